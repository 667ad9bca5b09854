"""Gaussians in PlayCanvas's streamed SOG, version 1: a folder of `lod-meta.json` and SOG chunks.

A tree divides the scene; each of its leaves names, for each level of detail it has, a run of
Gaussians in one of the chunks. Level 0 is the finest. All leaves of one level together are the
scene. An environment, such as a dome of sky, stands beside the levels. Facts by
github.com/playcanvas/splat-transform, guides/STREAMED_SOG_FORMAT.md (MIT); its chunks are folders,
and chunks in one .sog each are read as well.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Annotated

import torch
from pydantic import BaseModel, ConfigDict, Field

from augment.errors import SceneError
from augment.files.limits import check_memory, read_json
from augment.files.ply import SplatFile
from augment.files.scene_file import checked
from augment.files.sog import META, SUFFIX, read_stored_sog
from augment.scene import SH_COUNTS, Gaussians, check_gaussians

LOD_META = "lod-meta.json"
_MAX_META_BYTES = 128 << 20  # a tree of a hundred thousand leaves has about 20 MB
_VERSIONS = (None, 1)  # files before the first version say none
_MAX_LEVELS = 64

Count = Annotated[int, Field(ge=0)]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", strict=True)


class _Run(_Part):
    """The Gaussians offset to offset + count of a chunk. file: its index in `filenames`."""

    file: Count
    offset: Count
    count: Count


class _Meta(_Part):
    lodLevels: int = Field(ge=1, le=_MAX_LEVELS)
    filenames: Annotated[
        list[str], Field(fail_fast=True)
    ]  # a list of millions has millions of errors
    environment: str | None = None


def read_streamed_sog(path: str | Path, level: int = 0) -> SplatFile:
    """Read one level of detail of the scene that a `lod-meta.json` describes; its environment is
    left out, and said.

    Args:
        path: the `lod-meta.json`.
        level: 0 is the finest.

    Raises:
        SceneError: no such level, a chunk that is missing or damaged, or another version.
    """
    path = Path(path)
    try:
        content = read_json(path, _MAX_META_BYTES)
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error.strerror or error}") from error
    if content.get("version") not in _VERSIONS:
        raise SceneError(
            f"{path}: version 1 of streamed SOG is read; got {content['version']!r:.20}. Save it "
            f"anew with SplatTransform"
        )
    meta = checked(_Meta, content, str(path))
    if not 0 <= level < meta.lodLevels:
        raise SceneError(
            f"{path} has no level {level}; it has 0, the finest, to {meta.lodLevels - 1}"
        )
    runs = sorted(
        _runs(content.get("tree"), level, str(path)), key=lambda run: (run.file, run.offset)
    )
    runs = [run for run in runs if run.count > 0]
    if not runs:
        raise SceneError(f"{path}: its tree names no Gaussians of level {level}")
    raw, notes = _gathered(path, meta, runs, _check_runs(path, meta, runs))
    gaussians, problems = check_gaussians(raw, where=f"{path}, level {level}")
    said = [_levels_sentence(path, meta, level), *problems]
    if meta.environment:
        said.append(
            f"{path}: its environment, {meta.environment[:200]}, such as a dome of sky, is left "
            f"out; it opens by itself, as gaussians:{path.parent / meta.environment[:200]}"
        )
    return SplatFile(gaussians, notes=notes, problems=tuple(said))


def _levels_sentence(path: Path, meta: _Meta, level: int) -> str:
    which = "the finest, " if level == 0 else ""
    return (
        f"{path}: {which}level {level} of {meta.lodLevels} is taken; lod=N takes another, "
        f"0 to {meta.lodLevels - 1}"
    )


def _runs(tree: object, level: int, where: str) -> Iterator[_Run]:
    """The runs of all leaves that have the level."""
    waiting = [tree]
    while waiting:
        node = waiting.pop()
        if not isinstance(node, dict):
            raise SceneError(f"{where}: a node of its tree must be an object; got {node!r:.60}")
        children, lods = node.get("children"), node.get("lods")
        if isinstance(children, list) and lods is None:
            waiting += children
        elif isinstance(lods, dict) and not children:
            if (run := lods.get(str(level))) is not None:
                yield checked(_Run, run, f"{where}, lods of a leaf")
        else:
            raise SceneError(
                f"{where}: a node of its tree must have either children, a list, or lods, an "
                f"object; it has {', '.join(map(repr, list(node)[:8])) or 'nothing'}"
            )


def _check_runs(path: Path, meta: _Meta, runs: list[_Run]) -> int:
    """Refuse runs of chunks that are not named, that overlap, or that no chunk could hold. Returns
    the bytes of all chunks.
    """
    if runs[-1].file >= len(meta.filenames):
        raise SceneError(
            f"{path}: a leaf names chunk {runs[-1].file} of {len(meta.filenames)} filenames"
        )
    for before, run in itertools.pairwise(runs):
        if before.file == run.file and before.offset + before.count > run.offset:
            raise SceneError(
                f"{path}: two leaves share Gaussians of {meta.filenames[run.file]!r:.200}: "
                f"{before.offset} to {before.offset + before.count} and from {run.offset} on"
            )
    numbers = sorted({run.file for run in runs})
    chunks = {_chunk(path, meta.filenames[number]).resolve() for number in numbers}
    if len(chunks) < len(numbers):
        raise SceneError(f"{path} names a chunk twice: its {len(numbers)} are {len(chunks)} files")
    size = sum(map(_size_of, chunks))
    check_memory(str(path), sum(run.count for run in runs), functions=1, size=size)
    return size


def _gathered(
    path: Path, meta: _Meta, runs: list[_Run], size: int
) -> tuple[Gaussians, dict[str, str]]:
    """The Gaussians of the runs, chunk after chunk, and what the first chunk says of up and unit;
    colours of a lower degree are filled up with zeros. size: bytes of all chunks.
    """
    by_file: dict[int, list[_Run]] = {}
    for run in runs:
        by_file.setdefault(run.file, []).append(run)
    parts, notes = list[Gaussians](), dict[str, str]()
    for number, held in by_file.items():
        file = _chunk(path, meta.filenames[number])
        stored, said = read_stored_sog(file)
        if parts and said != notes:
            raise SceneError(f"{file} says {said} of up and unit; chunks before it say {notes}")
        notes = said
        end = held[-1].offset + held[-1].count
        if end > len(stored):
            raise SceneError(
                f"{path} names Gaussians up to {end} of {file}, which holds {len(stored)}"
            )
        if sum(run.count for run in held) < len(stored):
            kept = [torch.arange(run.offset, run.offset + run.count) for run in held]
            stored = stored.select(torch.cat(kept))
        parts.append(stored)
        rows, functions = sum(map(len, parts)), max(part.sh.shape[1] for part in parts)
        check_memory(str(path), rows, functions=functions, size=size)
    bands = max(part.sh.shape[1] for part in parts)
    assert bands in SH_COUNTS
    sh = [torch.nn.functional.pad(p.sh, (0, 0, 0, bands - p.sh.shape[1])) for p in parts]
    names = ("means", "quats", "scales", "opacities")
    columns = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
    return Gaussians(**columns, sh=torch.cat(sh)), notes


def _chunk(path: Path, name: str) -> Path:
    """The meta.json or .sog of a chunk, which must lie in the folder."""
    parts = PurePosixPath(name)
    is_plain = not parts.is_absolute() and ".." not in parts.parts and not set(name) & set("\\\0:")
    if not is_plain or not (parts.name == META or parts.suffix.lower() == SUFFIX):
        raise SceneError(
            f"{path} names the chunk {name!r:.200}; it must be a {META} or {SUFFIX} in the same "
            f"folder or below"
        )
    file = path.parent / name
    if not file.resolve().is_relative_to(path.parent.resolve()):
        raise SceneError(f"{file} is a link out of its folder; put the file itself there")
    if not file.is_file():
        raise SceneError(f"{path} names the chunk {name}, which is not there; copy it again")
    return file


def _size_of(chunk: Path) -> int:
    """Bytes of a chunk: of the .sog, or of the files beside its meta.json."""
    if chunk.name != META:
        return chunk.stat().st_size
    return sum(file.stat().st_size for file in chunk.parent.iterdir() if file.is_file())
