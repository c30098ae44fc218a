"""A scene that is being edited: both frames, and which current particle each previous one stands for."""

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vpd_lightning.editing.clusters import object_clusters
from vpd_lightning.editing.matching import match_frames
from vpd_lightning.editing.scenery import joined_scenery, only_scenery, transformed_scenery
from vpd_lightning.errors import EditError
from vpd_lightning.simulator import Scene
from vpd_lightning.types import OTHER_AXES, Particles


@dataclass(frozen=True)
class EditState:
    """What an edit takes and gives. Slots keep their numbers: what is deleted is masked, what is new comes last."""

    scene: Scene
    origin: Int64[Tensor, " previous_particle"]  # the slot of the current frame that a previous particle stands for
    colors: Float[Tensor, "particle 3"] | None  # of the current frame, in [0, 1], for selecting by colour

    @cached_property
    def clusters(self) -> Int64[Tensor, " particle"]:
        """The object-like cluster of each current particle, -1 for scenery (see ``object_clusters``)."""
        return object_clusters(self.scene.current)

    @property
    def positions(self) -> Float[Tensor, "particle 3"]:
        """Positions in the current frame (metres, world)."""
        return self.scene.current.positions[0]

    @property
    def mask(self) -> Bool[Tensor, " particle"]:
        """Which slots of the current frame hold a particle."""
        return self.scene.current.mask[0]


def start_state(
    scene: Scene, previous_colors: Float[Tensor, "previous_particle 3"] | None, colors: Tensor | None
) -> EditState:
    """Return the state of a scene that nobody edited yet.

    Colours default to what the encoder observed; others may be rendered (``export.particle_colors``).

    Raises:
        EditError: not a batch of one, or colours of another number of particles.
    """
    for name, frame in (("previous", scene.previous), ("current", scene.current)):
        if frame.positions.ndim != 3 or len(frame.positions) != 1:
            raise EditError(
                f"The {name} frame has shape {tuple(frame.positions.shape)}.\n"
                "One scene at a time is edited: a batch axis of 1, as simulator.encode gives it."
            )
    if previous_colors is None and scene.previous.colors is not None:
        previous_colors = scene.previous.colors[0]
    if colors is None and scene.current.colors is not None:
        colors = scene.current.colors[0]
    for frame, given in ((scene.previous, previous_colors), (scene.current, colors)):
        if given is not None and given.shape != frame.positions.shape[1:]:
            raise EditError(f"Colours have shape {tuple(given.shape)}, positions {tuple(frame.positions.shape[1:])}.")
    # What is guessed beside the particles would not follow the edits; the rollout guesses it anew.
    scene = Scene(*(replace(frame, hidden_side=None) for frame in (scene.previous, scene.current)))
    clusters = object_clusters(scene.current)
    origin = match_frames(scene.previous, scene.current, clusters, previous_colors, colors)
    return EditState(scene, origin, colors)


def chosen_slots(particles: Particles, chosen: Bool[Tensor, " particle"]) -> Particles:
    """Return only the chosen slots of a frame (batch axis of 1)."""
    kept = particles.mapped(lambda values: values[:, chosen])
    return replace(kept, scenery=only_scenery(particles, chosen), hidden_side=None)


def joined(first: Particles, second: Particles) -> Particles:
    """Return a frame with the particles of both, those of ``second`` last.

    Raises:
        EditError: they come from models that give different things.
    """
    if first.features.shape[-1] != second.features.shape[-1]:
        raise EditError(
            f"Particles with {second.features.shape[-1]} features cannot join particles with "
            f"{first.features.shape[-1]}.\nEncode both scenes with the same model."
        )
    stands_still = second.mask if second.moving is None else second.mask & ~second.moving
    if first.scenery is not None and second.scenery is None and bool(stands_still.any()):
        raise EditError("Only one of the two scenes has scenery.\nEncode both with the same model.")
    scenery = joined_scenery(first.scenery, second.scenery)
    pixels = None if first.pixels is None else torch.full_like(second.mask, -1, dtype=first.pixels.dtype)
    second = replace(second, pixels=pixels)  # the first ones' pictures do not show them
    parts: dict[str, Any] = {"scenery": scenery, "driven": first.driven, "pictures": first.pictures}
    for item in fields(first):
        if item.name in OTHER_AXES:
            continue
        one, other = getattr(first, item.name), getattr(second, item.name)
        if (one is None) != (other is None):
            raise EditError(f"Only one of the two scenes has {item.name}.\nEncode both with the same model.")
        parts[item.name] = None if one is None else torch.cat([one, other.to(one)], dim=1)
    return Particles(**parts)


def transformed(
    particles: Particles,
    chosen: Bool[Tensor, " particle"],
    rotation: Float[Tensor, "3 3"],
    scale: float,
    about: Float[Tensor, " 3"],
    translation: Float[Tensor, " 3"],
) -> Particles:
    """Return a frame whose chosen particles went to ``rotation @ (x - about) * scale + about + translation``.

    In float64, so that there and back again is the same place but for the last digit.
    """
    device = particles.positions.device
    rotation, about, translation = (value.to(device, torch.float64) for value in (rotation, about, translation))
    where = chosen[None, :, None]
    places = particles.positions.double()
    moved = (places - about) @ rotation.T * scale + about + translation
    changed = {"positions": torch.where(where, moved, places).to(particles.positions)}
    if particles.normals is not None:
        turned = (particles.normals.double() @ rotation.T).to(particles.normals)
        changed["normals"] = torch.where(where, turned, particles.normals)
    scenery = transformed_scenery(particles, chosen, rotation, scale, about, translation)
    return replace(without_pixels(particles, chosen), scenery=scenery, **changed)  # type: ignore[arg-type]


def without_pixels(particles: Particles, chosen: Bool[Tensor, " particle"]) -> Particles:
    """Return a frame whose chosen particles are no longer where, or as fast as, the pictures show them."""
    if particles.pixels is None:
        return particles
    return replace(particles, pixels=particles.pixels.masked_fill(chosen[None], -1))
