"""The scenes that the service offers: their names with weather, and the few that are open.

In: URIs and recipes. Out: an `OpenScene` for the time of a request. A scene that is not open is
opened for the request; the scene that was used longest ago is closed for it.
"""

from __future__ import annotations

import contextlib
import itertools
import re
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import grpc

from adapters.base import open_scene
from augment.effects import JobContext, precompute_effects
from augment.errors import ClimateGSError
from augment.output.names import STATE_FOLDER
from augment.output.store import open_store
from augment.render.backends import choose_backend
from augment.scene.scene import Scene
from augment.scene.scene_index import check_frames
from augment.view.plan import check_plans
from augment.view.quality import choose_settings
from augment.view.render_view import render_view
from recipes.fields import with_unchecked_field
from recipes.files import with_digest
from recipes.schema import Recipe
from tools.output import print_note
from tools.serve.errors import RequestRefused, quote_text
from tools.serve.scene_facts import SceneFacts, facts_of

# Sign between a scene's name and a recipe's.
RECIPE_SIGN = "@"
# Sign between a recipe's name and the number of a variant.
VARIANT_SIGN = "#"
# Names under which scenes can be offered. The signs above and spaces are not among the characters.
_NAME = re.compile(r"[A-Za-z0-9._:+=,~-]{1,200}")
# A name that a user gives a scene: NAME=URI.
_NAMED_URI = re.compile(r"([A-Za-z0-9._+~-]{1,200})=(.+)", re.DOTALL)
# Width of the images that are drawn when a scene is opened, at most, pixels.
_SMALL_WIDTH_PX = 160
# Names that a message about an unknown scene lists, at most.
_MAX_NAMES = 12


@dataclass(frozen=True)
class SceneSource:
    """A scene that the user has named."""

    uri: str
    """URI of the scene, as for `climategs render`."""
    name: str | None = None
    """Name for clients; None for the scene's own."""


@dataclass(frozen=True)
class OfferedRecipe:
    """Weather that a client can choose."""

    suffix: str
    """Part of a scene's name from RECIPE_SIGN on; empty for the default weather."""
    recipe: Recipe
    """Recipe in numbers, at full resolution."""


@dataclass(frozen=True, eq=False)
class OpenScene:
    """A scene that is in memory."""

    scene: Scene
    """The scene."""
    recipe_by_suffix: dict[str, Recipe]
    """Recipes with the settings for this scene, by the part of a name from RECIPE_SIGN on."""
    backend: str
    """Name of the rasteriser's backend."""
    facts: SceneFacts
    """Name for clients, cameras, path and masks."""


@dataclass(eq=False)
class _Entry:
    """A scene that is offered."""

    source: SceneSource
    """Its origin."""
    facts: SceneFacts
    """Name for clients, cameras, path and masks, also while the scene is closed."""
    open_scene: OpenScene | None = None
    """The scene, if it is in memory."""
    num_users: int = 0
    """Requests that use it at the moment."""
    last_use: int = 0
    """Number of the last request that used it."""
    opening: threading.Lock = field(default_factory=threading.Lock)
    """Held by the request that opens the scene."""


def parse_source(text: str) -> SceneSource:
    """Return the source of `URI` or `NAME=URI`. A path that exists is a URI, whatever its name."""
    match = _NAMED_URI.fullmatch(text)
    if match is None or Path(text).exists():
        return SceneSource(text)
    return SceneSource(match[2], match[1])


def scene_name(scene_id: str) -> str:
    """Return the scene of a client's name, without the weather."""
    return scene_id.partition(RECIPE_SIGN)[0]


def offered_recipes(recipes: Sequence[Recipe]) -> tuple[OfferedRecipe, ...]:
    """Return the weather that clients can choose, the default weather first.

    The first recipe is the default, and its first variant that of a name without a number.

    Args:
        recipes: recipes in numbers; the variants of one recipe follow each other.
    """
    offered = [OfferedRecipe("", recipes[0])]
    seen_names = set[str]()
    for recipe in recipes:
        if recipe.name not in seen_names:
            seen_names.add(recipe.name)
            offered.append(OfferedRecipe(f"{RECIPE_SIGN}{recipe.name}", recipe))
        number = f"{VARIANT_SIGN}{recipe.variant}"
        offered.append(OfferedRecipe(f"{RECIPE_SIGN}{recipe.name}{number}", recipe))
    return tuple(offered)


class SceneStore:
    """Opens scenes for requests, and keeps some of them open.

    All scenes are opened once at the start, so that their names and cameras are known, and
    impossible recipes are refused before a client comes.

    Args:
        sources: the scenes.
        recipes: recipes in numbers, the default first.
        backend: name of a backend, or "auto".
        max_open: scenes in memory, at most.
        folder: folder for files that images of a scene share.
        on_open: called with each scene that was opened.

    Raises:
        ClimateGSError: a scene cannot be opened, lacks frames, cannot have a recipe's weather, or
            has the name of another one.
    """

    def __init__(
        self,
        sources: Sequence[SceneSource],
        recipes: Sequence[Recipe],
        *,
        backend: str,
        max_open: int,
        folder: Path,
        on_open: Callable[[OpenScene], None] = lambda opened: None,
    ) -> None:
        self._offered = offered_recipes(recipes)
        self._backend = backend
        self._max_open = max_open
        self._folder = folder
        self._on_open = on_open
        self._changed = threading.Condition()
        self._entry_by_name: dict[str, _Entry] = {}
        self._num_opening = 0
        self._use_numbers = itertools.count(1)
        for source in sources:
            self._add(source)

    @property
    def scene_ids(self) -> tuple[str, ...]:
        """Names for clients: each scene with its default weather, then with each weather."""
        names = list(self._entry_by_name)
        plain_names = [name + self._offered[0].suffix for name in names]
        return (
            *plain_names,
            *(name + offered.suffix for name in names for offered in self._offered[1:]),
        )

    @property
    def scene_names(self) -> tuple[str, ...]:
        """Names of the scenes, without weather."""
        return tuple(self._entry_by_name)

    @property
    def all_facts(self) -> tuple[SceneFacts, ...]:
        """Facts of all scenes, open or not."""
        return tuple(entry.facts for entry in self._entry_by_name.values())

    @property
    def num_open(self) -> int:
        """Number of scenes in memory."""
        return sum(entry.open_scene is not None for entry in self._entry_by_name.values())

    def facts(self, scene_id: str) -> SceneFacts:
        """Return the facts of a scene by a client's name for it."""
        return self._find(scene_id)[0].facts

    @contextlib.contextmanager
    def borrow(
        self, scene_id: str, check: Callable[[], None] = lambda: None
    ) -> Iterator[tuple[OpenScene, Recipe]]:
        """Yield an open scene and the recipe of its weather; the scene stays open inside.

        Args:
            scene_id: a client's name for both.
            check: called while waiting; an exception that it raises ends the waiting.

        Raises:
            RequestRefused: there is no such scene or weather.
        """
        entry, suffix = self._find(scene_id)
        opened = self._acquire(entry, check)
        try:
            yield opened, opened.recipe_by_suffix[suffix]
        finally:
            with self._changed:
                entry.num_users -= 1
                self._changed.notify_all()

    def _find(self, scene_id: str) -> tuple[_Entry, str]:
        """Return the entry of a client's name, and the name's part with the weather."""
        name = scene_name(scene_id)
        suffix = scene_id.removeprefix(name)
        entry = self._entry_by_name.get(name)
        if entry is None:
            raise RequestRefused(
                grpc.StatusCode.NOT_FOUND,
                f"there is no scene {quote_text(name)}; this server has "
                f"{_listed(self.scene_names)}",
            )
        suffixes = [offered.suffix for offered in self._offered]
        if suffix not in suffixes:
            raise RequestRefused(
                grpc.StatusCode.NOT_FOUND,
                f"scene {name!r} is not offered in the weather {quote_text(suffix)}; "
                f"choose from {_listed([s for s in suffixes if s])}, or name the scene alone",
            )
        return entry, suffix

    def _acquire(self, entry: _Entry, check: Callable[[], None]) -> OpenScene:
        """Return the scene of an entry, opened if it was not, and count its user."""
        while True:
            with self._changed:
                if entry.open_scene is not None:
                    self._count_user(entry)
                    return entry.open_scene
            if not entry.opening.acquire(timeout=0.1):  # another request opens it
                check()
                continue
            try:
                if entry.open_scene is None:
                    with self._place(check):
                        opened = self._open(entry.source, entry.facts.name)
                        with self._changed:  # used at once, or a waiting request would close it
                            entry.open_scene = opened
                            self._count_user(entry)
                            return opened
            finally:
                entry.opening.release()

    def _count_user(self, entry: _Entry) -> None:
        """Count a request that uses an open scene. The caller holds the lock."""
        entry.num_users += 1
        entry.last_use = next(self._use_numbers)

    @contextlib.contextmanager
    def _place(self, check: Callable[[], None]) -> Iterator[None]:
        """Hold a place for a scene that is opened inside.

        Scenes that nobody uses are closed for it, the one used longest ago first.
        """
        with self._changed:
            while self.num_open + self._num_opening >= self._max_open:
                idle_entries = [
                    entry
                    for entry in self._entry_by_name.values()
                    if entry.open_scene is not None and entry.num_users == 0
                ]
                if idle_entries:
                    oldest_entry = min(idle_entries, key=lambda entry: entry.last_use)
                    oldest_entry.open_scene = None
                    continue
                self._changed.wait(0.1)
                check()
            self._num_opening += 1
        try:
            check()
            yield
        finally:
            with self._changed:
                self._num_opening -= 1
                self._changed.notify_all()

    def _add(self, source: SceneSource) -> None:
        """Open a scene for the first time, and offer it."""
        with self._place(lambda: None):
            opened = self._open(source, source.name)
        name = opened.facts.name
        if name in self._entry_by_name:
            raise ClimateGSError(
                f"two scenes are called {name!r}: {self._entry_by_name[name].source.uri} and "
                f"{source.uri}; give one another name, as in other={source.uri}"
            )
        if not _NAME.fullmatch(name):
            raise ClimateGSError(
                f"{source.uri}: the scene's name {name!r} cannot be asked for by clients, since "
                f"{RECIPE_SIGN} and {VARIANT_SIGN} name its weather; give it another, as in "
                f"scene1={source.uri}"
            )
        self._entry_by_name[name] = _Entry(source, opened.facts, opened)

    def _open(self, source: SceneSource, name: str | None) -> OpenScene:
        """Open a scene, choose the settings of its recipes, and compute what images share."""
        start_s = time.perf_counter()
        print_note(f"opening {source.uri}")
        scene = open_scene(source.uri)
        check_frames(scene)
        name = scene.name if name is None else name
        backend = choose_backend(self._backend, scene)
        folder = self._folder / re.sub(r"[^A-Za-z0-9._-]", "_", name)
        settled = {id(offered.recipe): offered.recipe for offered in self._offered}
        for key, recipe in settled.items():
            recipe = with_digest(recipe)
            if recipe.has_open_choice:
                store = open_store(str(folder))
                recipe = choose_settings(store, recipe, scene, backend=backend, progress=True)
            # The request gives the size of the image. No picture depends on the trust mask.
            recipe = with_unchecked_field(recipe, "render.scale", 1.0)
            recipe = with_unchecked_field(recipe, "output.trust", False)
            check_plans(recipe, scene)
            settled[key] = recipe
        recipe_by_suffix = {o.suffix: settled[id(o.recipe)] for o in self._offered}
        recipes = list(settled.values())
        state_folder = folder / STATE_FOLDER
        precompute_effects(JobContext(scene, recipes, None, state_folder, backend, True))
        for recipe in recipes:
            _draw_small_views(scene, recipe, backend)
        opened = OpenScene(scene, recipe_by_suffix, backend, facts_of(scene, name))
        for problem in scene.problems:
            print_note(f"note: {problem}")
        self._on_open(opened)
        print_note(f"opened {name} in {time.perf_counter() - start_s:.1f} s")
        return opened


def _draw_small_views(scene: Scene, recipe: Recipe, backend: str) -> None:
    """Draw the first camera twice in a small image, so that the first client waits no longer than
    others: some data of a scene are made with its first view, and some with its second.
    """
    frame = next(frame for frame in scene.frames if frame.cameras)
    camera = next(iter(frame.cameras.values()))
    small_camera = camera.scaled(min(1.0, _SMALL_WIDTH_PX / camera.width))
    for _ in range(2):
        render_view(scene, small_camera, recipe, backend=backend)


def _listed(names: Sequence[str]) -> str:
    """Return names for a message, the first of many."""
    listed = ", ".join(names[:_MAX_NAMES])
    return listed if len(names) <= _MAX_NAMES else f"{listed} and {len(names) - _MAX_NAMES} more"
