"""What every generated world must keep: the same bytes whatever the number of workers, and after being killed."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from data_gen.settings import preset_names, scene_names
from tests.data_gen.blocks import contents
from tests.waiting import HANG, wait_until
from vpd_lightning.data.manifest import load_manifest

ROOT = Path(__file__).resolve().parents[2]
SMALL = ["splits.train=3", "splits.validation=1", "splits.test=1", "num_frames=4", "camera.num_views=2"]
# One scene of each family; soft bodies, random textures and meshes are what could differ between processes. The block's
# workers and kills are tested in test_generate.py, the same bytes of meshes in movi/test_pictures.py.
SCENES = [
    "deformable_collision",
    *(pytest.param(scene, marks=pytest.mark.exhaustive) for scene in ("mujoco_block", "movi_c")),
]


def start(scene: str, out: Path, workers: int, *words: str) -> subprocess.Popen[bytes]:
    """Run ``vpd-data generate`` as its own process group, with GL."""
    command = [sys.executable, "-m", "vpd_lightning.commands.data", "generate", f"scene={scene}", "preset=tiny"]
    environment = {**os.environ, "PYTHONPATH": f"{ROOT / 'src'}:{ROOT}"}
    environment.pop("MUJOCO_GL", None)
    return subprocess.Popen(
        [*command, f"out={out}", f"workers={workers}", "renderer=auto", *SMALL, *words],
        env=environment,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def finish(process: subprocess.Popen[bytes]) -> None:
    _, errors = process.communicate(timeout=HANG)
    assert process.returncode == 0, errors.decode()


def test_every_scene_of_the_paper_has_its_presets():
    wanted = {"mujoco_block", "deformable_block", "deformable_multi", "deformable_collision"}
    wanted |= {"movi_a", "movi_b", "movi_c", "movi_a_high", "movi_c_high"}

    assert wanted <= set(scene_names())
    for scene in wanted:
        assert {"paper", "tiny"} <= set(preset_names(scene)), scene


@pytest.mark.gl
@pytest.mark.slow
@pytest.mark.parametrize("scene", SCENES)
def test_workers_and_a_kill_change_nothing(scene: str, tmp_path: Path):
    whole = tmp_path / "whole"
    finish(start(scene, whole, workers=1))
    assert len(contents(whole)) == 5

    killed = tmp_path / "killed"
    process = start(scene, killed, workers=2)
    wait_until(lambda: list(killed.glob("*/*.h5")), process)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert contents(killed), "it was killed before the first file"
    finish(start(scene, killed, workers=2))

    assert contents(killed) == contents(whole)
    assert load_manifest(killed).digest == load_manifest(whole).digest
    assert not list(killed.rglob(".*"))
