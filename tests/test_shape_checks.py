"""The checks of shapes find a wrong one in the first calls of each test, and leave the later calls alone."""

from dataclasses import dataclass
from typing import Any

import beartype
import jaxtyping
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from tests import shape_checks
from vpd_lightning.types import Particles

checked = jaxtyping.jaxtyped(typechecker=beartype.beartype)


@checked
def dot(left: Float[Tensor, "batch n"], right: Float[Tensor, "batch n"]) -> Float[Tensor, "batch n"]:
    return left * right


@checked
def halved(values: Float[Tensor, "n 2"]) -> Float[Tensor, " n"]:
    return values.mean()


@checked
def optional(values: list[Float[Tensor, "n 2"]] | None) -> int:
    return 0 if values is None else len(values)


@checked
@dataclass
class Pair:
    left: Float[Tensor, " n"]
    right: Float[Tensor, " n"]


@pytest.mark.parametrize("case", ["first", "second"])
def test_each_test_starts_with_checked_calls(case: str) -> None:
    for _ in range(shape_checks.CALLS - 1):
        dot(torch.ones(2, 3), torch.ones(2, 3))
    with pytest.raises(jaxtyping.TypeCheckError, match="right"):
        dot(torch.ones(2, 3), torch.ones(2, 1))
    assert dot(torch.ones(2, 3), torch.ones(2, 1)).shape == (2, 3)  # would be refused in a checked call
    shape_checks.start_again()
    with pytest.raises(jaxtyping.TypeCheckError, match="right"):
        dot(torch.ones(2, 3), torch.ones(2, 1))


@pytest.mark.parametrize(
    "call",
    [
        lambda: halved(torch.ones(4, 2)),  # what it returns
        lambda: optional([torch.ones(4, 3)]),  # within other types
        lambda: Pair(torch.ones(2), torch.ones(3)),  # one field against another
    ],
)
def test_a_wrong_shape_is_refused(call: Any) -> None:
    with pytest.raises(jaxtyping.TypeCheckError):
        call()


def test_our_own_code_is_checked() -> None:
    with pytest.raises(jaxtyping.TypeCheckError):
        Particles(torch.ones(2, 5, 3), torch.ones(2, 4, 8))


def test_a_function_without_arrays_is_left_alone() -> None:
    def total(values: list[int], scale: float = 1.0) -> float:
        return scale * sum(values)

    assert checked(total) is total
