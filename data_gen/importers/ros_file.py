"""ROS 1 and ROS 2 bags: which topics they hold, one pass over them, and single messages later on.

Needs the package ``rosbags``, which needs no ROS. A bag is opened when something is read, and only one is open at a
time, so hundreds of them can be listed.
"""

import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from vpd_lightning.errors import ConfigError, DataError, one_line

IMAGE, COMPRESSED_IMAGE, CAMERA_INFO = (
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/CameraInfo",
)
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_SUFFIXES = (".bag", ".db3", ".mcap")
_SKIP = 2 * 10**9  # ns; messages nearer than this are read past, further ones are sought


@dataclass(frozen=True, order=True)
class Entry:
    """One message of a topic: when it was recorded (ns), and how many of that topic had the same time before it."""

    time: int
    repeat: int


def bag_paths(path: Path) -> list[Path]:
    """Return the bags at a path: a file, a ROS 2 folder with ``metadata.yaml``, or those in a folder."""
    if path.is_file():
        return [path] if path.suffix in _SUFFIXES else []
    if _is_ros2_folder(path):
        return [path]
    if not path.is_dir():
        return []
    return sorted(inner for inner in path.iterdir() if inner.suffix in _SUFFIXES or _is_ros2_folder(inner))


def _is_ros2_folder(path: Path) -> bool:
    """Tell whether a folder is a bag: split into several files and compressed (``.db3.zstd``) or not."""
    if not (path / "metadata.yaml").is_file():
        return False
    return any({".db3", ".mcap"} & set(inner.suffixes) for inner in path.iterdir())


class Bag:
    """One bag; messages come as objects with the fields of their ROS type."""

    _opened: ClassVar["Bag | None"] = None

    def __init__(self, path: Path) -> None:
        self.path = path
        self._reader: Any = None
        self._cursors: dict[str, _Cursor] = {}

    def topics(self) -> dict[str, str]:
        """Return the message type of each topic that has messages."""
        return {connection.topic: connection.msgtype for connection in self._open().connections if connection.msgcount}

    def scan(self, topics: Collection[str]) -> Iterator[tuple[str, Entry, Any]]:
        """Yield topic, entry and message of all messages of these topics, in the order they were recorded."""
        last: dict[str, Entry] = {}
        for topic, time, message in self._messages(topics, None):
            before = last.get(topic)
            last[topic] = Entry(time, before.repeat + 1 if before is not None and before.time == time else 0)
            yield topic, last[topic], message()

    def message(self, topic: str, entry: Entry) -> Any:
        """Return one message; quick when asked for in the order they were recorded."""
        self._open()
        cursor = self._cursors.get(topic)
        if cursor is None or entry <= cursor.position or entry.time - cursor.position.time > _SKIP:
            cursor = _Cursor(self._messages([topic], entry.time), Entry(entry.time, -1))
            self._cursors[topic] = cursor
        found = cursor.seek(entry)
        if found is None:
            raise DataError(f"{self.path}: a message of {topic} is gone. Was the bag changed during the import?")
        return found()

    def close(self) -> None:
        """Close the file; the next access opens it again."""
        self._cursors.clear()
        reader, self._reader = self._reader, None
        if reader is not None:
            reader.close()
        if Bag._opened is self:
            Bag._opened = None

    def _messages(self, topics: Collection[str], start: int | None) -> Iterator[tuple[str, int, Any]]:
        reader = self._open()
        connections = [connection for connection in reader.connections if connection.topic in topics]
        if not connections:
            return
        stream = reader.messages(connections=connections, start=start)
        while True:
            try:
                connection, time, raw = next(stream)
            except StopIteration:
                return
            except Exception as error:  # rosbags' own, and struct, zstd, lz4 and SQLite errors from damaged bytes
                raise DataError(
                    f"{self.path} is damaged or cut short ({type(error).__name__}: {one_line(error)})."
                ) from error
            yield connection.topic, time, lambda c=connection, r=raw: self._decode(c, r)

    def _decode(self, connection: Any, raw: bytes) -> Any:
        from rosbags.highlevel import AnyReaderError

        try:
            return self._open().deserialize(raw, connection.msgtype)
        except (AnyReaderError, struct.error, ValueError, IndexError, AssertionError) as error:
            raise DataError(
                f"{self.path}: a message of {connection.topic} cannot be decoded ({one_line(error)})."
            ) from error

    def _open(self) -> Any:
        if self._reader is not None:
            return self._reader
        if Bag._opened is not None:
            Bag._opened.close()
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise ConfigError(
                f'Reading {self.path.name} needs rosbags.\npip install "vpd-lightning[ros]"  (or pip install rosbags)'
            ) from error
        # Older ROS 2 bags do not hold their message types; those read here have not changed since Humble.
        try:
            reader = AnyReader([self.path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            reader.open()
        except Exception as error:
            hint = "\nrosbag reindex may mend it." if "index" in str(error) else ""
            raise DataError(
                f"{self.path} cannot be opened as a ROS bag ({type(error).__name__}: {one_line(error)}).{hint}"
            ) from error
        self._reader = reader
        Bag._opened = self
        return reader


class _Cursor:
    """A place in the messages of one topic, which only moves on."""

    def __init__(self, messages: Iterator[tuple[str, int, Any]], position: Entry) -> None:
        self._messages = messages
        self.position = position

    def seek(self, entry: Entry) -> Any:
        """Return what decodes the entry's message; None where the topic has no such entry."""
        for _, time, message in self._messages:
            repeat = self.position.repeat + 1 if time == self.position.time else 0
            self.position = Entry(time, repeat)
            if self.position == entry:
                return message
            if self.position > entry:
                break
        return None
