"""Which images of a recording belong together, where it has gaps, and where a moving camera was at any time.

All times are integers of nanoseconds: as float64 seconds since 1970 they would be good to a quarter of a microsecond
only.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from data_gen.importers.recording import MIN_FRAMES

Times = NDArray[np.int64]
_GAP = 1.5  # frame times between neighbours; above, at least one frame is missing
_POSE_GAP = 0.1  # s; over this, 2 m/s2 of acceleration bend a path 2.5 mm away from the chord


def nearest(times: Times, wanted: Times, max_difference: int) -> NDArray[np.int64]:
    """Return for each wanted time the index of the nearest of ``times`` (increasing), or -1.

    Each index is given once, to the wanted time closest to it: a frame that is missing in one stream must not be
    replaced by its neighbour.
    """
    if len(times) == 0:
        return np.full(len(wanted), -1)
    after = np.clip(np.searchsorted(times, wanted), 1, max(len(times) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(times) - 1)
    index = np.where(wanted - times[before] <= times[after] - wanted, before, after)
    difference = np.abs(times[index] - wanted)
    order = np.lexsort((difference, index))
    is_first = np.ones(len(order), bool)
    is_first[1:] = index[order][1:] != index[order][:-1]
    is_taken = np.zeros(len(order), bool)
    is_taken[order] = is_first
    return np.where(is_taken & (difference <= max_difference), index, -1)


def usual_step(times: Times) -> float:
    """Return the time between frames in seconds, to the microsecond: the mean of the steps that are no gaps.

    0 for fewer than two frames.
    """
    if len(times) < 2:
        return 0.0
    steps = np.diff(times)
    return round(float(steps[steps <= _GAP * np.median(steps)].mean()) * 1e-9, 6)


def runs_without_gap(times: Times, frame_time: float) -> list[slice]:
    """Cut a sequence where frames are missing; the pieces have at least ``MIN_FRAMES`` frames each.

    A model that learns motion per frame must not see a jump of two frames as one.
    """
    cuts = np.flatnonzero(np.diff(times) > _GAP * frame_time * 1e9) + 1
    edges = [0, *cuts.tolist(), len(times)]
    pieces = zip(edges[:-1], edges[1:], strict=True)
    return [slice(start, stop) for start, stop in pieces if stop - start >= MIN_FRAMES]


def pose_gap(max_time_difference: float) -> int:
    """Return how many ns apart two poses may be to interpolate between them: 0.1 s, or more where more is allowed."""
    return round(max(_POSE_GAP, 2 * max_time_difference) * 1e9)


@dataclass(frozen=True)
class PoseTrack:
    """Poses of one frame in another over time.

    Attributes:
        times: (sample,) ns, strictly increasing.
        matrices: (sample, 4, 4), from the moving frame to the other.
    """

    times: Times
    matrices: NDArray[np.float64]

    def at(self, wanted: Times, max_gap: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return poses (time, 4, 4) between the samples around each time, and whether there are such samples.

        Positions are interpolated linearly, rotations along the shortest arc. A time before the first or after the last
        sample, or between two samples more than ``max_gap`` ns apart, has no pose (identity is given).
        """
        poses = np.broadcast_to(np.eye(4), (len(wanted), 4, 4)).copy()
        inside = (wanted >= self.times[0]) & (wanted <= self.times[-1])
        after = np.clip(np.searchsorted(self.times, wanted), 0, len(self.times) - 1)
        before = np.maximum(after - 1, 0)
        exact = inside & (self.times[after] == wanted)  # also covers a track of one sample
        known = exact | (inside & (self.times[after] - self.times[before] <= max_gap))
        poses[exact] = self.matrices[after[exact]]
        between = known & ~exact
        if between.any():
            seconds = (self.times - self.times[0]) * 1e-9
            moments = (wanted[between] - self.times[0]) * 1e-9
            rotations = Slerp(seconds, Rotation.from_matrix(self.matrices[:, :3, :3]))
            poses[between, :3, :3] = rotations(moments).as_matrix()
            for axis in range(3):
                poses[between, axis, 3] = np.interp(moments, seconds, self.matrices[:, axis, 3])
        return poses, known
