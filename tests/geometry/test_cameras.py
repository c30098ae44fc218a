import torch
from scipy.spatial.transform import Rotation

from vpd_lightning.geometry.cameras import pixel_rays, project, rays_through, unproject
from vpd_lightning.types import Cameras


def random_cameras(shape=(2, 3), height=6, width=9, seed=0):
    generator = torch.Generator().manual_seed(seed)
    count = int(torch.tensor(shape).prod())
    rotation = torch.from_numpy(Rotation.random(count, rng=seed).as_matrix())
    cam_to_world = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    cam_to_world[:, :3, :3] = rotation
    cam_to_world[:, :3, 3] = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    intrinsics = torch.tensor([[7.0, 0.3, 4.2], [0.0, 8.0, 3.1], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return Cameras(
        intrinsics.expand(*shape, 3, 3).clone(), cam_to_world.reshape(*shape, 4, 4), height=height, width=width
    )


def test_project_inverts_unproject():
    cameras = random_cameras()
    depth = torch.rand(2, 3, 6, 9, dtype=torch.float64) + 0.5

    pixels, z = project(unproject(depth, cameras), cameras)

    assert torch.allclose(z, depth, atol=1e-12)
    x = torch.arange(9, dtype=torch.float64) + 0.5
    assert torch.allclose(pixels[..., 0], x.expand(2, 3, 6, 9), atol=1e-10)


def test_rays_pass_through_unprojected_points():
    cameras = random_cameras()
    depth = torch.rand(2, 3, 6, 9, dtype=torch.float64) + 0.5

    rays = pixel_rays(cameras)

    offset = unproject(depth, cameras) - rays.origins
    along = (offset * rays.directions).sum(-1, keepdim=True)
    assert torch.allclose(offset, along * rays.directions, atol=1e-12)
    assert (along > 0).all()
    assert torch.allclose(rays.directions.norm(dim=-1), torch.ones(2, 3, 6, 9, dtype=torch.float64))


def test_rays_through_pixel_centres_are_pixel_rays():
    cameras = random_cameras(shape=(4,))
    centre = torch.tensor([2.5, 1.5], dtype=torch.float64).expand(4, 1, 2)

    rays = rays_through(cameras, centre)

    assert torch.allclose(rays.directions[:, 0], pixel_rays(cameras).directions[:, 1, 2])


def test_moving_the_world_moves_the_points_alike():
    cameras = random_cameras(shape=(3,))
    depth = torch.rand(3, 6, 9, dtype=torch.float64) + 0.5
    motion = random_cameras(shape=(1,), seed=5).cam_to_world[0]

    moved = Cameras(cameras.intrinsics, motion @ cameras.cam_to_world, 6, 9)

    expected = unproject(depth, cameras) @ motion[:3, :3].T + motion[:3, 3]
    assert torch.allclose(unproject(depth, moved), expected, atol=1e-12)


def test_float32_stays_float32_and_is_close():
    cameras = random_cameras()
    depth = torch.rand(2, 3, 6, 9, dtype=torch.float64) + 0.5

    single = unproject(depth.float(), cameras.to(torch.float32))

    assert single.dtype == torch.float32
    # a metre-sized scene in float32: a few ulp of 1 m
    assert (single.double() - unproject(depth, cameras)).abs().max() < 2e-6


def test_autocast_does_not_touch_geometry():
    cameras = random_cameras(shape=(2,)).to(torch.float32)
    depth = torch.rand(2, 6, 9) + 0.5
    expected = unproject(depth, cameras)

    with torch.autocast("cpu", dtype=torch.bfloat16):
        points = unproject(depth, cameras)

    assert torch.equal(points, expected)
