"""Dense depth maps of a user, by any network: finding, reading, and alignment to known depths.

    metric:DIR      DIR/<camera>/<name>.png, uint16 metres x 256, 0 where unknown
    relative:DIR    DIR/<camera>/<name>.npy or .png, inverse depth up to scale and shift
    DIR             either; what agrees better with the LiDAR counts

<name> is that of the recorded image, or the frame's number. The callers are
`adapters.lidar_scene.beyond_beams` and `adapters.training_views.depth_priors`.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from adapters.plain_files import decode_image
from adapters.safe_pickle import read_array
from augment.errors import AdapterError
from augment.reconstruct.view import ViewKey
from augment.scene.cameras import Camera

METRIC_PER_M = 256.0  # levels per metre of 16-bit depth images
_ASPECT_TOLERANCE = 0.02  # maps are often rounded to a multiple of 14 or 32 pixels
_MIN_KNOWN = 30  # known distances that two numbers may be fitted to
_ROUNDS = 30  # of reweighted least squares
_MIN_SPREAD_PER_M = 1e-4  # residuals below this are as good as none
_MIN_CORRELATION = 0.5  # of relative values and inverse depths; a map below it is refused
_NEAREST_M = 0.5  # depth from which an aligned relative map is believed
_FURTHEST_M = 120.0  # depth up to which an aligned relative map is believed
_NUMBER = re.compile(r"\d{1,12}")


def find_maps(
    folder: Path, keys: Collection[ViewKey], image_stems: Mapping[ViewKey, str], suffixes: set[str]
) -> dict[ViewKey, Path]:
    """Return the depth map's path of each view that has one.

    A file is DIR/<camera>/<name>. Its name is that of the recorded image; where no file of the
    camera has such a name, it is the frame's number."""
    check_folder(folder)
    paths: dict[ViewKey, Path] = {}
    for camera in dict.fromkeys(key.camera for key in keys):
        camera_keys = [key for key in keys if key.camera == camera]
        files = sorted(p for p in (folder / camera).glob("*") if p.suffix.lower() in suffixes)
        path_by_stem = {path.stem: path for path in files}
        paths_by_name = {
            k: path_by_stem[image_stems[k]]
            for k in camera_keys
            if image_stems.get(k) in path_by_stem
        }
        path_by_number = {int(p.stem): p for p in files if _NUMBER.fullmatch(p.stem)}
        paths |= paths_by_name or {
            k: path_by_number[k.frame] for k in camera_keys if k.frame in path_by_number
        }
    return paths


def read_metric(path: Path) -> np.ndarray:
    """float32 [h, w] metres, 0 where unknown, from a 16-bit image of metres x 256."""
    image = decode_image(path, cv2.IMREAD_UNCHANGED)
    if image is None:
        raise AdapterError(f"{path} cannot be decoded")
    if image.dtype != np.uint16 or image.ndim != 2:
        raise AdapterError(
            f"{path} must be a 16-bit image of one channel, metres x {METRIC_PER_M:.0f}; "
            f"it is {image.dtype} {list(image.shape)}"
        )
    return image.astype(np.float32) / np.float32(METRIC_PER_M)


def read_relative(path: Path) -> np.ndarray:
    """float32 [h, w] of any unit, larger where nearer, NaN where unknown, from .npy or an image."""
    if path.suffix.lower() == ".npy":
        values = read_array(path)
    else:
        values = decode_image(path, cv2.IMREAD_UNCHANGED)
        if values is None:
            raise AdapterError(f"{path} cannot be decoded")
        if values.ndim == 3 and (values[..., :1] == values[..., :3]).all():
            values = values[..., 0]  # grey written with three channels
    values = values[0] if values.ndim == 3 and len(values) == 1 else values
    if values.ndim != 2 or values.dtype.kind not in "fiu" or values.size == 0:
        raise AdapterError(
            f"{path} must be one inverse depth a pixel, [height, width], not colours; "
            f"it is {values.dtype} {list(values.shape)}"
        )
    out = values.astype(np.float32)
    out[~np.isfinite(out)] = np.nan
    return out


def check_aspect(path: Path, shape: Sequence[int], camera: Camera) -> None:
    """Refuse maps of another shape than the image: they are of another camera, or cropped."""
    error = (shape[1] / shape[0]) / (camera.width / camera.height) - 1
    if abs(error) > _ASPECT_TOLERANCE:
        raise AdapterError(
            f"{path} is of {shape[1]}x{shape[0]} pixels; a map of camera {camera.name!r} has the "
            f"proportions of its image, {camera.width}x{camera.height}"
        )


def check_folder(folder: Path) -> None:
    if not folder.is_dir():
        raise AdapterError(f"{folder}: no such folder; depth maps were to be read from it")


class Alignment(NamedTuple):
    """Alignment of a relative map: 1 / z = scale relative + shift, in 1/m."""

    scale: float
    shift: float

    def depth_m(self, relative: np.ndarray) -> np.ndarray:
        """Return the depth of relative values, float32.

        NaN if it is too near or far to be believed.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = 1.0 / (self.scale * relative.astype(np.float64) + self.shift)
            depth[~((depth >= _NEAREST_M) & (depth <= _FURTHEST_M))] = np.nan
        return depth.astype(np.float32)


def align(relative: np.ndarray, depth_m: np.ndarray) -> Alignment | None:
    """Fit inverse depth by robust least squares over known pixels, both [M]. None if it fails.

    The fit is iteratively reweighted with Cauchy's weights, whose spread follows the median
    residual (Holland and Welsch 1977). It starts from a line through the quartiles. It fails with
    fewer than 30 known pixels, without contrast, or if larger values are not clearly nearer.
    """
    x = relative.astype(np.float64)
    y = 1.0 / depth_m.astype(np.float64)
    is_finite = np.isfinite(x) & np.isfinite(y)
    x = x[is_finite]
    y = y[is_finite]
    if len(x) < _MIN_KNOWN:
        return None
    low, middle, high = np.quantile(x, [0.1, 0.5, 0.9])
    unit = high - low
    if not unit > 0:
        return None
    x = (x - middle) / unit  # so that the normal equations are well conditioned
    bottom, top = np.quantile(y, [0.1, 0.9])
    scale = top - bottom
    shift = float(np.median(y))
    weight = np.ones_like(x)
    for _ in range(_ROUNDS):
        residual = y - (scale * x + shift)
        spread = max(1.4826 * float(np.median(np.abs(residual))), _MIN_SPREAD_PER_M)
        weight = 1.0 / (1.0 + (residual / (2.385 * spread)) ** 2)
        weight /= weight.sum()
        mean_x = float(weight @ x)
        mean_y = float(weight @ y)
        variance = float(weight @ (x - mean_x) ** 2)
        covariance = float(weight @ ((x - mean_x) * (y - mean_y)))
        if not variance > 0:
            return None
        scale = covariance / variance
        shift = mean_y - scale * mean_x
    spread_y = float(weight @ (y - mean_y) ** 2)
    correlation = covariance / max((variance * spread_y) ** 0.5, 1e-12)
    if correlation < _MIN_CORRELATION:
        return None
    return Alignment(scale / unit, shift - scale * middle / unit)


class AlignedDepth(NamedTuple):
    """A user's depth of one image in metres."""

    depth_m: np.ndarray
    """Depth along the optical axis, float32 [H, W], NaN where it is unknown or not believed."""
    error: float
    """Median relative error at known pixels that the alignment was not fitted to."""


@dataclass(frozen=True, eq=False)
class DepthMaps:
    """Depth maps of a drive's images.

    Attributes:
        kind: "metric", "relative", or "" for whatever agrees better with the LiDAR.
        folder: the folder.
        paths: the map of each image that has one.
    """

    kind: str
    folder: Path
    paths: Mapping[ViewKey, Path]

    @staticmethod
    def find(option: str, image_paths: Mapping[ViewKey, Path]) -> DepthMaps:
        """Return the maps of recorded images.

        Args:
            option: folder, `metric:FOLDER` or `relative:FOLDER`.
            image_paths: the recorded images.

        Raises:
            AdapterError: there is no such folder.
        """
        kind, folder = split_depth_option(option)
        suffixes = {".png"} if kind == "metric" else {".png", ".npy"}
        stems = {key: path.stem for key, path in image_paths.items()}
        return DepthMaps(kind, folder, find_maps(folder, image_paths, stems, suffixes))

    def read(self, key: ViewKey, camera: Camera, known_m: np.ndarray) -> AlignedDepth | None:
        """Return the image's depth at the camera's size; None without a map.

        Args:
            key: the image.
            camera: its camera at any scale.
            known_m: depth of known surfaces, float [H, W], infinite where there is none.

        Raises:
            AdapterError: the map cannot be read, or does not agree with the known depths.
        """
        path = self.paths.get(key)
        if path is None:
            return None
        inverses = [_read_inverse(path, kind, camera) for kind in self._kinds_of(path)]
        fits = [fit for inverse in inverses if (fit := _fit_inverse(inverse, known_m)) is not None]
        if not fits:
            raise AdapterError(
                f"{path} does not agree with the {int(np.isfinite(known_m).sum())} known "
                f"distances of its image: a metric map has metres x {METRIC_PER_M:.0f}, in a "
                f"relative one larger values are nearer"
            )
        return min(fits, key=lambda fit: fit.error)

    def _kinds_of(self, path: Path) -> tuple[str, ...]:
        if self.kind:
            return (self.kind,)
        return ("relative",) if path.suffix.lower() == ".npy" else ("metric", "relative")


def split_depth_option(option: str) -> tuple[str, Path]:
    """Return the kind ("metric", "relative" or "") and the folder of an option."""
    kind, colon, folder = option.partition(":")
    if colon and kind in ("metric", "relative"):
        return kind, Path(folder)
    return "", Path(option)


def _read_inverse(path: Path, kind: str, camera: Camera) -> np.ndarray:
    """Return a map as inverse depth up to scale and shift, float32 [H, W], NaN where unknown."""
    if kind == "metric":
        depth_m = read_metric(path)
        with np.errstate(divide="ignore"):
            inverse = np.where(depth_m > 0, 1 / depth_m, np.float32(np.nan))
    else:
        inverse = read_relative(path)
    check_aspect(path, inverse.shape, camera)
    # The nearest pixel: between a car and the wall behind it there is no surface.
    rows = ((np.arange(camera.height) + 0.5) * inverse.shape[0] / camera.height).astype(np.int64)
    columns = ((np.arange(camera.width) + 0.5) * inverse.shape[1] / camera.width).astype(np.int64)
    return inverse[rows[:, None], columns[None]].astype(np.float32)


def _fit_inverse(inverse: np.ndarray, known_m: np.ndarray) -> AlignedDepth | None:
    """Return the map aligned to known depths, and its error at every other one of them."""
    usable = np.flatnonzero((np.isfinite(known_m) & np.isfinite(inverse)).ravel())
    alignment = align(inverse.ravel()[usable[::2]], known_m.ravel()[usable[::2]])
    if alignment is None:
        return None
    depth_m = alignment.depth_m(inverse)
    tested = depth_m.ravel()[usable[1::2]]
    truth = known_m.ravel()[usable[1::2]]
    errors = np.abs(tested - truth) / truth
    errors = errors[np.isfinite(errors)]
    return AlignedDepth(depth_m, float(np.median(errors))) if len(errors) else None
