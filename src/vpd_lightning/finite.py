"""Refuses NaN and infinity where they come in, by name."""

import torch
from torch import Tensor

from vpd_lightning.errors import NonFiniteError


def require_finite(where: str, **inputs: Tensor) -> None:
    """Refuse NaN and infinity by the name of the input.

    That waits for the device, so it is left out where a compiler or a CUDA graph records; NaN then comes out as NaN.

    Raises:
        NonFiniteError: naming every input that is not finite.
    """
    if is_traced():
        return
    finite = torch.stack([torch.isfinite(tensor).all() for tensor in inputs.values()])
    if bool(finite.all()):
        return
    bad = [name for name, is_finite in zip(inputs, finite.tolist(), strict=True) if not is_finite]
    raise NonFiniteError(
        f"{where}: NaN or infinity in {' and '.join(bad)}.\n"
        "The model diverged or the data are damaged: lower the learning rate, or check with vpd-data validate."
    )


def is_traced() -> bool:
    """Whether what runs is being recorded, so that no number may be looked at."""
    return torch.compiler.is_compiling() or (torch.cuda.is_available() and torch.cuda.is_current_stream_capturing())
