"""``resume=...``: which run to go on with, and with which settings."""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from vpd_lightning.config.migrations import ADDED_SETTINGS
from vpd_lightning.errors import CheckpointError, ConfigError
from vpd_lightning.moved import current_name

OVERRIDES_FILE = "overrides.yaml"
CONFIG_FILES = "config*.yaml"  # config.resumed-N.yaml of a run that was resumed


def resumed_overrides(overrides: Sequence[str], config_dir: str | Path | None = None) -> list[str]:
    """Return the overrides of the run to go on with, followed by the new ones; without ``resume``, the given ones.

    Settings that came after the run began are added as they were without them, for its weights are those of a model
    that has not got them.

    ``resume=FOLDER`` names a run folder, ``resume=last`` the latest one (of the experiment, where one is given),
    ``resume=auto`` goes on with ``run.folder`` where that holds a checkpoint and starts it otherwise (the caller makes
    room where a run died there before its first checkpoint).

    Raises:
        ConfigError: ``resume=auto`` without ``run.folder``.
        CheckpointError: there is no run to resume, or its settings cannot be read.
    """
    given = _as_mapping(overrides)
    wanted = _unquote(given.get("resume", "null"))
    if wanted in ("null", ""):
        return list(overrides)
    if wants_auto(overrides):
        if "run.folder" not in given:
            raise ConfigError("resume=auto needs to know the folder.\nAdd run.folder=FOLDER, or use resume=last.")
        folder = Path(_unquote(given["run.folder"])).expanduser()
        if not has_checkpoint(folder):
            return [word for word in overrides if not word.startswith("resume=")]
    elif wanted == "last":
        folder = _youngest_run(Path(_unquote(given.get("run.root", "runs"))), given.get("experiment"))
    else:
        folder = Path(wanted).expanduser()
    if not has_checkpoint(folder):
        raise CheckpointError(
            f"there is nothing to resume in {folder}.\nIt holds no checkpoints/last.ckpt.\n"
            "Name the folder of a run (resume=runs/EXPERIMENT/RUN), or remove resume to start anew."
        )
    merged = _as_mapping([*_saved_overrides(folder), *overrides])
    merged["resume"] = merged["run.folder"] = quote(str(folder.absolute()))
    words = [f"{key}={value}" for key, value in merged.items()]
    later = {key: value for key, value in _later_settings(_saved_config(folder)) if not _is_given(key, merged)}
    if later:  # composing takes half a second
        from vpd_lightning.config import compose

        composed = compose("train", words, config_dir)
        words += [f"{key}={_word(value)}" for key, value in later.items() if _value(composed, key, value) != value]
    return words


def _later_settings(config: Mapping[str, Any], where: str = "") -> Iterator[tuple[str, Any]]:
    """Yield what a stored configuration of an older version lacks, with the value that leaves its model as it was."""
    for name, section in config.items():
        if isinstance(section, Mapping):
            yield from _later_settings(section, f"{where}{name}.")
            for key, value in ADDED_SETTINGS.get(current_name(str(section.get("_target_"))), {}).items():
                if key not in section:
                    yield f"{where}{name}.{key}", value


def _is_given(key: str, words: Mapping[str, str]) -> bool:
    """Whether words set a key, or a section that it is in: ``renderer={far_pixels: true}``."""
    parts = key.split(".")
    sections = (".".join(parts[:count]) for count in range(1, len(parts)))
    return key in words or any(words.get(section, "").startswith("{") for section in sections)


def _value(config: Any, key: str, default: Any) -> Any:
    """Return the value of a dotted key; the default where there is no such key."""
    for name in key.split("."):
        if not isinstance(config, Mapping) or name not in config:
            return default
        config = config[name]
    return config


def _word(value: Any) -> str:
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def wants_auto(overrides: Sequence[str]) -> bool:
    """Whether the words say ``resume=auto``."""
    return _unquote(_as_mapping(overrides).get("resume", "null")) == "auto"


def has_checkpoint(folder: Path) -> bool:
    """Whether a run folder holds a checkpoint to go on from, be it of the first of two trainings."""
    from vpd_lightning.config.pretraining import FOLDER as FIRST

    return has_own_checkpoint(folder) or has_own_checkpoint(folder / FIRST)


def has_own_checkpoint(folder: Path) -> bool:
    """Whether the training that writes to this very folder has saved a checkpoint."""
    from vpd_lightning.training.checkpoint_files import LAST, PREVIOUS
    from vpd_lightning.training.checkpoints import FOLDER

    return any((folder / FOLDER / name).is_file() for name in (LAST, PREVIOUS))


def _youngest_run(root: Path, experiment: str | None) -> Path:
    from vpd_lightning.training.checkpoints import last_saved, latest_run

    folders = [root / _unquote(experiment)] if experiment else sorted(path for path in root.glob("*") if path.is_dir())
    runs = []
    for folder in folders:
        try:
            runs.append(latest_run(folder))
        except CheckpointError:
            continue  # this experiment has no run with a checkpoint
    if not runs:
        of = f" of experiment {experiment}" if experiment else ""
        raise CheckpointError(
            f"there is nothing to resume in {root.absolute()}.\nNo run{of} there has saved a checkpoint.\n"
            "Remove resume=last to start a run, or name the folder of one: resume=FOLDER"
        )
    return max(runs, key=lambda run: last_saved(run) or 0.0)


def _as_mapping(overrides: Sequence[str]) -> dict[str, str]:
    """Split the words; a later one replaces an earlier one of the same key."""
    merged: dict[str, str] = {}
    for word in overrides:
        key, _, value = word.partition("=")
        merged.pop(key, None)
        merged[key] = value
    return merged


def _saved_overrides(folder: Path) -> list[str]:
    path = folder / OVERRIDES_FILE
    try:
        words = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        raise CheckpointError(
            f"cannot read {path}, so the settings of the run are unknown.\n{str(error).splitlines()[0]}\n"
            "Restore the file, or start anew."
        ) from error
    if not isinstance(words, list) or not all(isinstance(word, str) and "=" in word for word in words):
        raise CheckpointError(f"{path} is not a list of overrides.\nRestore the file, or start anew.")
    return words


def _saved_config(folder: Path) -> Mapping[str, Any]:
    """Return the configuration with which the run was started or resumed last; empty where there is none to read."""
    try:
        youngest = max(folder.glob(CONFIG_FILES), key=lambda path: int(path.stem.partition("resumed-")[2] or 0))
        config = yaml.safe_load(youngest.read_text(encoding="utf-8"))
    except (ValueError, OSError, yaml.YAMLError):  # ValueError: there is none, it is no text, or has another name
        return {}
    return config if isinstance(config, Mapping) else {}


def _unquote(value: str) -> str:
    return value[1:-1] if len(value) > 1 and value[0] == value[-1] and value[0] in "'\"" else value


def quote(value: str) -> str:
    """Quote what Hydra's grammar would not read as one word."""
    return value if re.fullmatch(r"[\w./-]+", value) else "'" + value.replace("'", "\\'") + "'"
