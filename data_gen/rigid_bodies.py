"""The ground truth of bodies on free joints, noted frame by frame."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vpd_lightning.data import schema


class RigidBodies:
    """Notes poses and velocities of the bodies 1 ... ``num_bodies``, whose free joints are the model's first joints.

    Each body's frame must have its origin in the centre of mass (true for centred primitives; give meshes an
    ``inertial`` or centre them), for positions and linear velocities are those of the frame's origin.
    """

    def __init__(self, data: Any, num_bodies: int, num_frames: int) -> None:
        self.data, self.num_bodies = data, num_bodies
        self.positions, self.linear, self.angular = (np.empty((num_frames, num_bodies, 3)) for _ in range(3))
        self.quaternions = np.empty((num_frames, num_bodies, 4))

    def observe(self, frame: int) -> None:
        """Note the state that ``data`` holds as that of ``frame``."""
        poses = self.data.qpos[: 7 * self.num_bodies].reshape(-1, 7)
        velocities = self.data.qvel[: 6 * self.num_bodies].reshape(-1, 6)
        rotations = self.data.xmat[1 : 1 + self.num_bodies].reshape(-1, 3, 3)
        self.positions[frame], self.quaternions[frame] = poses[:, :3], poses[:, 3:]
        self.linear[frame] = velocities[:, :3]
        # MuJoCo gives angular velocities in the body's frame.
        self.angular[frame] = (rotations @ velocities[:, 3:, None])[..., 0]

    def state(self, half_sizes: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
        """Return the arrays of ``state/``; ``half_sizes`` (object, 3) are metres along the bodies' own axes."""
        return {
            schema.STATE_POSITIONS: self.positions,
            schema.STATE_QUATERNIONS: self.quaternions,
            schema.STATE_LINEAR_VELOCITIES: self.linear,
            schema.STATE_ANGULAR_VELOCITIES: self.angular,
            schema.STATE_HALF_SIZES: half_sizes,
        }
