"""Gaussians of the procedural street's bodies: flat, opaque, overlapping, coloured as the
surface.

`plan_splats` plans the spacing on each surface of a body, `coarseness_for` fits the number of
splats to a target, `splat` makes the Gaussians, `contact_shadow` and `shadow_gaussians` the shadow
of a moving body. The caller is `adapters.procedural`. Axes of arrays: P shapes, N cells, E eyes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch

from adapters.street.forms import OPEN_DIAGONAL, U0, U1, V0, V1, Kind, Material, Shapes, join, xyz
from adapters.street.light import SKY_RGB, SUN_RGB, Body
from adapters.street.raycast import Tree
from adapters.street.world import MovingBody
from adapters.world import join_gaussians
from augment.render.sh import SH_C0
from augment.scene.geometry import quat_from_rotmat
from augment.scene.scene import Gaussians
from augment.scene.semantics import SemanticClass

# ---- How far apart the splats of each surface may stand, and how far below it they must lie ------
# A splat's footprint should look equally large wherever the ego cameras see it from, so its spacing
# follows their nearest distance, and along a surface seen at a slant it is stretched.

# Panels are never cut shorter than half the first length, and walls are never left longer than the
# second.
SPLIT_M = (1.6, 4.0)
# Sine of the steepest ray of a level camera, up or down.
MAX_RAY_SINE = 0.42
# Largest stretch of the spacing along a surface that is seen at a slant.
MAX_STRETCH = 2.6
# Stretch of the spacing on surfaces that no camera sees.
HIDDEN_STRETCH = 3.5
# Eyes from which visibility is tested, by their rank in distance.
EYE_RANKS = (0, 1, 2, 3, 5, 8, 13, 21, 34)
# Places on a shape that are tested from each eye.
PLACES_PER_EYE = 3
# Smallest spacing of splats.
MIN_SPACING_M = 0.02
# Blending takes nearer splats first, which puts the weighted mean this many spacings too near,
# along the surface: measured against the truth for one layer of splats.
BLEND_LEAD = 0.62
# The same for two layers of splats (see `splat`).
BACKED_BLEND_LEAD = 0.41


@dataclass(frozen=True, eq=False)
class SplatPlan:
    """Surfaces of one body, split where they are long, ready to be sampled at any coarseness.

    Attributes:
        body: the body.
        shapes: its split shapes.
        spacing: float [P, 2], distance of splats along both axes, metres per unit of coarseness.
        sink: float [P], depth of splats below the surface in spacings, so that their blend appears
            on it.
        is_hidden: bool [P], True if no camera sees the shape. Its splats may be few, but must keep
            clear of rims.
    """

    body: Body
    shapes: Shapes
    spacing: np.ndarray
    sink: np.ndarray
    is_hidden: np.ndarray

    @cached_property
    def lengths(self) -> np.ndarray:
        """Return the lengths of the shapes' three axes, metres [P, 3]."""
        return np.linalg.norm(self.shapes.axes, axis=2)

    def counts(self, coarseness: float) -> np.ndarray:
        """Return the number of cells of the first layer along both axes, int64 [P, 2].

        Discs: rings, and cells in the outermost ring. Tubes: around and along. Ellipsoids: in all,
        and 1.
        """
        spacing_m = np.maximum(self.spacing * coarseness, MIN_SPACING_M)
        (a, b, c) = self.lengths.T
        shorter_side = np.minimum(spacing_m[:, 0], spacing_m[:, 1])
        longer_side = np.maximum(spacing_m[:, 0], spacing_m[:, 1])
        counts = np.ceil(self.lengths[:, :2] / spacing_m - 1e-9)
        is_panel, is_disc, is_tube, is_blob = (
            self.shapes.kind == kind
            for kind in (Kind.PARALLELOGRAM, Kind.DISC, Kind.CYLINDER, Kind.ELLIPSOID)
        )
        is_tuft = self.shapes.material == Material.LEAF
        is_blob &= ~is_tuft
        counts[is_disc, 1] = np.ceil(2 * np.pi * a[is_disc] / shorter_side[is_disc])
        counts[is_tube, 0] = np.maximum(
            MIN_TUBE_CELLS, np.ceil(2 * np.pi * a[is_tube] / shorter_side[is_tube])
        )
        counts[is_tube, 1] = np.maximum(2, np.ceil(2 * c[is_tube] / longer_side[is_tube]))
        counts[is_blob, 0] = np.ceil(_area(self.lengths[is_blob]) / shorter_side[is_blob] ** 2)
        counts[is_blob, 0] = np.maximum(MIN_ELLIPSOID_CELLS, counts[is_blob, 0])
        counts[is_blob, 1] = 1
        counts[is_tuft] = 1
        counts = np.maximum(counts, 1)
        counts[self.is_hidden & is_panel & (np.maximum(a, b) < MIN_HIDDEN_M)] = 0
        counts[self.is_hidden & is_tuft & (self.shapes.variation < HIDDEN_TUFT_DROP_FRACTION)] = 0
        counts[self.is_hidden & is_tube & (a < MIN_HIDDEN_M / 4)] = 0
        return counts.astype(np.int64)

    def backing(self, counts: np.ndarray) -> np.ndarray:
        """Return the number of cells of the second layer, [P, 2]; 0 if there is no such layer."""
        is_backed = self.shapes.backed & ~self.is_hidden & (counts >= MIN_BACKED_CELLS).all(1)
        return np.where(is_backed[:, None], -(-counts // BACKING_RATIO), 0)

    def total(self, coarseness: float) -> int:
        """Return the number of all cells, nearly (triangles and discs are estimated)."""
        counts = self.counts(coarseness)
        kind = self.shapes.kind
        edge_rows = _count_edge_rows(self.shapes, slice(None), counts, self.is_hidden)
        backing_counts = self.backing(counts)
        u, v = (counts + edge_rows[..., 0] + edge_rows[..., 1]).T
        num_cells = u * (v + 2 * (kind == Kind.CYLINDER))
        existing_fraction = np.where((kind == Kind.TRIANGLE) | (kind == Kind.DISC), 0.5, 1.0)
        return int((existing_fraction * num_cells).sum()) + int(
            (backing_counts[:, 0] * backing_counts[:, 1]).sum()
        )


def split_long(shapes: Shapes, eyes: np.ndarray) -> Shapes:
    """Return the same surfaces, with long parallelograms halved until one spacing suits each
    part.
    """
    finished_parts = []
    while len(shapes):
        distance = _nearest_sightings(shapes, eyes)[0].min(0)
        sides = np.linalg.norm(shapes.axes[:, :2], axis=2)
        max_side_m = np.maximum(SPLIT_M[0], 0.45 * distance)
        is_built = shapes.semantic != SemanticClass.TERRAIN
        max_side_m[is_built] = np.minimum(max_side_m, SPLIT_M[1])[is_built]
        is_long = (sides.max(1) > max_side_m) & (shapes.kind == Kind.PARALLELOGRAM)
        finished_parts.append(shapes[~is_long])
        shapes = _halve(shapes[is_long], sides[is_long].argmax(1))
    return join(finished_parts)


def _halve(shapes: Shapes, axis: np.ndarray) -> Shapes:
    """Return both halves of each parallelogram along its axis. Only outer edges stay crisp."""
    rows = np.arange(len(shapes))
    first_halves = shapes.copy()
    first_halves.axes[rows, axis] *= 0.5
    second_halves = first_halves.copy()
    second_halves.origin[:] += second_halves.axes[rows, axis]
    first_halves.edges[:] &= ~np.array([U1, V1], np.uint8)[axis]
    second_halves.edges[:] &= ~np.array([U0, V0], np.uint8)[axis]
    return join([first_halves, second_halves])


def plan_splats(body: Body, eyes: np.ndarray) -> SplatPlan:
    """Plan the sampling of a body that is seen from eyes [E, 3] (in its frame)."""
    shapes = split_long(body.shapes, eyes)
    distance, view = _nearest_sightings(shapes, eyes)
    sides = shapes.axes[:, :2]
    sides = sides / np.linalg.norm(sides, axis=2, keepdims=True)
    cosine = np.einsum("epk,pak->epa", view, sides)
    stretch = 1 / np.sqrt(np.maximum(1 - cosine**2, 1 / MAX_STRETCH**2))
    spacing = (distance[..., None] * stretch).min(0)
    is_flat = shapes.kind <= Kind.DISC
    slant = np.einsum("epk,pk->ep", view, shapes.axes[:, 2])
    is_tuft = shapes.material == Material.LEAF
    is_hidden = ((shapes.kind != Kind.ELLIPSOID) | is_tuft) & ~_find_visible(
        shapes, body.tree, eyes
    )
    spacing[is_hidden & is_flat] *= HIDDEN_STRETCH
    spacing *= shapes.spacing[:, None]
    sink = np.where(is_flat, _blend_depth(distance, slant, cosine, spacing, shapes.backed), 0.25)
    return SplatPlan(body, shapes, spacing, sink, is_hidden)


def _find_visible(shapes: Shapes, tree: Tree, eyes: np.ndarray) -> np.ndarray:
    """Return the shapes that some of the eyes can see, bool [P].

    A few places are tested on each shape, other ones for each eye.
    """
    is_visible = np.zeros(len(shapes), bool)
    is_round = shapes.kind >= Kind.ELLIPSOID
    radius = np.where(is_round, np.linalg.norm(shapes.axes, axis=2)[:, :2].max(1) * 1.05, 0)
    distance = np.linalg.norm(shapes.origin[None] - eyes[:, None], axis=2)
    nearest = np.argsort(distance, axis=0, kind="stable")  # [E, P]: eyes by distance
    eye_ranks = [rank for rank in EYE_RANKS if rank < len(eyes)]
    for number in range(len(eye_ranks) * PLACES_PER_EYE):
        index = np.flatnonzero(~is_visible)
        target = _sample_point(shapes, index, number)
        to_eye = eyes[nearest[eye_ranks[number // PLACES_PER_EYE], index]] - target
        length = np.linalg.norm(to_eye, axis=1)
        is_facing = is_round[index] | ((to_eye * shapes.axes[index, 2]).sum(1) > 0)
        is_facing &= (np.abs(to_eye[:, 2]) < 1.2 * MAX_RAY_SINE * length) & (length > radius[index])
        index = index[is_facing]
        to_eye = to_eye[is_facing]
        target = target[is_facing]
        length = length[is_facing]
        start = (radius[index] / length)[:, None]
        is_visible[index] = ~tree.occluded(target + start * to_eye, (1 - start) * to_eye, 1.0)
    return is_visible


def _sample_point(shapes: Shapes, index: np.ndarray, number: int) -> np.ndarray:
    """Return a point on each shape at index (on the axis of round forms), [I, 3].

    Numbers spread out.
    """
    kind = shapes.kind[index]
    (u, v, w) = shapes.axes[index].transpose(1, 0, 2)
    a, b = (0.06 + 0.88 * ((0.5 + number * step) % 1.0) for step in (0.7549, 0.5698))
    is_beyond_diagonal = (kind == Kind.TRIANGLE) & (a + b > 1)
    a = np.where(is_beyond_diagonal, 1 - a, a)
    b = np.where(is_beyond_diagonal, 1 - b, b)
    is_centered = kind >= Kind.DISC
    a, b = (np.where(is_centered, 1.4 * (c - 0.5), c)[:, None] for c in (a, b))
    is_round = (kind >= Kind.ELLIPSOID)[:, None]
    return shapes.origin[index] + np.where(is_round, b * w, a * u + b * v + 0.004 * w)


def _nearest_sightings(shapes: Shapes, eyes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distance [E, P] and unit direction [E, P, 3] from each eye to the nearest visible
    place.
    """
    to_nearest = shapes.origin[None] - eyes[:, None]  # [E, P, 3], from the eye
    is_straight = shapes.kind <= Kind.TRIANGLE
    for axis in range(2):
        side = shapes.axes[:, axis] * is_straight[:, None]
        square = np.maximum((side**2).sum(1), 1e-12)
        side_fraction = np.clip(-np.einsum("epk,pk->ep", to_nearest, side) / square, 0, 1)
        to_nearest = to_nearest + side_fraction[..., None] * side
    length = np.maximum(np.linalg.norm(to_nearest, axis=2), 0.3)
    view = to_nearest / length[..., None]
    return np.maximum(length, np.abs(to_nearest[..., 2]) / MAX_RAY_SINE), view


def _blend_depth(distance, slant, cosine, along, backed) -> np.ndarray:
    """Return the depth below the surface [P], per unit of spacing, that puts the blend on the
    surface.

    A splat that lies h below the surface appears h / slant further along the ray. Blending brings
    it some part of a spacing nearer along the surface. No depth suits all eyes: the weighted median
    makes the error least where most pixels are spent on the surface.

    Args:
        distance: float [E, P], from the eyes.
        slant: float [E, P], negative if the shape faces the eye.
        cosine: float [E, P, 2], between the view and the axes.
        along: float [P, 2], spacing along the axes.
        backed: bool [P].
    """
    is_facing = slant < 0
    slant = np.clip(np.abs(slant), 0.04, 1)
    horizontal = np.sqrt(1 - slant**2)
    spacing_along_view = np.sqrt((cosine**2 * along**2).sum(2)) / np.maximum(horizontal, 1e-6)
    blend_lead = np.where(backed, BACKED_BLEND_LEAD, BLEND_LEAD)
    depth = blend_lead * spacing_along_view / along.max(1) * horizontal * slant
    weight = is_facing / distance**2  # pixels go with slant, what an error costs with 1 / slant
    order = np.argsort(depth, axis=0)
    weights = np.cumsum(np.take_along_axis(weight, order, 0), axis=0)
    median_row = (weights < weights[-1] / 2).sum(0)
    rows = np.take_along_axis(order, np.minimum(median_row, len(order) - 1)[None], 0)
    return np.minimum(np.take_along_axis(depth, rows, 0)[0], 0.5)


# ---- Cells of surfaces: where splats stand and how large each is ---------------------------------
# Flat panels carry a lattice whose last rows narrow towards crisp edges; discs carry rings, round
# forms a wrapped lattice or a spiral.

# Where rows along a crisp edge end, in cells, by how many rows are added there: 0, 1 or 2.
NARROWING = np.array([[0, 0, 0], [0, 0.3, 0], [0, 0.16, 0.46]])
# Smallest number of cells around a tube.
MIN_TUBE_CELLS = 8
# Smallest number of cells on an ellipsoid.
MIN_ELLIPSOID_CELLS = 30
# Cells by which splats of hidden panels keep clear of crisp edges.
INSET_CELLS = 0.5
# Hidden panels with shorter sides, and hidden tubes of a smaller girth, get no splat.
MIN_HIDDEN_M = 0.4
# Fraction of hidden leaf tufts that is left out.
HIDDEN_TUFT_DROP_FRACTION = 0.6
# Cells along a side from which its crisp edges get two more rows, not one.
MIN_FINE_CELLS = 7


class Cells(NamedTuple):
    """Cells of surfaces; each becomes a splat.

    Attributes:
        shape: int [N], number of the shape.
        local: float [N, 3], middle of the cell in the shape's local coordinates.
        sides: float [N, 2, 3], its sides in local coordinates.
    """

    shape: np.ndarray
    local: np.ndarray
    sides: np.ndarray

    def places(self) -> np.ndarray:
        """Return four places in each cell, local coordinates [4, N, 3]."""
        a = self.sides[:, 0] / 4
        b = self.sides[:, 1] / 4
        around = ((-1, -1), (1, 1), (-1, 1), (1, -1))
        return np.stack([self.local + i * a + j * b for i, j in around])


def make_cells(shapes: Shapes, counts: np.ndarray, is_hidden: np.ndarray) -> Cells:
    """Return all cells of all shapes. counts [P, 2] and is_hidden [P] are those of a plan."""
    parts = []
    for build, *kinds in (
        (_flat_cells, Kind.PARALLELOGRAM, Kind.TRIANGLE),
        (_disc_cells, Kind.DISC),
        (_tube_cells, Kind.CYLINDER),
        (_blob_cells, Kind.ELLIPSOID),
    ):
        index = np.flatnonzero(np.isin(shapes.kind, kinds) & (counts[:, 0] > 0))
        parts.append(build(shapes, index, counts[index], is_hidden))
    shape, local, sides = (np.concatenate(p) for p in zip(*parts, strict=True))
    # Splats of hidden panels keep away from their crisp edges.
    index = np.flatnonzero(is_hidden[shape] & (shapes.kind[shape] == Kind.PARALLELOGRAM))
    edges = shapes.edges[shape[index]]
    for axis, (low_bit, high_bit) in enumerate(((U0, U1), (V0, V1))):
        margin = np.minimum(INSET_CELLS / counts[shape[index], axis], 0.25)
        low_inset = margin * ((edges & low_bit) > 0)
        high_inset = margin * ((edges & high_bit) > 0)
        local[index, axis] = low_inset + local[index, axis] * (1 - low_inset - high_inset)
        sides[index, axis] *= (1 - low_inset - high_inset)[:, None]
    return Cells(shape, local, sides)


def _count_edge_rows(
    shapes: Shapes, index, counts: np.ndarray, is_hidden: np.ndarray
) -> np.ndarray:
    """Return the rows added at both ends of both axes, [I, 2 axes, 2 ends], for the shapes at
    index.
    """
    bits = np.array([[U0, U1], [V0, V1]], np.uint8)
    is_crisp = (shapes.edges[index][:, None, None] & bits) > 0
    num_rows = (counts >= 2).astype(np.int64) + (counts >= MIN_FINE_CELLS)
    num_rows *= ((shapes.kind == Kind.PARALLELOGRAM) & ~is_hidden)[index][:, None]
    return is_crisp * num_rows[:, :, None]


def _expand_counts(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the owner and the running number within the owner of sum(counts) items."""
    owners = np.repeat(np.arange(len(counts)), counts)
    return owners, np.arange(len(owners)) - np.repeat(np.cumsum(counts) - counts, counts)


def _cell_on_line(i: np.ndarray, cells: np.ndarray, low_rows: np.ndarray, high_rows: np.ndarray):
    """Return the middle and width of cell i on [0, 1]: `cells` equal ones, with rows added at
    both ends.
    """
    total = cells + low_rows + high_rows

    def border(k: np.ndarray) -> np.ndarray:
        low_border = NARROWING[low_rows, np.minimum(k, low_rows)]
        high_border = NARROWING[high_rows, np.minimum(total - k, high_rows)]
        position = np.where(k <= low_rows, low_border, k - low_rows)
        return np.where(total - k <= high_rows, cells - high_border, position)

    a = border(i) / cells
    b = border(i + 1) / cells
    return (a + b) / 2, b - a


def _flat_cells(shapes: Shapes, index: np.ndarray, counts: np.ndarray, is_hidden: np.ndarray):
    edge_rows = _count_edge_rows(shapes, index, counts, is_hidden)
    num_rows = counts + edge_rows.sum(2)
    owner, number = _expand_counts(num_rows[:, 0] * num_rows[:, 1])
    i = number // num_rows[owner, 1]
    j = number % num_rows[owner, 1]
    u, du = _cell_on_line(i, counts[owner, 0], edge_rows[owner, 0, 0], edge_rows[owner, 0, 1])
    v, dv = _cell_on_line(j, counts[owner, 1], edge_rows[owner, 1, 0], edge_rows[owner, 1, 1])
    shape = index[owner]
    diagonal_distance = u + v - 1
    is_open = (shapes.edges[shape] & OPEN_DIAGONAL) > 0
    is_inside = (shapes.kind[shape] != Kind.TRIANGLE) | (
        diagonal_distance < np.where(is_open, -1e-9, 1e-9)
    )
    local = xyz(u, v, 0)[is_inside]
    sides = np.zeros((len(u), 2, 3))
    sides[:, 0, 0] = du
    sides[:, 1, 1] = dv
    return shape[is_inside], local, sides[is_inside]


def _disc_cells(shapes: Shapes, index: np.ndarray, counts: np.ndarray, is_hidden: np.ndarray):
    ring_owner, ring = _expand_counts(counts[:, 0])
    rings = counts[ring_owner, 0]
    num_around = np.maximum(1, np.round(counts[ring_owner, 1] * (ring + 0.5) / rings)).astype(
        np.int64
    )
    num_around = np.where((ring == 0) & (rings > 1), np.maximum(num_around, 3), num_around)
    owner, number = _expand_counts(num_around)
    is_single = rings[owner] == 1
    radius = np.where(is_single, 0.0, (ring[owner] + 0.5) / rings[owner])
    angle = 2 * np.pi * (number + 0.5 * (ring[owner] % 2)) / num_around[owner]
    c = np.cos(angle)
    s = np.sin(angle)
    depth = np.where(is_single, 1.1, 1 / rings[owner])
    width = np.where(is_single, 1.1, 2 * np.pi * radius / num_around[owner])
    sides = np.stack([xyz(c * depth, s * depth, 0), xyz(-s * width, c * width, 0)], 1)
    return index[ring_owner[owner]], xyz(radius * c, radius * s, 0), sides


def _tube_cells(shapes: Shapes, index: np.ndarray, counts: np.ndarray, is_hidden: np.ndarray):
    rows = counts[:, 1] + 2
    owner, number = _expand_counts(counts[:, 0] * rows)
    i = number // rows[owner]
    j = number % rows[owner]
    angle = 2 * np.pi * (i + 0.5 * (j % 2)) / counts[owner, 0]
    c = np.cos(angle)
    s = np.sin(angle)
    width = 2 * np.pi / counts[owner, 0]
    ones = np.ones_like(j)
    middle, height = _cell_on_line(j, counts[owner, 1], ones, ones)
    sides = np.stack([xyz(-s * width, c * width, 0), xyz(0, 0, 2 * height)], 1)
    return index[owner], xyz(c, s, 2 * middle - 1), sides


def _blob_cells(shapes: Shapes, index: np.ndarray, counts: np.ndarray, is_hidden: np.ndarray):
    """Return cells along a spiral of equal areas on the unit sphere."""
    owner, number = _expand_counts(counts[:, 0])
    total = counts[owner, 0]
    z = 1 - (2 * number + 1) / total
    angle = number * 2.399963229728653
    flat = np.sqrt(1 - z * z)
    c = np.cos(angle)
    s = np.sin(angle)
    size = np.sqrt(4 * np.pi / total)[:, None]
    sides = np.stack([xyz(-s, c, 0) * size, xyz(-z * c, -z * s, flat) * size], 1)
    return index[owner], xyz(flat * c, flat * s, z), sides


def _area(length: np.ndarray) -> np.ndarray:
    """Return the surface of ellipsoids with semi-axes [P, 3] (Thomsen's approximation, within
    1.1 %).
    """
    a, b, c = (length**1.6075).T
    return 4 * np.pi * ((a * b + a * c + b * c) / 3) ** (1 / 1.6075)


# ---- The shadow a mover casts on the ground, which travels with it as a soft dark layer ----------

# Edge of a cell of a shadow's grid.
SHADOW_CELL_M = 0.06
# The grid reaches at most this far beyond the mover.
MAX_SHADOW_MARGIN_M = 2.0
# Largest cover of a shadow: the ground below must keep the largest weight in its pixels.
MAX_COVER = 0.5
# Surfaces this near to the ground's plane receive the shadow.
GROUND_BAND_M = 0.25
# Display-encoded colour of a shadow.
SHADOW_RGB = np.array([0.03, 0.032, 0.04])


@dataclass(frozen=True, eq=False)
class ContactShadow:
    """Fraction of SHADOW_RGB that is mixed into the ground, on a grid in the mover's frame.

    Attributes:
        values: float [X, Y], cover in [0, MAX_COVER], zero at the rim.
        origin: x, y of values[0, 0], metres.
        ground_z: height of the ground.
    """

    values: np.ndarray
    origin: np.ndarray
    ground_z: float

    def cover(self, points: np.ndarray) -> np.ndarray:
        """Return the bilinear cover at points [N, 3] of the mover's frame.

        It is zero away from the ground.
        """
        cell = (points[:, :2] - self.origin) / SHADOW_CELL_M
        low_cell = np.floor(cell).astype(np.int64)
        is_inside = np.all((low_cell >= 0) & (low_cell < np.array(self.values.shape) - 1), axis=1)
        is_inside &= np.abs(points[:, 2] - self.ground_z) < GROUND_BAND_M
        cover = np.zeros(len(points))
        i, j = low_cell[is_inside].T
        fx, fy = (cell[is_inside] - low_cell[is_inside]).T
        v = self.values
        cover[is_inside] = (v[i, j] * (1 - fx) + v[i + 1, j] * fx) * (1 - fy) + (
            v[i, j + 1] * (1 - fx) + v[i + 1, j + 1] * fx
        ) * fy
        return cover


def contact_shadow(mover: MovingBody) -> ContactShadow:
    """Compute a mover's shadow: sun shadow by ray casting, sky shadow by the distance to its
    outline.
    """
    lighting = mover.body.lighting
    half = np.array(mover.size_m[:2]) / 2
    length = mover.size_m[2] / np.tan(np.arcsin(lighting.to_sun[2]))
    half_grid = half + np.minimum(length, MAX_SHADOW_MARGIN_M) + 0.4
    counts = np.ceil(2 * half_grid / SHADOW_CELL_M).astype(int) + 1
    origin = -(counts - 1) * SHADOW_CELL_M / 2
    x, y = (origin[k] + SHADOW_CELL_M * np.arange(counts[k]) for k in range(2))
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    points = np.concatenate([grid, np.full((len(grid), 1), lighting.ground_z)], 1)
    is_shaded = [mover.body.tree.occluded(points, d) for d in lighting.sun_directions()]
    sun_light = lighting.sunlit * lighting.to_sun[2] * SUN_RGB.mean()
    received_sun = (1 - np.sum(is_shaded, axis=0) / len(is_shaded)) * sun_light
    corner_radius = 0.8 * half.min()
    outline_distance = (
        np.linalg.norm(np.maximum(np.abs(grid) - half + corner_radius, 0), axis=1) - corner_radius
    )
    sky_blocked = 0.8 / (1 + np.exp((outline_distance - 0.02) / (0.11 * half.min() / 0.9)))
    received_sky = (1 - sky_blocked) * SKY_RGB.mean() * 0.75
    full_light = sun_light + SKY_RGB.mean() * 0.75
    cover = (
        1 - ((received_sun + received_sky) / full_light) ** 0.45
    )  # the display's encoding of that ratio, nearly
    rim_distance = np.min(
        np.minimum(grid - origin, -origin - grid), axis=1
    )  # fade out before the grid ends
    cover = np.minimum(cover, MAX_COVER) * np.clip(rim_distance / 0.3, 0, 1)
    return ContactShadow(cover.reshape(counts), origin, lighting.ground_z)


# ---- Gaussians of cells --------------------------------------------------------------------------

# Opacity of every splat.
SPLAT_OPACITY = 0.99
# Standard deviation per cell side: the least that leaves no gap (alpha > 0.99 in the mean), since
# wider splats blur and lead more (see BLEND_LEAD).
SIGMA_PER_SIDE = 0.74
# The same over a second layer, where splats may be narrower.
BACKED_SIGMA_PER_SIDE = 0.64
# The second layer fills the gaps between the splats of the first. It is this many times as coarse.
# It lies as deep as it is coarse, and so stays behind at every slant.
BACKING_RATIO = 3
# Panels with fewer cells along a side have no second layer.
MIN_BACKED_CELLS = 4
# Sigma per cell side of round forms, whose cells overlap more as they curve.
BLOB_SIGMA_PER_SIDE = 0.66
# Sigma per cell side of the closed meshes of cars: only the car itself shines through.
MESH_SIGMA_PER_SIDE = 0.71
# Sigma per cell side of single rows and hidden panels: half opaque at the edge.
NARROW_SIGMA_PER_SIDE = 0.5
# Sigma of a leaf tuft, which is one splat, per semi-axis.
LEAF_SIGMA = 0.64
# Cells with another surface this near above them are left out.
MIN_CLEARANCE_M = 0.08
# Distance of the splats of a shadow.
SHADOW_SPACING_M = 0.10
# Height of a shadow's splats above the ground.
SHADOW_HEIGHT_M = 0.035


def coarseness_for(plans: list[SplatPlan], target: int) -> float:
    """Return the spacing per metre of distance at which all plans together come to the target."""
    low_coarseness = 1e-3
    high_coarseness = 0.2
    for _ in range(12):
        middle_coarseness = float(np.sqrt(low_coarseness * high_coarseness))
        is_too_many = sum(plan.total(middle_coarseness) for plan in plans) > target
        low_coarseness, high_coarseness = (
            (middle_coarseness, high_coarseness)
            if is_too_many
            else (low_coarseness, middle_coarseness)
        )
    return high_coarseness


def splat(plan: SplatPlan, coarseness: float) -> Gaussians:
    """Return the Gaussians of a body."""
    counts = plan.counts(coarseness)
    backing = plan.backing(counts)
    cells = _drop_buried_cells(plan, make_cells(plan.shapes, counts, plan.is_hidden))
    sigma_per_side = _sigma_per_side(plan, counts, backing)[cells.shape]
    first_layer = _gaussians(plan, cells, sigma_per_side, plan.sink[cells.shape])
    # Under the ground the second layer may run on past an edge; behind a wall's it would be seen.
    is_wall = plan.shapes.semantic == SemanticClass.BUILDING
    backing_cells = make_cells(plan.shapes, backing, is_wall & (backing[:, 0] > 0))
    sigma_per_side = np.full((len(backing_cells.shape), 2), SIGMA_PER_SIDE)
    return join_gaussians(
        [first_layer, _gaussians(plan, backing_cells, sigma_per_side, np.ones(len(sigma_per_side)))]
    )


def _sigma_per_side(plan: SplatPlan, counts: np.ndarray, backing: np.ndarray) -> np.ndarray:
    """Return the standard deviation per cell side of each shape's first layer, along both axes,
    [P, 2].
    """
    kind = plan.shapes.kind
    is_hidden = plan.is_hidden
    sigma_per_side = np.where(backing[:, 0] > 0, BACKED_SIGMA_PER_SIDE, SIGMA_PER_SIDE)
    sigma_per_side = np.where(kind == Kind.TRIANGLE, MESH_SIGMA_PER_SIDE, sigma_per_side)
    sigma_per_side = np.where(kind == Kind.ELLIPSOID, BLOB_SIGMA_PER_SIDE, sigma_per_side)
    sigma_per_side = np.where(
        is_hidden & (kind == Kind.PARALLELOGRAM), NARROW_SIGMA_PER_SIDE, sigma_per_side
    )
    both_ends = np.array([U0 | U1, V0 | V1], np.uint8)
    is_single_row = (counts == 1) & ((plan.shapes.edges[:, None] & both_ends) == both_ends)
    return np.where(is_single_row, NARROW_SIGMA_PER_SIDE, sigma_per_side[:, None])


def _drop_buried_cells(plan: SplatPlan, cells: Cells) -> Cells:
    """Return the cells that do not lie wholly under another surface, through which they would
    shine.
    """
    is_covered = plan.shapes.material[cells.shape] != Material.LEAF
    places = cells.places()
    is_mesh = plan.shapes.kind[cells.shape] == Kind.TRIANGLE
    places[:, is_mesh] = cells.local[
        is_mesh
    ]  # its overlays, wheels and lamps, spill over their rims
    for local in places:
        index = np.flatnonzero(is_covered)
        shape = cells.shape[index]
        normals = plan.shapes.normals(shape, local[index])
        points = plan.shapes.points(shape, local[index]) + 0.003 * normals
        is_covered[index] = plan.body.tree.occluded(points, normals, MIN_CLEARANCE_M)
    return Cells(*(values[~is_covered] for values in cells))


def _gaussians(
    plan: SplatPlan, cells: Cells, sigma_per_side: np.ndarray, sink: np.ndarray
) -> Gaussians:
    """Return the Gaussians of cells.

    Args:
        plan: the plan of the body.
        cells: its cells.
        sigma_per_side: float [N, 2], standard deviations per cell side.
        sink: float [N], depth below the surface in longer cell sides.
    """
    shapes = plan.shapes
    shape = cells.shape
    places = cells.places()
    is_curved = shapes.kind[shape] >= Kind.DISC
    places[:, is_curved] = cells.local[is_curved]
    rgb = replace(plan.body, shapes=shapes).colors(shape, places)
    normals = shapes.normals(shape, cells.local)
    edges = np.einsum("nak,nkj->naj", cells.sides, shapes.axes[shape])  # metres
    frames, sigmas = _flat_covariance(edges * sigma_per_side[:, :, None], normals)
    sides = np.linalg.norm(edges, axis=2)
    depth = sink * np.where(is_curved, sides.min(1), sides.max(1))
    means = shapes.points(shape, cells.local) - depth[:, None] * normals
    thickness = np.clip(0.1 * sigmas.min(1), 0.002, 0.02)
    sigmas = np.concatenate([sigmas, thickness[:, None]], 1)
    leaf_rows = np.flatnonzero(shapes.material[shape] == Material.LEAF)
    size = np.linalg.norm(shapes.axes[shape[leaf_rows]], axis=2, keepdims=True)
    frames[leaf_rows] = (shapes.axes[shape[leaf_rows]] / size).transpose(0, 2, 1)
    sigmas[leaf_rows] = LEAF_SIGMA * size[..., 0]
    means[leaf_rows] = shapes.origin[shape[leaf_rows]]
    opacities = np.full(len(means), SPLAT_OPACITY)
    return _make_gaussians(means, frames, sigmas, opacities, rgb, shapes.semantic[shape])


def _flat_covariance(edges: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the principal axes of a a' + b b' as rotations [N, 3, 3], and sigmas [N, 2].

    Args:
        edges: float [N, 2, 3], the vectors a, b.
        normals: float [N, 3].
    """
    a = edges[:, 0]
    b = edges[:, 1]
    length = np.linalg.norm(a, axis=1)
    first = a / length[:, None]
    first = first - (first * normals).sum(1, keepdims=True) * normals
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    b_along = (b * first).sum(1)
    b_across = (b * second).sum(1)
    xx = length**2 + b_along**2
    xy = b_along * b_across
    yy = b_across**2
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    c = np.cos(angle)[:, None]
    s = np.sin(angle)[:, None]
    major = c * first + s * second
    minor = c * second - s * first
    mean = (xx + yy) / 2
    spread = np.hypot((xx - yy) / 2, xy)
    sigmas = np.sqrt(np.stack([mean + spread, np.maximum(mean - spread, 1e-8)], 1))
    return np.stack([major, minor, normals], 2), sigmas


def shadow_gaussians(shadow: ContactShadow) -> Gaussians:
    """Return a mover's shadow as thin translucent layers, none heavy enough to hide the ground's
    class.
    """
    size = np.array(shadow.values.shape) * SHADOW_CELL_M
    x, y = (np.arange(SHADOW_SPACING_M / 2, s, SHADOW_SPACING_M) for s in size)
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2) + shadow.origin
    points = np.concatenate([grid, np.full((len(grid), 1), shadow.ground_z)], 1)
    cover = shadow.cover(points)
    is_dark = cover > 0.02
    points = points[is_dark]
    cover = cover[is_dark]
    # Around any point the lattice's footprints add up to 2 pi (sigma / spacing)^2 of one splat.
    opacity = -np.log1p(-cover) / (2 * np.pi)
    sigma = np.tile([SHADOW_SPACING_M, SHADOW_SPACING_M, 0.004], (len(points), 1))
    frames = np.tile(np.eye(3), (len(points), 1, 1))
    rgb = np.tile(SHADOW_RGB, (len(points), 1))
    semantic = np.full(len(points), SemanticClass.ROAD, np.int16)
    points[:, 2] += SHADOW_HEIGHT_M
    return _make_gaussians(points, frames, sigma, opacity, rgb, semantic)


def _make_gaussians(means, frames, scales, opacities, rgb, semantic) -> Gaussians:
    """Return Gaussians of one colour each, from rotations [N, 3, 3] whose columns are the axes."""
    quats = quat_from_rotmat(torch.from_numpy(frames))
    return Gaussians(
        means=torch.from_numpy(means).float(),
        quats=quats.float(),
        scales=torch.from_numpy(scales).float(),
        opacities=torch.from_numpy(opacities).float(),
        sh=torch.from_numpy((rgb - 0.5) / SH_C0).float()[:, None],
        semantic=torch.from_numpy(semantic.astype(np.int16)),
    )
