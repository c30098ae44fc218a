"""All randomness comes from (seed, step, index of the sample in the global batch, purpose), none from global state.

This is what makes a resumed run bitwise equal to an uninterrupted one, and independent of loader workers and ranks.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch


def derive_seed(*parts: int | str) -> int:
    """Hash the parts to a 63-bit seed; the same parts give the same seed on every platform."""
    digest = hashlib.blake2b("/".join(str(part) for part in parts).encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1


def numpy_generator(*parts: int | str) -> np.random.Generator:
    """Return a NumPy generator that depends on the parts alone."""
    return np.random.default_rng(derive_seed(*parts))


@dataclass(frozen=True)
class RandomKeys:
    """Where the randomness of one batch comes from; ``sample_index`` counts within the global batch."""

    seed: int
    step: int
    sample_index: Sequence[int]

    @staticmethod
    def fixed(batch_size: int, seed: int = 0) -> "RandomKeys":
        """Keys for evaluation and for callers who do not care: the same draws every time, for every member."""
        return RandomKeys(seed=seed, step=0, sample_index=[0] * batch_size)

    def generators(self, purpose: str) -> list[torch.Generator]:
        """Return one fresh CPU generator per batch member; calling twice with one purpose repeats the draws."""
        return [
            torch.Generator().manual_seed(derive_seed(self.seed, self.step, index, purpose))
            for index in self.sample_index
        ]
