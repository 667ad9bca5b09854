"""Depth priors of every view from all available sources: LiDAR sweeps, and folders of depth
maps.

Faulty files raise AdapterErrors that name them; the view then has no prior from them. The caller is
`adapters.training_views.views`.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numba
import numpy as np

from adapters.lidar_scene.depth import DepthPixels, read_returns
from adapters.lidar_scene.depth_maps import (
    align,
    check_aspect,
    check_folder,
    find_maps,
    read_metric,
    read_relative,
)
from adapters.safe_pickle import read_array_dict
from augment.errors import AdapterError
from augment.memo import SceneMemo
from augment.reconstruct.view import ViewKey
from augment.render.cpu.jit import cached_njit
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera
from augment.scene.scene import Scene

logger = logging.getLogger(__name__)

_NUMBER = re.compile(r"\d{1,12}")
_SPARSE_NAME = re.compile(r"(\d{1,12})_(.+)")
_GRID_PX = 4  # dense maps are used at every such pixel of every such row
_RELATIVE_WEIGHT = 0.1  # of relative maps beside LiDAR, which is 1
_NEAREST_IN_FILE_M = 0.1  # values of a file that are larger are depths
_FURTHEST_IN_FILE_M = 1000.0  # values of a file that are smaller are depths
# A return is clearly behind another from this ratio of depths and this many metres more.
_BEHIND_RATIO = 1.05
_BEHIND_M = 0.5
_NEIGHBOURS = 16  # returns around one that say whether it is surrounded
_WIDEST_PART = 0.02  # of the image's width: what is further away says nothing
# Depth of a view at its training camera, float32 [H, W] metres, 0 where unknown.
ReferenceDepth = Callable[[ViewKey, Camera], np.ndarray]


def find_sparse(
    folder: Path, keys: Collection[ViewKey], camera_names: Sequence[str]
) -> dict[ViewKey, Path]:
    """Return the file DIR/<frame>_<camera>.npy of each view that has one.

    <camera> is a camera's name, or its number in the scene's order as Street Gaussians counts them.
    """
    check_folder(folder)
    requested = set(keys)
    paths: dict[ViewKey, Path] = {}
    for path in sorted(folder.glob("*.npy")):
        match = _SPARSE_NAME.fullmatch(path.stem)
        if match is None:
            continue
        name = match[2]
        if name not in camera_names and _NUMBER.fullmatch(name) and int(name) < len(camera_names):
            name = camera_names[int(name)]
        key = ViewKey(int(match[1]), name)
        if key in requested:
            paths[key] = path
    return paths


def read_sparse(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Street Gaussians' depth: mask bool [h, w] and the metres of its pixels, float32 [M]."""
    arrays = read_array_dict(path)
    mask = arrays.get("mask")
    value = arrays.get("value")
    if mask is None or value is None or mask.ndim != 2:
        raise AdapterError(
            f"{path} must hold 'mask' [height, width] and 'value'; it holds "
            f"{ {name: list(array.shape) for name, array in arrays.items()} }"
        )
    mask = mask.astype(np.bool_)
    if value.dtype.kind not in "fiu" or value.shape != (int(mask.sum()),):
        raise AdapterError(
            f"{path}: 'value' must hold a depth for each of the {int(mask.sum())} pixels of "
            f"'mask'; it is {value.dtype} {list(value.shape)}"
        )
    return mask, value.astype(np.float32)


def join_priors(priors: Sequence[DepthPixels]) -> DepthPixels:
    """Join one or more priors. If several have a pixel, the first in the sequence counts."""
    names = ("pixels", "depth_m", "weight")
    parts = [np.concatenate([getattr(prior, name) for prior in priors]) for name in names]
    _, first = np.unique(parts[0], return_index=True)  # the first occurrence, in order
    return DepthPixels(*parts).select(first)


def sparse_prior(path: Path, camera: Camera) -> DepthPixels:
    """Return Street Gaussians' depth, of a larger image, at the pixels on which it falls."""
    mask, value = read_sparse(path)
    check_aspect(path, mask.shape, camera)
    rows, columns = np.nonzero(mask)
    rows = (rows + 0.5) * camera.height / mask.shape[0]
    columns = (columns + 0.5) * camera.width / mask.shape[1]
    pixels = rows.astype(np.int64) * camera.width + columns.astype(np.int64)
    usable = (value > _NEAREST_IN_FILE_M) & (value < _FURTHEST_IN_FILE_M)  # NaN is neither
    return DepthPixels.of(pixels[usable], value[usable])


def metric_prior(path: Path, camera: Camera, sky: np.ndarray) -> DepthPixels:
    """Return a dense map in metres at the pixels of a grid, without zeros and sky."""
    depth = read_metric(path)
    check_aspect(path, depth.shape, camera)
    rows, columns = _grid(camera)
    # The nearest pixel: between a car and the wall behind it there is no surface.
    y = ((rows + 0.5) * depth.shape[0] / camera.height).astype(np.int64)
    x = ((columns + 0.5) * depth.shape[1] / camera.width).astype(np.int64)
    depth_m = depth[y, x]
    usable = (depth_m > _NEAREST_IN_FILE_M) & (depth_m < _FURTHEST_IN_FILE_M) & ~sky[rows, columns]
    return DepthPixels.of((rows * camera.width + columns)[usable], depth_m[usable])


def relative_prior(
    path: Path, camera: Camera, reference: np.ndarray, sky: np.ndarray
) -> DepthPixels:
    """Return a dense inverse depth map at the pixels of a grid, aligned to the reference depth.

    reference: [H, W], 0 where unknown.
    """
    relative = read_relative(path)
    check_aspect(path, relative.shape, camera)
    size = (camera.width, camera.height)
    is_smaller = relative.shape[0] <= camera.height
    interpolation = cv2.INTER_LINEAR if is_smaller else cv2.INTER_AREA
    relative = cv2.resize(relative, size, interpolation=interpolation)
    has_reference = reference > 0
    alignment = align(relative[has_reference], reference[has_reference])
    if alignment is None:
        raise AdapterError(
            f"{path} does not agree with the {int(has_reference.sum())} known distances: there "
            f"must be some, and larger values must be nearer (inverse depth, not depth)"
        )
    rows, columns = _grid(camera)
    depth_m = alignment.depth_m(relative[rows, columns])
    usable = np.isfinite(depth_m) & ~sky[rows, columns]
    pixels = (rows * camera.width + columns)[usable]
    return DepthPixels.of(pixels, depth_m[usable], _RELATIVE_WEIGHT)


def beside(dense: DepthPixels, trusted_prior: DepthPixels, camera: Camera) -> DepthPixels:
    """Return the pixels of the dense prior in whose grid cell the trusted prior has no pixel."""
    if len(trusted_prior) == 0:
        return dense
    columns = -(-camera.width // _GRID_PX)

    def cells(prior: DepthPixels) -> np.ndarray:
        row = prior.pixels // camera.width
        column = prior.pixels % camera.width
        return row // _GRID_PX * columns + column // _GRID_PX

    return dense.select(~np.isin(cells(dense), cells(trusted_prior)))


def _grid(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return rows [R, 1] and columns [1, C] in the middles of the grid's cells."""
    rows = np.arange(min(_GRID_PX // 2, camera.height - 1), camera.height, _GRID_PX)
    columns = np.arange(min(_GRID_PX // 2, camera.width - 1), camera.width, _GRID_PX)
    return rows[:, None], columns[None]


@cached_njit(parallel=True, nogil=True, error_model="numpy")
def hidden_returns(
    pixels, depth_m, grid, enough, most_radius, ratio, margin_m
):  # pragma: no cover - compiled
    """Return True for returns that lie behind nearer ones on all sides, bool [M].

    The square window around a return grows until it holds `enough` others or has the radius
    `most_radius` (pixels). The return is hidden if at least three of the window's four quadrants
    hold a return nearer than z / ratio - margin_m: then a surface passes in front of it, not just
    an edge beside it.

    Args:
        pixels: int32 [M], flat indices into grid.
        depth_m: float32 [M], depths of the returns.
        grid: float32 [H, W], depth at the pixels, 0 elsewhere.
        enough: number of others that ends the growth.
        most_radius: largest radius, pixels.
        ratio, margin_m: see above.
    """
    height, width = grid.shape
    out = np.zeros(len(pixels), np.bool_)
    for i in numba.prange(len(pixels)):
        row = pixels[i] // width
        column = pixels[i] % width
        limit = depth_m[i] / ratio - margin_m
        quadrants = 0  # one bit for each that holds a nearer return
        count = 0
        for radius in range(1, most_radius + 1):
            for dy in range(-radius, radius + 1):
                y = row + dy
                if y < 0 or y >= height:
                    continue
                # Only the window's border is new: whole rows at its ends, else two pixels.
                step = 1 if dy == -radius or dy == radius else 2 * radius
                for dx in range(-radius, radius + 1, step):
                    x = column + dx
                    if x < 0 or x >= width or grid[y, x] == 0:
                        continue
                    count += 1
                    if grid[y, x] >= limit:
                        continue
                    # What lies straight above or beside counts for both quadrants it touches.
                    if dy <= 0 and dx <= 0:
                        quadrants |= 1
                    if dy <= 0 and dx >= 0:
                        quadrants |= 2
                    if dy >= 0 and dx <= 0:
                        quadrants |= 4
                    if dy >= 0 and dx >= 0:
                        quadrants |= 8
            if count >= enough:
                break
        sides = (quadrants & 1) + (quadrants >> 1 & 1) + (quadrants >> 2 & 1) + (quadrants >> 3 & 1)
        out[i] = sides >= 3
    return out


def is_visible_return(returns: DepthPixels, camera: Camera) -> np.ndarray:
    """Return True for the LiDAR's returns that the camera sees too, bool [M].

    A return is hidden if clearly nearer ones lie among its neighbours on three sides. One that is
    hidden just behind an edge counts as visible.
    """
    with kernel_threads():
        is_hidden = hidden_returns(
            returns.pixels,
            returns.depth_m,
            returns.image(camera),
            _NEIGHBOURS,
            max(2, round(_WIDEST_PART * camera.width)),
            np.float32(_BEHIND_RATIO),
            np.float32(_BEHIND_M),
        )
    return ~is_hidden


@dataclass(frozen=True)
class DepthPriors:
    """Sources of depth priors. If several have a pixel, the first in the fields' order counts.

    Attributes:
        lidar: True for the scene's sweeps.
        sparse_dir: Street Gaussians' lidar_depth folder.
        metric_dir: dense depth in metres, DIR/<camera>/<frame>.png of uint16 metres x 256, 0 where
            unknown, as `climategs render` writes.
        relative_dir: dense inverse depth up to scale and shift, as monocular networks give,
            DIR/<camera>/<frame>.npy or .png.
    """

    lidar: bool = True
    sparse_dir: Path | None = None
    metric_dir: Path | None = None
    relative_dir: Path | None = None


class DepthSource:
    """The priors of all views, made on first use and cached in a bounded memory."""

    def __init__(
        self,
        scene: Scene,
        cameras: Mapping[ViewKey, Camera],
        options: DepthPriors,
        *,
        cache_bytes: int,
        reference: ReferenceDepth | None = None,
    ) -> None:
        """Prepare the sources.

        Args:
            scene: the scene.
            cameras: every view, at the training resolution.
            options: the sources to use.
            cache_bytes: memory for priors.
            reference: distances by which relative maps are brought to metres if the frame has no
                LiDAR.
        """
        self.problems: list[str] = []
        self._scene = scene
        self._cameras = cameras
        self._reference = reference
        self._has_sweeps = options.lidar and _has_sweeps(scene, cameras)
        self._maps = _find_all(scene, cameras, options, self.problems)
        self._memo = SceneMemo(cache_bytes)
        if not (self._has_sweeps or any(self._maps.values())):
            self.problems.append(
                "no depth priors: the scene has no LiDAR sweeps and no depth maps were found, so "
                "distances are learnt from the images alone"
            )

    def lidar(self, key: ViewKey) -> DepthPixels:
        """Return the depth of the LiDAR's returns that the view shows.

        A frame's sweep is read once for all of its cameras."""
        return self._memo.get(key.frame, lambda: self._read_frame(key.frame))[key.camera]

    def _read_frame(self, frame: int) -> dict[str, DepthPixels]:
        cameras = {
            key.camera: camera for key, camera in self._cameras.items() if key.frame == frame
        }
        returns = read_returns(self._scene, frame, of_surfaces=True) if self._has_sweeps else None
        if returns is None:
            no_pixels = DepthPixels.of(np.zeros(0, np.int32), np.zeros(0, np.float32))
            return dict.fromkeys(cameras, no_pixels)
        pixels_by_camera = {name: returns.seen_by(camera) for name, camera in cameras.items()}
        return {
            name: pixels_by_camera[name].select(
                is_visible_return(pixels_by_camera[name], cameras[name])
            )
            for name in cameras
        }

    def load(self, key: ViewKey, sky: np.ndarray) -> DepthPixels:
        """Return the depth prior of the view, joined from LiDAR and depth maps.

        sky: bool [H, W], True where values of dense maps are left out."""
        if not any(self._maps.values()):
            return self.lidar(key)
        return self._memo.get(key, lambda: self._combine(key, sky))

    def _combine(self, key: ViewKey, sky: np.ndarray) -> DepthPixels:
        camera = self._cameras[key]
        prior = self.lidar(key)
        for kind, maps in self._maps.items():  # in the order in which they are believed
            path = maps.get(key)
            if path is None:
                continue
            try:
                if kind == "sparse":
                    map_prior = sparse_prior(path, camera)
                elif kind == "metric":
                    map_prior = metric_prior(path, camera, sky)
                else:
                    reference = prior.image(camera)
                    if len(prior) == 0 and self._reference is not None:
                        reference = self._reference(key, camera)
                    map_prior = beside(relative_prior(path, camera, reference, sky), prior, camera)
            except AdapterError as error:
                sentence = f"camera {key.camera}, frame {key.frame}: {error}; its depth is left out"
                logger.warning("%s", sentence)
                if sentence not in self.problems:
                    self.problems.append(sentence)
            else:
                prior = join_priors([prior, map_prior])
        return prior


def _find_all(
    scene: Scene, cameras: Mapping[ViewKey, Camera], options: DepthPriors, problems: list[str]
) -> dict[str, dict[ViewKey, Path]]:
    stems = {key: Path(scene.frame(key.frame).image_paths[key.camera]).stem for key in cameras}
    finds = {
        "sparse": (options.sparse_dir, lambda d: find_sparse(d, cameras, scene.camera_names)),
        "metric": (options.metric_dir, lambda d: find_maps(d, cameras, {}, {".png"})),
        "relative": (
            options.relative_dir,
            lambda d: find_maps(d, cameras, stems, {".npy", ".png"}),
        ),
    }
    out: dict[str, dict[ViewKey, Path]] = {}
    for kind, (folder, find) in finds.items():
        out[kind] = {} if folder is None else find(folder)
        missing = [key for key in cameras if key not in out[kind]]
        if missing and folder is not None:
            problems.append(
                f"{folder} holds no {kind} depth for {len(missing)} of {len(cameras)} images, "
                f"first camera {missing[0].camera}, frame {missing[0].frame}"
            )
    return out


def _has_sweeps(scene: Scene, keys: Mapping[ViewKey, Camera]) -> bool:
    """Return True if any of the views' frames has a LiDAR sweep."""
    if scene.labels is None:
        return False
    frames = dict.fromkeys(key.frame for key in keys)
    return any(read_returns(scene, frame) is not None for frame in frames)
