"""`climategs bench trade`: what each knob that buys speed costs in accuracy, on one scene."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from tqdm import tqdm

from adapters.base import open_scene
from augment.ground import ground_of
from augment.render.buffers import CPU
from augment.scene import Scene
from recipes.schema import Recipe, Value
from tools.gpu_clock import gpu_facts
from tools.machine import load_average, machine_facts
from tools.trade_cases import (
    RECIPES,
    WHOLE_CASE,
    TradeCase,
    View,
    settings_of_trade,
    trade_recipe,
    trade_views,
)
from tools.trade_errors import true_depths
from tools.trade_measure import Measured, Row, measure_recipe
from tools.warm_up import warm_up

DIGITS = 4  # significant ones that figures keep


@dataclass(frozen=True, eq=False)
class Trade:
    """figures: for JSON. pictures: the first view's, by recipe and name of the whole."""

    figures: dict[str, Any]
    pictures: dict[str, dict[str, np.ndarray]]


def bench_trade(
    scene_uri: str,
    recipes: Sequence[str] = RECIPES,
    case: TradeCase = WHOLE_CASE,
    *,
    progress: bool = True,
    wholes: Mapping[str, Mapping[str, Value]] | None = None,
    backend: str = CPU,
) -> Trade:
    """recipes: of trade_cases.RECIPES, presets or files. wholes: settings of many knobs that are
    measured instead of single ones, by name. backend: CPU or CUDA. Times are the host's, to 8 bits
    that lie there.

    Interrupted, it says so and gives what it has of finished recipes, if it has any.

    Raises:
        SceneError, RecipeError: the scene or a recipe cannot be used.
    """
    drawn = [trade_recipe(name) for name in recipes]
    scene = _opened(scene_uri, drawn)
    views = trade_views(scene, case)
    machine = dataclasses.asdict(machine_facts())
    gpu = gpu_facts() if backend != CPU else None
    counts = [len(settings_of_trade(recipe, case, wholes)) for recipe in drawn]
    warm_up(drawn)
    true_m = true_depths(scene_uri, [view.camera for view in views])
    found: dict[str, Measured] = {}
    with tqdm(total=sum(counts), unit="setting", disable=not progress) as bar:
        for recipe in drawn:
            try:
                found[recipe.name] = measure_recipe(
                    scene,
                    views,
                    recipe,
                    case,
                    wholes=wholes,
                    true_m=true_m,
                    bar=bar,
                    backend=backend,
                )
            except KeyboardInterrupt:
                if not found:
                    raise
                bar.write(f"stopped: {len(found)} of {len(drawn)} recipes are measured")
                break
    figures = {
        "scene": scene.name,
        "gaussians": len(scene.background.means),
        "views": [_view_facts(view) for view in views],
        "repeats": case.repeats,
        "machine": machine,
        "gpu": None if gpu is None else dataclasses.asdict(gpu),
        "backend": backend,
        "load_after": load_average(),
        "recipes": [
            {"recipe": name, "rows": [_short(row) for row in measured.rows]}
            for name, measured in found.items()
        ],
    }
    return Trade(figures, {name: measured.pictures for name, measured in found.items()})


def table_of(figures: Mapping[str, Any]) -> list[Row]:
    """One row for every recipe, knob and value: {scene, recipe, knob, value, ms, flip, ...}."""
    return list(_rows(figures))


def _rows(figures: Mapping[str, Any]) -> Iterator[Row]:
    for entry in figures["recipes"]:
        for row in entry["rows"]:
            yield {"scene": figures["scene"], "recipe": entry["recipe"], **row}


def _opened(uri: str, recipes: Sequence[Recipe]) -> Scene:
    scene = open_scene(uri)
    if any(recipe.weather.flood is not None for recipe in recipes):
        scene = dataclasses.replace(scene, ground=ground_of(scene))  # looked for once
    return scene


def _view_facts(view: View) -> dict[str, Any]:
    camera = view.camera
    return {
        "camera": camera.name,
        "frame": view.frame,
        "width": camera.width,
        "height": camera.height,
    }


def _short(row: Row) -> Row:
    """Numbers to a few digits: the rest is noise, and the files are kept."""
    return {name: _rounded(value) for name, value in row.items()}


def _rounded(value: Any) -> Any:
    if not isinstance(value, float):
        return value
    return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
