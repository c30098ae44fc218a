"""Single depth images with their cameras, and which of them are worth comparing."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vpd_lightning.data.reader import TrajectoryReader

Array = NDArray[np.float64]
ImageKey = tuple[int, int]  # frame, view
_BEST_ANGLE = 35.0  # degrees between two cameras: much parallax, and still mostly the same surfaces
_MAX_VIEWS = 32  # evenly chosen: pairs grow with the square
_MAX_TIMES_FIXED, _MAX_TIMES_MOVING = 3, 12


@dataclass(frozen=True)
class PosedDepth:
    """One view at one time: z-depth (height, width) in metres, 0 = none; intrinsics (pixels); cam_to_world (metres)."""

    depth: NDArray[np.float32]
    intrinsics: Array
    cam_to_world: Array

    def points(self) -> Array:
        """Return the measured points (point, 3) in the world, metres."""
        rows, columns = np.nonzero(self.depth > 0)
        points = rays(self.intrinsics, columns, rows) * self.depth[rows, columns].astype(np.float64)[:, None]
        return points @ self.cam_to_world[:3, :3].T + self.cam_to_world[:3, 3]


def rays(intrinsics: Array, columns: NDArray[np.int64], rows: NDArray[np.int64]) -> Array:
    """Rays (point, 3) in the camera, one unit along the optical axis; pixel centres at +0.5."""
    y = (rows + 0.5 - intrinsics[1, 2]) / intrinsics[1, 1]
    x = (columns + 0.5 - intrinsics[0, 2] - intrinsics[0, 1] * y) / intrinsics[0, 0]
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def read_posed_depth(reader: TrajectoryReader, keys: Sequence[ImageKey]) -> dict[ImageKey, PosedDepth]:
    """Read the named images, each once."""
    images = {}
    for time, view in dict.fromkeys(keys):
        intrinsics, cam_to_world = (part[0, 0] for part in reader.cameras([time], [view]))
        images[time, view] = PosedDepth(reader.depth([time], [view])[0, 0], intrinsics, cam_to_world)
    return images


def choose_pairs(
    reader: TrajectoryReader, max_pairs: int, times: Sequence[int] | None = None
) -> list[tuple[ImageKey, ImageKey]]:
    """Choose ordered pairs of images to compare: views of one time, and with moving cameras also one view at two times.

    Preferred are pairs whose cameras are turned against each other by some 35 degrees, spread over views and times.
    That angle stays the same when poses are inverted or their axes flipped, so wrong conventions change no choice.
    """
    is_moving = not reader.is_static_cameras
    if times is None:
        count = min(reader.num_frames, _MAX_TIMES_MOVING if is_moving else _MAX_TIMES_FIXED)
        times = np.unique(np.linspace(0, reader.num_frames - 1, count).round().astype(int)).tolist()
    views = np.unique(np.linspace(0, reader.num_views - 1, _MAX_VIEWS).round().astype(int)).tolist()
    rotations = {
        (time, view): pose[:3, :3]
        for time, poses in zip(times, reader.cameras(list(times))[1], strict=True)
        for view, pose in zip(views, poses, strict=True)
    }
    pairs = [(a, b) for a in rotations for b in rotations if a[0] == b[0] and a[1] != b[1]]
    if is_moving:
        pairs += [(a, b) for a in rotations for b in rotations if a[0] != b[0] and a[1] == b[1]]
    # Rounded, so that equal angles keep their order whatever the machine's last digits.
    angles = {pair: round(angle_between(rotations[pair[0]], rotations[pair[1]]), 3) for pair in pairs}
    pairs.sort(key=lambda pair: abs(angles[pair] - _BEST_ANGLE))
    chosen: list[tuple[ImageKey, ImageKey]] = []
    uses: dict[ImageKey, int] = dict.fromkeys(rotations, 0)
    limit = 1
    while len(chosen) < min(max_pairs, len(pairs)):  # every image once before any is used more often
        for pair in pairs:
            if len(chosen) < max_pairs and pair not in chosen and max(uses[pair[0]], uses[pair[1]]) < limit:
                chosen.append(pair)
                uses[pair[0]] += 1
                uses[pair[1]] += 1
        limit += 1
    return chosen


def angle_between(first: Array, second: Array) -> float:
    """Return by how many degrees two rotations differ."""
    return float(np.degrees(np.arccos(np.clip((np.trace(first.T @ second) - 1) / 2, -1, 1))))
