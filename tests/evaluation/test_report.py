"""Statistics, metrics.json, the table that people read, and the pictures."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.evaluation.tossed_box import Oracle
from vpd_lightning.data.manifest import Manifest
from vpd_lightning.evaluation.evaluate import Evaluation, evaluate
from vpd_lightning.evaluation.gallery import write_gallery
from vpd_lightning.evaluation.protocol import Protocol
from vpd_lightning.evaluation.report import metrics_of, write_metrics
from vpd_lightning.evaluation.statistics import pooled_psnr, summarize
from vpd_lightning.evaluation.summary import horizons, summary_lines


@pytest.fixture
def evaluation(manifest: Manifest, protocol: Protocol, test_paths: list[Path]) -> Evaluation:
    return evaluate(Oracle(test_paths), manifest, protocol, [0], num_kept=2)


def test_summary_is_the_mean_over_images_that_have_a_value() -> None:
    values = np.array([[[1.0, 3.0]], [[np.nan, 5.0]], [[7.0, np.nan]]])
    summary = summarize(values, np.array([0, 0, 1]), num_bootstrap=50)
    assert summary["mean"] == pytest.approx(4.0)
    assert summary["per_step"] == [4.0, 4.0]
    assert summary["count"] == 4
    assert summary["std_trajectories"] == pytest.approx(np.std([3.0, 7.0], ddof=1))
    assert summary["ci95"] == pytest.approx([3.0, 7.0])


def test_bootstrap_resamples_trajectories_not_clips() -> None:
    # Ten clips of each of two trajectories: the interval must reach from one trajectory's mean to the other's.
    values = np.repeat([1.0, 2.0], 10)[:, None]
    summary = summarize(values, np.repeat([0, 1], 10), num_bootstrap=200)
    assert summary["ci95"] == [1.0, 2.0]


def test_bootstrap_interval_has_the_width_of_the_standard_error() -> None:
    values = np.random.default_rng(0).normal(size=(400, 1))
    low, high = summarize(values, np.arange(400), num_bootstrap=2000)["ci95"]
    # 2 * 1.96 / sqrt(400), within the noise of the sample's own spread and of 2000 resamples.
    assert high - low == pytest.approx(0.196, rel=0.15)


def test_summary_of_nothing_is_missing() -> None:
    summary = summarize(np.full((2, 1, 3), np.nan), np.array([0, 1]), num_bootstrap=10)
    assert summary["mean"] is None and summary["ci95"] is None and summary["per_step"] == [None] * 3


def test_pooled_psnr_is_below_the_mean_psnr() -> None:
    mse = np.array([1e-4, 1e-2])
    assert pooled_psnr(mse) == pytest.approx(-10 * np.log10(5.05e-3))
    assert pooled_psnr(mse) < np.mean(-10 * np.log10(mse))


def test_metrics_json_has_the_promised_shape(evaluation: Evaluation, protocol: Protocol, tmp_path: Path) -> None:
    identity = {"model": "oracle", "checkpoint_sha256": "0" * 64, "data_sha256": "1" * 64}
    path = write_metrics(tmp_path, metrics_of(evaluation, protocol, identity), evaluation)

    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    metrics = json.loads(path.read_text(), parse_constant=refuse)
    assert metrics["model"] == "oracle" and metrics["protocol"]["start_frames"] == [0, 2]
    for name in ("psnr", "ssim", "psnr_moving", "chamfer"):
        assert isinstance(metrics[name]["mean"], float) and len(metrics[name]["per_step"]) == 4
        assert metrics[name]["ci95"][0] <= metrics[name]["mean"] <= metrics[name]["ci95"][1]
    for reference in ("copy_last", "train_mean"):
        for name in ("psnr", "psnr_moving"):
            assert isinstance(metrics["references"][reference][name]["mean"], float)
    assert metrics["seconds"]["total"] > 0


def test_arrays_and_table_hold_every_value(evaluation: Evaluation, protocol: Protocol, tmp_path: Path) -> None:
    metrics = metrics_of(evaluation, protocol, {})
    write_metrics(tmp_path, metrics, evaluation)
    arrays = np.load(tmp_path / "arrays.npz")
    assert arrays["model/psnr"].shape == (6, 2, 4) and arrays["motion/centroid_error"].shape == (6, 1, 4)
    assert arrays["clip"][1] == "test/000000.h5@2" and arrays["trajectory"].tolist() == [0, 0, 1, 1, 2, 2]
    with (tmp_path / "metrics.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["step"] for row in rows] == ["1", "2", "3", "4"]
    assert float(rows[2]["copy_last/psnr"]) == pytest.approx(arrays["copy_last/psnr"][..., 2].mean(), abs=1e-3)


def test_views_are_also_reported_apart(evaluation: Evaluation, protocol: Protocol) -> None:
    copy = metrics_of(evaluation, protocol, {})["references"]["copy_last"]["psnr"]
    values = evaluation.images["copy_last"]["psnr"]
    assert copy["input_views"] == pytest.approx(values[:, 0].mean())
    assert copy["other_views"] == pytest.approx(values[:, 1].mean())


def test_the_table_shows_what_counts(evaluation: Evaluation, protocol: Protocol) -> None:
    text = "\n".join(summary_lines(metrics_of(evaluation, protocol, {})))
    assert "3 trajectories, 6 clips, 4 steps, 2 views" in text
    for label in ("PSNR (dB)", "moving pixels", "model / constant", "20-step rollout", "everything finite"):
        assert label in text
    assert max(map(len, text.splitlines())) <= 100


@pytest.mark.parametrize(("num_steps", "expected"), [(1, [1]), (4, [1, 4]), (8, [1, 4, 8]), (32, [1, 4, 8, 16, 32])])
def test_the_table_shows_steps_1_4_8_and_the_last(num_steps: int, expected: list[int]) -> None:
    assert horizons(num_steps) == expected


def test_the_gallery_has_curves_a_sheet_and_films(evaluation: Evaluation, protocol: Protocol, tmp_path: Path) -> None:
    write_gallery(tmp_path, metrics_of(evaluation, protocol, {}), evaluation, num_videos=1)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["contact_sheet.png", "curves.png", "videos"]
    (film,) = (tmp_path / "videos").iterdir()
    capture = cv2.VideoCapture(str(film))
    assert film.name == "test_000000_start0.webm"
    assert capture.get(cv2.CAP_PROP_FRAME_COUNT) == 5  # the last input frame and four predicted ones
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(5 / 3, abs=0.01)  # three seconds, however short the clip
