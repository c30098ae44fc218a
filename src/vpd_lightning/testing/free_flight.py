"""Balls in free flight over a floor: RGB-D video whose motion is known, drawn in memory. Metres, z up, float32.

What a dynamics must be able to learn before anything else: each ball has a velocity of its own, which only the
difference of the two context frames shows.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from vpd_lightning.geometry.cameras import pixel_rays
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.testing.scenes import ring_cameras
from vpd_lightning.types import Cameras, Rays, RGBDFrames, VideoBatch

RADIUS = 0.15
GRAVITY = 0.004  # metres per step squared
WORKSPACE_MIN, WORKSPACE_MAX = (-0.8, -0.8, -0.05), (0.8, 0.8, 1.0)
NEAR, FAR = 0.3, 5.0

_COLORS = ((0.85, 0.25, 0.2), (0.2, 0.3, 0.85))
_MIDDLES = ((0.28, 0.0, 0.45), (-0.28, 0.0, 0.45))
_REACH = 0.12  # metres from there along each axis, at most


@dataclass(frozen=True)
class Flights:
    """A training batch and what is true of it: where the balls are at all times, the two context frames first."""

    batch: VideoBatch
    centers: Float[Tensor, "batch time body 3"]

    @property
    def displacements(self) -> Float[Tensor, "batch step body 3"]:
        """How far each ball has moved since the last context frame."""
        return self.centers[:, 2:] - self.centers[:, 1:2]

    @property
    def velocities(self) -> Float[Tensor, "batch body 3"]:
        """Displacement over the step between the two context frames."""
        return self.centers[:, 1] - self.centers[:, 0]

    def body_of(self, positions: Float[Tensor, "batch particle 3"]) -> Int64[Tensor, "batch particle"]:
        """Return which ball each particle of the last context frame lies on, -1 for the floor."""
        nearest, body = (positions[:, :, None] - self.centers[:, 1, None]).norm(dim=-1).min(dim=-1)
        return torch.where(nearest < RADIUS + 0.01, body, -1)

    def true_displacements(
        self, positions: Float[Tensor, "batch particle 3"]
    ) -> Float[Tensor, "batch step particle 3"]:
        """Return how far particles of the last context frame truly move: with their ball, or not at all."""
        body = self.body_of(positions)
        moved = torch.cat([self.displacements, torch.zeros_like(self.displacements[:, :, :1])], dim=2)
        index = body.where(body >= 0, torch.tensor(moved.shape[2] - 1))
        return torch.gather(moved, 2, index[:, None, :, None].expand(-1, moved.shape[1], -1, 3))


@dataclass(frozen=True)
class FreeFlight:
    """One or two balls before cameras on a ring."""

    num_bodies: int = 2
    num_cameras: int = 3
    image_size: int = 32  # pixels, height and width
    speed: float = 0.05  # metres per step along each axis, at most

    def flights(
        self, seed: int, step: int, batch_size: int, num_steps: int, rays_per_step: int, *, still: bool = False
    ) -> Flights:
        """Draw the batch of one training step: context frames of all cameras, and rays of the steps after them.

        ``still``: all steps show the last context frame, as an auto-encoder needs it.
        """
        keys = RandomKeys(seed=seed, step=step, sample_index=list(range(batch_size)))
        times = torch.arange(num_steps + 2)
        centers = torch.stack([self._centers(generator, times) for generator in keys.generators("flight")])
        if still:
            centers[:, 2:] = centers[:, 1:2]
        cameras = self._cameras()
        rays = pixel_rays(cameras)
        every = Rays(rays.origins.flatten(0, -2), rays.directions.flatten(0, -2))
        context = [_seen(Rays(rays.origins[None], rays.directions[None]), centers[:, time]) for time in range(2)]
        forward = cameras.cam_to_world[:, None, None, :3, 2]
        targets = []
        for time in range(2, num_steps + 2):
            draws = [
                torch.randint(len(every.origins), (rays_per_step,), generator=generator)
                for generator in keys.generators(f"rays/{time}")
            ]
            drawn = torch.stack(draws)
            some = Rays(every.origins[drawn], every.directions[drawn])
            targets.append((some.origins, some.directions, _seen(some, centers[:, time])[0]))
        origins, directions, rgbs = (torch.stack(parts, dim=1) for parts in zip(*targets, strict=True))
        batch = VideoBatch(
            context=RGBDFrames(
                rgb=torch.stack([(255 * color).round().to(torch.uint8) for color, _ in context], dim=1),
                depth=torch.stack(
                    [distance * (rays.directions * forward).sum(dim=-1) for _, distance in context], dim=1
                ),
                cameras=Cameras(
                    cameras.intrinsics.expand(batch_size, 2, -1, -1, -1),
                    cameras.cam_to_world.expand(batch_size, 2, -1, -1, -1),
                    self.image_size,
                    self.image_size,
                ),
            ),
            rays=Rays(origins, directions),
            rgbs=rgbs,
            keys=keys,
            clips=[f"flight{member}@{step}" for member in range(batch_size)],
        )
        return Flights(batch, centers)

    def _centers(self, generator: torch.Generator, times: Int64[Tensor, " time"]) -> Float[Tensor, "time body 3"]:
        """Draw where the balls are at the last context frame, and how they fly; they keep to their sides."""
        side = 1.0 if torch.rand((), generator=generator) < 0.5 else -1.0
        middle = side * torch.tensor(_MIDDLES[: self.num_bodies])
        middle[:, 2] = middle[:, 2].abs()
        start = middle + _REACH * (2 * torch.rand(self.num_bodies, 3, generator=generator) - 1)
        velocity = self.speed * (2 * torch.rand(self.num_bodies, 3, generator=generator) - 1)
        elapsed = (times - 1).float()[:, None, None]
        fall = torch.tensor([0.0, 0.0, -0.5 * GRAVITY]) * elapsed.square()
        return start + velocity * elapsed + fall

    def _cameras(self) -> Cameras:
        cameras = ring_cameras(self.num_cameras, self.image_size)
        pose = cameras.cam_to_world.float()
        pose[:, :3, 3] *= 1.6
        return Cameras(cameras.intrinsics.float(), pose, self.image_size, self.image_size)


def _seen(
    rays: Rays, centers: Float[Tensor, "batch body 3"]
) -> tuple[Float[Tensor, "batch *ray 3"], Float[Tensor, " batch *ray"]]:
    """Return colour and distance along the ray of what each ray (``batch *ray``) meets first; 0 where nothing."""
    floor = -rays.origins[..., 2] / rays.directions[..., 2]
    floor = torch.where((floor > 0) & (floor < FAR), floor, FAR)
    nearest = floor.expand(len(centers), *floor.shape[1:])
    shape = (len(centers), *[1] * (rays.origins.dim() - 2), 3)
    middles = [centers[:, number].reshape(shape) for number in range(centers.shape[1])]
    body = torch.full(nearest.shape, -1)
    for number, middle in enumerate(middles):
        offset = rays.origins - middle
        half = (offset * rays.directions).sum(dim=-1)
        root = half.square() - offset.square().sum(dim=-1) + RADIUS**2
        hit = torch.where(root >= 0, -half - root.clamp(min=0).sqrt(), torch.inf)
        nearest, body = torch.where(hit < nearest, hit, nearest), torch.where(hit < nearest, number, body)
    points = rays.origins + nearest[..., None] * rays.directions
    color = points.new_tensor([0.6, 0.5, 0.4]) + 0.1 * torch.sin(5 * points[..., :1] + 3 * points[..., 1:2])
    for number, middle in enumerate(middles):
        shade = 0.75 + 0.25 * (points - middle)[..., 2:] / RADIUS
        color = torch.where((body == number)[..., None], shade * points.new_tensor(_COLORS[number]), color)
    return color.clamp(0, 1), torch.where(nearest < FAR, nearest, 0.0)
