"""Sleeping particles, as physics engines have them: what has come to rest costs nothing until something comes near."""

import math
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vpd_lightning.dynamics.base import AbstractDynamics
from vpd_lightning.dynamics.support import on_ground, within_reach
from vpd_lightning.graph.neighbors import BACKENDS
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Driven, Particles

_INNER = "dynamics."


@runtime_checkable
class HasAbstractNodes(Protocol):
    """A dynamics whose step can be made with fewer abstract nodes, where it is given fewer particles."""

    num_abstract_nodes: int

    def advance(
        self, previous: Particles, current: Particles, keys: RandomKeys, rollout_step: int, num_abstract_nodes: int
    ) -> Particles:
        """Return the particles of the next step."""


@dataclass(frozen=True)
class SleepingMemory:
    """Which particles sleep, for how many steps each has been at rest, and where its rest began (metres)."""

    inner: Any  # the memory of the wrapped dynamics
    asleep: Bool[Tensor, "batch particle"]
    num_rested: Int64[Tensor, "batch particle"]
    rest_positions: Float[Tensor, "batch particle 3"]


class SleepingDynamics(AbstractDynamics):
    """Wraps any dynamics and does not update particles at rest.

    All particles start awake; an edit rebuilds the memory, and everything is awake again. A particle falls asleep when

    - it rested for ``rest_steps`` steps: each no longer than ``rest_speed`` and all together no longer than
      ``rest_drift`` (both in units of ``location_scale`` metres), so that what slides slowly but steadily, faster than
      ``rest_drift / rest_steps`` a step, stays awake;
    - it is supported: it belongs to an island, linked by distances up to ``link_radius``, that is at least
      ``ground_width`` wide. A body in flight (at its apex, or with its floor deleted) is an island by itself;
    - nothing that moves faster than ``rest_speed``, driven or not, is within ``wake_radius`` of it, now or one such
      step ahead.

    A sleeping particle keeps its position bit for bit. It wakes when something that moves comes within
    ``wake_radius``; take it larger than a body and a step, then bodies wake as a whole and before contact.

    How a step is saved depends on the wrapped dynamics. One without memory is given the awake particles and, as
    context, those asleep within ``context_radius`` of them; where it has abstract nodes, it takes so many fewer of them
    that they are as dense as in training. Context takes the change of features that the wrapped dynamics gives it (a
    shadow moves over a sleeping floor) unless ``freeze_features``; sleepers beyond keep their features. A dynamics with
    a memory, which describes all particles, cannot be given a part of them: there a scene falls asleep as a whole, once
    all particles that may move are at rest and supported. When all sleep, no step is made at all. Members of a batch
    sleep independently of each other; once one of them does, steps are made member by member.

    With ``return_to_rest`` a particle that falls asleep returns to where its rest began: what it drifted since was
    noise by the first condition. While training nothing sleeps, unless ``in_training``.

    The state dict is that of the wrapped dynamics: a checkpoint trained without sleeping is read with it, and the other
    way round.

    ``last_awake_share`` is the share of the particles that were awake in the last call, ``last_active_share`` the share
    that was computed: awake or context.
    """

    # Paper: every particle takes part in every step; this is approximate and off in the paper's configuration.

    def __init__(
        self,
        *,
        dynamics: AbstractDynamics,
        location_scale: float,
        rest_speed: float,
        rest_drift: float,
        rest_steps: int,
        wake_radius: float,
        context_radius: float,
        link_radius: float,
        ground_width: float,
        freeze_features: bool,
        return_to_rest: bool,
        in_training: bool,
        neighbors_backend: str,
    ) -> None:
        super().__init__()
        lengths = {
            "location_scale": location_scale,
            "rest_speed": rest_speed,
            "rest_drift": rest_drift,
            "wake_radius": wake_radius,
            "context_radius": context_radius,
            "link_radius": link_radius,
            "ground_width": ground_width,
        }
        for name, value in lengths.items():
            if not value > 0:
                raise ValueError(f"{name} must be greater than 0, got {value}.")
        if rest_steps < 1:
            raise ValueError(f"rest_steps must be at least 1, got {rest_steps}.")
        if neighbors_backend not in ("auto", *BACKENDS):
            raise ValueError(f"neighbors_backend must be auto or one of {BACKENDS}, got {neighbors_backend!r}.")
        self.dynamics = dynamics
        self.rest_speed, self.rest_drift = rest_speed * location_scale, rest_drift * location_scale
        self.rest_steps = rest_steps
        self.wake_radius, self.context_radius = float(wake_radius), float(context_radius)
        self.link_radius, self.ground_width = float(link_radius), float(ground_width)
        self.freeze_features, self.return_to_rest, self.in_training = freeze_features, return_to_rest, in_training
        self.neighbors_backend = neighbors_backend
        self.last_awake_share = 1.0
        self.last_active_share = 1.0
        self.register_state_dict_post_hook(_without_inner_prefix)
        self.register_load_state_dict_pre_hook(_with_inner_prefix)

    @property
    def last_uncovered_share(self) -> Tensor | None:
        """That of the wrapped dynamics, where it has one."""
        return getattr(self.dynamics, "last_uncovered_share", None)

    def initialize(self, previous: Particles, current: Particles, keys: RandomKeys) -> SleepingMemory:
        """Wake everything and build the memory of the wrapped dynamics."""
        return SleepingMemory(
            inner=self.dynamics.initialize(previous, current, keys),
            asleep=torch.zeros_like(current.mask),
            num_rested=torch.zeros_like(current.mask, dtype=torch.int64),
            rest_positions=current.positions.detach(),
        )

    def forward(
        self, previous: Particles, current: Particles, memory: SleepingMemory, keys: RandomKeys, rollout_step: int
    ) -> tuple[Particles, SleepingMemory]:
        """Advance what is awake by one step, then decide who falls asleep and who wakes.

        Raises:
            ValueError: the memory is that of other particles; after an edit it must be rebuilt by ``initialize``.
        """
        if memory.asleep.shape != current.mask.shape:
            raise ValueError(
                f"the memory is of {tuple(memory.asleep.shape)} particles, but there are {tuple(current.mask.shape)}: "
                "rebuild it with initialize after an edit"
            )
        if current.driven is not None and bool(memory.asleep.any()):
            memory = self._woken(current, current.driven, memory)
        awake = current.mask & ~memory.asleep
        num_valid = current.mask.sum().clamp(min=1)
        self.last_awake_share = self.last_active_share = float(awake.sum() / num_valid)
        if bool(memory.asleep.any()) and not bool(awake.any()):
            return current, memory
        inner = memory.inner
        if inner is None and bool(memory.asleep.any()):
            following, num_active = self._advance_members(previous, current, awake, keys, rollout_step)
            self.last_active_share = float(num_active / num_valid)
        else:
            following, inner = self.dynamics(previous, current, inner, keys, rollout_step)
            following = _kept(following, current, memory.asleep)
        memory = replace(memory, inner=inner)
        if current.mask.numel() == 0 or (self.training and not self.in_training):
            return following, memory
        settled = self._settle(current, following, awake, memory)
        if self.return_to_rest:
            fallen = (settled.asleep & ~memory.asleep)[..., None]
            positions = torch.where(fallen, settled.rest_positions, following.positions)
            following = replace(following, positions=positions)
        return following, settled

    @torch.no_grad()
    def _woken(self, current: Particles, driven: Driven, memory: SleepingMemory) -> SleepingMemory:
        """Wake what a driven point comes near in this step; a dynamics with a memory wakes whole scenes."""
        following = driven.advanced().positions
        moving = driven.mask & (_length(following - driven.positions) > self.rest_speed)
        asleep = memory.asleep.clone()
        for member, movers in enumerate(moving):
            if not bool(movers.any()) or not bool(asleep[member].any()):
                continue
            path = torch.cat([driven.positions[member][movers], following[member][movers]])
            sleepers = asleep[member].nonzero()[:, 0]
            near = within_reach(current.positions[member][sleepers], path, self.wake_radius, self.neighbors_backend)
            asleep[member, sleepers] = ~near if memory.inner is None else ~near.any().expand_as(near)
        woken = memory.asleep & ~asleep
        return replace(memory, asleep=asleep, num_rested=memory.num_rested.masked_fill(woken, 0))

    def _advance_members(
        self, previous: Particles, current: Particles, awake: Tensor, keys: RandomKeys, rollout_step: int
    ) -> tuple[Particles, int]:
        """Advance the awake particles of each member, with the sleeping ones around them as context that stays."""
        positions, features = list(current.positions), list(current.features)
        num_active = 0
        for member, (valid, up) in enumerate(zip(current.mask, awake, strict=True)):
            if not bool(up.any()):
                continue
            index = self._with_context(positions[member].detach(), valid, up)
            num_active += len(index)
            before, now = _taken(previous, member, index), _taken(current, member, index)
            own = replace(keys, sample_index=[keys.sample_index[member]])
            after = self._advance(before, now, own, rollout_step, int(valid.sum()))
            moves = up[index][:, None]
            positions[member] = positions[member].index_copy(
                0, index, torch.where(moves, after.positions[0], now.positions[0])
            )
            changes = moves if self.freeze_features else torch.ones_like(moves)
            features[member] = features[member].index_copy(
                0, index, torch.where(changes, after.features[0], now.features[0])
            )
        return replace(current, positions=torch.stack(positions), features=torch.stack(features)), num_active

    def _with_context(
        self, positions: Float[Tensor, "particle 3"], valid: Bool[Tensor, " particle"], awake: Bool[Tensor, " particle"]
    ) -> Int64[Tensor, " active"]:
        sleepers = (valid & ~awake).nonzero()[:, 0]
        active = awake.clone()
        active[sleepers] = within_reach(
            positions[sleepers], positions[awake], self.context_radius, self.neighbors_backend
        )
        return active.nonzero()[:, 0]

    def _advance(
        self, previous: Particles, current: Particles, keys: RandomKeys, rollout_step: int, num_valid: int
    ) -> Particles:
        """Advance some of ``num_valid`` particles, with abstract nodes as dense as they are among all."""
        num_active = current.num_particles
        if num_active < num_valid and isinstance(self.dynamics, HasAbstractNodes):
            num_nodes = min(self.dynamics.num_abstract_nodes, num_valid) * num_active / num_valid
            return self.dynamics.advance(previous, current, keys, rollout_step, math.ceil(num_nodes))
        return self.dynamics(previous, current, None, keys, rollout_step)[0]

    @torch.no_grad()
    def _settle(
        self, current: Particles, following: Particles, awake: Tensor, memory: SleepingMemory
    ) -> SleepingMemory:
        """Count who rests, put to sleep who rested long enough, and wake who has a moving neighbour."""
        positions, asleep = following.positions, memory.asleep
        steps = positions - current.positions
        # What is not a number counts as moving, so that the search for its neighbours refuses it by name.
        moving = awake & ~(_length(steps) <= self.rest_speed)
        rests = awake & ~moving & (_length(positions - memory.rest_positions) <= self.rest_drift)
        num_rested = torch.where(rests, memory.num_rested + 1, torch.where(asleep, memory.num_rested, 0))
        rest_positions = torch.where((rests | asleep)[..., None], memory.rest_positions, positions)
        tired = rests & (num_rested >= self.rest_steps)
        if memory.inner is not None:
            asleep = self._whole_scenes(following, tired, asleep)
        else:
            asleep = torch.stack(
                [
                    self._members_sleepers(*row)
                    for row in zip(positions, steps, following.mask, moving, tired, asleep, strict=True)
                ]
            )
        num_rested = num_rested.masked_fill(memory.asleep & ~asleep, 0)  # those that wake
        return replace(memory, asleep=asleep, num_rested=num_rested, rest_positions=rest_positions)

    def _members_sleepers(
        self, positions: Tensor, steps: Tensor, valid: Tensor, moving: Tensor, tired: Tensor, asleep: Tensor
    ) -> Bool[Tensor, " particle"]:
        """Return who of one member sleeps from now on."""
        may_sleep = tired | asleep
        if bool(moving.any()) and bool(may_sleep.any()):
            ahead = torch.cat([positions[moving], positions[moving] + steps[moving]])
            near = within_reach(positions[may_sleep], ahead, self.wake_radius, self.neighbors_backend)
            may_sleep = may_sleep.masked_scatter(may_sleep, ~near)
        candidates = may_sleep & ~asleep
        if bool(candidates.any()):
            may_sleep = asleep & may_sleep | self._held(positions, valid, candidates, asleep)
        return may_sleep

    def _held(self, positions: Tensor, valid: Tensor, candidates: Tensor, asleep: Tensor) -> Bool[Tensor, " particle"]:
        """Return which candidates are supported. Sleepers are, so a link to one is enough, and quickly found."""
        linked = within_reach(positions[candidates], positions[asleep], self.link_radius, self.neighbors_backend)
        if bool(linked.all()):
            return candidates
        held = torch.zeros_like(valid)
        held[valid] = on_ground(positions[valid], self.link_radius, self.ground_width, self.neighbors_backend)
        return candidates & held

    def _whole_scenes(self, particles: Particles, tired: Tensor, asleep: Tensor) -> Bool[Tensor, "batch particle"]:
        """Put to sleep all particles of a member where everything that may move is at rest and supported."""
        may_move = particles.mask if particles.moving is None else particles.mask & particles.moving
        rows = []
        for positions, valid, movable, tired_ones, sleepers in zip(
            particles.positions, particles.mask, may_move, tired, asleep, strict=True
        ):
            at_rest = bool((tired_ones | ~movable).all())
            if at_rest and not bool(sleepers.any()):
                held = self._held(positions, valid, movable, torch.zeros_like(valid))
                sleepers = valid if bool((held | ~movable).all()) else sleepers
            rows.append(sleepers)
        return torch.stack(rows)


def _length(vectors: Float[Tensor, "*shape 3"]) -> Float[Tensor, "*shape"]:
    return vectors.square().sum(dim=-1).sqrt()


def _kept(following: Particles, current: Particles, asleep: Bool[Tensor, "batch particle"]) -> Particles:
    """Return the next particles, where those asleep are as they were."""
    if not bool(asleep.any()):
        return following
    stays = asleep[..., None]
    return replace(
        following,
        positions=torch.where(stays, current.positions, following.positions),
        features=torch.where(stays, current.features, following.features),
    )


def _taken(particles: Particles, member: int, index: Int64[Tensor, " active"]) -> Particles:
    """Return some particles of one member, as a batch of one."""
    driven = None if particles.driven is None else particles.driven[member : member + 1]
    return replace(particles.mapped(lambda values: values[member][index][None]), scenery=None, driven=driven)


def _without_inner_prefix(module: Any, state: dict[str, Any], prefix: str, metadata: Any) -> None:
    for name in [name for name in state if name.startswith(prefix + _INNER)]:
        state[prefix + name.removeprefix(prefix + _INNER)] = state.pop(name)


def _with_inner_prefix(module: Any, state: dict[str, Any], prefix: str, *rest: Any) -> None:
    for name in [name for name in state if name.startswith(prefix)]:
        state[prefix + _INNER + name.removeprefix(prefix)] = state.pop(name)
