"""The data of systems that take single camera views only: clips of them, and the slots they are stored as."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from lightning.pytorch.utilities import rank_zero_only

from vpd_lightning.data.datamodule import VideoDataModule
from vpd_lightning.data.manifest import file_sha256, load_manifest
from vpd_lightning.data.views.slot_extraction import encoder_of, extract_slots, wait_for_slots
from vpd_lightning.data.views.slot_store import INDEX_FILE, SlotSource, SlotStore
from vpd_lightning.data.views.view_clips import ViewClipDataset, collate_views
from vpd_lightning.errors import ConfigError

FOLDER = "slots"  # in the run folder


class ViewDataModule(VideoDataModule):
    """Clips of single camera views of a folder of our schema: each of ``target_views`` is a video of its own.

    A clip is ``num_history`` frames, ``frame_offset`` apart, as images of ``resolution`` pixels a side. With
    ``use_slots`` the ``num_steps`` frames behind them belong to it, and batches hold the slots of all of them.
    ``prepare`` makes the slots; they lie in the run folder, or in ``slot_folder`` to be shared by runs. With ``cache``
    the resized images stay in memory. Validation clips have ``num_history`` frames before those to predict.

    ``video`` are the arguments of ``VideoDataModule``. Those about rays, depth and input views change nothing here;
    they are taken so that experiments can set them whatever the system is.
    """

    def __init__(
        self,
        *,
        resolution: int,
        num_history: int,
        frame_offset: int,
        use_slots: bool,
        slot_folder: str | None,
        **video: Any,
    ) -> None:
        """Check the numbers; files are first touched by ``setup``."""
        older = {
            "sensor": "none",
            "sensor_percent": None,
            "load_driven": False,
        }  # what configurations from before these settings mean
        super().__init__(**{**older, **video, "cache": False})  # not the full images
        if num_history < 1 or frame_offset < 1 or resolution < 1:
            raise ValueError(
                "resolution, num_history and frame_offset must be at least 1, got"
                f" {resolution}, {num_history} and {frame_offset}"
            )
        self.resolution, self.num_context_frames, self.frame_offset = resolution, num_history, frame_offset
        self.use_slots, self.slot_folder = use_slots, slot_folder
        self.cache_images = bool(video["cache"])
        self.slots: SlotStore | None = None

    @staticmethod
    def settings_without_effect(settings: Mapping[str, Any]) -> dict[str, str]:
        """Return the arguments that change nothing beside the others, each with the reason."""
        of_scenes = (
            "rays_per_step", "input_views", "moving_ray_fraction", "moving_ray_margin", "moving_color_threshold",
            "moving_depth_threshold", "load_future", "load_driven",
        )  # fmt: skip
        idle = dict.fromkeys(of_scenes, "systems of single camera views see whole images, no rays and no depth")
        if not settings["use_slots"]:
            reason = "data.use_slots=false: clips have the frames of the history only"
            idle |= dict.fromkeys(("num_steps", "num_steps_schedule", "slot_folder"), reason)
        return idle

    def _context_views(self) -> list[int]:
        return self._views(self.validation_views)

    def prepare(self, system: Any, folder: Path, checkpoint: Path | None) -> None:
        """Provide the slots of all training videos, encoded by ``system`` with the weights of ``checkpoint``.

        Slots that are there already are used where they come from the same weights and pictures.

        Raises:
            ConfigError: there is no checkpoint of a first training.
            CheckpointError, DataError: the slots that are there come from something else.
        """
        if not self.use_slots:
            return
        if checkpoint is None:
            raise ConfigError(_NO_SLOTS)
        self.setup()
        manifest, views = load_manifest(self.folder), self._views(self.target_views)
        source = SlotSource(file_sha256(checkpoint), manifest.digest, self.resolution)
        place = folder / FOLDER if self.slot_folder is None else Path(self.slot_folder).expanduser()
        if rank_zero_only.rank:
            wait_for_slots(place / INDEX_FILE)
        elif not (place / INDEX_FILE).is_file():
            with encoder_of(system) as encode:
                extract_slots(
                    encode=encode,
                    trajectories=self.trajectories,
                    views=views,
                    data_folder=manifest.folder,
                    folder=place,
                    source=source,
                )
        slots = SlotStore(place, manifest.folder, source)
        for trajectory in self.trajectories:
            slots.require(trajectory.path, views, trajectory.num_frames)
        self.slots = slots

    def clip_dataset(self, max_steps: int) -> ViewClipDataset:  # type: ignore[override]
        """Return the training clips of a training of ``max_steps`` updates (works without a trainer)."""
        self.setup()
        if self.use_slots and self.slots is None:
            raise ConfigError(_NO_SLOTS)
        return ViewClipDataset(
            trajectories=self.trajectories,
            seed=self.seed,
            batch_size=self.batch_size,
            max_steps=max_steps,
            num_history=self.num_context_frames,
            num_steps=self.num_steps if self.use_slots else 0,
            num_steps_schedule=self.num_steps_schedule if self.use_slots else None,
            frame_offset=self.frame_offset,
            views=self._views(self.target_views),
            start_frames=self.start_frames,
            resolution=self.resolution,
            cache=self.cache_images,
            slots=self.slots,
            training_progress=self.training_progress,
        )

    def _collate(self) -> Callable[[Sequence[Any]], Any]:
        return partial(collate_views, num_history=self.num_context_frames)


_NO_SLOTS = (
    "data.use_slots asks for stored slots, and no first training has made any.\n"
    "Use model=slotformer, which begins with one, or name one that is done: pretraining.ckpt=RUN"
)
