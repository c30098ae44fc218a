"""Find the evaluated runs below some folders, and say why the others are left out."""

import os
import re
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vpd_lightning.comparison.run import Run, UnusableRunError, read_run
from vpd_lightning.comparison.settings import comparable, comparable_settings
from vpd_lightning.errors import ConfigError, DataError

_NEVER_ENTERED = ("checkpoints", "videos", "validation", "pretraining", "__pycache__")


@dataclass(frozen=True)
class Collection:
    """The runs of a report, and those left out with the reason."""

    runs: list[Run]
    left_out: list[tuple[Path, str]]


def collect(folders: Sequence[Path], split: str) -> Collection:
    """Walk ``folders`` for run folders and read each one's newest evaluation of ``split``.

    A run with the same data, system, settings and seed as a newer one is left out: the same training counts once.

    Raises:
        ConfigError: a folder does not exist.
        DataError: no run can be used; the message says what to do.
    """
    for folder in folders:
        if not folder.is_dir():
            raise ConfigError(f"There is no folder {folder}.\nGive folders that hold runs, for example vpd-report runs")
    runs: list[Run] = []
    left_out: list[tuple[Path, str]] = []
    seen: set[Path] = set()
    for folder in folders:
        for place in _run_folders(folder):
            if place.resolve() not in seen:
                seen.add(place.resolve())
                _read_one(place, split, runs, left_out)
    runs = _same_clips(_without_repeats(runs, left_out), left_out)
    if not runs:
        raise DataError(_nothing(folders, split, left_out))
    return Collection(runs, left_out)


def _run_folders(folder: Path) -> Iterator[Path]:
    """Yield every folder with a ``config.yaml`` or an evaluation of its own; nothing inside a run is a run."""
    for place, names, files in os.walk(folder):
        if "config.yaml" in files or "metrics.json" in files:
            names.clear()
            yield Path(place)
        names[:] = sorted(name for name in names if name not in _NEVER_ENTERED and not name.startswith("."))


def _read_one(folder: Path, split: str, runs: list[Run], left_out: list[tuple[Path, str]]) -> None:
    if (folder / "metrics.json").exists():
        left_out.append((folder, "an evaluation without a run: there is no config.yaml of a run around it"))
        return
    evaluations = [path.parent for path in folder.glob("evaluation*/metrics.json")]
    if not evaluations:
        trained = (folder / "checkpoints" / "last.ckpt").exists()
        how = f"vpd-eval ckpt={folder}/checkpoints/last.ckpt" if trained else "and it has no checkpoint"
        left_out.append((folder, f"not evaluated: {how}"))
        return
    usable = []
    for evaluation in sorted(evaluations, key=_age):
        try:
            run = read_run(folder, evaluation)
        except UnusableRunError as error:
            left_out.append((evaluation, str(error)))
        except (KeyError, TypeError, ValueError, AttributeError) as error:  # a file with other content than ours
            left_out.append((evaluation, f"its files are not those of vpd-eval ({type(error).__name__}: {error})"))
        else:
            found = run.metrics["protocol"].get("split")
            if found == split:
                usable.append(run)
            else:
                left_out.append((evaluation, f"it is about the {found} split, and the report about the {split} split"))
    newest = {run.asked_to_differ: run for run in usable}
    older = [run for run in usable if all(run is not other for other in newest.values())]
    left_out += [(run.evaluation, "an older evaluation of the same run: the newest counts") for run in older]
    runs += newest.values()


def _age(evaluation: Path) -> tuple[float, int]:
    number = re.search(r"_(\d+)$", evaluation.name)
    return (evaluation / "metrics.json").stat().st_mtime, int(number[1]) if number else 1


def _without_repeats(runs: Sequence[Run], left_out: list[tuple[Path, str]]) -> list[Run]:
    newest: dict[object, Run] = {}
    for run in sorted(runs, key=lambda run: _age(run.evaluation)):
        settings = _frozen(comparable_settings(run))
        key = (run.experiment, run.data_sha256, run.protocol, run.system, run.seed, settings)
        if key in newest:
            left_out.append((newest[key].folder, f"the same system, settings and seed as the newer {run.folder}"))
        newest[key] = run
    kept = {id(run) for run in newest.values()}
    return [run for run in runs if id(run) in kept]


def _frozen(settings: Mapping[str, Hashable]) -> Hashable:
    return frozenset((key, comparable(settings, key)) for key in settings)


def _same_clips(runs: Sequence[Run], left_out: list[tuple[Path, str]]) -> list[Run]:
    """Leave out what was evaluated on other clips than most of its table: trajectories are compared by their index."""
    groups: dict[object, list[Run]] = {}
    for run in runs:
        groups.setdefault((run.experiment, run.data_sha256, run.protocol), []).append(run)
    kept = []
    for group in groups.values():
        named = [run.clips for run in group if run.clips]
        usual = max(named, key=named.count) if named else ()
        for run in group:
            if run.clips in ((), usual):
                kept.append(run)
            else:
                left_out.append((run.folder, "evaluated on other clips than the other runs of the same protocol"))
    return kept


def _nothing(folders: Sequence[Path], split: str, left_out: Sequence[tuple[Path, str]]) -> str:
    places = ", ".join(str(folder) for folder in folders)
    if not left_out:
        return (
            f"There is no run below {places}.\nTrain one with vpd-train, then vpd-eval ckpt=RUN/checkpoints/last.ckpt."
        )
    lines = [f"{path}: {why}" for path, why in left_out[:2]]
    more = [f"(and {len(left_out) - 2} more)"] if len(left_out) > 2 else []
    return "\n".join([f"No run below {places} can be reported (split {split}):", *lines, *more])
