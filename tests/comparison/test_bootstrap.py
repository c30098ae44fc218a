"""Means over images and seeds; intervals over trajectories and seeds."""

import numpy as np
import pytest

from vpd_lightning.comparison.bootstrap import (
    Estimate,
    MetricSamples,
    difference,
    estimate,
    stacked,
    step_band,
    sums_of,
)
from vpd_lightning.evaluation.statistics import summarize


def measured(values: np.ndarray, trajectory: np.ndarray | None = None) -> MetricSamples:
    return stacked([sums_of(values, np.arange(len(values)) if trajectory is None else trajectory)])


@pytest.fixture
def images() -> np.ndarray:
    values = np.random.default_rng(0).normal(30.0, 3.0, (8, 3, 5))  # clip view step
    values[2, 1, 3] = values[5, :, 0] = np.nan
    return values


def test_one_seed_gives_what_the_evaluation_printed(images: np.ndarray):
    trajectory = np.array([0, 0, 1, 1, 2, 2, 3, 3])
    printed = summarize(images, trajectory, num_bootstrap=300)

    found = estimate(measured(images, trajectory), 300)

    assert found is not None and found.interval is not None
    assert found.mean == pytest.approx(printed["mean"], rel=1e-12)
    assert found.interval == pytest.approx(printed["ci95"], rel=1e-12)
    assert measured(images, trajectory).per_step() == pytest.approx(printed["per_step"], rel=1e-12)


def test_seeds_count_alike_and_widen_the_interval(images: np.ndarray):
    one = stacked([sums_of(images, np.arange(8))])
    three = stacked([sums_of(images + shift, np.arange(8)) for shift in (-4.0, 0.0, 4.0)])

    single, several = estimate(one, 500), estimate(three, 500)

    assert single and several and single.interval and several.interval
    assert several.mean == pytest.approx(single.mean)
    # The spread of a mean of three draws from (-4, 0, 4) is 1.9; that of the trajectories here is about 0.3.
    assert several.interval[1] - several.interval[0] > 3 * (single.interval[1] - single.interval[0])


def test_a_difference_forgets_what_makes_clips_hard():
    rng = np.random.default_rng(1)
    hard = rng.normal(0.0, 10.0, (12, 1, 1))
    first, second = measured(31.0 + hard + rng.normal(0, 0.1, (12, 2, 4))), measured(30.0 + hard + np.zeros((12, 2, 4)))

    alone, found = estimate(first, 400), difference(first, second, 400)

    assert alone and alone.interval and found and found[0].interval and found[1] == 12
    assert found[0].mean == pytest.approx(1.0, abs=0.1)
    assert 0.9 < found[0].interval[0] < found[0].interval[1] < 1.1
    assert alone.interval[1] - alone.interval[0] > 5.0


def test_a_difference_is_that_of_shared_trajectories():
    values = np.array([[1.0], [2.0], [9.0]])
    other = np.array([[0.5], [np.nan], [8.0]])

    found = difference(measured(values), measured(other), 50)

    assert found is not None and found[1] == 2
    assert found[0].mean == pytest.approx(0.75)
    turned = difference(measured(other), measured(values), 50)
    assert turned is not None and turned[0].mean == pytest.approx(-0.75)
    assert difference(measured(values[:1]), measured(np.full((1, 1), np.nan)), 50) is None


def test_a_difference_compares_the_same_steps_only():
    """A prediction that breaks down late must not gain from the hard steps that it leaves out."""
    values = np.tile(np.array([30.0, 20.0, 10.0]), (4, 1))
    broken = values - 1.0
    broken[:2, 1:] = np.nan

    found = difference(measured(values), measured(broken), 50)

    assert found is not None and found[1] == 4
    assert found[0].mean == pytest.approx(1.0) and found[0].interval == pytest.approx((1.0, 1.0))


def test_an_interval_needs_two_trajectories():
    found = estimate(measured(np.full((3, 2), 7.0), np.zeros(3, dtype=int)), 50)

    assert found == Estimate(7.0, None)
    assert np.isnan(step_band(measured(np.full((3, 2), 7.0), np.zeros(3, dtype=int)), 50)).all()


def test_the_band_of_a_step_is_the_interval_of_that_step_alone(images: np.ndarray):
    low, high = step_band(measured(images), 200)
    printed = summarize(images[..., 1:2], np.arange(8), 200)["ci95"]

    assert (low[1], high[1]) == pytest.approx(printed, rel=1e-12)


def test_intervals_overlap_where_they_share_a_value():
    assert Estimate(1.0, (0.0, 2.0)).overlaps(Estimate(3.0, (2.0, 4.0)))
    assert not Estimate(1.0, (0.0, 2.0)).overlaps(Estimate(3.0, (2.1, 4.0)))
    assert Estimate(1.0, (0.0, 2.0)).overlaps(Estimate(1.5, None))
