import json
import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from data_gen.importers import lerobot_tables, video_file
from data_gen.importers.run import import_recordings
from tests.data_gen.importers import known_scene
from tests.data_gen.importers.checks import TOLERANCE, assert_valid, attributes, camera_errors, files, worst_point
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.errors import ConfigError, DataError

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")
av = pytest.importorskip("av")

HEIGHT, WIDTH, FPS = 48, 64, 20
LENGTHS = (3, 5, 4)  # frames of the episodes; all lie in one video and one table, as LeRobot writes them
LOW, HIGH, SHIFT = 0.8, 6.0, 3.5
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
Pictures = list[list[known_scene.Picture]]


def pictures() -> Pictures:
    """Of all frames of all episodes, by view; the scene goes on from one episode to the next."""
    intrinsics, poses = known_scene.cameras(2, HEIGHT, WIDTH)
    return [
        [known_scene.render(intrinsics[v], poses[v], HEIGHT, WIDTH, frame / FPS) for v in range(2)]
        for frame in range(sum(LENGTHS))
    ]


def write_video(path: Path, images: list[np.ndarray], pix_fmt: str) -> None:
    """Without loss: 12-bit depth as LeRobot's HEVC Main 12, colour as RGB."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx265" if pix_fmt == "gray12le" else "libx264rgb", rate=FPS)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, pix_fmt
        stream.options = {"x265-params": "lossless=1:log-level=none", "qp": "0", "g": "4"}
        for index, image in enumerate(images):
            if pix_fmt == "gray12le":
                frame = av.VideoFrame(WIDTH, HEIGHT, pix_fmt)
                padded = np.zeros((HEIGHT, frame.planes[0].line_size // 2), "<u2")
                padded[:, :WIDTH] = image
                frame.planes[0].update(padded.tobytes())
            else:
                frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = index, Fraction(1, FPS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def codes_of(depth: np.ndarray, is_log: bool) -> np.ndarray:
    """LeRobot's coding of metres in 12 bits."""
    if is_log:
        share = (np.log(depth + SHIFT) - np.log(LOW + SHIFT)) / (np.log(HIGH + SHIFT) - np.log(LOW + SHIFT))
    else:
        share = (depth - LOW) / (HIGH - LOW)
    return np.clip(np.rint(share * 4095), 0, 4095).astype(np.uint16)


def write_lerobot(root: Path, depth: str = "video", is_log: bool = True) -> Path:
    """A data set of version 3: two cameras, poses and intrinsics as features; the path of the mapping is returned."""
    intrinsics, poses = known_scene.cameras(2, HEIGHT, WIDTH)
    shown = pictures()
    image = {"dtype": "video", "shape": [HEIGHT, WIDTH, 3], "names": ["height", "width", "channels"]}
    features: dict[str, Any] = {key: {"dtype": "int64", "shape": [1]} for key in ("episode_index", "frame_index")}
    features |= {f"observation.images.c{v}": image for v in range(2)}
    features |= {
        "extrinsic_cv": {"dtype": "float32", "shape": [3, 4]},
        "intrinsic_cv": {"dtype": "float64", "shape": [3, 3]},
    }
    features |= {"cam2world_gl": {"dtype": "float64", "shape": [16]}, "pose7": {"dtype": "float64", "shape": [7]}}
    total = sum(LENGTHS)
    columns: dict[str, Any] = {
        "episode_index": np.repeat(np.arange(len(LENGTHS)), LENGTHS),
        "frame_index": np.concatenate([np.arange(n) for n in LENGTHS]),
        "intrinsic_cv": [intrinsics[0].tolist()] * total,
        "cam2world_gl": [(poses[1] @ FLIP).ravel().tolist()] * total,
        "extrinsic_cv": pa.array([np.linalg.inv(poses[0])[:3].tolist()] * total, pa.list_(pa.list_(pa.float64()))),
    }
    for v in range(2):
        write_video(
            root / f"videos/observation.images.c{v}/chunk-000/file-000.mp4", [frame[v].rgb for frame in shown], "rgb24"
        )
        key = f"observation.images.d{v}"
        if depth == "video":
            info = {"is_depth_map": True, "video.depth_min": LOW, "video.depth_max": HIGH}
            info |= {"video.use_log": is_log, "video.shift": SHIFT}
            features[key] = {"dtype": "video", "shape": [HEIGHT, WIDTH, 1], "names": None, "info": info}
            codes = [codes_of(frame[v].depth, is_log) for frame in shown]
            codes[0][0, :3] = [0, 4095, 1]
            write_video(root / f"videos/{key}/chunk-000/file-000.mp4", codes, "gray12le")
        else:
            features[key] = {"dtype": "image", "shape": [HEIGHT, WIDTH, 1], "names": None}
            encoded = []
            for frame in shown:
                suffix, values = (
                    (".png", np.rint(frame[v].depth / 1e-4).astype(np.uint16))
                    if depth == "png"
                    else (".tiff", frame[v].depth.astype(np.float32))
                )
                encoded.append({"bytes": cv2.imencode(suffix, values)[1].tobytes(), "path": None})
            columns[key] = encoded
    (root / "data/chunk-000").mkdir(parents=True)
    pq.write_table(pa.table(columns), root / "data/chunk-000/file-000.parquet", row_group_size=5)
    rows = []
    for index, length in enumerate(LENGTHS):
        start = sum(LENGTHS[:index])
        row = {"episode_index": index, "length": length, "data/chunk_index": 0, "data/file_index": 0}
        for key, feature in features.items():
            if feature["dtype"] == "video":
                row |= {f"videos/{key}/chunk_index": 0, f"videos/{key}/file_index": 0}
                row |= {
                    f"videos/{key}/from_timestamp": start / FPS,
                    f"videos/{key}/to_timestamp": (start + length) / FPS,
                }
        rows.append(row | {"tasks": ["push"], "stats/action/min": [0.0]})
    (root / "meta/episodes/chunk-000").mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist(rows), root / "meta/episodes/chunk-000/file-000.parquet")
    info = {
        "codebase_version": "v3.0",
        "fps": FPS,
        "features": features,
        "splits": {"train": f"0:{len(LENGTHS)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    }
    (root / "meta/info.json").write_text(json.dumps(info))
    shared = {"pixel_center": 0.5, "depth_type": "z"} | ({"depth_unit": 1e-4} if depth == "png" else {})
    k = intrinsics[1]
    views = [
        {"name": "a", "intrinsics": "intrinsic_cv", "world_to_cam": "extrinsic_cv", "axes": "opencv"},
        {
            "name": "b",
            "intrinsics": {"fx": float(k[0, 0]), "fy": float(k[1, 1]), "cx": float(k[0, 2]), "cy": float(k[1, 2])},
            "cam_to_world": "cam2world_gl",
            "axes": "opengl",
        },
    ]
    for v, view in enumerate(views):
        view |= {"rgb": f"observation.images.c{v}", "depth": f"observation.images.d{v}", **shared}
    mapping = root.parent / "mapping.yaml"
    mapping.write_text(yaml.safe_dump({"views": views}))
    return mapping


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    root = tmp_path_factory.mktemp("lerobot") / "robot"
    return root, write_lerobot(root)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    root = tmp_path_factory.mktemp("lerobot_images") / "robot"
    return root, write_lerobot(root, depth="png")


def times_of(path: Path) -> list[float]:
    episode = int(str(attributes(path)["recording"])[-1])
    return [(sum(LENGTHS[:episode]) + i) / FPS for i in range(LENGTHS[episode])]


def test_images_and_features_become_exact_recordings(images: tuple[Path, Path], tmp_path: Path):
    out = import_recordings(images[0], tmp_path / "out", {"mapping": str(images[1])})

    intrinsics, poses = known_scene.cameras(2, HEIGHT, WIDTH)
    shown = pictures()
    assert len(files(out)) == 3
    for path in files(out):
        assert max(camera_errors(path, intrinsics, poses)) < 1e-12
        times = times_of(path)
        assert worst_point(path, times) < TOLERANCE
        with TrajectoryReader(path) as reader:
            for frame, time in enumerate(times):
                for view in range(2):
                    assert (reader.rgb([frame], [view])[0, 0] == shown[round(time * FPS)][view].rgb).all()
    found = attributes(files(out)[0])
    assert found["frame_time"] == 1 / FPS and found["source_axes"] == "opencv opengl"
    assert_valid(out)


@pytest.mark.parametrize("is_log", [True, False])
def test_depth_videos_give_every_code_back(is_log: bool, tmp_path: Path):
    mapping = write_lerobot(tmp_path / "robot", is_log=is_log)

    out = import_recordings(tmp_path / "robot", tmp_path / "out", {"mapping": str(mapping)})

    shown = pictures()
    for path in files(out):
        with TrajectoryReader(path) as reader:
            depth = reader.depth()
        for frame, time in enumerate(times_of(path)):
            for view in range(2):
                truth = shown[round(time * FPS)][view].depth
                error = np.abs(depth[frame, view] - truth)
                if time == 0.0:
                    assert depth[0, view][0, :2].tolist() == [0.0, 0.0]  # out of range, either way
                    error[0, :3] = 0.0
                # Half a step of 12 bits: 5.2 m / 4095 evenly; in the logarithm steps grow with depth + shift.
                step = (HIGH + SHIFT) * np.log((HIGH + SHIFT) / (LOW + SHIFT)) / 4095 if is_log else (HIGH - LOW) / 4095
                assert error.max() < 0.51 * step


def test_frames_can_be_read_in_any_order(videos: tuple[Path, Path]):
    shown = pictures()
    file = video_file.VideoFile(videos[0] / "videos/observation.images.c0/chunk-000/file-000.mp4")
    for index in (7, 2, 2, 11, 0, 5, 6, 1):
        assert (video_file.rgb_of(file.frame(index / FPS, 0.4 / FPS)) == shown[index][0].rgb).all()
    with pytest.raises(DataError, match="no frame at 5.0000 s"):
        file.frame(5.0, 0.4 / FPS)
    with pytest.raises(DataError, match="rgb24|gbrp"):
        video_file.gray_of(file.frame(0.0, 0.4 / FPS), "colour.mp4", 12)


def test_poses_of_seven_numbers(images: tuple[Path, Path], tmp_path: Path):
    from scipy.spatial.transform import Rotation

    pose = known_scene.cameras(2, HEIGHT, WIDTH)[1][0]
    views = yaml.safe_load(images[1].read_text())["views"][:1]
    del views[0]["world_to_cam"]
    views[0] |= {"cam_to_world": "pose7", "quaternion": "xyzw"}
    mapping = tmp_path / "m.yaml"
    mapping.write_text(yaml.safe_dump({"views": views}))
    file = tmp_path / "robot/data/chunk-000/file-000.parquet"
    copy_of(images[0], tmp_path / "robot")
    table = pq.read_table(file)
    seven = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
    pq.write_table(table.append_column("pose7", pa.array([seven] * table.num_rows)), file)

    out = import_recordings(tmp_path / "robot", tmp_path / "out", {"mapping": str(mapping), "max_recordings": 1})

    assert camera_errors(files(out)[0], known_scene.cameras(1, HEIGHT, WIDTH)[0], pose)[1] < 1e-12


def copy_of(source: Path, target: Path) -> None:
    import shutil

    shutil.copytree(source, target)


def _spoil(root: Path, views: list[dict[str, Any]], kind: str) -> None:
    info = json.loads((root / "meta/info.json").read_text())
    if kind == "version":
        info["codebase_version"] = "v2.1"
    elif kind == "feature":
        views[0]["rgb"] = "observation.images.c9"
    elif kind == "key":
        views[0]["intrinsic"] = views[0].pop("intrinsics")
    elif kind == "no pose":
        del views[0]["world_to_cam"]
    elif kind == "axes":
        del views[0]["axes"]
    elif kind == "seven":
        views[0]["intrinsics"] = "cam2world_gl"
    elif kind == "nan":
        file = root / "data/chunk-000/file-000.parquet"
        table = pq.read_table(file)
        rows = table.column("cam2world_gl").to_pylist()
        rows[4] = [float("nan")] * 16
        index = table.column_names.index("cam2world_gl")
        pq.write_table(table.set_column(index, "cam2world_gl", pa.array(rows)), file)
    elif kind == "escape":
        info["data_path"] = "../../{chunk_index}.parquet"
    elif kind == "format":
        info["video_path"] = "{video_key.__class__}/{chunk_index:99999999d}.mp4"
    elif kind == "lost video":
        (root / "videos/observation.images.c1/chunk-000/file-000.mp4").unlink()
    elif kind == "cut video":
        file = root / "videos/observation.images.c1/chunk-000/file-000.mp4"
        file.write_bytes(file.read_bytes()[:500])
    elif kind == "cut table":
        file = root / "data/chunk-000/file-000.parquet"
        file.write_bytes(file.read_bytes()[:500])
    (root / "meta/info.json").write_text(json.dumps(info))


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("version", "version v2.1; version 3 can be imported"),
        ("feature", "no feature 'observation.images.c9'; did you mean 'observation.images.c"),
        ("key", "unknown key 'intrinsic'; did you mean 'intrinsics'"),
        ("no pose", "one of cam_to_world and world_to_cam"),
        ("axes", "'axes' is missing"),
        ("seven", "cam2world_gl has 16 numbers; 9 are needed"),
        ("nan", "episode 1, frame 1 holds NaN"),
        ("escape", "leads out of"),
        ("format", "cannot be filled in"),
        ("lost video", "is missing; episode 0 needs it"),
        ("cut video", "cannot be decoded"),
        ("cut table", "cannot be read as Parquet"),
    ],
)
def test_mistakes_are_named(images: tuple[Path, Path], tmp_path: Path, kind: str, message: str):
    copy_of(images[0], tmp_path / "robot")
    views = yaml.safe_load(images[1].read_text())["views"]
    _spoil(tmp_path / "robot", views, kind)
    mapping = tmp_path / "mapping.yaml"
    mapping.write_text(yaml.safe_dump({"views": views}))

    with pytest.raises((ConfigError, DataError), match=f"(?s){message}") as caught:
        import_recordings(tmp_path / "robot", tmp_path / "out", {"mapping": str(mapping)})
    assert len(str(caught.value).splitlines()) <= 3


def test_without_a_mapping_or_its_packages_the_way_out_is_said(
    images: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    with pytest.raises(ConfigError, match="mapping=FILE"):
        import_recordings(images[0], tmp_path / "out")
    with pytest.raises(ConfigError, match="is not a file"):
        import_recordings(images[0], tmp_path / "out", {"mapping": str(tmp_path / "none.yaml")})
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(ConfigError, match=r"pip install \"vpd-lightning\[lerobot\]\""):
        lerobot_tables.LeRobotFolder(images[0])
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ConfigError, match=r"PyAV: pip install \"vpd-lightning\[lerobot\]\""):
        video_file.import_av()
