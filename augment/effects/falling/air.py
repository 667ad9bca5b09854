"""Rain or snowfall before a finished picture: near drops one by one, the rest as a veil.

A class of drops is drawn where it is at least `min_width_px` wide, fading out over the last quarter
of that depth. What is not drawn takes its share of the light by Beer-Lambert, so that the
extinction of near drops and far veil is that of the rate, whatever is drawn:

    out = glow + clear (behind - glow)           behind = airlight + exp(-tau) (picture - airlight)

clear: share of a pixel that no drop covered while the shutter was open: a drop of diameter D whose
image moves by a length L covers what lies on its way for D / (L + D) of the exposure (Garg and
Nayar 2007, "Vision and Rain"), over the sizes of drop, defocus and pixel. glow: light of a drop,
which bends that of a cone of 165 degrees about the line of sight (ibid.) into it: about the mean of
a half space. tau: optical depth of the rest, up to the surface, or up through a layer of LAYER_M
before the sky. airlight: the sky's above the horizon. All in squares of display-encoded colours,
which stand for linear light.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from augment.cameras import Camera
from augment.effects.falling import kernels
from augment.effects.falling.drops import Kind, Sizes, cell_counts, sizes_of
from augment.effects.falling.shutter import STANDING, Motion
from augment.effects.snow.light import display_from_linear, light_of
from augment.memo import memo_of
from augment.render.buffers import CPU, kernels_for
from augment.render.fog import MAX_EXPONENT, Fog
from augment.render.layout import LANES
from augment.render.threads import kernel_threads
from augment.rng import rng_for
from augment.scene import Scene
from augment.sky import is_stand_in

LAYER_M = 1000.0  # from which rain and snow fall
MAX_DROPS = 50_000  # drawn in a picture; what is beyond is veil sooner
APERTURE_M = 3e-3
FOCUS_M = 6.0  # a lens of 6 mm at f/2, as cars have
NEAR_M = 0.2  # no drop is closer
UNKNOWN_AIRLIGHT = (0.76, 0.78, 0.80)  # display-encoded, of scenes that know no sky
_HORIZON_SINE = math.sin(math.radians(15.0))  # up to here is "above the horizon"
_SAMPLES = 4096  # of directions
_AROUND_M = 30.0  # how far away most of what lights a drop is
_REFRACTED = 0.94
_SCATTERED = 0.5  # how much of its light a drop, or a flake, has from behind it
_AMONG_FLAKES = 0.5  # of a flake's light, which the flakes around it have scattered
CLEAR = 0.95  # of a pixel: where near drops leave less it is the mask's
SWAY_REACH_S = 0.95  # kernels._sway moves no flake farther than its speed in so long


@dataclass(frozen=True)
class Falling:
    """What falls through a scene's air. wind_mps: of x and y, where it blows to. sway_mps: of
    eddies and flutter. color: of the veil, None for the sky's.
    """

    kind: Kind
    rate_mm_h: float
    wind_mps: tuple[float, float]
    sway_mps: float
    seed: int
    exposure_s: float
    min_width_px: float
    color: tuple[float, float, float] | None = None

    @property
    def sizes(self) -> Sizes:
        return sizes_of(self.kind, self.rate_mm_h)


# ---- Its light -----------------------------------------------------------------------------------


class Glow(NamedTuple):
    """Squares of display-encoded colours. airlight [3]. mean [3]: over all directions. slope
    [3, 3]: what a drop adds to it towards world x, y and z, by channel.
    """

    airlight: np.ndarray
    mean: np.ndarray
    slope: np.ndarray


def glow_of(scene: Scene) -> Glow:
    """The light of drops in a scene, of its sky above and its ground below; worked out once."""

    def find() -> Glow:
        index = np.arange(_SAMPLES)
        z = 1 - (2 * index + 1) / _SAMPLES
        angle = index * (math.pi * (3 - math.sqrt(5)))
        flat = np.sqrt(1 - z * z)
        directions = np.stack([flat * np.cos(angle), flat * np.sin(angle), z], 1)
        unknown = np.asarray(UNKNOWN_AIRLIGHT) ** 2
        light = np.tile(unknown, (_SAMPLES, 1))
        above = z > 0
        if not is_stand_in(scene.sky):
            rgb = scene.sky.sample(torch.from_numpy(directions[above].astype(np.float32)))
            light[above] = np.clip(np.nan_to_num(rgb.double().numpy()), 0, 1) ** 2
        ground = np.asarray(light_of(scene).ground_rgb_linear)
        light[~above] = display_from_linear(np.clip(ground, 0, 1)) ** 2
        # The mean of a half space about d of what varies as c . d' is c . d / 2, and c is 3 <l d'>.
        slope = 1.5 * (light[:, :, None] * directions[:, None]).mean(0)
        return Glow(light[above & (z < _HORIZON_SINE)].mean(0), light.mean(0), slope)

    return memo_of(scene).get(("light of what falls",), find)


def _in_fog(glow: Glow, fog: Fog | None, eye_z_m: float, extinction_per_m: float) -> Glow:
    """The light where there is fog as well, which surrounds the drops and is behind them."""
    if fog is None:
        return glow
    sigma = fog.sigma_per_m
    color = np.asarray(fog.rgb, np.float64) ** 2
    if fog.scale_height_m is not None:
        climb = (eye_z_m - fog.base_z_m) / fog.scale_height_m
        sigma *= math.exp(min(max(-climb, -MAX_EXPONENT), MAX_EXPONENT))
    share = sigma / (sigma + extinction_per_m)
    clear = math.exp(-sigma * _AROUND_M)
    return Glow(
        glow.airlight + share * (color - glow.airlight),
        color + clear * (glow.mean - color),
        glow.slope * clear,
    )


# ---- Which drops a camera sees -------------------------------------------------------------------


class Walk(NamedTuple):
    """Arguments of kernels.find_drops, in its order."""

    slabs: np.ndarray
    columns: np.ndarray
    cells: np.ndarray
    keys: np.ndarray
    moves: np.ndarray
    sways: np.ndarray
    quantiles: np.ndarray
    shares: np.ndarray
    planes: np.ndarray
    shutter: np.ndarray
    lens: np.ndarray


def drawn_depths_m(falling: Falling, camera: Camera) -> np.ndarray:
    """Depth to which each class is drawn [B]: where it is `min_width_px` wide, less where there
    would be more than MAX_DROPS, 0 where none is worth it.
    """
    sizes = falling.sizes
    focal = math.sqrt(camera.fx * camera.fy)
    farthest = sizes.diameters_m * focal / falling.min_width_px
    solid = camera.width * camera.height / (3 * camera.fx * camera.fy)  # of a pyramid, over depth^3
    drawn = float((sizes.counts_per_m3 * farthest**3).sum()) * solid
    farthest *= min(1.0, (MAX_DROPS / max(drawn, 1e-300)) ** (1 / 3))
    return np.where(farthest > NEAR_M, farthest, 0.0)


def walk_of(falling: Falling, camera: Camera, motion: Motion, scene: str) -> Walk:
    """Which cells the camera's view crosses, and where their drops are meanwhile."""
    sizes = falling.sizes
    farthest = drawn_depths_m(falling, camera)
    half_s = falling.exposure_s / 2
    seconds = camera.timestamp_ns * 1e-9
    times = seconds + np.array([-half_s, 0.0, half_s])
    velocity = np.zeros((len(farthest), 3))
    velocity[:, :2] = falling.wind_mps
    velocity[:, 2] = -sizes.speeds_mps
    moves = velocity[:, None] * times[:, None]  # [B, 3, 3]
    poses = np.stack([motion.pose_after(camera, s) for s in (-half_s, half_s)])
    cells_m = sizes.cells_m
    speeds = np.linalg.norm(velocity - motion.velocity_mps, axis=1)
    speeds += np.linalg.norm(motion.turn_radps) * farthest
    spare = half_s * speeds + sizes.quantiles_m[:, -1] / 2 + SWAY_REACH_S * falling.sway_mps
    spare += APERTURE_M / 2 * np.maximum(1, farthest / FOCUS_M)
    spare += kernels.LEAST_RADIUS / math.sqrt(camera.fx * camera.fy) * farthest
    reach = cells_m * math.sqrt(0.75) + spare
    # Of the image's sides, inwards; then of its front.
    normals = np.array(
        [
            [camera.fx, 0, camera.cx],
            [-camera.fx, 0, camera.width - camera.cx],
            [0, camera.fy, camera.cy],
            [0, -camera.fy, camera.height - camera.cy],
            [0, 0, 1.0],
        ]
    )
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    pose = camera.camera_from_world.numpy()
    planes = np.concatenate([normals @ pose[:3, :3], normals @ pose[:3, 3:]], 1)
    planes[4, 3] -= NEAR_M
    slabs, columns = _columns_of(camera, cells_m, reach, farthest, moves[:, 1])
    rng = rng_for(seed=falling.seed, scene=scene, effect=f"{falling.kind} in the air")
    lens = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
    return Walk(
        slabs,
        columns,
        np.stack([cells_m, reach, farthest, spare], 1),
        rng.integers(0, 2**64, len(farthest), np.uint64),
        moves,
        _sways(falling.sway_mps, seconds),
        sizes.quantiles_m,
        cell_counts(),
        planes,
        np.ascontiguousarray(poses[:, :3]),
        np.array([*lens, NEAR_M, APERTURE_M, FOCUS_M], np.float64),
    )


def _sways(speed_mps: float, seconds: float) -> np.ndarray:
    """As kernels.find_drops takes them. Turns, which reference.sway counts in radians: whole ones
    left out, which would take the digits of what is added.
    """
    rates = [2.0 + 0.7 * wave for wave in range(3)]
    radians = np.array([*(rate * seconds for rate in rates), 4 * seconds])
    per_number = (8 * seconds + 50) * 2.0**-21
    return np.append((speed_mps, seconds), np.append(radians, per_number) / (2 * math.pi) % 1)


def _columns_of(
    camera: Camera, cells_m: np.ndarray, reach: np.ndarray, farthest: np.ndarray, moved: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """slabs and columns of the walk: the cells below and above each class's pyramid of sight."""
    corners = np.array([(u, v) for u in (0.0, camera.width) for v in (0.0, camera.height)])
    corners = (corners - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    world = camera.world_from_camera[:3, :3].numpy()
    rays = np.concatenate([corners, np.ones((4, 1))], 1) @ world.T
    rays = np.concatenate([rays, np.zeros((1, 3))])  # and the eye
    around = camera.centre.numpy()[:2] + rays[:, :2] * farthest[:, None, None]  # [B, 5, 2]
    low = (around.min(1) - reach[:, None] - moved[:, :2]) / cells_m[:, None] - 0.5
    high = (around.max(1) + reach[:, None] - moved[:, :2]) / cells_m[:, None] - 0.5
    first = np.floor(low).astype(np.int64)
    end = np.ceil(high).astype(np.int64) + 1
    slabs = [
        np.stack([np.full(b[0] - a[0], number), np.arange(a[0], b[0])], 1)
        for number, (a, b) in enumerate(zip(first, end, strict=True))
        if farthest[number] > 0
    ]
    slabs.append(np.zeros((0, 2), np.int64))
    return np.concatenate(slabs), np.stack([first[:, 1], end[:, 1]], 1)


def find_drops(walk: Walk) -> Float32[np.ndarray, "N 9"]:
    """The drops before a camera as kernels.find_drops describes them, in the order of the cells."""
    held = np.zeros(len(walk.slabs), np.int64)
    empty = np.empty((0, kernels.NUM_NUMBERS), np.float32)
    with kernel_threads(1):
        kernels.find_drops(*walk, np.zeros_like(held), held, empty)
        if not held.any():
            return empty
        found = np.empty((int(held.sum()), kernels.NUM_NUMBERS), np.float32)
        offsets = np.cumsum(held) - held
        counts = np.empty_like(held)
        kernels.find_drops(*walk, offsets, counts, found)
    return np.concatenate([found[o : o + c] for o, c in zip(offsets, counts, strict=True)])


def _listed(drops: np.ndarray, height: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """drops, listed and begins as kernels.cover_pixels takes them."""
    bands = -(-height // kernels.ROWS)
    begins = np.empty(bands + 1, np.int64)
    listed = np.empty(4 * len(drops), np.int64)
    needed = kernels.list_drops(drops, bands, begins, listed)
    if needed > len(listed):
        listed = np.empty(needed, np.int64)
        kernels.list_drops(drops, bands, begins, listed)
    return drops, listed, begins


def left_clear(
    drops: Float32[np.ndarray, "N 9"], alpha: np.ndarray, depth: np.ndarray
) -> Float32[np.ndarray, "H W"]:
    """Share of each pixel that none of the drops covers. alpha, depth: float32 [H, W]."""
    surfaces = [_wide(image) for image in (alpha, depth)]
    clear = np.empty_like(surfaces[0])
    with kernel_threads(1):
        flat = (image.reshape(-1) for image in surfaces)
        kernels.cover_pixels(*_listed(drops, len(depth)), *flat, clear)
    return clear[:, : depth.shape[1]]


def _wide(image: np.ndarray) -> np.ndarray:
    """The image, contiguous and as wide as kernels need it."""
    missing = max(0, LANES - image.shape[1])
    if missing:
        image = np.pad(image, [(0, 0), (0, missing)] + [(0, 0)] * (image.ndim - 2))
    return np.ascontiguousarray(image)


# ---- On a picture --------------------------------------------------------------------------------


class Veil(NamedTuple):
    """Arguments of kernels.blend_falling, float32."""

    rays: np.ndarray
    climb: np.ndarray
    bands: np.ndarray
    upwards: np.ndarray
    airlight: np.ndarray
    glow: np.ndarray


def veil_of(falling: Falling, camera: Camera, glow: Glow) -> Veil:
    """What of the extinction is not drawn, and what light it gives."""
    extinctions = falling.sizes.extinctions_per_m
    whole = drawn_depths_m(falling, camera)
    begin = kernels.FADE * whole
    grows = whole - begin
    half_inverse = np.divide(0.5, grows, out=np.zeros_like(grows), where=grows > 0)
    world = camera.world_from_camera[:3, :3].numpy()
    from_behind = _REFRACTED if falling.kind == "rain" else _SCATTERED
    airlight = glow.airlight if falling.color is None else np.asarray(falling.color) ** 2
    mean = glow.mean
    if falling.kind == "snow":
        mean = mean + _AMONG_FLAKES * (airlight - mean)
    numbers = (
        (1 / camera.fx, 1 / camera.fy, camera.cx, camera.cy),
        world[2],
        np.stack([extinctions, begin, grows, half_inverse, whole], 1),
        float(extinctions.sum()) * LAYER_M,
        airlight,
        np.concatenate([from_behind * glow.slope @ world, mean[:, None]], 1),
    )
    return Veil(*(np.asarray(n, np.float32, order="C") for n in numbers))


def draw_falling(
    rgb: Float[Tensor, "H W 3"],
    alpha: Float[Tensor, "H W"],
    depth: Float[Tensor, "H W"],
    camera: Camera,
    falling: Falling,
    *,
    scene: Scene,
    fog: Fog | None = None,
    motion: Motion = STANDING,
    splats: Float[Tensor, "H W 3"] | None = None,
    backend: str = CPU,
) -> tuple[Float[Tensor, "H W 3"], Bool[Tensor, "H W"]]:
    """The picture behind what falls, and where drawn drops leave less than CLEAR of a pixel.

    depth: z, metres; 0 where there is no surface. scene: whose light it is. fog: in the air as
    well. splats: what of rgb is the surfaces', where the rest is the sky's. backend: on the CPU
    pixels go through a kernel, equal to the definition in augment.effects.falling.reference within
    1e-4, and `rgb` is overwritten.
    """
    surfaces = [t.detach().float().cpu().numpy() for t in (alpha, depth)]
    drops = find_drops(walk_of(falling, camera, motion, scene.name))
    extinction = falling.sizes.extinction_per_m
    glow = _in_fog(glow_of(scene), fog, float(camera.centre[2]), extinction)
    veil = veil_of(falling, camera, glow)
    if kernels_for(backend, rgb, alpha, depth) != CPU:
        from augment.effects.falling.reference import blend_by_torch

        clear = torch.from_numpy(left_clear(drops, *surfaces)).to(rgb.device)
        return blend_by_torch(rgb, alpha, depth, clear, veil, splats), clear < CLEAR
    own = rgb.detach().numpy()
    apart = (
        np.empty((0, own.shape[1], 3), np.float32) if splats is None else splats.detach().numpy()
    )
    wide, *surfaces = (_wide(image) for image in (own, apart, *surfaces))
    mask = np.empty(wide.shape[:2], bool)
    with kernel_threads(1):
        kernels.blend_falling(
            *(image.reshape(-1) for image in (wide, *surfaces)),
            *_listed(drops, len(mask)),
            np.float32(CLEAR),
            *veil._replace(upwards=veil.upwards[()]),
            mask,
        )
    width = camera.width
    return torch.from_numpy(wide[:, :width]), torch.from_numpy(mask[:, :width])
