"""Adam and its learning rate over the training, as plain settings that a configuration holds."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import nn
from torch.optim.lr_scheduler import LambdaLR

from vpd_lightning.errors import ConfigError


class AbstractOptimization(ABC):
    """Adam with one learning rate per stage, all multiplied by ``lr_factor(step)``.

    A multiplier of 0 freezes a stage.
    """

    def __init__(
        self, *, lr: float, betas: Sequence[float], eps: float, stage_multipliers: Mapping[str, float]
    ) -> None:
        if lr <= 0 or eps <= 0:
            raise ValueError(f"lr and eps must be above 0, got lr={lr}, eps={eps}")
        if len(betas) != 2 or not all(0.0 <= beta < 1.0 for beta in betas):
            raise ValueError(f"betas must be two numbers in [0, 1), got {list(betas)}")
        if any(value < 0 for value in stage_multipliers.values()):
            raise ValueError(f"stage_multipliers must not be negative, got {dict(stage_multipliers)}")
        self.lr, self.betas, self.eps = lr, (float(betas[0]), float(betas[1])), eps
        self.stage_multipliers = dict(stage_multipliers)

    def freeze(self, simulator: nn.Module) -> None:
        """Freeze the stages whose multiplier is 0; else their gradients would be computed, and would count in clipping.

        To be called before DistributedDataParallel wraps the model, because it must know which parameters are trained.

        Raises:
            ConfigError: nothing is left that learns.
        """
        for name, stage in simulator.named_children():
            if self.stage_multipliers.get(name) == 0:
                stage.requires_grad_(False)
        parameters = list(simulator.parameters())
        if parameters and not any(parameter.requires_grad for parameter in parameters):
            raise ConfigError(
                "Nothing learns: optimizer.stage_multipliers freezes (0) every stage that has weights.\n"
                "Give one of them a multiplier above 0."
            )

    @abstractmethod
    def lr_factor(self, step: int, max_steps: int) -> float:
        """Return the factor on all learning rates for the update that follows ``step`` updates."""

    def build(self, simulator: nn.Module, max_steps: int | Callable[[], int]) -> tuple[torch.optim.Optimizer, LambdaLR]:
        """Return the optimiser and its schedule, to be stepped after every update.

        ``max_steps`` is called again for every update where it is a function: a training that ends after a given time
        estimates how many updates that allows.

        Stages are the direct children of the simulator; a stage without a multiplier has 1. Raises ValueError where a
        multiplier other than 1 names no stage.
        """
        optimizer = self.optimizer(self.parameter_groups(simulator))
        # A plain function: a scheduler writes the attributes of other callables into the checkpoint.
        expected = max_steps if callable(max_steps) else lambda: max_steps
        return optimizer, LambdaLR(optimizer, lambda step: self.lr_factor(step, expected()))

    def parameter_groups(self, simulator: nn.Module) -> list[dict[str, Any]]:
        """Return the weights that learn, one group for each stage, with ``lr`` and ``name``."""
        stages = dict(simulator.named_children())
        # Systems have different stages, and the default of 1 for the usual three concerns none of the others.
        unknown = sorted(name for name, value in self.stage_multipliers.items() if value != 1 and name not in stages)
        if unknown:
            raise ValueError(f"stage_multipliers name {unknown[0]!r}, but the stages are {', '.join(stages)}")
        groups: list[dict[str, Any]] = []
        seen: set[int] = set()
        for name, stage in [*stages.items(), ("simulator", simulator)]:
            parameters = [p for p in stage.parameters() if p.requires_grad and id(p) not in seen]
            seen.update(map(id, parameters))
            if parameters:  # a frozen stage has none
                rate = self.lr * self.stage_multipliers.get(name, 1.0)
                groups.append({"params": parameters, "lr": rate, "name": name})
        return groups

    def optimizer(self, groups: list[dict[str, Any]]) -> torch.optim.Optimizer:
        """Build the optimiser of parameter groups."""
        # One pass over each weight: three to six times as fast as the default on a CPU.
        adam = torch.optim.Adam(groups, betas=self.betas, eps=self.eps, fused=True)
        # Lightning refuses to clip gradients before an optimiser that would unscale them itself; let it unscale them.
        adam._step_supports_amp_scaling = False
        return adam


class StepDecayAdam(AbstractOptimization):
    """The learning rate is multiplied by ``gamma`` at each milestone (steps).

    Paper section A.2: 1/3 at 100K and 300K.
    """

    def __init__(
        self, *, lr: float, betas: Sequence[float], eps: float, milestones: Sequence[int], gamma: float
    ) -> None:
        super().__init__(lr=lr, betas=betas, eps=eps, stage_multipliers={})
        if gamma <= 0 or any(milestone < 1 for milestone in milestones):
            raise ValueError(f"gamma must be above 0 and milestones at least 1, got {gamma} and {list(milestones)}")
        self.milestones, self.gamma = sorted(milestones), gamma

    def lr_factor(self, step: int, max_steps: int) -> float:
        """Return gamma to the power of the milestones passed."""
        return self.gamma ** sum(step >= milestone for milestone in self.milestones)


class WarmupCosineAdam(AbstractOptimization):
    """Linear warm-up over ``warmup_steps``, then half a cosine down to ``final_share`` at the last step.

    # Paper: steps down twice over 400K updates; a short training needs a smooth decay.
    """

    def __init__(
        self,
        *,
        lr: float,
        betas: Sequence[float],
        eps: float,
        stage_multipliers: Mapping[str, float],
        warmup_steps: int,
        final_share: float,
    ) -> None:
        super().__init__(lr=lr, betas=betas, eps=eps, stage_multipliers=stage_multipliers)
        if warmup_steps < 0 or not 0.0 <= final_share <= 1.0:
            raise ValueError(
                f"warmup_steps must be at least 0 and final_share in [0, 1], got {warmup_steps} and {final_share}"
            )
        self.warmup_steps, self.final_share = warmup_steps, final_share

    def lr_factor(self, step: int, max_steps: int) -> float:
        """Return min(1, (step + 1) / warm-up) times the cosine from 1 to ``final_share``."""
        warm_up = min(1.0, (step + 1) / self.warmup_steps) if self.warmup_steps else 1.0
        done = min(1.0, max(0.0, (step - self.warmup_steps) / max(1, max_steps - self.warmup_steps)))
        return warm_up * (self.final_share + (1.0 - self.final_share) * 0.5 * (1.0 + math.cos(math.pi * done)))
