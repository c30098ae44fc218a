"""The stages of the paper and our own, at tiny sizes, through the whole training: gradients, resuming, validation."""

import signal
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch

from tests.data.recordings import write_recordings
from tests.training.tiny_training import SignalAt, tiny_trainer
from vpd_lightning.config import build, build_list, build_simulator, compose
from vpd_lightning.data.datamodule import VideoDataModule
from vpd_lightning.losses.base import AbstractLoss
from vpd_lightning.training.checkpoint_files import load_checkpoint
from vpd_lightning.training.checkpoints import find_resume
from vpd_lightning.training.module import VPDModule
from vpd_lightning.training.optimization import AbstractOptimization

# force_reach=null: what these recordings show flies, and then no learned force would act and learn.
MODELS = {
    "paper": ["encoder.num_particles=48"],
    "demo": [
        "encoder=unet_moving",
        "encoder.num_particles=48",
        "encoder.background.num_views=2",
        "encoder.background.height=16",
        "encoder.background.width=16",
        "dynamics=inertial",
        "dynamics.force_reach=null",
        "renderer=splat",
        "data.moving_ray_fraction=0.5",
    ],
    "objects": [
        "encoder=unet_objects",
        "encoder.num_particles=48",
        "dynamics=inertial",
        "dynamics.force_reach=null",
        "renderer=splat",
        "loss=pixel_and_motion",
        "data.load_future=true",
    ],
}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recordings(tmp_path_factory.mktemp("data"))


def build_training(data: Path, model: str) -> tuple[VPDModule, VideoDataModule]:
    """As vpd-train builds it; the initial weights are always the same."""
    shared = [f"data.folder={data}", "scene.input_views=[0,1]", "data.rays_per_step=16", "trainer.max_steps=4"]
    config = compose("train", ["experiment=tiny", "run.folder=unused", *shared, *MODELS[model]])
    datamodule = build(config["data"], VideoDataModule, "data")
    with torch.random.fork_rng():
        torch.manual_seed(0)
        simulator = build_simulator(config)
    background = simulator.encoder.background
    if background is not None and background.needs_fit:
        background.fit(*datamodule.median_background())  # type: ignore[operator]
    module = VPDModule(
        simulator=simulator,
        losses=build_list(config["loss"], AbstractLoss, "loss"),
        optimization=build(config["optimizer"], AbstractOptimization, "optimizer"),
        config=config,
    )
    return module, datamodule


class CheckGradients(pl.Callback):
    """Every weight must be reached by a finite gradient."""

    def __init__(self) -> None:
        self.reached: set[str] = set()

    def on_before_optimizer_step(self, trainer: pl.Trainer, pl_module: pl.LightningModule, optimizer: Any) -> None:
        for name, parameter in pl_module.named_parameters():
            if parameter.requires_grad:
                assert parameter.grad is not None, name
                assert parameter.grad.isfinite().all(), name
                if parameter.grad.any():
                    self.reached.add(name)


@pytest.mark.slow
@pytest.mark.parametrize("model", list(MODELS))
def test_all_weights_learn_and_an_interrupted_training_equals_an_uninterrupted_one(
    data: Path, tmp_path: Path, model: str
) -> None:
    module, datamodule = build_training(data, model)
    check = CheckGradients()
    tiny_trainer(tmp_path / "a", 4, [check], val_check_interval=2).fit(module, datamodule)
    missed = {name for name, parameter in module.named_parameters() if parameter.requires_grad} - check.reached
    # Nothing strikes anything in these recordings; tests/dynamics/test_inertial.py reaches the speed of a bounce.
    assert missed <= {"simulator.dynamics.log_rest_speed"}

    module, datamodule = build_training(data, model)
    with pytest.raises(SystemExit):
        tiny_trainer(tmp_path / "b", 4, [SignalAt(2, signal.SIGTERM)], val_check_interval=2).fit(module, datamodule)
    module, datamodule = build_training(data, model)
    resumed = find_resume(tmp_path / "b")
    tiny_trainer(tmp_path / "b", 4, val_check_interval=2).fit(module, datamodule, ckpt_path=resumed)

    first, second = (load_checkpoint(tmp_path / run / "checkpoints" / "last.ckpt") for run in ("a", "b"))
    assert first["global_step"] == second["global_step"] == 4
    for name, value in first["state_dict"].items():
        assert torch.equal(value, second["state_dict"][name]), name


@pytest.mark.parametrize("model", list(MODELS))
def test_bf16_trains(data: Path, tmp_path: Path, model: str) -> None:
    module, datamodule = build_training(data, model)
    trainer = tiny_trainer(tmp_path, 2, precision="bf16-mixed", val_check_interval=2)
    trainer.fit(module, datamodule)
    assert torch.isfinite(torch.as_tensor(module.train_metrics["loss"]))  # evidence of motion may be above one
    assert all(parameter.isfinite().all() for parameter in module.parameters())
