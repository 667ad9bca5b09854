"""Light of lamps on the surfaces of a picture: Lambert's law, with normals from the depth.

A lamp of intensity I in the direction of a point at a distance d lights a surface there with

    E = I cos(theta) exp(-sigma d) / (d^2 + r^2)        lux, if the lamp is above the surface

theta: angle between the normal and the lamp; sigma: extinction of the air between lamp and surface;
r: 0.15 m at least, so that a lamp that touches a surface does not burn a hole into it.
The surface's luminance is rho E / pi. The air before the surface is the caller's.

Light changes slowly over a surface. So the sum is taken at nodes, `step_px` apart, and spread to
the pixels of the same surface, which have reflectances of their own. In a tile of nodes only the
brightest lamps count. Lamps that add less than `min_luminance_cd_m2` to a white surface of a tile,
and to signs, do not light it.

Signs of retroreflective sheeting send the recording car's light back to it: L = R_A E, E on the
plane that faces the lamp.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float32, Float64

from augment.lamps import surface_light_kernels, surface_spread_kernels
from augment.lamps.beam_shadows import BeamShadows
from augment.lamps.lamp import EGO_OWNER, Lamps
from augment.lamps.patterns import pattern_value
from augment.lamps.surface_light_kernels import (
    FULL_RETURN_RAD,
    LAST_RETURN,
    LAST_RETURN_RAD,
    MIDDLE_RETURN,
    MIDDLE_RETURN_RAD,
    LampArrays,
    ShadowArrays,
)
from augment.lamps.surface_normals import Nodes, find_nodes, node_view
from augment.lamps.surface_spread_kernels import SIGN_RETURN_PER_LUX, SIGN_WHITE
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera

# Distance below which a lamp is no point, metres; that of larger lamps is their radius.
MIN_SOFTENING_M = 0.15
# Largest reflectance of a surface.
MAX_REFLECTANCE = 0.9
# Most luminance of a sign over that of a matt surface of its reflectance in the same light: 1,122.
SIGN_GAIN = math.pi * SIGN_RETURN_PER_LUX / SIGN_WHITE


def lamp_arrays(
    lamps: Lamps,
    extinctions_per_m: Float64[np.ndarray, "M"] | float,
    shadows: BeamShadows | None = None,
) -> LampArrays:
    """Return lamps as kernels take them.

    Args:
        lamps: the lamps.
        extinctions_per_m: extinction of the air about each lamp.
        shadows: depth maps from the recording car's lamps.
    """
    count = len(lamps)
    arrays = LampArrays(
        lamps.positions_m,
        lamps.axes,
        lamps.ups,
        lamps.intensities_cd,
        lamps.peak_intensities_cd,
        lamps.patterns,
        lamps.tables,
        lamps.colors,
        np.array(np.broadcast_to(extinctions_per_m, (count,)), np.float64),
        np.maximum(lamps.radii_m, MIN_SOFTENING_M) ** 2,
        np.full(count, -1, np.int64) if shadows is None else shadows.maps_of(lamps),
        lamps.owners == EGO_OWNER,
    )
    # Kernels are compiled for arrays that may be written.
    return LampArrays(*(np.require(array, requirements=["C", "W"]) for array in arrays))


def surface_light(
    lamps: Lamps,
    camera: Camera,
    depth_m: Float32[np.ndarray, "H W"],
    reflectance: Float32[np.ndarray, "H W 3"],
    *,
    extinctions_per_m: Float64[np.ndarray, "M"] | float = 0.0,
    min_luminance_cd_m2: float = 0.0,
    lamps_per_pixel: int = 8,
    nodes: Nodes | None = None,
    shadows: BeamShadows | None = None,
    is_sign: np.ndarray | None = None,
    picture: Float32[np.ndarray, "H W 3"] | None = None,
) -> Float32[np.ndarray, "H W 3"]:
    """Return the luminance of surfaces under lamps, without the air before them, cd/m2.

    Colours are linear sRGB.

    Args:
        lamps: the lamps.
        camera: camera of the picture.
        depth_m: z of the surfaces, metres; 0 for the sky.
        reflectance: reflectance of the surfaces, linear, 0 to 1.
        extinctions_per_m: extinction of the air between each lamp and what it lights.
        min_luminance_cd_m2: luminance of a white surface or a sign that need not be added.
        lamps_per_pixel: largest number of lamps that light a tile.
        nodes: result of `find_nodes`; None computes it.
        shadows: depth maps from the recording car's lamps.
        is_sign: pixels of retroreflective signs, bool [H, W]; None without any.
        picture: picture to which the light is added, in place; None for a new one.

    Raises:
        ValueError: arguments do not fit together.
    """
    _check_sizes(camera, depth_m, reflectance, lamps_per_pixel)
    if picture is None:
        picture = np.zeros((*depth_m.shape, 3), np.float32)
    if not len(lamps):
        return picture
    nodes = find_nodes(camera, depth_m) if nodes is None else nodes
    shape = (*nodes.depth.shape, 3)
    lux = np.empty(shape, np.float32)
    has_signs = is_sign is not None and bool((lamps.owners == EGO_OWNER).any()) and is_sign.any()
    own_lux = np.empty(shape if has_signs else (0, 0, 3), np.float32)
    signs = np.zeros((0, 0), np.bool_)
    if has_signs:
        assert is_sign is not None
        signs = np.ascontiguousarray(is_sign, np.bool_)
    arrays = lamp_arrays(lamps, extinctions_per_m, shadows)
    min_lux = min_luminance_cd_m2 * math.pi / MAX_REFLECTANCE
    min_own_lux = min_lux / SIGN_GAIN if has_signs else min_lux  # signs return own light alone
    with kernel_threads():
        surface_light_kernels.light_nodes(
            nodes.depth,
            nodes.normals,
            node_view(camera, nodes.step_px),
            arrays,
            shadow_arrays(shadows),
            signs,
            min_lux,
            min_own_lux,
            lamps_per_pixel,
            lux,
            own_lux,
        )
    with kernel_threads(8):
        surface_spread_kernels.spread_light(
            np.ascontiguousarray(depth_m, np.float32),
            nodes.inverse_depth,
            lux,
            own_lux,
            nodes.step_px,
            nodes.step_px // 2,
            np.ascontiguousarray(reflectance, np.float32),
            signs,
            picture,
        )
    return picture


def shadow_arrays(shadows: BeamShadows | None) -> ShadowArrays:
    """Return shadows as kernels take them; maps of no size for none."""
    if shadows is None:
        return ShadowArrays(
            np.zeros((0, 2, 2), np.float32), np.zeros((0, 3, 4)), np.zeros((0, 4)), np.zeros(2)
        )
    return shadows.arrays


def _check_sizes(
    camera: Camera, depth_m: np.ndarray, reflectance: np.ndarray, lamps_per_pixel: int
) -> None:
    """Raise ValueError unless the images have the camera's size."""
    size = (camera.height, camera.width)
    if depth_m.shape != size:
        raise ValueError(f"depth_m must be {list(size)} (from the camera); got {depth_m.shape}")
    if reflectance.shape != (*size, 3):
        raise ValueError(
            f"reflectance must be {[*size, 3]} (from the camera); got {list(reflectance.shape)}"
        )
    if lamps_per_pixel < 1:
        raise ValueError(f"lamps_per_pixel must be >= 1; got {lamps_per_pixel}")


# ---- Definitions ---------------------------------------------------------------------------------


def illuminance(
    lamps: Lamps,
    points: Float64[np.ndarray, "N 3"],
    normals: Float64[np.ndarray, "N 3"] | None = None,
    extinctions_per_m: Float64[np.ndarray, "M"] | float = 0.0,
) -> Float64[np.ndarray, "N M"]:
    """Return lux of every lamp at points: the definition of `light_nodes`, without shadows.

    Args:
        lamps: the lamps.
        points: places of the points, world, metres.
        normals: unit normals of the surfaces there; None for surfaces that face each lamp.
        extinctions_per_m: extinction of the air about each lamp.
    """
    lux = np.zeros((len(points), len(lamps)))
    extinctions = np.broadcast_to(extinctions_per_m, (len(lamps),))
    for m in range(len(lamps)):
        to_lamp = lamps.positions_m[m] - points
        distances = np.linalg.norm(to_lamp, axis=1)
        to_lamp = to_lamp / np.maximum(distances, 1e-9)[:, None]
        axis = lamps.axes[m]
        up = lamps.ups[m]
        frame = np.stack([axis, np.cross(axis, up), up])
        share = pattern_value(lamps.tables[lamps.patterns[m]], -to_lamp @ frame.T)
        softening = max(lamps.radii_m[m], MIN_SOFTENING_M) ** 2
        lux[:, m] = lamps.intensities_cd[m] * share / (distances**2 + softening)
        lux[:, m] *= np.exp(-extinctions[m] * distances)
        if normals is not None:
            lux[:, m] *= np.maximum((normals * to_lamp).sum(1), 0)
    return lux


def return_share(angle_rad: np.ndarray) -> np.ndarray:
    """Return the light that a sign sends back at an observation angle, over that at 0.2 degrees.

    The definition of the kernel of the same name: straight lines between the logarithms of
    coefficient and angle.
    """
    angles = np.log(np.maximum(angle_rad, 1e-12))
    table = np.log([FULL_RETURN_RAD, MIDDLE_RETURN_RAD, LAST_RETURN_RAD])
    values = np.log([1.0, MIDDLE_RETURN, LAST_RETURN])
    inside = np.interp(angles, table, values)
    slope = (values[2] - values[1]) / (table[2] - table[1])
    beyond = values[2] + slope * (angles - table[2])
    return np.exp(np.where(angles > table[2], beyond, inside))
