"""Tiny ready-made inputs: a ball that moves over a floor, seen by two cameras. Metres, world z up, float64."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.geometry.cameras import pixel_rays
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Cameras, Particles, Rays, RGBDFrames, VideoBatch

FEATURE_DIM = 6
NUM_VIEWS = 2
IMAGE_SIZE = 16  # pixels, height and width
NEAR, FAR = 0.3, 5.0
WORKSPACE_MIN, WORKSPACE_MAX = (-0.6, -0.6, -0.1), (0.6, 0.6, 0.6)

_RADIUS = 0.15
_VELOCITY = (0.03, 0.02, -0.02)  # metres per step
_CENTERS = ((0.05, -0.05, 0.3), (-0.1, 0.1, 0.25), (0.1, 0.1, 0.35))


def keys_for(batch_size: int) -> RandomKeys:
    """Return keys of a training step; member i of the batch has sample index i."""
    return RandomKeys(seed=3, step=5, sample_index=list(range(batch_size)))


def ring_cameras(num_views: int = NUM_VIEWS, size: int = IMAGE_SIZE) -> Cameras:
    """Return cameras (axis ``view``) on a ring of radius 1.1 m, 1 m high, that look at the middle of the scene."""
    angle = 2 * torch.pi * torch.arange(num_views, dtype=torch.float64) / num_views + 0.3
    eye = torch.stack([1.1 * angle.cos(), 1.1 * angle.sin(), torch.ones_like(angle)], dim=-1)
    forward = torch.nn.functional.normalize(eye.new_tensor([0.0, 0.0, 0.15]) - eye, dim=-1)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, eye.new_tensor([[0.0, 0.0, 1.0]])), dim=-1)
    cam_to_world = torch.eye(4, dtype=torch.float64).repeat(num_views, 1, 1)
    cam_to_world[:, :3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=-1)
    cam_to_world[:, :3, 3] = eye
    focal, middle = 1.2 * size, size / 2
    intrinsics = eye.new_tensor([[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]])
    return Cameras(intrinsics.repeat(num_views, 1, 1), cam_to_world, size, size)


def ball_frames(batch_size: int = 2, time: float = 0.0, has_ball: bool = True) -> RGBDFrames:
    """Return images (axes ``batch view``) of the ball and the floor after ``time`` steps, or of the floor alone.

    Every member of the batch has its own ball; the floor and the cameras are the same for all.
    """
    cameras = ring_cameras()
    rays = pixel_rays(cameras)
    forward = cameras.cam_to_world[:, None, None, :3, 2]
    floor = -rays.origins[..., 2] / rays.directions[..., 2]
    floor = torch.where((floor > 0) & (floor < FAR), floor, torch.inf)
    colors, depths = [], []
    for member in range(batch_size):
        distance, is_ball = floor, torch.zeros_like(floor, dtype=torch.bool)
        if has_ball:
            hit = _ball_distance(rays, _center(member, time))
            distance, is_ball = torch.minimum(hit, floor), hit < floor
        points = rays.origins + distance.nan_to_num(posinf=FAR)[..., None] * rays.directions
        colors.append(torch.where(is_ball[..., None], 0.5 + points, _floor_color(points)).clamp(0, 1))
        depth = distance * (rays.directions * forward).sum(dim=-1)
        depths.append(torch.where(torch.isfinite(depth), depth, 0.0))
    return RGBDFrames(
        rgb=(255 * torch.stack(colors)).round().to(torch.uint8),
        depth=torch.stack(depths),
        cameras=Cameras(
            cameras.intrinsics.expand(batch_size, -1, -1, -1),
            cameras.cam_to_world.expand(batch_size, -1, -1, -1),
            IMAGE_SIZE,
            IMAGE_SIZE,
        ),
    )


def ball_particles(
    batch_size: int = 2, num_particles: int = 40, feature_dim: int = FEATURE_DIM
) -> tuple[Particles, Particles]:
    """Return (previous, current) particles: half of them on the ball, half on the floor, in random order of slots.

    The two sets are drawn independently, so that there are no correspondences between them. They carry all optional
    observations: colours, normals, and which particles may be moving (those of the ball).
    """
    previous = [_draw(member, 0, num_particles, feature_dim) for member in range(batch_size)]
    current = [_draw(member, 1, num_particles, feature_dim) for member in range(batch_size)]
    return _stacked(previous), _stacked(current)


def scene_rays(batch_size: int = 2, num_rays: int = 12) -> Rays:
    """Return rays (axes ``batch ray``) through pixels of the cameras; every member has its own."""
    rays = pixel_rays(ring_cameras())
    generator = torch.Generator().manual_seed(11)
    index = torch.randint(0, rays.origins[..., 0].numel(), (batch_size, num_rays), generator=generator)
    return Rays(rays.origins.reshape(-1, 3)[index], rays.directions.reshape(-1, 3)[index])


def video_batch(batch_size: int = 2, num_steps: int = 2, num_rays: int = 12) -> VideoBatch:
    """Return a training batch: two context frames, and rays of the steps after them with random colours."""
    frames = [ball_frames(batch_size, time) for time in (0.0, 1.0)]
    rays = [scene_rays(batch_size, num_rays) for _ in range(num_steps)]
    generator = torch.Generator().manual_seed(12)
    first = frames[0].cameras
    return VideoBatch(
        context=RGBDFrames(
            rgb=torch.stack([frame.rgb for frame in frames], dim=1),
            depth=torch.stack([frame.depth for frame in frames], dim=1),
            cameras=replace(
                first,
                intrinsics=torch.stack([first.intrinsics] * 2, dim=1),
                cam_to_world=torch.stack([first.cam_to_world] * 2, dim=1),
            ),
        ),
        rays=Rays(
            torch.stack([step.origins for step in rays], dim=1), torch.stack([step.directions for step in rays], dim=1)
        ),
        rgbs=torch.rand(batch_size, num_steps, num_rays, 3, generator=generator, dtype=torch.float64),
        keys=keys_for(batch_size),
        clips=[f"clip{member}@0" for member in range(batch_size)],
    )


def _center(member: int, time: float) -> Float[Tensor, "3"]:
    start = torch.tensor(_CENTERS[member % len(_CENTERS)], dtype=torch.float64)
    return start + time * torch.tensor(_VELOCITY, dtype=torch.float64)


def _ball_distance(rays: Rays, center: Float[Tensor, "3"]) -> Float[Tensor, "view height width"]:
    offset = rays.origins - center
    half = (offset * rays.directions).sum(dim=-1)
    root = half.square() - offset.square().sum(dim=-1) + _RADIUS**2
    return torch.where(root >= 0, -half - root.clamp(min=0).sqrt(), torch.inf)


def _floor_color(points: Float[Tensor, "*shape 3"]) -> Float[Tensor, "*shape 3"]:
    wave = 0.2 * torch.sin(5 * points[..., :1] + 3 * points[..., 1:2])
    return points.new_tensor([0.6, 0.5, 0.4]) + wave


def _draw(member: int, time: int, num_particles: int, feature_dim: int) -> Particles:
    """Return the particles of one member at one time, without a batch axis."""
    generator = torch.Generator().manual_seed(100 * member + time)
    num_ball = num_particles // 2
    like = {"generator": generator, "dtype": torch.float64}
    outward = torch.nn.functional.normalize(torch.randn(num_ball, 3, **like), dim=-1)
    floor = torch.rand(num_particles - num_ball, 3, **like) - 0.5
    floor[:, 2] = 0.0
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(floor)
    positions = torch.cat([_center(member, time) + _RADIUS * outward, floor])
    order = torch.randperm(num_particles, generator=generator)
    return Particles(
        positions=positions[order],
        features=torch.rand(num_particles, feature_dim, **like),
        colors=torch.cat([0.5 + 0.5 * outward, _floor_color(floor)])[order],
        moving=(torch.arange(num_particles) < num_ball)[order],
        normals=torch.cat([outward, up])[order],
    )


def _stacked(members: Sequence[Particles]) -> Particles:
    names = ("positions", "features", "mask", "colors", "moving", "normals")
    return Particles(**{name: torch.stack([getattr(member, name) for member in members]) for name in names})
