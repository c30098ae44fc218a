"""Writes recordings of the known scene as plain folders, in any of the conventions the format knows."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tests.data_gen.importers import known_scene

HEIGHT, WIDTH = 48, 64
MM = 1e-4  # metres per step of 16-bit depth: 0.05 mm rounding, below the tolerance of 0.1 mm


def write_plain(
    folder: Path,
    *,
    num_frames: int = 4,
    num_views: int = 3,
    axes: str = "opencv",
    pixel_center: float = 0.5,
    depth_type: str = "z",
    depth: str = "png",
    world_to_cam: bool = False,
    distortion: np.ndarray | None = None,
    first: int = 0,
    **extra: Any,
) -> Path:
    intrinsics, poses = known_scene.cameras(num_views, HEIGHT, WIDTH)
    views = []
    for view in range(num_views):
        name = f"view{view}"
        for kind in ("rgb", "depth"):
            (folder / name / kind).mkdir(parents=True, exist_ok=True)
        for frame in range(num_frames):
            time = (first + frame) * known_scene.FRAME_TIME
            picture = known_scene.render(intrinsics[view], poses[view], HEIGHT, WIDTH, time, distortion)
            stem = f"{first + frame:06d}"
            cv2.imwrite(str(folder / name / "rgb" / f"{stem}.png"), picture.rgb[..., ::-1])
            values = picture.depth if depth_type == "z" else picture.distance
            if depth == "png":
                cv2.imwrite(str(folder / name / "depth" / f"{stem}.png"), np.rint(values / MM).astype(np.uint16))
            elif depth == "tiff":
                cv2.imwrite(str(folder / name / "depth" / f"{stem}.tiff"), values.astype(np.float32))
            else:
                np.save(folder / name / "depth" / f"{stem}.npy", values.astype(np.float32))
        matrix = intrinsics[view].copy()
        matrix[:2, 2] += pixel_center - 0.5
        pose = poses[view] @ np.diag([1.0, -1.0, -1.0, 1.0]) if axes == "opengl" else poses[view]
        entry = {"name": name, "K": matrix.tolist()}
        entry["world_to_cam" if world_to_cam else "cam_to_world"] = (
            np.linalg.inv(pose) if world_to_cam else pose
        ).tolist()
        if distortion is not None:
            entry["distortion"] = distortion.tolist()
        views.append(entry)
    content = {
        "frame_time": known_scene.FRAME_TIME,
        "axes": axes,
        "pixel_center": pixel_center,
        "depth_type": depth_type,
        "views": views,
        **({"depth_unit": MM} if depth == "png" else {}),
        **extra,
    }
    (folder / "cameras.json").write_text(json.dumps(content))
    return folder


def change(folder: Path, **values: Any) -> dict[str, Any]:
    """Change keys of ``cameras.json`` and return its content; ``None`` removes a key."""
    content = json.loads((folder / "cameras.json").read_text())
    content.update(values)
    content = {key: value for key, value in content.items() if value is not None}
    (folder / "cameras.json").write_text(json.dumps(content))
    return content
