"""Where contact sees what stands still: up to its edges, under bodies, and bodies that rest on it. Metres and steps."""

from dataclasses import replace

import pytest
import torch

from vpd_lightning.dynamics.inertial.body_motion import BodyMotion
from vpd_lightning.dynamics.inertial.contact import ContactPoints
from vpd_lightning.dynamics.inertial.static_surface import resting_clearances, static_contacts, static_surface

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


def surface_of(statics, points, edge_reach=1.5, clearance=0.0):
    mask = torch.ones_like(points.positions[..., 0], dtype=torch.bool)
    clearances = torch.full((1, 1), clearance, dtype=torch.float64)
    return static_surface(statics, points.positions, mask, edge_reach, clearances)


def test_a_surface_ends_where_it_was_seen_to_end() -> None:
    statics, points = table(), probes((0.2, 0.2, 0.1), (0.53, 0.2, 0.1), (0.7, 0.2, 0.1))
    inside = probes((0.2, 0.2, 0.1))  # footprints of the others would be a surface beyond the edge
    endless = static_contacts(surface_of(statics, inside, None), points, statics, FAR)
    ended = static_contacts(surface_of(statics, inside), points, statics, FAR)
    assert torch.allclose(endless.distances, torch.tensor([[0.1, 0.1, 0.1]]).double())
    assert torch.allclose(ended.distances, torch.tensor([[0.1, 0.1, FAR]]).double())
    assert ended.normals[0, 2].abs().max() == 0


def test_it_goes_on_under_a_body() -> None:
    statics = table(hole=0.15)
    body = probes(*[(0.03 * x, 0.03 * y, 0.05) for x in range(-4, 5) for y in range(-4, 5)])
    middle = probes((0.0, 0.0, 0.05))
    nothing = replace(surface_of(statics, body), mask=torch.zeros(1, 81, dtype=torch.bool))
    assert static_contacts(nothing, middle, statics, FAR).distances.item() == FAR
    assert static_contacts(surface_of(statics, body), middle, statics, FAR).distances.item() == pytest.approx(0.05)


def motion(velocity: tuple[float, float, float]) -> BodyMotion:
    eye, zero = torch.eye(3).double()[None, None], torch.zeros(1, 1, 3).double()
    return BodyMotion(zero, torch.tensor([[velocity]]).double(), zero, eye, 0 * eye)


@pytest.mark.parametrize(
    ("height", "velocity", "clearance"),
    [
        (0.02, (0, 0, 0), 0.02),  # its foot was not seen
        (-0.01, (0, 0, 0), -0.01),  # its guessed foot lies in the table
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


def test_without_an_edge_and_without_rest_nothing_is_different() -> None:
    from vpd_lightning.dynamics.inertial.contact import nearest_static_contacts

    statics, points = table(), probes((0.2, 0.23, 0.1), (3.0, 0.2, -0.1))
    plain = nearest_static_contacts(points.positions, *statics, FAR)
    same = static_contacts(surface_of(statics, points, None), points, statics, FAR)
    for name in ("distances", "normals", "lateral"):
        assert torch.equal(getattr(plain, name), getattr(same, name))
