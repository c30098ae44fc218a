"""What the cameras see of pushing agrees with what the file says of the pusher. GL runs in worker processes."""

from pathlib import Path

import numpy as np
import pytest

from data_gen.generate import generate
from vpd_lightning.data.driven import read_driven
from vpd_lightning.data.ground_truth import read_state
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.data.schema import DRIVEN_LABEL

pytestmark = [pytest.mark.gl, pytest.mark.slow]
SIZES = {"splits.train": 1, "splits.validation": 0, "splits.test": 0, "num_frames": 6, "frame_time": 0.2}
SIZES |= {"camera.height": 96, "camera.width": 96}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pushing")
    sensor = {"sensor.trigger_offset": 0.02, "sensor.trigger_steps": 2}
    plain = generate("pushing", "tiny", folder / "plain", 0, workers=1, overrides=SIZES)
    late = generate("pushing", "tiny", folder / "late", 0, workers=1, overrides=SIZES | sensor, sensor="active_stereo")
    return {name: next(iter(path.glob("train/*.h5"))) for name, path in (("plain", plain), ("late", late))}


def test_points_of_the_pusher_lie_where_it_is_seen(files: dict[str, Path]) -> None:
    driven = read_driven(files["plain"])
    assert driven is not None
    labels, num_compared = read_state(files["plain"]).segmentation, 0
    with TrajectoryReader(files["plain"]) as reader:
        intrinsics, poses = reader.cameras([0])
        for frame, view in np.ndindex(reader.num_frames, reader.num_views):
            pose, depth = poses[0, view], reader.depth([frame], [view])[0, 0]
            seen = (driven.points[frame] - pose[:3, 3]) @ pose[:3, :3]
            facing = ((driven.normals[frame] @ pose[:3, :3]) * seen).sum(axis=1) < -0.5 * np.linalg.norm(seen, axis=1)
            pixels = np.floor((seen @ intrinsics[0, view].T)[:, :2] / seen[:, 2:]).astype(int)
            inside = facing & (pixels >= 0).all(axis=1) & (pixels < [reader.width, reader.height]).all(axis=1)
            column, row = pixels[inside].T
            is_pusher = labels[frame, view, row, column] == DRIVEN_LABEL
            off = np.abs(depth[row, column] - seen[inside, 2])[is_pusher]
            assert (off < 0.02).all()  # a pixel is 1 cm wide, and sides are slanted
            num_compared += len(off)
    assert num_compared > 100


def test_a_late_sensor_changes_pictures_and_not_the_action(files: dict[str, Path]) -> None:
    one, other = (read_driven(files[name]) for name in ("plain", "late"))
    assert one is not None and other is not None
    assert one.points.shape == other.points.shape
    np.testing.assert_allclose(one.points, other.points, atol=1e-5)
