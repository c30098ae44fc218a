"""Noisy depth as planes fitted around every pixel: it scatters less, and pixels beside a surface get its depth."""

import functools
import math
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.geometry.decay import NEGLIGIBLE, decay
from vpd_lightning.threads import in_threads

_REACH = 3
"""Pixels to each side whose depth is looked at."""

_WIDTH = 2.0
"""Pixels: standard deviation of the weights of neighbours."""

_COLOR_SCALE = 0.1
"""Difference in colour at which a neighbour counts as of another surface: shades of one differ by less."""

_JUMP, _ROBUST = 2.0, 3.0
"""Pixel sizes and standard deviations of the noise beyond which a neighbour lies on another surface."""

_RIDGE = 0.05
"""Pull of the slope to zero, in weights of one neighbour, where too few neighbours determine it."""

_NUM_ROUNDS = 3

_MIN_WEIGHT = 1.0
"""Sum of the neighbours' weights below which a missing pixel stays missing."""

_MAX_CORRECTION = 4.0
"""Standard deviations of the noise by which a fit may move what was measured."""


_STEEP, _MOST_ALIKE = 4.0, 1
"""Pixel sizes by which neighbours on one surface differ in depth, and like neighbours of a pixel that is on none."""


@torch.no_grad()
def between_surfaces(
    depth: Float[Tensor, "image height width"], noise: Float[Tensor, " image"], pixel_sizes: Float[Tensor, " image"]
) -> Bool[Tensor, "image height width"]:
    """Return the measured pixels that hang in the air between a nearer and a farther surface.

    At most one of their eight neighbours is at a like distance: within three standard deviations of the difference of
    two, or as far as a steep surface leads. See ``plane_depth`` for the arguments.
    """
    depth = torch.nan_to_num(depth, nan=0.0, posinf=0.0, neginf=0.0).clamp(min=0)
    around = torch.nn.functional.unfold(depth[:, None], 3, padding=1).unflatten(2, depth.shape[1:])
    around, own = torch.cat([around[:, :4], around[:, 5:]], dim=1), depth[:, None]
    reach = torch.maximum(3 * math.sqrt(2) * noise, _STEEP * pixel_sizes).to(depth)[:, None, None, None] * own
    known = around > 0
    alike = (known & ((around - own).abs() <= reach)).sum(dim=1)
    nearer, farther = (known & (around < own - reach)).any(dim=1), (known & (around > own + reach)).any(dim=1)
    return (depth > 0) & (alike <= _MOST_ALIKE) & nearer & farther


@torch.no_grad()
def plane_depth(
    depth: Float[Tensor, "image height width"],
    rgb: Float[Tensor, "image height width 3"],
    noise: Float[Tensor, " image"],
    pixel_sizes: Float[Tensor, " image"],
) -> Float[Tensor, "image height width"]:
    """Return the depth (metres) of planes fitted around every pixel; 0 where nothing was measured near it.

    The inverse depth of a plane is linear in the picture. Around each pixel such a plane is fitted to neighbours of
    like colour (in [0, 1]) by iteratively reweighted least squares, starting from the pixel's own depth, or from the
    median of such neighbours where it has none (0 or not finite). A camera loses pixels at outlines most, other ones
    in every frame, and a body would seem to move by that; the colours show where it ends. What is measured is moved
    by a few standard deviations at most: a pixel between two surfaces keeps its depth.

    ``noise`` is the standard deviation of each image as a share of depth, ``pixel_sizes`` what a pixel covers as a
    share of depth. Joint bilateral filtering (Petschnigg et al. 2004; Eisemann and Durand 2004), with planes for
    constants and robust weights for the range filter. On a CPU with numba by compiled loops.
    """
    depth = torch.nan_to_num(depth, nan=0.0, posinf=0.0, neginf=0.0).clamp(min=0)
    compiled = _compiled() if depth.device.type == "cpu" else None
    if compiled is None or depth.dtype not in (torch.float32, torch.float64):
        return torch.stack([_fitted(*image) for image in zip(depth, rgb, noise, pixel_sizes, strict=True)])
    constants = _WIDTH, _COLOR_SCALE, _JUMP, _ROBUST, _RIDGE, float(_NUM_ROUNDS), _MIN_WEIGHT, _MAX_CORRECTION
    result = torch.empty_like(depth, memory_format=torch.contiguous_format)
    images = zip(
        depth.contiguous(), rgb.to(depth).contiguous(), noise.tolist(), pixel_sizes.tolist(), result, strict=True
    )

    def fill(image: tuple[Tensor, Tensor, float, float, Tensor]) -> None:
        one, colors, scatter, size, into = image
        compiled(one.numpy(), colors.numpy(), scatter, size, _REACH, (*constants, NEGLIGIBLE), into.numpy())

    in_threads(fill, list(images))
    return result


@functools.cache
def _compiled() -> Callable[..., None] | None:
    try:
        from vpd_lightning.geometry.plane_fits_numba import plane_fits
    except ImportError:
        return None
    return plane_fits  # type: ignore[no-any-return]


def _fitted(depth: Tensor, rgb: Tensor, noise: Tensor, pixel_size: Tensor) -> Float[Tensor, "height width"]:
    steps = torch.arange(-_REACH, _REACH + 1, dtype=depth.dtype, device=depth.device)
    rows, columns = (axis.flatten() for axis in torch.meshgrid(steps, steps, indexing="ij"))
    rgb, noise, pixel_size = rgb.to(depth), noise.to(depth), pixel_size.to(depth)
    around = _windows(torch.where(depth > 0, 1 / depth, 0.0)[None])[0]  # 1/m; zero where there is none
    known = around > 0
    colors = rgb.movedim(-1, 0)
    difference = (_windows(colors) - colors.flatten(1)[:, None]).square().sum(dim=0)
    difference = torch.where(known, difference, torch.inf)
    most_alike = difference.amin(dim=0)
    distance = (rows.square() + columns.square())[:, None] / (2 * _WIDTH**2)
    weights = decay(-distance - (difference - most_alike.clamp(max=1e9)) / (2 * _COLOR_SCALE**2))

    own, measured = depth.flatten(), depth.flatten() > 0
    start = torch.where(measured, 1 / own, 0.0)
    start[~measured] = _median(around[:, ~measured], weights[:, ~measured])
    start = start.clamp(min=1e-30)
    values = around / start - 1  # of the inverse depth at the start, so that all that follows has its digits
    scale = (_ROBUST * noise).clamp(min=1e-6)
    offsets = torch.stack([torch.ones_like(rows), columns, rows], dim=0)
    products = (offsets[:, None] * offsets).flatten(0, 1)
    pull = torch.diag(torch.tensor([1e-6, _RIDGE, _RIDGE], dtype=depth.dtype, device=depth.device))
    robust = _robust(weights, values, torch.maximum(scale, _JUMP * pixel_size))
    for _ in range(_NUM_ROUNDS):
        matrix = (products @ robust).mT.unflatten(1, (3, 3)) + pull
        planes = torch.linalg.solve(matrix, (offsets @ (robust * values)).mT)
        robust = _robust(weights, values - offsets.mT @ planes.mT, scale)

    nearness = start * (1 + planes[:, 0])
    fitted = torch.where(nearness > 0, 1 / nearness, 0.0)
    shift = planes[:, 0].abs()
    is_fine = torch.where(
        measured,
        shift < _MAX_CORRECTION * noise,
        (robust.sum(dim=0) > _MIN_WEIGHT)
        & (shift < 2 * torch.maximum(scale, _JUMP * pixel_size))
        & (most_alike < (3 * _COLOR_SCALE) ** 2),
    )
    return torch.where(is_fine, fitted, own).view_as(depth)


def _windows(images: Float[Tensor, "channel height width"]) -> Float[Tensor, "channel neighbour pixel"]:
    """Return what surrounds each pixel; zeros beyond the border."""
    return torch.nn.functional.unfold(images[:, None], 2 * _REACH + 1, padding=_REACH)


def _robust(weights: Tensor, residuals: Tensor, scale: Tensor) -> Tensor:
    """Return the weights without neighbours whose residual is far beyond the scale (Geman and McClure)."""
    return weights / (1 + (residuals / scale).square()).square()


def _median(
    values: Float[Tensor, "neighbour pixel"], weights: Float[Tensor, "neighbour pixel"]
) -> Float[Tensor, " pixel"]:
    """Return the weighted median over neighbours."""
    ordered, order = values.sort(dim=0)
    sums = torch.gather(weights, 0, order).cumsum(dim=0)
    middle = (sums >= sums[-1] / 2).to(torch.uint8).argmax(dim=0, keepdim=True)
    return torch.gather(ordered, 0, middle)[0]
