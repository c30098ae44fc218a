"""For each ray, the particles with the smallest score: one contract, brute force as its definition, a compiled twin.

Backend ``torch`` scores every pair of a ray and a particle by matrix products, a bounded number of pairs at a time; it
is the definition, and what runs on a GPU. A kernel there should keep this form (one tile of scores per block of rays
in shared memory, the best in registers) and never write the scores down. Backend ``numba`` cuts the particles into
blocks and scores only those that can hold one of the best (see ``ray_search_numba``).
"""

from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from typing import Any

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vpd_lightning.finite import is_traced, require_finite
from vpd_lightning.renderer.field.precision import at_least_float32, full_precision
from vpd_lightning.renderer.rays.ray_scores import BesideRay, RayScore

CANDIDATE_BACKENDS = ("auto", "torch", "numba")

_PAIRS_PER_CHUNK = {"cpu": 1 << 18, "cuda": 1 << 26}
"""Scores at a time: 1 MB of float32 stays in cache; a GPU wants much to do at once."""


@dataclass(frozen=True)
class Candidates:
    """The best particles of each ray, in no particular order; ``index`` is 0 where ``mask`` is false."""

    index: Int64[Tensor, "batch ray candidate"]
    mask: Bool[Tensor, "batch ray candidate"]


class RaySearch:
    """The particles of a batch, prepared once, to be searched by any number of chunks of rays."""

    def __init__(
        self,
        positions: Float[Tensor, "batch particle 3"],
        valid: Bool[Tensor, "batch particle"],
        backend: str,
    ) -> None:
        """Prepare particles; what is not ``valid`` is never found and may hold anything.

        Raises:
            NonFiniteError: when a valid position is not finite.
            ValueError: when the backend is unknown.
        """
        positions = at_least_float32(positions.detach())
        if is_traced() or not bool(valid.all()):
            positions = torch.where(valid[..., None], positions, 0.0)
        require_finite("Ray search", positions=positions)
        self.backend = resolved_backend(backend, positions.device)
        self._positions, self._valid = positions, valid
        self._prepared: list[Any] = []
        if self.backend == "numba":
            from vpd_lightning.renderer.kernels.ray_search_numba import prepared

            self._prepared = [prepared(p, v) for p, v in zip(positions, valid, strict=True)]

    @torch.no_grad()
    def closest(
        self,
        origins: Float[Tensor, "batch ray 3"],
        directions: Float[Tensor, "batch ray 3"],
        count: int,
        score: RayScore,
    ) -> Candidates:
        """Return the ``count`` best valid particles of each ray; where there are fewer, the rest is masked.

        Raises:
            NonFiniteError: when a ray is not finite.
        """
        dtype = self._positions.dtype
        origins, directions = origins.detach().to(dtype), directions.detach().to(dtype)
        require_finite("Ray search", rays=torch.cat([origins, directions]))
        with full_precision(origins):
            if self.backend == "numba":
                from vpd_lightning.renderer.kernels.ray_search_numba import search

                index = torch.zeros((*origins.shape[:2], count), dtype=torch.int64)
                mask = torch.zeros(index.shape, dtype=torch.bool)
                search(self._prepared, origins, directions, score, index, mask)
                return Candidates(index, mask)
            return _closest_torch(self._positions, self._valid, origins, directions, count, score)


def resolved_backend(backend: str, device: torch.device) -> str:
    """Return ``torch`` or ``numba``; ``auto`` is numba on a CPU where it is installed.

    Raises:
        ValueError: when the backend is unknown, or numba is asked for where it cannot run.
    """
    check_backend(backend)
    has_numba = device.type == "cpu" and _numba_is_installed()
    if backend == "numba" and not has_numba:
        raise ValueError(f"candidate_backend=numba needs numba and the CPU; the device is {device.type}. Take auto.")
    return "numba" if has_numba and backend != "torch" else "torch"


@cache
def _numba_is_installed() -> bool:
    return find_spec("numba") is not None


def check_backend(backend: str) -> None:
    """Refuse a name that is not one of ``CANDIDATE_BACKENDS``.

    Raises:
        ValueError: naming what was given and what is allowed.
    """
    if backend not in CANDIDATE_BACKENDS:
        raise ValueError(f"candidate_backend must be one of {', '.join(CANDIDATE_BACKENDS)}, got {backend!r}.")


def _closest_torch(
    positions: Float[Tensor, "batch particle 3"],
    valid: Bool[Tensor, "batch particle"],
    origins: Float[Tensor, "batch ray 3"],
    directions: Float[Tensor, "batch ray 3"],
    count: int,
    score: RayScore,
) -> Candidates:
    """Score all pairs. The products lose digits: ranks of almost equal scores may swap."""
    batch_size, num_particles = positions.shape[:2]
    num_rays = origins.shape[1]
    index = torch.zeros((batch_size, num_rays, count), dtype=torch.int64, device=positions.device)
    mask = torch.zeros_like(index, dtype=torch.bool)
    found = min(count, num_particles)
    if found == 0 or batch_size == 0:
        return Candidates(index, mask)
    # |p - o|^2 - ((p - o) . d)^2, both as products of [p, |p|^2, 1]; centred, so that little cancels.
    num_valid = valid.sum(dim=1).clamp(min=1)[:, None, None]
    center = torch.where(valid[..., None], positions, 0.0).sum(dim=1, keepdim=True) / num_valid
    p, o = positions - center, origins - center
    one = torch.ones_like(p[..., :1])
    lifted = torch.cat([p, p.square().sum(-1, keepdim=True), one], dim=-1).transpose(1, 2)
    distance = torch.cat([-2 * o, torch.ones_like(o[..., :1]), o.square().sum(-1, keepdim=True)], dim=-1)
    along_ray = -(o * directions).sum(-1, keepdim=True)
    depth = torch.cat([directions, torch.zeros_like(along_ray), along_ray], dim=-1)
    hidden = ~valid[:, None] if is_traced() or not bool(valid.all()) else None
    step = max(1, _PAIRS_PER_CHUNK.get(positions.device.type, 1 << 22) // (batch_size * num_particles))
    for start in range(0, num_rays, step):
        chunk = slice(start, start + step)
        along = depth[:, chunk] @ lifted
        beside = torch.baddbmm(along.square(), distance[:, chunk], lifted, beta=-1)
        if hidden is not None:
            beside.masked_fill_(hidden, torch.inf)
        scores = _scores(along, beside, score)
        chosen = smallest(scores.flatten(0, 1), found).unflatten(0, scores.shape[:2])
        index[:, chunk, :found] = chosen
        mask[:, chunk, :found] = scores.gather(-1, chosen) < torch.inf
    return Candidates(index.masked_fill_(~mask, 0), mask)


def _scores(along: Tensor, beside: Tensor, score: RayScore) -> Tensor:
    """Turn distances along and squared distances beside the rays into scores; both inputs are used up."""
    if isinstance(score, BesideRay):
        return beside.masked_fill_((along < score.near) | (along > score.far), torch.inf)
    beside.masked_fill_(along < score.near, torch.inf)
    first = (beside - score.width**2).clamp_(min=0).mul_(score.steepness).add_(along).amin(dim=-1, keepdim=True)
    behind = along.sub_(first + score.depth).clamp_(min=0)
    return beside.addcmul_(behind, behind, value=0.04)


def smallest(scores: Float[Tensor, "ray particle"], count: int) -> Int64[Tensor, "ray candidate"]:
    """Return the indices of the ``count`` smallest scores of each row, in no order; exact.

    The smallest lie in the ``count`` groups of eight whose best is smallest: most scores only pass through a minimum.
    """
    num_rays, num_particles = scores.shape
    count, group = min(count, num_particles), 8
    if num_particles < 4 * count * group // 2:
        return scores.topk(count, dim=-1, largest=False, sorted=False).indices
    padding = -num_particles % group
    groups = torch.nn.functional.pad(scores, (0, padding), value=float("inf")).view(num_rays, -1, group)
    best = groups.amin(dim=-1).topk(count, dim=-1, largest=False, sorted=False).indices
    members = torch.gather(groups, 1, best[..., None].expand(-1, -1, group)).flatten(1)
    chosen = members.topk(count, dim=-1, largest=False, sorted=False).indices
    return torch.gather(best, 1, chosen // group) * group + chosen % group
