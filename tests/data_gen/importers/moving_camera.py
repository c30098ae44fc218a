"""A camera on a straight path that turns at a constant rate, and what must hold of a recording made with it."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from data_gen.importers.recording import Recording
from data_gen.importers.run import import_recordings
from data_gen.inspection.validate import Report, check_dataset
from tests.data_gen.importers.known_scene import Array, camera, distance_to_surfaces, unproject

HEIGHT, WIDTH = 48, 64
FOCAL = 70.0
INTRINSICS = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])  # pixel centres at +0.5


def pose(time: float, azimuth: float = 20.0, elevation: float = 40.0, radius: float = 2.2) -> Array:
    """cam_to_world (4, 4), OpenCV axes; linear in position and along one arc in rotation, so interpolation is exact."""
    result = camera(azimuth, elevation, radius, HEIGHT, WIDTH)[1]
    result[:3, :3] = Rotation.from_rotvec(np.array([0.3, -0.6, 0.4]) * time).as_matrix() @ result[:3, :3]
    result[:3, 3] += np.array([1.2, 0.9, 0.6]) * time
    return result


def side_pose(time: float = 0.0) -> Array:
    """Another camera's pose, from higher up and nearer, so that no convention looks the same from both."""
    return pose(time, 75.0, 62.0, 1.8)


def opengl(cam_to_world: Array) -> Array:
    """The same camera with x right, y up, z back."""
    return cam_to_world @ np.diag([1.0, -1.0, -1.0, 1.0])


def quaternion_wxyz(matrix: Array) -> Array:
    """Quaternion of a pose's rotation."""
    return Rotation.from_matrix(matrix[:3, :3]).as_quat(scalar_first=True)


def largest_surface_distance(recording: Recording, times: list[float]) -> float:
    """Metres from the surfaces of the known scene of the worst pixel; at least 90 % of the pixels must be measured."""
    worst = 0.0
    for frame, time in enumerate(times):
        for view in range(recording.num_views):
            depth = recording.read_depth(frame, view)
            assert depth.dtype == np.float32 and depth.shape == (recording.height, recording.width)
            assert (depth > 0).mean() > 0.9
            intrinsics, cam_to_world = recording.intrinsics_at(frame)[view], recording.cam_to_world[frame][view]
            worst = max(worst, float(distance_to_surfaces(unproject(depth, intrinsics, cam_to_world), time).max()))
    return worst


def import_and_validate(source: Path, out: Path, **overrides: object) -> Report:
    """Import a source and return what ``vpd-data validate`` says of it."""
    return check_dataset(import_recordings(source, out, overrides))
