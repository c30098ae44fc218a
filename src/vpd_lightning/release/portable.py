"""A run's configuration and figures without the machine they come from: no absolute paths, run folders, user names."""

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from vpd_lightning.errors import ConfigError

_OF_THE_RUN = ("run", "logger", "debug", "force", "resume", "num_threads", "sweep_name", "evaluate")
"""Root entries about where and how a run ran, not about what was trained."""

_BUILT = ("model", "encoder", "dynamics", "renderer")
"""Sections that the system is built from: nothing may silently go there."""

DATA_ROOT = "datasets"


def portable_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is needed to build, train and evaluate a model elsewhere.

    Entries of the run itself go; the data's folder becomes relative; every other path of this machine becomes null.

    Raises:
        ConfigError: a section that the system is built from names a file of this machine.
    """
    run = config.get("run") or {}
    places = [str(run[name]) for name in ("folder", "root") if isinstance(run.get(name), str)]
    result = {}
    for name, section in config.items():
        if name in _OF_THE_RUN:
            continue
        result[name] = _without_paths(section, name, places, may_lose=name not in _BUILT)
    if isinstance(result.get("trainer"), dict):
        result["trainer"].pop("default_root_dir", None)
    data = config.get("data")
    if isinstance(data, Mapping) and isinstance(data.get("folder"), str):
        result["data"]["folder"] = portable_data_folder(data["folder"])
    return result


def portable_data_folder(folder: str) -> str:
    """Return a relative folder for a data set: as it is where it leads below some folder, else ``datasets/<its name>``.

    What lies below the current folder is named relative to it.
    """
    path = Path(folder)
    if path.is_absolute() and path.is_relative_to(Path.cwd()):
        path = path.relative_to(Path.cwd())
    if _is_of_this_machine(str(path)) or not path.parts:
        name = PureWindowsPath(folder).name if "\\" in folder else path.name
        path = Path(DATA_ROOT) / (name if name not in ("", "..") else "data")
    return path.as_posix()


def portable_metrics(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Return figures with relative paths: the data set's, and the checkpoint's within its run folder."""
    result = _relative(dict(metrics))
    if isinstance(metrics.get("data"), str):
        result["data"] = portable_data_folder(metrics["data"])
    if isinstance(metrics.get("checkpoint"), str):
        result["checkpoint"] = "/".join(Path(metrics["checkpoint"]).parts[-2:])
    return result


def absolute_paths(value: Any, name: str = "") -> list[str]:
    """Return the names of all entries below ``value`` that are a path of one machine, or lead upwards (``..``)."""
    if isinstance(value, Mapping):
        return [found for key, item in value.items() for found in absolute_paths(item, f"{name}.{key}".strip("."))]
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [found for index, item in enumerate(value) for found in absolute_paths(item, f"{name}[{index}]")]
    return [f"{name}={value}"] if isinstance(value, str) and _is_of_this_machine(value) else []


def _without_paths(value: Any, name: str, places: Sequence[str], *, may_lose: bool) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_paths(item, f"{name}.{key}", places, may_lose=may_lose) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_paths(item, f"{name}[{i}]", places, may_lose=may_lose) for i, item in enumerate(value)]
    if not isinstance(value, str) or not (_is_of_this_machine(value) or _is_below(value, places)):
        return value
    if not may_lose:
        raise ConfigError(
            f"{name}={value} is a file of this machine, and the model cannot be built without it.\n"
            "Train the model without it, then export."
        )
    return None


def _relative(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _relative(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_relative(item) for item in value]
    return Path(value).name if isinstance(value, str) and _is_of_this_machine(value) else value


def _is_of_this_machine(text: str) -> bool:
    windows = PureWindowsPath(text)
    is_windows = "\\" in text and bool(windows.drive or windows.root)
    return PurePosixPath(text).is_absolute() or text.startswith("~") or is_windows or ".." in windows.parts


def _is_below(text: str, places: Sequence[str]) -> bool:
    return any(text == place or text.startswith(f"{place.rstrip('/')}/") for place in places)
