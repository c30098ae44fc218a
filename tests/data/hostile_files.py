"""Ways to break a good trajectory file of 6 frames and 3 views of 16x16, by what the reader must call the fault."""

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

Harm = Callable[[h5py.File], object]
SHAPE = (6, 3, 16, 16)


def write_again(file: h5py.File, name: str, data: np.ndarray, **options: Any) -> None:
    attributes = dict(file[name].attrs)
    del file[name]
    file.create_dataset(name, data=data, **options)
    for key, value in attributes.items():
        file[name].attrs[key] = value


def external_storage(file: h5py.File) -> None:
    del file["rgb"]
    file.create_dataset("rgb", (*SHAPE, 3), np.uint8, external=[("/etc/hostname", 0, int(np.prod(SHAPE)) * 3)])


def virtual_storage(file: h5py.File) -> None:
    layout = h5py.VirtualLayout(SHAPE, np.float32)
    layout[:] = h5py.VirtualSource("other.h5", "depth", SHAPE)
    del file["depth"]
    file.create_virtual_dataset("depth", layout)


def linked(link: Any) -> Harm:
    def apply(file: h5py.File) -> None:
        del file["rgb"]
        file["rgb"] = link

    return apply


def deep_groups(file: h5py.File) -> None:
    group = file
    for _ in range(40):
        group = group.create_group("deeper")


def empty_of(shape: tuple[int, ...], chunks: tuple[int, ...] | None = None, name: str = "rgb") -> Harm:
    def apply(file: h5py.File) -> None:
        dtype = file[name].dtype
        del file[name]
        file.create_dataset(name, shape, dtype, chunks=chunks)

    return apply


def one_image_missing(file: h5py.File) -> None:
    depth = file["depth"][...]
    del file["depth"]
    dataset = file.create_dataset("depth", SHAPE, np.float32, chunks=(1, 1, 16, 16))
    for time, view in np.ndindex(SHAPE[0], SHAPE[1] - 1):
        dataset[time, view] = depth[time, view]


def zeros_packed(num_bytes: int) -> bytes:
    packer = zlib.compressobj(9)
    block = bytes(2**20)
    parts = [packer.compress(block) for _ in range(num_bytes // 2**20)]
    return b"".join([*parts, packer.compress(bytes(num_bytes % 2**20)), packer.flush()])


def bomb_of_many_chunks(file: h5py.File) -> None:
    """1 GiB of pictures in a file of about 1 MB: every chunk is one megabyte of zeros."""
    del file["rgb"]
    shape = (64, 16, 512, 683, 3)
    dataset = file.create_dataset("rgb", shape, np.uint8, chunks=(1, 1, *shape[2:]), compression="gzip")
    packed = zeros_packed(int(np.prod(shape[2:])))
    for time, view in np.ndindex(*shape[:2]):
        dataset.id.write_direct_chunk((time, view, 0, 0, 0), packed)


def bomb_in_one_chunk(file: h5py.File) -> None:
    """The chunk of one small picture unpacks to 64 MiB."""
    rgb = file["rgb"][...]
    write_again(file, "rgb", rgb, chunks=(1, 1, 16, 16, 3), compression="gzip")
    file["rgb"].id.write_direct_chunk((0, 0, 0, 0, 0), zeros_packed(2**26))


def bomb_in_a_large_chunk(file: h5py.File) -> None:
    """The same where chunks hold several pictures."""
    rgb = file["rgb"][...]
    write_again(file, "rgb", rgb, chunks=(2, 3, 16, 16, 3), compression="gzip")
    file["rgb"].id.write_direct_chunk((0, 0, 0, 0, 0), zeros_packed(2**26))


def short_image(file: h5py.File) -> None:
    rgb = file["rgb"][...]
    write_again(file, "rgb", rgb, chunks=(1, 1, 16, 16, 3), compression="gzip")
    file["rgb"].id.write_direct_chunk((0, 0, 0, 0, 0), zlib.compress(bytes(100)))


def two_compressions(file: h5py.File) -> None:
    rgb = file["rgb"][...]
    del file["rgb"]
    creation = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    creation.set_chunk((1, 1, 16, 16, 3))
    creation.set_deflate(9)
    creation.set_deflate(9)
    space = h5py.h5s.create_simple(rgb.shape)
    h5py.h5d.create(file.id, b"rgb", h5py.h5t.NATIVE_UINT8, space, creation).write(space, space, rgb)


def values(name: str, change: Callable[[np.ndarray], None]) -> Harm:
    def apply(file: h5py.File) -> None:
        data = file[name][...]
        change(data)
        write_again(file, name, data)

    return apply


def attribute(name: str, value: Any) -> Harm:
    def apply(file: h5py.File) -> None:
        file.attrs[name] = value

    return apply


def depth_scale(value: float | None) -> Harm:
    def apply(file: h5py.File) -> None:
        write_again(file, "depth", np.ones(SHAPE, np.uint16))
        file["depth"].attrs["offset"] = 0.0
        if value is not None:
            file["depth"].attrs["scale"] = value

    return apply


def named_type(file: h5py.File) -> None:
    depth = file["depth"][...]
    del file["depth"]
    file["kind"] = np.dtype("<f4")
    file.create_dataset("depth", data=depth, dtype=file["kind"])
    del file["kind"]


def odd_float(file: h5py.File) -> None:
    """32 bits with an exponent that no machine has; HDF5 would convert every value."""
    del file["depth"]
    kind = h5py.h5t.IEEE_F32LE.copy()
    kind.set_ebias(100)
    space = h5py.h5s.create_simple(SHAPE)
    h5py.h5d.create(file.id, b"depth", kind, space).write(space, space, np.ones(SHAPE, np.float32))


def as_dtype(name: str, dtype: Any) -> Harm:
    return lambda file: write_again(file, name, file[name][...].astype(dtype))


def transpose(poses: np.ndarray) -> None:
    poses[:] = np.swapaxes(poses, 1, 2).copy()


def assign(index: Any, value: float) -> Callable[[np.ndarray], None]:
    return lambda array: array.__setitem__(index, value)


def multiply(index: Any, factor: float) -> Callable[[np.ndarray], None]:
    return lambda array: array.__setitem__(index, array[index] * factor)


EVERY = slice(None)
ROTATION = (EVERY, slice(0, 3), slice(0, 3))
DEEP = "depth"

HARMS: dict[str, tuple[Harm, str]] = {
    # other files
    "external storage": (external_storage, "external_storage"),
    "virtual data set": (virtual_storage, "virtual_data_set"),
    "external link": (linked(h5py.ExternalLink("other.h5", "/rgb")), "external_link"),
    "soft link": (linked(h5py.SoftLink("/depth")), "soft_link"),
    "dangling link": (linked(h5py.SoftLink("/nowhere")), "soft_link"),
    "soft link beside the data": (lambda f: f.__setitem__("shortcut", h5py.SoftLink("/rgb")), "soft_link"),
    "soft link in a group": (lambda f: f.create_group("state").__setitem__("x", h5py.SoftLink("/rgb")), "soft_link"),
    # a tree that is none
    "root inside root": (lambda f: f.__setitem__("loop", f["/"]), "cyclic_groups"),
    "group inside itself": (lambda f: f.create_group("state").__setitem__("loop", f["state"]), "cyclic_groups"),
    "forty groups deep": (deep_groups, "cyclic_groups"),
    "a thousand entries": (lambda f: [f.create_group(f"g{i}") for i in range(1000)], "too_many_entries"),
    "group for data set": (lambda f: (f.pop("rgb"), f.create_group("rgb")), "not_a_data_set"),
    "datatype for data set": (lambda f: (f.pop("rgb"), f.__setitem__("rgb", np.dtype("u1"))), "named_type"),
    "no rgb": (lambda f: f.pop("rgb"), "missing_data_set"),
    "no cameras": (lambda f: f.pop("cam_to_world"), "missing_data_set"),
    # sizes
    "a trillion pixels, none stored": (empty_of((10**6, 1000, 32, 32, 3), (1, 1, 32, 32, 3)), "absurd_size"),
    "2^62 pixels": (empty_of((2**31, 2**31, 1, 1), (1, 1, 1, 1), DEEP), "absurd_size"),
    "a gigabyte, none stored": (empty_of((1024, 1, 512, 512, 4), (1, 1, 512, 512, 4)), "compression_bomb"),
    "huge chunk": (empty_of((60, 3, 1024, 1024, 3), (40, 3, 1024, 1024, 3)), "huge_chunk"),
    "nothing stored": (empty_of((*SHAPE, 3)), "missing_data"),
    "one image not stored": (one_image_missing, "missing_data"),
    "a million views": (empty_of((1, 10**6, 1, 1, 3), (1, 10**6, 1, 1, 3)), "missing_data"),
    "compression bomb of many chunks": (bomb_of_many_chunks, "compression_bomb"),
    "compression bomb in one chunk": (bomb_in_one_chunk, "damaged_data"),
    "compression bomb in a large chunk": (bomb_in_a_large_chunk, "damaged_data"),
    "image that is too short": (short_image, "damaged_data"),
    "compressed twice": (two_compressions, "repeated_filter"),
    "unknown filter": (
        lambda f: write_again(f, "depth", f["depth"][...], scaleoffset=3, chunks=True),
        "unknown_filter",
    ),
    # types and shapes
    "float16 depth": (as_dtype("depth", np.float16), "wrong_dtype"),
    "float64 depth": (as_dtype("depth", np.float64), "wrong_dtype"),
    "big-endian depth": (as_dtype("depth", ">f4"), "wrong_dtype"),
    "odd float depth": (odd_float, "wrong_dtype"),
    "float64 rgb": (as_dtype("rgb", np.float64), "wrong_dtype"),
    "bool rgb": (as_dtype("rgb", bool), "wrong_dtype"),
    "float32 poses": (as_dtype("cam_to_world", np.float32), "wrong_dtype"),
    "compound rgb": (lambda f: write_again(f, "rgb", np.zeros((*SHAPE, 3), [("r", "u1"), ("g", "u1")])), "wrong_dtype"),
    "texts for rgb": (
        lambda f: write_again(f, "rgb", np.full((1, 1, 1, 1, 3), "x", object), dtype=h5py.string_dtype()),
        "wrong_dtype",
    ),
    "references for depth": (
        lambda f: write_again(f, "depth", np.full((1, 1, 1, 1), f.ref, object), dtype=h5py.ref_dtype),
        "wrong_dtype",
    ),
    "named datatype": (named_type, "named_type"),
    "four channels": (lambda f: write_again(f, "rgb", np.zeros((*SHAPE, 4), np.uint8)), "wrong_shape"),
    "depth of other size": (lambda f: write_again(f, "depth", np.ones((6, 3, 8, 8), np.float32)), "wrong_shape"),
    "rgb with four axes": (lambda f: write_again(f, "rgb", np.zeros(SHAPE, np.uint8)), "wrong_shape"),
    "scalar rgb": (lambda f: write_again(f, "rgb", np.zeros((), np.uint8)), "wrong_shape"),
    "no frames": (lambda f: write_again(f, "rgb", np.zeros((0, 3, 16, 16, 3), np.uint8)), "wrong_shape"),
    "poses of other views": (lambda f: write_again(f, "cam_to_world", np.tile(np.eye(4), (7, 1, 1))), "wrong_shape"),
    # cameras
    "left-handed poses": (values("cam_to_world", multiply((EVERY, slice(0, 3), 0), -1)), "left_handed_pose"),
    "scaled poses": (values("cam_to_world", multiply(ROTATION, 1.01)), "not_orthonormal_pose"),
    "zero poses": (values("cam_to_world", multiply(ROTATION, 0)), "not_orthonormal_pose"),
    "sheared poses": (values("cam_to_world", assign((EVERY, 0, 1), 0.1)), "not_orthonormal_pose"),
    "transposed poses": (values("cam_to_world", transpose), "transposed_pose"),
    "nan poses": (values("cam_to_world", assign((0, 0, 0), np.nan)), "not_finite"),
    "infinitely far camera": (values("cam_to_world", assign((0, 0, 3), np.inf)), "not_finite"),
    "nan intrinsics": (values("intrinsics", assign((0, 0, 0), np.nan)), "not_finite"),
    "negative focal length": (values("intrinsics", multiply((EVERY, 0, 0), -1)), "focal_length"),
    "zero focal length": (values("intrinsics", assign((EVERY, 1, 1), 0)), "focal_length"),
    "normalised intrinsics": (values("intrinsics", multiply((EVERY, slice(0, 2)), 1 / 512)), "focal_length"),
    "far principal point": (values("intrinsics", assign((EVERY, 0, 2), 1000)), "principal_point"),
    "intrinsics no matrix": (values("intrinsics", assign((EVERY, 1, 0), 1)), "intrinsics_matrix"),
    # depth
    "negative depth": (values("depth", assign((0, 0, 3, 4), -1)), "negative_depth"),
    "uint16 depth without scale": (depth_scale(None), "missing_attribute"),
    "uint16 depth with nan scale": (depth_scale(np.nan), "not_finite"),
    "uint16 depth with negative scale": (depth_scale(-1.0), "depth_scale"),
    # attributes
    "schema from the future": (attribute("schema_version", 99), "schema_version"),
    "schema version a text": (attribute("schema_version", "1"), "wrong_attribute"),
    "no schema version": (lambda f: f.attrs.pop("schema_version"), "missing_attribute"),
    "no far": (lambda f: f.attrs.pop("far"), "missing_attribute"),
    "distance for depth": (attribute("depth_type", "distance"), "depth_type"),
    "number for depth type": (attribute("depth_type", 3), "wrong_attribute"),
    "near behind far": (attribute("near", 9.0), "near_far"),
    "no time between frames": (attribute("frame_time", 0.0), "frame_time"),
    "text for a number": (attribute("far", "five"), "wrong_attribute"),
    "far nan": (attribute("far", np.nan), "not_finite"),
    "empty workspace": (attribute("workspace_max", np.array([-2.0, 1, 1])), "workspace"),
    "view names that are no JSON": (attribute("view_names", "left, right"), "wrong_attribute"),
    "one view name too few": (attribute("view_names", '["left"]'), "wrong_attribute"),
    "a number for a view name": (attribute("view_names", '["left", 3]'), "wrong_attribute"),
    "flat workspace": (attribute("workspace_max", 1.0), "wrong_attribute"),
    "infinite workspace": (attribute("workspace_max", np.array([np.inf, 1, 1])), "not_finite"),
    "workspace of light years": (attribute("workspace_max", np.array([1e16, 1, 1])), "workspace"),
    "huge text": (attribute("scene_hash", "x" * 2**21), "huge_attribute"),
    "huge array": (lambda f: f.attrs.create("workspace_min", np.zeros(2**20)), "huge_attribute"),
}


def cut(content: bytearray) -> None:
    del content[-2000:]


def cut_to_header(content: bytearray) -> None:
    del content[100:]


def replace_all(new: bytes) -> Callable[[bytearray], None]:
    def apply(content: bytearray) -> None:
        content[:] = new

    return apply


def user_block(content: bytearray) -> None:
    content[:0] = b"#!/bin/sh\n" + bytes(502)


def break_heap(content: bytearray) -> None:
    """Where HDF5 keeps texts: the free space now starts with an object of no size."""
    start = content.find(b"GCOL\x01")
    position = start + 16
    while content[position] or content[position + 1]:
        position += 16 + (int.from_bytes(content[position + 8 : position + 16], "little") + 7) // 8 * 8
    content[position + 8 : position + 16] = bytes(8)


def flip(offset: int) -> Callable[[bytearray], None]:
    def apply(content: bytearray) -> None:
        content[offset] ^= 0x10

    return apply


BYTE_HARMS: dict[str, tuple[Callable[[bytearray], None], str]] = {
    "truncated": (cut, "damaged_file"),
    "only a header": (cut_to_header, "damaged_file"),
    "empty file": (replace_all(b""), "not_hdf5"),
    "text file": (replace_all(b"hello"), "not_hdf5"),
    "zip file": (replace_all(b"PK\x03\x04" + bytes(1000)), "not_hdf5"),
    "signature only": (replace_all(b"\x89HDF\r\n\x1a\n"), "damaged_file"),
    "user block": (user_block, "user_block"),
    "flipped bit in the signature": (flip(1), "not_hdf5"),
    "broken heap of texts": (break_heap, "damaged_file"),
    "flipped bit in the superblock": (flip(20), "damaged_file"),
}


def flip_in(path: Path, name: str, place: str) -> None:
    """Flip one bit of a data set's ``header``, or of the ``data`` of one of its chunks."""
    with h5py.File(path) as file:
        if place == "header":
            offset = h5py.h5o.get_info(file[name].id).addr + 20
        else:
            chunk = file[name].id.get_chunk_info(4)
            offset = chunk.byte_offset + chunk.size // 2
    content = bytearray(path.read_bytes())
    content[offset] ^= 0x10
    path.write_bytes(content)
