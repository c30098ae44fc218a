"""Other motions drawn by the model's own renderer: what of a picture's error is motion, and what is drawing."""

from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from vpd_lightning.data.clip import Clip
from vpd_lightning.evaluation.bodies import Body, find_bodies
from vpd_lightning.evaluation.motion import valid_positions
from vpd_lightning.evaluation.prediction import PredictsVideo, render_steps, roll_out_clip, stand_still
from vpd_lightning.metrics.body_dynamics import best_rotation
from vpd_lightning.metrics.registry import NOTHING_MOVES, TRUE_MOTION, TRUE_VELOCITY
from vpd_lightning.simulator import Scene
from vpd_lightning.types import HiddenSide, Particles


@torch.no_grad()
def drawn_references(
    simulator: PredictsVideo, scene: Scene, clip: Clip, margin: float
) -> Mapping[str, Float[Tensor, "step view height width 3"]]:
    """Render the particles of the last input frame as three motions that need no model carry them.

    Nothing moves; bodies keep the true velocity and rotation between the two input frames; bodies move as they truly
    do, with the features that the dynamics gives them at that step (its shading). The last is about the best that any
    dynamics can reach with this encoder and this renderer. In the last two, what is driven moves as it was given. The
    clip must have ground truth; a body's particles are those within ``margin`` metres of it. Colours are in [0, 1].
    """
    num_steps = clip.target_rgb.shape[0]
    current = scene.current
    bodies = find_bodies(clip, valid_positions(current), margin, num_steps)
    predicted = roll_out_clip(simulator, scene, clip, num_steps)

    def carried(places: list[Tensor]) -> list[Particles]:
        states = _carried(current, bodies, places, num_steps)
        return [replace(state, driven=known.driven) for state, known in zip(states, predicted, strict=True)]

    true = carried([body.true for body in bodies])
    moved = {
        NOTHING_MOVES: [current] * num_steps,
        TRUE_VELOCITY: carried([_kept_velocity(body, num_steps) for body in bodies]),
        TRUE_MOTION: [_with_features_of(known, state) for known, state in zip(predicted, true, strict=True)],
    }
    images = {}
    for name, states in moved.items():
        if name == NOTHING_MOVES and stand_still(clip.target_cameras):  # one picture stands for all steps
            images[name] = render_steps(simulator, states[:1], clip.target_cameras[:1]).float().cpu()
        else:
            images[name] = render_steps(simulator, states, clip.target_cameras).float().cpu()
    return images


def _kept_velocity(body: Body, num_steps: int) -> Float[Tensor, "time body_particle 3"]:
    """Where a body's particles are if its velocity and its rotation between the input frames go on."""
    now = body.true[0]
    places = [now]
    if len(now):
        rotation = best_rotation(body.before, now[None])[0]
        center, velocity = now.mean(0), now.mean(0) - body.before.mean(0)
        arms = now - center
        for step in range(1, num_steps + 1):
            arms = arms @ rotation.T
            places.append(center + step * velocity + arms)
    else:
        places = [now] * (num_steps + 1)
    return torch.stack(places)


def _carried(
    current: Particles, bodies: list[Body], places: list[Float[Tensor, "time body_particle 3"]], num_steps: int
) -> list[Particles]:
    """Move the particles of bodies to their places after each step; normals and hidden sides turn as the body does."""
    owners = _nearest_bodies(current, bodies)
    rows = current.mask[0].nonzero().flatten().cpu()
    states = []
    for step in range(1, num_steps + 1):
        positions = current.positions.clone()
        normals = None if current.normals is None else current.normals.clone()
        side = current.hidden_side
        for number, (body, path) in enumerate(zip(bodies, places, strict=True)):
            own = rows[body.mask].to(positions.device)
            if not len(own):
                continue
            positions[0, own] = path[step].to(positions)
            rotation = best_rotation(path[0], path[step][None])[0]
            if normals is not None:
                rotation = rotation.to(normals)
                normals[0, own] = current.normals[0, own] @ rotation.T  # type: ignore[index]
            if side is not None:
                side = _turned(side, owners == number, path[0].mean(0), path[step].mean(0), rotation)
        states.append(replace(current, positions=positions, normals=normals, hidden_side=side))
    return states


def _nearest_bodies(current: Particles, bodies: list[Body]) -> Int64[Tensor, " hidden"]:
    """Return for each particle of the hidden side the body that has the nearest particle; -1 without bodies."""
    if current.hidden_side is None or not any(len(body.true[0]) for body in bodies):
        return torch.full((0 if current.hidden_side is None else current.hidden_side.mask.shape[1],), -1)
    places = current.hidden_side.positions[0].cpu().double()
    nearest = [
        (places[:, None] - body.true[0].double()).square().sum(dim=-1).amin(dim=1)
        if len(body.true[0])
        else torch.full_like(places[:, 0], torch.inf)
        for body in bodies
    ]
    return torch.stack(nearest).argmin(dim=0)


def _turned(side: HiddenSide, own: Tensor, before: Tensor, after: Tensor, rotation: Tensor) -> HiddenSide:
    """Return a hidden side whose own particles moved as a body that turned about its particles' mean."""
    before, after, rotation = (part.to(side.positions) for part in (before, after, rotation))
    chosen = own.to(side.mask.device)[:, None]
    positions = torch.where(chosen, (side.positions - before) @ rotation.T + after, side.positions)
    return replace(side, positions=positions, normals=torch.where(chosen, side.normals @ rotation.T, side.normals))


def _with_features_of(predicted: Particles, state: Particles) -> Particles:
    side = state.hidden_side
    if side is not None and predicted.hidden_side is not None:
        side = replace(side, features=predicted.hidden_side.features)
    return replace(state, features=predicted.features, hidden_side=side)
