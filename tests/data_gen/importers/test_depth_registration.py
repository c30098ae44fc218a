"""Depth registered to colour against the depth that the colour camera would have measured itself, in closed form."""

import numpy as np
import pytest

from data_gen.importers.depth_registration import DepthCamera, DepthRegistration
from tests.data_gen.importers import known_scene

LENS = np.array([-0.12, 0.05, 0.001, -0.002, 0.0])


def two_cameras(
    depth_size: tuple[int, int], color_size: tuple[int, int], lens: np.ndarray | None, baseline: float = 0.05
):
    """A colour camera and a depth sensor beside it, a little turned; what each sees."""
    color, pose = known_scene.camera(10.0, 45.0, 2.0, *color_size)
    turn = np.radians(1.5)
    to_color = np.eye(4)
    to_color[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    to_color[:3, 3] = [baseline, 0.004, -0.002]
    matrix, _ = known_scene.camera(10.0, 45.0, 2.0, *depth_size)
    matrix[0, 0] *= 0.8  # sees more
    matrix[1, 1] *= 0.8
    sensor = DepthCamera(*depth_size, matrix, to_color, lens)
    seen = known_scene.render(matrix, pose @ to_color, *depth_size, 0.0, lens)
    true = known_scene.render(color, pose, *color_size, 0.0)
    return sensor, seen.depth.astype(np.float32), color, pose, true


@pytest.mark.parametrize("lens", [None, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("sizes", [((96, 128), (96, 128)), ((60, 80), (135, 180)), ((120, 160), (48, 64))])
def test_pixels_have_the_depth_that_the_colour_camera_would_measure(sizes, lens):
    sensor, seen, color, _, true = two_cameras(*sizes, lens)
    registered = DepthRegistration(sensor, color, *sizes[1])(seen)
    both = registered > 0
    error = np.abs(registered - true.depth)[both] / true.depth[both]
    # On surfaces the depth is that of the planes; around outlines a pixel of one image lies on the other surface.
    assert np.median(error) < 1e-5
    assert np.quantile(error, 0.9) < 1e-4
    assert (error < 0.01).mean() > 0.96
    # Nothing is missing but what the sensor does not see.
    assert both[true.depth > 0].mean() > 0.95


def test_what_the_body_hides_from_the_colour_camera_does_not_shine_through():
    sensor, seen, color, _, true = two_cameras((120, 160), (120, 160), None, baseline=0.2)
    registered = DepthRegistration(sensor, color, 120, 160)(seen)
    behind = (registered > 0) & (registered > 1.05 * true.depth)
    # A pixel of outline at most: no floor in the middle of the box.
    eroded = behind[1:-1, 1:-1] & behind[:-2, 1:-1] & behind[2:, 1:-1] & behind[1:-1, :-2] & behind[1:-1, 2:]
    assert not eroded.any()
    # The floor beside the box that only the colour camera sees has no depth.
    missing = (registered == 0) & (true.depth > 0)
    assert missing.sum() > 30


def test_a_sensor_in_the_place_of_the_colour_camera_changes_nothing():
    color, pose = known_scene.camera(10.0, 45.0, 2.0, 48, 64)
    depth = known_scene.render(color, pose, 48, 64, 0.0).depth.astype(np.float32)
    depth[10:14, 20:26] = 0
    registered = DepthRegistration(DepthCamera(48, 64, color, np.eye(4)), color, 48, 64)(depth)
    seen = depth > 0
    assert np.allclose(registered[seen], depth[seen], rtol=1e-6)
    assert (registered[11:13, 21:25] == 0).all()


def test_nothing_measured_gives_nothing():
    color, _ = known_scene.camera(10.0, 45.0, 2.0, 48, 64)
    sensor = DepthCamera(48, 64, color, np.eye(4))
    assert not DepthRegistration(sensor, color, 48, 64)(np.zeros((48, 64), np.float32)).any()
    away = np.diag([1.0, -1.0, -1.0, 1.0])  # it looks the other way
    assert not DepthRegistration(DepthCamera(48, 64, color, away), color, 48, 64)(np.ones((48, 64), np.float32)).any()


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="to_color is float64"):
        DepthCamera(4, 4, np.eye(3), np.eye(3))
    with pytest.raises(ValueError, match="distortion is"):
        DepthCamera(4, 4, np.eye(3), np.eye(4), np.zeros(4))
