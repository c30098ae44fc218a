"""A bag of the known scene: a camera on a moving base, as realsense2_camera and a robot would record it."""

import numpy as np

from tests.data_gen.importers.bag_writer import START, BagWriter
from tests.data_gen.importers.known_scene import render
from tests.data_gen.importers.moving_camera import HEIGHT, INTRINSICS, WIDTH, pose

NUM_FRAMES = 5
TIMES = [round(frame / 15 + 0.003 * np.sin(5 * frame), 6) for frame in range(NUM_FRAMES)]  # jittered
STAMPS = [START + 50_000_000 + round(time * 1e9) for time in TIMES]
RGB, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"
INFO, DEPTH_INFO = "/camera/color/camera_info", "/camera/aligned_depth_to_color/camera_info"
OPTICAL = "camera_color_optical_frame"
LINK_IN_BASE = np.array([[0.0, 0, 1, 0.1], [1, 0, 0, -0.05], [0, 1, 0, 0.2], [0, 0, 0, 1]])
OPTICAL_IN_LINK = np.array([[0.0, 0, 1, 0.01], [-1, 0, 0, 0.02], [0, -1, 0, 0], [0, 0, 0, 1]])


def film():
    """What the camera sees."""
    return [render(INTRINSICS, pose(time), HEIGHT, WIDTH, time) for time in TIMES]


def write_transforms(bag, start=-0.04, stop=0.5, rate=100, connect=True):
    """map > base (moving) > camera_link > optical frame; the camera's pose in the map is ``pose(time)``."""
    bag.transform("/tf_static", START, "camera_link", OPTICAL, OPTICAL_IN_LINK)
    if connect:
        bag.transform("/tf_static", START, "/base", "camera_link", LINK_IN_BASE)
    for time in np.arange(start, stop, 1 / rate):
        base = pose(time) @ np.linalg.inv(LINK_IN_BASE @ OPTICAL_IN_LINK)
        bag.transform("/tf", START + 50_000_000 + round(time * 1e9), "map", "base", base)


def millimetres(picture):
    return np.rint(picture.depth * 1000).astype(np.uint16)


def colour(picture, encoding):
    alpha = np.full((HEIGHT, WIDTH, 1), 255, np.uint8)
    return {
        "rgb8": picture.rgb,
        "bgr8": picture.rgb[..., ::-1],
        "rgba8": np.concatenate([picture.rgb, alpha], axis=-1),
        "bgra8": np.concatenate([picture.rgb[..., ::-1], alpha], axis=-1),
        "mono8": picture.rgb[..., 1],
    }[encoding]


def write_images(bag, pictures, encoding="rgb8", depth_encoding="16UC1", depth_frame=OPTICAL, **info):
    for stamp, picture in zip(STAMPS, pictures, strict=True):
        bag.image(RGB, stamp, OPTICAL, encoding, colour(picture, encoding), padding=8)
        depth = millimetres(picture) if depth_encoding != "32FC1" else picture.depth.astype(np.float32)
        bag.image(DEPTH, stamp, depth_frame, depth_encoding, depth, is_bigendian=depth_encoding == "mono16")
        if info.get("model") != "missing":
            bag.info(INFO, stamp, OPTICAL, **info)


def make_bag(folder, pictures, kind="ros1", **options):
    with BagWriter(folder, kind) as bag:
        write_transforms(bag)
        write_images(bag, pictures, **options)
    return bag.path
