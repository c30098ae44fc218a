"""What a person sees."""

import io
import re
from pathlib import Path
from typing import Any

import pytest

from tests.data.recordings import write_recordings
from tests.training.tiny_training import tiny_data, tiny_module, tiny_trainer
from vpd_lightning.training.callbacks.progress import Progress, clock
from vpd_lightning.training.callbacks.time_budget import TimeBudget


class Terminal(io.StringIO):
    """Says that it is one."""

    def isatty(self) -> bool:
        return True


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recordings(tmp_path_factory.mktemp("data"))


def train(data: Path, run: Path, stream: io.StringIO) -> str:
    tiny_trainer(run, 12, [Progress(every_n_steps=5, stream=stream)]).fit(tiny_module(), tiny_data(data))
    return stream.getvalue()


def test_plain_lines_where_there_is_no_terminal(data: Path, tmp_path: Path) -> None:
    lines = train(data, tmp_path, io.StringIO()).splitlines()
    pattern = r"step (\d+)/12  [\d.]+ it/s  [\d,]+ rays/s  ETA \d+:\d\d:\d\d  loss [\d.]+  PSNR [\d.]+"
    found = [match.group(1) for line in lines if (match := re.fullmatch(pattern, line))]
    assert found == ["5", "10", "12"]
    assert [line for line in lines if line.startswith("validation after step 10: PSNR ")]
    assert len(lines) == 4 and all(line.isprintable() for line in lines)


def test_a_live_line_on_a_terminal(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "120")
    text = train(data, tmp_path, Terminal())
    assert "\x1b[" in text and "12/12" in text and "rays/s" in text and "validation after step 10" in text


@pytest.mark.parametrize("is_terminal", [False, True])
def test_end_of_a_time_budget_is_told_and_is_the_end_of_the_bar(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_terminal: bool
) -> None:
    class TwelveSteps(TimeBudget):
        def now(self) -> float:
            return self.time

        def on_train_batch_start(self, *args: Any) -> None:
            super().on_train_batch_start(*args)
            self.time += 5.0

        time = 0.0

    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "160")
    stream = Terminal() if is_terminal else io.StringIO()
    progress = Progress(every_n_steps=50, stream=stream)
    totals = []
    monkeypatch.setattr(
        progress, "teardown", lambda *_, **__: totals.append(progress._bar and progress._bar.tasks[0].total)
    )
    trainer = tiny_trainer(tmp_path, 1000, [TwelveSteps(minutes=1.0, clock="cpu"), progress])
    trainer.fit(tiny_module(), tiny_data(data, num_steps_schedule=None))
    assert trainer.global_step == 12
    assert "the time is up: step 12/about 12  " in stream.getvalue()
    if is_terminal:
        assert totals == [12]
        progress._bar.stop()


def test_clock() -> None:
    assert [clock(seconds) for seconds in (-1.0, 59.6, 3661.0, 100 * 3600.0)] == [
        "0:00:00", "0:01:00", "1:01:01", "100:00:00"
    ]  # fmt: skip
