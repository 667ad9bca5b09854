"""One file or link of a dataset's copy: put in place whole, and never through what is there.

A file is linked (one inode with the original) or copied, under a temporary name where another one
has the place; then the name is moved. So the original of a link that was there is never written.
"""

from __future__ import annotations

import errno
import os
import re
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from augment.errors import AdapterError, OutputError
from augment.jobs.atomic import (
    output_error,
    refusals_of,
    replaced_file,
    temporary_beside,
    temporary_names,
)

# ---- The files of a dataset, as a copy of it in another place has to have them -------------------
# A dataset's own entries (`samples`, `camera` ...) may be links to other disks: what they lead to
# belongs to it. Links below them must stay within the dataset, and stay links in the copy; others
# would make the copy reach files that nobody meant.


@dataclass(frozen=True)
class SourceTree:
    """A dataset in a folder. root: absolute; its name is the copy's name too. uri: what it was
    opened by. images, sweeps: regular expressions that the paths of its camera images and LiDAR
    sweeps, relative to root, match in full. entries: what in root belongs to it; None for all.
    """

    uri: str
    root: Path
    images: str
    entries: tuple[str, ...] | None = None
    sweeps: str = r"(?!)"  # none

    @cached_property
    def bases(self) -> tuple[tuple[str, str], ...]:
        """Real paths of the folders and files that make up the dataset, and where each belongs
        relative to root: root itself, then what its own entries lead to elsewhere.
        """
        real_root = os.path.realpath(self.root)
        try:
            names = sorted(os.listdir(real_root))
        except OSError as error:
            raise AdapterError(f"{self.root} cannot be listed: {error.strerror}") from error
        if not self.root.name:
            raise AdapterError(f"{self.root} has no name; a dataset must lie in a folder")
        found = [(real_root, "")]
        for name in names:
            path = os.path.join(real_root, name)
            if not self._has(name) or not os.path.islink(path):
                continue
            real = os.path.realpath(path)
            if is_within(real, real_root):
                continue
            if not os.path.exists(real):
                raise AdapterError(
                    f"{path} is a link to {real}, which does not exist; put it there, or delete "
                    f"the link"
                )
            if is_within(real_root, real):
                raise AdapterError(
                    f"{path} is a link to {real}, which holds the dataset itself; delete the link"
                )
            found.append((real, name))
        return tuple(found)

    def relative(self, path: str | Path) -> str | None:
        """Where a file or folder belongs relative to root, links followed; None outside."""
        real = os.path.realpath(path)
        for base, name in self.bases:
            if is_within(real, base):
                inner = os.path.relpath(real, base)
                parts = [part for part in (name, inner) if part not in ("", ".")]
                within = "/".join(parts)
                return within if not within or self._has(within.split("/")[0]) else None
        return None

    def is_image(self, relative: str) -> bool:
        """Whether this is the path of a camera image."""
        return re.fullmatch(self.images, relative) is not None

    def is_sweep(self, relative: str) -> bool:
        """Whether this is the path of a LiDAR sweep."""
        return re.fullmatch(self.sweeps, relative) is not None

    def _has(self, name: str) -> bool:
        return self.entries is None or name in self.entries


@dataclass(frozen=True)
class SourceFile:
    """relative: to the dataset's root. path: where its bytes are. facts: as os.lstat of that."""

    relative: str
    path: str
    facts: os.stat_result


@dataclass(frozen=True)
class SourceFolder:
    """What is directly in one folder. relative: to the root, "" for itself. links: relative path
    and what the link says, which leads to another part of the dataset.
    """

    relative: str
    files: tuple[SourceFile, ...]
    folders: tuple[str, ...]
    links: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Survey:
    """How much a dataset is. images: camera images among the files."""

    files: int
    size: int
    images: int


def survey(tree: SourceTree) -> Survey:
    """Look at all that belongs to a dataset, reading no file."""
    files = size = images = 0
    for folder in walk(tree):
        files += len(folder.files)
        size += sum(file.facts.st_size for file in folder.files)
        images += sum(1 for file in folder.files if tree.is_image(file.relative))
    return Survey(files, size, images)


def walk(tree: SourceTree) -> Iterator[SourceFolder]:
    """The folders of a dataset, each before those in it, in order of name."""
    elsewhere = {name: real for real, name in tree.bases if name}
    waiting = [("", os.path.realpath(tree.root))]
    while waiting:
        relative, path = waiting.pop()
        folder, inner = _read_folder(tree, relative, path, {} if relative else elsewhere)
        yield folder
        waiting += reversed(inner)


def is_within(path: str, folder: str) -> bool:
    """Whether a real path is a folder's or of something in it."""
    return path == folder or path.startswith(folder.rstrip("/") + "/")


def _read_folder(
    tree: SourceTree, relative: str, path: str, elsewhere: dict[str, str]
) -> tuple[SourceFolder, list[tuple[str, str]]]:
    """The folder, and the relative and real paths of those in it. elsewhere: by name."""
    files, inner, links = [], [], []
    try:
        with os.scandir(path) as entries:
            found = sorted(entries, key=lambda entry: entry.name)
        for entry in found:
            if not relative and tree.entries is not None and entry.name not in tree.entries:
                continue
            within = f"{relative}/{entry.name}" if relative else entry.name
            real = elsewhere.get(entry.name, entry.path)
            facts = os.lstat(real) if entry.name in elsewhere else entry.stat(follow_symlinks=False)
            if stat.S_ISREG(facts.st_mode):
                files.append(SourceFile(within, real, facts))
            elif stat.S_ISDIR(facts.st_mode):
                inner.append((within, real))
            elif stat.S_ISLNK(facts.st_mode):
                links.append((within, _link_text(tree, within, real)))
            else:
                raise AdapterError(
                    f"{entry.path} is neither a file nor a folder nor a link; a dataset's copy "
                    f"cannot have it, move it elsewhere"
                )
    except OSError as error:
        raise AdapterError(f"{error.filename or path} cannot be read: {error.strerror}") from error
    folders = tuple(within for within, _ in inner)
    return SourceFolder(relative, tuple(files), folders, tuple(links)), inner


def _link_text(tree: SourceTree, within: str, path: str) -> str:
    """What the copy's link has to say to lead to the same part of the dataset's copy."""
    target = tree.relative(path)
    if target is None:
        raise AdapterError(
            f"{path} is a link to {os.path.realpath(path)}, outside {tree.root}. A copy of the "
            f"dataset can have links within it, and {tree.root}'s own entries may be links to "
            f"other places: put the file itself there, or the link higher up"
        )
    return os.path.relpath(target or ".", os.path.dirname(within) or ".")


# ---- Files and links put in place ----------------------------------------------------------------

LINKED, COPIED = "linked", "copied"
# Another disk, another user's file, too many links to it, a file system without hard links.
_CANNOT_LINK = {errno.EXDEV, errno.EPERM, errno.EMLINK}
_CANNOT_LINK |= {errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS}


def found_as(target: str, original: os.stat_result) -> str | None:
    """How the original is in place: LINKED, COPIED (same size and time), or None: it is not."""
    facts = _facts(target)
    if facts is None or not stat.S_ISREG(facts.st_mode):
        return None
    if (facts.st_dev, facts.st_ino) == (original.st_dev, original.st_ino):
        return LINKED
    same = (facts.st_size, facts.st_mtime_ns) == (original.st_size, original.st_mtime_ns)
    return COPIED if same else None


def link_file(original: str, target: str) -> bool:
    """Give the original a second name; False where the system cannot, and nothing has changed."""
    try:
        try:
            os.link(original, target, follow_symlinks=False)
        except FileExistsError:
            temporary = temporary_beside(Path(target))
            os.link(original, temporary, follow_symlinks=False)
            _move(temporary, target)
    except OSError as error:
        if error.errno in _CANNOT_LINK:
            return False
        raise output_error(Path(target), error) from error
    return True


def copy_file(original: str, target: str) -> None:
    """Copy bytes and time of change."""
    with replaced_file(Path(target), clear=False, flush=False) as file:
        source = os.open(original, os.O_RDONLY)
        try:
            at = 0
            while sent := os.sendfile(file.fileno(), source, at, 1 << 26):
                at += sent
            facts = os.fstat(source)
            os.utime(file.fileno(), ns=(facts.st_mtime_ns, facts.st_mtime_ns))
        finally:
            os.close(source)


def write_file(data: bytes, target: str, mtime_ns: int) -> None:
    """Write a file with that time of change."""
    with replaced_file(Path(target), clear=False, flush=False) as file:
        file.write(data)
        file.flush()
        os.utime(file.fileno(), ns=(mtime_ns, mtime_ns))


def put_link(text: str, target: str) -> bool:
    """A symbolic link that says `text`; False where it is there already."""
    with refusals_of(Path(target)):
        if os.path.islink(target) and os.readlink(target) == text:
            return False
        temporary = temporary_beside(Path(target))
        os.symlink(text, temporary)
        _move(temporary, target)
    return True


def own_folder(folder: str) -> bool:
    """Make sure that a folder of the copy is a real one; True where it had to be made."""
    facts = _facts(folder)
    if facts is None:
        with refusals_of(Path(folder)):
            os.mkdir(folder)
        return True
    if not stat.S_ISDIR(facts.st_mode):
        kind = "a link" if stat.S_ISLNK(facts.st_mode) else "a file"
        raise OutputError(
            f"{folder} is {kind}; the copy of the dataset needs a folder of its own there, and "
            f"writes through no link. Delete it, or choose another output folder"
        )
    return False


def others_in(folder: str, expected: set[str]) -> list[str]:
    """Names in a folder of the copy that are not expected; what a killed run left is deleted."""
    with refusals_of(Path(folder)):
        found = set(os.listdir(folder)) - expected
        left = set(temporary_names(found))
        for name in left:
            os.unlink(os.path.join(folder, name))
    return sorted(found - left)


def _facts(path: str) -> os.stat_result | None:
    try:
        return os.lstat(path)
    except FileNotFoundError:
        return None


def _move(temporary: Path, target: str) -> None:
    try:
        os.replace(temporary, target)
    finally:
        # Renaming does nothing where both names are links of one file already.
        temporary.unlink(missing_ok=True)
