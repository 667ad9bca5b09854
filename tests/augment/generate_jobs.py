"""Small dataset jobs with stand-in scenes and renderers, and notes of what was rendered when.

Worker processes import this module by name, so it needs nothing of pytest. Where the environment
names a file (NOTES), every process appends a line to it before an image is rendered (`R`) and after
its entry into the progress log has returned (`A`): no `R` may follow the `A` of the same image.
"""

from __future__ import annotations

import hashlib
import os
import signal
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from augment.errors import OutputError
from augment.jobs.block_worker import JobWorkerSetup
from augment.jobs.generate import GenerateJob
from augment.jobs.job_state import ProgressLog
from augment.output.manifest import read_manifest_rows
from augment.output.names import STATE_FOLDER
from augment.output.store import open_store
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from recipes.job import Job, JobRecipes, JobScene
from recipes.load import parse_recipe
from recipes.schema import Recipe
from tests.augment.batch_scenes import FakeView, fake_render, open_fake, tree_digest

NOTES = "CLIMATEGS_TEST_NOTES"

FOG = "weather: {smog: {visibility_m: {uniform: [20, 200]}}}\n"
WET = "weather: {flood: {level_m: {uniform: [0.1, 0.5]}}}\noutput: {image: jpg, depth: none}\n"
DRY = "output: {depth: none, labels: false, lidar: false}\n"
TEXTS = {"fog": FOG, "wet": WET, "dry": DRY}
SCENES = ("fake:a?frames=4", "fake:b?frames=3")


def make_recipes(
    names: Sequence[str] = ("fog", "wet"),
    *,
    variants: int = 1,
    block_images: int = 4,
    texts: dict[str, str] | None = None,
    **facts,
) -> JobRecipes:
    """A job's recipes by the names of TEXTS."""
    entries = [{"recipe": name, "variants": variants} for name in names]
    job = Job(scenes=({"uri": "x"},), recipes=tuple(entries), block_images=block_images, **facts)
    texts = {**TEXTS, **(texts or {})}
    templates = {}
    for name in names:
        text = f"name: {name}\nseed: 5\nvariants: {variants}\n{texts[name]}"
        templates[name] = parse_recipe(text, source=f"{name}.yaml")
    return JobRecipes(job, templates)


def make_job(
    out: Path | str,
    scenes: Sequence[str | JobScene] = SCENES,
    recipes: JobRecipes | None = None,
    *,
    renderer: Callable = fake_render,
    opener: Callable[[str], Scene] = open_fake,
    scratch: Path | None = None,
    executor: str = "serial",
    **options,
) -> GenerateJob:
    """7 frames of 2 cameras in 2 scenes under 2 recipes, 28 images, unless told otherwise."""
    entries = [s if isinstance(s, JobScene) else JobScene(uri=s) for s in scenes]
    setup = JobWorkerSetup(str(out), scratch, "auto", opener, renderer)
    return GenerateJob(recipes or make_recipes(), entries, setup, executor=executor, **options)


def image_name(scene: Scene, camera: Camera, recipe: Recipe) -> str:
    frame = round((camera.timestamp_ns - 10**18) / 1e8)
    return f"{scene.name}/{recipe.name}-{recipe.variant:03d}/{frame}/{camera.name}"


def note(kind: str, name: str) -> None:
    """Append a line to the notes, if any are taken: in one write, so that lines never mix."""
    if path := os.environ.get(NOTES):
        descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
        try:
            os.write(descriptor, f"{kind} {name}\n".encode())
        finally:
            os.close(descriptor)


def noting_render(scene: Scene, camera: Camera, recipe: Recipe, *, backend: str) -> FakeView:
    note("R", image_name(scene, camera, recipe))
    return fake_render(scene, camera, recipe, backend=backend)


def slow_noting_render(scene: Scene, camera: Camera, recipe: Recipe, *, backend: str) -> FakeView:
    time.sleep(0.05)
    return noting_render(scene, camera, recipe, backend=backend)


def dying_render(scene: Scene, camera: Camera, recipe: Recipe, *, backend: str) -> FakeView:
    """Kills its process at one image: frame 1 of the front camera of scene a in fog."""
    name = image_name(scene, camera, recipe)
    note("R", name)
    if name == "a/fog-000/1/front":
        os.kill(os.getpid(), signal.SIGKILL)
    return fake_render(scene, camera, recipe, backend=backend)


def raising_render(scene: Scene, camera: Camera, recipe: Recipe, *, backend: str) -> FakeView:
    """As an input frame that is damaged."""
    name = image_name(scene, camera, recipe)
    note("R", name)
    if name == "a/fog-000/1/front":
        raise ValueError("the picture is cut short")
    return fake_render(scene, camera, recipe, backend=backend)


def open_without_memory(uri: str) -> Scene:
    """Scene b cannot be opened; a small one of another name can."""
    if uri.startswith("fake:b"):
        raise MemoryError("bad allocation")
    return open_fake(uri)


def open_dying(uri: str) -> Scene:
    """Scene b takes the process with it, as when the kernel runs out of memory."""
    note("O", uri)
    if uri.startswith("fake:b"):
        os.kill(os.getpid(), signal.SIGKILL)
    return open_fake(uri)


def take_notes(path: Path) -> None:
    """Note what this process and its children do from now on."""
    os.environ[NOTES] = str(path)
    _note_entries()


def read_notes(path: Path) -> tuple[list[str], Counter[str]]:
    """Images rendered again after they had been finished, and how often each was rendered."""
    finished = set()
    again = []
    rendered = Counter()
    for line in path.read_text().splitlines() if path.exists() else []:
        kind, _, name = line.partition(" ")
        if kind == "A":
            finished.add(name)
        elif kind == "R":
            rendered[name] += 1
            again += [name] if name in finished else []
    return again, rendered


def _note_entries() -> None:
    """Wrap ProgressLog.append once, to note the rows that it has written."""
    append = ProgressLog.append
    if getattr(append, "notes", False):
        return

    def noted(progress_log: ProgressLog, row: dict) -> None:
        append(progress_log, row)
        if row["status"] == "ok":
            note("A", f"{row['scene']}/{row['variant']}/{row['frame']}/{row['camera']}")

    noted.notes = True
    ProgressLog.append = noted


if os.environ.get(NOTES):  # a worker of a process that takes notes
    _note_entries()


def outputs(out: Path) -> dict[str, str]:
    """SHA-256 of all files of the output less the state's own."""
    return {k: v for k, v in tree_digest(out).items() if not k.startswith(STATE_FOLDER)}


def leftovers(out: Path) -> list[str]:
    """What a finished job must not leave: staged blocks, held claims, temporaries."""
    state = out / STATE_FOLDER
    staged = [p for p in (state / "blocks").rglob("*")] if (state / "blocks").exists() else []
    claims = [p for p in (state / "claims").rglob("*")] if (state / "claims").exists() else []
    paths = staged + claims + list(out.rglob("*.climategs-tmp"))
    return sorted(str(path.relative_to(out)) for path in paths)


def check_reader(out: Path, reference_digests: dict[str, str], *, may_fail: bool = False) -> int:
    """What a reader sees is finished and valid, at any time; returns how many images that is.

    reference_digests: digests of the uninterrupted job's files. may_fail: rows of failures are
    expected.
    """
    try:
        table = read_manifest_rows(open_store(out))
    except OutputError as error:
        assert "neither" in str(error), error
        return 0
    rows = table.to_pylist()
    for row in rows:
        assert may_fail or row["status"] == "ok", row
        for kind, path in row.items():
            if kind.endswith("_path") and path is not None:
                data = (out / path).read_bytes()
                assert hashlib.sha256(data).hexdigest() == reference_digests[path], path
    return len(rows)
