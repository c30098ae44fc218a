"""Named sweeps: what is done stays done, what was begun goes on, what failed is reported."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import yaml

from tests import fork_server
from tests.fork_server import PIPE
from tests.waiting import HANG, wait_until
from vpd_lightning.commands import train
from vpd_lightning.errors import DataError
from vpd_lightning.runs.run_claim import CLAIM
from vpd_lightning.runs.sweeps import FINISHED, SweepJob, run_sweep, sweep_jobs
from vpd_lightning.training.checkpoint_files import LAST, load_checkpoint

ROOT = Path(__file__).resolve().parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": f"{ROOT / 'src'}{os.pathsep}{ROOT}", "OMP_NUM_THREADS": "1"}
HOLD_A_LOCK = (
    "import sys; from pathlib import Path; from vpd_lightning.runs.sweeps import _locked\n"
    "with _locked(Path(sys.argv[1])) as is_mine: print(is_mine, flush=True); sys.stdin.read()"
)


@pytest.fixture
def options(tmp_path: Path) -> str:
    """A folder with two sweeps: of three seeds, and of one number of trajectories that there is and one too many."""
    (tmp_path / "options" / "sweep").mkdir(parents=True)
    for name, key, values in (("seeds", "seed", "1,2,3"), ("sizes", "data.num_trajectories", "99,2")):
        params = {"experiment": "tiny", key: values}
        content = {"sweep_name": name, "hydra": {"sweeper": {"params": params}}}
        text = "# @package _global_\n" + yaml.safe_dump(content)
        (tmp_path / "options" / "sweep" / f"{name}.yaml").write_text(text)
    return str(tmp_path / "options")


@pytest.fixture
def jobs(options: str, in_folder: Path, dataset: Path) -> list[SweepJob]:
    return sweep_jobs(["sweep=seeds", f"data.folder={dataset}"], options)


class Trainer:
    """Stands in for a training: its options, in which folder, and files as a training leaves them."""

    def __init__(self, error_of: dict[str, BaseException] | None = None):
        self.error_of = error_of or {}
        self.trained: list[Path] = []
        self.calls: list[list[str]] = []

    def __call__(self, words: list[str]) -> None:
        self.calls.append(words)
        assert words[-2] == "resume=auto"
        seed = next(word for word in words if word.startswith("seed="))
        if seed in self.error_of:
            raise self.error_of[seed]
        folder = Path(words[-1].removeprefix("run.folder=").strip("'"))
        put_checkpoint(folder)
        self.trained.append(folder)


def put_checkpoint(folder: Path) -> None:
    (folder / "checkpoints").mkdir(parents=True, exist_ok=True)
    (folder / "checkpoints" / LAST).touch()


def statuses(said: str) -> list[str]:
    table = said.partition(" runs in ")[2].splitlines()[1:]
    return [line.split("  ")[-1].strip() for line in table if line.startswith("  ")]


@contextmanager
def another_process_has(job: SweepJob) -> Iterator[None]:
    process = fork_server.popen(
        [sys.executable, "-c", HOLD_A_LOCK, str(job.sweep_folder / ".jobs" / job.name)],
        env=ENVIRONMENT, stdin=PIPE, stdout=PIPE,
    )  # fmt: skip
    assert process.stdout is not None and process.stdout.readline() == "True\n"
    try:
        yield
    finally:
        process.kill()
        process.communicate(timeout=HANG)


def test_second_start_skips_what_is_done_and_goes_on_with_what_was_begun(
    jobs: list[SweepJob], capsys: pytest.CaptureFixture[str]
):
    put_checkpoint(jobs[1].folder)
    first, second = Trainer(), Trainer()

    assert run_sweep(jobs, first, pytest.fail) == 0
    said = capsys.readouterr().out
    assert statuses(said) == ["done", "resumed", "done"]
    assert said.rstrip().endswith(f"vpd-report {jobs[0].sweep_folder}")
    assert first.trained == [job.folder for job in jobs]

    (jobs[2].folder / FINISHED).unlink()
    assert run_sweep(jobs, second, pytest.fail) == 0
    assert statuses(capsys.readouterr().out) == ["skipped", "skipped", "resumed"]
    assert second.trained == [jobs[2].folder]


def test_job_that_is_to_be_evaluated_is_not_done_before(
    options: str, in_folder: Path, dataset: Path, capsys: pytest.CaptureFixture[str]
):
    words = ["sweep=seeds", f"data.folder={dataset}"]
    run_sweep(sweep_jobs(words, options), Trainer(), pytest.fail)
    jobs = sweep_jobs([*words, "evaluate=true"], options)
    for job in jobs[:2]:
        (job.folder / "evaluation").mkdir()
        (job.folder / "evaluation" / "metrics.json").touch()
    (jobs[1].folder / FINISHED).unlink()  # what was evaluated is not the finished training
    capsys.readouterr()

    trainer = Trainer()
    run_sweep(jobs, trainer, pytest.fail)

    assert all("evaluate=true" in words for words in trainer.calls)  # though the runs began with evaluate=false
    assert statuses(capsys.readouterr().out) == ["skipped", "resumed", "resumed"]
    assert [(job.folder / "evaluation").exists() for job in jobs] == [True, False, False]
    assert (jobs[1].folder / "earlier_evaluation_1" / "metrics.json").is_file()


def test_failed_job_is_told_does_not_end_the_sweep_and_is_tried_again(
    jobs: list[SweepJob], capsys: pytest.CaptureFixture[str]
):
    error, reported = DataError("nothing there"), []

    assert run_sweep(jobs, Trainer({"seed=2": error}), reported.append) == DataError.exit_code
    assert reported == [error]
    assert statuses(capsys.readouterr().out) == ["done", "failed", "done"]

    assert run_sweep(jobs, Trainer(), pytest.fail) == 0
    assert statuses(capsys.readouterr().out) == ["skipped", "done", "skipped"]


def test_ctrl_c_ends_the_sweep_and_says_how_to_go_on(jobs: list[SweepJob], capsys: pytest.CaptureFixture[str]):
    trainer = Trainer({"seed=2": KeyboardInterrupt()})

    with pytest.raises(KeyboardInterrupt):
        run_sweep(jobs, trainer, pytest.fail)

    assert trainer.trained == [jobs[0].folder]
    assert "given again, goes on" in capsys.readouterr().out


def test_job_of_another_process_is_left_to_it(jobs: list[SweepJob], capsys: pytest.CaptureFixture[str]):
    trainer = Trainer()
    with another_process_has(jobs[1]):
        assert run_sweep(jobs, trainer, pytest.fail) == 0

    said = capsys.readouterr().out
    assert statuses(said) == ["done", "taken by another process", "done"]
    assert "not complete yet: other processes have 1 of its 3 runs" in said
    assert run_sweep(jobs, trainer, pytest.fail) == 0  # that process was killed
    assert "not complete" not in capsys.readouterr().out
    assert trainer.trained == [jobs[0].folder, jobs[2].folder, jobs[1].folder]


def test_job_that_the_other_process_gave_up_meanwhile_is_done_in_the_end(
    jobs: list[SweepJob], capsys: pytest.CaptureFixture[str]
):
    trainer = Trainer()
    with another_process_has(jobs[0]) as _:
        other = another_process_has(jobs[1])
        other.__enter__()

        def train_and_free(words: list[str]) -> None:
            trainer(words)
            other.__exit__(None, None, None)

        assert run_sweep(jobs, train_and_free, pytest.fail) == 0

    assert statuses(capsys.readouterr().out) == ["taken by another process", "done", "done"]
    assert trainer.trained == [jobs[2].folder, jobs[1].folder]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["sweep=seeds"], "Add -m"),
        (["-m", "sweep=seeds,sizes"], "several sweeps"),
        (["-m", "sweep=seeds", "run.folder=here"], "run.root"),
        (["-m", "sweep=seeds", "resume=last"], "goes on by itself"),
        (["-m", "sweep=seeds", "hydra/launcher=joblib"], "Start the same command several times"),
        (["-m", "sweep=seed"], "Did you mean seeds"),
        (["-m", "sweep=seeds", "seed=1", "encoder.num_particles=many"], "num_particles"),
        (["-m", "sweep=seeds", "trainer.devices=2"], "several devices"),
        (["-m", "sweep=seeds", "num_threads=1,2"], "would share the folder tiny/seed-1"),
        (["-m", "sweep=seeds", "evaluate=true,false"], "would share the folder tiny/seed-1"),
    ],
)
def test_mistake_is_found_before_the_first_job(
    words: list[str], message: str, options: str, in_folder: Path, fails: Callable[..., str]
):
    assert message in fails(train.main, [*words, f"--config-dir={options}"], 2)


def test_sweep_trains_starts_anew_what_died_early_and_tells_what_failed(
    quick: list[str], options: str, in_folder: Path, capsys: pytest.CaptureFixture[str]
):
    words = [
        "-m",
        "sweep=sizes",
        f"--config-dir={options}",
        *quick,
        "trainer.max_steps=1",
        "data.num_validation_clips=1",
    ]
    [_, job] = sweep_jobs([word for word in words if not word.startswith("-")], options)
    job.folder.mkdir(parents=True)
    (job.folder / CLAIM).write_text("of a process that was killed")

    assert train.main(words) == DataError.exit_code

    captured = capsys.readouterr()
    assert statuses(captured.out) == ["failed", "done"]
    assert "99" in captured.err and "Traceback" not in captured.err
    assert job.folder.with_name(f"{job.folder.name}.aborted-1").is_dir()
    assert load_checkpoint(job.folder / "checkpoints" / LAST)["global_step"] == 1
    config = yaml.safe_load((job.folder / "config.yaml").read_text())
    assert config["sweep_name"] == "sizes"
    assert config["data"]["num_trajectories"] == 2


def test_killed_sweep_goes_on_where_it_stopped(
    quick: list[str], options: str, in_folder: Path, capsys: pytest.CaptureFixture[str]
):
    words = ["sweep=seeds", "seed=1,2", *quick, "trainer.max_steps=12", "trainer.val_check_interval=12"]
    words += ["data.num_validation_clips=1"]
    first, second = sweep_jobs(words, options)
    put_checkpoint(first.folder)
    (first.folder / FINISHED).touch()
    process = fork_server.popen(
        [sys.executable, "-m", "vpd_lightning.commands.train", "-m", *words, f"--config-dir={options}"],
        env=ENVIRONMENT, stdout=PIPE, stderr=PIPE,
    )  # fmt: skip
    wait_until((second.folder / "checkpoints" / LAST).is_file, process, pause=0.005)
    process.kill()
    process.communicate(timeout=HANG)
    assert not second.is_complete

    assert train.main(["-m", *words, f"--config-dir={options}"]) == 0

    assert statuses(capsys.readouterr().out) == ["skipped", "resumed"]
    assert not (first.folder / "metrics.csv").exists()  # nobody trained there
    assert load_checkpoint(second.folder / "checkpoints" / LAST)["global_step"] == 12
