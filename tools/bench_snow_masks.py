"""Whether neighbouring views agree on where snow is, and on its colour.

A view's pixels are carried by their rendered depth into another view of the same moment. Where the
depth drawn there is the same within SAME_SHARE and SAME_M, both see one place of the surface.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from augment.cameras import Camera
from augment.plan import make_plan
from augment.scene import Scene
from augment.views import render_buffers
from recipes.schema import Output, Recipe
from tools.bench_flood_masks import neighbours
from tools.bench_snow_cost import SHADINGS, snow_recipe

SAME_SHARE, SAME_M = 0.01, 0.05
DEPTH_ONLY = Output(depth="mode", labels=False)


@dataclass(frozen=True, eq=False)
class SnowView:
    """A picture in snow. rgb [H, W, 3], snow bool [H, W], depth [H, W]: z of what is drawn, 0 where
    nothing is.
    """

    camera: Camera
    rgb: np.ndarray
    snow: np.ndarray
    depth: np.ndarray


def snow_view(scene: Scene, camera: Camera, recipe: Recipe) -> SnowView:
    buffers = render_buffers(scene, camera, make_plan(recipe, scene))
    assert buffers.snow is not None and buffers.depth_m is not None
    return SnowView(
        camera,
        buffers.rgb.clamp(0, 1).numpy(),
        buffers.snow.numpy(),
        buffers.depth_m.to(torch.float64).numpy(),
    )


def pair_agreement(here: SnowView, there: SnowView) -> dict[str, Any]:
    """points: pixels of one view that the other sees, too. agreeing: share of equal masks among
    them. color_rms: in 1/255, of the colours where both are snow, a channel. Shares of nothing are
    None.
    """
    solid = here.depth > 0
    rays = here.camera.ray_directions(torch.float64).numpy()[solid]
    points = here.camera.centre.numpy() + here.depth[solid][:, None] * rays
    pose, camera = there.camera.camera_from_world.numpy(), there.camera
    local = points @ pose[:3, :3].T + pose[:3, 3]
    z = np.maximum(local[:, 2], 1e-9)
    column = np.floor(camera.fx * local[:, 0] / z + camera.cx)
    row = np.floor(camera.fy * local[:, 1] / z + camera.cy)
    height, width = there.depth.shape
    met = (local[:, 2] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    at = row[met].astype(np.int64), column[met].astype(np.int64)
    same = np.abs(there.depth[at] - z[met]) <= SAME_SHARE * z[met] + SAME_M
    ours, theirs = here.snow[solid][met][same], there.snow[at][same]
    both = ours & theirs
    colors = here.rgb[solid][met][same][both] - there.rgb[at][same][both]
    return {
        "points": int(same.sum()),
        "agreeing": float((ours == theirs).mean()) if len(ours) else None,
        "both": int(both.sum()),
        "color_rms": float(np.sqrt((colors**2).mean()) * 255) if both.any() else None,
    }


def bench_masks(
    scene: Scene, frames: Sequence[int], *, scale: float, cell_m: float = 0.05
) -> dict[str, Any]:
    """Pairs of neighbouring cameras, and of each camera with itself a frame later, taken at the
    first one's time; figures of both shadings, and of all pairs together.
    """
    figures = {}
    for shading in SHADINGS:
        recipe = snow_recipe(shading, cell_m=cell_m, output=DEPTH_ONLY)
        cameras, ahead = [], []
        for index in frames:
            frame = scene.frame(index)
            seen = _views(scene, frame.cameras, recipe, scale)
            for one, other in neighbours(frame.cameras):
                cameras.append(_named(f"{one} in {other}, frame {index}", seen[one], seen[other]))
            if index + 1 < len(scene.frames):
                then = scene.frame(index + 1).cameras
                moved = {
                    name: dataclasses.replace(then[name], timestamp_ns=camera.timestamp_ns)
                    for name, camera in frame.cameras.items()
                    if name in then
                }
                later = _views(scene, moved, recipe, scale)
                ahead += [
                    _named(f"{name} of frame {index} in {index + 1}", seen[name], view)
                    for name, view in later.items()
                ]
        figures[shading] = {"cameras": _all(cameras), "frames": _all(ahead)}
    return figures


def _views(scene: Scene, cameras: Any, recipe: Recipe, scale: float) -> dict[str, SnowView]:
    return {
        name: snow_view(scene, camera.scaled(scale), recipe) for name, camera in cameras.items()
    }


def _named(name: str, here: SnowView, there: SnowView) -> dict[str, Any]:
    return {"pair": name, **pair_agreement(here, there)}


def _all(pairs: list[dict[str, Any]]) -> dict[str, Any]:
    """Pairs that share something, and their figures weighed by their points."""
    pairs = [pair for pair in pairs if pair["points"]]
    points, both = (sum(pair[what] for pair in pairs) for what in ("points", "both"))
    agreeing = sum(pair["agreeing"] * pair["points"] for pair in pairs)
    squares = sum((pair["color_rms"] or 0) ** 2 * pair["both"] for pair in pairs)
    return {
        "points": points,
        "agreeing": agreeing / points if points else None,
        "color_rms": (squares / both) ** 0.5 if both else None,
        "pairs": pairs,
    }
