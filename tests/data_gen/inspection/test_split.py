import json
from dataclasses import replace
from pathlib import Path

import pytest

from data_gen.inspection.split import recording_counts, split_dataset
from tests.data.recordings import make_trajectory, write_dataset_file, write_recordings
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.data.schema import write_trajectory
from vpd_lightning.errors import ConfigError, DataError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Ten trajectories, each a recording of its own."""
    return write_recordings(tmp_path / "set", num_train=8, num_validation=2, num_frames=3, size=8)


@pytest.fixture
def clips(tmp_path: Path) -> Path:
    """Four recordings of 1, 2, 3 and 4 clips, all in train."""
    folder = tmp_path / "clips"
    files = []
    for recording in range(4):
        for clip in range(recording + 1):
            path = folder / "train" / f"{len(files):06d}.h5"
            trajectory = make_trajectory(recording, num_frames=3, size=8)
            write_trajectory(path, replace(trajectory, attributes={"recording": f"take{recording}", "clip": clip}))
            files.append(path)
    return write_dataset_file(folder, {"train": files, "validation": [], "test": []})


def division(folder: Path) -> dict[str, list[str]]:
    return {name: [path.name for path in files] for name, files in load_manifest(folder).splits.items()}


def test_numbers_and_fractions(folder: Path):
    assert split_dataset(folder, train=6, validation=3, test=1).num_trajectories == {
        "train": 6,
        "validation": 3,
        "test": 1,
    }
    assert split_dataset(folder, validation=2, test=2).num_recordings == {"train": 6, "validation": 2, "test": 2}
    result = split_dataset(folder, train=0.8, validation=0.1, test=0.1)
    assert result.num_trajectories == {"train": 8, "validation": 1, "test": 1}
    assert {name: len(files) for name, files in load_manifest(folder).splits.items()} == result.num_trajectories


def test_files_and_checksums_stay(folder: Path):
    before = load_manifest(folder)
    times = {path: path.stat().st_mtime_ns for path in folder.glob("*/*.h5")}

    split_dataset(folder, train=0.5, validation=0.3, test=0.2, seed=4)

    after = load_manifest(folder)
    assert after.sha256 == before.sha256 and after.num_bytes == before.num_bytes
    assert after.files_digest == before.files_digest and after.digest != before.digest, "splits belong to the digest"
    assert {path: path.stat().st_mtime_ns for path in folder.glob("*/*.h5")} == times
    assert (after.settings, after.scene, after.seed) == (before.settings, before.scene, before.seed)
    assert not list(folder.glob(".*"))


def test_the_same_seed_gives_the_same_division_whatever_came_before(folder: Path):
    split_dataset(folder, train=5, validation=3, test=2, seed=1)
    first = division(folder)
    split_dataset(folder, train=0.2, validation=0.4, test=0.4, seed=9)
    assert division(folder) != first
    split_dataset(folder, train=5, validation=3, test=2, seed=1)
    assert division(folder) == first
    split_dataset(folder, train=5, validation=3, test=2, seed=2)
    assert division(folder) != first


def test_the_first_manifest_is_kept(folder: Path):
    first = (folder / "dataset.json").read_bytes()

    split_dataset(folder, train=0.5, validation=0.5)
    split_dataset(folder, test=5, train=5, seed=3)

    assert (folder / "dataset.json.bak").read_bytes() == first
    generator = json.loads((folder / "dataset.json").read_text())["generator"]
    assert generator.endswith("; split by vpd-data split train=5 test=5 seed=3") and generator.count("split by") == 1


@pytest.mark.parametrize("seed", range(5))
def test_clips_of_one_recording_stay_together(clips: Path, seed: int):
    result = split_dataset(clips, train=2, validation=1, test=1, seed=seed)

    assert result.num_recordings == {"train": 2, "validation": 1, "test": 1}
    assert sum(result.num_trajectories.values()) == 10
    starts = [0, 1, 3, 6, 10]
    for files in division(clips).values():
        numbers = {int(name[:6]) for name in files}
        for first, last in zip(starts, starts[1:], strict=False):
            assert len(numbers & set(range(first, last))) in (0, last - first)


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ({}, "needs numbers or fractions"),
        ({"train": 9, "validation": 1, "test": 1}, "needs 11 recordings; there are 10"),
        ({"train": 4, "validation": 1, "test": 1}, "6 of 10 recordings.\nLeave one out"),
        ({"train": 0.5, "validation": 0.1, "test": 0.1}, "adds up to 0.7"),
        ({"train": 0.9, "validation": 0.2}, "adds up to 1.1"),
        ({"train": 0.5, "validation": 3}, "mixes"),
        ({"train": -1}, "train is -1"),
        ({"train": float("nan")}, "train is nan"),
        ({"train": True}, "train is True"),
        ({"train": "all"}, "train is 'all'"),
        ({"train": 5, "seed": -1}, "seed is -1"),
    ],
)
def test_impossible_requests_change_nothing(folder: Path, wanted: dict, message: str):
    before = (folder / "dataset.json").read_bytes()

    with pytest.raises(ConfigError, match=message):
        split_dataset(folder, **wanted)

    assert (folder / "dataset.json").read_bytes() == before
    assert not (folder / "dataset.json.bak").exists()


def test_more_splits_than_recordings(clips: Path):
    with pytest.raises(ConfigError, match="5 recordings; there are 4"):
        split_dataset(clips, train=3, validation=1, test=1)
    assert recording_counts({"train": 0.98, "validation": 0.01, "test": 0.01}, 4) == {
        "train": 2,
        "validation": 1,
        "test": 1,
    }
    with pytest.raises(ConfigError, match="3 splits of 2 recordings"):
        recording_counts({"train": 0.98, "validation": 0.01, "test": 0.01}, 2)


def test_damaged_data_sets_are_refused(folder: Path):
    path = folder / "train" / "000000.h5"
    size = path.stat().st_size
    path.write_bytes(b"x" * size)

    with pytest.raises(DataError, match="000000.h5"):
        split_dataset(folder, train=0.5, validation=0.5)
    with pytest.raises(DataError, match="No data set"):
        split_dataset(folder / "nothing", train=1)


def test_copies_of_a_file_stay_together(folder: Path):
    for seed in range(5):
        (folder / "train" / "000003.h5").write_bytes((folder / "train" / "000001.h5").read_bytes())
        write_dataset_file(folder, {"train": sorted(folder.glob("*/*.h5")), "validation": [], "test": []})
        split_dataset(folder, train=0.5, validation=0.25, test=0.25, seed=seed)
        assert sum({"000001.h5", "000003.h5"} <= set(names) for names in division(folder).values()) >= 1
        assert not load_manifest(folder).repeated()
