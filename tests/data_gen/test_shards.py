"""A data set made in parts: the same files as in one go, finished by whichever part ends last."""

from pathlib import Path

import pytest

from data_gen.dataset_folder import BusyFolderError
from data_gen.generate import generate, make_plan
from data_gen.importers.run import import_recordings
from data_gen.shards import Shard, parse_shard
from tests.data_gen.importers.plain_recording import write_plain
from vpd_lightning.data.manifest import UNFINISHED_NAME, load_manifest
from vpd_lightning.errors import ConfigError, DataError

SCENE = {"scene": "mujoco_block", "preset": "tiny", "seed": 0, "renderer": "raycast", "workers": 1}
FEW = {"splits.train": 2, "splits.validation": 1, "splits.test": 1, "num_frames": 3}


def make(out: Path, shard: str | None = None) -> Path:
    return generate(**SCENE, out=out, overrides=FEW, shard=shard)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.glob("*/*.h5"))}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("whole") / "set")


def test_every_entry_is_in_one_shard() -> None:
    items = dict.fromkeys(range(11))
    shards = [Shard(number, 4).of(items) for number in (1, 2, 3, 4)]
    assert sorted(key for shard in shards for key in shard) == list(items)
    assert max(map(len, shards)) - min(map(len, shards)) <= 1


@pytest.mark.parametrize("text", ["0/2", "3/2", "1", "a/b", "-1/2", "1/0", ""])
def test_what_is_no_shard_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(ConfigError, match="shard=1/4"):
        parse_shard(text)


def test_shards_in_any_order_make_the_set_that_one_process_makes(whole: Path, tmp_path: Path, capsys) -> None:
    make(tmp_path / "set", "2/2")
    assert "2 files of the others are missing" in capsys.readouterr().out
    with pytest.raises(DataError):
        load_manifest(tmp_path / "set")
    make(tmp_path / "set", "2/2")  # again: nothing is left to do for it
    make(tmp_path / "set", "1/2")
    assert contents(tmp_path / "set") == contents(whole)
    assert load_manifest(tmp_path / "set").sha256 == load_manifest(whole).sha256
    assert not (tmp_path / "set" / UNFINISHED_NAME).exists()
    assert not list((tmp_path / "set").glob(".shard*"))


def test_shards_of_separate_disks_are_finished_by_a_run_without_shard(whole: Path, tmp_path: Path) -> None:
    for number in (1, 2):
        make(tmp_path / f"disk{number}", f"{number}/2")
    for path in (tmp_path / "disk2").rglob("*.h5"):
        path.rename(tmp_path / "disk1" / path.relative_to(tmp_path / "disk2"))
    make(tmp_path / "disk1")
    assert contents(tmp_path / "disk1") == contents(whole)
    assert load_manifest(tmp_path / "disk1").sha256 == load_manifest(whole).sha256


def test_other_shards_may_have_the_folder_at_once_and_nobody_else(tmp_path: Path) -> None:
    folder = make_plan("mujoco_block", "tiny", tmp_path / "set", 0, FEW).folder
    with folder.claim(Shard(1, 2)):
        with folder.claim(Shard(2, 2)):
            pass
        with pytest.raises(BusyFolderError, match="Another vpd-data"), folder.claim(Shard(1, 2)):
            pass
        with pytest.raises(BusyFolderError, match="Another vpd-data"), folder.claim():
            pass
    with folder.claim(), pytest.raises(BusyFolderError), folder.claim(Shard(2, 2)):
        pass


def test_the_last_shard_leaves_finishing_to_a_process_that_is_at_it(tmp_path: Path, capsys) -> None:
    folder = make_plan("mujoco_block", "tiny", tmp_path / "set", 0, FEW).folder
    with folder.claim():
        folder.finish_shard(Shard(2, 2), [], lambda hashes: pytest.fail("finished twice"))
    assert "another process finishes the set" in capsys.readouterr().out


def test_an_import_is_divided_in_the_same_way(tmp_path: Path) -> None:
    source = write_plain(tmp_path / "source", num_frames=6)
    settings = {"clip_frames": 3}
    one = import_recordings(source, tmp_path / "one", settings)
    import_recordings(source, tmp_path / "two", settings, "2/2")
    import_recordings(source, tmp_path / "two", settings, "1/2")
    assert contents(tmp_path / "two") == contents(one)
    assert load_manifest(tmp_path / "two").sha256 == load_manifest(one).sha256
