"""What wet ground mirrors: the scene from the eye mirrored in it, blurred by the film's roughness.

    L = (1 - k F) C + k F M        in linear light

C: the ground as drawn; F: the share of light that a rough film reflects; k: how much of the pixel
the film closes over; M: the mirrored picture, through the fog of the whole way. Where fog is
uniform both C and M hold its airlight in their share, so that the sum is exact.

A film's slopes s (standard deviation along one axis) turn the mirrored ray by 2 s up and down, and
by 2 s sin(grazing angle) sideways, about the point where it leaves the ground. Seen from the eye,
that moves what stands a share q = way from the ground / way from the eye by q times as much: lamps
far behind the ground become long upright streaks, and a wall is sharp at its foot. M is blurred
upright to a few widths once, and looked up between two of them pixel by pixel.
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

from augment.cameras import Camera
from augment.effects.wet import kernels
from augment.effects.wet.darkening import display_of, linear_of
from augment.effects.wet.ground import CELL_M, WetGround
from augment.effects.wet.kernels import (
    ASPHALT,
    COARSE,
    COARSE_M,
    FAINT,
    FAR_OFF,
    FAR_PER_M,
    FARTHEST_M,
    FILM,
    FINE,
    FINE_M,
    HEIGHT,
    HOLLOW,
    LEAST_SINE,
    LEVELS,
    MOTTLE_SIDE,
    NEAR_OFF,
    NEAR_PER_M,
    OPEN,
    PUDDLE,
    R0,
    RIM,
    RISE_X,
    RISE_Y,
    SHARP_PX,
    TRACK,
    TRACK_SMOOTHS,
)
from augment.effects.wet.ripples import Rings, numbers_of, ring_slopes
from augment.geometry import rigid
from augment.render.buffers import AUTO, CPU, kernels_for
from augment.render.layout import ABOVE, LANES, HeightClip
from augment.render.threads import kernel_threads

# ---- The plane and its mirrored camera -----------------------------------------------------------

NEAR_M, FAR_M = 1.0, 60.0  # of the ground that the plane is fitted to
RAYS = 24  # a side, through the image


@dataclass(frozen=True)
class Plane:
    """Points x with up . x = offset_m; up: unit, world."""

    up: tuple[float, float, float]
    offset_m: float

    def above(self, lowered_m: float) -> HeightClip:
        return HeightClip(self.offset_m - lowered_m, ABOVE, up=self.up)


def plane_in_view(camera: Camera, ground: WetGround) -> Plane | None:
    """The plane through the open ground that a camera sees, nearest ground first; None where its
    rays meet none.

    Rays march to the map's heights by fixed steps of their length, so that a hill hides what is
    behind it.
    """
    points, weights = _seen_ground(camera, ground)
    if weights.sum() <= 0:
        return None
    middle = (weights[:, None] * points).sum(0) / weights.sum()
    local = points - middle
    a = np.concatenate([local[:, :2], np.ones((len(local), 1))], 1)
    ridge = 1e-3 * weights.sum() * np.diag([1.0, 1.0, 0.0])
    slopes = np.zeros(3)
    for _ in range(3):  # what is off the first plane by much is another surface
        off = np.abs(local[:, 2] - a @ slopes)
        own = weights * (1 / (1 + (off / 0.15) ** 2))
        slopes = np.linalg.solve(
            (a.T * own) @ a + ridge + 1e-9 * np.eye(3), (a.T * own) @ local[:, 2]
        )
    normal = np.array([-slopes[0], -slopes[1], 1.0])
    normal /= np.linalg.norm(normal)
    at = middle + np.array([0, 0, slopes[2]])
    up = (float(normal[0]), float(normal[1]), float(normal[2]))
    plane = Plane(up, float(normal @ at))
    if float(np.dot(normal, camera.centre.numpy())) - plane.offset_m < 0.05:
        return None  # an eye in the ground mirrors nothing
    return plane


def _seen_ground(camera: Camera, ground: WetGround) -> tuple[np.ndarray, np.ndarray]:
    """Points [N, 3] where rays of a grid over the image meet open ground, and weights [N]."""
    small = camera.resized(RAYS, RAYS)
    rays = small.ray_directions(torch.float64).reshape(-1, 3).numpy()
    eye = camera.centre.numpy()
    level = np.linalg.norm(rays[:, :2], axis=1)
    way = NEAR_M * (FAR_M / NEAR_M) ** (np.arange(33) / 32)
    at = eye + (rays / np.maximum(level, 1e-6)[:, None])[:, None] * way[None, :, None]
    heights = ground.nearest(at[..., 0], at[..., 1])[..., HEIGHT]
    under = at[..., 2] <= heights
    first = under.argmax(1)
    hit = under.any(1) & (rays[:, 2] < 0)
    points = at[np.arange(len(rays)), first]
    own = ground.nearest(points[:, 0], points[:, 1])
    points[:, 2] = own[:, HEIGHT]
    weights = np.where(hit, own[:, OPEN], 0) / (1 + way[first] / 10)
    return points, weights


def mirrored_in(camera: Camera, plane: Plane) -> Camera:
    """The camera whose pictures are the reflections that `camera` sees in the plane; its pixel
    (column, row) is the reflection in (column, height - 1 - row).
    """
    n = torch.tensor(plane.up, dtype=torch.float64)
    house = torch.eye(3, dtype=torch.float64) - 2 * n[:, None] * n
    flip = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    rotation = flip[:, None] * camera.camera_from_world[:3, :3] @ house
    eye = house @ camera.centre + 2 * plane.offset_m * n
    pose = rigid(rotation, -rotation @ eye)
    return dataclasses.replace(camera, camera_from_world=pose, cy=camera.height - camera.cy)


# ---- The mirrored picture and its blurs ----------------------------------------------------------

SIDEWAYS = 0.14  # of the blur upright: the sine of the angle at which most of a road is seen


class Mirror(NamedTuple):
    """The mirrored picture. camera: of its first level. levels: linear light [H, W >> k, 3] ...,
    level k > 0 blurred upright by 2^k pixels, its rows 2^(k-1) apart. depth: z, 0 for the sky.
    """

    camera: Camera
    levels: list[Tensor]
    depth: Float[Tensor, "H W"]


def blur_upright(
    rgb: Float[Tensor, "H W 3"], *, backend: str = AUTO
) -> list[Float[Tensor, "h W 3"]]:
    """The display-encoded picture in linear light, and its blurs: see Mirror.

    backend: on the CPU OpenCV blurs, equal to the definition within float rounding.
    """
    if kernels_for(backend, rgb) == CPU and rgb.numel() >= LANES:
        linear = np.empty(tuple(rgb.shape), np.float32)
        with kernel_threads():
            kernels.decode(_flat(rgb), linear.reshape(-1))
        image, levels = linear, [torch.from_numpy(linear)]
        for k in range(1, LEVELS):
            upright, aside = map(_taps, _widening(k))
            if k >= 2:
                image = np.concatenate((image, image[-1:])) if len(image) % 2 else image
                image = cv2.addWeighted(image[0::2], 0.5, image[1::2], 0.5, 0.0)
            image = cv2.sepFilter2D(image, -1, aside, upright, borderType=cv2.BORDER_REPLICATE)
            levels.append(torch.from_numpy(image))
        return levels
    linear = linear_of(rgb)
    image, found = linear.permute(2, 0, 1)[:, None], [linear]  # [3, 1, H, W]
    for k in range(1, LEVELS):
        if k >= 2:
            image = _halved(image)
        for axis, sigma in zip((2, 3), _widening(k), strict=True):
            image = _gauss(image, sigma, axis)
        found.append(image[:, 0].permute(1, 2, 0))
    return found


def _widening(k: int) -> tuple[float, float]:
    """Standard deviations upright, in rows that are 2^(k-1) apart, and sideways, that take a blur
    of 2^(k-1) pixels (or none) to one of 2^k.
    """
    added = math.sqrt(4.0**k - (4.0 ** (k - 1) if k > 1 else 0.0))
    return added / 2.0 ** (k - 1), SIDEWAYS * added


def _taps(sigma: float) -> np.ndarray:
    reach = math.ceil(2.5 * sigma)
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return (taps / taps.sum()).astype(np.float32)


def _gauss(image: Tensor, sigma: float, axis: int) -> Tensor:
    taps = torch.from_numpy(_taps(sigma)).to(image)
    reach = len(taps) // 2
    pad = (0, 0, reach, reach) if axis == 2 else (reach, reach, 0, 0)
    shape = (1, 1, -1, 1) if axis == 2 else (1, 1, 1, -1)
    padded = torch.nn.functional.pad(image, pad, mode="replicate")
    return torch.nn.functional.conv2d(padded, taps.reshape(shape))


def _halved(image: Tensor) -> Tensor:
    if image.shape[2] % 2:
        image = torch.cat((image, image[:, :, -1:]), 2)
    return 0.5 * (image[:, :, 0::2] + image[:, :, 1::2])


def _look_up(levels: list[Tensor], column: Tensor, row: Tensor, sigma: Tensor) -> Tensor:
    """Colours [P, 3] between the two levels about a blur of sigma pixels."""
    sigma = sigma.clamp_min(1.0)
    low = torch.log2(sigma).floor().clamp(0, LEVELS - 2)
    number = low + (sigma / torch.exp2(low) - 1).clamp_max(1.0)
    out = torch.zeros(len(column), 3, dtype=column.dtype, device=column.device)
    for k, image in enumerate(levels):
        weight = (1 - (number - k).abs()).clamp_min(0)
        some = torch.nonzero(weight > 0)[:, 0]
        if len(some):
            rows_apart = 2.0 ** max(k - 1, 0)
            seen = _bilinear(image, column[some], row[some] / rows_apart)
            out[some] += weight[some, None] * seen
    return out


def _bilinear(image: Tensor, column: Tensor, row: Tensor) -> Tensor:
    height, width = image.shape[:2]
    x, y = (column - 0.5).clamp(0, width - 1), (row - 0.5).clamp(0, height - 1)
    c0, r0 = x.long(), y.long()
    c1, r1 = (c0 + 1).clamp_max(width - 1), (r0 + 1).clamp_max(height - 1)
    u, v = (x - c0)[:, None], (y - r0)[:, None]
    flat = image.reshape(-1, image.shape[-1])
    top = flat[r0 * width + c0] * (1 - u) + flat[r0 * width + c1] * u
    bottom = flat[r1 * width + c0] * (1 - u) + flat[r1 * width + c1] * u
    return top * (1 - v) + bottom * v


# ---- Where wet ground is seen, and what it mirrors -----------------------------------------------


class Film(NamedTuple):
    """Water on the ground. wetness: 0 to 1. level: of HOLLOW, beyond which it stands in puddles.
    rings: on them.
    """

    wetness: float
    level: float
    rings: Rings


def find_ground(
    camera: Camera,
    depth: Float[Tensor, "H W"],
    shown: Float[Tensor, "H W"],
    ground: WetGround,
    *,
    backend: str = AUTO,
) -> tuple[Float[Tensor, "H W"], tuple[int, int]]:
    """How much of each pixel is open ground, and the first row and one past the last that has any.

    depth: z of what a pixel shows, 0 = none. shown: how much of the pixel is the scene's own.
    backend: the CPU's kernel equals the definition within float rounding.
    """
    if kernels_for(backend, depth, shown) == CPU and camera.width >= LANES:
        share = np.empty(tuple(depth.shape), np.float32)
        most, flat = np.empty(len(share), np.float32), share.reshape(-1)
        with kernel_threads(ROWS):
            kernels.find_ground(
                *_view(camera, ground), camera.width, _flat(depth), _flat(shown), flat, most
            )
        found = np.flatnonzero(most > 0)
        rows = (int(found[0]), int(found[-1]) + 1) if len(found) else (0, 0)
        return torch.from_numpy(share), rows
    points, distance, channels = _points(camera, depth, ground)
    off = (points[..., 2] + float(camera.centre[2]) - channels[..., HEIGHT]).abs()
    near, far = NEAR_OFF + NEAR_PER_M * distance, FAR_OFF + FAR_PER_M * distance
    share = shown * channels[..., OPEN] * (1 - _smoothstep(near, far, off))
    is_ground = (depth > 0) & depth.isfinite() & (points[..., 2] < 0) & (share > FAINT)
    found_rows = torch.nonzero(is_ground.any(1))[:, 0]
    rows = (int(found_rows[0]), int(found_rows[-1]) + 1) if len(found_rows) else (0, 0)
    return torch.where(is_ground, share, 0.0), rows


def _points(camera: Camera, depth: Tensor, ground: WetGround) -> tuple[Tensor, Tensor, Tensor]:
    """Points from the eye, how far they are, and the map's channels there."""
    known = torch.where(depth.isfinite(), depth, 0.0).double()
    points = camera.ray_directions(torch.float64, depth.device) * known[..., None]
    eye = camera.centre.to(depth.device)
    channels = ground.at(points[..., 0] + eye[0], points[..., 1] + eye[1])
    return points.float(), points.norm(dim=-1).float(), channels


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
    """The picture with reflections on its wet ground; on the CPU, `rgb` is overwritten.

    share: of `find_ground`. backend: as there.
    """
    wide = camera.width >= LANES and mirror.camera.width >= 2
    if kernels_for(backend, rgb, depth, share) == CPU and rgb.is_contiguous() and wide:
        with kernel_threads(ROWS):
            kernels.shade_wet(
                *_view(camera, ground), camera.width, _flat(depth), _flat(share),
                *_mirrored(mirror, camera), *_water(film), _flat(rgb),
            )  # fmt: skip
        return rgb
    points, distance, ch = _points(camera, depth, ground)
    puddle = film.wetness * _smoothstep(film.level - RIM, film.level + RIM, ch[..., HOLLOW])
    to_eye = -points / distance.clamp_min(1e-6)[..., None]
    footprint = distance / camera.fy / to_eye[..., 2].clamp_min(LEAST_SINE)
    eye = camera.centre.to(points.device)
    x, y = points[..., 0].double() + eye[0], points[..., 1].double() + eye[1]
    uneven = sum(
        amount * (2 - footprint / texel).clamp(0, 1) * _mottle(x, y, texel)
        for amount, texel in ((COARSE, COARSE_M), (FINE, FINE_M))
    )
    rough = ASPHALT * (1 - TRACK_SMOOTHS * ch[..., TRACK]) * (1 - uneven)
    slope_x, slope_y, variance = ring_slopes(film.rings, x, y, footprint)
    still = torch.sqrt(PUDDLE**2 + 0.5 * variance)
    rough = rough + puddle * (still - rough)
    flat = 1 - puddle
    slope = (-ch[..., RISE_X] * flat - slope_x * puddle, -ch[..., RISE_Y] * flat - slope_y * puddle)
    normal = torch.nn.functional.normalize(torch.stack((*slope, torch.ones_like(flat)), -1), dim=-1)
    cosine = (normal * to_eye).sum(-1).clamp(0.005, 1)
    own_film = (FILM + uneven + 0.1 * ch[..., TRACK]).clamp(0, 1)
    cover = film.wetness * (own_film + (1 - own_film) * puddle)
    strength = share * cover * mean_reflectance(cosine, rough)
    ray = 2 * cosine[..., None] * normal - to_eye
    seen = _seen_in_mirror(points, distance, ray, rough, mirror, camera)
    own = linear_of(rgb)
    mixed = display_of((own + strength[..., None] * (seen - own)).clamp_min(0))
    return torch.where((share > 0)[..., None], mixed, rgb)


def _seen_in_mirror(
    points: Tensor, distance: Tensor, ray: Tensor, rough: Tensor, mirror: Mirror, camera: Camera
) -> Tensor:
    """Linear light [H, W, 3] that the mirrored picture shows in rays from the ground.

    A ray is as long as the flat mirror's.
    """
    view = mirror.camera
    axes = view.camera_from_world[:3, :3].to(ray)
    to_mirror = (view.centre - camera.centre).to(ray)

    def project(vector: Tensor) -> tuple[Tensor, Tensor]:
        x, y, z = (vector @ axes.T).unbind(-1)
        z = z.clamp_min(1e-3)
        return view.fx * x / z + view.cx, view.fy * y / z + view.cy

    def way_at(column: Tensor, row: Tensor) -> Tensor:
        c = column.clamp(0, view.width - 1).long()
        r = row.clamp(0, view.height - 1).long()
        z = mirror.depth[r, c]
        at = ((c + 0.5 - view.cx) / view.fx * z, (r + 0.5 - view.cy) / view.fy * z, z)
        way = (torch.stack(at, -1) @ axes + to_mirror - points).norm(dim=-1)
        return torch.where(z > 0, way, torch.full_like(way, FARTHEST_M))

    way = way_at(*project(points - to_mirror))
    column, row = project(points + way[..., None] * ray - to_mirror)
    sigma = camera.fy * 2 * rough * way / (way + distance)
    sigma = sigma * sigma / (sigma + SHARP_PX) * (view.fy / camera.fy)
    found = _look_up(mirror.levels, column.reshape(-1), row.reshape(-1), sigma.reshape(-1))
    return found.reshape(*column.shape, 3)


def mean_reflectance(cosine: Float[Tensor, "*B"], slopes: Float[Tensor, "*B"]) -> Tensor:
    """Schlick's reflectance, averaged over slopes of a standard deviation (Bruneton et al. 2010,
    "Real-time realistic ocean lighting", section 5.3).
    """
    power = 5 * torch.exp(-2.69 * slopes)
    rest = (1 - cosine).clamp_min(0) ** power / (1 + 22.7 * slopes**1.5)
    return R0 + (1 - R0) * rest


def _smoothstep(low: float | Tensor, high: float | Tensor, value: Tensor) -> Tensor:
    t = ((value - low) / (high - low)).clamp(0, 1)
    return t * t * (3 - 2 * t)


@functools.cache
def mottle_table() -> np.ndarray:
    """float32 [MOTTLE_SIDE] * 2 of unit deviation, smooth over some texels, whose sides meet."""
    white = np.random.Generator(np.random.PCG64(1)).standard_normal(2 * (MOTTLE_SIDE,))
    smooth = ndimage.gaussian_filter(white, 1.0, mode="wrap")
    return (smooth / smooth.std()).astype(np.float32)


def _mottle(x: Tensor, y: Tensor, texel_m: float) -> Tensor:
    noise = torch.from_numpy(mottle_table()).to(x.device)
    u, v = x / texel_m, y / texel_m
    i, j = u.floor(), v.floor()
    u, v = (u - i).float(), (v - j).float()
    i0, j0 = (i.long() % MOTTLE_SIDE), (j.long() % MOTTLE_SIDE)
    i1, j1 = (i0 + 1) % MOTTLE_SIDE, (j0 + 1) % MOTTLE_SIDE
    below = noise[j0, i0] * (1 - u) + noise[j0, i1] * u
    return below * (1 - v) + (noise[j1, i0] * (1 - u) + noise[j1, i1] * u) * v


# ---- The kernels' arrays -------------------------------------------------------------------------

ROWS = 8  # image rows a thread takes at a time: rows without ground cost nothing


def _flat(part: Tensor) -> np.ndarray:
    return part.detach().float().contiguous().numpy().reshape(-1)


def _floats(*numbers: float) -> np.ndarray:
    return np.array(numbers, np.float32)


def _view(camera: Camera, ground: WetGround) -> tuple[kernels.View, np.ndarray]:
    pose = camera.world_from_camera.numpy()
    place = np.ascontiguousarray(pose[:2, 3])
    cells = (place - (ground.left_m, ground.bottom_m)) / CELL_M - 0.5
    turns = [place / texel_m % MOTTLE_SIDE for texel_m in (COARSE_M, FINE_M)]
    view = kernels.View(
        _floats(1 / camera.fx, 1 / camera.fy, camera.cx, camera.cy),
        np.ascontiguousarray(pose[:3, :3], np.float32),
        _floats(*cells, 1 / CELL_M, pose[2, 3], *turns[0], *turns[1]),
        place,
        *ground.channels.shape[:2],
    )
    return view, ground.channels.numpy().reshape(-1)


def _mirrored(
    mirror: Mirror, camera: Camera
) -> tuple[kernels.Mirrored, np.ndarray, np.ndarray, np.ndarray]:
    view = mirror.camera
    rows = np.array([len(level) for level in mirror.levels])
    mirrored = kernels.Mirrored(
        _floats(view.fx, view.fy, view.cx, view.cy),
        np.ascontiguousarray(view.camera_from_world.numpy()[:3, :3], np.float32),
        (view.centre - camera.centre).float().numpy(),
        view.width,
        view.height,
    )
    colors = np.concatenate([*(_flat(level) for level in mirror.levels), _floats(0.0, 0.0)])
    levels = np.stack([np.append(0, rows[:-1].cumsum()) * view.width, rows])
    return mirrored, colors, levels, _flat(mirror.depth)


def _water(film: Film) -> tuple[kernels.Water, np.ndarray]:
    numbers = np.float32(film.wetness), np.float32(film.level), *numbers_of(film.rings)
    return kernels.Water(*numbers), mottle_table().reshape(-1)
