"""The released demo model and two recordings of its data set, made anew: what a newcomer has after ten minutes."""

import functools
from pathlib import Path

from data_gen.generate import generate
from vpd_lightning.loading import LoadedModel, load_model

RELEASED = Path(__file__).parents[1] / "released" / "mujoco_block_demo"


@functools.cache
def demo_model() -> LoadedModel:
    return load_model(RELEASED)


def make_demo_data(folder: Path) -> Path:
    """Write one recording of each split and return the data set's folder."""
    sizes = {"splits.train": 1, "splits.validation": 1, "splits.test": 1}
    return generate("mujoco_block", "demo", out=folder, seed=0, renderer="raycast", workers=1, overrides=sizes)
