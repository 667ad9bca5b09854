"""Colours of a scene in its cameras' views: the content that a style maps from.

A scene and cameras come in. Colour statistics (for the closed forms) or whole pictures (for the
network) go out to `augment.effects.style.style` and to the training. A few small views are spread
evenly over the scene's frames and cameras. For a scene that no camera sees, the Gaussians' colours
are used instead, weighted by the area that they could cover.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.effects.style.color_maps import NUM_CLASSES
from augment.effects.style.statistics import (
    LAND,
    REGION_OF_CLASS,
    REST,
    ROAD,
    SKY,
    VEGETATION,
    WHOLE,
    ColorStatistics,
    Statistics,
    color_statistics,
)
from augment.memo import memo_of
from augment.render.composite import composite_sky
from augment.render.rasterize import rasterize
from augment.render.sh import SH_C0
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, Scene
from augment.scene.semantics import SemanticClass
from augment.scene.sky import ConstantSky, Sky, is_unknown_sky

# Largest number of views that the statistics are taken from.
NUM_VIEWS = 12
# Approximate number of pixels of a view.
VIEW_PIXELS = 200 * 130
# Largest number of pictures that a network takes.
NUM_PICTURES = 4
# Side of these pictures.
PICTURE_SIZE_PX = 256
# Smallest share of the sky in all views. Splats never cover a pixel completely, and a smaller share
# is only the sky that shines through them.
MIN_SKY_SHARE = 0.005

# Regions that the three channels of a marked picture stand for (see `_marked_scene`).
_CHANNELS = (ROAD, VEGETATION, REST)
# Channel of each class in a marked picture; classes without a channel are left out.
_CLASS_CHANNEL = {
    cls: _CHANNELS.index(region)
    for cls in SemanticClass
    if (region := REGION_OF_CLASS.get(cls, REST)) in _CHANNELS
}


def content_statistics(
    scene: Scene, cameras: Sequence[Camera] | None = None, *, per_region: bool
) -> Statistics:
    """Return colour statistics of the scene, kept in its memo.

    A grey that stands in for an unknown sky counts as SKY alone.

    Args:
        scene: the unstyled scene.
        cameras: the cameras that the scene will be seen by; None for all of its own.
        per_region: if True, statistics of ROAD, VEGETATION and REST are added where these regions
            are visible, provided that some Gaussians are classified as road or vegetation.

    Returns:
        Statistics of WHOLE always, of LAND and SKY where they are visible.
    """
    views = select_views(scene, cameras, NUM_VIEWS)
    key = ("content statistics", per_region, content_key(scene, cameras))
    return memo_of(scene).get(key, lambda: _statistics(scene, views, per_region))


def content_pictures(
    scene: Scene, cameras: Sequence[Camera] | None = None
) -> Float[Tensor, "B 3 256 256"]:
    """Return whole pictures of the scene with its sky, for a network; kept in the scene's memo.

    A scene that no camera sees gives one picture, of its Gaussians' colours in no order.

    Args:
        scene: the unstyled scene.
        cameras: the cameras that the scene will be seen by; None for all of its own.

    Returns:
        Display-encoded pictures in [0, 1], squeezed to squares.
    """
    views = select_views(scene, select_views(scene, cameras, NUM_VIEWS), NUM_PICTURES)
    key = ("content pictures", content_key(scene, cameras))
    return memo_of(scene).get(key, lambda: _pictures(scene, views))


def content_key(scene: Scene, cameras: Sequence[Camera] | None = None) -> Hashable:
    """Return the numbers of the cameras that the scene's content depends on."""
    return tuple(
        (
            c.width,
            c.height,
            c.fx,
            c.fy,
            c.cx,
            c.cy,
            c.timestamp_ns,
            c.camera_from_world.numpy().tobytes(),
        )
        for c in select_views(scene, cameras, NUM_VIEWS)
    )


def select_views(scene: Scene, cameras: Sequence[Camera] | None, count: int) -> tuple[Camera, ...]:
    """Return at most `count` of the cameras, spread evenly over their names and over time.

    Orthographic cameras are left out. The selection does not depend on what is rendered.

    Args:
        scene: the scene whose cameras are taken if `cameras` is None.
        cameras: the cameras to select from; None for the scene's own.
        count: largest number of selected cameras.
    """
    if cameras is None:
        cameras = [camera for frame in scene.frames for camera in frame.cameras.values()]
    by_name: dict[str, list[Camera]] = {}
    for camera in cameras:
        if not camera.is_orthographic:
            by_name.setdefault(camera.name, []).append(camera)
    names = list(by_name)
    if not names:
        return ()
    if sum(map(len, by_name.values())) <= count:
        return tuple(
            camera for same_name_cameras in by_name.values() for camera in same_name_cameras
        )
    selected_cameras = []
    for view in range(count):
        position = (2 * view + 1) / (2 * count)
        has_few_names = len(names) <= count
        same_name_cameras = by_name[
            names[view % len(names) if has_few_names else int(position * len(names))]
        ]
        selected_cameras.append(same_name_cameras[int(position * len(same_name_cameras))])
    return tuple({id(camera): camera for camera in selected_cameras}.values())


def knows_regions(scene: Scene) -> bool:
    """Return True if any of the scene's Gaussians is known to be road or vegetation."""
    regions = [REGION_OF_CLASS.get(cls) in (ROAD, VEGETATION) for cls in SemanticClass]
    table = np.zeros(NUM_CLASSES, bool)
    table[list(SemanticClass)] = regions
    classes = [part.semantic for part in scene.all_gaussians]
    return any(c is not None and bool(table[c.numpy()].any()) for c in classes)


def gaussian_statistics(scene: Scene, *, per_region: bool) -> Statistics:
    """Return statistics of the Gaussians' constant colours, weighted by opacity times mean extent.

    They stand for the whole picture, because the share of the sky is not known.

    Args:
        scene: a scene that no camera sees.
        per_region: if True, statistics of ROAD, VEGETATION and REST are added.
    """
    rgb, weights = _splat_colors(scene)
    statistics = color_statistics(rgb, weights)
    assert statistics is not None
    regions = {WHOLE: statistics, LAND: statistics}
    if per_region:
        channels = np.concatenate([_channels(part) for part in scene.all_gaussians])
        for number, region in enumerate(_CHANNELS):
            region_weights = np.where(channels == number, weights, 0)
            _add_region(regions, region, rgb, region_weights, float(weights.sum()))
    return regions


def _statistics(scene: Scene, views: Sequence[Camera], per_region: bool) -> Statistics:
    """Return statistics of the scene in these views, or of its Gaussians if no view shows any."""
    per_region = per_region and knows_regions(scene)
    marked = _marked_scene(scene) if per_region else None
    view_pixels = [_view_pixels(scene, marked, _small_camera(camera)) for camera in views]
    if not any((view.alpha > 0).any() for view in view_pixels):
        return gaussian_statistics(scene, per_region=per_region)
    alpha = np.concatenate([view.alpha for view in view_pixels])
    land = np.concatenate([view.land for view in view_pixels])
    total = float(alpha.size)
    regions: dict[str, ColorStatistics] = {}
    if is_unknown_sky(scene.sky):  # a grey that stands in for the sky is no part of the scene
        _add_region(regions, WHOLE, land, alpha, float(alpha.sum(dtype=np.float64)))
    else:
        picture = np.concatenate([view.picture for view in view_pixels])
        _add_region(regions, WHOLE, picture, np.ones_like(alpha), total)
    _add_region(regions, LAND, land, alpha, total)
    open_share = np.clip(1 - alpha, 0, 1)
    if open_share.sum(dtype=np.float64) >= MIN_SKY_SHARE * total:
        _add_region(
            regions, SKY, np.concatenate([view.sky for view in view_pixels]), open_share, total
        )
    if per_region:
        marks = np.concatenate([view.marks for view in view_pixels])
        for number, region in enumerate(_CHANNELS):
            _add_region(regions, region, land, marks[:, number], total)
    return regions


@dataclass(frozen=True, eq=False)
class _ViewPixels:
    """A view's P pixels, float32 in [0, 1]."""

    picture: np.ndarray  # [P, 3] colour of splats and sky together
    land: np.ndarray  # [P, 3] colour of the splats alone
    sky: np.ndarray  # [P, 3] colour of the sky alone
    alpha: np.ndarray  # [P] opacity of the splats
    marks: np.ndarray  # [P, 3] weights of _CHANNELS; [0, 3] without regions


def _view_pixels(scene: Scene, marked: Scene | None, camera: Camera) -> _ViewPixels:
    """Render a camera's view. marked: the scene of `_marked_scene`, or None without regions."""
    rgb_image, alpha_image = _render(scene, camera)
    black_image = torch.from_numpy(np.zeros((camera.height, camera.width, 3), np.float32))
    sky_image = composite_sky(black_image, black_image[..., 0].contiguous(), camera, scene.sky)
    # By NumPy from here: on arrays this small torch's threads cost more than they give.
    rgb, sky = (image.numpy().reshape(-1, 3) for image in (rgb_image, sky_image))
    alpha = np.clip(alpha_image.numpy().reshape(-1), 0, 1)
    marks = np.empty((0, 3), np.float32)
    if marked is not None:
        marks = np.clip(_render(marked, camera)[0].numpy().reshape(-1, 3), 0, 1)
    return _ViewPixels(
        picture=np.clip(rgb + (1 - alpha)[:, None] * sky, 0, 1),
        land=np.clip(rgb / np.maximum(alpha, np.float32(1e-6))[:, None], 0, 1),
        sky=np.clip(sky, 0, 1),
        alpha=alpha,
        marks=marks,
    )


def _add_region(
    regions: dict[str, ColorStatistics],
    region: str,
    rgb: np.ndarray,
    weights: np.ndarray,
    total: float,
) -> None:
    """Add statistics of the region to `regions`, unless its weights are only rounding errors."""
    statistics = color_statistics(rgb, weights, total=total)
    # Float rounding of the marks leaves traces of regions that are not visible.
    if statistics is not None and statistics.share > 1e-6:
        regions[region] = statistics


def _pictures(scene: Scene, views: Sequence[Camera]) -> Float[Tensor, "B 3 256 256"]:
    """Render square pictures of these views that show any splat; without any, a palette."""
    images = []
    for camera in views:
        view = camera.resized(PICTURE_SIZE_PX, PICTURE_SIZE_PX)
        rgb, alpha = _render(scene, view)
        if bool((alpha > 0).any()):
            image = composite_sky(rgb, alpha, view, _sky_of_pictures(scene, rgb, alpha))
            images.append(image.clamp(0, 1).permute(2, 0, 1))
    if not images:
        images = [_palette(scene)]
    return torch.stack(images).float().contiguous()


def _sky_of_pictures(scene: Scene, rgb: Tensor, alpha: Tensor) -> Sky:
    """Return the scene's sky; if that is a stand-in, a sky of the splats' mean visible colour."""
    if not is_unknown_sky(scene.sky):
        return scene.sky
    return ConstantSky((rgb.sum((0, 1)) / alpha.sum()).clamp(0, 1))


def _palette(scene: Scene) -> Float[Tensor, "3 256 256"]:
    """Return a picture of Gaussians' colours, in proportion to their weights, in no order."""
    rgb, weights = _splat_colors(scene)
    cumulative_weights = np.cumsum(weights)
    num_pixels = PICTURE_SIZE_PX**2
    indices = np.searchsorted(
        cumulative_weights, (np.arange(num_pixels) + 0.5) / num_pixels * cumulative_weights[-1]
    )
    picture = rgb[np.minimum(indices, len(rgb) - 1)].reshape(PICTURE_SIZE_PX, PICTURE_SIZE_PX, 3)
    return torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1))).float()


def _render(scene: Scene, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return colour (premultiplied) and opacity of the splats in a view."""
    with torch.no_grad():
        output = rasterize(scene.parts_for(camera), camera)
    assert output.rgb is not None and output.alpha is not None
    return output.rgb.float(), output.alpha.float()


def _marked_scene(scene: Scene) -> Scene:
    """Return the scene with Gaussians coloured by their region.

    Roads are (1, 0, 0), vegetation (0, 1, 0) and other land (0, 0, 1), so that a picture of the
    scene holds the weights of these three regions in every pixel.
    """

    def marked(gaussians: Gaussians) -> Gaussians:
        table = torch.full((len(_CHANNELS) + 1, 1, 3), -0.5 / SH_C0, dtype=gaussians.sh.dtype)
        for number in range(len(_CHANNELS)):
            table[number, 0, number] = 0.5 / SH_C0
        return dataclasses.replace(gaussians, sh=table[torch.from_numpy(_channels(gaussians))])

    return scene.with_gaussians(marked)


def _channels(gaussians: Gaussians) -> np.ndarray:
    """Return the channel that marks each Gaussian, int64 [N]; without one, len(_CHANNELS)."""
    table = np.full(NUM_CLASSES, len(_CHANNELS), np.int64)
    for cls, channel in _CLASS_CHANNEL.items():
        table[cls] = channel
    if gaussians.semantic is None:
        return np.full(len(gaussians), table[SemanticClass.UNKNOWN])
    return table[gaussians.semantic.numpy()]


def _splat_colors(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return constant colours of all Gaussians, float64 [N, 3], and their weights [N].

    A weight is the opacity times the ellipsoid's visible area, averaged over three sides, m^2. If
    the sum of all weights is 0, all weights are 1.
    """
    colors = []
    weights = []
    for part in scene.all_gaussians:
        colors.append(np.clip(0.5 + SH_C0 * part.sh[:, 0].detach().double().numpy(), 0, 1))
        a, b, c = part.scales.detach().double().numpy().T
        weights.append(part.opacities.detach().double().numpy() * ((a * b + b * c + c * a) / 3))
    all_weights = np.concatenate(weights)
    return np.concatenate(colors), all_weights if all_weights.sum() > 0 else np.ones_like(
        all_weights
    )


def _small_camera(camera: Camera) -> Camera:
    """Return the camera with about VIEW_PIXELS pixels, if it has more."""
    return camera.scaled(min(1.0, math.sqrt(VIEW_PIXELS / (camera.width * camera.height))))
