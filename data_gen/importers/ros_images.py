"""ROS image messages as arrays: raw, compressed (JPEG, PNG), and depth compressed with its own header.

Depth follows REP 118: 16-bit integers are millimetres (unless a scale is given), 32-bit floats are metres, both along
the optical axis; 0, NaN and infinity mean nothing was measured.
"""

import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vpd_lightning.errors import DataError

DEPTH_ENCODINGS = ("16UC1", "mono16", "32FC1")
COLOUR_ENCODINGS = ("rgb8", "bgr8", "rgba8", "bgra8", "mono8")
_CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1}
_ORDER = {"rgb8": [0, 1, 2], "bgr8": [2, 1, 0], "rgba8": [0, 1, 2], "bgra8": [2, 1, 0], "mono8": [0, 0, 0]}
_DEPTH_HEADER = struct.Struct("<iff")  # compressed_depth_image_transport: format, then two quantisation parameters
_MAX_PIXELS = 2**27


def describe(message: Any, where: str) -> tuple[str, int, int]:
    """Return encoding, height and width of an ``Image``, or of what a ``CompressedImage`` was before.

    A compressed image is decoded; where its format names no encoding (``jpeg``), 16-bit grey is ``16UC1``, all else
    ``bgr8``.
    """
    if hasattr(message, "encoding"):
        return str(message.encoding), int(message.height), int(message.width)
    image = _decompress(message, cv2.IMREAD_UNCHANGED, where)[0]
    encoding = _named_encoding(message)
    if encoding not in (*DEPTH_ENCODINGS, *COLOUR_ENCODINGS):
        encoding = "16UC1" if image.dtype == np.uint16 and image.ndim == 2 else "bgr8"
    return encoding, image.shape[0], image.shape[1]


def colour_image(message: Any, where: str) -> NDArray[np.uint8]:
    """Return (height, width, 3) RGB; grey is repeated, alpha is dropped.

    Raises:
        DataError: an encoding that is not supported, or damaged data.
    """
    if not hasattr(message, "encoding"):
        return np.ascontiguousarray(_decompress(message, cv2.IMREAD_COLOR, where)[0][..., ::-1])
    encoding = str(message.encoding)
    if encoding not in _CHANNELS:
        raise DataError(
            f"{where}: colour encoding {encoding!r} is not supported; allowed: {', '.join(COLOUR_ENCODINGS)}.\n"
            "Convert it with image_proc or cv_bridge first."
        )
    pixels = _pixels(message, np.dtype(np.uint8), _CHANNELS[encoding], where)
    return np.ascontiguousarray(pixels[..., _ORDER[encoding]])


def depth_image(message: Any, integer_scale: float, float_scale: float, where: str) -> NDArray[np.float64]:
    """Return (height, width) in metres, 0 where nothing was measured.

    Args:
        message: ``Image`` or ``CompressedImage``.
        integer_scale: metres per step of 16-bit depth.
        float_scale: metres per unit of floating-point depth.
        where: said in errors.

    Raises:
        DataError: an encoding that is not supported, or damaged data.
    """
    if not hasattr(message, "encoding"):
        values, parameters = _decompress(message, cv2.IMREAD_UNCHANGED, where)
        if values.dtype != np.uint16 or values.ndim != 2:
            raise DataError(f"{where}: compressed depth is {values.dtype} {values.shape}; 16-bit grey was expected.")
        if parameters is None or _named_encoding(message) != "32FC1":
            return values * integer_scale
        # Inverse depth in 16 bits: value = a / depth + b, 0 = none.
        a, b = parameters
        with np.errstate(divide="ignore"):
            depth = a / (values.astype(np.float64) - b)
        return _measured(np.where(values == 0, 0.0, depth)) * float_scale
    encoding = str(message.encoding)
    if encoding in ("16UC1", "mono16"):
        return _pixels(message, np.dtype(np.uint16), 1, where)[..., 0] * integer_scale
    if encoding == "32FC1":
        return _measured(_pixels(message, np.dtype(np.float32), 1, where)[..., 0].astype(np.float64)) * float_scale
    raise DataError(f"{where}: depth encoding {encoding!r} is not supported; allowed: {', '.join(DEPTH_ENCODINGS)}.")


def _named_encoding(message: Any) -> str:
    return str(message.format).split(";")[0].strip()


def _measured(depth: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0.0)


def _pixels(message: Any, dtype: np.dtype[Any], channels: int, where: str) -> NDArray[Any]:
    """Return (height, width, channel) of a raw image; rows may be padded."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * channels * dtype.itemsize
    data = np.asarray(message.data, np.uint8)
    if height * width > _MAX_PIXELS or step < row or data.size < step * height:
        raise DataError(f"{where}: {data.size} bytes do not make {width} x {height} pixels of {message.encoding}.")
    rows = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :row])
    stored = dtype.newbyteorder(">" if message.is_bigendian else "<")
    return rows.view(stored).astype(dtype, copy=False).reshape(height, width, channels)


def _decompress(message: Any, flags: int, where: str) -> tuple[NDArray[Any], tuple[float, float] | None]:
    """Decode a compressed image; also give the parameters of the depth header where there is one."""
    data = np.asarray(message.data, np.uint8)
    parameters = None
    if "compressedDepth" in str(message.format):
        if "rvl" in str(message.format).lower():
            raise DataError(f"{where}: depth is compressed with RVL, which is not supported; republish it as png.")
        if data.size <= _DEPTH_HEADER.size:
            raise DataError(f"{where}: compressed depth is cut off.")
        _, a, b = _DEPTH_HEADER.unpack(data[: _DEPTH_HEADER.size].tobytes())
        parameters = (a, b)
        data = data[_DEPTH_HEADER.size :]
    image = cv2.imdecode(np.ascontiguousarray(data), flags) if data.size else None
    if image is None:
        raise DataError(f"{where}: an image of format {message.format!r} cannot be decoded.")
    return image, parameters
