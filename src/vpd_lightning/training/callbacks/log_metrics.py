"""Sends the numbers of each step to the loggers, before a checkpoint of that step is written."""

from typing import Any

import lightning.pytorch as pl

from vpd_lightning.training.metrics_csv import MetricsCSV
from vpd_lightning.training.module import VALIDATION, VPDModule
from vpd_lightning.types import VideoBatch, ViewBatch


class LogMetrics(pl.Callback):
    """Logs every ``trainer.log_every_n_steps`` updates, and after each validation; ``step`` counts the updates done.

    Lightning logs a step after its checkpoint was written, so that a crash between the two loses a row; and it counts
    steps from 0. Checkpoint callbacks always come after this one.
    """

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Remove rows of steps that will be done again."""
        for logger in trainer.loggers:
            if isinstance(logger, MetricsCSV):
                logger.rewind(trainer.global_step)

    def on_train_batch_end(
        self,
        trainer: pl.Trainer,
        pl_module: pl.LightningModule,
        outputs: Any,
        batch: VideoBatch | ViewBatch,
        batch_idx: int,
    ) -> None:
        """Log a training step."""
        assert isinstance(pl_module, VPDModule)
        step = trainer.global_step
        if step % trainer.log_every_n_steps == 0 or step == trainer.max_steps:
            _log(trainer, pl_module.train_metrics, step)

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Log a validation."""
        if not trainer.sanity_checking and trainer.state.fn == "fit":
            found = {k: v for k, v in trainer.callback_metrics.items() if k.startswith(VALIDATION)}
            _log(trainer, found, trainer.global_step)


def _log(trainer: pl.Trainer, metrics: dict[str, Any], step: int) -> None:
    plain = {name: float(value) for name, value in metrics.items()}
    for logger in trainer.loggers:
        logger.log_metrics(plain, step=step)
