"""Where a static surface ends: at a table's edge, not at a hole that something hides, and not where nobody saw more."""

import pytest
import torch

from vpd_lightning.dynamics.inertial import surface_edges as edges
from vpd_lightning.dynamics.inertial.surface_edges import surface_edges
from vpd_lightning.geometry.spacing import point_spacing

HALF = 0.4  # metres, of the table
Statics = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


def scattered(count: int, half: float, height: float, hole: float = 0.0, without: float = 0.0) -> torch.Tensor:
    """Random places in a square at a height, but for a hole in the middle and what lies under another square."""
    draw = torch.Generator().manual_seed(count)
    xy = half * (2 * torch.rand(count, 2, generator=draw, dtype=torch.float64) - 1)
    kept = (xy.norm(dim=-1) > hole) & (xy.abs().amax(dim=-1) > without)
    return torch.cat([xy, torch.full_like(xy[:, :1], height)], dim=-1)[kept]


def table_on_a_floor(with_floor: bool = True, hole: float = 0.0) -> Statics:
    parts = [scattered(600, HALF, 0.0, hole=hole)]
    if with_floor:
        parts.append(scattered(600, 0.8, -0.3, without=HALF))
    positions = torch.cat(parts)[None]
    up = torch.tensor([0, 0, 1.0], dtype=torch.float64).expand_as(positions)
    return positions, up, torch.ones_like(positions[..., 0]) > 0


def found(statics: Statics) -> edges.SurfaceEdges:
    spacing = point_spacing(statics[0], statics[2])
    return surface_edges(statics, spacing, 1.5 * spacing[:, None].expand_as(statics[2]))


def reached(statics: Statics, places: list[tuple[float, float]]) -> list[bool]:
    """Whether the table's top is taken to be at some places."""
    queries = torch.tensor([[[x, y, 0.0] for x, y in places]], dtype=torch.float64)
    index = (queries[:, :, None] - statics[0][:, None]).square().sum(dim=-1).argmin(dim=-1)
    offsets = queries - torch.gather(statics[0], 1, index[..., None].expand(-1, -1, 3))
    flat = torch.where(torch.tensor([True, True, False]), offsets, 0.0)
    return found(statics).gathered(index).include(flat, flat.norm(dim=-1))[0].tolist()


def test_a_table_ends_where_it_ends() -> None:
    statics = table_on_a_floor()
    made = found(statics)
    is_edge = torch.isfinite(made.ends[0])
    places = (statics[0] + made.ends.nan_to_num(posinf=0.0)[..., None] * made.outward)[0, is_edge]
    spacing = point_spacing(statics[0], statics[2]).item()
    assert is_edge.sum() > 40 and (statics[0][0, is_edge, 2] == 0).all()  # of the table, none of the floor
    gaps = places[:, :2].abs().amax(dim=-1) - HALF
    assert gaps.mean().abs() < 0.2 * spacing and gaps.abs().max() < 1.5 * spacing
    lengths = made.outward[0].norm(dim=-1)
    assert torch.allclose(lengths[is_edge], torch.ones(int(is_edge.sum())).double()) and not lengths[~is_edge].any()


def test_no_particle_near_the_rim_is_without_its_edge() -> None:
    statics = table_on_a_floor()
    made, places = found(statics), statics[0][0]
    spacing = point_spacing(statics[0], statics[2]).item()
    is_top = places[:, 2] == 0
    near_rim = is_top & (places[:, :2].abs().amax(dim=-1) > HALF - spacing)
    assert near_rim.sum() > 50 and torch.isfinite(made.ends[0, near_rim]).all()
    inside = is_top & (places[:, :2].abs().amax(dim=-1) < HALF - 4 * spacing)
    assert inside.sum() > 200 and torch.isinf(made.ends[0, inside]).double().mean() > 0.95


def test_what_is_beside_a_table_is_not_on_it() -> None:
    statics = table_on_a_floor()
    along = [-0.3 + 0.05 * step for step in range(13)]
    spacing = point_spacing(statics[0], statics[2]).item()
    assert sum(reached(statics, [(HALF - 0.5 * spacing, y) for y in along])) >= len(along) - 1
    assert sum(reached(statics, [(HALF + spacing, y) for y in along])) <= 1
    assert not any(reached(statics, [(HALF + 1.6 * spacing, y) for y in along]))


def test_a_hidden_hole_is_no_edge_and_what_nobody_saw_is_none() -> None:
    for statics in (table_on_a_floor(hole=0.09), table_on_a_floor(with_floor=False)):
        near = statics[0][0].norm(dim=-1) < 0.2
        made = found(statics)
        assert torch.isinf(made.ends[0, near]).all() and not made.outward[0, near].any()
    assert torch.isinf(found(table_on_a_floor(with_floor=False)).ends).all()
    assert all(reached(table_on_a_floor(hole=0.04), [(0.0, 0.0)]))


def test_the_number_of_particles_at_a_time_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    statics = table_on_a_floor()
    whole = found(statics)
    monkeypatch.setattr(edges, "_AT_ONCE", 37)
    parts = found(statics)
    assert torch.equal(whole.ends, parts.ends) and torch.equal(whole.outward, parts.outward)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_particles_have_no_edges(count: int) -> None:
    positions, normals, mask = (part[:, :count] for part in table_on_a_floor())
    made = surface_edges((positions, normals, mask), torch.ones(1).double(), torch.ones_like(positions[..., 0]))
    assert made.ends.shape == (1, count) and torch.isinf(made.ends).all() and not made.outward.isnan().any()


def test_far_from_the_origin_and_at_any_scale_it_is_the_same() -> None:
    positions, normals, mask = table_on_a_floor()
    first = found((positions, normals, mask))
    for scale in (1e-3, 1e3):
        scaled = found((positions * scale, normals, mask))
        assert torch.allclose(scaled.ends, first.ends * scale) and torch.allclose(scaled.outward, first.outward)
    moved = found((positions + 100.0, normals, mask))
    assert torch.allclose(moved.ends, first.ends, atol=1e-6)
