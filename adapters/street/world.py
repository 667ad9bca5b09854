"""The assembled street: one static body and the bodies that move, each with its light."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from adapters.street.buildings import build_buildings
from adapters.street.forms import (
    ALL_EDGES,
    V0,
    V1,
    Look,
    Material,
    Rectangle,
    Shapes,
    albedo,
    cut,
    join,
    parallelograms,
)
from adapters.street.layout import (
    CAMBER,
    CROSS_STREET_M,
    FACADE_M,
    KERB_RISE_M,
    KERB_TOP_M,
    LANE_M,
    PARKED_Y_M,
    PAVEMENT_SLOPE,
    ROAD_HALF_M,
    TERRAIN_REACH_M,
    TERRAIN_Z_M,
    Layout,
    Motion,
    Mover,
    StreetParameters,
    camera_path,
    draw_layout,
    frame_time_ns,
    motion_of,
    pavement_z,
    road_z,
    stream,
)
from adapters.street.light import Lighting, shade, sun_share
from adapters.street.objects import SIZE_M, build_furniture, build_vegetation, draw_car, draw_person
from adapters.street.raycast import Tree, build_tree
from augment.semantics import SemanticClass as Class

# ---- The ground: carriageway and markings, kerbs, pavements, cross streets, the land around ------

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
    rectangles: np.ndarray, slope: float, z0: float, look: Look, edges: np.ndarray | int = ALL_EDGES
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
        if all(_are_disjoint(spot, other) for other in [*taken, *found[0], *found[1]]):
            found[kind].append(spot)
    return found[0], found[1]


def _are_disjoint(a: Rectangle, b: Rectangle) -> bool:
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
                parts.append(_sloped(np.array(here), slope, 0.0, look))
        kerb = V1 if side > 0 else V0
        for start, stop in itertools.pairwise(bounds):
            near = [h for h in holes if h[0] < stop and h[2] > start]
            pieces, edges = cut((start, low, stop, high), near, rim=kerb)
            parts.append(_sloped(pieces, slope, 0.0, ASPHALT, edges))
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
            parts.append(_sloped(rectangle, side * PAVEMENT_SLOPE, z0, look))
    return parts


def _cross_streets(layout: Layout) -> list[Shapes]:
    """The streets that ours runs into, with the pavement beyond."""
    parts = []
    z = float(road_z(ROAD_HALF_M))
    for x, direction in ((layout.x0, -1), (layout.x1, 1)):
        near, far = sorted((x, x + direction * CROSS_STREET_M))
        strip = np.array([[near, -70.0, far, 70.0]])
        parts.append(_sloped(strip, 0.0, z, ASPHALT))
        kerb = x + direction * CROSS_STREET_M
        u, up = np.array([0, 140.0, 0]), np.array([0, 0, KERB_RISE_M])
        sides = (up, u) if direction > 0 else (u, up)
        parts.append(parallelograms([kerb, -70.0, z], *sides, KERB))
        near, far = sorted((kerb, kerb + direction * 4.6))
        strip = np.array([[near, -70.0, far, 70.0]])
        parts.append(_sloped(strip, 0.0, z + KERB_RISE_M, PAVING))
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
    return _sloped(pieces, 0.0, TERRAIN_Z_M, GRASS, edges)


# ---- The whole -----------------------------------------------------------------------------------

ROOF_Z_M = 11.5  # of a typical house, for sky light between the fronts
SINK_M = 0.008  # tyres sit this far in the road, as on their contact patch


@dataclass(frozen=True, eq=False)
class Body:
    """Shapes that move together, how rays meet them, and their light, in one frame."""

    shapes: Shapes
    tree: Tree
    lighting: Lighting

    def colors(self, shape: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Display-encoded colour [N, 3] on shapes [N], averaged over places [G, N, 3].

        Albedo and the sun's shadows are averaged; other light is taken at the first place.
        """
        shapes = self.shapes
        looks = shapes.material[shape], shapes.rgb[shape], shapes.variation[shape]
        base = np.zeros((len(shape), 3))
        for local in places:
            base += albedo(*looks, local, shapes.points(shape, local))
        sun = sun_share(shapes, self.tree, self.lighting, shape, places)
        return shade(shapes, self.lighting, shape, places[0], base / len(places), sun)


@dataclass(frozen=True, eq=False)
class MovingBody:
    """A mover's body in its box frame, with its motion. ground_z: of the road, in that frame."""

    name: str
    label: str
    size_m: tuple[float, float, float]
    body: Body
    motion: Motion
    ground_z: float


@dataclass(frozen=True, eq=False)
class ParkedCar:
    """A labelled box of the static scene."""

    name: str
    centre: tuple[float, float, float]
    size_m: tuple[float, float, float]
    yaw: float


@dataclass(frozen=True, eq=False)
class Street:
    """Everything that is known of a street."""

    parameters: StreetParameters
    layout: Layout
    to_sun: np.ndarray
    static: Body
    movers: tuple[MovingBody, ...]
    parked: tuple[ParkedCar, ...]
    eye_path: np.ndarray


@lru_cache(maxsize=2)
def build_street(parameters: StreetParameters) -> Street:
    """The street of these parameters; the last two are kept."""
    layout = draw_layout(parameters)
    to_sun = _sun(parameters)
    ends = np.array([frame_time_ns(0), frame_time_ns(parameters.frames - 1)])
    eye_path = camera_path(parameters, ends)
    parked, cars = _park(layout)
    ground, houses = build_ground(layout), build_buildings(layout)
    shapes = join([ground, houses, build_vegetation(layout), build_furniture(layout), *cars])
    footprints = [(c.centre[0], c.centre[1], c.size_m[0] / 2, c.size_m[1] / 2) for c in parked]
    lighting = Lighting(
        to_sun=to_sun,
        eye_path=eye_path,
        canyon=(-FACADE_M, FACADE_M, ROOF_Z_M),
        footprints=np.array(footprints).reshape(-1, 4),
    )
    static = Body(shapes, build_tree(shapes), lighting)
    movers = tuple(_moving_body(mover, layout, static, ends) for mover in layout.movers)
    return Street(parameters, layout, to_sun, static, movers, parked, eye_path)


def _sun(parameters: StreetParameters) -> np.ndarray:
    """Unit vector to the sun: behind one shoulder of the driver, high enough to reach the road."""
    rng = stream(parameters, 6)
    azimuth = np.radians(rng.uniform(118, 150)) * rng.choice([-1, 1])
    height = np.radians(rng.uniform(43, 54))
    flat = np.cos(height)
    return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(height)])


def _park(layout: Layout) -> tuple[tuple[ParkedCar, ...], list[Shapes]]:
    """Parked cars and their shapes; each faces its side's traffic."""
    rng = stream(layout.parameters, 7)
    parked, shapes = [], []
    for number, (x, y) in enumerate(layout.parked):
        model, car = draw_car(int(rng.integers(2**31)))
        yaw = 0.0 if y < 0 else np.pi
        ground = float(road_z(PARKED_Y_M)) - SINK_M
        shapes.append(car.moved((x, y, ground), yaw))
        centre = (float(x), float(y), ground + model.size_m[2] / 2)
        parked.append(ParkedCar(f"parked-{number}", centre, model.size_m, yaw))
    return tuple(parked), shapes


def _moving_body(mover: Mover, layout: Layout, static: Body, ends: np.ndarray) -> MovingBody:
    if mover.kind == "car":
        model, shapes = draw_car(mover.seed)
        size, ground, label = model.size_m, float(road_z(mover.y_m)) - SINK_M, "Car"
    else:
        shapes, size = draw_person(mover.seed), SIZE_M
        ground, label = float(pavement_z(mover.y_m)), "Pedestrian"
    shapes = shapes.moved((0, 0, -size[2] / 2))
    motion = motion_of(mover, layout, size[2], ground)
    turn = 1.0 if motion.yaw == 0 else -1.0  # the heading is along +x or -x
    flip = np.array([turn, turn, 1.0])
    eyes = camera_path(layout.parameters, ends)
    centre = motion.centres[0]
    walls = sorted(turn * (side * FACADE_M - centre[1]) for side in (-1, 1))
    directions = static.lighting.sun_directions()
    origins = np.repeat(motion.centres, len(directions), axis=0)
    shaded = static.tree.occluded(origins, np.tile(directions, (len(motion.centres), 1)))
    lighting = Lighting(
        to_sun=static.lighting.to_sun * flip,
        eye_path=(eyes - motion.at(ends)[0]) * flip,
        canyon=(walls[0], walls[1], ROOF_Z_M - centre[2]),
        ground_z=-size[2] / 2,
        sunlit=1 - float(shaded.mean()),
    )
    body = Body(shapes, build_tree(shapes), lighting)
    return MovingBody(mover.name, label, size, body, motion, -size[2] / 2)
