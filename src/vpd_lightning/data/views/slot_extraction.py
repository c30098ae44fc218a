"""The slots of whole videos, once, before a training on slots begins."""

import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor, nn

from vpd_lightning.data.frames import TrajectoryFrames
from vpd_lightning.data.views.slot_store import ARRAY_FILE, SlotSource, write_index
from vpd_lightning.data.views.view_clips import resized_frames
from vpd_lightning.errors import DataError, NonFiniteError
from vpd_lightning.files import AtomicPath

log = logging.getLogger(__name__)

VIEWS_AT_ONCE = 4  # videos of one trajectory that go through the encoder together; bounds the memory
_REPORTS = 10  # lines in the log

Encode = Callable[[UInt8[Tensor, "time view height width 3"]], Float[Tensor, "view time slot dim"]]


def extract_slots(
    *,
    encode: Encode,
    trajectories: Sequence[TrajectoryFrames],
    views: Sequence[int],
    data_folder: Path,
    folder: Path,
    source: SlotSource,
) -> None:
    """Encode each camera of each trajectory from its frame 0 to its end, and write a ``SlotStore`` to ``folder``.

    ``encode`` gets the frames of a few cameras at ``source.resolution``. A clip from the middle of a video so has slots
    that have seen everything before it, as in the released SlotFormer. Where writing is interrupted, there is no store.

    Raises:
        NonFiniteError: the encoder gives NaN or infinity.
    """
    folder.mkdir(parents=True, exist_ok=True)
    total = sum(item.num_frames for item in trajectories) * len(views)
    log.info("encoding %d videos, %d frames, to slots", len(trajectories) * len(views), total)
    videos: list[tuple[str, int, int]] = []
    rows: NDArray[np.float32] | None = None
    done, reported = 0, 0
    with AtomicPath(folder / ARRAY_FILE) as partial:
        for trajectory in trajectories:
            name = trajectory.path.relative_to(data_folder).as_posix()
            for first in range(0, len(views), VIEWS_AT_ONCE):
                some = views[first : first + VIEWS_AT_ONCE]
                slots = _encode(encode, trajectory, some, source.resolution)
                if rows is None:
                    shape = (total, *slots.shape[-2:])
                    rows = np.lib.format.open_memmap(partial, mode="w+", dtype=np.float32, shape=shape)
                for view, video in zip(some, slots, strict=True):
                    rows[done : done + len(video)] = video
                    videos.append((name, view, len(video)))
                    done += len(video)
            if done * _REPORTS >= (reported + 1) * total:
                reported = done * _REPORTS // total
                log.info("encoded %d of %d frames", done, total)
        assert rows is not None
        rows.flush()  # type: ignore[attr-defined]
        shape = rows.shape
        del rows
    write_index(folder, source, videos, num_slots=shape[1], slot_dim=shape[2])


def _encode(encode: Encode, trajectory: TrajectoryFrames, views: Sequence[int], resolution: int) -> NDArray[np.float32]:
    every = range(trajectory.num_frames)
    frames = torch.stack([resized_frames(trajectory, view, every, resolution) for view in views], dim=1)
    slots = encode(frames).float().cpu().numpy()
    if not np.isfinite(slots).all():
        raise NonFiniteError(
            f"the slots of {trajectory.path} are not finite: the first training diverged.\n"
            "Train it again with another seed, or with a lower learning rate (pretraining.settings.optimizer.lr)."
        )
    return slots


def wait_for_slots(index: Path) -> None:
    """Wait in the other processes of a training until the first one has written the slots.

    Raises:
        DataError: the process that started this one is gone.
    """
    parent = os.getppid()
    while not index.is_file():
        if os.getppid() != parent:
            raise DataError(f"{index} was not written: the process that makes the slots is gone.")
        time.sleep(0.2)


@contextmanager
def encoder_of(system: Any) -> Iterator[Encode]:
    """Give ``system.encode_views`` on the fastest device there is, as it evaluates; afterwards all is as it was."""
    module: nn.Module = system
    home = next(module.parameters()).device
    modes = {part: part.training for part in module.modules()}
    device = torch.device("cuda") if torch.cuda.is_available() else home
    try:
        module.eval().to(device)
        yield lambda rgb: system.encode_views(rgb.to(device))
    finally:
        module.to(home)
        for part, mode in modes.items():
            part.training = mode
