"""The road's height in a scene, and how it is known: what a flood's level counts from.

`Scene.ground` where the adapter measured it or the URI says it; else measured here, from the first
of these that gives an answer:

    lidar labels   returns that the dataset's annotators called road
    road splats    the background's Gaussians of that class
    ransac         level planes through low points near the path: LiDAR's, else solid Gaussians
    ego path       where the car must have stood; the adapter's estimate, where it made one

All of it needs metres and a world that is level.
"""

from __future__ import annotations

import importlib
import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from augment.errors import BackendUnavailable, SceneError
from augment.labels import ClassifiesLidar
from augment.memo import memo_of
from augment.render.threads import select_thread_pool
from augment.scene import Gaussians, Ground, GroundSource, Scene
from augment.semantics import SemanticClass

# ---- The height of a road along a driven path, from points that lie on it ------------------------
# The path is cut into stretches; each has the median height of the points in a corridor around it,
# so that neither a stray point nor the pavement decides.

STRETCH_M = 3.0
LEVEL_M = 6.0  # a road this far above or below the car is another one
# Half widths of the corridor across and along the path. A LiDAR sees no road right below itself,
# so that beside a short path the road must be sought further away.
_CORRIDORS_M = ((2.5, STRETCH_M / 2), (4.0, 4.0), (8.0, 8.0), (16.0, 16.0), (math.inf, math.inf))
_MIN_IN_STRETCH = 20
_MIN_IN_ALL = 200  # some returns near a sensor are mislabelled: a few are not enough
_MAX_MEASURED = 400_000
_STANDING_M = 0.5  # positions nearer to each other are noise of a car that stands
_STEEPEST = 0.15  # rise over run; no road is steeper over a stretch


@dataclass(frozen=True, eq=False)
class LocatedPoints:
    """For each of N points: its stretch, and metres to its middle along and across the path."""

    stretch: np.ndarray
    along_m: np.ndarray
    across_m: np.ndarray

    def within(self, across_m: float, along_m: float) -> np.ndarray:
        """Which points are, bool [N]."""
        return (self.across_m <= across_m) & (self.along_m <= along_m)


@dataclass(frozen=True, eq=False)
class Stretches:
    """The stretches of a path: their middles float64 [S, 3] and unit directions [S, 2]."""

    middles: np.ndarray
    headings: np.ndarray

    def __len__(self) -> int:
        return len(self.middles)

    @staticmethod
    def of(positions: np.ndarray) -> Stretches:
        """Points every STRETCH_M along positions float64 [P, 3], P >= 1, in order of time."""
        kept = [positions[0]]
        for position in positions[1:]:
            if np.hypot(*(position - kept[-1])[:2]) >= _STANDING_M:
                kept.append(position)
        if len(kept) == 1:
            return Stretches(np.array(kept, np.float64), np.array([[1.0, 0.0]]))
        corners = np.array(kept, np.float64)
        steps = np.hypot(*np.diff(corners[:, :2], axis=0).T)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        places = np.linspace(0, along[-1], 1 + max(1, round(along[-1] / STRETCH_M)))
        middles = np.stack([np.interp(places, along, c) for c in corners.T], axis=1)
        segment = np.clip(np.searchsorted(along, places, side="right") - 1, 0, len(steps) - 1)
        headings = np.diff(corners[:, :2], axis=0)[segment] / steps[segment, None]
        return Stretches(middles, headings)

    def locate(self, points: np.ndarray) -> LocatedPoints:
        """Which stretch each of the points [N, 3] is nearest to, seen from above, and where."""
        nearest = np.asarray(KDTree(self.middles[:, :2]).query(points[:, :2])[1])
        offset = points[:, :2] - self.middles[nearest, :2]
        heading = self.headings[nearest]
        along = (offset * heading).sum(1)
        across = offset[:, 1] * heading[:, 0] - offset[:, 0] * heading[:, 1]
        return LocatedPoints(nearest, np.abs(along), np.abs(across))


def measure_ground(
    points: np.ndarray, positions: np.ndarray, source: GroundSource, *, level_m: float = LEVEL_M
) -> Ground | None:
    """The road along positions float64 [P, 3] from points [N, 3] of its surface; both in the
    scene's world. None where there are too few.

    level_m: points further above or below the path are another road's.
    """
    stretches = Stretches.of(positions)
    points = np.asarray(points[:: 1 + len(points) // _MAX_MEASURED], np.float64)
    if len(points) < _MIN_IN_ALL:
        return None
    located = stretches.locate(points)
    level = np.abs(points[:, 2] - stretches.middles[located.stretch, 2]) <= level_m
    groups = _widest_known(located, level, len(stretches))
    if not groups:
        return None
    heights = np.array([np.median(points[index, 2]) for index in groups.values()])
    places = stretches.middles[list(groups), :2]
    used = points[np.concatenate(list(groups.values()))]
    residuals = [_plane(points[index])[1] for index in groups.values()]
    median_z = float(np.median(heights))
    return Ground(
        lowest_z_m=min(_lowest(heights, places), median_z),
        median_z_m=median_z,
        source=source,
        residual_m=float(np.median(np.abs(np.concatenate(residuals)))),
        points=len(used),
        tilt_deg=_tilt_deg(used),
    )


def _widest_known(located: LocatedPoints, level: np.ndarray, count: int) -> dict[int, np.ndarray]:
    """Indices of the points of each stretch that has enough of them; none where all have too few.

    The narrowest corridor in which half of the stretches are known, or else the one that knows
    most of them.
    """
    best: dict[int, np.ndarray] = {}
    for across_m, along_m in _CORRIDORS_M:
        groups = _by_stretch(located, level & located.within(across_m, along_m))
        if len(groups) > len(best) and sum(map(len, groups.values())) >= _MIN_IN_ALL:
            best = groups
        if 2 * len(best) >= count:
            break
    return best


def _by_stretch(located: LocatedPoints, chosen: np.ndarray) -> dict[int, np.ndarray]:
    index = np.flatnonzero(chosen)
    index = index[np.argsort(located.stretch[index], kind="stable")]
    numbers, first = np.unique(located.stretch[index], return_index=True)
    parts = np.split(index, first[1:])
    return {
        int(number): part
        for number, part in zip(numbers, parts, strict=False)  # no numbers still have one part
        if len(part) >= _MIN_IN_STRETCH
    }


def _lowest(heights: np.ndarray, places: np.ndarray) -> float:
    """The lowest of the heights [S] at places [S, 2] that a neighbour confirms: roads climb only
    so steeply, and a single wrong stretch must not set the level of a flood.
    """
    if len(heights) == 1:
        return float(heights[0])
    allowed = _STEEPEST * np.hypot(*np.diff(places, axis=0).T)
    rise = np.diff(heights)  # from each stretch to the next
    confirmed = np.zeros(len(heights), bool)
    confirmed[:-1] |= rise <= allowed
    confirmed[1:] |= -rise <= allowed
    return float(heights[confirmed].min())


def _plane(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slopes [2] of the least-squares plane over x and y, and residuals [N] at right angles."""
    local = points - points.mean(axis=0)
    slopes = np.linalg.lstsq(local[:, :2], local[:, 2], rcond=1e-6)[0]
    residuals = local[:, 2] - local[:, :2] @ slopes
    return slopes, residuals / math.sqrt(1 + float(slopes @ slopes))


def _tilt_deg(points: np.ndarray) -> float:
    """Angle to +z of the normal of one plane through all points, the furthest left out."""
    slopes, residuals = _plane(points)
    for _ in range(2):
        near = np.abs(residuals) <= max(3 * float(np.median(np.abs(residuals))), 0.01)
        points = points[near]
        slopes, residuals = _plane(points)
    return math.degrees(math.atan(float(np.hypot(*slopes))))


# ---- Which points lie on the ground where nothing is labelled: open3d's planes through low points
# One plane does not fit a road that bends and climbs, so each WINDOW_M of the path has its own.

WINDOW_M = 40.0
STEEPEST_DEG = 15.0  # a plane further from level is a wall's, a hillside's or a roof's
SYSTEM_LIBRARIES = "libusb-1.0-0, libgl1, libx11-6, libgomp1"
_THRESHOLD_M = 0.1  # a road's camber and unevenness, less than a kerb
_REACHES_M = (6.0, 16.0, math.inf)  # beside the path; beyond its ends, at least _BEYOND_M
_BEYOND_M = 20.0
_CELL_M, _CELLS_A_SIDE = 0.5, 200
_LOW_QUANTILE = 0.1  # in a cell; LiDAR has stray returns below the ground, splats even more
_MIN_POINTS, _MIN_SHARE = 30, 0.25  # of the low points, on a plane that is believed
_ITERATIONS, _TRIES = 500, 3  # a quarter of the points on a plane: missed once in 2600 times
_SEED = 20260101


def ground_points(points: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Those of the points [N, 3] that lie on a nearly level plane through low ones near the path
    positions [P, 3]; in the scene's world, metres. None, float64 [0, 3], where no plane is found.

    The same points give the same result every time.

    Raises:
        BackendUnavailable: open3d, or a library it needs, is not installed.
    """
    o3d = load_open3d()
    stretches = Stretches.of(positions)
    located = stretches.locate(points)
    window = located.stretch // math.ceil(WINDOW_M / STRETCH_M)
    for reach_m in _REACHES_M:
        near = located.within(reach_m, max(reach_m, _BEYOND_M))
        found = _on_planes(o3d, points, window, near)
        if found.any():
            return points[found]
    return np.zeros((0, 3))


def load_open3d() -> Any:
    """The module, for its planes.

    Raises:
        BackendUnavailable: it or a library it needs is missing; names Debian's packages.
    """
    # open3d carries an older TBB, which numba refuses. Of one name the library loaded first is used
    # by all, and open3d is content with ours.
    select_thread_pool()
    try:
        return importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        raise BackendUnavailable(
            f"open3d cannot be loaded ({error}); it is installed with `pip install open3d` and "
            f"needs Debian's packages {SYSTEM_LIBRARIES}"
        ) from error


def _on_planes(o3d: Any, points: np.ndarray, window: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Which points [N] lie on the plane of their window, bool."""
    found = np.zeros(len(points), bool)
    for number in np.unique(window[near]):
        index = np.flatnonzero(near & (window == number))
        plane = _level_plane(o3d, _low_points(points[index]))
        if plane is not None:
            found[index] = np.abs(points[index] @ plane[:3] + plane[3]) <= 1.5 * _THRESHOLD_M
    return found


def _low_points(points: np.ndarray) -> np.ndarray:
    """One low point of every cell of a grid seen from above."""
    corner = points[:, :2].min(axis=0)
    cell = max(_CELL_M, float(np.ptp(points[:, :2], axis=0).max()) / _CELLS_A_SIDE)
    x, y = np.floor((points[:, :2] - corner) / cell).astype(np.int64).T
    flat = x * (_CELLS_A_SIDE + 1) + y
    order = np.lexsort((points[:, 2], flat))
    _, first, count = np.unique(flat[order], return_index=True, return_counts=True)
    return points[order[first + (_LOW_QUANTILE * count).astype(int)]]


def _level_plane(o3d: Any, points: np.ndarray) -> np.ndarray | None:
    """Unit normal and offset [4] of the nearly level plane with the most points; None if no such
    plane has enough of them."""
    min_points = max(_MIN_POINTS, math.ceil(_MIN_SHARE * len(points)))
    for _ in range(_TRIES):
        if len(points) < min_points:
            return None
        middle = points.mean(axis=0)
        o3d.utility.random.seed(_SEED)
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points - middle))
        # A probability below 1 stops early, at a moment that depends on the threads' progress.
        model, inliers = cloud.segment_plane(_THRESHOLD_M, 3, _ITERATIONS, probability=1.0)
        if len(inliers) < min_points:
            return None
        normal = np.array(model[:3]) / np.linalg.norm(model[:3])
        if abs(normal[2]) >= math.cos(math.radians(STEEPEST_DEG)):
            return np.array([*normal, model[3] / np.linalg.norm(model[:3]) - normal @ middle])
        points = np.delete(points, inliers, axis=0)
    return None


# ---- The ground of a scene -----------------------------------------------------------------------

logger = logging.getLogger(__name__)

ROAD_CLASSES = (SemanticClass.ROAD, SemanticClass.LANE_MARKING)
CAMERA_HEIGHT_M = 1.5  # a guess: on a car, cameras are 1.2 m to 2 m above the road
# Cameras this far above the ego origin stand on a car whose origin is on the road, or near it.
_EGO_ON_ROAD_M = 0.8
_SWEEP_EVERY_M, _MIN_SWEEPS, _MAX_SWEEPS = 20.0, 3, 24
_SOLID_OPACITY = 0.3  # fainter Gaussians are haze and leftovers of training
_MAX_POINTS = 600_000


def ground_of(scene: Scene) -> Ground:
    """The road's heights under the scene's path: the same numbers every time.

    A measurement is kept in the scene's memo. Sweeps are read from disk;
    a drive of 100 m takes a second or two.

    Raises:
        SceneError: the scene's unit or its vertical is not known (the message asks for both), or it
            has no frames and so no path.
    """
    check_metric_and_level(scene)
    if scene.ground is not None:
        return scene.ground

    def find() -> Ground:
        ground = _measure(scene)
        logger.info("%s: %s", scene.name, ground_sentence(ground))
        return ground

    return memo_of(scene).get(("ground",), find)


def check_metric_and_level(scene: Scene) -> None:
    """Raises SceneError, which asks for both, where metres or gravity are not known."""
    lacks = {}  # what is not known: the option of a URI that says it
    if not scene.has_known_gravity:
        lacks["which way is up"] = "up=-y"
    if not scene.has_metric_scale:
        lacks["how long a unit is"] = "scale=0.35"
    if not lacks:
        return
    example = "gaussians:PATH?up=-y&scale=0.35"
    if scene.source.startswith("gaussians:"):
        example = scene.source + ("&" if "?" in scene.source else "?") + "&".join(lacks.values())
    raise SceneError(
        f"scene {scene.name!r} ({scene.source}): its ground cannot be told without metres and "
        f"gravity; not known: {' and '.join(lacks)}. Give both: for a splat file as in "
        f"{example}, where up is the file's axis that points up (or up=cameras, their "
        f"mean) and scale is metres per unit (scale=1 if it is in metres); for a recording, poses "
        f'in metres with z up, and no "has_metric_scale": false in calibration.json; for a scene '
        f"folder, fit it again from such a source"
    )


def ground_sentence(ground: Ground) -> str:
    """Heights, source and residual for people."""
    text = (
        f"lowest z = {ground.lowest_z_m:.2f} m, median {ground.median_z_m:.2f} m under the path; "
        f"{ground.source}"
    )
    if ground.points:
        text += f", {ground.points:,} points"
    if ground.residual_m is not None:
        text += f", residual {ground.residual_m * 100:.1f} cm"
    if ground.tilt_deg is not None:
        text += f", tilt {ground.tilt_deg:.1f} deg"
    return text


def measure_from_classes(
    points: np.ndarray, classes: np.ndarray, positions: np.ndarray
) -> Ground | None:
    """The ground from LiDAR points [N, 3] with SemanticClass values [N] (negative: no surface)
    along positions [P, 3], scene world: by their classes where those say road, else by planes.
    None where neither gives an answer.
    """
    road = points[np.isin(classes, ROAD_CLASSES)]
    ground = measure_ground(road, positions, "lidar labels")
    if ground is None:
        ground = _from_planes(points[classes >= 0], positions)
    return ground


def _measure(scene: Scene) -> Ground:
    if not scene.frames:
        raise SceneError(
            f"scene {scene.name!r} ({scene.source}) has no frames, so no path to find the road "
            f"under; give camera_path=FILE, or ground_z=HEIGHT, in its URI"
        )
    positions = np.stack([frame.world_from_ego[:3, 3].numpy() for frame in scene.frames])
    points, classes = _lidar(scene, positions)
    road = points[np.isin(classes, ROAD_CLASSES)]
    ground = measure_ground(road, positions, "lidar labels")
    if ground is None:
        ground = measure_ground(_road_splats(scene.background), positions, "road splats")
    if ground is None and len(points):
        ground = _from_planes(points[classes >= 0], positions)
    if ground is None:
        ground = _from_planes(_below_cameras(scene), positions, level_m=math.inf)
    return _from_path(scene, positions) if ground is None else ground


def _lidar(scene: Scene, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns [N, 3] of a handful of sweeps in the scene's world, and their classes int16 [N]."""
    points, classes = [np.zeros((0, 3))], [np.zeros(0, np.int16)]
    labels = scene.labels
    for index in _spread_frames(scene, positions):
        sweep = scene.lidar(index)
        if sweep is None:
            continue
        known = labels.lidar_classes(sweep) if isinstance(labels, ClassifiesLidar) else None
        if known is None:
            known = np.full(len(sweep), SemanticClass.UNKNOWN, np.int16)
        world = sweep.points_m - scene.world_origin_m
        finite = np.isfinite(world).all(axis=1)
        points.append(world[finite])
        classes.append(known[finite])
    return np.concatenate(points), np.concatenate(classes)


def _spread_frames(scene: Scene, positions: np.ndarray) -> Iterator[int]:
    """Numbers of frames spread over the drive, enough that their sweeps overlap."""
    length = float(np.hypot(*np.diff(positions[:, :2], axis=0).T).sum())
    count = min(_MAX_SWEEPS, _MIN_SWEEPS + int(length / _SWEEP_EVERY_M), len(scene.frames))
    for place in np.unique(np.linspace(0, len(scene.frames) - 1, count).round().astype(int)):
        yield scene.frames[place].index


def _road_splats(gaussians: Gaussians) -> np.ndarray:
    """Centres [N, 3] of the solid Gaussians of the road."""
    if gaussians.semantic is None:
        return np.zeros((0, 3))
    road = np.isin(gaussians.semantic.numpy(), ROAD_CLASSES)
    road &= gaussians.opacities.numpy() > _SOLID_OPACITY
    return gaussians.means.numpy()[road].astype(np.float64)


def _below_cameras(scene: Scene) -> np.ndarray:
    """Centres [N, 3] of solid Gaussians that are lower than the highest camera, thinned evenly."""
    gaussians = scene.background
    means = gaussians.means.numpy()
    keep = np.flatnonzero(gaussians.opacities.numpy() > _SOLID_OPACITY)
    tops = [float(c.centre[2]) for frame in scene.frames for c in frame.cameras.values()]
    if tops:
        keep = keep[means[keep, 2] < max(tops)]
    return means[keep[:: 1 + len(keep) // _MAX_POINTS]].astype(np.float64)


def _from_planes(
    points: np.ndarray, positions: np.ndarray, *, level_m: float = LEVEL_M
) -> Ground | None:
    """By open3d's planes; None, and a warning, where open3d cannot be had."""
    if len(points) == 0:
        return None
    try:
        found = ground_points(points[:: 1 + len(points) // _MAX_POINTS], positions)
    except BackendUnavailable as error:
        logger.warning("the road is not looked for among unlabelled points: %s", error)
        return None
    return measure_ground(found, positions, "ransac", level_m=level_m)


def _from_path(scene: Scene, positions: np.ndarray) -> Ground:
    """Without points: the adapter's estimate; else the ego origin, where cameras stand above it as
    on a car; else CAMERA_HEIGHT_M below the cameras' mean.
    """
    if scene.ground_z_m is not None:
        return Ground(scene.ground_z_m, scene.ground_z_m, "ego path")
    heights = positions[:, 2]
    centres = [[float(c.centre[2]) for c in frame.cameras.values()] for frame in scene.frames]
    cameras = np.array([np.mean(own) if own else math.nan for own in centres])
    seen = np.isfinite(cameras)
    if seen.any() and np.median((cameras - heights)[seen]) < _EGO_ON_ROAD_M:
        heights = cameras[seen] - CAMERA_HEIGHT_M
    return Ground(float(heights.min()), float(np.median(heights)), "ego path")
