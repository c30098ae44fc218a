"""Small scenes whose bodies are known: boxes of particles above a floor, some of which moved since the last frame."""

import torch

from vpd_lightning.simulator import Scene
from vpd_lightning.types import Particles

FLOOR, RED, BLUE = 0, 1, 2
TONES = torch.tensor([[0.5, 0.5, 0.5], [0.9, 0.1, 0.1], [0.1, 0.2, 0.9]])
VELOCITY = torch.tensor([0.0, 0.1, -0.05])
"""Of the red box (metres a step); all else stands still."""


def _frame(time: int, generator: torch.Generator, full: bool, num_padding: int) -> tuple[Particles, torch.Tensor]:
    floor = torch.rand(400, 3, generator=generator) * torch.tensor([4.0, 4.0, 0.0]) - torch.tensor([2.0, 2.0, 0.0])
    red = torch.rand(150, 3, generator=generator) * 0.4 + torch.tensor([-1.0, 0.0, 0.5]) + time * VELOCITY
    blue = torch.rand(100, 3, generator=generator) * 0.4 + torch.tensor([0.8, 0.0, 0.5])
    body = torch.cat([torch.full((len(part),), number) for number, part in enumerate((floor, red, blue))])
    padding = torch.full((num_padding,), -1)
    order = torch.randperm(len(body), generator=generator)
    body = torch.cat([body[order], padding])
    positions = torch.cat([torch.cat([floor, red, blue])[order], torch.zeros(num_padding, 3)])
    colors = TONES[body.clamp(min=0)] + 0.02 * torch.randn(len(body), 3, generator=generator)
    normals = torch.nn.functional.normalize(torch.randn(len(body), 3, generator=generator), dim=-1)
    features = torch.randn(len(body), 5, generator=generator)
    return Particles(
        positions[None],
        features[None],
        (body >= 0)[None],
        colors.clamp(0, 1)[None] if full else None,
        (body > 0)[None] if full else None,
        normals[None] if full else None,
    ), body


def two_boxes(seed: int = 0, full: bool = True) -> tuple[Scene, torch.Tensor, torch.Tensor]:
    """Return a scene and the body of each particle of both frames (-1 padding); ``full`` with all observations."""
    generator = torch.Generator().manual_seed(seed)
    previous, before = _frame(-1, generator, full, 7)
    current, now = _frame(0, generator, full, 3)
    return Scene(previous, current), before, now


def same(one: Scene, other: Scene) -> bool:
    """Whether two scenes are equal bit for bit."""
    for frame in ("previous", "current"):
        for name in ("positions", "features", "mask", "colors", "moving", "normals"):
            a, b = getattr(getattr(one, frame), name), getattr(getattr(other, frame), name)
            if (a is None) != (b is None) or (a is not None and not torch.equal(a, b)):
                return False
    return True
