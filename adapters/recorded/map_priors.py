"""Depth maps from files as prior pixels of a training camera."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from adapters.recorded.depth_maps import check_aspect, read_metric, read_relative, read_sparse
from adapters.recorded.prior_pixels import PriorPixels
from adapters.recorded.relative_depth import align
from augment.cameras import Camera
from augment.errors import AdapterError

_NEAREST_M, _FURTHEST_M = 0.1, 1000.0  # what a file may call a depth


def sparse_prior(path: Path, camera: Camera) -> PriorPixels:
    """Street Gaussians' depth, of a larger image, at the pixels it falls on.

    Raises:
        AdapterError: the file is damaged, or of an image of another shape.
    """
    mask, value = read_sparse(path)
    check_aspect(path, mask.shape, camera)
    rows, columns = np.nonzero(mask)
    rows = (rows + 0.5) * camera.height / mask.shape[0]
    columns = (columns + 0.5) * camera.width / mask.shape[1]
    pixels = rows.astype(np.int64) * camera.width + columns.astype(np.int64)
    usable = (value > _NEAREST_M) & (value < _FURTHEST_M)  # NaN is neither
    return PriorPixels.of(pixels[usable], value[usable])


def metric_prior(path: Path, camera: Camera, sky: np.ndarray, grid_px: int) -> PriorPixels:
    """A dense map in metres at the pixels of a grid, 0 and sky left out.

    Raises:
        AdapterError: the file is no such map, or of an image of another shape.
    """
    depth = read_metric(path)
    check_aspect(path, depth.shape, camera)
    rows, columns = _grid(camera, grid_px)
    # No interpolation: between a car and the wall behind it there is no surface.
    at = _at_centres(depth, camera, rows, columns)
    usable = (at > _NEAREST_M) & (at < _FURTHEST_M) & ~sky[np.ix_(rows, columns)]
    return _of_grid(at, usable, rows, columns, camera)


def relative_prior(
    path: Path, camera: Camera, reference: np.ndarray, sky: np.ndarray, grid_px: int
) -> PriorPixels:
    """A dense inverse depth map, aligned to the reference depth [H, W] (0 where unknown), at the
    pixels of a grid.

    Raises:
        AdapterError: the file is no such map, or it does not agree with the reference.
    """
    relative = read_relative(path)
    check_aspect(path, relative.shape, camera)
    size = (camera.width, camera.height)
    enough = relative.shape[0] <= camera.height
    how = cv2.INTER_LINEAR if enough else cv2.INTER_AREA
    relative = cv2.resize(relative, size, interpolation=how)
    known = reference > 0
    found = align(relative[known], reference[known])
    if found is None:
        raise AdapterError(
            f"{path} does not agree with the {int(known.sum())} known distances: there must be "
            f"some, and larger values must be nearer (inverse depth, not depth)"
        )
    rows, columns = _grid(camera, grid_px)
    at = found.depth_m(relative[np.ix_(rows, columns)])
    return _of_grid(at, np.isfinite(at) & ~sky[np.ix_(rows, columns)], rows, columns, camera)


def beside(dense: PriorPixels, known: PriorPixels, camera: Camera, grid_px: int) -> PriorPixels:
    """The dense prior where no cell of its grid holds anything better known."""
    if len(known) == 0:
        return dense
    columns = -(-camera.width // grid_px)

    def cells(prior: PriorPixels) -> np.ndarray:
        row, column = prior.pixels // camera.width, prior.pixels % camera.width
        return row // grid_px * columns + column // grid_px

    return dense.select(~np.isin(cells(dense), cells(known)))


def _grid(camera: Camera, grid_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns in the middles of the grid's cells."""
    rows = np.arange(min(grid_px // 2, camera.height - 1), camera.height, grid_px)
    return rows, np.arange(min(grid_px // 2, camera.width - 1), camera.width, grid_px)


def _at_centres(
    image: np.ndarray, camera: Camera, rows: np.ndarray, columns: np.ndarray
) -> np.ndarray:
    y = ((rows + 0.5) * image.shape[0] / camera.height).astype(np.int64)
    x = ((columns + 0.5) * image.shape[1] / camera.width).astype(np.int64)
    return image[np.ix_(y, x)]


def _of_grid(
    depth_m: np.ndarray,
    usable: np.ndarray,
    rows: np.ndarray,
    columns: np.ndarray,
    camera: Camera,
) -> PriorPixels:
    pixels = rows[:, None] * camera.width + columns[None]
    return PriorPixels.of(pixels[usable], depth_m[usable])
