"""The folder of a released model: which files it holds, and reading it so that nothing in it can run or be damaged."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from vpd_lightning.data.trained_on import TRAINED_ON
from vpd_lightning.errors import CheckpointError
from vpd_lightning.metrics.registry import HEADLINE
from vpd_lightning.release.portable import absolute_paths

if TYPE_CHECKING:
    from torch import Tensor

FORMAT_VERSION = 1
WEIGHTS_FILE = "model.safetensors"
CONFIG_FILE = "config.yaml"
METRICS_FILE = "metrics.json"
CARD_FILE = "README.md"
INDEX_FILE = "release.json"
PROGRAM_FILE = "renderer.pt2"
CHECKED_FILES = (WEIGHTS_FILE, CONFIG_FILE, METRICS_FILE)
"""Files whose SHA-256 stands in the index, as that of a renderer's program does; the card is for people."""

_MAX_TEXT_BYTES = 4 * 2**20
_MAX_INDEX_BYTES = 64 * 2**20  # it names every trajectory of the training
_AGAIN = "Fetch the folder again, or export the model again with vpd-export."


@dataclass(frozen=True)
class ReleasedModel:
    """What a released folder holds: weights by their names in the system's state dict, and how to build the system.

    ``sha256`` is that of the weights' file; ``trained_on`` holds those of the trajectories a training saw, where known.
    """

    path: Path
    weights: "dict[str, Tensor]"
    config: dict[str, Any]
    step: int
    sha256: str
    trained_on: list[str] | None


class _PlainLoader(yaml.SafeLoader):
    """YAML without anchors: a few lines of references to references could stand for more than memory holds."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("it refers to itself with an alias (*), which our files never do")
        return super().compose_node(parent, index)


def is_release(path: Path) -> bool:
    """Tell whether a path is a released folder (complete or not), or the weights in one."""
    if path.is_dir():
        return (path / INDEX_FILE).is_file() or (path / WEIGHTS_FILE).is_file()
    return path.name == WEIGHTS_FILE and path.is_file()


def read_release(path: Path) -> ReleasedModel:
    """Read a released folder (or the weights in one); every file must be as it was when it was exported.

    Raises:
        CheckpointError: a file is missing, damaged, or of another kind than ours.
    """
    folder = path if path.is_dir() else path.parent
    index = read_index(folder)
    content = {name: _checked_bytes(folder / name, index["sha256"]) for name in (WEIGHTS_FILE, CONFIG_FILE)}
    return ReleasedModel(
        path=folder / WEIGHTS_FILE,
        weights=_parse_weights(folder / WEIGHTS_FILE, content[WEIGHTS_FILE]),
        config=_parse_config(folder / CONFIG_FILE, content[CONFIG_FILE]),
        step=index["step"],
        sha256=index["sha256"][WEIGHTS_FILE],
        trained_on=index.get(TRAINED_ON),
    )


def read_index(folder: Path) -> dict[str, Any]:
    """Read ``release.json``: name, system, step, number of parameters, and the SHA-256 of each file.

    Raises:
        CheckpointError: it is missing, or not an index of ours.
    """
    path = folder / INDEX_FILE
    text = _read_bytes(path, _MAX_INDEX_BYTES)
    try:
        index = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"{path} is damaged: {error}.\n{_AGAIN}") from error
    version = index.get("format_version") if isinstance(index, dict) else None
    if version != FORMAT_VERSION:
        raise CheckpointError(f"{path} has format version {version!r}; this program reads version {FORMAT_VERSION}.")
    digests = index.get("sha256")
    is_whole = isinstance(digests, dict) and all(isinstance(digests.get(name), str) for name in CHECKED_FILES)
    wanted = {"name": str, "system": str, "experiment": str, "step": int, "num_parameters": int, HEADLINE: int | float}
    wrong = [
        name for name, kind in wanted.items() if not isinstance(index.get(name), kind) or isinstance(index[name], bool)
    ]
    if not isinstance(index.get(TRAINED_ON), list | None):
        wrong.append(TRAINED_ON)
    if wrong or not is_whole:
        raise CheckpointError(f"{path} lacks {', '.join([*wrong, *(() if is_whole else ('checksums',))])}.\n{_AGAIN}")
    return index


def check_release(folder: Path) -> dict[str, Any]:
    """Compare every file of a released folder with its checksum, without opening the weights; returns the index.

    Raises:
        CheckpointError: a file is missing or damaged.
    """
    index = read_index(folder)
    has_program = PROGRAM_FILE in index["sha256"]
    for name in (*CHECKED_FILES, PROGRAM_FILE) if has_program else CHECKED_FILES:
        _checked_bytes(folder / name, index["sha256"])
    if (folder / PROGRAM_FILE).exists() and not has_program:
        raise CheckpointError(
            f"{folder / PROGRAM_FILE} does not belong there: {INDEX_FILE} does not name it.\n{_AGAIN}"
        )
    if not (folder / CARD_FILE).is_file():
        raise CheckpointError(f"{folder} is not whole: {CARD_FILE} is missing.\n{_AGAIN}")
    return index


def list_releases(folder: Path) -> list[dict[str, Any]]:
    """Return, for each released model below ``folder``, its index with ``folder``, ``bytes`` and ``fault`` added.

    ``fault`` is null where every file is whole, and else says what is wrong.
    """
    found = []
    for path in sorted(path for path in folder.glob("*") if path.is_dir() and is_release(path)):
        entry: dict[str, Any] = {"folder": str(path), "bytes": folder_bytes(path), "fault": None}
        try:
            entry = {**check_release(path), **entry}
        except CheckpointError as error:
            entry["fault"] = str(error).splitlines()[0]
        found.append(entry)
    return found


def folder_bytes(folder: Path) -> int:
    """Return the size of all files of a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def sha256(content: bytes) -> str:
    """Return the SHA-256 of bytes as hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def _checked_bytes(path: Path, digests: Mapping[str, str]) -> bytes:
    content = _read_bytes(path, None if path.name in (WEIGHTS_FILE, PROGRAM_FILE) else _MAX_TEXT_BYTES)
    if sha256(content) != digests[path.name]:
        raise CheckpointError(f"{path} is damaged: its SHA-256 is not the one in {INDEX_FILE}.\n{_AGAIN}")
    return content


def _read_bytes(path: Path, limit: int | None) -> bytes:
    try:
        if limit is not None and path.stat().st_size > limit:
            raise CheckpointError(f"{path} has {path.stat().st_size} bytes, more than the allowed {limit}.")
        return path.read_bytes()
    except FileNotFoundError:
        raise CheckpointError(f"{path.parent} is not whole: {path.name} is missing.\n{_AGAIN}") from None
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read: {error.strerror or error}.") from error


def _parse_weights(path: Path, content: bytes) -> "dict[str, Tensor]":
    # Imported here: vpd-info lists released models and needs neither.
    import safetensors
    import safetensors.torch

    try:
        return safetensors.torch.load(content)
    except (safetensors.SafetensorError, ValueError, KeyError) as error:
        raise CheckpointError(f"{path} holds no weights that can be read: {error}.\n{_AGAIN}") from error


def _parse_config(path: Path, content: bytes) -> dict[str, Any]:
    try:
        config = yaml.load(content.decode(), Loader=_PlainLoader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{path} is not plain YAML: {str(error).splitlines()[0]}.\n{_AGAIN}") from error
    if not isinstance(config, dict):
        raise CheckpointError(f"{path} holds no settings.\n{_AGAIN}")
    outside = absolute_paths(config)
    if outside:  # a data set that is missing is made where data.folder says
        raise CheckpointError(
            f"{path} names a place outside of the current folder: {outside[0][:120]}.\n"
            "vpd-export writes relative paths only; do not use this folder."
        )
    return config
