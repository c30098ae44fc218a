"""To look at one recording of a data set that is missing, that one is made, and it is the one of the whole set."""

from pathlib import Path

import numpy as np
import pytest

from data_gen.generate import generate
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.errors import ConfigError, DataError
from vpd_lightning.runs.one_recording import choose_trajectory, data_set
from vpd_lightning.runs.provide_data import provide_data

WHOLE = Path("datasets/mujoco_block_tiny")
CONFIG = {
    "experiment": "tiny",
    "data": {"folder": str(WHOLE)},
    "generate": {"scene": "mujoco_block", "preset": "tiny", "seed": 3, "when_missing": True},
}


@pytest.fixture(autouse=True)
def in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def pictures(path: Path) -> np.ndarray:
    with TrajectoryReader(path) as reader:
        return reader.rgb()


def test_it_is_the_trajectory_of_the_whole_data_set_and_made_once(capsys: pytest.CaptureFixture[str]):
    shown = data_set(None, CONFIG, only=("test", 1))

    assert {name: len(paths) for name, paths in shown.splits.items() if paths} == {"test": 2}
    assert not WHOLE.exists()
    said = capsys.readouterr().out
    assert f"there is no data set in {WHOLE}; making what is shown of it: vpd-data generate scene=mujoco_block" in said
    assert f"seed=3 splits.train=0 splits.validation=0 splits.test=2 out={WHOLE}_test_2" in said
    for number in (1, 0):  # what goes as far or farther is taken
        assert data_set(None, CONFIG, only=("test", number)).digest == shown.digest
        assert "making" not in capsys.readouterr().out
    sizes = {"splits.train": 1, "splits.validation": 1, "splits.test": 3}
    generate("mujoco_block", "tiny", WHOLE, seed=3, workers=1, overrides=sizes)
    assert data_set(None, CONFIG, only=("test", 1)).folder.name == WHOLE.name  # now that it is there, it is taken
    one, other = (choose_trajectory(found, "test", 1) for found in (shown, load_manifest(WHOLE)))
    np.testing.assert_array_equal(pictures(one), pictures(other))


def test_recordings_of_other_settings_are_not_taken_for_it():
    provide_data(CONFIG, only=("test", 0))
    other = {**CONFIG, "generate": {**CONFIG["generate"], "seed": 4}}
    with pytest.raises(DataError, match="seed"):
        provide_data(other, only=("test", 0))


@pytest.mark.parametrize("only", [("test", 2), ("test", -1), ("tests", 0)])
def test_a_trajectory_that_the_whole_data_set_would_not_have_is_not_made(only: tuple[str, int]):
    message = rf"There is no trajectory {only[1]} in split {only[0]}.\n.*train 4, validation 2, test 2"
    with pytest.raises(ConfigError, match=message):
        provide_data(CONFIG, only=only)
    assert not Path("datasets").exists()
