"""Scenes, cameras and recipes that several subjects of `climategs bench` measure."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from adapters.base import open_scene
from augment.jobs.render_job import RenderJob, run_job
from augment.output.layout import variant_name
from augment.output.names import folder_name
from augment.render.sh import SH_C0
from augment.scene.cameras import Camera
from augment.scene.geometry import rigid
from augment.scene.scene import Gaussians, Scene
from augment.view.plan import make_plan
from augment.view.render_view import render_buffers
from recipes.schema import Output, Recipe, Weather
from tools.bench.harness import Action

# The zooms that `water_camera` tries, in order. It takes the first whose share of water is right.
ZOOMS = (1.0, 0.8, 1.25, 1.6, 2.0, 2.5)
NEAR_SHARE = 0.05  # The largest error of the share of water in the image, which shall be a third.
SMALL = 0.125  # The scale of frames that load kernels, or look for water.
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
