"""How far apart the splats of each surface may stand, and how far below it they must lie.

A splat's footprint should look equally large wherever the ego cameras see it from, so its spacing
follows their nearest distance, and along a surface seen at a slant it is stretched.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapters.street.materials import Material
from adapters.street.raycast import Tree
from adapters.street.shapes import U0, U1, V0, V1, Kind, Shapes, join
from augment.semantics import SemanticClass

SPLIT_M = (1.6, 4.0)  # panels are never cut shorter than half the first; walls not left longer
STEEPEST = 0.42  # sine of the steepest ray of a level camera, up or down
MOST_STRETCH = 2.6
HIDDEN_STRETCH = 3.5  # of surfaces that no camera sees
# From which eyes sight is tried, by how near they are, and at how many places from each.
LOOKS, PLACES = (0, 1, 2, 3, 5, 8, 13, 21, 34), 3
LEAST_M = 0.02
# Blending takes nearer splats first, which puts the weighted mean this many spacings too near,
# along the surface: measured against the truth, for one layer of splats and for two (see `splats`).
BLEND_LEAD = 0.62
BACKED_BLEND_LEAD = 0.41


@dataclass(frozen=True, eq=False)
class Spacing:
    """Per shape: along [P, 2] spacing in metres per unit of coarseness on both axes; sink [P] how
    far below its surface splats lie, in spacings, so that their blend is seen on it; hidden [P]
    whether no camera sees it, so that its splats may be few but must keep clear of rims.
    """

    along: np.ndarray
    sink: np.ndarray
    hidden: np.ndarray


def split_long(shapes: Shapes, eyes: np.ndarray) -> Shapes:
    """The same surfaces, long parallelograms halved until one spacing suits all of each."""
    done = []
    while len(shapes):
        distance = _sightings(shapes, eyes)[0].min(0)
        sides = np.linalg.norm(shapes.axes[:, :2], axis=2)
        limit = np.maximum(SPLIT_M[0], 0.45 * distance)
        built = shapes.semantic != SemanticClass.TERRAIN
        limit[built] = np.minimum(limit, SPLIT_M[1])[built]
        wanted = (sides.max(1) > limit) & (shapes.kind == Kind.PARALLELOGRAM)
        done.append(shapes.select(np.flatnonzero(~wanted)))
        shapes = _halved(shapes.select(np.flatnonzero(wanted)), sides[wanted].argmax(1))
    return join(done)


def _halved(shapes: Shapes, axis: np.ndarray) -> Shapes:
    """Both halves of each parallelogram along its axis; only outer edges stay crisp."""
    rows = np.arange(len(shapes))
    first, second = shapes.select(rows), shapes.select(rows)
    for half in (first, second):
        half.axes[rows, axis] *= 0.5
    second.origin[:] += second.axes[rows, axis]
    low, high = np.array([U0, V0], np.uint8)[axis], np.array([U1, V1], np.uint8)[axis]
    first.edges[:] &= ~high
    second.edges[:] &= ~low
    return join([first, second])


def plan_spacing(shapes: Shapes, tree: Tree, eyes: np.ndarray) -> Spacing:
    """Spacings of shapes seen from eyes [E, 3], in the shapes' frame; tree: what may hide them."""
    distance, view = _sightings(shapes, eyes)
    unit = shapes.axes[:, :2] / np.linalg.norm(shapes.axes[:, :2], axis=2, keepdims=True)
    cosine = np.einsum("epk,pak->epa", view, unit)
    stretch = 1 / np.sqrt(np.maximum(1 - cosine**2, 1 / MOST_STRETCH**2))
    along = (distance[..., None] * stretch).min(0)
    flat = shapes.kind <= Kind.DISC
    slant = np.abs(np.einsum("epk,pk->ep", view, shapes.axes[:, 2]))
    facing = np.einsum("epk,pk->ep", view, shapes.axes[:, 2]) < 0
    tuft = shapes.material == Material.LEAF
    hidden = ((shapes.kind != Kind.ELLIPSOID) | tuft) & ~_in_sight(shapes, tree, eyes)
    along[hidden & flat] *= HIDDEN_STRETCH
    along *= shapes.spacing[:, None]
    sink = np.where(flat, _sink(distance, slant, facing, cosine, along, shapes.backed), 0.25)
    return Spacing(along, sink, hidden)


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


def _sink(
    distance: np.ndarray,
    slant: np.ndarray,
    facing: np.ndarray,
    cosine: np.ndarray,
    along: np.ndarray,
    backed: np.ndarray,
) -> np.ndarray:
    """Depth below the surface, per unit of spacing, that puts the blend on it in the mean.

    A splat that lies h below the surface is seen h / slant further along the ray; blending brings
    it some part of a spacing nearer along the surface. No depth suits all eyes: the weighted median
    makes the error least where most pixels are spent on the surface.
    """
    slant = np.clip(slant, 0.04, 1)
    level = np.sqrt(1 - slant**2)
    reach = np.sqrt((cosine**2 * along**2).sum(2)) / np.maximum(level, 1e-6)
    lead = np.where(backed, BACKED_BLEND_LEAD, BLEND_LEAD)
    wanted = lead * reach / along.max(1) * level * slant
    weight = facing / distance**2  # pixels go with slant, what an error costs with 1 / slant
    order = np.argsort(wanted, axis=0)
    heard = np.cumsum(np.take_along_axis(weight, order, 0), axis=0)
    middle = (heard < heard[-1] / 2).sum(0)
    rows = np.take_along_axis(order, np.minimum(middle, len(order) - 1)[None], 0)
    return np.minimum(np.take_along_axis(wanted, rows, 0)[0], 0.5)
