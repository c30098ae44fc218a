"""The tiny data set and training that the tests of commands have."""

from tests.commands.conftest import dataset, fails, in_folder, quick, shapes_are_left_unchecked, trained

__all__ = ["dataset", "fails", "in_folder", "quick", "shapes_are_left_unchecked", "trained"]
