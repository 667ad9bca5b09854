"""The assembled street: houses, ground and what stands on it as one static body, and the bodies
that move, each with its light."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import lru_cache

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
    ball,
    boxes,
    cut,
    disc,
    ellipsoids,
    join,
    parallelograms,
    quads,
    triangle,
    tube,
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
from adapters.street.light import Body, Lighting
from adapters.street.raycast import build_tree
from augment.semantics import SemanticClass as Class

# ---- House fronts: windows, doors and shops ------------------------------------------------------
# A front has its own frame: x along the wall, y into the house, z up; its outer face is the plane
# y = 0, seen from y < 0.

REVEAL_M = 0.14  # how deep windows stand in the wall
SURROUND_M = 0.13
GLASS = Look((0.022, 0.026, 0.03), Class.BUILDING, Material.GLASS, backed=True)
SHOP_GLASS = replace(GLASS, material=Material.SHOP)
_FRONT = ("-y", "+x", "-x", "+z", "-z")


@dataclass(frozen=True)
class Facade:
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
    rectangles: np.ndarray, depth_m: float, look: Look, edges: np.ndarray | int = ALL_EDGES
) -> Shapes:
    """Upright panels over (x, z) rectangles [R, 4] at y = depth_m, seen from the street."""
    x0, z0, x1, z1 = np.asarray(rectangles, np.float64).reshape(-1, 4).T
    u, v = xyz(x1 - x0, 0, 0), xyz(0, 0, z1 - z0)
    return parallelograms(xyz(x0, depth_m, z0), u, v, look, edges=edges)


def reveals(opening: Rectangle, depth_m: float, look: Look) -> Shapes:
    """The four inner faces of an opening, from the wall's face to depth_m."""
    x0, z0, x1, z1 = opening
    into, up, along = (0, depth_m, 0), (0, 0, z1 - z0), (x1 - x0, 0, 0)
    shaded = Look(look.rgb, look.semantic, look.material, ambient=0.75)
    corners = [(x0, 0, z0), (x1, 0, z0), (x0, 0, z0), (x0, 0, z1)]
    us, vs = [into, up, along, into], [up, into, into, along]
    return parallelograms(corners, us, vs, shaded)


def glazing(
    opening: Rectangle,
    columns: int,
    rows: int,
    depth_m: float,
    frame: Look,
    bar_m: float = 0.07,
    pane: Look = GLASS,
) -> Shapes:
    """Panes with a frame and bars, filling an opening."""
    x0, z0, x1, z1 = opening
    xs = np.linspace(x0 + bar_m / 2, x1 - bar_m / 2, columns + 1)
    zs = np.linspace(z0 + bar_m / 2, z1 - bar_m / 2, rows + 1)
    if rows == 2:
        zs[1] = zs[0] + 0.68 * (zs[2] - zs[0])  # a fanlight above
    half = bar_m / 2
    panes = [
        (xs[i] + half, zs[j] + half, xs[i + 1] - half, zs[j + 1] - half)
        for i in range(columns)
        for j in range(rows)
    ]
    bars, edges = cut(opening, panes)
    glass = panels(np.array(panes), depth_m, pane)
    glass.variation[:] = 0.37  # one window, one curtain
    return join([panels(bars, depth_m - 0.02, frame, edges), glass])


def window(size_m: tuple[float, float], facade: Facade, fine: bool) -> Shapes:
    """One window with reveals, sill and surround; its opening's lower left corner is the origin."""
    width, height = size_m
    opening = (0.0, 0.0, width, height)
    columns, rows = ((2, 2) if height > 1.7 else (2, 1)) if fine else (1, 1)
    parts = [
        glazing(opening, columns, rows, REVEAL_M, facade.frame),
        reveals(opening, REVEAL_M, facade.trim if facade.has_surround else facade.wall),
        boxes((-0.08, -0.09, -0.08), (width + 0.08, 0.02, 0.0), facade.trim, faces=_FRONT),
    ]
    if facade.has_surround:
        band = SURROUND_M
        low = [(-band, -0.035, 0.0), (width, -0.035, 0.0), (-band, -0.06, height)]
        high = [(0.0, 0, height), (width + band, 0, height), (width + band, 0, height + 0.2)]
        parts.append(boxes(low, high, facade.trim, faces=_FRONT))
    return join(parts)


def window_hole(corner: tuple[float, float], facade: Facade) -> list[Rectangle]:
    """What a window takes out of the wall: its opening, surround and sill."""
    (x, z), (width, height) = corner, facade.window_m
    holes = [(x - 0.08, z - 0.08, x + width + 0.08, z), (x, z, x + width, z + height)]
    if facade.has_surround:
        band = SURROUND_M
        holes += [(x - band, z, x + width + band, z + height)]
        holes += [(x - band, z + height, x + width + band, z + height + 0.2)]
    return holes


def door(opening: Rectangle, facade: Facade) -> Shapes:
    """A panelled door with a fanlight and a step."""
    x0, z0, x1, z1 = opening
    split = z1 - 0.55
    leaf, light = (x0 + 0.06, z0, x1 - 0.06, split), (x0 + 0.06, split + 0.06, x1 - 0.06, z1 - 0.06)
    low, high = leaf[0] + 0.14, leaf[2] - 0.14
    fields = [(low, z0 + 0.25, high, z0 + 0.95), (low, z0 + 1.1, high, split - 0.16)]
    frames, edges = cut(opening, [leaf, light])
    stiles, stile_edges = cut(leaf, fields)
    dark = facade.accent.tinted(np.array(facade.accent.rgb) * 0.7)
    return join([
        panels(frames, REVEAL_M - 0.02, facade.frame, edges),
        panels(stiles, REVEAL_M, facade.accent, stile_edges),
        panels(np.array(fields), REVEAL_M + 0.015, dark),
        panels(np.array([light]), REVEAL_M, GLASS),
        reveals(opening, REVEAL_M, facade.wall),
        boxes((x0 - 0.1, -0.35, -0.3), (x1 + 0.1, REVEAL_M, z0), facade.base),
    ])  # fmt: skip


def shop_front(opening: Rectangle, facade: Facade, awning: bool) -> Shapes:
    """A shop: plinth, large panes, a glass door, a sign above and perhaps an awning."""
    x0, z0, x1, z1 = opening
    depth = 0.18
    door_x = x1 - 1.25
    plinth, entry = (x0, z0, door_x, z0 + 0.5), (door_x, z0, x1, z1)
    show = (x0, z0 + 0.5, door_x, z1)
    sign_z, columns = z1 + 0.08, max(1, round((door_x - x0) / 1.7))
    low, high = (x0 - 0.1, -0.12, sign_z), (x1 + 0.1, 0.02, sign_z + 0.62)
    parts = [
        panels(np.array([plinth]), depth - 0.04, facade.accent),
        glazing(show, columns, 1, depth, facade.accent, 0.09, SHOP_GLASS),
        glazing(entry, 1, 2, depth, facade.accent, 0.11),
        reveals(opening, depth, facade.accent),
        boxes(low, high, facade.accent, faces=_FRONT),
        _lettering(x0, x1, sign_z, facade),
    ]
    if awning:
        parts.append(_awning(x0, x1, z1 + 0.05, facade))
    return join(parts)


def _lettering(x0: float, x1: float, z: float, facade: Facade) -> Shapes:
    """Light blocks on the sign that read as letters from afar."""
    middle, pitch = (x0 + x1) / 2, 0.32
    count = int(min(12, (x1 - x0 - 0.8) / pitch))
    starts = middle + (np.arange(count) - count / 2) * pitch
    tall = 0.18 + 0.10 * ((np.arange(count) * 5) % 3 == 0)
    sides = np.broadcast_arrays(starts, z + 0.17, starts + 0.2, z + 0.17 + tall)
    rectangles = np.stack(sides, 1)
    return panels(rectangles[(np.arange(count) % 5) != 3], -0.135, facade.trim)


def _awning(x0: float, x1: float, z: float, facade: Facade) -> Shapes:
    """Striped cloth, sloping out over the pavement, with a hem."""
    count = max(4, round((x1 - x0) / 0.45))
    edges = np.linspace(x0, x1, count + 1)[:-1]
    slope, hem = np.array([0.0, 1.2, 0.55]), np.array([0.0, 0.0, -0.2])
    parts = []
    for start, look in ((0, facade.accent), (1, facade.trim)):
        x = edges[start::2]
        u = ((x1 - x0) / count, 0.0, 0.0)
        top = xyz(x, -1.25, z - 0.55)
        parts.append(parallelograms(top, u, slope, look))
        parts.append(parallelograms(top + hem, u, -hem, look))
    return join(parts)


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
_PANE = Look((0.10, 0.12, 0.14), Class.BUILDING)
_LEDGE = ("-y", "+z", "-z", "+x", "-x")
ROOFS = ((0.24, 0.10, 0.065), (0.13, 0.12, 0.125), (0.19, 0.09, 0.06))


def build_buildings(layout: Layout) -> Shapes:
    """Both rows of houses, those that close the street's ends, and some behind."""
    middle = layout.parameters.path_length_m / 2
    parts = []
    for plot in layout.plots:
        yaw = 0.0 if plot.side > 0 else np.pi
        corner = (plot.x0 if plot.side > 0 else plot.x1, plot.side * FACADE_M, 0.0)
        reach = abs((plot.x0 + plot.x1) / 2 - middle) - middle
        width = plot.x1 - plot.x0
        built = _garden(width) if plot.is_garden else _house(plot.seed, width, reach < 32)
        parts.append(built.moved(corner, yaw))
    reach = CROSS_STREET_M + 4.6
    ends = ((layout.x1 + reach, -np.pi / 2), (layout.x0 - reach, np.pi / 2))
    for number, (x, yaw) in enumerate(ends):
        rng = stream(layout.parameters, 20, number)
        start = -56.0
        while start < 56.0:
            width = rng.uniform(9.0, 14.0)
            house = _house(int(rng.integers(2**31)), width, False)
            y = start + width if yaw < 0 else start
            parts.append(house.moved((x, y, 0.0), yaw))
            start += width
    parts.append(_second_row(layout))
    return join(parts)


def draw_facade(rng: np.random.Generator) -> Facade:
    """Colours and measures of one house."""
    rgb, material = WALLS[rng.integers(len(WALLS))]
    rgb = np.array(rgb) * rng.uniform(0.88, 1.06)
    stone = Look((0.60, 0.57, 0.51), Class.BUILDING)
    wall = Look(tuple(rgb), Class.BUILDING, material, backed=True)
    base = Look(tuple(rgb * 0.35 + 0.10), Class.BUILDING, Material.STONE)
    white = rng.random() < 0.7 or material == Material.BRICK
    return Facade(
        wall=wall,
        base=base,
        trim=stone.tinted((0.74, 0.72, 0.67)) if white else stone,
        frame=stone.tinted((0.78, 0.77, 0.75) if rng.random() < 0.7 else (0.07, 0.065, 0.06)),
        accent=Look(ACCENTS[rng.integers(len(ACCENTS))], Class.BUILDING),
        window_m=(float(rng.uniform(1.05, 1.4)), float(rng.uniform(1.55, 1.95))),
        floor_m=float(rng.uniform(3.0, 3.4)),
        ground_m=float(rng.uniform(3.75, 4.1)),
        has_surround=bool(rng.random() < 0.55),
        has_shop=bool(rng.random() < 0.5),
    )


def _house(seed: int, width: float, fine: bool) -> Shapes:
    """A house on x in [0, width], its front at y = 0."""
    rng = np.random.default_rng(seed)
    facade = draw_facade(rng)
    floors = int(rng.integers(2, 4))
    eaves = facade.ground_m + floors * facade.floor_m + 0.35
    count = max(2, round(width / rng.uniform(2.5, 3.1)))
    pitch = width / count
    holes: list[Rectangle] = []
    parts = [_ground_floor(rng, facade, width, count, holes, fine)]

    places = []
    for j, i in itertools.product(range(floors), range(count)):
        x, z = (
            (i + 0.5) * pitch - facade.window_m[0] / 2,
            facade.ground_m + j * facade.floor_m + 0.75,
        )
        holes += window_hole((x, z), facade)
        places.append((x, 0.0, z))
    parts.append(window(facade.window_m, facade, fine).repeated(np.array(places)))

    ledge = (facade.ground_m + 0.12, facade.ground_m + 0.3, 0.09)
    for z0, z1, reach in (ledge, (eaves - 0.32, eaves, 0.28)):
        holes.append((0.0, z0, width, z1))
        parts.append(boxes((0.0, -reach, z0), (width, 0.0, z1), facade.trim, faces=_LEDGE))
    holes.append((0.0, BASE_M, width, 0.5))
    base, edges = cut((0.0, BASE_M, width, 0.5), [h for h in holes[:-1] if h[1] < 0.5])
    parts.append(panels(base, -0.0, facade.base, edges))
    wall, edges = cut((0.0, 0.5, width, eaves), holes)
    parts.append(panels(wall, 0.0, facade.wall, edges))
    parts += [_back(facade, width, eaves), _roof(rng, facade, width, eaves)]
    inner = Look(facade.wall.rgb, Class.BUILDING)
    parts.append(panels(np.array([(0.0, BASE_M, width, eaves)]), INNER_WALL_M, inner))
    zinc = Look((0.22, 0.22, 0.215), Class.BUILDING)
    parts.append(tube((0.12, -0.09, 0.0), (0.12, -0.09, eaves - 0.2), 0.05, zinc))  # a rainpipe
    return join(parts)


def _ground_floor(
    rng: np.random.Generator, facade: Facade, width: float, count: int, holes: list, fine: bool
) -> Shapes:
    """Shop, or a door between windows; adds its holes to the wall's."""
    floor = float(pavement_z(FACADE_M)) + 0.02
    if facade.has_shop:
        opening = (0.45, floor, width - 0.45, floor + 2.75)
        holes.append(opening)
        holes.append((0.35, opening[3] + 0.08, width - 0.35, opening[3] + 0.70))
        return shop_front(opening, facade, bool(rng.random() < 0.45))
    pitch = width / count
    entry = int(rng.integers(count))
    parts, places = [], []
    for i in range(count):
        middle = (i + 0.5) * pitch
        if i == entry:
            opening = (middle - 0.58, floor + 0.12, middle + 0.58, floor + 2.95)
            holes.append(opening)
            holes.append((opening[0] - 0.1, BASE_M, opening[2] + 0.1, opening[1]))
            parts.append(door(opening, facade))
        else:
            corner = (middle - facade.window_m[0] / 2, 1.15)
            holes += window_hole(corner, facade)
            places.append((corner[0], 0.0, corner[1]))
    if places:
        parts.append(window(facade.window_m, facade, fine).repeated(np.array(places)))
    return join(parts)


def _back(facade: Facade, width: float, eaves: float) -> Shapes:
    """Side and back walls, plain."""
    wall = Look(facade.wall.rgb, Class.BUILDING, facade.wall.material, spacing=1.6)
    return boxes((0.0, 0.0, BASE_M), (width, DEPTH_M, eaves), wall, faces=("+x", "-x", "+y"))


def _roof(rng: np.random.Generator, facade: Facade, width: float, eaves: float) -> Shapes:
    if rng.random() < 0.35:
        return _flat_roof(facade, width, eaves)
    tiles = Look(ROOFS[rng.integers(len(ROOFS))], Class.BUILDING, Material.TILES, spacing=1.3)
    rise, half = (DEPTH_M / 2) * float(np.tan(np.radians(rng.uniform(30, 40)))), DEPTH_M / 2
    over = 0.35
    drop = over * rise / half
    edge_z = eaves - drop + 0.12
    slope = np.array([0.0, half + over, rise + drop])
    low, high = (0.0, -over - 0.12, edge_z - 0.14), (width, -over + 0.02, edge_z + 0.0)
    gutter = facade.trim.tinted((0.25, 0.24, 0.23))
    under = (0, -over, edge_z - 0.02)
    parts = [
        parallelograms((0.0, -over, edge_z), (width, 0, 0), slope, tiles),
        parallelograms((width, DEPTH_M + over, edge_z), (-width, 0, 0), slope * [1, -1, 1], tiles),
        boxes(low, high, gutter, faces=_LEDGE, edges=0),
        parallelograms(under, (0, over, 0), (width, 0, 0), facade.trim, edges=0),
    ]
    gable = Look(facade.wall.rgb, Class.BUILDING, facade.wall.material, spacing=0.8)
    for x, flip in ((0.0, True), (width, False)):
        a, b, c = (x, 0.0, eaves), (x, DEPTH_M, eaves), (x, half, eaves + rise + 0.1)
        parts.append(triangle(np.array([a, c, b] if flip else [a, b, c]), gable))
    brick = Look((0.33, 0.16, 0.11), Class.BUILDING, Material.BRICK)
    for x in (0.7, width - 1.5)[: int(rng.integers(1, 3))]:
        top = eaves + rise + 0.9
        parts.append(boxes((x, half - 0.9, eaves + rise * 0.6), (x + 0.8, half - 0.3, top), brick))
    return join(parts)


def _flat_roof(facade: Facade, width: float, eaves: float) -> Shapes:
    """A roof behind a parapet."""
    top = eaves + 0.75
    gravel = Look((0.30, 0.29, 0.27), Class.BUILDING, Material.ASPHALT, spacing=1.6)
    parapet = Look(facade.wall.rgb, Class.BUILDING, facade.wall.material)
    return join([
        parallelograms((0, 0.3, eaves), (width, 0, 0), (0, DEPTH_M - 0.3, 0), gravel),
        boxes((0, 0, eaves), (width, 0.3, top), parapet, faces=("-y", "+y", "+x", "-x")),
        boxes((-0.0, -0.07, top), (width, 0.37, top + 0.1), facade.trim, faces=_LEDGE),
    ])  # fmt: skip


def _garden(width: float) -> Shapes:
    """A low wall with a hedge behind it, across a gap between two houses."""
    brick = Look((0.34, 0.17, 0.12), Class.BARRIER, Material.BRICK)
    hedge = Look((0.075, 0.13, 0.03), Class.VEGETATION, Material.LEAVES)
    stone = Look((0.52, 0.50, 0.46), Class.BARRIER)
    return join([
        boxes((0, 0.0, BASE_M), (width, 0.3, 0.95), brick, faces=("-y", "+y", "+x", "-x")),
        boxes((0, -0.05, 0.95), (width, 0.35, 1.03), stone, faces=_LEDGE),
        boxes((0.05, 0.5, 0.0), (width - 0.05, 1.5, 1.75), hedge, edges=0),
    ])  # fmt: skip


def _second_row(layout: Layout) -> Shapes:
    """Plain houses behind the gardens, which close the view through the gaps."""
    rng = stream(layout.parameters, 21)
    parts = []
    for side in (1, -1):
        x = layout.x0 - 4.0
        while x < layout.x1 + 4.0:
            width, height = rng.uniform(9, 15), rng.uniform(6.5, 9.5)
            facade = draw_facade(rng)
            y = side * rng.uniform(36, 44)
            wall = Look(facade.wall.rgb, Class.BUILDING, facade.wall.material)
            columns = np.arange(1.2, width - 1.6, 2.6)
            holes = [(w, z, w + 1.2, z + 1.5) for z in (1.2, 4.2) for w in columns]
            front, edges = cut((0.0, BASE_M, width, height), holes)
            built = join([
                panels(front, 0.0, wall, edges & np.uint8(U0 | U1 | V1)),
                panels(np.array(holes), 0.1, _PANE),
                *[reveals(h, 0.1, wall) for h in holes],
                _back(facade, width, height),
                _roof(rng, facade, width, height),
            ])  # fmt: skip
            corner = (x if side > 0 else x + width, y, 0.0)
            parts.append(built.moved(corner, 0.0 if side > 0 else np.pi))
            x += width + rng.uniform(4, 12)
    return join(parts)


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
    parts = [*_carriageway(layout), *_pavements(layout), *_cross_streets(layout)]
    return join([*parts, _land(layout)])


def _sloped(
    rectangles: np.ndarray, slope: float, z0: float, look: Look, edges: np.ndarray | int = ALL_EDGES
) -> Shapes:
    """Panels over rectangles [R, 4] on the plane z = z0 + slope y, facing up."""
    x0, y0, x1, y1 = rectangles.T
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
    return _sloped(pieces, 0.0, TERRAIN_Z_M, GRASS, edges & np.uint8(V0 | V1))


# ---- A person in mid-stride: tubes and ellipsoids, one rigid body --------------------------------
# Frame: x forward, y left, z up, origin on the ground between the feet.

PERSON_SIZE_M = (0.92, 0.66, 1.80)
SKIN = ((0.52, 0.31, 0.21), (0.28, 0.15, 0.09), (0.60, 0.40, 0.29))
COATS = ((0.30, 0.05, 0.05), (0.05, 0.10, 0.22), (0.36, 0.31, 0.22), (0.06, 0.14, 0.09))
TROUSERS = ((0.035, 0.045, 0.08), (0.05, 0.05, 0.05), (0.20, 0.17, 0.12))


def draw_person(seed: int) -> Shapes:
    """A person with clothes drawn from the seed."""
    rng = np.random.default_rng(seed)
    plain = Look((0.5, 0.5, 0.5), Class.PEDESTRIAN, spacing=0.7)
    skin = plain.tinted(SKIN[rng.integers(len(SKIN))])
    coat = plain.tinted(COATS[rng.integers(len(COATS))])
    legs = plain.tinted(TROUSERS[rng.integers(len(TROUSERS))])
    hair = plain.tinted(np.array((0.03, 0.02, 0.015)) * rng.uniform(1, 4))
    shoes = plain.tinted((0.03, 0.028, 0.025))
    parts = [
        _tilted((0.01, 0, 1.20), (0.125, 0.20, 0.33), 0.06, coat),
        ball((0.0, 0, 0.93), (0.125, 0.175, 0.16), legs),
        ball((0.035, 0, 1.635), (0.098, 0.08, 0.125), skin),
        ball((0.012, 0, 1.67), (0.105, 0.09, 0.105), hair),
        tube((0.01, 0, 1.46), (0.02, 0, 1.56), 0.055, skin),
    ]
    for side in (1, -1):  # the left leg steps forward
        y, phase = side * 0.095, side
        knee = np.array([0.10 * phase + 0.06, y, 0.50])
        foot = np.array([0.27 * phase - (0.06 if phase < 0 else 0), y, 0.10 + 0.03 * (phase < 0)])
        shoulder = np.array([0.0, side * 0.19, 1.41])
        elbow = np.array([-0.13 * phase, side * 0.255, 1.15])
        hand = np.array([-0.20 * phase + 0.12, side * 0.245, 0.93])
        parts += [
            tube((0, y, 0.93), knee, 0.085, legs),
            tube(knee, foot, 0.062, legs),
            ball(knee, (0.072, 0.07, 0.075), legs),
            ball(foot + np.array([0.055, 0, -0.04]), (0.135, 0.05, 0.055), shoes),
            tube(shoulder, elbow, 0.052, coat),
            tube(elbow, hand, 0.043, coat),
            ball(shoulder, (0.062, 0.058, 0.068), coat),
            ball(elbow, (0.05, 0.05, 0.05), coat),
            ball(hand, (0.045, 0.03, 0.055), skin),
        ]
    return join(parts)


def _tilted(centre: tuple, radii: tuple, angle_rad: float, look: Look) -> Shapes:
    """An ellipsoid leaning forward."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    turn = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    return ellipsoids(np.array([centre]), (turn * np.array(radii)[:, None])[None], look)


# ---- Trees: a trunk with a few boughs, and a crown of many small leafy blobs around a dense core -

BARK = Look((0.13, 0.10, 0.075), Class.VEGETATION, Material.BARK)
LEAF = Look((0.12, 0.21, 0.04), Class.VEGETATION, Material.LEAF)
CORE = Look((0.045, 0.08, 0.02), Class.VEGETATION, Material.LEAVES, ambient=0.4, spacing=3.0)
WOOD = Look((0.07, 0.12, 0.035), Class.VEGETATION, Material.LEAVES, spacing=2.2)
NEAR_LEAVES, MIDDLE_LEAVES, FAR_LEAVES, GARDEN_LEAVES = 2600, 1200, 300, 80


def build_vegetation(layout: Layout) -> Shapes:
    """Street trees, garden trees behind the houses, and woods far out."""
    rng = stream(layout.parameters, 30)
    middle = layout.parameters.path_length_m / 2
    parts = []
    for x, y in layout.trees:
        beyond = max(abs(x - middle) - middle, 0.0)  # along the street from the drive
        leaves = NEAR_LEAVES if beyond < 10 else (MIDDLE_LEAVES if beyond < 28 else FAR_LEAVES)
        parts.append(_tree(rng, 1.0, leaves).moved((x, y, float(pavement_z(y)) - 0.03)))
    for _ in range(24):
        x = rng.uniform(layout.x0 - 8, layout.x1 + 8)
        y = rng.choice([-1, 1]) * rng.uniform(24, 33)
        parts.append(_tree(rng, rng.uniform(1.1, 1.5), GARDEN_LEAVES).moved((x, y, 0.0)))
    parts.append(_woods(rng, layout))
    return join(parts)


def _tree(rng: np.random.Generator, size: float, leaves: int) -> Shapes:
    """One tree at the origin; leaves: how many tufts its crown has."""
    height = size * rng.uniform(3.9, 4.6)  # of the crown's middle
    radii = size * np.array([1.0, 1.0, 1.15]) * rng.uniform(1.55, 1.95)
    lean = rng.uniform(-0.12, 0.12, 2)
    top = np.array([*lean, height])
    fork = top * [1, 1, 0.62]
    parts = [
        tube((0, 0, -0.1), fork * 0.5, 0.135 * size, BARK),
        tube(fork * 0.48, fork, 0.115 * size, BARK),
    ]
    for k in range(4):
        angle = rng.uniform(0, 0.8) + k * np.pi / 2
        reach = np.array([np.cos(angle), np.sin(angle), 0.9]) * radii * 0.62
        parts.append(tube(fork * 0.98, fork + reach, 0.055 * size, BARK))
    core = radii * 0.62
    parts.append(ellipsoids(top[None], np.diag(core)[None], CORE))
    parts.append(_crown(rng, top, radii, leaves))
    return join(parts)


def _crown(rng: np.random.Generator, centre: np.ndarray, radii: np.ndarray, leaves: int) -> Shapes:
    """Tufts of leaves on boughs: round lumps around a core, lighter towards the outside and top."""
    lumps = 34
    step = np.arange(lumps)
    height = 1 - (2 * step + 1) / lumps * 0.93  # the underside stays open around the trunk
    angle = step * 2.39996 + rng.uniform(0, 6)
    flat = np.sqrt(1 - height**2)
    lump = np.stack([flat * np.cos(angle), flat * np.sin(angle), height], 1)
    lump += rng.normal(size=(lumps, 3)) * 0.12
    lump /= np.linalg.norm(lump, axis=1, keepdims=True)
    lump_centre = lump * rng.uniform(0.60, 0.80, (lumps, 1))
    lump_radius = rng.uniform(0.32, 0.44, lumps)
    owner = rng.integers(lumps, size=leaves)
    local = _directions(rng, leaves) + 0.75 * lump[owner]  # more of them on a lump's outside
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    spot = (
        lump_centre[owner] + local * (lump_radius[owner] * rng.uniform(0.7, 1.08, leaves))[:, None]
    )
    outward = spot / np.linalg.norm(spot, axis=1, keepdims=True)
    normal = local + 0.5 * outward + 0.45 * rng.normal(size=(leaves, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    size = 2.6 * radii.mean() / np.sqrt(leaves) * rng.uniform(0.75, 1.3, leaves)
    u = np.cross(normal, rng.normal(size=(leaves, 3)))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    axes = np.stack([u, np.cross(normal, u) * 0.72, normal * 0.22], 1) * size[:, None, None]
    shapes = ellipsoids(centre + spot * radii, axes, LEAF)
    shapes.shading[:, 0] = normal
    depth = np.clip((np.linalg.norm(spot, axis=1) - 0.6) / 0.45, 0, 1)
    shapes.ambient[:] = 0.42 + 0.38 * depth + 0.22 * np.clip(outward[:, 2], -0.4, 1)
    shapes.variation[:] = rng.random(leaves)
    return shapes


def _directions(rng: np.random.Generator, count: int) -> np.ndarray:
    """Unit vectors [count, 3], evenly over the sphere."""
    out = rng.normal(size=(count, 3))
    return out / np.linalg.norm(out, axis=1, keepdims=True)


def _woods(rng: np.random.Generator, layout: Layout) -> Shapes:
    """Big loose crowns at the edge of the land, which hide where it ends."""
    count = 130
    angle = rng.uniform(0, 2 * np.pi, count)
    radius = rng.uniform(150, 215, count)
    middle = (layout.x0 + layout.x1) / 2
    stretch = 1 + (layout.x1 - layout.x0) / 2 / 200
    size = rng.uniform(5.0, 9.0, count)
    centres = np.stack(
        [middle + stretch * radius * np.cos(angle), radius * np.sin(angle), 0.55 * size], 1
    )
    axes = np.stack([np.diag([s * 1.5, s * 1.5, s * 0.85]) for s in size])
    shapes = ellipsoids(centres, axes, WOOD)
    shapes.variation[:] = rng.random(count)
    return shapes


# ---- Cars: a lofted body with smooth plates, a glasshouse on top, wheels and lights --------------
# Car frame: x forward, y left, z up, origin on the ground under the middle.

PAINTS = (
    (0.42, 0.42, 0.43), (0.05, 0.055, 0.06), (0.62, 0.62, 0.61),
    (0.30, 0.02, 0.02), (0.03, 0.07, 0.20), (0.16, 0.17, 0.18),
    (0.05, 0.13, 0.09), (0.36, 0.26, 0.06), (0.20, 0.29, 0.36),
)  # fmt: skip
CAR_SPACING = 0.6  # cars draw the eye
CAR_GLASS = Look((0.012, 0.014, 0.016), Class.VEHICLE, Material.PAINT, 0.8, CAR_SPACING)
TYRE = Look((0.022, 0.022, 0.023), Class.VEHICLE, spacing=CAR_SPACING)
ARCH = Look((0.008, 0.008, 0.008), Class.VEHICLE, spacing=CAR_SPACING)
RIM = Look((0.46, 0.46, 0.47), Class.VEHICLE, Material.RIM, spacing=CAR_SPACING)
TRIM = Look((0.03, 0.03, 0.032), Class.VEHICLE, spacing=CAR_SPACING)
HEADLIGHT = Look((0.72, 0.74, 0.78), Class.VEHICLE, spacing=CAR_SPACING)
TAILLIGHT = Look((0.42, 0.015, 0.015), Class.VEHICLE, spacing=CAR_SPACING)
PLATE = Look((0.72, 0.71, 0.62), Class.VEHICLE, spacing=CAR_SPACING)
WHEEL_RADIUS_M = 0.32


@dataclass(frozen=True)
class CarModel:
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
    rgb = PAINTS[rng.integers(len(PAINTS))]
    paint = Look(rgb, Class.VEHICLE, Material.PAINT, spacing=CAR_SPACING)
    parts = [_body(model, paint), _glasshouse(model, paint), *_wheels(model), *_details(model)]
    return model, join(parts)


def _body(model: CarModel, paint: Look) -> Shapes:
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
    rise = top - low
    # (share of the half width, share of the height) around one side of a section, from the sill up.
    lower = ((0.90, 0), (0.97, 0.10), (1.0, 0.42), (0.985, 0.72))
    profile = np.array([*lower, (0.94, 0.91), (0.86, 0.985), (0.45, 1.03)])
    y, z = width[:, None] * profile[:, 0], low[:, None] + rise[:, None] * profile[:, 1]
    side = np.stack([*np.broadcast_arrays(x[:, None], y, z)], -1)
    # From the right sill over to the left sill.
    ring = np.concatenate([side * [1, -1, 1], side[:, ::-1]], 1)
    caps = []
    for index, outward in ((0, -1), (-1, 1)):
        count = len(profile)
        right, left = ring[index, :count], ring[index, ::-1][:count]
        corners = np.stack([right[:-1], left[:-1], left[1:], right[1:]], 1)
        caps.append(quads(corners if outward > 0 else corners[:, ::-1], paint))
    return join([_loft(ring, paint), *caps])


def _loft(rings: np.ndarray, look: Look) -> Shapes:
    """A smooth surface through rings [X, M, 3], facing outwards if rings run right to left."""
    along = np.gradient(rings, axis=0)
    around = np.gradient(rings, axis=1)
    normals = np.cross(along, around)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    corners, bent = (
        np.stack([g[:-1, :-1], g[1:, :-1], g[1:, 1:], g[:-1, 1:]], 2).reshape(-1, 4, 3)
        for g in (rings, normals)
    )
    return quads(corners, look, normals=bent)


def _glasshouse(model: CarModel, paint: Look) -> Shapes:
    """Windscreen, side windows with pillars, rear window and roof."""
    base, top = model.width / 2 * 0.89, model.width / 2 * 0.70
    z0, z1 = model.belt - 0.02, model.roof

    def side_point(s: float, t: float, sign: int) -> np.ndarray:
        """s from rear to front, t from belt to roof."""
        rear = model.tail + (model.roof_rear - model.tail) * t
        front = model.hood + (model.roof_front - model.hood) * t
        bulge = 0.05 * t * (1 - t) * 4
        y = sign * (base + (top - base) * t**1.3 + bulge)
        return np.array([rear + (front - rear) * s, y, z0 + (z1 - z0) * t])

    parts = []
    levels = (0.0, 0.09, 0.50, 0.86, 1.0)
    cuts = (0.0, 0.06, 0.30, 0.36, 0.53, 0.58, 0.78, 0.93, 1.0)
    clear = {(i, j) for i in (1, 3, 5, 6) for j in (1, 2)}
    panes = list(itertools.product(range(len(cuts) - 1), range(len(levels) - 1)))
    for look, is_clear in ((CAR_GLASS, True), (paint, False)):
        corners = []
        for (i, j), sign in itertools.product(panes, (1, -1)):
            if ((i, j) in clear) == is_clear:
                a, b, c, d = cuts[i], cuts[i + 1], levels[j], levels[j + 1]
                loop = [side_point(*q, sign) for q in ((a, c), (b, c), (b, d), (a, d))]
                corners.append(loop[::-sign])
        parts.append(quads(np.array(corners), look))
    for s, sign in ((1.0, 1), (0.0, -1)):  # windscreen, rear window
        for look, (u0, u1), chosen in (
            (CAR_GLASS, (0.06, 0.94), (1, 2)),
            (paint, (0.06, 0.94), (0, 3)),
            (paint, (0.0, 0.06), (0, 1, 2, 3)),
            (paint, (0.94, 1.0), (0, 1, 2, 3)),
        ):
            corners = []
            for j in chosen:
                loop = []
                for u, k in ((u0, 0), (u1, 0), (u1, 1), (u0, 1)):
                    left, right = (side_point(s, levels[j + k], side) for side in (-1, 1))
                    loop.append(left + (right - left) * u)
                corners.append(loop[::sign])
            parts.append(quads(np.array(corners), look))
    parts.append(_car_roof(model, paint, top))
    return join(parts)


def _car_roof(model: CarModel, paint: Look, half_width: float) -> Shapes:
    """A gently domed roof."""
    x = np.linspace(model.roof_rear, model.roof_front, 7)
    share = np.linspace(-1, 1, 7)
    dome = 0.03 * (1 - share[None, :] ** 2) * np.sin(np.linspace(0, np.pi, 7))[:, None] ** 0.5
    z = model.roof + dome * 0.6
    return _loft(np.stack([*np.broadcast_arrays(x[:, None], share * half_width, z)], -1), paint)


def _wheels(model: CarModel) -> list[Shapes]:
    parts = []
    radius, reach = WHEEL_RADIUS_M, model.width / 2
    for x in (model.length * 0.305, -model.length * 0.295):
        for side in (1, -1):
            y, out = side * (reach - 0.005), (0.0, float(side), 0.0)
            inner = (x, side * (reach - 0.24), radius)
            parts += [
                disc((x, side * (reach + 0.012), radius + 0.03), out, radius + 0.065, ARCH),
                tube(inner, (x, y + side * 0.028, radius), radius, TYRE),
                disc((x, y + side * 0.028, radius), out, radius, TYRE),
                disc((x, y + side * 0.036, radius), out, radius * 0.68, RIM),
            ]
    return parts


def _details(model: CarModel) -> list[Shapes]:
    half, width = model.length / 2, model.width / 2
    front_z, rear_z = model.belt - 0.35, model.belt - 0.20
    parts = []
    for side in (1, -1):
        y0, y1 = sorted((side * width * 0.48, side * width * 0.80))
        low, high = (half - 0.16, y0, front_z - 0.06), (half + 0.012, y1, front_z + 0.07)
        parts.append(boxes(low, high, HEADLIGHT, faces=("+x", "+z", "+y", "-y", "-z")))
        low, high = (-half - 0.012, y0, rear_z - 0.10), (-half + 0.16, y1, rear_z + 0.07)
        parts.append(boxes(low, high, TAILLIGHT, faces=("-x", "+z", "+y", "-y", "-z")))
        y0, y1 = sorted((side * width * 0.93, side * (width + 0.035)))  # a mirror
        low, high = (model.hood - 0.42, y0, model.belt), (model.hood - 0.30, y1, model.belt + 0.13)
        parts.append(boxes(low, high, TRIM, faces=("+x", "-x", "+y", "-y", "+z", "-z")))
    front, back = half + 0.010, -half - 0.010
    plates = (  # grille, plates, bumper
        ((front, -width * 0.42, front_z - 0.07), (0, width * 0.84, 0), (0, 0, 0.11), TRIM),
        ((front, -width * 0.6, 0.36), (0, width * 1.2, 0), (0, 0, 0.12), TRIM),
        ((half + 0.016, -0.26, 0.40), (0, 0.52, 0), (0, 0, 0.11), PLATE),
        ((-half - 0.016, -0.26, rear_z - 0.22), (0, 0, 0.11), (0, 0.52, 0), PLATE),
        ((back, -width * 0.7, 0.34), (0, 0, 0.13), (0, width * 1.4, 0), TRIM),
    )
    return parts + [parallelograms(*plate) for plate in plates]


# ---- Lamps, signs, litter bins and bollards ------------------------------------------------------

STEEL = Look((0.16, 0.17, 0.17), Class.POLE)
LANTERN = Look((0.72, 0.71, 0.66), Class.POLE)
GREY = Look((0.30, 0.31, 0.32), Class.SIGN, spacing=0.5)
WHITE = Look((0.75, 0.75, 0.74), Class.SIGN, spacing=0.5)
BLUE = Look((0.03, 0.11, 0.36), Class.SIGN, spacing=0.5)
BLACK = Look((0.02, 0.02, 0.02), Class.SIGN, spacing=0.5)
RED = Look((0.48, 0.03, 0.03), Class.SIGN, spacing=0.5)
GREEN = Look((0.05, 0.10, 0.07), Class.OTHER)
CAST_IRON = Look((0.10, 0.10, 0.105), Class.BARRIER)


def build_furniture(layout: Layout) -> Shapes:
    """Everything man-made that stands on the pavements."""
    rng = stream(layout.parameters, 40)
    lamp, bollard, litter_bin = (
        join([build(*arguments) for build, *arguments in form])
        for form in (LAMP, BOLLARD, LITTER_BIN)
    )
    places: list[tuple[Shapes, float, float, float]] = []  # what, x, y, yaw
    places += [(lamp, x, y, 0.0 if y < 0 else np.pi) for x, y in layout.lamps]
    signs = [_crossing_sign(), _crossing_sign(), _limit_sign(), _limit_sign(), _parking_sign()]
    for number, (x, y) in enumerate(layout.signs):  # they face the traffic on their own side
        places.append((signs[number % 5], x, y, np.pi if y < 0 else 0.0))
    places += [(litter_bin, x + rng.uniform(1.2, 2.0), y, 0.0) for x, y in layout.lamps[::2]]
    for y in (ROAD_HALF_M + 0.4, -ROAD_HALF_M - 0.4):
        places += [(bollard, layout.zebra_x + dx, y, 0.0) for dx in (-3.4, 3.4, -4.6, 4.6)]
    return join([form.moved((x, y, float(pavement_z(y))), yaw) for form, x, y, yaw in places])


# Forms as (builder, its arguments). A tapered mast with an arm over the road (towards +y):
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


def _pole(height: float) -> Shapes:
    return tube((-0.03, 0, -0.05), (-0.03, 0, height), 0.032, STEEL)


def _plate(z: float, width: float, height: float, look: Look, x: float = 0.012) -> Shapes:
    """An upright rectangle facing +x."""
    corner = (x, -width / 2, z - height / 2)
    return parallelograms(corner, (0, width, 0), (0, 0, height), look)


def _rear(z: float, size: float) -> Shapes:
    corner = (0.0, -size / 2, z - size / 2)
    return parallelograms(corner, (0, 0, size), (0, size, 0), GREY)


def _crossing_sign() -> Shapes:
    figure = np.array([[0.022, -0.2, 2.3], [0.022, 0.2, 2.3], [0.022, 0.0, 2.66]])
    plates = (_plate(2.45, 0.64, 0.64, BLUE), triangle(figure, WHITE))
    return join([_pole(2.75), _rear(2.45, 0.62), *plates, _plate(2.40, 0.09, 0.18, BLACK, 0.032)])


def _limit_sign() -> Shapes:
    discs = ((0.010, 1, 0.31, RED), (0.018, 1, 0.235, WHITE), (0, -1, 0.31, GREY))
    parts = [disc((x, 0, 2.5), (facing, 0, 0), radius, look) for x, facing, radius, look in discs]
    for y in (-0.1, 0.1):
        parts.append(_plate(2.5, 0.13, 0.24, BLACK, 0.024).moved((0, y, 0)))
        parts.append(_plate(2.5, 0.045, 0.14, WHITE, 0.030).moved((0, y, 0)))
    return join([_pole(2.85), *parts])


def _parking_sign() -> Shapes:
    parts = [_pole(2.7), _rear(2.4, 0.5), _plate(2.4, 0.52, 0.52, BLUE)]
    strokes = (
        *((-0.09, 2.4, 0.07, 0.36), (0.02, 2.54, 0.18, 0.07)),
        *((0.02, 2.4, 0.18, 0.07), (0.11, 2.47, 0.07, 0.2)),
    )
    parts += [_plate(z, w, h, WHITE, 0.02).moved((0, y, 0)) for y, z, w, h in strokes]
    return join(parts)


# ---- The whole -----------------------------------------------------------------------------------

ROOF_Z_M = 11.5  # of a typical house, for sky light between the fronts
SINK_M = 0.008  # tyres sit this far in the road, as on their contact patch


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


@lru_cache(maxsize=2)
def build_street(parameters: StreetParameters) -> Street:
    """The street of these parameters; the last two are kept."""
    layout = draw_layout(parameters)
    to_sun = _sun(parameters)
    ends = np.array([frame_time_ns(0), frame_time_ns(parameters.frames - 1)])
    parked, cars = _park(layout)
    builders = (build_ground, build_buildings, build_vegetation, build_furniture)
    shapes = join([*(build(layout) for build in builders), *cars])
    footprints = [(c.centre[0], c.centre[1], c.size_m[0] / 2, c.size_m[1] / 2) for c in parked]
    lighting = Lighting(
        to_sun=to_sun,
        eye_path=camera_path(parameters, ends),
        canyon=(-FACADE_M, FACADE_M, ROOF_Z_M),
        footprints=np.array(footprints).reshape(-1, 4),
    )
    static = Body(shapes, build_tree(shapes), lighting)
    movers = tuple(_moving_body(mover, layout, static, ends) for mover in layout.movers)
    return Street(parameters, layout, to_sun, static, movers, parked)


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
        shapes, size = draw_person(mover.seed), PERSON_SIZE_M
        ground, label = float(pavement_z(mover.y_m)), "Pedestrian"
    shapes = shapes.moved((0, 0, -size[2] / 2))
    motion = motion_of(mover, layout, size[2], ground)
    turn = 1.0 if motion.yaw == 0 else -1.0  # the heading is along +x or -x
    flip = np.array([turn, turn, 1.0])
    centre = motion.centres[0]
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
    body = Body(shapes, build_tree(shapes), lighting)
    return MovingBody(mover.name, label, size, body, motion, -size[2] / 2)
