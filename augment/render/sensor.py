"""What a camera adds to the light that reaches it: the blur of its lens, and noise.

Noise has a variance of photons, which grows with the light, and one of reading, which does not
(Foi et al. 2008, "Practical Poissonian-Gaussian Noise Modeling and Fitting for Single-Image
Raw-Data"): in linear light L

    sigma^2 = k (L + READ_SHARE)

with k such that sigma is the one asked for at display-encoded mid grey, 0.5. It is drawn for the
sites of a Bayer pattern and interpolated as a demosaicing does, so that neighbours share it and
JPEG keeps it; it reaches display-encoded colours by the slope of the sRGB curve, to first order.
"""

from __future__ import annotations

import functools
import hashlib
import math

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from scipy.stats import norm
from torch import Tensor

from augment.cameras import Camera
from augment.render import picture_kernels
from augment.render.buffers import AUTO, CPU, kernels_for
from augment.render.composite import ROWS
from augment.render.threads import kernel_threads
from augment.rng import rng_for

READ_SHARE = 0.005  # of full scale: where reading is as noisy as photons are
MID_GREY = 0.5
_LEVEL_SD = 40.0  # of the draws, in their 8 bits: 3 sigma to either side
# The mean variance that bilinear demosaicing leaves of the sites' own: of green 5/8, else 9/16.
_LEFT = math.sqrt((0.625 + 2 * 0.5625) / 3)


def blur_lens(rgb: Float[Tensor, "H W 3"], psf_px: float) -> Float[Tensor, "H W 3"]:
    """The picture under a Gaussian of this sigma, pixels; > 0. On the CPU by OpenCV, elsewhere by
    the same sums in torch.
    """
    reach = math.ceil(3 * psf_px)
    if rgb.device.type == "cpu":
        size = (2 * reach + 1, 2 * reach + 1)
        blurred = cv2.GaussianBlur(
            rgb.detach().numpy(), size, psf_px, borderType=cv2.BORDER_REPLICATE
        )
        return torch.from_numpy(blurred)
    taps = torch.from_numpy(cv2.getGaussianKernel(2 * reach + 1, psf_px).astype(np.float32))
    taps = taps.to(rgb.device, rgb.dtype)
    rows = F.pad(rgb.permute(2, 0, 1)[:, None], (reach,) * 4, mode="replicate")
    rows = F.conv2d(rows, taps.view(1, 1, -1, 1))
    return F.conv2d(rows, taps.view(1, 1, 1, -1))[:, 0].permute(1, 2, 0)


def add_noise(
    rgb: Float[Tensor, "H W 3"],
    noise: float,
    camera: Camera,
    *,
    seed: int,
    scene: str,
    backend: str = AUTO,
) -> Float[Tensor, "H W 3"]:
    """The picture with the camera's noise: a function of seed, scene, camera, time and pose.

    noise: sigma at mid grey, of the display's range; > 0. Drawn on the CPU whatever the picture
    lies on; there, `rgb` is overwritten.
    """
    draws = draw_noise(camera, seed=seed, scene=scene)
    sigmas = noise_sigmas() * np.float32(noise / (_LEVEL_SD * _LEFT))
    if kernels_for(backend, rgb) == CPU:
        noisy = rgb.detach().contiguous().numpy()
        with kernel_threads(ROWS):
            rows = noisy.reshape(len(noisy), -1), draws.reshape(len(noisy), -1)
            picture_kernels.add_noise(*rows, sigmas)
        return torch.from_numpy(noisy)
    levels = (rgb.clamp(0, 1) * 255 + 0.5).long()
    sigma = torch.from_numpy(sigmas).to(rgb.device)[levels]
    return rgb + sigma * (torch.from_numpy(draws).to(rgb.device).float() - 128)


@functools.cache
def noise_sigmas() -> Float[np.ndarray, "256"]:
    """Noise of display-encoded colours, by their 8-bit level, over that of mid grey; float32."""

    def sigma(display: np.ndarray) -> np.ndarray:
        low = display <= 0.04045
        linear = np.where(low, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)
        slope = 1.055 / 2.4 * np.maximum(linear, 0.0031308) ** (1 / 2.4 - 1)
        return np.sqrt(linear + READ_SHARE) * np.where(low, 12.92, slope)

    levels = np.linspace(0, 1, 256)
    return (sigma(levels) / sigma(np.array([MID_GREY]))).astype(np.float32)


def draw_noise(camera: Camera, *, seed: int, scene: str) -> UInt8[np.ndarray, "H W 3"]:
    """Normal numbers in 8 bits about 128, demosaiced: _LEVEL_SD at a Bayer pattern's sites."""
    # Of a path without times, the pose tells frames apart.
    pose = np.ascontiguousarray(camera.camera_from_world.numpy(), np.float64).tobytes()
    which = f"{camera.timestamp_ns} ns, {hashlib.sha256(pose).hexdigest()}"
    rng = rng_for(seed=seed, scene=scene, effect=f"camera.noise at {which}", camera=camera.name)
    sites = rng.integers(0, 256, (max(2, camera.height), max(2, camera.width)), np.uint8)
    demosaiced = cv2.cvtColor(cv2.LUT(sites, _quantiles()), cv2.COLOR_BayerRG2RGB)
    return np.ascontiguousarray(demosaiced[: camera.height, : camera.width])


def noise_variance(
    rgb: Float[np.ndarray, "K 3"],
    down: Float[np.ndarray, " K"],
    across: Float[np.ndarray, " K"],
    noise: float,
) -> Float[np.ndarray, " K"]:
    """Variance of `add_noise` in colours sampled bilinearly, the mean over channels.

    down, across: 0 to 1, of the way from one pixel's centre to the next. Neighbours have noise in
    common, as demosaicing leaves it.
    """
    a, b = np.stack([1 - down, down]), np.stack([1 - across, across])
    # How far the weights of both directions reach: lags 0 and 1.
    rows = (a**2).sum(0), a[0] * a[1]
    columns = (b**2).sum(0), b[0] * b[1]
    shared = noise_covariance()
    kept = sum(
        shared[:, 1 + i, 1 + j] * (rows[abs(i)] * columns[abs(j)])[:, None]
        for i in (-1, 0, 1)
        for j in (-1, 0, 1)
    )
    levels = np.rint(rgb.clip(0, 1) * 255).astype(np.uint8)
    return ((noise * noise_sigmas()[levels]) ** 2 * kept).mean(1)


@functools.cache
def noise_covariance() -> Float[np.ndarray, "3 3 3"]:
    """Of a channel's noise with that of the pixels around (rows, columns: one before to one after),
    over the channels' mean variance; the mean over the places in a Bayer pattern.
    """
    found, unit = np.zeros((3, 3, 3)), 64
    for row, column in ((3, 3), (3, 4), (4, 3), (4, 4)):
        sites = np.zeros((8, 8), np.uint8)
        sites[row, column] = unit
        own = cv2.cvtColor(sites, cv2.COLOR_BayerRG2RGB).astype(np.float64) / unit
        for i in (-1, 0, 1):
            for j in (-1, 0, 1):
                found[:, 1 + i, 1 + j] += (own * np.roll(own, (i, j), (0, 1))).sum((0, 1)) / 4
    return found / _LEFT**2


@functools.cache
def _quantiles() -> UInt8[np.ndarray, "256"]:
    """A normal number for every byte."""
    values = norm.ppf((np.arange(256) + 0.5) / 256)
    return np.rint(128 + _LEVEL_SD * values / values.std()).clip(0, 255).astype(np.uint8)
