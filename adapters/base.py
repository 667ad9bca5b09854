"""Open scenes by URI: `open_scene("scheme:path?key=value&…")`.

Schemes and syntax are those of adapters.uri. A path without a scheme is recognised by its contents.
Four keys work with every scheme: `camera_path=FILE` replaces the scene's cameras (see
adapters.camera_files.paths); `ground_z=HEIGHT` gives the height of the road (scene world, metres)
if the scene does not know it or is wrong; `ego_masks=FOLDER` gives the pixels of recorded images
that show the recording car (see adapters.ego_masks); `tracks=FILE` moves, removes and adds actors
(see adapters.tracks_file).
"""

from __future__ import annotations

import contextlib
import dataclasses
import fnmatch
import glob
import itertools
import math
import os
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path

from adapters.camera_files.paths import with_camera_path
from adapters.datasets import DATASETS
from adapters.detect_format import describe_unrecognised, detect_scheme
from adapters.ego_masks import with_ego_masks
from adapters.scene_cache import cached_scene
from adapters.tracks_file import with_tracks
from adapters.uri import (
    CAMERA_PATH_KEY,
    EGO_MASKS_KEY,
    GROUND_KEY,
    TRACKS_KEY,
    add_to_uri,
    format_uri,
    known_schemes,
    parse_uri,
)
from augment.errors import AdapterError, SceneError
from augment.scene.scene import Ground, Scene
from recipes.errors import nearest_word
from recipes.job import JobScene


def open_scene(uri: str) -> Scene:
    """Open a scene.

    Raises:
        AdapterError: the scheme is unknown (the message lists the known ones), the path is missing,
            no adapter recognises it, or its adapter cannot use the dataset.
    """
    scheme, path, query = parse_uri(uri)
    camera_path = query.pop(CAMERA_PATH_KEY, None)
    ground_z = query.pop(GROUND_KEY, None)
    ego_masks = query.pop(EGO_MASKS_KEY, None)
    tracks = query.pop(TRACKS_KEY, None)
    if scheme is None:
        scheme = detect_scheme_of_path(Path(path))
    dataset = DATASETS.get(scheme)
    if dataset is None:
        near = nearest_word(scheme, tuple(DATASETS))
        guess = f"; did you mean {near}?" if near else ";"
        raise AdapterError(f"unknown scheme {scheme!r} in {uri!r}{guess} known: {known_schemes()}")
    if dataset.builtin:
        if path not in dataset.builtin:
            raise AdapterError(
                f"{scheme}:{path}: {scheme} scenes are {', '.join(dataset.builtin)}; got {path!r}. "
                f"Example: {dataset.example}"
            )
        scene = dataset.open(query)
    else:
        _check_there(Path(path))
        build = partial(dataset.open, path, query)
        try:
            scene = cached_scene(scheme, path, query, build) if dataset.is_raw else build()
        except OSError as error:
            raise AdapterError(f"{uri!r}: cannot be read: {error}") from error
        except AdapterError:
            raise
        except SceneError as error:
            raise AdapterError(f"{uri!r}: {error}") from error
    if ground_z is not None:
        scene = _with_ground(scene, ground_z)
    if ego_masks is not None:
        scene = with_ego_masks(scene, Path(ego_masks))
    if camera_path is not None:
        scene = with_camera_path(scene, Path(camera_path))
    if tracks is not None:
        scene = with_tracks(scene, Path(tracks), path, open_scene)
    return scene


def _with_ground(scene: Scene, text: str) -> Scene:
    try:
        height = float(text)
    except ValueError:
        height = math.nan
    if not math.isfinite(height):
        raise AdapterError(f"{GROUND_KEY} must be the road's height in metres; got {text!r}")
    source = add_to_uri(scene.source, GROUND_KEY, text)
    ground = Ground(height, height, "stated")
    return dataclasses.replace(scene, ground_z_m=height, ground=ground, source=source)


def detect_scheme_of_path(path: Path) -> str:
    """Return the scheme of a path by its contents."""
    _check_there(path)
    scheme = detect_scheme(path)
    if scheme is None:
        raise AdapterError(
            f"{path}: not recognised as a scene. {describe_unrecognised(path)}. "
            f"Or name the scheme: {known_schemes()}"
        )
    return scheme


def _check_there(path: Path) -> None:
    if path.is_dir() or path.is_file():
        return
    if path.exists():
        raise AdapterError(f"{path}: a pipe or device; a scene is a regular file or a folder")
    absolute = path.absolute()
    parent = next((p for p in absolute.parents if p.exists()), Path("/"))
    where = "" if parent == absolute.parent else f"; the path exists up to {parent}"
    raise AdapterError(f"{path}: no such file or folder (looked at {absolute}{where})")


# ---- Scenes of a job as its file names them: patterns expanded, relative paths made absolute -----

_NAME_KEYS = ("files",)  # name files in the scene's folder, not beside the job
MAX_ENTRIES = 200_000  # files and folders, for one pattern: a second or two


def expand_job_scenes(entries: Iterable[JobScene], folder: Path) -> list[JobScene]:
    """Return every scene of a job once, in the job's order.

    An entry whose path has `*`, `**` or `[...]` stands for all paths that match (a `?` begins the
    query), in their order. Each of them has the entry's query, frames, cameras and recipes.

    Args:
        entries: the job's entries.
        folder: folder from which relative paths start.
    """
    scenes: dict[str, JobScene] = {}
    for entry in entries:
        entry_scenes = _expanded(entry, folder)
        if entry.name is not None and len(entry_scenes) > 1:
            raise AdapterError(
                f"{entry.uri!r} stands for {len(entry_scenes)} scenes, which cannot all be called "
                f"{entry.name!r}; leave the name out, or list them one by one"
            )
        for scene in entry_scenes:
            if scene.uri in scenes:
                raise AdapterError(
                    f"the job names the scene {scene.uri!r} twice (by {entry.uri!r}); give its "
                    f"frames, cameras and recipes in one entry"
                )
            scenes[scene.uri] = scene
    return list(scenes.values())


def _expanded(entry: JobScene, folder: Path) -> list[JobScene]:
    scheme, path, query = parse_uri(entry.uri)
    dataset = DATASETS.get(scheme) if scheme is not None else None
    query = {
        key: value if key in _NAME_KEYS else _from(folder, key, value)
        for key, value in query.items()
    }
    if scheme is not None and dataset is None:
        return [entry]  # refused where it is opened
    if scheme is not None and dataset is not None and path in dataset.builtin:
        return [entry.model_copy(update={"uri": format_uri(scheme, path, query)})]
    full_path = folder.absolute() / path
    matches = [str(full_path)]
    if glob.has_magic(path) and not full_path.exists():
        # The job's own folder may be called [x] too.
        top = folder.absolute()
        parts = Path(path).parts
        if Path(path).is_absolute():
            top = Path("/")
            parts = parts[1:]
        matches = _matches(top, parts, entry.uri)
    if not matches:
        raise AdapterError(f"{entry.uri!r}: nothing matches {full_path}")
    return [entry.model_copy(update={"uri": _uri(scheme, match, query)}) for match in matches]


def expand_datasets(entries: Iterable[JobScene]) -> list[JobScene]:
    """Return a job's scenes, with every scene of a folder of many scenes in place of the folder."""
    scenes: list[JobScene] = []
    for entry in entries:
        scheme, path, query = parse_uri(entry.uri)
        if scheme is None:
            scheme = detect_scheme_of_path(Path(path))
        dataset = DATASETS.get(scheme)
        if dataset is None or path in dataset.builtin:
            scenes.append(entry)
            continue
        queries = dataset.scene_queries(path, query)
        uris = [format_uri(scheme, path, scene_query) for scene_query in queries]
        scenes += [entry.model_copy(update={"uri": uri}) for uri in uris]
    return scenes


def recorded_conditions(uri: str) -> tuple[str, ...]:
    """Return the conditions that a scene's dataset states of its recording, sorted by name.

    They are some of rain, snow, fog and night; none where the dataset says nothing.
    """
    scheme, path, query = parse_uri(uri)
    dataset = DATASETS.get(scheme) if scheme is not None else None
    return () if dataset is None else dataset.recorded_conditions(path, query)


def _matches(top: Path, parts: tuple[str, ...], scene_uri: str) -> list[str]:
    """Return the paths that match a pattern, in order.

    It works as glob.glob, but `**` follows no links, which may be circular, and the number of paths
    is limited.

    Args:
        top: folder below which paths are searched.
        parts: parts of the pattern below `top`.
        what: the pattern, for messages.
    """
    entry_count = itertools.count()

    def names(folder: str) -> Iterator[os.DirEntry[str]]:
        with contextlib.suppress(OSError), os.scandir(folder) as entries:  # a file, another user's
            for entry in entries:
                if next(entry_count) >= MAX_ENTRIES:
                    raise AdapterError(
                        f"{scene_uri!r}: looked at {MAX_ENTRIES} files and folders and saw no end; "
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


def _from(folder: Path, key: str, value: str) -> str:
    """Return a value of the query that names a file beside the job as an absolute path."""
    beside = folder.absolute() / value
    may_name_a_file = key in (EGO_MASKS_KEY, TRACKS_KEY) or "/" in value or "." in value
    names_a_file = may_name_a_file and beside.exists()
    return str(beside) if names_a_file else value


def _uri(scheme: str | None, path: str, query: dict[str, str]) -> str:
    if scheme is None and query:
        scheme = detect_scheme_of_path(Path(path))
    return path if scheme is None else format_uri(scheme, path, query)
