"""A drive in Street Gaussians' layout without a trained model: Gaussians from coloured LiDAR.

The world is the one that a model trained on it has. Returns are where they were at their frame's
time, as the converter has it, and so are the boxes.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np

from adapters.lidar.box_tracks import BoxSample, join_tracks
from adapters.lidar.drive_scene import path_of, scene_of, views_of, without_points
from adapters.lidar.options import DriveOptions
from adapters.lidar.scene import build_lidar_scene
from adapters.lidar.split import Sweep
from adapters.street_gaussians.calibration import calibrated_cameras
from adapters.street_gaussians.data import frames_of, read_data
from adapters.street_gaussians.labels import StreetGaussiansLabels, ego_from_boxes
from adapters.street_gaussians.point_clouds import FILE, iterate_point_clouds
from adapters.street_gaussians.records import ModelConfig
from adapters.street_gaussians.tracks import TrackTable, read_track_table, track_files
from adapters.uri import format_uri
from augment.cameras import Frame
from augment.errors import AdapterError
from augment.scene import Scene
from augment.semantics import SemanticClass

# Waymo's uppermost LiDAR looks up by 2.4 degrees; those at the sides see further up, but not far.
_LIDAR_TOP_DEG = 2.4
# The recording car in its own frame, whose origin is below its rear axle, on the ground.
_EGO_LOW_M = np.array([-1.4, -1.15, 0.1])
_EGO_HIGH_M = np.array([4.2, 1.15, 2.4])
_MOVED_M = 1.0  # an object whose boxes lie further apart than this moves
_STANDING = ("sign",)  # classes that never move


def open_raw(root: Path, query: dict[str, str]) -> Scene:
    """The scene of a dataset directory alone.

    query: frames, voxel_m, max_gaussians, image_scale, sky_size, held_out; see DriveOptions.
    Opening is deterministic: the same files and options give the same bits.

    Raises:
        AdapterError: a wrong option; calibration, poses, times or tracks that are missing or
            damaged; no LiDAR or no image of the frames that are not held out.
    """
    options = DriveOptions.from_query("street_gaussians", query)
    cams = calibrated_cameras(root)
    if not cams:
        raise AdapterError(
            f"{root / 'extrinsics'} holds no calibration 0.txt to 4.txt; copy it from the dataset"
        )
    data = read_data(root, ModelConfig(cameras=cams))
    frames = frames_of(data)
    chosen = options.select([f.index for f in frames], where=f"street_gaussians:{root}")
    frames = tuple(frame for frame in frames if frame.index in set(chosen.numbers))
    used = [frame for frame in frames if frame.index not in chosen.held_out]
    if not any(frame.image_paths for frame in used):
        raise AdapterError(
            f"{root / 'images'} holds no usable image of the frames that are not held out "
            f"({used[0].index} to {used[-1].index}); colours cannot be had without them"
        )
    sweeps, problems = _sweeps(root, used)
    table = read_track_table(track_files(root, use_tracker=False)[0])
    tracks = join_tracks(_moving_samples(table, frames))
    built = build_lidar_scene(
        sweeps,
        tracks,
        views_of(used),
        path_of(frames),
        options.scene_options(lidar_top_deg=_LIDAR_TOP_DEG),
    )
    return scene_of(
        built,
        name=root.absolute().name,
        source=format_uri("street_gaussians", root, query),
        frames=frames,
        labels=StreetGaussiansLabels(root),
        world_origin_m=data.world_origin_m,
        problems=data.problems + chosen.problems + problems + without_points(tracks, built),
    )


def _sweeps(root: Path, used: Sequence[Frame]) -> tuple[list[Sweep], tuple[str, ...]]:
    """The usable returns of the frames in the scene's world, without the recording car's own, and a
    sentence where frames have none."""
    by_number = {frame.index: frame for frame in used}
    sweeps = {}
    for number, cloud in iterate_point_clouds(root):
        frame = by_number.get(number)
        if frame is None:
            continue
        own = ((cloud.points > _EGO_LOW_M) & (cloud.points < _EGO_HIGH_M)).all(axis=1)
        points = cloud.points[~own & np.isfinite(cloud.points).all(axis=1)]
        pose = frame.world_from_ego.numpy()
        sweeps[number] = Sweep(
            (points @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32),
            np.full(len(points), frame.timestamp_ns, np.int64),
            np.full(len(points), SemanticClass.UNKNOWN, np.int16),
        )
    if not any(len(sweep) for sweep in sweeps.values()):
        raise AdapterError(
            f"{root / FILE} holds no returns of frames {used[0].index} to {used[-1].index}, or is "
            f"missing; a scene cannot be built without them. Make it with the converter's LiDAR "
            f"step, or give a trained model's folder"
        )
    missing = sorted(set(by_number) - set(sweeps))
    found = [sweeps[number] for number in sorted(sweeps)]
    if not missing:
        return found, ()
    said = f"{root / FILE} lacks {len(missing)} frames, such as {missing[0]}: their points too"
    return found, (said,)


def _moving_samples(table: TrackTable, frames: Sequence[Frame]) -> list[BoxSample]:
    """The boxes of the objects that move within the frames, by frame."""
    samples: list[BoxSample] = []
    for frame in frames:
        rows = np.flatnonzero(table.frames == frame.index)
        poses = frame.world_from_ego.numpy() @ ego_from_boxes(table, rows)
        samples += [
            BoxSample(
                object_id=str(int(table.ids[row])),
                sibling_id=None,
                label=table.labels[row],
                frame=frame.index,
                timestamp_ns=frame.timestamp_ns,
                world_from_box=pose,
                size_m=table.sizes_m[row],
            )
            for row, pose in zip(rows, poses, strict=True)
            if table.labels[row] not in _STANDING
        ]
    moving = _moving_ids(samples)
    return [sample for sample in samples if sample.object_id in moving]


def _moving_ids(samples: Sequence[BoxSample]) -> Collection[str]:
    places: dict[str, list[np.ndarray]] = {}
    for sample in samples:
        places.setdefault(sample.object_id, []).append(sample.world_from_box[:2, 3])
    extents = {name: np.ptp(np.array(xy), axis=0) for name, xy in places.items()}
    return {name for name, extent in extents.items() if np.hypot(*extent) > _MOVED_M}
