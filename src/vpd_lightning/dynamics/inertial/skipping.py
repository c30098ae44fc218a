"""What needs no step of its own: members of a batch in which all rests, and members that were one and still are alike.

Candidate motions from one moment have the same past until what is driven touches a body: one step serves all of them.
"""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vpd_lightning.dynamics.inertial.contact_step import about_to_be_pushed
from vpd_lightning.dynamics.inertial.memory import InertialMemory
from vpd_lightning.dynamics.inertial.resting import rows_of, with_rows
from vpd_lightning.types import Driven, Particles, mapped_tensors

State = tuple[Particles, InertialMemory]
Step = Callable[[Particles, InertialMemory], State]
Touches = Callable[[Particles, InertialMemory, Driven, Int64[Tensor, " batch"]], Bool[Tensor, " batch"]]


def step_where_it_moves(
    step: Step,
    touches: Touches,
    current: Particles,
    memory: InertialMemory,
    positions: Float[Tensor, "batch moving 3"],
    driven: Driven | None,
    *,
    is_mirrored: bool,
    has_all_sides: bool,
) -> State:
    """Advance the members of the batch in which something moves or is about to be pushed.

    Args:
        step: advances a batch.
        touches: whether something driven touches a body in this step; its arguments are states, one for all that are
            alike, the driven motion of each member, and which state is that member's.
        current: particles of all members.
        memory: that of all members.
        positions: of the moving candidates, from the memory's origin.
        driven: what is driven, with its next place.
        is_mirrored: whether bodies have mirror images.
        has_all_sides: false where hidden sides are yet to be guessed, without which no member can stay as it is.
    """
    count, is_idle = len(current.mask), memory.at_rest.all(dim=1)
    if driven is not None and bool(is_idle.any()):
        idle = is_idle.nonzero()[:, 0]
        parts = rows_of((driven, positions, memory), idle, count)
        is_idle = is_idle.index_put((idle,), ~about_to_be_pushed(*parts, is_mirrored=is_mirrored))
    if not has_all_sides:
        is_idle = torch.zeros_like(is_idle)
    rows = (~is_idle).nonzero()[:, 0]
    if len(rows) == 0:
        return current, memory
    unused = memory.past.max() + 1 + torch.arange(count, device=memory.past.device)
    given = current, memory, positions, driven, unused
    if len(rows) == count:
        return _step_of_alike(step, touches, *given)
    some = rows_of(given, rows, count)
    return with_rows((current, memory), rows, some[:2], _step_of_alike(step, touches, *some), count)


def _step_of_alike(
    step: Step,
    touches: Touches,
    current: Particles,
    memory: InertialMemory,
    positions: Tensor,
    driven: Driven | None,
    unused: Int64[Tensor, " batch"],
) -> State:
    """Advance one of all that are alike and touch nothing driven, and each of the others.

    ``unused`` are numbers of pasts that no member has, of those that are left out neither.
    """
    count = len(current.mask)
    own = torch.arange(count, device=memory.past.device)
    source = _first_alike(memory, positions)
    if bool((source == own).all()):
        return step(current, memory)
    past = memory.past
    if driven is not None:
        rows, place = torch.unique(source, return_inverse=True)
        touched = touches(*rows_of((current, memory), rows, count), driven, place)
        # Two that were one go apart: each has a past of its own from here on.
        past = torch.where(touched, unused, past)
        source = torch.where(touched, own, _first_alike(replace(memory, past=past), positions))
    rows, place = torch.unique(source, return_inverse=True)
    few, before = rows_of((current, memory), rows, count)
    following, onward = step(few, before)

    def given_back(values: Tensor) -> Tensor:
        return values.index_select(0, place) if values.dim() and len(values) == len(rows) else values

    def kept_or_given_back(whole: Tensor, old: Tensor, new: Tensor) -> Tensor:
        return whole if new is old else given_back(new)  # most of a memory never changes, and copies of it take long

    following = replace(mapped_tensors(given_back, replace(following, driven=None)), driven=current.driven)
    onward = mapped_tensors(kept_or_given_back, memory, before, onward)
    return following, replace(onward, past=past)


def _first_alike(memory: InertialMemory, positions: Tensor) -> Int64[Tensor, " batch"]:
    """Return for each member the first one with its past."""
    count = len(memory.past)
    own = torch.arange(count, device=memory.past.device)
    numbers, group = torch.unique(memory.past, return_inverse=True)
    if len(numbers) == count:
        return own
    first = torch.full_like(numbers, count).scatter_reduce(0, group, own, "amin")[group]
    # Particles may have been changed by hand since they were branched.
    is_same = (positions == positions[first]).flatten(1).all(dim=1)
    return torch.where(is_same, first, own)
