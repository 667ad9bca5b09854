"""Scenes whose actors are moved, removed or added, and their labels.

In: a scene, and a track for each actor that goes elsewhere. Out: a scene that renders, measures and
labels like any other. `adapters.tracks_file` reads the tracks from a file; a simulator's requests
state them directly:

    moved = move_actors(scene, {"car-7": carry_track(track, [(time_ns, world_from_actor)])})

A move costs next to nothing: Gaussians are shared, and what does not depend on the places of actors
is computed once for `Scene.as_recorded`. That includes where snow lies and where the ground is wet.
What the recording shows of a moved actor stays where it was: shadows on the ground, LiDAR returns,
photos, wheel tracks in snow.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.errors import ClimateGSError, SceneError
from augment.scene.geometry import quat_from_rotmat
from augment.scene.labels import EGO_VEHICLE, Boxes, LabelSource, LidarSweep
from augment.scene.scene import MAX_EXTENT_M, Actor, Scene, Track

# Largest error of a rotation's matrix product with its transpose: float32 quaternions have 1e-6.
MAX_ROTATION_ERROR = 1e-4
# Time between a frame and the label of one of its boxes, at most, ns: a turn of a LiDAR.
_MAX_LABEL_LAG_NS = 200_000_000
# Distance between a labelled box and the pose of its track at the label's time, at most, metres.
_MAX_LABEL_ERROR_M = 0.05
# What a person is told who moves actors.
NO_SHADOWS = (
    "actors were moved: shadows that the recording shows stay on the ground, and moved or added "
    "actors cast none beyond their own splats"
)
RECORDED_SWEEPS = "LiDAR sweeps show the actors where they were recorded"

# ---- Poses ---------------------------------------------------------------------------------------


def check_pose(pose: object, where: str) -> Float[Tensor, "4 4"]:
    """Return a pose as float64 [4, 4], or refuse it.

    Args:
        pose: the pose, a tensor, an array or nested lists.
        where: names the pose in messages.

    Raises:
        SceneError: it is no rigid transform of finite numbers within the world.
    """
    try:
        matrix = torch.as_tensor(np.asarray(pose, np.float64))
    except (TypeError, ValueError):
        raise SceneError(f"{where}: a pose must be 4x4 numbers; got {pose!r:.80}") from None
    if tuple(matrix.shape) != (4, 4):
        raise SceneError(f"{where}: a pose must be 4x4 numbers; got {list(matrix.shape)}")
    if not bool(torch.isfinite(matrix).all()):
        raise SceneError(f"{where}: a pose must be finite; got {matrix.tolist()}")
    rotation = matrix[:3, :3]
    error = float((rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max())
    last_row = matrix[3].tolist()
    if error > MAX_ROTATION_ERROR or last_row != [0.0, 0.0, 0.0, 1.0]:
        raise SceneError(
            f"{where}: a pose must be rigid, a rotation and a position: its rotation times the "
            f"transpose may differ from the identity by {MAX_ROTATION_ERROR:g}, and its last row "
            f"is 0, 0, 0, 1; got {error:.3g} and {last_row}"
        )
    if float(torch.linalg.det(rotation)) < 0:
        raise SceneError(f"{where}: a pose must be a rotation; this one mirrors")
    if float(matrix[:3, 3].abs().max()) > MAX_EXTENT_M:
        raise SceneError(
            f"{where}: a position must lie within {MAX_EXTENT_M:g} m of the scene's origin; got "
            f"{matrix[:3, 3].tolist()}"
        )
    return matrix


def make_track(
    poses: Sequence[tuple[int, object]], where: str, *, hold_ns: int = 100_000_000
) -> Track:
    """Return the track through poses.

    Args:
        poses: times in ns, strictly increasing, each with world_from_actor [4, 4].
        where: names the actor in messages.
        hold_ns: how long the actor stays before the first and after the last pose.

    Raises:
        SceneError: there is no pose, times do not increase, or a pose is not rigid.
    """
    if not poses:
        raise SceneError(f"{where}: a track needs at least one pose; without one, remove the actor")
    times_ns = [int(time_ns) for time_ns, _ in poses]
    for number, (earlier, later) in enumerate(itertools.pairwise(times_ns), start=1):
        if later <= earlier:
            raise SceneError(
                f"{where}: times of poses must increase; pose {number} has {later} ns after "
                f"{earlier} ns"
            )
    matrices = [check_pose(pose, f"{where}, pose {n}") for n, (_, pose) in enumerate(poses)]
    return Track(torch.tensor(times_ns, dtype=torch.int64), torch.stack(matrices), hold_ns)


def carry_track(track: Track, poses: Sequence[tuple[int, object]], where: str = "actor") -> Track:
    """Return a track that goes exactly through stated poses, with the recorded motion around them.

    A request of a simulator states one moment. Speeds before and after it matter as well: tyres
    throw spray behind them, brake lamps are lit, wheels blur. So the recorded track is carried
    rigidly to the first pose for the time before, and to the last pose for the time after. Where
    the actor was not recorded at that time, it stands still.

    Args:
        track: the recorded track.
        poses: times in ns, strictly increasing, each with world_from_actor [4, 4]: one, or those at
            the start and the end of an exposure.
        where: names the actor in messages.

    Raises:
        SceneError: as `make_track`.
    """
    stated = make_track(poses, where, hold_ns=track.hold_ns)
    first_ns = int(stated.timestamps_ns[0])
    last_ns = int(stated.timestamps_ns[-1])
    is_before = track.timestamps_ns < first_ns
    is_after = track.timestamps_ns > last_ns
    times = [stated.timestamps_ns]
    matrices = [stated.world_from_actor]
    start_pose = track.pose_at(first_ns)
    end_pose = track.pose_at(last_ns)
    if start_pose is not None:
        carry = stated.world_from_actor[0] @ torch.linalg.inv(start_pose)
        times.insert(0, track.timestamps_ns[is_before])
        matrices.insert(0, carry @ track.world_from_actor[is_before])
    if end_pose is not None:
        carry = stated.world_from_actor[-1] @ torch.linalg.inv(end_pose)
        times.append(track.timestamps_ns[is_after])
        matrices.append(carry @ track.world_from_actor[is_after])
    return replace(track, timestamps_ns=torch.cat(times), world_from_actor=torch.cat(matrices))


def shift_track(track: Track, shift_m: Sequence[float], turn_rad: float = 0.0) -> Track:
    """Return a track that is moved and turned in the actor's own frame at every moment.

    Args:
        track: the track.
        shift_m: metres forward, to the left and up.
        turn_rad: turn to the left about the actor's centre, radians.
    """
    shift = torch.eye(4, dtype=torch.float64)
    cosine = math.cos(turn_rad)
    sine = math.sin(turn_rad)
    shift[:2, :2] = torch.tensor([[cosine, -sine], [sine, cosine]], dtype=torch.float64)
    shift[:3, 3] = torch.tensor(shift_m, dtype=torch.float64)
    return replace(track, world_from_actor=track.world_from_actor.double() @ shift)


# ---- Scenes --------------------------------------------------------------------------------------


def move_actors(scene: Scene, tracks: Mapping[str, Track | None]) -> Scene:
    """Return the scene with some actors on other tracks.

    All other actors stay on the tracks that they have. Instance numbers stay those of the scene: a
    removed actor keeps its number, and is absent at all times.

    Args:
        scene: the scene, recorded or moved before.
        tracks: the new track of each actor that goes elsewhere, in the scene's world; None removes
            the actor.

    Raises:
        SceneError: the scene has no such actor.
    """
    check_track_ids(scene, tracks)
    actors = tuple(
        replace(actor, track=tracks[actor.track_id] or actor.track.as_absent())
        if actor.track_id in tracks
        else actor
        for actor in scene.actors
    )
    return _with_actors(scene, actors, _recorded_tracks(scene))


def add_actors(scene: Scene, actors: Sequence[Actor]) -> Scene:
    """Return the scene with further actors.

    Their Gaussians lie in their own frames, their tracks in this scene's world. Snow on them, below
    them and in their wheel tracks is that of recorded vehicles on these tracks. `Actor.copy_of`
    names the actor of this scene that one is a copy of; the trust mask then knows which of its
    sides were recorded.

    Args:
        scene: the scene, recorded or moved before.
        actors: the actors to add.

    Raises:
        SceneError: two actors would have one name.
    """
    names = [actor.track_id for actor in (*scene.actors, *actors)]
    for actor in actors:
        if names.count(actor.track_id) > 1:
            raise SceneError(
                f"scene {scene.name!r}: two actors would be called {actor.track_id!r}; give the "
                f"added one a name of its own"
            )
    return _with_actors(scene, (*scene.actors, *actors), _recorded_tracks(scene))


def check_track_ids(scene: Scene, track_ids: Collection[str]) -> None:
    """Refuse track ids that no actor of the scene has.

    Raises:
        SceneError: names the unknown track and the known ones.
    """
    movable_ids = [actor.track_id for actor in scene.actors if actor.label != EGO_VEHICLE]
    for track_id in track_ids:
        if track_id in movable_ids:
            continue
        num_more = len(movable_ids) - 8
        listed = ", ".join(movable_ids[:8]) + (f" and {num_more} more" if num_more > 0 else "")
        raise SceneError(
            f"scene {scene.name!r} has no actor {track_id!r} that could be moved; it has "
            f"{listed or 'none'}. Vehicles that never move are part of the background and stay"
        )


def _recorded_tracks(scene: Scene) -> dict[str, Track]:
    """Return the recorded track of each recorded actor, by track id."""
    recorded = scene if scene.recorded is None else scene.recorded
    return {actor.track_id: actor.track for actor in recorded.actors if not actor.track.is_absent}


def _with_actors(
    scene: Scene, actors: tuple[Actor, ...], recorded_tracks: Mapping[str, Track]
) -> Scene:
    """Return the scene with other actors.

    Args:
        scene: the scene.
        actors: all its actors, on their new tracks.
        recorded_tracks: recorded track of each recorded actor.
    """
    base = scene if scene.recorded is None else scene.recorded
    if len(actors) > len(base.actors):
        absent = tuple(
            replace(actor, track=actor.track.as_absent()) for actor in actors[len(base.actors) :]
        )
        base = replace(base, actors=(*base.actors, *absent))
    labels = base.labels
    if labels is not None:
        labels = MovedLabels(
            source=labels,
            frame_times_ns={f.index: f.timestamp_ns for f in (base.seen_frames or base.frames)}
            | {f.index: f.timestamp_ns for f in base.frames},
            actors=tuple(
                _LabelledActor(
                    actor.track_id,
                    actor.label,
                    actor.size_m,
                    recorded_tracks.get(actor.track_id),
                    actor.track,
                )
                for actor in actors
                if actor.track is not recorded_tracks.get(actor.track_id)
            ),
            world_origin_m=np.asarray(base.world_origin_m, np.float64),
        )
    return replace(scene, actors=actors, labels=labels, recorded=base)


# ---- Labels --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _LabelledActor:
    """A moved, removed or added actor, as labels need it."""

    track_id: str
    """Track of the actor."""
    label: str
    """Name of its kind in the dataset."""
    size_m: tuple[float, float, float]
    """Length, width and height, metres."""
    recorded_track: Track | None
    """Recorded track; None for an added actor."""
    track: Track
    """Track in the moved scene."""


@dataclass(frozen=True, eq=False)
class MovedLabels:
    """Labels of a scene with moved actors.

    Boxes of moved actors are where the actors are. Sweeps are the recorded ones.
    """

    source: LabelSource
    """Reader of the recorded labels."""
    frame_times_ns: Mapping[int, int]
    """Time of each frame, by number."""
    actors: tuple[_LabelledActor, ...]
    """The actors that are elsewhere than recorded."""
    world_origin_m: np.ndarray
    """Offset of the scene's world from the dataset's, float64 [3]."""

    def boxes(self, frame_index: int) -> Boxes:
        """Return the boxes of a frame: those that were not moved, then the others.

        A moved actor has a box wherever it exists at the frame's time, if any frame has a box of
        it. Its size is that of its recorded box. An added actor always has a box; the dataset's
        attributes say nothing of it.
        """
        boxes = self.source.boxes(frame_index)
        rows_of_track = {track_id: row for row, track_id in enumerate(boxes.track_ids)}
        moved_ids = {actor.track_id for actor in self.actors}
        remaining = [row for row, name in enumerate(boxes.track_ids) if name not in moved_ids]
        parts = [_select_boxes(boxes, remaining)]
        for actor in self.actors:
            row = rows_of_track.get(actor.track_id)
            time_ns = self._label_time(actor, frame_index, boxes, row)
            pose = None if time_ns is None else actor.track.pose_at(time_ns)
            if pose is not None:
                example = _select_boxes(boxes, [row]) if row is not None else None
                box = self._box_of(actor, frame_index, example, pose)
                parts += [] if box is None else [box]
        return _join_boxes(parts)

    def lidar(self, frame_index: int) -> LidarSweep | None:
        """Return the recorded sweep of a frame."""
        return self.source.lidar(frame_index)

    def _label_time(
        self, actor: _LabelledActor, frame_index: int, boxes: Boxes, row: int | None
    ) -> int | None:
        """Return the time at which a frame's label shows an actor; None for an unknown frame.

        A spinning LiDAR meets each object at its own time, which the recorded box tells: the
        track's sample that lies on it. Otherwise it is the frame's time.
        """
        frame_ns = self.frame_times_ns.get(frame_index)
        track = actor.recorded_track
        if row is None or track is None or frame_ns is None:
            return frame_ns
        centre = torch.from_numpy(boxes.centers_m[row] - self.world_origin_m)
        lags_ns = (track.timestamps_ns - frame_ns).abs()
        errors_m = (track.world_from_actor[:, :3, 3].double() - centre).norm(dim=1)
        fits = (lags_ns <= _MAX_LABEL_LAG_NS) & (errors_m <= _MAX_LABEL_ERROR_M)
        if not bool(fits.any()):
            return frame_ns
        lags_ns = torch.where(fits, lags_ns, torch.iinfo(torch.int64).max)
        return int(track.timestamps_ns[int(lags_ns.argmin())])

    def _box_of(
        self, actor: _LabelledActor, frame_index: int, example: Boxes | None, pose: Tensor
    ) -> Boxes | None:
        """Return the box of an actor at a pose; None for one that the dataset never labels.

        Args:
            actor: the actor.
            frame_index: number of the frame.
            example: recorded box of the same actor; None looks for one in the nearest frame.
            pose: world_from_actor, scene world.
        """
        is_added = actor.recorded_track is None
        if is_added:
            example = _box_without_attributes(self._columns, actor)
        elif example is None:
            example = self._example_of(actor.track_id, frame_index)
        if example is None:
            return None
        size_m = np.array(actor.size_m)[None] if is_added else example.sizes_m
        quat = quat_from_rotmat(pose[None, :3, :3].double()).numpy()
        return replace(
            example,
            track_ids=(actor.track_id,),
            centers_m=pose[None, :3, 3].double().numpy() + self.world_origin_m,
            sizes_m=size_m.astype(np.float64),
            quats=quat,
        )

    def _example_of(self, track_id: str, frame_index: int) -> Boxes | None:
        """Return the recorded box of a track in the frame nearest to a frame; None without one."""
        frames = self._frames_of_track.get(track_id)
        if not frames:
            return None
        nearest = min(frames, key=lambda index: (abs(index - frame_index), index))
        boxes = self.source.boxes(nearest)
        return _select_boxes(boxes, [boxes.track_ids.index(track_id)])

    @cached_property
    def _frames_of_track(self) -> dict[str, list[int]]:
        """Return the numbers of the frames that label each moved actor."""
        track_ids = {actor.track_id for actor in self.actors if actor.recorded_track is not None}
        frames: dict[str, list[int]] = {track_id: [] for track_id in track_ids}
        for index in self.frame_times_ns:
            try:
                box_ids = self.source.boxes(index).track_ids
            except ClimateGSError:  # an error of that frame's own images
                continue
            for track_id in track_ids.intersection(box_ids):
                frames[track_id].append(index)
        return frames

    @cached_property
    def _columns(self) -> dict[str, np.dtype]:
        """Return the attributes of the dataset's boxes, and their types."""
        for index in self.frame_times_ns:
            try:
                boxes = self.source.boxes(index)
            except ClimateGSError:
                continue
            if boxes.attributes:
                return {name: np.asarray(v).dtype for name, v in boxes.attributes.items()}
        return {}

    def __getstate__(self) -> dict[str, object]:
        """Return the fields only."""
        fields = ("source", "frame_times_ns", "actors", "world_origin_m")
        return {name: getattr(self, name) for name in fields}


def _select_boxes(boxes: Boxes, rows: Sequence[int]) -> Boxes:
    """Return some boxes, in the order of their rows."""
    index = np.array(rows, np.int64)
    return Boxes(
        track_ids=tuple(boxes.track_ids[row] for row in rows),
        labels=tuple(boxes.labels[row] for row in rows),
        centers_m=boxes.centers_m[index],
        sizes_m=boxes.sizes_m[index],
        quats=boxes.quats[index],
        attributes={name: np.asarray(v)[index] for name, v in boxes.attributes.items()},
    )


def _join_boxes(parts: Sequence[Boxes]) -> Boxes:
    """Return the boxes of all parts. Attributes are those of the first part that has any."""
    columns = next((part.attributes for part in parts if part.attributes), {})
    attributes = {
        name: np.concatenate(
            [_column(part, name, np.asarray(values).dtype) for part in parts if len(part)]
            or [np.asarray(values)[:0]]
        )
        for name, values in columns.items()
    }
    return Boxes(
        track_ids=tuple(track_id for part in parts for track_id in part.track_ids),
        labels=tuple(label for part in parts for label in part.labels),
        centers_m=np.concatenate([part.centers_m for part in parts]),
        sizes_m=np.concatenate([part.sizes_m for part in parts]),
        quats=np.concatenate([part.quats for part in parts]),
        attributes=attributes,
    )


def _column(boxes: Boxes, name: str, dtype: np.dtype) -> np.ndarray:
    """Return an attribute of boxes; unknown values where they lack it."""
    if name in boxes.attributes:
        return np.asarray(boxes.attributes[name])
    return _unknown_values(dtype, len(boxes))


def _unknown_values(dtype: np.dtype, count: int) -> np.ndarray:
    """Return values that say nothing: None, NaN, an empty text, 0 or False."""
    if dtype.kind == "O":
        return np.full(count, None, object)
    return np.full(count, np.nan, dtype) if dtype.kind == "f" else np.zeros(count, dtype)


def _box_without_attributes(columns: Mapping[str, np.dtype], actor: _LabelledActor) -> Boxes:
    """Return a box, still without place, of an actor that the dataset does not know."""
    return Boxes(
        track_ids=(actor.track_id,),
        labels=(actor.label,),
        centers_m=np.zeros((1, 3)),
        sizes_m=np.zeros((1, 3)),
        quats=np.zeros((1, 4)),
        attributes={name: _unknown_values(dtype, 1) for name, dtype in columns.items()},
    )
