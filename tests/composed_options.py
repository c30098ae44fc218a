"""Every option of groups of ``conf/``, composed as few times as there are options in the largest group."""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from vpd_lightning.config import compose, config_folder


def options(group: str) -> list[str]:
    """Return the names of a group's options."""
    return sorted(path.stem for path in (config_folder() / group).glob("*.yaml"))


def option_section(group: str, option: str, groups: Sequence[str], words: Sequence[str]) -> Any:
    """Return the section that an option fills, the one named ``group``; not to be changed.

    Composing takes half a second. So that it is done once for the first options of all ``groups``, once for the second
    ones and so on: an option fills its own section, and none of these may refer to another.

    Args:
        group: one of ``groups``.
        option: its option.
        groups: what is composed together.
        words: what every composition is given.
    """
    return _composed(options(group).index(option), tuple(groups), tuple(words))[group]


@cache
def _composed(number: int, groups: tuple[str, ...], words: tuple[str, ...]) -> Mapping[str, Any]:
    chosen = [f"{group}={names[number]}" for group in groups if number < len(names := options(group))]
    return compose("train", [*chosen, *words])
