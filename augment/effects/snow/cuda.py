"""A view's snow on the GPU: near discs split, glints found, vehicles' snow lit, points seen.

Nothing comes back to be counted: discs and crystals lie in blocks of neighbours, and the CPU
reserves as many results as a block near its eye could need; those that are none have opacity 0.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from augment.cameras import Camera
from augment.effects.snow import cuda_kernels as kernels
from augment.effects.snow.kernels import COARSER, FARTHEST_M, MAX_SPLITS, REACH, TEXEL_M
from augment.effects.snow.near_camera import FARTHEST_M as FARTHEST_GLINT_M
from augment.effects.snow.near_camera import (
    MOTTLE,
    RELIEF,
    SIZE_M,
    TABLE,
    CloseSnow,
    Crystals,
    Grain,
    Layer,
    SnowLayers,
    finest_split,
    noise_table,
    shift_m,
    sun_step,
    view_limits,
)
from augment.render.cuda import runtime as gpu
from augment.render.part_views import part_poses
from augment.render.sh import SH_C0
from augment.scene import Gaussians, PosedGaussians
from augment.semantics import SemanticClass

DISCS, CRYSTALS, SPLATS, POINTS = 128, 1024, 256, 64  # lanes of a program of each kernel
# Glints of a block at most: mirrors face every direction alike, so that one in 80 throws the sun at
# an eye; five times as many in one block come up once in 10^20.
MAX_GLINTS = 64
_ALIGNED = 4  # numbers: a layer's arrays begin at a multiple of 16 bytes
_ROUNDING = 1e-4  # of float32, on the safe side: of distances, and metres at the view's sides
_MIN_ROWS = 1 << 14  # of a column that is the same for every splat


def pose_layers(
    snow: SnowLayers, covered: Sequence[tuple[Layer, PosedGaussians]], camera: Camera
) -> list[PosedGaussians]:
    """Layers that have splats where their parts stand, as `SnowLayers.parts_for` lists them.

    What differs from frame to frame goes to the GPU in one upload; the rest stays there.
    """
    if not covered:
        return []
    layers = [layer for layer, _ in covered]
    poses = part_poses([part.world_from_part for _, part in covered])
    sun = np.array(snow.sun)
    suns = sun @ poses[:, :3, :3]
    eyes_m = ((camera.centre.numpy() - poses[:, :3, 3])[:, None] @ poses[:, :3, :3])[:, 0]

    by_normals = [number for number, layer in enumerate(layers) if layer.normals is not None]
    light = plan_light([layers[number] for number in by_normals], suns[by_normals], snow.wrap)
    ground, split = snow.ground, None
    if ground in layers and ground.normals is None:
        split = plan_split(ground.gaussians, ground.slopes, camera, sun, snow.grain)
    glints = plan_glints([layer.crystals for layer in layers], suns, eyes_m)

    sent = _sent(*(() if plan is None else plan.arrays for plan in (light, split, glints)))
    lit = [] if light is None else light.run(*next(sent))
    near = None if split is None else split.run(*next(sent))
    bright = [None] * len(layers) if glints is None else glints.run(*next(sent))

    lit_of, out = dict(zip(by_normals, lit, strict=True)), []
    for number, (layer, part) in enumerate(covered):
        drawn: list[tuple[Gaussians, Tensor | None]]
        if number in lit_of:
            drawn = [(lit_of[number], None)]
        elif layer is ground and near is not None:
            drawn = [(near.whole, layer.slopes), (near.fine, near.fine_slopes)]
        else:
            drawn = [(layer.gaussians, layer.slopes)]
        shown = bright[number]
        if shown is not None:
            drawn.append((shown, None))
        out += snow.posed(drawn, part, tuple(suns[number].tolist()))
    return out


def _sent(*groups: tuple[np.ndarray, ...]) -> Iterator[list[Tensor]]:
    """What lies on the GPU of each group that has arrays, all by one upload."""
    groups = tuple(group for group in groups if group)
    if groups:
        tensors = gpu.upload_together([array for group in groups for array in group])
        for group in groups:
            yield tensors[: len(group)]
            tensors = tensors[len(group) :]


# ---- Columns that are the same for every splat: sent once, a frame takes the rows it needs -------


def _snow_classes(count: int) -> Tensor:
    """int16 [count]"""
    return gpu.resident(_class_column(_num_rows(count)))[:count]


def _num_rows(count: int) -> int:
    return max(_MIN_ROWS, 1 << (count - 1).bit_length())


@cache
def _class_column(rows: int) -> Tensor:
    return torch.full((rows,), int(SemanticClass.SNOW), dtype=torch.int16)


@cache
def _glint_columns(rows: int) -> tuple[Tensor, Tensor, Tensor]:
    """Quaternions, scales and SH (white) of glints: [rows, 4], [rows, 3], [rows, 1, 3]."""
    return (
        torch.tensor([[1.0, 0, 0, 0]]).repeat(rows, 1),
        torch.full((rows, 3), SIZE_M),
        torch.full((rows, 1, 3), 0.5 / SH_C0),
    )


# ---- Blocks of neighbouring points, so that those near an eye are found by the block -------------

_SQUARE_M = 0.25  # points of one square need no order among themselves
_GROUP = 32  # blocks
_MANY = 1024  # blocks, of which groups are looked at first
_BITS = 16  # of a square's number, along x and along y


@dataclass(frozen=True, eq=False)
class Blocks:
    """P points, `size` at a time in the order int32 [P]; the last block may be short.

    lows, highs [B, 3]: corners of every block's box, metres, part's frame.
    """

    size: int
    order: Int[np.ndarray, "P"]
    lows: Float[np.ndarray, "B 3"]
    highs: Float[np.ndarray, "B 3"]

    def __len__(self) -> int:
        return len(self.lows)

    def counts(self, chosen: Int[np.ndarray, "C"]) -> Int[np.ndarray, "C"]:
        """Points of the chosen blocks."""
        return np.minimum(self.size, len(self.order) - self.size * chosen)

    def near(
        self, eye_m: Float[np.ndarray, "3"], reach_m: float
    ) -> tuple[Int[np.ndarray, "C"], Float[np.ndarray, "C"]]:
        """Blocks whose boxes are nearer to the eye than that, and how near; 0 within a box."""
        candidates = np.arange(len(self))
        if len(self) > _MANY:
            groups = np.flatnonzero(_distances(*self._groups, eye_m) < reach_m)
            candidates = (groups[:, None] * _GROUP + np.arange(_GROUP)).reshape(-1)
            candidates = candidates[candidates < len(self)]
        distances = _distances(self.lows[candidates], self.highs[candidates], eye_m)
        inside = distances < reach_m
        return candidates[inside], distances[inside]

    @cached_property
    def _groups(self) -> tuple[np.ndarray, np.ndarray]:
        """Boxes around _GROUP blocks at a time."""
        starts = np.arange(0, len(self), _GROUP)
        return np.minimum.reduceat(self.lows, starts), np.maximum.reduceat(self.highs, starts)

    def may_lie_in(self, chosen: np.ndarray, sides: np.ndarray) -> np.ndarray:
        """bool: whether a point of each chosen block may have sides [S, 4] @ (x, y, z, 1) >= 0 in
        every row.
        """
        lows, highs = self.lows[chosen], self.highs[chosen]
        axes = sides[:, :3].T
        most = (lows + highs) / 2 @ axes + (highs - lows) / 2 @ np.abs(axes) + sides[:, 3]
        return np.logical_and.reduce(most >= 0, axis=1)

    def largest(self, values: np.ndarray) -> np.ndarray:
        """The largest of the points' values in every block."""
        if not len(self):
            return np.zeros(0, values.dtype)
        return np.maximum.reduceat(values[self.order], self.size * np.arange(len(self)))


def blocks_of(points: Float[np.ndarray, "P 3"], size: int) -> Blocks:
    """Along a curve that visits every square of the ground after its neighbours (Morton's)."""
    points = points.astype(np.float64)
    low = points[:, :2].min(0, initial=np.inf)
    squares = np.minimum((points[:, :2] - low) / _SQUARE_M, 2**_BITS - 1).astype(np.uint64)
    codes = _spread(squares[:, 0]) | (_spread(squares[:, 1]) << np.uint64(1))
    order = np.argsort(codes, kind="stable").astype(np.int32)
    starts = np.arange(0, len(points), size)
    if not len(starts):
        return Blocks(size, order, np.zeros((0, 3)), np.zeros((0, 3)))
    ordered = points[order]
    return Blocks(
        size, order, np.minimum.reduceat(ordered, starts), np.maximum.reduceat(ordered, starts)
    )


def _distances(lows: np.ndarray, highs: np.ndarray, eye_m: np.ndarray) -> np.ndarray:
    gaps = np.maximum(np.maximum(lows - eye_m, eye_m - highs), 0.0)
    return np.sqrt(np.einsum("ij,ij->i", gaps, gaps))


def _spread(numbers: np.ndarray) -> np.ndarray:
    """Bits of uint64 numbers below 2^16, with a zero between each and the next."""
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        numbers = (numbers | (numbers << np.uint64(shift))) & np.uint64(mask)
    return numbers


# ---- Near discs, split as `near_camera.split_near` does ------------------------------------------


@dataclass(frozen=True, eq=False)
class Split:
    """What of a layer is split for a view. rows int32 [B, 4] and numbers float32: as
    `kernels.split_discs` reads them. total: finer discs at most.
    """

    gaussians: Gaussians
    slopes: Float[Tensor, "S 3"] | None
    order: Tensor
    arrays: tuple[np.ndarray, np.ndarray]
    total: int

    def run(self, rows: Tensor, numbers: Tensor) -> CloseSnow:
        """The discs as in `split_near`; rows and numbers as they lie on the GPU."""
        g, count = self.gaussians, self.total
        means, quats, scales, opacities, sh = (
            gpu.resident(tensor) for tensor in (g.means, g.quats, g.scales, g.opacities, g.sh)
        )
        slopes = None if self.slopes is None else gpu.resident(self.slopes)
        left = opacities.clone()

        def new(*shape: int) -> Tensor:
            return torch.empty((count, *shape), dtype=torch.float32, device=means.device)

        fine = Gaussians(
            new(3), new(4), new(3), new(), new(1, 3),
            semantic=None if g.semantic is None else _snow_classes(count),
        )  # fmt: skip
        fine_slopes = None if slopes is None else new(3)
        gpu.launch(
            kernels.split_discs,
            (len(self.arrays[0]), MAX_SPLITS**2),
            *(rows, numbers, gpu.resident(self.order), gpu.resident(_noise())),
            *(means, quats, scales, opacities, sh, slopes, left),
            *(fine.means, fine.quats, fine.scales, fine.opacities, fine.sh, fine_slopes),
            LIT=slopes is not None,
            BLOCK=DISCS,
        )
        whole = Gaussians(means, quats, scales, left, sh, g.semantic)
        return CloseSnow(whole, fine, fine_slopes)


def plan_split(
    gaussians: Gaussians,
    slopes: Float[Tensor, "S 3"] | None,
    camera: Camera,
    sun: np.ndarray,
    grain: Grain,
) -> Split | None:
    """What `split_near` would split, and perhaps more that is not; None where that is nothing.

    sun: unit, towards it, float64 [3].
    """
    if not len(gaussians):
        return None
    blocks, order, widest = _discs_of(gaussians)
    finest, eye = finest_split(camera), camera.centre.numpy()
    near, distances = blocks.near(eye, FARTHEST_M * (1 + _ROUNDING))
    distances = np.maximum(distances * (1 - _ROUNDING), 1e-9)
    most = np.minimum(np.floor(widest[near] / (finest * distances) + 0.5), MAX_SPLITS)
    chosen, splits = near[most > 1], most[most > 1].astype(int)
    seen = blocks.may_lie_in(chosen, _sides(camera))
    chosen, splits = chosen[seen], splits[seen]
    if not len(chosen):
        return None
    counts = blocks.counts(chosen)
    ends = np.cumsum(counts * splits**2)
    rows = np.stack([chosen * blocks.size, counts, splits, ends - counts * splits**2], 1)
    arrays = rows.astype(np.int32), _split_numbers(camera, sun, grain, finest)
    return Split(gaussians, slopes, order, arrays, int(ends[-1]))


_Discs = tuple[Blocks, Tensor, np.ndarray]
_discs: WeakKeyDictionary[Gaussians, _Discs] = WeakKeyDictionary()


def _discs_of(gaussians: Gaussians) -> _Discs:
    """Blocks of a layer's discs, their order as a tensor, and the widest side in each block."""
    if gaussians not in _discs:
        blocks = blocks_of(gaussians.means.numpy(), DISCS)
        sides = REACH * gaussians.scales.numpy()[:, :2].max(1).astype(np.float64)
        _discs[gaussians] = blocks, torch.from_numpy(blocks.order), blocks.largest(sides)
    return _discs[gaussians]


def _sides(camera: Camera) -> np.ndarray:
    """float64 [5, 4]: what of the world may be split, see Blocks.may_lie_in."""
    right, down, away = camera.camera_from_world.numpy()[:3]
    left_most, right_most, top, bottom = view_limits(camera)
    sides = np.stack([away, right - left_most * away, right_most * away - right,
                      down - top * away, bottom * away - down])  # fmt: skip
    sides[:, 3] += _ROUNDING * (1 + np.abs(sides[:, :3]).sum(1))
    return sides


def _split_numbers(camera: Camera, sun: np.ndarray, grain: Grain, finest: float) -> np.ndarray:
    eye = camera.centre.numpy()
    u, v = (eye[:2] + 0.7 * eye[2] + shift_m(grain.seed)) / TEXEL_M
    turned = np.array([0.8 * u - 0.6 * v, 0.6 * u + 0.8 * v])
    numbers = [
        camera.camera_from_world.numpy()[:3, :3].reshape(-1),
        *_coarse_and_rest(eye),
        view_limits(camera),
        [finest, grain.amount * grain.contrast * RELIEF, grain.amount * MOTTLE],
        sun_step(sun)[:2],
        [u % TABLE, v % TABLE],
        COARSER * turned % TABLE,
    ]
    return np.concatenate(numbers).astype(np.float32)


def _coarse_and_rest(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """float64 places as float32, and what float32 could not hold."""
    coarse = places.astype(np.float32)
    return coarse, places - coarse


@cache
def _noise() -> Tensor:
    return torch.from_numpy(noise_table())


# ---- Glints, as `Crystals.glints` finds them, of all layers in one launch ------------------------


@dataclass(frozen=True, eq=False)
class Glints:
    """What is asked of a view's crystals.

    arrays: rows int32 [B, 4], layers int64 [L, 2], numbers float32 [L, 10] of
    `kernels.find_glints`. spans: first slot and number of slots of every layer, 0 where none of it
    is near. tensors: what the layers' addresses point to, kept alive by this.
    """

    arrays: tuple[np.ndarray, np.ndarray, np.ndarray]
    spans: Sequence[tuple[int, int]]
    total: int
    tensors: Sequence[Tensor]

    def run(self, rows: Tensor, layers: Tensor, numbers: Tensor) -> list[Gaussians | None]:
        """Of every layer; None where it is too far for any. Arguments: as they lie on the GPU."""
        means = torch.empty((self.total, 3), dtype=torch.float32, device=rows.device)
        opacities = torch.empty(self.total, dtype=torch.float32, device=rows.device)
        gpu.launch(
            kernels.find_glints,
            (len(self.arrays[0]),),
            *(rows, layers, numbers, means, opacities),
            MAX_GLINTS=MAX_GLINTS,
            BLOCK=CRYSTALS,
            num_warps=8,
        )
        out = list[Gaussians | None]()
        for first, count in self.spans:
            if not count:
                out.append(None)
                continue
            columns = _glint_columns(_num_rows(count))
            quats, scales, sh = (gpu.resident(column)[:count] for column in columns)
            own = slice(first, first + count)
            out.append(
                Gaussians(means[own], quats, scales, opacities[own], sh, _snow_classes(count))
            )
        return out


def plan_glints(
    crystals: Sequence[Crystals | None], suns: np.ndarray, eyes_m: np.ndarray
) -> Glints | None:
    """What to ask of each layer's crystals; None where no layer has any near its eye.

    suns: unit, towards it; eyes_m: the camera's centre; float64 [L, 3], in the layers' frames.
    """
    rows, spans, slot, tensors = [], [], 0, list[Tensor]()
    layers = np.zeros((len(crystals), 2), np.int64)
    for number, (own, eye_m) in enumerate(zip(crystals, eyes_m, strict=True)):
        first = slot
        if own is not None and len(own.places_m):
            blocks, *sorted_tensors = _sorted(own)
            own_tensors = [gpu.resident(tensor) for tensor in sorted_tensors]
            layers[number] = [gpu.address_of(tensor) for tensor in own_tensors]
            tensors += own_tensors
            near = blocks.near(eye_m, FARTHEST_GLINT_M)[0]
            counts = blocks.counts(near)
            room = np.minimum(counts, MAX_GLINTS)
            ends = first + np.cumsum(room)
            rows.append(
                np.stack([np.full_like(near, number), near * CRYSTALS, counts, ends - room], 1)
            )
            slot = int(ends[-1]) if len(near) else slot
        spans.append((first, slot - first))
        slot += -slot % _ALIGNED
    if not slot:
        return None
    strengths = [0 if own is None else own.strength for own in crystals]
    numbers = np.concatenate([*_coarse_and_rest(eyes_m), suns, np.c_[strengths]], 1)
    arrays = np.concatenate(rows).astype(np.int32), layers, numbers.astype(np.float32)
    return Glints(arrays, spans, slot, tensors)


_Sorted = tuple[Blocks, Tensor, Tensor]
_sorted_crystals: WeakKeyDictionary[Crystals, _Sorted] = WeakKeyDictionary()


def _sorted(crystals: Crystals) -> _Sorted:
    """Blocks of crystals, and their places and mirrors [G, 3] in the blocks' order."""
    if crystals not in _sorted_crystals:
        blocks = blocks_of(crystals.places_m.numpy(), CRYSTALS)
        order = torch.from_numpy(blocks.order).long()
        _sorted_crystals[crystals] = blocks, crystals.places_m[order], crystals.mirrors[order]
    return _sorted_crystals[crystals]


# ---- Snow lit by its own normals, all layers of a view in one launch -----------------------------


@dataclass(frozen=True, eq=False)
class Light:
    """What is asked of layers with normals. arrays: rows int64 [L, 5] and numbers float32 [L, 4] of
    `kernels.light_splats`. total: splats. tensors: what the rows' addresses point to, kept alive.
    """

    layers: Sequence[Layer]
    tensors: Sequence[Tensor]
    arrays: tuple[np.ndarray, np.ndarray]
    total: int

    def run(self, rows: Tensor, numbers: Tensor) -> list[Gaussians]:
        """Every layer's Gaussians as they are lit; rows and numbers as they lie on the GPU."""
        lit = torch.empty((self.total, 1, 3), dtype=torch.float32, device=rows.device)
        counts, slots = self.arrays[0][:, 3], self.arrays[0][:, 4]
        programs = -(-int(counts.max()) // SPLATS)
        arguments = (rows, numbers, lit)
        gpu.launch(kernels.light_splats, (programs, len(self.layers)), *arguments, BLOCK=SPLATS)
        return [
            dataclasses.replace(layer.gaussians, sh=lit[slot : slot + count])
            for layer, slot, count in zip(self.layers, slots, counts, strict=True)
        ]


def plan_light(layers: Sequence[Layer], suns: np.ndarray, wrap: float) -> Light | None:
    """Of layers that have normals and splats; None where there are no layers.

    suns: unit, towards it, float64 [L, 3], in the layers' frames.
    """
    if not layers:
        return None
    rows, tensors, slot = [], list[Tensor](), 0
    for layer in layers:
        normals, slopes, sh = layer.normals, layer.slopes, layer.gaussians.sh
        assert normals is not None and slopes is not None
        own = [gpu.resident(tensor) for tensor in (normals, slopes, sh)]
        tensors += own
        rows.append([*(gpu.address_of(tensor) for tensor in own), len(normals), slot])
        slot += -(-len(normals) // _ALIGNED) * _ALIGNED
    numbers = np.concatenate([suns, np.full((len(layers), 1), wrap)], 1)
    return Light(layers, tensors, (np.array(rows, np.int64), numbers.astype(np.float32)), slot)


# ---- Points that some camera sees ----------------------------------------------------------------


def find_seen(
    points: np.ndarray,
    normals: np.ndarray,
    is_sure: np.ndarray,
    views: np.ndarray,
    sizes: np.ndarray,
    depths: Tensor,
    lifts: np.ndarray,
    tolerances: np.ndarray,
) -> np.ndarray:
    """bool [C], as surface_kernels.find_seen. depths lie on the GPU; waits for the result."""
    if not len(points):
        return np.zeros(0, bool)
    # Near the points float32 tells a tenth of a millimetre, wherever in the world they are.
    origin = points.mean(0)
    about = views.copy()
    about[:, 12:15] -= origin
    seen = gpu.upload(np.empty(len(points), np.uint8))
    gpu.launch(
        kernels.find_seen,
        (-(-len(points) // POINTS),),
        gpu.upload((points - origin).astype(np.float32).T),
        gpu.upload(normals.astype(np.float32).T),
        gpu.upload(is_sure.astype(np.uint8)),
        gpu.upload(about.astype(np.float32)),
        gpu.upload(sizes.astype(np.int32)),
        depths,
        gpu.upload(tolerances.astype(np.float32)),
        gpu.upload(lifts.astype(np.float32)),
        seen,
        len(points),
        len(views),
        LIFTS=len(lifts),
        BLOCK=POINTS,
        num_warps=1,
    )
    return seen.cpu().numpy() > 0
