"""A table top before a floor, in noisy depth: its rim is no body, and pixels in the air go where they belong."""

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from tests.geometry.cast_scenes import Box, Plane, cast
from vpd_lightning.encoder.particles.wide_surface_background import WideSurfaceBackground
from vpd_lightning.geometry.local_planes import between_surfaces, plane_depth
from vpd_lightning.types import RGBDFrames

NOISE, PIXEL = torch.tensor([0.004, 0.004]).double(), torch.tensor([1 / 77, 1 / 77]).double()
EYES = ((0.9, -1.1, 1.2), (-1.0, -1.0, 1.1))


@dataclass(frozen=True)
class Slab:
    """A box with sides of its own, upright."""

    center: tuple[float, float, float]
    halves: tuple[float, float, float]

    def hits(self, origins: Tensor, directions: Tensor) -> Tensor:
        start, halves = origins - origins.new_tensor(self.center), origins.new_tensor(self.halves)
        near, far = (-halves - start) / directions, (halves - start) / directions
        enter, leave = torch.minimum(near, far).amax(dim=-1), torch.maximum(near, far).amin(dim=-1)
        return torch.where((enter < leave) & (enter > 0), enter, torch.inf)


TABLE, GROUND = Slab((0, 0, -0.03), (0.5, 0.4, 0.03)), Plane((0.0, 0.0, 1.0), -0.6, reach=0.9)


def seen(*bodies, seed=0) -> tuple[RGBDFrames, Tensor]:
    """Return noisy frames of the table, the ground and bodies, and what each pixel shows, in that order."""
    frames, shown = cast([TABLE, GROUND, *bodies], EYES)
    draw = torch.Generator().manual_seed(seed)
    noise = 1 + NOISE[:, None, None] * torch.randn(frames.depth.shape, generator=draw, dtype=torch.float64)
    colors = torch.tensor([[0.7, 0.6, 0.5], [0.2, 0.2, 0.2], [0.8, 0.1, 0.1], [0.1, 0.2, 0.8]]).double()
    return RGBDFrames(colors[shown.clamp(min=0)].float(), (frames.depth * noise).float(), frames.cameras), shown


def background():
    return WideSurfaceBackground(
        max_slope=0.15, max_turn_degrees=20.0, min_width=0.4, tolerance=0.5, memory_frames=0, noise_floor=0.001
    )


@pytest.mark.parametrize("seed", range(4))
def test_the_rim_of_a_table_is_no_body_and_what_stands_on_it_is_one(seed):
    frames, shown = seen(Box((0.1, 0.0, 0.06), 0.06, 0.3), seed=seed)

    found = background()(frames)

    assert found[shown == 2].float().mean() > 0.9
    assert (found & (shown == 0)).sum() < 8, "a rim of more than 100 pixels"


def test_what_falls_past_the_edge_is_still_a_body():
    frames, shown = seen(Box((0.1, -0.5, -0.25), 0.06, 0.3))

    found = background()(frames)

    assert (shown == 2).sum() > 50
    assert found[shown == 2].float().mean() > 0.8


def test_pixels_in_the_air_are_told_from_noise_and_from_poles():
    frames, shown = seen(Slab((0.1, 0.0, 0.15), (0.012, 0.012, 0.15)))  # a pole of about a pixel
    depth = frames.depth[0].double()
    assert between_surfaces(depth, NOISE, PIXEL).float().mean() < 0.002
    outline = (torch.nn.functional.max_pool2d((shown == 0).float(), 3, stride=1, padding=1) > 0) & (shown == 1)
    picked = outline[0] & (torch.rand(depth.shape, generator=torch.Generator().manual_seed(1)) < 0.2)
    halfway = torch.where(picked, 0.8 * depth, depth)

    found = between_surfaces(halfway, NOISE, PIXEL)

    assert found[picked].float().mean() > 0.7
    assert found[~picked].float().mean() < 0.01


def test_a_pixel_in_the_air_gets_the_depth_of_the_surface_that_has_its_colour():
    frames, shown = seen()
    depth, model = frames.depth, background()
    outline = (torch.nn.functional.max_pool2d((shown == 0).float(), 3, stride=1, padding=1) > 0) & (shown == 1)
    picked = outline & (torch.rand(depth.shape, generator=torch.Generator().manual_seed(1)) < 0.2)
    flying = RGBDFrames(frames.rgb, torch.where(picked, 0.8 * depth, depth), frames.cameras)

    judged, placed = model.restored(flying)

    there = picked & (judged != flying.depth)
    assert there.sum() > 0.7 * picked.sum()
    assert (placed[there] / depth[there] - 1).abs().median() < 0.01, "the ground's, 20 % farther"
    assert (judged == placed)[there].all(), "and is judged by it"
    plain = plane_depth(flying.depth[0].double(), frames.rgb[0], NOISE, PIXEL)
    assert (plain / depth[0] - 1)[picked[0]].abs().median() > 0.1, "else it keeps its own"
