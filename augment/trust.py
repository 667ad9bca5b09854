"""Whether the pictures of a scene can be believed: from where it was seen, and what it lacks there.

A clear render hides what weather shows: fog fills a hole in the road, and a sheet of sky 15 m away
is a bright pane in it. So a view is judged by the scene itself:

    sky       pixels that the recording shows as sky and that have a surface nearer than 200 m
    ground    pixels below the horizon without a surface (alpha < 0.5), or that let light through
    pose      how far the camera is from those that the scene was made from; never fitted ones
    detail    pixels per metre of the picture over those that the scene was made from
    support   colours that recorded images from other places show at the same points

`trust_mask` says it of every pixel, `judge_scene` of a few small views, in figures and sentences.
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

from augment.cameras import Camera, Frame
from augment.labels import EGO_VEHICLE
from augment.memo import memo_of
from augment.recorded_sky import (
    WORK_WIDTH,
    RecordedSky,
    elevation_rad,
    read_small_image,
    recorded_sky,
)
from augment.render.buffers import ALPHA, AUTO, MEDIAN_DEPTH, RGB, SPLAT_IDS
from augment.render.rasterize import rasterize
from augment.scene import Scene
from augment.view_images import SURFACE_ALPHA

SKY_FROM_M = 200.0  # a surface this far fades in any fog and casts no pane
MAX_TRANSMITTANCE = 0.02  # below the horizon: 5/255 of a white fog shine through
MIN_GROUND_ALPHA = 0.9  # of a pixel that can be believed: a tenth of white fog is 20/255 and shows
# 1 % of the sky or the ground of a 480x270 picture is a patch of 25x25 pixels: a car 40 m away.
MAX_SKY_COVERED = MAX_GROUND_OPEN = 0.01
MIN_SKY_SHARE = 0.05  # of an image: where it shows less sky, pale walls are taken for it
HORIZON_RAD = math.radians(1.5)  # roads slope, and poses are off by as much
MAX_MAGNIFICATION = 1.5  # nothing finer was learnt; thin splats become needles
NO_TRUST_MAGNIFICATION = 4.0  # from here on a pixel's detail is invented; trust falls from 1.0 on
MAX_DISTANCE_M = 2.0  # half a lane and more: the sides of parked cars appear that nobody has seen
MAX_ANGLE_RAD = math.radians(15)  # a quarter of a camera 60 degrees wide looks past what it saw

_GRID_WIDTH = 320  # columns of the points that are looked for in the views of the scene
_DEPTH_WIDTH = 240  # and of these views' depths
_SKY_POINT_M = 1e4
_DEPTH_SHARE, _DEPTH_M = 0.05, 0.5  # a point so little behind what a view shows is seen by it
_NUM_VIEWS = 24  # the nearest are asked: what they have not seen, those farther away saw worse
_MIN_POINTS = 0.001  # of all: for fewer, a view's depths are not drawn
_MIN_GAIN = 0.1  # of a point's trust, for which one more view is asked
# Images whose colours are compared: of the same camera, from elsewhere, the nearest of them.
_PARALLAX_M = 1.0  # a floating splat 5 m away moves by 50 pixels of 240 against what is behind it
_NUM_WITNESSES = 4
# Of 255: colours that differ by less are the same, by more are another thing's.
_SAME_COLOR = 24.0
_OTHER_COLOR = 64.0


# ---- From where a scene was seen -----------------------------------------------------------------


class FitRecord(BaseModel):
    """`Scene.made_by["fitted"]`: what a scene was fitted to. scale: of the images learnt from over
    the recorded ones. views: frame numbers by camera, those held out left out.
    """

    model_config = ConfigDict(frozen=True, strict=True, allow_inf_nan=False)

    scale: Annotated[float, Field(gt=0, le=1)]
    views: dict[str, list[int]]


@dataclass(frozen=True, eq=False)
class SeenView:
    """An image that the scene was made from. camera: at the size that was learnt from, which is
    `scale` of the recorded one.
    """

    frame: int
    camera: Camera
    scale: float = 1.0


@dataclass(frozen=True, eq=False)
class Seen:
    """The images that a scene was made from; none where they are not known."""

    views: tuple[SeenView, ...]
    is_fit: bool

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(view.camera.name for view in self.views))

    def of(self, name: str) -> tuple[SeenView, ...]:
        return tuple(view for view in self.views if view.camera.name == name)

    @functools.cached_property
    def scale(self) -> float | None:
        """Of the smallest of the images over its camera; None where no view is known."""
        return min((view.scale for view in self.views), default=None)

    @functools.cached_property
    def poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Centres and optical axes, float64 [V, 3] each."""
        cameras = [view.camera for view in self.views]
        centres = np.array([c.centre.numpy() for c in cameras]).reshape(-1, 3)
        axes = np.array([c.camera_from_world.numpy()[2, :3] for c in cameras]).reshape(-1, 3)
        return centres, axes

    def away(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """How far a camera is from each view: metres and radians, [V] each."""
        centres, axes = self.poses
        cosine = axes @ camera.camera_from_world.numpy()[2, :3]
        distance_m = np.linalg.norm(centres - camera.centre.numpy(), axis=1)
        return distance_m, np.arccos(np.clip(cosine, -1, 1))


class Nearest(NamedTuple):
    """The seen view nearest to a camera. magnification: pixels of the camera for one of its own, of
    the same thing.
    """

    distance_m: float
    angle_rad: float
    magnification: float


def seen_views(scene: Scene) -> Seen:
    """Of a fitted scene what it was fitted to, as its files say; else all that was recorded."""
    return memo_of(scene).get("seen views", lambda: _find_seen(scene))


def unfitted_cameras(scene: Scene) -> tuple[str, ...]:
    """The recorded cameras that a fit has never learnt from."""
    seen = seen_views(scene)
    if not seen.is_fit or not seen.views:
        return ()
    known = dict.fromkeys(name for frame in _made_from(scene) for name in frame.cameras)
    return tuple(name for name in known if name not in seen.names)


def _made_from(scene: Scene) -> tuple[Frame, ...]:
    return scene.frames if scene.seen_frames is None else scene.seen_frames


def left_out_sentence(names: Sequence[str], how: str) -> str:
    """What a job says of cameras that it leaves out. how: what renders them all the same."""
    return (
        f"left out: {', '.join(names)}, to whose images the scene was never fitted; {how} renders "
        f"them too"
    )


def magnified_sentence(learnt_scale: float | None, scale: float) -> str | None:
    """What is wrong with pictures at a scale; None where nothing is."""
    if learnt_scale is None or scale <= MAX_MAGNIFICATION * learnt_scale:
        return None
    return (
        f"rendered {scale / learnt_scale:.1f} times as large as it was learnt (limit "
        f"{MAX_MAGNIFICATION:g}): nothing finer was learnt, and thin splats may show as "
        f"needles; render smaller, or fit larger"
    )


def nearest_view(seen: Seen, camera: Camera) -> Nearest | None:
    """By distance, with a metre for every 7.5 degrees; None where no view is known."""
    if not seen.views:
        return None
    distance_m, angle_rad = seen.away(camera)
    best = int(np.argmin(_away(distance_m, angle_rad)))
    magnification = camera.fx / seen.views[best].camera.fx
    return Nearest(float(distance_m[best]), float(angle_rad[best]), magnification)


def _away(distance_m: Any, angle_rad: Any) -> Any:
    return distance_m / MAX_DISTANCE_M + angle_rad / MAX_ANGLE_RAD


def _find_seen(scene: Scene) -> Seen:
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
                    views.append(SeenView(frame.index, camera.scaled(fit.scale), fit.scale))
            elif name in frame.image_paths or not has_images:
                views.append(SeenView(frame.index, camera))
    return Seen(tuple(views), fit is not None)


def _fit_record(made_by: Mapping[str, Any], frames: Sequence[Frame]) -> FitRecord | None:
    """None of a scene that was not fitted, or that says nothing usable of it. Scenes of before
    there was a record tell by the settings of their fit.
    """
    given = made_by.get("fitted")
    if given is None and isinstance(settings := made_by.get("settings"), dict):
        cameras, scale = settings.get("cameras"), settings.get("scale")
        held_out = re.fullmatch(r"every-(\d{1,6})(st|nd|rd|th)", str(settings.get("holdout")))
        step = int(held_out[1]) if held_out else 0
        left_out = {frame.index for frame in frames[step - 1 :: step]} if step else set()
        names = {name for frame in frames for name in frame.cameras}
        if cameras != "all":
            names &= set(str(cameras).split(","))
        learnt = [frame for frame in frames if frame.index not in left_out]
        views = {n: [f.index for f in learnt if n in f.cameras] for n in sorted(names)}
        given = {"scale": scale, "views": views}
    try:
        return None if given is None else FitRecord.model_validate(given)
    except ValidationError:
        return None


# ---- One view, pixel by pixel --------------------------------------------------------------------


class _Look(NamedTuple):
    """A view of the scene without weather. alpha, z_m [H, W]: z of its surfaces. owner: instance of
    the heaviest splat, 0 for the background. is_own_car: where that is the recording car.
    elevation_rad: of the rays. sky: what the recording shows as sky, None where that is unknown.
    rgb: of the surfaces [H, W, 3], 0 to 1 in the scene's colours; None where nobody asked.
    """

    alpha: Float[np.ndarray, "H W"]
    z_m: Float[np.ndarray, "H W"]
    owner: Int[np.ndarray, "H W"]
    is_own_car: Bool[np.ndarray, "H W"]
    elevation_rad: Float[np.ndarray, "H W"]
    sky: RecordedSky | None
    rgb: Float[np.ndarray, "H W 3"] | None

    @property
    def sky_share(self) -> float:
        """The share of the image that the recording shows as sky; 0 where that is unknown."""
        return 0.0 if self.sky is None else float(self.sky.sky.mean())

    @property
    def has_surface(self) -> Bool[np.ndarray, "H W"]:
        return self.alpha >= SURFACE_ALPHA


def trust_mask(scene: Scene, camera: Camera, *, backend: str = AUTO) -> UInt8[np.ndarray, "H W"]:
    """How far each pixel of a view can be believed, from 0, not at all, to 255.

    The product of three parts:

    - 1 where the pixel shows a surface or the sky, in the right place, and below the horizon a
      surface of MIN_GROUND_ALPHA; else 0;
    - by the image that has seen the same unhidden at most pixels a metre: 1 where those are as many
      as are drawn, 0 from NO_TRUST_MAGNIFICATION times fewer on, smooth between;
    - the share of images that show the surface's colour at its place: of this view and of up to
      _NUM_WITNESSES of the same camera, at least _PARALLAX_M away, that see it. Splats that stand
      where nothing is, fitted to one image, are contradicted by the others.

    Args:
        scene: weather does not count. Of a scene whose views are not known no pixel is seen.
        camera: as rendered. In an orthographic camera no pixel is seen.
    """
    if camera.is_orthographic:
        return np.zeros((camera.height, camera.width), np.uint8)
    pose = camera.camera_from_world.numpy().tobytes()
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    key = "trust", camera.name, camera.timestamp_ns, camera.width, camera.height, intrinsics, pose
    return memo_of(scene).get(
        key, lambda: _trusted(scene, camera, _look(scene, camera, backend, True), backend)
    )


def _look(scene: Scene, camera: Camera, backend: str, with_rgb: bool = False) -> _Look:
    parts = scene.parts_for(camera)
    buffers = (ALPHA, MEDIAN_DEPTH, SPLAT_IDS, *((RGB,) if with_rgb else ()))
    raster = rasterize(parts, camera, buffers=buffers, backend=backend)
    assert raster.alpha is not None
    assert raster.median_depth is not None and raster.splat_ids is not None
    ends = np.cumsum([len(part.gaussians) for part in parts])
    part_of = np.searchsorted(ends, raster.splat_ids.cpu().numpy(), side="right")  # -1: the first
    instances = np.array([part.instance_id for part in parts])
    own_car = [1 + i for i, actor in enumerate(scene.actors) if actor.label == EGO_VEHICLE]
    alpha, owner = raster.alpha.cpu().numpy(), instances[part_of]
    return _Look(
        alpha=alpha,
        z_m=raster.median_depth.cpu().numpy(),
        owner=owner,
        is_own_car=np.isin(owner, own_car) & (alpha >= SURFACE_ALPHA),
        elevation_rad=elevation_rad(camera),
        sky=_sky_of(scene, camera),
        rgb=None if raster.rgb is None else _opaque(raster.rgb.cpu().numpy(), alpha),
    )


def _opaque(rgb: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """The colours of surfaces from those weighted by their alpha."""
    return rgb / np.maximum(alpha, SURFACE_ALPHA)[..., None]


def _sky_of(scene: Scene, camera: Camera) -> RecordedSky | None:
    """By the recorded image that was taken there and then."""
    for frame in _made_from(scene):
        own = frame.cameras.get(camera.name)
        if own is not None and own.timestamp_ns == camera.timestamp_ns and _same_pose(own, camera):
            sky = recorded_sky(scene, frame, camera.name)
            if sky is None:
                return None
            return RecordedSky(*(_enlarged(mask, camera) for mask in sky))
    return None


def _enlarged(mask: np.ndarray, camera: Camera) -> np.ndarray:
    size = camera.width, camera.height
    return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0


def _inner(mask: np.ndarray) -> np.ndarray:
    """Without its border, which was cut in a small image."""
    side = 1 + 2 * max(1, round(mask.shape[1] / WORK_WIDTH))
    return cv2.erode(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0


def _same_pose(a: Camera, b: Camera) -> bool:
    return torch.allclose(a.camera_from_world, b.camera_from_world, rtol=0, atol=1e-6)


def _trusted(scene: Scene, camera: Camera, look: _Look, backend: str) -> np.ndarray:
    surface, below = look.has_surface, look.elevation_rad < -HORIZON_RAD
    open_sky = look.elevation_rad > 0
    solid = surface & ~(below & (look.alpha < MIN_GROUND_ALPHA))
    if look.sky is not None:
        open_sky &= ~_inner(look.sky.solid)
        if look.sky_share >= MIN_SKY_SHARE:
            solid &= ~_pane(scene, camera, look)
    is_fit = np.where(surface, solid, open_sky)
    points = _points(camera, look)
    trust = _seen_detail(scene, camera, points, backend)
    trust *= _support(scene, camera, look, points, backend)
    steps = np.rint(255 * trust.reshape(points.grid.height, points.grid.width)).astype(np.uint8)
    size = camera.width, camera.height
    return cv2.resize(steps, size, interpolation=cv2.INTER_NEAREST) * is_fit


def _pane(scene: Scene, camera: Camera, look: _Look) -> np.ndarray:
    """Where a surface stands before the sky."""
    assert look.sky is not None
    distance_m = look.z_m * camera.ray_lengths().numpy()
    is_near = distance_m < (SKY_FROM_M if scene.has_metric_scale else math.inf)
    return _inner(look.sky.sky) & look.has_surface & is_near


class _Points(NamedTuple):
    """What the pixels of a grid show, P points. grid: the camera at the grid's size. world [P, 3]:
    metres. owner [P]: instance whose point it is, 0 for the background. density [P]: pixels a metre
    that are drawn. has_surface [P]: others are sky, far away.
    """

    grid: Camera
    world: np.ndarray
    owner: np.ndarray
    density: np.ndarray
    has_surface: np.ndarray


def _points(camera: Camera, look: _Look) -> _Points:
    columns = min(_GRID_WIDTH, camera.width)
    grid = camera.resized(columns, max(1, round(camera.height * columns / camera.width)))
    rows_of = ((np.arange(grid.height) + 0.5) * camera.height / grid.height).astype(int)
    columns_of = ((np.arange(grid.width) + 0.5) * camera.width / grid.width).astype(int)
    at = np.ix_(rows_of, columns_of)
    surface, owner = look.has_surface[at].ravel(), look.owner[at].ravel()
    rays = camera.ray_directions(torch.float64).numpy()[at].reshape(-1, 3)
    z_m = np.where(surface, look.z_m[at].ravel(), _SKY_POINT_M)
    return _Points(
        grid=grid,
        world=camera.centre.numpy() + z_m[:, None] * rays,
        owner=np.where(surface, owner, 0),
        density=camera.fx / np.maximum(z_m, 1e-6),
        has_surface=surface,
    )


def _seen_detail(scene: Scene, camera: Camera, points: _Points, backend: str) -> np.ndarray:
    """How finely some view of the scene has seen each point unhidden, 0 to 1, [P]."""
    trust = np.zeros(len(points.world))
    all_seen = seen_views(scene)
    for number, view in _nearest_views(all_seen, camera):
        left = np.flatnonzero(trust < 1 - _MIN_GAIN)
        if len(left) == 0:
            break
        local = _seen_from(scene, camera, points, left, view.camera)
        detail = _detail(view.camera, local, points.density[left])
        gains = detail > trust[left] + _MIN_GAIN
        if not (
            camera.timestamp_ns == view.camera.timestamp_ns and _same_pose(view.camera, camera)
        ):
            if gains.sum() < _MIN_POINTS * len(trust):
                continue
            gains &= ~_hidden(view.camera, local, _depths(scene, number, view.camera, backend))
        trust[left[gains]] = detail[gains]
    return trust


def _support(
    scene: Scene, camera: Camera, look: _Look, points: _Points, backend: str
) -> np.ndarray:
    """The share of images that show each point's colour at its place, [P]: of those that see it,
    and of this view, which counts as one that does.
    """
    assert look.rgb is not None
    size = points.grid.width, points.grid.height
    rgb = cv2.resize(look.rgb, size, interpolation=cv2.INTER_AREA).reshape(-1, 3)
    agreeing, asked = np.ones(len(rgb)), np.ones(len(rgb))
    surface = np.flatnonzero(points.has_surface)
    for number, view in _witnesses(scene, camera):
        image = _recorded_range(scene, number, view)
        if image is None:
            continue
        local = _seen_from(scene, camera, points, surface, view.camera)
        sees = _detail(view.camera, local, points.density[surface]) > 0
        sees &= ~_hidden(view.camera, local, _depths(scene, number, view.camera, backend))
        colors = rgb[surface[sees]]
        color_map = scene.color_map(view.camera)
        if color_map is not None:
            colors = colors @ color_map[:, :3].numpy().T + color_map[:, 3].numpy()
        row, column = _pixels(view.camera, local[sees], image.lowest.shape[:2])
        steps = 255 * np.clip(colors, 0, 1)
        below, above = image.lowest[row, column] - steps, steps - image.highest[row, column]
        apart = np.maximum(below, above).max(axis=1)
        share = (_OTHER_COLOR - apart) / (_OTHER_COLOR - _SAME_COLOR)
        agreeing[surface[sees]] += np.clip(share, 0, 1)
        asked[surface[sees]] += 1
    return agreeing / asked


def _witnesses(scene: Scene, camera: Camera) -> list[tuple[int, SeenView]]:
    """The nearest views of the same camera from another place, with their numbers."""
    seen = seen_views(scene)
    distance_m, angle_rad = seen.away(camera) if seen.views else (np.zeros(0), np.zeros(0))
    order = np.argsort(_away(distance_m, angle_rad), kind="stable").tolist()
    names = {camera.name} if camera.name in seen.names else set(seen.names)
    found = [n for n in order if distance_m[n] >= _PARALLAX_M]
    found = [n for n in found if seen.views[n].camera.name in names][:_NUM_WITNESSES]
    return [(n, seen.views[n]) for n in found]


class _RecordedRange(NamedTuple):
    """The lowest and highest values of 3x3 pixels of a small recorded image, float32 [h, w, 3]."""

    lowest: np.ndarray
    highest: np.ndarray


def _recorded_range(scene: Scene, number: int, view: SeenView) -> _RecordedRange | None:
    """Of the recorded image of a view; None where there is none that can be read."""

    def make() -> tuple[_RecordedRange | None]:
        frames = (frame for frame in _made_from(scene) if frame.index == view.frame)
        path = next((frame.image_paths.get(view.camera.name) for frame in frames), None)
        small = view.camera.scaled(min(1.0, _DEPTH_WIDTH / view.camera.width))
        rgb = None if path is None else read_small_image(Path(path), small)
        if rgb is None:
            return (None,)
        around = np.ones((3, 3), np.uint8)
        lowest, highest = cv2.erode(rgb, around), cv2.dilate(rgb, around)
        return (_RecordedRange(lowest.astype(np.float32), highest.astype(np.float32)),)

    return memo_of(scene).get(("trust colours", number), make)[0]


def _seen_from(
    scene: Scene, camera: Camera, points: _Points, chosen: np.ndarray, view: Camera
) -> np.ndarray:
    """Column, row and z in a view of some points [C] of those that a camera sees, [C, 3]."""
    world, owner = points.world[chosen], points.owner[chosen]
    then = _moved(scene, world, owner, camera.timestamp_ns, view.timestamp_ns)
    return _in_camera(view, then)


def _nearest_views(seen: Seen, camera: Camera) -> list[tuple[int, SeenView]]:
    """The nearest views with their numbers."""
    order = np.argsort(_away(*seen.away(camera)), kind="stable")[:_NUM_VIEWS]
    return [(n, seen.views[n]) for n in order.tolist()]


def _moved(
    scene: Scene, points: np.ndarray, owner: np.ndarray, from_ns: int, to_ns: int
) -> np.ndarray:
    """Points of the world [P, 3] of actors at another time; NaN where their actor is not there."""
    moved = points.copy()
    for instance in np.unique(owner[owner > 0]):
        track, own = scene.actors[instance - 1].track, owner == instance
        before, after = track.pose_at(from_ns), track.pose_at(to_ns)
        if before is None or after is None:
            moved[own] = np.nan
            continue
        turn = (after @ torch.linalg.inv(before)).numpy()
        moved[own] = points[own] @ turn[:3, :3].T + turn[:3, 3]
    return moved


def _in_camera(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Column and row in pixels, and z, of points [P, 3] of the world; infinite or NaN behind it."""
    pose = camera.camera_from_world.numpy()
    x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).T
    z = np.where(z > 0, z, np.nan)
    return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, z], 1)


def _detail(camera: Camera, local: np.ndarray, density: np.ndarray) -> np.ndarray:
    """How finely a view shows points, 0 to 1; 0 of those outside its image. density: pixels a metre
    that are drawn.
    """
    u, v, z = local.T
    # Half a pixel more: rays of the same camera at another size end at the border itself.
    inside = (np.abs(u - camera.width / 2) <= camera.width / 2 + 0.5) & (
        np.abs(v - camera.height / 2) <= camera.height / 2 + 0.5
    )
    magnification = np.where(inside, density * z / camera.fx, math.inf)
    # Rounding aside, a view of the same size is no magnification.
    magnification = np.maximum(magnification / (1 + 1e-6), 1)
    part = np.clip(1 - np.log(magnification) / math.log(NO_TRUST_MAGNIFICATION), 0, 1)
    return part * part * (3 - 2 * part)


def _pixels(
    camera: Camera, local: np.ndarray, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of points in an image of a view at another size, inside of it."""
    height, width = shape
    u, v, _ = np.nan_to_num(local).T
    column = np.clip(u * width / camera.width, 0, width - 1).astype(int)
    row = np.clip(v * height / camera.height, 0, height - 1).astype(int)
    return row, column


def _hidden(camera: Camera, local: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Which points something stands before. depths: of `_depths`."""
    row, column = _pixels(camera, local, depths.shape)
    z = np.nan_to_num(local[:, 2])
    return z > depths[row, column] * (1 + _DEPTH_SHARE) + _DEPTH_M


def _depths(scene: Scene, number: int, camera: Camera, backend: str) -> np.ndarray:
    """What a view shows at most: the farthest z of 3x3 pixels; infinite where there is none."""

    def make() -> np.ndarray:
        small = camera.scaled(min(1.0, _DEPTH_WIDTH / camera.width))
        buffers = (ALPHA, MEDIAN_DEPTH)
        raster = rasterize(scene.parts_for(small), small, buffers=buffers, backend=backend)
        assert raster.alpha is not None and raster.median_depth is not None
        has_surface = raster.alpha >= SURFACE_ALPHA
        z = torch.where(has_surface, raster.median_depth, math.inf).cpu().numpy()
        return cv2.dilate(z, np.ones((3, 3), np.uint8))

    return memo_of(scene).get(("trust depths", number), make)


# ---- A few views in figures, and a scene in sentences --------------------------------------------


@dataclass(frozen=True)
class ViewTrust:
    """Shares of one judged view, 0 to 1. sky: of all pixels, what the recording shows as sky; None
    where that is unknown. sky_covered: of the sky, what has a surface nearer than SKY_FROM_M; None
    where the sky is unknown or absent. ground_open, ground_leaks: of what lies
    below the horizon, the recording car left out, what has no surface, and what lets more than
    MAX_TRANSMITTANCE of the light through; None where nothing lies there or up is unknown.
    own_car: of all pixels. reach_m: distance within which 95 % of the surfaces lie; None without
    any.
    """

    frame: int
    sky: float | None
    sky_covered: float | None
    ground_open: float | None
    ground_leaks: float | None
    own_car: float
    reach_m: float | None


@dataclass(frozen=True)
class CameraTrust:
    """What is known of a camera's pictures. seen_images, seen_width_px, seen_path_m: of its images
    that the scene was made from. nearest: of the frame that is farthest from any of them. away:
    frames whose poses are. views: that were judged. problems: sentences, none where it is fit.
    """

    name: str
    seen_images: int
    seen_width_px: int | None
    seen_path_m: float
    nearest: Nearest | None
    away: tuple[int, ...]
    views: tuple[ViewTrust, ...]
    problems: tuple[str, ...]


@dataclass(frozen=True)
class SceneTrust:
    """cameras: all that were asked for. problems: of all, with the cameras' names; and what could
    not be judged.
    """

    cameras: tuple[CameraTrust, ...]
    unknown: tuple[str, ...]

    @property
    def problems(self) -> tuple[str, ...]:
        cameras = dict[str, list[str]]()  # by sentence: the same of all is said once
        for own in self.cameras:
            for text in own.problems:
                cameras.setdefault(text, []).append(own.name)
        return tuple(f"{', '.join(names)}: {text}" for text, names in cameras.items())

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        cameras = [dataclasses.asdict(own) for own in self.cameras]
        for entry, own in zip(cameras, self.cameras, strict=True):
            entry["nearest"] = None if own.nearest is None else own.nearest._asdict()
        return {"cameras": cameras, "unknown": list(self.unknown), "problems": list(self.problems)}


def judge_view(scene: Scene, camera: Camera, frame_index: int, *, backend: str = AUTO) -> ViewTrust:
    """The figures of a view, at the camera's own size."""
    look = _look(scene, camera, backend)
    below = (look.elevation_rad < -HORIZON_RAD) & ~look.is_own_car
    if not scene.has_known_gravity:
        below &= False
    surface, covered = look.has_surface, None
    if look.sky is not None:
        inner = _inner(look.sky.sky) & ~look.is_own_car
        covered = _share(_pane(scene, camera, look), inner)
    distances_m = (look.z_m * camera.ray_lengths().numpy())[surface]
    return ViewTrust(
        frame=frame_index,
        sky=None if look.sky is None else look.sky_share,
        sky_covered=covered,
        ground_open=_share(~surface, below),
        ground_leaks=_share(look.alpha < 1 - MAX_TRANSMITTANCE, below),
        own_car=float(look.is_own_car.mean()),
        reach_m=float(np.quantile(distances_m, 0.95)) if len(distances_m) else None,
    )


def _share(what: np.ndarray, within: np.ndarray) -> float | None:
    count = int(within.sum())
    return float((what & within).sum() / count) if count else None


def judge_scene(
    scene: Scene,
    frames: Sequence[Frame] | None = None,
    cameras: Sequence[str] | None = None,
    *,
    scale: float | None = 1.0,
    count: int = 3,
    backend: str = AUTO,
) -> SceneTrust:
    """The scene as some frames and cameras of it show it; all, where these are None.

    scale: of the pictures over the cameras; None leaves magnification out. count: how many frames
    of each camera are drawn, small; those of cameras that were never fitted are not. The poses of
    all frames count.
    """
    frames = scene.frames if frames is None else frames
    names = dict.fromkeys(name for frame in frames for name in frame.cameras)
    chosen = [name for name in names if cameras is None or name in cameras]
    judged = tuple(_judge_camera(scene, frames, name, scale, count, backend) for name in chosen)
    unknown = []
    drawn = [view for own in judged for view in own.views]
    if not seen_views(scene).views:
        unknown.append("from where the scene was seen: no camera that it was made from is known")
    if drawn and all(view.sky_covered is None for view in drawn):
        unknown.append("whether the sky is empty: no recorded image tells where it is")
    if drawn and not scene.has_known_gravity:
        unknown.append("whether the ground is closed: it is not known which way is up")
    return SceneTrust(judged, tuple(unknown))


def _judge_camera(
    scene: Scene, frames: Sequence[Frame], name: str, scale: float | None, count: int, backend: str
) -> CameraTrust:
    seen = seen_views(scene)
    own = seen.of(name)
    held = [f for f in frames if name in f.cameras and not f.cameras[name].is_orthographic]
    poses = {f.index: nearest_view(seen, f.cameras[name].scaled(scale or 1.0)) for f in held}
    known = {index: near for index, near in poses.items() if near is not None}
    farthest = max(known.values(), key=lambda n: _away(*n[:2])) if known else None
    is_unfitted = name in unfitted_cameras(scene)
    away = tuple(
        index for index, near in known.items() if scene.has_metric_scale and _is_away(near)
    )
    middles = [held[(2 * k + 1) * len(held) // (2 * count)] for k in range(count)] if held else []
    drawn = {} if is_unfitted else {f.index: f.cameras[name] for f in middles}
    views, failed = list[ViewTrust](), list[str]()
    for index, camera in drawn.items():
        try:
            views.append(judge_view(scene, _small(camera), index, backend=backend))
        except Exception as error:  # as in a job: one bad frame is named, and the others go on
            failed.append(f"frame {index} cannot be drawn: {error}")
    centres = [view.camera.centre for view in own]
    steps = [float((b - a).norm()) for a, b in itertools.pairwise(centres)]
    found = CameraTrust(
        name=name,
        seen_images=len(own),
        seen_width_px=max((view.camera.width for view in own), default=None),
        seen_path_m=sum(steps, 0.0),
        nearest=farthest,
        away=away,
        views=tuple(views),
        problems=(),
    )
    problems = failed + _problems(found, is_unfitted, len(held))
    if farthest is not None and scale is not None and not is_unfitted:
        magnified = magnified_sentence(1 / farthest.magnification, 1.0)
        problems += [] if magnified is None else [magnified]
    return dataclasses.replace(found, problems=tuple(problems))


def _small(camera: Camera) -> Camera:
    return camera.scaled(min(1.0, WORK_WIDTH / camera.width))


def _is_away(nearest: Nearest) -> bool:
    return nearest.distance_m > MAX_DISTANCE_M or nearest.angle_rad > MAX_ANGLE_RAD


_LACKS = {  # by figure of ViewTrust
    "ground_open": "{share} of the ground has no surface{where}: fog and water stand in the holes",
    "ground_leaks": f"{{share}} of the ground lets more than {100 * MAX_TRANSMITTANCE:g} % of the "
    "light behind it through{where}",
    "sky_covered": "{share} of the sky, which is {sky} of the image, has a surface nearer than "
    f"{SKY_FROM_M:.0f} m{{where}}: it stands as a pane in fog",
}


def _problems(own: CameraTrust, is_unfitted: bool, frames: int) -> list[str]:
    found = []
    if own.nearest is not None and (is_unfitted or own.away):
        where = f"{own.nearest.distance_m:.1f} m and {math.degrees(own.nearest.angle_rad):.0f} deg"
        limits = f"{MAX_DISTANCE_M:g} m, {math.degrees(MAX_ANGLE_RAD):.0f} deg"
        if is_unfitted:
            found.append(f"never fitted; up to {where} from the nearest image learnt from")
        else:
            found.append(
                f"{len(own.away)} of {frames} frames stand away from all images that the scene was "
                f"made from, up to {where} (limit {limits}): {_listed(own.away)}"
            )
    with_sky = [view for view in own.views if view.sky is None or view.sky >= MIN_SKY_SHARE]
    worst = {
        figure: _worst(with_sky if figure == "sky_covered" else own.views, figure)
        for figure in _LACKS
    }
    sky = {view.frame: _percent(view.sky or 0.0) for view in own.views}
    hole, leak = worst["ground_open"], worst["ground_leaks"]
    if hole is not None and leak is not None and leak[1] < 2 * hole[1]:
        del worst["ground_leaks"]  # it is mostly the holes
    for figure, largest in worst.items():
        limit = MAX_SKY_COVERED if figure == "sky_covered" else MAX_GROUND_OPEN
        if largest is not None and largest[1] > limit:
            where = f" in frame {largest[0]}, the worst of {len(own.views)}"
            where += f" (limit {_percent(limit)})"
            shares = {"share": _percent(largest[1]), "sky": sky[largest[0]]}
            found.append(_LACKS[figure].format(**shares, where=where))
    return found


def _worst(views: Sequence[ViewTrust], figure: str) -> tuple[int, float] | None:
    """Frame and value of the largest."""
    known = [(view.frame, getattr(view, figure)) for view in views]
    return max(((f, v) for f, v in known if v is not None), key=lambda pair: pair[1], default=None)


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 0.1 else f"{100 * share:.0f} %"


def _listed(numbers: Sequence[int]) -> str:
    shown = ", ".join(map(str, numbers[:8]))
    return shown + (f" and {len(numbers) - 8} more" if len(numbers) > 8 else "")
