"""What is said to the commonest mistakes, word for word: docs/errors.md holds it, for people and as a snapshot.

After a change of a message: ``VPD_WRITE_ERRORS=1 pytest tests/commands/test_common_mistakes.py``; read the diff.
"""

import os
import re
import shutil
import socket
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import h5py
import pytest
import torch

from data_gen.inspection.fault import Fault
from data_gen.inspection.split import split_dataset
from tests.data.recordings import write_recordings
from vpd_lightning.commands import data, eval, export, info, render, report, train, view
from vpd_lightning.data import busy
from vpd_lightning.data.manifest import load_manifest, write_manifest
from vpd_lightning.data.verdict import keep_verdict
from vpd_lightning.runs import run_claim

PAGE = Path(__file__).resolve().parents[2] / "docs" / "errors.md"
HEAD = """# Common mistakes, and what is said

Every message says what is wrong and what to do, in at most five lines; `debug=true` adds the traceback. This page is
written by `tests/commands/test_common_mistakes.py`, which makes each mistake.
"""
MAINS = {
    "vpd-train": train.main, "vpd-eval": eval.main, "vpd-render": render.main, "vpd-data": data.main,
    "vpd-export": export.main, "vpd-report": report.main, "vpd-info": info.main, "vpd-view": view.main,
}  # fmt: skip


@dataclass(frozen=True)
class Mistake:
    """What went wrong, the command as one would type it, its exit code, and what else is done before and printed."""

    title: str
    command: str
    code: int
    hidden: str = ""  # words that only make the test quick
    before: Callable[[pytest.MonkeyPatch], object] = field(default=lambda patch: None)


def _recording(patch: pytest.MonkeyPatch) -> None:
    Path("kitchen").mkdir(exist_ok=True)
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        (Path("kitchen") / name).touch()


def _occupied(patch: pytest.MonkeyPatch) -> None:
    Path("runs/mine").mkdir(parents=True)
    (Path("runs/mine") / run_claim.CLAIM).touch()
    patch.setattr(run_claim, "is_claimed", lambda folder: True)


def _out_of_memory(patch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: object, **options: object) -> None:
        raise MemoryError

    patch.setattr("vpd_lightning.simulator.Simulator.forward", fail)


def _no_gl(patch: pytest.MonkeyPatch) -> None:
    patch.setattr("data_gen.gl_backend.why_not", lambda backend: "its library is missing")


_HELD: list[socket.socket] = []


def _taken_port(patch: pytest.MonkeyPatch) -> None:
    _HELD.append(socket.socket())
    with suppress(OSError):  # taken already: as well
        _HELD[-1].bind(("127.0.0.1", 8765))
        _HELD[-1].listen()


def _typo_in_edit(patch: pytest.MonkeyPatch) -> None:
    Path("typo.yaml").write_text("vpd_edit: 1\nedits:\n- {edit: delete, select: {clustr: {index: 0}}}\n")


def _cut_data(patch: pytest.MonkeyPatch) -> None:
    shutil.copytree("datasets/tiny", "datasets/cut")
    for path in Path("datasets/cut/train").glob("*.h5"):
        path.write_bytes(path.read_bytes()[:1000])


def _damaged(patch: pytest.MonkeyPatch) -> None:
    content = Path("runs/trained/checkpoints/last.ckpt").read_bytes()
    Path("damaged.ckpt").write_bytes(content[:-5000] + bytes(100) + content[-4900:])
    Path("cut.ckpt").write_bytes(content[:5000])


def _lightning_checkpoint(patch: pytest.MonkeyPatch) -> None:
    torch.save({"state_dict": {}, "pytorch-lightning_version": "1.0"}, "other.ckpt")


def _not_validated(patch: pytest.MonkeyPatch) -> None:
    shutil.copytree("datasets/tiny", "datasets/table")
    manifest = load_manifest("datasets/table")
    write_manifest(replace(manifest, generator="vpd-data import, format plain"))


def _failed_validation(patch: pytest.MonkeyPatch) -> None:
    keep_verdict(load_manifest("datasets/table"), [Fault("views_disagree", "train/000003.h5", _DISAGREE)])


def _busy_file(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(busy, "_programs", lambda path, writing: ["jupyter-lab (process 4711)"])
    shutil.copytree("datasets/tiny", "datasets/busy")
    _OPEN.append(h5py.File("datasets/busy/train/000000.h5"))


def _divided_anew(patch: pytest.MonkeyPatch) -> None:
    shutil.copytree("datasets/tiny", "datasets/divided")
    split_dataset("datasets/divided", validation=2, test=4, seed=1)


QUICK = "QUICK"
_OPEN: list[h5py.File] = []
_DISAGREE = "points seen twice are 4 % of their depth apart (median); it would be 0.1 % if depth is a distance"
MISTAKES = [
    Mistake("A key that is spelt wrong", "vpd-train experiment=tiny encoder.num_particle=64", 2),
    Mistake("A key in another section", "vpd-train experiment=tiny trainer.batch_size=4", 2),
    Mistake("A word where a number belongs", "vpd-train experiment=tiny seed=abc", 2),
    Mistake("An experiment that does not exist", "vpd-train experiment=tinny", 2),
    Mistake("A stage that does not exist", "vpd-train experiment=tiny renderer=nerf", 2),
    Mistake("A flag that does not exist", "vpd-train --fast experiment=tiny", 2),
    Mistake("Several values without -m", "vpd-train experiment=tiny seed=1,2", 2),
    Mistake("Stages that do not fit together", "vpd-train experiment=tiny dynamics.feature_dim=8", 2),
    Mistake("A class from elsewhere", "vpd-train experiment=tiny encoder._target_=os.system", 2),
    Mistake("A GPU where there is none", "vpd-train experiment=tiny trainer=gpu", 2, QUICK + " trainer=gpu"),
    Mistake("A sweep over runs with several devices", "vpd-train -m experiment=tiny seed=1,2 trainer.devices=2", 2),
    Mistake("Data that were not generated yet", "vpd-train experiment=mujoco_block trainer=cpu", 3),
    Mistake("A data folder that is not there", "vpd-train data.folder=mine trainer=cpu", 3),
    Mistake("A folder where an option belongs", "vpd-train experiment=tiny data=datasets/mine", 2),
    Mistake("A folder without a key", "vpd-train experiment=tiny datasets/mine", 2),
    Mistake("A data file that was cut short", "vpd-train data.folder=datasets/cut", 3, QUICK, _cut_data),
    Mistake(
        "A data folder that is spelt wrong", "vpd-train experiment=tiny data.folder=datasets/tinny", 3, QUICK,
    ),
    Mistake(
        "Recordings that were never validated", "vpd-train data.folder=datasets/table", 3, QUICK, _not_validated,
    ),
    Mistake(
        "Recordings that failed validation", "vpd-train data.folder=datasets/table", 3, QUICK, _failed_validation,
    ),
    Mistake("A data file that another program holds", "vpd-train data.folder=datasets/busy", 3, QUICK, _busy_file),
    Mistake("A camera that is not there", "vpd-train experiment=tiny scene.input_views=[0,7]", 3, QUICK),
    Mistake("Clips longer than the recordings", "vpd-train experiment=tiny data.num_steps=40", 3, QUICK),
    Mistake(
        "A workspace without a point",
        "vpd-train experiment=tiny scene.workspace_min=[50,50,50] scene.workspace_max=[51,51,51]", 3, QUICK,
    ),
    Mistake("Memory that runs out", "vpd-train experiment=tiny", 5, QUICK, _out_of_memory),
    Mistake("A run folder that exists", "vpd-train experiment=tiny run.folder=runs/trained", 2, QUICK),
    Mistake("A run folder that another run has taken", "vpd-train run.folder=runs/mine", 2, QUICK, _occupied),
    Mistake("Nothing to resume", "vpd-train resume=last", 4),
    Mistake("resume=auto without a folder", "vpd-train experiment=tiny resume=auto", 2),
    Mistake("No checkpoint given", "vpd-eval", 2),
    Mistake("A checkpoint without a key", "vpd-eval runs/mine", 2),
    Mistake("A checkpoint that is not there", "vpd-eval ckpt=nowhere.ckpt", 4),
    Mistake("A checkpoint that was cut short", "vpd-eval ckpt=cut.ckpt", 4, "", _damaged),
    Mistake("A checkpoint that is damaged", "vpd-eval ckpt=damaged.ckpt", 4, "", _damaged),
    Mistake("A checkpoint of another program", "vpd-eval ckpt=other.ckpt", 4, "", _lightning_checkpoint),
    Mistake("A split that does not exist", "vpd-eval ckpt=runs/trained protocol.split=testing", 2),
    Mistake(
        "Trajectories that were trained on",
        "vpd-eval ckpt=runs/trained data.folder=datasets/divided", 3, before=_divided_anew,
    ),
    Mistake("More steps than were recorded", "vpd-eval ckpt=runs/trained protocol.num_steps=50", 3),
    Mistake("A device that is not there", "vpd-eval ckpt=runs/trained device=cuda:77", 2),
    Mistake("A film into a folder that is there", "vpd-render ckpt=runs/trained out=runs", 2),
    Mistake("No GL", "vpd-data generate scene=mujoco_block preset=tiny out=made renderer=auto", 3, "", _no_gl),
    Mistake("A preset that does not exist", "vpd-data generate scene=mujoco_block preset=tinny out=made", 2),
    Mistake("A recording of no known kind", "vpd-data import runs out=made", 3),
    Mistake("A recording that was not imported", "vpd-data inspect kitchen", 3, before=_recording),
    Mistake("A model that was not evaluated", "vpd-export ckpt=runs/trained out=released/mine", 2),
    Mistake("A report about nothing", "vpd-report runs", 3),
    Mistake("A port that something listens on", "vpd-view ckpt=runs/trained port=8765", 2, before=_taken_port),
    Mistake("An edit that is not there", "vpd-render ckpt=runs/trained edit=no_ball.yaml", 2),
    Mistake("A typo in an edit", "vpd-render ckpt=runs/trained edit=typo.yaml", 2, before=_typo_in_edit),
    Mistake("An option that vpd-info does not have", "vpd-info --jsn", 2),
]  # fmt: skip


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, dataset: Path, trained: Path) -> Path:
    folder = tmp_path_factory.mktemp("mistakes")
    shutil.copytree(dataset, folder / "datasets" / "tiny")
    shutil.copytree(trained, folder / "runs" / "trained")
    write_recordings(folder / "datasets" / "recordings")
    return folder


def said(
    mistake: Mistake,
    place: Path,
    dataset: Path,
    quick: list[str],
    patch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> str:
    """Make the mistake and return what stderr says, without the places of this machine."""
    patch.chdir(place)
    mistake.before(patch)
    name, *words = mistake.command.split()
    hidden = mistake.hidden.split()
    if hidden[:1] == [QUICK]:
        given = {word.split("=")[0] for word in words}
        words = [*[word for word in quick if word.split("=")[0] not in given], *words, *hidden[1:]]
    code = MAINS[name](words)
    message = capsys.readouterr().err.strip()
    assert code == mistake.code, message
    for path, label in ((place, "."), (dataset, "datasets/tiny")):
        message = message.replace(str(path), label)
    return re.sub(r"(no device '[^']*'): .*", r"\1: ...", message)  # the reason is PyTorch's, of its build


def section(mistake: Mistake, message: str) -> str:
    return f"\n## {mistake.title}\n\n```\n$ {mistake.command}\n{message}\n```\n"


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.title)
def test_the_message_is_the_one_of_the_page(
    mistake: Mistake,
    place: Path,
    dataset: Path,
    quick: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if "trainer=gpu" in mistake.command and torch.cuda.is_available():
        pytest.skip("there is a GPU")
    message = said(mistake, place, dataset, quick, monkeypatch, capsys)

    assert message.startswith("error: ") and len(message.splitlines()) <= 5
    if os.environ.get("VPD_WRITE_ERRORS"):
        begin = HEAD if mistake is MISTAKES[0] else PAGE.read_text()
        PAGE.write_text(begin + section(mistake, message))
    assert section(mistake, message) in PAGE.read_text()


def test_the_page_holds_every_mistake_and_no_other() -> None:
    titles = re.findall(r"^## (.*)$", PAGE.read_text(), re.M)
    assert titles == [mistake.title for mistake in MISTAKES]
    assert len(titles) >= 30
