"""Names of bodies, smooth camera paths, and pictures that are kept."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vpd_lightning.viewer.body_names import body_names, color_name
from vpd_lightning.viewer.frame_cache import FrameCache
from vpd_lightning.viewer.interpolation import between
from vpd_lightning.viewer.preset_buttons import readable


@pytest.mark.parametrize(
    ("rgb", "name"),
    [
        ((0.9, 0.1, 0.1), "red"),
        ((0.9, 0.1, 0.2), "red"),
        ((0.1, 0.2, 0.9), "blue"),
        ((0.1, 0.8, 0.2), "green"),
        ((0.9, 0.85, 0.1), "yellow"),
        ((0.9, 0.5, 0.1), "orange"),
        ((0.6, 0.1, 0.8), "purple"),
        ((0.5, 0.5, 0.52), "grey"),
        ((0.95, 0.95, 0.95), "white"),
        ((0.05, 0.02, 0.05), "black"),
    ],
)
def test_colours_have_everyday_words(rgb: tuple[float, float, float], name: str) -> None:
    assert color_name(rgb) == name


def test_bodies_are_told_apart_by_colour_and_then_by_number() -> None:
    clusters = np.array([0, 0, 1, 1, 2, 2, -1])
    red, blue = (0.9, 0.1, 0.1), (0.1, 0.1, 0.9)
    colors = np.array([red, red, blue, blue, red, red, (0.5, 0.5, 0.5)])
    assert body_names("deformable_collision", clusters, colors) == [
        "red soft body 1",
        "blue soft body",
        "red soft body 2",
    ]
    assert body_names("mujoco_block", clusters[:2], colors[:2]) == ["block"]
    assert body_names("imported", np.array([-1, -1]), colors[:2]) == []
    assert body_names("imported", np.zeros(0, int), np.zeros((0, 3))) == []


def test_a_path_goes_through_its_places_and_turns_evenly() -> None:
    places = []
    for number in range(4):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("z", 40 * number, degrees=True).as_matrix()
        pose[:3, 3] = [np.cos(number), np.sin(number), 0.1 * number]
        places.append((pose, 0.8 + 0.1 * number))
    path = between(places, 5)
    assert len(path) == 16
    for number, (pose, fov) in enumerate(places):
        assert np.allclose(path[5 * number][0], pose) and path[5 * number][1] == pytest.approx(fov)
    poses = np.stack([pose for pose, _ in path])
    turns = Rotation.from_matrix(poses[1:, :3, :3] @ poses[:-1, :3, :3].transpose(0, 2, 1)).magnitude()
    assert np.allclose(turns, np.radians(8), atol=1e-6)  # places 40 degrees apart about one axis
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert steps.max() < 2 * steps.min()
    assert between(places[:1], 5) == places[:1]
    with pytest.raises(ValueError, match="a place"):
        between([], 5)


def test_pictures_that_were_not_asked_for_the_longest_go_first() -> None:
    frames = FrameCache(max_bytes=3 * 300)
    for number in range(3):
        frames.put(number, np.full((10, 10, 3), number, np.uint8))
    assert frames.get(0) is not None
    frames.put(3, np.full((10, 10, 3), 3, np.uint8))
    assert frames.get(1) is None and frames.get(0) is not None and frames.get(3) is not None
    frames.put(3, np.full((10, 10, 3), 4, np.uint8))
    assert frames.get(2) is not None and frames.get(3)[0, 0, 0] == 4  # type: ignore[index]
    frames.put("large", np.zeros((100, 100, 3), np.uint8))
    assert frames.get("large") is not None and frames.get(0) is None


def test_buttons_have_the_bodies_colours_and_can_be_read() -> None:
    assert readable((200, 30, 20)) == (200, 30, 20)
    red, green, blue = readable((250, 230, 20))
    assert red == pytest.approx(green * 250 / 230, abs=1) and 0.299 * red + 0.587 * green + 0.114 * blue < 0.43 * 255
