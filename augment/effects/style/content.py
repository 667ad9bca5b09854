"""Colours of a scene in its cameras' views: the content that a style maps from.

A few small views are spread evenly over the scene's frames and cameras. For a scene that no camera
sees, the Gaussians' colours are used instead, weighted by the area that they could cover.
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

from augment.cameras import Camera
from augment.effects.style.color_maps import CLASSES
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
    statistics_of,
)
from augment.memo import memo_of
from augment.render.composite import composite_sky
from augment.render.rasterize import rasterize
from augment.render.sh import SH_C0
from augment.scene import Gaussians, Scene
from augment.semantics import SemanticClass
from augment.sky import ConstantSky, Sky, is_stand_in

VIEWS = 12  # views that the statistics are taken from
VIEW_PIXELS = 200 * 130  # approximate number of pixels of a view
PICTURES = 4  # pictures that a network takes
PICTURE_SIZE = 256  # side of these pictures, pixels
# Smallest share of the sky in all views. Splats never cover a pixel completely, and a smaller share
# is only what shines through them.
MIN_SKY = 0.005

_CHANNELS = (ROAD, VEGETATION, REST)  # of the picture that says what a pixel shows
_CLASS_CHANNEL = {
    cls: _CHANNELS.index(region)
    for cls in SemanticClass
    if (region := REGION_OF_CLASS.get(cls, REST)) in _CHANNELS
}


def content_statistics(
    scene: Scene, cameras: Sequence[Camera] | None = None, *, per_region: bool
) -> Statistics:
    """Colour statistics of the scene: WHOLE always, LAND and SKY where they are seen.

    A grey that stands in for a sky counts as SKY alone.

    cameras: those that the scene will be seen by; None for all of its own. per_region: also ROAD,
    VEGETATION and REST where they are seen, of a scene whose Gaussians know at least one of the
    first two. Kept in the scene's memo.
    """
    views = select_views(scene, cameras, VIEWS)
    key = ("content statistics", per_region, content_key(scene, cameras))
    return memo_of(scene).get(key, lambda: _statistics(scene, views, per_region))


def content_pictures(
    scene: Scene, cameras: Sequence[Camera] | None = None
) -> Float[Tensor, "B 3 256 256"]:
    """Whole pictures of the scene with its sky, in [0, 1], squeezed to a square: for a network.

    cameras: as content_statistics. A scene that no camera sees gives one picture, of its
    Gaussians' colours in no order. Kept in the scene's memo.
    """
    views = select_views(scene, select_views(scene, cameras, VIEWS), PICTURES)
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
        for c in select_views(scene, cameras, VIEWS)
    )


def select_views(scene: Scene, cameras: Sequence[Camera] | None, count: int) -> tuple[Camera, ...]:
    """Return at most `count` of the cameras, spread evenly over their names and over time.

    cameras: None for the scene's own. Orthographic cameras are left out. The selection does not
    depend on what is rendered.
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
        return tuple(camera for group in by_name.values() for camera in group)
    chosen = []
    for view in range(count):
        spread = (2 * view + 1) / (2 * count)
        few = len(names) <= count
        group = by_name[names[view % len(names) if few else int(spread * len(names))]]
        chosen.append(group[int(spread * len(group))])
    return tuple({id(camera): camera for camera in chosen}.values())


def knows_regions(scene: Scene) -> bool:
    """Return True if any of the scene's Gaussians is known to be road or vegetation."""
    regions = [REGION_OF_CLASS.get(cls) in (ROAD, VEGETATION) for cls in SemanticClass]
    table = np.zeros(CLASSES, bool)
    table[list(SemanticClass)] = regions
    classes = [part.semantic for part in scene.all_gaussians]
    return any(c is not None and bool(table[c.numpy()].any()) for c in classes)


def gaussian_statistics(scene: Scene, *, per_region: bool) -> Statistics:
    """Statistics of the Gaussians' constant colours, weighted by opacity times mean extent.

    They stand for the whole picture: how much sky would be seen is not known.
    """
    rgb, weights = _splat_colors(scene)
    statistics = statistics_of(rgb, weights)
    assert statistics is not None
    regions = {WHOLE: statistics, LAND: statistics}
    if per_region:
        channels = np.concatenate([_channels(part) for part in scene.all_gaussians])
        for number, region in enumerate(_CHANNELS):
            region_weights = np.where(channels == number, weights, 0)
            _add(regions, region, rgb, region_weights, float(weights.sum()))
    return regions


def _statistics(scene: Scene, views: Sequence[Camera], per_region: bool) -> Statistics:
    per_region = per_region and knows_regions(scene)
    marked = _marked_scene(scene) if per_region else None
    view_pixels = [_view_pixels(scene, marked, _small(camera)) for camera in views]
    if not any((view.alpha > 0).any() for view in view_pixels):
        return gaussian_statistics(scene, per_region=per_region)
    alpha = np.concatenate([view.alpha for view in view_pixels])
    land = np.concatenate([view.land for view in view_pixels])
    total = float(alpha.size)
    regions: dict[str, ColorStatistics] = {}
    if is_stand_in(scene.sky):  # a grey that nobody saw has no part in the scene's mood
        _add(regions, WHOLE, land, alpha, float(alpha.sum(dtype=np.float64)))
    else:
        picture = np.concatenate([view.picture for view in view_pixels])
        _add(regions, WHOLE, picture, np.ones_like(alpha), total)
    _add(regions, LAND, land, alpha, total)
    open_share = np.clip(1 - alpha, 0, 1)
    if open_share.sum(dtype=np.float64) >= MIN_SKY * total:
        _add(regions, SKY, np.concatenate([view.sky for view in view_pixels]), open_share, total)
    if per_region:
        marks = np.concatenate([view.marks for view in view_pixels])
        for number, region in enumerate(_CHANNELS):
            _add(regions, region, land, marks[:, number], total)
    return regions


@dataclass(frozen=True, eq=False)
class _ViewPixels:
    """A view's P pixels, float32 in [0, 1]."""

    picture: np.ndarray  # [P, 3]
    land: np.ndarray  # [P, 3] colour of the splats alone
    sky: np.ndarray  # [P, 3] colour of the sky alone
    alpha: np.ndarray  # [P]
    marks: np.ndarray  # [P, 3] weights of _CHANNELS, or [0, 3]


def _view_pixels(scene: Scene, marked: Scene | None, camera: Camera) -> _ViewPixels:
    rgb_image, alpha_image = _render(scene, camera)
    nothing = torch.from_numpy(np.zeros((camera.height, camera.width, 3), np.float32))
    sky_image = composite_sky(nothing, nothing[..., 0].contiguous(), camera, scene.sky)
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


def _add(
    regions: dict[str, ColorStatistics],
    region: str,
    rgb: np.ndarray,
    weights: np.ndarray,
    total: float,
) -> None:
    statistics = statistics_of(rgb, weights, total=total)
    # Float rounding of the marks leaves traces of regions that are nowhere.
    if statistics is not None and statistics.share > 1e-6:
        regions[region] = statistics


def _pictures(scene: Scene, views: Sequence[Camera]) -> Float[Tensor, "B 3 256 256"]:
    images = []
    for camera in views:
        view = camera.resized(PICTURE_SIZE, PICTURE_SIZE)
        rgb, alpha = _render(scene, view)
        if bool((alpha > 0).any()):
            image = composite_sky(rgb, alpha, view, _sky_of_pictures(scene, rgb, alpha))
            images.append(image.clamp(0, 1).permute(2, 0, 1))
    if not images:
        images = [_palette(scene)]
    return torch.stack(images).float().contiguous()


def _sky_of_pictures(scene: Scene, rgb: Tensor, alpha: Tensor) -> Sky:
    """The scene's; where that is a stand-in, one of the mean colour of what else is seen."""
    if not is_stand_in(scene.sky):
        return scene.sky
    return ConstantSky((rgb.sum((0, 1)) / alpha.sum()).clamp(0, 1))


def _palette(scene: Scene) -> Float[Tensor, "3 256 256"]:
    """Return colours of Gaussians, each as often as its weight says, in no meaningful order."""
    rgb, weights = _splat_colors(scene)
    reached = np.cumsum(weights)
    pixels = PICTURE_SIZE**2
    at = np.searchsorted(reached, (np.arange(pixels) + 0.5) / pixels * reached[-1])
    picture = rgb[np.minimum(at, len(rgb) - 1)].reshape(PICTURE_SIZE, PICTURE_SIZE, 3)
    return torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1))).float()


def _render(scene: Scene, camera: Camera) -> tuple[Tensor, Tensor]:
    with torch.no_grad():
        output = rasterize(scene.parts_for(camera), camera)
    assert output.rgb is not None and output.alpha is not None
    return output.rgb.float(), output.alpha.float()


def _marked_scene(scene: Scene) -> Scene:
    """The scene with Gaussians of the colours (1, 0, 0) on roads, (0, 1, 0) on vegetation,
    (0, 0, 1) on the rest, so that a picture of it holds every pixel's weights of the three.
    """

    def marked(gaussians: Gaussians) -> Gaussians:
        table = torch.full((len(_CHANNELS) + 1, 1, 3), -0.5 / SH_C0, dtype=gaussians.sh.dtype)
        for number in range(len(_CHANNELS)):
            table[number, 0, number] = 0.5 / SH_C0
        return dataclasses.replace(gaussians, sh=table[torch.from_numpy(_channels(gaussians))])

    return scene.with_gaussians(marked)


def _channels(gaussians: Gaussians) -> np.ndarray:
    """int64 [N]: the channel that marks each Gaussian; one past the last where none does."""
    table = np.full(CLASSES, len(_CHANNELS), np.int64)
    for cls, channel in _CLASS_CHANNEL.items():
        table[cls] = channel
    if gaussians.semantic is None:
        return np.full(len(gaussians), table[SemanticClass.UNKNOWN])
    return table[gaussians.semantic.numpy()]


def _splat_colors(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """The constant colours of all Gaussians, float64 [N, 3], and their weights [N]: opacity times
    the mean over three sides of what is seen of an ellipsoid, m^2; 1 where all weigh nothing.
    """
    colors = []
    weights = []
    for part in scene.all_gaussians:
        colors.append(np.clip(0.5 + SH_C0 * part.sh[:, 0].detach().double().numpy(), 0, 1))
        a, b, c = part.scales.detach().double().numpy().T
        weights.append(part.opacities.detach().double().numpy() * ((a * b + b * c + c * a) / 3))
    weighted = np.concatenate(weights)
    return np.concatenate(colors), weighted if weighted.sum() > 0 else np.ones_like(weighted)


def _small(camera: Camera) -> Camera:
    return camera.scaled(min(1.0, math.sqrt(VIEW_PIXELS / (camera.width * camera.height))))
