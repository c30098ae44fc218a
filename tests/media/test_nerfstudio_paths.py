"""Camera paths of nerfstudio: axes and angles by arithmetic of the test's own, and what is refused."""

import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from vpd_lightning.errors import ConfigError, DataError
from vpd_lightning.geometry.cameras import project, rays_through
from vpd_lightning.media.camera_paths import look_at, read_camera_file
from vpd_lightning.media.nerfstudio_paths import write_camera_path
from vpd_lightning.types import Cameras

# A camera at (0, -2, 1) that looks along +y with its top towards +z, as three columns of OpenGL axes: right = +x,
# up = +z, back = -y. Written row by row.
LOOKS_ALONG_Y = [1, 0, 0, 0, 0, 0, -1, -2, 0, 1, 0, 1, 0, 0, 0, 1]


def camera_path(**changes: Any) -> dict[str, Any]:
    camera = {"camera_to_world": LOOKS_ALONG_Y, "fov": 90.0, "aspect": 1.0}
    content = {"camera_type": "perspective", "render_height": 20, "render_width": 40, "camera_path": [camera, camera]}
    return {**content, "fps": 24, "seconds": 1.0, "is_cycle": False, "keyframes": [], **changes}


def written(folder: Path, content: Any) -> Path:
    path = folder / "camera_path.json"
    path.write_text(json.dumps(content))
    return path


def test_a_viewers_path_is_a_moving_camera_that_sees_what_it_says(tmp_path: Path) -> None:
    cameras, moving = read_camera_file(written(tmp_path, camera_path()))
    assert moving and cameras.shape == (2,) and (cameras.height, cameras.width) == (20, 40)
    # 90 degrees high at distance 2: half a metre up is a quarter of the way from the middle (10) to the top row (0),
    # and pixels are square, so half a metre to the right is as far.
    point = torch.tensor([[[0.5, 0.0, 1.5]]]).expand(2, 1, 3)
    pixels, depth = project(point, cameras)
    torch.testing.assert_close(pixels, torch.tensor([[[22.5, 7.5]]]).expand(2, 1, 2))
    torch.testing.assert_close(depth, torch.full((2, 1), 2.0))
    middle = rays_through(cameras, torch.tensor([[[20.0, 10.0]]]).expand(2, 1, 2))
    torch.testing.assert_close(middle.directions[0, 0], torch.tensor([0.0, 1.0, 0.0]))
    torch.testing.assert_close(middle.origins[0, 0], torch.tensor([0.0, -2.0, 1.0]))


def test_what_is_written_has_opengl_axes_and_is_read_again(tmp_path: Path) -> None:
    eyes = torch.tensor([[2.0, 0.0, 1.0], [0.3, -1.5, 0.7], [0.0, 2.0, 1.0]], dtype=torch.float64)
    intrinsics = torch.tensor([[33.0, 0, 16], [0, 33.0, 12], [0, 0, 1]], dtype=torch.float64).expand(3, 3, 3)
    cameras = Cameras(intrinsics, look_at(eyes, torch.zeros(3, dtype=torch.float64)), 24, 32)
    write_camera_path(tmp_path / "out.json", cameras, 8.0, is_cycle=True)
    content = json.loads((tmp_path / "out.json").read_text())
    assert (content["render_height"], content["render_width"], content["fps"], content["is_cycle"]) == (24, 32, 8, True)
    assert content["seconds"] == pytest.approx(3 / 8) and content["camera_type"] == "perspective"
    for eye, camera in zip(eyes.tolist(), content["camera_path"], strict=True):
        rows = [camera["camera_to_world"][4 * i : 4 * i + 4] for i in range(4)]
        back, up = [row[2] for row in rows[:3]], [row[1] for row in rows[:3]]
        length = math.hypot(*eye)
        assert back == pytest.approx([x / length for x in eye]), "an OpenGL camera has its scene behind its z axis"
        assert up[2] > 0 and [row[3] for row in rows] == pytest.approx([*eye, 1.0])
        assert math.tan(math.radians(camera["fov"]) / 2) == pytest.approx(12 / 33)
        assert camera["aspect"] == pytest.approx(32 / 24)
    read, moving = read_camera_file(tmp_path / "out.json")
    assert moving
    torch.testing.assert_close(read.cam_to_world.double(), cameras.cam_to_world, atol=1e-6, rtol=0)
    torch.testing.assert_close(read.intrinsics.double(), cameras.intrinsics, atol=1e-5, rtol=0)


@pytest.mark.parametrize(("row", "column", "value"), [(0, 2, 17.0), (1, 1, 34.0), (0, 1, 1.0)])
def test_cameras_that_the_format_cannot_hold_are_not_written(
    tmp_path: Path, row: int, column: int, value: float
) -> None:
    intrinsics = torch.tensor([[33.0, 0, 16], [0, 33.0, 12], [0, 0, 1]])
    intrinsics[row, column] = value
    with pytest.raises(ConfigError, match="save_camera_path=false"):
        write_camera_path(tmp_path / "out.json", Cameras(intrinsics[None], torch.eye(4)[None], 24, 32), 8.0, False)
    assert not list(tmp_path.iterdir())


BAD = {
    "'fisheye' cameras": camera_path(camera_type="fisheye"),
    "KeyError 'render_width'": {name: value for name, value in camera_path().items() if name != "render_width"},
    "0 cameras": camera_path(camera_path=[]),
    "TypeError": camera_path(camera_path=7),
    "shape": camera_path(camera_path=[{"camera_to_world": [1.0] * 12, "fov": 50.0}]),
    "ValueError": camera_path(camera_path=[{"camera_to_world": ["a"] * 16, "fov": 50.0}]),
    "180 degrees|180.0 degrees": camera_path(camera_path=[{"camera_to_world": LOOKS_ALONG_Y, "fov": 180.0}]),
    "nan degrees": camera_path(camera_path=[{"camera_to_world": LOOKS_ALONG_Y, "fov": math.nan}]),
    "field of view|fov|nan": camera_path(camera_path=[{"camera_to_world": LOOKS_ALONG_Y, "fov": None}]),
    "transposed": camera_path(
        camera_path=[{"camera_to_world": [LOOKS_ALONG_Y[4 * (i % 4) + i // 4] for i in range(16)], "fov": 50.0}]
    ),
    "orthonormal": camera_path(camera_path=[{"camera_to_world": [2, *LOOKS_ALONG_Y[1:]], "fov": 50.0}]),
    "left-handed": camera_path(camera_path=[{"camera_to_world": [-1, *LOOKS_ALONG_Y[1:]], "fov": 50.0}]),
    "not finite": camera_path(
        camera_path=[{"camera_to_world": [*LOOKS_ALONG_Y[:3], math.inf, *LOOKS_ALONG_Y[4:]], "fov": 50.0}]
    ),
    "'20'x40": camera_path(render_height="20"),
    "True": camera_path(render_height=True),
    "20000": camera_path(render_height=20000, render_width=20000),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_paths_get_a_named_error(tmp_path: Path, message: str) -> None:
    with pytest.raises(DataError, match=message) as raised:
        read_camera_file(written(tmp_path, BAD[message]))
    assert "camera_path.json" in str(raised.value)
