"""The training step: what it guards, logs and stores."""

from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch

from tests.data.recordings import write_recordings
from tests.training.tiny_training import tiny_data, tiny_module, tiny_simulator, tiny_trainer
from vpd_lightning.errors import ConfigError, NonFiniteError
from vpd_lightning.losses.base import AbstractLoss
from vpd_lightning.losses.pixel import PixelLoss
from vpd_lightning.training.checkpoint_files import load_checkpoint
from vpd_lightning.training.module import VPDModule
from vpd_lightning.training.optimization import StepDecayAdam
from vpd_lightning.types import SimulatorOutput, VideoBatch


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recordings(tmp_path_factory.mktemp("data"))


class BadLoss(AbstractLoss):
    """Becomes not finite, or gets such a gradient, at the second step."""

    name, weight = "bad", 1.0

    def __init__(self, kind: str) -> None:
        super().__init__()
        self.kind = kind

    def forward(self, output: SimulatorOutput, batch: VideoBatch) -> torch.Tensor:
        mean = output.rendered.rgbs.mean()
        if batch.keys.step == 0:
            return mean
        if self.kind == "loss":
            return mean * float("nan")
        zero = (mean - mean.detach()).abs()
        return zero.sqrt()  # 0, with an infinite gradient (times 0: NaN)


def module_with(losses: list[AbstractLoss], config: dict[str, Any] | None = None) -> VPDModule:
    adam = StepDecayAdam(lr=1e-3, betas=[0.9, 0.999], eps=1e-8, milestones=[], gamma=0.5)
    return VPDModule(simulator=tiny_simulator(), losses=losses, optimization=adam, config=config or {})


class WeightsAt(pl.Callback):
    """Remembers the weights before each step."""

    def __init__(self) -> None:
        self.weights: list[dict[str, torch.Tensor]] = []

    def on_train_batch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *args: Any) -> None:
        self.weights.append({name: value.clone() for name, value in pl_module.state_dict().items()})


@pytest.mark.parametrize(("kind", "message"), [("loss", "loss is not finite .*bad = nan"), ("gradient", "gradient of")])
def test_a_loss_or_gradient_that_is_not_finite_stops_before_the_update(
    data: Path, tmp_path: Path, kind: str, message: str
) -> None:
    module, before = module_with([PixelLoss(weight=1.0, coarse_weight=1.0), BadLoss(kind)]), WeightsAt()
    with pytest.raises(NonFiniteError, match=message) as raised:
        tiny_trainer(tmp_path, 5, [before]).fit(module, tiny_data(data))
    text = str(raised.value)
    assert "at step 1." in text and "train/00000" in text and "@" in text
    assert len(text.splitlines()) <= 5
    assert len(before.weights) == 2
    for name, value in module.state_dict().items():
        assert torch.equal(value, before.weights[1][name]), name


def test_every_weight_gets_a_gradient_and_the_loss_falls(data: Path, tmp_path: Path) -> None:
    seen: list[float] = []

    class Watch(pl.Callback):
        def on_before_optimizer_step(self, trainer: pl.Trainer, pl_module: pl.LightningModule, optimizer: Any) -> None:
            assert all(p.grad is not None and p.grad.isfinite().all() for p in pl_module.simulator.parameters())

        def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *args: Any) -> None:
            seen.append(float(pl_module.train_metrics["loss"]))

    tiny_trainer(tmp_path, 40, [Watch()]).fit(tiny_module(), tiny_data(data))
    assert sum(seen[-10:]) < 0.9 * sum(seen[:10])


def test_a_step_logs_what_it_should(data: Path, tmp_path: Path) -> None:
    module = tiny_module()
    module.simulator.dynamics.last_uncovered_share = torch.tensor(0.25)
    tiny_trainer(tmp_path, 3).fit(module, tiny_data(data))
    expected = {"loss", "loss/pixel", "psnr", "gradient_norm", "rays_per_second", "uncovered_share"}
    expected |= {"lr/encoder", "lr/dynamics", "lr/renderer"}
    assert set(module.train_metrics) == expected
    assert float(module.train_metrics["uncovered_share"]) == 0.25


def test_losses_are_weighted_and_logged_unweighted(data: Path, tmp_path: Path) -> None:
    class Constant(AbstractLoss):
        name, weight = "constant", 10.0

        def forward(self, output: SimulatorOutput, batch: VideoBatch) -> torch.Tensor:
            return output.rendered.rgbs.sum() * 0.0 + 2.0

    module = module_with([PixelLoss(weight=0.5, coarse_weight=1.0), Constant()])
    tiny_trainer(tmp_path, 1).fit(module, tiny_data(data))
    logged = {name: float(value) for name, value in module.train_metrics.items()}
    assert logged["loss/constant"] == 2.0
    assert logged["loss"] == pytest.approx(0.5 * logged["loss/pixel"] + 20.0)


def test_the_psnr_of_validation_is_that_of_all_images_of_all_clips(data: Path, tmp_path: Path) -> None:
    module, datamodule = tiny_module(), tiny_data(data)
    trainer = tiny_trainer(tmp_path, 10)
    trainer.fit(module, datamodule)
    values = []
    for clip in datamodule.val_dataloader():
        scene = module.simulator.encode(clip.context.rgb, clip.context.depth, clip.context.cameras)
        states = module.simulator.rollout(scene, 2)
        for step, state in enumerate(states):
            image = module.simulator.render([state], clip.target.cameras[step])[0]
            values.append(-10 * torch.log10((image - clip.target.rgb[step] / 255).square().mean((-3, -2, -1))))
    assert float(trainer.callback_metrics["validation/psnr"]) == pytest.approx(float(torch.cat(values).mean()))


def test_training_goes_on_in_training_mode_after_a_validation(data: Path, tmp_path: Path) -> None:
    modes = []

    class Watch(pl.Callback):
        def on_before_backward(self, trainer: pl.Trainer, pl_module: pl.LightningModule, loss: torch.Tensor) -> None:
            modes.append(all(module.training for module in pl_module.simulator.modules()))

    tiny_trainer(tmp_path, 12, [Watch()]).fit(tiny_module(), tiny_data(data))
    assert modes == [True] * 12


def test_bf16_and_gradient_clipping_train(data: Path, tmp_path: Path) -> None:
    norms = []

    class Watch(pl.Callback):
        def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *args: Any) -> None:
            gradients = [p.grad for p in pl_module.parameters() if p.grad is not None]
            norms.append(float(torch.linalg.vector_norm(torch.stack([g.norm() for g in gradients]))))

    trainer = tiny_trainer(tmp_path, 4, [Watch()], precision="bf16-mixed", gradient_clip_val=1e-3)
    module = tiny_module()
    trainer.fit(module, tiny_data(data))
    assert max(norms) <= 1.001e-3
    assert all(p.dtype == torch.float32 and p.isfinite().all() for p in module.parameters())


def test_the_configuration_is_stored_as_plain_containers(data: Path, tmp_path: Path) -> None:
    config = {"experiment": "x", "data": {"views": [0, 1], "schedule": {0.0: 2}}, "resume": None}
    tiny_trainer(tmp_path, 1).fit(module_with([PixelLoss(weight=1.0, coarse_weight=1.0)], config), tiny_data(data))
    assert load_checkpoint(tmp_path / "checkpoints" / "last.ckpt")["hyper_parameters"] == config


@pytest.mark.parametrize("config", [{"a": Path("x")}, {"a": [1, {"b": torch.ones(1)}]}, {(1, 2): 3}])
def test_a_configuration_that_is_not_plain_is_refused(config: dict[str, Any]) -> None:
    with pytest.raises(TypeError, match="config"):
        module_with([PixelLoss(weight=1.0, coarse_weight=1.0)], config)


def test_no_loss_and_two_losses_of_one_name_are_refused() -> None:
    with pytest.raises(ConfigError, match="no loss"):
        module_with([])
    with pytest.raises(ConfigError, match="same name"):
        module_with([PixelLoss(weight=1.0, coarse_weight=1.0), PixelLoss(weight=2.0, coarse_weight=1.0)])
