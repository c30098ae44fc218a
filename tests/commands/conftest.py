"""A tiny data set and a short training of it, made once for all tests of commands."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from data_gen.generate import generate
from tests.shared_folder import made_once
from vpd_lightning.commands import train

SMALL = {"num_frames": 10, "camera.num_views": 3, "camera.height": 32, "camera.width": 32}


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three cameras of 32x32, ten frames of a tossed block, ray cast."""
    return made_once(
        tmp_path_factory,
        "tiny_data",
        lambda folder: generate("mujoco_block", "tiny", folder, seed=0, workers=1, overrides=SMALL),
    )


@pytest.fixture(scope="session")
def quick(dataset: Path) -> list[str]:
    """Words that make ``vpd-train`` do two small steps."""
    return [
        "experiment=tiny", f"data.folder={dataset}", "trainer.max_steps=2", "trainer.val_check_interval=2",
        "callbacks.keep_checkpoints.every_n_steps=1", "callbacks.draw_rollouts=null", "logger=csv",
        "encoder.num_particles=64", "data.rays_per_step=16", "num_threads=1", "scene.input_views=[0,1,2]",
        "renderer.net_width=8", "renderer.num_coarse_samples=4", "renderer.num_fine_samples=4",
        "protocol.num_long_steps=4", "protocol.num_steps=2",
    ]  # fmt: skip


@pytest.fixture(scope="session")
def trained(quick: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of a training of two steps; do not write into it."""

    def make(folder: Path) -> None:
        assert train.main([*quick, f"run.folder={folder}"]) == 0

    return made_once(tmp_path_factory, "tiny_run", make)


@pytest.fixture
def in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Work in a folder of one's own: commands write below the current one."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def fails(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run a command that must fail; return its message after checking that it is one."""

    def check(main: Callable[[list[str]], int], words: list[str], code: int) -> str:
        before = set(os.listdir("."))
        assert main(words) == code
        captured = capsys.readouterr()
        message = captured.err
        assert message.startswith("error: "), captured
        assert "Traceback" not in message
        assert len(message.strip().splitlines()) <= 5, message
        left = set(os.listdir(".")) - before
        assert not left, f"a command that failed left {left} behind"
        return message

    return check
