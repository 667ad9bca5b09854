"""Scenes, cameras and recipes that several subjects of `climategs bench` measure."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from adapters.base import open_scene
from augment.cameras import Camera
from augment.effects.snow.snow import placement_settings
from augment.effects.snow.support import remember_support, support_of
from augment.effects.style.style import remember_maps, style_maps
from augment.geometry import rigid
from augment.jobs.layout import folder_name, variant_name
from augment.jobs.render_job import RenderJob, run_job
from augment.plan import make_plan
from augment.render.sh import SH_C0
from augment.scene import Gaussians, Scene
from augment.views import render_buffers
from recipes.schema import Output, Recipe, Smog, Weather
from recipes.weather import Flood, Snow, Style, Waves

ZOOMS = (1.0, 0.8, 1.25, 1.6, 2.0, 2.5)  # the first that is near is taken
NEAR_SHARE = 0.05  # of the image; as much off is about a third, too
FOCAL_PER_WIDTH = 0.8125  # 520 px at 640, 1300 px at 1600


@dataclass(frozen=True)
class RasterCase:
    """One size of the random scene. count: Gaussians. width, height: pixels."""

    count: int
    width: int
    height: int

    @property
    def name(self) -> str:
        multiples = {"M": 1_000_000, "k": 1_000, "": 1}
        suffix = next(s for s, multiple in multiples.items() if self.count % multiple == 0)
        return f"{self.count // multiples[suffix]}{suffix}@{self.width}x{self.height}"


SMALL_CASE, LARGE_CASE = RasterCase(100_000, 640, 480), RasterCase(1_000_000, 1600, 1066)


def random_scene(case: RasterCase, *, seed: int = 0) -> tuple[Gaussians, Camera]:
    """Gaussians with SH of degree 3 spread evenly over a view, and its camera.

    Depth is uniform in 2 to 20 m, x and y within 1.1 of the frustum, each scale exp of a uniform
    logarithm between 4 and 60 mm, rotations uniform, opacity Beta(0.9, 1.2) clipped to [0.005, 1].
    """
    rng = np.random.default_rng(seed)
    count, focal = case.count, FOCAL_PER_WIDTH * case.width
    z = rng.uniform(2, 20, count)
    x = rng.uniform(-1.1, 1.1, count) * z * (case.width / 2 / focal)
    y = rng.uniform(-1.1, 1.1, count) * z * (case.height / 2 / focal)
    scales = np.exp(rng.uniform(math.log(0.004), math.log(0.06), (count, 3)))
    quats = rng.normal(size=(count, 4))
    opacities = np.clip(rng.beta(0.9, 1.2, count), 0.005, 1)
    sh = rng.normal(0, 0.1, (count, 16, 3))
    sh[:, 0] = (rng.uniform(0, 1, (count, 3)) - 0.5) / SH_C0
    fields = {
        "means": np.stack([z, -x, -y], -1),  # the camera looks along +x, z is up
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "scales": scales,
        "opacities": opacities,
        "sh": sh,
    }
    gaussians = Gaussians(**{k: torch.from_numpy(v.astype(np.float32)) for k, v in fields.items()})
    rotation = torch.tensor([[0, -1, 0], [0, 0, -1], [1, 0, 0]], dtype=torch.float64)
    pose = rigid(rotation, torch.zeros(3, dtype=torch.float64))
    centre = (case.width / 2, case.height / 2)
    return gaussians, Camera("bench", case.width, case.height, focal, focal, *centre, pose)


def street_uri(frames: int = 1, gaussians: int | None = None) -> str:
    size = "" if gaussians is None else f"&gaussians={gaussians}"
    return f"procedural:street?seed=3&frames={frames}{size}"


def front_name(names: Sequence[str]) -> str:
    """The shortest with `front` in it, or the first."""
    return min((name for name in names if "front" in name), key=len, default=names[0])


def front_camera(scene: Scene, width: int | None = None) -> Camera:
    """That of the middle frame, by default of its own size."""
    cameras = scene.frames[len(scene.frames) // 2].cameras
    camera = cameras[front_name([*cameras])]
    return camera if width is None else camera.scaled(width / camera.width)


def water_camera(scene: Scene, width: int, height: int, backend: str = "auto") -> Camera:
    """`front_camera`, zoomed where less or more than about a third of the image is water."""
    own, choice = front_camera(scene), []
    plan = make_plan(flood_recipe("sky"), scene)
    for zoom in ZOOMS:
        scale = zoom * width / own.width
        cx, cy = (
            size / 2 + scale * off
            for size, off in ((width, own.cx - own.width / 2), (height, own.cy - own.height / 2))
        )
        size = {"width": width, "height": height, "cx": cx, "cy": cy}
        camera = dataclasses.replace(own, fx=own.fx * scale, fy=own.fy * scale, **size)
        water = render_buffers(scene, camera.scaled(0.125), plan, backend=backend).water
        off = abs((0.0 if water is None else float(water.float().mean())) - 1 / 3)
        if off <= NEAR_SHARE:
            return camera
        choice.append((off, camera))
    return min(choice, key=lambda entry: entry[0])[1]


PICTURE_ONLY = Output(depth="none", labels=False)


def flood_recipe(
    reflection: str = "mirrored",
    waves: str = "still",
    *,
    output: Output = PICTURE_ONLY,
    **flood: Any,
) -> Recipe:
    """Water 25 cm above the median road, the middle one of a drive that may have a slope."""
    fields = {"level_m": 0.25, "reference": "median", "reflection": reflection, **flood}
    water = Flood.model_validate({**fields, "waves": Waves.model_validate({"preset": waves})})
    return Recipe(weather=Weather(flood=water), output=output)


def snow_recipe(
    shading: str | None = "per_splat",
    *,
    cell_m: float = 0.05,
    output: Output = PICTURE_ONLY,
    **weather: Any,
) -> Recipe:
    """10 cm of snow; shading: None for none. weather: what else the recipe has."""
    if shading is not None:
        fields = {"depth_m": 0.1, "shading": shading, "cell_m": cell_m}
        weather["snow"] = Snow.model_validate(fields)
    return Recipe(weather=Weather(**weather), output=output)


def smog_recipe(visibility_m: float = 200) -> Recipe:
    return Recipe(weather=Weather(smog=Smog(visibility_m=visibility_m)), output=PICTURE_ONLY)


def style_recipe(preset: str = "overcast", **style: Any) -> Recipe:
    return Recipe(style=Style.model_validate({"preset": preset, **style}), output=PICTURE_ONLY)


def record_street(
    folder: Path,
    recipe: Recipe,
    *,
    scale: float = 1.0,
    cameras: Sequence[str] | None = None,
    frames: int,
    gaussians: int,
) -> tuple[Scene, Path]:
    """The procedural street, and the folder of one variant of it that a job has written."""
    scene = open_scene(street_uri(frames, gaussians))
    recipe = recipe.model_copy(update={"render": recipe.render.model_copy(update={"scale": scale})})
    job = RenderJob(scene.source, [recipe], folder, cameras=cameras)
    run_job(job, scene_loader=lambda _: scene)
    return scene, folder / folder_name(scene.name) / variant_name(recipe)


def scene_of_recipe(scene: Scene, recipe: Recipe, backend: str = "auto") -> Scene:
    """A scene of the same arrays that remembers a recipe's snow and style maps, as long as it
    lives: only a few are kept at a time, and none may be found anew between two timed frames.
    """
    own = dataclasses.replace(scene)
    snow, style = recipe.weather.snow, recipe.style
    if snow is not None:
        settings = placement_settings(snow)
        remember_support(own, settings, support_of(scene, settings, backend=backend))
    if style is not None:
        usual = style.model_copy(update={"evaluated": "color"})
        remember_maps(own, style, style_maps(scene, usual))
    return own
