"""Splats for what photos show as surface and the LiDAR did not reach: storeys, crowns, poles, the
end of the street.

One recorded image after another is compared with the Gaussians so far. Where it shows no sky, and
the Gaussians leave it open, discs in the photo's colours are placed at the depth that
`adapters.lidar_scene.dense_depth` gives. They are small at the photo's edges and large where it is
even, so that far walls need few. A disc that other images see as sky is placed far away, or left
out. The callers are `adapters.lidar_scene.scene` and `adapters.training_views.starting_scene`.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch

from adapters.lidar_scene.closing import spread_views
from adapters.lidar_scene.dense_depth import FAR_M, DenseDepth, KnownSurface, complete_depth
from adapters.lidar_scene.depth_maps import DepthMaps
from adapters.lidar_scene.image_views import View
from adapters.lidar_scene.sky_conflicts import measure_agreement, without_sky_splats
from adapters.lidar_scene.sky_edges import shorten_ends_in_sky, trim_at_sky
from adapters.lidar_scene.solid_views import WORK_WIDTH, SolidView, read_solid_view
from adapters.lidar_scene.split import ObjectTrack, is_flat
from adapters.lidar_scene.surfels import SplatShape, Surfels, gaussians_from_surfels
from adapters.lidar_scene.wall_planes import WallPlanes, find_wall_planes
from adapters.raw_drive import Sweep
from adapters.world import join_gaussians
from augment.errors import AdapterError
from augment.reconstruct.view import ViewKey
from augment.render.buffers import ALPHA, MEDIAN_DEPTH, SPLAT_IDS
from augment.render.constants import SURFACE_ALPHA
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, PosedGaussians
from augment.scene.semantics import SemanticClass

logger = logging.getLogger(__name__)

_STEP_M = 2.0  # distance on the path from one image that is taken to the next
_FRAMES_PART = 1 / 6  # largest part of all frames whose images are taken, beyond a few
_SKY_STEP_M = 0.7  # distance from one image whose sky may refute splats to the next
_SKY_FRAMES_PART = 1 / 3  # largest part of all frames whose images may
_DEPTH_WIDTH = 480  # columns at which depth is searched for, at most
_OPEN_ALPHA = 0.97  # mean alpha of the Gaussians so far around a pixel below which it is open
_OPEN_WINDOW_PX = 5  # side of the square over which that mean is taken
_SAME_TIME_NS = 10_000_000  # sweeps of one moment, as those of several depth images
_SOLID_SHARE = 0.4  # share of sky below which a pixel shows a surface
_BEHIND = 0.002  # gap from a surface that leaks to the disc behind it, as a part of the depth
_BEHIND_M = 0.02  # constant part of that gap, metres
_SIDES_PX = (32, 16, 8, 4, 2, 1)  # sides of discs, pixels
# Largest standard deviations of CIELAB colours within a disc, in turn, until there is room for all.
_COLOR_TOLERANCES = (2.0, 4.0, 8.0, 16.0)
_SKY_SIDES = 1.2  # least distance of a disc from the sky, as a multiple of its side
_DEPTH_TOLERANCE = 0.02  # largest standard deviation of the logarithm of depths within a disc
_VIEWS_PER_SHARE = 8  # one view adds the remaining number over this at most, if so many follow
_MIN_COSINE = 0.15  # of the angle between a ray and a wall's normal, to which a disc is stretched
_MAX_CONFLICTS = 0.1  # part of the images of a disc in which it may cover sky
_MAX_MEASURED_CONFLICTS = 0.4  # the same of a splat that returns made
_SHAPE = SplatShape(sigma_per_spacing=0.65, opacity=0.99)


# Background and camera to everything that is drawn, the background first.
PosesParts = Callable[[Gaussians, Camera], Sequence[PosedGaussians]]


def close_above_beams(
    parts: Sequence[Gaussians],
    tracks: Sequence[ObjectTrack],
    views: Sequence[View],
    *,
    sweeps: Sequence[Sweep],
    lidar_top_rad: float,
    max_gaussians: int,
    depth_option: str | None = None,
) -> tuple[Gaussians, tuple[str, ...]]:
    """Return the world's Gaussians with discs where images show a surface above the LiDAR's view.

    The second result are sentences on a user's depth maps.

    Args:
        parts: Gaussians of the world, then those of the tracks, in their frames.
        tracks: moving objects.
        views: recorded images.
        sweeps: the LiDAR's returns; those nearest in time tell an image's sky.
        lidar_top_rad: highest elevation that the LiDAR measures.
        max_gaussians: largest number for all parts.
        depth_option: a user's depth maps, as in `DepthMaps.find`.
    """
    returns_at = _ReturnsAt(sweeps)

    def read_views(chosen: Iterable[View], width: int) -> list[SolidView]:
        solid_views = (
            read_solid_view(
                view,
                tracks,
                returns_at.nearest(view.camera.timestamp_ns),
                lidar_top_rad,
                width=width,
            )
            for view in chosen
        )
        return [view for view in solid_views if view is not None]

    main_views = spread_views(views, step_m=_STEP_M, frames_part=_FRAMES_PART)
    solid_views = read_views(main_views, WORK_WIDTH)
    used = {view.key for view in solid_views}
    more_views = spread_views(views, step_m=_SKY_STEP_M, frames_part=_SKY_FRAMES_PART)
    sky_views = read_views(
        (view for view in more_views if ViewKey(view.frame, view.camera.name) not in used),
        _DEPTH_WIDTH,
    )

    def pose_parts(background: Gaussians, camera: Camera) -> list[PosedGaussians]:
        posed = [PosedGaussians(background, None, instance_id=0)]
        for number, (track, part) in enumerate(zip(tracks, parts[1:], strict=True), start=1):
            pose = track.motion.pose_at(camera.timestamp_ns)
            if pose is not None and len(part):
                posed.append(PosedGaussians(part, torch.from_numpy(pose), instance_id=number))
        return posed

    image_paths = {ViewKey(view.frame, view.camera.name): view.path for view in views}
    maps = None if depth_option is None else MapReader(DepthMaps.find(depth_option, image_paths))
    background = add_surfaces_beyond_beams(
        parts[0],
        solid_views,
        pose_parts,
        sky_views=sky_views,
        lidar_top_rad=lidar_top_rad,
        max_added=max_gaussians - sum(map(len, parts)),
        maps=maps,
    )
    return background, () if maps is None else maps.sentences()


class _ReturnsAt:
    """Finds the sweeps that are nearest in time."""

    def __init__(self, sweeps: Sequence[Sweep]) -> None:
        self._sweeps = [sweep for sweep in sweeps if len(sweep)]
        self._times_ns = [int(np.median(sweep.timestamps_ns)) for sweep in self._sweeps]

    def nearest(self, timestamp_ns: int) -> np.ndarray:
        """Return the points of the nearest sweeps, float32 [N, 3]; none without a sweep."""
        if not self._sweeps:
            return np.zeros((0, 3), np.float32)
        gaps_ns = np.abs(np.array(self._times_ns) - timestamp_ns)
        nearest = np.flatnonzero(gaps_ns <= gaps_ns.min() + _SAME_TIME_NS)
        return np.concatenate([self._sweeps[number].points for number in nearest])


class MapReader:
    """Reads a user's depth maps, and counts what it read."""

    def __init__(self, maps: DepthMaps) -> None:
        self._maps = maps
        self._errors: list[float] = []
        self._faults: list[str] = []
        self._num_missing = 0

    def read(self, view: SolidView) -> np.ndarray | None:
        """Return the user's depth of an image, float [H, W], NaN where unknown; None without."""
        assert view.known_m is not None
        try:
            aligned = self._maps.read(view.key, view.camera, view.known_m)
        except AdapterError as error:
            where = f"camera {view.key.camera}, frame {view.key.frame}"
            self._faults.append(f"{where}: {error}; its depth is guessed")
            return None
        if aligned is None:
            self._num_missing += 1
            return None
        self._errors.append(aligned.error)
        return aligned.depth_m

    def sentences(self) -> tuple[str, ...]:
        """Return a sentence on the maps' error, and one on each kind of fault."""
        folder = self._maps.folder
        out = []
        if self._errors:
            out.append(
                f"depth maps of {folder} are used for {len(self._errors)} images; aligned to the "
                f"LiDAR, their median relative error is {np.median(self._errors):.1%}"
            )
        if self._num_missing:
            out.append(f"{folder} has no depth map for {self._num_missing} images; it is guessed")
        if self._faults:
            out.append(f"{self._faults[0]} (so for {len(self._faults)} images)")
        return tuple(out)


def add_surfaces_beyond_beams(
    background: Gaussians,
    views: Iterable[SolidView],
    pose_parts: PosesParts,
    *,
    lidar_top_rad: float,
    max_added: int,
    sky_views: Sequence[SolidView] = (),
    maps: MapReader | None = None,
) -> Gaussians:
    """Return the background with discs until the views' pixels without sky have a surface.

    Args:
        background: splats of what stands still, with classes.
        views: recorded images, in the order in which they add discs.
        pose_parts: places background and actors for a camera.
        lidar_top_rad: highest elevation that the LiDAR looks at.
        max_added: largest number of discs.
        sky_views: more recorded images, whose sky refutes splats.
        maps: a user's depth maps, which count before a guess.
    """
    views = list(views)
    voters = [*views, *sky_views]
    background = without_sky_splats(background, voters, max_conflicts=_MAX_MEASURED_CONFLICTS)
    views = [
        dataclasses.replace(view, known_m=_draw(background, view.camera, pose_parts)[1].depth_m)
        for view in views
    ]
    background = trim_at_sky(background, views)
    walls = find_wall_planes(background)
    count = len(background)
    for number, view in enumerate(views):
        room = max_added - (len(background) - count)
        room //= min(_VIEWS_PER_SHARE, len(views) - number)
        alpha, known_surface = _draw(background, view.camera, pose_parts)
        # A sheet behind all of a leaking wall takes fewer discs than one behind each leak.
        leaks = cv2.blur(alpha, (_OPEN_WINDOW_PX, _OPEN_WINDOW_PX)) < _OPEN_ALPHA
        leaks &= view.camera.ray_directions().numpy()[..., 2] > -0.5 / view.camera.fy
        leaks &= ~view.excluded
        if not (leaks & (view.matte.sky_share < _SOLID_SHARE)).any() or room < 1:
            continue
        depth = _complete_depth(view, known_surface, walls, lidar_top_rad)
        is_known = np.isfinite(known_surface.depth_m)
        user_m = None if maps is None else maps.read(view)
        if user_m is not None:
            depth = _take_user_depth(depth, user_m, ~is_known)
        depth = depth._replace(
            depth_m=np.where(is_known, depth.depth_m * (1 + _BEHIND) + _BEHIND_M, depth.depth_m)
        )
        other_views = [other for other in views if other is not view]
        panes = _find_panes(view.matte.sky_share, depth.wall)
        sky_share = np.where(panes, np.float32(0), view.matte.sky_share)
        view = dataclasses.replace(view, matte=view.matte._replace(sky_share=sky_share))
        cells = _cells(view, depth, leaks & (sky_share < _SOLID_SHARE), room)
        discs = _discs(view, depth, is_known | panes, cells, walls, other_views)
        background = join_gaussians([background, discs])
    added = background.select(torch.arange(count, len(background)))
    background = background.select(torch.arange(count))
    added = without_sky_splats(added, voters, min_views=1, max_conflicts=_MAX_CONFLICTS)
    added = shorten_ends_in_sky(trim_at_sky(added, views), voters)
    background = join_gaussians([background, added])
    logger.info("%d splats beyond the LiDAR's view", len(background) - count)
    return background


def _take_user_depth(depth: DenseDepth, user_m: np.ndarray, is_open: np.ndarray) -> DenseDepth:
    """Return the depth with a user's at open pixels where it is known."""
    is_told = is_open & np.isfinite(user_m)
    return depth._replace(
        depth_m=np.where(is_told, user_m, depth.depth_m),
        is_far=depth.is_far & ~is_told,
        wall=np.where(is_told, -1, depth.wall),
    )


def _complete_depth(
    view: SolidView, known_surface: KnownSurface, walls: WallPlanes, lidar_top_rad: float
) -> DenseDepth:
    """Return a depth for every pixel of a view, searched for at _DEPTH_WIDTH columns at most.

    Args:
        view: the recorded image.
        known_surface: known surfaces, at the view's size.
        walls: walls of the scene.
        lidar_top_rad: highest elevation that the LiDAR looks at.
    """
    camera = view.camera.scaled(min(1.0, _DEPTH_WIDTH / view.camera.width))
    size = (camera.width, camera.height)
    rows = np.arange(camera.height) * view.camera.height // camera.height
    columns = np.arange(camera.width) * view.camera.width // camera.width
    depth = complete_depth(
        camera,
        cv2.resize(view.rgb, size, interpolation=cv2.INTER_AREA),
        cv2.resize(view.matte.sky_share, size, interpolation=cv2.INTER_AREA),
        KnownSurface(*(image[rows[:, None], columns] for image in known_surface)),
        walls,
        lidar_top_rad,
    )
    rows = np.arange(view.camera.height) * camera.height // view.camera.height
    columns = np.arange(view.camera.width) * camera.width // view.camera.width
    depth = DenseDepth(*(image[rows[:, None], columns] for image in depth))
    is_known = np.isfinite(known_surface.depth_m)
    return depth._replace(
        depth_m=np.where(is_known, known_surface.depth_m, depth.depth_m),
        semantic=np.where(is_known, known_surface.semantic, depth.semantic),
        is_far=depth.is_far & ~is_known,
    )


def _draw(
    background: Gaussians, camera: Camera, pose_parts: PosesParts
) -> tuple[np.ndarray, KnownSurface]:
    """Return alpha [H, W] and the surfaces of the Gaussians so far."""
    parts = pose_parts(background, camera)
    raster = rasterize(parts, camera, buffers=(ALPHA, MEDIAN_DEPTH, SPLAT_IDS))
    assert raster.alpha is not None and raster.median_depth is not None
    assert raster.splat_ids is not None and background.semantic is not None
    alpha = raster.alpha.numpy()
    ids = raster.splat_ids.numpy()
    in_background = (ids >= 0) & (ids < len(background))
    semantic = background.semantic.numpy()[np.where(in_background, ids, 0)]
    depth = np.where(alpha >= SURFACE_ALPHA, raster.median_depth.numpy(), np.inf)
    return alpha, KnownSurface(depth, semantic.astype(np.int16), (ids >= len(background)))


def _find_panes(sky_share: np.ndarray, wall: np.ndarray) -> np.ndarray:
    """Return the pixels of glass that mirrors the sky: sky in the middle of one wall, bool [H, W].

    wall: int64 [H, W], number of the wall, -1 for none.
    """
    panes = np.zeros(wall.shape, np.bool_)
    is_sky = (sky_share >= _SOLID_SHARE).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(is_sky)
    for number in range(1, count):
        left, top, width, height, _ = stats[number]
        if min(left, top) == 0 or left + width >= wall.shape[1]:
            continue
        window = slice(top - 1, top + height + 1), slice(left - 1, left + width + 1)
        inside = labels[window] == number
        rim = cv2.dilate(inside.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        walls = np.unique(wall[window][rim & ~inside])
        if len(walls) == 1 and walls[0] >= 0:
            panes[window] |= inside
    return panes


class _Cells(NamedTuple):
    """M square cells of pixels."""

    rows: np.ndarray
    """First row of each cell, int64 [M]."""
    columns: np.ndarray
    """First column of each cell, int64 [M]."""
    sides: np.ndarray
    """Side of each cell, pixels, int64 [M]."""

    def select(self, keep: np.ndarray) -> _Cells:
        return _Cells(*(column[keep] for column in self))


class _CellImages(NamedTuple):
    """Images of H x W pixels that decide how large cells may be."""

    lab: np.ndarray
    """Colours in CIELAB, float32 [H, W, 3]."""
    log_depth: np.ndarray
    """Logarithm of the depth, float32 [H, W]."""
    wall: np.ndarray
    """Number of the wall, -1 for none, float32 [H, W]."""
    from_sky_px: np.ndarray
    """Distance from the nearest pixel of sky, pixels, float32 [H, W]."""


def _cells(view: SolidView, depth: DenseDepth, is_open: np.ndarray, room: int) -> _Cells:
    """Return the cells that cover the open pixels, `room` at most.

    A cell is as large as colour and depth are even in it. If there are too many, colours may
    differ more; at last the smallest cells are left out.
    """
    is_solid = (view.matte.sky_share < _SOLID_SHARE).astype(np.uint8)
    images = _CellImages(
        lab=cv2.cvtColor(view.matte.surface_rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB),
        log_depth=np.log(np.maximum(depth.depth_m, 1e-3)).astype(np.float32),
        wall=depth.wall.astype(np.float32),
        from_sky_px=cv2.distanceTransform(is_solid, cv2.DIST_L2, 3),
    )
    evenness = [_measure_evenness(images, side) for side in _SIDES_PX]
    for tolerance in _COLOR_TOLERANCES:
        cells = _split(evenness, is_open, tolerance)
        if len(cells.rows) <= room:
            return cells
    largest_first = np.argsort(-cells.sides, kind="stable")[:room]
    return cells.select(np.sort(largest_first))


class _Evenness(NamedTuple):
    """Evenness of the square cells of one side in an image, [R, C] each."""

    side: int
    """Side of the cells, pixels."""
    color_variance: np.ndarray
    """Variance of the colours in each cell, summed over the channels, float32."""
    is_allowed: np.ndarray
    """True where depths are even, and no sky is near."""


def _measure_evenness(images: _CellImages, side: int) -> _Evenness:
    """Return the evenness of the cells of one side."""
    height, width = images.wall.shape
    rows = height // side
    columns = width // side
    if side == 1 or rows == 0 or columns == 0:
        shape = rows, columns
        return _Evenness(side, np.zeros(shape, np.float32), np.ones(shape, np.bool_))

    def mean(image: np.ndarray) -> np.ndarray:
        return _means_of_cells(image, side)

    variance = cv2.transform(mean(images.lab**2) - mean(images.lab) ** 2, np.ones((1, 3)))
    depth_variance = mean(images.log_depth**2) - mean(images.log_depth) ** 2
    # A disc on a wall leans with it.
    mean_wall = mean(images.wall)
    wall_variance = mean(images.wall**2) - mean_wall**2
    is_even = depth_variance < _DEPTH_TOLERANCE**2
    is_even |= (mean_wall >= 0) & (wall_variance < 1e-3)
    # A cell that is nearer would reach into the sky.
    is_apart = mean(images.from_sky_px) > _SKY_SIDES * side
    return _Evenness(side, variance, is_even & is_apart)


def _means_of_cells(image: np.ndarray, side: int) -> np.ndarray:
    """Return the means [R, C, ...] of the image's whole square cells."""
    rows = image.shape[0] // side
    columns = image.shape[1] // side
    inside = image[: rows * side, : columns * side]
    return cv2.resize(inside, (columns, rows), interpolation=cv2.INTER_AREA)


def _split(evenness: Sequence[_Evenness], is_open: np.ndarray, tolerance: float) -> _Cells:
    """Return cells of a quadtree: of each open pixel the largest one that is open and even.

    Args:
        evenness: the cells of each side, the largest first.
        is_open: open pixels, bool [H, W].
        tolerance: largest standard deviation of colours within a cell.
    """
    missing = is_open.copy()
    cell_lists = []
    for side, color_variance, is_allowed in evenness:
        if is_allowed.size == 0:
            continue
        is_cell = _means_of_cells(missing.astype(np.float32), side) > 1 - 0.5 / side**2
        is_cell &= (color_variance < tolerance**2) & is_allowed
        cell_rows, cell_columns = np.nonzero(is_cell)
        cell_lists.append((cell_rows * side, cell_columns * side, np.full(len(cell_rows), side)))
        covered = is_cell.repeat(side, axis=0).repeat(side, axis=1)
        missing[: covered.shape[0], : covered.shape[1]] &= ~covered
    return _Cells(*(np.concatenate(parts) for parts in zip(*cell_lists, strict=True)))


def _discs(
    view: SolidView,
    depth: DenseDepth,
    is_sure: np.ndarray,
    cells: _Cells,
    walls: WallPlanes,
    other_views: Sequence[SolidView],
) -> Gaussians:
    """Return a disc for each cell, without those that other images see as sky.

    is_sure: bool [H, W], pixels whose surface is known, whatever other images show.
    """
    camera = view.camera
    half = (cells.sides // 2,) * 2
    middle_rows = np.minimum(cells.rows + half[0], camera.height - 1)
    middle_columns = np.minimum(cells.columns + half[1], camera.width - 1)
    rays = _rays_at(camera, cells.rows + cells.sides / 2, cells.columns + cells.sides / 2)
    depth_m = depth.depth_m[middle_rows, middle_columns]
    wall = depth.wall[middle_rows, middle_columns]
    centre = camera.centre.numpy()
    level = np.maximum(np.hypot(rays[:, 0], rays[:, 1]), 1e-9)
    colors, share = _colors_of_cells(view, cells)
    lab = view.lab[middle_rows, middle_columns]
    agreement = measure_agreement(centre + depth_m[:, None] * rays, lab, other_views)
    conflicts = agreement.conflicts
    doubt = agreement.doubt()
    is_sure_cell = is_sure[middle_rows, middle_columns]
    doubt[is_sure_cell] = 0
    conflicts[is_sure_cell & (conflicts < 0.3)] = 0
    unlikely = np.flatnonzero(doubt > 0)
    far_m = FAR_M / level[unlikely]
    far_points = centre + far_m[:, None] * rays[unlikely]
    far_agreement = measure_agreement(far_points, lab[unlikely], other_views)
    better = far_agreement.doubt() < doubt[unlikely]
    goes_far = unlikely[better]
    depth_m[goes_far] = far_m[better]
    wall[goes_far] = -1
    conflicts[goes_far] = far_agreement.conflicts[better]
    keep = conflicts <= _MAX_CONFLICTS
    surfels = _oriented_surfels(
        centre + (depth_m[:, None] * rays), rays, depth_m * cells.sides / camera.fx, wall, walls
    )
    semantic = depth.semantic[middle_rows, middle_columns]
    semantic = np.where(is_flat(semantic), np.int16(SemanticClass.UNKNOWN), semantic)
    index = np.flatnonzero(keep)
    discs = gaussians_from_surfels(surfels.select(index), colors[index], semantic[index], _SHAPE)
    opacities = np.minimum(_SHAPE.opacity, 1.2 * (1 - share[index])).astype(np.float32)
    return dataclasses.replace(discs, opacities=torch.from_numpy(opacities))


def _rays_at(camera: Camera, v: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the directions through image positions, with unit depth, world, float64 [M, 3]."""
    local = np.stack(
        [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))], axis=1
    )
    return local @ camera.camera_from_world[:3, :3].numpy().astype(np.float64)


def _oriented_surfels(
    points: np.ndarray, rays: np.ndarray, pitch_m: np.ndarray, wall: np.ndarray, walls: WallPlanes
) -> Surfels:
    """Return discs that lie on their walls, or face the camera.

    Args:
        points: float64 [M, 3], world.
        rays: float64 [M, 3], world.
        pitch_m: float64 [M], distance to the next disc across the rays.
        wall: int64 [M], number of the wall, -1 for none.
        walls: the walls.
    """
    toward = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    normals = toward.copy()
    stretch = np.ones(len(points))
    on_wall = wall >= 0
    if on_wall.any():
        plan = walls.normals[wall[on_wall]]
        normals[on_wall] = np.column_stack([plan, np.zeros(len(plan))])
        cosine = np.abs((normals[on_wall] * toward[on_wall]).sum(1))
        stretch[on_wall] = 1 / np.maximum(cosine, _MIN_COSINE)
    major = np.cross([0.0, 0.0, 1.0], normals)
    major /= np.maximum(np.linalg.norm(major, axis=1, keepdims=True), 1e-9)
    surfels = Surfels.discs(points, normals, major, pitch_m)
    spacing = np.stack([pitch_m * stretch, pitch_m], axis=1).astype(np.float32)
    return dataclasses.replace(surfels, spacing=spacing)


def _colors_of_cells(view: SolidView, cells: _Cells) -> tuple[np.ndarray, np.ndarray]:
    """Return mean colours without sky, float32 [M, 3] in [0, 1], and shares of sky, [M]."""
    images = np.dstack([view.matte.surface_rgb.astype(np.float64) / 255, view.matte.sky_share])
    sums = cv2.integral(images)  # [H + 1, W + 1, 4]
    rows = cells.rows
    columns = cells.columns
    last_rows = rows + cells.sides
    last_columns = columns + cells.sides
    total = sums[last_rows, last_columns] - sums[rows, last_columns]
    total += sums[rows, columns] - sums[last_rows, columns]
    means = total / (cells.sides**2)[:, None]
    return means[:, :3].clip(0, 1).astype(np.float32), means[:, 3].clip(0, 1)
