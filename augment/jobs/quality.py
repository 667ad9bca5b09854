"""Lets a recipe's quality choose its settings in view of a scene."""

from __future__ import annotations

import copy
import hashlib
import json
import logging
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np
from tqdm import tqdm

import augment
from augment.cameras import Camera, Frame
from augment.effects import Sharing, share_effects
from augment.errors import SceneError
from augment.jobs.claims import try_claim
from augment.jobs.files import trajectory_id
from augment.jobs.layout import STATE_FOLDER, reading_back
from augment.jobs.store import Store, StoredFileMissing
from augment.jobs.worker import Renderer, default_renderer
from augment.memo import memo_of
from augment.metrics.image import flip
from augment.scene import Scene
from recipes.schema import KNOBS, Recipe, Value, free_knobs, with_settings

# ---- One picture for the sake of its time and its errors, at the size of its reference -----------


@dataclass(frozen=True, eq=False)
class Trial:
    """A rendered view, at the size of the reference however small it was rendered. picture: uint8
    [H, W, 3], display-encoded. depth: float32 [H, W], metres, 0 = none; None where the recipe
    writes none. seconds: of rendering alone, without the enlarging.
    """

    picture: np.ndarray
    depth: np.ndarray | None
    seconds: float


def render_trial(
    scene: Scene,
    camera: Camera,
    recipe: Recipe,
    backend: str = "auto",
    *,
    size: tuple[int, int] | None = None,
    renderer: Renderer | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> Trial:
    """The view of `camera` (before recipe.render.scale) under the recipe, in 8 bits as in files.
    size: width and height of the reference, pixels; None for the camera's own. The first picture of
    a scene in some snow or style also takes the time of placing the snow and fitting the colours.
    Raises SceneError: the scene cannot be rendered so. RecipeError: the recipe is not resolved.
    """
    started = clock()
    view = (renderer or default_renderer())(scene, camera, recipe, backend=backend)
    seconds = clock() - started
    width, height = size or (camera.width, camera.height)
    depth = view.depth_m
    if depth is not None and depth.shape != (height, width):
        # Nearest: a mean of near and far would be a surface that is in neither.
        depth = cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
    return Trial(upsampled(view.rgb, width, height), depth, seconds)


def upsampled(picture: np.ndarray, width: int, height: int) -> np.ndarray:
    """The picture [H, W, 3] at another size, in its own type, as a viewer would show it. Bilinear
    where it grows, means over areas where it shrinks, else the same array.
    """
    if picture.shape[:2] == (height, width):
        return picture
    shrinks = picture.shape[0] > height or picture.shape[1] > width
    how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return cv2.resize(picture, (width, height), interpolation=how)


class View(NamedTuple):
    """An image that is rendered to find out what settings cost. frame: its number."""

    frame: int
    name: str
    camera: Camera


def calibration_views(frames: Sequence[Frame], count: int = 3) -> tuple[View, ...]:
    """Images spread over the frames and over each frame's cameras; at most `count`, at least one.
    frames: all that the scene or the camera path has, never a selection, so that what is rendered
    beside an image does not change it.
    """
    pictured = sorted((f for f in frames if f.cameras), key=lambda frame: frame.index)
    if not pictured:
        raise ValueError(f"none of the {len(frames)} frames has a camera")
    views: dict[tuple[int, str], View] = {}
    for number in range(count):
        frame = pictured[(2 * number + 1) * len(pictured) // (2 * count)]
        names = sorted(frame.cameras)
        name = names[number * len(names) // count]
        views.setdefault((frame.index, name), View(frame.index, name, frame.cameras[name]))
    return tuple(views.values())


# ---- Renders a recipe's settings in a few views: how long they take, and how far off they are ----

WINDOW = 96  # pixels; FLIP's filters reach about ten
WINDOWS = 4  # across and down
DOUBT = 1.25  # how far beyond the bound an estimate must be to stand for the whole picture


class Bench:
    """Tries settings of a recipe on a scene. recipe: its knobs at reference. cameras: those that
    snow is placed and style maps are fitted for; the scene's own if None. each: called before every
    picture. Errors of single knobs are estimated from windows of the picture where that is much
    larger: FLIP takes longer than rendering. `flip` and, near the bound, `exceeds` look at all of
    it.
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
        each: Callable[[], object] = lambda: None,
    ) -> None:
        self._recipe, self._views, self._backend = recipe, tuple(views), backend
        # An object of its own, which takes along what is found of settings that are not chosen.
        self._scene, self._cameras = copy.copy(scene), cameras
        self._renderer, self._clock, self._each = renderer, clock, each
        self._estimates: dict[tuple, float] = {}
        self._errors: dict[tuple, tuple[float, ...]] = {}
        self._ms: dict[tuple, float] = {}
        self._truth = [self._picture(view, {}) for view in self._views]

    def estimate(self, settings: Mapping[str, Value], enough: float = 1.0) -> float:
        """Mean FLIP in the worst view, from windows of it; of errors beyond `enough` a part."""
        key = _key(settings)
        if key not in self._estimates:
            worst = 0.0
            for view, truth in zip(self._views, self._truth, strict=True):
                worst = max(worst, _windows_flip(self._picture(view, settings), truth))
                if worst > enough:
                    break
            self._estimates[key] = worst
        return self._estimates[key]

    def exceeds(self, settings: Mapping[str, Value], bound: float) -> bool:
        """Whether the error in some view is beyond the bound."""
        errors = []
        for view, truth in zip(self._views, self._truth, strict=True):
            picture = self._picture(view, settings)
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
            self._errors[key] = tuple(_flip(self._picture(v, settings), t) for v, t in pairs)
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
        """Let the scene know what images of these settings share, if that was found here."""
        if self._cameras is None and self._renderer is None:
            recipe = with_settings(self._recipe, settings)
            share_effects(Sharing(self._scene, [recipe], backend=self._backend))
            memo_of(scene).update(memo_of(self._scene).shared())

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
        """Find for a camera path what pictures would otherwise find for the scene's own cameras."""
        if self._cameras is None or self._renderer is not None:
            return
        share_effects(Sharing(self._scene, [recipe], self._cameras, backend=self._backend))


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


# ---- From what the values of each knob cost and save to a setting of all of them -----------------

Settings = dict[str, Value]
# The values to choose from by the knobs' paths: from the fastest to the reference.
Options = Mapping[str, Sequence[Value]]
MIN_SAVED = 0.02  # of the reference's time: less is noise of a few pictures


@dataclass(frozen=True)
class Cost:
    """One knob at one value, all others at reference. ms: of a frame. flip: against reference."""

    value: Value
    ms: float
    flip: float


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
    against reference in the worst of the views. views: frame numbers and cameras. The same for the
    same scene, recipe and backend on every machine, where the recipe gives max_flip. Not so ms, the
    settings' frame time, and reference_ms, which only a recipe with budget_ms has; and seconds,
    what choosing took.
    """

    settings: Settings
    is_met: bool = True
    flip: float = 0.0
    views: tuple[tuple[int, str], ...] = ()
    measured: tuple[Measured, ...] = ()
    ms: float | None = None
    reference_ms: float | None = None
    seconds: float = 0.0


def reference_settings(options: Options) -> Settings:
    return {path: values[-1] for path, values in options.items()}


def within_flip(
    options: Options,
    bound: float,
    own_flip: Callable[[str, Value], float],
    exceeds: Callable[[Settings], bool],
) -> Settings:
    """Fast settings whose pictures together are within the bound. Knob after knob, in the order of
    `options`, takes the fastest value with which all that are chosen so far stay within the bound,
    the rest at reference. own_flip: error of one knob at one value, all others at reference; of a
    value beyond the bound any number beyond it. exceeds: whether settings together are beyond the
    bound; not asked of the reference.
    """
    settings = reference_settings(options)
    for path, values in options.items():
        for value in values[:-1]:
            tried = settings | {path: value}
            if own_flip(path, value) <= bound and not exceeds(tried):
                settings = tried
                break
    return settings


def within_budget(
    options: Options,
    budget_ms: float,
    costs: Mapping[str, Sequence[Cost]],
    ms_of: Callable[[Settings], float],
) -> Report:
    """Accurate settings whose frames take no longer than the budget. From reference on, the knob
    goes a step on that saves the most time for the error that it adds, by what each costs alone,
    and the time of all together is measured again, until it is within the budget or no step is left
    that saves anything. costs: of every value of every knob, its reference included.
    """
    ladders = {path: useful(costs[path]) for path in options}
    places = dict.fromkeys(options, 0)
    while True:
        settings = {path: ladder[places[path]].value for path, ladder in ladders.items()}
        ms = ms_of(settings)
        if ms <= budget_ms:
            return _given_back(ladders, places, budget_ms, ms, ms_of)
        left = [path for path, ladder in ladders.items() if places[path] < len(ladder) - 1]
        if not left:
            return Report(settings, is_met=False, ms=ms)
        best = max(left, key=lambda path: _worth(ladders[path][places[path] :]))
        places[best] += 1


def _given_back(
    ladders: Mapping[str, Sequence[Cost]],
    places: dict[str, int],
    budget_ms: float,
    ms: float,
    ms_of: Callable[[Settings], float],
) -> Report:
    """Settings within a budget, each knob as close to reference as the others leave time for."""

    def settings() -> Settings:
        return {path: ladder[places[path]].value for path, ladder in ladders.items()}

    def error(path: str) -> float:
        return ladders[path][places[path]].flip

    for path in sorted(ladders, key=error, reverse=True):
        while places[path] > 0:
            places[path] -= 1
            tried_ms = ms_of(settings())
            if tried_ms > budget_ms:
                places[path] += 1
                break
            ms = tried_ms
    return Report(settings(), ms=ms)


def useful(costs: Sequence[Cost]) -> list[Cost]:
    """Of a knob's values, from the fastest to reference, those worth a step: from reference on,
    each faster than all that are as accurate or more so.
    """
    reference = costs[-1]
    min_ms = MIN_SAVED * reference.ms
    kept = [reference]
    # Of values with equal errors the fastest comes first, and the others save nothing then.
    for cost in sorted(costs[:-1], key=lambda cost: (cost.flip, cost.ms)):
        if kept[-1].ms - cost.ms > min_ms:
            kept.append(cost)
    return kept


def _worth(ladder: Sequence[Cost]) -> tuple[float, float]:
    """Time saved for the error added, then time saved, of the best of the steps down a ladder.
    Where a step is poor and the one behind it good, it is the way there.
    """
    before, *after = ladder
    saved = [(before.ms - cost.ms, cost.flip - before.flip) for cost in after]
    return max((ms / error if error > 0 else math.inf, ms) for ms, error in saved)


# ---- The choice ----------------------------------------------------------------------------------

_CELL = "weather.snow.cell_m"  # the one knob whose finest value a scene may be too large for
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Resolved:
    """recipe: with its settings in numbers. report: None where nothing had to be chosen."""

    recipe: Recipe
    report: Report | None = None


def resolve_quality(
    recipe: Recipe,
    scene: Scene,
    *,
    views: Sequence[View] | None = None,
    cameras: Sequence[Camera] | None = None,
    backend: str = "auto",
    renderer: Renderer | None = None,
    clock: Callable[[], float] = time.perf_counter,
    progress: bool = False,
) -> Resolved:
    """The recipe with the settings that its max_flip or budget_ms chooses in this scene. With
    max_flip the choice is the same every time; with budget_ms it is this machine's. A budget that
    cannot be kept is logged as a warning, and the fastest settings are taken. views: what is
    rendered to find out, `calibration_views` of the scene's frames if None. cameras: all of a
    camera path, where one is to be rendered; None for the scene's. renderer:
    `augment.views.render_view` if None. clock: in seconds. progress: a bar on stderr. Raises
    SceneError: the scene cannot be rendered under the recipe.
    """
    if not recipe.quality.is_open:
        return Resolved(recipe)
    started = time.perf_counter()
    views = calibration_views(scene.frames) if views is None else tuple(views)
    bar = tqdm(unit="picture", desc=f"choosing settings of {recipe.name}", disable=not progress)
    with bar:
        options = _options(recipe)
        bench_of = partial(
            Bench,
            scene=scene,
            views=views,
            backend=backend,
            cameras=cameras,
            renderer=renderer,
            clock=clock,
            each=bar.update,
        )
        bench = _started(recipe, options, bench_of)
        if recipe.quality.max_flip is not None:
            chosen = _for_flip(bench, options, recipe.quality.max_flip)
        else:
            assert recipe.quality.budget_ms is not None
            chosen = _for_budget(bench, options, recipe.quality.budget_ms)
        flip = max(bench.flip(chosen.settings))
    bench.hand_over(chosen.settings, scene)
    shown = tuple((view.frame, view.name) for view in views)
    seconds = time.perf_counter() - started
    if not chosen.is_met:
        _log.warning(
            "recipe %s, scene %s: its frames take %.0f ms with the fastest settings, more than "
            "quality.budget_ms %g; give a larger budget, or fields that save more",
            recipe.name,
            scene.name,
            chosen.ms,
            recipe.quality.budget_ms,
        )
    report = replace(chosen, flip=flip, views=shown, seconds=seconds)
    return Resolved(resolved_recipe(recipe, chosen.settings), report)


def resolved_recipe(recipe: Recipe, settings: Settings) -> Recipe:
    """The recipe with a choice made for it. Raises ValueError: these are not settings for the
    recipe's free knobs.
    """
    free = {knob.path for knob in free_knobs(recipe)}
    if settings.keys() != free:
        raise ValueError(
            f"the settings are of {', '.join(sorted(settings)) or 'no knob'}; the recipe leaves "
            f"free {', '.join(sorted(free)) or 'none'}"
        )
    return with_settings(recipe, {**settings, "quality.settled": True})


def recipes_to_try(recipe: Recipe) -> list[Recipe]:
    """The recipe with each knob at each value that may be tried alone; to compile kernels for.
    The recipe itself where there is nothing to choose.
    """
    if not recipe.quality.is_open:
        return [recipe]
    options = _options(recipe)
    resolved = resolved_recipe(recipe, reference_settings(options))
    tried = [resolved]
    for path, values in options.items():
        tried += [with_settings(resolved, {path: value}) for value in values[:-1]]
    return tried


def _started(
    recipe: Recipe, options: dict[str, tuple[Value, ...]], bench_of: Callable[[Recipe], Bench]
) -> Bench:
    """A bench with the reference rendered; takes what the scene cannot have out of `options`."""
    while True:
        try:
            return bench_of(resolved_recipe(recipe, reference_settings(options)))
        except SceneError:
            if len(options.get(_CELL, ())) < 2:
                raise
            options[_CELL] = options[_CELL][:-1]


def _for_flip(bench: Bench, options: Options, bound: float) -> Report:
    measured: dict[tuple[str, Value], Measured] = {}

    def own_flip(path: str, value: Value) -> float:
        error = bench.estimate({path: value}, enough=bound)
        measured[path, value] = Measured(path, value, error, None)
        return error

    settings = within_flip(options, bound, own_flip, lambda s: bench.exceeds(s, bound))
    return Report(settings, measured=tuple(measured.values()))


def _for_budget(bench: Bench, options: Options, budget_ms: float) -> Report:
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
    return replace(found, measured=tuple(measured), reference_ms=reference_ms)


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
        return with_settings(recipe, {path: value}) is not None
    except ValueError:
        return False


# ---- A choice of settings, made once for an output and kept in it --------------------------------
# `.climategs/quality/<digest>.json` is found again by what was asked. Whoever goes on with the
# output, on whatever machine, takes the settings from there: with a budget of time they would else
# differ from one machine to the next, and the images with them.

FOLDER = f"{STATE_FOLDER}/quality"
_FORMAT = 1
_MAX_WAIT_S = 1.0  # between looks at what another process is choosing


@dataclass(frozen=True)
class Question:
    """What a choice is made for. recipe: not resolved. scene, source: its name and origin.
    trajectory: of the camera path, as in the manifest.
    """

    recipe: Recipe
    scene: str
    source: str
    trajectory: str
    backend: str

    def facts(self) -> dict[str, Any]:
        """All that decides which choice is meant; what a recipe leaves free is not in its hash."""
        return {
            "recipe": json.loads(self.recipe.canonical_json()),
            "free": sorted(knob.path for knob in free_knobs(self.recipe)),
            "scene": self.scene,
            "source": self.source,
            "trajectory": self.trajectory,
            "version": augment.__version__,
            "backend": self.backend,
        }

    @property
    def digest(self) -> str:
        text = json.dumps(self.facts(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:20]

    @property
    def path(self) -> str:
        return f"{FOLDER}/{self.digest}.json"


def resolve_quality_for(
    store: Store,
    recipe: Recipe,
    scene: Scene,
    *,
    backend: str,
    camera_path: Sequence[Frame] | None = None,
    renderer: Renderer | None = None,
    anew: bool = False,
    keep: bool = True,
    progress: bool = False,
) -> Recipe:
    """The recipe with the settings that the output has for it in this scene, or that are chosen
    now; the same recipe where its quality has nothing to choose. camera_path: frames that are
    rendered in place of the scene's own. anew: as in `resolve_quality_once`. keep: whether a new
    choice is kept in the output. The others and errors: as of `resolve_quality`.
    """
    if not recipe.quality.is_open:
        return recipe
    question = Question(recipe, scene.name, scene.source, trajectory_id(camera_path), backend)
    frames, cameras = scene.frames, None
    if camera_path is not None:
        frames = camera_path
        cameras = [camera for frame in camera_path for camera in frame.cameras.values()]

    def choose() -> Resolved:
        return resolve_quality(
            recipe,
            scene,
            views=calibration_views(frames),
            cameras=cameras,
            backend=backend,
            renderer=renderer,
            progress=progress,
        )

    if keep:
        return resolve_quality_once(store, question, choose, anew=anew)
    return recorded(store, question) or choose().recipe


def recorded(store: Store, question: Question) -> Recipe | None:
    """The recipe resolved as the output has it; None where nothing was chosen yet."""
    try:
        data = store.read(question.path)
    except StoredFileMissing:
        return None
    what = f"the settings chosen for recipe {question.recipe.name} in scene {question.scene}"
    with reading_back(
        f"{store.uri}/{question.path}, {what},",
        "Delete it, and they are chosen anew; images of other settings then have to be overwritten",
    ):
        document = json.loads(data)
        if document["format"] != _FORMAT:
            raise ValueError(f"its format is {document['format']!r}, not {_FORMAT}")
        if document["asked"] != question.facts():
            raise ValueError("it answers another question than its name says")
        settings = document["choice"]["settings"]
        if not isinstance(settings, dict):
            raise TypeError(f"its settings are {settings!r}")
        _check_values(settings)
        return resolved_recipe(question.recipe, settings)


def resolve_quality_once(
    store: Store, question: Question, choose: Callable[[], Resolved], *, anew: bool = False
) -> Recipe:
    """The recipe resolved as the output has it; where it has nothing, `choose` chooses, and the
    choice is kept before anyone sees it. Waits for another process that is choosing. anew: choose
    whatever there is, and keep that in its place.
    """
    found = None if anew else recorded(store, question)
    if found is not None:
        return found
    wait_s = 0.05
    while (claim := try_claim(store, f"quality.{question.digest}")) is None:  # another one chooses
        time.sleep(wait_s)
        wait_s = min(2 * wait_s, _MAX_WAIT_S)
    with claim:
        found = None if anew else recorded(store, question)
        if found is None:
            resolved = choose()
            assert resolved.report is not None, "the recipe had nothing to choose"
            found = resolved.recipe
            claim.check()
            store.write(question.path, _to_json(question, resolved.report))
    return found


def _check_values(settings: dict[str, Any]) -> None:
    for path, value in settings.items():
        knob = KNOBS.get(path)
        if knob is None or not any(value == v and type(value) is type(v) for v in knob.values):
            raise ValueError(f"{path} = {value!r} is none of the values to choose from")


def _to_json(question: Question, report: Report) -> bytes:
    measured = [asdict(m) for m in report.measured]
    times = [{"path": m["path"], "value": m["value"], "ms": m.pop("ms")} for m in measured]
    document = {
        "format": _FORMAT,
        "asked": question.facts(),
        "choice": {
            "settings": report.settings,
            "is_met": report.is_met,
            "flip": report.flip,
            "views": report.views,
            "measured": measured,
        },
        "this_machine": {
            "ms": report.ms,
            "reference_ms": report.reference_ms,
            "seconds": round(report.seconds, 3),
            "measured": [t for t in times if t["ms"] is not None],
        },
    }
    return json.dumps(document, indent=1).encode()
