"""unproject, project and pixel_rays against the pixel-by-pixel float64 reference."""

import numpy as np
import pytest
import torch

from tests.reference import reference_geometry as reference
from vpd_lightning.geometry.cameras import pixel_rays, project, unproject
from vpd_lightning.types import Cameras

HEIGHT, WIDTH = 5, 7


def _pose(generator: np.random.Generator) -> np.ndarray:
    rotation, _ = np.linalg.qr(generator.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    pose[:3, 3] = generator.uniform(-2, 2, 3)
    return pose


def _cameras(count: int) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(0)
    intrinsics = np.zeros((count, 3, 3))
    intrinsics[:, 0, 0], intrinsics[:, 1, 1] = generator.uniform(5, 9, count), generator.uniform(5, 9, count)
    intrinsics[:, 0, 2], intrinsics[:, 1, 2] = generator.uniform(3, 4, count), generator.uniform(2, 3, count)
    intrinsics[:, 2, 2] = 1
    return intrinsics, np.stack([_pose(generator) for _ in range(count)])


# float32: coordinates reach 5 m and pass through about ten roundings of 2^-24 each, 3e-6 m; pixels reach 50 after a
# division by a depth of at least 0.5, ten times that.
TOLERANCES = [(torch.float64, 1e-6, 1e-6), (torch.float32, 1e-5, 1e-3)]


@pytest.mark.parametrize(("dtype", "metres", "pixels"), TOLERANCES)
def test_unproject_project_and_rays_match_the_loops(dtype: torch.dtype, metres: float, pixels: float) -> None:
    intrinsics, poses = _cameras(3)
    depth = np.random.default_rng(1).uniform(0.5, 4.0, (3, HEIGHT, WIDTH))
    cameras = Cameras(torch.tensor(intrinsics).to(dtype), torch.tensor(poses).to(dtype), HEIGHT, WIDTH)

    points = unproject(torch.tensor(depth).to(dtype), cameras)
    rays = pixel_rays(cameras)
    assert points.dtype == rays.directions.dtype == dtype
    for view in range(3):
        expected = reference.unproject(depth[view], intrinsics[view], poses[view])
        np.testing.assert_allclose(points[view].numpy(), expected, rtol=metres, atol=metres)
        origins, directions = reference.pixel_rays(intrinsics[view], poses[view], HEIGHT, WIDTH)
        np.testing.assert_allclose(rays.origins[view].numpy(), origins, rtol=metres, atol=metres)
        np.testing.assert_allclose(rays.directions[view].numpy(), directions, rtol=metres, atol=metres)

        found_pixels, found_depths = project(torch.tensor(expected.reshape(-1, 3)).to(dtype), cameras[view])
        true_pixels, true_depths = reference.project(expected.reshape(-1, 3), intrinsics[view], poses[view])
        np.testing.assert_allclose(found_pixels.numpy(), true_pixels, rtol=pixels, atol=pixels)
        np.testing.assert_allclose(found_depths.numpy(), true_depths, rtol=metres, atol=metres)


def test_the_reference_itself_puts_the_optical_axis_where_the_conventions_say() -> None:
    intrinsics = np.array([[10.0, 0, 3.5], [0, 10.0, 2.5], [0, 0, 1]])
    points = reference.unproject(np.full((HEIGHT, WIDTH), 2.0), intrinsics, np.eye(4))
    # The principal point (3.5, 2.5) is the centre of pixel column 3, row 2: straight ahead, two metres along z.
    np.testing.assert_allclose(points[2, 3], [0, 0, 2])
    # One column to the right is 1/10 of the depth along +x, one row down 1/10 along +y.
    np.testing.assert_allclose(points[3, 4], [0.2, 0.2, 2])


def test_depth_is_along_the_optical_axis_not_along_the_ray() -> None:
    intrinsics, poses = _cameras(1)
    cameras = Cameras(torch.tensor(intrinsics[0]), torch.tensor(poses[0]), HEIGHT, WIDTH)
    points = unproject(torch.full((HEIGHT, WIDTH), 3.0, dtype=torch.float64), cameras)
    forward = torch.tensor(poses[0, :3, 2])
    along_axis = ((points - torch.tensor(poses[0, :3, 3])) * forward).sum(-1)
    np.testing.assert_allclose(along_axis.numpy(), 3.0, rtol=1e-6)


def test_one_camera_serves_several_depth_images() -> None:
    intrinsics, poses = _cameras(1)
    cameras = Cameras(torch.tensor(intrinsics[0]), torch.tensor(poses[0]), HEIGHT, WIDTH)
    depth = np.random.default_rng(2).uniform(0.5, 4.0, (2, 3, HEIGHT, WIDTH))
    points = unproject(torch.tensor(depth), cameras)
    for time in range(2):
        for view in range(3):
            expected = reference.unproject(depth[time, view], intrinsics[0], poses[0])
            np.testing.assert_allclose(points[time, view].numpy(), expected, rtol=1e-6, atol=1e-6)
