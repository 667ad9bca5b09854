"""An output folder as a store of whole files: a folder of this machine, or a place in the cloud.

Paths are relative to the folder, with forward slashes. A file is there whole or not at all.
"""

from __future__ import annotations

import re
import urllib.parse
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from augment.batch.layout import relative_parts
from augment.errors import OutputError

_UNSAFE = re.compile("[\x00-\x1f\x7f\ud800-\udfff]")  # control characters, bytes that are no text


class StoredFileMissing(OutputError):
    """A store has no file of this path."""


@dataclass(frozen=True)
class StoredFile:
    """Size in bytes, and time of the last change by the store's own clock, seconds since 1970."""

    size: int
    modified_s: float


@runtime_checkable
class Store(Protocol):
    """Files below one folder. All methods raise OutputError, and may be called by any thread.

    A store can be pickled and used after a fork: each process opens its own connections. (A child
    that os.fork made and that used S3 must end by os._exit, as those of multiprocessing do: at a
    normal exit, pyarrow waits for threads that did not follow it.)
    """

    @property
    def uri(self) -> str:
        """What open_store takes, without credentials; a local folder's absolute path."""
        ...

    @property
    def local_dir(self) -> Path | None:
        """The folder, where it is on this machine."""
        ...

    def read(self, path: str) -> bytes:
        """The file's bytes; StoredFileMissing where there is none."""
        ...

    def write(self, path: str, data: bytes) -> None:
        """Put the bytes there, durably, in one step that replaces what was there."""
        ...

    def put_file(self, path: str, source: Path) -> None:
        """As write, with the bytes of a local file; a local store may share its disk blocks."""
        ...

    def list(self, folder: str) -> dict[str, StoredFile]:
        """Every file beneath the folder ("" for all), by path relative to the root, sorted."""
        ...

    def exists(self, path: str) -> bool:
        """Whether there is a file of this path."""
        ...

    def delete(self, paths: Iterable[str]) -> None:
        """Delete files; those that are missing already are fine."""
        ...


def open_store(uri: str | Path) -> Store:
    """The store at a path, `file://`, `s3://bucket/path?region=...`, `gs://` or the like.

    Nothing is read or made yet: a folder appears with its first file, a bucket must exist.
    S3 takes `endpoint_override`, `scheme`, `region`, `force_virtual_addressing` and
    `tls_ca_file_path` in the URI, and credentials from the environment.

    Raises:
        OutputError: no such kind of store, or options that it does not know.
    """
    from augment.batch.local_store import LocalStore

    if isinstance(uri, Path) or "://" not in uri:
        return LocalStore(Path(uri).absolute())
    if uri.lower().startswith("file:"):
        parsed = urllib.parse.urlsplit(uri)
        if parsed.netloc not in ("", "localhost") or not parsed.path.startswith("/"):
            raise OutputError(f"{uri!r} must be file:///absolute/path")
        return LocalStore(Path(urllib.parse.unquote(parsed.path)))
    from augment.batch.remote_store import RemoteStore

    return RemoteStore(uri)


def stored_path(path: str, uri: str) -> str:
    """The path with single slashes between its components.

    Raises:
        OutputError: it is absolute, empty, climbs with `..`, or holds control characters.
    """
    parts = relative_parts(path)
    if parts is None or _UNSAFE.search(path):
        raise OutputError(
            f"{uri}: {path!r} is no path of a file there; paths must be relative to it, with "
            f"forward slashes and without '..' or control characters. Where a manifest names "
            f"it, do not trust the folder"
        )
    return "/".join(parts)
