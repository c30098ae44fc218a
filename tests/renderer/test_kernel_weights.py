"""Shares of particles under kernels: against PyTorch's softmax, with gradients, and where nothing can be used."""

import torch

from vpd_lightning.renderer.kernel_weights import kernel_weights

SCALES = torch.tensor([0.1, 0.4, 1.0], dtype=torch.float64)


def inputs(dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Two members of four rays with six candidates in two layers; the first ray can use none, the second one."""
    generator = torch.Generator().manual_seed(0)
    usable = torch.rand(2, 4, 6, generator=generator) < 0.7
    usable[:, 0], usable[:, 1] = False, torch.arange(6) == 2
    memberships = -3 * torch.rand(2, 4, 2, 6, generator=generator, dtype=torch.float64)
    memberships = memberships.masked_fill(~usable[:, :, None], -1e30)
    square = torch.rand(2, 4, 6, generator=generator, dtype=torch.float64).square()
    return memberships.to(dtype).requires_grad_(), square.to(dtype).requires_grad_(), usable


def plain(
    memberships: torch.Tensor, square: torch.Tensor, usable: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    logits = memberships[:, :, :, None] - square[:, :, None, None] / (2 * SCALES.to(square)[:, None].square())
    some = usable.any(dim=-1)[:, :, None, None, None]
    return torch.softmax(logits, dim=-1) * some, logits.logsumexp(dim=-1, keepdim=True), some


def test_shares_and_totals_are_those_of_a_softmax() -> None:
    memberships, square, usable = inputs()
    weights, log_total = kernel_weights(memberships, square, usable, SCALES)
    expected, expected_total, some = plain(memberships, square, usable)
    torch.testing.assert_close(weights, expected, rtol=1e-12, atol=1e-25)
    torch.testing.assert_close((log_total * some), (expected_total * some), rtol=1e-12, atol=1e-12)
    assert (weights[:, 0] == 0).all() and (log_total[:, 0] < -1e29).all()


def test_gradients_are_those_of_finite_differences_and_of_autograd() -> None:
    memberships, square, usable = inputs()
    used = usable[:, :, None].expand_as(memberships)

    def outputs(free: torch.Tensor, square: torch.Tensor) -> tuple[torch.Tensor, ...]:
        whole = torch.full_like(memberships, -1e30).masked_scatter(used, free)
        weights, log_total = kernel_weights(whole, square, usable, SCALES)
        return weights, log_total[:, 1:]

    free = memberships.detach()[used].requires_grad_()
    assert torch.autograd.gradcheck(outputs, (free, square), atol=1e-7, rtol=1e-6)

    weights, log_total = kernel_weights(memberships, square, usable, SCALES)
    expected, expected_total, some = plain(memberships, square, usable)
    ramp = torch.linspace(-1, 1, weights.numel(), dtype=weights.dtype).view_as(weights)
    mine = torch.autograd.grad((weights * ramp).sum() + (log_total * some).sum(), (memberships, square))
    theirs = torch.autograd.grad((expected * ramp).sum() + (expected_total * some).sum(), (memberships, square))
    for one, other in zip(mine, theirs, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-12)


def test_float32_is_near_float64_and_far_candidates_are_no_subnormal_numbers() -> None:
    memberships, square, usable = inputs()
    exact, exact_total = kernel_weights(memberships, 1e3 * square, usable, SCALES)
    single = [tensor.detach().float() for tensor in (memberships, 1e3 * square)]
    weights, log_total = kernel_weights(*single, usable, SCALES.float())
    torch.testing.assert_close(weights.double(), exact, rtol=0, atol=1e-3)  # exponents are large here
    torch.testing.assert_close(log_total.double()[:, 1:], exact_total[:, 1:], rtol=1e-6, atol=0)
    assert not ((weights > 0) & (weights < torch.finfo(torch.float32).tiny)).any()
