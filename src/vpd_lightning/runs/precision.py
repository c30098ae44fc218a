"""``trainer.precision=auto``: bfloat16 where the hardware multiplies it, float32 elsewhere."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from vpd_lightning.errors import CheckpointError

AUTO = "auto"
FLOAT32, BFLOAT16 = "32-true", "bf16-mixed"
_CPU_INSTRUCTIONS = ("avx512_bf16", "amx_bf16", "bf16")  # the last one: ARM


def chosen_precision(trainer: Mapping[str, Any], recorded: Path | None) -> tuple[str, str]:
    """Return what ``auto`` means for a training, and why; a run that goes on keeps what it began with.

    Args:
        trainer: the section of the configuration.
        recorded: the configuration file of the run that goes on; None for a new one.

    Raises:
        CheckpointError: the file of the run cannot be read.
    """
    if recorded is not None:
        try:
            precision = yaml.safe_load(recorded.read_text(encoding="utf-8"))["trainer"]["precision"]
        except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError) as error:
            raise CheckpointError(
                f"cannot read trainer.precision from {recorded}, so the precision of the run is unknown.\n"
                f"Restore the file, or set trainer.precision={FLOAT32} or {BFLOAT16}."
            ) from error
        if precision != AUTO:
            return precision, "as the run began"
    device = _device(str(trainer.get("accelerator", "auto")))
    if device == "cuda":
        import torch

        is_native = torch.cuda.is_bf16_supported(including_emulation=False)
        return (BFLOAT16, "this GPU supports bfloat16") if is_native else (FLOAT32, "this GPU lacks bfloat16")
    if device == "cpu":
        found = bfloat16_instructions()
        if found:
            return BFLOAT16, f"this processor multiplies bfloat16: {found}"
        return FLOAT32, "this processor has no bfloat16 instructions"
    return FLOAT32, f"bfloat16 support of accelerator {device} is unknown"


def bfloat16_instructions() -> str:
    """Return which instructions of this processor multiply bfloat16, nothing where none do."""
    import torch

    read = getattr(torch.cpu, "get_capabilities", None)  # not in every PyTorch
    capabilities: dict[str, Any] = read() if read else {}
    return next((name for name in _CPU_INSTRUCTIONS if capabilities.get(name)), "")


def _device(accelerator: str) -> str:
    import torch

    if accelerator in ("gpu", "cuda", "auto") and torch.cuda.is_available():
        return "cuda"
    return "cpu" if accelerator == "auto" else accelerator
