"""Writes bags with the real message types through rosbags' writers: images, calibrations and transforms."""

from types import SimpleNamespace

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.data_gen.importers.moving_camera import FOCAL, HEIGHT, WIDTH, quaternion_wxyz

START = 1_700_000_000 * 10**9  # ns


class BagWriter:
    """A bag of kind ``ros1``, ``ros1_lz4``, ``ros2`` (SQLite) or ``mcap``; ``path`` goes to the importer."""

    def __init__(self, folder, kind, name="made"):
        self.is_ros1 = kind.startswith("ros1")
        self.types = get_typestore(Stores.ROS1_NOETIC if self.is_ros1 else Stores.ROS2_HUMBLE)
        if self.is_ros1:
            message = "geometry_msgs/TransformStamped[] transforms"
            self.types.register(get_types_from_msg(message, "tf2_msgs/msg/TFMessage"))
            self.path = folder / f"{name}.bag"
            self.writer = Writer1(self.path)
            if kind == "ros1_lz4":
                self.writer.set_compression(Writer1.CompressionFormat.LZ4)
        else:
            self.path = folder / name
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            self.writer = Writer2(self.path, version=9, storage_plugin=plugin)
        self.connections = {}

    def __enter__(self):
        self.writer.open()
        return self

    def __exit__(self, *error):
        self.writer.close()

    def write(self, topic, kind, time, **fields):
        """Write one message; ``time`` in ns is when the bag received it."""
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.types)
        message = self.make(kind, **fields)
        serialize = self.types.serialize_ros1 if self.is_ros1 else self.types.serialize_cdr
        self.writer.write(self.connections[topic], time, serialize(message, kind))

    def make(self, kind, **fields):
        return self.types.types[kind](**fields)

    def header(self, stamp, frame):
        time = self.make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        sequence = {"seq": 0} if self.is_ros1 else {}
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame, **sequence)

    def image(self, topic, stamp, frame, encoding, pixels, padding=0, is_bigendian=False):
        """A raw image; rows may be padded, 16 and 32 bits may be big-endian."""
        stored = pixels.astype(pixels.dtype.newbyteorder(">" if is_bigendian else "<"))
        rows = np.ascontiguousarray(stored).reshape(len(pixels), -1).view(np.uint8)
        rows = np.pad(rows, ((0, 0), (0, padding)))
        self.write(
            topic,
            "sensor_msgs/msg/Image",
            stamp + 4_000_000,
            header=self.header(stamp, frame),
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=int(is_bigendian),
            step=rows.shape[1],
            data=rows.ravel(),
        )

    def compressed(self, topic, stamp, frame, form, data):
        self.write(
            topic,
            "sensor_msgs/msg/CompressedImage",
            stamp + 4_000_000,
            header=self.header(stamp, frame),
            format=form,
            data=np.frombuffer(data, np.uint8),
        )

    def info(self, topic, stamp, frame, model="plumb_bob", distortion=(0.0,) * 5, focal=FOCAL, size=(HEIGHT, WIDTH)):
        """Calibration with pixel centres at integers."""
        k = np.array([focal, 0, WIDTH / 2 - 0.5, 0, focal, HEIGHT / 2 - 0.5, 0, 0, 1])
        p = np.concatenate([k.reshape(3, 3), np.zeros((3, 1))], axis=1).ravel()
        names = "DKRP" if self.is_ros1 else "dkrp"
        matrices = dict(zip(names, (np.array(distortion, np.float64), k, np.eye(3).ravel(), p), strict=True))
        roi = self.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        self.write(
            topic,
            "sensor_msgs/msg/CameraInfo",
            stamp + 1_000_000,
            header=self.header(stamp, frame),
            height=size[0],
            width=size[1],
            distortion_model=model,
            binning_x=0,
            binning_y=0,
            roi=roi,
            **matrices,
        )

    def transform(self, topic, stamp, parent, child, matrix):
        w, x, y, z = quaternion_wxyz(matrix)
        stamped = self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(stamp, parent),
            child_frame_id=child,
            transform=self.make(
                "geometry_msgs/msg/Transform",
                translation=self.make("geometry_msgs/msg/Vector3", **dict(zip("xyz", matrix[:3, 3], strict=True))),
                rotation=self.make("geometry_msgs/msg/Quaternion", w=w, x=x, y=y, z=z),
            ),
        )
        self.write(topic, "tf2_msgs/msg/TFMessage", stamp, transforms=[stamped])


def png(image):
    done, data = cv2.imencode(".png", image)
    assert done
    return data.tobytes()


def compressed_depth(depth):
    """Metres in 32 bits as compressed_depth_image_transport stores them: inverse depth in 16 bits behind a header."""
    quantization, depth_max = 100.0, 10.0
    a = quantization * (quantization + 1)
    b = 1 - a / depth_max
    codes = np.where(depth > 0, a / np.where(depth > 0, depth, 1) + b, 0)
    header = np.array([0], "<i4").tobytes() + np.array([a, b], "<f4").tobytes()
    return header + png(codes.astype(np.uint16)), SimpleNamespace(a=a, b=b)
