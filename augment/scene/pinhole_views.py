"""Pinhole views that cover the picture of a camera with a lens, and the way between their pixels.

The rasteriser draws pinholes. A camera with a lens is drawn as one pinhole view, or as several that
look into different directions, and every pixel of the lens is looked up in them. The layout with
the fewest pixels is taken, of one view, of sectors side by side, and of the faces of a cube. Each
view has at least the lens's resolution at every pixel that is looked up in it.

Views overlap in a narrow band, in which their colours are mixed: so no seam is seen where effects
differ a little between views.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64
from scipy.interpolate import RectBivariateSpline
from torch import Tensor

from augment.scene.cameras import Camera
from augment.scene.geometry import rigid
from augment.scene.lenses import Intrinsics, Lens

# Largest angle between a view's axis and a ray that is looked up in it, degrees.
MAX_OFF_AXIS_DEG = 70.0
# Width of the band in which two views are mixed: difference of the cosines to both axes.
BLEND_BAND = 0.04
# Pixels of a view beyond those that are looked up, on every side.
MARGIN_PX = 4
# Pixels of a single view, in those of the lens image, up to which no other layout is tried.
MAX_SINGLE_SIZE = 2.5
# Cost of another view, in pixels: every view looks at all splats and effects anew.
VIEW_COST_PX = 400_000
# Numbers of sectors that are tried.
_SECTORS = (2, 3, 4)
# Spacing of the pixels whose rays are solved, where rays in between can be interpolated, pixels.
_COARSE_PX = 8
# Largest error of interpolated rays, pixels.
_MAX_RAY_ERROR_PX = 1e-3
# Layouts that are remembered.
_NUM_LAYOUTS = 16


@dataclass(frozen=True, eq=False)
class PinholeView:
    """One pinhole view of a layout."""

    view_from_camera: Float64[np.ndarray, "3 3"]
    """Rotation from the camera's axes to the view's."""
    width: int
    """Width of the view, pixels."""
    height: int
    """Height of the view, pixels."""
    intrinsics: Intrinsics
    """Focal lengths and principal point of the view."""
    pixels: Float32[np.ndarray, "H W 2"]
    """Place in the view of every pixel of the lens image; undefined where the weight is 0."""
    weights: Float32[np.ndarray, "H W"]
    """Share of the view in the colour of a pixel of the lens image."""
    distance_per_z: Float32[np.ndarray, "H W"]
    """Distance along the ray for a depth of 1 in the view."""

    def camera_for(self, camera: Camera) -> Camera:
        """Return the view as a pinhole camera.

        Args:
            camera: the camera with the lens, at the layout's size.
        """
        rotation = torch.from_numpy(self.view_from_camera)
        pose = rigid(rotation, torch.zeros(3, dtype=torch.float64)) @ camera.camera_from_world
        is_turned = not np.array_equal(self.view_from_camera, np.eye(3))
        return dataclasses.replace(
            camera,
            width=self.width,
            height=self.height,
            fx=self.intrinsics.fx,
            fy=self.intrinsics.fy,
            cx=self.intrinsics.cx,
            cy=self.intrinsics.cy,
            camera_from_world=pose if is_turned else camera.camera_from_world,
            lens=None,
            shutter=None,
        )


@dataclass(frozen=True, eq=False)
class LensLayout:
    """Pinhole views that cover a lens image."""

    views: tuple[PinholeView, ...]
    """The views."""
    is_inside: Bool[np.ndarray, "H W"]
    """Pixels of the lens image that see something."""
    rays: Float32[np.ndarray, "H W 3"]
    """Unit directions of its pixels in the camera's axes; (0, 0, 1) outside."""

    @property
    def main_view(self) -> Float64[np.ndarray, "H W"]:
        """Return the index of the view with the largest weight at each pixel."""
        return np.argmax([view.weights for view in self.views], axis=0)


def layout_of(camera: Camera) -> LensLayout:
    """Return the pinhole views that cover the picture of a camera with a lens.

    Args:
        camera: the camera; its pose and shutter do not matter.

    Raises:
        ValueError: no pixel of the camera sees anything.
    """
    assert camera.lens is not None
    return _make_layout(camera.lens, camera.intrinsics, camera.width, camera.height, camera.name)


@functools.lru_cache(maxsize=_NUM_LAYOUTS)
def _make_layout(
    lens: Lens, intrinsics: Intrinsics, width: int, height: int, name: str
) -> LensLayout:
    """Return the layout of `layout_of`."""
    rays, is_inside = pixel_rays(lens, intrinsics, width, height)
    if not is_inside.any():
        raise ValueError(
            f"camera {name!r}: no pixel of its image of {width}x{height} lies within its "
            f"{type(lens).__name__} (up to {math.degrees(lens.max_angle_rad):.4g} degrees from the "
            f"axis); check the lens's numbers and {intrinsics}"
        )
    best: tuple[float, tuple[PinholeView, ...]] | None = None
    for rotations in _candidates(rays[is_inside]):
        views = _views_of(rotations, rays, is_inside, intrinsics)
        if views is None:
            continue
        cost = sum(view.width * view.height + VIEW_COST_PX for view in views)
        if best is None or cost < best[0]:
            best = (cost, views)
        if len(views) == 1 and cost <= MAX_SINGLE_SIZE * width * height + VIEW_COST_PX:
            break
    assert best is not None  # the cube covers every direction
    return LensLayout(best[1], is_inside, rays.astype(np.float32))


def pixel_rays(
    lens: Lens, intrinsics: Intrinsics, width: int, height: int
) -> tuple[Float64[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]:
    """Return the unit directions of all pixel centres, and the mask of those that see something.

    Where the whole image sees something, the rays of some pixels are solved and splines give the
    others.

    Args:
        lens: the lens.
        intrinsics: numbers of the image.
        width: width of the image, pixels.
        height: height of the image, pixels.
    """
    columns = np.arange(width) + 0.5
    rows = np.arange(height) + 0.5
    coarse = [_coarse_places(size) for size in (width, height)]
    grid = np.stack(np.meshgrid(*coarse), -1)
    coarse_rays, is_inside = lens.rays(grid, intrinsics)
    if is_inside.all() and min(grid.shape[:2]) > 5:
        rays = np.stack(
            [
                RectBivariateSpline(coarse[1], coarse[0], coarse_rays[..., axis], kx=5, ky=5)(
                    rows, columns
                )
                for axis in range(3)
            ],
            -1,
        )
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        pixels, is_inside = lens.project(rays[::5, ::5], intrinsics)
        error = np.abs(pixels - np.stack(np.meshgrid(columns[::5], rows[::5]), -1))
        if is_inside.all() and error.max() <= _MAX_RAY_ERROR_PX:
            return rays, np.ones((height, width), bool)
    return lens.rays(np.stack(np.meshgrid(columns, rows), -1), intrinsics)


def _coarse_places(size: int) -> Float64[np.ndarray, " N"]:
    """Return places about _COARSE_PX apart from the first pixel's centre to the last one's."""
    count = max(2, math.ceil((size - 1) / _COARSE_PX) + 1)
    return np.linspace(0.5, size - 0.5, count)


def _candidates(rays: Float64[np.ndarray, "N 3"]) -> list[list[Float64[np.ndarray, "3 3"]]]:
    """Return sets of views that may cover the rays, as rotations from the camera's axes.

    Args:
        rays: unit directions in the camera's axes.
    """
    sets = [[np.eye(3)]]
    azimuth = np.arctan2(rays[:, 0], rays[:, 2])
    low = float(azimuth.min())
    span = float(azimuth.max()) - low
    for count in _SECTORS:
        sets.append([_turned_right(low + span * (i + 0.5) / count) for i in range(count)])
    quarter = math.pi / 2
    cube = [_turned_right(quarter * i) for i in range(4)]
    cube += [_turned_down(quarter), _turned_down(-quarter)]
    # Four views about the axis: corners of a wide lens lie in their middles.
    tilt = math.radians(40.0)
    around = [
        _turned_down(down) @ _turned_right(right)
        for right, down in itertools.product((-tilt, tilt), repeat=2)
    ]
    return [*sets, around, cube]


def _turned_right(angle_rad: float) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation from the camera's axes to those of a view turned to the right."""
    cosine = math.cos(angle_rad)
    sine = math.sin(angle_rad)
    return np.array([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]])


def _turned_down(angle_rad: float) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation from the camera's axes to those of a view turned down."""
    cosine = math.cos(angle_rad)
    sine = math.sin(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, cosine, -sine], [0.0, sine, cosine]])


def _views_of(
    rotations: Sequence[Float64[np.ndarray, "3 3"]],
    rays: Float64[np.ndarray, "H W 3"],
    is_inside: Bool[np.ndarray, "H W"],
    intrinsics: Intrinsics,
) -> tuple[PinholeView, ...] | None:
    """Return the views with these rotations, as small as the rays allow; None if they cannot see
    every ray.

    Args:
        rotations: from the camera's axes to the views'.
        rays: unit directions of the pixels in the camera's axes.
        is_inside: pixels that see something.
        intrinsics: of the lens image.
    """
    cosines = np.stack([rays @ rotation[2] for rotation in rotations])
    largest = cosines.max(0)
    min_cosine = math.cos(math.radians(MAX_OFF_AXIS_DEG))
    if (largest[is_inside] < min_cosine).any():
        return None
    views = []
    weights = np.maximum(cosines - (largest - BLEND_BAND), 0.0) * is_inside
    # A pixel at the edge of a view's reach takes another one.
    weights = np.where(cosines >= min_cosine * 0.9, weights, 0.0)
    weights /= np.maximum(weights.sum(0), 1e-12)
    for rotation, weight, cosine in zip(rotations, weights, cosines, strict=True):
        is_used = weight > 0
        if not is_used.any():
            continue
        views.append(_view_of(rotation, rays, weight, cosine, intrinsics))
    return tuple(views)


def _view_of(
    rotation: Float64[np.ndarray, "3 3"],
    rays: Float64[np.ndarray, "H W 3"],
    weight: Float64[np.ndarray, "H W"],
    cosine: Float64[np.ndarray, "H W"],
    intrinsics: Intrinsics,
) -> PinholeView:
    """Return one view, as small as the pixels that are looked up in it allow.

    Args:
        rotation: from the camera's axes to the view's.
        rays: unit directions of the pixels in the camera's axes.
        weight: share of the view in each pixel.
        cosine: of the angle between each ray and the view's axis.
        intrinsics: of the lens image.
    """
    is_used = weight > 0
    z = np.where(is_used, cosine, 1.0)
    across = np.where(is_used, rays @ rotation[0] / z, 0.0) * intrinsics.fx
    down = np.where(is_used, rays @ rotation[1] / z, 0.0) * intrinsics.fy
    scale = 1 / _smallest_stretch(across, down, is_used)
    if abs(scale - 1) < 0.02:
        scale = 1.0
    # The view's pixels have the raster of the lens image at the axis: without distortion, no pixel
    # lies between others.
    columns = across * scale + intrinsics.cx
    rows = down * scale + intrinsics.cy
    left = math.floor(columns[is_used].min()) - MARGIN_PX
    top = math.floor(rows[is_used].min()) - MARGIN_PX
    width = math.ceil(columns[is_used].max()) + MARGIN_PX - left
    height = math.ceil(rows[is_used].max()) + MARGIN_PX - top
    return PinholeView(
        rotation,
        width,
        height,
        Intrinsics(
            intrinsics.fx * scale, intrinsics.fy * scale, intrinsics.cx - left, intrinsics.cy - top
        ),
        np.stack([columns - left, rows - top], -1).astype(np.float32),
        weight.astype(np.float32),
        np.where(is_used, 1 / z, 0.0).astype(np.float32),
    )


def _smallest_stretch(
    across: Float64[np.ndarray, "H W"],
    down: Float64[np.ndarray, "H W"],
    is_used: Bool[np.ndarray, "H W"],
) -> float:
    """Return the smallest stretch of a view against the lens image, in any direction.

    Args:
        across: place of each pixel in the view along x, pixels.
        down: its place along y, pixels.
        is_used: pixels that are looked up in the view.
    """
    if min(across.shape) < 2:
        return 1.0
    is_whole = is_used[:-1, :-1] & is_used[1:, :-1] & is_used[:-1, 1:]
    if not is_whole.any():
        return 1.0
    xx = np.diff(across, axis=1)[:-1][is_whole]
    xy = np.diff(across, axis=0)[:, :-1][is_whole]
    yx = np.diff(down, axis=1)[:-1][is_whole]
    yy = np.diff(down, axis=0)[:, :-1][is_whole]
    # The smaller singular value of [[xx, xy], [yx, yy]].
    total = xx * xx + xy * xy + yx * yx + yy * yy
    determinant = xx * yy - xy * yx
    difference = np.sqrt(np.maximum(total * total - 4 * determinant * determinant, 0.0))
    smallest = np.sqrt(np.maximum((total - difference) / 2, 0.0))
    return float(max(np.quantile(smallest, 0.001), 0.05))


def covering_camera(camera: Camera) -> Camera:
    """Return a pinhole camera that looks where a camera looks: itself, if it is one.

    Code that asks what a camera has seen, and needs no exact pixels, takes it in place of a camera
    with a lens. Beyond MAX_OFF_AXIS_DEG from the axis, it sees nothing.

    Args:
        camera: any camera but an orthographic one.
    """
    if camera.lens is None:
        return camera.without_lens()
    width, height, intrinsics = _covering_pinhole(
        camera.lens, camera.intrinsics, camera.width, camera.height
    )
    return dataclasses.replace(
        camera,
        width=width,
        height=height,
        fx=intrinsics.fx,
        fy=intrinsics.fy,
        cx=intrinsics.cx,
        cy=intrinsics.cy,
        lens=None,
        shutter=None,
    )


@functools.lru_cache(maxsize=64)
def _covering_pinhole(
    lens: Lens, intrinsics: Intrinsics, width: int, height: int
) -> tuple[int, int, Intrinsics]:
    """Return size and intrinsics of `covering_camera`."""
    grid = np.stack(np.meshgrid(*[_coarse_places(size) for size in (width, height)]), -1)
    rays, is_inside = lens.rays(grid, intrinsics)
    is_inside &= rays[..., 2] >= math.cos(math.radians(MAX_OFF_AXIS_DEG))
    if not is_inside.any():
        return width, height, intrinsics
    columns = (rays[..., 0] / rays[..., 2])[is_inside] * intrinsics.fx + intrinsics.cx
    rows = (rays[..., 1] / rays[..., 2])[is_inside] * intrinsics.fy + intrinsics.cy
    left = math.floor(columns.min())
    top = math.floor(rows.min())
    return (
        math.ceil(columns.max()) - left,
        math.ceil(rows.max()) - top,
        intrinsics._replace(cx=intrinsics.cx - left, cy=intrinsics.cy - top),
    )
