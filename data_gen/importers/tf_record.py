"""TFRecord files of ``tf.train.Example`` messages, read without TensorFlow.

A record is its length (8 bytes, little endian), the masked CRC-32C of that length, the data, and the masked CRC-32C of
the data. The data are a protocol buffer: ``Example.features`` (field 1) holds map entries (field 1) of a name (1) and a
``Feature`` (2), which is a list of byte strings (1), of floats (2) or of 64-bit integers (3).
"""

import mmap
import os
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data_gen.importers.crc32c import masked_crc32c
from vpd_lightning.errors import DataError, one_line

FeatureValues = list[memoryview] | NDArray[np.float32] | NDArray[np.int64]
_HEADER = 12  # length and its checksum
_FOOTER = 4
_BYTES_LIST, _FLOAT_LIST, _INT64_LIST = 1, 2, 3
_VARINT, _FIXED64, _DELIMITED, _FIXED32 = 0, 1, 2, 5  # wire types


@dataclass(frozen=True)
class RecordSpan:
    """Where the data of one record lie in their file."""

    path: Path
    index: int
    offset: int
    length: int

    def __str__(self) -> str:
        return f"{self.path.name}, record {self.index}"


def record_spans(path: Path) -> Iterator[RecordSpan]:
    """Walk over a file's records without reading their data.

    Raises:
        DataError: not a TFRecord file, a damaged length, or the file ends within a record.
    """
    size = path.stat().st_size
    position = index = 0
    with path.open("rb") as file:
        while position < size:
            file.seek(position)
            header = file.read(_HEADER)
            span = RecordSpan(path, index, position + _HEADER, 0)
            if len(header) < _HEADER:
                raise _cut_off(span, path)
            if index == 0 and header[:2] == b"\x1f\x8b":
                raise DataError(f"{path} is compressed with gzip. Decompress it first (gunzip).")
            length, checksum = struct.unpack("<QI", header)
            if masked_crc32c(header[:8]) != checksum:
                raise DataError(
                    f"{span}: a checksum is wrong; this is no TFRecord file, or it is damaged.\n"
                    f"Copy {path} again from its source."
                )
            position += _HEADER + length + _FOOTER
            if position > size:
                raise _cut_off(span, path)
            yield RecordSpan(path, index, span.offset, length)
            index += 1


def read_record(span: RecordSpan) -> bytes:
    """Read one record's data and check them against their checksum.

    Raises:
        DataError: the checksum is wrong, or the file has become shorter.
    """
    with span.path.open("rb") as file:
        file.seek(span.offset)
        data = file.read(span.length)
        footer = file.read(_FOOTER)
    if len(footer) < _FOOTER:
        raise _cut_off(span, span.path)
    if masked_crc32c(data) != int.from_bytes(footer, "little"):
        raise DataError(f"{span}: the checksum of the data is wrong; the file is damaged.\nCopy {span.path} again.")
    return data


def map_record(span: RecordSpan) -> memoryview:
    """Return one record's data unread and unchecked: what is not looked at is not loaded from disk."""
    with span.path.open("rb") as file:
        data = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    return data[span.offset : span.offset + span.length]


def parse_example(data: bytes | memoryview, names: Collection[str], where: object) -> dict[str, FeatureValues]:
    """Return the named features of an Example, those that are there; all others are skipped undecoded.

    Args:
        data: serialised ``tf.train.Example``.
        names: features to decode. Byte strings come as views of ``data``.
        where: said in errors.

    Raises:
        DataError: the bytes are not such a message.
    """
    found: dict[str, FeatureValues] = {}
    try:
        for features in _delimited(memoryview(data), 1):
            for entry in _delimited(features, 1):
                name = b"".join(map(bytes, _delimited(entry, 1))).decode()
                if name in names:
                    for feature in _delimited(entry, 2):
                        found[name] = _feature(feature)
    except (ValueError, struct.error) as error:
        raise DataError(f"{where}: the data are not a tf.train.Example ({one_line(error)}).") from error
    return found


def _feature(message: memoryview) -> FeatureValues:
    for number, wire_type, value in _fields(message):
        if wire_type != _DELIMITED:
            continue
        assert isinstance(value, memoryview)
        if number == _BYTES_LIST:
            return list(_delimited(value, 1))
        if number == _FLOAT_LIST:
            return _floats(value)
        if number == _INT64_LIST:
            return _integers(value)
    return []


def _floats(message: memoryview) -> NDArray[np.float32]:
    parts = []
    for number, wire_type, value in _fields(message):
        if number == 1 and wire_type in (_DELIMITED, _FIXED32):  # packed, or one by one
            assert isinstance(value, memoryview)
            parts.append(np.frombuffer(value, "<f4"))
    return np.concatenate(parts) if parts else np.zeros(0, np.float32)


def _integers(message: memoryview) -> NDArray[np.int64]:
    values: list[int] = []
    for number, wire_type, value in _fields(message):
        if number == 1 and wire_type == _VARINT:
            assert isinstance(value, int)
            values.append(value)
        elif number == 1 and wire_type == _DELIMITED:
            assert isinstance(value, memoryview)
            position = 0
            while position < len(value):
                item, position = _varint(value, position)
                values.append(item)
    return np.array([value - 2**64 if value >= 2**63 else value for value in values], np.int64)


def _delimited(message: memoryview, number: int) -> Iterator[memoryview]:
    """Yield the length-delimited fields of that number."""
    for found, wire_type, value in _fields(message):
        if found == number and wire_type == _DELIMITED:
            assert isinstance(value, memoryview)
            yield value


def _fields(message: memoryview) -> Iterator[tuple[int, int, memoryview | int]]:
    """Yield ``(field number, wire type, value)`` of a message; fixed-size values come as their bytes."""
    position = 0
    while position < len(message):
        key, position = _varint(message, position)
        wire_type = key & 7
        if wire_type == _VARINT:
            value, position = _varint(message, position)
            yield key >> 3, wire_type, value
            continue
        if wire_type == _DELIMITED:
            length, position = _varint(message, position)
        elif wire_type in (_FIXED64, _FIXED32):
            length = 8 if wire_type == _FIXED64 else 4
        else:
            raise ValueError(f"wire type {wire_type} is unknown")
        if position + length > len(message):
            raise ValueError(f"a field of {length} bytes reaches past its message")
        yield key >> 3, wire_type, message[position : position + length]
        position += length


def _varint(message: memoryview, position: int) -> tuple[int, int]:
    """Read a base-128 number; gives it and the position after it."""
    value = 0
    for shift in range(0, 70, 7):
        if position >= len(message):
            raise ValueError("a number is cut off")
        byte = message[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value & (2**64 - 1), position
    raise ValueError("a number is longer than 10 bytes")


def _cut_off(span: RecordSpan, path: Path) -> DataError:
    return DataError(f"{span}: the file ends within the record ({os.path.getsize(path)} bytes).\nCopy {path} again.")
