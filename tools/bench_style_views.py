"""Whether views of a styled scene agree as well as those of the clean one.

The protocol is augment.metrics.consistency's: a view is warped into another by the scene's depth.
Cameras show the scene's own colours, or what is measured would be how their exposures differ.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from augment.cameras import Camera
from augment.metrics.consistency import Consistency, DepthView, warped_consistency
from augment.plan import Plan, make_plan
from augment.scene import Scene
from augment.views import render_buffers
from recipes.schema import Output, Recipe, Render
from recipes.weather import Style
from tools.bench_flood_masks import neighbours

NEAR, FAR = 1, 7  # frames apart, as Lai et al. 2018 and its successors take them
KINDS = (f"{NEAR} frame apart", f"{FAR} frames apart", "neighbouring cameras")
_DEPTH = Output(depth="expected", labels=False)
_NEUTRAL = Render(exposure="neutral")
_MIN_SHARE = 0.01  # of a view that another shows; of less there is nothing to say


def bench_views(
    scene: Scene, frames: Sequence[int], presets: Sequence[str], width: int
) -> list[dict[str, Any]]:
    """A row a style, the clean scene first. Of each kind of pairs: rmse and relative (to the
    picture's own spread), pooled over pairs by how many pixels count, share (of the pixels that
    count), and the ratios of both errors to the clean scene's; None where no pair overlaps, and
    for ratios to nothing.
    """
    styles: dict[str, Style | None] = {"clean": None}
    for preset in presets:
        styles[preset] = Style(preset=preset)
    styles[f"{presets[0]}, reinhard"] = Style(preset=presets[0], method="reinhard")
    styles[f"{presets[0]}, strength 2"] = Style(preset=presets[0], strength=2)
    pairs = {kind: _pairs(scene, frames, kind, width) for kind in KINDS}
    rows: list[dict[str, Any]] = []
    for name, style in styles.items():
        plan = make_plan(Recipe(style=style, output=_DEPTH, render=_NEUTRAL), scene)
        found = {kind: _pooled(scene, plan, pairs[kind]) for kind in KINDS}
        for kind, each in found.items():
            clean = rows[0][kind] if rows else each
            if each is not None and clean is not None:
                for error in ("rmse", "relative"):
                    each[f"{error}_ratio"] = _ratio(each[error], clean[error])
        rows.append({"style": name, **found})
    return rows


def _pairs(
    scene: Scene, frames: Sequence[int], kind: str, width: int
) -> list[tuple[Camera, Camera]]:
    """Pairs of cameras at one time stamp."""
    found = []
    for index in frames:
        cameras = scene.frame(index).cameras
        if kind == KINDS[2]:
            chosen = [(cameras[a], cameras[b]) for a, b in neighbours(cameras) if a != b]
        else:
            numbers = [frame.index for frame in scene.frames]
            at = numbers.index(index) + (NEAR if kind == KINDS[0] else FAR)
            later = scene.frames[at].cameras if at < len(numbers) else {}
            name = min((n for n in cameras if "front" in n), key=len, default=next(iter(cameras)))
            chosen = [(cameras[name], later[name])] if name in later else []
        for one, other in chosen:
            then = dataclasses.replace(other, timestamp_ns=one.timestamp_ns)
            found.append((_small(one, width), _small(then, width)))
    return found


def _small(camera: Camera, width: int) -> Camera:
    return camera.scaled(width / camera.width)


def _pooled(
    scene: Scene, plan: Plan, pairs: Sequence[tuple[Camera, Camera]]
) -> dict[str, float | None] | None:
    seen: list[Consistency] = []
    for one, other in pairs:
        each = warped_consistency(_view(scene, one, plan), _view(scene, other, plan))
        if each.share >= _MIN_SHARE:
            seen.append(each)
    total = sum(each.share for each in seen)
    if not total > 0:
        return None
    rmse = math.sqrt(sum(each.share * each.rmse**2 for each in seen) / total)
    spread = math.sqrt(sum(each.share * each.spread**2 for each in seen) / total)
    return {
        "rmse": rmse,
        "relative": _ratio(rmse, spread),
        "share": total / len(seen),
        "pairs": len(seen),
    }


def _ratio(over: float | None, under: float | None) -> float | None:
    return over / under if over is not None and under else None


def _view(scene: Scene, camera: Camera, plan: Plan) -> DepthView:
    seen = render_buffers(scene, camera, plan)
    assert seen.raster.expected_depth is not None and seen.raster.alpha is not None
    return DepthView(
        camera,
        seen.rgb.clamp(0, 1).numpy(),
        seen.raster.expected_depth.numpy(),
        seen.raster.alpha.numpy(),
    )
