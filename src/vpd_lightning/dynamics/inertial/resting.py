"""Scenes in which nothing moves and nothing is about to be pushed are left alone."""

from dataclasses import replace
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vpd_lightning.dynamics.inertial.body_motion import BodyMotion
from vpd_lightning.dynamics.inertial.contact import Resolved
from vpd_lightning.types import mapped_tensors

Tree = TypeVar("Tree")


def is_slow(motion: BodyMotion, speed: float, arm: float) -> Bool[Tensor, "batch body"]:
    """Return which bodies move by less than ``speed`` (metres per step); a spin counts at ``arm`` (metres)."""
    square = motion.displacements.square().sum(dim=-1) + arm**2 * motion.spins.square().sum(dim=-1)
    return square < speed**2


def held(motion: BodyMotion, undisturbed: Bool[Tensor, "batch body"]) -> BodyMotion:
    """Return the motion with none of bodies that are still undisturbed: what was seen to stand is in balance.

    That is known better than where its weight acts and on what: both are guesses about its hidden side, and with them
    most bodies would tip.
    """
    moves = ~undisturbed[..., None]
    return replace(
        motion,
        displacements=motion.displacements * moves,
        spins=motion.spins * moves,
        strains=motion.strains * moves[..., None],
    )


def rested(
    resolved: Resolved, slowest: float, arm: float, guided: Float[Tensor, "batch body 1"] | None
) -> tuple[BodyMotion, BodyMotion]:
    """Stop bodies in contact that move by less than ``slowest`` in a step (metres; a rotation counts at ``arm``).

    Networks are never exactly zero, and a body at rest would creep; like static friction, this suppresses small
    motion, but for the share of it that is ``guided``.
    """
    if slowest == 0:
        return resolved.step, resolved.onward
    gated = []
    for motion in (resolved.step, resolved.onward):
        square = motion.displacements.square().sum(dim=-1, keepdim=True)
        square = square + arm**2 * motion.spins.square().sum(dim=-1, keepdim=True)
        share = torch.where(resolved.touching, square / (square + slowest**2), 1.0)
        if guided is not None:
            share = share + guided * (1 - share)
        gated.append(replace(motion, displacements=motion.displacements * share, spins=motion.spins * share))
    return gated[0], gated[1]


def rows_of(tree: Tree, rows: Int64[Tensor, " row"], count: int) -> Tree:
    """Return some members of tensors and dataclasses of tensors whose batch axis has ``count`` members."""

    def taken(values: Tensor) -> Tensor:
        if not values.dim() or len(values) != count:
            return values
        if values.stride(0) == 0:  # one for all, which no copy is needed of
            return values[:1].expand(len(rows), *values.shape[1:])
        return values.index_select(0, rows)

    return mapped_tensors(taken, tree)  # type: ignore[no-any-return]


def with_rows(tree: Tree, rows: Int64[Tensor, " row"], old: Tree, new: Tree, count: int) -> Tree:
    """Return the members of ``tree`` with those at ``rows`` replaced by ``new``, made of ``old`` (``rows_of``).

    Tensors that ``new`` has from ``old`` stay what they are: most describe what stands still, and copies of them took
    longer than a step.
    """

    def put(values: Tensor, before: Tensor, after: Tensor) -> Tensor:
        if after is before or not values.dim() or len(values) != count:
            return values
        return values.index_copy(0, rows, after.to(values.dtype))

    return mapped_tensors(put, tree, old, new)  # type: ignore[no-any-return]


def members_in_use(bodies: Float[Tensor, "batch body moving"]) -> Bool[Tensor, "batch body"]:
    """Return which places for bodies hold one."""
    return bodies.sum(dim=-1) > 0
