"""Depth beyond the LiDAR's view, measured by hiding what the LiDAR saw highest.

The returns above an elevation are taken out of every sweep of a drive. The scene is built of the
rest. Its depth at the pixels of the hidden returns is then compared with them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np

from adapters.lidar_scene.depth import project_points
from adapters.raw_drive import RawDrive
from adapters.training_views.depth_priors import is_visible_return
from augment.render.buffers import ALPHA, MEDIAN_DEPTH
from augment.render.constants import SURFACE_ALPHA
from augment.render.rasterize import rasterize
from augment.scene.cameras import Frame
from augment.scene.scene import Scene

# Columns of the images that are compared.
_WIDTH = 480
# Smallest distance of returns whose elevation counts, metres: nearer ones are the car's own.
_FROM_M = 5.0
# Smallest depth of a return that a camera sees, metres.
_NEAR_M = 0.5


def hide_top_returns(drive: RawDrive, share: float) -> tuple[RawDrive, dict[int, np.ndarray]]:
    """Return the drive without its highest returns, and these, float64 [N, 3], by frame.

    Args:
        drive: a drive with one sweep for each used frame.
        share: part of the returns beyond 5 m that stays; the elevation is the median over frames,
            as the cameras see it.
    """
    frames = drive.used
    if len(frames) != len(drive.sweeps):
        raise ValueError(f"expected a sweep a frame; got {len(drive.sweeps)} for {len(frames)}")
    elevations = []
    tops = []
    for frame, sweep in zip(frames, drive.sweeps, strict=True):
        eye = np.mean([camera.centre.numpy() for camera in frame.cameras.values()], axis=0)
        offset = sweep.points - eye
        distance_m = np.hypot(offset[:, 0], offset[:, 1])
        elevation_rad = np.arctan2(offset[:, 2], distance_m)
        elevations.append(elevation_rad)
        tops.append(np.quantile(elevation_rad[distance_m > _FROM_M], share))
    top_rad = float(np.median(tops))
    hidden_points = {
        frame.index: sweep.points[elevation_rad > top_rad].astype(np.float64)
        for frame, sweep, elevation_rad in zip(frames, drive.sweeps, elevations, strict=True)
    }
    sweeps = tuple(
        sweep.select(elevation_rad <= top_rad)
        for sweep, elevation_rad in zip(drive.sweeps, elevations, strict=True)
    )
    top_deg = math.degrees(top_rad)
    return dataclasses.replace(drive, sweeps=sweeps, lidar_top_deg=top_deg), hidden_points


def errors_at_hidden(
    scene: Scene, frames: Sequence[Frame], hidden_points: Mapping[int, np.ndarray]
) -> dict[str, np.ndarray]:
    """Return relative errors of depth at hidden returns, by camera; infinite without a surface.

    Args:
        scene: the scene that was built without them.
        frames: frames to compare.
        hidden_points: hidden returns by frame, as from `hide_top_returns`.
    """
    errors: dict[str, list[np.ndarray]] = {}
    for frame in frames:
        for name, full_camera in frame.cameras.items():
            camera = full_camera.scaled(min(1.0, _WIDTH / full_camera.width))
            truth, _ = project_points(hidden_points[frame.index], camera, near_m=_NEAR_M)
            truth = truth.select(is_visible_return(truth, camera))
            raster = rasterize(scene.parts_for(camera), camera, buffers=(ALPHA, MEDIAN_DEPTH))
            assert raster.alpha is not None and raster.median_depth is not None
            depth_m = raster.median_depth.numpy().ravel()[truth.pixels]
            has_surface = raster.alpha.numpy().ravel()[truth.pixels] >= SURFACE_ALPHA
            error = np.abs(depth_m - truth.depth_m) / truth.depth_m
            errors.setdefault(name, []).append(np.where(has_surface, error, np.inf))
    return {name: np.concatenate(parts) for name, parts in errors.items()}
