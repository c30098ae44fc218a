"""One .obj or .glb file as a ``Mesh`` with one texture, read by trimesh; nothing outside the folder is opened."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.movi.mesh import Mesh, join
from vpd_lightning.errors import ConfigError, DataError

MAX_BYTES = 256 * 2**20
MAX_READ_FACES = 2_000_000
TEXTURE_SIZE = 512  # pixels, longest side that is kept
_IMAGES = {".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tga", ".tif", ".tiff"}
_GREY = np.full((4, 4, 3), 160, dtype=np.uint8)
_BLOCK = 4  # texels along a face's side, where colours of vertices become a texture


def read_mesh(path: Path, folder: Path) -> Mesh:
    """Read a mesh with its texture, in the file's own units and axes.

    A picture (or base colour) of the material is kept, scaled down to ``TEXTURE_SIZE``; several materials become one
    texture; colours of vertices or faces are painted into one; without all that the mesh is grey.

    Raises:
        DataError: the file, or one that it names, is missing, outside ``folder``, broken or too big.
        ConfigError: trimesh is not installed.
    """
    try:
        import trimesh
    except ImportError as error:
        raise ConfigError("reading meshes of one's own needs trimesh: pip install trimesh") from error
    if path.stat().st_size > MAX_BYTES:
        raise DataError(f"{path}: {path.stat().st_size / 2**20:.0f} MiB; meshes may have {MAX_BYTES >> 20} MiB")
    files: Any = _FolderFiles(path, folder)  # what trimesh calls a resolver, without its base class
    try:
        content = io.BytesIO(path.read_bytes())
        scene = trimesh.load_scene(content, file_type=path.suffix[1:].lower(), resolver=files, process=False)
        found = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    except Exception as error:  # a parser of a damaged file may raise anything
        if files.refused:
            raise DataError(f"{path}: {files.refused[0]}") from error
        raise DataError(f"{path}: cannot be read as {path.suffix[1:]} ({type(error).__name__}: {error})") from error
    if files.refused:
        raise DataError(f"{path}: {files.refused[0]}")
    if not found:
        raise DataError(f"{path}: holds no faces")
    count = sum(len(part.faces) for part in found)
    if count > MAX_READ_FACES:
        raise DataError(f"{path}: {count:,} faces; at most {MAX_READ_FACES:,} are read. Simplify the mesh first.")
    parts = [_part(part, path) for part in found]
    has_picture = any(_picture(getattr(part.visual, "material", None))[0] is not None for part in found)
    if not has_picture and (files.has_served_image or _promises_picture(content.getvalue())):
        raise DataError(f"{path}: its picture cannot be decoded; save it as PNG or JPEG")
    mesh = parts[0] if len(parts) == 1 else _merged(parts)
    if not np.isfinite(mesh.vertices).all() or mesh.texcoords is None or not np.isfinite(mesh.texcoords).all():
        raise DataError(f"{path}: holds coordinates that are not finite")
    return mesh


def _promises_picture(content: bytes) -> bool:
    """Whether a .glb file says that a material has a picture (trimesh leaves out what it cannot decode)."""
    if content[:4] != b"glTF" or content[16:20] != b"JSON":
        return False
    header = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    materials = header.get("materials", [])
    return any("baseColorTexture" in material.get("pbrMetallicRoughness", {}) for material in materials)


class _FolderFiles:
    """What trimesh asks for files that a mesh names: only inside ``folder``, and it remembers what it refused."""

    def __init__(self, path: Path, folder: Path) -> None:
        self.beside, self.folder = path.parent.resolve(), folder.resolve()
        self.file_name = path.name
        self.refused: list[str] = []
        self.has_served_image = False

    def get(self, name: str) -> bytes:
        wanted = name.strip().replace("\\", "/")
        # Google's scans keep their pictures in a folder of their own, which their .mtl does not say.
        for place in (self.beside / wanted, self.beside.parent / "materials" / "textures" / wanted):
            real = place.resolve()
            if not real.is_relative_to(self.folder):
                self.refused.append(f"names {wanted!r}, which lies outside of the folder; copy it next to the mesh")
                raise FileNotFoundError(wanted)
            if real.is_file():
                if real.stat().st_size > MAX_BYTES:
                    break
                self.has_served_image |= real.suffix.lower() in _IMAGES
                return real.read_bytes()
        self.refused.append(f"names {wanted!r}, which is not there (or too big); put it next to the mesh")
        raise FileNotFoundError(wanted)

    def __getitem__(self, name: str) -> bytes:
        return self.get(name)

    def keys(self) -> list[str]:
        return []

    def __contains__(self, name: str) -> bool:
        return False


def _part(part: Any, path: Path) -> Mesh:
    """One of trimesh's meshes with texture coordinates and a texture."""
    vertices = np.asarray(part.vertices, dtype=np.float64)
    faces = np.asarray(part.faces, dtype=np.int32)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise DataError(f"{path}: a face names a vertex that is not there")
    visual = part.visual
    if getattr(visual, "kind", None) in ("vertex", "face"):
        corners = np.asarray(visual.vertex_colors)[faces] if visual.kind == "vertex" else None
        if corners is None:
            corners = np.repeat(np.asarray(visual.face_colors)[:, None], 3, axis=1)
        return _painted(vertices, faces, corners[..., :3].astype(np.float64))
    texture, texcoords = _GREY, np.full((len(vertices), 2), 0.5)
    material = getattr(visual, "material", None)
    if material is not None:
        image, factor = _picture(material)
        uv = getattr(visual, "uv", None)
        if image is not None and uv is not None and np.shape(uv) == (len(vertices), 2):
            tint = np.rint(image * (factor if hasattr(material, "baseColorFactor") else 1.0))
            return Mesh(vertices, faces, np.asarray(uv, dtype=np.float64), tint.astype(np.uint8))
        texture = np.broadcast_to(np.rint(255 * factor), (4, 4, 3)).astype(np.uint8)
    return Mesh(vertices, faces, texcoords, texture)


def _picture(material: Any) -> tuple[NDArray[np.float64] | None, NDArray[np.float64]]:
    """Return the material's picture (or None), 0 to 255, and its plain colour, 0 to 1."""
    image = getattr(material, "baseColorTexture", None)
    if image is None:
        image = getattr(material, "image", None)
    color = getattr(material, "baseColorFactor", None)
    if color is None:
        color = getattr(material, "diffuse", None)
    factor = np.full(3, 160 / 255)
    if color is not None:
        given = np.asarray(color)
        factor = given[:3] / 255.0 if given.dtype.kind in "ui" else given[:3].astype(np.float64)
    elif image is not None:
        factor = np.ones(3)
    if image is None:
        return None, np.clip(factor, 0.0, 1.0)
    image = image.convert("RGB")
    shrink = TEXTURE_SIZE / max(image.size)
    if shrink < 1.0:
        image = image.resize([max(1, round(side * shrink)) for side in image.size])
    return np.asarray(image, dtype=np.float64), np.clip(factor, 0.0, 1.0)


def _painted(vertices: NDArray[np.float64], faces: NDArray[np.int32], colors: NDArray[np.float64]) -> Mesh:
    """Paint colours of corners (face, 3, 3), 0 to 255, into a texture with a small square for each face."""
    side = int(np.ceil(np.sqrt(len(faces))))
    share = np.arange(_BLOCK) / (_BLOCK - 1)
    right, up = np.meshgrid(share, share[::-1])  # the picture's rows run down
    weights = np.stack([1.0 - right - up, right, up], axis=-1)
    squares = np.zeros((side * side, _BLOCK, _BLOCK, 3))
    squares[: len(faces)] = np.einsum("ijk,fkc->fijc", weights, colors)
    image = squares.reshape(side, side, _BLOCK, _BLOCK, 3).transpose(0, 2, 1, 3, 4).reshape(side * _BLOCK, -1, 3)
    low, high = 0.5 / _BLOCK, 1.0 - 0.5 / _BLOCK
    corner = np.array([[low, low], [high, low], [low, high]])
    row, column = np.divmod(np.arange(len(faces)), side)
    texcoords = (np.stack([column, side - 1 - row], axis=1)[:, None] + corner) / side
    return Mesh(
        vertices[faces.reshape(-1)],
        np.arange(faces.size, dtype=np.int32).reshape(-1, 3),
        texcoords.reshape(-1, 2),
        np.rint(np.clip(image, 0, 255)).astype(np.uint8),
    )


def _merged(parts: list[Mesh]) -> Mesh:
    """Join meshes of different materials; their pictures come side by side in one."""
    import cv2

    columns = int(np.ceil(np.sqrt(len(parts))))
    size = max(16, 2 * TEXTURE_SIZE // columns)
    atlas = np.zeros((columns * size, columns * size, 3), dtype=np.uint8)
    moved = []
    for index, part in enumerate(parts):
        assert part.texcoords is not None and part.texture is not None
        # Coordinates outside of 0 to 1 repeat the picture, so it is repeated here as often as they say.
        start = np.floor(part.texcoords.min(axis=0) + 1e-6)
        repeats = np.clip(np.ceil(part.texcoords.max(axis=0) - start - 1e-6), 1, 16)
        tiled = np.tile(part.texture, (int(repeats[1]), int(repeats[0]), 1))
        row, column = divmod(index, columns)
        small = cv2.resize(tiled, (size, size), interpolation=cv2.INTER_AREA)
        atlas[row * size : (row + 1) * size, column * size : (column + 1) * size] = small
        share = np.clip((part.texcoords - start) / repeats, 0.5 / size, 1.0 - 0.5 / size)
        texcoords = (share + [column, columns - 1 - row]) / columns
        moved.append(Mesh(part.vertices, part.faces, texcoords))
    whole = join(moved)
    return Mesh(whole.vertices, whole.faces, whole.texcoords, atlas)
