"""The state of a training as a few small files: weights, what Adam remembers, the curve.

Weights travel with 15 bits of mantissa (three bytes each; rounded by 2^-16 of their size at most), Adam's second moment
with one byte each (its root to 2 %). The first moment is not kept: it forgets in ten updates, and starts again at zero.
"""

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vpd_lightning.errors import CheckpointError

SHARD_BYTES = 15 * 2**20  # below the 16 MiB that one file may have
MAX_SHARDS = 8
_OCTAVES, _CODES_PER_OCTAVE = 31.75, 8  # codes 1 to 255 span them, below the largest value; 0 is zero


@dataclass
class Progress:
    """Where a training stands: the ``phase`` and how far in it, weights, their average, Adam's memory, the curve."""

    phase: int = 0
    step: int = 0
    seconds: float = 0.0
    weights: dict[str, Tensor] = field(default_factory=dict)
    second_moments: dict[str, Tensor] = field(default_factory=dict)
    curve: list[dict[str, float]] = field(default_factory=list)
    phase_seconds: float = 0.0
    average: dict[str, Tensor] = field(default_factory=dict)
    seed: int | None = None  # where it is not the pack's


def beginning_with(other: Progress, phase: int, seed: int | None) -> Progress:
    """Return the beginning of a phase with another training's weights: their average, where it kept one."""
    return Progress(phase=phase, weights={**other.weights, **other.average}, seed=seed)


def write_progress(folder: Path, progress: Progress) -> list[Path]:
    """Write ``state_<i>_of_<n>.bin`` and ``curve.json`` in the place of an earlier state's; return their paths.

    Raises:
        CheckpointError: the state does not fit into eight files.
    """
    buffer = io.BytesIO()
    torch.save(
        {
            "phase": progress.phase,
            "step": progress.step,
            "seconds": progress.seconds,
            "phase_seconds": progress.phase_seconds,
            "seed": progress.seed,
            "weights": {name: _three_bytes(value) for name, value in progress.weights.items()},
            "average": {name: _three_bytes(value) for name, value in progress.average.items()},
            "second_moments": {name: _one_byte(value) for name, value in progress.second_moments.items()},
            "curve": json.dumps(progress.curve),
        },
        buffer,
    )
    content = buffer.getvalue()
    count = -(-len(content) // SHARD_BYTES)
    if count > MAX_SHARDS - 1:
        raise CheckpointError(
            f"The state has {len(content):,} bytes.\nAt most {MAX_SHARDS - 1} files of 15 MiB return."
        )
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for number in range(count):
        path = folder / f"state_{number}_of_{count}.bin"
        partial = path.with_suffix(".partial")
        partial.write_bytes(content[number * SHARD_BYTES : (number + 1) * SHARD_BYTES])
        written.append((partial, path))
    for old in folder.glob("state_*_of_*.bin"):
        old.unlink()
    for partial, path in written:
        partial.replace(path)
    curve = folder / "curve.json"
    curve.write_text(json.dumps(progress.curve, indent=0) + "\n")
    return [*(path for _, path in written), curve]


def read_progress(folder: Path) -> Progress:
    """Read what ``write_progress`` wrote.

    Raises:
        CheckpointError: the folder holds no state, or not all of its files.
    """
    shards = sorted(folder.glob("state_*_of_*.bin"))
    if not shards:
        raise CheckpointError(f"{folder} holds no state (state_*_of_*.bin).\nLeave --resume away to begin anew.")
    count = int(shards[0].stem.rpartition("_")[2])
    if [path.name for path in shards] != [f"state_{number}_of_{count}.bin" for number in range(count)]:
        raise CheckpointError(f"{folder} holds {len(shards)} of {count} files of a state.\nBring all of them.")
    try:
        content = torch.load(io.BytesIO(b"".join(path.read_bytes() for path in shards)), weights_only=True)
    except Exception as error:  # whatever a cut file makes of the unpickler
        raise CheckpointError(f"The state in {folder} is damaged: {error}\nBring its files once more.") from error
    return Progress(
        phase=content["phase"],
        step=content["step"],
        seconds=content["seconds"],
        weights={name: _from_three_bytes(*value) for name, value in content["weights"].items()},
        second_moments={name: _from_one_byte(*value) for name, value in content["second_moments"].items()},
        curve=json.loads(content["curve"]),
        # Not in states of earlier versions.
        phase_seconds=content.get("phase_seconds", 0.0),
        seed=content.get("seed"),
        average={name: _from_three_bytes(*value) for name, value in content.get("average", {}).items()},
    )


def adam_second_moments(optimizer: torch.optim.Optimizer, names: Mapping[Tensor, str]) -> dict[str, Tensor]:
    """Return Adam's second moments by the names of their weights."""
    return {names[weight]: state["exp_avg_sq"] for weight, state in optimizer.state.items() if "exp_avg_sq" in state}


def restore_adam(
    optimizer: torch.optim.Optimizer, named: Mapping[str, Tensor], moments: Mapping[str, Tensor], step: int
) -> None:
    """Let Adam go on after ``step`` updates with the second moments that were kept."""
    for name, value in moments.items():
        weight = named[name]
        state: dict[str, Any] = {
            "step": torch.tensor(float(step), device=weight.device),
            "exp_avg": torch.zeros_like(weight),
            "exp_avg_sq": value.to(weight),
        }
        optimizer.state[weight] = state


def _three_bytes(value: Tensor) -> tuple[Tensor, list[int]]:
    """Round float32 to 15 bits of mantissa and drop the last byte; values must be finite."""
    bits = value.detach().to("cpu", torch.float32).contiguous().view(-1).numpy().view(np.uint32)
    rounded = (bits.astype(np.uint64) + 0x80).astype(np.uint32)
    octets = np.ascontiguousarray(rounded.astype("<u4").view(np.uint8).reshape(-1, 4)[:, 1:])
    return torch.from_numpy(octets), list(value.shape)


def _from_three_bytes(octets: Tensor, shape: list[int]) -> Tensor:
    whole = np.zeros((len(octets), 4), np.uint8)
    whole[:, 1:] = octets.numpy()
    return torch.from_numpy(whole.reshape(-1).view("<u4").astype(np.uint32).view(np.float32).copy()).view(shape)


def _one_byte(value: Tensor) -> tuple[Tensor, float]:
    """Store the logarithm of values >= 0 relative to the largest one."""
    value = value.detach().to("cpu", torch.float32)
    largest = float(value.max()) if value.numel() else 0.0
    if largest <= 0:
        return torch.zeros(value.shape, dtype=torch.uint8), 0.0
    octaves = torch.log2(value / largest) + _OCTAVES
    codes = (1 + (octaves * _CODES_PER_OCTAVE).round()).clamp(0, 255)
    return torch.where(value > 0, codes, 0.0).to(torch.uint8), largest


def _from_one_byte(codes: Tensor, largest: float) -> Tensor:
    octaves = (codes.float() - 1) / _CODES_PER_OCTAVE - _OCTAVES
    return torch.where(codes > 0, largest * torch.exp2(octaves), 0.0)
