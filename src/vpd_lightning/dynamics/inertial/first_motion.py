"""The bodies of the first frame and how each came there: what may move, gathered, divided and matched."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vpd_lightning.dynamics.inertial.body_motion import BodyMotion
from vpd_lightning.dynamics.inertial.first_velocity import FirstVelocity, MatchedMotion, Surfels
from vpd_lightning.dynamics.inertial.picture_match import picture_match
from vpd_lightning.dynamics.inertial.rigid_motion import fit_twists, rotate, rotation_from_spin
from vpd_lightning.finite import require_finite
from vpd_lightning.geometry.spacing import point_spacing
from vpd_lightning.graph.bodies import label_bodies
from vpd_lightning.types import Particles


@dataclass(frozen=True)
class FirstMotion:
    """What may move in the current frame, gathered: its slots, its bodies, and how far it came since the last frame."""

    index: Int64[Tensor, "batch moving"]  # slots among all particles
    mask: Bool[Tensor, "batch moving"]
    seen: Surfels
    bodies: Float[Tensor, "batch body moving"]  # 1 where a particle belongs to a body, else 0
    own: Int64[Tensor, "batch moving"]  # the number of that body; 0 for padding
    matched: MatchedMotion  # metres; at rest and not believed without a first velocity


def observed(previous: Particles, current: Particles) -> tuple[Particles, Particles]:
    """Return both frames with zeros in padding and at least one slot.

    Raises:
        ValueError: colours or normals were not observed.
        NonFiniteError: a valid particle is not finite.
    """
    for particles in (previous, current):
        if particles.colors is None or particles.normals is None:
            raise ValueError("this dynamics needs observed colors and normals; set encoder.use_normals=true")
    previous, current = previous.without_padding(), current.without_padding()
    require_finite(
        "Dynamics",
        positions=torch.cat([previous.positions, current.positions], dim=1),
        features=torch.cat([previous.features, current.features], dim=1),
        colors=torch.cat([previous.colors, current.colors], dim=1),  # type: ignore[list-item]
        normals=torch.cat([previous.normals, current.normals], dim=1),  # type: ignore[list-item]
    )
    return _with_a_slot(previous), _with_a_slot(current)


def find_first_motion(
    previous: Particles,
    current: Particles,
    *,
    num_bodies: int,
    body_link: float,
    max_concavity: float,
    max_concave_share: float,
    first_velocity: FirstVelocity | None,
) -> FirstMotion:
    """Divide what may move now into bodies (``label_bodies``) and find where each was, in frames from ``observed``."""
    index, mask = gather_index(movable(current))
    seen = _surfels(current, index, mask)
    # Far from the origin of the world coordinates have few digits left; differences of near ones are exact.
    origin = seen.positions[:, :1]
    near = replace(seen, positions=seen.positions - origin)
    labels = label_bodies(
        near.positions,
        seen.normals,
        seen.colors,
        mask,
        num_bodies=num_bodies,
        link=body_link,
        max_concavity=max_concavity,
        max_concave_share=max_concave_share,
    )
    mask = labels >= 0  # strays belong to no body and stay where they are
    near, seen = replace(near, mask=mask), replace(seen, mask=mask)
    # No more places than there are bodies: what follows costs as much for an empty one.
    numbers = torch.arange(max(1, int(labels.max()) + 1), device=labels.device)
    bodies = (labels[:, None] == numbers[:, None]).to(current.positions.dtype)
    if first_velocity is None:
        matched = MatchedMotion(torch.zeros_like(seen.positions), torch.zeros_like(seen.positions[..., 0]))
    else:
        before = _surfels(previous, *gather_index(movable(previous)))
        pictures = None
        if first_velocity.picture_weight > 0:
            frames = (relative_to(frame, origin) for frame in (previous, current))
            pictures = picture_match(*frames, index, point_spacing(near.positions, mask))
        matched = first_velocity(near, bodies, replace(before, positions=before.positions - origin), pictures)
    return FirstMotion(index, mask, seen, bodies, labels.clamp(min=0), matched)


def arriving_motion(positions: Tensor, displacements: Tensor, shares: Tensor, centers: Tensor) -> BodyMotion:
    """Return the motion that the bodies arrived with: rigid, about their own centres."""
    fitted = fit_twists(positions, displacements, shares)
    # Fitted centres are those after the step; turning back gives where each centre was before it.
    back = rotate(rotation_from_spin(-fitted.spins), centers - fitted.centers)
    eye = torch.eye(3, dtype=positions.dtype, device=positions.device).expand(*centers.shape, 3)
    there = (shares.sum(dim=-1) > 0)[..., None]
    return BodyMotion(
        centers=centers,
        displacements=torch.where(there, centers - (fitted.centers - fitted.displacements + back), 0.0),
        spins=torch.where(there, fitted.spins, 0.0),
        stretches=eye,
        strains=torch.zeros_like(eye),
    )


def relative_to(particles: Particles, origin: Float[Tensor, "batch 1 3"]) -> Particles:
    """Return the particles, and the cameras that saw them, as seen from a place near them (metres)."""
    near = replace(particles, positions=particles.positions - origin)
    if near.pictures is None:
        return near
    cameras = near.pictures.cameras
    poses = cameras.cam_to_world.clone()
    poses[..., :3, 3] -= origin
    return replace(near, pictures=replace(near.pictures, cameras=replace(cameras, cam_to_world=poses)))


def movable(particles: Particles) -> Bool[Tensor, "batch particle"]:
    """Return which particles may move: all of them where nothing is known."""
    return particles.mask if particles.moving is None else particles.mask & particles.moving


def gather_index(
    chosen: Bool[Tensor, "batch particle"],
) -> tuple[Int64[Tensor, "batch chosen"], Bool[Tensor, "batch chosen"]]:
    """Return slots of the chosen particles, packed to the largest count of the batch (at least one), and a mask."""
    count = max(1, int(chosen.sum(dim=1).max()))
    index = torch.sort((~chosen).to(torch.uint8), dim=1, stable=True).indices[:, :count]
    return index, torch.gather(chosen, 1, index)


def take(
    values: Float[Tensor, "batch particle channel"], index: Int64[Tensor, "batch chosen"]
) -> Float[Tensor, "batch chosen channel"]:
    """Return the values at some slots."""
    return torch.gather(values, 1, index[..., None].expand(-1, -1, values.shape[-1]))


def put(
    values: Float[Tensor, "batch particle channel"],
    index: Int64[Tensor, "batch chosen"],
    new: Float[Tensor, "batch chosen channel"],
    mask: Bool[Tensor, "batch chosen"],
) -> Float[Tensor, "batch particle channel"]:
    """Return ``values`` with ``new`` at the valid slots; the others keep what they had, bit for bit."""
    new = torch.where(mask[..., None], new, take(values, index))
    return values.scatter(1, index[..., None].expand_as(new), new)


def _surfels(particles: Particles, index: Tensor, mask: Tensor) -> Surfels:
    colors, normals = particles.colors, particles.normals
    assert colors is not None and normals is not None
    positions, colors, normals, features = (
        take(values, index) for values in (particles.positions, colors, normals, particles.features)
    )
    return Surfels(positions, colors, normals, features, mask)


def _with_a_slot(particles: Particles) -> Particles:
    """Return the particles with one slot of padding where they have no slots at all."""
    if particles.num_particles > 0:
        return particles
    return particles.mapped(lambda values: values.new_zeros(len(values), 1, *values.shape[2:]))
