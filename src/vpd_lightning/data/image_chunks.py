"""Reading images: one chunk per image on several threads, as our files have them, or any other layout."""

import functools
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from vpd_lightning.data.hdf5_checks import read_all
from vpd_lightning.data.stored_chunks import StoredChunks

_BYTES_PER_THREAD = 2**19  # less is not worth a second thread


class ImageChunks:
    """One checked data set with axes ``time view height width ...``.

    Raises:
        DataError: chunks of an impossible size (when made), or bytes that do not unpack to exactly one chunk.
    """

    def __init__(self, path: Path, dataset: h5py.Dataset) -> None:
        self.path, self.dataset = path, dataset
        self.image_shape = dataset.shape[2:]
        self.image_bytes = int(np.prod(self.image_shape)) * dataset.dtype.itemsize
        self.chunks = StoredChunks(path, dataset)
        self._zeros = (0,) * len(self.image_shape)

    def read(self, times: NDArray[np.int64], views: NDArray[np.int64]) -> NDArray[Any]:
        """Return the images (time, view, height, width, ...) as they are stored."""
        if self.chunks.is_packed and self.dataset.chunks != (1, 1, *self.image_shape):
            return self.chunks.read([times, views, *map(np.arange, self.image_shape)])
        images = np.empty((len(times), len(views), *self.image_shape), self.dataset.dtype)
        if self.chunks.is_packed:
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
            self.chunks.unpack((time, view, *self._zeros), image)


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
