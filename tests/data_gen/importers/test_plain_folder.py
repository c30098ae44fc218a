import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from data_gen.importers.run import import_recordings
from data_gen.inspection.validate import validate_dataset
from tests.data_gen.importers import known_scene
from tests.data_gen.importers.checks import TOLERANCE, assert_valid, attributes, camera_errors, files, worst_point
from tests.data_gen.importers.plain_recording import HEIGHT, MM, WIDTH, change, write_plain
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.errors import DataError

LENS = np.array([-0.18, 0.04, 0.002, -0.001, 0.0])


@pytest.mark.parametrize(
    "conventions",
    [
        {},
        {"axes": "opengl", "pixel_center": 0.0},
        {"depth_type": "distance", "depth": "npy"},
        {"world_to_cam": True, "depth": "tiff"},
        {"axes": "opengl", "world_to_cam": True, "depth_type": "distance", "pixel_center": 0.0},
    ],
    ids=lambda value: "-".join(map(str, value.values())) or "ours",
)
def test_every_convention_comes_out_as_ours(tmp_path: Path, conventions: dict):
    source = write_plain(tmp_path / "take", num_frames=3, **conventions)

    out = import_recordings(source, tmp_path / "out")

    (path,) = files(out)
    intrinsics, poses = known_scene.cameras(3, HEIGHT, WIDTH)
    errors = camera_errors(path, intrinsics, poses)
    assert errors[0] < 1e-12
    assert errors[1] < 1e-12 if conventions.get("world_to_cam") else errors[1] == 0.0
    assert worst_point(path, [i * known_scene.FRAME_TIME for i in range(3)]) < TOLERANCE
    assert_valid(out)
    found = attributes(path)
    assert found["source_axes"] == conventions.get("axes", "opencv")
    assert found["source_depth_type"] == conventions.get("depth_type", "z")
    assert float(found["source_pixel_center"]) == conventions.get("pixel_center", 0.5)
    assert found["depth_type"] == "z" and found["recording"] == "take"


@pytest.mark.parametrize(
    ("written", "claimed", "advice"),
    [
        ({"axes": "opengl"}, {"axes": "opencv"}, "axes are OpenGL"),
        ({"depth_type": "distance"}, {"depth": "z"}, "depth is the distance to the camera centre"),
        ({"depth": "npy"}, {"depth_scale": 1000.0}, "depth is in millimetres"),
        ({"pixel_center": 0.0}, {"pixel_center": 0.5}, "add 0.5 to cx and cy"),
    ],
)
def test_a_wrong_claim_is_caught_by_validation(tmp_path: Path, written: dict, claimed: dict, advice: str):
    source = write_plain(tmp_path / "take", num_frames=3, **written)

    faults = validate_dataset(import_recordings(source, tmp_path / "out", claimed))

    assert any(fault.is_error and advice in str(fault) for fault in faults)


def test_colours_arrive_unchanged(tmp_path: Path):
    source = write_plain(tmp_path / "take", num_frames=3)

    (path,) = files(import_recordings(source, tmp_path / "out"))

    intrinsics, poses = known_scene.cameras(3, HEIGHT, WIDTH)
    with TrajectoryReader(path) as reader:
        for view in range(3):
            picture = known_scene.render(intrinsics[view], poses[view], HEIGHT, WIDTH, 0.05)
            assert (reader.rgb([1], [view])[0, 0] == picture.rgb).all()


@pytest.mark.parametrize("depth_type", ["z", "distance"])
def test_distorted_images_are_straightened(tmp_path: Path, depth_type: str):
    """Colour is bilinear; depth is exact on planes but for its steps, and never averaged over edges."""
    source = write_plain(tmp_path / "take", num_frames=3, distortion=LENS, depth_type=depth_type, pixel_center=0.0)

    out = import_recordings(source, tmp_path / "out")

    (path,) = files(out)
    assert_valid(out)
    intrinsics, poses = known_scene.cameras(3, HEIGHT, WIDTH)
    assert camera_errors(path, intrinsics, poses) == (pytest.approx(0, abs=1e-12), 0.0)
    with TrajectoryReader(path) as reader:
        rgb, depth = reader.rgb([0])[0], reader.depth([0])[0]
    for view in range(3):
        picture = known_scene.render(intrinsics[view], poses[view], HEIGHT, WIDTH, 0.0)
        distorted = known_scene.render(intrinsics[view], poses[view], HEIGHT, WIDTH, 0.0, LENS)
        inner = np.s_[4:-4, 4:-4]
        error = np.abs(rgb[view].astype(float) - picture.rgb)[inner]
        assert np.median(error) <= 1.0  # bilinear between 8-bit values
        assert error.mean() < 0.5 * np.abs(distorted.rgb.astype(float) - picture.rgb)[inner].mean()
        measured = depth[view] > 0
        relative = np.abs(depth[view] - picture.depth)[measured] / picture.depth[measured]
        assert np.quantile(relative, 0.9) < 1e-3  # the nearest pixel alone would be off by up to 2 %
        around = np.stack([np.roll(picture.depth, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)])
        made_up = (depth[view] < 0.99 * around.min(axis=0)) | (depth[view] > 1.01 * around.max(axis=0))
        assert not made_up[measured & (np.ptp(around, axis=0) < 10)][4:-4].any()


def test_what_the_lens_did_not_see_has_no_depth(tmp_path: Path):
    """A pincushion lens: the corners of the straightened image lie outside what was recorded."""
    source = write_plain(tmp_path / "take", num_frames=3, distortion=np.array([0.3, 0.0, 0.0, 0.0, 0.0]))

    (path,) = files(import_recordings(source, tmp_path / "out"))

    with TrajectoryReader(path) as reader:
        depth, rgb = reader.depth([0], [0])[0, 0], reader.rgb([0], [0])[0, 0]
    assert depth[0, 0] == depth[-1, -1] == 0
    assert rgb[0, 0].sum() == 0
    assert (depth > 0).mean() > 0.8


def test_moving_cameras_and_lists_per_frame(tmp_path: Path):
    source = write_plain(tmp_path / "take", num_frames=3, num_views=2)
    content = json.loads((source / "cameras.json").read_text())
    intrinsics, still = known_scene.cameras(2, HEIGHT, WIDTH)
    poses = np.repeat(still[None], 3, axis=0)
    poses[:, 1, 0, 3] += [0.0, 0.01, 0.02]
    content["views"][1]["cam_to_world"] = poses[:, 1].tolist()
    matrix = content["views"][0].pop("K")
    content["views"][0] |= {"fx": [matrix[0][0]] * 3, "fy": matrix[1][1], "cx": matrix[0][2], "cy": matrix[1][2]}
    change(source, **content)

    (path,) = files(import_recordings(source, tmp_path / "out"))

    assert camera_errors(path, intrinsics, poses) == (0.0, 0.0)


def test_smaller_depth_images_of_the_same_view_are_fitted_to_colour(tmp_path: Path):
    source = write_plain(tmp_path / "take", num_frames=3, num_views=2, depth="npy")
    small = {}
    for file in source.glob("*/depth/*.npy"):
        small[file.parts[-3], file.stem] = values = np.load(file)[::2, ::2]
        np.save(file, values)

    out = import_recordings(source, tmp_path / "out", {"height": HEIGHT // 2})

    with TrajectoryReader(files(out)[0]) as reader:
        relative = np.abs(reader.depth([0], [1])[0, 0] / small["view1", "000000"] - 1)
    assert np.quantile(relative, 0.9) < 5e-3  # every other pixel stands for the two it was taken from


def _mistake(source: Path, kind: str) -> None:
    content = json.loads((source / "cameras.json").read_text())
    view = content["views"][1]
    if kind == "no axes":
        del content["axes"]
    elif kind == "nan":
        view["cam_to_world"] = [view["cam_to_world"]] * 3
        view["cam_to_world"] = json.loads(json.dumps(view["cam_to_world"]))
        view["cam_to_world"][2][0][0] = float("nan")
    elif kind == "scaled":
        view["cam_to_world"] = [[2 * x for x in row[:3]] + row[3:] for row in view["cam_to_world"][:3]] + [[0, 0, 0, 1]]
    elif kind == "left-handed":
        view["cam_to_world"] = (np.array(view["cam_to_world"]) @ np.diag([-1.0, 1, 1, 1])).tolist()
    elif kind == "transposed":
        view["cam_to_world"] = np.array(view["cam_to_world"]).T.tolist()
    elif kind == "normalised":
        view["K"] = [[1.0, 0, 0.5], [0, -1.0, 0.5], [0, 0, 1]]
    elif kind == "escape":
        view["name"] = "../other"
    elif kind == "both poses":
        view["world_to_cam"] = view["cam_to_world"]
    elif kind == "too few poses":
        view["cam_to_world"] = [view["cam_to_world"]] * 2
    elif kind == "gap":
        for file in source.glob("*/*/000001.*"):
            file.unlink()
    elif kind == "missing depth":
        (source / "view1/depth/000002.png").unlink()
    elif kind == "coloured depth":
        cv2.imwrite(str(source / "view0/depth/000000.png"), np.zeros((HEIGHT, WIDTH, 3), np.uint16))
    elif kind == "8 bits":
        cv2.imwrite(str(source / "view0/depth/000000.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    elif kind == "other size":
        cv2.imwrite(str(source / "view0/rgb/000001.png"), np.zeros((HEIGHT, WIDTH // 2, 3), np.uint8))
    elif kind == "unaligned":
        cv2.imwrite(str(source / "view0/depth/000000.png"), np.ones((HEIGHT, HEIGHT), np.uint16))
    elif kind == "truncated":
        file = source / "view0/rgb/000001.png"
        file.write_bytes(file.read_bytes()[:60])
    elif kind == "huge":
        file = source / "view0/rgb/000000.png"
        data = bytearray(file.read_bytes())
        data[16:24] = (10**6).to_bytes(4, "big") * 2
        file.write_bytes(bytes(data))
    elif kind == "no unit":
        del content["depth_unit"]
    elif kind == "name":
        (source / "view0/rgb/000001.png").rename(source / "view0/rgb/second.png")
    (source / "cameras.json").write_text(json.dumps(content))
    if kind == "json":
        (source / "cameras.json").write_text("{" * 5)
    elif kind == "deep":
        (source / "cameras.json").write_text('{"views": ' + "[" * 100_000)
    elif kind == "link":
        shutil.copytree(source / "view0", source.parent / "elsewhere")
        shutil.rmtree(source / "view0")
        (source / "view0").symlink_to(source.parent / "elsewhere")


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("no axes", "'axes' is missing.*opencv.*x right, y down"),
        ("nan", "view view1: 'cam_to_world', frame 2 holds NaN"),
        ("scaled", "scaled by 2"),
        ("left-handed", "left-handed"),
        ("transposed", "0 0 0 1. It looks transposed"),
        ("normalised", "focal lengths"),
        ("escape", "leads out of"),
        ("link", "leads out of"),
        ("both poses", "one of 'cam_to_world' and 'world_to_cam'"),
        ("too few poses", "2 matrices; there are 3 frames"),
        ("gap", "frame 1 is missing"),
        ("missing depth", "frame 2 is in one of them only"),
        ("coloured depth", "one channel"),
        ("8 bits", "8 bits, too few"),
        ("other size", "is 32x48 pixels; 64x48 was expected"),
        ("unaligned", "aligned to colour"),
        ("truncated", "000001.png cannot be read as an image"),
        ("huge", "sides of 1 to"),
        ("no unit", "depth_scale=0.001"),
        ("name", "named by the number"),
        ("json", "cannot be read as JSON"),
        ("deep", "cannot be read as JSON"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, kind: str, message: str):
    source = write_plain(tmp_path / "take", num_frames=3, num_views=2)
    _mistake(source, kind)

    with pytest.raises(DataError, match=f"(?s){message}") as caught:
        import_recordings(source, tmp_path / "out")
    assert len(str(caught.value).splitlines()) <= 3
    assert not files(tmp_path / "out")


def _with_sensor(source: Path, **changes: object) -> None:
    """Replace view 0's depth by that of a sensor of 96 x 128 pixels, 4 cm beside the colour camera."""
    content = json.loads((source / "cameras.json").read_text())
    view = content["views"][0]
    to_color = np.eye(4)
    to_color[:3, 3] = [0.04, 0.0, 0.01]
    matrix, _ = known_scene.camera(10.0, 45.0, 2.0, 96, 128)
    pose = np.array(view["cam_to_world"]) @ to_color
    for file in sorted((source / view["name"] / "depth").iterdir()):
        picture = known_scene.render(matrix, pose, 96, 128, int(file.stem) * known_scene.FRAME_TIME)
        cv2.imwrite(str(file), np.rint(picture.depth / MM).astype(np.uint16))
    view["depth_camera"] = {"K": matrix.tolist(), "depth_to_color": to_color.tolist(), **changes}
    (source / "cameras.json").write_text(json.dumps(content))


def test_depth_of_a_sensor_beside_the_colour_camera_is_registered(tmp_path: Path):
    source = write_plain(tmp_path / "take")
    _with_sensor(source)
    imported = import_recordings(source, tmp_path / "out", {"splits.train": 1.0})
    (path,) = files(imported)
    with TrajectoryReader(path) as reader:
        depth, (intrinsics, poses) = reader.depth([0])[0], reader.cameras([0])
        assert reader.view_names == ("view0", "view1", "view2")
    for view in (0, 1):
        points = known_scene.unproject(depth[view], intrinsics[0, view], poses[0, view])
        # Rounded to 0.1 mm and interpolated; around outlines a pixel may show what is a pixel of the sensor away.
        assert np.quantile(known_scene.distance_to_surfaces(points, 0.0), 0.95) < 2e-4
        assert len(points) > 0.9 * depth[view].size
    assert_valid(imported)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"depth_to_color": None}, "depth_to_color"),
        ({"depth_to_color": [[2.0, 0, 0, 0], [0, 2.0, 0, 0], [0, 0, 2.0, 0], [0, 0, 0, 1]]}, "scaled by 2"),
        ({"depth_to_colour": 1}, "unknown key 'depth_to_colour'; did you mean 'depth_to_color'"),
        ({"K": [[1, 0], [0, 1]]}, r"depth_camera: 'K' has shape \(2, 2\)"),
        ({"pixel_center": 0.25}, "pixel_center"),
    ],
)
def test_mistakes_in_a_depth_camera_are_named(tmp_path: Path, changes: dict, message: str):
    source = write_plain(tmp_path / "take")
    _with_sensor(source, **changes)
    with pytest.raises(DataError, match=message):
        import_recordings(source, tmp_path / "out", {})
