"""Blur of a camera's lens, and a camera's noise. `views` applies both to finished images.

Photons have a variance that grows with the light, and reading has one that does not
(Foi et al. 2008, "Practical Poissonian-Gaussian Noise Modeling and Fitting for Single-Image
Raw-Data"): in linear light L

    sigma^2 = k (L + READ_SHARE)

with k such that sigma is the requested one at display-encoded mid grey, 0.5. Noise is drawn for the
sites of a Bayer pattern and interpolated as a demosaicing does, so that neighbours share it and
JPEG keeps it. The slope of the sRGB curve carries it to display-encoded colours, to first order.
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

from augment.render import picture_kernels
from augment.render.buffers import AUTO, CPU, choose_kernels
from augment.render.composite import ROWS_PER_CHUNK
from augment.render.threads import kernel_threads
from augment.rng import rng_for
from augment.scene.cameras import Camera

# Linear light, relative to full scale, at which reading is as noisy as photons are.
READ_SHARE = 0.005
# Display-encoded level at which a recipe states the noise.
MID_GREY = 0.5
# Standard deviation of the draws in their 8 bits, which leaves 3 sigma to either side.
LEVEL_SD = 40.0
# Standard deviation that bilinear demosaicing leaves of the sites' noise: the root of the mean
# variance, 5/8 for green, 9/16 for red and blue.
_DEMOSAICED_SD = math.sqrt((0.625 + 2 * 0.5625) / 3)


def blur_lens(rgb: Float[Tensor, "H W 3"], psf_px: float) -> Float[Tensor, "H W 3"]:
    """Return the image under a Gaussian. On the CPU OpenCV blurs it, elsewhere torch by the same
    sums.

    psf_px: sigma of the Gaussian, pixels; > 0.
    """
    radius_px = math.ceil(3 * psf_px)
    if rgb.device.type == "cpu":
        size = (2 * radius_px + 1, 2 * radius_px + 1)
        blurred_rgb = cv2.GaussianBlur(
            rgb.detach().numpy(), size, psf_px, borderType=cv2.BORDER_REPLICATE
        )
        return torch.from_numpy(blurred_rgb)
    taps = torch.from_numpy(cv2.getGaussianKernel(2 * radius_px + 1, psf_px).astype(np.float32))
    taps = taps.to(rgb.device, rgb.dtype)
    rows = F.pad(rgb.permute(2, 0, 1)[:, None], (radius_px,) * 4, mode="replicate")
    rows = F.conv2d(rows, taps.view(1, 1, -1, 1))
    return F.conv2d(rows, taps.view(1, 1, 1, -1))[:, 0].permute(1, 2, 0)


def add_noise(
    rgb: Float[Tensor, "H W 3"],
    mid_grey_sigma: float,
    camera: Camera,
    *,
    seed: int,
    scene: str,
    backend: str = AUTO,
) -> Float[Tensor, "H W 3"]:
    """Return the image with the camera's noise: a function of seed, scene, camera, time and pose.

    Args:
        rgb: the image; it is overwritten if it lies on the CPU.
        mid_grey_sigma: sigma at mid grey, relative to the display's range; > 0.
        camera: camera of the image.
        seed: seed of the recipe.
        scene: name of the scene.
        backend: backend of the render. The noise is drawn on the CPU for every backend.
    """
    draws = draw_noise(camera, seed=seed, scene=scene)
    sigmas = noise_sigmas() * np.float32(mid_grey_sigma / (LEVEL_SD * _DEMOSAICED_SD))
    if choose_kernels(backend, rgb) == CPU:
        noisy_rgb = rgb.detach().contiguous().numpy()
        with kernel_threads(ROWS_PER_CHUNK):
            rows = noisy_rgb.reshape(len(noisy_rgb), -1), draws.reshape(len(noisy_rgb), -1)
            picture_kernels.add_noise(*rows, sigmas)
        return torch.from_numpy(noisy_rgb)
    levels = (rgb.clamp(0, 1) * 255 + 0.5).long()
    sigma = torch.from_numpy(sigmas).to(rgb.device)[levels]
    return rgb + sigma * (torch.from_numpy(draws).to(rgb.device).float() - 128)


@functools.cache
def noise_sigmas() -> Float[np.ndarray, "256"]:
    """Return the noise of display-encoded colours by their 8-bit level, over that of mid grey.

    The sigmas are float32 [256].
    """

    def sigma(display: np.ndarray) -> np.ndarray:
        """Return the noise at display-encoded levels, up to a constant factor."""
        is_linear_part = display <= 0.04045
        linear = np.where(is_linear_part, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)
        slope = 1.055 / 2.4 * np.maximum(linear, 0.0031308) ** (1 / 2.4 - 1)
        return np.sqrt(linear + READ_SHARE) * np.where(is_linear_part, 12.92, slope)

    levels = np.linspace(0, 1, 256)
    return (sigma(levels) / sigma(np.array([MID_GREY]))).astype(np.float32)


def draw_noise(camera: Camera, *, seed: int, scene: str) -> UInt8[np.ndarray, "H W 3"]:
    """Return demosaiced normal numbers in 8 bits about 128.

    Their standard deviation at the sites of the Bayer pattern is LEVEL_SD.
    """
    # The pose distinguishes the frames of a path without times.
    pose = np.ascontiguousarray(camera.camera_from_world.numpy(), np.float64).tobytes()
    frame_key = f"{camera.timestamp_ns} ns, {hashlib.sha256(pose).hexdigest()}"
    rng = rng_for(seed=seed, scene=scene, effect=f"camera.noise at {frame_key}", camera=camera.name)
    sites = rng.integers(0, 256, (max(2, camera.height), max(2, camera.width)), np.uint8)
    demosaiced = cv2.cvtColor(cv2.LUT(sites, _quantiles()), cv2.COLOR_BayerRG2RGB)
    return np.ascontiguousarray(demosaiced[: camera.height, : camera.width])


def noise_variance(
    rgb: Float[np.ndarray, "K 3"],
    down: Float[np.ndarray, " K"],
    across: Float[np.ndarray, " K"],
    mid_grey_sigma: float,
) -> Float[np.ndarray, " K"]:
    """Return the variance of `add_noise` in colours that are sampled bilinearly, the mean over
    channels.

    Neighbours share noise, as demosaicing leaves it.

    Args:
        rgb: colours, display-encoded.
        down: vertical position between two pixel centres, 0 to 1.
        across: horizontal position between two pixel centres, 0 to 1.
        mid_grey_sigma: sigma at mid grey, as in `add_noise`.
    """
    row_weights = np.stack([1 - down, down])
    column_weights = np.stack([1 - across, across])
    # Products of the weights at lags 0 and 1, in both directions.
    rows = (row_weights**2).sum(0), row_weights[0] * row_weights[1]
    columns = (column_weights**2).sum(0), column_weights[0] * column_weights[1]
    covariance = noise_covariance()
    variance_share = sum(
        covariance[:, 1 + i, 1 + j] * (rows[abs(i)] * columns[abs(j)])[:, None]
        for i in (-1, 0, 1)
        for j in (-1, 0, 1)
    )
    levels = np.rint(rgb.clip(0, 1) * 255).astype(np.uint8)
    return ((mid_grey_sigma * noise_sigmas()[levels]) ** 2 * variance_share).mean(1)


@functools.cache
def noise_covariance() -> Float[np.ndarray, "3 3 3"]:
    """Return the covariance of a channel's noise with that of the pixels around, [channel, row,
    column].

    Rows and columns go from one before to one after. The covariances are relative to the channels'
    mean variance, and are means over the positions in a Bayer pattern.
    """
    covariance = np.zeros((3, 3, 3))
    site_level = 64
    for row, column in ((3, 3), (3, 4), (4, 3), (4, 4)):
        sites = np.zeros((8, 8), np.uint8)
        sites[row, column] = site_level
        demosaiced = cv2.cvtColor(sites, cv2.COLOR_BayerRG2RGB).astype(np.float64) / site_level
        for i in (-1, 0, 1):
            for j in (-1, 0, 1):
                covariance[:, 1 + i, 1 + j] += (
                    demosaiced * np.roll(demosaiced, (i, j), (0, 1))
                ).sum((0, 1)) / 4
    return covariance / _DEMOSAICED_SD**2


@functools.cache
def _quantiles() -> UInt8[np.ndarray, "256"]:
    """Return a normal number for every byte."""
    values = norm.ppf((np.arange(256) + 0.5) / 256)
    return np.rint(128 + LEVEL_SD * values / values.std()).clip(0, 255).astype(np.uint8)
