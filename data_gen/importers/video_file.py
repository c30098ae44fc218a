"""Frames of a video file by time, in any order; reading forwards decodes each frame once."""

from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vpd_lightning.errors import ConfigError, DataError

_MAX_OPEN = 16
_SEEK_AFTER = 2.0  # s; a nearer frame is reached by decoding on


class VideoFile:
    """One video; opened at the first use."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._container: Any = None
        self._frames: Iterator[Any] = iter(())
        self._last: Any = None

    def frame(self, seconds: float, tolerance: float) -> Any:
        """Return PyAV's frame shown at a time (s), or raise ``DataError`` where there is none within ``tolerance``."""
        av = import_av()
        try:
            if self._container is None:
                self._container = av.open(str(self.path))
            if self._last is None or not 0 <= seconds - self._last.time + tolerance < _SEEK_AFTER:
                stream = self._container.streams.video[0]
                self._container.seek(max(0, int((seconds - tolerance) / stream.time_base)), stream=stream)
                self._frames, self._last = self._container.decode(stream), None
            while self._last is None or self._last.time < seconds - tolerance:
                self._last = next(self._frames)
        except StopIteration:
            self._last = None
        except (av.error.FFmpegError, IndexError, OSError) as error:
            self.close()
            raise DataError(f"{self.path} cannot be decoded: {' '.join(str(error).split())[:200]}.") from error
        if self._last is None or abs(self._last.time - seconds) > tolerance:
            raise DataError(f"{self.path} has no frame at {seconds:.4f} s. Is the file complete?")
        return self._last

    def close(self) -> None:
        """Close the file; the next use opens it again."""
        self._frames, self._last = iter(()), None
        if self._container is not None:
            self._container.close()
            self._container = None


class VideoCache:
    """Keeps the videos used last open."""

    def __init__(self) -> None:
        self._files: OrderedDict[Path, VideoFile] = OrderedDict()

    def get(self, path: Path) -> VideoFile:
        """Return a video, closing the one that was used longest ago when there are too many."""
        file = self._files.pop(path, None) or VideoFile(path)
        self._files[path] = file
        while len(self._files) > _MAX_OPEN:
            self._files.popitem(last=False)[1].close()
        return file


def rgb_of(frame: Any) -> NDArray[np.uint8]:
    """Return (height, width, 3) sRGB of a decoded frame."""
    return frame.to_ndarray(format="rgb24")


def gray_of(frame: Any, name: str, bits: int | None = None) -> NDArray[np.uint16]:
    """Return (height, width) codes of a frame with one high-bit-depth channel, as they stand in the file.

    Raises:
        DataError: the video has colour, or another number of bits than wanted.
    """
    components = frame.format.components
    found = components[0].bits
    if len(components) != 1 or found <= 8 or bits not in (None, found):
        raise DataError(
            f"{name} is a {frame.format.name} video; depth needs one channel of {bits or 'over 8'} bits (gray12le)."
        )
    plane = frame.planes[0]
    rows = np.frombuffer(plane, np.dtype("<u2")).reshape(-1, plane.line_size // 2)
    return rows[: frame.height, : frame.width].copy()


def import_av() -> ModuleType:
    """Import PyAV where it is needed first."""
    try:
        import av
    except ImportError as error:
        raise ConfigError('Reading videos needs PyAV: pip install "vpd-lightning[lerobot]"') from error
    return av
