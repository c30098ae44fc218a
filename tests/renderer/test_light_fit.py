"""The light is found again from frames that a known one lit: shadows of balls on a floor, by geometry alone."""

import math

import numpy as np
import pytest
import torch

from tests.renderer.test_splat_scenery import ball, floor, renderer, straight_down
from vpd_lightning.renderer.light_fit import LightPair, fit_light, light_pair
from vpd_lightning.renderer.shadows import Shadows
from vpd_lightning.types import Occluders, Particles

SUN = np.array([0.4, -0.3, 1.0]) / math.sqrt(1.25)
SHARE = 0.5
RADIUS = 0.12
NUM_PAIRS, NUM_UPDATES = 16, 80


def shell(center: np.ndarray, draw: np.random.Generator) -> np.ndarray:
    """Points all over a ball."""
    outwards = draw.normal(size=(300, 3))
    return center + RADIUS * outwards / np.linalg.norm(outwards, axis=-1, keepdims=True)


def lit(points: np.ndarray, center: np.ndarray, share: float) -> np.ndarray:
    """How bright the floor is: darker where the line towards the sun meets the ball."""
    offsets = center - points
    square = (offsets**2).sum(axis=-1) - (offsets @ SUN) ** 2
    return 0.8 * (1 - share * (square < RADIUS**2))


def pairs(share: float) -> list[LightPair]:
    draw = np.random.default_rng(0)
    found = []
    for _ in range(NUM_PAIRS):
        points = np.append(draw.uniform(-0.6, 0.6, size=(400, 2)), np.zeros((400, 1)), axis=-1)
        centers = [np.append(draw.uniform(-0.3, 0.3, size=2), draw.uniform(0.3, 0.6)) for _ in range(2)]
        colors = [np.repeat(lit(points, center, share)[:, None], 3, axis=1) for center in centers]
        occluders = [Occluders(torch.from_numpy(shell(center, draw))[None], torch.ones(1, 300, dtype=torch.bool))
                     for center in centers]  # fmt: skip
        weights = torch.full((400,), 1 / 400, dtype=torch.float64)
        found.append(LightPair(torch.from_numpy(points), *map(torch.from_numpy, colors), weights, *occluders))
    return found


def fitted(share: float, num_lights: int = 3, num_updates: int = NUM_UPDATES) -> tuple[Shadows, float]:
    shadows = Shadows(num_lights=num_lights, softness=0.05).double()
    left = fit_light(shadows, pairs(share), num_updates, torch.Generator().manual_seed(0))
    return shadows, left


def test_the_sun_is_found_with_its_share_and_the_others_go_out() -> None:
    shadows, left = fitted(SHARE)
    shares = shadows.shares.mean(dim=1)
    main = int(shares.argmax())
    direction = torch.nn.functional.normalize(shadows.directions[main], dim=0).detach().numpy()
    assert math.degrees(math.acos(min(1.0, float(direction @ SUN)))) < 3
    assert shares[main].item() == pytest.approx(SHARE, rel=0.2)
    assert shares.clamp(min=0).sum().item() == pytest.approx(SHARE, rel=0.25), "nothing is counted twice"
    assert left < 0.2, "edges are blurred, the rest is explained"
    others = shadows.shares[torch.arange(3) != main]
    assert (others < 0.1).all() and ((others > 0) | (others == -1)).all()


def test_where_nothing_darkens_no_light_is_left() -> None:
    shadows, left = fitted(0.0)
    assert (shadows.shares < 0.02).all() and left <= 1


def test_a_fit_that_explains_nothing_changes_nothing() -> None:
    shadows, left = fitted(SHARE, num_updates=1)
    start = Shadows(num_lights=3, softness=0.05).double()
    assert left >= 0.9
    assert all(torch.equal(one, other) for one, other in zip(shadows.parameters(), start.parameters(), strict=True))


def test_a_fit_that_explains_a_part_leaves_every_light_to_training() -> None:
    for num_updates in (10, 11, 19, 25):
        shadows, left = fitted(SHARE, num_updates=num_updates)
        if 0.5 < left < 0.9:
            assert (shadows.shares > 0).all()
            return
    pytest.fail("no number of updates explains a part")


def test_the_same_draws_give_the_same_light() -> None:
    (first, left), (second, _) = fitted(SHARE, 1, 25), fitted(SHARE, 1, 25)
    assert left < 0.9, "the fit explains something, so the light is not the one it began with"
    assert all(torch.equal(one, other) for one, other in zip(first.parameters(), second.parameters(), strict=True))


GRID = [[0.1 * x, 0.1 * y] for x in range(-5, 6) for y in range(-5, 6)]


def seen(**changes: object) -> Particles:
    """Particles of a frame whose scenery has one point for each ray of ``GRID``."""
    scenery = floor(spacing=0.1, half_width=0.5, occluders=ball([0.0, 0.0, 0.4]).positions)
    values = {name: getattr(scenery, name) for name in scenery.__dataclass_fields__} | changes
    return Particles(torch.zeros(1, 1, 3).double(), torch.zeros(1, 1, 5).double(), scenery=type(scenery)(**values))


def compared(before: Particles, after: Particles) -> LightPair | None:
    rays = straight_down(GRID)
    flat = type(rays)(rays.origins[0], rays.directions[0])
    assert after.scenery is not None
    colors = after.scenery.colors[0]
    return light_pair(renderer().double(), before, after, flat, colors, torch.Generator().manual_seed(0))


def test_frames_without_scenery_are_not_compared() -> None:
    bare = Particles(torch.zeros(1, 1, 3).double(), torch.zeros(1, 1, 5).double())
    rays = straight_down(GRID)
    flat = type(rays)(rays.origins[0], rays.directions[0])
    assert light_pair(renderer().double(), bare, bare, flat, rays.origins[0], torch.Generator()) is None


def test_what_changed_is_compared_with_its_weight() -> None:
    colors = seen().scenery.colors.clone()  # type: ignore[union-attr]
    colors[0, :30] *= 0.5
    found = compared(seen(), seen(colors=colors))
    assert found is not None
    changed = (found.colors_before - found.colors_after).abs().amax(dim=-1) > 0.05
    assert int(changed.sum()) == 30 and len(changed) == len(GRID)
    assert found.weights.sum().item() == pytest.approx(1)
    torch.testing.assert_close(found.colors_after[changed], 0.5 * found.colors_before[changed], rtol=1e-3, atol=1e-4)


def test_a_surface_that_was_not_there_says_nothing_of_light() -> None:
    colors = seen().scenery.colors.clone()  # type: ignore[union-attr]
    colors[0, :40] *= 0.5
    raised = floor(height=0.5, spacing=0.1, half_width=0.5).positions.clone()
    raised[0, 40:, 2] = 0  # the first forty are half a metre higher than before
    found = compared(seen(), seen(colors=colors, positions=raised))
    assert found is None, "where the surface is the same, nothing changed"


def test_without_shadows_or_bodies_there_is_nothing_to_compare() -> None:
    assert compared(seen(), seen()) is None
    darker = 0.5 * seen().scenery.colors  # type: ignore[union-attr]
    nobody = torch.zeros(1, 40, dtype=torch.bool)
    assert compared(seen(), seen(colors=darker)) is not None
    assert compared(seen(), seen(colors=darker, occluder_mask=nobody)) is None
    assert compared(seen(occluder_mask=nobody), seen(colors=darker)) is None
