"""How many CPU threads a command computes on."""

from vpd_lightning.errors import ConfigError


def set_threads(count: int | None) -> None:
    """Give PyTorch this many CPU threads; None leaves it alone."""
    import torch

    if count is None:
        return
    if count < 1:
        raise ConfigError(f"num_threads={count} is out of range.\nAllowed: 1 or more, or null.")
    torch.set_num_threads(count)
