"""Lamps as a camera sees them: their discs, drawn by energy, and how far they are hidden.

A lamp gives the camera an illuminance

    E = I(omega) exp(-sigma D) V / D^2                                            (lux)

I is its intensity towards the camera, V the share of its disc that nothing hides. Beyond some tens
of metres the disc is smaller than a pixel. A picture that drew the lamp's own luminance in such a
pixel would flicker with distance. So E is spread over the disc, or over a pixel where the disc is
smaller, and the sum of luminance times solid angle over the pixels is E at every distance.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, Float32, Float64

from augment.lamps import emitter_kernels
from augment.lamps.fog_phase import AirExtinction
from augment.lamps.lamp import Lamps
from augment.lamps.patterns import pattern_value
from augment.scene.cameras import Camera

# Smallest radius of a drawn disc, pixels: with its soft edge it is a cone of one pixel's width.
MIN_RADIUS_PX = 0.5
# Nearest depth at which a lamp is drawn, metres.
MIN_DEPTH_M = 0.3
# Distance by which a surface must lie before a lamp to hide it, metres. Lamps are fixed to boxes,
# and so may lie inside the surface that they belong to.
HIDDEN_MARGIN_M = 0.6
# The same, as a share of the depth: the error of surfaces grows with it.
HIDDEN_MARGIN_SHARE = 0.01
# Opacity of a pixel up to which it shows no surface that hides a lamp.
MIN_ALPHA = 1e-3
# Points of a lamp's disc at which it is tested.
NUM_POINTS = 32
# Smallest radius of the disc that is tested, pixels.
MIN_TESTED_RADIUS_PX = 0.75
# Radius about a lamp of the air that hides with it, metres: a car's width.
HALO_RADIUS_M = 1.0


def illuminance_at_camera(
    lamps: Lamps, camera: Camera, air: AirExtinction
) -> Float64[np.ndarray, "M"]:
    """Return what each lamp gives a camera that nothing hides it from, lux across the ray."""
    centre = camera.centre.numpy()
    towards_camera = centre - lamps.positions_m
    distances_m = np.maximum(np.linalg.norm(towards_camera, axis=1), 1e-6)
    passed = air.transmittance(np.broadcast_to(centre, towards_camera.shape), lamps.positions_m)
    return intensities_towards(lamps, towards_camera) * passed / distances_m**2


def intensities_towards(
    lamps: Lamps, directions: Float[np.ndarray, "M 3"]
) -> Float64[np.ndarray, "M"]:
    """Return each lamp's intensity in a direction of the world, candela.

    directions: one direction a lamp, of any length but zero.
    """
    unit = directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    sides = np.cross(lamps.axes, lamps.ups)
    local = np.stack([(unit * basis).sum(1) for basis in (lamps.axes, sides, lamps.ups)], 1)
    values = np.empty(len(lamps))
    for pattern in np.unique(lamps.patterns):
        has_pattern = lamps.patterns == pattern
        values[has_pattern] = pattern_value(lamps.tables[pattern], local[has_pattern])
    return lamps.intensities_cd * values


def lamp_visibility(
    lamps: Lamps,
    camera: Camera,
    depth_m: Float32[np.ndarray, "H W"],
    alpha: Float32[np.ndarray, "H W"],
    *,
    radius_m: float | None = None,
) -> Float64[np.ndarray, "M"]:
    """Return the share of each lamp's disc that no surface before it hides.

    Points of the disc outside the image are left out; a lamp that lies outside as a whole is 1.

    Args:
        lamps: the lamps.
        camera: a pinhole camera.
        depth_m: depth along the optical axis, metres; inf for the sky.
        alpha: share of each pixel that its surface covers, 0 to 1; with MIN_ALPHA or less the depth
            has no meaning.
        radius_m: radius of the disc that is tested, metres; None for the lamp's own. With
            HALO_RADIUS_M it tells how far the air about a lamp can be seen.
    """
    if depth_m.shape != (camera.height, camera.width) or alpha.shape != depth_m.shape:
        raise ValueError(
            f"depth_m and alpha must be [{camera.height}, {camera.width}] (from camera "
            f"{camera.name!r}); got {list(depth_m.shape)} and {list(alpha.shape)}"
        )
    columns, rows, depths = _project(lamps, camera)
    is_ahead = depths >= MIN_DEPTH_M
    safe_depths = np.where(is_ahead, depths, 1.0)
    radii_m = lamps.radii_m if radius_m is None else np.full(len(lamps), radius_m)
    focal_px = math.sqrt(camera.fx * camera.fy)
    radii_px = np.maximum(radii_m * focal_px / safe_depths, MIN_TESTED_RADIUS_PX)
    # A sunflower's seeds cover a disc evenly.
    index = np.arange(NUM_POINTS) + 0.5
    seeds = np.sqrt(index / NUM_POINTS)
    turns = index * (math.pi * (3 - math.sqrt(5)))
    with np.errstate(invalid="ignore"):
        x = np.floor(columns[:, None] + radii_px[:, None] * seeds * np.cos(turns))
        y = np.floor(rows[:, None] + radii_px[:, None] * seeds * np.sin(turns))
    is_inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height) & is_ahead[:, None]
    x_index = np.where(is_inside, x, 0).astype(np.int64)
    y_index = np.where(is_inside, y, 0).astype(np.int64)
    limits = safe_depths - HIDDEN_MARGIN_M - HIDDEN_MARGIN_SHARE * safe_depths
    covered = alpha[y_index, x_index]
    is_before = (depth_m[y_index, x_index] < limits[:, None]) & (covered > MIN_ALPHA)
    visible = np.where(is_before, 1.0 - np.clip(covered, 0, 1), 1.0)
    counts = is_inside.sum(1)
    sums = (visible * is_inside).sum(1)
    return np.where(counts > 0, sums / np.maximum(counts, 1), 1.0)


def add_emitters(
    picture: Float32[np.ndarray, "H W 3"],
    lamps: Lamps,
    camera: Camera,
    visibility: Float64[np.ndarray, "M"],
    air: AirExtinction,
) -> None:
    """Add the lamps themselves to a picture, in place.

    Args:
        picture: linear sRGB, cd/m2.
        lamps: the lamps.
        camera: a pinhole camera.
        visibility: share of each lamp's disc that is not hidden, of `lamp_visibility`.
        air: extinction of the air.
    """
    if picture.shape != (camera.height, camera.width, 3) or picture.dtype != np.float32:
        raise ValueError(
            f"picture must be float32 [{camera.height}, {camera.width}, 3] (from camera "
            f"{camera.name!r}); got {picture.dtype} {list(picture.shape)}"
        )
    if visibility.shape != (len(lamps),):
        raise ValueError(f"visibility must be [{len(lamps)}]; got {list(visibility.shape)}")
    if len(lamps) == 0:
        return
    columns, rows, depths = _project(lamps, camera)
    illuminances = illuminance_at_camera(lamps, camera, air) * visibility
    is_ahead = depths >= MIN_DEPTH_M
    safe_depths = np.where(is_ahead, depths, 1.0)
    radii_px = np.maximum(
        lamps.radii_m * math.sqrt(camera.fx * camera.fy) / safe_depths, MIN_RADIUS_PX
    )
    reach_px = radii_px + 1
    is_drawn = (
        is_ahead
        & (illuminances > 0)
        & (columns > -reach_px)
        & (columns < camera.width + reach_px)
        & (rows > -reach_px)
        & (rows < camera.height + reach_px)
    )
    emitter_kernels.draw_discs(
        np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float64),
        np.stack([columns, rows], 1)[is_drawn],
        radii_px[is_drawn],
        (illuminances[:, None] * lamps.colors)[is_drawn],
        picture,
    )


def _project(
    lamps: Lamps, camera: Camera
) -> tuple[Float64[np.ndarray, "M"], Float64[np.ndarray, "M"], Float64[np.ndarray, "M"]]:
    """Return column and row of each lamp in pixels, and its depth in metres.

    Lamps behind the camera have the pixel of a lamp at depth 1.
    """
    pose = camera.camera_from_world.numpy()
    x, y, depths = (lamps.positions_m @ pose[:3, :3].T + pose[:3, 3]).T
    safe_depths = np.where(depths > 1e-6, depths, 1.0)
    return camera.fx * x / safe_depths + camera.cx, camera.fy * y / safe_depths + camera.cy, depths
