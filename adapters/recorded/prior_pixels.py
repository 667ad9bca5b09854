"""Depth at some pixels of one image: the common form of all depth priors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from augment.cameras import Camera


@dataclass(frozen=True, eq=False)
class PriorPixels:
    """pixels: int32 [M], flat indices, increasing. depth_m: float32 [M]. weight: float32 [M]."""

    pixels: np.ndarray
    depth_m: np.ndarray
    weight: np.ndarray

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def nbytes(self) -> int:
        return self.pixels.nbytes + self.depth_m.nbytes + self.weight.nbytes

    @staticmethod
    def empty() -> PriorPixels:
        return PriorPixels(np.zeros(0, np.int32), np.zeros(0, np.float32), np.zeros(0, np.float32))

    @staticmethod
    def of(pixels: np.ndarray, depth_m: np.ndarray) -> PriorPixels:
        """Of weight 1. Pixels come in any order, some of them several times: the nearest depth of
        each remains."""
        order = np.lexsort((depth_m, pixels))
        first = np.ones(len(order), np.bool_)
        first[1:] = np.diff(pixels[order]) > 0
        chosen = order[first]
        return PriorPixels(
            pixels[chosen].astype(np.int32),
            depth_m[chosen].astype(np.float32),
            np.ones(len(chosen), np.float32),
        )

    def select(self, keep: np.ndarray) -> PriorPixels:
        return PriorPixels(self.pixels[keep], self.depth_m[keep], self.weight[keep])

    def weighing(self, weight: float) -> PriorPixels:
        """The same with another weight."""
        return PriorPixels(self.pixels, self.depth_m, np.full(len(self), weight, np.float32))

    def image(self, camera: Camera) -> np.ndarray:
        """float32 [H, W], 0 where nothing is known."""
        out = np.zeros(camera.height * camera.width, np.float32)
        out[self.pixels] = self.depth_m
        return out.reshape(camera.height, camera.width)


def join_priors(priors: Sequence[PriorPixels]) -> PriorPixels:
    """All of them; where several know a pixel, the first in the sequence is believed."""
    priors = [prior for prior in priors if len(prior)]
    if not priors:
        return PriorPixels.empty()
    if len(priors) == 1:
        return priors[0]
    pixels = np.concatenate([prior.pixels for prior in priors])
    _, first = np.unique(pixels, return_index=True)  # the first occurrence, in order of pixels
    return PriorPixels(
        pixels[first],
        np.concatenate([prior.depth_m for prior in priors])[first],
        np.concatenate([prior.weight for prior in priors])[first],
    )
