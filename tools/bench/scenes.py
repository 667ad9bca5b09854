"""Scenes, cameras and recipes that several subjects of `climategs bench` measure.

`cost_tables` measures the cost of an effect: its frames in turns with clean frames. The modules of
effects (`smog.py`, `flood.py`, `snow.py`, `rain.py`, `style.py`) add tables of their errors.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from adapters.base import open_scene, parse_uri
from adapters.procedural import StreetTruth, open_truth
from augment.jobs.render_job import RenderJob, run_job
from augment.output.layout import folder_name, variant_name
from augment.render.sh import SH_C0
from augment.scene.cameras import Camera
from augment.scene.geometry import rigid
from augment.scene.scene import Gaussians, Scene
from augment.timing import stopwatch
from augment.view.plan import make_plan
from augment.view.render_view import render_buffers
from recipes.schema import Output, Recipe, Weather
from tools.bench.harness import (
    Action,
    Figures,
    Table,
    figures,
    machine_facts,
    median_ms,
    peak_mib_in_subprocess,
    rounds,
    spread_ratio,
)

# The zooms that `water_camera` tries, in order. It takes the first whose share of water is right.
ZOOMS = (1.0, 0.8, 1.25, 1.6, 2.0, 2.5)
NEAR_SHARE = 0.05  # The largest error of the share of water in the image, which shall be a third.
# The focal length of the random scene's camera by the image's width: 520 px at 640 px.
FOCAL_PER_WIDTH = 0.8125


@dataclass(frozen=True)
class RasterCase:
    """One size of the random scene."""

    count: int
    """The number of Gaussians."""
    width: int
    """The width of the image, pixels."""
    height: int
    """The height of the image, pixels."""

    @property
    def name(self) -> str:
        """The size in short: "100k@640x480"."""
        multiples = {"M": 1_000_000, "k": 1_000, "": 1}
        suffix = next(s for s, multiple in multiples.items() if self.count % multiple == 0)
        return f"{self.count // multiples[suffix]}{suffix}@{self.width}x{self.height}"


SMALL_CASE = RasterCase(100_000, 640, 480)  # The smaller of the usual sizes.
LARGE_CASE = RasterCase(1_000_000, 1600, 1066)  # The larger of the usual sizes.


def random_scene(case: RasterCase, *, seed: int = 0) -> tuple[Gaussians, Camera]:
    """Return random Gaussians with SH of degree 3, spread evenly over a view, and its camera.

    Depth is uniform in 2 to 20 m, x and y within 1.1 of the frustum, each scale exp of a uniform
    logarithm between 4 and 60 mm, rotations uniform, opacity Beta(0.9, 1.2) clipped to [0.005, 1].
    """
    rng = np.random.default_rng(seed)
    count = case.count
    focal = FOCAL_PER_WIDTH * case.width
    z = rng.uniform(2, 20, count)
    x = rng.uniform(-1.1, 1.1, count) * z * (case.width / 2 / focal)
    y = rng.uniform(-1.1, 1.1, count) * z * (case.height / 2 / focal)
    scales = np.exp(rng.uniform(math.log(0.004), math.log(0.06), (count, 3)))
    quats = rng.normal(size=(count, 4))
    opacities = np.clip(rng.beta(0.9, 1.2, count), 0.005, 1)
    sh = rng.normal(0, 0.1, (count, 16, 3))
    sh[:, 0] = (rng.uniform(0, 1, (count, 3)) - 0.5) / SH_C0
    means = np.stack([z, -x, -y], -1)  # the camera looks along +x, z is up
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    fields = (means, quats, scales, opacities, sh)
    gaussians = Gaussians(*(torch.from_numpy(field.astype(np.float32)) for field in fields))
    rotation = torch.tensor([[0, -1, 0], [0, 0, -1], [1, 0, 0]], dtype=torch.float64)
    pose = rigid(rotation, torch.zeros(3, dtype=torch.float64))
    centre = (case.width / 2, case.height / 2)
    return gaussians, Camera("bench", case.width, case.height, focal, focal, *centre, pose)


def street_uri(frames: int = 1, gaussians: int | None = None) -> str:
    """Return the address of the procedural street. gaussians: None for the street's default."""
    size = "" if gaussians is None else f"&gaussians={gaussians}"
    return f"procedural:street?seed=3&frames={frames}{size}"


def front_name(names: Sequence[str]) -> str:
    """Return the shortest name that contains `front`, or else the first name."""
    return min((name for name in names if "front" in name), key=len, default=names[0])


def front_camera(scene: Scene, width: int | None = None) -> Camera:
    """Return the front camera of the middle frame, by default at its own size."""
    cameras = scene.frames[len(scene.frames) // 2].cameras
    camera = cameras[front_name([*cameras])]
    return camera if width is None else camera.scaled(width / camera.width)


def all_cameras(scene: Scene) -> list[Camera]:
    """Return the cameras of all frames."""
    return [camera for frame in scene.frames for camera in frame.cameras.values()]


def water_camera(scene: Scene, width: int, height: int, backend: str = "auto") -> Camera:
    """Return `front_camera`, zoomed until about a third of the image is water."""
    front = front_camera(scene)
    candidates = []
    recipe = recipe_of({"flood": {**WATER, "reflection": "sky", "waves": {"preset": "still"}}})
    for zoom in ZOOMS:
        scale = zoom * width / front.width
        cx, cy = (
            size / 2 + scale * off
            for size, off in (
                (width, front.cx - front.width / 2),
                (height, front.cy - front.height / 2),
            )
        )
        size = {"width": width, "height": height, "cx": cx, "cy": cy}
        camera = dataclasses.replace(front, fx=front.fx * scale, fy=front.fy * scale, **size)
        water = frame_of(scene, camera.scaled(SMALL), recipe, backend)().masks.get("water")
        off = abs((0.0 if water is None else float(water.float().mean())) - 1 / 3)
        if off <= NEAR_SHARE:
            return camera
        candidates.append((off, camera))
    return min(candidates, key=lambda entry: entry[0])[1]


# ---- recipes ------------------------------------------------------------------------------------

PICTURE_ONLY = Output(depth="none", labels=False)  # The outputs of a timed frame.
CLEAN = Recipe(output=PICTURE_ONLY)  # The recipe without effects.
# The fields of a flood 25 cm above the median height of the road. A drive may have a slope.
WATER = {"level_m": 0.25, "reference": "median"}


def recipe_of(effects: Mapping[str, Any], output: Output = PICTURE_ONLY) -> Recipe:
    """Return a recipe with some effects.

    Args:
        effects: The fields of each effect, by its name.
        output: The outputs of the recipe.
    """
    weather = {name: fields for name, fields in effects.items() if name in Weather.model_fields}
    other_sections = {name: fields for name, fields in effects.items() if name not in weather}
    return Recipe.model_validate({"weather": weather, "output": output, **other_sections})


def frame_of(scene: Scene, camera: Camera, recipe: Recipe, backend: str = "auto") -> Action:
    """Return an action that renders a view as floats, by a plan that is made once."""
    plan = make_plan(recipe, scene)
    return functools.partial(render_buffers, scene, camera, plan, backend=backend)


def record_street(
    folder: Path,
    recipe: Recipe,
    *,
    scale: float = 1.0,
    frames: int,
    gaussians: int,
    cameras: Sequence[str] | None = None,
) -> tuple[Scene, Path]:
    """Run a job on the procedural street.

    Args:
        folder: The output folder.
        recipe: The recipe of the images.
        scale: The scale of the images.
        frames: The number of frames.
        gaussians: The number of Gaussians of the street.
        cameras: The names of the cameras; None for all.

    Returns:
        The scene, and the folder of the job's only variant.
    """
    scene = open_scene(street_uri(frames, gaussians))
    recipe = recipe.model_copy(update={"render": recipe.render.model_copy(update={"scale": scale})})
    job = RenderJob(scene.source, [recipe], folder, cameras=cameras)
    run_job(job, scene_loader=lambda _: scene)
    return scene, folder / folder_name(scene.name) / variant_name(recipe)


# ---- the cost of an effect ----------------------------------------------------------------------

SMALL = 0.125  # The scale of the frame that loads kernels before memory is measured.
# The recipe with an effect and the clean recipe that it is compared with, by the case's name.
Cases = Mapping[str, tuple[Recipe, Recipe]]


@dataclass(frozen=True)
class EffectCase:
    """Scenes and sizes of an effect's measurements."""

    scenes: tuple[str, ...] = (street_uri(gaussians=1_000_000),)  # scenes that measure its cost
    width: int = 1600  # pixels of the images that measure its cost
    height: int = 1066  # pixels, likewise
    street: str = street_uri(6)  # procedural scene that measures errors: its truth is known
    frames: tuple[int, ...] = (0, 5)  # frames of the street's views
    cameras: tuple[str, ...] = ("front", "left", "back")  # cameras of the street's views
    scale: float = 1.0  # scale of the street's views
    cell_m: float = 0.05  # metres of a snow cell near the path
    splats: int = 1_000_000  # splats whose SH a style maps
    presets: tuple[str, ...] = ()  # styles whose pictures are compared; empty for all
    photos: Path | None = None  # folder that style methods are scored on
    memory: bool = True  # whether memory is measured

    def open_street(self) -> tuple[Scene, StreetTruth]:
        """Return the street and its exact surfaces."""
        return open_scene(self.street), open_truth(parse_uri(self.street)[2])

    def views(self, street: Scene, scale: float = 1.0) -> list[Camera]:
        """Return the cameras of the street's views. scale: on top of the case's."""
        return [
            street.frame(frame).cameras[name].scaled(self.scale * scale)
            for frame in self.frames
            for name in self.cameras
        ]


FULL_CASE = EffectCase()  # The case of published figures.
# The case of `--quick`.
QUICK_CASE = EffectCase(
    (street_uri(),),
    800,
    533,
    street_uri(2, 120_000),
    (0,),
    ("front",),
    scale=0.5,
    cell_m=0.1,
    splats=200_000,
    presets=("overcast", "golden-hour"),
)


def measure_effect(
    effect: str, repeats: int, case: EffectCase, scene: str | None = None
) -> Figures:
    """Measure one effect.

    Args:
        effect: The name of a module of this folder.
        repeats: The number of rounds that count.
        case: The scenes and sizes.
        scene: The address of a further scene in which the effect's cost is measured.
    """
    machine = machine_facts()
    scenes = (*case.scenes, *([scene] if scene else []))
    subject = importlib.import_module(f"tools.bench.{effect}")
    tables = subject.tables(dataclasses.replace(case, scenes=scenes), repeats)
    return figures(effect, tables, machine=machine)


def cost_tables(case: EffectCase, cases: Cases, staged: Sequence[str], repeats: int) -> list[Table]:
    """Measure the frames of every case in turns with clean frames, for every scene.

    Args:
        case: The scenes and sizes.
        cases: The recipes.
        staged: The names of cases whose stages and memory are shown.
        repeats: The number of rounds that count.
    """
    tables: list[Table] = []
    for uri in case.scenes:
        scene = open_scene(uri)
        camera = water_camera(scene, case.width, case.height)
        rows = []
        stages = {}
        for name, (recipe, clean) in tqdm(cases.items(), "frames", leave=False):
            pair = {"effect": recipe, "clean": clean}
            seconds, stage_times = time_frames(scene, camera, pair, repeats)
            ratio = spread_ratio(seconds["effect"], seconds["clean"]).values()
            clean_ms = median_ms(seconds["clean"])
            effect_ms = median_ms(seconds["effect"])
            rows.append([name, clean_ms, effect_ms, *ratio])
            if name in staged:
                stages.setdefault("clean", {**stage_times["clean"], "whole": clean_ms})
                stages[name] = {**stage_times["effect"], "whole": effect_ms}
        names = dict.fromkeys(s for stage_ms in stages.values() for s in stage_ms if s != "whole")
        shown_stages = [
            s for s in names if any(stage_ms.get(s, 0) >= 0.1 for stage_ms in stages.values())
        ]
        by_stage = [
            [s, *(stage_ms.get(s) for stage_ms in stages.values())]
            for s in (*shown_stages, "whole")
        ]
        count = sum(len(part.gaussians) for part in scene.parts_for(camera))
        title = f"Frames: {uri}, {count:,} Gaussians, {camera.name} {case.width}x{case.height}"
        columns = ("case", "clean ms", "with it ms", "ratio", "least", "p90")
        tables.append(Table(title, columns, rows))
        tables.append(Table("Stages, ms; those below 0.1 left out", ("stage", *stages), by_stage))
        if case.memory:
            recipes = {"clean": cases[staged[0]][1], **{name: cases[name][0] for name in staged}}
            size = (uri, case.width, case.height)
            mib = [[n, peak_mib_in_subprocess(_warm_frame, (*size, r))] for n, r in recipes.items()]
            tables.append(Table("Memory of a frame above its scene", ("case", "MiB"), mib))
    return tables


def time_frames(
    scene: Scene, camera: Camera, recipes: Mapping[str, Recipe], repeats: int, backend: str = "auto"
) -> tuple[dict[str, list[float]], dict[str, dict[str, float]]]:
    """Time frames of several recipes in turns, to finished floats.

    Returns:
        Seconds of every recipe's frames; medians of their stages in milliseconds, by recipe and
        stage.
    """
    stage_times: dict[str, list[dict[str, float]]] = {name: [] for name in recipes}

    def timed_frame(name: str, frame: Action) -> None:
        with stopwatch() as seconds:
            frame()
        stage_times[name].append(seconds)

    frames = {name: frame_of(scene, camera, recipe, backend) for name, recipe in recipes.items()}
    actions = {name: functools.partial(timed_frame, name, frame) for name, frame in frames.items()}
    return rounds(actions, repeats), {
        name: {
            stage: median_ms([lap.get(stage, 0.0) for lap in frame_stages[1:]])
            for stage in frame_stages[-1]
        }
        for name, frame_stages in stage_times.items()
    }


def _warm_frame(uri: str, width: int, height: int, recipe: Recipe) -> Action:
    """Return an action that draws a frame which was drawn small before.

    So the process already holds kernels, snow, maps and sky.
    """
    scene = open_scene(uri)
    camera = water_camera(scene, width, height)
    frame_of(scene, camera.scaled(SMALL), recipe)()
    return frame_of(scene, camera, recipe)
