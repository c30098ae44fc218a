"""Broken and hostile files: each is refused by name, with little work and memory, and none is read."""

import json
import os
import pickle
import resource
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from data_gen.inspection.validate import validate_dataset
from tests.data.hostile_files import BYTE_HARMS, HARMS, flip_in
from tests.data.recordings import make_trajectory, write_recordings
from tests.work import counted_calls
from vpd_lightning.data import busy
from vpd_lightning.data.ground_truth import has_state, read_state
from vpd_lightning.data.hdf5.broken_file import BrokenFileError
from vpd_lightning.data.hdf5.checks import checked_dataset
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.data.schema import COMPRESSIONS, write_trajectory
from vpd_lightning.errors import DataError

# Reading the sound file takes 5,000 calls; what a hostile file makes of that must not grow with the sizes it claims.
MAX_CALLS, MAX_MEGABYTES = 20_000, 64


@pytest.fixture(autouse=True)
def _no_other_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Looking who holds a file takes as many calls as this machine has open files; that is not what is counted."""
    monkeypatch.setattr(busy, "_programs", lambda path, *, writing: [])


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_trajectory(tmp_path / "good.h5", make_trajectory(5, num_frames=6, num_views=3))
    return tmp_path / "good.h5"


def refusal(path: Path) -> BrokenFileError:
    """Read everything; return what was said, after checking that it took little work and memory."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(BrokenFileError), TrajectoryReader(path) as reader:  # the calls that load modules do not count
        reader.rgb()
        reader.depth()
    with pytest.raises(BrokenFileError) as caught, counted_calls() as work, TrajectoryReader(path) as reader:
        reader.rgb()
        reader.depth()
    assert work.calls < MAX_CALLS
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak) / 1024 < MAX_MEGABYTES
    error = caught.value
    assert str(path) in str(error)
    assert 2 <= len(str(error).splitlines()) <= 3
    assert error.exit_code == 3
    return error


@pytest.mark.parametrize("harm", HARMS)
def test_harmed_file_is_refused_by_name(path: Path, harm: str):
    apply, kind = HARMS[harm]
    with h5py.File(path, "r+") as file:
        apply(file)

    assert refusal(path).kind == kind
    (fault,) = validate_dataset(path)
    assert (fault.name, fault.is_error) == (kind, True)


@pytest.mark.parametrize("harm", BYTE_HARMS)
def test_file_with_other_bytes_is_refused_by_name(path: Path, harm: str):
    apply, kind = BYTE_HARMS[harm]
    content = bytearray(path.read_bytes())
    apply(content)
    path.write_bytes(content)

    assert refusal(path).kind == kind


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("name", ["rgb", "depth"])
def test_flipped_bit_is_noticed(tmp_path: Path, name: str, compression: str):
    for place, kind in (("header", "damaged_file"), ("data", "damaged_data")):
        path = tmp_path / f"{place}.h5"
        write_trajectory(path, make_trajectory(5, num_frames=6, num_views=3), compression=compression)
        flip_in(path, name, place)

        assert refusal(path).kind == kind


@pytest.mark.parametrize("make", [Path.mkdir, os.mkfifo, lambda path: path.symlink_to("nowhere"), lambda path: None])
def test_what_is_no_file_is_not_opened(tmp_path: Path, make: Callable[[Path], Any]):
    make(tmp_path / "a.h5")

    assert refusal(tmp_path / "a.h5").kind == "missing_file"


@pytest.mark.parametrize("level", [0.0, np.nan, np.inf])
def test_file_without_any_depth_is_named_by_validation(tmp_path: Path, level: float):
    trajectory = make_trajectory(5)
    trajectory.depth[...] = level
    write_trajectory(tmp_path / "a.h5", trajectory)

    assert [fault.name for fault in validate_dataset(tmp_path / "a.h5")] == ["no_depth"]
    assert not TrajectoryReader(tmp_path / "a.h5").depth().any()


def test_three_hundred_random_flips_are_refused_or_harmless(path: Path):
    """One byte anywhere: either the same pictures come out, or a named error; never a crash or other pictures.

    Cameras have no checksum of their own (the manifest's SHA-256 covers them), so they are not compared.
    """
    content, good = path.read_bytes(), TrajectoryReader(path)
    rgb, depth = good.rgb(), good.depth()
    draw = np.random.default_rng(0)
    num_refused = 0
    for offset in draw.integers(0, len(content), size=300):
        harmed = bytearray(content)
        harmed[offset] ^= int(draw.integers(1, 256))
        path.write_bytes(harmed)
        try:
            with TrajectoryReader(path) as reader:
                np.testing.assert_array_equal(reader.rgb(), rgb)
                np.testing.assert_array_equal(reader.depth(), depth)
        except DataError:
            num_refused += 1
    assert num_refused > 30


def test_lzf_that_would_never_end_is_refused(tmp_path: Path):
    """HDF5's lzf enlarges its memory by its third option, the size of a chunk, until the data fit; here by nothing."""
    path = tmp_path / "a.h5"
    with h5py.File(path, "w", libver="earliest") as file:  # the later layouts have checksums over this
        file.create_dataset("x", data=np.zeros((4, 300), np.uint8), chunks=(1, 300), compression="lzf")
    content = path.read_bytes()
    options = np.array([4, 261, 300], "<u4").tobytes()
    assert content.count(options) == 1
    path.write_bytes(content.replace(options, np.array([4, 261, 0], "<u4").tobytes()))

    with h5py.File(path) as file, pytest.raises(BrokenFileError) as caught:
        checked_dataset(path, file, "x", dtypes=[np.uint8], num_axes=[2])
    assert caught.value.kind == "filter_options"


def test_refusal_keeps_its_name_between_processes(path: Path):
    error = pickle.loads(pickle.dumps(BrokenFileError("broken", "left_handed_pose")))

    assert (str(error), error.kind) == ("broken", "left_handed_pose")


def test_state_behind_a_link_is_refused(path: Path):
    with h5py.File(path, "r+") as file:
        group = file.create_group("state")
        for name in ("positions", "quaternions", "linear_velocities", "angular_velocities", "half_sizes"):
            group[name] = np.zeros((6, 1, 3))
        group["segmentation"] = h5py.SoftLink("/rgb")

    for read in (read_state, has_state):
        with pytest.raises(DataError, match="soft link"):
            read(path)


# -- manifests ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_recordings(tmp_path / "squares")


def change_manifest(folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    content = json.loads((folder / "dataset.json").read_text())
    change(content)
    (folder / "dataset.json").write_text(json.dumps(content))


def name_first(name: str) -> Callable[[dict[str, Any]], Any]:
    return lambda content: content["splits"]["train"][0].update(file=name)


MANIFESTS: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "parent folder": (name_first("../outside.h5"), "only .h5 files inside"),
    "parent folder in between": (name_first("train/../../outside.h5"), "only .h5 files inside"),
    "absolute name": (name_first("/etc/passwd"), "only .h5 files inside"),
    "absolute trajectory": (name_first("/data/000000.h5"), "only .h5 files inside"),
    "backslashes": (name_first("train\\000000.h5"), "only .h5 files inside"),
    "two names of one file": (name_first("train/./000001.h5"), "only .h5 files inside"),
    "zero byte": (name_first("train/\x00.h5"), "missing or damaged"),
    "twice in one split": (lambda c: c["splits"]["train"].append(c["splits"]["train"][0]), "twice"),
    "in two splits": (lambda c: c["splits"]["test"].append(c["splits"]["train"][0]), "twice"),
    "endless size": (lambda c: c["splits"]["train"][0].update(bytes=float("inf")), "not a manifest"),
    "schema from the future": (lambda c: c.update(schema_version=2), "schema version 2"),
    "splits no mapping": (lambda c: c.update(splits=[[]]), "not a manifest"),
    "settings no mapping": (lambda c: c.update(settings=3), "not a manifest"),
}


@pytest.mark.parametrize("harm", MANIFESTS)
def test_harmed_manifest_is_refused(folder: Path, harm: str):
    change, message = MANIFESTS[harm]
    change_manifest(folder, change)

    with pytest.raises(DataError, match=message):
        load_manifest(folder)


def test_trajectory_that_is_a_symbolic_link_out_of_the_folder_is_refused(folder: Path):
    file = folder / "train" / "000000.h5"
    file.rename(folder.parent / "outside.h5")
    file.symlink_to(folder.parent / "outside.h5")

    with pytest.raises(DataError, match="leads out of the data set"):
        load_manifest(folder)


def test_symbolic_link_to_another_split_is_refused(folder: Path):
    file = folder / "validation" / "000000.h5"
    file.unlink()
    file.symlink_to(folder / "train" / "000000.h5")
    size = (folder / "train" / "000000.h5").stat().st_size
    change_manifest(folder, lambda content: content["splits"]["validation"][0].update(bytes=size))

    with pytest.raises(DataError, match="twice"):
        load_manifest(folder)


def test_data_set_behind_a_symbolic_link_is_read(folder: Path):
    (folder.parent / "link").symlink_to(folder)

    assert len(load_manifest(folder.parent / "link").split("train")) == 4


def huge(path: Path) -> None:
    with path.open("r+b") as stream:
        stream.truncate(2**40)


TEXTS: dict[str, Callable[[Path], Any]] = {
    "a terabyte of nothing": huge,
    "a hundred thousand lists deep": lambda path: path.write_text("[" * 100_000 + "]" * 100_000),
    "ten million lists": lambda path: path.write_text("[" + "[]," * 10_000_000 + "[]]"),
    "number of a million digits": lambda path: path.write_text('{"schema_version": ' + "9" * 1_000_000 + "}"),
    "not unicode": lambda path: path.write_bytes(b'{"name": "\xff\xfe"}'),
    "half": lambda path: path.write_text(path.read_text()[:100]),
    "empty": lambda path: path.write_text(""),
}


@pytest.mark.parametrize("harm", TEXTS)
def test_text_that_is_no_manifest_is_refused_quickly(folder: Path, harm: str):
    TEXTS[harm](folder / "dataset.json")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    with pytest.raises(DataError, match=r"dataset\.json"), counted_calls() as work:
        load_manifest(folder)

    assert work.calls < MAX_CALLS
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak) / 1024 < 2 * MAX_MEGABYTES


def test_wrong_checksum_is_named(folder: Path):
    change_manifest(folder, lambda content: content["splits"]["train"][1].update(sha256="0" * 64))

    assert [fault.name for fault in validate_dataset(folder) if fault.is_error] == ["checksum"]
