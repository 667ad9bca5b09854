"""Buffers of the image loss that calls share, and the sums of the sky's gradient."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from augment.reconstruct import loss_kernels, sky_kernels


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
        lanes, pad = loss_kernels.LANES, loss_kernels.PAD
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
        self.parts = np.zeros((sky_kernels.PARTS, texels, 3), np.float32)
        self.touched = np.zeros((sky_kernels.PARTS, slots), np.uint8)
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
        sky_kernels.scatter_sky(
            d_rgb, alpha, image.texels, image.fractions, self.size, self.parts, self.touched
        )
        words = self.touched.view(np.uint64)
        count = sky_kernels.gather_sky(self.parts, self.touched, words, self.texels, self.grads)
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
