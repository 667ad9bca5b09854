"""`climategs render`: a scene under recipes becomes a job, and the job images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from adapters.base import open_scene
from adapters.camera_files.paths import frames_from_path_file
from adapters.scene_cache import scene_digest
from augment.errors import ClimateGSError
from augment.jobs.render_job import RenderJob, run_job
from augment.jobs.time_shares import compute_time_shares
from augment.output.layout import variant_name
from augment.output.manifest import lidar_notes
from augment.output.store import open_store
from augment.photo.trust import judge_scene, skipped_cameras_sentence, unfitted_cameras
from augment.render.backends import choose_backend, renders_on_gpu
from augment.scene.cameras import Frame
from augment.scene.scene import Scene
from augment.scene.scene_index import SceneIndex, check_frames, has_lidar
from augment.view.plan import check_plans
from augment.view.quality import choose_settings, recipes_to_try
from recipes.fields import section_at
from recipes.job import scaled_recipe
from recipes.load import load_recipe, read_overrides
from recipes.schema import Recipe, free_knobs, parse_frames
from tools.labels import write_labels_of_job
from tools.mirror import clear_notes, mirror_outputs, recipes_for_source
from tools.options import FITTED, names_in, with_ego_masks_key, with_tracks_key
from tools.output import compiling_noted, print_images, print_note
from tools.sheet import draw_sheet
from tools.warm_up import kernel_modules, warm_up

if TYPE_CHECKING:
    from tools.cli import RenderOptions


def render_recipes(options: RenderOptions) -> int:
    """Run the job and print its result. Return the exit code: 1 if images failed."""
    out = options.out
    backend = options.backend
    scene_uri = with_ego_masks_key(options.scene, options.ego_masks)
    scene_uri = with_tracks_key(scene_uri, options.tracks)
    recipes = resolve_recipes(options.recipes, options.variants, options.scale, options.overrides)
    trial_recipes = [recipe for resolved in recipes for recipe in recipes_to_try(resolved)]
    on_gpu = renders_on_gpu(backend)
    of_street = options.scene.startswith("procedural:")
    with compiling_noted(kernel_modules(trial_recipes, backend, of_street=of_street)):
        scene = open_scene(scene_uri)
        if not on_gpu:
            warm_up(trial_recipes, backend)
    if on_gpu:
        with compiling_noted(on_gpu=True):
            warm_up(trial_recipes, backend)
    if options.camera_path is None:
        check_frames(scene)
    for problem in scene.problems:
        print_note(f"note: {problem}")
    if options.layout == "source":
        if options.camera_path is not None:
            raise ClimateGSError(
                f"--camera-path {options.camera_path} shows frames that the dataset does not have: "
                f"--layout source is for the scene's own frames"
            )
        recipes = recipes_for_source(scene, out, recipes, overwrite=options.overwrite)
    path = None
    if options.camera_path is not None:
        path = frames_from_path_file(options.camera_path, scene)
    recipes = [_with_quality(resolved, scene, options, path) for resolved in recipes]
    for resolved in recipes:
        check_plans(resolved, scene)  # refuse once, not for every image
    frame_numbers = parse_frames(options.frames).select([frame.index for frame in scene.frames])
    cameras = _cameras(options, scene, path)
    frames = [f for f in path or scene.frames if frame_numbers is None or f.index in frame_numbers]
    if options.layout == "source":
        of_sweeps = any(resolved.lidar == "weather" for resolved in recipes)
        for note in clear_notes(scene, frame_numbers, cameras, of_sweeps=of_sweeps):
            print_note(f"note: {note}")
    scale = max(resolved.render.scale for resolved in recipes)
    for problem in judge_scene(scene, frames, cameras, scale=scale, count=1).problems:
        print_note(f"note: not fit for weather: {problem}")
    notes = lidar_notes(recipes)
    labelled_frames = SceneIndex.of(scene, path).labelled_frames
    sweep_frames = (
        labelled_frames if frame_numbers is None else labelled_frames.intersection(frame_numbers)
    )
    if notes and has_lidar(scene, sweep_frames):
        for note in notes:
            print_note(f"note: {note}")
    job = RenderJob(
        scene_uri=scene_uri,
        recipes=recipes,
        out_dir=out,
        frames=frame_numbers,
        cameras=cameras,
        camera_path=path,
        workers=options.workers,
        backend=backend,
        overwrite=options.overwrite,
        source_digest=scene_digest(scene_uri),
    )
    result = run_job(job, scene_loader=lambda _uri: scene)
    print_images(result, f"{result.seconds:.1f} s")
    if result.written:
        kinds = ("render", "encode", "write")
        times = [f"{1000 * result.timings.get(k, 0.0) / result.written:.0f} ms {k}" for k in kinds]
        print(f"per image: {', '.join(times)} (on threads that overlap)")
    if shares := compute_time_shares(result.timings, num_waiting_workers=options.workers):
        print(shares.sentence)
    print(f"manifest: {result.manifest}")
    write_labels_of_job(out, recipes, result.written + result.skipped)
    if options.layout == "source":
        names = [variant_name(resolved) for resolved in recipes]
        for sentence in mirror_outputs(scene, out, variants=names, links=options.links):
            print(sentence)
    if options.sheet and result.written + result.skipped:
        print(f"pictures: {draw_sheet(out)}")
    return 1 if result.failed else 0


def _cameras(
    options: RenderOptions, scene: Scene, path: Sequence[Frame] | None
) -> Sequence[str] | None:
    """Return the names of the cameras, or None for all. A note names those that are left out."""
    if options.cameras != FITTED:
        return names_in(options.cameras)
    unfitted_names = () if path is not None else unfitted_cameras(scene)
    if not unfitted_names:
        return None
    print_note(f"note: {skipped_cameras_sentence(unfitted_names, '--cameras all')}")
    return [name for name in scene.camera_names if name not in unfitted_names]


def resolve_recipes(
    names: Sequence[str],
    variants: int | None = None,
    scale: float = 1.0,
    overrides: Sequence[str] = (),
) -> list[Recipe]:
    """Return the recipes' variants in numbers, at `scale` times each recipe's resolution.

    Raises:
        RecipeError: a recipe is invalid, or scaled beyond its limits.
        ClimateGSError: two would write to the same folder.
    """
    recipes = []
    source_by_name = dict[str, str]()
    for name in names:
        template = load_recipe(name, read_overrides(overrides))
        if template.name in source_by_name:
            raise ClimateGSError(
                f"the recipes {source_by_name[template.name]} and {name} are both called "
                f"{template.name!r} and would write to the same folders: leave one out, or give "
                f"it another name"
            )
        source_by_name[template.name] = name
        count = template.variants if variants is None else variants
        recipes += [scaled_recipe(template.resolve(number), scale) for number in range(count)]
    return recipes


def _with_quality(
    recipe: Recipe, scene: Scene, options: RenderOptions, path: Sequence[Frame] | None
) -> Recipe:
    """Return the recipe with the settings of its quality. A note names chosen settings."""
    if not recipe.has_open_choice:
        return recipe
    resolved = choose_settings(
        open_store(options.out),
        recipe,
        scene,
        backend=choose_backend(options.backend, scene),
        camera_path=path,
        choose_again=options.overwrite,
        progress=True,
    )
    settings = [f"{k.path} {section_at(resolved, k.path)}" for k in free_knobs(recipe)]
    print_note(
        f"{variant_name(recipe)}: quality {recipe.quality.summary} chose {', '.join(settings)}"
    )
    return resolved
