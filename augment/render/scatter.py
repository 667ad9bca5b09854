"""Forward scatter: droplets smear the light that comes through fog, the more the deeper it is.

A droplet much larger than the wavelength diffracts as much light as it blocks (Babinet; van de
Hulst 1957, "Light Scattering by Small Particles", ch. 8: an extinction of twice the cross-section),
into an angle of about wavelength / diameter. Large things keep that light, and with it the contrast
that Koschmieder's visibility goes by; fine ones lose it. In the small-angle approximation (Wells
1969, "Loss of resolution in water as a result of multiple small-angle scattering"; Kopeika 1998, "A
System Engineering Approach to Imaging", ch. 17) what arrives of a detail of nu cycles a radian,
beside what arrives of a large thing, is

    M(nu) = exp(-tau (1 - P(nu))),     P(nu) = int_0^1 C(u nu lambda / D) du

tau: optical depth of the way, of which diffraction has as much again. C: the transform of a disc's
diffraction, which is the autocorrelation of the disc. u: the share of the way that lies behind the
droplet, since what is deflected close to a thing still comes from beside it. M(0) = 1: no light is
lost. It is the many-times scattered light of Narasimhan and Nayar (2003, "Shedding Light on the
Weather"), without the wide angles that they keep, which are airlight here.

In the picture the sharp share is exp(-tau), the rest is spread by one kernel: the one of M at
NOMINAL_DEPTH, put together from the levels of a Gaussian pyramid. What passes between two pixels
goes by the nearer one's depth, so that near outlines stay sharp and dark cars have no halo in the
fog behind them: weights w_p w_q / sqrt(N_p N_q) with w = 1 - exp(-tau) and N = kernel * w, which
are the same both ways, so no light is made or lost. Colours are display-encoded, as fog blends
them.
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

from augment.cameras import Camera
from augment.render import picture_kernels
from augment.render.buffers import AUTO, CPU, kernels_for
from augment.render.composite import ROWS, pixels_at_unit_depth
from augment.render.fog import MAX_EXPONENT, Fog, optical_depth, sky_optical_depth
from augment.render.threads import kernel_threads

WAVELENGTH_UM = 0.55
DROPLET_UM = 20.0  # across: heavy advection fog, of mode radius 10 um (Shettle and Fenn 1979)
DIFFRACTION_RAD = WAVELENGTH_UM / DROPLET_UM
NOMINAL_DEPTH = 1.5  # where a fifth of the contrast of large things is left
NUM_LEVELS = 5  # of the pyramid, above the picture
# Of the picture that is blurred: the least that shows DIFFRACTION_RAD in so many pixels.
_MIN_PX = 12.0
_MIN_WEIGHT = 1e-6  # of neighbourhoods that scatter nothing

Image = TypeVar("Image", np.ndarray, Tensor)  # [H, W, C]


def scatter_forward(
    rgb: Float[Tensor, "H W 3"],
    alpha: Float[Tensor, "H W"],
    depth: Float[Tensor, "H W"],
    camera: Camera,
    medium: Fog,
    strength: float,
    *,
    backend: str = AUTO,
) -> Float[Tensor, "H W 3"]:
    """The finished picture in fog, its sky included, with its light smeared by the fog.

    depth: z, metres; 0 where there is no surface. alpha: of the surfaces; the rest is sky, at its
    own optical depth.
    strength: tau's factor, 1 for a droplet's whole diffraction; > 0. backend: on the CPU pixels go
    through kernels, equal to this definition within 1e-4, and `rgb` is overwritten.
    """
    factor = 2 ** max(0, math.floor(math.log2(DIFFRACTION_RAD * camera.fx / _MIN_PX)))
    size = max(1, camera.height // factor), max(1, camera.width // factor)
    # Levels whose kernel would be larger than the picture tell nothing of it.
    levels = max(0, min(NUM_LEVELS, int(math.log2(min(size))) - 1))
    shares = level_shares(DIFFRACTION_RAD * camera.fx / factor)[: levels + 1]
    if kernels_for(backend, rgb, alpha, depth) == CPU:
        weight = _scattered_share(alpha, depth, camera, medium, strength)
        return _exchanged(rgb, weight, size, shares)
    weight = _scattered_share_by_torch(alpha, depth, camera, medium, strength)[..., None]
    small, own = _resized(rgb, size), _resized(weight, size)
    around = (1 / (_spread(own, shares) + _MIN_WEIGHT)).sqrt()
    own = own * around
    spread = _spread(torch.cat([small * own, own], -1), shares) * around * sum(shares[1:])
    spread = _resized(spread, (camera.height, camera.width))
    return rgb + weight * (spread[..., :3] - rgb * spread[..., 3:])


def _exchanged(
    rgb: Tensor, weight: np.ndarray, size: tuple[int, int], shares: tuple[float, ...]
) -> Tensor:
    """What the pixels' light becomes, of weights w [H, W], by kernels. size: at which it is
    blurred.
    """
    full, sharp = (rgb.shape[0], rgb.shape[1]), rgb.detach().contiguous().numpy()
    own = _resized(weight[..., None], size)
    around = _spread(own, shares)[..., 0]
    weighed = np.empty((*size, 4), np.float32)
    with kernel_threads(ROWS):
        picture_kernels.weigh(
            _resized(sharp, size), own[..., 0], around, np.float32(_MIN_WEIGHT), weighed
        )
        spread = _spread(weighed, shares)
        picture_kernels.multiply(spread, around, np.float32(sum(shares[1:])))
        picture_kernels.blend_scattered(sharp, weight, _resized(spread, full))
    return torch.from_numpy(sharp)


def _scattered_share(
    alpha: Tensor, depth: Tensor, camera: Camera, medium: Fog, strength: float
) -> Float32[np.ndarray, "H W"]:
    """As _scattered_share_by_torch, by a kernel."""
    height_m, sigma = medium.scale_height_m, medium.sigma_per_m
    if height_m is not None:
        a = (float(camera.centre[2]) - medium.base_z_m) / height_m
        sigma *= math.exp(min(-a, MAX_EXPONENT))
    out = np.empty((camera.height, camera.width), np.float32)
    with kernel_threads(ROWS):
        picture_kernels.scattered_share(
            alpha.contiguous().numpy(), depth.contiguous().numpy(), *pixels_at_unit_depth(camera),
            camera.world_from_camera[2, :3].numpy().astype(np.float32), np.float32(strength),
            np.float32(min(sigma, 1e30)), np.float32(0 if height_m is None else 1 / height_m), out,
        )  # fmt: skip
    return out


def _scattered_share_by_torch(
    alpha: Tensor, depth: Tensor, camera: Camera, medium: Fog, strength: float
) -> Float[Tensor, "H W"]:
    """1 - exp(-strength tau) of every pixel: how much of its light is deflected."""
    lengths = camera.ray_lengths(depth.dtype, depth.device)
    eye_z_m, point_z_m, behind = float(camera.centre[2]), None, 1.0
    if medium.scale_height_m is not None:
        climb = camera.ray_directions(depth.dtype, depth.device)[..., 2]
        point_z_m = eye_z_m + depth * climb
        behind = -torch.expm1(-strength * sky_optical_depth(medium, climb / lengths, eye_z_m))
    tau = optical_depth(medium, depth * lengths, eye_z_m, point_z_m)
    shown = torch.where(depth > 0, alpha, 0.0)
    return (behind + shown * (-torch.expm1(-strength * tau) - behind)).clamp(0, 1)


# ---- The kernel ----------------------------------------------------------------------------------


def disc_autocorrelation(x: np.ndarray) -> np.ndarray:
    """C of the module's equation: overlap of two discs of diameter 1 at a distance x >= 0."""
    x = np.clip(x, 0, 1)
    return 2 / np.pi * (np.arccos(x) - x * np.sqrt(1 - x * x))


def once_scattered(cycles: np.ndarray) -> np.ndarray:
    """P of the module's equation [K]. cycles: nu lambda / D."""
    u = (np.arange(1000) + 0.5) / 1000
    return disc_autocorrelation(u * cycles[:, None]).mean(1)


def scattered(cycles: np.ndarray, tau: float) -> np.ndarray:
    """Of the light that was deflected at least once, what a detail keeps: (M - M(inf)) / (1 -
    M(inf)) = (exp(tau P) - 1) / (exp(tau) - 1), [K].
    """
    return np.expm1(tau * once_scattered(cycles)) / math.expm1(tau)


@functools.lru_cache(maxsize=64)
def level_shares(diffraction_px: float) -> tuple[float, ...]:
    """Shares [NUM_LEVELS + 1] of the pyramid's levels in the kernel, which sum to 1; level 0 is the
    picture itself. diffraction_px: pixels that DIFFRACTION_RAD spans.

    A level blurs by a variance of 2 (4^level - 1) / 3 px^2: a binomial of variance 1 down and one
    up between each two. Least squares over the frequencies that pixels can show: within
    0.05 from 6 px on, 0.11 at 3.
    """
    frequency = np.geomspace(1e-3, 0.5, 200)  # cycles a pixel
    variance = 2 * (4.0 ** np.arange(NUM_LEVELS + 1) - 1) / 3
    levels = np.exp(-2 * np.pi**2 * variance * frequency[:, None] ** 2)
    whole = 1e3 * np.ones((1, NUM_LEVELS + 1))
    kernel = np.append(scattered(frequency * diffraction_px, NOMINAL_DEPTH), 1e3)
    shares, _ = nnls(np.concatenate([levels, whole]), kernel)
    return tuple(float(share) for share in shares / shares.sum())


# ---- The pyramid: of arrays by OpenCV, of tensors by torch ---------------------------------------
# Arrays since torch's threads cost more than they give where others are busy.

_BINOMIAL = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)


def _spread(image: Image, shares: tuple[float, ...]) -> Image:
    """The image under the kernel without its level 0. Each level is blurred going down as it is
    going up, so the kernel is symmetric.
    """
    levels = [image]
    for _ in shares[1:]:
        levels.append(pyramid_down(levels[-1]))
    whole = sum(shares[1:]) or 1.0
    total = levels[-1] * (shares[-1] / whole)
    for level in range(len(shares) - 2, -1, -1):
        total = pyramid_up(total, (levels[level].shape[0], levels[level].shape[1]))
        if level > 0:
            total += levels[level] * (shares[level] / whole)
    return total


def pyramid_down(image: Image) -> Image:
    """Every second pixel of every second row of the image under a binomial of variance 1."""
    if isinstance(image, np.ndarray):
        return _with_channels(cv2.pyrDown(image), image)
    rows = F.pad(image.permute(2, 0, 1)[:, None], (2, 2, 2, 2), mode="reflect")
    taps = torch.tensor(_BINOMIAL, device=image.device, dtype=image.dtype)
    rows = F.conv2d(rows, taps.view(1, 1, 5, 1), stride=(2, 1))
    return F.conv2d(rows, taps.view(1, 1, 1, 5), stride=(1, 2))[:, 0].permute(1, 2, 0)


def pyramid_up(image: Image, size: tuple[int, int]) -> Image:
    """The image at twice its size, between its pixels under the same binomial."""
    if isinstance(image, np.ndarray):
        return _with_channels(cv2.pyrUp(image, dstsize=size[::-1]), image)
    # As OpenCV: before the first pixel comes the second one, after the last comes itself.
    small = F.pad(image.permute(2, 0, 1)[:, None], (1, 0, 1, 0), mode="reflect")
    small = F.pad(small, (0, 1, 0, 1), mode="replicate")
    taps = 2 * torch.tensor(_BINOMIAL, device=image.device, dtype=image.dtype)
    rows = F.conv_transpose2d(small, taps.view(1, 1, 5, 1), stride=(2, 1))
    rows = F.conv_transpose2d(rows, taps.view(1, 1, 1, 5), stride=(1, 2))
    return rows[:, 0, 4 : 4 + size[0], 4 : 4 + size[1]].permute(1, 2, 0)


def _resized(image: Image, size: tuple[int, int]) -> Image:
    """At another size: means over areas where it shrinks, bilinear where it grows."""
    if (image.shape[0], image.shape[1]) == size:
        return image
    shrinks = image.shape[0] > size[0] or image.shape[1] > size[1]
    if isinstance(image, np.ndarray):
        how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        return _with_channels(cv2.resize(image, size[::-1], interpolation=how), image)
    mode = "area" if shrinks else "bilinear"
    return F.interpolate(image.permute(2, 0, 1)[None], size, mode=mode)[0].permute(1, 2, 0)


def _with_channels(array: np.ndarray, like: np.ndarray) -> np.ndarray:
    """OpenCV drops a single channel."""
    return array.reshape(*array.shape[:2], like.shape[2])
