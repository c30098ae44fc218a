"""Scenes in which nothing moves and nothing is about to be pushed are left alone."""

from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vpd_lightning.dynamics.inertial.body_motion import BodyMotion
from vpd_lightning.dynamics.inertial.contact import Resolved
from vpd_lightning.randomness import RandomKeys

Tree = TypeVar("Tree")


def is_slow(motion: BodyMotion, speed: float, arm: float) -> Bool[Tensor, "batch body"]:
    """Return which bodies move by less than ``speed`` (metres per step); a spin counts at ``arm`` (metres)."""
    square = motion.displacements.square().sum(dim=-1) + arm**2 * motion.spins.square().sum(dim=-1)
    return square < speed**2


def rested(resolved: Resolved, slowest: float, arm: float) -> tuple[BodyMotion, BodyMotion]:
    """Stop bodies in contact that move by less than ``slowest`` in a step (metres; a rotation counts at ``arm``).

    Networks are never exactly zero, and a body at rest would creep; like static friction, this suppresses small
    motion.
    """
    if slowest == 0:
        return resolved.step, resolved.onward
    gated = []
    for motion in (resolved.step, resolved.onward):
        square = motion.displacements.square().sum(dim=-1, keepdim=True)
        square = square + arm**2 * motion.spins.square().sum(dim=-1, keepdim=True)
        share = torch.where(resolved.touching, square / (square + slowest**2), 1.0)
        gated.append(replace(motion, displacements=motion.displacements * share, spins=motion.spins * share))
    return gated[0], gated[1]


def rows_of(tree: Tree, rows: Int64[Tensor, " row"], count: int) -> Tree:
    """Return some members of tensors and dataclasses of tensors whose batch axis has ``count`` members."""
    value: Any = tree
    if isinstance(value, Tensor):
        return value.index_select(0, rows) if value.dim() and len(value) == count else value  # type: ignore[return-value]
    if isinstance(value, RandomKeys):
        return replace(value, sample_index=[value.sample_index[row] for row in rows.tolist()])  # type: ignore[return-value]
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{item.name: rows_of(getattr(value, item.name), rows, count) for item in fields(value)})  # type: ignore[return-value]
    return tree


def with_rows(tree: Tree, rows: Int64[Tensor, " row"], new: Tree, count: int) -> Tree:
    """Return the members of ``tree`` with those at ``rows`` replaced by those of ``new``; what is the same stays."""
    value, other = tree, new
    old: Any = value
    if isinstance(old, Tensor) and isinstance(other, Tensor):
        return old.index_copy(0, rows, other.to(old.dtype)) if old.dim() and len(old) == count else old  # type: ignore[return-value]
    if is_dataclass(old) and not isinstance(old, type):
        parts = {
            item.name: with_rows(getattr(old, item.name), rows, getattr(other, item.name), count)
            for item in fields(old)
        }
        return replace(old, **parts)  # type: ignore[return-value]
    return tree


def members_in_use(bodies: Float[Tensor, "batch body moving"]) -> Bool[Tensor, "batch body"]:
    """Return which places for bodies hold one."""
    return bodies.sum(dim=-1) > 0
