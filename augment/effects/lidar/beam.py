"""A LiDAR's beams and what they bring back: the strongest echo of each, which effects change.

Every return is a row of the source and stays one; `codes` says what became of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from augment.effects.lidar.codes import (
    ATTENUATED,
    CODE_COLUMN,
    INDEX_COLUMN,
    LOST,
    MOVED,
    UNCHANGED,
)
from augment.labels import KnowsLidarOrigins, LidarSweep
from augment.scene import Scene

# ---- The sensor: its optics as assumed, its intensities, where its beams start -------------------

LIGHT_MPS = 299_792_458.0
INTENSITY_COLUMNS = ("intensity", "i", "reflectance", "reflectivity")
UNKNOWN_REFLECTANCE = 0.10  # of a surface, where the sweep has no intensities
FAINTEST = 0.005  # reflectance that an intensity of 0 stands for: half a step of 8 bits
EGO_SENSOR_M = (0.0, 0.0, 1.8)  # forward, left, up of the ego origin, where nothing else is known


@dataclass(frozen=True)
class LidarModel:
    """A spinning 905 nm LiDAR; datasets do not publish their own.

    reach_m: where a surface of 10 % reflectance is just seen in clear air; it stands for the noise.
    pulse_fwhm_s: half-power width of the emitted sin^2 pulse. overlap_from_m, overlap_full_m: from
    where the receiver sees the beam, and all of it (Hahner et al. 2021, section 3). near_gain:
    share of a signal from the first metres that is not suppressed, unpublished: the default makes
    fog of 40 m visibility cost a surface of 50 % reflectance at 25 m, as far as LiDARs see in it
    (Bijelic, Gruber and Ritter 2018, "A Benchmark for Lidar Sensors in Fog"). focus_m: nearer
    spots are out of focus, and the receiver's field holds (r / focus_m)^2 of their light: that of a
    lens of 3 cm over a field of 3 mrad, and near_gain at 1 m. aperture_m, divergence_rad: the
    beam's diameter as it leaves, and how it grows. range_noise_m: an echo n times as strong as
    the noise has a range of error range_noise_m / sqrt(2 n) (both of Kilic et al. 2021).
    """

    wavelength_um: float = 0.905
    reach_m: float = 150.0
    pulse_fwhm_s: float = 10e-9
    overlap_from_m: float = 0.9
    overlap_full_m: float = 1.0
    near_gain: float = 0.01
    focus_m: float = 10.0
    aperture_m: float = 0.01
    divergence_rad: float = 3e-3
    range_noise_m: float = 0.09

    @property
    def pulse_m(self) -> float:
        """Half the emitted pulse's length as ranges count, c tau / 2."""
        return LIGHT_MPS * self.pulse_fwhm_s / 2

    def noise_reflectance(self, ranges_m: np.ndarray) -> np.ndarray:
        """The reflectance that is just seen at a range in clear air: 0.1 (R / reach)^2."""
        return 0.1 * (ranges_m / self.reach_m) ** 2

    @property
    def noise_signal(self) -> float:
        """What is just seen at any range, as `signal` has it."""
        return 0.1 / (math.pi * self.reach_m**2)


DEFAULT_MODEL = LidarModel()


def intensity_column(sweep: LidarSweep) -> str | None:
    """The name of the column that holds intensities; None where there is none."""
    for name in INTENSITY_COLUMNS:
        column = sweep.columns.get(name)
        if column is not None and np.asarray(column).dtype.kind in "fiu":
            return name
    return None


def white_level(intensity: np.ndarray) -> float:
    """The intensity of a white, diffuse surface that is met head on: 1 of fractions, else 100, as
    Velodyne and Hesai document their 8 bits; what is above comes from retroreflectors.
    """
    values = np.asarray(intensity)
    if values.dtype.kind == "f":
        finite = values[np.isfinite(values)]
        if finite.size == 0 or finite.max() <= 1:
            return 1.0
    return 100.0


def highest_intensity(intensity: np.ndarray) -> float:
    """The highest intensity that the sensor reports: 1 of fractions, else 255, as of 8 bits, or
    what the sweep itself holds where that is more.
    """
    values = np.asarray(intensity)
    top = 1.0 if white_level(values) == 1 else 255.0
    return max(top, float(np.max(values, initial=top, where=np.isfinite(values))))


def reflectances(sweep: LidarSweep) -> np.ndarray:
    """Reflectance of each return's surface, float64 [N], FAINTEST at least; incidence included, as
    sensors do not take it out.
    """
    name = intensity_column(sweep)
    if name is None:
        return np.full(len(sweep), UNKNOWN_REFLECTANCE)
    values = np.asarray(sweep.columns[name], np.float64)
    return np.maximum(np.nan_to_num(values / white_level(sweep.columns[name])), FAINTEST)


def origins_of(scene: Scene, frame_index: int, sweep: LidarSweep) -> np.ndarray:
    """Where each return's beam started, float64 [N, 3], dataset world.

    From the labels where they know. Else EGO_SENSOR_M at the frame's time, which is wrong by the
    sensor's place on its car and by what the car drove within the sweep.

    Raises:
        ValueError: what the labels gave is not one origin a return.
    """
    labels = scene.labels
    if isinstance(labels, KnowsLidarOrigins):
        known = labels.lidar_origins(frame_index, sweep)
        if known is not None:
            known = np.asarray(known, np.float64)
            if known.shape != (len(sweep), 3):
                raise ValueError(
                    f"lidar_origins of {type(labels).__name__} must be [{len(sweep)}, 3], one for "
                    f"each return of frame {frame_index}; got {list(known.shape)}"
                )
            return known
    pose = scene.frame(frame_index).world_from_ego.numpy()
    origin = pose[:3, :3] @ np.array(EGO_SENSOR_M) + pose[:3, 3]
    return np.broadcast_to(origin + np.asarray(scene.world_origin_m), (len(sweep), 3))


def signal(reflectance: np.ndarray, ranges_m: np.ndarray) -> np.ndarray:
    """Power of an echo, in the units of `smog.soft_response`: reflectance / (pi R^2), 1/m^2/sr."""
    return reflectance / (math.pi * ranges_m**2)


# ---- The strongest echo of every beam, which one effect after another changes --------------------

_MIN_M = 1e-3  # nearer returns have no direction


@dataclass(eq=False)
class Echoes:
    """The echoes of a sweep of N returns; arrays change in place.

    origins, directions [N, 3]: scene world; directions are unit. ranges_m [N]: as reported, 0 where
    the source has no point: such rows are never touched. air_m [N]: of the way, through the air.
    reflectance [N]: of what gives the echo, incidence included, relative to a white surface met
    head on. gain [N]: what the weather leaves of the echo. haze_per_m [N]: extinction about the
    sensor, of what has dimmed echoes so far. is_new [N]: the echo is not the source's, so its
    intensity follows from reflectance. is_moved [N]: it lies elsewhere than in the source.
    """

    source: LidarSweep
    model: LidarModel
    dataset_origins: np.ndarray
    origins: np.ndarray
    directions: np.ndarray
    ranges_m: np.ndarray
    air_m: np.ndarray
    reflectance: np.ndarray
    gain: np.ndarray
    haze_per_m: np.ndarray
    codes: np.ndarray
    is_new: np.ndarray
    is_moved: np.ndarray

    @staticmethod
    def of(
        sweep: LidarSweep, origins: np.ndarray, world_origin_m: np.ndarray, model: LidarModel
    ) -> Echoes:
        """As recorded in clear air. origins: float64 [N, 3], dataset world.

        What was recorded was above the sensor's noise, however dark: it counts as just so bright.
        """
        count = len(sweep)
        offsets = sweep.points_m - origins
        ranges = np.sqrt((offsets * offsets).sum(1))
        ranges[~(np.isfinite(ranges) & (ranges > _MIN_M))] = 0
        directions = offsets / np.where(ranges > 0, ranges, 1.0)[:, None]
        directions[ranges == 0] = 0
        starts = np.where((ranges > 0)[:, None], origins - world_origin_m, 0.0)
        return Echoes(
            source=sweep,
            model=model,
            dataset_origins=origins,
            origins=starts,
            directions=directions,
            ranges_m=ranges,
            air_m=ranges.copy(),
            reflectance=np.maximum(reflectances(sweep), model.noise_reflectance(ranges)),
            gain=np.ones(count),
            haze_per_m=np.zeros(count),
            codes=np.full(count, UNCHANGED, np.uint8),
            is_new=np.zeros(count, bool),
            is_moved=np.zeros(count, bool),
        )

    def replace(
        self, rows: np.ndarray, ranges_m: np.ndarray, reflectance: np.ndarray, code: int
    ) -> None:
        """Echoes [M] of something else, met in the air, for the returns in rows [M]."""
        self.ranges_m[rows] = self.air_m[rows] = ranges_m
        self.reflectance[rows], self.gain[rows] = reflectance, 1.0
        self.codes[rows] = code
        self.is_new[rows] = self.is_moved[rows] = True

    def see_through(
        self, rows: np.ndarray, ranges_m: np.ndarray, air_m: np.ndarray, kept: np.ndarray
    ) -> None:
        """Move the returns in rows [M] along their beams, and dim them to kept [M]."""
        moves = np.abs(ranges_m - self.ranges_m[rows]) > _MIN_M
        self.codes[rows[moves]] = MOVED
        self.is_moved[rows[moves]] = True
        self.ranges_m[rows[moves]] = ranges_m[moves]
        self.air_m[rows] = air_m
        self.gain[rows] *= kept

    def spread_ranges(self, gain_before: np.ndarray, normal: np.ndarray) -> None:
        """Ranges with the noise that echoes have gained since their gain was gain_before [N], by
        normal variates [N]: what was recorded has the rest. An echo at the noise has most.
        """
        levels = self.reflectance / self.model.noise_reflectance(np.maximum(self.ranges_m, _MIN_M))
        inverse = [1 / np.maximum(levels * gain, 1.0) for gain in (self.gain, gain_before)]
        sigma = self.model.range_noise_m * np.sqrt(np.maximum(inverse[0] - inverse[1], 0) / 2)
        rows = np.flatnonzero((sigma > 0) & (self.ranges_m > 0) & (self.codes != LOST))
        noisy = self.ranges_m[rows] + sigma[rows] * normal[rows]
        self.ranges_m[rows] = np.maximum(noisy, _MIN_M)
        self.is_moved[rows] = True
        self.codes[rows[self.codes[rows] == UNCHANGED]] = ATTENUATED

    def lose_faint(self) -> None:
        """Lose what is below the sensor's noise."""
        faint = self.reflectance * self.gain < self.model.noise_reflectance(self.ranges_m)
        self.codes[faint & (self.ranges_m > 0)] = LOST

    def sweep(self) -> LidarSweep:
        """As `weathered_sweep` returns it."""
        columns = {name: np.asarray(column) for name, column in self.source.columns.items()}
        columns |= self._coordinates(columns)
        name = intensity_column(self.source)
        if name is not None:
            columns[name] = self._intensity(columns[name])
        columns[INDEX_COLUMN] = np.arange(len(self.codes), dtype=np.int32)
        columns[CODE_COLUMN] = self.codes
        return LidarSweep(columns)

    def _coordinates(self, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        lost = self.codes == LOST
        rows = np.flatnonzero(self.is_moved & ~lost)
        if not len(rows) and not lost.any():
            return {}
        moved = self.dataset_origins[rows] + self.ranges_m[rows, None] * self.directions[rows]
        out = {}
        for axis, name in enumerate("xyz"):
            floats = columns[name].dtype.kind == "f"
            out[name] = columns[name].astype(columns[name].dtype if floats else np.float64)
            out[name][rows] = moved[:, axis]
            out[name][lost] = np.nan
        return out

    def _intensity(self, column: np.ndarray) -> np.ndarray:
        """The intensities; rows that were unchanged so far are attenuated where theirs change."""
        rows = np.flatnonzero((self.gain != 1) | self.is_new | (self.codes == LOST))
        if not len(rows):
            return column
        old = column[rows]
        own = white_level(column) * self.reflectance[rows]
        values = np.where(self.is_new[rows], own, old) * self.gain[rows]
        values[self.codes[rows] == LOST] = 0
        values = np.minimum(values, highest_intensity(column))
        if column.dtype.kind in "iu":
            limits = np.iinfo(column.dtype)
            values = np.clip(np.rint(values), limits.min, limits.max)
        values = values.astype(column.dtype)
        changed = (values != old) & (old == old)  # NaN was no intensity and is none
        self.codes[rows[changed & (self.codes[rows] == UNCHANGED)]] = ATTENUATED
        out = column.copy()
        out[rows] = values
        return out
