"""Levels of detail: far splats merged once a scene, and which of them a camera takes.

The ground is cut into squares. Level 0 of a square holds its own splats; level k holds, for a
square of twice the side, what is left when the splats of level k - 1 that share a cell of
c_k = c_1 2^(k-1) are merged. So a square of any level holds about as many splats, and squares are
the nodes of a quadtree. Of a camera of focal length f, level k serves what lies at least

    d_k = f c_k / lod_px

away: a cell is no larger than lod_px pixels there. From d_k to (1 + BAND) d_k a square fades into
the one that holds it: of shares w and 1 - w, a splat of opacity o has 1 - (1 - o)^w, so that
transmittances, which multiply, stay those of one level. Distances are Euclidean, and a square's is
never below that of the square that holds it: shares add up to 1, follow the camera's place without
a step, and stay as they are when it turns.

Splats whose colours differ by less than ALIKE are merged in cells of 2 c_k. Merging keeps the
moments of the mixture (weights: opacity times surface; splats that are larger than the cell stay as
they are), its mean colour,

    mu = sum w_i mu_i,    Sigma = sum w_i (Sigma_i + (mu_i - mu)(mu_i - mu)^T),

and what its splats cover together of the plane that they lie in, as wide as the rasteriser's blur
makes them where the level serves. Where this takes a flat top, the opacity is above 1: alpha is
min(alpha_max, o exp(-sigma)). (Kerbl et al. 2024, "A Hierarchical 3D Gaussian Representation for
Real-Time Rendering of Very Large Datasets", section 4.1, weighs so, and has such opacities.)
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor

from augment import kernels
from augment.bounds import Bounds
from augment.cameras import Camera
from augment.errors import SceneError
from augment.geometry import quat_from_rotmat, rotmat_from_quat
from augment.memo import memo_of
from augment.render.buffers import SPLAT_IDS, RenderOutput
from augment.render.constants import ALPHA_MIN, COV2D_BLUR, RasterSettings
from augment.render.cpu.order import CELL, known_of, may_be_drawn
from augment.render.fog import Fog
from augment.render.layout import HeightClip
from augment.render.sh import SH_C0
from augment.render.threads import kernel_threads
from augment.scene import Gaussians, PosedGaussians, is_drawable
from augment.semantics import SemanticClass

MIN_SPLATS = 20_000  # a part with fewer is drawn as it is
CELLS_M = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)  # c_1: the first whose cells leave at most
MOST_LEFT = 0.6  # of the splats
CELLS_ACROSS = 64  # of c_1 along a square of level 0
MAX_LEVELS, FEW_SQUARES = 12, 4  # no further level where so few are left
BAND = 0.12
ALIKE = 0.03  # of 1, in each channel of the encoded colours
# A pixel is 1 to 2 cells where a level serves with lod_px = 1. The blur's deviation, in cells:
BLUR_CELLS = math.sqrt(2 * COV2D_BLUR)
FLAT_TOP = 2.0  # a flat top covers this many times what the deviations say; beyond it they grow
MAX_OPACITY = math.exp(FLAT_TOP - 1)
THINNEST_M = 1e-4
FEW_TESTED = 1024  # squares whose splats are tested as quickly as they are
BATCH = 1 << 18  # splats merged at once
OFF_GRID = (0.37, 0.37, 0.5)  # of a cell: walls and ground at round numbers lie within one
_ODD = np.uint64(0x9E3779B97F4A7C15)
_BIAS = 1 << 21  # half the squares that keys can tell apart along an axis
_SPREAD = ((16, 0x0000FFFF0000FFFF), (8, 0x00FF00FF00FF00FF), (4, 0x0F0F0F0F0F0F0F0F),
           (2, 0x3333333333333333), (1, 0x5555555555555555))  # fmt: skip
_SPREAD_BY_TWO = (
    (32, 0x001F00000000FFFF), (16, 0x001F0000FF0000FF), (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249))  # fmt: skip
_LEVELS = ("levels of detail",)  # where a memo has them
_STORED = (*_LEVELS, False)
_COLUMNS = ("means", "quats", "scales", "opacities", "sh")


# ---- What levels are -----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Squares:
    """S squares of a level, along a Z-curve.

    keys [S]: increasing; those of the next level are these without their last two bits. starts
    [S + 1]: the splats of each. lows, highs [S, 3]: around the means of level 0 in it, metres.
    longest [S]: the largest standard deviation of its splats.
    """

    keys: Int64[np.ndarray, "S"]
    starts: Int64[np.ndarray, "_"]
    lows: Float[np.ndarray, "S 3"]
    highs: Float[np.ndarray, "S 3"]
    longest: Float[np.ndarray, "S"]

    def __len__(self) -> int:
        return len(self.keys)


class Boxes(NamedTuple):
    """Around the means of every CELL splats of a level, [C, 3], and their largest standard
    deviations [C].
    """

    lows: Float[np.ndarray, "C 3"]
    highs: Float[np.ndarray, "C 3"]
    longest: Float[np.ndarray, "C"]

    @staticmethod
    def around(g: Gaussians, starts: np.ndarray) -> Boxes:
        """Of the splats from each start to the next."""
        means, longest = g.means.numpy(), g.scales.numpy().max(1)
        lows, highs = (f.reduceat(means, starts) for f in (np.minimum, np.maximum))
        return Boxes(lows, highs, np.maximum.reduceat(longest, starts))

    @staticmethod
    def join(boxes: Sequence[Boxes]) -> Boxes:
        return Boxes(*map(np.concatenate, zip(*boxes, strict=True)))

    def bounds(self, rows: np.ndarray) -> Bounds:
        lows, highs = self.lows[rows].astype(np.float64), self.highs[rows].astype(np.float64)
        owners = np.zeros(len(rows), np.int64)
        return Bounds((lows + highs) / 2, (highs - lows) / 2, self.longest[rows], owners)


@dataclass(frozen=True, eq=False)
class Level:
    """Splats, square after square, neighbours together. stands_for [N]: the part's own splat whose
    number and class each has. unchecked: the file that they come from, whose numbers are looked at
    when they are taken. splats: of the part, where it is unchecked. parents [N]: the splat of the
    next level that each is merged into, -1 for none.
    """

    gaussians: Gaussians
    stands_for: Int32[np.ndarray, "N"]
    squares: Squares
    boxes: Boxes
    parents: Int32[np.ndarray, "N"]
    unchecked: str | None = None
    splats: int = 0
    _checked: Bool[np.ndarray, "C"] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_checked", np.zeros(len(self.boxes.longest), bool))

    def check(self, cells: Int64[np.ndarray, "_"]) -> None:
        """Look at the numbers of these CELLs of splats, once."""
        if self.unchecked is None:
            return
        cells = np.unique(cells[~self._checked[cells]])
        ends = (np.diff(cells) != 1) | (cells[1:] % (BATCH // CELL) == 0)
        for run in np.split(cells, np.flatnonzero(ends) + 1) if len(cells) else []:
            rows = slice(int(run[0]) * CELL, min(int(run[-1] + 1) * CELL, len(self.gaussians)))
            numbers = self.stands_for[rows]
            is_own = numbers.min() >= 0 and numbers.max() < self.splats
            where = f"{self.unchecked}: splats {rows.start} to {rows.stop}"
            _check(rows_of(self.gaussians, rows), bool(is_own), where)
        self._checked[cells] = True


class Tree(NamedTuple):
    """The squares of all levels, [S], those of level 0 first. numbers: their levels. parents: the
    square that holds each, -1 for none. firsts, ends: of their splats. cells_m: c_k; 0 of level 0.
    cells: the Boxes of all levels; cell_starts: where each level's begin.
    """

    boxes: Boxes
    numbers: Int64[np.ndarray, "S"]
    parents: Int64[np.ndarray, "S"]
    firsts: Int64[np.ndarray, "S"]
    ends: Int64[np.ndarray, "S"]
    cells_m: Float[np.ndarray, "S"]
    cells: Boxes
    cell_starts: Int64[np.ndarray, "_"]


@dataclass(frozen=True, eq=False)
class Levels:
    """Of a part, the finest first. finest_m: c_1."""

    finest_m: float
    levels: tuple[Level, ...]

    @cached_property
    def tree(self) -> Tree:
        squares, cells = [own.squares for own in self.levels], [own.boxes for own in self.levels]
        counts = [len(own) for own in squares]
        numbers = np.repeat(np.arange(len(counts)), counts)
        starts, parents = np.cumsum([0, *counts]), np.full(sum(counts), -1)
        for number, (finer, own) in enumerate(itertools.pairwise(squares)):
            above = starts[number + 1] + np.searchsorted(own.keys, finer.keys >> 2)
            parents[starts[number] : starts[number + 1]] = above
        return Tree(
            Boxes.join([Boxes(own.lows, own.highs, own.longest) for own in squares]),
            numbers,
            parents,
            np.concatenate([own.starts[:-1] for own in squares]),
            np.concatenate([own.starts[1:] for own in squares]),
            np.where(numbers > 0, self.finest_m * 2.0 ** (numbers - 1), 0),
            Boxes.join(cells),
            np.cumsum([0, *(len(own.longest) for own in cells)]),
        )

    def cell_m(self, number: int) -> float:
        return self.finest_m * 2.0 ** (number - 1)


def rows_of(g: Gaussians, rows: slice) -> Gaussians:
    """A piece of the Gaussians that copies nothing."""
    means, quats, scales, opacities, sh = (getattr(g, name).detach()[rows] for name in _COLUMNS)
    semantic = None if g.semantic is None else g.semantic[rows]
    return Gaussians(means, quats, scales, opacities, sh, semantic)


def _check(g: Gaussians, is_numbered: bool, where: str) -> None:
    usual = replace(g, opacities=g.opacities.clamp(max=1))
    classes = [0] if g.semantic is None else [int(g.semantic.min()), int(g.semantic.max())]
    is_classed = min(SemanticClass) <= min(classes) and max(classes) <= max(SemanticClass)
    is_clear = float(g.opacities.max()) <= MAX_OPACITY * (1 + 1e-6)
    if not (is_numbered and is_classed and is_clear and is_drawable(usual)):
        raise SceneError(
            f"{where} holds Gaussians that cannot be drawn: NaN or infinite values, quaternions "
            f"that are not of length 1, scales <= 0, opacities outside [0, {MAX_OPACITY:.4g}], "
            f"coordinates that are too large, or classes or splats that there are not; write the "
            f"scene again"
        )


def check_background(gaussians: Gaussians) -> None:
    """Look at all numbers of a background that lies in a file with its levels, once.

    Raises:
        SceneError: some cannot be drawn.
    """
    if memo_of(gaussians).known(_STORED):
        level = levels_of(gaussians).levels[0]
        level.check(np.arange(len(level.boxes.longest)))


# ---- Merging -------------------------------------------------------------------------------------


class Piece(NamedTuple):
    """Splats of some squares, what each stands for, and the key of its square."""

    gaussians: Gaussians
    stands_for: Int32[np.ndarray, "N"]
    keys: Int64[np.ndarray, "N"]


def levels_of(gaussians: Gaussians, *, antialiased: bool = False) -> Levels:
    """The levels of a part, made once for these Gaussians."""

    def make() -> Levels:
        stored = known_of(gaussians.means, "levels", lambda: None)
        if stored is None or antialiased or not _has_shapes(gaussians, stored.levels[0].gaussians):
            return build_levels(gaussians, antialiased=antialiased)
        return edited_levels(stored, gaussians)

    return memo_of(gaussians).get((*_LEVELS, antialiased), make)


def keep_levels(gaussians: Gaussians, levels: Levels) -> None:
    """Let `levels_of` know levels that lie in a file. levels: must not hold this object, or its
    means.
    """
    memo_of(gaussians).put(_STORED, levels, shared=True)
    known_of(gaussians.means, "levels", lambda: levels)


def _has_shapes(g: Gaussians, other: Gaussians) -> bool:
    return all(getattr(g, n).data_ptr() == getattr(other, n).data_ptr() for n in _COLUMNS[:3])


def edited_levels(levels: Levels, g: Gaussians) -> Levels:
    """The levels of Gaussians that have other colours, or let more through: mean colours and sums
    of opacities are taken anew, where nothing moves.

    Raises:
        SceneError: the levels' file is damaged.
    """
    edited = [replace(levels.levels[0], gaussians=rows_of(g, slice(None)), unchecked=None)]
    for finer, own in itertools.pairwise(levels.levels):
        if len(finer.parents) and not -1 <= finer.parents.min() <= finer.parents.max() < len(
            own.gaussians
        ):
            raise SceneError(f"{own.unchecked}: parents must be splats of the next level")
        edited.append(replace(own, gaussians=_reweighed(finer, edited[-1].gaussians, own)))
    return replace(levels, levels=tuple(edited))


def _reweighed(finer: Level, g: Gaussians, own: Level) -> Gaussians:
    """The splats of a level as the finer ones' new opacities and colours make them."""
    count, functions = len(own.gaussians), g.sh.shape[1]
    before, after, sh = np.zeros(count), np.zeros(count), np.zeros((count, functions * 3))
    for rows in batches(len(g)):
        into = finer.parents[rows]
        merged = np.flatnonzero(into >= 0)
        if not len(merged):
            continue
        into = into[merged]
        first, end = int(into.min()), int(into.max()) + 1
        a, b, c = g.scales[rows].double().numpy()[merged].T
        area, size = a * b + b * c + c * a, end - first
        weights = area * g.opacities[rows].numpy()[merged]
        whole = area * finer.gaussians.opacities[rows].numpy()[merged]
        before[first:end] += np.bincount(into - first, whole, size)
        after[first:end] += np.bincount(into - first, weights, size)
        values = g.sh[rows].reshape(-1, functions * 3).numpy()[merged]
        for column in range(functions * 3):
            own_sum = np.bincount(into - first, weights * values[:, column], size)
            sh[first:end, column] += own_sum
    is_left = (after > 0) & (before > 0)
    left = np.where(is_left, after / np.where(is_left, before, 1), 0)
    known = np.where(is_left, after, 1)[:, None]
    mean = np.where(is_left[:, None], sh / known, own.gaussians.sh.reshape(count, -1).numpy())
    return replace(
        own.gaussians,
        opacities=own.gaussians.opacities * torch.from_numpy(left).clamp(max=1).float(),
        sh=torch.from_numpy(mean.astype(np.float32)).reshape(own.gaussians.sh.shape),
    )


def keeps_levels(gaussians: Gaussians) -> bool:
    """Whether levels lie in a file with these Gaussians."""
    is_known = memo_of(gaussians).known(_STORED)
    return is_known and levels_of(gaussians).levels[0].unchecked is not None


def join_pieces(pieces: Iterable[Piece]) -> Piece:
    """All pieces in memory."""
    gaussians, stands_for, keys = zip(*pieces, strict=True)
    own = {name: torch.cat([getattr(g, name) for g in gaussians]) for name in _COLUMNS}
    classes = [g.semantic for g in gaussians if g.semantic is not None]
    joined = Gaussians(**own, semantic=torch.cat(classes) if classes else None)
    return Piece(joined, np.concatenate(stands_for), np.concatenate(keys))


def build_levels(
    gaussians: Gaussians,
    *,
    antialiased: bool = False,
    keep: Callable[[Iterable[Piece]], Piece] = join_pieces,
) -> Levels:
    """The levels of one Gaussian or more. Level 0 is a copy, unless they lie square after square
    already.

    antialiased: for a rasteriser whose blur takes no more of the image. keep: where a level lies.
    """
    own = rows_of(gaussians, slice(None))
    finest_m, order, keys = square_order(own)
    found = Piece(own, order.astype(np.int32), keys)
    if not (np.diff(found.stands_for) == 1).all():
        found = keep(
            Piece(own.select(torch.from_numpy(order[rows])), *(v[rows] for v in found[1:]))
            for rows in batches(len(order))
        )
    levels = [level_of(found)]
    while len(levels[-1].squares) > FEW_SQUARES and len(levels) <= MAX_LEVELS:
        cell_m = finest_m * 2.0 ** (len(levels) - 1)
        found = keep(coarser(levels[-1], cell_m, antialiased=antialiased))
        levels.append(level_of(found, levels[-1].squares))
    return Levels(finest_m, tuple(levels))


def square_order(g: Gaussians) -> tuple[float, Int64[np.ndarray, "N"], Int64[np.ndarray, "N"]]:
    """c_1; the splats square after square of level 0, neighbours together; their squares."""
    finest_m = finest_cell_m(g.means)
    side_m = finest_m * CELLS_ACROSS
    keys = square_keys(g.means, side_m)
    for rows in batches(len(keys)):
        within = np.floor(g.means[rows].double().numpy() / (side_m / 32)).astype(np.int64) & 31
        keys[rows] = (keys[rows] << 15) | _along_curve(within)
    order = np.argsort(keys, kind="stable")
    return finest_m, order, keys[order] >> 15


def batches(count: int) -> Iterator[slice]:
    return (slice(first, min(first + BATCH, count)) for first in range(0, count, BATCH))


def finest_cell_m(means: Float[Tensor, "N 3"]) -> float:
    """c_1: by a sixteenth of the cells and all splats in them."""
    for cell_m in CELLS_M:
        sampled = []
        for rows in batches(len(means)):
            numbers = _cells(means[rows], cell_m)
            sampled.append(numbers[(numbers.astype(np.uint64) * _ODD) >> np.uint64(60) == 0])
        numbers = np.concatenate(sampled)
        if len(np.unique(numbers)) <= MOST_LEFT * len(numbers):
            return cell_m
    return CELLS_M[-1]


def square_keys(means: Float[Tensor, "N 3"], side_m: float) -> Int64[np.ndarray, "N"]:
    """The square of each mean, along a Z-curve."""
    keys = np.empty(len(means), np.int64)
    for rows in batches(len(means)):
        xy = np.floor(means[rows, :2].double().numpy() / side_m)
        bits = (np.clip(xy, -_BIAS, _BIAS - 1).astype(np.int64) + _BIAS).astype(np.uint64)
        for shift, mask in _SPREAD:
            bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
        keys[rows] = (bits[:, 0] | (bits[:, 1] << np.uint64(1))).astype(np.int64)
    return keys


def _cells(means: Float[Tensor, "N 3"], cell_m: float) -> Int64[np.ndarray, "N"]:
    """The cell of each mean, along a Morton curve."""
    places = np.floor(means.double().numpy() / cell_m + OFF_GRID).astype(np.int64)
    return _along_curve(places & (_BIAS - 1))


def _along_curve(places: Int64[np.ndarray, "N 3"]) -> Int64[np.ndarray, "N"]:
    """Places of 21 bits along a Morton curve."""
    bits = places.astype(np.uint64)
    for shift, mask in _SPREAD_BY_TWO:
        bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
    x, y, z = bits.T
    return (x | (y << np.uint64(1)) | (z << np.uint64(2))).astype(np.int64)


def level_of(found: Piece, finer: Squares | None = None) -> Level:
    """found: square after square. finer: of the level before; None for level 0."""
    g = found.gaussians
    firsts = np.flatnonzero(np.diff(found.keys, prepend=-1))
    own, starts = found.keys[firsts], np.append(firsts, len(found.keys))
    lows, highs, longest = Boxes.around(g, firsts)
    if finer is not None:
        firsts = np.searchsorted(finer.keys >> 2, own)
        lows = np.minimum.reduceat(finer.lows, firsts)
        highs = np.maximum.reduceat(finer.highs, firsts)
    boxes = Boxes.around(g, np.arange(0, len(g), CELL))
    parents = np.full(len(g), -1, np.int32)
    return Level(g, found.stands_for, Squares(own, starts, lows, highs, longest), boxes, parents)


def coarser(finer: Level, cell_m: float, *, antialiased: bool = False) -> Iterator[Piece]:
    """The next level, a few squares at a time; `finer` learns its parents. cell_m: its cells."""
    keys = finer.squares.keys >> 2
    firsts = np.append(np.flatnonzero(np.diff(keys, prepend=-1)), len(keys))
    starts = finer.squares.starts[firsts]
    blur_m = 0.0 if antialiased else BLUR_CELLS * cell_m
    first, count = 0, 0
    while first < len(starts) - 1:
        end = max(int(np.searchsorted(starts, starts[first] + BATCH, "right")) - 1, first + 1)
        rows = slice(int(starts[first]), int(starts[end]))
        squares = np.repeat(keys[firsts[first:end]], np.diff(starts[first : end + 1]))
        merged, leads, into = merge_cells(rows_of(finer.gaussians, rows), squares, cell_m, blur_m)
        finer.parents[rows] = np.where(into < 0, -1, into + count)
        count += len(leads)
        yield Piece(merged, finer.stands_for[rows][leads], squares[leads])
        first = end


def merge_cells(
    g: Gaussians, squares: Int64[np.ndarray, "N"], cell_m: float, blur_m: float
) -> tuple[Gaussians, Int64[np.ndarray, "M"], Int64[np.ndarray, "N"]]:
    """The splats of each cell merged into one, square after square.

    squares [N]: the number of each splat's square, increasing. blur_m: standard deviation of the
    rasteriser's blur. Splats that are too clear to be drawn are left out. Returns also the splat
    that stands for each merged one, the heaviest of the class that weighs most; and which one each
    is merged into, -1 for none.
    """
    kept = np.flatnonzero(g.opacities.numpy() >= ALPHA_MIN)
    longest, squares = g.scales.numpy().max(1)[kept], squares[kept]
    cells, is_large = _cells(g.means, cell_m)[kept], longest > cell_m
    wide = _cells(g.means, 2 * cell_m)[kept]
    alike = _alike(g.sh.numpy()[kept, 0], longest > 2 * cell_m, wide, squares)
    cells, is_large = np.where(alike, ~wide, cells), is_large & ~alike
    order, begins = _grouped(is_large, cells, squares)
    begins |= is_large[order]
    order, starts = kept[order], np.flatnonzero(begins)
    counts = np.diff(starts, append=len(order))
    leads, several = order[starts], counts > 1
    into = np.full(len(g), -1)
    into[order] = np.repeat(np.arange(len(starts)), counts)
    at = np.flatnonzero(several)
    if not len(at):
        return g.select(torch.from_numpy(leads)), leads, into
    rows = order[np.repeat(several, counts)]
    firsts = np.cumsum(counts[at]) - counts[at]
    merged, heaviest = merge_groups(g.select(torch.from_numpy(rows)), firsts, blur_m)
    leads[at] = rows[heaviest]
    out = g.select(torch.from_numpy(leads))
    for name in _COLUMNS:
        getattr(out, name)[torch.from_numpy(at)] = getattr(merged, name).to(g.means.dtype)
    return out, leads, into


def _grouped(is_apart: np.ndarray, cells: np.ndarray, squares: np.ndarray) -> tuple:
    """An order in which the splats of a square's cell stand together, and where such groups begin;
    those that stand apart are not among them.
    """
    order = np.lexsort((is_apart, cells, squares))
    begins = np.ones(len(order), bool)
    begins[1:] = np.diff(is_apart[order]) != 0
    for column in (cells, squares):
        begins[1:] |= np.diff(column[order]) != 0
    return order, begins


def _alike(
    sh: Float[np.ndarray, "N 3"], is_large: np.ndarray, cells: np.ndarray, squares: np.ndarray
) -> Bool[np.ndarray, "N"]:
    """Which splats share a cell with others, all of nearly one colour. sh: of degree 0."""
    order, begins = _grouped(is_large, cells, squares)
    starts = np.flatnonzero(begins)
    counts = np.diff(starts, append=len(order))
    lows, highs = (f.reduceat(sh[order], starts) for f in (np.minimum, np.maximum))
    is_one = (SH_C0 * (highs - lows).max(1) <= ALIKE) & (counts > 1)
    found = np.zeros(len(order), bool)
    found[order] = np.repeat(is_one, counts)
    return found & ~is_large


def merge_groups(
    g: Gaussians, firsts: Int64[np.ndarray, "M"], blur_m: float
) -> tuple[Gaussians, Int64[np.ndarray, "M"]]:
    """One Gaussian for each group of rows, float64, and the row that stands for it. firsts: the
    first row of each group.
    """
    groups = np.repeat(np.arange(len(firsts)), np.diff(firsts, append=len(g)))
    a, b, c = (scales := g.scales.double().numpy()).T
    opacities = g.opacities.double().numpy()
    weights = opacities * (a * b + b * c + c * a)
    shares = weights / np.add.reduceat(weights, firsts)[groups]

    def mean(values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(shares.reshape(-1, *[1] * (values.ndim - 1)) * values, firsts)

    means = g.means.double().numpy()
    centres = mean(means)
    off = means - centres[groups]
    halves = rotmat_from_quat(g.quats.double()).numpy() * scales[:, None]
    own = halves @ halves.transpose(0, 2, 1)
    variances, axes = np.linalg.eigh(mean(own + off[:, :, None] * off[:, None]))
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    # The plane that the group lies in, its deviations as units.
    units = np.sqrt(np.maximum(variances[:, 1:], THINNEST_M**2) + blur_m**2)
    plane = (axes[:, :, 1:] / units[:, None])[groups]
    flat = plane.transpose(0, 2, 1) @ own @ plane
    flat[:, [0, 1], [0, 1]] += (blur_m / units[groups]) ** 2
    covered = np.empty(len(firsts))
    with kernel_threads():
        kernels.covered_plane(
            *(np.append(firsts, len(g)), opacities, (off[:, None] @ plane)[:, 0], flat, covered)
        )
    ratio = covered / (2 * math.pi)  # of what a Gaussian of opacity 1 covers
    flat_top = np.exp(np.minimum(ratio, FLAT_TOP) - 1)
    variances[:, 1:] += (np.maximum(ratio / FLAT_TOP, 1) - 1)[:, None] * units**2
    merged = (
        centres,
        quat_from_rotmat(torch.from_numpy(axes)).numpy(),
        np.sqrt(np.maximum(variances, THINNEST_M**2)),
        np.where(ratio <= 1, ratio, flat_top),
        mean(g.sh.double().numpy()),
    )
    return Gaussians(*map(torch.from_numpy, merged)), _heaviest(g, weights, groups)


def _heaviest(g: Gaussians, weights: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """The heaviest row of the heaviest class of each group."""
    classes = np.zeros(len(g), np.int16) if g.semantic is None else g.semantic.numpy()
    order = np.lexsort((-weights, classes, groups))
    group, kind = groups[order], classes[order]
    runs = np.flatnonzero(
        (np.diff(group, prepend=-1) != 0) | (np.diff(kind, prepend=kind[:1]) != 0)
    )
    sums = np.add.reduceat(weights[order], runs)
    best = np.lexsort((-sums, group[runs]))
    return order[runs[best[np.flatnonzero(np.diff(group[runs][best], prepend=-1))]]]


# ---- Which of them a camera takes ----------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Chosen:
    """Parts to draw in place of `parts`. pieces: of each, what its splats stand for among those of
    all parts: a first number, and numbers that are added to it (None: 0, 1, ...).
    """

    parts: tuple[PosedGaussians, ...]
    pieces: tuple[tuple[int, Int32[np.ndarray, "_"] | None], ...]

    def restore_ids(self, drawn: RenderOutput) -> RenderOutput:
        """The buffers with splat_ids that count through the parts which these stand for."""
        if drawn.splat_ids is None:
            return drawn
        ids = drawn.splat_ids.cpu().numpy()
        starts = np.cumsum([0, *(len(part.gaussians) for part in self.parts)])
        pieces, found = np.searchsorted(starts, ids, "right") - 1, np.full_like(ids, -1)
        for number, (first, stands_for) in enumerate(self.pieces):
            shown = pieces == number
            own = ids[shown] - starts[number]
            found[shown] = first + (own if stands_for is None else stands_for[own])
        return replace(drawn, **{SPLAT_IDS: torch.from_numpy(found).to(drawn.splat_ids)})


def choose_parts(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    settings: RasterSettings,
    fog: Fog | None = None,
    clip: HeightClip | None = None,
    *,
    whole: bool = True,
) -> Chosen:
    """What the camera takes of large backgrounds at settings.lod_px, and all other parts.

    whole: take levels whole, and say which rows are drawn; else a part for every run of rows.
    """
    chosen, pieces, first = list[PosedGaussians](), list[tuple[int, np.ndarray | None]](), 0
    for part in parts:
        own = [(part, None)]
        if has_levels(part):
            levels = levels_of(part.gaussians, antialiased=settings.antialiased)
            taken = [*_taken(levels, part, camera, settings, fog, clip)]
            if _is_merged(levels, taken):
                own = (piece for t in taken for piece in _pieces(t, part, whole=whole))
        for piece, stands_for in own:
            chosen.append(piece)
            pieces.append((first, stands_for))
        first += len(part.gaussians)
    if not chosen:  # a rasteriser wants to know at least the parts' type
        nothing = rows_of(parts[0].gaussians, slice(0))
        chosen.append(replace(parts[0], gaussians=nothing, color_maps=None, color_rows=None))
        pieces.append((0, None))
    return Chosen(tuple(chosen), tuple(pieces))


def has_levels(part: PosedGaussians) -> bool:
    """Whether a part is drawn in levels: actors and what lies on the scene are not."""
    is_plain = part.instance_id == 0 and not part.is_overlay and part.shading is None
    g = part.gaussians
    return is_plain and len(g) >= MIN_SPLATS and g.means.device.type == "cpu"


class _Taken(NamedTuple):
    """Runs of a level's splats, [R, 2], and the share of each, [R]."""

    level: Level
    rows: Int64[np.ndarray, "R 2"]
    shares: Float[np.ndarray, "R"]


def _is_merged(levels: Levels, taken: Sequence[_Taken]) -> bool:
    """Whether levels are drawn: where all splats are those of level 0, the part is as it is."""
    is_open = levels.levels[0].unchecked is None
    return not is_open or any(t.level is not levels.levels[0] for t in taken)


def _pieces(
    taken: _Taken, part: PosedGaussians, *, whole: bool
) -> Iterator[tuple[PosedGaussians, np.ndarray]]:
    level, is_faded = taken.level, taken.shares < 1
    is_small = len(level.gaussians) <= BATCH  # then a copy costs less than another part
    for chosen in [np.ones_like(is_faded)] if is_small else [~is_faded, is_faded]:
        rows, shares, g = taken.rows[chosen], taken.shares[chosen], level.gaussians
        if not len(rows):
            continue
        if shares.min() < 1:
            own = g.opacities.numpy()  # NumPy wakes no threads
            opacities = torch.from_numpy(own.copy() if is_small else np.empty_like(own))
            for (first, last), share in zip(rows.tolist(), shares.tolist(), strict=True):
                if share < 1:
                    opacities[first:last] = faded(g.opacities[first:last], share)
            g = replace(g, opacities=opacities)
        color_rows = None
        if part.color_rows is not None:
            color_rows = torch.empty(len(g), dtype=torch.int16)
            for own in itertools.starmap(slice, rows.tolist()):
                color_rows[own] = part.color_rows[torch.from_numpy(level.stands_for[own]).long()]
        piece = replace(part, gaussians=g, color_rows=color_rows, rows=rows)
        if whole:
            yield piece, level.stands_for
            continue
        for own in itertools.starmap(slice, rows.tolist()):
            of_run = None if color_rows is None else color_rows[own]
            run = replace(piece, gaussians=rows_of(g, own), color_rows=of_run, rows=None)
            yield run, level.stands_for[own]


def faded(opacities: Float[Tensor, "N"], share: float) -> Float[Tensor, "N"]:
    """Of splats that are drawn for a share of what they hide."""
    own = opacities.numpy()
    low = np.clip(own, 1e-6, 0.99)  # flat tops, which have more, fade in proportion
    return torch.from_numpy(own * (-np.expm1(share * np.log1p(-low)) / low))


def _taken(
    levels: Levels,
    part: PosedGaussians,
    camera: Camera,
    settings: RasterSettings,
    fog: Fog | None,
    clip: HeightClip | None,
) -> Iterator[_Taken]:
    """Of each level, what may be seen of the squares that the camera takes."""
    pose = None if part.world_from_part is None else part.world_from_part.numpy()
    tree = levels.tree
    taken, shares = squares_taken(levels, part, camera, settings)
    if len(taken) > FEW_TESTED:
        seen = may_be_drawn(tree.boxes.bounds(taken), pose, camera, settings, fog, clip)
        taken, shares = taken[seen], shares[seen]
    low = tree.firsts[taken] // CELL
    counts = -(-tree.ends[taken] // CELL) - low
    owner = np.repeat(np.arange(len(taken)), counts)
    cells = np.arange(len(owner)) + (low - counts.cumsum() + counts)[owner]
    inside = tree.cells.bounds(cells + tree.cell_starts[tree.numbers[taken]][owner])
    seen = may_be_drawn(inside, pose, camera, settings, fog, clip)
    cells, owner = cells[seen], owner[seen]
    square = taken[owner]
    first = np.maximum(tree.firsts[square], cells * CELL)
    end = np.minimum(tree.ends[square], (cells + 1) * CELL)
    begins = np.ones(len(first), bool)
    begins[1:] = (first[1:] != end[:-1]) | (np.diff(shares[owner]) != 0)
    begins[1:] |= np.diff(tree.numbers[square]) != 0
    heads = np.flatnonzero(begins)
    rows = np.stack([first[heads], end[np.append(heads[1:], len(first))[: len(heads)] - 1]], 1)
    number_of, share_of = tree.numbers[square[heads]], shares[owner[heads]]
    for number, level in enumerate(levels.levels):
        own = number_of == number
        if own.any():
            level.check(cells[tree.numbers[square] == number])
            yield _Taken(level, rows[own], share_of[own])


def squares_taken(
    levels: Levels, part: PosedGaussians, camera: Camera, settings: RasterSettings
) -> tuple[Int64[np.ndarray, "T"], Float[np.ndarray, "T"]]:
    """The tree's squares that the camera takes, wherever it looks, and their shares."""
    eye_m = camera.centre.numpy()
    if part.world_from_part is not None:
        eye_m = np.linalg.solve(part.world_from_part.numpy(), np.append(eye_m, 1.0))[:3]
    tree = levels.tree
    cell_px = max(camera.fx, camera.fy) * tree.cells_m / settings.lod_px
    if camera.is_orthographic:
        refined = (cell_px > 1).astype(np.float64)
    else:
        beside_m = np.maximum(tree.boxes.lows - eye_m, eye_m - tree.boxes.highs)
        away_m = np.linalg.norm(np.maximum(beside_m, 0), axis=1)
        refined = np.clip((1 + BAND - away_m / np.maximum(cell_px, 1e-9)) / BAND, 0, 1)
    refined[tree.numbers == 0] = 0
    # Whatever holds a square that is refined at all is refined wholly: d_k doubles.
    shares = (1 - refined) * np.append(refined, 1)[tree.parents]
    taken = np.flatnonzero(shares > 0)
    return taken, shares[taken]
