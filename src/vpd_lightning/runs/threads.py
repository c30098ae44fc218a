"""How many CPU threads a command computes on."""

from vpd_lightning.errors import ConfigError


def set_threads(count: int | None, num_free: int = 0) -> None:
    """Give PyTorch this many CPU threads; None leaves it alone, but for ``num_free`` cores that others need."""
    import torch

    if count is None:
        if num_free:
            torch.set_num_threads(max(1, torch.get_num_threads() - num_free))
        return
    if count < 1:
        raise ConfigError(f"num_threads={count} is out of range.\nAllowed: 1 or more, or null.")
    torch.set_num_threads(count)
