"""Reading images that are stored one per chunk: unpacked here, which is faster and safer than HDF5's own way.

HDF5 unpacks whatever a chunk holds before it looks at the size, so that a few kilobytes can fill the memory. Here
unpacking stops at the size of one image. Damage shows in zlib's checksum (Adler-32) or, for lzf, in HDF5's Fletcher-32.
ISA-L unpacks gzip's format two to three times as fast as zlib.
"""

import functools
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from isal import igzip_lib, isal_zlib
from numpy.typing import NDArray

from vpd_lightning.data.broken_file import refuse
from vpd_lightning.data.hdf5_checks import FILTER_LZF, damaged_data, read_all

_COMPRESSIONS = (h5py.h5z.FILTER_DEFLATE, FILTER_LZF)
_BYTES_PER_THREAD = 2**19  # less is not worth a second thread
_CHECKSUM_BYTES = 4


class ImageChunks:
    """One checked data set with axes ``time view height width ...``.

    Raises:
        DataError: bytes that do not unpack to exactly one image, or (when made) chunks that could unpack to far more.
    """

    def __init__(self, path: Path, dataset: h5py.Dataset) -> None:
        self.path, self.dataset = path, dataset
        self.image_shape = dataset.shape[2:]
        self.image_bytes = int(np.prod(self.image_shape)) * dataset.dtype.itemsize
        creation = dataset.id.get_create_plist()
        filters = [creation.get_filter(index)[0] for index in range(creation.get_nfilters())]
        packers = [code for code in filters if code in _COMPRESSIONS]
        self._is_lzf = packers == [FILTER_LZF]
        self._is_shuffled = h5py.h5z.FILTER_SHUFFLE in filters and dataset.dtype.itemsize > 1
        self._has_checksum = h5py.h5z.FILTER_FLETCHER32 in filters
        self._is_unpacked_here = bool(packers) and dataset.chunks == (1, 1, *self.image_shape)
        self._packing_bit = 1 << filters.index(packers[0]) if packers else 0
        self._zeros = (0,) * len(self.image_shape)
        if packers and not self._is_unpacked_here:
            self._refuse_swollen_chunks()

    def read(self, times: NDArray[np.int64], views: NDArray[np.int64]) -> NDArray[Any]:
        """Return the images (time, view, height, width, ...) as they are stored."""
        images = np.empty((len(times), len(views), *self.image_shape), self.dataset.dtype)
        if self._is_unpacked_here:
            places = [(t, v, images[i, j]) for i, t in enumerate(times.tolist()) for j, v in enumerate(views.tolist())]
            num_threads = min(_num_threads(), len(places) * self.image_bytes // _BYTES_PER_THREAD)
            if num_threads > 1:  # both ways of unpacking give up Python's lock
                parts = [places[first::num_threads] for first in range(num_threads)]
                list(_pool(os.getpid(), num_threads).map(self._unpack_all, parts))
            else:
                self._unpack_all(places)
            return images
        for time_out, time_in in _runs(times):
            for view_out, view_in in _runs(views):
                images[time_out, view_out] = read_all(self.path, self.dataset, (time_in, view_in))
        return images

    def _unpack_all(self, places: Sequence[tuple[int, int, NDArray[Any]]]) -> None:
        for time, view, image in places:
            try:
                skipped, packed = self.dataset.id.read_direct_chunk((time, view, *self._zeros))
                if skipped & self._packing_bit:  # packing did not help and was left out for this chunk
                    image[...] = self.dataset[time, view]
                    continue
                content = self._unpack_lzf(packed) if self._is_lzf else self._unpack_gzip(packed)
            except (OSError, RuntimeError, ValueError, igzip_lib.IsalError) as error:  # type: ignore[misc]
                raise damaged_data(self.path, self.dataset.name, error) from error
            if content is None:
                fault = (
                    f"{self.dataset.name!r} does not unpack to one image of {self.image_bytes} bytes at {time, view}"
                )
                raise refuse(self.path, "damaged_data", fault)
            flat = image.reshape(-1).view(np.uint8)
            if self._is_shuffled:  # first bytes of all values, then second ones, and so on
                import cv2

                size = image.dtype.itemsize
                cv2.merge(list(content.reshape(size, -1, 1)), flat.reshape(-1, 1, size))
            else:
                flat[...] = content

    def _unpack_gzip(self, packed: bytes) -> NDArray[np.uint8] | None:
        stream = isal_zlib.decompressobj()
        content = stream.decompress(packed, self.image_bytes + 1)
        is_whole = len(content) == self.image_bytes and stream.eof
        return np.frombuffer(content, np.uint8) if is_whole else None

    def _unpack_lzf(self, packed: bytes) -> NDArray[np.uint8] | None:
        from vpd_lightning.data.lzf_numba import SLACK, fletcher32, unpack_lzf

        num_packed = len(packed) - (_CHECKSUM_BYTES if self._has_checksum else 0)
        source = np.empty(max(0, num_packed) + SLACK, np.uint8)
        source[: len(packed)] = np.frombuffer(packed, np.uint8)
        if self._has_checksum:
            stored = int.from_bytes(packed[-_CHECKSUM_BYTES:], "little")
            found = fletcher32(source, max(0, num_packed))
            if any((a - b) % 65_535 for a, b in ((stored >> 16, found >> 16), (stored & 0xFFFF, found & 0xFFFF))):
                raise ValueError("its checksum differs")
        target = np.empty(self.image_bytes + SLACK, np.uint8)
        is_whole = unpack_lzf(source, num_packed, target, self.image_bytes) == self.image_bytes
        return target[: self.image_bytes] if is_whole else None

    def _refuse_swollen_chunks(self) -> None:
        """Refuse packed chunks that are larger than unpacked ones: HDF5 could unpack them to a thousand times that."""
        limit = int(np.prod(self.dataset.chunks)) * self.dataset.dtype.itemsize * 1.01 + 1024
        sizes: list[int] = []
        self.dataset.id.chunk_iter(lambda info: sizes.append(info.size))
        if max(sizes, default=0) > limit:
            fault = f"{self.dataset.name!r} has chunks of {max(sizes)} bytes, more than unpacked"
            raise refuse(self.path, "compression_bomb", fault)


def _num_threads() -> int:
    """As many as PyTorch uses (one in a loader's worker); without PyTorch as many as there are cores."""
    torch = sys.modules.get("torch")
    return int(torch.get_num_threads()) if torch is not None else len(os.sched_getaffinity(0))


@functools.lru_cache(maxsize=1)
def _pool(process: int, num_threads: int) -> ThreadPoolExecutor:
    """Return the threads of one process: those of its parent do not survive a fork."""
    return ThreadPoolExecutor(num_threads, thread_name_prefix="unpack")


def _runs(indices: NDArray[np.int64]) -> list[tuple[slice, slice]]:
    """Split indices into rising runs: pairs (where in the result, where in the file), so that HDF5 reads slices."""
    if not len(indices):
        return []
    starts = np.flatnonzero(np.diff(indices, prepend=indices[0] - 2) != 1)
    ends = np.append(starts[1:], len(indices))
    return [
        (slice(int(a), int(b)), slice(int(indices[a]), int(indices[b - 1]) + 1))
        for a, b in zip(starts, ends, strict=True)
    ]
