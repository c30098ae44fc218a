"""Particles to PyTorch Geometric and back: nothing is lost but what padding held."""

from dataclasses import fields

import pytest
import torch
from torch_geometric.data import Batch, Data
from torch_geometric.loader import DataLoader
from torch_geometric.nn import global_mean_pool

from vpd_lightning.errors import NonFiniteError
from vpd_lightning.media.graph_data import from_graph_data, to_graph_data
from vpd_lightning.types import Particles


def particles(*batch: int, carried: bool = True, seed: int = 0) -> Particles:
    """Seven places, some of them padding (also in the middle) that holds NaN."""
    generator = torch.Generator().manual_seed(seed)
    mask = torch.rand(*batch, 7, generator=generator) > 0.3
    mask[..., 2] = False

    def table(width: int) -> torch.Tensor:
        values = torch.randn(*batch, 7, width, generator=generator)
        return torch.where(mask[..., None], values, torch.nan)

    moving = torch.rand(*batch, 7, generator=generator) > 0.5
    kept = {"colors": table(3), "moving": moving & mask, "normals": table(3)} if carried else {}
    return Particles(table(3), table(5), mask, **kept)


def assert_same(one: Particles, other: Particles) -> None:
    assert torch.equal(one.mask, other.mask) and not one.mask.all()
    for field in fields(Particles):
        a, b = getattr(one, field.name), getattr(other, field.name)
        assert (a is None) == (b is None), field.name
        if a is not None:
            assert a.dtype == b.dtype and a.shape == b.shape
            assert torch.equal(a[one.mask], b[one.mask]), field.name


@pytest.mark.parametrize("batch", [(), (1,), (3,)])
@pytest.mark.parametrize("carried", [True, False])
def test_there_and_back(batch: tuple[int, ...], carried: bool) -> None:
    before = particles(*batch, carried=carried)
    data = to_graph_data(before, edge_radius=None)
    assert isinstance(data, Batch) == bool(batch) and data.num_nodes == int(before.mask.sum())
    assert torch.isfinite(data.pos).all(), "padding stays behind"
    after = from_graph_data(data)
    assert_same(before, after)
    assert torch.isfinite(after.positions).all()


def test_a_batch_is_one_that_pytorch_geometric_understands() -> None:
    before = particles(3)
    data = to_graph_data(before, edge_radius=None)
    assert data.num_graphs == 3 and data.batch.bincount().tolist() == before.mask.sum(1).tolist()
    means = global_mean_pool(data.x, data.batch)
    for member in range(3):
        torch.testing.assert_close(means[member], before.features[member][before.mask[member]].mean(0))
    loader = DataLoader([to_graph_data(particles(seed=seed), edge_radius=0.5) for seed in range(4)], batch_size=4)
    (again,) = loader
    assert_same(particles(seed=2), from_graph_data(again.get_example(2)))
    assert from_graph_data(again).positions.shape == (4, 7, 3)


def test_edges_join_what_is_near() -> None:
    before = particles(2, seed=3)
    data = to_graph_data(before, edge_radius=1.5)
    offset = data.pos[:, None] - data.pos[None]
    near = (offset.square().sum(-1).sqrt() <= 1.5) & (data.batch[:, None] == data.batch[None])
    near.fill_diagonal_(False)
    expected = near.nonzero()  # (target, source), in that order
    assert len(expected) > 4
    assert torch.equal(data.edge_index, torch.stack([expected[:, 1], expected[:, 0]]))
    assert "edge_index" not in to_graph_data(before, edge_radius=None)


def test_an_empty_scene_survives() -> None:
    before = Particles(torch.zeros(2, 4, 3), torch.zeros(2, 4, 5), torch.tensor([[False] * 4, [True] * 4]))
    assert torch.equal(from_graph_data(to_graph_data(before, edge_radius=0.1)).mask, before.mask)


def test_graphs_from_elsewhere_are_padded_to_the_longest() -> None:
    graphs = [Data(x=torch.ones(n, 2), pos=torch.full((n, 3), float(n))) for n in (2, 4)]
    read = from_graph_data(Batch.from_data_list(graphs))
    assert read.mask.tolist() == [[True, True, False, False], [True] * 4]
    assert read.positions[0, 0, 0] == 2 and read.positions[0, 3, 0] == 0 and read.colors is None


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (Data(x=torch.ones(2, 1)), "pos"),
        (Data(pos=torch.ones(2, 2), x=torch.ones(2, 1)), "pos"),
        (Data(pos=torch.ones(2, 3)), "features"),
        (Data(pos=torch.ones(2, 3), x=torch.ones(3, 1)), "features"),
        (Data(pos=torch.ones(2, 3), x=torch.ones(2, 1), slot=torch.tensor([0, 0]), num_slots=2), "place of its own"),
        (Data(pos=torch.ones(2, 3), x=torch.ones(2, 1), slot=torch.tensor([0, 2]), num_slots=2), "place of its own"),
    ],
)
def test_bad_graphs_are_refused(data: Data, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        from_graph_data(data)


def test_bad_particles_are_refused() -> None:
    with pytest.raises(ValueError, match="at most one batch axis"):
        to_graph_data(particles(2, 2), edge_radius=None)
    with pytest.raises(ValueError, match="max_radius"):
        to_graph_data(particles(), edge_radius=-1.0)
    broken = Particles(torch.full((2, 3), torch.nan), torch.zeros(2, 1))
    with pytest.raises(NonFiniteError):
        to_graph_data(broken, edge_radius=1.0)
