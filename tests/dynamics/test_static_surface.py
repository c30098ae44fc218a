"""Where contact sees what stands still: up to its edges, under bodies, and bodies that rest on it. Metres and steps."""

from dataclasses import replace

import pytest
import torch

from tests.dynamics.test_surface_edges import HALF, table_on_a_floor
from vpd_lightning.dynamics.inertial import static_surface as surfaces
from vpd_lightning.dynamics.inertial.body_motion import BodyMotion
from vpd_lightning.dynamics.inertial.contact_search import ContactPoints
from vpd_lightning.dynamics.inertial.static_surface import resting_clearances, static_surface, trusted_normals

FAR = 10.0


def table(hole: float = 0.0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A square of a metre at z = 0, a point every 5 cm, but for a round hole in the middle."""
    axis = torch.arange(-10, 11, dtype=torch.float64) / 20
    x, y = (values.flatten() for values in torch.meshgrid(axis, axis, indexing="ij"))
    kept = x.square() + y.square() >= hole**2
    positions = torch.stack([x, y, torch.zeros_like(x)], dim=-1)[kept][None]
    return positions, torch.tensor([0, 0, 1.0]).double().expand_as(positions), torch.ones_like(positions[..., 0]) > 0


def probes(*places: tuple[float, float, float]) -> ContactPoints:
    positions = torch.tensor([places], dtype=torch.float64)
    return ContactPoints(positions, torch.zeros_like(positions), torch.ones(1, 1, len(places), dtype=torch.float64))


def surface_of(statics, points, edge_reach=1.5, clearance=0.0, workspace=None):
    mask = torch.ones_like(points.positions[..., 0], dtype=torch.bool)
    clearances = torch.full((1, 1), clearance, dtype=torch.float64)
    return static_surface(statics, points.positions, mask, edge_reach, clearances, workspace)


def static_contacts(surface, points, statics, far, center=None):
    """Contacts of one body whose centre is that of its points, but a little higher, unless said otherwise."""
    middle = points.positions.mean(dim=1, keepdim=True) + torch.tensor([0, 0, 0.05]).double()
    given = middle if center is None else torch.tensor([[center]], dtype=torch.float64)
    return surfaces.static_contacts(surface, points, statics, given, far)


def test_a_surface_ends_where_it_was_seen_to_end() -> None:
    statics, points = table(), probes((0.2, 0.2, 0.1), (0.53, 0.2, 0.1), (0.7, 0.2, 0.1))
    inside = probes((0.2, 0.2, 0.1))  # footprints of the others would be a surface beyond the edge
    endless = static_contacts(surface_of(statics, inside, None), points, statics, FAR)
    ended = static_contacts(surface_of(statics, inside), points, statics, FAR)
    assert torch.allclose(endless.distances, torch.tensor([[0.1, 0.1, 0.1]]).double())
    assert torch.allclose(ended.distances, torch.tensor([[0.1, 0.1, FAR]]).double())
    assert ended.normals[0, 2].abs().max() == 0


def test_it_goes_on_where_the_workspace_cuts_it() -> None:
    corners = ((-2, -2, -1), (0.51, 2, 1))  # only the side towards +x cuts the table
    workspace = tuple(torch.tensor([[corner]], dtype=torch.float64) for corner in corners)
    statics, inside = table(), probes((0.2, 0.2, 0.1))
    points = probes((0.2, 0.2, 0.1), (3.0, 0.2, 0.1), (-0.7, 0.2, 0.1), (0.2, 0.7, 0.1))
    surface = surface_of(statics, inside, workspace=workspace)
    found = static_contacts(surface, points, statics, FAR)
    assert torch.allclose(found.distances, torch.tensor([[0.1, 0.1, FAR, FAR]]).double())
    without = static_contacts(surface_of(statics, inside), points, statics, FAR)
    assert torch.allclose(without.distances, torch.tensor([[0.1, FAR, FAR, FAR]]).double())


def test_it_goes_on_under_a_body() -> None:
    statics = table(hole=0.15)
    body = probes(*[(0.03 * x, 0.03 * y, 0.05) for x in range(-4, 5) for y in range(-4, 5)])
    middle = probes((0.0, 0.0, 0.05))
    nothing = replace(surface_of(statics, body), mask=torch.zeros(1, 81, dtype=torch.bool))
    assert static_contacts(nothing, middle, statics, FAR).distances.item() == FAR
    assert static_contacts(surface_of(statics, body), middle, statics, FAR).distances.item() == pytest.approx(0.05)


def motion(velocity: tuple[float, float, float]) -> BodyMotion:
    eye, zero = torch.eye(3).double()[None, None], torch.zeros(1, 1, 3).double()
    return BodyMotion(zero + 0.3, torch.tensor([[velocity]]).double(), zero, eye, 0 * eye)


@pytest.mark.parametrize(
    ("height", "velocity", "clearance"),
    [
        (0.02, (0, 0, 0), 0.02),  # its foot was not seen
        (-0.01, (0, 0, 0), -0.01),  # its guessed foot lies in the table
        (-0.03, (0, 0, 0), 0.0),  # so deep that the guess is wrong, as with two bodies taken for one
        (0.02, (0.03, 0, 0), 0.02),  # it slides
        (0.02, (0, 0, -0.02), 0.0),  # it falls
        (0.2, (0, 0, 0), 0.0),  # it hangs in the air, at the top of its flight
    ],
)
def test_what_rests_is_told_from_what_falls(height, velocity, clearance) -> None:
    points = probes((0.1, 0.1, height), (0.15, 0.1, height + 0.05))
    sizes = torch.full((1, 1), 0.05, dtype=torch.float64)
    found, rests = resting_clearances(points, table(), motion(velocity), sizes, 0.003, FAR)
    assert found.item() == pytest.approx(clearance) and bool(rests.item()) == (clearance != 0)
    if clearance:
        contacts = static_contacts(surface_of(table(), points, clearance=clearance), points, table(), FAR)
        assert contacts.distances.min().item() == pytest.approx(0, abs=1e-12)


def table_with_a_side(slanted: bool = False) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A table's top (x below 0) and its side (x = 0); ``slanted`` are normals along the edge that are of neither."""
    axis = torch.arange(1, 11, dtype=torch.float64) / 20
    y = torch.arange(-10, 11, dtype=torch.float64) / 20
    x, across = (values.flatten() for values in torch.meshgrid(-axis, y, indexing="ij"))
    z, along = (values.flatten() for values in torch.meshgrid(-axis[:4], y, indexing="ij"))
    top = torch.stack([x, across, torch.zeros_like(x)], dim=-1)
    side = torch.stack([torch.zeros_like(z), along, z], dim=-1)
    edge = torch.stack([torch.zeros_like(y), y, torch.zeros_like(y)], dim=-1)[: len(y) * slanted]
    normals = [torch.tensor(n).double().expand(len(p), -1) for n, p in (((0, 0, 1.0), top), ((1.0, 0, 0), side))]
    normals.append(torch.tensor([1.0, 0, 1.0]).double().expand(len(edge), -1) / 2**0.5)
    positions = torch.cat([top, side, edge])[None]
    return positions, torch.cat(normals)[None], torch.ones_like(positions[..., 0]) > 0


def test_a_side_pushes_what_is_beside_it_and_not_what_stands_on_top() -> None:
    statics = table_with_a_side()
    nothing = replace(surface_of(statics, probes((-0.3, 0.0, 0.1))), mask=torch.zeros(1, 1, dtype=torch.bool))
    low = probes((-0.01, 0.0, -0.04))  # its nearest particle is on the side
    on_top = static_contacts(nothing, low, statics, FAR, center=(-0.1, 0.0, 0.05))
    beside = static_contacts(nothing, low, statics, FAR, center=(0.05, 0.0, -0.1))
    assert on_top.distances.item() == FAR and not on_top.normals.any()
    assert beside.distances.item() == pytest.approx(-0.01)


def test_footprints_near_an_edge_are_on_the_top() -> None:
    statics = table_with_a_side()
    body = probes((-0.04, 0.02, 0.005), (-0.045, 0.0, 0.03))
    found = surface_of(statics, body)
    assert found.mask.all() and torch.allclose(found.positions[..., 2], torch.zeros(1, 2).double(), atol=1e-12)


@pytest.mark.parametrize("hidden", [0.05, 0.08])
def test_what_is_beyond_the_edge_when_first_seen_stands_on_nothing(hidden: float) -> None:
    """It hides the rim: particles around that hole, which are not at it, must know where the table ends."""
    held = []
    for y in range(-25, 26, 5):
        middle = torch.tensor([HALF, 0.01 * y, 0.0], dtype=torch.float64)
        positions, normals, mask = table_on_a_floor()
        seen = (positions[0] - middle).norm(dim=-1) > hidden
        statics = positions[:, seen], normals[:, seen], mask[:, seen]
        body = probes(*[(HALF + 0.01 * x, 0.01 * (y + z), 0.02) for x in range(-4, 5) for z in range(-4, 5)])
        found = static_contacts(surface_of(statics, body), body, statics, FAR)
        is_held = (found.distances < 0.1) & (found.normals[..., 2] > 0.9)
        held.append(is_held[0, body.positions[0, :, 0] > HALF + 0.012].double().mean().item())
    assert sum(held) / len(held) < 0.25, held  # without the edges of neighbours 0.6 and 0.99


def test_a_normal_that_its_neighbours_do_not_share_is_not_trusted() -> None:
    positions, normals, mask = table_with_a_side(slanted=True)
    kept = trusted_normals(positions, normals, mask).norm(dim=-1)[0] > 0.5
    is_slanted = normals[0, :, 0] * normals[0, :, 2] != 0
    assert not kept[is_slanted].any() and kept[normals[0, :, 2] == 1].float().mean() > 0.95
    alone = trusted_normals(positions[:, :1], normals[:, :1], mask[:, :1])
    assert torch.equal(alone, normals[:, :1]), "nothing contradicts one particle alone"


def test_without_an_edge_and_without_rest_nothing_is_different() -> None:
    from vpd_lightning.dynamics.inertial.contact_search import nearest_static_contacts

    statics, points = table(), probes((0.2, 0.23, 0.1), (3.0, 0.2, -0.1))
    plain = nearest_static_contacts(points.positions, *statics, FAR)
    same = static_contacts(surface_of(statics, points, None), points, statics, FAR)
    for name in ("distances", "normals", "lateral"):
        assert torch.equal(getattr(plain, name), getattr(same, name))
