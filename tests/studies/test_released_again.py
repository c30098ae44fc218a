"""Released models against their cards: what differs is named, what was measured is not measured again."""

import copy
import json
from pathlib import Path

import pytest

from docs.results.studies import released_again

ROOT = Path(__file__).resolve().parents[2]
CARD = json.loads((ROOT / "released" / "mujoco_block_demo" / "metrics.json").read_text())


def moved(name: str, change: float) -> dict:
    """Return the metrics of the demo's card with one mean changed."""
    metrics = copy.deepcopy(CARD)
    (metrics["motion"] if name == "centroid_error" else metrics)[name]["mean"] += change
    return metrics


@pytest.mark.parametrize(
    ("name", "change", "apart"),
    [
        ("psnr", 0.019, []),
        ("psnr", -0.021, ["psnr"]),
        ("ssim", float("nan"), ["ssim"]),
        ("centroid_error", 0.0009, []),
        ("centroid_error", 0.0011, ["centroid_error_cm"]),
    ],
)
def test_what_differs_by_more_than_its_limit_is_named(name: str, change: float, apart: list[str]) -> None:
    assert released_again.compared(CARD, moved(name, change))["apart"] == apart


def test_a_figure_that_is_missing_differs() -> None:
    without = {**CARD, "motion": None}
    assert released_again.compared(CARD, without)["apart"] == ["centroid_error_cm"]


def test_a_model_is_evaluated_once_for_its_weights_and_decides_the_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    results = [moved("psnr", 0.1)]
    monkeypatch.setattr(released_again, "evaluated", lambda model, work: results.pop())
    words = [str(tmp_path / "out.json"), str(tmp_path), "--models", "mujoco_block_demo"]

    assert released_again.main(words) == 1
    assert released_again.main(words) == 1 and not results
    found = json.loads((tmp_path / "out.json").read_text())["mujoco_block_demo"]
    assert found["now"]["psnr"] == pytest.approx(found["card"]["psnr"] + 0.1)
