"""The table of several evaluations, which the documentation shows."""

import copy
from pathlib import Path
from typing import Any

import pytest

from docs.results.studies.seeds_table import COLUMNS, table
from tests.evaluation.conftest import protocol_with
from tests.evaluation.tossed_box import Oracle, write_tossed_boxes
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.evaluation.evaluate import evaluate
from vpd_lightning.evaluation.report import metrics_of


@pytest.fixture(scope="module")
def metrics(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    manifest = load_manifest(write_tossed_boxes(tmp_path_factory.mktemp("boxes")))
    paths: list[Path] = manifest.split("test")
    protocol = protocol_with()
    return metrics_of(evaluate(Oracle(paths), manifest, protocol, [0]), protocol, {})


def cells(line: str) -> dict[str, str]:
    return dict(zip([name for name, _, _ in COLUMNS], [cell.strip() for cell in line.split("|")[2:-1]], strict=True))


def test_every_run_has_its_row_and_numbers_have_a_mean(metrics: dict[str, Any]) -> None:
    other = copy.deepcopy(metrics)
    other["ssim"]["mean"] = metrics["ssim"]["mean"] - 0.2
    other["long_rollout"] |= {"finite": False, "floor_drift": {"max": 0.03}}
    other["long_rollout"]["size_ratio"] |= {"min": 0.5, "max": 1.25}
    header, rule, first, second, mean = table([metrics, other]).splitlines()
    assert header.count("|") == rule.count("|") == first.count("|") == mean.count("|")
    assert cells(first)["long rollout finite"] == "yes" and cells(second)["long rollout finite"] == "NO"
    assert cells(first)["block size / start, long rollout"] == "1.00 to 1.00"
    assert cells(second)["block size / start, long rollout"] == "0.50 to 1.25"
    assert cells(mean)["floor drift, worst particle (cm)"] == "1.50"
    assert cells(mean)["SSIM"] == "0.900"
    assert cells(mean)["long rollout finite"] == "-"


def test_what_an_evaluation_does_not_have_is_a_dash(metrics: dict[str, Any]) -> None:
    bare = {**metrics, "motion": None, "long_rollout": None}
    _, _, _, second, mean = table([metrics, bare]).splitlines()
    for row in (cells(second), cells(mean)):
        assert row["centroid error, step 4 (cm)"] == row["floor drift, worst particle (cm)"] == "-"
    assert cells(second)["of best constant, step 8 (%)"] == "-"  # four steps only
