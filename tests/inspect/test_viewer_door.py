"""The door of ``neurad view``: who is let in, and what a browser that is in can do to the others."""

import re
import socket
import threading
import time

import pytest
from helpers.viewed import viewed

# ruff: noqa: E402
viser = pytest.importorskip("viser")  # brings what follows
import msgspec
import zstandard
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request
from websockets.sync.client import connect

from neurad.core.errors import InputError
from neurad.inspect import server
from neurad.inspect.panel import _escaped, plain
from neurad.inspect.server import is_wanted, path_below

VERSION = f"viser-v{viser.__version__}"
NAN, INF = float("nan"), float("inf")
NEVER = (NAN, INF, -INF, 1e300, -1e300, 2**63, "abc", "nan", None, [], {}, True)
"""What no number that the page sends may be."""
CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [0.1, 0.2, 0.3],
    "fov": 1.0,
    "near": 0.01,
    "far": 1000,
    "image_height": 480,
    "image_width": 640,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 1.0, 0.0],
}
CLICK = {
    "type": "ScenePointerMessage",
    "event_type": "click",
    "ray_origin": [0.1, 0.2, 0.3],
    "ray_direction": [0.0, 0.0, 1.0],
    "screen_pos": [[0.5, 0.5]],
    "modifier": None,
}
CONTROL = {"type": "GuiUpdateMessage", "uuid": "x", "updates": {"value": 1.0}}


def bad_messages():
    """Every number of every message that the page can send, at every value that it may not have."""
    for good in (CAMERA, CLICK):
        for name, value in good.items():
            if isinstance(value, (int, float)):
                yield from ({**good, name: bad} for bad in NEVER)
            elif isinstance(value, list):
                vector = value[0] if name == "screen_pos" else value
                wrong = [[*vector[:i], bad, *vector[i + 1 :]] for i in range(len(vector)) for bad in NEVER]
                wrong += [vector[1:], [*vector, 0.0], [], NAN, None, "abc"]
                yield from ({**good, name: [bad] if name == "screen_pos" else bad} for bad in wrong)
    for name, value in (("fov", 0.0), ("fov", -1.0), ("fov", 3.2), ("wxyz", [0.0] * 4), ("wxyz", [9.0] * 4)):
        yield {**CAMERA, name: value}
    yield from ({**CAMERA, name: -1} for name in ("near", "far", "image_height", "image_width"))
    yield from ({**CAMERA, name: 10**9} for name in ("image_height", "image_width"))
    yield {**CLICK, "ray_direction": [0.0, 0.0, 0.0]}
    yield from ({**CONTROL, "updates": {"value": bad}} for bad in (NAN, INF, -INF, 1e300, 2**63, None, [], {}))
    updates = ({}, {"removed": True}, {"value": 1, "update_cb": None}, 3, None)
    yield from ({**CONTROL, "updates": bad} for bad in updates)


def test_numbers_are_ranged():
    far = {**CAMERA, "position": [1e6, 0, -3], "near": 0, "image_height": 0}
    for good in (CAMERA, CLICK, CONTROL, far):
        assert is_wanted(msgspec.msgpack.encode(good))
    bad = list(bad_messages())
    assert len(bad) > 300
    for message in bad:
        with pytest.raises(InputError, match=f"of a {message['type']} is out of range"):
            is_wanted(msgspec.msgpack.encode(message))
    for missing in CAMERA.keys() - {"type"}:
        with pytest.raises(InputError, match=f"^{missing} of"):
            is_wanted(msgspec.msgpack.encode({k: v for k, v in CAMERA.items() if k != missing}))
    for raw in ("text", b"", b"\xc1", b"\x93\x01", b"\x91" * 60000, msgspec.msgpack.encode([CAMERA]), b"\x80", None):
        with pytest.raises(InputError, match="no message"):
            is_wanted(raw)
    for kind in ("ShareUrlRequest", "RunJavascriptMessage", "FileTransferStartUpload", "Unknown"):
        assert not is_wanted(msgspec.msgpack.encode({"type": kind}))


@pytest.mark.parametrize(
    ("path", "headers", "below"),
    [
        ("/secret", {"Host": "127.0.0.1:8080"}, "/"),
        ("/secret/", {"Host": "localhost:9"}, "/"),
        ("/secret/a/b?c=/d", {"Host": "127.0.0.1"}, "/a/b"),
        ("/secret", {"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:8080"}, "/"),
        ("/secret", {"Host": "127.0.0.1:8080", "Origin": "http://evil.example"}, None),
        ("/secret", {"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:3000"}, None),
        ("/secret", {"Host": "127.0.0.1:8080", "Origin": "http://localhost:8080"}, None),
        ("/secret", {"Host": "127.0.0.1:8080", "Origin": "null"}, None),
        ("/secret", {"Host": "evil.example:8080"}, None),
        ("/secret", {"Host": "evil.example:8080", "Origin": "http://evil.example:8080"}, None),
        ("/secret", {"Host": "127.0.0.1.evil.example:8080"}, None),
        ("/secret", {"Host": "localhost.evil.example"}, None),
        ("/secret", {"Host": "127.0.0.1:8080@evil.example"}, None),
        ("/secret", {"Host": ""}, None),
        ("/secret", {}, None),
        ("/", {"Host": "127.0.0.1:8080"}, None),
        ("/secre", {"Host": "127.0.0.1:8080"}, None),
        ("/secrets", {"Host": "127.0.0.1:8080"}, None),
        ("/?secret", {"Host": "127.0.0.1:8080"}, None),
        ("/a/../secret", {"Host": "127.0.0.1:8080"}, None),
        ("/s\udce9cret", {"Host": "127.0.0.1:8080"}, None),
    ],
)
def test_who_is_let_in(path, headers, below):
    assert path_below("secret", Request(path, Headers(headers))) == below
    twice = Headers(headers)
    twice["Host"] = "evil.example"
    assert path_below("secret", Request(path, twice)) is None or not headers


def test_names_are_shown_as_they_are():
    assert plain("`<img src=x onerror=alert(1)>`\n") == "'<img src=x onerror=alert(1)>'"
    assert _escaped("<b> www.evil.example & `a`") == r"\<b\> www\.evil\.example \& \`a\`"


def test_a_viser_without_the_door(monkeypatch):
    """One that begins its server in another way lets everybody in: then there is no page."""
    import contextlib

    monkeypatch.setattr(server, "guarded", lambda token: contextlib.nullcontext())
    threads = threading.active_count()
    with pytest.raises(InputError, match="lets in everybody"):
        server.serve(0)
    end = time.monotonic() + 5
    while threading.active_count() > threads and time.monotonic() < end:
        time.sleep(0.05)
    assert threading.active_count() == threads


def asked(port, path, upgrade=False, **headers):
    """Status of the answer to a request."""
    headers = {"Host": f"127.0.0.1:{port}", **headers}
    if upgrade:
        headers |= {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"}
        headers |= {"Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Protocol": VERSION}
    with socket.create_connection(("127.0.0.1", port), timeout=10) as line:
        lines = [f"GET {path} HTTP/1.1", *(f"{name}: {value}" for name, value in headers.items() if value), "", ""]
        line.sendall("\r\n".join(lines).encode())
        return int(line.recv(4096).split()[1])


class Client:
    """A browser that says what it likes."""

    def __init__(self, address, *first):
        where = address.replace("http", "ws").rstrip("/")
        self.line = connect(where, subprotocols=[VERSION], origin=re.match("http://[^/]*", address)[0], max_size=None)
        for message in first:
            self.send(message)

    def send(self, message):
        self.line.send(message if isinstance(message, (str, bytes)) else msgspec.msgpack.encode(message))

    def read(self, seconds=20):
        """The next messages."""
        raw = self.line.recv(timeout=seconds)
        size = int.from_bytes(raw[8:16], "little")
        return msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(raw[16 : 16 + size]))["messages"]

    def controls(self):
        """Identifiers of the controls by label, once the first picture is there."""
        found, pictures = {}, 0
        while not pictures or "size" not in found:
            for message in self.read():
                if label := (message.get("props") or {}).get("label"):
                    found[label] = message["uuid"]
                pictures += message["type"] == "BackgroundImageMessage"
        return found

    def closed(self, seconds=20):
        """The code that the connection is closed with."""
        end = time.monotonic() + seconds
        try:
            while time.monotonic() < end:
                self.read(end - time.monotonic())
        except ConnectionClosed as closed:
            return closed.rcvd.code
        raise AssertionError("it is still there")


def test_bad_guests(viewed_run, look_at, capfd):
    """The socket as an enemy has it, while somebody looks at the page."""
    with viewed("--ckpt_path", str(viewed_run), "--port", "0") as viewer:
        port, token = int(re.split("[:/]+", viewer.address)[2]), viewer.address.rstrip("/").rpartition("/")[2]
        assert len(token) > 40
        for upgrade in (False, True):
            good = 101 if upgrade else 200
            assert asked(port, f"/{token}", upgrade) == good
            assert asked(port, f"/{token}", upgrade, Host=f"localhost:{port}") == good
            assert asked(port, f"/{token}", upgrade, Origin="http://evil.example") == 403
            assert asked(port, f"/{token}", upgrade, Origin=f"http://localhost:{port}") == 403
            assert asked(port, f"/{token}", upgrade, Host=f"evil.example:{port}") == 403
            assert asked(port, f"/{token}", upgrade, Host="") == 403
            assert asked(port, "/", upgrade) == 403
            assert asked(port, f"/{token[:-1]}x", upgrade) == 403
            assert asked(port, f"/?{token}", upgrade) == 403
        assert asked(port, f"/{token}/../../pyproject.toml") == 404
        with socket.create_connection(("127.0.0.1", port)) as line:
            line.sendall(b"\x16\x03\x01 garbage\r\n\r\n")

        page = look_at(viewer.address, width=1000, height=640)
        page.page.wait_for_function("() => document.body.innerText.includes('pixels.')")
        assert page.errors == []
        (number,) = viewer.sessions
        friend = viewer.sessions[number]

        wrong = [{**CAMERA, "fov": NAN}, {**CLICK, "ray_direction": [0.0, 0.0, 0.0]}]  # test_numbers_are_ranged has all
        wrong += [{**CONTROL, "updates": {"value": NAN}}, "text", b"\xc1"]
        for message in wrong:
            assert Client(viewer.address, message).closed() == 1008
        assert Client(viewer.address, {**CAMERA, "surplus": 1}).closed() == 1008  # viser itself fails over it
        assert Client(viewer.address, b"\xc4" * (1 << 20)).closed() == 1009  # too long

        first = Client(viewer.address, CAMERA)
        controls = first.controls()
        for message in wrong[-2:]:  # by one that has pictures already
            first.send(message)
            assert first.closed() == 1008
            first = Client(viewer.address, CAMERA)
            controls = first.controls()
        for label, value in (("size", "99999999"), ("view", "nowhere"), ("exposure", "nan")):
            first.send({**CONTROL, "uuid": controls[label], "updates": {"value": value}})
            assert first.closed() == 1008
            first = Client(viewer.address, CAMERA)
            controls = first.controls()
        for label, value in (("exposure", 1e9), ("exposure", -1e9), ("exposure", "abc"), ("turn", 1e9), ("unknown", 1)):
            first.send({**CONTROL, "uuid": controls.get(label, "x"), "updates": {"value": value}})
        first.send({**CAMERA, "position": [1e12, -1e12, 0], "fov": 3.1, "image_height": 1, "image_width": 65536})
        nowhere = {name: [0, 0, 0] for name in ("position", "look_at", "up_direction")}
        first.send({**CAMERA, **nowhere, "image_width": 0})
        first.send({**CLICK, "ray_origin": [1e12, 0, 0]})
        first.send({"type": "ShareUrlRequest"})
        while not any(message["type"] == "BackgroundImageMessage" for message in first.read()):
            pass

        # nobody else noticed
        assert viewer.sessions[number] is friend
        frames = friend.frames
        page.page.get_by_label("mode", exact=True).click()
        page.page.get_by_role("option", name="albedo", exact=True).click()
        page.page.wait_for_function("() => document.body.innerText.includes('The recovered albedo.')")
        assert friend.frames > frames
        assert page.errors == []
    said = capfd.readouterr()
    assert said.out.count(token) == 1
    assert "Traceback" not in said.err
    assert said.err.count("a browser was dropped") >= len(wrong)
