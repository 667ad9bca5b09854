"""Scenes of a job as its file names them: patterns taken apart, relative paths made absolute."""

from __future__ import annotations

import contextlib
import fnmatch
import glob
import itertools
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from adapters.base import recognise
from adapters.uri import SCHEMES, format_uri, parse_uri
from augment.errors import AdapterError
from recipes.job import JobScene

MAX_LOOKED_AT = 200_000  # files and folders, for one pattern: a second or two


def scenes_of(entries: Iterable[JobScene], folder: Path) -> list[JobScene]:
    """Every scene once, in the order of the job; those of a pattern in the order of their paths.

    An entry whose path has `*`, `**` or `[...]` stands for all that match, as in a shell (a `?`
    begins the query); each keeps the entry's query, frames, cameras and recipes. folder: where
    relative paths start.

    Raises:
        AdapterError: a pattern matches nothing or too much is below it to be looked through, a
            scene is named twice, or a pattern has a name.
    """
    scenes: dict[str, JobScene] = {}
    for entry in entries:
        found = _expanded(entry, folder)
        if entry.name is not None and len(found) > 1:
            raise AdapterError(
                f"{entry.uri!r} stands for {len(found)} scenes, which cannot all be called "
                f"{entry.name!r}; leave the name out, or list them one by one"
            )
        for scene in found:
            if scene.uri in scenes:
                raise AdapterError(
                    f"the job names the scene {scene.uri!r} twice (by {entry.uri!r}); give its "
                    f"frames, cameras and recipes in one entry"
                )
            scenes[scene.uri] = scene
    return list(scenes.values())


def _expanded(entry: JobScene, folder: Path) -> list[JobScene]:
    scheme, path, query = parse_uri(entry.uri)
    known = SCHEMES.get(scheme) if scheme is not None else None
    query = {key: _from(folder, value) for key, value in query.items()}
    if scheme is not None and known is None:
        return [entry]  # refused where it is opened
    if scheme is not None and known is not None and path in known.builtin:
        return [entry.model_copy(update={"uri": format_uri(scheme, path, query)})]
    whole = folder.absolute() / path
    matches = [str(whole)]
    if glob.has_magic(path) and not whole.exists():
        # The job's own folder may be called [x] too.
        top, parts = (
            (Path("/"), Path(path).parts[1:])
            if Path(path).is_absolute()
            else (folder.absolute(), Path(path).parts)
        )
        matches = _matches(top, parts, entry.uri)
    if not matches:
        raise AdapterError(f"{entry.uri!r}: nothing matches {whole}")
    return [entry.model_copy(update={"uri": _uri(scheme, match, query)}) for match in matches]


def _matches(top: Path, parts: tuple[str, ...], what: str) -> list[str]:
    """Paths that match, in order. parts: of the pattern below `top`. As glob.glob, but that `**`
    follows no links, which may lead round in circles, and that there is an end to it.
    """
    looked_at = itertools.count()

    def names(folder: str) -> Iterator[os.DirEntry[str]]:
        with contextlib.suppress(OSError), os.scandir(folder) as entries:  # a file, another user's
            for entry in entries:
                if next(looked_at) >= MAX_LOOKED_AT:
                    raise AdapterError(
                        f"{what!r}: looked at {MAX_LOOKED_AT} files and folders and saw no end; "
                        f"name more of the path, or fewer levels (**)"
                    )
                yield entry

    def below(path: str, parts: tuple[str, ...]) -> Iterator[str]:
        if not parts:
            yield path
        elif parts[0] == "**":
            yield from below(path, parts[1:])
            for entry in names(path):
                if entry.name.startswith("."):
                    continue
                if entry.is_dir(follow_symlinks=False):
                    yield from below(entry.path, parts)
                elif len(parts) == 1:
                    yield entry.path
        elif glob.has_magic(parts[0]):
            for entry in names(path):
                is_shown = parts[0].startswith(".") or not entry.name.startswith(".")
                if is_shown and fnmatch.fnmatchcase(entry.name, parts[0]):
                    yield from below(entry.path, parts[1:])
        elif os.path.lexists(inner := os.path.join(path, parts[0])):
            yield from below(inner, parts[1:])

    return sorted(set(below(str(top), parts)))


def _from(folder: Path, value: str) -> str:
    """A value of the query that names a file beside the job, as an absolute path."""
    beside = folder.absolute() / value
    names_a_file = ("/" in value or "." in value) and beside.exists()
    return str(beside) if names_a_file else value


def _uri(scheme: str | None, path: str, query: dict[str, str]) -> str:
    if scheme is None and query:
        scheme = recognise(Path(path))
    return path if scheme is None else format_uri(scheme, path, query)
