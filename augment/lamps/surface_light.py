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
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from augment.lamps import surface_light_kernels
from augment.lamps.beam_shadows import BeamShadows
from augment.lamps.lamp import EGO_OWNER, Lamps
from augment.lamps.patterns import pattern_value
from augment.lamps.surface_light_kernels import (
    FULL_RETURN_RAD,
    LAST_RETURN,
    LAST_RETURN_RAD,
    MIDDLE_RETURN,
    MIDDLE_RETURN_RAD,
    SIGN_RETURN_PER_LUX,
    SIGN_WHITE,
    LampArrays,
    NodeView,
    ShadowArrays,
)
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera

# Distance below which a lamp is no point, metres; that of larger lamps is their radius.
MIN_SOFTENING_M = 0.15
# Largest reflectance of a surface.
MAX_REFLECTANCE = 0.9
# Cosine to the vertical from which on a node counts as ground for certain: 25 degrees.
_GROUND_COSINE = 0.906
# The same, below which it does not: 40 degrees.
_MIN_GROUND_COSINE = 0.766
# Sides of the window in which the normals of the ground are averaged, nodes: columns, rows.
_GROUND_WINDOW = (65, 17)
# Sides of the window in which most nodes are ground about one that is taken for it: columns, rows.
_NEAR_WINDOW = (33, 17)
# Share of them below which it is not.
_MIN_NEAR_SHARE = 0.45
# Share of them from which on it is for certain.
_NEAR_SHARE = 0.65
# Largest difference of its inverse depth from theirs, of theirs.
_SAME_GROUND = 0.03
# Sides of the window in which the normals of walls are averaged, nodes.
_WALL_WINDOW = (49, 49)
# Length of a mean normal below which a surface is rough, as leaves are.
_MIN_SMOOTH = 0.8
# Length from which on it is smooth.
_SMOOTH = 0.95
# Difference of a node's inverse depth from the window's, of that, up to which it is of one wall.
_SAME_WALL = 0.02
# Most luminance of a sign over that of a matt surface of its reflectance in the same light: 1,122.
SIGN_GAIN = math.pi * SIGN_RETURN_PER_LUX / SIGN_WHITE
# Nodes in a row of a picture, about.
NODES_PER_ROW = 600
# Pixels between nodes, at most.
MAX_STEP_PX = 4


@dataclass(frozen=True, eq=False)
class Nodes:
    """Points of a picture at which light is summed."""

    depth: Float32[np.ndarray, "h w"]
    """z, metres; 0 for the sky."""
    normals: Float32[np.ndarray, "h w 3"]
    """Normals towards the eye, world, as short as those about them disagree; 0 for the sky."""
    step_px: int
    """Pixels between nodes."""

    @property
    def inverse_depth(self) -> Float32[np.ndarray, "h w"]:
        """Return 1 / z; 0 for the sky."""
        return _inverse(self.depth)


def _inverse(depth: np.ndarray) -> np.ndarray:
    is_surface = (depth > 0) & (depth < 1e6)
    return np.divide(1, depth, out=np.zeros_like(depth), where=is_surface)


def default_step_px(camera: Camera) -> int:
    """Return the pixels between nodes at which a picture has about NODES_PER_ROW in a row."""
    return min(max(round(camera.width / NODES_PER_ROW), 1), MAX_STEP_PX)


def find_nodes(
    camera: Camera, depth_m: Float32[np.ndarray, "H W"], *, step_px: int | None = None
) -> Nodes:
    """Return the nodes of a picture, with normals by its depth.

    A normal follows from the slopes of the inverse depth, on the side of the node that is smoother,
    and is averaged with those about it. On ground, the normals are averaged over a wide window: a
    car's own lamps light a road at so small an angle that each bump of the splats would throw a
    shadow.

    Args:
        camera: camera of the picture.
        depth_m: z of the surfaces, metres; 0 for the sky.
        step_px: pixels between nodes; None for `default_step_px`.
    """
    step_px = default_step_px(camera) if step_px is None else step_px
    first = step_px // 2
    depth = np.ascontiguousarray(depth_m[first::step_px, first::step_px], np.float32)
    if not depth.size:
        depth = np.ascontiguousarray(depth_m[:1, :1], np.float32)
    slopes = np.empty((*depth.shape, 3), np.float32)
    normals = np.empty_like(slopes)
    inverse = _inverse(depth)
    with kernel_threads(depth.shape[0]):
        surface_light_kernels.find_slopes(inverse, node_view(camera, step_px), slopes)
        surface_light_kernels.average_normals(inverse, slopes, normals)
    return Nodes(depth, _smooth_walls(_smooth_ground(normals, inverse), inverse), step_px)


def _smooth_ground(
    normals: Float32[np.ndarray, "h w 3"], inverse: Float32[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w 3"]:
    """Return the normals, those of the ground averaged over a window of the picture.

    Single nodes whose normals differ count as ground where most of those about them do, at about
    their depth.

    Args:
        normals: normals by the depth.
        inverse: 1 / z of the nodes, 0 for the sky.
    """
    share = (normals[..., 2] - _MIN_GROUND_COSINE) / (_GROUND_COSINE - _MIN_GROUND_COSINE)
    share = np.clip(share, 0, 1)
    mean = normals * share[..., None]
    near = cv2.blur(share, _NEAR_WINDOW, borderType=cv2.BORDER_REFLECT_101)
    near_inverse = cv2.blur(share * inverse, _NEAR_WINDOW, borderType=cv2.BORDER_REFLECT_101)
    is_near = np.abs(inverse * near - near_inverse) < _SAME_GROUND * near_inverse
    filled = (near - _MIN_NEAR_SHARE) / (_NEAR_SHARE - _MIN_NEAR_SHARE)
    share = np.maximum(share, np.where(is_near, np.clip(filled, 0, 1), 0))[..., None]
    for _ in range(2):
        mean = cv2.blur(mean, _GROUND_WINDOW, borderType=cv2.BORDER_CONSTANT)
    x, y, z = cv2.split(mean)
    mean *= (1 / np.sqrt(np.maximum(x * x + y * y + z * z, 1e-12)))[..., None]
    return normals + share * (mean - normals)


def _smooth_walls(
    normals: Float32[np.ndarray, "h w 3"], inverse: Float32[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w 3"]:
    """Return the normals, those of smooth surfaces off the ground averaged over a window.

    Fronts and paint have wide bulges in the depth of splats and sweeps, which a lamp would show as
    blotches. Leaves, whose normals disagree from node to node, keep theirs; so does what stands
    before something else.

    Args:
        normals: normals, as short as those about them disagree.
        inverse: 1 / z of the nodes, 0 for the sky.
    """
    x, y, z = cv2.split(normals)
    lengths = np.sqrt(x * x + y * y + z * z)
    weights = np.clip((lengths - _MIN_SMOOTH) / (_SMOOTH - _MIN_SMOOTH), 0, 1)
    weights *= np.clip((_GROUND_COSINE - z) / (_GROUND_COSINE - _MIN_GROUND_COSINE), 0, 1)
    border = cv2.BORDER_CONSTANT
    total = cv2.blur(weights, _WALL_WINDOW, borderType=border)
    near_inverse = cv2.blur(weights * inverse, _WALL_WINDOW, borderType=border)
    mean = cv2.blur(normals * weights[..., None], _WALL_WINDOW, borderType=border)
    difference = np.abs(inverse * total - near_inverse) / np.maximum(near_inverse, 1e-12)
    share = weights * np.clip(2 - difference / _SAME_WALL, 0, 1)
    x, y, z = cv2.split(mean)
    mean *= (lengths / np.sqrt(np.maximum(x * x + y * y + z * z, 1e-12)))[..., None]
    return normals + share[..., None] * (mean - normals)


def node_view(camera: Camera, step_px: int) -> NodeView:
    """Return the view of the nodes as kernels take it."""
    pose = camera.world_from_camera.numpy()
    lens = (1 / camera.fx, 1 / camera.fy, camera.cx, camera.cy, step_px, step_px // 2 + 0.5)
    return NodeView(
        np.array(lens, np.float64),
        np.ascontiguousarray(pose[:3, :3]),
        np.ascontiguousarray(pose[:3, 3]),
    )


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
    peaks = lamps.tables.reshape(len(lamps.tables), -1).max(1, initial=0).astype(np.float64)
    arrays = LampArrays(
        lamps.positions_m,
        lamps.axes,
        lamps.ups,
        lamps.intensities_cd,
        lamps.intensities_cd * peaks[lamps.patterns] if count else np.zeros(0),
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
        surface_light_kernels.spread_light(
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
