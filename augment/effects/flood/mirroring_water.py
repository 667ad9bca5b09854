"""Water of a flood as lamps are mirrored in it."""

from __future__ import annotations

import numpy as np

from augment.effects.flood.flood_view import FloodedImage
from augment.effects.flood.water_plane import plane_depth
from augment.lamps.wet_surface import MIN_ROUGHNESS, WetSurface
from augment.scene.cameras import Camera


def mirroring_water(image: FloodedImage, camera: Camera, level_z_m: float) -> WetSurface | None:
    """Return the water of a picture for lamps; None if no surface is seen from above.

    Waves that the image can show tilt the mirror; finer ones make it rough: Beckmann's m^2 is twice
    the variance of their slopes along one axis.

    Args:
        image: the flooded picture.
        camera: camera of the picture.
        level_z_m: height of the water, scene world.
    """
    if image.field is None or image.window is None:
        return None
    share = image.water.cpu().numpy().astype(np.float32)
    roughness = np.zeros_like(share)
    tilts = np.zeros((*share.shape, 2), np.float32)
    rows = slice(image.window.top, image.window.bottom)
    columns = slice(image.window.left, image.window.right)
    variance = image.field.slope_variance.cpu().numpy()
    roughness[rows, columns] = np.sqrt(MIN_ROUGHNESS**2 + 2 * variance)
    tilts[rows, columns, 0] = image.field.normal_x.cpu().numpy()
    tilts[rows, columns, 1] = image.field.normal_y.cpu().numpy()
    depth = plane_depth(camera, level_z_m).numpy()
    share *= roughness > 0
    is_water = share > 0
    depth_m = np.where(is_water & np.isfinite(depth), depth, 0).astype(np.float32)
    return WetSurface(share, roughness, depth_m, (0.0, 0.0, 1.0), tilts)
