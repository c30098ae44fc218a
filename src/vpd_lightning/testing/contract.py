"""What all contracts share: how a component is built and compared, and how a departure from a check is declared."""

import functools
import random
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn


class Contract:
    """Base of the contracts: subclass one of them in a pytest module and define ``build``.

    ``departures`` maps the name of a check marked ``may_depart`` to the reason why the component does not satisfy it.
    The check still runs. It is reported as an expected failure with the reason, and as a failure where it passes: a
    departure that is none must not be declared.

    ``tolerance`` is absolute and meant for float64: rounding, amplified by steep functions such as annealed matches.
    """

    departures: Mapping[str, str] = {}
    tolerance: float = 1e-6
    device: str = "cpu"

    def build(self) -> Any:
        """Return a new component at a small size; may be called many times, with other random weights each time."""
        raise NotImplementedError(f"{type(self).__name__} must define build(self) and return the component to test")

    def built(self, dtype: torch.dtype = torch.float64) -> Any:
        """Return a component in evaluation mode in the given precision.

        Layers that start at zero hide what lies behind them, so a little noise is added to all weights.
        """
        with torch.random.fork_rng():
            torch.manual_seed(0)
            component = self.build().to(self.device, dtype)
            with torch.no_grad():
                for parameter in component.parameters():
                    parameter.add_(0.05 * torch.randn_like(parameter))
        return component.eval()

    def test_departures_are_declared_by_name(self) -> None:
        names = {name for name in dir(self) if getattr(getattr(self, name), "may_depart", False)}
        unknown = set(self.departures) - names
        assert not unknown, f"departures names {sorted(unknown)}; possible are {sorted(names)}"


def may_depart(check: Callable[..., None]) -> Callable[..., None]:
    """Mark a check from which a component may depart for a declared reason; see ``Contract``."""

    @functools.wraps(check)
    def run(self: Contract) -> None:
        reason = self.departures.get(check.__name__)
        if reason is None:
            return check(self)
        try:
            check(self)
        except AssertionError:
            import pytest

            pytest.xfail(reason)
        raise AssertionError(f"declared as a departure ({reason}), but the check passes; remove it from departures")

    run.may_depart = True  # type: ignore[attr-defined]
    return run


def tensors_of(value: Any, name: str = "") -> Iterator[tuple[str, Tensor]]:
    """Yield all tensors inside dataclasses, mappings, lists and tuples, with their names."""
    if isinstance(value, Tensor):
        yield name, value
    elif is_dataclass(value) and not isinstance(value, type):
        for item in fields(value):
            yield from tensors_of(getattr(value, item.name), f"{name}.{item.name}")
    elif isinstance(value, Mapping):
        for key, entry in value.items():
            yield from tensors_of(entry, f"{name}.{key}")
    elif isinstance(value, list | tuple):
        for index, entry in enumerate(value):
            yield from tensors_of(entry, f"{name}[{index}]")


def assert_same(actual: Any, expected: Any, tolerance: float = 0.0) -> None:
    """Compare all tensors of two results.

    Raises:
        AssertionError: naming the tensor and the largest difference.
    """
    first, second = dict(tensors_of(actual)), dict(tensors_of(expected))
    assert set(first) == set(second), f"one result has {sorted(first)}, the other {sorted(second)}"
    for name, value in first.items():
        torch.testing.assert_close(
            value, second[name], rtol=0.0, atol=tolerance, equal_nan=True, msg=lambda text, name=name: f"{name}: {text}"
        )


@contextmanager
def describe_case(what: str) -> Iterator[None]:
    """Name the case in which a check fails.

    Raises:
        AssertionError: of the check, with the case before its text.
    """
    try:
        yield
    except AssertionError as error:
        raise AssertionError(f"{what}: {error}") from error


def assert_finite(value: Any, what: str) -> None:
    """Check all floating tensors of a result.

    Raises:
        AssertionError: naming the tensor that holds NaN or infinity.
    """
    for name, tensor in tensors_of(value):
        assert not tensor.is_floating_point() or bool(torch.isfinite(tensor).all()), f"{what}{name} is not finite"


def assert_precision(value: Any, dtype: torch.dtype) -> None:
    """Check that all floating tensors have one precision.

    Raises:
        AssertionError: naming the tensor that does not.
    """
    for name, tensor in tensors_of(value):
        assert not tensor.is_floating_point() or tensor.dtype == dtype, f"{name} is {tensor.dtype}, wanted {dtype}"


def assert_gradients(module: nn.Module) -> None:
    """Check that every weight that learns was reached by a finite gradient.

    Raises:
        AssertionError: naming the parameters that were not.
    """
    learning = {name: p.grad for name, p in module.named_parameters() if p.requires_grad}
    missed = [name for name, gradient in learning.items() if gradient is None or not gradient.any()]
    assert not missed, f"no gradient reaches {missed}"
    infinite = [name for name, gradient in learning.items() if not bool(torch.isfinite(gradient).all())]
    assert not infinite, f"the gradients of {infinite} are not finite"


def summed(value: Any) -> Tensor:
    """Return one number that depends on every floating tensor of a result, unevenly."""
    total: Tensor | None = None
    for _, tensor in tensors_of(value):
        if tensor.is_floating_point():
            weights = torch.linspace(0.5, 1.5, max(tensor.numel(), 1), dtype=tensor.dtype, device=tensor.device)
            part = (tensor.flatten() * weights[: tensor.numel()]).sum()
            total = part if total is None else total + part
    assert total is not None, "the result holds no floating tensor"
    return total


@contextmanager
def global_randomness_untouched() -> Iterator[None]:
    """Check that nothing draws from (or seeds) the global generators of PyTorch and NumPy.

    Python's own is not looked at: checkers of types and shapes sample with it. Results may not depend on it either.

    Raises:
        AssertionError: naming the library.
    """
    before = (torch.get_rng_state(), np.random.get_state())
    cuda = torch.cuda.get_rng_state_all() if torch.cuda.is_available() else []
    yield
    fault = "changes global random state; draw from keys.generators(purpose) instead"
    assert torch.equal(before[0], torch.get_rng_state()), f"the component {fault} (torch)"
    after = torch.cuda.get_rng_state_all() if torch.cuda.is_available() else []
    assert all(torch.equal(a, b) for a, b in zip(cuda, after, strict=True)), f"the component {fault} (torch.cuda)"
    now = np.random.get_state()
    same = all(np.array_equal(a, b) for a, b in zip(before[1], now, strict=True))  # type: ignore[arg-type]
    assert same, f"the component {fault} (numpy)"


def disturb_global_randomness() -> None:
    """Draw from every global generator, so that a second run that depends on one of them differs from the first."""
    torch.rand(1)
    np.random.random()
    random.random()


@contextmanager
def unchanged(*values: Any) -> Iterator[None]:
    """Check that no tensor of the values is changed in place.

    Raises:
        AssertionError: naming the tensor.
    """
    before = [(name, tensor, tensor.detach().clone()) for name, tensor in tensors_of(values)]
    yield
    for name, tensor, copy in before:
        now = tensor.detach()
        if copy.is_floating_point():  # NaN (missing depth) does not equal itself
            now, copy = now.nan_to_num(), copy.nan_to_num()
        assert torch.equal(now, copy), f"input{name} was changed in place"
