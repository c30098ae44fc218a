"""Which points cast shadows: those that move, packed, and evenly thinned where there are many."""

import torch

from vpd_lightning.geometry.occluders import MOST_OCCLUDERS, occluders_of, thinned
from vpd_lightning.types import Occluders, Particles


def line(count: int) -> torch.Tensor:
    """Points at 0, 1, 2, ... of two members."""
    return torch.arange(float(count), dtype=torch.float64)[None, :, None].expand(2, -1, 3)


def test_they_are_the_packed_moving_particles_of_each_member() -> None:
    places = line(40)
    moving = torch.stack([torch.arange(40) % 3 == 0, torch.arange(40) % 2 == 0])
    mask = torch.arange(40).expand(2, 40) > 3
    found = occluders_of(Particles(places, torch.zeros(2, 40, 1), mask, moving=moving))
    for member in range(2):
        expected = places[member][moving[member] & mask[member]]
        assert torch.equal(found.positions[member][found.mask[member]], expected)
    assert found.mask.shape[1] == int((moving & mask).sum(dim=1).max())


def test_fewer_are_spread_evenly_over_all() -> None:
    mask = torch.ones(2, 30, dtype=torch.bool)
    mask[1, ::2] = False
    few = thinned(Occluders(line(30), mask), 10)
    assert few.positions[0, :, 0].tolist() == list(range(0, 30, 3)) and few.mask.all()
    odd = list(range(1, 30, 2))
    assert few.positions[1, :, 0].tolist() == [odd[number * 15 // 10] for number in range(10)]


def test_thinning_twice_is_thinning_once() -> None:
    count = 3 * MOST_OCCLUDERS + 5
    generator = torch.Generator().manual_seed(0)
    mask = torch.rand(2, count, generator=generator) > 0.3
    everything = Occluders(line(count), mask)
    once, twice = thinned(everything, 512), thinned(thinned(everything, MOST_OCCLUDERS), 512)
    assert torch.equal(once.positions, twice.positions) and torch.equal(once.mask, twice.mask)
