"""Small pictures side by side: what the cameras of a trajectory see, and how trajectories differ."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vpd_lightning.data.reader import TrajectoryReader

_MAX_ROWS, _MAX_VIEWS, _MIN_SIDE = 8, 24, 96
_MAX_TRAJECTORIES, _FRAMES_EACH = 16, 6
_MAX_WIDTH = 4096  # pixels of the whole sheet
_GAP = 2
_MASK_COLOR = np.array([255.0, 40.0, 40.0])


def view_sheet(path: Path) -> NDArray[np.uint8]:
    """Return frames (down) by views (across) of one trajectory, and the depth of view 0 in the last column."""
    with TrajectoryReader(path) as reader:
        times = np.unique(np.linspace(0, reader.num_frames - 1, _MAX_ROWS).round().astype(int))
        views = np.arange(min(reader.num_views, _MAX_VIEWS))
        rgb, depth = reader.rgb(times, views), reader.depth(times, [0])
    return _tiled(np.concatenate([rgb, color_depth(depth)], axis=1))


def trajectory_sheet(paths: Sequence[Path]) -> NDArray[np.uint8]:
    """Return trajectories (down, an even choice) by frames (across) as view 0 sees them."""
    chosen = np.unique(np.linspace(0, len(paths) - 1, min(len(paths), _MAX_TRAJECTORIES)).round().astype(int))
    rows = []
    for index in chosen:
        with TrajectoryReader(paths[index]) as reader:
            times = np.linspace(0, reader.num_frames - 1, _FRAMES_EACH).round().astype(int)
            rows.append(reader.rgb(times, [0])[:, 0])
    shape = rows[0].shape
    return _tiled(np.stack([row for row in rows if row.shape == shape]))  # sizes may differ; validate says so


def mask_sheet(path: Path, times: Sequence[int], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return frames (down) by views (across) of one trajectory, with the pixels of a mask (same axes) in red."""
    with TrajectoryReader(path) as reader:
        views = np.arange(min(reader.num_views, _MAX_VIEWS))
        rgb = reader.rgb(times, views)
    grey = np.repeat(rgb.mean(axis=-1, keepdims=True), 3, axis=-1)
    tinted = np.where(mask[:, : len(views), ..., None], 0.45 * rgb + 0.55 * _MASK_COLOR, 0.7 * grey)
    return _tiled(tinted.astype(np.uint8))


def color_depth(depth: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return depth as grey (..., 3) uint8: near is light, far is dark, black is not measured."""
    valid = depth > 0
    if not valid.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    low, high = np.percentile(depth[valid], [1, 99])
    share = np.clip((depth - low) / max(high - low, 1e-6), 0, 1)
    grey = np.where(valid, 255 - 215 * share, 0).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)


def _tiled(images: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Put (row, column, height, width, 3) side by side, enlarged or thinned out to a size that can be looked at."""
    scale = max(1, -(-_MIN_SIDE // min(images.shape[2:4])))
    stride = max(1, -(-images.shape[1] * images.shape[3] // _MAX_WIDTH))
    tiles = images[:, :, ::stride, ::stride]
    if stride == 1:
        tiles = tiles.repeat(scale, axis=2).repeat(scale, axis=3)
    tiles = np.pad(tiles, ((0, 0), (0, 0), (0, _GAP), (0, _GAP), (0, 0)), constant_values=255)
    rows, columns, height, width, _ = tiles.shape
    return tiles.transpose(0, 2, 1, 3, 4).reshape(rows * height, columns * width, 3)
