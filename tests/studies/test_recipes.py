"""Every row of the table of recipes is a training that can be configured."""

import functools

import pytest

from docs.results.studies.recipes import RECIPES, TRAINING, main
from vpd_lightning.config import compose


@functools.cache
def composed(*words: str) -> dict:
    """Not to be changed."""
    return compose("train", [*TRAINING, *words])


@pytest.mark.parametrize("row", RECIPES)
def test_each_row_changes_what_it_says(row: str) -> None:
    assert (composed(*RECIPES[row]) == composed()) == (row == "base")


def test_unknown_rows_are_refused(tmp_path) -> None:
    with pytest.raises(SystemExit):
        main([str(tmp_path), "--rows", "nothing"])
