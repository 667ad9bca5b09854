"""A folder of raw data in this project's own layout as a scene: one's own recording, or what
`climategs render` wrote.

    images/<camera>/<frame>.png|jpg    required, with calibration.json
    lidar/<frame>.parquet              columns x y z (metres, world); timestamp_ns or t, semantic
    depth/<camera>/<frame>.png         where there is no LiDAR: 16 bits, metres x 256, 0 = none
    labels/boxes.parquet               boxes; those that move become actors

Everything is in one world, as calibration.json has it: metres, z up. docs/scenes.md has examples.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from adapters.join import join_gaussians
from adapters.lidar.box_tracks import join_tracks
from adapters.lidar.drive_scene import path_of, scene_of, views_of, without_points
from adapters.lidar.options import DriveOptions
from adapters.lidar.scene import LidarScene, LidarSceneOptions, build_lidar_scene
from adapters.lidar.split import Sweep
from adapters.recording.calibration import CALIBRATION, Calibration, read_calibration
from adapters.recording.depth_images import depth_sweeps
from adapters.recording.files import find_images, unlisted_images
from adapters.recording.guesses import (
    MOST_GAUSSIANS,
    SHELL_SHARE,
    VOXEL_M,
    check_cameras_above,
    ground_heights,
    guess_shells,
    guess_surfaces,
)
from adapters.recording.labels import RecordingLabels, all_boxes
from adapters.recording.sweeps import read_lidar_drive
from adapters.recording.tracks import RecordedObjects, read_objects
from adapters.uri import format_uri
from augment.cameras import Frame
from augment.errors import AdapterError
from augment.ground import Ground
from augment.scene import Scene

_FEWEST_RETURNS = 100  # no surface is found among fewer
_DEPTH_TOP_DEG = 90.0  # what a depth image leaves open has no surface, however high it is
_SKY_ABOVE_DEG = 15.0  # with nothing but a flat ground drawn, every column's top is sky


def open_recording(path: str, query: dict[str, str]) -> Scene:
    """The scene of a recording's folder, such as `out/street-seed3/clear-000`.

    query: frames, voxel_m, max_gaussians, image_scale, sky_size, held_out; see DriveOptions.
    Opening is deterministic: the same files and options give the same bits. Without LiDAR the
    scene starts from depth images, or else from guesses; Scene.problems says which.

    Raises:
        AdapterError: a wrong option; calibration that is missing, damaged or not finite; no usable
            image; a damaged LiDAR file or table of boxes; a file outside the folder.
    """
    options = DriveOptions.from_query("recording", query)
    root = Path(path)
    if not root.is_dir():
        raise AdapterError(f"{root} is not a folder; expected one with calibration.json in it")
    calibration = read_calibration(root)
    numbers = [frame.index for frame in calibration.frames]
    chosen = options.select(numbers, where=f"recording:{path}")
    listed = [frame for frame in calibration.frames if frame.index in set(chosen.numbers)]
    frames, image_problems = find_images(root, listed)
    used = [frame for frame in frames if frame.index not in chosen.held_out]
    if not any(frame.image_paths for frame in used):
        raise AdapterError(
            f"{root / 'images'} holds no usable image of the frames that are not held out "
            f"({used[0].index} to {used[-1].index}); colours cannot be had without them"
        )
    objects = read_objects(frames, all_boxes(root), calibration.world_origin_m)
    start = _Start(root, calibration, options, frames, used, objects)
    built, problems = start.build()
    if len(built.background) + len(built.actors) == 0:
        raise AdapterError(
            f"{root}: none of the points that were measured is in any image; check in "
            f"calibration.json that camera axes are x right, y down, z forward, and that LiDAR "
            f"and poses are in one world with z up"
        )
    return scene_of(
        built,
        name=calibration.name,
        source=format_uri("recording", path, query),
        frames=frames,
        labels=RecordingLabels(root),
        world_origin_m=calibration.world_origin_m,
        has_metric_scale=calibration.has_metric_scale,
        problems=(
            *unlisted_images(root, calibration.frames),
            *image_problems,
            *chosen.problems,
            *objects.problems,
            *problems,
        ),
    )


@dataclass(frozen=True, eq=False)
class _Start:
    """What a scene is built from. frames: all; used: those that are not held out."""

    root: Path
    calibration: Calibration
    options: DriveOptions
    frames: Sequence[Frame]
    used: Sequence[Frame]
    objects: RecordedObjects

    def build(self) -> tuple[LidarScene, tuple[str, ...]]:
        """The scene from the best there is, and what was missing, one sentence each."""
        lidar = read_lidar_drive(self.root, self.calibration, self.used)
        if len(lidar) >= _FEWEST_RETURNS:
            return self._surfaces(lidar.sweeps, lidar.top_deg), lidar.problems
        sweeps, problems = depth_sweeps(self.root, self.used)
        problems = lidar.problems + problems
        if any(len(sweep) for sweep in sweeps):
            said = (
                f"{self.root / 'lidar'} holds {len(lidar) or 'no'} returns: the scene starts from "
                f"the points of {len(sweeps)} depth images"
            )
            return self._surfaces(sweeps, _DEPTH_TOP_DEG), (*problems, said)
        said = (
            f"{self.root / 'lidar'} holds {len(lidar) or 'no'} returns and {self.root / 'depth'} "
            f"no depth: the scene starts from a flat ground "
            f"{self.calibration.ego_above_ground_m:g} m below the ego origin, the labelled boxes, "
            f"and splats guessed along the cameras' rays; reconstruct it before rendering it"
        )
        return self._guess(), (*problems, said)

    def _surfaces(self, sweeps: Sequence[Sweep], top_deg: float) -> LidarScene:
        return self._built(sweeps, self.options.scene_options(lidar_top_deg=top_deg))

    def _guess(self) -> LidarScene:
        road = ground_heights(self.frames, self.calibration.ego_above_ground_m)
        check_cameras_above(self.root / CALIBRATION, self.frames, road)
        most = min(MOST_GAUSSIANS, self.options.max_gaussians)
        shells = guess_shells(views_of(self.used), road, round(most * SHELL_SHARE))
        coarse = dataclasses.replace(
            self.options.scene_options(lidar_top_deg=_SKY_ABOVE_DEG),
            voxel_m=max(VOXEL_M, self.options.voxel_m),
            max_gaussians=most - len(shells),
        )
        sweeps = guess_surfaces(road, self.objects.moving, self.objects.still)
        built = self._built(sweeps, coarse)
        # Whatever was found in the guessed surfaces is the height they were given.
        assumed = Ground(float(road[:, 2].min()), float(np.median(road[:, 2])), "ego path")
        return dataclasses.replace(
            built,
            background=join_gaussians([built.background, shells]),
            ground_z_m=assumed.lowest_z_m,
            ground=assumed,
        )

    def _built(self, sweeps: Sequence[Sweep], options: LidarSceneOptions) -> LidarScene:
        tracks = join_tracks(self.objects.moving)
        views, path = views_of(self.used), path_of(self.frames)
        built = build_lidar_scene(sweeps, tracks, views, path, options)
        return dataclasses.replace(
            built, problems=(*built.problems, *without_points(tracks, built))
        )
