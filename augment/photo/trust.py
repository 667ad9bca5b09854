"""Trust in the pictures of a scene: from where it was seen, and what it lacks there.

In: a scene and its cameras. Out: `trust_mask`, a number for every pixel of a view, which jobs write
beside the picture; and `judge_scene`, figures and sentences from a few small views, for `climategs`
commands and the checks before a job.

A clear render hides what weather shows: fog fills a hole in the road, and a sheet of sky 15 m away
is a bright pane in it. So a view is judged by the scene itself:

    sky       pixels that the recording shows as sky and that have a surface nearer than 200 m
    ground    pixels below the horizon without a surface (alpha < 0.5), or that let light through
    pose      distance of the camera from those that the scene was made from; never fitted ones
    detail    pixels per metre of the picture over those that the scene was made from
    support   colours that recorded images from other places show at the same points
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from augment.memo import memo_of
from augment.photo.lidar_view import elevation_rad
from augment.photo.sky_matte import (
    is_same_view,
    read_small_image,
    recorded_frame,
    recorded_sky_regions,
)
from augment.photo.sky_regions import SOFT_EDGE, SURFACE, WORK_WIDTH
from augment.render.buffers import ALPHA, AUTO, MEDIAN_DEPTH, RGB, SPLAT_IDS
from augment.render.constants import SURFACE_ALPHA
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera, Frame
from augment.scene.labels import EGO_VEHICLE
from augment.scene.pinhole_scene import pinhole_frames, pinhole_scene
from augment.scene.scene import Scene, Track

# Distance from which a surface before the sky fades in any fog and casts no pane, metres.
SKY_FROM_M = 200.0
# Transmittance of ground below the horizon, at most: 5/255 of a white fog shine through.
MAX_TRANSMITTANCE = 0.02
# Alpha of ground in a pixel that can be trusted: a tenth of white fog is 20/255 and shows.
MIN_GROUND_ALPHA = 0.9
# Share of the sky that may be covered by near surfaces: 1 % of the sky or the ground of a 480x270
# picture is a patch of 25x25 pixels, a car 40 m away.
MAX_SKY_COVERED = 0.01
# Share of the ground that may be without a surface.
MAX_GROUND_OPEN = 0.01
# Share of sky in an image below which pale walls are taken for it.
MIN_SKY_SHARE = 0.05
# Elevation below zero from which a ray counts as below the horizon: roads slope, and poses are off
# by as much.
HORIZON_RAD = math.radians(1.5)
# Magnification up to which pictures are sharp: nothing finer was learnt, and thin splats become
# needles.
MAX_MAGNIFICATION = 1.5
# Magnification from which a pixel's detail is invented; trust falls from 1.0 on.
NO_TRUST_MAGNIFICATION = 4.0
# Distance from the nearest source view up to which a view is trusted, metres: half a lane and more.
# Beyond it the sides of parked cars appear that nobody has seen.
MAX_DISTANCE_M = 2.0
# Angle to the nearest source view up to which a view is trusted: beyond it, a quarter of a camera
# 60 degrees wide looks past what it saw.
MAX_ANGLE_RAD = math.radians(15)

# Columns of the views that are judged.
_JUDGED_WIDTH = 256
# Columns of the points that are looked for in the views of the scene.
_GRID_WIDTH = 320
# Columns of these views' depths.
_DEPTH_WIDTH = 240
# Depth of points of the sky, metres.
_SKY_POINT_M = 1e4
# Depth behind what a view shows up to which it has seen a point, as a part of the depth.
_DEPTH_SHARE = 0.05
# The same in metres; both are added.
_DEPTH_M = 0.5
# Nearest views that are searched: what they have not seen, views farther away saw worse.
_NUM_VIEWS = 24
# Share of all points for which a view's depths are drawn, at least.
_MIN_POINTS = 0.001
# Gain in a point's trust for which one more view is searched.
_MIN_GAIN = 0.1
# Distance from which an image of the same camera is compared, metres: a floating splat 5 m away
# then moves by 50 pixels of 240 against what is behind it.
_PARALLAX_M = 1.0
# Nearest images that are compared.
_NUM_WITNESSES = 4
# Difference below which colours are the same, of 255.
_SAME_COLOR = 24.0
# Difference from which colours are another thing's, of 255.
_OTHER_COLOR = 64.0


# ---- Views that a scene was made from ------------------------------------------------------------


class FitRecord(BaseModel):
    """Record of a fit: the value of `Scene.made_by["fitted"]`."""

    model_config = ConfigDict(frozen=True, strict=True, allow_inf_nan=False)

    scale: Annotated[float, Field(gt=0, le=1)]
    """Size of the images learnt from over the recorded ones."""
    views: dict[str, list[int]]
    """Frame numbers learnt from, by camera."""


@dataclass(frozen=True, eq=False)
class SourceView:
    """An image that the scene was made from."""

    frame: int
    """Number of the frame."""
    camera: Camera
    """Camera at the size that was learnt from."""
    scale: float = 1.0
    """That size over the recorded one."""


@dataclass(frozen=True, eq=False)
class SourceViews:
    """The images that a scene was made from; none where they are not known."""

    views: tuple[SourceView, ...]
    """The images."""
    is_fit: bool
    """If True, the scene was fitted to the images; else made from a recording."""

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the cameras, in the order in which they first appear."""
        return tuple(dict.fromkeys(view.camera.name for view in self.views))

    def of_camera(self, name: str) -> tuple[SourceView, ...]:
        """Return the views of one camera."""
        return tuple(view for view in self.views if view.camera.name == name)

    @functools.cached_property
    def scale(self) -> float | None:
        """Return the smallest scale of the images; None where no view is known."""
        return min((view.scale for view in self.views), default=None)

    @functools.cached_property
    def poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Return centres and optical axes, float64 [V, 3] each."""
        cameras = [view.camera for view in self.views]
        centres = np.array([c.centre.numpy() for c in cameras]).reshape(-1, 3)
        axes = np.array([c.camera_from_world.numpy()[2, :3] for c in cameras]).reshape(-1, 3)
        return centres, axes

    def pose_differences(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Return the distance of a camera from each view: metres and radians, [V] each."""
        centres, axes = self.poses
        cosine = axes @ camera.camera_from_world.numpy()[2, :3]
        distance_m = np.linalg.norm(centres - camera.centre.numpy(), axis=1)
        return distance_m, np.arccos(np.clip(cosine, -1, 1))


class NearestView(NamedTuple):
    """The source view nearest to a camera."""

    distance_m: float
    """Distance between the cameras' centres."""
    angle_rad: float
    """Angle between their optical axes."""
    magnification: float
    """Pixels of the camera for one pixel of the view, of the same thing."""


def source_views(scene: Scene) -> SourceViews:
    """Return the views that a scene was made from.

    For a fitted scene they are those that it was fitted to, as its files say; else all that was
    recorded.
    """
    scene = scene.as_recorded
    return memo_of(scene).get("source views", lambda: _find_source_views(scene))


def unfitted_cameras(scene: Scene) -> tuple[str, ...]:
    """Return the recorded cameras that a fit has never learnt from."""
    sources = source_views(scene)
    if not sources.is_fit or not sources.views:
        return ()
    recorded_names = dict.fromkeys(name for frame in _made_from(scene) for name in frame.cameras)
    return tuple(name for name in recorded_names if name not in sources.names)


def _made_from(scene: Scene) -> tuple[Frame, ...]:
    """Return the frames that the scene was made from."""
    return scene.frames if scene.seen_frames is None else scene.seen_frames


def skipped_cameras_sentence(names: Sequence[str], how: str) -> str:
    """Return a job's sentence about cameras that it leaves out.

    Args:
        names: names of the cameras.
        how: option that renders them all the same.
    """
    return (
        f"left out: {', '.join(names)}, to whose images the scene was never fitted; {how} renders "
        f"them too"
    )


def magnification_sentence(learnt_scale: float | None, scale: float) -> str | None:
    """Return a sentence on pictures that are too large; None where they are not.

    Args:
        learnt_scale: scale of the images learnt from; None where unknown.
        scale: scale of the pictures.
    """
    if learnt_scale is None or scale <= MAX_MAGNIFICATION * learnt_scale:
        return None
    return (
        f"rendered {scale / learnt_scale:.1f} times as large as it was learnt (limit "
        f"{MAX_MAGNIFICATION:g}): nothing finer was learnt, and thin splats may show as "
        f"needles; render smaller, or fit larger"
    )


def nearest_view(sources: SourceViews, camera: Camera) -> NearestView | None:
    """Return the source view nearest to a camera; None where no view is known.

    A metre of distance counts as much as 7.5 degrees.
    """
    if not sources.views:
        return None
    distance_m, angle_rad = sources.pose_differences(camera)
    best = int(np.argmin(_pose_difference(distance_m, angle_rad)))
    magnification = camera.fx / sources.views[best].camera.fx
    return NearestView(float(distance_m[best]), float(angle_rad[best]), magnification)


def _pose_difference(distance_m: Any, angle_rad: Any) -> Any:
    """Return the difference of two poses, 1 at each limit alone."""
    return distance_m / MAX_DISTANCE_M + angle_rad / MAX_ANGLE_RAD


def _find_source_views(scene: Scene) -> SourceViews:
    """Return the views that a scene was made from, as `source_views`."""
    frames = _made_from(scene)
    fit = _fit_record(scene.made_by, frames)
    has_images = any(frame.image_paths for frame in frames)
    views = []
    for frame in frames:
        for name, camera in frame.cameras.items():
            if camera.is_orthographic:
                continue
            if fit is not None:
                if frame.index in fit.views.get(name, ()):
                    views.append(SourceView(frame.index, camera.scaled(fit.scale), fit.scale))
            elif name in frame.image_paths or not has_images:
                views.append(SourceView(frame.index, camera))
    return SourceViews(tuple(views), fit is not None)


def _fit_record(made_by: Mapping[str, Any], frames: Sequence[Frame]) -> FitRecord | None:
    """Return the record of a scene's fit; None for a scene that was not fitted, or has no usable
    one.

    Scenes from before there was a record are read by the settings of their fit.
    """
    record = made_by.get("fitted")
    if record is None and isinstance(settings := made_by.get("settings"), dict):
        cameras = settings.get("cameras")
        scale = settings.get("scale")
        holdout_match = re.fullmatch(r"every-(\d{1,6})(st|nd|rd|th)", str(settings.get("holdout")))
        holdout_step = int(holdout_match[1]) if holdout_match else 0
        held_out_frames = (
            {frame.index for frame in frames[holdout_step - 1 :: holdout_step]}
            if holdout_step
            else set()
        )
        names = {name for frame in frames for name in frame.cameras}
        if cameras != "all":
            names &= set(str(cameras).split(","))
        learnt_frames = [frame for frame in frames if frame.index not in held_out_frames]
        views = {n: [f.index for f in learnt_frames if n in f.cameras] for n in sorted(names)}
        record = {"scale": scale, "views": views}
    try:
        return None if record is None else FitRecord.model_validate(record)
    except ValidationError:
        return None


# ---- One view, pixel by pixel --------------------------------------------------------------------


class _RecordedSky(NamedTuple):
    """Sky of one image. Pixels in neither mask are at edges."""

    is_sky: Bool[np.ndarray, "H W"]
    """Pixels that surely show sky."""
    is_solid: Bool[np.ndarray, "H W"]
    """Pixels that surely show no sky."""


class _ClearView(NamedTuple):
    """A view of the scene without weather."""

    alpha: Float[np.ndarray, "H W"]
    """Alpha of the view."""
    z_m: Float[np.ndarray, "H W"]
    """z of its surfaces."""
    owner: Int[np.ndarray, "H W"]
    """Instance of the heaviest splat, 0 for the background."""
    is_own_car: Bool[np.ndarray, "H W"]
    """Pixels that show the recording car."""
    elevation_rad: Float[np.ndarray, "H W"]
    """Elevation of the rays."""
    sky: _RecordedSky | None
    """Sky of the recorded image; None where that is unknown."""
    rgb: Float[np.ndarray, "H W 3"] | None
    """Colours of the surfaces, 0 to 1, the scene's; None where nobody asks."""

    @property
    def sky_share(self) -> float:
        """Return the share of the image that the recording shows as sky; 0 where unknown."""
        return 0.0 if self.sky is None else float(self.sky.is_sky.mean())

    @property
    def has_surface(self) -> Bool[np.ndarray, "H W"]:
        """Return the mask of pixels that show a surface."""
        return self.alpha >= SURFACE_ALPHA


def trust_mask(scene: Scene, camera: Camera, *, backend: str = AUTO) -> UInt8[np.ndarray, "H W"]:
    """Return the trust in each pixel of a view, from 0, none, to 255.

    It is the product of three parts:

    - 1 where the pixel shows a surface or the sky, in the right place, and below the horizon a
    surface of MIN_GROUND_ALPHA; else 0;
    - by the image that has seen the same thing unhidden at most pixels a metre: 1 where those are
    as many as are drawn, 0 from NO_TRUST_MAGNIFICATION times fewer on, smooth between;
    - the share of images that show the surface's colour at its place: of this view and of up to
    _NUM_WITNESSES of the same camera, at least _PARALLAX_M away, that see it. Splats that stand
    where nothing is, fitted to one image, are contradicted by the others.

    Actors that were moved, and copies of actors, are looked for where images recorded them. So the
    ground that a removed actor always hid, sides that no image shows and actors of other scenes
    have no trust.

    Args:
        scene: the scene; weather does not count. If its views are not known, no pixel is trusted.
        camera: the view, as rendered. In an orthographic camera no pixel is trusted.
        backend: the rasteriser's backend.
    """
    if camera.is_orthographic:
        return np.zeros((camera.height, camera.width), np.uint8)
    pose = camera.camera_from_world.numpy().tobytes()
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    key = "trust", camera.name, camera.timestamp_ns, camera.width, camera.height, intrinsics, pose
    return memo_of(scene).get(
        key,
        lambda: _measure_trust(
            scene, camera, _render_clear_view(scene, camera, backend, True), backend
        ),
    )


def _render_clear_view(
    scene: Scene, camera: Camera, backend: str, with_rgb: bool = False
) -> _ClearView:
    """Return a view of the scene without weather."""
    parts = scene.parts_for(camera)
    buffers = (ALPHA, MEDIAN_DEPTH, SPLAT_IDS, *((RGB,) if with_rgb else ()))
    raster = rasterize(parts, camera, buffers=buffers, backend=backend)
    assert raster.alpha is not None
    assert raster.median_depth is not None and raster.splat_ids is not None
    ends = np.cumsum([len(part.gaussians) for part in parts])
    part_of = np.searchsorted(ends, raster.splat_ids.cpu().numpy(), side="right")  # -1: the first
    instances = np.array([part.instance_id for part in parts])
    own_car = [1 + i for i, actor in enumerate(scene.actors) if actor.label == EGO_VEHICLE]
    alpha = raster.alpha.cpu().numpy()
    owner = instances[part_of]
    return _ClearView(
        alpha=alpha,
        z_m=raster.median_depth.cpu().numpy(),
        owner=owner,
        is_own_car=np.isin(owner, own_car) & (alpha >= SURFACE_ALPHA),
        elevation_rad=elevation_rad(camera),
        sky=_find_recorded_sky(scene, camera),
        rgb=None if raster.rgb is None else _unweight_colors(raster.rgb.cpu().numpy(), alpha),
    )


def _unweight_colors(rgb: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Return the colours of surfaces from colours weighted by their alpha."""
    return rgb / np.maximum(alpha, SURFACE_ALPHA)[..., None]


def _find_recorded_sky(scene: Scene, camera: Camera) -> _RecordedSky | None:
    """Return the sky of the image that was recorded at the camera's place and time."""
    frame = recorded_frame(scene, camera)
    if frame is None or all(frame.index != f.index for f in _made_from(scene)):
        return None
    kinds = recorded_sky_regions(scene, frame, camera.name)
    if kinds is None:
        return None
    recorded = frame.cameras[camera.name]
    if not is_same_view(recorded, camera):
        return _RecordedSky(
            is_sky=_seen_in(kinds >= SOFT_EDGE, recorded, camera),
            is_solid=_seen_in(kinds == SURFACE, recorded, camera),
        )
    return _RecordedSky(
        is_sky=_enlarge(kinds >= SOFT_EDGE, camera), is_solid=_enlarge(kinds == SURFACE, camera)
    )


def _seen_in(mask: np.ndarray, recorded: Camera, camera: Camera) -> np.ndarray:
    """Return a mask of a recorded image as another camera at its place sees it.

    Pixels beyond the recorded image are False.

    Args:
        mask: bool [h, w], of the image at any size.
        recorded: the pinhole camera of the image.
        camera: the other camera.
    """
    small = recorded.resized(mask.shape[1], mask.shape[0])
    rays = camera.ray_directions().numpy() @ small.camera_from_world[:3, :3].numpy().T
    z = np.maximum(rays[..., 2], 1e-6)
    columns = np.where(rays[..., 2] > 0, small.fx * rays[..., 0] / z + small.cx - 0.5, -2.0)
    rows = np.where(rays[..., 2] > 0, small.fy * rays[..., 1] / z + small.cy - 0.5, -2.0)
    places = columns.astype(np.float32), rows.astype(np.float32)
    border = cv2.BORDER_CONSTANT
    return cv2.remap(mask.astype(np.uint8), *places, cv2.INTER_NEAREST, borderMode=border) > 0


def _enlarge(mask: np.ndarray, camera: Camera) -> np.ndarray:
    """Return a mask at the camera's size."""
    size = camera.width, camera.height
    return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0


def _erode_border(mask: np.ndarray) -> np.ndarray:
    """Return a mask without its border, which was cut in a small image."""
    side = 1 + 2 * max(1, round(mask.shape[1] / WORK_WIDTH))
    return cv2.erode(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0


def _same_pose(a: Camera, b: Camera) -> bool:
    """Return True if two cameras have one pose."""
    return torch.allclose(a.camera_from_world, b.camera_from_world, rtol=0, atol=1e-6)


def _measure_trust(scene: Scene, camera: Camera, view: _ClearView, backend: str) -> np.ndarray:
    """Return the trust in each pixel of a view, as `trust_mask`."""
    has_surface = view.has_surface
    is_below_horizon = view.elevation_rad < -HORIZON_RAD
    is_open_sky = view.elevation_rad > 0
    is_solid = has_surface & ~(is_below_horizon & (view.alpha < MIN_GROUND_ALPHA))
    if view.sky is not None:
        is_open_sky &= ~_erode_border(view.sky.is_solid)
        if view.sky_share >= MIN_SKY_SHARE:
            # A moved actor may stand before what the recording shows as sky.
            is_moved = np.isin(view.owner, list(scene.moved_instances))
            is_solid &= is_moved | ~_find_panes(scene, camera, view)
    is_fit = np.where(has_surface, is_solid, is_open_sky)
    points = _view_points(camera, view)
    trust = _measure_detail(scene, camera, points, backend)
    trust *= _measure_support(scene, camera, view, points, backend)
    steps = np.rint(255 * trust.reshape(points.grid.height, points.grid.width)).astype(np.uint8)
    size = camera.width, camera.height
    return cv2.resize(steps, size, interpolation=cv2.INTER_NEAREST) * is_fit


def _find_panes(scene: Scene, camera: Camera, view: _ClearView) -> np.ndarray:
    """Return the mask of surfaces that stand before the sky."""
    assert view.sky is not None
    distance_m = view.z_m * camera.ray_lengths().numpy()
    is_near = distance_m < (SKY_FROM_M if scene.has_metric_scale else math.inf)
    return _erode_border(view.sky.is_sky) & view.has_surface & is_near


class _ViewPoints(NamedTuple):
    """P points that the pixels of a grid show."""

    grid: Camera
    """Camera at the grid's size."""
    world: np.ndarray
    """Places, metres, [P, 3]."""
    owner: np.ndarray
    """Instance that each point belongs to, 0 for the background, [P]."""
    density: np.ndarray
    """Pixels a metre that are drawn, [P]."""
    has_surface: np.ndarray
    """True for points of surfaces; others are sky, far away, [P]."""


def _view_points(camera: Camera, view: _ClearView) -> _ViewPoints:
    """Return the points that a view shows."""
    columns = min(_GRID_WIDTH, camera.width)
    grid = camera.resized(columns, max(1, round(camera.height * columns / camera.width)))
    rows_of = ((np.arange(grid.height) + 0.5) * camera.height / grid.height).astype(int)
    columns_of = ((np.arange(grid.width) + 0.5) * camera.width / grid.width).astype(int)
    grid_pixels = np.ix_(rows_of, columns_of)
    has_surface = view.has_surface[grid_pixels].ravel()
    owner = view.owner[grid_pixels].ravel()
    rays = camera.ray_directions(torch.float64).numpy()[grid_pixels].reshape(-1, 3)
    z_m = np.where(has_surface, view.z_m[grid_pixels].ravel(), _SKY_POINT_M)
    return _ViewPoints(
        grid=grid,
        world=camera.centre.numpy() + z_m[:, None] * rays,
        owner=np.where(has_surface, owner, 0),
        density=camera.fx / np.maximum(z_m, 1e-6),
        has_surface=has_surface,
    )


def _measure_detail(scene: Scene, camera: Camera, points: _ViewPoints, backend: str) -> np.ndarray:
    """Return how finely some view of the scene has seen each point unhidden, 0 to 1, [P]."""
    trust = np.zeros(len(points.world))
    sources = source_views(scene)
    for number, view in _nearest_views(sources, camera):
        remaining = np.flatnonzero(trust < 1 - _MIN_GAIN)
        if len(remaining) == 0:
            break
        view_points = _points_in_view(scene, camera, points, remaining, view.camera)
        detail = _detail_of_points(view.camera, view_points, points.density[remaining])
        has_gain = detail > trust[remaining] + _MIN_GAIN
        is_same_image = camera.timestamp_ns == view.camera.timestamp_ns and _same_pose(
            view.camera, camera
        )
        if not is_same_image or scene.moved_instances:
            if has_gain.sum() < _MIN_POINTS * len(trust):
                continue
            has_gain &= ~_find_hidden(
                view.camera, view_points, _depths(scene, number, view.camera, backend)
            )
        trust[remaining[has_gain]] = detail[has_gain]
    return trust


def _measure_support(
    scene: Scene, camera: Camera, view: _ClearView, points: _ViewPoints, backend: str
) -> np.ndarray:
    """Return the share of images that show each point's colour at its place, [P].

    It counts images that see the point, and this view, which counts as one that does.
    """
    assert view.rgb is not None
    size = points.grid.width, points.grid.height
    rgb = cv2.resize(view.rgb, size, interpolation=cv2.INTER_AREA).reshape(-1, 3)
    num_agreeing = np.ones(len(rgb))
    num_images = np.ones(len(rgb))
    surface_points = np.flatnonzero(points.has_surface)
    for number, witness in _witnesses(scene, camera):
        image = _recorded_range(scene, number, witness)
        if image is None:
            continue
        view_points = _points_in_view(scene, camera, points, surface_points, witness.camera)
        is_seen = _detail_of_points(witness.camera, view_points, points.density[surface_points]) > 0
        is_seen &= ~_find_hidden(
            witness.camera, view_points, _depths(scene, number, witness.camera, backend)
        )
        colors = rgb[surface_points[is_seen]]
        color_map = scene.color_map(witness.camera)
        if color_map is not None:
            colors = colors @ color_map[:, :3].numpy().T + color_map[:, 3].numpy()
        row, column = _pixels(witness.camera, view_points[is_seen], image.lowest.shape[:2])
        color_levels = 255 * np.clip(colors, 0, 1)
        below_range = image.lowest[row, column] - color_levels
        above_range = color_levels - image.highest[row, column]
        difference = np.maximum(below_range, above_range).max(axis=1)
        agreement = (_OTHER_COLOR - difference) / (_OTHER_COLOR - _SAME_COLOR)
        num_agreeing[surface_points[is_seen]] += np.clip(agreement, 0, 1)
        num_images[surface_points[is_seen]] += 1
    return num_agreeing / num_images


def _witnesses(scene: Scene, camera: Camera) -> list[tuple[int, SourceView]]:
    """Return the nearest views of the same camera from another place, with their numbers."""
    sources = source_views(scene)
    distance_m, angle_rad = (
        sources.pose_differences(camera) if sources.views else (np.zeros(0), np.zeros(0))
    )
    order = np.argsort(_pose_difference(distance_m, angle_rad), kind="stable").tolist()
    names = {camera.name} if camera.name in sources.names else set(sources.names)
    numbers = [n for n in order if distance_m[n] >= _PARALLAX_M]
    numbers = [n for n in numbers if sources.views[n].camera.name in names][:_NUM_WITNESSES]
    return [(n, sources.views[n]) for n in numbers]


class _RecordedRange(NamedTuple):
    """Range of values of 3x3 pixels of a small recorded image."""

    lowest: np.ndarray
    """Lowest values, float32 [h, w, 3]."""
    highest: np.ndarray
    """Highest values, float32 [h, w, 3]."""


def _recorded_range(scene: Scene, number: int, view: SourceView) -> _RecordedRange | None:
    """Return the ranges of a view's recorded image; None where there is none that can be read."""

    def make() -> tuple[_RecordedRange | None]:
        frames = (frame for frame in _made_from(scene) if frame.index == view.frame)
        path = next((frame.image_paths.get(view.camera.name) for frame in frames), None)
        small = view.camera.scaled(min(1.0, _DEPTH_WIDTH / view.camera.width))
        rgb = None if path is None else read_small_image(Path(path), small)
        if rgb is None:
            return (None,)
        square = np.ones((3, 3), np.uint8)
        lowest = cv2.erode(rgb, square)
        highest = cv2.dilate(rgb, square)
        return (_RecordedRange(lowest.astype(np.float32), highest.astype(np.float32)),)

    return memo_of(scene.as_recorded).get(("trust colours", number), make)[0]


def _points_in_view(
    scene: Scene, camera: Camera, points: _ViewPoints, indices: np.ndarray, view: Camera
) -> np.ndarray:
    """Return column, row and z in a view, [C, 3], of some points that a camera sees.

    Args:
        scene: the scene.
        camera: the camera that sees the points.
        points: the points.
        indices: indices of the points to take, [C].
        view: camera of the view.
    """
    world = points.world[indices]
    owner = points.owner[indices]
    moved_world = _move_with_actors(scene, world, owner, camera.timestamp_ns, view.timestamp_ns)
    return _project_points(view, moved_world)


def _nearest_views(sources: SourceViews, camera: Camera) -> list[tuple[int, SourceView]]:
    """Return the nearest views with their numbers."""
    order = np.argsort(_pose_difference(*sources.pose_differences(camera)), kind="stable")[
        :_NUM_VIEWS
    ]
    return [(n, sources.views[n]) for n in order.tolist()]


def _move_with_actors(
    scene: Scene, points: np.ndarray, owner: np.ndarray, from_ns: int, to_ns: int
) -> np.ndarray:
    """Return points of the world [P, 3] at another time, moved with their actors.

    Points are NaN where their actor is absent at one of the times.

    Args:
        scene: the scene.
        points: the points.
        owner: instance of each point, 0 for the background.
        from_ns: time of the points, which are where the scene has its actors.
        to_ns: time of the result, which is where images recorded the actors.
    """
    moved_points = points.copy()
    for instance in np.unique(owner[owner > 0]):
        is_owned = owner == instance
        pose_before = scene.actors[instance - 1].track.pose_at(from_ns)
        pose_after = _recorded_track(scene, int(instance)).pose_at(to_ns)
        if pose_before is None or pose_after is None:
            moved_points[is_owned] = np.nan
            continue
        turn = (pose_after @ torch.linalg.inv(pose_before)).numpy()
        moved_points[is_owned] = points[is_owned] @ turn[:3, :3].T + turn[:3, 3]
    return moved_points


def _recorded_track(scene: Scene, instance: int) -> Track:
    """Return the track on which images recorded an actor, or the one that it is a copy of."""
    recorded_actors = scene.as_recorded.actors
    source_id = recorded_actors[instance - 1].copy_of
    source_tracks = [actor.track for actor in recorded_actors if actor.track_id == source_id]
    return source_tracks[0] if source_tracks else recorded_actors[instance - 1].track


def _project_points(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Return column and row in pixels, and z, of world points [P, 3]; infinite or NaN behind."""
    pose = camera.camera_from_world.numpy()
    x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).T
    z = np.where(z > 0, z, np.nan)
    return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, z], 1)


def _detail_of_points(camera: Camera, local: np.ndarray, density: np.ndarray) -> np.ndarray:
    """Return how finely a view shows points, 0 to 1; 0 for points outside its image.

    Args:
        camera: camera of the view.
        local: column, row and z of the points in the view, [P, 3].
        density: pixels a metre that are drawn, [P].
    """
    u, v, z = local.T
    # Half a pixel more, because rays of the same camera at another size end at the border itself.
    is_inside = (np.abs(u - camera.width / 2) <= camera.width / 2 + 0.5) & (
        np.abs(v - camera.height / 2) <= camera.height / 2 + 0.5
    )
    magnification = np.where(is_inside, density * z / camera.fx, math.inf)
    # Rounding aside, a view of the same size is no magnification.
    magnification = np.maximum(magnification / (1 + 1e-6), 1)
    sharpness = np.clip(1 - np.log(magnification) / math.log(NO_TRUST_MAGNIFICATION), 0, 1)
    return sharpness * sharpness * (3 - 2 * sharpness)


def _pixels(
    camera: Camera, local: np.ndarray, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of points in an image of a view at another size, inside of it."""
    height, width = shape
    u, v, _ = np.nan_to_num(local).T
    column = np.clip(u * width / camera.width, 0, width - 1).astype(int)
    row = np.clip(v * height / camera.height, 0, height - 1).astype(int)
    return row, column


def _find_hidden(camera: Camera, local: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Return the mask of points that something stands before.

    Args:
        camera: camera of the view.
        local: column, row and z of the points in the view, [P, 3].
        depths: depths of the view, as `_depths`.
    """
    row, column = _pixels(camera, local, depths.shape)
    z = np.nan_to_num(local[:, 2])
    return z > depths[row, column] * (1 + _DEPTH_SHARE) + _DEPTH_M


def _depths(scene: Scene, number: int, camera: Camera, backend: str) -> np.ndarray:
    """Return the farthest z of 3x3 pixels of a view, as recorded; infinite without a surface."""
    scene = scene.as_recorded

    def make() -> np.ndarray:
        small = camera.scaled(min(1.0, _DEPTH_WIDTH / camera.width))
        buffers = (ALPHA, MEDIAN_DEPTH)
        raster = rasterize(scene.parts_for(small), small, buffers=buffers, backend=backend)
        assert raster.alpha is not None and raster.median_depth is not None
        has_surface = raster.alpha >= SURFACE_ALPHA
        z = torch.where(has_surface, raster.median_depth, math.inf).cpu().numpy()
        return cv2.dilate(z, np.ones((3, 3), np.uint8))

    return memo_of(scene).get(("trust depths", number), make)


# ---- Figures of a few views, and sentences on a scene --------------------------------------------


@dataclass(frozen=True)
class ViewTrust:
    """Shares of one judged view, 0 to 1."""

    frame: int
    """Number of the frame."""
    sky: float | None
    """Share of all pixels that the recording shows as sky; None where unknown."""
    sky_covered: float | None
    """Share of the sky with a surface nearer than SKY_FROM_M; None where the sky is unknown or
    absent."""
    ground_open: float | None
    """Share without a surface of the pixels below the horizon, the recording car left out; None
    where there are no such pixels, or up is unknown."""
    ground_leaks: float | None
    """Share of the same pixels that let more than MAX_TRANSMITTANCE of the light through."""
    own_car: float
    """Share of all pixels that show the recording car."""
    reach_m: float | None
    """Distance within which 95 % of the surfaces lie; None without any."""


@dataclass(frozen=True)
class CameraTrust:
    """Facts about the pictures of one camera."""

    name: str
    """Name of the camera."""
    seen_images: int
    """Number of its images that the scene was made from."""
    seen_width_px: int | None
    """Width of the largest of them; None without any."""
    seen_path_m: float
    """Length of the path between them."""
    nearest: NearestView | None
    """Nearest view to the frame that is farthest from any view; None without any."""
    away: tuple[int, ...]
    """Numbers of frames that stand away from all views."""
    views: tuple[ViewTrust, ...]
    """Views that were judged."""
    problems: tuple[str, ...]
    """Sentences; none where the camera is fit."""


@dataclass(frozen=True)
class SceneTrust:
    """Facts about the pictures of a scene."""

    cameras: tuple[CameraTrust, ...]
    """All cameras that were asked for."""
    unknown: tuple[str, ...]
    """Sentences on what could not be judged."""

    @property
    def problems(self) -> tuple[str, ...]:
        """Return the sentences of all cameras, with the cameras' names."""
        names_by_sentence = dict[
            str, list[str]
        ]()  # the same sentence is said once for all its cameras
        for camera in self.cameras:
            for text in camera.problems:
                names_by_sentence.setdefault(text, []).append(camera.name)
        return tuple(f"{', '.join(names)}: {text}" for text, names in names_by_sentence.items())

    def as_dict(self) -> dict[str, Any]:
        """Return the facts for JSON."""
        cameras = [dataclasses.asdict(camera) for camera in self.cameras]
        for entry, camera in zip(cameras, self.cameras, strict=True):
            entry["nearest"] = None if camera.nearest is None else camera.nearest._asdict()
        return {"cameras": cameras, "unknown": list(self.unknown), "problems": list(self.problems)}


def judge_view(scene: Scene, camera: Camera, frame_index: int, *, backend: str = AUTO) -> ViewTrust:
    """Return the figures of a view, at the camera's own size.

    Args:
        scene: the scene; weather does not count.
        camera: the view.
        frame_index: number of its frame.
        backend: the rasteriser's backend.
    """
    view = _render_clear_view(scene, camera, backend)
    is_below_horizon = (view.elevation_rad < -HORIZON_RAD) & ~view.is_own_car
    if not scene.has_known_gravity:
        is_below_horizon &= False
    has_surface = view.has_surface
    sky_covered = None
    if view.sky is not None:
        is_sky = _erode_border(view.sky.is_sky) & ~view.is_own_car
        sky_covered = _share_within(_find_panes(scene, camera, view), is_sky)
    distances_m = (view.z_m * camera.ray_lengths().numpy())[has_surface]
    return ViewTrust(
        frame=frame_index,
        sky=None if view.sky is None else view.sky_share,
        sky_covered=sky_covered,
        ground_open=_share_within(~has_surface, is_below_horizon),
        ground_leaks=_share_within(view.alpha < 1 - MAX_TRANSMITTANCE, is_below_horizon),
        own_car=float(view.is_own_car.mean()),
        reach_m=float(np.quantile(distances_m, 0.95)) if len(distances_m) else None,
    )


def _share_within(mask: np.ndarray, within: np.ndarray) -> float | None:
    """Return the share of the pixels in `within` that `mask` marks; None without such pixels."""
    count = int(within.sum())
    return float((mask & within).sum() / count) if count else None


def judge_scene(
    scene: Scene,
    frames: Sequence[Frame] | None = None,
    cameras: Sequence[str] | None = None,
    *,
    scale: float | None = 1.0,
    count: int = 3,
    backend: str = AUTO,
) -> SceneTrust:
    """Judge the scene as some frames and cameras of it show it.

    The poses of all the frames count.

    Args:
        scene: the scene.
        frames: the frames, of the scene or of a camera path; None for all.
        cameras: names of the cameras; None for all.
        scale: size of the pictures over that of the cameras; None leaves magnification out.
        count: frames of each camera that are drawn, small; those of cameras that were never fitted
            are not drawn.
        backend: the rasteriser's backend.
    """
    scene = pinhole_scene(scene)
    frames = scene.frames if frames is None else pinhole_frames(tuple(frames))
    names = dict.fromkeys(name for frame in frames for name in frame.cameras)
    chosen_names = [name for name in names if cameras is None or name in cameras]
    judged_cameras = tuple(
        _judge_camera(scene, frames, name, scale, count, backend) for name in chosen_names
    )
    unknown = []
    judged_views = [view for camera in judged_cameras for view in camera.views]
    if not source_views(scene).views:
        unknown.append("from where the scene was seen: no camera that it was made from is known")
    if judged_views and all(view.sky_covered is None for view in judged_views):
        unknown.append("whether the sky is empty: no recorded image tells where it is")
    if judged_views and not scene.has_known_gravity:
        unknown.append("whether the ground is closed: it is not known which way is up")
    return SceneTrust(judged_cameras, tuple(unknown))


def _judge_camera(
    scene: Scene, frames: Sequence[Frame], name: str, scale: float | None, count: int, backend: str
) -> CameraTrust:
    """Judge one camera; the arguments are those of `judge_scene`."""
    sources = source_views(scene)
    camera_sources = sources.of_camera(name)
    camera_frames = [f for f in frames if name in f.cameras and not f.cameras[name].is_orthographic]
    nearest_views = {
        f.index: nearest_view(sources, f.cameras[name].scaled(scale or 1.0)) for f in camera_frames
    }
    known_views = {
        index: nearest for index, nearest in nearest_views.items() if nearest is not None
    }
    farthest_view = (
        max(known_views.values(), key=lambda n: _pose_difference(*n[:2])) if known_views else None
    )
    is_unfitted = name in unfitted_cameras(scene)
    frames_away = tuple(
        index
        for index, nearest in known_views.items()
        if scene.has_metric_scale and _is_away(nearest)
    )
    drawn_frames = (
        [camera_frames[(2 * k + 1) * len(camera_frames) // (2 * count)] for k in range(count)]
        if camera_frames
        else []
    )
    drawn_cameras = {} if is_unfitted else {f.index: f.cameras[name] for f in drawn_frames}
    views = list[ViewTrust]()
    failures = list[str]()
    for index, camera in drawn_cameras.items():
        try:
            views.append(judge_view(scene, _shrink_camera(camera), index, backend=backend))
        except Exception as error:  # as in a job: one bad frame is named, and the others go on
            failures.append(f"frame {index} cannot be drawn: {error}")
    centres = [view.camera.centre for view in camera_sources]
    steps = [float((b - a).norm()) for a, b in itertools.pairwise(centres)]
    camera_trust = CameraTrust(
        name=name,
        seen_images=len(camera_sources),
        seen_width_px=max((view.camera.width for view in camera_sources), default=None),
        seen_path_m=sum(steps, 0.0),
        nearest=farthest_view,
        away=frames_away,
        views=tuple(views),
        problems=(),
    )
    problems = failures + _find_problems(camera_trust, is_unfitted, len(camera_frames))
    if farthest_view is not None and scale is not None and not is_unfitted:
        sentence = magnification_sentence(1 / farthest_view.magnification, 1.0)
        problems += [] if sentence is None else [sentence]
    return dataclasses.replace(camera_trust, problems=tuple(problems))


def _shrink_camera(camera: Camera) -> Camera:
    """Return the camera at the size at which views are judged."""
    return camera.scaled(min(1.0, _JUDGED_WIDTH / camera.width))


def _is_away(nearest: NearestView) -> bool:
    """Return True if a view is beyond the limits of distance or angle."""
    return nearest.distance_m > MAX_DISTANCE_M or nearest.angle_rad > MAX_ANGLE_RAD


# Sentences on figures that are beyond their limit, by field of ViewTrust.
_FIGURE_SENTENCES = {
    "ground_open": "{share} of the ground has no surface{where}: fog and water stand in the holes",
    "ground_leaks": f"{{share}} of the ground lets more than {100 * MAX_TRANSMITTANCE:g} % of the "
    "light behind it through{where}",
    "sky_covered": "{share} of the sky, which is {sky} of the image, has a surface nearer than "
    f"{SKY_FROM_M:.0f} m{{where}}: it stands as a pane in fog",
}


def _find_problems(trust: CameraTrust, is_unfitted: bool, num_frames: int) -> list[str]:
    """Return the sentences on what is wrong with a camera's pictures.

    Args:
        trust: facts about the pictures.
        is_unfitted: if True, the scene was never fitted to the camera.
        num_frames: number of the camera's frames.
    """
    sentences = []
    if trust.nearest is not None and (is_unfitted or trust.away):
        where = (
            f"{trust.nearest.distance_m:.1f} m and {math.degrees(trust.nearest.angle_rad):.0f} deg"
        )
        limits = f"{MAX_DISTANCE_M:g} m, {math.degrees(MAX_ANGLE_RAD):.0f} deg"
        if is_unfitted:
            sentences.append(f"never fitted; up to {where} from the nearest image learnt from")
        else:
            sentences.append(
                f"{len(trust.away)} of {num_frames} frames stand away from all images that the "
                f"scene was made from, up to {where} (limit {limits}): {_list_numbers(trust.away)}"
            )
    with_sky = [view for view in trust.views if view.sky is None or view.sky >= MIN_SKY_SHARE]
    worst_views = {
        figure: _find_worst(with_sky if figure == "sky_covered" else trust.views, figure)
        for figure in _FIGURE_SENTENCES
    }
    sky = {view.frame: _percent(view.sky or 0.0) for view in trust.views}
    worst_open = worst_views["ground_open"]
    worst_leaks = worst_views["ground_leaks"]
    if worst_open is not None and worst_leaks is not None and worst_leaks[1] < 2 * worst_open[1]:
        del worst_views["ground_leaks"]  # the light comes mostly through the holes
    for figure, largest in worst_views.items():
        limit = MAX_SKY_COVERED if figure == "sky_covered" else MAX_GROUND_OPEN
        if largest is not None and largest[1] > limit:
            where = f" in frame {largest[0]}, the worst of {len(trust.views)}"
            where += f" (limit {_percent(limit)})"
            shares = {"share": _percent(largest[1]), "sky": sky[largest[0]]}
            sentences.append(_FIGURE_SENTENCES[figure].format(**shares, where=where))
    return sentences


def _find_worst(views: Sequence[ViewTrust], figure: str) -> tuple[int, float] | None:
    """Return frame and value of the view with the largest figure; None without a figure."""
    figures = [(view.frame, getattr(view, figure)) for view in views]
    return max(
        ((f, v) for f, v in figures if v is not None), key=lambda pair: pair[1], default=None
    )


def _percent(share: float) -> str:
    """Return a share as a text in percent."""
    return f"{100 * share:.2g} %" if share < 0.1 else f"{100 * share:.0f} %"


def _list_numbers(numbers: Sequence[int]) -> str:
    """Return the first eight of some numbers as a text."""
    text = ", ".join(map(str, numbers[:8]))
    return text + (f" and {len(numbers) - 8} more" if len(numbers) > 8 else "")
