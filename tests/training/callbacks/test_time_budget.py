"""A training that ends after a given time."""

import json
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch

from tests.data.recordings import write_recordings
from tests.training.tiny_training import tiny_data, tiny_module, tiny_trainer
from vpd_lightning.data.rollout_lengths import RolloutLengths
from vpd_lightning.errors import ConfigError
from vpd_lightning.training.callbacks.time_budget import FILE, TimeBudget
from vpd_lightning.training.checkpoint_files import load_checkpoint

SECONDS_A_STEP = 2.0


class ScriptedBudget(TimeBudget):
    """A clock of its own: two seconds for every step, a thousand for every validation."""

    def __init__(self, minutes: float | None, **settings: Any) -> None:
        super().__init__(minutes=minutes, clock="cpu")
        self.time = 0.0

    def now(self) -> float:
        return self.time

    def on_before_optimizer_step(self, *args: Any) -> None:
        self.time += SECONDS_A_STEP

    def on_validation_end(self, *args: Any) -> None:
        self.time += 1000.0


class Rates(pl.Callback):
    """Notes the learning rate of every step."""

    def __init__(self) -> None:
        self.values: list[float] = []

    def on_before_optimizer_step(self, trainer: pl.Trainer, pl_module: pl.LightningModule, optimizer: Any) -> None:
        self.values.append(optimizer.param_groups[0]["lr"])


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recordings(tmp_path_factory.mktemp("data"))


def fit(data: Path, run: Path, budget: TimeBudget, steps: int = 1000, **changes: Any) -> tuple[pl.Trainer, Rates]:
    rates = Rates()
    trainer = tiny_trainer(run, steps, [budget, rates])
    trainer.fit(tiny_module(), tiny_data(data, num_steps_schedule=None), **changes)
    return trainer, rates


def test_ends_when_the_time_of_its_steps_is_up_and_does_not_count_validations(data: Path, tmp_path: Path) -> None:
    trainer, _ = fit(data, tmp_path, ScriptedBudget(minutes=1.0))  # a validation every 10 steps

    assert trainer.global_step == 30
    assert load_checkpoint(tmp_path / "checkpoints" / "last.ckpt")["global_step"] == 30
    written = json.loads((tmp_path / FILE).read_text())
    assert written == {"seconds": 60.0, "seconds_before": 0.0, "clock": "cpu", "steps": 30, "minutes_allowed": 1.0}


def test_learning_rate_reaches_its_end_with_the_time(data: Path, tmp_path: Path) -> None:
    _, rates = fit(data, tmp_path, ScriptedBudget(minutes=1.0))
    trainer = tiny_trainer(tmp_path / "steps", 30, [counted := Rates()])
    trainer.fit(tiny_module(), tiny_data(data, num_steps_schedule=None))

    # The pace is known after ten steps; from then on the schedule is that of as many steps.
    assert rates.values[11:] == pytest.approx(counted.values[11:])
    assert rates.values[-1] < 0.2 * max(rates.values)


def test_pace_is_that_of_the_steps_behind_the_first_ones_of_a_start(data: Path, tmp_path: Path) -> None:
    class SlowStart(ScriptedBudget):
        def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
            super().on_train_start(trainer, pl_module)
            self.left, self.seen = 3, {}

        def on_before_optimizer_step(self, *args: Any) -> None:
            self.time += 10.0 if self.left > 0 else SECONDS_A_STEP
            self.left -= 1

        def on_train_batch_end(self, *args: Any) -> None:
            super().on_train_batch_end(*args)
            self.seen[self._steps] = self.expected_steps(1000)

    budget = SlowStart(minutes=2.0)
    fit(data, tmp_path, budget, steps=12)
    # 3 steps of 10 s, and 45 of 2 s
    assert budget.seen == {**dict.fromkeys(range(1, 10), 1000), 10: 48, 11: 48, 12: 48}

    again = SlowStart(minutes=2.0)
    trainer, _ = fit(data, tmp_path, again, ckpt_path=tmp_path / "checkpoints" / "last.ckpt")
    # 24 s more are lost: 12 steps fewer
    assert trainer.global_step == 36 and set(list(again.seen.values())[2:]) == {36}


def test_several_devices_follow_the_clock_of_the_first() -> None:
    class Strategy:
        """The first device's time is broadcast to the others."""

        def __init__(self) -> None:
            self.said: Any = None

        def broadcast(self, value: Any, src: int) -> Any:
            assert src == 0
            self.said = value if self.said is None else self.said
            return self.said

        def next_step(self) -> None:
            self.said = None

    class FakeTrainer(pl.Trainer):
        world_size, max_steps, global_step, strategy, should_stop = 2, 1000, 0, None, False

        def __init__(self, strategy: Strategy) -> None:
            self.strategy = strategy

    strategy, module = Strategy(), tiny_module()
    ranks = [(ScriptedBudget(minutes=1.0), FakeTrainer(strategy)) for _ in range(2)]
    for number, (budget, trainer) in enumerate(ranks):
        budget.seconds_before = 10.0 * (1 - number)
        budget.on_train_start(trainer, module)
    for step in range(1, 26):
        strategy.next_step()
        for number, (budget, trainer) in enumerate(ranks):
            trainer.global_step = step
            budget.time += SECONDS_A_STEP * (1 + number)
            budget.on_train_batch_end(trainer, module, None, None, 0)
        assert ranks[0][0].expected_steps(1000) == ranks[1][0].expected_steps(1000)
        assert [trainer.should_stop for _, trainer in ranks] == [step >= 25] * 2
    assert ranks[1][0].seconds == 50.0 and ranks[1][0].seconds_before == 10.0


def test_time_spent_before_counts(data: Path, tmp_path: Path) -> None:
    budget = ScriptedBudget(minutes=1.0)
    budget.seconds_before = 40.0
    trainer, _ = fit(data, tmp_path, budget)

    assert trainer.global_step == 10
    assert json.loads((tmp_path / FILE).read_text())["seconds"] == 60.0


def test_resumed_training_uses_what_is_left(data: Path, tmp_path: Path) -> None:
    fit(data, tmp_path, ScriptedBudget(minutes=1.0), steps=12)
    trainer, _ = fit(data, tmp_path, ScriptedBudget(minutes=1.0), ckpt_path=tmp_path / "checkpoints" / "last.ckpt")
    assert trainer.global_step == 30

    again, _ = fit(data, tmp_path, ScriptedBudget(minutes=1.0), ckpt_path=tmp_path / "checkpoints" / "last.ckpt")
    assert again.global_step == 30  # the time is up: not one step more


def test_without_a_limit_the_steps_end_it_and_the_time_is_written(data: Path, tmp_path: Path) -> None:
    trainer, _ = fit(data, tmp_path, ScriptedBudget(minutes=None), steps=4)

    assert trainer.global_step == 4
    assert json.loads((tmp_path / FILE).read_text())["seconds"] == 4 * SECONDS_A_STEP


class Lengths(pl.Callback):
    """Notes the rollout length of every step."""

    def __init__(self) -> None:
        self.values: list[int] = []

    def on_train_batch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule, batch: Any, index: int) -> None:
        self.values.append(batch.rgbs.shape[1])


def test_clips_grow_with_the_share_of_the_time(data: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer(tmp_path, 1000, [ScriptedBudget(minutes=1.0), lengths := Lengths()])
    trainer.fit(tiny_module(), tiny_data(data, num_steps_schedule={0.0: 1, 0.5: 3}, num_workers=0))

    assert len(lengths.values) == 30
    changed = lengths.values.index(3)
    assert set(lengths.values[:changed]) == {1} and set(lengths.values[changed:]) == {3}
    assert 15 <= changed <= 17  # batches are read one ahead


class LongerTakesLonger(ScriptedBudget):
    """A second for every frame that is read or predicted; notes how many updates are expected."""

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        super().on_train_start(trainer, pl_module)
        self.expected: dict[int, int] = {}

    def on_before_optimizer_step(self, *args: Any) -> None:
        pass

    def on_train_batch_end(self, trainer: Any, module: Any, outputs: Any, batch: Any, index: int) -> None:
        self.time += batch.rgbs.shape[1] + 2.0
        super().on_train_batch_end(trainer, module, outputs, batch, index)
        self.expected[self._steps] = self.expected_steps(1000)


def test_what_longer_clips_will_take_is_expected_from_the_start(data: Path, tmp_path: Path) -> None:
    settings = {"num_steps_schedule": {0.0: 1, 0.5: [3, 5]}, "num_workers": 0}
    tiny_trainer(tmp_path, 1000, [budget := LongerTakesLonger(minutes=6.0)]).fit(
        tiny_module(), tiny_data(data, **settings)
    )

    # Three minutes of updates of 3 s, and three of updates of 5 or 7.
    assert budget.expected[10] == 60 + 30
    assert all(abs(expected - budget._steps) <= 3 for step, expected in budget.expected.items() if step >= 10)


def test_a_training_from_before_paces_were_kept_by_length_goes_on(data: Path, tmp_path: Path) -> None:
    budget = LongerTakesLonger(minutes=3.0)
    budget._lengths = RolloutLengths(1, {0.0: 1, 0.5: 4})
    budget.load_state_dict(
        {"seconds": 60.0, "seconds_before": 0.0, "steps": 20, "paced_seconds": 51.0, "paced_steps": 17}
    )
    # 30 s more of updates of 3 s, and 90 s of updates that take twice as long
    assert budget.expected_steps(1000) == 20 + 10 + 15


def test_a_schedule_whose_data_other_processes_read_is_refused(data: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer(tmp_path, 10, [TimeBudget(minutes=1.0, clock="wall")])
    with pytest.raises(ConfigError, match=r"(?s)num_steps_schedule follows the time.*Set data.num_workers=0"):
        trainer.fit(tiny_module(), tiny_data(data, num_workers=2))


def test_work_that_the_processors_clock_does_not_see_is_refused(data: Path, tmp_path: Path) -> None:
    def start(budget: TimeBudget, **changes: Any) -> None:
        trainer = tiny_trainer(tmp_path, 1, [budget])
        trainer.fit(tiny_module(), tiny_data(data, num_steps_schedule=None, **changes))

    with pytest.raises(ConfigError, match=r"(?s)2 processes that read data.*data\.num_workers=0.*clock=wall"):
        start(TimeBudget(minutes=1.0, clock="cpu"), num_workers=2)
    start(TimeBudget(minutes=None, clock="cpu"), num_workers=2)  # only measured

    class OnDevice(pl.Trainer):
        class strategy:
            root_device = torch.device("cuda", 0)

        def __init__(self) -> None:
            pass

    with pytest.raises(ConfigError, match=r"(?s)runs on cuda.*clock=wall"):
        TimeBudget(minutes=1.0, clock="cpu").setup(OnDevice(), tiny_module(), "fit")
    TimeBudget(minutes=1.0, clock="wall").setup(OnDevice(), tiny_module(), "fit")


def test_no_time_at_all_is_refused() -> None:
    with pytest.raises(ValueError, match="minutes"):
        TimeBudget(minutes=0.0, clock="cpu")
