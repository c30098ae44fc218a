"""Penetration of predicted particles: where the floor is, and what is in other bodies."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.evaluation.conftest import protocol_with
from tests.evaluation.tossed_box import FLOOR_HEIGHT, HALF_SIZE, Oracle, clip_penetration
from vpd_lightning.data.clip import Clip, read_clip
from vpd_lightning.data.manifest import Manifest
from vpd_lightning.evaluation.bodies import Body, find_bodies
from vpd_lightning.evaluation.evaluate import evaluate
from vpd_lightning.evaluation.penetration import floor_height
from vpd_lightning.evaluation.report import metrics_of
from vpd_lightning.simulator import Scene
from vpd_lightning.types import Particles


class Sinking(Oracle):
    """An oracle whose particles sink by 20 cm a step."""

    def rollout(self, scene: Scene, num_steps: int) -> list[Particles]:
        down = torch.tensor([0.0, 0.0, -0.2])
        states = super().rollout(scene, num_steps)
        return [replace(s, positions=s.positions + (i + 1) * down) for i, s in enumerate(states)]


@pytest.fixture
def clip(test_paths: list[Path]) -> Clip:
    return read_clip(test_paths[0], 0, 0, 4)


def test_the_floor_is_where_static_pixels_are_lowest(clip: Clip) -> None:
    assert floor_height(clip) == pytest.approx(FLOOR_HEIGHT, abs=1e-6)
    depth = clip.depth.clone()
    depth[-1, 0, 5, :3] = 3.9  # a few wrong depths
    assert floor_height(replace(clip, depth=depth)) == pytest.approx(FLOOR_HEIGHT, abs=1e-3)


def test_without_a_floor_in_sight_there_is_no_height(clip: Clip) -> None:
    assert np.isnan(floor_height(replace(clip, depth=torch.zeros_like(clip.depth))))
    assert np.isnan(floor_height(replace(clip, workspace_min=(-1.0, -1.0, -0.4))))


def test_a_body_that_sinks_is_measured_from_its_deepest_particle(manifest: Manifest, test_paths: list[Path]) -> None:
    protocol = protocol_with(num_trajectories=1, start_frames=(0,), num_long_steps=0)
    evaluation = evaluate(Sinking(test_paths), manifest, protocol, [0])
    lowest = evaluation.motion["lowest_point"][0, 0]
    expected = np.maximum(FLOOR_HEIGHT - lowest, 0)
    assert expected[-1] > 0.3
    np.testing.assert_allclose(evaluation.blocks["penetration"]["mean"][0, 0], expected, atol=1e-6)
    penetration = metrics_of(evaluation, protocol, {})["penetration"]
    assert penetration["mean"] == penetration["floor"] == pytest.approx(expected.mean(), abs=1e-6)
    assert penetration["bodies"] is None, "there is no other body"
    assert penetration["true_motion"] < 1e-6 < penetration["mean"]


def two_boxes(clip: Clip) -> Clip:
    """The same clip with a second box beside the first, 0.6 m along x, which stays beside it."""
    state = clip.state
    assert state is not None
    beside = state.positions + [0.6, 0.0, 0.0]
    both = replace(
        state,
        positions=np.concatenate([state.positions, beside], axis=1),
        quaternions=np.tile([1.0, 0.0, 0.0, 0.0], (len(beside), 2, 1)),
        half_sizes=np.repeat(state.half_sizes, 2, axis=0),
    )
    return replace(clip, state=both)


def particles_of(clip: Clip, number: int) -> torch.Tensor:
    """Ten particles on the +x face of a box, (10, 3), near its middle."""
    center = clip.poses(0)[0, number, :3]
    offset = torch.zeros(10, 3, dtype=torch.float64)
    offset[:, 0], offset[:, 1] = HALF_SIZE[0, 0], torch.linspace(-0.05, 0.05, 10)
    return center + offset


def test_particles_in_another_bodys_true_box_are_measured_to_its_nearest_face(clip: Clip) -> None:
    clip = two_boxes(clip)
    start = particles_of(clip, 0)
    bodies = find_bodies(clip, start, 0.02, 4)
    assert bodies[0].mask.all() and not bodies[1].mask.any()
    moved = bodies[0].true.clone()
    moved[1:, :, 0] += torch.tensor([0.0, 0.1, 0.15, 0.3])[:, None]  # the other box begins 0.1 m away
    depths = clip_penetration(clip, bodies, moved)
    np.testing.assert_allclose(depths["bodies"][0].numpy(), [0.0, 0.0, 0.05, 0.15], atol=1e-6)  # 0.15: a half size
    np.testing.assert_allclose(depths["mean"][0].numpy(), depths["bodies"][0].numpy())
    assert (depths["true_motion"][0] == 0).all()
    assert depths["mean"][1].isnan().all(), "nothing shows the second box"


def test_what_two_boxes_share_from_the_start_is_no_penetration(clip: Clip) -> None:
    clip = two_boxes(clip)
    start = particles_of(clip, 0)
    shared = Body(torch.ones(10, dtype=torch.bool), start.expand(5, -1, -1), None, start)
    depths = clip_penetration(clip, [shared, shared], start.expand(5, -1, -1))
    assert (depths["bodies"] == 0).all()


def test_what_is_not_finite_or_behind_the_recording_has_no_depth(clip: Clip) -> None:
    clip = two_boxes(clip)
    bodies = find_bodies(clip, particles_of(clip, 0), 0.02, 20)
    positions = particles_of(clip, 0).repeat(21, 1, 1)
    positions[2] = torch.nan
    depths = clip_penetration(clip, bodies, positions)
    assert depths["mean"][0].isnan().nonzero().flatten().tolist() == [1]
    assert depths["bodies"][0].isfinite().sum() == 7 and depths["true_motion"][0].isfinite().sum() == 8
