"""Depth priors of every view from whatever is there: LiDAR sweeps, and folders of depth maps."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from adapters.lidar.depth import read_returns
from adapters.pandaset.labels import PandaSetLabels
from adapters.recorded.lidar_priors import LidarPriors
from adapters.recorded.prior_pixels import PriorPixels, join_priors
from augment.cameras import Camera
from augment.reconstruct.view import ViewKey
from augment.scene import Scene

logger = logging.getLogger(__name__)

ReferenceDepth = Callable[[ViewKey, Camera], np.ndarray]


@dataclass(frozen=True)
class DepthPriors:
    """Which priors to use. Where several know a pixel, the first of this order is believed.

    lidar: the scene's sweeps. sparse_dir: Street Gaussians' lidar_depth folder. metric_dir: dense
    depth in metres, DIR/<camera>/<frame>.png of uint16 metres x 256, 0 where unknown, as `climategs
    render` writes. relative_dir: dense inverse depth up to scale and shift, as monocular networks
    give, DIR/<camera>/<frame>.npy or .png. grid_px: dense maps are used at every grid_px-th pixel
    of every grid_px-th row. relative_weight: how much those maps count beside LiDAR, which is 1.
    """

    lidar: bool = True
    sparse_dir: Path | None = None
    metric_dir: Path | None = None
    relative_dir: Path | None = None
    grid_px: int = 4
    relative_weight: float = 0.1

    def __post_init__(self) -> None:
        if self.grid_px < 1:
            raise ValueError(f"grid_px must be >= 1; got {self.grid_px}")
        if not 0 < self.relative_weight <= 1:
            raise ValueError(f"relative_weight must be > 0 and <= 1; got {self.relative_weight}")


class DepthSource:
    """The priors of all views, made when first asked for and remembered in a bounded memory."""

    def __init__(
        self,
        scene: Scene,
        cameras: Mapping[ViewKey, Camera],
        options: DepthPriors,
        *,
        cache_bytes: int,
    ) -> None:
        """cameras: every view, at the training resolution."""
        self.problems: list[str] = []
        self.kinds: list[str] = []
        self._lidar: LidarPriors | None = None
        if options.lidar and has_sweeps(scene, cameras):
            self.kinds.append("lidar")
            self._lidar = LidarPriors(
                scene,
                cameras,
                weight=1.0,
                without_semantic=no_surface_classes(scene),
                cache_bytes=cache_bytes,
            )
        if not self.kinds:
            self.problems.append(
                "no depth priors: the scene has no LiDAR sweeps and no folder of depth maps was "
                "given, so distances are learnt from the images alone"
            )

    def load(self, key: ViewKey) -> PriorPixels:
        priors = []
        if self._lidar is not None:
            priors.append(self._lidar.load(key))
        return join_priors(priors)


def has_sweeps(scene: Scene, keys: Mapping[ViewKey, Camera]) -> bool:
    """Whether any of the views' frames has a LiDAR sweep."""
    if scene.labels is None:
        return False
    frames = dict.fromkeys(key.frame for key in keys)
    return any(read_returns(scene, frame) is not None for frame in frames)


def no_surface_classes(scene: Scene) -> tuple[int, ...]:
    """The dataset's class numbers of returns that no surface made, such as mirror images."""
    return scene.labels.no_surface_classes if isinstance(scene.labels, PandaSetLabels) else ()
