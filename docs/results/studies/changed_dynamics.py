"""Settings of a trained model's dynamics that a study changes: the weights stay, the result says what was changed."""

import json
from argparse import ArgumentParser
from collections.abc import Sequence
from typing import Any

from vpd_lightning.loading import LoadedModel


def add_option(parser: ArgumentParser) -> None:
    """Add ``--dynamics KEY=JSON ...``."""
    parser.add_argument("--dynamics", nargs="*", default=[], help="settings of the models' dynamics, KEY=JSON")


def change_dynamics(model: LoadedModel, words: Sequence[str]) -> dict[str, Any]:
    """Set what ``KEY=JSON`` words say and return it.

    Raises:
        ValueError: the dynamics has no such setting.
    """
    changes = {key: json.loads(value) for key, value in (word.split("=", 1) for word in words)}
    for key, value in changes.items():
        if not hasattr(model.simulator.dynamics, key):
            raise ValueError(f"the dynamics of this model has no setting {key!r}")
        setattr(model.simulator.dynamics, key, value)
    return changes
