"""Keeps ``last.ckpt`` (with the one before it) and ``best.ckpt`` of a run."""

import math
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
from lightning.pytorch.callbacks import Checkpoint

from vpd_lightning.free_memory import return_free_memory
from vpd_lightning.training.checkpoint_files import BEST, LAST
from vpd_lightning.training.checkpoints import FOLDER
from vpd_lightning.training.module import BEST_METRIC


class KeepCheckpoints(Checkpoint):
    """Writes ``checkpoints/last.ckpt`` every ``every_n_steps`` updates and at the end, ``best.ckpt`` after validations.

    Where a validation is due at the same step, ``last.ckpt`` is written after it: Lightning would not make up for a
    validation that was cut short. ``best`` means the highest validation PSNR.
    """

    def __init__(self, *, every_n_steps: int) -> None:
        super().__init__()
        if every_n_steps < 1:
            raise ValueError(f"every_n_steps must be at least 1, got {every_n_steps}")
        self.every_n_steps = every_n_steps
        self.best_score = -math.inf
        self.best_step = -1
        self._saved_step = -1

    def state_dict(self) -> dict[str, Any]:
        """Return plain numbers."""
        return {"best_score": self.best_score, "best_step": self.best_step}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on with the best score so far."""
        self.best_score, self.best_step = float(state_dict["best_score"]), int(state_dict["best_step"])

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save where it is time to."""
        if self._is_due(trainer) and not _validation_follows(trainer):
            self.save_last(trainer)

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Save the best, then a ``last.ckpt`` that waited for this validation."""
        if trainer.sanity_checking or trainer.state.fn != "fit":
            return
        score = float(trainer.callback_metrics.get(BEST_METRIC, math.nan))
        if score > self.best_score:
            self.best_score, self.best_step = score, trainer.global_step
            save_checkpoint(trainer, BEST)
        if self._is_due(trainer):
            self.save_last(trainer)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Save what a training that ends early (by time or another callback) has reached."""
        if self._saved_step != trainer.global_step and trainer.global_step > 0:
            self.save_last(trainer)

    def save_last(self, trainer: pl.Trainer) -> None:
        """Write ``last.ckpt`` now."""
        save_checkpoint(trainer, LAST)
        self._saved_step = trainer.global_step
        return_free_memory()  # here because it is as often as a training may pause

    def _is_due(self, trainer: pl.Trainer) -> bool:
        step = trainer.global_step
        return step != self._saved_step and (step % self.every_n_steps == 0 or step == trainer.max_steps)

    def on_fit_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Remember nothing of another fit."""
        self._saved_step = -1


def save_checkpoint(trainer: pl.Trainer, name: str) -> None:
    """Write all that a resume needs to ``trainer.default_root_dir/checkpoints/name``; to be called on every rank."""
    trainer.save_checkpoint(Path(trainer.default_root_dir) / FOLDER / name, weights_only=False)


def _validation_follows(trainer: pl.Trainer) -> bool:
    """Whether Lightning will validate right after this training step."""
    loop = trainer.fit_loop
    return loop.epoch_loop._should_check_val_fx(loop._data_fetcher)  # type: ignore[arg-type]
