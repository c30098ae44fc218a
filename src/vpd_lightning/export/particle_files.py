"""Particles on disk: binary PLY (opens in MeshLab, Blender, CloudCompare) and NPZ."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vpd_lightning.data.ply import write_ply
from vpd_lightning.data.schema import AtomicPath

__all__ = ["write_particles", "write_ply"]


def write_particles(
    path: Path,
    positions: NDArray[np.floating],
    features: NDArray[np.floating],
    colors: NDArray[np.uint8],
) -> None:
    """Write one frame's ``positions`` (particle, 3), ``features`` (particle, feature) and ``colors`` as NPZ."""
    with AtomicPath(path) as partial, partial.open("wb") as stream:
        np.savez_compressed(stream, positions=positions, features=features, colors=colors)
