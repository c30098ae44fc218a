"""docs/numerics.md names functions and tests that exist."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "numerics.md").read_text()
ROWS = [line for line in PAGE.split("## Hazards")[1].split("\n## ")[0].splitlines() if line.startswith("| ")][1:]


def names_in(path: Path) -> set[str]:
    return {
        node.name for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef | ast.ClassDef)
    }


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.split("|")[1].strip()[:40])
def test_every_fix_and_every_test_is_there(row: str):
    _, _, _, where, test, _ = (cell.strip() for cell in row.split("|"))
    file, name = where.strip("`").split(":")
    test_file, test_name = test.strip("`").split("::")

    assert name in names_in(ROOT / "src" / "vpd_lightning" / file)
    assert test_name in names_in(ROOT / "tests" / "stability" / test_file)


def test_the_page_names_every_file_of_the_matrix():
    files = {path.name for path in (ROOT / "tests" / "stability").glob("test_*_stability.py")}
    named = set(re.findall(r"test_\w+_stability\.py", PAGE))

    assert files - named <= {"test_interpreter_stability.py"}
