"""Solvers: which sequence of actions costs least. They see costs only, of any simulator, learned or true.

``evaluate`` maps candidates (``candidate knot axis``, in [-1, 1]) to their costs. Each solver spends
``num_samples * num_iterations`` of them (MPPI one more); they begin at ``start``, which is a candidate itself.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.errors import ConfigError

Evaluate = Callable[[Float[Tensor, "candidate knot axis"]], Float[Tensor, " candidate"]]


@dataclass(frozen=True)
class Solution:
    """The best candidate that was evaluated, its cost, and the least cost after each iteration."""

    actions: Float[Tensor, "knot axis"]
    cost: float
    history: list[float]


@runtime_checkable
class Solver(Protocol):
    """What ``plan`` asks of a solver."""

    @property
    def num_samples(self) -> int: ...
    @property
    def num_iterations(self) -> int: ...
    def solve(self, evaluate: Evaluate, start: Float[Tensor, "knot axis"], seed: int) -> Solution:
        """Return the best of all evaluated candidates; the same seed draws the same candidates."""


class _Best:
    """Keeps the best candidate that was evaluated."""

    def __init__(self, evaluate: Evaluate) -> None:
        self._evaluate, self.actions, self.cost, self.history = evaluate, None, float("inf"), []  # type: ignore[var-annotated]

    def __call__(self, candidates: Tensor) -> Tensor:
        costs = self._evaluate(candidates)
        # What is not a number must not win; a candidate that leads nowhere costs more than all others.
        costs = torch.nan_to_num(
            costs, nan=torch.finfo(costs.dtype).max / 1e6, posinf=torch.finfo(costs.dtype).max / 1e6
        )
        index = int(costs.argmin())
        if float(costs[index]) < self.cost or self.actions is None:
            self.cost, self.actions = float(costs[index]), candidates[index].clone()
        self.history.append(self.cost)
        return costs

    def solution(self) -> Solution:
        assert self.actions is not None
        return Solution(self.actions, self.cost, self.history)


@dataclass(frozen=True)
class CrossEntropy:
    """Cross-entropy method (Rubinstein 1999): refit a Gaussian to the best candidates, again and again.

    ``spread`` is the first standard deviation, in shares of the range; ``num_elites`` are kept. Of the first candidates
    one is ``start`` and one is to do nothing. There is no package on
    PyPI that brings it alone; that of stable-worldmodel needs a data base (see ``worldmodel``, the adapter for it).
    """

    num_samples: int
    num_iterations: int
    num_elites: int
    spread: float

    def __post_init__(self) -> None:
        if self.num_iterations < 1 or not 1 <= self.num_elites <= self.num_samples or self.spread <= 0:
            raise ValueError(
                "num_iterations must be at least 1, num_elites from 1 to num_samples and spread positive, got "
                f"{self.num_iterations}, {self.num_elites} of {self.num_samples} and {self.spread}"
            )

    def solve(self, evaluate: Evaluate, start: Float[Tensor, "knot axis"], seed: int) -> Solution:
        """Return the best of all evaluated candidates."""
        draw = torch.Generator().manual_seed(seed)
        best = _Best(evaluate)
        mean, spread = start.clone(), torch.full_like(start, self.spread)
        for _ in range(self.num_iterations):
            noise = torch.randn(self.num_samples, *start.shape, generator=draw).to(start)
            candidates = (mean + spread * noise).clamp(-1, 1)
            candidates[0] = mean if best.actions is None else best.actions
            if best.actions is None and len(candidates) > 1:
                candidates[1] = 0  # doing nothing, too: what a plan began may be done
            elites = candidates[best(candidates).argsort()[: self.num_elites]]
            mean, spread = elites.mean(dim=0), elites.std(dim=0, correction=0).clamp(min=0.05)
        return best.solution()


@dataclass(frozen=True)
class PathIntegral:
    """MPPI (Williams et al. 2017), by the package pytorch-mppi; ``temperature`` is in the unit of the cost (metres)."""

    num_samples: int
    num_iterations: int
    spread: float
    temperature: float

    def solve(self, evaluate: Evaluate, start: Float[Tensor, "knot axis"], seed: int) -> Solution:
        """Return the best of all evaluated candidates.

        Raises:
            ConfigError: pytorch-mppi is not installed.
        """
        try:
            from pytorch_mppi import MPPI
        except ImportError as error:
            raise ConfigError(
                "MPPI needs the package pytorch-mppi, which is not installed.\n"
                "pip install vpd-lightning[planning], or plan with CEM: solver=cem."
            ) from error
        best = _Best(evaluate)
        best(start[None])  # the package does not try it without noise
        num_knots, num_axes = start.shape
        # The package rolls states out step by step; a candidate is judged as a whole, once all its actions are known.
        solver = MPPI(
            dynamics=lambda state, action: state,
            running_cost=lambda state, action: torch.zeros_like(state[:, 0]),
            terminal_state_cost=lambda states, actions: best(actions[0]),
            nx=1,
            noise_sigma=self.spread**2 * torch.eye(num_axes, dtype=start.dtype),
            num_samples=self.num_samples,
            horizon=num_knots,
            lambda_=self.temperature,
            u_min=-torch.ones(num_axes, dtype=start.dtype),
            u_max=torch.ones(num_axes, dtype=start.dtype),
            U_init=start.cpu().clone(),
            sample_null_action=False,
            noise_abs_cost=True,
        )
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)  # the package draws from the global generator
            for _ in range(self.num_iterations):
                solver.command(torch.zeros(1, dtype=start.dtype), shift_nominal_trajectory=False)
        return best.solution()


@dataclass(frozen=True)
class RandomShooting:
    """The best of candidates drawn evenly over the whole range: the reference that a solver must beat."""

    num_samples: int
    num_iterations: int

    def solve(self, evaluate: Evaluate, start: Float[Tensor, "knot axis"], seed: int) -> Solution:
        """Return the best of all evaluated candidates; ``start`` says their shape and is not tried."""
        draw = torch.Generator().manual_seed(seed)
        best = _Best(evaluate)
        for _ in range(self.num_iterations):
            best((2 * torch.rand(self.num_samples, *start.shape, generator=draw) - 1).to(start))
        return best.solution()
