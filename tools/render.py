"""`climategs render`, `demo` and `generate`: recipes and scenes become jobs, and jobs images."""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import shlex
import signal
import tempfile
import time
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from adapters.base import expand_job_scenes, open_scene
from adapters.camera_files.paths import frames_from_path_file
from adapters.scene_cache import scene_digest
from augment import effects
from augment.dataset.label_files import NothingLabelled
from augment.effects.lidar.sweep import weathered_sweep
from augment.errors import ClimateGSError
from augment.jobs.block_worker import JobWorkerSetup
from augment.jobs.blocks import JobStatus, read_status, select_shard
from augment.jobs.generate import GenerateJob, default_scratch, plan_job, run_generate
from augment.jobs.render_job import RenderJob, run_job
from augment.jobs.time_shares import compute_time_shares
from augment.output.layout import STATE_FOLDER, variant_name
from augment.output.manifest import lidar_notes
from augment.output.store import open_store
from augment.photo.trust import judge_scene, skipped_cameras_sentence, unfitted_cameras
from augment.render.backends import choose_backend, renders_on_gpu
from augment.render.buffers import CPU, CUDA
from augment.render.cuda.runtime import is_interpreted
from augment.scene.boxes import WorldBoxes, find_occlusion
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import rigid
from augment.scene.labels import Boxes, LidarSweep
from augment.scene.scene import Gaussians, Ground, Scene
from augment.scene.scene_index import SceneIndex, check_frames, has_lidar
from augment.scene.sky import CubemapSky
from augment.view.box_labels import uses_boxes
from augment.view.plan import make_plan
from augment.view.quality import choose_settings, recipes_to_try
from augment.view.render_view import render_view
from recipes.fields import section_at
from recipes.job import load_job, load_job_recipes, scaled_recipe
from recipes.load import load_recipe, read_overrides
from recipes.schema import Recipe, free_knobs, parse_frames
from tools.drawing import draw_sheet, draw_video, write_rgb
from tools.export import clear_notes, label_files, mirror_outputs, recipes_for_source
from tools.options import FITTED, names_in
from tools.output import (
    LABELS_OF_STORES,
    compiling_noted,
    duration_text,
    fill,
    print_images,
    print_note,
)

if TYPE_CHECKING:
    from tools.cli import GenerateOptions, RenderOptions

DEMO_RECIPES = ("clear", "dense-fog", "street-flood", "fresh-snow", "evening")
DEMO_CAMERA = "front"  # the one that is shown as a video
_MAX_LINES = 20  # of scenes and recipes
# Of the scene that kernels are compiled with.
SIZE = 32  # pixels a side
ACROSS = 10  # the number of the road's splats to each side
SPACING_M = 0.1  # the distance between two of these splats, in metres


def warm_up(recipes: Sequence[Recipe], backend: str = CPU) -> None:
    """Compile the kernels that the recipes take, or load them."""
    if not renders_on_gpu(backend):
        _warm_recipes(recipes)
    elif not is_interpreted():  # there is nothing to compile then, and drawing takes long
        _warm_recipes(recipes, CUDA)


def warm_up_for_workers(recipes: Sequence[Recipe], backend: str) -> None:
    """Compile kernels for other processes, which find them in the caches on disk. See `warm_up`.

    A GPU is used in a process of its own: this one would hold a part of its memory until it ends.
    """
    on_gpu = renders_on_gpu(backend)
    with compiling_noted(kernel_modules(recipes, backend), on_gpu=on_gpu):
        if not on_gpu:
            warm_up(recipes)
            return
        spawn = multiprocessing.get_context("spawn")
        process = spawn.Process(target=warm_up, args=(recipes, backend))
        process.start()
        process.join()


def kernel_modules(
    recipes: Sequence[Recipe], backend: str = CPU, *, of_street: bool = False
) -> list[str]:
    """How the names of modules begin that hold the recipes' kernels for the CPU. of_street: and
    those that build the procedural street.
    """
    street = ["adapters.street"] if of_street else []
    if renders_on_gpu(backend):
        return street
    present_effects = [
        e for e in effects.EFFECTS if any(e.section_of(recipe) is not None for recipe in recipes)
    ]
    folders = {
        folder
        for effect in present_effects
        for folder in (type(effect).__module__.removesuffix(".effect"), *effect.kernel_folders)
    }
    pictures = (f"augment.render.{name}" for name in ("cpu", "composite_kernels"))
    passes = ["augment.render.picture_kernels"] if any(map(_alters_picture, recipes)) else []
    return [*street, "augment.scene", *pictures, *passes, *sorted(folders)]


def _alters_picture(recipe: Recipe) -> bool:
    """True if airlight by elevation, scatter or a camera's noise pass over the recipe's picture."""
    smog = recipe.weather.smog
    of_smog = smog is not None and (smog.scatter > 0 or smog.overcast > 0)
    return recipe.camera.noise > 0 or of_smog


def _warm_recipes(recipes: Sequence[Recipe], backend: str = CPU) -> None:
    kernel_sets = set()
    if any(uses_boxes(recipe) for recipe in recipes):
        no_boxes = WorldBoxes.from_labels(Boxes.empty(), np.zeros(3))
        find_occlusion(no_boxes, _camera(1.0), np.zeros((SIZE, SIZE), np.float32))
    for recipe in recipes:
        output = recipe.output
        sections = ((effect, effect.section_of(recipe)) for effect in effects.EFFECTS)
        effect_kernels = tuple(
            e.kernel_key(section) if section is not None else None for e, section in sections
        )
        for_boxes = uses_boxes(recipe) and output.depth == "none"
        ids = output.semantic or output.instance
        base = recipe.render.base
        kernels = (
            *effect_kernels,
            base,
            output.depth,
            ids,
            output.surface,
            for_boxes,
            recipe.lidar,
        )
        if kernels not in kernel_sets:
            kernel_sets.add(kernels)
            with tempfile.NamedTemporaryFile(suffix=".png") as photo:
                write_rgb(Path(photo.name), np.zeros((SIZE, SIZE, 3), np.uint8))
                _warm_recipe(recipe, photo.name, backend)


def _warm_recipe(recipe: Recipe, photo: str, backend: str) -> None:
    scene = _warm_up_scene(0.0, photo, with_labels=False)
    effect_plans = make_plan(recipe, scene).effect_plans.values()
    level_z_m = next((p.water_level_z_m for p in effect_plans if p.water_level_z_m), 0.0)
    scene = _warm_up_scene(level_z_m, photo, with_labels=recipe.output.labels)
    render_view(scene, scene.frames[0].cameras["warm-up"], recipe, backend=backend)
    if recipe.lidar == "weather":
        weathered_sweep(scene, recipe, 0, _one_return(level_z_m))


def _warm_up_scene(level_z_m: float, photo: str, *, with_labels: bool) -> Scene:
    """Return a scene of a level road above a flood's surface, and a splat below it."""
    across = torch.arange(-ACROSS, ACROSS + 1) * SPACING_M
    x, y = torch.meshgrid(across + 4, across, indexing="ij")
    road = torch.stack([x.flatten(), y.flatten(), torch.full((x.numel(),), level_z_m + 0.1)], 1)
    means = torch.cat([road, torch.tensor([[4.0, 0.0, level_z_m - 0.1]])])
    gaussians = Gaussians(
        means=means,
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(len(means), 1),
        scales=torch.tensor([[SPACING_M, SPACING_M, 0.02]]).repeat(len(means), 1),
        opacities=torch.full((len(means),), 0.9),
        sh=torch.zeros(len(means), 1, 3),
    )
    sky = CubemapSky(torch.zeros(6, 2, 2, 3))
    camera = _camera(level_z_m + 1.0)
    world_from_ego = torch.eye(4, dtype=torch.float64)
    frame = Frame(0, 0, world_from_ego, {camera.name: camera}, {camera.name: photo})
    return Scene(
        "warm-up",
        "warm-up",
        gaussians,
        (),
        sky,
        (frame,),
        labels=_NoLabels() if with_labels else None,
        ground_z_m=0.0,  # smog that thins with height asks for it
        ground=Ground(0.0, 0.0, "stated"),
    )


class _NoLabels:
    """An empty set of labels, so that everything that labels need is drawn."""

    def boxes(self, frame_index: int) -> Boxes:
        return Boxes.empty()

    def lidar(self, frame_index: int) -> LidarSweep | None:
        return None


def _one_return(z_m: float) -> LidarSweep:
    """Return a sweep with one return, from the road ahead."""
    return LidarSweep({"x": np.array([4.0]), "y": np.array([0.0]), "z": np.array([z_m])})


def _camera(z_m: float) -> Camera:
    """Return a level camera that looks ahead along +x."""
    rotation = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]], dtype=torch.float64)
    centre = torch.tensor([0.0, 0.0, z_m], dtype=torch.float64)
    pose = rigid(rotation, -rotation @ centre)
    return Camera("warm-up", SIZE, SIZE, 20.0, 20.0, SIZE / 2, SIZE / 2, pose)


def generate_dataset(options: GenerateOptions) -> int:
    """Run the job and print its result. Return the exit code: 1 if images failed."""
    job = options.job
    out = options.out
    backend = options.backend
    assert job is not None
    requested = load_job(job)
    recipes = load_job_recipes(requested, job.parent)
    store = open_store(out)
    number, count = map(int, options.shard.split("/"))
    setup = JobWorkerSetup(
        store_uri=out if store.local_dir is None else store.uri,
        scratch_dir=options.scratch or default_scratch(out),
        backend=backend,
        open_scene=open_scene,
        scene_digest=scene_digest,
    )
    task = GenerateJob(
        recipes,
        expand_job_scenes(requested.scenes, job.parent),
        setup,
        executor=options.executor,
        workers=options.workers,
        shard=(number, count),
        reopens_scenes=options.rescan,
    )
    if options.dry_run:
        return _dry_run(task)
    # Learn that an output cannot be written before scenes are opened, which may take hours.
    probe = f"{STATE_FOLDER}/probe-{uuid.uuid4().hex}"
    store.write(probe, b"")
    store.delete([probe])
    with ended_by_sigterm():
        result = run_generate(task, prepare=lambda recipes: warm_up_for_workers(recipes, backend))
    print_images(result, duration_text(result.seconds))
    if shares := compute_time_shares(result.timings):
        print(shares.sentence)
    for uri, why in result.unusable.items():
        print_note(f"cannot be used: {uri}: {why}")
    firsts = [template.resolve(0) for template in recipes.templates.values()]
    if store.local_dir is not None:
        _write_labels(store.local_dir, firsts, result.written + result.skipped)
    elif any(recipe.output.label_formats for recipe in firsts):
        print_note(f"note: labels for trainers need the images on this machine; {LABELS_OF_STORES}")
    print(f"output: {out}   (climategs report {shlex.quote(out)} shows it)")
    return 1 if result.failed or result.unusable else 0


def show_status(out: str) -> int:
    """Print the progress of an output's jobs. Return the exit code: 1 for unfinished jobs.

    Raises:
        ClimateGSError: no job was ever started there.
    """
    statuses = read_status(open_store(out))
    if not statuses:
        raise ClimateGSError(f"{out}: no job has been started there (no .climategs/jobs)")
    for status in statuses:
        print(_status_text(status))
    return 0 if all(_is_done(status) for status in statuses) else 1


def _dry_run(job: GenerateJob) -> int:
    from augment.jobs.estimate import estimate_job

    plan = plan_job(job)
    page = fill(
        "plan.txt",
        plan=plan,
        recipes=len({block.recipe.name for block in plan.blocks}),
        variants=len({(block.scene, block.variant) for block in plan.blocks}),
        shard=job.shard,
        blocks=select_shard(plan.blocks, *job.shard),
        max_lines=_MAX_LINES,
    )
    print(page)
    guess = estimate_job(plan, open_scene, on_recipe=lambda name: print_note(f"trying {name}"))
    for name, sample in guess.samples.items():
        print(
            f"  {name}: {sample.seconds_per_mpx:.2f} s and {_size(sample.bytes_per_mpx)} a "
            f"megapixel, {sample.prepare_s:.1f} s to prepare"
        )
    if guess.unsampled_recipes:
        print(f"  taken as their mean: {', '.join(guess.unsampled_recipes)}")
    print(
        f"about {duration_text(guess.seconds)} of one worker, {_size(guess.bytes)} "
        f"(from one picture a recipe; right to a factor of two or so)"
    )
    return 1 if plan.unusable else 0


def _status_text(status: JobStatus) -> str:
    unfinished = {
        kind: [(name, g) for name, g in groups.items() if g.published < g.planned]
        for kind, groups in (("scene", status.by_scene), ("recipe", status.by_recipe))
    }
    left = duration_text(status.remaining_s) if status.remaining_s and not _is_done(status) else ""
    return fill("status.txt", status=status, left=left, unfinished=unfinished, max_lines=_MAX_LINES)


def _is_done(status: JobStatus) -> bool:
    total = status.total
    return total.published == total.planned and not total.in_failed_blocks and not status.unusable


@contextlib.contextmanager
def ended_by_sigterm() -> Iterator[None]:
    """Let a scheduler's SIGTERM end the job as Ctrl-C does."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    previous_handler = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous_handler)


def _size(count: float) -> str:
    steps = ("B", "kB", "MB", "GB", "TB")
    step = min(int(math.log(max(count, 1), 1000)), len(steps) - 1)
    return f"{count / 1000**step:.1f} {steps[step]}"


def render_recipes(options: RenderOptions) -> int:
    """Run the job and print its result. Return the exit code: 1 if images failed."""
    out = options.out
    backend = options.backend
    recipes = resolve_recipes(options.recipes, options.variants, options.scale, options.overrides)
    trial_recipes = [recipe for resolved in recipes for recipe in recipes_to_try(resolved)]
    on_gpu = renders_on_gpu(backend)
    of_street = options.scene.startswith("procedural:")
    with compiling_noted(kernel_modules(trial_recipes, backend, of_street=of_street)):
        scene = open_scene(options.scene)
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
        make_plan(resolved, scene)  # refuse once, not for every image
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
        scene_uri=options.scene,
        recipes=recipes,
        out_dir=out,
        frames=frame_numbers,
        cameras=cameras,
        camera_path=path,
        workers=options.workers,
        backend=backend,
        overwrite=options.overwrite,
        source_digest=scene_digest(options.scene),
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
    _write_labels(out, recipes, result.written + result.skipped)
    if options.layout == "source":
        names = [variant_name(resolved) for resolved in recipes]
        for sentence in mirror_outputs(scene, out, variants=names, links=options.links):
            print(sentence)
    if options.sheet and result.written + result.skipped:
        print(f"pictures: {draw_sheet(out)}")
    return 1 if result.failed else 0


def _write_labels(out: Path, recipes: Sequence[Recipe], images: int) -> None:
    """Write the labels for trainers, where a recipe asks for them."""
    if not images or not any(recipe.output.label_formats for recipe in recipes):
        return
    try:
        print("\n".join(label_files(out)))
    except NothingLabelled as error:  # the scenes have no boxes, say
        print_note(f"note: {error}")


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
    if not recipe.quality.has_open_choice:
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


def run_demo(out: Path, frames: int) -> int:
    """Render the embedded street under five recipes, with pictures. Return the exit code."""
    start_s = time.perf_counter()
    uri = f"procedural:street?seed=3&frames={frames}"
    print_note(f"building {uri}")
    recipes = [load_recipe(name).resolve(0) for name in DEMO_RECIPES]
    with compiling_noted(kernel_modules(recipes, of_street=True)):
        scene = open_scene(uri)
        warm_up(recipes)
    ready_s = time.perf_counter()
    job = RenderJob(uri, recipes, out, source_digest=scene_digest(uri))
    result = run_job(job, scene_loader=lambda _uri: scene)
    for failure in result.failures:
        print_note(f"failed: {failure}")
    pictures = [draw_sheet(out), draw_video(out, DEMO_CAMERA, frames_per_second=5)]
    end_s = time.perf_counter()
    print(
        f"{result.written} images written, {result.skipped} already there, {result.failed} failed: "
        f"{ready_s - start_s:.0f} s to build and compile, "
        f"{end_s - ready_s:.0f} s to render and draw"
    )
    print(f"images, depth, labels, LiDAR: {out}")
    print(f"contact sheet:                {pictures[0]}")
    print(f"video, variants side by side: {pictures[1]}")
    return 1 if result.failed else 0
