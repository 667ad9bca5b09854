"""Snow that lies in a scene, ready to be drawn for a camera, and the glints on it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from augment.cameras import Camera
from augment.effects.snow.relief import Grain
from augment.memo import memo_of
from augment.render.buffers import AUTO, CUDA
from augment.render.cuda import runtime as gpu
from augment.render.sh import SH_C0
from augment.scene import Gaussians, PosedGaussians, Scene, SplatShading
from augment.semantics import SemanticClass

_BLOCK = 256  # neighbouring points


def near_rows(owner: Any, points: np.ndarray, eye_m: np.ndarray, reach_m: float) -> np.ndarray:
    """int64: rows of the owner's points [P, 3] that hold all within reach of the eye, and some
    others: of blocks whose boxes are near.
    """

    def corners() -> tuple[np.ndarray, np.ndarray]:
        starts = np.arange(0, len(points), _BLOCK)
        return np.minimum.reduceat(points, starts), np.maximum.reduceat(points, starts)

    if not len(points):
        return np.zeros(0, np.int64)
    lows, highs = memo_of(owner).get(("corners of blocks",), corners)
    gaps = np.maximum(np.maximum(lows - eye_m, eye_m - highs), 0.0)
    blocks = np.flatnonzero((gaps * gaps).sum(1) <= (1.001 * reach_m) ** 2)
    rows = (blocks[:, None] * _BLOCK + np.arange(_BLOCK)).reshape(-1)
    return rows[: np.searchsorted(rows, len(points))]


# ---- Crystals on snow that throw the sun at a camera: glints, which come and go as it moves ------

FARTHEST_M = 15.0  # from the camera: glints fade until there
LOBE_DEG = 9.0  # how far a mirror may be off what throws the sun at the camera
MIN_OPACITY = 0.02  # opacity below which a glint is none
# Mirrors face every direction alike, so that one crystal in 80 throws the sun at an eye. On a GPU,
# which does not count them, there is room for five times as many.
GLINT_OF = 16
SIZE_M = 0.002  # standard deviation of a glint
LIFTED = 4.0  # height over a disc's middle, in its thickness
PER_DISC = 2  # crystals at most
WIDEST_M = 0.15  # discs larger than this are too far for any glint
DULL, STRONG = 0.02, 0.25  # by how much lit snow outshines shaded snow where glints begin, are full
CLEAN = 0.9  # of the usual brightness: packed and shaded snow below it shows none


@dataclass(frozen=True, eq=False)
class Crystals:
    """G crystals that may glint. places_m [G, 3], mirrors [G, 3] (unit): in the part's frame.

    strength: of their light, 0 to 1.
    """

    places_m: Float32[Tensor, "G 3"]
    mirrors: Float32[Tensor, "G 3"]
    strength: float

    def glints(
        self, sun: Float[Tensor, "3"], eye_m: Float[Tensor, "3"], *, backend: str = AUTO
    ) -> Gaussians | None:
        """Small bright Gaussians where a mirror throws the sun into the eye; None without any.

        sun: unit, towards it. eye_m: the camera's centre. Both in the part's frame. backend: with
        "cuda" they lie on the GPU, where nobody counts them: some have opacity 0.
        """
        eye, towards_sun = eye_m.numpy().astype(np.float32), sun.numpy().astype(np.float32)
        near = near_rows(self, self.places_m.numpy(), eye, FARTHEST_M)
        if backend == CUDA and len(near):
            rows, view = gpu.upload(near), gpu.upload(np.stack([towards_sun, eye]))
            places, mirrors = (gpu.resident(t)[rows] for t in (self.places_m, self.mirrors))
            power = glint_power(places, mirrors, self.strength, view[0], view[1])
            power, index = power.topk(min(len(near), 64 + len(near) // GLINT_OF), sorted=False)
            opacities = torch.where(power > MIN_OPACITY, power.clip(max=1), 0.0)
            return _glints_at(places[index], opacities)
        # numpy, since starting threads would take longer than the arithmetic on one part's crystals
        places, mirrors = self.places_m.numpy()[near], self.mirrors.numpy()[near]
        power = glint_power(places, mirrors, self.strength, towards_sun, eye)
        shown = power > MIN_OPACITY
        if not shown.any():
            return None
        opacities = np.minimum(power[shown], 1).astype(np.float32)
        return _glints_at(torch.from_numpy(places[shown]), torch.from_numpy(opacities))


def glint_power(places: Any, mirrors: Any, strength: float, sun: Any, eye: Any) -> Any:
    """Opacities [G] of crystals' glints, below MIN_OPACITY where there is none; float32 arrays or
    tensors. places, mirrors [G, 3]; sun: unit, towards it; eye: all in the part's frame.
    """
    views = eye - places
    distances = ((views * views).sum(1) ** 0.5).clip(1e-6)
    halves = views / distances[:, None] + sun
    lengths = ((halves * halves).sum(1) ** 0.5).clip(1e-6)
    aligned = (halves * mirrors).sum(1) / lengths
    off = (1 - aligned) / (1 - math.cos(math.radians(LOBE_DEG)))  # 1 at the lobe's rim
    return strength * (1 - off).clip(0) ** 0.5 * (1 - distances / FARTHEST_M)


def _glints_at(places: Tensor, opacities: Tensor) -> Gaussians:
    count, device = len(places), places.device
    return Gaussians(
        means=places,
        quats=torch.eye(4, device=device)[:1].repeat(count, 1),
        scales=torch.full((count, 3), SIZE_M, device=device),
        opacities=opacities,
        sh=torch.full((count, 1, 3), 0.5 / SH_C0, device=device),  # white
        semantic=torch.full((count,), int(SemanticClass.SNOW), dtype=torch.int16, device=device),
    )


def crystals_of(
    gaussians: Gaussians,
    normals: Float32[Tensor, "S 3"],
    rises: float,
    sparkle: float,
    rng: np.random.Generator,
) -> Crystals | None:
    """As many of all possible crystals as `sparkle` says; None where the light makes no glints.

    Their mirrors face every direction above the snow alike. normals: of the discs. rises: by how
    much snow in the sun is brighter than in shade.
    """
    strength = min((rises - DULL) / (STRONG - DULL), 1.0)
    if strength <= 0 or len(gaussians) == 0:
        return None
    brightness = gaussians.sh[:, 0].mean(1) * SH_C0 + 0.5
    bearing = gaussians.scales[:, :2].amax(1) < WIDEST_M
    bearing &= brightness > CLEAN * brightness.median()
    draws = torch.from_numpy(rng.random((5, PER_DISC * len(gaussians)), np.float32))
    kept = ((draws[0] < sparkle) & bearing.repeat(PER_DISC)).nonzero()[:, 0]
    draws, discs = draws[:, kept], kept % len(gaussians)
    up, around = draws[1], 2 * math.pi * draws[2]
    flat = (1 - up * up).sqrt()
    mirrors = torch.stack([flat * around.cos(), flat * around.sin(), up], 1)
    side, thick = gaussians.scales[discs, 1:2], gaussians.scales[discs, 2:3]
    beside = torch.stack([draws[3] - 0.5, draws[4] - 0.5, torch.zeros_like(up)], 1) * side
    places = gaussians.means[discs] + LIFTED * thick * normals[discs] + beside
    return Crystals(places, mirrors, strength)


# ---- Snow that lies in a scene, ready to be drawn: Gaussians added, and Gaussians hidden ---------


@dataclass(frozen=True, eq=False)
class Layer:
    """The snow on one part of a scene.

    gaussians [S]: the snow, in the part's frame, semantic SNOW. opacities [N]: of the part's own
    Gaussians, 0 for those that the snow buries. slopes [S, 3]: see SplatShading; None where the
    light is in the Gaussians' colours already. normals [S, 3]: unit, where the light's share is one
    for a splat but changes as the part turns; None where it is one for a pixel.
    """

    gaussians: Gaussians
    opacities: Float[Tensor, "N"]
    slopes: Float[Tensor, "S 3"] | None = None
    normals: Float[Tensor, "S 3"] | None = None
    crystals: Crystals | None = None


@dataclass(frozen=True, eq=False)
class SnowLayers:
    """The snow in a scene. actors: layers by track_id. sun, wrap: of the light, for layers with
    slopes (world; see SplatShading). thickness_m: the layer's depth on level ground. grain: how it
    looks from close by.
    """

    ground: Layer
    actors: Mapping[str, Layer]
    sun: tuple[float, float, float]
    wrap: float
    thickness_m: float
    grain: Grain

    def layer_on(self, scene: Scene, instance_id: int) -> Layer | None:
        """The snow on the background (0) or an actor (1 + its index); None where it has none."""
        if instance_id == 0:
            return self.ground
        return self.actors.get(scene.actors[instance_id - 1].track_id)

    def parts_for(
        self,
        scene: Scene,
        camera: Camera,
        without_snow: Sequence[PosedGaussians] | None = None,
        snowy: Collection[int] | None = None,
        *,
        backend: str = AUTO,
    ) -> tuple[PosedGaussians, ...]:
        """The scene's parts and the snow on them at the moment the camera took its image.

        The scene's own come first, in their order. without_snow: those that are drawn, the
        background first. snowy: instance ids of the parts whose snow is; None for all. backend:
        with "cuda", what changes with the view lies on the GPU, equal within float rounding.
        """
        without_snow = scene.parts_for(camera) if without_snow is None else without_snow
        parts, covered = [], []
        for part in without_snow:
            layer = self.layer_on(scene, part.instance_id)
            if layer is None or (snowy is not None and part.instance_id not in snowy):
                parts.append(part)
                continue
            left = _left_visible(layer, part.gaussians)
            parts.append(dataclasses.replace(part, gaussians=left))
            if len(layer.gaussians):
                covered.append((layer, part))
        for layer, part in covered:
            parts.extend(self._posed(layer, part, camera, backend))
        return tuple(parts)

    def _posed(
        self, layer: Layer, part: PosedGaussians, camera: Camera, backend: str
    ) -> list[PosedGaussians]:
        """The layer where its part stands, and its glints."""
        pose, eye_m = part.world_from_part, camera.centre
        sun = torch.tensor(self.sun, dtype=torch.float64)
        if pose is not None:
            sun, eye_m = pose[:3, :3].T @ sun, pose[:3, :3].T @ (eye_m - pose[:3, 3])
        gaussians, slopes = layer.gaussians, layer.slopes
        if layer.normals is not None:
            assert slopes is not None
            towards = sun.tolist()
            gaussians = _lit(gaussians, slopes, layer.normals, towards, self.wrap, backend)
            slopes = None
        drawn = [(gaussians, slopes)]
        if layer.crystals is not None:
            glints = layer.crystals.glints(sun, eye_m, backend=backend)
            drawn += [] if glints is None else [(glints, None)]
        towards_sun, instance = tuple(sun.tolist()), part.instance_id
        lights = (None if s is None else SplatShading(s, towards_sun, self.wrap) for _, s in drawn)
        return [
            PosedGaussians(splats, pose, instance, is_overlay=True, shading=light)
            for (splats, _), light in zip(drawn, lights, strict=True)
        ]


def _left_visible(layer: Layer, own: Gaussians) -> Gaussians:
    """A part's Gaussians less those that the snow buries: one object for as long as the part's own
    is one, so that what a GPU knows of it is not asked for anew every frame.
    """
    of_layers = memo_of(own).get(("left visible by snow",), WeakKeyDictionary[Layer, Gaussians])
    if layer not in of_layers:
        of_layers[layer] = dataclasses.replace(own, opacities=layer.opacities)
    return of_layers[layer]


def _lit(
    gaussians: Gaussians, slopes: Tensor, normals: Tensor, sun: list[float], wrap: float, on: str
) -> Gaussians:
    """The Gaussians in the light that their own normals catch. sun: unit, in the part's frame. on:
    the backend.
    """
    # numpy, since starting threads would take longer than the arithmetic on one part's snow
    sh, rises, n = (
        gpu.resident(t) if on == CUDA else t.numpy() for t in (gaussians.sh, slopes, normals)
    )
    facing = n[:, 0] * sun[0] + n[:, 1] * sun[1] + n[:, 2] * sun[2]
    share = ((facing + wrap) / (1 + wrap)).clip(0, 1) / SH_C0
    lit = sh + (rises * share[:, None])[:, None, :]
    return dataclasses.replace(gaussians, sh=torch.as_tensor(lit))
