"""The assembled street: houses, ground and what stands on it as one static body, and the bodies
that move, each with its light."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from adapters.street.forms import (
    ALL_EDGES,
    U0,
    U1,
    V0,
    V1,
    Look,
    Material,
    Rectangle,
    Shapes,
    Vectors,
    ball,
    boxes,
    cross,
    cut,
    disc,
    ellipsoids,
    join,
    joined,
    parallelograms,
    quads,
    triangles,
    tube,
    unit,
    xyz,
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
from adapters.street.light import Body, Lighting, direction_to_sun
from adapters.street.raycast import build_tree
from augment.semantics import SemanticClass as Class

# ---- House fronts: windows, doors and shops ------------------------------------------------------
# A front has its own frame: x along the wall, y into the house, z up; its outer face is the plane
# y = 0, seen from y < 0. `holes` collects what stands in the wall, as (x, z) rectangles.

REVEAL_M = 0.14  # how deep windows stand in the wall
SURROUND_M = 0.13
GLASS = Look((0.022, 0.026, 0.03), Class.BUILDING, Material.GLASS, backed=True)
SHOP_GLASS = GLASS._replace(material=Material.SHOP)
_FRONT, _LEDGE = ("-y", "+x", "-x", "+z", "-z"), ("-y", "+z", "-z", "+x", "-x")


class Facade(NamedTuple):
    wall: Look
    base: Look
    trim: Look
    frame: Look
    accent: Look
    window_m: tuple[float, float]
    floor_m: float
    ground_m: float
    has_surround: bool
    has_shop: bool


def panels(
    rectangles, depth_m: float, look: Look, edges: np.ndarray | int = ALL_EDGES
) -> Shapes:  # fmt: skip
    """Upright panels over (x, z) rectangles [R, 4] at y = depth_m, seen from the street."""
    x0, z0, x1, z1 = np.asarray(rectangles, np.float64).reshape(-1, 4).T
    u, v = xyz(x1 - x0, 0, 0), xyz(0, 0, z1 - z0)
    return parallelograms(xyz(x0, depth_m, z0), u, v, look, edges=edges)


def reveals(opening: Rectangle, depth_m: float, look: Look) -> Shapes:
    """The four inner faces of an opening, from the wall's face to depth_m."""
    x0, z0, x1, z1 = opening
    into, up, along = (0, depth_m, 0), (0, 0, z1 - z0), (x1 - x0, 0, 0)
    corners = [(x0, 0, z0), (x1, 0, z0), (x0, 0, z0), (x0, 0, z1)]
    us, vs = [into, up, along, into], [up, into, into, along]
    return parallelograms(corners, us, vs, look._replace(ambient=0.75, backed=False))


@joined
def glazing(
    opening: Rectangle, columns: int, rows: int, depth_m: float, frame: Look,
    bar_m: float = 0.07, pane: Look = GLASS,
) -> Iterator[Shapes]:  # fmt: skip
    """Panes with a frame and bars, filling an opening."""
    x0, z0, x1, z1 = opening
    half = bar_m / 2
    xs = np.linspace(x0 + half, x1 - half, columns + 1)
    zs = np.linspace(z0 + half, z1 - half, rows + 1)
    if rows == 2:
        zs[1] = zs[0] + 0.68 * (zs[2] - zs[0])  # a fanlight above
    panes = [
        (a + half, low + half, b - half, high - half)
        for a, b in itertools.pairwise(xs)
        for low, high in itertools.pairwise(zs)
    ]
    bars, edges = cut(opening, panes)
    yield panels(bars, depth_m - 0.02, frame, edges)
    glass = panels(panes, depth_m, pane)
    glass.variation[:] = 0.37  # one window, one curtain
    yield glass


def windows(corners: list, facade: Facade, fine: bool, holes: list[Rectangle]) -> Shapes:
    """Windows with reveals, sills and surrounds, the lower left corners of their openings at
    (x, z)."""
    width, height = facade.window_m
    band, over = (SURROUND_M, 0.2) if facade.has_surround else (0.0, 0.0)
    opening = (0.0, 0.0, width, height)
    columns, rows = ((2, 2) if height > 1.7 else (2, 1)) if fine else (1, 1)
    parts = [
        glazing(opening, columns, rows, REVEAL_M, facade.frame),
        reveals(opening, REVEAL_M, facade.trim if facade.has_surround else facade.wall),
        boxes((-0.08, -0.09, -0.08), (width + 0.08, 0.02, 0.0), facade.trim, faces=_FRONT),
    ]
    if facade.has_surround:
        low = [(-band, -0.035, 0.0), (width, -0.035, 0.0), (-band, -0.06, height)]
        high = [(0.0, 0, height), (width + band, 0, height), (width + band, 0, height + over)]
        parts.append(boxes(low, high, facade.trim, faces=_FRONT))
    for x, z in corners:
        holes += [(x - 0.08, z - 0.08, x + width + 0.08, z), (x, z, x + width, z + height)]
        if facade.has_surround:
            holes += [(x - band, z, x + width + band, z + height)]
            holes += [(x - band, z + height, x + width + band, z + height + over)]
    return join(parts).repeated(np.array([(x, 0.0, z) for x, z in corners]))


@joined
def door(opening: Rectangle, facade: Facade) -> Iterator[Shapes]:
    """A panelled door with a fanlight and a step."""
    x0, z0, x1, z1 = opening
    split = z1 - 0.55
    leaf, light = (x0 + 0.06, z0, x1 - 0.06, split), (x0 + 0.06, split + 0.06, x1 - 0.06, z1 - 0.06)
    low, high = leaf[0] + 0.14, leaf[2] - 0.14
    fields = [(low, z0 + 0.25, high, z0 + 0.95), (low, z0 + 1.1, high, split - 0.16)]
    frames, edges = cut(opening, [leaf, light])
    stiles, stile_edges = cut(leaf, fields)
    yield panels(frames, REVEAL_M - 0.02, facade.frame, edges)
    yield panels(stiles, REVEAL_M, facade.accent, stile_edges)
    dark = facade.accent.tinted(np.array(facade.accent.rgb) * 0.7)
    yield panels(fields, REVEAL_M + 0.015, dark)
    yield panels(light, REVEAL_M, GLASS)
    yield reveals(opening, REVEAL_M, facade.wall)
    yield boxes((x0 - 0.1, -0.35, -0.3), (x1 + 0.1, REVEAL_M, z0), facade.base)


@joined
def shop_front(opening: Rectangle, facade: Facade, awning: bool) -> Iterator[Shapes]:
    """A shop: plinth, large panes, a glass door, a sign above and perhaps an awning."""
    x0, z0, x1, z1 = opening
    accent, depth, door_x, sign_z = facade.accent, 0.18, x1 - 1.25, z1 + 0.08
    yield panels((x0, z0, door_x, z0 + 0.5), depth - 0.04, accent)
    columns = max(1, round((door_x - x0) / 1.7))
    yield glazing((x0, z0 + 0.5, door_x, z1), columns, 1, depth, accent, 0.09, SHOP_GLASS)
    yield glazing((door_x, z0, x1, z1), 1, 2, depth, accent, 0.11)
    yield reveals(opening, depth, accent)
    low, high = (x0 - 0.1, -0.12, sign_z), (x1 + 0.1, 0.02, sign_z + 0.62)
    yield boxes(low, high, accent, faces=_FRONT)
    # Light blocks on the sign that read as letters from afar.
    number = np.arange(int(min(12, (x1 - x0 - 0.8) / 0.32)))
    starts = (x0 + x1) / 2 + (number - len(number) / 2) * 0.32
    tall = 0.18 + 0.10 * ((number * 5) % 3 == 0)
    z = sign_z + 0.17
    letters = np.stack(np.broadcast_arrays(starts, z, starts + 0.2, z + tall), 1)
    yield panels(letters[number % 5 != 3], -0.135, facade.trim)
    if awning:  # striped cloth, sloping out over the pavement, with a hem
        count = max(4, round((x1 - x0) / 0.45))
        edges, u = np.linspace(x0, x1, count + 1)[:-1], ((x1 - x0) / count, 0.0, 0.0)
        slope, hem = np.array([0.0, 1.2, 0.55]), np.array([0.0, 0.0, -0.2])
        for start, look in ((0, accent), (1, facade.trim)):
            top = xyz(edges[start::2], -1.25, z1 + 0.05 - 0.55)
            yield parallelograms(top, u, slope, look)
            yield parallelograms(top + hem, u, -hem, look)


# ---- Houses and gardens --------------------------------------------------------------------------

DEPTH_M = 10.5
BASE_M = -0.25  # walls reach below the pavement
# Nobody sees it: it stops what little shines through the front's splats from showing the back wall.
INNER_WALL_M = 0.45
WALLS = (
    *[((0.72, 0.66, 0.54), Material.PLASTER), ((0.66, 0.50, 0.36), Material.PLASTER)],
    *[((0.58, 0.57, 0.54), Material.PLASTER), ((0.70, 0.56, 0.50), Material.PLASTER)],
    *[((0.50, 0.58, 0.56), Material.PLASTER), ((0.78, 0.76, 0.71), Material.PLASTER)],
    *[((0.36, 0.16, 0.11), Material.BRICK), ((0.42, 0.22, 0.14), Material.BRICK)],
    *[((0.30, 0.19, 0.15), Material.BRICK), ((0.55, 0.49, 0.39), Material.STONE)],
)
ACCENTS = (
    (0.05, 0.13, 0.10), (0.24, 0.03, 0.03), (0.04, 0.07, 0.18),
    (0.10, 0.055, 0.03), (0.03, 0.03, 0.035), (0.30, 0.17, 0.03),
)  # fmt: skip
ROOFS = ((0.24, 0.10, 0.065), (0.13, 0.12, 0.125), (0.19, 0.09, 0.06))
STONE = Look((0.60, 0.57, 0.51), Class.BUILDING)
_PANE = Look((0.10, 0.12, 0.14), Class.BUILDING)
_ZINC = Look((0.22, 0.22, 0.215), Class.BUILDING)
_CHIMNEY = Look((0.33, 0.16, 0.11), Class.BUILDING, Material.BRICK)
_GRAVEL = Look((0.30, 0.29, 0.27), Class.BUILDING, Material.ASPHALT, spacing=1.6)
_UPRIGHT = ("-y", "+y", "+x", "-x")


@joined
def build_buildings(layout: Layout) -> Iterator[Shapes]:
    """Both rows of houses, those that close the street's ends, and some behind."""
    middle = layout.parameters.path_length_m / 2
    for x0, x1, side, seed, is_garden in layout.plots:
        is_near = abs((x0 + x1) / 2 - middle) - middle < 32
        built = _garden(x1 - x0) if is_garden else _house(seed, x1 - x0, is_near)
        yield _beside(built, side, x0, x1, FACADE_M)
    reach = CROSS_STREET_M + 4.6
    for number, (x, turn) in enumerate(((layout.x1 + reach, -1), (layout.x0 - reach, 1))):
        rng = stream(layout.parameters, 20, number)
        start = -56.0
        while start < 56.0:
            width = rng.uniform(9.0, 14.0)
            house = _house(int(rng.integers(2**31)), width, False)
            yield house.moved((x, start + width if turn < 0 else start, 0.0), turn * np.pi / 2)
            start += width
    yield _second_row(layout)


def _beside(built: Shapes, side: int, x0: float, x1: float, y: float) -> Shapes:
    """What is built at the origin, from x0 to x1 on the street's left (1) or right side (-1)."""
    return built.moved((x0 if side > 0 else x1, side * y, 0.0), 0.0 if side > 0 else np.pi)


def draw_facade(rng: np.random.Generator) -> Facade:
    """Colours and measures of one house."""
    rgb, material = WALLS[rng.integers(len(WALLS))]
    rgb = np.array(rgb) * rng.uniform(0.88, 1.06)
    white = rng.random() < 0.7 or material == Material.BRICK
    return Facade(
        wall=Look(rgb, Class.BUILDING, material, backed=True),
        base=Look(rgb * 0.35 + 0.10, Class.BUILDING, Material.STONE),
        trim=STONE.tinted((0.74, 0.72, 0.67)) if white else STONE,
        frame=STONE.tinted((0.78, 0.77, 0.75) if rng.random() < 0.7 else (0.07, 0.065, 0.06)),
        accent=Look(ACCENTS[rng.integers(len(ACCENTS))], Class.BUILDING),
        window_m=(float(rng.uniform(1.05, 1.4)), float(rng.uniform(1.55, 1.95))),
        floor_m=float(rng.uniform(3.0, 3.4)),
        ground_m=float(rng.uniform(3.75, 4.1)),
        has_surround=bool(rng.random() < 0.55),
        has_shop=bool(rng.random() < 0.5),
    )


@joined
def _house(seed: int, width: float, fine: bool) -> Iterator[Shapes]:
    """A house on x in [0, width], its front at y = 0."""
    rng = np.random.default_rng(seed)
    facade = draw_facade(rng)
    floors = int(rng.integers(2, 4))
    eaves = facade.ground_m + floors * facade.floor_m + 0.35
    count = max(2, round(width / rng.uniform(2.5, 3.1)))
    middles = [(i + 0.5) * (width / count) for i in range(count)]
    holes: list[Rectangle] = []
    yield from _ground_floor(rng, facade, width, middles, holes, fine)
    sills = [facade.ground_m + j * facade.floor_m + 0.75 for j in range(floors)]
    corners = [(x - facade.window_m[0] / 2, z) for z in sills for x in middles]
    yield windows(corners, facade, fine, holes)
    ledge = (facade.ground_m + 0.12, facade.ground_m + 0.3, 0.09)
    for z0, z1, reach in (ledge, (eaves - 0.32, eaves, 0.28)):
        holes.append((0.0, z0, width, z1))
        yield boxes((0.0, -reach, z0), (width, 0.0, z1), facade.trim, faces=_LEDGE)
    base, edges = cut((0.0, BASE_M, width, 0.5), [h for h in holes if h[1] < 0.5])
    yield panels(base, -0.0, facade.base, edges)
    wall, edges = cut((0.0, 0.5, width, eaves), holes)
    yield panels(wall, 0.0, facade.wall, edges)
    yield _back(facade, width, eaves)
    yield _roof(rng, facade, width, eaves)
    inner = facade.wall._replace(material=Material.PLAIN, backed=False)
    yield panels((0.0, BASE_M, width, eaves), INNER_WALL_M, inner)
    yield tube((0.12, -0.09, 0.0), (0.12, -0.09, eaves - 0.2), 0.05, _ZINC)  # a rainpipe


def _ground_floor(
    rng: np.random.Generator, facade: Facade, width: float, middles: list[float],
    holes: list[Rectangle], fine: bool,
) -> Iterator[Shapes]:  # fmt: skip
    """Shop, or a door between windows."""
    floor = float(pavement_z(FACADE_M)) + 0.02
    if facade.has_shop:
        opening = (0.45, floor, width - 0.45, floor + 2.75)
        holes += [opening, (0.35, opening[3] + 0.08, width - 0.35, opening[3] + 0.70)]
        yield shop_front(opening, facade, bool(rng.random() < 0.45))
        return
    entry = middles[int(rng.integers(len(middles)))]
    opening = (entry - 0.58, floor + 0.12, entry + 0.58, floor + 2.95)
    holes += [opening, (opening[0] - 0.1, BASE_M, opening[2] + 0.1, opening[1])]
    yield door(opening, facade)
    corners = [(x - facade.window_m[0] / 2, 1.15) for x in middles if x != entry]
    yield windows(corners, facade, fine, holes)


def _back(facade: Facade, width: float, eaves: float) -> Shapes:
    """Side and back walls, plain."""
    wall = facade.wall._replace(spacing=1.6, backed=False)
    return boxes((0.0, 0.0, BASE_M), (width, DEPTH_M, eaves), wall, faces=("+x", "-x", "+y"))


@joined
def _roof(
    rng: np.random.Generator, facade: Facade, width: float, eaves: float
) -> Iterator[Shapes]:  # fmt: skip
    """A ridge along the street, or a flat roof behind a parapet."""
    wall, trim = facade.wall._replace(backed=False), facade.trim
    if rng.random() < 0.35:
        top = eaves + 0.75
        yield parallelograms((0, 0.3, eaves), (width, 0, 0), (0, DEPTH_M - 0.3, 0), _GRAVEL)
        yield boxes((0, 0, eaves), (width, 0.3, top), wall, faces=_UPRIGHT)
        yield boxes((-0.0, -0.07, top), (width, 0.37, top + 0.1), trim, faces=_LEDGE)
        return
    tiles = Look(ROOFS[rng.integers(len(ROOFS))], Class.BUILDING, Material.TILES, spacing=1.3)
    half, over = DEPTH_M / 2, 0.35
    rise = half * float(np.tan(np.radians(rng.uniform(30, 40))))
    drop = over * rise / half
    edge_z = eaves - drop + 0.12
    slope = np.array([0.0, half + over, rise + drop])
    yield parallelograms((0.0, -over, edge_z), (width, 0, 0), slope, tiles)
    back = (width, DEPTH_M + over, edge_z)
    yield parallelograms(back, (-width, 0, 0), slope * [1, -1, 1], tiles)
    low, high = (0.0, -over - 0.12, edge_z - 0.14), (width, -over + 0.02, edge_z + 0.0)
    yield boxes(low, high, trim.tinted((0.25, 0.24, 0.23)), faces=_LEDGE, edges=0)  # a gutter
    yield parallelograms((0, -over, edge_z - 0.02), (0, over, 0), (width, 0, 0), trim, edges=0)
    for x, order in ((0.0, (0, 2, 1)), (width, (0, 1, 2))):
        gable = np.array([(x, 0.0, eaves), (x, DEPTH_M, eaves), (x, half, eaves + rise + 0.1)])
        yield triangles(*gable[list(order)], wall._replace(spacing=0.8))
    for x in (0.7, width - 1.5)[: int(rng.integers(1, 3))]:
        low, high = (x, half - 0.9, eaves + rise * 0.6), (x + 0.8, half - 0.3, eaves + rise + 0.9)
        yield boxes(low, high, _CHIMNEY)


def _garden(width: float) -> Shapes:
    """A low wall with a hedge behind it, across a gap between two houses."""
    brick = Look((0.34, 0.17, 0.12), Class.BARRIER, Material.BRICK)
    hedge = Look((0.075, 0.13, 0.03), Class.VEGETATION, Material.LEAVES)
    stone = Look((0.52, 0.50, 0.46), Class.BARRIER)
    return join([
        boxes((0, 0.0, BASE_M), (width, 0.3, 0.95), brick, faces=_UPRIGHT),
        boxes((0, -0.05, 0.95), (width, 0.35, 1.03), stone, faces=_LEDGE),
        boxes((0.05, 0.5, 0.0), (width - 0.05, 1.5, 1.75), hedge, edges=0),
    ])  # fmt: skip


@joined
def _second_row(layout: Layout) -> Iterator[Shapes]:
    """Plain houses behind the gardens, which close the view through the gaps."""
    rng = stream(layout.parameters, 21)
    for side in (1, -1):
        x = layout.x0 - 4.0
        while x < layout.x1 + 4.0:
            width, height = rng.uniform(9, 15), rng.uniform(6.5, 9.5)
            facade = draw_facade(rng)
            y = rng.uniform(36, 44)
            wall = facade.wall._replace(backed=False)
            columns = np.arange(1.2, width - 1.6, 2.6)
            holes = [(w, z, w + 1.2, z + 1.5) for z in (1.2, 4.2) for w in columns]
            front, edges = cut((0.0, BASE_M, width, height), holes)
            built = join([
                panels(front, 0.0, wall, edges & np.uint8(U0 | U1 | V1)),
                panels(holes, 0.1, _PANE),
                *[reveals(h, 0.1, wall) for h in holes],
                _back(facade, width, height),
                _roof(rng, facade, width, height),
            ])  # fmt: skip
            yield _beside(built, side, x, x + width, y)
            x += width + rng.uniform(4, 12)


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
PAVEMENT_M, CROSS_HALF_M = 4.6, 70.0  # of the cross streets: their far pavement, half their length
EDGE_M = FACADE_M + 0.6  # where the pavements end, under the walls


@joined
def build_ground(layout: Layout) -> Iterator[Shapes]:
    """Everything that lies on the ground."""
    yield from _carriageway(layout)
    yield from _pavements(layout)
    yield from _cross_streets(layout)
    west, east = layout.x0 - CROSS_STREET_M, layout.x1 + CROSS_STREET_M
    holes: list[Rectangle] = [
        (layout.x0, -EDGE_M, layout.x1, EDGE_M),
        (west - PAVEMENT_M, -CROSS_HALF_M, layout.x0, CROSS_HALF_M),
        (layout.x1, -CROSS_HALF_M, east + PAVEMENT_M, CROSS_HALF_M),
    ]
    reach = TERRAIN_REACH_M
    pieces, edges = cut((west - reach, -reach, east + reach, reach), holes)
    # Only the rims that border something else need to be crisp.
    yield _sloped(pieces, 0.0, TERRAIN_Z_M, GRASS, edges & np.uint8(V0 | V1))


def _sloped(
    rectangles, slope: float, z0: float, look: Look, edges: np.ndarray | int = ALL_EDGES
) -> Shapes:  # fmt: skip
    """Panels over rectangles [R, 4] on the plane z = z0 + slope y, facing up."""
    x0, y0, x1, y1 = np.reshape(rectangles, (-1, 4)).T
    u, v = xyz(x1 - x0, 0, 0), xyz(0, y1 - y0, slope * (y1 - y0))
    return parallelograms(xyz(x0, y0, z0 + slope * y0), u, v, look, edges=edges)


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
    found: tuple[list[Rectangle], list[Rectangle]] = [], []
    for x in np.arange(layout.x0 + 4, layout.x1 - 6, 7.0):
        kind = int(rng.random() < 0.45)
        side = rng.choice([-1, 1])
        half = (rng.uniform(0.8, 2.6), rng.uniform(0.3, 0.6)) if kind == 0 else (0.3, 0.3)
        middle = (x + rng.uniform(0, 4), side * rng.uniform(0.9, 2.4))
        spot = (middle[0] - half[0], middle[1] - half[1], middle[0] + half[0], middle[1] + half[1])
        left, near, right, far = spot[0] - 0.1, spot[1] - 0.1, spot[2] + 0.1, spot[3] + 0.1
        others = [*taken, *found[0], *found[1]]
        if all(right < a[0] or a[2] < left or far < a[1] or a[3] < near for a in others):
            found[kind].append(spot)
    return found


def _carriageway(layout: Layout) -> Iterator[Shapes]:
    """Both halves of the road, in sections along x: a mark cuts only the asphalt beside it."""
    marks = _markings(layout)
    repairs, covers = _patches(layout, marks)
    crossing = (layout.zebra_x - ZEBRA_CLEAR_M, layout.zebra_x + ZEBRA_CLEAR_M)
    bounds = np.arange(layout.x0, layout.x1 - SECTION_M / 2, SECTION_M)
    bounds = bounds[(bounds < crossing[0] - 1) | (bounds > crossing[1] + 1)]
    bounds = np.sort([*bounds, *crossing, layout.x1])
    for side, kerb in ((1, V1), (-1, V0)):
        low, high = sorted((0.0, side * ROAD_HALF_M))
        holes = []
        for rectangles, look in ((marks, MARKING), (repairs, REPAIR), (covers, IRON)):
            here = [r for r in rectangles if low <= r[1] and r[3] <= high]
            holes += here
            yield _sloped(here, -side * CAMBER, 0.0, look)
        for start, stop in itertools.pairwise(bounds):
            near = [h for h in holes if h[0] < stop and h[2] > start]
            pieces, edges = cut((start, low, stop, high), near, rim=kerb)
            yield _sloped(pieces, -side * CAMBER, 0.0, ASPHALT, edges)


def _kerb(start: Vectors, along: Vectors, left: bool) -> Shapes:
    """A kerb's face, which looks to the left or the right of the way along it."""
    up = (0, 0, KERB_RISE_M)
    return parallelograms(start, *((along, up) if not left else (up, along)), KERB)


def _pavements(layout: Layout) -> Iterator[Shapes]:
    low_z, inner = float(road_z(ROAD_HALF_M)), ROAD_HALF_M + KERB_TOP_M
    z0 = low_z + KERB_RISE_M - PAVEMENT_SLOPE * ROAD_HALF_M
    for side in (1, -1):
        start = (layout.x0, side * ROAD_HALF_M, low_z)
        yield _kerb(start, (layout.x1 - layout.x0, 0, 0), side < 0)
        for near, far, look in ((ROAD_HALF_M, inner, KERB), (inner, EDGE_M, PAVING)):
            low, high = sorted((side * near, side * far))
            yield _sloped((layout.x0, low, layout.x1, high), side * PAVEMENT_SLOPE, z0, look)


def _cross_streets(layout: Layout) -> Iterator[Shapes]:
    """The streets that ours runs into, with the pavement beyond."""
    z, half = float(road_z(ROAD_HALF_M)), CROSS_HALF_M
    for x, direction in ((layout.x0, -1), (layout.x1, 1)):
        kerb = x + direction * CROSS_STREET_M
        near, far = sorted((x, kerb))
        yield _sloped((near, -half, far, half), 0.0, z, ASPHALT)
        yield _kerb((kerb, -half, z), (0, 2 * half, 0), direction > 0)
        near, far = sorted((kerb, kerb + direction * PAVEMENT_M))
        yield _sloped((near, -half, far, half), 0.0, z + KERB_RISE_M, PAVING)
        for side in (1, -1):  # the near pavement's edge, left and right of our street
            is_left = (side > 0) != (direction < 0)
            yield _kerb((x, side * ROAD_HALF_M, z), side * np.array([0, 60.0, 0]), is_left)


# ---- A person in mid-stride: tubes and ellipsoids, one rigid body --------------------------------
# Frame: x forward, y left, z up, origin on the ground between the feet.

PERSON_SIZE_M = (0.92, 0.66, 1.80)
SKIN = ((0.52, 0.31, 0.21), (0.28, 0.15, 0.09), (0.60, 0.40, 0.29))
COATS = ((0.30, 0.05, 0.05), (0.05, 0.10, 0.22), (0.36, 0.31, 0.22), (0.06, 0.14, 0.09))
TROUSERS = ((0.035, 0.045, 0.08), (0.05, 0.05, 0.05), (0.20, 0.17, 0.12))


@joined
def draw_person(seed: int) -> Iterator[Shapes]:
    """A person with clothes drawn from the seed."""
    rng = np.random.default_rng(seed)
    drawn = [colours[rng.integers(len(colours))] for colours in (SKIN, COATS, TROUSERS)]
    drawn += [np.array((0.03, 0.02, 0.015)) * rng.uniform(1, 4), (0.03, 0.028, 0.025)]
    skin, coat, legs, hair, shoes = (Look(rgb, Class.PEDESTRIAN, spacing=0.7) for rgb in drawn)
    c, s = np.cos(0.06), np.sin(0.06)  # the trunk leans forward
    lean = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    radii = np.array([[0.125], [0.20], [0.33]])
    yield ellipsoids((0.01, 0, 1.20), (lean * radii)[None], coat)
    yield ball((0.0, 0, 0.93), (0.125, 0.175, 0.16), legs)
    yield ball((0.035, 0, 1.635), (0.098, 0.08, 0.125), skin)
    yield ball((0.012, 0, 1.67), (0.105, 0.09, 0.105), hair)
    yield tube((0.01, 0, 1.46), (0.02, 0, 1.56), 0.055, skin)
    for side in (1, -1):  # the left leg steps forward
        y = side * 0.095
        knee = (0.10 * side + 0.06, y, 0.50)
        foot = np.array([0.27 * side - 0.06 * (side < 0), y, 0.10 + 0.03 * (side < 0)])
        shoulder, elbow = (0.0, side * 0.19, 1.41), (-0.13 * side, side * 0.255, 1.15)
        hand = (-0.20 * side + 0.12, side * 0.245, 0.93)
        yield tube((0, y, 0.93), knee, 0.085, legs)
        yield tube(knee, foot, 0.062, legs)
        yield ball(knee, (0.072, 0.07, 0.075), legs)
        yield ball(foot + np.array([0.055, 0, -0.04]), (0.135, 0.05, 0.055), shoes)
        yield tube(shoulder, elbow, 0.052, coat)
        yield tube(elbow, hand, 0.043, coat)
        yield ball(shoulder, (0.062, 0.058, 0.068), coat)
        yield ball(elbow, (0.05, 0.05, 0.05), coat)
        yield ball(hand, (0.045, 0.03, 0.055), skin)


# ---- Trees: a trunk with a few boughs, and a crown of many small leafy blobs around a dense core -

BARK = Look((0.13, 0.10, 0.075), Class.VEGETATION, Material.BARK)
LEAF = Look((0.12, 0.21, 0.04), Class.VEGETATION, Material.LEAF)
CORE = Look((0.045, 0.08, 0.02), Class.VEGETATION, Material.LEAVES, ambient=0.4, spacing=3.0)
WOOD = Look((0.07, 0.12, 0.035), Class.VEGETATION, Material.LEAVES, spacing=2.2)
NEAR_LEAVES, MIDDLE_LEAVES, FAR_LEAVES, GARDEN_LEAVES = 2600, 1200, 300, 80


@joined
def build_vegetation(layout: Layout) -> Iterator[Shapes]:
    """Street trees, garden trees behind the houses, and woods far out."""
    rng = stream(layout.parameters, 30)
    middle = layout.parameters.path_length_m / 2
    for x, y in layout.trees:
        beyond = max(abs(x - middle) - middle, 0.0)  # along the street from the drive
        leaves = NEAR_LEAVES if beyond < 10 else (MIDDLE_LEAVES if beyond < 28 else FAR_LEAVES)
        yield _tree(rng, 1.0, leaves).moved((x, y, float(pavement_z(y)) - 0.03))
    for _ in range(24):
        x = rng.uniform(layout.x0 - 8, layout.x1 + 8)
        y = rng.choice([-1, 1]) * rng.uniform(24, 33)
        yield _tree(rng, rng.uniform(1.1, 1.5), GARDEN_LEAVES).moved((x, y, 0.0))
    # Big loose crowns at the edge of the land, which hide where it ends.
    angle, radius = rng.uniform(0, 2 * np.pi, 130), rng.uniform(150, 215, 130)
    size = rng.uniform(5.0, 9.0, 130)
    x = (layout.x0 + layout.x1) / 2
    x = x + (1 + (layout.x1 - layout.x0) / 2 / 200) * radius * np.cos(angle)
    axes = np.eye(3) * (size[:, None] * [1.5, 1.5, 0.85])[:, None]
    woods = ellipsoids(xyz(x, radius * np.sin(angle), 0.55 * size), axes, WOOD)
    woods.variation[:] = rng.random(130)
    yield woods


@joined
def _tree(rng: np.random.Generator, size: float, leaves: int) -> Iterator[Shapes]:
    """One tree at the origin; leaves: how many tufts its crown has."""
    height = size * rng.uniform(3.9, 4.6)  # of the crown's middle
    radii = size * np.array([1.0, 1.0, 1.15]) * rng.uniform(1.55, 1.95)
    top = np.array([*rng.uniform(-0.12, 0.12, 2), height])
    fork = top * [1, 1, 0.62]
    yield tube((0, 0, -0.1), fork * 0.5, 0.135 * size, BARK)
    yield tube(fork * 0.48, fork, 0.115 * size, BARK)
    for k in range(4):
        angle = rng.uniform(0, 0.8) + k * np.pi / 2
        reach = np.array([np.cos(angle), np.sin(angle), 0.9]) * radii * 0.62
        yield tube(fork * 0.98, fork + reach, 0.055 * size, BARK)
    yield ball(top, radii * 0.62, CORE)
    yield _crown(rng, top, radii, leaves)


def _crown(rng: np.random.Generator, centre: np.ndarray, radii: np.ndarray, leaves: int) -> Shapes:
    """Tufts of leaves on boughs: round lumps around a core, lighter towards the outside and top."""
    lumps = 34
    step = np.arange(lumps)
    height = 1 - (2 * step + 1) / lumps * 0.93  # the underside stays open around the trunk
    angle = step * 2.39996 + rng.uniform(0, 6)
    flat = np.sqrt(1 - height**2)
    lump = xyz(flat * np.cos(angle), flat * np.sin(angle), height)
    lump = unit(lump + rng.normal(size=(lumps, 3)) * 0.12)
    lump_centre = lump * rng.uniform(0.60, 0.80, (lumps, 1))
    lump_radius = rng.uniform(0.32, 0.44, lumps)
    owner = rng.integers(lumps, size=leaves)
    # More of them on a lump's outside.
    local = unit(unit(rng.normal(size=(leaves, 3))) + 0.75 * lump[owner])
    reach = lump_radius[owner] * rng.uniform(0.7, 1.08, leaves)
    spot = lump_centre[owner] + local * reach[:, None]
    outward = unit(spot)
    normal = unit(local + 0.5 * outward + 0.45 * rng.normal(size=(leaves, 3)))
    size = 2.6 * radii.mean() / np.sqrt(leaves) * rng.uniform(0.75, 1.3, leaves)
    u = unit(cross(normal, rng.normal(size=(leaves, 3))))
    axes = np.stack([u, cross(normal, u) * 0.72, normal * 0.22], 1) * size[:, None, None]
    shapes = ellipsoids(centre + spot * radii, axes, LEAF)
    shapes.shading[:, 0] = normal
    depth = np.clip((np.linalg.norm(spot, axis=1) - 0.6) / 0.45, 0, 1)
    shapes.ambient[:] = 0.42 + 0.38 * depth + 0.22 * np.clip(outward[:, 2], -0.4, 1)
    shapes.variation[:] = rng.random(leaves)
    return shapes


# ---- Cars: a lofted body with smooth plates, a glasshouse on top, wheels and lights --------------
# Car frame: x forward, y left, z up, origin on the ground under the middle.

PAINTS = (
    (0.42, 0.42, 0.43), (0.05, 0.055, 0.06), (0.62, 0.62, 0.61),
    (0.30, 0.02, 0.02), (0.03, 0.07, 0.20), (0.16, 0.17, 0.18),
    (0.05, 0.13, 0.09), (0.36, 0.26, 0.06), (0.20, 0.29, 0.36),
)  # fmt: skip
CAR_SPACING = 0.6  # cars draw the eye
PAINT = Look((-1.0, -1.0, -1.0), Class.VEHICLE, Material.PAINT, spacing=CAR_SPACING)  # not yet any
CAR_GLASS = PAINT._replace(rgb=(0.012, 0.014, 0.016), ambient=0.8)
TYRE = Look((0.022, 0.022, 0.023), Class.VEHICLE, spacing=CAR_SPACING)
ARCH = TYRE.tinted((0.008, 0.008, 0.008))
RIM = TYRE._replace(rgb=(0.46, 0.46, 0.47), material=Material.RIM)
TRIM = TYRE.tinted((0.03, 0.03, 0.032))
HEADLIGHT = TYRE.tinted((0.72, 0.74, 0.78))
TAILLIGHT = TYRE.tinted((0.42, 0.015, 0.015))
PLATE = TYRE.tinted((0.72, 0.71, 0.62))
WHEEL_RADIUS_M = 0.32


class CarModel(NamedTuple):
    """Measures in metres. hood, tail: where windscreen and rear window start, from the middle."""

    length: float
    width: float
    belt: float
    roof: float
    hood: float
    tail: float
    roof_front: float
    roof_rear: float

    @property
    def size_m(self) -> tuple[float, float, float]:
        return (self.length + 0.08, self.width + 0.08, self.roof + 0.02 + 0.04)


CAR_MODELS = (
    CarModel(4.25, 1.80, 0.90, 1.46, 0.95, -1.95, 0.20, -1.45),  # hatchback
    CarModel(4.60, 1.82, 0.90, 1.42, 1.00, -1.65, 0.25, -0.90),  # saloon
    CarModel(4.50, 1.86, 1.02, 1.66, 1.10, -2.10, 0.45, -1.75),  # tall estate
)


def draw_car(seed: int) -> tuple[CarModel, Shapes]:
    """A car of some model and paint."""
    rng = np.random.default_rng(seed)
    model = CAR_MODELS[rng.integers(len(CAR_MODELS))]
    shapes = _unpainted(model).copy()
    shapes.rgb[shapes.rgb[:, 0] < 0] = PAINTS[rng.integers(len(PAINTS))]
    return model, shapes


@lru_cache(maxsize=len(CAR_MODELS))
@joined
def _unpainted(model: CarModel) -> Iterator[Shapes]:
    yield from _body(model)
    yield from _glasshouse(model)
    yield from _wheels(model)
    yield from _details(model)


def _body(model: CarModel) -> Iterator[Shapes]:
    """The lower body, lofted along x through rounded cross sections."""
    half = model.length / 2
    s = np.concatenate([[-1, -0.985, -0.94], np.linspace(-0.82, 0.80, 11), [0.93, 0.982, 1]])
    x = s * half
    end = np.abs(s)
    width = model.width / 2 * (1 - 0.07 * end**4 - 0.13 * np.clip((end - 0.9) / 0.1, 0, 1) ** 2)
    hood = np.clip((x - model.hood + 0.25) / (half - model.hood + 0.25), 0, 1)
    boot = np.clip((model.tail + 0.2 - x) / (half + model.tail + 0.2), 0, 1)
    top = model.belt - 0.17 * hood**1.6 - 0.05 * boot - 0.14 * np.clip((end - 0.94) / 0.06, 0, 1)
    low = 0.20 + 0.12 * np.clip((end - 0.86) / 0.14, 0, 1)
    # (share of the half width, share of the height) around one side of a section, from the sill up.
    lower = ((0.90, 0), (0.97, 0.10), (1.0, 0.42), (0.985, 0.72))
    profile = np.array([*lower, (0.94, 0.91), (0.86, 0.985), (0.45, 1.03)])
    y, z = width[:, None] * profile[:, 0], low[:, None] + (top - low)[:, None] * profile[:, 1]
    left = xyz(x[:, None], y, z)
    right = left * [1, -1, 1]
    yield _loft(np.concatenate([right, left[:, ::-1]], 1))  # from sill over to sill
    for index, turn in ((0, -1), (-1, 1)):  # both ends
        a, b = right[index], left[index]
        yield quads(np.stack([a[:-1], b[:-1], b[1:], a[1:]], 1)[:, ::turn], PAINT)


def _loft(rings: np.ndarray) -> Shapes:
    """A smooth surface through rings [X, M, 3], facing outwards if rings run right to left."""
    normals = np.cross(np.gradient(rings, axis=0), np.gradient(rings, axis=1))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    corners, bent = (
        np.stack([g[:-1, :-1], g[1:, :-1], g[1:, 1:], g[:-1, 1:]], 2).reshape(-1, 4, 3)
        for g in (rings, normals)
    )
    return quads(corners, PAINT, normals=bent)


def _glasshouse(model: CarModel) -> Iterator[Shapes]:
    """Windscreen, side windows with pillars, rear window and roof."""
    base, top = model.width / 2 * 0.89, model.width / 2 * 0.70
    z0, z1 = model.belt - 0.02, model.roof

    def side_point(s: float, t: float, sign: int) -> np.ndarray:
        """s from rear to front, t from belt to roof."""
        rear = model.tail + (model.roof_rear - model.tail) * t
        front = model.hood + (model.roof_front - model.hood) * t
        y = sign * (base + (top - base) * t**1.3 + 0.05 * t * (1 - t) * 4)  # bulging
        return np.array([rear + (front - rear) * s, y, z0 + (z1 - z0) * t])

    levels = (0.0, 0.09, 0.50, 0.86, 1.0)
    cuts = (0.0, 0.06, 0.30, 0.36, 0.53, 0.58, 0.78, 0.93, 1.0)
    cells = list(itertools.product(range(len(cuts) - 1), range(len(levels) - 1), (1, -1)))
    for look, is_clear in ((CAR_GLASS, True), (PAINT, False)):
        corners = []
        for i, j, sign in cells:
            if (i in (1, 3, 5, 6) and j in (1, 2)) == is_clear:
                loop = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)][::-sign]
                corners.append([side_point(cuts[k], levels[n], sign) for k, n in loop])
        yield quads(corners, look)
    for s, sign in ((1.0, 1), (0.0, -1)):  # windscreen, rear window
        ends = [[side_point(s, t, side) for t in levels] for side in (-1, 1)]
        for look, (u0, u1), chosen in (
            (CAR_GLASS, (0.06, 0.94), (1, 2)),
            (PAINT, (0.06, 0.94), (0, 3)),
            (PAINT, (0.0, 0.06), (0, 1, 2, 3)),
            (PAINT, (0.94, 1.0), (0, 1, 2, 3)),
        ):
            corners = []
            for j in chosen:
                loop = [(u0, j), (u1, j), (u1, j + 1), (u0, j + 1)][::sign]
                corners.append([ends[0][k] + (ends[1][k] - ends[0][k]) * u for u, k in loop])
            yield quads(corners, look)
    # A gently domed roof.
    x, share = np.linspace(model.roof_rear, model.roof_front, 7)[:, None], np.linspace(-1, 1, 7)
    dome = 0.03 * (1 - share[None, :] ** 2) * np.sin(np.linspace(0, np.pi, 7))[:, None] ** 0.5
    yield _loft(xyz(x, share * top, model.roof + dome * 0.6))


def _wheels(model: CarModel) -> Iterator[Shapes]:
    radius, reach = WHEEL_RADIUS_M, model.width / 2
    for x in (model.length * 0.305, -model.length * 0.295):
        for side in (1, -1):
            y, out = side * (reach - 0.005), (0.0, float(side), 0.0)
            inner, outer = (x, side * (reach - 0.24), radius), (x, y + side * 0.028, radius)
            yield disc((x, side * (reach + 0.012), radius + 0.03), out, radius + 0.065, ARCH)
            yield tube(inner, outer, radius, TYRE)
            yield disc(outer, out, radius, TYRE)
            yield disc((x, y + side * 0.036, radius), out, radius * 0.68, RIM)


def _details(model: CarModel) -> Iterator[Shapes]:
    """Lamps, mirrors, grille, number plates and bumpers."""
    half, width = model.length / 2, model.width / 2
    front_z, rear_z = model.belt - 0.35, model.belt - 0.20
    for side in (1, -1):
        for look, faces, x0, x1, z0, z1, share, over in (
            (HEADLIGHT, "+x +z +y -y -z", half - 0.16, half + 0.012, front_z - 0.06, front_z + 0.07,
             0.48, width * 0.80),
            (TAILLIGHT, "-x +z +y -y -z", -half - 0.012, -half + 0.16, rear_z - 0.10, rear_z + 0.07,
             0.48, width * 0.80),
            (TRIM, "+x -x +y -y +z -z", model.hood - 0.42, model.hood - 0.30, model.belt,
             model.belt + 0.13, 0.93, width + 0.035),
        ):  # fmt: skip
            y0, y1 = sorted((side * width * share, side * over))
            yield boxes((x0, y0, z0), (x1, y1, z1), look, faces=faces.split())
    front, back = half + 0.010, -half - 0.010
    for plate in (
        ((front, -width * 0.42, front_z - 0.07), (0, width * 0.84, 0), (0, 0, 0.11), TRIM),
        ((front, -width * 0.6, 0.36), (0, width * 1.2, 0), (0, 0, 0.12), TRIM),
        ((half + 0.016, -0.26, 0.40), (0, 0.52, 0), (0, 0, 0.11), PLATE),
        ((-half - 0.016, -0.26, rear_z - 0.22), (0, 0, 0.11), (0, 0.52, 0), PLATE),
        ((back, -width * 0.7, 0.34), (0, 0, 0.13), (0, width * 1.4, 0), TRIM),
    ):
        yield parallelograms(*plate)


# ---- Lamps, signs, litter bins and bollards ------------------------------------------------------

STEEL = Look((0.16, 0.17, 0.17), Class.POLE)
LANTERN = Look((0.72, 0.71, 0.66), Class.POLE)
GREY = Look((0.30, 0.31, 0.32), Class.SIGN, spacing=0.5)
WHITE = GREY.tinted((0.75, 0.75, 0.74))
BLUE = GREY.tinted((0.03, 0.11, 0.36))
BLACK = GREY.tinted((0.02, 0.02, 0.02))
RED = GREY.tinted((0.48, 0.03, 0.03))
GREEN = Look((0.05, 0.10, 0.07), Class.OTHER)
CAST_IRON = Look((0.10, 0.10, 0.105), Class.BARRIER)


def _pole(height: float) -> tuple:
    return (tube, (-0.03, 0, -0.05), (-0.03, 0, height), 0.032, STEEL)


def _plate(z: float, width: float, height: float, look: Look, x=0.012, y=0.0) -> tuple:
    """An upright rectangle facing +x."""
    corner = (x, -width / 2 + y, z - height / 2)
    return (parallelograms, corner, (0, width, 0), (0, 0, height), look)


def _rear(z: float, size: float) -> tuple:
    return (parallelograms, (0.0, -size / 2, z - size / 2), (0, 0, size), (0, size, 0), GREY)


# Forms as (builder, its arguments). LAMP: a tapered mast with an arm over the road (towards +y).
LAMP = (
    (tube, (0, 0, -0.05), (0, 0, 0.9), 0.085, STEEL),
    (tube, (0, 0, 0.9), (0, 0, 6.4), 0.055, STEEL),
    (tube, (0, 0, 6.35), (0, 1.5, 6.75), 0.035, STEEL),
    (boxes, (-0.14, 1.35, 6.68), (0.14, 2.05, 6.82), STEEL),
    (parallelograms, (-0.11, 1.4, 6.675), (0, 0.6, 0), (0.22, 0, 0), LANTERN),
    (ball, (0, 0, 6.38), (0.07, 0.07, 0.07), STEEL),
)
LITTER_BIN = (
    (tube, (0, 0, 0.0), (0, 0, 0.85), 0.22, GREEN),
    (disc, (0, 0, 0.85), (0, 0, 1), 0.22, GREEN.tinted((0.02, 0.02, 0.02))),
    (tube, (0, 0, 0.85), (0, 0, 0.92), 0.23, STEEL),
)
BOLLARD = (
    (tube, (0, 0, 0.0), (0, 0, 0.85), 0.06, CAST_IRON),
    (tube, (0, 0, 0.66), (0, 0, 0.76), 0.064, WHITE),
    (ball, (0, 0, 0.85), (0.06, 0.06, 0.05), CAST_IRON),
)
CROSSING_SIGN = (
    _pole(2.75),
    _rear(2.45, 0.62),
    _plate(2.45, 0.64, 0.64, BLUE),
    (triangles, (0.022, -0.2, 2.3), np.array([0.022, 0.2, 2.3]), (0.022, 0.0, 2.66), WHITE),
    _plate(2.40, 0.09, 0.18, BLACK, 0.032),
)
LIMIT_SIGN = (
    _pole(2.85),
    (disc, (0.010, 0, 2.5), (1, 0, 0), 0.31, RED),
    (disc, (0.018, 0, 2.5), (1, 0, 0), 0.235, WHITE),
    (disc, (0, 0, 2.5), (-1, 0, 0), 0.31, GREY),
    _plate(2.5, 0.13, 0.24, BLACK, 0.024, -0.1),
    _plate(2.5, 0.045, 0.14, WHITE, 0.030, -0.1),
    _plate(2.5, 0.13, 0.24, BLACK, 0.024, 0.1),
    _plate(2.5, 0.045, 0.14, WHITE, 0.030, 0.1),
)
PARKING_SIGN = (
    _pole(2.7),
    _rear(2.4, 0.5),
    _plate(2.4, 0.52, 0.52, BLUE),
    _plate(2.4, 0.07, 0.36, WHITE, 0.02, -0.09),  # the letter P
    _plate(2.54, 0.18, 0.07, WHITE, 0.02, 0.02),
    _plate(2.4, 0.18, 0.07, WHITE, 0.02, 0.02),
    _plate(2.47, 0.07, 0.2, WHITE, 0.02, 0.11),
)
SIGNS = (CROSSING_SIGN, CROSSING_SIGN, LIMIT_SIGN, LIMIT_SIGN, PARKING_SIGN)


@joined
def build_furniture(layout: Layout) -> Iterator[Shapes]:
    """Everything man-made that stands on the pavements."""
    rng = stream(layout.parameters, 40)
    places = [(LAMP, x, y, 0.0 if y < 0 else np.pi) for x, y in layout.lamps]
    for form, (x, y) in zip(SIGNS, layout.signs, strict=True):
        places.append((form, x, y, np.pi if y < 0 else 0.0))  # facing the traffic on its side
    places += [(LITTER_BIN, x + rng.uniform(1.2, 2.0), y, 0.0) for x, y in layout.lamps[::2]]
    for y in (ROAD_HALF_M + 0.4, -ROAD_HALF_M - 0.4):
        places += [(BOLLARD, layout.zebra_x + dx, y, 0.0) for dx in (-3.4, 3.4, -4.6, 4.6)]
    for form, x, y, yaw in places:
        shapes = join([build(*arguments) for build, *arguments in form])
        yield shapes.moved((x, y, float(pavement_z(y))), yaw)


# ---- The whole -----------------------------------------------------------------------------------

ROOF_Z_M = 11.5  # of a typical house, for sky light between the fronts
SINK_M = 0.008  # tyres sit this far in the road, as on their contact patch


@dataclass(frozen=True, eq=False)
class MovingBody:
    """A mover's body in its box frame, with its motion."""

    name: str
    label: str
    size_m: tuple[float, float, float]
    body: Body
    motion: Motion


@dataclass(frozen=True, eq=False)
class Street:
    """Everything that is known of a street. parked: name, centre, size and yaw of each car."""

    parameters: StreetParameters
    layout: Layout
    static: Body
    movers: tuple[MovingBody, ...]
    parked: tuple[tuple, ...]


@lru_cache(maxsize=2)
def build_street(parameters: StreetParameters) -> Street:
    """The street of these parameters; the last two are kept."""
    layout = draw_layout(parameters)
    ends = np.array([frame_time_ns(0), frame_time_ns(parameters.frames - 1)])
    rng = stream(parameters, 7)
    builders = (build_ground, build_buildings, build_vegetation, build_furniture)
    parts = [build(layout) for build in builders]
    parked = []
    for number, (x, y) in enumerate(layout.parked):  # each faces its side's traffic
        model, car = draw_car(int(rng.integers(2**31)))
        yaw, ground = 0.0 if y < 0 else np.pi, float(road_z(PARKED_Y_M)) - SINK_M
        parts.append(car.moved((x, y, ground), yaw))
        centre = (float(x), float(y), ground + model.size_m[2] / 2)
        parked.append((f"parked-{number}", centre, model.size_m, yaw))
    shapes = join(parts)
    footprints = [(*at[:2], size[0] / 2, size[1] / 2) for _, at, size, _ in parked]
    lighting = Lighting(
        to_sun=direction_to_sun(parameters.seed),
        eye_path=camera_path(parameters, ends),
        canyon=(-FACADE_M, FACADE_M, ROOF_Z_M),
        footprints=np.array(footprints).reshape(-1, 4),
    )
    static = Body(shapes, build_tree(shapes), lighting)
    movers = tuple(_moving_body(mover, layout, static, ends) for mover in layout.movers)
    return Street(parameters, layout, static, movers, tuple(parked))


def _moving_body(mover: Mover, layout: Layout, static: Body, ends: np.ndarray) -> MovingBody:
    if mover.name.startswith("car"):
        model, shapes = draw_car(mover.seed)
        size, ground, label = model.size_m, float(road_z(mover.y_m)) - SINK_M, "Car"
    else:
        shapes, size = draw_person(mover.seed), PERSON_SIZE_M
        ground, label = float(pavement_z(mover.y_m)), "Pedestrian"
    shapes = shapes.moved((0, 0, -size[2] / 2))
    motion = motion_of(mover, layout, size[2], ground)
    turn = 1.0 if motion.yaw == 0 else -1.0  # the heading is along +x or -x
    flip, centre = np.array([turn, turn, 1.0]), motion.centres[0]
    walls = sorted(turn * (side * FACADE_M - centre[1]) for side in (-1, 1))
    directions = static.lighting.sun_directions()
    origins = np.repeat(motion.centres, len(directions), axis=0)
    shaded = static.tree.occluded(origins, np.tile(directions, (len(motion.centres), 1)))
    lighting = Lighting(
        to_sun=static.lighting.to_sun * flip,
        eye_path=(static.lighting.eye_path - motion.at(ends)[0]) * flip,
        canyon=(walls[0], walls[1], ROOF_Z_M - centre[2]),
        ground_z=-size[2] / 2,
        sunlit=1 - float(shaded.mean()),
    )
    return MovingBody(mover.name, label, size, Body(shapes, build_tree(shapes), lighting), motion)
