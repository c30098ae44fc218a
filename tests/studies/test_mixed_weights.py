"""Weights between two models lie on the straight line between them, and the folder is whole."""

import json
from pathlib import Path
from shutil import copytree

import pytest
import safetensors.torch
import torch

from docs.results.studies.mixed_weights import main, mix
from vpd_lightning.errors import CheckpointError
from vpd_lightning.release.release_folder import INDEX_FILE, WEIGHTS_FILE, check_release, read_release, sha256

RELEASED = Path(__file__).resolve().parents[2] / "released" / "mujoco_block_vpd"


def changed(out: Path, shift: float, keep: int | None = None) -> Path:
    """A copy of the released model whose weights are larger by ``shift``."""
    copytree(RELEASED, out)
    weights = {name: value + shift for name, value in list(read_release(RELEASED).weights.items())[:keep]}
    content = safetensors.torch.save(weights)
    (out / WEIGHTS_FILE).write_bytes(content)
    index = json.loads((out / INDEX_FILE).read_text())
    index["sha256"][WEIGHTS_FILE] = sha256(content)
    (out / INDEX_FILE).write_text(json.dumps(index))
    return out


def test_weights_lie_on_the_way_and_the_folder_is_whole(tmp_path: Path) -> None:
    other = changed(tmp_path / "other", 0.4)
    assert main([str(RELEASED), str(other), "0.25", str(tmp_path / "mixed")]) == 0
    assert check_release(tmp_path / "mixed")["name"] == "mixed"
    before, mixed = read_release(RELEASED).weights, read_release(tmp_path / "mixed").weights
    for name, value in before.items():
        torch.testing.assert_close(mixed[name], value + 0.1, rtol=0, atol=1e-6)


def test_what_cannot_be_mixed_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="differ in shape"):
        mix(RELEASED, changed(tmp_path / "less", 0.0, keep=-1), 0.5, tmp_path / "out")
    with pytest.raises(ValueError, match="allowed: 0 to 1"):
        mix(RELEASED, RELEASED, 1.5, tmp_path / "out")
    assert not (tmp_path / "out").exists()
