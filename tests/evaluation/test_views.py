"""Systems without particles: each view continued from its own frames, at a resolution of its own."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio

from tests.evaluation.conftest import protocol_with
from tests.evaluation.tossed_box import NUM_VIEWS, SIZE, Oracle
from vpd_lightning.data.clip import read_clip
from vpd_lightning.data.manifest import Manifest
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.errors import ConfigError
from vpd_lightning.evaluation.evaluate import Evaluation, evaluate
from vpd_lightning.evaluation.gallery import write_gallery
from vpd_lightning.evaluation.prediction import PredictsVideo, PredictsViews, predict_clip, without_depth
from vpd_lightning.evaluation.protocol import Protocol
from vpd_lightning.evaluation.report import metrics_of, write_metrics
from vpd_lightning.evaluation.rollouts import write_rollouts
from vpd_lightning.evaluation.summary import summary_lines
from vpd_lightning.simulator import Scene
from vpd_lightning.types import Particles

RESOLUTION = SIZE // 2


class RepeatsTheLastFrame:
    """Its only slot is the image at half the size; it remembers what it was shown."""

    num_context_frames = 6

    def __init__(self) -> None:
        self.shown: list[np.ndarray] = []

    def encode_views(self, rgb: torch.Tensor) -> torch.Tensor:
        self.shown.append(rgb.numpy())
        small = rgb.float().unfold(2, 2, 2).unfold(3, 2, 2).mean((-2, -1)) / 255  # time view row column colour
        return small.transpose(0, 1).flatten(2).unsqueeze(2)

    def rollout_views(self, slots: torch.Tensor, num_steps: int) -> torch.Tensor:
        return slots[:, -1:].expand(-1, num_steps, -1, -1)

    def decode(self, slots: torch.Tensor) -> torch.Tensor:
        return slots[..., 0, :].unflatten(-1, (RESOLUTION, RESOLUTION, 3))


class SceneVector(Oracle):
    """A system whose state is one vector of the whole scene, kept as the feature of a single particle."""

    def encode(self, *arguments: torch.Tensor) -> Scene:
        scene = super().encode(*arguments)
        origin = torch.zeros(1, 1, 3, dtype=torch.float64)
        return Scene(*(Particles(origin, state.features[:, :1]) for state in (scene.previous, scene.current)))


@pytest.fixture
def protocol() -> Protocol:
    return protocol_with(start_frames=(4,), num_long_steps=5)


@pytest.fixture
def evaluation(manifest: Manifest, protocol: Protocol) -> Evaluation:
    return evaluate(RepeatsTheLastFrame(), manifest, protocol, [1], num_kept=2)


def halved(images: np.ndarray) -> np.ndarray:
    """Mean of 2x2 pixels, in [0, 1]."""
    height, width = images.shape[-3] // 2, images.shape[-2] // 2
    return images.reshape(*images.shape[:-3], height, 2, width, 2, 3).mean((-4, -2)) / 255


def test_protocols_tell_the_systems_apart() -> None:
    assert isinstance(RepeatsTheLastFrame(), PredictsViews) and not isinstance(RepeatsTheLastFrame(), PredictsVideo)
    assert not isinstance(Oracle([]), PredictsViews)


def test_a_system_with_a_longer_memory_sees_earlier_frames_and_predicts_the_same(
    manifest: Manifest, protocol: Protocol, test_paths: list[Path]
) -> None:
    system = RepeatsTheLastFrame()
    evaluation = evaluate(system, manifest, protocol, [1], num_kept=1)
    with TrajectoryReader(test_paths[0]) as reader:
        assert np.array_equal(system.shown[0], reader.rgb(range(6)))
        assert np.array_equal(evaluation.kept[0][0].target_rgb.numpy(), reader.rgb(range(6, 10)))
    two = read_clip(test_paths[0], 0, 4, 4)
    six = read_clip(test_paths[0], 0, 4, 4, num_context=6)
    assert two.current_frame == six.current_frame == 5
    assert torch.equal(two.target_rgb, six.target_rgb) and torch.equal(two.rgb, six.rgb[-2:])
    assert six.cameras.shape == six.depth.shape[:2] == (6, NUM_VIEWS)


def test_too_little_history_is_refused_with_the_way_out(manifest: Manifest) -> None:
    with pytest.raises(ConfigError, match=r"(?s)looks at 6 frames, but start frame 3 has only 5.*start_frames=\[4\]"):
        evaluate(RepeatsTheLastFrame(), manifest, protocol_with(start_frames=(4, 3)), [0])


def test_the_headline_enlarges_the_prediction_and_native_shrinks_the_truth(
    evaluation: Evaluation, protocol: Protocol, test_paths: list[Path]
) -> None:
    assert evaluation.images["model"]["psnr"].shape == evaluation.native["psnr"].shape == (3, NUM_VIEWS, 4)
    with TrajectoryReader(test_paths[1]) as reader:
        frames = reader.rgb().astype(np.float64)
    for view in range(NUM_VIEWS):
        small = halved(frames[5, view])
        large = cv2.resize(small, (SIZE, SIZE), interpolation=cv2.INTER_LINEAR)
        for step in range(4):
            expected = peak_signal_noise_ratio(frames[6 + step, view] / 255, large, data_range=1.0)
            assert evaluation.images["model"]["psnr"][1, view, step] == pytest.approx(expected, abs=1e-4)
            expected = peak_signal_noise_ratio(halved(frames[6 + step, view]), small, data_range=1.0)
            assert evaluation.native["psnr"][1, view, step] == pytest.approx(expected, abs=1e-4)
    native = metrics_of(evaluation, protocol, {})["native"]
    assert native["resolution"] == RESOLUTION
    for name in ("psnr", "ssim", "psnr_moving", "sharpness"):
        assert native[name] == pytest.approx(np.nanmean(evaluation.native[name]))


def test_what_needs_particles_is_missing_and_nothing_minds(
    evaluation: Evaluation, protocol: Protocol, tmp_path: Path
) -> None:
    metrics = metrics_of(evaluation, protocol, {})
    assert all(metrics[name] is None for name in ("chamfer", "motion", "penetration", "long_rollout"))
    assert metrics["protocol"]["input_views"] == [0, 1], "each view is predicted from its own frames"
    assert metrics["psnr"]["other_views"] is None and metrics["finite"]
    write_metrics(tmp_path, metrics, evaluation)
    write_gallery(tmp_path, metrics, evaluation, num_videos=1)
    write_rollouts(tmp_path / "rollouts.npz", evaluation)
    assert (tmp_path / "curves.png").stat().st_size > 0 and len(list((tmp_path / "videos").iterdir())) == 1
    text = "\n".join(summary_lines(metrics))
    assert "at its own 12x12 pixels" in text and "Chamfer" not in text and "centroid" not in text
    assert max(map(len, text.splitlines())) <= 110


def test_a_system_as_coarse_as_ssims_window_has_no_native_ssim(manifest: Manifest, protocol: Protocol) -> None:
    class Coarse(RepeatsTheLastFrame):
        def decode(self, slots: torch.Tensor) -> torch.Tensor:
            return super().decode(slots)[..., ::2, ::2, :]

    metrics = metrics_of(evaluate(Coarse(), manifest, protocol, [0]), protocol, {})
    assert metrics["native"]["resolution"] == 6 and metrics["native"]["ssim"] is None
    assert metrics["native"]["psnr"] > 5 and metrics["ssim"]["mean"] is not None


def test_images_that_are_no_numbers_are_said_and_count_as_black(
    manifest: Manifest, protocol: Protocol, test_paths: list[Path]
) -> None:
    class Broken(RepeatsTheLastFrame):
        def decode(self, slots: torch.Tensor) -> torch.Tensor:
            return torch.nan * super().decode(slots)

    metrics = metrics_of(evaluate(Broken(), manifest, protocol, [0]), protocol, {})
    assert not metrics["finite"] and "NOT FINITE" in summary_lines(metrics)[0]
    with TrajectoryReader(test_paths[0]) as reader:
        black = np.mean((reader.rgb([9], [0]) / 255.0) ** 2)
    evaluation = evaluate(Broken(), manifest, protocol, [0])
    assert evaluation.images["model"]["mse"][0, 0, -1] == pytest.approx(black, rel=1e-5)


def test_a_vector_of_the_scene_is_judged_by_its_pixels(
    manifest: Manifest, protocol: Protocol, test_paths: list[Path]
) -> None:
    evaluation = evaluate(SceneVector(test_paths), manifest, protocol, [0])
    metrics = metrics_of(evaluation, protocol, {})
    assert all(metrics[name] is None for name in ("chamfer", "motion", "penetration", "long_rollout", "native"))


def test_rollouts_hold_the_pixels_of_two_clips_and_of_an_input_and_another_view(
    evaluation: Evaluation, tmp_path: Path
) -> None:
    write_rollouts(tmp_path / "rollouts.npz", evaluation)
    rollouts = np.load(tmp_path / "rollouts.npz", allow_pickle=False)
    assert rollouts["clips"].tolist() == evaluation.clips[:2] and rollouts["views"].tolist() == [1, 0]
    assert rollouts["context"].shape == (2, 6, 2, SIZE, SIZE, 3) and rollouts["context"].dtype == np.uint8
    assert rollouts["truth"].shape == rollouts["prediction"].shape == (2, 4, 2, SIZE, SIZE, 3)
    clip, prediction = evaluation.kept[1]
    assert np.array_equal(rollouts["truth"][1, :, 0], clip.target_rgb[:, 1].numpy())
    assert np.array_equal(rollouts["prediction"][1, :, 1], prediction.images_uint8()[:, 0])


def test_hidden_depth_reaches_the_system_and_not_the_metrics(
    manifest: Manifest, protocol: Protocol, test_paths: list[Path]
) -> None:
    class Blind(SceneVector):
        def encode(self, *arguments: torch.Tensor) -> Scene:
            rgb, depth, cameras = arguments
            assert depth.isnan().all()
            return super().encode(rgb, torch.ones_like(depth), cameras)

    evaluation = evaluate(Blind(test_paths), manifest, protocol, [0], num_kept=1, hide_depth=True)
    assert evaluation.finite and evaluation.kept[0][0].depth.isfinite().all()


def test_hidden_depth_changes_nothing_else_of_a_clip(test_paths: list[Path]) -> None:
    clip = read_clip(test_paths[0], 0, 4, 2)
    hidden = without_depth(clip)
    assert hidden.depth.isnan().all() and replace(hidden, depth=clip.depth) == clip


def test_predicting_views_needs_no_gradient(test_paths: list[Path]) -> None:
    class Learned(RepeatsTheLastFrame):
        weight = torch.nn.Parameter(torch.ones(()))

        def rollout_views(self, slots: torch.Tensor, num_steps: int) -> torch.Tensor:
            return self.weight * super().rollout_views(slots, num_steps)

    prediction = predict_clip(Learned(), read_clip(test_paths[0], 0, 4, 2, num_context=6), [0])
    assert not prediction.images.requires_grad and prediction.positions is None
    assert prediction.native is not None and prediction.native.shape == (2, NUM_VIEWS, RESOLUTION, RESOLUTION, 3)
