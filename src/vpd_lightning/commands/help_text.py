"""What ``--help`` prints of a command with a configuration: its text in ``conf/hydra/help``, and all options."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml

# Chosen by other options, not by a person.
_NOT_LISTED = ("recipe",)


def help_text(command: str, folders: Sequence[Path]) -> str:
    """Return the help of a command.

    Args:
        command: name of the root configuration.
        folders: where options lie; the first one holds the root, and the text.
    """
    answers = _read(folders[0] / "hydra" / "help" / f"{command}.yaml")
    options = "\n".join(
        f"{group}: {', '.join(_options(group, folders))}" for group in sorted(_groups(command, folders))
    )
    text: str = answers["template"].replace("${hydra.help.header}", answers["header"])
    return text.replace("$APP_CONFIG_GROUPS", options).rstrip()


def _groups(command: str, folders: Sequence[Path]) -> set[str]:
    """Return the groups that the defaults list of the root names, and those that files of these groups name."""
    own = set(_named(folders[0] / f"{command}.yaml"))
    files = [path for folder in folders for group in own for path in (folder / group).rglob("*.yaml")]
    named = own.union(*(_named(path) for path in files))
    return {group for group in named if group not in _NOT_LISTED and _options(group, folders)}


def _named(path: Path) -> Iterator[str]:
    """Yield the groups of a file's defaults list, without Hydra's own and those for a certain place."""
    for line in _read(path).get("defaults", []):
        words = next(iter(line)).split() if isinstance(line, dict) else []
        if words and re.fullmatch(r"/?\w+", words[-1]):
            yield words[-1].removeprefix("/")


def _options(group: str, folders: Sequence[Path]) -> list[str]:
    return sorted({path.stem for folder in folders for path in (folder / group).glob("*.yaml")})


def _read(path: Path) -> dict[str, Any]:
    return yaml.safe_load(path.read_text(encoding="utf-8")) or {}
