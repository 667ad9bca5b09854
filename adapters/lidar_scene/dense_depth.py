"""Depth for the pixels of a recorded image that show a surface where the LiDAR has none.

A LiDAR looks up some 15 degrees, a camera 20 and more, and what is dark, glossy or further than
the LiDAR's range returns nothing. A pixel there takes over a surface that is known elsewhere in
the image:

1. Known surfaces are seeds. So is, at a far distance, what lies within the LiDAR's view and
   returned nothing.
2. Every other pixel belongs to the seed with the cheapest path to it. A step costs its length,
   the difference of the photo's colours, and more through sky. Steps aside cost more than steps
   upward. Plants do not go on where the photo looks like no plant, nor walls where it does.
3. A pixel stands straight above its seed: at the same distance in plan. If the seed lies on a
   wall (`adapters.lidar_scene.wall_planes`), the pixel lies on the same plane.
4. Where a plant's path ends in what looks like no plant, a wall behind the plant goes on.

The callers are `adapters.lidar_scene.beyond_beams` and the measurement in `tools.bench`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
import torch

from adapters.lidar_scene.split import is_flat
from adapters.lidar_scene.wall_planes import WallPlanes
from augment.render.cpu.jit import cached_njit
from augment.scene.cameras import Camera
from augment.scene.semantics import SemanticClass

FAR_M = 300.0  # distance in plan of what is further than the LiDAR sees
# Things on the road: what is above them is something else, unless they reach the LiDAR's top.
_LOW_CLASSES = (SemanticClass.VEHICLE, SemanticClass.TWO_WHEELER, SemanticClass.PEDESTRIAN)
_SOLID_CLASSES = (
    SemanticClass.BUILDING,
    SemanticClass.BARRIER,
    SemanticClass.POLE,
    SemanticClass.SIGN,
    SemanticClass.OTHER,
)
_TOP_MARGIN_RAD = math.radians(3.0)  # below the LiDAR's top, from which a low thing may go on
_FAR_MARGIN_RAD = math.radians(4.0)  # below the top, up to which it surely looked: rings are sparse
_FAR_PART = 1 / 60  # of the image's width: distance from all surfaces of what is surely far
_BELOW_ROWS_PART = 1 / 16  # of the image's width: rows below the lowest unknown pixel with seeds
_UP_COST = 1.0  # cost of a step by a row, of an image of _COST_WIDTH columns
_ASIDE_COST = 5.0  # cost of a step by a column
_COST_WIDTH = 480.0  # columns of the image that costs are stated for
_SKY_COST = 3.0  # additional cost of a step through sky
_CLASS_COST = 6.0  # additional cost of a step through pixels that look like another class
_SWEEPS = 4  # sweeps over the image, from below and from above in turn
_ON_WALL_M = 0.5  # distance from a wall's plane of seeds that lie on it
_PROLONGED_M = 6.0  # length by which a wall may go on beyond its last known place
_WINDOW_PART = 1 / 8  # of the image's width: widest gap in a wall that is taken for glass
_PLANT_SHARE = 0.4  # probability of a plant below which a pixel is none
_MIN_SAMPLES = 50  # known pixels of plants, and of other things, that their colours are learnt from


class KnownSurface(NamedTuple):
    """Surfaces that are known in one image of H x W pixels."""

    depth_m: np.ndarray
    """Depth along the optical axis, float [H, W], infinite where no surface is known."""
    semantic: np.ndarray
    """Class of the surface, int16 [H, W]."""
    moves: np.ndarray
    """True for surfaces of moving objects, bool [H, W]."""


class DenseDepth(NamedTuple):
    """Depth of every pixel of an image. Pixels of sky have one too; it says nothing."""

    depth_m: np.ndarray
    """Depth along the optical axis, float64 [H, W]."""
    semantic: np.ndarray
    """Class of the surface, int16 [H, W]."""
    is_far: np.ndarray
    """True where the distance is FAR_M for want of any surface that goes on, bool [H, W]."""
    wall: np.ndarray
    """Number of the wall on which the surface lies, -1 for none, int64 [H, W]."""


def complete_depth(
    camera: Camera,
    rgb: np.ndarray,
    sky_share: np.ndarray,
    known_surface: KnownSurface,
    walls: WallPlanes,
    lidar_top_rad: float,
) -> DenseDepth:
    """Return a depth for every pixel of an image, the known one where there is one.

    Args:
        camera: the image's camera.
        rgb: the photo at the camera's size, uint8 [H, W, 3].
        sky_share: share of sky in each pixel, float32 [H, W].
        known_surface: known surfaces.
        walls: walls of the scene.
        lidar_top_rad: highest elevation that the LiDAR looks at.
    """
    is_known = np.isfinite(known_surface.depth_m)
    rays = camera.ray_directions(torch.float64).numpy()
    level = np.hypot(rays[..., 0], rays[..., 1])
    depth_m = np.where(is_known, known_surface.depth_m, FAR_M / np.maximum(level, 1e-9))
    semantic = known_surface.semantic.copy()
    is_far = ~is_known
    wall = np.full(is_known.shape, -1, np.int64)
    open_rows = np.flatnonzero((~is_known).any(axis=1))
    if len(open_rows):
        below = round(_BELOW_ROWS_PART * camera.width)
        rows = slice(0, min(int(open_rows[-1]) + 1 + below, camera.height))
        part = _complete_rows(
            camera.centre.numpy(),
            rays[rows],
            rgb[rows],
            sky_share[rows],
            KnownSurface(*(image[rows] for image in known_surface)),
            walls,
            lidar_top_rad,
        )
        depth_m[rows] = np.where(is_known[rows], depth_m[rows], part.depth_m)
        semantic[rows] = np.where(is_known[rows], semantic[rows], part.semantic)
        is_far[rows] &= part.is_far
        wall[rows] = part.wall
    return DenseDepth(depth_m, semantic, is_far, wall)


def _complete_rows(
    centre: np.ndarray,
    rays: np.ndarray,
    rgb: np.ndarray,
    sky_share: np.ndarray,
    known_surface: KnownSurface,
    walls: WallPlanes,
    lidar_top_rad: float,
) -> DenseDepth:
    """Return depths of the image's upper rows. Arguments as in `complete_depth`."""
    is_known = np.isfinite(known_surface.depth_m)
    width = rgb.shape[1]
    level = np.maximum(np.hypot(rays[..., 0], rays[..., 1]), 1e-9)
    elevation_rad = np.arctan2(rays[..., 2], level)
    plan_m = np.where(is_known, known_surface.depth_m, 0.0) * level  # distance in plan
    lab = cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    plant_share = _plant_share(rgb, lab, is_known, known_surface.semantic)

    is_low = np.isin(known_surface.semantic, _LOW_CLASSES) & (
        elevation_rad < lidar_top_rad - _TOP_MARGIN_RAD
    )
    is_seed = is_known & ~is_flat(known_surface.semantic) & ~is_low & ~known_surface.moves
    is_far_seed = _find_far(is_known, elevation_rad, lidar_top_rad, sky_share)
    plan_m[is_far_seed] = FAR_M
    wall = _walls_of_seeds(centre, rays, level, plan_m, is_seed, known_surface.semantic, walls)
    is_plant = (known_surface.semantic == SemanticClass.VEGETATION) & is_seed

    seed = _cheapest_seeds(
        lab,
        is_seed | is_far_seed,
        is_plant,
        (_SKY_COST * sky_share).astype(np.float32),
        plant_share,
        np.float32(_UP_COST * _COST_WIDTH / width),
        np.float32(_ASIDE_COST * _COST_WIDTH / width),
        np.float32(_CLASS_COST * _COST_WIDTH / width),
        _SWEEPS,
    )
    has_seed = seed >= 0
    seed = np.maximum(seed, 0)
    out_m = np.where(has_seed, plan_m.ravel()[seed], FAR_M)
    is_far = ~has_seed | is_far_seed.ravel()[seed]
    semantic = known_surface.semantic.ravel()[seed]
    directions = rays[..., :2] / level[..., None]
    seed_wall = wall
    wall = np.where(is_known, -1, seed_wall.ravel()[seed])
    _stand_on_walls(out_m, wall, centre, directions, walls)
    behind = ~is_known & is_plant.ravel()[seed] & (plant_share < _PLANT_SHARE) & has_seed
    is_wall_behind = _meet_walls_behind(out_m, wall, behind, centre, directions, walls)
    semantic = np.where(is_wall_behind, np.int16(SemanticClass.BUILDING), semantic)
    if (known_surface.semantic[is_known] != SemanticClass.UNKNOWN).any():
        looks_like = np.where(
            plant_share > 1 - _PLANT_SHARE, SemanticClass.VEGETATION, SemanticClass.BUILDING
        )
        semantic = np.where(is_far, looks_like, semantic)
    smooth_m = np.exp(cv2.medianBlur(np.log(out_m).astype(np.float32), 5)).astype(np.float64)
    out_m = np.where(is_known | (wall >= 0), out_m, smooth_m)
    wall = np.where(is_known, seed_wall, wall)
    return DenseDepth(out_m / level, semantic.astype(np.int16), is_far, wall)


def _find_far(
    is_known: np.ndarray, elevation_rad: np.ndarray, lidar_top_rad: float, sky_share: np.ndarray
) -> np.ndarray:
    """Return the pixels that the LiDAR looked at without a return, bool [H, W].

    They lie apart from all surfaces and below none: between two rings on one wall there is wall.
    """
    looked_at = (elevation_rad > 0) & (elevation_rad < lidar_top_rad - _FAR_MARGIN_RAD)
    apart_px = cv2.distanceTransform((~is_known).astype(np.uint8), cv2.DIST_L2, 5)
    is_below_surface = np.maximum.accumulate(is_known, axis=0)
    return (
        looked_at
        & ~is_below_surface
        & (apart_px > _FAR_PART * is_known.shape[1])
        & (sky_share < 0.5)
    )


def _plant_share(
    rgb: np.ndarray, lab: np.ndarray, is_known: np.ndarray, semantic: np.ndarray
) -> np.ndarray:
    """Return the probability that each pixel shows a plant, float32 [H, W]; 0.5 if unknown.

    Colour and roughness of the photo at known plants and at other known things are two normal
    distributions.
    """
    plants = is_known & (semantic == SemanticClass.VEGETATION)
    other_things = is_known & np.isin(semantic, _SOLID_CLASSES)
    if min(plants.sum(), other_things.sum()) < _MIN_SAMPLES:
        return np.full(is_known.shape, 0.5, np.float32)
    mean = cv2.blur(lab[..., 0], (7, 7))
    variance = np.maximum(cv2.blur(lab[..., 0] ** 2, (7, 7)) - mean * mean, 0)
    # A unit of roughness is to count about as much as a unit of colour.
    features = np.dstack([cv2.blur(lab, (5, 5)), 6 * np.log(np.sqrt(variance) + 1)])
    evidence = _log_density(features, other_things) - _log_density(features, plants)
    share = 1 / (1 + np.exp(np.clip(evidence, -30, 30)))
    return cv2.ximgproc.guidedFilter(rgb, share.astype(np.float32), 6, 200.0)


def _log_density(features: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Return the logarithm of the samples' normal density at all pixels, but for a constant."""
    values = features[samples].astype(np.float64)
    mean = values.mean(axis=0)
    covariance = np.cov(values.T) + np.eye(values.shape[1])
    offset = (features - mean).astype(np.float32)
    inverse = np.linalg.inv(covariance).astype(np.float32)
    squares = ((offset @ inverse) * offset).sum(-1)
    return -0.5 * (squares + np.linalg.slogdet(covariance)[1])


def _walls_of_seeds(
    centre: np.ndarray,
    rays: np.ndarray,
    level: np.ndarray,
    plan_m: np.ndarray,
    is_seed: np.ndarray,
    semantic: np.ndarray,
    walls: WallPlanes,
) -> np.ndarray:
    """Return the number of the wall that each seed lies on, -1 for none, int64 [H, W].

    Seeds behind the glass of a wall are moved onto it: their plan_m is changed in place.
    """
    wall = np.full(is_seed.shape, -1, np.int64)
    if not len(walls):
        return wall
    may_lie = is_seed & (semantic != SemanticClass.VEGETATION)
    directions = rays[..., :2] / level[..., None]
    places = centre[:2] + plan_m[may_lie][:, None] * directions[may_lie]
    wall[may_lie] = walls.nearest(places, _ON_WALL_M, 1.0)
    window = np.ones((1, 2 * round(_WINDOW_PART * is_seed.shape[1] / 2) + 1), np.uint8)
    for number in np.unique(wall[wall >= 0]):
        closed = cv2.morphologyEx((wall == number).astype(np.uint8), cv2.MORPH_CLOSE, window)
        gap = (closed > 0) & may_lie & (wall != number)
        if gap.any():
            distance = walls.meet(int(number), centre[:2], directions[gap], 0.0)
            is_behind = distance < plan_m[gap]
            rows, columns = (index[is_behind] for index in np.nonzero(gap))
            plan_m[rows, columns] = distance[is_behind]
            wall[rows, columns] = number
    return wall


def _stand_on_walls(
    plan_m: np.ndarray,
    wall: np.ndarray,
    centre: np.ndarray,
    directions: np.ndarray,
    walls: WallPlanes,
) -> None:
    """Move pixels onto their walls: plan_m and wall [H, W] are changed in place.

    A pixel whose ray does not meet its wall keeps its distance, and has no wall.
    """
    for number in np.unique(wall[wall >= 0]):
        rows, columns = np.nonzero(wall == number)
        distance = walls.meet(int(number), centre[:2], directions[rows, columns], _PROLONGED_M)
        meets = distance < FAR_M
        plan_m[rows[meets], columns[meets]] = distance[meets]
        wall[rows[~meets], columns[~meets]] = -1


def _meet_walls_behind(
    plan_m: np.ndarray,
    wall: np.ndarray,
    pixels: np.ndarray,
    centre: np.ndarray,
    directions: np.ndarray,
    walls: WallPlanes,
) -> np.ndarray:
    """Move pixels to the nearest wall behind them, in place.

    Returns:
        The pixels that were moved, bool [H, W].
    """
    rows, columns = np.nonzero(pixels)
    nearest = np.full(len(rows), FAR_M)
    number_of_nearest = np.full(len(rows), -1, np.int64)
    nearest_possible = plan_m[rows, columns] + _ON_WALL_M
    for number in range(len(walls) if len(rows) else 0):
        distance = walls.meet(number, centre[:2], directions[rows, columns], 1.0)
        is_nearer = (distance > nearest_possible) & (distance < nearest)
        nearest[is_nearer] = distance[is_nearer]
        number_of_nearest[is_nearer] = number
    meets = number_of_nearest >= 0
    plan_m[rows[meets], columns[meets]] = nearest[meets]
    wall[rows[meets], columns[meets]] = number_of_nearest[meets]
    moved = np.zeros(pixels.shape, np.bool_)
    moved[rows[meets], columns[meets]] = True
    return moved


@cached_njit(nogil=True)
def _cheapest_seeds(
    lab, is_seed, is_plant, sky_cost, plant_share, up_cost, aside_cost, class_cost, sweeps
):  # pragma: no cover - compiled
    """Return the flat index of the seed with the cheapest path to each pixel, int64 [H, W].

    A raster scan propagates costs from pixel to pixel, from below and from above in turn (Toivanen
    1996, New geodesic distance transforms for gray-scale images). -1 where there is no seed at all.

    Args:
        lab: float32 [H, W, 3], the photo's colours.
        is_seed, is_plant: bool [H, W], seeds, and those of them that are plants.
        sky_cost: float32 [H, W], added to a step into each pixel.
        plant_share: float32 [H, W], probability of a plant.
        up_cost, aside_cost: costs of a row and a column.
        class_cost: cost of a step into a pixel that surely looks like the other kind.
        sweeps: number of sweeps.
    """
    height, width = is_seed.shape
    cost = np.full((height, width), np.float32(1e9), np.float32)
    seed = np.full((height, width), -1, np.int64)
    for y in range(height):
        for x in range(width):
            if is_seed[y, x]:
                cost[y, x] = 0
                seed[y, x] = y * width + x
    diagonal_cost = np.sqrt(up_cost * up_cost + aside_cost * aside_cost)
    for sweep in range(sweeps):
        step = -1 if sweep % 2 == 0 else 1  # upward first
        for row in range(height):
            y = row if step > 0 else height - 1 - row
            for column in range(width):
                x = column if step > 0 else width - 1 - column
                if is_seed[y, x]:
                    continue
                best = cost[y, x]
                best_seed = seed[y, x]
                for dy in range(-1, 2):
                    for dx in range(-1, 2):
                        ny = y + dy
                        nx = x + dx
                        if ny < 0 or ny >= height or nx < 0 or nx >= width or seed[ny, nx] < 0:
                            continue
                        if (dy == 0 and dx == 0) or cost[ny, nx] >= best:
                            continue
                        difference = 0.0
                        for channel in range(3):
                            difference += (lab[y, x, channel] - lab[ny, nx, channel]) ** 2
                        length = up_cost
                        if dx != 0:
                            length = aside_cost if dy == 0 else diagonal_cost
                        source = seed[ny, nx]
                        share = plant_share[y, x]
                        if is_plant[source // width, source % width]:
                            length += class_cost * (1 - share)
                        else:
                            length += class_cost * share / 2
                        length += sky_cost[y, x] + np.sqrt(difference)
                        total = cost[ny, nx] + length
                        if total < best:
                            best = total
                            best_seed = source
                cost[y, x] = best
                seed[y, x] = best_seed
    return seed
