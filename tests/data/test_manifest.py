import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.data.recordings import write_recordings
from vpd_lightning.data.manifest import did_you_mean, load_manifest
from vpd_lightning.errors import DataError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_recordings(tmp_path / "squares")


def test_manifest_lists_what_was_written(folder: Path):
    manifest = load_manifest(folder)

    assert [path.name for path in manifest.split("train")] == [f"{i:06d}.h5" for i in range(4)]
    assert all(path.is_absolute() and path.is_file() for path in manifest.split("validation"))
    assert len(set(manifest.sha256.values())) == 6


def test_digest_changes_with_any_file(folder: Path, tmp_path: Path):
    other = write_recordings(tmp_path / "other", num_validation=1)

    assert load_manifest(folder).digest == load_manifest(folder).digest
    assert load_manifest(folder).digest != load_manifest(other).digest


def test_unknown_or_empty_split_names_those_there_are(folder: Path):
    for name in ("test", "holiday"):
        with pytest.raises(DataError, match=r"train \(4\), validation \(2\)"):
            load_manifest(folder).split(name)


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("mujoco_block_tiny", "scene=mujoco_block preset=tiny out="),
        ("mujoco_block_paper", "scene=mujoco_block preset=paper out="),
        ("mujoco_block", "scene=SCENE preset=PRESET out="),
        ("anything", "scene=SCENE preset=PRESET out="),
    ],
)
def test_missing_data_set_is_told_with_the_command_that_makes_it(tmp_path: Path, name: str, command: str):
    with pytest.raises(DataError) as caught:
        load_manifest(tmp_path / name)

    assert f"vpd-data generate {command}{tmp_path / name}" in str(caught.value)


@pytest.mark.parametrize("harm", [Path.unlink, lambda path: path.write_bytes(path.read_bytes()[:-1])])
def test_missing_or_cut_trajectory_is_named(folder: Path, harm: Callable[[Path], Any]):
    harm(folder / "train" / "000002.h5")

    with pytest.raises(DataError, match=r"1 of 6 trajectories.*\n.*train/000002.h5"):
        load_manifest(folder)


def rewrite(folder: Path, change: Callable[[dict[str, Any]], None]) -> None:
    content = json.loads((folder / "dataset.json").read_text())
    change(content)
    (folder / "dataset.json").write_text(json.dumps(content))


@pytest.mark.parametrize("name", ["../outside.h5", "/etc/passwd", "train/../../x.h5", "train/000000.txt"])
def test_names_that_lead_elsewhere_are_refused(folder: Path, name: str):
    rewrite(folder, lambda content: content["splits"]["train"][0].update(file=name))

    with pytest.raises(DataError, match="only .h5 files inside the data set"):
        load_manifest(folder)


def test_trajectory_in_two_splits_is_refused(folder: Path):
    rewrite(folder, lambda content: content["splits"]["validation"].append(content["splits"]["train"][0]))

    with pytest.raises(DataError, match="names a trajectory twice"):
        load_manifest(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: content.update(schema_version=7), "schema version 7"),
        (lambda content: content.pop("splits"), "not a manifest"),
        (lambda content: content.update(splits=[1]), "not a manifest"),
        (lambda content: content["splits"]["train"][0].pop("sha256"), "not a manifest"),
    ],
)
def test_wrong_content_is_refused(folder: Path, change: Callable[[dict[str, Any]], None], message: str):
    rewrite(folder, change)

    with pytest.raises(DataError, match=message):
        load_manifest(folder)


@pytest.mark.parametrize("text", ["", "[]", "{half", "\x00\x01"])
def test_text_that_is_no_manifest_is_refused(folder: Path, text: str):
    (folder / "dataset.json").write_text(text)

    with pytest.raises(DataError, match=r"dataset\.json"):
        load_manifest(folder)


def test_a_set_that_was_never_divided_anew_keeps_the_digest_of_earlier_versions(folder: Path):
    manifest = load_manifest(folder)
    lines = "".join(f"{name} {value}\n" for name, value in sorted(manifest.sha256.items()))
    assert manifest.digest == manifest.files_digest == hashlib.sha256(lines.encode()).hexdigest()


def test_the_digest_changes_with_the_splits(folder: Path):
    before = load_manifest(folder)
    moved = {"train": before.splits["train"][1:], "validation": before.splits["validation"]}
    seen = {before.digest}
    for split in ("validation", "test"):
        other = replace(before, splits={**moved, split: [*moved.get(split, []), before.splits["train"][0]]})
        assert other.files_digest == before.files_digest
        seen.add(other.digest)
    assert len(seen) == 3


@pytest.mark.parametrize(
    ("given", "meant"),
    [("sets/squars", "sets/squares"), ("set/squares", "sets/squares"), ("sets/something_else", None)],
)
def test_a_mistyped_folder_names_its_neighbours(tmp_path: Path, given: str, meant: str | None):
    write_recordings(tmp_path / "sets" / "squares", num_train=1, num_validation=1)
    line = did_you_mean(tmp_path / given)
    assert line == (f"\nDid you mean {tmp_path / meant}?" if meant else "")
