"""A tiny training in float64 by several processes, which writes down what each rank was given and what it learned.

``python -m tests.reliability.ranks_child DATA RUN DEVICES BATCH STEPS``: each step's clips in ``clips_RANK.json``, the
gradients of the second step, after they were averaged, in ``gradients.pt``. A run with a checkpoint is gone on with.
"""

import json
import sys
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch

from tests.training.tiny_training import tiny_data, tiny_module, tiny_simulator, tiny_trainer
from vpd_lightning.training.checkpoints import FOLDER, find_resume


class WriteDown(pl.Callback):
    """Keeps gradients and clips."""

    def __init__(self, run: Path) -> None:
        self.run = run
        self.clips: dict[int, list[str]] = {}

    def on_train_batch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule, batch: Any, index: int) -> None:
        self.clips[trainer.global_step] = list(batch.clips)

    def on_before_optimizer_step(self, trainer: pl.Trainer, pl_module: pl.LightningModule, optimizer: Any) -> None:
        if trainer.is_global_zero and trainer.global_step == 1:
            gradients = {name: p.grad.clone() for name, p in pl_module.named_parameters() if p.grad is not None}
            torch.save(gradients, self.run / "gradients.pt")

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        path = self.run / f"clips_{trainer.global_rank}.json"
        before = json.loads(path.read_text()) if path.is_file() else {}
        path.write_text(json.dumps({**before, **self.clips}))


def main() -> None:
    """Train, or go on."""
    data, run, (devices, batch, steps) = Path(sys.argv[1]), Path(sys.argv[2]), map(int, sys.argv[3:6])
    torch.set_num_threads(1)
    run.mkdir(parents=True, exist_ok=True)
    strategy = "ddp_fork" if devices > 1 else "auto"  # forked: they need not import everything again
    trainer = tiny_trainer(run, steps, [WriteDown(run)], devices=devices, strategy=strategy, val_check_interval=steps)
    resume = find_resume(run) if (run / FOLDER).is_dir() else None
    clips = max(devices, 2)
    trainer.fit(
        tiny_module(tiny_simulator(torch.float64)),
        tiny_data(data, batch_size=batch, num_validation_clips=clips),
        ckpt_path=resume,
    )


if __name__ == "__main__":
    main()
