"""Dropout that draws from the keys of a batch: PyTorch's own layers draw from the global generator only."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from vpd_lightning.randomness import RandomKeys, derive_seed


@contextmanager
def seeded_dropout(keys: RandomKeys, purpose: str, device: torch.device, enabled: bool) -> Iterator[None]:
    """Seed the global generators (CPU and ``device``) from the keys, and put their states back afterwards.

    All members of a batch share one stream, so that the draws depend on how a global batch is divided over ranks.
    """
    if not enabled:
        yield
        return
    seed = derive_seed(keys.seed, keys.step, *keys.sample_index, purpose)
    if device.type == "cpu":
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(seed)
            yield
        return
    accelerator = torch.get_device_module(device.type)
    index = accelerator.current_device() if device.index is None else device.index
    with torch.random.fork_rng(devices=[index], device_type=device.type):
        # Not torch.manual_seed: it would seed devices whose state nobody restores.
        torch.default_generator.manual_seed(seed)
        accelerator.manual_seed(seed)
        yield
