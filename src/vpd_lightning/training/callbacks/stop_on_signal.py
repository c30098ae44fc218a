"""Ctrl-C, SIGTERM, SIGUSR1: finish the step, save, leave with the exit code that shells expect (130, 143, 138)."""

import os
import signal
import subprocess
import threading
from types import FrameType
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.callbacks import Checkpoint

from vpd_lightning.training.callbacks.keep_checkpoints import save_checkpoint
from vpd_lightning.training.checkpoint_files import LAST

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)


class StopOnSignal(Checkpoint):
    """At the first signal the training saves ``last.ckpt`` after the step at hand and raises SystemExit(128 + signal).

    A validation at hand is finished first, so that its row in ``metrics.csv`` is not lost; the weights are saved at
    once. The second signal ends the process without further ado; the checkpoint before it stays whole.

    SIGUSR1 is what a cluster sends shortly before a job's time is up (``sbatch --signal=USR1@60``). In a SLURM job it
    also puts the job back into the queue, where ``resume=auto`` goes on.

    A kind of ``Checkpoint`` because Lightning calls those after all others, in the order of the configuration.
    """

    def __init__(self) -> None:
        super().__init__()
        self._received = 0
        self._is_saved = False
        self._before: dict[int, Any] = {}

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Take over from Lightning, whose handlers end with other exit codes and checkpoints."""
        self._received, self._is_saved = 0, False
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._handle) for number in _SIGNALS}

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._received:
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
        self._received = number

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Stop here if asked to; all devices stop together."""
        if self._is_asked(trainer):
            self._save_and_stop(trainer)

    def on_validation_batch_end(self, trainer: pl.Trainer, *args: Any, **kwargs: Any) -> None:
        """Save here, once, if asked to stop."""
        if _is_training(trainer) and not self._is_saved and self._is_asked(trainer):
            save_checkpoint(trainer, LAST)
            self._is_saved = True

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Stop here if asked to."""
        if _is_training(trainer) and self._is_asked(trainer):
            self._save_and_stop(trainer)

    def _is_asked(self, trainer: pl.Trainer) -> bool:
        if trainer.world_size == 1:
            return bool(self._received)
        return trainer.strategy.reduce_boolean_decision(bool(self._received), all=False)

    def _save_and_stop(self, trainer: pl.Trainer) -> None:
        save_checkpoint(trainer, LAST)
        received = torch.tensor(self._received, device=trainer.strategy.root_device)
        number = int(trainer.strategy.reduce(received, reduce_op="max"))  # not every rank received it
        if trainer.is_global_zero:
            name = signal.Signals(number).name
            is_queued = number == signal.SIGUSR1 and _requeue()
            onward = "The job is back in the queue." if is_queued else "Go on with resume=last."
            print(f"Stopped by {name} after step {trainer.global_step}; last.ckpt is saved. {onward}", flush=True)
        raise SystemExit(128 + number)

    def teardown(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Give the signals back."""
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}


def _is_training(trainer: pl.Trainer) -> bool:
    return trainer.state.fn == "fit" and not trainer.sanity_checking


def _requeue() -> bool:
    """Put the SLURM job that this process belongs to back into the queue; False where there is none, or it fails."""
    job = os.environ.get("SLURM_ARRAY_JOB_ID", os.environ.get("SLURM_JOB_ID"))
    if job is None:
        return False
    if task := os.environ.get("SLURM_ARRAY_TASK_ID"):
        job = f"{job}_{task}"
    try:
        done = subprocess.run(["scontrol", "requeue", job], capture_output=True, text=True, timeout=20, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        print(f"SLURM job {job} could not be put back into the queue: {error}", flush=True)
        return False
    if done.returncode:
        print(f"SLURM job {job} could not be put back into the queue: {done.stderr.strip()}", flush=True)
    return done.returncode == 0
