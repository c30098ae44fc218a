"""The Pareto front, fitted exponents, and pictures."""

from pathlib import Path

import pytest

from benchmarks import plots
from benchmarks.measuring import row
from benchmarks.plots import Point, fitted_exponent, pareto_front


def is_picture(path: Path) -> bool:
    return path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 5000


def test_pareto_front_holds_what_nothing_beats_in_both():
    fast, good, beaten, equal = (
        Point("a", 1, 9, None),
        Point("b", 4, 1, None),
        Point("c", 5, 2, None),
        Point("d", 4, 3, None),
    )
    middle = Point("e", 2, 5, None)

    assert pareto_front([beaten, good, equal, middle, fast]) == [fast, middle, good]
    assert pareto_front([]) == []


def test_no_point_beats_a_point_of_the_front():
    points = [Point(str(n), (7 * n) % 11 + 1, (5 * n) % 13 + 1, None) for n in range(40)]

    front = pareto_front(points)

    for kept in front:
        assert not [p for p in points if p.seconds <= kept.seconds and p.error < kept.error]
        assert not [p for p in points if p.seconds < kept.seconds and p.error <= kept.error]
    for point in points:
        assert any(kept.seconds <= point.seconds and kept.error <= point.error for kept in front)


@pytest.mark.parametrize(("exponent", "factor"), [(1.0, 3.0), (0.5, 0.01), (2.0, 1e-6)])
def test_fitted_exponent_finds_a_power_law(exponent: float, factor: float):
    sizes = [2.0**power for power in range(12, 18)]

    found = fitted_exponent(sizes, [factor * size**exponent for size in sizes])

    assert found == pytest.approx((exponent, factor), rel=1e-9)


def test_fitted_exponent_refuses_what_has_no_logarithm():
    with pytest.raises(ValueError, match="power law"):
        fitted_exponent([1.0, 2.0], [0.0, 1.0])
    with pytest.raises(ValueError, match="power law"):
        fitted_exponent([1.0], [1.0])


def test_time_error_picture_is_drawn_with_and_without_truth(tmp_path: Path):
    default = Point("default", 2e-3, 1e-3, 25.0, True)
    knobs = {"samples": [Point("8", 1e-3, 1e-2, 24.0), default], "exact": [default, Point("off", 3e-3, 0.0, None)]}

    plots.time_error({"a model": knobs, "untrained": {"samples": [Point("8", 1e-3, 1e-2, None)]}}, tmp_path / "a.png")

    assert is_picture(tmp_path / "a.png")


def test_bars_and_scaling_are_drawn(tmp_path: Path):
    plots.bars([row("a", [0.1]), row("b", [0.2], "a", [0.1], peak_bytes=2**20)], "title", tmp_path / "bars.png")
    plots.scaling({"time": {"step": ([1.0, 2.0, 4.0], [1.0, 2.1, 4.2])}}, tmp_path / "scaling.png")

    assert is_picture(tmp_path / "bars.png")
    assert is_picture(tmp_path / "scaling.png")
