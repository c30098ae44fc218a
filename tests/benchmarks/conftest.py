"""A model of two training steps for the suites that want a checkpoint."""

from tests.commands.conftest import dataset, quick, trained

__all__ = ["dataset", "quick", "trained"]
