"""Depth priors of every view from whatever is there: LiDAR sweeps, and folders of depth maps."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from adapters.lidar.depth import read_returns
from adapters.pandaset.labels import PandaSetLabels
from adapters.recorded.byte_cache import ByteCache
from adapters.recorded.depth_maps import find_maps, find_sparse
from adapters.recorded.lidar_priors import LidarPriors
from adapters.recorded.map_priors import beside, metric_prior, relative_prior, sparse_prior
from adapters.recorded.prior_pixels import PriorPixels, join_priors
from augment.cameras import Camera
from augment.errors import AdapterError
from augment.reconstruct.view import ViewKey
from augment.scene import Scene

logger = logging.getLogger(__name__)

# Depth of a view at its training camera, float32 [H, W] metres, 0 where unknown.
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
        reference: ReferenceDepth | None = None,
    ) -> None:
        """cameras: every view, at the training resolution. reference: distances that relative
        maps are brought to metres by where the frame has no LiDAR."""
        self.problems: list[str] = []
        self._options, self._cameras, self._reference = options, cameras, reference
        self._lidar: LidarPriors | None = None
        if options.lidar and has_sweeps(scene, cameras):
            self._lidar = LidarPriors(
                scene,
                cameras,
                without_semantic=no_surface_classes(scene),
                cache_bytes=cache_bytes // 2,
            )
        self._maps = _find_all(scene, cameras, options, self.problems)
        self._cache: ByteCache[PriorPixels] = ByteCache(cache_bytes - cache_bytes // 2)
        if not self.kinds:
            self.problems.append(
                "no depth priors: the scene has no LiDAR sweeps and no depth maps were found, so "
                "distances are learnt from the images alone"
            )

    @property
    def kinds(self) -> tuple[str, ...]:
        """Which priors there are: lidar, sparse, metric, relative."""
        found = tuple(kind for kind, maps in self._maps.items() if maps)
        return found if self._lidar is None else ("lidar", *found)

    def lidar(self, key: ViewKey) -> PriorPixels:
        """What the sweep of the view's frame says."""
        return PriorPixels.empty() if self._lidar is None else self._lidar.load(key)

    def load(self, key: ViewKey, sky: np.ndarray) -> PriorPixels:
        """All that is known of the view. sky: bool [H, W], where dense maps are not believed."""
        if not any(self._maps.values()):
            return self.lidar(key)
        found = self._cache.get(key)
        if found is None:
            found = self._combine(key, sky)
            self._cache.put(key, found, found.nbytes)
        return found

    def _combine(self, key: ViewKey, sky: np.ndarray) -> PriorPixels:
        camera, options = self._cameras[key], self._options
        priors = [self.lidar(key)]
        for kind in ("sparse", "metric"):
            priors.append(self._read(kind, key, sky))
        known = join_priors(priors)
        if key in self._maps["relative"]:
            path = self._maps["relative"][key]
            try:
                reference = known.image(camera)
                if len(known) == 0 and self._reference is not None:
                    reference = self._reference(key, camera)
                relative = relative_prior(path, camera, reference, sky, options.grid_px)
            except AdapterError as error:
                self._left_out(key, error)
            else:
                weighed = relative.weighing(options.relative_weight)
                known = join_priors([known, beside(weighed, known, camera, options.grid_px)])
        return known

    def _read(self, kind: str, key: ViewKey, sky: np.ndarray) -> PriorPixels:
        path = self._maps[kind].get(key)
        if path is None:
            return PriorPixels.empty()
        camera = self._cameras[key]
        try:
            if kind == "sparse":
                return sparse_prior(path, camera)
            return metric_prior(path, camera, sky, self._options.grid_px)
        except AdapterError as error:
            self._left_out(key, error)
            return PriorPixels.empty()

    def _left_out(self, key: ViewKey, error: AdapterError) -> None:
        sentence = f"camera {key.camera}, frame {key.frame}: {error}; its depth is left out"
        logger.warning("%s", sentence)
        if sentence not in self.problems:
            self.problems.append(sentence)


def _find_all(
    scene: Scene,
    cameras: Mapping[ViewKey, Camera],
    options: DepthPriors,
    problems: list[str],
) -> dict[str, dict[ViewKey, Path]]:
    stems = {key: Path(scene.frame(key.frame).image_paths[key.camera]).stem for key in cameras}
    folders = {
        "sparse": options.sparse_dir,
        "metric": options.metric_dir,
        "relative": options.relative_dir,
    }
    out: dict[str, dict[ViewKey, Path]] = {}
    for kind, folder in folders.items():
        if folder is None:
            out[kind] = {}
            continue
        if kind == "sparse":
            out[kind] = find_sparse(folder, cameras, scene.camera_names)
        elif kind == "metric":
            out[kind] = find_maps(folder, cameras, {}, {".png"})
        else:
            out[kind] = find_maps(folder, cameras, stems, {".npy", ".png"})
        missing = [key for key in cameras if key not in out[kind]]
        if missing:
            problems.append(
                f"{folder} holds no {kind} depth for {len(missing)} of {len(cameras)} images, "
                f"first camera {missing[0].camera}, frame {missing[0].frame}"
            )
    return out


def has_sweeps(scene: Scene, keys: Mapping[ViewKey, Camera]) -> bool:
    """Whether any of the views' frames has a LiDAR sweep."""
    if scene.labels is None:
        return False
    frames = dict.fromkeys(key.frame for key in keys)
    return any(read_returns(scene, frame) is not None for frame in frames)


def no_surface_classes(scene: Scene) -> tuple[int, ...]:
    """The dataset's class numbers of returns that no surface made, such as mirror images."""
    return scene.labels.no_surface_classes if isinstance(scene.labels, PandaSetLabels) else ()
