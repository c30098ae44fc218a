"""A camera shifted along a bare table is told by colours, where there are any, and right ones are left alone."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from data_gen.inspection.color_agreement import ColoredView, slide
from data_gen.inspection.posed_depth import PosedDepth
from data_gen.inspection.validate import check_dataset
from tests.data.analytic_scene import Array, cast, known_trajectory, look_at, pinhole
from vpd_lightning.data.schema import Trajectory, write_trajectory

HEIGHT, WIDTH = 72, 96
INTRINSICS = pinhole(HEIGHT, WIDTH, 45.0)
PLACES = ((-1.0, -1.0, 1.1), (1.1, -0.8, 1.0), (0.1, 1.2, 1.2))
POSES = np.stack([look_at(np.array(place), np.zeros(3)) for place in PLACES])


def points_seen(pose: Array, depth: Array) -> Array:
    v, u = np.meshgrid(np.arange(HEIGHT) + 0.5, np.arange(WIDTH) + 0.5, indexing="ij")
    directions = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(INTRINSICS).T
    return (directions * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]


def stained(points: Array) -> Array:
    """Stains on the table, of about 20 cm, in [0, 1]."""
    x, y = points[..., 0], points[..., 1]
    return 0.5 + 0.2 * np.stack([np.sin(9 * x + 4 * y), np.sin(7 * y - 5 * x + 1), np.sin(6 * x) * np.cos(8 * y)], -1)


def table(
    paint: Callable[[Array], Array] = stained,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    gains: tuple[float, ...] = (1.0, 0.8, 1.1),
    num_views: int = 3,
) -> Trajectory:
    """A table seen by cameras of different exposure; the second one's pose is stored off by ``shift`` (metres)."""
    draw = np.random.default_rng(0)
    depth = np.stack([cast([], INTRINSICS, pose, HEIGHT, WIDTH, wall=100.0) for pose in POSES[:num_views]])
    rgb = []
    for view, pose in enumerate(POSES[:num_views]):
        colors = gains[view] * paint(points_seen(pose, depth[view])) + 0.02 * draw.normal(size=(HEIGHT, WIDTH, 3))
        rgb.append((255 * colors.clip(0, 1)).astype(np.uint8))
    stored = POSES[:num_views].copy()
    stored[1, :3, 3] += shift
    return known_trajectory(
        num_frames=3,
        num_views=num_views,
        height=HEIGHT,
        width=WIDTH,
        rgb=np.repeat(np.stack(rgb)[None], 3, axis=0),
        depth=np.repeat((depth * (1 + 0.003 * draw.normal(size=depth.shape)))[None], 3, axis=0).astype(np.float32),
        intrinsics=np.repeat(INTRINSICS[None], num_views, axis=0),
        cam_to_world=stored,
    )


def faults(folder: Path, trajectory: Trajectory) -> list[str]:
    write_trajectory(folder / "000000.h5", trajectory)
    return [f"{fault.name}: {fault.message}" for fault in check_dataset(folder / "000000.h5").faults if fault.is_error]


@pytest.mark.parametrize("shift", [(0.03, 0.0, 0.0), (0.0, -0.03, 0.0)])
@pytest.mark.parametrize("num_views", [2, 3])
def test_a_camera_three_centimetres_along_the_table_is_named(
    tmp_path: Path, shift: tuple[float, float, float], num_views: int
) -> None:
    (found,) = faults(tmp_path, table(shift=shift, num_views=num_views))
    named = "view 1 is off: its" if num_views == 3 else "view 0 or view 1 is off: their"
    assert found.startswith(f"pose_off: the pose of {named} colours lie")
    (distance,) = re.findall(r"colours lie ([\d.]+) cm", found)
    assert float(distance) == pytest.approx(3.0, abs=0.5)


@pytest.mark.parametrize("num_views", [2, 3])
def test_right_cameras_of_any_exposure_pass(tmp_path: Path, num_views: int) -> None:
    assert not faults(tmp_path, table(num_views=num_views))


def test_what_has_no_colours_says_nothing(tmp_path: Path) -> None:
    plain = table(paint=lambda points: np.full(points.shape, 0.5), shift=(0.03, 0.0, 0.0))
    assert not faults(tmp_path, plain)


def test_highlights_that_move_with_the_camera_are_no_pose(tmp_path: Path) -> None:
    right = table()
    rgb = right.rgb.astype(np.float64)
    row, column = np.indices((HEIGHT, WIDTH))
    for view in range(3):  # at the same place of every picture, whatever is there
        rgb[:, view] += 80 * np.exp(-((row - 30) ** 2 + (column - 50) ** 2) / 60)[None, ..., None]
    bright = known_trajectory(
        num_frames=3,
        num_views=3,
        height=HEIGHT,
        width=WIDTH,
        rgb=rgb.clip(0, 255).astype(np.uint8),
        depth=right.depth,
        intrinsics=right.intrinsics,
        cam_to_world=right.cam_to_world,
    )
    assert not faults(tmp_path, bright)


def test_the_slide_is_the_one_that_was_made() -> None:
    depth = [cast([], INTRINSICS, pose, HEIGHT, WIDTH, wall=100.0) for pose in POSES[:2]]
    rgb = [(255 * stained(points_seen(pose, one))).astype(np.uint8) for pose, one in zip(POSES, depth, strict=False)]
    points = points_seen(POSES[0], depth[0])[20:-20, 30:-30]
    rows, columns = np.indices((HEIGHT, WIDTH))[:, 20:-20, 30:-30]
    pixels = np.stack([rows.ravel(), columns.ravel()], axis=1)
    other = PosedDepth(depth[1].astype(np.float32), INTRINSICS, POSES[1])
    made = np.array([0.02, -0.03, 0.0])
    part = ColoredView(points.reshape(-1, 3) - made, pixels, rgb[0], other, rgb[1])
    center, axes = points.reshape(-1, 3).mean(axis=0), np.eye(6)[:, :2]

    found = slide([part], center, 0.5, axes)
    assert found is not None and found.error < 0.003
    np.testing.assert_allclose(found.motion[:3], made, atol=0.003)

    assert slide([part], center, 0.5, axes[:, :0]) is None
