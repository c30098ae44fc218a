"""Where a rollout is filmed from: recorded cameras, a ring around the workspace, or cameras of a file."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from vpd_lightning.data.clip import read_cameras
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.errors import ConfigError
from vpd_lightning.media.camera_paths import common_target, read_camera_file, resized, ring_cameras
from vpd_lightning.types import Cameras


@dataclass(frozen=True)
class Viewpoints:
    """Where to film from. ``moving``: ``cameras`` are the places of one camera, one per frame; else each makes a film.

    ``views`` are the numbers of recorded cameras, for comparison with the truth; None for cameras of no recording.
    ``names`` are those of the films, ``labels`` those of the cameras. ``is_cycle``: the last place is followed by the
    first.
    """

    cameras: Cameras
    moving: bool
    views: list[int] | None
    names: list[str]
    labels: list[str]
    is_cycle: bool = False


def choose_viewpoints(
    camera: str | int | Sequence[int], path: Path, start: int, num_frames: int, input_views: Sequence[int], frozen: bool
) -> Viewpoints:
    """Turn ``input``, ``all``, numbers of recorded cameras, ``ring`` or the name of a JSON file into cameras.

    A ring has ``num_frames`` places. So many of a file's are used where time moves with the camera, and all where it is
    ``frozen``.

    Raises:
        ConfigError: a word that means nothing, or a camera that the recording lacks.
        DataError: a bad camera file.
    """
    with TrajectoryReader(path) as reader:
        recorded = read_cameras(reader, [start + 1], range(reader.num_views))[0]
        low, high = torch.tensor(reader.workspace_min), torch.tensor(reader.workspace_max)
    if camera == "ring":
        target = common_target(recorded, ((low + high) / 2).float())
        ring = ring_cameras(recorded, num_frames, target)
        angles = [f"{360 * place / num_frames:.0f} deg" for place in range(num_frames)]
        return Viewpoints(ring, True, None, ["ring"], angles, is_cycle=True)
    if isinstance(camera, str) and camera.endswith(".json"):
        return _viewpoints_of_file(Path(camera).expanduser(), None if frozen else num_frames)
    views = _recorded_views(camera, recorded.shape[0], input_views)
    names = [f"camera_{view:02d}" for view in views]
    return Viewpoints(recorded[views], False, views, names, [f"camera {view}" for view in views])


def _viewpoints_of_file(path: Path, num_frames: int | None) -> Viewpoints:
    cameras, moving = read_camera_file(path)
    count = cameras.shape[0]
    if not moving:
        names = [f"novel_{number:02d}" for number in range(count)]
        return Viewpoints(cameras, False, None, names, [f"camera {number}" for number in range(count)])
    if num_frames is not None and count < num_frames:
        raise ConfigError(
            f"{path} has {count} poses of a moving camera, but {num_frames} frames are to be filmed.\n"
            f"Lower num_steps to {count - 1}, or add poses, or stop time with freeze_step."
        )
    kept = cameras[:num_frames]
    return Viewpoints(kept, True, None, ["path"], [f"place {place}" for place in range(kept.shape[0])])


def _recorded_views(camera: str | int | Sequence[int], num_views: int, input_views: Sequence[int]) -> list[int]:
    if camera == "input":
        views = list(input_views)
    elif camera == "all":
        views = list(range(num_views))
    elif isinstance(camera, int):
        views = [camera]
    elif isinstance(camera, list | tuple) and camera and all(isinstance(view, int) for view in camera):
        views = list(camera)
    else:
        raise ConfigError(
            f"camera={camera} means nothing.\nAllowed: input, all, ring, a number, a list [0,5], or FILE.json."
        )
    wrong = [view for view in views if not 0 <= view < num_views]
    if wrong:
        raise ConfigError(f"There is no camera {wrong[0]}: the recording has {num_views} (0 to {num_views - 1}).")
    return views


def resize_viewpoints(viewpoints: Viewpoints, height: int | None, width: int | None) -> Viewpoints:
    """Return the same viewpoints at another image size; other sizes have no truth to compare with."""
    cameras = resized(viewpoints.cameras, height, width)
    same = (cameras.height, cameras.width) == (viewpoints.cameras.height, viewpoints.cameras.width)
    views = viewpoints.views if same else None
    return replace(viewpoints, cameras=cameras, views=views)
