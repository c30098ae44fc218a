"""Ends a training after a given time, so that systems of different cost can be compared fairly."""

import json
import time
from pathlib import Path
from typing import Any, Literal

import lightning.pytorch as pl

from vpd_lightning.data.rollout_lengths import RolloutLengths
from vpd_lightning.errors import ConfigError
from vpd_lightning.files import AtomicPath
from vpd_lightning.training.callbacks.pace import Pace
from vpd_lightning.training.module import VPDModule

FILE = "training_time.json"
_FIRST_GUESS = 10  # updates before the measured pace says how many there will be
_WARM_UP = 3  # updates after a start that compile and fill caches: they count, but are left out of the pace


class TimeBudget(pl.Callback):
    """Stops after ``minutes`` of training steps; null trains for ``trainer.max_steps`` and only measures the time.

    ``clock`` is ``wall``, or ``cpu``: the processor time of this process, which other work on the same machine hardly
    changes; it does not depend on loader workers or accelerators. With several devices, the first one's time counts.
    Reading data counts; validations, pictures and checkpoints do not. The learning rate's schedule follows the time:
    the updates that the budget will allow are estimated from the pace so far, and from what longer rollouts will take
    (``Pace``). Such a training does not repeat bit for bit. The time used is written to ``training_time.json`` in the
    run folder, and ``seconds_before`` (of a first training and what it prepared) counts.
    """

    def __init__(self, *, minutes: float | None, clock: Literal["wall", "cpu"]) -> None:
        super().__init__()
        if minutes is not None and minutes <= 0:
            raise ValueError(f"minutes must be above 0, or null, got {minutes}")
        self.minutes, self.clock = minutes, clock
        self.seconds_before = 0.0
        self.seconds = 0.0
        self._steps = 0
        self._pace = Pace()
        self._lengths: RolloutLengths | None = None  # where they change in the course of the training
        self._since_start = 0
        self._started: float | None = None

    def now(self) -> float:
        """Read the clock (seconds)."""
        return time.process_time() if self.clock == "cpu" else time.monotonic()

    @property
    def seconds_allowed(self) -> float | None:
        """What this training may use; None without a limit."""
        return None if self.minutes is None else max(60.0 * self.minutes - self.seconds_before, 1e-3)

    def expected_steps(self, max_steps: int) -> int:
        """How many updates the budget will allow, as far as is known; at most ``max_steps``."""
        allowed = self.seconds_allowed
        if allowed is None or self._steps < _FIRST_GUESS or not self._pace.is_known:
            return max_steps
        share = min(1.0, self.seconds / allowed)
        ahead = [(1.0 - share, list[int]())] if self._lengths is None else self._lengths.ahead(share)
        further = sum(part * allowed / self._pace.seconds_per_step(lengths) for part, lengths in ahead)
        return max(1, min(max_steps, self._steps + round(further)))

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Tell the module's schedule how long the training will be.

        Raises:
            ConfigError: the rollout length is to change in the course of the training, and other processes read the
                data; or the clock does not see the work.
        """
        if self.minutes is not None and self.clock == "cpu":
            self._require_work_on_the_clock(trainer)
        if self.minutes is not None and getattr(getattr(trainer, "datamodule", None), "num_steps_schedule", None):
            self._lengthen_clips_by_time(trainer)
        if self.minutes is not None and isinstance(pl_module, VPDModule):
            pl_module.expected_steps = lambda: self.expected_steps(trainer.max_steps)

    def _lengthen_clips_by_time(self, trainer: pl.Trainer) -> None:
        """Give the data the share of the time that is used: how many updates there will be is not known."""
        datamodule: Any = trainer.datamodule  # type: ignore[attr-defined]
        if datamodule.num_workers:
            raise ConfigError(
                "data.num_steps_schedule follows the time that callbacks.time_budget.minutes allows, which the"
                f" {datamodule.num_workers} processes that read data cannot see.\n"
                "Set data.num_workers=0, or data.num_steps_schedule=null."
            )
        self._lengths = RolloutLengths(datamodule.num_steps, datamodule.num_steps_schedule)
        datamodule.training_progress = lambda: min(1.0, self.seconds / (self.seconds_allowed or 1.0))

    @staticmethod
    def _require_work_on_the_clock(trainer: pl.Trainer) -> None:
        device = trainer.strategy.root_device.type
        if device != "cpu":
            raise ConfigError(
                f"callbacks.time_budget.clock=cpu measures the processor, but this training runs on {device}.\n"
                "Set callbacks.time_budget.clock=wall, or trainer=cpu."
            )
        workers = getattr(getattr(trainer, "datamodule", None), "num_workers", 0)
        if workers:
            raise ConfigError(
                f"callbacks.time_budget.clock=cpu does not see the {workers} processes that read data.\n"
                "Set data.num_workers=0, or callbacks.time_budget.clock=wall."
            )

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Start the clock; a training that goes on where its time was up already makes no further step."""
        self._started, self._since_start = self.now(), 0
        self._stop_where_time_is_up(trainer)

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Count the step and what it took, its data included; stop where the time is up."""
        now = self.now()
        spent = now - (now if self._started is None else self._started)
        self.seconds += spent
        self._started = now
        self._steps = trainer.global_step
        self._since_start += 1
        if self._since_start > _WARM_UP:
            self._pace.count(0 if self._lengths is None else batch.rgbs.shape[1], spent)
        self._stop_where_time_is_up(trainer)

    def _stop_where_time_is_up(self, trainer: pl.Trainer) -> None:
        if trainer.world_size > 1:  # all devices stop at the same step, and have the same learning rates up to there
            mine = (self.seconds, self.seconds_before, self._pace.counted)
            self.seconds, self.seconds_before, counted = trainer.strategy.broadcast(mine, src=0)
            self._pace.counted = dict(counted)
        allowed = self.seconds_allowed
        if allowed is not None and self.seconds >= allowed:
            trainer.should_stop = True

    def on_validation_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Stop the clock."""
        self._started = None

    def on_train_batch_start(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Start it again behind a validation or a checkpoint."""
        if self._started is None:
            self._started = self.now()

    def on_save_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """A checkpoint does not count."""
        self._started = None

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Write down what was used."""
        if trainer.is_global_zero and trainer.default_root_dir:
            self.write(Path(trainer.default_root_dir) / FILE)

    def write(self, path: Path) -> None:
        """Write seconds, clock and steps."""
        content = {
            "seconds": self.seconds_before + self.seconds,
            "seconds_before": self.seconds_before,
            "clock": self.clock,
            "steps": self._steps,
            "minutes_allowed": self.minutes,
        }
        with AtomicPath(path) as partial:
            partial.write_text(json.dumps(content, indent=1) + "\n")

    def state_dict(self) -> dict[str, Any]:
        """Return plain numbers."""
        return {
            "seconds": self.seconds,
            "seconds_before": self.seconds_before,
            "steps": self._steps,
            "pace": [[length, *counted] for length, counted in self._pace.counted.items()],
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on counting."""
        self.seconds, self._steps = float(state_dict["seconds"]), int(state_dict["steps"])
        self.seconds_before = float(state_dict["seconds_before"])
        self._pace, pace = Pace(), state_dict.get("pace")
        if pace is None:  # from before the pace was kept by length: the mean over all updates, as of those that follow
            share = min(self.seconds / (self.seconds_allowed or 1.0), 0.999)
            length = 0 if self._lengths is None else self._lengths.ahead(share)[0][1][0]
            pace = [[length, state_dict.get("paced_seconds", self.seconds), state_dict.get("paced_steps", self._steps)]]
        for length, seconds, steps in pace:
            if steps:
                self._pace.count(int(length), float(seconds), int(steps))
