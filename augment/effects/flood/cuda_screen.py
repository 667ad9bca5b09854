"""Launches of the Triton kernels that march mirrored rays through the image."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from torch import Tensor

from augment.cameras import Camera
from augment.effects.flood import cuda_screen_kernels as kernels
from augment.effects.flood.cuda_pour import rows_on_gpu
from augment.effects.flood.flood import Layer
from augment.effects.flood.water_plane import column_intervals, image_coordinates
from augment.effects.flood.waves import WaveField, WaveSet, turns_at
from augment.render.cuda.runtime import gpu_device, launch, upload

# ---- Tables for the Triton kernel of waves, and its launch ---------------------------------------
# Float64 is needed for phases alone, and reduced here: the eye's own turns of every wave, and the
# place of every stretch's anchor.

LANES = 128  # columns of a stretch: of one anchor, and of one program
LARGE_BITS = 12  # of two factors whose product float32 holds exactly


def fill_field(
    waves: WaveSet, camera: Camera, height: float, *, farthest: float, limits: tuple[float, ...]
) -> WaveField:
    """`wave_field` of waves that are not flat, on the GPU.

    height: of the eye over the plane, metres. farthest: depth at which the plane is still met.
    limits: horizontal part of a ray, at unit z, below which it is vertical; lengths in pixels at
    which a wave is gone, and at full height.
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
        upload(stretches),
        upload(_waves(waves, camera)),
        len(waves.wavelengths_m),
        camera.width,
        stretches.shape[1],
        height,
        float(a[2]),
        float(bend[0]),
        float(bend[1]),
        *limits,
        *fields,
        LANES=LANES,
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
    edges = np.arange(0, camera.width, LANES)
    first = np.maximum(begin[:, None], edges)  # [H, S]
    last = np.minimum(end[:, None], edges + LANES) - 1
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
    out = np.zeros((*first.shape, kernels.STRETCH), np.float32)
    out[..., kernels.BEGIN], out[..., kernels.END] = first, np.where(none, 0, last + 1)
    out[..., kernels.ANCHOR] = anchor
    for k, d in enumerate((x, y)):
        out[..., kernels.X + k] = d
        out[..., kernels.STEP_X + k] = a[k] - a[2] / z * d
        out[..., kernels.DROP_X + k] = b[k] * z - b[2] * d
        place = kernels.PLACE_X + 2 * k
        out[..., place], out[..., place + 1] = _in_parts(away * d)
    out[..., kernels.Z] = z
    return out


def _waves(waves: WaveSet, camera: Camera) -> Float32[np.ndarray, "N 12"]:
    dx, dy = waves.directions.T
    eye = camera.centre.numpy()
    per_metre = dx / waves.wavelengths_m, dy / waves.wavelengths_m
    turns = per_metre[0] * eye[0] + per_metre[1] * eye[1] + turns_at(waves, camera.timestamp_ns)
    slopes, bends = waves.wavenumbers * waves.amplitudes_m, waves.steepness
    out = np.zeros((len(turns), kernels.WAVE), np.float32)
    for k, number in enumerate(per_metre):
        place = kernels.TURN_X + 2 * k
        out[:, place], out[:, place + 1] = _in_parts(number)
    out[:, kernels.TURNS] = turns - np.floor(turns)
    terms = [bends * dx * dx, bends * dx * dy, bends * dy * dy, slopes * dx, slopes * dy]
    out[:, kernels.TERMS : kernels.TERMS + 5] = np.stack(terms, 1)
    return out


def _in_parts(numbers: Float64[np.ndarray, "*B"]) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of LARGE_BITS significant bits, and what they leave of the given ones."""
    share, exponent = np.frexp(numbers)
    large = np.ldexp(np.round(np.ldexp(share, LARGE_BITS)), exponent - LARGE_BITS)
    return large, numbers - large


# ---- cuda screen ---------------------------------------------------------------------------------

WIDE, HIGH = 8, 4  # pixels of a program: a warp, whose rays wait for each other


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
        alpha,
        depth,
        whole.width,
        whole.height,
        rows,
        columns,
        pyramid,
        num_warps=8,
    )
    up, image, eye_height_m = vertical
    size = (camera.height, camera.width)
    distance, weight = (torch.empty(size, dtype=torch.float32, device=device) for _ in range(2))
    across = -(-camera.width // WIDE)
    launch(
        kernels.trace,
        (across * -(-camera.height // HIGH),),
        pyramid,
        rows_on_gpu(camera),
        alpha,
        asked.view(torch.uint8),
        left,
        top,
        camera.width,
        camera.height,
        across,
        whole.width,
        whole.height,
        rows,
        columns,
        up[0] / camera.fx,
        *up,
        image[0],
        image[1],
        whole.fx,
        whole.fy,
        whole.cx,
        whole.cy,
        eye_height_m,
        distance,
        weight,
        WIDE=WIDE,
        HIGH=HIGH,
        num_warps=1,
    )
    return distance, weight
