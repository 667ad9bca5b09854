"""Bodies as Gaussians: flat, opaque, overlapping, coloured as the surface below them."""

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
from augment.geometry import quat_from_rotmat
from augment.render.sh import SH_C0
from augment.scene import Gaussians
from augment.semantics import SemanticClass

# ---- How far apart the splats of each surface may stand, and how far below it they must lie ------
# A splat's footprint should look equally large wherever the ego cameras see it from, so its spacing
# follows their nearest distance, and along a surface seen at a slant it is stretched.

SPLIT_M = (1.6, 4.0)  # panels are never cut shorter than half the first; walls not left longer
STEEPEST = 0.42  # sine of the steepest ray of a level camera, up or down
MAX_STRETCH = 2.6
HIDDEN_STRETCH = 3.5  # of surfaces that no camera sees
# From which eyes sight is tried, by how near they are, and at how many places from each.
LOOKS, PLACES = (0, 1, 2, 3, 5, 8, 13, 21, 34), 3
MIN_M = 0.02
# Blending takes nearer splats first, which puts the weighted mean this many spacings too near,
# along the surface: measured against the truth, for one layer of splats and for two (see `splats`).
BLEND_LEAD = 0.62
BACKED_BLEND_LEAD = 0.41


@dataclass(frozen=True, eq=False)
class SplatPlan:
    """Surfaces of one body, split where they are long, ready to be sampled at any coarseness.

    spacing [P, 2]: of splats along both axes, metres per unit of coarseness. sink [P]: how far
    below its surface splats lie, in spacings, so that their blend is seen on it. hidden [P]: no
    camera sees it, so that its splats may be few but must keep clear of rims.
    """

    body: Body
    shapes: Shapes
    spacing: np.ndarray
    sink: np.ndarray
    hidden: np.ndarray

    @cached_property
    def lengths(self) -> np.ndarray:
        """Of the shapes' three axes, metres [P, 3]."""
        return np.linalg.norm(self.shapes.axes, axis=2)

    def counts(self, coarseness: float) -> np.ndarray:
        """How many cells the first layer has along both axes, [P, 2].

        Discs: rings and cells in the outermost. Tubes: around and along. Ellipsoids: in all, and 1.
        """
        along, (a, b, c) = np.maximum(self.spacing * coarseness, MIN_M), self.lengths.T
        finer, coarser = np.minimum(along[:, 0], along[:, 1]), np.maximum(along[:, 0], along[:, 1])
        counts = np.ceil(self.lengths[:, :2] / along - 1e-9)
        panel, disc, tube, blob = (
            self.shapes.kind == kind
            for kind in (Kind.PARALLELOGRAM, Kind.DISC, Kind.CYLINDER, Kind.ELLIPSOID)
        )
        tuft = self.shapes.material == Material.LEAF
        blob &= ~tuft
        counts[disc, 1] = np.ceil(2 * np.pi * a[disc] / finer[disc])
        counts[tube, 0] = np.maximum(MIN_ROUND, np.ceil(2 * np.pi * a[tube] / finer[tube]))
        counts[tube, 1] = np.maximum(2, np.ceil(2 * c[tube] / coarser[tube]))
        counts[blob, 0] = np.ceil(_area(self.lengths[blob]) / finer[blob] ** 2)
        counts[blob, 0] = np.maximum(MIN_BLOB, counts[blob, 0])
        counts[blob, 1], counts[tuft] = 1, 1
        counts = np.maximum(counts, 1)
        counts[self.hidden & panel & (np.maximum(a, b) < MIN_HIDDEN_M)] = 0
        counts[self.hidden & tuft & (self.shapes.variation < HIDDEN_TUFTS_DROPPED)] = 0
        counts[self.hidden & tube & (a < MIN_HIDDEN_M / 4)] = 0
        return counts.astype(np.int64)

    def backing(self, counts: np.ndarray) -> np.ndarray:
        """Cells of the second layer, [P, 2]; none where there is no such layer."""
        is_backed = self.shapes.backed & ~self.hidden & (counts >= BACKED_FROM).all(1)
        return np.where(is_backed[:, None], -(-counts // BACKING), 0)

    def total(self, coarseness: float) -> int:
        """How many cells that comes to, nearly (triangles and discs are estimated)."""
        counts, kind = self.counts(coarseness), self.shapes.kind
        graded, back = _graded(self.shapes, slice(None), counts, self.hidden), self.backing(counts)
        u, v = (counts + graded[..., 0] + graded[..., 1]).T
        each = u * (v + 2 * (kind == Kind.CYLINDER))
        share = np.where((kind == Kind.TRIANGLE) | (kind == Kind.DISC), 0.5, 1.0)
        return int((share * each).sum()) + int((back[:, 0] * back[:, 1]).sum())


def split_long(shapes: Shapes, eyes: np.ndarray) -> Shapes:
    """The same surfaces, long parallelograms halved until one spacing suits all of each."""
    done = []
    while len(shapes):
        distance = _sightings(shapes, eyes)[0].min(0)
        sides = np.linalg.norm(shapes.axes[:, :2], axis=2)
        limit = np.maximum(SPLIT_M[0], 0.45 * distance)
        built = shapes.semantic != SemanticClass.TERRAIN
        limit[built] = np.minimum(limit, SPLIT_M[1])[built]
        split = (sides.max(1) > limit) & (shapes.kind == Kind.PARALLELOGRAM)
        done.append(shapes[~split])
        shapes = _halved(shapes[split], sides[split].argmax(1))
    return join(done)


def _halved(shapes: Shapes, axis: np.ndarray) -> Shapes:
    """Both halves of each parallelogram along its axis; only outer edges stay crisp."""
    rows, first = np.arange(len(shapes)), shapes.copy()
    first.axes[rows, axis] *= 0.5
    second = first.copy()
    second.origin[:] += second.axes[rows, axis]
    first.edges[:] &= ~np.array([U1, V1], np.uint8)[axis]
    second.edges[:] &= ~np.array([U0, V0], np.uint8)[axis]
    return join([first, second])


def plan_splats(body: Body, eyes: np.ndarray) -> SplatPlan:
    """How a body seen from eyes [E, 3] (its frame) is to be sampled."""
    shapes = split_long(body.shapes, eyes)
    distance, view = _sightings(shapes, eyes)
    sides = shapes.axes[:, :2]
    sides = sides / np.linalg.norm(sides, axis=2, keepdims=True)
    cosine = np.einsum("epk,pak->epa", view, sides)
    stretch = 1 / np.sqrt(np.maximum(1 - cosine**2, 1 / MAX_STRETCH**2))
    along = (distance[..., None] * stretch).min(0)
    flat = shapes.kind <= Kind.DISC
    slant = np.einsum("epk,pk->ep", view, shapes.axes[:, 2])
    tuft = shapes.material == Material.LEAF
    hidden = ((shapes.kind != Kind.ELLIPSOID) | tuft) & ~_in_sight(shapes, body.tree, eyes)
    along[hidden & flat] *= HIDDEN_STRETCH
    along *= shapes.spacing[:, None]
    sink = np.where(flat, _sink(distance, slant, cosine, along, shapes.backed), 0.25)
    return SplatPlan(body, shapes, along, sink, hidden)


def _in_sight(shapes: Shapes, tree: Tree, eyes: np.ndarray) -> np.ndarray:
    """Which shapes some of the eyes can see, bool [P]: a few places are tried, each time others."""
    seen = np.zeros(len(shapes), bool)
    round_form = shapes.kind >= Kind.ELLIPSOID
    radius = np.where(round_form, np.linalg.norm(shapes.axes, axis=2)[:, :2].max(1) * 1.05, 0)
    distance = np.linalg.norm(shapes.origin[None] - eyes[:, None], axis=2)
    nearest = np.argsort(distance, axis=0, kind="stable")  # [E, P]: eyes by distance
    ranks = [rank for rank in LOOKS if rank < len(eyes)]
    for number in range(len(ranks) * PLACES):
        index = np.flatnonzero(~seen)
        target = _place(shapes, index, number)
        back = eyes[nearest[ranks[number // PLACES], index]] - target
        length = np.linalg.norm(back, axis=1)
        front = round_form[index] | ((back * shapes.axes[index, 2]).sum(1) > 0)
        front &= (np.abs(back[:, 2]) < 1.2 * STEEPEST * length) & (length > radius[index])
        index, back, target, length = index[front], back[front], target[front], length[front]
        start = (radius[index] / length)[:, None]
        seen[index] = ~tree.occluded(target + start * back, (1 - start) * back, 1.0)
    return seen


def _place(shapes: Shapes, index: np.ndarray, number: int) -> np.ndarray:
    """A place on each shape at index (on the axis of round forms), [I, 3]; numbers spread out."""
    kind, (u, v, w) = shapes.kind[index], shapes.axes[index].transpose(1, 0, 2)
    a, b = (0.06 + 0.88 * ((0.5 + number * step) % 1.0) for step in (0.7549, 0.5698))
    folded = (kind == Kind.TRIANGLE) & (a + b > 1)
    a, b = np.where(folded, 1 - a, a), np.where(folded, 1 - b, b)
    centred = kind >= Kind.DISC
    a, b = (np.where(centred, 1.4 * (c - 0.5), c)[:, None] for c in (a, b))
    on_axis = (kind >= Kind.ELLIPSOID)[:, None]
    return shapes.origin[index] + np.where(on_axis, b * w, a * u + b * v + 0.004 * w)


def _sightings(shapes: Shapes, eyes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [E, P] and unit direction [E, P, 3] from each eye to the nearest visible place."""
    nearest = shapes.origin[None] - eyes[:, None]  # [E, P, 3], from the eye
    straight = shapes.kind <= Kind.TRIANGLE
    for axis in range(2):
        side = shapes.axes[:, axis] * straight[:, None]
        square = np.maximum((side**2).sum(1), 1e-12)
        share = np.clip(-np.einsum("epk,pk->ep", nearest, side) / square, 0, 1)
        nearest = nearest + share[..., None] * side
    length = np.maximum(np.linalg.norm(nearest, axis=2), 0.3)
    view = nearest / length[..., None]
    return np.maximum(length, np.abs(nearest[..., 2]) / STEEPEST), view


def _sink(distance, slant, cosine, along, backed) -> np.ndarray:
    """Depth below the surface [P], per unit of spacing, that puts the blend on it in the mean.

    distance, slant [E, P] (negative: facing the eye) and cosine [E, P, 2]: of the eyes. along
    [P, 2], backed [P]. A splat that lies h below the surface is seen h / slant further along the
    ray; blending brings it some part of a spacing nearer along the surface. No depth suits all
    eyes: the weighted median makes the error least where most pixels are spent on the surface.
    """
    facing, slant = slant < 0, np.clip(np.abs(slant), 0.04, 1)
    level = np.sqrt(1 - slant**2)
    reach = np.sqrt((cosine**2 * along**2).sum(2)) / np.maximum(level, 1e-6)
    lead = np.where(backed, BACKED_BLEND_LEAD, BLEND_LEAD)
    depth = lead * reach / along.max(1) * level * slant
    weight = facing / distance**2  # pixels go with slant, what an error costs with 1 / slant
    order = np.argsort(depth, axis=0)
    weights = np.cumsum(np.take_along_axis(weight, order, 0), axis=0)
    middle = (weights < weights[-1] / 2).sum(0)
    rows = np.take_along_axis(order, np.minimum(middle, len(order) - 1)[None], 0)
    return np.minimum(np.take_along_axis(depth, rows, 0)[0], 0.5)


# ---- Cells of surfaces: where splats stand and how large each is ---------------------------------
# Flat panels carry a lattice whose last rows narrow towards crisp edges; discs carry rings, round
# forms a wrapped lattice or a spiral.

# Where rows along a crisp edge end, in cells, by how many rows are added there: 0, 1 or 2.
NARROWING = np.array([[0, 0, 0], [0, 0.3, 0], [0, 0.16, 0.46]])
MIN_ROUND = 8  # cells around a tube
MIN_BLOB = 30  # cells on an ellipsoid
# Hidden panels: cells by which splats keep clear of crisp edges, and the side below which a panel
# gets no splat at all; for tubes the girth.
INSET = 0.5
MIN_HIDDEN_M = 0.4
HIDDEN_TUFTS_DROPPED = 0.6
FINE_FROM = 7  # cells along a side from which its crisp edges get two more rows, not one


class Cells(NamedTuple):
    """shape [N]; local [N, 3]: the cell's middle; sides [N, 2, 3]: its sides in the shape's local
    coordinates."""

    shape: np.ndarray
    local: np.ndarray
    sides: np.ndarray

    def places(self) -> np.ndarray:
        """Four places in each cell, local coordinates [4, N, 3]."""
        a, b = self.sides[:, 0] / 4, self.sides[:, 1] / 4
        around = ((-1, -1), (1, 1), (-1, 1), (1, -1))
        return np.stack([self.local + i * a + j * b for i, j in around])


def make_cells(shapes: Shapes, counts: np.ndarray, hidden: np.ndarray) -> Cells:
    """All cells of all shapes; counts [P, 2] and hidden [P] as a plan has them."""
    parts = []
    for build, *kinds in (
        (_flat_cells, Kind.PARALLELOGRAM, Kind.TRIANGLE),
        (_disc_cells, Kind.DISC),
        (_tube_cells, Kind.CYLINDER),
        (_blob_cells, Kind.ELLIPSOID),
    ):
        index = np.flatnonzero(np.isin(shapes.kind, kinds) & (counts[:, 0] > 0))
        parts.append(build(shapes, index, counts[index], hidden))
    shape, local, sides = (np.concatenate(p) for p in zip(*parts, strict=True))
    # Splats of hidden panels keep away from their crisp edges.
    index = np.flatnonzero(hidden[shape] & (shapes.kind[shape] == Kind.PARALLELOGRAM))
    edges = shapes.edges[shape[index]]
    for axis, (low_bit, high_bit) in enumerate(((U0, U1), (V0, V1))):
        margin = np.minimum(INSET / counts[shape[index], axis], 0.25)
        low, high = margin * ((edges & low_bit) > 0), margin * ((edges & high_bit) > 0)
        local[index, axis] = low + local[index, axis] * (1 - low - high)
        sides[index, axis] *= (1 - low - high)[:, None]
    return Cells(shape, local, sides)


def _graded(shapes: Shapes, index, counts: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """Rows added at both ends of both axes, [I, 2 axes, 2 ends], for the shapes at index."""
    bits = np.array([[U0, U1], [V0, V1]], np.uint8)
    flagged = (shapes.edges[index][:, None, None] & bits) > 0
    rows = (counts >= 2).astype(np.int64) + (counts >= FINE_FROM)
    rows *= ((shapes.kind == Kind.PARALLELOGRAM) & ~hidden)[index][:, None]
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
    local = xyz(u, v, 0)[inside]
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
    c, s = np.cos(angle), np.sin(angle)
    depth = np.where(whole, 1.1, 1 / rings[owner])
    width = np.where(whole, 1.1, 2 * np.pi * radius / around[owner])
    sides = np.stack([xyz(c * depth, s * depth, 0), xyz(-s * width, c * width, 0)], 1)
    return index[ring_owner[owner]], xyz(radius * c, radius * s, 0), sides


def _tube_cells(shapes: Shapes, index: np.ndarray, counts: np.ndarray, hidden: np.ndarray):
    rows = counts[:, 1] + 2
    owner, number = _expand(counts[:, 0] * rows)
    i, j = number // rows[owner], number % rows[owner]
    angle = 2 * np.pi * (i + 0.5 * (j % 2)) / counts[owner, 0]
    c, s = np.cos(angle), np.sin(angle)
    width = 2 * np.pi / counts[owner, 0]
    one = np.ones_like(j)
    middle, height = _line(j, counts[owner, 1], one, one)
    sides = np.stack([xyz(-s * width, c * width, 0), xyz(0, 0, 2 * height)], 1)
    return index[owner], xyz(c, s, 2 * middle - 1), sides


def _blob_cells(shapes: Shapes, index: np.ndarray, counts: np.ndarray, hidden: np.ndarray):
    """A spiral of equal areas on the unit sphere."""
    owner, number = _expand(counts[:, 0])
    total = counts[owner, 0]
    z = 1 - (2 * number + 1) / total
    angle = number * 2.399963229728653
    flat = np.sqrt(1 - z * z)
    c, s = np.cos(angle), np.sin(angle)
    size = np.sqrt(4 * np.pi / total)[:, None]
    sides = np.stack([xyz(-s, c, 0) * size, xyz(-z * c, -z * s, flat) * size], 1)
    return index[owner], xyz(flat * c, flat * s, z), sides


def _area(length: np.ndarray) -> np.ndarray:
    """Surface of ellipsoids with semi-axes [P, 3] (Thomsen's approximation, within 1.1 %)."""
    a, b, c = (length**1.6075).T
    return 4 * np.pi * ((a * b + a * c + b * c) / 3) ** (1 / 1.6075)


# ---- The shadow a mover casts on the ground, which travels with it as a soft dark layer ----------

CELL_M = 0.06
MARGIN_M = 2.0
MAX_COVER = 0.5  # never more: what lies below must stay the heaviest thing in its pixels
GROUND_BAND_M = 0.25  # surfaces this near the ground's plane receive the shadow
SHADOW_RGB = np.array([0.03, 0.032, 0.04])


@dataclass(frozen=True, eq=False)
class ContactShadow:
    """Share of SHADOW_RGB mixed into the ground, on a grid in the mover's frame.

    values [X, Y]: cover in [0, MAX_COVER], zero at the rim. origin: x, y of values[0, 0], metres.
    """

    values: np.ndarray
    origin: np.ndarray
    ground_z: float

    def cover(self, points: np.ndarray) -> np.ndarray:
        """Bilinear cover at points [N, 3] of the mover's frame; zero away from the ground."""
        cell = (points[:, :2] - self.origin) / CELL_M
        low = np.floor(cell).astype(np.int64)
        inside = np.all((low >= 0) & (low < np.array(self.values.shape) - 1), axis=1)
        inside &= np.abs(points[:, 2] - self.ground_z) < GROUND_BAND_M
        out = np.zeros(len(points))
        i, j = low[inside].T
        fx, fy = (cell[inside] - low[inside]).T
        v = self.values
        out[inside] = (v[i, j] * (1 - fx) + v[i + 1, j] * fx) * (1 - fy) + (
            v[i, j + 1] * (1 - fx) + v[i + 1, j + 1] * fx
        ) * fy
        return out


def contact_shadow(mover: MovingBody) -> ContactShadow:
    """Sun shadow by ray casting, and sky shadow by the distance to the body's outline."""
    lighting = mover.body.lighting
    half = np.array(mover.size_m[:2]) / 2
    length = mover.size_m[2] / np.tan(np.arcsin(lighting.to_sun[2]))
    reach = half + np.minimum(length, MARGIN_M) + 0.4
    counts = np.ceil(2 * reach / CELL_M).astype(int) + 1
    origin = -(counts - 1) * CELL_M / 2
    x, y = (origin[k] + CELL_M * np.arange(counts[k]) for k in range(2))
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    points = np.concatenate([grid, np.full((len(grid), 1), lighting.ground_z)], 1)
    shaded = [mover.body.tree.occluded(points, d) for d in lighting.sun_directions()]
    full_sun = lighting.sunlit * lighting.to_sun[2] * SUN_RGB.mean()
    sun = (1 - np.sum(shaded, axis=0) / len(shaded)) * full_sun
    rounding = 0.8 * half.min()
    outside = np.linalg.norm(np.maximum(np.abs(grid) - half + rounding, 0), axis=1) - rounding
    hidden = 0.8 / (1 + np.exp((outside - 0.02) / (0.11 * half.min() / 0.9)))
    sky = (1 - hidden) * SKY_RGB.mean() * 0.75
    lit = full_sun + SKY_RGB.mean() * 0.75
    cover = 1 - ((sun + sky) / lit) ** 0.45  # the display's encoding of that ratio, nearly
    rim = np.min(np.minimum(grid - origin, -origin - grid), axis=1)  # fade out before the grid ends
    cover = np.minimum(cover, MAX_COVER) * np.clip(rim / 0.3, 0, 1)
    return ContactShadow(cover.reshape(counts), origin, lighting.ground_z)


# ---- Gaussians of cells --------------------------------------------------------------------------

OPACITY = 0.99
# Standard deviation per cell side: the least that leaves no gap (alpha > 0.99 in the mean), since
# wider splats blur and lead more (see `spacing`). Over a second layer they may be narrower.
SIGMA_PER_SIDE = 0.74
BACKED_SIGMA_PER_SIDE = 0.64
# The second layer, which fills what is left between the splats of the first: how many times as
# coarse, and from how many cells a side. As deep as it is coarse it stays behind at every slant.
BACKING = 3
BACKED_FROM = 4
BLOB_SIGMA_PER_SIDE = 0.66  # of round forms, whose cells overlap more as they curve
MESH_SIGMA_PER_SIDE = 0.71  # of the closed meshes of cars: what leaks is the car again
NARROW_SIGMA_PER_SIDE = 0.5  # half opaque at the edge: single rows, and panels nobody sees
LEAF_SIGMA = 0.64  # of the semi-axes of a tuft, which is one splat
BURIED_M = 0.08
SHADOW_SPACING_M = 0.10
SHADOW_HEIGHT_M = 0.035


def coarseness_for(plans: list[SplatPlan], target: int) -> float:
    """Spacing per metre of distance at which all plans together come to the target."""
    low, high = 1e-3, 0.2
    for _ in range(12):
        middle = float(np.sqrt(low * high))
        too_many = sum(plan.total(middle) for plan in plans) > target
        low, high = (middle, high) if too_many else (low, middle)
    return high


def splat(plan: SplatPlan, coarseness: float) -> Gaussians:
    """The Gaussians of a body."""
    counts = plan.counts(coarseness)
    backing = plan.backing(counts)
    cells = _uncovered(plan, make_cells(plan.shapes, counts, plan.hidden))
    share = _sigma_per_side(plan, counts, backing)[cells.shape]
    first = _gaussians(plan, cells, share, plan.sink[cells.shape])
    # Under the ground the second layer may run on past an edge; behind a wall's it would be seen.
    upright = plan.shapes.semantic == SemanticClass.BUILDING
    below = make_cells(plan.shapes, backing, upright & (backing[:, 0] > 0))
    share = np.full((len(below.shape), 2), SIGMA_PER_SIDE)
    return join_gaussians([first, _gaussians(plan, below, share, np.ones(len(share)))])


def _sigma_per_side(plan: SplatPlan, counts: np.ndarray, backing: np.ndarray) -> np.ndarray:
    """Standard deviation per cell side of each shape's first layer, along both axes, [P, 2]."""
    kind, hidden = plan.shapes.kind, plan.hidden
    share = np.where(backing[:, 0] > 0, BACKED_SIGMA_PER_SIDE, SIGMA_PER_SIDE)
    share = np.where(kind == Kind.TRIANGLE, MESH_SIGMA_PER_SIDE, share)
    share = np.where(kind == Kind.ELLIPSOID, BLOB_SIGMA_PER_SIDE, share)
    share = np.where(hidden & (kind == Kind.PARALLELOGRAM), NARROW_SIGMA_PER_SIDE, share)
    ends = np.array([U0 | U1, V0 | V1], np.uint8)
    single = (counts == 1) & ((plan.shapes.edges[:, None] & ends) == ends)
    return np.where(single, NARROW_SIGMA_PER_SIDE, share[:, None])


def _uncovered(plan: SplatPlan, cells: Cells) -> Cells:
    """Cells that do not lie wholly under another surface, which they would shine through."""
    covered = plan.shapes.material[cells.shape] != Material.LEAF
    places = cells.places()
    mesh = plan.shapes.kind[cells.shape] == Kind.TRIANGLE
    places[:, mesh] = cells.local[mesh]  # its overlays, wheels and lamps, spill over their rims
    for local in places:
        index = np.flatnonzero(covered)
        shape = cells.shape[index]
        normals = plan.shapes.normals(shape, local[index])
        points = plan.shapes.points(shape, local[index]) + 0.003 * normals
        covered[index] = plan.body.tree.occluded(points, normals, BURIED_M)
    return Cells(*(values[~covered] for values in cells))


def _gaussians(plan: SplatPlan, cells: Cells, share: np.ndarray, sink: np.ndarray) -> Gaussians:
    """Splats of cells; share [N, 2]: sigma per cell side; sink [N]: depth in longer cell sides."""
    shapes, shape = plan.shapes, cells.shape
    places = cells.places()
    curved = shapes.kind[shape] >= Kind.DISC
    places[:, curved] = cells.local[curved]
    rgb = replace(plan.body, shapes=shapes).colors(shape, places)
    normals = shapes.normals(shape, cells.local)
    edges = np.einsum("nak,nkj->naj", cells.sides, shapes.axes[shape])  # metres
    frames, sigmas = _flat_covariance(edges * share[:, :, None], normals)
    sides = np.linalg.norm(edges, axis=2)
    depth = sink * np.where(curved, sides.min(1), sides.max(1))
    means = shapes.points(shape, cells.local) - depth[:, None] * normals
    thin = np.clip(0.1 * sigmas.min(1), 0.002, 0.02)
    sigmas = np.concatenate([sigmas, thin[:, None]], 1)
    leaf = np.flatnonzero(shapes.material[shape] == Material.LEAF)
    size = np.linalg.norm(shapes.axes[shape[leaf]], axis=2, keepdims=True)
    frames[leaf] = (shapes.axes[shape[leaf]] / size).transpose(0, 2, 1)
    sigmas[leaf], means[leaf] = LEAF_SIGMA * size[..., 0], shapes.origin[shape[leaf]]
    opacities = np.full(len(means), OPACITY)
    return _make_gaussians(means, frames, sigmas, opacities, rgb, shapes.semantic[shape])


def _flat_covariance(edges: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Principal axes of a a' + b b', edges a, b [N, 2, 3]: rotations [N, 3, 3], sigmas [N, 2]."""
    a, b = edges[:, 0], edges[:, 1]
    length = np.linalg.norm(a, axis=1)
    first = a / length[:, None]
    first = first - (first * normals).sum(1, keepdims=True) * normals
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    along, across = (b * first).sum(1), (b * second).sum(1)
    xx, xy, yy = length**2 + along**2, along * across, across**2
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    major, minor = c * first + s * second, c * second - s * first
    middle, spread = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    sigmas = np.sqrt(np.stack([middle + spread, np.maximum(middle - spread, 1e-8)], 1))
    return np.stack([major, minor, normals], 2), sigmas


def shadow_gaussians(shadow: ContactShadow) -> Gaussians:
    """A mover's shadow as thin translucent layers, none heavy enough to hide the ground's class."""
    size = np.array(shadow.values.shape) * CELL_M
    x, y = (np.arange(SHADOW_SPACING_M / 2, s, SHADOW_SPACING_M) for s in size)
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2) + shadow.origin
    points = np.concatenate([grid, np.full((len(grid), 1), shadow.ground_z)], 1)
    cover = shadow.cover(points)
    kept = cover > 0.02
    points, cover = points[kept], cover[kept]
    # Around any point the lattice's footprints add up to 2 pi (sigma / spacing)^2 of one splat.
    opacity = -np.log1p(-cover) / (2 * np.pi)
    sigma = np.tile([SHADOW_SPACING_M, SHADOW_SPACING_M, 0.004], (len(points), 1))
    frames = np.tile(np.eye(3), (len(points), 1, 1))
    rgb = np.tile(SHADOW_RGB, (len(points), 1))
    semantic = np.full(len(points), SemanticClass.ROAD, np.int16)
    points[:, 2] += SHADOW_HEIGHT_M
    return _make_gaussians(points, frames, sigma, opacity, rgb, semantic)


def _make_gaussians(means, frames, scales, opacities, rgb, semantic) -> Gaussians:
    """Gaussians of one colour each, from rotations [N, 3, 3] whose columns are the axes."""
    quats = quat_from_rotmat(torch.from_numpy(frames))
    return Gaussians(
        means=torch.from_numpy(means).float(),
        quats=quats.float(),
        scales=torch.from_numpy(scales).float(),
        opacities=torch.from_numpy(opacities).float(),
        sh=torch.from_numpy((rgb - 0.5) / SH_C0).float()[:, None],
        semantic=torch.from_numpy(semantic.astype(np.int16)),
    )
