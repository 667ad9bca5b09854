"""Every setting of a recipe on every view: its time, its errors, its memory.

Settings are timed a few at a time, in turns with the reference and the clean frame, so that what
the machine does meanwhile falls on all; ratios are taken within each turn.
"""

from __future__ import annotations

import dataclasses
import gc
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from tqdm import tqdm

from augment.effects.snow.snow import placement_settings
from augment.effects.snow.support import bed_of, remember_support
from augment.effects.style.style import remember_maps, style_maps
from augment.jobs.files import decode_image, encode_image
from augment.jobs.quality import Trial, render_trial
from augment.render.buffers import CPU, CUDA
from augment.render.cpu.driver import release_scratch
from augment.scene import Scene
from recipes.schema import BY_PATH, Output, Recipe, Value
from tools.bench_memory import RESET_PEAK, extra_mib, return_free_memory, status_mib
from tools.bench_pairs import spread_ms, turns
from tools.gpu_clock import gpu_mib, peak_gpu_mib
from tools.trade_cases import (
    CLEAN,
    DEPTH,
    JPEG,
    REFERENCE,
    TRUTH,
    WHOLE,
    Setting,
    TradeCase,
    View,
    clean_recipe,
    grouped,
    settings_of_trade,
)
from tools.trade_errors import (
    PictureErrors,
    Standard,
    depth_figures,
    flicker,
    picture_figures,
    standard_of,
)

AT_A_TIME = 6  # settings between two frames of the reference
SMALL = 0.125  # resolution of the frame after which what stays of a recipe is weighed
Row = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Measured:
    """A recipe's rows, reference first, and the first view's pictures of its wholes, by name."""

    rows: list[Row]
    pictures: dict[str, np.ndarray]


class Stage:
    """A scene for each snow and style, and what renders them: what is laid and mapped for one is
    remembered as long as its scene lives, a few of them only, and must not be made anew between two
    timed frames.
    """

    def __init__(self, scene: Scene, view: View, backend: str) -> None:
        self._bare, self._view, self.backend = scene, view, backend
        self._dressed: dict[str, Scene] = {}
        self.kept_mib: dict[str, float | None] = {}

    def scene_for(self, recipe: Recipe) -> Scene:
        key = _dress(recipe)
        if key not in self._dressed:
            if not self._dressed:  # kernels and tables that are loaded once belong to no scene
                self._kept(dressed(self._bare, recipe, self.backend), recipe)
            scene = self._dressed[key] = dressed(self._bare, recipe, self.backend)
            self.kept_mib[key] = self._kept(scene, recipe)
        return self._dressed[key]

    def kept_of(self, recipe: Recipe) -> float | None:
        """MiB that stay with the scene after the first frame: the snow's splats, styled colours."""
        return self.kept_mib[_dress(recipe)]

    def _kept(self, scene: Scene, recipe: Recipe) -> float | None:
        before = _resident_mib(self.backend)
        render_trial(scene, self._view.camera.scaled(SMALL), recipe, self.backend)
        after = _resident_mib(self.backend)
        return None if before is None or after is None else max(0.0, after - before)


def dressed(bare: Scene, recipe: Recipe, backend: str) -> Scene:
    """A scene of the same arrays for one recipe's snow and style to stay with. Where snow can lie
    and what a style maps colours to is looked for in the bare scene, once.
    """
    scene = dataclasses.replace(bare)
    snow, style = recipe.weather.snow, recipe.style
    if snow is not None:
        settings = placement_settings(snow)
        remember_support(scene, settings, bed_of(bare, settings, backend=backend))
    if style is not None:
        usual = style.model_copy(update={"evaluated": "color"})
        remember_maps(scene, style, style_maps(bare, usual))
    return scene


def measure_recipe(
    scene: Scene,
    views: Sequence[View],
    recipe: Recipe,
    case: TradeCase,
    *,
    wholes: Mapping[str, Mapping[str, Value]] | None = None,
    true_m: Sequence[np.ndarray] | None = None,
    bar: tqdm | None = None,
    backend: str = CPU,
) -> Measured:
    """wholes: as of settings_of_trade. true_m: the scene's exact depth by view; it is not used for
    recipes with snow, whose surface is another. backend: of what is timed and compared; on which
    pixels errors count is the CPU backend's to say.
    """
    settings = settings_of_trade(recipe, case, wholes)
    stage = Stage(scene, views[0], backend)
    clean = Setting(CLEAN, CLEAN, clean_recipe(recipe))
    best = settings[0]
    known = true_m if recipe.weather.snow is None else None
    standards = [
        standard_of(stage.scene_for(best.recipe), view, best.recipe, true)
        for view, true in zip(views, known or [None] * len(views), strict=True)
    ]
    rows: list[Row] = []
    pictures: dict[str, np.ndarray] = {}
    for group in grouped(settings, AT_A_TIME):
        timed = time_group(stage, views, [clean, best, *group], case.repeats)
        for setting in [*([] if rows else [best]), *group]:
            if bar is not None:
                bar.set_postfix_str(f"{recipe.name}: {setting.knob} {setting.value}")
            row = {"knob": setting.knob, "value": setting.value}
            if setting.knob == WHOLE and setting.given:
                row["settings"] = dict(setting.given)
            row |= timed.figures(setting, best, clean)
            row |= _errors(setting, best, standards, timed)
            if case.memory:
                row |= _memory(stage, views[0], setting)
            rows.append(row)
            if setting.knob == WHOLE:
                pictures[str(setting.value)] = timed.trials[_name(setting)][0].picture
            if bar is not None:
                bar.update()
    if wholes is None:
        rows += jpeg_rows([timed.trials[_name(best)][n].picture for n in range(len(views))])
    return Measured(rows, pictures)


@dataclass(eq=False)
class Timed:
    """By the setting's name: its first pictures, by view, and seconds of its frames, in turns."""

    trials: dict[str, list[Trial]] = field(default_factory=lambda: defaultdict(list))
    seconds: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))

    def figures(self, setting: Setting, best: Setting, clean: Setting) -> Row:
        """ms: least, median, 90 %. over_reference, over_clean: medians of the turns' ratios."""
        own = self.seconds[_name(setting)]
        ratios = {
            "over_reference": [a / b for a, b in zip(own, self.seconds[_name(best)], strict=True)],
            "over_clean": [a / b for a, b in zip(own, self.seconds[_name(clean)], strict=True)],
        }
        spread = spread_ms(own)
        return {
            "ms": spread["median"],
            "ms_min": spread["min"],
            "ms_p90": spread["p90"],
            **{name: statistics.median(values) for name, values in ratios.items()},
        }


def time_group(
    stage: Stage, views: Sequence[View], settings: Sequence[Setting], repeats: int
) -> Timed:
    """Frames of all settings in turns, on one view after the other; the first of each, which loads
    and lays what it needs, gives the picture and is not timed.
    """
    timed, by_name = Timed(), {_name(setting): setting for setting in settings}
    for view in views:
        for repeat in range(repeats + 1):
            for name in turns(by_name, repeat):
                recipe = by_name[name].recipe
                trial = render_trial(stage.scene_for(recipe), view.camera, recipe, stage.backend)
                if repeat:
                    timed.seconds[name].append(trial.seconds)
                else:
                    timed.trials[name].append(trial)
    return timed


def _errors(setting: Setting, best: Setting, standards: Sequence[Standard], timed: Timed) -> Row:
    own, good = timed.trials[_name(setting)], timed.trials[_name(best)]
    pairs = list(zip(own, good, strict=True))
    row: Row = picture_figures([PictureErrors.between(a.picture, b.picture) for a, b in pairs])
    row |= _depth_errors(setting, own, good, standards)
    row["flicker"] = flicker(standards[0], standards[1], own[:2], good[:2])
    return row


def _depth_errors(
    setting: Setting, own: Sequence[Trial], good: Sequence[Trial], standards: Sequence[Standard]
) -> Row:
    """Against the reference's; of estimators, where the scene's exact depth is known, against that.

    depth_against: which of the two.
    """
    depths, true = [t.depth for t in own], [s.true_m for s in standards if s.true_m is not None]
    if setting.knob == DEPTH and len(true) == len(standards):
        where = [np.isfinite(t) & s.surfaces for t, s in zip(true, standards, strict=True)]
        return {**depth_figures(depths, true, where), "depth_against": TRUTH}
    right = [t.depth for t in good if t.depth is not None]
    if len(right) < len(good):  # the recipe writes none
        return {"abs_rel": None, "off_5cm": None, "depth_against": None}
    where = [
        standard.region(setting.knob) & (best > 0)
        for standard, best in zip(standards, right, strict=True)
    ]
    return {**depth_figures(depths, right, where), "depth_against": REFERENCE}


def jpeg_rows(pictures: Sequence[np.ndarray]) -> list[Row]:
    """Encoding as PNG and as JPEG of each quality: ms and kB an image, errors against PNG, which
    loses nothing.
    """
    rows = []
    for quality in ("png", *BY_PATH[JPEG].values):
        output = Output() if quality == "png" else Output(image="jpg", jpeg_quality=quality)
        seconds, kilobytes, errors = [], [], []
        for picture in pictures:
            started = time.perf_counter()
            data = encode_image(picture, output)
            seconds.append(time.perf_counter() - started)
            kilobytes.append(len(data) / 1e3)
            errors.append(PictureErrors.between(decode_image(data), picture))
        spread = spread_ms(seconds)
        rows.append({
            "knob": JPEG,
            "value": quality,
            "ms": spread["median"],
            "ms_min": spread["min"],
            "ms_p90": spread["p90"],
            "kilobytes": statistics.fmean(kilobytes),
            **picture_figures(errors),
        })  # fmt: skip
    return rows


def _memory(stage: Stage, view: View, setting: Setting) -> Row:
    """mib: of a frame above its scene, at its highest moment. kept_mib: what stays with the scene.

    The renderer's work space is given back before; so the frame takes all it needs anew, as in a
    process of its own (docs/trade.md has both beside each other). On a GPU both are of its memory.
    """
    scene = stage.scene_for(setting.recipe)

    def frame() -> object:
        return render_trial(scene, view.camera, setting.recipe, stage.backend)

    if stage.backend == CUDA:
        peak = peak_gpu_mib(frame)
        mib = None if peak is None else peak[1]
    else:
        mib = frame_mib(frame) if RESET_PEAK.is_file() else None
    return {"mib": mib, "kept_mib": stage.kept_of(setting.recipe)}


def frame_mib(action: Callable[[], object]) -> float:
    release_scratch()
    return extra_mib(action)


def _resident_mib(backend: str) -> float | None:
    """What the process, or on a GPU its tensors, take now; None where nothing tells."""
    if backend == CUDA:
        return gpu_mib()
    if not RESET_PEAK.is_file():
        return None
    release_scratch()
    gc.collect()
    return_free_memory()
    return status_mib("VmRSS")


def _name(setting: Setting) -> str:
    return f"{setting.knob}={setting.value}"


def _dress(recipe: Recipe) -> str:
    """What of a recipe stays with the scene from frame to frame."""
    snow, style, flood = recipe.weather.snow, recipe.style, recipe.weather.flood
    level = None if flood is None else flood.level_m
    return repr((snow, style, None if snow is None else level))
