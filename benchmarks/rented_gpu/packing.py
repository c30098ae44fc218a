"""Recordings and settings in one small file: what a machine without this project's tools needs for a training.

Cameras stand still, so most pixels of a frame are those of the camera's median image, and what is left compresses well:
images are stored without loss as their difference from it. Depth is kept for the input cameras alone, in float32,
actions as they are recorded, and where rays are drawn more densely on what moves, which pixels do.
"""

import io
import json
import lzma
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from vpd_lightning.data.dataset import MovingPixels
from vpd_lightning.data.driven_motion import DrivenMotion
from vpd_lightning.data.frame_source import FrameSource
from vpd_lightning.errors import DataError

SETTINGS = "settings"
_OVERHEAD = 1024  # bytes of the archive for each array, and of a trajectory's name and checksum
_PRESET = 6  # of lzma; 9 saves a hundredth and takes twice as long


@dataclass(frozen=True)
class PackedTrajectory:
    """One recording in memory; only its packed views have pixels."""

    path: Path
    packed_rgb: Mapping[int, UInt8[np.ndarray, "time height width 3"]]  # by view
    packed_depth: Mapping[int, Float32[np.ndarray, "time height width"]]
    intrinsics: Float[np.ndarray, "view 3 3"]
    cam_to_world: Float[np.ndarray, "view 4 4"]
    action: DrivenMotion | None = None
    moving_bits: UInt8[np.ndarray, "time byte"] | None = None  # of the pixels of the target views (view, y, x)
    use_cache: bool = True

    @property
    def num_frames(self) -> int:
        return len(next(iter(self.packed_rgb.values())))

    @property
    def num_views(self) -> int:
        return len(self.intrinsics)

    @property
    def height(self) -> int:
        return int(next(iter(self.packed_rgb.values())).shape[1])

    @property
    def width(self) -> int:
        return int(next(iter(self.packed_rgb.values())).shape[2])

    def rgb(self, times: Sequence[int], views: Sequence[int]) -> UInt8[np.ndarray, "time view height width 3"]:
        """Return the colours of the given frames and views."""
        return np.stack([self.packed_rgb[view][list(times)] for view in views], axis=1)

    def depth(self, times: Sequence[int], views: Sequence[int]) -> Float32[np.ndarray, "time view height width"]:
        """Return the z-depths (metres) of the given frames and views."""
        return np.stack([self.packed_depth[view][list(times)] for view in views], axis=1)

    def cameras(
        self, times: Sequence[int], views: Sequence[int]
    ) -> tuple[Float[np.ndarray, "time view 3 3"], Float[np.ndarray, "time view 4 4"]]:
        """Return (intrinsics in pixels, cam_to_world in metres), the same at all times."""
        of_views = self.intrinsics[list(views)], self.cam_to_world[list(views)]
        intrinsics, cam_to_world = (np.repeat(values[None], len(times), axis=0) for values in of_views)
        return intrinsics, cam_to_world

    def driven(self, times: Sequence[int]) -> DrivenMotion | None:
        """Return the given motion at the given frames; None where the recording has none."""
        return None if self.action is None else self.action.at(times)


@dataclass(frozen=True)
class PackedMovingRays:
    """``MovingRays`` whose pixels were found when the recordings were packed."""

    fraction: float

    def pixels(self, trajectory: FrameSource, time: int, views: Sequence[int]) -> Int[np.ndarray, " pixel"]:
        """Return flat indices of the moving pixels of a frame; the views are those that were packed."""
        assert isinstance(trajectory, PackedTrajectory) and trajectory.moving_bits is not None
        count = len(views) * trajectory.height * trajectory.width
        return np.flatnonzero(np.unpackbits(trajectory.moving_bits[time], count=count)).astype(np.int32)


def write_pack(
    path: Path,
    settings: Mapping[str, Any],
    trajectories: Sequence[FrameSource],
    checksums: Sequence[str],
    *,
    views: Sequence[int],
    base: tuple[UInt8[np.ndarray, "view height width 3"], Float32[np.ndarray, "view height width"]],
    input_views: Sequence[int],
    limit_bytes: int,
    moving_rays: MovingPixels | None = None,
    target_views: Sequence[int] = (),
) -> tuple[int, int]:
    """Write settings and as many trajectories as fit into ``limit_bytes``; return how many fitted and the file's size.

    Args:
        path: of the file.
        settings: plain values, for ``training``.
        trajectories: with cameras that stand still and are the same for all.
        checksums: SHA-256 of each trajectory's file.
        views: cameras whose colours are packed.
        base: colours and depth (metres) that these cameras mostly see.
        input_views: cameras whose depth is packed, too.
        limit_bytes: at most so many bytes are written.
        moving_rays: what finds the moving pixels of the ``target_views``, where rays are drawn on those.
        target_views: cameras whose pixels the rays are.

    Raises:
        DataError: not even one trajectory fits.
    """
    base_rgb, base_depth = base
    intrinsics, cam_to_world = (part[0] for part in trajectories[0].cameras([0], range(trajectories[0].num_views)))
    arrays: dict[str, Any] = {
        "views": np.asarray(views),
        "base_rgb": base_rgb,
        "base_depth": base_depth,
        "intrinsics": intrinsics,
        "cam_to_world": cam_to_world,
        "num_frames": np.asarray([t.num_frames for t in trajectories]),
    }
    size = sum(values.nbytes + _OVERHEAD for values in arrays.values()) + len(json.dumps(settings)) + _OVERHEAD
    fitted = 0
    for trajectory in trajectories:
        parts = {
            "trajectory": _packed(trajectory, views, sorted(input_views), base_rgb, base_depth),
            "action": _packed_action(trajectory),
            "moving": b"" if moving_rays is None else _packed_moving(trajectory, moving_rays, target_views),
        }
        parts = {name: content for name, content in parts.items() if content}
        needed = sum(len(content) + _OVERHEAD for content in parts.values())
        if size + needed > limit_bytes:
            break
        for name, content in parts.items():
            arrays[f"{name}_{fitted}"] = np.frombuffer(content, np.uint8)
        size += needed
        fitted += 1
    if not fitted:
        raise DataError(f"Not one trajectory fits into {limit_bytes:,} bytes.\nRaise --limit-mib, or pack fewer views.")
    content = {
        **settings,
        "input_views": sorted(input_views),
        "checksums": list(checksums[:fitted]),
        "names": [f"{t.path.parent.name}/{t.path.name}" for t in trajectories[:fitted]],
    }
    arrays[SETTINGS] = np.frombuffer(json.dumps(content).encode(), np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        np.savez(file, **arrays)
    return fitted, path.stat().st_size


def read_settings(path: Path) -> dict[str, Any]:
    """Return the settings of a pack alone."""
    with np.load(path) as archive:
        return dict(json.loads(archive[SETTINGS].tobytes()))


def read_pack(path: Path) -> tuple[dict[str, Any], list[PackedTrajectory]]:
    """Return the settings and the trajectories of a pack."""
    settings = read_settings(path)
    with np.load(path) as archive:
        shared = {name: archive[name] for name in ("views", "base_rgb", "base_depth", "intrinsics", "cam_to_world")}
        lengths = archive["num_frames"]
        packed = [
            {
                part: archive[name].tobytes()
                for part in ("trajectory", "action", "moving")
                if (name := f"{part}_{n}") in archive
            }
            for n in range(len(settings["names"]))
        ]
    views = [int(view) for view in shared["views"]]
    with_depth = [view for view in views if view in settings["input_views"]]
    found = []
    for name, length, parts in zip(settings["names"], lengths, packed, strict=False):
        rgb, depth = _unpacked(
            parts["trajectory"], int(length), views, with_depth, shared["base_rgb"], shared["base_depth"]
        )
        action = _unpacked_action(parts["action"]) if "action" in parts else None
        moving = None
        if "moving" in parts:
            moving = np.frombuffer(lzma.decompress(parts["moving"]), np.uint8).reshape(int(length), -1)
        cameras = shared["intrinsics"], shared["cam_to_world"]
        found.append(PackedTrajectory(Path(name), rgb, depth, *cameras, action, moving))
    return settings, found


def _packed(
    trajectory: FrameSource,
    views: Sequence[int],
    with_depth: Sequence[int],
    base_rgb: UInt8[np.ndarray, "view height width 3"],
    base_depth: Float32[np.ndarray, "view height width"],
) -> bytes:
    """Pack differences from the median images: colours modulo 256, depths as their bits, a plane per byte."""
    times = range(trajectory.num_frames)
    parts = []
    for row, view in enumerate(views):
        parts.append((trajectory.rgb(times, [view])[:, 0] - base_rgb[row]).tobytes())
    for view in with_depth:
        bits = trajectory.depth(times, [view])[:, 0].view(np.uint32) ^ base_depth[views.index(view)].view(np.uint32)
        parts.append(np.ascontiguousarray(bits.reshape(-1).view(np.uint8).reshape(-1, 4).T).tobytes())
    return lzma.compress(b"".join(parts), preset=_PRESET)


def _packed_action(trajectory: FrameSource) -> bytes:
    """Pack what ``action/`` of the recording's file holds; empty where it has none."""
    driven = trajectory.driven(range(trajectory.num_frames))
    if driven is None:
        return b""
    content = io.BytesIO()
    np.savez(content, **driven.as_arrays())
    return lzma.compress(content.getvalue(), preset=_PRESET)


def _packed_moving(trajectory: FrameSource, rays: MovingPixels, target_views: Sequence[int]) -> bytes:
    """Pack a bit for each pixel of each frame of the target views."""
    moving = np.zeros((trajectory.num_frames, len(target_views) * trajectory.height * trajectory.width), bool)
    for time, row in enumerate(moving):
        row[rays.pixels(trajectory, time, target_views)] = True
    return lzma.compress(np.packbits(moving, axis=1).tobytes(), preset=_PRESET)


def _unpacked_action(packed: bytes) -> DrivenMotion:
    with np.load(io.BytesIO(lzma.decompress(packed))) as archive:
        return DrivenMotion(**archive)


def _unpacked(
    packed: bytes,
    num_frames: int,
    views: Sequence[int],
    with_depth: Sequence[int],
    base_rgb: UInt8[np.ndarray, "view height width 3"],
    base_depth: Float32[np.ndarray, "view height width"],
) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray]]:
    plain = np.frombuffer(lzma.decompress(packed), np.uint8)
    height, width = base_depth.shape[1:]
    pixels = num_frames * height * width
    rgb, depth, start = {}, {}, 0
    for row, view in enumerate(views):
        difference = plain[start : start + 3 * pixels].reshape(num_frames, height, width, 3)
        rgb[view], start = difference + base_rgb[row], start + 3 * pixels
    for view in with_depth:
        planes = plain[start : start + 4 * pixels].reshape(4, pixels)
        bits = np.ascontiguousarray(planes.T).view(np.uint32).reshape(num_frames, height, width)
        depth[view] = (bits ^ base_depth[views.index(view)].view(np.uint32)).view(np.float32)
        start += 4 * pixels
    return rgb, depth
