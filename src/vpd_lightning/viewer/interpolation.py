"""A camera that goes smoothly from place to place."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

Place = tuple[Float[NDArray, "4 4"], float]


def between(places: Sequence[Place], steps: int) -> list[Place]:
    """Return the places (pose, vertical field of view in radians) with ``steps - 1`` more between any two.

    Positions follow a cubic spline and turns one without jumps in angular speed (SciPy's ``RotationSpline``), both
    natural at the ends; fields of view are interpolated linearly.

    Raises:
        ValueError: no place, or ``steps`` below 1.
    """
    if not places or steps < 1:
        raise ValueError(f"need a place and a step or more, got {len(places)} places and {steps} steps")
    if len(places) == 1:
        return list(places)
    knots = np.arange(len(places), dtype=np.float64)
    times = np.linspace(0.0, knots[-1], (len(places) - 1) * steps + 1)
    poses = np.stack([np.asarray(pose, dtype=np.float64) for pose, _ in places])
    turns = RotationSpline(knots, Rotation.from_matrix(poses[:, :3, :3]))(times).as_matrix()
    positions = CubicSpline(knots, poses[:, :3, 3], bc_type="natural")(times)
    fields = np.interp(times, knots, [fov for _, fov in places])
    found = []
    for turn, position, fov in zip(turns, positions, fields, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, position
        found.append((pose, float(fov)))
    return found
