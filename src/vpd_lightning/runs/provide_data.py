"""Where a data set is missing: make it where it is the experiment's own, else say how. Refuse what is not trusted."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from vpd_lightning.data.manifest import FILE_NAME, did_you_mean, load_manifest
from vpd_lightning.errors import ConfigError, DataError

_HOME = "datasets"
"""Where the data sets of our experiments lie, each called after its experiment or scene, and its preset."""


def provide_data(
    config: Mapping[str, Any], overrides: Sequence[str] | None = None, only: tuple[str, int] | None = None
) -> Path:
    """Generate the data set of a training's configuration where it is missing and ``generate.when_missing`` is true.

    A folder that was given by name is not filled: it may be a mistyped one. What was given by name, ``overrides`` say
    (the words of the command line); where they are not known, every folder but the experiment's own counts as given.

    Args:
        config: of a training.
        overrides: the words of the command line.
        only: a split and the number of the one trajectory of it that is needed. A missing data set is then not made
            whole, but as far as that trajectory, in a folder of its own beside it; a trajectory is the same in both.

    Returns:
        The folder of the data set.

    Raises:
        DataError: it is missing, and nothing makes it here.
    """
    folder, wanted = Path(config["data"]["folder"]), config.get("generate")
    if (folder / FILE_NAME).is_file():
        return folder
    missing = f"there is no data set in {folder} (no {FILE_NAME}).{did_you_mean(folder)}"
    if wanted is None or wanted["scene"] is None:
        raise DataError(
            f"{missing}\nPoint data.folder at one; vpd-data --help says how to generate or import recordings."
        )
    command = f"vpd-data generate scene={wanted['scene']} preset={wanted['preset']} out={folder}"
    if not wanted["when_missing"]:
        raise DataError(
            f"{missing}\nMake it: {command}\n"
            "Or first check that everything works, on a tiny data set that is generated automatically: budget=tiny"
        )
    if not _may_fill(folder, config, overrides):
        raise DataError(
            f"{missing}\nA folder that is given by name is not generated automatically. Correct data.folder,\n"
            f"or make it: {command}\nor have it made: generate.when_missing=true"
        )
    if int(os.environ.get("LOCAL_RANK", "0")) > 0:
        raise DataError(f"there is no data set in {folder}.\nMake it before training on several devices: {command}")
    settings = {"scene": wanted["scene"], "preset": wanted["preset"], "seed": wanted["seed"]}
    if only is not None:
        return _provide_one(folder, settings, *only)
    from data_gen.generate import generate

    print(f"there is no data set in {folder}; making it: {command}", flush=True)
    return generate(**settings, out=folder)


def _provide_one(whole: Path, settings: dict[str, Any], split: str, number: int) -> Path:
    """Generate a split as far as one trajectory, in a folder called after both; one that goes as far is taken.

    Raises:
        ConfigError: the whole data set would not have that trajectory.
        DataError: a folder of that name holds recordings of other settings.
    """
    from data_gen.generate import generate, make_plan

    counts = asdict(make_plan(out=whole, overrides={}, **settings).settings.splits)
    if not 0 <= number < counts.get(split, 0):
        has = ", ".join(f"{name} {count}" for name, count in counts.items())
        raise ConfigError(
            f"There is no trajectory {number} in split {split}.\nThe data set has, counted from 0: {has}."
        )
    name = f"{whole.name}_{split}_"
    there = [path.parent.name.removeprefix(name) for path in whole.parent.glob(f"{name}*/{FILE_NAME}")]
    count = min((int(end) for end in there if end.isdecimal() and int(end) > number), default=number + 1)
    folder = whole.with_name(f"{name}{count}")
    sizes = {f"splits.{other}": count * (other == split) for other in counts}
    if not (folder / FILE_NAME).is_file():
        words = " ".join(f"{key}={value}" for key, value in (settings | sizes | {"out": folder}).items())
        print(f"there is no data set in {whole}; making what is shown of it: vpd-data generate {words}", flush=True)
    return generate(**settings, out=folder, overrides=sizes)  # where it is there, whether it has these settings


def require_trusted_data(config: Mapping[str, Any]) -> None:
    """Refuse a data set that failed validation or was never validated, unless ``force`` is true.

    Raises:
        DataError: see ``data.verdict.require_trusted``.
    """
    from vpd_lightning.data.verdict import require_trusted

    if not config.get("force"):
        require_trusted(load_manifest(config["data"]["folder"]))


def _may_fill(folder: Path, config: Mapping[str, Any], overrides: Sequence[str] | None) -> bool:
    wanted = config["generate"]
    own = [Path(_HOME) / f"{name}_{wanted['preset']}" for name in (config.get("experiment"), wanted["scene"])]
    if folder in own:
        return True
    if overrides is None:
        return False
    words = [word.lstrip("+") for word in overrides]
    is_asked = "generate.when_missing=true" in [word.lower() for word in words]
    return is_asked or not any(word.startswith("data.folder=") for word in words)
