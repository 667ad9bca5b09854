"""Actors that a user moves, removes or adds.

    scene URI:  pandaset:PATH/002?tracks=FILE.json
    command:    climategs render … --tracks FILE.json

The file has up to three lists. Positions are in the dataset's world, in metres, at the centre of
the actor's box. Times are in seconds from the scene's first frame.

    {"move":   [{"track_id": "a1", "shift_m": [0, -3.5, 0]},
                {"track_id": "b2", "poses": [
                    {"time_s": 0, "position_m": [12, 3, 0.8], "yaw_deg": 90},
                    {"time_s": 2, "position_m": [12, 9, 0.8], "yaw_deg": 90}]}],
     "remove": [{"track_id": "c3"}],
     "add":    [{"track_id": "second a1", "copy_of": "a1", "shift_m": [8, 0, 0]},
                {"track_id": "stranger", "copy_of": "d4", "scene": "pandaset:../004",
                 "poses": [{"time_s": 0, "position_m": [20, 3, 0.8], "yaw_deg": 0}]}]}

`with_tracks` applies it with `augment.scene.moved_actors`.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Self

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field, model_validator

from adapters.datasets import DATASETS
from adapters.detect_format import describe_unrecognised, detect_scheme
from adapters.plain_files import Number, Text, read_json, validate_content
from adapters.uri import TRACKS_KEY, add_to_uri, format_uri, parse_uri
from augment.errors import AdapterError, SceneError
from augment.scene.geometry import rotmat_from_quat
from augment.scene.moved_actors import (
    NO_SHADOWS,
    RECORDED_SWEEPS,
    add_actors,
    check_track_ids,
    make_track,
    move_actors,
    shift_track,
)
from augment.scene.scene import Actor, Scene, Track

# Largest number of poses of one actor.
_MAX_POSES = 100_000
# Largest number of entries of a list.
_MAX_ACTORS = 1000
# Largest time, seconds: a year.
_MAX_TIME_S = 3.2e7
# Error of a unit quaternion's length, at most.
_MAX_QUAT_ERROR = 1e-4

_Name = Annotated[Text, Field(min_length=1, max_length=256)]
_Vector = tuple[Number, Number, Number]
_Time = Annotated[Number, Field(ge=-_MAX_TIME_S, le=_MAX_TIME_S)]


class TrackPose(BaseModel):
    """Place of an actor at a time."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    time_s: _Time
    """Seconds from the scene's first frame."""
    position_m: _Vector
    """Centre of the actor's box, dataset's world."""
    yaw_deg: Number | None = None
    """Heading of a level actor, to the left from +x; or give quat_wxyz."""
    quat_wxyz: tuple[Number, Number, Number, Number] | None = None
    """Rotation world_from_actor, a unit quaternion; the actor's x is ahead, y left, z up."""

    @model_validator(mode="after")
    def _has_one_rotation(self) -> Self:
        if (self.yaw_deg is None) == (self.quat_wxyz is None):
            raise ValueError("must have either yaw_deg or quat_wxyz")
        if self.quat_wxyz is not None:
            length = math.sqrt(sum(value * value for value in self.quat_wxyz))
            if abs(length - 1) > _MAX_QUAT_ERROR:
                raise ValueError(f"must have a quat_wxyz of length 1; its length is {length:.6g}")
        return self


class _Motion(BaseModel):
    """Motion of a moved or added actor."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    track_id: _Name
    """Name of the actor."""
    poses: Annotated[list[TrackPose], Field(min_length=1, max_length=_MAX_POSES)] | None = None
    """Places in order of time, in place of the recorded ones; straight lines between them."""
    hold_s: Annotated[Number, Field(ge=0, le=_MAX_TIME_S)] = 0.1
    """How long the actor stays before the first and after the last of the poses, seconds."""
    shift_m: _Vector | None = None
    """Shift of the recorded track: metres ahead, to the left and up, in the actor's own axes."""
    turn_deg: Number = 0.0
    """Turn of the shifted actor to the left about its centre."""

    @model_validator(mode="after")
    def _has_one_motion(self) -> Self:
        if (self.poses is None) == (self.shift_m is None):
            raise ValueError("must have either poses or shift_m")
        if self.poses is not None and self.turn_deg:
            raise ValueError("must have turn_deg with shift_m alone; poses have their own yaw_deg")
        return self


class MovedActor(_Motion):
    """An actor of the scene that goes elsewhere."""


class AddedActor(_Motion):
    """A copy of an actor of this scene or of another one."""

    copy_of: _Name
    """Track id of the actor that is copied."""
    scene: _Name | None = None
    """URI of the scene that has it; null for this scene. A relative path starts at the file."""

    @model_validator(mode="after")
    def _has_poses(self) -> Self:
        if self.scene is not None and self.poses is None:
            raise ValueError("must have poses: tracks of another scene mean nothing in this one")
        return self


class RemovedActor(BaseModel):
    """An actor of the scene that is taken away."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    track_id: _Name
    """Name of the actor."""


class TracksFile(BaseModel):
    """Contents of the file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    move: Annotated[list[MovedActor], Field(max_length=_MAX_ACTORS)] = []
    """Actors that go elsewhere."""
    remove: Annotated[list[RemovedActor], Field(max_length=_MAX_ACTORS)] = []
    """Actors that are taken away."""
    add: Annotated[list[AddedActor], Field(max_length=_MAX_ACTORS)] = []
    """Actors that are added."""

    @model_validator(mode="after")
    def _names_each_once(self) -> Self:
        names = [entry.track_id for entry in (*self.move, *self.remove, *self.add)]
        if not names:
            raise ValueError("must move, remove or add an actor; the lists are empty")
        repeated_names = sorted({name for name in names if names.count(name) > 1})
        if repeated_names:
            raise ValueError(f"must name each track_id once; {repeated_names[0]!r} stands twice")
        return self

    @property
    def summary(self) -> str:
        """Return the numbers of moved, removed and added actors in words."""
        counts = {"moved": self.move, "removed": self.remove, "added": self.add}
        return ", ".join(f"{len(entries)} {name}" for name, entries in counts.items() if entries)


def read_tracks_file(path: Path) -> TracksFile:
    """Read a tracks file.

    Raises:
        AdapterError: there is no such file, it is no JSON, or a field is wrong.
    """
    if not path.is_file():
        raise AdapterError(f"{TRACKS_KEY}={path}: there is no such file; expected a JSON file")
    hint = "docs/scenes.md describes the file"
    return validate_content(TracksFile, read_json(path), str(path), hint=hint)


def with_tracks(
    scene: Scene, path: Path, scene_path: str, open_other: Callable[[str], Scene]
) -> Scene:
    """Return the scene with the actors of a file moved, removed and added.

    Args:
        scene: the scene.
        path: the file.
        scene_path: path of the scene's URI; other scenes may lie beside it.
        open_other: opens another scene by its URI.

    Raises:
        AdapterError: the file cannot be read, names an unknown actor, or another scene that cannot
            be used.
    """
    file = read_tracks_file(path)
    try:
        moved = _apply(scene, file, path, scene_path, open_other)
    except AdapterError:
        raise
    except SceneError as error:
        raise AdapterError(f"{path}: {error}") from None
    problem = f"{file.summary} by {path.name}: {NO_SHADOWS}; {RECORDED_SWEEPS}"
    return dataclasses.replace(
        moved,
        source=add_to_uri(scene.source, TRACKS_KEY, str(path.absolute())),
        problems=(*scene.problems, problem),
    )


def other_scenes(path: Path, scene_path: str) -> Iterator[str]:
    """Yield the URI of each other scene that a file names, once.

    Args:
        path: the file.
        scene_path: path of the scene's URI.

    Raises:
        AdapterError: as `read_tracks_file`, or a scene lies where it may not.
    """
    names = (entry.scene for entry in read_tracks_file(path).add)
    for name in dict.fromkeys(name for name in names if name is not None):
        yield _other_uri(name, path, scene_path)


def _apply(
    scene: Scene, file: TracksFile, path: Path, scene_path: str, open_other: Callable[[str], Scene]
) -> Scene:
    """Return the scene with a file's changes."""
    check_track_ids(scene, [entry.track_id for entry in (*file.move, *file.remove)])
    recorded = {actor.track_id: actor for actor in scene.actors}
    other_scenes_by_name = {
        name: open_other(_other_uri(name, path, scene_path))
        for name in dict.fromkeys(entry.scene for entry in file.add)
        if name is not None
    }
    added = []
    for entry in file.add:
        other = scene if entry.scene is None else other_scenes_by_name[entry.scene]
        _check_same_unit(scene, other)
        check_track_ids(other, [entry.copy_of])
        source = next(actor for actor in other.actors if actor.track_id == entry.copy_of)
        added.append(_added_actor(scene, entry, source))
    moves: dict[str, Track | None] = {
        entry.track_id: _track_of(scene, entry, recorded[entry.track_id]) for entry in file.move
    }
    moves |= {entry.track_id: None for entry in file.remove}
    moved = add_actors(scene, added) if added else scene
    return move_actors(moved, moves) if moves else moved


def _added_actor(scene: Scene, entry: AddedActor, source: Actor) -> Actor:
    """Return the actor of an entry.

    Colours of another scene that change over time stay as they are on average: its times are not
    this scene's.
    """
    is_stranger = entry.scene is not None
    return dataclasses.replace(
        source,
        track_id=entry.track_id,
        track=_track_of(scene, entry, source),
        color_waves=None if is_stranger else source.color_waves,
        copy_of=None if is_stranger else source.track_id,
    )


def _track_of(scene: Scene, entry: _Motion, actor: Actor) -> Track:
    """Return the track of an entry, scene world."""
    if entry.poses is None:
        assert entry.shift_m is not None
        return shift_track(actor.track, entry.shift_m, math.radians(entry.turn_deg))
    frames = scene.frames if scene.seen_frames is None else scene.seen_frames or scene.frames
    first_ns = min((frame.timestamp_ns for frame in frames), default=0)
    poses = [
        (first_ns + round(pose.time_s * 1e9), _matrix(pose, scene.world_origin_m))
        for pose in entry.poses
    ]
    return make_track(poses, f"actor {entry.track_id!r}", hold_ns=round(entry.hold_s * 1e9))


def _matrix(pose: TrackPose, origin_m: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return world_from_actor in the scene's world, float64 [4, 4]."""
    matrix = np.eye(4)
    if pose.quat_wxyz is not None:
        quat = torch.tensor(pose.quat_wxyz, dtype=torch.float64)
        matrix[:3, :3] = rotmat_from_quat(quat).numpy()
    else:
        yaw = math.radians(pose.yaw_deg or 0.0)
        cosine = math.cos(yaw)
        sine = math.sin(yaw)
        matrix[:2, :2] = [[cosine, -sine], [sine, cosine]]
    matrix[:3, 3] = np.array(pose.position_m) - np.asarray(origin_m, np.float64)
    return matrix


def _check_same_unit(scene: Scene, other: Scene) -> None:
    """Refuse an actor of a scene whose unit is another."""
    if scene.has_metric_scale != other.has_metric_scale:
        unknown = other if scene.has_metric_scale else scene
        raise SceneError(
            f"scenes {scene.name!r} and {other.name!r} cannot exchange actors: one unit of "
            f"{unknown.name!r} is not known to be a metre"
        )


def _other_uri(name: str, path: Path, scene_path: str) -> str:
    """Return the URI of another scene.

    It may be built in, or lie in the folder of the file, or in the folder in which the scene lies,
    and its options name no files: a file from elsewhere then opens nothing else of this machine.
    """
    scheme, other_path, query = parse_uri(name)
    where = f"{path}: scene {name!r}"
    if TRACKS_KEY in query:
        raise AdapterError(f"{where} has moved actors itself; take the actor from the recording")
    for key, value in query.items():
        if _may_name_a_file(value):
            raise AdapterError(
                f"{where}: option {key} may name a file, which an actor's scene must not; got "
                f"{value!r}, leave it out"
            )
    dataset = DATASETS.get(scheme or "")
    if dataset is not None and other_path in dataset.builtin:
        return name
    folder = path.absolute().parent
    target = (folder / other_path).resolve()
    roots = [folder.resolve()]
    if Path(scene_path).exists():
        roots.append(Path(scene_path).absolute().parent.resolve())
    if not any(target.is_relative_to(root) for root in roots):
        raise AdapterError(
            f"{where} lies outside of {' and '.join(map(str, roots))}; another scene lies in the "
            f"folder of the tracks file, or beside the scene that is changed"
        )
    if not target.exists():
        raise AdapterError(f"{where}: there is no {target}")
    scheme = scheme or detect_scheme(target)
    if scheme is None:
        raise AdapterError(f"{where}: {describe_unrecognised(target)}. Or name its scheme")
    return format_uri(scheme, target, query)


def _may_name_a_file(value: str) -> bool:
    """Return True if a value of a URI's query may be a path, or exists as one."""
    return "/" in value or "\\" in value or value == ".." or os.path.exists(value)
