"""The scenery under edits: its points go with the static particles that they lie nearest to."""

from dataclasses import fields, replace

import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from vpd_lightning.types import Particles, Scenery


def without_scenery(particles: Particles, chosen: Bool[Tensor, " particle"]) -> Scenery | None:
    """Return the scenery without the points of the chosen particles."""
    scenery = particles.scenery
    if scenery is None:
        return None
    return replace(scenery, mask=scenery.mask & ~_points_of(particles, scenery, chosen))


def only_scenery(particles: Particles, chosen: Bool[Tensor, " particle"]) -> Scenery | None:
    """Return the scenery with the points of the chosen particles alone."""
    scenery = particles.scenery
    if scenery is None:
        return None
    return replace(scenery, mask=_points_of(particles, scenery, chosen), far_mask=torch.zeros_like(scenery.far_mask))


def transformed_scenery(
    particles: Particles,
    chosen: Bool[Tensor, " particle"],
    rotation: Float[Tensor, "3 3"],
    scale: float,
    about: Float[Tensor, " 3"],
    translation: Float[Tensor, " 3"],
) -> Scenery | None:
    """Return the scenery whose points of the chosen particles went along; see ``state.transformed``."""
    scenery = particles.scenery
    if scenery is None:
        return None
    here = _points_of(particles, scenery, chosen)
    where = here[..., None]

    def turned(vectors: Tensor) -> Tensor:
        return torch.where(where, (vectors.double() @ rotation.T).to(vectors), vectors)

    moved = ((scenery.positions.double() - about) @ rotation.T * scale + about + translation).to(scenery.positions)
    return replace(
        scenery,
        positions=torch.where(where, moved, scenery.positions),
        normals=turned(scenery.normals),
        views=turned(scenery.views),
        sizes=torch.where(here, scenery.sizes * scale, scenery.sizes),
    )


def joined_scenery(first: Scenery | None, second: Scenery | None) -> Scenery | None:
    """Return the points of both; the shadows in what was observed are those of the first."""
    if first is None or second is None:
        return first
    second = second.to(first.positions.device)
    names = [item.name for item in fields(first) if not item.name.startswith("occluder")]
    return replace(first, **{name: torch.cat([getattr(first, name), getattr(second, name)], dim=1) for name in names})


def _points_of(particles: Particles, scenery: Scenery, chosen: Bool[Tensor, " particle"]) -> Bool[Tensor, "1 point"]:
    """Return which points lie nearest to a chosen one of the particles that stand still."""
    still = particles.mask[0] if particles.moving is None else particles.mask[0] & ~particles.moving[0]
    if not bool((chosen & still).any()):
        return torch.zeros_like(scenery.mask)
    tree = cKDTree(particles.positions[0][still].double().cpu().numpy())
    nearest = torch.from_numpy(tree.query(scenery.positions[0].double().cpu().numpy())[1]).to(chosen.device)
    return (chosen[still][nearest] & scenery.mask[0])[None]
