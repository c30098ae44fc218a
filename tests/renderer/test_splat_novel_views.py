"""The splat renderer learns three pictures of a ball and is asked for a fourth, from where nobody looked."""

import math

import pytest
import torch

from tests.renderer.test_splat import renderer
from vpd_lightning.metrics.psnr import psnr
from vpd_lightning.types import Particles, Rays

RADIUS, SIDE, BEHIND = 0.5, 24, 0.2


def ball(count: int = 400) -> Particles:
    """Return particles spread evenly over a ball (Fibonacci's spiral), whose features are the colours of the ball."""
    number = torch.arange(count, dtype=torch.float64)
    z = 1 - 2 * (number + 0.5) / count
    angle = math.pi * (3 - math.sqrt(5)) * number
    normals = torch.stack([(1 - z**2).sqrt() * angle.cos(), (1 - z**2).sqrt() * angle.sin(), z], dim=-1)
    return Particles(RADIUS * normals[None], color_of(normals)[None])


def color_of(normals: torch.Tensor) -> torch.Tensor:
    return torch.cat([0.5 + 0.5 * normals, (6 * normals).sin()[..., :2]], dim=-1)


def view(azimuth: float) -> tuple[Rays, torch.Tensor]:
    """Return the rays of a camera 2 m from the ball, and the exact picture: of every ray the first hit, or grey."""
    forward = -torch.tensor([math.cos(azimuth), math.sin(azimuth), 0.5], dtype=torch.float64)
    forward = forward / forward.norm()
    right = torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    right = right / right.norm()
    down = torch.linalg.cross(forward, right)
    across = (torch.arange(SIDE, dtype=torch.float64) + 0.5) / SIDE - 0.5
    y, x = torch.meshgrid(across, across, indexing="ij")
    directions = (forward + 0.7 * (x[..., None] * right + y[..., None] * down)).reshape(-1, 3)
    directions = directions / directions.norm(dim=-1, keepdim=True)
    origins = (-2 * forward).expand_as(directions)
    middle = -(origins * directions).sum(-1)
    inside = middle**2 - (origins.square().sum(-1) - RADIUS**2)
    hits = origins + (middle - inside.clamp(min=0).sqrt())[:, None] * directions
    colors = torch.where(inside[:, None] > 0, color_of(hits / RADIUS)[:, :3], BEHIND)
    return Rays(origins[None], directions[None]), colors[None]


@pytest.mark.parametrize("held_out", [math.pi / 3, math.pi])
def test_a_view_that_nobody_was_taught_shows_the_ball_as_it_is(held_out):
    """Cameras at 0, 120 and 240 degrees teach; 60 and 180 degrees are half way between two of them."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model, scene = renderer(hidden_dim=32, ray_chunk_size=1024), ball()
        views = [view(2 * math.pi * number / 3) for number in range(3)]
        rays = Rays(*(torch.cat([getattr(v[0], n) for v in views], 1) for n in ("origins", "directions")))
        truth = torch.cat([colors for _, colors in views], dim=1)
        optimizer = torch.optim.Adam(model.parameters(), lr=5e-3)
        for _ in range(200):
            some = torch.randint(0, truth.shape[1], (256,))
            out = model(scene, Rays(rays.origins[:, some], rays.directions[:, some]), None)
            loss = (out.rgbs - truth[:, some]).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()

    def score(lines: Rays, colors: torch.Tensor) -> float:
        with torch.no_grad():
            picture = model(scene, lines, None).rgbs.reshape(1, SIDE, -1, 3).clamp(0, 1)
        return float(psnr(picture, colors.reshape(picture.shape)))

    lines, colors = view(held_out)
    mean_color = torch.full_like(colors, 1.0) * truth.mean(dim=1)
    flat = float(psnr(mean_color.reshape(1, SIDE, SIDE, 3), colors.reshape(1, SIDE, SIDE, 3)))
    taught, novel = score(rays, truth), score(lines, colors)

    # Measured over three seeds: 26.5 to 27.5 dB taught, 23.5 to 24.9 dB novel, 11 and 13 dB of the mean colour alone.
    assert novel > flat + 8
    assert novel > taught - 6
