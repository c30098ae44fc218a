"""Pictures and videos of validation rollouts."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from lightning.pytorch.loggers import TensorBoardLogger

from tests.data.recordings import write_recordings
from tests.training.tiny_training import tiny_data, tiny_module, tiny_trainer
from vpd_lightning.training.callbacks.draw_rollouts import DrawRollouts, film_strip


def test_validations_leave_a_strip_and_a_video_of_each_clip(tmp_path: Path) -> None:
    data = tiny_data(write_recordings(tmp_path / "data"), num_validation_steps=4)
    drawing = DrawRollouts(num_clips=1, every_n_steps=20, max_columns=3, frames_per_second=5.0)
    run = tmp_path / "run"
    logger = TensorBoardLogger(save_dir=run, name="", version="")
    tiny_trainer(run, 30, [drawing], logger=[logger]).fit(tiny_module(), data)
    made = sorted(path.name for path in (run / "validation").iterdir())
    # Validations at 10, 20 and 30; drawn at the first and 20 updates later.
    assert made == [f"step_00000{step}_clip_0.{end}" for step in (10, 30) for end in ("png", "webm")]
    picture = cv2.imread(str(run / "validation" / "step_0000010_clip_0.png"))
    assert picture.shape == (2 * 16, 3 * 16, 3)
    video = cv2.VideoCapture(str(run / "validation" / "step_0000030_clip_0.webm"))
    count = 0
    while video.read()[0]:
        count += 1
    assert count == 4
    assert list(run.glob("events.*"))


def test_a_strip_shows_truth_above_prediction_from_first_to_last_step() -> None:
    truth = np.arange(5, dtype=np.uint8)[:, None, None, None].repeat(2, 1).repeat(2, 2).repeat(3, 3)
    strip = film_strip(truth, truth + 100, max_columns=3)
    assert strip.shape == (4, 6, 3)
    assert strip[0, ::2, 0].tolist() == [0, 2, 4] and strip[2, ::2, 0].tolist() == [100, 102, 104]


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError, match="frames_per_second above 0"):
        DrawRollouts(num_clips=1, every_n_steps=1, max_columns=1, frames_per_second=0.0)
