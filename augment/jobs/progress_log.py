"""What a job has finished so far, on the disk: one journal per variant until the manifest has it.

`.climategs/journal/<scene>/<variant>.jsonl` starts with the variant's identity and gains a line
for every image once all its files are in place. A line counts only with its line break, so a job
killed while writing one loses that line and nothing else. When a job ends, its lines have become
rows of the manifest and the journal goes.
"""

from __future__ import annotations

import json
import os
import threading
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from augment.errors import OutputError
from augment.jobs.atomic import flush_folder, output_error, write_atomic
from augment.jobs.layout import STATE_FOLDER, folder_name


@dataclass(frozen=True)
class Identity:
    """What must agree for two runs to write into the same variant folder."""

    source: str
    recipe_hash: str
    trajectory: str
    version: str
    backend: str

    @staticmethod
    def of_row(row: dict[str, Any]) -> Identity:
        return Identity(**{name: row[name] for name in Identity.__dataclass_fields__})

    def check(self, found: Identity, where: str) -> None:
        """Raise OutputError where the folder was written by something else."""
        names = {
            "source": "scene",
            "recipe_hash": "recipe hash",
            "trajectory": "camera path",
            "version": "package version",
            "backend": "backend",
        }
        mine, theirs = asdict(self), asdict(found)
        different = [
            f"{label} there {theirs[name]!r}, here {mine[name]!r}"
            for name, label in names.items()
            if mine[name] != theirs[name]
        ]
        if different:
            raise OutputError(
                f"{where} already holds images of another kind: {'; '.join(different)}. Give the "
                f"recipe another name, choose another output folder, or ask for the variant to be "
                f"overwritten (render --overwrite, overwrite=True)"
            )


class ProgressLog:
    """The journal of one variant. `append` may be called from several threads."""

    def __init__(self, out_dir: Path, scene: str, variant: str) -> None:
        folder = out_dir / STATE_FOLDER / "journal" / folder_name(scene)
        self.path = folder / f"{folder_name(variant)}.jsonl"
        self._file: int | None = None
        self._lock = threading.Lock()

    def load(self) -> tuple[Identity | None, list[dict[str, Any]]]:
        """The identity and rows in the journal; (None, []) where there is none."""
        try:
            lines = self.path.read_bytes().split(b"\n")[:-1]  # the last part has no line break
        except FileNotFoundError:
            return None, []
        try:
            identity, *rows = [json.loads(line) for line in lines]
            return Identity(**identity), rows
        except (ValueError, TypeError, RecursionError) as error:
            raise OutputError(
                f"{self.path} is damaged: {error}. Delete it; what it lists is rendered again"
            ) from error

    def begin(self, identity: Identity) -> None:
        """Open for appending; starts with the identity, or goes on after the last whole line."""
        try:
            whole = self.path.read_bytes() if self.path.exists() else b""
            whole = whole[: whole.rfind(b"\n") + 1]
            write_atomic(self.path, whole or _line(asdict(identity)))
            self._file = os.open(self.path, os.O_WRONLY | os.O_APPEND)
        except OSError as error:
            raise output_error(self.path, error) from error

    def append(self, row: dict[str, Any]) -> None:
        """Add a finished image. Returns when the line is on the disk."""
        assert self._file is not None, "begin() comes first"
        with self._lock:
            length = os.fstat(self._file).st_size
            try:
                _write_all(self._file, _line(row))
                os.fsync(self._file)
            except OSError as error:
                os.ftruncate(self._file, length)  # a later line must not join half of this one
                raise output_error(self.path, error) from error

    def close(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def remove(self) -> None:
        """Delete the journal and the folders it leaves empty."""
        self.close()
        try:
            self.path.unlink(missing_ok=True)
            for folder in (self.path.parent, self.path.parent.parent):
                if folder.is_dir() and not any(folder.iterdir()):
                    folder.rmdir()
                    flush_folder(folder.parent)
        except OSError as error:
            raise output_error(self.path, error) from error


def logged_variants(out_dir: Path) -> list[str]:
    """Folders (`<scene>/<variant>`) of the variants that some job has begun and not ended."""
    root = out_dir / STATE_FOLDER / "journal"
    return sorted(str(p.relative_to(root).with_suffix("")) for p in root.glob("*/*.jsonl"))


def _write_all(descriptor: int, data: bytes) -> None:
    while data:
        data = data[os.write(descriptor, data) :]


def _line(value: dict[str, Any]) -> bytes:
    return json.dumps(value, separators=(",", ":")).encode() + b"\n"
