"""What runs in each worker process of an import: the plan of the import, and one clip per job.

``data_gen.worker`` builds a ``Scene`` and asks it for trajectories; here they are read instead of simulated.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2

from data_gen.importers.import_plan import Found, clip_trajectory, make_plan
from data_gen.importers.settings import ImportSettings
from data_gen.stage_clock import StageClock
from vpd_lightning.data.schema import Trajectory


@dataclass(frozen=True)
class ImportJob:
    """What a worker needs to make the same plan again; a recording itself cannot be sent to another process."""

    source: Path
    settings: ImportSettings
    found: Found

    @property
    def storage(self) -> ImportSettings:
        """How files are written: ``compression`` and ``depth_encoding``."""
        return self.settings


class Scene:
    """The clips of one import."""

    def __init__(self, job: ImportJob, renderer: str) -> None:
        cv2.setNumThreads(1)  # every core has its own worker
        self.plan = make_plan(job.source, job.settings, job.found)
        self.clips = {clip.path: clip for clip in self.plan.clips}

    def trajectory(
        self, seed: int, split: str, index: int, scene_hash: str, check_stop: Callable[[], None], clock: StageClock
    ) -> Trajectory:
        """Read the clip that becomes ``split/index.h5``."""
        with clock.measure("read"):
            clip = self.clips[Path(split) / f"{index:06d}.h5"]
            return clip_trajectory(self.plan, clip, scene_hash, check_stop)

    def close(self) -> None:
        """Nothing to free: recordings open files when they read and the process ends."""
