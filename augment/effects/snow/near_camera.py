"""Snow close to the camera: discs that a pixel could tell apart are split, and show grain.

A cell of 5 cm is 20 pixels wide a few metres before a car's camera. There every disc becomes a few
that cover what it covered, each a little brighter or darker: crumbs and clods, lit on the side of
the sun. The noise they follow belongs to the place, so that all cameras and frames see one grain.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Float, Float32
from scipy import ndimage
from torch import Tensor

from augment.cameras import Camera
from augment.effects.snow import kernels as close_kernels
from augment.effects.snow.kernels import MARGIN, TEXEL_M
from augment.render.buffers import AUTO, CUDA
from augment.render.sh import SH_C0
from augment.render.threads import kernel_threads
from augment.scene import Gaussians, PosedGaussians, Scene, SplatShading
from augment.semantics import SemanticClass

# Splitting stops at a standard deviation of so many pixels, and of so much of the distance.
FINEST_PX, FINEST = 5.0, 0.0038
ROWS = 2048  # discs that a thread takes at a time
RELIEF = 3.4  # brightness per fall of the noise towards the sun, of a clear day's contrast
CRUMB_M = 0.025  # what one crumb of snow measures
TABLE = 512  # texels a side of the noise that grain follows: 5 m, repeated
MOTTLE = 0.16  # brightness per noise, in any light


@dataclass(frozen=True)
class Grain:
    """How snow looks from close by. amount: 0 smooth, 1 coarse. contrast: 0 to 1, by how much the
    sun outshines the sky on it. seed: of its noise.
    """

    amount: float
    contrast: float
    seed: int


@dataclass(frozen=True, eq=False)
class CloseSnow:
    """Snow of which near discs are split. whole: the layer's Gaussians, those that were split with
    opacity 0. fine: what they were split into. fine_slopes: theirs, where the layer has slopes.
    """

    whole: Gaussians
    fine: Gaussians
    fine_slopes: Float[Tensor, "F 3"] | None


def split_near(
    gaussians: Gaussians,
    slopes: Float[Tensor, "S 3"] | None,
    camera: Camera,
    sun: Float[Tensor, "3"],
    grain: Grain,
) -> CloseSnow | None:
    """The snow as the camera sees it; None where no disc is near enough.

    gaussians: of the world. sun: unit, towards it.
    """
    finest = finest_split(camera)
    splits = _count_splits(gaussians, camera, finest)
    chosen = np.flatnonzero(splits)
    if len(chosen) == 0:
        return None
    splits = splits[chosen]
    lasts = np.cumsum(splits.astype(np.int64) ** 2)
    total = int(lasts[-1])
    fine = Gaussians(
        means=torch.empty(total, 3),
        quats=torch.empty(total, 4),
        scales=torch.empty(total, 3),
        opacities=torch.from_numpy(np.full(total, gaussians.opacities.numpy()[0])),
        sh=torch.empty(total, 1, 3),
        semantic=None if gaussians.semantic is None else gaussians.semantic[:1].expand(total),
    )
    fine_slopes = torch.empty(0 if slopes is None else total, 3)
    with kernel_threads(ROWS):
        close_kernels.split(
            *(chosen, splits, lasts - splits.astype(np.int64) ** 2, camera.centre.numpy()),
            *(sun_step(sun.numpy()), shift_m(grain.seed), noise_table()),
            *(grain.amount * grain.contrast * RELIEF, grain.amount * MOTTLE, finest),
            *_arrays(gaussians, slopes),
            *_arrays(fine, fine_slopes),
        )
    opacities = gaussians.opacities.numpy().copy()  # numpy: torch would wake threads for so little
    opacities[chosen] = 0
    return CloseSnow(
        dataclasses.replace(gaussians, opacities=torch.from_numpy(opacities)),
        fine,
        None if slopes is None else fine_slopes,
    )


def finest_split(camera: Camera) -> float:
    """Standard deviation of a disc over its distance that splitting stops at."""
    return max(FINEST_PX / max(camera.fx, camera.fy), FINEST)


def view_limits(camera: Camera) -> np.ndarray:
    """Lowest and highest x / z, then y / z, of the discs that are split, float64 [4]."""
    wide = (1 + MARGIN) * np.array([-1.0, 1.0])
    across = (0.5 * camera.width - camera.cx + 0.5 * camera.width * wide) / camera.fx
    down = (0.5 * camera.height - camera.cy + 0.5 * camera.height * wide) / camera.fy
    return np.concatenate([across, down])


def sun_step(sun: np.ndarray) -> np.ndarray:
    """Half a step of the relief towards the sun, level, metres, float64 [3]. sun: unit."""
    level = sun * np.array([1.0, 1.0, 0.0])
    return 0.25 * CRUMB_M * level / max(float(np.linalg.norm(level)), 1e-9)


@functools.cache
def noise_table() -> np.ndarray:
    """float32 [TABLE, TABLE] of unit deviation, smooth over a crumb, whose borders meet."""
    white = np.random.Generator(np.random.PCG64(0)).standard_normal((TABLE, TABLE))
    smooth = ndimage.gaussian_filter(white, 0.5 * CRUMB_M / TEXEL_M, mode="wrap")
    return (smooth / smooth.std()).astype(np.float32)


@functools.lru_cache(8)
def shift_m(seed: int) -> np.ndarray:
    """Where a recipe's grain begins in the table, float64 [2]."""
    return np.random.Generator(np.random.PCG64(seed)).uniform(0, TABLE * TEXEL_M, 2)


def _count_splits(gaussians: Gaussians, camera: Camera, finest: float) -> np.ndarray:
    splits = np.empty(len(gaussians), np.uint8)
    pose = np.ascontiguousarray(camera.camera_from_world.numpy()[:3])
    means, scales = gaussians.means.numpy(), gaussians.scales.numpy()
    with kernel_threads(ROWS):
        close_kernels.count_splits(means, scales, pose, view_limits(camera), finest, splits)
    return splits


def _arrays(gaussians: Gaussians, slopes: Tensor | None) -> tuple[np.ndarray, ...]:
    tensors = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.sh)
    slopes = torch.empty(0, 3) if slopes is None else slopes
    return tuple(t.contiguous().numpy() for t in (*tensors, slopes))


# ---- Crystals on snow that throw the sun at a camera: glints, which come and go as it moves ------

FARTHEST_M = 15.0  # from the camera: glints fade until there
LOBE_DEG = 9.0  # how far a mirror may be off what throws the sun at the camera
MIN_OPACITY = 0.02  # opacity below which a glint is none
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

    def glints(self, sun: Float[Tensor, "3"], eye_m: Float[Tensor, "3"]) -> Gaussians | None:
        """Small bright Gaussians where a mirror throws the sun into the eye; None without any.

        sun: unit, towards it. eye_m: the camera's centre. Both in the part's frame.
        """
        # numpy, since starting threads would take longer than the arithmetic on one part's crystals
        eye, towards_sun = eye_m.numpy().astype(np.float32), sun.numpy().astype(np.float32)
        places = self.places_m.numpy()
        near = np.flatnonzero(np.abs(places[:, 0] - eye[0]) < FARTHEST_M)
        views = eye - places[near]
        distances = np.maximum(np.sqrt((views * views).sum(1)), np.float32(1e-6))
        halves = views / distances[:, None] + towards_sun
        lengths = np.maximum(np.sqrt((halves * halves).sum(1)), np.float32(1e-6))
        aligned = (halves * self.mirrors.numpy()[near]).sum(1) / lengths
        off = (1 - aligned) / (1 - math.cos(math.radians(LOBE_DEG)))  # 1 at the lobe's rim
        power = self.strength * np.sqrt(np.maximum(1 - off, 0)) * (1 - distances / FARTHEST_M)
        shown = power > MIN_OPACITY
        count = int(shown.sum())
        if count == 0:
            return None
        return Gaussians(
            means=torch.from_numpy(places[near[shown]]),
            quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
            scales=torch.full((count, 3), SIZE_M),
            opacities=torch.from_numpy(np.minimum(power[shown], 1).astype(np.float32)),
            sh=torch.full((count, 1, 3), 0.5 / SH_C0),  # white
            semantic=torch.full((count,), int(SemanticClass.SNOW), dtype=torch.int16),
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
    slopes (world; see SplatShading). thickness_m: the layer's depth on level ground. grain: how the
    ground's snow looks from close by.
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
        if backend == CUDA:
            from augment.effects.snow.cuda import pose_layers

            return (*parts, *pose_layers(self, covered, camera))
        for layer, part in covered:
            parts.extend(self._posed(layer, part, camera))
        return tuple(parts)

    def _posed(self, layer: Layer, part: PosedGaussians, camera: Camera) -> list[PosedGaussians]:
        """The layer where its part stands, the ground's finer where it is near, and its glints."""
        pose, eye_m = part.world_from_part, camera.centre
        sun = torch.tensor(self.sun, dtype=torch.float64)
        if pose is not None:
            sun, eye_m = pose[:3, :3].T @ sun, pose[:3, :3].T @ (eye_m - pose[:3, 3])
        gaussians, slopes = layer.gaussians, layer.slopes
        if layer.normals is not None:
            assert slopes is not None
            gaussians = _lit(gaussians, slopes, layer.normals, sun, self.wrap)
            slopes = None
        drawn, near = [(gaussians, slopes)], None
        if layer is self.ground:
            near = split_near(gaussians, slopes, camera, sun, self.grain)
        if near is not None:
            drawn = [(near.whole, slopes), (near.fine, near.fine_slopes)]
        glints = None if layer.crystals is None else layer.crystals.glints(sun, eye_m)
        if glints is not None:
            drawn.append((glints, None))
        return self.posed(drawn, part, tuple(sun.tolist()))

    def posed(
        self,
        drawn: Sequence[tuple[Gaussians, Tensor | None]],
        part: PosedGaussians,
        sun: tuple[float, float, float],
    ) -> list[PosedGaussians]:
        """Splats with their slopes where a part stands. sun: unit, in the part's frame."""
        lights = (None if s is None else SplatShading(s, sun, self.wrap) for _, s in drawn)
        pose = (part.world_from_part, part.instance_id)
        return [
            PosedGaussians(splats, *pose, is_overlay=True, shading=light)
            for (splats, _), light in zip(drawn, lights, strict=True)
        ]


_left: WeakKeyDictionary[Layer, tuple[Gaussians, Gaussians]] = WeakKeyDictionary()


def _left_visible(layer: Layer, own: Gaussians) -> Gaussians:
    """A part's Gaussians less those that the snow buries: one object for as long as the part's own
    is one, so that what a GPU knows of it is not asked for anew every frame.
    """
    known = _left.get(layer)
    if known is None or known[0] is not own:
        known = _left[layer] = (own, dataclasses.replace(own, opacities=layer.opacities))
    return known[1]


def _lit(
    gaussians: Gaussians,
    slopes: Float[Tensor, "S 3"],
    normals: Float[Tensor, "S 3"],
    sun: Float[Tensor, "3"],
    wrap: float,
) -> Gaussians:
    """The Gaussians in the light that their own normals catch. sun: unit, in the part's frame."""
    # numpy, since starting threads would take longer than the arithmetic on one part's snow
    n, light = normals.numpy(), sun.numpy().astype(np.float32)
    facing = n[:, 0] * light[0] + n[:, 1] * light[1] + n[:, 2] * light[2]
    share = np.clip((facing + wrap) / (1 + wrap), 0, 1) / SH_C0
    lit = gaussians.sh.numpy() + (slopes.numpy() * share[:, None])[:, None, :]
    return dataclasses.replace(gaussians, sh=torch.from_numpy(lit.astype(np.float32)))
