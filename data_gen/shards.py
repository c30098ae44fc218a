"""One data set made by several machines: each makes every n-th file, and the last one finishes the set."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

from vpd_lightning.errors import ConfigError

K = TypeVar("K")
V = TypeVar("V")


@dataclass(frozen=True)
class Shard:
    """Part ``number`` (from 1) of ``count``."""

    number: int
    count: int

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    @property
    def is_whole(self) -> bool:
        """Whether it is everything."""
        return self.count == 1

    def of(self, items: Mapping[K, V]) -> dict[K, V]:
        """Return every ``count``-th entry; which one does not depend on what is done already."""
        return {key: value for i, (key, value) in enumerate(items.items()) if i % self.count == self.number - 1}


WHOLE = Shard(1, 1)


def parse_shard(text: str | None) -> Shard:
    """Read ``i/n``, with i from 1 to n; None is everything.

    Raises:
        ConfigError: it is not of this form.
    """
    if text is None:
        return WHOLE
    found = re.fullmatch(r"(\d+)/(\d+)", str(text).strip())
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise ConfigError(
            f"shard is {text!r}; allowed: i/n with i from 1 to n, for example shard=1/4 on the first of four machines."
        )
    return Shard(int(found[1]), int(found[2]))
