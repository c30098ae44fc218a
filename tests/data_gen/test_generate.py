import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from data_gen import dataset_folder
from data_gen import generate as module
from tests.data_gen.blocks import contents, generate_small
from tests.waiting import HANG, wait_until
from vpd_lightning.data.ground_truth import read_state
from vpd_lightning.data.manifest import file_sha256, load_manifest
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.errors import ConfigError, DataError

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return generate_small(tmp_path_factory.mktemp("blocks") / "small")


def test_manifest_is_complete_and_checksums_hold(folder: Path):
    manifest = load_manifest(folder)

    assert {name: len(files) for name, files in manifest.splits.items()} == {"train": 2, "validation": 1, "test": 1}
    for files in manifest.splits.values():
        for path in files:
            assert file_sha256(path) == manifest.sha256[manifest.relative(path)]
    assert manifest.versions["mujoco"]
    assert not list(folder.rglob(".*"))


def test_trajectories_differ_and_carry_their_truth(folder: Path):
    poses = {read_state(path).positions[0, 0].tobytes() for path in folder.glob("*/*.h5")}

    assert len(poses) == 4
    with TrajectoryReader(folder / "test" / "000000.h5") as reader:
        assert (reader.num_frames, reader.num_views, reader.height, reader.width) == (4, 2, 24, 32)


def test_same_seed_gives_same_bytes_and_another_seed_others(folder: Path, tmp_path: Path):
    again, other = generate_small(tmp_path / "again"), generate_small(tmp_path / "other", seed=1)

    assert contents(again) == contents(folder)
    assert load_manifest(again).digest == load_manifest(folder).digest
    assert not set(contents(other).values()) & set(contents(folder).values())


@pytest.mark.slow
def test_number_of_workers_changes_nothing(folder: Path, tmp_path: Path):
    assert contents(generate_small(tmp_path / "two", workers=2)) == contents(folder)


def test_fewer_trajectories_are_the_first_of_more(folder: Path, tmp_path: Path):
    """Each trajectory depends on seed, split and index alone (files differ in the hash of the settings only)."""
    fewer = generate_small(tmp_path / "fewer", **{"splits.train": 1})

    for name in ("train/000000.h5", "test/000000.h5"):
        assert (TrajectoryReader(fewer / name).rgb() == TrajectoryReader(folder / name).rgb()).all()


def test_finished_data_set_is_left_alone(folder: Path):
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    generate_small(folder)

    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


def test_other_settings_never_overwrite_a_finished_data_set(folder: Path):
    before = contents(folder)
    with pytest.raises(DataError, match=r"other settings.*\n.*seed: 4 instead of 0") as caught:
        generate_small(folder, seed=4)
    with pytest.raises(DataError, match=r"block.side: 0.2 instead of 0.3"):
        generate_small(folder, **{"block.side": 0.2})

    assert "Choose another out=FOLDER" in str(caught.value)
    assert contents(folder) == before


def interrupt_after(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    original, calls = module.worker.make_file, []

    def make_file(*args: object) -> str:
        if len(calls) == count:
            raise KeyboardInterrupt
        calls.append(args)
        return original(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(module.worker, "make_file", make_file)


def test_interrupted_run_resumes_where_it_stopped(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    out = tmp_path / "resumed"
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        interrupt_after(patch, 2)
        generate_small(out)
    assert len(contents(out)) == 2 and not (out / "dataset.json").exists()
    kept = {path: path.stat().st_mtime_ns for path in out.glob("*/*.h5")}
    (out / "train" / ".000001.h5.xyz.partial").write_bytes(b"rest of a killed process")
    damaged = next(iter(kept))
    damaged.write_bytes(damaged.read_bytes()[:-100])

    generate_small(out)

    assert contents(out) == contents(folder)
    assert load_manifest(out).digest == load_manifest(folder).digest
    assert not list(out.rglob(".*"))
    for path, modified in kept.items():
        assert (path.stat().st_mtime_ns == modified) == (path != damaged)


def test_unfinished_data_set_is_not_continued_with_other_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        interrupt_after(patch, 1)
        generate_small(tmp_path / "out")

    with pytest.raises(DataError, match=r"unfinished.*\n.*num_frames: 6 instead of 4"):
        generate_small(tmp_path / "out", **{"num_frames": 6})


def test_folder_with_strange_trajectories_is_left_alone(folder: Path, tmp_path: Path):
    strange = tmp_path / "mine" / "train" / "000000.h5"
    strange.parent.mkdir(parents=True)
    strange.write_text("my recording")

    with pytest.raises(DataError, match=r"not from this run, for example train/000000.h5"):
        generate_small(tmp_path / "mine")
    assert strange.read_text() == "my recording"


def test_full_disk_is_told_before_anything_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(dataset_folder, "_DISK_RESERVE", 2**60)

    with pytest.raises(DataError, match=r"GiB free; 4 trajectories need about"):
        generate_small(tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_two_generators_do_not_share_a_folder(tmp_path: Path):
    plan = module.make_plan("mujoco_block", "tiny", tmp_path / "out", 0, {})
    with plan.folder.claim(), pytest.raises(DataError, match="Another vpd-data"), plan.folder.claim():
        pass


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"workers": 0}, "workers is 0"),
        ({"seed": -1}, "seed is -1"),
        ({"scene": "mujoco_blok"}, "did you mean 'mujoco_block'"),
        ({"preset": "dmo"}, "did you mean 'demo'"),
    ],
)
def test_wrong_arguments_are_refused(tmp_path: Path, changes: dict[str, object], message: str):
    arguments = {"scene": "mujoco_block", "preset": "tiny", "out": tmp_path / "out", "seed": 0, **changes}
    with pytest.raises(ConfigError, match=message):
        module.generate(**arguments)  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGTERM, 143), pytest.param(signal.SIGINT, 130, marks=pytest.mark.exhaustive)]
)
def test_stopped_with_workers_leaves_no_half_file(tmp_path: Path, number: signal.Signals, code: int):
    out = tmp_path / "out"
    words = ["scene=mujoco_block", "preset=tiny", f"out={out}", "splits.train=2000", "workers=2", "num_frames=30"]
    process = subprocess.Popen(
        [sys.executable, "-m", "vpd_lightning.commands.data", "generate", *words],
        env={**os.environ, "PYTHONPATH": f"{ROOT / 'src'}:{ROOT}"},
        stderr=subprocess.PIPE,
        start_new_session=True,
        # A shell lets what it starts in the background ignore Ctrl-C, tests included, and that is inherited.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    wait_until(lambda: list(out.glob("train/*.h5")), process)
    os.killpg(process.pid, number)  # as a terminal does: to the workers as well
    _, errors = process.communicate(timeout=HANG)

    assert process.returncode == code, errors.decode()
    assert b"Traceback" not in errors
    assert list(out.glob("train/*.h5"))
    assert not list(out.rglob("*.partial"))
    assert not (out / "dataset.json").exists()
