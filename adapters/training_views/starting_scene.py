"""What reconstruction starts from: the scene of a recording, and what its sensors leave out.

Walls go on above the LiDAR's view, and the recording car's own bonnet or roof stands before some
cameras. It becomes an actor that travels with the camera: else it would be learnt into the road
below, anew in every frame. It stands still in the image, so its true distance cannot be told from
the images, and need not be: it is put near the camera, where nothing else is and other cameras do
not look.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from adapters.lidar_scene.image_views import Observations
from adapters.lidar_scene.surfels import SplatShape, Surfels, edges_at, gaussians_from_surfels
from adapters.training_views.views import RecordedViews
from augment.cameras import Camera
from augment.geometry import rigid, rotmat_from_quat
from augment.labels import EGO_VEHICLE
from augment.reconstruct.view import RecordedView, ViewKey, ViewSource
from augment.render.buffers import ALPHA, MEDIAN_DEPTH, SPLAT_IDS
from augment.render.rasterize import rasterize
from augment.scene import Actor, Gaussians, Scene, Track
from augment.semantics import SemanticClass
from augment.semantics import SemanticClass as Class

logger = logging.getLogger(__name__)

# ---- Upper walls, trees and poles that only the images show --------------------------------------
# What stands above the LiDAR's highest channel would be painted on the sky and drift under
# parallax. Where the drawn surface of an image ends near that channel it is taken to go straight
# up. All views vote on every piece: it is kept where several show one colour that is not their
# sky's, and none looks through it.

LIDAR_REACH_M = 60.0  # the LiDAR meets a wall this far away, if nothing hides it
LIDAR_MARGIN_RAD = math.radians(4.0)  # the camera is not where the LiDAR is
COARSE_WIDTH = 320  # columns: walls are continued in cells wider than its pixels
_COLUMN_PX = 2.0  # width of a sector of azimuth, coarse pixels
_SOLID_ALPHA = 0.5
_NEAR_M, _FAR_M = 2.0, 80.0
_SHIFT = 4  # colours are compared in steps of 2^_SHIFT levels
_SIDE = 256 >> _SHIFT
_ENOUGH_SKY = 400  # coarse pixels of sure sky that make an image's own colours
_RARE = 0.003  # part of the commonest sky colour's count below which a colour is no sky
_NO_WALL = np.array(
    [
        Class.ROAD, Class.LANE_MARKING, Class.SIDEWALK, Class.TERRAIN,
        Class.VEHICLE, Class.TWO_WHEELER, Class.PEDESTRIAN,
    ]
)  # fmt: skip
MIN_VIEWS = 3  # that must show a place where a wall goes on, and a piece of it
_SKY_PART, _SEEN_PAST_PART = 0.3, 0.3  # of the views of a piece, that end the wall
_SPREAD_LEVELS = 28.0  # of 255: median deviation from the median colour of one surface
_GAP_M = 0.8  # of pieces in a row that fail end a column; a window that mirrors the sky is lower
_NEARER, _NEARER_M = 0.03, 0.3  # tolerance of depth comparisons, relative and in metres
_FEATHER = 0.1  # scores fall over this part of the image towards its border
MAX_VIEWS = 300  # as many are looked at, evenly over the drive: what is coarse needs no more
VOXEL_M = 0.08
_RIM_MARGIN_RAD = math.radians(3.0)
_MAX_GAUSSIANS = 40_000
_HEIGHT_M = 30.0  # above the lowest camera
_SHAPE = SplatShape(opacity=0.6)  # hides most of the sky, yet gives way while it is learnt


@dataclass(frozen=True, eq=False)
class Rims:
    """Topmost points of surfaces that probably go on. points: float64 [R, 3], scene world.
    normals: float32 [R, 3], of the splat there. semantic: int16 [R]. reach_z_m: float64 [R], height
    at which the image ends above the point."""

    points: np.ndarray
    normals: np.ndarray
    semantic: np.ndarray
    reach_z_m: np.ndarray


@dataclass(frozen=True, eq=False)
class WallView:
    """A view at COARSE_WIDTH or less. rgb: uint8 [H, W, 3]. depth_m: float32 [H, W]: z of the
    surface drawn; minus that of its vertical continuation above it; infinite where nothing is.
    used: bool [H, W]. sky_counts: float32 [_SIDE^3], how often each coarse colour is sure sky."""

    camera: Camera
    rgb: np.ndarray
    depth_m: np.ndarray
    used: np.ndarray
    sky_counts: np.ndarray
    rims: Rims

    @staticmethod
    def of(scene: Scene, view: RecordedView, lowest_rim_rad: float) -> WallView:
        """lowest_rim_rad: elevation from which a surface's top may be the LiDAR's, not its own."""
        camera = view.camera.scaled(min(1.0, COARSE_WIDTH / view.camera.width))
        size = (camera.width, camera.height)
        rgb = cv2.resize(view.rgb, size, interpolation=cv2.INTER_AREA)
        used = _shrunk(view.weight > 0, size)
        depth_m, rims = _continue_upward(scene, camera, used, lowest_rim_rad)
        sky_counts = np.bincount(
            colour_cells(rgb[_shrunk(view.sky, size)]), minlength=_SIDE**3
        ).astype(np.float32)
        return WallView(camera, rgb, depth_m, used, sky_counts, rims)


def colour_cells(rgb: np.ndarray) -> np.ndarray:
    """The coarse colour of each pixel, int64 [...], for rgb uint8 [..., 3]."""
    steps = rgb.astype(np.int64) >> _SHIFT
    return (steps[..., 0] * _SIDE + steps[..., 1]) * _SIDE + steps[..., 2]


def sky_colours(own: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Which coarse colours look like sky, bool [_SIDE^3], by the image's own counts, or those of
    its camera where it shows too little. Without any sky only white does."""
    counts = own if own.sum() >= _ENOUGH_SKY else others
    if counts.sum() < _ENOUGH_SKY:
        luma = np.indices((_SIDE,) * 3).reshape(3, -1).min(axis=0)
        return luma >= _SIDE - 2
    cube = counts.reshape((_SIDE,) * 3)
    for axis in range(3):  # colours one step beside are sky too
        padded = np.pad(cube, [(1, 1) if a == axis else (0, 0) for a in range(3)])
        cube = sum(np.take(padded, np.arange(_SIDE) + k, axis=axis) for k in range(3))
    return cube.reshape(-1) > _RARE * cube.max()


def _shrunk(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Coarse pixels that lie wholly in the mask, bool [H, W]."""
    return cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.99


def _continue_upward(
    scene: Scene, camera: Camera, used: np.ndarray, lowest_rim_rad: float
) -> tuple[np.ndarray, Rims]:
    """The view's signed depth (see WallView) and the rims in it."""
    parts = scene.parts_for(camera)
    out = rasterize(parts, camera, buffers=(ALPHA, MEDIAN_DEPTH, SPLAT_IDS))
    assert out.alpha is not None and out.median_depth is not None and out.splat_ids is not None
    z, ids = out.median_depth.numpy(), out.splat_ids.numpy().ravel()
    solid = (out.alpha.numpy() >= _SOLID_ALPHA) & (z > 0)
    depth = np.where(solid, z, np.float32(np.inf)).ravel()
    rays = camera.ray_directions().numpy().reshape(-1, 3).astype(np.float64)
    level = np.hypot(rays[:, 0], rays[:, 1])
    rise = np.arctan2(rays[:, 2], level)
    sector = _sectors(camera, rays)
    top = _topmost(np.where(solid.ravel(), rise, -np.inf), sector)
    rim = (top >= 0) & (rise[top] >= lowest_rim_rad) & used.ravel()[top]
    own = np.maximum(ids[top], 0)
    background = scene.background
    rim &= (ids[top] >= 0) & (ids[top] < len(background))
    own[~rim] = 0
    semantic = np.zeros(len(own), np.int16)
    if background.semantic is not None and len(background):
        semantic = background.semantic.numpy()[own]
    distance_m = np.where(rim, depth[top], 0.0) * level[top]
    rim &= ~np.isin(semantic, _NO_WALL) & (distance_m > _NEAR_M) & (distance_m < _FAR_M)
    above = rim[sector] & (rise > rise[top][sector]) & ~solid.ravel() & used.ravel()
    depth[above] = -(distance_m[sector] / level)[above]
    centre = camera.centre.numpy()
    reach = np.full(len(top), -np.inf)
    np.maximum.at(reach, sector[above], rise[above])
    chosen = np.flatnonzero(rim & np.isfinite(reach))
    at = top[chosen]
    rims = Rims(
        points=centre + depth[at, None].astype(np.float64) * rays[at],
        normals=_normals(scene, own[chosen]),
        semantic=semantic[chosen],
        reach_z_m=centre[2] + distance_m[chosen] * np.tan(reach[chosen]),
    )
    return depth.reshape(z.shape), rims


def _sectors(camera: Camera, rays: np.ndarray) -> np.ndarray:
    """Number of the vertical plane through the camera's centre that each pixel lies in, int64."""
    forward = camera.world_from_camera[:3, 2].numpy()
    ahead = rays[:, 0] * forward[0] + rays[:, 1] * forward[1]
    aside = rays[:, 1] * forward[0] - rays[:, 0] * forward[1]
    azimuth = np.arctan2(aside, ahead)
    number = np.floor(azimuth * (camera.fx / _COLUMN_PX)).astype(np.int64)
    return number - number.min()


def _topmost(rise: np.ndarray, sector: np.ndarray) -> np.ndarray:
    """Index of the pixel of largest rise in each sector, -1 where none is finite; int64."""
    order = np.lexsort((-np.arange(len(rise)), rise, sector))
    last = np.append(np.flatnonzero(np.diff(sector[order])), len(order) - 1)
    out = np.full(int(sector.max()) + 1, -1, np.int64)
    out[sector[order[last]]] = order[last]
    out[(out >= 0) & ~np.isfinite(rise[out])] = -1
    return out


def _normals(scene: Scene, splats: np.ndarray) -> np.ndarray:
    """Unit normals of background splats: their thinnest axes, float32 [R, 3]."""
    if len(splats) == 0:
        return np.zeros((0, 3), np.float32)
    axes = rotmat_from_quat(scene.background.quats[splats]).numpy()
    thinnest = scene.background.scales[splats].numpy().argmin(axis=1)
    return axes[np.arange(len(splats)), :, thinnest].astype(np.float32)


@dataclass(frozen=True, eq=False)
class Columns:
    """Places in plan where a surface goes on. xy: float64 [C, 2]. low_z_m, high_z_m: float64 [C],
    the span that images show. edge_m: float64 [C]. normals: float64 [C, 3], level and unit.
    semantic: int16 [C]."""

    xy: np.ndarray
    low_z_m: np.ndarray
    high_z_m: np.ndarray
    edge_m: np.ndarray
    normals: np.ndarray
    semantic: np.ndarray

    def __len__(self) -> int:
        return len(self.xy)

    def select(self, index: np.ndarray) -> Columns:
        return Columns(*(getattr(self, name)[index] for name in Columns.__dataclass_fields__))


@dataclass(frozen=True, eq=False)
class Pieces:
    """N pieces, column after column, upward. centres: float64 [N, 3]. column, step: int64 [N]."""

    centres: np.ndarray
    column: np.ndarray
    step: np.ndarray

    @staticmethod
    def of(columns: Columns) -> Pieces:
        rows = np.ceil((columns.high_z_m - columns.low_z_m) / columns.edge_m)
        count = np.maximum(rows, 0).astype(np.int64)
        column = np.repeat(np.arange(len(columns)), count)
        step = np.arange(len(column)) - np.repeat(np.cumsum(count) - count, count)
        z = columns.low_z_m[column] + (step + 0.5) * columns.edge_m[column]
        return Pieces(np.concatenate([columns.xy[column], z[:, None]], axis=1), column, step)


def vote(
    pieces: Pieces,
    columns: Columns,
    views: Sequence[WallView],
    sky_tables: Sequence[np.ndarray],
    lidar_top_rad: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Which pieces are surface, bool [N], and their colours, float32 [N, 3]."""
    count = len(pieces.centres)
    seen_colours = Observations.empty(count)
    shown, sky, seen_past = (np.zeros(count, np.int64) for _ in range(3))
    names = list(dict.fromkeys(view.camera.name for view in views))
    for view, sky_table in zip(views, sky_tables, strict=True):
        seen, rgb, score, empty = _observe(pieces.centres, view, lidar_top_rad)
        is_sky = sky_table[colour_cells(rgb)]
        seen_past[seen[empty]] += 1
        sky[seen[is_sky & ~empty]] += 1
        shown[seen[~is_sky & ~empty]] += 1
        worst = seen_colours.scores[seen].argmin(axis=1)
        better = ~empty & (score > seen_colours.scores[seen, worst])
        index, worst = seen[better], worst[better]
        seen_colours.scores[index, worst] = score[better]
        seen_colours.colours[index, worst] = rgb[better]
        seen_colours.cameras[index, worst] = names.index(view.camera.name)
    blended, _ = seen_colours.blended()
    total = shown + sky + seen_past
    good = shown >= min(MIN_VIEWS, len(views))
    good &= (sky <= _SKY_PART * total) & (seen_past <= _SEEN_PAST_PART * total)
    good &= _spread(seen_colours, blended) <= _SPREAD_LEVELS
    empty = (seen_past > _SEEN_PAST_PART * total) | (total == 0)
    return _without_holes(good, empty, pieces, columns), blended


def _observe(
    centres: np.ndarray, view: WallView, lidar_top_rad: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Indices of the pieces that nothing hides, their pixels' colours uint8 [M, 3], scores float32
    [M], and whether the view shows that nothing can be there."""
    camera = view.camera
    pose = camera.camera_from_world.numpy()
    local = centres @ pose[:3, :3].T + pose[:3, 3]
    z = local[:, 2]
    ahead = np.maximum(z, 0.5)
    u = camera.fx * local[:, 0] / ahead + camera.cx
    v = camera.fy * local[:, 1] / ahead + camera.cy
    seen = np.flatnonzero(
        (z > 0.5) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    )
    column, row = u[seen].astype(np.int64), v[seen].astype(np.int64)
    used = view.used[row, column]
    seen, row, column = seen[used], row[used], column[used]
    z, depth = z[seen], view.depth_m[row, column].astype(np.float64)
    slack = _NEARER * z + _NEARER_M
    hidden = z > np.abs(depth) + slack
    offsets = centres[seen] - camera.centre.numpy()
    level_m = np.hypot(offsets[:, 0], offsets[:, 1])
    scanned = np.arctan2(offsets[:, 2], level_m) < lidar_top_rad - LIDAR_MARGIN_RAD
    scanned &= level_m < LIDAR_REACH_M
    empty = np.where(depth > 0, np.isfinite(depth) & (z < depth - slack), False)
    empty |= scanned & np.isinf(depth)
    border = np.minimum(
        np.minimum(u[seen], camera.width - u[seen]) / camera.width,
        np.minimum(v[seen], camera.height - v[seen]) / camera.height,
    )
    score = (np.minimum(border / _FEATHER, 1.0) + 1e-3) * camera.fx / z
    open_ = ~hidden
    return (
        seen[open_],
        view.rgb[row[open_], column[open_]],
        score[open_].astype(np.float32),
        empty[open_],
    )


def _spread(seen: Observations, blended: np.ndarray) -> np.ndarray:
    """Median over a piece's observations of their largest deviation from its colour, float [N]."""
    off = np.abs(seen.colours - 255 * blended[:, None]).max(axis=2)
    off = np.where(seen.scores > 0, off, np.nan)
    off[~(seen.scores > 0).any(axis=1)] = np.inf
    return np.nanmedian(off, axis=1)


def _without_holes(
    good: np.ndarray, empty: np.ndarray, pieces: Pieces, columns: Columns
) -> np.ndarray:
    """The good pieces up to where _GAP_M of their column fails, with what they enclose that is not
    surely empty; bool [N]."""
    rows = int(pieces.step.max(initial=-1)) + 1
    last = np.full(len(columns), -1, np.int64)  # the highest good piece below the column's end
    gap = np.ceil(_GAP_M / columns.edge_m).astype(np.int64)
    table = np.zeros((len(columns), rows), np.bool_)
    table[pieces.column, pieces.step] = good
    for step in range(rows):
        goes_on = table[:, step] & (step - last <= gap)
        last[goes_on] = step
    return (good | ~empty) & (pieces.step <= last[pieces.column])


def wall_tops(scene: Scene, source: ViewSource, *, lidar_top_deg: float = 15.0) -> Gaussians:
    """Degree-0 Gaussians that continue the background above the LiDAR's view; perhaps none. source:
    views whose `sky` tells what sky looks like and whose `weight` masks out the recording car."""
    every = max(1, math.ceil(len(source.train) / MAX_VIEWS))
    by_camera: dict[str, list[ViewKey]] = defaultdict(list)
    for key in source.train:
        by_camera[key.camera].append(key)
    chosen = [key for group in by_camera.values() for key in group[::every]]
    lidar_top_rad = math.radians(lidar_top_deg)
    views = [WallView.of(scene, source.load(k), lidar_top_rad - _RIM_MARGIN_RAD) for k in chosen]
    path = np.array([frame.world_from_ego[:3, 3].numpy() for frame in scene.frames])
    if not any(len(view.rims.points) for view in views) or len(path) == 0:
        return Gaussians.empty()
    totals: dict[str, np.ndarray] = defaultdict(lambda: np.zeros(_SIDE**3, np.float32))
    for view in views:
        totals[view.camera.name] = totals[view.camera.name] + view.sky_counts
    sky_tables = [sky_colours(view.sky_counts, totals[view.camera.name]) for view in views]
    voxel_m = VOXEL_M
    while True:
        columns = _columns(views, path, voxel_m)
        pieces = Pieces.of(columns)
        keep, colours = vote(pieces, columns, views, sky_tables, lidar_top_rad)
        kept = int(keep.sum())
        logger.info("%d of %d pieces of walls kept at %.3f m", kept, len(keep), voxel_m)
        if kept <= _MAX_GAUSSIANS:
            break
        voxel_m *= max(1.05, math.sqrt(kept / _MAX_GAUSSIANS))
    return _gaussians(pieces, columns, keep, colours)


def _columns(views: Sequence[WallView], path: np.ndarray, voxel_m: float) -> Columns:
    """The rims of all views, joined where they stand on one cell of the plan."""
    rims = [view.rims for view in views]
    points = np.concatenate([r.points for r in rims])
    owner = np.repeat(np.arange(len(rims)), [len(r.points) for r in rims])
    edges = edges_at(points, path, voxel_m=voxel_m).astype(np.float64)
    level = np.round(4 * np.log2(edges / voxel_m)).astype(np.int64)
    cell = np.floor(points[:, :2] / edges[:, None]).astype(np.int64) + (1 << 23)
    _, column = np.unique((level << 48) | (cell[:, 0] << 24) | cell[:, 1], return_inverse=True)
    count = int(column.max()) + 1
    seen_by = np.unique(column * len(views) + owner) // len(views)
    enough = np.bincount(seen_by, minlength=count) >= min(MIN_VIEWS, len(views))
    order = np.lexsort((points[:, 2], column))
    sizes = np.bincount(column, minlength=count)
    starts = np.cumsum(sizes) - sizes
    high = np.full(count, -np.inf)
    np.maximum.at(high, column, np.concatenate([r.reach_z_m for r in rims]))
    ceiling = min(float(view.camera.centre[2]) for view in views) + _HEIGHT_M
    normals = np.concatenate([r.normals for r in rims]).astype(np.float64)
    columns = Columns(
        xy=np.stack([np.bincount(column, points[:, a]) / sizes for a in range(2)], axis=1),
        low_z_m=points[order, 2][starts + sizes // 2],
        high_z_m=np.minimum(high, ceiling),
        edge_m=edges[order][starts],
        normals=_level_normals(normals, column, count),
        semantic=_commonest(np.concatenate([r.semantic for r in rims]), column, count),
    )
    return columns.select(enough)


def _level_normals(normals: np.ndarray, column: np.ndarray, count: int) -> np.ndarray:
    """The level direction along which the normals of each column point, whatever their signs."""
    xx, yy, xy = (
        np.bincount(column, normals[:, a] * normals[:, b], count)
        for a, b in ((0, 0), (1, 1), (0, 1))
    )
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    return np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)


def _commonest(semantic: np.ndarray, column: np.ndarray, count: int) -> np.ndarray:
    votes = np.zeros((count, 64), np.int64)
    np.add.at(votes, (column, semantic), 1)
    votes[:, 0] = 0  # UNKNOWN only where nothing else was seen
    return votes.argmax(axis=1).astype(np.int16)


def _gaussians(
    pieces: Pieces, columns: Columns, keep: np.ndarray, colours: np.ndarray
) -> Gaussians:
    column = pieces.column[keep]
    normals = columns.normals[column].astype(np.float32)
    up = np.broadcast_to(np.array([0, 0, 1], np.float32), normals.shape)
    edges = columns.edge_m[column]
    surfels = Surfels.discs(pieces.centres[keep], normals, np.cross(up, normals), edges)
    return gaussians_from_surfels(surfels, colours[keep], columns.semantic[column], _SHAPE)


# ---- The recording car, and all together ---------------------------------------------------------

_PX_PER_SPLAT = 8  # pixels of the recorded image from splat to splat: two at a quarter of its size
_COLUMNS = (160, 320)  # fewest and most splats across a whole image
_MAX_IMAGES = 48  # that the median is taken over
_MIN_SPLATS = 16  # a smaller mask is a speck, not a car
_COVERED = 0.5  # part of a splat's cell that must lie in the mask
_BODY_FAR_M, _BODY_NEAR_M = 1.6, 0.4  # along the optical axis
_HALF_WIDTH_M = 0.95  # half a car's width: the body does not reach aside into other cameras' views
_MIN_SLOPE = 0.05  # a roof below the camera is seen at no flatter angle than this
_MARGIN_M = 0.01
_BODY_SHAPE = SplatShape(sigma_per_spacing=0.6, opacity=0.95)

# Camera axes (x right, y down, z forward) to an actor's (x forward, y left, z up).
_ACTOR_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def starting_scene(scene: Scene, views: RecordedViews) -> Scene:
    """The scene with upper walls in its background and a body of the recording car for every
    camera that sees it, both from training views alone."""
    top_deg = views.facts["lidar_top_deg"]
    background = scene.background
    if top_deg is not None:  # without LiDAR nothing ends at its highest view
        background = _joined(background, wall_tops(scene, views, lidar_top_deg=top_deg))
    bodies = [ego_body(scene, name, mask, views) for name, mask in views.ego_masks.items()]
    actors = (*scene.actors, *(body for body in bodies if body is not None))
    return dataclasses.replace(scene, background=background, actors=actors)


def _joined(first: Gaussians, second: Gaussians) -> Gaussians:
    """Both, at the first one's SH degree, which is not lower than the second's."""
    if len(second) == 0:
        return first
    sh = torch.zeros(len(second), first.sh.shape[1], 3)
    sh[:, : second.sh.shape[1]] = second.sh
    if first.semantic is None or second.semantic is None:
        first, second = (dataclasses.replace(g, semantic=None) for g in (first, second))
    parts = (first, dataclasses.replace(second, sh=sh))
    joined = {
        field.name: torch.cat([getattr(part, field.name) for part in parts])
        for field in dataclasses.fields(Gaussians)
        if getattr(first, field.name) is not None
    }
    return Gaussians(**joined)


def ego_body(scene: Scene, camera_name: str, mask: np.ndarray, source: ViewSource) -> Actor | None:
    """The part of the recording car that a camera sees; None without a mask or images.

    mask: bool [H, W] of that camera's images at any scale, True where they show the car. source:
    recorded views; the median over time of those of the camera that are trained on gives the
    colours. The actor's frame is the camera's own, turned to x forward, y left, z up and
    moved to the box's centre; its track are the camera's poses at its own times, so that the body
    stands still in every image. Its label is EGO_VEHICLE and its class OTHER: it has no box.

    Raises:
        ValueError: no such camera, or a mask that is not bool [H, W] with the camera's proportions.
    """
    cameras = [frame.cameras[camera_name] for frame in scene.frames if camera_name in frame.cameras]
    if not cameras:
        raise ValueError(
            f"scene {scene.name!r} has no camera {camera_name!r}; it has "
            f"{', '.join(scene.camera_names) or 'none'}"
        )
    first = cameras[0]
    _check_mask(mask, first)
    step = first.width / min(max(first.width / _PX_PER_SPLAT, _COLUMNS[0]), _COLUMNS[1])
    grid = first.scaled(min(1.0, 1 / step))
    size = (grid.width, grid.height)
    part = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    rows, columns = np.nonzero(part >= _COVERED)
    if len(rows) < _MIN_SPLATS:
        return None
    colours = _median_colours(camera_name, source, size, rows, columns)
    if colours is None:
        return None
    points, spacing = _place(grid, rows, columns)
    gaussians, centre, size_m = _body_gaussians(points, spacing, colours)
    logger.info("%d splats for the recording car in camera %s", len(gaussians), camera_name)
    return Actor(
        track_id=f"{EGO_VEHICLE}:{camera_name}",
        label=EGO_VEHICLE,
        gaussians=gaussians,
        track=_track(cameras, centre),
        size_m=size_m,
    )


def _check_mask(mask: np.ndarray, camera: Camera) -> None:
    where = f"the mask of the recording car in camera {camera.name!r}"
    if mask.dtype != np.bool_ or mask.ndim != 2 or mask.size == 0:
        raise ValueError(f"{where} must be bool [H, W]; got {mask.dtype} {list(mask.shape)}")
    height, width = mask.shape
    expected = width * camera.height / camera.width
    if abs(height - expected) > 1:
        raise ValueError(
            f"{where} must have the proportions of its images, {camera.width}x{camera.height}; "
            f"got {width}x{height}"
        )


def _median_colours(
    camera_name: str,
    source: ViewSource,
    size: tuple[int, int],
    rows: np.ndarray,
    columns: np.ndarray,
) -> np.ndarray | None:
    """Median over the images, float32 [N, 3] in [0, 1], or None without any."""
    own = [k for k in source.train if k.camera == camera_name]
    every = max(1, math.ceil(len(own) / _MAX_IMAGES))
    samples = []
    for key in own[::every]:
        rgb = cv2.resize(source.load(key).rgb, size, interpolation=cv2.INTER_AREA)
        samples.append(rgb[rows, columns])
    if not samples:
        return None
    return (np.median(np.stack(samples), axis=0) / 255).astype(np.float32)


def _place(grid: Camera, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points on the rays through pixels of the grid, float64 [N, 3] in the camera's frame, and the
    distance from one to the next [N]: on a level surface below the camera, such as a roof, as far
    as a car's width allows; where a ray does not go down, on an upright one."""
    x = (columns + 0.5 - grid.cx) / grid.fx
    y = (rows + 0.5 - grid.cy) / grid.fy
    far_m = float(np.clip(_HALF_WIDTH_M / max(np.abs(x).max(), 1e-6), _BODY_NEAR_M, _BODY_FAR_M))
    down = np.maximum(y, _MIN_SLOPE)
    depth = np.clip(far_m * down.min() / down, _BODY_NEAR_M, far_m)
    rays = np.stack([x, y, np.ones_like(x)], axis=1)
    return rays * depth[:, None], depth / min(grid.fx, grid.fy)


def _body_gaussians(
    points: np.ndarray, spacing: np.ndarray, colours: np.ndarray
) -> tuple[Gaussians, np.ndarray, tuple[float, float, float]]:
    """Discs that face the camera, in the actor's frame; the box's centre in the camera's axes
    turned to the actor's, float64 [3]; and the box's size."""
    turned = points @ _ACTOR_FROM_CAMERA.T
    normals = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    major = np.cross([0.0, 0.0, 1.0], normals)
    major /= np.linalg.norm(major, axis=1, keepdims=True)
    low, high = turned.min(axis=0) - _MARGIN_M, turned.max(axis=0) + _MARGIN_M
    centre = (low + high) / 2
    surfels = Surfels.discs(turned - centre, normals, major, spacing)
    other = np.full(len(points), int(SemanticClass.OTHER), np.int16)
    length, width, height = (float(v) for v in high - low)
    return (
        gaussians_from_surfels(surfels, colours, other, _BODY_SHAPE),
        centre,
        (length, width, height),
    )


def _track(cameras: Sequence[Camera], centre: np.ndarray) -> Track:
    """The camera's poses as an actor's; of images of one time the first counts."""
    rotation = torch.from_numpy(_ACTOR_FROM_CAMERA.T.copy())
    camera_from_actor = rigid(rotation, rotation @ torch.from_numpy(centre))
    poses = {}
    for camera in cameras:
        poses.setdefault(camera.timestamp_ns, camera.world_from_camera @ camera_from_actor)
    times = sorted(poses)
    return Track(
        torch.tensor(times, dtype=torch.int64), torch.stack([poses[time] for time in times])
    )
