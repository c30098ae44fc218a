"""What is timed: a simulator, its optimiser and real batches, composed from the project's own configuration."""

from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import torch

from data_gen.generate import generate
from vpd_lightning.config import build, build_list, build_simulator, compose
from vpd_lightning.losses.base import AbstractLoss
from vpd_lightning.simulator import Simulator
from vpd_lightning.training.optimization import AbstractOptimization
from vpd_lightning.types import VideoBatch

NUM_TRAJECTORIES, NUM_FRAMES = 4, 16


@dataclass(frozen=True)
class Workload:
    """One size: words of a ``vpd-train`` command line, and the preset of the data it is fed with."""

    name: str
    preset: str
    words: Sequence[str]


# The paper's model (its UNet, ten message passing steps, widths and sample counts reduced), 128x128 pixels.
MID = Workload(
    "mid",
    "paper",
    (
        "experiment=mujoco_block",
        "encoder.channels=[32,64,128,256,256,128,64,32,16]",
        "encoder.num_particles=4096",
        "dynamics.num_abstract_nodes=256",
        "dynamics.message_passing_steps=5",
        "dynamics.hidden_dim=64",
        "renderer=point_nerf_small",
        "renderer.num_neighbors=16",
        "renderer.net_width=64",
        "renderer.num_coarse_samples=32",
        "renderer.num_fine_samples=32",
        "model.checkpoint_dynamics=false",
        "data.batch_size=1",
        "data.num_steps=4",
        "data.rays_per_step=128",
    ),
)
DEMO = Workload("demo", "demo", ("experiment=demo",))
# The paper's graph network and volume renderer where the demo has its own: the same data, batch and rays.
DEMO_PAPER_STAGES = Workload(
    "demo_paper_stages",
    "demo",
    ("experiment=demo", "dynamics=hierarchical_gnn_small", "renderer=point_nerf_small"),
)
TINY = Workload("tiny", "tiny", ("experiment=tiny",))
WORKLOADS = {workload.name: workload for workload in (TINY, DEMO, DEMO_PAPER_STAGES, MID)}


@dataclass(frozen=True)
class Training:
    """Everything one training step needs."""

    config: dict[str, Any]
    simulator: Simulator
    losses: Sequence[AbstractLoss]
    optimizer: torch.optim.Optimizer
    batch: VideoBatch


def prepare(workload: Workload, scratch: Path, device: torch.device, words: Sequence[str] = ()) -> Training:
    """Generate a little data below ``scratch`` and build the training; the same weights and batch every time."""
    folder = scratch / workload.preset
    with redirect_stdout(StringIO()):
        generate(
            scene="mujoco_block",
            preset=workload.preset,
            out=folder,
            seed=0,
            renderer="raycast",
            workers=1,
            overrides={
                "splits.train": NUM_TRAJECTORIES,
                "splits.validation": 1,
                "splits.test": 1,
                "num_frames": NUM_FRAMES,
            },
        )
    fixed = (f"data.folder={folder}", "data.num_workers=0", "data.num_trajectories=null", "data.num_validation_clips=0")
    config = compose("train", [*workload.words, *words, *fixed])
    torch.manual_seed(0)
    datamodule = build(config["data"], None, "data")
    simulator = build_simulator(config)
    if simulator.encoder.background is not None:
        simulator.encoder.background.fit(*datamodule.median_background())
    simulator = simulator.to(device).train()
    optimization = build(config["optimizer"], AbstractOptimization, "optimizer")
    optimizer, _ = optimization.build(simulator, config["trainer"]["max_steps"])
    batch = next(iter(datamodule.loader(max_steps=1))).to(device)
    return Training(config, simulator, build_list(config["loss"], AbstractLoss, "loss"), optimizer, batch)
