import pytest
import torch
from torch.utils.checkpoint import checkpoint

from vpd_lightning.dynamics.hierarchical_gnn import HierarchicalGNNDynamics
from vpd_lightning.errors import NonFiniteError
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Particles

SMALL = {
    "feature_dim": 4,
    "hidden_dim": 16,
    "message_passing_steps": 2,
    "num_abstract_nodes": 12,
    "max_abstract_neighbors": 2,
    "r_s": 0.4,
    "r_a_s": 0.9,
    "location_scale": 0.1,
    "edge_capacity": None,
    "max_abstract_edges_per_node": None,
    "feature_limit": 1e4,
    "zero_init_decoders": False,
    "normalized_edges": False,
    "edge_gain": 1.0,
    "aggregation": "sum",
    "update_features": True,
    "has_driven": False,
    "compile": False,
    "neighbors_backend": "auto",
}


def dynamics_of(**changes: object) -> HierarchicalGNNDynamics:
    return HierarchicalGNNDynamics(**(SMALL | changes)).double()


def particles(batch: int, count: int, seed: int, mask: torch.Tensor | None = None) -> Particles:
    generator = torch.Generator().manual_seed(seed)
    positions = torch.rand(batch, count, 3, generator=generator, dtype=torch.float64)
    features = torch.rand(batch, count, 4, generator=generator, dtype=torch.float64)
    return Particles(positions, features, torch.ones(batch, count, dtype=torch.bool) if mask is None else mask)


def step(dynamics: HierarchicalGNNDynamics, previous: Particles, current: Particles, index: list[int]) -> Particles:
    return dynamics(previous, current, None, RandomKeys(0, 0, index), 0)[0]


def test_only_relative_positions_matter() -> None:
    dynamics, previous, current = dynamics_of(), particles(1, 40, 0), particles(1, 50, 1)
    shift = torch.tensor([3.0, -2.0, 7.0], dtype=torch.float64)
    here = step(dynamics, previous, current, [0])
    there = step(
        dynamics,
        Particles(previous.positions + shift, previous.features),
        Particles(current.positions + shift, current.features),
        [0],
    )
    # Rounding of coordinates around 10 is 1e-15; layer norms amplify it a little.
    torch.testing.assert_close(there.positions - shift, here.positions, rtol=0, atol=1e-10)
    torch.testing.assert_close(there.features, here.features, rtol=0, atol=1e-10)


def test_the_order_of_particles_does_not_matter() -> None:
    # With as many abstract nodes as particles their choice is the same set in any order.
    dynamics, previous, current = dynamics_of(num_abstract_nodes=50), particles(1, 40, 0), particles(1, 50, 1)
    first, second = torch.randperm(40), torch.randperm(50)
    plain = step(dynamics, previous, current, [0])
    shuffled = step(
        dynamics,
        Particles(previous.positions[:, first], previous.features[:, first]),
        Particles(current.positions[:, second], current.features[:, second]),
        [0],
    )
    torch.testing.assert_close(shuffled.positions, plain.positions[:, second], rtol=0, atol=1e-10)
    torch.testing.assert_close(shuffled.features, plain.features[:, second], rtol=0, atol=1e-10)


def test_a_batch_equals_its_members() -> None:
    dynamics, previous, current = dynamics_of(), particles(3, 40, 0), particles(3, 50, 1)
    together = step(dynamics, previous, current, [4, 5, 6])
    for member in range(3):
        alone = step(
            dynamics,
            Particles(previous.positions[member : member + 1], previous.features[member : member + 1]),
            Particles(current.positions[member : member + 1], current.features[member : member + 1]),
            [4 + member],
        )
        torch.testing.assert_close(together.positions[member], alone.positions[0], rtol=0, atol=1e-12)
        torch.testing.assert_close(together.features[member], alone.features[0], rtol=0, atol=1e-12)


def test_padding_changes_nothing_and_stays_as_it_is() -> None:
    dynamics, previous, current = dynamics_of(), particles(1, 40, 0), particles(1, 50, 1)
    mask = torch.arange(60)[None] < 50
    padding = torch.full((1, 10, 3), torch.nan, dtype=torch.float64)
    padded = Particles(
        torch.cat([current.positions, padding], dim=1),
        torch.cat([current.features, torch.full((1, 10, 4), torch.nan, dtype=torch.float64)], dim=1),
        mask,
    )
    plain, with_padding = step(dynamics, previous, current, [0]), step(dynamics, previous, padded, [0])
    torch.testing.assert_close(with_padding.positions[:, :50], plain.positions, rtol=0, atol=1e-12)
    assert torch.equal(with_padding.mask, mask)
    loss = with_padding.positions[mask].sum() + with_padding.features[mask].sum()
    loss.backward()
    assert all(bool(torch.isfinite(parameter.grad).all()) for parameter in dynamics.parameters())


def test_particles_move_no_faster_than_the_location_scale() -> None:
    dynamics, previous, current = dynamics_of(location_scale=0.03), particles(1, 40, 0), particles(1, 50, 1)
    with torch.no_grad():
        dynamics.decode_location.layers[-1].weight.mul_(1e3)
    moved = (step(dynamics, previous, current, [0]).positions - current.positions).abs()
    assert 0.029 < float(moved.detach().max()) <= 0.03 + 1e-12


def test_gradients_reach_every_parameter_and_input() -> None:
    dynamics, previous, current = dynamics_of(), particles(1, 40, 0), particles(1, 50, 1)
    inputs = [previous.positions, previous.features, current.positions, current.features]
    for tensor in inputs:
        tensor.requires_grad_()
    following = step(dynamics, previous, current, [0])
    (following.positions.square().sum() + following.features.square().sum()).backward()
    for name, parameter in dynamics.named_parameters():
        assert parameter.grad is not None and bool(parameter.grad.abs().sum() > 0), name
    for tensor in inputs:
        assert bool(tensor.grad.abs().sum() > 0)


@pytest.mark.parametrize("frame", ["previous", "current"])
def test_gradients_to_positions_are_those_of_finite_differences(frame: str) -> None:
    dynamics, frames = dynamics_of(), {"previous": particles(1, 40, 0), "current": particles(1, 50, 1)}
    start = frames[frame].positions.clone().requires_grad_()
    direction = torch.randn(start.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)

    def features_after(positions: torch.Tensor) -> torch.Tensor:
        moved = frames | {frame: Particles(positions, frames[frame].features)}
        return step(dynamics, moved["previous"], moved["current"], [0]).features.square().sum()

    (gradient,) = torch.autograd.grad(features_after(start), start)
    with torch.no_grad():
        ahead, behind = (features_after(start + sign * 1e-8 * direction) for sign in (1, -1))
    # So short a step meets no bend of a layer. Values of order 100, rounded by 1e-15 of themselves, leave 1e-5 over it.
    torch.testing.assert_close((gradient * direction).sum(), (ahead - behind) / 2e-8, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("nothing", ["edges", "previous", "particles"])
def test_every_parameter_gets_a_gradient_without_any_edge(nothing: str) -> None:
    dynamics, previous, current = dynamics_of(num_abstract_nodes=1), particles(1, 5, 0), particles(1, 6, 1)
    if nothing == "edges":
        dynamics.r_s = dynamics.r_a_s = 1e-9
        previous = Particles(previous.positions + 100, previous.features)
    elif nothing == "previous":
        previous = Particles(previous.positions, previous.features, torch.zeros(1, 5, dtype=torch.bool))
    else:
        current = Particles(current.positions, current.features, torch.zeros(1, 6, dtype=torch.bool))
    following = step(dynamics, previous, current, [0])
    (following.positions.sum() + following.features.sum()).backward()
    for name, parameter in dynamics.named_parameters():
        assert parameter.grad is not None and bool(torch.isfinite(parameter.grad).all()), name


def test_an_uncovered_particle_gets_a_zero_message_and_is_reported() -> None:
    dynamics, previous, current = dynamics_of(num_abstract_nodes=1, r_s=1e-9), particles(1, 40, 0), particles(1, 50, 1)
    following = step(dynamics, previous, current, [0])
    assert dynamics.last_uncovered_share.item() == pytest.approx(49 / 50)
    nodes = dynamics.encode_node["current"](current.features[0])
    nodes = dynamics.update_node["current"](nodes, torch.zeros_like(nodes))
    expected = current.positions[0] + 0.1 * torch.tanh(dynamics.decode_location(nodes))
    same = torch.isclose(following.positions[0], expected, rtol=0, atol=1e-12).all(dim=-1)
    assert int(same.sum()) >= 49


def test_checkpointed_gradients_are_the_same() -> None:
    previous, current = particles(2, 40, 0), particles(2, 50, 1)
    gradients = []
    for is_checkpointed in (False, True):
        torch.manual_seed(0)
        dynamics, keys = dynamics_of(), RandomKeys(0, 0, [0, 1])
        before, now = previous, current
        for index in range(3):
            arguments = (before, now, None, keys, index)
            following = (
                checkpoint(dynamics, *arguments, use_reentrant=False) if is_checkpointed else dynamics(*arguments)
            )
            before, now = now, following[0]
        (now.positions.square().sum() + now.features.square().sum()).backward()
        gradients.append([parameter.grad for parameter in dynamics.parameters()])
    assert all(torch.equal(plain, again) for plain, again in zip(*gradients, strict=True))


def test_abstract_nodes_are_drawn_anew_for_step_sample_and_rollout_step() -> None:
    dynamics, previous, current = dynamics_of(), particles(1, 40, 0), particles(1, 50, 1)

    def positions(keys: RandomKeys, rollout_step: int) -> torch.Tensor:
        return dynamics(previous, current, None, keys, rollout_step)[0].positions

    first = positions(RandomKeys(0, 0, [0]), 0)
    assert torch.equal(first, positions(RandomKeys(0, 0, [0]), 0))
    for keys, rollout_step in ((RandomKeys(0, 1, [0]), 0), (RandomKeys(0, 0, [1]), 0), (RandomKeys(0, 0, [0]), 1)):
        assert not torch.equal(first, positions(keys, rollout_step))


def test_positions_stay_float32_under_autocast() -> None:
    dynamics = dynamics_of().float()
    previous, current = particles(1, 40, 0).to(torch.float32), particles(1, 50, 1).to(torch.float32)
    exact = step(dynamics, previous, current, [0])
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rounded = step(dynamics, previous, current, [0])
    assert rounded.positions.dtype == rounded.features.dtype == torch.float32
    # bf16 products keep about three digits; deltas are at most 0.1.
    torch.testing.assert_close(rounded.positions, exact.positions, rtol=0, atol=2e-2)


def test_parameter_count_at_the_papers_size() -> None:
    size = {"feature_dim": 16, "hidden_dim": 128, "message_passing_steps": 10, "num_abstract_nodes": 1024}
    dynamics = dynamics_of(**size)
    assert sum(parameter.numel() for parameter in dynamics.parameters()) == 1_612_435


def test_a_particle_that_is_not_a_number_is_refused() -> None:
    dynamics, previous, current = dynamics_of(), particles(1, 40, 0), particles(1, 50, 1)
    current.positions[0, 3, 0] = torch.nan
    with pytest.raises(NonFiniteError):
        step(dynamics, previous, current, [0])


@pytest.mark.parametrize(
    ("name", "value"),
    [("hidden_dim", 0), ("r_s", 0.0), ("r_a_s", -1.0), ("location_scale", 0.0), ("message_passing_steps", -1)],
)
def test_values_out_of_range_are_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        dynamics_of(**{name: value})


def test_decoders_that_start_at_zero_leave_everything_as_it_is() -> None:
    previous, current = particles(1, 40, 0), particles(1, 50, 1)
    following = step(dynamics_of(zero_init_decoders=True), previous, current, [0])
    assert torch.equal(following.positions, current.positions) and torch.equal(following.features, current.features)
    dynamics = dynamics_of(zero_init_decoders=True)
    step(dynamics, previous, current, [0]).positions.square().sum().backward()
    assert bool(dynamics.decode_location.layers[-1].weight.grad.any())  # but it learns


def test_features_stay_where_they_are_not_updated() -> None:
    dynamics, previous, current = dynamics_of(update_features=False), particles(1, 40, 0), particles(1, 50, 1)
    following = step(dynamics, previous, current, [0])
    assert torch.equal(following.features, current.features)
    assert not torch.equal(following.positions, current.positions)
    assert not any(name.startswith("decode_feature") for name, _ in dynamics.named_parameters())


def test_normalized_edges_do_not_depend_on_the_unit_of_length() -> None:
    previous, current = particles(1, 40, 0), particles(1, 50, 1)
    torch.manual_seed(0)
    metres = dynamics_of(normalized_edges=True)
    torch.manual_seed(0)
    millimetres = dynamics_of(normalized_edges=True, r_s=400.0, r_a_s=900.0, location_scale=100.0)
    here = step(metres, previous, current, [0])
    there = step(
        millimetres,
        Particles(1000 * previous.positions, previous.features),
        Particles(1000 * current.positions, current.features),
        [0],
    )
    torch.testing.assert_close(there.positions / 1000, here.positions, rtol=0, atol=1e-10)


def test_a_gain_without_normalized_edges_is_refused() -> None:
    with pytest.raises(ValueError, match="edge_gain=3.0 multiplies normalised edges: set normalized_edges=true"):
        dynamics_of(edge_gain=3.0)


def test_an_unknown_aggregation_is_refused() -> None:
    with pytest.raises(ValueError, match="aggregation must be sum or mean, got 'max'"):
        dynamics_of(aggregation="max")
