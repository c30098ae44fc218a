from dataclasses import replace

import pytest
import torch

from vpd_lightning.dynamics.global_mlp import GlobalMLPDynamics
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Particles

SMALL = {"feature_dim": 6, "hidden_dim": 16, "num_hidden_layers": 2}
KEYS = RandomKeys.fixed(3)


def dynamics_of(is_moved: bool = True, dtype: torch.dtype = torch.float64) -> GlobalMLPDynamics:
    torch.manual_seed(0)
    dynamics = GlobalMLPDynamics(**SMALL)
    if is_moved:
        for parameter in dynamics.parameters():
            torch.nn.init.normal_(parameter, std=0.4)
    return dynamics.to(dtype)


def scene(seed: int, dtype: torch.dtype = torch.float64) -> Particles:
    features = torch.randn(3, 1, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    features = torch.nn.functional.normalize(features, dim=-1).to(dtype)
    return Particles(torch.zeros(3, 1, 3, dtype=dtype), features)


def test_parameter_count_at_full_size() -> None:
    dynamics = GlobalMLPDynamics(feature_dim=256, hidden_dim=512, num_hidden_layers=3)
    assert sum(parameter.numel() for parameter in dynamics.parameters()) == 919_296


def test_it_starts_with_nothing_changes_and_can_learn() -> None:
    dynamics, previous, current = dynamics_of(is_moved=False), scene(0), scene(1)
    following, memory = dynamics(previous, current, None, KEYS, 0)
    torch.testing.assert_close(following.features, current.features)
    assert memory is None
    following.features[..., 0].sum().backward()
    assert dynamics.network.layers[-1].weight.grad.any()


def test_it_is_the_formula_written_out() -> None:
    dynamics, previous, current = dynamics_of(), scene(0), scene(1)
    hidden = torch.cat([previous.features, current.features], dim=-1)[:, 0]
    for index, layer in enumerate(dynamics.network.layers):
        hidden = hidden @ layer.weight.T + layer.bias
        if index < 2:
            hidden = hidden.clamp(min=0)
    moved = current.features[:, 0] + hidden
    expected = moved / moved.square().sum(-1, keepdim=True).sqrt()
    following, _ = dynamics(previous, current, None, KEYS, 0)
    torch.testing.assert_close(following.features[:, 0], expected, rtol=1e-12, atol=1e-12)


def test_the_previous_frame_tells_the_velocity() -> None:
    dynamics = dynamics_of()
    first, second = (dynamics(scene(seed), scene(1), None, KEYS, 0)[0].features for seed in (0, 7))
    assert (first - second).abs().max() > 1e-3


def test_states_keep_unit_length_over_32_steps() -> None:
    dynamics = dynamics_of(dtype=torch.float32)
    previous, current = scene(0, torch.float32), scene(1, torch.float32)
    for step in range(32):
        previous, (current, _) = current, dynamics(previous, current, None, KEYS, step)
        torch.testing.assert_close(current.features.norm(dim=-1), torch.ones(3, 1), rtol=0, atol=1e-6)
    assert not torch.allclose(current.features, scene(1, torch.float32).features, atol=0.1)


def test_positions_stay_and_do_not_matter() -> None:
    dynamics, previous, current = dynamics_of(), scene(0), scene(1)
    noisy = replace(current, positions=torch.randn_like(current.positions))
    plain, _ = dynamics(previous, current, None, KEYS, 0)
    other, _ = dynamics(previous, noisy, None, KEYS, 0)
    assert torch.equal(other.features, plain.features) and torch.equal(other.positions, noisy.positions)


def test_padding_without_a_number_harms_neither_values_nor_gradients() -> None:
    dynamics, previous, current = dynamics_of(), scene(0), scene(1)
    nothing = torch.full((3, 1, 6), torch.nan, dtype=torch.float64)
    features = torch.cat([current.features, nothing], dim=1)
    padded = Particles(torch.zeros(3, 2, 3, dtype=torch.float64), features, torch.tensor([[True, False]] * 3))
    following, _ = dynamics(previous, padded, None, KEYS, 0)
    plain, _ = dynamics(previous, current, None, KEYS, 0)
    torch.testing.assert_close(following.features[:, :1], plain.features)
    following.features[:, 0].sum().backward()
    assert all(parameter.grad.isfinite().all() for parameter in dynamics.parameters())


@pytest.mark.parametrize("name", list(SMALL))
def test_values_out_of_range_are_refused_by_name(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        GlobalMLPDynamics(**(SMALL | {name: 0}))
