"""The checks of ``make reliability`` in small."""

from pathlib import Path

import pytest

from tests import fork_server
from tests.reliability import checkpoints, disks, fuzz, kills, trainings
from tests.reliability.outcome import Outcome, read, write
from tests.reliability.trainings import differences, kill_group, members, run, start


@pytest.fixture(autouse=True)
def _forked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trainings, "popen", fork_server.popen)


def assert_kept(outcomes: list[Outcome]) -> None:
    assert outcomes and all(outcome.is_kept for outcome in outcomes), "\n".join(map(str, outcomes))


@pytest.mark.slow
@pytest.mark.reliability
def test_a_killed_training_ends_as_an_undisturbed_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kills, "STEPS", 40)

    assert_kept(kills.kills(tmp_path, num_chains=1, num_kills=2, num_in_writing=1))

    (metrics,) = (tmp_path / "killed_0").glob("metrics.csv")
    metrics.write_text(metrics.read_text().replace("\n20,", "\n21,", 1))
    assert differences(tmp_path / "undisturbed", tmp_path / "killed_0") == ["metrics.csv"]


@pytest.mark.slow
@pytest.mark.reliability
def test_harmed_checkpoints_are_refused(tmp_path: Path) -> None:
    assert_kept(checkpoints.checkpoints(tmp_path, num_flips=8))


@pytest.mark.slow
@pytest.mark.reliability
def test_mutated_files_are_read_or_refused(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    pytest.importorskip("pyarrow")
    pytest.importorskip("av")
    assert_kept(fuzz.reader(tmp_path, count=100))
    assert_kept(fuzz.importers(tmp_path, count=20))


@pytest.mark.slow
@pytest.mark.reliability
@pytest.mark.skipif(not disks.is_possible(), reason="no mount namespaces here")
def test_a_disk_that_fails_is_named(tmp_path: Path) -> None:
    assert_kept(disks.disks(tmp_path, harms=["read-only"]))


def test_processes_of_a_group_are_found_and_ended(tmp_path: Path) -> None:
    process = start([], "http.server", "0", cwd=tmp_path)
    assert process.pid in members(process.pid)
    kill_group(process.pid)
    process.wait(10)
    assert not members(process.pid)


def test_a_training_that_fails_is_told(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="ended with 2"):
        run(["experiment=nothing"], cwd=tmp_path)


def test_outcomes_of_one_check_replace_its_last_ones(tmp_path: Path) -> None:
    path = tmp_path / "results" / "a.json"
    one, other = Outcome("all", 2, 2, "seen"), Outcome("most", 3, 2)
    write("b", [other], 1.0, path)
    write("a", [one], 1.2, path)
    write("b", [one, other], 1.0, path)

    assert read(path) == {"a": [one], "b": [one, other]}
    assert one.is_kept and not other.is_kept and not Outcome("none", 0, 0).is_kept
    assert str(other).startswith("FAIL")
