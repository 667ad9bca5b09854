"""Bodies of the procedural street: houses, ground and furniture as one static body, and moving
bodies.

`build_street` returns all of them, each with its light. Builders return arrays of shapes in the
frame that their section describes. The callers are `adapters.procedural` and
`adapters.street.splats`.
"""

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
    rng_of,
    road_z,
)
from adapters.street.light import Body, Lighting, direction_to_sun
from adapters.street.raycast import build_tree
from augment.scene.semantics import SemanticClass as Class

# ---- House fronts: windows, doors and shops ------------------------------------------------------
# A front has its own frame: x along the wall, y into the house, z up; its outer face is the plane
# y = 0, seen from y < 0. `holes` collects what stands in the wall, as (x, z) rectangles.

# Depth of windows in the wall.
REVEAL_M = 0.14
# Width of the surround of windows.
SURROUND_M = 0.13
# Look of window panes.
GLASS = Look((0.022, 0.026, 0.03), Class.BUILDING, Material.GLASS, backed=True)
# Look of shop panes.
SHOP_GLASS = GLASS._replace(material=Material.SHOP)
# Visible faces of a box on a front.
_FRONT_FACES = ("-y", "+x", "-x", "+z", "-z")
# Visible faces of a ledge.
_LEDGE_FACES = ("-y", "+z", "-z", "+x", "-x")


class Facade(NamedTuple):
    """Looks and measures of a house's front."""

    wall: Look
    """Look of the wall."""

    base: Look
    """Look of the plinth at the foot of the wall."""

    trim: Look
    """Look of sills, surrounds and ledges."""

    frame: Look
    """Look of the frames of windows and doors."""

    accent: Look
    """Look of door leaves and shop fronts."""

    window_m: tuple[float, float]
    """Width and height of a window."""

    floor_m: float
    """Height of an upper floor."""

    ground_m: float
    """Height of the ground floor."""

    has_surround: bool
    """True if windows have a surround."""

    has_shop: bool
    """True if there is a shop on the ground floor."""


def panels(rectangles, depth_m: float, look: Look, edges: np.ndarray | int = ALL_EDGES) -> Shapes:
    """Return upright panels over (x, z) rectangles [R, 4] at y = depth_m. They face the street."""
    x0, z0, x1, z1 = np.asarray(rectangles, np.float64).reshape(-1, 4).T
    u = xyz(x1 - x0, 0, 0)
    v = xyz(0, 0, z1 - z0)
    return parallelograms(xyz(x0, depth_m, z0), u, v, look, edges=edges)


def reveals(opening: Rectangle, depth_m: float, look: Look) -> Shapes:
    """Return the four inner faces of an opening, from the wall's face to depth_m."""
    x0, z0, x1, z1 = opening
    inwards = (0, depth_m, 0)
    up = (0, 0, z1 - z0)
    along = (x1 - x0, 0, 0)
    corners = [(x0, 0, z0), (x1, 0, z0), (x0, 0, z0), (x0, 0, z1)]
    first_sides = [inwards, up, along, inwards]
    second_sides = [up, inwards, inwards, along]
    return parallelograms(
        corners, first_sides, second_sides, look._replace(ambient=0.75, backed=False)
    )


@joined
def glazing(
    opening: Rectangle,
    columns: int,
    rows: int,
    depth_m: float,
    frame: Look,
    bar_m: float = 0.07,
    pane: Look = GLASS,
) -> Iterator[Shapes]:
    """Build panes with a frame and bars that fill an opening."""
    x0, z0, x1, z1 = opening
    half_bar_m = bar_m / 2
    xs = np.linspace(x0 + half_bar_m, x1 - half_bar_m, columns + 1)
    zs = np.linspace(z0 + half_bar_m, z1 - half_bar_m, rows + 1)
    if rows == 2:
        zs[1] = zs[0] + 0.68 * (zs[2] - zs[0])  # a fanlight above
    panes = [
        (a + half_bar_m, low + half_bar_m, b - half_bar_m, high - half_bar_m)
        for a, b in itertools.pairwise(xs)
        for low, high in itertools.pairwise(zs)
    ]
    bars, edges = cut(opening, panes)
    yield panels(bars, depth_m - 0.02, frame, edges)
    glass = panels(panes, depth_m, pane)
    glass.variation[:] = 0.37  # one window, one curtain
    yield glass


def windows(corners: list, facade: Facade, is_fine: bool, holes: list[Rectangle]) -> Shapes:
    """Build windows with reveals, sills and surrounds.

    Args:
        corners: (x, z) of the lower left corners of the openings.
        facade: the front's looks and measures.
        is_fine: True for windows with several panes.
        holes: rectangles in the wall, extended by those of the windows.
    """
    width, height = facade.window_m
    band_m, lintel_m = (SURROUND_M, 0.2) if facade.has_surround else (0.0, 0.0)
    opening = (0.0, 0.0, width, height)
    columns, rows = ((2, 2) if height > 1.7 else (2, 1)) if is_fine else (1, 1)
    parts = [
        glazing(opening, columns, rows, REVEAL_M, facade.frame),
        reveals(opening, REVEAL_M, facade.trim if facade.has_surround else facade.wall),
        boxes((-0.08, -0.09, -0.08), (width + 0.08, 0.02, 0.0), facade.trim, faces=_FRONT_FACES),
    ]
    if facade.has_surround:
        low_corners = [(-band_m, -0.035, 0.0), (width, -0.035, 0.0), (-band_m, -0.06, height)]
        high_corners = [
            (0.0, 0, height),
            (width + band_m, 0, height),
            (width + band_m, 0, height + lintel_m),
        ]
        parts.append(boxes(low_corners, high_corners, facade.trim, faces=_FRONT_FACES))
    for x, z in corners:
        holes += [(x - 0.08, z - 0.08, x + width + 0.08, z), (x, z, x + width, z + height)]
        if facade.has_surround:
            holes += [(x - band_m, z, x + width + band_m, z + height)]
            holes += [(x - band_m, z + height, x + width + band_m, z + height + lintel_m)]
    return join(parts).repeated(np.array([(x, 0.0, z) for x, z in corners]))


@joined
def door(opening: Rectangle, facade: Facade) -> Iterator[Shapes]:
    """Build a panelled door with a fanlight and a step."""
    x0, z0, x1, z1 = opening
    fanlight_z = z1 - 0.55
    leaf_opening = (x0 + 0.06, z0, x1 - 0.06, fanlight_z)
    fanlight = (x0 + 0.06, fanlight_z + 0.06, x1 - 0.06, z1 - 0.06)
    field_x0 = leaf_opening[0] + 0.14
    field_x1 = leaf_opening[2] - 0.14
    fields = [
        (field_x0, z0 + 0.25, field_x1, z0 + 0.95),
        (field_x0, z0 + 1.1, field_x1, fanlight_z - 0.16),
    ]
    frames, edges = cut(opening, [leaf_opening, fanlight])
    stiles, stile_edges = cut(leaf_opening, fields)
    yield panels(frames, REVEAL_M - 0.02, facade.frame, edges)
    yield panels(stiles, REVEAL_M, facade.accent, stile_edges)
    dark_accent = facade.accent.tinted(np.array(facade.accent.rgb) * 0.7)
    yield panels(fields, REVEAL_M + 0.015, dark_accent)
    yield panels(fanlight, REVEAL_M, GLASS)
    yield reveals(opening, REVEAL_M, facade.wall)
    yield boxes((x0 - 0.1, -0.35, -0.3), (x1 + 0.1, REVEAL_M, z0), facade.base)


@joined
def shop_front(opening: Rectangle, facade: Facade, has_awning: bool) -> Iterator[Shapes]:
    """Build a shop: plinth, large panes, a glass door, a sign above and perhaps an awning."""
    x0, z0, x1, z1 = opening
    accent = facade.accent
    depth = 0.18
    door_x = x1 - 1.25
    sign_z = z1 + 0.08
    yield panels((x0, z0, door_x, z0 + 0.5), depth - 0.04, accent)
    columns = max(1, round((door_x - x0) / 1.7))
    yield glazing((x0, z0 + 0.5, door_x, z1), columns, 1, depth, accent, 0.09, SHOP_GLASS)
    yield glazing((door_x, z0, x1, z1), 1, 2, depth, accent, 0.11)
    yield reveals(opening, depth, accent)
    low_corner = (x0 - 0.1, -0.12, sign_z)
    high_corner = (x1 + 0.1, 0.02, sign_z + 0.62)
    yield boxes(low_corner, high_corner, accent, faces=_FRONT_FACES)
    # Light blocks on the sign that read as letters from afar.
    number = np.arange(int(min(12, (x1 - x0 - 0.8) / 0.32)))
    starts = (x0 + x1) / 2 + (number - len(number) / 2) * 0.32
    letter_heights = 0.18 + 0.10 * ((number * 5) % 3 == 0)
    z = sign_z + 0.17
    letters = np.stack(np.broadcast_arrays(starts, z, starts + 0.2, z + letter_heights), 1)
    yield panels(letters[number % 5 != 3], -0.135, facade.trim)
    if has_awning:  # striped cloth, sloping out over the pavement, with a hem
        count = max(4, round((x1 - x0) / 0.45))
        edges = np.linspace(x0, x1, count + 1)[:-1]
        u = ((x1 - x0) / count, 0.0, 0.0)
        slope = np.array([0.0, 1.2, 0.55])
        hem_drop = np.array([0.0, 0.0, -0.2])
        for start, look in ((0, accent), (1, facade.trim)):
            top = xyz(edges[start::2], -1.25, z1 + 0.05 - 0.55)
            yield parallelograms(top, u, slope, look)
            yield parallelograms(top + hem_drop, u, -hem_drop, look)


# ---- Houses and gardens --------------------------------------------------------------------------

# Depth of a house.
HOUSE_DEPTH_M = 10.5
# Lower end of the walls, below the pavement.
WALL_BASE_Z_M = -0.25
# Depth of a hidden inner wall behind the front. Where the front's splats let a little light
# through, it keeps the back wall from showing.
INNER_WALL_M = 0.45
# Linear colours and materials of house fronts.
WALLS = (
    *[((0.72, 0.66, 0.54), Material.PLASTER), ((0.66, 0.50, 0.36), Material.PLASTER)],
    *[((0.58, 0.57, 0.54), Material.PLASTER), ((0.70, 0.56, 0.50), Material.PLASTER)],
    *[((0.50, 0.58, 0.56), Material.PLASTER), ((0.78, 0.76, 0.71), Material.PLASTER)],
    *[((0.36, 0.16, 0.11), Material.BRICK), ((0.42, 0.22, 0.14), Material.BRICK)],
    *[((0.30, 0.19, 0.15), Material.BRICK), ((0.55, 0.49, 0.39), Material.STONE)],
)
# Linear colours of doors and shop fronts.
ACCENTS = (
    (0.05, 0.13, 0.10), (0.24, 0.03, 0.03), (0.04, 0.07, 0.18),
    (0.10, 0.055, 0.03), (0.03, 0.03, 0.035), (0.30, 0.17, 0.03),
)  # fmt: skip
# Linear colours of roofs.
ROOFS = ((0.24, 0.10, 0.065), (0.13, 0.12, 0.125), (0.19, 0.09, 0.06))
# Look of stone trim.
STONE = Look((0.60, 0.57, 0.51), Class.BUILDING)
# Look of the windows of distant houses, without mirroring.
_PANE = Look((0.10, 0.12, 0.14), Class.BUILDING)
# Look of gutters and other sheet metal.
_ZINC = Look((0.22, 0.22, 0.215), Class.BUILDING)
# Look of chimneys.
_CHIMNEY = Look((0.33, 0.16, 0.11), Class.BUILDING, Material.BRICK)
# Look of flat roofs.
_GRAVEL = Look((0.30, 0.29, 0.27), Class.BUILDING, Material.ASPHALT, spacing=1.6)
# Upright faces of a box.
_UPRIGHT_FACES = ("-y", "+y", "+x", "-x")


@joined
def build_buildings(layout: Layout) -> Iterator[Shapes]:
    """Build both rows of houses, those that close the street's ends, and some behind."""
    middle = layout.parameters.path_length_m / 2
    for x0, x1, side, seed, is_garden in layout.plots:
        has_fine_windows = abs((x0 + x1) / 2 - middle) - middle < 32
        shapes = _garden(x1 - x0) if is_garden else _house(seed, x1 - x0, has_fine_windows)
        yield _place_beside_street(shapes, side, x0, x1, FACADE_M)
    distance = CROSS_STREET_M + 4.6
    for number, (x, turn) in enumerate(((layout.x1 + distance, -1), (layout.x0 - distance, 1))):
        rng = rng_of(layout.parameters, 20, number)
        start = -56.0
        while start < 56.0:
            width = rng.uniform(9.0, 14.0)
            house = _house(int(rng.integers(2**31)), width, False)
            yield house.moved((x, start + width if turn < 0 else start, 0.0), turn * np.pi / 2)
            start += width
    yield _second_row(layout)


def _place_beside_street(shapes: Shapes, side: int, x0: float, x1: float, y: float) -> Shapes:
    """Move shapes from the origin to x0 ... x1 on the street's left (side 1) or right side (-1)."""
    return shapes.moved((x0 if side > 0 else x1, side * y, 0.0), 0.0 if side > 0 else np.pi)


def draw_facade(rng: np.random.Generator) -> Facade:
    """Draw the looks and measures of one house."""
    rgb, material = WALLS[rng.integers(len(WALLS))]
    rgb = np.array(rgb) * rng.uniform(0.88, 1.06)
    is_white_trim = rng.random() < 0.7 or material == Material.BRICK
    return Facade(
        wall=Look(rgb, Class.BUILDING, material, backed=True),
        base=Look(rgb * 0.35 + 0.10, Class.BUILDING, Material.STONE),
        trim=STONE.tinted((0.74, 0.72, 0.67)) if is_white_trim else STONE,
        frame=STONE.tinted((0.78, 0.77, 0.75) if rng.random() < 0.7 else (0.07, 0.065, 0.06)),
        accent=Look(ACCENTS[rng.integers(len(ACCENTS))], Class.BUILDING),
        window_m=(float(rng.uniform(1.05, 1.4)), float(rng.uniform(1.55, 1.95))),
        floor_m=float(rng.uniform(3.0, 3.4)),
        ground_m=float(rng.uniform(3.75, 4.1)),
        has_surround=bool(rng.random() < 0.55),
        has_shop=bool(rng.random() < 0.5),
    )


@joined
def _house(seed: int, width: float, is_fine: bool) -> Iterator[Shapes]:
    """Build a house on x in [0, width], with its front at y = 0."""
    rng = np.random.default_rng(seed)
    facade = draw_facade(rng)
    num_floors = int(rng.integers(2, 4))
    eaves = facade.ground_m + num_floors * facade.floor_m + 0.35
    num_columns = max(2, round(width / rng.uniform(2.5, 3.1)))
    window_centers = [(i + 0.5) * (width / num_columns) for i in range(num_columns)]
    holes: list[Rectangle] = []
    yield from _ground_floor(rng, facade, width, window_centers, holes, is_fine)
    sills = [facade.ground_m + j * facade.floor_m + 0.75 for j in range(num_floors)]
    corners = [(x - facade.window_m[0] / 2, z) for z in sills for x in window_centers]
    yield windows(corners, facade, is_fine, holes)
    ledge_span = (facade.ground_m + 0.12, facade.ground_m + 0.3, 0.09)
    for z0, z1, reach in (ledge_span, (eaves - 0.32, eaves, 0.28)):
        holes.append((0.0, z0, width, z1))
        yield boxes((0.0, -reach, z0), (width, 0.0, z1), facade.trim, faces=_LEDGE_FACES)
    base, edges = cut((0.0, WALL_BASE_Z_M, width, 0.5), [h for h in holes if h[1] < 0.5])
    yield panels(base, -0.0, facade.base, edges)
    wall, edges = cut((0.0, 0.5, width, eaves), holes)
    yield panels(wall, 0.0, facade.wall, edges)
    yield _back(facade, width, eaves)
    yield _roof(rng, facade, width, eaves)
    inner_wall = facade.wall._replace(material=Material.PLAIN, backed=False)
    yield panels((0.0, WALL_BASE_Z_M, width, eaves), INNER_WALL_M, inner_wall)
    yield tube((0.12, -0.09, 0.0), (0.12, -0.09, eaves - 0.2), 0.05, _ZINC)  # a rainpipe


def _ground_floor(
    rng: np.random.Generator,
    facade: Facade,
    width: float,
    window_centers: list[float],
    holes: list[Rectangle],
    is_fine: bool,
) -> Iterator[Shapes]:
    """Build a shop, or a door between windows."""
    floor = float(pavement_z(FACADE_M)) + 0.02
    if facade.has_shop:
        opening = (0.45, floor, width - 0.45, floor + 2.75)
        holes += [opening, (0.35, opening[3] + 0.08, width - 0.35, opening[3] + 0.70)]
        yield shop_front(opening, facade, bool(rng.random() < 0.45))
        return
    door_x = window_centers[int(rng.integers(len(window_centers)))]
    opening = (door_x - 0.58, floor + 0.12, door_x + 0.58, floor + 2.95)
    holes += [opening, (opening[0] - 0.1, WALL_BASE_Z_M, opening[2] + 0.1, opening[1])]
    yield door(opening, facade)
    corners = [(x - facade.window_m[0] / 2, 1.15) for x in window_centers if x != door_x]
    yield windows(corners, facade, is_fine, holes)


def _back(facade: Facade, width: float, eaves: float) -> Shapes:
    """Build the plain side and back walls."""
    wall = facade.wall._replace(spacing=1.6, backed=False)
    return boxes(
        (0.0, 0.0, WALL_BASE_Z_M), (width, HOUSE_DEPTH_M, eaves), wall, faces=("+x", "-x", "+y")
    )


@joined
def _roof(rng: np.random.Generator, facade: Facade, width: float, eaves: float) -> Iterator[Shapes]:
    """Build a ridged roof along the street, or a flat roof behind a parapet."""
    wall = facade.wall._replace(backed=False)
    trim = facade.trim
    if rng.random() < 0.35:
        top = eaves + 0.75
        yield parallelograms((0, 0.3, eaves), (width, 0, 0), (0, HOUSE_DEPTH_M - 0.3, 0), _GRAVEL)
        yield boxes((0, 0, eaves), (width, 0.3, top), wall, faces=_UPRIGHT_FACES)
        yield boxes((-0.0, -0.07, top), (width, 0.37, top + 0.1), trim, faces=_LEDGE_FACES)
        return
    tiles = Look(ROOFS[rng.integers(len(ROOFS))], Class.BUILDING, Material.TILES, spacing=1.3)
    half_depth = HOUSE_DEPTH_M / 2
    overhang = 0.35
    rise = half_depth * float(np.tan(np.radians(rng.uniform(30, 40))))
    drop = overhang * rise / half_depth
    edge_z = eaves - drop + 0.12
    slope = np.array([0.0, half_depth + overhang, rise + drop])
    yield parallelograms((0.0, -overhang, edge_z), (width, 0, 0), slope, tiles)
    far_corner = (width, HOUSE_DEPTH_M + overhang, edge_z)
    yield parallelograms(far_corner, (-width, 0, 0), slope * [1, -1, 1], tiles)
    low_corner = (0.0, -overhang - 0.12, edge_z - 0.14)
    high_corner = (width, -overhang + 0.02, edge_z + 0.0)
    yield boxes(
        low_corner, high_corner, trim.tinted((0.25, 0.24, 0.23)), faces=_LEDGE_FACES, edges=0
    )  # a gutter
    yield parallelograms(
        (0, -overhang, edge_z - 0.02), (0, overhang, 0), (width, 0, 0), trim, edges=0
    )
    for x, order in ((0.0, (0, 2, 1)), (width, (0, 1, 2))):
        gable_corners = np.array(
            [(x, 0.0, eaves), (x, HOUSE_DEPTH_M, eaves), (x, half_depth, eaves + rise + 0.1)]
        )
        yield triangles(*gable_corners[list(order)], wall._replace(spacing=0.8))
    for x in (0.7, width - 1.5)[: int(rng.integers(1, 3))]:
        low_corner = (x, half_depth - 0.9, eaves + rise * 0.6)
        high_corner = (x + 0.8, half_depth - 0.3, eaves + rise + 0.9)
        yield boxes(low_corner, high_corner, _CHIMNEY)


def _garden(width: float) -> Shapes:
    """Build a low wall with a hedge behind it, across a gap between two houses."""
    brick = Look((0.34, 0.17, 0.12), Class.BARRIER, Material.BRICK)
    hedge = Look((0.075, 0.13, 0.03), Class.VEGETATION, Material.LEAVES)
    stone = Look((0.52, 0.50, 0.46), Class.BARRIER)
    return join([
        boxes((0, 0.0, WALL_BASE_Z_M), (width, 0.3, 0.95), brick, faces=_UPRIGHT_FACES),
        boxes((0, -0.05, 0.95), (width, 0.35, 1.03), stone, faces=_LEDGE_FACES),
        boxes((0.05, 0.5, 0.0), (width - 0.05, 1.5, 1.75), hedge, edges=0),
    ])  # fmt: skip


@joined
def _second_row(layout: Layout) -> Iterator[Shapes]:
    """Build plain houses behind the gardens. They close the view through the gaps."""
    rng = rng_of(layout.parameters, 21)
    for side in (1, -1):
        x = layout.x0 - 4.0
        while x < layout.x1 + 4.0:
            width = rng.uniform(9, 15)
            height = rng.uniform(6.5, 9.5)
            facade = draw_facade(rng)
            y = rng.uniform(36, 44)
            wall = facade.wall._replace(backed=False)
            columns = np.arange(1.2, width - 1.6, 2.6)
            holes = [(w, z, w + 1.2, z + 1.5) for z in (1.2, 4.2) for w in columns]
            front, edges = cut((0.0, WALL_BASE_Z_M, width, height), holes)
            shapes = join([
                panels(front, 0.0, wall, edges & np.uint8(U0 | U1 | V1)),
                panels(holes, 0.1, _PANE),
                *[reveals(h, 0.1, wall) for h in holes],
                _back(facade, width, height),
                _roof(rng, facade, width, height),
            ])  # fmt: skip
            yield _place_beside_street(shapes, side, x, x + width, y)
            x += width + rng.uniform(4, 12)


# ---- The ground: carriageway and markings, kerbs, pavements, cross streets, the land around ------

# Look of the carriageway.
ASPHALT = Look((0.105, 0.105, 0.11), Class.ROAD, Material.ASPHALT, spacing=1.3, backed=True)
# Look of repaired patches of the carriageway.
REPAIR = Look((0.075, 0.075, 0.08), Class.ROAD, Material.ASPHALT, spacing=1.3, backed=True)
# Look of manhole covers.
IRON = Look((0.06, 0.058, 0.055), Class.ROAD)
# Look of lane markings.
MARKING = Look((0.72, 0.72, 0.70), Class.LANE_MARKING, Material.MARKING)
# Look of pavements.
PAVING = Look((0.34, 0.325, 0.30), Class.SIDEWALK, Material.PAVING, spacing=1.2, backed=True)
# Look of kerb stones.
KERB = Look((0.44, 0.43, 0.41), Class.SIDEWALK)
# Look of grass.
GRASS = Look((0.13, 0.19, 0.05), Class.TERRAIN, Material.GRASS, spacing=2.5)

# Length of a section of the carriageway.
SECTION_M = 6.0
# Around the middle of the zebra crossing, no other mark lies within this distance.
ZEBRA_CLEAR_M = 3.6
# Width of the cross streets' far pavement.
FAR_PAVEMENT_M = 4.6
# Half of the cross streets' length.
CROSS_HALF_M = 70.0
# Distance of the pavements' end, under the walls, from the street's middle.
PAVEMENT_END_M = FACADE_M + 0.6


@joined
def build_ground(layout: Layout) -> Iterator[Shapes]:
    """Build the ground: carriageway, markings, kerbs, pavements, cross streets and the land
    around.
    """
    yield from _carriageway(layout)
    yield from _pavements(layout)
    yield from _cross_streets(layout)
    west = layout.x0 - CROSS_STREET_M
    east = layout.x1 + CROSS_STREET_M
    holes: list[Rectangle] = [
        (layout.x0, -PAVEMENT_END_M, layout.x1, PAVEMENT_END_M),
        (west - FAR_PAVEMENT_M, -CROSS_HALF_M, layout.x0, CROSS_HALF_M),
        (layout.x1, -CROSS_HALF_M, east + FAR_PAVEMENT_M, CROSS_HALF_M),
    ]
    margin = TERRAIN_REACH_M
    pieces, edges = cut((west - margin, -margin, east + margin, margin), holes)
    # Only the rims that border something else need to be crisp.
    yield _sloped_panels(pieces, 0.0, TERRAIN_Z_M, GRASS, edges & np.uint8(V0 | V1))


def _sloped_panels(
    rectangles, slope: float, z0: float, look: Look, edges: np.ndarray | int = ALL_EDGES
) -> Shapes:
    """Return panels over rectangles [R, 4] on the plane z = z0 + slope y, facing up."""
    x0, y0, x1, y1 = np.reshape(rectangles, (-1, 4)).T
    u = xyz(x1 - x0, 0, 0)
    v = xyz(0, y1 - y0, slope * (y1 - y0))
    return parallelograms(xyz(x0, y0, z0 + slope * y0), u, v, look, edges=edges)


def _marking_rectangles(layout: Layout) -> list[Rectangle]:
    """Return the painted rectangles of both halves of the road. None crosses the crown y = 0."""
    rectangles: list[Rectangle] = []
    zebra = layout.zebra_x
    x0 = layout.x0
    x1 = layout.x1
    for x in np.arange(x0 + 2, x1 - 8, 6.0):
        if abs(x + 1.5 - zebra) > 6.5:
            rectangles += [(x, 0.0, x + 3.0, 0.07), (x, -0.07, x + 3.0, 0.0)]
    for side in (1, -1):
        low_y, high_y = sorted((side * (LANE_M - 0.06), side * (LANE_M + 0.06)))
        for x in np.arange(x0 + 2, x1 - 8, 6.1):  # parking bays: a corner line and its end
            if abs(x + 3.0 - zebra) > 8.0:
                rectangles.append((x, low_y, x + 4.9, high_y))
        for y in np.arange(0.25, LANE_M + 1.6, 1.0):
            near_y, far_y = sorted((side * y, side * (y + 0.5)))
            rectangles.append((zebra - 1.5, near_y, zebra + 1.5, far_y))
        stop = zebra + side * 3.0  # each lane stops before it
        near_y, far_y = sorted((side * 0.12, side * (LANE_M - 0.12)))
        rectangles.append((stop - 0.15, near_y, stop + 0.15, far_y))
    return rectangles


def _draw_patches(
    layout: Layout, occupied: list[Rectangle]
) -> tuple[list[Rectangle], list[Rectangle]]:
    """Draw repaired asphalt and iron covers, clear of the markings and of each other."""
    rng = rng_of(layout.parameters, 10)
    patches: tuple[list[Rectangle], list[Rectangle]] = [], []
    for x in np.arange(layout.x0 + 4, layout.x1 - 6, 7.0):
        kind = int(rng.random() < 0.45)
        side = rng.choice([-1, 1])
        half_size = (rng.uniform(0.8, 2.6), rng.uniform(0.3, 0.6)) if kind == 0 else (0.3, 0.3)
        center = (x + rng.uniform(0, 4), side * rng.uniform(0.9, 2.4))
        rectangle = (
            center[0] - half_size[0],
            center[1] - half_size[1],
            center[0] + half_size[0],
            center[1] + half_size[1],
        )
        low_x = rectangle[0] - 0.1
        low_y = rectangle[1] - 0.1
        high_x = rectangle[2] + 0.1
        high_y = rectangle[3] + 0.1
        other_rectangles = [*occupied, *patches[0], *patches[1]]
        if all(
            high_x < a[0] or a[2] < low_x or high_y < a[1] or a[3] < low_y for a in other_rectangles
        ):
            patches[kind].append(rectangle)
    return patches


def _carriageway(layout: Layout) -> Iterator[Shapes]:
    """Build both halves of the road in sections along x. A mark cuts only the asphalt beside it."""
    marks = _marking_rectangles(layout)
    repairs, covers = _draw_patches(layout, marks)
    crossing = (layout.zebra_x - ZEBRA_CLEAR_M, layout.zebra_x + ZEBRA_CLEAR_M)
    bounds = np.arange(layout.x0, layout.x1 - SECTION_M / 2, SECTION_M)
    bounds = bounds[(bounds < crossing[0] - 1) | (bounds > crossing[1] + 1)]
    bounds = np.sort([*bounds, *crossing, layout.x1])
    for side, kerb in ((1, V1), (-1, V0)):
        low_y, high_y = sorted((0.0, side * ROAD_HALF_M))
        holes = []
        for rectangles, look in ((marks, MARKING), (repairs, REPAIR), (covers, IRON)):
            side_rectangles = [r for r in rectangles if low_y <= r[1] and r[3] <= high_y]
            holes += side_rectangles
            yield _sloped_panels(side_rectangles, -side * CAMBER, 0.0, look)
        for start, stop in itertools.pairwise(bounds):
            section_holes = [h for h in holes if h[0] < stop and h[2] > start]
            pieces, edges = cut((start, low_y, stop, high_y), section_holes, rim=kerb)
            yield _sloped_panels(pieces, -side * CAMBER, 0.0, ASPHALT, edges)


def _kerb_face(start: Vectors, along: Vectors, left: bool) -> Shapes:
    """Return a kerb's face, which looks to the left or the right of the direction along it."""
    up = (0, 0, KERB_RISE_M)
    return parallelograms(start, *((along, up) if not left else (up, along)), KERB)


def _pavements(layout: Layout) -> Iterator[Shapes]:
    low_z = float(road_z(ROAD_HALF_M))
    inner_y = ROAD_HALF_M + KERB_TOP_M
    z0 = low_z + KERB_RISE_M - PAVEMENT_SLOPE * ROAD_HALF_M
    for side in (1, -1):
        start = (layout.x0, side * ROAD_HALF_M, low_z)
        yield _kerb_face(start, (layout.x1 - layout.x0, 0, 0), side < 0)
        for near_y, far_y, look in (
            (ROAD_HALF_M, inner_y, KERB),
            (inner_y, PAVEMENT_END_M, PAVING),
        ):
            low_y, high_y = sorted((side * near_y, side * far_y))
            yield _sloped_panels(
                (layout.x0, low_y, layout.x1, high_y), side * PAVEMENT_SLOPE, z0, look
            )


def _cross_streets(layout: Layout) -> Iterator[Shapes]:
    """Build the streets at both ends, with the pavement beyond."""
    z = float(road_z(ROAD_HALF_M))
    half_length = CROSS_HALF_M
    for x, direction in ((layout.x0, -1), (layout.x1, 1)):
        kerb = x + direction * CROSS_STREET_M
        near_x, far_x = sorted((x, kerb))
        yield _sloped_panels((near_x, -half_length, far_x, half_length), 0.0, z, ASPHALT)
        yield _kerb_face((kerb, -half_length, z), (0, 2 * half_length, 0), direction > 0)
        near_x, far_x = sorted((kerb, kerb + direction * FAR_PAVEMENT_M))
        yield _sloped_panels(
            (near_x, -half_length, far_x, half_length), 0.0, z + KERB_RISE_M, PAVING
        )
        for side in (1, -1):  # the near pavement's edge, left and right of our street
            is_left = (side > 0) != (direction < 0)
            yield _kerb_face((x, side * ROAD_HALF_M, z), side * np.array([0, 60.0, 0]), is_left)


# ---- A person in mid-stride: tubes and ellipsoids, one rigid body --------------------------------
# Frame: x forward, y left, z up, origin on the ground between the feet.

# Length, width and height of a person's box.
PERSON_SIZE_M = (0.92, 0.66, 1.80)
# Linear colours of skin.
SKIN = ((0.52, 0.31, 0.21), (0.28, 0.15, 0.09), (0.60, 0.40, 0.29))
# Linear colours of coats.
COATS = ((0.30, 0.05, 0.05), (0.05, 0.10, 0.22), (0.36, 0.31, 0.22), (0.06, 0.14, 0.09))
# Linear colours of trousers.
TROUSERS = ((0.035, 0.045, 0.08), (0.05, 0.05, 0.05), (0.20, 0.17, 0.12))


@joined
def draw_person(seed: int) -> Iterator[Shapes]:
    """Draw a person with clothes from the seed."""
    rng = np.random.default_rng(seed)
    colors = [colours[rng.integers(len(colours))] for colours in (SKIN, COATS, TROUSERS)]
    colors += [np.array((0.03, 0.02, 0.015)) * rng.uniform(1, 4), (0.03, 0.028, 0.025)]
    skin, coat, legs, hair, shoes = (Look(rgb, Class.PEDESTRIAN, spacing=0.7) for rgb in colors)
    c = np.cos(0.06)
    s = np.sin(0.06)  # the trunk leans forward
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
        shoulder = (0.0, side * 0.19, 1.41)
        elbow = (-0.13 * side, side * 0.255, 1.15)
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

# Look of trunks and boughs.
BARK = Look((0.13, 0.10, 0.075), Class.VEGETATION, Material.BARK)
# Look of leaf tufts.
LEAF = Look((0.12, 0.21, 0.04), Class.VEGETATION, Material.LEAF)
# Look of the dense core of a crown.
CROWN_CORE = Look((0.045, 0.08, 0.02), Class.VEGETATION, Material.LEAVES, ambient=0.4, spacing=3.0)
# Look of the woods far out.
WOODS = Look((0.07, 0.12, 0.035), Class.VEGETATION, Material.LEAVES, spacing=2.2)
# Leaf tufts of a street tree near the drive.
NEAR_LEAVES = 2600
# Leaf tufts of a street tree at a middle distance.
MIDDLE_LEAVES = 1200
# Leaf tufts of a street tree far from the drive.
FAR_LEAVES = 300
# Leaf tufts of a garden tree.
GARDEN_LEAVES = 80


@joined
def build_vegetation(layout: Layout) -> Iterator[Shapes]:
    """Build street trees, garden trees behind the houses, and woods far out."""
    rng = rng_of(layout.parameters, 30)
    middle = layout.parameters.path_length_m / 2
    for x, y in layout.trees:
        distance_beyond_drive = max(
            abs(x - middle) - middle, 0.0
        )  # along the street from the drive
        leaves = (
            NEAR_LEAVES
            if distance_beyond_drive < 10
            else (MIDDLE_LEAVES if distance_beyond_drive < 28 else FAR_LEAVES)
        )
        yield _tree(rng, 1.0, leaves).moved((x, y, float(pavement_z(y)) - 0.03))
    for _ in range(24):
        x = rng.uniform(layout.x0 - 8, layout.x1 + 8)
        y = rng.choice([-1, 1]) * rng.uniform(24, 33)
        yield _tree(rng, rng.uniform(1.1, 1.5), GARDEN_LEAVES).moved((x, y, 0.0))
    # Big loose crowns at the edge of the land, which hide where it ends.
    angle = rng.uniform(0, 2 * np.pi, 130)
    radius = rng.uniform(150, 215, 130)
    size = rng.uniform(5.0, 9.0, 130)
    x = (layout.x0 + layout.x1) / 2
    x = x + (1 + (layout.x1 - layout.x0) / 2 / 200) * radius * np.cos(angle)
    axes = np.eye(3) * (size[:, None] * [1.5, 1.5, 0.85])[:, None]
    woods = ellipsoids(xyz(x, radius * np.sin(angle), 0.55 * size), axes, WOODS)
    woods.variation[:] = rng.random(130)
    yield woods


@joined
def _tree(rng: np.random.Generator, size: float, num_leaves: int) -> Iterator[Shapes]:
    """Build one tree at the origin. num_leaves: number of tufts of its crown."""
    height = size * rng.uniform(3.9, 4.6)  # of the crown's middle
    radii = size * np.array([1.0, 1.0, 1.15]) * rng.uniform(1.55, 1.95)
    top = np.array([*rng.uniform(-0.12, 0.12, 2), height])
    fork = top * [1, 1, 0.62]
    yield tube((0, 0, -0.1), fork * 0.5, 0.135 * size, BARK)
    yield tube(fork * 0.48, fork, 0.115 * size, BARK)
    for k in range(4):
        angle = rng.uniform(0, 0.8) + k * np.pi / 2
        branch = np.array([np.cos(angle), np.sin(angle), 0.9]) * radii * 0.62
        yield tube(fork * 0.98, fork + branch, 0.055 * size, BARK)
    yield ball(top, radii * 0.62, CROWN_CORE)
    yield _crown(rng, top, radii, num_leaves)


def _crown(
    rng: np.random.Generator, centre: np.ndarray, radii: np.ndarray, num_leaves: int
) -> Shapes:
    """Return tufts of leaves on boughs: round lumps around a core, lighter towards the outside
    and top.
    """
    num_lumps = 34
    step = np.arange(num_lumps)
    height = 1 - (2 * step + 1) / num_lumps * 0.93  # the underside stays open around the trunk
    angle = step * 2.39996 + rng.uniform(0, 6)
    horizontal = np.sqrt(1 - height**2)
    lump_directions = xyz(horizontal * np.cos(angle), horizontal * np.sin(angle), height)
    lump_directions = unit(lump_directions + rng.normal(size=(num_lumps, 3)) * 0.12)
    lump_centre = lump_directions * rng.uniform(0.60, 0.80, (num_lumps, 1))
    lump_radius = rng.uniform(0.32, 0.44, num_lumps)
    lump_of_leaf = rng.integers(num_lumps, size=num_leaves)
    # More of them on a lump's outside.
    leaf_directions = unit(
        unit(rng.normal(size=(num_leaves, 3))) + 0.75 * lump_directions[lump_of_leaf]
    )
    leaf_distances = lump_radius[lump_of_leaf] * rng.uniform(0.7, 1.08, num_leaves)
    leaf_positions = lump_centre[lump_of_leaf] + leaf_directions * leaf_distances[:, None]
    outwards = unit(leaf_positions)
    leaf_normals = unit(leaf_directions + 0.5 * outwards + 0.45 * rng.normal(size=(num_leaves, 3)))
    leaf_sizes = 2.6 * radii.mean() / np.sqrt(num_leaves) * rng.uniform(0.75, 1.3, num_leaves)
    u = unit(cross(leaf_normals, rng.normal(size=(num_leaves, 3))))
    axes = (
        np.stack([u, cross(leaf_normals, u) * 0.72, leaf_normals * 0.22], 1)
        * leaf_sizes[:, None, None]
    )
    shapes = ellipsoids(centre + leaf_positions * radii, axes, LEAF)
    shapes.shading[:, 0] = leaf_normals
    depth = np.clip((np.linalg.norm(leaf_positions, axis=1) - 0.6) / 0.45, 0, 1)
    shapes.ambient[:] = 0.42 + 0.38 * depth + 0.22 * np.clip(outwards[:, 2], -0.4, 1)
    shapes.variation[:] = rng.random(num_leaves)
    return shapes


# ---- Cars: a lofted body with smooth plates, a glasshouse on top, wheels and lights --------------
# Car frame: x forward, y left, z up, origin on the ground under the middle.

# Linear colours of car paint.
PAINTS = (
    (0.42, 0.42, 0.43), (0.05, 0.055, 0.06), (0.62, 0.62, 0.61),
    (0.30, 0.02, 0.02), (0.03, 0.07, 0.20), (0.16, 0.17, 0.18),
    (0.05, 0.13, 0.09), (0.36, 0.26, 0.06), (0.20, 0.29, 0.36),
)  # fmt: skip
# Relative spacing of the splats of cars, which draw the eye.
CAR_SPACING = 0.6
# Paint of unpainted cars. `draw_car` replaces its negative colour.
PAINT = Look((-1.0, -1.0, -1.0), Class.VEHICLE, Material.PAINT, spacing=CAR_SPACING)
# Look of car windows.
CAR_GLASS = PAINT._replace(rgb=(0.012, 0.014, 0.016), ambient=0.8)
# Look of tyres.
TYRE = Look((0.022, 0.022, 0.023), Class.VEHICLE, spacing=CAR_SPACING)
# Look of wheel arches.
ARCH = TYRE.tinted((0.008, 0.008, 0.008))
# Look of wheel rims.
RIM = TYRE._replace(rgb=(0.46, 0.46, 0.47), material=Material.RIM)
# Look of black trim.
TRIM = TYRE.tinted((0.03, 0.03, 0.032))
# Look of headlights.
HEADLIGHT = TYRE.tinted((0.72, 0.74, 0.78))
# Look of tail lights.
TAILLIGHT = TYRE.tinted((0.42, 0.015, 0.015))
# Look of number plates.
PLATE = TYRE.tinted((0.72, 0.71, 0.62))
# Radius of the wheels.
WHEEL_RADIUS_M = 0.32


class CarModel(NamedTuple):
    """Measures of a car in metres, in the car frame."""

    length: float
    """Length of the body."""

    width: float
    """Width of the body."""

    belt_z: float
    """z of the belt line, on which the windows stand."""

    roof_z: float
    """z of the roof."""

    hood_x: float
    """x of the windscreen's lower end."""

    tail_x: float
    """x of the rear window's lower end."""

    roof_front_x: float
    """x of the windscreen's upper end."""

    roof_rear_x: float
    """x of the rear window's upper end."""

    @property
    def size_m(self) -> tuple[float, float, float]:
        """Return length, width and height of the car's box."""
        return (self.length + 0.08, self.width + 0.08, self.roof_z + 0.02 + 0.04)


# Models that cars are drawn from.
CAR_MODELS = (
    CarModel(4.25, 1.80, 0.90, 1.46, 0.95, -1.95, 0.20, -1.45),  # hatchback
    CarModel(4.60, 1.82, 0.90, 1.42, 1.00, -1.65, 0.25, -0.90),  # saloon
    CarModel(4.50, 1.86, 1.02, 1.66, 1.10, -2.10, 0.45, -1.75),  # tall estate
)


def draw_car(seed: int) -> tuple[CarModel, Shapes]:
    """Draw a car of some model and paint from the seed."""
    rng = np.random.default_rng(seed)
    model = CAR_MODELS[rng.integers(len(CAR_MODELS))]
    shapes = _build_unpainted_car(model).copy()
    shapes.rgb[shapes.rgb[:, 0] < 0] = PAINTS[rng.integers(len(PAINTS))]
    return model, shapes


@lru_cache(maxsize=len(CAR_MODELS))
@joined
def _build_unpainted_car(model: CarModel) -> Iterator[Shapes]:
    """Build a car whose paint has no colour yet."""
    yield from _body(model)
    yield from _glasshouse(model)
    yield from _wheels(model)
    yield from _details(model)


def _body(model: CarModel) -> Iterator[Shapes]:
    """Build the lower body, lofted along x through rounded cross sections."""
    half = model.length / 2
    s = np.concatenate([[-1, -0.985, -0.94], np.linspace(-0.82, 0.80, 11), [0.93, 0.982, 1]])
    x = s * half
    end = np.abs(s)
    width = model.width / 2 * (1 - 0.07 * end**4 - 0.13 * np.clip((end - 0.9) / 0.1, 0, 1) ** 2)
    hood = np.clip((x - model.hood_x + 0.25) / (half - model.hood_x + 0.25), 0, 1)
    boot = np.clip((model.tail_x + 0.2 - x) / (half + model.tail_x + 0.2), 0, 1)
    top = model.belt_z - 0.17 * hood**1.6 - 0.05 * boot - 0.14 * np.clip((end - 0.94) / 0.06, 0, 1)
    low = 0.20 + 0.12 * np.clip((end - 0.86) / 0.14, 0, 1)
    # (share of the half width, share of the height) around one side of a section, from the sill up.
    lower = ((0.90, 0), (0.97, 0.10), (1.0, 0.42), (0.985, 0.72))
    profile = np.array([*lower, (0.94, 0.91), (0.86, 0.985), (0.45, 1.03)])
    y = width[:, None] * profile[:, 0]
    z = low[:, None] + (top - low)[:, None] * profile[:, 1]
    left = xyz(x[:, None], y, z)
    right = left * [1, -1, 1]
    yield _loft(np.concatenate([right, left[:, ::-1]], 1))  # from sill over to sill
    for index, turn in ((0, -1), (-1, 1)):  # both ends
        a = right[index]
        b = left[index]
        yield quads(np.stack([a[:-1], b[:-1], b[1:], a[1:]], 1)[:, ::turn], PAINT)


def _loft(rings: np.ndarray) -> Shapes:
    """Return a smooth surface through rings [X, M, 3].

    It faces outwards if rings run right to left.
    """
    normals = np.cross(np.gradient(rings, axis=0), np.gradient(rings, axis=1))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    corners, corner_normals = (
        np.stack([g[:-1, :-1], g[1:, :-1], g[1:, 1:], g[:-1, 1:]], 2).reshape(-1, 4, 3)
        for g in (rings, normals)
    )
    return quads(corners, PAINT, normals=corner_normals)


def _glasshouse(model: CarModel) -> Iterator[Shapes]:
    """Build windscreen, side windows with pillars, rear window and roof."""
    base = model.width / 2 * 0.89
    top = model.width / 2 * 0.70
    z0 = model.belt_z - 0.02
    z1 = model.roof_z

    def side_point(s: float, t: float, sign: int) -> np.ndarray:
        """Return the point at s from rear to front and t from belt to roof."""
        rear = model.tail_x + (model.roof_rear_x - model.tail_x) * t
        front = model.hood_x + (model.roof_front_x - model.hood_x) * t
        y = sign * (base + (top - base) * t**1.3 + 0.05 * t * (1 - t) * 4)  # bulging
        return np.array([rear + (front - rear) * s, y, z0 + (z1 - z0) * t])

    levels = (0.0, 0.09, 0.50, 0.86, 1.0)
    side_cuts = (0.0, 0.06, 0.30, 0.36, 0.53, 0.58, 0.78, 0.93, 1.0)
    cells = list(itertools.product(range(len(side_cuts) - 1), range(len(levels) - 1), (1, -1)))
    for look, is_clear in ((CAR_GLASS, True), (PAINT, False)):
        corners = []
        for i, j, sign in cells:
            if (i in (1, 3, 5, 6) and j in (1, 2)) == is_clear:
                loop = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)][::-sign]
                corners.append([side_point(side_cuts[k], levels[n], sign) for k, n in loop])
        yield quads(corners, look)
    for s, sign in ((1.0, 1), (0.0, -1)):  # windscreen, rear window
        ends = [[side_point(s, t, side) for t in levels] for side in (-1, 1)]
        for look, (u0, u1), rows in (
            (CAR_GLASS, (0.06, 0.94), (1, 2)),
            (PAINT, (0.06, 0.94), (0, 3)),
            (PAINT, (0.0, 0.06), (0, 1, 2, 3)),
            (PAINT, (0.94, 1.0), (0, 1, 2, 3)),
        ):
            corners = []
            for j in rows:
                loop = [(u0, j), (u1, j), (u1, j + 1), (u0, j + 1)][::sign]
                corners.append([ends[0][k] + (ends[1][k] - ends[0][k]) * u for u, k in loop])
            yield quads(corners, look)
    # A gently domed roof.
    x = np.linspace(model.roof_rear_x, model.roof_front_x, 7)[:, None]
    lateral = np.linspace(-1, 1, 7)
    dome = 0.03 * (1 - lateral[None, :] ** 2) * np.sin(np.linspace(0, np.pi, 7))[:, None] ** 0.5
    yield _loft(xyz(x, lateral * top, model.roof_z + dome * 0.6))


def _wheels(model: CarModel) -> Iterator[Shapes]:
    radius = WHEEL_RADIUS_M
    half_width = model.width / 2
    for x in (model.length * 0.305, -model.length * 0.295):
        for side in (1, -1):
            y = side * (half_width - 0.005)
            outwards = (0.0, float(side), 0.0)
            inner = (x, side * (half_width - 0.24), radius)
            outer = (x, y + side * 0.028, radius)
            yield disc(
                (x, side * (half_width + 0.012), radius + 0.03), outwards, radius + 0.065, ARCH
            )
            yield tube(inner, outer, radius, TYRE)
            yield disc(outer, outwards, radius, TYRE)
            yield disc((x, y + side * 0.036, radius), outwards, radius * 0.68, RIM)


def _details(model: CarModel) -> Iterator[Shapes]:
    """Build lamps, mirrors, grille, number plates and bumpers."""
    half_length = model.length / 2
    half_width = model.width / 2
    front_z = model.belt_z - 0.35
    rear_z = model.belt_z - 0.20
    for side in (1, -1):
        for look, faces, x0, x1, z0, z1, inner_fraction, outer_y in (
            (
                HEADLIGHT,
                "+x +z +y -y -z",
                half_length - 0.16,
                half_length + 0.012,
                front_z - 0.06,
                front_z + 0.07,
                0.48,
                half_width * 0.80,
            ),
            (
                TAILLIGHT,
                "-x +z +y -y -z",
                -half_length - 0.012,
                -half_length + 0.16,
                rear_z - 0.10,
                rear_z + 0.07,
                0.48,
                half_width * 0.80,
            ),
            (
                TRIM,
                "+x -x +y -y +z -z",
                model.hood_x - 0.42,
                model.hood_x - 0.30,
                model.belt_z,
                model.belt_z + 0.13,
                0.93,
                half_width + 0.035,
            ),
        ):
            y0, y1 = sorted((side * half_width * inner_fraction, side * outer_y))
            yield boxes((x0, y0, z0), (x1, y1, z1), look, faces=faces.split())
    front_x = half_length + 0.010
    rear_x = -half_length - 0.010
    for plate in (
        (
            (front_x, -half_width * 0.42, front_z - 0.07),
            (0, half_width * 0.84, 0),
            (0, 0, 0.11),
            TRIM,
        ),
        ((front_x, -half_width * 0.6, 0.36), (0, half_width * 1.2, 0), (0, 0, 0.12), TRIM),
        ((half_length + 0.016, -0.26, 0.40), (0, 0.52, 0), (0, 0, 0.11), PLATE),
        ((-half_length - 0.016, -0.26, rear_z - 0.22), (0, 0, 0.11), (0, 0.52, 0), PLATE),
        ((rear_x, -half_width * 0.7, 0.34), (0, 0, 0.13), (0, half_width * 1.4, 0), TRIM),
    ):
        yield parallelograms(*plate)


# ---- Lamps, signs, litter bins and bollards ------------------------------------------------------

# Look of steel masts and poles.
STEEL = Look((0.16, 0.17, 0.17), Class.POLE)
# Look of a lantern's glass.
LANTERN = Look((0.72, 0.71, 0.66), Class.POLE)
# Look of the backs of signs.
GREY = Look((0.30, 0.31, 0.32), Class.SIGN, spacing=0.5)
# Look of white sign paint.
WHITE = GREY.tinted((0.75, 0.75, 0.74))
# Look of blue sign paint.
BLUE = GREY.tinted((0.03, 0.11, 0.36))
# Look of black sign paint.
BLACK = GREY.tinted((0.02, 0.02, 0.02))
# Look of red sign paint.
RED = GREY.tinted((0.48, 0.03, 0.03))
# Look of litter bins.
GREEN = Look((0.05, 0.10, 0.07), Class.OTHER)
# Look of bollards.
CAST_IRON = Look((0.10, 0.10, 0.105), Class.BARRIER)


def _sign_pole(height: float) -> tuple:
    """Return the builder and arguments of a sign's pole."""
    return (tube, (-0.03, 0, -0.05), (-0.03, 0, height), 0.032, STEEL)


def _sign_plate(z: float, width: float, height: float, look: Look, x=0.012, y=0.0) -> tuple:
    """Return the builder and arguments of an upright rectangle facing +x."""
    corner = (x, -width / 2 + y, z - height / 2)
    return (parallelograms, corner, (0, width, 0), (0, 0, height), look)


def _sign_back(z: float, size: float) -> tuple:
    """Return the builder and arguments of a square back facing -x."""
    return (parallelograms, (0.0, -size / 2, z - size / 2), (0, 0, size), (0, size, 0), GREY)


# Forms of furniture are tuples of (builder, its arguments).

# Form of a lamp: a tapered mast with an arm over the road (towards +y).
LAMP = (
    (tube, (0, 0, -0.05), (0, 0, 0.9), 0.085, STEEL),
    (tube, (0, 0, 0.9), (0, 0, 6.4), 0.055, STEEL),
    (tube, (0, 0, 6.35), (0, 1.5, 6.75), 0.035, STEEL),
    (boxes, (-0.14, 1.35, 6.68), (0.14, 2.05, 6.82), STEEL),
    (parallelograms, (-0.11, 1.4, 6.675), (0, 0.6, 0), (0.22, 0, 0), LANTERN),
    (ball, (0, 0, 6.38), (0.07, 0.07, 0.07), STEEL),
)
# Form of a litter bin.
LITTER_BIN = (
    (tube, (0, 0, 0.0), (0, 0, 0.85), 0.22, GREEN),
    (disc, (0, 0, 0.85), (0, 0, 1), 0.22, GREEN.tinted((0.02, 0.02, 0.02))),
    (tube, (0, 0, 0.85), (0, 0, 0.92), 0.23, STEEL),
)
# Form of a bollard.
BOLLARD = (
    (tube, (0, 0, 0.0), (0, 0, 0.85), 0.06, CAST_IRON),
    (tube, (0, 0, 0.66), (0, 0, 0.76), 0.064, WHITE),
    (ball, (0, 0, 0.85), (0.06, 0.06, 0.05), CAST_IRON),
)
# Form of the sign of a zebra crossing.
CROSSING_SIGN = (
    _sign_pole(2.75),
    _sign_back(2.45, 0.62),
    _sign_plate(2.45, 0.64, 0.64, BLUE),
    (triangles, (0.022, -0.2, 2.3), np.array([0.022, 0.2, 2.3]), (0.022, 0.0, 2.66), WHITE),
    _sign_plate(2.40, 0.09, 0.18, BLACK, 0.032),
)
# Form of the sign of a speed limit.
LIMIT_SIGN = (
    _sign_pole(2.85),
    (disc, (0.010, 0, 2.5), (1, 0, 0), 0.31, RED),
    (disc, (0.018, 0, 2.5), (1, 0, 0), 0.235, WHITE),
    (disc, (0, 0, 2.5), (-1, 0, 0), 0.31, GREY),
    _sign_plate(2.5, 0.13, 0.24, BLACK, 0.024, -0.1),
    _sign_plate(2.5, 0.045, 0.14, WHITE, 0.030, -0.1),
    _sign_plate(2.5, 0.13, 0.24, BLACK, 0.024, 0.1),
    _sign_plate(2.5, 0.045, 0.14, WHITE, 0.030, 0.1),
)
# Form of the sign of a parking place.
PARKING_SIGN = (
    _sign_pole(2.7),
    _sign_back(2.4, 0.5),
    _sign_plate(2.4, 0.52, 0.52, BLUE),
    _sign_plate(2.4, 0.07, 0.36, WHITE, 0.02, -0.09),  # the letter P
    _sign_plate(2.54, 0.18, 0.07, WHITE, 0.02, 0.02),
    _sign_plate(2.4, 0.18, 0.07, WHITE, 0.02, 0.02),
    _sign_plate(2.47, 0.07, 0.2, WHITE, 0.02, 0.11),
)
# Forms of the street's signs, in the order of Layout.signs.
SIGNS = (CROSSING_SIGN, CROSSING_SIGN, LIMIT_SIGN, LIMIT_SIGN, PARKING_SIGN)


@joined
def build_furniture(layout: Layout) -> Iterator[Shapes]:
    """Build everything man-made that stands on the pavements."""
    rng = rng_of(layout.parameters, 40)
    placements = [(LAMP, x, y, 0.0 if y < 0 else np.pi) for x, y in layout.lamps]
    for form, (x, y) in zip(SIGNS, layout.signs, strict=True):
        placements.append((form, x, y, np.pi if y < 0 else 0.0))  # facing the traffic on its side
    placements += [(LITTER_BIN, x + rng.uniform(1.2, 2.0), y, 0.0) for x, y in layout.lamps[::2]]
    for y in (ROAD_HALF_M + 0.4, -ROAD_HALF_M - 0.4):
        placements += [(BOLLARD, layout.zebra_x + dx, y, 0.0) for dx in (-3.4, 3.4, -4.6, 4.6)]
    for form, x, y, yaw in placements:
        shapes = join([build(*arguments) for build, *arguments in form])
        yield shapes.moved((x, y, float(pavement_z(y))), yaw)


# ---- The whole -----------------------------------------------------------------------------------

# Height of a typical house, for sky light between the fronts.
ROOF_Z_M = 11.5
# Depth of tyres in the road, as on their contact patch.
TYRE_SINK_M = 0.008


@dataclass(frozen=True, eq=False)
class MovingBody:
    """A mover's body in its box frame, with its motion."""

    name: str
    """Name of the mover, for example car-0."""

    label: str
    """Label of the actor, Car or Pedestrian."""

    size_m: tuple[float, float, float]
    """Length, width and height of its box."""

    body: Body
    """Shapes, tree and light in the box frame."""

    motion: Motion
    """Motion of the box centre."""


@dataclass(frozen=True, eq=False)
class Street:
    """A built street."""

    parameters: StreetParameters
    """Parameters of the street."""

    layout: Layout
    """Plan of the street."""

    static: Body
    """Body of everything that does not move."""

    movers: tuple[MovingBody, ...]
    """Moving bodies."""

    parked: tuple[tuple, ...]
    """Name, centre, size and yaw of each parked car."""


@lru_cache(maxsize=2)
def build_street(parameters: StreetParameters) -> Street:
    """Build the street of these parameters. The last two are cached."""
    layout = draw_layout(parameters)
    drive_ends_ns = np.array([frame_time_ns(0), frame_time_ns(parameters.frames - 1)])
    rng = rng_of(parameters, 7)
    builders = (build_ground, build_buildings, build_vegetation, build_furniture)
    parts = [build(layout) for build in builders]
    parked_cars = []
    for number, (x, y) in enumerate(layout.parked):  # each faces its side's traffic
        model, car = draw_car(int(rng.integers(2**31)))
        yaw = 0.0 if y < 0 else np.pi
        ground = float(road_z(PARKED_Y_M)) - TYRE_SINK_M
        parts.append(car.moved((x, y, ground), yaw))
        centre = (float(x), float(y), ground + model.size_m[2] / 2)
        parked_cars.append((f"parked-{number}", centre, model.size_m, yaw))
    shapes = join(parts)
    footprints = [(*center[:2], size[0] / 2, size[1] / 2) for _, center, size, _ in parked_cars]
    lighting = Lighting(
        to_sun=direction_to_sun(parameters.seed),
        eye_path=camera_path(parameters, drive_ends_ns),
        canyon=(-FACADE_M, FACADE_M, ROOF_Z_M),
        footprints=np.array(footprints).reshape(-1, 4),
    )
    static = Body(shapes, build_tree(shapes), lighting)
    movers = tuple(_moving_body(mover, layout, static, drive_ends_ns) for mover in layout.movers)
    return Street(parameters, layout, static, movers, tuple(parked_cars))


def _moving_body(
    mover: Mover, layout: Layout, static: Body, drive_ends_ns: np.ndarray
) -> MovingBody:
    """Build the body of a mover, with its light and motion."""
    if mover.name.startswith("car"):
        model, shapes = draw_car(mover.seed)
        size = model.size_m
        ground = float(road_z(mover.y_m)) - TYRE_SINK_M
        label = "Car"
    else:
        shapes = draw_person(mover.seed)
        size = PERSON_SIZE_M
        ground = float(pavement_z(mover.y_m))
        label = "Pedestrian"
    shapes = shapes.moved((0, 0, -size[2] / 2))
    motion = motion_of(mover, layout, size[2], ground)
    heading_sign = 1.0 if motion.yaw == 0 else -1.0  # the heading is along +x or -x
    axis_signs = np.array([heading_sign, heading_sign, 1.0])
    centre = motion.centres[0]
    walls = sorted(heading_sign * (side * FACADE_M - centre[1]) for side in (-1, 1))
    directions = static.lighting.sun_directions()
    origins = np.repeat(motion.centres, len(directions), axis=0)
    is_shaded = static.tree.occluded(origins, np.tile(directions, (len(motion.centres), 1)))
    lighting = Lighting(
        to_sun=static.lighting.to_sun * axis_signs,
        eye_path=(static.lighting.eye_path - motion.at(drive_ends_ns)[0]) * axis_signs,
        canyon=(walls[0], walls[1], ROOF_Z_M - centre[2]),
        ground_z=-size[2] / 2,
        sunlit=1 - float(is_shaded.mean()),
    )
    return MovingBody(mover.name, label, size, Body(shapes, build_tree(shapes), lighting), motion)
