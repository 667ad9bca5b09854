"""Reading an output's files for its report: what cannot be read is noted, and does not stop it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import pyarrow as pa

from augment.errors import OutputError
from augment.jobs.store import StoredFileMissing
from augment.jobs.tables import read_table

MAX_FILE = 1 << 28  # bytes; a report needs no larger one
MAX_PROBLEMS = 50  # that the page lists


class Readable(Protocol):
    """What a report asks of a store (`augment.jobs.store`)."""

    @property
    def uri(self) -> str: ...

    def read(self, path: str) -> bytes: ...


class Sized(Protocol):
    """A file in a store's listing."""

    @property
    def size(self) -> int: ...


class ReportFiles:
    """The files of one output. listing: of the whole store.

    problems: why files could not be read, by path. unlisted: how many more there are.
    """

    def __init__(self, store: Readable, listing: Mapping[str, Sized]) -> None:
        self._store, self._listing = store, listing
        self.problems: dict[str, str] = {}
        self.unlisted = 0

    def read(self, path: str) -> bytes | None:
        """The file's content; None, and noted, where there is none that can be used."""
        stored = self._listing.get(path)
        if stored is not None and stored.size > MAX_FILE:
            return self.note(path, f"larger than {MAX_FILE >> 20} MiB: not looked at")
        try:
            return self._store.read(path)
        except StoredFileMissing:
            return self.note(path, "missing")
        except OutputError as error:
            # A page that is handed on says nothing of the machine that it was made on.
            return self.note(path, str(error).replace(self._store.uri, "OUT"))

    def read_columns(self, path: str, wanted: tuple[str, ...]) -> pa.Table | None:
        """Those of `wanted` that a Parquet file has; None, and noted, where it is none."""
        data = self.read(path)
        if data is None:
            return None
        try:
            return read_table(data, path, wanted)
        except OutputError as error:
            return self.note(path, str(error))

    def note(self, path: str, why: str) -> None:
        """Remember that a file is damaged."""
        if path in self.problems:
            return
        if len(self.problems) < MAX_PROBLEMS:
            self.problems[path] = why
        else:
            self.unlisted += 1
