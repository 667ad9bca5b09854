"""Renders reflections in wet ground: the scene from the mirrored eye, blurred by a rough film.

    L = (1 - k F) C + k F M        in linear light

- C: the ground as rendered.
- F: share of light that a rough film reflects.
- k: share of the pixel that the film covers.
- M: the mirrored picture, through the fog of its whole path.

Where fog is uniform, C and M hold its airlight in their share, so that the sum is exact.

A film's slopes s (standard deviation along one axis) turn the mirrored ray by 2 s up and down, and
by 2 s sin(grazing angle) sideways, about the point where it leaves the ground. Seen from the eye,
this moves a thing by q times as much, q = distance from the ground / distance from the eye: lamps
far behind the ground become long upright streaks, and a wall is sharp at its foot. M is blurred
upright to a few widths once, and each pixel looks up between two of them.

Caller: `WetEffect.edit_image` (`find_ground`, then `shade_wet`). On the CPU, `film_kernels` compute
the same.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage
from torch import Tensor

from augment.effects.wet import film_kernels
from augment.effects.wet.darkening import to_display, to_linear, wet_ratio
from augment.effects.wet.drying import (
    DryingMap,
    RoadFilm,
    local_water,
    stain_levels,
    stained_share,
    water_numbers,
)
from augment.effects.wet.film_kernels import (
    ASPHALT_ROUGHNESS,
    COARSE_AMPLITUDE,
    COARSE_RANK,
    COARSE_TEXEL_M,
    EXPOSURE,
    FILM_SHARE,
    FINE_AMPLITUDE,
    FINE_RANK,
    FINE_TEXEL_M,
    GROUND_TOLERANCE_M,
    GROUND_TOLERANCE_PER_M,
    HEIGHT,
    MAX_GROUND_OFFSET_M,
    MAX_GROUND_OFFSET_PER_M,
    MIN_BLUR_PX,
    MIN_FOOTPRINT_SINE,
    MIN_GROUND_SHARE,
    MOTTLE_SIDE,
    NUM_LEVELS,
    PUDDLE_ORDER,
    PUDDLE_RIM,
    PUDDLE_ROUGHNESS,
    R0,
    SKY_DISTANCE_M,
    SLOPE_X,
    SLOPE_Y,
    TRACK_SMOOTHING,
    WHEEL_TRACK,
)
from augment.effects.wet.ground_map import GROUND_CELL_M, WetGround
from augment.effects.wet.ripples import Rings, ring_arrays, ring_slopes
from augment.render.buffers import AUTO, CPU, choose_kernels
from augment.render.layout import ABOVE, NUM_LANES, HeightClip
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera
from augment.scene.geometry import rigid

# ---- The plane and its mirrored camera -----------------------------------------------------------

# Distances between which the plane is fitted to the ground.
MIN_FIT_DISTANCE_M = 1.0
MAX_FIT_DISTANCE_M = 60.0
NUM_RAYS = 24  # number of rays on a side of the image


@dataclass(frozen=True)
class Plane:
    """Points x with up . x = offset_m."""

    up: tuple[float, float, float]  # unit normal, world
    offset_m: float  # distance from the origin

    def above(self, lowered_m: float) -> HeightClip:
        """Return the clip that keeps what lies above the plane, lowered by `lowered_m`."""
        return HeightClip(self.offset_m - lowered_m, ABOVE, up=self.up)


def plane_in_view(camera: Camera, ground: WetGround) -> Plane | None:
    """Fit a plane to the open ground that a camera sees, nearest ground first.

    It is None where the camera's rays meet no ground. Rays march to the map's heights by fixed
    steps of their length, so that a hill hides what is behind it.
    """
    points, weights = _sample_ground(camera, ground)
    if weights.sum() <= 0:
        return None
    center = (weights[:, None] * points).sum(0) / weights.sum()
    local = points - center
    design = np.concatenate([local[:, :2], np.ones((len(local), 1))], 1)
    ridge = 1e-3 * weights.sum() * np.diag([1.0, 1.0, 0.0])
    slopes = np.zeros(3)
    for _ in range(3):  # points far off the first plane belong to another surface
        height_gaps = np.abs(local[:, 2] - design @ slopes)
        robust_weights = weights * (1 / (1 + (height_gaps / 0.15) ** 2))
        slopes = np.linalg.solve(
            (design.T * robust_weights) @ design + ridge + 1e-9 * np.eye(3),
            (design.T * robust_weights) @ local[:, 2],
        )
    normal = np.array([-slopes[0], -slopes[1], 1.0])
    normal /= np.linalg.norm(normal)
    point = center + np.array([0, 0, slopes[2]])
    up = (float(normal[0]), float(normal[1]), float(normal[2]))
    plane = Plane(up, float(normal @ point))
    if float(np.dot(normal, camera.centre.numpy())) - plane.offset_m < 0.05:
        return None  # an eye in the ground sees no reflections
    return plane


def _sample_ground(camera: Camera, ground: WetGround) -> tuple[np.ndarray, np.ndarray]:
    """Return points [N, 3] where rays over the image meet open ground, and weights [N]."""
    small_camera = camera.resized(NUM_RAYS, NUM_RAYS)
    rays = small_camera.ray_directions(torch.float64).reshape(-1, 3).numpy()
    eye = camera.centre.numpy()
    horizontal = np.linalg.norm(rays[:, :2], axis=1)
    distances = MIN_FIT_DISTANCE_M * (MAX_FIT_DISTANCE_M / MIN_FIT_DISTANCE_M) ** (
        np.arange(33) / 32
    )
    points_on_rays = (
        eye + (rays / np.maximum(horizontal, 1e-6)[:, None])[:, None] * distances[None, :, None]
    )
    heights = ground.nearest(points_on_rays[..., 0], points_on_rays[..., 1])[..., HEIGHT]
    is_under = points_on_rays[..., 2] <= heights
    first_step = is_under.argmax(1)
    is_hit = is_under.any(1) & (rays[:, 2] < 0)
    points = points_on_rays[np.arange(len(rays)), first_step]
    channels = ground.nearest(points[:, 0], points[:, 1])
    points[:, 2] = channels[:, HEIGHT]
    weights = np.where(is_hit, channels[:, EXPOSURE], 0) / (1 + distances[first_step] / 10)
    return points, weights


def mirror_camera(camera: Camera, plane: Plane) -> Camera:
    """Return the camera whose pictures are the reflections that `camera` sees in the plane.

    Its pixel (column, row) is the reflection in (column, height - 1 - row).
    """
    normal = torch.tensor(plane.up, dtype=torch.float64)
    householder = torch.eye(3, dtype=torch.float64) - 2 * normal[:, None] * normal
    flip = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    rotation = flip[:, None] * camera.camera_from_world[:3, :3] @ householder
    eye = householder @ camera.centre + 2 * plane.offset_m * normal
    pose = rigid(rotation, -rotation @ eye)
    return dataclasses.replace(camera, camera_from_world=pose, cy=camera.height - camera.cy)


# ---- The mirrored picture and its blurs ----------------------------------------------------------

# Sideways blur over upright blur: the sine of the angle at which most of a road is seen.
SIDEWAYS_BLUR_RATIO = 0.14


class Mirror(NamedTuple):
    """Mirrored picture."""

    camera: Camera  # camera of the first level
    # Linear light, [H, W, 3], [H, W, 3], [H / 2, W, 3] ...: level k > 0 is blurred upright by 2^k
    # pixels, its rows are 2^(k-1) apart.
    levels: list[Tensor]
    depth: Float[Tensor, "H W"]  # z, 0 for the sky


def blur_upright(
    rgb: Float[Tensor, "H W 3"], *, backend: str = AUTO
) -> list[Float[Tensor, "h W 3"]]:
    """Return the display-encoded picture in linear light, and its blurs, see Mirror.

    backend: on the CPU OpenCV blurs, equal to the definition within float rounding.
    """
    if choose_kernels(backend, rgb) == CPU and rgb.numel() >= NUM_LANES:
        linear = np.empty(tuple(rgb.shape), np.float32)
        with kernel_threads():
            film_kernels.decode_srgb(_flat_array(rgb), linear.reshape(-1))
        image = linear
        levels = [torch.from_numpy(linear)]
        for k in range(1, NUM_LEVELS):
            upright, sideways = map(_gaussian_weights, _added_blur(k))
            if k >= 2:
                image = np.concatenate((image, image[-1:])) if len(image) % 2 else image
                image = cv2.addWeighted(image[0::2], 0.5, image[1::2], 0.5, 0.0)
            image = cv2.sepFilter2D(image, -1, sideways, upright, borderType=cv2.BORDER_REPLICATE)
            levels.append(torch.from_numpy(image))
        return levels
    linear = to_linear(rgb)
    image = linear.permute(2, 0, 1)[:, None]  # [3, 1, H, W]
    reference_levels = [linear]
    for k in range(1, NUM_LEVELS):
        if k >= 2:
            image = _halve_rows(image)
        for axis, sigma in zip((2, 3), _added_blur(k), strict=True):
            image = _blur_axis(image, sigma, axis)
        reference_levels.append(image[:, 0].permute(1, 2, 0))
    return reference_levels


def _added_blur(k: int) -> tuple[float, float]:
    """Return the blur, upright and sideways, that takes level k - 1 to level k.

    Level k is blurred by 2^k pixels, level 0 not at all. The upright standard deviation is in rows
    that are 2^(k-1) apart.
    """
    added = math.sqrt(4.0**k - (4.0 ** (k - 1) if k > 1 else 0.0))
    return added / 2.0 ** (k - 1), SIDEWAYS_BLUR_RATIO * added


def _gaussian_weights(sigma: float) -> np.ndarray:
    """Return the weights of a Gaussian blur."""
    reach = math.ceil(2.5 * sigma)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return (weights / weights.sum()).astype(np.float32)


def _blur_axis(image: Tensor, sigma: float, axis: int) -> Tensor:
    """Blur an image [3, 1, H, W] along one axis."""
    weights = torch.from_numpy(_gaussian_weights(sigma)).to(image)
    reach = len(weights) // 2
    pad = (0, 0, reach, reach) if axis == 2 else (reach, reach, 0, 0)
    shape = (1, 1, -1, 1) if axis == 2 else (1, 1, 1, -1)
    padded = torch.nn.functional.pad(image, pad, mode="replicate")
    return torch.nn.functional.conv2d(padded, weights.reshape(shape))


def _halve_rows(image: Tensor) -> Tensor:
    """Average pairs of rows."""
    if image.shape[2] % 2:
        image = torch.cat((image, image[:, :, -1:]), 2)
    return 0.5 * (image[:, :, 0::2] + image[:, :, 1::2])


def _look_up_levels(levels: list[Tensor], column: Tensor, row: Tensor, sigma: Tensor) -> Tensor:
    """Return colours [P, 3] between the two levels about a blur of sigma pixels."""
    sigma = sigma.clamp_min(1.0)
    lower_level = torch.log2(sigma).floor().clamp(0, NUM_LEVELS - 2)
    level_number = lower_level + (sigma / torch.exp2(lower_level) - 1).clamp_max(1.0)
    out = torch.zeros(len(column), 3, dtype=column.dtype, device=column.device)
    for k, image in enumerate(levels):
        weight = (1 - (level_number - k).abs()).clamp_min(0)
        rows_of_level = torch.nonzero(weight > 0)[:, 0]
        if len(rows_of_level):
            rows_apart = 2.0 ** max(k - 1, 0)
            colours = _bilinear(image, column[rows_of_level], row[rows_of_level] / rows_apart)
            out[rows_of_level] += weight[rows_of_level, None] * colours
    return out


def _bilinear(image: Tensor, column: Tensor, row: Tensor) -> Tensor:
    """Interpolate an image between its pixels."""
    height, width = image.shape[:2]
    x = (column - 0.5).clamp(0, width - 1)
    y = (row - 0.5).clamp(0, height - 1)
    c0 = x.long()
    r0 = y.long()
    c1 = (c0 + 1).clamp_max(width - 1)
    r1 = (r0 + 1).clamp_max(height - 1)
    u = (x - c0)[:, None]
    v = (y - r0)[:, None]
    flat = image.reshape(-1, image.shape[-1])
    top = flat[r0 * width + c0] * (1 - u) + flat[r0 * width + c1] * u
    bottom = flat[r1 * width + c0] * (1 - u) + flat[r1 * width + c1] * u
    return top * (1 - v) + bottom * v


# ---- Pixels of wet ground, and their reflections -------------------------------------------------


class Film(NamedTuple):
    """Water on the ground."""

    wetness: float  # 0 to 1
    puddle_threshold: float  # value of PUDDLE_ORDER above which water stands in puddles
    rings: Rings  # rings of drops on the puddles


def find_ground(
    camera: Camera,
    depth: Float[Tensor, "H W"],
    visible_share: Float[Tensor, "H W"],
    ground: WetGround,
    *,
    backend: str = AUTO,
) -> tuple[Float[Tensor, "H W"], tuple[int, int]]:
    """Find how much of each pixel is open ground.

    Args:
        camera: the camera.
        depth: z of what a pixel shows, 0 = none.
        visible_share: share of the pixel that shows the scene's own splats.
        ground: map of the ground.
        backend: the CPU's kernel equals the definition within float rounding.

    Returns:
        The shares [H, W]; the first row with open ground, and one past the last.
    """
    if choose_kernels(backend, depth, visible_share) == CPU and camera.width >= NUM_LANES:
        share = np.empty(tuple(depth.shape), np.float32)
        row_max = np.empty(len(share), np.float32)
        flat_share = share.reshape(-1)
        with kernel_threads(ROWS_PER_TASK):
            film_kernels.find_ground(
                *_map_view(camera, ground),
                camera.width,
                _flat_array(depth),
                _flat_array(visible_share),
                flat_share,
                row_max,
            )
        rows_with_ground = np.flatnonzero(row_max > 0)
        rows = (
            (int(rows_with_ground[0]), int(rows_with_ground[-1]) + 1)
            if len(rows_with_ground)
            else (0, 0)
        )
        return torch.from_numpy(share), rows
    points, distance, channels = _ground_points(camera, depth, ground)
    height_gap = (points[..., 2] + float(camera.centre[2]) - channels[..., HEIGHT]).abs()
    tolerance_m = GROUND_TOLERANCE_M + GROUND_TOLERANCE_PER_M * distance
    max_offset_m = MAX_GROUND_OFFSET_M + MAX_GROUND_OFFSET_PER_M * distance
    share = (
        visible_share
        * channels[..., EXPOSURE]
        * (1 - _smoothstep(tolerance_m, max_offset_m, height_gap))
    )
    is_ground = (depth > 0) & depth.isfinite() & (points[..., 2] < 0) & (share > MIN_GROUND_SHARE)
    ground_rows = torch.nonzero(is_ground.any(1))[:, 0]
    rows = (int(ground_rows[0]), int(ground_rows[-1]) + 1) if len(ground_rows) else (0, 0)
    return torch.where(is_ground, share, 0.0), rows


def _ground_points(
    camera: Camera, depth: Tensor, ground: WetGround
) -> tuple[Tensor, Tensor, Tensor]:
    """Return points from the eye, their distances, and the map's channels there."""
    finite_depth = torch.where(depth.isfinite(), depth, 0.0).double()
    points = camera.ray_directions(torch.float64, depth.device) * finite_depth[..., None]
    eye = camera.centre.to(depth.device)
    channels = ground.interpolate(points[..., 0] + eye[0], points[..., 1] + eye[1])
    return points.float(), points.norm(dim=-1).float(), channels


def wet_by_film(
    rgb: Float[Tensor, "H W 3"],
    camera: Camera,
    depth: Float[Tensor, "H W"],
    share: Float[Tensor, "H W"],
    ground: WetGround,
    order: DryingMap,
    film: RoadFilm,
    puddle_threshold: float,
    white: float,
    *,
    backend: str = AUTO,
) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"]]:
    """Darken the ground of a picture by the film that lies on it.

    On the CPU, `rgb` and `share` are overwritten.

    Args:
        rgb: display-encoded picture of the dry ground, without fog.
        camera: the camera.
        depth: z of what a pixel shows.
        share: result of `find_ground`.
        ground: map of the ground.
        order: order in which the ground dries.
        film: water on the road.
        puddle_threshold: value of PUDDLE_ORDER above which water stands.
        white: result of `darkening.white_level`.
        backend: the CPU's kernel equals the definition within float rounding.

    Returns:
        The picture, and the share of each pixel whose film mirrors.
    """
    if choose_kernels(backend, rgb, depth, share) == CPU and camera.width >= NUM_LANES:
        rgb = rgb.contiguous()
        share = share.contiguous()
        view, _ = _map_view(camera, ground)
        with kernel_threads(ROWS_PER_TASK):
            film_kernels.wet_ground(
                view,
                order.channels.numpy().reshape(-1),
                camera.width,
                _flat_array(depth),
                _flat_array(share),
                water_numbers(film, puddle_threshold, white),
                make_mottle_table().reshape(-1),
                stain_levels(film.spots),
                _flat_array(rgb),
            )
        return rgb, share
    points, distance, _ = _ground_points(camera, depth, ground)
    eye = camera.centre.to(points.device)
    x = points[..., 0].double() + eye[0]
    y = points[..., 1].double() + eye[1]
    rank, puddle_order, track = ground.interpolate_values(order.channels, x, y).unbind(-1)
    across = distance / camera.fy
    sine = (-points[..., 2] / distance.clamp_min(1e-6)).clamp_min(MIN_FOOTPRINT_SINE)
    for amplitude, texel in ((COARSE_RANK, COARSE_TEXEL_M), (FINE_RANK, FINE_TEXEL_M)):
        weight = (2 - across / sine / texel).clamp(0, 1)
        rank = rank + amplitude * weight * _mottle(x, y, texel)
    puddle = _smoothstep(puddle_threshold - PUDDLE_RIM, puddle_threshold + PUDDLE_RIM, puddle_order)
    spots = stained_share(film.spots, x, y, across / sine.sqrt())
    wetness, mirror = local_water(film, rank, track, spots, puddle)
    is_ground = share > 0
    ratio = wet_ratio(rgb.clamp_min(0), white, torch.where(is_ground, share * wetness, 0.0))
    darkened = torch.where(is_ground[..., None], rgb * ratio, rgb)
    return darkened, torch.where(is_ground, share * mirror, 0.0)


def shade_wet(
    rgb: Float[Tensor, "H W 3"],
    camera: Camera,
    depth: Float[Tensor, "H W"],
    share: Float[Tensor, "H W"],
    ground: WetGround,
    film: Film,
    mirror: Mirror,
    *,
    backend: str = AUTO,
) -> Float[Tensor, "H W 3"]:
    """Add reflections to the wet ground of a picture; on the CPU, `rgb` is overwritten.

    Args:
        rgb: display-encoded picture.
        camera: the camera.
        depth: z of what a pixel shows.
        share: result of `find_ground`.
        ground: map of the ground.
        film: water on the ground.
        mirror: mirrored picture.
        backend: the CPU's kernel equals the definition within float rounding.
    """
    is_wide_enough = camera.width >= NUM_LANES and mirror.camera.width >= 2
    if choose_kernels(backend, rgb, depth, share) == CPU and rgb.is_contiguous() and is_wide_enough:
        with kernel_threads(ROWS_PER_TASK):
            film_kernels.shade_wet(
                *_map_view(camera, ground),
                camera.width,
                _flat_array(depth),
                _flat_array(share),
                *_mirror_arrays(mirror, camera),
                *_water_arrays(film),
                _flat_array(rgb),
            )
        return rgb
    points, distance, channels = _ground_points(camera, depth, ground)
    puddle = film.wetness * _smoothstep(
        film.puddle_threshold - PUDDLE_RIM,
        film.puddle_threshold + PUDDLE_RIM,
        channels[..., PUDDLE_ORDER],
    )
    to_eye = -points / distance.clamp_min(1e-6)[..., None]
    footprint = distance / camera.fy / to_eye[..., 2].clamp_min(MIN_FOOTPRINT_SINE)
    eye = camera.centre.to(points.device)
    x = points[..., 0].double() + eye[0]
    y = points[..., 1].double() + eye[1]
    unevenness = sum(
        amplitude * (2 - footprint / texel).clamp(0, 1) * _mottle(x, y, texel)
        for amplitude, texel in ((COARSE_AMPLITUDE, COARSE_TEXEL_M), (FINE_AMPLITUDE, FINE_TEXEL_M))
    )
    roughness = (
        ASPHALT_ROUGHNESS * (1 - TRACK_SMOOTHING * channels[..., WHEEL_TRACK]) * (1 - unevenness)
    )
    slope_x, slope_y, variance = ring_slopes(film.rings, x, y, footprint)
    puddle_roughness = torch.sqrt(PUDDLE_ROUGHNESS**2 + 0.5 * variance)
    roughness = roughness + puddle * (puddle_roughness - roughness)
    asphalt_weight = 1 - puddle
    slope = (
        -channels[..., SLOPE_X] * asphalt_weight - slope_x * puddle,
        -channels[..., SLOPE_Y] * asphalt_weight - slope_y * puddle,
    )
    normal = torch.nn.functional.normalize(
        torch.stack((*slope, torch.ones_like(asphalt_weight)), -1), dim=-1
    )
    cosine = (normal * to_eye).sum(-1).clamp(0.005, 1)
    film_share = (FILM_SHARE + unevenness + 0.1 * channels[..., WHEEL_TRACK]).clamp(0, 1)
    covered_share = film.wetness * (film_share + (1 - film_share) * puddle)
    strength = share * covered_share * mean_reflectance(cosine, roughness)
    ray = 2 * cosine[..., None] * normal - to_eye
    reflected = _reflected_light(points, distance, ray, roughness, mirror, camera)
    linear = to_linear(rgb)
    mixed = to_display((linear + strength[..., None] * (reflected - linear)).clamp_min(0))
    return torch.where((share > 0)[..., None], mixed, rgb)


def _reflected_light(
    points: Tensor, distance: Tensor, ray: Tensor, roughness: Tensor, mirror: Mirror, camera: Camera
) -> Tensor:
    """Return the linear light [H, W, 3] that the mirrored picture shows in rays from the ground.

    A ray is as long as the flat mirror's.
    """
    view = mirror.camera
    axes = view.camera_from_world[:3, :3].to(ray)
    to_mirror = (view.centre - camera.centre).to(ray)

    def project(vector: Tensor) -> tuple[Tensor, Tensor]:
        """Return column and row of vectors from the mirrored eye."""
        x, y, z = (vector @ axes.T).unbind(-1)
        z = z.clamp_min(1e-3)
        return view.fx * x / z + view.cx, view.fy * y / z + view.cy

    def distance_at(column: Tensor, row: Tensor) -> Tensor:
        """Return the distance from the ground to what the mirrored picture shows in a pixel."""
        c = column.clamp(0, view.width - 1).long()
        r = row.clamp(0, view.height - 1).long()
        z = mirror.depth[r, c]
        camera_point = ((c + 0.5 - view.cx) / view.fx * z, (r + 0.5 - view.cy) / view.fy * z, z)
        mirror_distance = (torch.stack(camera_point, -1) @ axes + to_mirror - points).norm(dim=-1)
        return torch.where(z > 0, mirror_distance, torch.full_like(mirror_distance, SKY_DISTANCE_M))

    mirror_distance = distance_at(*project(points - to_mirror))
    column, row = project(points + mirror_distance[..., None] * ray - to_mirror)
    sigma = camera.fy * 2 * roughness * mirror_distance / (mirror_distance + distance)
    sigma = sigma * sigma / (sigma + MIN_BLUR_PX) * (view.fy / camera.fy)
    colours = _look_up_levels(mirror.levels, column.reshape(-1), row.reshape(-1), sigma.reshape(-1))
    return colours.reshape(*column.shape, 3)


def mean_reflectance(cosine: Float[Tensor, "*B"], slopes: Float[Tensor, "*B"]) -> Tensor:
    """Return Schlick's reflectance, averaged over slopes of a standard deviation.

    Source: Bruneton et al. 2010, "Real-time realistic ocean lighting", section 5.3.
    """
    power = 5 * torch.exp(-2.69 * slopes)
    schlick_term = (1 - cosine).clamp_min(0) ** power / (1 + 22.7 * slopes**1.5)
    return R0 + (1 - R0) * schlick_term


def _smoothstep(low: float | Tensor, high: float | Tensor, value: Tensor) -> Tensor:
    """Smooth step from 0 at low to 1 at high."""
    t = ((value - low) / (high - low)).clamp(0, 1)
    return t * t * (3 - 2 * t)


@functools.cache
def make_mottle_table() -> np.ndarray:
    """float32 [MOTTLE_SIDE] * 2 of unit deviation, smooth over some texels; its sides meet."""
    white = np.random.Generator(np.random.PCG64(1)).standard_normal(2 * (MOTTLE_SIDE,))
    smooth = ndimage.gaussian_filter(white, 1.0, mode="wrap")
    return (smooth / smooth.std()).astype(np.float32)


def _mottle(x: Tensor, y: Tensor, texel_m: float) -> Tensor:
    """Return the noise of the table at points."""
    noise = torch.from_numpy(make_mottle_table()).to(x.device)
    u = x / texel_m
    v = y / texel_m
    i = u.floor()
    j = v.floor()
    u = (u - i).float()
    v = (v - j).float()
    i0 = i.long() % MOTTLE_SIDE
    j0 = j.long() % MOTTLE_SIDE
    i1 = (i0 + 1) % MOTTLE_SIDE
    j1 = (j0 + 1) % MOTTLE_SIDE
    below = noise[j0, i0] * (1 - u) + noise[j0, i1] * u
    return below * (1 - v) + (noise[j1, i0] * (1 - u) + noise[j1, i1] * u) * v


# ---- The kernels' arrays -------------------------------------------------------------------------

# Number of image rows that a thread takes at a time; rows without ground cost nothing.
ROWS_PER_TASK = 8


def _flat_array(part: Tensor) -> np.ndarray:
    """Return a tensor as a flat float32 array."""
    return part.detach().float().contiguous().numpy().reshape(-1)


def _float_array(*numbers: float) -> np.ndarray:
    """Return numbers as a float32 array."""
    return np.array(numbers, np.float32)


def _map_view(camera: Camera, ground: WetGround) -> tuple[film_kernels.MapView, np.ndarray]:
    """Return the view on the map, and the map, as kernels take them."""
    pose = camera.world_from_camera.numpy()
    place = np.ascontiguousarray(pose[:2, 3])
    cells = (place - (ground.left_m, ground.bottom_m)) / GROUND_CELL_M - 0.5
    turns = [place / texel_m % MOTTLE_SIDE for texel_m in (COARSE_TEXEL_M, FINE_TEXEL_M)]
    view = film_kernels.MapView(
        _float_array(1 / camera.fx, 1 / camera.fy, camera.cx, camera.cy),
        np.ascontiguousarray(pose[:3, :3], np.float32),
        _float_array(*cells, 1 / GROUND_CELL_M, pose[2, 3], *turns[0], *turns[1]),
        place,
        *ground.channels.shape[:2],
    )
    return view, ground.channels.numpy().reshape(-1)


def _mirror_arrays(
    mirror: Mirror, camera: Camera
) -> tuple[film_kernels.MirrorView, np.ndarray, np.ndarray, np.ndarray]:
    """Return the mirror as kernels take it: view, colours, levels, depth."""
    view = mirror.camera
    rows = np.array([len(level) for level in mirror.levels])
    mirrored = film_kernels.MirrorView(
        _float_array(view.fx, view.fy, view.cx, view.cy),
        np.ascontiguousarray(view.camera_from_world.numpy()[:3, :3], np.float32),
        (view.centre - camera.centre).float().numpy(),
        view.width,
        view.height,
    )
    colors = np.concatenate(
        [*(_flat_array(level) for level in mirror.levels), _float_array(0.0, 0.0)]
    )
    levels = np.stack([np.append(0, rows[:-1].cumsum()) * view.width, rows])
    return mirrored, colors, levels, _flat_array(mirror.depth)


def _water_arrays(film: Film) -> tuple[film_kernels.WaterOnGround, np.ndarray]:
    """Return the water and the mottle table as kernels take them."""
    numbers = np.float32(film.wetness), np.float32(film.puddle_threshold), *ring_arrays(film.rings)
    return film_kernels.WaterOnGround(*numbers), make_mottle_table().reshape(-1)
