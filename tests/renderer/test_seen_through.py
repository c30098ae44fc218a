"""A table before a floor: where one ends and the other shows."""

from dataclasses import replace

import torch

from tests.renderer.test_scenery_layer import BLUE, RED, joined, layer, through, unit, wall
from vpd_lightning.types import Rays


def table_and_floor():
    """What one camera saw of a red table at 1 m, which fills the right half of its picture, and a blue floor at 2 m."""
    right = (torch.arange(256) % 16 >= 8).view(1, 256)
    near, far = wall(1.0, RED), wall(2.0, BLUE)
    return joined(replace(near, mask=right), replace(far, mask=~right))


def test_a_surface_ends_where_a_camera_saw_past_it():
    columns = torch.arange(5.5, 11.0)
    rays = through(torch.stack([columns, torch.full_like(columns, 8.5)], dim=-1))
    scene, red, blue = table_and_floor(), torch.tensor(RED).double(), torch.tensor(BLUE).double()

    seen, before = (layer(12, seen_through=does)(scene, rays).colors[0] for does in (True, False))

    torch.testing.assert_close(seen, torch.stack([blue] * 3 + [red] * 3), rtol=0, atol=1e-3)
    assert (before[2] - red).abs().max() < 0.2, "its pixel beside the table, which would be in front of it"


def test_from_where_no_camera_saw_past_it_a_surface_reaches_farther():
    """Half a turn of the learned angle away the floor's pixel says nothing about what is before it."""
    edge = torch.tensor([0.025, 0.025, 1.0], dtype=torch.float64)  # half a pixel beside the last one of the table
    rays = Rays(edge.expand(1, 1, 3) - unit(torch.tensor([0.4, 0.0, 1.0])).double(), torch.zeros(1, 1, 3))
    rays = Rays(rays.origins, unit(edge - rays.origins))

    seen = layer(12)(table_and_floor(), rays)

    assert (seen.colors[0, 0] - torch.tensor(RED)).abs().max() < 0.2 and seen.opacities.min() > 0.9
