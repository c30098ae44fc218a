"""Round bodies that roll for long, that are tiny, huge or far away, and those that are hardly bodies at all."""

import pytest
import torch

from tests.dynamics.solids import random_rotation
from tests.dynamics.test_round_bodies import Roller, ellipsoid, seen_half
from vpd_lightning.dynamics.inertial.round_bodies import fit_ellipsoids


@pytest.mark.parametrize("seed", range(3))
def test_an_ellipsoid_that_rolls_gains_no_energy(seed: int) -> None:
    body = Roller((0.035, 0.04, 0.05), 0.015, True, random_rotation(seed).double())
    body.step()
    energies = [body.energy()]
    for _ in range(150):
        body.step()
        energies.append(body.energy())
    assert max(energies) < 1.05 * energies[0]
    assert body.motion.centers[0, 0, 2] > 0.03, "it does not sink"


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_an_ellipsoid_of_any_size_is_found(scale: float, dtype: torch.dtype) -> None:
    points, normals = seen_half(*ellipsoid(300, (0.03, 0.04, 0.06)))
    points, normals = (scale * points).to(dtype), normals.to(dtype)
    members = torch.ones(1, 1, len(points), dtype=dtype)
    _, shapes = fit_ellipsoids(points[None], normals[None], members, points.mean(dim=0)[None, None])
    expected = [0.03 * scale, 0.04 * scale, 0.06 * scale]
    assert torch.linalg.eigvalsh(shapes[0, 0].double()).sqrt().tolist() == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("kind", ["none", "one", "line", "plane", "same place", "no normals"])
def test_what_is_hardly_a_body_is_finite_and_not_round(kind: str) -> None:
    points, normals = ellipsoid(60, (0.04, 0.04, 0.04))
    keep = {"none": 0, "one": 1}.get(kind, 60)
    members = (torch.arange(60) < keep).double()[None, None]
    if kind == "line":
        points = points * torch.tensor([1.0, 0, 0]).double()
    if kind == "plane":
        points = points * torch.tensor([1.0, 1, 0]).double()
        normals = torch.tensor([0, 0, 1.0]).double().expand_as(points)
    points = points[:1].expand(60, 3) if kind == "same place" else points
    normals = torch.zeros_like(normals) if kind == "no normals" else normals
    start = torch.zeros(1, 1, 3).double()
    centers, shapes = fit_ellipsoids(points[None], normals[None], members, start)
    assert torch.equal(centers, start) and not shapes.any()
