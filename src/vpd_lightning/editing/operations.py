"""What can be done to a scene: each operation takes an ``EditState`` and gives a new one."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.editing.point_particles import particles_of_points
from vpd_lightning.editing.rotation import NO_ROTATION, Numbers, Quaternion, matrix_of, quaternion_of, vector_of
from vpd_lightning.editing.scenery import without_scenery
from vpd_lightning.editing.selectors import Everything, Selector
from vpd_lightning.editing.state import EditState, chosen_slots, joined, start_state, transformed, without_pixels
from vpd_lightning.errors import EditError
from vpd_lightning.simulator import Scene
from vpd_lightning.types import Particles

Chosen = tuple[Bool[Tensor, " particle"], Bool[Tensor, " previous_particle"]]


class Operation(ABC):
    """One edit. It never changes the tensors it is given."""

    @abstractmethod
    def apply(self, state: EditState) -> EditState:
        """Return the edited state.

        Raises:
            EditError: nothing is selected, or it does not fit the scene.
        """


def find(state: EditState, what: Selector) -> Chosen:
    """Return the selected particles of the current frame, and those of the previous one that stand for the same.

    Raises:
        EditError: nothing is selected.
    """
    now = what.select(state)
    if not bool(now.any()):
        raise EditError(
            f"{type(what).__name__} selects none of the scene's {int(state.mask.sum())} particles.\n"
            "Select something that is there."
        )
    return now, now[state.origin] & state.scene.previous.mask[0]


@dataclass(frozen=True)
class Delete(Operation):
    """Take particles out of both frames."""

    select: Selector

    def apply(self, state: EditState) -> EditState:
        now, before = find(state, self.select)
        previous, current = state.scene.previous, state.scene.current
        scene = Scene(_without(previous, before), _without(current, now))
        return replace(state, scene=scene)


@dataclass(frozen=True)
class Move(Operation):
    """Turn particles about a point, then shift them (metres); both frames alike, so the velocity turns along.

    ``rotation`` is a quaternion (w, x, y, z). ``about`` None: the centroid of what is selected in the current frame.
    """

    select: Selector
    translation: Numbers = (0.0, 0.0, 0.0)
    rotation: Numbers = NO_ROTATION
    about: Numbers = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "translation", vector_of(self.translation, "translation"))
        object.__setattr__(self, "rotation", quaternion_of(self.rotation, "rotation"))
        if self.about is not None:
            object.__setattr__(self, "about", vector_of(self.about, "about"))

    def apply(self, state: EditState) -> EditState:
        now, before = find(state, self.select)
        about, shift = _pivot(state, now, self.about), _vector(self.translation)
        turn = matrix_of(self.rotation)
        scene = Scene(
            transformed(state.scene.previous, before, turn, 1.0, about, shift),
            transformed(state.scene.current, now, turn, 1.0, about, shift),
        )
        return replace(state, scene=scene)


@dataclass(frozen=True)
class Scale(Operation):
    """Make particles' shape larger or smaller; their centroids of both frames, and so their velocity, stay.

    ``about`` None: each frame's own centroid. A given point is that of the current frame, and the previous frame's
    point is as far from its centroid.
    """

    select: Selector
    factor: Numbers
    about: Numbers = None

    def __post_init__(self) -> None:
        (factor,) = vector_of([self.factor], "factor", 1)
        if factor <= 0:
            raise EditError(f"factor is {factor}.\nAllowed: above 0.")
        object.__setattr__(self, "factor", factor)
        if self.about is not None:
            object.__setattr__(self, "about", vector_of(self.about, "about"))

    def apply(self, state: EditState) -> EditState:
        now, before = find(state, self.select)
        about = _pivot(state, now, self.about)
        offset = about - _centroid(state.scene.current, now)
        still = torch.zeros(3)
        previous = state.scene.previous
        if bool(before.any()):
            pivot = _centroid(previous, before) + offset
            previous = transformed(previous, before, torch.eye(3), self.factor, pivot, still)
        current = transformed(state.scene.current, now, torch.eye(3), self.factor, about, still)
        return replace(state, scene=Scene(previous, current))


@dataclass(frozen=True)
class Duplicate(Operation):
    """Add a copy of particles, turned about their centroid and shifted (metres), with its history; it comes last."""

    select: Selector
    translation: Numbers = (0.0, 0.0, 0.0)
    rotation: Numbers = NO_ROTATION

    def __post_init__(self) -> None:
        object.__setattr__(self, "translation", vector_of(self.translation, "translation"))
        object.__setattr__(self, "rotation", quaternion_of(self.rotation, "rotation"))

    def apply(self, state: EditState) -> EditState:
        copies = Move(Everything(), self.translation, self.rotation).apply(_only(state, self.select))
        return _with(state, copies)


@dataclass(frozen=True)
class Insert(Operation):
    """Add particles of another scene that the same model encoded, where they were but for ``translation`` (metres)."""

    scene: Scene
    select: Selector | None = None
    translation: Numbers = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "translation", vector_of(self.translation, "translation"))

    def apply(self, state: EditState) -> EditState:
        device = state.positions.device
        scene = Scene(self.scene.previous.to(device), self.scene.current.to(device))
        other = start_state(scene, None, None)
        if self.select is not None:
            other = _only(other, self.select)
        if any(self.translation):
            other = Move(Everything(), self.translation).apply(other)
        return _with(state, other)


@dataclass(frozen=True)
class InsertPoints(Operation):
    """Add coloured points (metres, world) as particles; each gets the features of the scene's particle most alike.

    ``positions`` (point, 3); ``colors`` (point, 3) in [0, 1]; they go on with ``velocity`` (metres a step). A model was
    never trained on such particles: what it makes of them is a guess by colour.
    """

    positions: Float[Tensor, "point 3"]
    colors: Float[Tensor, "point 3"]
    velocity: Numbers = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "velocity", vector_of(self.velocity, "velocity"))
        positions, colors = self.positions, self.colors
        if positions.ndim != 2 or positions.shape[1:] != (3,) or colors.shape != positions.shape or not len(positions):
            raise EditError(
                f"Points have shape {tuple(positions.shape)} and colours {tuple(colors.shape)}.\n"
                "Allowed: both (point, 3), at least one point."
            )
        if not bool(torch.isfinite(positions).all() and torch.isfinite(colors).all()):
            raise EditError("Points or colours hold NaN or infinity.\nLeave those points out.")

    def apply(self, state: EditState) -> EditState:
        if state.colors is None:
            raise EditError("This scene's particles have no colours to compare with.\nGive SceneEditor colors=...")
        current = particles_of_points(self.positions, self.colors, state.scene.current, state.colors)
        shift = _vector(self.velocity).to(current.positions)
        previous = replace(current, positions=current.positions - shift)
        same = torch.arange(current.num_particles, device=current.positions.device)
        return _with(state, EditState(Scene(previous, current), same, self.colors.to(state.colors)))


@dataclass(frozen=True)
class SetVelocity(Operation):
    """Give particles a velocity (metres a step) and a spin (axis times radians a step) about their centroid.

    Their particles of the previous frame are replaced by those of the current one, moved back: both frames then show
    the same particles, and the motion between them is exactly this.
    """

    select: Selector
    velocity: Numbers = (0.0, 0.0, 0.0)
    spin: Numbers = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "velocity", vector_of(self.velocity, "velocity"))
        object.__setattr__(self, "spin", vector_of(self.spin, "spin"))

    def apply(self, state: EditState) -> EditState:
        now, before = find(state, self.select)
        back = matrix_of(_from_spin(tuple(-value for value in self.spin)))
        shift = -_vector(self.velocity)
        current = state.scene.current
        moved = transformed(current, now, back, 1.0, _centroid(current, now), shift)
        previous = state.scene.previous
        kept = _without(previous, before)
        origin = torch.cat([state.origin, now.nonzero().flatten()])
        scene = Scene(joined(kept, chosen_slots(moved, now)), without_pixels(current, now))
        return replace(state, scene=scene, origin=origin)


def _without(particles: Particles, chosen: Bool[Tensor, " particle"]) -> Particles:
    return replace(particles, mask=particles.mask & ~chosen, scenery=without_scenery(particles, chosen))


def _with(state: EditState, more: EditState) -> EditState:
    """Return a state with the particles of another one behind its own."""
    scene = Scene(joined(state.scene.previous, more.scene.previous), joined(state.scene.current, more.scene.current))
    origin = torch.cat([state.origin, more.origin.to(state.origin) + state.scene.current.num_particles])
    colors = None
    if state.colors is not None:
        if more.colors is None:
            raise EditError("Only one of the two scenes has colours.\nEncode both with the same model.")
        colors = torch.cat([state.colors, more.colors.to(state.colors)])
    return EditState(scene, origin, colors)


def _only(state: EditState, what: Selector) -> EditState:
    """Return a state that holds what is selected and nothing else."""
    now, before = find(state, what)
    scene = Scene(chosen_slots(state.scene.previous, before), chosen_slots(state.scene.current, now))
    rank = torch.cumsum(now, dim=0) - 1
    return EditState(scene, rank[state.origin[before]], None if state.colors is None else state.colors[now])


def _pivot(state: EditState, now: Bool[Tensor, " particle"], about: Sequence[float] | None) -> Float[Tensor, " 3"]:
    return _centroid(state.scene.current, now) if about is None else _vector(about)


def _centroid(particles: Particles, chosen: Bool[Tensor, " particle"]) -> Float[Tensor, " 3"]:
    return particles.positions[0][chosen].double().mean(dim=0).cpu()


def _vector(values: Sequence[float]) -> Float[Tensor, " 3"]:
    return torch.tensor(tuple(values), dtype=torch.float64)


def _from_spin(spin: Sequence[float]) -> Quaternion:
    angle = math.sqrt(sum(value * value for value in spin))
    share = 0.5 if angle < 1e-12 else math.sin(angle / 2) / angle
    x, y, z = (share * value for value in spin)
    return (math.cos(angle / 2), x, y, z)
