"""Surface colour before light: a base albedo with each material's own grain.

Every rule is a function of place alone (and of a shape's variation), in linear albedo. Grain is
kept as coarse as the splats can carry: finer detail would only be lost between them.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from functools import lru_cache

import numpy as np

# ---- Smooth noise from hashed lattices: the same value for the same place, whoever asks ----------
# Nothing here holds state, so a splat and a ray that meet a surface at one point see one colour.


def hashed(integers: np.ndarray, seed: int = 0) -> np.ndarray:
    """Numbers in [0, 1), float32, from int32 rows [N, D]: a Murmur-style mix of each row."""
    state = np.full(integers.shape[0], (seed * 0x9E3779B1 + 0x7F4A7C15) & 0xFFFFFFFF, np.uint32)
    for column in integers.astype(np.int32).view(np.uint32).T:
        state ^= column * np.uint32(0xCC9E2D51)
        state = (state << np.uint32(13)) | (state >> np.uint32(19))
        state = state * np.uint32(5) + np.uint32(0xE6546B64)
    state ^= state >> np.uint32(16)
    state *= np.uint32(0x85EBCA6B)
    state ^= state >> np.uint32(13)
    state *= np.uint32(0xC2B2AE35)
    state ^= state >> np.uint32(16)
    return (state >> np.uint32(8)).astype(np.float32) * np.float32(2**-24)


def value_noise(points: np.ndarray, seed: int = 0) -> np.ndarray:
    """Smooth noise in [-1, 1] at points [N, D] (D 2 or 3), one lattice cell per unit, float32.

    Lattice values come from one table, so the pattern repeats after some 200 cells.
    """
    base = np.floor(points)
    share = (points - base).astype(np.float32)
    share = share * share * (3 - 2 * share)
    steps = _STEPS[: points.shape[1]]
    index = base.astype(np.int64) @ steps + seed * 7919

    def blend(offset: int, axes: int) -> np.ndarray:
        if axes == 0:
            return _table()[(index + offset) & (TABLE_SIZE - 1)]
        low, high = blend(offset, axes - 1), blend(offset + int(steps[axes - 1]), axes - 1)
        return low + share[:, axes - 1] * (high - low)

    return blend(0, points.shape[1])


TABLE_SIZE = 1 << 16
_STEPS = np.array([1, 40503, 12289])  # far apart in the table, whichever few cells are compared


@lru_cache(maxsize=1)
def _table() -> np.ndarray:
    integers = np.arange(TABLE_SIZE, dtype=np.int32)[:, None]
    return 2 * hashed(integers, 1) - 1


def fractal_noise(points: np.ndarray, octaves: int, seed: int = 0) -> np.ndarray:
    """Octaves of value noise, each twice as fine and half as strong; in [-1, 1]."""
    total = np.zeros(len(points), np.float32)
    strength, norm = 1.0, 0.0
    for octave in range(octaves):
        total += np.float32(strength) * value_noise(points * 2.0**octave, seed + 31 * octave)
        norm += strength
        strength *= 0.5
    return total / np.float32(norm)


# ---- materials -----------------------------------------------------------------------------------


class Material(IntEnum):
    PLAIN = 0
    ASPHALT = 1
    MARKING = 2
    PAVING = 3
    PLASTER = 4
    BRICK = 5
    STONE = 6
    TILES = 7
    GRASS = 8
    LEAVES = 9
    BARK = 10
    GLASS = 11  # window pane: shading adds what it mirrors
    PAINT = 12  # car paint: shading adds a clear coat
    RIM = 13
    LEAF = 14  # one tuft of leaves: a single splat, one light
    SHOP = 15  # a shop's pane: as GLASS, with goods behind it


def albedo(
    material: np.ndarray,
    rgb: np.ndarray,
    variation: np.ndarray,
    local: np.ndarray,
    points: np.ndarray,
) -> np.ndarray:
    """Linear albedo [N, 3] at points [N, 3] of the body's frame with local coordinates [N, 3]."""
    out = rgb.copy()
    for value in np.unique(material):
        rule = _RULES.get(Material(int(value)))
        if rule is not None:
            here = np.flatnonzero(material == value)
            out[here] = rule(out[here], variation[here], local[here], points[here])
    return np.clip(out, 0.0, 1.0)


def _asphalt(rgb: np.ndarray, variation: np.ndarray, local: np.ndarray, points: np.ndarray):
    flat = points[:, :2]
    tracks = value_noise(flat * [0.05, 1.1], 3)  # the long streaks that wheels leave
    grain = 0.09 * fractal_noise(flat * 1.6, 2, 1) + 0.05 * value_noise(flat * 0.3, 2)
    return rgb * (1 + grain + 0.03 * tracks)[:, None]


def _marking(rgb: np.ndarray, variation: np.ndarray, local: np.ndarray, points: np.ndarray):
    worn = np.clip(fractal_noise(points[:, :2] * 2.5, 2, 11) - 0.1, 0, 1)
    return rgb * (1 - 0.5 * worn)[:, None]


def _paving(rgb: np.ndarray, variation: np.ndarray, local: np.ndarray, points: np.ndarray):
    slab = np.floor(points[:, :2] / 0.6)
    tone = 0.10 * (hashed(slab.astype(np.int32), 5) - 0.5)
    return rgb * (1 + tone + 0.05 * value_noise(points[:, :2] * 0.9, 6))[:, None]


def _wall_plane(points: np.ndarray) -> np.ndarray:
    """Along-the-wall and up: walls follow x or y, so that the sum is one of them, shifted."""
    return np.stack([points[:, 0] + points[:, 1], points[:, 2]], 1)


def _plaster(rgb: np.ndarray, variation: np.ndarray, local: np.ndarray, points: np.ndarray):
    wall = _wall_plane(points)
    patches = 0.05 * fractal_noise(wall * 0.7, 2, 21)
    streaks = 0.04 * value_noise(wall * [2.2, 0.25], 22)
    dirt = 0.18 * np.exp(-np.maximum(points[:, 2], 0) / 0.5)
    return rgb * (1 + patches + streaks - dirt)[:, None]


def _courses(
    rgb: np.ndarray, points: np.ndarray, size_m: tuple[float, float], spread: float, seed: int
) -> np.ndarray:
    """Blocks in running bond, each with its own tone."""
    wall = _wall_plane(points)
    row = np.floor(wall[:, 1] / size_m[1])
    column = np.floor(wall[:, 0] / size_m[0] + 0.5 * (row % 2))
    tone = spread * (hashed(np.stack([column, row], 1).astype(np.int32), seed) - 0.5)
    return rgb * (1 + tone + 0.05 * value_noise(wall * 0.8, seed + 1))[:, None]


def _brick(rgb: np.ndarray, variation: np.ndarray, local: np.ndarray, points: np.ndarray):
    return _courses(rgb, points, (0.5, 0.16), 0.30, 31)


def _stone(rgb: np.ndarray, variation: np.ndarray, local: np.ndarray, points: np.ndarray):
    return _courses(rgb, points, (0.8, 0.4), 0.16, 41)


def _tiles(rgb: np.ndarray, variation: np.ndarray, local: np.ndarray, points: np.ndarray):
    return _courses(rgb, points, (0.4, 0.25), 0.24, 51)


def _grass(rgb: np.ndarray, variation: np.ndarray, local: np.ndarray, points: np.ndarray):
    grain = 0.22 * fractal_noise(points[:, :2] * 0.5, 3, 61)
    dry = 0.5 + 0.5 * fractal_noise(points[:, :2] * 0.08, 2, 62)
    return rgb * (1 + grain[:, None]) * (1 + dry[:, None] * np.array([0.25, 0.08, 0.0]))


def _leaves(rgb: np.ndarray, variation: np.ndarray, local: np.ndarray, points: np.ndarray):
    warm = variation[:, None] - 0.5
    tint = 1 + warm * np.array([0.5, 0.3, 0.1])
    return rgb * tint * (1 + 0.35 * value_noise(points * 7.0, 71))[:, None]


def _leaf(rgb: np.ndarray, variation: np.ndarray, local: np.ndarray, points: np.ndarray):
    tone = 0.75 + 0.5 * ((variation * 13.7) % 1.0)
    return rgb * tone[:, None] * (1 + (variation[:, None] - 0.5) * np.array([0.6, 0.25, 0.1]))


def _bark(rgb: np.ndarray, variation: np.ndarray, local: np.ndarray, points: np.ndarray):
    return rgb * (1 + 0.3 * value_noise(points * [9.0, 9.0, 2.0], 81))[:, None]


def _glass(rgb: np.ndarray, variation: np.ndarray, local: np.ndarray, points: np.ndarray):
    """What stands behind a pane: mostly a dark room, in some windows a curtain."""
    curtain = variation > 0.62
    drawn = np.where(curtain, 0.25 + 0.45 * ((variation * 7.31) % 1.0), 0.0)
    cloth = drawn[:, None] * np.array([0.62, 0.58, 0.52])
    return rgb + cloth * (0.35 + 0.65 * np.clip(local[:, 1:2], 0, 1))


def _shop(rgb: np.ndarray, variation: np.ndarray, local: np.ndarray, points: np.ndarray):
    """Goods on shelves: blocks of colour in a dim room, fewer towards the top."""
    wall = _wall_plane(points)
    cell = np.floor(wall / [0.45, 0.62]).astype(np.int32)
    shown = hashed(cell, 91) < 0.75 - 0.65 * np.clip(local[:, 1], 0, 1)
    hue = np.stack([hashed(cell, 92 + k) for k in range(3)], 1)
    goods = 0.05 + 0.22 * hue * np.array([1.0, 0.85, 0.7])
    lamp = 0.05 * np.clip(local[:, 1:2] - 0.7, 0, 1) * np.array([1.0, 0.85, 0.6])
    return rgb + np.where(shown[:, None], goods, 0.0) + lamp


def _rim(rgb: np.ndarray, variation: np.ndarray, local: np.ndarray, points: np.ndarray):
    """Five soft spokes and a hub."""
    radius = np.hypot(local[:, 0], local[:, 1])
    spokes = 0.5 + 0.5 * np.cos(5 * np.arctan2(local[:, 1], local[:, 0]))
    bright = np.where(radius < 0.25, 1.0, 0.25 + 0.75 * spokes)
    return rgb * np.where(radius > 0.88, 1.0, bright)[:, None]


_Rule = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]
_RULES: dict[Material, _Rule] = {
    Material.ASPHALT: _asphalt,
    Material.MARKING: _marking,
    Material.PAVING: _paving,
    Material.PLASTER: _plaster,
    Material.BRICK: _brick,
    Material.STONE: _stone,
    Material.TILES: _tiles,
    Material.GRASS: _grass,
    Material.LEAVES: _leaves,
    Material.LEAF: _leaf,
    Material.BARK: _bark,
    Material.GLASS: _glass,
    Material.SHOP: _shop,
    Material.RIM: _rim,
}
