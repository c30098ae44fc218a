"""MOVi data sets as TensorFlow Datasets stores them: ``movi_a-train.tfrecord-00000-of-01024`` and so on.

Each record is one video of one camera. Depth is stored as 16-bit steps over the ``depth_range`` of its video, and is
the distance to the camera's centre. The 128x128 builds took every second pixel of depth, starting with the first, but
averaged colour over 2x2 pixels: their depth is sampled a quarter of a pixel up and left of the pixel's centre.
TensorFlow is not needed. Listing the videos reads only their cameras; checksums are verified when images are read.
"""

import json
import re
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from data_gen.importers.kubric_camera import (
    BACKGROUND,
    FRAME_RATE,
    kubric_depth,
    kubric_intrinsics,
    kubric_poses,
    kubric_source,
)
from data_gen.importers.recording import Recording
from data_gen.importers.settings import ImportSettings
from data_gen.importers.tf_record import FeatureValues, RecordSpan, map_record, parse_example, read_record, record_spans
from vpd_lightning.errors import DataError

FORMAT = "movi"
_SHARD = re.compile(r"(?P<name>.+)-(?P<split>[^-]+)\.tfrecord(-(?P<shard>\d+)-of-(?P<shards>\d+))?$")
_DEPTH_STEPS = 65535
_SPLITS = {"train": "train", "validation": "validation", "test": "test"}
_CAMERA = ("focal_length", "sensor_width", "field_of_view", "positions", "quaternions")
_METADATA = ("video_name", "height", "width", "num_frames", "depth_range")
_IMAGES = ("video", "depth")
_NAMES = frozenset(
    [*(f"camera/{name}" for name in _CAMERA), *(f"metadata/{name}" for name in _METADATA), *_IMAGES],
)


def matches(path: Path) -> bool:
    """Tell whether the path is a TFRecord file, or a folder with some (itself or up to three folders below)."""
    if path.is_file():
        return _SHARD.match(path.name) is not None
    return bool(_shard_folders(path))


def recordings(path: Path, settings: ImportSettings) -> Iterator[Recording]:
    """Read all videos, shard by shard.

    Raises:
        DataError: a file is damaged or cut short, features are missing, or the folder holds several builds.
    """
    for shard in _shards(path):
        found = _SHARD.match(shard.name)
        assert found is not None
        count = 0
        for span in record_spans(shard):
            try:
                recording = _recording(span, found["split"], settings)
            except DataError:
                read_record(span)  # a wrong checksum is the better explanation
                raise
            yield recording
            count += 1
        expected = _expected_records(shard, found["split"], int(found["shard"] or 0))
        if expected is not None and count != expected:
            raise DataError(f"{shard} has {count} records, dataset_info.json says {expected}.\nCopy that file again.")


def _shards(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    folders = _shard_folders(path)
    if not folders:
        raise DataError(f"{path} holds no TFRecord files (NAME-train.tfrecord-00000-of-00010).")
    if len(folders) > 1:
        listed = ", ".join(str(folder.relative_to(path)) for folder in folders[:4])
        raise DataError(f"{path} holds {len(folders)} builds: {listed}.\nImport one of these folders at a time.")
    return sorted(shard for shard in folders[0].iterdir() if _SHARD.match(shard.name))


def _shard_folders(path: Path) -> list[Path]:
    for pattern in ("", "*/", "*/*/", "*/*/*/"):
        folders = sorted({shard.parent for shard in path.glob(f"{pattern}*.tfrecord*") if _SHARD.match(shard.name)})
        if folders:
            return folders
    return []


def _expected_records(shard: Path, split: str, index: int) -> int | None:
    """Return how many records ``dataset_info.json`` says the shard has; None where it does not say."""
    path = shard.parent / "dataset_info.json"
    if not path.is_file():
        return None
    try:
        splits = json.loads(path.read_text())["splits"]
        lengths = next(entry["shardLengths"] for entry in splits if entry["name"] == split)
        return int(lengths[index])
    except (OSError, ValueError, KeyError, TypeError, IndexError, StopIteration):
        return None


def _recording(span: RecordSpan, split: str, settings: ImportSettings) -> Recording:
    example = parse_example(map_record(span), _NAMES, span)
    missing = [name for name in ("video", "depth", "metadata/depth_range") if name not in example]
    if missing:
        raise DataError(f"{span} has no {', '.join(missing)}. Is this a MOVi data set?")
    video, depth = _images(example, "video", span), _images(example, "depth", span)
    num_frames = len(video)
    if len(depth) != num_frames or num_frames == 0:
        raise DataError(f"{span} has {num_frames} colour and {len(depth)} depth images.")
    height, width = _size(example, video[0], span)
    low, high = _depth_range(example, span)
    camera = {name: example[f"camera/{name}"] for name in _CAMERA if f"camera/{name}" in example}
    intrinsics = kubric_intrinsics(camera, height, width, settings, f"{span}, camera")
    poses = kubric_poses(camera, num_frames, settings, f"{span}, camera")

    def read_rgb(frame: int, view: int) -> NDArray[np.uint8]:
        image = _decode(_images(_example(span), "video", span)[frame], cv2.IMREAD_COLOR, (height, width), span, frame)
        return np.ascontiguousarray(image[..., ::-1])

    def read_depth(frame: int, view: int) -> NDArray[np.float32]:
        codes = _decode(
            _images(_example(span), "depth", span)[frame], cv2.IMREAD_UNCHANGED, (height, width), span, frame
        )
        if codes.dtype != np.uint16 or codes.ndim != 2:
            raise DataError(f"{span}, frame {frame}: depth is {codes.dtype} {codes.shape}; 16-bit grey was expected.")
        return kubric_depth(codes / _DEPTH_STEPS * (high - low) + low, intrinsics, settings)

    return Recording(
        name=_name(example, span, split),
        height=height,
        width=width,
        intrinsics=intrinsics[None],
        cam_to_world=poses[None] if poses.ndim == 2 else poses[:, None],
        num_frames=num_frames,
        num_views=1,
        frame_time=settings.frame_time or 1.0 / FRAME_RATE,
        read_rgb=read_rgb,
        read_depth=read_depth,
        source={
            **kubric_source(FORMAT, settings),
            "depth_unit": str((high - low) / _DEPTH_STEPS * (settings.depth_scale or 1.0)),
        },
        split=_SPLITS.get(split),
    )


@lru_cache(maxsize=1)  # the frames of one video are read one after the other
def _example(span: RecordSpan) -> dict[str, FeatureValues]:
    return parse_example(read_record(span), _NAMES, span)


def _images(example: Mapping[str, FeatureValues], name: str, span: RecordSpan) -> list[memoryview]:
    images = example[name]
    if not isinstance(images, list):
        raise DataError(f"{span}: {name} holds numbers; encoded images were expected.")
    return images


def _decode(data: memoryview, flags: int, size: tuple[int, int], span: RecordSpan, frame: int) -> NDArray[Any]:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if len(data) else None
    if image is None:
        raise DataError(f"{span}, frame {frame}: an image cannot be decoded.")
    if image.shape[:2] != size:
        raise DataError(
            f"{span}, frame {frame}: an image is {image.shape[1]} x {image.shape[0]} pixels, not {size[1]} x {size[0]}."
        )
    return image


def _size(example: Mapping[str, FeatureValues], first: memoryview, span: RecordSpan) -> tuple[int, int]:
    if "metadata/height" in example and "metadata/width" in example:
        return int(_first(example, "metadata/height", span)), int(_first(example, "metadata/width", span))
    image = cv2.imdecode(np.frombuffer(first, np.uint8), cv2.IMREAD_UNCHANGED) if len(first) else None
    if image is None:
        raise DataError(f"{span}: the first image cannot be decoded.")
    return image.shape[0], image.shape[1]


def _depth_range(example: Mapping[str, FeatureValues], span: RecordSpan) -> tuple[float, float]:
    values = example["metadata/depth_range"]
    if len(values) != 2 or isinstance(values, list) or not np.isfinite(values).all() or not 0 <= values[0] <= values[1]:
        raise DataError(f"{span}: depth_range is not two distances in metres, smallest first.")
    low, high = map(float, values)
    if high >= BACKGROUND:
        step = (high - low) / _DEPTH_STEPS
        raise DataError(
            f"{span}: depth reaches {high:.3g} m (empty background), so one of its 16-bit steps is {step:.3g} m.\n"
            "Nothing is left of the scene's depth; render it with a background object, or import Kubric's folders."
        )
    return low, high


def _name(example: Mapping[str, FeatureValues], span: RecordSpan, split: str) -> str:
    names = example.get("metadata/video_name")
    if isinstance(names, list) and names:
        return f"{split}/{bytes(names[0]).decode(errors='replace')}"
    return f"{split}/{span.path.name}/{span.index}"


def _first(example: Mapping[str, FeatureValues], name: str, span: RecordSpan) -> float:
    values = example[name]
    if len(values) == 0 or isinstance(values, list):
        raise DataError(f"{span}: {name} holds no number.")
    return float(values[0])
