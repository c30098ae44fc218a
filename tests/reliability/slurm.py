"""A real SLURM, of one machine: a job of four tasks is signalled that its time is up, is queued again, and goes on."""

import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

from tests.reliability.outcome import Outcome
from tests.reliability.trainings import environment, make_data, metrics, start, words
from vpd_lightning.training.checkpoint_files import load_checkpoint

CLUSTER = Path(__file__).with_name("one_machine_slurm.sh")
LOG = Path("docs/results/slurm_requeue.log")
STEPS, TASKS = 60, 4
MAX_ERROR = 1e-3  # relative, of weights, from rounding alone
JOB = """#!/bin/bash
#SBATCH --nodes=1 --ntasks-per-node={tasks} --requeue --open-mode=append --output={log}
srun --kill-on-bad-exit=1 {python} -m vpd_lightning.commands.train {words}
"""


def slurm(work: Path, *, log: Path | None = LOG) -> list[Outcome]:
    """Start the cluster, run the job undisturbed and disturbed, compare; the disturbed one's log goes into the docs."""
    data, place = make_data(work / "data"), work / "slurm"
    _call(str(CLUSTER), "start", str(place), str(TASKS))
    settings = environment(SLURM_CONF=str(place / "slurm.conf"))
    try:
        whole, disturbed = work / "slurm_undisturbed", work / "slurm_requeued"
        _wait(_submit(data, whole, work, settings), settings)
        job = _submit(data, disturbed, work, settings)
        output = work / f"{disturbed.name}.out"
        _wait_for(lambda: "step 10" in _text(output), "the tenth step", 180)
        asked = time.monotonic()
        _call("scancel", "--signal=USR1", job, env=settings)
        _wait_for(lambda: "Stopped by SIGUSR1" in _text(output), "the answer to SIGUSR1", 60)
        seconds = time.monotonic() - asked
        step = load_checkpoint(disturbed / "checkpoints" / "last.ckpt")["global_step"]
        _wait(job, settings)
        restarts = _shown(job, "Restarts", settings)
        many = _multirun(data, work, settings)
        steps = [int(number) for number in re.findall(r"^step (\d+)", _text(output), re.M)]
    finally:
        _call(str(CLUSTER), "stop", str(place))
    text = _text(output)
    if log is not None:
        log.parent.mkdir(parents=True, exist_ok=True)
        log.write_text(_portable(text, work))
    went_on = restarts == "1" and f"after step {step};" in text and steps[-1] == STEPS
    first = [next(row["loss"] for row in metrics(run) if row["step"] == str(step + 1)) for run in (whole, disturbed)]
    error = _distance(whole, disturbed)
    seen = f"loss of step {step + 1}: {first[0]} and {first[1]}; weights after step {STEPS} off by {error:.0e}"
    held = first[0] == first[1] and error < MAX_ERROR
    return [
        Outcome("a SLURM job of four tasks saved and requeued itself on SIGUSR1", 1, int(went_on), f"{seconds:.1f} s"),
        Outcome("the requeued job went on from the same bits and ended as an undisturbed one", 1, int(held), seen),
        many,
    ]


def _multirun(data: Path, work: Path, settings: dict[str, str]) -> Outcome:
    """Send one job for each of two seeds through submitit."""
    place = work / "slurm_multirun"
    place.mkdir()
    training = [word for word in words(data, place, 6) if not word.startswith("run.folder=")]
    launcher = ["-m", "hydra/launcher=submitit_slurm", "hydra.launcher.timeout_min=10", "seed=0,1"]
    process = start([*launcher, *training], cwd=place, env=settings)
    output, _ = process.communicate(timeout=600)
    ended = len(list(place.glob("runs/*/*/checkpoints/last.ckpt")))
    if process.returncode != 0:
        print(output[-2000:])
    return Outcome("runs of a multirun became SLURM jobs and ended", 2, ended if process.returncode == 0 else 0)


def _distance(a: Path, b: Path) -> float:
    """Return the largest relative distance of a weight tensor; more than two ranks sum in an order of their own.

    DistributedDataParallel orders its buckets anew after the first step of a process, so a process that went on sums
    gradients of three ranks or more in another order than one that did not stop.
    """
    first, second = (load_checkpoint(run / "checkpoints" / "last.ckpt")["state_dict"] for run in (a, b))
    pairs = [(first[name].float(), second[name].float()) for name in first]
    return max(((x - y).norm() / x.norm().clamp(min=1e-12)).item() for x, y in pairs)


def is_possible() -> bool:
    """Whether this machine has SLURM, or may install it."""
    return shutil.which("slurmctld") is not None or (os.geteuid() == 0 and shutil.which("apt-get") is not None)


def _submit(data: Path, folder: Path, work: Path, settings: dict[str, str]) -> str:
    training = words(
        data, folder, STEPS, "resume=auto", "trainer=ddp", "trainer.accelerator=cpu", f"trainer.devices={TASKS}",
        f"data.batch_size={TASKS}", f"data.num_validation_clips={TASKS}",
    )  # fmt: skip
    script = work / f"{folder.name}.sh"
    output = work / f"{folder.name}.out"
    script.write_text(JOB.format(tasks=TASKS, log=output, python=sys.executable, words=" ".join(training)))
    return _call("sbatch", "--parsable", str(script), env=settings).strip()


def _wait(job: str, settings: dict[str, str]) -> None:
    done = ("COMPLETED", "FAILED", "CANCELLED", "TIMEOUT", "NODE_FAIL", "OUT_OF_MEMORY")
    _wait_for(lambda: _shown(job, "JobState", settings) in done, f"the end of job {job}", 600)
    if (state := _shown(job, "JobState", settings)) != "COMPLETED":
        raise RuntimeError(f"job {job} ended as {state}")


def _shown(job: str, key: str, settings: dict[str, str]) -> str:
    found = re.search(rf"\b{key}=(\S+)", _call("scontrol", "show", "job", job, env=settings))
    return found[1] if found else ""


def _call(*command: str, env: dict[str, str] | None = None) -> str:
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=600, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}:\n{done.stderr}{done.stdout}")
    return done.stdout


def _wait_for(condition, what: str, seconds: float) -> None:  # type: ignore[no-untyped-def]
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            raise RuntimeError(f"{what} did not come within {seconds:.0f} s")
        time.sleep(0.5)


def _text(path: Path) -> str:
    return path.read_text() if path.is_file() else ""


def _portable(text: str, work: Path) -> str:
    """Leave out where this machine keeps things."""
    return text.replace(str(work), "WORK").replace(sys.executable, "python")
