"""``--why KEY``: every place that set a key, in order, and what won."""

import re
from pathlib import Path

import pytest

from vpd_lightning.commands import render, train
from vpd_lightning.config.why import explain_key
from vpd_lightning.errors import ConfigError


def blocks(key: str, *words: str, command: str = "train", config_dir: Path | None = None) -> dict[str, list[str]]:
    """What is printed: by its first line, the lines below it without the columns' blanks."""
    parts = explain_key(command, key, words, config_dir).split("\n\n")
    found = [part.splitlines() for part in parts]
    return {lines[0]: [re.sub(r" {2,}", " ", line.strip()) for line in lines[1:]] for lines in found}


def places(lines: list[str]) -> list[str]:
    return [re.sub(r":\d+$", "", line.split()[0]) for line in lines]


def test_a_value_is_followed_through_files_to_the_command_line() -> None:
    found = blocks("optimizer.lr", "model=slotformer", "budget=minutes", "optimizer.lr=0.5")

    lines = found["optimizer.lr = 0.5"]
    assert places(lines[:-1]) == ["conf/optimizer/adam_cosine.yaml", "conf/recipe/small/slotformer.yaml"]
    assert lines[-1] == "command line 0.5 <- wins"


def test_a_place_is_a_line_of_its_file() -> None:
    found = blocks("optimizer.lr", "model=slotformer", "budget=minutes")

    for line in found["optimizer.lr = 0.001"]:
        name, number = line.split()[0].rsplit(":", 1)
        path = Path(__file__).parents[2] / name
        assert "lr: 1e-3" in path.read_text().splitlines()[int(number) - 1]


def test_who_chose_the_option_of_a_section_is_told_and_the_last_one_wins() -> None:
    found = blocks("optimizer.lr", "model=slotformer", "budget=minutes")

    lines = found["optimizer is adam_cosine"]
    assert places(lines) == ["conf/train.yaml", "conf/model/slotformer.yaml", "conf/budget/minutes.yaml"]
    assert [line.split()[1] for line in lines] == ["adam_paper", "adam_slotformer", "adam_cosine"]
    assert lines[-1].endswith("<- wins")


def test_an_option_given_on_the_command_line_wins() -> None:
    found = blocks("renderer", "model=vpd", "budget=minutes", "renderer=splat")

    assert found["renderer is splat"][-1] == "command line splat <- wins"


def test_a_stage_that_depends_on_the_size_leads_to_the_budget() -> None:
    found = blocks("encoder.channels", "model=vpd_predicted_depth", "budget=minutes")

    assert "${vpd_lookup:${size}" in found["encoder is unet_depth_small"][-1]
    assert places(found["size is small"])[-1] == "conf/budget/minutes.yaml"


def test_an_expression_is_shown_with_its_value_and_with_what_it_refers_to() -> None:
    found = blocks("dynamics.r_s", "budget=minutes", "scene.r_s=0.4")

    assert found["dynamics.r_s = 0.4"][-1].split()[1] == "${scene.r_s}"
    assert found["scene.r_s = 0.4"][-1] == "command line 0.4 <- wins"


def test_a_section_that_was_null_and_is_set_whole_is_told_of() -> None:
    found = blocks("pretraining.share", "model=slotformer")

    lines = found["pretraining.share = 0.5"]
    assert "null (as pretraining)" in lines[0]
    assert places(lines)[-1] == "conf/model/slotformer.yaml"


def test_a_section_shows_what_each_file_adds_to_it() -> None:
    found = blocks("callbacks.time_budget", "budget=hour")

    (title,) = [title for title in found if title.startswith("callbacks.time_budget = {")]
    assert "minutes: 60, clock: cpu" in title
    assert places(found[title])[1:] == ["conf/budget/minutes.yaml", "conf/budget/hour.yaml"]


def test_a_section_that_a_word_sets_whole_is_told_of() -> None:
    found = blocks(
        "optimizer.stage_multipliers.encoder", "experiment=demo", "optimizer={stage_multipliers:{encoder:2}}"
    )

    assert found["optimizer.stage_multipliers.encoder = 2"][-1] == "command line 2 <- wins"


def test_a_value_that_needs_the_run_is_shown_as_the_expression() -> None:
    assert "run.folder = null" in blocks("trainer.default_root_dir")


def test_a_key_of_another_command_and_of_a_folder_of_ones_own_are_explained(tmp_path: Path) -> None:
    assert places(blocks("fps", "ckpt=a", command="render")["fps = 10.0"]) == ["conf/render.yaml"]
    (tmp_path / "encoder").mkdir()
    (tmp_path / "encoder" / "mine.yaml").write_text("defaults: [unet_small, _self_]\nnum_particles: 77\n")

    found = blocks("encoder.num_particles", "encoder=mine", config_dir=tmp_path)

    assert places(found["encoder.num_particles = 77"])[-1] == str(tmp_path / "encoder" / "mine.yaml")


def test_a_key_that_is_not_there_is_refused_with_a_guess() -> None:
    with pytest.raises(ConfigError, match=r"there is no key optimiser.lr.\nDid you mean optimizer.lr\?"):
        explain_key("train", "optimiser.lr", [])


def test_the_commands_answer_and_do_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)

    assert train.main(["--why", "optimizer.lr", "experiment=demo"]) == 0
    assert render.main(["ckpt=a", "--why=fps"]) == 0
    assert train.main(["--why"]) == 2
    captured = capsys.readouterr()
    assert "conf/experiment/demo.yaml" in captured.out and "conf/render.yaml" in captured.out
    assert "--why needs a key" in captured.err
    assert not list(tmp_path.iterdir())
