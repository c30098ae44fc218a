"""A folder of the user's own meshes (.obj, .glb), for those who have the scans that the stand-ins stand in for."""

import hashlib
import os
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import overload

from data_gen.movi.collision_parts import hull
from data_gen.movi.mesh import Mesh
from data_gen.movi.mesh_files import read_mesh
from data_gen.movi.mesh_reduction import reduced
from vpd_lightning.errors import DataError

SUFFIXES = (".obj", ".glb")
MAX_FACES = 5000  # more are merged: pictures of 128 pixels do not show them, and every one costs time in every frame
MIN_VOLUME = 1e-5  # of the hull, where the longest side is 1; flatter things have no inside that could collide
_NUM_CACHED = 64


class UserMeshes(Sequence[tuple[str, Mesh]]):
    """Names and meshes of a folder, in the order of their paths; each mesh is read when it is asked for.

    Attributes:
        folder: where they lie.
        paths: the mesh files relative to ``folder``, with slashes, sorted.
    """

    def __init__(self, folder: Path, paths: Sequence[str]) -> None:
        self.folder, self.paths = folder, tuple(paths)
        self._read = lru_cache(maxsize=_NUM_CACHED)(self._load)

    def __len__(self) -> int:
        return len(self.paths)

    @overload
    def __getitem__(self, index: int) -> tuple[str, Mesh]: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[tuple[str, Mesh]]: ...
    def __getitem__(self, index: int | slice) -> tuple[str, Mesh] | Sequence[tuple[str, Mesh]]:
        if isinstance(index, slice):
            return UserMeshes(self.folder, self.paths[index])
        path = self.paths[index]
        return path, self._read(path)

    def sha256(self) -> str:
        """Return a digest of the names and contents of all files of the folder: pictures and materials count, too."""
        digest = hashlib.sha256()
        for path in _files(self.folder):
            content = hashlib.sha256((self.folder / path).read_bytes()).hexdigest()
            digest.update(f"{content}  {path}\n".encode())
        return digest.hexdigest()

    def check(self) -> None:
        """Read every mesh once.

        Raises:
            DataError: one of them cannot be used; the message names it.
        """
        for path in self.paths:
            self._load(path)

    def _load(self, path: str) -> Mesh:
        mesh = read_mesh(self.folder / path, self.folder).without_slivers()
        where = self.folder / path
        longest = float(mesh.extents.max()) if len(mesh.faces) else 0.0
        if longest <= 0.0:
            raise DataError(f"{where}: has no size")
        try:
            solid = hull(mesh.normalized().vertices).mesh
        except ValueError as error:
            raise DataError(f"{where}: is flat, so it has no volume that could collide") from error
        assert solid is not None
        if solid.volume < MIN_VOLUME:
            raise DataError(f"{where}: is nearly flat, so it has no volume that could collide")
        mesh = reduced(mesh, MAX_FACES).normalized()
        if mesh.is_closed and mesh.volume < 0.0:  # written inside out
            mesh = Mesh(mesh.vertices, mesh.faces[:, ::-1].copy(), mesh.texcoords, mesh.texture)
        return mesh.shaded()


def load_folder(folder: str | Path) -> UserMeshes:
    """Find the meshes in ``folder`` and its subfolders.

    Each is centred and its longest side is 1 (scenes set sizes anyway); axes stay the file's. Files named
    ``collision*`` are passed over: Kubric's asset folders hold one beside each visual mesh. The object's convex hull
    collides.

    Raises:
        DataError: no such folder, or no meshes in it.
    """
    root = Path(folder).expanduser()
    if not root.is_dir():
        raise DataError(f"{root} is not a folder of meshes")
    names = [
        path
        for path in _files(root)
        if path.lower().endswith(SUFFIXES) and not path.rsplit("/", 1)[-1].lower().startswith("collision")
    ]
    if not names:
        raise DataError(f"{root} holds no meshes; put {' or '.join(SUFFIXES)} files there")
    return UserMeshes(root, names)


def _files(root: Path) -> list[str]:
    """All files under ``root`` as sorted relative paths; links that lead out of it are left alone."""
    inside = root.resolve()
    found = []
    for folder, _, names in os.walk(root):
        for name in names:
            path = Path(folder) / name
            if path.is_file() and path.resolve().is_relative_to(inside):
                found.append(path.relative_to(root).as_posix())
    return sorted(found)
