"""Named sweeps: each job has a place of its own, so that the same command, given again, goes on where it stopped."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

from vpd_lightning.config.run_folders import sweep_folder, sweep_slug
from vpd_lightning.errors import ConfigError
from vpd_lightning.runs.resume import has_checkpoint, quote
from vpd_lightning.runs.run_claim import is_claimed, lock

DONE, SKIPPED, RESUMED, FAILED, TAKEN = "done", "skipped", "resumed", "failed", "taken by another process"
FINISHED = "finished"
"""File that marks a job's run folder as done."""
_LOCKS = ".jobs"


@dataclass(frozen=True)
class SweepJob:
    """One run of a named sweep: its words, the configuration they give, and its place."""

    words: tuple[str, ...]
    config: dict[str, Any]
    sweep_folder: Path
    folder: Path

    @property
    def name(self) -> str:
        """The job's place inside the sweep's folder."""
        return self.folder.relative_to(self.sweep_folder).as_posix()

    @property
    def is_complete(self) -> bool:
        """Whether the training has finished, and was evaluated where it is to be."""
        is_evaluated = not self.config["evaluate"] or any(self.folder.glob("evaluation*/metrics.json"))
        return is_evaluated and (self.folder / FINISHED).is_file()


def is_named_sweep(overrides: Sequence[str]) -> bool:
    """Whether the words name a file of ``conf/sweep``."""
    return any(word.startswith("sweep=") and word not in ("sweep=null", "sweep=") for word in overrides)


def sweep_jobs(overrides: Sequence[str], config_dir: str | None) -> list[SweepJob]:
    """Return the jobs of a named sweep in order, each configuration checked as far as ``compose`` does.

    Raises:
        ConfigError: a word that is wrong, or that a named sweep has no place for; two jobs would share a folder.
    """
    from vpd_lightning.config import compose, expand_sweep, sweep_parameters

    _refuse_words(overrides)
    common = [word for word in overrides if word.startswith(("hydra.", "hydra/"))]
    common = [word for word in common if not word.startswith("hydra.sweeper.")]
    parameters = [word.partition("=")[0] for word in sweep_parameters("train", overrides, config_dir)]
    jobs: list[SweepJob] = []
    for words in expand_sweep("train", overrides, config_dir):
        config = compose("train", [*words, "run.folder=not-chosen-yet"], config_dir)
        folder = sweep_folder(config["run"]["root"], config["sweep_name"])
        place = folder / config["experiment"] / sweep_slug(words, parameters)
        job = SweepJob((*words, *common), config, folder, place)
        if twin := next((other for other in jobs if other.folder == place), None):
            raise ConfigError(
                f"two jobs of the sweep would share the folder {job.name}:\n"
                f"'{' '.join(twin.words)}' and '{' '.join(job.words)}'.\n"
                "evaluate, num_threads and debug are not in the folder name: give each one value, and every key once."
            )
        jobs.append(job)
    return jobs


def run_sweep(jobs: Sequence[SweepJob], train: Callable[[list[str]], None], show: Callable[[Exception], None]) -> int:
    """Do what is left to do of a sweep, print a table of it, and return the exit code.

    Several processes may work on one sweep: each leaves alone what another one has taken, and looks at that once more
    when it is through. A job that fails is shown and does not end the sweep; the exit code is that of the first one.

    Args:
        jobs: what belongs to the sweep.
        train: trains with the words given, or raises.
        show: reports an error to the user.
    """
    statuses: dict[str, str] = {}
    codes: list[int] = []
    try:
        for _ in range(2):
            for number, job in enumerate(jobs, start=1):
                if statuses.get(job.name, TAKEN) != TAKEN:
                    continue
                try:
                    statuses[job.name] = _attend_to(job, f"[{number}/{len(jobs)}]", train)
                except Exception as error:
                    statuses[job.name] = FAILED
                    codes.append(getattr(error, "exit_code", 1))
                    show(error)
    except BaseException:
        print("The sweep was stopped. The same command, given again, goes on with it.", flush=True)
        raise
    _print_table(jobs, statuses)
    return codes[0] if codes else 0


def _attend_to(job: SweepJob, number: str, train: Callable[[list[str]], None]) -> str:
    from vpd_lightning.runs.provide_data import provide_data

    # Held until the job ends: nobody else may decide what to do with its folder, which is not there at first.
    with _locked(job.sweep_folder / _LOCKS / job.name) as is_mine:
        if not is_mine or is_claimed(job.folder):
            return TAKEN
        if job.is_complete:
            return SKIPPED
        is_resumed = has_checkpoint(job.folder)
        print(f"{number} {job.name}: {'going on' if is_resumed else 'starting'}", flush=True)
        _set_aside_evaluations(job.folder)
        with _locked(job.sweep_folder / _LOCKS / "data", is_patient=True):
            provide_data(job.config, job.words)
        train([*job.words, *_settled(job.config), "resume=auto", f"run.folder={quote(str(job.folder))}"])
        (job.folder / FINISHED).write_text("This run is complete: the sweep skips it.\n")
        return RESUMED if is_resumed else DONE


def _settled(config: dict[str, Any]) -> list[str]:
    """Say what the folder's name does not, so that a resumed run does not keep the options it began with."""
    values = {key: config[key] for key in ("evaluate", "num_threads")}
    return [f"{key}={'null' if value is None else str(value).lower()}" for key, value in values.items()]


def _set_aside_evaluations(folder: Path) -> None:
    """Make room for the evaluation of the finished training: what is there is of an earlier checkpoint."""
    for path in sorted(folder.glob("evaluation*")):
        names = (f"earlier_{path.name}_{number}" for number in count(1))
        path.rename(next(place for name in names if not (place := folder / name).exists()))


@contextmanager
def _locked(path: Path, *, is_patient: bool = False) -> Iterator[bool]:
    """Hold a lock that goes with the process; yields whether it could be had (``is_patient`` waits for it)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.with_name(f"{path.name}.lock").open("a") as stream:
        yield lock(stream, is_patient=is_patient)


def _refuse_words(overrides: Sequence[str]) -> None:
    keys = {word.partition("=")[0]: word for word in overrides}
    if "," in keys["sweep"]:
        raise ConfigError(f"{keys['sweep']} names several sweeps.\nStart them one after the other.")
    if "run.folder" in keys:
        raise ConfigError("run.folder names one folder, but a sweep makes many.\nUse run.root=FOLDER.")
    if "resume" in keys:
        raise ConfigError("a named sweep goes on by itself.\nRemove resume.")
    if launcher := next((word for word in overrides if word.startswith(("hydra/launcher=", "hydra.launcher"))), ""):
        raise ConfigError(
            f"'{launcher}' cannot be used with a named sweep, whose jobs run one after the other.\n"
            "Start the same command several times, one per core, GPU or node: each takes what no other has."
        )


def _print_table(jobs: Sequence[SweepJob], statuses: dict[str, str]) -> None:
    width = max(len(job.name) for job in jobs)
    folder = jobs[0].sweep_folder
    print(f"\nsweep {folder.name}, {len(jobs)} runs in {folder}:")
    for job in jobs:
        print(f"  {job.name:<{width}}  {statuses[job.name]}")
    if taken := sum(status == TAKEN for status in statuses.values()):
        print(f"The sweep is not complete yet: other processes have {taken} of its {len(jobs)} runs.")
    print(f"Compare them: vpd-report {folder}", flush=True)
