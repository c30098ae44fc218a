"""A run that began with an older version goes on as the model that it was: settings that came later stay off."""

from pathlib import Path

import pytest
import yaml

from vpd_lightning.config import compose
from vpd_lightning.runs.resume import resumed_overrides

WORDS = ["experiment=tiny", "model=inertial", "run.folder=unused"]


def run_of_an_older_version(folder: Path, *words: str, without: tuple[str, ...]) -> Path:
    config = compose("train", [*WORDS, *words])
    for name in without:
        section, _, key = name.partition(".")
        del config[section][key]
    (folder / "checkpoints").mkdir(parents=True)
    (folder / "checkpoints" / "last.ckpt").write_bytes(b"weights")
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    (folder / "overrides.yaml").write_text(yaml.safe_dump([*WORDS, *words]))
    return folder


def added(words: list[str]) -> set[str]:
    """What stands in the words beside those of the run."""
    return set(words) - set(WORDS) - {word for word in words if word.startswith(("resume=", "run.folder="))}


LATER = ("renderer.unseen_ground", "renderer.far_pixels", "renderer.num_occluders", "renderer.candidate_backend")


def test_settings_that_came_later_stay_as_they_were_without_them(tmp_path: Path) -> None:
    folder = run_of_an_older_version(tmp_path / "run", without=LATER)

    words = resumed_overrides([f"resume={folder}"])

    # What came later and is the same without (candidate_backend) needs no word.
    off = {"renderer.unseen_ground=false", "renderer.far_pixels=false", "renderer.num_occluders=512"}
    assert added(words) == off
    renderer = compose("train", words)["renderer"]
    assert (renderer["unseen_ground"], renderer["far_pixels"], renderer["num_occluders"]) == (False, False, 512)


def test_what_is_asked_for_now_counts(tmp_path: Path) -> None:
    folder = run_of_an_older_version(tmp_path / "run", without=LATER[:2])

    words = resumed_overrides([f"resume={folder}", "renderer.unseen_ground=true"])

    assert added(words) == {"renderer.unseen_ground=true", "renderer.far_pixels=false"}


def test_a_run_without_scenery_needs_none(tmp_path: Path) -> None:
    folder = run_of_an_older_version(tmp_path / "run", "scenery=false", without=LATER)

    assert added(resumed_overrides([f"resume={folder}"])) == {"scenery=false"}


def test_a_section_that_is_given_counts_as_its_settings(tmp_path: Path) -> None:
    folder = run_of_an_older_version(tmp_path / "run", without=LATER[:2])

    words = resumed_overrides([f"resume={folder}", "renderer={far_pixels: true}"])

    assert added(words) == {"renderer={far_pixels: true}"}


@pytest.mark.parametrize("last", [2, 11])
def test_what_it_was_last_resumed_with_counts(tmp_path: Path, last: int) -> None:
    """Resumed by a version in between, a run has the settings of that."""
    folder = run_of_an_older_version(tmp_path / "run", without=LATER[:2])
    between = run_of_an_older_version(tmp_path / "between", without=LATER[:1])
    (between / "config.yaml").rename(folder / f"config.resumed-{last}.yaml")
    (folder / "config.resumed-1.yaml").write_text((folder / "config.yaml").read_text())

    assert added(resumed_overrides([f"resume={folder}"])) == {"renderer.unseen_ground=false"}


@pytest.mark.parametrize("is_readable", [True, False])
def test_a_run_of_today_is_composed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_readable: bool) -> None:
    folder = run_of_an_older_version(tmp_path / "run", without=())
    if not is_readable:
        (folder / "config.yaml").write_text("{")
    monkeypatch.setattr("vpd_lightning.config.compose", None)

    assert added(resumed_overrides([f"resume={folder}"])) == set()
