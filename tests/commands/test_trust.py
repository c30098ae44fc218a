"""What may be trained on, and what may be called new: splits, mistyped folders, unvalidated sets, copies."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from data_gen.inspection.split import split_dataset
from tests.data.recordings import write_dataset_file
from vpd_lightning.commands import data, eval, export, train
from vpd_lightning.data.manifest import load_manifest, write_manifest
from vpd_lightning.data.trained_on import TRAINED_ON
from vpd_lightning.data.verdict import FILE_NAME as VERDICT
from vpd_lightning.training.checkpoint_files import load_checkpoint

Fails = Callable[..., str]
EVALUATION = ["num_videos=0", "protocol.num_long_steps=0", "num_threads=1"]


@pytest.fixture
def copied(dataset: Path, in_folder: Path) -> Path:
    """The data set of the training, to be changed."""
    return Path(shutil.copytree(dataset, in_folder / "copied"))


def as_recordings(folder: Path) -> Path:
    """Let a data set be one that another program made."""
    content = json.loads((folder / "dataset.json").read_text())
    (folder / "dataset.json").write_text(json.dumps({**content, "generator": "vpd-data import, format plain"}))
    return folder


def figures(run: Path, name: str) -> dict:
    return json.loads((run / name / "metrics.json").read_text())


@pytest.fixture
def run(trained: Path, in_folder: Path) -> Path:
    return Path(shutil.copytree(trained, in_folder / "run"))


# -- what was trained on ----------------------------------------------------------------------------------------------


def test_a_checkpoint_names_the_trajectories_it_was_trained_on(run: Path, dataset: Path) -> None:
    manifest = load_manifest(dataset)
    stored = load_checkpoint(run / "checkpoints" / "last.ckpt")[TRAINED_ON]
    assert stored == sorted(manifest.checksums(manifest.split("train")))


def test_new_trajectories_are_called_new(run: Path, dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert eval.main([f"ckpt={run}", *EVALUATION]) == 0
    count = len(load_manifest(dataset).split("test"))
    assert figures(run, "evaluation")["seen_in_training"] == {"trajectories": 0, "of": count}
    assert "rained on" not in capsys.readouterr().out
    assert export.main([f"ckpt={run}", "out=given"]) == 0
    assert f"{count} trajectories that no training saw" in Path("given/README.md").read_text()
    index = json.loads(Path("given/release.json").read_text())
    assert index[TRAINED_ON] == load_checkpoint(run / "checkpoints" / "last.ckpt")[TRAINED_ON]


def test_a_division_after_the_training_is_noticed(run: Path, copied: Path, fails: Fails) -> None:
    before = load_manifest(copied).digest
    split_dataset(copied, train=1, test=2, seed=3)
    assert load_manifest(copied).digest != before
    message = fails(eval.main, [f"ckpt={run}", f"data.folder={copied}", *EVALUATION], 3)
    assert "of split test were trained on" in message and "dataset.json.bak" in message and "force=true" in message


def test_a_renamed_copy_is_the_same_trajectory(run: Path, dataset: Path, in_folder: Path, fails: Fails) -> None:
    other = in_folder / "other"
    splits: dict[str, list[Path]] = {}
    for split, source, name in (("train", "validation", "a.h5"), ("test", "train", "never_seen.h5")):
        splits[split] = [other / split / name]
        splits[split][0].parent.mkdir(parents=True)
        shutil.copy(load_manifest(dataset).split(source)[0], splits[split][0])
    write_dataset_file(other, splits)
    message = fails(eval.main, [f"ckpt={run}", f"data.folder={other}", *EVALUATION], 3)
    assert "1 of the 1 trajectories of split test were trained on, first test/never_seen.h5" in message


def test_what_was_trained_on_is_evaluated_on_purpose_and_marked(
    run: Path, copied: Path, fails: Fails, capsys: pytest.CaptureFixture[str]
) -> None:
    assert eval.main([f"ckpt={run}", "protocol.split=train", *EVALUATION]) == 0
    found = figures(run, "evaluation_train")["seen_in_training"]
    assert found["trajectories"] == found["of"] > 0
    mark = f"TRAINED ON: {found['of']} of these {found['of']} trajectories"
    assert mark in capsys.readouterr().out
    assert mark in (run / "evaluation_train" / "index.html").read_text()

    split_dataset(copied, train=1, test=2, seed=3)
    assert eval.main([f"ckpt={run}", f"data.folder={copied}", "force=true", *EVALUATION]) == 0
    assert figures(run, "evaluation")["seen_in_training"]["trajectories"] > 0
    assert "TRAINED ON" in capsys.readouterr().out
    message = fails(export.main, [f"ckpt={run}", "out=given"], 2)
    assert "were trained on" in message


def test_a_checkpoint_that_does_not_say_is_not_vouched_for(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("vpd_lightning.loading._checksums", lambda stored: None)
    assert eval.main([f"ckpt={run}", *EVALUATION]) == 0
    assert figures(run, "evaluation")["seen_in_training"]["trajectories"] is None
    assert "is not known" in capsys.readouterr().out
    assert export.main([f"ckpt={run}", "out=given"]) == 0
    card = Path("given/README.md").read_text()
    assert "no training saw" not in card and "is unknown" in card
    assert json.loads(Path("given/release.json").read_text())[TRAINED_ON] is None


def test_a_released_model_remembers_as_well(run: Path, copied: Path, fails: Fails) -> None:
    assert eval.main([f"ckpt={run}", *EVALUATION]) == export.main([f"ckpt={run}", "out=given"]) == 0
    split_dataset(copied, train=1, test=2, seed=3)
    message = fails(eval.main, ["ckpt=given", f"data.folder={copied}", "out=here", *EVALUATION], 3)
    assert "were trained on" in message


# -- folders that are given by name -----------------------------------------------------------------------------------


def test_a_mistyped_folder_is_not_filled(copied: Path, quick: list[str], fails: Fails) -> None:
    words = [word for word in quick if not word.startswith("data.folder=")]
    assert "generate.when_missing=true" not in words
    message = fails(train.main, [*words, "data.folder=copid"], 3)
    assert "Did you mean copied?" in message
    assert "vpd-data generate scene=mujoco_block preset=tiny out=copid" in message
    assert "generate.when_missing=true" in message


@pytest.mark.parametrize("words", [["data.folder=made", "generate.when_missing=true"], []])
def test_a_folder_is_filled_where_it_is_the_experiments_own_or_that_is_asked_for(
    in_folder: Path, quick: list[str], monkeypatch: pytest.MonkeyPatch, words: list[str]
) -> None:
    made: list[Path] = []

    def generate(*, scene: str, preset: str, out: Path, seed: int) -> None:
        made.append(Path(out))
        raise KeyboardInterrupt  # what comes then is tested elsewhere

    monkeypatch.setattr("data_gen.generate.generate", generate)
    train.main([*(word for word in quick if not word.startswith("data.folder=")), *words])
    assert made == [Path("made" if words else "datasets/mujoco_block_tiny")]


def test_an_evaluation_fills_no_folder_that_the_training_was_given(run: Path, dataset: Path, fails: Fails) -> None:
    gone = dataset.rename(dataset.with_name("elsewhere"))
    try:
        message = fails(eval.main, [f"ckpt={run}", *EVALUATION], 3)
    finally:
        gone.rename(dataset)
    assert "given by name" in message and f"out={dataset}" in message


# -- data sets that nobody should learn from --------------------------------------------------------------------------


def test_recordings_that_nobody_validated_are_not_trained_on(copied: Path, quick: list[str], fails: Fails) -> None:
    words = [*quick, f"data.folder={as_recordings(copied)}"]
    message = fails(train.main, words, 3)
    assert f"vpd-data validate {copied}" in message and "force=true" in message

    assert data.main(["validate", str(copied)]) == 0
    split_dataset(copied, validation=2, test=2)  # the same files
    assert train.main([*words, "run.folder=good"]) == 0


def test_recordings_that_failed_are_not_trained_on(
    copied: Path, quick: list[str], fails: Fails, capsys: pytest.CaptureFixture[str]
) -> None:
    manifest = load_manifest(copied)
    write_manifest(replace(manifest, sha256={**manifest.sha256, "train/000000.h5": "0" * 64}))
    assert data.main(["validate", str(copied)]) == 3
    capsys.readouterr()
    words = [*quick, f"data.folder={copied}"]
    message = fails(train.main, words, 3)
    assert "failed vpd-data validate with" in message and "First: fault " in message and "force=true" in message

    assert train.main([*words, "run.folder=forced", "force=true"]) == 0

    content = json.loads((copied / VERDICT).read_text())
    (copied / VERDICT).write_text(json.dumps({**content, "files_digest": "of other files"}))
    assert train.main([*words, "run.folder=other"]) == 0, "a verdict on other files says nothing of these"


def test_one_trajectory_in_two_splits_is_refused_and_can_be_divided(
    copied: Path, quick: list[str], fails: Fails
) -> None:
    shutil.copy(copied / "train" / "000000.h5", copied / "test" / "again.h5")
    manifest = load_manifest(copied)
    path = copied / "test" / "again.h5"
    manifest.splits["test"].append(path)
    manifest.sha256["test/again.h5"] = manifest.sha256["train/000000.h5"]
    manifest.num_bytes["test/again.h5"] = path.stat().st_size
    write_manifest(manifest)
    message = fails(train.main, [*quick, f"data.folder={copied}"], 3)
    assert "train/000000.h5 and test/again.h5 hold the same bytes" in message
    for seed in range(4):
        split_dataset(copied, train=0.5, validation=0.2, test=0.3, seed=seed)
        assert not load_manifest(copied).repeated()
