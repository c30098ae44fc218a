"""Which checkpoints a run keeps."""

from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch

from tests.data.recordings import write_recordings
from tests.training.tiny_training import tiny_data, tiny_module, tiny_trainer
from vpd_lightning.training.callbacks.keep_checkpoints import KeepCheckpoints
from vpd_lightning.training.checkpoint_files import load_checkpoint


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recordings(tmp_path_factory.mktemp("data"))


class SavedSteps(pl.Callback):
    """Notes the step of last.ckpt before each training step."""

    def __init__(self, run: Path) -> None:
        self.last = run / "checkpoints" / "last.ckpt"
        self.steps: list[int] = []

    def on_train_batch_start(self, *args: Any) -> None:
        self.steps.append(load_checkpoint(self.last)["global_step"] if self.last.exists() else 0)


def test_last_is_written_on_time_and_at_the_end(data: Path, tmp_path: Path) -> None:
    saved = SavedSteps(tmp_path)
    tiny_trainer(tmp_path, 12, [saved]).fit(tiny_module(), tiny_data(data))
    assert saved.steps == [0] * 5 + [5] * 5 + [10] * 2
    assert load_checkpoint(saved.last)["global_step"] == 12
    assert load_checkpoint(saved.last.with_name("last-previous.ckpt"))["global_step"] == 10


def test_best_is_the_one_with_the_highest_validation_psnr(data: Path, tmp_path: Path) -> None:
    class Worse(pl.Callback):
        """Spoils the weights after step 20."""

        def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *args: Any) -> None:
            if trainer.global_step > 20:
                with torch.no_grad():
                    pl_module.simulator.renderer.color.bias.fill_(10.0)

    trainer = tiny_trainer(tmp_path, 30, [Worse()])
    trainer.fit(tiny_module(), tiny_data(data))
    lines = [line.split(",") for line in (tmp_path / "metrics.csv").read_text().splitlines()]
    place = lines[0].index("validation/psnr")
    scores = {int(line[0]): float(line[place]) for line in lines[1:] if line[place]}
    assert set(scores) == {10, 20, 30} and scores[30] < max(scores.values())
    best = load_checkpoint(tmp_path / "checkpoints" / "best.ckpt")
    assert best["global_step"] == max(scores, key=lambda step: scores[step])
    assert best["callbacks"]["KeepCheckpoints"]["best_score"] == pytest.approx(max(scores.values()))


def test_a_training_that_is_told_to_stop_early_is_saved(data: Path, tmp_path: Path) -> None:
    class Stop(pl.Callback):
        def on_train_batch_end(self, trainer: pl.Trainer, *args: Any) -> None:
            trainer.should_stop = trainer.global_step == 7

    tiny_trainer(tmp_path, 12, [Stop()]).fit(tiny_module(), tiny_data(data))
    assert load_checkpoint(tmp_path / "checkpoints" / "last.ckpt")["global_step"] == 7


def test_an_interval_below_one_is_refused() -> None:
    with pytest.raises(ValueError, match="every_n_steps must be at least 1, got 0"):
        KeepCheckpoints(every_n_steps=0)
