"""Refined poses against the true ones, on three boxes and a floor whose depth is known in closed form."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_gen.importers.image_geometry import ImageGeometry
from data_gen.importers.pose_refinement import refine_poses
from data_gen.importers.recording import Recording
from data_gen.importers.run import import_recordings
from data_gen.importers.settings import ImportSettings
from tests.data_gen.importers import known_scene
from tests.data_gen.importers.checks import attributes, files
from tests.data_gen.importers.plain_recording import write_plain
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.errors import ConfigError, DataError

HEIGHT, WIDTH = 96, 128
CAMERAS = [known_scene.camera(10.0 + 60 * view, 45.0 + 8 * view, 2.0 + 0.2 * view, HEIGHT, WIDTH) for view in range(3)]
INTRINSICS = np.stack([matrix for matrix, _ in CAMERAS])
POSES = np.stack([pose for _, pose in CAMERAS])
OFF = {1: ([0.02, -0.015, 0.01], [0.5, -0.4, 0.6]), 2: ([-0.01, 0.02, 0.012], [0.0, 0.3, 0.0])}  # metres, degrees


def boxes() -> list[np.ndarray]:
    found = []
    for x, y, turn, tilt in ((0.0, 0.0, 20, 0), (-0.55, 0.35, 50, 0), (0.5, -0.45, -15, 10)):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("zx", [turn, tilt], degrees=True).as_matrix()
        pose[:3, 3] = [x, y, 0.25]
        found.append(pose)
    return found


def depth_of(view: int, with_boxes: bool = True) -> np.ndarray:
    matrix, pose = INTRINSICS[view], POSES[view]
    v, u = np.meshgrid(np.arange(HEIGHT) + 0.5, np.arange(WIDTH) + 0.5, indexing="ij")
    x, y = (u - matrix[0, 2]) / matrix[0, 0], (v - matrix[1, 2]) / matrix[1, 1]
    directions = np.stack([x, y, np.ones_like(x)], axis=-1) @ pose[:3, :3].T
    depth = -pose[2, 3] / directions[..., 2]
    for box in boxes() if with_boxes else []:
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.minimum(depth, known_scene._box_hits(pose[:3, 3], directions, box))
    assert (depth > 0).all()
    return depth


def misplaced() -> np.ndarray:
    poses = POSES.copy()
    for view, (shift, turn) in OFF.items():
        poses[view, :3, 3] += shift
        poses[view, :3, :3] = Rotation.from_euler("xyz", turn, degrees=True).as_matrix() @ poses[view, :3, :3]
    return poses


def geometry(poses: np.ndarray, noise: float = 0.0, with_boxes: bool = True) -> ImageGeometry:
    true = [depth_of(view, with_boxes) for view in range(3)]

    def read_depth(frame: int, view: int) -> np.ndarray:
        scatter = np.random.default_rng([frame, view]).standard_normal((HEIGHT, WIDTH))
        return (true[view] * (1 + noise * scatter)).astype(np.float32)

    recording = Recording(
        "take", HEIGHT, WIDTH, INTRINSICS, poses, 7, 3, 0.05,
        lambda frame, view: np.zeros((HEIGHT, WIDTH, 3), np.uint8), read_depth, view_names=("left", "middle", "right"),
    )  # fmt: skip
    return ImageGeometry(recording, ImportSettings())


def errors(poses: np.ndarray) -> list[float]:
    return [float(np.linalg.norm(poses[view, :3, 3] - POSES[view, :3, 3])) for view in (1, 2)]


def test_misplaced_cameras_find_back():
    found = refine_poses({"take": geometry(misplaced())}, 1)
    poses = found.poses["take"]
    assert min(errors(misplaced())) > 0.025
    assert max(errors(poses)) < 0.006
    np.testing.assert_array_equal(poses[0], POSES[0])
    np.testing.assert_allclose(
        poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (3, 1, 1)), atol=1e-12
    )
    text = "\n".join(found.remarks)
    assert "view 1 (middle): moved by 2" in text
    assert "lies 0.0 mm apart (median); before, 7" in text
    halved = "\n".join(refine_poses({"take": geometry(misplaced())}, 1, unit=0.5).remarks)
    assert "view 1 (middle): moved by 13" in halved


def test_noise_leaves_true_poses_alone_and_still_mends_wrong_ones():
    kept = refine_poses({"take": geometry(POSES, noise=0.003)}, 1).poses["take"]
    assert max(errors(kept)) < 0.004
    mended = refine_poses({"take": geometry(misplaced(), noise=0.003)}, 1).poses["take"]
    assert errors(mended)[0] < 0.003
    assert errors(mended)[1] < 0.9 * errors(misplaced())[1]


def test_a_bare_floor_mends_height_and_tilt_and_keeps_the_rest():
    found = refine_poses({"take": geometry(misplaced(), with_boxes=False)}, 1)
    poses = found.poses["take"]
    for view in (1, 2):
        assert poses[view, 2, 3] == pytest.approx(POSES[view, 2, 3], abs=0.001)
        np.testing.assert_allclose(poses[view, :2, 3], misplaced()[view, :2, 3], atol=0.03)  # a tilt is about the floor
    assert any("do not determine 6 of the 12 parts" in line for line in found.remarks)


def test_recordings_of_one_arrangement_share_their_poses_and_others_do_not():
    shifted = POSES.copy()
    shifted[:, 0, 3] += 0.3
    found = refine_poses({"a": geometry(POSES), "b": geometry(POSES), "c": geometry(shifted)}, 1)
    np.testing.assert_array_equal(found.poses["a"], found.poses["b"])
    assert found.poses["c"][0, 0, 3] == shifted[0, 0, 3]
    assert [line for line in found.remarks if line.startswith("refined")] == [
        "refined poses of a and 1 more:",
        "refined poses of c:",
    ]


def test_a_pose_far_off_is_refused_and_one_that_sees_nothing_of_the_others_is_kept():
    poses = POSES.copy()
    poses[2] = np.diag([1.0, -1, -1, 1.0])  # looks down from the origin: nothing in common
    poses[2, 2, 3] = 50.0
    found = refine_poses({"take": geometry(poses)}, 1)
    assert any("view 2 (right): shares too little" in line for line in found.remarks)
    np.testing.assert_array_equal(found.poses["take"][2], poses[2])
    poses = POSES.copy()
    poses[1, :3, 3] += [0.0, 0.0, 0.12]
    poses[1, :3, :3] = Rotation.from_euler("x", 9, degrees=True).as_matrix() @ poses[1, :3, :3]
    with pytest.raises(DataError, match=r"view 1 \(middle\): the pose that fits the surfaces is .* too far"):
        refine_poses({"take": geometry(poses)}, 1)


def test_import_writes_refined_poses_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    source = write_plain(tmp_path / "take", num_views=3)
    content = json.loads((source / "cameras.json").read_text())
    for view in range(3):
        content["views"][view] |= {"K": INTRINSICS[view].tolist(), "cam_to_world": misplaced()[view].tolist()}
        for kind, picture in (("rgb", np.zeros((HEIGHT, WIDTH, 3), np.uint8)), ("depth", depth_of(view))):
            for file in (source / f"view{view}" / kind).iterdir():
                values = picture if kind == "rgb" else np.rint(picture / content["depth_unit"]).astype(np.uint16)
                cv2.imwrite(str(file), values)
    (source / "cameras.json").write_text(json.dumps(content))
    out = import_recordings(source, tmp_path / "out", {"refine_poses": True})
    said = capsys.readouterr().out
    assert "view 1 (view1): moved by 2" in said
    (path,) = files(out)
    with TrajectoryReader(path) as reader:
        assert max(errors(reader.cameras([0])[1][0])) < 0.006
    moved = attributes(path)["source_poses_moved"]
    assert moved[0] == 0
    assert 0.02 < moved[1] < 0.035
    import_recordings(source, tmp_path / "out", {"refine_poses": True})
    assert "complete already" in capsys.readouterr().out


@pytest.mark.parametrize(("views", "moving", "fault"), [(1, False, "has one view"), (2, True, "has cameras that move")])
def test_what_cannot_be_refined_is_refused(tmp_path: Path, views: int, moving: bool, fault: str):
    source = write_plain(tmp_path / "take", num_views=views)
    if moving:
        content = json.loads((source / "cameras.json").read_text())
        pose = content["views"][0]["cam_to_world"]
        poses = [[row[:] for row in pose] for _ in range(4)]
        poses[2][0][3] += 0.1
        content["views"][0]["cam_to_world"] = poses
        (source / "cameras.json").write_text(json.dumps(content))
    with pytest.raises(ConfigError, match=fault):
        import_recordings(source, tmp_path / "out", {"refine_poses": True})
