"""Depth priors from the LiDAR sweep of an image's own frame."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from adapters.lidar.depth import SparseDepth, depth_seen, read_returns
from adapters.recorded.byte_cache import ByteCache
from adapters.recorded.depth_kernels import hidden_returns
from adapters.recorded.prior_pixels import PriorPixels
from augment.cameras import Camera
from augment.reconstruct.view import ViewKey
from augment.render.threads import kernel_threads
from augment.scene import Scene

# A return is clearly behind another from this ratio of depths and this many metres more.
_BEHIND_RATIO, _BEHIND_M = 1.05, 0.5
_NEIGHBOURS = 16  # returns around one that say whether it is surrounded
_WIDEST_PART = 0.02  # of the image's width: what is further away says nothing


class LidarPriors:
    """What the sweeps say of every view. A sweep is read once for all cameras of its frame."""

    def __init__(
        self,
        scene: Scene,
        cameras: Mapping[ViewKey, Camera],
        *,
        without_semantic: Collection[int],
        cache_bytes: int,
    ) -> None:
        """cameras: every view that may be asked for, at the training resolution."""
        self._scene = scene
        self._without = tuple(without_semantic)
        self._frames: dict[int, dict[ViewKey, Camera]] = {}
        for key, camera in cameras.items():
            self._frames.setdefault(key.frame, {})[key] = camera
        self._cache: ByteCache[PriorPixels] = ByteCache(cache_bytes)

    def load(self, key: ViewKey) -> PriorPixels:
        """Empty where the frame has no sweep."""
        found = self._cache.get(key)
        if found is not None:
            return found
        returns = read_returns(self._scene, key.frame, without_semantic=self._without)
        wanted = PriorPixels.empty()
        for other, camera in self._frames[key.frame].items():
            prior = PriorPixels.empty()
            if returns is not None:
                seen = depth_seen(returns, camera)
                prior = _as_prior(seen, visible(seen, camera), camera)
            self._cache.put(other, prior, prior.nbytes)
            if other == key:
                wanted = prior
        return wanted


def visible(seen: SparseDepth, camera: Camera) -> np.ndarray:
    """Which returns the camera sees too, bool [M].

    The LiDAR stands elsewhere and looks past objects that hide what is behind them from the camera.
    A return counts as hidden if clearly nearer ones are among its neighbours on three sides. Those
    hidden just behind an edge are not found.
    """
    if len(seen) == 0:
        return np.zeros(0, np.bool_)
    pixels = seen.uv[:, 1] * np.int32(camera.width) + seen.uv[:, 0]
    grid = np.zeros((camera.height, camera.width), np.float32)
    grid.reshape(-1)[pixels] = seen.depth_m
    with kernel_threads():
        hidden = hidden_returns(
            pixels, seen.depth_m, grid, _NEIGHBOURS, max(2, round(_WIDEST_PART * camera.width)),
            np.float32(_BEHIND_RATIO), np.float32(_BEHIND_M),
        )  # fmt: skip
    return ~hidden


def _as_prior(seen: SparseDepth, keep: np.ndarray, camera: Camera) -> PriorPixels:
    pixels = seen.uv[keep, 1] * np.int32(camera.width) + seen.uv[keep, 0]
    return PriorPixels(pixels, seen.depth_m[keep], np.ones(len(pixels), np.float32))
