"""Levels of detail: splats merged once a scene, and the choice of levels for one camera.

In: the Gaussians of a large background (`levels_of` builds `Levels`, once). Out: `choose_parts`
gives the parts that a camera needs, in place of the whole background. `rasterize` calls it where
recipe.render.speed.lod_px > 0; `augment.files.level_file` stores levels beside a scene.

The ground is cut into squares. Level 0 of a square holds its own splats. Level k holds, for a
square of twice the side, the splats of level k - 1, with those merged that share a cell of side

    c_k = c_1 2^(k-1).

So a square of any level holds about as many splats, and the squares are the nodes of a quadtree.
For a camera of focal length f, level k serves squares at a distance of at least

    d_k = f c_k / lod_px,

where a cell is no larger than lod_px pixels. From d_k to (1 + FADE_BAND) d_k a square fades into
the square that holds it. The two have shares w and 1 - w, and a splat of opacity o is drawn with 1
- (1 - o)^w, so that transmittances, which multiply, stay those of one level. Distances are
Euclidean, and a square's is never below that of the square that holds it. So shares add up to 1,
change without a step as the camera moves, and stay the same when it turns.

Splats whose colours differ by less than MAX_COLOR_DIFFERENCE are merged in cells of 2 c_k. Merging
keeps the moments of the mixture and its mean colour:

    mu = sum w_i mu_i,    Sigma = sum w_i (Sigma_i + (mu_i - mu)(mu_i - mu)^T).

The weights w_i are opacity times surface; splats larger than the cell stay as they are. Merging
also keeps the area that the splats cover together in the plane that they lie in, at the width that
the rasteriser's blur gives them where the level serves. Where this takes a flat top, the opacity is
above 1: alpha is min(alpha_max, o exp(-sigma)). (Kerbl et al. 2024, "A Hierarchical 3D Gaussian
Representation for Real-Time Rendering of Very Large Datasets", section 4.1, weighs so, and has such
opacities.)
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

from augment.detail.lod_kernels import sum_covered_areas
from augment.errors import SceneError
from augment.memo import memo_of
from augment.render.buffers import SPLAT_IDS, RenderOutput
from augment.render.constants import ALPHA_MIN, COV2D_BLUR, RasterSettings
from augment.render.cpu.order import CELL_SIZE, cached_of_tensor, find_visible_boxes
from augment.render.fog import Fog
from augment.render.layout import HeightClip
from augment.render.sh import SH_C0
from augment.render.threads import kernel_threads
from augment.scene.bounds import Bounds
from augment.scene.cameras import Camera
from augment.scene.geometry import quat_from_rotmat, rotmat_from_quat
from augment.scene.scene import Gaussians, PosedGaussians, is_drawable
from augment.scene.semantics import SemanticClass

# Splats of a part below which it is drawn as it is.
MIN_SPLATS = 20_000
# Candidates of c_1, metres: the first is taken whose cells leave at most MAX_REMAINING_SHARE of the
# splats.
CELLS_M = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
# Share of the splats that merging in the finest cells may leave.
MAX_REMAINING_SHARE = 0.6
# Cells of c_1 along a square of level 0.
CELLS_ACROSS = 64
# Levels that a part has at most, above level 0.
MAX_LEVELS = 12
# Squares of a level from which no further level is made.
MIN_SQUARES = 4
# Width of the band in which levels fade, as a part of d_k.
FADE_BAND = 0.12
# Largest difference of alike colours, of 1, in each channel of the encoded colours.
MAX_COLOR_DIFFERENCE = 0.03
# Standard deviation of the rasteriser's blur, in cells. A pixel is 1 to 2 cells where a level
# serves with lod_px = 1.
BLUR_CELLS = math.sqrt(2 * COV2D_BLUR)
# Area that a flat top covers at most, over the area by its standard deviations; beyond it the
# deviations grow.
FLAT_TOP = 2.0
# Largest opacity of a merged splat.
MAX_OPACITY = math.exp(FLAT_TOP - 1)
# Smallest standard deviation of a merged splat, metres.
MIN_SCALE_M = 1e-4
# Number of squares up to which testing their splats takes no longer than testing the squares.
MAX_UNTESTED_SQUARES = 1024
# Splats that are merged at once.
MERGE_BATCH = 1 << 18
# Offset of the cells' grid, in cells: walls and ground at round numbers then lie inside one cell.
GRID_OFFSET_CELLS = (0.37, 0.37, 0.5)
# Odd factor that mixes the bits of cell numbers.
_ODD = np.uint64(0x9E3779B97F4A7C15)
# Half the number of squares that keys can tell apart along an axis.
_BIAS = 1 << 21
# Shifts and masks that spread the bits of a number to every second bit.
_SPREAD = (
    (16, 0x0000FFFF0000FFFF),
    (8, 0x00FF00FF00FF00FF),
    (4, 0x0F0F0F0F0F0F0F0F),
    (2, 0x3333333333333333),
    (1, 0x5555555555555555),
)
# Shifts and masks that spread the bits of a number to every third bit.
_SPREAD_BY_TWO = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
# Key of the levels in a memo; `antialiased` follows.
_LEVELS = ("levels of detail",)
# Key of the levels that may lie in a file.
_STORED = (*_LEVELS, False)
# Fields of Gaussians that merged splats have.
_COLUMNS = ("means", "quats", "scales", "opacities", "sh")


# ---- Records of levels ---------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Squares:
    """S squares of a level, along a Z-curve."""

    keys: Int64[np.ndarray, "S"]
    """Numbers of the squares along the curve, increasing; those of the next level are these without
    their last two bits."""
    starts: Int64[np.ndarray, "_"]
    """First splat of each square, and the number of all splats, [S + 1]."""
    lows: Float[np.ndarray, "S 3"]
    """Lowest corner of the means of level 0 in each square, metres."""
    highs: Float[np.ndarray, "S 3"]
    """Highest corner of the means of level 0 in each square, metres."""
    longest: Float[np.ndarray, "S"]
    """Largest standard deviation of each square's splats, metres."""

    def __len__(self) -> int:
        return len(self.keys)


class SplatBoxes(NamedTuple):
    """Boxes around the means of every CELL_SIZE splats of a level."""

    lows: Float[np.ndarray, "C 3"]
    """Lowest corners, metres."""
    highs: Float[np.ndarray, "C 3"]
    """Highest corners, metres."""
    longest: Float[np.ndarray, "C"]
    """Largest standard deviation of the splats in each box, metres."""

    @staticmethod
    def around(g: Gaussians, starts: np.ndarray) -> SplatBoxes:
        """Return boxes around the splats from each start to the next."""
        means = g.means.numpy()
        longest = g.scales.numpy().max(1)
        lows, highs = (f.reduceat(means, starts) for f in (np.minimum, np.maximum))
        return SplatBoxes(lows, highs, np.maximum.reduceat(longest, starts))

    @staticmethod
    def join(boxes: Sequence[SplatBoxes]) -> SplatBoxes:
        """Return all boxes, in their order."""
        return SplatBoxes(*map(np.concatenate, zip(*boxes, strict=True)))

    def bounds(self, rows: np.ndarray) -> Bounds:
        """Return some of the boxes as bounds of the background."""
        lows = self.lows[rows].astype(np.float64)
        highs = self.highs[rows].astype(np.float64)
        owners = np.zeros(len(rows), np.int64)
        return Bounds((lows + highs) / 2, (highs - lows) / 2, self.longest[rows], owners)


@dataclass(frozen=True, eq=False)
class Level:
    """Splats of one level, square after square, neighbours together."""

    gaussians: Gaussians
    """The N splats."""
    stands_for: Int32[np.ndarray, "N"]
    """Index of the part's own splat that gives each its number and class, [N]."""
    squares: Squares
    """The squares of the level."""
    boxes: SplatBoxes
    """Boxes around every CELL_SIZE splats."""
    parents: Int32[np.ndarray, "N"]
    """Splat of the next level that each splat is merged into, [N]; -1 for none."""
    unchecked_file: str | None = None
    """Name of the file that the splats come from, whose numbers are checked when they are taken;
    None where they need no check."""
    num_part_splats: int = 0
    """Number of the part's splats, where `unchecked_file` is set."""
    _checked: Bool[np.ndarray, "C"] = field(init=False)
    """Mask of the boxes whose splats have been checked."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "_checked", np.zeros(len(self.boxes.longest), bool))

    def check(self, cells: Int64[np.ndarray, "_"]) -> None:
        """Check the numbers of the splats in some boxes, once.

        Args:
            cells: indices of the boxes of CELL_SIZE splats.
        """
        if self.unchecked_file is None:
            return
        cells = np.unique(cells[~self._checked[cells]])
        ends = (np.diff(cells) != 1) | (cells[1:] % (MERGE_BATCH // CELL_SIZE) == 0)
        for run in np.split(cells, np.flatnonzero(ends) + 1) if len(cells) else []:
            rows = slice(
                int(run[0]) * CELL_SIZE, min(int(run[-1] + 1) * CELL_SIZE, len(self.gaussians))
            )
            numbers = self.stands_for[rows]
            is_own = numbers.min() >= 0 and numbers.max() < self.num_part_splats
            where = f"{self.unchecked_file}: splats {rows.start} to {rows.stop}"
            _check(slice_gaussians(self.gaussians, rows), bool(is_own), where)
        self._checked[cells] = True


class Tree(NamedTuple):
    """The S squares of all levels, those of level 0 first."""

    boxes: SplatBoxes
    """Boxes around the squares."""
    numbers: Int64[np.ndarray, "S"]
    """Level of each square."""
    parents: Int64[np.ndarray, "S"]
    """Square that holds each square; -1 for none."""
    firsts: Int64[np.ndarray, "S"]
    """First splat of each square, in its level."""
    ends: Int64[np.ndarray, "S"]
    """Last splat of each square, plus 1."""
    cells_m: Float[np.ndarray, "S"]
    """c_k of each square's level, metres; 0 at level 0."""
    cells: SplatBoxes
    """Boxes around every CELL_SIZE splats, of all levels."""
    cell_starts: Int64[np.ndarray, "_"]
    """First of `cells` of each level."""


@dataclass(frozen=True, eq=False)
class Levels:
    """Levels of a part, the finest first."""

    finest_m: float
    """c_1, metres."""
    levels: tuple[Level, ...]
    """The levels; levels[k] is level k."""

    @cached_property
    def tree(self) -> Tree:
        """Return the squares of all levels as one tree."""
        level_squares = [level.squares for level in self.levels]
        cells = [level.boxes for level in self.levels]
        counts = [len(level) for level in level_squares]
        numbers = np.repeat(np.arange(len(counts)), counts)
        starts = np.cumsum([0, *counts])
        parents = np.full(sum(counts), -1)
        for number, (finer, level) in enumerate(itertools.pairwise(level_squares)):
            coarse_squares = starts[number + 1] + np.searchsorted(level.keys, finer.keys >> 2)
            parents[starts[number] : starts[number + 1]] = coarse_squares
        return Tree(
            SplatBoxes.join(
                [SplatBoxes(level.lows, level.highs, level.longest) for level in level_squares]
            ),
            numbers,
            parents,
            np.concatenate([level.starts[:-1] for level in level_squares]),
            np.concatenate([level.starts[1:] for level in level_squares]),
            np.where(numbers > 0, self.finest_m * 2.0 ** (numbers - 1), 0),
            SplatBoxes.join(cells),
            np.cumsum([0, *(len(level.longest) for level in cells)]),
        )

    def cell_m(self, number: int) -> float:
        """Return c_k of level k = `number`, metres."""
        return self.finest_m * 2.0 ** (number - 1)


def slice_gaussians(g: Gaussians, rows: slice) -> Gaussians:
    """Return a run of the Gaussians, without a copy."""
    means, quats, scales, opacities, sh = (getattr(g, name).detach()[rows] for name in _COLUMNS)
    semantic = None if g.semantic is None else g.semantic[rows]
    return Gaussians(means, quats, scales, opacities, sh, semantic)


def _check(g: Gaussians, is_numbered: bool, where: str) -> None:
    """Raise SceneError if Gaussians cannot be drawn.

    Args:
        g: the Gaussians, with opacities of merged splats.
        is_numbered: if False, `stands_for` names splats that do not exist.
        where: names the Gaussians in the message.
    """
    clamped = replace(g, opacities=g.opacities.clamp(max=1))
    classes = [0] if g.semantic is None else [int(g.semantic.min()), int(g.semantic.max())]
    has_valid_classes = min(SemanticClass) <= min(classes) and max(classes) <= max(SemanticClass)
    has_valid_opacities = float(g.opacities.max()) <= MAX_OPACITY * (1 + 1e-6)
    if not (is_numbered and has_valid_classes and has_valid_opacities and is_drawable(clamped)):
        raise SceneError(
            f"{where} holds Gaussians that cannot be drawn: NaN or infinite values, quaternions "
            f"that are not of length 1, scales <= 0, opacities outside [0, {MAX_OPACITY:.4g}], "
            f"coordinates that are too large, or classes or splats that there are not; write the "
            f"scene again"
        )


def check_background(gaussians: Gaussians) -> None:
    """Check all numbers of a background that lies in a file with its levels, once.

    Raises:
        SceneError: some cannot be drawn.
    """
    if memo_of(gaussians).has(_STORED):
        level = levels_of(gaussians).levels[0]
        level.check(np.arange(len(level.boxes.longest)))


# ---- Merging -------------------------------------------------------------------------------------


class LevelPiece(NamedTuple):
    """Splats of some squares."""

    gaussians: Gaussians
    """The splats."""
    stands_for: Int32[np.ndarray, "N"]
    """Index of the part's own splat that gives each its number and class."""
    keys: Int64[np.ndarray, "N"]
    """Key of each splat's square."""


def levels_of(gaussians: Gaussians, *, antialiased: bool = False) -> Levels:
    """Return the levels of a part, made once for these Gaussians.

    Args:
        gaussians: the part's Gaussians.
        antialiased: as for `build_levels`.
    """

    def make() -> Levels:
        stored_levels = cached_of_tensor(gaussians.means, "levels", lambda: None)
        if (
            stored_levels is None
            or antialiased
            or not _has_shapes(gaussians, stored_levels.levels[0].gaussians)
        ):
            return build_levels(gaussians, antialiased=antialiased)
        return update_levels(stored_levels, gaussians)

    return memo_of(gaussians).get((*_LEVELS, antialiased), make)


def store_levels(gaussians: Gaussians, levels: Levels) -> None:
    """Let `levels_of` know levels that lie in a file.

    Args:
        gaussians: the part's Gaussians.
        levels: their levels, which must not hold this object or its means.
    """
    memo_of(gaussians).put(_STORED, levels, shared=True)
    cached_of_tensor(gaussians.means, "levels", lambda: levels)


def _has_shapes(g: Gaussians, other: Gaussians) -> bool:
    """Return True if both share the memory of means, quats and scales."""
    return all(getattr(g, n).data_ptr() == getattr(other, n).data_ptr() for n in _COLUMNS[:3])


def update_levels(levels: Levels, g: Gaussians) -> Levels:
    """Return the levels of Gaussians with other colours or lower opacities.

    Nothing moves: mean colours and sums of opacities are computed anew.

    Args:
        levels: the levels of the Gaussians before the edit.
        g: the Gaussians after it.

    Raises:
        SceneError: the levels' file is damaged.
    """
    new_levels = [
        replace(levels.levels[0], gaussians=slice_gaussians(g, slice(None)), unchecked_file=None)
    ]
    for finer, level in itertools.pairwise(levels.levels):
        if len(finer.parents) and not -1 <= finer.parents.min() <= finer.parents.max() < len(
            level.gaussians
        ):
            raise SceneError(f"{level.unchecked_file}: parents must be splats of the next level")
        new_levels.append(
            replace(level, gaussians=_reweigh(finer, new_levels[-1].gaussians, level))
        )
    return replace(levels, levels=tuple(new_levels))


def _reweigh(finer: Level, g: Gaussians, level: Level) -> Gaussians:
    """Return the splats of a level, by the edited opacities and colours of the finer level.

    Args:
        finer: the finer level before the edit.
        g: the finer level's Gaussians after it.
        level: the level before the edit.
    """
    count = len(level.gaussians)
    num_sh = g.sh.shape[1]
    old_weights = np.zeros(count)
    new_weights = np.zeros(count)
    sh = np.zeros((count, num_sh * 3))
    for rows in batches(len(g)):
        targets = finer.parents[rows]
        merged_rows = np.flatnonzero(targets >= 0)
        if not len(merged_rows):
            continue
        targets = targets[merged_rows]
        first = int(targets.min())
        end = int(targets.max()) + 1
        a, b, c = g.scales[rows].double().numpy()[merged_rows].T
        area = a * b + b * c + c * a
        size = end - first
        row_weights = area * g.opacities[rows].numpy()[merged_rows]
        old_row_weights = area * finer.gaussians.opacities[rows].numpy()[merged_rows]
        old_weights[first:end] += np.bincount(targets - first, old_row_weights, size)
        new_weights[first:end] += np.bincount(targets - first, row_weights, size)
        values = g.sh[rows].reshape(-1, num_sh * 3).numpy()[merged_rows]
        for column in range(num_sh * 3):
            channel_sum = np.bincount(targets - first, row_weights * values[:, column], size)
            sh[first:end, column] += channel_sum
    has_weight = (new_weights > 0) & (old_weights > 0)
    opacity_ratio = np.where(has_weight, new_weights / np.where(has_weight, old_weights, 1), 0)
    safe_weights = np.where(has_weight, new_weights, 1)[:, None]
    mean_sh = np.where(
        has_weight[:, None], sh / safe_weights, level.gaussians.sh.reshape(count, -1).numpy()
    )
    return replace(
        level.gaussians,
        opacities=level.gaussians.opacities * torch.from_numpy(opacity_ratio).clamp(max=1).float(),
        sh=torch.from_numpy(mean_sh.astype(np.float32)).reshape(level.gaussians.sh.shape),
    )


def has_stored_levels(gaussians: Gaussians) -> bool:
    """Return True if levels lie in a file with these Gaussians."""
    is_known = memo_of(gaussians).has(_STORED)
    return is_known and levels_of(gaussians).levels[0].unchecked_file is not None


def join_pieces(pieces: Iterable[LevelPiece]) -> LevelPiece:
    """Return all pieces as one, in memory."""
    gaussians, stands_for, keys = zip(*pieces, strict=True)
    columns = {name: torch.cat([getattr(g, name) for g in gaussians]) for name in _COLUMNS}
    classes = [g.semantic for g in gaussians if g.semantic is not None]
    joined_gaussians = Gaussians(**columns, semantic=torch.cat(classes) if classes else None)
    return LevelPiece(joined_gaussians, np.concatenate(stands_for), np.concatenate(keys))


def build_levels(
    gaussians: Gaussians,
    *,
    antialiased: bool = False,
    store_piece: Callable[[Iterable[LevelPiece]], LevelPiece] = join_pieces,
) -> Levels:
    """Build the levels of one Gaussian or more.

    Level 0 is a copy, unless the Gaussians lie square after square already.

    Args:
        gaussians: the Gaussians.
        antialiased: if True, the levels are for a rasteriser whose blur covers no more of the
            image.
        store_piece: puts the pieces of a level where the level is to lie.
    """
    detached = slice_gaussians(gaussians, slice(None))
    finest_m, order, keys = square_order(detached)
    piece = LevelPiece(detached, order.astype(np.int32), keys)
    if not (np.diff(piece.stands_for) == 1).all():
        piece = store_piece(
            LevelPiece(
                detached.select(torch.from_numpy(order[rows])), *(v[rows] for v in piece[1:])
            )
            for rows in batches(len(order))
        )
    levels = [level_of(piece)]
    while len(levels[-1].squares) > MIN_SQUARES and len(levels) <= MAX_LEVELS:
        cell_m = finest_m * 2.0 ** (len(levels) - 1)
        piece = store_piece(build_coarser_level(levels[-1], cell_m, antialiased=antialiased))
        levels.append(level_of(piece, levels[-1].squares))
    return Levels(finest_m, tuple(levels))


def square_order(g: Gaussians) -> tuple[float, Int64[np.ndarray, "N"], Int64[np.ndarray, "N"]]:
    """Return c_1, the order of the splats, and their squares.

    In this order splats lie square after square of level 0, neighbours together.
    """
    finest_m = finest_cell_m(g.means)
    side_m = finest_m * CELLS_ACROSS
    keys = square_keys(g.means, side_m)
    for rows in batches(len(keys)):
        fine_cells = np.floor(g.means[rows].double().numpy() / (side_m / 32)).astype(np.int64) & 31
        keys[rows] = (keys[rows] << 15) | _along_curve(fine_cells)
    order = np.argsort(keys, kind="stable")
    return finest_m, order, keys[order] >> 15


def batches(count: int) -> Iterator[slice]:
    """Return slices that cut `count` rows into runs of MERGE_BATCH."""
    return (slice(first, min(first + MERGE_BATCH, count)) for first in range(0, count, MERGE_BATCH))


def finest_cell_m(means: Float[Tensor, "N 3"]) -> float:
    """Return c_1, chosen by a sixteenth of the cells and all splats in them."""
    for cell_m in CELLS_M:
        sampled_numbers = []
        for rows in batches(len(means)):
            numbers = _cells(means[rows], cell_m)
            sampled_numbers.append(
                numbers[(numbers.astype(np.uint64) * _ODD) >> np.uint64(60) == 0]
            )
        numbers = np.concatenate(sampled_numbers)
        if len(np.unique(numbers)) <= MAX_REMAINING_SHARE * len(numbers):
            return cell_m
    return CELLS_M[-1]


def square_keys(means: Float[Tensor, "N 3"], side_m: float) -> Int64[np.ndarray, "N"]:
    """Return the square of each mean, as its number along a Z-curve."""
    keys = np.empty(len(means), np.int64)
    for rows in batches(len(means)):
        xy = np.floor(means[rows, :2].double().numpy() / side_m)
        bits = (np.clip(xy, -_BIAS, _BIAS - 1).astype(np.int64) + _BIAS).astype(np.uint64)
        for shift, mask in _SPREAD:
            bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
        keys[rows] = (bits[:, 0] | (bits[:, 1] << np.uint64(1))).astype(np.int64)
    return keys


def _cells(means: Float[Tensor, "N 3"], cell_m: float) -> Int64[np.ndarray, "N"]:
    """Return the cell of each mean, as its number along a Morton curve."""
    places = np.floor(means.double().numpy() / cell_m + GRID_OFFSET_CELLS).astype(np.int64)
    return _along_curve(places & (_BIAS - 1))


def _along_curve(places: Int64[np.ndarray, "N 3"]) -> Int64[np.ndarray, "N"]:
    """Return the numbers of cells along a Morton curve, from indices of 21 bits an axis."""
    bits = places.astype(np.uint64)
    for shift, mask in _SPREAD_BY_TWO:
        bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
    x, y, z = bits.T
    return (x | (y << np.uint64(1)) | (z << np.uint64(2))).astype(np.int64)


def level_of(piece: LevelPiece, finer: Squares | None = None) -> Level:
    """Return one level.

    Args:
        piece: the level's splats, square after square.
        finer: squares of the finer level; None at level 0.
    """
    g = piece.gaussians
    firsts = np.flatnonzero(np.diff(piece.keys, prepend=-1))
    keys = piece.keys[firsts]
    starts = np.append(firsts, len(piece.keys))
    lows, highs, longest = SplatBoxes.around(g, firsts)
    if finer is not None:
        firsts = np.searchsorted(finer.keys >> 2, keys)
        lows = np.minimum.reduceat(finer.lows, firsts)
        highs = np.maximum.reduceat(finer.highs, firsts)
    boxes = SplatBoxes.around(g, np.arange(0, len(g), CELL_SIZE))
    parents = np.full(len(g), -1, np.int32)
    return Level(g, piece.stands_for, Squares(keys, starts, lows, highs, longest), boxes, parents)


def build_coarser_level(
    finer: Level, cell_m: float, *, antialiased: bool = False
) -> Iterator[LevelPiece]:
    """Yield the next level, a few squares at a time, and note its splats as parents in `finer`.

    Args:
        finer: the level below.
        cell_m: side of the next level's cells, metres.
        antialiased: as for `build_levels`.
    """
    keys = finer.squares.keys >> 2
    firsts = np.append(np.flatnonzero(np.diff(keys, prepend=-1)), len(keys))
    starts = finer.squares.starts[firsts]
    blur_m = 0.0 if antialiased else BLUR_CELLS * cell_m
    first_square = 0
    count = 0
    while first_square < len(starts) - 1:
        end_square = max(
            int(np.searchsorted(starts, starts[first_square] + MERGE_BATCH, "right")) - 1,
            first_square + 1,
        )
        rows = slice(int(starts[first_square]), int(starts[end_square]))
        squares = np.repeat(
            keys[firsts[first_square:end_square]], np.diff(starts[first_square : end_square + 1])
        )
        merged, leads, targets = merge_cells(
            slice_gaussians(finer.gaussians, rows), squares, cell_m, blur_m
        )
        finer.parents[rows] = np.where(targets < 0, -1, targets + count)
        count += len(leads)
        yield LevelPiece(merged, finer.stands_for[rows][leads], squares[leads])
        first_square = end_square


def merge_cells(
    g: Gaussians, squares: Int64[np.ndarray, "N"], cell_m: float, blur_m: float
) -> tuple[Gaussians, Int64[np.ndarray, "M"], Int64[np.ndarray, "N"]]:
    """Merge the splats of each cell into one, square after square.

    Splats that are too transparent to be drawn are left out.

    Args:
        g: N splats.
        squares: number of each splat's square, increasing.
        cell_m: side of the cells, metres.
        blur_m: standard deviation of the rasteriser's blur, metres.

    Returns:
        The M splats after merging; the row of `g` that stands for each (the heaviest one of the
        class that weighs most); and the merged splat of each row of `g`, -1 for none.
    """
    visible_rows = np.flatnonzero(g.opacities.numpy() >= ALPHA_MIN)
    longest = g.scales.numpy().max(1)[visible_rows]
    squares = squares[visible_rows]
    cells = _cells(g.means, cell_m)[visible_rows]
    is_large = longest > cell_m
    wide_cells = _cells(g.means, 2 * cell_m)[visible_rows]
    is_alike = _find_alike(g.sh.numpy()[visible_rows, 0], longest > 2 * cell_m, wide_cells, squares)
    cells = np.where(is_alike, ~wide_cells, cells)
    is_large = is_large & ~is_alike
    order, is_first = _group_by_cell(is_large, cells, squares)
    is_first |= is_large[order]
    order = visible_rows[order]
    starts = np.flatnonzero(is_first)
    counts = np.diff(starts, append=len(order))
    leads = order[starts]
    is_merged = counts > 1
    targets = np.full(len(g), -1)
    targets[order] = np.repeat(np.arange(len(starts)), counts)
    merged_indices = np.flatnonzero(is_merged)
    if not len(merged_indices):
        return g.select(torch.from_numpy(leads)), leads, targets
    rows = order[np.repeat(is_merged, counts)]
    firsts = np.cumsum(counts[merged_indices]) - counts[merged_indices]
    merged, heaviest = merge_groups(g.select(torch.from_numpy(rows)), firsts, blur_m)
    leads[merged_indices] = rows[heaviest]
    out = g.select(torch.from_numpy(leads))
    for name in _COLUMNS:
        getattr(out, name)[torch.from_numpy(merged_indices)] = getattr(merged, name).to(
            g.means.dtype
        )
    return out, leads, targets


def _group_by_cell(is_separate: np.ndarray, cells: np.ndarray, squares: np.ndarray) -> tuple:
    """Return an order in which the splats of a square's cell stand together, and a mask of the
    first splat of each group in that order.

    Splats of `is_separate` form no group with others.
    """
    order = np.lexsort((is_separate, cells, squares))
    is_first = np.ones(len(order), bool)
    is_first[1:] = np.diff(is_separate[order]) != 0
    for column in (cells, squares):
        is_first[1:] |= np.diff(column[order]) != 0
    return order, is_first


def _find_alike(
    sh: Float[np.ndarray, "N 3"], is_large: np.ndarray, cells: np.ndarray, squares: np.ndarray
) -> Bool[np.ndarray, "N"]:
    """Return the mask of splats that share a cell with others, all of nearly one colour.

    Args:
        sh: coefficients of degree 0.
        is_large: splats that are merged with none.
        cells: cell of each splat.
        squares: square of each splat.
    """
    order, is_first = _group_by_cell(is_large, cells, squares)
    starts = np.flatnonzero(is_first)
    counts = np.diff(starts, append=len(order))
    lows, highs = (f.reduceat(sh[order], starts) for f in (np.minimum, np.maximum))
    has_one_color = (SH_C0 * (highs - lows).max(1) <= MAX_COLOR_DIFFERENCE) & (counts > 1)
    is_alike = np.zeros(len(order), bool)
    is_alike[order] = np.repeat(has_one_color, counts)
    return is_alike & ~is_large


def merge_groups(
    g: Gaussians, firsts: Int64[np.ndarray, "M"], blur_m: float
) -> tuple[Gaussians, Int64[np.ndarray, "M"]]:
    """Merge each group of rows into one Gaussian of float64.

    Args:
        g: the splats, group after group.
        firsts: first row of each of the M groups.
        blur_m: standard deviation of the rasteriser's blur, metres.

    Returns:
        The M Gaussians, and the row that stands for each.
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
    offsets = means - centres[groups]
    half_axes = rotmat_from_quat(g.quats.double()).numpy() * scales[:, None]
    covariances = half_axes @ half_axes.transpose(0, 2, 1)
    variances, axes = np.linalg.eigh(mean(covariances + offsets[:, :, None] * offsets[:, None]))
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    # Axes of the plane that the group lies in, in units of its standard deviations.
    units = np.sqrt(np.maximum(variances[:, 1:], MIN_SCALE_M**2) + blur_m**2)
    plane = (axes[:, :, 1:] / units[:, None])[groups]
    plane_covariances = plane.transpose(0, 2, 1) @ covariances @ plane
    plane_covariances[:, [0, 1], [0, 1]] += (blur_m / units[groups]) ** 2
    covered_areas = np.empty(len(firsts))
    with kernel_threads():
        sum_covered_areas(
            np.append(firsts, len(g)),
            opacities,
            (offsets[:, None] @ plane)[:, 0],
            plane_covariances,
            covered_areas,
        )
    area_ratio = covered_areas / (2 * math.pi)  # of what a Gaussian of opacity 1 covers
    flat_top = np.exp(np.minimum(area_ratio, FLAT_TOP) - 1)
    variances[:, 1:] += (np.maximum(area_ratio / FLAT_TOP, 1) - 1)[:, None] * units**2
    merged = (
        centres,
        quat_from_rotmat(torch.from_numpy(axes)).numpy(),
        np.sqrt(np.maximum(variances, MIN_SCALE_M**2)),
        np.where(area_ratio <= 1, area_ratio, flat_top),
        mean(g.sh.double().numpy()),
    )
    return Gaussians(*map(torch.from_numpy, merged)), _find_heaviest(g, weights, groups)


def _find_heaviest(g: Gaussians, weights: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Return the heaviest row of the heaviest class of each group."""
    classes = np.zeros(len(g), np.int16) if g.semantic is None else g.semantic.numpy()
    order = np.lexsort((-weights, classes, groups))
    sorted_groups = groups[order]
    sorted_classes = classes[order]
    run_starts = np.flatnonzero(
        (np.diff(sorted_groups, prepend=-1) != 0)
        | (np.diff(sorted_classes, prepend=sorted_classes[:1]) != 0)
    )
    run_weights = np.add.reduceat(weights[order], run_starts)
    run_order = np.lexsort((-run_weights, sorted_groups[run_starts]))
    return order[
        run_starts[
            run_order[np.flatnonzero(np.diff(sorted_groups[run_starts][run_order], prepend=-1))]
        ]
    ]


# ---- The choice of levels for a camera -----------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ReplacedParts:
    """Parts to draw in place of other parts."""

    parts: tuple[PosedGaussians, ...]
    """The parts to draw."""
    stood_for: tuple[tuple[int, Int32[np.ndarray, "_"] | None], ...]
    """For each part, the splats of the replaced parts that its splats stand for: a first number,
    and numbers that are added to it (None: 0, 1, ...)."""

    def restore_ids(self, raster: RenderOutput) -> RenderOutput:
        """Return the buffers with splat_ids that count through the replaced parts."""
        if raster.splat_ids is None:
            return raster
        ids = raster.splat_ids.cpu().numpy()
        starts = np.cumsum([0, *(len(part.gaussians) for part in self.parts)])
        piece_numbers = np.searchsorted(starts, ids, "right") - 1
        restored_ids = np.full_like(ids, -1)
        for number, (first, stands_for) in enumerate(self.stood_for):
            is_of_piece = piece_numbers == number
            local_ids = ids[is_of_piece] - starts[number]
            restored_ids[is_of_piece] = first + (
                local_ids if stands_for is None else stands_for[local_ids]
            )
        return replace(raster, **{SPLAT_IDS: torch.from_numpy(restored_ids).to(raster.splat_ids)})


def choose_parts(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    settings: RasterSettings,
    fog: Fog | None = None,
    clip: HeightClip | None = None,
    *,
    takes_whole_levels: bool = True,
) -> ReplacedParts:
    """Return the parts that a camera needs of large backgrounds, and all other parts.

    Args:
        parts: the parts of the scene.
        camera: the view.
        settings: the rasteriser's settings, with lod_px > 0.
        fog: hides what is far away; None for clear air.
        clip: the level plane and the side of it that is drawn; None for both sides.
        takes_whole_levels: if True, take levels whole and name the rows to draw; else make a part
            of every run of rows.
    """
    chosen_parts = list[PosedGaussians]()
    stood_for = list[tuple[int, np.ndarray | None]]()
    first_splat = 0
    for part in parts:
        replacements = [(part, None)]
        if takes_levels(part):
            levels = levels_of(part.gaussians, antialiased=settings.antialiased)
            taken_runs = [*_select_runs(levels, part, camera, settings, fog, clip)]
            if _is_merged(levels, taken_runs):
                replacements = (
                    piece
                    for t in taken_runs
                    for piece in _pieces(t, part, is_whole=takes_whole_levels)
                )
        for piece, stands_for in replacements:
            chosen_parts.append(piece)
            stood_for.append((first_splat, stands_for))
        first_splat += len(part.gaussians)
    if not chosen_parts:  # a rasteriser wants to know at least the parts' type
        no_gaussians = slice_gaussians(parts[0].gaussians, slice(0))
        chosen_parts.append(
            replace(parts[0], gaussians=no_gaussians, color_maps=None, color_rows=None)
        )
        stood_for.append((0, None))
    return ReplacedParts(tuple(chosen_parts), tuple(stood_for))


def takes_levels(part: PosedGaussians) -> bool:
    """Return True if a part is drawn in levels.

    Actors and what lies on the scene are not, nor are small parts.
    """
    is_plain = part.instance_id == 0 and not part.is_overlay and part.shading is None
    g = part.gaussians
    return is_plain and len(g) >= MIN_SPLATS and g.means.device.type == "cpu"


class _LevelRuns(NamedTuple):
    """Runs of one level's splats that a camera takes."""

    level: Level
    """The level."""
    rows: Int64[np.ndarray, "R 2"]
    """Runs (first, last + 1)."""
    shares: Float[np.ndarray, "R"]
    """Share of each run, 0 to 1."""


def _is_merged(levels: Levels, level_runs: Sequence[_LevelRuns]) -> bool:
    """Return True if merged splats are drawn.

    Where all splats are those of level 0, the part stays as it is.
    """
    is_checked = levels.levels[0].unchecked_file is None
    return not is_checked or any(runs.level is not levels.levels[0] for runs in level_runs)


def _pieces(
    runs: _LevelRuns, part: PosedGaussians, *, is_whole: bool
) -> Iterator[tuple[PosedGaussians, np.ndarray]]:
    """Yield the parts of one level's runs, each with the numbers that its splats stand for."""
    level = runs.level
    is_faded = runs.shares < 1
    is_small = len(level.gaussians) <= MERGE_BATCH  # then a copy costs less than a second part
    for is_chosen in [np.ones_like(is_faded)] if is_small else [~is_faded, is_faded]:
        rows = runs.rows[is_chosen]
        shares = runs.shares[is_chosen]
        g = level.gaussians
        if not len(rows):
            continue
        if shares.min() < 1:
            run_rows = g.opacities.numpy()  # NumPy wakes no threads
            opacities = torch.from_numpy(run_rows.copy() if is_small else np.empty_like(run_rows))
            for (first, last), share in zip(rows.tolist(), shares.tolist(), strict=True):
                if share < 1:
                    opacities[first:last] = fade_opacities(g.opacities[first:last], share)
            g = replace(g, opacities=opacities)
        color_rows = None
        if part.color_rows is not None:
            color_rows = torch.empty(len(g), dtype=torch.int16)
            for run_rows in itertools.starmap(slice, rows.tolist()):
                color_rows[run_rows] = part.color_rows[
                    torch.from_numpy(level.stands_for[run_rows]).long()
                ]
        piece = replace(part, gaussians=g, color_rows=color_rows, rows=rows)
        if is_whole:
            yield piece, level.stands_for
            continue
        for run_rows in itertools.starmap(slice, rows.tolist()):
            run_color_rows = None if color_rows is None else color_rows[run_rows]
            run_part = replace(
                piece, gaussians=slice_gaussians(g, run_rows), color_rows=run_color_rows, rows=None
            )
            yield run_part, level.stands_for[run_rows]


def fade_opacities(opacities: Float[Tensor, "N"], share: float) -> Float[Tensor, "N"]:
    """Return the opacities of splats that are drawn for a share of what they hide.

    Args:
        opacities: opacities of the splats.
        share: 0 to 1.
    """
    values = opacities.numpy()
    clipped = np.clip(values, 1e-6, 0.99)  # flat tops, which have more, fade in proportion
    return torch.from_numpy(values * (-np.expm1(share * np.log1p(-clipped)) / clipped))


def _select_runs(
    levels: Levels,
    part: PosedGaussians,
    camera: Camera,
    settings: RasterSettings,
    fog: Fog | None,
    clip: HeightClip | None,
) -> Iterator[_LevelRuns]:
    """Yield, for each level, the runs of splats that may be seen in squares that the camera
    takes.
    """
    pose = None if part.world_from_part is None else part.world_from_part.numpy()
    tree = levels.tree
    squares, shares = choose_squares(levels, part, camera, settings)
    if len(squares) > MAX_UNTESTED_SQUARES:
        may_be_seen = find_visible_boxes(
            tree.boxes.bounds(squares), pose, camera, settings, fog, clip
        )
        squares = squares[may_be_seen]
        shares = shares[may_be_seen]
    first_cells = tree.firsts[squares] // CELL_SIZE
    num_cells = -(-tree.ends[squares] // CELL_SIZE) - first_cells
    square_of_cell = np.repeat(np.arange(len(squares)), num_cells)
    cells = (
        np.arange(len(square_of_cell))
        + (first_cells - num_cells.cumsum() + num_cells)[square_of_cell]
    )
    cell_bounds = tree.cells.bounds(cells + tree.cell_starts[tree.numbers[squares]][square_of_cell])
    may_be_seen = find_visible_boxes(cell_bounds, pose, camera, settings, fog, clip)
    cells = cells[may_be_seen]
    square_of_cell = square_of_cell[may_be_seen]
    square = squares[square_of_cell]
    firsts = np.maximum(tree.firsts[square], cells * CELL_SIZE)
    ends = np.minimum(tree.ends[square], (cells + 1) * CELL_SIZE)
    is_first = np.ones(len(firsts), bool)
    is_first[1:] = (firsts[1:] != ends[:-1]) | (np.diff(shares[square_of_cell]) != 0)
    is_first[1:] |= np.diff(tree.numbers[square]) != 0
    run_starts = np.flatnonzero(is_first)
    rows = np.stack(
        [firsts[run_starts], ends[np.append(run_starts[1:], len(firsts))[: len(run_starts)] - 1]], 1
    )
    run_levels = tree.numbers[square[run_starts]]
    run_shares = shares[square_of_cell[run_starts]]
    for number, level in enumerate(levels.levels):
        is_of_level = run_levels == number
        if is_of_level.any():
            level.check(cells[tree.numbers[square] == number])
            yield _LevelRuns(level, rows[is_of_level], run_shares[is_of_level])


def choose_squares(
    levels: Levels, part: PosedGaussians, camera: Camera, settings: RasterSettings
) -> tuple[Int64[np.ndarray, "T"], Float[np.ndarray, "T"]]:
    """Return the tree's squares that a camera takes, wherever it looks, and their shares.

    Args:
        levels: levels of the part.
        part: the part, for its pose.
        camera: the view.
        settings: the rasteriser's settings, with lod_px > 0.
    """
    eye_m = camera.centre.numpy()
    if part.world_from_part is not None:
        eye_m = np.linalg.solve(part.world_from_part.numpy(), np.append(eye_m, 1.0))[:3]
    tree = levels.tree
    cell_px = max(camera.fx, camera.fy) * tree.cells_m / settings.lod_px
    if camera.is_orthographic:
        refined_share = (cell_px > 1).astype(np.float64)
    else:
        axis_distances_m = np.maximum(tree.boxes.lows - eye_m, eye_m - tree.boxes.highs)
        distance_m = np.linalg.norm(np.maximum(axis_distances_m, 0), axis=1)
        refined_share = np.clip(
            (1 + FADE_BAND - distance_m / np.maximum(cell_px, 1e-9)) / FADE_BAND, 0, 1
        )
    refined_share[tree.numbers == 0] = 0
    # A square that holds a partly refined one is refined wholly, because d_k doubles from level to
    # level.
    shares = (1 - refined_share) * np.append(refined_share, 1)[tree.parents]
    squares = np.flatnonzero(shares > 0)
    return squares, shares[squares]
