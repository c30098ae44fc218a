"""ROS 1 bags, ROS 2 bags (SQLite, MCAP) and recordings of RealSense cameras.

Depth is aligned to colour, or is registered to it here where the bag has the depth sensor's calibration and its place.

Frames are the colour images of the first camera; a depth image, and the images of other cameras, belong to them when
they are the nearest in time and within ``max_time_difference``. Each camera's pose is that of its optical frame (x
right, y down, z forward) in the world frame, interpolated at its image's time, or the constant pose in the mapping
file. Where something is missing, the recording is cut. A bag is read once from start to end for its times and poses;
images are fetched when they are written.
"""

import re
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.importers.conventions import distance_to_z, opengl_to_opencv, shift_principal_point
from data_gen.importers.depth_registration import DepthCamera
from data_gen.importers.frame_times import Times, nearest, pose_gap, runs_without_gap, usual_step
from data_gen.importers.recording import MIN_FRAMES, Recording
from data_gen.importers.ros_cameras import (
    Calibration,
    ImageTopic,
    calibration,
    depth_sensor,
    find_camera,
    image_topic,
    info_topic,
)
from data_gen.importers.ros_file import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, TRANSFORMS, Bag, Entry, bag_paths
from data_gen.importers.ros_images import colour_image, depth_image
from data_gen.importers.ros_mapping import CameraTopics, RosMapping, read_ros_mapping
from data_gen.importers.ros_transforms import TransformTree, frame_name
from data_gen.importers.settings import ImportSettings, chosen
from vpd_lightning.data.driven_motion import DrivenMotion
from vpd_lightning.errors import DataError

FORMAT = "ros"
_METRES_PER_STEP = 0.001  # REP 118
_DEPTH_UNITS = re.compile(r"(?P<sensor>.*)/option/Depth[_ ]Units/value$")  # of the RealSense viewer's recordings


def matches(path: Path) -> bool:
    """Tell whether the path is a bag or a folder of bags."""
    return bool(bag_paths(path))


def recordings(path: Path, settings: ImportSettings) -> Iterator[Recording]:
    """Read one bag, or all bags in a folder; one recording per stretch without a gap.

    Raises:
        ConfigError: ``rosbags`` is not installed, or the mapping file is wrong.
        DataError: the bag is damaged, poses or calibration are missing, depth is not aligned to colour, ...
    """
    paths = bag_paths(path)
    if not paths:
        raise DataError(f"{path} holds no ROS bag (.bag, .db3, .mcap, or a folder with metadata.yaml).")
    mapping = read_ros_mapping(Path(settings.mapping)) if settings.mapping else RosMapping()
    for bag_path in paths:
        yield from _bag_recordings(Bag(bag_path), mapping, settings)


@dataclass
class _Contents:
    """What one pass over a bag finds."""

    images: dict[str, list[tuple[int, Entry]]] = field(default_factory=lambda: defaultdict(list))  # (stamp, entry)
    infos: dict[str, Any] = field(default_factory=dict)
    tree: TransformTree = field(default_factory=TransformTree)
    depth_units: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _Camera:
    """One camera of a bag, ready to be read."""

    topics: CameraTopics
    image: ImageTopic
    calibration: Calibration
    depth_scale: float
    times: Times
    entries: list[Entry]
    depth_times: Times
    depth_entries: list[Entry]
    sensor: DepthCamera | None  # of depth that is not aligned to colour


def _bag_recordings(bag: Bag, mapping: RosMapping, settings: ImportSettings) -> Iterator[Recording]:
    try:
        topics = bag.topics()
        images = _image_topics(bag, topics, mapping)
        chosen_cameras = mapping.cameras or (find_camera(list(images.values()), str(bag.path)),)
        contents = _scan(bag, topics, chosen_cameras)
        cameras = [_camera(bag, camera, images, topics, contents, settings) for camera in chosen_cameras]
    finally:
        bag.close()
    difference = round(settings.max_time_difference * 1e9)
    times = cameras[0].times
    colour = [nearest(camera.times, times, difference) for camera in cameras]
    depth = [nearest(camera.depth_times, times, difference) for camera in cameras]
    is_imaged = np.all([index >= 0 for index in (*colour, *depth)], axis=0)
    tracked = [_poses(bag, camera, mapping, contents.tree, settings) for camera in cameras]
    is_posed = np.all([known[index] for index, (_, known) in zip(colour, tracked, strict=True)], axis=0)
    links = _robot(bag, cameras[0], mapping, contents.tree, settings)
    if links is not None:
        is_posed &= links[1]
    frames = np.flatnonzero(is_imaged & is_posed)
    frame_time = usual_step(times)
    stretches = runs_without_gap(times[frames], frame_time) if len(frames) else []
    if not stretches:
        raise DataError(
            f"{bag.path}: of {len(times)} colour images {int(is_imaged.sum())} have all other images within "
            f"{settings.max_time_difference} s and {int(is_posed.sum())} all poses; nowhere do {MIN_FRAMES} follow "
            "each other.\nDo all sensors use one clock? Otherwise raise max_time_difference."
        )
    for number, stretch in enumerate(stretches):
        kept = frames[stretch]
        yield _recording(
            bag,
            bag.path.stem if len(stretches) == 1 else f"{bag.path.stem}/part{number}",
            cameras,
            [[camera.entries[i] for i in index[kept]] for camera, index in zip(cameras, colour, strict=True)],
            [[camera.depth_entries[i] for i in index[kept]] for camera, index in zip(cameras, depth, strict=True)],
            np.stack([poses[index[kept]] for index, (poses, _) in zip(colour, tracked, strict=True)], axis=1),
            settings.frame_time or frame_time,
            settings,
            None if links is None or mapping.robot is None else mapping.robot.motion(links[0][kept]),
        )


def _image_topics(bag: Bag, topics: dict[str, str], mapping: RosMapping) -> dict[str, ImageTopic]:
    """Describe the mapped image topics, or all of them."""
    wanted = [topic for camera in mapping.cameras for topic in (camera.rgb, camera.depth)]
    images = [topic for topic, kind in topics.items() if kind in (IMAGE, COMPRESSED_IMAGE)]
    for topic in wanted:
        if topic not in images:
            raise DataError(f"{bag.path} has no images on {topic}.\nIt has {', '.join(sorted(images)) or 'none'}.")
    found = {}
    for topic in wanted or images:
        first = next(bag.scan([topic]), None)
        if first is None:
            raise DataError(f"{bag.path} is damaged: its index counts messages on {topic}, and there are none.")
        message = first[2]
        try:
            found[topic] = image_topic(topic, message)
        except DataError:
            if wanted:
                raise  # others may be videos (h264) in CompressedImage messages, which are nobody's camera here
    return found


def _scan(bag: Bag, topics: dict[str, str], cameras: tuple[CameraTopics, ...]) -> _Contents:
    """Read times, calibrations and transforms in one pass."""
    contents = _Contents()
    images = {topic for camera in cameras for topic in (camera.rgb, camera.depth)}
    infos = {topic for camera in cameras for topic in _info_topics(camera, topics) if topic is not None}
    transforms = {topic for topic, kind in topics.items() if kind in TRANSFORMS}
    units = {topic for topic in topics if _DEPTH_UNITS.match(topic)}
    for topic, entry, message in bag.scan([*images, *infos, *transforms, *units]):
        if topic in images:
            contents.images[topic].append((_stamp(message.header.stamp) or entry.time, entry))
        elif topic in infos:
            before = contents.infos.setdefault(topic, message)
            if not np.array_equal(_k(before), _k(message)):
                raise DataError(
                    f"{bag.path}: the calibration on {topic} changes while recording; that is not supported."
                )
        elif topic in units:
            contents.depth_units[topic] = float(message.data)
        else:
            for transform in message.transforms:
                move, turn = transform.transform.translation, transform.transform.rotation
                contents.tree.add(
                    transform.header.frame_id,
                    transform.child_frame_id,
                    _stamp(transform.header.stamp) or entry.time,
                    (move.x, move.y, move.z),
                    (turn.x, turn.y, turn.z, turn.w),
                    topic.endswith("tf_static"),
                )
    return contents


def _camera(
    bag: Bag,
    camera: CameraTopics,
    images: dict[str, ImageTopic],
    topics: dict[str, str],
    contents: _Contents,
    settings: ImportSettings,
) -> _Camera:
    calibrations = {}
    for image, info in zip((camera.rgb, camera.depth), _info_topics(camera, topics), strict=True):
        if info is not None and (image == camera.rgb or not camera.is_aligned):
            calibrations[image] = calibration(contents.infos[info], images[image], f"{bag.path}, {info}")
    pair = images[camera.rgb], images[camera.depth]
    sensor = depth_sensor(camera, *pair, calibrations, contents.tree, str(bag.path))
    if camera.rgb not in calibrations:
        wanted = camera.info or f"{camera.rgb.rpartition('/')[0]}/camera_info"
        raise DataError(
            f"{bag.path}: the calibration of {camera.rgb} is missing: no CameraInfo on {wanted}.\n"
            "Record camera_info too, or name its topic in mapping=FILE (info: ...)."
        )
    times, entries = _in_order(contents.images[camera.rgb])
    depth_times, depth_entries = _in_order(contents.images[camera.depth])
    scale = settings.depth_scale or camera.depth_scale or _depth_unit(camera.depth, contents) or _METRES_PER_STEP
    return _Camera(camera, pair[0], calibrations[camera.rgb], scale, times, entries, depth_times, depth_entries, sensor)


def _poses(
    bag: Bag, camera: _Camera, mapping: RosMapping, tree: TransformTree, settings: ImportSettings
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return poses (time, 4, 4) at the times of a camera's colour images, and which are known."""
    given = camera.topics.cam_to_world
    if given is not None:
        return np.repeat(given[None], len(camera.times), axis=0), np.ones(len(camera.times), bool)
    frame = frame_name(camera.topics.frame or camera.image.frame)
    if frame not in tree.frames:
        raise DataError(
            f"{bag.path}: tf does not know {frame or 'the camera (its images have no frame_id)'}; the camera's pose is "
            f"missing.\nGive it in mapping=FILE (cam_to_world: 4x4), or name another frame of: "
            f"{', '.join(tree.frames[:12]) or 'none, the bag has no tf'}."
        )
    world = mapping.world_frame or tree.root(frame)
    poses, known = tree.poses(frame, world, camera.times, pose_gap(settings.max_time_difference))
    return (opengl_to_opencv(poses) if settings.axes == "opengl" else poses), known


def _robot(
    bag: Bag, first: _Camera, mapping: RosMapping, tree: TransformTree, settings: ImportSettings
) -> tuple[NDArray[np.float64], NDArray[np.bool_]] | None:
    """Return poses (time, link, 4, 4) of the robot's links at the times of the first camera; None without a robot."""
    if mapping.robot is None:
        return None
    gap, where = pose_gap(settings.max_time_difference), str(bag.path)
    world = mapping.world_frame or tree.root(first.topics.frame or first.image.frame)
    return mapping.robot.poses(tree, world, first.times, gap, where)


def _recording(
    bag: Bag,
    name: str,
    cameras: list[_Camera],
    colour: list[list[Entry]],
    depth: list[list[Entry]],
    poses: NDArray[np.float64],
    frame_time: float,
    settings: ImportSettings,
    driven: DrivenMotion | None,
) -> Recording:
    first = cameras[0].image
    for camera in cameras[1:]:
        if (camera.image.height, camera.image.width) != (first.height, first.width):
            raise DataError(f"{bag.path}: {first} and {camera.image} differ in size; all cameras must have the same.")
    is_centred = chosen(settings.pixel_center, "0.0") == "0.5"
    intrinsics = np.stack([camera.calibration.intrinsics for camera in cameras])
    intrinsics = intrinsics if is_centred else shift_principal_point(intrinsics, 0.5)
    size = max(camera.calibration.distortion.size for camera in cameras)
    distortions = [
        np.pad(camera.calibration.distortion, (0, size - camera.calibration.distortion.size)) for camera in cameras
    ]

    def checked(image: NDArray[Any], topic: str, sensor: DepthCamera | None = None) -> NDArray[Any]:
        taken_by = sensor or first
        if image.shape[:2] != (taken_by.height, taken_by.width):
            raise DataError(f"{bag.path}: images on {topic} change their size while recording.")
        return image

    def read_rgb(frame: int, view: int) -> NDArray[np.uint8]:
        topic = cameras[view].topics.rgb
        return checked(colour_image(bag.message(topic, colour[view][frame]), f"{bag.path}, {topic}"), topic)

    def read_depth(frame: int, view: int) -> NDArray[np.float32]:
        camera, topic = cameras[view], cameras[view].topics.depth
        message = bag.message(topic, depth[view][frame])
        metres = depth_image(message, camera.depth_scale, settings.depth_scale or 1.0, f"{bag.path}, {topic}")
        metres = checked(metres, topic, camera.sensor)
        if chosen(settings.depth, "z") == "distance":
            if camera.sensor is not None:
                return distance_to_z(metres, camera.sensor.intrinsics, camera.sensor.distortion)
            return distance_to_z(metres, intrinsics[view], distortions[view] if size else None)
        return metres.astype(np.float32)

    is_still = bool((poses == poses[0]).all())
    return Recording(
        name=name,
        height=first.height,
        width=first.width,
        intrinsics=intrinsics,
        cam_to_world=np.ascontiguousarray(poses[0] if is_still else poses),
        num_frames=len(poses),
        num_views=len(cameras),
        frame_time=frame_time,
        read_rgb=read_rgb,
        read_depth=read_depth,
        source={
            "format": FORMAT,
            "axes": chosen(settings.axes, "opencv"),
            "depth_type": chosen(settings.depth, "z"),
            "depth_unit": ",".join(f"{camera.depth_scale:.9g}" for camera in cameras),
            "pixel_center": chosen(settings.pixel_center, "0.0"),
        },
        depth_cameras=[camera.sensor for camera in cameras],
        view_names=[camera.topics.name or camera.topics.rgb for camera in cameras],
        distortion=np.stack(distortions) if size else None,
        driven=driven,
    )


def _info_topics(camera: CameraTopics, topics: dict[str, str]) -> tuple[str | None, str | None]:
    """Return the CameraInfo topics of colour and depth, where the bag has them."""
    infos = [topic for topic, kind in topics.items() if kind == CAMERA_INFO]
    own = (camera.info if camera.info in infos else None) if camera.info else info_topic(camera.rgb, infos)
    return own, info_topic(camera.depth, infos)


def _depth_unit(topic: str, contents: _Contents) -> float | None:
    """Return the metres per step that a RealSense recording holds for the sensor of a depth topic."""
    for option, value in contents.depth_units.items():
        found = _DEPTH_UNITS.match(option)
        if found and topic.startswith(found["sensor"] + "/") and value > 0:
            return value
    return None


def _in_order(stamped: list[tuple[int, Entry]]) -> tuple[Times, list[Entry]]:
    """Sort messages by their stamps, and drop repeated ones."""
    unique = dict(sorted(stamped, reverse=True))
    times = sorted(unique)
    return np.array(times, np.int64), [unique[time] for time in times]


def _stamp(stamp: Any) -> int:
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _k(info: Any) -> Any:
    return info.k if hasattr(info, "k") else info.K
