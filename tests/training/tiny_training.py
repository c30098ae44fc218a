"""A simulator of a few hundred weights and a training of it, small enough to be killed and resumed many times.

Its stages draw from the batch's keys, as real ones do. Runs as a script, too:
``python -m tests.training.tiny_training DATA RUN --steps 30 [--workers 2] [--resume] [--kill-at 17]``.
"""

import argparse
import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor, nn

from vpd_lightning.data.datamodule import VideoDataModule
from vpd_lightning.dynamics.base import AbstractDynamics
from vpd_lightning.encoder.base import AbstractEncoder, EncoderOutput
from vpd_lightning.geometry.cameras import unproject
from vpd_lightning.geometry.workspace import choose
from vpd_lightning.losses.pixel import PixelLoss
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.base import AbstractRenderer
from vpd_lightning.simulator import Simulator
from vpd_lightning.training.callbacks.keep_checkpoints import KeepCheckpoints
from vpd_lightning.training.callbacks.log_metrics import LogMetrics
from vpd_lightning.training.callbacks.progress import Progress
from vpd_lightning.training.callbacks.stop_on_signal import StopOnSignal
from vpd_lightning.training.checkpoint_io import AtomicCheckpointIO
from vpd_lightning.training.checkpoints import find_resume
from vpd_lightning.training.metrics_csv import MetricsCSV
from vpd_lightning.training.module import VPDModule
from vpd_lightning.training.optimization import WarmupCosineAdam
from vpd_lightning.types import Particles, Rays, RenderedRays, RGBDFrames

NUM_PARTICLES = 12
FEATURE_DIM = 4


class TinyEncoder(AbstractEncoder):
    """A random choice of unprojected pixels with a linear map of their colours."""

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Linear(3, FEATURE_DIM)

    def forward(self, frames: RGBDFrames, keys: RandomKeys, purpose: str) -> EncoderOutput:
        points = unproject(frames.depth, frames.cameras).flatten(1, 3)
        colors = frames.rgb if frames.rgb.is_floating_point() else frames.rgb.to(points) / 255
        members = []
        for generator in keys.generators(f"particles/{purpose}"):
            everything = torch.ones(points.shape[1], dtype=torch.bool)
            members.append(choose(everything, NUM_PARTICLES, generator)[0])
        index = torch.stack(members)[..., None].expand(-1, -1, 3)
        positions = points.gather(1, index)
        return EncoderOutput(Particles(positions, self.features(colors.flatten(1, 3).gather(1, index))))


class TinyDynamics(AbstractDynamics):
    """Every particle moves by a function of its feature and of the mean of both frames."""

    def __init__(self) -> None:
        super().__init__()
        self.change = nn.Linear(FEATURE_DIM + 6, 3 + FEATURE_DIM)

    def forward(
        self, previous: Particles, current: Particles, memory: Any, keys: RandomKeys, rollout_step: int
    ) -> tuple[Particles, Any]:
        means = torch.cat([previous.positions.mean(1), current.positions.mean(1)], dim=-1)
        context = means[:, None].expand(-1, current.num_particles, -1)
        change = 0.1 * self.change(torch.cat([current.features, context], dim=-1)).tanh()
        moved = replace(
            current, positions=current.positions + change[..., :3], features=current.features + change[..., 3:]
        )
        return moved, memory


class TinyRenderer(AbstractRenderer):
    """A colour from the particles weighed by their distance to the (jittered) ray."""

    def __init__(self) -> None:
        super().__init__()
        self.color = nn.Linear(FEATURE_DIM, 3)

    def forward(self, particles: Particles, rays: Rays, keys: RandomKeys | None) -> RenderedRays:
        offset = particles.positions[:, None] - rays.origins[:, :, None]
        along = (offset * rays.directions[:, :, None]).sum(-1)
        squared = offset.square().sum(-1) - along.square()
        if keys is not None:
            noise = [torch.rand(squared.shape[1:], generator=g) for g in keys.generators("renderer")]
            squared = squared + 0.01 * torch.stack(noise).to(squared)
        weights = torch.softmax(-10 * squared, dim=-1)
        rgbs = torch.sigmoid(self.color(weights @ particles.features))
        return RenderedRays(rgbs=rgbs, depths=(weights * along).sum(-1), opacities=torch.ones_like(rgbs[..., 0]))


def tiny_simulator(dtype: torch.dtype = torch.float32) -> Simulator:
    """Always the same weights."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        simulator = Simulator(
            encoder=TinyEncoder(),
            dynamics=TinyDynamics(),
            renderer=TinyRenderer(),
            location_noise=1e-3,
            checkpoint_dynamics=False,
            pixel_gradient_to_motion=1.0,
        )
    return simulator.to(dtype)


def tiny_module(simulator: Simulator | None = None) -> VPDModule:
    return VPDModule(
        simulator=simulator or tiny_simulator(),
        losses=[PixelLoss(weight=1.0, coarse_weight=1.0)],
        optimization=WarmupCosineAdam(
            lr=1e-2,
            betas=[0.9, 0.999],
            eps=1e-8,
            stage_multipliers={"dynamics": 0.5},
            warmup_steps=3,
            final_share=0.1,
        ),
        config={"experiment": "test", "scene": {"input_views": [0]}},
    )


def tiny_data(folder: Path, **changes: Any) -> VideoDataModule:
    settings: dict[str, Any] = {
        "folder": folder,
        "seed": 0,
        "num_trajectories": None,
        "batch_size": 2,
        "num_workers": 0,
        "num_steps": 3,
        "num_steps_schedule": {0.0: 2, 0.5: 3},
        "rays_per_step": 8,
        "input_views": [0],
        "target_views": None,
        "start_frames": None,
        "moving_ray_fraction": 0.5,
        "moving_ray_margin": 1,
        "moving_color_threshold": 0.1,
        "moving_depth_threshold": 0.05,
        "cache": True,
        "num_validation_clips": 2,
        "num_validation_steps": 2,
        "validation_views": [0],
        "load_future": False,
        "sensor": "none",
        "sensor_percent": None,
        "load_driven": False,
    }
    return VideoDataModule(**{**settings, **changes})


class SignalAt(pl.Callback):
    """Sends this process a signal while a step, or the validation after it, is at work."""

    def __init__(self, step: int, number: int, is_validation: bool = False) -> None:
        self.step, self.number, self.is_validation = step, number, is_validation

    def on_before_backward(self, trainer: pl.Trainer, pl_module: pl.LightningModule, loss: Tensor) -> None:
        self._send_at(trainer.global_step, is_validation=False)

    def on_validation_batch_start(self, trainer: pl.Trainer, *args: Any) -> None:
        self._send_at(trainer.global_step, is_validation=True)

    def _send_at(self, step: int, is_validation: bool) -> None:
        if step == self.step and is_validation == self.is_validation:
            self.step = -1
            os.kill(os.getpid(), self.number)


def tiny_trainer(run: Path, steps: int, callbacks: list[pl.Callback] | None = None, **changes: Any) -> pl.Trainer:
    settings: dict[str, Any] = {
        "accelerator": "cpu",
        "devices": 1,
        "max_steps": steps,
        "default_root_dir": run,
        "logger": [MetricsCSV(folder=run)],
        "plugins": [AtomicCheckpointIO()],
        "callbacks": [LogMetrics(), KeepCheckpoints(every_n_steps=5), StopOnSignal(), *(callbacks or [])],
        "log_every_n_steps": 1,
        "val_check_interval": 10,
        "check_val_every_n_epoch": None,
        "num_sanity_val_steps": 0,
        "enable_progress_bar": False,
        "enable_model_summary": False,
        "use_distributed_sampler": False,
    }
    return pl.Trainer(**{**settings, **changes})


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("data", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--kill-at", type=int)
    options = parser.parse_args()
    torch.set_num_threads(1)
    callbacks: list[pl.Callback] = [Progress(every_n_steps=5)]
    if options.kill_at is not None:
        callbacks.append(SignalAt(options.kill_at, signal.SIGKILL))
    trainer = tiny_trainer(options.run, options.steps, callbacks)
    resume = find_resume(options.run) if options.resume else None
    trainer.fit(tiny_module(), tiny_data(options.data, num_workers=options.workers), ckpt_path=resume)


if __name__ == "__main__":
    main()
