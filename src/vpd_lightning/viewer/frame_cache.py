"""Pictures that were drawn already, so that a film loops without drawing them again."""

import threading
from collections import OrderedDict
from collections.abc import Hashable

from jaxtyping import UInt8
from numpy.typing import NDArray

MAX_BYTES = 256 * 2**20


class FrameCache:
    """Keeps pictures up to ``max_bytes``; those that were not asked for the longest go first. Thread-safe."""

    def __init__(self, max_bytes: int = MAX_BYTES):
        self._max_bytes, self._bytes = max_bytes, 0
        self._frames: OrderedDict[Hashable, UInt8[NDArray, "_ _ 3"]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Hashable) -> UInt8[NDArray, "_ _ 3"] | None:
        """Return a picture, None where it is not kept."""
        with self._lock:
            if key not in self._frames:
                return None
            self._frames.move_to_end(key)
            return self._frames[key]

    def put(self, key: Hashable, image: UInt8[NDArray, "_ _ 3"]) -> None:
        """Keep a picture; nobody may change it afterwards."""
        image.setflags(write=False)
        with self._lock:
            old = self._frames.pop(key, None)
            self._bytes += image.nbytes - (0 if old is None else old.nbytes)
            self._frames[key] = image
            while self._bytes > self._max_bytes and len(self._frames) > 1:
                self._bytes -= self._frames.popitem(last=False)[1].nbytes
