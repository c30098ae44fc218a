"""Counting points of one view that float in front of what another view sees there.

A ray that reached a surface proves that the space before it is empty. A surface point of one view inside that empty
space of another contradicts it: a wrong pose or depth, or a pixel that mixes two surfaces at a silhouette.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data_gen.inspection.posed_depth import ImageKey, PosedDepth, choose_pairs, read_posed_depth
from data_gen.inspection.smooth_surface import smooth_surface
from vpd_lightning.data.reader import TrajectoryReader

MAX_SHARE = 0.01
TOLERANCE = 0.005  # of the workspace's longest side
_NOISE_FACTOR = 4.0  # standard deviations of the depth noise that a point may lie in front as well
_NOISE_STEP = 3  # pixels
_MEASURED_NOISE = 0.0005  # share of depth from which on it is that of a sensor
_MAX_PAIRS = 36
_MAX_FRAMES = 3


@dataclass(frozen=True)
class FreeSpace:
    """Shares of the compared points; ``pairs`` goes by (view of the points, view that looks).

    ``share_beyond_noise`` counts only points that the depth's own noise (``noise``, the standard deviation over depth,
    measured inside each image) cannot have put there. All are 0 where ``num_points`` is.
    """

    share: float
    share_beyond_noise: float
    noise: float
    num_points: int
    pairs: dict[tuple[int, int], float]


def free_space_violations(
    path: str | Path, times: Sequence[int] | None = None, max_pairs: int = _MAX_PAIRS
) -> FreeSpace:
    """Count points of one view in front of the 3x3-pixel minimum of another view's depth of the same time.

    In front means by more than 0.5 % of the workspace's longest side; compared are points where all nine pixels are
    measured. ``times`` are frame numbers (by default three, spread evenly), ``max_pairs`` limits the ordered pairs of
    views over all of them.
    """
    with TrajectoryReader(path) as reader:
        if times is None:
            count = min(reader.num_frames, _MAX_FRAMES)
            times = np.unique(np.linspace(0, reader.num_frames - 1, count).round().astype(int)).tolist()
        pairs: list[tuple[ImageKey, ImageKey]] = []
        for time in times:
            pairs += choose_pairs(reader, max(1, max_pairs // len(times)), [time])
        images = read_posed_depth(reader, [key for pair in pairs for key in pair])
        tolerance = TOLERANCE * float(np.max(np.subtract(reader.workspace_max, reader.workspace_min)))
    noise = float(np.median([depth_noise(image) for image in images.values()])) if images else 0.0
    if noise > _MEASURED_NOISE:
        images = {
            key: replace(image, depth=np.where(smooth_surface(image).is_sure, image.depth, 0))
            for key, image in images.items()
        }
    minima = {key: _nearest_of_nine(image.depth) for key, image in images.items()}
    counts: dict[tuple[int, int], NDArray[np.int64]] = {}
    for first, second in pairs:
        here = _count(images[first], images[second], minima[second], tolerance, noise)
        key = first[1], second[1]
        counts[key] = counts.get(key, np.zeros(3, np.int64)) + here
    total = sum(counts.values(), np.zeros(3, np.int64))
    compared = max(1, int(total[0]))
    return FreeSpace(
        share=float(total[1]) / compared,
        share_beyond_noise=float(total[2]) / compared,
        noise=noise,
        num_points=int(total[0]),
        pairs={key: float(count[1]) / max(1, int(count[0])) for key, count in counts.items()},
    )


def depth_noise(image: PosedDepth) -> float:
    """Estimate the noise of an image: one standard deviation over depth, from second differences of inverse depth.

    Planes have none; what a minority of curved or broken places has does not move the median. The differences are taken
    over ``_NOISE_STEP`` pixels: neighbours err alike, which would hide the noise.
    """
    valid, step = image.depth > 0, _NOISE_STEP
    inverse = np.divide(1.0, image.depth, out=np.zeros(image.depth.shape), where=valid)
    middle = inverse[:, step:-step]
    bends = np.abs(inverse[:, 2 * step :] - 2 * middle + inverse[:, : -2 * step])
    is_whole = valid[:, 2 * step :] & valid[:, step:-step] & valid[:, : -2 * step]
    if not is_whole.any():
        return 0.0
    # 1.4826 turns the median of absolute values into a standard deviation; 1, -2, 1 has the norm sqrt(6).
    return float(1.4826 / np.sqrt(6) * np.median(bends[is_whole] / middle[is_whole]))


def _count(
    first: PosedDepth, second: PosedDepth, nearest: NDArray[np.float32], tolerance: float, noise: float
) -> NDArray[np.int64]:
    """Return how many points of ``first`` are compared, in front, and in front beyond the noise."""
    pose = second.cam_to_world
    seen = (first.points() - pose[:3, 3]) @ pose[:3, :3]
    seen = seen[seen[:, 2] > 1e-9]
    height, width = second.depth.shape
    column, row = np.floor((seen @ second.intrinsics.T)[:, :2] / seen[:, 2:]).T
    is_inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    depth = seen[is_inside, 2]
    limit = nearest[row[is_inside].astype(np.int64), column[is_inside].astype(np.int64)].astype(np.float64)
    is_known = limit > 0
    limit, depth = limit[is_known], depth[is_known]
    excess = limit - depth - tolerance
    if not len(limit):
        return np.zeros(3, np.int64)
    # Noise in metres grows with the square of the distance; ``noise`` is that at the middle one.
    scatter = noise * depth * np.maximum(1.0, depth / np.median(depth))
    return np.array([len(limit), (excess > 0).sum(), (excess > _NOISE_FACTOR * scatter).sum()])


def _nearest_of_nine(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Minimum over 3x3 pixels, where all nine are measured; 0 elsewhere and at the border."""
    padded = np.pad(depth, 1)
    least = np.full(depth.shape, np.inf, np.float32)
    for down in range(3):
        for right in range(3):
            part = padded[down : down + depth.shape[0], right : right + depth.shape[1]]
            np.minimum(least, np.where(part > 0, part, 0), out=least)
    return least
