"""A small but whole ``vpd-train``: real stages, loaders, checkpoints, metrics; and the comparison of two of them."""

import csv
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import torch

from vpd_lightning.commands import data
from vpd_lightning.training.checkpoint_files import load_checkpoint

TIMED = "rays_per_second"
popen: Any = subprocess.Popen  # the tests of these checks fork instead, which is quicker


def make_data(folder: Path) -> Path:
    """Generate the tiny tossed block, ray cast; no GL needed."""
    words = ["generate", "scene=mujoco_block", "preset=tiny", f"out={folder}", "seed=0", "num_frames=10"]
    if not folder.is_dir() and data.main([*words, "camera.height=32", "camera.width=32"]) != 0:
        raise RuntimeError(f"no data could be generated in {folder}")
    return folder


def words(folder: Path, run: Path, steps: int, *more: str) -> list[str]:
    """What to ``vpd-train`` for a few updates a second."""
    return [
        "experiment=tiny", f"data.folder={folder}", f"run.folder={run}", f"trainer.max_steps={steps}",
        "trainer.val_check_interval=20", "trainer.log_every_n_steps=1", "callbacks.keep_checkpoints.every_n_steps=3",
        "callbacks.draw_rollouts=null", "callbacks.progress.every_n_steps=1", "logger=csv", "num_threads=1",

        "encoder.num_particles=64", "data.rays_per_step=16", "scene.input_views=[0,1,2]", *more,
    ]  # fmt: skip


def environment(**more: str) -> dict[str, str]:
    """Imports as here, one thread."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1", **more}


def start(arguments: list[str], *prefix: str, **options: Any) -> subprocess.Popen[str]:
    """Start ``vpd-train`` (or a module that takes its words) in a process group of its own."""
    module = prefix or ("vpd_lightning.commands.train",)
    command = [sys.executable, "-m", *module, *arguments]
    settings = {"env": environment(), "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return popen(command, start_new_session=True, **{**settings, **options})


def run(arguments: list[str], **options: Any) -> str:
    """Train to the end and return what was printed."""
    process = start(arguments, **options)
    output, _ = process.communicate(timeout=600)
    if process.returncode != 0:
        raise RuntimeError(f"vpd-train ended with {process.returncode}:\n{output[-3000:]}")
    return output


def members(group: int) -> list[int]:
    """Return the processes of a group that are alive."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            fields = (entry / "stat").read_text().rsplit(")", 1)[1].split()
        except OSError:
            continue
        if int(fields[2]) == group and fields[0] != "Z":
            found.append(int(entry.name))
    return found


def kill_group(group: int) -> None:
    """End whatever is left of a group."""
    for process in members(group):
        os.kill(process, signal.SIGKILL)


def metrics(run: Path) -> list[dict[str, str]]:
    """Everything but the time that a step took."""
    with (run / "metrics.csv").open(newline="") as stream:
        return [{key: value for key, value in row.items() if key != TIMED} for row in csv.DictReader(stream)]


def differences(a: Path, b: Path) -> list[str]:
    """Name what differs, in any bit, between the results of two runs: weights, optimiser, schedules, metrics."""
    found = []
    first, second = (load_checkpoint(folder / "checkpoints" / "last.ckpt") for folder in (a, b))
    for loaded in (first, second):
        loaded["callbacks"].pop("TimeBudget", None)  # how long it took
    for part in ("state_dict", "optimizer_states", "lr_schedulers", "callbacks", "loops", "global_step"):
        if not is_equal(first[part], second[part]):
            found.append(part)
    if metrics(a) != metrics(b):
        found.append("metrics.csv")
    return found


def is_equal(a: Any, b: Any) -> bool:
    """Whether plain containers hold the same, tensors bit for bit."""
    if isinstance(a, torch.Tensor):
        return isinstance(b, torch.Tensor) and a.dtype == b.dtype and torch.equal(a, b)
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(is_equal(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(is_equal(x, y) for x, y in zip(a, b, strict=True))
    return bool(a == b)
