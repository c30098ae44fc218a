"""Particles on disk: binary PLY (opens in MeshLab, Blender, CloudCompare), NPZ, and GLB (browsers, Blender)."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vpd_lightning.files import AtomicPath
from vpd_lightning.media.ply import write_ply

__all__ = ["WRITERS", "write_glb", "write_particles", "write_ply"]

_Z_UP_TO_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def write_particles(
    path: Path,
    positions: NDArray[np.floating],
    features: NDArray[np.floating],
    colors: NDArray[np.uint8],
) -> None:
    """Write one frame's ``positions`` (particle, 3), ``features`` (particle, feature) and ``colors`` as NPZ."""
    with AtomicPath(path) as partial, partial.open("wb") as stream:
        np.savez_compressed(stream, positions=positions, features=features, colors=colors)


def write_glb(path: Path, positions: NDArray[np.floating], colors: NDArray[np.uint8]) -> None:
    """Write coloured points as binary glTF: ``positions`` (point, 3) in metres, ``colors`` (point, 3) sRGB.

    The points are stored as they are, below a node that turns the world's z up into glTF's y up. Colours are stored as
    they are, too: a viewer that takes glTF's vertex colours for linear light shows them paler.
    """
    # Imported here: it is slow to import, and most films are made without it.
    import trimesh

    opaque = np.concatenate([colors, np.full((len(colors), 1), 255, np.uint8)], axis=1)
    scene = trimesh.Scene()
    cloud = trimesh.PointCloud(np.asarray(positions, np.float32), colors=opaque)
    scene.add_geometry(cloud, node_name="particles", geom_name="particles", transform=_Z_UP_TO_Y_UP)
    content = scene.export(file_type="glb")
    with AtomicPath(path) as partial:
        partial.write_bytes(content)


WRITERS: dict[str, Callable[[Path, NDArray, NDArray, NDArray[np.uint8]], None]] = {
    "ply": lambda path, positions, features, colors: write_ply(path, positions, colors),
    "npz": write_particles,
    "glb": lambda path, positions, features, colors: write_glb(path, positions, colors),
}
"""By the suffix; each takes a path, positions, features and colours."""
