"""A recording of a soft tetrahedral body that falls, turns and is squashed, and of a rigid box beside it."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from tests.evaluation.tossed_box import NUM_FRAMES, tossed_box
from vpd_lightning.data.schema import Trajectory, write_trajectory

CENTER, RADIUS, FALL = np.array([0.5, 0.5, 0.4]), 0.3, 0.03  # m, m, m per frame


@dataclass(frozen=True)
class SoftScene:
    """Where it is stored, and where points of the soft body's surface (material points) truly are in each frame."""

    path: Path
    surface: torch.Tensor  # (time, point, 3)


def write_soft_ball(path: Path) -> SoftScene:
    """Object 0 is the box of ``tossed_box``, object 1 the soft body."""
    box = tossed_box(0)
    assert box.state is not None
    rest = _ball()
    tetrahedra = Delaunay(rest).simplices.astype(np.int32)
    vertices = np.stack([_deformed(rest, frame) for frame in range(NUM_FRAMES)]).astype(np.float32)
    faces = rest[_hull(rest)]
    weights = np.random.default_rng(1).dirichlet([1, 1, 1], len(faces))
    assert faces.shape[1:] == (3, 3)
    corners = vertices[:, _hull(rest)].astype(np.float64)
    write_trajectory(path, replace(box, state=_state(box, vertices, tetrahedra)))
    return SoftScene(path, torch.from_numpy(np.einsum("tpck,pc->tpk", corners, weights)))


def _ball() -> np.ndarray:
    """Vertices evenly over a sphere (Fibonacci), and one in the middle so that no tetrahedron is flat."""
    number = np.arange(80) + 0.5
    polar, around = np.arccos(1 - 2 * number / 80), np.pi * (1 + 5**0.5) * number
    sphere = np.stack([np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)], axis=1)
    return np.concatenate([RADIUS * sphere, np.zeros((1, 3))])


def _deformed(rest: np.ndarray, frame: int) -> np.ndarray:
    squash = np.array([1 + 0.04 * frame, 1 + 0.02 * frame, 1 - 0.05 * frame])
    turned = Rotation.from_rotvec([0.0, 0.1 * frame, 0.2 * frame]).apply(rest)
    return np.asarray(turned * squash + CENTER - [0, 0, FALL * frame])


def _hull(rest: np.ndarray) -> np.ndarray:
    return np.asarray(Delaunay(rest).convex_hull)


def _state(box: Trajectory, vertices: np.ndarray, tetrahedra: np.ndarray) -> dict[str, np.ndarray]:
    assert box.state is not None
    center = vertices.mean(axis=1, dtype=np.float64)
    still = np.broadcast_to([1.0, 0.0, 0.0, 0.0], (NUM_FRAMES, 4))
    second = {
        "positions": center,
        "quaternions": still,
        "linear_velocities": np.zeros_like(center),
        "angular_velocities": np.zeros_like(center),
    }
    joined = {name: np.stack([box.state[name][:, 0], values], axis=1) for name, values in second.items()}
    return {
        **box.state,
        **joined,
        "half_sizes": np.concatenate([box.state["half_sizes"], np.full((1, 3), RADIUS)]),
        "vertices": vertices,
        "vertex_objects": np.ones(vertices.shape[1], np.int32),
        "tetrahedra": tetrahedra,
    }
