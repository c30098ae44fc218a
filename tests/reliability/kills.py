"""Fifty SIGKILLs at random moments, twenty of them inside the writing of a checkpoint; then signals that ask.

Each chain is one training that is killed ten times and gone on with by ``resume=auto``, as a cluster's queue would.
Its end must equal, bit for bit, that of a training nobody disturbed. Runs and temporary files lie on different file
systems where the machine has two.
"""

import os
import random
import signal
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.reliability.killed_training import PLACES
from tests.reliability.outcome import Outcome
from tests.reliability.trainings import differences, kill_group, make_data, members, run, start, words
from vpd_lightning.training.checkpoint_files import load_checkpoint

STEPS = 240
SIGNALS = {signal.SIGTERM: 143, signal.SIGINT: 130, signal.SIGUSR1: 138}


def other_file_system(folder: Path) -> Path:
    """Return a folder for temporary files that lies on another file system than ``folder``, if there is one."""
    for candidate in (Path("/dev/shm"), Path("/tmp"), Path("/var/tmp")):
        if candidate.is_dir() and os.access(candidate, os.W_OK) and candidate.stat().st_dev != folder.stat().st_dev:
            return candidate
    return folder


def chain(data: Path, folder: Path, temporary: Path, seed: int, num_kills: int, num_in_writing: int) -> list[str]:
    """Kill one training again and again, then let it end; return the places where it was killed."""
    draw = random.Random(seed)
    kinds = [True] * num_in_writing + [False] * (num_kills - num_in_writing)
    draw.shuffle(kinds)
    training = words(data, folder, STEPS, "resume=auto", f"data.num_workers={seed % 2}")
    environment = {**os.environ, "TMPDIR": str(temporary), "OMP_NUM_THREADS": "1"}
    killed = []
    for in_writing in kinds:
        place = draw.choice(PLACES) if in_writing else "anywhere"
        if in_writing:
            module = ("tests.reliability.killed_training", place, str(draw.randint(2, 6)))
            process = start(training, *module, env=environment)
            output, _ = process.communicate(timeout=300)
        else:
            process = start(training, env=environment)
            _wait_for_a_step_perhaps(process, draw)
            process.kill()
            output, _ = process.communicate(timeout=300)
        if process.returncode != -signal.SIGKILL:
            raise RuntimeError(f"killed {place}, but it ended with {process.returncode}:\n{output[-2000:]}")
        _no_orphans(process.pid)
        killed.append(place)
    run(training, env=environment)
    return killed


def _wait_for_a_step_perhaps(process: subprocess.Popen[str], draw: random.Random) -> None:
    """Wait for a random step that it prints; one time in five for none. Then for a moment, to be anywhere in a step."""
    steps = 0 if draw.random() < 0.2 else draw.randint(1, max(STEPS // 12, 1))
    printed = (line for line in process.stdout or () if line.startswith("step "))
    for _ in range(steps):
        next(printed, None)
    time.sleep(draw.uniform(0.0, 0.1))


def _no_orphans(group: int) -> None:
    deadline = time.monotonic() + 30
    while members(group):
        if time.monotonic() > deadline:
            kill_group(group)
            raise RuntimeError("loader workers outlived their training by 30 s")
        time.sleep(0.1)


def kills(work: Path, *, num_chains: int = 5, num_kills: int = 10, num_in_writing: int = 4) -> list[Outcome]:
    """Run the chains, two at a time."""
    data, whole = make_data(work / "data"), work / "undisturbed"
    run(words(data, whole, STEPS))
    temporary = other_file_system(work)
    folders = [work / f"killed_{number}" for number in range(num_chains)]
    with ThreadPoolExecutor(2) as pool:
        jobs = [
            pool.submit(chain, data, folder, temporary, seed, num_kills, num_in_writing)
            for seed, folder in enumerate(folders)
        ]
        killed = [job.result() for job in jobs]
    places = [place for one in killed for place in one]
    equal = [not differences(whole, folder) for folder in folders]
    in_writing = sum(place != "anywhere" for place in places)
    systems = "different file systems" if temporary.stat().st_dev != work.stat().st_dev else "ONE file system"
    seen = f"{in_writing} inside the writing of a checkpoint; runs and temporary files on {systems}"
    return [
        Outcome("trainings killed with SIGKILL at random moments went on", len(places), len(places), seen),
        Outcome("such trainings ended bitwise equal to an undisturbed one", len(equal), sum(equal)),
    ]


def signals(work: Path) -> list[Outcome]:
    """Ask a training to end by each signal, twice; it must be gone on with, and end equal."""
    data, whole = make_data(work / "data"), work / "undisturbed"
    if not whole.is_dir():
        run(words(data, whole, STEPS))
    held, waits = 0, []
    for number, code in SIGNALS.items():
        folder = work / signal.Signals(number).name
        training = words(data, folder, STEPS, "resume=auto")
        process = start(training)
        for line in process.stdout or ():
            if line.startswith("step 10"):
                break
        asked = time.monotonic()
        process.send_signal(number)
        output, _ = process.communicate(timeout=60)
        waits.append(time.monotonic() - asked)
        step = load_checkpoint(folder / "checkpoints" / "last.ckpt")["global_step"]
        is_told = f"after step {step}; last.ckpt is saved" in output
        run(training)
        held += process.returncode == code and waits[-1] < 30 and is_told and not differences(whole, folder)
    seen = f"SIGTERM, SIGINT, SIGUSR1: exit codes 143, 130, 138; at most {max(waits):.1f} s; equal to the end"
    return [Outcome("signals ended a training after its step, saved, and it went on", len(SIGNALS), held, seen)]
