"""What an evaluation predicts and counts."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from vpd_lightning.data.clip import Clip, read_clip
from vpd_lightning.data.manifest import SPLITS
from vpd_lightning.errors import ConfigError
from vpd_lightning.types import NUM_CONTEXT_FRAMES


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """Which clips are predicted, how far, and what the metrics count. Frames are counted from 0.

    A clip that starts at frame ``s`` shows the model frames ``s`` and ``s + 1`` (to one that needs more, those before
    them as well) and asks for the ``num_steps`` frames behind them: every model predicts the same frames.
    ``num_trajectories`` limits the split to its first files (None: all). ``num_long_steps`` (0: none) rolls the clips
    of ``long_start_frame`` out further, without images. ``moving_threshold`` is a colour difference in [0, 1] from
    which on a pixel has changed, and counts as moving where there is no segmentation; images with fewer than
    ``min_moving_pixels`` such pixels have no moving PSNR and no intersection over union. ``body_margin``
    (metres) grows a body's true box, or its surface where it is soft, when its particles are picked.
    ``draw_references`` also judges other motions that the model's renderer draws, at about twice the time.
    """

    split: str
    start_frames: Sequence[int]
    num_steps: int
    num_trajectories: int | None
    num_long_steps: int
    long_start_frame: int
    moving_threshold: float
    min_moving_pixels: int
    body_margin: float
    num_chamfer_points: int
    num_bootstrap: int
    draw_references: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "start_frames", tuple(self.start_frames))
        if self.split not in SPLITS:
            raise ConfigError(f"There is no split {self.split!r}.\nAllowed: {', '.join(SPLITS)}.")
        if not self.start_frames or min(self.start_frames) < 0 or len(set(self.start_frames)) < len(self.start_frames):
            raise ConfigError(
                f"start_frames is {list(self.start_frames)}; it must be a list of different frames, 0 or more."
            )
        if self.num_trajectories is not None and self.num_trajectories < 1:
            raise ConfigError(f"num_trajectories is {self.num_trajectories}; it must be null or at least 1.")
        for name, lowest in (("num_steps", 1), ("num_long_steps", 0), ("long_start_frame", 0), ("num_bootstrap", 1)):
            if getattr(self, name) < lowest:
                raise ConfigError(f"{name} is {getattr(self, name)}; it must be at least {lowest}.")

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for ``metrics.json``."""
        return {**asdict(self), "start_frames": list(self.start_frames)}


def read_clips(paths: Sequence[Path], protocol: Protocol, num_context: int = NUM_CONTEXT_FRAMES) -> Iterator[Clip]:
    """Read the clips of the protocol one after the other: every start frame of the first trajectory, then the next."""
    for trajectory, path in enumerate(paths[: protocol.num_trajectories]):
        for start in protocol.start_frames:
            yield read_clip(path, trajectory, start, protocol.num_steps, num_context=num_context)
