"""What an update will take is measured with one clip; a training that cannot fit ends before its first update."""

import io
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch

from tests.data.recordings import write_recordings
from tests.training.tiny_training import TinyRenderer, tiny_data, tiny_module, tiny_simulator, tiny_trainer
from vpd_lightning.errors import OutOfMemoryError
from vpd_lightning.free_memory import peak_bytes, reset_peak
from vpd_lightning.training.callbacks import memory_estimate
from vpd_lightning.training.callbacks.memory_estimate import MemoryEstimate, first_clip
from vpd_lightning.training.module import VPDModule
from vpd_lightning.types import RenderedRays, VideoBatch

GIB = 2**30
KEPT = 32 * 2**20  # bytes that the wasteful renderer keeps for the backward pass, a clip and step


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recordings(tmp_path_factory.mktemp("data"))


class Wasteful(TinyRenderer):
    """Keeps much for the backward pass, so that all else is small beside it."""

    def forward(self, particles: Any, rays: Any, keys: Any) -> RenderedRays:
        drawn = super().forward(particles, rays, keys)
        waste = torch.ones(len(drawn.rgbs), KEPT // 4) * drawn.rgbs.mean()
        return RenderedRays(drawn.rgbs + 0.0 * (waste * waste).mean(), drawn.depths, drawn.opacities)


def first_batch(data: Path, folder: Path) -> VideoBatch:
    found: list[VideoBatch] = []

    class Keep(pl.Callback):
        def on_train_batch_start(self, trainer: pl.Trainer, module: VPDModule, batch: VideoBatch, *_: Any) -> None:
            found.append(batch)

    tiny_trainer(folder, 1, [Keep()]).fit(tiny_module(), tiny_data(data))
    return found[0]


def test_one_clip_is_as_long_as_the_longest_rollout(data: Path, tmp_path: Path) -> None:
    batch = first_batch(data, tmp_path)
    clip = first_clip(batch, 5)
    assert isinstance(clip, VideoBatch) and batch.rgbs.shape[:2] == (2, 2) and clip.rgbs.shape[:2] == (1, 5)
    assert torch.equal(clip.rgbs[:, :2], batch.rgbs[:1]) and torch.equal(clip.rgbs[0, 4], batch.rgbs[0, 1])
    assert clip.rays.origins.shape == clip.rays.directions.shape == clip.rgbs.shape
    assert clip.context.rgb.shape[0] == 1 and clip.keys.sample_index == batch.keys.sample_index[:1]
    assert clip.clips == batch.clips[:1] and first_clip(batch).rgbs.shape[:2] == (1, 2)


class Peak(pl.Callback):
    """Measures what the second update takes, when everything is loaded."""

    taken = 0

    def on_train_batch_start(self, *_: Any) -> None:
        self.before = reset_peak()

    def on_before_optimizer_step(self, *_: Any) -> None:
        self.taken = peak_bytes() - self.before


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="only Linux says what a process held at most")
def test_the_estimate_is_what_an_update_of_the_longest_rollouts_takes(data: Path, tmp_path: Path) -> None:
    simulator = tiny_simulator()
    simulator.renderer = Wasteful()
    said, peak = io.StringIO(), Peak()
    estimate = MemoryEstimate(force=False, stream=said)
    trainer = tiny_trainer(tmp_path, 1, [estimate])
    trainer.fit(tiny_module(simulator), tiny_data(data))  # the first update has two steps
    long = tiny_trainer(tmp_path / "long", 2, [peak])
    long.fit(tiny_module(simulator), tiny_data(data, num_steps_schedule=None))
    assert estimate.estimate is not None and peak.taken > 2 * 3 * KEPT  # two clips, three steps
    assert 0.8 < estimate.estimate / peak.taken < 1.25
    assert "for an update of 2 clips of 3 steps" in said.getvalue()


def test_a_training_learns_the_same_with_it_and_without(data: Path, tmp_path: Path) -> None:
    weights = []
    for name, callbacks in (("with", [MemoryEstimate(force=False)]), ("without", [])):
        module = tiny_module()
        tiny_trainer(tmp_path / name, 4, callbacks).fit(module, tiny_data(data))
        weights.append(torch.cat([p.detach().flatten() for p in module.parameters()]))
    assert torch.equal(*weights)


def scripted(monkeypatch: pytest.MonkeyPatch, taken: int, free: int) -> None:
    monkeypatch.setattr(memory_estimate, "_taken_by", lambda module, batch: taken)
    monkeypatch.setattr(memory_estimate, "available_bytes", lambda device: free)


def test_what_cannot_fit_ends_before_the_first_update_unless_forced(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scripted(monkeypatch, 3 * GIB, 5 * GIB)
    module = tiny_module()
    before = [p.detach().clone() for p in module.parameters()]
    with pytest.raises(OutOfMemoryError) as refused:
        tiny_trainer(tmp_path / "one", 2, [MemoryEstimate(force=False)]).fit(module, tiny_data(data))
    text = str(refused.value)
    assert "about 6.0 GiB for an update of 2 clips of 3 steps, and 5.0 GiB are free" in text
    assert "data.batch_size" in text and "force=true" in text
    assert all(torch.equal(one, other) for one, other in zip(before, module.parameters(), strict=True))

    trainer = tiny_trainer(tmp_path / "two", 2, [MemoryEstimate(force=True)])
    trainer.fit(tiny_module(), tiny_data(data))
    assert trainer.global_step == 2


def test_one_clip_alone_and_what_is_not_known_are_not_judged(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scripted(monkeypatch, GIB, 0)
    alone = MemoryEstimate(force=False)
    tiny_trainer(tmp_path / "one", 1, [alone]).fit(tiny_module(), tiny_data(data, batch_size=1))
    assert alone.estimate is None
    monkeypatch.setattr(memory_estimate, "available_bytes", lambda device: None)
    unknown = MemoryEstimate(force=False)
    tiny_trainer(tmp_path / "two", 1, [unknown]).fit(tiny_module(), tiny_data(data))
    assert unknown.estimate is None
