"""Which body a ray hits first, against every particle looked at one by one."""

import math

import pytest
import torch

from vpd_lightning.types import Particles
from vpd_lightning.viewer.picking import body_at, spacing


def grid(low: tuple[float, float, float], size: tuple[int, int, int], step: float = 0.1) -> torch.Tensor:
    axes = [start + step * torch.arange(count) for start, count in zip(low, size, strict=True)]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3).float()


@pytest.fixture
def scene() -> tuple[Particles, torch.Tensor]:
    floor = grid((-1.0, -1.0, 0.0), (21, 21, 1))
    near, far = grid((-0.1, -0.5, 0.1), (3, 3, 3)), grid((-0.1, 0.5, 0.1), (3, 3, 3))
    points = torch.cat([floor, near, far, torch.zeros(5, 3)])
    labels = torch.tensor([-1] * len(floor) + [0] * len(near) + [1] * len(far) + [0] * 5)
    mask = torch.ones(len(points), dtype=torch.bool)
    mask[-5:] = False  # padding lies in the origin
    return Particles(points[None], torch.zeros(1, len(points), 4), mask=mask[None]), labels


def test_the_nearest_body_is_hit_and_scenery_is_none(scene: tuple[Particles, torch.Tensor]) -> None:
    particles, labels = scene
    assert spacing(particles) == pytest.approx(0.1, abs=1e-6)
    eye, level = torch.tensor([0.0, -3.0, 0.2]), torch.tensor([0.0, 1.0, 0.0])
    assert body_at(particles, labels, eye, level) == 0
    assert body_at(particles, labels, torch.tensor([0.0, 3.0, 0.2]), -level) == 1
    assert body_at(particles, labels, eye, -level) is None  # behind the eye
    down = torch.tensor([0.0, 0.0, -1.0])
    assert body_at(particles, labels, torch.tensor([0.0, 0.0, 2.0]), down) is None  # the floor, and padding
    assert body_at(particles, labels, torch.tensor([0.0, 0.6, 2.0]), down) == 1
    assert body_at(particles, labels, torch.tensor([5.0, 0.6, 2.0]), down) is None


def test_a_wall_hides_what_is_behind_it(scene: tuple[Particles, torch.Tensor]) -> None:
    particles, labels = scene
    wall = grid((-1.0, -2.0, 0.0), (21, 1, 10))
    points = torch.cat([wall, particles.positions[0]])
    mask = torch.cat([torch.ones(len(wall), dtype=torch.bool), particles.mask[0]])
    walled = Particles(points[None], torch.zeros(1, len(points), 4), mask=mask[None])
    numbers = torch.cat([torch.full((len(wall),), -1), labels])
    eye, level = torch.tensor([0.0, -3.0, 0.2]), torch.tensor([0.0, 1.0, 0.0])
    assert body_at(walled, numbers, eye, level) is None


def test_random_rays_hit_what_a_plain_search_hits() -> None:
    generator = torch.Generator().manual_seed(3)
    points = torch.rand(200, 3, generator=generator)
    labels = torch.randint(0, 4, (200,), generator=generator)
    particles = Particles(points[None], torch.zeros(1, 200, 1))
    eye = torch.tensor([0.5, 0.5, -2.0])
    for number in range(50):
        direction = torch.rand(3, generator=generator, dtype=torch.float64) - 0.5 + torch.tensor([0.0, 0.0, 2.5])
        hits = []
        for point, label in zip(points.double().tolist(), labels.tolist(), strict=True):
            offset = [a - b for a, b in zip(point, eye.tolist(), strict=True)]
            length = math.sqrt(sum(value * value for value in direction.tolist()))
            along = sum(a * b for a, b in zip(offset, direction.tolist(), strict=True)) / length
            aside = math.sqrt(max(sum(value * value for value in offset) - along * along, 0.0))
            if along > 0 and aside <= 0.05:
                hits.append((along, label))
        expected = min(hits)[1] if hits else None
        assert body_at(particles, labels, eye, direction, reach=0.05) == expected, number


def test_nothing_is_hit_where_nothing_is() -> None:
    empty = Particles(torch.zeros(1, 0, 3), torch.zeros(1, 0, 4))
    assert body_at(empty, torch.zeros(0, dtype=torch.long), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0])) is None
    assert spacing(empty) == 0.01
