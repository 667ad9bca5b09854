"""Choice of a recipe's settings by its quality, measured on a scene.

In: a recipe whose `quality` gives a bound of error (`max_flip`) or of time (`budget_ms`), and an
open scene. Out: the recipe with settings in numbers. `render_job`, `generate` and
`augment.dataset.live` call it; jobs keep a choice in their output.
"""

from __future__ import annotations

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
from augment.effects import JobContext, precompute_effects
from augment.errors import SceneError
from augment.memo import memo_of
from augment.metrics.image import flip
from augment.output.calibration import trajectory_id
from augment.output.claims import hold_claim
from augment.output.layout import parse_errors_as_output_errors
from augment.output.names import STATE_FOLDER
from augment.output.store import Store, StoredFileMissing
from augment.progress import ProgressBar
from augment.scene.cameras import Camera, Frame
from augment.scene.scene import Scene
from augment.scene.scene_times import scene_times
from augment.view.render_view import render_view
from augment.view.results import Renderer
from recipes.fields import with_unchecked_field
from recipes.schema import KNOBS, Recipe, Value, free_knobs, with_settings
from recipes.speed import MOVED_FIELDS, former_path

# ---- One picture, to measure its time and its error at the size of its reference -----------------


@dataclass(frozen=True, eq=False)
class Trial:
    """A rendered view, enlarged or reduced to the size of the reference."""

    rgb: np.ndarray
    """Display-encoded colours, uint8 [H, W, 3]."""
    depth: np.ndarray | None
    """Depth in metres, float32 [H, W], 0 = none; None where the recipe writes none."""
    seconds: float
    """Seconds of rendering alone, without resizing."""


def render_trial(
    scene: Scene,
    camera: Camera,
    recipe: Recipe,
    backend: str = "auto",
    *,
    size: tuple[int, int] | None = None,
    renderer: Renderer | None = None,
) -> Trial:
    """Render a view under the recipe, in 8 bits as in files.

    The first picture of a scene in some snow or style also takes the time to place the snow and to
    fit the colours.

    Args:
        camera: Camera before recipe.render.scale.
        recipe: Resolved recipe.
        size: Width and height of the reference, pixels; the camera's own if None.

    Raises:
        SceneError: The scene cannot be rendered under the recipe.
        RecipeError: The recipe is not resolved.
    """
    start_s = perf_counter()
    view = (renderer or render_view)(scene, camera, recipe, backend=backend)
    seconds = perf_counter() - start_s
    width, height = size or (camera.width, camera.height)
    depth = view.depth_m
    if depth is not None and depth.shape != (height, width):
        # Nearest, because a mean of near and far would be a surface that does not exist.
        depth = cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
    return Trial(resize_picture(view.rgb, width, height), depth, seconds)


def resize_picture(picture: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return the picture [H, W, 3] at another size, in its own type, as a viewer would show it.

    It is bilinear where the picture grows, and a mean over areas where it shrinks; otherwise the
    same array.
    """
    if picture.shape[:2] == (height, width):
        return picture
    shrinks = picture.shape[0] > height or picture.shape[1] > width
    interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return cv2.resize(picture, (width, height), interpolation=interpolation)


# Largest number of views that are rendered because the weather is at an extreme then.
MAX_EXTREMES = 5


class CalibrationView(NamedTuple):
    """Image that is rendered to measure the cost of settings."""

    frame: int
    """Frame number."""
    name: str
    """Camera name."""
    camera: Camera
    """The camera."""


def calibration_views(
    frames: Sequence[Frame], count: int = 3, times_ns: Sequence[int] = ()
) -> tuple[CalibrationView, ...]:
    """Return images spread over the frames and over each frame's cameras, and some of other times.

    There are at most `count` and one for each time, and at least one.

    Args:
        frames: All frames of the scene or the camera path, never a selection, so that the choice
            does not depend on which images are rendered.
        count: Number of images spread over the frames.
        times_ns: Times at which the weather is at an extreme; the nearest frame of each counts.
    """
    frames_with_cameras = sorted((f for f in frames if f.cameras), key=lambda frame: frame.index)
    if not frames_with_cameras:
        raise ValueError(f"none of the {len(frames)} frames has a camera")
    views: dict[tuple[int, str], CalibrationView] = {}
    for number in range(count):
        frame = frames_with_cameras[(2 * number + 1) * len(frames_with_cameras) // (2 * count)]
        names = sorted(frame.cameras)
        name = names[number * len(names) // count]
        views.setdefault(
            (frame.index, name), CalibrationView(frame.index, name, frame.cameras[name])
        )
    for number, time_ns in enumerate(times_ns):
        frame = min(frames_with_cameras, key=lambda frame: abs(frame.timestamp_ns - time_ns))
        if any(index == frame.index for index, _ in views):
            continue
        name = sorted(frame.cameras)[number % len(frame.cameras)]
        views[frame.index, name] = CalibrationView(frame.index, name, frame.cameras[name])
    return tuple(views.values())


def _extreme_times_ns(recipe: Recipe, scene: Scene) -> list[int]:
    """Return some times of the drive at which a changing recipe is at its extremes."""
    if not recipe.changes_over_time:
        return []
    drive = scene_times(scene)
    clock = recipe.weather.clock
    times_s = recipe.key_times_s(drive)
    rows = np.linspace(0, len(times_s) - 1, min(len(times_s), MAX_EXTREMES)).round().astype(int)
    return [drive.start_ns + round((times_s[i] - clock.start_s) / clock.speed * 1e9) for i in rows]


# ---- The search ----------------------------------------------------------------------------------

Settings = dict[str, Value]
# Values of every knob, by its path.
Ladders = Mapping[str, Sequence[Value]]
# Path of a knob, and a value to try.
Step = tuple[str, Value]
# Least saving that counts, as a fraction of the reference's time; less is noise of a few pictures.
MIN_SAVING = 0.02


def first_settings(ladders: Ladders) -> Settings:
    """Return the settings that a search begins with."""
    return {path: values[-1] for path, values in ladders.items()}


def search_settings(
    ladders: Ladders, keeps_bound: Callable[[Settings], bool], steps: Iterable[Step] | None = None
) -> Settings:
    """Return settings that keep a bound of error or of time.

    A step is taken where it leads towards the preferred value, and where `keeps_bound` says that
    the settings with it keep the bound.

    Args:
        ladders: Values of each knob, from the preferred one to the one to begin with; the settings
            to begin with must keep the bound.
        keeps_bound: Returns True if settings keep the bound.
        steps: Knobs and values to try, in order. None: knob after knob, each at its preferred
            values first.
    """
    settings = first_settings(ladders)
    if steps is None:
        steps = [(path, value) for path, values in ladders.items() for value in values[:-1]]
    for path, value in steps:
        rank_of = ladders[path].index
        trial_settings = settings | {path: value}
        if rank_of(value) < rank_of(settings[path]) and keeps_bound(trial_settings):
            settings = trial_settings
    return settings


class Cost(NamedTuple):
    """Cost of one knob at one value, with all other knobs at reference."""

    value: Value
    """Value of the knob."""
    ms: float
    """Milliseconds of a frame."""
    flip: float
    """Mean FLIP against reference."""


def select_useful_values(costs: Sequence[Cost]) -> list[Cost]:
    """Return the values of a knob that are worth a step, from reference on.

    Args:
        costs: Costs of the knob's values, reference last.

    Returns:
        Costs, each faster than all that are as accurate or more accurate.
    """
    reference = costs[-1]
    min_ms = MIN_SAVING * reference.ms
    useful_costs = [reference]
    # Of values with equal errors the fastest comes first, so the others save nothing.
    for cost in sorted(costs[:-1], key=lambda cost: (cost.flip, cost.ms)):
        if useful_costs[-1].ms - cost.ms > min_ms:
            useful_costs.append(cost)
    return useful_costs


def steps_back(costs: Mapping[str, Sequence[Cost]]) -> tuple[Ladders, list[Step]]:
    """Return ladders and steps to search a budget of time with.

    The ladders go from reference to the fastest of the useful values. The steps go back to slower
    values, and those that undo the most error come first, because the worst error shows.
    """
    ladders = {path: select_useful_values(knob_costs) for path, knob_costs in costs.items()}
    saved_error = {
        (path, slow.value): fast.flip - slow.flip
        for path, ladder in ladders.items()
        for slow, fast in pairwise(ladder)
    }
    values_of_knob = {path: [cost.value for cost in ladder] for path, ladder in ladders.items()}
    return values_of_knob, sorted(saved_error, key=saved_error.__getitem__, reverse=True)


# ---- Cost of a recipe's settings in a few views of a scene ---------------------------------------

# Number of columns of a picture from which the errors of single values are estimated.
_NUM_COLUMNS = 4
# Width of such a column, pixels.
_COLUMN_WIDTH_PX = 48


@dataclass(eq=False)
class SettingsBench:
    """Measures settings of a recipe's free knobs on a scene, against pictures at `reference`.

    Raises:
        SceneError: The reference cannot be rendered.
    """

    recipe: Recipe
    """The recipe."""
    scene: Scene
    """Open scene."""
    views: Sequence[CalibrationView]
    """Images to render."""
    reference: Settings
    """Settings of the reference."""
    backend: str
    """Name of the rasteriser's backend."""
    cameras: Sequence[Camera] | None
    """Cameras that surfaces are found and style maps fitted for; the scene's own if None."""
    renderer: Renderer | None
    """Renderer of the images; the library's own if None."""
    on_picture: Callable[[], object]
    """Called before every picture."""

    def __post_init__(self) -> None:
        self._flips: dict[tuple[bytes, ...], float] = {}
        self._ms: dict[frozenset[Step], float] = {}
        self._reference_pictures = [self._trial(view, self.reference).rgb for view in self.views]

    def flip(self, settings: Settings, max_flip: float = 1.0) -> float:
        """Return the mean FLIP of the worst view; stops at the first view above `max_flip`."""
        worst_flip = 0.0
        for view, reference_picture in zip(self.views, self._reference_pictures, strict=True):
            worst_flip = max(
                worst_flip, self._flip(self._trial(view, settings).rgb, reference_picture)
            )
            if worst_flip > max_flip:
                break
        return worst_flip

    def ms(self, settings: Settings) -> float:
        """Return the median of the views' frame times, milliseconds.

        One picture before them does not count.
        """
        key = frozenset(settings.items())
        if key not in self._ms:
            self._ms[key] = _median_ms(self._time_views(settings))
        return self._ms[key]

    def cost(self, path: str, value: Value) -> Cost:
        """Return the cost of one knob at one value.

        The error is that of the worst view, estimated from columns of it, because FLIP takes longer
        than rendering.
        """
        trials = self._time_views(self.reference | {path: value})
        picture_pairs = zip((trial.rgb for trial in trials), self._reference_pictures, strict=True)
        worst_flip = max(
            self._flip(_cut_columns(picture), _cut_columns(reference_picture))
            for picture, reference_picture in picture_pairs
        )
        return Cost(value, _median_ms(trials), worst_flip)

    def _time_views(self, settings: Settings) -> list[Trial]:
        """Render all views, after a first picture that does not count."""
        return [self._trial(view, settings) for view in (self.views[0], *self.views)][1:]

    def _trial(self, view: CalibrationView, settings: Settings) -> Trial:
        """Render one view under the settings."""
        recipe = apply_settings(self.recipe, settings)
        recipe = with_unchecked_field(
            recipe, "camera.noise", 0.0
        )  # noise of another image size differs
        if self.cameras is not None and self.renderer is None:
            # Otherwise pictures would compute shared data for the scene's own cameras.
            precompute_effects(JobContext(self.scene, [recipe], self.cameras, backend=self.backend))
        self.on_picture()
        reference = apply_settings(self.recipe, self.reference)
        reference_camera = view.camera.scaled(reference.render.scale)
        arguments = (self.scene, view.camera, recipe, self.backend)
        return render_trial(
            *arguments,
            size=(reference_camera.width, reference_camera.height),
            renderer=self.renderer,
        )

    def _flip(self, picture: np.ndarray, reference_picture: np.ndarray) -> float:
        """Return the mean FLIP of two pictures; remembers results."""
        key = tuple(
            hashlib.sha256(image.tobytes()).digest() for image in (picture, reference_picture)
        )
        if key not in self._flips:  # many settings change nothing
            self._flips[key] = 0.0 if key[0] == key[1] else flip(picture, reference_picture)
        return self._flips[key]


def _median_ms(trials: Sequence[Trial]) -> float:
    return 1000 * statistics.median(trial.seconds for trial in trials)


def _cut_columns(picture: np.ndarray) -> np.ndarray:
    """Return a few columns of a picture side by side, evenly spread; a narrow picture as it is."""
    width = picture.shape[1]
    if width <= 2 * _NUM_COLUMNS * _COLUMN_WIDTH_PX:
        return picture
    starts = np.linspace(0, width - _COLUMN_WIDTH_PX, _NUM_COLUMNS).astype(int)
    return np.concatenate(
        [picture[:, start : start + _COLUMN_WIDTH_PX] for start in starts], axis=1
    )


# ---- The choice ----------------------------------------------------------------------------------

# Knob whose finest value may need more memory than a large scene allows.
_SNOW_CELL_KNOB = "weather.snow.cell_m"
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SettingsChoice:
    """Result of choosing settings.

    The recipe, settings, is_met, flip and views are the same for the same scene, recipe and backend
    on every machine, where the recipe gives max_flip. The times differ. Where nothing had to be
    chosen, all fields but the recipe are empty.
    """

    recipe: Recipe
    """Recipe with its settings in numbers."""
    settings: Settings = field(default_factory=dict)
    """Chosen values of the knobs that the recipe leaves free."""
    is_met: bool = True
    """True if the settings keep the recipe's bound; an error can always be kept, a budget
    cannot.
    """
    flip: float = 0.0
    """Mean FLIP against reference in the worst of the views."""
    views: tuple[tuple[int, str], ...] = ()
    """Frame numbers and camera names."""
    ms: float | None = None
    """Frame time of the settings, milliseconds; only for a recipe with budget_ms."""
    reference_ms: float | None = None
    """Frame time of the reference, milliseconds; only for a recipe with budget_ms."""
    seconds: float = 0.0
    """Seconds that the choice took."""


def resolve_quality(
    recipe: Recipe,
    scene: Scene,
    *,
    camera_path: Sequence[Frame] | None = None,
    backend: str = "auto",
    renderer: Renderer | None = None,
    progress: bool = False,
) -> SettingsChoice:
    """Return the recipe with the settings that its max_flip or budget_ms chooses in this scene.

    With max_flip the choice is the same every time; with budget_ms it depends on this machine. A
    budget that cannot be kept is logged as a warning, and the fastest settings are taken.

    Args:
        camera_path: Frames that are rendered in place of the scene's own.
        renderer: `augment.view.render_view.render_view` if None.
        progress: If True, show a bar on stderr.

    Raises:
        SceneError: The scene cannot be rendered under the recipe.
    """
    quality = recipe.quality
    if not recipe.has_open_choice:
        return SettingsChoice(recipe)
    start_s = perf_counter()
    views = calibration_views(
        scene.frames if camera_path is None else camera_path,
        times_ns=_extreme_times_ns(recipe, scene),
    )
    cameras = None
    if camera_path is not None:
        cameras = [camera for frame in camera_path for camera in frame.cameras.values()]
    # A copy keeps the shared data of settings that are not chosen.
    trial_scene = scene.without_memo()
    values_of_knob = _allowed_values(recipe)
    bar = ProgressBar(
        unit="picture", desc=f"choosing settings of {recipe.name}", disable=not progress
    )
    with bar:
        while True:
            reference = first_settings(values_of_knob)
            arguments = (recipe, trial_scene, views, reference, backend, cameras, renderer)
            try:
                bench = SettingsBench(*arguments, bar.update)
                break
            except SceneError:
                if len(values_of_knob.get(_SNOW_CELL_KNOB, ())) < 2:
                    raise
                values_of_knob[_SNOW_CELL_KNOB] = values_of_knob[_SNOW_CELL_KNOB][:-1]
        ms = reference_ms = None
        if (bound := quality.max_flip) is not None:
            settings = search_settings(
                values_of_knob, lambda trial_settings: bench.flip(trial_settings, bound) <= bound
            )
        else:
            assert quality.budget_ms is not None
            settings = _within_budget(bench, values_of_knob, quality.budget_ms)
            ms = bench.ms(settings)
            reference_ms = bench.ms(reference)
        worst_flip = bench.flip(settings)
    chosen_recipe = apply_settings(recipe, settings)
    if cameras is None and renderer is None:  # keep the images' shared data
        precompute_effects(JobContext(trial_scene, [chosen_recipe], backend=backend))
        memo_of(scene.as_recorded).take_shared(memo_of(trial_scene.as_recorded).shared())
    is_met = ms is None or ms <= (quality.budget_ms or 0)
    if not is_met:
        _log.warning(
            "recipe %s, scene %s: its frames take %.0f ms with the fastest settings, more than "
            "quality.budget_ms %g; give a larger budget, or fields that save more",
            recipe.name,
            scene.name,
            ms,
            quality.budget_ms,
        )
    view_names = tuple((v.frame, v.name) for v in views)
    seconds = perf_counter() - start_s
    return SettingsChoice(
        chosen_recipe, settings, is_met, worst_flip, view_names, ms, reference_ms, seconds
    )


def _within_budget(bench: SettingsBench, values_of_knob: Ladders, budget_ms: float) -> Settings:
    """Return settings that keep the budget; the fastest settings where none keep it."""

    def keeps(settings: Settings) -> bool:
        return bench.ms(settings) <= budget_ms

    if keeps(bench.reference):
        return bench.reference
    reference_ms = bench.ms(bench.reference)
    ladders, steps = steps_back(
        {
            path: [*(bench.cost(path, v) for v in values[:-1]), Cost(values[-1], reference_ms, 0.0)]
            for path, values in values_of_knob.items()
        }
    )
    fastest = first_settings(ladders)
    return search_settings(ladders, keeps, steps) if keeps(fastest) else fastest


def apply_settings(recipe: Recipe, settings: Settings) -> Recipe:
    """Return the recipe with chosen settings.

    Raises:
        ValueError: The settings are not for the recipe's free knobs.
    """
    free_paths = {knob.path for knob in free_knobs(recipe)}
    if settings.keys() != free_paths:
        raise ValueError(
            f"the settings are of {', '.join(sorted(settings)) or 'no knob'}; the recipe leaves "
            f"free {', '.join(sorted(free_paths)) or 'none'}"
        )
    return with_settings(recipe, {**settings, "render.speed.settled": True})


def recipes_to_try(recipe: Recipe) -> list[Recipe]:
    """Return the recipe with each knob at each value that may be tried alone.

    Kernels are compiled for these recipes. A recipe without anything to choose is returned as it
    is.
    """
    if not recipe.has_open_choice:
        return [recipe]
    values_of_knob = _allowed_values(recipe)
    reference = first_settings(values_of_knob)
    single_changes = [
        {path: value} for path, values in values_of_knob.items() for value in values[:-1]
    ]
    return [apply_settings(recipe, reference | changes) for changes in [{}, *single_changes]]


def _allowed_values(recipe: Recipe) -> dict[str, tuple[Value, ...]]:
    """Return the values of free knobs that the recipe's rules allow, from the fastest to reference.

    The reference is always one of them.
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
# `.climategs/quality/<digest>.json` is named by a digest of the question. Every process that goes
# on with the output, on any machine, takes the settings from there. With a budget of time they
# would otherwise differ between machines, and so would the images.

# Folder of the choices.
CHOICES_FOLDER = f"{STATE_FOLDER}/quality"
# Version of the file's format.
_FORMAT = 1
# Longest wait for a choice that another process is making, seconds.
MAX_CHOOSING_S = 7200.0


@dataclass(frozen=True)
class Question:
    """Subject of a choice."""

    recipe: Recipe
    """Recipe that is not resolved."""
    scene: str
    """Name of the scene."""
    source: str
    """The scene's own statement of its origin."""
    trajectory: str
    """Camera path, as in the manifest."""
    backend: str
    """Name of the rasteriser's backend."""

    def facts(self) -> dict[str, Any]:
        """Return all facts that decide the choice.

        They name the free knobs, which the recipe's hash does not cover.
        """
        return {
            "recipe": json.loads(self.recipe.canonical_json()),
            "free": sorted(former_path(knob.path) for knob in free_knobs(self.recipe)),
            "scene": self.scene,
            "source": self.source,
            "trajectory": self.trajectory,
            "version": augment.__version__,
            "backend": self.backend,
        }

    @property
    def digest(self) -> str:
        """Digest of the facts, 20 hex digits."""
        text = json.dumps(self.facts(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:20]

    @property
    def path(self) -> str:
        """Path of the choice's file in the output."""
        return f"{CHOICES_FOLDER}/{self.digest}.json"


def choose_settings(
    store: Store,
    recipe: Recipe,
    scene: Scene,
    *,
    backend: str,
    camera_path: Sequence[Frame] | None = None,
    renderer: Renderer | None = None,
    choose_again: bool = False,
    keep_choice: bool = True,
    progress: bool = False,
) -> Recipe:
    """Return the recipe with the settings that the output holds for it, or that are chosen now.

    A recipe whose quality has nothing to choose is returned as it is. A new choice is kept before
    any image uses it. Where another process is choosing, its choice is waited for. Other arguments
    and errors are those of `resolve_quality`.

    Args:
        choose_again: If True, choose again, and keep the new choice in place of the old one.
        keep_choice: If True, the output keeps a new choice.
    """
    if not recipe.has_open_choice:
        return recipe
    question = Question(recipe, scene.name, scene.source, trajectory_id(camera_path), backend)

    def choose() -> SettingsChoice:
        options = {"backend": backend, "renderer": renderer, "progress": progress}
        return resolve_quality(recipe, scene, camera_path=camera_path, **options)

    if not choose_again and (stored_recipe := read_choice(store, question)):
        return stored_recipe
    if not keep_choice:
        return choose().recipe
    claim_name = f"quality.{question.digest}"
    activity = "is choosing the same settings"
    with hold_claim(store, claim_name, MAX_CHOOSING_S, activity) as claim:
        if not choose_again and (stored_recipe := read_choice(store, question)):
            return stored_recipe
        result = choose()
        claim.check()
        store.write(question.path, _to_json(question, result))
        return result.recipe


def read_choice(store: Store, question: Question) -> Recipe | None:
    """Return the resolved recipe that the output holds; None where nothing was chosen yet."""
    try:
        data = store.read(question.path)
    except StoredFileMissing:
        return None
    subject = f"the settings chosen for recipe {question.recipe.name} in scene {question.scene}"
    with parse_errors_as_output_errors(
        f"{store.uri}/{question.path}, {subject},",
        "Delete it, and they are chosen anew; images of other settings then have to be overwritten",
    ):
        document = json.loads(data)
        if document["format"] != _FORMAT:
            raise ValueError(f"its format is {document['format']!r}, not {_FORMAT}")
        if document["asked"] != question.facts():
            raise ValueError("it answers another question than its name says")
        stored_settings: Settings = document["choice"]["settings"]
        settings = {MOVED_FIELDS.get(path, path): v for path, v in stored_settings.items()}
        for path, value in settings.items():
            knob = KNOBS.get(path)
            if knob is None or not any(value == v and type(value) is type(v) for v in knob.values):
                raise ValueError(f"{path} = {value!r} is none of the values to choose from")
        return apply_settings(question.recipe, settings)


def _to_json(question: Question, result: SettingsChoice) -> bytes:
    """Return the file of a choice."""
    settings = {former_path(path): value for path, value in result.settings.items()}
    values = {**vars(result), "settings": settings}
    document = {
        "format": _FORMAT,
        "asked": question.facts(),
        "choice": {name: values[name] for name in ("settings", "is_met", "flip", "views")},
        "this_machine": {name: values[name] for name in ("ms", "reference_ms", "seconds")},
    }
    return json.dumps(document, indent=1).encode()
