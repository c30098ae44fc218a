"""Muon for matrices, Adam for the rest: steps, state, and what a checkpoint keeps."""

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from vpd_lightning.training.muon import MIN_WIDTH, WarmupCosineMuon
from vpd_lightning.training.optimization import WarmupCosineAdam

SETTINGS = {
    "lr": 1e-3, "betas": [0.9, 0.999], "eps": 1e-8, "stage_multipliers": {"renderer": 0.5}, "warmup_steps": 0,
    "final_share": 1.0,
}  # fmt: skip


def muon(**changes: Any) -> WarmupCosineMuon:
    return WarmupCosineMuon(**{**SETTINGS, "muon_lr": 1e-2, "muon_momentum": 0.95, **changes})


def system() -> nn.Module:
    torch.manual_seed(0)
    stages = nn.Module()
    stages.dynamics = nn.Sequential(nn.Linear(3, 32), nn.Linear(32, 32), nn.Linear(32, 3))
    stages.renderer = nn.Linear(32, MIN_WIDTH)
    return stages


def give_gradients(model: nn.Module, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    for weight in model.parameters():
        weight.grad = torch.randn(weight.shape, generator=generator)


def trained(model: nn.Module, optimizer: torch.optim.Optimizer, seeds: range) -> list[Tensor]:
    for seed in seeds:
        give_gradients(model, seed)
        optimizer.step()
    return [weight.detach().clone() for weight in model.parameters()]


def test_each_weight_is_stepped_once_by_its_own_kind():
    model = system()
    optimizer, _ = muon().build(model, max_steps=10)
    groups = {(group["name"], group["is_matrix"]): group for group in optimizer.param_groups}

    assert {name: [tuple(p.shape) for p in group["params"]] for name, group in groups.items()} == {
        ("dynamics", True): [(32, 32)],
        ("dynamics", False): [(32, 3), (32,), (32,), (3, 32), (3,)],
        ("renderer", True): [(16, 32)],
        ("renderer", False): [(16,)],
    }
    assert {name: group["lr"] for name, group in groups.items()} == {
        ("dynamics", True): 1e-2, ("dynamics", False): 1e-3, ("renderer", True): 5e-3, ("renderer", False): 5e-4,
    }  # fmt: skip


def test_steps_are_those_of_muon_and_of_adam_alone():
    model, alone = system(), system()
    ours = trained(model, muon().build(model, max_steps=10)[0], range(3))
    matrices = {"dynamics.1.weight": 1e-2, "renderer.weight": 5e-3}
    parts: list[torch.optim.Optimizer] = []
    for name, weight in alone.named_parameters():
        if name in matrices:
            rate = {"lr": matrices[name], "weight_decay": 0.0, "momentum": 0.95, "adjust_lr_fn": "match_rms_adamw"}
            parts.append(torch.optim.Muon([weight], **rate))
        else:
            parts.append(torch.optim.Adam([weight], lr=1e-3 if name.startswith("dynamics") else 5e-4))
    for seed in range(3):
        give_gradients(alone, seed)
        for part in parts:
            part.step()

    for one, other in zip(ours, alone.parameters(), strict=True):
        torch.testing.assert_close(one, other.detach(), rtol=1e-5, atol=1e-7)


def test_a_gradient_with_one_direction_moves_a_matrix_no_more_than_any_other():
    """What Muon is here for: the size of the step does not come from the largest singular value."""
    model = nn.Module()
    model.dynamics = nn.Linear(32, 32, bias=False)
    optimizer, _ = muon(muon_momentum=0.0, stage_multipliers={}).build(model, max_steps=10)
    before = model.dynamics.weight.detach().clone()
    common = torch.outer(torch.ones(32), torch.ones(32))
    gradient = 100 * common + torch.randn(32, 32, generator=torch.Generator().manual_seed(0))
    model.dynamics.weight.grad = gradient.clone()
    optimizer.step()

    step, given = (torch.linalg.svdvals(x) for x in (model.dynamics.weight.detach() - before, gradient))
    assert given[0] / given[15] > 500
    assert step[0] / step[15] < 5  # its iteration makes singular values one to a factor


def test_a_resumed_optimiser_takes_the_same_steps():
    whole = system()
    expected = trained(whole, muon().build(whole, max_steps=10)[0], range(4))

    model = system()
    first, _ = muon().build(model, max_steps=10)
    trained(model, first, range(2))
    second, _ = muon().build(model, max_steps=10)
    second.load_state_dict(first.state_dict())

    for one, other in zip(trained(model, second, range(2, 4)), expected, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)


def test_without_a_rate_for_matrices_adam_steps_all_weights():
    ours, theirs = system(), system()
    optimizer, _ = muon(muon_lr=None).build(ours, max_steps=10)
    adam, _ = WarmupCosineAdam(**SETTINGS).build(theirs, max_steps=10)

    for one, other in zip(trained(ours, optimizer, range(3)), trained(theirs, adam, range(3)), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)


def test_both_rates_follow_one_schedule():
    model = system()
    optimizer, schedule = muon(warmup_steps=2, final_share=0.1).build(model, max_steps=6)
    adam, of_adam = WarmupCosineAdam(**{**SETTINGS, "warmup_steps": 2, "final_share": 0.1}).build(model, max_steps=6)
    for _ in range(6):
        rates = {group["is_matrix"]: group["lr"] for group in optimizer.param_groups if group["name"] == "dynamics"}
        assert rates[False] == pytest.approx(adam.param_groups[0]["lr"])
        assert rates[True] == pytest.approx(10 * rates[False])
        give_gradients(model, 0)
        optimizer.step(), adam.step()
        schedule.step(), of_adam.step()


def test_a_closure_is_called_once():
    model = system()
    optimizer, _ = muon().build(model, max_steps=1)
    calls = []

    def closure() -> Tensor:
        calls.append(torch.is_grad_enabled())
        give_gradients(model, 0)
        return torch.tensor(0.5)

    assert optimizer.step(closure) == 0.5
    assert calls == [True]


@pytest.mark.parametrize("changes", [{"muon_lr": 0.0}, {"muon_momentum": 1.0}])
def test_numbers_out_of_range_are_refused(changes: dict[str, float]):
    with pytest.raises(ValueError, match="muon_lr must be above 0 or null and muon_momentum in"):
        muon(**changes)


@pytest.mark.parametrize("size", [0.0, 1e-30, 1e15])
def test_gradients_of_any_size_leave_finite_weights(size: float):
    """A matrix that no clip of a batch reaches has a gradient of zero, which has no direction."""
    model = system()
    optimizer, _ = muon().build(model, max_steps=10)
    before = [weight.detach().clone() for weight in model.parameters()]
    for weight in model.parameters():
        weight.grad = torch.full_like(weight, size)
    optimizer.step()

    for weight, was in zip(model.parameters(), before, strict=True):
        assert weight.isfinite().all()
        assert size > 0 or torch.equal(weight, was)
