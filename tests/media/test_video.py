"""Films and pictures: complete or absent, the right size, readable again."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from vpd_lightning.errors import ConfigError
from vpd_lightning.media.video import comparison_frames, enlarge, error_image, write_video


def read_back(path: Path) -> np.ndarray:
    capture, frames = cv2.VideoCapture(str(path)), []
    while (answer := capture.read())[0]:
        frames.append(answer[1][..., ::-1])
    return np.stack(frames)


@pytest.mark.parametrize("suffix", [".webm", ".mp4"])
def test_a_film_shows_what_was_written(tmp_path: Path, suffix: str, capfd: pytest.CaptureFixture[str]) -> None:
    frames = np.zeros((6, 64, 96, 3), np.uint8)
    for time in range(6):
        frames[time, 16:48, 10 * time : 10 * time + 32] = [220, 40, 40 * time]
    write_video(tmp_path / f"film{suffix}", frames, 10.0)
    assert [path.name for path in tmp_path.iterdir()] == [f"film{suffix}"]
    # VP9 is lossy and stores colour at half resolution.
    assert np.abs(read_back(tmp_path / f"film{suffix}").astype(int) - frames).mean() < 4
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_a_looping_picture_shows_what_was_written(tmp_path: Path, suffix: str) -> None:
    frames = np.zeros((6, 63, 95, 3), np.uint8)
    for time in range(6):
        frames[time, 16:48, 10 * time : 10 * time + 32] = [220, 40, 40 * time]
    write_video(tmp_path / f"film{suffix}", frames, 4.0)
    assert [path.name for path in tmp_path.iterdir()] == [f"film{suffix}"]
    with Image.open(tmp_path / f"film{suffix}") as film:
        assert film.info["loop"] == 0 and film.n_frames == 6
        for time in range(6):
            film.seek(time)
            shown = np.asarray(film.convert("RGB")).astype(int)
            assert film.info["duration"] == 250 and np.abs(shown - frames[time]).mean() < 4


def test_odd_sizes_lose_a_row_and_a_column(tmp_path: Path) -> None:
    write_video(tmp_path / "film.webm", np.full((2, 65, 97, 3), 100, np.uint8), 10.0)
    assert read_back(tmp_path / "film.webm").shape == (2, 64, 96, 3)


def test_other_formats_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"film\.avi.*\n.*\.webm, \.mp4, \.webp, \.gif"):
        write_video(tmp_path / "film.avi", np.zeros((2, 64, 64, 3), np.uint8), 10.0)


@pytest.mark.parametrize("shape", [(0, 64, 64, 3), (2, 64, 64, 4), (64, 64, 3)])
def test_what_is_no_film_is_refused_and_leaves_nothing_behind(tmp_path: Path, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="time, height, width, 3"):
        write_video(tmp_path / "film.webm", np.zeros(shape, np.uint8), 10.0)
    assert not list(tmp_path.iterdir())


def test_comparison_has_three_panels_and_one_row_per_view() -> None:
    truth = np.zeros((2, 3, 16, 16, 3), np.uint8)
    frames = comparison_frames(truth, truth + 255, views=[0, 2], labels=["step 1", "step 2"])
    panel = 256 + 2  # enlarged, with a frame of one pixel
    assert frames.shape == (2, 2 * panel + 22, 3 * panel, 3)
    assert frames[0, 22 + 1, 1].tolist() == [0, 0, 0]
    assert frames[0, 22 + 1, panel + 1].tolist() == [255, 255, 255]


def test_error_is_black_where_there_is_none_and_saturates() -> None:
    truth = np.zeros((4, 4, 3), np.uint8)
    pred = truth.copy()
    pred[0, 0], pred[0, 1] = 128, 255
    heat = error_image(pred, truth)
    assert heat[2, 2].sum() < 10
    assert heat[0, 0].tolist() == heat[0, 1].tolist() and heat[0, 0].sum() > 500


def test_enlarging_repeats_pixels() -> None:
    image = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    large = enlarge(image, min_size=5)
    assert large.shape == (6, 6, 3) and (large[:3, 3:] == image[0, 1]).all()
