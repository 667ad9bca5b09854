"""Carriageway and markings, kerbs, pavements, the cross streets at both ends, the land around."""

from __future__ import annotations

import itertools

import numpy as np

from adapters.street.forms import parallelograms
from adapters.street.layout import (
    CAMBER,
    CROSS_STREET_M,
    FACADE_M,
    KERB_RISE_M,
    KERB_TOP_M,
    LANE_M,
    PAVEMENT_SLOPE,
    ROAD_HALF_M,
    TERRAIN_REACH_M,
    TERRAIN_Z_M,
    Layout,
    road_z,
    stream,
)
from adapters.street.materials import Material
from adapters.street.rectangles import Rectangle, cut
from adapters.street.shapes import ALL_EDGES, V0, V1, Look, Shapes, join
from augment.semantics import SemanticClass as Class

ASPHALT = Look((0.105, 0.105, 0.11), Class.ROAD, Material.ASPHALT, spacing=1.3, backed=True)
REPAIR = Look((0.075, 0.075, 0.08), Class.ROAD, Material.ASPHALT, spacing=1.3, backed=True)
IRON = Look((0.06, 0.058, 0.055), Class.ROAD)
MARKING = Look((0.72, 0.72, 0.70), Class.LANE_MARKING, Material.MARKING)
PAVING = Look((0.34, 0.325, 0.30), Class.SIDEWALK, Material.PAVING, spacing=1.2, backed=True)
KERB = Look((0.44, 0.43, 0.41), Class.SIDEWALK)
GRASS = Look((0.13, 0.19, 0.05), Class.TERRAIN, Material.GRASS, spacing=2.5)

SECTION_M = 6.0
ZEBRA_CLEAR_M = 3.6  # of a zebra crossing's middle, where no other mark may lie


def build_ground(layout: Layout) -> Shapes:
    """Everything that lies on the ground."""
    return join(
        [*_carriageway(layout), *_pavements(layout), *_cross_streets(layout), _land(layout)]
    )


def _sloped(
    rectangles: np.ndarray, edges: np.ndarray, slope: float, z0: float, look: Look
) -> Shapes:
    """Panels over rectangles [R, 4] on the plane z = z0 + slope y, facing up."""
    x0, y0, x1, y1 = rectangles.T
    zero = np.zeros_like(x0)
    return parallelograms(
        np.stack([x0, y0, z0 + slope * y0], 1),
        np.stack([x1 - x0, zero, zero], 1),
        np.stack([zero, y1 - y0, slope * (y1 - y0)], 1),
        look,
        edges=edges,
    )


def _markings(layout: Layout) -> list[Rectangle]:
    """Painted rectangles of both halves of the road; none crosses the crown y = 0."""
    marks: list[Rectangle] = []
    zebra, x0, x1 = layout.zebra_x, layout.x0, layout.x1
    for x in np.arange(x0 + 2, x1 - 8, 6.0):
        if abs(x + 1.5 - zebra) > 6.5:
            marks += [(x, 0.0, x + 3.0, 0.07), (x, -0.07, x + 3.0, 0.0)]
    for side in (1, -1):
        low, high = sorted((side * (LANE_M - 0.06), side * (LANE_M + 0.06)))
        for x in np.arange(x0 + 2, x1 - 8, 6.1):  # parking bays: a corner line and its end
            if abs(x + 3.0 - zebra) > 8.0:
                marks.append((x, low, x + 4.9, high))
        for y in np.arange(0.25, LANE_M + 1.6, 1.0):
            near, far = sorted((side * y, side * (y + 0.5)))
            marks.append((zebra - 1.5, near, zebra + 1.5, far))
        stop = zebra + side * 3.0  # each lane stops before it
        near, far = sorted((side * 0.12, side * (LANE_M - 0.12)))
        marks.append((stop - 0.15, near, stop + 0.15, far))
    return marks


def _patches(layout: Layout, taken: list[Rectangle]) -> tuple[list[Rectangle], list[Rectangle]]:
    """Repaired asphalt and iron covers, clear of the markings and of each other."""
    rng = stream(layout.parameters, 10)
    found: list[list[Rectangle]] = [[], []]
    for x in np.arange(layout.x0 + 4, layout.x1 - 6, 7.0):
        kind = int(rng.random() < 0.45)
        side = rng.choice([-1, 1])
        half = (rng.uniform(0.8, 2.6), rng.uniform(0.3, 0.6)) if kind == 0 else (0.3, 0.3)
        middle = (x + rng.uniform(0, 4), side * rng.uniform(0.9, 2.4))
        spot = (middle[0] - half[0], middle[1] - half[1], middle[0] + half[0], middle[1] + half[1])
        if all(_apart(spot, other) for other in [*taken, *found[0], *found[1]]):
            found[kind].append(spot)
    return found[0], found[1]


def _apart(a: Rectangle, b: Rectangle) -> bool:
    gap = 0.1
    return a[2] + gap < b[0] or b[2] + gap < a[0] or a[3] + gap < b[1] or b[3] + gap < a[1]


def _carriageway(layout: Layout) -> list[Shapes]:
    """Both halves of the road, in sections along x: a mark cuts only the asphalt beside it."""
    marks = _markings(layout)
    repairs, covers = _patches(layout, marks)
    crossing = (layout.zebra_x - ZEBRA_CLEAR_M, layout.zebra_x + ZEBRA_CLEAR_M)
    bounds = np.arange(layout.x0, layout.x1 - SECTION_M / 2, SECTION_M)
    bounds = bounds[(bounds < crossing[0] - 1) | (bounds > crossing[1] + 1)]
    bounds = np.sort([*bounds, *crossing, layout.x1])
    parts = []
    for side in (1, -1):
        low, high = sorted((0.0, side * ROAD_HALF_M))
        slope = -side * CAMBER
        holes = []
        for rectangles, look in ((marks, MARKING), (repairs, REPAIR), (covers, IRON)):
            here = [r for r in rectangles if low <= r[1] and r[3] <= high]
            holes += here
            if here:
                edges = np.full(len(here), ALL_EDGES, np.uint8)
                parts.append(_sloped(np.array(here), edges, slope, 0.0, look))
        kerb = V1 if side > 0 else V0
        for start, stop in itertools.pairwise(bounds):
            near = [h for h in holes if h[0] < stop and h[2] > start]
            pieces, edges = cut((start, low, stop, high), near, rim=kerb)
            parts.append(_sloped(pieces, edges, slope, 0.0, ASPHALT))
    return parts


def _pavements(layout: Layout) -> list[Shapes]:
    parts = []
    x0, length = layout.x0, layout.x1 - layout.x0
    kerb_low, kerb_high = float(road_z(ROAD_HALF_M)), float(road_z(ROAD_HALF_M)) + KERB_RISE_M
    inner, outer = ROAD_HALF_M + KERB_TOP_M, FACADE_M + 0.6
    for side in (1, -1):
        face = [x0, side * ROAD_HALF_M, kerb_low]
        u, up = np.array([length, 0, 0]), np.array([0, 0, KERB_RISE_M])
        # Turned so that u x v points to the road.
        parts.append(parallelograms(face, *((u, up) if side > 0 else (up, u)), KERB))
        for near, far, look in ((ROAD_HALF_M, inner, KERB), (inner, outer, PAVING)):
            low, high = sorted((side * near, side * far))
            z0 = kerb_high - PAVEMENT_SLOPE * ROAD_HALF_M
            rectangle = np.array([[x0, low, layout.x1, high]])
            edges = np.array([ALL_EDGES], np.uint8)
            parts.append(_sloped(rectangle, edges, side * PAVEMENT_SLOPE, z0, look))
    return parts


def _cross_streets(layout: Layout) -> list[Shapes]:
    """The streets that ours runs into, with the pavement beyond."""
    parts = []
    z = float(road_z(ROAD_HALF_M))
    for x, direction in ((layout.x0, -1), (layout.x1, 1)):
        near, far = sorted((x, x + direction * CROSS_STREET_M))
        strip = np.array([[near, -70.0, far, 70.0]])
        parts.append(_sloped(strip, np.array([ALL_EDGES], np.uint8), 0.0, z, ASPHALT))
        kerb = x + direction * CROSS_STREET_M
        u, up = np.array([0, 140.0, 0]), np.array([0, 0, KERB_RISE_M])
        sides = (up, u) if direction > 0 else (u, up)
        parts.append(parallelograms([kerb, -70.0, z], *sides, KERB))
        near, far = sorted((kerb, kerb + direction * 4.6))
        strip = np.array([[near, -70.0, far, 70.0]])
        edges = np.array([ALL_EDGES], np.uint8)
        parts.append(_sloped(strip, edges, 0.0, z + KERB_RISE_M, PAVING))
        for side in (1, -1):  # the near pavement's edge, left and right of our street
            u = np.array([0, 60.0, 0]) * side
            start = [x, side * ROAD_HALF_M, z]
            sides = (u, up) if (side > 0) == (direction < 0) else (up, u)
            parts.append(parallelograms(start, *sides, KERB))
    return parts


def _land(layout: Layout) -> Shapes:
    reach = TERRAIN_REACH_M
    west, east = layout.x0 - CROSS_STREET_M, layout.x1 + CROSS_STREET_M
    edge = FACADE_M + 0.6
    holes: list[Rectangle] = [
        (layout.x0, -edge, layout.x1, edge),
        (west - 4.6, -70.0, layout.x0, 70.0),
        (layout.x1, -70.0, east + 4.6, 70.0),
    ]
    outer = (west - reach, -reach, east + reach, reach)
    pieces, edges = cut(outer, holes)
    # Only the rims that border something else need to be crisp.
    edges &= np.uint8(V0 | V1)
    return _sloped(pieces, edges, 0.0, TERRAIN_Z_M, GRASS)
