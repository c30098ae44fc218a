"""Options of studies of trained models: models, clips, and settings of the dynamics that are changed (weights stay)."""

import json
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vpd_lightning.loading import LoadedModel


def add_option(parser: ArgumentParser) -> None:
    """Add ``--dynamics KEY=JSON ...``."""
    parser.add_argument("--dynamics", nargs="*", default=[], help="settings of the models' dynamics, KEY=JSON")


def parser_of(description: str | None, least_models: str) -> ArgumentParser:
    """Return the options of a study that measures models on the clips of a split.

    ``least_models`` is argparse's ``nargs`` of the models.
    """
    parser = ArgumentParser(description=description, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("models", nargs=least_models, help="NAME=CKPT")
    parser.add_argument("--split", default="test")
    parser.add_argument("--starts", type=int, nargs="+", default=[0, 6, 12])
    add_option(parser)
    return parser


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
