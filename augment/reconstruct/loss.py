"""The loss of one view, from the rasteriser's images to their gradients.

    picture = color_map(rgb + (1 - alpha) sky(direction))
    total = (1 - d_ssim) L1 + d_ssim (1 - SSIM) / 2 + depth |1/ED - 1/z| + surface (1 - alpha)
            + sky alpha + ground (1 - alpha)

Each term is a weighted mean as `LossWeights` says. The trainer calls `view_loss`; a test compares
it with a definition in torch. SSIM is that of 3D Gaussian splatting (Kerbl et al. 2023): windows of
11 x 11 pixels, a Gaussian of sigma 1.5, zeros beyond the image, per channel, of pictures in [0, 1]
that are not clamped.

Departures, which the definition in torch shares:
- Where a pixel's weight is 0, both pictures hold the prediction there, as a constant: the pixel
  neither disturbs the windows of its neighbours nor gets a gradient from them. (Depth and sky have
  masks of their own and ignore the weight.)
- The sky is not looked up where 1 - alpha < MIN_SKY; it counts as black there, without a gradient.
- A depth prior counts only where alpha > MIN_ALPHA: the expected depth of almost nothing is noise.
  Elsewhere it gives no gradient, but the mean always divides by all of the view's priors, so that
  uncovered pixels do not make the others count more.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch

from augment.reconstruct import kernels
from augment.reconstruct.config import LossWeights
from augment.reconstruct.view import RecordedView
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera
from augment.scene.sky import CubemapSky, Sky, directions_of_cubemap

MIN_SKY = 1e-3  # transmittance; the sky behind less changes a pixel by at most 1/4 of an 8-bit step
MIN_ALPHA = 0.05  # opacity from which a depth prior counts


@dataclass(frozen=True, eq=False)
class SkyGradient:
    """Gradient of the sky's texels that the view shows."""

    texels: np.ndarray  # int32 [T], increasing indices into faces.reshape(-1, 3)
    grads: np.ndarray  # float32 [T, 3]


class ImageBuffers:
    """Buffers of an image's size; the kernels describe each one."""

    def __init__(self, height: int, width: int) -> None:
        lanes = kernels.NUM_LANES
        pad = kernels.PAD
        stride = -(-width // lanes) * lanes
        padded = (height + 2 * pad) * stride
        self.size = (height, width, stride)
        self.sky_colors = np.zeros((3, height, stride), np.float32)
        self.texels = np.empty((height, width), np.int32)
        self.fractions = np.empty((2, height, width), np.float32)
        self.pairs = np.zeros(6 * padded, np.float32)  # its margins stay zero
        self.slopes = np.zeros(9 * padded, np.float32)
        self.weights = np.empty(height * stride, np.float32)
        self.sums = np.empty((height, 2, lanes), np.float32)
        self.alpha_in_sky = np.empty(height)
        self.ssim_sums = np.empty((height, lanes), np.float32)
        self.map_sums = np.empty((height, 3, 4, lanes), np.float32)
        self.composite = np.empty(3 * height * stride, np.float32)
        self.d_rgb = np.empty((height, width, 3), np.float32)
        self.d_alpha = np.empty((height, width), np.float32)
        self.d_expected_depth = np.empty((height, width), np.float32)


class SkyBuffers:
    """Sums over a cube map of faces `size` wide, zero between two calls."""

    def __init__(self, size: int) -> None:
        self.size = size
        num_texels = 6 * size * size
        padded_texels = -(-num_texels // 8) * 8
        self.parts = np.zeros((kernels.PARTS, num_texels, 3), np.float32)
        self.touched = np.zeros((kernels.PARTS, padded_texels), np.uint8)
        self.texels = np.empty(num_texels, np.int32)
        self.grads = np.empty((num_texels, 3), np.float32)
        self.is_clean = True

    def gradient(
        self, d_rgb: np.ndarray, alpha: np.ndarray, image: ImageBuffers
    ) -> SkyGradient | None:
        """Return the gradient of the texels that the image shows, or None without any."""
        if not self.is_clean:  # a call was interrupted between the two kernels
            self.parts.fill(0)
            self.touched.fill(0)
        self.is_clean = False
        kernels.scatter_sky(
            d_rgb, alpha, image.texels, image.fractions, self.size, self.parts, self.touched
        )
        words = self.touched.view(np.uint64)
        num_texels = kernels.gather_sky(self.parts, self.touched, words, self.texels, self.grads)
        self.is_clean = True
        return (
            SkyGradient(self.texels[:num_texels], self.grads[:num_texels]) if num_texels else None
        )


@dataclass(eq=False)
class LossScratch:
    """Buffers that calls of `view_loss` share, so that nothing is allocated.

    Gradients that a call returns lie in these buffers: they are valid until the next call. Two
    threads must not use the same record at once.
    """

    _images: dict[tuple[int, int], ImageBuffers] = field(default_factory=dict)
    _skies: dict[int, SkyBuffers] = field(default_factory=dict)

    def image(self, height: int, width: int) -> ImageBuffers:
        """Return the buffers of an image's size."""
        key = (height, width)
        if key not in self._images:
            self._images[key] = ImageBuffers(height, width)
        return self._images[key]

    def sky(self, size: int) -> SkyBuffers:
        """Return the buffers of a sky; their sums are zero even after a failed call."""
        if size not in self._skies:
            self._skies[size] = SkyBuffers(size)
        return self._skies[size]


# A colour map that changes nothing, [3, 4].
IDENTITY_MAP = np.eye(3, 4, dtype=np.float32)


@dataclass(frozen=True, eq=False)
class ViewLoss:
    """A view's loss and its gradient.

    A view whose weights are all 0 has l1 0, ssim 1, and gradients only from depth and sky.
    """

    total: float  # the weighted sum; d_* are its derivatives
    l1: float  # mean |picture - recorded| over weighted pixels
    ssim: float  # mean SSIM over weighted pixels; 1 without any
    depth: float  # mean |1/ED - 1/z|, 1/m
    sky: float  # mean over the image of alpha in the sky
    d_rgb: np.ndarray  # float32 [H, W, 3]
    d_alpha: np.ndarray  # float32 [H, W]
    d_expected_depth: np.ndarray  # float32 [H, W]
    d_color_map: np.ndarray  # float64 [3, 4]
    d_sky: SkyGradient | None  # None where the view shows no texel
    surface: float = 0.0  # mean of 1 - alpha at the depth priors


def view_loss(
    rgb: np.ndarray,
    alpha: np.ndarray,
    expected_depth: np.ndarray | None,
    view: RecordedView,
    sky_faces: np.ndarray,
    color_map: np.ndarray,
    weights: LossWeights,
    *,
    scratch: LossScratch | None = None,
) -> ViewLoss:
    """Return the loss of a render of `view.camera` against the view, and its gradient.

    The same inputs give the same bits for any number of threads.

    Args:
        rgb: float32 [H, W, 3], rasterised without background.
        alpha: float32 [H, W], rasterised.
        expected_depth: float32 [H, W], metres, rasterised; None switches depth priors off.
        view: the recorded image.
        sky_faces: float32 [6, R, R, 3].
        color_map: float32 [3, 4].
        weights: weights of the terms.
        scratch: buffers to reuse, which saves page faults by the megabyte; the gradients are then
            valid until the next call.

    Raises:
        ValueError: an array's shape or type is wrong, or depth_pixels are not increasing indices.
    """
    camera = view.camera
    size = (camera.height, camera.width)
    faces = sky_faces.shape[1] if sky_faces.ndim == 4 and sky_faces.shape[1] else 1
    rgb = _checked_array("rgb", rgb, (*size, 3), camera)
    alpha = _checked_array("alpha", alpha, size, camera)
    sky_faces = _checked_array("sky_faces", sky_faces, (6, faces, faces, 3), camera)
    color_map = _checked_array("color_map", color_map, (3, 4), camera)
    if expected_depth is not None:
        expected_depth = _checked_array("expected_depth", expected_depth, size, camera)
    scratch = scratch or LossScratch()
    buffers = scratch.image(camera.height, camera.width)
    with kernel_threads():
        rotation = camera.camera_from_world[:3, :3].numpy().T.astype(np.float32, order="C")
        intrinsics = np.array([1 / camera.fx, 1 / camera.fy, camera.cx, camera.cy], np.float32)
        sky_samples = (buffers.sky_colors, buffers.texels, buffers.fractions)
        kernels.sample_sky(
            alpha, sky_faces, rotation, intrinsics, np.float32(MIN_SKY), *sky_samples
        )
        l1, ssim, sky, d_color_map = _compare(rgb, alpha, view, color_map, weights, buffers)
        depth = _compare_depth(expected_depth, alpha, view, weights, buffers)
        surface = _compare_surface(alpha, view, weights, buffers)
        ground = _compare_ground(alpha, view, weights, buffers)
        d_sky = scratch.sky(sky_faces.shape[1]).gradient(buffers.d_rgb, alpha, buffers)
    total = (1 - weights.d_ssim) * l1 + weights.d_ssim * (1 - ssim) / 2
    total += weights.depth * depth + weights.surface * surface + weights.sky * sky
    total += weights.ground * ground
    return ViewLoss(
        total=total,
        l1=l1,
        ssim=ssim,
        depth=depth,
        sky=sky,
        d_rgb=buffers.d_rgb,
        d_alpha=buffers.d_alpha,
        d_expected_depth=buffers.d_expected_depth,
        d_color_map=d_color_map,
        d_sky=d_sky,
        surface=surface,
    )


def _compare(
    rgb: np.ndarray,
    alpha: np.ndarray,
    view: RecordedView,
    color_map: np.ndarray,
    weights: LossWeights,
    buffers: ImageBuffers,
) -> tuple[float, float, float, np.ndarray]:
    """Return L1, SSIM, alpha in the sky, and the colour map's gradient.

    The other gradients are written into the buffers.
    """
    size = buffers.size
    num_pixels = size[0] * size[1]
    sky = buffers.sky_colors.reshape(-1)
    flat_map = color_map.reshape(-1)
    recorded = _writeable(view.rgb).reshape(-1)
    weight = _writeable(view.weight).reshape(-1)
    is_sky = _writeable(view.sky).reshape(-1)
    pairs = buffers.pairs
    slopes = buffers.slopes
    weight_plane = buffers.weights
    kernels.compare(
        rgb.reshape(-1),
        alpha.reshape(-1),
        sky,
        flat_map,
        recorded,
        weight,
        is_sky,
        size,
        (buffers.composite, pairs, weight_plane, buffers.sums.reshape(-1), buffers.alpha_in_sky),
    )
    error_sum, weight_sum = buffers.sums.sum(axis=(0, 2), dtype=np.float64).tolist()
    alpha_in_sky = float(buffers.alpha_in_sky.sum())
    num_values = 3 * weight_sum
    ssim = 1.0
    ssim_factor = 0.0
    if num_values > 0 and weights.d_ssim != 0:
        kernels.compare_windows(pairs, weight_plane, size, slopes, buffers.ssim_sums.reshape(-1))
        ssim = float(buffers.ssim_sums.sum(dtype=np.float64)) / num_values
        ssim_factor = -weights.d_ssim / 2 / num_values
    value_weight = 1 / num_values if num_values > 0 else 0.0
    factors = ((1 - weights.d_ssim) * value_weight, ssim_factor, weights.sky / num_pixels)
    kernels.differentiate(
        sky,
        flat_map,
        is_sky,
        buffers.composite,
        pairs,
        slopes,
        weight_plane,
        size,
        np.array(factors, np.float32),
        buffers.d_rgb.reshape(-1),
        buffers.d_alpha.reshape(-1),
        buffers.map_sums.reshape(-1),
    )
    d_color_map = buffers.map_sums.sum(axis=(0, 3), dtype=np.float64)
    return error_sum * value_weight, ssim, alpha_in_sky / num_pixels, d_color_map


def _compare_surface(
    alpha: np.ndarray, view: RecordedView, weights: LossWeights, buffers: ImageBuffers
) -> float:
    """Return the mean 1 - alpha at depth priors; add its gradient to the buffers."""
    weight_sum = float(view.depth_weight.sum(dtype=np.float64))
    if weight_sum <= 0 or weights.surface == 0:
        return 0.0
    pixels = view.depth_pixels  # without repetitions
    gradient = view.depth_weight * np.float32(weights.surface / weight_sum)
    buffers.d_alpha.reshape(-1)[pixels] -= gradient
    transmittance = (1 - alpha.reshape(-1)[pixels]) * view.depth_weight
    return float(transmittance.sum(dtype=np.float64)) / weight_sum


def _compare_ground(
    alpha: np.ndarray, view: RecordedView, weights: LossWeights, buffers: ImageBuffers
) -> float:
    """Return the mean over the image of 1 - alpha below the horizon, without the sky.

    Its gradient is added to the buffers.
    """
    camera = view.camera
    right, down, ahead = camera.world_from_camera[2, :3].tolist()  # z of the camera's axes
    column = (np.arange(camera.width) + 0.5 - camera.cx) * (right / camera.fx)
    row = (np.arange(camera.height) + 0.5 - camera.cy) * (down / camera.fy) + ahead
    is_ground = (column[None] < -row[:, None]) & ~view.sky
    buffers.d_alpha -= is_ground * np.float32(weights.ground / alpha.size)
    return float(is_ground.sum() - alpha[is_ground].sum(dtype=np.float64)) / alpha.size


def _compare_depth(
    expected_depth: np.ndarray | None,
    alpha: np.ndarray,
    view: RecordedView,
    weights: LossWeights,
    buffers: ImageBuffers,
) -> float:
    """Return the mean |1/ED - 1/z| in 1/m; write its gradient into the buffers."""
    buffers.d_expected_depth.fill(0)
    weight_sum = float(view.depth_weight.sum(dtype=np.float64))
    if expected_depth is None or weight_sum <= 0 or weights.depth == 0:
        return 0.0
    sums = np.empty(-(-len(view.depth_pixels) // kernels.CHUNK))
    kernels.compare_depth(
        expected_depth.reshape(-1),
        alpha.reshape(-1),
        _writeable(view.depth_pixels),
        _writeable(view.depth_m),
        _writeable(view.depth_weight),
        np.float32(weights.depth / weight_sum),
        np.float32(MIN_ALPHA),
        buffers.d_expected_depth.reshape(-1),
        sums,
    )
    if sums.min() < 0:
        raise ValueError(
            f"view of camera {view.camera.name!r}: depth_pixels must be increasing indices from 0 "
            f"to {expected_depth.size - 1}, and depth_weight >= 0; got pixels from "
            f"{view.depth_pixels.min()} to {view.depth_pixels.max()}, weights from "
            f"{view.depth_weight.min()}"
        )
    return float(sums.sum()) / weight_sum


def _checked_array(
    name: str, value: np.ndarray, shape: tuple[int, ...], camera: Camera
) -> np.ndarray:
    """Check an array's shape and type."""
    if value.shape != shape or value.dtype != np.float32:
        raise ValueError(
            f"{name} of camera {camera.name!r} must be float32 {list(shape)}; "
            f"got {value.dtype} {list(value.shape)}"
        )
    return _writeable(value)


def _writeable(value: np.ndarray) -> np.ndarray:
    """Return the array, or a copy if it is read-only: numba would compile anew for that."""
    value = np.ascontiguousarray(value)
    return value if value.flags.writeable else value.copy()


# ---- The sky that a fit starts from, as a cube map -----------------------------------------------

_FACE_SIZE = 512  # texels along a cube edge where the starting sky is no cube map
# Sine of the elevation below which nothing is sky, even where the road falls.
_MIN_SKY_SINE = -0.05
# Sine of the elevation up to which texels give the horizon's colour.
_MAX_HAZE_SINE = 0.15


def starting_sky(sky: Sky) -> np.ndarray:
    """Return a copy of a cube map, or any other sky sampled into one, float32 [6, R, R, 3]."""
    if isinstance(sky, CubemapSky):
        return sky.faces.float().numpy().copy()
    directions = directions_of_cubemap(_FACE_SIZE).float()
    return np.ascontiguousarray(sky.sample(directions).float().numpy())


def paint_below_horizon(faces: np.ndarray) -> np.ndarray:
    """Paint texels below the horizon in its mean colour; return the texels of sky, bool [6 R R].

    Texels below the horizon are not learnt: a hole in the road must look wrong, and not like road
    infinitely far away, which weather would uncover.
    """
    flat = faces.reshape(-1, 3)
    z = directions_of_cubemap(faces.shape[1]).reshape(-1, 3)
    z = torch.nn.functional.normalize(z, dim=1)[:, 2].numpy()
    is_haze = (z >= 0) & (z < _MAX_HAZE_SINE)
    flat[z < _MIN_SKY_SINE] = flat[is_haze if is_haze.any() else z >= 0].mean(0, dtype=np.float64)
    return z >= _MIN_SKY_SINE
