"""Models trained for equal time, compared on the same pixels: of all cameras, or of those that were held out."""

import shutil
from pathlib import Path

import pytest
import torch

from benchmarks.equal_time import ALL, HELD_OUT, SEEN, cameras_of, draw, main, measure, training_time
from benchmarks.measuring import Options
from benchmarks.models import load_models
from benchmarks.results_files import read
from tests.benchmarks.test_plots import is_picture
from vpd_lightning.commands import train

pytestmark = pytest.mark.slow  # two trainings of two steps
CPU = torch.device("cpu")
TWO_OF_THREE = ["scene.input_views=[0,1]", "data.target_views=[0,1]"]


@pytest.fixture(scope="module")
def held_out(quick: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training that never sees the third camera, neither as input nor as target."""
    folder = tmp_path_factory.mktemp("held_out") / "two_cameras"
    words = [word for word in quick if not word.startswith("scene.input_views")]
    assert train.main([*words, *TWO_OF_THREE, f"run.folder={folder}"]) == 0
    return folder


def the_model(folder: Path):
    ((_, model),) = load_models(Options(CPU, "tiny", 1, [folder / "checkpoints" / "last.ckpt"])).items()
    return model


def test_cameras_that_did_not_supervise_are_held_out(trained: Path, held_out: Path):
    assert cameras_of(the_model(trained)) == {ALL: [0, 1, 2]}
    assert cameras_of(the_model(held_out)) == {SEEN: [0, 1], HELD_OUT: [2]}


def test_runs_are_compared_on_both_kinds_of_cameras_in_a_table_and_a_picture(held_out: Path, tmp_path: Path):
    again = shutil.copytree(held_out, tmp_path / "again")

    result = measure([held_out, again], repeats=1, num_clips=2, num_rays=8, horizons=[1])

    assert len({item.name for item in result.rows}) == len(result.rows) == 4
    for item in result.rows:
        assert item.seconds > 0 and 0 < item.psnr < 60
    # The same weights twice: not a decibel between the two, on either kind of cameras.
    gains = [value for name, value in result.facts.items() if name.startswith("dB of")]
    assert gains == [0.0, 0.0]
    draw(result, tmp_path / "picture.png")
    assert is_picture(tmp_path / "picture.png")


def test_command_writes_all_files_under_the_name_it_was_given(
    held_out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    words = ["--repeats=1", "--clips=1", "--rays=8", "--steps", "1", "--name=renderers", f"--out={tmp_path}"]
    monkeypatch.setattr("sys.argv", ["equal_time", str(held_out), *words])

    main()

    assert [item.name.rpartition(", ")[2] for item in read(tmp_path / "renderers_cpu.json")["rows"]] == [SEEN, HELD_OUT]
    assert is_picture(tmp_path / "renderers_cpu.png")


def test_length_of_a_training_is_its_own_record_or_the_age_of_its_files(held_out: Path, tmp_path: Path):
    seconds, clock = training_time(held_out)
    (tmp_path / "training_time.json").write_text('{"seconds": 150.2, "clock": "cpu"}')

    assert seconds >= 0 and clock in ("wall", "cpu")
    assert training_time(tmp_path) == (150.2, "cpu")
