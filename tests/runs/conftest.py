"""The tiny data set and training that the tests of commands have."""

from tests.commands.conftest import dataset, fails, in_folder, quick, trained

__all__ = ["dataset", "fails", "in_folder", "quick", "trained"]
