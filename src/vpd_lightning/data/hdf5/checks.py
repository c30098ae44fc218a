"""Opening HDF5 files from strangers: everything is checked before a byte of data is read.

HDF5 can point at other files (external storage, virtual data sets, external and soft links), which a crafted data set
can use to read any file of the user; it can also ask for filters that load plug-ins, for absurd sizes, or unpack a few
kilobytes to many gigabytes.
"""

import errno
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from vpd_lightning.data.busy import busy_error
from vpd_lightning.data.hdf5.broken_file import BrokenFileError, brief, refuse
from vpd_lightning.data.hdf5.text_heaps import global_heaps_valid
from vpd_lightning.data.schema import VIEW_NAMES
from vpd_lightning.errors import DataError

MAX_DATASET_BYTES = 64 * 2**30
MAX_CHUNK_BYTES = 256 * 2**20
MAX_ATTRIBUTE_BYTES = 64 * 2**10
MAX_LINKS = 64
_MAX_NAME = 80  # characters shown of a view's name
# Pictures of one colour shrink a thousandfold too; that is allowed up to what any machine can hold.
MAX_RATIO, MAX_BYTES_AT_ANY_RATIO = 300, 256 * 2**20
_MAX_DEPTH = 4  # of groups in groups
FILTER_LZF = 32000
# In the order in which a writer may apply them, each at most once; gzip and lzf exclude each other.
_ALLOWED_FILTERS = {
    h5py.h5z.FILTER_SHUFFLE: ("shuffle", 0),
    h5py.h5z.FILTER_DEFLATE: ("gzip", 1),
    FILTER_LZF: ("lzf", 1),
    h5py.h5z.FILTER_FLETCHER32: ("fletcher32", 2),
}
_COPY_AGAIN = "Delete it and generate it again, or copy it again."
# What h5py raises for damaged metadata, whatever the damage.
_DAMAGE = (
    OSError,
    RuntimeError,
    ValueError,
    KeyError,
    TypeError,
    IndexError,
    AttributeError,
    ArithmeticError,
    MemoryError,
)
# What is wrong with rights, disks and limits, and not with the file.
_OF_THE_SYSTEM = (errno.EACCES, errno.EPERM, errno.EMFILE, errno.ENFILE, errno.EIO, errno.ESTALE)


@contextmanager
def named_damage(path: Path) -> Iterator[None]:
    """Turn whatever h5py raises about damaged metadata into a ``DataError`` that names the file."""
    try:
        yield
    except DataError:
        raise
    except _DAMAGE as error:
        damaged = refuse(path, "damaged_file", f"is damaged ({brief(error)})", _COPY_AGAIN)
        raise _not_its_fault(path, error) or damaged from error


def _not_its_fault(path: Path, error: BaseException) -> BrokenFileError | None:
    """Return the error where the system, or another program, kept us from reading: a file to keep, not to delete."""
    number = getattr(error, "errno", None)
    busy = busy_error(path, error)
    if busy is not None or number not in _OF_THE_SYSTEM:
        return busy
    return refuse(
        path,
        "unreadable",
        f"cannot be read: {os.strerror(number)} ({brief(error)})",
        "The file itself may be intact. Fix the error that the system reports, then try again.",
    )


def open_file(path: Path) -> h5py.File:
    """Open a file read-only after checking that every link in it stays inside the file.

    Raises:
        DataError: missing, busy, not HDF5, truncated, damaged, or with anything but a plain tree of groups and data
            sets.
    """
    if not path.is_file():
        way_out = "Check the path; `vpd-data inspect FOLDER` lists what is there."
        raise refuse(path, "missing_file", "there is no such file", way_out)
    try:
        # Files never change once complete, so no lock is needed (and read-only media offer none).
        file = h5py.File(path, "r", locking=False)
    except _DAMAGE as error:
        if (kept := _not_its_fault(path, error)) is not None:
            raise kept from error
        is_hdf5 = _is_hdf5(path)
        kind, fault = ("damaged_file", "is truncated or damaged") if is_hdf5 else ("not_hdf5", "is not an HDF5 file")
        raise refuse(path, kind, f"{fault} ({brief(error)})", _COPY_AGAIN) from error
    try:
        with named_damage(path):
            if file.userblock_size:
                raise refuse(path, "user_block", f"starts with {file.userblock_size} bytes that are not HDF5")
            if not global_heaps_valid(path):
                raise refuse(path, "damaged_file", "is damaged (in its string storage)", _COPY_AGAIN)
            check_links(path, file)
    except BaseException:
        file.close()
        raise
    return file


def check_links(path: Path, group: h5py.Group) -> None:
    """Refuse everything but a small tree of plain (hard) links to groups and data sets."""
    _check_tree(path, group, {_address(group)}, 0)


def _check_tree(path: Path, group: h5py.Group, seen: set[int], depth: int) -> None:
    if len(group) > MAX_LINKS:
        fault = f"{group.name} holds {len(group)} entries, more than the allowed {MAX_LINKS}"
        raise refuse(path, "too_many_entries", fault)
    for name in group:
        link = group.get(name, getlink=True)
        if not isinstance(link, h5py.HardLink):
            kind = "external" if isinstance(link, h5py.ExternalLink) else "soft"
            fault = f"{name!r} is a {kind} link; links to other places are not allowed"
            raise refuse(path, f"{kind}_link", fault)
        member = group[name]
        if isinstance(member, h5py.Datatype):
            raise refuse(path, "named_type", f"{name!r} is a named datatype; only groups and data sets are allowed")
        if isinstance(member, h5py.Group):
            if _address(member) in seen or depth >= _MAX_DEPTH:
                raise refuse(path, "cyclic_groups", f"{name!r} is a group that is linked twice or nested too deep")
            seen.add(_address(member))
            _check_tree(path, member, seen, depth + 1)


def checked_dataset(
    path: Path, group: h5py.Group, name: str, *, dtypes: Sequence[Any], num_axes: Sequence[int]
) -> h5py.Dataset:
    """Return one data set after checking storage, filters, dtype, number of axes and size; reads no data."""
    if name not in group:
        raise refuse(path, "missing_data_set", f"has no data set {name!r}")
    dataset = group[name]
    if not isinstance(dataset, h5py.Dataset):
        raise refuse(path, "not_a_data_set", f"{name!r} is a {type(dataset).__name__.lower()}, not a data set")
    _check_storage(path, name, dataset)
    stored_type = dataset.id.get_type()
    if not any(stored_type.equal(h5py.h5t.py_create(np.dtype(dtype))) for dtype in dtypes):
        allowed = " or ".join(str(np.dtype(dtype)) for dtype in dtypes)
        given = getattr(dataset, "dtype", "unknown")
        given = f"{given} (a user-defined type)" if str(given) in allowed else given
        raise refuse(path, "wrong_dtype", f"{name!r} has dtype {given}; it must be {allowed}")
    if stored_type.committed():
        raise refuse(path, "named_type", f"{name!r} uses a named datatype; that is not allowed")
    if dataset.ndim not in num_axes or 0 in dataset.shape:
        fault = f"{name!r} has shape {dataset.shape}; it must have {_either(num_axes)} non-empty axes"
        raise refuse(path, "wrong_shape", fault)
    _check_size(path, name, dataset)
    return dataset


def _check_storage(path: Path, name: str, dataset: h5py.Dataset) -> None:
    creation = dataset.id.get_create_plist()
    if creation.get_external_count():
        raise refuse(path, "external_storage", f"{name!r} uses external storage (another file); that is not allowed")
    if creation.get_layout() == h5py.h5d.VIRTUAL:
        raise refuse(path, "virtual_data_set", f"{name!r} is a virtual data set (other files); that is not allowed")
    last = -1
    for index in range(creation.get_nfilters()):
        code, _, values = creation.get_filter(index)[:3]
        if code not in _ALLOWED_FILTERS:
            allowed = ", ".join(title for title, _ in _ALLOWED_FILTERS.values())
            raise refuse(path, "unknown_filter", f"{name!r} uses the unknown filter {code}; allowed: {allowed}")
        title, order = _ALLOWED_FILTERS[code]
        if order <= last:
            raise refuse(path, "repeated_filter", f"{name!r} uses {title} twice or out of order; that is not allowed")
        last = order
        if code == FILTER_LZF:
            # The size of a chunk, by which lzf enlarges its memory until the data fit: 0 would never end.
            expected = int(np.prod(creation.get_chunk(), dtype=object)) * dataset.id.get_type().get_size()
            if len(values) < 3 or values[2] != expected:
                raise refuse(path, "filter_options", f"{name!r} has lzf options {values} that do not match its chunks")


def _check_size(path: Path, name: str, dataset: h5py.Dataset) -> None:
    num_bytes = int(np.prod(dataset.shape, dtype=object)) * dataset.dtype.itemsize
    if num_bytes > MAX_DATASET_BYTES:
        fault = f"{name!r} unpacks to {num_bytes} bytes, more than the allowed {MAX_DATASET_BYTES}"
        raise refuse(path, "absurd_size", fault)
    if dataset.chunks is not None:
        chunk_bytes = int(np.prod(dataset.chunks, dtype=object)) * dataset.dtype.itemsize
        if chunk_bytes > MAX_CHUNK_BYTES:
            fault = f"{name!r} has chunks of {chunk_bytes} bytes, more than the allowed {MAX_CHUNK_BYTES}"
            raise refuse(path, "huge_chunk", fault)
    file_bytes = path.stat().st_size
    if num_bytes > MAX_BYTES_AT_ANY_RATIO and num_bytes > MAX_RATIO * file_bytes:
        fault = (
            f"{name!r} unpacks to {num_bytes} bytes from a file of {file_bytes}; that is a compression bomb or empty"
        )
        raise refuse(path, "compression_bomb", fault)
    if dataset.id.get_space_status() != h5py.h5d.SPACE_STATUS_ALLOCATED:
        raise refuse(path, "missing_data", f"{name!r} holds no data for some of its {dataset.shape} values")
    # Packed data that are larger than unpacked are a bomb as well: a filter unpacks what it finds, whatever its size.
    if dataset.id.get_storage_size() > 1.25 * num_bytes + 2**16:
        raise refuse(path, "compression_bomb", f"{name!r} takes more space in the file than its {num_bytes} bytes")


def checked_attribute(path: Path, owner: h5py.Group | h5py.Dataset, name: str, kind: str, length: int = 0) -> Any:
    """Return an attribute as ``float``, ``int``, ``str`` or (``length`` > 0) a tuple of floats; refuse anything else.

    ``kind`` is ``"number"``, ``"integer"`` or ``"text"``.
    """
    if name not in owner.attrs:
        raise refuse(path, "missing_attribute", f"has no attribute {name!r}")
    identifier = owner.attrs.get_id(name)
    too_large = refuse(
        path, "huge_attribute", f"attribute {name!r} is larger than the allowed {MAX_ATTRIBUTE_BYTES} bytes"
    )
    if identifier.get_storage_size() > MAX_ATTRIBUTE_BYTES:
        raise too_large
    dtype, shape = identifier.dtype, identifier.shape
    if kind == "text":
        if h5py.check_string_dtype(dtype) is None or shape != ():
            raise refuse(path, "wrong_attribute", f"attribute {name!r} is {dtype} {shape}; it must be a single string")
        value = owner.attrs[name]
        if len(value) > MAX_ATTRIBUTE_BYTES:  # texts of any length count as 16 bytes above
            raise too_large
        return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
    if dtype.kind not in ("iu" if kind == "integer" else "iuf") or shape != ((length,) if length else ()):
        wanted = f"{length} numbers" if length else f"one {kind}"
        raise refuse(path, "wrong_attribute", f"attribute {name!r} is {dtype} {shape}; it must be {wanted}")
    value = np.asarray(owner.attrs[name])
    if not np.isfinite(value).all():
        raise refuse(path, "not_finite", f"attribute {name!r} is not finite ({value})")
    if length:
        return tuple(float(item) for item in value)
    return int(value) if kind == "integer" else float(value)


def checked_view_names(path: Path, file: h5py.File, num_views: int) -> tuple[str, ...]:
    """Return the names of the views, a JSON list in an attribute; empty where the file has none."""
    if VIEW_NAMES not in file.attrs:
        return ()
    text = checked_attribute(path, file, VIEW_NAMES, "text")
    try:
        names = json.loads(text)
    except (ValueError, RecursionError):
        names = None
    if not isinstance(names, list) or len(names) != num_views or not all(isinstance(name, str) for name in names):
        raise refuse(path, "wrong_attribute", f"attribute {VIEW_NAMES!r} is no JSON list of {num_views} names")
    return tuple(" ".join(name.split())[:_MAX_NAME] for name in names)


def read_all(path: Path, dataset: h5py.Dataset, selection: Any = ()) -> np.ndarray:
    """Read a checked data set (or a part); a checksum that fails becomes a ``DataError`` naming the file."""
    try:
        return np.asarray(dataset[selection])
    except _DAMAGE as error:
        raise damaged_data(path, dataset.name, error) from error


def damaged_data(path: Path, name: str | None, error: BaseException) -> BrokenFileError:
    """Return the error for bytes that do not unpack, or whose checksum differs."""
    return _not_its_fault(path, error) or refuse(
        path,
        "damaged_data",
        f"{name!r} cannot be read, its bytes are damaged ({brief(error)})",
        "Delete the file and generate it again, or copy it again; `vpd-data validate FOLDER` finds all such files.",
    )


def _is_hdf5(path: Path) -> bool:
    try:
        return bool(h5py.is_hdf5(path))
    except _DAMAGE:
        return False


def _address(group: h5py.Group) -> int:
    return int(h5py.h5o.get_info(group.id).addr)


def _either(numbers: Sequence[int]) -> str:
    return " or ".join(map(str, numbers))
