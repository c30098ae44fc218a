"""The schedule of SlotFormer's released trainings: warm-up over a share of the training, then one cosine."""

import math
from collections.abc import Mapping, Sequence

from vpd_lightning.training.optimization import AbstractOptimization


class WarmupShareCosineAdam(AbstractOptimization):
    """Linear warm-up over the first ``warmup_share`` of the updates, then half a cosine; both ends are ``end_share``.

    A training of twice as many updates warms up twice as long. SlotFormer (Wu et al., 2023) warms up SAVi over 2.5 %
    and the rollouter over 5 %, from and to a hundredth of the learning rate; the paper names the rates alone.
    """

    def __init__(
        self,
        *,
        lr: float,
        betas: Sequence[float],
        eps: float,
        stage_multipliers: Mapping[str, float],
        warmup_share: float,
        end_share: float,
    ) -> None:
        super().__init__(lr=lr, betas=betas, eps=eps, stage_multipliers=stage_multipliers)
        if not 0.0 <= warmup_share < 1.0 or not 0.0 <= end_share <= 1.0:
            raise ValueError(
                f"warmup_share must be in [0, 1) and end_share in [0, 1], got {warmup_share} and {end_share}"
            )
        self.warmup_share, self.end_share = warmup_share, end_share

    def lr_factor(self, step: int, max_steps: int) -> float:
        """Return ``end_share`` at step 0, 1 at the end of the warm-up and ``end_share`` again at ``max_steps``."""
        warmup_steps = self.warmup_share * max_steps
        if step < warmup_steps:
            rise = step / warmup_steps
        else:
            done = min(1.0, (step - warmup_steps) / max(1.0, max_steps - warmup_steps))
            rise = 0.5 * (1.0 + math.cos(math.pi * done))
        return self.end_share + (1.0 - self.end_share) * rise
