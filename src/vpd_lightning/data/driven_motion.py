"""Motion that is given: what a robot, or any other tool, does in a recording, as points on its surface.

Unlike ground truth, it is an input: who simulates an action knows it beforehand. Any robot becomes points by its own
forward kinematics.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class DrivenMotion:
    """Points on what is driven, frame by frame. World frame, metres.

    ``groups`` says which rigid part a point belongs to. ``poses`` (part to world) are measured, ``commanded_poses`` are
    what the controller was asked for at that moment; None where the recording has none.
    """

    points: NDArray[np.float32]  # (time, particle, 3)
    normals: NDArray[np.float32]  # (time, particle, 3), outward
    groups: NDArray[np.int32]  # (particle,)
    poses: NDArray[np.float64] | None = None  # (time, group, 4, 4)
    commanded_poses: NDArray[np.float64] | None = None  # (time, group, 4, 4)

    @property
    def num_groups(self) -> int:
        return int(self.groups.max()) + 1

    @classmethod
    def carried(
        cls,
        points: NDArray[np.floating],
        normals: NDArray[np.floating],
        groups: NDArray[np.int32],
        poses: NDArray[np.float64],
        commanded_poses: NDArray[np.float64] | None = None,
    ) -> "DrivenMotion":
        """Return points and normals (particle, 3), each in its part's own frame, moved along ``poses``."""
        carrying = poses[:, groups]
        turned, facing = (np.einsum("tpij,pj->tpi", carrying[..., :3, :3], part) for part in (points, normals))
        moved = turned + carrying[..., :3, 3]
        return cls(moved.astype(np.float32), facing.astype(np.float32), groups, poses, commanded_poses)

    def at(self, frames: Sequence[int]) -> "DrivenMotion":
        """Return the motion of some frames."""
        chosen = list(frames)
        return DrivenMotion(
            points=self.points[chosen],
            normals=self.normals[chosen],
            groups=self.groups,
            poses=None if self.poses is None else self.poses[chosen],
            commanded_poses=None if self.commanded_poses is None else self.commanded_poses[chosen],
        )

    def as_arrays(self) -> dict[str, NDArray[Any]]:
        """Return what ``action/`` of a file holds."""
        arrays = {item.name: getattr(self, item.name) for item in fields(self)}
        return {name: values for name, values in arrays.items() if values is not None}
