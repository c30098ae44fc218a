"""Says before the first update how much memory an update will take, and ends a training that cannot fit."""

import sys
from dataclasses import replace
from io import TextIOBase

import lightning.pytorch as pl
import torch

from vpd_lightning.errors import OutOfMemoryError
from vpd_lightning.free_memory import available_bytes, peak_bytes, reset_peak
from vpd_lightning.training.module import VPDModule
from vpd_lightning.types import VideoBatch, ViewBatch

KNOBS = (
    "Lower renderer.ray_chunk_size (same result), data.batch_size, data.rays_per_step, data.num_steps or\n"
    "encoder.num_particles; or use more devices: each takes its share of data.batch_size."
)
"""What takes memory, in the words of the configuration."""
_NOTEWORTHY = 64 * 2**20  # bytes; less is within what libraries take by themselves


class MemoryEstimate(pl.Callback):
    """Passes one clip of the first batch through the model and back, and multiplies what that took by their number.

    Where rollouts become longer in the course of the training (``data.num_steps_schedule``), the clip is as long as the
    longest. Nothing is learned from it, and no random number is used up. A batch of one clip is not measured, as it
    would take as long as the update itself, nor is a compiled step.
    """

    def __init__(self, *, force: bool, stream: TextIOBase | None = None) -> None:
        super().__init__()
        self.force, self.stream = force, stream or sys.stdout
        self.estimate: int | None = None
        self._is_done = False

    def on_train_batch_start(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, batch: VideoBatch | ViewBatch, batch_idx: int
    ) -> None:
        """Measure, before the first update only.

        Raises:
            OutOfMemoryError: there is less than an update takes, and ``force`` is false.
        """
        if self._is_done or not isinstance(pl_module, VPDModule):
            return
        self._is_done = True
        size = len(batch.keys.sample_index)
        # A compiler would compile once more for the batch of one.
        is_compiled = getattr(getattr(pl_module.simulator, "dynamics", None), "is_compiled", False)
        if size == 1 or is_compiled:
            return
        longest = getattr(getattr(trainer, "datamodule", None), "longest_rollout", 0)
        clip = first_clip(batch, longest)
        taken, free = _taken_by(pl_module, clip), available_bytes(pl_module.device)
        if taken is None or free is None:
            return
        if pl_module.device.type == "cpu":
            free //= trainer.num_devices  # its processes share what there is
        self.estimate = taken * size
        words = f"about {_gigabytes(self.estimate)} for an update of {size} clips of {clip.rgbs.shape[1]} steps"
        if self.estimate > free and not self.force:
            raise OutOfMemoryError(
                f"memory will not suffice: {words}, and {_gigabytes(free)} are free.\n{KNOBS}\n"
                "To try all the same: force=true."
            )
        if trainer.is_global_zero and self.estimate > _NOTEWORTHY:
            print(f"memory: {words}; {_gigabytes(free)} are free", file=self.stream, flush=True)


def first_clip(batch: VideoBatch | ViewBatch, num_steps: int = 0) -> VideoBatch | ViewBatch:
    """Return a batch of its first member alone, its last frame repeated up to ``num_steps`` predicted steps."""
    keys = replace(batch.keys, sample_index=batch.keys.sample_index[:1])
    clips = batch.clips[:1]
    if isinstance(batch, ViewBatch):
        slots = None if batch.slots is None else batch.slots[:1]
        return replace(batch, images=batch.images[:1], slots=slots, keys=keys, clips=clips)
    length = batch.rgbs.shape[1]
    steps = [min(step, length - 1) for step in range(max(length, num_steps))]
    rays = replace(batch.rays, origins=batch.rays.origins[:1, steps], directions=batch.rays.directions[:1, steps])
    future = None if batch.future is None else batch.future[:1, steps]
    driven = None if batch.driven is None else batch.driven[:1, steps]
    context, rgbs = batch.context[:1], batch.rgbs[:1, steps]
    return replace(batch, context=context, rays=rays, rgbs=rgbs, keys=keys, clips=clips, future=future, driven=driven)


def _taken_by(module: VPDModule, batch: VideoBatch | ViewBatch) -> int | None:
    """Return what a pass forward and back takes beside what is held already (bytes); None where it is not measured."""

    def there_and_back() -> None:
        with module.trainer.precision_plugin.forward_context():
            total = module.losses_of(batch)[2]
        total.backward()
        module.zero_grad(set_to_none=True)

    with torch.random.fork_rng():
        there_and_back()  # the first time, libraries are loaded and kernels are compiled
        before = reset_peak(module.device)
        if before is None:
            return None
        there_and_back()
        after = peak_bytes(module.device)
    return None if after is None else max(after - before, 0)


def _gigabytes(count: int) -> str:
    return f"{count / 2**30:.1f} GiB"
