"""A viser server that only this machine's user can talk to: loopback, a token, no foreign page, no large upload.

Values of inputs are held to the limits that their input shows, which viser leaves to the page.

viser listens on all interfaces and answers any web page by default, and has no hook for either; so its one call of
``websockets.serve`` is wrapped while it starts (viser 1.1, pinned; ``tests/viewer/test_guard.py`` holds it to this).
"""

import hmac
import http
import logging
import math
import secrets
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

import rich
import viser
import websockets.asyncio.server
from viser import _messages
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from vpd_lightning.errors import ConfigError
from vpd_lightning.viewer.page_script import add_script

HOST = "127.0.0.1"
LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")
MAX_MESSAGE_BYTES = 16 * 2**20
MAX_UPLOAD_BYTES = 16 * 2**20
MAX_PENDING_UPLOADS = 2
_COOKIE = "vpd_view_token"


def start_guarded_server(port: int, token: str, title: str) -> viser.ViserServer:
    """Start viser on the loopback interface behind a token.

    A request needs the token, as ``?token=`` (the address that ``vpd-view`` prints) or as the cookie that the first
    page sets; a loopback name as host, so that no foreign name can point here; and where a browser says which page
    asks (``Origin``), that page must be ours.

    Raises:
        ConfigError: the port is taken.
    """
    require_free(port)
    serve = websockets.asyncio.server.serve

    def guarded_serve(handler: Any, host: str, asked_port: int, **options: Any) -> Any:
        options["process_request"] = _guarded(options["process_request"], token)
        options["max_size"] = MAX_MESSAGE_BYTES
        options["logger"] = _silent_logger()
        return serve(handler, HOST, asked_port, **options)

    with _replaced(websockets.asyncio.server, "serve", guarded_serve), _replaced(rich, "print", lambda *_: None):
        server = viser.ViserServer(host=HOST, port=port, label=title, verbose=False)
    server.request_share_url = lambda verbose=True: None  # type: ignore[method-assign]
    limit_messages(server.gui)
    return server


@contextmanager
def _replaced(module: Any, name: str, value: Any) -> Iterator[None]:
    kept = getattr(module, name)
    setattr(module, name, value)
    try:
        yield
    finally:
        setattr(module, name, kept)


def new_token() -> str:
    """Return a random token of 128 bits."""
    return secrets.token_urlsafe(16)


def require_free(port: int) -> None:
    """Refuse a port that something listens on; viser would silently take the next one.

    Raises:
        ConfigError: it is taken, or not allowed.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise ConfigError(
                f"port={port} cannot be used: {error.strerror}.\nGive another one, or port=0 for any that is free."
            ) from error


def is_welcome(path: str, headers: Headers, token: str) -> bool:
    """Whether a request comes from this machine's user: right token, loopback host, no foreign page."""
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or _name(hosts[0]) not in LOOPBACK_NAMES:
        return False
    if len(origins) > 1 or (origins and origins[0] != f"http://{hosts[0]}"):
        return False
    given = parse_qs(urlsplit(path).query).get("token", [])
    given += [_cookie(value) for value in headers.get_all("Cookie")]
    return any(hmac.compare_digest(word.encode(), token.encode()) for word in given)


def _name(host: str) -> str:
    return host.rpartition(":")[0] if host.rpartition(":")[2].isdigit() else host


def _cookie(text: str) -> str:
    try:
        found = SimpleCookie(text).get(_COOKIE)
    except CookieError:
        return ""
    return found.value if found else ""


def _guarded(inner: Callable[..., Response | None], token: str) -> Callable[..., Response | None]:
    def process_request(connection: Any, request: Request) -> Response | None:
        try:
            welcome = is_welcome(request.path, request.headers, token)
        except ValueError:  # an address that is none
            welcome = False
        if not welcome:
            text = b"Open the address that vpd-view printed, with its token.\n"
            headers = Headers({"Content-Type": "text/plain", "Content-Length": str(len(text)), "Connection": "close"})
            return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", headers, text)
        response = inner(connection, request)
        if response is not None:
            add_script(response)
            response.headers["Set-Cookie"] = f"{_COOKIE}={token}; Path=/; HttpOnly; SameSite=Strict"
            response.headers["X-Frame-Options"] = "DENY"
            response.headers["Referrer-Policy"] = "no-referrer"
        return response

    return process_request


def _silent_logger() -> logging.Logger:
    """Return a logger for refused and broken connections, which are no news to the person at the terminal."""
    logger = logging.getLogger("vpd_lightning.viewer.connections")
    logger.propagate = False
    logger.addHandler(logging.NullHandler())
    return logger


def limit_messages(gui: Any) -> None:
    """Hold uploads to their cap and the values of inputs to their limits."""
    _cap_uploads(gui)
    _limit_values(gui)


def _limit_values(gui: Any) -> None:
    """Keep values of inputs between their limits; drop what is no number, no option, or sets anything but a value."""
    interface = gui._websock_interface

    async def update(client_id: Any, message: Any) -> None:
        handle = gui._gui_input_handle_from_uuid.get(message.uuid)
        if handle is None or list(message.updates) != ["value"]:
            return
        props = handle._impl.props
        try:
            value = _limited(message.updates["value"], getattr(props, "min", None), getattr(props, "max", None))
        except (TypeError, ValueError):
            return
        if value not in getattr(props, "options", [value]):
            return
        message.updates["value"] = value
        await gui._handle_gui_updates(client_id, message)

    interface.unregister_handler(_messages.GuiUpdateMessage)
    interface.register_handler(_messages.GuiUpdateMessage, update)


def _limited(value: Any, low: Any, high: Any) -> Any:
    """Return a value between limits that may be absent: for a sequence, component by component.

    Raises:
        TypeError: there are limits and no number, or the wrong number of components.
        ValueError: a number is not finite.
    """
    if isinstance(value, list | tuple):
        lows, highs = (limit if isinstance(limit, list | tuple) else [limit] * len(value) for limit in (low, high))
        return [_limited(*each) for each in zip(value, lows, highs, strict=True)]
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError
    if low is not None:
        value = max(value, low)
    return value if high is None else min(value, high)


def _cap_uploads(gui: Any) -> None:
    """Refuse uploads of more than ``MAX_UPLOAD_BYTES``, too many at once, and parts beyond the announced size."""
    interface, pending = gui._websock_interface, gui._current_file_upload_states

    def start(client_id: Any, message: Any) -> None:
        sizes = (message.size_bytes, message.part_count)
        sound = all(isinstance(size, int) and 0 <= size <= MAX_UPLOAD_BYTES for size in sizes)
        if sound and len(pending) < MAX_PENDING_UPLOADS:
            gui._handle_file_transfer_start(client_id, message)

    def part(client_id: Any, message: Any) -> None:
        state = pending.get(message.transfer_uuid)
        if state is None:
            return
        if not isinstance(message.content, bytes) or (
            state["transferred_bytes"] + len(message.content) > state["total_bytes"]
        ):
            pending.pop(message.transfer_uuid, None)
            return
        gui._handle_file_transfer_part(client_id, message)

    for kind, handler in ((_messages.FileTransferStartUpload, start), (_messages.FileTransferPart, part)):
        interface.unregister_handler(kind)
        interface.register_handler(kind, handler)
