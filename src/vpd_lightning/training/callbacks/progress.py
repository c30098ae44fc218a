"""What a person sees while a model trains: a live line on a terminal, plain lines elsewhere."""

import sys
from io import TextIOBase
from typing import Any

import lightning.pytorch as pl

from vpd_lightning.metrics.registry import HEADLINE, metric
from vpd_lightning.training.module import BEST_METRIC, VPDModule
from vpd_lightning.types import VideoBatch, ViewBatch


class Progress(pl.Callback):
    """Step, it/s, rays/s, time left, loss and PSNR; on a terminal through Rich, else one line every ``every_n_steps``.

    Nothing but plain text reaches a pipe or a file: no colours, no cursor movements.
    """

    def __init__(self, *, every_n_steps: int, stream: TextIOBase | None = None) -> None:
        super().__init__()
        if every_n_steps < 1:
            raise ValueError(f"every_n_steps must be at least 1, got {every_n_steps}")
        self.every_n_steps = every_n_steps
        self.stream = stream or sys.stdout
        self._bar: Any = None
        self._task: Any = None
        self._is_active = True

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Open the bar on a terminal."""
        self._is_active = trainer.is_global_zero
        if self._is_active and self.stream.isatty():
            self._open_bar(trainer)

    def _open_bar(self, trainer: pl.Trainer) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn

        self._bar = Progress(
            TextColumn("training"),
            BarColumn(),
            TextColumn("{task.fields[line]}"),
            console=Console(file=self.stream),  # type: ignore[arg-type]
        )
        self._bar.start()
        self._task = self._bar.add_task("training", total=trainer.max_steps, completed=trainer.global_step, line="")

    def on_train_batch_end(
        self,
        trainer: pl.Trainer,
        pl_module: pl.LightningModule,
        outputs: Any,
        batch: VideoBatch | ViewBatch,
        batch_idx: int,
    ) -> None:
        """Show the step where it is time to."""
        assert isinstance(pl_module, VPDModule)
        step = trainer.global_step
        if not self._is_active:
            return
        if self._bar is not None:
            # Values are fetched from the device at a readable pace only; each fetch waits for it.
            is_shown = step % min(10, self.every_n_steps) == 0 or step == trainer.max_steps
            fields = {"line": self._line(trainer, pl_module)} if is_shown else {}
            self._bar.update(self._task, completed=step, total=_total(trainer, pl_module), **fields)
        elif step % self.every_n_steps == 0 or step == trainer.max_steps:
            self._print(self._line(trainer, pl_module))

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Say where a time budget ended the training."""
        assert isinstance(pl_module, VPDModule)
        if self._is_active and pl_module.expected_steps is not None and trainer.global_step < trainer.max_steps:
            self._print(f"the time is up: {self._line(trainer, pl_module)}")

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Show the validation's PSNR."""
        score = trainer.callback_metrics.get(BEST_METRIC)
        if self._is_active and score is not None and trainer.state.fn == "fit" and not trainer.sanity_checking:
            self._print(f"validation after step {trainer.global_step}: {metric(HEADLINE).spoken(float(score))}")

    def _line(self, trainer: pl.Trainer, module: VPDModule) -> str:
        step, metrics = trainer.global_step, module.train_metrics
        # Where a time budget ends the training, the number of steps is an estimate.
        is_estimate = module.expected_steps is not None
        total = _total(trainer, module)
        parts = [f"step {step}/{'about ' if is_estimate else ''}{total}"]
        seconds = module.seconds_per_step
        if seconds is not None:
            parts += [f"{1.0 / seconds:.2f} it/s"]
            if "rays_per_second" in metrics:
                parts += [f"{float(metrics['rays_per_second']):,.0f} rays/s"]
            parts += [f"ETA {clock(seconds * (total - step))}"]
        parts += [f"{name} {float(metrics['loss']):.5f}" for name in ("loss",) if name in metrics]
        info = metric(HEADLINE)
        parts += [f"{info.title} {info.shown(float(metrics[name]))}" for name in (HEADLINE,) if name in metrics]
        return "  ".join(parts)

    def _print(self, line: str) -> None:
        if self._bar is not None:
            self._bar.console.print(line, highlight=False)
        else:
            print(line, file=self.stream, flush=True)

    def teardown(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Close the bar, after errors too."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None


def _total(trainer: pl.Trainer, module: VPDModule) -> int:
    return module.expected_steps() if module.expected_steps is not None else trainer.max_steps


def clock(seconds: float) -> str:
    """Return hours:minutes:seconds."""
    whole = max(0, round(seconds))
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"
