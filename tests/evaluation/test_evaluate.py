"""The protocol with an oracle that knows the future, with broken predictions, and against hand calculations."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from tests.evaluation.conftest import protocol_with
from tests.evaluation.tossed_box import NUM_FRAMES, NUM_VIEWS, SIZE, Oracle
from vpd_lightning.data.clip import read_clip
from vpd_lightning.data.ground_truth import read_state
from vpd_lightning.data.manifest import Manifest
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.errors import ConfigError, DataError
from vpd_lightning.evaluation.evaluate import evaluate
from vpd_lightning.evaluation.images import moving_pixels
from vpd_lightning.evaluation.protocol import Protocol, read_clips
from vpd_lightning.evaluation.references import geometric_median, median_displacements, training_mean
from vpd_lightning.evaluation.report import metrics_of
from vpd_lightning.metrics.psnr import PSNR_CAP
from vpd_lightning.simulator import Scene
from vpd_lightning.types import Particles


class Shifted(Oracle):
    """An oracle whose particles are all 5 cm off, and do not stay together after the tenth step."""

    def rollout(self, scene: Scene, num_steps: int) -> list[Particles]:
        shift = torch.tensor([0.03, 0.0, 0.04])
        return [replace(state, positions=state.positions + shift) for state in super().rollout(scene, num_steps)]


class Broken(Oracle):
    """An oracle that predicts no numbers from the third step on."""

    def rollout(self, scene: Scene, num_steps: int) -> list[Particles]:
        states = super().rollout(scene, num_steps)
        return [
            replace(state, positions=state.positions * torch.nan) if step >= 2 else state
            for step, state in enumerate(states)
        ]


def test_the_oracle_is_perfect(manifest: Manifest, protocol: Protocol, test_paths: list[Path]) -> None:
    evaluation = evaluate(Oracle(test_paths), manifest, protocol, input_views=[0])
    metrics = metrics_of(evaluation, protocol, {})
    assert evaluation.images["model"]["psnr"].shape == (6, NUM_VIEWS, 4)
    assert metrics["finite"]
    assert metrics["psnr"]["mean"] == PSNR_CAP
    assert metrics["ssim"]["mean"] == pytest.approx(1.0, abs=1e-5)
    assert metrics["reconstruction"]["psnr"] == PSNR_CAP
    motion = metrics["motion"]
    # Poses are float64, so the oracle's particles are where the metric moves them.
    for name in (
        "centroid_error",
        "particle_error",
        "rigidity_error",
        "velocity_error",
        "energy_error",
        "height_error",
    ):
        assert max(motion[name]["per_step"]) < 1e-7
    assert max(motion["orientation_error"]["per_step"]) < 1e-6
    # In free flight the first velocity kept up falls behind by g h (h + 1) dt^2 / 2; seen points also turn.
    behind = [4.9 * 0.05**2 * step * (step + 1) for step in range(1, 5)]
    assert motion["centroid_error_velocity"]["per_step"] == pytest.approx(behind, rel=0.1)
    assert metrics["events"]["contact"]["count"] == metrics["events"]["rest"]["count"] == 0  # the box is in flight
    np.testing.assert_allclose(motion["size_ratio"]["per_step"], 1.0, atol=1e-9)
    assert max(motion["centroid_error_over_constant"]["per_step"]) < 1e-6
    long = metrics["long_rollout"]
    assert long["finite"] and long["num_steps"] == 20 and long["num_clips"] == 3
    assert long["floor_drift"]["max"] == 0
    assert long["size_ratio"]["min"] == pytest.approx(1.0) == long["size_ratio"]["max"]
    assert long["final_speed"]["max"] < 1e-9  # the oracle stands still behind the end of the recording


def test_references_do_not_reach_the_oracle(manifest: Manifest, protocol: Protocol, test_paths: list[Path]) -> None:
    metrics = metrics_of(evaluate(Oracle(test_paths), manifest, protocol, [0]), protocol, {})
    for reference in metrics["references"].values():
        assert 5 < reference["psnr_moving"]["mean"] < reference["psnr"]["mean"] < 40
    motion = metrics["motion"]
    assert motion["centroid_error_copy"]["per_step"][-1] > motion["centroid_error_constant"]["per_step"][-1] > 0.01


def test_a_shift_is_measured_as_such(manifest: Manifest, protocol: Protocol, test_paths: list[Path]) -> None:
    metrics = metrics_of(evaluate(Shifted(test_paths), manifest, protocol, [0]), protocol, {})
    np.testing.assert_allclose(metrics["motion"]["centroid_error"]["per_step"], 0.05, atol=1e-7)
    np.testing.assert_allclose(metrics["motion"]["particle_error"]["per_step"], 0.05, atol=1e-7)
    assert metrics["motion"]["rigidity_error"]["mean"] < 1e-7
    assert metrics["long_rollout"]["floor_drift"]["median"] == pytest.approx(0.05, abs=1e-7)


def test_what_is_not_a_number_is_said_and_has_no_error(
    manifest: Manifest, protocol: Protocol, test_paths: list[Path]
) -> None:
    metrics = metrics_of(evaluate(Broken(test_paths), manifest, protocol, [0]), protocol, {})
    assert not metrics["finite"] and not metrics["long_rollout"]["finite"]
    errors = metrics["motion"]["centroid_error"]["per_step"]
    assert errors[1] < 1e-9 and errors[2] is None
    assert metrics["chamfer"]["per_step"][2] is None


def test_model_and_constant_are_compared_over_the_clips_that_have_both(
    manifest: Manifest, protocol: Protocol, test_paths: list[Path]
) -> None:
    evaluation = evaluate(Shifted(test_paths), manifest, protocol, [0])
    lost = {**evaluation.motion, "centroid_error": evaluation.motion["centroid_error"].copy()}
    hardest = evaluation.motion["centroid_error_constant"][..., 3].argmax()
    lost["centroid_error"][hardest, :, 3] = np.nan
    ratio = metrics_of(replace(evaluation, motion=lost), protocol, {})["motion"]["centroid_error_over_constant"]
    others = np.delete(evaluation.motion["centroid_error_constant"][..., 3], hardest)
    assert ratio["per_step"][3] == pytest.approx(0.05 / others.mean())
    assert ratio["count"] == evaluation.motion["centroid_error"].size - 1


def test_copying_the_last_input_frame_is_compared_frame_by_frame(
    manifest: Manifest, protocol: Protocol, test_paths: list[Path]
) -> None:
    evaluation = evaluate(Oracle(test_paths), manifest, protocol, [0])
    with TrajectoryReader(test_paths[0]) as reader:
        images = reader.rgb().astype(np.float64) / 255
    number, view, step = 1, 1, 2  # the clip of start frame 2; its last input frame is 3
    error = np.mean((images[3, view] - images[4 + step, view]) ** 2)
    expected = -10 * np.log10(error)
    assert evaluation.images["copy_last"]["psnr"][number, view, step] == pytest.approx(expected, abs=1e-4)
    state = read_state(test_paths[0]).segmentation
    moving = (state[3, view] > 0) | (state[4 + step, view] > 0)
    expected = -10 * np.log10(np.mean((images[3, view] - images[4 + step, view])[moving] ** 2))
    assert evaluation.images["copy_last"]["psnr_moving"][number, view, step] == pytest.approx(expected, abs=1e-4)


def test_training_mean_is_the_mean_of_all_training_frames(manifest: Manifest) -> None:
    frames = []
    for path in manifest.split("train"):
        with TrajectoryReader(path) as reader:
            frames.append(reader.rgb())
    expected = np.concatenate(frames).mean(0) / 255
    np.testing.assert_allclose(training_mean(manifest.split("train")).numpy(), expected, atol=1e-6)


def test_best_constant_is_the_geometric_median_of_the_training_displacements(manifest: Manifest) -> None:
    positions = [read_state(path).positions[:, 0] for path in manifest.split("train")]
    displacements = np.stack([p[4:8] - p[3] for p in positions])
    constants = median_displacements(manifest.split("train"), [2, NUM_FRAMES], num_steps=4)
    np.testing.assert_allclose(constants[2][:, 0].numpy(), geometric_median(displacements))
    assert NUM_FRAMES not in constants  # no training trajectory is long enough


def mean_distance(points: np.ndarray, constant: np.ndarray) -> float:
    return float(np.linalg.norm(points - constant, axis=-1).mean())


@pytest.mark.parametrize("outlier", [0.0, 5.0])
def test_no_constant_has_a_smaller_mean_distance_than_the_geometric_median(outlier: float) -> None:
    random = np.random.default_rng(0)
    points = random.normal(size=(15, 2, 3)) + [0.3, -1.0, 0.2]
    points[0] += outlier
    medians = geometric_median(points)
    for index, median in enumerate(medians):
        found = minimize(lambda x, p=points[:, index]: mean_distance(p, x), points[:, index].mean(0), tol=1e-12)
        assert mean_distance(points[:, index], median) < found.fun + 1e-5
        tried = median + random.normal(size=(1000, 3)) * random.choice([1e-3, 1e-2, 0.1, 1.0], size=(1000, 1))
        best = min(mean_distance(points[:, index], x) for x in (*tried, *points[:, index]))
        assert mean_distance(points[:, index], median) < best + 1e-5
        assert mean_distance(points[:, index], median) < mean_distance(points[:, index], points[:, index].mean(0))


def test_geometric_median_leaves_a_point_that_is_not_it_and_finds_one_that_is() -> None:
    # The mean of the first set, where the iteration starts, lies on one of its points.
    off = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0.1, 0], [1, -0.1, 0], [-3, 0, 0]])
    assert geometric_median(off)[0] == pytest.approx(
        minimize(lambda x: mean_distance(off, x), [0.5, 0.01, 0.01], method="Nelder-Mead", tol=1e-10).x[0], abs=2e-3
    )
    most = np.array([[0.0, 0, 0], [0, 0, 0], [0, 0, 0], [1, 0, 0], [0, 4, 0]])
    np.testing.assert_allclose(geometric_median(most), 0, atol=1e-3)
    np.testing.assert_allclose(geometric_median(np.ones((1, 3))), 1)


def test_moving_pixels_without_segmentation_come_from_colour(test_paths: list[Path], protocol: Protocol) -> None:
    clip = replace(read_clip(test_paths[0], 0, 0, 4), state=None)
    change = (clip.target_rgb.int() - clip.rgb[1].int()).abs().amax(-1) / 255
    assert torch.equal(moving_pixels(clip, protocol), change > protocol.moving_threshold)


def test_recordings_without_ground_truth_are_judged_by_their_pixels(
    manifest: Manifest, protocol: Protocol, test_paths: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vpd_lightning.data.clip.has_state", lambda path: False)
    metrics = metrics_of(evaluate(Oracle(test_paths), manifest, protocol, [0]), protocol, {})
    assert metrics["motion"] is None and metrics["long_rollout"] is None
    assert metrics["psnr_moving"]["mean"] == PSNR_CAP
    assert metrics["chamfer"]["mean"] < 0.1


def test_clips_are_every_start_of_every_trajectory(test_paths: list[Path], protocol: Protocol) -> None:
    clips = list(read_clips(test_paths[:2], protocol))
    assert [clip.name for clip in clips] == [f"test/00000{n}.h5@{start}" for n in range(2) for start in (0, 2)]
    assert clips[1].rgb.shape == (2, NUM_VIEWS, SIZE, SIZE, 3) and clips[1].target_rgb.shape[0] == 4
    with TrajectoryReader(test_paths[0]) as reader:
        assert np.array_equal(clips[1].target_rgb[0], reader.rgb([4])[0])


def test_a_recording_that_is_too_short_is_refused(manifest: Manifest, test_paths: list[Path]) -> None:
    with pytest.raises(DataError, match="has 10 frames; start frame 2 with 9 steps needs 13"):
        evaluate(Oracle(test_paths), manifest, protocol_with(num_steps=9, start_frames=(2,)), [0])


def test_views_that_are_not_there_are_refused(manifest: Manifest, protocol: Protocol, test_paths: list[Path]) -> None:
    with pytest.raises(ConfigError, match=r"reads views \[0, 2\].*has 2 \(0 to 1\)"):
        evaluate(Oracle(test_paths), manifest, protocol, [0, 2])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"split": "tests"}, "no split 'tests'"),
        ({"start_frames": ()}, "start_frames"),
        ({"start_frames": (1, 1)}, "start_frames"),
        ({"num_steps": 0}, "num_steps is 0"),
        ({"num_trajectories": 0}, "num_trajectories"),
    ],
)
def test_protocols_that_make_no_sense_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        protocol_with(**changes)


def test_progress_counts_clips(manifest: Manifest, test_paths: list[Path]) -> None:
    calls: list[tuple[str, int, int]] = []

    def listen(what: str, done: int, total: int) -> None:
        calls.append((what, done, total))

    evaluate(Oracle(test_paths), manifest, protocol_with(num_trajectories=1), [0], progress=listen)
    assert ("clips", 1, 2) in calls and ("long rollouts", 0, 1) in calls


def test_first_clips_are_kept_for_pictures(manifest: Manifest, protocol: Protocol, test_paths: Sequence[Path]) -> None:
    evaluation = evaluate(Oracle(test_paths), manifest, protocol, [0], num_kept=2)
    assert [clip.name for clip, _ in evaluation.kept] == evaluation.clips[:2]
    clip, prediction = evaluation.kept[0]
    assert np.array_equal(prediction.images_uint8(), clip.target_rgb.numpy())
