"""Speed for accuracy: what each knob of a recipe costs and saves on a scene, and the tiers.

Settings are timed a few at a time, in turns with the reference and the clean frame; ratios are
taken within each turn. Pictures are compared in 8 bits by PSNR, SSIM and FLIP. Flicker is what is
left in time: with E_t the picture less the reference's at frame t, E_(t+1) is warped into frame t
by the reference's depth, so that the drive's motion does not count, and flicker is the root mean
square of E_t - warped E_(t+1): 0 for an error that sticks to its surface, sqrt(2) times the error's
own RMS for one that is drawn anew.

The tiers of `quality` follow by a rule from the figures of docs/trade/*.json:

1. Of each knob the values that save time: those faster than every more accurate one by at least
   MIN_SAVED of the reference's time. A value's time is the geometric mean of its ratios to the
   reference, over all recipes and scenes in which it changes the picture.
2. Knob after knob, that which saves most first, takes the fastest of them with which the worst FLIP
   of all that are chosen so far, rendered together, is within the bound: over all recipes, scenes
   and views (augment.jobs.quality.search).

    python -m tools.bench.trade [TABLE.json=SCENE_URI ...]

renders what step 2 asks for and the tables lack, adds it to them, then the tiers themselves, in
place of rows of earlier ones, with TABLE_tiers.jpg beside; and makes docs/trade.md's tables anew.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import json
import math
import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from tqdm import tqdm

from adapters.base import open_scene, parse_uri
from adapters.procedural import open_truth
from augment import effects
from augment.cameras import Camera
from augment.errors import ClimateGSError, SceneError
from augment.ground import ground_of
from augment.jobs.files import decode_image, encode_image
from augment.jobs.quality import Cost, Settings, Trial, render_trial, search, useful
from augment.metrics.consistency import DepthView, warp_view
from augment.metrics.image import CLOSE_M, flip, ssim
from augment.render.buffers import CPU, CUDA
from augment.render.cpu.driver import release_scratch
from augment.scene import Scene
from augment.view_images import SURFACE_ALPHA
from augment.views import render_view
from recipes.fields import changed
from recipes.load import load_recipe
from recipes.schema import (
    KNOBS,
    TIERS,
    Knob,
    Output,
    Quality,
    Recipe,
    Value,
    Weather,
    as_reference,
    knobs_of,
    with_settings,
)
from tools.bench.harness import (
    Figures,
    Table,
    extra_mib,
    figures,
    gpu_facts,
    in_turns,
    load_average,
    machine_facts,
    machine_line,
    markdown_lines,
    peak_gpu_mib,
    replace_marked,
    spread_ms,
    spread_ratio,
)
from tools.bench.scenes import frame_of, front_name, recipe_of
from tools.drawing import captioned, strip, write_rgb
from tools.render import warm_up

WHOLE = "whole"  # stands for a knob where several are set
DEPTH, JPEG = "output.depth", "output.jpeg_quality"
REFERENCE, DEFAULTS, CLEAN = "reference", "defaults", "clean"
WATER = "water"  # the mask of what a ray meets before the scene
TRUTH = "truth"  # what depths are compared with where the scene's surfaces are known
PRESETS = {"smog": "brown-smog", "flood": "street-flood", "snow": "fresh-snow", "style": "evening"}
ALL = {
    "smog": {"visibility_m": 400.0, "scale_height_m": 120.0},
    "flood": {"level_m": 0.15, "turbidity_ntu": 20.0},
    "snow": {"depth_m": 0.1},
    "style": {"preset": "overcast"},
}
RECIPES = (CLEAN, *PRESETS, "all")
AT_A_TIME = 6  # settings between two frames of the reference
DIGITS = 4  # significant ones that figures keep
COLUMNS = {
    "knob": "knob", "value": "value", "ms": "ms", "least": "ms_min", "p90": "ms_p90",
    "x reference": "over_reference", "x clean": "over_clean", "FLIP": "flip", "worst": "worst_flip",
    "PSNR": "psnr", "SSIM": "ssim", "depth off, %": "off_5cm", "abs-rel, %": "abs_rel",
    "flicker": "flicker", "MiB": "mib",
}  # fmt: skip
FILE_COLUMNS = {
    "quality": "value", "ms": "ms", "kB": "kilobytes", "FLIP": "flip", "worst": "worst_flip",
    "PSNR": "psnr", "SSIM": "ssim",
}  # fmt: skip
Row = dict[str, Any]
Wholes = Mapping[str, Mapping[str, Value]]


# ---- what is rendered ---------------------------------------------------------------------------


@dataclass(frozen=True)
class TradeCase:
    """width: pixels of the pictures, at most. repeats: timed frames of each setting and view.
    depths: the estimators that are compared. memory: whether it is measured.
    """

    width: int = 640
    repeats: int = 9
    depths: tuple[str, ...] = ("none", "expected", "median", "mode")
    memory: bool = True


WHOLE_CASE, QUICK = TradeCase(), TradeCase(width=240, repeats=1, memory=False)


@dataclass(frozen=True)
class Setting:
    """One way of rendering a recipe. knob: the path of the one that is not at reference, else
    WHOLE, and then value is a name. given: what is set, by path, where it is WHOLE.
    """

    knob: str
    value: Value
    recipe: Recipe
    given: Mapping[str, Value] = field(default_factory=dict)


def trade_recipe(name: str) -> Recipe:
    """One of RECIPES, a preset or a file: its first variant, without any wish for quality."""
    if name in (CLEAN, "all"):
        recipe = recipe_of(ALL if name == "all" else {}, Output()).model_copy(update={"name": name})
    else:
        loaded = load_recipe(PRESETS.get(name, name)).resolve(0)
        recipe = loaded.model_copy(update={"name": name if name in PRESETS else loaded.name})
    return recipe.model_copy(update={"quality": Quality()})


def settings_of_trade(
    recipe: Recipe, case: TradeCase, wholes: Wholes | None = None
) -> list[Setting]:
    """Reference first, each knob's other values alone, then the recipe with its own settings, and
    the tiers. wholes: in place of all but the reference.
    """
    best = as_reference(recipe)
    chosen = [knob for knob in knobs_of(recipe) if knob.chosen]
    settings = [Setting(WHOLE, REFERENCE, best, {k.path: k.reference for k in chosen})]
    if wholes is None:
        for knob in (k for k in knobs_of(recipe) if not k.path.startswith("output.")):
            for value in knob.values[:-1]:
                settings.append(Setting(knob.path, value, with_settings(best, {knob.path: value})))
        settings += [Setting(DEPTH, name, changed(best, {DEPTH: name})) for name in case.depths]
        settings.append(Setting(WHOLE, DEFAULTS, recipe))
    for name, given in (TIERS if wholes is None else wholes).items():
        own = {k.path: given.get(k.path, k.reference) for k in chosen}
        settings.append(Setting(WHOLE, name, with_settings(best, own), own))
    return settings


def trade_views(scene: Scene, width: int) -> list[tuple[int, Camera]]:
    """Frames and cameras: the front camera in the middle of the drive, the same in the next frame,
    and the camera that looks away from it the most.

    Raises:
        SceneError: the scene has one frame only.
    """
    at = (len(scene.frames) - 1) // 2
    if len(scene.frames) < 2:
        raise SceneError(
            f"{scene.name} has {len(scene.frames)} frame: the trade needs two in a row, since "
            f"flicker is measured between them"
        )
    now, after = scene.frames[at : at + 2]
    shared = [name for name in now.cameras if name in after.cameras]
    if not shared:
        raise SceneError(f"{scene.name}: frames {now.index} and {after.index} share no camera")
    front = front_name(shared)
    ahead = now.cameras[front].camera_from_world[2, :3]
    away = min(now.cameras, key=lambda n: float(now.cameras[n].camera_from_world[2, :3] @ ahead))
    views = [(now, front), (after, front)] + ([(now, away)] if away != front else [])
    cameras = [(frame.index, frame.cameras[name]) for frame, name in views]
    return [(frame, camera.scaled(min(1.0, width / camera.width))) for frame, camera in cameras]


class Stage:
    """Renders recipes on one scene. Those of other effects have a copy of their own: it remembers
    what is found once, and none may be found anew between two timed frames.
    """

    def __init__(self, scene: Scene, backend: str) -> None:
        self._scene, self._backend = scene, backend
        self._scenes: dict[str, Scene] = {}

    def scene_for(self, recipe: Recipe) -> Scene:
        key = recipe.model_dump_json(exclude={"name", "render", "output", "quality"})
        return self._scenes.setdefault(key, dataclasses.replace(self._scene))

    def render(self, recipe: Recipe, camera: Camera) -> Trial:
        return render_trial(self.scene_for(recipe), camera, recipe, self._backend)

    def frame_mib(self, recipe: Recipe, camera: Camera) -> float | None:
        """MiB of a frame above its scene, at its highest moment; on a GPU of its memory. The
        renderer's work space is given back before, so that it counts, as in a process of its own.
        """
        self.scene_for(recipe)
        if self._backend == CUDA:
            return peak_gpu_mib(lambda: self.render(recipe, camera))[1]
        release_scratch()
        return extra_mib(lambda: self.render(recipe, camera))


# ---- errors -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Standard:
    """What a reference's view is compared by. first_m, alpha [H, W]: of what a ray meets first,
    water too. surfaces [H, W]: where there are such. masks [H, W]: where an effect is what a pixel
    shows, by name. true_m [H, W]: the scene's exact depth, infinite in the sky; None where it is
    not known, or something lies on it.
    """

    camera: Camera
    first_m: np.ndarray
    alpha: np.ndarray
    surfaces: np.ndarray
    masks: Mapping[str, np.ndarray] = field(default_factory=dict)
    true_m: np.ndarray | None = None

    def region(self, knob: str) -> np.ndarray:
        """Where a knob's depth errors count: on what its effect covers, else on all surfaces."""
        own = next((e for e in effects.EFFECTS if knob.startswith(f"{e.section}.")), None)
        if own is None or own.mask is None:
            return self.surfaces
        covered = self.masks.get(own.mask, np.zeros_like(self.surfaces))
        return covered if own.lies_on_scene else covered & self.surfaces


def standard_of(
    scene: Scene, camera: Camera, recipe: Recipe, true_m: np.ndarray | None = None
) -> Standard:
    """recipe: at reference. true_m: of the scene without what lies on it."""
    if recipe.output.depth == "none":
        recipe = changed(recipe, {DEPTH: "median"})
    solid = frame_of(scene, camera, recipe)()
    depth, alpha = solid.depth_m, solid.raster.alpha
    surfaces = (alpha >= SURFACE_ALPHA) & (depth > 0)
    if WATER in solid.masks:
        first = render_view(scene, camera, changed(recipe, {"output.surface": "first"})).depth_m
        depth = torch.where(solid.masks[WATER], torch.from_numpy(first).to(depth.dtype), depth)
        alpha = torch.where(solid.masks[WATER], 1.0, alpha)
    masks = {name: mask.numpy() for name, mask in solid.masks.items()}
    true_m = true_m if solid.raster.overlay is None else None
    return Standard(camera, depth.numpy(), alpha.numpy(), surfaces.numpy(), masks, true_m)


@dataclass(frozen=True)
class PictureErrors:
    """mse: mean squared error of display-encoded colours, of which PSNR is made."""

    mse: float
    ssim: float
    flip: float

    @staticmethod
    def between(picture: np.ndarray, reference: np.ndarray) -> PictureErrors:
        """Of uint8 pictures [H, W, 3] of one size."""
        if np.array_equal(picture, reference):  # many settings have no effect on some scene
            return PictureErrors(0.0, 1.0, 0.0)
        mse = float((((picture.astype(np.float64) - reference) / 255) ** 2).mean())
        return PictureErrors(mse, ssim(picture, reference), flip(picture, reference))


def picture_figures(views: Sequence[PictureErrors]) -> dict[str, float | None]:
    """psnr: dB, of the mean squared error of all views; None where there is none. flip, ssim:
    means; worst_flip: of the worst view.
    """
    mse = statistics.fmean(view.mse for view in views)
    return {
        "psnr": None if mse == 0 else -10 * math.log10(mse),
        "ssim": statistics.fmean(view.ssim for view in views),
        "flip": statistics.fmean(view.flip for view in views),
        "worst_flip": max(view.flip for view in views),
    }


def depth_figures(
    depths: Sequence[np.ndarray | None], right: Sequence[np.ndarray], where: Sequence[np.ndarray]
) -> dict[str, float | None]:
    """abs_rel: mean of |depth - right| / right where both have a surface. off_5cm: share of the
    region's pixels, of all views, that are off by more than CLOSE_M or have no depth. None where
    there is no depth, or the region is empty. right, where: by view, [H, W].
    """
    if any(depth is None for depth in depths) or not any(region.any() for region in where):
        return {"abs_rel": None, "off_5cm": None}
    own, good = (
        np.concatenate([i[r] for i, r in zip(each, where, strict=True)]).astype(np.float64)
        for each in (depths, right)
    )
    error, known = np.abs(own - good), own > 0
    shares = (error / good)[known]
    return {
        "abs_rel": float(shares.mean()) if shares.size else None,
        "off_5cm": float(((error > CLOSE_M) | ~known).mean()),
    }


def flicker(standards: Sequence[Standard], own: Sequence[Trial], best: Sequence[Trial]) -> float:
    """Display-encoded, 0 to 1, of two successive frames under a setting and at reference; NaN where
    they share no surface.
    """
    if all(np.array_equal(t.picture, b.picture) for t, b in zip(own, best, strict=True)):
        return 0.0
    errors = [
        (trial.picture.astype(np.float32) - good.picture) / np.float32(255)
        for trial, good in zip(own, best, strict=True)
    ]
    first, second = (
        DepthView(standard.camera, error, standard.first_m, standard.alpha)
        for standard, error in zip(standards, errors, strict=True)
    )
    warped, counts = warp_view(first, second)
    if not counts.any():
        return math.nan
    change = first.picture[counts].astype(np.float64) - warped[counts]
    return math.sqrt(float((change**2).mean()))


def true_depths(uri: str, cameras: Sequence[Camera]) -> list[np.ndarray] | None:
    """z of the procedural street's surfaces, float64 [H, W] each, infinite in the sky; None of
    other scenes.
    """
    scheme, _, query = parse_uri(uri)
    if scheme != "procedural":
        return None
    truth = open_truth(query)
    return [truth.render(camera).depth for camera in cameras]


# ---- measuring ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Trade:
    """figures: for JSON. pictures: the first view's, by recipe and name of the whole."""

    figures: Figures
    pictures: dict[str, dict[str, np.ndarray]]


def bench_trade(
    scene_uri: str,
    recipes: Sequence[str] = RECIPES,
    case: TradeCase = WHOLE_CASE,
    *,
    wholes: Wholes | None = None,
    backend: str = CPU,
) -> Trade:
    """recipes: of RECIPES, presets or files. wholes: settings of many knobs that are measured
    instead of single ones, by name. backend: CPU or CUDA. Times are the host's, to 8 bits that lie
    there; on which pixels errors count is the CPU backend's to say.

    Raises:
        SceneError, RecipeError: the scene or a recipe cannot be used.
    """
    drawn = [trade_recipe(name) for name in recipes]
    scene = open_scene(scene_uri)
    with contextlib.suppress(SceneError):  # looked for once, not for every copy of the scene
        scene = dataclasses.replace(scene, ground=ground_of(scene))
    views = trade_views(scene, case.width)
    cameras = [camera for _, camera in views]
    machine, gpu = machine_facts(), None if backend == CPU else gpu_facts()
    warm_up(drawn)
    true_m = true_depths(scene_uri, cameras)
    entries, pictures = [], {}
    for recipe in tqdm(drawn, unit="recipe"):
        stage = Stage(scene, backend)
        rows, pictures[recipe.name] = measure_recipe(stage, cameras, recipe, case, wholes, true_m)
        rows = [{name: _rounded(value) for name, value in row.items()} for row in rows]
        entries.append({"recipe": recipe.name, "rows": rows})
    found = {
        "scene": scene.name,
        "gaussians": len(scene.background.means),
        "views": [
            {"camera": c.name, "frame": frame, "width": c.width, "height": c.height}
            for frame, c in views
        ],
        "repeats": case.repeats,
        "machine": machine,
        "gpu": gpu,
        "backend": backend,
        "load_after": load_average(),
        "recipes": entries,
    }
    return Trade(found, pictures)


def measure_recipe(
    stage: Stage,
    cameras: Sequence[Camera],
    recipe: Recipe,
    case: TradeCase,
    wholes: Wholes | None = None,
    true_m: Sequence[np.ndarray] | None = None,
) -> tuple[list[Row], dict[str, np.ndarray]]:
    """Rows, reference first, and the first view's pictures of the wholes, by name. true_m: the
    scene's exact depth by view; not used with snow, whose surface is another.
    """
    best, *others = settings_of_trade(recipe, case, wholes)
    plain = recipe.model_copy(update={"weather": Weather(), "style": None})
    clean = Setting(CLEAN, CLEAN, as_reference(plain))
    standards = [
        standard_of(stage.scene_for(best.recipe), camera, best.recipe, true)
        for camera, true in zip(cameras, true_m or [None] * len(cameras), strict=True)
    ]
    rows: list[Row] = []
    pictures: dict[str, np.ndarray] = {}
    for start in range(0, max(len(others), 1), AT_A_TIME):
        group = others[start : start + AT_A_TIME]
        timed = time_group(stage, cameras, [clean, best, *group], case.repeats)
        (_, clean_s), (best_trials, best_s), *_ = timed
        shown = [best, *group] if not rows else group
        for setting, (trials, seconds) in zip(shown, timed[-len(shown) :], strict=True):
            row: Row = {"knob": setting.knob, "value": setting.value}
            if setting.knob == WHOLE and setting.given:
                row["settings"] = dict(setting.given)
            ms = spread_ms(seconds)
            row |= {"ms": ms["median"], "ms_min": ms["min"], "ms_p90": ms["p90"]}
            row["over_reference"] = spread_ratio(seconds, best_s)["median"]
            row["over_clean"] = spread_ratio(seconds, clean_s)["median"]
            row |= _errors(setting, trials, best_trials, standards)
            if case.memory:
                row["mib"] = stage.frame_mib(setting.recipe, cameras[0])
            rows.append(row)
            if setting.knob == WHOLE:
                pictures[str(setting.value)] = trials[0].picture
    if wholes is None:
        rows += jpeg_rows([trial.picture for trial in best_trials])
    return rows, pictures


def time_group(
    stage: Stage, cameras: Sequence[Camera], settings: Sequence[Setting], repeats: int
) -> list[tuple[list[Trial], list[float]]]:
    """Of each setting the pictures by view, and seconds. Frames take turns, on one view after the
    other; the first of each, which loads and lays what it needs, gives the picture and is not
    timed.
    """
    found: dict[int, tuple[list[Trial], list[float]]] = {n: ([], []) for n in range(len(settings))}
    for camera in cameras:
        for repeat in range(repeats + 1):
            for number in in_turns(found, repeat):
                trial = stage.render(settings[number].recipe, camera)
                trials, seconds = found[number]
                if repeat:
                    seconds.append(trial.seconds)
                else:
                    trials.append(trial)
    return [*found.values()]


def _errors(
    setting: Setting, own: Sequence[Trial], best: Sequence[Trial], standards: Sequence[Standard]
) -> Row:
    """Depth against the reference's; of estimators, where the scene's exact depth is known, against
    that. depth_against: which of the two.
    """
    pairs = zip(own, best, strict=True)
    row: Row = picture_figures([PictureErrors.between(a.picture, b.picture) for a, b in pairs])
    true = [s.true_m for s in standards if s.true_m is not None]
    right = [trial.depth for trial in best if trial.depth is not None]
    against: str | None = REFERENCE
    where = [s.region(setting.knob) for s in standards]
    if setting.knob == DEPTH and len(true) == len(standards):
        against, right = TRUTH, true
        where = [np.isfinite(t) & s.surfaces for t, s in zip(true, standards, strict=True)]
    elif len(right) == len(best):
        where = [region & (depth > 0) for region, depth in zip(where, right, strict=True)]
    else:  # the recipe writes none
        against, right = None, [np.zeros_like(region, float) for region in where]
    depths = [None if against is None else trial.depth for trial in own]
    row |= {**depth_figures(depths, right, where), "depth_against": against}
    return row | {"flicker": flicker(standards[:2], own[:2], best[:2])}


def jpeg_rows(pictures: Sequence[np.ndarray]) -> list[Row]:
    """Encoding as PNG and as JPEG of each quality: ms and kB an image, errors against PNG, which
    loses nothing.
    """
    rows = []
    for quality in ("png", *KNOBS[JPEG].values):
        output = Output() if quality == "png" else Output(image="jpg", jpeg_quality=quality)
        seconds, files = [], []
        for picture in pictures:
            started = time.perf_counter()
            files.append(encode_image(picture, output))
            seconds.append(time.perf_counter() - started)
        ms, decoded = spread_ms(seconds), [decode_image(data) for data in files]
        errors = [PictureErrors.between(*pair) for pair in zip(decoded, pictures, strict=True)]
        row = {"knob": JPEG, "value": quality, "ms": ms["median"], "ms_min": ms["min"]}
        kilobytes = statistics.fmean(len(data) / 1e3 for data in files)
        rows.append(row | {"ms_p90": ms["p90"], "kilobytes": kilobytes, **picture_figures(errors)})
    return rows


def _rounded(value: Any) -> Any:
    """Numbers to a few digits: the rest is noise, and the files are kept."""
    if not isinstance(value, float):
        return value
    return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None


def table_of(trade: Mapping[str, Any]) -> list[Row]:
    """One row for every recipe, knob and value: {scene, recipe, knob, value, ms, flip, ...}."""
    return [
        {"scene": trade["scene"], "recipe": entry["recipe"], **row}
        for entry in trade["recipes"]
        for row in entry["rows"]
    ]


def printable(trade: Mapping[str, Any]) -> Figures:
    """Tables in the form that all subjects are printed in: of every recipe the settings, wholes
    first, and the files.
    """
    order = {path: number for number, path in enumerate([WHOLE, *KNOBS])}
    tables = []
    for entry in trade["recipes"]:
        rows = sorted(entry["rows"], key=lambda row: order[row["knob"]])
        for title, columns, shown in (
            (entry["recipe"], COLUMNS, [row for row in rows if row["knob"] != JPEG]),
            (f"{entry['recipe']}, files", FILE_COLUMNS, [r for r in rows if r["knob"] == JPEG]),
        ):
            cells = [[_cell(key, row.get(key)) for key in columns.values()] for row in shown]
            tables += [Table(title, tuple(columns), cells)] if cells else []
    shown = figures("trade", tables, machine=trade["machine"], gpu=trade["gpu"])
    return {**shown, "load_after": trade["load_after"]}


def _cell(key: str, value: Any) -> Any:
    if key == "knob":
        return value.removeprefix("weather.")
    if key == "value":
        return _text(value)
    return 100 * value if key in ("off_5cm", "abs_rel") and value is not None else value


def _text(value: Value) -> str:
    return "all" if value is None else str(value)


# ---- the rule of the tiers ----------------------------------------------------------------------

# What a viewer takes for the same picture: on every published scene under every recipe it is below
# the FLIP of a JPEG at quality 92, which is what people who look at pictures take for lossless.
INVISIBLE_FLIP, INVISIBLE_QUALITY = 0.02, 92
# What differs plainly and shows the same: reconstructions differ as much from the recordings that
# they are made of (docs/reconstruction.md: 0.05 to 0.11 on held-out views).
DRAFT_FLIP = 0.10
BOUNDS = {"draft": DRAFT_FLIP, "balanced": INVISIBLE_FLIP}
Tables = Sequence[Mapping[str, Any]]


class Unmeasured(Exception):
    """Settings that the rule has to know the error of, and no row has."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(f"not measured together: {settings}")
        self.settings = settings


def tiers_from(tables: Tables) -> dict[str, dict[str, Value]]:
    """What each tier sets, by the knobs' paths; knobs at reference are left out.

    Raises:
        Unmeasured: the tables lack settings that have to be rendered together.
    """
    return {name: tier_from(tables, bound) for name, bound in BOUNDS.items()}


def tier_from(tables: Tables, bound: float) -> dict[str, Value]:
    """The rule for one bound.

    Raises:
        Unmeasured: see tiers_from.
    """
    rows = _all_rows(tables)
    costs = {knob.path: knob_costs(rows, knob) for knob in KNOBS.values() if knob.chosen}
    # From the fastest to reference, as within_flip takes them.
    ladders = {path: useful(each)[::-1] for path, each in costs.items()}
    flips = {path: {cost.value: cost.flip for cost in each} for path, each in costs.items()}

    def min_ms(path: str) -> float:
        """Of the values that are within the bound alone."""
        return min(cost.ms for cost in ladders[path] if cost.flip <= bound)

    def keeps(settings: Settings) -> bool:
        alone = (flips[path][value] for path, value in settings.items())
        return all(flip <= bound for flip in alone) and whole_flip(rows, settings) <= bound

    values = {path: [cost.value for cost in ladders[path]] for path in sorted(ladders, key=min_ms)}
    chosen = search(values, keeps)
    return {path: value for path, value in chosen.items() if value != KNOBS[path].reference}


def knob_costs(rows: Sequence[Row], knob: Knob) -> list[Cost]:
    """Of its values, fast to accurate. ms: here per cent of the reference's time. flip: the worst.

    Values that no table has, and those that change no picture, are left out: of the latter a time
    would be noise.
    """
    costs = []
    for value in knob.values[:-1]:
        own = [row for row in _of_value(rows, knob, value) if row["worst_flip"] > 0]
        if own:
            worst = max(row["worst_flip"] for row in own)
            costs.append(Cost(value, 100 * _mean_ratio(own), worst))
    return [*costs, Cost(knob.reference, 100.0, 0.0)]


def whole_flip(rows: Sequence[Row], settings: Settings) -> float:
    """The worst of the rows of these settings together.

    Raises:
        Unmeasured: a recipe has none.
    """
    worst = 0.0
    for recipe in sorted({(row["scene"], row["recipe"]) for row in rows}):
        own = [row for row in rows if (row["scene"], row["recipe"]) == recipe]
        found = [row["worst_flip"] for row in own if _is_of(row, settings)]
        found += _alone(own, settings)
        if not found:
            raise Unmeasured(settings)
        worst = max(worst, *found)
    return worst


def _alone(rows: Sequence[Row], settings: Settings) -> list[float]:
    """The error of settings of which one, or none, differs from reference for a recipe."""
    knobs = {row["knob"] for row in rows}
    moved = {p: v for p, v in settings.items() if p in knobs and v != KNOBS[p].reference}
    if not moved:
        return [0.0]
    if len(moved) > 1:
        return []
    return [row["worst_flip"] for row in rows if (row["knob"], row["value"]) in moved.items()]


def _is_of(row: Row, settings: Settings) -> bool:
    given = row.get("settings")
    return (
        row["knob"] == WHOLE
        and given is not None
        and all(settings.get(path, value) == value for path, value in given.items())
    )


def _all_rows(tables: Tables) -> list[Row]:
    return [row for table in tables for row in table_of(table)]


def _of_value(rows: Sequence[Row], knob: Knob, value: Value) -> list[Row]:
    return [row for row in rows if (row["knob"], row["value"]) == (knob.path, value)]


def _mean_ratio(rows: Sequence[Row]) -> float:
    return math.exp(sum(math.log(row["over_reference"]) for row in rows) / len(rows))


def settle(
    tables: Sequence[dict[str, Any]], uris: Sequence[str], case: TradeCase
) -> dict[str, dict[str, Value]]:
    """The tiers; what the rule has to know and the tables lack is rendered and added to them."""
    while True:
        try:
            return tiers_from(tables)
        except Unmeasured as missing:
            for table, uri in zip(tables, uris, strict=True):
                rows = table_of(table)
                tried = {r["value"] for r in rows if str(r["value"]).startswith("candidate")}
                measure_wholes(table, uri, {f"candidate {len(tried) + 1}": missing.settings}, case)


def measure_wholes(table: dict[str, Any], uri: str, wholes: Wholes, case: TradeCase) -> Trade:
    """Render settings on the table's scene and put their rows in place of those of their names."""
    names = [entry["recipe"] for entry in table["recipes"]]
    trade = bench_trade(uri, names, case, wholes=wholes)
    for entry, new in zip(table["recipes"], trade.figures["recipes"], strict=True):
        kept = [row for row in entry["rows"] if row["knob"] != WHOLE or row["value"] not in wholes]
        entry["rows"] = kept + [row for row in new["rows"] if row["value"] in wholes]
    return trade


def invisible_evidence(tables: Tables) -> list[float]:
    """Mean FLIP of JPEGs of INVISIBLE_QUALITY against PNG, by scene and recipe."""
    rows = _of_value(_all_rows(tables), KNOBS[JPEG], INVISIBLE_QUALITY)
    return [row["flip"] for row in rows]


# ---- docs/trade.md ------------------------------------------------------------------------------

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGE = DOCS / "trade.md"
SCENES = {"street": "street", "pandaset": "PandaSet 002"}
START = "<!-- {name}: made by python -m tools.bench.trade -->"
END = "<!-- end of {name} -->"


def read_tables() -> list[dict[str, Any]]:
    """The kept figures of SCENES, under the names that people know them by."""
    files = {title: DOCS / "trade" / f"{name}.json" for name, title in SCENES.items()}
    return [{**json.loads(path.read_text()), "scene": title} for title, path in files.items()]


def document(text: str, tables: Tables) -> str:
    """The document with its tables made anew.

    Raises:
        ValueError: it lacks a marker.
    """
    sections = {
        "machine": [f"- {machine_line(t)}; {_views_line(t)}." for t in tables],
        "tiers": _tier_lines(),
        "wholes": _whole_lines(tables),
        "knobs": _knob_lines(tables),
    }
    for name, lines in sections.items():
        start, end = START.format(name=name), END.format(name=name)
        text = replace_marked(text, start, end, "\n".join(lines))
    return text


def _views_line(trade: Mapping[str, Any]) -> str:
    views = [
        f"{v['camera']} of frame {v['frame']} ({v['width']}x{v['height']})" for v in trade["views"]
    ]
    return (
        f"{trade['scene']}, {trade['gaussians']:,} Gaussians; {', '.join(views)}; "
        f"{trade['repeats']} timed frames of each view and setting"
    )


def _tier_lines() -> list[str]:
    rows = []
    for knob in (knob for knob in KNOBS.values() if knob.chosen):
        values = [TIERS[name].get(knob.path, knob.reference) for name in BOUNDS]
        rows.append([f"`{knob.path}`", knob.what, *map(_text, [*values, knob.reference])])
    return _lines(["knob", "what it is", *BOUNDS, REFERENCE], rows)


def _whole_lines(tables: Tables) -> list[str]:
    """Settings as a whole, a row a recipe: time over the reference's, and the worst view's FLIP."""
    settings, rows = (DEFAULTS, *BOUNDS), []
    for table in tables:
        found = {(r["recipe"], r["value"]): r for r in table_of(table) if r["knob"] == WHOLE}
        for recipe in dict.fromkeys(recipe for recipe, _ in found):
            of = [found[recipe, name] for name in settings]
            cells = [f"{row['over_reference']:.2f}, {row['worst_flip']:.3f}" for row in of]
            ms = f"{found[recipe, REFERENCE]['ms']:.0f}"
            rows.append([table["scene"], recipe, ms, *cells])
    header = ["scene", "recipe", "reference ms", *(f"{name}: x, FLIP" for name in settings)]
    return _lines(header, rows)


def _knob_lines(tables: Tables) -> list[str]:
    """Over all recipes that a knob has an effect on: mean ratio of times and the worst errors."""
    each, rows = ("x reference", "worst FLIP", "depth off"), []
    for knob in (knob for knob in KNOBS.values() if knob.path != JPEG):
        for value in knob.values if knob.path == DEPTH else knob.values[:-1]:
            of = [_of_value(table_of(table), knob, value) for table in tables]
            cells = [cell for own in of for cell in _knob_cells(own)]
            rows.append([f"`{knob.path}`", _text(value), *cells])
    return _lines(
        ["knob", "value", *(f"{t['scene']}: {name}" for t in tables for name in each)], rows
    )


def _knob_cells(rows: Sequence[Row]) -> list[str]:
    if not rows:
        return ["-", "-", "-"]
    ratios = [row["over_reference"] for row in rows]
    off = max((row["off_5cm"] for row in rows if row["off_5cm"] is not None), default=None)
    return [
        f"{_mean_ratio(rows):.2f} ({min(ratios):.2f}-{max(ratios):.2f})",
        f"{max(row['worst_flip'] for row in rows):.3f}",
        "-" if off is None else f"{100 * off:.2f} %",
    ]


def _lines(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Of a Markdown table; all columns but the first two to the right."""
    return markdown_lines(header, ["---", "---", *["---:"] * (len(header) - 2)], rows)


# ---- pictures -----------------------------------------------------------------------------------

CROP_PX, CROP_AT = 300, (0.5, 0.56)  # height, and middle within the picture, of what is shown


def check_matplotlib() -> None:
    """Raises ClimateGSError where it is not installed, which takes no minutes to find out."""
    if importlib.util.find_spec("matplotlib") is None:
        raise ClimateGSError("the trade's chart needs matplotlib: pip install 'climategs[plots]'")


def draw_trade(folder: Path, trade: Trade) -> list[Path]:
    """trade_<scene>.png, FLIP against time by recipe, and trade_<scene>_tiers.jpg."""
    folder.mkdir(parents=True, exist_ok=True)
    name = "".join(c if c.isalnum() else "_" for c in trade.figures["scene"])
    chart, tiers = folder / f"trade_{name}.png", folder / f"trade_{name}_tiers.jpg"
    draw_chart(chart, trade.figures)
    draw_tiers(tiers, trade)
    return [chart, tiers]


def draw_chart(path: Path, figures: Mapping[str, Any]) -> None:
    """A panel for each recipe: a line a knob, from its values to the reference; settings as a
    whole.
    """
    from matplotlib.figure import Figure

    recipes = figures["recipes"]
    lines = -(-len(recipes) // 2)
    figure = Figure(figsize=(13, 4.6 * lines), layout="constrained")
    for number, entry in enumerate(recipes, 1):
        axes = figure.add_subplot(lines, min(2, len(recipes)), number, title=entry["recipe"])
        points: dict[str, list[tuple[float, float]]] = {}
        for row in entry["rows"]:
            if row["knob"] not in (DEPTH, JPEG) and not str(row["value"]).startswith("candidate"):
                is_whole = row["knob"] == WHOLE
                name = row["value"] if is_whole else row["knob"].removeprefix("weather.")
                own = points.setdefault(name, [] if is_whole else [(1.0, 0.0)])
                own.insert(-1, (row["over_reference"], row["flip"]))
        for name, own in points.items():
            axes.plot(*zip(*own, strict=True), marker="D" if len(own) == 1 else ".", label=name)
        axes.set_yscale("symlog", linthresh=1e-3)  # 0 is on it
        axes.set_xlim(left=0)
        axes.set_xlabel("time over the reference's")
        axes.set_ylabel("mean FLIP against the reference")
        axes.legend(fontsize="x-small")
    figure.savefig(path, metadata={"Software": None})


def draw_tiers(path: Path, trade: Trade) -> None:
    """A row a recipe: the same part of the reference and the tiers, with their time and error. The
    part is half the picture's height about CROP_AT; pixels are not smoothed, for they are what is
    compared.
    """
    lines = []
    for entry in trade.figures["recipes"]:
        whole = {row["value"]: row for row in entry["rows"] if row["knob"] == WHOLE}
        panels = []
        for name in (REFERENCE, *list(BOUNDS)[::-1]):
            picture = trade.pictures[entry["recipe"]][name]
            height, width = picture.shape[:2]
            tall, wide = height // 2, min(width, height * 2 // 3)
            top = min(max(0, round(CROP_AT[1] * height - tall / 2)), height - tall)
            left = min(max(0, round(CROP_AT[0] * width - wide / 2)), width - wide)
            part = picture[top : top + tall, left : left + wide]
            size = (round(CROP_PX * wide / tall), CROP_PX)
            shown = cv2.resize(part, size, interpolation=cv2.INTER_NEAREST)
            error = "" if name == REFERENCE else f", FLIP {whole[name]['flip']:.4f}"
            text = f"{whole[name]['ms']:.0f} ms{error}"
            panels.append(captioned(shown, f"{entry['recipe']}, {name}", text))
        lines.append(strip(panels))
    write_rgb(path, np.concatenate(lines))


def main(arguments: Sequence[str]) -> None:
    """[TABLE.json=SCENE_URI ...]: see the module."""
    pairs = [argument.partition("=") for argument in arguments]
    if not all(uri for _, _, uri in pairs):
        raise SystemExit("usage: python -m tools.bench.trade [TABLE.json=SCENE_URI ...]")
    paths, uris = [Path(path) for path, _, _ in pairs], [uri for _, _, uri in pairs]
    tables = [json.loads(path.read_text()) for path in paths]
    if tables:
        width = max(view["width"] for view in tables[0]["views"])
        case = TradeCase(width=width, repeats=tables[0]["repeats"])
        tiers = settle(tables, uris, case)
        for path, uri, table in zip(paths, uris, tables, strict=True):
            trade = measure_wholes(table, uri, tiers, case)
            draw_tiers(path.with_name(f"{path.stem}_tiers.jpg"), trade)
            path.write_text(json.dumps(table, indent=1) + "\n")
        for name, settings in tiers.items():
            print(f"{name}: {settings}")
    PAGE.write_text(document(PAGE.read_text(), read_tables()))


if __name__ == "__main__":
    main(sys.argv[1:])
