"""Boxes, balls and planes seen by ray casting: images with exact depth, and which pixel shows what."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from vpd_lightning.geometry.cameras import pixel_rays
from vpd_lightning.types import Cameras, RGBDFrames

DTYPE = torch.float64


@dataclass(frozen=True)
class Plane:
    """The half space normal . x < height is solid; its surface ends at ``reach`` (metres) from the origin."""

    normal: Sequence[float]
    height: float
    reach: float = 1.5

    def hits(self, origins: Tensor, directions: Tensor) -> Tensor:
        normal = torch.tensor(self.normal, dtype=DTYPE)
        distance = (self.height - origins @ normal) / (directions @ normal)
        point = origins + distance[..., None] * directions
        return torch.where((distance > 0) & (point.abs().amax(dim=-1) < self.reach), distance, torch.inf)


@dataclass(frozen=True)
class Ball:
    center: Sequence[float]
    radius: float

    def hits(self, origins: Tensor, directions: Tensor) -> Tensor:
        offset = origins - torch.tensor(self.center, dtype=DTYPE)
        half = (offset * directions).sum(dim=-1)
        root = half.square() - offset.square().sum(dim=-1) + self.radius**2
        return torch.where(root >= 0, -half - root.clamp(min=0).sqrt(), torch.inf)


@dataclass(frozen=True)
class Box:
    center: Sequence[float]
    half: float
    yaw: float = 0.0

    def hits(self, origins: Tensor, directions: Tensor) -> Tensor:
        angle = torch.tensor(self.yaw, dtype=DTYPE)
        turn = torch.eye(3, dtype=DTYPE)
        turn[0, 0] = turn[1, 1] = angle.cos()
        turn[0, 1], turn[1, 0] = angle.sin(), -angle.sin()
        start, along = (origins - torch.tensor(self.center, dtype=DTYPE)) @ turn.T, directions @ turn.T
        near, far = (-self.half - start) / along, (self.half - start) / along
        enter, leave = torch.minimum(near, far).amax(dim=-1), torch.maximum(near, far).amin(dim=-1)
        return torch.where((enter < leave) & (enter > 0), enter, torch.inf)


FLOOR = Plane((0.0, 0.0, 1.0), 0.0)
WALL = Plane((0.0, -1.0, 0.0), -0.6)  # stands at y = 0.6 and faces -y


def looking_at(eyes: Sequence[Sequence[float]], target: Sequence[float] = (0.0, 0.0, 0.1), size: int = 64) -> Cameras:
    """Return cameras (axis ``view``) at the eyes, upright, that look at the target."""
    eye = torch.tensor(eyes, dtype=DTYPE)
    forward = torch.nn.functional.normalize(eye.new_tensor(target) - eye, dim=-1)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, eye.new_tensor([[0.0, 0.0, 1.0]])), dim=-1)
    cam_to_world = torch.eye(4, dtype=DTYPE).repeat(len(eye), 1, 1)
    cam_to_world[:, :3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=-1)
    cam_to_world[:, :3, 3] = eye
    focal, middle = 1.2 * size, size / 2
    intrinsics = eye.new_tensor([[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]])
    return Cameras(intrinsics.repeat(len(eye), 1, 1), cam_to_world, size, size)


TWO_EYES = ((0.9, -1.1, 1.0), (-1.0, -0.8, 1.1))


def cast(
    solids: Sequence[Plane | Ball | Box], eyes: Sequence[Sequence[float]] = TWO_EYES, size: int = 64
) -> tuple[RGBDFrames, Tensor]:
    """Return the images of one batch member, and for each pixel the number of the solid it shows (-1: none)."""
    cameras = looking_at(eyes, size=size)
    rays = pixel_rays(cameras)
    distances = torch.stack([solid.hits(rays.origins, rays.directions) for solid in solids])
    distance, shown = distances.min(dim=0)
    depth = distance * (rays.directions * cameras.cam_to_world[:, None, None, :3, 2]).sum(dim=-1)
    seen = torch.isfinite(distance)
    batched = Cameras(cameras.intrinsics[None], cameras.cam_to_world[None], size, size)
    rgb = torch.full((1, *depth.shape, 3), 128, dtype=torch.uint8)
    return RGBDFrames(rgb, torch.where(seen, depth, 0.0)[None], batched), torch.where(seen, shown, -1)[None]
