"""A rank whose scene has nothing in it takes part: every weight that a full scene teaches gets a gradient there, too.

Data-parallel training waits for the gradient of each weight from each rank; one that is missing is a deadlock.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.data.recordings import write_recordings
from vpd_lightning.config import build, build_list, build_simulator, compose
from vpd_lightning.data.datamodule import VideoDataModule
from vpd_lightning.losses.base import AbstractLoss
from vpd_lightning.training.module import VPDModule
from vpd_lightning.training.optimization import AbstractOptimization
from vpd_lightning.types import RGBDFrames, VideoBatch

MODELS = ["vpd", "inertial", "inertial_gnn", "persistence", "global"]


def module_and_batch(data: Path, model: str) -> tuple[VPDModule, VideoBatch]:
    size = ["encoder.height=16", "encoder.width=16"] if model == "global" else ["encoder.num_particles=32"]
    words = [f"model={model}", f"data.folder={data}", "scene.input_views=[0]", *size]
    config = compose("train", ["experiment=tiny", *words, "data.rays_per_step=8", "run.folder=nowhere"])
    torch.manual_seed(0)
    module = VPDModule(
        simulator=build_simulator(config),
        losses=build_list(config["loss"], AbstractLoss, "loss"),
        optimization=build(config["optimizer"], AbstractOptimization, "optimizer"),
        config=config,
    )
    datamodule = build(config["data"], VideoDataModule, "data")
    datamodule.setup("fit")
    return module, next(iter(datamodule.loader(1)))


def flat(frames: RGBDFrames) -> RGBDFrames:
    """A floor and nothing else."""
    return replace(frames, depth=torch.full_like(frames.depth, 1.5), rgb=torch.full_like(frames.rgb, 90))


def nearly_blind(frames: RGBDFrames) -> RGBDFrames:
    """One measured pixel in each view."""
    depth = torch.zeros_like(frames.depth)
    depth[..., 8, 8] = 1.5
    return replace(frames, depth=depth)


def learned(module: VPDModule, batch: VideoBatch) -> dict[str, Any]:
    module.zero_grad(set_to_none=True)
    output = module.simulator(batch)
    torch.stack([loss.weight * loss(output, batch) for loss in module.losses]).sum().backward()
    return {name: p.grad for name, p in module.simulator.named_parameters() if p.grad is not None}


@pytest.mark.parametrize("harm", [flat, nearly_blind])
@pytest.mark.parametrize("model", MODELS)
def test_an_empty_scene_teaches_the_same_weights_as_a_full_one(tmp_path: Path, model: str, harm: Any) -> None:
    module, batch = module_and_batch(write_recordings(tmp_path), model)
    full = learned(module, batch)
    future = None if batch.future is None else harm(batch.future)

    empty = learned(module, replace(batch, context=harm(batch.context), future=future))

    assert full and full.keys() == empty.keys()
    assert all(torch.isfinite(gradient).all() for gradient in empty.values())
