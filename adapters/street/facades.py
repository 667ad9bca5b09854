"""Parts of a house front, built in its own frame: x along the wall, y into the house, z up.

The wall's outer face is the plane y = 0, seen from y < 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from adapters.street.forms import boxes, parallelograms
from adapters.street.materials import Material
from adapters.street.rectangles import Rectangle, cut
from adapters.street.shapes import ALL_EDGES, Look, Shapes, join
from augment.semantics import SemanticClass as Class

REVEAL_M = 0.14  # how deep windows stand in the wall
GLASS = Look((0.022, 0.026, 0.03), Class.BUILDING, Material.GLASS, backed=True)


@dataclass(frozen=True)
class Style:
    """The looks and measures of one house."""

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


def panels(rectangles: np.ndarray, depth_m: float, look: Look, edges: np.ndarray | int) -> Shapes:
    """Upright panels over (x, z) rectangles [R, 4] at y = depth_m, seen from the street."""
    x0, z0, x1, z1 = np.asarray(rectangles, np.float64).reshape(-1, 4).T
    zero = np.zeros_like(x0)
    return parallelograms(
        np.stack([x0, zero + depth_m, z0], 1),
        np.stack([x1 - x0, zero, zero], 1),
        np.stack([zero, zero, z1 - z0], 1),
        look,
        edges=edges,
    )


def reveals(opening: Rectangle, depth_m: float, look: Look) -> Shapes:
    """The four inner faces of an opening, from the wall's face to depth_m."""
    x0, z0, x1, z1 = opening
    into, up, along = (0, depth_m, 0), (0, 0, z1 - z0), (x1 - x0, 0, 0)
    shaded = Look(look.rgb, look.semantic, look.material, ambient=0.75)
    return parallelograms(
        [(x0, 0, z0), (x1, 0, z0), (x0, 0, z0), (x0, 0, z1)],
        [into, up, along, into],
        [up, into, into, along],
        shaded,
    )


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
    glass = panels(np.array(panes), depth_m, pane, ALL_EDGES)
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
    leaf = (x0 + 0.06, z0, x1 - 0.06, split)
    fields = [
        (leaf[0] + 0.14, z0 + 0.25, leaf[2] - 0.14, z0 + 0.95),
        (leaf[0] + 0.14, z0 + 1.1, leaf[2] - 0.14, split - 0.16),
    ]
    frames, edges = cut(opening, [leaf, (x0 + 0.06, split + 0.06, x1 - 0.06, z1 - 0.06)])
    stiles, stile_edges = cut(leaf, fields)
    dark = style.accent.tinted(np.array(style.accent.rgb) * 0.7)
    light = np.array([(x0 + 0.06, split + 0.06, x1 - 0.06, z1 - 0.06)])
    return join(
        [
            panels(frames, REVEAL_M - 0.02, style.frame, edges),
            panels(stiles, REVEAL_M, style.accent, stile_edges),
            panels(np.array(fields), REVEAL_M + 0.015, dark, ALL_EDGES),
            panels(light, REVEAL_M, GLASS, ALL_EDGES),
            reveals(opening, REVEAL_M, style.wall),
            boxes((x0 - 0.1, -0.35, -0.3), (x1 + 0.1, REVEAL_M, z0), style.base),
        ]
    )


def shop_front(opening: Rectangle, style: Style, awning: bool) -> Shapes:
    """A shop: plinth, large panes, a glass door, a sign above and perhaps an awning."""
    x0, z0, x1, z1 = opening
    depth = 0.18
    door_x = x1 - 1.25
    plinth = (x0, z0, door_x, z0 + 0.5)
    show = (x0, z0 + 0.5, door_x, z1)
    entry = (door_x, z0, x1, z1)
    sign_z = z1 + 0.08
    parts = [
        panels(np.array([plinth]), depth - 0.04, style.accent, ALL_EDGES),
        glazing(show, max(1, round((door_x - x0) / 1.7)), 1, depth, style.accent, 0.09, SHOP_GLASS),
        glazing(entry, 1, 2, depth, style.accent, 0.11),
        reveals(opening, depth, style.accent),
        boxes(
            (x0 - 0.1, -0.12, sign_z), (x1 + 0.1, 0.02, sign_z + 0.62), style.accent, faces=_FRONT
        ),
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
    rectangles = np.stack([starts, np.full(count, z + 0.17), starts + 0.2, z + 0.17 + tall], 1)[
        (np.arange(count) % 5) != 3
    ]
    return panels(rectangles, -0.135, style.trim, ALL_EDGES)


def _awning(x0: float, x1: float, z: float, style: Style) -> Shapes:
    """Striped cloth, sloping out over the pavement, with a hem."""
    count = max(4, round((x1 - x0) / 0.45))
    edges = np.linspace(x0, x1, count + 1)
    parts = []
    for start, shade in ((0, style.accent), (1, style.trim)):
        x = edges[:-1][start::2]
        width = np.full(len(x), (x1 - x0) / count)
        zero = np.zeros_like(x)
        u = np.stack([width, zero, zero], 1)
        top = np.stack([x, zero - 1.25, zero + z - 0.55], 1)
        slope = np.array([0.0, 1.2, 0.55])
        hem = np.array([0.0, 0.0, -0.2])
        parts.append(parallelograms(top, u, slope, shade))
        parts.append(parallelograms(top + hem, u, -hem, shade))
    return join(parts)
