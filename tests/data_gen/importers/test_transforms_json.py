import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from data_gen.importers.run import import_recordings
from tests.data_gen.importers import known_scene
from tests.data_gen.importers.checks import TOLERANCE, assert_valid, attributes, camera_errors, files, worst_point
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.errors import DataError

HEIGHT, WIDTH, FRAMES, STEP = 48, 64, 3, known_scene.FRAME_TIME
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
LENS = np.array([-0.15, 0.03, 0.001, 0.002, 0.0])


def write_transforms(
    folder: Path,
    *,
    names: str = "cam{view}/{frame:05d}.png",
    keys: bool = True,
    lens: np.ndarray | None = None,
    views: int = 3,
    step: float = 1e-4,
    **top: Any,
) -> dict[str, Any]:
    """The known scene as nerfstudio writes it (OpenGL axes, whole-number depth); the content is returned too."""
    intrinsics, poses = known_scene.cameras(views, HEIGHT, WIDTH)
    frames = []
    for frame in range(FRAMES):
        for view in range(views):
            picture = known_scene.render(intrinsics[view], poses[view], HEIGHT, WIDTH, frame * STEP, lens)
            name = names.format(view=view, frame=frame)
            for kind, image in (
                ("images", picture.rgb[..., ::-1]),
                ("depth", np.rint(picture.depth / step).astype(np.uint16)),
            ):
                (folder / kind / name).parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(folder / kind / name), image)
            matrix = intrinsics[view]
            entry: dict[str, Any] = {
                "file_path": f"images/{name}",
                "depth_file_path": f"depth/{name}",
                "transform_matrix": (poses[view] @ FLIP).tolist(),
                "fl_x": matrix[0, 0],
                "fl_y": matrix[1, 1],
                "cx": matrix[0, 2],
                "cy": matrix[1, 2],
            }
            if keys:
                entry |= {"time": frame * STEP, "camera": f"c{view}"}
            frames.append(entry)
    content = {"camera_model": "OPENCV", "w": WIDTH, "h": HEIGHT, "depth_unit_scale_factor": step}
    if lens is not None:
        content |= dict(zip(("k1", "k2", "p1", "p2", "k3"), lens.tolist(), strict=True))
    content |= {**top, "frames": frames[::-1]}  # in no useful order
    return save(folder, content)


def save(folder: Path, content: dict[str, Any]) -> dict[str, Any]:
    (folder / "transforms.json").write_text(json.dumps(content))
    return content


@pytest.mark.parametrize(
    ("names", "keys", "settings"),
    [
        ("a{frame:03d}_{view}.png", True, {}),
        ("cam{view}/{frame:05d}.png", False, {"frame_time": STEP}),
        ("frame_{frame:05d}_camera_{view}.png", False, {"frame_time": STEP}),
        ("left{view}/img{frame}.png", False, {"frame_time": STEP}),
        ("{frame:04d}/view{view}.png", False, {"frame_time": STEP}),
    ],
)
def test_cameras_and_times_come_from_keys_or_names(tmp_path: Path, names: str, keys: bool, settings: dict):
    write_transforms(tmp_path / "scene", names=names, keys=keys)

    out = import_recordings(tmp_path / "scene", tmp_path / "out", settings)

    (path,) = files(out)
    assert camera_errors(path, *known_scene.cameras(3, HEIGHT, WIDTH)) == (0.0, 0.0)
    assert worst_point(path, [i * STEP for i in range(FRAMES)]) < TOLERANCE
    found = attributes(path)
    assert found["frame_time"] == pytest.approx(STEP)
    assert (found["source_axes"], found["source_pixel_center"], found["source_format"]) == (
        "opengl",
        "0.5",
        "transforms",
    )


def test_the_result_is_valid_and_colours_are_unchanged(tmp_path: Path):
    write_transforms(tmp_path / "scene")

    out = import_recordings(tmp_path / "scene" / "transforms.json", tmp_path / "out")

    assert_valid(out)
    intrinsics, poses = known_scene.cameras(3, HEIGHT, WIDTH)
    picture = known_scene.render(intrinsics[2], poses[2], HEIGHT, WIDTH, 2 * STEP)
    with TrajectoryReader(files(out)[0]) as reader:
        assert (reader.rgb([2], [2])[0, 0] == picture.rgb).all()


def test_instant_ngp_keys_and_one_angle_for_all(tmp_path: Path):
    """camera_angle_x alone: square pixels, principal point in the middle; depth in integer_depth_scale."""
    content = write_transforms(tmp_path / "scene", integer_depth_scale=2e-4)
    del content["depth_unit_scale_factor"], content["w"], content["h"]
    for entry in content["frames"]:
        entry["depth_path"] = entry.pop("depth_file_path")
        for key in ("fl_x", "fl_y", "cx", "cy"):
            del entry[key]
    save(tmp_path / "scene", content | {"camera_angle_x": 1.0})

    (path,) = files(import_recordings(tmp_path / "scene", tmp_path / "out"))

    focal = WIDTH / 2 / math.tan(0.5)
    with TrajectoryReader(path) as reader:
        expected = [[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]]
        assert np.abs(reader.cameras([0])[0][0, 0] - expected).max() < 1e-12
        picture = known_scene.render(*(x[0] for x in known_scene.cameras(3, HEIGHT, WIDTH)), HEIGHT, WIDTH, 0.0)
        assert np.abs(reader.depth([0], [0])[0, 0] - 2 * picture.depth).max() < 2e-4


@pytest.mark.parametrize("kind", ["distortion", "distance", "pixel_center", "opencv", "one"])
def test_other_conventions(tmp_path: Path, kind: str):
    if kind == "distortion":
        write_transforms(tmp_path / "scene", lens=LENS)
        settings: dict[str, Any] = {}
    else:
        content = write_transforms(tmp_path / "scene")
        settings = {"distance": {"depth": "distance"}, "pixel_center": {"pixel_center": 0.0}}.get(
            kind, {"axes": "opencv"}
        )
        intrinsics, poses = known_scene.cameras(3, HEIGHT, WIDTH)
        for entry in content["frames"]:
            if kind == "pixel_center":
                entry["cx"] -= 0.5
                entry["cy"] -= 0.5
            elif kind == "distance":
                view = int(entry["camera"][1:])
                picture = known_scene.render(intrinsics[view], poses[view], HEIGHT, WIDTH, entry["time"])
                file = str(tmp_path / "scene" / entry["depth_file_path"])
                cv2.imwrite(file, np.rint(picture.distance / 1e-4).astype(np.uint16))
            else:
                entry["transform_matrix"] = (np.array(entry["transform_matrix"]) @ FLIP).tolist()
        save(tmp_path / "scene", content)

    (path,) = files(import_recordings(tmp_path / "scene", tmp_path / "out", settings))

    errors = camera_errors(path, *known_scene.cameras(3, HEIGHT, WIDTH))
    assert max(errors) < 1e-12
    if kind != "distortion":
        assert worst_point(path, [i * STEP for i in range(FRAMES)]) < TOLERANCE
        return
    intrinsics, poses = known_scene.cameras(3, HEIGHT, WIDTH)
    with TrajectoryReader(path) as reader:
        depth = reader.depth([0], [0])[0, 0]
    truth = known_scene.render(intrinsics[0], poses[0], HEIGHT, WIDTH, 0.0).depth
    seen = depth > 0
    assert seen.mean() > 0.9
    # Nearest pixel: half a pixel on a floor that recedes by at most 3 % a pixel.
    assert np.quantile(np.abs(depth - truth)[seen] / truth[seen], 0.9) < 0.02


def test_applied_transform_is_kept_or_undone(tmp_path: Path):
    turn = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])  # as nerfstudio's, for COLMAP
    content = write_transforms(tmp_path / "scene", applied_transform=turn[:3].tolist())
    for entry in content["frames"]:
        entry["transform_matrix"] = (turn @ np.array(entry["transform_matrix"])).tolist()
    save(tmp_path / "scene", content)

    kept = import_recordings(tmp_path / "scene", tmp_path / "kept")
    undone = import_recordings(tmp_path / "scene", tmp_path / "undone", {"undo_applied_transform": True})

    intrinsics, poses = known_scene.cameras(3, HEIGHT, WIDTH)
    assert camera_errors(files(kept)[0], intrinsics, turn @ poses)[1] == 0.0
    assert camera_errors(files(undone)[0], intrinsics, poses)[1] < 1e-12
    assert str(attributes(files(kept)[0])["source_applied_transform"]).startswith("kept")


def test_one_moving_camera(tmp_path: Path):
    """Consecutive frames of one camera: only when said, because a capture of a static scene looks the same."""
    content = write_transforms(tmp_path / "scene", views=1, names="frame_{frame:05d}.png", keys=False)
    poses = np.repeat(known_scene.cameras(1, HEIGHT, WIDTH)[1][None], FRAMES, axis=0)
    for entry in content["frames"]:
        frame = int(entry["file_path"][-9:-4])
        poses[frame, 0, 0, 3] += 0.01 * frame
        entry["transform_matrix"] = (poses[frame, 0] @ FLIP).tolist()
    save(tmp_path / "scene", content)

    with pytest.raises(DataError, match="(?s)a static scene is one frame.*moving_camera=true"):
        import_recordings(tmp_path / "scene", tmp_path / "out")
    (path,) = files(
        import_recordings(tmp_path / "scene", tmp_path / "out", {"moving_camera": True, "frame_time": STEP})
    )

    assert camera_errors(path, known_scene.cameras(1, HEIGHT, WIDTH)[0], poses) == (0.0, 0.0)


def _spoil(content: dict[str, Any], kind: str) -> None:
    first = content["frames"][0]
    if kind == "fisheye":
        content["camera_model"] = "OPENCV_FISHEYE"
    elif kind == "fisheye flag":
        content["is_fisheye"] = True
    elif kind == "k4":
        first["k4"] = 0.1
    elif kind == "no depth":
        del first["depth_file_path"]
    elif kind == "escape":
        first["file_path"] = "../../secret.png"
    elif kind == "absolute":
        first["depth_file_path"] = "/etc/hostname"
    elif kind == "nan":
        first["transform_matrix"][0][0] = float("nan")
    elif kind == "shear":
        first["transform_matrix"][0][0] += 0.1
    elif kind == "no matrix":
        del first["transform_matrix"]
    elif kind == "no focal":
        del first["fl_x"]
    elif kind == "size":
        content["w"] = 2 * WIDTH
    elif kind == "missing camera":
        del first["camera"]
    elif kind == "missing time":
        del first["time"]
    elif kind == "lost image":
        content["frames"] = content["frames"][1:]
    elif kind == "static":
        for entry in content["frames"]:
            entry["time"] = 0.0
            entry["camera"] = entry["file_path"]
    elif kind == "twice":
        for entry in content["frames"]:
            entry["camera"] = "one"
    elif kind == "uneven":
        for entry in content["frames"]:
            entry["time"] = entry["time"] ** 2
    elif kind == "apart":
        for entry in content["frames"]:
            entry["time"] += 0.03 * (entry["camera"] == "c1")
    elif kind == "normalised":
        for entry in content["frames"]:
            entry["time"] *= 10


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("fisheye", "OPENCV_FISHEYE; only pinhole"),
        ("fisheye flag", "a fisheye lens"),
        ("k4", "'k4' is 0.1"),
        ("no depth", "frame 0: no 'depth_file_path'"),
        ("escape", "leads out of"),
        ("absolute", "leads out of"),
        ("nan", "frame 0: 'transform_matrix' holds NaN"),
        ("shear", "frame 0: 'transform_matrix' holds no rotation"),
        ("no matrix", "'transform_matrix' is not a matrix"),
        ("no focal", "neither 'fl_x'.*nor 'camera_angle_x'"),
        ("size", "is 64x48 pixels, transforms.json says 128x48"),
        ("missing camera", "frame 0 .* names no camera"),
        ("missing time", 'has no "time"'),
        ("lost image", "different numbers of images: c0 3, c1 3, c2 2"),
        ("static", "a static scene, all 9 images belong to one moment"),
        ("twice", "one camera and one time"),
        ("uneven", "not evenly spaced"),
        ("apart", "0.03 apart"),
        ("normalised", "from 0 to 1, which are hardly seconds"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, kind: str, message: str):
    content = write_transforms(tmp_path / "scene")
    _spoil(content, kind)
    save(tmp_path / "scene", content)

    with pytest.raises(DataError, match=f"(?s){message}") as caught:
        import_recordings(tmp_path / "scene", tmp_path / "out")
    assert len(str(caught.value).splitlines()) <= 3
