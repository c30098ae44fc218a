"""Bad input gets a named error of at most five lines and its own exit code, and leaves nothing behind."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import h5py
import pytest

from vpd_lightning.commands import data, eval, render, train

Fails = Callable[..., str]

# Words for vpd-train, and what the message must say. None of these reaches the data.
BAD_CONFIGURATIONS = {
    "unknown key": (["encoder.num_particle=3"], "Did you mean encoder.num_particles?"),
    "unknown key at the root": (["sed=1"], "Did you mean seed?"),
    "unknown section": (["rendrer.near=1"], "Did you mean renderer.near?"),
    "key of another section": (["trainer.batch_size=4"], "Did you mean data.batch_size?"),
    "word for a number": (["seed=abc"], "seed has the wrong type"),
    "word for a stage's number": (["encoder.num_particles=many"], "encoder.num_particles has the wrong type"),
    "fraction for a count": (["data.batch_size=1.5"], "data.batch_size has the wrong type"),
    "no such precision": (["trainer.precision=half"], "64-true or 64, 32, 16, bf16 or null or auto"),
    "number for a list": (["scene.kernel_radii=3"], "scene.kernel_radii has the wrong type"),
    "unknown experiment": (["experiment=tinny"], "Did you mean tiny?"),
    "unknown option": (["renderer=nerf"], "there is no option of renderer called nerf"),
    "added key": (["+encoder.dropout=0.1"], "behind the schema's back"),
    "forced key": (["++seed=1"], "behind the schema's back"),
    "removed key": (["~scene"], "behind the schema's back"),
    "no equal sign": (["seed"], "cannot read 'seed'"),
    "folder without a key": (["datasets/mine"], "Did you mean data.folder=datasets/mine?"),
    "folder for an option": (["data=datasets/mine"], "Write data.folder=datasets/mine"),
    "several values without -m": (["seed=1,2"], "For a sweep add -m"),
    "unknown flag": (["--fast"], "there is no flag --fast"),
    "other configuration folder": (["--config-path=/tmp"], "--config-path is not supported"),
    "missing configuration folder": (["--config-dir=nowhere"], "the configuration folder nowhere does not exist"),
    "negative seed": (["seed=-1"], "seed=-1 is out of range"),
    "negative count": (["encoder.num_particles=-5"], "num_particles must be at least 1, got -5"),
    "zero clips": (["data.batch_size=0"], "batch_size must be at least 1, got 0"),
    "near beyond far": (["scene.near=9.5"], "scene.near=9.5 is out of range"),
    "workspace inside out": (["scene.workspace_min=[2,2,2]"], "below scene.workspace_max on every axis"),
    "radius without bandwidth": (["scene.kernel_radii=[0.1]"], "one radius per bandwidth"),
    "not a number": (["scene.far=nan"], "finite numbers"),
    "experiment that leads elsewhere": (["experiment=tiny", "run.root=.", "experiment=../../x"], "called x"),
    "class from elsewhere": (["encoder._target_=os.system"], "encoder._target_=os.system may not be built"),
    "class of another stage": (
        ["encoder._target_=vpd_lightning.losses.pixel.PixelLoss"],
        "there is no key encoder.channels: PixelLoss takes no such argument",
    ),
    "class that is not there": (
        ["encoder._target_=vpd_lightning.encoder.unet.UNetEncodr"],
        "Did you mean vpd_lightning.encoder.unet.UNetEncoder?",
    ),
    "unequal feature widths": (["dynamics.feature_dim=8"], "disagree on the width of particle features"),
    "sweep over several devices": (["-m", "seed=1,2", "trainer.devices=2"], "would start itself once per device"),
    "sweep into one folder": (["-m", "seed=1,2", "run.folder=here"], "a sweep makes many"),
    "resume=auto without a folder": (["resume=auto"], "Add run.folder=FOLDER"),
    "precision that is not": (["float32_matmul_precision=low"], "highest, high or medium"),
    "optimiser out of range": (["optimizer.lr=-1"], "lr and eps must be above 0"),
}


@pytest.mark.parametrize("case", BAD_CONFIGURATIONS)
def test_bad_configuration(case: str, quick: list[str], in_folder: Path, fails: Fails):
    words, said = BAD_CONFIGURATIONS[case]

    message = fails(train.main, [*words, *quick] if words[0].startswith("-") else [*quick, *words], 2)

    assert said in message


@pytest.mark.parametrize("command", [eval, render], ids=["eval", "render"])
def test_checkpoint_without_a_key(command: ModuleType, in_folder: Path, fails: Fails):
    assert "Did you mean ckpt=runs/mine?" in fails(command.main, ["runs/mine"], 2)


def copy_of(dataset: Path, folder: Path) -> Path:
    return Path(shutil.copytree(dataset, folder))


def note_sizes(folder: Path) -> None:
    """Make the manifest agree with the sizes on disk, so that only the content is wrong."""
    manifest = json.loads((folder / "dataset.json").read_text())
    for entries in manifest["splits"].values():
        for entry in entries:
            entry["bytes"] = (folder / entry["file"]).stat().st_size
    (folder / "dataset.json").write_text(json.dumps(manifest))


def cut(path: Path, share: float) -> None:
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])


def test_missing_data_come_with_the_command_that_makes_them(in_folder: Path, fails: Fails):
    message = fails(train.main, ["experiment=mujoco_block", "trainer=cpu"], 3)

    assert "vpd-data generate scene=mujoco_block preset=paper out=datasets/mujoco_block" in message


def test_missing_data_that_nothing_generates(in_folder: Path, fails: Fails):
    message = fails(train.main, ["data.folder=mine", "trainer=cpu"], 3)

    assert "there is no data set in mine" in message
    assert "import recordings" in message


def test_data_file_that_is_gone(quick: list[str], dataset: Path, tmp_path: Path, in_folder: Path, fails: Fails):
    folder = copy_of(dataset, tmp_path / "copy")
    (folder / "train" / "000001.h5").unlink()

    assert "train/000001.h5 is missing" in fails(train.main, [*quick, f"data.folder={folder}"], 3)


def test_data_file_that_was_cut_short(quick: list[str], dataset: Path, tmp_path: Path, in_folder: Path, fails: Fails):
    folder = copy_of(dataset, tmp_path / "copy")
    cut(folder / "train" / "000000.h5", 0.5)

    assert "000000.h5" in fails(train.main, [*quick, f"data.folder={folder}"], 3)


def test_data_file_whose_content_is_broken(
    quick: list[str], dataset: Path, tmp_path: Path, in_folder: Path, fails: Fails
):
    folder = copy_of(dataset, tmp_path / "copy")
    for path in (folder / "train").glob("*.h5"):
        cut(path, 0.5)
    note_sizes(folder)

    assert "000000.h5" in fails(train.main, [*quick, f"data.folder={folder}"], 3)


def test_data_file_that_is_something_else(
    quick: list[str], dataset: Path, tmp_path: Path, in_folder: Path, fails: Fails
):
    folder = copy_of(dataset, tmp_path / "copy")
    for path in (folder / "train").glob("*.h5"):
        path.write_text("not HDF5")
    note_sizes(folder)

    assert "000000.h5" in fails(train.main, [*quick, f"data.folder={folder}"], 3)


def test_manifest_that_is_broken(quick: list[str], dataset: Path, tmp_path: Path, in_folder: Path, fails: Fails):
    folder = copy_of(dataset, tmp_path / "copy")
    (folder / "dataset.json").write_text("{")

    assert "dataset.json cannot be read" in fails(train.main, [*quick, f"data.folder={folder}"], 3)


def test_images_of_different_sizes(quick: list[str], dataset: Path, tmp_path: Path, in_folder: Path, fails: Fails):
    folder = copy_of(dataset, tmp_path / "copy")
    with h5py.File(folder / "train" / "000001.h5", "r+") as file:
        for name in ("rgb", "depth"):
            smaller = file[name][:, :, :16, :16]
            del file[name]
            file[name] = smaller
    note_sizes(folder)

    message = fails(train.main, [*quick, f"data.folder={folder}"], 3)
    assert "000001.h5" in message


def test_image_size_that_the_unet_cannot_halve(quick: list[str], in_folder: Path, fails: Fails):
    channels = "encoder.channels=[4,4,4,4,4,4,4,4,4,4,4,4,16]"  # 32 pixels halve five times, not six

    assert "must be a multiple of 64" in fails(train.main, [*quick, channels], 2)


def test_more_views_than_there_are(quick: list[str], in_folder: Path, fails: Fails):
    message = fails(train.main, [*quick, "scene.input_views=[0,7]"], 3)

    assert "has 3 views (0 to 2), but view 7 is asked for" in message


def test_clips_longer_than_the_recordings(quick: list[str], in_folder: Path, fails: Fails):
    assert "10 frames, but a clip needs 42" in fails(train.main, [*quick, "data.num_steps=40"], 3)


def test_more_trajectories_than_there_are(quick: list[str], in_folder: Path, fails: Fails):
    assert "data.num_trajectories=99" in fails(train.main, [*quick, "data.num_trajectories=99"], 3)


def test_no_particle_in_the_workspace(quick: list[str], in_folder: Path, fails: Fails):
    words = ["scene.workspace_min=[50,50,50]", "scene.workspace_max=[51,51,51]"]

    assert "workspace" in fails(train.main, [*quick, *words], 3)


@pytest.mark.parametrize("resume", ["last", "nowhere"])
def test_resuming_what_is_not_there(resume: str, in_folder: Path, fails: Fails):
    assert "nothing to resume" in fails(train.main, ["experiment=tiny", f"resume={resume}"], 4)


def test_resuming_from_a_damaged_checkpoint(trained: Path, tmp_path: Path, in_folder: Path, fails: Fails):
    folder = tmp_path / "run"
    shutil.copytree(trained, folder)
    for path in (folder / "checkpoints").glob("*.ckpt"):
        cut(path, 0.9)

    assert "is damaged or cut short" in fails(train.main, [f"resume={folder}"], 4)


def test_folder_that_holds_a_run_already(quick: list[str], trained: Path, in_folder: Path, fails: Fails):
    before = {path: path.stat().st_mtime_ns for path in trained.rglob("*")}

    message = fails(train.main, [*quick, f"run.folder={trained}"], 2)

    assert f"Go on with it: resume={trained}" in message
    assert {path: path.stat().st_mtime_ns for path in trained.rglob("*")} == before


@pytest.mark.parametrize("more", [[], ["resume=auto"]])
def test_folder_that_holds_something_else(quick: list[str], more: list[str], in_folder: Path, fails: Fails):
    (in_folder / "here").mkdir()
    (in_folder / "here" / "thesis.tex").touch()
    (in_folder / "here" / "log.txt").touch()

    message = fails(train.main, [*quick, "run.folder=here", *more], 2)

    assert "holds no checkpoint to go on from, but what no training starts with: thesis.tex" in message
    assert {path.name for path in (in_folder / "here").iterdir()} == {"thesis.tex", "log.txt"}


def test_folder_that_is_a_file(quick: list[str], in_folder: Path, fails: Fails):
    (in_folder / "here").touch()

    assert "run.folder=here is a file" in fails(train.main, [*quick, "run.folder=here", "resume=auto"], 2)


def test_folder_of_a_run_that_died_before_a_checkpoint(quick: list[str], in_folder: Path, fails: Fails):
    (in_folder / "here" / "checkpoints").mkdir(parents=True)
    (in_folder / "here" / "log.txt").touch()

    message = fails(train.main, [*quick, "run.folder=here"], 2)

    assert "resume=auto" in message and "here.aborted-N" in message
    assert "resume=here" not in message
    # A mistake elsewhere moves nothing.
    fails(train.main, [*quick, "run.folder=here", "resume=auto", "encoder._target_=os.system"], 2)
    assert {path.name for path in in_folder.iterdir()} == {"here"}


# Words for vpd-eval and vpd-render beside a good checkpoint.
COMMANDS = {"vpd-eval": eval.main, "vpd-render": render.main}


@pytest.mark.parametrize("command", COMMANDS)
def test_no_checkpoint_given(command: str, in_folder: Path, fails: Fails):
    assert "Give one: ckpt=..." in fails(COMMANDS[command], [], 2)


@pytest.mark.parametrize("command", COMMANDS)
def test_checkpoint_that_is_not_there(command: str, in_folder: Path, fails: Fails):
    assert "nowhere.ckpt" in fails(COMMANDS[command], ["ckpt=nowhere.ckpt"], 4)


@pytest.mark.parametrize("command", COMMANDS)
def test_checkpoint_that_is_not_one(command: str, tmp_path: Path, in_folder: Path, fails: Fails):
    path = tmp_path / "picture.ckpt"
    path.write_bytes(b"\x89PNG" + bytes(1000))

    assert "is not a checkpoint" in fails(COMMANDS[command], [f"ckpt={path}"], 4)


@pytest.mark.parametrize("command", COMMANDS)
def test_checkpoint_with_a_flipped_bit(command: str, trained: Path, tmp_path: Path, in_folder: Path, fails: Fails):
    path = tmp_path / "flipped.ckpt"
    content = bytearray((trained / "checkpoints" / "last.ckpt").read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)

    assert "is damaged or cut short: its checksums do not fit" in fails(COMMANDS[command], [f"ckpt={path}"], 4)


@pytest.mark.parametrize("command", COMMANDS)
def test_unknown_key_of_another_command(command: str, trained: Path, in_folder: Path, fails: Fails):
    words = [f"ckpt={trained / 'checkpoints' / 'last.ckpt'}", "devise=cpu"]

    assert "Did you mean device?" in fails(COMMANDS[command], words, 2)


def test_evaluation_of_a_split_that_does_not_exist(trained: Path, in_folder: Path, fails: Fails):
    words = [f"ckpt={trained / 'checkpoints' / 'last.ckpt'}", "protocol.split=testing"]

    assert "testing" in fails(eval.main, words, 2)


def test_evaluation_over_more_steps_than_were_recorded(trained: Path, in_folder: Path, fails: Fails):
    words = [f"ckpt={trained / 'checkpoints' / 'last.ckpt'}", "protocol.num_steps=50", f"out={in_folder / 'out'}"]

    assert "10 frames" in fails(eval.main, words, 3)


def test_evaluation_into_a_folder_that_is_there(trained: Path, tmp_path: Path, in_folder: Path, fails: Fails):
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "mine.txt").write_text("keep")
    words = [f"ckpt={trained / 'checkpoints' / 'last.ckpt'}", f"out={tmp_path / 'results'}"]

    assert "results" in fails(eval.main, words, 2)
    assert (tmp_path / "results" / "mine.txt").read_text() == "keep"


def test_device_that_is_not_there(trained: Path, in_folder: Path, fails: Fails):
    words = [f"ckpt={trained / 'checkpoints' / 'last.ckpt'}", "device=cuda:77"]

    assert "cuda:77" in fails(eval.main, words, 2)


def test_rendering_without_gl(in_folder: Path, fails: Fails, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("data_gen.gl_backend.why_not", lambda backend: "its library is missing")

    message = fails(data.main, ["generate", "scene=mujoco_block", "preset=tiny", "out=made", "renderer=auto"], 3)

    assert "apt-get install libosmesa6" in message


def test_generating_an_unknown_preset(in_folder: Path, fails: Fails):
    assert "tinny" in fails(data.main, ["generate", "scene=mujoco_block", "preset=tinny", "out=made"], 2)
