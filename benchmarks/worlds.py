"""Made-up input of any size: particles on a floor and boxes, and RGB-D video of a rising ball. Metres."""

import math

import torch
from torch import Tensor

from vpd_lightning.geometry.cameras import pixel_rays
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Cameras, Particles, Rays, RGBDFrames, Scenery, VideoBatch

# Middle and half sizes of boxes on the floor of the workspace of +-1 m.
BOXES = (
    ((0.0, 0.0, 0.2), (0.2, 0.15, 0.2)),
    ((0.5, 0.4, 0.12), (0.15, 0.15, 0.12)),
    ((-0.5, 0.3, 0.3), (0.1, 0.2, 0.1)),
    ((-0.3, -0.6, 0.1), (0.25, 0.1, 0.1)),
)
BOX_SHARE = 0.35  # of the particles; a camera that looks at boxes sees more of them than their share of the floor


def surface_particles(count: int, seed: int = 0, feature_dim: int = 16) -> Particles:
    """Return particles (batch axis of 1) spread evenly over a floor of 2 x 2 m and the surfaces of four boxes."""
    generator = torch.Generator().manual_seed(seed)
    on_boxes = int(BOX_SHARE * count)
    floor = torch.rand(count - on_boxes, 3, generator=generator) * 2 - 1
    floor[:, 2] = 0.0
    parts = [floor]
    for number, (middle, half) in enumerate(BOXES):
        share = on_boxes // len(BOXES) + (number < on_boxes % len(BOXES))
        points = torch.rand(share, 3, generator=generator) * 2 - 1
        face = torch.randint(0, 3, (share,), generator=generator)
        points[torch.arange(share), face] = points[torch.arange(share), face].sign()
        parts.append(points * torch.tensor(half) + torch.tensor(middle))
    positions = torch.cat(parts)[torch.randperm(count, generator=generator)]
    features = torch.rand(count, feature_dim, generator=generator)
    return Particles(positions[None], features[None])


def two_frames(count: int, seed: int = 0) -> tuple[Particles, Particles]:
    """Return previous and current particles of one scene, drawn independently, without correspondences."""
    return surface_particles(count, 2 * seed + 1), surface_particles(count, 2 * seed)


def block_above(count: int, seed: int = 0, feature_dim: int = 16) -> Particles:
    """Return particles (batch axis of 1) of a moving block of 20 cm, half a metre above the floor, with its normals."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 3, generator=generator) * 2 - 1
    face = torch.randint(0, 3, (count,), generator=generator)
    rows = torch.arange(count)
    normals = torch.zeros(count, 3)
    normals[rows, face] = points[rows, face].sign()
    points[rows, face] = normals[rows, face]
    positions = 0.1 * points + torch.tensor([0.0, 0.0, 0.5])
    features = torch.rand(count, feature_dim, generator=generator)
    is_moving = torch.ones(1, count, dtype=torch.bool)
    return Particles(positions[None], features[None], moving=is_moving, normals=normals[None])


def floor_as_seen(count: int, occluders: Tensor, seed: int = 0) -> Scenery:
    """Return a floor of 2 x 2 m as so many pixels saw it from above, in the shadow of ``occluders`` (``1 point 3``)."""
    generator = torch.Generator().manual_seed(seed)
    positions = torch.rand(1, count, 3, generator=generator) * 2 - 1
    positions[..., 2] = 0.0
    up = torch.tensor([0.0, 0.0, 1.0]).expand_as(positions)
    return Scenery(
        positions=positions,
        colors=torch.rand(1, count, 3, generator=generator),
        normals=up,
        views=-up,
        sizes=torch.full((1, count), 2 / math.sqrt(count)),
        mask=torch.ones(1, count, dtype=torch.bool),
        occluders=occluders,
        occluder_mask=torch.ones(occluders.shape[:2], dtype=torch.bool),
    )


def camera(size: int, distance: float = 2.2) -> Cameras:
    """A camera 45 degrees above the ground that looks at the origin; its picture lies within +-1 m on the floor."""
    down, side = math.sqrt(0.5), torch.tensor([0.0, 1.0, 0.0])
    forward = torch.tensor([-down, 0.0, -down])
    pose = torch.eye(4)
    pose[:3, :3] = torch.stack([side, torch.linalg.cross(forward, side), forward], dim=1)
    pose[:3, 3] = -distance * forward
    focal = 2.2 * size
    return Cameras(torch.tensor([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]]), pose, size, size)


def picture_rays(size: int, count: int | None = None, seed: int = 0) -> Rays:
    """Return all rays of a picture (batch axis of 1), or some of them drawn at random."""
    rays = pixel_rays(camera(size))
    origins, directions = rays.origins.reshape(-1, 3), rays.directions.reshape(-1, 3)
    if count is not None:
        chosen = torch.randint(0, len(origins), (count,), generator=torch.Generator().manual_seed(seed))
        origins, directions = origins[chosen], directions[chosen]
    return Rays(origins[None], directions[None])


def video_batch(size: int, num_steps: int, rays_per_step: int, seed: int = 0) -> VideoBatch:
    """One clip of a rising ball: two context frames from one view, random pixels of the steps that follow."""
    cameras, generator = camera(size), torch.Generator().manual_seed(seed)
    pictures = [_picture(cameras, torch.tensor([0.0, 0.0, 0.2 + 0.03 * t])) for t in range(2 + num_steps)]
    views = Cameras(cameras.intrinsics.expand(1, 2, 1, 3, 3), cameras.cam_to_world.expand(1, 2, 1, 4, 4), size, size)
    context = RGBDFrames(
        torch.stack([rgb for rgb, _ in pictures[:2]])[None, :, None],
        torch.stack([depth for _, depth in pictures[:2]])[None, :, None],
        views,
    )
    rays = pixel_rays(cameras)
    chosen = torch.randint(0, size * size, (num_steps, rays_per_step), generator=generator)
    targets = torch.stack([rgb.reshape(-1, 3)[index] for (rgb, _), index in zip(pictures[2:], chosen, strict=True)])
    return VideoBatch(
        context,
        Rays(rays.origins.reshape(-1, 3)[chosen][None], rays.directions.reshape(-1, 3)[chosen][None]),
        targets[None],
        RandomKeys(seed=seed, step=0, sample_index=[0]),
        ["synthetic@0"],
    )


def _picture(cameras: Cameras, center: Tensor) -> tuple[Tensor, Tensor]:
    """Ray cast a chequered floor and a ball: RGB in [0, 1] and z-depth."""
    rays = pixel_rays(cameras)
    floor = -rays.origins[..., 2] / rays.directions[..., 2]
    offset = rays.origins - center
    half = (offset * rays.directions).sum(-1)
    root = half.square() - offset.square().sum(-1) + 0.2**2
    ball = torch.where(root > 0, -half - root.clamp(min=0).sqrt(), math.inf)
    distance = torch.minimum(floor, ball)
    points = rays.origins + distance[..., None] * rays.directions
    chequered = ((points[..., :2] * 5).floor().sum(-1) % 2)[..., None].expand(*floor.shape, 3) * 0.5 + 0.25
    rgb = torch.where((ball < floor)[..., None], (points - center) * 2.5 + 0.5, chequered)
    return rgb, distance * (rays.directions * cameras.cam_to_world[:3, 2]).sum(-1)
