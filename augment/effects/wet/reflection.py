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
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from augment.cameras import Camera
from augment.effects.wet.darkening import display_of, linear_of
from augment.effects.wet.ground import HEIGHT, HOLLOW, OPEN, RISE_X, RISE_Y, TRACK, WetGround
from augment.geometry import rigid
from augment.render.layout import ABOVE, HeightClip

R0 = 0.0201  # of water under a right angle
ASPHALT, PUDDLE = 0.085, 0.008  # standard deviations of slopes: alpha / sqrt 2 of 0.12 and 0.011
TRACK_SMOOTHS = 0.35  # share of the roughness that wheels have polished away
FILM = 0.75  # of wet asphalt that shows water: stones stand out of it
# Where a puddle's rim lies, in HOLLOW.
RIM = 0.25

# ---- The plane and its mirrored camera -----------------------------------------------------------

NEAR_M, FAR_M = 1.0, 60.0  # of the ground that the plane is fitted to
RAYS = 48  # a side, through the image


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
        slopes = np.linalg.solve((a.T * own) @ a + ridge + 1e-9 * np.eye(3), (a.T * own) @ local[:, 2])
    normal = np.array([-slopes[0], -slopes[1], 1.0])
    normal /= np.linalg.norm(normal)
    at = middle + (0, 0, slopes[2])
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
    channels = ground.at(torch.from_numpy(at[..., 0]), torch.from_numpy(at[..., 1])).numpy()
    under = at[..., 2] <= channels[..., HEIGHT]
    first = under.argmax(1)
    hit = under.any(1) & (rays[:, 2] < 0)
    own = channels[np.arange(len(rays)), first]
    points = at[np.arange(len(rays)), first]
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
LEVELS = 7  # sharp, and standard deviations of 2 to 64 pixels


class Mirror(NamedTuple):
    """The mirrored picture. camera: of its first level. levels: linear light [H, W >> k, 3] ...,
    level k > 0 blurred upright by 2^k pixels, its rows 2^(k-1) apart. depth: z, 0 for the sky.
    """

    camera: Camera
    levels: list[Tensor]
    depth: Float[Tensor, "H W"]


def blur_upright(linear: Float[Tensor, "H W 3"]) -> list[Tensor]:
    """The picture and its blurs: see Mirror."""
    image = linear.permute(2, 0, 1)[:, None]  # [3, 1, H, W]
    levels = [linear]
    for k in range(1, LEVELS):
        # In rows that are 2^(k-2) apart, from a deviation of 2^(k-1) pixels to one of 2^k.
        apart = 2.0 ** max(k - 2, 0)
        before = 0.0 if k == 1 else 4.0 ** (k - 1)
        rows = math.sqrt(4.0**k - before) / apart
        aside = SIDEWAYS * math.sqrt(4.0**k - before)
        image = _gauss(_gauss(image, rows, 2), aside, 3)
        if k >= 2:
            image = _halved(image)
        levels.append(image[:, 0].permute(1, 2, 0))
    return levels


def _gauss(image: Tensor, sigma: float, axis: int) -> Tensor:
    reach = math.ceil(2.5 * sigma)
    if reach < 1:
        return image
    taps = torch.exp(-0.5 * (torch.arange(-reach, reach + 1, device=image.device) / sigma) ** 2)
    taps = (taps / taps.sum()).to(image.dtype)
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
    number = torch.log2(sigma.clamp_min(1.0)).clamp(0, LEVELS - 1)
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
    """Water on the ground. wetness: 0 to 1. level: of HOLLOW, beyond which it stands in puddles."""

    wetness: float
    level: float


def mean_reflectance(cosine: Float[Tensor, "*B"], slopes: Float[Tensor, "*B"]) -> Tensor:
    """Schlick's reflectance, averaged over slopes of a standard deviation (Bruneton et al. 2010,
    "Real-time realistic ocean lighting", section 5.3).
    """
    power = 5 * torch.exp(-2.69 * slopes)
    rest = (1 - cosine).clamp_min(0) ** power / (1 + 22.7 * slopes**1.5)
    return R0 + (1 - R0) * rest


def smoothstep(low: float | Tensor, high: float | Tensor, value: Tensor) -> Tensor:
    t = ((value - low) / (high - low)).clamp(0, 1)
    return t * t * (3 - 2 * t)


class Seen(NamedTuple):
    """Pixels that show wet ground: index [P] into the flat image; points [P, 3] from the eye;
    channels [P, C] of the map; share [P] of the pixel that is it.
    """

    index: Tensor
    points: Tensor
    channels: Tensor
    share: Tensor


def find_ground(
    camera: Camera,
    depth: Float[Tensor, "H W"],
    shown: Float[Tensor, "H W"],
    ground: WetGround,
) -> Seen:
    """The pixels whose surface is open ground. shown: how much of each pixel is the scene's."""
    rays = camera.ray_directions(torch.float32, depth.device)
    index = torch.nonzero(((rays[..., 2] < 0) & (depth > 0) & (shown > 0)).reshape(-1))[:, 0]
    points = rays.reshape(-1, 3)[index] * depth.reshape(-1)[index, None]
    eye = camera.centre.to(depth.device)
    x, y = points[:, 0].double() + eye[0], points[:, 1].double() + eye[1]
    channels = ground.at(x, y)
    z = points[:, 2] + float(eye[2])
    off = (z - channels[:, HEIGHT]).abs()
    distance = points.norm(dim=-1)
    agrees = 1 - smoothstep(0.08 + 0.003 * distance, 0.2 + 0.008 * distance, off)
    share = shown.reshape(-1)[index] * channels[:, OPEN] * agrees
    kept = torch.nonzero(share > 0.004)[:, 0]
    return Seen(index[kept], points[kept], channels[kept], share[kept])


def shade_wet(
    rgb: Float[Tensor, "H W 3"],
    camera: Camera,
    seen: Seen,
    film: Film,
    plane: Plane,
    mirror: Mirror,
) -> Float[Tensor, "H W 3"]:
    """The picture with reflections on its wet ground."""
    ch = seen.channels
    puddle = film.wetness * smoothstep(film.level - RIM, film.level + RIM, ch[:, HOLLOW])
    flat = (1 - puddle)
    normal = torch.stack((-ch[:, RISE_X] * flat, -ch[:, RISE_Y] * flat, torch.ones_like(flat)), -1)
    normal = torch.nn.functional.normalize(normal, dim=-1)
    distance = seen.points.norm(dim=-1)
    to_eye = -seen.points / distance[:, None]
    cosine = (normal * to_eye).sum(-1).clamp(0.005, 1)
    rough = ASPHALT * (1 - TRACK_SMOOTHS * ch[:, TRACK])
    rough = rough + puddle * (PUDDLE - rough)
    cover = film.wetness * (FILM + (1 - FILM) * puddle)
    strength = seen.share * cover * mean_reflectance(cosine, rough)
    ray = 2 * cosine[:, None] * normal - to_eye

    up = torch.tensor(plane.up, dtype=ray.dtype, device=ray.device)
    height = float(np.dot(plane.up, camera.centre.numpy())) - plane.offset_m
    to_mirror = -2 * height * up  # from the eye to the mirrored one
    view = mirror.camera
    axes = view.camera_from_world[:3, :3].to(ray)

    def project(vector: Tensor) -> tuple[Tensor, Tensor]:
        x, y, z = (vector @ axes.T).unbind(-1)
        z = z.clamp_min(1e-3)
        return view.fx * x / z + view.cx, view.fy * y / z + view.cy

    def way_at(column: Tensor, row: Tensor) -> Tensor:
        """Metres from the ground to what the mirrored picture shows; infinite of the sky."""
        c = column.clamp(0, view.width - 1).long()
        r = row.clamp(0, view.height - 1).long()
        z = mirror.depth[r, c]
        at = torch.stack(((c + 0.5 - view.cx) / view.fx * z, (r + 0.5 - view.cy) / view.fy * z, z), -1)
        way = (at @ axes + to_mirror - seen.points).norm(dim=-1)
        return torch.where(z > 0, way, torch.full_like(way, 1e5))

    way = way_at(*project(seen.points - to_mirror))
    end = seen.points + way[:, None] * ray - to_mirror
    column, row = project(end)
    way = way_at(column, row)
    sigma = view.fy * 2 * rough * way / (way + distance)
    sigma = sigma * sigma / (sigma + 1.0)  # less than a pixel is none
    seen_there = _look_up(mirror.levels, column, row, sigma)
    flat_rgb = rgb.reshape(-1, 3)
    own = linear_of(flat_rgb[seen.index])
    mixed = own + strength[:, None] * (seen_there - own)
    out = flat_rgb.clone()
    out[seen.index] = display_of(mixed.clamp_min(0))
    return out.reshape(rgb.shape)
