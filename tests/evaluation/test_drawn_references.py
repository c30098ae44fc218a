"""Other motions drawn by the model's renderer: where particles and normals go, and what is reported of them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.evaluation.conftest import protocol_with
from tests.evaluation.tossed_box import HALF_SIZE, Oracle
from vpd_lightning.data.clip import Clip, read_clip
from vpd_lightning.data.manifest import Manifest
from vpd_lightning.evaluation.drawn_references import drawn_references
from vpd_lightning.evaluation.evaluate import evaluate
from vpd_lightning.evaluation.gallery import write_gallery
from vpd_lightning.evaluation.protocol import Protocol
from vpd_lightning.evaluation.report import metrics_of, step_table, write_metrics
from vpd_lightning.evaluation.summary import summary_lines
from vpd_lightning.metrics.registry import DRAWN
from vpd_lightning.metrics.rigid_motion import inside_box
from vpd_lightning.types import Cameras, HiddenSide, Particles

NUM_STEPS = 4


class Recorder(Oracle):
    """An oracle that keeps the states which it renders."""

    def render(self, states: Sequence[Particles], cameras: Cameras) -> torch.Tensor:
        self.seen = [*getattr(self, "seen", []), list(states)]
        return super().render(states, cameras)


def _drawn(paths: list[Path]) -> tuple[Recorder, Clip, Particles, list[list[Particles]]]:
    oracle = Recorder(paths)
    clip = read_clip(paths[0], 0, 2, NUM_STEPS)
    scene = oracle.encode(clip.rgb[:, [0]], clip.depth[:, [0]], clip.cameras[:, [0]])
    upwards = torch.zeros_like(scene.current.positions)
    upwards[..., 2] = 1
    body = inside_box(scene.current.positions[0], clip.poses(0)[0, 0], torch.from_numpy(HALF_SIZE[0]), 0.02)
    # What is guessed here is the body once more, so that it must stay where the body is.
    parts = (part[:, body] for part in (scene.current.positions, scene.current.features, upwards))
    side = HiddenSide(*parts, mask=torch.ones(1, int(body.sum()), dtype=torch.bool))
    current = replace(scene.current, normals=upwards, hidden_side=side)
    images = drawn_references(oracle, replace(scene, current=current), clip, 0.02)
    assert list(images) == list(DRAWN) and all(image.shape[-1] == 3 for image in images.values())
    return oracle, clip, current, oracle.seen


def test_nothing_moves_is_drawn_once_and_the_true_motion_is_the_oracles(test_paths: list[Path]) -> None:
    oracle, _, current, (still, _, true) = _drawn(test_paths)
    assert len(still) == 1 and torch.equal(still[0].positions, current.positions)
    scene = type("Scene", (), {"current": current})()
    for state, expected in zip(true, oracle.rollout(scene, NUM_STEPS), strict=True):
        torch.testing.assert_close(state.positions, expected.positions, atol=1e-9, rtol=0)
        assert torch.equal(state.features, expected.features), "the dynamics may shade what it turns"


def test_the_hidden_side_goes_with_its_body(test_paths: list[Path]) -> None:
    _, clip, current, drawn = _drawn(test_paths)
    body = inside_box(current.positions[0], clip.poses(0)[0, 0], torch.from_numpy(HALF_SIZE[0]), 0.02)
    assert body.any() and not body.all()
    for state in [state for states in drawn for state in states]:
        side = state.hidden_side
        assert side is not None and state.normals is not None
        torch.testing.assert_close(side.positions, state.positions[:, body], atol=1e-9, rtol=0)
        torch.testing.assert_close(side.normals, state.normals[:, body], atol=1e-9, rtol=0)
    assert not torch.allclose(drawn[-1][-1].positions[:, body], current.positions[:, body], atol=0.01)


def test_the_kept_velocity_goes_on_straight_and_turns_on(test_paths: list[Path]) -> None:
    _, clip, current, (_, kept, _) = _drawn(test_paths)
    before, now = clip.previous_pose()[0].numpy(), clip.poses(0)[0, 0].numpy()
    turn = Rotation.from_quat(np.roll(now[3:], -1)) * Rotation.from_quat(np.roll(before[3:], -1)).inv()
    points = current.positions[0].numpy()
    body = inside_box(current.positions[0], torch.from_numpy(now), torch.from_numpy(HALF_SIZE[0]), 0.02).numpy()
    center = points[body].mean(axis=0)
    past = before[:3] + turn.inv().apply(center - now[:3])  # where that point of the body was
    for step, state in enumerate(kept, start=1):
        rotation = Rotation.from_rotvec(step * turn.as_rotvec())
        expected = center + step * (center - past) + rotation.apply(points[body] - center)
        np.testing.assert_allclose(state.positions[0, body], expected, atol=1e-9)
        np.testing.assert_array_equal(state.positions[0, ~body], points[~body])
        assert state.normals is not None
        np.testing.assert_allclose(
            state.normals[0, body], np.tile(rotation.apply([0, 0, 1]), (body.sum(), 1)), atol=1e-9
        )
        assert (state.normals[0, ~body, 2] == 1).all()


def test_they_are_reported_where_they_are_asked_for(
    manifest: Manifest, protocol: Protocol, test_paths: list[Path], tmp_path: Path
) -> None:
    plain = metrics_of(evaluate(Oracle(test_paths), manifest, protocol, [0]), protocol, {})
    assert plain["drawn"] is None and not any("same renderer" in line for line in summary_lines(plain))

    asked = protocol_with(draw_references=True)
    evaluation = evaluate(Oracle(test_paths), manifest, asked, [0], num_kept=1)
    metrics = metrics_of(evaluation, asked, {})
    assert {**metrics, **dict.fromkeys(("drawn", "protocol", "seconds"))} == {
        **plain, **dict.fromkeys(("drawn", "protocol", "seconds"))
    }  # fmt: skip
    # The oracle draws the frame that its features name: the last one, where they are not predicted.
    for metric in ("psnr", "ssim", "psnr_moving", "moving_iou"):
        same = {"true_motion": metrics, **dict.fromkeys(list(DRAWN)[:2], metrics["references"]["copy_last"])}
        for name, expected in same.items():
            found = metrics["drawn"][name][metric]["per_step"]
            assert found == pytest.approx(expected[metric]["per_step"], abs=1e-4)
    assert "true_motion/psnr" in step_table(metrics)
    assert any("true velocity kept" in line for line in summary_lines(metrics))
    write_metrics(tmp_path, metrics, evaluation)
    write_gallery(tmp_path, metrics, evaluation, num_videos=0)
    with np.load(tmp_path / "arrays.npz") as arrays:
        assert arrays["nothing_moves/psnr"].shape == arrays["model/psnr"].shape
