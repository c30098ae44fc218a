"""A running average of the weights: what it is, who sees it, and that a resumed training keeps it."""

import signal
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from torch import Tensor

from tests.data.recordings import write_recordings
from tests.training.tiny_training import SignalAt, tiny_data, tiny_module, tiny_trainer
from vpd_lightning.commands import train
from vpd_lightning.loading import load_model, simulator_weights
from vpd_lightning.training.callbacks.average_weights import CURRENT, AverageWeights
from vpd_lightning.training.checkpoint_files import load_checkpoint
from vpd_lightning.training.checkpoints import find_resume
from vpd_lightning.training.module import BEST_METRIC

STEPS = 24


def average() -> AverageWeights:
    return AverageWeights(decay=0.9, warmup=4.0)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recordings(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def uninterrupted(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("uninterrupted")
    tiny_trainer(run, STEPS, [average()]).fit(tiny_module(), tiny_data(data))
    return run


def last(run: Path) -> dict[str, Any]:
    return load_checkpoint(run / "checkpoints" / "last.ckpt")


def assert_equal_states(first: dict[str, Tensor], second: dict[str, Tensor]) -> None:
    assert first.keys() == second.keys()
    for key, value in first.items():
        assert torch.equal(value, second[key]), key


def assert_equal_runs(first: Path, second: Path) -> None:
    for name in ("last.ckpt", "last-previous.ckpt", "best.ckpt"):
        a, b = (load_checkpoint(run / "checkpoints" / name) for run in (first, second))
        assert a["global_step"] == b["global_step"]
        assert a["callbacks"] == b["callbacks"]
        for key in ("state_dict", CURRENT, "averaging_state"):
            assert_equal_states(a[key], b[key])


class Weights(pl.Callback):
    """Notes one parameter after every update."""

    def __init__(self) -> None:
        self.seen: list[Tensor] = []

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *args: Any) -> None:
        self.seen.append(pl_module.simulator.renderer.color.weight.detach().clone())


def test_the_checkpoint_holds_the_average_of_all_updates(data: Path, tmp_path: Path) -> None:
    weights = Weights()
    tiny_trainer(tmp_path, STEPS, [weights, average()]).fit(tiny_module(), tiny_data(data))

    expected = weights.seen[0]
    for number, value in enumerate(weights.seen[1:], start=1):
        kept = min(0.9, (1 + number) / (4 + number))
        expected = kept * expected + (1 - kept) * value
    stored = last(tmp_path)
    assert torch.allclose(stored["state_dict"]["simulator.renderer.color.weight"], expected, rtol=0, atol=1e-6)
    assert torch.equal(stored[CURRENT]["simulator.renderer.color.weight"], weights.seen[-1])
    assert not torch.allclose(expected, weights.seen[-1], rtol=0, atol=1e-4)


def test_the_training_itself_does_not_notice(data: Path, uninterrupted: Path, tmp_path: Path) -> None:
    tiny_trainer(tmp_path, STEPS).fit(tiny_module(), tiny_data(data))

    assert_equal_states(last(tmp_path)["state_dict"], last(uninterrupted)[CURRENT])


def test_validations_see_the_average(data: Path, tmp_path: Path) -> None:
    """The score of the last validation is that of a bare system with the average of the checkpoint behind it."""
    trainer = tiny_trainer(tmp_path, 10, [average()])
    trainer.fit(tiny_module(), tiny_data(data))

    def score_of(weights: dict[str, Tensor]) -> Tensor:
        bare, validator = tiny_module(), tiny_trainer(tmp_path / "bare", 10)
        bare.load_state_dict(weights)
        validator.validate(bare, tiny_data(data))
        return validator.callback_metrics[BEST_METRIC]

    scored, stored = trainer.callback_metrics[BEST_METRIC], last(tmp_path)
    assert scored == score_of(stored["state_dict"])
    assert scored != score_of(stored[CURRENT])


@pytest.mark.parametrize(("step", "is_validation"), [(13, False), (20, True)])
def test_a_resumed_training_equals_an_uninterrupted_one(
    data: Path, uninterrupted: Path, tmp_path: Path, step: int, is_validation: bool
) -> None:
    stop = SignalAt(step, signal.SIGTERM, is_validation=is_validation)
    with pytest.raises(SystemExit):
        tiny_trainer(tmp_path, STEPS, [average(), stop]).fit(tiny_module(), tiny_data(data))

    assert last(tmp_path)["global_step"] == step + (not is_validation)
    tiny_trainer(tmp_path, STEPS, [average()]).fit(tiny_module(), tiny_data(data), ckpt_path=find_resume(tmp_path))
    assert_equal_runs(uninterrupted, tmp_path)


class SavedInside(pl.Callback):
    """Saves a checkpoint in the middle of the validation of a step, as a signal at that moment would."""

    def __init__(self, step: int, path: Path) -> None:
        self.step, self.path = step, path

    def on_validation_batch_end(self, trainer: pl.Trainer, *args: Any) -> None:
        if trainer.global_step == self.step:
            trainer.save_checkpoint(self.path)


def test_a_checkpoint_out_of_the_middle_of_a_validation_is_the_one_behind_it(data: Path, tmp_path: Path) -> None:
    inside = SavedInside(20, tmp_path / "inside.ckpt")
    tiny_trainer(tmp_path, 20, [average(), inside]).fit(tiny_module(), tiny_data(data))

    saved = load_checkpoint(tmp_path / "inside.ckpt")
    assert_equal_states(saved["state_dict"], last(tmp_path)["state_dict"])
    assert_equal_states(saved[CURRENT], last(tmp_path)[CURRENT])


def test_a_training_that_is_told_to_stop_keeps_weights_to_go_on_with(
    data: Path, uninterrupted: Path, tmp_path: Path
) -> None:
    """A time budget ends a training between checkpoints: the one then written must not hold the average twice."""

    class Stop(pl.Callback):
        def on_train_batch_end(self, trainer: pl.Trainer, *args: Any) -> None:
            trainer.should_stop = trainer.global_step >= 13

    tiny_trainer(tmp_path, STEPS, [average(), Stop()]).fit(tiny_module(), tiny_data(data))
    assert last(tmp_path)["global_step"] == 13

    tiny_trainer(tmp_path, STEPS, [average()]).fit(tiny_module(), tiny_data(data), ckpt_path=find_resume(tmp_path))
    assert_equal_states(last(tmp_path)[CURRENT], last(uninterrupted)[CURRENT])
    assert_equal_states(last(tmp_path)["state_dict"], last(uninterrupted)["state_dict"])


def test_what_is_loaded_for_an_evaluation_is_the_average(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "run"
    train.main([
        "experiment=tiny", "callbacks=weight_averaging", "trainer=cpu", "trainer.max_steps=4", "logger=csv",
        "encoder.num_particles=64", "data.rays_per_step=16",
        "evaluate=false", f"run.folder={folder}",
    ])  # fmt: skip

    stored, loaded = last(folder), load_model(folder).simulator.state_dict()
    assert_equal_states(loaded, simulator_weights(stored))
    own = simulator_weights({"state_dict": stored[CURRENT]})
    assert any(not torch.equal(value, own[key]) for key, value in loaded.items())


def test_the_first_weights_are_forgotten_in_short_trainings_and_decay_rules_long_ones() -> None:
    callback = AverageWeights(decay=0.99, warmup=10.0)

    assert callback.share_kept(1) == pytest.approx(2 / 11)
    assert callback.share_kept(400) == pytest.approx(401 / 410)
    assert callback.share_kept(10_000) == 0.99


@pytest.mark.parametrize("changes", [{"decay": 1.0}, {"decay": 0.0}, {"warmup": 0.5}])
def test_shares_that_mean_nothing_are_refused(changes: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="decay must lie"):
        AverageWeights(**{"decay": 0.9, "warmup": 10.0, **changes})
