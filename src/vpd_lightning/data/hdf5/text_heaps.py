"""Checking where HDF5 keeps texts, before it reads them: it loops (almost) without end over a damaged heap."""

import struct
from pathlib import Path

_SIGNATURE = b"GCOL\x01\x00\x00\x00"
_HEADER = 16  # bytes, of a heap and of each object in it
_SEARCHED = 2**20  # bytes from the start of the file; writers put attributes there
_MIN_BYTES, _MAX_BYTES = 64, 2**24


def global_heaps_valid(path: Path) -> bool:
    """Whether every global heap at the start of the file is filled exactly by its objects (no checksum covers them)."""
    with path.open("rb") as stream:
        content = stream.read(_SEARCHED + _MIN_BYTES)
    start = content.find(_SIGNATURE)
    while 0 <= start < _SEARCHED and len(content) >= start + _HEADER:
        (num_bytes,) = struct.unpack_from("<Q", content, start + 8)
        if not _MIN_BYTES <= num_bytes <= _MAX_BYTES:
            return False
        if start + num_bytes <= len(content) and not _is_filled(content, start + _HEADER, start + num_bytes):
            return False
        start = content.find(_SIGNATURE, start + _HEADER)
    return True


def _is_filled(content: bytes, position: int, end: int) -> bool:
    while end - position >= _HEADER:
        index, _, num_bytes = struct.unpack_from("<HH4xQ", content, position)
        if index == 0:  # what is free, its header included, up to the end
            return num_bytes == end - position
        position += _HEADER + (num_bytes + 7) // 8 * 8
    return position <= end
