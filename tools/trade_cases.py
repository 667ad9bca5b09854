"""What `climategs bench trade` renders: views of a scene, recipes, and their settings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from augment.cameras import Camera
from augment.errors import SceneError
from augment.scene import Scene
from recipes.change import changed
from recipes.load import load_recipe
from recipes.schema import (
    KNOBS,
    TIERS,
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

WHOLE = "whole"  # stands for a knob where several are set
DEPTH, JPEG = "output.depth", "output.jpeg_quality"
REFERENCE, DEFAULTS, CLEAN = "reference", "defaults", "clean"
TRUTH = "truth"  # what depths are compared with where the scene's surfaces are known
PRESETS = {"smog": "brown-smog", "flood": "street-flood", "snow": "fresh-snow", "style": "evening"}
RECIPES = (CLEAN, *PRESETS, "all")


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
class View:
    """camera: of the size that reference pictures have."""

    frame: int
    camera: Camera

    @property
    def name(self) -> str:
        return f"{self.camera.name} of frame {self.frame}"


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
    def is_reference(self) -> bool:
        return (self.knob, self.value) == (WHOLE, REFERENCE)


def trade_recipe(name: str) -> Recipe:
    """One of RECIPES, a preset or a file: its first variant, without any wish for quality."""
    if name == CLEAN:
        recipe = Recipe(name=CLEAN)
    elif name == "all":
        recipe = Recipe(
            name="all",
            weather=Weather(
                smog=Smog(visibility_m=400.0, scale_height_m=120.0),
                flood=Flood(level_m=0.15, turbidity_ntu=20.0),
                snow=Snow(depth_m=0.1),
            ),
            style=Style(preset="overcast"),
        )
    else:
        loaded = load_recipe(PRESETS.get(name, name)).resolve(0)
        recipe = loaded.model_copy(update={"name": name if name in PRESETS else loaded.name})
    return recipe.model_copy(update={"quality": Quality()})


def clean_recipe(recipe: Recipe) -> Recipe:
    """The reference without effects: the same files of the same scene."""
    return as_reference(recipe.model_copy(update={"weather": Weather(), "style": None}))


def settings_of_trade(
    recipe: Recipe, case: TradeCase, wholes: Mapping[str, Mapping[str, Value]] | None = None
) -> list[Setting]:
    """Reference first, each knob's other values alone, then wholes: by default the tiers and the
    recipe with its own settings.

    wholes: other wholes instead, by name; then single knobs are left out.
    """
    best = as_reference(recipe)
    chosen = [knob for knob in knobs_of(recipe) if knob.chosen]
    found = [Setting(WHOLE, REFERENCE, best, {k.path: k.reference for k in chosen})]
    if wholes is None:
        for knob in (k for k in knobs_of(recipe) if not k.path.startswith("output.")):
            for value in knob.values[:-1]:
                found.append(Setting(knob.path, value, with_settings(best, {knob.path: value})))
        found += [Setting(DEPTH, name, changed(best, {DEPTH: name})) for name in case.depths]
        found.append(Setting(WHOLE, DEFAULTS, recipe))
    for name, given in (TIERS if wholes is None else wholes).items():
        own = {k.path: given.get(k.path, k.reference) for k in chosen}
        found.append(Setting(WHOLE, name, with_settings(best, own), own))
    return found


def trade_views(scene: Scene, case: TradeCase) -> list[View]:
    """The front camera in the middle of the drive, the same in the next frame, and the camera that
    looks away from it the most.

    Raises:
        SceneError: the scene has one frame only.
    """
    if len(scene.frames) < 2:
        raise SceneError(
            f"{scene.name} has {len(scene.frames)} frame: the trade needs two in a row, since "
            f"flicker is measured between them"
        )
    at = (len(scene.frames) - 1) // 2
    now, after = scene.frames[at], scene.frames[at + 1]
    shared = [name for name in now.cameras if name in after.cameras]
    if not shared:
        raise SceneError(f"{scene.name}: frames {now.index} and {after.index} share no camera")
    front = min((n for n in shared if "front" in n), key=len, default=shared[0])
    ahead = _axis(now.cameras[front])
    other = min(now.cameras, key=lambda name: float(_axis(now.cameras[name]) @ ahead))
    views = [(now, front), (after, front)] + ([(now, other)] if other != front else [])
    return [View(frame.index, fitted(frame.cameras[name], case.width)) for frame, name in views]


def fitted(camera: Camera, width: int) -> Camera:
    """The camera, smaller where its images are wider than `width` pixels."""
    return camera.scaled(min(1.0, width / camera.width))


def grouped(settings: Sequence[Setting], most: int) -> Iterator[list[Setting]]:
    """The settings but for the reference, at most `most` at a time."""
    others = [setting for setting in settings if not setting.is_reference]
    for start in range(0, max(len(others), 1), most):
        yield others[start : start + most]


def knob_order() -> dict[str, int]:
    return {path: number for number, path in enumerate([*(k.path for k in KNOBS), WHOLE])}


def _axis(camera: Camera) -> np.ndarray:
    return camera.camera_from_world.numpy()[2, :3]
