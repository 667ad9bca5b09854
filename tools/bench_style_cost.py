"""What a style costs: maps folded into SH; frames with fused maps and clean ones in turns."""

from __future__ import annotations

import time
from typing import Any

import torch
from tqdm import tqdm

from augment.cameras import Camera
from augment.effects.style.color_maps import CLASSES, StyleMaps, style_gaussians
from augment.plan import make_plan
from augment.scene import Gaussians, Scene
from augment.semantics import SemanticClass
from recipes.schema import Recipe
from recipes.weather import Style
from tools.bench_flood_error import PICTURE_ONLY
from tools.bench_pairs import spread, spread_ms, spread_ratio, time_in_turns
from tools.bench_scene import RasterCase, random_scene
from tools.bench_style_exact import with_directions


def front_camera(scene: Scene, width: int) -> Camera:
    """That of the middle frame, `width` pixels wide."""
    cameras = scene.frames[len(scene.frames) // 2].cameras
    name = min((n for n in cameras if "front" in n), key=len, default=next(iter(cameras)))
    return cameras[name].scaled(width / cameras[name].width)


def bench_apply(case: RasterCase, repeats: int) -> dict[str, Any]:
    """Milliseconds of one map, and of one for each class, on random Gaussians with SH 3: in place
    and into new memory; and how fast that reads and writes.
    """
    gaussians, _ = random_scene(case)
    classes = torch.arange(len(gaussians), dtype=torch.int16) % (max(SemanticClass) + 1)
    gaussians = Gaussians(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        semantic=classes,
    )
    moved = 2 * gaussians.sh.numel() * gaussians.sh.element_size()
    found: dict[str, Any] = {"gaussians": len(gaussians), "bytes": moved}
    maps = {"one map": some_maps(1), "a map a class": some_maps(CLASSES)}
    cases = [(name, where) for name in maps for where in ("in place", "new memory")]
    seconds: dict[tuple[str, str], list[float]] = {case: [] for case in cases}
    for repeat in range(repeats + 1):
        for name, where in cases if repeat % 2 else cases[::-1]:
            out = gaussians.sh if where == "in place" else None
            start = time.perf_counter()
            style_gaussians(gaussians, maps[name], out=out)
            seconds[name, where].append(time.perf_counter() - start)
    for (name, where), times in seconds.items():
        found[f"{name}, {where}"] = {
            "ms": spread_ms(times[1:]),
            "gb_per_s": spread([moved / each / 1e9 for each in times[1:]]),
        }
    return found


def some_maps(count: int) -> StyleMaps:
    """Gains about 0.9, so that colours stay finite however often they are mapped."""
    maps = 0.9 * torch.eye(3, 4).repeat(count, 1, 1)
    maps[:, :, 3] = 0.05
    maps[:, 0, 1] = torch.linspace(-0.05, 0.05, count)
    return StyleMaps(maps, maps[0], maps[0])


def bench_frames(
    scene: Scene, camera: Camera, preset: str, repeats: int, *, progress: bool = True
) -> dict[str, Any]:
    """Frames without a style, with one map, with one a region, and with one on the picture; of the
    scene as it is, and with SH 3 where its colours depend on no direction.
    """
    kinds = {"as it is": scene}
    if scene.background.sh.shape[1] == 1:
        kinds["SH 3"] = with_directions(scene)
    recipes = {
        "clean": Recipe(output=PICTURE_ONLY),
        "one map": Recipe(style=Style(preset=preset), output=PICTURE_ONLY),
        # A preset knows land and sky only; its maps by class are the same, and cost the same.
        "per region": Recipe(style=Style(preset=preset, per_region=True), output=PICTURE_ONLY),
        "on the picture": Recipe(
            style=Style(preset=preset, applied_to="picture"), output=PICTURE_ONLY
        ),
    }
    cases = []
    for kind, each in tqdm(kinds.items(), "styled frames", disable=not progress):
        plans = {name: make_plan(recipe, each) for name, recipe in recipes.items()}
        seconds = time_in_turns(each, camera, plans, repeats)
        for name in list(recipes)[1:]:
            cases.append(
                {
                    "case": f"{name}, {kind}",
                    "clean_ms": spread_ms(seconds["clean"]),
                    "styled_ms": spread_ms(seconds[name]),
                    "ratio": spread_ratio(seconds[name], seconds["clean"]),
                }
            )
    return {
        "camera": f"{camera.name} {camera.width}x{camera.height}",
        "gaussians": sum(len(part.gaussians) for part in scene.parts_for(camera)),
        "repeats": repeats,
        "cases": cases,
    }
