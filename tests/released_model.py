"""Runs with figures, as training and evaluation leave them, of small models that learned nothing."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from tests.evaluation.untrained_model import write_untrained
from vpd_lightning.config import build_simulator, compose
from vpd_lightning.release.release_folder import sha256
from vpd_lightning.simulator import Simulator
from vpd_lightning.training.checkpoint_files import write_checkpoint
from vpd_lightning.types import Cameras

SIZE = 16


def write_run(run: Path, data: Path) -> Path:
    """Write a run folder with a checkpoint, its figures, its time and its environment; return the checkpoint."""
    checkpoint = write_untrained(run, data, f"run.folder='{run}'")
    (run / "evaluation").mkdir()
    (run / "evaluation" / "metrics.json").write_text(json.dumps(figures(checkpoint, data)))
    time = {"seconds": 301.5, "seconds_before": 0.0, "clock": "cpu", "steps": 7, "minutes_allowed": 5}
    (run / "training_time.json").write_text(json.dumps(time))
    environment = {
        "versions": {"python": "3.11.7", "torch": "2.13.0"},
        "devices": ["cpu: x86_64, 1 threads in use"],
        "git_commit": "0123abc",
        "command": ["/home/somebody/.venv/bin/vpd-train", "experiment=tiny"],
    }
    (run / "environment.json").write_text(json.dumps(environment))
    return checkpoint


def write_slotformer(run: Path) -> Path:
    """Write a run folder with a checkpoint of a system without particles; return the checkpoint."""
    words = (
        "experiment=mujoco_block", "model=slotformer", "data.folder=datasets/boxes", f"model.savi.resolution={SIZE}",
        "model.savi.encoder_first_stride=1", "model.savi.decoder_start_resolution=2",
    )  # fmt: skip
    config = compose("train", words)
    torch.manual_seed(0)
    system = build_simulator(config)
    weights = {f"simulator.{name}": value for name, value in system.state_dict().items()}
    path = run / "checkpoints" / "last.ckpt"
    write_checkpoint({"state_dict": weights, "hyper_parameters": config, "global_step": 3}, path)
    return path


def figures(checkpoint: Path, data: Path) -> dict[str, Any]:
    """The part of ``metrics.json`` that a card shows, with absolute paths as ``vpd-eval`` writes them."""

    def block(mean: float) -> dict[str, Any]:
        ends = [0.99 * mean, 1.01 * mean]
        return {"mean": mean, "ci95": ends, "per_step": [mean] * 3, "input_views": mean, "other_views": None}

    def images(scale: float) -> dict[str, Any]:
        return {"psnr": block(25.125 * scale), "psnr_moving": block(19.5 * scale), "ssim": block(0.75 * scale)}

    return {
        "format_version": 1,
        "model": "custom",
        "checkpoint": str(checkpoint.absolute()),
        "checkpoint_sha256": sha256(checkpoint.read_bytes()),
        "data": str(data.absolute()),
        "data_sha256": "ab" * 32,
        "protocol": {
            "split": "test", "num_trajectories": 4, "num_clips": 8, "num_steps": 3, "num_views": 2, "input_views": [0],
        },
        **images(1.0),
        "chamfer": block(0.0388),
        "motion": None,
        "references": {"copy_last": images(0.9), "train_mean": images(0.8)},
    }  # fmt: skip


def predict(simulator: Simulator) -> torch.Tensor:
    """Predict two steps of a fixed synthetic scene from its one camera."""
    scene = simulator.encode(*synthetic_frames(2, 1), cameras(1))
    return simulator.render(simulator.rollout(scene, num_steps=2), cameras(1))


def synthetic_frames(
    *shape: int, size: int = SIZE, width: int | None = None, distance: float = 1.5
) -> tuple[torch.Tensor, torch.Tensor]:
    """Colours at random and a level ground near what ``cameras`` look at, always the same, with these leading axes."""
    generator = torch.Generator().manual_seed(0)
    picture = (*shape, size, width or size)
    rgb = torch.randint(0, 256, (*picture, 3), generator=generator, dtype=torch.uint8)
    return rgb, torch.full(picture, 0.95 * distance)


def cameras(
    *shape: int,
    size: int = SIZE,
    width: int | None = None,
    center: Sequence[float] = (0.0, 0.0, 0.0),
    distance: float = 1.5,
) -> Cameras:
    """Cameras at ``distance`` (metres) above ``center``, looking down, with these leading axes."""
    across = width or size
    intrinsics = torch.tensor([[size, 0.0, across / 2], [0.0, size, size / 2], [0.0, 0.0, 1.0]])
    pose = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    pose[:3, 3] = torch.tensor(center) + torch.tensor([0.0, 0.0, distance])
    return Cameras(intrinsics.expand(*shape, 3, 3), pose.expand(*shape, 4, 4), size, across)
