"""Depth priors: what a LiDAR sweep says of the depth at an image's pixels."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from adapters.lidar_scene.actor_motion import Motion, indices_between, inside_box
from adapters.lidar_scene.split import FLOOR_M, HALO_M, SKIN_M
from augment.cameras import Camera
from augment.errors import AdapterError
from augment.labels import EGO_VEHICLE, LidarSweep
from augment.scene import Scene

# ---- When each return of a sweep was measured, from whichever column says so ---------------------

_SAME_DRIVE_NS = 10_000_000_000  # times further from the frame's count from some other start


def sweep_times(sweep: LidarSweep, frame_ns: int) -> np.ndarray | None:
    """int64 [N] nanoseconds from the column timestamp_ns, or t in seconds; None where there is
    neither, where t has gaps, or where the times are not of the drive that the frame is of (such as
    times that count from the sweep's start).

    frame_ns: the frame's timestamp.

    Raises:
        ValueError: timestamp_ns holds anything but whole numbers or dates.
    """
    times = sweep.columns.get("timestamp_ns")
    if times is None:
        seconds = sweep.columns.get("t")
        if seconds is None or seconds.dtype.kind not in "fiu" or not np.isfinite(seconds).all():
            return None
        # Beyond 9e9 s int64 has no nanoseconds; such times are no times of this drive either.
        times = np.round(seconds.astype(np.float64).clip(-9e9, 9e9) * 1e9)
    times = whole_numbers(times, "timestamp_ns")
    near = len(times) == 0 or abs(int(np.median(times)) - frame_ns) <= _SAME_DRIVE_NS
    return times if near else None


def whole_numbers(column: np.ndarray, name: str) -> np.ndarray:
    """A column of whole numbers, or of dates (nanoseconds since 1970), as int64.

    Raises:
        ValueError: it holds anything else, or gaps.
    """
    if len(column) == 0:  # Arrow's type of an empty column may be anything
        return np.zeros(0, np.int64)
    if column.dtype.kind == "M" and not np.isnat(column).any():
        return column.astype("datetime64[ns]").astype(np.int64)
    is_whole = column.dtype.kind in "iu" or (
        column.dtype.kind == "f" and np.isfinite(column).all() and (column % 1 == 0).all()
    )
    if not is_whole:
        raise ValueError(
            f"column {name} must hold whole numbers without gaps; it is {column.dtype}"
        )
    if max(abs(float(column.min())), abs(float(column.max()))) > 2**62:
        raise ValueError(
            f"column {name} must hold numbers from -2^62 to 2^62; it holds {column.min()} to "
            f"{column.max()}"
        )
    return column.astype(np.int64)


# ---- depth ---------------------------------------------------------------------------------------

_NEAR_M = 0.1


@dataclass(frozen=True, eq=False)
class SparseDepth:
    """Depth at M pixels of one image, at most one a pixel, in order of rows.

    uv: int32 [M, 2], column and row. depth_m: float32 [M], along the optical axis.
    timestamp_ns: int64 [M], when the LiDAR saw the point.
    """

    uv: np.ndarray
    depth_m: np.ndarray
    timestamp_ns: np.ndarray

    def __len__(self) -> int:
        return len(self.depth_m)


@dataclass(frozen=True, eq=False)
class FrameReturns:
    """A frame's sweep, ready to be seen by any camera of the frame.

    points: float64 [N, 3], scene world, as the LiDAR saw them. timestamps_ns: int64 [N].
    carried: for each actor that has any, its motion, the indices of its returns, and their places
    in its own frame.
    """

    points: np.ndarray
    timestamps_ns: np.ndarray
    carried: tuple[tuple[Motion, np.ndarray, np.ndarray], ...]

    def __len__(self) -> int:
        return len(self.points)


def lidar_depth(
    scene: Scene, frame_index: int, camera: Camera, *, without_semantic: Collection[int] = ()
) -> SparseDepth:
    """The frame's sweep as the camera would see it, the nearest return of each pixel.

    Returns on a moving object are carried along its track from their own time to the camera's, and
    left out if the object is not there then; the lowest FLOOR_M of its box counts as ground.
    Without a sweep the result is empty. without_semantic: the dataset's class numbers of returns
    that are no surface, such as mirror images. LiDAR and camera look from different places: a
    pixel may show the depth of something that a nearer object hides from the camera.

    Raises:
        AdapterError: the sweep has no times (column timestamp_ns, or t in seconds) and its frame
            is none of the scene's, whose time would be taken.
    """
    returns = read_returns(scene, frame_index, without_semantic=without_semantic)
    if returns is None:
        return SparseDepth(np.zeros((0, 2), np.int32), np.zeros(0, np.float32), np.zeros(0, int))
    return depth_seen(returns, camera)


def read_returns(
    scene: Scene, frame_index: int, *, without_semantic: Collection[int] = ()
) -> FrameReturns | None:
    """The part of `lidar_depth` that all cameras of a frame share; None without a sweep."""
    sweep = scene.lidar(frame_index)
    if sweep is None:
        return None
    points = sweep.points_m - scene.world_origin_m
    times = _times(scene, sweep, frame_index)
    keep = np.isfinite(points).all(axis=1)
    if without_semantic and "semantic" in sweep.columns:
        keep &= ~np.isin(sweep.columns["semantic"], list(without_semantic))
    points, times = points[keep], times[keep]
    return FrameReturns(points, times, _on_actors(scene, points, times))


def depth_seen(returns: FrameReturns, camera: Camera) -> SparseDepth:
    """The part of `lidar_depth` that is the camera's own."""
    points = returns.points.copy()
    present = np.ones(len(points), dtype=bool)
    for motion, own, local in returns.carried:
        pose = motion.pose_at(camera.timestamp_ns)
        if pose is None:
            present[own] = False
        else:
            points[own] = local @ pose[:3, :3].T + pose[:3, 3]
    return _project(points[present], returns.timestamps_ns[present], camera)


def _times(scene: Scene, sweep: LidarSweep, frame_index: int) -> np.ndarray:
    frame_ns = next((f.timestamp_ns for f in scene.frames if f.index == frame_index), None)
    if frame_ns is not None:
        try:
            times = sweep_times(sweep, frame_ns)
        except ValueError as error:
            raise AdapterError(f"frame {frame_index}: its sweep's {error}") from None
        return np.full(len(sweep), frame_ns, np.int64) if times is None else times
    if "timestamp_ns" in sweep.columns:
        return sweep.columns["timestamp_ns"].astype(np.int64)
    if "t" in sweep.columns:
        return np.round(sweep.columns["t"].astype(np.float64) * 1e9).astype(np.int64)
    raise AdapterError(
        f"frame {frame_index}: the sweep must have a column timestamp_ns or t (seconds), so that "
        f"moving objects can be followed; it has {sorted(sweep.columns)}"
    )


def _on_actors(
    scene: Scene, points: np.ndarray, times: np.ndarray
) -> tuple[tuple[Motion, np.ndarray, np.ndarray], ...]:
    """For each actor with returns: its motion, their indices, and where they are on it."""
    found = []
    for actor in scene.actors if len(points) else ():
        if actor.label == EGO_VEHICLE:
            continue
        motion = Motion.of(actor.track)
        size_m = np.array(actor.size_m)
        low, high = motion.span(int(times.min()), int(times.max()))
        reach = float(np.linalg.norm(size_m)) / 2 + HALO_M
        near = indices_between(points, low - reach, high + reach)
        near = near[motion.exists_at(times[near])]
        local = motion.into_actor(points[near], times[near])
        own = inside_box(local, size_m, SKIN_M) & (local[:, 2] > FLOOR_M - size_m[2] / 2)
        if own.any():
            found.append((motion, near[own], local[own]))
    return tuple(found)


def _project(points: np.ndarray, times: np.ndarray, camera: Camera) -> SparseDepth:
    transform = camera.camera_from_world.numpy()
    local = points @ transform[:3, :3].T + transform[:3, 3]
    ahead = local[:, 2] > _NEAR_M
    local, times = local[ahead], times[ahead]
    u = np.floor(camera.fx * local[:, 0] / local[:, 2] + camera.cx)
    v = np.floor(camera.fy * local[:, 1] / local[:, 2] + camera.cy)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    u, v = u[inside].astype(np.int32), v[inside].astype(np.int32)
    depth, times = local[inside, 2].astype(np.float32), times[inside]
    pixel = v.astype(np.int64) * camera.width + u
    order = np.lexsort((depth, pixel))  # stable: of equal depths the sweep's first wins
    first = np.ones(len(order), dtype=bool)
    first[1:] = np.diff(pixel[order]) > 0
    chosen = order[first]
    return SparseDepth(np.stack([u, v], 1)[chosen], depth[chosen], times[chosen])
