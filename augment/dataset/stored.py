"""The files that a manifest names, read from this machine or from an object store.

A manifest may come from anybody, so no path leaves the output folder, whether by `..` or through a
link. Checking that takes longer than opening a file, so a folder's way is checked once, and a file
itself is opened such that it cannot be a link.
"""

from __future__ import annotations

import errno
import os
import tempfile
from collections import OrderedDict
from collections.abc import Callable, Sized
from pathlib import Path, PurePosixPath
from typing import Any, Generic, TypeVar

from augment.batch.layout import resolve_inside
from augment.batch.store import Store, StoredFileMissing
from augment.errors import OutputError

Value = TypeVar("Value")
SizedValue = TypeVar("SizedValue", bound=Sized)

CACHED_ENTRIES = 4096  # of companion files, each a frame's or an image's: tens of megabytes
_FLAGS = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)
_CAN_REFUSE_LINKS = hasattr(os, "O_NOFOLLOW")


class StoredFiles:
    """Reads the files of an output folder by the manifest's paths; picklable."""

    def __init__(self, store: Store) -> None:
        self.store = store
        root, mark, query = store.uri.partition("?")
        if store.local_dir is not None:
            root, mark, query = str(store.local_dir), "", ""
        self._before, self._after = root.rstrip("/") + "/", mark + query
        self._folders: dict[str, str] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_folders": {}}

    def name(self, folder: str, name: str) -> str:
        """What a file is called in messages and samples: its path here, or its URI."""
        return f"{self._before}{folder}{name}{self._after}"

    def read(self, folder: str, name: str) -> bytes:
        """The bytes of a file. folder: with its slash, or empty.

        Raises:
            OutputError: there is no such file, it cannot be read, or it lies outside the folder.
        """
        try:
            if self.store.local_dir is None:
                return self.store.read(folder + name)
            return self._read_here(self.store.local_dir, folder, name)
        except StoredFileMissing as error:
            raise _unreadable(self.name(folder, name), "there is no such file") from error
        except OSError as error:
            raise _unreadable(self.name(folder, name), error.strerror or str(error)) from error

    def parse(self, folder: str, name: str, read: Callable[[Path], Value]) -> Value:
        """What `read` makes of a file.

        Raises:
            OutputError: as `read` raises it, or as from `read` of this class.
        """
        if self.store.local_dir is not None:
            return read(resolve_inside(self.store.local_dir, folder + name))
        data = self.read(folder, name)
        with tempfile.TemporaryDirectory(prefix="climategs-") as scratch:
            copy = Path(scratch) / PurePosixPath(name).name
            copy.write_bytes(data)
            try:
                return read(copy)
            except OutputError as error:
                told = str(error).replace(str(copy), self.name(folder, name))
                raise OutputError(told) from error

    def _read_here(self, root: Path, folder: str, name: str) -> bytes:
        if not _CAN_REFUSE_LINKS or name in ("", ".", "..") or "\\" in name or "\0" in name:
            return resolve_inside(root, folder + name).read_bytes()
        try:
            descriptor = os.open(self._folder(root, folder) + name, _FLAGS)
        except OSError as error:
            if error.errno != errno.ELOOP:
                raise
            return resolve_inside(root, folder + name).read_bytes()  # a link may stay inside
        with open(descriptor, "rb", buffering=0) as file:
            return file.read()

    def _folder(self, root: Path, folder: str) -> str:
        if folder not in self._folders:
            checked = resolve_inside(root, folder) if folder else root
            self._folders[folder] = f"{checked}/"
        return self._folders[folder]


class Companions(Generic[SizedValue]):
    """Parsed files beside the images, the last used ones kept.

    read: what makes something with entries of a file. At least one file is kept, and others as long
    as they have no more than CACHED_ENTRIES together.
    """

    def __init__(self, files: StoredFiles, read: Callable[[Path], SizedValue]) -> None:
        self._files, self._read = files, read
        self._values: OrderedDict[tuple[str, str], SizedValue] = OrderedDict()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_values": OrderedDict()}

    def get(self, folder: str, name: str) -> SizedValue:
        key = (folder, name)
        if key not in self._values:
            self._values[key] = self._files.parse(folder, name, self._read)
            held = sum(map(len, self._values.values()))
            while held > CACHED_ENTRIES and len(self._values) > 1:
                held -= len(self._values.popitem(last=False)[1])
        self._values.move_to_end(key)
        return self._values[key]


def damaged(file: str, what: str) -> OutputError:
    """The error of a file that holds something else than it should."""
    return OutputError(
        f"{file} is damaged: {what}. Delete it and run the job again, which renders it anew"
    )


def _unreadable(file: str, why: str) -> OutputError:
    return OutputError(
        f"{file} cannot be read ({why}), though the manifest lists it; run the job again: it "
        f"renders what is missing"
    )
