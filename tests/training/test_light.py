"""Fitting the light of a whole simulator to recordings, as vpd-train does before its first update."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tests.evaluation.tossed_box import write_tossed_boxes
from vpd_lightning.config import build_simulator, compose
from vpd_lightning.data.frames import TrajectoryFrames
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.errors import ConfigError, DataError
from vpd_lightning.renderer import light_fit
from vpd_lightning.runs import training_run
from vpd_lightning.simulator import Simulator
from vpd_lightning.training.callbacks.time_budget import TimeBudget
from vpd_lightning.training.light import fit_light_of

NUM_PAIRS, NUM_UPDATES = 3, 2
WORKSPACE = ("scene.workspace_min=[-9,-9,-9]", "scene.workspace_max=[9,9,9]")


@pytest.fixture(scope="module")
def trajectories(tmp_path_factory: pytest.TempPathFactory) -> list[TrajectoryFrames]:
    folder = write_tossed_boxes(tmp_path_factory.mktemp("tossed_boxes"))
    return [TrajectoryFrames(path, use_cache=True) for path in load_manifest(folder).split("train")]


def simulator(*words: str) -> Simulator:
    torch.manual_seed(0)
    words = ("experiment=tiny", "model=inertial", "budget=tiny", "run.folder=unused", *WORKSPACE, *words)
    config = compose("train", list(words))
    built = build_simulator(config)
    assert isinstance(built, Simulator)
    return built


def fit(
    system: object, trajectories: list[TrajectoryFrames], num_pairs: int = NUM_PAIRS, seed: int = 0
) -> float | None:
    return fit_light_of(system, trajectories, [0, 1], seed, num_pairs, NUM_UPDATES)


def weights(system: Simulator) -> dict[str, np.ndarray]:
    return {name: value.detach().numpy().copy() for name, value in system.state_dict().items()}


class Darkening:
    """A recording whose later frames are half as bright on their left: a shadow that comes."""

    def __init__(self, trajectory: TrajectoryFrames) -> None:
        self.inner = trajectory

    def __getattr__(self, name: str) -> object:
        return getattr(self.inner, name)

    def rgb(self, times: list[int], views: list[int]) -> np.ndarray:
        images = self.inner.rgb(times, views).copy()
        for index, time in enumerate(times):
            if time > self.inner.num_frames // 2:
                images[index, :, :, : images.shape[3] // 2] //= 2
        return images


@pytest.fixture
def any_fit_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two updates explain nothing."""
    monkeypatch.setattr(light_fit, "USEFUL", 10.0)


@pytest.mark.usefixtures("any_fit_is_kept")
def test_lights_are_fitted_and_nothing_else_is_touched(trajectories: list[TrajectoryFrames]) -> None:
    system = simulator()
    before = weights(system)
    left = fit(system, [Darkening(one) for one in trajectories], num_pairs=8)
    assert left is not None and 0 <= left < 2
    changed = {name for name, value in weights(system).items() if not np.array_equal(value, before[name])}
    assert changed and all(name.startswith("renderer.shadows.") for name in changed)
    assert all(weight.requires_grad for weight in system.renderer.parameters()), "they go on learning"


@pytest.mark.usefixtures("any_fit_is_kept")
def test_the_seed_decides(trajectories: list[TrajectoryFrames]) -> None:
    found = []
    for seed in (0, 0, 1):
        system = simulator()
        fit(system, [Darkening(one) for one in trajectories], num_pairs=8, seed=seed)
        found.append(weights(system)["renderer.shadows.directions"])
    np.testing.assert_array_equal(found[0], found[1])
    assert not np.array_equal(found[0], found[2])


@pytest.mark.parametrize("words", [("scenery=false",), ("renderer.num_lights=0",)])
def test_what_has_no_lights_is_left_alone(words: tuple[str, ...], trajectories: list[TrajectoryFrames]) -> None:
    system = simulator(*words)
    before = weights(system)
    assert fit(system, trajectories) is None and fit(torch.nn.Linear(1, 1), trajectories) is None
    assert all(np.array_equal(value, before[name]) for name, value in weights(system).items())


def test_frozen_lights_stay(trajectories: list[TrajectoryFrames]) -> None:
    system = simulator()
    system.renderer.requires_grad_(False)
    before = weights(system)
    assert fit(system, [Darkening(one) for one in trajectories], num_pairs=8) is None
    assert all(np.array_equal(value, before[name]) for name, value in weights(system).items())


def test_frames_without_depth_are_passed_by(trajectories: list[TrajectoryFrames]) -> None:
    class Blind(Darkening):
        def depth(self, times: list[int], views: list[int]) -> np.ndarray:
            return np.zeros_like(self.inner.depth(times, views))

    assert fit(simulator(), [Blind(one) for one in trajectories]) is None


def test_a_view_that_is_not_there_is_named(trajectories: list[TrajectoryFrames]) -> None:
    with pytest.raises(DataError, match="view 7 is asked for"):
        fit_light_of(simulator(), trajectories, [0, 7], 0, NUM_PAIRS, NUM_UPDATES)


def test_a_fit_that_takes_all_the_time_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training_run, "fit_light_of", lambda *_, **__: None)
    clock = TimeBudget(minutes=1.0, clock="cpu")
    times = iter([100.0, 161.0])
    monkeypatch.setattr(clock, "now", lambda: next(times))
    data = SimpleNamespace(trajectories=[], input_views=[0])
    config = {"seed": 3, "light_fit": {"num_pairs": 4, "num_updates": 5}}
    with pytest.raises(ConfigError, match="took 61 s, all of .*minutes=1"):
        training_run._fit_light(simulator(), data, [clock], config)


def test_the_time_it_takes_is_the_training_s(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[str, object] = {}
    monkeypatch.setattr(training_run, "fit_light_of", lambda *_, **words: asked.update(words))
    clock = TimeBudget(minutes=5.0, clock="cpu")
    clock.seconds = 2.0
    times = iter([100.0, 107.5])
    monkeypatch.setattr(clock, "now", lambda: next(times))
    data = SimpleNamespace(trajectories=[], input_views=[0])
    config = {"seed": 3, "light_fit": {"num_pairs": 4, "num_updates": 5}}
    training_run._fit_light(simulator(), data, [clock], config)
    assert clock.seconds == 9.5 and asked == {"num_pairs": 4, "num_updates": 5}


def test_where_there_are_no_lights_its_settings_are_refused() -> None:
    for words in (["scenery=false"], ["renderer.num_lights=0"]):
        with pytest.raises(ConfigError, match="light_fit.num_pairs has no effect here: renderer.num_lights is 0"):
            compose("train", ["experiment=demo", "run.folder=unused", "light_fit.num_pairs=7", *words])


def test_too_few_pairs_are_refused(trajectories: list[TrajectoryFrames]) -> None:
    with pytest.raises(ConfigError, match="(?s)num_pairs=0.*light_fit.num_pairs=0"):
        fit(simulator(), trajectories, num_pairs=0)
