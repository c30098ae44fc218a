"""The files of a LeRobot v3 data set: which episode lies where, and the rows of its Parquet tables."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.importers.images import decode_image
from data_gen.importers.source_files import inside, positive, read_json
from data_gen.settings import did_you_mean
from vpd_lightning.errors import ConfigError, DataError

_SPLITS = {"train": "train", "val": "validation", "valid": "validation", "validation": "validation", "test": "test"}
_DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"


@dataclass(frozen=True)
class Episode:
    """One row of ``meta/episodes``: its number, length and place."""

    index: int
    num_frames: int
    row: dict[str, Any]
    split: str | None

    def __str__(self) -> str:
        return f"episode {self.index}"


class LeRobotFolder:
    """One data set on disk.

    Raises:
        ConfigError: at construction, when pyarrow is not installed.
        DataError: at construction, when the data set is of another version.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._parquet = _import_parquet()
        info = read_json(path / "meta" / "info.json")
        version = str(info.get("codebase_version"))
        if not version.startswith("v3"):
            raise DataError(
                f"{path} is a LeRobot data set of version {version}; version 3 can be imported.\n"
                "Convert it first: python -m lerobot.scripts.convert_dataset_v21_to_v30 (from version 2.1)."
            )
        features = info.get("features")
        if not isinstance(features, dict) or not all(isinstance(x, dict) and "dtype" in x for x in features.values()):
            raise DataError(f"{path}/meta/info.json: 'features' does not say what the columns are.")
        self.features: dict[str, dict[str, Any]] = features
        self.fps = positive(info, "fps", f"{path}/meta/info.json")
        self._data_path = str(info.get("data_path") or _DATA_PATH)
        self._video_path = str(info.get("video_path") or _VIDEO_PATH)
        splits = info.get("splits")
        self._splits: dict[str, Any] = splits if isinstance(splits, dict) else {}
        self._group = lru_cache(maxsize=4)(self._read_group)
        self._rows = lru_cache(maxsize=64)(self._read_rows)
        self._open = lru_cache(maxsize=16)(self._open_file)

    def feature(self, name: str, where: str) -> dict[str, Any]:
        """Return what ``meta/info.json`` says of a feature; ``where`` says who asks for it."""
        if name not in self.features:
            near = did_you_mean(name, self.features)
            raise ConfigError(f"{where}: there is no feature {name!r}{near}\nFeatures: {', '.join(self.features)}.")
        return self.features[name]

    def image_size(self, name: str) -> tuple[int, int]:
        """Return (height, width) of an image or video feature."""
        feature = self.features[name]
        shape, names = feature.get("shape"), feature.get("names")
        if isinstance(shape, list) and len(shape) == 3 and all(isinstance(x, int) and x > 0 for x in shape):
            is_channels_first = isinstance(names, list) and str(names[0]).startswith("c")
            return (shape[1], shape[2]) if is_channels_first else (shape[0], shape[1])
        raise DataError(f"{self.path}/meta/info.json: feature {name!r} has no image shape ({shape}).")

    def episodes(self) -> Iterator[Episode]:
        """List all episodes."""
        files = sorted((self.path / "meta" / "episodes").glob("chunk-*/file-*.parquet"))
        if not files:
            raise DataError(f"{self.path}/meta/episodes holds no file-*.parquet.")
        for file in files:
            names = self._schema_names(file)
            columns = [name for name in names if not name.startswith("stats/") and name != "tasks"]
            for row in self._table(file, columns).to_pylist():
                index, length = row.get("episode_index"), row.get("length")
                if not isinstance(index, int) or not isinstance(length, int) or length < 1:
                    raise DataError(f"{file}: episode {index} has length {length}.")
                yield Episode(index, length, row, self._split(index))

    def numbers(self, episode: Episode, columns: Sequence[str]) -> dict[str, NDArray[np.float64]]:
        """Return features of numbers, each (time, number) in float64."""
        if not columns:
            return {}
        file = self._data_file(episode)
        table = self._table(file, list(dict.fromkeys(columns))).take(
            self._rows(file, episode.index, episode.num_frames)
        )
        found = {}
        for name in table.column_names:
            try:
                values = np.array(table.column(name).to_pylist(), np.float64)
            except (TypeError, ValueError) as error:
                raise DataError(f"{file}: {name} of {episode} is not a table of numbers.") from error
            found[name] = values.reshape(len(values), -1)
        return found

    def image(self, episode: Episode, name: str, frame: int, flags: int) -> NDArray[Any]:
        """Decode an image that is stored in the table (or named by it)."""
        file = self._data_file(episode)
        row = int(self._rows(file, episode.index, episode.num_frames)[frame])
        groups = self._open(file).metadata
        group = 0
        while row >= groups.row_group(group).num_rows:
            row -= groups.row_group(group).num_rows
            group += 1
        value = self._group(file, group, name).column(name)[row].as_py()
        where = f"{file}: {name} of {episode}, frame {frame}"
        if isinstance(value, dict) and isinstance(value.get("bytes"), bytes):
            return decode_image(np.frombuffer(value["bytes"], np.uint8), flags, where)
        if isinstance(value, dict) and value.get("path"):
            path = inside(self.path, value["path"], where)
            if not path.is_file():
                raise DataError(f"{path} is missing.")
            return decode_image(np.fromfile(path, np.uint8), flags, str(path))
        raise DataError(f"{where} is no image.")

    def video(self, episode: Episode, name: str, frame: int) -> tuple[Path, float]:
        """Return the video file that holds a frame, and the time in it (s)."""
        start = episode.row.get(f"videos/{name}/from_timestamp")
        if not isinstance(start, float | int) or not np.isfinite(start) or start < 0:
            raise DataError(f"{self.path}: {episode} does not say where its video of {name} begins.")
        path = self._placed(self._video_path, episode, f"videos/{name}", video_key=name)
        return path, float(start) + frame / self.fps

    def _split(self, index: int) -> str | None:
        """Return the split of an episode where ``info.json`` has more than one ("train": "0:50")."""
        if len(self._splits) < 2:
            return None
        for name, interval in self._splits.items():
            first, _, last = str(interval).partition(":")
            if first.isdigit() and last.isdigit() and int(first) <= index < int(last):
                return _SPLITS.get(name)
        return None

    def _placed(self, pattern: str, episode: Episode, prefix: str, **names: str) -> Path:
        chunk, file = (episode.row.get(f"{prefix}/{key}") for key in ("chunk_index", "file_index"))
        if not isinstance(chunk, int) or not isinstance(file, int):
            raise DataError(f"{self.path}: {episode} does not say which file holds its {prefix}.")
        name = pattern
        for key, value in {"chunk_index": chunk, "file_index": file}.items():
            name = re.sub(rf"\{{{key}(?::0?(\d)d)?\}}", lambda m, v=value: f"{v:0{m.group(1) or 1}d}", name)  # type: ignore[misc]
        for key, text in names.items():
            name = name.replace(f"{{{key}}}", text)
        if "{" in name:
            raise DataError(f"{self.path}/meta/info.json: the path {pattern!r} cannot be filled in.")
        path = inside(self.path, name, f"{self.path}/meta/info.json: path")
        if not path.is_file():
            raise DataError(f"{path} is missing; {episode} needs it. Was the data set downloaded completely?")
        return path

    def _data_file(self, episode: Episode) -> Path:
        return self._placed(self._data_path, episode, "data")

    def _read_rows(self, file: Path, index: int, num_frames: int) -> NDArray[np.int64]:
        table = self._table(file, ["episode_index", "frame_index"])
        found = table.column("episode_index").to_numpy() == index
        rows = np.flatnonzero(found)
        rows = rows[np.argsort(table.column("frame_index").to_numpy()[rows], kind="stable")]
        if len(rows) != num_frames:
            raise DataError(f"{file} has {len(rows)} rows of episode {index}; meta/episodes says {num_frames}.")
        return rows

    def _schema_names(self, file: Path) -> list[str]:
        return list(self._open(file).schema_arrow.names)

    def _open_file(self, file: Path) -> Any:
        try:
            return self._parquet.ParquetFile(file)
        except (OSError, ValueError) as error:
            raise DataError(f"{file} cannot be read as Parquet: {' '.join(str(error).split())[:200]}.") from error

    def _table(self, file: Path, columns: list[str]) -> Any:
        missing = [name for name in columns if name not in self._schema_names(file)]
        if missing:
            raise DataError(f"{file} has no column {missing[0]!r}.")
        try:
            return self._open(file).read(columns=columns)
        except (OSError, ValueError) as error:
            raise DataError(f"{file} cannot be read: {' '.join(str(error).split())[:200]}.") from error

    def _read_group(self, file: Path, group: int, name: str) -> Any:
        try:
            return self._open(file).read_row_group(group, columns=[name])
        except (OSError, ValueError) as error:
            raise DataError(f"{file} cannot be read: {' '.join(str(error).split())[:200]}.") from error


def _import_parquet() -> ModuleType:
    try:
        import pyarrow.parquet
    except ImportError as error:
        raise ConfigError('Reading LeRobot data sets needs pyarrow: pip install "vpd-lightning[lerobot]"') from error
    return pyarrow.parquet
