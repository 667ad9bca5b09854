"""Shadows that things throw in the recording car's own beams: depth maps from the lamps' place.

The lamps of a pair stand so near to each other that they share one map, from between them. The map
holds inverse depths. They are linear on a plane, so that a road seen at a grazing angle does not
shade itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64, Int64

from augment.lamps.lamp import EGO_OWNER, LampKind, Lamps
from augment.lamps.surface_light_kernels import ShadowArrays
from augment.render.buffers import ALPHA, EXPECTED_DEPTH
from augment.render.constants import RasterSettings
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera
from augment.scene.geometry import invert_rigid
from augment.scene.scene import PosedGaussians

MAP_WIDTH = 256  # width of a map, pixels
MAP_HEIGHT = 128  # height of a map, pixels
# Angle from the axis up to which a map reaches sideways, degrees.
_SIDE_DEG = 48.0
# Angle from the axis up to which a map reaches up and down, degrees.
_UP_DEG = 20.0
# Least alpha of a pixel of the map that holds a surface.
_MIN_ALPHA = 0.5
# Distance from the lamp below which nothing throws a shadow, metres: the car itself.
_NEAR_M = 1.0
# Share of the inverse depth by which a surface may lie behind the map and be lit.
_TOLERANCE = 0.1
# Inverse metres by which it may do so.
_TOLERANCE_PER_M = 0.0008
# Cosine between the axes of lamps that share a map, at least.
_SAME_AXIS = 0.995
# Distance between lamps that share a map, at most, metres.
_SAME_PLACE_M = 2.5
# Kinds of lamps that throw shadows.
_BEAMS = (LampKind.DIPPED, LampKind.HIGH, LampKind.FRONT_FOG, LampKind.DAYTIME)


@dataclass(frozen=True, eq=False)
class BeamShadows:
    """Depth maps from the recording car's lamps."""

    arrays: ShadowArrays
    """The maps, as kernels take them."""
    positions_m: Float64[np.ndarray, "S 3"]
    """Places from which the maps look, world, metres."""
    axes: Float64[np.ndarray, "S 3"]
    """Unit directions in which they look, world."""

    def maps_of(self, lamps: Lamps) -> Int64[np.ndarray, "M"]:
        """Return the index of each lamp's map; -1 for lamps without one."""
        indices = np.full(len(lamps), -1, np.int64)
        for m in np.flatnonzero(_throws_shadows(lamps)):
            gaps = np.linalg.norm(self.positions_m - lamps.positions_m[m], axis=1)
            is_fit = (gaps <= _SAME_PLACE_M) & (self.axes @ lamps.axes[m] >= _SAME_AXIS)
            if is_fit.any():
                indices[m] = int(np.where(is_fit, gaps, np.inf).argmin())
        return indices


def _throws_shadows(lamps: Lamps) -> np.ndarray:
    return (lamps.owners == EGO_OWNER) & np.isin(lamps.kinds, [int(kind) for kind in _BEAMS])


def draw_beam_shadows(
    lamps: Lamps,
    parts: Sequence[PosedGaussians],
    *,
    settings: RasterSettings,
    backend: str,
    timestamp_ns: int = 0,
) -> BeamShadows | None:
    """Return the depth maps of the recording car's beams; None if it has no such lamp.

    Args:
        lamps: all lamps of the moment.
        parts: the scene's parts at that moment, without the recording car.
        settings: settings of the rasteriser.
        backend: backend of the rasteriser.
        timestamp_ns: the moment.
    """
    own_lamps = lamps.select(_throws_shadows(lamps))
    views = _views_of(own_lamps)
    if not views:
        return None
    images: list[np.ndarray] = []
    poses: list[np.ndarray] = []
    lenses: list[tuple[float, float, float, float]] = []
    near = replace(settings, near_m=max(settings.near_m, _NEAR_M))
    for position, axis, up in views:
        camera = _lamp_camera(position, axis, up, timestamp_ns)
        raster = rasterize(
            parts, camera, buffers={ALPHA, EXPECTED_DEPTH}, settings=near, backend=backend
        )
        assert raster.alpha is not None and raster.expected_depth is not None
        alpha = raster.alpha.detach().cpu().numpy()
        depth = raster.expected_depth.detach().cpu().numpy()
        is_surface = (alpha >= _MIN_ALPHA) & (depth > 0)
        images.append(np.divide(1, depth, out=np.zeros_like(depth), where=is_surface))
        poses.append(camera.camera_from_world.numpy()[:3])
        lenses.append((camera.fx, camera.fy, camera.cx, camera.cy))
    arrays = ShadowArrays(
        np.ascontiguousarray(np.stack(images), np.float32),
        np.ascontiguousarray(np.stack(poses)),
        np.array(lenses, np.float64),
        np.array([_TOLERANCE, _TOLERANCE_PER_M]),
    )
    positions = np.stack([view[0] for view in views])
    return BeamShadows(arrays, positions, np.stack([view[1] for view in views]))


def _views_of(own_lamps: Lamps) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return place, axis and up of one view for each group of lamps with the same direction."""
    views: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    remaining = list(range(len(own_lamps)))
    while remaining:
        first = remaining[0]
        gaps = np.linalg.norm(own_lamps.positions_m - own_lamps.positions_m[first], axis=1)
        is_same = (gaps <= _SAME_PLACE_M) & (own_lamps.axes @ own_lamps.axes[first] >= _SAME_AXIS)
        group = [m for m in remaining if is_same[m]]
        remaining = [m for m in remaining if not is_same[m]]
        views.append(
            (own_lamps.positions_m[group].mean(0), own_lamps.axes[first], own_lamps.ups[first])
        )
    return views


def _lamp_camera(
    position: np.ndarray, axis: np.ndarray, up: np.ndarray, timestamp_ns: int
) -> Camera:
    """Return a camera that looks from a lamp along its axis."""
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = np.stack([np.cross(axis, up), -up, axis], 1)
    world_from_camera[:3, 3] = position
    return Camera(
        "own lamps",
        MAP_WIDTH,
        MAP_HEIGHT,
        MAP_WIDTH / 2 / math.tan(math.radians(_SIDE_DEG)),
        MAP_HEIGHT / 2 / math.tan(math.radians(_UP_DEG)),
        MAP_WIDTH / 2,
        MAP_HEIGHT / 2,
        invert_rigid(torch.from_numpy(world_from_camera)),
        timestamp_ns,
    )
