"""Opening HDF5 files from strangers: everything is checked before a byte of data is read.

HDF5 can point at other files (external storage, virtual data sets, external and soft links), which a crafted data set
can use to read any file of the user; it can also ask for filters that load plug-ins, or for absurd sizes.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from vpd_lightning.errors import DataError

MAX_DATASET_BYTES = 64 * 2**30
MAX_CHUNK_BYTES = 256 * 2**20
MAX_ATTRIBUTE_BYTES = 64 * 2**10
MAX_LINKS = 64
_FILTER_LZF = 32000
_ALLOWED_FILTERS = {
    h5py.h5z.FILTER_DEFLATE: "gzip",
    h5py.h5z.FILTER_SHUFFLE: "shuffle",
    h5py.h5z.FILTER_FLETCHER32: "fletcher32",
    _FILTER_LZF: "lzf",
}
_WAY_OUT = "Write it again with `vpd-data generate`, or see docs/your_data.md for the format."


def refuse(path: Path, fault: str, way_out: str = _WAY_OUT) -> DataError:
    """Return (not raise) the error that names the file, its fault and what to do."""
    return DataError(f"{path}: {fault}.\n{way_out}")


def open_file(path: Path) -> h5py.File:
    """Open a file read-only after checking that every link in it stays inside the file.

    Raises:
        DataError: missing, not HDF5, truncated, or with external or soft links.
    """
    if not path.is_file():
        raise refuse(path, "there is no such file", "Check the path; `vpd-data inspect FOLDER` lists what is there.")
    try:
        # Files never change once complete, so no lock is needed (and read-only media offer none).
        file = h5py.File(path, "r", locking=False)
    except OSError as error:
        kind = "is not an HDF5 file" if not h5py.is_hdf5(path) else "is truncated or damaged"
        raise refuse(path, f"{kind} ({_brief(error)})", "Delete it and generate it again, or copy it again.") from error
    try:
        check_links(path, file)
    except BaseException:
        file.close()
        raise
    return file


def check_links(path: Path, group: h5py.Group) -> None:
    """Refuse links that leave the file; only plain (hard) links to groups and data sets are allowed."""
    if len(group) > MAX_LINKS:
        raise refuse(path, f"{group.name} holds {len(group)} entries, more than the allowed {MAX_LINKS}")
    for name in group:
        link = group.get(name, getlink=True)
        if not isinstance(link, h5py.HardLink):
            kind = "external" if isinstance(link, h5py.ExternalLink) else "soft"
            raise refuse(path, f"{name!r} is a {kind} link; links to other places are not allowed")


def checked_dataset(
    path: Path, group: h5py.Group, name: str, *, dtypes: Sequence[Any], num_axes: Sequence[int]
) -> h5py.Dataset:
    """Return one data set after checking storage, filters, dtype, number of axes and size; reads no data."""
    if name not in group:
        raise refuse(path, f"has no data set {name!r}")
    dataset = group[name]
    if not isinstance(dataset, h5py.Dataset):
        raise refuse(path, f"{name!r} is a {type(dataset).__name__.lower()}, not a data set")
    creation = dataset.id.get_create_plist()
    if creation.get_external_count():
        raise refuse(path, f"{name!r} uses external storage (another file); that is not allowed")
    if creation.get_layout() == h5py.h5d.VIRTUAL:
        raise refuse(path, f"{name!r} is a virtual data set (other files); that is not allowed")
    for index in range(creation.get_nfilters()):
        code = creation.get_filter(index)[0]
        if code not in _ALLOWED_FILTERS:
            allowed = ", ".join(_ALLOWED_FILTERS.values())
            raise refuse(path, f"{name!r} uses the unknown filter {code}; allowed: {allowed}")
    if all(dataset.dtype != np.dtype(dtype) for dtype in dtypes):
        allowed = " or ".join(str(np.dtype(dtype)) for dtype in dtypes)
        raise refuse(path, f"{name!r} has dtype {dataset.dtype}; it must be {allowed}")
    if dataset.ndim not in num_axes or 0 in dataset.shape:
        raise refuse(path, f"{name!r} has shape {dataset.shape}; it must have {_either(num_axes)} non-empty axes")
    if dataset.nbytes > MAX_DATASET_BYTES:
        raise refuse(path, f"{name!r} unpacks to {dataset.nbytes} bytes, more than the allowed {MAX_DATASET_BYTES}")
    if dataset.chunks is not None:
        chunk_bytes = int(np.prod(dataset.chunks, dtype=object)) * dataset.dtype.itemsize
        if chunk_bytes > MAX_CHUNK_BYTES:
            raise refuse(path, f"{name!r} has chunks of {chunk_bytes} bytes, more than the allowed {MAX_CHUNK_BYTES}")
    return dataset


def checked_attribute(path: Path, owner: h5py.Group | h5py.Dataset, name: str, kind: str, length: int = 0) -> Any:
    """Return an attribute as ``float``, ``int``, ``str`` or (``length`` > 0) a tuple of floats; refuse anything else.

    ``kind`` is ``"number"``, ``"integer"`` or ``"text"``.
    """
    if name not in owner.attrs:
        raise refuse(path, f"has no attribute {name!r}")
    identifier = owner.attrs.get_id(name)
    if identifier.get_storage_size() > MAX_ATTRIBUTE_BYTES:
        raise refuse(path, f"attribute {name!r} is larger than the allowed {MAX_ATTRIBUTE_BYTES} bytes")
    dtype, shape = identifier.dtype, identifier.shape
    if kind == "text":
        if h5py.check_string_dtype(dtype) is None or shape != ():
            raise refuse(path, f"attribute {name!r} is {dtype} {shape}; it must be one text")
        value = owner.attrs[name]
        return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
    if dtype.kind not in ("iu" if kind == "integer" else "iuf") or shape != ((length,) if length else ()):
        wanted = f"{length} numbers" if length else f"one {kind}"
        raise refuse(path, f"attribute {name!r} is {dtype} {shape}; it must be {wanted}")
    value = np.asarray(owner.attrs[name])
    if not np.isfinite(value).all():
        raise refuse(path, f"attribute {name!r} is not finite ({value})")
    if length:
        return tuple(float(item) for item in value)
    return int(value) if kind == "integer" else float(value)


def read_all(path: Path, dataset: h5py.Dataset, selection: Any = ()) -> np.ndarray:
    """Read a checked data set (or a part); a checksum that fails becomes a ``DataError`` naming the file."""
    try:
        return np.asarray(dataset[selection])
    except (OSError, RuntimeError, ValueError) as error:
        name = dataset.name
        raise refuse(
            path,
            f"{name!r} cannot be read, its bytes are damaged ({_brief(error)})",
            "Delete the file and generate it again, or copy it again; `vpd-data validate FOLDER` finds all such files.",
        ) from error


def _brief(error: BaseException) -> str:
    return " ".join(str(error).split())[:160]


def _either(numbers: Sequence[int]) -> str:
    return " or ".join(map(str, numbers))
