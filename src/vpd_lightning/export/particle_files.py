"""Particles on disk: binary PLY (opens in MeshLab, Blender, CloudCompare) and NPZ."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vpd_lightning.data.schema import AtomicPath

_PLY_VERTEX = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])


def write_ply(path: Path, positions: NDArray[np.floating], colors: NDArray[np.uint8]) -> None:
    """Write coloured points: ``positions`` (particle, 3) in metres, world frame; ``colors`` (particle, 3) sRGB."""
    vertices = np.empty(len(positions), _PLY_VERTEX)
    for axis, name in enumerate(("x", "y", "z")):
        vertices[name] = positions[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = colors[:, channel]
    kinds = {"f4": "float", "u1": "uchar"}
    properties = [f"property {kinds[_PLY_VERTEX[name].str[1:]]} {name}" for name in _PLY_VERTEX.names or ()]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}", *properties, "end_header"]
    with AtomicPath(path) as partial, partial.open("wb") as stream:
        stream.write(("\n".join(header) + "\n").encode("ascii"))
        stream.write(vertices.tobytes())


def write_particles(
    path: Path,
    positions: NDArray[np.floating],
    features: NDArray[np.floating],
    colors: NDArray[np.uint8],
) -> None:
    """Write one frame's ``positions`` (particle, 3), ``features`` (particle, feature) and ``colors`` as NPZ."""
    with AtomicPath(path) as partial, partial.open("wb") as stream:
        np.savez_compressed(stream, positions=positions, features=features, colors=colors)
