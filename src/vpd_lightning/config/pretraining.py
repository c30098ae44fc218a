"""The first of two trainings: its configuration is the main one with the section ``pretraining.settings`` over it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

FOLDER = "pretraining"


def pretraining_config(config: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the resolved configuration of the training that comes first, or None where there is none.

    It writes to ``<run folder>/pretraining``, gets its share of the time budget, and is not evaluated. ``config`` stays
    as it is.
    """
    section = config.get("pretraining")
    if not section:
        return None
    own = str(config["run"]["folder"])
    inner = str(Path(own) / FOLDER)
    result: dict[str, Any] = _moved(_merged(config, section["settings"]), own, inner)
    result.update(pretraining=None, evaluate=False)
    budget = (result.get("callbacks") or {}).get("time_budget")
    if budget and budget["minutes"] is not None:
        budget["minutes"] *= section["share"]
    return result


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Merge key by key; what names another class replaces the section whole, because its arguments are others."""
    result = dict(base)
    for key, value in over.items():
        old = base.get(key)
        is_other = isinstance(value, Mapping) and isinstance(old, Mapping) and _is_other_class(old, value)
        if isinstance(value, Mapping) and isinstance(old, Mapping) and not is_other:
            result[key] = _merged(old, value)
        else:
            result[key] = value
    return result


def _is_other_class(old: Mapping[str, Any], new: Mapping[str, Any]) -> bool:
    return "_target_" in new and new["_target_"] != old.get("_target_")


def _moved(value: Any, folder: str, inner: str) -> Any:
    """Copy, with paths into the run folder (of loggers and the trainer) turned into paths into the inner one."""
    if isinstance(value, Mapping):
        return {key: _moved(item, folder, inner) for key, item in value.items()}
    if isinstance(value, list):
        return [_moved(item, folder, inner) for item in value]
    if isinstance(value, str) and (value == folder or value.startswith(f"{folder}/")):
        return inner + value[len(folder) :]
    return value
