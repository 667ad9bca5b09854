"""How right snow is on the procedural street: what it covers, what it should not, and its height.

Cells are compared with the true surface, and so is the snow as it is drawn from straight above.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
import torch

from adapters.procedural import StreetTruth
from augment.cameras import Camera
from augment.effects.snow.cells import SnowSupport
from augment.effects.snow.height_map import Estimator
from augment.effects.snow.layer import build_snow_layer
from augment.effects.snow.light import illumination_of
from augment.effects.snow.near_camera import SnowCover
from augment.effects.snow.placement import PlacementSettings, place_snow_support
from augment.render.buffers import BUFFERS
from augment.render.constants import RasterSettings
from augment.render.layout import UNCUT
from augment.render.rasterize import rasterize
from augment.scene import PosedGaussians, Scene
from recipes.weather import Snow
from tools.bench_snow_cells import (
    OVER_M,
    at_edges,
    bed_heights,
    class_shares,
    covered_shares,
    height_error,
    sheltered_share,
    vehicle_shares,
)
from tools.bench_snow_truth import (
    TruePoints,
    camera_from_above,
    pixel_places,
    still,
    surface_below,
    true_points,
)

ESTIMATORS: tuple[Estimator, ...] = get_args(Estimator)
DEPTHS_M = (0.02, 0.1, 0.4)
COVERED = 0.5  # of a pixel
ALLOWED_SHARE, ALLOWED_M = 0.2, 0.01  # of the depth, and beside it: median height error


@dataclass(frozen=True)
class AccuracyCase:
    """reach_m: level distance from the cameras within which points are taken. pixel_m: of the view
    from above. every: points are every so many of its pixels along each axis.
    """

    reach_m: float = 32.0
    pixel_m: float = 0.05
    every: int = 3


def bench_accuracy(
    scene: Scene,
    truth: StreetTruth,
    *,
    cell_m: float = 0.05,
    case: AccuracyCase = AccuracyCase(),
    depths_m: Sequence[float] = DEPTHS_M,
    estimators: Sequence[Estimator] = ESTIMATORS,
) -> dict[str, Any]:
    """Figures of every estimator that placement can use."""
    cameras = [camera for frame in scene.frames for camera in frame.cameras.values()]
    moving, truth, settings = truth, still(truth), PlacementSettings(cell_m=cell_m)
    above = camera_from_above(cameras, reach_m=case.reach_m, pixel_m=case.pixel_m)
    pick = np.s_[case.every // 2 :: case.every, case.every // 2 :: case.every]
    xy = pixel_places(above)[pick].reshape(-1, 2)
    points = true_points(truth, cameras, xy, reach_m=case.reach_m)
    flat = points.chosen(points.is_seen & (points.slope < math.radians(settings.max_slope_deg)))
    edges, figures = at_edges(truth, flat), []
    scene_bias = scene_bias_m(scene, truth, flat, above)
    for estimator in estimators:
        settings = PlacementSettings(cell_m=cell_m, estimator=estimator)
        bed = place_snow_support(scene, cameras, settings)
        figures.append(
            {
                "estimator": estimator,
                "cells": len(bed.ground),
                **covered_shares(bed.ground, flat, edges),
                **sheltered_share(bed.ground, truth, points),
                "vehicles": vehicle_shares(bed, scene, moving),
                "bed_error_m": height_error(bed_heights(bed.ground, flat) - flat.z),
                "depths": [
                    drawn_figures(scene, bed, truth, flat, above, depth, scene_bias)
                    for depth in depths_m
                ],
            }
        )
    return {
        "points": len(points),
        "exposed_flat_seen": len(flat),
        "at_edges": float(edges.mean()),
        "reach_m": case.reach_m,
        "scene_bias_m": scene_bias,
        "estimators": figures,
    }


def scene_bias_m(scene: Scene, truth: StreetTruth, points: TruePoints, above: Camera) -> float:
    """How far the scene's own Gaussians are above the true surface where the points are: median of
    the centres of those that are heaviest there. A fitted or sampled surface has such an offset,
    which no placement can know.
    """
    out = rasterize([PosedGaussians(scene.background)], above, buffers=BUFFERS, clip=UNCUT)
    assert out.splat_ids is not None
    ids = np.unique(out.splat_ids.numpy()[_pixels(above, points.xy)])
    means = scene.background.means.numpy()[ids[ids >= 0]].astype(np.float64)
    off = means[:, 2] - surface_below(truth, means[:, :2])
    return float(np.median(off[np.abs(off) < OVER_M]))


def drawn_figures(
    scene: Scene,
    bed: SnowSupport,
    truth: StreetTruth,
    flat: TruePoints,
    above: Camera,
    depth_m: float,
    scene_bias: float,
) -> dict[str, Any]:
    """The snow as it is drawn from above: the points it covers; where it is drawn beneath what is
    open to the sky; and how far its surface is from the true one raised by its depth, and from that
    with the scene's own offset.
    """
    snow = Snow(depth_m=depth_m)
    cover = build_snow_layer(bed, scene, snow, illumination_of(scene, snow), seed=0)
    height, shown = draw_snow(scene, cover, above)
    rows, columns = _pixels(above, flat.xy)
    z, there = height[rows, columns], shown[rows, columns]
    on_it = there & (np.abs(z - depth_m - flat.z) <= OVER_M + 0.5 * depth_m)
    off = np.where(on_it, z - flat.z - depth_m, np.nan)
    allowed = ALLOWED_SHARE * depth_m + ALLOWED_M
    drawn_rows, drawn_columns = np.nonzero(shown)
    step = max(1, len(drawn_rows) // 400_000)
    drawn_rows, drawn_columns = drawn_rows[::step], drawn_columns[::step]
    places = pixel_places(above)[drawn_rows, drawn_columns]
    sunk = height[drawn_rows, drawn_columns] < surface_below(truth, places) - OVER_M
    return {
        "depth_m": depth_m,
        "gaussians": len(cover.ground.gaussians),
        "covered": class_shares(on_it, flat)["covered"],
        "sheltered": float(sunk.mean()) if len(sunk) else 0.0,
        "error_m": height_error(off),
        "error_on_scene_m": height_error(off - scene_bias),
        "allowed_m": allowed,
    }


def draw_snow(scene: Scene, cover: SnowCover, above: Camera) -> tuple[np.ndarray, np.ndarray]:
    """float64 and bool [H, W]: z of what is drawn of the still scene, and where it is snow."""
    own, layer = scene.background, cover.ground
    kept = PosedGaussians(
        type(own)(own.means, own.quats, own.scales, layer.opacities, own.sh, own.semantic)
    )
    out = rasterize(
        [kept, PosedGaussians(layer.gaussians, is_snow=True)],
        above,
        buffers=BUFFERS,
        settings=RasterSettings(sh_degree=0),
        clip=UNCUT,
    )
    assert out.mode_depth is not None and out.snow is not None
    height = float(above.centre[2]) - out.mode_depth.to(torch.float64).numpy()
    return height, out.snow.numpy() >= COVERED


def _pixels(above: Camera, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of places [P, 2] in a camera from above."""
    centre = above.centre.numpy()
    columns = np.floor((xy[:, 0] - centre[0]) * above.fx + above.cx).astype(np.int64)
    rows = np.floor((centre[1] - xy[:, 1]) * above.fy + above.cy).astype(np.int64)
    return rows, columns
