"""A checkpoint as training writes it, of a small model that has learned nothing and lets nothing move."""

from pathlib import Path

import torch

from vpd_lightning.config import build_simulator, compose
from vpd_lightning.training.checkpoint_files import write_checkpoint

OVERRIDES = (
    "scene=tiny",
    "encoder=unet_small",
    "dynamics=persistence",
    "renderer=point_nerf_small",
    "encoder.channels=[4,8,4]",
    "encoder.num_particles=300",
    "renderer.num_coarse_samples=4",
    "renderer.num_fine_samples=4",
    "feature_dim=4",
    "scene.input_views=[0]",
    "protocol=tiny",
    "protocol.num_steps=3",
)


def write_untrained(run: Path, data: Path, *overrides: str) -> Path:
    """Write ``checkpoints/last.ckpt`` in a run folder and return its path."""
    config = compose("train", [*OVERRIDES, f"data.folder='{data}'", *overrides])
    torch.manual_seed(0)
    simulator = build_simulator(config)
    weights = {f"simulator.{name}": value for name, value in simulator.state_dict().items()}
    path = run / "checkpoints" / "last.ckpt"
    write_checkpoint({"state_dict": weights, "hyper_parameters": config, "global_step": 7}, path)
    return path
