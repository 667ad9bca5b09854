"""A raw PandaSet sequence as a scene: Gaussians from accumulated, image-coloured LiDAR.

World: PandaSet's own, unless the drive is further than a kilometre from its origin. Ego: the LiDAR
pose turned by a quarter about z, so that x is forward, y left, z up; its origin is the pose's. One
actor stands for each moving object, whichever sensor's boxes it has; its track_id is the one that
the object's boxes have in the labels.
"""

from __future__ import annotations

from pathlib import Path

import torch

from adapters.lidar.box_tracks import join_tracks
from adapters.lidar.drive_scene import path_of, scene_of, views_of
from adapters.lidar.options import DriveOptions
from adapters.lidar.scene import build_lidar_scene
from adapters.pandaset.files import CameraTrack, Sequence, read_sequence
from adapters.pandaset.labels import PandaSetLabels
from adapters.pandaset.sweeps import read_drive
from adapters.uri import format_uri
from augment.cameras import Camera, Frame
from augment.errors import AdapterError
from augment.geometry import invert_rigid
from augment.scene import Scene

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
            Missing LiDAR or annotation files and images of single frames are Scene.problems.
    """
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
    built = build_lidar_scene(
        drive.sweeps,
        join_tracks(drive.samples),
        views_of((f for f in frames if f.index not in chosen.held_out), _ROWS_ABOVE_CAR),
        path_of(frames),
        options.scene_options(lidar_top_deg=_LIDAR_TOP_DEG),
    )
    return scene_of(
        built,
        name=Path(path).name,
        source=format_uri("pandaset", path, query),
        frames=frames,
        labels=PandaSetLabels(Path(path)),
        world_origin_m=sequence.world_origin_m,
        problems=sequence.problems + chosen.problems + drive.problems,
    )


def _frame(sequence: Sequence, number: int) -> Frame:
    cameras = {track.name: _camera(track, number) for track in sequence.cameras}
    paths = {track.name: track.images[number] for track in sequence.cameras}
    return Frame(
        index=number,
        timestamp_ns=int(sequence.timestamps_ns[number]),
        world_from_ego=torch.from_numpy(sequence.world_from_ego[number].copy()),
        cameras=cameras,
        image_paths={name: str(path) for name, path in paths.items() if path is not None},
    )


def _camera(track: CameraTrack, number: int) -> Camera:
    return Camera(
        name=track.name,
        width=track.width,
        height=track.height,
        fx=track.fx,
        fy=track.fy,
        cx=track.cx,
        cy=track.cy,
        camera_from_world=invert_rigid(torch.from_numpy(track.world_from_camera[number])),
        timestamp_ns=int(track.timestamps_ns[number]),
    )
