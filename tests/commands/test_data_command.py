import os
import subprocess
import sys
from pathlib import Path

import pytest

from vpd_lightning.commands.data import VERBS, main
from vpd_lightning.commands.report_errors import format_error, run_command
from vpd_lightning.errors import CheckpointError, ConfigError, DataError, OutOfMemoryError

ROOT = Path(__file__).resolve().parents[2]
TINY = ["scene=mujoco_block", "preset=tiny", "workers=1", "num_frames=4", "camera.num_views=2", "splits.train=1"]


def test_generate_inspect_and_validate_work_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = tmp_path / "blocks"

    assert main(["generate", *TINY, f"out={folder}", "splits.validation=0", "splits.test=1"]) == 0
    assert main(["validate", str(folder)]) == 0
    assert main(["inspect", str(folder), f"out={tmp_path / 'sheet.png'}"]) == 0

    printed = capsys.readouterr().out
    assert "2 trajectories" in printed and "is valid" in printed and "train 1, validation 0, test 1" in printed
    assert "depth noise    0.00 % of depth" in printed and "may move" in printed
    assert (tmp_path / "sheet.png").stat().st_size > 1000 and (tmp_path / "may_move.png").stat().st_size > 1000


def test_validate_lists_faults_and_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    main(["generate", *TINY, f"out={tmp_path}", "splits.validation=0", "splits.test=0"])
    path = tmp_path / "train" / "000000.h5"
    path.write_bytes(path.read_bytes()[:-10])

    assert main(["validate", str(tmp_path)]) == 3
    printed = capsys.readouterr()
    assert "fault manifest" in printed.out and "fault damaged_file" in printed.out
    assert "has 2 faults" in printed.err


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        ([], 2, ""),
        (["generat"], 2, "did you mean 'generate'"),
        (["import", "somewhere"], 2, "import takes one source"),
        (["import", "{folder}/nowhere", "out={out}"], 3, "There is no"),
        (["import", "{folder}", "out={out}", "formt=tum"], 2, "did you mean 'format'"),
        (["import", "{folder}", "out={out}", "format=tun"], 2, "did you mean 'tum'"),
        (["split", "{folder}", "train=0.5", "size=3"], 2, "split has no setting 'size'"),
        (["split", "{folder}", "train=0.5"], 3, "No data set in"),
        (["generate"], 2, "generate needs scene=..., preset=..., out=..."),
        (["generate", "scene=mujoco_block", "preset=tiny"], 2, "generate needs out=..."),
        (["generate", "demo", *TINY, "out={out}"], 2, "not 'demo'"),
        (["generate", *TINY, "out={out}", "--seed", "3"], 2, "Unknown option '--seed'"),
        (["generate", *TINY, "out={out}", "seed=1", "seed=2"], 2, "seed is given twice"),
        (["generate", *TINY, "out={out}", "seed=x"], 2, "seed is 'x'"),
        (["generate", *TINY, "out={out}", "seed=-1"], 2, "seed is -1"),
        (["generate", *TINY[2:], "scene=moon", "preset=tiny", "out={out}"], 2, "Available: deformable_block"),
        (["generate", "scene=mujoco_block", "preset=big", "out={out}"], 2, "Available: demo, paper, small, tiny"),
        (["generate", *TINY, "out={out}", "split.test=1"], 2, "did you mean 'splits.test'"),
        (["generate", *TINY, "out={out}", "splits.test=two"], 2, "splits.test"),
        (["generate", *TINY, "out={out}", "splits.test=[1"], 2, "cannot be read"),
        (["generate", *TINY, "out={out}", "renderer=vulkan"], 2, "auto, egl, osmesa, blender, raycast"),
        (["generate", *TINY, "out={file}"], 3, "is a file"),
        (["generate", *TINY, "out={file}/inside"], 3, "cannot be written"),
        (["inspect"], 2, "inspect takes one folder"),
        (["inspect", "{out}", "size=3"], 3, "There is no"),
        (["inspect", "{folder}", "size=3"], 2, "inspect has no setting 'size'"),
        (["inspect", "{folder}"], 3, "No data set in"),
        (["validate", "{out}"], 3, "Make one: vpd-data generate"),
        (["validate", "{out}"], 3, "vpd-data import from a recording"),
        (["validate", "{file}"], 3, "not an HDF5 file"),
        (["validate", "{folder}"], 3, "fault"),
    ],
)
def test_wrong_use_gets_a_short_message_and_its_exit_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], code: int, message: str
):
    places = {"out": tmp_path / "out", "file": tmp_path / "file.h5", "folder": tmp_path / "folder"}
    places["file"].write_text("something else")
    places["folder"].mkdir()
    before = sorted(tmp_path.rglob("*"))

    assert main([word.format(**places) for word in words]) == code

    printed = capsys.readouterr()
    assert message in printed.err + printed.out
    assert "Traceback" not in printed.err
    assert len(printed.err.splitlines()) <= 5
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("verb", ["inspect", "validate", "split"])
def test_a_recording_that_was_not_imported_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str], verb: str):
    folder = tmp_path / "table"
    folder.mkdir()
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        (folder / name).touch()

    assert main([verb, str(folder)]) == 3

    said = capsys.readouterr().err
    assert "is a recording (tum)" in said and f"vpd-data import {folder} out=datasets/table" in said


def test_a_mistyped_data_set_is_suggested(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "blocks").mkdir()
    (tmp_path / "blocks" / "dataset.json").touch()

    assert main(["inspect", str(tmp_path / "bloks")]) == 3
    assert f"Did you mean {tmp_path / 'blocks'}?" in capsys.readouterr().err


def test_help_loads_nothing_heavy():  # tests/test_architecture.py counts what it does
    script = (
        "import sys; from vpd_lightning.commands.data import main; code = main(['--help']); "
        "print('LOADED', {'torch', 'mujoco', 'h5py', 'omegaconf', 'numpy'} & set(sys.modules)); sys.exit(code)"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT / "src"), str(ROOT)])}
    result = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, env=environment, check=False
    )

    assert result.returncode == 0, result.stderr
    assert "LOADED set()" in result.stdout
    assert all(f"vpd-data {verb}" in result.stdout for verb in VERBS)


@pytest.mark.parametrize("kind", [ConfigError, DataError, CheckpointError, OutOfMemoryError])
def test_named_errors_become_exit_codes(kind: type[ConfigError], capsys: pytest.CaptureFixture[str]):
    def fail() -> None:
        raise kind("what\nwhy\nwhat to do")

    assert run_command(fail) == kind.exit_code
    assert capsys.readouterr().err == "error: what\n       why\n       what to do\n"


def test_interrupt_is_130_and_success_0(capsys: pytest.CaptureFixture[str]):
    def interrupt() -> None:
        raise KeyboardInterrupt

    assert run_command(interrupt) == 130
    assert run_command(lambda: None) == 0
    assert run_command(lambda: 7) == 7
    assert capsys.readouterr().err == "interrupted\n"


def test_traceback_only_on_demand(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    def fail() -> None:
        raise DataError("broken")

    run_command(fail)
    assert "Traceback" not in capsys.readouterr().err
    monkeypatch.setattr(sys, "argv", ["vpd-data", "debug=true"])
    run_command(fail)
    assert "Traceback" in capsys.readouterr().err


def test_long_errors_are_cut_to_five_lines():
    assert len(format_error(DataError("\n".join("abcdefgh"))).splitlines()) == 5


def test_faults_of_this_program_keep_their_traceback():
    with pytest.raises(ZeroDivisionError):
        run_command(lambda: 1 // 0)
