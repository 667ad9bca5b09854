"""Puffs of spray in front of a picture: their light and their opacity.

The optical depth of a Gaussian puff along a ray, from the eye to the surface that the pixel shows,
is in closed form, so a puff that holds the camera, or a car, is no special case:

    tau = sigma sqrt(2 pi / a) |d| exp(-q / 2) (Phi(sqrt(a) (z - z0)) - Phi(-sqrt(a) z0))

for a ray z d with unit z, a = |w d|^2, z0 where it comes closest to the centre, q the square of its
distance there in standard deviations. Depths add up over puffs. Droplets scatter what light there
is around them, alike in all directions: the mean of sky and ground.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.effects.spray import puff_kernels
from augment.effects.spray.puffs import CUT_DISTANCE2, Puffs
from augment.render.buffers import CPU, choose_kernels
from augment.render.composite import ROWS_PER_CHUNK
from augment.render.fog import Fog
from augment.render.fog_image import point_optical_depth_numpy
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera

_RUNS_PER_SD = 12  # runs of pixels in a standard deviation of a puff
_MAX_RUN = 8  # longest run, pixels


def windows_of(puffs: Puffs, camera: Camera) -> np.ndarray:
    """Return the windows of pixels that each puff can show in, int64 [N, 5].

    The columns are top, bottom, left, right, and the length of runs of pixels in a row over which
    the puff hardly varies.
    """
    pose = camera.camera_from_world.numpy()
    centres = puffs.centres_m @ pose[:3, :3].T + pose[:3, 3]
    whitenings = puffs.whitenings @ pose[:3, :3].T
    reach = CUT_DISTANCE2 * np.linalg.inv(np.swapaxes(whitenings, 1, 2) @ whitenings)
    windows = np.empty((len(centres), 5), np.int64)
    sides = ((1, camera.fy, camera.cy, camera.height), (0, camera.fx, camera.cx, camera.width))
    for column, (axis, focal, middle, size) in zip((0, 2), sides, strict=True):
        low, high = _tangents(centres[:, axis], centres[:, 2], reach[:, [axis, 2]][:, :, [axis, 2]])
        with np.errstate(invalid="ignore"):
            windows[:, column] = np.clip(np.floor(focal * low + middle), 0, size)
            windows[:, column + 1] = np.clip(np.ceil(focal * high + middle), 0, size)
    windows[centres[:, 2] + np.sqrt(reach[:, 2, 2]) <= 0, :4] = 0
    deviations_px = (windows[:, 3] - windows[:, 2]) / (2 * math.sqrt(CUT_DISTANCE2))
    windows[:, 4] = np.clip(deviations_px / _RUNS_PER_SD, 1, _MAX_RUN)
    return windows


def _tangents(x: np.ndarray, z: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest slope s = x / z of an ellipse's part at z > 0, [N] each.

    They solve (x - s z)^2 = (1, -s) reach (1, -s). They are infinite where the ellipse crosses
    z = 0.
    """
    a = z * z - reach[:, 1, 1]
    b = x * z - reach[:, 0, 1]
    c = x * x - reach[:, 0, 0]
    inside = b * b - a * c
    root = np.sqrt(np.maximum(inside, 0))
    with np.errstate(divide="ignore", invalid="ignore"):
        first = (b - root) / a
        second = (b + root) / a
    low = np.minimum(first, second)
    high = np.maximum(first, second)
    is_right = x - z * reach[:, 0, 1] / reach[:, 1, 1] > 0  # where it crosses z = 0
    crosses = a <= 0
    low, high = (
        np.where(crosses, np.where(is_right, high, -np.inf), low),
        np.where(crosses, np.where(is_right, np.inf, low), high),
    )
    around = (inside <= 0) | ~np.isfinite(first) | ~np.isfinite(second)  # of the origin
    return np.where(around, -np.inf, low), np.where(around, np.inf, high)


def blend_puffs(
    rgb: Float[Tensor, "H W 3"],
    alpha: Float[Tensor, "H W"],
    depth: Float[Tensor, "H W"],
    camera: Camera,
    puffs: Puffs,
    light: np.ndarray,
    *,
    fog: Fog | None = None,
    backend: str = CPU,
) -> Float[Tensor, "H W 3"]:
    """Return the picture behind the puffs.

    On the CPU a kernel computes it, equal to this definition within float rounding; `rgb` is then
    overwritten.

    Args:
        rgb: the picture, display-encoded.
        alpha: opacity of the surfaces.
        depth: z of the surfaces, metres.
        camera: camera of the picture.
        puffs: the puffs.
        light: [3] light of the puffs, the square of display-encoded colours.
        fog: the fog in front of them.
        backend: name of the backend.
    """
    windows = windows_of(puffs, camera)
    is_in_view = (windows[:, 0] < windows[:, 1]) & (windows[:, 2] < windows[:, 3])
    if not is_in_view.any():
        return rgb
    puffs = Puffs(*(array[is_in_view] for array in puffs))
    windows = windows[is_in_view]
    numbers = _numbers(puffs, camera, fog)
    fog_light = np.zeros(3)
    if fog is not None:
        fog_light = np.square(np.asarray(fog.airlight_rgb, np.float64))
    if choose_kernels(backend, rgb, depth) == CPU and rgb.is_contiguous():
        # By numpy: torch's threads would wait for more work, on the cores that the kernel needs.
        z = depth.contiguous().numpy()
        surfaces = np.where((alpha.detach().numpy() >= 0.5) & (z > 0), z, np.float32(np.inf))
        rays = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        with kernel_threads(ROWS_PER_CHUNK):
            puff_kernels.blend_puffs(
                rgb.detach().numpy(),
                surfaces,
                rays,
                numbers,
                windows,
                np.asarray(light, np.float64),
                fog_light,
            )
        return rgb
    surfaces = torch.where((alpha >= 0.5) & (depth > 0), depth, torch.inf).float()
    return _blend_by_torch(rgb, surfaces, camera, numbers, windows, light, fog_light)


def _numbers(puffs: Puffs, camera: Camera, fog: Fog | None) -> np.ndarray:
    """Return the numbers of the puffs, [N, 15], as puff_kernels.blend_puffs takes them."""
    rotation = camera.camera_from_world[:3, :3].numpy()
    eye = camera.centre.numpy()
    camera_whitenings = puffs.whitenings @ rotation.T
    offsets = puffs.centres_m - eye
    whitened = (puffs.whitenings @ offsets[:, :, None])[..., 0]
    fog_transmittance = np.ones(len(camera_whitenings))
    if fog is not None:
        fog_transmittance = np.exp(-point_optical_depth_numpy(fog, camera, puffs.centres_m))
    strength = math.sqrt(2 * math.pi) * puffs.extinction_per_m
    numbers = [
        camera_whitenings.reshape(-1, 9),
        whitened,
        strength[:, None],
        fog_transmittance[:, None],
    ]
    return np.concatenate([*numbers, np.full((len(camera_whitenings), 1), CUT_DISTANCE2)], 1)


def _blend_by_torch(
    rgb: Tensor,
    surfaces: Tensor,
    camera: Camera,
    numbers: np.ndarray,
    windows: np.ndarray,
    light: np.ndarray,
    fog_light: np.ndarray,
) -> Tensor:
    tau = torch.zeros(rgb.shape[:2], dtype=torch.float64, device=rgb.device)
    clear = torch.zeros_like(tau)
    v = torch.arange(camera.height, dtype=tau.dtype, device=tau.device)
    v = (v + 0.5 - camera.cy) / camera.fy
    for puff, (top, bottom, left, right, run) in zip(numbers, windows.tolist(), strict=True):
        part = slice(top, bottom), slice(left, right)
        u = torch.arange(right - left, device=tau.device) // run * run + left + run / 2
        u = (u.to(tau.dtype) - camera.cx) / camera.fx
        d = torch.stack(torch.broadcast_tensors(u, v[part[0], None], tau.new_ones(1)), -1)
        whitened = d @ torch.from_numpy(puff[:9].reshape(3, 3)).to(tau.device).T
        centre = torch.from_numpy(puff[9:12]).to(tau.device)
        a = whitened.square().sum(-1)
        nearest = (whitened @ centre) / a
        off = centre.square().sum() - a * nearest.square()
        per = (a / 2).sqrt()
        passed = torch.erf(per * (surfaces[part] - nearest)) + torch.erf(per * nearest)
        puff_tau = (
            puff[12] * d.norm(dim=-1) / a.sqrt() * torch.exp(-off / 2) * passed.clamp_min(0) / 2
        )
        puff_tau = torch.where(off > puff[14], 0.0, puff_tau)
        tau[part] += puff_tau
        clear[part] += puff_tau * puff[13]
    share = (clear / tau.clamp_min(1e-300))[..., None]
    whitened = share * torch.from_numpy(light).to(tau) + (1 - share) * torch.from_numpy(
        fog_light
    ).to(tau)
    transmittance = torch.exp(-tau)[..., None]
    blended = (
        (transmittance * rgb.clamp_min(0).square() + (1 - transmittance) * whitened)
        .sqrt()
        .to(rgb.dtype)
    )
    return torch.where((tau > 0)[..., None], blended, rgb)
