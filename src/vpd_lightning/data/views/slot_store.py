"""Codes of whole videos on disk: one array of all frames, and an index of which video each belongs to."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from vpd_lightning.errors import CheckpointError, DataError
from vpd_lightning.files import AtomicPath

ARRAY_FILE, INDEX_FILE = "slots.npy", "slots.json"
STORE_VERSION = 1
_MAX_INDEX_BYTES = 64 * 2**20


@dataclass(frozen=True)
class SlotSource:
    """What slots were made from: weights (SHA-256 of the checkpoint), pictures (digest of the data set), their size."""

    checkpoint_sha256: str
    data_digest: str
    resolution: int


@dataclass(frozen=True)
class StoredVideo:
    """Where the slots of one camera of one trajectory lie: ``num_frames`` rows from ``first`` on."""

    file: str
    view: int
    first: int
    num_frames: int


class SlotStore:
    """Slots of the videos of a data set, read frame by frame; opened in each process at its first use.

    ``slots.npy`` holds float32 (frame, slot, dim), the videos one after another; ``slots.json`` lists which rows belong
    to which (trajectory file, camera), and ``SlotSource``. The index is written last: without it there is no store.

    Raises:
        CheckpointError: the slots were made by another checkpoint.
        DataError: they are of another data set, of another resolution, or damaged.
    """

    def __init__(self, folder: Path, data_folder: Path, source: SlotSource) -> None:
        self.folder, self.data_folder = Path(folder), Path(data_folder)
        index = _read_index(self.folder / INDEX_FILE)
        _require_source(self.folder, index, source)
        self.num_slots, self.slot_dim, self.videos = _parse(self.folder / INDEX_FILE, index)
        self._rows: NDArray[np.float32] | None = None
        self._open()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_rows": None}  # else a copy of all slots would go to each loader worker

    def read(self, path: Path, view: int, times: Sequence[int]) -> Float[Tensor, "time slot dim"]:
        """Return the slots of the given frames of one camera of a trajectory of the data set."""
        video = self._video(path, view)
        outside = [time for time in times if not 0 <= time < video.num_frames]
        if outside:
            raise DataError(
                f"{self.folder} holds {video.num_frames} frames of {video.file}, camera {view}, but frame"
                f" {outside[0]} is asked for.\n{_REMOVE}"
            )
        rows = self._open()[[video.first + time for time in times]]
        return torch.from_numpy(np.array(rows))

    def require(self, path: Path, views: Sequence[int], num_frames: int) -> None:
        """Raise DataError unless the slots of all frames of these cameras are here."""
        for view in views:
            if self._video(path, view).num_frames != num_frames:
                raise DataError(
                    f"{self.folder} holds {self._video(path, view).num_frames} frames of {path.name}, camera {view},"
                    f" which has {num_frames}.\n{_REMOVE}"
                )

    def _video(self, path: Path, view: int) -> StoredVideo:
        name = path.relative_to(self.data_folder).as_posix()
        if (name, view) not in self.videos:
            raise DataError(
                f"{self.folder} holds no slots of {name}, camera {view}: they were made for fewer videos.\n{_REMOVE}"
            )
        return self.videos[name, view]

    def _open(self) -> NDArray[np.float32]:
        if self._rows is None:
            path = self.folder / ARRAY_FILE
            expected = (sum(video.num_frames for video in self.videos.values()), self.num_slots, self.slot_dim)
            try:
                rows = np.load(path, mmap_mode="r", allow_pickle=False)
            except (OSError, ValueError, EOFError) as error:
                raise DataError(f"{path} cannot be read: {error}.\n{_REMOVE}") from error
            if rows.shape != expected or rows.dtype != np.float32:
                raise DataError(
                    f"{path} is {rows.dtype} of shape {rows.shape}, but its index says float32 {expected}.\n{_REMOVE}"
                )
            self._rows = rows
        return self._rows


_REMOVE = "Remove the folder to make them anew, or set data.slot_folder to another one."


def write_index(
    folder: Path, source: SlotSource, videos: Sequence[tuple[str, int, int]], *, num_slots: int, slot_dim: int
) -> None:
    """Write the index of slots that lie in ``slots.npy`` already; ``videos`` are (file, view, frames) in order."""
    entries, first = [], 0
    for file, view, num_frames in videos:
        entries.append([file, view, first, num_frames])
        first += num_frames
    content = {
        "store_version": STORE_VERSION,
        **asdict(source),
        "num_slots": num_slots,
        "slot_dim": slot_dim,
        "videos": entries,
    }
    with AtomicPath(folder / INDEX_FILE) as partial:
        partial.write_text(json.dumps(content) + "\n", encoding="utf-8")


def _read_index(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > _MAX_INDEX_BYTES:
            raise ValueError(f"more than {_MAX_INDEX_BYTES} bytes")
        content = json.loads(path.read_text(encoding="utf-8"))
        wanted = {"checkpoint_sha256", "data_digest", "resolution", "num_slots", "slot_dim", "videos"}
        if not isinstance(content, dict) or content.get("store_version") != STORE_VERSION or not wanted <= set(content):
            raise ValueError(f"not an index of version {STORE_VERSION}")
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path} cannot be read: {error}.\n{_REMOVE}") from error
    return content


def _parse(path: Path, index: dict[str, Any]) -> tuple[int, int, dict[tuple[str, int], StoredVideo]]:
    videos: dict[tuple[str, int], StoredVideo] = {}
    end = 0
    try:
        for file, view, first, num_frames in index["videos"]:
            video = StoredVideo(str(file), int(view), int(first), int(num_frames))
            if video.first != end or video.num_frames < 1 or (video.file, video.view) in videos:
                raise ValueError(f"the rows of {file}, camera {view}, are not behind those before")
            videos[video.file, video.view] = video
            end += video.num_frames
        return int(index["num_slots"]), int(index["slot_dim"]), videos
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{path} cannot be read: {error}.\n{_REMOVE}") from error


def _require_source(folder: Path, index: dict[str, Any], source: SlotSource) -> None:
    if index["checkpoint_sha256"] != source.checkpoint_sha256:
        raise CheckpointError(
            f"{folder} holds slots of another checkpoint (SHA-256 {str(index['checkpoint_sha256'])[:12]}..., but the"
            f" first training's is {source.checkpoint_sha256[:12]}...).\n"
            f"Slots and the decoder must come from one training. {_REMOVE}"
        )
    if index["data_digest"] != source.data_digest:
        raise DataError(f"{folder} holds slots of another data set, or of an older state of it.\n{_REMOVE}")
    if index["resolution"] != source.resolution:
        raise DataError(
            f"{folder} holds slots of images of {index['resolution']} pixels, but data.resolution is"
            f" {source.resolution}.\n{_REMOVE}"
        )
