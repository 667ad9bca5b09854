"""List of the files that were put into a copy of a dataset, so that edited files are not replaced.

In: facts of each file as it is put in place. Out: whether a file of the copy is still the one that
was put there. Any other file has been edited, or was there before; `mirror` does not replace it.
The list lies beside the copy, one JSON array on a line. Each line is written before its file is put
in place, so that the files of a killed run are in the list too.
"""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import BinaryIO, NamedTuple

from pydantic import TypeAdapter

from augment.output.atomic import raise_output_error, write_atomic
from augment.output.layout import parse_errors_as_output_errors
from recipes.files import open_file

# Size of a file whose contents are encoded after its line is written.
ANY_SIZE = -1


class PlacedFile(NamedTuple):
    """A file of the copy as it was put there."""

    size: int
    """Size in bytes; ANY_SIZE where contents are encoded after the line is written."""
    mtime_ns: int
    """Time at which the contents changed, nanoseconds since 1970."""
    source_ctime_ns: int = 0
    """Time at which the source file or its facts changed, which no program can set; 0 where it is
    not find.
    """
    source_digest: str = ""
    """Digest of the source file's contents, where ours were made with them; empty otherwise."""

    def is_of(self, facts: os.stat_result) -> bool:
        """Return True for a file of this size and time."""
        return self.size in (ANY_SIZE, facts.st_size) and self.mtime_ns == facts.st_mtime_ns


_LINE = TypeAdapter(tuple[str, PlacedFile])


class PlacedFiles:
    """The list of one copy.

    Several lines may have one name, until `finish` leaves the last one.

    Attributes:
        path: File of the list.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: BinaryIO | None = None
        self._old_lines: dict[str, list[PlacedFile]] = {}
        self._new_lines: dict[str, PlacedFile] = {}
        self.exists = path.is_file()
        self._file_text = b""
        self._has_new_lines = False
        if not self.exists:
            return
        with raise_output_error(path), open_file(path) as file:
            self._file_text = file.read()
        advice = "Delete it and run again; edits in the copy are not noticed then"
        with parse_errors_as_output_errors(str(path), advice):
            # A line without its end was being written when the power went.
            for line in self._file_text[: self._file_text.rfind(b"\n") + 1].splitlines():
                name, placed_file = _LINE.validate_json(line)
                self._old_lines.setdefault(name, []).append(placed_file)

    def find(self, name: str, facts: os.stat_result) -> PlacedFile | None:
        """Return the latest line that fits the file in the copy; None where no line fits.

        Args:
            name: Path relative to the dataset's folder.
            facts: Facts of the file in the copy.
        """
        lines = self._old_lines.get(name, [])
        return next(
            (placed_file for placed_file in reversed(lines) if placed_file.is_of(facts)), None
        )

    def adopt(self, files: dict[str, PlacedFile]) -> None:
        """Begin the list of a copy without a list, with the files that are in the copy."""
        self._old_lines = {name: [placed_file] for name, placed_file in files.items()}
        self._file_text = _file_text(files)
        write_atomic(self._path, self._file_text)

    def begin(self) -> None:
        """Open the list for further lines."""
        with raise_output_error(self._path):
            if self._file_text and not self._file_text.endswith(b"\n"):
                self._file_text = self._file_text[: self._file_text.rfind(b"\n") + 1]
                write_atomic(self._path, self._file_text)
            flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW
            self._file = os.fdopen(os.open(self._path, flags, 0o666), "ab", buffering=0)

    def add(self, name: str, placed_file: PlacedFile) -> None:
        """Add the line of a file that is about to be put in place."""
        assert self._file is not None, "begin() comes before"
        self._new_lines[name] = placed_file
        with raise_output_error(self._path):
            self._file.write(_file_text({name: placed_file}))
        self._has_new_lines = True

    def keep(self, name: str, placed_file: PlacedFile) -> None:
        """Keep the line of a file that is in place already."""
        self._new_lines[name] = placed_file

    def close(self) -> None:
        """Close the list as it is."""
        if self._file is not None:
            self._file.close()

    def finish(self) -> None:
        """Leave one line for each file, including files that the source no longer has."""
        text = _file_text(
            {name: lines[-1] for name, lines in self._old_lines.items()} | self._new_lines
        )
        if self._has_new_lines or text != self._file_text:
            write_atomic(self._path, text)


def digest_of(path: str) -> str:
    """Return the SHA-256 of a file's contents, hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _file_text(files: dict[str, PlacedFile]) -> bytes:
    lines = [json.dumps([name, list(files[name])]) + "\n" for name in sorted(files)]
    return "".join(lines).encode()
