"""LeRobot v3 data sets: episodes in Parquet, videos per camera, and a mapping file that says what is what.

LeRobot has no standard names for camera matrices, so a YAML file names them: ``mapping=my_robot.yaml``::

    views:
      - name: front
        rgb: observation.images.front                 # a video or image feature
        depth: observation.images.front_depth         # a 12-bit gray video, or an image feature (16-bit, TIFF)
        # depth_range: [0.01, 10.0]                   # videos: metres of codes 0 and 4095, unless meta/info.json says
        # depth_log: true                             #   even steps of log(depth + depth_shift), unless it says
        # depth_shift: 3.5
        # depth_unit: 0.001                           # images: metres per step of whole numbers, or per unit of floats
        depth_type: z                                 # z (along the optical axis) | distance (to the camera centre)
        intrinsics: {fx: 615.0, fy: 615.0, cx: 320.0, cy: 240.0}  # pixels; or a 3x3 matrix, or a feature of 9 numbers
        pixel_center: 0.0                             # the first pixel's centre: 0.0 (OpenCV, RealSense) | 0.5
        world_to_cam: observation.camera.extrinsic_cv # or cam_to_world; a feature of 12 or 16 numbers (row by row),
                                                      # of 7 (position, quaternion), or a constant 3x4 or 4x4 matrix
        axes: opencv                                  # opencv (x right, y down, z forward) | opengl (y up, z back)
        # quaternion: wxyz                            # order of the quaternion, where the pose has 7 numbers: or xyzw
        # distortion: [k1, k2, p1, p2, k3]
      - name: wrist
        ...
    robot:                                            # optional: its links become points whose motion is given
      model: arm.xml                                  # MJCF or URDF, beside the mapping
      state: observation.state                        # joint positions: metres of sliding joints, else ``unit``
      joints: [shoulder, elbow, null]                 # the model's joint of each number; null: a number that is none
      unit: rad                                       # rad | deg
      # command: action                               # joint positions that were asked for
      # base: [[...], [...], [...], [0, 0, 0, 1]]     # 4x4, the model's world to the cameras'; the same without
      # points: 256                                   # on its surface

Each episode becomes a recording. ManiSkill's exports have ``extrinsic_cv`` (world to camera, OpenCV axes),
``cam2world_gl`` and ``intrinsic_cv``. In depth videos the first and the last code count as no measurement: they also
hold all that lies out of range.

Needs pyarrow and PyAV: ``pip install "vpd-lightning[lerobot]"``.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from data_gen.importers.conventions import (
    checked_intrinsics,
    checked_pose,
    distance_to_z,
    invert_pose,
    join_views,
    opengl_to_opencv,
    pose_matrix,
    rotation_from_quaternion,
    shift_principal_point,
)
from data_gen.importers.images import depth_in_metres
from data_gen.importers.lerobot_mapping import LeRobotMapping, MappedView, read_lerobot_mapping
from data_gen.importers.lerobot_tables import Episode, LeRobotFolder
from data_gen.importers.recording import Recording
from data_gen.importers.settings import ImportSettings, chosen
from data_gen.importers.video_file import VideoCache, gray_of, import_av, rgb_of
from vpd_lightning.errors import ConfigError, DataError

FORMAT = "lerobot"

Array = NDArray[np.float64]


def matches(path: Path) -> bool:
    """Tell whether the folder has LeRobot's ``meta/info.json``."""
    return (path / "meta" / "info.json").is_file()


def recordings(path: Path, settings: ImportSettings) -> Iterator[Recording]:
    """Read one data set; each episode is a recording.

    Raises:
        ConfigError: the mapping is missing or does not fit, or pyarrow or PyAV are not installed.
        DataError: the data set is of another version, or broken.
    """
    mapping = read_lerobot_mapping(settings.mapping)
    folder = LeRobotFolder(path)
    for name in mapping.robot.features if mapping.robot is not None else ():
        folder.feature(name, "mapping, robot")
    for view in mapping.views:
        for kind, name in (("rgb", view.rgb), ("depth", view.depth)):
            if folder.feature(name, f"mapping, view {view.name}: {kind}")["dtype"] == "video":
                import_av()
        for value in (view.intrinsics, view.pose):
            if isinstance(value, str):
                folder.feature(value, f"mapping, view {view.name}")
    videos = VideoCache()
    for episode in folder.episodes():
        yield _recording(folder, episode, mapping, videos, settings)


def _recording(
    folder: LeRobotFolder, episode: Episode, mapping: LeRobotMapping, videos: VideoCache, settings: ImportSettings
) -> Recording:
    views, robot = mapping.views, mapping.robot
    height, width = _common_size(folder, views)
    centers = [float(chosen(settings.pixel_center, str(view.pixel_center))) for view in views]
    axes = [chosen(settings.axes, view.axes) for view in views]
    types = [chosen(settings.depth, view.depth_type) for view in views]
    names = [x for view in views for x in (view.intrinsics, view.pose) if isinstance(x, str)]
    numbers = folder.numbers(episode, [*names, *(robot.features if robot is not None else ())])
    intrinsics = join_views(
        [
            shift_principal_point(_intrinsics(view, numbers, episode), 0.5 - center)
            for view, center in zip(views, centers, strict=True)
        ],
        episode.num_frames,
    )
    poses = [_poses(view, numbers, episode) for view in views]
    distortion = _distortion(views)
    color = [_color_reader(folder, episode, view, videos, (height, width)) for view in views]
    depth = [_depth_reader(folder, episode, view, videos, (height, width), settings) for view in views]

    def depth_of(frame: int, view: int) -> NDArray[np.float32]:
        if types[view] == "z":
            return depth[view](frame)
        matrix = intrinsics[view] if intrinsics.ndim == 3 else intrinsics[frame, view]
        return distance_to_z(depth[view](frame), matrix, None if distortion is None else distortion[view])

    return Recording(
        name=f"episode_{episode.index:06d}",
        height=height,
        width=width,
        intrinsics=intrinsics,
        cam_to_world=join_views(
            [opengl_to_opencv(pose) if axis == "opengl" else pose for pose, axis in zip(poses, axes, strict=True)],
            episode.num_frames,
        ),
        num_frames=episode.num_frames,
        num_views=len(views),
        frame_time=settings.frame_time or 1.0 / folder.fps,
        read_rgb=lambda frame, view: color[view](frame),
        read_depth=depth_of,
        source={
            "format": FORMAT,
            "axes": _said(axes),
            "depth_type": _said(types),
            "pixel_center": _said([f"{center:.1f}" for center in centers]),
        },
        view_names=[view.name for view in views],
        distortion=distortion,
        driven=None if robot is None else robot.motion(numbers, str(episode)),
        split=episode.split,
    )


def _color_reader(
    folder: LeRobotFolder, episode: Episode, view: MappedView, videos: VideoCache, size: tuple[int, int]
) -> Callable[[int], NDArray[np.uint8]]:
    def read(frame: int) -> NDArray[np.uint8]:
        if folder.features[view.rgb]["dtype"] == "video":
            path, seconds = folder.video(episode, view.rgb, frame)
            image = rgb_of(videos.get(path).frame(seconds, 0.4 / folder.fps))
        else:
            image = np.ascontiguousarray(folder.image(episode, view.rgb, frame, cv2.IMREAD_COLOR)[..., ::-1])
        if image.shape != (*size, 3):
            raise DataError(f"{view.rgb} of {episode} is {image.shape}; info.json says {size[0]}x{size[1]} pixels.")
        return image

    return read


def _depth_reader(
    folder: LeRobotFolder,
    episode: Episode,
    view: MappedView,
    videos: VideoCache,
    size: tuple[int, int],
    settings: ImportSettings,
) -> Callable[[int], NDArray[np.float32]]:
    feature = folder.features[view.depth]
    unit = settings.depth_scale or view.depth_unit
    name = f"{view.depth} of {episode}"
    if feature["dtype"] != "video":
        return lambda frame: depth_in_metres(
            folder.image(episode, view.depth, frame, cv2.IMREAD_UNCHANGED), *size, unit, unit or 1.0, name
        )
    codes = (
        None if unit is not None else view.codes({**(feature.get("video_info") or {}), **(feature.get("info") or {})})
    )

    def read(frame: int) -> NDArray[np.float32]:
        path, seconds = folder.video(episode, view.depth, frame)
        values = gray_of(videos.get(path).frame(seconds, 0.4 / folder.fps), str(path), 12 if codes else None)
        metres = codes.metres(values) if codes else values
        return depth_in_metres(metres, *size, unit, 1.0, name)

    return read


def _common_size(folder: LeRobotFolder, views: Sequence[MappedView]) -> tuple[int, int]:
    sizes = {folder.image_size(view.rgb): view.rgb for view in views}
    if len(sizes) > 1:
        listed = ", ".join(f"{w}x{h} ({name})" for (h, w), name in sizes.items())
        raise DataError(f"{folder.path}: the views differ in size: {listed}.\nMap views of one size.")
    return next(iter(sizes))


def _intrinsics(view: MappedView, numbers: Mapping[str, Array], episode: Episode) -> Array:
    if not isinstance(view.intrinsics, str):
        return view.intrinsics
    values = numbers[view.intrinsics]
    if values.shape[1] != 9:
        raise ConfigError(f"mapping, view {view.name}: {view.intrinsics} has {values.shape[1]} numbers; 9 are needed.")
    where = f"{view.intrinsics}, {episode}"
    rows = values.reshape(-1, 3, 3)
    return np.stack([checked_intrinsics(row, f"{where}, frame {index}") for index, row in enumerate(rows)])


def _poses(view: MappedView, numbers: Mapping[str, Array], episode: Episode) -> Array:
    if not isinstance(view.pose, str):
        return invert_pose(view.pose) if view.is_world_to_cam else view.pose
    values = numbers[view.pose]
    if values.shape[1] == 7:
        if view.quaternion is None:
            raise ConfigError(f"mapping, view {view.name}: {view.pose} has 7 numbers; give quaternion: wxyz or xyzw.")
        if (np.linalg.norm(values[:, 3:], axis=1) < 1e-6).any():
            raise DataError(f"{view.pose}, {episode} holds a quaternion of zeros.")
        matrices = pose_matrix(rotation_from_quaternion(values[:, 3:], view.quaternion), values[:, :3])
    elif values.shape[1] in (12, 16):
        matrices = values.reshape(len(values), -1, 4)
    else:
        raise ConfigError(
            f"mapping, view {view.name}: {view.pose} has {values.shape[1]} numbers; 7, 12 or 16 are needed."
        )
    where = f"{view.pose}, {episode}"
    poses = np.stack([checked_pose(row, f"{where}, frame {index}") for index, row in enumerate(matrices)])
    return invert_pose(poses) if view.is_world_to_cam else poses


def _distortion(views: Sequence[MappedView]) -> Array | None:
    if all(view.distortion is None for view in views):
        return None
    joined = np.zeros((len(views), max(len(view.distortion) for view in views if view.distortion is not None)))
    for index, view in enumerate(views):
        if view.distortion is not None:
            joined[index, : len(view.distortion)] = view.distortion
    return joined


def _said(values: Sequence[Any]) -> str:
    return str(values[0]) if len(set(values)) == 1 else " ".join(map(str, values))
