import torch

from docs.results.studies.first_velocity import FOLDERS, SCENES, VARIANTS, _carried, simulator_for
from tests.dynamics.test_rigid_motion import rotation_about
from vpd_lightning.config import compose
from vpd_lightning.dynamics.inertial import InertialDynamics


def test_a_point_is_carried_as_the_particles_around_it_move():
    generator = torch.Generator().manual_seed(0)
    after = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    turn, shift = rotation_about([1, 2, 3], 0.3), torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)
    before = (after - shift) @ turn
    point = torch.tensor([0.5, 0.1, -0.4], dtype=torch.float64)

    carried = _carried(point, after, after - before)

    assert torch.allclose(carried, point - (point - shift) @ turn, atol=1e-5)  # but for the ridge of the fit


def test_every_scene_is_an_experiment_with_a_data_set():
    for scene in SCENES:
        # The demo has its data set by itself, the others with the budget of their small one.
        budget = [] if scene in FOLDERS else ["budget=minutes"]
        config = compose("train", ["run.folder=unused", *budget, f"experiment={scene}", "model=inertial"])
        assert config["data"]["folder"] == f"datasets/{FOLDERS.get(scene, f'{scene}_small')}"


def test_variants_change_what_they_name():
    for variant, settings in VARIANTS.items():
        dynamics = simulator_for("mujoco_block", variant).dynamics
        assert isinstance(dynamics, InertialDynamics) and dynamics.first_velocity is not None
        for name, value in settings.items():
            assert getattr(dynamics.first_velocity, name) == value
        assert (dynamics.grouping["num_bodies"] == 1) == (variant == "one body")
