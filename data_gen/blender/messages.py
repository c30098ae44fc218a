"""Messages between the program and Blender's process: a JSON head and named arrays, length-prefixed.

Both sides use this file, so it needs NumPy and the standard library only. Nothing is ever unpickled: an array is its
name, type, shape and bytes, and every length is checked before anything is allocated.
"""

import json
import math
import struct
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

_PREFIX = struct.Struct("<4sIQ")  # magic, bytes of the head, bytes of the arrays
_MAGIC = b"VPDB"
_MAX_HEAD = 1 << 26
_MAX_BODY = 1 << 33
_TYPES = frozenset({"|u1", "<u2", "<i4", "<f4", "<f8"})

Arrays = dict[str, NDArray[Any]]


def pack(head: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return one message as bytes."""
    parts, entries = [], []
    for name, array in arrays.items():
        values = np.asarray(array, order="C")
        if values.dtype.str not in _TYPES:
            raise TypeError(f"{name} is {values.dtype}; messages carry {', '.join(sorted(_TYPES))}")
        entries.append([name, values.dtype.str, list(values.shape)])
        parts.append(values.tobytes())
    text = json.dumps({"head": dict(head), "arrays": entries}).encode()
    body = b"".join(parts)
    return _PREFIX.pack(_MAGIC, len(text), len(body)) + text + body


def unpack(read: Callable[[int], bytes]) -> tuple[dict[str, Any], Arrays]:
    """Read one message through ``read(n)``, which returns exactly n bytes or raises.

    Raises:
        ValueError: what arrives is not a message.
    """
    magic, head_size, body_size = _PREFIX.unpack(read(_PREFIX.size))
    if magic != _MAGIC or head_size > _MAX_HEAD or body_size > _MAX_BODY:
        raise ValueError("what arrived is not a message")
    content = json.loads(read(head_size))
    sizes = []
    for _, kind, shape in content["arrays"]:
        if kind not in _TYPES or any(not isinstance(length, int) or length < 0 for length in shape):
            raise ValueError("a message announces an array that messages do not carry")
        sizes.append(math.prod(shape) * np.dtype(kind).itemsize)
    if sum(sizes) != body_size:
        raise ValueError("the arrays of a message do not add up to its length")
    body = read(body_size)
    arrays, start = {}, 0
    for (name, kind, shape), size in zip(content["arrays"], sizes, strict=True):
        arrays[name] = np.frombuffer(body, np.dtype(kind), math.prod(shape), start).reshape(shape)
        start += size
    return content["head"], arrays
