"""Browsers that are none: they say where their camera is, and read what the server sends."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import viser
from viser import _messages
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from tests.viewer.opened import open_tossed_box
from tests.waiting import HANG, wait_until
from vpd_lightning.viewer.panel import Panel
from vpd_lightning.viewer.server import Viewer

PROTOCOL = f"viser-v{viser.__version__}"


def socket_of(viewer: Viewer, query: str, **options: Any) -> Any:
    return connect(f"ws://127.0.0.1:{viewer.port}/{query}", subprotocols=[PROTOCOL], open_timeout=HANG, **options)


def settled_panel(viewer: Viewer, before: set[int]) -> Panel:
    """The panel of the client that just came."""
    wait_until(lambda: set(viewer.panels) - before)
    return viewer.panels[(set(viewer.panels) - before).pop()]


def drain(connection: Any) -> None:
    """Read what the server sends, so that its buffers do not fill."""

    def read() -> None:
        try:
            while True:
                connection.recv()
        except ConnectionClosed:
            pass

    threading.Thread(target=read, daemon=True).start()


def camera_message(position: tuple[float, float, float] = (0.0, 0.0, 3.0)) -> bytes:
    """A browser reports its camera first; until then viser announces no client."""
    return serialized(
        _messages.ViewerCameraMessage(
            (1.0, 0.0, 0.0, 0.0), position, 0.9, 0.01, 100.0, 600, 800, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
        )
    )


def serialized(message: Any) -> bytes:
    return msgspec.msgpack.encode(message.as_serializable_dict())


@contextmanager
def only_page(folder: Path) -> Iterator[tuple[Panel, Any]]:
    """Yield the panel and the connection of the one page of a viewer of its own, which shows a tossed box."""
    viewer = Viewer(0, "a-token-for-tests")
    try:
        viewer.show(open_tossed_box(folder), folder / "view", 3)
        with socket_of(viewer, "?token=a-token-for-tests") as connection:
            connection.send(camera_message())
            drain(connection)
            yield settled_panel(viewer, set()), connection
    finally:
        viewer.stop()
