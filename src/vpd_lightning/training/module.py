"""The training of a simulator as a LightningModule: which parts are called when, and what is logged. No maths."""

import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor, nn

from vpd_lightning.data.trained_on import DATA_SHA256, TRAINED_ON
from vpd_lightning.data.validation import VideoClip
from vpd_lightning.errors import ConfigError, NonFiniteError
from vpd_lightning.losses.base import AbstractLoss
from vpd_lightning.metrics.psnr import mean_squared_error, psnr_of
from vpd_lightning.metrics.registry import HEADLINE, PSNR, metric
from vpd_lightning.metrics.sample_metric import SampleMetric
from vpd_lightning.metrics.true_images import TrueImages
from vpd_lightning.system import AbstractSystem
from vpd_lightning.training.optimization import AbstractOptimization
from vpd_lightning.types import SimulatorOutput, VideoBatch, ViewBatch

VALIDATION = "validation/"
BEST_METRIC = f"{VALIDATION}{HEADLINE}"

log = logging.getLogger(__name__)


class VPDModule(pl.LightningModule):
    """Trains ``simulator`` (any system) on the weighted sum of ``losses``.

    ``config`` is the resolved configuration as plain containers; it is stored in every checkpoint, as its
    ``hyper_parameters``, and is what a model is rebuilt from.

    After each step, ``train_metrics`` holds what is to be logged: loss, loss/<name>, psnr (training rays), lr,
    gradient_norm, rays_per_second, uncovered_share (where the dynamics measures it), and what a loss measures beside.
    """

    def __init__(
        self,
        *,
        simulator: AbstractSystem,
        losses: Sequence[AbstractLoss],
        optimization: AbstractOptimization,
        config: Mapping[str, Any],
    ) -> None:
        super().__init__()
        if not losses:
            raise ConfigError("There is no loss to train on.\nSet loss=pixel, or another option of conf/loss.")
        names = [loss.name for loss in losses]
        if len(set(names)) != len(names):
            raise ConfigError(f"Two losses have the same name: {', '.join(names)}.\nGive each its own name.")
        _require_plain(config, "config")
        self.save_hyperparameters(dict(config), logger=False)
        self.simulator = simulator
        self.losses = nn.ModuleList(losses)
        self.optimization = optimization
        optimization.freeze(simulator)
        self.validation_metric = SampleMetric(metric(HEADLINE))
        self.validation_metric_last_step = SampleMetric(metric(HEADLINE), last_step_only=True)
        self.train_metrics: dict[str, Tensor | float] = {}
        self.expected_steps: Callable[[], int] | None = None
        self._clips: Sequence[str] = ()
        self._earlier_data: list[str] = []
        self._earlier_trajectories: frozenset[str] | None = frozenset()
        self.seconds_per_step: float | None = None
        self._last_start: float | None = None

    def configure_optimizers(self) -> dict[str, Any]:
        """Build the optimiser; its schedule moves with every update and ends at ``trainer.max_steps``.

        Where a time budget ends the training (``callbacks.time_budget``), ``expected_steps`` says how many updates that
        will be, as far as is known.
        """
        expected = self.expected_steps or (lambda: self.trainer.max_steps)
        optimizer, schedule = self.optimization.build(self.simulator, expected)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    # -- what a checkpoint says of its data ----------------------------------------------------------------------------

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep the digests of the data sets that were trained on, in order, and of all their trajectories."""
        now = self._data_sha256()
        checkpoint[DATA_SHA256] = [*self._earlier_data, *([now] if now and now not in self._earlier_data else [])]
        now_seen, before = self._of_data("trained_on"), self._earlier_trajectories
        checkpoint[TRAINED_ON] = None if now_seen is None or before is None else sorted({*now_seen, *before})

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Warn where a training goes on with other data than before, or with another division of them."""
        self.remember(checkpoint.get(TRAINED_ON))
        self._earlier_data, now = list(checkpoint.get(DATA_SHA256) or []), self._data_sha256()
        if now and self._earlier_data and self._earlier_data != [now]:
            log.warning(
                "the data set is not what this training began with, or its splits are not (SHA-256 %s, was %s)",
                now[:12],
                self._earlier_data[0][:12],
            )

    def remember(self, trajectories: Iterable[str] | None) -> None:
        """Count what an earlier training saw (SHA-256 of each trajectory) among what this one saw; None: not known."""
        before = self._earlier_trajectories
        self._earlier_trajectories = None if trajectories is None or before is None else before.union(trajectories)

    def _data_sha256(self) -> str | None:
        return self._of_data("data_sha256")

    def _of_data(self, name: str) -> Any:
        trainer = self._trainer  # absent where a checkpoint is read without one
        return getattr(getattr(trainer, "datamodule", None), name, None)

    # -- training ------------------------------------------------------------------------------------------------------

    def training_step(self, batch: VideoBatch | ViewBatch, batch_idx: int) -> Tensor:
        """Return the weighted sum of all losses; NonFiniteError before anything is updated by a bad one."""
        self._clips = batch.clips
        self._time_step()
        output, parts, total = self.losses_of(batch)
        if not torch.isfinite(total):
            values = ", ".join(f"{name} = {part.item()}" for name, part in parts.items())
            raise self._non_finite(f"The loss is not finite ({values})")
        self.train_metrics = {
            "loss": total.detach(),
            **{f"loss/{name}": part.detach() for name, part in parts.items()},
            **{name: value for loss in self.losses for name, value in loss.metrics.items()},  # type: ignore[operator,union-attr]
        }
        if output.rendered is not None:
            truth = batch.rgbs.to(self._parameter_dtype()).float()
            error = mean_squared_error(output.rendered.rgbs.detach().float(), truth)
            self.train_metrics[PSNR] = psnr_of(error).mean()
        if self.seconds_per_step is not None:
            rays = batch.rgbs.shape[:-1].numel() * self.trainer.world_size
            self.train_metrics["rays_per_second"] = rays / self.seconds_per_step
        uncovered = getattr(getattr(self.simulator, "dynamics", None), "last_uncovered_share", None)
        if uncovered is not None:
            self.train_metrics["uncovered_share"] = uncovered
        return total

    def losses_of(self, batch: VideoBatch | ViewBatch) -> tuple[SimulatorOutput, dict[str, Tensor], Tensor]:
        """Return what the system makes of a batch, each loss by its name, and their weighted sum."""
        batch = batch.to(self._parameter_dtype())
        output = self.simulator(batch)
        parts = {loss.name: loss(output, batch) for loss in self.losses}  # type: ignore[union-attr]
        total = torch.stack([loss.weight * parts[loss.name] for loss in self.losses]).sum()  # type: ignore[union-attr]
        return output, parts, total

    def _parameter_dtype(self) -> torch.dtype:
        """Return the precision of the parameters, which the data follow (float32 under autocast, too)."""
        return next(self.simulator.parameters()).dtype

    def _time_step(self) -> None:
        """Measure from the start of one step to the start of the next, data and optimiser included; a running mean."""
        now, last = time.perf_counter(), self._last_start
        self._last_start = now
        if last is not None:
            before = self.seconds_per_step
            self.seconds_per_step = now - last if before is None else 0.9 * before + 0.1 * (now - last)

    def on_validation_start(self) -> None:
        """Leave validations out of the time of a training step."""
        self._last_start = None

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Stop before a gradient that is not finite reaches the weights."""
        self.train_metrics.update(_learning_rates(optimizer))
        named = [(name, p.grad) for name, p in self.simulator.named_parameters() if p.grad is not None]
        if not named:
            return
        norms = torch.stack(torch._foreach_norm([gradient for _, gradient in named]))
        total = torch.linalg.vector_norm(norms)
        # float16 training skips such steps itself, by its loss scaler.
        has_scaler = getattr(self.trainer.precision_plugin, "scaler", None) is not None
        if not torch.isfinite(total) and not has_scaler:
            bad = [name for (name, _), norm in zip(named, norms, strict=True) if not torch.isfinite(norm)]
            raise self._non_finite(f"The gradient of {len(bad)} parameters is not finite, first {(bad or ['?'])[0]}")
        self.train_metrics["gradient_norm"] = total

    def _non_finite(self, what: str) -> NonFiniteError:
        return NonFiniteError(
            f"{what}, at step {self.global_step}.\n"
            f"Clips (file@first frame): {', '.join(self._clips)}.\n"
            "Nothing was updated. Check these files (vpd-data validate), lower optimizer.lr, or set"
            " trainer.gradient_clip_val."
        )

    # -- validation ----------------------------------------------------------------------------------------------------

    def validation_step(self, clip: VideoClip, batch_idx: int) -> dict[str, Any]:
        """Roll one clip out and compare all its frames; returns the pictures for callbacks to draw."""
        clip = clip.to(self._parameter_dtype())
        target = clip.target
        prediction = self.simulator.predict_frames(clip.context, target.cameras, target.driven).float()
        if not torch.isfinite(prediction).all():
            raise NonFiniteError(
                f"The prediction for {clip.name} is not finite, after step {self.global_step}.\n"
                "Lower optimizer.lr or set trainer.gradient_clip_val."
            )
        # Each clip counts once, on whatever device it was; with one device and with several the same.
        truth = TrueImages(target.rgb.float() / 255.0)
        metrics = {BEST_METRIC: self.validation_metric, f"{BEST_METRIC}_last_step": self.validation_metric_last_step}
        for each in metrics.values():
            each.update(clip.number, prediction, truth)
        self.log_dict(metrics, on_step=False, on_epoch=True, batch_size=1, logger=False)
        return {"prediction": prediction}


def _learning_rates(optimizer: torch.optim.Optimizer) -> dict[str, Tensor | float]:
    rates = {group["name"]: group["lr"] for group in optimizer.param_groups}
    if len(set(rates.values())) == 1:
        return {"lr": next(iter(rates.values()))}
    return {f"lr/{name}": rate for name, rate in rates.items()}


def _require_plain(value: Any, where: str) -> None:
    """Refuse what a safe load of the checkpoint would refuse."""
    if isinstance(value, dict):
        for key, item in value.items():
            if not isinstance(key, str | int | float | bool):
                raise TypeError(f"{where} has a key of type {type(key).__name__}; keys must be plain")
            _require_plain(item, f"{where}.{key}")
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            _require_plain(item, f"{where}[{index}]")
    elif value is not None and type(value) not in (str, int, float, bool):
        raise TypeError(f"{where} is a {type(value).__name__}; a checkpoint holds plain dicts, lists and scalars only")
