"""Rain or snowfall in front of a finished picture: near drops one by one, the others as a veil.

A class of drops is drawn up to the depth at which it is `min_width_px` wide, and fades out over the
last quarter of that depth. Drops that are not drawn take their share of the light by Beer-Lambert.
The extinction of near drops and far veil together is therefore that of the rate, however many
drops are drawn:

    out = glow + clear (behind - glow)           behind = airlight + exp(-tau) (picture - airlight)

clear is the share of a pixel that no drop covers while the shutter is open. A drop of diameter D
whose image moves by a length L covers a point of its path for D / (L + D) of the exposure (Garg and
Nayar 2007, "Vision and Rain"), over the sizes of drop, defocus and pixel. glow is the light of a
drop. A drop bends the light of a cone of 165 degrees about the line of sight into that line
(ibid.), so glow is about the mean of a half space. tau is the optical depth of the drops that are
not drawn, up to the surface, or up through a layer of LAYER_M before the sky. airlight is the light
of the sky above the horizon. All light is in squares of display-encoded colours, which approximate
linear light.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from torch import Tensor

from augment.effects.falling import drop_kernels, shower_kernels
from augment.effects.falling.drop_kernels import CellWalk, Veil
from augment.effects.falling.drops import Kind, Sizes, cell_counts, lattice_of, sizes_of
from augment.effects.falling.shower import Shower, ShowerTable, shower_about, shower_in_view
from augment.effects.falling.shower_kernels import LAYER_M
from augment.effects.falling.shutter import STANDING, Motion
from augment.light.common_exposure import AddedColors
from augment.light.scene_light import find_scene_light
from augment.light.srgb import display_from_linear
from augment.memo import memo_of
from augment.render.buffers import CPU, choose_kernels
from augment.render.fog import MAX_EXPONENT, Fog
from augment.render.fog_table import local_fog
from augment.render.layout import NUM_LANES
from augment.render.threads import kernel_threads
from augment.rng import rng_for
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from augment.scene.sky import is_unknown_sky

MAX_DROPS = 50_000  # most drops that are drawn in a picture; more make the veil begin sooner
APERTURE_M = 3e-3  # diameter of the aperture, metres: a lens of 6 mm at f/2, usual on cars
FOCUS_M = 6.0  # depth in focus, metres
NEAR_M = 0.2  # smallest depth of a drop, metres
UNKNOWN_AIRLIGHT = (0.76, 0.78, 0.80)  # display-encoded airlight of scenes without a sky
# Sine of the largest elevation that counts as "above the horizon".
_HORIZON_SINE = math.sin(math.radians(15.0))
_NUM_DIRECTIONS = 4096  # directions in which the light around a drop is sampled
_LIGHT_DISTANCE_M = 30.0  # usual distance of the surfaces that light a drop, metres
_DROP_LIGHT_FROM_BEHIND = 0.94  # share of a drop's light that comes from behind it
_FLAKE_LIGHT_FROM_BEHIND = 0.5  # share of a flake's light that comes from behind it
_SCATTERED_SHARE = 0.5  # share of a flake's light that other flakes have scattered
CLEAR = 0.95  # share of a pixel; the mask holds pixels of which near drops leave less
SWAY_REACH_S = 0.95  # drop_kernels._sway moves a flake by at most its speed times this, seconds


@dataclass(frozen=True)
class Precipitation:
    """Precipitation in a scene's air."""

    kind: Kind
    """Rain or snow."""

    rate_mm_h: float
    """Rate, millimetres of water an hour."""

    wind_mps: tuple[float, float]
    """Velocity of the wind along world x and y."""

    sway_mps: float
    """Speed of the air's eddies and of the flakes' flutter."""

    seed: int
    """Seed of the drops."""

    exposure_s: float
    """Exposure time."""

    min_width_px: float
    """Smallest width of a drop that is drawn, pixels."""

    color: tuple[float, float, float] | None = None
    """Display-encoded colour of the veil; None for the sky's."""

    peak_mm_h: float | None = None
    """Largest rate of the weather's course; None if the rate does not change."""

    shower: Shower | None = None
    """Rates by place; None if the rate is the same everywhere."""

    @property
    def sizes(self) -> Sizes:
        return sizes_of(self.kind, self.rate_mm_h)

    @property
    def lattice(self) -> Sizes:
        """Return the sizes whose lattice the drops are in: those of the rate, or of its course."""
        if self.peak_mm_h is None:
            return self.sizes
        return lattice_of(self.kind, max(self.peak_mm_h, self.rate_mm_h))

    def at(self, camera: Camera) -> Precipitation:
        """Return the precipitation with the rate at a camera."""
        if self.shower is None:
            return self
        return replace(self, rate_mm_h=self.shower.rate_at(camera.centre.numpy()))

    def shower_about(self, eye_m: np.ndarray) -> ShowerTable | None:
        """Return the shower about an eye [3], world; None if the rate is the same everywhere."""
        return None if self.shower is None else shower_about(self.shower, self.kind, eye_m)


# ---- The light of drops --------------------------------------------------------------------------


class Glow(NamedTuple):
    """Light of drops, in squares of display-encoded colours."""

    airlight: np.ndarray  # [3] light of the sky above the horizon
    mean: np.ndarray  # [3] light of a drop, mean over all directions
    slope: np.ndarray  # [3, 3] change of a drop's light towards world x, y and z, by channel


def glow_of(scene: Scene) -> Glow:
    """Return the light of drops in a scene, from its sky and its ground; cached in its memo."""

    def compute() -> Glow:
        index = np.arange(_NUM_DIRECTIONS)
        z = 1 - (2 * index + 1) / _NUM_DIRECTIONS
        angle = index * (math.pi * (3 - math.sqrt(5)))
        horizontal = np.sqrt(1 - z * z)
        directions = np.stack([horizontal * np.cos(angle), horizontal * np.sin(angle), z], 1)
        unknown_light = np.asarray(UNKNOWN_AIRLIGHT) ** 2
        light = np.tile(unknown_light, (_NUM_DIRECTIONS, 1))
        is_above = z > 0
        if not is_unknown_sky(scene.sky):
            rgb = scene.sky.sample(torch.from_numpy(directions[is_above].astype(np.float32)))
            light[is_above] = np.clip(np.nan_to_num(rgb.double().numpy()), 0, 1) ** 2
        ground = np.asarray(find_scene_light(scene).ground_rgb_linear)
        light[~is_above] = display_from_linear(np.clip(ground, 0, 1)) ** 2
        # The mean of a half space about d of what varies as c . d' is c . d / 2, and c is 3 <l d'>.
        slope = 1.5 * (light[:, :, None] * directions[:, None]).mean(0)
        return Glow(light[is_above & (z < _HORIZON_SINE)].mean(0), light.mean(0), slope)

    scene = scene.as_recorded
    return memo_of(scene).get(("light of precipitation",), compute)


def _in_common_exposure(glow: Glow, added_colors: AddedColors) -> Glow:
    """Return the light of drops as the common exposure of all cameras shows it."""
    slope = added_colors.slope_of_light(glow.mean, glow.slope)
    return Glow(added_colors.of_light(glow.airlight), added_colors.of_light(glow.mean), slope)


def _in_fog(glow: Glow, fog: Fog | None, eye_z_m: float, extinction_per_m: float) -> Glow:
    """Return the light of drops in fog, which is around them and behind them."""
    if fog is None:
        return glow
    sigma = fog.extinction_per_m
    color = np.asarray(fog.airlight_rgb, np.float64) ** 2
    if fog.scale_height_m is not None:
        climb = (eye_z_m - fog.base_z_m) / fog.scale_height_m
        sigma *= math.exp(min(max(-climb, -MAX_EXPONENT), MAX_EXPONENT))
    share = sigma / (sigma + extinction_per_m)
    clear = math.exp(-sigma * _LIGHT_DISTANCE_M)
    return Glow(
        glow.airlight + share * (color - glow.airlight),
        color + clear * (glow.mean - color),
        glow.slope * clear,
    )


# ---- Drops in a camera's view --------------------------------------------------------------------


def max_depths_m(precipitation: Precipitation, camera: Camera) -> np.ndarray:
    """Return the depth up to which each class is drawn [B].

    There a drop is `min_width_px` wide. The depth is smaller if more than MAX_DROPS would be drawn,
    and 0 if no drop of the class is drawn.
    """
    sizes = precipitation.sizes
    focal = math.sqrt(camera.fx * camera.fy)
    farthest = sizes.diameters_m * focal / precipitation.min_width_px
    volume_factor = (
        camera.width * camera.height / (3 * camera.fx * camera.fy)
    )  # of a pyramid, over depth^3
    num_drops = float((sizes.counts_per_m3 * farthest**3).sum()) * volume_factor
    farthest *= min(1.0, (MAX_DROPS / max(num_drops, 1e-300)) ** (1 / 3))
    return np.where(farthest > NEAR_M, farthest, 0.0)


def cell_walk(precipitation: Precipitation, camera: Camera, motion: Motion, scene: str) -> CellWalk:
    """Return the cells that the camera's view crosses, and their drops' motion.

    The lattice is that of the largest rate of the weather's course, so that a drop stays where it
    is while the rate changes. A share of its drops falls.
    """
    sizes = precipitation.sizes
    lattice = precipitation.lattice
    farthest = max_depths_m(precipitation, camera)
    half_s = precipitation.exposure_s / 2
    seconds = camera.timestamp_ns * 1e-9
    times = seconds + np.array([-half_s, 0.0, half_s])
    velocity = np.zeros((len(farthest), 3))
    velocity[:, :2] = precipitation.wind_mps
    velocity[:, 2] = -lattice.speeds_mps
    moves = velocity[:, None] * times[:, None]  # [B, 3, 3]
    poses = np.stack([motion.pose_after(camera, s) for s in (-half_s, half_s)])
    cells_m = lattice.cells_m
    speeds = np.linalg.norm(velocity - motion.velocity_mps, axis=1)
    speeds += np.linalg.norm(motion.turn_radps) * farthest
    spread_m = (
        half_s * speeds + sizes.quantiles_m[:, -1] / 2 + SWAY_REACH_S * precipitation.sway_mps
    )
    spread_m += APERTURE_M / 2 * np.maximum(1, farthest / FOCUS_M)
    spread_m += drop_kernels.LEAST_RADIUS / math.sqrt(camera.fx * camera.fy) * farthest
    reach = cells_m * math.sqrt(0.75) + spread_m
    # Inward normals of the view's sides, then of its front.
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
    falling_share = np.minimum(sizes.counts_per_m3 / lattice.counts_per_m3, 1.0)
    slabs, columns = _columns_of(camera, cells_m, reach, farthest, moves[:, 1])
    rng = rng_for(seed=precipitation.seed, scene=scene, effect=f"{precipitation.kind} in the air")
    lens = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
    return CellWalk(
        slabs,
        columns,
        np.stack([cells_m, reach, farthest, spread_m, falling_share], 1),
        rng.integers(0, 2**64, len(farthest), np.uint64),
        moves,
        _sways(precipitation.sway_mps, seconds),
        sizes.quantiles_m,
        cell_counts(),
        planes,
        np.ascontiguousarray(poses[:, :3]),
        np.array([*lens, NEAR_M, APERTURE_M, FOCUS_M], np.float64),
    )


def _sways(speed_mps: float, seconds: float) -> np.ndarray:
    """Return `sways` as drop_kernels.find_drops takes them.

    They are in turns, where reference.sway counts radians. Whole turns are left out, because they
    would cost digits.
    """
    rates = [2.0 + 0.7 * wave for wave in range(3)]
    radians = np.array([*(rate * seconds for rate in rates), 4 * seconds])
    per_number = (8 * seconds + 50) * 2.0**-21
    return np.append((speed_mps, seconds), np.append(radians, per_number) / (2 * math.pi) % 1)


def _columns_of(
    camera: Camera,
    cells_m: np.ndarray,
    reach: np.ndarray,
    farthest: np.ndarray,
    offsets_m: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return slabs and columns of the walk: cells below and above each class's view frustum."""
    corners = np.array([(u, v) for u in (0.0, camera.width) for v in (0.0, camera.height)])
    corners = (corners - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    world = camera.world_from_camera[:3, :3].numpy()
    rays = np.concatenate([corners, np.ones((4, 1))], 1) @ world.T
    rays = np.concatenate([rays, np.zeros((1, 3))])  # and the eye
    around = camera.centre.numpy()[:2] + rays[:, :2] * farthest[:, None, None]  # [B, 5, 2]
    low = (around.min(1) - reach[:, None] - offsets_m[:, :2]) / cells_m[:, None] - 0.5
    high = (around.max(1) + reach[:, None] - offsets_m[:, :2]) / cells_m[:, None] - 0.5
    first = np.floor(low).astype(np.int64)
    end = np.ceil(high).astype(np.int64) + 1
    slabs = [
        np.stack([np.full(b[0] - a[0], number), np.arange(a[0], b[0])], 1)
        for number, (a, b) in enumerate(zip(first, end, strict=True))
        if farthest[number] > 0
    ]
    slabs.append(np.zeros((0, 2), np.int64))
    return np.concatenate(slabs), np.stack([first[:, 1], end[:, 1]], 1)


def find_drops(walk: CellWalk) -> Float32[np.ndarray, "N 9"]:
    """Return the drops in a camera's view, as drop_kernels.find_drops writes them, by cell."""
    slab_counts = np.zeros(len(walk.slabs), np.int64)
    empty = np.empty((0, drop_kernels.NUM_NUMBERS), np.float32)
    with kernel_threads(1):
        drop_kernels.find_drops(*walk, np.zeros_like(slab_counts), slab_counts, empty)
        if not slab_counts.any():
            return empty
        drops = np.empty((int(slab_counts.sum()), drop_kernels.NUM_NUMBERS), np.float32)
        offsets = np.cumsum(slab_counts) - slab_counts
        counts = np.empty_like(slab_counts)
        drop_kernels.find_drops(*walk, offsets, counts, drops)
    return np.concatenate([drops[o : o + c] for o, c in zip(offsets, counts, strict=True)])


def list_drops(
    drops: Float32[np.ndarray, "N 9"], height: int
) -> tuple[Float32[np.ndarray, "N 9"], Int64[np.ndarray, "L"], Int64[np.ndarray, "B"]]:
    """Return drops, listed and begins as drop_kernels.cover_pixels takes them.

    Args:
        drops: the drops, as `find_drops` gives them.
        height: height of the picture.
    """
    bands = -(-height // drop_kernels.ROWS)
    begins = np.empty(bands + 1, np.int64)
    listed = np.empty(4 * len(drops), np.int64)
    needed = drop_kernels.list_drops(drops, bands, begins, listed)
    if needed > len(listed):
        listed = np.empty(needed, np.int64)
        drop_kernels.list_drops(drops, bands, begins, listed)
    return drops, listed, begins


def compute_clear_share(
    drops: Float32[np.ndarray, "N 9"], alpha: np.ndarray, depth: np.ndarray
) -> Float32[np.ndarray, "H W"]:
    """Return the share of each pixel that no drop covers. alpha, depth: float32 [H, W]."""
    surfaces = [padded_image(image) for image in (alpha, depth)]
    clear = np.empty_like(surfaces[0])
    with kernel_threads(1):
        flat = (image.reshape(-1) for image in surfaces)
        drop_kernels.cover_pixels(*list_drops(drops, len(depth)), *flat, clear)
    return clear[:, : depth.shape[1]]


def padded_image(image: np.ndarray) -> np.ndarray:
    """Return the image, contiguous and padded to the width that kernels need.

    Args:
        image: [H, W], or [H, W, C].
    """
    missing = max(0, NUM_LANES - image.shape[1])
    if missing:
        image = np.pad(image, [(0, 0), (0, missing)] + [(0, 0)] * (image.ndim - 2))
    return np.ascontiguousarray(image)


# ---- On a picture --------------------------------------------------------------------------------


def veil_of(precipitation: Precipitation, camera: Camera, glow: Glow) -> Veil:
    """Return the veil: extinction of the drops that are not drawn, and its light."""
    extinctions = precipitation.sizes.extinctions_per_m
    full_depths = max_depths_m(precipitation, camera)
    begin = drop_kernels.FADE * full_depths
    grows = full_depths - begin
    half_inverse = np.divide(0.5, grows, out=np.zeros_like(grows), where=grows > 0)
    world = camera.world_from_camera[:3, :3].numpy()
    from_behind = (
        _DROP_LIGHT_FROM_BEHIND if precipitation.kind == "rain" else _FLAKE_LIGHT_FROM_BEHIND
    )
    airlight = (
        glow.airlight if precipitation.color is None else np.asarray(precipitation.color) ** 2
    )
    mean = glow.mean
    if precipitation.kind == "snow":
        mean = mean + _SCATTERED_SHARE * (airlight - mean)
    numbers = (
        (1 / camera.fx, 1 / camera.fy, camera.cx, camera.cy),
        world[2],
        np.stack([extinctions, begin, grows, half_inverse, full_depths], 1),
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
    precipitation: Precipitation,
    *,
    scene: Scene,
    fog: Fog | None = None,
    motion: Motion = STANDING,
    splats: Float[Tensor, "H W 3"] | None = None,
    added_colors: AddedColors | None = None,
    drops: Float32[np.ndarray, "N 9"] | None = None,
    backend: str = CPU,
) -> tuple[Float[Tensor, "H W 3"], Bool[Tensor, "H W"]]:
    """Return the picture behind the precipitation, and the mask of its drawn drops.

    The mask holds pixels of which drawn drops leave less than CLEAR.

    Args:
        rgb: the picture, display-encoded.
        alpha: opacity of the surfaces.
        depth: z of the surfaces, metres; 0 without a surface.
        camera: camera of the picture.
        precipitation: the rain or snow in the air, with the rate at the camera.
        scene: the scene whose light the drops have.
        fog: the fog in the air.
        motion: motion of the camera.
        splats: the surfaces' part of rgb; the other part is the sky's.
        added_colors: map of the light of drops and veil; None to leave it.
        drops: the drops, if `find_drops` has found them; None to find them.
        backend: on the CPU a kernel draws, equal to the definition in
            augment.effects.falling.reference within 1e-4, and `rgb` is overwritten.
    """
    surfaces = [t.detach().float().cpu().numpy() for t in (alpha, depth)]
    if drops is None:
        drops = find_drops(cell_walk(precipitation, camera, motion, scene.name))
    extinction = precipitation.sizes.extinction_per_m
    glow = glow_of(scene)
    if added_colors is not None:
        glow = _in_common_exposure(glow, added_colors)
        if precipitation.color is not None:
            precipitation = replace(precipitation, color=added_colors.of_color(precipitation.color))
    glow = _in_fog(glow, local_fog(fog, camera), float(camera.centre[2]), extinction)
    veil = veil_of(precipitation, camera, glow)
    table = precipitation.shower_about(camera.centre.numpy())
    shower = None
    if table is not None:
        shower = shower_in_view(table, camera, np.asarray(veil.airlight, np.float64))
    if choose_kernels(backend, rgb, alpha, depth) != CPU:
        from augment.effects.falling.reference import blend_by_torch

        clear = torch.from_numpy(compute_clear_share(drops, *surfaces)).to(rgb.device)
        return blend_by_torch(rgb, alpha, depth, clear, veil, splats, shower), clear < CLEAR
    picture = rgb.detach().numpy()
    splat_colors = (
        np.empty((0, picture.shape[1], 3), np.float32)
        if splats is None
        else splats.detach().numpy()
    )
    padded, *surfaces = (padded_image(image) for image in (picture, splat_colors, *surfaces))
    mask = np.empty(padded.shape[:2], bool)
    images = (*(image.reshape(-1) for image in (padded, *surfaces)), *list_drops(drops, len(mask)))
    with kernel_threads(1):
        if shower is None:
            numbers = veil._replace(upwards=veil.upwards[()])
            drop_kernels.blend_falling(*images, np.float32(CLEAR), *numbers, mask)
        else:
            light = (veil.rays, veil.climb, veil.bands, veil.airlight, veil.glow)
            shower_kernels.blend_shower(*images, np.float32(CLEAR), *light, *shower, mask)
    width = camera.width
    return torch.from_numpy(padded[:, :width]), torch.from_numpy(mask[:, :width])
