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
    albedo,
    boxes,
    cut,
    join,
    parallelograms,
    triangle,
    tube,
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

# ---- House fronts: windows, doors and shops ------------------------------------------------------
# A front has its own frame: x along the wall, y into the house, z up; its outer face is the plane
# y = 0, seen from y < 0.

REVEAL_M = 0.14  # how deep windows stand in the wall
GLASS = Look((0.022, 0.026, 0.03), Class.BUILDING, Material.GLASS, backed=True)


@dataclass(frozen=True)
class Style:
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


SHOP_GLASS = replace(GLASS, material=Material.SHOP)


def panels(
    rectangles: np.ndarray, depth_m: float, look: Look, edges: np.ndarray | int = ALL_EDGES
) -> Shapes:
    """Upright panels over (x, z) rectangles [R, 4] at y = depth_m, seen from the street."""
    x0, z0, x1, z1 = np.asarray(rectangles, np.float64).reshape(-1, 4).T
    zero = np.zeros_like(x0)
    corner = np.stack([x0, zero + depth_m, z0], 1)
    u, v = np.stack([x1 - x0, zero, zero], 1), np.stack([zero, zero, z1 - z0], 1)
    return parallelograms(corner, u, v, look, edges=edges)


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


def window(size_m: tuple[float, float], style: Style, fine: bool) -> Shapes:
    """One window with reveals, sill and surround; its opening's lower left corner is the origin."""
    width, height = size_m
    opening = (0.0, 0.0, width, height)
    columns, rows = ((2, 2) if height > 1.7 else (2, 1)) if fine else (1, 1)
    parts = [
        glazing(opening, columns, rows, REVEAL_M, style.frame),
        reveals(opening, REVEAL_M, style.trim if style.has_surround else style.wall),
        boxes((-0.08, -0.09, -0.08), (width + 0.08, 0.02, 0.0), style.trim, faces=_FRONT),
    ]
    if style.has_surround:
        band = SURROUND_M
        low = [(-band, -0.035, 0.0), (width, -0.035, 0.0), (-band, -0.06, height)]
        high = [(0.0, 0, height), (width + band, 0, height), (width + band, 0, height + 0.2)]
        parts.append(boxes(low, high, style.trim, faces=_FRONT))
    return join(parts)


SURROUND_M = 0.13
_FRONT = ("-y", "+x", "-x", "+z", "-z")


def window_hole(corner: tuple[float, float], style: Style) -> list[Rectangle]:
    """What a window takes out of the wall: its opening, surround and sill."""
    (x, z), (width, height) = corner, style.window_m
    holes = [(x - 0.08, z - 0.08, x + width + 0.08, z), (x, z, x + width, z + height)]
    if style.has_surround:
        band = SURROUND_M
        holes += [(x - band, z, x + width + band, z + height)]
        holes += [(x - band, z + height, x + width + band, z + height + 0.2)]
    return holes


def door(opening: Rectangle, style: Style) -> Shapes:
    """A panelled door with a fanlight and a step."""
    x0, z0, x1, z1 = opening
    split = z1 - 0.55
    leaf, light = (x0 + 0.06, z0, x1 - 0.06, split), (x0 + 0.06, split + 0.06, x1 - 0.06, z1 - 0.06)
    low, high = leaf[0] + 0.14, leaf[2] - 0.14
    fields = [(low, z0 + 0.25, high, z0 + 0.95), (low, z0 + 1.1, high, split - 0.16)]
    frames, edges = cut(opening, [leaf, light])
    stiles, stile_edges = cut(leaf, fields)
    dark = style.accent.tinted(np.array(style.accent.rgb) * 0.7)
    return join(
        [
            panels(frames, REVEAL_M - 0.02, style.frame, edges),
            panels(stiles, REVEAL_M, style.accent, stile_edges),
            panels(np.array(fields), REVEAL_M + 0.015, dark),
            panels(np.array([light]), REVEAL_M, GLASS),
            reveals(opening, REVEAL_M, style.wall),
            boxes((x0 - 0.1, -0.35, -0.3), (x1 + 0.1, REVEAL_M, z0), style.base),
        ]
    )


def shop_front(opening: Rectangle, style: Style, awning: bool) -> Shapes:
    """A shop: plinth, large panes, a glass door, a sign above and perhaps an awning."""
    x0, z0, x1, z1 = opening
    depth = 0.18
    door_x = x1 - 1.25
    plinth, entry = (x0, z0, door_x, z0 + 0.5), (door_x, z0, x1, z1)
    show = (x0, z0 + 0.5, door_x, z1)
    sign_z, columns = z1 + 0.08, max(1, round((door_x - x0) / 1.7))
    low, high = (x0 - 0.1, -0.12, sign_z), (x1 + 0.1, 0.02, sign_z + 0.62)
    parts = [
        panels(np.array([plinth]), depth - 0.04, style.accent),
        glazing(show, columns, 1, depth, style.accent, 0.09, SHOP_GLASS),
        glazing(entry, 1, 2, depth, style.accent, 0.11),
        reveals(opening, depth, style.accent),
        boxes(low, high, style.accent, faces=_FRONT),
        _lettering(x0, x1, sign_z, style),
    ]
    if awning:
        parts.append(_awning(x0, x1, z1 + 0.05, style))
    return join(parts)


def _lettering(x0: float, x1: float, z: float, style: Style) -> Shapes:
    """Light blocks on the sign that read as letters from afar."""
    middle, pitch = (x0 + x1) / 2, 0.32
    count = int(min(12, (x1 - x0 - 0.8) / pitch))
    starts = middle + (np.arange(count) - count / 2) * pitch
    tall = 0.18 + 0.10 * ((np.arange(count) * 5) % 3 == 0)
    low = np.full(count, z + 0.17)
    rectangles = np.stack([starts, low, starts + 0.2, z + 0.17 + tall], 1)
    return panels(rectangles[(np.arange(count) % 5) != 3], -0.135, style.trim)


def _awning(x0: float, x1: float, z: float, style: Style) -> Shapes:
    """Striped cloth, sloping out over the pavement, with a hem."""
    count = max(4, round((x1 - x0) / 0.45))
    edges = np.linspace(x0, x1, count + 1)
    parts = []
    for start, look in ((0, style.accent), (1, style.trim)):
        x = edges[:-1][start::2]
        width = np.full(len(x), (x1 - x0) / count)
        zero = np.zeros_like(x)
        u = np.stack([width, zero, zero], 1)
        top = np.stack([x, zero - 1.25, zero + z - 0.55], 1)
        slope = np.array([0.0, 1.2, 0.55])
        hem = np.array([0.0, 0.0, -0.2])
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
    (0.05, 0.13, 0.10),
    (0.24, 0.03, 0.03),
    (0.04, 0.07, 0.18),
    (0.10, 0.055, 0.03),
    (0.03, 0.03, 0.035),
    (0.30, 0.17, 0.03),
)
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
        rng = np.random.default_rng([layout.parameters.seed, 20, number])
        start = -56.0
        while start < 56.0:
            width = rng.uniform(9.0, 14.0)
            house = _house(int(rng.integers(2**31)), width, False)
            y = start + width if yaw < 0 else start
            parts.append(house.moved((x, y, 0.0), yaw))
            start += width
    parts.append(_second_row(layout))
    return join(parts)


def draw_style(rng: np.random.Generator) -> Style:
    """Colours and measures of one house."""
    rgb, material = WALLS[rng.integers(len(WALLS))]
    rgb = np.array(rgb) * rng.uniform(0.88, 1.06)
    stone = Look((0.60, 0.57, 0.51), Class.BUILDING)
    wall = Look(tuple(rgb), Class.BUILDING, material, backed=True)
    base = Look(tuple(rgb * 0.35 + 0.10), Class.BUILDING, Material.STONE)
    white = rng.random() < 0.7 or material == Material.BRICK
    return Style(
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
    style = draw_style(rng)
    floors = int(rng.integers(2, 4))
    eaves = style.ground_m + floors * style.floor_m + 0.35
    count = max(2, round(width / rng.uniform(2.5, 3.1)))
    pitch = width / count
    holes: list[Rectangle] = []
    parts = [_ground_floor(rng, style, width, count, holes, fine)]

    corners = [
        ((i + 0.5) * pitch - style.window_m[0] / 2, style.ground_m + j * style.floor_m + 0.75)
        for j in range(floors)
        for i in range(count)
    ]
    for corner in corners:
        holes += window_hole(corner, style)
    places = np.array([(x, 0.0, z) for x, z in corners])
    parts.append(window(style.window_m, style, fine).repeated(places))

    for z0, z1, reach in (
        (style.ground_m + 0.12, style.ground_m + 0.3, 0.09),
        (eaves - 0.32, eaves, 0.28),
    ):
        holes.append((0.0, z0, width, z1))
        parts.append(boxes((0.0, -reach, z0), (width, 0.0, z1), style.trim, faces=_LEDGE))
    holes.append((0.0, BASE_M, width, 0.5))
    base, edges = cut((0.0, BASE_M, width, 0.5), [h for h in holes[:-1] if h[1] < 0.5])
    parts.append(panels(base, -0.0, style.base, edges))
    wall, edges = cut((0.0, 0.5, width, eaves), holes)
    parts.append(panels(wall, 0.0, style.wall, edges))
    parts += [_back(style, width, eaves), _roof(rng, style, width, eaves)]
    inner = Look(style.wall.rgb, Class.BUILDING)
    parts.append(panels(np.array([(0.0, BASE_M, width, eaves)]), INNER_WALL_M, inner))
    zinc = Look((0.22, 0.22, 0.215), Class.BUILDING)
    parts.append(tube((0.12, -0.09, 0.0), (0.12, -0.09, eaves - 0.2), 0.05, zinc))  # a rainpipe
    return join(parts)


_LEDGE = ("-y", "+z", "-z", "+x", "-x")


def _ground_floor(
    rng: np.random.Generator, style: Style, width: float, count: int, holes: list, fine: bool
) -> Shapes:
    """Shop, or a door between windows; adds its holes to the wall's."""
    floor = float(pavement_z(FACADE_M)) + 0.02
    if style.has_shop:
        opening = (0.45, floor, width - 0.45, floor + 2.75)
        holes.append(opening)
        holes.append((0.35, opening[3] + 0.08, width - 0.35, opening[3] + 0.70))
        return shop_front(opening, style, bool(rng.random() < 0.45))
    pitch = width / count
    entry = int(rng.integers(count))
    parts = []
    places = []
    for i in range(count):
        middle = (i + 0.5) * pitch
        if i == entry:
            opening = (middle - 0.58, floor + 0.12, middle + 0.58, floor + 2.95)
            holes.append(opening)
            holes.append((opening[0] - 0.1, BASE_M, opening[2] + 0.1, opening[1]))
            parts.append(door(opening, style))
        else:
            corner = (middle - style.window_m[0] / 2, 1.15)
            holes += window_hole(corner, style)
            places.append((corner[0], 0.0, corner[1]))
    if places:
        parts.append(window(style.window_m, style, fine).repeated(np.array(places)))
    return join(parts)


def _back(style: Style, width: float, eaves: float) -> Shapes:
    """Side and back walls, plain."""
    wall = Look(style.wall.rgb, Class.BUILDING, style.wall.material, spacing=1.6)
    low, high = (0.0, 0.0, BASE_M), (width, DEPTH_M, eaves)
    return boxes(low, high, wall, faces=("+x", "-x", "+y"))


def _roof(rng: np.random.Generator, style: Style, width: float, eaves: float) -> Shapes:
    if rng.random() < 0.35:
        return _flat_roof(style, width, eaves)
    tiles = Look(ROOFS[rng.integers(len(ROOFS))], Class.BUILDING, Material.TILES, spacing=1.3)
    rise, half = (DEPTH_M / 2) * float(np.tan(np.radians(rng.uniform(30, 40)))), DEPTH_M / 2
    over = 0.35
    drop = over * rise / half
    edge_z = eaves - drop + 0.12
    slope = np.array([0.0, half + over, rise + drop])
    low, high = (0.0, -over - 0.12, edge_z - 0.14), (width, -over + 0.02, edge_z + 0.0)
    gutter = style.trim.tinted((0.25, 0.24, 0.23))
    under = (0, -over, edge_z - 0.02)
    parts = [
        parallelograms((0.0, -over, edge_z), (width, 0, 0), slope, tiles),
        parallelograms((width, DEPTH_M + over, edge_z), (-width, 0, 0), slope * [1, -1, 1], tiles),
        boxes(low, high, gutter, faces=_LEDGE, edges=0),
        parallelograms(under, (0, over, 0), (width, 0, 0), style.trim, edges=0),
    ]
    gable = Look(style.wall.rgb, Class.BUILDING, style.wall.material, spacing=0.8)
    for x, flip in ((0.0, True), (width, False)):
        a, b, c = (x, 0.0, eaves), (x, DEPTH_M, eaves), (x, half, eaves + rise + 0.1)
        parts.append(triangle(np.array([a, c, b] if flip else [a, b, c]), gable))
    brick = Look((0.33, 0.16, 0.11), Class.BUILDING, Material.BRICK)
    for x in (0.7, width - 1.5)[: int(rng.integers(1, 3))]:
        top = eaves + rise + 0.9
        parts.append(boxes((x, half - 0.9, eaves + rise * 0.6), (x + 0.8, half - 0.3, top), brick))
    return join(parts)


def _flat_roof(style: Style, width: float, eaves: float) -> Shapes:
    """A roof behind a parapet."""
    top = eaves + 0.75
    gravel = Look((0.30, 0.29, 0.27), Class.BUILDING, Material.ASPHALT, spacing=1.6)
    parapet = Look(style.wall.rgb, Class.BUILDING, style.wall.material)
    return join(
        [
            parallelograms((0, 0.3, eaves), (width, 0, 0), (0, DEPTH_M - 0.3, 0), gravel),
            boxes((0, 0, eaves), (width, 0.3, top), parapet, faces=("-y", "+y", "+x", "-x")),
            boxes((-0.0, -0.07, top), (width, 0.37, top + 0.1), style.trim, faces=_LEDGE),
        ]
    )


def _garden(width: float) -> Shapes:
    """A low wall with a hedge behind it, across a gap between two houses."""
    brick = Look((0.34, 0.17, 0.12), Class.BARRIER, Material.BRICK)
    hedge = Look((0.075, 0.13, 0.03), Class.VEGETATION, Material.LEAVES)
    stone = Look((0.52, 0.50, 0.46), Class.BARRIER)
    return join(
        [
            boxes((0, 0.0, BASE_M), (width, 0.3, 0.95), brick, faces=("-y", "+y", "+x", "-x")),
            boxes((0, -0.05, 0.95), (width, 0.35, 1.03), stone, faces=_LEDGE),
            boxes((0.05, 0.5, 0.0), (width - 0.05, 1.5, 1.75), hedge, edges=0),
        ]
    )


def _second_row(layout: Layout) -> Shapes:
    """Plain houses behind the gardens, which close the view through the gaps."""
    rng = np.random.default_rng([layout.parameters.seed, 21])
    parts = []
    for side in (1, -1):
        x = layout.x0 - 4.0
        while x < layout.x1 + 4.0:
            width, height = rng.uniform(9, 15), rng.uniform(6.5, 9.5)
            style = draw_style(rng)
            y = side * rng.uniform(36, 44)
            wall = Look(style.wall.rgb, Class.BUILDING, style.wall.material)
            columns = np.arange(1.2, width - 1.6, 2.6)
            holes = [(w, z, w + 1.2, z + 1.5) for z in (1.2, 4.2) for w in columns]
            front, edges = cut((0.0, BASE_M, width, height), holes)
            built = join(
                [
                    panels(front, 0.0, wall, edges & np.uint8(U0 | U1 | V1)),
                    panels(np.array(holes), 0.1, _PANE),
                    *[reveals(h, 0.1, wall) for h in holes],
                    _back(style, width, height),
                    _roof(rng, style, width, height),
                ]
            )
            corner = (x if side > 0 else x + width, y, 0.0)
            parts.append(built.moved(corner, 0.0 if side > 0 else np.pi))
            x += width + rng.uniform(4, 12)
    return join(parts)


_PANE = Look((0.10, 0.12, 0.14), Class.BUILDING)


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
