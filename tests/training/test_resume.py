"""A training that was killed and resumed equals one that was not, bit for bit."""

import csv
import os
import shutil
import signal
import sys
from pathlib import Path

import pytest
import torch

from data_gen.inspection.split import split_dataset
from tests import fork_server
from tests.data.recordings import write_recordings
from tests.training.tiny_training import SignalAt, tiny_data, tiny_module, tiny_trainer
from tests.waiting import HANG
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.data.trained_on import DATA_SHA256, TRAINED_ON
from vpd_lightning.training.checkpoint_files import load_checkpoint, write_checkpoint
from vpd_lightning.training.checkpoints import find_resume

STEPS = 30
TIMED = "rays_per_second"


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recordings(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def uninterrupted(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("uninterrupted")
    tiny_trainer(run, STEPS).fit(tiny_module(), tiny_data(data))
    return run


def train_and_die(data: Path, run: Path, step: int, num_workers: int) -> int:
    """Train in a process of its own that is killed within the given step; return its exit code."""
    command = [sys.executable, "-m", "tests.training.tiny_training", str(data), str(run), f"--steps={STEPS}"]
    command += [f"--workers={num_workers}", f"--kill-at={step}"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    done = fork_server.run(command, env=environment, capture_output=True, timeout=HANG)
    assert "\x1b" not in done.stdout + done.stderr  # no terminal, no control characters
    return done.returncode


def resume(data: Path, run: Path, num_workers: int = 0) -> None:
    trainer = tiny_trainer(run, STEPS)
    trainer.fit(tiny_module(), tiny_data(data, num_workers=num_workers), ckpt_path=find_resume(run))


def metrics(run: Path) -> list[dict[str, str]]:
    """Everything but the time that a step took."""
    with (run / "metrics.csv").open(newline="") as stream:
        return [{k: v for k, v in row.items() if k != TIMED} for row in csv.DictReader(stream)]


def assert_equal_runs(a: Path, b: Path) -> None:
    for name in ("last.ckpt", "last-previous.ckpt", "best.ckpt"):
        first, second = (load_checkpoint(run / "checkpoints" / name) for run in (a, b))
        assert first["global_step"] == second["global_step"]
        assert first["state_dict"].keys() == second["state_dict"].keys()
        for key, value in first["state_dict"].items():
            assert torch.equal(value, second["state_dict"][key]), f"{name}: {key}"
        moments = [
            [value for state in loaded["optimizer_states"][0]["state"].values() for value in state.values()]
            for loaded in (first, second)
        ]
        assert all(torch.equal(x, y) for x, y in zip(*moments, strict=True))
        assert first["callbacks"] == second["callbacks"]
    assert metrics(a) == metrics(b)


@pytest.mark.slow
@pytest.mark.parametrize(("num_workers", "step"), [(0, 17), (2, 17), (0, 23)])
def test_killed_between_checkpoints_and_resumed(
    data: Path, uninterrupted: Path, tmp_path: Path, num_workers: int, step: int
) -> None:
    assert train_and_die(data, tmp_path, step, num_workers) == -signal.SIGKILL
    assert load_checkpoint(find_resume(tmp_path))["global_step"] == step // 5 * 5
    assert len(metrics(tmp_path)) >= step  # those after the checkpoint will be written again
    resume(data, tmp_path, num_workers)
    assert_equal_runs(uninterrupted, tmp_path)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130), (signal.SIGUSR1, 138)])
def test_a_signal_saves_the_step_at_hand_and_gives_its_exit_code(
    data: Path, uninterrupted: Path, tmp_path: Path, number: int, code: int
) -> None:
    handlers = [signal.getsignal(item) for item in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1)]
    with pytest.raises(SystemExit) as stop:
        tiny_trainer(tmp_path, STEPS, [SignalAt(17, number)]).fit(tiny_module(), tiny_data(data))
    assert stop.value.code == code
    assert handlers == [signal.getsignal(item) for item in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1)]
    assert load_checkpoint(tmp_path / "checkpoints" / "last.ckpt")["global_step"] == 18
    resume(data, tmp_path)
    assert_equal_runs(uninterrupted, tmp_path)


def test_a_signal_during_a_validation_loses_no_step(data: Path, uninterrupted: Path, tmp_path: Path) -> None:
    with pytest.raises(SystemExit):
        callback = SignalAt(20, signal.SIGTERM, is_validation=True)
        tiny_trainer(tmp_path, STEPS, [callback]).fit(tiny_module(), tiny_data(data))
    assert load_checkpoint(tmp_path / "checkpoints" / "last.ckpt")["global_step"] == 20
    resume(data, tmp_path)
    assert_equal_runs(uninterrupted, tmp_path)


def test_a_run_that_is_finished_stays_as_it_is(data: Path, uninterrupted: Path) -> None:
    before = {path: path.read_bytes() for path in uninterrupted.rglob("*") if path.is_file()}
    resume(data, uninterrupted)
    assert {path: path.read_bytes() for path in uninterrupted.rglob("*") if path.is_file()} == before


def test_a_checkpoint_names_its_data_and_going_on_with_other_data_warns(
    data: Path, uninterrupted: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    last = uninterrupted / "checkpoints" / "last.ckpt"
    assert load_checkpoint(last)[DATA_SHA256] == [load_manifest(data).digest]
    tiny_trainer(tmp_path / "same", STEPS + 1).fit(tiny_module(), tiny_data(data), ckpt_path=last)
    assert "not what this training began with" not in caplog.text

    other = write_recordings(tmp_path / "data", num_train=3)
    tiny_trainer(tmp_path / "other", STEPS + 1).fit(tiny_module(), tiny_data(other), ckpt_path=last)

    assert "not what this training began with" in caplog.text
    manifests = [load_manifest(folder) for folder in (data, other)]
    stored = load_checkpoint(tmp_path / "other/checkpoints/last.ckpt")
    assert stored[DATA_SHA256] == [manifest.digest for manifest in manifests]
    seen = {checksum for manifest in manifests for checksum in manifest.checksums(manifest.split("train"))}
    assert stored[TRAINED_ON] == sorted(seen)


def test_a_training_that_goes_on_from_a_checkpoint_that_does_not_say_does_not_know_either(
    data: Path, uninterrupted: Path, tmp_path: Path
) -> None:
    old = load_checkpoint(uninterrupted / "checkpoints" / "last.ckpt")
    assert old.pop(TRAINED_ON)
    write_checkpoint(old, tmp_path / "old.ckpt")
    tiny_trainer(tmp_path / "run", STEPS + 1).fit(tiny_module(), tiny_data(data), ckpt_path=tmp_path / "old.ckpt")
    assert load_checkpoint(tmp_path / "run/checkpoints/last.ckpt")[TRAINED_ON] is None


def test_going_on_with_another_division_of_the_same_files_warns(
    data: Path, uninterrupted: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    other = Path(shutil.copytree(data, tmp_path / "data"))
    split_dataset(other, train=3, validation=3, test=0, seed=1)
    last = uninterrupted / "checkpoints" / "last.ckpt"
    tiny_trainer(tmp_path / "run", STEPS + 1).fit(tiny_module(), tiny_data(other), ckpt_path=last)
    assert "or its splits are not" in caplog.text


def test_with_workers_or_another_start_nothing_changes(data: Path, uninterrupted: Path, tmp_path: Path) -> None:
    tiny_trainer(tmp_path, STEPS).fit(tiny_module(), tiny_data(data, num_workers=2, cache=False))
    assert_equal_runs(uninterrupted, tmp_path)


def test_a_damaged_last_checkpoint_costs_only_the_steps_since_the_one_before(
    data: Path, uninterrupted: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    tiny_trainer(run, STEPS).fit(tiny_module(), tiny_data(data))
    last = run / "checkpoints" / "last.ckpt"
    last.write_bytes(last.read_bytes()[:5000])
    assert load_checkpoint(find_resume(run))["global_step"] == 25
    resume(data, run)
    first, second = (load_checkpoint(r / "checkpoints" / "last.ckpt")["state_dict"] for r in (uninterrupted, run))
    assert all(torch.equal(first[key], second[key]) for key in first)
