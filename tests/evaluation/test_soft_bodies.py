"""Soft bodies have no rigid pose: their own particles, their true motion, and what is not said of them."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from tests.evaluation.soft_ball import RADIUS, SoftScene, write_soft_ball
from tests.evaluation.tossed_box import NUM_FRAMES, clip_penetration
from vpd_lightning.data.clip import Clip, read_clip
from vpd_lightning.data.ground_truth import read_positions, read_state
from vpd_lightning.errors import DataError
from vpd_lightning.evaluation.bodies import find_bodies
from vpd_lightning.evaluation.motion import clip_motion

START, MARGIN = 1, 0.02
FIRST = START + 1  # the last input frame


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SoftScene:
    return write_soft_ball(tmp_path_factory.mktemp("soft") / "000000.h5")


@pytest.fixture
def clip(scene: SoftScene) -> Clip:
    return read_clip(scene.path, 0, START, 5)


def prediction(scene: SoftScene, num_floor: int = 30) -> torch.Tensor:
    """The soft body's material points, perfectly predicted (time, particle, 3), and a few points far from it."""
    body = scene.surface[FIRST:]
    floor = torch.tensor([-0.8, -0.8, -0.5], dtype=torch.float64).expand(len(body), num_floor, 3)
    return torch.cat([body, floor], dim=1)


def test_particles_of_a_soft_body_are_those_at_its_surface(scene: SoftScene, clip: Clip) -> None:
    positions, num_body = prediction(scene)[0].clone(), scene.surface.shape[1]
    outwards = positions[:num_body] - scene.surface[FIRST].mean(0)
    outwards /= outwards.norm(dim=-1, keepdim=True)
    positions[:num_body:2] += 0.01 * outwards[::2]
    positions[1:num_body:2] += 0.05 * outwards[1::2]
    box, soft = find_bodies(clip, positions, MARGIN, 5)
    assert not box.is_soft and soft.is_soft
    assert soft.mask[:num_body:2].all() and not soft.mask[1:num_body:2].any() and not soft.mask[num_body:].any()


def test_a_perfect_prediction_of_a_soft_body_has_no_error(scene: SoftScene, clip: Clip) -> None:
    motion, masks = clip_motion(clip, prediction(scene)[: 1 + 5], MARGIN, None)
    assert masks[1].sum() == scene.surface.shape[1]
    for name in ("centroid_error", "particle_error", "body_chamfer", "height_error", "velocity_error"):
        assert motion[name][1].max() < 1e-6, name  # vertices are stored in float32
    assert motion["centroid_error_copy"][1, -1] > 0.1
    for name in ("rigidity_error", "size_ratio", "orientation_error"):
        assert motion[name][1].isnan().all(), f"{name} says nothing of a body that changes its shape"


def test_a_rigid_guess_of_a_soft_body_is_wrong_by_the_deformation(scene: SoftScene, clip: Clip) -> None:
    start = prediction(scene)[0]
    center = scene.surface[FIRST:].mean(1, keepdim=True)
    num_body = scene.surface.shape[1]
    rigid = start.repeat(6, 1, 1)
    rigid[:, :num_body] += (center - center[:1])[:6]
    motion, _ = clip_motion(clip, rigid, MARGIN, None)
    assert motion["centroid_error"][1].max() < 1e-6
    assert motion["body_chamfer"][1, -1] > 0.02 and motion["particle_error"][1, -1] > 0.1


def test_distance_to_the_surface_is_a_shift_along_its_normal(scene: SoftScene, clip: Clip) -> None:
    pred = prediction(scene)[:6].clone()
    center = scene.surface[FIRST:][1:6].mean(1, keepdim=True)
    pred[1:, : scene.surface.shape[1]] = center  # all in the middle: a radius away, less what is squashed
    motion, _ = clip_motion(clip, pred, MARGIN, None)
    assert 0.5 * RADIUS < motion["body_chamfer"][1, 0] < RADIUS
    assert motion["centroid_error"][1].max() < 0.02


def test_steps_behind_the_recording_have_no_error(scene: SoftScene, clip: Clip) -> None:
    positions = prediction(scene)
    longer = torch.cat([positions, positions[-1:].repeat(3, 1, 1)])
    motion, _ = clip_motion(clip, longer, MARGIN, None)
    known = NUM_FRAMES - 1 - FIRST
    for name in ("centroid_error", "body_chamfer"):
        assert motion[name][1, :known].isfinite().all() and motion[name][1, known:].isnan().all()


def test_soft_bodies_have_no_box_to_penetrate(scene: SoftScene, clip: Clip) -> None:
    positions = prediction(scene)[:6]
    bodies = find_bodies(clip, positions[0], MARGIN, 5)
    into_box = positions.clone()
    into_box[1:, : scene.surface.shape[1]] = clip.poses(5)[1:, :1, :3]  # the middle of the rigid box
    depths = clip_penetration(clip, bodies, into_box)
    np.testing.assert_allclose(depths["bodies"][1].numpy(), 0.15, atol=1e-9)  # the box's smallest half size
    assert depths["bodies"][0].isnan().all(), "nothing shows the box here"


def test_a_rigid_scene_has_no_vertices_and_a_soft_one_all_of_them(scene: SoftScene, test_paths: list[Path]) -> None:
    assert read_state(test_paths[0]).vertices is None
    state = read_state(scene.path)
    assert state.vertices is not None and state.vertices.shape == (NUM_FRAMES, 81, 3)
    positions = read_positions(scene.path)
    assert positions is not None and np.array_equal(positions, state.positions)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("tetrahedra", None, "only a part"),
        ("tetrahedra", np.full((2, 4), 81, np.int32), "do not fit"),
        ("vertex_objects", np.full(81, 2, np.int32), "do not fit"),
        ("vertices", np.zeros((NUM_FRAMES - 1, 81, 3), np.float32), "do not fit"),
    ],
)
def test_vertices_that_fit_nothing_are_refused(
    scene: SoftScene, tmp_path: Path, name: str, value: np.ndarray | None, message: str
) -> None:
    path = tmp_path / "broken.h5"
    path.write_bytes(scene.path.read_bytes())
    with h5py.File(path, "r+") as file:
        del file["state"][name]
        if value is not None:
            file["state"][name] = value
    with pytest.raises(DataError, match=message):
        read_state(path)


def test_without_vertices_the_same_body_counts_as_rigid(scene: SoftScene, clip: Clip) -> None:
    assert clip.state is not None
    rigid = replace(clip, state=replace(clip.state, vertices=None, vertex_objects=None, tetrahedra=None))
    assert not any(body.is_soft for body in find_bodies(rigid, prediction(scene)[0], MARGIN, 5))
