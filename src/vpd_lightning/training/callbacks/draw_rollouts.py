"""Pictures and videos of validation rollouts, truth beside prediction."""

from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import numpy as np
from jaxtyping import UInt8

from vpd_lightning.data.validation import VideoClip
from vpd_lightning.media.pictures import write_png
from vpd_lightning.media.video import comparison_frames, write_video

FOLDER = "validation"


class DrawRollouts(pl.Callback):
    """Draws the first ``num_clips`` validation clips, at most once in ``every_n_steps`` updates.

    For each: ``validation/step_<step>_clip_<i>.png`` (first validation view; top row the truth, bottom row the
    prediction, one column a step, at most ``max_columns``) and ``.webm`` (truth | prediction | error, all of them).
    """

    def __init__(self, *, num_clips: int, every_n_steps: int, max_columns: int, frames_per_second: float) -> None:
        super().__init__()
        if num_clips < 0 or every_n_steps < 1 or max_columns < 1 or frames_per_second <= 0:
            raise ValueError(
                "num_clips must be at least 0, every_n_steps and max_columns at least 1, frames_per_second above 0, got"
                f" {num_clips}, {every_n_steps}, {max_columns}, {frames_per_second}"
            )
        self.num_clips, self.every_n_steps = num_clips, every_n_steps
        self.max_columns, self.frames_per_second = max_columns, frames_per_second
        self._is_due = True
        self._drawn_step: int | None = None

    def on_validation_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Decide once per validation."""
        last = self._drawn_step
        is_time = last is None or trainer.global_step - last >= self.every_n_steps
        self._is_due = is_time and trainer.is_global_zero and not trainer.sanity_checking and trainer.state.fn == "fit"
        if self._is_due:
            self._drawn_step = trainer.global_step

    def on_validation_batch_end(
        self,
        trainer: pl.Trainer,
        pl_module: pl.LightningModule,
        outputs: Any,
        batch: VideoClip,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Draw one clip."""
        if not self._is_due or batch_idx >= self.num_clips:
            return
        pred = (outputs["prediction"].float().clamp(0, 1) * 255).round().byte().cpu().numpy()
        truth = batch.target.rgb.cpu().numpy()
        folder = Path(trainer.default_root_dir) / FOLDER
        folder.mkdir(parents=True, exist_ok=True)
        name = f"step_{trainer.global_step:07d}_clip_{batch_idx}"
        strip = film_strip(truth[:, 0], pred[:, 0], self.max_columns)
        write_png(folder / f"{name}.png", strip)
        labels = [f"+{step + 1}" for step in range(len(truth))]
        frames = comparison_frames(truth, pred, range(truth.shape[1]), labels)
        write_video(folder / f"{name}.webm", frames, self.frames_per_second)
        for logger in trainer.loggers:
            add_image = getattr(logger.experiment, "add_image", None)  # TensorBoard has one
            if add_image is not None:
                add_image(f"validation/clip_{batch_idx}", strip, trainer.global_step, dataformats="HWC")


def film_strip(
    truth: UInt8[np.ndarray, "time height width 3"],
    prediction: UInt8[np.ndarray, "time height width 3"],
    max_columns: int,
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Return the truth in the top row and the prediction below it, at an even choice of steps."""
    count = min(max_columns, len(truth))
    chosen = np.linspace(0, len(truth) - 1, count).round().astype(int)
    rows = [np.concatenate(list(frames[chosen]), axis=1) for frames in (truth, prediction)]
    return np.concatenate(rows, axis=0)
