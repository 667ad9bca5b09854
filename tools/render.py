"""`climategs render`: a recipe and a scene's URI become a job; `climategs demo` is one of them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from adapters.base import open_scene
from adapters.camera_files.paths import frames_from_path_file
from augment.cameras import Frame
from augment.errors import ClimateGSError
from augment.ground import ground_of
from augment.jobs.backends import choose_backend
from augment.jobs.files import SceneIndex, check_frames, has_lidar
from augment.jobs.layout import variant_name
from augment.jobs.manifest import lidar_notes
from augment.jobs.quality import recipes_to_try, resolve_quality_for
from augment.jobs.render_job import JobResult, RenderJob, run_job
from augment.jobs.store import open_store
from augment.jobs.worker import shares_of
from augment.plan import make_plan
from augment.scene import Scene
from recipes.change import found
from recipes.job import scaled_recipe
from recipes.load import load_recipe
from recipes.schema import FramePattern, Recipe, free_knobs, parse_frames
from tools.mirror import mirror_outputs, recipes_for_source
from tools.output import print_images, print_note
from tools.sheet import draw_sheet, draw_video
from tools.warm_up import warm_up, warming_up_beside

if TYPE_CHECKING:
    from tools.cli import RenderOptions

DEMO_RECIPES = ("clear", "dense-fog", "street-flood", "fresh-snow", "evening")
DEMO_CAMERA = "front"  # the one that is shown as a video


def render_recipe(options: RenderOptions) -> int:
    """Runs the job and prints what became of it. Returns the exit code: 1 where images failed."""
    out, backend = options.out, options.backend
    recipes = resolve_variants(options.recipe, options.variants, options.scale)
    tried = [each for resolved in recipes for each in recipes_to_try(resolved)]
    seconds = warm_up(tried, backend)
    if seconds > 1:
        print_note(f"compiled the kernels in {seconds:.1f} s (kept for the next run)")
    scene = open_scene(options.scene)
    if options.camera_path is None:
        check_frames(scene)
    for problem in scene.problems:
        print_note(f"note: {problem}")
    if options.layout == "source":
        _check_no_path(options.camera_path)
        recipes = recipes_for_source(scene, out, recipes, overwrite=options.overwrite)
    if any(resolved.weather.flood is not None for resolved in recipes):
        scene = replace(scene, ground=ground_of(scene))  # looked for once, not by every worker
    path = None
    if options.camera_path is not None:
        path = frames_from_path_file(options.camera_path, scene)
    recipes = [_with_quality(resolved, scene, options, path) for resolved in recipes]
    for resolved in recipes:
        make_plan(resolved, scene)  # refuse once, not for every image
    chosen = _pattern(options.frames).select([frame.index for frame in scene.frames])
    notes = lidar_notes(recipes)
    labelled = SceneIndex.of(scene, path).labelled
    asked = labelled if chosen is None else labelled.intersection(chosen)
    if notes and has_lidar(scene, asked):
        for note in notes:
            print_note(f"note: {note}")
    job = RenderJob(
        scene_uri=options.scene,
        recipes=recipes,
        out_dir=out,
        frames=chosen,
        cameras=None if options.cameras == "all" else tuple(options.cameras.split(",")),
        camera_path=path,
        workers=options.workers,
        backend=backend,
        overwrite=options.overwrite,
    )
    result = run_job(job, scene_loader=lambda _uri: scene)
    _report(result, options.workers)
    if options.layout == "source":
        names = [variant_name(resolved) for resolved in recipes]
        for sentence in mirror_outputs(scene, out, variants=names, links=options.links):
            print(sentence)
    if options.sheet and result.written + result.skipped:
        print(f"pictures: {draw_sheet(out)}")
    return 1 if result.failed else 0


def resolve_variants(recipe: str, variants: int | None = None, scale: float = 1.0) -> list[Recipe]:
    """The recipe's variants in numbers, at `scale` times the recipe's resolution.

    Raises:
        RecipeError: the recipe is invalid, or scaled beyond its limits.
    """
    template = load_recipe(recipe)
    count = template.variants if variants is None else variants
    if count < 1:
        raise ClimateGSError(f"--variants must be >= 1; got {count}")
    resolved = [template.resolve(number) for number in range(count)]
    return [scaled_recipe(r, scale) for r in resolved]


def _with_quality(
    recipe: Recipe, scene: Scene, options: RenderOptions, path: Sequence[Frame] | None
) -> Recipe:
    """The recipe with the settings of its quality; a note says which it had to choose."""
    if not recipe.quality.is_open:
        return recipe
    resolved = resolve_quality_for(
        open_store(options.out),
        recipe,
        scene,
        backend=choose_backend(options.backend, scene),
        camera_path=path,
        anew=options.overwrite,
        progress=True,
    )
    settings = [f"{k.path} {found(resolved, k.path)}" for k in free_knobs(recipe)]
    print_note(
        f"{variant_name(recipe)}: quality {recipe.quality.words} chose {', '.join(settings)}"
    )
    return resolved


def _pattern(text: str) -> FramePattern:
    try:
        return parse_frames(text)
    except ValueError as error:
        raise ClimateGSError(f"--frames {error}") from None


def _check_no_path(camera_path: Path | None) -> None:
    if camera_path is not None:
        raise ClimateGSError(
            f"--camera-path {camera_path} shows frames that the dataset does not have: "
            f"--layout source is for the scene's own frames"
        )


def _report(result: JobResult, workers: int) -> None:
    print_images(result, f"{result.seconds:.1f} s")
    if result.written:
        kinds = ("render", "encode", "write")
        each = [f"{1000 * result.timings.get(k, 0.0) / result.written:.0f} ms {k}" for k in kinds]
        print(f"per image: {', '.join(each)} (on threads that overlap)")
    if shares := shares_of(result.timings, held_up=workers):
        print(shares.sentence)
    print(f"manifest: {result.manifest}")


def run_demo(out: Path, frames: int) -> int:
    """The embedded street under five recipes, and pictures of it. Returns the exit code."""
    started = time.perf_counter()
    uri = f"procedural:street?seed=3&frames={frames}"
    print_note(f"building {uri} and compiling the kernels (kept for the next run)")
    recipes = [load_recipe(name).resolve(0) for name in DEMO_RECIPES]
    with warming_up_beside(recipes):
        scene = open_scene(uri)
        warm_up(recipes)
    ready = time.perf_counter()
    job = RenderJob(scene_uri=uri, recipes=recipes, out_dir=out)
    result = run_job(job, scene_loader=lambda _uri: scene)
    for failure in result.failures:
        print_note(f"failed: {failure}")
    pictures = [draw_sheet(out), draw_video(out, DEMO_CAMERA, frames_per_second=5)]
    done = time.perf_counter()
    print(
        f"{result.written} images written, {result.skipped} already there, {result.failed} failed: "
        f"{ready - started:.0f} s to build and compile, {done - ready:.0f} s to render and draw"
    )
    print(f"images, depth, labels, LiDAR: {out}")
    print(f"contact sheet:                {pictures[0]}")
    print(f"video, variants side by side: {pictures[1]}")
    return 1 if result.failed else 0
