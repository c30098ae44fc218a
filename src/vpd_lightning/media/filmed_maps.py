"""Depth and opacity of a film on disk: numbers for other programs, and films to look at."""

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from vpd_lightning.files import AtomicPath
from vpd_lightning.geometry.cameras import pixel_rays
from vpd_lightning.media.video import enlarge, label_bar, write_video
from vpd_lightning.types import Cameras

MAPS = ("depth", "opacity")
_SOLID = 0.5
"""Where less than this stops a ray, its expected distance is mostly that of nothing; depth previews are black there."""


def z_depth(distances: Float[Tensor, "camera height width"], cameras: Cameras) -> Float[Tensor, "camera height width"]:
    """Turn distances along the rays (metres) into z-depths, along the optical axes (metres)."""
    directions = pixel_rays(cameras).directions
    axes = cameras.cam_to_world[:, None, None, :3, 2]
    return distances * (directions * axes).sum(-1).to(distances)


def write_maps(
    folder: Path,
    name: str,
    maps: Mapping[str, NDArray[np.float32]],
    opacity: NDArray[np.float32],
    cameras: Cameras,
    frames_per_second: float,
) -> None:
    """Write ``NAME_maps.npz`` and, where there is more than one frame, a film of each map.

    ``maps`` has ``depth`` (z-depth, metres; 0 where it is no number) or ``opacity``, each (time, height, width).
    The films of depth are black where ``opacity`` is low, whether or not it is written.
    ``cameras`` (axis ``time`` or one for all) go with them: ``intrinsics`` and ``cam_to_world`` of every frame.
    """
    num_frames = len(next(iter(maps.values())))
    matrices = {
        "intrinsics": cameras.intrinsics.expand(num_frames, 3, 3),
        "cam_to_world": cameras.cam_to_world.expand(num_frames, 4, 4),
    }
    arrays = {**maps, **{key: value.cpu().numpy().astype(np.float32) for key, value in matrices.items()}}
    path = folder / f"{name}_maps.npz"
    with AtomicPath(path) as partial, partial.open("wb") as stream:
        np.savez_compressed(stream, **arrays)
    if num_frames > 1:
        for kind, (pictures, caption) in map_pictures(maps, opacity).items():
            labelled = []
            for picture in pictures:
                large = enlarge(picture)
                labelled.append(np.concatenate([label_bar(caption, large.shape[1]), large]))
            write_video(folder / f"{name}_{kind}.webm", np.stack(labelled), frames_per_second)


def map_pictures(
    maps: Mapping[str, NDArray[np.float32]], opacity: NDArray[np.float32]
) -> dict[str, tuple[NDArray[np.uint8], str]]:
    """Return for each map its pictures (time, height, width, 3), and in words what their colours mean.

    Depth goes from blue (near) to red (far) over all frames, and is black where less than half of a ray is stopped, or
    where nothing was measured; opacity goes from black to white.
    """
    pictures = {}
    if "depth" in maps:
        depth = maps["depth"]
        solid = (depth > 0) & (opacity >= _SOLID)
        low, high = (float(edge) for edge in np.percentile(depth[solid], [1, 99])) if solid.any() else (0.0, 1.0)
        level = (255 * np.clip((depth - low) / max(high - low, 1e-6), 0, 1)).astype(np.uint8)
        colored = cv2.applyColorMap(level.reshape(len(level), -1), cv2.COLORMAP_TURBO)[..., ::-1]
        picture = np.where(solid[..., None], colored.reshape(*level.shape, 3), 0).astype(np.uint8)
        pictures["depth"] = (picture, f"depth, {low:.2f} to {high:.2f} m")
    if "opacity" in maps:
        level = (255 * np.clip(opacity, 0, 1)).round().astype(np.uint8)
        pictures["opacity"] = (np.repeat(level[..., None], 3, axis=-1), "opacity, 0 to 1")
    return pictures
