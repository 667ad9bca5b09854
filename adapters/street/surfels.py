"""Cells of surfaces: where splats stand and how large each is.

Flat panels carry a lattice whose last rows narrow towards crisp edges; discs carry rings, round
forms a wrapped lattice or a spiral.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapters.street.materials import Material
from adapters.street.shapes import OPEN_DIAGONAL, U0, U1, V0, V1, Kind, Shapes

# Where rows along a crisp edge end, in cells, by how many rows are added there: 0, 1 or 2.
NARROWING = np.array([[0, 0, 0], [0, 0.3, 0], [0, 0.16, 0.46]])
LEAST_ROUND = 8  # cells around a tube
LEAST_BLOB = 30  # cells on an ellipsoid
# Hidden panels: cells by which splats keep clear of crisp edges, and the side below which a panel
# gets no splat at all; for tubes the girth.
INSET = 0.5
LEAST_HIDDEN_M = 0.4
HIDDEN_TUFTS_DROPPED = 0.6
FINE_FROM = 7  # cells along a side from which its crisp edges get two more rows, not one


@dataclass(frozen=True, eq=False)
class Cells:
    """shape [N]; local [N, 3]: the cell's middle; sides [N, 2, 3]: its sides in the shape's local
    coordinates; edges [N, 2, 3]: the same in metres.
    """

    shape: np.ndarray
    local: np.ndarray
    sides: np.ndarray
    edges: np.ndarray

    def select(self, index: np.ndarray) -> Cells:
        return Cells(self.shape[index], self.local[index], self.sides[index], self.edges[index])

    def places(self) -> np.ndarray:
        """Four places in each cell, local coordinates [4, N, 3]."""
        a, b = self.sides[:, 0] / 4, self.sides[:, 1] / 4
        return np.stack(
            [self.local + i * a + j * b for i, j in ((-1, -1), (1, 1), (-1, 1), (1, -1))]
        )


def cell_counts(shapes: Shapes, spacing: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """How many cells along both axes, [P, 2]; spacing [P, 2] in metres, hidden [P].

    Discs: rings and cells in the outermost. Tubes: around and along. Ellipsoids: in all, and 1.
    """
    length = np.linalg.norm(shapes.axes, axis=2)
    counts = np.ceil(length[:, :2] / spacing - 1e-9)
    kind = shapes.kind
    disc, tube, blob = (kind == k for k in (Kind.DISC, Kind.CYLINDER, Kind.ELLIPSOID))
    round_length = 2 * np.pi * length[:, 0]
    counts[disc, 1] = np.ceil(round_length / spacing.min(1))[disc]
    counts[tube, 0] = np.maximum(LEAST_ROUND, np.ceil(round_length / spacing.min(1)))[tube]
    counts[tube, 1] = np.maximum(2, np.ceil(2 * length[:, 2] / spacing.max(1)))[tube]
    counts[blob, 0] = np.maximum(LEAST_BLOB, np.ceil(_area(length) / spacing.min(1) ** 2))[blob]
    counts[blob, 1] = 1
    tuft = shapes.material == Material.LEAF
    counts[tuft] = 1
    counts = np.maximum(counts, 1)
    panel = shapes.kind == Kind.PARALLELOGRAM
    counts[hidden & panel & (length[:, :2].max(1) < LEAST_HIDDEN_M)] = 0
    counts[hidden & tuft & (shapes.variation < HIDDEN_TUFTS_DROPPED)] = 0
    counts[hidden & tube & (length[:, 0] < LEAST_HIDDEN_M / 4)] = 0
    return counts.astype(np.int64)


def total_cells(shapes: Shapes, counts: np.ndarray, hidden: np.ndarray) -> int:
    """How many cells these counts come to, nearly (triangles and discs are estimated)."""
    m = counts + _graded(shapes, np.arange(len(shapes)), counts, hidden).sum(2)
    each = (m[:, 0] * m[:, 1]).astype(np.float64)
    each[shapes.kind == Kind.TRIANGLE] *= 0.5
    each[shapes.kind == Kind.DISC] *= 0.5
    tube = shapes.kind == Kind.CYLINDER
    each[tube] = (counts[:, 0] * (counts[:, 1] + 2))[tube]
    return int(each.sum())


def make_cells(shapes: Shapes, counts: np.ndarray, hidden: np.ndarray) -> Cells:
    """All cells of all shapes; counts [P, 2] and hidden [P] as in cell_counts."""
    parts = []
    for kinds, build in (
        ((Kind.PARALLELOGRAM, Kind.TRIANGLE), _flat_cells),
        ((Kind.DISC,), _disc_cells),
        ((Kind.CYLINDER,), _tube_cells),
        ((Kind.ELLIPSOID,), _blob_cells),
    ):
        index = np.flatnonzero(np.isin(shapes.kind, kinds) & (counts[:, 0] > 0))
        if len(index):
            parts.append(build(shapes, index, counts[index], hidden))
    if not parts:
        return Cells(
            np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 2, 3)), np.zeros((0, 2, 3))
        )
    shape, local, sides = (np.concatenate(p) for p in zip(*parts, strict=True))
    inset = hidden[shape] & (shapes.kind[shape] == Kind.PARALLELOGRAM)
    _draw_in(shapes, counts, np.flatnonzero(inset), shape, local, sides)
    return Cells(shape, local, sides, np.einsum("nak,nkj->naj", sides, shapes.axes[shape]))


def _draw_in(
    shapes: Shapes,
    counts: np.ndarray,
    index: np.ndarray,
    shape: np.ndarray,
    local: np.ndarray,
    sides: np.ndarray,
) -> None:
    """Move the cells at index, in place, away from the crisp edges of their panels."""
    for axis, (low_bit, high_bit) in enumerate(((U0, U1), (V0, V1))):
        margin = np.minimum(INSET / counts[shape[index], axis], 0.25)
        low = margin * ((shapes.edges[shape[index]] & low_bit) > 0)
        high = margin * ((shapes.edges[shape[index]] & high_bit) > 0)
        local[index, axis] = low + local[index, axis] * (1 - low - high)
        sides[index, axis] *= (1 - low - high)[:, None]


def _graded(
    shapes: Shapes, index: np.ndarray, counts: np.ndarray, hidden: np.ndarray
) -> np.ndarray:
    """Rows added at both ends of both axes, [I, 2 axes, 2 ends], for the shapes at index."""
    bits = np.array([[U0, U1], [V0, V1]], np.uint8)
    flagged = (shapes.edges[index, None, None] & bits) > 0
    rows = (counts >= 2).astype(np.int64) + (counts >= FINE_FROM)
    rows *= ((shapes.kind == Kind.PARALLELOGRAM) & ~hidden)[index, None]
    return flagged * rows[:, :, None]


def _expand(each: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Owner and running number within the owner of sum(each) items."""
    owner = np.repeat(np.arange(len(each)), each)
    return owner, np.arange(len(owner)) - np.repeat(np.cumsum(each) - each, each)


def _line(i: np.ndarray, cells: np.ndarray, low: np.ndarray, high: np.ndarray):
    """Middle and width of cell i on [0, 1]: `cells` equal ones, with rows added at both ends."""
    total = cells + low + high

    def border(k: np.ndarray) -> np.ndarray:
        near = NARROWING[low, np.minimum(k, low)]
        far = NARROWING[high, np.minimum(total - k, high)]
        at = np.where(k <= low, near, k - low)
        return np.where(total - k <= high, cells - far, at)

    a, b = border(i) / cells, border(i + 1) / cells
    return (a + b) / 2, b - a


def _flat_cells(shapes: Shapes, index: np.ndarray, counts: np.ndarray, hidden: np.ndarray):
    graded = _graded(shapes, index, counts, hidden)
    m = counts + graded.sum(2)
    owner, number = _expand(m[:, 0] * m[:, 1])
    i, j = number // m[owner, 1], number % m[owner, 1]
    u, du = _line(i, counts[owner, 0], graded[owner, 0, 0], graded[owner, 0, 1])
    v, dv = _line(j, counts[owner, 1], graded[owner, 1, 0], graded[owner, 1, 1])
    shape = index[owner]
    over = u + v - 1
    opened = (shapes.edges[shape] & OPEN_DIAGONAL) > 0
    inside = (shapes.kind[shape] != Kind.TRIANGLE) | (over < np.where(opened, -1e-9, 1e-9))
    local = np.stack([u, v, np.zeros_like(u)], 1)[inside]
    sides = np.zeros((len(u), 2, 3))
    sides[:, 0, 0], sides[:, 1, 1] = du, dv
    return shape[inside], local, sides[inside]


def _disc_cells(shapes: Shapes, index: np.ndarray, counts: np.ndarray, hidden: np.ndarray):
    ring_owner, ring = _expand(counts[:, 0])
    rings = counts[ring_owner, 0]
    around = np.maximum(1, np.round(counts[ring_owner, 1] * (ring + 0.5) / rings)).astype(np.int64)
    around = np.where((ring == 0) & (rings > 1), np.maximum(around, 3), around)
    owner, number = _expand(around)
    whole = rings[owner] == 1
    radius = np.where(whole, 0.0, (ring[owner] + 0.5) / rings[owner])
    angle = 2 * np.pi * (number + 0.5 * (ring[owner] % 2)) / around[owner]
    c, s, zero = np.cos(angle), np.sin(angle), np.zeros(len(angle))
    depth = np.where(whole, 1.1, 1 / rings[owner])
    width = np.where(whole, 1.1, 2 * np.pi * radius / around[owner])
    sides = np.stack(
        [
            np.stack([c * depth, s * depth, zero], 1),
            np.stack([-s * width, c * width, zero], 1),
        ],
        1,
    )
    return index[ring_owner[owner]], np.stack([radius * c, radius * s, zero], 1), sides


def _tube_cells(shapes: Shapes, index: np.ndarray, counts: np.ndarray, hidden: np.ndarray):
    rows = counts[:, 1] + 2
    owner, number = _expand(counts[:, 0] * rows)
    i, j = number // rows[owner], number % rows[owner]
    angle = 2 * np.pi * (i + 0.5 * (j % 2)) / counts[owner, 0]
    c, s, zero = np.cos(angle), np.sin(angle), np.zeros(len(angle))
    width = 2 * np.pi / counts[owner, 0]
    one = np.ones_like(j)
    middle, height = _line(j, counts[owner, 1], one, one)
    sides = np.stack(
        [np.stack([-s * width, c * width, zero], 1), np.stack([zero, zero, 2 * height], 1)], 1
    )
    return index[owner], np.stack([c, s, 2 * middle - 1], 1), sides


def _blob_cells(shapes: Shapes, index: np.ndarray, counts: np.ndarray, hidden: np.ndarray):
    """A spiral of equal areas on the unit sphere."""
    owner, number = _expand(counts[:, 0])
    total = counts[owner, 0]
    z = 1 - (2 * number + 1) / total
    angle = number * 2.399963229728653
    flat = np.sqrt(1 - z * z)
    c, s, zero = np.cos(angle), np.sin(angle), np.zeros(len(angle))
    size = np.sqrt(4 * np.pi / total)[:, None]
    sides = np.stack(
        [np.stack([-s, c, zero], 1) * size, np.stack([-z * c, -z * s, flat], 1) * size], 1
    )
    return index[owner], np.stack([flat * c, flat * s, z], 1), sides


def _area(length: np.ndarray) -> np.ndarray:
    """Surface of ellipsoids with semi-axes [P, 3] (Thomsen's approximation, within 1.1 %)."""
    a, b, c = (length**1.6075).T
    return 4 * np.pi * ((a * b + a * c + b * c) / 3) ** (1 / 1.6075)
