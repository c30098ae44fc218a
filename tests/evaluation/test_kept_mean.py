"""The training mean is computed once, and anew where a file of the training split is another one."""

import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.data.recordings import make_trajectory, write_recordings
from vpd_lightning.data.manifest import Manifest, load_manifest
from vpd_lightning.data.schema import write_trajectory
from vpd_lightning.evaluation import kept_mean
from vpd_lightning.evaluation.kept_mean import kept_training_mean
from vpd_lightning.evaluation.references import training_mean


@pytest.fixture
def manifest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Manifest:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return load_manifest(write_recordings(tmp_path / "set", num_frames=3, size=8))


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[list[Path]]:
    """What the mean was computed of, each time."""
    calls: list[list[Path]] = []

    def counted(paths: list[Path]) -> torch.Tensor:
        calls.append(paths)
        return training_mean(paths)

    monkeypatch.setattr(kept_mean, "training_mean", counted)
    return calls


def files(manifest: Manifest) -> list[Path]:
    return list(manifest.folder.glob(".cache/*"))


def test_it_is_computed_once_and_the_same_bit_for_bit(manifest: Manifest, computed: list[list[Path]]) -> None:
    values = [kept_training_mean(manifest) for _ in range(3)]
    assert len(computed) == 1 and len(files(manifest)) == 1
    expected = training_mean(manifest.split("train"))
    assert all(value.dtype == expected.dtype and torch.equal(value, expected) for value in values)


def test_another_file_another_size_or_another_division_makes_it_anew(
    manifest: Manifest, computed: list[list[Path]]
) -> None:
    before = kept_training_mean(manifest)
    path = manifest.split("train")[0]

    other = replace(manifest, sha256={**manifest.sha256, "train/000000.h5": "0" * 64})
    kept_training_mean(other)
    assert len(computed) == 2, "the checksum is another one"

    write_trajectory(path, make_trajectory(77, num_frames=3, size=8))  # behind the manifest's back
    os.utime(path, ns=(1, 1))
    after = kept_training_mean(manifest)
    assert len(computed) == 3 and not torch.equal(before, after)

    fewer = replace(manifest, splits={**manifest.splits, "train": manifest.split("train")[1:]})
    assert torch.equal(kept_training_mean(fewer), training_mean(fewer.split("train")))
    assert len(computed) == 4


@pytest.mark.parametrize("harm", [b"", b"not an archive", None])
def test_a_damaged_file_counts_as_none(manifest: Manifest, computed: list[list[Path]], harm: bytes | None) -> None:
    before = kept_training_mean(manifest)
    (path,) = files(manifest)
    content = bytearray(path.read_bytes())
    content[-200] ^= 1
    path.write_bytes(bytes(content) if harm is None else harm)
    assert torch.equal(kept_training_mean(manifest), before) and len(computed) == 2
    assert torch.equal(kept_training_mean(manifest), before) and len(computed) == 2, "it was mended"


def test_a_data_set_that_cannot_be_written_to_is_kept_in_the_users_cache(
    manifest: Manifest, computed: list[list[Path]], tmp_path: Path
) -> None:
    (manifest.folder / ".cache").write_text("no folder can be made here")
    before = kept_training_mean(manifest)
    assert torch.equal(kept_training_mean(manifest), before) and len(computed) == 1
    assert len(list((tmp_path / "cache" / "vpd_lightning").rglob("*.npz"))) == 1
    shutil.rmtree(tmp_path / "cache")
    (tmp_path / "cache").write_text("nor here")
    assert torch.equal(kept_training_mean(manifest), before), "then it is computed each time"


def test_runs_side_by_side_do_not_disturb_each_other(manifest: Manifest) -> None:
    with ThreadPoolExecutor(8) as pool:
        values = list(pool.map(lambda _: kept_training_mean(manifest), range(16)))
    assert all(torch.equal(value, values[0]) for value in values)
    assert [path.suffix for path in files(manifest)] == [".npz"], "nothing half-written is left"
