"""Gaussians and cameras at the limits of what files may hold, and how many examples tests draw.

World: x ahead, z up. All are drawn from a seed, placed by angle and log of distance so that each
camera sees most of them, however wide it looks. CLIMATEGS_EXAMPLES=2000 makes a long soak of the
same tests: examples are drawn from a fixed seed and kept in no database, so that a run fails or
passes whatever ran before it.
"""

from __future__ import annotations

import dataclasses
import math
import os

import numpy as np
import torch
from hypothesis import HealthCheck, settings

from augment.render.constants import ALPHA_MIN
from augment.render.fog import Fog
from augment.render.sh import SH_C0
from augment.scene.cameras import Camera
from augment.scene.geometry import rigid
from augment.scene.scene import Gaussians, PosedGaussians, SplatShading

MIN_SCALE, MAX_SCALE = 1e-8, 1e4  # metres
EDGE = np.float32(ALPHA_MIN)
# Opacities at which something begins or ends: nothing, the least that is drawn and its neighbours,
# the stop of one splat, all.
OPACITIES = np.array(
    [0, np.nextafter(EDGE, np.float32(0)), EDGE, np.nextafter(EDGE, np.float32(1)),
     0.5, 0.998, 0.999, np.nextafter(np.float32(1), np.float32(0)), 1],
    np.float32,
)  # fmt: skip
SMOGS = {
    "clear": None,
    "uniform": Fog(0.15, (0.8, 0.7, 0.5)),
    "layered": Fog(0.3, (0.8, 0.7, 0.5), scale_height_m=2.0, base_z_m=-1.0),
}


def wide_camera(
    fov_deg: float, size: tuple[int, int] = (33, 21), *, at=(0.0, 0.0, 0.0), turn: float = 0.0
) -> Camera:
    """A camera along +x that sees fov_deg over the longer side of its image, rolled by `turn`."""
    width, height = size
    focal = 0.5 * max(size) / math.tan(math.radians(fov_deg) / 2)
    c, s = math.cos(turn), math.sin(turn)
    ahead = torch.tensor([[0.0, -c, -s], [0.0, s, -c], [1.0, 0.0, 0.0]], dtype=torch.float64)
    pose = rigid(ahead, -ahead @ torch.tensor(at, dtype=torch.float64))
    return Camera("wide", width, height, focal, focal, 0.48 * width, 0.53 * height, pose)


def hard_gaussians(
    kind: str,
    camera: Camera,
    count: int = 60,
    *,
    seed: int = 0,
    sh_degree: int = 1,
    dtype=torch.float32,
) -> Gaussians:
    """Gaussians that `camera` sees.

    kind: "plain" (a few pixels to half the image wide), "round" (balls of 1e-8 to 1e4 m), "mixed"
    (every axis of its own length in that range), "needles" (1 m to 10 km long, thinner than 1 cm,
    centred up to ten images beside this one), "edges" (opacities at the thresholds), "near"
    (distances about the near plane).
    """
    rng = np.random.default_rng(seed)
    z = np.exp(rng.uniform(math.log(0.5), math.log(50.0), count))
    if kind == "near":
        z = rng.uniform(0.005, 0.03, count)
    beside = 10.0 if kind == "needles" else 0.2
    columns = rng.uniform(-beside, 1 + beside, count) * camera.width
    rows = rng.uniform(-beside, 1 + beside, count) * camera.height
    x, y = (columns - camera.cx) / camera.fx * z, (rows - camera.cy) / camera.fy * z
    centre, rotation = camera.centre.numpy(), camera.camera_from_world.numpy()[:3, :3]
    means = np.stack([x, y, z], 1) @ rotation + centre
    span = 0.3 * max(camera.width, camera.height) / camera.fx * z
    scales = span[:, None] * np.exp(rng.uniform(math.log(0.02), 0, (count, 3)))
    low, high = math.log(MIN_SCALE), math.log(MAX_SCALE)
    if kind == "round":
        scales = np.exp(rng.uniform(low, high, (count, 1))).repeat(3, 1)
    elif kind == "mixed":
        scales = np.exp(rng.uniform(low, high, (count, 3)))
    elif kind == "needles":
        scales = 10 ** np.stack([rng.uniform(0, 4, count), *rng.uniform(-8, -2, (2, count))], 1)
    opacities = rng.uniform(0.02, 0.98, count)
    if kind == "edges":
        opacities = rng.choice(OPACITIES, count)
    quats = rng.normal(size=(count, 4))
    sh = rng.normal(0, 0.15, (count, (sh_degree + 1) ** 2, 3))
    sh[:, 0] = (rng.uniform(0, 1, (count, 3)) - 0.5) / SH_C0
    fields = {
        "means": means,
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "scales": scales,
        "opacities": opacities,
        "sh": sh,
    }
    semantic = torch.from_numpy(rng.integers(0, 5, count).astype(np.int16))
    return Gaussians(
        **{n: torch.from_numpy(v).to(dtype) for n, v in fields.items()}, semantic=semantic
    )


def untied(gaussians: Gaussians, camera: Camera) -> Gaussians:
    """Those that are not at the z of another, in the order given; float32 may round z to 1e-6."""
    z = (gaussians.means.double() - camera.centre) @ camera.camera_from_world[2, :3]
    z, order = z.sort()
    apart = torch.ones(len(z), dtype=torch.bool)
    apart[1:] = z[1:] - z[:-1] > 1e-6 * z[1:].abs()
    return gaussians.select(order[apart].sort().values)


KINDS = ("plain", "round", "mixed", "needles", "edges", "near")


def colour_maps(seed: int = 0) -> torch.Tensor:
    """Maps [5, 3, 4] as styles have them, one a class; the first is extreme."""
    rng = np.random.default_rng(seed)
    maps = np.concatenate([np.eye(3)[None] + rng.normal(0, 0.3, (5, 3, 3)),
                           rng.normal(0, 0.1, (5, 3, 1))], 2)  # fmt: skip
    maps[0] *= 3
    return torch.from_numpy(maps).float()


def in_weather(gaussians: Gaussians, weather: str, seed: int = 0, pose=None) -> PosedGaussians:
    """A part that is snow lit per pixel ("light"), has a style's maps ("maps"), or is plain."""
    part = PosedGaussians(gaussians, pose, is_overlay=weather == "light" or bool(seed % 2))
    if weather == "light":
        return dataclasses.replace(part, shading=snow_light(len(gaussians), seed))
    return dataclasses.replace(part, color_maps=colour_maps(seed)) if weather == "maps" else part


def snow_light(count: int, seed: int = 0) -> SplatShading:
    """Light per pixel on `count` splats, from a low sun."""
    slopes = torch.from_numpy(np.random.default_rng(seed).uniform(0, 1, (count, 3))).float()
    return SplatShading(slopes, (0.6, 0.0, 0.8), 0.4)


VARIABLE = "CLIMATEGS_EXAMPLES"


def examples(default: int) -> int:
    """The number of examples of one test: `default`, or what the environment asks for."""
    text = os.environ.get(VARIABLE, "")
    if not text:
        return default
    if not text.isdecimal() or int(text) < 1:
        raise ValueError(f"{VARIABLE} must be a whole number of examples, >= 1; got {text!r}")
    return int(text)


def drawing(default: int) -> settings:
    """Settings of a property: `default` examples, or the environment's number.

    Frames take as long as they take, and the first waits for kernels: no deadline, and no
    complaint that drawing is slow.
    """
    return settings(
        max_examples=examples(default),
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
    )
