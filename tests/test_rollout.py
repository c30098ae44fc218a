"""Rollouts taken one step at a time: the same bits as all at once, and nothing is changed by going on."""

from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch

import vpd_lightning as vpd
from tests.evaluation.tossed_box import write_tossed_boxes
from tests.evaluation.untrained_model import write_untrained
from vpd_lightning.data.clip import read_clip
from vpd_lightning.evaluation.prediction import encode_clip
from vpd_lightning.simulator import Scene, Simulator

NUM_STEPS = 5
RELEASED = Path(__file__).parents[1] / "released" / "mujoco_block_demo"


@pytest.fixture(scope="module", params=["inertial, which remembers", "graph network", "sleeping graph network"])
def model_and_scene(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Simulator, Scene]:
    folder = tmp_path_factory.mktemp("rollout")
    data = write_tossed_boxes(folder / "data", num_train=1, num_test=1)
    path: Path = RELEASED
    if request.param != "inertial, which remembers":
        dynamics = "sleeping_small" if "sleeping" in request.param else "hierarchical_gnn_small"
        path = write_untrained(folder / "run", data, f"dynamics={dynamics}")
    simulator = vpd.load(path)
    clip = read_clip(data / "test" / "000000.h5", 0, 0, num_steps=0, with_state=False)
    return simulator, encode_clip(simulator, clip, [0, 1])


def tensors(value: Any) -> list[torch.Tensor]:
    """All tensors of nested dataclasses, in order."""
    if isinstance(value, torch.Tensor):
        return [value]
    if is_dataclass(value):
        return [tensor for field in fields(value) for tensor in tensors(getattr(value, field.name))]
    return [tensor for item in value for tensor in tensors(item)] if isinstance(value, list | tuple) else []


def same(one: Any, other: Any) -> bool:
    pairs = list(zip(tensors(one), tensors(other), strict=True))
    return bool(pairs) and all(torch.equal(a, b) for a, b in pairs)


def test_single_steps_are_those_of_a_rollout(model_and_scene: tuple[Simulator, Scene]) -> None:
    simulator, scene = model_and_scene
    moment = simulator.start(scene)
    assert same(moment.particles, scene.current) and moment.num_steps == 0
    for number, state in enumerate(simulator.rollout(scene, NUM_STEPS), start=1):
        before = moment
        moment = moment.step()
        assert moment.num_steps == number and same(moment.previous, before.particles)
        assert same(moment.particles, state)
    first = replace(scene.current, pixels=None, pictures=None)
    assert not same(moment.particles, first), "something must move, or this shows nothing"


def test_two_plans_may_go_on_from_one_moment(model_and_scene: tuple[Simulator, Scene]) -> None:
    simulator, scene = model_and_scene
    moment = simulator.start(scene).step()
    kept = [tensor.clone() for tensor in tensors((moment.previous, moment.particles, moment.memory))]
    expected = moment.step().step()
    pushed = replace(moment.particles, positions=moment.particles.positions + torch.tensor([0.1, 0.0, 0.0]))
    replace(moment, particles=pushed).step().step()
    assert same(moment.step().step(), expected)
    assert same([moment.previous, moment.particles, moment.memory], kept)


def test_steps_keep_no_gradients(model_and_scene: tuple[Simulator, Scene]) -> None:
    simulator, scene = model_and_scene
    simulator.train()
    moment = simulator.start(scene).step()
    assert not simulator.training and not moment.particles.positions.requires_grad
