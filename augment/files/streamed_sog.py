"""Reads PlayCanvas's streamed SOG, version 1: a folder of `lod-meta.json` and SOG chunks.

A tree divides the scene. Each leaf names, for each of its levels of detail, a run of Gaussians in
one of the chunks. Level 0 is the finest. All leaves of one level together are the scene. An
environment, such as a dome of sky, is stored beside the levels. Source:
github.com/playcanvas/splat-transform, guides/STREAMED_SOG_FORMAT.md (MIT). Its chunks are folders;
chunks in one .sog each are read as well.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Annotated

import torch
from pydantic import BaseModel, ConfigDict, Field

from augment.errors import SceneError
from augment.files.limits import check_memory, read_json_object, validate_model
from augment.files.sog import META, SUFFIX, read_all_sog_gaussians
from augment.files.splat_format import SplatFile, SplatFormat
from augment.scene.scene import NUM_SH_BY_DEGREE, Gaussians, check_gaussians

LOD_META = "lod-meta.json"  # the name of the file that describes the scene
_MAX_META_BYTES = 128 << 20  # bytes of it; a tree of a hundred thousand leaves has about 20 MB
_VERSIONS = (None, 1)  # versions that are read; files before the first version state none
_MAX_LEVELS = 64  # levels of detail

Count = Annotated[int, Field(ge=0)]


class _Part(BaseModel):
    """Base of the JSON objects."""

    model_config = ConfigDict(frozen=True, extra="ignore", strict=True)


class _Run(_Part):
    """A run of Gaussians in a chunk."""

    file: Count  # the chunk's index in `filenames`
    offset: Count  # the first Gaussian
    count: Count  # how many follow


class _Meta(_Part):
    """The content of lod-meta.json without its tree."""

    lodLevels: int = Field(ge=1, le=_MAX_LEVELS)
    filenames: Annotated[
        list[str], Field(fail_fast=True)
    ]  # a list of millions has millions of errors
    environment: str | None = None


def read_streamed_sog(path: str | Path, level: int = 0) -> SplatFile:
    """Read one level of detail of the scene that a `lod-meta.json` describes.

    Its environment is left out; a problem reports that.

    Args:
        path: the `lod-meta.json`.
        level: 0 is the finest.

    Raises:
        SceneError: no such level, a chunk that is missing or damaged, or another version.
    """
    path = Path(path)
    try:
        content = read_json_object(path, _MAX_META_BYTES)
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error.strerror or error}") from error
    if content.get("version") not in _VERSIONS:
        raise SceneError(
            f"{path}: version 1 of streamed SOG is read; got {content['version']!r:.20}. Save it "
            f"anew with SplatTransform"
        )
    meta = validate_model(_Meta, content, str(path))
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
    all_gaussians, notes = _gather_gaussians(path, meta, runs, _check_runs(path, meta, runs))
    gaussians, problems = check_gaussians(all_gaussians, where=f"{path}, level {level}")
    sentences = [_levels_sentence(path, meta, level), *problems]
    if meta.environment:
        sentences.append(
            f"{path}: its environment, {meta.environment[:200]}, such as a dome of sky, is left "
            f"out; it opens by itself, as gaussians:{path.parent / meta.environment[:200]}"
        )
    return SplatFile(gaussians, notes=notes, problems=tuple(sentences))


def _levels_sentence(path: Path, meta: _Meta, level: int) -> str:
    """Return the sentence that says which level was read."""
    qualifier = "the finest, " if level == 0 else ""
    return (
        f"{path}: {qualifier}level {level} of {meta.lodLevels} is taken; lod=N takes another, "
        f"0 to {meta.lodLevels - 1}"
    )


def _runs(tree: object, level: int, where: str) -> Iterator[_Run]:
    """Yield the runs of all leaves that have the level."""
    pending_nodes = [tree]
    while pending_nodes:
        node = pending_nodes.pop()
        if not isinstance(node, dict):
            raise SceneError(f"{where}: a node of its tree must be an object; got {node!r:.60}")
        children = node.get("children")
        lods = node.get("lods")
        if isinstance(children, list) and lods is None:
            pending_nodes += children
        elif isinstance(lods, dict) and not children:
            if (run := lods.get(str(level))) is not None:
                yield validate_model(_Run, run, f"{where}, lods of a leaf")
        else:
            raise SceneError(
                f"{where}: a node of its tree must have either children, a list, or lods, an "
                f"object; it has {', '.join(map(repr, list(node)[:8])) or 'nothing'}"
            )


def _check_runs(path: Path, meta: _Meta, runs: list[_Run]) -> int:
    """Refuse runs of unnamed chunks, runs that overlap, and runs that no chunk could hold.

    Returns:
        Bytes of all chunks.
    """
    if runs[-1].file >= len(meta.filenames):
        raise SceneError(
            f"{path}: a leaf names chunk {runs[-1].file} of {len(meta.filenames)} filenames"
        )
    for previous_run, run in itertools.pairwise(runs):
        if previous_run.file == run.file and previous_run.offset + previous_run.count > run.offset:
            raise SceneError(
                f"{path}: two leaves share Gaussians of {meta.filenames[run.file]!r:.200}: "
                f"{previous_run.offset} to {previous_run.offset + previous_run.count} and from "
                f"{run.offset} on"
            )
    numbers = sorted({run.file for run in runs})
    chunks = {_chunk_path(path, meta.filenames[number]).resolve() for number in numbers}
    if len(chunks) < len(numbers):
        raise SceneError(f"{path} names a chunk twice: its {len(numbers)} are {len(chunks)} files")
    size = sum(map(_chunk_bytes, chunks))
    check_memory(str(path), sum(run.count for run in runs), num_sh=1, file_bytes=size)
    return size


def _gather_gaussians(
    path: Path, meta: _Meta, runs: list[_Run], size: int
) -> tuple[Gaussians, dict[str, str]]:
    """Gather the Gaussians of the runs, chunk after chunk.

    Colours of a lower degree are filled up with zeros.

    Args:
        path: the `lod-meta.json`.
        meta: its content.
        runs: the runs, sorted by chunk and offset.
        size: bytes of all chunks.

    Returns:
        The Gaussians, and the first chunk's notes `up` and `unit`.
    """
    by_file: dict[int, list[_Run]] = {}
    for run in runs:
        by_file.setdefault(run.file, []).append(run)
    parts = list[Gaussians]()
    notes = dict[str, str]()
    for number, chunk_runs in by_file.items():
        file = _chunk_path(path, meta.filenames[number])
        chunk_gaussians, chunk_notes = read_all_sog_gaussians(file)
        if parts and chunk_notes != notes:
            raise SceneError(
                f"{file} says {chunk_notes} of up and unit; chunks before it say {notes}"
            )
        notes = chunk_notes
        end = chunk_runs[-1].offset + chunk_runs[-1].count
        if end > len(chunk_gaussians):
            raise SceneError(
                f"{path} names Gaussians up to {end} of {file}, which holds {len(chunk_gaussians)}"
            )
        if sum(run.count for run in chunk_runs) < len(chunk_gaussians):
            row_ranges = [torch.arange(run.offset, run.offset + run.count) for run in chunk_runs]
            chunk_gaussians = chunk_gaussians.select(torch.cat(row_ranges))
        parts.append(chunk_gaussians)
        num_rows = sum(map(len, parts))
        num_sh = max(part.sh.shape[1] for part in parts)
        check_memory(str(path), num_rows, num_sh=num_sh, file_bytes=size)
    bands = max(part.sh.shape[1] for part in parts)
    assert bands in NUM_SH_BY_DEGREE
    sh = [torch.nn.functional.pad(p.sh, (0, 0, 0, bands - p.sh.shape[1])) for p in parts]
    names = ("means", "quats", "scales", "opacities")
    columns = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
    return Gaussians(**columns, sh=torch.cat(sh)), notes


def _chunk_path(path: Path, name: str) -> Path:
    """Return the meta.json or .sog of a chunk, which must lie in the folder."""
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


def _chunk_bytes(chunk: Path) -> int:
    """Return the bytes of a chunk: of the .sog, or of the files beside its meta.json."""
    if chunk.name != META:
        return chunk.stat().st_size
    return sum(file.stat().st_size for file in chunk.parent.iterdir() if file.is_file())


STREAMED_SOG = SplatFormat(
    name=LOD_META, reader=read_streamed_sog, file_names=(LOD_META,), option="level"
)
