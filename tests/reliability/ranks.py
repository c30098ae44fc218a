"""Many processes train as one does; where one of them dies, the others end."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import torch

from tests.data.recordings import write_recordings
from tests.reliability.outcome import Outcome
from tests.reliability.trainings import environment, kill_group, make_data, members, start, words
from vpd_lightning.training.checkpoint_files import load_checkpoint

WORLD = 16


def ranks(work: Path, *, world: int = WORLD) -> list[Outcome]:
    """Compare one process with a batch of ``world`` to ``world`` processes with one clip each, and so on."""
    data = write_recordings(work / "recordings", num_train=5)
    one, many = work / "one_rank", work / "many_ranks"
    _train(data, one, 1, world, 3)
    _train(data, many, world, world, 3)
    return [_gradients(one, many, world), _clips(one, many, world), _resumed(data, work), *_killed(work), _asked(work)]


def _train(data: Path, run: Path, devices: int, batch: int, steps: int) -> None:
    command = [sys.executable, "-m", "tests.reliability.ranks_child", str(data), str(run)]
    command += [str(devices), str(batch), str(steps)]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=600, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{devices} processes ended with {done.returncode}:\n{done.stderr[-3000:]}")


def _gradients(one: Path, many: Path, world: int) -> Outcome:
    first, second = (torch.load(run / "gradients.pt", weights_only=True) for run in (one, many))
    if first.keys() != second.keys() or not first:
        return Outcome("gradients of many ranks equal those of one", 1, 0, "other parameters")
    errors = [((second[name] - first[name]).norm() / first[name].norm()).item() for name in first]
    seen = f"1 rank with {world} clips against {world} ranks with one, float64: off by {max(errors):.1e} at most"
    return Outcome(
        "gradients of many ranks equal those of one", len(errors), sum(error <= 1e-6 for error in errors), seen
    )


def _given(run: Path, world: int) -> dict[str, list[str]]:
    """Return the clips of each step over all ranks."""
    found: dict[str, list[str]] = {}
    for rank in range(world):
        for step, clips in json.loads((run / f"clips_{rank}.json").read_text()).items():
            found.setdefault(step, []).extend(clips)
    return {step: sorted(clips) for step, clips in found.items()}


def _clips(one: Path, many: Path, world: int) -> Outcome:
    first, second = _given(one, 1), _given(many, world)
    held = sum(first[step] == second.get(step) and len(first[step]) == world for step in first)
    return Outcome("steps of many ranks used the clips of one", len(first), held, f"{world} clips a step")


def _resumed(data: Path, work: Path) -> Outcome:
    """Two processes that stop after five of ten steps and go on."""
    whole, halves = work / "two_whole", work / "two_halves"
    _train(data, whole, 2, 4, 10)
    _train(data, halves, 2, 4, 5)
    # The length of a training is in its schedule: the first half is taken from one that was to be ten long.
    (halves / "checkpoints" / "last.ckpt").write_bytes((whole / "checkpoints" / "last-previous.ckpt").read_bytes())
    step = load_checkpoint(halves / "checkpoints" / "last.ckpt")["global_step"]
    _train(data, halves, 2, 4, 10)
    a, b = (load_checkpoint(run / "checkpoints" / "last.ckpt")["state_dict"] for run in (whole, halves))
    is_equal = all(torch.equal(a[name], b[name]) for name in a)
    used = [_given(run, 2) for run in (whole, halves)]
    held = is_equal and all(used[0][str(index)] == used[1][str(index)] for index in range(step, 10))
    return Outcome(
        "two ranks that went on ended bitwise as two that were not stopped", 1, int(held), f"after step {step} of 10"
    )


def _started(folder: Path, data: Path) -> tuple[subprocess.Popen[str], dict[str, int]]:
    """Start a real ``vpd-train trainer=ddp_cpu`` and return it, five steps later, with its two processes."""
    process = start(words(data, folder, 100_000, "trainer=ddp_cpu"))
    for line in process.stdout or ():
        if line.startswith("step 5"):
            break
    (second,) = [item for item in members(process.pid) if item != process.pid and _is_training(item)]
    return process, {"the first": process.pid, "the second": second}


def _asked(work: Path) -> Outcome:
    """Ask one of two processes to stop; both must, together, with a checkpoint."""
    data = make_data(work / "data")
    held, seen = 0, []
    for asked in ("the first", "the second"):
        folder = work / f"asked_{asked.replace(' ', '_')}"
        process, ranks = _started(folder, data)
        os.kill(ranks[asked], signal.SIGTERM)
        output, _ = process.communicate(timeout=60)
        step = load_checkpoint(folder / "checkpoints" / "last.ckpt")["global_step"]
        is_told = f"Stopped by SIGTERM after step {step}" in output
        held += process.returncode == 128 + signal.SIGTERM and is_told and not members(process.pid)
        seen.append(f"{asked}: exit code {process.returncode}, step {step}")
        if os.environ.get("VPD_RANKS_VERBOSE"):
            print(output[-3000:])
    return Outcome("when one of two processes was asked to stop, both saved and stopped", 2, held, "; ".join(seen))


def _killed(work: Path) -> list[Outcome]:
    """Kill one of two processes: the second, and then the first."""
    data = make_data(work / "data")
    outcomes = []
    for victim in ("the second", "the first"):
        folder = work / f"killed_{victim.replace(' ', '_')}"
        process, ranks = _started(folder, data)
        began = time.monotonic()
        os.kill(ranks[victim], signal.SIGKILL)
        while members(process.pid) and time.monotonic() - began < 120:
            time.sleep(0.2)
        seconds = time.monotonic() - began
        left = members(process.pid)
        kill_group(process.pid)
        output, _ = process.communicate(timeout=60)
        is_told = "another of the 2 processes of this training is gone" in output and "Traceback" not in output
        held = not left and seconds < 60 and process.returncode != 0 and is_told
        seen = f"{seconds:.0f} s, exit code {process.returncode}"
        outcomes.append(Outcome(f"when {victim} of two processes was killed, the other ended", 1, int(held), seen))
        if os.environ.get("VPD_RANKS_VERBOSE"):
            print(output[-3000:])
    return outcomes


def _is_training(process: int) -> bool:
    """Whether a process is ``vpd-train`` and no loader worker of it."""
    try:
        parts = Path(f"/proc/{process}/environ").read_bytes().split(b"\0")
        command = Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return False
    return b"vpd_lightning.commands.train" in command and any(part.startswith(b"LOCAL_RANK=") for part in parts)
