"""Pinhole views that cover the picture of a camera with a lens, and the way between their pixels.

The rasteriser draws pinholes. A camera with a lens is drawn as one pinhole view, or as several that
look into different directions, and every pixel of the lens is looked up in them. Each view has at
least the lens's resolution at every pixel that is looked up in it.

Views overlap in a narrow band, in which their colours are mixed: so no seam is seen where effects
differ a little between views.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, UInt8
from scipy.interpolate import RectBivariateSpline

from augment.scene.cameras import Camera
from augment.scene.geometry import rigid
from augment.scene.lenses import Intrinsics, Lens

# Largest angle between a view's axis and a ray that is looked up in it, degrees.
MAX_OFF_AXIS_DEG = 65.0
# Largest ratio of the areas that pixels of the lens cover in one of several views.
MAX_AREA_RATIO = 2.2
# Power of a larger ratio by which a set of views costs more.
_RATIO_POWER = 1.5
# The same of a single view, which costs least. Its splats are blurred as in a pinhole picture.
MAX_SINGLE_AREA_RATIO = 4.0
# Width of the band in which two views are mixed: difference of the cosines to both axes.
BLEND_BAND = 0.03
# Pixels of a view beyond those that are looked up, on every side.
MARGIN_PX = 4
# Cost of another view, in pixels: every view looks at all splats and effects anew.
VIEW_COST_PX = 150_000
# Columns and rows of views that are tried, spread over the lens image.
_GRIDS = ((2, 1), (1, 2), (3, 1), (2, 2), (3, 2), (2, 3), (3, 3), (4, 3), (3, 4), (4, 4), (5, 5))
# Smallest factor of the splats' blur in a view: a window of an image may show less finely.
MIN_BLUR_GAIN = 0.1
# Largest factor of the splats' blur in a view.
MAX_BLUR_GAIN = 4.0
# Spacing of the pixels whose rays are solved, where rays in between can be interpolated, pixels.
_COARSE_PX = 8
# Largest error of interpolated rays, pixels.
_MAX_RAY_ERROR_PX = 1e-3
# Layouts that are remembered.
_NUM_LAYOUTS = 64


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
    blur_gain: float
    """Factor of the rasteriser's blur, px^2, by which splats are as wide as in the lens image."""

    def camera_for(self, camera: Camera) -> Camera:
        """Return the view as a pinhole camera.

        Args:
            camera: the camera with the lens, at the layout's size.
        """
        rotation = torch.from_numpy(self.view_from_camera)
        pose = rigid(rotation, torch.zeros(3, dtype=torch.float64)) @ camera.camera_from_world
        is_turned = not np.array_equal(self.view_from_camera, np.eye(3))
        return dataclasses.replace(
            camera.without_lens(),
            width=self.width,
            height=self.height,
            **self.intrinsics._asdict(),
            camera_from_world=pose if is_turned else camera.camera_from_world,
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

    @functools.cached_property
    def main_view(self) -> UInt8[np.ndarray, "H W"]:
        """Return the index of the view with the largest weight at each pixel."""
        return np.argmax([view.weights for view in self.views], axis=0).astype(np.uint8)


def layout_of(camera: Camera, whole_camera: Camera | None = None) -> LensLayout:
    """Return the pinhole views that cover the picture of a camera with a lens.

    Args:
        camera: the camera; its pose and shutter do not matter.
        whole_camera: the camera of whose image `camera` is a window. The window is looked up in
            views with the directions and resolutions of the whole image's, so that both look alike.

    Raises:
        ValueError: no pixel of the camera sees anything.
    """
    views = () if whole_camera is None else layout_of(whole_camera).views
    lens = camera.lens
    assert lens is not None
    layout = _make_layout(lens, camera.intrinsics, camera.width, camera.height, views)
    if layout is None:
        raise ValueError(
            f"camera {camera.name!r}: no pixel of its image of {camera.width}x{camera.height} lies "
            f"within its {type(lens).__name__} (up to {math.degrees(lens.max_angle_rad):.4g} "
            f"degrees from the axis); check the lens's numbers and {camera.intrinsics}"
        )
    return layout


@functools.lru_cache(maxsize=_NUM_LAYOUTS)
def _make_layout(
    lens: Lens,
    intrinsics: Intrinsics,
    width: int,
    height: int,
    whole_views: tuple[PinholeView, ...],
) -> LensLayout | None:
    """Return the layout of `layout_of`, None if no pixel sees anything. Cameras with one lens share
    it, whatever their names.

    Args:
        lens: the lens.
        intrinsics: numbers of the image.
        width: width of the image, pixels.
        height: height of the image, pixels.
        whole_views: views of the image of which this one is a window; empty for a whole image.
    """
    rays, is_inside = pixel_rays(lens, intrinsics, width, height)
    if not is_inside.any():
        return None
    if whole_views:
        rotations = [view.view_from_camera for view in whole_views]
    else:
        rotations = _choose_views(rays, is_inside, intrinsics)
    weights = _weights(rotations, rays, is_inside)
    # A window that reaches beyond the whole image may see what no view shows.
    is_inside = is_inside & (weights.sum(0) > 0)
    views = [
        _view_of(
            rotation,
            rays,
            weight,
            intrinsics,
            is_single=len(rotations) == 1,
            whole_view=whole_views[number] if whole_views else None,
        )
        for number, (rotation, weight) in enumerate(zip(rotations, weights, strict=True))
        if (weight > 0).any()
    ]
    return LensLayout(tuple(views), is_inside, rays.astype(np.float32))


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
    pixels = np.stack(np.meshgrid(columns, rows), -1).astype(np.float64)
    return lens.rays(pixels, intrinsics)


def _coarse_places(size: int) -> Float64[np.ndarray, " N"]:
    """Return places about _COARSE_PX apart from the first pixel's centre to the last one's."""
    count = max(2, math.ceil((size - 1) / _COARSE_PX) + 1)
    return np.linspace(0.5, size - 0.5, count)


def _choose_views(
    rays: Float64[np.ndarray, "H W 3"], is_inside: Bool[np.ndarray, "H W"], intrinsics: Intrinsics
) -> list[Float64[np.ndarray, "3 3"]]:
    """Return the views with the fewest pixels, as rotations from the camera's axes.

    One view is taken if it stretches no part of the lens image much more than another. Splats are
    blurred by pixels of the view: where these are much smaller than the lens's, they are too sharp.

    Args:
        rays: unit directions of the pixels in the camera's axes.
        is_inside: pixels that see something.
        intrinsics: of the lens image.
    """
    step = max(1, min(rays.shape[:2]) // 64)
    coarse_rays = rays[::step, ::step]
    coarse_inside = is_inside[::step, ::step]
    single = [np.eye(3)]
    ratio, _ = _judge(single, coarse_rays, coarse_inside, intrinsics, step)
    if ratio <= MAX_SINGLE_AREA_RATIO:
        return single
    choices = []
    for columns, rows in _GRIDS:
        rotations = _spread_views(coarse_rays, coarse_inside, columns, rows)
        ratio, cost = _judge(rotations, coarse_rays, coarse_inside, intrinsics, step)
        choices.append((cost * max(ratio / MAX_AREA_RATIO, 1.0) ** _RATIO_POWER, rotations))
    return min(choices, key=lambda choice: choice[0])[1]


def _spread_views(
    rays: Float64[np.ndarray, "H W 3"], is_inside: Bool[np.ndarray, "H W"], columns: int, rows: int
) -> list[Float64[np.ndarray, "3 3"]]:
    """Return views that look at the middles of a grid's cells over the lens image.

    Args:
        rays: unit directions of the pixels in the camera's axes.
        is_inside: pixels that see something.
        columns: columns of the grid.
        rows: rows of the grid.
    """
    height, width = is_inside.shape
    rotations = []
    for row in range(rows):
        for column in range(columns):
            cell = np.s_[
                row * height // rows : (row + 1) * height // rows,
                column * width // columns : (column + 1) * width // columns,
            ]
            inside = is_inside[cell]
            if inside.any():
                rotations.append(_looking_along(rays[cell][inside].mean(0)))
    return rotations


def _looking_along(direction: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Return the smallest rotation from the camera's axes that brings a direction to the axis."""
    x, y, z = direction / np.linalg.norm(direction)
    if z < -0.999:
        return np.diag([-1.0, 1.0, -1.0])
    k = 1 / (1 + z)
    return np.array([[1 - k * x * x, -k * x * y, -x], [-k * x * y, 1 - k * y * y, -y], [x, y, z]])


def _judge(
    rotations: Sequence[Float64[np.ndarray, "3 3"]],
    rays: Float64[np.ndarray, "H W 3"],
    is_inside: Bool[np.ndarray, "H W"],
    intrinsics: Intrinsics,
    step: int,
) -> tuple[float, float]:
    """Return the largest ratio of stretches in a view, and the cost of a set of views in pixels.

    Args:
        rotations: from the camera's axes to the views'.
        rays: unit directions of some pixels in the camera's axes.
        is_inside: pixels that see something.
        intrinsics: of the lens image.
        step: spacing of these pixels.
    """
    weights = _weights(rotations, rays, is_inside)
    if ((weights.sum(0) <= 0) & is_inside).any():
        return math.inf, math.inf
    largest = 1.0
    cost = 0.0
    for rotation, weight in zip(rotations, weights, strict=True):
        is_used = weight > 0
        if not is_used.any():
            continue
        across, down = _flat_places(rotation, rays, is_used, intrinsics)
        smallest, areas = _stretches(across / step, down / step, is_used)
        if len(areas):
            largest = max(largest, float(np.quantile(areas, 0.99) / np.quantile(areas, 0.01)))
        size = np.ptp(across[is_used]) * np.ptp(down[is_used])
        cost += float(size) / smallest**2 + VIEW_COST_PX
    return largest, cost


def _weights(
    rotations: Sequence[Float64[np.ndarray, "3 3"]],
    rays: Float64[np.ndarray, "H W 3"],
    is_inside: Bool[np.ndarray, "H W"],
) -> Float64[np.ndarray, "V H W"]:
    """Return the share of each view in the pixels of the lens image; zeros where no view reaches.

    Args:
        rotations: from the camera's axes to the views'.
        rays: unit directions of the pixels in the camera's axes.
        is_inside: pixels that see something.
    """
    cosines = np.stack([rays @ rotation[2] for rotation in rotations])
    weights = np.maximum(cosines - (cosines.max(0) - BLEND_BAND), 0.0) * is_inside
    weights *= cosines >= math.cos(math.radians(MAX_OFF_AXIS_DEG))
    return weights / np.maximum(weights.sum(0), 1e-12)


def _flat_places(
    rotation: Float64[np.ndarray, "3 3"],
    rays: Float64[np.ndarray, "H W 3"],
    is_used: Bool[np.ndarray, "H W"],
    intrinsics: Intrinsics,
) -> tuple[Float64[np.ndarray, "H W"], Float64[np.ndarray, "H W"]]:
    """Return x and y of pixels in a view with the lens image's focal lengths, from its axis.

    Args:
        rotation: from the camera's axes to the view's.
        rays: unit directions of the pixels in the camera's axes.
        is_used: pixels that are looked up in the view; the others get 0.
        intrinsics: of the lens image.
    """
    z = np.where(is_used, rays @ rotation[2], 1.0)
    across = np.where(is_used, rays @ rotation[0] / z, 0.0) * intrinsics.fx
    down = np.where(is_used, rays @ rotation[1] / z, 0.0) * intrinsics.fy
    return across, down


def _view_of(
    rotation: Float64[np.ndarray, "3 3"],
    rays: Float64[np.ndarray, "H W 3"],
    weight: Float64[np.ndarray, "H W"],
    intrinsics: Intrinsics,
    *,
    is_single: bool,
    whole_view: PinholeView | None = None,
) -> PinholeView:
    """Return one view, as small as the pixels that are looked up in it allow.

    Args:
        rotation: from the camera's axes to the view's.
        rays: unit directions of the pixels in the camera's axes.
        weight: share of the view in each pixel.
        intrinsics: of the lens image.
        is_single: True for the only view of a layout.
        whole_view: view of the whole image whose resolution is taken; None to choose it.
    """
    is_used = weight > 0
    across, down = _flat_places(rotation, rays, is_used, intrinsics)
    if whole_view is None:
        smallest, areas = _stretches(across, down, is_used)
        scale = 1 / smallest
        if abs(scale - 1) < 0.02:
            scale = 1.0
        blur_gain = scale * scale
        if not is_single and len(areas):
            blur_gain *= float(np.median(areas))
    else:
        scale = whole_view.intrinsics.fx / intrinsics.fx
        blur_gain = whole_view.blur_gain
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
        np.where(is_used, 1 / np.where(is_used, rays @ rotation[2], 1.0), 0.0).astype(np.float32),
        min(max(blur_gain, MIN_BLUR_GAIN), MAX_BLUR_GAIN),
    )


def _stretches(
    across: Float64[np.ndarray, "H W"],
    down: Float64[np.ndarray, "H W"],
    is_used: Bool[np.ndarray, "H W"],
) -> tuple[float, Float64[np.ndarray, " N"]]:
    """Return the smallest stretch of a view against the lens image, in any direction and place, and
    the areas of the lens's pixels in the view, in its pixels.

    Args:
        across: place of each pixel in the view along x, pixels.
        down: its place along y, pixels.
        is_used: pixels that are looked up in the view.
    """
    if min(across.shape) < 2:
        return 1.0, np.zeros(0)
    is_whole = is_used[:-1, :-1] & is_used[1:, :-1] & is_used[:-1, 1:]
    if not is_whole.any():
        return 1.0, np.zeros(0)
    xx = np.diff(across, axis=1)[:-1][is_whole]
    xy = np.diff(across, axis=0)[:, :-1][is_whole]
    yx = np.diff(down, axis=1)[:-1][is_whole]
    yy = np.diff(down, axis=0)[:, :-1][is_whole]
    # The smaller singular value of [[xx, xy], [yx, yy]].
    total = xx * xx + xy * xy + yx * yx + yy * yy
    areas = xx * yy - xy * yx
    difference = np.sqrt(np.maximum(total * total - 4 * areas * areas, 0.0))
    smallest = np.sqrt(np.maximum((total - difference) / 2, 0.0))
    return float(max(np.quantile(smallest, 0.001), 0.05)), areas


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
        camera.without_lens(), width=width, height=height, **intrinsics._asdict()
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
