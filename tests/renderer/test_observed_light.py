"""Light on observed scenery (``renderer/observed_light.py``) on a floor whose true light and true colours are known."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

import tests.renderer.test_splat_scenery as scenes
from vpd_lightning.renderer.observed_light import light_then, observed_light
from vpd_lightning.renderer.scenery_layer import SeenScenery
from vpd_lightning.types import Occluders, Scenery

PIXEL = 0.01  # metres
UMBRA = 0.4
NOTHING = Occluders(torch.zeros(1, 1, 3), torch.ones(1, 1, dtype=torch.bool))


def true_light(points: Tensor) -> Tensor:
    """A sharp shadow, 8 pixels wide."""
    dark = points[..., :1].abs() < 4 * PIXEL
    return torch.where(dark, UMBRA, 1.0).expand_as(points)


def soft_light(points: Tensor, *_: Tensor) -> Tensor:
    """The same shadow as it is predicted: soft, and a pixel and a half to the side."""
    x = points[..., :1] - 1.5 * PIXEL
    inside = torch.sigmoid((4 * PIXEL - x.abs()) / PIXEL)
    return (1 - (1 - UMBRA) * inside).expand_as(points)


def floor(albedo: Tensor | float, light: Tensor | None = None) -> Scenery:
    along = PIXEL * torch.arange(-20.0, 21.0)
    x, y = torch.meshgrid(along, along[10:31], indexing="ij")
    points = torch.stack([x, y, torch.zeros_like(x)], dim=-1).flatten(0, 1)[None]
    up = torch.tensor([0.0, 0.0, 1.0]).expand_as(points)
    light = true_light(points) if light is None else light
    return Scenery(
        positions=points,
        colors=albedo * light,
        normals=up,
        views=-up,
        sizes=torch.full(points.shape[:2], PIXEL),
        mask=torch.ones(points.shape[:2], dtype=torch.bool),
        occluders=NOTHING.positions,
        occluder_mask=NOTHING.mask,
    )


def seen_at(scenery: Scenery) -> SeenScenery:
    """Rays that meet every point."""
    ones = torch.ones(scenery.positions.shape[:2])
    return SeenScenery(scenery.colors, ones, ones, torch.zeros_like(scenery.colors))


def corrected(scenery: Scenery, shadows=soft_light) -> Tensor:
    predicted = shadows(scenery.positions)
    return observed_light(shadows, scenery, NOTHING, seen_at(scenery), scenery.positions, predicted)


def tiles(scenery: Scenery) -> Tensor:
    """Albedo of a checkerboard, 4 pixels a tile."""
    cells = (scenery.positions[..., :2] / (4 * PIXEL)).floor().sum(dim=-1, keepdim=True)
    return torch.where(cells % 2 == 0, 0.8, 0.3).expand_as(scenery.positions)


def test_a_shadow_seen_beside_the_predicted_one_leaves_no_rim() -> None:
    scenery = floor(0.6)
    before = (scenery.colors / soft_light(scenery.positions) - 0.6).abs()
    after = (scenery.colors / corrected(scenery) - 0.6).abs()

    assert before.max() > 0.3  # a light rim, half as bright again
    assert after.max() < 0.07
    assert after.mean() < 0.2 * before.mean()


def test_a_checkerboard_keeps_its_tiles() -> None:
    albedo = tiles(floor(1.0))
    scenery = floor(albedo)
    before = (scenery.colors / soft_light(scenery.positions) - albedo).abs()
    after = (scenery.colors / corrected(scenery) - albedo).abs()

    assert after.mean() < 0.5 * before.mean()
    assert (after > 0.1).float().mean() < 0.02


def test_on_noise_a_right_prediction_changes_little() -> None:
    points = floor(1.0).positions
    albedo = 0.2 + 0.6 * torch.rand(points.shape, generator=torch.Generator().manual_seed(0))
    scenery = floor(albedo, soft_light(points))

    after = scenery.colors / corrected(scenery)
    assert (after - albedo).abs().mean() < 0.025  # of colours that differ from pixel to pixel, with nothing to go by


def test_light_stays_between_what_is_predicted_around() -> None:
    scenery = floor(torch.rand(1, 861, 3, generator=torch.Generator().manual_seed(0)))
    light = corrected(scenery)
    assert light.min() >= soft_light(scenery.positions).min()
    assert light.max() <= 1


def test_without_a_lit_point_near_the_prediction_stays() -> None:
    def dim(points: Tensor, *_: Tensor) -> Tensor:
        return 0.9 * soft_light(points)

    scenery = floor(0.6)
    assert torch.equal(corrected(scenery, dim), dim(scenery.positions))


def test_another_surface_says_nothing() -> None:
    scenery = floor(0.6)
    # What is lit belongs to a wall.
    wall = torch.tensor([1.0, 0.0, 0.0]).expand_as(scenery.normals)
    lit = soft_light(scenery.positions).amin(dim=-1, keepdim=True) > 0.95
    scenery = Scenery(**{**vars(scenery), "normals": torch.where(lit, wall, scenery.normals)})
    changed = corrected(scenery) != soft_light(scenery.positions)
    assert not changed[~lit.expand_as(changed)].any()


def test_members_of_a_batch_do_not_matter_to_each_other() -> None:
    one, other = floor(0.6), floor(0.3)
    both = Scenery(**{name: torch.cat([value, vars(other)[name]]) for name, value in vars(one).items()})
    casting = Occluders(both.occluders, both.occluder_mask)
    together = observed_light(soft_light, both, casting, seen_at(both), both.positions, soft_light(both.positions))
    assert torch.equal(together, torch.cat([corrected(one), corrected(other)]))


@pytest.mark.parametrize("case", ["no scenery", "not seen", "not finite"])
def test_what_cannot_be_corrected_stays(case: str) -> None:
    scenery = floor(0.6)
    points, seen = scenery.positions.clone(), seen_at(scenery)
    if case == "no scenery":
        scenery = Scenery(**{**vars(scenery), "mask": torch.zeros_like(scenery.mask)})
    elif case == "not seen":
        seen = seen._replace(opacities=torch.zeros_like(seen.opacities))
    else:
        points[:] = torch.nan
    predicted = soft_light(scenery.positions)
    assert torch.equal(observed_light(soft_light, scenery, NOTHING, seen, points, predicted), predicted)


def test_a_trained_renderer_corrects_and_one_in_training_sees_where_it_is_wrong() -> None:
    body = scenes.ball(scenes.BALL)
    model = scenes.with_side_light(scenes.renderer()).double()
    scenery = scenes.floor(occluders=body.positions)  # a body, and no shadow in the picture
    rays = scenes.straight_down(scenes.BESIDE)
    without = replace(body, mask=torch.zeros_like(body.mask), scenery=scenery)

    in_training = model.train()(without, rays, None).rgbs[0, 0]
    afterwards = model.eval()(without, rays, None).rgbs[0, 0]
    gray = scenes.tensor(scenes.GRAY)
    assert (in_training - gray).min() > 0.03
    assert (afterwards - gray).abs().max() < 0.005


def test_a_shadow_that_stays_is_drawn_as_it_was_seen() -> None:
    scenery = floor(0.6)
    predicted = soft_light(scenery.positions)
    light = light_then(predicted, corrected(scenery), predicted)
    assert torch.equal(scenery.colors * predicted / light, scenery.colors)
    # Half of the light that was missing has returned.
    half = light_then(predicted, corrected(scenery), (1 + predicted) / 2)
    shaded = predicted < 0.9
    torch.testing.assert_close(half[shaded], ((predicted + corrected(scenery)) / 2)[shaded])
