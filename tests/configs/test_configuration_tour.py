"""The commands of docs/configuration.md compose, and what the page says of them is so."""

import re
import shlex
from pathlib import Path

import pytest
import yaml

from vpd_lightning.commands.hydra_application import parse_arguments
from vpd_lightning.config import compose, config_folder
from vpd_lightning.config.why import explain_key
from vpd_lightning.errors import ConfigError

PAGE = (Path(__file__).parents[2] / "docs" / "configuration.md").read_text()
BLOCKS = re.findall(r"^```\n(.*?)^```", PAGE, re.M | re.S)
COMMANDS = [line for block in BLOCKS for line in block.splitlines() if line.startswith("vpd-")]


@pytest.mark.parametrize("line", COMMANDS)
def test_command_composes(line: str) -> None:
    command, *words = shlex.split(line)
    arguments = parse_arguments(words)
    root = command.removeprefix("vpd-")

    assert compose(root, arguments.overrides)
    if arguments.why is not None:
        assert explain_key(root, arguments.why, arguments.overrides)


def test_the_list_is_that_of_the_root() -> None:
    shown = next(block for block in BLOCKS if block.startswith("defaults:\n  - train_schema"))

    assert yaml.safe_load(shown)["defaults"] == yaml.safe_load((config_folder() / "train.yaml").read_text())["defaults"]


def test_the_answer_that_is_shown_is_the_one_that_is_given() -> None:
    line = next(line for line in COMMANDS if line.endswith("--why optimizer.lr"))
    arguments = parse_arguments(shlex.split(line)[1:])
    shown = next(block for block in BLOCKS if block.startswith("optimizer.lr = "))

    assert explain_key("train", "optimizer.lr", arguments.overrides) == shown.rstrip("\n")


def test_the_refusal_that_is_shown_is_the_one_that_is_given() -> None:
    line, *printed = next(block for block in BLOCKS if block.startswith("$ ")).splitlines()

    with pytest.raises(ConfigError) as refusal:
        compose("train", shlex.split(line.removeprefix("$ vpd-train ")))

    assert [word.removeprefix("error:").strip() for word in printed] == str(refusal.value).splitlines()


def test_files_that_are_named_are_there() -> None:
    named = re.findall(r"`((?:conf|src)/[\w/.]+)`", PAGE)

    assert len(named) > 5
    assert not [name for name in named if not (Path(__file__).parents[2] / name).is_file()]


def test_a_line_of_a_file_that_is_quoted_is_in_it() -> None:
    for block in BLOCKS:
        for text, path in re.findall(r"^  - (override .*?) +# (conf/\S+)$", block, re.M):
            assert f"  - {text}" in (Path(__file__).parents[2] / path).read_text()
