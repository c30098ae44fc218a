"""Shapes are checked in the first calls that a test makes of each function, instead of in every call.

jaxtyping's import hook decorates every function and dataclass of ours; two fifths of the tests' processor seconds went
into its checks. What a test gives a function hardly changes after the first calls, so the checks of those find what the
others would. A function whose annotations name no array is left alone: mypy checks it. Imported before any module of
ours; ``conftest.py`` starts the count again for each test.
"""

import dataclasses
import functools
import typing
from types import FunctionType
from typing import Any

import jaxtyping

CALLS = 10
"""Checked calls of one function in one test."""

_check_every_call = jaxtyping.jaxtyped
_left: list[list[int]] = []


def start_again() -> None:
    """Check the next ``CALLS`` calls of each function."""
    for left in _left:
        left[0] = CALLS


def names_arrays(annotation: Any) -> bool:
    """Return whether an annotation holds a shape; one that is still text may."""
    if isinstance(annotation, str):
        return True
    if isinstance(annotation, type) and issubclass(annotation, jaxtyping.AbstractArray):
        return True
    return any(map(names_arrays, typing.get_args(annotation)))


def _checked(decorated: Any, typechecker: Any) -> Any:
    if isinstance(decorated, type):
        if dataclasses.is_dataclass(decorated) and "__init__" in vars(decorated):
            decorated.__init__ = _checked(decorated.__init__, typechecker)  # type: ignore[misc]
        return decorated
    if not isinstance(decorated, FunctionType):
        return _check_every_call(decorated, typechecker=typechecker)
    if not any(map(names_arrays, decorated.__annotations__.values())):
        return decorated
    checked = _check_every_call(decorated, typechecker=typechecker)
    left = [CALLS]
    _left.append(left)

    @functools.wraps(decorated)
    def in_first_calls(*args: Any, **kwargs: Any) -> Any:
        if not left[0]:
            return decorated(*args, **kwargs)
        left[0] -= 1
        return checked(*args, **kwargs)

    return in_first_calls


def install() -> None:
    """Let the import hook, which looks its decorator up under this name, check as said above."""
    jaxtyping.jaxtyped = lambda *, typechecker: functools.partial(_checked, typechecker=typechecker)  # type: ignore
