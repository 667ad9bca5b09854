"""Height of the road in a scene: the level that a flood counts from.

In: a scene. Out: a `Ground` (by `ground_of`): `Scene.ground` where the adapter measured it or the
URI says it. Else it is measured here, from the first of these that gives an answer:

    lidar labels   returns that the dataset's annotators called road
    road splats    the background's Gaussians of that class
    ransac         level planes through low points near the path: LiDAR's, else solid Gaussians
    ego path       where the car must have stood; the adapter's estimate, where it made one

All of these need metres and a world that is level. The flood effect and `climategs explain` call
`ground_of`; adapters call `measure_ground` and `measure_from_classes`.
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
from augment.memo import memo_of
from augment.render.threads import select_thread_pool
from augment.scene.labels import ClassifiesLidar
from augment.scene.scene import Gaussians, Ground, GroundSource, Scene
from augment.scene.semantics import SemanticClass

# ---- The height of a road along a driven path, from points that lie on it ------------------------
# The path is cut into stretches. Each has the median height of the points in a corridor around it,
# so that neither a stray point nor the pavement decides.

# Length of a stretch, metres.
STRETCH_M = 3.0
# Height above or below the car from which a road is another one, metres.
MAX_ROAD_HEIGHT_M = 6.0
# Half widths of the corridor across and along the path, metres. A LiDAR sees no road right below
# itself, so that beside a short path the road must be sought further away.
_CORRIDORS_M = ((2.5, STRETCH_M / 2), (4.0, 4.0), (8.0, 8.0), (16.0, 16.0), (math.inf, math.inf))
# Points that a stretch needs to count.
_MIN_IN_STRETCH = 20
# Points that all stretches need together: a few returns near a sensor are mislabelled.
_MIN_IN_ALL = 200
# Points that are measured at most; more are thinned evenly.
_MAX_MEASURED = 400_000
# Distance below which positions are noise of a car that stands, metres.
_STANDING_M = 0.5
# Rise over run that no road exceeds over a stretch.
_STEEPEST = 0.15


@dataclass(frozen=True, eq=False)
class LocatedPoints:
    """Places of N points beside a path."""

    stretch: np.ndarray
    """Stretch that each point is nearest to, [N]."""
    along_m: np.ndarray
    """Distance along the path from the stretch's middle, [N]."""
    across_m: np.ndarray
    """Distance across the path from the stretch's middle, [N]."""

    def within(self, across_m: float, along_m: float) -> np.ndarray:
        """Return the mask of points within a corridor, bool [N]."""
        return (self.across_m <= across_m) & (self.along_m <= along_m)


@dataclass(frozen=True, eq=False)
class Stretches:
    """The S stretches of a path."""

    middles: np.ndarray
    """Middle of each stretch, float64 [S, 3]."""
    headings: np.ndarray
    """Unit direction of each stretch, [S, 2]."""

    def __len__(self) -> int:
        return len(self.middles)

    @staticmethod
    def along_path(positions: np.ndarray) -> Stretches:
        """Return stretches of STRETCH_M along a path.

        Args:
            positions: the path, float64 [P, 3], P >= 1, in order of time.
        """
        corner_list = [positions[0]]
        for position in positions[1:]:
            if np.hypot(*(position - corner_list[-1])[:2]) >= _STANDING_M:
                corner_list.append(position)
        if len(corner_list) == 1:
            return Stretches(np.array(corner_list, np.float64), np.array([[1.0, 0.0]]))
        corners = np.array(corner_list, np.float64)
        steps = np.hypot(*np.diff(corners[:, :2], axis=0).T)
        path_lengths = np.concatenate([[0.0], np.cumsum(steps)])
        middle_lengths = np.linspace(
            0, path_lengths[-1], 1 + max(1, round(path_lengths[-1] / STRETCH_M))
        )
        middles = np.stack([np.interp(middle_lengths, path_lengths, c) for c in corners.T], axis=1)
        segment = np.clip(
            np.searchsorted(path_lengths, middle_lengths, side="right") - 1, 0, len(steps) - 1
        )
        headings = np.diff(corners[:, :2], axis=0)[segment] / steps[segment, None]
        return Stretches(middles, headings)

    def locate(self, points: np.ndarray) -> LocatedPoints:
        """Return the stretch nearest to each of the points [N, 3], seen from above, and their
        places.
        """
        nearest = np.asarray(KDTree(self.middles[:, :2]).query(points[:, :2])[1])
        offset = points[:, :2] - self.middles[nearest, :2]
        heading = self.headings[nearest]
        along = (offset * heading).sum(1)
        across = offset[:, 1] * heading[:, 0] - offset[:, 0] * heading[:, 1]
        return LocatedPoints(nearest, np.abs(along), np.abs(across))


def measure_ground(
    points: np.ndarray,
    positions: np.ndarray,
    source: GroundSource,
    *,
    max_height_m: float = MAX_ROAD_HEIGHT_M,
) -> Ground | None:
    """Return the road's heights along a path; None where there are too few points.

    Args:
        points: points of the road's surface, [N, 3], scene world.
        positions: the path, float64 [P, 3], scene world.
        source: origin of the points.
        max_height_m: height above or below the path from which points are another road's.
    """
    stretches = Stretches.along_path(positions)
    points = np.asarray(points[:: 1 + len(points) // _MAX_MEASURED], np.float64)
    if len(points) < _MIN_IN_ALL:
        return None
    located = stretches.locate(points)
    is_on_level = np.abs(points[:, 2] - stretches.middles[located.stretch, 2]) <= max_height_m
    groups = _group_points(located, is_on_level, len(stretches))
    if not groups:
        return None
    heights = np.array([np.median(points[index, 2]) for index in groups.values()])
    places = stretches.middles[list(groups), :2]
    road_points = points[np.concatenate(list(groups.values()))]
    residuals = [_fit_plane(points[index])[1] for index in groups.values()]
    median_z = float(np.median(heights))
    return Ground(
        lowest_z_m=min(_lowest_confirmed(heights, places), median_z),
        median_z_m=median_z,
        source=source,
        residual_m=float(np.median(np.abs(np.concatenate(residuals)))),
        points=len(road_points),
        tilt_deg=_tilt_deg(road_points),
    )


def _group_points(
    located: LocatedPoints, is_on_level: np.ndarray, count: int
) -> dict[int, np.ndarray]:
    """Return indices of the points of each stretch that has enough of them.

    The corridor is the narrowest one in which half of the stretches are known, or else the one in
    which most are known. Empty where all stretches have too few points.
    """
    best: dict[int, np.ndarray] = {}
    for across_m, along_m in _CORRIDORS_M:
        groups = _group_by_stretch(located, is_on_level & located.within(across_m, along_m))
        if len(groups) > len(best) and sum(map(len, groups.values())) >= _MIN_IN_ALL:
            best = groups
        if 2 * len(best) >= count:
            break
    return best


def _group_by_stretch(located: LocatedPoints, is_chosen: np.ndarray) -> dict[int, np.ndarray]:
    """Return indices of chosen points by stretch, for stretches with enough of them."""
    index = np.flatnonzero(is_chosen)
    index = index[np.argsort(located.stretch[index], kind="stable")]
    numbers, first = np.unique(located.stretch[index], return_index=True)
    parts = np.split(index, first[1:])
    return {
        int(number): stretch_points
        for number, stretch_points in zip(
            numbers, parts, strict=False
        )  # no numbers still have one part
        if len(stretch_points) >= _MIN_IN_STRETCH
    }


def _lowest_confirmed(heights: np.ndarray, places: np.ndarray) -> float:
    """Return the lowest of the heights [S] at places [S, 2] that a neighbour confirms.

    Roads climb only so steeply, and a single wrong stretch must not set the level of a flood.
    """
    if len(heights) == 1:
        return float(heights[0])
    max_rise = _STEEPEST * np.hypot(*np.diff(places, axis=0).T)
    rise = np.diff(heights)  # from each stretch to the next
    is_confirmed = np.zeros(len(heights), bool)
    is_confirmed[:-1] |= rise <= max_rise
    is_confirmed[1:] |= -rise <= max_rise
    return float(heights[is_confirmed].min())


def _fit_plane(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return slopes [2] of the least-squares plane over x and y, and residuals [N] at right
    angles.
    """
    local = points - points.mean(axis=0)
    slopes = np.linalg.lstsq(local[:, :2], local[:, 2], rcond=1e-6)[0]
    residuals = local[:, 2] - local[:, :2] @ slopes
    return slopes, residuals / math.sqrt(1 + float(slopes @ slopes))


def _tilt_deg(points: np.ndarray) -> float:
    """Return the angle to +z of one plane's normal through the points, the furthest left out."""
    slopes, residuals = _fit_plane(points)
    for _ in range(2):
        is_near = np.abs(residuals) <= max(3 * float(np.median(np.abs(residuals))), 0.01)
        points = points[is_near]
        slopes, residuals = _fit_plane(points)
    return math.degrees(math.atan(float(np.hypot(*slopes))))


# ---- Ground points where nothing is labelled: open3d's planes through low points -----------------
# One plane does not fit a road that bends and climbs, so each WINDOW_M of the path has its own.

# Length of the path that one plane fits, metres.
WINDOW_M = 40.0
# Slope of a plane from which it is a wall's, a hillside's or a roof's.
STEEPEST_DEG = 15.0
# Packages of Debian that open3d needs.
SYSTEM_LIBRARIES = "libusb-1.0-0, libgl1, libx11-6, libgomp1"
# Distance of a plane's points from it, metres: a road's camber and unevenness, less than a kerb.
_THRESHOLD_M = 0.1
# Distances beside the path within which the ground is sought, in order, metres.
_REACHES_M = (6.0, 16.0, math.inf)
# Distance beyond the path's ends within which the ground is sought, at least, metres.
_BEYOND_M = 20.0
# Side of a cell that gives one low point, metres.
_CELL_M = 0.5
# Cells along a side of the grid, at most; a larger grid has larger cells.
_CELLS_A_SIDE = 200
# Quantile of the heights in a cell that is its low point: LiDAR has stray returns below the ground,
# splats even more.
_LOW_QUANTILE = 0.1
# Low points on a plane that is believed, at least.
_MIN_POINTS = 30
# Share of the low points on a plane that is believed, at least.
_MIN_SHARE = 0.25
# Rounds of open3d's search: a plane of a quarter of the points is missed once in 2600 times.
_ITERATIONS = 500
# Planes that are tried in a window.
_TRIES = 3
# Seed of the search.
_SEED = 20260101


def ground_points(points: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Return the points that lie on a nearly level plane through low points near the path.

    The same points give the same result every time.

    Args:
        points: points, [N, 3], scene world, metres.
        positions: the path, [P, 3].

    Returns:
        The points of the ground, [M, 3]; none, float64 [0, 3], where no plane is found.

    Raises:
        BackendUnavailable: open3d, or a library it needs, is not installed.
    """
    o3d = load_open3d()
    stretches = Stretches.along_path(positions)
    located = stretches.locate(points)
    window = located.stretch // math.ceil(WINDOW_M / STRETCH_M)
    for reach_m in _REACHES_M:
        is_near = located.within(reach_m, max(reach_m, _BEYOND_M))
        is_on_plane = _on_planes(o3d, points, window, is_near)
        if is_on_plane.any():
            return points[is_on_plane]
    return np.zeros((0, 3))


def load_open3d() -> Any:
    """Return the module open3d, for its planes.

    Raises:
        BackendUnavailable: it or a library it needs is missing; names Debian's packages.
    """
    # open3d carries an older TBB, which numba refuses. The first loaded library of a name serves
    # all, and open3d is content with ours.
    select_thread_pool()
    try:
        return importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        raise BackendUnavailable(
            f"open3d cannot be loaded ({error}); it is installed with `pip install open3d` and "
            f"needs Debian's packages {SYSTEM_LIBRARIES}"
        ) from error


def _on_planes(o3d: Any, points: np.ndarray, window: np.ndarray, is_near: np.ndarray) -> np.ndarray:
    """Return the mask of points [N] that lie on the plane of their window."""
    is_on_plane = np.zeros(len(points), bool)
    for number in np.unique(window[is_near]):
        index = np.flatnonzero(is_near & (window == number))
        plane = _level_plane(o3d, _low_points(points[index]))
        if plane is not None:
            is_on_plane[index] = np.abs(points[index] @ plane[:3] + plane[3]) <= 1.5 * _THRESHOLD_M
    return is_on_plane


def _low_points(points: np.ndarray) -> np.ndarray:
    """Return one low point of every cell of a grid seen from above."""
    corner = points[:, :2].min(axis=0)
    cell = max(_CELL_M, float(np.ptp(points[:, :2], axis=0).max()) / _CELLS_A_SIDE)
    x, y = np.floor((points[:, :2] - corner) / cell).astype(np.int64).T
    flat = x * (_CELLS_A_SIDE + 1) + y
    order = np.lexsort((points[:, 2], flat))
    _, first, count = np.unique(flat[order], return_index=True, return_counts=True)
    return points[order[first + (_LOW_QUANTILE * count).astype(int)]]


def _level_plane(o3d: Any, points: np.ndarray) -> np.ndarray | None:
    """Return unit normal and offset [4] of the nearly level plane with the most points.

    None if no such plane has enough of them.
    """
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

# Classes of the road's surface.
ROAD_CLASSES = (SemanticClass.ROAD, SemanticClass.LANE_MARKING)
# Height of a camera above the road where it is not known, metres: on a car, 1.2 m to 2 m.
CAMERA_HEIGHT_M = 1.5
# Height of cameras above the ego origin from which that origin is on the road, or near it, metres.
_EGO_ON_ROAD_M = 0.8
# Path between two sweeps that are read, metres.
_SWEEP_EVERY_M = 20.0
# Sweeps that are read at least.
_MIN_SWEEPS = 3
# Sweeps that are read at most.
_MAX_SWEEPS = 24
# Opacity up to which Gaussians are haze and leftovers of training.
_SOLID_OPACITY = 0.3
# Points that planes are fitted to at most; more are thinned evenly.
_MAX_POINTS = 600_000


def ground_of(scene: Scene) -> Ground:
    """Return the road's heights under the scene's path, the same numbers every time.

    A measurement is kept in the scene's memo. Sweeps are read from disk; a drive of 100 m takes a
    second or two.

    Raises:
        SceneError: the scene's unit or its vertical is not known (the message asks for both), or it
            has no frames and so no path.
    """
    check_metric_and_level(scene)
    if scene.ground is not None:
        return scene.ground

    def find() -> Ground:
        ground = _measure_ground(scene)
        logger.info("%s: %s", scene.name, describe_ground(ground))
        return ground

    scene = scene.as_recorded
    return memo_of(scene).get(("ground",), find)


def check_metric_and_level(scene: Scene) -> None:
    """Check that metres and gravity are known.

    Raises:
        SceneError: one of them is not; the message asks for both.
    """
    uri_options = {}  # fact that is not known: option of a URI that states it
    if not scene.has_known_gravity:
        uri_options["which way is up"] = "up=-y"
    if not scene.has_metric_scale:
        uri_options["how long a unit is"] = "scale=0.35"
    if not uri_options:
        return
    example = "gaussians:PATH?up=-y&scale=0.35"
    if scene.source.startswith("gaussians:"):
        example = (
            scene.source + ("&" if "?" in scene.source else "?") + "&".join(uri_options.values())
        )
    raise SceneError(
        f"scene {scene.name!r} ({scene.source}): its ground cannot be told without metres and "
        f"gravity; not known: {' and '.join(uri_options)}. Give both: for a splat file as in "
        f"{example}, where up is the file's axis that points up (or up=cameras, their "
        f"mean) and scale is metres per unit (scale=1 if it is in metres); for a recording, poses "
        f'in metres with z up, and no "has_metric_scale": false in calibration.json; for a scene '
        f"folder, fit it again from such a source"
    )


def describe_ground(ground: Ground) -> str:
    """Return heights, source and residual as a text for people."""
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
    """Return the ground from classified LiDAR points; None where there is no answer.

    The points of the road are taken, or else planes through the points of any surface.

    Args:
        points: points, [N, 3], scene world.
        classes: SemanticClass values, [N]; negative: no surface.
        positions: the path, [P, 3], scene world.
    """
    road_points = points[np.isin(classes, ROAD_CLASSES)]
    ground = measure_ground(road_points, positions, "lidar labels")
    if ground is None:
        ground = _measure_by_planes(points[classes >= 0], positions)
    return ground


def _measure_ground(scene: Scene) -> Ground:
    """Return the road's heights from the first source that gives an answer."""
    if not scene.frames:
        raise SceneError(
            f"scene {scene.name!r} ({scene.source}) has no frames, so no path to find the road "
            f"under; give camera_path=FILE, or ground_z=HEIGHT, in its URI"
        )
    positions = np.stack([frame.world_from_ego[:3, 3].numpy() for frame in scene.frames])
    points, classes = _read_lidar(scene, positions)
    road_points = points[np.isin(classes, ROAD_CLASSES)]
    ground = measure_ground(road_points, positions, "lidar labels")
    if ground is None:
        ground = measure_ground(_road_splats(scene.background), positions, "road splats")
    if ground is None and len(points):
        ground = _measure_by_planes(points[classes >= 0], positions)
    if ground is None:
        ground = _measure_by_planes(_below_cameras(scene), positions, max_height_m=math.inf)
    return _estimate_from_path(scene, positions) if ground is None else ground


def _read_lidar(scene: Scene, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the returns [N, 3] of a handful of sweeps, scene world, and their classes int16
    [N].
    """
    points = [np.zeros((0, 3))]
    classes = [np.zeros(0, np.int16)]
    labels = scene.labels
    for index in _spread_frames(scene, positions):
        sweep = scene.lidar(index)
        if sweep is None:
            continue
        sweep_classes = labels.lidar_classes(sweep) if isinstance(labels, ClassifiesLidar) else None
        if sweep_classes is None:
            sweep_classes = np.full(len(sweep), SemanticClass.UNKNOWN, np.int16)
        world_points = sweep.points_m - scene.world_origin_m
        is_finite = np.isfinite(world_points).all(axis=1)
        points.append(world_points[is_finite])
        classes.append(sweep_classes[is_finite])
    return np.concatenate(points), np.concatenate(classes)


def _spread_frames(scene: Scene, positions: np.ndarray) -> Iterator[int]:
    """Yield numbers of frames spread over the drive, enough that their sweeps overlap."""
    length = float(np.hypot(*np.diff(positions[:, :2], axis=0).T).sum())
    count = min(_MAX_SWEEPS, _MIN_SWEEPS + int(length / _SWEEP_EVERY_M), len(scene.frames))
    for place in np.unique(np.linspace(0, len(scene.frames) - 1, count).round().astype(int)):
        yield scene.frames[place].index


def _road_splats(gaussians: Gaussians) -> np.ndarray:
    """Return the centres [N, 3] of the solid Gaussians of the road."""
    if gaussians.semantic is None:
        return np.zeros((0, 3))
    is_road = np.isin(gaussians.semantic.numpy(), ROAD_CLASSES)
    is_road &= gaussians.opacities.numpy() > _SOLID_OPACITY
    return gaussians.means.numpy()[is_road].astype(np.float64)


def _below_cameras(scene: Scene) -> np.ndarray:
    """Return centres [N, 3] of solid Gaussians below the highest camera, thinned evenly."""
    gaussians = scene.background
    means = gaussians.means.numpy()
    indices = np.flatnonzero(gaussians.opacities.numpy() > _SOLID_OPACITY)
    camera_heights = [float(c.centre[2]) for frame in scene.frames for c in frame.cameras.values()]
    if camera_heights:
        indices = indices[means[indices, 2] < max(camera_heights)]
    return means[indices[:: 1 + len(indices) // _MAX_POINTS]].astype(np.float64)


def _measure_by_planes(
    points: np.ndarray, positions: np.ndarray, *, max_height_m: float = MAX_ROAD_HEIGHT_M
) -> Ground | None:
    """Return the ground by open3d's planes; None, and a warning, where open3d cannot be had."""
    if len(points) == 0:
        return None
    try:
        road_points = ground_points(points[:: 1 + len(points) // _MAX_POINTS], positions)
    except BackendUnavailable as error:
        logger.warning("the road is not looked for among unlabelled points: %s", error)
        return None
    return measure_ground(road_points, positions, "ransac", max_height_m=max_height_m)


def _estimate_from_path(scene: Scene, positions: np.ndarray) -> Ground:
    """Return the ground without any points.

    It is the adapter's estimate; else the ego origin, where cameras stand above it as on a car;
    else CAMERA_HEIGHT_M below the cameras' mean.
    """
    if scene.ground_z_m is not None:
        return Ground(scene.ground_z_m, scene.ground_z_m, "ego path")
    heights = positions[:, 2]
    frame_camera_heights = [
        [float(c.centre[2]) for c in frame.cameras.values()] for frame in scene.frames
    ]
    camera_heights = np.array(
        [
            np.mean(frame_heights) if frame_heights else math.nan
            for frame_heights in frame_camera_heights
        ]
    )
    has_cameras = np.isfinite(camera_heights)
    if has_cameras.any() and np.median((camera_heights - heights)[has_cameras]) < _EGO_ON_ROAD_M:
        heights = camera_heights[has_cameras] - CAMERA_HEIGHT_M
    return Ground(float(heights.min()), float(np.median(heights)), "ego path")
