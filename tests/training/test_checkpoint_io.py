"""Checkpoints: whole or not there, verified, and nothing in them can run."""

import hashlib
import multiprocessing
import os
import pickle
import re
import signal
import struct
import zipfile
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import LightningModule, Trainer
from torch.utils.data import DataLoader

from vpd_lightning.config.pretraining import FOLDER
from vpd_lightning.errors import CheckpointError
from vpd_lightning.training.checkpoint_files import load_checkpoint, write_checkpoint
from vpd_lightning.training.checkpoint_io import AtomicCheckpointIO
from vpd_lightning.training.checkpoints import FIRST_TRAINING, find_resume, latest_run


def content(value: float = 1.0) -> dict[str, Any]:
    return {"state_dict": {"weight": torch.full((100,), value)}, "hyper_parameters": {"experiment": "test"}}


def value_of(path: Path) -> float:
    return float(load_checkpoint(path)["state_dict"]["weight"][0])


def test_what_is_written_is_read_and_plain_torch_reads_it_too(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "a.ckpt"
    write_checkpoint(content(), path)
    for loaded in (load_checkpoint(path), torch.load(path, weights_only=True)):
        assert torch.equal(loaded["state_dict"]["weight"], torch.ones(100))
        assert loaded["hyper_parameters"] == {"experiment": "test"}
    assert zipfile.ZipFile(path).testzip() is None
    assert [item.name for item in path.parent.iterdir()] == ["a.ckpt"]


def payloads(path: Path) -> set[int]:
    """Places of the bytes that are content; the others are the archive's headers, and gaps between its members."""
    found: set[int] = set()
    with zipfile.ZipFile(path) as archive, path.open("rb") as stream:
        for member in archive.infolist():
            stream.seek(member.header_offset + 26)
            name_length, extra_length = struct.unpack("<HH", stream.read(4))
            start = member.header_offset + 30 + name_length + extra_length
            found |= set(range(start, start + member.file_size))
    return found


def signatures(archive: bytes, start: int) -> list[int]:
    """Places where an entry of the archive's directory begins."""
    return [place for place in range(start, len(archive)) if archive[place : place + 4] == b"PK\x01\x02"]


def test_a_changed_byte_is_noticed_or_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.ckpt"
    write_checkpoint(content(), path)
    good, inside = path.read_bytes(), payloads(path)
    with zipfile.ZipFile(path) as archive:
        attributes = [place + 38 for place in signatures(good, archive.start_dir)]
    refused = 0
    changes = [(place, 0x40) for place in sorted({*range(0, len(good), 37), *range(len(good) - 100, len(good))})]
    for place, changed_bits in [*changes, *((place, 0x10) for place in attributes)]:  # 0x10: as if it were a folder
        path.write_bytes(good[:place] + bytes([good[place] ^ changed_bits]) + good[place + 1 :])
        try:
            loaded = load_checkpoint(path)
        except CheckpointError as error:
            assert re.search("damaged|not a checkpoint", str(error))
            refused += 1
            continue
        assert place not in inside
        assert torch.equal(loaded["state_dict"]["weight"], content()["state_dict"]["weight"])
        assert loaded["hyper_parameters"] == content()["hyper_parameters"]
    assert refused > len(inside & {place for place, _ in changes}) + len(attributes)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_file_that_is_cut_short_is_refused(tmp_path: Path, share: float) -> None:
    path = tmp_path / "a.ckpt"
    write_checkpoint(content(), path)
    good = path.read_bytes()
    path.write_bytes(good[: int(share * len(good))])
    with pytest.raises(CheckpointError, match="is damaged or cut short|is not a checkpoint"):
        load_checkpoint(path)


def test_checkpoints_with_the_checksum_of_older_versions_are_read(tmp_path: Path) -> None:
    """They end in the SHA-256 of what is before it, as the comment of the archive."""
    path = tmp_path / "a.ckpt"
    write_checkpoint(content(2.0), path)
    trailer = b"vpd-sha256:" + hashlib.sha256(path.read_bytes()[:-2]).hexdigest().encode()
    path.write_bytes(path.read_bytes()[:-2] + len(trailer).to_bytes(2, "little") + trailer)
    assert value_of(path) == 2.0


def test_checkpoints_of_plain_lightning_are_read(tmp_path: Path) -> None:
    class Module(LightningModule):
        def __init__(self) -> None:
            super().__init__()
            self.save_hyperparameters({"experiment": "test"})
            self.weight = torch.nn.Parameter(torch.full((100,), 3.0))

        def training_step(self, batch: torch.Tensor, batch_idx: int) -> torch.Tensor:
            return (self.weight * batch).sum()

        def configure_optimizers(self) -> torch.optim.Optimizer:
            return torch.optim.SGD(self.parameters(), lr=0.0)

    trainer = Trainer(
        max_steps=1, accelerator="cpu", default_root_dir=tmp_path, logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(Module(), DataLoader(torch.ones(1, 1)))
    trainer.save_checkpoint(tmp_path / "a.ckpt")
    loaded = load_checkpoint(tmp_path / "a.ckpt")
    assert float(loaded["state_dict"]["weight"][0]) == 3.0 and loaded["hyper_parameters"] == {"experiment": "test"}


def test_files_that_are_not_ours_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ckpt"
    path.write_text("hello")
    with pytest.raises(CheckpointError, match="is not a checkpoint"):
        load_checkpoint(path)
    torch.save(content(), path, _use_new_zipfile_serialization=False)
    with pytest.raises(CheckpointError, match="is not a checkpoint"):
        load_checkpoint(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("hello.txt", "hello")
    with pytest.raises(CheckpointError, match="not a checkpoint"):
        load_checkpoint(path)
    write_checkpoint({"weights": torch.ones(1)}, path)
    with pytest.raises(CheckpointError, match="holds no weights"):
        load_checkpoint(path)
    with pytest.raises(CheckpointError, match="There is no checkpoint"):
        load_checkpoint(tmp_path / "b.ckpt")
    with pytest.raises(CheckpointError, match="cannot be read"):
        load_checkpoint(tmp_path)


@pytest.mark.parametrize("address", ["http://example.com/a.ckpt", "https://example.com/a.ckpt", "s3://bucket/a.ckpt"])
def test_internet_addresses_are_refused(address: str) -> None:
    with pytest.raises(CheckpointError, match="internet address"):
        load_checkpoint(address)


class Bomb:
    """Makes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.path),)


def test_code_in_a_checkpoint_does_not_run(tmp_path: Path) -> None:
    path, trace = tmp_path / "a.ckpt", tmp_path / "trace"
    write_checkpoint({**content(), "bomb": Bomb(trace)}, path)
    with pytest.raises(CheckpointError, match="more than tensors and plain containers"):
        load_checkpoint(path)
    with pytest.raises(CheckpointError):
        AtomicCheckpointIO().load_checkpoint(path, weights_only=False)
    path.write_bytes(pickle.dumps(Bomb(trace)))
    with pytest.raises(CheckpointError):
        load_checkpoint(path)
    assert not trace.exists()


def test_a_full_disk_leaves_the_old_checkpoint_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "last.ckpt"
    write_checkpoint(content(1.0), path)

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(CheckpointError, match="No space left on device"):
        write_checkpoint(content(2.0), path)
    monkeypatch.undo()
    assert value_of(path) == 1.0 and os.listdir(tmp_path) == ["last.ckpt"]


def save_and_die(path: Path, place: str, is_after: bool) -> None:
    """Be killed inside the named call of the operating system."""
    real = getattr(os, place)

    def deadly(*args: Any, **kwargs: Any) -> None:
        if is_after:
            real(*args, **kwargs)
        os.kill(os.getpid(), signal.SIGKILL)

    setattr(os, place, deadly)
    AtomicCheckpointIO().save_checkpoint(content(3.0), path)


@pytest.mark.parametrize(
    ("place", "is_after"), [("fsync", False), ("replace", False), ("replace", True), ("link", True)]
)
def test_a_process_that_is_killed_while_saving_leaves_a_good_checkpoint(
    tmp_path: Path, place: str, is_after: bool
) -> None:
    path = tmp_path / "last.ckpt"
    saver = AtomicCheckpointIO()
    saver.save_checkpoint(content(1.0), path)
    saver.save_checkpoint(content(2.0), path)
    died = multiprocessing.get_context("fork").Process(target=save_and_die, args=(path, place, is_after))
    died.start()
    died.join(60)
    assert died.exitcode == -signal.SIGKILL
    assert value_of(find_resume(tmp_path)) == 2.0
    saver.save_checkpoint(content(4.0), path)  # what the dead process left behind is not in the way
    assert value_of(path) == 4.0


def test_the_checkpoint_before_the_last_is_kept(tmp_path: Path) -> None:
    saver = AtomicCheckpointIO()
    for value in (1.0, 2.0, 3.0):
        saver.save_checkpoint(content(value), tmp_path / "last.ckpt")
    assert value_of(tmp_path / "last.ckpt") == 3.0 and value_of(tmp_path / "last-previous.ckpt") == 2.0
    assert len(list(tmp_path.iterdir())) == 2


def test_resuming_falls_back_to_the_checkpoint_before_a_damaged_one_and_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run = tmp_path / "experiment" / "run"
    last = run / "checkpoints" / "last.ckpt"
    saver = AtomicCheckpointIO()
    for value in (1.0, 2.0):
        saver.save_checkpoint(content(value), last)
    assert find_resume(run) == find_resume(last.parent) == find_resume(last) == last
    last.write_bytes(last.read_bytes()[:-1])
    assert find_resume(run) == last.with_name("last-previous.ckpt")
    assert "Going on from the checkpoint before it" in caplog.text
    last.unlink()
    assert value_of(find_resume(run)) == 1.0
    last.with_name("last-previous.ckpt").write_bytes(b"")
    with pytest.raises(CheckpointError, match="last-previous.ckpt is not a checkpoint"):
        find_resume(run)
    with pytest.raises(CheckpointError, match="holds no checkpoint"):
        find_resume(tmp_path)


def test_the_latest_run_is_the_one_that_saved_last(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="No run below"):
        latest_run(tmp_path)
    for index, name in enumerate(("b", "a")):
        path = tmp_path / name / "checkpoints" / "last.ckpt"
        write_checkpoint(content(), path)
        os.utime(path, (1000 + index, 1000 + index))
    assert latest_run(tmp_path) == tmp_path / "a"

    assert FIRST_TRAINING == FOLDER  # of a run that was stopped in the first of two trainings
    path = tmp_path / "b" / FIRST_TRAINING / "checkpoints" / "last.ckpt"
    write_checkpoint(content(), path)
    os.utime(path, (1002, 1002))
    assert latest_run(tmp_path) == tmp_path / "b"
