"""Launches of the Triton kernels of a flooded view, and the tables that they read."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int32
from torch import Tensor

from augment.cameras import Camera
from augment.effects.flood import cuda_kernels as kernels
from augment.effects.flood.flood import Layer
from augment.effects.flood.refraction import MIP_LEVELS, smooth_variance
from augment.effects.flood.water import Water, flat_faces, medium_numbers, view_numbers
from augment.effects.flood.water_kernels import HIDDEN_COVER
from augment.effects.flood.water_plane import (
    BEGIN,
    END,
    Window,
    column_intervals,
    falling_rows,
    image_coordinates,
    window_offset,
)
from augment.effects.flood.waves import WaveField, WaveSet, turns_at
from augment.render.constants import DEPTH_EPS
from augment.render.cuda.runtime import gpu_device, launch, resident, upload
from augment.render.fog import Fog

LANES = 512  # pixels of a program that puts layers together
MAX_OTHERS = 4  # buffers that the kernel joins beside alpha and expected depth
COLUMNS = 128  # of a stretch of waves: of one anchor, and of one program
TRACE_TILE = 8, 4  # pixels of a program: a warp, whose rays wait for each other
SHADE_TILE = 16, 8
LARGE_BITS = 12  # of two factors whose product float32 holds exactly

_rows: WeakKeyDictionary[Camera, tuple[Tensor, int]] = WeakKeyDictionary()


def _rows_of(camera: Camera) -> tuple[Int32[Tensor, "H 4"], int]:
    """`falling_rows` on the GPU, copied once a camera, and `dry_rows`."""
    known = _rows.get(camera)
    if known is None or known[0].device != gpu_device():
        rows = falling_rows(camera)
        is_dry = (rows[:, BEGIN] > 0) | (rows[:, END] < camera.width)
        known = _rows[camera] = upload(rows), int(is_dry.nonzero()[0].max(initial=-1)) + 1
    return known


def dry_rows(camera: Camera) -> int:
    """One past the last row in which a ray does not fall."""
    return _rows_of(camera)[1]


def _on_gpu(part: Tensor) -> Tensor:
    return part.detach().float().to(gpu_device()).contiguous()


# ---- Layers composited ---------------------------------------------------------------------------


def find_water(
    alpha: Float[Tensor, "H W"], camera: Camera
) -> tuple[Bool[Tensor, "H W"], Float[Tensor, ""]]:
    """As `flood_view.find_water`; the largest share stays on the GPU."""
    count = alpha.numel()
    programs = -(-count // LANES)
    water = torch.empty(alpha.shape, dtype=torch.uint8, device=alpha.device)
    shown = torch.empty(programs, dtype=torch.float32, device=alpha.device)
    image = _rows_of(camera)[0], alpha.detach().contiguous(), camera.width, count
    launch(kernels.find_water, (programs,), *image, shown, water, LANES=LANES)
    return water.view(torch.bool), shown.max()


def composite_water(
    rgb: Float[Tensor, "H W 3"],
    alpha: Float[Tensor, "H W"],
    camera: Camera,
    window: Window,
    color: Float[Tensor, "h w 3"],
    sky: Float[Tensor, "S W 3"],
    dry: int,
) -> None:
    """Water into rgb, and the first `dry` rows of `sky`, finished, where rays do not fall."""
    launch(
        kernels.composite_water,
        (-(-alpha.numel() // LANES),),
        *(_rows_of(camera)[0], alpha, color.contiguous(), sky.contiguous(), dry),
        *(window.left, window.top, window.right, window.bottom, camera.width, alpha.numel(), rgb),
        LANES=LANES,
    )


def merge_depths(
    alpha: Float[Tensor, "H W"],
    behind_alpha: Float[Tensor, "h w"],
    depths: tuple[Tensor, Tensor] | None,
    others: list[tuple[Tensor, Tensor]],
    window: Window,
) -> None:
    """As `flood_view.merge_depths`, in place. others: pairs of buffers of the two layers."""
    assert len(others) <= MAX_OTHERS
    (rows, columns), (own_rows, own_columns) = window.overlap(alpha)
    wide, count = columns.stop - columns.start, 0
    if wide > 0:
        count = wide * max(rows.stop - rows.start, 0)
    pairs = [tuple(part.view(torch.int32) for part in pair) for pair in others]
    nothing = (alpha, behind_alpha)  # stands where no pointer is looked at
    pairs += [nothing] * (MAX_OTHERS - len(others))
    launch(
        kernels.merge_depths,
        (-(-count // LANES),),
        *nothing,
        *(nothing if depths is None else depths),
        *(part for pair in pairs for part in pair),
        *(DEPTH_EPS, columns.start, rows.start, own_columns.start, own_rows.start),
        *(wide, count, alpha.shape[1], behind_alpha.shape[1]),
        HAS_DEPTH=depths is not None,
        OTHERS=len(others),
        LANES=LANES,
    )


# ---- Waves: phases need float64, which is reduced here -------------------------------------------


def fill_field(
    waves: WaveSet, camera: Camera, height: float, *, farthest: float, limits: tuple[float, ...]
) -> WaveField:
    """`wave_field` of waves that are not flat. height: of the eye over the plane, metres. farthest:
    depth at which the plane is still met. limits: as of the CPU's `fill_field`.
    """
    rotation = camera.world_from_camera[:3, :3].numpy()
    a, b = rotation[:, 0] / camera.fx, rotation[:, 1] / camera.fy
    bend = b * a[2] - b[2] * a
    stretches = _stretches(camera, rotation, height, farthest)
    size = (camera.height, camera.width)
    fields = [torch.empty(size, dtype=torch.float32, device=gpu_device()) for _ in range(3)]
    launch(
        kernels.fill_field,
        (stretches.shape[0] * stretches.shape[1],),
        *(upload(stretches), upload(_waves(waves, camera)), len(waves.wavelengths_m)),
        *(camera.width, stretches.shape[1], height, float(a[2]), float(bend[0]), float(bend[1])),
        *limits,
        *fields,
        LANES=COLUMNS,
        num_warps=1,
    )
    return WaveField(*fields)


def _stretches(
    camera: Camera, rotation: np.ndarray, height: float, farthest: float
) -> Float32[np.ndarray, "H S 16"]:
    u, v = image_coordinates(camera)

    def ray_z(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        return (u[columns] * rotation[2, 0] + v[rows] * rotation[2, 1]) + rotation[2, 2]

    def meets(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        away = -height / ray_z(rows, columns)
        return (away > 0) & (away <= farthest)

    with np.errstate(divide="ignore"):  # a level ray meets the plane nowhere
        begin, end = column_intervals(camera, meets)
    edges = np.arange(0, camera.width, COLUMNS)
    first = np.maximum(begin[:, None], edges)  # [H, S]
    last = np.minimum(end[:, None], edges + COLUMNS) - 1
    none = first > last
    first, last = np.where(none, 0, first), np.where(none, 0, last)
    rows = np.broadcast_to(np.arange(camera.height)[:, None], first.shape)
    # The middle, or the end with the nearer plane where distances differ much: turns counted from
    # a point near the horizon would be lost in float32.
    anchor = (first + last + 1) // 2
    z, z_first, z_last = (np.abs(ray_z(rows, at)) for at in (anchor, first, last))
    nearer = np.where(z_first > z_last, first, last)
    anchor = np.where(2 * z >= np.maximum(z_first, z_last), anchor, nearer)

    x, y = (
        u[anchor] * rotation[k, 0] + v[rows] * rotation[k, 1] + rotation[k, 2] for k in range(2)
    )
    z = np.where(none, -height, ray_z(rows, anchor))
    a, b = rotation[:, 0] / camera.fx, rotation[:, 1] / camera.fy
    away = -height / z
    numbers = [first, np.where(none, 0, last + 1), anchor, x, y, z]
    numbers += [a[k] - a[2] / z * d for k, d in enumerate((x, y))]
    numbers += [b[k] * z - b[2] * d for k, d in enumerate((x, y))]
    numbers += [part for d in (x, y) for part in _in_parts(away * d)]
    out = np.zeros((*first.shape, 16), np.float32)
    out[..., : len(numbers)] = np.stack(numbers, -1)
    return out


def _waves(waves: WaveSet, camera: Camera) -> Float32[np.ndarray, "N 12"]:
    dx, dy = waves.directions.T
    eye = camera.centre.numpy()
    per_metre = dx / waves.wavelengths_m, dy / waves.wavelengths_m
    turns = per_metre[0] * eye[0] + per_metre[1] * eye[1] + turns_at(waves, camera.timestamp_ns)
    numbers = [part for number in per_metre for part in _in_parts(number)]
    numbers += [turns - np.floor(turns), *waves.tangent_factors]
    out = np.zeros((len(turns), 12), np.float32)
    out[:, : len(numbers)] = np.stack(numbers, 1)
    return out


def _in_parts(numbers: Float64[np.ndarray, "*B"]) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of LARGE_BITS significant bits, and what they leave of the given ones."""
    share, exponent = np.frexp(numbers)
    large = np.ldexp(np.round(np.ldexp(share, LARGE_BITS)), exponent - LARGE_BITS)
    return large, numbers - large


# ---- Mirrored rays through the image -------------------------------------------------------------


def trace(
    front: Layer,
    camera: Camera,
    left: int,
    top: int,
    needed: Bool[Tensor, "h w"],
    vertical: tuple[list[float], list[float], float],
) -> tuple[Tensor, Tensor]:
    """(distance, weight) as in `screen_space.ScreenReflection`, on the GPU.

    left, top: of the window `camera` in the front's image. vertical: in the front's camera, its
    image in homogeneous pixels, and the eye's height over the water.
    """
    whole, device = front.camera, gpu_device()
    alpha, depth, asked = (
        part.detach().to(device).contiguous() for part in (front.alpha, front.depth, needed)
    )
    block = kernels.BLOCK
    rows, columns = (-(-size // block) * block for size in (whole.height, whole.width))
    pyramid = torch.empty((rows, columns + columns // 4), dtype=torch.float32, device=device)
    launch(
        kernels.build_pyramid,
        ((rows // block) * (columns // block),),
        *(alpha, depth, whole.width, whole.height, rows, columns, pyramid),
        num_warps=8,
    )
    up, image, eye_height_m = vertical
    size = (camera.height, camera.width)
    distance, weight = (torch.empty(size, dtype=torch.float32, device=device) for _ in range(2))
    wide, high = TRACE_TILE
    across = -(-camera.width // wide)
    launch(
        kernels.trace,
        (across * -(-camera.height // high),),
        *(pyramid, _rows_of(camera)[0], alpha, asked.view(torch.uint8), left, top),
        *(camera.width, camera.height, across, whole.width, whole.height, rows, columns),
        *(up[0] / camera.fx, *up, image[0], image[1]),
        *(whole.fx, whole.fy, whole.cx, whole.cy, eye_height_m, distance, weight),
        WIDE=wide,
        HIGH=high,
        num_warps=1,
    )
    return distance, weight


# ---- The water's colours -------------------------------------------------------------------------


def shade(water: Water) -> Float[Tensor, "h w 3"]:
    """As `water.shade_water`."""
    camera, medium, field, screen = water.camera, water.medium, water.field, water.screen
    faces, size, layered = flat_faces(water.sky, water.fog)
    cover = _on_gpu(water.cover)
    nothing = cover, cover, cover
    mirror = nothing if water.mirror is None else _images(water.mirror)
    mips, levels = (cover, 1) if water.mirror is None else _averages(*mirror[:2])
    front = nothing if screen is None else _images(screen.layer)
    rays = nothing[:2] if screen is None else (_on_gpu(screen.distance), _on_gpu(screen.weight))
    out = torch.empty((camera.height, camera.width, 3), dtype=torch.float32, device=gpu_device())
    wide, high = SHADE_TILE
    across = -(-camera.width // wide)
    launch(
        kernels.shade,
        (across * -(-camera.height // high),),
        *(upload(_numbers(water, layered)), _rows_of(camera)[0]),
        *(resident(faces), size, cover),
        *(_on_gpu(part) for part in (field.normal_x, field.normal_y, field.slope_variance)),
        *(*_images(water.bed), *window_offset(water.bed.camera, camera)),
        *(*mirror[1:], mips, levels, *front, *rays),
        *(out, camera.width, camera.height, across),
        HAS_MIRROR=water.mirror is not None,
        HAS_FRONT=screen is not None,
        BENDS=medium.refraction_index != 1,
        SCHLICK=medium.fresnel == "schlick",
        WIDE=wide,
        HIGH=high,
    )
    return out


def _images(layer: Layer) -> tuple[Tensor, Tensor, Tensor]:
    return _on_gpu(layer.rgb), _on_gpu(layer.alpha), _on_gpu(layer.depth)


def _averages(
    rgb: Float[Tensor, "H W 3"], alpha: Float[Tensor, "H W"]
) -> tuple[Float[Tensor, "P 4"], int]:
    """Mip levels one after the other, and how many they are."""
    height, width = high, wide = tuple(alpha.shape)
    total, levels = high * wide, 1
    while levels < MIP_LEVELS and max(high, wide) > 1:
        high, wide = (high + 1) // 2, (wide + 1) // 2
        total, levels = total + high * wide, levels + 1
    mips = torch.empty((total, 4), dtype=torch.float32, device=alpha.device)
    down, across = (-(-size // kernels.SIDE) for size in (height, width))
    arguments = (rgb, alpha, width, height, across, levels, mips)
    launch(kernels.average, (down * across,), *arguments, num_warps=8)
    return mips, levels


def _numbers(water: Water, layered: Fog | None) -> Float32[np.ndarray, " n"]:
    """What `kernels.shade` reads beside images."""
    camera, bed = water.camera, water.bed
    axes = camera.world_from_camera[:3, :3].numpy()
    lens = [1 / camera.fx, 1 / camera.fy, 0.5 - camera.cx, 0.5 - camera.cy]
    front = None if water.screen is None else water.screen.layer
    views = [view_numbers((layer or bed).camera) for layer in (bed, water.mirror, front)]
    numbers = [axes.reshape(-1), [*lens, axes[2, 0] / camera.fx], *views]
    numbers += [medium_numbers(water, layered), [HIDDEN_COVER, smooth_variance(camera)]]
    return np.concatenate(numbers).astype(np.float32)
