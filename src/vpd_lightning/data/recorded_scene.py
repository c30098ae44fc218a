"""Cameras, workspace and lengths of a scene, read from its recordings; lengths fit its distance and frame rate.

Lengths that nobody measured follow from how far off the scene is and how fast things fall. The factors lie near the
means over the scenes whose lengths were chosen by hand (tossed block from 1.9 and 2.6 m, MOVi
from 9 m, soft bodies from 18 m).
"""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from vpd_lightning.data.manifest import FILE_NAME, Manifest, load_manifest
from vpd_lightning.data.reader import TrajectoryReader

RECORDINGS = "recordings"
"""``scene.name`` of a configuration that takes its scene from here."""

_GRAVITY = 9.81  # m/s2
_NUM_FILES = 8
"""Training recordings that are looked at, evenly over all of them."""

_OF_DISTANCE: dict[str, float | list[float]] = {
    "r_s": 0.1,
    "r_a_s": 0.32,
    "kernel_radii": [0.0, 0.02, 0.045, 0.21],
    "kernel_bandwidths": [0.02, 0.025, 0.045, 0.21],
    "surface_scale": 0.04,
    "location_noise": 2e-5,
    "contact_range": 0.34,
    "max_contact_depth": 0.055,
    "shadow_scales": [0.04, 0.08, 0.16],
    "moving_depth_threshold": 0.01,
}
"""Lengths as shares of the median depth between near and far."""

_OF_FALL = 0.85
"""Displacement in a step, as a share of that of a body that fell as far as the cameras are off."""

_OF_GRAVITY = 4.0
"""The most that a force changes a body's displacement in a step, as a multiple of what gravity does."""


def recorded_scene(folder: str | Path) -> dict[str, Any]:
    """Return what the training recordings of a data set say, by the names of ``conf/scene``; empty without them.

    Beside these: ``moving_ray_fraction`` (0 for moving cameras, which have no median image), ``moving_depth_threshold``
    (metres), ``num_validation_clips`` and ``num_steps`` (that evaluation can predict).

    Raises:
        DataError: the data set is damaged.
    """
    path = Path(folder).expanduser().absolute()
    manifest_path = path / FILE_NAME
    if not manifest_path.is_file():
        return {}
    return dict(_read(path, manifest_path.stat().st_mtime_ns))


@lru_cache(maxsize=8)
def _read(folder: Path, changed: int) -> dict[str, Any]:
    manifest = load_manifest(folder)
    files = manifest.splits.get("train", [])
    if not files:
        return {}
    chosen = [files[index] for index in np.unique(np.linspace(0, len(files) - 1, _NUM_FILES).round().astype(int))]
    found = [_of_file(file) for file in chosen]
    distance = float(np.median([item["distance"] for item in found]))
    frame_time = float(np.median([item["frame_time"] for item in found]))
    scene: dict[str, Any] = {
        "input_views": list(range(min(item["num_views"] for item in found))),
        "near": min(item["near"] for item in found),
        "far": max(item["far"] for item in found),
        "workspace_min": np.min([item["workspace_min"] for item in found], axis=0).tolist(),
        "workspace_max": np.max([item["workspace_max"] for item in found], axis=0).tolist(),
        "location_scale": _rounded(_OF_FALL * np.sqrt(2 * _GRAVITY * distance) * frame_time),
        "force_scale": _rounded(_OF_GRAVITY * _GRAVITY * frame_time**2),
        "moving_ray_fraction": 0.5 if all(item["is_static"] for item in found) else 0.0,
        "num_validation_clips": min(4, len(manifest.splits.get("validation", []))),
        "num_steps": max(1, min(8, _shortest(manifest, "test", found) - 2)),
    }
    for name, share in _OF_DISTANCE.items():
        scene[name] = (
            [_rounded(part * distance) for part in share] if isinstance(share, list) else _rounded(share * distance)
        )
    return scene


def _of_file(path: Path) -> dict[str, Any]:
    with TrajectoryReader(path) as reader:
        depth = reader.depth([0])[0]
        inside = (depth >= reader.near) & (depth <= reader.far)
        return {
            "distance": float(np.median(depth[inside])) if inside.any() else float(np.sqrt(reader.near * reader.far)),
            "is_static": reader.is_static_cameras,
            **{name: getattr(reader, name) for name in _ATTRIBUTES},
        }


_ATTRIBUTES = ("num_views", "num_frames", "frame_time", "near", "far", "workspace_min", "workspace_max")


def _shortest(manifest: Manifest, split: str, found: list[dict[str, Any]]) -> int:
    files = manifest.splits.get(split, [])
    if not files:
        return int(min(item["num_frames"] for item in found))
    with TrajectoryReader(files[0]) as reader:
        return reader.num_frames


def _rounded(value: float) -> float:
    """Return two significant digits: what is estimated is not known better."""
    return float(f"{value:.2g}")


def recorded(folder: str, name: str, otherwise: Any) -> Any:
    """Return one entry of ``recorded_scene``, or ``otherwise`` where the folder holds no data set (yet)."""
    return recorded_scene(folder).get(name, otherwise)


def recorded_scene_notes(folder: str | Path, scene: Mapping[str, Any]) -> list[str]:
    """Return lines on the scene that the recordings gave, and on entries of ``scene`` that were set by hand instead."""
    found = recorded_scene(folder)
    if not found:
        return []
    low, high = (" ".join(f"{value:.3g}" for value in found[f"workspace_{end}"]) for end in ("min", "max"))
    lines = [
        f"scene of {folder}: views {_listed(found['input_views'])}, near {found['near']:.3g} m, "
        f"far {found['far']:.3g} m, workspace ({low}) to ({high}) m, "
        f"at most {found['location_scale']:.3g} m in a step"
    ]
    for name, value in scene.items():
        if name in found and value != found[name]:
            lines.append(f"scene.{name}={value} was set by hand; the recordings say {found[name]}")
    return lines


def _listed(views: Sequence[int]) -> str:
    return ", ".join(map(str, views)) if len(views) <= 9 else f"0 to {views[-1]}"
