"""Forward scatter: droplets smear the light that comes through fog, the more the deeper the fog is.

`effects.smog` calls `scatter_forward` on finished images.

A droplet much larger than the wavelength diffracts as much light as it blocks (Babinet; van de
Hulst 1957, "Light Scattering by Small Particles", ch. 8: an extinction of twice the cross-section),
into an angle of about wavelength / diameter. Large things keep that light, and with it the contrast
that Koschmieder's visibility is defined by; fine details lose it. In the small-angle approximation
(Wells 1969, "Loss of resolution in water as a result of multiple small-angle scattering"; Kopeika
1998, "A System Engineering Approach to Imaging", ch. 17) a detail of nu cycles per radian arrives,
relative to a large thing, with the factor

    M(nu) = exp(-tau (1 - P(nu))),     P(nu) = int_0^1 C(u nu lambda / D) du

tau: optical depth of the ray, of which diffraction has as much again.
C: transform of a disc's diffraction, which is the autocorrelation of the disc.
u: share of the ray that lies behind the droplet, since light that is deflected close to a thing
    still comes from beside it.
lambda, D: WAVELENGTH_UM and DROPLET_UM.

M(0) = 1: no light is lost. M describes the multiple scattering of Narasimhan and Nayar (2003,
"Shedding Light on the Weather"), without the wide angles of that model, which are airlight here.

In the image the sharp share is exp(-tau). The rest is spread by one kernel, that of M at
NOMINAL_DEPTH, composed from the levels of a Gaussian pyramid. The light that two pixels exchange
depends on the depth of the nearer one, so near outlines stay sharp and dark cars have no halo in
the fog behind them: the weights are w_p w_q / sqrt(N_p N_q) with w = 1 - exp(-tau) and
N = kernel * w. They are the same in both directions, so no light is made or lost. Colours are
display-encoded, as fog blends them.
"""

from __future__ import annotations

import functools
import math
from typing import TypeVar

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Float32
from scipy.optimize import nnls
from torch import Tensor

from augment.render import picture_kernels
from augment.render.buffers import AUTO, CPU, choose_kernels
from augment.render.composite import ROWS_PER_CHUNK, unit_depth_coordinates
from augment.render.fog import MAX_EXPONENT, Fog
from augment.render.fog_image import (
    fits_plain_kernels,
    image_optical_depth,
    plain_fog_depth,
    sky_image_depth,
)
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera

# Wavelength of the light, micrometres.
WAVELENGTH_UM = 0.55
# Diameter of a droplet, micrometres: heavy advection fog, of mode radius 10 um (Shettle and Fenn
# 1979).
DROPLET_UM = 20.0
# Angle into which a droplet diffracts, radians.
DIFFRACTION_RAD = WAVELENGTH_UM / DROPLET_UM
# Optical depth of the kernel: a fifth of the contrast of large things is left there.
NOMINAL_DEPTH = 1.5
# Number of the pyramid's levels above the image.
NUM_LEVELS = 5
# Smallest number of pixels that DIFFRACTION_RAD spans in the image that is blurred.
_MIN_PX = 12.0
# Weight that is added to neighbourhoods, since some scatter nothing.
_MIN_WEIGHT = 1e-6

Image = TypeVar("Image", np.ndarray, Tensor)  # [H, W, C]


def scatter_forward(
    rgb: Float[Tensor, "H W 3"],
    alpha: Float[Tensor, "H W"],
    depth: Float[Tensor, "H W"],
    camera: Camera,
    fog: Fog,
    strength: float,
    *,
    fog_share: Float[Tensor, "H W"] | None = None,
    backend: str = AUTO,
) -> Float[Tensor, "H W 3"]:
    """Return the finished image in fog, sky included, with its light smeared by the fog.

    Args:
        rgb: the image, display-encoded; on the CPU it is overwritten.
        alpha: alpha of the surfaces; the rest of a pixel is sky, at its own optical depth.
        depth: z of the surfaces, metres; 0 where there is no surface.
        camera: camera of the image.
        fog: the fog.
        strength: factor of tau, > 0; 1 for the whole diffraction of a droplet.
        fog_share: 1 - exp(-tau) of each pixel, where it is known better than by depth.
        backend: on the CPU, pixels go through kernels, equal to this definition within 1e-4.
    """
    factor = 2 ** max(0, math.floor(math.log2(DIFFRACTION_RAD * camera.fx / _MIN_PX)))
    size = max(1, camera.height // factor), max(1, camera.width // factor)
    # Levels whose kernel would be larger than the image are left out.
    levels = max(0, min(NUM_LEVELS, int(math.log2(min(size))) - 1))
    shares = level_shares(DIFFRACTION_RAD * camera.fx / factor)[: levels + 1]
    if choose_kernels(backend, rgb, alpha, depth) == CPU:
        if fog_share is None:
            weight = _scattered_share_by_kernel(alpha, depth, camera, fog, strength)
        else:
            transmittance = np.maximum(1 - fog_share.detach().numpy(), 0)
            weight = 1 - cv2.pow(transmittance, strength)  # torch takes three times as long
        return _exchange_light(rgb, weight, size, shares)
    if fog_share is None:
        weight = _scattered_share_by_torch(alpha, depth, camera, fog, strength)[..., None]
    else:
        weight = 1 - ((1 - fog_share).clamp_min(0) ** strength)[..., None]
    small_rgb = _resize(rgb, size)
    small_weight = _resize(weight, size)
    neighbourhood_scale = (1 / (_blur_by_pyramid(small_weight, shares) + _MIN_WEIGHT)).sqrt()
    small_weight = small_weight * neighbourhood_scale
    spread = (
        _blur_by_pyramid(torch.cat([small_rgb * small_weight, small_weight], -1), shares)
        * neighbourhood_scale
        * sum(shares[1:])
    )
    spread = _resize(spread, (camera.height, camera.width))
    return rgb + weight * (spread[..., :3] - rgb * spread[..., 3:])


def _exchange_light(
    rgb: Tensor, weight: np.ndarray, size: tuple[int, int], shares: tuple[float, ...]
) -> Tensor:
    """Return the image after its pixels have exchanged light, by kernels.

    Args:
        rgb: the image; it is overwritten.
        weight: weights w [H, W].
        size: height and width at which the light is blurred.
        shares: shares of the pyramid's levels.
    """
    full_size = (rgb.shape[0], rgb.shape[1])
    sharp_rgb = rgb.detach().contiguous().numpy()
    small_weight = _resize(weight[..., None], size)
    neighbourhood_weight = _blur_by_pyramid(small_weight, shares)[..., 0]
    weighted_rgb = np.empty((*size, 4), np.float32)
    with kernel_threads(ROWS_PER_CHUNK):
        picture_kernels.weight_pixels(
            _resize(sharp_rgb, size),
            small_weight[..., 0],
            neighbourhood_weight,
            np.float32(_MIN_WEIGHT),
            weighted_rgb,
        )
        spread = _blur_by_pyramid(weighted_rgb, shares)
        picture_kernels.scale_pixels(spread, neighbourhood_weight, np.float32(sum(shares[1:])))
        picture_kernels.blend_scattered(sharp_rgb, weight, _resize(spread, full_size))
    return torch.from_numpy(sharp_rgb)


def scattered_share(
    alpha: Float[Tensor, "H W"],
    depth: Float[Tensor, "H W"],
    camera: Camera,
    fog: Fog,
    strength: float = 1.0,
    *,
    backend: str = AUTO,
) -> Float[Tensor, "H W"]:
    """Return 1 - exp(-strength tau) of every pixel; at strength 1 it is the fog's share.

    The arguments are those of `scatter_forward`. A pixel is the mean of its surfaces and its sky.
    """
    if choose_kernels(backend, alpha, depth) == CPU:
        return torch.from_numpy(_scattered_share_by_kernel(alpha, depth, camera, fog, strength))
    return _scattered_share_by_torch(alpha, depth, camera, fog, strength)


def _scattered_share_by_kernel(
    alpha: Tensor, depth: Tensor, camera: Camera, fog: Fog, strength: float
) -> Float32[np.ndarray, "H W"]:
    """Return `_scattered_share_by_torch`, by a kernel where there is one for the fog."""
    if not fits_plain_kernels(fog):
        return _scattered_share_by_torch(alpha, depth, camera, fog, strength).numpy()
    scale_height_m = fog.scale_height_m
    extinction_per_m = fog.extinction_per_m
    if scale_height_m is not None:
        a = (float(camera.centre[2]) - fog.base_z_m) / scale_height_m
        extinction_per_m *= math.exp(min(-a, MAX_EXPONENT))
    out = np.empty((camera.height, camera.width), np.float32)
    with kernel_threads(ROWS_PER_CHUNK):
        picture_kernels.scattered_share(
            alpha.contiguous().numpy(),
            plain_fog_depth(fog, camera, depth).contiguous().numpy(),
            *unit_depth_coordinates(camera),
            camera.world_from_camera[2, :3].numpy().astype(np.float32),
            np.float32(strength),
            np.float32(min(extinction_per_m, 1e30)),
            np.float32(0 if scale_height_m is None else 1 / scale_height_m),
            out,
        )
    return out


def _scattered_share_by_torch(
    alpha: Tensor, depth: Tensor, camera: Camera, fog: Fog, strength: float
) -> Float[Tensor, "H W"]:
    """Return 1 - exp(-strength tau) of every pixel: the share of its light that is deflected."""
    sky_share = 1.0
    if fog.scale_height_m is not None:
        climb = camera.ray_directions(depth.dtype, depth.device)[..., 2]
        slope = climb / camera.ray_lengths(depth.dtype, depth.device)
        sky_share = -torch.expm1(-strength * sky_image_depth(fog, camera, slope))
    tau = image_optical_depth(fog, camera, depth)
    shown_alpha = torch.where(depth > 0, alpha, 0.0)
    return (sky_share + shown_alpha * (-torch.expm1(-strength * tau) - sky_share)).clamp(0, 1)


# ---- The kernel ----------------------------------------------------------------------------------


def disc_autocorrelation(x: np.ndarray) -> np.ndarray:
    """Return C of the module: overlap of two discs of diameter 1 at a distance x >= 0."""
    x = np.clip(x, 0, 1)
    return 2 / np.pi * (np.arccos(x) - x * np.sqrt(1 - x * x))


def once_scattered(cycles: np.ndarray) -> np.ndarray:
    """Return P of the module's equation [K]. cycles: nu lambda / D."""
    u = (np.arange(1000) + 0.5) / 1000
    return disc_autocorrelation(u * cycles[:, None]).mean(1)


def scattered(cycles: np.ndarray, tau: float) -> np.ndarray:
    """Return the contrast that light keeps which was deflected at least once, [K].

    It is (M - M(inf)) / (1 - M(inf)) = (exp(tau P) - 1) / (exp(tau) - 1).
    """
    return np.expm1(tau * once_scattered(cycles)) / math.expm1(tau)


@functools.lru_cache(maxsize=64)
def level_shares(diffraction_px: float) -> tuple[float, ...]:
    """Return the shares [NUM_LEVELS + 1] of the pyramid's levels in the kernel. They sum to 1.

    Level 0 is the image itself. A level blurs by a variance of 2 (4^level - 1) / 3 px^2: between
    two levels lie a binomial of variance 1 on the way down and one on the way up. The shares are a
    least squares fit over the frequencies that pixels can show: within 0.05 from 6 px on, 0.11 at
    3.

    diffraction_px: pixels that DIFFRACTION_RAD spans.
    """
    frequency = np.geomspace(1e-3, 0.5, 200)  # cycles a pixel
    variance = 2 * (4.0 ** np.arange(NUM_LEVELS + 1) - 1) / 3
    levels = np.exp(-2 * np.pi**2 * variance * frequency[:, None] ** 2)
    sum_row = 1e3 * np.ones((1, NUM_LEVELS + 1))
    kernel = np.append(scattered(frequency * diffraction_px, NOMINAL_DEPTH), 1e3)
    shares, _ = nnls(np.concatenate([levels, sum_row]), kernel)
    return tuple(float(share) for share in shares / shares.sum())


# ---- The pyramid: of arrays by OpenCV, of tensors by torch ---------------------------------------
# The CPU uses arrays: torch's threads cost more than they gain while other threads are busy.

# Weights of a binomial of variance 1, px^2.
_BINOMIAL = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)


def _blur_by_pyramid(image: Image, shares: tuple[float, ...]) -> Image:
    """Return the image under the kernel without its level 0.

    Each level is blurred equally on the way down and on the way up, so the kernel is symmetric.
    """
    levels = [image]
    for _ in shares[1:]:
        levels.append(pyramid_down(levels[-1]))
    total_share = sum(shares[1:]) or 1.0
    total = levels[-1] * (shares[-1] / total_share)
    for level in range(len(shares) - 2, -1, -1):
        total = pyramid_up(total, (levels[level].shape[0], levels[level].shape[1]))
        if level > 0:
            total += levels[level] * (shares[level] / total_share)
    return total


def pyramid_down(image: Image) -> Image:
    """Return every second pixel of every second row of the image under a binomial of variance 1."""
    if isinstance(image, np.ndarray):
        return _restore_channels(cv2.pyrDown(image), image)
    rows = F.pad(image.permute(2, 0, 1)[:, None], (2, 2, 2, 2), mode="reflect")
    taps = torch.tensor(_BINOMIAL, device=image.device, dtype=image.dtype)
    rows = F.conv2d(rows, taps.view(1, 1, 5, 1), stride=(2, 1))
    return F.conv2d(rows, taps.view(1, 1, 1, 5), stride=(1, 2))[:, 0].permute(1, 2, 0)


def pyramid_up(image: Image, size: tuple[int, int]) -> Image:
    """Return the image at twice its size, interpolated with the same binomial."""
    if isinstance(image, np.ndarray):
        return _restore_channels(cv2.pyrUp(image, dstsize=size[::-1]), image)
    # Borders as in OpenCV: the second pixel comes before the first, and the last is repeated.
    small = F.pad(image.permute(2, 0, 1)[:, None], (1, 0, 1, 0), mode="reflect")
    small = F.pad(small, (0, 1, 0, 1), mode="replicate")
    taps = 2 * torch.tensor(_BINOMIAL, device=image.device, dtype=image.dtype)
    rows = F.conv_transpose2d(small, taps.view(1, 1, 5, 1), stride=(2, 1))
    rows = F.conv_transpose2d(rows, taps.view(1, 1, 1, 5), stride=(1, 2))
    return rows[:, 0, 4 : 4 + size[0], 4 : 4 + size[1]].permute(1, 2, 0)


def _resize(image: Image, size: tuple[int, int]) -> Image:
    """Return the image at another size: area means if it shrinks, bilinear if it grows."""
    if (image.shape[0], image.shape[1]) == size:
        return image
    shrinks = image.shape[0] > size[0] or image.shape[1] > size[1]
    if isinstance(image, np.ndarray):
        interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        return _restore_channels(cv2.resize(image, size[::-1], interpolation=interpolation), image)
    mode = "area" if shrinks else "bilinear"
    return F.interpolate(image.permute(2, 0, 1)[None], size, mode=mode)[0].permute(1, 2, 0)


def _restore_channels(array: np.ndarray, like: np.ndarray) -> np.ndarray:
    """Return the array with the channel that OpenCV drops from images with a single one."""
    return array.reshape(*array.shape[:2], like.shape[2])
