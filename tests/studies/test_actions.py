"""What the action is worth: the ratio of errors with it to those without."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from docs.results.studies import actions
from docs.results.studies.actions import STEPS, Errors, _sums, ratio


def _row(kind: str, sums: list[float]) -> dict[str, object]:
    return {"sums": {kind: {str(step): sums for step in STEPS}}}


def test_sums_are_of_each_trajectory_in_centimetres() -> None:
    """Trajectories without a pushed body have no place in them."""
    errors = np.arange(3 * max(STEPS), dtype=np.float64).reshape(3, max(STEPS)) / 100
    sums = _sums({"true/centroid_error": errors, "true/size_ratio": errors}, np.array([0, 2, 2]))
    assert list(sums) == ["true"]
    np.testing.assert_allclose(sums["true"]["4"], [3, 3 + 32 + 3 + 64])


def test_half_the_error_is_half() -> None:
    found = ratio(_row("true", [2.0, 2.0]), _row("none", [4.0, 4.0]))
    assert found["16"] == pytest.approx([0.5, 0.5, 0.5])


def test_the_interval_holds_the_trajectories_apart() -> None:
    """One trajectory at a quarter, one at the same error: the interval reaches from one to the other."""
    found = ratio(_row("true", [1.0, 4.0]), _row("none", [4.0, 4.0]))
    value, low, high = found["8"]
    assert (value, low, high) == pytest.approx((0.625, 0.25, 1.0))


def test_seeds_are_averaged_body_by_body(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two bodies of two trajectories; one model is off by 1 and 3 cm, the other by 5 and 3."""
    made = {}
    for name, values in {"a": [0.01, 0.03], "b": [0.05, 0.03]}.items():
        bodies = np.repeat(np.array(values)[:, None], max(STEPS), axis=1)
        scores = np.full((2, len(STEPS)), 10.0 if name == "a" else 20.0)
        made[name] = Errors(
            {"true/centroid_error": bodies}, np.array([0, 1]), np.array([True, False]), {"true": scores},
            np.array([0, 1]),
        )  # fmt: skip
    monkeypatch.setattr(actions, "errors", lambda model, *_: made[model.name])
    models = [
        SimpleNamespace(name=name, simulator=torch.nn.Linear(2, 3), step=7, checkpoint=None, path=Path())
        for name in made
    ]
    found = actions.measured(models, Path(), "test", [0])  # type: ignore[arg-type]
    assert found["true"]["centroid_error"]["8"] == pytest.approx([3.0, 3.0, 3.0])
    assert found["sums"]["true"]["8"] == pytest.approx([3.0, 3.0])
    assert found["stay"]["sums"]["true"]["8"] == pytest.approx([3.0]), "the other one falls"
    assert found["psnr_moving"]["true"]["16"][0] == pytest.approx(15.0)
    assert [seed["centroid_error"]["true"]["8"][0] for seed in found["seeds"]] == pytest.approx([2.0, 4.0])
    assert found["parameters"] == 9
