"""The commands that README and docs print: all are composed, and those that take seconds run in order, as printed.

What is long gets words behind it that shrink it (``RUN``); what does not run here is in ``NOT_RUN`` with the reason. It
is composed all the same, so that a key or an option that is gone is found. A command that stands in neither fails.
"""

import importlib.util
import json
import re
import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from data_gen.generate import make_plan
from tests.data_gen.importers import known_scene, plain_recording
from tests.documents.printed import ROOT, Command, commands
from vpd_lightning.commands import data, eval, export, info, render, report, train
from vpd_lightning.config import compose
from vpd_lightning.config.composing import expand_sweep

pytestmark = pytest.mark.documents
MAINS = {
    "vpd-train": train.main, "vpd-eval": eval.main, "vpd-render": render.main, "vpd-data": data.main,
    "vpd-export": export.main, "vpd-report": report.main, "vpd-info": info.main,
}  # fmt: skip
COMMANDS = {command.text: command for command in commands()}

TRAINING = (
    "trainer.max_steps=1 trainer.val_check_interval=1 data.num_validation_clips=1 data.batch_size=1 data.num_steps=2 "
    "data.num_steps_schedule=null data.rays_per_step=16 encoder.num_particles=64 logger=csv "
    "callbacks.draw_rollouts=null"
)
LIGHT = " light_fit.num_pairs=1 light_fit.num_updates=1"  # of model=inertial alone
EVALUATION = "protocol.num_trajectories=1 protocol.num_steps=2 protocol.num_long_steps=2 num_videos=0"
FILM = "num_steps=1 height=16 width=16"
# What runs, in this order, and what is put behind it.
RUN = {
    "vpd-info": "",
    "vpd-info --json": "",
    "vpd-data generate scene=mujoco_block preset=demo out=datasets/mujoco_block_demo": (
        "splits.train=2 splits.validation=1 splits.test=1 renderer=raycast workers=1"
    ),
    "vpd-data validate datasets/mujoco_block_demo": "",
    "vpd-data inspect datasets/mujoco_block_demo": "",
    "vpd-eval ckpt=released/mujoco_block_demo": EVALUATION,
    "vpd-render ckpt=released/mujoco_block_demo": FILM + " camera=[0]",
    "vpd-train experiment=tiny": TRAINING,
    "vpd-train experiment=demo": TRAINING + LIGHT + " run.folder=runs/demo/seed0",
    "vpd-train experiment=demo seed=1": TRAINING + LIGHT,
    "vpd-train resume=last": "",
    "vpd-eval ckpt=runs/demo/RUN/checkpoints/last.ckpt": EVALUATION,
    "vpd-eval ckpt=FILE 'change={renderer: {ray_chunk_size: 512}}'": EVALUATION,
    "vpd-render ckpt=FILE camera=path.json": "num_steps=1",
    "vpd-render ckpt=FILE edit=no_ball.yaml": FILM + " camera=[0]",
    "vpd-render ckpt=FILE save_particles=[npz,glb] out=films": FILM + " camera=[0]",
    "vpd-render ckpt=MODEL camera=ring": FILM,
    "vpd-report runs/mujoco_block": "",
    "vpd-export ckpt=runs/demo/seed0 out=released/demo": "",
    "vpd-eval ckpt=released/demo": EVALUATION,
    "vpd-data import recordings/table out=datasets/table": "height=48",
    "vpd-data inspect datasets/table": "",
    "vpd-data import recordings/table out=datasets/table height=128": "",
    "vpd-data validate datasets/table": "",
    "vpd-train experiment=recordings data.folder=datasets/table run.folder=runs/table": TRAINING + LIGHT,
    "vpd-eval ckpt=runs/table/checkpoints/last.ckpt": EVALUATION,
    "vpd-train experiment=recordings data.folder=datasets/table run.folder=runs/table_even_rays": TRAINING + LIGHT,
    "vpd-train experiment=recordings data.folder=datasets/table run.folder=runs/table_vpd ": TRAINING,
}
# What does not run here: how a command begins, and why. The first that fits counts.
NOT_RUN = {
    "make": "takes minutes; .ci/run goes through the targets",
    "source": "belongs to the shell of the reader",
    "export": "belongs to the shell of the reader",
    "mkdir": "of a package that is not installed here",
    "printf": "of a package that is not installed here",
    "pip install": "tests/integration/test_example_package.py installs it",
    "python": "needs a GPU, trained models or minutes; the module is looked for",
    "OMP_NUM_THREADS": "takes minutes; the module is looked for",
    "srun": "needs SLURM; tests/reliability has one",
    "vpd-view": "serves until it is stopped; tests/viewer starts it",
    "vpd-plan": "needs a model that takes actions; tests/commands/test_plan_command.py runs it",
    "vpd-bench": "takes minutes; tests/benchmarks runs the suites",
    "vpd-info | grep": "needs a shell",
    "VPD_DEBUG=1": "needs a shell",
    "vpd-train --config-dir": "needs a package that is not installed here; tests/integration/test_example_package.py",
    "vpd-train": "takes minutes to weeks; composed",
    "vpd-eval": "as the evaluations above, with other words; composed",
    "vpd-render": "as the films above, with other words; composed",
    "vpd-export": "as the exports above, with other words; composed",
    "vpd-report": "as the report above, of other folders",
    "vpd-data generate": "takes minutes, or Blender; planned",
    "vpd-data import": "as the import above, of another folder",
}


def printed(start: str) -> Command:
    """Return the command that is or begins with these words."""
    return COMMANDS.get(start) or next(command for text, command in COMMANDS.items() if text.startswith(start))


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what a reader has: released models, takes of two cameras, an edit, a camera file."""
    folder = tmp_path_factory.mktemp("documents")
    (folder / "released").mkdir()
    shutil.copytree(ROOT / "released" / "mujoco_block_demo", folder / "released" / "mujoco_block_demo")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plain_recording, "HEIGHT", 480)
        patch.setattr(plain_recording, "WIDTH", 640)
        for index, split in enumerate(("train", "validation", "test")):
            take = folder / "recordings" / "table" / f"take{index}"
            plain_recording.write_plain(take, num_frames=10, num_views=2, first=index, split=split)
    (folder / "no_ball.yaml").write_text("vpd_edit: 1\nedits:\n- {edit: delete, select: {cluster: {index: 0}}}\n")
    intrinsics, poses = known_scene.cameras(1, 16, 16)
    camera = {"intrinsics": intrinsics[0].tolist(), "cam_to_world": poses[0].tolist()}
    (folder / "path.json").write_text(json.dumps({"height": 16, "width": 16, "cameras": [camera]}))
    small = "num_frames=10 camera.num_views=4 camera.height=32 camera.width=32 renderer=raycast workers=1"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)  # experiment=tiny makes its own, with OpenGL
        words = ["generate", "scene=mujoco_block", "preset=tiny", "out=datasets/mujoco_block_tiny", *small.split()]
        assert data.main(words) == 0
    return folder


def test_commands_run_as_printed(
    place: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(place)
    failed = []
    for start, more in RUN.items():
        program, *words = printed(start).words
        if "import" in words:  # the same folder from other settings is refused
            shutil.rmtree("datasets/table", ignore_errors=True)
        words = ["runs/demo" if word == "runs/mujoco_block" else word for word in words]
        code = MAINS[program]([*words, *more.split()])
        said = capfd.readouterr()
        if code != 0:
            failed.append(f"{printed(start)} {more}\nended with {code}: {said.out[-600:]}{said.err[-600:]}")
    assert not failed, "\n\n".join(failed)
    assert json.loads(Path("runs/table/evaluation/metrics.json").read_text())["psnr"]["mean"] > 0
    assert np.load(next(Path("films").rglob("*.npz"))).files


def test_every_command_is_run_or_has_a_reason_why_not() -> None:
    ran = {printed(start).text for start in RUN}
    assert not [text for text in COMMANDS if text not in ran and not text.startswith(tuple(NOT_RUN))]
    assert not [start for start in NOT_RUN if not any(text.startswith(start) for text in COMMANDS if text not in ran)]


@pytest.mark.parametrize("text", [text for text in COMMANDS if "vpd-" in text.split("=")[0] + text.partition(" ")[2]])
def test_a_command_can_be_composed(text: str) -> None:
    words = COMMANDS[text].words
    words = words[next(index for index, word in enumerate(words) if word.startswith("vpd-")) :]
    asked = [word for flag, word in pairwise(words) if flag in ("--cfg", "--package", "--why")]
    program, *words = [word for word in words if not word.startswith("--") and word not in asked]
    command = program.removeprefix("vpd-")
    if command == "train":
        check_training(words)
    elif command == "data" and words[0] == "generate":
        _, settings = data.parse(words[1:])
        places = [settings.pop(key) for key in ("scene", "preset", "out")]
        seed, _ = settings.pop("seed", 0), settings.pop("workers", None)
        if "objects.mesh_folder" in settings:  # whose meshes are read at once
            settings.pop("objects.mesh_folder")
        make_plan(places[0], places[1], Path(places[2]), seed, settings, settings.pop("sensor", "none"))
    elif command in ("eval", "render", "view", "bench", "export", "plan"):
        compose(command, [re.sub(r"^(suite=\w+),.*", r"\1", word) for word in words])  # one of several suites


def check_training(words: list[str]) -> None:
    """Compose one run; the jobs of named sweeps are composed by ``tests/configs``."""
    if words == ["resume=last"]:
        return
    words = [word for word in words if not word.startswith("resume=")]
    for word in words:
        if word.startswith("sweep="):
            assert (ROOT / "conf" / "sweep" / f"{word.partition('=')[2]}.yaml").is_file()
    if any("drift" in word for word in words):  # of the package that tests/integration/test_example_package.py trains
        words = [word for word in words if not word.startswith("dynamics")]
    words = [word for word in words if not word.startswith(("sweep=", "-"))]
    if not any(word.startswith("experiment=") for word in words):
        words.insert(0, "experiment=mujoco_block")
    compose("train", expand_sweep("train", words)[0])


@pytest.mark.parametrize("text", [text for text in COMMANDS if text.startswith(("make ", "python ", "OMP_"))])
def test_a_target_and_a_module_are_there(text: str) -> None:
    words = COMMANDS[text].words
    if words[0] == "make":
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
        return
    if "-m" in words:
        assert importlib.util.find_spec(words[words.index("-m") + 1]) is not None
    assert all((ROOT / word).exists() for word in words if word.startswith(("tests/", "examples/")))
