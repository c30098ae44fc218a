"""The light that fell on the scenery when it was observed: predicted shadows, corrected by where shadows are seen."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.graph.neighbors import PointIndex
from vpd_lightning.renderer.scenery_layer import SeenScenery
from vpd_lightning.types import Occluders, Scenery

_SHADED = 0.995
"""Share of the light below which a point may lie in a shadow, or beside one."""

_LIT = 0.97
"""Share of the light from which on a point shows what its surface looks like without a shadow."""

_NUM_NEIGHBORS = 96
"""Points of the scenery around a ray's that are looked at."""

_OFF = 6.0
"""How far off the edge of a predicted shadow may be, in widths of the pixel that saw a point."""

_NUM_LEVELS = 17
"""Of light that are tried, from the least to the most that is predicted around a point."""

_PRIOR = 0.1
"""How much a change of the light counts beside a difference of (the logarithms of) colours: little."""

_DARKEST = 0.01
"""Of a colour channel in [0, 1]: below it, ratios are noise."""

_SAME_SURFACE = 0.8
"""Least cosine between the normals of two points of one surface."""

_POINTS_PER_CHUNK = 1024


class ObservedScenery(NamedTuple):
    """What rays see of the scenery, where (metres), and the light that fell on it then: predicted, and corrected."""

    seen: SeenScenery
    points: Float[Tensor, "batch ray 3"]
    predicted: Float[Tensor, "batch ray 3"]
    corrected: Float[Tensor, "batch ray 3"]


@torch.no_grad()
def observed_light(
    shadows: Callable[[Tensor, Tensor, Tensor], Tensor],
    scenery: Scenery,
    casting: Occluders,
    seen: SeenScenery,
    points: Float[Tensor, "batch ray 3"],
    predicted: Float[Tensor, "batch ray 3"],
) -> Float[Tensor, "batch ray 3"]:
    """Return the share of light per channel (in (0, 1]) that fell on what the rays see, when it was observed.

    Colours that were observed in a shadow are divided by the light that is ``predicted`` there. A predicted shadow is
    softer than the one seen, or a pixel or two beside it: divided by it, its edge would become brighter than anything
    around. So the light at each point (metres) in or beside a predicted shadow is chosen between the least and the
    most that is predicted within ``_OFF`` pixels, such that the colour divided by it is that of a lit point of the
    same surface nearby. Where no lit point is near the prediction stays, and where several choices are as good the one
    nearest to it is taken. ``shadows`` predicts light from points, occluders and their mask, as ``Shadows`` does.
    """
    result = predicted.clone()
    for member in range(len(points)):
        shaded = (predicted[member].amin(dim=-1) < _SHADED) & (seen.opacities[member] > 0.5)
        shaded &= torch.isfinite(points[member]).all(dim=-1)
        rows = shaded.nonzero().flatten()
        if len(rows) == 0 or not bool(scenery.mask[member].any()):
            continue
        index = PointIndex(scenery.positions[member], mask=scenery.mask[member])
        for some in rows.split(_POINTS_PER_CHUNK):
            near = index.knn(points[member][some], _NUM_NEIGHBORS)
            unique, place = near.index.unique(return_inverse=True)
            light = shadows(
                scenery.positions[member][unique][None], casting.positions[member][None], casting.mask[member][None]
            )[0][place]
            normals = scenery.normals[member][near.index]
            same = near.mask & ((normals * normals[:, :1]).sum(dim=-1) > _SAME_SURFACE)
            inside = near.mask & (near.distance <= _OFF * scenery.sizes[member][near.index])
            result[member, some] = _matched(
                seen.colors[member][some],
                predicted[member][some],
                light.masked_fill(~inside[..., None], torch.nan),
                scenery.colors[member][near.index],
                same & (light.amin(dim=-1) > _LIT),
            )
    return result


def light_then(
    predicted: Float[Tensor, "batch ray 3"], observed: Float[Tensor, "batch ray 3"], now: Float[Tensor, "batch ray 3"]
) -> Float[Tensor, "batch ray 3"]:
    """Return the light that observed colours are divided by, before they are multiplied by that which falls ``now``.

    It is the one ``predicted`` for then where now is as dark as then, so that a shadow that stays is drawn as it was
    seen, the ``observed`` one where all light has returned, and between the two where some has.
    """
    if observed is predicted:
        return predicted
    returned = (now - predicted) / (1 - predicted).clamp(min=1 - _SHADED)
    return torch.lerp(predicted, observed, returned.clamp(0, 1))


def _matched(
    colors: Float[Tensor, "point 3"],
    predicted: Float[Tensor, "point 3"],
    around: Float[Tensor, "point neighbor 3"],
    beside: Float[Tensor, "point neighbor 3"],
    is_lit: Bool[Tensor, "point neighbor"],
) -> Float[Tensor, "point 3"]:
    """Return the level of light that makes each colour most like that of a lit neighbour.

    ``around`` is the light predicted near the point, not a number where that is too far away; ``beside`` are colours.
    """
    least = torch.minimum(torch.where(around.isnan(), torch.inf, around).amin(dim=1), predicted)
    most = torch.maximum(torch.where(around.isnan(), -torch.inf, around).amax(dim=1), predicted)
    shares = torch.linspace(0, 1, _NUM_LEVELS, device=colors.device, dtype=colors.dtype)[:, None]
    levels = torch.cat([predicted[:, None], torch.lerp(least[:, None], most[:, None], shares)], dim=1)
    wanted = (colors.clamp(min=_DARKEST)[:, None] / levels).log()
    differences = (wanted[:, :, None] - beside.clamp(min=_DARKEST).log()[:, None]).abs().sum(dim=-1)
    differences = differences.masked_fill(~is_lit[:, None], torch.inf).amin(dim=-1)
    costs = differences + _PRIOR * (levels - predicted[:, None]).abs().sum(dim=-1)
    best = levels[torch.arange(len(levels), device=levels.device), costs.argmin(dim=1)]
    return torch.where(is_lit.any(dim=1, keepdim=True), best, predicted)
