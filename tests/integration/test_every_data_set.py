"""Every data set of the paper: generated, trained on for a moment, evaluated; from an empty folder to metrics.json."""

import json
import math
from pathlib import Path
from typing import Any

import pytest

from data_gen.generate import generate
from vpd_lightning.commands import eval as evaluation
from vpd_lightning.commands import train
from vpd_lightning.config import compose

NEEDS_GL = ["deformable_collision", "movi_c"]  # one of each family; the others are the same code with other settings
OTHERS = ["deformable_block", "deformable_multi", "movi_a", "movi_b", "movi_a_high", "movi_c_high"]
EXPERIMENTS = [
    "mujoco_block",
    *(pytest.param(name, marks=pytest.mark.gl) for name in NEEDS_GL),
    *(pytest.param(name, marks=[pytest.mark.gl, pytest.mark.exhaustive]) for name in OTHERS),
]
SMALL = {
    "splits.train": 2, "splits.validation": 1, "splits.test": 1,
    "num_frames": 6, "camera.height": 32, "camera.width": 32,
}  # fmt: skip
# Two steps of everything that the tiny budget has, with fewer rays and samples.
QUICK = [
    "trainer.max_steps=2", "trainer.val_check_interval=2", "callbacks.keep_checkpoints.every_n_steps=2",
    "callbacks.draw_rollouts=null", "logger=csv", "num_threads=1", "data.num_validation_clips=1",
    "encoder.num_particles=128", "data.rays_per_step=16",
]  # fmt: skip


def numbers(tree: Any) -> list[float]:
    """All numbers of nested lists and mappings."""
    if isinstance(tree, dict):
        return [number for value in tree.values() for number in numbers(value)]
    if isinstance(tree, list):
        return [number for value in tree for number in numbers(value)]
    return [tree] if isinstance(tree, int | float) and not isinstance(tree, bool) else []


def check_run(run: Path) -> None:
    """Evaluate the run's last checkpoint: the figures must be there, and be numbers."""
    assert evaluation.main([f"ckpt={run}/checkpoints/last.ckpt", "num_videos=0", "num_threads=1"]) == 0

    metrics = json.loads((run / "evaluation" / "metrics.json").read_text())
    assert metrics["protocol"]["num_steps"] == 4
    assert len(metrics["psnr"]["per_step"]) == 4
    assert 3.0 < metrics["psnr"]["mean"] < 50.0  # two steps: anything but broken
    assert metrics["chamfer"]["mean"] > 0
    assert all(math.isfinite(number) for number in numbers(metrics)), metrics


@pytest.fixture
def in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_experiment_learns_from_its_data_set_and_is_evaluated(experiment: str, in_folder: Path):
    words = [f"experiment={experiment}", "budget=tiny", "run.folder=run", *QUICK]
    wanted = compose("train", words)
    generate(wanted["generate"]["scene"], "tiny", wanted["data"]["folder"], seed=0, workers=1, overrides=SMALL)

    assert train.main(words) == 0

    check_run(in_folder / "run")


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.gl
def test_training_makes_its_data_set_in_an_empty_folder(in_folder: Path, capsys: pytest.CaptureFixture[str]):
    words = ["experiment=mujoco_block", "budget=tiny", "run.folder=run", "num_threads=1"]

    assert train.main([*words, "trainer.max_steps=3", "callbacks.draw_rollouts=null"]) == 0

    assert "making it: vpd-data generate scene=mujoco_block preset=tiny" in capsys.readouterr().out
    assert (in_folder / "datasets" / "mujoco_block_tiny" / "dataset.json").is_file()
    check_run(in_folder / "run")
