"""Training on a rented GPU machine: the pack holds the recordings, the state goes on, the weights come home."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

import vpd_lightning
from benchmarks.rented_gpu import __main__ as rented_gpu
from benchmarks.rented_gpu.packing import read_pack
from benchmarks.rented_gpu.progress import Progress, read_progress, write_progress
from benchmarks.rented_gpu.training import Training, build_system
from tests.evaluation.pushed_box import write_pushed_boxes
from vpd_lightning.config import build, compose
from vpd_lightning.config.building import build_simulator
from vpd_lightning.data.frames import TrajectoryFrames
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.errors import CheckpointError

WORDS = [
    "experiment=tiny",
    "model=vpd_staged",
    "encoder.num_particles=64",
    "data.rays_per_step=16",
    "data.batch_size=2",
]


@pytest.fixture(scope="module")
def words(dataset: Path) -> list[str]:
    return [*WORDS, f"data.folder={dataset}", "scene.input_views=[0,1]"]


@pytest.fixture(scope="module")
def pack(words: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pack") / "pack.npz"
    assert rented_gpu.main(["pack", "--out", str(path), "--updates", "2,3", "--limit-mib", "4", *words]) == 0
    return path


def train(pack: Path, out: Path, *more: str) -> int:
    return rented_gpu.main(
        ["train", "--pack", str(pack), "--out", str(out), "--device", "cpu", "--workers", "0", *more]
    )


def test_packed_recordings_are_the_recordings(pack: Path, dataset: Path):
    files = load_manifest(dataset).split("train")
    settings, trajectories = read_pack(pack)

    assert len(trajectories) == len(files)
    for path, packed in zip(files, trajectories, strict=True):
        frames = TrajectoryFrames(path, use_cache=False)
        times = range(frames.num_frames)
        assert (packed.num_frames, packed.num_views) == (frames.num_frames, frames.num_views)
        np.testing.assert_array_equal(packed.rgb(times, [0, 1, 2]), frames.rgb(times, [0, 1, 2]))
        np.testing.assert_array_equal(packed.depth(times, [1, 0]), frames.depth(times, [1, 0]))
        for mine, theirs in zip(packed.cameras([2, 0], [1, 2]), frames.cameras([2, 0], [1, 2]), strict=True):
            np.testing.assert_array_equal(mine, theirs)
    assert pack.stat().st_size < sum(path.stat().st_size for path in files) / 2


def test_as_many_trajectories_as_fit_are_packed(pack: Path, words: list[str], tmp_path: Path, capsys):
    whole = pack.stat().st_size / 2**20
    small = tmp_path / "small.npz"

    assert rented_gpu.main(["pack", "--out", str(small), "--updates", "1,1", "--limit-mib", str(whole), *words]) == 0
    assert 0 < len(read_pack(small)[1]) < len(read_pack(pack)[1])
    assert small.stat().st_size <= whole * 2**20

    assert rented_gpu.main(["pack", "--out", str(small), "--updates", "1,1", "--limit-mib", "0.01", *words]) == 1
    assert "Not one trajectory fits" in capsys.readouterr().err


@pytest.mark.parametrize("more", [[], ["data.moving_ray_fraction=0.5", "data.moving_ray_margin=1"]])
def test_clips_and_first_weights_are_those_of_vpd_train(words: list[str], more: list[str], tmp_path: Path):
    from lightning.pytorch import LightningDataModule

    words, pack = [*words, *more], tmp_path / "pack.npz"
    assert rented_gpu.main(["pack", "--out", str(pack), "--updates", "2,3", "--limit-mib", "4", *words]) == 0
    config = compose("train", ["run.folder=unused", *words])
    settings, trajectories = read_pack(pack)
    training = Training(settings["phases"][1:], trajectories, torch.device("cpu"), 0, Progress())
    mine = next(iter(training._batches()))
    theirs = next(iter(build(config["data"], LightningDataModule, "data").loader(max_steps=3)))

    torch.testing.assert_close(mine.context.depth, theirs.context.depth, rtol=0, atol=0)
    torch.testing.assert_close(mine.rays.directions, theirs.rays.directions, rtol=0, atol=0)
    torch.testing.assert_close(mine.rgbs, theirs.rgbs, rtol=0, atol=0)
    own = build_system(settings["phases"][1]).state_dict()
    assert own.keys() == build_simulator(config).state_dict().keys()


def test_training_stops_goes_on_and_comes_home(pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
    state = tmp_path / "state"
    assert train(pack, state, "--minutes", "0") == 0  # no time for an update
    assert (read_progress(state).phase, read_progress(state).step) == (0, 0)

    assert train(pack, state, "--resume", str(state)) == 0
    done = read_progress(state)
    assert done.phase == 2
    curve = json.loads((state / "curve.json").read_text())
    assert {point["phase"] for point in curve} == {0, 1}
    assert "s each)" in capsys.readouterr().out

    run = tmp_path / "run"
    assert rented_gpu.main(["run", "--pack", str(pack), "--state", str(state), "--folder", str(run)]) == 0
    simulator = vpd_lightning.load(run)
    for name, value in simulator.state_dict().items():
        torch.testing.assert_close(value, done.weights[name], rtol=0, atol=0)


def test_time_ends_phases_and_weights_are_averaged(pack: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    settings, trajectories = read_pack(pack)
    phases = [{**phase, "averaging": {"decay": 0.9, "warmup": 2}} for phase in settings["phases"]]
    phases[1]["data"] = {**phases[1]["data"], "num_steps_schedule": {"0.0": 1, "0.5": 2}}
    assert sum(phase["share"] for phase in phases) == pytest.approx(1)
    progress = Progress(seed=3)
    training = Training(phases, trajectories, torch.device("cpu"), 0, progress, seconds_in_all=1000.0)
    monkeypatch.setattr(training, "_count", lambda _, count=training._count: count(60.0))  # an update takes a minute

    averages: list[dict[str, torch.Tensor]] = []

    def next_phase(call=training._next_phase) -> None:
        averages.append({name: value.clone() for name, value in training._average.items()})
        call()

    monkeypatch.setattr(training, "_next_phase", next_phase)

    training.run(float("inf"), tmp_path, 1e9)

    assert training.is_done
    written = read_progress(tmp_path).weights
    for name, value in averages[-1].items():
        torch.testing.assert_close(written[name], value, rtol=1e-4, atol=1e-7)  # kept with 15 bits
    lengths = {point["step"]: point["num_steps"] for point in progress.curve if point["phase"] == 1}
    assert (lengths[1], lengths[10]) == (1, 2)
    assert training.num_taken == sum(math.ceil(1000 * phase["share"] / 60) for phase in phases)
    assert read_progress(tmp_path).seed == 3


def test_state_between_phases_holds_the_average_beside_the_weights(pack: Path, tmp_path: Path):
    settings, trajectories = read_pack(pack)
    phase = settings["phases"][0] | {"averaging": {"decay": 0.999, "warmup": 10}, "updates": 30}
    training = Training([phase], trajectories, torch.device("cpu"), 0, Progress())
    first = {name: value.clone() for name, value in training.system.state_dict().items()}
    for batch, _ in zip(training._batches(), range(20), strict=False):
        training._update(batch)
    training.save(tmp_path)
    kept = read_progress(tmp_path)

    name = max(kept.average, key=lambda one: kept.average[one].numel())
    assert not torch.equal(kept.average[name], first[name])
    assert not torch.equal(kept.average[name], kept.weights[name])
    again = Training([phase], trajectories, torch.device("cpu"), 0, kept)
    average = kept.average[name]
    torch.testing.assert_close(again._average[name], average)
    again._next_phase()
    torch.testing.assert_close(kept.weights[name], average)


def test_training_goes_on_nearly_as_if_it_had_not_stopped(pack: Path, tmp_path: Path):
    settings, trajectories = read_pack(pack)
    phase = settings["phases"][0] | {"updates": 40}

    def trained(stops: int, folder: Path) -> Progress:
        progress = Progress()
        for _ in range(stops):
            training = Training([phase], trajectories, torch.device("cpu"), 0, progress)
            for batch, _ in zip(training._batches(), range(40 // stops), strict=False):
                training._update(batch)
            training.save(folder)
            progress = read_progress(folder)
        return progress

    whole, stopped = trained(1, tmp_path / "whole"), trained(2, tmp_path / "stopped")
    initial = build_system(phase).state_dict()
    moved = {name: whole.weights[name] - value for name, value in initial.items()}
    apart = {name: stopped.weights[name] - whole.weights[name] for name in initial}
    ratio = sum(v.square().sum() for v in apart.values()) / sum(v.square().sum() for v in moved.values())

    assert stopped.step == whole.step == 40
    assert ratio**0.5 < 0.35  # the first moment began again once in 40 updates


def test_state_keeps_weights_and_second_moments(tmp_path: Path):
    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(3, 1000, generator=generator) * torch.logspace(-8, 3, 1000)
    moments = torch.rand(1000, generator=generator) * torch.logspace(-8, 0, 1000)
    moments[::7] = 0
    write_progress(tmp_path, Progress(1, 5, 2.5, {"a": weights, "b": torch.zeros(0)}, {"a": moments}, [{"loss": 1.0}]))

    found = read_progress(tmp_path)

    assert (found.phase, found.step, found.seconds, found.curve) == (1, 5, 2.5, [{"loss": 1.0}])
    torch.testing.assert_close(found.weights["a"], weights, rtol=2**-16, atol=0)
    torch.testing.assert_close(found.second_moments["a"].sqrt(), moments.sqrt(), rtol=0.025, atol=0)
    assert found.weights["b"].shape == (0,)


def test_state_in_several_files_must_be_whole(tmp_path: Path):
    many = torch.randn(6_000_000)
    written = write_progress(tmp_path, Progress(weights={"a": many}))
    assert len(written) == 3  # two parts and the curve
    assert all(path.stat().st_size < 16 * 2**20 for path in written)
    torch.testing.assert_close(read_progress(tmp_path).weights["a"], many, rtol=2**-16, atol=0)

    written[1].write_bytes(written[1].read_bytes()[:100])
    with pytest.raises(CheckpointError, match="damaged"):
        read_progress(tmp_path)
    written[1].unlink()
    with pytest.raises(CheckpointError, match="1 of 2 files"):
        read_progress(tmp_path)
    with pytest.raises(CheckpointError, match="holds no state"):
        read_progress(tmp_path / "nowhere")


def test_another_seed_is_that_of_the_run(pack: Path, tmp_path: Path):
    state, run = tmp_path / "state", tmp_path / "run"
    assert train(pack, state, "--seed", "5", "--clips", "1") == 0
    assert rented_gpu.main(["run", "--pack", str(pack), "--state", str(state), "--folder", str(run)]) == 0
    content = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)
    config = content["hyper_parameters"]
    assert (config["seed"], config["data"]["seed"]) == (5, 5)


def test_the_last_training_begins_with_other_weights(pack: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    assert train(pack, tmp_path / "first") == 0
    begun: list[Training] = []
    monkeypatch.setattr(Training, "run", lambda self, *_: begun.append(self))

    assert train(pack, tmp_path / "second", "--weights", str(tmp_path / "first"), "--seed", "5") == 0

    (training,) = begun
    assert (training.progress.phase, training.progress.step, training.progress.seed) == (1, 0, 5)
    state = read_progress(tmp_path / "first")
    for name, value in training.system.state_dict().items():
        torch.testing.assert_close(value, {**state.weights, **state.average}[name], rtol=0, atol=0)


def test_an_update_can_be_profiled(pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
    assert train(pack, tmp_path / "state", "--profile", "1", "--minutes-in-all", "9") == 0
    printed = capsys.readouterr().out
    assert "aten::addmm" in printed and "waits an update" in printed


def test_what_the_loop_does_not_offer_is_refused(words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture):
    out = ["pack", "--out", str(tmp_path / "x.npz"), "--updates"]

    assert rented_gpu.main([*out, "1", *words]) == 1
    assert "--updates needs 2 numbers" in capsys.readouterr().err
    assert rented_gpu.main([*out, "1,1", *words, "encoder=unet_moving"]) == 1
    assert "encoder.background=null" in capsys.readouterr().err


def test_actions_travel_and_are_trained_on(tmp_path: Path):
    data = write_pushed_boxes(tmp_path / "data")
    pack = tmp_path / "pack.npz"
    more = [f"data.folder={data}", "actions=true", "scene.input_views=[0]", "data.target_views=[0,1]"]
    assert rented_gpu.main(["pack", "--out", str(pack), "--updates", "1,1", *WORDS, *more]) == 0
    (file,) = load_manifest(data).split("train")
    _, (packed,) = read_pack(pack)
    frames = TrajectoryFrames(file, use_cache=False)
    mine, theirs = packed.driven([3, 1]), frames.driven([3, 1])
    assert mine is not None and theirs is not None
    assert mine.as_arrays().keys() == theirs.as_arrays().keys()
    for name, values in theirs.as_arrays().items():
        np.testing.assert_array_equal(mine.as_arrays()[name], values)

    assert train(pack, tmp_path / "state") == 0
    settings, _ = read_pack(pack)
    first, last = build_system(settings["phases"][-1]).state_dict(), read_progress(tmp_path / "state").weights
    of_action = [name for name in last if "driven" in name]
    assert of_action and not all(torch.allclose(first[name], last[name], atol=1e-5) for name in of_action)
