"""What stands and moves on a street: people, trees, cars, lamps, signs, bins and bollards."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from adapters.street.forms import (
    Look,
    Material,
    Shapes,
    ball,
    boxes,
    disc,
    ellipsoids,
    join,
    parallelograms,
    quads,
    triangle,
    tube,
)
from adapters.street.layout import ROAD_HALF_M, Layout, pavement_z
from augment.semantics import SemanticClass as Class

# ---- A person in mid-stride: tubes and ellipsoids, one rigid body --------------------------------
# Frame: x forward, y left, z up, origin on the ground between the feet.

SIZE_M = (0.92, 0.66, 1.80)
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
    rng = np.random.default_rng([layout.parameters.seed, 30])
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


# ---- Cars: a lofted body with smooth panels, a glasshouse on top, wheels and lights --------------
# Car frame: x forward, y left, z up, origin on the ground under the middle.

PAINTS = (
    (0.42, 0.42, 0.43),
    (0.05, 0.055, 0.06),
    (0.62, 0.62, 0.61),
    (0.30, 0.02, 0.02),
    (0.03, 0.07, 0.20),
    (0.16, 0.17, 0.18),
    (0.05, 0.13, 0.09),
    (0.36, 0.26, 0.06),
    (0.20, 0.29, 0.36),
)
SPACING = 0.6  # cars draw the eye
GLASS = Look((0.012, 0.014, 0.016), Class.VEHICLE, Material.PAINT, 0.8, SPACING)
TYRE = Look((0.022, 0.022, 0.023), Class.VEHICLE, spacing=SPACING)
ARCH = Look((0.008, 0.008, 0.008), Class.VEHICLE, spacing=SPACING)
RIM = Look((0.46, 0.46, 0.47), Class.VEHICLE, Material.RIM, spacing=SPACING)
TRIM = Look((0.03, 0.03, 0.032), Class.VEHICLE, spacing=SPACING)
HEADLIGHT = Look((0.72, 0.74, 0.78), Class.VEHICLE, spacing=SPACING)
TAILLIGHT = Look((0.42, 0.015, 0.015), Class.VEHICLE, spacing=SPACING)
PLATE = Look((0.72, 0.71, 0.62), Class.VEHICLE, spacing=SPACING)
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


MODELS = (
    CarModel(4.25, 1.80, 0.90, 1.46, 0.95, -1.95, 0.20, -1.45),  # hatchback
    CarModel(4.60, 1.82, 0.90, 1.42, 1.00, -1.65, 0.25, -0.90),  # saloon
    CarModel(4.50, 1.86, 1.02, 1.66, 1.10, -2.10, 0.45, -1.75),  # tall estate
)


def draw_car(seed: int) -> tuple[CarModel, Shapes]:
    """A car of some model and paint."""
    rng = np.random.default_rng(seed)
    model = MODELS[rng.integers(len(MODELS))]
    rgb = PAINTS[rng.integers(len(PAINTS))]
    paint = Look(rgb, Class.VEHICLE, Material.PAINT, spacing=SPACING)
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
    for look, is_clear in ((GLASS, True), (paint, False)):
        corners = []
        for i, j in panes:
            if ((i, j) in clear) != is_clear:
                continue
            a, b, c, d = cuts[i], cuts[i + 1], levels[j], levels[j + 1]
            for sign in (1, -1):
                loop = [side_point(*q, sign) for q in ((a, c), (b, c), (b, d), (a, d))]
                corners.append(loop[::-1] if sign > 0 else loop)
        parts.append(quads(np.array(corners), look))
    for s, steps, sign in ((1.0, levels, 1), (0.0, levels, -1)):  # windscreen, rear window
        for look, (u0, u1), chosen in (
            (GLASS, (0.06, 0.94), (1, 2)),
            (paint, (0.06, 0.94), (0, 3)),
            (paint, (0.0, 0.06), (0, 1, 2, 3)),
            (paint, (0.94, 1.0), (0, 1, 2, 3)),
        ):
            corners = []
            for j in chosen:
                loop = []
                for u, k in ((u0, 0), (u1, 0), (u1, 1), (u0, 1)):
                    left, right = (side_point(s, steps[j + k], side) for side in (-1, 1))
                    loop.append(left + (right - left) * u)
                corners.append(loop if sign > 0 else loop[::-1])
            parts.append(quads(np.array(corners), look))
    parts.append(_roof(model, paint, top))
    return join(parts)


def _roof(model: CarModel, paint: Look, half_width: float) -> Shapes:
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
        low, high = (
            (model.hood - 0.42, y0, model.belt + 0.0),
            (model.hood - 0.30, y1, model.belt + 0.13),
        )
        parts.append(boxes(low, high, TRIM, faces=("+x", "-x", "+y", "-y", "+z", "-z")))
    front, back = half + 0.010, -half - 0.010
    panels = (
        (
            (front, -width * 0.42, front_z - 0.07),
            (0, width * 0.84, 0),
            (0, 0, 0.11),
            TRIM,
        ),  # grille
        ((front, -width * 0.6, 0.36), (0, width * 1.2, 0), (0, 0, 0.12), TRIM),
        ((half + 0.016, -0.26, 0.40), (0, 0.52, 0), (0, 0, 0.11), PLATE),
        ((-half - 0.016, -0.26, rear_z - 0.22), (0, 0, 0.11), (0, 0.52, 0), PLATE),
        ((back, -width * 0.7, 0.34), (0, 0, 0.13), (0, width * 1.4, 0), TRIM),  # bumper
    )
    return parts + [parallelograms(*panel) for panel in panels]


# ---- Lamps, signs, litter bins and bollards ------------------------------------------------------

STEEL = Look((0.16, 0.17, 0.17), Class.POLE)
LANTERN = Look((0.72, 0.71, 0.66), Class.POLE)
GREY = Look((0.30, 0.31, 0.32), Class.SIGN, spacing=0.5)
WHITE = Look((0.75, 0.75, 0.74), Class.SIGN, spacing=0.5)
BLUE = Look((0.03, 0.11, 0.36), Class.SIGN, spacing=0.5)
BLACK = Look((0.02, 0.02, 0.02), Class.SIGN, spacing=0.5)
RED = Look((0.48, 0.03, 0.03), Class.SIGN, spacing=0.5)
GREEN = Look((0.05, 0.10, 0.07), Class.OTHER)
IRON = Look((0.10, 0.10, 0.105), Class.BARRIER)


def build_furniture(layout: Layout) -> Shapes:
    """Everything man-made that stands on the pavements."""
    rng = np.random.default_rng([layout.parameters.seed, 40])
    lamp, bollard, litter_bin = _joined(LAMP), _joined(BOLLARD), _joined(LITTER_BIN)
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
    (tube, (0, 0, 0.0), (0, 0, 0.85), 0.06, IRON),
    (tube, (0, 0, 0.66), (0, 0, 0.76), 0.064, WHITE),
    (ball, (0, 0, 0.85), (0.06, 0.06, 0.05), IRON),
)


def _joined(parts: Iterable[tuple]) -> Shapes:
    return join([build(*arguments) for build, *arguments in parts])


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
    for y, z, width, height in strokes:
        parts.append(_plate(z, width, height, WHITE, 0.02).moved((0, y, 0)))
    return join(parts)
