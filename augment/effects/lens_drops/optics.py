"""Optics of drops on the glass in front of a camera.

A lens focused at infinity sees, in one pixel, the glass over a disc as wide as its aperture: a drop
is blurred by that disc, and covers the share of it that lies on the drop. The light through a drop
comes from the scene's surroundings, far away, refracted by the flat glass and by a spherical cap of
water (Snell, n = 1.33; Fresnel's losses; no light beyond total reflection, which darkens the rim).
Deviations of tens of degrees are smeared by the aperture: soft discs, dark above and bright below.

So the drops are drawn through the aperture's centre, on a grid as coarse as the blur allows, from a
small map of the surroundings, and blurred by the aperture's disc. Light is added up as the square
of display-encoded colours, an encoding of gamma 2.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from augment.effects.lens_drops import lens_drop_kernels
from augment.effects.lens_drops.drops import Drops
from augment.render.buffers import CPU, choose_kernels
from augment.render.composite import ROWS_PER_CHUNK, simplify_sky
from augment.render.fog import blend_airlight
from augment.render.fog_image import sky_ray_depth
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera
from augment.scene.sky import is_unknown_sky
from augment.view.layers import LayerRenderer

WATER = 1.33  # refractive index
MIN_MASK_SHARE = 0.1  # share of a pixel's light from drops from which the mask holds the pixel
MIN_SHARE = 1e-3  # share of a pixel's light from drops from which the pixel changes
_MAP_DEG = 0.75  # size of a cell in the map of the surroundings
_MAP_REACH_DEG = 81.0  # largest angle from the axis in that map
_CELLS_AT_ONCE = 1 << 20  # cells of the layer that are drawn at a time
_BLUR_CELLS = 4.0  # radius of the aperture's disc in cells of the layer, if it has as many pixels


# ---- The surroundings ----------------------------------------------------------------------------


def map_surroundings(
    rgb: Float[Tensor, "H W 3"], camera: Camera, layers: LayerRenderer | None, *, level: bool
) -> Float32[np.ndarray, "S S 3"]:
    """Return a map of the light around the camera's axis.

    Its axes are the angles atan(x / z) and atan(y / z) in cells of _MAP_DEG. It holds the picture;
    outside of it the sky in its fog above the horizon, and the picture's border elsewhere.

    Args:
        rgb: the picture.
        camera: camera of the picture.
        layers: the parts, sky and fog that the picture shows.
        level: True if +z is known to point up.
    """
    angles = np.arange(-_MAP_REACH_DEG, _MAP_REACH_DEG + _MAP_DEG / 2, _MAP_DEG)
    slopes = np.tan(np.radians(angles))
    shrink = max(1.0, camera.fx * math.tan(math.radians(_MAP_DEG)))
    size = (max(1, round(camera.width / shrink)), max(1, round(camera.height / shrink)))
    x = (camera.fx * slopes + camera.cx) * (size[0] / camera.width) - 0.5
    y = (camera.fy * slopes + camera.cy) * (size[1] / camera.height) - 0.5
    columns, rows = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
    picture = cv2.remap(
        _shrunk(rgb, size), columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    if layers is not None and level and not is_unknown_sky(layers.sky):
        u, v = np.meshgrid(slopes, slopes)
        rotation = camera.world_from_camera[:3, :3].numpy()
        rays = np.stack([u, v, np.ones_like(u)], -1) @ rotation.T
        beside = (columns < -0.5) | (columns > size[0] - 0.5)
        outside = (beside | (rows < -0.5) | (rows > size[1] - 0.5)) & (rays[..., 2] > 0)
        picture[outside] = _sky_colors(layers, rays[outside], camera)
    return np.square(np.maximum(picture, 0))


def _shrunk(rgb: Float[Tensor, "H W 3"], size: tuple[int, int]) -> Float32[np.ndarray, "h w 3"]:
    """Return the picture in this many columns and rows, each the mean of its area."""
    if rgb.device.type == "cpu":
        return cv2.resize(rgb.detach().numpy(), size, interpolation=cv2.INTER_AREA)
    small = F.interpolate(rgb.permute(2, 0, 1)[None], size[::-1], mode="area")
    return small[0].permute(1, 2, 0).cpu().contiguous().numpy()


def _sky_colors(layers: LayerRenderer, rays: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the sky's colours in world directions [N, 3], through the fog."""
    sky, fog = simplify_sky(layers.sky, layers.fog)
    directions = F.normalize(torch.from_numpy(rays).float(), dim=-1)
    colors = sky.sample(directions)
    if fog is not None:
        tau = sky_ray_depth(fog, camera, directions)
        colors = blend_airlight(colors, tau, fog, directions[:, 2])
    return colors.numpy()


# ---- Drops, drawn on a coarse grid ---------------------------------------------------------------


def draw_drops(
    drops: Drops,
    surroundings: Float32[np.ndarray, "S S 3"],
    camera: Camera,
    *,
    glass_m: float,
    aperture_m: float,
) -> tuple[Float32[np.ndarray, "h w 4"], float, int]:
    """Draw the drops on a coarse grid.

    Returns:
        The drops' light and covered share of each cell, the size of a cell in pixels, and the
        number of cells before the picture's first.
    """
    blur_px = aperture_m / glass_m * camera.fx
    step = max(1.0, blur_px / _BLUR_CELLS)
    blur = blur_px / step
    margin = math.ceil(blur) + 2
    width, height = (math.ceil(side / step) + 2 * margin for side in (camera.width, camera.height))
    layer = np.zeros((height, width, 4), np.float32)
    fx = camera.fx / step
    fy = camera.fy / step
    cx = camera.cx / step + margin
    cy = camera.cy / step + margin
    reach = drops.radii_m * (1 + drops.bends[:, 0] + drops.bends[:, 2]) / glass_m
    centres_px = drops.centres_m / glass_m * (fx, fy) + (cx, cy)
    windows = [
        (_window(y, fy * radius + 1, height), _window(x, fx * radius + 1, width))
        for (x, y), radius in zip(centres_px, reach, strict=True)
    ]
    sizes = [(y.stop - y.start) * (x.stop - x.start) for y, x in windows]
    visible_numbers = [number for number, size in enumerate(sizes) if size > 0]
    numbers = list[int]()
    cells = 0
    for number in visible_numbers:
        numbers.append(number)
        cells += sizes[number]
        if cells < _CELLS_AT_ONCE and number != visible_numbers[-1]:
            continue
        group_drops = Drops(*(array[numbers] for array in drops))
        group_windows = [windows[n] for n in numbers]
        light = _drop_light(group_drops, group_windows, surroundings, (fx, fy, cx, cy), glass_m)
        for window, premultiplied in zip(group_windows, light, strict=True):
            layer[window] *= 1 - premultiplied[..., 3:]
            layer[window] += premultiplied
        numbers = list[int]()
        cells = 0
    if blur > 0.5:
        layer = cv2.filter2D(layer, -1, _disc(blur), borderType=cv2.BORDER_CONSTANT)
    return layer, step, margin


def _window(centre: float, reach: float, size: int) -> slice:
    low = min(max(math.floor(centre - reach), 0), size)
    return slice(low, min(max(math.ceil(centre + reach), 0), size))


def _drop_light(
    drops: Drops,
    windows: list[tuple[slice, slice]],
    surroundings: Float32[np.ndarray, "S S 3"],
    lens: tuple[float, float, float, float],
    glass_m: float,
) -> list[Float32[np.ndarray, "h w 4"]]:
    """Return the light through each drop, and its cover of each cell, in its window of cells.

    lens: fx, fy, cx, cy in cells.
    """
    fx, fy, cx, cy = lens
    places = [np.mgrid[window].reshape(2, -1) for window in windows]
    rows, columns = np.concatenate(places, 1).astype(np.float32) + np.float32(0.5)
    counts = [place.shape[1] for place in places]

    def of_cells(values: np.ndarray) -> np.ndarray:
        return np.repeat(values.astype(np.float32), counts, axis=0)

    u = (columns - np.float32(cx)) / fx
    v = (rows - np.float32(cy)) / fy
    centres = of_cells(drops.centres_m)
    radii_m = of_cells(drops.radii_m)
    right = u * glass_m - centres[:, 0]
    down = v * glass_m - centres[:, 1]
    # The rim's distance is the radius times 1 + a cos 2(t - t0) + b cos 3(t - t1), by direction t;
    # bends: a, 2 t0, b, 3 t1.
    t = np.arctan2(down, right)
    (a, t0, b, t1) = of_cells(drops.bends).T
    rims_m = radii_m * (1 + a * np.cos(2 * t - t0) + b * np.cos(3 * t - t1))
    rims_m = np.maximum(rims_m, np.float32(1e-12))  # radii may be below float32's least
    # A drop smaller than a cell covers its share of it.
    cover = np.clip((rims_m - np.hypot(right, down)) * (fx / glass_m) + 0.5, 0, 1)
    cover *= np.minimum(1, np.pi * (radii_m * (fx / glass_m)) ** 2)
    sines = of_cells(np.sin(drops.contact_rad))
    colors = _refracted(u, v, right / rims_m, down / rims_m, sines, surroundings)
    light = np.concatenate([colors * cover[:, None], cover[:, None]], 1).astype(np.float32)
    shapes = [
        (rows.stop - rows.start, columns.stop - columns.start, 4) for rows, columns in windows
    ]
    pieces = np.split(light, np.cumsum(counts)[:-1])
    return [piece.reshape(shape) for piece, shape in zip(pieces, shapes, strict=True)]


def _refracted(
    u: np.ndarray,
    v: np.ndarray,
    right: np.ndarray,
    down: np.ndarray,
    contact: np.ndarray,
    surroundings: np.ndarray,
) -> Float32[np.ndarray, "N 3"]:
    """Return the light along rays of slopes u, v through caps of water.

    right, down: point where the ray meets the cap, whose rim is at 1. contact: sine of the
    surface's tilt at the rim. All are [N].
    """
    length = np.sqrt(1 + u * u + v * v)
    wx = u / (WATER * length)
    wy = v / (WATER * length)  # flat glass: Snell at its outer side
    wz = np.sqrt(1 - wx * wx - wy * wy)
    rim_distance = np.hypot(right, down)
    tilt = np.minimum(rim_distance, 1) * contact
    nx, ny = (tilt * along / np.maximum(rim_distance, 1e-9) for along in (right, down))
    nz = np.sqrt(1 - tilt * tilt)
    inside = wx * nx + wy * ny + wz * nz
    cosine2 = 1 - WATER**2 * (1 - inside * inside)  # below 0: totally reflected
    outside = np.sqrt(np.maximum(cosine2, 0))
    turn = outside - WATER * inside
    x, y, z = (WATER * w + turn * n for w, n in ((wx, nx), (wy, ny), (wz, nz)))
    s = (WATER * inside - outside) / (WATER * inside + outside)
    p = (inside - WATER * outside) / (inside + WATER * outside)
    transmittance = np.where(cosine2 > 0, 1 - (s * s + p * p) / 2, 0)
    middle = (len(surroundings) - 1) / 2
    row_length = 1024  # OpenCV takes no row of more than 32767
    columns, rows = (
        np.resize(
            np.degrees(np.arctan2(along, np.maximum(z, 1e-6))) / _MAP_DEG + middle,
            (-(-len(u) // row_length), row_length),
        ).astype(np.float32)
        for along in (x, y)
    )
    colors = cv2.remap(
        surroundings, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return transmittance[:, None] * colors.reshape(-1, 3)[: len(u)]


def _disc(radius: float) -> Float32[np.ndarray, "K K"]:
    """Return a disc's cover of pixels, normalised to a sum of 1."""
    reach = math.ceil(radius)
    x = np.arange(-reach, reach + 1)
    disc = np.clip(radius + 0.5 - np.hypot(x[:, None], x), 0, 1).astype(np.float32)
    return disc / disc.sum()


# ---- Over the picture ----------------------------------------------------------------------------


def blend_drops(
    rgb: Float[Tensor, "H W 3"],
    layer: Float32[np.ndarray, "h w 4"],
    step: float,
    margin: int,
    *,
    backend: str,
) -> tuple[Float[Tensor, "H W 3"], Bool[Tensor, "H W"]]:
    """Return the picture behind the drops, and the mask of pixels with MIN_MASK_SHARE of light from
    drops.

    On the CPU a kernel computes it, equal to this definition within float rounding; `rgb` is then
    overwritten.
    """
    height, width, _ = rgb.shape
    if choose_kernels(backend, rgb) == CPU and rgb.is_contiguous():
        mask = np.empty((height, width), np.bool_)
        numbers = np.float32(step), margin, np.float32(MIN_SHARE), np.float32(MIN_MASK_SHARE)
        with kernel_threads(ROWS_PER_CHUNK):
            lens_drop_kernels.blend_drops(rgb.detach().numpy(), layer, *numbers, mask)
        return rgb, torch.from_numpy(mask)
    cells = torch.from_numpy(layer).to(rgb.device, rgb.dtype)
    columns, rows = (
        2 * ((torch.arange(n, device=rgb.device, dtype=rgb.dtype) + 0.5) / step + margin) / m - 1
        for n, m in ((width, layer.shape[1]), (height, layer.shape[0]))
    )
    grid = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1)[None]
    drop_layer = F.grid_sample(cells.permute(2, 0, 1)[None], grid, align_corners=False)[0]
    light = drop_layer[:3].permute(1, 2, 0).clamp_min(0)
    cover = drop_layer[3]
    background_light = (1 - cover).clamp_min(0)[..., None] * rgb.clamp_min(0).square()
    blended = torch.where((cover >= MIN_SHARE)[..., None], (background_light + light).sqrt(), rgb)
    return blended, cover >= MIN_MASK_SHARE
