"""From the source's world to the data set's: another axis up, another unit, another origin, each only when asked."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from data_gen.importers.conventions import world_rotation

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

    def poses(self, cam_to_world: Array) -> Array:
        """Convert camera poses (..., 4, 4)."""
        poses = cam_to_world.copy() if self.up == "z" else world_rotation(self.up) @ cam_to_world
        if self.scale != 1.0:
            poses[..., :3, 3] *= self.scale
        if self.shift.any():
            poses[..., :3, 3] += self.shift
        return poses

    def depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Convert a depth image."""
        return depth if self.scale == 1.0 else (depth * np.float64(self.scale)).astype(np.float32)
