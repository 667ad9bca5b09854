"""Where things stand: the street's plan, drawn from the seed. x runs along it, y to the left.

Each kind of thing draws from its own stream, so that one more car moves no tree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapters.street.parameters import StreetParameters

FRAME_NS = 100_000_000
START_NS = 1_700_000_000_000_000_000
LANE_M = 3.4
ROAD_HALF_M = 5.6  # a driving lane and a parking lane
KERB_TOP_M = 0.15  # the kerb stone's width
FACADE_M = 9.4
CAMBER = 0.02
KERB_RISE_M = 0.13
PAVEMENT_SLOPE = 0.012
EGO_Y_M = -1.7
PARKED_Y_M = 4.52
TREE_Y_M = 6.75
CROSS_STREET_M = 10.0  # width of the streets that end ours
TERRAIN_REACH_M = 230.0
TERRAIN_Z_M = 0.03


@dataclass(frozen=True)
class Plot:
    """One building or garden. side: +1 left, -1 right of the street."""

    x0: float
    x1: float
    side: int
    seed: int
    is_garden: bool


@dataclass(frozen=True)
class Mover:
    """Something that goes straight along x at a steady speed (negative: towards -x)."""

    name: str
    kind: str  # "car" or "pedestrian"
    x_m: float  # at the first frame
    y_m: float
    speed_mps: float
    seed: int


@dataclass(frozen=True)
class Layout:
    """The plan. x0, x1: where the street's carriageway begins and ends, metres."""

    parameters: StreetParameters
    x0: float
    x1: float
    plots: tuple[Plot, ...]
    trees: np.ndarray  # [T, 2]
    lamps: np.ndarray  # [L, 2]
    signs: np.ndarray  # [S, 2]
    parked: np.ndarray  # [C, 2]
    zebra_x: float
    movers: tuple[Mover, ...]

    @property
    def path_length_m(self) -> float:
        return path_length(self.parameters)


def path_length(parameters: StreetParameters) -> float:
    """How far the ego car drives, metres."""
    return parameters.speed_mps * (parameters.frames - 1) * FRAME_NS * 1e-9


def road_z(y: np.ndarray | float) -> np.ndarray | float:
    """Height of the carriageway: 0 at its crown, falling to both kerbs."""
    return -CAMBER * np.abs(y)


def pavement_z(y: np.ndarray | float) -> np.ndarray | float:
    """Height of the pavements, from kerb to wall."""
    kerb = -CAMBER * ROAD_HALF_M + KERB_RISE_M
    return kerb + PAVEMENT_SLOPE * (np.abs(y) - ROAD_HALF_M)


def stream(parameters: StreetParameters, *key: int) -> np.random.Generator:
    """Random numbers of one kind of thing."""
    return np.random.default_rng([parameters.seed, *key])


def draw_layout(parameters: StreetParameters) -> Layout:
    """The plan of a street."""
    length = path_length(parameters)
    x0, x1 = -62.0, length + 86.0
    zebra_x = length + 15.0
    lamps = _lamps(x0, x1)
    return Layout(
        parameters=parameters,
        x0=x0,
        x1=x1,
        plots=tuple(_plots(stream(parameters, 1), x0, x1)),
        trees=_trees(stream(parameters, 2), x0, x1, lamps, zebra_x),
        lamps=lamps,
        signs=_signs(stream(parameters, 3), zebra_x, length),
        parked=_parked(stream(parameters, 4), parameters.parked, length, zebra_x),
        zebra_x=zebra_x,
        movers=tuple(_movers(stream(parameters, 5), parameters, length)),
    )


def _plots(rng: np.random.Generator, x0: float, x1: float) -> list[Plot]:
    plots = []
    for side in (1, -1):
        x, last_was_garden = x0 - 2.0, True
        while x < x1 - 3.0:
            garden = not last_was_garden and x < x1 - 20 and rng.random() < 0.13
            width = rng.uniform(4.5, 7.5) if garden else rng.uniform(7.5, 13.0)
            end = x + width
            if x1 + 1.0 - end < 7.0:
                end = x1 + 1.0
                garden = False
            plots.append(Plot(x, end, side, int(rng.integers(2**31)), garden))
            x, last_was_garden = end, garden
    return plots


def _lamps(x0: float, x1: float) -> np.ndarray:
    left = np.arange(x0 + 10.0, x1 - 4.0, 26.0)
    right = np.arange(x0 + 23.0, x1 - 4.0, 26.0)
    y = ROAD_HALF_M + 0.55
    return np.concatenate(
        [np.stack([left, np.full_like(left, y)], 1), np.stack([right, np.full_like(right, -y)], 1)]
    )


def _trees(
    rng: np.random.Generator, x0: float, x1: float, lamps: np.ndarray, zebra_x: float
) -> np.ndarray:
    trees = []
    for side in (1, -1):
        x = x0 + rng.uniform(2, 9)
        while x < x1 - 3:
            place = np.array([x, side * TREE_Y_M])
            clear = np.abs(lamps - place).sum(1).min() > 3.0 and abs(x - zebra_x) > 4.5
            if clear and rng.random() > 0.25:
                trees.append(place)
            x += rng.uniform(8.0, 12.5)
    return np.array(trees).reshape(-1, 2)


def _signs(rng: np.random.Generator, zebra_x: float, length: float) -> np.ndarray:
    y = ROAD_HALF_M + 0.45
    places = [(zebra_x - 2.6, -y), (zebra_x + 2.6, y), (rng.uniform(6, 9), -y)]
    places += [(length + rng.uniform(36, 40), -y), (-rng.uniform(16, 20), y)]
    return np.array(places)


def _parked(rng: np.random.Generator, count: int, length: float, zebra_x: float) -> np.ndarray:
    slots = []
    for side in (1, -1):
        for x in np.arange(-26.0, length + 58.0, 6.1):
            if abs(x - zebra_x) > 5.5:
                slots.append((x + rng.uniform(-0.4, 0.4), side * PARKED_Y_M))
    chosen = rng.permutation(len(slots))[:count]
    return np.array([slots[i] for i in sorted(chosen)]).reshape(-1, 2)


def _movers(rng: np.random.Generator, parameters: StreetParameters, length: float) -> list[Mover]:
    ego = parameters.speed_mps
    lane = LANE_M / 2
    cars = [
        (17.0, -lane, ego + 0.6),
        (34.0, lane, -9.0),
        (-13.0, -lane, ego - 0.4),
        (62.0, lane, -8.2),
        (-24.0, lane, -9.5),
        (33.0, -lane, ego + 0.9),
    ]
    movers = [
        Mover(f"car-{i}", "car", x, y, v, int(rng.integers(2**31)))
        for i, (x, y, v) in enumerate(cars[: parameters.moving])
    ]
    for i in range(parameters.pedestrians):
        side, direction = (-1, 1)[i % 2], (1, -1)[(i // 2 + i) % 2]
        place = rng.uniform(7, 10) + 4.5 * i + length * 0.25
        movers.append(
            Mover(
                f"pedestrian-{i}",
                "pedestrian",
                place,
                side * rng.uniform(7.7, 8.5),
                direction * rng.uniform(1.2, 1.6),
                int(rng.integers(2**31)),
            )
        )
    return movers
