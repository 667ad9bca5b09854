"""A choice of settings, made once for an output and kept in it.

`.climategs/quality/<digest>.json` is found again by what was asked: the recipe with the knobs that
it leaves free, the scene, the camera path, the package's version and the backend. Whoever goes on
with the output, on whatever machine, takes the settings from there: with a budget of time they
would else differ from one machine to the next, and the images with them.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import augment
from augment.cameras import Frame
from augment.errors import OutputError
from augment.jobs.claims import Claim, try_claim
from augment.jobs.files import trajectory_id
from augment.jobs.layout import STATE_FOLDER
from augment.jobs.quality import (
    Report,
    Settled,
    calibration_views,
    resolve_quality,
    resolved_recipe,
)
from augment.jobs.store import Store, StoredFileMissing
from augment.jobs.worker import Renderer
from augment.scene import Scene
from recipes.schema import BY_PATH, Recipe, free_knobs

FOLDER = f"{STATE_FOLDER}/quality"
_FORMAT = 1
_MAX_WAIT_S = 1.0  # between looks at what another process is choosing


@dataclass(frozen=True)
class Question:
    """What a choice is made for. recipe: not settled. scene, source: its name and where it is from.
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
    now; the same recipe where its quality has nothing to choose.

    camera_path: frames that are rendered in place of the scene's own. anew: as in
    `resolve_quality_once`.
    keep: whether a new choice is kept in the output. The others: as in `settle`.

    Raises:
        SceneError: the scene cannot be rendered under the recipe. OutputError: as
        resolve_quality_once.
    """
    if not recipe.quality.is_open:
        return recipe
    question = Question(recipe, scene.name, scene.source, trajectory_id(camera_path), backend)
    frames, cameras = scene.frames, None
    if camera_path is not None:
        frames = camera_path
        cameras = [camera for frame in camera_path for camera in frame.cameras.values()]

    def choose() -> Settled:
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
    found = None if anew else recorded(store, question)
    return found or choose().recipe


def recorded(store: Store, question: Question) -> Recipe | None:
    """The recipe settled as the output has it; None where nothing was chosen yet.

    Raises:
        OutputError: the record is damaged, or the output cannot be read.
    """
    try:
        data = store.read(question.path)
    except StoredFileMissing:
        return None
    try:
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
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        said = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise OutputError(
            f"{store.uri}/{question.path}, the settings chosen for recipe {question.recipe.name} "
            f"in scene {question.scene}, is damaged: {said}. Delete it, and they are chosen anew; "
            f"images of other settings then have to be overwritten"
        ) from error


def resolve_quality_once(
    store: Store, question: Question, choose: Callable[[], Settled], *, anew: bool = False
) -> Recipe:
    """The recipe settled as the output has it; where it has nothing, `choose` chooses, and the
    choice is kept before anyone sees it. Waits for another process that is choosing.

    anew: choose whatever there is, and keep that in its place.

    Raises:
        OutputError: the record is damaged, or cannot be written; and what `choose` raises.
    """
    found = None if anew else recorded(store, question)
    if found is not None:
        return found
    with _claimed(store, question) as claim:
        found = None if anew else recorded(store, question)  # another may have chosen meanwhile
        if found is None:
            settled = choose()
            assert settled.report is not None, "the recipe had nothing to choose"
            found = settled.recipe
            claim.check()
            store.write(question.path, _to_json(question, settled.report))
    return found


def _check_values(settings: dict[str, Any]) -> None:
    for path, value in settings.items():
        knob = BY_PATH.get(path)
        if knob is None or not any(value == v and type(value) is type(v) for v in knob.values):
            raise ValueError(f"{path} = {value!r} is none of the values to choose from")


def _claimed(store: Store, question: Question) -> Claim:
    """The claim to choose, however long another process holds it: as long as it takes to find where
    snow can lie. That of one that has died can be had.
    """
    wait_s = 0.05
    while (claim := try_claim(store, f"quality.{question.digest}")) is None:
        time.sleep(wait_s)
        wait_s = min(2 * wait_s, _MAX_WAIT_S)
    return claim


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
