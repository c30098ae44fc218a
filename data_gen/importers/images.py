"""Reading colour and depth images of recordings, with their sizes checked before and after decoding."""

import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vpd_lightning.data.reader import MAX_IMAGE_SIDE
from vpd_lightning.errors import DataError

COLOR_SUFFIXES = (".png", ".jpg", ".jpeg")
DEPTH_SUFFIXES = (".png", ".npy", ".tiff", ".tif")
_ONE_SURFACE = 1.05  # largest over smallest depth of four neighbours that belong to one surface
MEAN_FROM = 1.5  # pixels of the source under one of the result, from which on depth is averaged
_NOISE_OF_ONE_SURFACE = 3.0  # standard deviations by which measurements of one surface may differ
_ROUNDING = 1e-5  # share of depth; float32 of a plane
_MAX_FILE_BYTES = 512 * 2**20
_MAX_PIXELS = 2**27
_JPEG_SIZES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # the markers whose segment holds the image's size


def image_size(path: Path) -> tuple[int, int]:
    """Return (height, width) of a colour image; of PNG and JPEG from the header, before anything is unpacked."""
    size = _header_size(path)
    if size is None:
        height, width = _decoded(path, cv2.IMREAD_COLOR).shape[:2]
        return height, width
    _check_pixels(str(path), size)
    return size


def depth_size(path: Path) -> tuple[int, int]:
    """Return (height, width) of a depth image."""
    values = _array(path) if path.suffix.lower() == ".npy" else _decoded(path, cv2.IMREAD_UNCHANGED)
    size = values.shape[1:] if values.ndim == 3 and values.shape[0] == 1 else values.shape[:2]
    if len(size) != 2:
        raise DataError(f"{path} is {values.dtype} {values.shape}; depth must have one channel.")
    return size[0], size[1]


def read_color(path: Path, height: int, width: int) -> NDArray[np.uint8]:
    """Read (height, width, 3) sRGB; transparency is ignored, and so is a camera's note to turn the picture."""
    image = _decoded(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image.shape[:2] != (height, width):
        raise DataError(
            f"{path} is {image.shape[1]}x{image.shape[0]} pixels; {width}x{height} was expected, as for the others."
        )
    return np.ascontiguousarray(image[..., ::-1])


def read_depth(
    path: Path, height: int, width: int, metres_per_step: float | None, metres_per_unit: float = 1.0
) -> NDArray[np.float32]:
    """Read (height, width) metres; 0, negative and non-finite values become 0 (no measurement).

    Args:
        path: PNG or TIFF with one channel, or ``.npy``. A smaller or larger image of the same field of view (as
            phones give) is resampled; see ``sample_depth``.
        height: of the colour image.
        width: of the colour image.
        metres_per_step: for integers. ``None``: integers are refused.
        metres_per_unit: for floating-point values.
    """
    values = _array(path) if path.suffix.lower() == ".npy" else _decoded(path, cv2.IMREAD_UNCHANGED)
    return depth_in_metres(values, height, width, metres_per_step, metres_per_unit, str(path))


def depth_in_metres(
    values: NDArray[Any], height: int, width: int, metres_per_step: float | None, metres_per_unit: float, name: str
) -> NDArray[np.float32]:
    """Turn a decoded depth image into (height, width) metres; see ``read_depth``. ``name`` stands in errors."""
    if values.ndim == 3 and 1 in (values.shape[0], values.shape[2]):
        values = values[..., 0] if values.shape[2] == 1 else values[0]
    if values.ndim != 2 or values.dtype.kind not in "uif":
        raise DataError(
            f"{name} is {values.dtype} {values.shape}; depth must have one channel.\n"
            "A coloured picture of depth cannot be turned back into metres; export the raw depth."
        )
    if values.dtype.kind in "ui" and values.dtype.itemsize == 1:
        raise DataError(f"{name} has 8 bits, too few for depth in metres.\nExport depth as 16-bit PNG, TIFF or .npy.")
    if values.dtype.kind in "ui" and metres_per_step is None:
        raise DataError(f"{name} holds whole numbers; say how many metres one step is: depth_scale=0.001 for mm.")
    scale = metres_per_step if values.dtype.kind in "ui" and metres_per_step is not None else metres_per_unit
    depth = (values.astype(np.float64) * scale).astype(np.float32)
    depth[~(np.isfinite(depth) & (depth > 0))] = 0.0
    return _fitted(name, depth, height, width)


def pixel_centers(count: int, source_count: int) -> NDArray[np.float64]:
    """Return where ``count`` pixel centres lie among ``source_count`` pixels of the same field of view.

    Source pixels have their centres at whole numbers here.
    """
    return (np.arange(count) + 0.5) * source_count / count - 0.5


def sample_depth(
    depth: NDArray[np.float32], rows: NDArray[np.float64], columns: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Return z-depth at places between pixels (whose centres are at whole numbers), 0 outside and where none is.

    Where the four pixels around belong to one surface, inverse depth is interpolated, which is exact on planes. The
    nearest pixel alone would be off by half a pixel to one side whenever an image shrinks by an even factor. Across
    edges and beside holes the nearest pixel counts: depth is never averaged there.
    """
    height, width = depth.shape
    nearest_row, nearest_column = np.rint(rows).astype(np.intp), np.rint(columns).astype(np.intp)
    is_seen = (nearest_row >= 0) & (nearest_row < height) & (nearest_column >= 0) & (nearest_column < width)
    nearest = depth[np.clip(nearest_row, 0, height - 1), np.clip(nearest_column, 0, width - 1)]
    row = np.clip(np.floor(rows).astype(np.intp), 0, max(height - 2, 0))
    column = np.clip(np.floor(columns).astype(np.intp), 0, max(width - 2, 0))
    below, right = np.minimum(row + 1, height - 1), np.minimum(column + 1, width - 1)
    corners = np.stack([depth[row, column], depth[row, right], depth[below, column], depth[below, right]])
    corners = corners.astype(np.float64)
    down, across = rows - row, columns - column
    is_between = (down >= 0) & (down <= 1) & (across >= 0) & (across <= 1)
    is_smooth = is_between & (corners.min(axis=0) > 0) & (corners.max(axis=0) <= _ONE_SURFACE * corners.min(axis=0))
    shares = np.stack([(1 - down) * (1 - across), (1 - down) * across, down * (1 - across), down * across])
    inverse = (shares / np.where(corners > 0, corners, 1.0)).sum(axis=0)
    sampled = np.where(is_smooth, 1.0 / np.where(is_smooth, inverse, 1.0), nearest)
    return np.where(is_seen, sampled, 0.0).astype(np.float32)


def mean_depth(
    sample: Callable[[float, float], NDArray[np.float32]], rows_each: float, columns_each: float, noise: float
) -> NDArray[np.float32]:
    """Return the depth of pixels of which each covers several of the source's: the mean inverse depth of one surface.

    It has less noise than the middle. Samples count in pairs on opposite sides of the middle, where both show the
    middle's surface and their mean is its depth but for noise: planes and creases stay where they are. A middle without
    measurement has one where most of the pixel has: their median.

    Args:
        sample: depth (height, width) at places shifted down and right by shares of a pixel's sides; 0: not measured.
        rows_each: how many rows of the source a pixel covers.
        columns_each: how many columns.
        noise: standard deviation of a sample, as a share of depth.
    """
    middle = sample(0.0, 0.0)
    shifts = [
        (down, right)
        for down in _sub_places(rows_each)
        for right in _sub_places(columns_each)
        if (down, right) > (0.0, 0.0)
    ]
    if not shifts:
        return middle
    pairs = [(sample(down, right), sample(-down, -right)) for down, right in shifts]
    every = np.array([one for pair in pairs for one in pair])
    is_seen = every > 0
    is_mostly_seen = is_seen.sum(axis=0) > len(every) / 2
    typical = np.nanmedian(np.where(is_seen | ~is_mostly_seen, every, np.nan), axis=0)
    middle = np.where((middle <= 0) & is_mostly_seen, typical, middle)
    most = _NOISE_OF_ONE_SURFACE * noise * math.sqrt(1.5) + _ROUNDING  # of the mean of two, less the middle
    total, count = np.where(middle > 0, 1 / np.where(middle > 0, middle, 1.0), 0.0), np.ones(middle.shape)
    for one, other in pairs:
        nearest, farthest = np.minimum(one, other), np.maximum(one, other)
        is_same = (nearest * _ONE_SURFACE >= middle) & (farthest <= middle * _ONE_SURFACE) & (nearest > 0)
        both = 1 / np.where(is_same, one, 1.0) + 1 / np.where(is_same, other, 1.0)
        is_same &= np.abs(middle * both / 2 - 1) <= most
        total += np.where(is_same, both, 0.0)
        count += 2 * is_same
    return np.where(middle > 0, count / np.where(middle > 0, total, 1.0), 0.0).astype(np.float32)


def _sub_places(covered: float) -> list[float]:
    """Return where samples lie in a pixel that covers so many of the source's, as shares of its side, 0 in the middle.

    As many as it covers, so that each of the source's pixels counts about once; one where it covers less than two.
    """
    count = max(1, round(covered))
    return [(place + 0.5) / count - 0.5 for place in range(count)]


def _fitted(name: str, depth: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    if depth.shape == (height, width):
        return depth
    if abs(depth.shape[0] * width - depth.shape[1] * height) > 0.01 * depth.shape[0] * width:
        raise DataError(
            f"{name} is {depth.shape[1]}x{depth.shape[0]}; colour is {width}x{height}, of another shape.\n"
            "Depth must be aligned to colour: see the camera's own software (for RealSense: align to colour)."
        )
    rows, columns = np.meshgrid(
        pixel_centers(height, depth.shape[0]), pixel_centers(width, depth.shape[1]), indexing="ij"
    )
    return sample_depth(depth, rows, columns)


def _array(path: Path) -> NDArray[Any]:
    _check_file(path)
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)
        _check_pixels(str(path), values.shape[:2] if values.ndim >= 2 else (0, 0))
        return np.asarray(values)
    except (ValueError, OSError, EOFError) as error:
        raise DataError(f"{path} cannot be read as .npy: {' '.join(str(error).split())[:200]}.") from error


def _decoded(path: Path, flags: int) -> NDArray[Any]:
    _check_file(path)
    size = _header_size(path)
    if size is not None:
        _check_pixels(str(path), size)
    return decode_image(np.fromfile(path, np.uint8), flags, str(path))


def decode_image(content: NDArray[np.uint8], flags: int, name: str) -> NDArray[Any]:
    """Decode the bytes of an image file with OpenCV's ``flags``; ``name`` stands in errors."""
    try:
        image = cv2.imdecode(content, flags) if len(content) else None
    except cv2.error as error:
        raise DataError(f"{name} cannot be read as an image: {' '.join(str(error).split())[:200]}.") from error
    if image is None:
        raise DataError(f"{name} cannot be read as an image. Is it complete?")
    _check_pixels(name, image.shape[:2])
    return image


def _check_file(path: Path) -> None:
    if not path.is_file():
        raise DataError(f"{path} is missing.")
    if not 0 < path.stat().st_size <= _MAX_FILE_BYTES:
        raise DataError(f"{path} has {path.stat().st_size} bytes; allowed: 1 to {_MAX_FILE_BYTES}.")


def _check_pixels(name: str, size: tuple[int, ...]) -> None:
    if min(size) < 1 or max(size) > MAX_IMAGE_SIDE or size[0] * size[1] > _MAX_PIXELS:
        raise DataError(f"{name} has {size} pixels; sides of 1 to {MAX_IMAGE_SIDE} are allowed.")


def _header_size(path: Path) -> tuple[int, int] | None:
    """Read (height, width) of a PNG or JPEG from its header; ``None`` for other files."""
    _check_file(path)
    with path.open("rb") as stream:
        start = stream.read(24)
        if start[:8] == b"\x89PNG\r\n\x1a\n" and len(start) == 24:
            width, height = struct.unpack(">II", start[16:24])
            return height, width
        if start[:2] != b"\xff\xd8":
            return None
        stream.seek(2)
        while True:
            head = stream.read(4)
            if len(head) < 4 or head[0] != 0xFF:
                return None
            if head[1] == 0xFF:  # a fill byte before the marker
                stream.seek(-3, 1)
                continue
            length = struct.unpack(">H", head[2:])[0]
            if head[1] in _JPEG_SIZES:
                body = stream.read(5)
                return struct.unpack(">HH", body[1:5]) if len(body) == 5 else None
            if length < 2:
                return None
            stream.seek(length - 2, 1)
