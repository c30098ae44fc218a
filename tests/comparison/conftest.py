"""What the tests of reports share."""

from pathlib import Path

import pytest

from tests.comparison.made_runs import MakeRun, write_run


@pytest.fixture
def make_run(tmp_path: Path) -> MakeRun:
    """Write a run below ``tmp_path / "runs"``; the first word is its folder."""
    return lambda name, **values: write_run(tmp_path / "runs" / name, **values)
