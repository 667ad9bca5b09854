"""`climategs render`: a recipe and a scene's URI become a job."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from adapters.base import open_scene
from augment.cameras import Frame
from augment.errors import ClimateGSError
from augment.ground import ground_of
from augment.jobs.backends import choose_backend
from augment.jobs.files import SceneIndex, check_frames, has_lidar
from augment.jobs.layout import variant_name
from augment.jobs.manifest import lidar_notes
from augment.jobs.mirror import Links
from augment.jobs.quality import recipes_to_try
from augment.jobs.quality import resolve_quality_for
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

Layout = Literal["standard", "source"]


def render_recipe(
    recipe: str,
    scene_uri: str,
    out: Path,
    *,
    frames: str = "all",
    cameras: str = "all",
    scale: float = 1.0,
    variants: int | None = None,
    workers: int = 1,
    backend: str = "auto",
    camera_path: Path | None = None,
    overwrite: bool = False,
    sheet: bool = True,
    layout: Layout = "standard",
    links: Links = "hard",
) -> int:
    """Runs the job and prints what became of it. Returns the exit code: 1 where images failed.

    layout: source also makes a copy of the scene's dataset with the images in place of the
    recorded ones. links: of that copy, see `tools.mirror.mirror_outputs`.
    """
    from tools.warm_up import warm_up

    recipes = resolve_variants(recipe, variants, scale)
    tried = [each for resolved in recipes for each in recipes_to_try(resolved)]
    seconds = warm_up(tried, backend)
    if seconds > 1:
        _print_result(f"compiled the kernels in {seconds:.1f} s (kept for the next run)")
    scene = open_scene(scene_uri)
    if camera_path is None:
        check_frames(scene)
    for problem in scene.problems:
        _print_result(f"note: {problem}")
    if layout == "source":
        _check_no_path(camera_path)
        recipes = recipes_for_source(scene, out, recipes, overwrite=overwrite)
    if any(resolved.weather.flood is not None for resolved in recipes):
        scene = replace(scene, ground=ground_of(scene))  # looked for once, not by every worker
    path = _frames_of(camera_path, scene)
    recipes = [
        _settled(resolved, scene, out, path, backend, overwrite=overwrite) for resolved in recipes
    ]
    for resolved in recipes:
        make_plan(resolved, scene)  # what the scene cannot give is said once, not for every image
    chosen = _pattern(frames).select([frame.index for frame in scene.frames])
    notes = lidar_notes(recipes)
    labelled = SceneIndex.of(scene, path).labelled
    asked = labelled if chosen is None else labelled.intersection(chosen)
    if notes and has_lidar(scene, asked):
        for note in notes:
            _print_result(f"note: {note}")
    job = RenderJob(
        scene_uri=scene_uri,
        recipes=recipes,
        out_dir=out,
        frames=chosen,
        cameras=None if cameras == "all" else tuple(cameras.split(",")),
        camera_path=path,
        workers=workers,
        backend=backend,
        overwrite=overwrite,
    )
    result = run_job(job, scene_loader=lambda _uri: scene)
    _report(result, workers)
    if layout == "source":
        names = [variant_name(resolved) for resolved in recipes]
        for sentence in mirror_outputs(scene, out, variants=names, links=links):
            print(sentence)
    if sheet and result.written + result.skipped:
        from tools.pictures import draw_sheet

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


def _settled(
    recipe: Recipe,
    scene: Scene,
    out: Path,
    path: Sequence[Frame] | None,
    backend: str,
    *,
    overwrite: bool,
) -> Recipe:
    """The recipe with the settings of its quality, which are told where it had to choose them."""
    if not recipe.quality.is_open:
        return recipe
    settled = resolve_quality_for(
        open_store(out),
        recipe,
        scene,
        backend=choose_backend(backend, scene),
        camera_path=path,
        anew=overwrite,
        progress=True,
    )
    settings = [f"{k.path} {found(settled, k.path)}" for k in free_knobs(recipe)]
    _print_result(
        f"{variant_name(recipe)}: quality {recipe.quality.words} chose {', '.join(settings)}"
    )
    return settled


def _frames_of(camera_path: Path | None, scene: Scene) -> Sequence[Frame] | None:
    if camera_path is None:
        return None
    from adapters.camera_files.paths import frames_from_path_file

    return frames_from_path_file(camera_path, scene)


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
    rate = result.written / result.seconds if result.seconds else 0.0
    print(
        f"{result.written} images written, {result.skipped} already there, {result.failed} failed; "
        f"{result.seconds:.1f} s, {rate:.1f} images/s"
    )
    if result.written:
        kinds = ("render", "encode", "write")
        each = [f"{1000 * result.timings.get(k, 0.0) / result.written:.0f} ms {k}" for k in kinds]
        print(f"per image: {', '.join(each)} (on threads that overlap)")
    if shares := shares_of(result.timings, held_up=workers):
        print(shares.sentence)
    for failure in result.failures[:20]:
        _print_result(f"failed: {failure}")
    if len(result.failures) > 20:
        _print_result(f"... and {len(result.failures) - 20} more; the manifest has them all")
    print(f"manifest: {result.manifest}")


def _print_result(text: str) -> None:
    print(text, file=sys.stderr)
