from itertools import permutations

import mujoco
import numpy as np
import pytest

from tests.data_gen.movi.throws import thrown
from vpd_lightning.errors import ConfigError

SCENES = ("movi_a", "movi_b", "movi_c")
NUM = 6  # trajectories a scene


@pytest.mark.parametrize("scene", SCENES)
def test_objects_start_apart_in_the_region_and_fly_to_the_middle(scene: str):
    for index in range(NUM):
        throw = thrown(scene, index)
        region, data = throw.settings.throw, throw.data
        for one, other in permutations(range(len(throw.objects)), 2):
            rotation, position = data.xmat[1 + other].reshape(3, 3), data.xpos[1 + other]
            local = (throw.corners(one) - position) @ rotation
            # No vertex of the one inside a convex part of the other.
            assert min(part.distance(local).min() for part in throw.objects[other].item.parts) > -1e-6
        for number in range(len(throw.objects)):
            corners = throw.corners(number)
            low, high = corners.min(axis=0), corners.max(axis=0)
            fits = high - low <= np.subtract(region.region_max, region.region_min)
            assert (low >= np.asarray(region.region_min) - 1e-9)[fits].all()
            assert (high <= np.asarray(region.region_max) + 1e-9)[fits].all()
            assert low[2] > 0
            velocity = data.qvel[6 * number : 6 * number + 6]
            assert (np.abs(velocity[:2] + data.qpos[7 * number : 7 * number + 2]) <= 4.0).all()
            np.testing.assert_array_equal(velocity[2:], 0.0)


@pytest.mark.parametrize("scene", SCENES)
def test_objects_never_gain_energy_nor_sink_into_the_floor(scene: str):
    """Restitution below one and friction take energy; 2 % is what springs and discrete time may give back."""
    for index in range(NUM // 2):
        throw = thrown(scene, index)
        masses = throw.model.body_mass[1:]
        inertias = throw.model.body_inertia[1:]
        start = None
        for _ in range(0, throw.settings.num_frames, 2):
            mujoco.mj_forward(throw.model, throw.data)
            velocity = np.empty(6)
            energy = 0.0
            for number in range(len(throw.objects)):
                mujoco.mj_objectVelocity(
                    throw.model, throw.data, mujoco.mjtObj.mjOBJ_BODY, 1 + number, velocity, True
                )  # in the principal axes: angular, then linear
                energy += 0.5 * (inertias[number] @ velocity[:3] ** 2 + masses[number] * velocity[3:] @ velocity[3:])
                energy += masses[number] * 10.0 * throw.data.xipos[1 + number, 2]
                assert throw.corners(number)[:, 2].min() > -0.03  # contacts are springs: 2 cm at 9 m/s
            start = energy if start is None else start
            assert energy <= 1.02 * start
            mujoco.mj_step(throw.model, throw.data, 2 * throw.settings.substeps)
        assert np.isfinite(throw.data.qpos).all()


def test_sizes_and_masses_are_kubrics():
    """Density 2.7 (metal) or 1.1 (rubber) times the volume; the longest side is one of two sizes."""
    seen = set()
    for index in range(12):
        throw = thrown("movi_a", index)
        for number, thing in enumerate(throw.objects):
            size, density = thing.size, {"metal": 2.7, "rubber": 1.1}[thing.material.name]
            assert size in (0.7, 1.4)
            volume = {"cube": 1.0, "sphere": np.pi / 6, "cylinder": np.pi / 4}[thing.item.name] * size**3
            assert throw.model.body_mass[1 + number] == pytest.approx(density * volume, rel=1e-6)
            assert thing.mass == pytest.approx(density * volume, rel=1e-6)
            np.testing.assert_allclose(thing.item.half_sizes, size / 2, rtol=1e-9)
            if thing.item.name == "cube":
                np.testing.assert_allclose(throw.model.body_inertia[1 + number], thing.mass * size**2 / 6, rtol=1e-6)
            if thing.item.name == "sphere":
                np.testing.assert_allclose(throw.model.body_inertia[1 + number], 0.1 * thing.mass * size**2, rtol=1e-6)
            seen.add((thing.item.name, size, thing.material.name))
    assert len(seen) >= 9  # of twelve


@pytest.mark.parametrize("scene", ["movi_b", "movi_c"])
def test_sizes_lie_between_the_bounds_and_bodies_turn_about_their_centre_of_mass(scene: str):
    for index in range(NUM):
        throw = thrown(scene, index)
        low, high = throw.settings.objects.sizes
        for number, thing in enumerate(throw.objects):
            assert low <= thing.size <= high
            assert thing.item.mesh.extents.max() == pytest.approx(thing.size)
            np.testing.assert_allclose(throw.model.body_ipos[1 + number], 0.0, atol=1e-9)
            corners = np.abs(thing.item.mesh.vertices)
            np.testing.assert_allclose(thing.item.half_sizes, corners.max(axis=0))


def test_every_pair_of_bodies_and_the_floor_has_a_contact_of_its_own():
    throw = thrown("movi_b", 0, **{"objects.shapes": ["torus", "gear", "cube"]})
    counts = [len(thing.item.parts) for thing in throw.objects]
    pairs = sum(counts) + counts[0] * counts[1] + counts[0] * counts[2] + counts[1] * counts[2]
    assert throw.model.npair == pairs
    assert (throw.model.geom_contype == 0).all()  # nothing collides but by a pair
    floor = throw.model.geom("floor").id
    for pair in range(throw.model.npair):
        if throw.model.pair_geom1[pair] == floor or throw.model.pair_geom2[pair] == floor:
            geom = (
                throw.model.pair_geom2[pair] if throw.model.pair_geom1[pair] == floor else throw.model.pair_geom1[pair]
            )
            material = throw.objects[throw.model.geom_bodyid[geom] - 1].material
            np.testing.assert_allclose(throw.model.pair_friction[pair, :2], 0.3 * material.friction)


def test_state_depends_on_the_index_alone():
    first, again, other = (thrown("movi_c", index) for index in (3, 3, 4))
    names = [[thing.item.name for thing in throw.objects] for throw in (first, again, other)]
    one, two, three = first.simulate(), again.simulate(), other.simulate()

    assert names[0] == names[1] != names[2]
    np.testing.assert_array_equal(one.positions, two.positions)
    np.testing.assert_array_equal(one.quaternions, two.quaternions)
    assert np.abs(one.positions - three.positions).min() > 0


def test_a_crowd_that_finds_no_room_is_refused():
    with pytest.raises(ConfigError, match=r"No room for 9 objects.*throw\.region_min"):
        thrown("movi_a", 0, **{"objects.count": 9, "objects.sizes": [3.0], "throw.max_trials": 3})
