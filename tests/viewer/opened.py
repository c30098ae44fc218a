"""A scene that opens in a moment: a tossed box of a synthetic recording, and a small model that learned nothing."""

from pathlib import Path

from tests.evaluation.tossed_box import write_tossed_boxes
from tests.evaluation.untrained_model import write_untrained
from vpd_lightning.loading import load_model
from vpd_lightning.viewer.opened_scene import OpenedScene, open_scene


def open_tossed_box(folder: Path) -> OpenedScene:
    data = write_tossed_boxes(folder / "data", num_train=1, num_test=1)
    model = load_model(write_untrained(folder / "run", data))
    return open_scene(model.simulator, data / "test" / "000000.h5", 0, model.input_views, "tossed box", "mujoco_block")
