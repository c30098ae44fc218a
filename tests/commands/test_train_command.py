"""``vpd-train``: run folders, sweeps, resuming, and how it ends."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests import fork_server
from tests.waiting import HANG, wait_until
from vpd_lightning.commands import train
from vpd_lightning.training.checkpoint_files import load_checkpoint

ROOT = Path(__file__).resolve().parents[2]


def start(words: list[str], cwd: Path, popen: Any = fork_server.popen) -> Any:
    """Start ``vpd-train`` as a process of its own."""
    environment = {**os.environ, "PYTHONPATH": f"{ROOT / 'src'}{os.pathsep}{ROOT}", "OMP_NUM_THREADS": "1"}
    return popen(
        [sys.executable, "-m", "vpd_lightning.commands.train", *words],
        cwd=cwd, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def run_folders(root: Path) -> list[Path]:
    return sorted(path.parent for path in root.glob("runs/*/*/config.yaml"))


def test_run_folder_holds_what_is_needed_to_repeat_the_run(trained: Path, quick: list[str]):
    config = yaml.safe_load((trained / "config.yaml").read_text())
    environment = json.loads((trained / "environment.json").read_text())

    assert config["experiment"] == "tiny"
    assert config["run"]["folder"] == str(trained)
    assert config["encoder"]["workspace_min"] == [-1.0, -1.0, -0.1]  # resolved
    assert yaml.safe_load((trained / "overrides.yaml").read_text()) == quick
    assert environment["versions"]["torch"]
    assert environment["devices"]
    assert environment["float32_matmul_precision"] == "highest"
    assert "TF32 off" in (trained / "log.txt").read_text()
    assert (trained / "metrics.csv").read_text().splitlines()[-1].startswith("2,")
    assert load_checkpoint(trained / "checkpoints" / "last.ckpt")["hyper_parameters"] == config
    assert not list(trained.glob(".claimed"))


def test_an_automatic_precision_is_printed_recorded_and_kept(
    quick: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("vpd_lightning.runs.precision.bfloat16_instructions", lambda: "avx512_bf16")
    run = tmp_path / "run"
    words = [*(word for word in quick if not word.startswith("run.")), f"run.folder={run}", "trainer.precision=auto"]

    assert train.main(words) == 0

    assert "precision: bf16-mixed (this processor multiplies bfloat16: avx512_bf16)" in capsys.readouterr().out
    assert yaml.safe_load((run / "config.yaml").read_text())["trainer"]["precision"] == "bf16-mixed"
    monkeypatch.setattr("vpd_lightning.runs.precision.bfloat16_instructions", lambda: "")  # another machine
    assert train.main([f"resume={run}", "trainer.max_steps=3"]) == 0
    assert "precision: bf16-mixed (as the run began)" in capsys.readouterr().out
    assert (
        load_checkpoint(run / "checkpoints" / "last.ckpt")["hyper_parameters"]["trainer"]["precision"] == "bf16-mixed"
    )


def test_trained_model_loads_and_predicts(trained: Path):
    import vpd_lightning as vpd

    simulator = vpd.load(trained / "checkpoints" / "last.ckpt")

    assert isinstance(simulator, vpd.Simulator)


def test_folder_of_a_run_is_named_by_time_and_overrides_and_never_reused(
    quick: list[str], in_folder: Path, capsys: pytest.CaptureFixture[str]
):
    for _ in range(2):
        assert train.main([*quick, "trainer.max_steps=1"]) == 0

    folders = run_folders(in_folder)
    assert len(folders) == 2
    assert {folder.parent.name for folder in folders} == {"tiny"}
    said = capsys.readouterr().out
    assert all(f"run folder: {folder}\n" in said for folder in folders)
    assert {folder.name[20:28] for folder in folders} == {folders[0].name[20:28]}  # one hash, two times or suffixes


@pytest.mark.slow
def test_sweep_of_two_by_two_makes_four_folders(quick: list[str], in_folder: Path):
    assert train.main(["-m", *quick, "trainer.max_steps=1", "seed=1,2", "data.num_trajectories=2,4"]) == 0

    configs = [yaml.safe_load((folder / "config.yaml").read_text()) for folder in run_folders(in_folder)]
    assert {(c["seed"], c["data"]["num_trajectories"]) for c in configs} == {(1, 2), (1, 4), (2, 2), (2, 4)}
    assert all((folder / "checkpoints" / "last.ckpt").is_file() for folder in run_folders(in_folder))


@pytest.mark.slow
def test_sweep_goes_on_after_a_run_that_failed(quick: list[str], in_folder: Path, capsys: pytest.CaptureFixture[str]):
    code = train.main(["-m", *quick, "trainer.max_steps=1", "data.num_trajectories=99,2"])

    assert code == 3
    assert "99" in capsys.readouterr().err
    assert [
        yaml.safe_load((f / "config.yaml").read_text())["data"]["num_trajectories"] for f in run_folders(in_folder)
    ] == [2]


@pytest.mark.slow
def test_typing_error_anywhere_in_a_sweep_is_found_before_the_first_run(quick: list[str], in_folder: Path):
    assert train.main(["-m", *quick, "encoder.num_particles=64,many"]) == 2
    assert not run_folders(in_folder)


@pytest.mark.slow
def test_resumed_run_goes_on_in_its_folder_with_its_settings(quick: list[str], in_folder: Path):
    assert train.main([*quick, "seed=5"]) == 0
    [folder] = run_folders(in_folder)

    assert train.main(["resume=last", "trainer.max_steps=4"]) == 0

    assert run_folders(in_folder) == [folder]
    checkpoint = load_checkpoint(folder / "checkpoints" / "last.ckpt")
    assert checkpoint["global_step"] == 4
    assert checkpoint["hyper_parameters"]["seed"] == 5
    assert yaml.safe_load((folder / "config.yaml").read_text())["trainer"]["max_steps"] == 2  # the first settings stay
    steps = [line.split(",")[0] for line in (folder / "metrics.csv").read_text().splitlines()[1:]]
    assert steps[0] == "2" and steps[-1] == "4"


@pytest.mark.slow
def test_resume_auto_starts_a_run_and_then_goes_on_with_it(quick: list[str], in_folder: Path):
    words = [*quick, "resume=auto", "run.folder=here"]

    assert train.main([*words, "trainer.max_steps=1"]) == 0
    assert train.main([*words, "trainer.max_steps=3"]) == 0

    assert load_checkpoint(in_folder / "here" / "checkpoints" / "last.ckpt")["global_step"] == 3


@pytest.mark.slow
def test_run_killed_before_its_first_checkpoint_is_moved_aside_and_started_anew(
    quick: list[str], in_folder: Path, fails: Callable[..., str], capsys: pytest.CaptureFixture[str]
):
    late = [f"{key}=100000" for key in ("trainer.max_steps", "trainer.val_check_interval")]
    late += ["callbacks.keep_checkpoints.every_n_steps=100000", "resume=auto", "run.folder=here"]
    # With every logger of a usual run.
    process = start([*(word for word in quick if word != "logger=csv"), *late], in_folder)
    wait_until((in_folder / "here" / "metrics.csv").is_file, process)
    words = [*quick, "trainer.max_steps=1", "run.folder=here"]

    # While it is alive nobody else may have its folder.
    assert "a run that is still going" in fails(train.main, [*words, "resume=auto"], 2)

    process.kill()
    process.communicate(timeout=HANG)
    left = {path.name: path.read_bytes() for path in (in_folder / "here").iterdir() if path.is_file()}
    assert "Start anew in it with resume=auto" in fails(train.main, words, 2)
    assert {path.name for path in in_folder.iterdir()} == {"here"}

    assert train.main([*words, "resume=auto"]) == 0

    aside = in_folder / "here.aborted-1"
    assert str(aside) in capsys.readouterr().out
    assert {path.name: path.read_bytes() for path in aside.iterdir() if path.is_file()} == left
    assert load_checkpoint(in_folder / "here" / "checkpoints" / "last.ckpt")["global_step"] == 1


def test_missing_tiny_data_are_made(in_folder: Path, quick: list[str]):
    words = [word for word in quick if not word.startswith("data.folder")]

    assert train.main([*words, "trainer.max_steps=1"]) == 0

    assert (in_folder / "datasets" / "mujoco_block_tiny" / "dataset.json").is_file()


def test_help_says_what_where_and_which_exit_codes(capsys: pytest.CaptureFixture[str], in_folder: Path):
    assert train.main(["--help"]) == 0

    said = capsys.readouterr().out
    assert said.count("vpd-train ") >= 6
    assert "runs/EXPERIMENT/TIMESTAMP_HASH" in said
    assert "143 SIGTERM" in said
    assert "mujoco_block" in said
    assert not list(in_folder.iterdir())


def test_configuration_can_be_shown_without_a_run(capsys: pytest.CaptureFixture[str], in_folder: Path):
    assert train.main(["experiment=tiny", "--cfg", "job", "--resolve"]) == 0

    assert yaml.safe_load(capsys.readouterr().out)["renderer"]["near"] == 0.3
    assert not list(in_folder.iterdir())


@pytest.mark.parametrize(
    "line", ["experiment=tiny --cfg job -p renderer seed=1", "-p renderer experiment=tiny --cfg job"]
)
def test_flags_may_stand_anywhere_among_the_settings(line: str, capsys: pytest.CaptureFixture[str]):
    assert train.main(line.split()) == 0

    assert yaml.safe_load(capsys.readouterr().out.partition("\n")[2])["near"] == "${scene.near}"  # behind "# @package"


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_signal_saves_a_checkpoint_and_gives_the_shells_exit_code(
    quick: list[str], in_folder: Path, number: signal.Signals, code: int
):
    process = start([*quick, "trainer.max_steps=100000", "run.folder=here"], in_folder)
    wait_until((in_folder / "here" / "checkpoints" / "last.ckpt").is_file, process)

    process.send_signal(number)
    out, err = process.communicate(timeout=HANG)

    assert process.returncode == code, out + err
    assert "Traceback" not in err
    assert load_checkpoint(in_folder / "here" / "checkpoints" / "last.ckpt")["global_step"] > 0


@pytest.mark.slow
@pytest.mark.ddp
def test_two_processes_share_one_run_folder(quick: list[str], in_folder: Path):
    process = start([*quick, "trainer=ddp_cpu"], in_folder, subprocess.Popen)
    out, err = process.communicate(timeout=HANG)

    assert process.returncode == 0, out + err
    [folder] = run_folders(in_folder)
    assert (folder / "checkpoints" / "last.ckpt").is_file()
    assert out.count("run folder:") == 1
    assert "\x1b[" not in out + err  # no terminal, no colours


def test_memory_error_names_the_knobs_and_gives_its_own_code(
    quick: list[str], in_folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def out_of_memory(*args: object, **kwargs: object) -> None:
        raise MemoryError

    monkeypatch.setattr("vpd_lightning.simulator.Simulator.forward", out_of_memory)

    assert train.main(quick) == 5
    assert "renderer.ray_chunk_size" in capsys.readouterr().err


def test_traceback_is_shown_on_demand(
    in_folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("VPD_DEBUG", "1")

    assert train.main(["experiment=nothing"]) == 2
    assert "Traceback" in capsys.readouterr().err
