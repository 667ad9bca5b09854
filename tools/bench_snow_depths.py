"""How far the three depth buffers of a camera are from the surface that it sees.

The truth is the procedural street's own, or a scene's LiDAR: its frame's sweep as the camera would
see it. LiDAR and camera look from different places: returns that most of those about them lie in
front of are taken for hidden from the camera and left out. Some are missed, and count as errors of
every estimator alike, at silhouettes above all.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from adapters.lidar_scene.depth import lidar_depth
from adapters.procedural import StreetTruth
from augment.cameras import Camera
from augment.render.buffers import BUFFERS as EVERY_BUFFER
from augment.render.buffers import EXPECTED_DEPTH, MEDIAN_DEPTH, MODE_DEPTH
from augment.render.layout import UNCUT
from augment.render.rasterize import rasterize
from augment.scene import Scene

# Depth of splats' centres as pictures hold it, and of their surfaces at the pixel's middle, as
# placement takes it; the median is of centres either way.
BUFFERS = {
    "expected": (EXPECTED_DEPTH, False),
    "median": (MEDIAN_DEPTH, False),
    "mode": (MODE_DEPTH, False),
    "expected, of surfaces": (EXPECTED_DEPTH, True),
    "mode, of surfaces": (MODE_DEPTH, True),
}
ZONES = ("overall", "smooth", "silhouettes")
JUMP_M = 0.5
NEAR_PX, FAR_PX = 2, 4  # from a jump: a silhouette is that near, a smooth surface farther away
LIDAR_GAP_PX = 7  # between a sweep's points in an image, about, at full resolution
HIDDEN_SHARE = 0.6  # of the returns about one; beside a straight silhouette half are nearer
REACH_M = 80.0
OFF_M = 0.1
COVERED = 0.5


def depth_buffers(scene: Scene, camera: Camera) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """float32 [H, W] of every estimator, and bool [H, W]: where the scene has a surface."""
    parts = scene.parts_for(camera)
    # With all buffers, because kernels for these alone would be compiled first.
    outputs = {
        False: rasterize(parts, camera, buffers=EVERY_BUFFER),
        True: rasterize(parts, camera, buffers=EVERY_BUFFER, clip=UNCUT),
    }
    found = {
        name: getattr(outputs[of_surfaces], buffer).numpy()
        for name, (buffer, of_surfaces) in BUFFERS.items()
    }
    alpha = outputs[False].alpha
    assert alpha is not None
    return found, alpha.numpy() >= COVERED


def true_zones(depth: np.ndarray) -> dict[str, np.ndarray]:
    """bool [H, W] of each zone, of a true depth [H, W]. Where the depth's slope changes by JUMP_M a
    pixel, the surface ends; far away the ground itself falls back by as much.
    """
    z = np.where(np.isfinite(depth), depth, 1e4)
    ends = np.zeros(z.shape, np.uint8)
    ends[:, 1:-1] |= np.abs(z[:, 2:] - 2 * z[:, 1:-1] + z[:, :-2]) > JUMP_M
    ends[1:-1] |= np.abs(z[2:] - 2 * z[1:-1] + z[:-2]) > JUMP_M
    return _zones(ends, depth <= REACH_M, NEAR_PX - 1, FAR_PX)  # a change spans the jump already


def lidar_zones(depth: np.ndarray, gap_px: int) -> dict[str, np.ndarray]:
    """The same of a sweep's depth [H, W], 0 where it has no point: where neighbouring points are
    JUMP_M apart.
    """
    known = (depth > 0) & ~hidden_returns(depth, 2 * gap_px)
    square = np.ones((2 * gap_px + 1, 2 * gap_px + 1), np.uint8)
    far = cv2.dilate(np.where(known, depth, -np.inf), square)
    near = cv2.erode(np.where(known, depth, np.inf), square)
    with np.errstate(invalid="ignore", over="ignore"):  # far from any point both are infinite
        jumps = known & (far - near > JUMP_M)
    inside = known & (depth <= REACH_M)
    return {"overall": inside, "smooth": inside & ~jumps, "silhouettes": inside & jumps}


def hidden_returns(depth: np.ndarray, reach_px: int) -> np.ndarray:
    """bool [H, W]: returns of a sweep's depth [H, W], 0 where it has none, that are JUMP_M or more
    behind HIDDEN_SHARE of those within reach_px.
    """
    rows, columns = np.nonzero(depth)
    padded = np.pad(depth, reach_px)
    own = depth[rows, columns]
    there, nearer = np.zeros(len(rows), np.int64), np.zeros(len(rows), np.int64)
    for down in range(2 * reach_px + 1):
        for right in range(2 * reach_px + 1):
            beside = padded[rows + down, columns + right]
            there += beside > 0
            nearer += (beside > 0) & (beside < own - JUMP_M)
    out = np.zeros(depth.shape, bool)
    out[rows, columns] = nearer > HIDDEN_SHARE * there
    return out


def _zones(
    ends: np.ndarray, inside: np.ndarray, near_px: int, far_px: int
) -> dict[str, np.ndarray]:
    def around(reach: int) -> np.ndarray:
        return cv2.dilate(ends, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0

    return {
        "overall": inside,
        "smooth": inside & ~around(far_px),
        "silhouettes": inside & around(near_px),
    }


def street_depths(
    scene: Scene, truth: StreetTruth, cameras: Sequence[Camera]
) -> dict[str, dict[str, Any]]:
    """Errors of every estimator in every zone, over all the cameras."""
    views = []
    for camera in cameras:
        true = truth.render(camera).depth
        views.append((camera, true, true_zones(true)))
    return _errors(scene, views)


def lidar_depths(
    scene: Scene, frames: Sequence[int], names: Sequence[str], scale: float
) -> dict[str, dict[str, Any]] | None:
    """The same against the sweeps of frames; None where the scene has none."""
    views = []
    for index in frames:
        for name in names:
            camera = scene.frame(index).cameras[name].scaled(scale)
            sparse = lidar_depth(scene, index, camera)
            if len(sparse) == 0:
                continue
            depth = np.zeros((camera.height, camera.width), np.float32)
            depth[sparse.uv[:, 1], sparse.uv[:, 0]] = sparse.depth_m
            views.append((camera, depth, lidar_zones(depth, max(2, round(LIDAR_GAP_PX * scale)))))
    return _errors(scene, views) if views else None


def _errors(
    scene: Scene, views: Sequence[tuple[Camera, np.ndarray, dict[str, np.ndarray]]]
) -> dict[str, dict[str, Any]]:
    found: dict[tuple[str, str], list[np.ndarray]] = {}
    for camera, true, zones in views:
        buffers, covered = depth_buffers(scene, camera)
        for zone, mask in zones.items():
            mask = mask & covered
            for name, depth in buffers.items():
                found.setdefault((name, zone), []).append(np.abs(depth[mask] - true[mask]))
    return {
        name: {zone: _figures(np.concatenate(found[name, zone])) for zone in ZONES}
        for name in BUFFERS
    }


def _figures(error: np.ndarray) -> dict[str, Any]:
    if len(error) == 0:
        return {"pixels": 0, "mean_m": None, "median_m": None, "off": None}
    return {
        "pixels": len(error),
        "mean_m": float(error.mean()),
        "median_m": float(np.median(error)),
        "off": float((error > OFF_M).mean()),
    }
