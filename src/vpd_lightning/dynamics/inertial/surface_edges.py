"""Where a static surface ends: no farther than its last particles, where something lower was seen beyond them."""

from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.dynamics.inertial.body_motion import vectors_of

_NEAR, _FAR = 2.5, 10.0
"""Spacings of the static particles: neighbours on a surface, and how far beside its end others are looked for."""

_FLAT, _LOWER = 0.25, 0.5
"""Spacings from a tangent plane: within the first a particle is on the same surface, below the second it is not."""

_ONE_SIDED = 0.3
"""Length of the mean direction to the neighbours: 0 inside of a surface, 0.64 (2 / pi) at a straight edge."""

_CONE, _BESIDE = 0.7, 1.2
"""Cosine of directions that lead outward, and spacings beside such a line within which particles say where it ends."""

_ALIKE = 0.9
"""Cosine of directions outward that are those of one edge."""

_TYPICAL = 0.65
"""Quantile of what neighbours say of one edge that is taken: gaps inside of a surface let some say too little."""

_GAP = 0.25
"""Spacings from the outermost of some random particles to where the surface ends."""

_AT_ONCE = 256
"""Particles that are compared with all at a time."""


@dataclass(frozen=True)
class SurfaceEdges:
    """How far beside each static particle its surface goes on (metres).

    Nowhere farther than ``reach``; towards ``outward`` (a unit vector in the tangent plane) no farther than ``ends``.
    Where no edge is near ``outward`` is zero and ``ends`` infinite.
    """

    reach: Float[Tensor, "batch particle"]
    outward: Float[Tensor, "batch particle 3"]
    ends: Float[Tensor, "batch particle"]

    def gathered(self, index: Tensor) -> "SurfaceEdges":
        """Return those of some particles (``batch any``)."""
        wide = index[..., None].expand(-1, -1, 3)
        reach, ends = (torch.gather(values, 1, index) for values in (self.reach, self.ends))
        return SurfaceEdges(reach, torch.gather(self.outward, 1, wide), ends)

    def joined(self, others: "SurfaceEdges") -> "SurfaceEdges":
        """Return these and behind them others."""
        names = [item.name for item in fields(self)]
        return SurfaceEdges(*(torch.cat([getattr(self, name), getattr(others, name)], dim=1) for name in names))

    def include(self, offsets: Float[Tensor, "batch particle 3"], lateral: Float[Tensor, "batch particle"]) -> Tensor:
        """Return whether places at ``offsets`` from the particles, ``lateral`` beside them, are on their surfaces."""
        return (lateral < self.reach) & ((offsets * self.outward).sum(dim=-1) < self.ends)


@torch.no_grad()
def surface_edges(
    statics: tuple[Tensor, Tensor, Tensor],
    spacing: Float[Tensor, " batch"],
    reach: Float[Tensor, "batch particle"],
) -> SurfaceEdges:
    """Find the edges of what stands still (positions, normals, mask).

    A particle is near an edge where its neighbours on the surface are on one side, nothing on the same plane was seen
    beyond, and something below it was: a hole that a body hides has the surface on its other side, and what nobody saw
    has nothing. There the surface ends where its particles do; also for the particles around, on the same plane: beside
    a corner, or a row further in, one sees no edge of its own, and would carry what lies beyond that of its neighbour.
    """
    parts = [slice(start, start + _AT_ONCE) for start in range(0, statics[0].shape[1], _AT_ONCE)]
    found = [_of_some(statics, spacing, some) for some in parts]
    if not found:
        return SurfaceEdges(reach, torch.zeros_like(statics[0]), torch.full_like(reach, torch.inf))
    outward, ends = (torch.cat(each, dim=1) for each in zip(*found, strict=True))
    around = [_from_neighbors(statics, spacing, outward, ends, some) for some in parts]
    outward, ends = (torch.cat(each, dim=1) for each in zip(*around, strict=True))
    return SurfaceEdges(reach, outward, ends)


def _of_some(
    statics: tuple[Tensor, Tensor, Tensor], spacing: Float[Tensor, " batch"], some: slice
) -> tuple[Float[Tensor, "batch some 3"], Float[Tensor, "batch some"]]:
    """Return outward directions and ends of some of the particles."""
    positions, mask = statics[0], statics[2]
    here, normals = positions[:, some], statics[1][:, some]
    is_oriented = mask[:, some] & (normals.square().sum(dim=-1) > 0.5)
    unit = spacing[:, None, None].clamp(min=1e-9)
    offsets = (positions[:, None] - here[:, :, None]) / unit[..., None]
    heights = (offsets * normals[:, :, None]).sum(dim=-1)
    along = offsets - heights[..., None] * normals[:, :, None]
    lengths = along.square().sum(dim=-1).clamp(min=1e-12).sqrt()
    others = mask[:, None] & is_oriented[:, :, None] & (lengths > 1e-3)
    same = others & (heights.abs() < _FLAT)
    near = (same & (lengths < _NEAR)).to(lengths.dtype)
    mean = ((near / lengths)[..., None] * along).sum(dim=2) / near.sum(dim=2, keepdim=True).clamp(min=1)
    length = mean.square().sum(dim=-1, keepdim=True).clamp(min=1e-12).sqrt()
    outward = -mean / length
    out = (along * outward[:, :, None]).sum(dim=-1)
    beyond = (out > _CONE * lengths) & (lengths < _FAR)
    goes_on = (same & beyond & (lengths > _NEAR)).any(dim=2)
    is_lower = (others & beyond & (heights < -_LOWER)).any(dim=2)
    is_edge = is_oriented & (length[..., 0] > _ONE_SIDED) & ~goes_on & is_lower
    beside = (lengths.square() - out.square()).clamp(min=0).sqrt()
    last = _GAP + out.masked_fill(~((near > 0) & (beside < _BESIDE)), 0.0).amax(dim=2).clamp(min=0)
    ends = torch.where(is_edge, last * unit[..., 0], torch.inf)
    return outward * is_edge[..., None], ends


def _from_neighbors(
    statics: tuple[Tensor, Tensor, Tensor], spacing: Float[Tensor, " batch"], outward: Tensor, ends: Tensor, some: slice
) -> tuple[Float[Tensor, "batch some 3"], Float[Tensor, "batch some"]]:
    """Return the edges that some of the particles share with those around, as far as these agree with the nearest."""
    positions, normals = statics[0], statics[1][:, some]
    offsets = positions[:, None] - positions[:, some, None]
    heights = (offsets * normals[:, :, None]).sum(dim=-1)
    square = offsets.square().sum(dim=-1)
    unit = spacing[:, None, None]
    same = torch.isfinite(ends)[:, None] & (heights.abs() < _FLAT * unit) & (square < (_NEAR * unit).square())
    square = square.masked_fill(~same, torch.inf)
    nearest, index = square.min(dim=-1)
    agreeing = same & (vectors_of(outward, index) @ outward.mT > _ALIKE)
    mean = agreeing.to(square.dtype) @ outward
    mean = mean / mean.square().sum(dim=-1, keepdim=True).clamp(min=1e-12).sqrt()
    places = offsets + (outward * ends.nan_to_num(posinf=0.0)[..., None])[:, None]
    reaches = (places * mean[:, :, None]).sum(dim=-1).masked_fill(~agreeing, torch.nan)
    typical = torch.nanquantile(reaches, _TYPICAL, dim=-1)
    is_near = torch.isfinite(nearest) & statics[2][:, some] & (normals.square().sum(dim=-1) > 0.5)
    return mean * is_near[..., None], torch.where(is_near, typical, torch.inf)
