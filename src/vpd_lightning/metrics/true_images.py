"""The true images that predictions are compared with, and what is known of them already."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

from jaxtyping import Bool, Float
from torch import Tensor

T = TypeVar("T")


@dataclass(frozen=True)
class TrueImages:
    """True colours in [0, 1], which of their pixels move, and the last input frame.

    Images with fewer than ``min_moving_pixels`` moving ones have no values on moving pixels. A pixel has changed where
    its colour differs from the last input frame's by more than ``moving_threshold``. ``moving`` is None where
    nobody asks for it, ``last_input`` also where the cameras move.
    """

    colors: Float[Tensor, "step view height width 3"]
    moving: Bool[Tensor, "step view height width"] | None = None
    min_moving_pixels: int = 0
    last_input: Float[Tensor, "1 view height width 3"] | None = None
    moving_threshold: float = 0.0
    _known: dict[Callable[..., Any], Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def once(self, compute: Callable[[Tensor], T]) -> T:
        """Return ``compute(colors)``, computed once however many predictions are compared with these images."""
        if compute not in self._known:
            self._known[compute] = compute(self.colors)
        found: T = self._known[compute]
        return found
