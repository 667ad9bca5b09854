"""Light of lamps on drops and flakes near the eye.

A drop at a distance r along a ray has the luminance E p(angle) of its disc: E is the sum of the
lamps' lux at it, p its phase function (1/sr), as a drop scatters all light that meets it. It adds
this to the share of the pixel that it covers while the shutter is open.

- Drops refract most light forward and send a little back: .92 of Henyey-Greenstein's function with
  g = .85, and .08 with g = -.6 (assumed).
- Flakes scatter as spheres of Lambert's law, with a share that shines through them (assumed).

E changes slowly: it is computed in cells of 16 pixels, at the distances at which the cover is
known, and interpolated over the picture.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float32, Float64

from augment.lamps import drop_light_kernels, fog_phase
from augment.lamps.drop_cover import DropCover
from augment.lamps.drop_light_kernels import (
    DROP_BACKWARD,
    DROP_BACKWARD_SHARE,
    DROP_FORWARD,
    FLAKE_THROUGH_SHARE,
)
from augment.lamps.lamp import Lamps
from augment.lamps.lamp_lanes import lamp_table, pattern_starts
from augment.lamps.surface_light import MIN_SOFTENING_M, illuminance
from augment.render.layout import NUM_LANES
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera

# Side of a cell, pixels.
CELL_PX = 16


def add_drop_light(
    picture: Float32[np.ndarray, "H W 3"],
    lamps: Lamps,
    camera: Camera,
    cover: DropCover,
    *,
    extinction_per_m: float = 0.0,
    min_luminance_cd_m2: float = 1e-4,
) -> None:
    """Add the light of lamps on near drops to a picture, in place.

    Args:
        picture: luminance in linear sRGB, cd/m2.
        lamps: the lamps.
        camera: camera of the picture.
        cover: the drops.
        extinction_per_m: extinction of the air about the drops.
        min_luminance_cd_m2: luminance that need not be added.

    Raises:
        ValueError: the images differ in size.
    """
    if picture.shape[:2] != cover.size_px:
        raise ValueError(
            f"picture must be {[*cover.size_px, 3]} (from cover); got {list(picture.shape)}"
        )
    if not len(lamps) or not cover.has_drops:
        return
    rays = cell_rays(camera)
    rows, columns = rays.shape[:2]
    # Whole eights of columns; those beyond the last one are not looked at.
    padded = np.zeros((3, rows, -(-columns // NUM_LANES) * NUM_LANES), np.float32)
    padded[0] = 1
    padded[:, :, :columns] = np.moveaxis(rays, 2, 0)
    cells = np.empty((len(cover.distances_m), rows, 3, padded.shape[2]), np.float32)
    softening_m2 = np.maximum(lamps.radii_m, MIN_SOFTENING_M) ** 2
    eye = camera.centre.numpy()
    with kernel_threads(len(cover.distances_m)):
        drop_light_kernels.light_cells(
            padded,
            np.array(cover.distances_m, np.float32),
            lamp_table(lamps, extinction_per_m, softening_m2, np.eye(3), eye),
            np.require(lamps.tables, np.float32, ["C", "W"]),
            pattern_starts(lamps),
            cover.is_snow,
            float(min_luminance_cd_m2),
            cells,
        )
    cells *= np.exp(-extinction_per_m * cover.distances_m).astype(np.float32)[:, None, None, None]
    cover.add_light(picture, cells, CELL_PX)


def cell_rays(camera: Camera) -> Float64[np.ndarray, "h w 3"]:
    """Return the unit directions through the cells' middles, world."""
    rows = math.ceil(camera.height / CELL_PX)
    columns = math.ceil(camera.width / CELL_PX)
    x = ((np.arange(columns) + 0.5) * CELL_PX - camera.cx) / camera.fx
    y = ((np.arange(rows) + 0.5) * CELL_PX - camera.cy) / camera.fy
    rays = np.ones((rows, columns, 3))
    rays[..., 0] = x
    rays[..., 1] = y[:, None]
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    return np.ascontiguousarray(rays @ camera.world_from_camera[:3, :3].numpy().T)


# ---- Definition ----------------------------------------------------------------------------------


def phase_function(cosine: np.ndarray, *, is_snow: bool) -> np.ndarray:
    """Return the phase function of a drop or flake, 1/sr: the definition of the kernels' ones.

    Args:
        cosine: cosine of the scattering angle, 1 for light that goes straight on.
        is_snow: True for flakes.
    """
    theta = np.arccos(np.clip(cosine, -1, 1))
    if is_snow:
        back = _lambert_sphere(np.pi - theta)
        through = _lambert_sphere(theta)
        return (1 - FLAKE_THROUGH_SHARE) * back + FLAKE_THROUGH_SHARE * through
    forward = (1 - DROP_BACKWARD_SHARE, DROP_FORWARD)
    backward = (DROP_BACKWARD_SHARE, DROP_BACKWARD)
    return fog_phase.phase_function((forward, backward), theta)


def _lambert_sphere(alpha: np.ndarray) -> np.ndarray:
    """Return the phase function of a white Lambertian sphere, 1/sr.

    alpha: angle between lamp and eye, seen from the sphere, radians.
    """
    return 2 / (3 * np.pi**2) * (np.sin(alpha) + (np.pi - alpha) * np.cos(alpha))


def cell_luminance(
    lamps: Lamps, camera: Camera, distance_m: float, *, is_snow: bool, extinction_per_m: float = 0.0
) -> Float64[np.ndarray, "h w 3"]:
    """Return the luminance of drops at a distance in each cell: the definition of `light_cells`.

    Args:
        lamps: the lamps.
        camera: camera of the picture.
        distance_m: distance of the drops.
        is_snow: True for flakes.
        extinction_per_m: extinction of the air about the drops.
    """
    rays = cell_rays(camera)
    points = (camera.centre.numpy() + distance_m * rays).reshape(-1, 3)
    lux = illuminance(lamps, points, None, extinction_per_m)
    to_lamp = lamps.positions_m[None] - points[:, None]
    to_lamp /= np.linalg.norm(to_lamp, axis=2, keepdims=True)
    cosine = (to_lamp * rays.reshape(-1, 1, 3)).sum(2)
    luminance = (lux * phase_function(cosine, is_snow=is_snow)) @ lamps.colors
    return luminance.reshape(rays.shape)
