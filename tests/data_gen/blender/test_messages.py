import json
import struct

import numpy as np
import pytest

from data_gen.blender import messages


def reader(data: bytes):
    position = 0

    def read(count: int) -> bytes:
        nonlocal position
        if count > len(data) - position:
            raise EOFError
        position += count
        return data[position - count : position]

    return read


def test_what_is_packed_comes_out():
    arrays = {
        "floats": np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4),
        "bytes": np.arange(6, dtype=np.uint8).reshape(1, 2, 3),
        "none": np.zeros((0, 3), np.int32),
        "scalar": np.array(2.5),
        "transposed": np.arange(6.0).reshape(2, 3).T,
    }
    head, received = messages.unpack(reader(messages.pack({"kind": "frame", "seeds": [1, 2]}, arrays)))

    assert head == {"kind": "frame", "seeds": [1, 2]}
    assert received.keys() == arrays.keys()
    for name, array in arrays.items():
        assert received[name].dtype == array.dtype
        assert np.array_equal(received[name], array)


def test_objects_cannot_be_packed():
    with pytest.raises(TypeError, match="things is object"):
        messages.pack({}, {"things": np.array([{}], dtype=object)})


def message(arrays: list[object], body: bytes, magic: bytes = b"VPDB", head_size: int | None = None) -> bytes:
    text = json.dumps({"head": {}, "arrays": arrays}).encode()
    return struct.pack("<4sIQ", magic, len(text) if head_size is None else head_size, len(body)) + text + body


@pytest.mark.parametrize(
    "data",
    [
        message([], b"", magic=b"Blen"),
        message([], b"", head_size=1 << 30),
        message([["a", "<f4", [2]]], b"1234"),
        message([["a", "|O", [1]]], b"12345678"),
        message([["a", "<f4", [-1]]], b""),
        message([["a", "<f4", [1.5]]], b"123456"),
    ],
    ids=["another program's output", "absurd length", "too short", "objects", "negative", "not whole"],
)
def test_what_is_not_a_message_is_refused(data: bytes):
    with pytest.raises(ValueError, match="message"):
        messages.unpack(reader(data))


def test_message_that_breaks_off_is_noticed():
    whole = messages.pack({}, {"a": np.arange(100.0)})
    with pytest.raises(EOFError):
        messages.unpack(reader(whole[:-1]))
