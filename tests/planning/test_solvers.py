"""Solvers on costs with a known minimum."""

from typing import Any

import pytest
import torch
from torch import Tensor

from vpd_lightning.errors import ConfigError
from vpd_lightning.planning.solvers import CrossEntropy, PathIntegral, RandomShooting

GOAL = torch.tensor([[0.5, -0.5], [0.2, 0.1], [-0.4, 0.8]])
SOLVERS = {
    "cem": CrossEntropy(num_samples=40, num_iterations=12, num_elites=6, spread=0.6),
    "mppi": PathIntegral(num_samples=40, num_iterations=12, spread=0.3, temperature=0.02),
    "random": RandomShooting(num_samples=40, num_iterations=12),
}


def distance(candidates: Tensor) -> Tensor:
    return (candidates - GOAL).square().mean(dim=(1, 2)).sqrt()


@pytest.mark.parametrize("name", SOLVERS)
def test_it_comes_near_the_minimum_and_says_what_it_found(name: str) -> None:
    tried: list[Tensor] = []

    def evaluate(candidates: Tensor) -> Tensor:
        tried.append(candidates)
        return distance(candidates)

    found = SOLVERS[name].solve(evaluate, torch.zeros(3, 2), seed=0)
    assert sum(map(len, tried)) == 480 + (name == "mppi") and len(found.history) == 12 + (name == "mppi")
    assert found.cost == pytest.approx(float(distance(found.actions[None])), abs=1e-6)
    assert found.history == sorted(found.history, reverse=True) and found.history[-1] == found.cost
    assert found.cost < {"cem": 0.1, "mppi": 0.2, "random": 0.45}[name]
    assert all(bool((part.abs() <= 1 + 1e-6).all()) for part in tried)


@pytest.mark.parametrize("name", SOLVERS)
def test_the_same_seed_gives_the_same_and_global_randomness_is_untouched(name: str) -> None:
    torch.manual_seed(5)
    first = SOLVERS[name].solve(distance, torch.zeros(3, 2), seed=1)
    drawn = torch.rand(3)
    torch.manual_seed(5)
    assert torch.equal(drawn, torch.rand(3))
    assert torch.equal(first.actions, SOLVERS[name].solve(distance, torch.zeros(3, 2), seed=1).actions)
    assert not torch.equal(first.actions, SOLVERS[name].solve(distance, torch.zeros(3, 2), seed=2).actions)


@pytest.mark.parametrize("name", ["cem", "mppi"])
def test_a_start_is_never_made_worse(name: str) -> None:
    near = GOAL + 0.01
    found = SOLVERS[name].solve(distance, near, seed=0)
    assert found.cost <= float(distance(near[None]))


@pytest.mark.parametrize("name", SOLVERS)
def test_what_is_not_a_number_never_wins(name: str) -> None:
    def broken(candidates: Tensor) -> Tensor:
        return torch.where(candidates[:, 0, 0] > 0, torch.nan, distance(candidates))

    found = SOLVERS[name].solve(broken, torch.zeros(3, 2), seed=0)
    assert torch.isfinite(found.actions).all() and found.cost < 10 and found.actions[0, 0] <= 0


@pytest.mark.parametrize(
    "change", [{"num_elites": 0}, {"num_elites": 41}, {"num_iterations": 0}, {"spread": 0.0}], ids=str
)
def test_numbers_out_of_range_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="num_elites from 1 to num_samples"):
        CrossEntropy(**{"num_samples": 40, "num_iterations": 3, "num_elites": 4, "spread": 0.5, **change})


def test_without_the_package_mppi_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "pytorch_mppi", None)
    with pytest.raises(ConfigError, match=r"pip install vpd-lightning\[planning\]"):
        SOLVERS["mppi"].solve(distance, torch.zeros(3, 2), seed=0)


def test_the_cross_entropy_method_tries_what_it_starts_from_and_to_do_nothing() -> None:
    tried: list[Tensor] = []

    def evaluate(candidates: Tensor) -> Tensor:
        tried.append(candidates.clone())
        return candidates.square().sum(dim=(1, 2))  # nothing is cheaper than doing nothing

    found = CrossEntropy(num_samples=8, num_iterations=1, num_elites=2, spread=0.7).solve(evaluate, GOAL.clone(), 0)
    assert torch.equal(tried[0][0], GOAL) and not tried[0][1].any()
    assert found.cost == 0 and not found.actions.any()
