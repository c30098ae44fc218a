"""What is put together for a model at a size, from which files, and in which order."""

import functools
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from hydra.core.global_hydra import GlobalHydra
from hydra.types import RunMode

from vpd_lightning.config import compose, config_folder
from vpd_lightning.config.composing import initialized, prepare
from vpd_lightning.config.resolvers import find_recipe, look_up
from vpd_lightning.errors import ConfigError

CONF = config_folder()
MODELS = sorted(path.stem for path in (CONF / "model").glob("*.yaml"))
SIZES = sorted(path.stem for path in (CONF / "size").glob("*.yaml"))
PLACED = ("data.folder=nowhere", "run.folder=nowhere")


def files_behind(*words: str) -> list[Path]:
    """The YAML files of ours that a configuration is put together from."""
    prepare()
    with initialized(words, None) as all_words:
        composed = GlobalHydra.instance().config_loader().compute_defaults_list("train", all_words, RunMode.RUN)
    paths = [CONF / f"{default.config_path}.yaml" for default in composed.defaults]
    return [path for path in dict.fromkeys(paths) if path.is_file()]


@functools.cache
def lines_of(path: Path) -> tuple[tuple[bool, str, str], ...]:
    """The defaults list of a file: whether a line is an override, its group, its option."""
    found = (yaml.safe_load(path.read_text()) or {}).get("defaults", [])
    pairs = [next(iter(line.items())) for line in found if isinstance(line, dict)]
    return tuple(("override" in key.split(), key.split()[-1].lstrip("/"), str(option)) for key, option in pairs)


def chosen_by(group: str) -> set[str]:
    """The groups that files of a group choose an option of; ``@`` names a place, not a choice."""
    files = sorted((CONF / group).rglob("*.yaml"))
    return {name for path in files for is_override, name, _ in lines_of(path) if is_override and "@" not in name}


def consumed(option: str) -> set[str]:
    return set(re.findall(r"\$\{(\w+)\}", option))


def test_slotformer_within_minutes_is_made_of_few_files_and_none_is_empty() -> None:
    files = files_behind("model=slotformer", "budget=minutes")

    assert len(files) <= 18, files
    assert not [path for path in files if not yaml.safe_load(path.read_text())]


def test_no_line_uses_a_choice_that_a_later_line_changes() -> None:
    lines = [(name, option) for is_override, name, option in lines_of(CONF / "train.yaml") if not is_override]
    using = [(number, consumed(option)) for number, (_, option) in enumerate(lines) if consumed(option)]

    assert using  # the recipe, at least
    for number, groups in using:
        assert groups <= {name for name, _ in lines[:number]}
        assert not groups & {name for later, _ in lines[number + 1 :] for name in chosen_by(later)}


def test_a_choice_by_size_is_made_where_the_size_is_settled() -> None:
    """A model's file may say `${size}` of a stage: the stages are the recipe's, which stands behind all that choose."""
    order = [name for _, name, _ in lines_of(CONF / "train.yaml")]
    by_size = {name for model in MODELS for _, name, option in lines_of(CONF / "model" / f"{model}.yaml")
               if consumed(option)}  # fmt: skip

    assert by_size and by_size <= {"encoder", "dynamics", "renderer"}
    assert not by_size & set(order)
    assert order.index("recipe") > max(order.index(name) for name in ("size", "model", "experiment", "budget"))


@pytest.mark.parametrize("size", SIZES)
def test_a_model_without_a_recipe_of_its_own_gets_the_one_of_all(size: str) -> None:
    assert find_recipe([CONF], size, "vpd") == f"{size}/default"
    assert find_recipe([CONF], size, "slotformer") == f"{size}/slotformer"


def test_no_recipe_is_for_a_model_that_is_not_there() -> None:
    assert {path.stem for path in (CONF / "recipe").rglob("*.yaml")} <= {"default", *MODELS}
    assert {path.name for path in (CONF / "recipe").iterdir()} == set(SIZES)


@pytest.mark.parametrize("size", SIZES)
def test_the_size_is_recorded_and_can_be_given(size: str) -> None:
    assert compose("train", [f"size={size}", *PLACED])["size"] == size


def test_a_table_has_a_default() -> None:
    assert [look_up(key, {"small": 32}, 128) for key in ("small", "tiny")] == [32, 128]


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """A folder of options of one's own, with a model and its recipe."""
    contents: dict[str, dict[str, Any]] = {
        "model/mine.yaml": {"defaults": ["vpd", "_self_"], "system": "mine"},
        "recipe/small/mine.yaml": {
            "defaults": ["/recipe/small/default", "_self_"],
            "data": {"batch_size": 3},
        },
        "experiment/shelf.yaml": {
            "defaults": [{"override /scene": "kubric"}, {"override /dynamics": "persistence"}],
            "experiment": "shelf",
            "data": {"folder": "shelf"},
        },
    }
    for name, content in contents.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("# @package _global_\n" + yaml.safe_dump(content))
    return tmp_path


def test_a_model_of_ones_own_is_one_file_and_may_have_a_recipe(lab: Path) -> None:
    full = compose("train", ["model=mine", *PLACED], lab)
    small = compose("train", ["model=mine", "budget=minutes", "experiment=movi_a", *PLACED], lab)

    assert full["system"] == small["system"] == "mine"
    assert full["encoder"]["num_particles"] == 16384
    assert small["encoder"]["num_particles"] == 1024
    assert small["data"]["batch_size"] == 3


def test_an_experiment_of_ones_own_chooses_a_stage_at_every_size(lab: Path) -> None:
    for budget in ("paper", "minutes"):
        config = compose("train", ["experiment=shelf", f"budget={budget}", "run.folder=nowhere"], lab)

        assert config["scene"]["name"] == "kubric"
        assert config["dynamics"] == {"_target_": "vpd_lightning.dynamics.persistence.PersistenceDynamics"}


def test_the_words_of_a_person_win_over_model_and_size() -> None:
    words = ["renderer=splat", "dynamics=inertial", "model=vpd", "experiment=movi_a", "budget=minutes", *PLACED]
    forward, backward = compose("train", words), compose("train", words[::-1])

    assert forward == backward
    assert forward["renderer"]["_target_"].endswith("SplatRenderer")
    assert forward["dynamics"]["_target_"].endswith("InertialDynamics")
    assert forward["data"]["batch_size"] == 4


def test_a_schedule_on_the_command_line_replaces_that_of_the_recipe_whole() -> None:
    words = ["model=vpd_staged", "budget=hour", "experiment=mujoco_block"]
    assert set(compose("train", words)["data"]["num_steps_schedule"]) == {0.0, 0.3, 0.75}
    config = compose("train", [*words, "data.num_steps_schedule={0.0:2,0.5:[1,8]}"])
    assert config["data"]["num_steps_schedule"] == {0.0: 2, 0.5: [1, 8]}


def test_settings_of_a_stage_in_an_experiment_of_ones_own_are_refused(lab: Path) -> None:
    path = lab / "experiment" / "shelf.yaml"
    path.write_text(path.read_text() + "encoder:\n  num_particles: 77\n")

    with pytest.raises(ConfigError, match=r"(?s)shelf.yaml sets values of encoder.*encoder/mine.yaml"):
        compose("train", ["experiment=shelf", "run.folder=nowhere"], lab)


@pytest.mark.parametrize("group", ["stages", "tuning", "per_scene", "spacing"])
def test_a_group_that_is_no_more_is_refused_in_a_folder_of_ones_own(group: str, tmp_path: Path) -> None:
    (tmp_path / group).mkdir()

    with pytest.raises(ConfigError, match=rf"(?s){group} would have no effect.*recipe/SIZE/MODEL.yaml"):
        compose("train", PLACED, tmp_path)


def test_no_two_files_share_two_dozen_lines() -> None:
    texts = {
        path: [line.strip() for line in path.read_text().splitlines() if line.strip()] for path in CONF.rglob("*.yaml")
    }
    seen: dict[tuple[str, ...], Path] = {}
    for path, lines in texts.items():
        for start in range(len(lines) - 23):
            run = tuple(lines[start : start + 24])
            assert seen.setdefault(run, path) == path, (path, seen[run], run[0])
