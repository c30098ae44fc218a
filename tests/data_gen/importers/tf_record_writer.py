"""Writes TFRecord files of tf.train.Example messages, from the format's description and nothing else."""

import struct


def _table_entry(byte):
    for _ in range(8):
        byte = (byte >> 1) ^ (0x82F63B78 if byte & 1 else 0)
    return byte


_TABLE = [_table_entry(byte) for byte in range(256)]


def crc32c(data):
    """One byte after the other, as in RFC 3720, appendix B.4."""
    state = 0xFFFFFFFF
    for byte in data:
        state = _TABLE[(state ^ byte) & 255] ^ (state >> 8)
    return state ^ 0xFFFFFFFF


def masked(checksum):
    return ((checksum >> 15 | checksum << 17) + 0xA282EAD8) % 2**32


def frame(data):
    """One record: length, its checksum, the data, their checksum."""
    length = struct.pack("<Q", len(data))
    return length + struct.pack("<I", masked(crc32c(length))) + data + struct.pack("<I", masked(crc32c(data)))


def varint(value):
    value %= 2**64
    out = b""
    while value > 127:
        out += bytes([value % 128 + 128])
        value //= 128
    return out + bytes([value])


def delimited(number, data):
    return varint(number * 8 + 2) + varint(len(data)) + data


def example(features, is_packed=True):
    """A serialised Example; values are lists of bytes, of float or of int, and tell the kind."""
    entries = b""
    for name, values in features.items():
        if not values or isinstance(values[0], bytes):
            kind, body = 1, b"".join(delimited(1, value) for value in values)
        elif isinstance(values[0], float):
            if is_packed:
                kind, body = 2, delimited(1, struct.pack(f"<{len(values)}f", *values))
            else:
                kind, body = 2, b"".join(varint(1 * 8 + 5) + struct.pack("<f", value) for value in values)
        elif is_packed:
            kind, body = 3, delimited(1, b"".join(varint(value) for value in values))
        else:
            kind, body = 3, b"".join(varint(1 * 8 + 0) + varint(value) for value in values)
        entries += delimited(1, delimited(1, name.encode()) + delimited(2, delimited(kind, body)))
    return delimited(1, entries)
