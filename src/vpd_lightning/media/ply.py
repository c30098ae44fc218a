"""Coloured points on disk: binary PLY, which MeshLab, Blender and CloudCompare open."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vpd_lightning.files import AtomicPath

_VERTEX = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])


def write_ply(path: Path, positions: NDArray[np.floating], colors: NDArray[np.uint8]) -> None:
    """Write coloured points: ``positions`` (point, 3) in metres, world frame; ``colors`` (point, 3) sRGB."""
    vertices = np.empty(len(positions), _VERTEX)
    for axis, name in enumerate(("x", "y", "z")):
        vertices[name] = positions[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = colors[:, channel]
    kinds = {"f4": "float", "u1": "uchar"}
    properties = [f"property {kinds[_VERTEX[name].str[1:]]} {name}" for name in _VERTEX.names or ()]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}", *properties, "end_header"]
    with AtomicPath(path) as partial, partial.open("wb") as stream:
        stream.write(("\n".join(header) + "\n").encode("ascii"))
        stream.write(vertices.tobytes())
