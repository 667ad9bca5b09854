"""Detect the kind of scene that a path holds, from names in folders and the first bytes of files.

`detect_scheme` returns the scheme, `describe_unrecognised` explains a failure, `source_tree` finds
the dataset behind a scene. The callers are `adapters.base` and `tools`.
"""

from __future__ import annotations

import contextlib
import itertools
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from adapters.dataset import Signature
from adapters.datasets import DATASETS, RECOGNITION_ORDER
from adapters.uri import CAMERA_PATH_KEY, EGO_MASKS_KEY, GROUND_KEY, TRACKS_KEY, parse_uri
from augment.errors import AdapterError
from augment.jobs.mirror import DatasetFolder
from augment.scene.scene import Scene

# ---- Which folder and files make up the dataset behind a scene, for copies in other weather ------


def source_tree(scene: Scene) -> DatasetFolder:
    """Return the dataset from which the scene was made: the opened one, or the one that recorded
    it.
    """
    uri = scene.recorded_source or scene.source
    for part in (scene.source, uri):
        if CAMERA_PATH_KEY in parse_uri(part)[2]:
            raise AdapterError(
                f"{part} shows the frames of a camera path; a dataset's copy takes images of its "
                f"own frames, leave {CAMERA_PATH_KEY} out"
            )
        if TRACKS_KEY in parse_uri(part)[2]:
            raise AdapterError(
                f"{part} has moved actors, and a dataset's copy keeps the dataset's own labels and "
                f"sweeps, which show them where they were recorded; leave {TRACKS_KEY} out"
            )
    scheme, path, query = parse_uri(uri)
    query.pop(GROUND_KEY, None)
    query.pop(EGO_MASKS_KEY, None)
    trees = {name: dataset.source_tree for name, dataset in DATASETS.items() if dataset.source_tree}
    find = trees.get(scheme or "")
    if find is None:
        raise AdapterError(
            f"{uri} has no dataset's folder that could be copied with weathered images; "
            f"{', '.join(trees)} scenes have one, and scenes fitted to them"
        )
    if not Path(path).exists():
        raise AdapterError(
            f"{path}, which the scene was made from, is not there; where it has moved, say so in "
            f"the scene's URI (data=URI)"
        )
    tree = find(Path(os.path.abspath(path)), query)
    entries = None if tree.entries is None else tuple(sorted(tree.entries))
    return DatasetFolder(uri, tree.root, tree.images, entries, tree.sweeps)


# ---- Signatures ----------------------------------------------------------------------------------

_MAX_ENTRIES = 1000  # of a folder that are looked at below the one given


def _signatures(path: Path) -> list[tuple[str, Signature]]:
    """Return schemes and signatures of files or of folders, whichever lies at the path, in the
    order of recognition.
    """
    is_file = path.is_file()
    signatures = [(d.scheme, d.file if is_file else d.folder) for d in RECOGNITION_ORDER]
    return [(scheme, signature) for scheme, signature in signatures if signature is not None]


def detect_scheme(path: Path) -> str | None:
    """Return the scheme of a path's contents, or None if they are not known."""
    try:
        return next((name for name, sign in _signatures(path) if sign.is_here(path)), None)
    except OSError as error:
        raise AdapterError(f"{path}: cannot be read: {error}") from error


def describe_unrecognised(path: Path) -> str:
    """Return sentences on a path that is not recognised.

    They say what lies at the path or below it, what it lacks, and what was looked for.
    """
    *most, last = (signature.describe() for _, signature in _signatures(path))
    text = f"{', '.join(most)}, or {last}"
    if path.is_file():
        return f"Looked for {text}"
    below = next(_scenes_below(path), None)
    if below is not None:
        return f"It holds scenes: give one, such as {below}. Looked for {text}"
    return f"{_advice(path)}. Looked for {text}"


_IMAGES = (".jpg", ".jpeg", ".png")  # suffixes of images
_VIDEOS = (".mp4", ".mov", ".avi", ".mkv")  # suffixes of videos
_MAX_SEEN = 20_000  # files of an unknown folder that are counted
_MOST_KINDS = 6  # that are named


def _advice(folder: Path) -> str:
    """Return what an unknown folder holds, which kind it nearly is, and how to make it a
    recording.
    """
    from adapters.camera_files.camera_files import find_colmap_model

    places: dict[str, Counter[str]] = {}
    walk = ((place, name) for place, _, names in os.walk(folder) for name in sorted(names))
    for place, name in itertools.islice(walk, _MAX_SEEN):
        kind = os.path.splitext(name)[1].lower() or name
        places.setdefault(kind, Counter())[os.path.relpath(place, folder)] += 1
    kinds = sorted(places.items(), key=lambda kind: (-kind[1].total(), kind[0]))
    counts = [
        f"{where.total()} {kind} ({where.most_common(1)[0][0]}/"
        f"{' and others' if len(where) > 1 else ''})".replace(" (./)", "")
        for kind, where in kinds[:_MOST_KINDS]
    ]
    more = f" and {len(kinds) - _MOST_KINDS} more kinds" if len(kinds) > _MOST_KINDS else ""
    said = [f"It holds {', '.join(counts) or 'no files'}{more}"]
    for layout in (layout for dataset in DATASETS.values() for layout in dataset.layouts):
        existing_parts = [
            name
            for name, patterns in layout.parts.items()
            if any(any(folder.glob(pattern)) for pattern in patterns)
        ]
        missing = [name for name in layout.parts if name not in existing_parts]
        # Of many parts, one alone is anybody's name.
        if missing and len(existing_parts) > len(layout.parts) // 5:
            is_are = "is" if len(existing_parts) == 1 else "are"
            said.append(
                f"It is nearly {layout.kind_words}: {', '.join(existing_parts)} {is_are} there, "
                f"{', '.join(missing)} not"
            )
    guide = "docs/datasets/own-drive.md"
    if (model := find_colmap_model(folder)) is not None:
        said.append(
            f"It holds a COLMAP model: `climategs record {model} --images FOLDER --out RECORDING "
            f"--fps N --camera-height METRES` makes a recording of it"
        )
    elif any(kind in places for kind in _IMAGES):
        said.append(
            f"Its images make a recording with their poses: images/<camera>/000000.jpg and "
            f"calibration.json (docs/datasets/recording.md); COLMAP finds poses ({guide})"
        )
    elif any(kind in places for kind in _VIDEOS):
        said.append(f"Of a video's frames COLMAP and `climategs record` make a recording ({guide})")
    return ". ".join(said)


def _scenes_below(folder: Path) -> Iterator[Path]:
    for level in ("*", "*/*"):
        for entry in sorted(itertools.islice(folder.glob(level), _MAX_ENTRIES)):
            with contextlib.suppress(OSError, AdapterError):  # another user's
                if entry.is_dir() and detect_scheme(entry) is not None:
                    yield entry
