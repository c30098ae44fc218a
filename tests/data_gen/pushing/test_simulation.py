"""The physics of pushing, without pictures: what the pusher does and what it does to bodies."""

from typing import Any

import numpy as np
import pytest

from data_gen.pushing.arm import cylinder_surface, joints_of, link_poses, link_surfaces, place_of
from data_gen.pushing.bodies import PlacedBody, draw_bodies
from data_gen.pushing.motion import CommandedPath, draw_path
from data_gen.pushing.scene import Pushing
from data_gen.pushing.settings import PushingSettings
from data_gen.settings import load_settings
from vpd_lightning.errors import ConfigError


def loaded(**overrides: Any) -> PushingSettings:
    return load_settings(PushingSettings, "pushing", "tiny", overrides)


def cube(place: list[float], mass: float = 0.2, friction: float = 0.4) -> PlacedBody:
    half_sizes = np.full(3, 0.04)
    return PlacedBody("box", half_sizes, mass, friction, (np.ones(3), np.zeros(3)), np.array(place), 0.0)


def straight(*places: list[float], seconds: float) -> CommandedPath:
    return CommandedPath(np.array(places), seconds * np.arange(len(places)))


def simulated(settings: PushingSettings, bodies: list[PlacedBody], path: CommandedPath) -> tuple[Pushing, np.ndarray]:
    """Return the simulation and the bodies' places (time, body, 3)."""
    pushing = Pushing(settings, bodies, path)
    places = []
    for frame in range(settings.num_frames):
        if frame:
            pushing.step(frame)
        pushing.begin_frame(frame)
        places.append(pushing.data.qpos[: 7 * len(bodies)].reshape(-1, 7)[:, :3].copy())
    return pushing, np.array(places)


def test_a_body_is_pushed_as_far_as_the_pusher_goes_and_not_before_it_is_touched() -> None:
    settings = loaded()
    path = straight([-0.2, 0.0], [0.1, 0.0], seconds=1.4)
    pushing, places = simulated(settings, [cube([0.0, 0.0])], path)
    poses = pushing.driven_motion().poses
    assert poses is not None
    tip = poses[:, 0, 0, 3] + settings.pusher.radius
    touched = int(np.argmax(places[:, 0, 0] > 1e-3))
    assert abs(tip[touched] - places[touched, 0, 0] + 0.04) < 0.003
    assert np.abs(places[: touched - 1, 0, :2]).max() < 1e-3
    assert places[-1, 0, 0] == pytest.approx(tip[-1] + 0.04, abs=0.01)


def test_a_body_pushed_over_the_edge_falls_to_the_floor() -> None:
    settings = loaded()
    edge = settings.table.half_size[0]
    path = straight([edge - 0.2, 0.0], [edge + 0.05, 0.0], seconds=0.6)
    _, places = simulated(settings, [cube([edge - 0.1, 0.0])], path)
    assert places[0, 0, 2] == pytest.approx(0.04)
    assert places[-1, 0, 2] == pytest.approx(0.04 - settings.table.height, abs=0.03)


def test_the_pusher_follows_its_command_by_the_time_that_its_control_takes() -> None:
    settings = loaded()
    path = straight([-0.2, 0.2], [0.2, 0.2], seconds=1.0)
    driven = simulated(settings, [cube([0.0, -0.2])], path)[0].driven_motion()
    assert driven.poses is not None and driven.commanded_poses is not None
    lag = settings.pusher.damping / settings.pusher.stiffness
    behind = path.at(0.5)[0] - path.at(0.5 - lag)[0]
    frame = round(0.5 / settings.frame_time)
    error = driven.commanded_poses[frame, 0, 0, 3] - driven.poses[frame, 0, 0, 3]
    assert error == pytest.approx(behind, rel=0.2)
    assert driven.commanded_poses[frame, 0, :2, 3] == pytest.approx(path.at(frame * settings.frame_time))


ARM = {"arm.links": [0.52, 0.5]}


@pytest.mark.parametrize("place", [(0.3, 0.2), (-0.39, 0.0), (0.4, -0.35), (0.0, 0.0)])
def test_the_arm_brings_the_pusher_where_it_should_be(place: tuple[float, float]) -> None:
    settings = loaded(**ARM)
    joints = joints_of(settings, np.array(place))
    assert place_of(settings, joints) == pytest.approx(place, abs=1e-9)
    assert place_of(loaded(), joints_of(loaded(), np.array(place))) == pytest.approx(place)


def test_links_and_their_points_are_where_mujoco_has_them() -> None:
    import mujoco

    settings = loaded(**ARM)
    pushing = Pushing(settings, [cube([0.0, 0.2])], straight([-0.2, -0.1], [0.3, 0.1], seconds=1.0))
    for _ in range(300):
        pushing._advance()
    mujoco.mj_kinematics(pushing.model, pushing.data)
    poses = link_poses(settings, pushing.data.qpos[-2:])
    points, normals, groups = link_surfaces(settings)
    assert len(poses) == 4 and len(points) == 3 * settings.arm.num_points + settings.pusher.num_points
    for link, name in enumerate(("column", "upper", "fore", "pusher")):
        body = pushing.data.body(name)
        assert poses[link, :3, 3] == pytest.approx(body.xpos, abs=1e-6)
        assert poses[link, :3, :3].ravel() == pytest.approx(body.xmat, abs=1e-6)
        geom = int(pushing.model.body(name).geomadr[0])
        local = points[groups == link] @ poses[link, :3, :3].T + poses[link, :3, 3] - pushing.data.geom_xpos[geom]
        local = local @ pushing.data.geom_xmat[geom].reshape(3, 3)
        radius, half = pushing.model.geom_size[geom, :2]
        on_side = np.abs(np.linalg.norm(local[:, :2], axis=1) - radius) < 1e-6
        on_cap = np.abs(np.abs(local[:, 2]) - half) < 1e-6
        assert (on_side | on_cap).all() and on_side.mean() > 0.5
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0)


def test_an_arm_pushes_as_the_pusher_by_itself_does() -> None:
    path = straight([-0.2, 0.0], [0.1, 0.0], seconds=1.4)
    alone, there = simulated(loaded(), [cube([0.0, 0.0])], path)
    carried, here = simulated(loaded(**ARM), [cube([0.0, 0.0])], path)
    assert here[-1, 0] == pytest.approx(there[-1, 0], abs=0.02)
    assert carried.driven_motion().points.shape[1] == 4 * 64
    assert carried.place == pytest.approx(alone.place, abs=0.01)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"arm.links": [0.5]}, "two lengths"),
        ({"arm.links": [0.3, 0.3]}, "a reach"),
        ({"arm.links": [0.9, 0.3]}, "a reach"),
        ({"arm.links": [0.52, 0.5], "arm.radius": 0.0}, "arm.radius"),
    ],
)
def test_an_arm_that_does_not_reach_is_refused(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        loaded(**settings)


def test_with_a_camera_delay_the_action_is_that_of_a_moment_after_the_picture() -> None:
    path = straight([-0.2, 0.2], [0.2, 0.2], seconds=1.0)
    bodies = [cube([0.0, -0.2])]
    late, places = simulated(loaded(camera_delay=0.02), bodies, path)
    fine, _ = simulated(loaded(frame_time=0.02, num_frames=80), bodies, path)
    _, without = simulated(loaded(), bodies, path)
    found, expected = late.driven_motion().poses, fine.driven_motion().poses
    assert found is not None and expected is not None
    np.testing.assert_array_equal(found, expected[1::2])
    np.testing.assert_array_equal(places, without)  # the pictures' moments do not change


@pytest.mark.parametrize("seed", range(20))
def test_at_first_nothing_touches_and_everything_lies_still(seed: int) -> None:
    settings = loaded(num_frames=2)
    generator = np.random.default_rng(seed)
    bodies = draw_bodies(settings, generator)
    assert settings.bodies.count_min <= len(bodies) <= settings.bodies.count_max
    path = draw_path(settings, bodies, 2.0, generator)
    pushing = Pushing(settings, bodies, CommandedPath(path.places[[0, 0]], np.array([0.0, 10.0])))
    before = pushing.data.qpos.copy()
    pushing.step(1)
    pairs = {frozenset((pushing.model.geom(contact.geom1).name, pushing.model.geom(contact.geom2).name)) for contact in
             pushing.data.contact}  # fmt: skip
    assert {len(pair - {"top"}) for pair in pairs} <= {1}, pairs
    assert np.abs(pushing.data.qpos - before).max() < 2e-3


@pytest.mark.parametrize("task_share", [0.0, 1.0])
def test_a_path_keeps_its_speeds_and_lasts_long_enough(task_share: float) -> None:
    settings = loaded(**{"pusher.task_share": task_share})
    for seed in range(20):
        generator = np.random.default_rng(seed)
        path = draw_path(settings, draw_bodies(settings, generator), 2.0, generator)
        assert path.times[-1] >= 2.0
        moved = np.linalg.norm(np.diff(path.places, axis=0), axis=1)
        speeds = moved / np.diff(path.times)
        assert speeds.max() <= settings.pusher.speed[1] * (1 + 1e-9)
        times = np.linspace(0, 2.0, 400)
        steps = np.linalg.norm(np.diff([path.at(time) for time in times], axis=0), axis=1) / np.diff(times)
        assert steps.max() < 1.51 * settings.pusher.speed[1]  # the bump's top is 1.5 times its mean


def test_points_lie_evenly_on_the_pusher() -> None:
    pusher = loaded(**{"pusher.num_points": 4000}).pusher
    points, normals = cylinder_surface(pusher.radius, pusher.length, pusher.num_points)
    away, half = np.hypot(points[:, 0], points[:, 1]), pusher.length / 2
    is_side = np.abs(normals[:, 2]) < 0.5
    np.testing.assert_allclose(away[is_side], pusher.radius)
    np.testing.assert_allclose(np.abs(points[~is_side, 2]), half)
    assert away.max() <= pusher.radius * (1 + 1e-9) and np.abs(points[:, 2]).max() <= half * (1 + 1e-9)
    area = pusher.radius / (2 * half + pusher.radius)  # of both caps, as a share of the whole
    assert (~is_side).mean() == pytest.approx(area, abs=0.01)
    assert (points * normals).sum(axis=1).min() > 0
    assert np.abs(points.mean(axis=0)).max() < 0.01 * half


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera_delay": 0.04}, "camera_delay is 0.04; allowed: 0 to less than frame_time"),
        ({"bodies.count_min": 0}, "count_min, count_max"),
        ({"bodies.shapes": ["donut"]}, "bodies.shapes"),
        ({"pusher.speed": [0.5, 0.2]}, "pusher.speed"),
        ({"pusher.task_share": 1.5}, "pusher.task_share"),
        ({"table.thickness": 1.0}, "table.thickness"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_impossible_settings_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(Exception, match=message):
        loaded(**change)
