"""The record of a dataset: the facts about one kind of scene that are needed before it is opened.

Each dataset's folder has a `dataset.py` with its record. `adapters.datasets` lists them all. URIs,
recognition, the scene cache, advice on unknown folders and copies of datasets read the records.
Loading a record loads no reader and no torch.
"""

from __future__ import annotations

import importlib
import itertools
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:  # torch would be loaded with them
    from augment.scene.labels import LabelSource
    from augment.scene.scene import Scene

_START_BYTES = 4096  # of a file, by which its format is recognised
_MAX_NAMES = 1_000_000  # names of a folder that are looked at: some tenths of a second
_NO_PATH = r"(?!)"  # matches nothing


@dataclass(frozen=True)
class Signature:
    """Signs by which a file or folder of one kind is recognised."""

    is_here: Callable[[Path], bool]
    kind_words: str | Callable[[], str]
    """The kind in words, for messages, or a function that returns them."""

    def describe(self) -> str:
        """Return the kind in words."""
        return self.kind_words if isinstance(self.kind_words, str) else self.kind_words()


@dataclass(frozen=True)
class FolderLayout:
    """Parts of one kind of folder. An unknown folder that has some of them is told the others."""

    kind_words: str
    """The kind in words, for messages."""
    parts: Mapping[str, tuple[str, ...]]
    """Each part's name in messages, with glob patterns below the folder. A match of any of them
    is the part."""


class SourceTree(NamedTuple):
    """Folder of a dataset that is copied with weathered images."""

    root: Path
    images: str
    """Regular expression that matches the complete paths of camera images, relative to root."""
    sweeps: str = _NO_PATH
    """Regular expression that matches the complete paths of LiDAR sweeps, relative to root."""
    entries: Iterable[str] | None = None
    """Names in root that belong to the dataset; None for all."""


def fixed_tree(images: str, sweeps: str = _NO_PATH) -> Callable[[Path, dict[str, str]], SourceTree]:
    """Return a `source_tree` for datasets whose folder is the scene's path."""
    return lambda folder, _query: SourceTree(folder, images, sweeps)


OpenLabels = Callable[[], "LabelSource | None"]
ListFiles = Callable[[str, dict[str, str], OpenLabels], Iterable[Path]]


def whole_path(path: str, _query: dict[str, str], _open_labels: OpenLabels) -> Iterable[Path]:
    """Return the path itself: the scene is made from a file, or from everything in a folder."""
    return (Path(path),)


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """One kind of scene. Its reader is given as module:name, and imported when it is used."""

    scheme: str
    """Scheme of its URIs."""
    description: str
    """The data that a user has, in words, as the table in docs/scenes.md has it."""
    page: str
    """Name of its page in docs/datasets."""
    example: str
    """URI of an example, for messages."""
    opener: str
    """Function from path and query to a Scene whose `source` is `format_uri(scheme, path, query)`.
    It raises an AdapterError for unknown keys."""
    builtin: tuple[str, ...] = ()
    """Names that the path may be if it is no file. The opener then takes the query alone."""
    labels: str | None = None
    """Function from path and query to the labels alone (None without any), which a scene fitted to
    such data needs."""
    is_raw: bool = False
    """True if opening builds the scene from raw data, which takes long. The scene is cached."""
    folder: Signature | None = None
    """Signs of a folder."""
    file: Signature | None = None
    """Signs of a single file."""
    layouts: tuple[FolderLayout, ...] = ()
    """Kinds of folders of this dataset, for advice on a folder that lacks a part."""
    source_tree: Callable[[Path, dict[str, str]], SourceTree] | None = None
    """Function from the scene's absolute path and query to the folder that `--layout source`
    copies; None if no such copy is made."""
    scene_files: ListFiles = whole_path
    """Function that lists the files that the opener reads, including those that it would read if
    they existed. A folder stands for everything in it. A cached scene is built again when one of
    them changes. Arguments: path, query, a function that returns the scene's labels."""
    content_files: Callable[[str], Iterable[Path]] | None = None
    """Function from the path to the files whose content makes the scene's digest; None if they are
    those of `scene_files`."""
    list_scenes: str | None = None
    """Function from path and query to the query of each scene in a folder of many scenes; None if a
    path is one scene."""
    conditions: str | None = None
    """Function from path and query to the conditions that the dataset states of a recording: some
    of rain, snow, fog and night. None if it states none."""
    is_hashed_whole: bool = False
    """True if the digest reads all bytes. Of other scenes large files and images are sampled."""

    def open(self, *path_and_query: object) -> Scene:
        return _imported(self.opener)(*path_and_query)

    def open_labels(self, path: str, query: Mapping[str, str]) -> LabelSource | None:
        return _imported(self.labels)(path, query) if self.labels else None

    def scene_queries(self, path: str, query: dict[str, str]) -> list[dict[str, str]]:
        """Return the query of each scene that a path and a query stand for.

        A folder without scenes stands for itself: opening it says what is missing.
        """
        queries = _imported(self.list_scenes)(path, query) if self.list_scenes else []
        return queries or [query]

    def recorded_conditions(self, path: str, query: dict[str, str]) -> tuple[str, ...]:
        """Return the conditions that the dataset states of a recording, sorted by name."""
        return tuple(sorted(_imported(self.conditions)(path, query))) if self.conditions else ()


def _imported(name: str) -> Callable[..., Any]:
    module, function = name.split(":")
    return getattr(importlib.import_module(module), function)


def read_start(path: Path) -> bytes:
    """Return the first bytes of a file."""
    from recipes.files import open_file

    with open_file(path) as file:
        return file.read(_START_BYTES)


def names_in(folder: Path) -> list[str]:
    """Return the names of a folder's entries."""
    with os.scandir(folder) as entries:
        return [entry.name for entry in itertools.islice(entries, _MAX_NAMES)]
