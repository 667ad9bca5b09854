"""Speed for accuracy: what each knob of a recipe costs and saves on a scene, and the tiers.

Settings are timed a few at a time, in turns with the reference and the clean frame, so that what
the machine does meanwhile falls on all; ratios are taken within each turn. Pictures are compared in
8 bits by PSNR, SSIM and FLIP. Flicker is what is left in time: let E_t be the picture less the
reference's, at frame t. E_(t+1) is warped into frame t by the reference's depth, so that the
drive's motion does not count, and flicker is the root mean square of E_t - warped E_(t+1): 0 for an
error that sticks to its surface, sqrt(2) times the error's own RMS for one that is drawn anew.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from adapters.base import open_scene, parse_uri
from adapters.procedural import open_truth
from augment.cameras import Camera
from augment.effects.flood.water_plane import plane_depth
from augment.errors import SceneError
from augment.ground import ground_of
from augment.jobs.files import decode_image, encode_image
from augment.jobs.quality import Trial, render_trial
from augment.metrics.consistency import DepthView, warp_view
from augment.metrics.image import CLOSE_M, flip, ssim
from augment.plan import make_plan
from augment.render.buffers import CPU, CUDA
from augment.render.cpu.driver import release_scratch
from augment.scene import Scene
from augment.views import SURFACE_ALPHA, render_buffers
from recipes.change import changed
from recipes.load import load_recipe
from recipes.schema import (
    BY_PATH,
    KNOBS,
    TIERS,
    Output,
    Quality,
    Recipe,
    Smog,
    Value,
    Weather,
    as_reference,
    knobs_of,
    with_settings,
)
from recipes.weather import Flood, Snow, Style
from tools.bench.gpu import gpu_facts, peak_gpu_mib
from tools.bench.harness import (
    RESET_PEAK,
    Figures,
    Table,
    extra_mib,
    figures,
    in_turns,
    load_average,
    machine_facts,
    spread_ms,
)
from tools.bench.scenes import scene_of_recipe
from tools.render import warm_up

WHOLE = "whole"  # stands for a knob where several are set
DEPTH, JPEG = "output.depth", "output.jpeg_quality"
REFERENCE, DEFAULTS, CLEAN = "reference", "defaults", "clean"
TRUTH = "truth"  # what depths are compared with where the scene's surfaces are known
PRESETS = {"smog": "brown-smog", "flood": "street-flood", "snow": "fresh-snow", "style": "evening"}
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

    @property
    def name(self) -> str:
        return f"{self.knob}={self.value}"


def trade_recipe(name: str) -> Recipe:
    """One of RECIPES, a preset or a file: its first variant, without any wish for quality."""
    if name == CLEAN:
        recipe = Recipe(name=CLEAN)
    elif name == "all":
        smog = Smog(visibility_m=400.0, scale_height_m=120.0)
        flood, snow = Flood(level_m=0.15, turbidity_ntu=20.0), Snow(depth_m=0.1)
        weather = Weather(smog=smog, flood=flood, snow=snow)
        recipe = Recipe(name=name, weather=weather, style=Style(preset="overcast"))
    else:
        loaded = load_recipe(PRESETS.get(name, name)).resolve(0)
        recipe = loaded.model_copy(update={"name": name if name in PRESETS else loaded.name})
    return recipe.model_copy(update={"quality": Quality()})


def settings_of_trade(
    recipe: Recipe, case: TradeCase, wholes: Wholes | None = None
) -> list[Setting]:
    """Reference first, each knob's other values alone, then wholes: by default the tiers and the
    recipe with its own settings.

    wholes: other wholes instead, by name; then single knobs are left out.
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
    front = min((name for name in shared if "front" in name), key=len, default=shared[0])
    ahead = now.cameras[front].camera_from_world[2, :3]
    away = min(now.cameras, key=lambda n: float(now.cameras[n].camera_from_world[2, :3] @ ahead))
    views = [(now, front), (after, front)] + ([(now, away)] if away != front else [])
    cameras = [(frame.index, frame.cameras[name]) for frame, name in views]
    return [(frame, camera.scaled(min(1.0, width / camera.width))) for frame, camera in cameras]


class Stage:
    """Renders recipes on one scene, whose snow and style maps are found once and remembered."""

    def __init__(self, scene: Scene, backend: str) -> None:
        self._scene, self._backend = scene, backend
        self._scenes: dict[str, Scene] = {}

    def scene_for(self, recipe: Recipe) -> Scene:
        snow, style, flood = recipe.weather.snow, recipe.style, recipe.weather.flood
        key = repr((snow, style, None if snow is None or flood is None else flood.level_m))
        if key not in self._scenes:
            self._scenes[key] = scene_of_recipe(self._scene, recipe, self._backend)
        return self._scenes[key]

    def render(self, recipe: Recipe, camera: Camera) -> Trial:
        return render_trial(self.scene_for(recipe), camera, recipe, self._backend)

    def frame_mib(self, recipe: Recipe, camera: Camera) -> float | None:
        """MiB of a frame above its scene, at its highest moment; on a GPU of its memory. The
        renderer's work space is given back before, so that it counts, as in a process of its own.
        """
        self.scene_for(recipe)
        if self._backend == CUDA:
            return peak_gpu_mib(lambda: self.render(recipe, camera))[1]
        if not RESET_PEAK.is_file():
            return None
        release_scratch()
        return extra_mib(lambda: self.render(recipe, camera))


# ---- errors -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Standard:
    """What a reference's view is compared by. first_m, alpha [H, W]: of what a ray meets first,
    water too. surfaces, water, snow [H, W]: where there are such. true_m [H, W]: the scene's exact
    depth, infinite in the sky; None where it is not known, or under snow.
    """

    camera: Camera
    first_m: np.ndarray
    alpha: np.ndarray
    surfaces: np.ndarray
    water: np.ndarray
    snow: np.ndarray
    true_m: np.ndarray | None = None

    def region(self, knob: str) -> np.ndarray:
        """Where a knob's depth errors count: on what its effect covers, else on all surfaces."""
        if knob.startswith("weather.flood."):
            return self.water & self.surfaces
        return self.snow if knob.startswith("weather.snow.") else self.surfaces


def standard_of(
    scene: Scene, camera: Camera, recipe: Recipe, true_m: np.ndarray | None = None
) -> Standard:
    """recipe: at reference."""
    if recipe.output.depth == "none":
        recipe = changed(recipe, {DEPTH: "median"})
    plan = make_plan(recipe, scene)
    buffers = render_buffers(scene, camera, plan)
    assert buffers.depth_m is not None and buffers.raster.alpha is not None
    depth, alpha = buffers.depth_m, buffers.raster.alpha
    surfaces, nowhere = (alpha >= SURFACE_ALPHA) & (depth > 0), torch.zeros_like(alpha) > 0
    water = nowhere if buffers.water is None else buffers.water
    snow = nowhere if buffers.snow is None else buffers.snow
    if plan.flood is not None:
        depth = torch.where(water, plane_depth(camera, plan.flood.level_z_m).to(depth.dtype), depth)
        alpha = torch.where(water, 1.0, alpha)
    images = (depth, alpha, surfaces, water, snow)
    return Standard(camera, *(image.numpy() for image in images), true_m)


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
    images = [np.concatenate([i[r] for i, r in zip(each, where, strict=True)]).astype(np.float64)
              for each in (depths, right)]  # fmt: skip
    own, good = images
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
    first, second = (
        DepthView(
            standard.camera,
            (trial.picture.astype(np.float32) - good.picture) / np.float32(255),
            standard.first_m,
            standard.alpha,
        )
        for standard, trial, good in zip(standards, own, best, strict=True)
    )
    warped, counts = warp_view(first, second)
    if not counts.any():
        return math.nan
    return math.sqrt(
        float(((first.picture[counts].astype(np.float64) - warped[counts]) ** 2).mean())
    )


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
    progress: bool = True,
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
    if any(recipe.weather.flood is not None for recipe in drawn):
        scene = dataclasses.replace(scene, ground=ground_of(scene))  # looked for once
    views = trade_views(scene, case.width)
    cameras = [camera for _, camera in views]
    machine, gpu = machine_facts(), None if backend == CPU else gpu_facts()
    warm_up(drawn)
    true_m = true_depths(scene_uri, cameras)
    entries, pictures = [], {}
    for recipe in tqdm(drawn, unit="recipe", disable=not progress):
        stage = Stage(scene, backend)
        rows, shown = measure_recipe(stage, cameras, recipe, case, wholes, true_m)
        rows = [{name: _rounded(value) for name, value in row.items()} for row in rows]
        entries.append({"recipe": recipe.name, "rows": rows})
        pictures[recipe.name] = shown
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
    settings = settings_of_trade(recipe, case, wholes)
    best, others = settings[0], settings[1:]
    bare = recipe.model_copy(update={"weather": Weather(), "style": None})
    clean = Setting(CLEAN, CLEAN, as_reference(bare))
    known = None if recipe.weather.snow is not None else true_m
    standards = [
        standard_of(stage.scene_for(best.recipe), camera, best.recipe, true)
        for camera, true in zip(cameras, known or [None] * len(cameras), strict=True)
    ]
    rows: list[Row] = []
    pictures: dict[str, np.ndarray] = {}
    for start in range(0, max(len(others), 1), AT_A_TIME):
        group = others[start : start + AT_A_TIME]
        trials, seconds = time_group(stage, cameras, [clean, best, *group], case.repeats)
        for setting in [*([] if rows else [best]), *group]:
            row: Row = {"knob": setting.knob, "value": setting.value}
            if setting.knob == WHOLE and setting.given:
                row["settings"] = dict(setting.given)
            own, ms = seconds[setting.name], spread_ms(seconds[setting.name])
            row |= {"ms": ms["median"], "ms_min": ms["min"], "ms_p90": ms["p90"]}
            for name, beside in (("over_reference", best), ("over_clean", clean)):
                pairs = zip(own, seconds[beside.name], strict=True)
                row[name] = statistics.median(a / b for a, b in pairs)
            row |= _errors(setting, trials[setting.name], trials[best.name], standards)
            if case.memory:
                row["mib"] = stage.frame_mib(setting.recipe, cameras[0])
            rows.append(row)
            if setting.knob == WHOLE:
                pictures[str(setting.value)] = trials[setting.name][0].picture
    if wholes is None:
        rows += jpeg_rows([trial.picture for trial in trials[best.name]])
    return rows, pictures


def time_group(
    stage: Stage, cameras: Sequence[Camera], settings: Sequence[Setting], repeats: int
) -> tuple[dict[str, list[Trial]], dict[str, list[float]]]:
    """By the settings' names: pictures by view, and seconds. Frames take turns, on one view after
    the other; the first of each, which loads and lays what it needs, gives the picture and is not
    timed.
    """
    by_name = {setting.name: setting.recipe for setting in settings}
    trials: dict[str, list[Trial]] = {name: [] for name in by_name}
    seconds: dict[str, list[float]] = {name: [] for name in by_name}
    for camera in cameras:
        for repeat in range(repeats + 1):
            for name in in_turns(by_name, repeat):
                trial = stage.render(by_name[name], camera)
                if repeat:
                    seconds[name].append(trial.seconds)
                else:
                    trials[name].append(trial)
    return trials, seconds


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
    for quality in ("png", *BY_PATH[JPEG].values):
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


# ---- tables -------------------------------------------------------------------------------------


def table_of(trade: Mapping[str, Any]) -> list[Row]:
    """One row for every recipe, knob and value: {scene, recipe, knob, value, ms, flip, ...}."""
    return [
        {"scene": trade["scene"], "recipe": entry["recipe"], **row}
        for entry in trade["recipes"]
        for row in entry["rows"]
    ]


def trade_tables(trade: Mapping[str, Any]) -> list[Table]:
    """For people: of every recipe the settings, wholes first, and the files."""
    order = {path: number for number, path in enumerate([WHOLE, *(knob.path for knob in KNOBS)])}
    tables = []
    for entry in trade["recipes"]:
        rows = sorted(entry["rows"], key=lambda row: order[row["knob"]])
        for title, columns, shown in (
            (entry["recipe"], COLUMNS, [row for row in rows if row["knob"] != JPEG]),
            (f"{entry['recipe']}, files", FILE_COLUMNS, [r for r in rows if r["knob"] == JPEG]),
        ):
            cells = [[_cell(key, row.get(key)) for key in columns.values()] for row in shown]
            tables += [Table(title, tuple(columns), cells)] if cells else []
    return tables


def printable(trade: Mapping[str, Any]) -> Figures:
    """The tables in the one form that all subjects are printed in."""
    shown = figures("trade", trade_tables(trade), machine=trade["machine"], gpu=trade["gpu"])
    return {**shown, "load_after": trade["load_after"]}


def _cell(key: str, value: Any) -> Any:
    if key == "knob":
        return value.removeprefix("weather.")
    if key == "value":
        return "all" if value is None else str(value)
    return 100 * value if key in ("off_5cm", "abs_rel") and value is not None else value


def views_line(trade: Mapping[str, Any]) -> str:
    views = [
        f"{v['camera']} of frame {v['frame']} ({v['width']}x{v['height']})" for v in trade["views"]
    ]
    return (
        f"{trade['scene']}, {trade['gaussians']:,} Gaussians; {', '.join(views)}; "
        f"{trade['repeats']} timed frames of each view and setting"
    )
