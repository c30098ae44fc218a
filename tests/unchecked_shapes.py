"""Long loops without the checks of shapes that every call is wrapped in under pytest."""

from collections.abc import Iterator
from contextlib import contextmanager

from jaxtyping import config


@contextmanager
def unchecked_shapes() -> Iterator[None]:
    """Leave shapes unchecked: for the later steps of a long loop whose first ones are checked, in half the time."""
    before = config.jaxtyping_disable
    config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        config.update("jaxtyping_disable", before)
