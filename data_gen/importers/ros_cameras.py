"""The cameras of a bag: which image topics belong together, and what their CameraInfo messages say."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.importers.conventions import camera_matrix, checked_intrinsics, shift_principal_point
from data_gen.importers.depth_registration import DepthCamera
from data_gen.importers.ros_images import COLOUR_ENCODINGS, DEPTH_ENCODINGS, describe
from data_gen.importers.ros_mapping import CameraTopics
from data_gen.importers.ros_transforms import TransformTree, frame_name
from vpd_lightning.errors import DataError

_TRANSPORT = re.compile(r"/(compressed|compressedDepth)$")
_PINHOLE_MODELS = ("plumb_bob", "rational_polynomial", "brown conrady")
_SAME_CALIBRATION = 1e-3  # relative
_ALIGN_HINT = (
    "Record depth aligned to colour: realsense2_camera with align_depth:=true (ROS 2: align_depth.enable:=true),\n"
    "and take .../aligned_depth_to_color/image_raw. Or record the depth sensor's camera_info and tf between the\n"
    "two frames, and it is registered here. Where they do fit, say is_aligned: true in mapping=FILE."
)


@dataclass(frozen=True)
class ImageTopic:
    """What the first message of an image topic says."""

    topic: str
    encoding: str
    height: int
    width: int
    frame: str

    @property
    def is_depth(self) -> bool:
        """Whether pixels are distances."""
        return self.encoding in DEPTH_ENCODINGS

    def __str__(self) -> str:
        return f"{self.topic} ({self.encoding}, {self.width} x {self.height}, frame {self.frame or 'none'})"


@dataclass(frozen=True)
class Calibration:
    """Intrinsics (3, 3) in pixels, centres at integers as in ROS, and OpenCV's 0, 5 or 8 distortion numbers."""

    intrinsics: NDArray[np.float64]
    distortion: NDArray[np.float64]


def image_topic(topic: str, message: Any) -> ImageTopic:
    """Describe a topic by its first message."""
    encoding, height, width = describe(message, topic)
    return ImageTopic(topic, encoding, height, width, frame_name(str(message.header.frame_id)))


def find_camera(images: Sequence[ImageTopic], where: str) -> CameraTopics:
    """Return the only pair of colour and aligned depth; a raw topic is preferred to a compressed one of its name.

    Raises:
        DataError: there is none, or more than one.
    """
    listed = "\n".join(str(image) for image in images[:8]) or "It holds no images at all."
    chosen = _lossless(images)
    depth = [image for image in chosen if image.is_depth]
    colour = [image for image in chosen if image.encoding in COLOUR_ENCODINGS]
    colour = [image for image in colour if image.encoding != "mono8"] or colour  # infrared beside a colour stream
    if not depth or not colour:
        what = "colour and depth" if not depth and not colour else "depth" if not depth else "colour"
        raise DataError(f"{where} has no {what} images of a known encoding. Its images:\n{listed}")
    pairs = [(c, d) for c in colour for d in depth if _misalignment(c, d) is None]
    if not pairs and len(colour) == len(depth) == 1 and colour[0].frame != depth[0].frame:
        pairs = [(colour[0], depth[0])]  # two sensors; whether depth can be registered, the calibrations say
    if not pairs:
        raise DataError(f"{where}: {_misalignment(colour[0], depth[0])}.\n{_ALIGN_HINT}")
    if len(pairs) > 1:
        raise DataError(
            f"{where} has {len(pairs)} RGB-D pairs. Say which are cameras in mapping=FILE (rgb: ..., depth: ...)."
            f"\n{listed}"
        )
    return CameraTopics(pairs[0][0].topic, pairs[0][1].topic)


def info_topic(image: str, topics: Mapping[str, str] | Sequence[str]) -> str | None:
    """Return the CameraInfo topic beside an image topic, if it is among the topics."""
    base = _TRANSPORT.sub("", image)
    candidates = [f"{base.rpartition('/')[0]}/camera_info"]
    if base.endswith("/image/data"):  # recordings of the RealSense viewer
        candidates.append(base.removesuffix("/image/data") + "/info/camera_info")
    return next((topic for topic in candidates if topic in topics), None)


def depth_sensor(
    camera: CameraTopics,
    colour: ImageTopic,
    depth: ImageTopic,
    infos: Mapping[str, Calibration],
    tree: TransformTree,
    where: str,
) -> DepthCamera | None:
    """Return the sensor of depth that is to be registered to colour; None where it is aligned already.

    Args:
        camera: the two topics.
        colour: its first colour image.
        depth: its first depth image.
        infos: calibrations by image topic, where the bag has one.
        tree: where the frames of the two lie to each other.
        where: said in errors.

    Raises:
        DataError: sizes, frames or calibrations differ, and the bag does not say how the two lie to each other.
    """
    fault = _misalignment(colour, depth)
    own, other = infos.get(camera.rgb), infos.get(camera.depth)
    if fault is None and own is not None and other is not None and not _is_same(own, other):
        fault = f"{camera.depth} has another calibration than {camera.rgb}: depth is not aligned to colour"
    is_same_size = (colour.height, colour.width) == (depth.height, depth.width)
    if fault is None or camera.is_aligned and is_same_size:
        return None
    to_color = tree.fixed_pose(depth.frame, colour.frame) if colour.frame != depth.frame else None
    if other is None or to_color is None:
        raise DataError(f"{where}: {fault}.\n{_ALIGN_HINT}")
    intrinsics = shift_principal_point(other.intrinsics, 0.5)
    return DepthCamera(
        depth.height, depth.width, intrinsics, to_color, other.distortion if other.distortion.size else None
    )


def calibration(info: Any, image: ImageTopic, where: str) -> Calibration:
    """Read a CameraInfo message; of rectified images (``image_rect``) the matrix P counts, without distortion.

    Raises:
        DataError: it is for images of another size, for a part of the sensor, or for a lens model that is not a pinhole
            with OpenCV's polynomial distortion.
    """
    if (info.height, info.width) != (image.height, image.width):
        raise DataError(
            f"{where}: the calibration is for {info.width} x {info.height} pixels, {image.topic} has "
            f"{image.width} x {image.height}."
        )
    if max(info.binning_x, info.binning_y) > 1 or (info.roi.width, info.roi.height) not in (
        (0, 0),
        (info.width, info.height),
    ):
        raise DataError(f"{where}: binning and regions of interest in CameraInfo are not supported.")
    k, p, d = (np.asarray(_field(info, name), np.float64).ravel() for name in "kpd")
    is_rectified = "image_rect" in image.topic and p.size == 12 and p[0] > 0
    matrix = p.reshape(3, 4)[:, :3] if is_rectified else k.reshape(3, 3)
    if matrix[0, 0] <= 0:
        raise DataError(f"{where}: the camera is not calibrated (K is 0). Give K in CameraInfo, or record it again.")
    intrinsics = checked_intrinsics(
        camera_matrix(matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]), f"{where}: K"
    )
    if is_rectified or not np.any(d):
        return Calibration(intrinsics, np.zeros(0))
    model = str(info.distortion_model).replace("_", " ").lower()
    if model not in [name.replace("_", " ") for name in _PINHOLE_MODELS] or np.any(d[8:]) or d.size < 4:
        raise DataError(
            f"{where}: lens model {info.distortion_model!r} with {d.size} numbers is not supported "
            "(plumb_bob and rational_polynomial are).\nRectify the images first (image_proc); take image_rect topics."
        )
    size = 5 if d.size <= 5 else 8
    return Calibration(intrinsics, np.pad(d[:size], (0, size - min(d.size, size))))


def _lossless(images: Sequence[ImageTopic]) -> list[ImageTopic]:
    """Keep one of several transports of the same images: raw, or else the first."""
    ranks = {"": 0, "/compressedDepth": 1, "/compressed": 2}
    best: dict[str, ImageTopic] = {}
    for image in sorted(images, key=lambda image: ranks[_suffix(image.topic)]):
        best.setdefault(_TRANSPORT.sub("", image.topic), image)
    return sorted(best.values(), key=lambda image: image.topic)


def _suffix(topic: str) -> str:
    found = _TRANSPORT.search(topic)
    return found[0] if found else ""


def _misalignment(colour: ImageTopic, depth: ImageTopic) -> str | None:
    """Say why depth cannot be aligned to colour, as far as sizes and frames show."""
    if (colour.height, colour.width) != (depth.height, depth.width):
        return f"depth is not aligned to colour: {colour} and {depth} differ in size"
    if colour.frame != depth.frame:
        return f"depth is not aligned to colour: {colour} and {depth} are in different frames"
    return None


def _is_same(first: Calibration, second: Calibration) -> bool:
    return np.allclose(first.intrinsics, second.intrinsics, rtol=_SAME_CALIBRATION, atol=0.0)


def _field(info: Any, name: str) -> Any:
    """Return a field that ROS 1 writes as a capital letter, ROS 2 as a small one."""
    return getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())
