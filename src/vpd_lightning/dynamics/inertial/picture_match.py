"""Points matched in pictures: what two images of one camera tell of how far the points in them have moved."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn import functional

from vpd_lightning.geometry.cameras import project
from vpd_lightning.types import Cameras, Particles

_OTHER = 0.15
"""Difference between pixels (in ``chromaticity``) at which they count as of different things: occluded, or shaded."""

_BEHIND = 2.0
"""Spacings of the particles by which one may lie off the depth of a picture's pixel and still be what it shows."""

_SMOOTHING = 0.8
"""Standard deviation in pixels by which pictures are smoothed before they are compared. Sampled between its pixels a
picture is smoother than at them; at outlines, of which only the inside belongs to the body, that looks like motion."""


def chromaticity(colors: Float[Tensor, "*shape 3"]) -> Float[Tensor, "*shape 6"]:
    """Return what is compared of colours: shares of red, green and blue, and, more weakly, brightness."""
    return torch.cat([colors / (colors.sum(dim=-1, keepdim=True) + 0.15), 0.3 * colors], dim=-1)


@dataclass(frozen=True)
class PictureMatch:
    """How the current particles look to each camera that sees them, and what it saw one frame earlier.

    Dense alignment of images (Lucas and Kanade 1981; Kerl et al. 2013 for RGB-D), linearised about the mean of both
    slopes (Malis 2004). Depth says where a surface is along its normal, its pictures where it is across the ray: to a
    tenth of a pixel at outlines and between faces of different colours, whatever the noise of depth.
    """

    seen: Bool[Tensor, "batch view particle"]
    colors: Float[Tensor, "batch view particle channel"]
    slopes: Float[Tensor, "batch view particle 2 channel"]  # per pixel, across and down
    earlier: Float[Tensor, "batch view plane height width"]  # the channels of the frame before, then their slopes
    cameras: Cameras  # of the frame before; axes ``batch view``

    def first(self, count: int) -> "PictureMatch":
        """Return the first particles."""
        parts = {name: getattr(self, name)[:, :, :count] for name in ("seen", "colors", "slopes")}
        return replace(self, **parts)

    @torch.no_grad()
    def equations(
        self, places: Float[Tensor, "batch particle 3"]
    ) -> tuple[Float[Tensor, "batch particle 3 3"], Float[Tensor, "batch particle 3"]]:
        """Return the normal equations of each particle's shift (metres) from ``places``, where it was a frame earlier.

        Matrix (per square metre) and right side (per metre) of the least squares of its change in appearance, summed
        over views; zero where no picture of both frames shows it.
        """
        pixels, depth, inside = _projected(places, self.cameras)
        inside = inside & self.seen
        earlier = _sampled(self.earlier, pixels).unflatten(-1, (3, -1))
        change = torch.where(inside[..., None], earlier[..., 0, :] - self.colors, 0.0)
        slopes = (earlier[..., 1:, :] + self.slopes) / 2
        jacobian = slopes.mT @ _pixel_shifts(pixels, torch.where(inside, depth, 1.0), self.cameras)
        weights = inside / (1 + change.square().sum(dim=-1) / _OTHER**2).square()
        weighted = weights[..., None, None] * jacobian
        right = -(weighted.mT @ change[..., None]).squeeze(-1)
        return (jacobian.mT @ weighted).sum(dim=1), right.sum(dim=1)


@torch.no_grad()
def picture_match(
    previous: Particles, current: Particles, index: Int64[Tensor, "batch moving"], spacing: Float[Tensor, " batch"]
) -> PictureMatch | None:
    """Return the match of the current particles at ``index``; None where the pictures are not known.

    ``spacing`` (metres) is that of the particles.
    """
    if current.pixels is None or current.pictures is None or previous.pictures is None:
        return None
    now, before = current.pictures, previous.pictures
    if now.rgb.shape != before.rgb.shape:
        return None
    places = torch.gather(current.positions, 1, index[..., None].expand(-1, -1, 3))
    pixels, depth, inside = _projected(places, now.cameras)
    nearest = torch.stack([pixels[..., 0].floor(), pixels[..., 1].floor()], dim=-1).long()
    shown = torch.gather(now.depth.flatten(2), 2, nearest[..., 1] * now.depth.shape[-1] + nearest[..., 0])
    shows = (shown > 0) & ((shown - depth).abs() <= _BEHIND * spacing[:, None, None])
    looks = _sampled(_with_slopes(now.rgb), pixels).unflatten(-1, (3, -1))
    is_pixel = torch.gather(current.pixels, 1, index) >= 0
    return PictureMatch(
        seen=inside & shows & is_pixel[:, None],
        colors=looks[..., 0, :],
        slopes=looks[..., 1:, :],
        earlier=_with_slopes(before.rgb),
        cameras=before.cameras,
    )


def _with_slopes(rgb: Float[Tensor, "batch view height width 3"]) -> Float[Tensor, "batch view plane height width"]:
    """Return the channels that are compared, smoothed, and behind them their central differences across and down."""
    images = chromaticity(rgb).movedim(-1, 2)
    images = _smoothed(images.flatten(0, 1)).view_as(images)
    padded = functional.pad(images.flatten(0, 1), (1, 1, 1, 1), mode="replicate")
    across = (padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]) / 2
    down = (padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]) / 2
    return torch.cat([images, across.view_as(images), down.view_as(images)], dim=2)


def _smoothed(images: Float[Tensor, "image channel height width"]) -> Float[Tensor, "image channel height width"]:
    """Return the images after a Gaussian filter; beyond their borders they go on as at them."""
    reach = 2
    taps = torch.exp(-(torch.arange(-reach, reach + 1).to(images) / _SMOOTHING).square() / 2)
    taps = taps / taps.sum()
    padded = functional.pad(images, (reach, reach, reach, reach), mode="replicate")
    # Sums, not a convolution: that may be in TF32 on a GPU, and what is compared are differences of pictures.
    down = (padded.unfold(2, len(taps), 1) * taps).sum(dim=-1)
    return (down.unfold(3, len(taps), 1) * taps).sum(dim=-1)


def _projected(
    places: Float[Tensor, "batch particle 3"], cameras: Cameras
) -> tuple[Float[Tensor, "batch view particle 2"], Float[Tensor, "batch view particle"], Tensor]:
    """Return pixels (x, y) in every view, z-depth in metres, and which lie in the picture; others are at a corner."""
    num_views = cameras.shape[1]
    pixels, depth = project(places[:, None].expand(-1, num_views, -1, -1), cameras)
    limits = pixels.new_tensor([cameras.width, cameras.height])
    inside = (depth > 0) & ((pixels > 0) & (pixels < limits)).all(dim=-1)
    return torch.where(inside[..., None], pixels, 0.5), depth, inside


def _sampled(
    images: Float[Tensor, "batch view plane height width"], pixels: Float[Tensor, "batch view particle 2"]
) -> Float[Tensor, "batch view particle plane"]:
    """Return the images at places (x, y) between the centres of pixels, by bilinear interpolation."""
    height, width = images.shape[-2:]
    flat = images.flatten(3).mT
    corner = (pixels - 0.5).floor()
    part, corner = pixels - 0.5 - corner, corner.long()
    result = torch.zeros((), dtype=images.dtype, device=images.device)
    for right, below in ((0, 0), (1, 0), (0, 1), (1, 1)):
        column = (corner[..., 0] + right).clamp(0, width - 1)
        row = (corner[..., 1] + below).clamp(0, height - 1)
        value = torch.gather(flat, 2, (row * width + column)[..., None].expand(-1, -1, -1, flat.shape[-1]))
        share = (part[..., 0] if right else 1 - part[..., 0]) * (part[..., 1] if below else 1 - part[..., 1])
        result = result + share[..., None] * value
    return result


def _pixel_shifts(
    pixels: Float[Tensor, "batch view particle 2"], depth: Float[Tensor, "batch view particle"], cameras: Cameras
) -> Float[Tensor, "batch view particle 2 3"]:
    """Return by how many pixels a point moves per metre along the axes of the world."""
    k, rotation = cameras.intrinsics[:, :, None], cameras.cam_to_world[:, :, None, :3, :3]
    center = pixels - k[..., :2, 2]
    one = torch.ones_like(depth)
    across = torch.stack([k[..., 0, 0] * one, k[..., 0, 1] * one, -center[..., 0]], dim=-1)
    down = torch.stack([0 * one, k[..., 1, 1] * one, -center[..., 1]], dim=-1)
    return torch.stack([across, down], dim=-2) / depth[..., None, None] @ rotation.mT
