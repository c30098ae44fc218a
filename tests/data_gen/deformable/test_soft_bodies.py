import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_gen.deformable import Settings
from data_gen.deformable.drop import draw_drop
from data_gen.deformable.model import vertex_masses
from data_gen.deformable.scene import prepare
from data_gen.deformable.soft_bodies import SimulationFailedError, fit_rigid_motion
from data_gen.deformable.tetrahedra import mesh, signed_volumes
from data_gen.settings import load_settings
from tests.data_gen.deformable.no_pictures import blind_scene
from vpd_lightning.data import schema
from vpd_lightning.errors import DataError

GRAVITY = 9.81  # m/s2, MuJoCo's default
NO_PICTURES = {"camera.height": 8, "camera.width": 8}
SMALL = {**NO_PICTURES, "num_frames": 6, "splits.train": 1}


def random_body() -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(0)
    return generator.normal(size=(40, 3)), generator.uniform(0.1, 1.0, 40)


def test_fit_recovers_a_rigid_motion():
    rest, masses = random_body()
    rotation = Rotation.from_rotvec([0.3, -2.0, 1.1])
    spin, drift = np.array([0.5, -1.0, 2.0]), np.array([3.0, 0.2, -1.0])
    points = rotation.apply(rest) + [4.0, 5.0, 6.0]
    center = masses @ points / masses.sum()
    velocities = drift + np.cross(spin, points - center)

    position, quaternion, linear, angular = fit_rigid_motion(rest, points, velocities, masses)

    np.testing.assert_allclose(position, center, atol=1e-12)
    turned = Rotation.from_quat(quaternion, scalar_first=True)
    assert (turned.inv() * rotation).magnitude() < 1e-12
    np.testing.assert_allclose(linear, drift, atol=1e-12)
    np.testing.assert_allclose(angular, spin, atol=1e-12)


def test_fit_never_mirrors_and_keeps_the_angular_momentum():
    """A body that is squashed through itself still gets a proper rotation."""
    rest, masses = random_body()
    generator = np.random.default_rng(1)
    points, velocities = rest * [1.0, 1.2, -0.2], generator.normal(size=rest.shape)

    position, quaternion, linear, angular = fit_rigid_motion(rest, points, velocities, masses)

    assert np.linalg.norm(quaternion) == pytest.approx(1.0)
    momentum = carried = np.zeros(3)
    for mass, point, velocity in zip(masses, points, velocities, strict=True):
        arm = point - position
        momentum = momentum + mass * np.cross(arm, velocity - linear)
        carried = carried + mass * np.cross(arm, np.cross(angular, arm))
    np.testing.assert_allclose(carried, momentum, atol=1e-10)


def test_masses_are_those_of_the_volume():
    """Total mass and centre of mass of a homogeneous solid (MuJoCo alone would give all vertices the same mass)."""
    settings = load_settings(Settings, "deformable_multi", "paper", {"bodies.shapes": ["duck"]})
    body = mesh("duck", settings.bodies.spacing)
    masses = vertex_masses(body, settings.bodies.density)
    centers = body.vertices[body.tetrahedra].mean(axis=1)
    model, _, _ = prepare(settings, draw_drop(settings, 0, "train", 0))

    assert masses.sum() == pytest.approx(settings.bodies.density * body.volumes.sum(), rel=1e-12)
    np.testing.assert_allclose(masses @ body.vertices / masses.sum(), body.volumes @ centers / body.volumes.sum())
    np.testing.assert_allclose(model.body_mass[model.flex_vertbodyid], masses, rtol=1e-12)


def test_bodies_fall_freely_and_unchanged_before_they_land(monkeypatch: pytest.MonkeyPatch):
    overrides = {**SMALL, "drop.gap_min": 1.0}  # in the air for 0.44 s; six frames are 0.2 s
    settings = load_settings(Settings, "deformable_collision", "paper", overrides)
    state = blind_scene(settings, monkeypatch).trajectory(0, "train", 0, "").state
    assert state is not None
    time = settings.frame_time * np.arange(settings.num_frames)[:, None]

    # The integrator adds gravity before it moves: half a step more than the parabola.
    fallen = 0.5 * GRAVITY * time * (time + settings.timestep)
    height = state[schema.STATE_POSITIONS][:, :, 2]
    np.testing.assert_allclose(height, height[0] - fallen, atol=1e-4)
    np.testing.assert_allclose(state[schema.STATE_LINEAR_VELOCITIES][:, :, 2], -GRAVITY * time + [0, 0], atol=1e-3)
    quaternions = state[schema.STATE_QUATERNIONS]
    np.testing.assert_allclose(quaternions, np.broadcast_to(quaternions[0], quaternions.shape), atol=1e-4)
    assert np.abs(state[schema.STATE_ANGULAR_VELOCITIES]).max() < 1e-2


def test_state_describes_the_drawn_bodies(monkeypatch: pytest.MonkeyPatch):
    settings = load_settings(Settings, "deformable_collision", "paper", SMALL)
    trajectory = blind_scene(settings, monkeypatch).trajectory(0, "train", 0, "")
    drop, state = draw_drop(settings, 0, "train", 0), trajectory.state
    assert state is not None
    vertices, objects = state[schema.STATE_VERTICES], state[schema.STATE_VERTEX_OBJECTS]
    tetrahedra = state[schema.STATE_TETRAHEDRA]

    assert trajectory.attributes["objects"] == ",".join(drop.shapes) and trajectory.attributes["attempt"] == 0
    assert (vertices.dtype, objects.dtype, tetrahedra.dtype) == (np.float32, np.int32, np.int32)
    assert (objects[tetrahedra] == objects[tetrahedra[:, :1]]).all()
    for body in range(2):
        rest = drop.meshes[body].vertices
        np.testing.assert_allclose(vertices[0, objects == body], drop.vertices[body], atol=1e-6)
        masses = vertex_masses(drop.meshes[body], 1.0)
        around = abs(rest - masses @ rest / masses.sum()).max(axis=0)
        np.testing.assert_allclose(state[schema.STATE_HALF_SIZES][body], around)
        turn = Rotation.from_quat(state[schema.STATE_QUATERNIONS][0, body], scalar_first=True)
        placed = turn.apply(rest - masses @ rest / masses.sum()) + state[schema.STATE_POSITIONS][0, body]
        np.testing.assert_allclose(placed, drop.vertices[body], atol=1e-9)
    assert (signed_volumes(vertices[0].astype(float), tetrahedra) > 0).all()


def test_same_seed_gives_the_same_motion(monkeypatch: pytest.MonkeyPatch):
    settings = load_settings(Settings, "deformable_collision", "tiny", NO_PICTURES)
    first, again = (blind_scene(settings, monkeypatch).trajectory(7, "test", 1, "").state for _ in range(2))
    assert first is not None and again is not None

    for name, values in first.items():
        assert (values == again[name]).all(), name


def test_bodies_land_and_collide_in_the_tiny_sets(monkeypatch: pytest.MonkeyPatch):
    for scene, index in (("deformable_block", 0), ("deformable_multi", 1), ("deformable_collision", 0)):
        settings = load_settings(Settings, scene, "tiny", NO_PICTURES)
        state = blind_scene(settings, monkeypatch).trajectory(0, "train", index, "").state
        assert state is not None
        vertices = state[schema.STATE_VERTICES][:, state[schema.STATE_VERTEX_OBJECTS] == 0]
        last = state[schema.STATE_VERTICES][:, state[schema.STATE_VERTEX_OBJECTS] == settings.bodies.count - 1]
        assert vertices[0, :, 2].min() > 0.1 and vertices[-2, :, 2].min() < 0.1
        assert np.ptp(last[:, :, 2], axis=1).min() < 0.95 * np.ptp(last[0, :, 2])  # it was squashed


def test_failed_simulations_are_noticed_and_told(monkeypatch: pytest.MonkeyPatch):
    """What falls for 0.9 s is faster than 1 m/s, whichever of the three initial states is taken."""
    changes = {**NO_PICTURES, "drop.max_speed": 1.0, "drop.max_attempts": 3}
    settings = load_settings(Settings, "deformable_block", "tiny", changes)

    with pytest.raises(DataError, match=r"train trajectory 0 failed 3 times .frame 3: the fastest vertex has 1.18 m/s"):
        blind_scene(settings, monkeypatch).trajectory(0, "train", 0, "")


def test_second_attempt_is_kept_and_noted(monkeypatch: pytest.MonkeyPatch):
    settings = load_settings(Settings, "deformable_block", "tiny", NO_PICTURES)
    scene = blind_scene(settings, monkeypatch)
    original = scene._attempt

    def first_fails(attempt: int, *rest: object) -> schema.Trajectory:
        if attempt == 0:
            raise SimulationFailedError("once")
        return original(attempt, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(scene, "_attempt", first_fails)
    trajectory = scene.trajectory(0, "train", 0, "")
    assert trajectory.state is not None

    assert trajectory.attributes["attempt"] == 1
    expected = draw_drop(settings, 0, "train", 0, attempt=1).vertices[0]
    np.testing.assert_allclose(trajectory.state[schema.STATE_VERTICES][0], expected, atol=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_coordinates_that_are_not_finite_are_noticed(bad: float):
    settings = load_settings(Settings, "deformable_block", "tiny", SMALL)
    _, data, bodies = prepare(settings, draw_drop(settings, 0, "train", 0))
    data.qpos[5] = bad

    with pytest.raises(SimulationFailedError, match="frame 0"):
        bodies.observe(0)
