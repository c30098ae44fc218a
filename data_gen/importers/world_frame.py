"""From the source's world to the data set's: another axis up, another unit, another origin, each only when asked."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from data_gen.importers.conventions import world_rotation
from vpd_lightning.data.driven_motion import DrivenMotion

Array = NDArray[np.float64]


@dataclass(frozen=True)
class WorldFrame:
    """A similarity: turn, then scale, then shift. Without any of them values pass through bit by bit.

    Attributes:
        up: axis of the source's world that points up.
        scale: metres per unit of the source.
        shift: metres, added to all positions.
    """

    up: str = "z"
    scale: float = 1.0
    shift: Array = field(default_factory=lambda: np.zeros(3))

    def poses(self, to_world: Array) -> Array:
        """Convert poses (..., 4, 4) of cameras and links."""
        poses = to_world.copy() if self.up == "z" else world_rotation(self.up) @ to_world
        if self.scale != 1.0:
            poses[..., :3, 3] *= self.scale
        if self.shift.any():
            poses[..., :3, 3] += self.shift
        return poses

    def driven(self, motion: DrivenMotion) -> DrivenMotion:
        """Convert what a robot did."""
        turn = world_rotation(self.up)[:3, :3]
        return DrivenMotion(
            points=((motion.points @ turn.T) * self.scale + self.shift).astype(np.float32),
            normals=(motion.normals @ turn.T).astype(np.float32),
            groups=motion.groups,
            poses=None if motion.poses is None else self.poses(motion.poses),
            commanded_poses=None if motion.commanded_poses is None else self.poses(motion.commanded_poses),
        )

    def depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Convert a depth image."""
        return depth if self.scale == 1.0 else (depth * np.float64(self.scale)).astype(np.float32)
