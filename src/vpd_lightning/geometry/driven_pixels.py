"""Which pixels show what is driven, such as a robot: found by projection of its points."""

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vpd_lightning.geometry.cameras import pixel_rays, project, unproject
from vpd_lightning.geometry.spacing import point_spacing
from vpd_lightning.types import Driven, RGBDFrames

_LATERAL, _NORMAL = 0.8, 0.25
"""Spacings of the points beside and along their normals within which a pixel still lies on their surface."""

_DEPTH_ERROR = 0.002
"""Share of a pixel's depth that is added to both for the error of the sensor."""

_PIXELS_AT_A_TIME = 4096

_THROUGH = 0.02
"""Share of a point's depth by which the measured depth must exceed it, beside the spacing, to be seen through it."""


@torch.no_grad()
def shows_driven(frames: RGBDFrames) -> Bool[Tensor, "batch view height width"]:
    """Return the pixels of frames (axes ``batch view``) that show what is driven, with one pixel around them.

    A measured pixel does where it lies on the surface that the points sample; one without a depth where a point near
    its ray projects to it. The pixel around them mixes what is driven with what is behind it.
    """
    depth, driven = frames.depth, frames.driven
    shown = torch.zeros_like(depth, dtype=torch.bool)
    if driven is None or driven.positions.shape[-2] == 0:
        return shown
    measured = torch.isfinite(depth) & (depth > 0)
    points = unproject(torch.where(measured, depth, 0.0), frames.cameras)
    rays = pixel_rays(frames.cameras)
    for member in range(len(depth)):
        mask = driven.mask[member]
        places, normals = driven.positions[member][mask], driven.normals[member][mask]
        if len(places) == 0:
            continue
        spacing = driven_spacing(driven, member)
        seen, flat = measured[member], shown[member].flatten()
        # Most pixels are farther from all points than any of them can be: a box says so at once.
        margin = 2 * _LATERAL * spacing + _DEPTH_ERROR * depth[member].nan_to_num(0, 0, 0).max()
        low, high = places.amin(dim=0) - margin, places.amax(dim=0) + margin
        near = ((points[member] > low) & (points[member] < high)).all(dim=-1)
        index = (seen & near).flatten().nonzero()[:, 0]
        for some in index.split(_PIXELS_AT_A_TIME):
            offsets = points[member].flatten(0, 2)[some][:, None] - places
            heights = (offsets * normals).sum(dim=-1).abs()
            beside = (offsets.square().sum(dim=-1) - heights.square()).clamp(min=0).sqrt()
            error = _DEPTH_ERROR * depth[member].flatten()[some][:, None]
            flat[some] = ((beside < _LATERAL * spacing + error) & (heights < _NORMAL * spacing + error)).any(dim=-1)
        origins, directions = (part[member].flatten(0, 2) for part in (rays.origins, rays.directions))
        for some in (~seen).flatten().nonzero()[:, 0].split(_PIXELS_AT_A_TIME):
            offsets = places - origins[some][:, None]
            along = (offsets * directions[some][:, None]).sum(dim=-1)
            beside = (offsets.square().sum(dim=-1) - along.square()).clamp(min=0).sqrt()
            flat[some] = ((beside < spacing) & (along > 0)).any(dim=-1)
        shown[member] = flat.view_as(seen)
    return torch.nn.functional.max_pool2d(shown.float(), 3, stride=1, padding=1) > 0


def driven_spacing(driven: Driven, member: int = 0) -> Float[Tensor, ""]:
    """Return the distance (metres) between neighbouring points of one member."""
    places = driven.positions[member][driven.mask[member]]
    return point_spacing(places[None], torch.ones_like(places[None, :, 0], dtype=torch.bool))[0]


@torch.no_grad()
def nearest_pixels(
    driven: Driven, points: Float[Tensor, "batch point 3"], shown: Bool[Tensor, "batch point"]
) -> tuple[Int64[Tensor, "batch driven"], Bool[Tensor, "batch driven"]]:
    """Return the pixel that shows each driven point, or the nearest one that shows another, and whether there is any.

    ``points`` are those of all pixels (metres), ``shown`` those on what is driven.
    """
    index = torch.zeros_like(driven.groups)
    for member, pixels in enumerate(shown):
        chosen = pixels.nonzero()[:, 0]
        if len(chosen):
            gaps = driven.positions[member][:, None] - points[member][chosen]
            index[member] = chosen[gaps.square().sum(dim=-1).argmin(dim=1)]
    return index, shown.any(dim=1, keepdim=True).expand_as(driven.mask)


@torch.no_grad()
def seen_through_share(frames: RGBDFrames) -> Float[Tensor, " batch"]:
    """Return which share of the driven points some camera sees through (0: the recording does not contradict them).

    Of the points that lie in a picture where depth was measured, it is those at which every such camera measured
    something farther away: had the robot been there, it would have been in the way.
    """
    driven, depth = frames.driven, frames.depth
    if driven is None:
        return depth.new_zeros(len(depth))
    height, width = depth.shape[-2:]
    places = driven.positions[:, None].expand(-1, depth.shape[1], -1, -1)
    pixels, z = project(places, frames.cameras)
    column, row = (pixels[..., axis].floor().nan_to_num(-1).clamp(-1, 1e6).long() for axis in (0, 1))
    inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    index = (row.clamp(0, height - 1) * width + column.clamp(0, width - 1)).flatten(2)
    there = torch.gather(depth.flatten(2), 2, index)
    inside = inside & torch.isfinite(there) & (there > 0) & driven.mask[:, None]
    spacing = torch.stack([driven_spacing(driven, member) for member in range(len(depth))])
    through = inside & (there > z * (1 + _THROUGH) + spacing[:, None, None])
    seen = inside.any(dim=1)
    contradicted = seen & (through | ~inside).all(dim=1)
    return contradicted.sum(dim=1) / seen.sum(dim=1).clamp(min=1)
