"""The list of metrics: each line can be measured, and nothing else holds its name."""

import ast
import json
from pathlib import Path

import pytest

import vpd_lightning
from vpd_lightning.metrics import registry
from vpd_lightning.metrics.metric_info import MetricInfo
from vpd_lightning.metrics.registry import METRICS, metric

SOURCE = Path(vpd_lightning.__file__).parent
ROOT = Path(__file__).resolve().parents[2]
PUBLISHED = sorted(
    path for pattern in ("released/*/metrics.json", "docs/results/demo_[rs]e*.json") for path in ROOT.glob(pattern)
)
# Files that need one of them for what it means, not to list, print or compare it.
ON_PURPOSE = {
    "metrics/psnr.py": {"psnr", "psnr_moving"},  # the parts that its functions return
    "evaluation/events.py": {"height_error", "speed", "true_speed", "vertical_velocity", "true_vertical_velocity"},
    "evaluation/long_rollout.py": {"size_ratio", "lowest_point", "centroid_error", "centroid_error_copy"},
    "evaluation/report.py": {"size_ratio", "lowest_point", "centroid_error", "centroid_error_copy"},  # long rollouts
    "evaluation/summary.py": {
        "size_ratio",
        "lowest_point",
        "height_error",
        "speed",
    },  # long rollouts, and bodies at rest
}


def test_names_are_unique_and_references_are_of_metrics() -> None:
    names = [info.name for info in METRICS]
    assert len(set(names)) == len(names) and registry.HEADLINE in names
    assert all(info.reference_of is None or metric(info.reference_of).better != "none" for info in METRICS)


@pytest.mark.parametrize("info", METRICS, ids=lambda info: info.name)
def test_every_line_has_its_function_and_its_words(info: MetricInfo) -> None:
    assert callable(info.load()) and info.title and info.description and info.digits >= 0
    assert info.part_names[0] in (info.name, "mean")
    assert info.pooled_part is None or info.pooled_part in info.parts
    assert not (info.in_tables and info.better == "none"), "what judges nothing ranks nobody"


def test_numbers_are_printed_with_their_unit() -> None:
    assert metric("centroid_error").label == "centroid error of bodies (cm)"
    assert metric("centroid_error").spoken(0.0234) == "centroid error of bodies 2.3 cm"
    assert metric("ssim").spoken(0.8484) == "SSIM 0.848" and metric("sharpness").label == "sharpness (truth: 1)"
    assert metric("psnr").shown(None) == "-"


def test_the_smaller_the_distance_the_better() -> None:
    assert metric("psnr").distance(30.0) < metric("psnr").distance(20.0)
    assert metric("chamfer").distance(0.01) < metric("chamfer").distance(0.02)
    assert metric("sharpness").distance(1.0) < metric("sharpness").distance(0.5)


@pytest.mark.parametrize("path", PUBLISHED, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_figures_that_were_published_before_are_found(path: Path) -> None:
    metrics = json.loads(path.read_text())
    wanted = [info for info in METRICS if info.name in ("psnr", "psnr_moving", "ssim", "chamfer", "centroid_error")]
    if metrics.get("experiment") == "pushing":  # its recordings differ in how many bodies they have
        assert metrics["motion"] is None
        wanted.remove(metric("centroid_error"))
    for info in wanted:
        found = info.summary(metrics)
        assert found is not None and found["mean"] > 0 and len(found["per_step"]) == metrics["protocol"]["num_steps"]
        references = [info.summary(metrics, source) for source in registry.REFERENCES]
        assert all((reference is not None) == (info.subject == "image") for reference in references)


def test_an_unknown_name_is_answered_with_the_known_ones() -> None:
    with pytest.raises(KeyError, match="no metric 'dists'.*psnr_moving"):
        metric("dists")


def test_a_function_that_returns_other_parts_is_refused() -> None:
    with pytest.raises(ValueError, match="returns .*'mae'.*psnr"):
        metric("psnr").as_parts({"mae": 1.0})


def test_no_other_file_holds_the_name_of_a_metric() -> None:
    names = {info.name for info in METRICS}
    found: dict[str, set[str]] = {}
    for path in SOURCE.rglob("*.py"):
        place = path.relative_to(SOURCE).as_posix()
        if place != "metrics/registry.py":
            strings = {node.value for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Constant)}
            if strings & names:
                found[place] = strings & names
    assert found == ON_PURPOSE
