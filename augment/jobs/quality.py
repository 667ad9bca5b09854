"""Lets a recipe's quality choose its settings in view of a scene."""

from __future__ import annotations

import copy
import hashlib
import json
import logging
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from time import perf_counter
from typing import Any, NamedTuple

import cv2
import numpy as np

import augment
from augment.cameras import Camera, Frame
from augment.effects import Sharing, share_effects
from augment.errors import SceneError
from augment.jobs.claims import hold
from augment.jobs.files import trajectory_id
from augment.jobs.layout import STATE_FOLDER, reading_back
from augment.jobs.store import Store, StoredFileMissing
from augment.jobs.worker import Renderer, default_renderer
from augment.memo import memo_of
from augment.metrics.image import flip
from augment.progress import ProgressBar
from augment.scene import Scene
from recipes.fields import replaced
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
) -> Trial:
    """The view of `camera` (before recipe.render.scale) under the recipe, in 8 bits as in files.
    size: width and height of the reference, pixels; None for the camera's own. The first picture of
    a scene in some snow or style also takes the time of placing the snow and fitting the colours.
    Raises SceneError: the scene cannot be rendered so. RecipeError: the recipe is not resolved.
    """
    started = perf_counter()
    view = (renderer or default_renderer())(scene, camera, recipe, backend=backend)
    seconds = perf_counter() - started
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


# ---- The search ----------------------------------------------------------------------------------

Settings = dict[str, Value]
# The values of every knob, by its path.
Ladders = Mapping[str, Sequence[Value]]
Step = tuple[str, Value]
MIN_SAVED = 0.02  # of the reference's time: less is noise of a few pictures


def first_settings(ladders: Ladders) -> Settings:
    """Those that a search begins with."""
    return {path: values[-1] for path, values in ladders.items()}


def search(
    ladders: Ladders, keeps: Callable[[Settings], bool], steps: Iterable[Step] | None = None
) -> Settings:
    """Settings that keep a bound of error or of time. ladders: of each knob from the value that is
    wanted most to the one to begin with; those to begin with, all together, must keep the bound.
    steps: which knob is tried at which value, in order; if None knob after knob, each at the value
    wanted most first. A step is taken where it leads towards what is wanted and `keeps` says that
    the settings with it keep the bound.
    """
    settings = first_settings(ladders)
    if steps is None:
        steps = [(path, value) for path, values in ladders.items() for value in values[:-1]]
    for path, value in steps:
        place = ladders[path].index
        tried = settings | {path: value}
        if place(value) < place(settings[path]) and keeps(tried):
            settings = tried
    return settings


class Cost(NamedTuple):
    """One knob at one value, all others at reference. ms: of a frame. flip: against reference."""

    value: Value
    ms: float
    flip: float


def useful(costs: Sequence[Cost]) -> list[Cost]:
    """Of a knob's values, reference last, those worth a step: from reference on, each faster than
    all that are as accurate or more so.
    """
    reference = costs[-1]
    min_ms = MIN_SAVED * reference.ms
    kept = [reference]
    # Of values with equal errors the fastest comes first, and the others save nothing then.
    for cost in sorted(costs[:-1], key=lambda cost: (cost.flip, cost.ms)):
        if kept[-1].ms - cost.ms > min_ms:
            kept.append(cost)
    return kept


def steps_back(costs: Mapping[str, Sequence[Cost]]) -> tuple[Ladders, list[Step]]:
    """What to `search` a budget of time with: ladders from reference to the fastest of the useful
    values, and the steps back, first those that undo the most error: the worst shows.
    """
    ladders = {path: useful(each) for path, each in costs.items()}
    steps = {
        (path, slow.value): fast.flip - slow.flip
        for path, ladder in ladders.items()
        for slow, fast in pairwise(ladder)
    }
    values = {path: [cost.value for cost in ladder] for path, ladder in ladders.items()}
    return values, sorted(steps, key=steps.__getitem__, reverse=True)


# ---- What settings of a recipe cost in a few views of a scene ------------------------------------

_COLUMNS, _COLUMN_PX = 4, 48  # of a picture; single values' errors are estimated from them


@dataclass(eq=False)
class Bench:
    """Tries settings of a recipe's free knobs on a scene, and compares pictures with those of
    `reference`. cameras: those that snow is placed and style maps are fitted for; the scene's own
    if None. on_picture: called before every picture. Raises SceneError: the reference cannot be
    rendered.
    """

    recipe: Recipe
    scene: Scene
    views: Sequence[View]
    reference: Settings
    backend: str
    cameras: Sequence[Camera] | None
    renderer: Renderer | None
    on_picture: Callable[[], object]

    def __post_init__(self) -> None:
        self._flips: dict[tuple[bytes, ...], float] = {}
        self._ms: dict[frozenset[Step], float] = {}
        self._truth = [self._trial(view, self.reference).picture for view in self.views]

    def flip(self, settings: Settings, enough: float = 1.0) -> float:
        """Mean FLIP in the worst view; beyond `enough` in any that is."""
        worst = 0.0
        for view, truth in zip(self.views, self._truth, strict=True):
            worst = max(worst, self._flip(self._trial(view, settings).picture, truth))
            if worst > enough:
                break
        return worst

    def ms(self, settings: Settings) -> float:
        """Median of the views' frame times, milliseconds, after a first picture that counts not."""
        key = frozenset(settings.items())
        if key not in self._ms:
            self._ms[key] = _median_ms(self._timed(settings))
        return self._ms[key]

    def cost(self, path: str, value: Value) -> Cost:
        """The error is that of the worst view, from columns of it: FLIP takes longer than rendering
        does.
        """
        trials = self._timed(self.reference | {path: value})
        pairs = zip((trial.picture for trial in trials), self._truth, strict=True)
        worst = max(self._flip(_columns(picture), _columns(truth)) for picture, truth in pairs)
        return Cost(value, _median_ms(trials), worst)

    def _timed(self, settings: Settings) -> list[Trial]:
        return [self._trial(view, settings) for view in (self.views[0], *self.views)][1:]

    def _trial(self, view: View, settings: Settings) -> Trial:
        recipe = resolved_recipe(self.recipe, settings)
        recipe = replaced(recipe, "camera.noise", 0.0)  # of another size it is other noise
        if self.cameras is not None and self.renderer is None:
            # Else pictures would find it for the scene's own cameras.
            share_effects(Sharing(self.scene, [recipe], self.cameras, backend=self.backend))
        self.on_picture()
        reference = resolved_recipe(self.recipe, self.reference)
        shown = view.camera.scaled(reference.render.scale)
        given = (self.scene, view.camera, recipe, self.backend)
        return render_trial(*given, size=(shown.width, shown.height), renderer=self.renderer)

    def _flip(self, picture: np.ndarray, truth: np.ndarray) -> float:
        key = tuple(hashlib.sha256(each.tobytes()).digest() for each in (picture, truth))
        if key not in self._flips:  # many settings change nothing
            self._flips[key] = 0.0 if key[0] == key[1] else flip(picture, truth)
        return self._flips[key]


def _median_ms(trials: Sequence[Trial]) -> float:
    return 1000 * statistics.median(trial.seconds for trial in trials)


def _columns(picture: np.ndarray) -> np.ndarray:
    """A few columns of a picture side by side, evenly spread; all of a narrow one."""
    width = picture.shape[1]
    if width <= 2 * _COLUMNS * _COLUMN_PX:
        return picture
    starts = np.linspace(0, width - _COLUMN_PX, _COLUMNS).astype(int)
    return np.concatenate([picture[:, start : start + _COLUMN_PX] for start in starts], axis=1)


# ---- The choice ----------------------------------------------------------------------------------

_CELL = "weather.snow.cell_m"  # the one knob whose finest value a scene may be too large for
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Resolved:
    """recipe: with its settings in numbers; where nothing had to be chosen, the rest is empty.
    settings: what was chosen, of the knobs that the recipe leaves free. is_met: whether they keep
    what the recipe asks for; an error can always be kept, a budget cannot. flip: mean FLIP against
    reference in the worst of the views. views: frame numbers and cameras. All this is the same for
    the same scene, recipe and backend on every machine, where the recipe gives max_flip. Not so ms,
    the settings' frame time, and reference_ms, which only a recipe with budget_ms has; and seconds,
    what choosing took.
    """

    recipe: Recipe
    settings: Settings = field(default_factory=dict)
    is_met: bool = True
    flip: float = 0.0
    views: tuple[tuple[int, str], ...] = ()
    ms: float | None = None
    reference_ms: float | None = None
    seconds: float = 0.0


def resolve_quality(
    recipe: Recipe,
    scene: Scene,
    *,
    camera_path: Sequence[Frame] | None = None,
    backend: str = "auto",
    renderer: Renderer | None = None,
    progress: bool = False,
) -> Resolved:
    """The recipe with the settings that its max_flip or budget_ms chooses in this scene. With
    max_flip the choice is the same every time; with budget_ms it is this machine's. A budget that
    cannot be kept is logged as a warning, and the fastest settings are taken. camera_path: frames
    that are rendered in place of the scene's own. renderer: `augment.views.render_view` if None.
    progress: a bar on stderr. Raises SceneError: the scene cannot be rendered under the recipe.
    """
    wish = recipe.quality
    if not wish.is_open:
        return Resolved(recipe)
    started = perf_counter()
    views = calibration_views(scene.frames if camera_path is None else camera_path)
    cameras = None
    if camera_path is not None:
        cameras = [camera for frame in camera_path for camera in frame.cameras.values()]
    # An object of its own, which takes along what is found of settings that are not chosen.
    tried_on = copy.copy(scene)
    options = _options(recipe)
    bar = ProgressBar(
        unit="picture", desc=f"choosing settings of {recipe.name}", disable=not progress
    )
    with bar:
        while True:
            reference = first_settings(options)
            given = (recipe, tried_on, views, reference, backend, cameras, renderer)
            try:
                bench = Bench(*given, bar.update)
                break
            except SceneError:
                if len(options.get(_CELL, ())) < 2:
                    raise
                options[_CELL] = options[_CELL][:-1]
        ms = reference_ms = None
        if (bound := wish.max_flip) is not None:
            settings = search(options, lambda tried: bench.flip(tried, bound) <= bound)
        else:
            assert wish.budget_ms is not None
            settings = _within_budget(bench, options, wish.budget_ms)
            ms, reference_ms = bench.ms(settings), bench.ms(reference)
        worst = bench.flip(settings)
    resolved = resolved_recipe(recipe, settings)
    if cameras is None and renderer is None:  # what images of these settings share is known here
        share_effects(Sharing(tried_on, [resolved], backend=backend))
        memo_of(scene).update(memo_of(tried_on).shared())
    is_met = ms is None or ms <= (wish.budget_ms or 0)
    if not is_met:
        _log.warning(
            "recipe %s, scene %s: its frames take %.0f ms with the fastest settings, more than "
            "quality.budget_ms %g; give a larger budget, or fields that save more",
            recipe.name,
            scene.name,
            ms,
            wish.budget_ms,
        )
    shown, seconds = tuple((v.frame, v.name) for v in views), perf_counter() - started
    return Resolved(resolved, settings, is_met, worst, shown, ms, reference_ms, seconds)


def _within_budget(bench: Bench, options: Ladders, budget_ms: float) -> Settings:
    """The fastest settings where none keep it."""

    def keeps(settings: Settings) -> bool:
        return bench.ms(settings) <= budget_ms

    if keeps(bench.reference):
        return bench.reference
    reference_ms = bench.ms(bench.reference)
    ladders, steps = steps_back({
        path: [*(bench.cost(path, v) for v in values[:-1]), Cost(values[-1], reference_ms, 0.0)]
        for path, values in options.items()
    })  # fmt: skip
    fastest = first_settings(ladders)
    return search(ladders, keeps, steps) if keeps(fastest) else fastest


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
    reference = first_settings(options)
    single = [{path: value} for path, values in options.items() for value in values[:-1]]
    return [resolved_recipe(recipe, reference | changes) for changes in [{}, *single]]


def _options(recipe: Recipe) -> dict[str, tuple[Value, ...]]:
    """The values of its free knobs that the recipe's rules allow, from the fastest to reference,
    which always is one.
    """
    knobs = free_knobs(recipe)
    reference = with_settings(recipe, {knob.path: knob.reference for knob in knobs})

    def is_allowed(path: str, value: Value) -> bool:
        try:
            return with_settings(reference, {path: value}) is not None
        except ValueError:
            return False

    return {k.path: tuple(v for v in k.values if is_allowed(k.path, v)) for k in knobs}


# ---- A choice of settings, made once for an output and kept in it --------------------------------
# `.climategs/quality/<digest>.json` is found again by what was asked. Whoever goes on with the
# output, on whatever machine, takes the settings from there: with a budget of time they would else
# differ from one machine to the next, and the images with them.

FOLDER = f"{STATE_FOLDER}/quality"
_FORMAT = 1
MAX_CHOOSING_S = 7200.0  # how long to wait for what another process is choosing


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
    now; the same recipe where its quality has nothing to choose. A new choice is kept before anyone
    sees it; where another process is choosing, its choice is waited for. anew: choose whatever
    there is, and keep that in its place. keep: whether a new choice is kept. The others and errors:
    as of `resolve_quality`.
    """
    if not recipe.quality.is_open:
        return recipe
    question = Question(recipe, scene.name, scene.source, trajectory_id(camera_path), backend)

    def choose() -> Resolved:
        given = {"backend": backend, "renderer": renderer, "progress": progress}
        return resolve_quality(recipe, scene, camera_path=camera_path, **given)

    if not anew and (found := recorded(store, question)):
        return found
    if not keep:
        return choose().recipe
    name, doing = f"quality.{question.digest}", "is choosing the same settings"
    with hold(store, name, MAX_CHOOSING_S, doing) as claim:
        if not anew and (found := recorded(store, question)):
            return found
        chosen = choose()
        claim.check()
        store.write(question.path, _to_json(question, chosen))
        return chosen.recipe


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
        for path, value in settings.items():
            knob = KNOBS.get(path)
            if knob is None or not any(value == v and type(value) is type(v) for v in knob.values):
                raise ValueError(f"{path} = {value!r} is none of the values to choose from")
        return resolved_recipe(question.recipe, settings)


def _to_json(question: Question, chosen: Resolved) -> bytes:
    found = vars(chosen)
    document = {
        "format": _FORMAT,
        "asked": question.facts(),
        "choice": {name: found[name] for name in ("settings", "is_met", "flip", "views")},
        "this_machine": {name: found[name] for name in ("ms", "reference_ms", "seconds")},
    }
    return json.dumps(document, indent=1).encode()
