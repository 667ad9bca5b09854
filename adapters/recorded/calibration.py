"""How far a camera's images are shifted against the LiDAR, from what both see of surfaces.

Paint, signs and edges differ in reflectance as they do in brightness. Over a range of shifts of the
projected returns the information that intensity and grey value share is measured; it is highest
where they lie on each other (Pandey et al. 2012, here with shifts for rotations).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from adapters.lidar.depth import SparseDepth
from adapters.recorded.lidar_priors import visible
from adapters.recorded.views import RecordedViews
from augment.cameras import Camera
from augment.labels import LidarSweep
from augment.reconstruct.view import ViewKey
from augment.scene import Scene

_WIDTH = 480  # columns of the images compared, at most
_REACH_DEG = 1.2
_NEAR_M = 8.0  # nearer returns shift with the camera's position and time, not only its rotation
_BINS = 16
_MOST_POINTS = 60_000
_FEWEST_POINTS = 3000
_CONTRAST = 0.1  # how much the best shift must stand out
_AGREE_PX = 0.75  # between the measurement in every other frame and the rest
_ALONE_PX = 2.0  # a single frame says less, and less exactly
_INTENSITY, _SENSOR = ("intensity", "i"), ("sensor", "d")


@dataclass(frozen=True)
class CameraOffset:
    """Where a camera's images lie beside the LiDAR's returns, pixels at `width_px` columns.

    angle_deg: the same as an angle. is_sure: the shift stands out, lies within the range searched,
    and two halves of the frames agree on it.
    """

    camera: str
    right_px: float
    down_px: float
    width_px: int
    angle_deg: float
    is_sure: bool


@dataclass(frozen=True, eq=False)
class Returns:
    """A sweep's returns with intensity. points: float64 [N, 3], scene world. intensity: [N]."""

    points: np.ndarray
    intensity: np.ndarray


@dataclass(frozen=True, eq=False)
class Points:
    """Returns in one image: columns, rows int64 [M], intensity [M]; grey uint8 [H, W]."""

    columns: np.ndarray
    rows: np.ndarray
    intensity: np.ndarray
    grey: np.ndarray


def measure_offset(
    returns: Mapping[int, Returns], views: RecordedViews, cameras: Mapping[ViewKey, Camera]
) -> CameraOffset | None:
    """The shift of one camera's images; None if fewer than 3000 returns are seen.

    returns: by frame. cameras: the views to compare, at any resolution.
    """
    seen = [
        project_returns(
            returns[key.frame], views, key, camera,
            reach=_reach_px(_compared(camera)), near_m=_NEAR_M,
        )
        for key, camera in cameras.items()
        if key.frame in returns
    ]  # fmt: skip
    if sum(len(points.rows) for points in seen) < _FEWEST_POINTS:
        return None
    camera = _compared(next(iter(cameras.values())))
    reach = _reach_px(camera)
    score = shared_information(seen, reach)
    right, down = _peak(score)
    halves = [_peak(shared_information(half, reach)) for half in (seen[::2], seen[1::2]) if half]
    apart = max(math.hypot(right - h[0], down - h[1]) for h in halves)
    # Repeated shapes can look shifted to all frames together, but not to most of them one by one.
    single = [_peak(shared_information([points], reach)) for points in seen]
    near = [math.hypot(right - p[0], down - p[1]) < _ALONE_PX for p in single]
    contrast = float(score.max() / max(float(np.median(score)), 1e-12) - 1)
    inside = max(abs(right), abs(down)) < reach - 0.5
    return CameraOffset(
        camera=camera.name,
        right_px=right,
        down_px=down,
        width_px=camera.width,
        angle_deg=math.degrees(math.hypot(right / camera.fx, down / camera.fy)),
        # At the border of the range the shift is at least as large as that.
        is_sure=contrast > _CONTRAST
        and len(halves) == 2
        and (apart < _AGREE_PX or not inside)
        and 2 * sum(near) >= len(near),
    )


def _compared(camera: Camera) -> Camera:
    return camera.scaled(min(1.0, _WIDTH / camera.width))


def _reach_px(camera: Camera) -> int:
    return min(max(round(math.radians(_REACH_DEG) * camera.fx), 4), 16)


def _column(sweep: LidarSweep, names: Sequence[str]) -> np.ndarray | None:
    found = [name for name in names if name in sweep.columns]
    return np.asarray(sweep.columns[found[0]]) if found else None


def read_intensities(scene: Scene, frames: Iterable[int]) -> dict[int, Returns]:
    """The returns of each frame's sweep, of the sensor that has most; frames without intensity
    left out."""
    out: dict[int, Returns] = {}
    for frame in dict.fromkeys(frames):
        sweep = scene.lidar(frame)
        intensity = None if sweep is None else _column(sweep, _INTENSITY)
        if sweep is None or intensity is None:
            continue
        points = sweep.points_m - scene.world_origin_m
        use = np.isfinite(points).all(axis=1) & np.isfinite(intensity.astype(np.float64))
        sensor = _column(sweep, _SENSOR)
        if sensor is not None and len(sensor):
            names, counts = np.unique(sensor, return_counts=True)
            use &= sensor == names[counts.argmax()]  # each sensor has its own scale of intensity
        out[frame] = Returns(points[use], intensity[use])
    return out


def project_returns(
    returns: Returns,
    views: RecordedViews,
    key: ViewKey,
    camera: Camera,
    *,
    reach: int,
    near_m: float,
) -> Points:
    """The returns beyond near_m that `camera` sees, with the image of `key`. reach: pixels from the
    image's border that are left out."""
    camera = _compared(camera)
    grey = cv2.cvtColor(views.image(key), cv2.COLOR_RGB2GRAY)
    grey = cv2.resize(grey, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    pose = camera.camera_from_world.numpy()
    local = returns.points @ pose[:3, :3].T + pose[:3, 3]
    ahead = local[:, 2] > near_m
    local, intensity = local[ahead], returns.intensity[ahead]
    u = np.floor(camera.fx * local[:, 0] / local[:, 2] + camera.cx).astype(np.int64)
    v = np.floor(camera.fy * local[:, 1] / local[:, 2] + camera.cy).astype(np.int64)
    inside = (u >= reach) & (u < camera.width - reach) & (v >= reach) & (v < camera.height - reach)
    u, v, z, intensity = u[inside], v[inside], local[inside, 2], intensity[inside]
    order = np.lexsort((z, v * camera.width + u))
    first = np.ones(len(order), np.bool_)
    first[1:] = np.diff((v * camera.width + u)[order]) > 0
    chosen = order[first]
    uv = np.stack([u, v], 1)[chosen].astype(np.int32)
    front = visible(SparseDepth(uv, z[chosen].astype(np.float32), chosen), camera)
    kept = chosen[front]
    return Points(u[kept], v[kept], intensity[kept], grey)


def shared_information(seen: Sequence[Points], reach: int) -> np.ndarray:
    """Mutual information of intensity and grey value over their joint entropy for each shift,
    float64 [2 reach + 1, 2 reach + 1], rows of downward shifts."""
    stride = max(1, -(-sum(len(points.rows) for points in seen) // _MOST_POINTS))
    columns, rows, images, intensity = (
        np.concatenate(parts)
        for parts in zip(
            *(
                (p.columns[::stride], p.rows[::stride], np.full(len(p.rows[::stride]), i),
                 p.intensity[::stride])
                for i, p in enumerate(seen)
            ),
            strict=True,
        )
    )  # fmt: skip
    grey = np.stack([points.grey for points in seen])
    ranks = np.linspace(0, 1, _BINS + 1)[1:-1]
    a = np.searchsorted(np.quantile(intensity, ranks), intensity) * _BINS
    bins = np.quantile(grey[images, rows, columns], ranks)
    levels = np.searchsorted(bins, np.arange(256)).astype(np.int64)[grey]
    shifts = range(-reach, reach + 1)
    out = np.zeros((len(shifts), len(shifts)))
    for i, down in enumerate(shifts):
        for j, right in enumerate(shifts):
            b = levels[images, rows + down, columns + right]
            joint = np.bincount(a + b, minlength=_BINS**2) / len(a)
            both = _entropy(joint)
            table = joint.reshape(_BINS, _BINS)
            out[i, j] = (_entropy(table.sum(0)) + _entropy(table.sum(1)) - both) / max(both, 1e-12)
    return out


def _entropy(p: np.ndarray) -> float:
    p = p[p > 0]
    return float(-(p * np.log(p)).sum())


def _peak(score: np.ndarray) -> tuple[float, float]:
    """Shift to the right and down of the highest score, to fractions of a pixel by parabolas."""
    reach = len(score) // 2
    i, j = np.unravel_index(int(score.argmax()), score.shape)
    down, right = float(i) - reach, float(j) - reach
    if 0 < i < 2 * reach:
        down += _vertex(score[i - 1, j], score[i, j], score[i + 1, j])
    if 0 < j < 2 * reach:
        right += _vertex(score[i, j - 1], score[i, j], score[i, j + 1])
    return right, down


def _vertex(before: float, here: float, after: float) -> float:
    bend = before - 2 * here + after
    return 0.0 if bend == 0 else float(0.5 * (before - after) / bend)
