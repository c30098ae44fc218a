"""Reading a source's text files: JSON of sane size, and names that stay inside the source's folder."""

import json
import math
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from vpd_lightning.errors import DataError

MAX_JSON_BYTES = 256 * 2**20


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        DataError: missing, too large, not JSON, or not an object.
    """
    if not path.is_file():
        raise DataError(f"{path} is missing.")
    if path.stat().st_size > MAX_JSON_BYTES:
        raise DataError(f"{path} has {path.stat().st_size} bytes, more than the allowed {MAX_JSON_BYTES}.")
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except (ValueError, OSError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise DataError(f"{path} cannot be read as JSON: {reason}.") from error
    if not isinstance(content, dict):
        raise DataError(f"{path} holds a {type(content).__name__}; a JSON object {{...}} is needed.")
    return content


def inside(folder: Path, name: object, where: str) -> Path:
    """Return the path of a file that a source names, refusing names (and links) that lead out of ``folder``.

    ``where`` says who names it, for example ``transforms.json, frame 3: file_path``.
    """
    if not isinstance(name, str) or not name or "\0" in name:
        raise DataError(f"{where} is {name!r}; a file name is needed.")
    relative = PurePosixPath(name.replace("\\", "/"))
    path = folder / relative
    if relative.is_absolute() or ".." in relative.parts or not path.resolve().is_relative_to(folder.resolve()):
        raise DataError(
            f"{where} is {name!r}, which leads out of {folder}.\nOnly files inside the source are read: copy it there."
        )
    return path


def number(content: Mapping[str, Any], key: str, where: str, default: float | None = None) -> float:
    """Return a finite number of a JSON object, or raise ``DataError`` that names it."""
    value = content.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        given = "missing" if value is None else repr(value)
        raise DataError(f"{where}: {key!r} is {given}; a number is needed.")
    return float(value)


def positive(content: Mapping[str, Any], key: str, where: str, default: float | None = None) -> float:
    """Return a number above 0 of a JSON object, or raise ``DataError`` that names it."""
    value = number(content, key, where, default)
    if value <= 0:
        raise DataError(f"{where}: {key!r} is {value}; it must be above 0.")
    return value


def choice(content: Mapping[str, Any], key: str, where: str, choices: Mapping[Any, str]) -> Any:
    """Return one of a few values of a JSON object; ``choices`` maps each to its meaning, shown in the error."""
    value = content.get(key)
    if isinstance(value, bool) or not isinstance(value, str | int | float) or value not in choices:
        given = "missing" if value is None else f"{value!r}"
        meanings = ", ".join(f"{json.dumps(name)} ({meaning})" for name, meaning in choices.items())
        raise DataError(f"{where}: {key!r} is {given}.\nGive one of {meanings}.")
    return value
