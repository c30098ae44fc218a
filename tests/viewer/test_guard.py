"""Who may talk to the viewer, and what strangers' messages do to it."""

import gzip
import http.client
import math
import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser")

import msgspec
from viser import _messages
from websockets.exceptions import ConnectionClosed, InvalidStatus

from tests.viewer import clients
from tests.viewer.clients import camera_message, drain, serialized, settled_panel
from tests.viewer.opened import open_tossed_box
from tests.waiting import HANG, wait_until
from vpd_lightning.errors import ConfigError
from vpd_lightning.viewer.guard import MAX_UPLOAD_BYTES, new_token, require_free, start_guarded_server
from vpd_lightning.viewer.server import Viewer

TOKEN = "a-token-for-tests"


@pytest.fixture(scope="module")
def viewer(tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("guard")
    viewer = Viewer(0, TOKEN)
    viewer.show(open_tossed_box(folder), folder / "run" / "view", 4)
    viewer.folder = folder  # for the test that looks for strange files
    yield viewer
    viewer.stop()


def ask(viewer: Viewer, path: str, **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", viewer.port, timeout=HANG)
    connection.putrequest("GET", path, skip_host="Host" in headers, skip_accept_encoding="Accept-Encoding" in headers)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    return connection.getresponse()


def socket_of(viewer: Viewer, query: str = f"?token={TOKEN}", **options):
    return clients.socket_of(viewer, query, **options)


def test_it_listens_on_the_loopback_interface_alone(viewer: Viewer) -> None:
    listening = []
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        for line in Path(table).read_text().splitlines()[1:]:
            address, state = line.split()[1], line.split()[3]
            if int(address.rpartition(":")[2], 16) == viewer.port and state == "0A":
                listening.append(address.rpartition(":")[0])
    assert listening == ["0100007F"]  # 127.0.0.1


def test_the_page_needs_the_token_once_and_a_cookie_then(viewer: Viewer) -> None:
    assert ask(viewer, "/").status == 403
    assert ask(viewer, "/?token=wrong").status == 403
    assert ask(viewer, f"/?token={TOKEN}x").status == 403
    assert ask(viewer, "/?token=").status == 403
    first = ask(viewer, f"/?token={TOKEN}")
    cookie = first.getheader("Set-Cookie")
    assert first.status == 200 and "HttpOnly" in cookie and "SameSite=Strict" in cookie
    assert b"<html" in first.read()
    assert ask(viewer, "/", Cookie=cookie.partition(";")[0]).status == 200
    assert ask(viewer, "/", Cookie="vpd_view_token=wrong").status == 403
    assert ask(viewer, "/", Cookie='="; broken').status == 403


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "192.168.0.2:8080"])
def test_a_foreign_name_that_points_here_is_refused(viewer: Viewer, host: str) -> None:
    assert ask(viewer, f"/?token={TOKEN}", Host=host).status == 403


def test_a_forwarded_port_is_welcome_and_a_foreign_page_is_not(viewer: Viewer) -> None:
    assert ask(viewer, f"/?token={TOKEN}", Host="localhost:9999", Origin="http://localhost:9999").status == 200
    for origin in ("http://evil.example", "null", "http://localhost:1", "https://localhost:9999", ""):
        assert ask(viewer, f"/?token={TOKEN}", Host="localhost:9999", Origin=origin).status == 403


def test_the_socket_needs_the_token_and_our_own_page(viewer: Viewer) -> None:
    for query, options in (
        ("", {}),
        ("?token=wrong", {}),
        (f"?token={TOKEN}", {"origin": "http://evil.example"}),
        (f"?token={TOKEN}", {"origin": f"http://localhost:{viewer.port}"}),
    ):
        with pytest.raises(InvalidStatus) as refused:
            socket_of(viewer, query, **options)
        assert refused.value.response.status_code == 403
    with socket_of(viewer, origin=f"http://127.0.0.1:{viewer.port}") as connection:
        assert isinstance(connection.recv(timeout=HANG), bytes)


@pytest.mark.parametrize(
    "path", ["/../../../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "/..\\..\\etc\\passwd", "//x"]
)
def test_no_file_outside_of_the_page_is_served(viewer: Viewer, path: str) -> None:
    answer = ask(viewer, f"{path}?token={TOKEN}")
    assert answer.status != 200 and b"root:" not in answer.read()


def test_arrow_keys_are_taken_from_the_camera_in_every_encoding_of_the_page(viewer: Viewer) -> None:
    plain, packed = ask(viewer, f"/?token={TOKEN}"), ask(viewer, f"/?token={TOKEN}", **{"Accept-Encoding": "gzip"})
    page, compressed = plain.read(), packed.read()
    assert packed.getheader("Content-Encoding") == "gzip" and gzip.decompress(compressed) == page
    assert page.count(b'event.code.startsWith("Arrow")') == 1
    assert b"<script" not in ask(viewer, f"/nothing?token={TOKEN}").read()


def test_a_taken_port_is_refused_by_name(viewer: Viewer) -> None:
    with pytest.raises(ConfigError, match=f"port={viewer.port} cannot be used"):
        require_free(viewer.port)
    with pytest.raises(ConfigError, match="port=0 for any"):
        start_guarded_server(viewer.port, TOKEN, "second")
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        held.listen()
        with pytest.raises(ConfigError):
            require_free(held.getsockname()[1])


def test_tokens_differ_and_no_share_link_is_made(viewer: Viewer) -> None:
    assert len({new_token() for _ in range(100)}) == 100 and len(new_token()) >= 20
    assert viewer.server.request_share_url() is None


def test_uploads_beyond_the_cap_and_beyond_what_was_announced_are_dropped(viewer: Viewer) -> None:
    before = set(viewer.panels)
    with socket_of(viewer) as connection:
        connection.send(camera_message())
        drain(connection)
        gui = settled_panel(viewer, before).client.gui
        target = viewer.panels[max(viewer.panels)].edit_tab.upload._impl.uuid
        pending = gui._current_file_upload_states

        def start(name: str, size: int, parts: int) -> None:
            message = _messages.FileTransferStartUpload(target, name, "x.yaml", "text/yaml", parts, size)
            connection.send(serialized(message))

        start("large", MAX_UPLOAD_BYTES + 1, 1)
        start("many", 10, MAX_UPLOAD_BYTES + 1)
        start("negative", -1, 1)
        for name in "abcd":
            start(name, 8, 2)
        wait_until(lambda: len(pending) == 2)
        assert set(pending) == {"a", "b"}
        for part in (0, 1):
            connection.send(serialized(_messages.FileTransferPart(target, "a", part, b"12345")))
        wait_until(lambda: set(pending) == {"b"})


def test_values_beyond_what_an_input_allows_are_held_to_it_or_dropped(viewer: Viewer) -> None:
    """Steps to simulate end at 1,000: a page that asks for 1e308 would fill the memory."""
    before = set(viewer.panels)
    with socket_of(viewer) as connection:
        connection.send(camera_message())
        drain(connection)
        tab = settled_panel(viewer, before).view_tab

        def set_to(handle: Any, **updates: Any) -> None:
            connection.send(serialized(_messages.GuiUpdateMessage(handle._impl.uuid, updates)))

        set_to(tab.camera, value="none that exists")
        set_to(tab.point_size, value=math.nan)
        set_to(tab.point_size, value="large")
        set_to(tab.fps, value=-1e308)
        set_to(tab.length, max=1e308)
        set_to(tab.length, removed=True)
        set_to(tab.length, value=1e308)
        wait_until(lambda: tab.length.value == 1000)  # messages come in order
        assert tab.fps.value == 1 and tab.length.max == 1000 and not tab.length._impl.removed
        assert tab.camera.value in tab.camera.options and math.isfinite(tab.point_size.value)


JUNK = (None, True, -1, 3.5, float("nan"), 1e308, "", "x" * 500, b"\0\xff", [], [1, "a"], {}, {"value": 1}, [0.0] * 4)


def junk_messages(targets: list[str], count: int, seed: int) -> list[bytes]:
    """Messages of every kind with any values, many of them to things that exist."""
    kinds = sorted(_messages.Message._subclass_from_type_string())
    generator = np.random.default_rng(seed)
    messages = []
    for _ in range(count):
        kind = kinds[generator.integers(len(kinds))]
        cls = _messages.Message._subclass_from_type_string()[kind]
        values = {name: JUNK[generator.integers(len(JUNK))] for name in cls.__dataclass_fields__}
        for name in ("uuid", "source_component_uuid", "name"):
            if name in values and targets and generator.random() < 0.7:
                values[name] = targets[generator.integers(len(targets))]
        if generator.random() < 0.4:
            value = JUNK[generator.integers(len(JUNK))]
            target = targets[generator.integers(len(targets))]
            kind, values = "GuiUpdateMessage", {"uuid": target, "updates": {"value": value}}
        messages.append(msgspec.msgpack.encode({"type": kind, **values}))
    return messages


@pytest.mark.slow
def test_ten_thousand_random_messages_leave_the_server_alive_and_other_clients_untouched(viewer: Viewer) -> None:
    before = set(viewer.panels)
    with socket_of(viewer) as bystander:
        bystander.send(camera_message())
        drain(bystander)
        calm = settled_panel(viewer, before)
        edits = calm.session.operations()
        sent, connections, generator = 0, 0, np.random.default_rng(0)
        while sent < 10_000:
            known = set(viewer.panels)
            # A server that was sent no message closes first, and this side would wait ten seconds for its last packet.
            with socket_of(viewer, close_timeout=0.2) as connection:
                connections += 1
                connection.send(camera_message())
                drain(connection)
                gui = settled_panel(viewer, known).client.gui
                inputs = list(gui._gui_input_handle_from_uuid)
                targets = [*(4 * inputs), *gui._command_handle_from_uuid]  # keys are slower to answer
                assert inputs and len(targets) > 4 * len(inputs)
                try:
                    for message in junk_messages(targets, 1500, connections):
                        connection.send(message)
                        sent += 1
                        if generator.random() < 0.01:  # bytes that are no message at all end this connection
                            connection.send(generator.bytes(int(generator.integers(1, 300))))
                            sent += 1
                except ConnectionClosed:
                    continue
            assert connections < 2000
        assert ask(viewer, f"/?token={TOKEN}").status == 200
        assert viewer.panels[calm.client.client_id] is calm and calm.session.operations() == edits
        assert int(calm.session.select(None)) == 0
    strange = [
        p for p in viewer.folder.rglob("*") if p.is_file() and p.parts[len(viewer.folder.parts)] not in ("data", "run")
    ]
    assert strange == []
