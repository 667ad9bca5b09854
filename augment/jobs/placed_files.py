"""What the files of a dataset's copy were when they were put there, so that nobody's work is lost.

A file that is no longer what was put there has been edited, or was there before: it is not
replaced. The list lies beside the copy, a JSON array a line; each line is written before its file
is put in place, so that a killed run's files are known too.
"""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import BinaryIO, NamedTuple

from pydantic import TypeAdapter

from augment.jobs.atomic import refusals_of, write_atomic
from augment.jobs.layout import reading_back
from recipes.files import open_file

ANY_SIZE = -1


class PlacedFile(NamedTuple):
    """A file of the copy as it was put there.

    size: bytes; ANY_SIZE where contents are encoded after the line is written.
    mtime_ns: time of change of its contents.
    source_ctime_ns: time of change of the source file and its facts, which no program can set; 0
        where that is not known.
    source_digest: of the source file's contents, where ours were made with them; else empty.
    """

    size: int
    mtime_ns: int
    source_ctime_ns: int = 0
    source_digest: str = ""

    def is_of(self, facts: os.stat_result) -> bool:
        """Return True for a file of this size and time."""
        return self.size in (ANY_SIZE, facts.st_size) and self.mtime_ns == facts.st_mtime_ns


_LINE = TypeAdapter(tuple[str, PlacedFile])


class PlacedFiles:
    """The list of one copy. path: its file. Lines of one name add up until `finish`."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: BinaryIO | None = None
        self._earlier: dict[str, list[PlacedFile]] = {}
        self._now: dict[str, PlacedFile] = {}
        self.is_there = path.is_file()
        self._text = b""
        self._is_longer = False
        if not self.is_there:
            return
        with refusals_of(path), open_file(path) as file:
            self._text = file.read()
        advice = "Delete it and run again; edits in the copy are not noticed then"
        with reading_back(str(path), advice):
            # A line without its end was being written when the power went.
            for line in self._text[: self._text.rfind(b"\n") + 1].splitlines():
                name, placed = _LINE.validate_json(line)
                self._earlier.setdefault(name, []).append(placed)

    def known(self, name: str, facts: os.stat_result) -> PlacedFile | None:
        """The latest line that the file in the copy fits; None where it is not what was put there.

        Args:
            name: path relative to the dataset's folder.
            facts: of the file in the copy.
        """
        lines = self._earlier.get(name, [])
        return next((placed for placed in reversed(lines) if placed.is_of(facts)), None)

    def adopt(self, files: dict[str, PlacedFile]) -> None:
        """Begin the list of a copy that has none with the files that are there."""
        self._earlier = {name: [placed] for name, placed in files.items()}
        self._text = _text(files)
        write_atomic(self._path, self._text)

    def begin(self) -> None:
        """Open the list for further lines."""
        with refusals_of(self._path):
            if self._text and not self._text.endswith(b"\n"):
                self._text = self._text[: self._text.rfind(b"\n") + 1]
                write_atomic(self._path, self._text)
            flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW
            self._file = os.fdopen(os.open(self._path, flags, 0o666), "ab", buffering=0)

    def add(self, name: str, placed: PlacedFile) -> None:
        """Add the line of a file that is about to be put in place."""
        assert self._file is not None, "begin() comes before"
        self._now[name] = placed
        with refusals_of(self._path):
            self._file.write(_text({name: placed}))
        self._is_longer = True

    def keep(self, name: str, placed: PlacedFile) -> None:
        """Go on with the line of a file that is in place already."""
        self._now[name] = placed

    def close(self) -> None:
        """Close the list as it is."""
        if self._file is not None:
            self._file.close()

    def finish(self) -> None:
        """Leave one line of each file, those included that the source does not have any more."""
        text = _text({name: lines[-1] for name, lines in self._earlier.items()} | self._now)
        if self._is_longer or text != self._text:
            write_atomic(self._path, text)


def digest_of(path: str) -> str:
    """Digest of a file's contents."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _text(files: dict[str, PlacedFile]) -> bytes:
    lines = [json.dumps([name, list(files[name])]) + "\n" for name in sorted(files)]
    return "".join(lines).encode()
