"""The velocity of the first frame: where each body was one frame earlier, found without correspondences."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from vpd_lightning.dynamics.inertial.picture_match import PictureMatch, chromaticity
from vpd_lightning.dynamics.inertial.rigid_motion import cross, rigid_fit, rotate, rotation_from_spin, weighted_sum
from vpd_lightning.geometry.decay import decay
from vpd_lightning.geometry.spacing import point_spacing

_EVIDENCE = 0.3  # evidence (1: one perfect match) at which the confidence of a match is 0.5
_TOO_FAR = 0.01  # at a lower mean confidence of the matches the pose of the body is not updated
_NO_MATCH = 0.1  # a body with a lower mean confidence was not seen before: no velocity


@dataclass(frozen=True)
class Surfels:
    """Observed points of one frame that are matched: positions (metres), colours in [0, 1], normals, features."""

    positions: Float[Tensor, "batch particle 3"]
    colors: Float[Tensor, "batch particle 3"]
    normals: Float[Tensor, "batch particle 3"]
    features: Float[Tensor, "batch particle feature"]
    mask: Bool[Tensor, "batch particle"]

    def first(self, count: int) -> "Surfels":
        """Return the first points; where their order is random, a random subset."""
        values = (self.positions, self.colors, self.normals, self.features, self.mask)
        return Surfels(*(value[:, :count] for value in values))


@dataclass(frozen=True)
class MatchedMotion:
    """Displacement of each particle since the frame before (metres), and its confidence (0 to 1)."""

    displacements: Float[Tensor, "batch particle 3"]
    confidence: Float[Tensor, "batch particle"]


@dataclass(frozen=True)
class Poses:
    """Where bodies were: a point x of a body was at rotation (x - center) + goal."""

    rotations: Float[Tensor, "batch body 3 3"]
    centers: Float[Tensor, "batch body 3"]
    goals: Float[Tensor, "batch body 3"]

    def of(self, points: Tensor, bodies: Float[Tensor, "batch body particle"]) -> Float[Tensor, "batch particle 3"]:
        """Return where points of the bodies were; a point of no body goes to zero."""
        offsets = points[:, None] - self.centers[:, :, None]
        moved = rotate(self.rotations[:, :, None], offsets) + self.goals[:, :, None]
        return (bodies[..., None] * moved).sum(dim=1)


class FirstVelocity(nn.Module):
    """Soft matches in space and colour, agreed upon by each body, annealed, and finished on tangent planes.

    Every particle is matched softly to the earlier frame within a scale; a weighted rigid fit (Kabsch 1976) for each
    body replaces the matches, and the scale shrinks along ``match_scales`` (in radii of the body), but not below
    ``min_scale`` spacings of the points. Single matches fail on surfaces of one colour (the aperture problem);
    agreement on one motion resolves them. Then ``num_plane_rounds`` Gauss-Newton steps bring each point onto the
    tangent planes of its match (Chen and Medioni 1992), while its soft match pulls along the surface with
    ``tangential_weight``: points of two frames are never the same points, and between them a surface is known better
    than any point. How much it pulls depends on how many colours the body has: on one colour, all points match
    equally well; there a rotation that planes do not determine, such as the spin of a plain ball, is pulled to zero
    (``rest_weight``). Where the pictures of both frames are known, each point's change of colour in them joins these
    equations with ``picture_weight`` (see ``PictureMatch``).

    Colours are compared as chromaticity and, more weakly, brightness, within ``color_scale``, so that shading under
    rotation does not break a match; with a ``feature_scale``, the encoder's features, too. The last step is
    differentiable in places, colours and features of both frames; the rounds before it only find where it starts.
    """

    def __init__(
        self,
        *,
        match_scales: Sequence[float],
        min_scale: float,
        color_scale: float,
        feature_scale: float | None,
        num_matched: int,
        num_plane_rounds: int,
        tangential_weight: float,
        rest_weight: float,
        picture_weight: float,
    ):
        super().__init__()
        positive = {"color_scale": color_scale, "min_scale": min_scale, "tangential_weight": tangential_weight}
        positive |= {"rest_weight": rest_weight}
        positive |= {} if feature_scale is None else {"feature_scale": feature_scale}
        for name, value in positive.items():
            if not value > 0:
                raise ValueError(f"{name} must be positive, got {value}")
        if not picture_weight >= 0:
            raise ValueError(f"picture_weight must not be negative, got {picture_weight}")
        if not match_scales or min(match_scales) <= 0:
            raise ValueError(f"match_scales must be positive radii of a body, got {list(match_scales)}")
        if num_matched < 1 or num_plane_rounds < 1:
            raise ValueError(
                f"num_matched and num_plane_rounds must be at least 1, got {num_matched} and {num_plane_rounds}"
            )
        self.match_scales, self.min_scale = list(match_scales), min_scale
        self.color_scale, self.feature_scale = color_scale, feature_scale
        self.num_matched, self.num_plane_rounds = num_matched, num_plane_rounds
        self.tangential_weight, self.rest_weight = tangential_weight, rest_weight
        self.picture_weight = picture_weight

    def forward(
        self,
        current: Surfels,
        bodies: Float[Tensor, "batch body particle"],
        previous: Surfels,
        pictures: PictureMatch | None = None,
    ) -> MatchedMotion:
        """Return the motion of the current particles; ``bodies`` is 1 where a particle belongs to a body, else 0.

        A particle of no body does not move. A body that the earlier frame does not show has no velocity and hardly any
        confidence. ``pictures`` are those in which the current particles and, one frame earlier, their bodies are seen.
        """
        some, target = current.first(self.num_matched), previous.first(2 * self.num_matched)
        members = bodies[:, :, : self.num_matched]
        pictures = None if pictures is None or self.picture_weight == 0 else pictures.first(self.num_matched)
        cost = self.appearance_cost(some, target)
        with torch.no_grad():
            radii = body_radii(some.positions, members)
            smallest = self.min_scale * point_spacing(target.positions, target.mask)[:, None]
            poses, scales = self._anneal(some, members, target, cost, radii, smallest)
            for _ in range(self.num_plane_rounds - 1):
                poses, _ = self._plane_round(poses, some, members, target, cost, scales, radii, smallest, pictures)
        poses, confidences = self._plane_round(poses, some, members, target, cost, scales, radii, smallest, pictures)
        count = members.sum(dim=2).clamp(min=1)
        confidence = (members * confidences[:, None]).sum(dim=2) / count
        known = torch.sigmoid((confidence - _NO_MATCH) / 0.02) * target.mask.any(dim=1, keepdim=True)
        was = poses.of(current.positions, bodies)
        share = (bodies * known[..., None]).sum(dim=1)
        displacements = share[..., None] * (current.positions - was) * bodies.any(dim=1)[..., None]
        return MatchedMotion(displacements, (bodies * (confidence * known)[..., None]).sum(dim=1))

    def _anneal(
        self, some: Surfels, members: Tensor, target: Surfels, cost: Tensor, radii: Tensor, smallest: Tensor
    ) -> tuple[Poses, Float[Tensor, "batch particle"]]:
        """Return the poses that soft matches of shrinking scale agree on, and the last scale (metres) of each point."""
        radius = (members * radii[..., None]).sum(dim=1)  # of each particle's body
        poses = _unmoved(some.positions, members)
        count = members.sum(dim=2).clamp(min=1)
        for scale in self.match_scales:
            scales = torch.maximum(scale * radius, smallest).clamp(min=1e-9)
            matched, evidence, _ = match(poses.of(some.positions, members), target, cost, scales)
            weights = members * match_confidence(evidence)[:, None]
            # Soft matches always lie somewhere: a body that was not seen before must not jump onto another.
            is_near = weights.sum(dim=2) / count > _TOO_FAR
            poses = _where(is_near, Poses(*rigid_fit(some.positions, matched, weights + 1e-6 * members)), poses)
        return poses, scales

    def appearance_cost(self, some: Surfels, target: Surfels) -> Float[Tensor, "batch particle target"]:
        """Return half the squared difference in appearance, in the scales of the match."""
        cost = _half_squares(
            chromaticity(some.colors) / self.color_scale, chromaticity(target.colors) / self.color_scale
        )
        if self.feature_scale is not None:
            scaled = (some.features / self.feature_scale, target.features / self.feature_scale)
            cost = cost + _half_squares(*scaled)
        return cost

    def _variety(self, colors: Tensor, members: Tensor) -> Float[Tensor, "batch body"]:
        """Return from 0 (a body of one colour) to 1 how well colours identify points of a body."""
        shares = members / members.sum(dim=2, keepdim=True).clamp(min=1)
        tone = chromaticity(colors)[..., :3]
        spread = weighted_sum(shares, tone.square()).sum(-1) - weighted_sum(shares, tone).square().sum(-1)
        spread = spread.clamp(min=0)
        return spread / (spread + self.color_scale**2)

    def _plane_round(
        self,
        poses: Poses,
        some: Surfels,
        members: Tensor,
        target: Surfels,
        cost: Tensor,
        scales: Tensor,
        radii: Float[Tensor, "batch body"],
        smallest: Float[Tensor, "batch 1"],
        pictures: PictureMatch | None = None,
    ) -> tuple[Poses, Float[Tensor, "batch particle"]]:
        """Take one Gauss-Newton step of every body onto the surface seen before; also return confidences."""
        at = poses.of(some.positions, members)
        matched, evidence, weights = match(at, target, cost, scales)
        confidences = match_confidence(evidence)
        # Symmetric distance (Rusinkiewicz 2019), ``(target - point) . (normal of one + normal of the other) / 2``:
        # on a curved surface tangent planes alone lie outside of it, and what is seen from above would seem to fall.
        # Averaged over the soft match, not of its best point: two may be equally good, and rounding would choose.
        own = rotate((members[..., None, None] * poses.rotations[:, :, None]).sum(dim=1), some.normals)
        normals = (weights @ target.normals + own) / 2
        middle = _masked_mean(target.positions, target.mask)
        heights = weights @ ((target.positions - middle) * target.normals).sum(dim=-1, keepdim=True)
        heights = (heights.squeeze(-1) + ((matched - middle) * own).sum(dim=-1)) / 2
        off_plane = heights - ((at - middle) * normals).sum(dim=-1)
        # A point whose plane is far off has no match there, whatever the soft match is (Geman-McClure weights).
        robust_weights = 1 / (1 + (off_plane.detach() / smallest.clamp(min=1e-9)).square())
        plane_weights = confidences * robust_weights * (normals.square().sum(dim=-1) > 0.5)

        centers = poses.goals
        # Turns are solved in radii of the body, so that turns and shifts are of one size in the equations.
        size = radii.clamp(min=1e-9)
        arms = (at[:, None] - centers[:, :, None]) / size[..., None, None]
        along_normal = torch.cat([cross(arms, normals[:, None]), normals[:, None].expand_as(arms)], dim=-1)
        eye = torch.eye(3, dtype=at.dtype, device=at.device)
        along_axes = torch.cat([cross(arms[..., None, :], eye), eye.expand(*arms.shape[:-1], 3, 3)], dim=-1)
        plane = members * plane_weights[:, None]
        variety = self._variety(some.colors, members)
        pull = self.tangential_weight * (0.1 + 0.9 * variety)
        point_weights = members * pull[..., None] * confidences[:, None]
        matrix = torch.einsum("bkp,bkpi,bkpj->bkij", plane, along_normal, along_normal)
        matrix = matrix + torch.einsum("bkp,bkpai,bkpaj->bkij", point_weights, along_axes, along_axes)
        right = torch.einsum("bkp,bkpi,bp->bki", plane, along_normal, off_plane)
        right = right + torch.einsum("bkp,bkpai,bpa->bki", point_weights, along_axes, matched - at)
        if pictures is not None:
            # A change of ``color_scale`` counts as much as a plane that is off by what planes are off: in perfect depth
            # little, in noisy depth more than anything else. What pictures tell is taken as given, without gradients.
            sure, off = plane.detach(), off_plane.detach().square()[:, None]
            variance = (sure * off).sum(dim=-1, keepdim=True) / sure.sum(dim=-1, keepdim=True).clamp(min=1e-9)
            scale = self.picture_weight * variance / self.color_scale**2
            known, seen = pictures.equations(at.detach())
            axes = along_axes.detach()
            weighted = (scale * members)[..., None, None] * axes
            matrix = matrix + torch.einsum("bkpai,bpac,bkpcj->bkij", weighted, known, axes)
            right = right + torch.einsum("bkpai,bpa->bki", weighted, seen)
        count = members.sum(dim=2)[..., None]
        ridge = torch.eye(6, dtype=at.dtype, device=at.device) * (1e-6 * count[..., None] + 1e-9)
        rest = self.rest_weight * (1.02 - variety)[..., None] * count
        matrix = matrix + ridge + rest[..., None] * torch.diag(ridge.new_tensor([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]))
        right = right - nn.functional.pad(rest * _spin(poses.rotations) * size[..., None], (0, 3))
        step = torch.linalg.solve(matrix, right)
        turn = rotation_from_spin(step[..., :3] / size[..., None])
        rotations = (turn[..., None] * poses.rotations[..., None, :, :]).sum(dim=-2)
        return Poses(rotations, poses.centers, centers + step[..., 3:]), confidences


def _half_squares(
    some: Float[Tensor, "batch particle value"], target: Float[Tensor, "batch target value"]
) -> Float[Tensor, "batch particle target"]:
    """Return half the squared distance of every pair, as a product: five times as fast as from differences."""
    middle = target.mean(dim=1, keepdim=True).detach()  # about which large features keep their digits
    some, target = some - middle, target - middle
    square = torch.baddbmm(target.square().sum(dim=-1)[:, None], some, target.mT, alpha=-2)
    return 0.5 * (square + some.square().sum(dim=-1)[..., None]).clamp(min=0)


def match(
    at: Tensor, target: Surfels, cost: Tensor, scales: Float[Tensor, "batch particle"]
) -> tuple[Tensor, Tensor, Tensor]:
    """Return soft matches (metres), their evidence (1 for one perfect match) and the weights of the points."""
    origin = _masked_mean(target.positions, target.mask)
    local, goals = at - origin, target.positions - origin
    # The product form of the squared distance, two to three times faster than differences: about the middle of the
    # scene its error is a millionth of the scene's width squared, against scales of a hundredth of it.
    square = torch.baddbmm(goals.square().sum(dim=-1)[:, None], local, goals.mT, alpha=-2)
    square = (square + local.square().sum(dim=-1)[..., None]).clamp(min=0)
    logits = -square / (2 * scales[..., None].square()) - cost
    # What is not there counts for nothing, and even where nothing is there the numbers stay finite.
    logits = logits.masked_fill(~target.mask[:, None], -1e4).clamp(min=-1e4)
    top = logits.detach().amax(dim=-1, keepdim=True)
    kernel = decay(logits - top)
    total = kernel.sum(dim=-1, keepdim=True)
    weights = kernel / total
    return origin + weights @ goals, (total * torch.exp(top)).squeeze(-1), weights


def _masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Return the mean of the valid values, with the axis kept; zero where there is none."""
    return (values * mask[..., None]).sum(dim=1, keepdim=True) / mask.sum(dim=1).clamp(min=1)[:, None, None]


def match_confidence(evidence: Tensor) -> Tensor:
    """Return the confidence of a match from its evidence: from 0 to almost 1."""
    return evidence / (evidence + _EVIDENCE)


def _unmoved(positions: Tensor, members: Tensor) -> Poses:
    weights = members / members.sum(dim=2, keepdim=True).clamp(min=1)
    centers = weighted_sum(weights, positions)
    eye = torch.eye(3, dtype=positions.dtype, device=positions.device)
    return Poses(eye.expand(*centers.shape, 3), centers, centers)


def _where(chosen: Bool[Tensor, "batch body"], one: Poses, other: Poses) -> Poses:
    """Return for each body the chosen one of two poses."""
    chosen = chosen[..., None]
    return Poses(
        torch.where(chosen[..., None], one.rotations, other.rotations),
        torch.where(chosen, one.centers, other.centers),
        torch.where(chosen, one.goals, other.goals),
    )


def _spin(rotations: Float[Tensor, "batch body 3 3"]) -> Float[Tensor, "batch body 3"]:
    """Return 2 tan(angle / 2) * axis of rotations of less than half a turn."""
    skew = rotations - rotations.mT
    axis = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1)
    trace = rotations.diagonal(dim1=-2, dim2=-1).sum(dim=-1, keepdim=True)
    return 2 * axis / (1 + trace).clamp(min=1e-3)


def body_radii(positions: Tensor, members: Tensor) -> Float[Tensor, "batch body"]:
    """Return the root mean square distance of each body's particles from their mean (metres)."""
    weights = members / members.sum(dim=2, keepdim=True).clamp(min=1)
    offsets = positions[:, None] - weighted_sum(weights, positions)[:, :, None]
    return (weights * offsets.square().sum(dim=-1)).sum(dim=2).clamp(min=1e-18).sqrt()
