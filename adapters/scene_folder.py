"""Scenes in files of our own, with the labels of their recording.

    scene:PATH?data=pandaset:PATH/002

PATH is a folder (`climategs fit` writes them) or a single .climategs file. Such files hold no
labels: boxes and LiDAR are read on demand from the recording to which the scene was fitted. `data`
gives its place, if it has moved.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path

from adapters.datasets import DATASETS
from adapters.uri import (
    CAMERA_PATH_KEY,
    EGO_MASKS_KEY,
    GROUND_KEY,
    TRACKS_KEY,
    format_uri,
    parse_uri,
)
from augment.errors import AdapterError
from augment.files.scene_file import read_saved_scene
from augment.scene.cameras import Frame
from augment.scene.labels import LabelSource
from augment.scene.scene import Scene

_DATA_KEY = "data"


@dataclasses.dataclass(frozen=True)
class Recording:
    """Location of raw data. path: absolute, or a builtin scene's name."""

    scheme: str
    path: str
    query: Mapping[str, str]

    @property
    def uri(self) -> str:
        return format_uri(self.scheme, self.path, self.query)

    @property
    def is_there(self) -> bool:
        return self.path in DATASETS[self.scheme].builtin or Path(self.path).exists()


def open_scene_folder(path: str, query: dict[str, str]) -> Scene:
    """Open the scene of a scene folder or a scene file.

    query: data, the URI or path of the recording, if it has moved.

    Raises:
        AdapterError: a key is unknown, or `data` leads nowhere.
        SceneError: a file is missing or damaged. A missing recording is a sentence in
            Scene.problems.
    """
    unknown = sorted(set(query) - {_DATA_KEY})
    if unknown:
        raise AdapterError(
            f"scene:{path} does not know {', '.join(map(repr, unknown))}; it takes {_DATA_KEY}"
        )
    saved = read_saved_scene(path)
    scene = dataclasses.replace(saved.scene, source=format_uri("scene", path, query))
    assert scene.recorded_source is not None
    recorded = _recording(scene.recorded_source, saved.working_folder)
    if _DATA_KEY in query:
        new_recording = _recording_of_query(query[_DATA_KEY])
        if recorded is not None:
            scene = with_images_in(new_recording.path, scene, recorded.path)
        recorded = new_recording
    try:
        if recorded is None or not recorded.is_there:
            name = scene.recorded_source if recorded is None else recorded.uri
            raise AdapterError(f"{name}, which the scene was made from, is not there")
        labels = recorded_labels(recorded)
    except AdapterError as error:
        missing = (
            f"{error}; so boxes and LiDAR are left out. Where it has moved, add {_DATA_KEY}=URI to "
            f"the scene's URI"
        )
        return dataclasses.replace(scene, problems=(*scene.problems, missing))
    return dataclasses.replace(scene, labels=labels, recorded_source=recorded.uri)


def prepare_for_storage(scene: Scene) -> Scene:
    """Return an opened scene in the form in which it belongs into another saved scene.

    A recording that is missing today is no fact about the scene, and a relative path to it stays
    valid.
    """
    scheme, path, _ = parse_uri(scene.source)
    if scheme != "scene" or scene.labels is not None or scene.recorded_source is None:
        return scene
    saved = read_saved_scene(path)
    recorded = _recording(scene.recorded_source, saved.working_folder)
    if recorded is not None:
        scene = dataclasses.replace(scene, recorded_source=recorded.uri)
    return dataclasses.replace(scene, problems=saved.scene.problems)


def recorded_labels(recording: Recording) -> LabelSource | None:
    """Return the labels of a recording without its Gaussians, which take long to build.

    The result is None if a scene of this URI has no labels.
    """
    if CAMERA_PATH_KEY in recording.query:  # the frames are not the recorded ones
        return None
    facts = (GROUND_KEY, EGO_MASKS_KEY, TRACKS_KEY)  # of scenes, not of labels
    query = {key: value for key, value in recording.query.items() if key not in facts}
    return DATASETS[recording.scheme].open_labels(recording.path, query)


def _recording_of_query(uri: str) -> Recording:
    """Return the recording of the `data` key."""
    from adapters.base import detect_scheme_of_path

    recording = _recording(uri, Path.cwd())
    if recording is None:
        scheme, path, query = parse_uri(uri)
        if scheme is not None:
            raise AdapterError(f"{_DATA_KEY}={uri}: no recording is named so")
        return Recording(detect_scheme_of_path(Path(path)), os.path.abspath(path), query)
    if not recording.is_there:
        raise AdapterError(f"{_DATA_KEY}={uri}: no such file or folder: {recording.path}")
    return recording


def _recording(uri: str, working_folder: Path) -> Recording | None:
    """Return a URI with its path made absolute, or None if it names no recording."""
    try:
        scheme, path, query = parse_uri(uri)
    except AdapterError:
        return None
    if scheme is None or scheme not in DATASETS or scheme == "scene":
        return None
    if path in DATASETS[scheme].builtin:
        return Recording(scheme, path, query)
    return Recording(scheme, os.path.normpath(working_folder / path), query)


def with_images_in(new: str, scene: Scene, old: str) -> Scene:
    """Return the scene with image paths moved from the folder `old` to the folder `new`."""

    def moved(frame: Frame) -> Frame:
        paths = {
            name: str(Path(new, os.path.relpath(path, old))) if path.startswith(old + "/") else path
            for name, path in frame.image_paths.items()
        }
        return dataclasses.replace(frame, image_paths=paths)

    seen_frames = scene.seen_frames
    return dataclasses.replace(
        scene,
        frames=tuple(map(moved, scene.frames)),
        seen_frames=None if seen_frames is None else tuple(map(moved, seen_frames)),
    )
