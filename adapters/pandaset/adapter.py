"""A raw PandaSet sequence as a scene: Gaussians from accumulated, image-coloured LiDAR.

World: PandaSet's own, unless the drive is further than a kilometre from its origin. Ego: the LiDAR
pose turned by a quarter about z, so that x is forward, y left, z up; its origin is the pose's. One
actor stands for each moving object, whichever sensor's boxes it has; its track_id is the one that
the object's boxes have in the labels.
"""

from __future__ import annotations

from collections.abc import Collection
from collections.abc import Sequence as Seq
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from tqdm import tqdm

from adapters.lidar_scene.scene import build_lidar_scene, views_of
from adapters.lidar_scene.split import indices_between, inside_box, join_tracks
from adapters.pandaset.files import (
    Objects,
    PandaSetLabels,
    Sequence,
    boxes_of_cuboids,
    read_cuboids,
    read_lidar,
    read_objects,
    read_semantics,
    read_sequence,
    semantic_table,
    sensors_of,
)
from adapters.raw_drive import (
    NO_SURFACE,
    BoxSample,
    DriveOptions,
    Sweep,
    is_in_box,
    objects_that_travel,
)
from adapters.uri import format_uri
from augment.cameras import Camera, Frame
from augment.errors import AdapterError
from augment.geometry import invert_rigid, rotmat_from_quat
from augment.scene import Scene
from augment.semantics import SemanticClass

# The recording car in its own frame (x forward, y left, z up): no other surface can be in there.
EGO_LOW_M = np.array([-3.0, -1.05, -1.0])
EGO_HIGH_M = np.array([3.0, 1.05, 2.2])
_TIMING_MARGIN_M = 0.25  # returns this near a box tell when its sensor saw the object
_LIDAR_TOP_DEG = 15.0  # the spinning sensor's uppermost channel
# The back camera looks over the recording car's own roof, the same in every PandaSet sequence:
# from this part of its rows downwards.
_ROWS_ABOVE_CAR = {"back_camera": 0.745}


def open_pandaset(path: str, query: dict[str, str]) -> Scene:
    """The scene of one PandaSet sequence folder, such as `pandaset/002`.

    query: frames, voxel_m, max_gaussians, image_scale, sky_size, held_out; see DriveOptions.
    Opening is deterministic: the same files and options give the same bits.

    Raises:
        AdapterError: a wrong option, missing or damaged calibration, a damaged table, or no LiDAR.
            Missing LiDAR or annotation files and images of single frames are Scene.problems."""
    options = DriveOptions.from_query("pandaset", query)
    sequence = read_sequence(Path(path))
    chosen = options.select(range(len(sequence)), where=f"pandaset:{path}")
    drive = read_drive(sequence, chosen.numbers, held_out=chosen.held_out)
    if sum(len(sweep) for sweep in drive.sweeps) == 0:
        raise AdapterError(
            f"{Path(path) / 'lidar'} holds no returns for frames {chosen.used[0]} to "
            f"{chosen.used[-1]}; a scene cannot be built without them, unpack the sequence again"
        )
    frames = tuple(_frame(sequence, number) for number in chosen.numbers)
    return build_lidar_scene(
        drive.sweeps,
        join_tracks(drive.samples),
        views_of((f for f in frames if f.index not in chosen.held_out), _ROWS_ABOVE_CAR),
        options,
        lidar_top_deg=_LIDAR_TOP_DEG,
        name=Path(path).name,
        source=format_uri("pandaset", path, query),
        frames=frames,
        labels=PandaSetLabels(Path(path)),
        world_origin_m=sequence.world_origin_m,
        problems=sequence.problems + chosen.problems + drive.problems,
    )


def _frame(sequence: Sequence, number: int) -> Frame:
    paths = {track.name: track.images[number] for track in sequence.cameras}
    return Frame(
        index=number,
        timestamp_ns=int(sequence.timestamps_ns[number]),
        world_from_ego=torch.from_numpy(sequence.world_from_ego[number].copy()),
        cameras={
            track.name: Camera(
                track.name,
                *track.size,
                *track.lens,
                camera_from_world=invert_rigid(torch.from_numpy(track.world_from_camera[number])),
                timestamp_ns=int(track.timestamps_ns[number]),
            )
            for track in sequence.cameras
        },
        image_paths={name: str(path) for name, path in paths.items() if path is not None},
    )


@dataclass(frozen=True, eq=False)
class Drive:
    """What the sensors and annotators saw, in the scene's world.

    sweeps: one a frame that has a file and is not held out. samples: the boxes of moving objects,
    in order of frames."""

    sweeps: tuple[Sweep, ...]
    samples: tuple[BoxSample, ...]
    problems: tuple[str, ...]


def read_drive(
    sequence: Sequence, frames: Seq[int], *, held_out: Collection[int] = frozenset()
) -> Drive:
    """Sweeps and moving boxes of the frames; missing files of single frames are problems. Left out
    are returns of smoke, exhaust, spray, mirror images and the recording car.

    held_out: frames whose sweeps only tell when their boxes were seen, so that tracks stay
    whole."""
    table = semantic_table(sequence.root)
    sweeps, samples, problems = [], [], []
    cuboids = {frame: read_cuboids(sequence.root, frame) for frame in frames}
    objects = read_objects(sequence.root)
    moving = _moving_objects([c for c in cuboids.values() if c is not None], objects)
    for frame in tqdm(frames, desc="LiDAR", unit="frame", disable=None):
        lidar = read_lidar(sequence.root, frame)
        if lidar is None:
            problems.append(f"frame {frame}: lidar/{frame:02d}.pkl.gz is missing, its points too")
        else:
            raw = _RawSweep.of(sequence, frame, lidar, table)
            if raw.unlabelled:
                problems.append(
                    f"frame {frame}: annotations/semseg/{frame:02d}.pkl.gz is missing; "
                    f"its points have no class"
                )
            if frame not in held_out:
                sweeps.append(raw.usable())
        boxes = cuboids[frame]
        if boxes is None:
            problems.append(
                f"frame {frame}: annotations/cuboids/{frame:02d}.pkl.gz is missing; "
                f"moving objects are interpolated"
            )
            continue
        seen = None if lidar is None else raw
        samples += _samples(boxes, frame, moving, objects, seen, sequence)
    return Drive(tuple(sweeps), tuple(samples), tuple(problems))


@dataclass(frozen=True, eq=False)
class _RawSweep:
    points: np.ndarray  # float32 [N, 3], scene world
    timestamps_ns: np.ndarray
    semantic: np.ndarray  # int16 [N], NO_SURFACE included
    sensor: np.ndarray
    of_ego: np.ndarray  # bool [N]
    unlabelled: bool

    @staticmethod
    def of(sequence: Sequence, frame: int, lidar: pd.DataFrame, table: np.ndarray) -> _RawSweep:
        world = lidar[["x", "y", "z"]].to_numpy(dtype=np.float64) - sequence.world_origin_m
        pose = sequence.world_from_ego[frame]
        ego = (world - pose[:3, 3]) @ pose[:3, :3]
        classes = read_semantics(sequence.root, frame, len(lidar))
        if classes is None:
            semantic = np.full(len(lidar), SemanticClass.UNKNOWN, dtype=np.int16)
        else:
            semantic = table[np.clip(classes, 0, len(table) - 1)]
        return _RawSweep(
            points=world.astype(np.float32),
            timestamps_ns=np.round(lidar["t"].to_numpy(dtype=np.float64) * 1e9).astype(np.int64),
            semantic=semantic,
            sensor=lidar["d"].to_numpy(),
            of_ego=is_in_box(ego, EGO_LOW_M, EGO_HIGH_M),
            unlabelled=classes is None,
        )

    def usable(self) -> Sweep:
        keep = ~self.of_ego & (self.semantic != NO_SURFACE) & np.isfinite(self.points).all(axis=1)
        return Sweep(self.points[keep], self.timestamps_ns[keep], self.semantic[keep])


def _moving_objects(tables: Seq[pd.DataFrame], objects: Objects) -> set[str]:
    """Names of objects that are labelled moving, or that travel although labelled stationary."""
    moving: set[str] = set()
    places: list[tuple[str, np.ndarray]] = []
    for table in tables:
        uuids = table["uuid"].astype(str)
        moving |= set(uuids[~table["stationary"].astype(bool)])
        xy = table[["position.x", "position.y"]].to_numpy(dtype=np.float64)
        places += zip(uuids, xy, strict=True)
    return {objects.names[uuid] for uuid in moving | objects_that_travel(places)}


def _samples(
    table: pd.DataFrame,
    frame: int,
    moving: set[str],
    objects: Objects,
    seen: _RawSweep | None,
    sequence: Sequence,
) -> list[BoxSample]:
    """The boxes of moving objects, both sensors' under the object's name."""
    table = table[[objects.names[str(uuid)] in moving for uuid in table["uuid"]]]
    if len(table) == 0:
        return []
    boxes = boxes_of_cuboids(table)
    rotations = rotmat_from_quat(torch.from_numpy(boxes.quats)).numpy()
    sensors = sensors_of(table)
    out = []
    for i in range(len(boxes)):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotations[i], boxes.centers_m[i] - sequence.world_origin_m
        time = int(sequence.timestamps_ns[frame])
        if seen is not None:
            time = _time_seen(seen, pose, boxes.sizes_m[i], sensors[i], sequence, frame, time)
        name = objects.names[boxes.track_ids[i]]
        out.append(BoxSample(name, None, boxes.labels[i], frame, time, pose, boxes.sizes_m[i]))
    return out


def _time_seen(
    sweep: _RawSweep,
    pose: np.ndarray,
    size_m: np.ndarray,
    sensor: int,
    sequence: Sequence,
    frame: int,
    otherwise: int,
) -> int:
    """When the box's sensor saw it, as boxes were drawn around returns of 0.1 s: the median time of
    its returns in the box, else the time of the return of nearest bearing from the car."""
    reach = float(np.linalg.norm(size_m))
    near = indices_between(sweep.points, pose[:3, 3] - reach, pose[:3, 3] + reach)
    if sensor >= 0:
        near = near[sweep.sensor[near] == sensor]
    local = (sweep.points[near] - pose[:3, 3]) @ pose[:3, :3]
    inside = near[inside_box(local, size_m, _TIMING_MARGIN_M)]
    if len(inside):
        return int(np.sort(sweep.timestamps_ns[inside])[len(inside) // 2])
    finite = np.isfinite(sweep.points[:, 0])
    ofs = finite & (sweep.sensor == sensor) if (sweep.sensor == sensor).any() else finite
    if not ofs.any():
        return otherwise
    origin = sequence.world_from_ego[frame][:2, 3]
    to_points = sweep.points[ofs, :2] - origin
    to_box = pose[:2, 3] - origin
    cosine = (to_points @ to_box) / np.maximum(np.linalg.norm(to_points, axis=1), 1e-6)
    return int(sweep.timestamps_ns[ofs][np.argmax(cosine)])
