"""Runs of a multirun that a launcher takes to processes of their own."""

import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.reliability.trainings import start
from tests.waiting import HANG
from vpd_lightning.config.explaining import _explain_missing_option

LAUNCHER = ["-m", "hydra/launcher=submitit_local", "hydra.launcher.timeout_min=5"]


def multirun(words: Sequence[str], folder: Path) -> tuple[int, str]:
    pytest.importorskip("submitit")
    process = start([*LAUNCHER, *words], cwd=folder, stderr=subprocess.STDOUT)
    output, _ = process.communicate(timeout=HANG)
    return process.returncode, output


@pytest.mark.slow
@pytest.mark.launcher
def test_each_run_has_a_process_and_a_folder(quick: list[str], in_folder: Path):
    code, output = multirun([*quick, "seed=0,1"], in_folder)

    assert code == 0, output
    assert len(list(in_folder.glob("runs/tiny/*/checkpoints/last.ckpt"))) == 2


@pytest.mark.slow
@pytest.mark.exhaustive
@pytest.mark.launcher
def test_a_run_that_fails_elsewhere_fails_here(quick: list[str], in_folder: Path):
    code, output = multirun([*quick, "data.num_steps=40"], in_folder)

    assert code == 3
    assert "10 frames, but a clip needs 42" in output


def test_a_launcher_that_is_not_installed_is_named_with_its_package():
    error = _explain_missing_option("hydra/launcher/submitit_slurm", ["basic"], [])

    assert "pip install 'vpd-lightning[slurm]'" in str(error)
