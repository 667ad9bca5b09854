"""A page of `climategs view` without a browser: it speaks viser's protocol as the browser does."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar

import cv2
import msgspec
import numpy as np
import viser
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

TIMEOUT_S = 300.0  # kernels may have to be compiled
Found = TypeVar("Found")


class PageClient:
    """widgets: as the server made and changed them, by FOLDER/LABEL, in order. pictures: the time
    of each, and its message. said: all that the page's lines have said, in order. nodes: what lies
    over the picture. theme: of the page. pose: of the window, which goes where the server puts it.
    """

    def __init__(
        self, url: str, size: tuple[int, int] = (640, 360), origin: str | None = None
    ) -> None:
        address = url.replace("http", "ws").replace("localhost", "127.0.0.1")
        own: dict[str, Any] = {"max_size": None, "compression": None}
        protocol = Subprotocol(f"viser-v{viser.__version__}")
        self._socket = connect(address, origin=origin, subprotocols=[protocol], **own)
        self.size, self.widgets, self.pictures = size, dict[str, list[dict[str, Any]]](), []
        self.nodes: set[str] = set()
        self.theme: dict[str, Any] = {}
        self.said: list[str] = []
        self.pose: dict[str, Any] = {
            "position": [0.0, -5.0, 2.0], "look_at": [0.0, 0.0, 0.0],
            "up_direction": [0.0, 0.0, 1.0], "fov": 1.0,
        }  # fmt: skip
        self._by_uuid: dict[str, dict[str, Any]] = {}
        self._folders: dict[str, str] = {}
        self._html: dict[str, str] = {}
        self._is_deaf = False
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()
        self.send_camera()

    @property
    def is_listening(self) -> bool:
        return self._thread.is_alive()

    def stop_listening(self) -> None:
        """Take no more from the connection, which stays."""
        self._is_deaf = True

    def close(self) -> None:
        self._is_deaf = False
        self._socket.close()
        self._thread.join()

    def __enter__(self) -> PageClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ---- What the person does

    def set(self, path: str, value: Any, number: int = -1) -> None:
        """Moves one of the widgets of that label: the last, or 0 for the first."""
        widget = self.wait_for(lambda: self.widgets.get(path), path)[number]
        widget["value"] = value
        self.send({"type": "GuiUpdateMessage", "uuid": widget["uuid"], "updates": {"value": value}})

    def press(self, path: str) -> None:
        self.set(path, True)

    def upload(self, path: str, name: str, content: bytes) -> None:
        widget = self.wait_for(lambda: self.widgets.get(path), path)[-1]
        own = {"source_component_uuid": widget["uuid"], "transfer_uuid": name}
        said = {"filename": name, "mime_type": "", "part_count": 1, "size_bytes": len(content)}
        self.send({"type": "FileTransferStartUpload", **own, **said})
        self.send({"type": "FileTransferPart", **own, "part_index": 0, "content": content})

    def move(self, **pose: Any) -> None:
        self.pose |= pose
        self.send_camera()

    def send_camera(self) -> None:
        position, look_at, up = (
            np.asarray(self.pose[name], float) for name in ("position", "look_at", "up_direction")
        )
        z = (look_at - position) / np.linalg.norm(look_at - position)
        x = np.cross(z, up) / np.linalg.norm(np.cross(z, up))
        rotation = np.stack([x, np.cross(z, x), z], 1)
        wxyz = viser.transforms.SO3.from_matrix(rotation).wxyz
        width, height = self.size
        sizes = {"image_width": width, "image_height": height, "near": 0.01, "far": 1000.0}
        own = {name: np.asarray(value).tolist() for name, value in self.pose.items()}
        self.send({"type": "ViewerCameraMessage", "wxyz": wxyz.tolist(), **own, **sizes})

    # ---- What the person sees

    def status(self) -> str:
        return " ".join(self._html.values())

    def picture(self, what: str = "at rest", *, after: int = 0) -> np.ndarray:
        """The next one, RGB, of those that have come since there were `after`."""
        format_ = {"at rest": "png", "while moving": "jpeg"}[what]

        def newest() -> dict[str, Any] | None:
            fitting = [m for _, m in self.pictures[after:] if m["format"] == format_]
            return fitting[-1] if fitting else None

        message = self.wait_for(newest, f"a picture {what}")
        return cv2.cvtColor(
            cv2.imdecode(np.frombuffer(message["rgb_data"], np.uint8), cv2.IMREAD_COLOR),
            cv2.COLOR_BGR2RGB,
        )

    def rest(self, *, after: int) -> np.ndarray:
        """The picture at rest, after which none comes for a while."""
        picture = self.picture(after=after)
        while True:
            count = len(self.pictures)
            time.sleep(0.5)
            if len(self.pictures) == count:
                return picture
            picture = self.picture(after=count)

    def wait_for(self, look: Callable[[], Found | None], what: str) -> Found:
        end = time.monotonic() + TIMEOUT_S
        while time.monotonic() < end:
            if found := look():
                return found
            time.sleep(0.01)
        raise AssertionError(f"waited {TIMEOUT_S:g} s for {what}; the page says {self.status()}")

    # ---- The protocol

    def send(self, message: dict[str, Any]) -> None:
        self._socket.send(msgspec.msgpack.encode(message))

    def _listen(self) -> None:
        try:
            for raw in self._socket:
                while self._is_deaf:
                    time.sleep(0.05)
                assert isinstance(raw, bytes)
                length = int.from_bytes(raw[8:16], "little")
                packed = zstandard.ZstdDecompressor().decompress(
                    raw[16 : 16 + length], int.from_bytes(raw[:8], "little")
                )
                messages = msgspec.msgpack.decode(packed)["messages"]
                for message in messages:
                    self._hear(message)
                if any(message["type"].startswith("SetCamera") for message in messages):
                    self.send_camera()
        except ConnectionClosed:
            pass

    def _hear(self, message: dict[str, Any]) -> None:
        kind = message["type"]
        if kind == "BackgroundImageMessage" and message["rgb_data"]:
            self.pictures.append((time.monotonic(), message))
        elif kind == "GuiUpdateMessage":
            own = self._by_uuid.get(message["uuid"], {})
            own |= message["updates"]
            if "content" in message["updates"]:
                self._html[message["uuid"]] = message["updates"]["content"]
                self.said.append(message["updates"]["content"])
        elif kind.startswith("Gui") and "props" in message:
            own = {**message["props"], "uuid": message["uuid"], "value": message.get("value")}
            self._by_uuid[message["uuid"]] = own
            above = self._folders.get(message["container_uuid"], "")
            path = above + (own.get("label") or "")
            self.widgets.setdefault(path, []).append(own)
            if kind == "GuiFolderMessage":
                self._folders[message["uuid"]] = f"{path}/" if own["label"] else above
        elif kind == "ThemeConfigurationMessage":
            self.theme = message
        elif kind == "RemoveSceneNodeMessage":
            self.nodes.discard(message["name"])
        elif kind in ("LineSegmentsMessage", "PointCloudMessage", "CameraFrustumMessage"):
            self.nodes.add(message["name"])
        for name in ("position", "look_at", "up_direction", "fov"):
            word = name.title().replace("_", "")
            if kind == f"SetCamera{word}Message":
                (self.pose[name],) = (message[key] for key in message if key in (name, "position"))
