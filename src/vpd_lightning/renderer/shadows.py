"""Shadows of what moves on what stands still: light that bodies keep away, with directions learned from pixels."""

import math
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from vpd_lightning.finite import is_traced
from vpd_lightning.geometry.decay import NEGLIGIBLE, decay
from vpd_lightning.geometry.spacing import point_spacing

_PAIRS_PER_CHUNK = 2**17
"""Of points and occluders at a time: half a megabyte, which stays in cache."""

_REACH = 6.0
"""Widths beside an occluder from which on it casts nothing: e^-18 of what it casts where it is."""

_REACH_ALONG = 13.0
"""Widths below a point, along the light, from which on an occluder casts nothing: the logistic's e^-26 there."""

_POINT_WIDTH = 0.4
"""Of the spacing of points: how far each reaches, so that neighbours close up and outlines stay where they are. Fitted
to shadows of the demo, 0.4, 0.6 and 0.9 left squared errors of 2.37, 2.52 and 3.01; on soft bodies 0.6 was as good."""

_BEGIN = 2.0
"""Half widths above a point at which an occluder begins to count: what touches the point is its own surface."""

_GONE = -0.3
"""Share of a light that training no longer computes. Of four lights three are below it after some hundred updates, and
in the trainings looked at none came back from below."""

_PAIRS_PER_BLOCK = 2**23
"""Of points and occluders at a time where all are computed, without gradients: 32 MB."""

_NUM_BALLS = 8
"""Balls around the occluders of a scene that decide which points to look at: bodies lie apart."""


class Shadows(nn.Module):
    """How much light reaches a point past the bodies, from ``num_lights`` lights far away.

    A body hides a light within its outline as seen from there: each of its points covers as much of that as no other
    point does, so that their number and how many lie behind one another hardly matter. The outline's edge is blurred
    by ``softness`` (metres, learned) and, the higher the body is, the wider, as below a light of some size (a
    penumbra's slope, learned: about the tangent of half the light's angle). Each light has a learned direction and a
    learned share of the light per colour channel. Directions start spread over the upper half; pixels decide which of
    them cast shadows.
    """

    # Paper: has no shadows of its own; the radiance field paints what its particles' features say.

    def __init__(self, *, num_lights: int, softness: float):
        super().__init__()
        if num_lights < 1 or softness <= 0:
            raise ValueError(f"num_lights must be at least 1 and softness positive, got {num_lights} and {softness}")
        self.directions = nn.Parameter(_spread(num_lights))
        # Together a tenth of the light before training.
        self.shares = nn.Parameter(torch.full((num_lights, 3), 0.1 / num_lights))
        self.log_softness = nn.Parameter(torch.full((num_lights,), softness).log())
        self.log_slope = nn.Parameter(torch.full((num_lights,), 0.03).log())

    def forward(
        self,
        points: Float[Tensor, "batch point 3"],
        occluders: Float[Tensor, "batch occluder 3"],
        mask: Bool[Tensor, "batch occluder"],
    ) -> Float[Tensor, "batch point 3"]:
        """Return the share of light per colour channel that reaches the points, in (0, 1]."""
        if occluders.shape[1] == 0:  # each weight has a gradient all the same, as training on several devices needs
            return torch.ones_like(points) + 0 * sum(weight.sum() for weight in self.parameters())
        # Seen from among the occluders, so that squares of coordinates keep their digits.
        count = mask.sum(dim=1).clamp(min=1)[:, None, None]
        center = torch.where(mask[..., None], occluders, 0.0).sum(dim=1, keepdim=True) / count
        points, occluders = points - center, torch.where(mask[..., None], occluders - center, 0.0)
        directions = nn.functional.normalize(self.directions, dim=-1).to(points.dtype)
        spacing = point_spacing(occluders.detach(), mask)
        # Never less than no light; the gradient goes through, so that a light that went out may come back.
        shares = self.shares + (self.shares.clamp(min=0) - self.shares).detach()
        least = _GONE if torch.is_grad_enabled() else 0.0
        # Each weight has a gradient all the same, as training on several devices needs.
        light = torch.ones_like(points) + 0 * sum(weight.sum() for weight in self.parameters())
        known = range(len(shares)) if is_traced() else (self.shares > least).any(dim=1).nonzero().flatten().tolist()
        for i in known:
            softness = self.log_softness[i].exp()
            # Too few points for a spacing reach as far as their edges are soft.
            reach = torch.where(spacing > 0, _POINT_WIDTH * spacing, softness)
            width = torch.where(spacing > 0, (reach.square() + softness.square()).sqrt(), softness)
            beam = _Beam(directions[i], reach, width, self.log_slope[i].exp())
            if points.device.type == "cpu" and not is_traced():
                covered = _covered_near(points, occluders, mask, beam)
            else:
                keeps_all = torch.is_grad_enabled() or is_traced()
                parts = [points] if keeps_all else points.split(max(1, _PAIRS_PER_BLOCK // mask.shape[1]), dim=1)
                covered = torch.cat([_covered(part, occluders, mask, beam) for part in parts], dim=1)
            light = light - shares[i] * (covered * beam.height[:, None]).clamp(max=1)[..., None]
        return light.clamp(min=0.05)


class _Beam(NamedTuple):
    """Light from one side: the unit direction towards it, and how far beside a line to it an occluder casts.

    ``reach`` (metres, of each member of the batch) is that of a point itself, ``width`` with the softness of its edge;
    for each metre below the occluder it is ``slope`` more, in squares.
    """

    direction: Float[Tensor, " 3"]
    reach: Float[Tensor, " batch"]
    width: Float[Tensor, " batch"]
    slope: Float[Tensor, ""]

    @property
    def growth(self) -> Float[Tensor, ""]:
        """How much the squared width grows, in squared widths, from one half width below the occluder to the next."""
        return (0.5 * self.slope).square()

    def coordinates(
        self, points: Float[Tensor, "batch point 3"], occluders: Float[Tensor, "batch occluder 3"]
    ) -> tuple[
        Float[Tensor, "batch point 4"],
        Float[Tensor, "batch occluder 4"],
        Float[Tensor, "batch point"],
        Float[Tensor, "batch occluder"],
    ]:
        """Return rows and columns whose product is minus half the squared distance of a pair across the light.

        In widths; and where points and occluders are along the light, in half widths. What is below a point does not
        cast on it.
        """
        axes = _across(self.direction)
        scale = math.sqrt(2) * self.width[:, None, None]
        seen, casting = points @ axes.mT / scale, occluders @ axes.mT / scale
        one, other = torch.ones_like(seen[..., :1]), torch.ones_like(casting[..., :1])
        rows = torch.cat([2 * seen, -seen.square().sum(-1, keepdim=True), one], dim=-1)
        columns = torch.cat([casting, other, -casting.square().sum(-1, keepdim=True)], dim=-1)
        half = 0.5 * self.width[:, None]
        return rows, columns, points @ self.direction / half, occluders @ self.direction / half - _BEGIN

    @torch.no_grad()
    def shares_of_outline(
        self, occluders: Float[Tensor, "batch occluder 3"], mask: Bool[Tensor, "batch occluder"]
    ) -> Float[Tensor, "batch occluder"]:
        """Return how much each point adds to the outline of all: one over the number of points on its line.

        The sum over points of this times their kernels is then about 1 within the outline. Constant for gradients.
        """
        casting = occluders @ _across(self.direction).mT / (math.sqrt(2) * self.reach[:, None, None])
        square, one = casting.square().sum(dim=-1, keepdim=True), torch.ones_like(casting[..., :1])
        rows, columns = torch.cat([2 * casting, -square, one], dim=-1), torch.cat([casting, one, -square], dim=-1)
        kernels = decay((rows @ columns.mT).clamp_(max=0))
        return mask / (kernels @ mask[..., None].to(kernels.dtype)).squeeze(-1).clamp(min=1)

    @property
    def height(self) -> Float[Tensor, " batch"]:
        """Of a softened kernel over that of the point alone: lower by as much as it is wider."""
        return (self.reach / self.width).square()


def _covered(points: Tensor, occluders: Tensor, mask: Tensor, beam: _Beam) -> Float[Tensor, "batch point"]:
    """Return the sum of all kernels at each point, from every pair."""
    rows, columns, starts, ends = beam.coordinates(points, occluders)
    offsets = ends[..., None, :] - starts[..., None]
    narrow = 1 / (1 + beam.growth * (offsets + _BEGIN).square())
    kernels = narrow * decay((rows @ columns.mT).clamp(max=0) * narrow) * torch.sigmoid(offsets)
    return (kernels @ beam.shares_of_outline(occluders, mask)[..., None]).squeeze(-1)


class _KernelSum(torch.autograd.Function):
    """The sum of kernels of the occluders between each point and the light, as in ``_covered``.

    With ``t = end - start`` and ``n = 1 / (1 + growth (t + 2)^2)`` it is ``sum w n exp(n rows @ columns) sigmoid(t)``.
    It keeps four numbers of each pair, and its backward pass is two matrix products: half of the time that autograd
    takes for the same sum. It has first derivatives alone, and none by the weights ``w``.
    """

    @staticmethod
    def forward(
        ctx: Any, rows: Tensor, columns: Tensor, starts: Tensor, ends: Tensor, weights: Tensor, growth: Tensor
    ) -> Tensor:
        offsets = ends - starts[:, None]
        ahead = torch.sigmoid(offsets)
        square = offsets.add_(_BEGIN).square_()
        narrow = square.mul_(growth).add_(1).reciprocal_()
        exponents = (rows @ columns.mT).clamp_(max=0).mul_(narrow).clamp_(min=NEGLIGIBLE)
        kernels = exponents.exp().mul_(ahead).mul_(narrow).mul_(weights)
        ctx.save_for_backward(rows, columns, starts, ends, growth, kernels, exponents, ahead, narrow)
        return kernels.sum(dim=-1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        rows, columns, starts, ends, growth, kernels, exponents, ahead, narrow = ctx.saved_tensors
        by_log = kernels * gradients[0][:, None]
        by_exponent = by_log * narrow
        # n = 1 / (1 + growth x^2): of log(n) + n q the derivative by log(n) is 1 + n q, that of log(n) by x is
        # -2 growth x n, and by growth -x^2 n.
        by_narrow = (exponents + 1).mul_(by_exponent)
        height = ends + _BEGIN - starts[:, None]
        by_narrow.mul_(height)
        by_offset = by_log.sub_(by_log * ahead).sub_(by_narrow * (2 * growth))
        by_growth = -by_narrow.mul_(height).sum()
        return (
            by_exponent @ columns,
            by_exponent.mT @ rows,
            -by_offset.sum(dim=1),
            by_offset.sum(dim=0),
            None,
            by_growth,
        )


def _across(direction: Float[Tensor, " 3"]) -> Float[Tensor, "2 3"]:
    """Return two unit vectors perpendicular to a unit vector and to each other."""
    helper = torch.zeros_like(direction).index_fill_(0, direction.detach().abs().argmin()[None], 1.0)
    first = nn.functional.normalize(torch.linalg.cross(direction, helper), dim=0)
    return torch.stack([first, torch.linalg.cross(direction, first)])


def _covered_near(
    points: Float[Tensor, "batch point 3"],
    occluders: Float[Tensor, "batch occluder 3"],
    mask: Bool[Tensor, "batch occluder"],
    beam: _Beam,
) -> Float[Tensor, "batch point"]:
    """Return the sum of all kernels at each point, computed where its line passes near some occluder."""
    near = _lines_pass_near(points, occluders, mask, beam)
    rows, columns, starts, ends = beam.coordinates(points, occluders)
    found, places = [], []
    for member, place in enumerate(row.nonzero().flatten() for row in near):
        if len(place) == 0:
            continue
        some = slice(member, member + 1)
        alone = _Beam(beam.direction, beam.reach[some], beam.width[some], beam.slope)
        casting = slice(None) if bool(mask[member].all()) else mask[member]
        weights = alone.shares_of_outline(occluders[some, casting], mask[some, casting])[0]
        for some in place.split(max(1, _PAIRS_PER_CHUNK // max(512, len(weights)))):
            chosen = rows[member].index_select(0, some), columns[member][casting]
            begin, end = starts[member].index_select(0, some), ends[member][casting]
            found.append(_KernelSum.apply(*chosen, begin, end, weights, beam.growth))
        places.append(place + member * points.shape[1])
    # Without a point near, each weight has a gradient all the same, as training on several devices needs.
    covered = (0 * (beam.direction.sum() + beam.width.sum() + beam.slope)).expand(near.numel())
    if found:
        covered = covered.index_add(0, torch.cat(places), torch.cat(found).to(covered))
    return covered.unflatten(0, points.shape[:2])


@torch.no_grad()
def _lines_pass_near(points: Tensor, occluders: Tensor, mask: Tensor, beam: _Beam) -> Bool[Tensor, "batch point"]:
    """Return whose lines to the light pass within ``_REACH`` widths of one of ``_NUM_BALLS`` balls around occluders."""
    centers, radii = _balls(occluders, mask)
    radii = radii[:, None]
    square = points.square().sum(-1, keepdim=True) + centers.square().sum(-1)[:, None] - 2 * points @ centers.mT
    towards = (centers @ beam.direction)[:, None] - (points @ beam.direction)[..., None]
    width = beam.width[:, None, None]
    reach = radii + _REACH * (width + beam.slope * (towards + radii).clamp(min=0))
    below = radii + _REACH_ALONG * width
    # What is not a number is near everything, so that it stays what it is.
    return ~((square - towards.square() > reach.square()) | (towards < -below)).all(dim=-1)


def _balls(
    occluders: Float[Tensor, "batch occluder 3"], mask: Bool[Tensor, "batch occluder"]
) -> tuple[Float[Tensor, "batch ball 3"], Float[Tensor, "batch ball"]]:
    """Cover the occluders with few balls: each centre is the occluder farthest from those before it."""
    first = mask.to(torch.uint8).argmax(dim=1, keepdim=True)
    chosen = [torch.gather(occluders, 1, first[..., None].expand(-1, -1, 3))]
    nearest = torch.full_like(occluders[..., 0], torch.inf)
    owner = torch.zeros_like(first).expand(mask.shape).clone()
    for number in range(_NUM_BALLS):
        distance = (occluders - chosen[-1]).norm(dim=-1)
        owner = torch.where(distance < nearest, number, owner)
        nearest = torch.minimum(nearest, distance)
        farthest = nearest.masked_fill(~mask, -1.0).argmax(dim=1, keepdim=True)
        chosen.append(torch.gather(occluders, 1, farthest[..., None].expand(-1, -1, 3)))
    radii = torch.full((len(mask), _NUM_BALLS), -torch.inf, dtype=occluders.dtype, device=occluders.device)
    radii = radii.scatter_reduce(1, owner, nearest.masked_fill(~mask, -torch.inf), "amax")
    return torch.cat(chosen[:-1], dim=1), radii


def _spread(count: int) -> Float[Tensor, "light 3"]:
    """Return directions spread over the upper half, the first straight up (a golden spiral)."""
    steps = torch.arange(count, dtype=torch.float32)
    height = 1 - 0.8 * steps / max(count, 2)
    angle = steps * 2.399963
    radius = (1 - height.square()).clamp(min=0).sqrt()
    return torch.stack([radius * torch.cos(angle), radius * torch.sin(angle), height], dim=-1)
