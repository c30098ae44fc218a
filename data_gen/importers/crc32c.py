"""CRC-32C (Castagnoli), fast enough in NumPy for records of tens of megabytes.

The bytes are cut into equal lanes whose checksums advance together, one table look-up per byte position; then
neighbouring lanes are merged pairwise. Merging works because a checksum is linear over GF(2): the checksum of ``a`` and
``b`` in a row is that of ``a`` moved on over ``len(b)`` zero bytes, xor that of ``b``, when both start from zero.
"""

import numpy as np
from numpy.typing import NDArray

_POLYNOMIAL = 0x82F63B78  # 0x1EDC6F41 with its bits reversed
_ALL_ONES = 0xFFFFFFFF
_MAX_LANES = 4096
_SHORT = 1024  # bytes; up to here the plain loop is quicker


def crc32c(data: bytes | memoryview) -> int:
    """Return the CRC-32C of the bytes; ``crc32c(b"123456789") == 0xE3069283``."""
    if len(data) <= _SHORT:
        state = _ALL_ONES
        for byte in bytes(data):
            state = _BYTE_TABLE[(state ^ byte) & 0xFF] ^ (state >> 8)
        return state ^ _ALL_ONES
    values = np.frombuffer(data, np.uint8)
    from_zero = _checksum_from_zero(values)
    start = _advance(_zero_bytes(len(values)), np.array([_ALL_ONES], np.uint32))[0]
    return int(from_zero ^ start ^ np.uint32(_ALL_ONES))


def masked_crc32c(data: bytes | memoryview) -> int:
    """Return the checksum as TFRecord files store it: rotated by 15 bits, plus a constant."""
    value = crc32c(data)
    return (((value >> 15) | (value << 17)) + 0xA282EAD8) & _ALL_ONES


def _checksum_from_zero(values: NDArray[np.uint8]) -> np.uint32:
    """Return the checksum that starts at zero and is not inverted at the end; leading zeros do not change it."""
    lanes = 1
    while lanes < _MAX_LANES and lanes * lanes * 4 < len(values):
        lanes *= 2
    length = -(-len(values) // lanes)
    padded = np.zeros(lanes * length, np.uint8)
    padded[lanes * length - len(values) :] = values
    states = np.zeros(lanes, np.uint32)
    for column in np.ascontiguousarray(padded.reshape(lanes, length).T):
        states = _TABLE[(states ^ column) & 0xFF] ^ (states >> np.uint32(8))
    operator = _zero_bytes(length)
    while len(states) > 1:
        states = _advance(operator, states[0::2]) ^ states[1::2]
        operator = _advance(operator, operator)
    return states[0]


def _make_table() -> NDArray[np.uint32]:
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> np.uint32(1)) ^ np.uint32(_POLYNOMIAL), table >> np.uint32(1))
    return table


def _zero_bytes(count: int) -> NDArray[np.uint32]:
    """Return what ``count`` zero bytes do to each of the 32 bits of a checksum: the columns of a GF(2) matrix."""
    result = np.uint32(1) << np.arange(32, dtype=np.uint32)
    power = _TABLE[result & 0xFF] ^ (result >> np.uint32(8))  # one byte
    while count:
        if count & 1:
            result = _advance(power, result)
        power = _advance(power, power)
        count >>= 1
    return result


def _advance(operator: NDArray[np.uint32], states: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Multiply a GF(2) matrix, given by its columns, with each state."""
    moved = np.zeros_like(states)
    for bit in range(32):
        moved ^= np.where((states >> np.uint32(bit)) & np.uint32(1), operator[bit], np.uint32(0))
    return moved


_TABLE = _make_table()
_BYTE_TABLE = [int(value) for value in _TABLE]
