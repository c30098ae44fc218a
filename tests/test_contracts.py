"""Every encoder, dynamics, renderer and loss of conf/ keeps its contract; a new file is tested because it is there."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
import yaml

from tests.composed_options import option_section, options
from vpd_lightning.config import build, compose, config_folder
from vpd_lightning.dynamics.base import AbstractDynamics
from vpd_lightning.encoder.base import AbstractEncoder
from vpd_lightning.losses.base import AbstractLoss
from vpd_lightning.renderer.base import AbstractRenderer
from vpd_lightning.testing import (
    FAR,
    FEATURE_DIM,
    IMAGE_SIZE,
    NEAR,
    NUM_VIEWS,
    WORKSPACE_MAX,
    WORKSPACE_MIN,
    DynamicsContract,
    EncoderContract,
    LossContract,
    RendererContract,
)
from vpd_lightning.types import Driven, Particles, SimulatorOutput, VideoBatch

# Any option may hold any of these; where it does, the test takes the small value. All else stays as the file says.
SMALL = {
    "channels": [6, 8, 6, 8, FEATURE_DIM],
    "widths": [4, 4, 8, 8],
    "blocks": [1, 1, 1, 1],
    "num_groups": 2,
    "num_particles": 30,
    "num_views": NUM_VIEWS,
    "height": IMAGE_SIZE,
    "width": IMAGE_SIZE,
    "hidden_dim": 12,
    "message_passing_steps": 2,
    "num_abstract_nodes": 12,
    "net_depth": 3,
    "net_width": 12,
    "skip_layer": 1,
    "net_width_condition": 8,
    "num_coarse_samples": 12,
    "num_fine_samples": 12,
    "background_width": 8,
    "ray_chunk_size": 10,  # fewer than the rays of a check, so that chunks are joined
    "force_scale": 0.03,  # metres: the ball of the checks falls fast enough to bounce
    "initial_depth": 1.4,  # from the cameras of the checks to the middle of the scene
}
SCENE = [
    "scene=demo",
    f"feature_dim={FEATURE_DIM}",
    f"scene.near={NEAR}",
    f"scene.far={FAR}",
    f"scene.workspace_min={list(WORKSPACE_MIN)}",
    f"scene.workspace_max={list(WORKSPACE_MAX)}",
    "data.folder=nowhere",
    "run.folder=nowhere",
]
# InertialDynamics sees the first num_probes and num_matched slots of what may move;
# beyond them the order of particles does matter, so both stay above 20 here.

# What a class cannot satisfy, by its name, so that a new option of the same class needs no entry.
DEPARTURES = {
    "DepthPredictingEncoder": {
        "test_particles_lie_on_what_was_measured": "particles lie where the predicted depth says",
        "test_without_a_measured_pixel_there_is_nothing": "the measured depth is not looked at",
    },
    "GlobalSceneEncoder": {  # its one particle lies at the origin, which is on the floor of the scene of the checks
        "test_without_a_measured_pixel_there_is_nothing": "depth is not looked at",
    },
    "GlobalNeRFRenderer": {
        "test_moving_the_world_and_the_camera_leaves_the_picture_alone": "its network sees absolute places",
        "test_the_picture_shows_the_particles": "the scene is in the features; positions are not looked at",
        "test_the_positions_get_a_finite_gradient": "positions are not looked at",
    },
    "HierarchicalGNNDynamics": {
        "test_order_of_particles_does_not_matter": "abstract nodes are drawn among the slots of the current particles"
    },
    "SleepingDynamics": {
        "test_order_of_particles_does_not_matter": "it wraps the graph network, whose abstract nodes are drawn so"
    },
}
NEEDS_OBSERVATIONS = {"InertialDynamics"}


GROUPS = ("encoder", "dynamics", "renderer")


@cache
def composed(group: str, option: str) -> Any:
    if group in GROUPS:
        return option_section(group, option, GROUPS, SCENE)
    return compose("train", [f"{group}={option}", *SCENE])[group]


def own_entries(loss: str) -> list[str]:
    """Return the losses that an option's own file holds, without composing it while tests are collected."""
    return [key for key in yaml.safe_load((config_folder() / "loss" / f"{loss}.yaml").read_text()) if key != "defaults"]


def small(section: Any) -> Any:
    if isinstance(section, Mapping):
        return {key: SMALL[key] if key in SMALL else small(value) for key, value in section.items()}
    return section


class ChosenOption:
    """Builds the option that a test is parametrised with."""

    group: str
    base: type

    def choose(self, option: str) -> None:
        self.section = small(composed(self.group, option))
        self.class_name = self.section.get("_target_", "").rpartition(".")[2]
        self.departures = DEPARTURES.get(self.class_name, {})

    def build(self) -> Any:
        return build(self.section, self.base, self.group)


class TestEncoders(ChosenOption, EncoderContract):
    group, base = "encoder", AbstractEncoder

    @pytest.fixture(params=options("encoder"), autouse=True)
    def _option(self, request: pytest.FixtureRequest) -> None:
        self.choose(request.param)


class TestDynamics(ChosenOption, DynamicsContract):
    group, base = "dynamics", AbstractDynamics

    @pytest.fixture(params=options("dynamics"), autouse=True)
    def _option(self, request: pytest.FixtureRequest) -> None:
        self.choose(request.param)
        self.needs_observations = self.class_name in NEEDS_OBSERVATIONS

    def particles(self, *sizes: int, **named: int) -> tuple[Particles, Particles]:
        """Return particles whose balls strike the floor where a dynamics has weights that only an impact reaches."""
        previous, current = super().particles(*sizes, **named)
        if self.class_name not in NEEDS_OBSERVATIONS:
            return previous, current
        return _lowered(previous), _lowered(current)


def _lowered(particles: Particles) -> Particles:
    assert particles.moving is not None
    fall = 0.12 * particles.moving[..., None] * torch.tensor([0.0, 0.0, 1.0]).to(particles.positions)
    return replace(particles, positions=particles.positions - fall)


class TestDynamicsWithActions(TestDynamics):
    """With something driven beside the ball, moving into it, every dynamics keeps its contract."""

    @pytest.fixture(params=options("dynamics"), autouse=True)
    def _option(self, request: pytest.FixtureRequest) -> None:
        self.section = small(option_section("dynamics", request.param, GROUPS, [*SCENE, "actions=true"]))
        self.class_name = self.section["_target_"].rpartition(".")[2]
        self.departures = DEPARTURES.get(self.class_name, {})
        self.needs_observations = self.class_name in NEEDS_OBSERVATIONS

    def particles(self, *sizes: int, **named: int) -> tuple[Particles, Particles]:
        """Return particles whose balls a driven ball is about to push."""
        previous, current = super().particles(*sizes, **named)
        return previous, replace(current, driven=_beside(current))


def _beside(particles: Particles) -> Driven:
    """A small ball of points at the side of each member's ball, and where it goes: towards its middle."""
    assert particles.moving is not None and particles.normals is not None
    share = particles.moving[..., None].to(particles.positions)
    middle = (share * particles.positions).sum(dim=1, keepdim=True) / share.sum(dim=1, keepdim=True).clamp(min=1)
    index = torch.arange(24).to(particles.positions)
    height, angle = 1 - 2 * (index + 0.5) / 24, index * torch.pi * (3 - 5**0.5)
    ring = (1 - height.square()).sqrt()
    normals = torch.stack([ring * angle.cos(), ring * angle.sin(), height], dim=-1).expand(len(middle), -1, -1)
    places = middle + 0.03 * normals + middle.new_tensor([0.2, 0.0, 0.0])
    step = middle.new_tensor([-0.06, 0.0, 0.0])
    groups = torch.zeros(places.shape[:2], dtype=torch.int64, device=places.device)
    return Driven(places, normals, groups, next_positions=places + step, next_normals=normals)


class TestPaperDynamicsWithoutDraws(TestDynamics):
    """With as many abstract nodes as particles nothing is drawn, and the paper's network departs from nothing."""

    @pytest.fixture(params=[name for name in options("dynamics") if name.startswith("hierarchical_gnn")], autouse=True)
    def _option(self, request: pytest.FixtureRequest) -> None:
        self.choose(request.param)
        self.section["num_abstract_nodes"] = 64
        self.departures = {}
        self.needs_observations = self.class_name in NEEDS_OBSERVATIONS


class TestRenderers(ChosenOption, RendererContract):
    group, base = "renderer", AbstractRenderer

    @pytest.fixture(params=options("renderer"), autouse=True)
    def _option(self, request: pytest.FixtureRequest) -> None:
        self.choose(request.param)


class TestLosses(ChosenOption, LossContract):
    group, base = "loss", AbstractLoss

    # An option may hold several losses; those it has from another are tested there.
    @pytest.fixture(params=[f"{name}.{entry}" for name in options("loss") for entry in own_entries(name)], autouse=True)
    def _option(self, request: pytest.FixtureRequest) -> None:
        option, _, entry = request.param.partition(".")
        self.choose(option)
        self.section = self.section[entry]

    def output(self, batch: VideoBatch) -> SimulatorOutput:
        """Return an output that also has what a loss may ask a stage for."""
        made = super().output(batch)
        draw = {"generator": torch.Generator().manual_seed(7), "dtype": torch.float64}
        shape = made.states[0].positions.shape[:1] + (len(made.states),)
        names = ("predicted_features", "target_features", "predicted_slots", "target_slots")
        auxiliary = {name: torch.rand(*shape, 5, 4, **draw) for name in names}
        auxiliary["point_mass"] = torch.rand(*shape, 5, **draw)
        for name in ("future_positions", "future_colors"):
            auxiliary[name] = torch.rand(*shape, 7, 3, **draw) - 0.5
        auxiliary["future_mask"] = torch.rand(*shape, 7, **draw) < 0.7
        auxiliary["predicted_depth"] = 1 + torch.rand(batch.context.depth[:, 1].shape, **draw)
        return replace(
            made,
            auxiliary={
                name: value.to(batch.rgbs) if value.is_floating_point() else value.to(batch.rgbs.device)
                for name, value in auxiliary.items()
            },
        )
