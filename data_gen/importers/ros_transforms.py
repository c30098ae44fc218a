"""The tree of frames that ``/tf`` and ``/tf_static`` span, and poses in it at any time."""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from data_gen.importers.conventions import invert_pose, pose_matrix, rotation_from_quaternion
from data_gen.importers.frame_times import PoseTrack, Times
from vpd_lightning.errors import DataError


class TransformTree:
    """Collects transforms and chains them; frame names lose a leading slash, as in ROS 2."""

    def __init__(self) -> None:
        self._parents: dict[str, str] = {}
        self._static: dict[str, NDArray[np.float64]] = {}
        self._moving: dict[str, dict[int, NDArray[np.float64]]] = defaultdict(dict)
        self._tracks: dict[str, PoseTrack] = {}

    def add(
        self,
        parent: str,
        child: str,
        time: int,
        translation: Sequence[float],
        rotation: Sequence[float],
        is_static: bool,
    ) -> None:
        """Add one transform, which takes points from child to parent.

        Args:
            parent: its ``header.frame_id``.
            child: its ``child_frame_id``.
            time: ns; of no meaning where it is static.
            translation: x y z in metres.
            rotation: quaternion x y z w.
            is_static: from ``/tf_static``.

        Raises:
            DataError: the numbers are no transform, or the child has another parent already.
        """
        parent, child = frame_name(parent), frame_name(child)
        values = np.array([*translation, *rotation], np.float64)
        if not np.isfinite(values).all() or abs(np.linalg.norm(values[3:]) - 1) > 0.01:
            raise DataError(f"tf: the transform from {child} to {parent} holds no unit quaternion, or NaN.")
        if self._parents.setdefault(child, parent) != parent:
            raise DataError(
                f"tf: {child} has two parents, {self._parents[child]} and {parent}.\n"
                "Give the cameras' poses in mapping=FILE (cam_to_world), or mend the tree."
            )
        pose = pose_matrix(rotation_from_quaternion(values[3:], "xyzw"), values[:3])
        if is_static:
            self._static[child] = pose
        else:
            self._moving[child][time] = pose
            self._tracks.pop(child, None)

    @property
    def frames(self) -> list[str]:
        """All frames by name."""
        return sorted({*self._parents, *self._parents.values()})

    def root(self, frame: str) -> str:
        """Return the frame at the top of the tree in which a frame hangs."""
        return self._chain(frame_name(frame))[-1]

    def poses(
        self, frame: str, world: str, times: Times, max_gap: int
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return poses (time, 4, 4) of a frame in the world frame, and whether each is known.

        Raises:
            DataError: the two frames are not connected.
        """
        frame, world = frame_name(frame), frame_name(world)
        above_frame, above_world = self._chain(frame), self._chain(world)
        shared = next((name for name in above_frame if name in above_world), None)
        if shared is None:
            raise DataError(
                f"tf does not connect {frame} with {world}: their roots are {above_frame[-1]} and {above_world[-1]}.\n"
                f"Frames in the bag: {', '.join(self.frames[:12]) or 'none'}."
            )
        frame_in_shared, known = self._climb(above_frame[: above_frame.index(shared)], times, max_gap)
        world_in_shared, also_known = self._climb(above_world[: above_world.index(shared)], times, max_gap)
        return invert_pose(world_in_shared) @ frame_in_shared, known & also_known

    def fixed_pose(self, frame: str, other: str) -> NDArray[np.float64] | None:
        """Return the pose (4, 4) of a frame in another that never moves against it; None where there is none."""
        frame, other = frame_name(frame), frame_name(other)
        above, above_other = self._chain(frame), self._chain(other)
        shared = next((name for name in above if name in above_other), None)
        if shared is None:
            return None
        between = [*above[: above.index(shared)], *above_other[: above_other.index(shared)]]
        if not all(name in self._static for name in between):
            return None
        return self.poses(frame, other, np.zeros(1, np.int64), 0)[0][0]

    def _chain(self, frame: str) -> list[str]:
        """Return a frame and all frames above it."""
        chain = [frame]
        while (parent := self._parents.get(chain[-1])) is not None:
            if parent in chain:
                raise DataError(f"tf: the frames {' > '.join([*chain, parent])} run in a circle.")
            chain.append(parent)
        return chain

    def _climb(self, frames: list[str], times: Times, max_gap: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return the pose of the first frame in the parent of the last one."""
        poses = np.broadcast_to(np.eye(4), (len(times), 4, 4))
        known = np.ones(len(times), bool)
        for frame in frames:
            if frame in self._static:
                poses = self._static[frame] @ poses
            else:
                step, is_known = self._track(frame).at(times, max_gap)
                poses, known = step @ poses, known & is_known
        return poses, known

    def _track(self, frame: str) -> PoseTrack:
        if frame not in self._tracks:
            samples = self._moving[frame]
            order = sorted(samples)
            self._tracks[frame] = PoseTrack(np.array(order, np.int64), np.stack([samples[time] for time in order]))
        return self._tracks[frame]


def frame_name(name: str) -> str:
    """Return a frame's name without ROS 1's leading slash."""
    return name.lstrip("/")
