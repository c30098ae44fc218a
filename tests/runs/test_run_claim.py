"""Who may write into a run folder."""

import os
import sys
from pathlib import Path
from typing import IO

import pytest

from tests import fork_server
from tests.fork_server import PIPE
from tests.waiting import HANG
from vpd_lightning.errors import ConfigError
from vpd_lightning.runs import run_claim
from vpd_lightning.runs.run_claim import CLAIM, claimed, foreign_files, is_claimed, set_aside

CLAIM_AND_WAIT = (
    "import sys; from pathlib import Path; from vpd_lightning.runs.run_claim import claimed\n"
    "with claimed(Path(sys.argv[1]), is_new=True): print('mine', flush=True); sys.stdin.read()"
)


def test_folder_is_claimed_while_a_process_has_it_and_free_after_that_was_killed(tmp_path: Path):
    folder = tmp_path / "run"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    process = fork_server.popen(
        [sys.executable, "-c", CLAIM_AND_WAIT, str(folder)],
        env=environment, stdin=PIPE, stdout=PIPE,
    )  # fmt: skip
    assert process.stdout is not None and process.stdout.readline() == "mine\n"

    assert is_claimed(folder)
    with pytest.raises(ConfigError, match="another process trains in"), claimed(folder, is_new=False):
        pass
    assert (folder / CLAIM).read_text() == f"{process.pid}\n"

    process.kill()
    process.communicate(timeout=HANG)
    assert (folder / CLAIM).is_file() and not is_claimed(folder)
    with claimed(folder, is_new=False):
        pass
    assert not (folder / CLAIM).exists()


def test_two_runs_that_choose_one_name_at_the_same_moment_do_not_mix(tmp_path: Path):
    with (
        claimed(tmp_path / "run", is_new=True),
        pytest.raises(ConfigError, match="another run has just taken"),
        claimed(tmp_path / "run", is_new=True),
    ):
        pass


@pytest.mark.parametrize("is_new", [True, False])
def test_claim_that_is_removed_before_it_is_locked_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_new: bool
):
    calls = []

    def lock_late(stream: IO[str]) -> bool:
        calls.append(stream)
        if len(calls) == 1:  # the owner before ends just now
            (tmp_path / CLAIM).unlink()
        return True

    monkeypatch.setattr(run_claim, "lock", lock_late)
    with claimed(tmp_path, is_new=is_new):
        assert (tmp_path / CLAIM).read_text() == f"{os.getpid()}\n"
    assert len(calls) == 2 and calls[0].closed


def test_folder_is_set_aside_under_the_first_free_name(tmp_path: Path):
    for number in (1, 2):
        folder = tmp_path / "run"
        folder.mkdir()
        (folder / "log.txt").write_text(str(number))

        assert set_aside(folder) == tmp_path / f"run.aborted-{number}"

    assert [(tmp_path / f"run.aborted-{number}" / "log.txt").read_text() for number in (1, 2)] == ["1", "2"]


def test_what_a_training_wrote_is_not_foreign(trained: Path, tmp_path: Path):
    assert foreign_files(trained) == []
    (tmp_path / "thesis.tex").touch()
    (tmp_path / "config.yaml").touch()
    assert foreign_files(tmp_path) == ["thesis.tex"]
