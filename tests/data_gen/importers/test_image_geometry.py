import json
from pathlib import Path

import numpy as np
import pytest

from data_gen.importers.image_geometry import ImageGeometry
from data_gen.importers.recording import Recording
from data_gen.importers.run import import_recordings
from data_gen.importers.settings import load_import_settings
from tests.data_gen.importers import known_scene
from tests.data_gen.importers.checks import TOLERANCE, assert_valid, attributes, camera_errors, files, worst_point
from tests.data_gen.importers.plain_recording import HEIGHT, WIDTH, change, write_plain
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.errors import ConfigError


@pytest.fixture
def source(tmp_path: Path) -> Path:
    return write_plain(tmp_path / "take0", num_frames=4, num_views=2)


def test_crop_and_scale_keep_every_ray(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Thirds: the centre of an output pixel is the centre of an input pixel, so nearest depth is exact."""
    out = import_recordings(source, tmp_path / "out", {"crop": [4, 3, 57, 42], "height": 14})

    (path,) = files(out)
    assert "19 pixels is no multiple of 16" in capsys.readouterr().out
    intrinsics, _ = known_scene.cameras(2, HEIGHT, WIDTH)
    with TrajectoryReader(path) as reader:
        assert (reader.height, reader.width) == (14, 19)
        stored = reader.cameras([0])[0][0]
    for view in range(2):
        # The output pixel (row 5, column 7) has its centre at the input pixel (3 + 3 * 5 + 1, 4 + 3 * 7 + 1).
        here = np.linalg.solve(stored[view], [7.5, 5.5, 1.0])
        there = np.linalg.solve(intrinsics[view], [26.5, 19.5, 1.0])
        assert np.abs(here - there).max() < 1e-12
    assert worst_point(path, [i * known_scene.FRAME_TIME for i in range(4)]) < TOLERANCE
    assert_valid(out)


def test_colour_is_averaged_by_area_and_depth_is_not(tmp_path: Path):
    rgb = np.zeros((16, 16, 3), np.uint8)
    rgb[:, ::2] = 200
    depth = np.ones((16, 16), np.float32)
    depth[:, ::2] = 3.0
    geometry = ImageGeometry(_recording(rgb, depth), load_import_settings({"height": 8}))

    assert (geometry.rgb(0, 0) == 100).all()
    assert set(np.unique(geometry.depth(0, 0))) <= {1.0, 3.0}


def _recording(rgb: np.ndarray, depth: np.ndarray) -> Recording:
    height, width = depth.shape
    matrix = np.array([[[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]]])
    return Recording("r", height, width, matrix, np.eye(4)[None], 3, 1, 0.1, lambda t, v: rgb, lambda t, v: depth)


def test_crop_outside_the_image_is_refused(source: Path, tmp_path: Path):
    with pytest.raises(ConfigError, match=r"crop=\[10,0,60,48\] leaves the images of take0, which are 64x48"):
        import_recordings(source, tmp_path / "out", {"crop": [10, 0, 60, 48]})


def test_world_is_scaled_turned_and_recentred_only_when_asked(tmp_path: Path):
    """The source's world is in centimetres with y up; after the import it is the known scene again."""
    folder = write_plain(tmp_path / "take", num_frames=3, num_views=2, depth="npy")
    turn = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # our z is the source's y
    content = json.loads((folder / "cameras.json").read_text())
    for view in content["views"]:
        pose = turn @ np.array(view["cam_to_world"])
        pose[:3, 3] *= 100
        view["cam_to_world"] = pose.tolist()
    change(folder, views=content["views"])
    for file in folder.glob("*/depth/*.npy"):
        np.save(file, np.load(file) * np.float32(100))

    out = import_recordings(folder, tmp_path / "out", {"scale": 0.01, "up": "y"})
    moved = import_recordings(folder, tmp_path / "moved", {"scale": 0.01, "up": "y", "recenter": True})

    intrinsics, poses = known_scene.cameras(2, HEIGHT, WIDTH)
    assert camera_errors(files(out)[0], intrinsics, poses)[1] < 1e-12
    assert worst_point(files(out)[0], [0.0, 0.05, 0.1]) < TOLERANCE
    assert_valid(out)
    assert attributes(files(out)[0])["source_scale"] == 0.01 and attributes(files(out)[0])["source_up"] == "y"
    shift = attributes(files(moved)[0])["source_shift"]
    with TrajectoryReader(files(moved)[0]) as reader:
        assert np.abs(reader.cameras([0])[1][0, :, :3, 3] - poses[:, :3, 3] - shift).max() < 1e-9
        assert np.all(np.array(reader.workspace_min) < 0) and np.all(np.array(reader.workspace_max) > 0)
