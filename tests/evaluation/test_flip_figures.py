"""FLIP in evaluations: by step, for the references, where its package is missing, and in files from before it."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.comparison.made_runs import write_run
from tests.evaluation.tossed_box import Oracle
from vpd_lightning.commands.report import main as report
from vpd_lightning.data.manifest import Manifest
from vpd_lightning.evaluation.evaluate import evaluate
from vpd_lightning.evaluation.gallery import write_gallery
from vpd_lightning.evaluation.protocol import Protocol
from vpd_lightning.evaluation.report import metrics_of, write_metrics
from vpd_lightning.evaluation.statistics import summarize
from vpd_lightning.evaluation.summary import summary_lines
from vpd_lightning.evaluation.web_page import write_web_page
from vpd_lightning.metrics import flip
from vpd_lightning.metrics.registry import metric
from vpd_lightning.release.card_figures import figure_lines


@pytest.mark.skipif(not flip.is_installed(), reason="flip-evaluator has no wheel for this machine")
def test_references_are_measured_by_step(manifest: Manifest, protocol: Protocol, test_paths: list[Path]) -> None:
    metrics = metrics_of(evaluate(Oracle(test_paths), manifest, protocol, [0]), protocol, {})
    for source in (metrics, *metrics["references"].values()):
        assert len(source["flip"]["per_step"]) == protocol.num_steps and 0 <= source["flip"]["mean"] <= 1
    copied = metrics["references"]["copy_last"]["flip"]
    assert metrics["flip"]["mean"] < 0.1 * copied["mean"] and copied["per_step"][0] < copied["per_step"][-1]
    assert any(line.startswith("FLIP ") and "+" in line for line in summary_lines(metrics)), "lower is a gain"


def test_without_the_package_the_figure_is_missing_and_said_to_be(
    manifest: Manifest, protocol: Protocol, test_paths: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flip, "is_installed", lambda: False)
    evaluation = evaluate(Oracle(test_paths), manifest, protocol, [0], num_kept=1)
    metrics = metrics_of(evaluation, protocol, {})
    write_metrics(tmp_path, metrics, evaluation)
    write_gallery(tmp_path, metrics, evaluation, num_videos=0)
    words = "FLIP was not measured: the package flip-evaluator was not installed."
    assert metrics["flip"]["mean"] is None and metric("flip").summary(metrics) is None
    assert words in summary_lines(metrics) and words in write_web_page(tmp_path, metrics).read_text()
    metrics["seen_in_training"] = None
    assert not any("FLIP |" in line for line in figure_lines(metrics))


def test_files_from_before_it_are_still_shown(
    manifest: Manifest, protocol: Protocol, test_paths: list[Path], tmp_path: Path
) -> None:
    evaluation = evaluate(Oracle(test_paths), manifest, protocol, [0], num_kept=1)
    metrics = metrics_of(evaluation, protocol, {})
    for block in (metrics, metrics["reconstruction"], *metrics["references"].values()):
        del block["flip"]
    write_gallery(tmp_path, metrics, evaluation, num_videos=0)
    assert (tmp_path / "curves.png").stat().st_size > 0
    assert "FLIP" not in "\n".join([*summary_lines(metrics), write_web_page(tmp_path, metrics).read_text()])


def with_flip(run: Path, value: float) -> None:
    """Give a run's evaluation the figure of FLIP, of the model and of the references."""
    path = run / "evaluation" / "metrics.json"
    metrics, arrays = json.loads(path.read_text()), dict(np.load(run / "evaluation" / "arrays.npz"))
    for source, block in (("model", metrics), *metrics["references"].items()):
        arrays[f"{source}/flip"] = np.full((6, 2, 4), value) + np.arange(6)[:, None, None] / 100
        block["flip"] = summarize(arrays[f"{source}/flip"], arrays["trajectory"], 200)
    path.write_text(json.dumps(metrics))
    np.savez_compressed(run / "evaluation" / "arrays.npz", **arrays)


@pytest.mark.parametrize("newer", [0, 1, 2])
def test_runs_from_before_it_are_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, newer: int) -> None:
    monkeypatch.chdir(tmp_path)
    for number, system in enumerate(("vpd", "slotformer")):
        run = write_run(tmp_path / "runs" / system, system=system)
        if number < newer:
            with_flip(run, 0.2 + number / 10)
    assert report(["runs", "out=compared"]) == 0
    text = (tmp_path / "compared" / "report.md").read_text()
    heads = [line for line in text.splitlines() if line.startswith(("| system |", "| first - second |"))]
    assert len(heads) == 2 and all(("| FLIP |" in head) == (newer > 0) for head in heads)
    assert ("- FLIP: vpd (0.225), and no other system" in text) == (newer == 2), "lower is better"
