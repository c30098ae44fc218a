"""Lengths that recordings give are near those that were chosen by hand for the same scenes."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.data.recordings import write_recordings
from tests.data_gen.blocks import generate_small
from vpd_lightning.config import compose
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.data.recorded_scene import recorded_scene, recorded_scene_notes
from vpd_lightning.errors import DataError

# Median depth in metres and frame time in seconds of the generated sets, and what conf/scene says of each.
BY_HAND = {"demo": (2.59, 0.05), "mujoco": (1.91, 0.02), "kubric": (8.8, 1 / 24), "deformable": (17.9, 0.04)}
LENGTHS = (
    "surface_scale",
    "location_scale",
    "force_scale",
    "contact_range",
    "max_contact_depth",
    "shadow_scales",
    "r_a_s",
)


@pytest.fixture(scope="module")
def blocks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return generate_small(tmp_path_factory.mktemp("blocks") / "small", **{"camera.num_views": 3})


@pytest.mark.parametrize("scene", BY_HAND)
def test_lengths_are_within_a_factor_of_two_of_those_chosen_by_hand(
    scene: str, blocks: Path, monkeypatch: pytest.MonkeyPatch
):
    """The rule is asked about the distance and frame time of each scene; what it reads from files is tested below."""
    from vpd_lightning.data import recorded_scene as module

    distance, frame_time = BY_HAND[scene]
    real = module._of_file
    monkeypatch.setattr(module, "_of_file", lambda path: real(path) | {"distance": distance, "frame_time": frame_time})
    module._read.cache_clear()
    found, chosen = recorded_scene(blocks), compose("train", [f"scene={scene}", "data.folder=nowhere"])["scene"]
    module._read.cache_clear()

    for name in LENGTHS:
        ratio = np.divide(found[name], chosen[name])
        assert (ratio > 0.5).all() and (ratio < 2.1).all(), (name, ratio)


def test_cameras_and_workspace_are_those_of_the_files(blocks: Path):
    found = recorded_scene(blocks)

    with TrajectoryReader(next((blocks / "train").glob("*.h5"))) as reader:
        assert (found["near"], found["far"]) == (reader.near, reader.far)
        assert found["workspace_min"] == list(reader.workspace_min)
        assert found["workspace_max"] == list(reader.workspace_max)
        assert found["input_views"] == list(range(reader.num_views)) == [0, 1, 2]
    assert found["moving_ray_fraction"] == 0.5


def test_a_configuration_of_recordings_is_that_of_its_files_but_for_what_is_set_by_hand(blocks: Path):
    words = ["experiment=recordings", f"data.folder={blocks}"]
    config, near = compose("train", words), compose("train", [*words, "scene.near=0.123"])
    found = recorded_scene(blocks)

    assert {name: found[name] for name in config["scene"] if name in found} == {
        name: value for name, value in config["scene"].items() if name != "name"
    }
    assert config["data"]["input_views"] == found["input_views"] and config["renderer"]["near"] == found["near"]
    assert near["scene"]["near"] == near["renderer"]["near"] == 0.123
    assert not [line for line in recorded_scene_notes(blocks, config["scene"]) if "by hand" in line]
    assert f"scene.near=0.123 was set by hand; the recordings say {found['near']}" in recorded_scene_notes(
        blocks, near["scene"]
    )


def test_moving_cameras_have_no_moving_rays_and_few_recordings_no_more_validation_than_there_is(tmp_path: Path):
    write_recordings(tmp_path)
    found = recorded_scene(tmp_path)
    files: dict[str, Any] = {name: list((tmp_path / name).glob("*.h5")) for name in ("train", "validation")}

    assert found["num_validation_clips"] == min(4, len(files["validation"]))
    with TrajectoryReader(files["train"][0]) as reader:
        assert found["moving_ray_fraction"] == (0.5 if reader.is_static_cameras else 0.0)
        assert found["num_steps"] == min(8, reader.num_frames - 2)


def test_a_folder_without_a_data_set_says_nothing_and_composes(blocks: Path, tmp_path: Path):
    assert recorded_scene(tmp_path) == {} and recorded_scene_notes(tmp_path, {}) == []
    assert compose("train", ["experiment=recordings", f"data.folder={tmp_path}"])["scene"]["near"] == 0.3
    shutil.copytree(blocks, tmp_path / "now")
    assert recorded_scene(tmp_path / "now")


def test_a_damaged_data_set_is_named(tmp_path: Path):
    (tmp_path / "dataset.json").write_text("{")

    with pytest.raises(DataError, match="dataset.json"):
        compose("train", ["experiment=recordings", f"data.folder={tmp_path}"])
