"""Small views that together launch every kernel of the GPU backend, for when they are interpreted.

An interpreted kernel takes a millisecond for a line: the scene has some dozens of splats, and its
views one or a few tiles.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import torch

from augment.render.buffers import RGB
from augment.render.rasterize import rasterize
from augment.render.sh import SH_C0
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import rigid
from augment.scene.scene import Actor, Gaussians, Ground, PosedGaussians, Scene, Track
from augment.scene.semantics import SemanticClass
from augment.scene.sky import CubemapSky
from augment.view.render_view import render_view
from recipes.flood import Flood, Waves
from recipes.schema import Output, Recipe, Render, Smog, Weather
from recipes.snow import Snow
from recipes.speed import Speed
from recipes.style import Style

WIDTH, HEIGHT = 20, 12
_DENSE = 20.0  # metres of visibility: there is smog to see even here
_PLAIN = Output(depth="none", labels=False)

RECIPES = {
    "clean": Recipe(output=Output(semantic=True, instance=True)),
    "antialiased, stopped early": Recipe(
        render=Render(speed=Speed(antialiased=True, transmittance_stop=0.2)),
        output=Output(depth="expected", labels=False),
    ),
    "mode depth": Recipe(output=Output(depth="mode", labels=False)),
    "uniform smog": Recipe(weather=Weather(smog=Smog(visibility_m=_DENSE)), output=_PLAIN),
    "layered smog": Recipe(
        weather=Weather(smog=Smog(visibility_m=_DENSE, scale_height_m=9.0)), output=_PLAIN
    ),
    "smog on buffers": Recipe(
        weather=Weather(smog=Smog(visibility_m=_DENSE, model="deferred")), output=_PLAIN
    ),
    "flood": Recipe(
        weather=Weather(
            flood=Flood(
                level_m=0.2, reflection="screen_space", waves=Waves(preset="breeze", seed=1)
            )
        ),
        output=Output(depth="expected", labels=False),
    ),
    "flood, mirrored": Recipe(
        weather=Weather(flood=Flood(level_m=0.2, reflection="mirrored")), output=_PLAIN
    ),
    "flood, sky": Recipe(
        weather=Weather(flood=Flood(level_m=0.2, reflection="sky", fresnel="schlick")),
        output=_PLAIN,
    ),
    "snow, lit per pixel": Recipe(
        weather=Weather(snow=Snow(depth_m=0.1, cell_m=0.8, tracks="never", shading="per_pixel")),
        output=_PLAIN,
    ),
    "snow, close and glinting": Recipe(
        weather=Weather(
            snow=Snow(depth_m=0.1, cell_m=0.8, tracks="never", shading="per_splat", sparkle=1.0)
        ),
        output=_PLAIN,
    ),
    "style": Recipe(style=Style(preset="dusk", per_region=True), output=_PLAIN),
    "style folded into SH": Recipe(style=Style(preset="dusk", evaluated="sh"), output=_PLAIN),
}


def views(scene: Scene | None = None) -> dict[str, Callable[[], object]]:
    """What to do, by name, for its kernels to be launched."""
    scene = small_scene() if scene is None else scene
    camera = scene.frames[0].cameras["ahead"]

    def render(recipe: Recipe) -> Callable[[], object]:
        return lambda: render_view(scene, camera, recipe, backend="cuda")

    out: dict[str, Callable[[], object]] = {n: render(r) for n, r in RECIPES.items()}
    out["gradients of colours"] = lambda: _learn_colors(scene, camera)
    return out


def _learn_colors(scene: Scene, camera: Camera) -> None:
    """What training a style through the renderer asks for."""
    sh = scene.background.sh.clone().requires_grad_()
    part = PosedGaussians(dataclasses.replace(scene.background, sh=sh))
    out = rasterize([part], camera, buffers=(RGB,), backend="cuda")
    assert out.rgb is not None
    out.rgb.sum().backward()


def small_scene() -> Scene:
    """Ground ahead, a wall and a box on it that drives, with colours that change with the view."""
    ground = _grid((1.5, 7.0), (-1.5, 1.5), 0.9, SemanticClass.ROAD)
    box = _grid((-0.5, 0.5), (-0.4, 0.4), 0.45, SemanticClass.VEHICLE)
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[:, 0, 3], poses[:, 2, 3] = torch.tensor([3.5, 4.0]), 0.6
    actor = Actor("box", "car", box, Track(torch.tensor([0, 10**8]), poses), (1.0, 0.8, 0.6))
    rotation = torch.tensor([[0, -1, 0], [-0.2, 0, -0.98], [0.98, 0, -0.2]], dtype=torch.float64)
    rotation = rotation / rotation.norm(dim=1, keepdim=True)  # looks ahead and a little down
    pose = rigid(rotation, -rotation @ torch.tensor([0.0, 0.0, 1.2], dtype=torch.float64))
    camera = Camera("ahead", WIDTH, HEIGHT, 16.0, 16.0, WIDTH / 2, HEIGHT / 2, pose)
    frame = Frame(0, 0, torch.eye(4, dtype=torch.float64), {"ahead": camera})
    rng = np.random.default_rng(1)
    return Scene(
        name="kernels",
        source="none:kernels",
        background=ground,
        actors=(actor,),
        sky=CubemapSky(torch.from_numpy(rng.uniform(0.3, 0.9, (6, 4, 4, 3)).astype(np.float32))),
        frames=(frame,),
        ground_z_m=0.0,
        ground=Ground(0.0, 0.0, "stated", None, 0, None),
        color_maps={"ahead": torch.eye(3, 4) * 0.9},
    )


def _grid(
    x: tuple[float, float], y: tuple[float, float], step_m: float, semantic: SemanticClass
) -> Gaussians:
    """A level sheet of flat splats with SH of degree 3."""
    rng = np.random.default_rng(0)
    spots = np.stack(np.meshgrid(np.arange(*x, step_m), np.arange(*y, step_m)), -1).reshape(-1, 2)
    count = len(spots)
    sh = rng.normal(0, 0.05, (count, 16, 3))
    sh[:, 0] = (rng.uniform(0.2, 0.8, (count, 3)) - 0.5) / SH_C0
    scales = np.tile([0.6 * step_m, 0.6 * step_m, 0.005], (count, 1))
    means = np.hstack([spots + step_m / 2, np.zeros((count, 1))])
    return Gaussians(
        means=torch.from_numpy(means.astype(np.float32)),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        scales=torch.from_numpy(scales.astype(np.float32)),
        opacities=torch.full((count,), 0.95),
        sh=torch.from_numpy(sh.astype(np.float32)),
        semantic=torch.full((count,), int(semantic), dtype=torch.int16),
    )
