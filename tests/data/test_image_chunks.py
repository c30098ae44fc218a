import zlib
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from vpd_lightning.data.hdf5.image_chunks import ImageChunks
from vpd_lightning.data.hdf5.stored_chunks import lzf_size
from vpd_lightning.errors import DataError

SHAPE = (3, 2, 24, 20)


def pictures(kind: str, dtype: Any) -> np.ndarray:
    """Pictures that pack badly, well, and in runs of every length."""
    draw = np.random.default_rng(3)
    if kind == "noise":
        return draw.integers(0, 250, size=SHAPE).astype(dtype)
    if kind == "flat":
        return np.full(SHAPE, 7, dtype)
    steps = draw.integers(1, 40, size=400).cumsum() % 17
    return np.resize(np.repeat(steps, draw.integers(1, 90, size=400)), SHAPE).astype(dtype)


@pytest.mark.parametrize("kind", ["noise", "flat", "runs"])
@pytest.mark.parametrize("dtype", ["u1", "<u2", "<f4"])
@pytest.mark.parametrize("options", [{"compression": "gzip"}, {"compression": "lzf"}, {}])
@pytest.mark.parametrize("chunks", [(1, 1, 24, 20), (2, 2, 10, 20)])
@pytest.mark.parametrize("extra", [{}, {"shuffle": True, "fletcher32": True}])
def test_images_equal_what_hdf5_reads(
    tmp_path: Path, kind: str, dtype: str, options: dict[str, Any], chunks: tuple[int, ...], extra: dict[str, Any]
):
    expected = pictures(kind, dtype)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        chunked = ImageChunks(
            tmp_path / "a.h5", file.create_dataset("x", data=expected, chunks=chunks, **options, **extra)
        )
        for times, views in (([0, 1, 2], [0, 1]), ([2, 0], [1]), ([], [0])):
            found = chunked.read(np.array(times, int), np.array(views, int))

            assert found.dtype == expected.dtype
            np.testing.assert_array_equal(found, expected[np.ix_(times, views)])


def lzf_bomb(num_bytes: int) -> bytes:
    """One zero, and as often as needed: 264 times the byte before."""
    return b"\x00\x00" + b"\xe0\xff\x00" * (num_bytes // 264)


@pytest.mark.parametrize(
    ("compression", "content"),
    [
        ("gzip", zlib.compress(bytes(10_000))),
        ("gzip", zlib.compress(bytes(479))),
        ("gzip", zlib.compress(bytes(480))[:-1]),
        ("gzip", b"\x78\x9c"),
        ("lzf", lzf_bomb(10_000)),
        ("lzf", lzf_bomb(300)),
        ("lzf", b"\x20\x05"),  # a copy of what was five bytes before the start
        ("lzf", b"\x1f"),  # 32 bytes that are not there
        ("lzf", b"\xe0"),
    ],
)
@pytest.mark.parametrize("mask", [0, 2])
def test_chunk_that_is_not_one_image_is_refused(tmp_path: Path, compression: str, content: bytes, mask: int):
    """``mask`` 2 claims that the checksum was left out."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        dataset = file.create_dataset(
            "x", data=np.zeros(SHAPE, np.uint8), chunks=(1, 1, 24, 20), compression=compression, fletcher32=bool(mask)
        )
        dataset.id.write_direct_chunk((0, 0, 0, 0), content, mask)
        with pytest.raises(DataError, match=r"a\.h5: '/x'"):
            ImageChunks(tmp_path / "a.h5", dataset).read(np.array([0]), np.array([0]))


def test_image_that_was_stored_unpacked_is_read(tmp_path: Path):
    expected = np.random.default_rng(0).integers(0, 256, size=SHAPE).astype(np.uint8)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        dataset = file.create_dataset("x", SHAPE, np.uint8, chunks=(1, 1, 24, 20), compression="gzip")
        for place in np.ndindex(SHAPE[:2]):
            dataset.id.write_direct_chunk((*place, 0, 0), expected[place].tobytes(), 1)
        np.testing.assert_array_equal(
            ImageChunks(tmp_path / "a.h5", dataset).read(np.arange(3), np.arange(2)), expected
        )


@pytest.mark.parametrize("kind", ["noise", "flat", "runs"])
def test_the_size_of_what_lzf_packed_is_known_without_unpacking(tmp_path: Path, kind: str):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        dataset = file.create_dataset("x", data=pictures(kind, "u1"), chunks=(1, 1, 24, 20), compression="lzf")
        for place in np.ndindex(SHAPE[:2]):
            skipped, packed = dataset.id.read_direct_chunk((*place, 0, 0))
            assert skipped or lzf_size(packed) == 24 * 20
            assert skipped == (kind == "noise")


def test_a_checksum_that_does_not_fit_is_noticed_however_a_chunk_is_packed(tmp_path: Path):
    for number, options in enumerate(({"compression": "lzf"}, {"compression": "gzip"}, {})):
        with h5py.File(tmp_path / f"{number}.h5", "w") as file:
            dataset = file.create_dataset(
                "x", data=pictures("flat", "u1"), chunks=(1, 1, 24, 20), fletcher32=True, **options
            )
            _, packed = dataset.id.read_direct_chunk((0, 0, 0, 0))
            dataset.id.write_direct_chunk((0, 0, 0, 0), bytes([packed[0], packed[1] ^ 1]) + packed[2:])
        with h5py.File(tmp_path / f"{number}.h5") as file, pytest.raises(DataError, match="'/x'"):
            ImageChunks(tmp_path / f"{number}.h5", file["x"]).read(np.array([0]), np.array([0]))


@pytest.mark.parametrize("options", [{"compression": "gzip"}, {"compression": "lzf"}, {}, {"fletcher32": True}])
@pytest.mark.parametrize("chunks", [(1, 1, 24, 20), (2, 2, 10, 20), (3, 2, 24, 20)])
@pytest.mark.parametrize("mask", [0, 1])
def test_chunk_that_holds_too_little_is_refused(
    tmp_path: Path, options: dict[str, Any], chunks: tuple[int, ...], mask: int
):
    """HDF5 would go on reading behind the end of what such a chunk holds, packed or not."""
    content = zlib.compress(bytes(16)) if options.get("compression") == "gzip" and not mask else bytes(16)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        dataset = file.create_dataset("x", data=np.zeros(SHAPE, np.uint8), chunks=chunks, **options)
        dataset.id.write_direct_chunk((0, 0, 0, 0), content, mask if options else 0)
    with h5py.File(tmp_path / "a.h5") as file, pytest.raises(DataError, match=r"a\.h5: '/x'"):
        ImageChunks(tmp_path / "a.h5", file["x"]).read(np.array([0]), np.array([0]))


def test_chunk_that_leaves_out_the_shuffle_is_refused(tmp_path: Path):
    """It is legal, but nothing writes it; taken for shuffled it would give other numbers."""
    values = np.arange(480, dtype=np.float32).reshape(1, 1, 24, 20)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        dataset = file.create_dataset("x", data=values, chunks=(1, 1, 24, 20), compression="gzip", shuffle=True)
        dataset.id.write_direct_chunk((0, 0, 0, 0), zlib.compress(values.tobytes()), 1)
    with h5py.File(tmp_path / "a.h5") as file, pytest.raises(DataError, match="leaves out steps"):
        ImageChunks(tmp_path / "a.h5", file["x"]).read(np.array([0]), np.array([0]))
