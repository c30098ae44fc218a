"""The composed configuration of the seven paper experiments, compared with the paper cell by cell.

Everything on the expected side is typed from the paper; nothing is computed.
"""

from typing import Any

import pytest

from vpd_lightning.config import compose

# Appendix, table "Hyperparameters for VPD by dataset". The row r^a_s lacks a separator there: 3.0 and 3.0.
COLUMNS: dict[str, dict[str, Any]] = {
    "MuJoCo": {
        "r_s": 0.1,
        "r_a_s": 0.3,
        "input views": 1,
        "kernel radii": [0.0, 0.05, 0.1, 0.5],
        "kernel bandwidths": [0.05, 0.05, 0.05, 0.5],
        "location scale": 0.1,
        "location noise": 1e-5,
        "near plane": 0.3,
        "far plane": 5.0,
        "workspace min": [-1, -1, -1],
        "workspace max": [1, 1, 1],
    },
    "Deformable": {
        "r_s": 1.0,
        "r_a_s": 3.0,
        "input views": 4,
        "kernel radii": [0.0, 0.5, 1.0, 4.0],
        "kernel bandwidths": [0.5, 0.5, 1.0, 4.0],
        "location scale": 0.5,
        "location noise": 1e-3,
        "near plane": 9.0,
        "far plane": 30,
        "workspace min": [-8, -8, -2],
        "workspace max": [8, 8, 8],
    },
    "Kubric": {
        "r_s": 1.0,
        "r_a_s": 3.0,
        "input views": 9,
        "kernel radii": [0.0, 0.1, 0.4, 2.0],
        "kernel bandwidths": [0.1, 0.2, 0.4, 2.0],
        "location scale": 0.5,
        "location noise": 1e-4,
        "near plane": 0.5,
        "far plane": 15,
        "workspace min": [-10, -10, -10],
        "workspace max": [10, 10, 10],
    },
}
EXPERIMENTS = {
    "mujoco_block": "MuJoCo",
    "deformable_block": "Deformable",
    "deformable_multi": "Deformable",
    "deformable_collision": "Deformable",
    "movi_a": "Kubric",
    "movi_b": "Kubric",
    "movi_c": "Kubric",
}
# Where each row acts: every place of the composed configuration that must hold the cell.
PLACES = {
    "r_s": ["scene.r_s", "dynamics.r_s"],
    "r_a_s": ["scene.r_a_s", "dynamics.r_a_s"],
    "kernel radii": ["scene.kernel_radii", "renderer.kernel_radii"],
    "kernel bandwidths": ["scene.kernel_bandwidths", "renderer.kernel_bandwidths"],
    "location scale": ["scene.location_scale", "dynamics.location_scale"],
    "location noise": ["scene.location_noise", "model.location_noise"],
    "near plane": ["scene.near", "renderer.near"],
    "far plane": ["scene.far", "renderer.far"],
    "workspace min": ["scene.workspace_min", "encoder.workspace_min"],
    "workspace max": ["scene.workspace_max", "encoder.workspace_max"],
}
# Appendix, sections "Architectures" and "Training": the same for all data sets.
TEXT = {
    "encoder._target_": "vpd_lightning.encoder.unet.UNetEncoder",
    "encoder.channels": [64, 128, 256, 512, 512, 256, 128, 64, 16],
    "encoder.num_particles": 2**14,
    "encoder.moving_fraction": None,
    "encoder.background": None,
    "encoder.use_normals": False,
    "encoder.color_features": False,
    "dynamics._target_": "vpd_lightning.dynamics.hierarchical_gnn.HierarchicalGNNDynamics",
    "dynamics.feature_dim": 16,
    "dynamics.hidden_dim": 128,
    "dynamics.message_passing_steps": 10,
    "dynamics.max_abstract_neighbors": 2,
    "renderer._target_": "vpd_lightning.renderer.point_nerf.PointNeRFRenderer",
    "renderer.feature_dim": 16,
    "renderer.num_neighbors": 16,
    "renderer.num_coarse_samples": 128,
    "renderer.num_fine_samples": 256,
    "renderer.net_depth": 8,
    "renderer.net_width": 256,
    "renderer.skip_layer": 4,
    "renderer.net_width_condition": 128,
    "renderer.view_degree": 4,
    "renderer.density_activation": "relu",
    "data.num_steps": 6,
    "data.num_steps_schedule": None,
    "data.rays_per_step": 256,
    "data.batch_size": 16,
    "data.num_trajectories": None,
    "data.target_views": None,
    "data.start_frames": None,
    "data.moving_ray_fraction": 0.0,
    "data.moving_ray_margin": 0,
    "optimizer._target_": "vpd_lightning.training.optimization.StepDecayAdam",
    "optimizer.lr": 3e-4,
    "optimizer.milestones": [100_000, 300_000],
    "optimizer.gamma": pytest.approx(1 / 3, abs=1e-15),
    "trainer.max_steps": 400_000,
    "trainer.gradient_clip_val": None,
    "trainer.precision": "32-true",
}
# Section "Long term video prediction": context frames, and evaluation on held-out trajectories.
PROTOCOL = {"split": "test", "start_frames": [4], "num_steps": 32, "num_trajectories": 16}


def at(config: dict[str, Any], place: str) -> Any:
    for word in place.split("."):
        config = config[word]
    return config


@pytest.fixture(scope="module", params=EXPERIMENTS)
def experiment(request: pytest.FixtureRequest) -> tuple[str, dict[str, Any]]:
    return request.param, compose("train", [f"experiment={request.param}"])


def test_every_cell_of_the_table_stands_in_the_configuration_and_where_it_acts(experiment):
    name, config = experiment
    column = COLUMNS[EXPERIMENTS[name]]

    assert set(PLACES) | {"input views"} == set(column)
    for row, places in PLACES.items():
        for place in places:
            assert at(config, place) == column[row], f"{name}: {place}"
    assert config["scene"]["input_views"] == list(range(column["input views"]))
    assert config["data"]["input_views"] == list(range(column["input views"]))


@pytest.mark.parametrize("place", TEXT)
def test_every_number_of_the_text_stands_in_the_configuration(experiment, place: str):
    _, config = experiment

    assert at(config, place) == TEXT[place]


def test_lengths_of_the_splat_renderer_follow_the_scene(experiment):
    name, _ = experiment
    config = compose("train", [f"experiment={name}", "renderer=splat", "scene.surface_scale=0.7"])

    assert config["renderer"]["surface_scale"] == 0.7
    assert config["renderer"]["near"] == config["scene"]["near"]


def test_evaluation_follows_the_protocol(experiment):
    _, config = experiment

    assert {key: config["protocol"][key] for key in PROTOCOL} == PROTOCOL


def test_experiment_has_its_own_name_and_data(experiment):
    name, config = experiment

    assert config["experiment"] == name
    assert config["data"]["folder"] == f"datasets/{name}"


def test_loss_is_the_pixel_loss_alone(experiment):
    _, config = experiment

    assert config["loss"] == {
        "pixel": {"_target_": "vpd_lightning.losses.pixel.PixelLoss", "weight": 1.0, "coarse_weight": 1.0}
    }


def test_default_trainer_takes_what_is_there_and_the_papers_takes_sixteen_gpus():
    here = compose("train", ["experiment=mujoco_block"])["trainer"]
    paper = compose("train", ["experiment=mujoco_block", "trainer=paper_ddp"])["trainer"]

    assert (here["accelerator"], here["devices"], here["num_nodes"]) == ("auto", "auto", 1)
    assert (paper["accelerator"], paper["devices"], paper["strategy"]) == ("gpu", 16, "ddp")
    assert paper["max_steps"] == 400_000
