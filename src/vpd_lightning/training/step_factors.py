"""A learning rate that falls by another factor at each milestone, wherever the training ends."""

import math
from collections.abc import Mapping, Sequence

from vpd_lightning.training.optimization import AbstractOptimization


class StepFactorsAdam(AbstractOptimization):
    """The learning rate is multiplied by ``factors[i]`` once the share ``milestones[i]`` of the training is done.

    Shares instead of numbers of steps, so that one setting serves trainings of different lengths.
    """

    def __init__(
        self,
        *,
        lr: float,
        betas: Sequence[float],
        eps: float,
        stage_multipliers: Mapping[str, float],
        milestones: Sequence[float],
        factors: Sequence[float],
    ) -> None:
        super().__init__(lr=lr, betas=betas, eps=eps, stage_multipliers=stage_multipliers)
        if len(milestones) != len(factors):
            raise ValueError(
                f"milestones and factors must be as long as each other, got {len(milestones)} and {len(factors)}"
            )
        if not all(0.0 < milestone < 1.0 for milestone in milestones):
            raise ValueError(f"milestones are shares of the training between 0 and 1, got {list(milestones)}")
        if not all(0.0 < factor < math.inf for factor in factors):
            raise ValueError(f"factors must be finite and above 0, got {list(factors)}")
        self.milestones, self.factors = list(milestones), list(factors)

    def lr_factor(self, step: int, max_steps: int) -> float:
        """Return the product of the factors of all milestones passed."""
        passed = [
            factor for share, factor in zip(self.milestones, self.factors, strict=True) if step >= share * max_steps
        ]
        return math.prod(passed)
