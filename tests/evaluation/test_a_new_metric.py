"""A metric that is in the list is everywhere: its function and its line are all that a new one needs."""

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from tests.comparison.made_runs import write_run
from tests.evaluation.conftest import protocol_with
from tests.evaluation.tossed_box import Oracle
from vpd_lightning.commands.report import main as report
from vpd_lightning.data.manifest import Manifest
from vpd_lightning.evaluation.evaluate import evaluate
from vpd_lightning.evaluation.gallery import write_gallery
from vpd_lightning.evaluation.report import metrics_of, write_metrics
from vpd_lightning.evaluation.statistics import summarize
from vpd_lightning.evaluation.summary import summary_lines
from vpd_lightning.evaluation.web_page import write_web_page
from vpd_lightning.metrics import registry
from vpd_lightning.metrics.body_track import BodyTrack
from vpd_lightning.metrics.metric_info import MetricInfo
from vpd_lightning.metrics.true_images import TrueImages
from vpd_lightning.release.card_figures import beaten_by, figure_lines

IMAGE = MetricInfo(
    name="redness", title="error of red", unit="", better="lower", digits=4, subject="image",
    function=f"{__name__}.redness", description="mean difference of the red channel",
)  # fmt: skip
BODY = MetricInfo(
    name="drift", title="sideways drift", unit="m", better="lower", digits=3, subject="body",
    function=f"{__name__}.drift", description="error of the centroid along x",
)  # fmt: skip


def redness(pred: Float[Tensor, "step_or_1 view height width 3"], truth: TrueImages) -> Float[Tensor, "step view"]:
    return (pred[..., 0] - truth.colors[..., 0]).abs().mean((-2, -1))


def drift(track: BodyTrack) -> Float[Tensor, " step"]:
    return track.judged((track.predicted[: track.num_true, :, 0].mean(1) - track.true_steps[..., 0].mean(1)).abs())


@pytest.fixture(autouse=True)
def _listed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "METRICS", (*registry.METRICS, IMAGE, BODY))


def test_a_listed_metric_is_measured_written_and_shown(manifest: Manifest, tmp_path: Path) -> None:
    protocol = protocol_with(num_long_steps=0, start_frames=(0,))
    evaluation = evaluate(Oracle(manifest.split("test")), manifest, protocol, [0], num_kept=1)
    metrics = metrics_of(evaluation, protocol, {})
    write_metrics(tmp_path, metrics, evaluation)
    write_gallery(tmp_path, metrics, evaluation, num_videos=0)
    page = write_web_page(tmp_path, metrics).read_text()

    written = json.loads((tmp_path / "metrics.json").read_text())
    arrays = np.load(tmp_path / "arrays.npz")
    clip = evaluation.kept[0][0]
    copied = (clip.target_rgb[..., 0].float() - clip.rgb[-1, ..., 0].float()).abs().mean((-2, -1)) / 255
    assert torch.from_numpy(arrays["copy_last/redness"][0]).T.numpy() == pytest.approx(copied.numpy(), rel=1e-5)
    assert written["references"]["copy_last"]["redness"]["mean"] > written["redness"]["mean"] >= 0
    assert written["motion"]["drift"]["mean"] < 1e-6 and len(written["motion"]["drift"]["per_step"]) == 4
    assert written["reconstruction"]["redness"] >= 0
    with (tmp_path / "metrics.csv").open() as stream:
        assert {"model/redness", "copy_last/redness", "motion/drift"} <= set(next(csv.reader(stream)))
    lines = summary_lines(metrics)
    assert any(line.startswith("error of red ") for line in lines), "with the gain over the better reference"
    assert any(line.startswith("sideways drift (cm)") for line in lines)
    assert "error of red" in page and "model/redness" in page and "motion/drift" in page


def listed(folder: Path, system: str, error: float) -> None:
    """A run whose evaluation knows the new metrics."""
    run = write_run(folder / system, system=system, psnr=25.0 - error) / "evaluation"
    with np.load(run / "arrays.npz") as stored:
        arrays: dict[str, Any] = dict(stored)
    metrics = json.loads((run / "metrics.json").read_text())
    for source, scale in (("model", 1.0), ("copy_last", 2.0), ("train_mean", 3.0)):
        values = np.full((6, 2, 4), scale * error) + np.arange(6)[:, None, None] / 100
        arrays[f"{source}/redness"] = values
        block = metrics if source == "model" else metrics["references"][source]
        block["redness"] = summarize(values, arrays["trajectory"], 200)
    arrays["motion/drift"] = np.full((6, 1, 4), error)
    metrics["motion"]["drift"] = summarize(arrays["motion/drift"], arrays["trajectory"], 200)
    np.savez_compressed(run / "arrays.npz", **arrays)
    (run / "metrics.json").write_text(json.dumps(metrics))


def test_a_listed_metric_compares_systems(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for system, error in (("vpd", 0.1), ("slotformer", 0.3)):
        listed(tmp_path / "runs", system, error)
    assert report(["runs", "out=compared"]) == 0
    text = (tmp_path / "compared" / "report.md").read_text()
    head = next(line for line in text.splitlines() if line.startswith("| system |"))
    assert "error of red" in head and "sideways drift (cm)" in head
    assert "- error of red: vpd (0.1250)" in text, "it is ranked, the lower the better"
    assert "| first - second |" in text and "+0.2000 [" in text, "it is compared clip by clip"
    assert "error of the centroid along x" in text, "and the page says what it is"
    with (tmp_path / "compared" / "report.csv").open() as stream:
        rows = {row["system"]: row for row in csv.DictReader(stream)}
    assert float(rows["vpd"]["redness"]) == pytest.approx(0.125) and float(rows["vpd"]["drift"]) == pytest.approx(0.1)


def test_a_listed_metric_stands_in_the_card(tmp_path: Path) -> None:
    listed(tmp_path, "vpd", 0.1)
    metrics = json.loads((tmp_path / "vpd/evaluation/metrics.json").read_text())
    for source in ("copy_last", "train_mean"):
        for part in ("input_views", "other_views"):
            metrics["references"][source]["redness"][part] = None
    assert any(line.startswith("| error of red | 0.1250 |") for line in figure_lines(metrics))
    assert beaten_by(metrics, "redness") == []
    metrics["references"]["train_mean"]["redness"]["mean"] = 0.01
    assert beaten_by(metrics, "redness") == ["the training mean"]


def test_a_metric_may_stay_out_of_tables_and_summaries(monkeypatch: pytest.MonkeyPatch) -> None:
    hidden = replace(BODY, in_tables=False, in_summary=False)
    monkeypatch.setattr(registry, "METRICS", (*registry.METRICS[:-1], hidden))
    assert hidden not in registry.compared() and hidden in registry.motion_metrics()
