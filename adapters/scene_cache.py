"""Cache of raw scenes in the user's cache folder.

A raw scene takes a minute of a processor to build, and an instant to open from the cache. An entry
is a scene file (augment.files.scene_file), named by its sources and by its own bytes:

    $XDG_CACHE_HOME or ~/.cache, climategs/scenes/KEY-DIGEST.climategs

KEY is a digest of path and options, of the code and the libraries that build the scene, and of
path, size and time of change of every file that the adapter reads. A file that is replaced by one
of the same size and time goes unnoticed; to read all bytes of a drive would take seconds. Labels
are no part of an entry: they are read from the recording.

CLIMATEGS_SCENE_CACHE_GB limits the folder's size (10 by default); the entries that were not used
for longest are removed first. With 0 the cache is neither read nor written. Beside it,
images/NAME-KEY/ holds images that a dataset does not have in files of their own. They may take as
much, or all that was used within a day, which a running job may need.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import hashlib
import json
import logging
import math
import os
import re
import secrets
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

from llvmlite.binding import get_host_cpu_name

import augment
from adapters.datasets import DATASETS
from adapters.detect_format import detect_scheme
from adapters.ego_masks import mask_files
from adapters.scene_folder import with_images_in
from adapters.tracks_file import other_scenes
from adapters.uri import EGO_MASKS_KEY, TRACKS_KEY, format_uri, parse_uri
from augment.errors import AdapterError, ClimateGSError, OutputError, SceneError
from augment.files.recorded_images import has_image
from augment.files.scene_file import SCENE_SUFFIX, VERSION, load_scene_parts, save_scene_file
from augment.output.atomic import (
    open_lock,
    read_file,
    remove_temporaries,
    wait_for_lock,
    write_atomic,
)
from augment.output.names import STATE_FOLDER
from augment.render.cpu.kernel_cache import user_cache_folder
from augment.scene.labels import LabelSource
from augment.scene.scene import Scene, is_drawable
from recipes.files import open_file

logger = logging.getLogger(__name__)

LIMIT_KEY = "CLIMATEGS_SCENE_CACHE_GB"
DEFAULT_LIMIT_GB = 10.0  # some 150 scenes
_MAX_FILES = 1_000_000  # of a dataset's folder: some seconds to look at; or links lead in circles
_IMAGES = "images"
_IN_USE_S = 86_400.0
MAX_BUILDING_S = 1800.0  # how long to wait for another process that builds the same scene
_CODE = ("adapters", "augment", "recipes")
_LIBRARIES = (
    "climategs",
    "numpy",
    "scipy",
    "numba",
    "torch",
    "opencv-contrib-python-headless",
    "opencv-python-headless",
    "opencv-python",
    "pandas",
    "pyarrow",
    "open3d",
)


def cached_scene(
    scheme: str, path: str, query: Mapping[str, str], build: Callable[[], Scene]
) -> Scene:
    """Return the scene that `build` would make of this URI, from the cache if it is there."""
    limit_bytes = _limit_bytes()
    open_labels = functools.cache(partial(DATASETS[scheme].open_labels, path, query))
    key = _scene_key(scheme, path, query, open_labels) if limit_bytes else None
    folder = _cache_folder()
    if key is None or folder is None:
        return build()
    stored_scene = _read(folder, key)
    if stored_scene is None or not _has_images(stored_scene, folder):
        with _lock_entry(folder, key) as can_write:
            stored_scene = _read(folder, key) if can_write else None  # by another process meanwhile
            if stored_scene is None or not _has_images(stored_scene, folder):
                scene = build()
                if can_write:
                    _store(scene, folder, key, limit_bytes)
                return scene
    return replace(
        with_images_in(path, stored_scene, os.path.abspath(path)),
        source=format_uri(scheme, path, query),
        labels=open_labels(),
        recorded_source=None,
    )


def image_folder(name: str, sources: Sequence[Path]) -> Path:
    """Return the folder for images that are made of these files.

    Its name follows from the files' paths, sizes and times. Folders that were not used for longest,
    and not within a day, are removed to make room.
    """
    scenes = _cache_folder()
    if scenes is None:
        raise AdapterError(
            "images without lens distortion need a folder, and this user has no home: set "
            "XDG_CACHE_HOME"
        )
    facts = json.dumps(list(_facts_of(sources))).encode()
    image_dir = scenes.with_name(_IMAGES) / f"{name}-{hashlib.sha256(facts).hexdigest()[:16]}"
    with contextlib.suppress(OSError):  # what cannot be written, the writer says
        image_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
        os.utime(image_dir)
        _make_room_for_images(image_dir.parent, _limit_bytes())
    return image_dir


def _make_room_for_images(folder: Path, limit_bytes: float) -> None:
    used = sorted(((path.stat().st_mtime, path) for path in folder.iterdir()), reverse=True)
    total = 0
    for used_s, path in used:
        total += sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
        if total > limit_bytes and time.time() - used_s > _IN_USE_S:
            shutil.rmtree(path, ignore_errors=True)


def _has_images(scene: Scene, folder: Path) -> bool:
    """True if all of the scene's images that belong beside the cache's folder exist."""
    image_prefix = str(folder.with_name(_IMAGES)) + os.sep
    frames = (*scene.frames, *(scene.seen_frames or ()))
    paths = (path for frame in frames for path in frame.image_paths.values())
    return all(has_image(Path(path)) for path in paths if path.startswith(image_prefix))


def disable_scene_cache() -> None:
    """Disable the cache in this process and those that it starts."""
    os.environ[LIMIT_KEY] = "0"


def _cache_folder() -> Path | None:
    """Return the folder of the entries, or None if the user has no home."""
    folder = user_cache_folder()
    return None if folder is None else folder / "scenes"


def _limit_bytes() -> float:
    text = os.environ.get(LIMIT_KEY, "") or str(DEFAULT_LIMIT_GB)
    try:
        limit = float(text)
    except ValueError:
        limit = math.nan
    if not limit >= 0:
        raise AdapterError(
            f"{LIMIT_KEY} must be a number of gigabytes, 0 for no scene cache; got {text!r}"
        )
    return limit * 1e9


# ---- What a scene is made from -------------------------------------------------------------------


def _scene_key(
    scheme: str, path: str, query: Mapping[str, str], open_labels: Callable[[], LabelSource | None]
) -> str | None:
    """Return the KEY of a scene, hexadecimal.

    The result is None if the scene's files cannot be listed; the adapter then gives a better
    message.
    """
    try:
        files = list(_facts_of(_read_files(scheme, path, query, open_labels)))
    except (OSError, ClimateGSError):
        return None
    facts = [VERSION, *_builder(), scheme, os.path.abspath(path), sorted(query.items()), files]
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:32]


def _read_files(
    scheme: str, path: str, query: Mapping[str, str], open_labels: Callable[[], LabelSource | None]
) -> Iterator[Path]:
    """Return the files that the adapter reads, including those that it would read if they
    existed.

    A folder stands for everything in it.
    """
    yield from (Path(value) for value in query.values() if Path(value).is_file())
    yield from _depth_folder(query)
    yield from DATASETS[scheme].scene_files(path, dict(query), open_labels)


def _depth_folder(query: Mapping[str, str]) -> tuple[Path, ...]:
    """Return the folder of a raw drive's option `depth`, which may begin with a kind of maps."""
    option = query.get("depth")
    return () if option is None else (Path(re.sub("^(metric|relative):", "", option)),)


def _facts_of(paths: Iterable[Path]) -> Iterator[tuple[str, int, int]]:
    """Return path, size and time of change of files and of all files in folders.

    Missing ones are marked.
    """
    count = 0
    for path in paths:
        names: Iterable[str] = [str(path)]
        if path.is_dir():
            walk = os.walk(path, followlinks=True)
            names = (os.path.join(place, name) for place, _, files in walk for name in files)
        for name in sorted(names):
            count += 1
            if count > _MAX_FILES:
                raise AdapterError(f"{path} has more than {_MAX_FILES} files")
            try:
                facts = os.stat(name)
            except FileNotFoundError:  # or a link to nothing
                yield os.path.abspath(name), -1, -1
            else:
                yield os.path.abspath(name), facts.st_size, facts.st_mtime_ns


@functools.cache
def _builder() -> tuple[str, ...]:
    """Return facts on the code that builds scenes.

    They are its own, those of the libraries with which it calculates, and the processor, whose
    instructions the libraries choose from.
    """
    code = hashlib.sha256()
    for package in _CODE:
        top = Path(__file__).parents[1] / package
        for file in sorted(top.rglob("*.py")):
            code.update(f"{file.relative_to(top)}\0".encode() + file.read_bytes())
    installed = {
        distribution.name: distribution.version
        for name in _LIBRARIES
        for distribution in distributions(name=name)
    }
    return (code.hexdigest(), *map(str, installed.items()), get_host_cpu_name())


# ---- The digest of a scene's content, by which an output knows what it was made from ------------
# It is of what the files hold, under their names below the scene's path: a copy on another disk has
# the same, and so has one whose times were changed. Scene files and splat files are read whole. Of
# recorded drives, images and files of more than 1 MiB are sampled at three places, since a drive
# has gigabytes; of nuScenes, whose folder has hundreds of scenes, the tables alone are read. What
# was read once is remembered by the sizes and times of the files, in the user's cache folder.

_DIGEST_FORMAT = 1
_DIGESTS = "digests"
_IMAGES_OF_DRIVES = {".jpg", ".jpeg", ".png", ".webp"}
_MAX_WHOLE_BYTES = 1 << 20
_IMAGE_SAMPLE_BYTES = 1 << 12
_SAMPLE_BYTES = 1 << 16
_SETTLED_S = 2.0  # a file changed later may change again within one tick of its clock


def scene_digest(uri: str) -> str | None:
    """Return a digest of a scene's content, 32 hexadecimal digits: other content, another
    digest.

    For a procedural scene it is of its options and the package's version. Masks of the recording
    car count as files of the scene, and so do a file of tracks and the scenes that it names. The
    result is None if the scene's files cannot be listed or read; opening the scene then gives the
    reason.
    """
    try:
        scheme, path, query = parse_uri(uri)
        tracks = query.pop(TRACKS_KEY, None)
        if tracks is not None:
            scheme = scheme or detect_scheme(Path(path))
            return _digest_with_tracks(format_uri(str(scheme), path, query), path, Path(tracks))
        scheme = scheme or detect_scheme(Path(path))
        dataset = DATASETS[scheme or ""]
        if path in dataset.builtin:
            return _sha256([_DIGEST_FORMAT, scheme, sorted(query.items()), augment.__version__])
        files = _digest_files(str(scheme), path, query)
        return _cached_digest([scheme, os.path.abspath(path), sorted(query.items())], files)
    except (KeyError, OSError, ClimateGSError):
        return None


def _digest_with_tracks(uri: str, path: str, tracks: Path) -> str | None:
    """Return the digest of a scene whose actors a file moves; None where one cannot be read.

    Args:
        uri: the scene's URI without the file.
        path: the path in it.
        tracks: the file.
    """
    other_uris = other_scenes(tracks, path)
    digests = [scene_digest(uri), *(scene_digest(other) for other in other_uris)]
    if None in digests:
        return None
    content = _content_digest(tracks, True, tracks.stat().st_size)
    return _sha256([_DIGEST_FORMAT, digests, content])


def _digest_files(scheme: str, path: str, query: Mapping[str, str]) -> dict[str, tuple[Path, bool]]:
    """Return the scene's files by name: the path of each, and whether it is read whole."""
    root = Path(path)
    dataset = DATASETS[scheme]
    if dataset.content_files is not None:
        places = dataset.content_files(path)
    else:
        options = {
            key: value
            for key, value in query.items()
            if key != EGO_MASKS_KEY and not Path(value).is_file()
        }
        places = dataset.scene_files(path, options, lambda: None)
    files: dict[str, tuple[Path, bool]] = {}
    for place in places:
        for file in visible_files(place) if place.is_dir() else (place,):
            files[os.path.relpath(file, root)] = file, dataset.is_hashed_whole
    for key, value in query.items():  # of cameras, say
        if Path(value).is_file():
            files[f"?{key}"] = Path(value), True
        elif key == EGO_MASKS_KEY:
            for file in mask_files(Path(value)):
                files[f"?{key}/{file.name}"] = file, True
    for folder in _depth_folder(query):
        for file in visible_files(folder):
            files[f"?depth/{os.path.relpath(file, folder)}"] = file, dataset.is_hashed_whole
    if len(files) > _MAX_FILES:
        raise AdapterError(f"{path} has more than {_MAX_FILES} files")
    return files


def visible_files(folder: Path) -> Iterator[Path]:
    """Return the files below a folder, without hidden ones and those of outputs that were
    written there.
    """
    for place, folders, names in os.walk(folder, followlinks=True):
        folders[:] = [
            name
            for name in folders
            if name[0] != "." and not os.path.isdir(os.path.join(place, name, STATE_FOLDER))
        ]
        yield from (Path(place, name) for name in names if name[0] != ".")


def _cached_digest(names: list[Any], files: Mapping[str, tuple[Path, bool]]) -> str:
    """Return the digest of the files, from the user's cache folder if none has changed since."""
    stats = {name: file.stat() for name, (file, _) in sorted(files.items()) if file.is_file()}
    if not stats:
        raise FileNotFoundError(str(names))
    facts = _sha256([_DIGEST_FORMAT, [[n, s.st_size, s.st_mtime_ns] for n, s in stats.items()]])
    scenes = _cache_folder()
    memo = None
    if scenes is not None and _limit_bytes():
        memo = scenes.with_name(_DIGESTS) / f"{_sha256(names)}.json"
        with contextlib.suppress(OSError, ValueError, RecursionError):
            memo_content = json.loads(read_file(memo))
            if isinstance(memo_content, dict) and memo_content.get("facts") == facts:
                return str(memo_content["digest"])
    parts = [[name, _content_digest(*files[name], stats[name].st_size)] for name in stats]
    digest = _sha256([_DIGEST_FORMAT, parts])
    latest_s = max((s.st_mtime for s in stats.values()), default=0.0)
    if memo is not None and time.time() - latest_s > _SETTLED_S:
        with contextlib.suppress(OSError, OutputError):  # it is worked out again
            memo.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            write_atomic(memo, json.dumps({"facts": facts, "digest": digest}).encode())
    return digest


def _content_digest(file: Path, is_whole: bool, size: int) -> str:
    is_image = file.suffix.lower() in _IMAGES_OF_DRIVES
    with open_file(file) as opened:
        if is_whole or (size <= _MAX_WHOLE_BYTES and not is_image):
            return hashlib.file_digest(opened, "sha256").hexdigest()
        length = _IMAGE_SAMPLE_BYTES if is_image else _SAMPLE_BYTES
        sampled = hashlib.sha256(str(size).encode())
        for start in sorted({0, max(0, size // 2 - length // 2), max(0, size - length)}):
            opened.seek(start)
            sampled.update(opened.read(length))
        return sampled.hexdigest()


def _sha256(facts: object) -> str:
    return hashlib.sha256(json.dumps(facts).encode(errors="surrogateescape")).hexdigest()[:32]


# ---- Entries -------------------------------------------------------------------------------------


def _read(folder: Path, key: str) -> Scene | None:
    """Read the scene of a whole entry, and mark the entry as used."""
    for entry in folder.glob(f"{key}-*{SCENE_SUFFIX}"):
        try:
            if entry.stem != f"{key}-{_digest_of(entry)}":
                raise SceneError("its bytes are not those that were written")
            scene = load_scene_parts(entry)
        except (OSError, SceneError) as error:
            if entry.exists():  # not what another process has just removed
                logger.warning("%s is damaged (%s); the scene is built again", entry, error)
                with contextlib.suppress(OSError):
                    entry.unlink()
            continue
        with contextlib.suppress(OSError):  # a cache that is read only
            os.utime(entry)
        logger.info("%s: as it was built last, from %s", scene.name, entry)
        return scene
    return None


def _store(scene: Scene, folder: Path, key: str, limit_bytes: float) -> None:
    """Write an entry as a whole or not at all; where that cannot be done, say so once."""
    if not all(map(is_drawable, scene.all_gaussians)):
        return  # scene files leave such Gaussians out
    new = folder / f"{key}.{secrets.token_hex(8)}{SCENE_SUFFIX}"
    try:
        save_scene_file(scene, new)
        os.replace(new, new.with_name(f"{key}-{_digest_of(new)}{SCENE_SUFFIX}"))
        _make_room(folder, limit_bytes)
    except (OSError, ClimateGSError) as error:
        _warn_once(folder, error)


def _make_room(folder: Path, limit_bytes: float) -> None:
    """Remove entries that were not used for longest, and files that killed processes have left."""
    remove_temporaries(folder, recursive=False)
    used = []
    for entry in folder.glob(f"*{SCENE_SUFFIX}"):
        with contextlib.suppress(FileNotFoundError):
            facts = entry.stat()
            used.append((facts.st_mtime_ns, facts.st_size, entry))
    total = 0
    for _, size, entry in sorted(used, reverse=True):
        total += size
        if total > limit_bytes:
            entry.unlink(missing_ok=True)


@contextlib.contextmanager
def _lock_entry(folder: Path, key: str) -> Iterator[bool]:
    """Let one process build a scene while others that want the same wait.

    It yields True if the folder can be written. Without the system's locks, each process builds its
    own.
    """
    path = folder / f"{key}.lock"
    with contextlib.ExitStack() as stack:
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            lock = open_lock(path)
        except (OSError, OutputError) as error:
            _warn_once(folder, error)
            yield False
            return
        stack.callback(os.close, lock)
        try:
            wait_for_lock(path, lock, patience_s=MAX_BUILDING_S, activity="builds this scene")
        except OutputError as error:
            logger.warning("%s. The scene is built without the cache", error)
            yield False
            return
        except OSError:  # a system without locks
            pass
        else:
            # Not left to closing the file, which a process started meanwhile may have open too.
            stack.callback(fcntl.flock, lock, fcntl.LOCK_UN)
        stack.callback(path.unlink, missing_ok=True)
        yield True


def _digest_of(path: Path) -> str:
    with open_file(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:32]


def _warn_once(folder: Path, error: Exception) -> None:
    """Log once per process that scenes cannot be cached."""
    if folder not in _complained:
        logger.warning("scenes are not kept in %s for the next command: %s", folder, error)
    _complained.add(folder)


_complained: set[Path] = set()
