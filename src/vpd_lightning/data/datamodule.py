"""The data of one training: clips of the training split, fixed validation clips, the background of fixed cameras."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor
from torch.utils.data import DataLoader, Subset

from vpd_lightning.data.background import median_images
from vpd_lightning.data.collate import collate_clips
from vpd_lightning.data.dataset import ClipDataset, MovingRays
from vpd_lightning.data.frames import TrajectoryFrames
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.data.rollout_lengths import RolloutLengths, Schedule
from vpd_lightning.data.sampler import StepBatchSampler, StepLoader
from vpd_lightning.data.sensors import load_sensor
from vpd_lightning.data.sensors.noisy_frames import NoisyFrames
from vpd_lightning.data.validation import ValidationClips, VideoClip
from vpd_lightning.errors import ConfigError, DataError
from vpd_lightning.types import NUM_CONTEXT_FRAMES, Cameras, VideoBatch


class VideoDataModule(pl.LightningDataModule):
    """Posed RGB-D video from a folder of our schema.

    ``batch_size`` is the global one. ``target_views`` null means all; ``start_frames`` null means every start frame
    that leaves room for the clip; ``num_trajectories`` null means the whole training split. ``num_steps_schedule`` maps
    fractions of the training to rollout lengths, or to lists of which every update draws one, and overrides
    ``num_steps`` in training (null: no schedule); fractions are of ``trainer.max_steps``, or of the time where
    ``training_progress`` is set (``callbacks.time_budget``). ``moving_ray_fraction`` of the rays goes to pixels that
    differ from the per-camera training median by more than the thresholds (largest colour channel, in [0, 1]; depth, in
    metres), or lie within ``moving_ray_margin`` pixels of one that does. With ``cache`` decoded frames stay in memory
    (in each loader worker; with the demo's small images use ``num_workers=0``). With ``load_future`` batches also hold
    the input views' images of the frames to predict, with ``load_driven`` what the recordings' actions drive.
    ``sensor`` names a simulated sensor (``conf/sensor``) whose errors
    the training clips get, ``sensor_percent`` its noise at each trajectory's median depth; validation clips stay as
    they are.
    """

    def __init__(
        self,
        *,
        folder: str | Path,
        seed: int,
        num_trajectories: int | None,
        batch_size: int,
        num_workers: int,
        num_steps: int,
        num_steps_schedule: Schedule | None,
        rays_per_step: int,
        input_views: Sequence[int],
        target_views: Sequence[int] | None,
        start_frames: Sequence[int] | None,
        moving_ray_fraction: float,
        moving_ray_margin: int,
        moving_color_threshold: float,
        moving_depth_threshold: float,
        cache: bool,
        num_validation_clips: int,
        num_validation_steps: int,
        validation_views: Sequence[int] | None,
        load_future: bool,
        sensor: str,
        sensor_percent: float | None,
        load_driven: bool,
    ) -> None:
        """Check the numbers; files are first touched by ``setup``."""
        super().__init__()
        if num_workers < 0 or num_validation_clips < 0 or num_validation_steps < 1:
            raise ValueError(
                f"num_workers and num_validation_clips must be at least 0 and num_validation_steps at least 1, got"
                f" {num_workers}, {num_validation_clips} and {num_validation_steps}"
            )
        if not input_views:
            raise ValueError("input_views must name at least one view, got none")
        self.folder = Path(folder)
        self.seed, self.num_trajectories = seed, num_trajectories
        self.batch_size, self.num_workers = batch_size, num_workers
        self.num_steps, self.num_steps_schedule, self.rays_per_step = num_steps, num_steps_schedule, rays_per_step
        self.input_views, self.target_views, self.start_frames = list(input_views), target_views, start_frames
        self.moving_ray_fraction, self.moving_ray_margin = moving_ray_fraction, moving_ray_margin
        self.moving_color_threshold, self.moving_depth_threshold = moving_color_threshold, moving_depth_threshold
        self.cache = cache
        self.num_validation_clips, self.num_validation_steps = num_validation_clips, num_validation_steps
        self.validation_views = validation_views
        self.load_future, self.load_driven = load_future, load_driven
        changes = {} if sensor_percent is None else {"percent_at_median": sensor_percent}
        self.sensor = load_sensor(sensor, changes)
        self.num_context_frames = NUM_CONTEXT_FRAMES
        self.training_progress: Callable[[], float] | None = None
        self.data_sha256: str | None = None  # of the data set; known from setup on
        self.trained_on: list[str] | None = None  # SHA-256 of each trajectory that clips are drawn from; as above
        self.trajectories: list[TrajectoryFrames] = []
        self.validation: ValidationClips | None = None
        self._medians: dict[int, tuple[UInt8[np.ndarray, "height width 3"], Float32[np.ndarray, "height width"]]] = {}

    @property
    def longest_rollout(self) -> int:
        """The most frames that a training clip has to predict."""
        return RolloutLengths(self.num_steps, self.num_steps_schedule).longest

    def setup(self, stage: str = "fit") -> None:
        """Open the manifest, check every trajectory that will be used. DataError says what is wrong and what to do."""
        if self.trajectories:
            return
        manifest = load_manifest(self.folder)
        self.data_sha256 = manifest.digest
        files = manifest.split("train")
        wanted = len(files) if self.num_trajectories is None else self.num_trajectories
        if not 1 <= wanted <= len(files):
            raise DataError(
                f"data.num_trajectories={wanted}, but {self.folder} has {len(files)} training trajectories.\n"
                f"Use 1 to {len(files)}, or null for all."
            )
        self.trajectories = [self._frames(path) for path in files[:wanted]]
        self.trained_on = manifest.checksums(files[:wanted])
        if self.num_validation_clips:
            held_out = manifest.split("validation")[: self.num_validation_clips]
            self.validation = ValidationClips(
                trajectories=[TrajectoryFrames(path, use_cache=False) for path in held_out],
                load_driven=self.load_driven,
                num_clips=self.num_validation_clips,
                num_context_frames=self.num_context_frames,
                num_steps=self.num_validation_steps,
                input_views=self._context_views(),
                target_views=self._views(self.validation_views),
                start_frames=self.start_frames,
            )

    def _frames(self, path: Path) -> TrajectoryFrames:
        if self.sensor is None:
            return TrajectoryFrames(path, self.cache)
        return NoisyFrames(path, self.cache, self.sensor, self.seed)

    def _context_views(self) -> list[int]:
        return self.input_views

    def _views(self, views: Sequence[int] | None) -> list[int]:
        return list(range(self.trajectories[0].num_views)) if views is None else list(views)

    def _median_images(
        self, views: Sequence[int]
    ) -> tuple[UInt8[np.ndarray, "view height width 3"], Float32[np.ndarray, "view height width"]]:
        """Each view's median is taken once: moving rays and the background want many of the same."""
        missing = [view for view in dict.fromkeys(views) if view not in self._medians]
        if missing:
            images = zip(*median_images(self.trajectories, missing), strict=True)
            self._medians.update(zip(missing, images, strict=True))
        rgbs, depths = zip(*(self._medians[view] for view in views), strict=True)
        return np.stack(rgbs), np.stack(depths)

    def clip_dataset(self, max_steps: int) -> ClipDataset:
        """Return the training clips of a training of ``max_steps`` updates (works without a trainer)."""
        self.setup()
        target_views = self._views(self.target_views)
        moving_rays = None
        if self.moving_ray_fraction > 0:
            rgb, depth = self._median_images(target_views)
            moving_rays = MovingRays(
                fraction=self.moving_ray_fraction,
                margin=self.moving_ray_margin,
                color_threshold=self.moving_color_threshold,
                depth_threshold=self.moving_depth_threshold,
                rgb=rgb,
                depth=depth,
            )
        return ClipDataset(
            trajectories=self.trajectories,
            seed=self.seed,
            batch_size=self.batch_size,
            max_steps=max_steps,
            num_steps=self.num_steps,
            num_steps_schedule=self.num_steps_schedule,
            rays_per_step=self.rays_per_step,
            input_views=self.input_views,
            target_views=target_views,
            start_frames=self.start_frames,
            moving_rays=moving_rays,
            load_future=self.load_future,
            load_driven=self.load_driven,
            training_progress=self.training_progress,
        )

    def train_dataloader(self) -> DataLoader[VideoBatch]:
        """Return the batches of all steps still to do; rank and step come from the trainer."""
        trainer = self.trainer
        if trainer is None:
            return self.loader(max_steps=1)
        if trainer.max_steps < 1:
            raise ConfigError(
                "Training is counted in steps, but trainer.max_steps is not set.\n"
                "Set it, for example trainer.max_steps=1000."
            )
        if trainer.accumulate_grad_batches != 1:
            raise ConfigError(
                "trainer.accumulate_grad_batches must be 1: one step is one batch of data.batch_size clips."
            )
        if trainer.world_size > 1 and trainer._accelerator_connector.use_distributed_sampler:
            raise ConfigError(
                "This program divides the clips among the devices; Lightning would divide them a second time.\n"
                "Set trainer.use_distributed_sampler=false."
            )
        return self.loader(trainer.max_steps, lambda: trainer.global_step, trainer.global_rank, trainer.world_size)

    def loader(
        self, max_steps: int, first_step: Callable[[], int] = lambda: 0, rank: int = 0, world_size: int = 1
    ) -> DataLoader[Any]:
        """Return a loader of this rank's share of each step's batch (works without a trainer)."""
        return StepLoader(
            self.clip_dataset(max_steps),
            batch_sampler=StepBatchSampler(
                batch_size=self.batch_size,
                max_steps=max_steps,
                rank=rank,
                world_size=world_size,
                first_step=first_step,
            ),
            collate_fn=self._collate(),
            num_workers=self.num_workers,
            worker_init_fn=one_thread,
        )

    def _collate(self) -> Callable[[Sequence[Any]], Any]:
        """Say how samples become a batch; loader workers get a copy of it."""
        return collate_clips

    def val_dataloader(self) -> DataLoader[VideoClip] | list[DataLoader[VideoClip]]:
        """Return this rank's validation clips, one at a time."""
        if self.validation is None:
            return []
        rank, world_size = (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)
        if len(self.validation) % world_size:
            raise ConfigError(
                f"data.num_validation_clips={len(self.validation)} must be a multiple of the number of devices,"
                f" {world_size}."
            )
        share = Subset(self.validation, range(rank, len(self.validation), world_size))
        return DataLoader(share, batch_size=None, collate_fn=_unchanged, num_workers=0)

    def median_background(
        self, views: Sequence[int] | None = None
    ) -> tuple[UInt8[Tensor, "view height width 3"], Float[Tensor, "view height width"], Cameras]:
        """Return median colour, median z-depth (metres) and cameras of the input views, from the training split.

        Raises DataError where cameras move or differ between trajectories.
        """
        self.setup()
        views = self.input_views if views is None else list(views)
        rgb, depth = self._median_images(views)
        first = self.trajectories[0]
        intrinsics, cam_to_world = (torch.from_numpy(part[0]).float() for part in first.cameras([0], views))
        cameras = Cameras(intrinsics, cam_to_world, first.height, first.width)
        return torch.from_numpy(rgb), torch.from_numpy(depth), cameras


def _unchanged(clip: VideoClip) -> VideoClip:
    return clip


def one_thread(worker: int) -> None:
    """Loader workers share the machine with the training: one thread each."""
    torch.set_num_threads(1)
