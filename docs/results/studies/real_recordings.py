"""Turn public recordings, which nobody may pass on, into plain folders for ``vpd-data import``.

``python -m docs.results.studies.real_recordings SOURCE OUT``. ``SOURCE`` holds, as far as they were fetched by hand,
``chocapics/``, ``fruta1/`` and ``CalibrationData.mat`` of github.com/fsousa96/image_processing (structured light, two
cameras and one; depth in the depth sensor's own frame) and ``data/`` of github.com/andyzeng/tsdf-fusion-python
(7-Scenes, a camera that moves through a room). Frame rates are not known of the first two; 0.1 s is assumed. The second
camera's pose in ``chocapics`` is not given: it is found here from features of both pictures (perspective-n-point with
RANSAC), to a few centimetres, and is a case for ``refine_poses=true``. The repositories state no licence: use what
comes out locally.
"""

import argparse
import json
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

from data_gen.importers.depth_registration import DepthCamera, DepthRegistration

Array = NDArray[np.float64]
FRAME_TIME = 0.1
_MAX_FRAMES = 120
_MIN_MATCHES = 30


def calibration(source: Path) -> dict[str, Any]:
    """Return K and lens of colour and depth, and the pose of the depth sensor in the colour camera's frame."""
    values = loadmat(source / "CalibrationData.mat", squeeze_me=True)
    to_color = np.eye(4)
    u, _, v = np.linalg.svd(values["R_d_to_rgb"])
    to_color[:3, :3], to_color[:3, 3] = u @ v, values["T_d_to_rgb"]
    found: dict[str, Any] = {"to_color": to_color}
    for name, key in (("color", "RGB_cam"), ("depth", "Depth_cam")):
        found[name] = (values[key]["K"].item().astype(float), values[key]["DistCoef"].item().astype(float))
    return found


def read_image(path: Path, flags: int) -> NDArray[Any]:
    """Return an image file's values, as OpenCV's ``flags`` want them."""
    image = cv2.imread(str(path), flags)
    if image is None:
        raise ValueError(f"{path} is no image that OpenCV reads")
    return image


def write_view(folder: Path, name: str, frames: Sequence[tuple[Path, Path]]) -> None:
    """Write colour and depth (MATLAB's arrays of millimetres, or PNG) as numbered files."""
    for kind in ("rgb", "depth"):
        (folder / name / kind).mkdir(parents=True)
    for index, (color, depth) in enumerate(frames):
        shutil.copy(color, folder / name / "rgb" / f"{index:06d}{color.suffix}")
        target = folder / name / "depth" / f"{index:06d}.png"
        if depth.suffix == ".mat":
            cv2.imwrite(str(target), loadmat(depth)["depth_array"])
        else:
            image = read_image(depth, cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(target), np.where(image == 65535, 0, image))  # 7-Scenes: none


def structured_light(source: Path, pictures: str, num_views: int, out: Path) -> None:
    """Write ``chocapics`` (two views) or ``fruta1`` (one)."""
    known, folder = calibration(source), source / pictures
    views = []
    for number in range(1, num_views + 1):
        depth = sorted(folder.glob(f"depth{number}_*.mat"), key=_number)
        color = [next(_color_files(folder, number, _number(path))) for path in depth]
        write_view(out, f"camera{number}", list(zip(color, depth, strict=True)))
        sensor = {"K": known["depth"][0].tolist(), "distortion": known["depth"][1].tolist()}
        views.append(
            {
                "name": f"camera{number}",
                "K": known["color"][0].tolist(),
                "distortion": known["color"][1].tolist(),
                "cam_to_world": np.eye(4).tolist(),
                "depth_camera": sensor | {"depth_to_color": known["to_color"].tolist()},
            }
        )
    if num_views == 2:
        views[1]["cam_to_world"] = second_pose(out, known).tolist()
    _write_cameras(out, views, pixel_center=0.0)


def second_pose(folder: Path, known: dict[str, Any]) -> Array:
    """Return the pose (4, 4) of camera2 in camera1's frame, from features that both show in their first pictures."""
    matrix, lens = known["color"]
    shifted = [k + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]) for k in (known["depth"][0], matrix)]
    sensor = DepthCamera(480, 640, shifted[0], known["to_color"], known["depth"][1])
    raw = read_image(folder / "camera1" / "depth" / "000000.png", cv2.IMREAD_UNCHANGED) / np.float32(1000)
    depth = DepthRegistration(sensor, shifted[1], 480, 640)(raw.astype(np.float32))
    paths = [next((folder / f"camera{n}" / "rgb").glob("000000.*")) for n in (1, 2)]
    grey = [cv2.undistort(read_image(path, cv2.IMREAD_GRAYSCALE), matrix, lens) for path in paths]
    detector = cv2.SIFT.create(6000)
    (first, one), (second, two) = (detector.detectAndCompute(image, None) for image in grey)
    pairs = [a for a, b in cv2.BFMatcher().knnMatch(one, two, k=2) if a.distance < 0.8 * b.distance]
    pixels = np.array([first[pair.queryIdx].pt for pair in pairs])
    others = np.array([second[pair.trainIdx].pt for pair in pairs])
    z = depth[np.rint(pixels[:, 1]).astype(int), np.rint(pixels[:, 0]).astype(int)].astype(np.float64)
    rays = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1) @ np.linalg.inv(matrix).T
    points, others = (rays * z[:, None])[z > 0], others[z > 0]
    found, turn, shift, inliers = cv2.solvePnPRansac(
        points, others, matrix, None, iterationsCount=5000, reprojectionError=4.0, confidence=0.9999
    )
    if not found or len(inliers) < _MIN_MATCHES:
        raise RuntimeError(f"only {0 if inliers is None else len(inliers)} features agree")
    print(f"pose of camera2 from {len(inliers)} features")
    to_second = np.eye(4)
    to_second[:3, :3], to_second[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
    return np.linalg.inv(to_second).astype(np.float64)


def seven_scenes(source: Path, out: Path) -> None:
    """Write the first frames of ``data``, a camera that moves."""
    colors = sorted((source / "data").glob("frame-*.color.jpg"))[:_MAX_FRAMES]
    write_view(out, "camera", [(path, Path(str(path).replace(".color.jpg", ".depth.png"))) for path in colors])
    poses = [_rigid(np.loadtxt(str(path).replace(".color.jpg", ".pose.txt"))) for path in colors]
    matrix = np.loadtxt(source / "data" / "camera-intrinsics.txt")
    view = {"name": "camera", "K": matrix.tolist(), "cam_to_world": [pose.tolist() for pose in poses]}
    _write_cameras(out, [view], pixel_center=0.0)


def _rigid(pose: Array) -> Array:
    """Return a pose whose rotation, written with few digits, is one exactly."""
    u, _, v = np.linalg.svd(pose[:3, :3])
    pose[:3, :3] = u @ v
    return pose


def _write_cameras(out: Path, views: list[dict[str, Any]], pixel_center: float) -> None:
    content = {"frame_time": FRAME_TIME, "axes": "opencv", "pixel_center": pixel_center, "depth_type": "z"}
    (out / "cameras.json").write_text(json.dumps(content | {"depth_unit": 0.001, "views": views}))


def _number(path: Path) -> int:
    return int(path.stem.rpartition("_")[2])


def _color_files(folder: Path, camera: int, number: int) -> Iterator[Path]:
    yield from (path for path in sorted(folder.glob(f"rgb_image{camera}_*")) if _number(path) == number)


def main(arguments: Sequence[str] | None = None) -> int:
    """Write what the source has."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    parser.add_argument("out", type=Path)
    options = parser.parse_args(arguments)
    source, out = options.source, options.out
    if (source / "chocapics").is_dir():
        structured_light(source, "chocapics", 2, out / "two_cameras" / "take")
    if (source / "fruta1").is_dir():
        structured_light(source, "fruta1", 1, out / "fruit" / "take")
    if (source / "data").is_dir():
        seven_scenes(source, out / "room" / "take")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
