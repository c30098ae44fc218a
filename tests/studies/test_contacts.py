"""What the study of contact counts, on poses with a known answer. Metres and steps."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from data_gen.pushing.bodies import draw_bodies
from data_gen.pushing.settings import PushingSettings
from data_gen.settings import SPLIT_CODES, load_settings
from docs.results.studies.contacts import MOVED, Counts, Shapes, carried, fall, onset

AWAY = np.array([5.0, 5.0, 0.1])


@pytest.fixture(scope="module")
def settings() -> PushingSettings:
    return load_settings(
        PushingSettings, "pushing", "tiny", {"bodies.count_min": 2, "bodies.count_max": 2, "bodies.shapes": ["box"]}
    )


@pytest.fixture(scope="module")
def shapes(settings: PushingSettings) -> Shapes:
    return Shapes(settings, 0, "test", 0)


@pytest.fixture(scope="module")
def poses(settings: PushingSettings) -> np.ndarray:
    bodies = draw_bodies(settings, np.random.default_rng([0, SPLIT_CODES["test"], 0]))
    up = [Rotation.from_euler("z", body.yaw).as_quat(scalar_first=True) for body in bodies]
    return np.array([[*body.place, body.half_sizes[2], *turn] for body, turn in zip(bodies, up, strict=True)])


def test_what_stands_on_the_table_lies_in_nothing(shapes: Shapes, poses: np.ndarray) -> None:
    assert shapes.depths(poses, AWAY) == pytest.approx({"pusher": 0, "table": 0, "bodies": 0}, abs=1e-6)
    assert not shapes.is_touched(0, poses, AWAY)


def test_how_deep_things_lie_in_each_other(shapes: Shapes, poses: np.ndarray) -> None:
    sunk = poses.copy()
    sunk[0, 2] -= 0.004
    assert shapes.depths(sunk, AWAY)["table"] == pytest.approx(0.004, abs=2e-4)
    inside = shapes.depths(poses, poses[0, :3])
    assert inside["pusher"] > 0.01 and inside["bodies"] == 0 and shapes.is_touched(0, poses, poses[0, :3])
    together = poses.copy()
    together[1, :2] = poses[0, :2] + [0.01, 0.0]
    assert shapes.depths(together, AWAY)["bodies"] > 0.01 and shapes.is_touched(1, together, AWAY)


def test_a_body_is_carried_as_its_points_move() -> None:
    draw = torch.Generator().manual_seed(0)
    start = np.array([0.1, 0.2, 0.3, *Rotation.from_euler("xyz", [0.3, 0.2, 0.1]).as_quat(scalar_first=True)])
    points = torch.rand(20, 3, generator=draw, dtype=torch.float64) * 0.05 + torch.from_numpy(start[:3])
    turn, shift = Rotation.from_euler("xyz", [0.5, -0.4, 0.9]), np.array([0.3, -0.1, 0.05])
    moved = torch.from_numpy(turn.apply(points.numpy()) + shift)
    found = carried(start, torch.stack([points, points, moved]))
    assert found[0] == pytest.approx(start)
    assert found[1, :3] == pytest.approx(turn.apply(start[:3]) + shift)
    there = Rotation.from_quat(found[1, 3:], scalar_first=True)
    assert (there * (turn * Rotation.from_quat(start[3:], scalar_first=True)).inv()).magnitude() < 1e-9


def test_when_a_body_moves_and_when_it_falls() -> None:
    places = np.zeros((6, 3))
    assert onset(places) == np.inf and fall(places) == np.inf
    places[3:, 0], places[5, 2] = 1.5 * MOVED, -0.1
    assert onset(places) == 3 and fall(places) == 5


def test_what_is_counted_is_shares_and_means() -> None:
    counts = Counts(late=[0.0, 2.0, -3.0, np.inf], false_starts=[True, False], drift=[0.001, 0.003])
    counts.depth["table"] = [0.0, 0.01]
    counts.falls, counts.false_falls = [1.0, np.inf], [False]
    found = counts.summary()
    assert found["onsets"]["within_two_frames"] == 0.5 and found["onsets"]["never"] == 0.25
    assert found["onsets"]["frames_later"] == pytest.approx(-1 / 3) and found["onsets"]["of_these_moved"] == 0.5
    assert found["penetration_mm"]["table"]["mean"] == pytest.approx(5.0)
    assert found["drift_mm"]["largest"] == pytest.approx(3.0)
    assert found["falls"]["fall"] == 0.5 and found["falls"]["within_two_frames"] == 0.5
