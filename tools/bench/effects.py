"""What the effects' subjects share: the cost of a frame beside the clean one, whole and by stage,
its memory, and pairs of views that show one moment.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from tqdm import tqdm

from adapters.base import open_scene, parse_uri
from adapters.procedural import StreetTruth, open_truth
from augment.cameras import Camera
from augment.metrics.consistency import DepthView, find_warp
from augment.plan import make_plan
from augment.scene import Scene
from augment.timing import stopwatch
from augment.views import render_buffers
from recipes.schema import Recipe
from tools.bench.harness import (
    Action,
    Table,
    median_ms,
    peak_mib_in_subprocess,
    rounds,
    spread_ratio,
)
from tools.bench.scenes import PICTURE_ONLY, water_camera

CLEAN = Recipe(output=PICTURE_ONLY)
SMALL = 0.125  # resolution of the frame that loads kernels before memory is measured
NEXT_CAMERA = "next camera"
Cases = Mapping[str, tuple[Recipe, Recipe]]  # with the effect, and the clean frame beside it


@dataclass(frozen=True)
class EffectCase:
    """What an effect is measured on. scene: of its cost, in an image of width x height pixels.
    street: of its errors, procedural, because the truth must be known; frames, cameras, scale: of
    the street's views. cell_m: of snow near the path.
    """

    scene: str = "procedural:street?seed=3&frames=1&gaussians=1000000"
    width: int = 1600
    height: int = 1066
    street: str = "procedural:street?seed=3&frames=6"
    frames: tuple[int, ...] = (0, 5)
    cameras: tuple[str, ...] = ("front", "left", "back")
    scale: float = 1.0
    cell_m: float = 0.05

    def open_street(self) -> tuple[Scene, StreetTruth]:
        return open_scene(self.street), open_truth(parse_uri(self.street)[2])

    def views(self, street: Scene, scale: float = 1.0) -> list[Camera]:
        return [
            street.frame(frame).cameras[name].scaled(self.scale * scale)
            for frame in self.frames
            for name in self.cameras
        ]


WHOLE = EffectCase()
QUICK = EffectCase(
    scene="procedural:street?seed=3&frames=1",
    width=800,
    height=533,
    street="procedural:street?seed=3&frames=2&gaussians=120000",
    frames=(0,),
    cameras=("front",),
    scale=0.5,
    cell_m=0.1,
)


# ---- cost ---------------------------------------------------------------------------------------


def cost_tables(
    case: EffectCase, cases: Cases, staged: Sequence[str], *, repeats: int = 7, memory: bool = True
) -> list[Table]:
    """Frames of every case in turns with clean ones. staged: cases whose stages are shown, and of
    which memory is measured if `memory` is true.
    """
    scene = open_scene(case.scene)
    camera = water_camera(scene, case.width, case.height)
    rows, stages = [], {}
    for name, (recipe, clean) in tqdm(cases.items(), "frames", leave=False):
        both = {"effect": recipe, "clean": clean}
        seconds, laps = time_frames(scene, camera, both, repeats)
        ratio = spread_ratio(seconds["effect"], seconds["clean"])
        ms = {which: median_ms(each) for which, each in seconds.items()}
        rows.append([name, ms["clean"], ms["effect"], ratio["median"], ratio["min"], ratio["p90"]])
        if name in staged:
            stages.setdefault("clean", {**laps["clean"], "whole": ms["clean"]})
            stages[name] = {**laps["effect"], "whole": ms["effect"]}
    names = dict.fromkeys(stage for each in stages.values() for stage in each if stage != "whole")
    shown = [stage for stage in names if any(each.get(stage, 0) >= 0.1 for each in stages.values())]
    count = sum(len(part.gaussians) for part in scene.parts_for(camera))
    tables = [
        Table(
            f"Frames: {case.scene}, {count:,} Gaussians, {camera.name} {case.width}x{case.height}",
            ("case", "clean ms", "with it ms", "ratio", "least", "p90"),
            rows,
        ),
        Table(
            "Stages, ms; those below 0.1 left out",
            ("stage", *stages),
            [
                [stage, *(each.get(stage) for each in stages.values())]
                for stage in [*shown, "whole"]
            ],
        ),
    ]
    if memory:
        recipes = {"clean": cases[staged[0]][1], **{name: cases[name][0] for name in staged}}
        arguments = (case.scene, case.width, case.height)
        mib = [[name, frame_mib(*arguments, recipe)] for name, recipe in recipes.items()]
        tables.append(Table("Memory of a frame above its scene", ("case", "MiB"), mib))
    return tables


def time_frames(
    scene: Scene, camera: Camera, recipes: Mapping[str, Recipe], repeats: int
) -> tuple[dict[str, list[float]], dict[str, dict[str, float]]]:
    """Seconds of each recipe's frames as floats, and medians of their stages, milliseconds."""
    laps: dict[str, list[dict[str, float]]] = {name: [] for name in recipes}

    def frame_of(name: str, recipe: Recipe) -> Action:
        plan = make_plan(recipe, scene)

        def draw() -> None:
            with stopwatch() as seconds:
                render_buffers(scene, camera, plan)
            laps[name].append(seconds)

        return draw

    actions = {name: frame_of(name, recipe) for name, recipe in recipes.items()}
    seconds = rounds(actions, repeats, progress=False)
    return seconds, {
        name: {stage: median_ms([lap.get(stage, 0.0) for lap in each[1:]]) for stage in each[-1]}
        for name, each in laps.items()
    }


def frame_mib(uri: str, width: int, height: int, recipe: Recipe) -> float | None:
    """MiB of a frame above its scene, in a process of its own, which has drawn it small before, so
    that kernels, snow, maps and sky are there; None where the system cannot tell.
    """
    return peak_mib_in_subprocess(_frame_action, (uri, width, height, recipe))


def _frame_action(uri: str, width: int, height: int, recipe: Recipe) -> Action:
    scene = open_scene(uri)
    camera, plan = water_camera(scene, width, height), make_plan(recipe, scene)
    render_buffers(scene, camera.scaled(SMALL), plan)
    return lambda: render_buffers(scene, camera, plan)


# ---- views of one moment ------------------------------------------------------------------------


def view_pairs(
    scene: Scene,
    frames: Sequence[int],
    scale: float,
    *,
    ahead: Sequence[int] = (1,),
    names: Sequence[str] | None = None,
) -> Iterator[tuple[str, Camera, Camera]]:
    """Kind and cameras of pairs at one time: each camera and the next one clockwise; those of
    `names` (all, by default) and itself where it stands so many frames ahead.
    """
    for index in frames:
        frame = scene.frame(index)

        def then(camera: Camera, time: int = frame.timestamp_ns) -> Camera:
            return dataclasses.replace(camera.scaled(scale), timestamp_ns=time)

        own = {name: then(camera) for name, camera in frame.cameras.items()}
        yield from ((NEXT_CAMERA, own[a], own[b]) for a, b in neighbours(frame.cameras) if a != b)
        for step in ahead:
            later = next((f.cameras for f in scene.frames if f.index == index + step), {})
            for name in own if names is None else names:
                if name in later:
                    yield f"{step} ahead", own[name], then(later[name])


def neighbours(cameras: Mapping[str, Camera]) -> list[tuple[str, str]]:
    """Each camera and the next one clockwise, by their optical axes; from the first one on."""

    def bearing(name: str) -> float:
        ahead = cameras[name].world_from_camera[:3, 2]
        return math.atan2(float(ahead[1]), float(ahead[0]))

    ring = sorted(cameras, key=bearing, reverse=True)
    first = ring.index(next(iter(cameras)))
    ring = ring[first:] + ring[:first]
    return list(zip(ring, [*ring[1:], ring[0]], strict=True))


@dataclass(frozen=True, eq=False)
class MaskedView:
    """seen: whose depth says which points two views share. mask bool [H, W]: of the effect."""

    seen: DepthView
    mask: np.ndarray


def mask_agreement(
    pairs: Sequence[tuple[str, Camera, Camera]], view_of: Callable[[Camera], MaskedView]
) -> list[list[str | float | int | None]]:
    """By kind of pairs: points that both show; share of them with equal masks, of all pairs and of
    the worst; root mean square difference of colours, 1/255, where both masks are true.
    """
    view_of = functools.cache(view_of)
    found: dict[str, list[tuple[int, int, float, int]]] = {}
    for kind, one, other in pairs:
        here, there = view_of(one), view_of(other)
        warp = find_warp(here.seen, there.seen)
        ours = here.mask[warp.counts]
        images = np.concatenate([there.seen.picture, there.mask[..., None]], -1)
        theirs = warp.sample(images)[warp.counts]
        same = ours == (theirs[:, 3] > 0.5)
        both = ours & same
        off = here.seen.picture[warp.counts][both] - theirs[both, :3]
        found.setdefault(kind, []).append(
            (len(ours), int(same.sum()), float((off**2).sum()), int(both.sum()))
        )
    rows = []
    for kind, each in found.items():
        points, same, squares, both = (sum(column) for column in zip(*each, strict=True))
        worst = min((s / p for p, s, _, _ in each if p), default=None)
        rms = 255 * math.sqrt(squares / (3 * both)) if both else None
        rows.append([kind, points, same / points if points else None, worst, rms])
    return rows


def plain_view(camera: Camera, depth_m: np.ndarray, alpha: np.ndarray) -> DepthView:
    """A view without colours."""
    return DepthView(camera, np.zeros((*depth_m.shape, 3)), depth_m, alpha.astype(np.float64))


def rendered_view(scene: Scene, camera: Camera, recipe: Recipe) -> tuple[DepthView, torch.Tensor]:
    """A view by its expected depth, and the mask of its snow (of nothing where there is none)."""
    buffers = render_buffers(scene, camera, make_plan(recipe, scene))
    raster = buffers.raster
    assert raster.expected_depth is not None and raster.alpha is not None
    snow = (
        torch.zeros_like(raster.alpha, dtype=torch.bool) if buffers.snow is None else buffers.snow
    )
    picture = buffers.rgb.clamp(0, 1).numpy()
    return DepthView(camera, picture, raster.expected_depth.numpy(), raster.alpha.numpy()), snow
