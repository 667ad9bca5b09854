"""Cars: a lofted body with smooth panels, a glasshouse on top, wheels and lights.

Car frame: x forward, y left, z up, origin on the ground under the middle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapters.street.forms import boxes, disc, parallelograms, quads, tube
from adapters.street.materials import Material
from adapters.street.shapes import Look, Shapes, join
from augment.semantics import SemanticClass as Class

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
    def height(self) -> float:
        return self.roof + 0.02

    @property
    def size_m(self) -> tuple[float, float, float]:
        return (self.length + 0.08, self.width + 0.08, self.height + 0.04)


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
    return model, build_car(model, paint)


def build_car(model: CarModel, paint: Look) -> Shapes:
    """All surfaces of a car."""
    return join([_body(model, paint), _glasshouse(model, paint), *_wheels(model), *_details(model)])


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
    profile = np.array(
        [
            (0.90, 0),
            (0.97, 0.10),
            (1.0, 0.42),
            (0.985, 0.72),
            (0.94, 0.91),
            (0.86, 0.985),
            (0.45, 1.03),
        ]
    )
    side = np.stack(
        [
            np.broadcast_to(x[:, None], (len(x), len(profile))),
            width[:, None] * profile[:, 0],
            low[:, None] + rise[:, None] * profile[:, 1],
        ],
        -1,
    )
    ring = np.concatenate(
        [side * [1, -1, 1], side[:, ::-1]], 1
    )  # right sill, over, to the left sill
    mesh = _loft(ring, paint)
    caps = []
    for index, outward in ((0, -1), (-1, 1)):
        count = len(profile)
        right, left = ring[index, :count], ring[index, ::-1][:count]
        corners = np.stack([right[:-1], left[:-1], left[1:], right[1:]], 1)
        caps.append(quads(corners if outward > 0 else corners[:, ::-1], paint))
    return join([mesh, *caps])


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
    lean = 0.0

    def side_point(s: float, t: float, sign: int) -> np.ndarray:
        """s from rear to front, t from belt to roof."""
        rear = model.tail + (model.roof_rear - model.tail) * t
        front = model.hood + (model.roof_front - model.hood) * t
        bulge = 0.05 * t * (1 - t) * 4
        y = sign * (base + (top - base) * t**1.3 + bulge)
        return np.array([rear + (front - rear) * s, y + lean, z0 + (z1 - z0) * t])

    parts = []
    levels = (0.0, 0.09, 0.50, 0.86, 1.0)
    cuts = (0.0, 0.06, 0.30, 0.36, 0.53, 0.58, 0.78, 0.93, 1.0)
    clear = {(i, j) for i in (1, 3, 5, 6) for j in (1, 2)}
    for look, wanted in ((GLASS, True), (paint, False)):
        corners = []
        for i in range(len(cuts) - 1):
            for j in range(len(levels) - 1):
                if ((i, j) in clear) != wanted:
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
                loop = [
                    _between(side_point(s, steps[j + k], -1), side_point(s, steps[j + k], 1), u)
                    for u, k in ((u0, 0), (u1, 0), (u1, 1), (u0, 1))
                ]
                corners.append(loop if sign > 0 else loop[::-1])
            parts.append(quads(np.array(corners), look))
    parts.append(_roof(model, paint, top))
    return join(parts)


def _between(a: np.ndarray, b: np.ndarray, share: float) -> np.ndarray:
    return a + (b - a) * share


def _roof(model: CarModel, paint: Look, half_width: float) -> Shapes:
    """A gently domed roof."""
    x = np.linspace(model.roof_rear, model.roof_front, 7)
    share = np.linspace(-1, 1, 7)
    dome = 0.03 * (1 - share[None, :] ** 2) * np.sin(np.linspace(0, np.pi, 7))[:, None] ** 0.5
    grid = np.stack(
        [
            np.broadcast_to(x[:, None], (7, 7)),
            np.broadcast_to(share[None, :] * half_width, (7, 7)),
            model.roof + dome * 0.6,
        ],
        -1,
    )
    return _loft(grid, paint)


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
        y = sorted((side * width * 0.48, side * width * 0.80))
        low, high = (half - 0.16, y[0], front_z - 0.06), (half + 0.012, y[1], front_z + 0.07)
        parts.append(boxes(low, high, HEADLIGHT, faces=("+x", "+z", "+y", "-y", "-z")))
        low, high = (-half - 0.012, y[0], rear_z - 0.10), (-half + 0.16, y[1], rear_z + 0.07)
        parts.append(boxes(low, high, TAILLIGHT, faces=("-x", "+z", "+y", "-y", "-z")))
        mirror = sorted((side * width * 0.93, side * (width + 0.035)))
        low, high = (model.hood - 0.42, mirror[0], model.belt + 0.0), (0.0, mirror[1], 0.0)
        high = (model.hood - 0.30, mirror[1], model.belt + 0.13)
        parts.append(boxes(low, high, TRIM, faces=("+x", "-x", "+y", "-y", "+z", "-z")))
    grille = (half + 0.010, -width * 0.42, front_z - 0.07)
    parts.append(parallelograms(grille, (0, width * 0.84, 0), (0, 0, 0.11), TRIM))
    lower = (half + 0.010, -width * 0.6, 0.36)
    parts.append(parallelograms(lower, (0, width * 1.2, 0), (0, 0, 0.12), TRIM))
    parts.append(parallelograms((half + 0.016, -0.26, 0.40), (0, 0.52, 0), (0, 0, 0.11), PLATE))
    rear = (-half - 0.016, -0.26, rear_z - 0.22)
    parts.append(parallelograms(rear, (0, 0, 0.11), (0, 0.52, 0), PLATE))
    bumper = (-half - 0.010, -width * 0.7, 0.34)
    parts.append(parallelograms(bumper, (0, 0, 0.13), (0, width * 1.4, 0), TRIM))
    return parts
