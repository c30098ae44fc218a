"""Thousands of mutated files for the reader of trajectories and for the importers of recordings."""

import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import h5py
import numpy as np

from tests.data.hostile_files import HARMS
from tests.data.recordings import make_trajectory
from tests.data_gen.importers import sources
from tests.reliability.opened_files import OpenedFiles
from tests.reliability.outcome import Outcome
from tests.reliability.trainings import environment
from vpd_lightning.data.schema import COMPRESSIONS, write_trajectory

NUM_FILES, NUM_SOURCES = 10_000, 1_000
OUTSIDE = "outside.h5"
_LINKS = ("external storage", "virtual data set", "external link")


def reader(work: Path, *, count: int = NUM_FILES) -> list[Outcome]:
    """Mutate whole and hostile trajectories; a watched file beside them stands for all that must not be opened."""
    folder = work / "reader"
    (folder / "mutants").mkdir(parents=True)
    watched = _make_trajectories(folder)
    with OpenedFiles(watched) as opened:
        shutil.copy(folder / "hostile" / "external_link.h5", folder / "mutants" / "naive.h5")
        with h5py.File(folder / "mutants" / "naive.h5") as file:  # the watch works: HDF5 follows such a link
            file["rgb"]
        if not opened.count():
            raise RuntimeError("the watch saw nothing of a file that was opened")
        counts, deaths, kept = _fuzz("reader", folder, count, seed=1)
        num_opened = opened.count()
    outcomes = _outcomes("mutated trajectories", counts, deaths, kept, count)
    seen = "links, external storage and virtual data sets to other files among them"
    return [*outcomes, Outcome("mutated trajectories opened no other file", count, count - num_opened, seen)]


def importers(work: Path, *, count: int = NUM_SOURCES) -> list[Outcome]:
    """Mutate recordings of every format that can be imported."""
    folder = work / "importers"
    (folder / "mutants").mkdir(parents=True)
    formats = sources.write_all(folder / "good")
    counts, deaths, kept = _fuzz("importers", folder, count, seed=2)
    return _outcomes(f"mutated recordings of {len(formats)} formats", counts, deaths, kept, count)


def _make_trajectories(folder: Path) -> list[Path]:
    """Write whole files of every compression and one for each known harm; return what none of them may open."""
    whole, hostile, outside = folder / "whole", folder / "hostile", folder / "mutants" / OUTSIDE
    whole.mkdir()
    hostile.mkdir()
    trajectory = make_trajectory(5, num_frames=6, num_views=3)
    for name in COMPRESSIONS:
        write_trajectory(whole / f"{name}.h5", trajectory, compression=name)
    write_trajectory(outside, trajectory)
    for name, (harm, _) in HARMS.items():
        path = hostile / (re.sub(r"\W+", "_", name) + ".h5")
        write_trajectory(path, trajectory)
        with h5py.File(path, "r+") as file:
            _link_outside(file, name) if name in _LINKS else harm(file)
        if path.stat().st_size > 2**20:  # bombs would take all the time
            path.unlink()
    return [outside]


def _link_outside(file: h5py.File, how: str) -> None:
    if how == "external link":
        del file["rgb"]
        file["rgb"] = h5py.ExternalLink(OUTSIDE, "/rgb")
        return
    shape = file["depth"].shape
    del file["depth"]
    if how == "external storage":
        size = int(np.prod(shape)) * 4
        file.create_dataset("depth", shape, np.float32, external=[(OUTSIDE, 0, size)])
        return
    layout = h5py.VirtualLayout(shape, np.float32)
    layout[:] = h5py.VirtualSource(OUTSIDE, "depth", shape)
    file.create_virtual_dataset("depth", layout)


def _fuzz(target: str, folder: Path, count: int, seed: int) -> tuple[Counter[str], list[str], list[str]]:
    """Return how often each thing happened, how children died, and the errors nobody meant."""
    counts: Counter[str] = Counter()
    deaths: list[str] = []
    others: list[str] = []
    number = 0
    while number < count:
        command = [sys.executable, "-m", "tests.reliability.fuzz_child", target, str(folder)]
        process = subprocess.Popen(
            [*command, str(number), str(min(count - number, 2500)), str(seed)],
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment(),
        )  # fmt: skip
        last = number - 1
        for line in process.stdout or ():
            index, _, what = line.strip().partition(" ")
            if what:
                last = int(index)
                counts[what.split()[0]] += 1
                if what.startswith("other"):
                    others.append(f"{index}: {what}")
        if process.wait() != 0:  # at the file after the last one
            last += 1
            counts["died"] += 1
            deaths.append(f"{last}: exit {process.returncode}")
        number = last + 1
    return counts, deaths, others


def _outcomes(what: str, counts: Counter[str], deaths: list[str], others: list[str], count: int) -> list[Outcome]:
    seen = f"{counts['refused']:,} refused by a named error, {counts['read']:,} read"
    first = "; ".join([*deaths, *others][:5])
    if os.environ.get("VPD_FUZZ_VERBOSE"):
        print("\n".join([*deaths, *others]))
    return [
        Outcome(f"{what} crashed and hung no process", count, count - len(deaths), "; ".join(deaths[:5])),
        Outcome(f"{what} were read, or refused by a named error", count, count - len(others), f"{seen}. {first}"),
    ]
