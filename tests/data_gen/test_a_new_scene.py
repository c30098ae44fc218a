"""A scene of its own costs a module and a preset: what generates, lists and checks data sets finds both by name."""

import sys
from pathlib import Path
from shutil import copytree

import h5py
import pytest

import data_gen
from data_gen import presets, settings
from data_gen.generate import generate
from tests.data_gen.blocks import SMALL, contents
from vpd_lightning.commands.data import main
from vpd_lightning.commands.data_help import scene_lines
from vpd_lightning.errors import ConfigError

MODULE = '''
"""A block that is let go above the middle of the floor."""

from dataclasses import dataclass

from omegaconf import MISSING

from data_gen.mujoco_block.scene import MujocoBlockScene
from data_gen.mujoco_block.settings import MujocoBlockSettings
from data_gen.scene_settings import require

VERSION = 1


@dataclass
class Settings(MujocoBlockSettings):
    drop_height: float = MISSING  # m

    def __post_init__(self):
        super().__post_init__()
        require(self.drop_height > 0, "drop_height", self.drop_height, "above 0")


class Scene(MujocoBlockScene):
    def __init__(self, settings, renderer):
        toss = settings.toss
        toss.position_min = toss.position_max = [0.0, 0.0, settings.drop_height]
        toss.velocity_max = [0.0, 0.0, 0.0]
        super().__init__(settings, renderer)
'''
PRESET = """
# Let go, not thrown.
family: let_go
about: a block that is let go
extends: mujoco_block/tiny
drop_height: 0.8
"""


@pytest.fixture(autouse=True)
def _added(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put the two files beside the others."""
    (tmp_path / "code").mkdir()
    (tmp_path / "code" / "let_go.py").write_text(MODULE)
    folder = copytree(presets.preset_folder(), tmp_path / "conf")
    (folder / "block_let_go").mkdir()
    (folder / "block_let_go" / "tiny.yaml").write_text(PRESET)
    monkeypatch.setattr(data_gen, "__path__", [*data_gen.__path__, str(tmp_path / "code")])
    for module in (presets, settings):
        monkeypatch.setattr(module, "preset_folder", lambda: folder)
    monkeypatch.setitem(sys.modules, "data_gen.let_go", None)  # so that it is forgotten afterwards
    del sys.modules["data_gen.let_go"]


def test_it_is_generated_and_valid(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = generate("block_let_go", "tiny", tmp_path / "out", seed=0, workers=1, overrides=SMALL)
    assert sorted(contents(out)) == ["test/000000.h5", "train/000000.h5", "train/000001.h5", "validation/000000.h5"]
    with h5py.File(out / "train" / "000000.h5") as file:
        assert file["state/positions"][0, 0].tolist() == [0.0, 0.0, 0.8]
    assert main(["validate", str(out)]) == 0


def test_it_is_listed_with_what_it_shows() -> None:
    assert "block_let_go                          a block that is let go" in scene_lines()


def test_its_settings_are_checked(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"drop_height is -1\.0; allowed: above 0"):
        generate("block_let_go", "tiny", tmp_path / "out", seed=0, workers=1, overrides={"drop_height": -1.0})
    with pytest.raises(ConfigError, match="did you mean 'drop_height'"):
        generate("block_let_go", "tiny", tmp_path / "out", seed=0, workers=1, overrides={"drop_hight": 1.0})


def test_every_scene_says_what_it_shows() -> None:
    assert all(presets.scene_description(scene) for scene in presets.scene_names())
