"""Renders a recipe's settings in a few views: how long they take, and how far off they are."""

from __future__ import annotations

import copy
import statistics
import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from augment.batch.runner import Renderer
from augment.batch.snow_beds import snow_to_lay
from augment.batch.style_maps import style_to_apply
from augment.cameras import Camera
from augment.metrics.image import flip
from augment.quality.trial import Trial, render_trial
from augment.quality.views import View
from augment.scene import Scene
from recipes.knobs import Value, with_settings
from recipes.schema import Recipe

WINDOW = 96  # pixels; FLIP's filters reach about ten
WINDOWS = 4  # across and down
DOUBT = 1.25  # how far beyond the bound an estimate must be to stand for the whole picture


class Bench:
    """Tries settings of a recipe on a scene.

    recipe: its knobs at reference. scene, cameras: where snow can lie and what a style maps is
    found for these cameras, the scene's own if None. clock: in seconds. each: is told before every
    picture.

    Errors of single knobs are estimated from windows of the picture where that is much larger:
    FLIP takes longer than rendering. `flip` and, near the bound, `exceeds` look at all of it.
    """

    def __init__(
        self,
        recipe: Recipe,
        scene: Scene,
        views: Sequence[View],
        *,
        backend: str,
        cameras: Sequence[Camera] | None = None,
        renderer: Renderer | None = None,
        clock: Callable[[], float] = time.perf_counter,
        each: Callable[[], None] = lambda: None,
    ) -> None:
        self._recipe, self._views, self._backend = recipe, tuple(views), backend
        # An object of its own, which takes along what is found of settings that are not chosen.
        self._scene, self._cameras = copy.copy(scene), cameras
        self._renderer, self._clock, self._each = renderer, clock, each
        self._truth: list[np.ndarray] = []
        self._estimates: dict[tuple, float] = {}
        self._errors: dict[tuple, tuple[float, ...]] = {}
        self._ms: dict[tuple, float] = {}

    def start(self) -> None:
        """Render the reference.

        Raises:
            SceneError: the scene cannot be rendered so.
        """
        self._truth = [self._picture(view, {}) for view in self._views]

    def estimate(self, settings: Mapping[str, Value], enough: float = 1.0) -> float:
        """Mean FLIP in the worst view, from windows of it; of errors beyond `enough` a part."""
        key = _key(settings)
        if key not in self._estimates:
            worst = 0.0
            for number, view in enumerate(self._views):
                picture = self._picture(view, settings)
                worst = max(worst, _windows_flip(picture, self._truth[number]))
                if worst > enough:
                    break
            self._estimates[key] = worst
        return self._estimates[key]

    def exceeds(self, settings: Mapping[str, Value], bound: float) -> bool:
        """Whether the error in some view is beyond the bound."""
        errors = []
        for number, view in enumerate(self._views):
            picture, truth = self._picture(view, settings), self._truth[number]
            if _windows_flip(picture, truth) > DOUBT * bound:
                return True
            errors.append(_flip(picture, truth))
            if errors[-1] > bound:
                return True
        self._errors[_key(settings)] = tuple(errors)
        return False

    def flip(self, settings: Mapping[str, Value]) -> tuple[float, ...]:
        """Mean FLIP of each view."""
        key = _key(settings)
        if key not in self._errors:
            pairs = zip(self._views, self._truth, strict=True)
            errors = (_flip(self._picture(view, settings), truth) for view, truth in pairs)
            self._errors[key] = tuple(errors)
        return self._errors[key]

    def ms(self, settings: Mapping[str, Value]) -> float:
        """Median of the views' frame times, milliseconds, after a first picture that counts not."""
        key = _key(settings)
        if key not in self._ms:
            self._picture(self._views[0], settings)
            trials = [self._trial(view, settings) for view in self._views]
            self._ms[key] = 1000 * statistics.median(trial.seconds for trial in trials)
            pairs = zip(trials, self._truth, strict=True)
            self._estimates[key] = max(_windows_flip(t.picture, truth) for t, truth in pairs)
        return self._ms[key]

    def hand_over(self, settings: Mapping[str, Value], scene: Scene) -> None:
        """Let the scene know where snow of these settings can lie, if that was found here."""
        snow = snow_to_lay(with_settings(self._recipe, settings))
        if snow is not None and self._cameras is None:
            from augment.batch.snow_beds import find_bed, remember

            remember(scene, snow, find_bed(self._scene, snow, backend=self._backend))

    def _picture(self, view: View, settings: Mapping[str, Value]) -> np.ndarray:
        return self._trial(view, settings).picture

    def _trial(self, view: View, settings: Mapping[str, Value]) -> Trial:
        recipe = with_settings(self._recipe, settings)
        self._prepare(recipe)
        self._each()
        reference = view.camera.scaled(self._recipe.render.scale)
        return render_trial(
            self._scene,
            view.camera,
            recipe,
            self._backend,
            size=(reference.width, reference.height),
            renderer=self._renderer,
            clock=self._clock,
        )

    def _prepare(self, recipe: Recipe) -> None:
        """Find for a camera path what pictures would else find for the scene's own cameras."""
        if self._cameras is None or self._renderer is not None:
            return
        snow, style = snow_to_lay(recipe), style_to_apply(recipe)
        if snow is not None:
            from augment.snow.beds import bed_of
            from augment.snow.covers import placement_settings

            settings = placement_settings(snow)
            bed_of(self._scene, settings, cameras=self._cameras, backend=self._backend)
        if style is not None:
            from augment.style.scene_maps import remember_maps, style_maps

            remember_maps(self._scene, style, style_maps(self._scene, style, cameras=self._cameras))


def _key(settings: Mapping[str, Value]) -> tuple:
    return tuple(sorted(settings.items()))


def _flip(picture: np.ndarray, truth: np.ndarray) -> float:
    return 0.0 if np.array_equal(picture, truth) else flip(picture, truth)


def _windows_flip(picture: np.ndarray, truth: np.ndarray) -> float:
    """FLIP of a grid of windows, or of a picture that is not much larger."""
    height, width = truth.shape[:2]
    if height * width <= 2 * (WINDOWS * WINDOW) ** 2 or min(height, width) < WINDOW:
        return _flip(picture, truth)
    total = 0.0
    for y in _starts(height):
        for x in _starts(width):
            at = np.s_[y : y + WINDOW, x : x + WINDOW]
            total += _flip(picture[at], truth[at])
    return total / WINDOWS**2


def _starts(length: int) -> list[int]:
    """Where windows begin that lie evenly along a side; they may overlap on a short one."""
    cell = length / WINDOWS
    centres = [(number + 0.5) * cell for number in range(WINDOWS)]
    return [min(max(0, int(c - WINDOW / 2)), length - WINDOW) for c in centres]
