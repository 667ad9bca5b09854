"""Who may connect to `climategs view`, what a page may send, and what of others' texts it shows."""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import urlsplit

import msgspec
import pytest
import viser
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from augment.errors import ClimateGSError, OutputError
from recipes.errors import RecipeError
from recipes.load import load_recipe
from tests.tools.page_client import PageClient
from tools.view import messages, text
from tools.view.access import Access, is_loopback
from tools.view.edits import create_file, rename_recipe, save_recipe, unused_path
from tools.view.messages import FileTransferPart, FileTransferStartUpload, Uploads, read_message
from tools.view.server import MAX_PIXELS, check_size, import_viser, serve
from tools.view.widgets import options_of


class SmallPages:
    """A page with one widget of each kind, and what it hears."""

    def __init__(self) -> None:
        self.values: list[Any] = []
        self.refusals: list[str] = []
        self.clients: list[int] = []

    def start(self) -> None:
        """Nothing to do."""

    def stop(self) -> None:
        """Nothing to do."""

    def open_page(self, client: Any) -> Callable[[str], None]:
        self.clients.append(client.client_id)
        gui = client.gui
        number = gui.add_number("number", 1.0, min=0.0, max=10.0)
        frame = gui.add_slider("frame", 0, 5, 1, 0)
        word = gui.add_dropdown("word", ("fog", "rain"))
        flag = gui.add_checkbox("flag", False)
        line = gui.add_text("line", "")
        both = gui.add_vector3("both", (0.0, 0.0, 0.0), min=(0.0, 0.0, 0.0))
        file = gui.add_upload_button("file")
        for part in (number, frame, word, flag, line, both):
            part.on_update(self._hear)
        file.on_upload(self._hear)
        return self.refusals.append

    def close_page(self, client: Any) -> None:
        self.clients.remove(client.client_id)

    async def _hear(self, event: Any) -> None:
        self.values.append(event.target.value)


@pytest.fixture
def pages() -> SmallPages:
    return SmallPages()


@pytest.fixture
def url(pages: SmallPages) -> Iterator[str]:
    with serve(import_viser(), pages, "127.0.0.1", 0) as url:
        yield url


def wait_until(look: Callable[[], object]) -> None:
    end = time.monotonic() + 10
    while not look():
        assert time.monotonic() < end
        time.sleep(0.01)


# ---- Who may connect -----------------------------------------------------------------------------


def status_of(url: str, path: str, headers: str, *, upgrade: bool = True) -> int:
    """The status that the server answers a request with."""
    lines = f"GET {path} HTTP/1.1\r\n{headers}"
    if upgrade:
        lines += (
            "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
            f"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
            f"Sec-WebSocket-Protocol: viser-v{viser.__version__}\r\n"
        )
    with socket.create_connection(("127.0.0.1", urlsplit(url).port or 0), timeout=10) as connection:
        connection.sendall(f"{lines}\r\n".encode())
        return int(connection.recv(100).split()[1])


def test_a_connection_needs_the_token_this_machines_name_and_its_own_pages_origin(url, pages):
    port, token = urlsplit(url).port, urlsplit(url).query
    host, cookie = f"Host: localhost:{port}\r\n", f"climategs-view-{port}={token[6:]}"
    origin = f"Origin: http://localhost:{port}\r\n"
    let_in = [
        (f"/?{token}", host),
        (f"/?{token}", host + origin),
        ("/", f"{host}{origin}Cookie: other=1; {cookie}\r\n"),
        (f"/?{token}", f"Host: 127.0.0.1:{port}\r\nOrigin: http://127.0.0.1:{port}\r\n"),
        (f"/?{token}", "Host: localhost:9000\r\nOrigin: http://localhost:9000\r\n"),  # by a tunnel
        (f"/?{token}", f"Host: [::1]:{port}\r\n"),
    ]
    refused = [
        ("/", host),
        ("/", host + origin),
        (f"/?{token}x", host),
        ("/?token=", host),
        ("/", f"{host}Cookie: climategs-view-1={token[6:]}\r\n"),
        (f"/?{token}", f"{host}Origin: https://evil.example\r\n"),
        (f"/?{token}", f"{host}Origin: null\r\n"),
        (f"/?{token}", f"{host}Origin: file://\r\n"),
        (f"/?{token}", f"{host}Origin: http://localhost:1\r\n"),
        (f"/?{token}", f"{host}Origin: http://localhost\r\n"),
        (f"/?{token}", f"{host}{origin}Origin: https://evil.example\r\n"),
        (f"/?{token}", f"Host: evil.example:{port}\r\nOrigin: http://evil.example:{port}\r\n"),
        (f"/?{token}", f"Host: 203.0.113.7:{port}\r\n"),
        (f"/?{token}", ""),
        (f"/?{token}", host + host),
        (f"/?{token}", "Host: [:::]\r\n"),
        (f"//[::?{token}x", host),
        # viser's page would connect to that server, or play that file.
        (f"/?{token}&websocket=wss://evil.example", host),
        (f"/?playbackPath=https://evil.example/x.viser&{token}", host),
    ]  # fmt: skip
    for path, headers in let_in:
        assert status_of(url, path, headers) == 101, (path, headers)
        assert status_of(url, path, headers, upgrade=False) == 200, (path, headers)
    for path, headers in refused:
        for upgrade in (True, False):
            assert status_of(url, path, headers, upgrade=upgrade) in (400, 403), (path, headers)
    assert not pages.clients


def test_addresses_of_this_machine_alone_are_known():
    assert all(map(is_loopback, ("127.0.0.1", "localhost", "::1", "127.8.9.1")))
    assert not any(map(is_loopback, ("0.0.0.0", "::", "10.0.0.1", "example.org")))


def test_at_other_addresses_the_token_and_the_origin_are_the_rule():
    from websockets.datastructures import Headers

    access = Access(is_local=False)
    host, path = ("Host", "render-3.lab:8080"), f"/?token={access.token}"
    allowed = [[host], [host, ("Origin", "http://render-3.lab:8080")]]
    refused = [[host, ("Origin", "http://evil.example:8080")], [host, ("Origin", "null")], []]
    assert not any(access.refusal(path, Headers(each), 8080) for each in allowed)
    assert all(access.refusal(path, Headers(each), 8080) for each in refused)
    assert access.refusal("/", Headers([host]), 8080) is not None


def test_a_page_makes_no_code_of_texts_and_stands_in_no_frame(url):
    with socket.create_connection(("127.0.0.1", urlsplit(url).port or 0)) as connection:
        path = f"/?{urlsplit(url).query}"
        connection.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        head = connection.makefile("rb").read(2000).split(b"\r\n\r\n")[0].decode()
    policy = next(line for line in head.splitlines() if line.startswith("Content-Security-Policy"))
    assert "'unsafe-eval'" not in policy and "frame-ancestors 'none'" in policy
    assert "connect-src 'self' ws://localhost wss://localhost data: blob:;" in policy
    assert "HttpOnly; SameSite=Strict" in head and "Referrer-Policy: no-referrer" in head


def test_nobody_can_have_the_page_shared(url, monkeypatch):
    asked = []
    for name in ("request_share_url", "disconnect_share_url"):
        monkeypatch.setattr(viser.ViserServer, name, lambda *_, name=name, **__: asked.append(name))
    with PageClient(url) as page:
        page.wait_for(lambda: page.widgets.get("line"), "the page")
        for kind in ("ShareUrlRequest", "ShareUrlDisconnect"):
            page.send({"type": kind})
        page.set("line", "still here")
        page.wait_for(lambda: page.is_listening, "the server")
        time.sleep(0.3)
        assert page.is_listening and not asked
        assert page.theme["show_share_button"] is False


# ---- What a page may send ------------------------------------------------------------------------

CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [0, 0, 2], "fov": 1.0,
    "near": 0.01, "far": 1000.0, "image_height": 360, "image_width": 640,
    "look_at": [1.0, 0.0, 2.0], "up_direction": [0, 0, 1],
}  # fmt: skip


@pytest.mark.parametrize(
    "message",
    [
        CAMERA | {"fov": float("nan")},
        CAMERA | {"fov": 3.14},
        CAMERA | {"position": [float("inf"), 0, 0]},
        CAMERA | {"position": [1e30, 0, 0]},
        CAMERA | {"wxyz": [0, 0, 0, 0]},
        CAMERA | {"wxyz": [1, 0, 0]},
        CAMERA | {"image_width": 2**31},
        CAMERA | {"image_height": -1},
        {name: value for name, value in CAMERA.items() if name != "look_at"},
        CAMERA | {"camera_cb": []},
        {"type": "ShareUrlRequest"},
        {"type": "RunJavascriptMessage", "source": "1"},
        {"type": "GuiUpdateMessage", "uuid": "1", "updates": {"update_cb": []}},
        {"type": "GuiUpdateMessage", "uuid": "1", "updates": {"value": {"a": 1}}},
        {"type": "GuiUpdateMessage", "uuid": "1", "updates": {"value": float("nan")}},
        {"type": "GuiUpdateMessage", "uuid": "1", "updates": {"value": "x" * 70_000}},
        [1, 2],
        "text",
    ],
)
def test_a_message_that_no_page_sends_is_none(message):
    assert read_message(msgspec.msgpack.encode(CAMERA))
    with pytest.raises(ValueError):
        read_message(msgspec.msgpack.encode(message))


@pytest.mark.parametrize("data", [b"", b"\xc1", b"\x91" * 100_000, b"\xdf\xff\xff\xff\xff", "text"])
def test_bytes_that_are_no_message_are_none(data):
    with pytest.raises(ValueError):
        read_message(data)


def test_a_widget_takes_only_values_that_it_can_have(url, pages, caplog):
    hostile = {
        "number": [11.0, -1, True, "1", [1.0], float("nan"), 1e300],
        "frame": [6, -1, 2**53, "1", 1e300],
        "word": ["snow", "/etc/passwd", 1, True],
        "flag": ["yes", 1, 0.0],
        "line": [1, False, [1]],
        "both": [[1.0, 2.0], [-1.0, 0.0, 0.0], "abc", [1.0, 2.0, "3"], 4],
        "file": ["x", True, [1]],
    }
    good = {"number": 9.5, "frame": 3, "word": "rain", "flag": True, "line": "{x}"}
    with caplog.at_level(logging.WARNING), PageClient(url) as page:
        for name, values in hostile.items():
            for value in values:
                page.set(name, value)
        start = {"type": "FileTransferStartUpload", "transfer_uuid": "1", "filename": "x"}
        sizes = {"mime_type": "", "part_count": 0, "size_bytes": 0}
        page.send({**start, **sizes, "source_component_uuid": page.widgets["number"][0]["uuid"]})
        for name, value in good.items():
            page.set(name, value)
        page.set("both", [1, 2.5, 3])
        page.upload("file", "a.yaml", b"abc")
        wait_until(lambda: len(pages.values) >= 7)
    *values, file = pages.values
    assert values == [*good.values(), (1.0, 2.5, 3.0)] and file.content == b"abc"
    assert len(pages.refusals) == sum(map(len, hostile.values())) - len(hostile["file"])
    assert "number: 11 is not within its ends, 0 to 10" in pages.refusals
    assert not caplog.records


def test_a_page_moves_no_widgets_of_another(url, pages):
    with PageClient(url) as one, PageClient(url) as other:
        (flag,) = one.wait_for(lambda: one.widgets.get("flag"), "the page")
        other.wait_for(lambda: other.widgets.get("file"), "the other page")
        update = {"type": "GuiUpdateMessage", "uuid": flag["uuid"], "updates": {"value": True}}
        other.send(update)
        other.set("line", "from the other")
        wait_until(lambda: pages.values)
    assert pages.values == ["from the other"] and not flag["value"]


def begun(name: str, size: int, parts: int) -> FileTransferStartUpload:
    return FileTransferStartUpload("button", name, f"{name}.bin", "", parts, size)


def part_of(name: str, index: int, content: bytes) -> FileTransferPart:
    return FileTransferPart("button", name, index, content)


def test_an_upload_is_passed_on_whole_or_not_at_all():
    refusals: list[str] = []
    uploads = Uploads(refusals.append)
    assert uploads.begin(begun("a", 5, 2)) == uploads.add(part_of("a", 1, b"45")) == []
    start, whole = uploads.add(part_of("a", 0, b"123"))
    assert start.part_count == 1 and whole.content == b"12345"
    assert len(uploads.begin(begun("empty", 0, 0))) == 1
    uploads.begin(begun("b", 5, 2))
    assert uploads.add(part_of("b", 0, b"123456")) == uploads.add(part_of("b", 1, b"")) == []
    uploads.begin(begun("c", 5, 1))
    assert uploads.add(part_of("c", 7, b"12345")) == []
    assert uploads.add(part_of("nobody's", 0, b"1")) == []
    assert len(uploads) == 0 and len(refusals) == 2


def test_unfinished_uploads_have_limits_of_size_number_and_time(monkeypatch):
    refusals: list[str] = []
    uploads = Uploads(refusals.append)
    uploads.begin(begun("large", messages.MAX_UPLOAD_BYTES + 1, 2))
    assert len(uploads) == 0 and "64 MiB" in refusals[0] and "large.bin" in refusals[0]
    for number in range(messages.MAX_UPLOADS + 1):
        uploads.begin(begun(str(number), 10, 2))
    assert len(uploads) == messages.MAX_UPLOADS and len(refusals) == 2
    uploads.forget_idle()
    assert len(uploads) == messages.MAX_UPLOADS
    monkeypatch.setattr(messages, "UPLOAD_S", -1.0)
    uploads.forget_idle()
    assert len(uploads) == 0


def test_a_page_whose_messages_are_too_long_is_closed_and_others_stay(url):
    address = url.replace("http", "ws").replace("localhost", "127.0.0.1")
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    with PageClient(url) as page:
        page.wait_for(lambda: page.widgets.get("line"), "the page")
        with connect(address, subprotocols=[protocol]) as other:
            other.send(bytes(2 * messages.MAX_MESSAGE_BYTES))
            with pytest.raises(Exception, match="1009"):
                while True:
                    other.recv(timeout=10)
        page.set("line", "still here")
        assert page.is_listening


# ---- Texts ---------------------------------------------------------------------------------------


def test_texts_of_others_are_shown_letter_for_letter():
    hostile = "{alert(1)} <img src=x onerror=alert(1)> &lt; `a` **b** | \u202e \x00 \udcff 雪 é"
    shown = text.escaped(hostile)
    assert "<" not in shown and "&lt;img" in shown and "&amp;lt;" in shown
    assert "\\u202e" in shown and "\\x00" in shown and "\\udcff" in shown and "雪 é" in shown
    assert text.escaped("a\nb") == "a<br>b" and text.printable("a\nb") == "a\\nb"
    cells = text.table(("<a>", "{b}"), [("<i>", "</table>")], [True])
    assert "<i>" not in cells and cells.count("</table>") == 1 and "<b>&lt;i&gt;</b>" in cells
    assert len(text.printable("x" * 10**6)) < 30_000
    shown.encode()


def test_options_are_unequal_and_can_be_sent():
    options = options_of(["a", "", "(empty)", "b\x00", "b\\x00", "\udcff"])
    assert list(options.values()) == ["a", "", "(empty)", "b\x00", "b\\x00", "\udcff"]
    assert list(options)[1:3] == ["(empty)", "(empty) (2)"] and all(map(str.isprintable, options))


# ---- Files ---------------------------------------------------------------------------------------


def test_files_of_pages_replace_nothing_and_follow_no_link(tmp_path):
    folder = tmp_path / "opened"
    (first,) = {create_file(folder, "fog.v2", ".yaml", b"1")}
    (folder / "fog.yaml").write_bytes(b"precious")
    (folder / "fog.v2-2.yaml").symlink_to(tmp_path / "outside")  # a link to nothing
    second = create_file(folder, "fog.v2", ".yaml", b"2")
    assert (first.name, second.name) == ("fog.v2.yaml", "fog.v2-3.yaml")
    assert create_file(folder, "fog", ".yaml", b"3").name == "fog-2.yaml"
    assert (folder / "fog.yaml").read_bytes() == b"precious" and first.read_bytes() == b"1"
    assert not (tmp_path / "outside").exists()
    assert unused_path(folder, "fog", ".yaml").name == "fog-3"
    assert not [path for path in folder.iterdir() if path.name.startswith(".")]
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "uploads").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OutputError, match="is a link"):
        create_file(tmp_path / "uploads", "a", ".png", b"")
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OutputError, match="file"):
        create_file(tmp_path / "file" / "below", "a", ".png", b"")
    recipe = load_recipe("clear").resolve(0)
    os.symlink("nowhere", tmp_path / "mine.yaml")
    with pytest.raises(FileExistsError):
        save_recipe(recipe, tmp_path / "mine.yaml")
    assert unused_path(tmp_path, "mine", ".yaml").name == "mine-2"


@pytest.mark.parametrize("name", ["", "..", "a/b", "x" * 65, "a b", "<b>", "a\n"])
def test_a_bad_name_is_refused_in_our_words(name):
    with pytest.raises(RecipeError, match="1 to 64 letters") as raised:
        rename_recipe(load_recipe("clear").resolve(0), name)
    assert "pydantic" not in str(raised.value)


def test_every_pixel_has_a_limit():
    check_size(8192, MAX_PIXELS / 8192)
    with pytest.raises(ClimateGSError, match="20000 x 10000 pixels"):
        check_size(20_000, 10_000)
