"""Write the last figures into docs/reliability.md: ``python -m tests.reliability.page``."""

import json
from pathlib import Path

from tests.reliability.outcome import RESULTS, read

PAGE = Path("docs/reliability.md")
BEGIN, END = "<!-- reliability -->\n", "<!-- /reliability -->"


def table(results: Path = RESULTS) -> str:
    """Return the table of all checks that have results."""
    seconds = {check: rows["seconds"] for check, rows in json.loads(results.read_text()).items()}
    lines = ["| check | promise | held | seen |", "|---|---|---:|---|"]
    for check, outcomes in read(results).items():
        for index, outcome in enumerate(outcomes):
            name = f"`{check}` ({seconds[check]} s)" if index == 0 else ""
            held = f"{outcome.held:,} of {outcome.tried:,}"
            lines.append(
                f"| {name} | {outcome.promise} | {held if outcome.is_kept else f'**{held}**'} | {outcome.seen} |"
            )
    return "\n".join(lines) + "\n"


def written(page: str, content: str) -> str:
    """Return the page with the table in its place."""
    before, rest = page.split(BEGIN)
    return before + BEGIN + content + END + rest.split(END)[1]


if __name__ == "__main__":
    PAGE.write_text(written(PAGE.read_text(), table()))
