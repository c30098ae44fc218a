"""Compare what ``dump.py`` wrote before a change with what it writes after it, but for a committed list of changes.

``python -m tests.configs.composed.compare BEFORE.json AFTER.json CHANGES.json [RESULT.json]``. The list of changes has
five entries, each with its reasons: ``added`` and ``removed`` are keys (with all below them), ``changed`` keys with
pairs of values before and after, ``gone_words`` words of a command line that are refused since, ``mended`` command
lines whose configuration is meant to differ, with the keys.
"""

import json
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from vpd_lightning.moved import current_name

_ABSENT = "(absent)"


def main(before: str, after: str, changes: str, result: str | None = None) -> int:
    """Print each difference that the list does not name; return 1 where there is one."""
    old, new = (json.loads(Path(path).read_text()) for path in (before, after))
    allowed = json.loads(Path(changes).read_text())
    differences = {words: found for words in old if (found := different(words, old[words], new.get(words), allowed))}
    summary = {
        "compared": len(old),
        "refused before and after": sum("error" in old[words] and "error" in new.get(words, {}) for words in old),
        "refused since, by a word that is gone": sum(is_gone(words, allowed) for words in old),
        "different": differences,
        "only after": sorted(new.keys() - old.keys()),
    }
    text = json.dumps(summary, indent=1)
    print(text)
    if result is not None:
        Path(result).write_text(text + "\n")
    return int(bool(differences))


def is_gone(words: str, allowed: Mapping[str, Any]) -> bool:
    """Whether a command line has a word that is refused since the change."""
    return any(word in allowed["gone_words"] for word in words.split())


def different(
    words: str, old: dict[str, Any], new: dict[str, Any] | None, allowed: Mapping[str, Any]
) -> dict[str, list[Any]]:
    """Return the keys with another value, and both values; empty where the list of changes accounts for all."""
    if new is None:  # its option is gone
        return {} if is_gone(words, allowed) else {"": ["composed", "not tried"]}
    if "error" in old or "error" in new:
        is_same = ("error" in old) == ("error" in new) or ("error" in new and is_gone(words, allowed))
        return {} if is_same else {"error": [old.get("error"), new.get("error")]}
    was = {key: value for key, value in flat(old) if not is_below(key, allowed["removed"])}
    now = {key: value for key, value in flat(new) if not is_below(key, allowed["added"])}
    mended = allowed["mended"].get(words, ())
    return {
        key: [was.get(key, _ABSENT), now.get(key, _ABSENT)]
        for key in sorted(was.keys() | now.keys())
        if was.get(key, _ABSENT) != now.get(key, _ABSENT) and key not in mended
        if [was.get(key, _ABSENT), now.get(key, _ABSENT)] not in allowed["changed"].get(key, {"values": []})["values"]
    }


def is_below(key: str, parents: Mapping[str, str]) -> bool:
    """Whether a key is one of ``parents``, or below one."""
    return any(key == parent or key.startswith(f"{parent}.") for parent in parents)


def flat(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted keys of a configuration, classes by today's names; lists and empty sections count as values."""
    if isinstance(config, dict) and config:
        for key, value in config.items():
            yield from flat(value, f"{prefix}.{key}" if prefix else key)
    else:
        yield prefix, current_name(config) if isinstance(config, str) else config


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
