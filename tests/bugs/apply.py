"""Puts one of the faults of ``bugs.toml`` into a copy of the repository, also after files were moved.

``python -m tests.bugs.apply`` says of each fault where its text stands now, and fails where one has no single place.
"""

import json
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent
ROOTS = ("src", "data_gen")
"""Folders in which a text is looked for where it is no longer in its file."""


@dataclass(frozen=True)
class Bug:
    """A fault: ``after`` in the place of ``before``, whose white space does not matter."""

    id: int
    kind: str
    path: str
    wrong: str
    before: str
    after: str
    called_as: str | None = None

    def places(self, text: str) -> list[re.Match[str]]:
        """Return where ``before`` stands in a file, wherever its lines are broken."""
        tokens = re.findall(r'"[^"]*"|\w+|[^\w\s]', self.before)
        pattern = r"\s*".join(re.escape(token) for token in tokens)
        # Neither a part of a longer name, nor of a longer dotted one.
        return list(re.finditer(rf"(?<![\w.]){pattern}(?!\w)", text))


class LostBug(Exception):
    """The text of a fault has no single place any more."""


def load_bugs() -> list[Bug]:
    """Return all faults in the order of their numbers."""
    entries = tomllib.loads((HERE / "bugs.toml").read_text())["bug"]
    return sorted((Bug(**entry) for entry in entries), key=lambda bug: bug.id)


def find(bug: Bug, tree: Path) -> tuple[Path, re.Match[str]]:
    """Return the file of a tree in which the fault's text stands, and where.

    The file is the one of the entry, or where ``moved.json`` (old path: new path) says it went. Where the text is not
    there, it is looked for everywhere; of several places, one in a file of the same name counts.

    Raises:
        LostBug: the text stands nowhere, or in more than one place.
    """
    moved = json.loads((HERE / "moved.json").read_text())
    known = tree / moved.get(bug.path, bug.path)
    found = bug.places(known.read_text()) if known.is_file() else []
    if len(found) == 1:
        return known, found[0]
    everywhere = [
        (path, place)
        for root in ROOTS
        for path in sorted((tree / root).rglob("*.py"))
        for place in bug.places(path.read_text())
    ]
    if len(everywhere) > 1:
        everywhere = [(path, place) for path, place in everywhere if path.name == Path(bug.path).name]
    if len(everywhere) != 1:
        raise LostBug(f"bug {bug.id}: {len(everywhere)} places for {bug.before!r}, last seen in {bug.path}")
    return everywhere[0]


def put_in(bug: Bug, tree: Path) -> Path:
    """Put the fault into a tree; return the file. Never to be done to the tree that one works in."""
    path, place = find(bug, tree)
    text = path.read_text()
    path.write_text(text[: place.start()] + bug.after + text[place.end() :])
    return path


def main() -> None:
    """Say where each fault belongs now."""
    tree, lost = HERE.parents[1], 0
    for bug in load_bugs():
        try:
            path, place = find(bug, tree)
            line = path.read_text().count("\n", 0, place.start()) + 1
            print(f"{bug.id:2d} {bug.kind:14s} {path.relative_to(tree)}:{line}")
        except LostBug as error:
            lost += 1
            print(error)
    raise SystemExit(1 if lost else 0)


if __name__ == "__main__":
    main()
