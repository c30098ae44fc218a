"""What the action is worth: the ratio of errors with it to those without."""

import numpy as np
import pytest

from docs.results.studies.actions import STEPS, _sums, ratio


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
