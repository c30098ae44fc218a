"""A camera that takes its pictures later than the others is named, also under noise; correct ones are left alone."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_gen.inspection.trigger_delay import TriggerDelay, trigger_delays
from data_gen.inspection.validate import check_dataset
from tests.data.analytic_scene import Box, cast, known_trajectory
from vpd_lightning.data.schema import Trajectory, write_trajectory
from vpd_lightning.data.sensors import Sensor, load_sensor
from vpd_lightning.data.sensors.sensor import median_depth

NUM_FRAMES, HEIGHT, WIDTH = 16, 72, 96


def thrown(delays: Sequence[float], seed: int = 0, sensor: str = "none") -> Trajectory:
    """Two boxes in flight before three cameras, each of which is late by its delay (s)."""
    still = known_trajectory(seed, num_frames=1, num_views=len(delays), height=HEIGHT, width=WIDTH)
    draw = np.random.default_rng([3, seed])
    starts, velocities = draw.uniform(-0.3, 0.3, (2, 3)), draw.uniform(-1.0, 1.0, (2, 3))
    angles, turns = draw.uniform(0, np.pi, 2), draw.uniform(-3, 3, 2)
    half_sizes = draw.uniform(0.08, 0.2, (2, 3))
    depth = np.empty((NUM_FRAMES, len(delays), HEIGHT, WIDTH), np.float32)
    for frame, view in np.ndindex(*depth.shape[:2]):
        time = frame * still.frame_time + delays[view] - 0.4
        boxes = []
        for start, velocity, angle, turn, half_size in zip(starts, velocities, angles, turns, half_sizes, strict=True):
            center = start + velocity * time + [0.0, 0.0, 0.6 - 2.0 * time**2 / 2]
            cosine, sine = np.cos(angle + turn * time), np.sin(angle + turn * time)
            boxes.append(Box(center, np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]]), half_size))
        depth[frame, view] = cast(boxes, still.intrinsics[view], still.cam_to_world[view], HEIGHT, WIDTH)
    settings = load_sensor(sensor)
    if settings is not None:
        camera = Sensor(settings, seed=seed, trajectory=str(seed), median_depth=median_depth(depth, still.far))
        intrinsics = np.broadcast_to(still.intrinsics, (*depth.shape[:2], 3, 3))
        for frame, view in np.ndindex(*depth.shape[:2]):
            depth[frame, view] = camera.measure_depth(depth[frame, view], intrinsics[frame, view], frame, view)
    rgb = np.zeros((*depth.shape, 3), np.uint8)
    return replace(still, depth=depth, rgb=rgb)


def written(folder: Path, trajectories: Sequence[Trajectory]) -> list[Path]:
    paths = [folder / f"{number:06d}.h5" for number in range(len(trajectories))]
    for path, trajectory in zip(paths, trajectories, strict=True):
        write_trajectory(path, trajectory)
    return paths


def measured(folder: Path, delays: Sequence[float]) -> list[TriggerDelay]:
    return trigger_delays(written(folder, [thrown(delays)]))


@pytest.mark.parametrize("late", [-0.02, 0.0, 0.01, 0.025, 0.05], ids=lambda late: f"{1e3 * late:.0f} ms")
def test_delay_is_measured_on_exact_depth(tmp_path: Path, late: float):
    found = measured(tmp_path, [0.0, late, 0.0])
    assert [item.view for item in found] == [0, 1, 2]
    for item in found:
        truth = late if item.view == 1 else 0.0
        assert abs(item.delay - truth) < 0.002 + 0.1 * abs(late), item


def test_of_two_views_each_is_compared_with_the_other(tmp_path: Path):
    first, second = measured(tmp_path, [0.0, 0.02])
    assert first.delay == pytest.approx(-second.delay)
    assert second.delay == pytest.approx(0.02, abs=0.003)
    assert second.is_certain and second.others == (0,)


def test_nothing_is_said_where_nothing_moves(tmp_path: Path):
    assert trigger_delays(written(tmp_path, [known_trajectory(0, num_frames=4)])) == []


@pytest.mark.parametrize("sensor", ["structured_light", "active_stereo", "time_of_flight"])
def test_thirty_milliseconds_are_named_under_noise_and_none_are_not(tmp_path: Path, sensor: str):
    together = written(tmp_path, [thrown([0, 0, 0], 0, sensor)])
    report = check_dataset(together[0])
    assert report.is_valid and "views taken within" in report.summary, report
    late = written(tmp_path, [thrown([0, 0, 0.03], 0, sensor)])
    named = [fault for fault in check_dataset(late[0]).faults if fault.is_error]
    assert [fault.name for fault in named] == ["trigger_delay"], named
    assert "view 2 is taken" in named[0].message and "later than views 0, 1" in named[0].message
