"""The surfaces that a street is made of: their materials, shapes, and builders of simple forms."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterable, Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from augment.semantics import SemanticClass

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
    index = sum(base[:, k].astype(np.int64) * _STEPS[k] for k in range(points.shape[1]))
    index = (index + seed * 7919) & (TABLE_SIZE - 1)

    def blend(offset: int, axes: int) -> np.ndarray:
        if axes == 0:
            return _TABLE[offset:][index]
        low, high = blend(offset, axes - 1), blend(offset + _STEPS[axes - 1], axes - 1)
        return low + share[:, axes - 1] * (high - low)

    return blend(0, points.shape[1])


TABLE_SIZE = 1 << 16
_TABLE = np.tile(2 * hashed(np.arange(TABLE_SIZE, dtype=np.int32)[:, None], 1) - 1, 2)
_STEPS = (1, 40503, 12289)  # far apart in the table, whichever few cells are compared


def fractal_noise(points: np.ndarray, octaves: int, seed: int = 0) -> np.ndarray:
    """Octaves of value noise, each twice as fine and half as strong; in [-1, 1]."""
    total = np.zeros(len(points), np.float32)
    strength, norm = 1.0, 0.0
    for octave in range(octaves):
        total += np.float32(strength) * value_noise(points * 2.0**octave, seed + 31 * octave)
        norm += strength
        strength *= 0.5
    return total / np.float32(norm)


# ---- Materials: albedo before light --------------------------------------------------------------
# Every rule is a function of place alone (and of a shape's variation), in linear albedo. Grain is
# kept as coarse as the splats can carry: finer detail would only be lost between them.


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


class Spots(NamedTuple):
    """N places on surfaces of one material. rgb [N, 3]: the shapes' own. variation [N], local
    [N, 3], points [N, 3]: body frame."""

    rgb: np.ndarray
    variation: np.ndarray
    local: np.ndarray
    points: np.ndarray

    @property
    def wall(self) -> np.ndarray:
        """Along the wall and up: walls follow x or y, so that the sum is one of them, shifted."""
        return np.stack([self.points[:, 0] + self.points[:, 1], self.points[:, 2]], 1)


def albedo(shapes: Shapes, shape: np.ndarray, local: np.ndarray) -> np.ndarray:
    """Linear albedo [N, 3] on shapes [N] at local coordinates [N, 3]."""
    material, out = shapes.material[shape], shapes.rgb[shape]
    for value in np.unique(material):
        if rule := _RULES.get(Material(int(value))):
            here = np.flatnonzero(material == value)
            own, at = shape[here], local[here]
            points = shapes.points(own, at)
            out[here] = rule(Spots(out[here], shapes.variation[own], at, points))
    return np.clip(out, 0.0, 1.0)


def _asphalt(at: Spots) -> np.ndarray:
    flat = at.points[:, :2]
    tracks = value_noise(flat * [0.05, 1.1], 3)  # the long streaks that wheels leave
    grain = 0.09 * fractal_noise(flat * 1.6, 2, 1) + 0.05 * value_noise(flat * 0.3, 2)
    return at.rgb * (1 + grain + 0.03 * tracks)[:, None]


def _marking(at: Spots) -> np.ndarray:
    worn = np.clip(fractal_noise(at.points[:, :2] * 2.5, 2, 11) - 0.1, 0, 1)
    return at.rgb * (1 - 0.5 * worn)[:, None]


def _paving(at: Spots) -> np.ndarray:
    slab = np.floor(at.points[:, :2] / 0.6)
    tone = 0.10 * (hashed(slab.astype(np.int32), 5) - 0.5)
    return at.rgb * (1 + tone + 0.05 * value_noise(at.points[:, :2] * 0.9, 6))[:, None]


def _plaster(at: Spots) -> np.ndarray:
    patches = 0.05 * fractal_noise(at.wall * 0.7, 2, 21)
    streaks = 0.04 * value_noise(at.wall * [2.2, 0.25], 22)
    dirt = 0.18 * np.exp(-np.maximum(at.points[:, 2], 0) / 0.5)
    return at.rgb * (1 + patches + streaks - dirt)[:, None]


def _courses(at: Spots, size_m: tuple[float, float], spread: float, seed: int) -> np.ndarray:
    """Blocks in running bond, each with its own tone."""
    wall = at.wall
    row = np.floor(wall[:, 1] / size_m[1])
    column = np.floor(wall[:, 0] / size_m[0] + 0.5 * (row % 2))
    tone = spread * (hashed(np.stack([column, row], 1).astype(np.int32), seed) - 0.5)
    return at.rgb * (1 + tone + 0.05 * value_noise(wall * 0.8, seed + 1))[:, None]


def _grass(at: Spots) -> np.ndarray:
    grain = 0.22 * fractal_noise(at.points[:, :2] * 0.5, 3, 61)
    dry = 0.5 + 0.5 * fractal_noise(at.points[:, :2] * 0.08, 2, 62)
    return at.rgb * (1 + grain[:, None]) * (1 + dry[:, None] * np.array([0.25, 0.08, 0.0]))


def _leaves(at: Spots) -> np.ndarray:
    tint = 1 + (at.variation[:, None] - 0.5) * np.array([0.5, 0.3, 0.1])
    return at.rgb * tint * (1 + 0.35 * value_noise(at.points * 7.0, 71))[:, None]


def _leaf(at: Spots) -> np.ndarray:
    tone = 0.75 + 0.5 * ((at.variation * 13.7) % 1.0)
    tint = 1 + (at.variation[:, None] - 0.5) * np.array([0.6, 0.25, 0.1])
    return at.rgb * tone[:, None] * tint


def _glass(at: Spots) -> np.ndarray:
    """What stands behind a pane: mostly a dark room, in some windows a curtain."""
    drawn = np.where(at.variation > 0.62, 0.25 + 0.45 * ((at.variation * 7.31) % 1.0), 0.0)
    cloth = drawn[:, None] * np.array([0.62, 0.58, 0.52])
    return at.rgb + cloth * (0.35 + 0.65 * np.clip(at.local[:, 1:2], 0, 1))


def _shop(at: Spots) -> np.ndarray:
    """Goods on shelves: blocks of colour in a dim room, fewer towards the top."""
    cell = np.floor(at.wall / [0.45, 0.62]).astype(np.int32)
    shown = hashed(cell, 91) < 0.75 - 0.65 * np.clip(at.local[:, 1], 0, 1)
    hue = np.stack([hashed(cell, 92 + k) for k in range(3)], 1)
    goods = 0.05 + 0.22 * hue * np.array([1.0, 0.85, 0.7])
    lamp = 0.05 * np.clip(at.local[:, 1:2] - 0.7, 0, 1) * np.array([1.0, 0.85, 0.6])
    return at.rgb + np.where(shown[:, None], goods, 0.0) + lamp


def _rim(at: Spots) -> np.ndarray:
    """Five soft spokes and a hub."""
    radius = np.hypot(at.local[:, 0], at.local[:, 1])
    spokes = 0.5 + 0.5 * np.cos(5 * np.arctan2(at.local[:, 1], at.local[:, 0]))
    bright = np.where(radius < 0.25, 1.0, 0.25 + 0.75 * spokes)
    return at.rgb * np.where(radius > 0.88, 1.0, bright)[:, None]


_RULES: dict[Material, Callable[[Spots], np.ndarray]] = {
    Material.ASPHALT: _asphalt,
    Material.MARKING: _marking,
    Material.PAVING: _paving,
    Material.PLASTER: _plaster,
    Material.BRICK: lambda at: _courses(at, (0.5, 0.16), 0.30, 31),
    Material.STONE: lambda at: _courses(at, (0.8, 0.4), 0.16, 41),
    Material.TILES: lambda at: _courses(at, (0.4, 0.25), 0.24, 51),
    Material.GRASS: _grass,
    Material.LEAVES: _leaves,
    Material.LEAF: _leaf,
    Material.BARK: lambda at: (
        at.rgb * (1 + 0.3 * value_noise(at.points * [9.0, 9.0, 2.0], 81))[:, None]
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
    PARALLELOGRAM = 0
    TRIANGLE = 1
    DISC = 2
    ELLIPSOID = 3
    CYLINDER = 4


# Bits of Shapes.edges: where a parallelogram's splats should end crisply.
U0, U1, V0, V1 = 1, 2, 4, 8
ALL_EDGES = U0 | U1 | V0 | V1
# A triangle that leaves the splats on its diagonal to the other half of its quad.
OPEN_DIAGONAL = 16


class Look(NamedTuple):
    """What a surface looks like. rgb: linear albedo. ambient: share of sky light that reaches it.
    spacing: its splats' distance relative to other surfaces as far away. backed: whether half a
    metre of nothing lies behind it, where a second layer of splats may stand."""

    rgb: Sequence[float] | np.ndarray
    semantic: SemanticClass
    material: Material = Material.PLAIN
    ambient: float = 1.0
    spacing: float = 1.0
    backed: bool = False

    def tinted(self, rgb: Sequence[float] | np.ndarray) -> Look:
        return self._replace(rgb=rgb)


class Shapes(np.recarray):
    """P shapes: an array of records, each field an attribute. origin [P, 3], axes [P, 3, 3] (rows
    u, v, w), metres.

    shading: [P, 3, 3], of flat kinds and leaves: what light takes for the normal is
    shading[0] + u shading[1] + v shading[2]. variation [P]: in [0, 1), tells equal shapes apart.
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
        """Shapes of one kind and look. origin, and the vectors u, v, w of axes: [P, 3] or [1, 3].
        shading: its three vectors; the normal w unless given."""
        count = max(len(values) for values in (origin, *axes))
        out = np.zeros(count, cls.FIELDS)
        for name, value in zip(Look._fields, look, strict=True):
            out[name] = value
        out["kind"], out["origin"], out["edges"] = kind, origin, edges
        for row, vector in enumerate(axes):
            out["axes"][:, row] = vector
        for row, vector in enumerate(shading or axes[2:]):
            out["shading"][:, row] = vector
        out["variation"] = (np.arange(count) * 0.618034 + 0.37) % 1.0
        return out.view(cls)

    def moved(self, translation: Sequence[float], yaw_rad: float = 0.0) -> Shapes:
        """The shapes turned about z, then shifted."""
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])  # rows: images of x, y, z
        out = self.copy()
        out["origin"] = self.origin @ turn + np.asarray(translation, np.float64)
        out["axes"], out["shading"] = self.axes @ turn, self.shading @ turn
        return out

    def repeated(self, translations: np.ndarray) -> Shapes:
        """A copy at each translation [M, 3]."""
        out = join([self] * len(translations))
        out["origin"] += np.repeat(translations, len(self), axis=0)
        step = np.repeat(np.arange(len(translations)) * 0.618034, len(self))
        out["variation"] = (out.variation + step) % 1.0
        return out

    def points(self, shape: np.ndarray, local: np.ndarray) -> np.ndarray:
        """Positions [N, 3] of local coordinates [N, 3] on shapes [N]."""
        return self.origin[shape] + np.einsum("nk,nkj->nj", local, self.axes[shape])

    def normals(self, shape: np.ndarray, local: np.ndarray) -> np.ndarray:
        """Outward unit normals [N, 3] of the true surface."""
        normals = self.axes[shape, 2].copy()
        curved = self.kind[shape] >= Kind.ELLIPSOID
        if curved.any():
            chosen, q = shape[curved], local[curved].copy()
            q[self.kind[chosen] == Kind.CYLINDER, 2] = 0
            axes = self.axes[chosen]
            gradient = np.einsum("nk,nkj->nj", q / (axes**2).sum(2), axes)  # axes are orthogonal
            normals[curved] = unit(gradient)
        return normals

    def shading_normals(self, shape: np.ndarray, local: np.ndarray) -> np.ndarray:
        """Unit normals [N, 3] that light sees: smooth across the panels of a mesh."""
        normals = self.normals(shape, local)
        flat = (self.kind[shape] < Kind.ELLIPSOID) | (self.material[shape] == Material.LEAF)
        bent, q = self.shading[shape[flat]], local[flat]
        normals[flat] = unit(bent[:, 0] + q[:, :1] * bent[:, 1] + q[:, 1:2] * bent[:, 2])
        return normals


_OPAQUE = np.dtype((np.void, Shapes.FIELDS.itemsize))  # numpy would compare all fields in Python


def join(parts: Sequence[Shapes]) -> Shapes:
    """All parts in one."""
    return np.concatenate([part.view(_OPAQUE) for part in parts]).view(Shapes.FIELDS, Shapes)


def joined(build: Callable[..., Iterable[Shapes]]) -> Callable[..., Shapes]:
    """Makes of a builder that yields parts one that returns them in one."""
    return functools.wraps(build)(lambda *args, **options: join([*build(*args, **options)]))


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors [N, 3] at length 1."""
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


# ---- Cutting rectangles around holes, so that splats line up with every edge between colours -----

Rectangle = tuple[float, float, float, float]  # x0, y0, x1, y1 with x0 < x1 and y0 < y1


def cut(
    outer: Rectangle, holes: Sequence[Rectangle], rim: int = ALL_EDGES
) -> tuple[np.ndarray, np.ndarray]:
    """What is left of a rectangle without holes: rectangles [R, 4] and their edge bits [R].

    Cuts run along x first, so long pieces lie along x. Holes may touch each other and reach beyond
    the outer rectangle. An edge bit is set where the piece borders a hole, or lies on those sides
    of the outer rectangle that `rim` names.
    """
    x0, y0, x1, y1 = outer
    clipped = [
        (max(a, x0), max(b, y0), min(c, x1), min(d, y1))
        for a, b, c, d in holes
        if min(c, x1) - max(a, x0) > 1e-9 and min(d, y1) - max(b, y0) > 1e-9
    ]
    levels = sorted({y0, y1, *(h[1] for h in clipped), *(h[3] for h in clipped)})
    pieces: list[Rectangle] = []
    for low, high in itertools.pairwise(levels):
        here = sorted((h[0], h[2]) for h in clipped if h[1] <= low and h[3] >= high)
        start = x0
        for a, b in [*here, (x1, x1)]:
            if a - start > 1e-9:
                pieces.append((start, low, a, high))
            start = max(start, b)
    pieces = _merged(pieces)
    return np.array(pieces).reshape(-1, 4), _edge_bits(pieces, outer, clipped, rim)


def _merged(pieces: list[Rectangle]) -> list[Rectangle]:
    """Pieces of equal x range stacked on each other, joined."""
    out: list[Rectangle] = []
    for piece in pieces:
        for i, other in enumerate(out):
            if other[0] == piece[0] and other[2] == piece[2] and other[3] == piece[1]:
                out[i] = (other[0], other[1], other[2], piece[3])
                break
        else:
            out.append(piece)
    return out


def _edge_bits(
    pieces: Sequence[Rectangle], outer: Rectangle, holes: Sequence[Rectangle], rim: int
) -> np.ndarray:
    """Bits [R] of the sides of each piece that border a hole or a named side of the rim."""
    p = np.array(pieces).reshape(-1, 4)[:, None]  # [R, 1, 4] against holes [1, H, 4]
    h = np.array(holes).reshape(-1, 4)[None]
    beside = (h[..., 1] < p[..., 3]) & (h[..., 3] > p[..., 1])
    above = (h[..., 0] < p[..., 2]) & (h[..., 2] > p[..., 0])
    bits = np.zeros(len(pieces), np.uint8)
    for bit, side, across in ((U0, 0, beside), (V0, 1, above), (U1, 2, beside), (V1, 3, above)):
        value = p[..., side]
        touches = (value == h[..., side]) | (value == h[..., (side + 2) % 4])
        borders = (touches & across).any(1) | ((value[:, 0] == outer[side]) & bool(rim & bit))
        bits |= np.where(borders, bit, 0).astype(np.uint8)
    return bits


# ---- Builders ------------------------------------------------------------------------------------


Vectors = Sequence[float] | np.ndarray  # [3] or [P, 3]


def xyz(x: np.ndarray | float, y: np.ndarray | float, z: np.ndarray | float) -> np.ndarray:
    """Vectors [N, 3] of coordinates [N] or one for all."""
    out = np.empty((*np.broadcast(x, y, z).shape, 3))
    out[..., 0], out[..., 1], out[..., 2] = x, y, z
    return out


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products [..., 3]: what np.cross gives, in half its time."""
    (ax, ay, az), (bx, by, bz) = ((v[..., 0], v[..., 1], v[..., 2]) for v in (a, b))
    return xyz(ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)


def _rows(values: Vectors) -> np.ndarray:
    return np.asarray(values, np.float64).reshape(-1, 3)


def parallelograms(
    origin: Vectors, u: Vectors, v: Vectors, look: Look, *, edges: np.ndarray | int = ALL_EDGES
) -> Shapes:
    """Flat panels with corner `origin` and sides u, v; they face u x v."""
    origin, u, v = _rows(origin), _rows(u), _rows(v)
    return Shapes.of(Kind.PARALLELOGRAM, origin, (u, v, unit(cross(u, v))), look, edges)


def boxes(
    low: Vectors,
    high: Vectors,
    look: Look,
    *,
    faces: Sequence[str] = ("+x", "-x", "+y", "-y", "+z"),
    edges: int = ALL_EDGES,
) -> Shapes:
    """Axis-aligned boxes between corners low and high; the named faces only."""
    low, high = _rows(low), _rows(high)
    along = np.eye(3)[["xyz".index(face[1]) for face in faces], None]  # [F, 1, 3]
    outward = np.array([face[0] == "+" for face in faces])[:, None, None]
    corner = np.where((along > 0) & outward, high, low)  # [F, B, 3]
    second, third = np.roll(along, 1, -1) * (high - low), np.roll(along, 2, -1) * (high - low)
    u, v = np.where(outward, second, third), np.where(outward, third, second)
    return parallelograms(corner, u, v, look, edges=edges)


def disc(centre: Sequence[float], normal: Sequence[float], radius_m: float, look: Look) -> Shapes:
    """A flat round plate."""
    u, v, w = _frame(np.asarray(normal, np.float64))
    return Shapes.of(Kind.DISC, _rows(centre), _each(u * radius_m, v * radius_m, w), look)


def tube(start: Sequence[float], end: Sequence[float], radius_m: float, look: Look) -> Shapes:
    """A round tube between two points, open at its ends."""
    a, b = np.asarray(start, np.float64), np.asarray(end, np.float64)
    u, v, _ = _frame(b - a)
    axes = _each(u * radius_m, v * radius_m, (b - a) / 2)
    return Shapes.of(Kind.CYLINDER, _rows((a + b) / 2), axes, look)


def ellipsoids(centres: Vectors, axes: np.ndarray, look: Look) -> Shapes:
    """Ellipsoids with orthogonal semi-axes axes [P, 3, 3] (rows), metres."""
    return Shapes.of(Kind.ELLIPSOID, _rows(centres), axes.transpose(1, 0, 2), look)


def ball(centre: Sequence[float], radii: Sequence[float], look: Look) -> Shapes:
    """One ellipsoid along the coordinate axes."""
    return ellipsoids(centre, np.diag(np.asarray(radii, np.float64))[None], look)


def quads(corners: np.ndarray, look: Look, *, normals: np.ndarray | None = None) -> Shapes:
    """Four-sided panels [P, 4, 3], corners in turn, facing (c1 - c0) x (c3 - c0).

    Parallelograms stay whole; others become two triangles, as do panels of a smooth mesh, whose
    shading normals at the corners are `normals` [P, 4, 3].
    """
    corners = np.asarray(corners, np.float64)
    slack = np.abs(corners[:, 0] - corners[:, 1] + corners[:, 2] - corners[:, 3]).max(1)
    whole = (slack < 1e-9) & (normals is None)
    a, b, _, d = corners[whole].transpose(1, 0, 2)
    c = corners[~whole]
    parts = [parallelograms(a, b - a, d - a, look, edges=0)]
    for (i, j, k), flag in (((0, 1, 3), 0), ((2, 3, 1), OPEN_DIAGONAL)):
        shading = None
        if normals is not None:
            shading = normals[:, i], normals[:, j] - normals[:, i], normals[:, k] - normals[:, i]
        parts.append(triangles(c[:, i], c[:, j], c[:, k], look, flag, shading))
    return join(parts)


def triangles(
    a: Vectors, b: Vectors, c: Vectors, look: Look, edges: int = 0,
    shading: Sequence[np.ndarray] | None = None,
) -> Shapes:  # fmt: skip
    """Triangles, facing (b - a) x (c - a)."""
    a = _rows(a)
    u, v = b - a, c - a
    return Shapes.of(Kind.TRIANGLE, a, (u, v, unit(cross(u, v))), look, edges, shading)


def _frame(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit u, v, w, right-handed, with w along the direction."""
    w = direction / np.linalg.norm(direction)
    helper = np.array([1.0, 0.0, 0.0]) if abs(w[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    u = cross(helper, w)
    u /= np.linalg.norm(u)
    return u, cross(w, u), w


def _each(*vectors: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(vector[None] for vector in vectors)
