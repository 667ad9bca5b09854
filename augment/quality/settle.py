"""Lets a recipe's quality choose its settings in view of a scene."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from tqdm import tqdm

from augment.batch.runner import Renderer
from augment.cameras import Camera
from augment.errors import SceneError
from augment.quality.bench import Bench
from augment.quality.choose import (
    Cost,
    Options,
    Settings,
    reference_settings,
    within_budget,
    within_flip,
)
from augment.quality.views import View, calibration_views
from augment.scene import Scene
from recipes.knobs import Value, free_knobs, with_settings
from recipes.schema import Recipe

_CELL = "weather.snow.cell_m"  # the one knob whose finest value a scene may be too large for
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Measured:
    """One knob at one value, all others at reference. flip: mean FLIP against reference in the
    worst view, as estimated. ms: of a frame; None where the choice does not depend on it.
    """

    path: str
    value: Value
    flip: float
    ms: float | None


@dataclass(frozen=True)
class Report:
    """settings: what was chosen, of the knobs that the recipe leaves free. is_met: whether they
    keep what the recipe asks for; an error can always be kept, a budget cannot. flip: mean FLIP
    against reference in the worst of the views. views: frame numbers and cameras.

    The same for the same scene, recipe and backend on every machine, where the recipe gives
    max_flip. Not so the rest: ms, the settings' frame time; reference_ms; seconds, what choosing
    took. Only a recipe with budget_ms has the first two.
    """

    settings: Settings
    is_met: bool
    flip: float
    views: tuple[tuple[int, str], ...]
    measured: tuple[Measured, ...]
    ms: float | None = None
    reference_ms: float | None = None
    seconds: float = 0.0


@dataclass(frozen=True)
class Settled:
    """recipe: with its settings in numbers. report: None where nothing had to be chosen."""

    recipe: Recipe
    report: Report | None = None


def settle(
    recipe: Recipe,
    scene: Scene,
    *,
    views: Sequence[View] | None = None,
    cameras: Sequence[Camera] | None = None,
    backend: str = "auto",
    renderer: Renderer | None = None,
    clock: Callable[[], float] = time.perf_counter,
    progress: bool = False,
) -> Settled:
    """The recipe with the settings that its max_flip or budget_ms chooses in this scene.

    views: what is rendered to find out, `calibration_views` of the scene's frames if None. cameras:
    all of a camera path, where one is to be rendered; None for the scene's. renderer:
    `augment.apply.render_view` if None. clock: in seconds. progress: a bar on stderr.

    With max_flip the choice is the same every time; with budget_ms it is this machine's. A budget
    that cannot be kept is logged as a warning, and the fastest settings are taken.

    Raises:
        SceneError: the scene cannot be rendered under the recipe.
    """
    if not recipe.quality.is_open:
        return Settled(recipe)
    started = time.perf_counter()
    views = calibration_views(scene.frames) if views is None else tuple(views)
    bar = tqdm(unit="picture", desc=f"choosing settings of {recipe.name}", disable=not progress)
    with bar:

        def each() -> None:
            bar.update()

        def bench_of(reference: Recipe) -> Bench:
            return Bench(
                reference,
                scene,
                views,
                backend=backend,
                cameras=cameras,
                renderer=renderer,
                clock=clock,
                each=each,
            )

        chosen = _chosen(recipe, bench_of)
    chosen.bench.hand_over(chosen.settings, scene)
    report = Report(
        settings=chosen.settings,
        is_met=chosen.is_met,
        flip=max(chosen.flips),
        views=tuple((view.frame, view.name) for view in views),
        measured=tuple(chosen.measured),
        ms=chosen.ms,
        reference_ms=chosen.reference_ms,
        seconds=time.perf_counter() - started,
    )
    if not chosen.is_met:
        _log.warning(
            "recipe %s, scene %s: its frames take %.0f ms with the fastest settings, more than "
            "quality.budget_ms %g; give a larger budget, or fields that save more",
            recipe.name,
            scene.name,
            chosen.ms,
            recipe.quality.budget_ms,
        )
    return Settled(settled_recipe(recipe, chosen.settings), report)


def settled_recipe(recipe: Recipe, settings: Settings) -> Recipe:
    """The recipe with a choice made for it.

    Raises:
        ValueError: these are not settings for the recipe's free knobs.
    """
    free = {knob.path for knob in free_knobs(recipe)}
    if settings.keys() != free:
        raise ValueError(
            f"the settings are of {', '.join(sorted(settings)) or 'no knob'}; the recipe leaves "
            f"free {', '.join(sorted(free)) or 'none'}"
        )
    return with_settings(recipe, {**settings, "quality.settled": True})


def recipes_to_try(recipe: Recipe) -> list[Recipe]:
    """The recipe with each knob at each value that `settle` may try alone; to compile kernels for.

    The recipe itself where there is nothing to choose.
    """
    if not recipe.quality.is_open:
        return [recipe]
    options = _options(recipe)
    settled = settled_recipe(recipe, reference_settings(options))
    tried = [settled]
    for path, values in options.items():
        tried += [with_settings(settled, {path: value}) for value in values[:-1]]
    return tried


@dataclass
class _Chosen:
    bench: Bench
    settings: Settings
    is_met: bool = True
    flips: tuple[float, ...] = ()
    measured: list[Measured] = field(default_factory=list)
    ms: float | None = None
    reference_ms: float | None = None


def _chosen(recipe: Recipe, bench_of: Callable[[Recipe], Bench]) -> _Chosen:
    options = _options(recipe)
    bench = _started(recipe, options, bench_of)
    if recipe.quality.max_flip is not None:
        chosen = _for_flip(bench, options, recipe.quality.max_flip)
    else:
        assert recipe.quality.budget_ms is not None
        chosen = _for_budget(bench, options, recipe.quality.budget_ms)
    chosen.flips = bench.flip(chosen.settings)
    return chosen


def _started(
    recipe: Recipe, options: dict[str, tuple[Value, ...]], bench_of: Callable[[Recipe], Bench]
) -> Bench:
    """A bench that has rendered the reference; leaves out of `options` what the scene cannot have.

    Raises:
        SceneError: the scene cannot be rendered, whatever the settings.
    """
    while True:
        bench = bench_of(settled_recipe(recipe, reference_settings(options)))
        try:
            bench.start()
            return bench
        except SceneError:
            if len(options.get(_CELL, ())) < 2:
                raise
            options[_CELL] = options[_CELL][:-1]


def _for_flip(bench: Bench, options: Options, bound: float) -> _Chosen:
    measured: dict[tuple[str, Value], Measured] = {}

    def own_flip(path: str, value: Value) -> float:
        error = bench.estimate({path: value}, enough=bound)
        measured[path, value] = Measured(path, value, error, None)
        return error

    settings = within_flip(options, bound, own_flip, lambda s: bench.exceeds(s, bound))
    return _Chosen(bench, settings, measured=list(measured.values()))


def _for_budget(bench: Bench, options: Options, budget_ms: float) -> _Chosen:
    reference_ms = bench.ms({})
    costs: dict[str, list[Cost]] = {path: [] for path in options}
    measured = []
    if reference_ms > budget_ms:  # else nothing has to be given up
        for path, values in options.items():
            for value in values[:-1]:
                ms, error = bench.ms({path: value}), bench.estimate({path: value})
                costs[path].append(Cost(value, ms, error))
                measured.append(Measured(path, value, error, ms))
    for path, values in options.items():
        costs[path].append(Cost(values[-1], reference_ms, 0.0))
    reference = reference_settings(options)

    def ms_of(settings: Settings) -> float:
        return bench.ms({p: value for p, value in settings.items() if value != reference[p]})

    found = within_budget(options, budget_ms, costs, ms_of)
    return _Chosen(
        bench,
        found.settings,
        found.is_met,
        measured=measured,
        ms=found.ms,
        reference_ms=reference_ms,
    )


def _options(recipe: Recipe) -> dict[str, tuple[Value, ...]]:
    """The values of its free knobs that the recipe's rules allow, reference always."""
    knobs = free_knobs(recipe)
    reference = with_settings(recipe, {knob.path: knob.reference for knob in knobs})
    return {
        knob.path: tuple(value for value in knob.values if _is_allowed(reference, knob.path, value))
        for knob in knobs
    }


def _is_allowed(recipe: Recipe, path: str, value: Value) -> bool:
    try:
        with_settings(recipe, {path: value})
    except ValueError:
        return False
    return True
