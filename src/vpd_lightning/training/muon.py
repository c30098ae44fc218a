"""Muon for matrices and Adam for all other weights, as one optimiser.

Muon (Jordan et al. 2024, https://kellerjordan.github.io/posts/muon) takes the momentum of a matrix's gradient and makes
it orthogonal before the step: all its singular values become one. The part of the pixel
gradient that all particles have in common is the largest by far: it dominates a step of Adam, but not one of Muon.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from vpd_lightning.training.optimization import WarmupCosineAdam

MIN_WIDTH = 16
"""Weights with fewer rows or columns (layers from or to a place in space, say) are left to Adam."""


class WarmupCosineMuon(WarmupCosineAdam):
    """``WarmupCosineAdam`` with Muon, at ``muon_lr``, for matrices of at least 16 rows and columns; null: Adam for all.

    Both rates follow the same schedule and the same multipliers. Muon's step has the root mean square that Adam's
    would have (PyTorch's ``match_rms_adamw``), so that rates can be compared; no weight decay.

    # Paper: Adam for all weights.
    """

    def __init__(
        self,
        *,
        lr: float,
        muon_lr: float | None,
        muon_momentum: float,
        betas: Sequence[float],
        eps: float,
        stage_multipliers: Mapping[str, float],
        warmup_steps: int,
        final_share: float,
    ) -> None:
        super().__init__(
            lr=lr,
            betas=betas,
            eps=eps,
            stage_multipliers=stage_multipliers,
            warmup_steps=warmup_steps,
            final_share=final_share,
        )
        if (muon_lr is not None and muon_lr <= 0) or not 0.0 <= muon_momentum < 1.0:
            raise ValueError(
                f"muon_lr must be above 0 or null and muon_momentum in [0, 1), got {muon_lr} and {muon_momentum}"
            )
        self.muon_lr, self.muon_momentum = muon_lr, muon_momentum

    def optimizer(self, groups: list[dict[str, Any]]) -> torch.optim.Optimizer:
        """Build Muon for the matrices of the groups and Adam for their other weights."""
        if self.muon_lr is None:
            return super().optimizer(groups)
        divided = []
        for group in groups:
            matrices = [p for p in group["params"] if p.ndim == 2 and min(p.shape) >= MIN_WIDTH]
            chosen = set(map(id, matrices))
            others = [p for p in group["params"] if id(p) not in chosen]
            rate = group["lr"] * self.muon_lr / self.lr
            if matrices:
                divided.append({**group, "params": matrices, "lr": rate, "is_matrix": True})
            if others:
                divided.append({**group, "params": others, "is_matrix": False})
        return MuonAndAdam(divided, momentum=self.muon_momentum, betas=self.betas, eps=self.eps)


class MuonAndAdam(torch.optim.Optimizer):
    """Groups with ``is_matrix`` step by Muon, the others by Adam; state and groups are those of one optimiser."""

    def __init__(
        self, groups: Iterable[dict[str, Any]], *, momentum: float, betas: tuple[float, float], eps: float
    ) -> None:
        groups = [dict(group) for group in groups]
        rate = groups[0]["lr"]
        matrices = [group for group in groups if group["is_matrix"]]
        others = [group for group in groups if not group["is_matrix"]]
        self._muon = (
            torch.optim.Muon(matrices, rate, 0.0, momentum, adjust_lr_fn="match_rms_adamw") if matrices else None
        )
        self._adam = torch.optim.Adam(others, rate, betas, eps, fused=True) if others else None
        # With the defaults that both have filled in.
        super().__init__([group for part in self._parts() for group in part.param_groups], {"lr": rate})
        self._share()

    def _parts(self) -> list[torch.optim.Optimizer]:
        return [part for part in (self._muon, self._adam) if part is not None]

    def _share(self) -> None:
        """Let both work on the groups and the state of this one, which is what schedules and checkpoints see."""
        for part, is_matrix in ((self._muon, True), (self._adam, False)):
            if part is not None:
                part.param_groups = [group for group in self.param_groups if group["is_matrix"] == is_matrix]
                part.state = self.state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from a stored state."""
        super().load_state_dict(state_dict)
        self._share()

    @torch.no_grad()
    def step(self, closure: Callable[[], Tensor] | None = None) -> Tensor | None:  # type: ignore[override]
        """Take a step with both."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for part in self._parts():
            part.step()
        return loss
