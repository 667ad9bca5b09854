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
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from scipy import ndimage
from torch import Tensor

from augment.cameras import Camera
from augment.effects.snow import kernels as close_kernels
from augment.effects.snow.kernels import (
    CLOD,
    COARSER,
    CRUMB,
    MARGIN,
    REACH,
    SPREAD,
    TEXEL_M,
    CloseView,
    Discs,
)
from augment.geometry import rotmat_from_quat
from augment.memo import memo_of
from augment.render.buffers import AUTO, CUDA
from augment.render.cuda import runtime as gpu
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
    *,
    backend: str = AUTO,
) -> CloseSnow | None:
    """The snow as the camera sees it; None where no disc is near enough.

    gaussians: of the world. sun: unit, towards it. backend: with "cuda", `split_discs` splits them
    on the GPU, where they lie afterwards.
    """
    finest, means = finest_split(camera), gaussians.means.numpy()
    near = near_rows(gaussians, means, camera.centre.numpy(), close_kernels.FARTHEST_M)
    splits = np.empty(len(near), np.uint8)
    pose = np.ascontiguousarray(camera.camera_from_world.numpy()[:3])
    with kernel_threads(ROWS):
        close_kernels.count_splits(
            *(near, means, gaussians.scales.numpy(), pose, view_limits(camera), finest, splits)
        )
    chosen = np.flatnonzero(splits)
    if len(chosen) == 0:
        return None
    chosen, splits = near[chosen], splits[chosen].astype(np.int64)
    view = CloseView(
        *(camera.centre.numpy(), sun_step(sun.numpy()), shift_m(grain.seed)),
        *(grain.amount * grain.contrast * RELIEF, grain.amount * MOTTLE, finest),
    )
    if backend != CUDA:
        return _split_on_cpu(gaussians, slopes, chosen, splits, view)
    picked, numbers = np.stack([chosen, splits]), np.concatenate(view[:3])
    picked, numbers = gpu.upload(picked), gpu.upload(numbers)
    g, there = gaussians, gpu.resident
    on_gpu = Gaussians(
        *(there(g.means), there(g.quats), there(g.scales), there(g.opacities), there(g.sh)),
        semantic=None if g.semantic is None else there(g.semantic),
    )
    slopes = None if slopes is None else there(slopes)
    view = view._replace(eye=numbers[:3], sun=numbers[3:6], shift=numbers[6:])
    total = int((splits * splits).sum())
    return split_discs(on_gpu, slopes, picked[0], picked[1], total, view)


def _split_on_cpu(
    gaussians: Gaussians,
    slopes: Tensor | None,
    chosen: np.ndarray,
    splits: np.ndarray,
    view: CloseView,
) -> CloseSnow:
    """`split_discs` by the kernel."""
    lasts = np.cumsum(splits * splits)
    total = int(lasts[-1])
    fine = Gaussians(
        means=torch.empty(total, 3),
        quats=torch.empty(total, 4),
        scales=torch.empty(total, 3),
        opacities=torch.from_numpy(np.full(total, gaussians.opacities.numpy()[0])),
        sh=torch.empty(total, 1, 3),
        semantic=None if gaussians.semantic is None else gaussians.semantic[:1].expand(total),
    )
    fine_slopes = None if slopes is None else torch.empty(total, 3)
    with kernel_threads(ROWS):
        close_kernels.split(
            *(chosen, splits, lasts - splits * splits, view, noise_table()),
            *(_discs(gaussians, slopes), _discs(fine, fine_slopes)),
        )
    opacities = gaussians.opacities.numpy().copy()  # numpy: torch would wake threads for so little
    opacities[chosen] = 0
    whole = dataclasses.replace(gaussians, opacities=torch.from_numpy(opacities))
    return CloseSnow(whole, fine, fine_slopes)


def split_discs(
    gaussians: Gaussians,
    slopes: Float[Tensor, "S 3"] | None,
    chosen: Int64[Tensor, "C"],
    splits: Int64[Tensor, "C"],
    total: int,
    view: CloseView,
) -> CloseSnow:
    """The chosen discs split, each into splits^2, `total` in all: on the tensors' own device, which
    nobody waits for. The definition of what `kernels.split` computes. view: its arrays as tensors.
    """
    g, device = gaussians, gaussians.means.device
    counts = splits * splits
    own = torch.repeat_interleave(counts, output_size=total)
    disc, n = chosen[own], splits[own]
    piece = torch.arange(total, device=device) - (counts.cumsum(0) - counts)[own]
    quats, scales, colors = g.quats[disc], g.scales[disc], g.sh[disc].double() * SH_C0 + 0.5
    axes = rotmat_from_quat(quats.double())
    sides = REACH * scales[:, :2].double()
    spot = torch.stack([piece // n, piece % n], 1)
    spot = ((spot + 0.5) / n[:, None] - 0.5) * (sides / SPREAD)
    middles = g.means[disc].double()
    places = middles + (axes[:, :, :2] * spot[:, None]).sum(2)

    far = (middles - view.eye).norm(dim=1)
    fade = (2 * (1 - far / close_kernels.FARTHEST_M)).clamp(0, 1)
    # 0 where discs grow whole again
    fade = fade * (2 * sides.amax(1) / (view.finest * far) - 3).clamp(0, 1)
    noise = _noise() if device.type == "cpu" else gpu.resident(_noise())
    behind, sunward = (
        _grain_at(places + step, view.shift, noise) for step in (-view.sun, view.sun)
    )
    bright = view.relief * (behind - sunward) + 0.5 * view.mottle * (behind + sunward)
    factor = (1 + fade * bright)[:, None]
    fine = Gaussians(
        means=places.float(),
        quats=quats,
        scales=torch.cat([(sides / n[:, None]).float(), scales[:, 2:]], 1),
        opacities=g.opacities[disc],
        sh=((factor[..., None] * colors - 0.5) / SH_C0).float(),
        semantic=None if g.semantic is None else g.semantic[disc],
    )
    whole = dataclasses.replace(g, opacities=g.opacities.index_fill(0, chosen, 0.0))
    return CloseSnow(whole, fine, None if slopes is None else (factor * slopes[disc]).float())


def _grain_at(places: Tensor, shift: Tensor, noise: Tensor) -> Tensor:
    """The noise that the grain follows, [F], at places [F, 3]: two scales of one table."""
    level = places[:, :2] + 0.7 * places[:, 2:] + shift
    u, v = level.unbind(1)
    turned = torch.stack([0.8 * u - 0.6 * v, 0.6 * u + 0.8 * v], 1) * COARSER
    crumb, clod = (
        noise[tuple(((at * (1 / TEXEL_M)).floor().long() & (TABLE - 1)).unbind(1))]
        for at in (level, turned)
    )
    return CRUMB * crumb.double() + CLOD * clod.double()


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


@functools.cache
def _noise() -> Tensor:
    return torch.from_numpy(noise_table())


def _discs(gaussians: Gaussians, slopes: Tensor | None) -> Discs:
    slopes = torch.empty(0, 3) if slopes is None else slopes
    columns = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.sh, slopes)
    return Discs(*(t.contiguous().numpy() for t in columns))


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
        for layer, part in covered:
            parts.extend(self._posed(layer, part, camera, backend))
        return tuple(parts)

    def _posed(
        self, layer: Layer, part: PosedGaussians, camera: Camera, backend: str
    ) -> list[PosedGaussians]:
        """The layer where its part stands, the ground's finer where it is near, and its glints."""
        pose, eye_m = part.world_from_part, camera.centre
        sun = torch.tensor(self.sun, dtype=torch.float64)
        if pose is not None:
            sun, eye_m = pose[:3, :3].T @ sun, pose[:3, :3].T @ (eye_m - pose[:3, 3])
        gaussians, slopes, near = layer.gaussians, layer.slopes, None
        if layer.normals is not None:
            assert slopes is not None
            towards = sun.tolist()
            gaussians = _lit(gaussians, slopes, layer.normals, towards, self.wrap, backend)
            slopes = None
        elif layer is self.ground:
            near = split_near(gaussians, slopes, camera, sun, self.grain, backend=backend)
        drawn = [(gaussians, slopes)]
        if near is not None:
            drawn = [(near.whole, slopes), (near.fine, near.fine_slopes)]
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
