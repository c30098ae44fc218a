"""The light of a data set, fitted before training to what the floor looks like in different frames.

Which directions light comes from, how much of it, and how soft its shadows are is the same in all frames of all
recordings, and is seen best where frames lie far apart: a shadow has gone, or come. Training on predictions of a few
steps sees little of that. It takes no trained weights: only pixels that stand still, and points of what moves.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.geometry.occluders import thinned
from vpd_lightning.renderer.shadows import Shadows
from vpd_lightning.renderer.splat import SplatRenderer
from vpd_lightning.types import Occluders, Particles, Rays

_NUM_RAYS = 4096
"""Rays of a frame whose colours are compared; some of those are fitted."""

_NUM_POINTS = 384
"""Points of each kind (changed between the frames, unchanged) that are fitted."""

_MIN_CHANGE = 0.05
"""Difference of a colour channel (of 1) from which on a point counts as changed."""

_LR = 0.03
"""Of directions and shares; that of the logarithms of widths is four times as high."""

_PAIRS_PER_UPDATE = 2

USEFUL = 0.9
"""Share of the squared error from which on a fit has found nothing: the lights then stay as they were."""

_COMPLETE = 0.5
"""Share up to which it has found all there is: lights without a share are then left out for good."""


@dataclass(frozen=True)
class LightPair:
    """Points of what stands still that two frames of a recording saw, each with all that moved in it.

    ``weights`` make up for changed points being drawn more often; colours in [0, 1], places in metres.
    """

    points: Float[Tensor, "point 3"]
    colors_before: Float[Tensor, "point 3"]
    colors_after: Float[Tensor, "point 3"]
    weights: Float[Tensor, " point"]
    occluders_before: Occluders
    occluders_after: Occluders


@torch.no_grad()
def light_pair(
    renderer: SplatRenderer,
    before: Particles,
    after: Particles,
    rays: Rays,
    colors: Float[Tensor, "ray 3"],
    generator: torch.Generator,
) -> LightPair | None:
    """Compare two frames of a recording (particles with scenery, batch of 1); None where nothing is to be compared.

    ``rays`` are those of all pixels of the later frame, in the order of its scenery, ``colors`` what they saw.
    """
    if renderer.scenery is None or before.scenery is None or after.scenery is None:
        return None
    still = after.scenery.mask[0].nonzero().flatten()
    still = still[torch.randperm(len(still), generator=generator)[:_NUM_RAYS].to(still.device)]
    lines = Rays(rays.origins[still][None], rays.directions[still][None])
    seen = renderer.scenery(before.scenery, lines)
    # A ray that meets something else now and then (what a body hid, another surface) shows nothing of the light.
    depth = (after.scenery.positions[0][still] - lines.origins[0]).norm(dim=-1)
    same = (seen.opacities[0] > 0.9) & ((seen.distances[0] - depth).abs() < 3 * after.scenery.sizes[0][still])
    changed = ((colors[still] - seen.colors[0]).abs().amax(dim=-1) > _MIN_CHANGE) & same
    kinds = [kind.nonzero().flatten() for kind in (changed, same & ~changed)]
    casting = [
        thinned(Occluders(scenery.occluders, scenery.occluder_mask), renderer.num_occluders)
        for scenery in (before.scenery, after.scenery)
    ]
    if not len(kinds[0]) or not all(bool(occluders.mask.any()) for occluders in casting):
        return None
    chosen = torch.cat([kind[:_NUM_POINTS] for kind in kinds])
    weights = [
        torch.full_like(part, len(kind), dtype=colors.dtype) / max(len(part), 1)
        for kind, part in ((kind, kind[:_NUM_POINTS]) for kind in kinds)
    ]
    return LightPair(
        points=after.scenery.positions[0][still][chosen],
        colors_before=seen.colors[0][chosen],
        colors_after=colors[still][chosen],
        weights=torch.cat(weights) / len(still),
        occluders_before=casting[0],
        occluders_after=casting[1],
    )


def fit_light(shadows: Shadows, pairs: Sequence[LightPair], num_updates: int, generator: torch.Generator) -> float:
    """Fit the lights to pairs of frames; return the squared error left, in shares of that without shadows.

    Where little is left, lights that have no share end with one below zero, and are never computed from then on; else
    they begin training with the share they had before. Where hardly anything was explained, all is as it was before.
    """
    initial = {name: value.clone() for name, value in shadows.state_dict().items()}
    widths = [shadows.log_softness, shadows.log_slope]
    optimizer = torch.optim.Adam(
        [{"params": [shadows.directions, shadows.shares]}, {"params": widths, "lr": 4 * _LR}], lr=_LR
    )
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, [_LR, 4 * _LR], num_updates + 2, pct_start=0.1 if num_updates > 18 else 0.4
    )
    with torch.enable_grad():
        for _ in range(num_updates):
            chosen = torch.randint(len(pairs), (_PAIRS_PER_UPDATE,), generator=generator).tolist()
            optimizer.zero_grad()
            torch.stack([_error(shadows, pairs[index]) for index in chosen]).sum().backward()
            optimizer.step()
            schedule.step()
    with torch.no_grad():
        unused = shadows.shares <= 0
        shadows.shares.masked_fill_(unused, -1.0)
        left = sum(float(_error(shadows, pair)) for pair in pairs)
        before = sum(float(_squares(pair.colors_before, pair)) for pair in pairs)
        share = left / max(before, 1e-12)
        if share >= USEFUL:
            shadows.load_state_dict(initial)
        elif share > _COMPLETE:
            shadows.shares.copy_(torch.where(unused, initial["shares"], shadows.shares))
    return share


def _error(shadows: Shadows, pair: LightPair) -> Float[Tensor, ""]:
    points = pair.points[None]
    before, after = (
        shadows(points, occluders.positions, occluders.mask)[0]
        for occluders in (pair.occluders_before, pair.occluders_after)
    )
    return _squares(pair.colors_before * after / before, pair)


def _squares(colors: Tensor, pair: LightPair) -> Float[Tensor, ""]:
    return ((colors - pair.colors_after).square().mean(dim=-1) * pair.weights).sum()
