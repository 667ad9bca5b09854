"""Messages that a page may send. This file drops all others.

viser handles whatever a connection sends, takes any number, sets any attribute of a widget that a
message names, and keeps parts of uploads for as long as the connection lasts. So this file reads
each message first, by a schema, and writes it anew for viser. It also collects the parts of
uploads, within limits of size, number and time, and passes on only complete files.

This module needs the libraries of viser's protocol, which are installed with viser.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any

import msgspec
import viser
import zstandard
from msgspec import Meta
from websockets.asyncio.server import ServerConnection

from augment.errors import ClimateGSError
from tools.view.widgets import value_of

# The largest message, bytes; a browser cuts files into parts of half as much.
MAX_MESSAGE_BYTES = 2**20
MAX_UPLOAD_BYTES = 64 * 2**20  # The largest sum of a page's uploads at one time, bytes.
MAX_UPLOADS = 4  # The most uploads of a page at one time.
UPLOAD_S = 60.0  # The time without a new part after which an upload is given up, seconds.
MAX_TEXT = 65_536  # The longest text in a widget, characters.
_LOG = logging.getLogger(__name__)

Name = Annotated[str, Meta(max_length=128)]
Coordinate = Annotated[float, Meta(ge=-1e7, le=1e7)]
Vector = tuple[Coordinate, Coordinate, Coordinate]
Pixels = Annotated[int, Meta(ge=0, le=2**15)]
Number = Annotated[float, Meta(ge=-1e300, le=1e300)]
WholeNumber = Annotated[int, Meta(ge=-(2**53), le=2**53)]
Text = Annotated[str, Meta(max_length=MAX_TEXT)]


class ViewerCameraMessage(msgspec.Struct, tag=True, tag_field="type", forbid_unknown_fields=True):
    """Pose of the window's camera, world_from_camera, and the size of the window in pixels."""

    wxyz: tuple[Coordinate, Coordinate, Coordinate, Coordinate]
    position: Vector
    fov: Annotated[float, Meta(gt=1e-3, lt=2.8)]
    near: Number
    far: Number
    image_height: Pixels
    image_width: Pixels
    look_at: Vector
    up_direction: Vector

    def __post_init__(self) -> None:
        if sum(number * number for number in self.wxyz) < 1e-6:
            raise ValueError("wxyz is no rotation")


class Updates(msgspec.Struct, forbid_unknown_fields=True):
    """The new value of a widget, and nothing else of it."""

    value: (
        bool
        | WholeNumber
        | Number
        | Text
        | Annotated[tuple[WholeNumber | Number, ...], Meta(max_length=8)]
    )


class GuiUpdateMessage(msgspec.Struct, tag=True, tag_field="type", forbid_unknown_fields=True):
    """A person has changed a widget, or pressed a button."""

    uuid: Name
    updates: Updates


class FileTransferStartUpload(
    msgspec.Struct, tag=True, tag_field="type", forbid_unknown_fields=True
):
    """A person has chosen a file; its parts follow."""

    source_component_uuid: Name
    transfer_uuid: Name
    filename: Annotated[str, Meta(max_length=1024)]
    mime_type: Annotated[str, Meta(max_length=1024)]
    part_count: Annotated[int, Meta(ge=0, le=1024)]
    size_bytes: Annotated[int, Meta(ge=0, le=2**53)]


class FileTransferPart(msgspec.Struct, tag=True, tag_field="type", forbid_unknown_fields=True):
    """A part of a file."""

    source_component_uuid: Name
    transfer_uuid: Name
    part_index: Annotated[int, Meta(ge=0, le=1024)]
    content: bytes


PageMessage = ViewerCameraMessage | GuiUpdateMessage | FileTransferStartUpload | FileTransferPart
_DECODER = msgspec.msgpack.Decoder(PageMessage)


@dataclass
class Upload:
    """A file whose parts are coming in."""

    start: FileTransferStartUpload
    """The message that announced the file."""
    parts: dict[int, bytes] = field(default_factory=dict)
    """The content of every part so far, by its number."""
    size_bytes: int = 0
    """The size of all parts so far, bytes."""
    last_part_time: float = field(default_factory=time.monotonic)
    """The time of the latest part on the monotonic clock, seconds."""


class Uploads:
    """The files that one page has begun to upload.

    Args:
        report: Shows on the page why a file is refused.
    """

    def __init__(self, report: Callable[[str], None]) -> None:
        self._report = report
        self._uploads: dict[str, Upload] = {}

    def __len__(self) -> int:
        return len(self._uploads)

    def begin(self, start: FileTransferStartUpload) -> list[PageMessage]:
        """Begin an upload. Return the messages to pass on: an empty file is complete at once."""
        size = start.size_bytes
        waiting = sum(upload.start.size_bytes for upload in self._uploads.values())
        if start.transfer_uuid in self._uploads:
            return []
        if len(self) >= MAX_UPLOADS or waiting + size > MAX_UPLOAD_BYTES:
            self._report(
                f"{start.filename} ({size / 2**20:.1f} MiB) was not uploaded: a page takes "
                f"{MAX_UPLOADS} files of {MAX_UPLOAD_BYTES // 2**20} MiB together at a time; copy "
                f"it to the machine of climategs view and write its path instead"
            )
            return []
        if start.part_count == 0:
            return [msgspec.structs.replace(start, size_bytes=0)]
        self._uploads[start.transfer_uuid] = Upload(start)
        return []

    def add(self, part: FileTransferPart) -> list[PageMessage]:
        """Add a part. Return the messages to pass on: the complete file after its last part."""
        upload = self._uploads.get(part.transfer_uuid)
        if upload is None or part.part_index in upload.parts:
            return []
        upload.parts[part.part_index] = part.content
        upload.size_bytes += len(part.content)
        upload.last_part_time = time.monotonic()
        start = upload.start
        count = len(upload.parts)
        too_large = upload.size_bytes > start.size_bytes or part.part_index >= start.part_count
        if count < start.part_count and not too_large:
            return []
        del self._uploads[part.transfer_uuid]
        if too_large or upload.size_bytes != start.size_bytes:
            self._report(f"{start.filename} was not uploaded: its parts are not what was announced")
            return []
        content = b"".join(upload.parts[index] for index in range(count))
        file = FileTransferPart(start.source_component_uuid, start.transfer_uuid, 0, content)
        return [msgspec.structs.replace(start, part_count=1), file]

    def progress(self, message: FileTransferStartUpload | FileTransferPart) -> tuple[int, int]:
        """Return the bytes of the message's file so far, and its size in bytes.

        Both numbers are equal for a file that has ended or was refused, so that the page goes on
        to the next one.
        """
        upload = self._uploads.get(message.transfer_uuid)
        return (1, 1) if upload is None else (upload.size_bytes, upload.start.size_bytes)

    def forget_idle(self) -> None:
        """Give up uploads without a new part in the last UPLOAD_S seconds."""
        for key, upload in list(self._uploads.items()):
            if time.monotonic() - upload.last_part_time > UPLOAD_S:
                del self._uploads[key]
                self._report(
                    f"{upload.start.filename} was not uploaded: no part of it has come for "
                    f"{UPLOAD_S:g} s"
                )


class PageConnection(ServerConnection):
    """A page's connection. It gives viser only the messages that a page may send.

    After the page is made, `widget_of` returns viser's handle of a widget by its name in messages,
    and `report` shows on the page why something was refused.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.widget_of: Callable[[str], Any] = lambda _: None
        self.report: Callable[[str], None] = _LOG.debug
        self._uploads = Uploads(lambda text: self.report(text))
        self._ready: deque[bytes] = deque()
        self._timer: asyncio.TimerHandle | None = None  # runs while there are uploads

    async def recv(self, decode: bool | None = None) -> Any:
        """Return the next message for viser."""
        while not self._ready:
            data = await super().recv(decode)
            try:
                admitted = await self._admitted(read_message(data))
            except ValueError as error:
                _LOG.debug("a message of a page is passed over: %s", error)
                if isinstance(data, bytes) and GuiUpdateMessage.__name__.encode() in data[:256]:
                    self.report(
                        f"the page's value was not taken: numbers are finite, and a text has at "
                        f"most {MAX_TEXT} characters"
                    )
            except ClimateGSError as error:
                self.report(str(error))
            else:
                self._ready.extend(map(msgspec.msgpack.encode, admitted))
        return self._ready.popleft()

    async def _admitted(self, message: PageMessage) -> list[PageMessage]:
        """Return the messages to pass on in place of one.

        Raises:
            ClimateGSError: the widget that it names cannot have the value.
        """
        if isinstance(message, ViewerCameraMessage):
            return [message]
        if isinstance(message, GuiUpdateMessage):
            widget = self.widget_of(message.uuid)
            if widget is None or isinstance(widget, viser.GuiUploadButtonHandle):
                return []
            value = value_of(widget, message.updates.value)
            return [GuiUpdateMessage(message.uuid, Updates(value))]
        widget = self.widget_of(message.source_component_uuid)
        is_upload = isinstance(widget, viser.GuiUploadButtonHandle)
        return await self._take_upload(message) if is_upload else []

    async def _take_upload(
        self, message: FileTransferStartUpload | FileTransferPart
    ) -> list[PageMessage]:
        if isinstance(message, FileTransferStartUpload):
            admitted = self._uploads.begin(message)
            if self._timer is None and self._uploads:
                self._forget_idle()
        else:
            admitted = self._uploads.add(message)
        so_far, total = self._uploads.progress(message)
        acknowledgement = {
            "type": "FileTransferPartAck",
            "source_component_uuid": message.source_component_uuid,
            "transfer_uuid": message.transfer_uuid,
            "transferred_bytes": so_far,
            "total_bytes": total,
        }
        if not admitted:  # else viser tells
            await self.send(frame_of(acknowledgement))
        return admitted

    def _forget_idle(self) -> None:
        self._uploads.forget_idle()
        loop = asyncio.get_running_loop()
        self._timer = loop.call_later(UPLOAD_S / 4, self._forget_idle) if self._uploads else None


def read_message(data: Any) -> PageMessage:
    """Decode a page's message.

    Args:
        data: The bytes of the message; any type, since a page may send anything.

    Raises:
        ValueError: a page may not send this message, or a value in it is out of range.
    """
    try:
        return _DECODER.decode(data)
    except (msgspec.MsgspecError, RecursionError, TypeError, OverflowError) as error:
        raise ValueError(str(error)) from error


def frame_of(message: dict[str, Any]) -> bytes:
    """Return the bytes of a message to a page in viser's form: two lengths and packed messages."""
    content = {"messages": [message], "timestampSec": time.perf_counter()}
    inner = msgspec.msgpack.encode({**content, "binaryBufferLengths": ()})
    packed = zstandard.ZstdCompressor(level=1).compress(inner)
    return len(inner).to_bytes(8, "little") + len(packed).to_bytes(8, "little") + packed
