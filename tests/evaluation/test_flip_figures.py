"""FLIP in evaluations: by step, for the references, where its package is missing, and in files from before it."""

from pathlib import Path

import pytest

from tests.evaluation.tossed_box import Oracle
from vpd_lightning.data.manifest import Manifest
from vpd_lightning.evaluation.evaluate import evaluate
from vpd_lightning.evaluation.gallery import write_gallery
from vpd_lightning.evaluation.protocol import Protocol
from vpd_lightning.evaluation.report import metrics_of, write_metrics
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
