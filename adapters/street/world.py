"""The assembled street: one static body and the bodies that move, each with its light."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from adapters.street.buildings import build_buildings
from adapters.street.furniture import build_furniture
from adapters.street.ground import build_ground
from adapters.street.layout import (
    FACADE_M,
    PARKED_Y_M,
    Layout,
    Mover,
    draw_layout,
    pavement_z,
    road_z,
    stream,
)
from adapters.street.lighting import Lighting, shade, sun_share
from adapters.street.materials import albedo
from adapters.street.parameters import StreetParameters
from adapters.street.people import SIZE_M, draw_person
from adapters.street.raycast import Tree, build_tree
from adapters.street.rig import (
    Motion,
    camera_path,
    frame_time_ns,
    motion_of,
)
from adapters.street.shapes import Shapes, join
from adapters.street.vegetation import build_vegetation
from adapters.street.vehicles import draw_car

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
        material, rgb, variation = (
            shapes.material[shape],
            shapes.rgb[shape],
            shapes.variation[shape],
        )
        base = np.zeros((len(shape), 3))
        for local in places:
            base += albedo(material, rgb, variation, local, shapes.points(shape, local))
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
    shapes = join(
        [
            build_ground(layout),
            build_buildings(layout),
            build_vegetation(layout),
            build_furniture(layout),
            *cars,
        ]
    )
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
    lighting = Lighting(
        to_sun=static.lighting.to_sun * flip,
        eye_path=(eyes - motion.at(ends)[0]) * flip,
        canyon=(walls[0], walls[1], ROOF_Z_M - centre[2]),
        ground_z=-size[2] / 2,
        sunlit=_sunlit(static, motion.centres),
    )
    body = Body(shapes, build_tree(shapes), lighting)
    return MovingBody(mover.name, label, size, body, motion, -size[2] / 2)


def _sunlit(static: Body, centres: np.ndarray) -> float:
    """Share of places [N, 3] that the static scene leaves in the sun."""
    directions = static.lighting.sun_directions()
    origins = np.repeat(centres, len(directions), axis=0)
    rays = np.tile(directions, (len(centres), 1))
    return 1 - float(static.tree.occluded(origins, rays).mean())
