"""Two processes with half a batch each compute the gradients of one process with the whole batch."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch

from tests.data.recordings import write_recordings
from tests.training.tiny_training import tiny_data, tiny_module, tiny_simulator, tiny_trainer
from tests.waiting import HANG


class KeepScores(pl.Callback):
    """Saves what a validation found, as it is monitored and logged."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if trainer.is_global_zero:
            scores = {name: value for name, value in trainer.callback_metrics.items() if name.startswith("validation/")}
            torch.save(scores, self.path)


class KeepGradients(pl.Callback):
    """Saves the gradients of the second step, after they were averaged over the processes."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def on_before_optimizer_step(self, trainer: pl.Trainer, pl_module: pl.LightningModule, optimizer: Any) -> None:
        if trainer.is_global_zero and trainer.global_step == 1:
            gradients = {name: p.grad.clone() for name, p in pl_module.named_parameters() if p.grad is not None}
            torch.save(gradients, self.path)


def train(data: Path, run: Path, devices: int) -> None:
    run.mkdir(parents=True)
    torch.set_num_threads(1)
    # Forked processes, because they need not import everything again; the strategy is the same.
    strategy = "ddp_fork" if devices > 1 else "auto"
    data_of = tiny_data(data, batch_size=4)
    tiny_trainer(run, 2, [KeepScores(run / "untrained.pt")], devices=devices, strategy=strategy).validate(
        tiny_module(tiny_simulator(torch.float64)), data_of, verbose=False
    )
    callbacks: list[pl.Callback] = [KeepGradients(run / "gradients.pt")]
    trainer = tiny_trainer(run, 2, callbacks, devices=devices, strategy=strategy, val_check_interval=2)
    trainer.fit(tiny_module(tiny_simulator(torch.float64)), data_of)


@pytest.mark.slow
@pytest.mark.ddp
def test_two_processes_give_the_gradients_and_the_validation_of_one(tmp_path: Path) -> None:
    data = write_recordings(tmp_path / "data")
    train(data, tmp_path / "one", devices=1)
    # In a process that has computed nothing yet: a fork of one that has may hang.
    program = "from tests.training.test_data_parallel import *; train(Path(sys.argv[1]), Path(sys.argv[2]), devices=2)"
    command = [sys.executable, "-c", program, str(data), str(tmp_path / "two")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=HANG, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    gradients = [torch.load(tmp_path / run / "gradients.pt", weights_only=True) for run in ("one", "two")]
    untrained = [torch.load(tmp_path / run / "untrained.pt", weights_only=True) for run in ("one", "two")]
    assert set(untrained[0]) == {"validation/psnr", "validation/psnr_last_step"}
    # The same weights in both: bit for bit, whichever process predicted which clip.
    assert untrained[0] == untrained[1]
    scores = [(tmp_path / run / "metrics.csv").read_text().split(",")[-2:] for run in ("one", "two")]
    assert gradients[0].keys() == gradients[1].keys() and len(gradients[0]) == 6
    for name, expected in gradients[0].items():
        assert expected.dtype == torch.float64 and expected.abs().max() > 0
        # Means over two halves instead of the whole: rounding of float64 only.
        torch.testing.assert_close(gradients[1][name], expected, rtol=1e-6, atol=1e-12)
    assert [float(a) for a in scores[0]] == pytest.approx([float(b) for b in scores[1]], rel=1e-6)
