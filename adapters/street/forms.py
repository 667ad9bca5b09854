"""Surfaces that a street is made of: noise, materials, arrays of shapes, and builders of simple
forms.

The callers are `adapters.street.world` and `adapters.street.light`. Lengths are metres, colours
linear albedo.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterable, Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from augment.scene.semantics import SemanticClass

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
    fraction = (points - base).astype(np.float32)
    fraction = fraction * fraction * (3 - 2 * fraction)
    index = sum(base[:, k].astype(np.int64) * _CORNER_STEPS[k] for k in range(points.shape[1]))
    index = (index + seed * 7919) & (TABLE_SIZE - 1)

    def blend(offset: int, axes: int) -> np.ndarray:
        if axes == 0:
            return _NOISE_TABLE[offset:][index]
        low = blend(offset, axes - 1)
        high = blend(offset + _CORNER_STEPS[axes - 1], axes - 1)
        return low + fraction[:, axes - 1] * (high - low)

    return blend(0, points.shape[1])


# Number of entries of the noise table.
TABLE_SIZE = 1 << 16
# Random values in [-1, 1], twice one after the other, so that an offset needs no modulo.
_NOISE_TABLE = np.tile(2 * hashed(np.arange(TABLE_SIZE, dtype=np.int32)[:, None], 1) - 1, 2)
# Steps in the table from a cell to its neighbour along each axis. They are chosen so that nearby
# cells are far from each other in the table.
_CORNER_STEPS = (1, 40503, 12289)


def fractal_noise(points: np.ndarray, octaves: int, seed: int = 0) -> np.ndarray:
    """Octaves of value noise, each twice as fine and half as strong; in [-1, 1]."""
    total = np.zeros(len(points), np.float32)
    strength = 1.0
    norm = 0.0
    for octave in range(octaves):
        total += np.float32(strength) * value_noise(points * 2.0**octave, seed + 31 * octave)
        norm += strength
        strength *= 0.5
    return total / np.float32(norm)


# ---- Materials: albedo before light --------------------------------------------------------------
# Every rule is a function of place alone (and of a shape's variation), in linear albedo. Grain is
# kept as coarse as the splats can carry: finer detail would only be lost between them.


class Material(IntEnum):
    """Rule by which a surface's albedo varies with the place."""

    PLAIN = 0  # the albedo of the shape, everywhere
    ASPHALT = 1  # carriageways and flat roofs
    MARKING = 2  # paint on the road
    PAVING = 3  # slabs of pavements
    PLASTER = 4  # plastered walls
    BRICK = 5  # courses of bricks
    STONE = 6  # courses of stones
    TILES = 7  # courses of roof tiles
    GRASS = 8  # grass of the land
    LEAVES = 9  # masses of leaves, as in a crown's core
    BARK = 10  # trunks and boughs
    GLASS = 11  # window pane: shading adds what it mirrors
    PAINT = 12  # car paint: shading adds a clear coat
    RIM = 13  # spokes and hub of a wheel
    LEAF = 14  # one tuft of leaves: a single splat, one light
    SHOP = 15  # a shop's pane: as GLASS, with goods behind it


class SurfacePoints(NamedTuple):
    """N points on surfaces of one material.

    Attributes:
        rgb: float [N, 3], the shapes' own albedo.
        variation: float [N], the shapes' variation.
        local: float [N, 3], local coordinates on the shapes.
        points: float [N, 3], positions in the body's frame.
    """

    rgb: np.ndarray
    variation: np.ndarray
    local: np.ndarray
    points: np.ndarray

    @property
    def wall(self) -> np.ndarray:
        """Return coordinates along the wall and up, [N, 2].

        Walls follow x or y, so that the sum x + y runs along each of them.
        """
        return np.stack([self.points[:, 0] + self.points[:, 1], self.points[:, 2]], 1)


def albedo(shapes: Shapes, shape: np.ndarray, local: np.ndarray) -> np.ndarray:
    """Return the linear albedo [N, 3] on shapes [N] at local coordinates [N, 3]."""
    material = shapes.material[shape]
    out = shapes.rgb[shape]
    for value in np.unique(material):
        if rule := _ALBEDO_RULES.get(Material(int(value))):
            index = np.flatnonzero(material == value)
            shape_index = shape[index]
            local_coords = local[index]
            points = shapes.points(shape_index, local_coords)
            out[index] = rule(
                SurfacePoints(out[index], shapes.variation[shape_index], local_coords, points)
            )
    return np.clip(out, 0.0, 1.0)


def _asphalt(spots: SurfacePoints) -> np.ndarray:
    xy = spots.points[:, :2]
    tracks = value_noise(xy * [0.05, 1.1], 3)  # the long streaks that wheels leave
    grain = 0.09 * fractal_noise(xy * 1.6, 2, 1) + 0.05 * value_noise(xy * 0.3, 2)
    return spots.rgb * (1 + grain + 0.03 * tracks)[:, None]


def _marking(spots: SurfacePoints) -> np.ndarray:
    wear = np.clip(fractal_noise(spots.points[:, :2] * 2.5, 2, 11) - 0.1, 0, 1)
    return spots.rgb * (1 - 0.5 * wear)[:, None]


def _paving(spots: SurfacePoints) -> np.ndarray:
    slab = np.floor(spots.points[:, :2] / 0.6)
    tone = 0.10 * (hashed(slab.astype(np.int32), 5) - 0.5)
    return spots.rgb * (1 + tone + 0.05 * value_noise(spots.points[:, :2] * 0.9, 6))[:, None]


def _plaster(spots: SurfacePoints) -> np.ndarray:
    patch_tone = 0.05 * fractal_noise(spots.wall * 0.7, 2, 21)
    streak_tone = 0.04 * value_noise(spots.wall * [2.2, 0.25], 22)
    dirt = 0.18 * np.exp(-np.maximum(spots.points[:, 2], 0) / 0.5)
    return spots.rgb * (1 + patch_tone + streak_tone - dirt)[:, None]


def _block_courses(
    spots: SurfacePoints, size_m: tuple[float, float], spread: float, seed: int
) -> np.ndarray:
    """Return the albedo of blocks in running bond, each with its own tone."""
    wall = spots.wall
    row = np.floor(wall[:, 1] / size_m[1])
    column = np.floor(wall[:, 0] / size_m[0] + 0.5 * (row % 2))
    tone = spread * (hashed(np.stack([column, row], 1).astype(np.int32), seed) - 0.5)
    return spots.rgb * (1 + tone + 0.05 * value_noise(wall * 0.8, seed + 1))[:, None]


def _grass(spots: SurfacePoints) -> np.ndarray:
    grain = 0.22 * fractal_noise(spots.points[:, :2] * 0.5, 3, 61)
    dry = 0.5 + 0.5 * fractal_noise(spots.points[:, :2] * 0.08, 2, 62)
    return spots.rgb * (1 + grain[:, None]) * (1 + dry[:, None] * np.array([0.25, 0.08, 0.0]))


def _leaves(spots: SurfacePoints) -> np.ndarray:
    tint = 1 + (spots.variation[:, None] - 0.5) * np.array([0.5, 0.3, 0.1])
    return spots.rgb * tint * (1 + 0.35 * value_noise(spots.points * 7.0, 71))[:, None]


def _leaf(spots: SurfacePoints) -> np.ndarray:
    tone = 0.75 + 0.5 * ((spots.variation * 13.7) % 1.0)
    tint = 1 + (spots.variation[:, None] - 0.5) * np.array([0.6, 0.25, 0.1])
    return spots.rgb * tone[:, None] * tint


def _glass(spots: SurfacePoints) -> np.ndarray:
    """Return the albedo behind a pane: mostly a dark room, in some windows a curtain."""
    curtain = np.where(spots.variation > 0.62, 0.25 + 0.45 * ((spots.variation * 7.31) % 1.0), 0.0)
    cloth = curtain[:, None] * np.array([0.62, 0.58, 0.52])
    return spots.rgb + cloth * (0.35 + 0.65 * np.clip(spots.local[:, 1:2], 0, 1))


def _shop(spots: SurfacePoints) -> np.ndarray:
    """Return the albedo of goods on shelves: blocks of colour in a dim room, fewer towards the
    top.
    """
    cell = np.floor(spots.wall / [0.45, 0.62]).astype(np.int32)
    has_goods = hashed(cell, 91) < 0.75 - 0.65 * np.clip(spots.local[:, 1], 0, 1)
    hue = np.stack([hashed(cell, 92 + k) for k in range(3)], 1)
    goods = 0.05 + 0.22 * hue * np.array([1.0, 0.85, 0.7])
    lamp = 0.05 * np.clip(spots.local[:, 1:2] - 0.7, 0, 1) * np.array([1.0, 0.85, 0.6])
    return spots.rgb + np.where(has_goods[:, None], goods, 0.0) + lamp


def _rim(spots: SurfacePoints) -> np.ndarray:
    """Return the albedo of five soft spokes and a hub."""
    radius = np.hypot(spots.local[:, 0], spots.local[:, 1])
    spokes = 0.5 + 0.5 * np.cos(5 * np.arctan2(spots.local[:, 1], spots.local[:, 0]))
    bright = np.where(radius < 0.25, 1.0, 0.25 + 0.75 * spokes)
    return spots.rgb * np.where(radius > 0.88, 1.0, bright)[:, None]


# Functions that give the albedo of points on each material; others keep the albedo of the shape.
_ALBEDO_RULES: dict[Material, Callable[[SurfacePoints], np.ndarray]] = {
    Material.ASPHALT: _asphalt,
    Material.MARKING: _marking,
    Material.PAVING: _paving,
    Material.PLASTER: _plaster,
    Material.BRICK: lambda spots: _block_courses(spots, (0.5, 0.16), 0.30, 31),
    Material.STONE: lambda spots: _block_courses(spots, (0.8, 0.4), 0.16, 41),
    Material.TILES: lambda spots: _block_courses(spots, (0.4, 0.25), 0.24, 51),
    Material.GRASS: _grass,
    Material.LEAVES: _leaves,
    Material.LEAF: _leaf,
    Material.BARK: lambda spots: (
        spots.rgb * (1 + 0.3 * value_noise(spots.points * [9.0, 9.0, 2.0], 81))[:, None]
    ),
    Material.GLASS: _glass,
    Material.SHOP: _shop,
    Material.RIM: _rim,
}


# ---- Shapes: arrays of unit shapes, each in its own affine frame ---------------------------------
# A point has local coordinates q with `point = origin + q @ axes`, and the kinds are
#
#     PARALLELOGRAM  0 <= u, v <= 1, w = 0        DISC       u^2 + v^2 <= 1, w = 0
#     TRIANGLE       0 <= u, v, u + v <= 1, w = 0 ELLIPSOID  |q| = 1
#     CYLINDER       u^2 + v^2 = 1, |w| <= 1 (open ends)
#
# For the flat kinds the third axis is the unit normal, pointing outwards.


class Kind(IntEnum):
    """Form of a shape."""

    PARALLELOGRAM = 0
    TRIANGLE = 1
    DISC = 2
    ELLIPSOID = 3
    CYLINDER = 4


# Bits of Shapes.edges: where a parallelogram's splats should end crisply.

# The side u = 0.
U0 = 1
# The side u = 1.
U1 = 2
# The side v = 0.
V0 = 4
# The side v = 1.
V1 = 8
# All four sides.
ALL_EDGES = U0 | U1 | V0 | V1
# A triangle that leaves the splats on its diagonal to the other half of its quad.
OPEN_DIAGONAL = 16


class Look(NamedTuple):
    """Appearance of a surface.

    Attributes:
        rgb: linear albedo.
        semantic: class.
        material: rule by which the albedo varies.
        ambient: fraction of sky light that reaches the surface.
        spacing: distance of its splats, relative to other surfaces as far away.
        backed: True if half a metre of empty space lies behind it, where a second layer of splats
            fits.
    """

    rgb: Sequence[float] | np.ndarray
    semantic: SemanticClass
    material: Material = Material.PLAIN
    ambient: float = 1.0
    spacing: float = 1.0
    backed: bool = False

    def tinted(self, rgb: Sequence[float] | np.ndarray) -> Look:
        """Return the same look in another colour."""
        return self._replace(rgb=rgb)


class Shapes(np.recarray):
    """P shapes: an array of records, each field an attribute.

    Attributes:
        origin: float [P, 3], origin of the local frame, metres.
        axes: float [P, 3, 3], axes u, v, w of the local frame as rows, metres.
        shading: float [P, 3, 3]. The normal that lights flat kinds and leaves is
            shading[0] + u shading[1] + v shading[2].
        variation: float [P], in [0, 1), differs between equal shapes.
        kind: int [P], form of the shape, a Kind.
        edges: uint [P], sides where the splats end crisply, bits such as U0.
        rgb, ambient, spacing, material, semantic, backed: the fields of Look.
    """

    FIELDS = np.dtype([
        ("origin", "3f8"), ("axes", "(3,3)f8"), ("shading", "(3,3)f8"), ("rgb", "3f8"),
        ("ambient", "f8"), ("spacing", "f8"), ("variation", "f8"),
        ("material", "i2"), ("semantic", "i2"), ("kind", "i1"), ("edges", "u1"), ("backed", "?"),
    ], align=True)  # fmt: skip

    @classmethod
    def of(
        cls,
        kind: Kind,
        origin: np.ndarray,
        axes: Sequence[np.ndarray],
        look: Look,
        edges: np.ndarray | int = 0,
        shading: Sequence[np.ndarray] | None = None,
    ) -> Shapes:
        """Return shapes of one kind and look.

        Args:
            kind: their kind.
            origin: float [P, 3] or [1, 3].
            axes: the vectors u, v, w, each [P, 3] or [1, 3].
            look: their look.
            edges: bits of crisp edges.
            shading: the three vectors of shading. If missing, the normal is w.
        """
        count = max(len(values) for values in (origin, *axes))
        records = np.zeros(count, cls.FIELDS)
        for name, value in zip(Look._fields, look, strict=True):
            records[name] = value
        records["kind"] = kind
        records["origin"] = origin
        records["edges"] = edges
        for row, vector in enumerate(axes):
            records["axes"][:, row] = vector
        for row, vector in enumerate(shading or axes[2:]):
            records["shading"][:, row] = vector
        records["variation"] = (np.arange(count) * 0.618034 + 0.37) % 1.0
        return records.view(cls)

    def moved(self, translation: Sequence[float], yaw_rad: float = 0.0) -> Shapes:
        """Return the shapes turned about z, then shifted."""
        c = np.cos(yaw_rad)
        s = np.sin(yaw_rad)
        rotation = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])  # rows: images of x, y, z
        shapes = self.copy()
        shapes["origin"] = self.origin @ rotation + np.asarray(translation, np.float64)
        shapes["axes"] = self.axes @ rotation
        shapes["shading"] = self.shading @ rotation
        return shapes

    def repeated(self, translations: np.ndarray) -> Shapes:
        """Return a copy of the shapes at each translation [M, 3]."""
        shapes = join([self] * len(translations))
        shapes["origin"] += np.repeat(translations, len(self), axis=0)
        variation_steps = np.repeat(np.arange(len(translations)) * 0.618034, len(self))
        shapes["variation"] = (shapes.variation + variation_steps) % 1.0
        return shapes

    def points(self, shape: np.ndarray, local: np.ndarray) -> np.ndarray:
        """Return the positions [N, 3] of local coordinates [N, 3] on shapes [N]."""
        return self.origin[shape] + np.einsum("nk,nkj->nj", local, self.axes[shape])

    def normals(self, shape: np.ndarray, local: np.ndarray) -> np.ndarray:
        """Return the outward unit normals [N, 3] of the true surface."""
        normals = self.axes[shape, 2].copy()
        is_curved = self.kind[shape] >= Kind.ELLIPSOID
        if is_curved.any():
            curved_shapes = shape[is_curved]
            q = local[is_curved].copy()
            q[self.kind[curved_shapes] == Kind.CYLINDER, 2] = 0
            axes = self.axes[curved_shapes]
            gradient = np.einsum("nk,nkj->nj", q / (axes**2).sum(2), axes)  # axes are orthogonal
            normals[is_curved] = unit(gradient)
        return normals

    def shading_normals(self, shape: np.ndarray, local: np.ndarray) -> np.ndarray:
        """Return the unit normals [N, 3] for light, which are smooth across the panels of a
        mesh.
        """
        normals = self.normals(shape, local)
        is_flat = (self.kind[shape] < Kind.ELLIPSOID) | (self.material[shape] == Material.LEAF)
        shading = self.shading[shape[is_flat]]
        q = local[is_flat]
        normals[is_flat] = unit(
            shading[:, 0] + q[:, :1] * shading[:, 1] + q[:, 1:2] * shading[:, 2]
        )
        return normals


# Shapes as opaque records: NumPy would compare all fields in Python.
_RECORD_BYTES = np.dtype((np.void, Shapes.FIELDS.itemsize))


def join(parts: Sequence[Shapes]) -> Shapes:
    """Return all parts in one array."""
    return np.concatenate([part.view(_RECORD_BYTES) for part in parts]).view(Shapes.FIELDS, Shapes)


def joined(build: Callable[..., Iterable[Shapes]]) -> Callable[..., Shapes]:
    """Decorate a builder that yields parts, so that it returns them in one array."""
    return functools.wraps(build)(lambda *args, **options: join([*build(*args, **options)]))


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors [N, 3] scaled to length 1."""
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


# ---- Cutting rectangles around holes, so that splats line up with every edge between colours -----

Rectangle = tuple[float, float, float, float]  # x0, y0, x1, y1 with x0 < x1 and y0 < y1


def cut(
    outer: Rectangle, holes: Sequence[Rectangle], rim: int = ALL_EDGES
) -> tuple[np.ndarray, np.ndarray]:
    """Cut holes out of a rectangle.

    Cuts run along x first, so long pieces lie along x. Holes may touch each other and reach beyond
    the outer rectangle. An edge bit is set if the piece borders a hole there, or lies on a side of
    the outer rectangle that `rim` names.

    Returns:
        The remaining rectangles, float [R, 4], and their edge bits, uint8 [R].
    """
    x0, y0, x1, y1 = outer
    clipped_holes = [
        (max(hole_start, x0), max(hole_end, y0), min(c, x1), min(d, y1))
        for hole_start, hole_end, c, d in holes
        if min(c, x1) - max(hole_start, x0) > 1e-9 and min(d, y1) - max(hole_end, y0) > 1e-9
    ]
    levels = sorted({y0, y1, *(h[1] for h in clipped_holes), *(h[3] for h in clipped_holes)})
    pieces: list[Rectangle] = []
    for low, high in itertools.pairwise(levels):
        spans = sorted((h[0], h[2]) for h in clipped_holes if h[1] <= low and h[3] >= high)
        start = x0
        for hole_start, hole_end in [*spans, (x1, x1)]:
            if hole_start - start > 1e-9:
                pieces.append((start, low, hole_start, high))
            start = max(start, hole_end)
    pieces = _merge_stacked(pieces)
    return np.array(pieces).reshape(-1, 4), _edge_bits(pieces, outer, clipped_holes, rim)


def _merge_stacked(pieces: list[Rectangle]) -> list[Rectangle]:
    """Merge pieces of equal x range that are stacked on each other."""
    merged: list[Rectangle] = []
    for piece in pieces:
        for i, other in enumerate(merged):
            if other[0] == piece[0] and other[2] == piece[2] and other[3] == piece[1]:
                merged[i] = (other[0], other[1], other[2], piece[3])
                break
        else:
            merged.append(piece)
    return merged


def _edge_bits(
    pieces: Sequence[Rectangle], outer: Rectangle, holes: Sequence[Rectangle], rim: int
) -> np.ndarray:
    """Return the bits [R] of the sides of each piece that border a hole or a named side of the
    rim.
    """
    p = np.array(pieces).reshape(-1, 4)[:, None]  # [R, 1, 4] against holes [1, H, 4]
    h = np.array(holes).reshape(-1, 4)[None]
    overlaps_in_y = (h[..., 1] < p[..., 3]) & (h[..., 3] > p[..., 1])
    overlaps_in_x = (h[..., 0] < p[..., 2]) & (h[..., 2] > p[..., 0])
    bits = np.zeros(len(pieces), np.uint8)
    for bit, side, overlaps in (
        (U0, 0, overlaps_in_y),
        (V0, 1, overlaps_in_x),
        (U1, 2, overlaps_in_y),
        (V1, 3, overlaps_in_x),
    ):
        value = p[..., side]
        touches_hole = (value == h[..., side]) | (value == h[..., (side + 2) % 4])
        is_crisp = (touches_hole & overlaps).any(1) | (
            (value[:, 0] == outer[side]) & bool(rim & bit)
        )
        bits |= np.where(is_crisp, bit, 0).astype(np.uint8)
    return bits


# ---- Builders ------------------------------------------------------------------------------------


Vectors = Sequence[float] | np.ndarray  # [3] or [P, 3]


def xyz(x: np.ndarray | float, y: np.ndarray | float, z: np.ndarray | float) -> np.ndarray:
    """Return vectors [N, 3] of coordinates, each [N] or one for all."""
    out = np.empty((*np.broadcast(x, y, z).shape, 3))
    out[..., 0] = x
    out[..., 1] = y
    out[..., 2] = z
    return out


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross products [..., 3]. np.cross gives the same in twice the time."""
    (ax, ay, az), (bx, by, bz) = ((v[..., 0], v[..., 1], v[..., 2]) for v in (a, b))
    return xyz(ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)


def _as_vectors(values: Vectors) -> np.ndarray:
    return np.asarray(values, np.float64).reshape(-1, 3)


def parallelograms(
    origin: Vectors, u: Vectors, v: Vectors, look: Look, *, edges: np.ndarray | int = ALL_EDGES
) -> Shapes:
    """Return flat panels with corner `origin` and sides u, v. They face u x v."""
    origin = _as_vectors(origin)
    u = _as_vectors(u)
    v = _as_vectors(v)
    return Shapes.of(Kind.PARALLELOGRAM, origin, (u, v, unit(cross(u, v))), look, edges)


def boxes(
    low: Vectors,
    high: Vectors,
    look: Look,
    *,
    faces: Sequence[str] = ("+x", "-x", "+y", "-y", "+z"),
    edges: int = ALL_EDGES,
) -> Shapes:
    """Return the named faces of axis-aligned boxes between corners low and high."""
    low = _as_vectors(low)
    high = _as_vectors(high)
    axis = np.eye(3)[["xyz".index(face[1]) for face in faces], None]  # [F, 1, 3]
    is_outward = np.array([face[0] == "+" for face in faces])[:, None, None]
    corner = np.where((axis > 0) & is_outward, high, low)  # [F, B, 3]
    second_side = np.roll(axis, 1, -1) * (high - low)
    third_side = np.roll(axis, 2, -1) * (high - low)
    u = np.where(is_outward, second_side, third_side)
    v = np.where(is_outward, third_side, second_side)
    return parallelograms(corner, u, v, look, edges=edges)


def disc(centre: Sequence[float], normal: Sequence[float], radius_m: float, look: Look) -> Shapes:
    """Return a flat round plate."""
    u, v, w = _frame(np.asarray(normal, np.float64))
    return Shapes.of(Kind.DISC, _as_vectors(centre), _as_rows(u * radius_m, v * radius_m, w), look)


def tube(start: Sequence[float], end: Sequence[float], radius_m: float, look: Look) -> Shapes:
    """Return a round tube between two points, open at its ends."""
    a = np.asarray(start, np.float64)
    b = np.asarray(end, np.float64)
    u, v, _ = _frame(b - a)
    axes = _as_rows(u * radius_m, v * radius_m, (b - a) / 2)
    return Shapes.of(Kind.CYLINDER, _as_vectors((a + b) / 2), axes, look)


def ellipsoids(centres: Vectors, axes: np.ndarray, look: Look) -> Shapes:
    """Return ellipsoids with orthogonal semi-axes, the rows of `axes` [P, 3, 3], metres."""
    return Shapes.of(Kind.ELLIPSOID, _as_vectors(centres), axes.transpose(1, 0, 2), look)


def ball(centre: Sequence[float], radii: Sequence[float], look: Look) -> Shapes:
    """Return one ellipsoid along the coordinate axes."""
    return ellipsoids(centre, np.diag(np.asarray(radii, np.float64))[None], look)


def quads(corners: np.ndarray, look: Look, *, normals: np.ndarray | None = None) -> Shapes:
    """Return four-sided panels [P, 4, 3], corners in turn, facing (c1 - c0) x (c3 - c0).

    Parallelograms stay whole. Other panels become two triangles, as do panels of a smooth mesh,
    whose shading normals at the corners are `normals` [P, 4, 3].
    """
    corners = np.asarray(corners, np.float64)
    closure_error = np.abs(corners[:, 0] - corners[:, 1] + corners[:, 2] - corners[:, 3]).max(1)
    is_parallelogram = (closure_error < 1e-9) & (normals is None)
    a, b, _, d = corners[is_parallelogram].transpose(1, 0, 2)
    c = corners[~is_parallelogram]
    parts = [parallelograms(a, b - a, d - a, look, edges=0)]
    for (i, j, k), flag in (((0, 1, 3), 0), ((2, 3, 1), OPEN_DIAGONAL)):
        shading = None
        if normals is not None:
            shading = normals[:, i], normals[:, j] - normals[:, i], normals[:, k] - normals[:, i]
        parts.append(triangles(c[:, i], c[:, j], c[:, k], look, flag, shading))
    return join(parts)


def triangles(
    a: Vectors,
    b: Vectors,
    c: Vectors,
    look: Look,
    edges: int = 0,
    shading: Sequence[np.ndarray] | None = None,
) -> Shapes:
    """Return triangles that face (b - a) x (c - a)."""
    a = _as_vectors(a)
    u = b - a
    v = c - a
    return Shapes.of(Kind.TRIANGLE, a, (u, v, unit(cross(u, v))), look, edges, shading)


def _frame(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return unit vectors u, v, w, right-handed, with w along the direction."""
    w = direction / np.linalg.norm(direction)
    helper = np.array([1.0, 0.0, 0.0]) if abs(w[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    u = cross(helper, w)
    u /= np.linalg.norm(u)
    return u, cross(w, u), w


def _as_rows(*vectors: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(vector[None] for vector in vectors)
