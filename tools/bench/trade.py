"""`climategs bench trade`: the time and the errors of quality settings, and the tiers of `quality`.

A knob is a setting of a recipe that trades speed for accuracy. `bench_trade` renders a scene with
every value of every knob, and with the tiers. Settings are timed a few at a time, in turns with the
reference and the clean frame, and ratios are taken within each turn. Pictures are compared in 8
bits by PSNR, SSIM and FLIP.

Flicker measures how an error changes in time. E_t is the picture minus the reference's picture at
frame t. E_(t+1) is warped into frame t by the reference's depth, so that the drive's motion does
not count. Flicker is the root mean square of E_t - warped E_(t+1). It is 0 for an error that sticks
to its surface, and sqrt(2) times the error's RMS for an error that is random in every frame.

The tiers follow from the figures of docs/trade/*.json by the rule of docs/trade.md. The time of a
value is the geometric mean of its ratios to the reference.

    python -m tools.bench.trade [TABLE.json=SCENE_URI ...]

renders the settings that the rule needs and the tables lack, and adds them to the tables. Then it
renders the tiers, replaces the earlier ones, draws TABLE_tiers.jpg, and writes the tables of
docs/trade.md again.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib.util
import json
import math
import sys
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from tqdm import tqdm

from adapters.base import open_scene, parse_uri
from adapters.procedural import open_truth
from augment import effects
from augment.detail.prune import precompute_errors
from augment.errors import ClimateGSError, SceneError
from augment.memo import memo_of
from augment.metrics.consistency import DepthView, warp_view
from augment.metrics.image import depth_errors, flip, ssim
from augment.output.codecs import decode_image, encode_image
from augment.render.buffers import CPU, CUDA
from augment.render.constants import SURFACE_ALPHA
from augment.render.cpu.driver import free_scratch
from augment.scene.cameras import Camera
from augment.scene.ground import ground_of
from augment.scene.scene import Scene
from augment.view.quality import (
    Cost,
    Settings,
    Trial,
    render_trial,
    search_settings,
    select_useful_values,
)
from augment.view.render_view import render_view
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
    knobs_of,
    with_reference_settings,
    with_settings,
)
from tools.bench import harness
from tools.bench.harness import Figures, Table
from tools.bench.scenes import frame_of, front_name, recipe_of
from tools.pictures import captioned, strip, write_rgb
from tools.warm_up import warm_up

ALL_KNOBS = "whole"  # The word in place of a knob's path where several knobs are set.
DEPTH = "output.depth"  # The knob of the estimator of depth.
JPEG = "output.jpeg_quality"  # The knob of the quality of JPEG files.
REFERENCE = "reference"  # The name of the settings with all knobs at reference.
DEFAULTS = "defaults"  # The name of the recipe's own settings.
CLEAN = "clean"  # The name of the recipe without effects.
WATER = "water"  # The name of the mask of water, which a ray meets before the scene.
TRUTH = "truth"  # The word for depths that are compared with the scene's exact depth.
# The preset of every recipe that has one.
PRESETS = {
    "smog": "brown-smog",
    "flood": "street-flood",
    "snow": "fresh-snow",
    "style": "evening",
    "rain": "rain",
    "snowfall": "flurries",
}
# The effects of the recipe "fog". It renders only the picture, since its fog hides splats.
FOG = {"smog": {"visibility_m": 50.0}}
# The effects of the recipe "all".
ALL = {
    "smog": {"visibility_m": 400.0, "scale_height_m": 120.0},
    "flood": {"level_m": 0.15, "turbidity_ntu": 20.0},
    "snow": {"depth_m": 0.1},
    "style": {"preset": "overcast"},
}
RECIPES = (CLEAN, *PRESETS, "fog", "all")  # The names of the recipes that are measured by default.
NUM_SETTINGS_PER_TURN = 6  # The number of settings between two frames of the reference.
DIGITS = 4  # The number of significant digits that figures have in files.
# The key of a figure in a row, by the heading of its column.
COLUMNS = {
    "knob": "knob",
    "value": "value",
    "ms": "ms",
    "least": "ms_min",
    "p90": "ms_p90",
    "kB": "kilobytes",
    "x reference": "over_reference",
    "x clean": "over_clean",
    "FLIP": "flip",
    "worst": "worst_flip",
    "PSNR": "psnr",
    "SSIM": "ssim",
    "depth off, %": "off_5cm",
    "abs-rel, %": "abs_rel",
    "flicker": "flicker",
    "MiB": "mib",
}
# The figures of one setting: {knob, value, ms, flip, ...}. Either `knob` is a path, `value` is its
# value and all other knobs are at reference; or `knob` is ALL_KNOBS, `value` is a name, and
# `settings` has the value of every knob. Rows of several scenes and recipes also have `scene` and
# `recipe`.
Row = dict[str, Any]
Tables = Sequence[Mapping[str, Any]]  # The figures of several scenes.
NamedSettings = Mapping[
    str, Mapping[str, Value]
]  # Values of knobs, by the settings' name and path.


# ---- recipes, settings and views------------------------------------------------------------------


@dataclass(frozen=True)
class TradeCase:
    """The size of the measurements."""

    width: int = 640
    """The largest width of pictures, pixels."""
    repeats: int = 4
    """The number of timed frames of each setting and view."""
    memory: bool = True
    """True if memory is measured, for settings of all knobs together."""


FULL_CASE = TradeCase()  # The case of published figures.
QUICK_CASE = TradeCase(width=240, repeats=1, memory=False)  # The case of `--quick`.


def trade_recipe(name: str) -> Recipe:
    """Return the first variant of a recipe, without a request for quality.

    Args:
        name: One of RECIPES, a preset or a file.
    """
    if name == "fog":
        recipe = recipe_of(FOG, Output(depth="none", labels=False, lidar=False))
    elif name in (CLEAN, "all"):
        recipe = recipe_of(ALL if name == "all" else {}, Output())
    else:
        recipe = load_recipe(PRESETS.get(name, name)).resolve(0)
    recipe_name = name if name in RECIPES else recipe.name
    return recipe.model_copy(update={"name": recipe_name, "quality": Quality()})


def measured_values(knob: Knob, recipe: Recipe | None = None) -> Sequence[Value]:
    """Return the values of a knob with which pictures are rendered.

    They include all estimators of depth, since none of them is the best. The quality of JPEG has
    none: it is measured on files.

    Args:
        knob: The knob.
        recipe: The recipe; None for any.
    """
    has_no_depth = recipe is not None and recipe.output.depth == "none"
    if knob.path == JPEG or (knob.path == DEPTH and has_no_depth):
        return ()
    return knob.values if knob.path == DEPTH else knob.values[:-1]


def settings_of_trade(
    recipe: Recipe, wholes: NamedSettings | None = None
) -> list[tuple[Row, Recipe]]:
    """Return the settings to measure: the start of each row, and its recipe.

    The reference comes first, then each other value of each knob alone, then the recipe's own
    settings, and the tiers.

    Args:
        recipe: The recipe.
        wholes: Settings of many knobs that replace all but the reference.
    """
    best = with_reference_settings(recipe)
    knobs = knobs_of(recipe)
    references = {knob.path: knob.reference for knob in knobs if knob.is_selectable}
    single: list[tuple[Row, Recipe]] = []
    if wholes is None:
        pairs = [(knob.path, value) for knob in knobs for value in measured_values(knob, recipe)]
        single = [({"knob": p, "value": v}, with_settings(best, {p: v})) for p, v in pairs]
        single.append(({"knob": ALL_KNOBS, "value": DEFAULTS}, recipe))
    whole_rows: list[tuple[Row, Recipe]] = []
    for name, settings in {REFERENCE: {}, **(TIERS if wholes is None else wholes)}.items():
        all_settings = {path: settings.get(path, value) for path, value in references.items()}
        row = {"knob": ALL_KNOBS, "value": name, "settings": all_settings}
        whole_rows.append((row, with_settings(best, all_settings)))
    return [whole_rows[0], *single, *whole_rows[1:]]


def trade_views(scene: Scene, width: int) -> list[tuple[int, Camera]]:
    """Return the frames and cameras of the views that are rendered.

    They are the front camera in the middle of the drive, the same camera in the next frame, and
    the camera that looks away from it the most.

    Raises:
        SceneError: the scene has only one frame, or two successive frames share no camera.
    """
    at = max(0, (len(scene.frames) - 1) // 2)
    pair = scene.frames[at : at + 2]
    shared = [n for n in pair[0].cameras if n in pair[1].cameras] if len(pair) == 2 else []
    if not shared:
        raise SceneError(
            f"{scene.name} has {len(scene.frames)} frame(s): the trade needs two in a row with a "
            "camera in common, since flicker is measured between them"
        )
    now, after = pair
    front = front_name(shared)
    ahead = now.cameras[front].camera_from_world[2, :3]
    away = min(now.cameras, key=lambda n: float(now.cameras[n].camera_from_world[2, :3] @ ahead))
    views = [(now, front), (after, front)] + ([(now, away)] if away != front else [])
    cameras = [(frame.index, frame.cameras[name]) for frame, name in views]
    return [(frame, camera.scaled(min(1.0, width / camera.width))) for frame, camera in cameras]


# ---- errors -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Standard:
    """A view at reference, with which other settings are compared."""

    camera: Camera
    """The camera."""
    best: Trial
    """The view at reference, rendered in the same way as other settings."""
    first_m: np.ndarray
    """[H, W]. Depth of the first surface that a ray meets, also of water, metres."""
    alpha: np.ndarray
    """[H, W]. Opacity of that surface."""
    surfaces: np.ndarray
    """[H, W], bool. True where the scene has a surface."""
    masks: Mapping[str, np.ndarray] = field(default_factory=dict)
    """[H, W] each, by name. True where a pixel shows an effect."""
    true_m: np.ndarray | None = None
    """[H, W]. The scene's exact depth, infinite in the sky; None if it is not known, or if an
    overlay lies on the scene.
    """

    def region(self, knob: str) -> np.ndarray:
        """Return the pixels of a knob's depth errors: its effect's, or else all surfaces."""
        effect = next((e for e in effects.EFFECTS if knob.startswith(f"{e.section}.")), None)
        if effect is None or effect.mask_name is None:
            return self.surfaces
        covered = self.masks.get(effect.mask_name, np.zeros_like(self.surfaces))
        return covered if effect.adds_overlays else covered & self.surfaces


def render_standard(
    scene: Scene, camera: Camera, recipe: Recipe, true_m: np.ndarray | None, backend: str
) -> Standard:
    """Render a view at reference.

    Args:
        scene: The scene.
        camera: The camera.
        recipe: The recipe with all knobs at reference.
        true_m: [H, W]. The exact depth of the scene without overlays; None if it is not known.
        backend: The rasteriser's backend.
    """
    best = render_trial(scene, camera, recipe, backend)
    if recipe.output.depth == "none":
        recipe = with_settings(recipe, {DEPTH: "median"})
    solid = frame_of(scene, camera, recipe)()
    depth = solid.depth_m
    alpha = solid.raster.alpha
    surfaces = (alpha >= SURFACE_ALPHA) & (depth > 0)
    if WATER in solid.masks:
        of_water = with_settings(recipe, {"output.surface": "first"})
        first = torch.from_numpy(render_view(scene, camera, of_water).depth_m)
        depth = torch.where(solid.masks[WATER], first.to(depth.dtype), depth)
        alpha = torch.where(solid.masks[WATER], 1.0, alpha)
    masks = {name: mask.numpy() for name, mask in solid.masks.items()}
    true_m = true_m if solid.raster.overlay is None else None
    return Standard(camera, best, depth.numpy(), alpha.numpy(), surfaces.numpy(), masks, true_m)


def true_depths(uri: str, cameras: Sequence[Camera]) -> list[np.ndarray] | None:
    """Return exact depths of the procedural street, float64 [H, W] for each camera.

    Depth is infinite in the sky. Other scenes have none: the result is None.
    """
    scheme, _, query = parse_uri(uri)
    if scheme != "procedural":
        return None
    truth = open_truth(query)
    return [truth.render(camera).depth for camera in cameras]


def errors_of(knob: str, trials: Sequence[Trial], standards: Sequence[Standard]) -> Row:
    """Return the errors of pictures and depths with a knob at a value.

    Depth is compared with the reference's depth. Estimators of depth are compared with the scene's
    exact depth if it is known. The figure `depth_against` names the one that was used; it is None
    if the recipe writes no depth.

    Args:
        knob: Path of the knob.
        trials: The rendered views.
        standards: The same views at reference.
    """
    regions = [standard.region(knob) for standard in standards]
    expected_depths = [standard.best.depth for standard in standards]
    true_depths_m = [standard.true_m for standard in standards]
    depth_reference = None
    if knob == DEPTH and all(depth is not None for depth in true_depths_m):
        depth_reference = TRUTH
        expected_depths = true_depths_m
        regions = [
            np.isfinite(t) & s.surfaces for t, s in zip(true_depths_m, standards, strict=True)
        ]
    elif all(depth is not None for depth in expected_depths):
        depth_reference = REFERENCE
        regions = [
            region & (depth > 0) for region, depth in zip(regions, expected_depths, strict=True)
        ]
    depths = [trial.depth if depth_reference else None for trial in trials]
    pictures = [trial.rgb for trial in trials]
    return {
        **picture_figures(pictures, [standard.best.rgb for standard in standards]),
        **depth_figures(depths, expected_depths, regions),
        "depth_against": depth_reference,
        "flicker": flicker(standards[:2], pictures[:2]),
    }


def picture_figures(pictures: Sequence[np.ndarray], best: Sequence[np.ndarray]) -> Row:
    """Compare uint8 pictures [H, W, 3] of all views, display-encoded.

    Returns:
        psnr: dB, of the mean squared error of all views; None for equal pictures. flip, ssim:
            means.
        worst_flip: FLIP of the worst view.
    """
    pairs = list(zip(pictures, best, strict=True))
    mse = fmean(float((((a.astype(np.float64) - b) / 255) ** 2).mean()) for a, b in pairs)
    # Many settings have no effect on some scene.
    flips = [0.0 if np.array_equal(a, b) else flip(a, b) for a, b in pairs]
    return {
        "psnr": None if mse == 0 else -10 * math.log10(mse),
        "ssim": fmean(1.0 if np.array_equal(a, b) else ssim(a, b) for a, b in pairs),
        "flip": fmean(flips),
        "worst_flip": max(flips),
    }


def depth_figures(
    depths: Sequence[np.ndarray | None], right: Sequence[np.ndarray], where: Sequence[np.ndarray]
) -> Row:
    """Return errors of depth.

    Args:
        depths: [H, W] for each view. The measured depths, metres.
        right: [H, W] for each view. The expected depths, metres.
        where: [H, W] for each view, bool. The pixels that count.

    Returns:
        abs_rel: mean of |depth - right| / right where both have a surface.
        off_5cm: share of the pixels, of all views, whose error is above 5 cm or that have no depth.
        Both are None if there is no depth, or no pixel counts.
    """
    if any(depth is None for depth in depths) or not any(region.any() for region in where):
        return {"abs_rel": None, "off_5cm": None}
    measured_m, expected_m = (
        np.concatenate([i[r] for i, r in zip(depth_images, where, strict=True)]).astype(np.float64)
        for depth_images in (depths, right)
    )
    errors = depth_errors(measured_m, expected_m, measured_m > 0)
    close = errors.within_5cm * errors.pixels / measured_m.size if errors.pixels else 0.0
    return {"abs_rel": errors.abs_rel, "off_5cm": 1 - close}


def flicker(standards: Sequence[Standard], pictures: Sequence[np.ndarray]) -> float:
    """Return the flicker of two successive pictures, display-encoded, 0 to 1.

    It is NaN if the pictures share no surface. The module's head has its definition.

    Args:
        standards: The two views at reference.
        pictures: The two pictures, uint8 [H, W, 3].
    """
    first, second = (
        DepthView(
            standard.camera,
            (picture.astype(np.float32) - standard.best.rgb) / np.float32(255),
            standard.first_m,
            standard.alpha,
        )
        for standard, picture in zip(standards, pictures, strict=True)
    )
    if not (first.picture.any() or second.picture.any()):
        return 0.0
    warped, counts = warp_view(first, second)
    if not counts.any():
        return math.nan
    change = first.picture[counts].astype(np.float64) - warped[counts]
    return math.sqrt(float((change**2).mean()))


# ---- measuring ----------------------------------------------------------------------------------


class Trade(NamedTuple):
    """The result of `bench_trade`."""

    figures: Figures
    """The figures, for JSON."""
    pictures: dict[str, dict[str, np.ndarray]]
    """Pictures of the first view, by recipe and name of the settings of all knobs."""


def bench_trade(
    scene_uri: str,
    recipes: Sequence[str] = RECIPES,
    case: TradeCase = FULL_CASE,
    *,
    wholes: NamedSettings | None = None,
    backend: str = CPU,
) -> Trade:
    """Measure the time and the errors of settings on a scene.

    Times are the host's, until an 8-bit picture is in its memory. The CPU backend decides on which
    pixels errors count.

    Args:
        scene_uri: The address of the scene.
        recipes: Names out of RECIPES, presets or files.
        case: The size of the measurements.
        wholes: Settings of many knobs by name, which are measured instead of single knobs.
        backend: CPU or CUDA.

    Raises:
        SceneError: the scene cannot be used.
        RecipeError: a recipe cannot be used.
    """
    resolved_recipes = [trade_recipe(name) for name in recipes]
    scene = open_scene(scene_uri)
    with contextlib.suppress(SceneError):  # looked for once, not for every copy of the scene
        scene = dataclasses.replace(scene, ground=ground_of(scene))
    precompute_errors(scene)
    views = trade_views(scene, case.width)
    cameras = [camera for _, camera in views]
    machine = harness.machine_facts()
    gpu = None if backend == CPU else harness.gpu_facts()
    warm_up(resolved_recipes)
    true_m = true_depths(scene_uri, cameras) or [None] * len(cameras)
    pictures: dict[str, dict[str, np.ndarray]] = {recipe.name: {} for recipe in resolved_recipes}
    entries = []
    for recipe in tqdm(resolved_recipes, unit="recipe"):
        recipe_scene = dataclasses.replace(scene)  # its memo holds nothing of other recipes
        memo_of(recipe_scene).take_shared(memo_of(scene).shared())
        settings = settings_of_trade(recipe, wholes)
        standards = [
            render_standard(recipe_scene, camera, settings[0][1], true, backend)
            for camera, true in zip(cameras, true_m, strict=True)
        ]
        rows: list[Row] = []
        for row, picture in setting_rows(recipe_scene, recipe, settings, standards, case, backend):
            rows.append(row)
            if row["knob"] == ALL_KNOBS:
                pictures[recipe.name][row["value"]] = picture
        if wholes is None:
            rows += jpeg_rows([standard.best.rgb for standard in standards])
        rows = [{name: _rounded(value) for name, value in row.items()} for row in rows]
        entries.append({"recipe": recipe.name, "rows": rows})
    trade_figures = {
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
        "load_after": harness.load_average(),
        "recipes": entries,
    }
    return Trade(trade_figures, pictures)


def setting_rows(
    scene: Scene,
    recipe: Recipe,
    settings: Sequence[tuple[Row, Recipe]],
    standards: Sequence[Standard],
    case: TradeCase,
    backend: str,
) -> Iterator[tuple[Row, np.ndarray]]:
    """Yield rows of settings, and their pictures of the first view.

    Timed frames take turns, on one view after the other. Every setting has been rendered before,
    so that kernels are loaded and snow is placed.

    Args:
        scene: The scene.
        recipe: The recipe.
        settings: The starts of rows and their recipes, with the reference first.
        standards: The views at reference.
        case: The size of the measurements.
        backend: CPU or CUDA.
    """
    no_effects = {"weather": Weather(), "style": None, "light": None}
    clean = with_reference_settings(recipe.model_copy(update=no_effects))
    cameras = [standard.camera for standard in standards]

    def frame(trial_recipe: Recipe, camera: Camera) -> harness.Action:
        """Return an action that renders a frame without enlarging it to the full resolution."""
        return functools.partial(render_view, scene, camera, trial_recipe, backend=backend)

    for start in range(1, max(len(settings), 2), NUM_SETTINGS_PER_TURN):
        group = [({}, clean), settings[0], *settings[start : start + NUM_SETTINGS_PER_TURN]]
        trials = [
            [render_trial(scene, c, trial_recipe, backend) for c in cameras]
            for _, trial_recipe in group
        ]
        seconds: list[list[float]] = [[] for _ in group]
        for camera in cameras:
            frames = {
                str(n): frame(trial_recipe, camera) for n, (_, trial_recipe) in enumerate(group)
            }
            for name, timed in harness.rounds(frames, case.repeats).items():
                seconds[int(name)] += timed
        for n in range(1 if start == 1 else 2, len(group)):
            head, trial_recipe = group[n]
            row = {**head, **_times(seconds[n])}
            row["over_reference"] = harness.spread_ratio(seconds[n], seconds[1])["median"]
            row["over_clean"] = harness.spread_ratio(seconds[n], seconds[0])["median"]
            row |= errors_of(row["knob"], trials[n], standards)
            if case.memory and row["knob"] == ALL_KNOBS:
                row["mib"] = frame_mib(frame(trial_recipe, cameras[0]), backend)
            yield row, trials[n][0].rgb


def frame_mib(frame: harness.Action, backend: str) -> float | None:
    """Return the peak memory of a frame above its scene, MiB; on a GPU that of its memory.

    The renderer's work space is freed before, so that it counts as in a fresh process.
    """
    if backend == CUDA:
        return harness.peak_gpu_mib(frame)[1]
    free_scratch()
    return harness.extra_mib(frame)


def jpeg_rows(pictures: Sequence[np.ndarray]) -> Iterator[Row]:
    """Yield rows of the encoding as PNG, and as JPEG of each quality.

    A row has milliseconds and kB of an image, and its errors against PNG, which loses nothing.
    """
    for quality in ("png", *KNOBS[JPEG].values):
        output = Output() if quality == "png" else Output(image="jpg", jpeg_quality=quality)
        encode = [functools.partial(encode_image, picture, output) for picture in pictures]
        times = harness.rounds({str(n): encoder for n, encoder in enumerate(encode)}, 1).values()
        files = [encoder() for encoder in encode]
        yield {
            "knob": JPEG,
            "value": quality,
            **_times([s for encoder in times for s in encoder]),
            "kilobytes": fmean(len(data) / 1e3 for data in files),
            **picture_figures([decode_image(data) for data in files], pictures),
        }


def _times(seconds: Sequence[float]) -> Row:
    return dict(zip(("ms", "ms_min", "ms_p90"), harness.spread_ms(seconds).values(), strict=True))


def _rounded(value: Any) -> Any:
    """Return a number with DIGITS digits, since further digits are noise; other values as given."""
    if not isinstance(value, float):
        return value
    return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None


def rows_of(tables: Tables) -> list[Row]:
    """Return all rows of tables, each with its scene and recipe."""
    return [
        {"scene": table["scene"], "recipe": entry["recipe"], **row}
        for table in tables
        for entry in table["recipes"]
        for row in entry["rows"]
    ]


def printable(trade: Mapping[str, Any]) -> Figures:
    """Return the figures in the form in which all subjects are printed.

    Every recipe has a table of settings, with those of all knobs together first, and a table of
    files. Columns without any value are left out.
    """
    order = [ALL_KNOBS, *KNOBS]
    tables = []
    for entry in trade["recipes"]:
        rows = sorted(entry["rows"], key=lambda row: order.index(row["knob"]))
        for title, of_files in ((entry["recipe"], False), (f"{entry['recipe']}, files", True)):
            table_rows = [row for row in rows if (row["knob"] == JPEG) == of_files]
            columns = {
                n: k for n, k in COLUMNS.items() if any(r.get(k) is not None for r in table_rows)
            }
            cells = [[_cell(key, row.get(key)) for key in columns.values()] for row in table_rows]
            tables += [Table(title, tuple(columns), cells)] if cells else []
    table_rows = harness.figures("trade", tables, machine=trade["machine"], gpu=trade["gpu"])
    return {**table_rows, "load_after": trade["load_after"]}


def _cell(key: str, value: Any) -> Any:
    if key in ("knob", "value"):
        return _text(value).removeprefix("weather.")
    return 100 * value if key in ("off_5cm", "abs_rel") and value is not None else value


def _text(value: Value) -> str:
    return "all" if value is None else str(value)


# ---- the rule of the tiers ----------------------------------------------------------------------

# The largest FLIP of a tier's pictures. balanced: a viewer takes the picture for the same. On every
# published scene and recipe the bound is below the FLIP of a JPEG at quality 92, which people take
# for lossless. draft: the picture differs visibly but shows the same things. Reconstructions differ
# as much from their recordings (docs/reconstruction.md: 0.05 to 0.11 on held-out views).
BOUNDS = {"draft": 0.10, "balanced": 0.02}


class Unmeasured(Exception):
    """Raised when no row has settings whose error the rule needs. Its argument: the settings."""


def tiers_from(tables: Tables) -> dict[str, dict[str, Value]]:
    """Return the settings of each tier, by the knobs' paths, without knobs at reference.

    Raises:
        Unmeasured: the tables lack settings that have to be rendered together.
    """
    return {name: tier_from(tables, bound) for name, bound in BOUNDS.items()}


def tier_from(tables: Tables, bound: float) -> dict[str, Value]:
    """Return the settings of one tier. bound: its largest FLIP.

    Raises:
        Unmeasured: the tables lack settings that have to be rendered together.
    """
    rows = rows_of(tables)
    ladders = {}
    for path, knob in KNOBS.items():
        if knob.is_selectable:
            costs = [value_cost(rows, path, value) for value in knob.values[:-1]]
            known_costs = [cost for cost in costs if cost is not None]
            fast_first = select_useful_values([*known_costs, Cost(knob.reference, 100.0, 0.0)])[
                ::-1
            ]
            # What is beyond the bound alone need not be rendered with others.
            ladders[path] = [cost for cost in fast_first if cost.flip <= bound]
    by_time = sorted(ladders, key=lambda path: _saved(rows, path, ladders[path]), reverse=True)
    chosen = search_settings(
        {path: [cost.value for cost in ladders[path]] for path in by_time},
        lambda settings: whole_flip(rows, settings) <= bound,
    )
    return _moved(chosen, KNOBS)


def _saved(rows: Sequence[Row], path: str, costs: Sequence[Cost]) -> float:
    """Return the largest saving of a knob's values, as the sum of logarithms over all recipes."""
    of_values = (_of_value(rows, path, cost.value) for cost in costs)
    return max(
        -sum(math.log(row["over_reference"]) for row in value_rows) for value_rows in of_values
    )


def value_cost(rows: Sequence[Row], path: str, value: Value) -> Cost | None:
    """Return the cost of a knob's value.

    Its `ms` is here per cent of the reference's time, and its `flip` is the worst. The result is
    None if no table has the value, or if it changes no picture: its time would be noise.
    """
    changed_rows = [row for row in _of_value(rows, path, value) if row["worst_flip"] > 0]
    if not changed_rows:
        return None
    return Cost(
        value, 100 * _mean_ratio(changed_rows), max(row["worst_flip"] for row in changed_rows)
    )


def whole_flip(rows: Sequence[Row], settings: Settings) -> float:
    """Return the worst FLIP of settings that are used together.

    If only one knob of a recipe is not at reference, the rows of that knob alone count.

    Raises:
        Unmeasured: a recipe has no row of the settings.
    """
    by_recipe: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        by_recipe.setdefault((row["scene"], row["recipe"]), []).append(row)
    worst = [0.0]
    for recipe_rows in by_recipe.values():
        knobs = {row["knob"] for row in recipe_rows}
        if moved := _moved(settings, knobs):
            flips = [
                row["worst_flip"] for row in recipe_rows if _moved(_settings(row), knobs) == moved
            ]
            if not flips:
                raise Unmeasured(settings)
            worst += flips
    return max(worst)


def _settings(row: Row) -> Mapping[str, Value]:
    single = {} if row["knob"] == ALL_KNOBS else {row["knob"]: row["value"]}
    return row.get("settings", single)


def _moved(settings: Mapping[str, Value], knobs: Container[str]) -> dict[str, Value]:
    """Return the settings of some knobs that are not at reference."""
    return {p: v for p, v in settings.items() if p in knobs and v != KNOBS[p].reference}


def _of_value(rows: Sequence[Row], path: str, value: Value) -> list[Row]:
    return [row for row in rows if (row["knob"], row["value"]) == (path, value)]


def _mean_ratio(rows: Sequence[Row]) -> float:
    return math.exp(sum(math.log(row["over_reference"]) for row in rows) / len(rows))


def find_tiers(
    tables: Sequence[dict[str, Any]], uris: Sequence[str], case: TradeCase
) -> dict[str, dict[str, Value]]:
    """Return the tiers. Settings that the rule needs and the tables lack are rendered and added."""
    while True:
        try:
            return tiers_from(tables)
        except Unmeasured as missing:
            for table, uri in zip(tables, uris, strict=True):
                values = {str(row["value"]) for row in rows_of([table])}
                tried = sum(value.startswith("candidate") for value in values)
                measure_wholes(table, uri, {f"candidate {tried + 1}": missing.args[0]}, case)


def measure_wholes(
    table: dict[str, Any], uri: str, wholes: NamedSettings, case: TradeCase
) -> Trade:
    """Render settings on the table's scene. Their rows replace the table's rows of these names."""
    names = [entry["recipe"] for entry in table["recipes"]]
    trade = bench_trade(uri, names, case, wholes=wholes)
    for entry, new in zip(table["recipes"], trade.figures["recipes"], strict=True):
        other_rows = [
            row for row in entry["rows"] if row["knob"] != ALL_KNOBS or row["value"] not in wholes
        ]
        entry["rows"] = other_rows + [row for row in new["rows"] if row["value"] in wholes]
    return trade


# ---- docs/trade.md ------------------------------------------------------------------------------

DOCS = Path(__file__).resolve().parents[2] / "docs"  # The folder of the documentation.
PAGE = DOCS / "trade.md"  # The document with the tables.
SCENES = {"street": "street", "pandaset": "PandaSet 002"}  # The titles of scenes by file name.
# The lines of the document between which a table is written.
START_MARKER = "<!-- {name}: made by python -m tools.bench.trade -->"
END_MARKER = "<!-- end of {name} -->"


def read_tables() -> list[dict[str, Any]]:
    """Read the published figures of SCENES, with their titles as names of the scenes."""
    files = {title: DOCS / "trade" / f"{name}.json" for name, title in SCENES.items()}
    return [{**json.loads(path.read_text()), "scene": title} for title, path in files.items()]


def document(text: str, tables: Tables) -> str:
    """Return a document with new tables.

    Raises:
        ValueError: the document lacks a marker.
    """
    sections = {
        "machine": [_machine_line(table) for table in tables],
        "tiers": _tier_lines(),
        "wholes": _whole_lines(tables),
        "knobs": _knob_lines(tables),
    }
    for name, lines in sections.items():
        start = START_MARKER.format(name=name)
        end = END_MARKER.format(name=name)
        text = harness.replace_marked(text, start, end, "\n".join(lines))
    return text


def _machine_line(trade: Mapping[str, Any]) -> str:
    view = "{camera} of frame {frame} ({width}x{height})"
    return (
        f"- {harness.machine_line(trade)}; {trade['scene']}, {trade['gaussians']:,} Gaussians; "
        f"{', '.join(view.format(**view_facts) for view_facts in trade['views'])}; "
        f"{trade['repeats']} timed frames of each view and setting."
    )


def _tier_lines() -> list[str]:
    rows = []
    for path, knob in KNOBS.items():
        values = [TIERS[name].get(path, knob.reference) for name in BOUNDS]
        rows += [
            [f"`{path}`", knob.description, *map(_text, [*values, knob.reference])]
        ] * knob.is_selectable
    return _lines(["knob", "what it is", *BOUNDS, REFERENCE], rows)


def _whole_lines(tables: Tables) -> list[str]:
    """Return a table of settings of all knobs: time over the reference's, and the worst FLIP."""
    names = (DEFAULTS, *BOUNDS)
    lines = []
    whole_rows = [row for row in rows_of(tables) if row["knob"] == ALL_KNOBS]
    row_of = {(row["scene"], row["recipe"], row["value"]): row for row in whole_rows}
    for scene, recipe in dict.fromkeys(key[:2] for key in row_of):
        named_rows = [row_of[scene, recipe, name] for name in names]
        cells = [f"{row['over_reference']:.2f}, {row['worst_flip']:.3f}" for row in named_rows]
        lines.append([scene, recipe, f"{row_of[scene, recipe, REFERENCE]['ms']:.0f}", *cells])
    header = ["scene", "recipe", "reference ms", *(f"{name}: x, FLIP" for name in names)]
    return _lines(header, lines)


def _knob_lines(tables: Tables) -> list[str]:
    """Return a table of knobs: mean ratio of times and worst errors over affected recipes."""
    rows = [
        [f"`{path}`", _text(value), *(c for t in tables for c in _knob_cells(t, path, value))]
        for path, knob in KNOBS.items()
        for value in measured_values(knob)
    ]
    headings = ("x reference", "worst FLIP", "depth off")
    return _lines(
        ["knob", "value", *(f"{t['scene']}: {n}" for t in tables for n in headings)], rows
    )


def _knob_cells(table: Mapping[str, Any], path: str, value: Value) -> list[str]:
    rows = _of_value(rows_of([table]), path, value)
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
    """Return the lines of a Markdown table; all columns but the first two are right-aligned."""
    return harness.markdown_lines(header, ["---", "---", *["---:"] * (len(header) - 2)], rows)


# ---- pictures -----------------------------------------------------------------------------------

CROP_PX = 300  # The height of a part of a picture that is shown, pixels.
CROP_AT = (0.5, 0.56)  # The middle of that part, as shares of the picture's width and height.


def check_matplotlib() -> None:
    """Check that matplotlib is installed, before minutes of measuring.

    Raises:
        ClimateGSError: it is not installed.
    """
    if importlib.util.find_spec("matplotlib") is None:
        raise ClimateGSError("the chart needs matplotlib: pip install 'climategs[plots]'")


def draw_trade(folder: Path, trade: Trade) -> list[Path]:
    """Draw trade_<scene>.png, FLIP against time by recipe, and trade_<scene>_tiers.jpg."""
    folder.mkdir(parents=True, exist_ok=True)
    name = "".join(c if c.isalnum() else "_" for c in trade.figures["scene"])
    chart = folder / f"trade_{name}.png"
    tiers = folder / f"trade_{name}_tiers.jpg"
    draw_chart(chart, trade.figures)
    draw_tiers(tiers, trade)
    return [chart, tiers]


def draw_chart(path: Path, figures: Mapping[str, Any]) -> None:
    """Draw a panel for each recipe: a line for each knob, and a mark for settings of all knobs."""
    from matplotlib.figure import Figure

    recipes = figures["recipes"]
    lines = -(-len(recipes) // 2)
    figure = Figure(figsize=(13, 4.6 * lines), layout="constrained")
    for number, entry in enumerate(recipes, 1):
        axes = figure.add_subplot(lines, min(2, len(recipes)), number, title=entry["recipe"])
        points: dict[str, list[tuple[float, float]]] = {}
        for row in entry["rows"]:
            if row["knob"] not in (DEPTH, JPEG) and not str(row["value"]).startswith("candidate"):
                is_whole = row["knob"] == ALL_KNOBS
                name = row["value"] if is_whole else row["knob"].removeprefix("weather.")
                curve = points.setdefault(name, [] if is_whole else [(1.0, 0.0)])
                curve.insert(-1, (row["over_reference"], row["flip"]))
        for name, curve in points.items():
            axes.plot(*zip(*curve, strict=True), marker="D" if len(curve) == 1 else ".", label=name)
        axes.set_yscale("symlog", linthresh=1e-3)  # 0 is on it
        axes.set_xlim(left=0)
        axes.set_xlabel("time over the reference's")
        axes.set_ylabel("mean FLIP against the reference")
        axes.legend(fontsize="x-small")
    figure.savefig(path, metadata={"Software": None})


def draw_tiers(path: Path, trade: Trade) -> None:
    """Draw a row for each recipe: the same part of the reference and the tiers, time and error.

    The part is half the picture's height around CROP_AT. Pixels are enlarged without smoothing,
    since the pixels are compared.
    """
    lines = []
    for entry in trade.figures["recipes"]:
        whole_rows = {row["value"]: row for row in entry["rows"] if row["knob"] == ALL_KNOBS}
        panels = []
        for name in (REFERENCE, *list(BOUNDS)[::-1]):
            picture = trade.pictures[entry["recipe"]][name]
            row = whole_rows[name]
            height, width = picture.shape[:2]
            tall = height // 2
            wide = min(width, height * 2 // 3)
            top = min(max(0, round(CROP_AT[1] * height - tall / 2)), height - tall)
            left = min(max(0, round(CROP_AT[0] * width - wide / 2)), width - wide)
            part = picture[top : top + tall, left : left + wide]
            size = (round(CROP_PX * wide / tall), CROP_PX)
            enlarged = cv2.resize(part, size, interpolation=cv2.INTER_NEAREST)
            error = "" if name == REFERENCE else f", FLIP {row['flip']:.4f}"
            panels.append(
                captioned(enlarged, f"{entry['recipe']}, {name}", f"{row['ms']:.0f} ms{error}")
            )
        lines.append(strip(panels))
    write_rgb(path, np.concatenate(lines))


def main(arguments: Sequence[str]) -> None:
    """Run the module's command with arguments TABLE.json=SCENE_URI."""
    pairs = [argument.partition("=") for argument in arguments]
    if not all(uri for _, _, uri in pairs):
        raise SystemExit("usage: python -m tools.bench.trade [TABLE.json=SCENE_URI ...]")
    paths = [Path(path) for path, _, _ in pairs]
    uris = [uri for _, _, uri in pairs]
    tables = [json.loads(path.read_text()) for path in paths]
    if tables:
        width = max(view["width"] for view in tables[0]["views"])
        case = TradeCase(width=width, repeats=tables[0]["repeats"])
        tiers = find_tiers(tables, uris, case)
        for path, uri, table in zip(paths, uris, tables, strict=True):
            trade = measure_wholes(table, uri, tiers, case)
            draw_tiers(path.with_name(f"{path.stem}_tiers.jpg"), trade)
            path.write_text(json.dumps(table, indent=1) + "\n")
        for name, settings in tiers.items():
            print(f"{name}: {settings}")
    PAGE.write_text(document(PAGE.read_text(), read_tables()))


if __name__ == "__main__":
    main(sys.argv[1:])
