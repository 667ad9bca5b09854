"""The loss of one view, from the rasteriser's buffers to their gradients.

    picture = color_map(rgb + (1 - alpha) sky(direction))
    total = (1 - d_ssim) L1 + d_ssim (1 - SSIM) / 2 + depth |1/ED - 1/z| + surface (1 - alpha)
            + sky alpha + ground (1 - alpha)

each a weighted mean as `LossWeights` says. A test holds it to its torch definition. SSIM is that of
3D Gaussian splatting (Kerbl et al. 2023): windows of 11 x 11 pixels, a Gaussian of sigma 1.5, zeros
beyond the image, per channel, of pictures in [0, 1] that are not clamped.

Departures, all shared by the reference:
- Where a pixel's weight is 0, both pictures hold the prediction there, as a constant: it neither
  disturbs the windows of its neighbours nor gets a gradient from them. (Depth and sky have masks
  of their own and do not ask for the weight.)
- The sky is not looked up where 1 - alpha < MIN_SKY; it counts as black, and has no gradient.
- A depth prior counts only where alpha > MIN_ALPHA, for the expected depth of next to nothing is
  noise; it gives no gradient elsewhere, but the mean is always over all of the view's priors, so
  that uncovered pixels do not make the others count more.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch

from augment.cameras import Camera
from augment.reconstruct import kernels
from augment.reconstruct.config import LossWeights
from augment.reconstruct.view import RecordedView
from augment.render.threads import kernel_threads
from augment.sky import CubemapSky, Sky, directions_of_cubemap

MIN_SKY = 1e-3  # less of the sky shows at most a quarter of an 8-bit step
MIN_ALPHA = 0.05


@dataclass(frozen=True, eq=False)
class SkyGradient:
    """Gradient of the texels that were seen. texels: int32 [T], increasing indices into
    faces.reshape(-1, 3); grads: float32 [T, 3].
    """

    texels: np.ndarray
    grads: np.ndarray


class ImageBuffers:
    """What depends on the image's size; see the kernels for each buffer's meaning."""

    def __init__(self, height: int, width: int) -> None:
        lanes, pad = kernels.LANES, kernels.PAD
        stride = -(-width // lanes) * lanes
        padded = (height + 2 * pad) * stride
        self.size = (height, width, stride)
        self.sky_colors = np.zeros((3, height, stride), np.float32)
        self.texels = np.empty((height, width), np.int32)
        self.fractions = np.empty((2, height, width), np.float32)
        self.pairs = np.zeros(6 * padded, np.float32)  # their margins stay zero
        self.slopes = np.zeros(9 * padded, np.float32)
        self.weights = np.empty(height * stride, np.float32)
        self.sums = np.empty((height, 2, lanes), np.float32)
        self.covered = np.empty(height)
        self.ssim_sums = np.empty((height, lanes), np.float32)
        self.map_sums = np.empty((height, 3, 4, lanes), np.float32)
        self.behind = np.empty(3 * height * stride, np.float32)
        self.d_rgb = np.empty((height, width, 3), np.float32)
        self.d_alpha = np.empty((height, width), np.float32)
        self.d_expected_depth = np.empty((height, width), np.float32)


class SkyBuffers:
    """Sums over a cube map of faces `size` wide, zero between two calls."""

    def __init__(self, size: int) -> None:
        self.size = size
        texels = 6 * size * size
        slots = -(-texels // 8) * 8
        self.parts = np.zeros((kernels.PARTS, texels, 3), np.float32)
        self.touched = np.zeros((kernels.PARTS, slots), np.uint8)
        self.texels = np.empty(texels, np.int32)
        self.grads = np.empty((texels, 3), np.float32)
        self.is_clean = True

    def gradient(
        self, d_rgb: np.ndarray, alpha: np.ndarray, image: ImageBuffers
    ) -> SkyGradient | None:
        if not self.is_clean:  # a call was interrupted between the two kernels
            self.parts.fill(0)
            self.touched.fill(0)
        self.is_clean = False
        kernels.scatter_sky(
            d_rgb, alpha, image.texels, image.fractions, self.size, self.parts, self.touched
        )
        words = self.touched.view(np.uint64)
        count = kernels.gather_sky(self.parts, self.touched, words, self.texels, self.grads)
        self.is_clean = True
        return SkyGradient(self.texels[:count], self.grads[:count]) if count else None


@dataclass(eq=False)
class LossScratch:
    """Buffers that calls of `view_loss` share, to allocate nothing. Gradients returned by a call
    with it lie in it: they hold until the next call. Not for two threads at once.
    """

    _images: dict[tuple[int, int], ImageBuffers] = field(default_factory=dict)
    _skies: dict[int, SkyBuffers] = field(default_factory=dict)

    def image(self, height: int, width: int) -> ImageBuffers:
        key = (height, width)
        if key not in self._images:
            self._images[key] = ImageBuffers(height, width)
        return self._images[key]

    def sky(self, size: int) -> SkyBuffers:
        """Sums that are zero, whatever became of the call before."""
        if size not in self._skies:
            self._skies[size] = SkyBuffers(size)
        return self._skies[size]


IDENTITY_MAP = np.eye(3, 4, dtype=np.float32)


@dataclass(frozen=True, eq=False)
class ViewLoss:
    """A view's loss and its gradient.

    total: the weighted sum, what d_* are the derivatives of. l1: mean |picture - recorded| over
    weighted pixels; ssim: mean SSIM over them, 1 where there are none; depth: mean |1/ED - 1/z| in
    1/m; sky: mean over the image of alpha in the sky; surface: mean of 1 - alpha where there is a
    depth prior. d_rgb [H, W, 3], d_alpha, d_expected_depth
    [H, W]: float32. d_color_map: float64 [3, 4]. d_sky: None where no texel was seen.

    A view whose weights are all 0 has l1 0, ssim 1, and gradients only from depth and sky.
    """

    total: float
    l1: float
    ssim: float
    depth: float
    sky: float
    d_rgb: np.ndarray
    d_alpha: np.ndarray
    d_expected_depth: np.ndarray
    d_color_map: np.ndarray
    d_sky: SkyGradient | None
    surface: float = 0.0


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
    """The loss of a render of `view.camera` against the view, and its gradient.

    rgb [H, W, 3] without background, alpha [H, W], expected_depth [H, W] (m): as rasterised,
    float32; without expected_depth no depth prior counts. sky_faces: float32 [6, R, R, 3].
    color_map: float32 [3, 4]. scratch: buffers to reuse, which saves page faults by the megabyte;
    the gradients then hold until the next call. The same inputs give the same bits for any number
    of threads.

    Raises:
        ValueError: an array's shape or type is wrong, or depth_pixels are not increasing indices.
    """
    camera = view.camera
    size = (camera.height, camera.width)
    faces = sky_faces.shape[1] if sky_faces.ndim == 4 and sky_faces.shape[1] else 1
    rgb = _plain("rgb", rgb, (*size, 3), camera)
    alpha = _plain("alpha", alpha, size, camera)
    sky_faces = _plain("sky_faces", sky_faces, (6, faces, faces, 3), camera)
    color_map = _plain("color_map", color_map, (3, 4), camera)
    if expected_depth is not None:
        expected_depth = _plain("expected_depth", expected_depth, size, camera)
    scratch = scratch or LossScratch()
    buffers = scratch.image(camera.height, camera.width)
    with kernel_threads():
        rotation = camera.camera_from_world[:3, :3].numpy().T.astype(np.float32, order="C")
        intrinsics = np.array([1 / camera.fx, 1 / camera.fy, camera.cx, camera.cy], np.float32)
        seen = (buffers.sky_colors, buffers.texels, buffers.fractions)
        kernels.sample_sky(alpha, sky_faces, rotation, intrinsics, np.float32(MIN_SKY), *seen)
        l1, ssim, sky, d_color_map = _compare(rgb, alpha, view, color_map, weights, buffers)
        depth = _compare_depth(expected_depth, alpha, view, weights, buffers)
        surface = _compare_surface(alpha, view, weights, buffers)
        ground = _compare_ground(alpha, view, weights, buffers)
        d_sky = scratch.sky(sky_faces.shape[1]).gradient(buffers.d_rgb, alpha, buffers)
    total = (1 - weights.d_ssim) * l1 + weights.d_ssim * (1 - ssim) / 2
    total += weights.depth * depth + weights.surface * surface + weights.sky * sky
    total += weights.ground * ground
    return ViewLoss(
        total=total, l1=l1, ssim=ssim, depth=depth, sky=sky, d_rgb=buffers.d_rgb,
        d_alpha=buffers.d_alpha, d_expected_depth=buffers.d_expected_depth, d_color_map=d_color_map,
        d_sky=d_sky, surface=surface,
    )  # fmt: skip


def _compare(
    rgb: np.ndarray,
    alpha: np.ndarray,
    view: RecordedView,
    color_map: np.ndarray,
    weights: LossWeights,
    buffers: ImageBuffers,
) -> tuple[float, float, float, np.ndarray]:
    """L1, SSIM, alpha in the sky, and the colour map's gradient; the others go to the buffers."""
    size = buffers.size
    pixels = size[0] * size[1]
    sky, mapping = buffers.sky_colors.reshape(-1), color_map.reshape(-1)
    recorded = _writeable(view.rgb).reshape(-1)
    weight, is_sky = _writeable(view.weight).reshape(-1), _writeable(view.sky).reshape(-1)
    pairs, slopes, kept = buffers.pairs, buffers.slopes, buffers.weights
    kernels.compare(
        rgb.reshape(-1), alpha.reshape(-1), sky, mapping, recorded, weight, is_sky, size,
        (buffers.behind, pairs, kept, buffers.sums.reshape(-1), buffers.covered),
    )  # fmt: skip
    error_sum, weight_sum = buffers.sums.sum(axis=(0, 2), dtype=np.float64).tolist()
    covered = float(buffers.covered.sum())
    count = 3 * weight_sum
    ssim, ssim_factor = 1.0, 0.0
    if count > 0 and weights.d_ssim != 0:
        kernels.compare_windows(pairs, kept, size, slopes, buffers.ssim_sums.reshape(-1))
        ssim = float(buffers.ssim_sums.sum(dtype=np.float64)) / count
        ssim_factor = -weights.d_ssim / 2 / count
    per_weight = 1 / count if count > 0 else 0.0
    factors = ((1 - weights.d_ssim) * per_weight, ssim_factor, weights.sky / pixels)
    kernels.differentiate(
        sky, mapping, is_sky, buffers.behind, pairs, slopes, kept, size,
        np.array(factors, np.float32), buffers.d_rgb.reshape(-1), buffers.d_alpha.reshape(-1),
        buffers.map_sums.reshape(-1),
    )  # fmt: skip
    d_color_map = buffers.map_sums.sum(axis=(0, 3), dtype=np.float64)
    return error_sum * per_weight, ssim, covered / pixels, d_color_map


def _compare_surface(
    alpha: np.ndarray, view: RecordedView, weights: LossWeights, buffers: ImageBuffers
) -> float:
    """Mean 1 - alpha where a depth prior says that something is; its gradient to the buffers."""
    weight_sum = float(view.depth_weight.sum(dtype=np.float64))
    if weight_sum <= 0 or weights.surface == 0:
        return 0.0
    pixels = view.depth_pixels  # each once
    share = view.depth_weight * np.float32(weights.surface / weight_sum)
    buffers.d_alpha.reshape(-1)[pixels] -= share
    transmittance = (1 - alpha.reshape(-1)[pixels]) * view.depth_weight
    return float(transmittance.sum(dtype=np.float64)) / weight_sum


def _compare_ground(
    alpha: np.ndarray, view: RecordedView, weights: LossWeights, buffers: ImageBuffers
) -> float:
    """Mean over the image of 1 - alpha below the horizon, where no sky is; its gradient to the
    buffers.
    """
    camera = view.camera
    right, down, ahead = camera.world_from_camera[2, :3].tolist()  # heights of the camera's axes
    column = (np.arange(camera.width) + 0.5 - camera.cx) * (right / camera.fx)
    row = (np.arange(camera.height) + 0.5 - camera.cy) * (down / camera.fy) + ahead
    below = (column[None] < -row[:, None]) & ~view.sky
    buffers.d_alpha -= below * np.float32(weights.ground / alpha.size)
    return float(below.sum() - alpha[below].sum(dtype=np.float64)) / alpha.size


def _compare_depth(
    expected_depth: np.ndarray | None,
    alpha: np.ndarray,
    view: RecordedView,
    weights: LossWeights,
    buffers: ImageBuffers,
) -> float:
    """Mean |1/ED - 1/z| in 1/m; its gradient goes to the buffers."""
    buffers.d_expected_depth.fill(0)
    weight_sum = float(view.depth_weight.sum(dtype=np.float64))
    if expected_depth is None or weight_sum <= 0 or weights.depth == 0:
        return 0.0
    sums = np.empty(-(-len(view.depth_pixels) // kernels.CHUNK))
    kernels.compare_depth(
        expected_depth.reshape(-1), alpha.reshape(-1), _writeable(view.depth_pixels),
        _writeable(view.depth_m), _writeable(view.depth_weight),
        np.float32(weights.depth / weight_sum), np.float32(MIN_ALPHA),
        buffers.d_expected_depth.reshape(-1), sums,
    )  # fmt: skip
    if sums.min() < 0:
        raise ValueError(
            f"view of camera {view.camera.name!r}: depth_pixels must be increasing indices from 0 "
            f"to {expected_depth.size - 1}, and depth_weight >= 0; got pixels from "
            f"{view.depth_pixels.min()} to {view.depth_pixels.max()}, weights from "
            f"{view.depth_weight.min()}"
        )
    return float(sums.sum()) / weight_sum


def _plain(name: str, value: np.ndarray, shape: tuple[int, ...], camera: Camera) -> np.ndarray:
    if value.shape != shape or value.dtype != np.float32:
        raise ValueError(
            f"{name} of camera {camera.name!r} must be float32 {list(shape)}; "
            f"got {value.dtype} {list(value.shape)}"
        )
    return _writeable(value)


def _writeable(value: np.ndarray) -> np.ndarray:
    """The array, or a copy where it is read-only, which numba would compile everything anew for."""
    value = np.ascontiguousarray(value)
    return value if value.flags.writeable else value.copy()


# ---- The sky that a fit starts from, as a cube map, and what of it is sky at all -----------------

_SIZE = 512  # texels along a cube edge where the starting sky is no cube map
# Sines of elevations: what lies lower is no sky, also where the road falls; the horizon's colour.
_BELOW, _HAZE = -0.05, 0.15


def starting_sky(sky: Sky) -> np.ndarray:
    """float32 [6, R, R, 3]: a copy of a cube map, or any other sky sampled into one."""
    if isinstance(sky, CubemapSky):
        return sky.faces.float().numpy().copy()
    directions = directions_of_cubemap(_SIZE).float()
    return np.ascontiguousarray(sky.sample(directions).float().numpy())


def paint_below_horizon(faces: np.ndarray) -> np.ndarray:
    """Which texels are sky, bool [6 R R]; the others, below the horizon, get its mean colour.

    They are not learnt: a hole in the road must look wrong, not like road infinitely far away,
    which weather would uncover.
    """
    flat = faces.reshape(-1, 3)
    z = directions_of_cubemap(faces.shape[1]).reshape(-1, 3)
    z = torch.nn.functional.normalize(z, dim=1)[:, 2].numpy()
    horizon = (z >= 0) & (z < _HAZE)
    flat[z < _BELOW] = flat[horizon if horizon.any() else z >= 0].mean(0, dtype=np.float64)
    return z >= _BELOW
