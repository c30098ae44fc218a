"""vpd-bench: what it says when asked for the wrong thing, and what it writes."""

import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.results_files import read
from vpd_lightning.commands import bench


def run(*words: str, capsys: pytest.CaptureFixture) -> tuple[int, str, str]:
    code = bench.main(list(words))
    said = capsys.readouterr()
    return code, said.out, said.err


def test_unknown_suite_is_named_with_the_nearest(capsys: pytest.CaptureFixture):
    code, _, error = run("suite=neighbours", capsys=capsys)

    assert code == 2
    assert "no suite 'neighbours'" in error
    assert "Did you mean neighbors?" in error
    assert len(error.strip().splitlines()) <= 5


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["suite=neighbors,trainstep"], "train_step"),
        ([], "suite"),
        (["suite=neighbors", "repeats=0"], "repeats=0"),
        (["suite=neighbors", "device=abacus"], "abacus"),
        (["suite=neighbors", "num_threads=0"], "num_threads=0"),
        (["suite=accuracy", "ckpt=[no/such/file.ckpt]"], "no/such/file.ckpt"),
        (["suite=neighbors", "quik=true"], "quik"),
    ],
)
def test_bad_words_end_with_two_and_no_traceback(words: list[str], said: str, capsys: pytest.CaptureFixture):
    code, _, error = run(*words, capsys=capsys)

    assert code == 2
    assert said in error
    assert "Traceback" not in error


@pytest.mark.slow
def test_several_suites_write_their_files_and_the_paths_come_last(tmp_path: Path, capsys: pytest.CaptureFixture):
    code, out, error = run(
        "suite=accuracy,rollout", "quick=true", "repeats=1", "num_threads=1", f"out={tmp_path}", capsys=capsys
    )

    assert code == 0, error
    paths = [tmp_path / "rollout_cpu.json", tmp_path / "accuracy_cpu.json"]
    assert out.strip().splitlines()[-2:] == [str(path) for path in paths]
    assert read(paths[0])["rows"]
    assert paths[0].with_suffix(".png").exists() and paths[0].with_suffix(".csv").exists()
    assert "no checkpoint" in read(paths[1])["facts"]["note"]


def test_help_shows_the_suites(tmp_path: Path):
    command = [sys.executable, "-c", "import sys; from vpd_lightning.commands.bench import main; sys.exit(main())"]

    done = subprocess.run([*command, "--help"], cwd=tmp_path, capture_output=True, text=True)

    assert done.returncode == 0, done.stderr
    assert "vpd-bench suite=" in done.stdout and "train_step" in done.stdout
    assert not list(tmp_path.iterdir())
