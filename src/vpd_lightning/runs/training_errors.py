"""What can end a training, in words a person can act on."""

import errno
import logging
import signal
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from lightning.pytorch import Trainer

from vpd_lightning.errors import CheckpointError, ConfigError, LostProcessError, OutOfMemoryError
from vpd_lightning.free_memory import limited_to_available
from vpd_lightning.training.callbacks.memory_estimate import KNOBS

_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.ESTALE)

log = logging.getLogger(__name__)


@contextmanager
def named_memory_errors() -> Iterator[None]:
    """Say which knobs to turn where memory ran out: an allocation beyond what is free fails here."""
    try:
        with limited_to_available():
            yield
    except (MemoryError, RuntimeError) as error:
        text = str(error).lower()
        if isinstance(error, MemoryError | torch.OutOfMemoryError) or "out of memory" in text or "alloc_cpu" in text:
            raise OutOfMemoryError(f"memory ran out.\n{KNOBS}") from error
        raise


@contextmanager
def named_disk_errors(folder: Path) -> Iterator[None]:
    """Say that the run folder cannot be written any more: metrics, logs and pictures go there, too."""
    try:
        yield
    except OSError as error:
        names = [Path(str(name)) for name in (error.filename, error.filename2) if name is not None]
        # A file elsewhere (data, say) is another fault; what is already open for writing has no name here.
        is_ours = any(name.is_relative_to(folder) for name in names) if names else error.errno in _DISK_ERRORS
        if not is_ours:
            raise
        what = f"{names[0]} could not be written" if names else f"nothing more could be written in {folder}"
        raise CheckpointError(
            f"{what}: {error.strerror or error}.\n"
            "Checkpoints that are there are whole. Make room or permit writing, then go on with resume=last."
        ) from error


@contextmanager
def named_range_errors(trainer: Trainer) -> Iterator[None]:
    """Before the first step, a value that our code refuses is a fault of the configuration, not of the program."""
    try:
        yield
    except ValueError as error:
        frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
        is_ours = frames[-1].f_globals.get("__name__", "").startswith("vpd_lightning.")
        if trainer.global_step > 0 or not is_ours:
            raise
        raise ConfigError(f"the training cannot start.\n{error}") from error


@contextmanager
def named_lost_process(trainer: Trainer) -> Iterator[None]:
    """Say in plain words that another process is gone; what the transport said goes to the log."""
    try:
        yield
    except RuntimeError as error:
        lost = isinstance(error, torch.distributed.DistError) or "gloo" in str(error)
        if trainer.world_size == 1 or not lost:
            raise
        log.info("the transport between processes failed", exc_info=error)
        raise LostProcessError(
            f"another of the {trainer.world_size} processes of this training is gone (seen by rank"
            f" {trainer.global_rank} at step {trainer.global_step}).\n"
            "It was killed, or ran out of memory: its own output says why. Go on with resume=last."
        ) from error


@contextmanager
def plain_interrupt() -> Iterator[None]:
    """Turn Lightning's answer to Ctrl-C, an exit with code 1, back into the interrupt it was."""
    handler = signal.getsignal(signal.SIGINT)
    try:
        yield
    except SystemExit as stop:
        if stop.code == 1 and isinstance(stop.__context__, KeyboardInterrupt):
            signal.signal(signal.SIGINT, handler)
            raise KeyboardInterrupt from stop
        raise
