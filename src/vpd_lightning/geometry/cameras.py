"""Pinhole projection between pixels, camera rays and world points (OpenCV axes, z-depth, pixel centres at +0.5)."""

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.types import Cameras, Rays


def pixel_centers(cameras: Cameras) -> Float[Tensor, "height width 2"]:
    """Return the (x, y) coordinates of all pixel centres, in pixels."""
    like = {"dtype": cameras.intrinsics.dtype, "device": cameras.intrinsics.device}
    y, x = torch.meshgrid(
        torch.arange(cameras.height, **like) + 0.5, torch.arange(cameras.width, **like) + 0.5, indexing="ij"
    )
    return torch.stack([x, y], dim=-1)


def _camera_directions(cameras: Cameras, pixels: Float[Tensor, "*shape point 2"]) -> Float[Tensor, "*shape point 3"]:
    """Return the point at z-depth 1 behind each pixel, in camera coordinates."""
    k = cameras.intrinsics[..., None, :, :]
    y = (pixels[..., 1] - k[..., 1, 2]) / k[..., 1, 1]
    x = (pixels[..., 0] - k[..., 0, 2] - k[..., 0, 1] * y) / k[..., 0, 0]
    return torch.stack([x, y, torch.ones_like(x)], dim=-1)


def _rotate(cam_to_world: Float[Tensor, "*camera 4 4"], vectors: Float[Tensor, "*shape point 3"]) -> Tensor:
    """Rotate camera vectors to the world by explicit sums: autocast may not lower the precision of geometry."""
    rotation = cam_to_world[..., None, :3, :3]
    x, y, z = (vectors[..., axis : axis + 1] * rotation[..., axis] for axis in range(3))
    return x + y + z


def unproject(depth: Float[Tensor, "*shape height width"], cameras: Cameras) -> Float[Tensor, "*shape height width 3"]:
    """Lift every pixel to the world point at its z-depth (metres). Paper section 3.1.

    Pixels without a measurement (0 or non-finite depth) give points that mean nothing; mask them by the depth.
    """
    height, width = depth.shape[-2:]
    if (height, width) != (cameras.height, cameras.width):
        raise ValueError(f"depth is {height}x{width}, but the cameras are {cameras.height}x{cameras.width}")
    pixels = pixel_centers(cameras).flatten(0, 1).expand(*cameras.shape, -1, -1)
    points = _camera_directions(cameras, pixels) * depth.flatten(-2)[..., None]
    world = _rotate(cameras.cam_to_world, points) + cameras.cam_to_world[..., None, :3, 3]
    return world.unflatten(-2, (height, width))


def project(
    points: Float[Tensor, "*shape 3"], cameras: Cameras
) -> tuple[Float[Tensor, "*shape 2"], Float[Tensor, "*shape"]]:
    """Project world points to (pixel coordinates, z-depth in metres).

    The cameras' leading axes must be leading axes of the points. Points behind the camera have negative depth.
    """
    extra = points.dim() - 1 - len(cameras.shape)
    if extra < 0:
        raise ValueError(f"points {tuple(points.shape)} have fewer leading axes than cameras {tuple(cameras.shape)}")
    ones = (1,) * extra
    cam_to_world = cameras.cam_to_world.reshape(*cameras.shape, *ones, 4, 4)
    k = cameras.intrinsics.reshape(*cameras.shape, *ones, 3, 3)
    offset = points - cam_to_world[..., :3, 3]
    local = (cam_to_world[..., :3, :3] * offset[..., :, None]).sum(dim=-2)  # inverse of a rotation is its transpose
    depth = local[..., 2]
    x, y = local[..., 0] / depth, local[..., 1] / depth
    pixels = torch.stack([k[..., 0, 0] * x + k[..., 0, 1] * y + k[..., 0, 2], k[..., 1, 1] * y + k[..., 1, 2]], dim=-1)
    return pixels, depth


def rays_through(cameras: Cameras, pixels: Float[Tensor, "*shape point 2"]) -> Rays:
    """Return the world rays through the given pixel coordinates (x, y); directions have unit length."""
    directions = _rotate(cameras.cam_to_world, _camera_directions(cameras, pixels))
    directions = directions / directions.norm(dim=-1, keepdim=True)
    origins = cameras.cam_to_world[..., None, :3, 3].expand_as(directions)
    return Rays(origins=origins, directions=directions)


def pixel_rays(cameras: Cameras) -> Rays:
    """Return the ray through every pixel centre, with axes ``... height width 3``."""
    pixels = pixel_centers(cameras).flatten(0, 1).expand(*cameras.shape, -1, -1)
    rays = rays_through(cameras, pixels)
    shape = (cameras.height, cameras.width)
    return Rays(rays.origins.unflatten(-2, shape), rays.directions.unflatten(-2, shape))
