"""Models a LiDAR's beams and the strongest echo of each, which one effect after another changes.

`augment.view.weathered_sweep` makes `Echoes` from a recorded sweep, passes them to every effect,
and takes the weathered sweep from them. Every return is a row of the source and stays one; `codes`
names what became of it.
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
from augment.scene.labels import KnowsLidarOrigins, LidarSweep
from augment.scene.scene import Scene

# ---- The sensor: its optics as assumed, its intensities, where its beams start -------------------

LIGHT_SPEED_MPS = 299_792_458.0  # speed of light
# Names of the column that holds intensities.
INTENSITY_COLUMNS = ("intensity", "i", "reflectance", "reflectivity")
UNKNOWN_REFLECTANCE = 0.10  # reflectance of a surface if the sweep has no intensities
MIN_REFLECTANCE = 0.005  # reflectance for an intensity of 0: half a step of 8 bits
# Place of a sensor forward, left and up of the ego origin, if nothing else is known.
EGO_SENSOR_M = (0.0, 0.0, 1.8)


@dataclass(frozen=True)
class LidarModel:
    """Spinning 905 nm LiDAR; datasets do not publish the optics of their own."""

    wavelength_um: float = 0.905
    # Range at which a surface of 10 % reflectance is just seen in clear air; it stands for noise.
    reach_m: float = 150.0
    pulse_fwhm_s: float = 10e-9  # half-power width of the emitted sin^2 pulse
    # Ranges from which on the receiver sees a part of the beam, and all of it (Hahner et al. 2021,
    # section 3).
    overlap_from_m: float = 0.9
    overlap_full_m: float = 1.0
    # Share of a signal from the first metres that is not suppressed; unpublished. The default makes
    # fog of 40 m visibility cost a surface of 50 % reflectance at 25 m, as far as LiDARs see in it
    # (Bijelic, Gruber and Ritter 2018, "A Benchmark for Lidar Sensors in Fog").
    near_gain: float = 0.01
    # Nearer spots are out of focus, and the receiver's field holds (r / focus_m)^2 of their light:
    # that of a lens of 3 cm over a field of 3 mrad, and near_gain at 1 m.
    focus_m: float = 10.0
    aperture_m: float = 0.01  # diameter of the beam as it leaves the sensor
    divergence_rad: float = 3e-3  # growth of that diameter with range
    # An echo n times as strong as the noise has a range error of range_noise_m / sqrt(2 n). This
    # and the two fields before are from Kilic et al. 2021.
    range_noise_m: float = 0.09

    @property
    def pulse_m(self) -> float:
        """Half the emitted pulse's length in ranges, c tau / 2."""
        return LIGHT_SPEED_MPS * self.pulse_fwhm_s / 2

    def noise_reflectance(self, ranges_m: np.ndarray) -> np.ndarray:
        """Return the reflectance that is just seen at a range in clear air: 0.1 (R / reach)^2."""
        return 0.1 * (ranges_m / self.reach_m) ** 2

    @property
    def noise_signal(self) -> float:
        """Signal that is just seen at any range, in the units of `signal`."""
        return 0.1 / (math.pi * self.reach_m**2)


DEFAULT_MODEL = LidarModel()


def find_intensity_column(sweep: LidarSweep) -> str | None:
    """Return the name of the column that holds intensities; None where there is none."""
    for name in INTENSITY_COLUMNS:
        column = sweep.columns.get(name)
        if column is not None and np.asarray(column).dtype.kind in "fiu":
            return name
    return None


def white_level(intensity: np.ndarray) -> float:
    """Return the intensity of a white, diffuse surface that is met head on.

    It is 1 if intensities are fractions, else 100, as Velodyne and Hesai document for their 8 bits.
    Higher intensities come from retroreflectors.
    """
    values = np.asarray(intensity)
    if values.dtype.kind == "f":
        finite = values[np.isfinite(values)]
        if finite.size == 0 or finite.max() <= 1:
            return 1.0
    return 100.0


def highest_intensity(intensity: np.ndarray) -> float:
    """Return the highest intensity that the sensor reports.

    It is 1 if intensities are fractions, else 255, as of 8 bits, or the sweep's own highest value
    where that is more.
    """
    values = np.asarray(intensity)
    top = 1.0 if white_level(values) == 1 else 255.0
    return max(top, float(np.max(values, initial=top, where=np.isfinite(values))))


def find_reflectances(sweep: LidarSweep) -> np.ndarray:
    """Return the reflectance of each return's surface, float64 [N], MIN_REFLECTANCE at least.

    It includes the cosine of incidence, since sensors do not divide by it.
    """
    name = find_intensity_column(sweep)
    if name is None:
        return np.full(len(sweep), UNKNOWN_REFLECTANCE)
    values = np.asarray(sweep.columns[name], np.float64)
    return np.maximum(np.nan_to_num(values / white_level(sweep.columns[name])), MIN_REFLECTANCE)


def find_beam_origins(scene: Scene, frame_index: int, sweep: LidarSweep) -> np.ndarray:
    """Return where each return's beam started, float64 [N, 3], dataset world.

    Labels give it if they know it. Otherwise it is EGO_SENSOR_M at the frame's time, which is wrong
    by the sensor's place on its car and by the distance that the car drove within the sweep.

    Raises:
        ValueError: the labels did not give one origin for each return.
    """
    labels = scene.labels
    if isinstance(labels, KnowsLidarOrigins):
        known_origins = labels.lidar_origins(frame_index, sweep)
        if known_origins is not None:
            known_origins = np.asarray(known_origins, np.float64)
            if known_origins.shape != (len(sweep), 3):
                raise ValueError(
                    f"lidar_origins of {type(labels).__name__} must be [{len(sweep)}, 3], one for "
                    f"each return of frame {frame_index}; got {list(known_origins.shape)}"
                )
            return known_origins
    pose = scene.frame(frame_index).world_from_ego.numpy()
    origin = pose[:3, :3] @ np.array(EGO_SENSOR_M) + pose[:3, 3]
    return np.broadcast_to(origin + np.asarray(scene.world_origin_m), (len(sweep), 3))


def signal(reflectance: np.ndarray, ranges_m: np.ndarray) -> np.ndarray:
    """Return the power of an echo, reflectance / (pi R^2), 1/m^2/sr.

    The units are those of `smog.soft_response`.
    """
    return reflectance / (math.pi * ranges_m**2)


# ---- The strongest echo of every beam, which one effect after another changes --------------------

_MIN_RANGE_M = 1e-3  # least range; nearer returns have no direction


@dataclass(eq=False)
class Echoes:
    """Echoes of a sweep of N returns; the arrays change in place."""

    source: LidarSweep  # the recorded sweep
    model: LidarModel
    dataset_origins: np.ndarray  # [N, 3], starts of the beams, dataset world
    origins: np.ndarray  # [N, 3], starts of the beams, scene world
    directions: np.ndarray  # [N, 3], unit, scene world
    # [N], as reported; 0 where the source has no point: such rows are never touched.
    ranges_m: np.ndarray
    air_path_m: np.ndarray  # [N], length of the beam's path through the air
    # [N], reflectance of the surface that gives the echo, incidence included, relative to a white
    # surface met head on.
    reflectance: np.ndarray
    gain: np.ndarray  # [N], share of the echo that the weather leaves
    # [N], extinction about the sensor, of the weather that has dimmed echoes so far.
    extinction_per_m: np.ndarray
    codes: np.ndarray  # [N], uint8, see codes
    # [N], True if the echo is not the source's, so that its intensity follows from reflectance.
    is_new: np.ndarray
    is_moved: np.ndarray  # [N], True if it lies elsewhere than in the source

    @staticmethod
    def from_sweep(
        sweep: LidarSweep, origins: np.ndarray, world_origin_m: np.ndarray, model: LidarModel
    ) -> Echoes:
        """Return the echoes as recorded in clear air; origins: float64 [N, 3], dataset world.

        A recorded echo was above the sensor's noise, however dark: it counts as just bright enough.
        """
        count = len(sweep)
        offsets = sweep.points_m - origins
        ranges = np.sqrt((offsets * offsets).sum(1))
        ranges[~(np.isfinite(ranges) & (ranges > _MIN_RANGE_M))] = 0
        directions = offsets / np.where(ranges > 0, ranges, 1.0)[:, None]
        directions[ranges == 0] = 0
        scene_origins = np.where((ranges > 0)[:, None], origins - world_origin_m, 0.0)
        return Echoes(
            source=sweep,
            model=model,
            dataset_origins=origins,
            origins=scene_origins,
            directions=directions,
            ranges_m=ranges,
            air_path_m=ranges.copy(),
            reflectance=np.maximum(find_reflectances(sweep), model.noise_reflectance(ranges)),
            gain=np.ones(count),
            extinction_per_m=np.zeros(count),
            codes=np.full(count, UNCHANGED, np.uint8),
            is_new=np.zeros(count, bool),
            is_moved=np.zeros(count, bool),
        )

    def replace_echoes(
        self, rows: np.ndarray, ranges_m: np.ndarray, reflectance: np.ndarray, code: int
    ) -> None:
        """Replace the echoes of rows [M] by echoes of something else, met in the air."""
        self.ranges_m[rows] = self.air_path_m[rows] = ranges_m
        self.reflectance[rows] = reflectance
        self.gain[rows] = 1.0
        self.codes[rows] = code
        self.is_new[rows] = self.is_moved[rows] = True

    def move_and_dim(
        self, rows: np.ndarray, ranges_m: np.ndarray, air_m: np.ndarray, transmittance: np.ndarray
    ) -> None:
        """Move the returns in rows [M] along their beams, and dim them by a transmittance [M]."""
        has_moved = np.abs(ranges_m - self.ranges_m[rows]) > _MIN_RANGE_M
        self.codes[rows[has_moved]] = MOVED
        self.is_moved[rows[has_moved]] = True
        self.ranges_m[rows[has_moved]] = ranges_m[has_moved]
        self.air_path_m[rows] = air_m
        self.gain[rows] *= transmittance

    def add_range_noise(self, gain_before: np.ndarray, normal: np.ndarray) -> None:
        """Add noise to the ranges of echoes that have become fainter.

        An echo has lost gain since gain_before [N]; the recorded range holds the noise of the rest.
        The noise is largest for an echo at the sensor's noise. normal: normal variates [N].
        """
        levels = self.reflectance / self.model.noise_reflectance(
            np.maximum(self.ranges_m, _MIN_RANGE_M)
        )
        inverse = [1 / np.maximum(levels * gain, 1.0) for gain in (self.gain, gain_before)]
        sigma = self.model.range_noise_m * np.sqrt(np.maximum(inverse[0] - inverse[1], 0) / 2)
        rows = np.flatnonzero((sigma > 0) & (self.ranges_m > 0) & (self.codes != LOST))
        noisy = self.ranges_m[rows] + sigma[rows] * normal[rows]
        self.ranges_m[rows] = np.maximum(noisy, _MIN_RANGE_M)
        self.is_moved[rows] = True
        self.codes[rows[self.codes[rows] == UNCHANGED]] = ATTENUATED

    def drop_faint(self) -> None:
        """Mark echoes below the sensor's noise as lost."""
        is_faint = self.reflectance * self.gain < self.model.noise_reflectance(self.ranges_m)
        self.codes[is_faint & (self.ranges_m > 0)] = LOST

    def to_sweep(self) -> LidarSweep:
        """Return the weathered sweep, as `weathered_sweep` does."""
        columns = {name: np.asarray(column) for name, column in self.source.columns.items()}
        columns |= self._coordinates(columns)
        name = find_intensity_column(self.source)
        if name is not None:
            columns[name] = self._intensity(columns[name])
        columns[INDEX_COLUMN] = np.arange(len(self.codes), dtype=np.int32)
        columns[CODE_COLUMN] = self.codes
        return LidarSweep(columns)

    def _coordinates(self, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the columns x, y, z that have changed."""
        is_lost = self.codes == LOST
        rows = np.flatnonzero(self.is_moved & ~is_lost)
        if not len(rows) and not is_lost.any():
            return {}
        moved = self.dataset_origins[rows] + self.ranges_m[rows, None] * self.directions[rows]
        new_columns = {}
        for axis, name in enumerate("xyz"):
            floats = columns[name].dtype.kind == "f"
            new_columns[name] = columns[name].astype(columns[name].dtype if floats else np.float64)
            new_columns[name][rows] = moved[:, axis]
            new_columns[name][is_lost] = np.nan
        return new_columns

    def _intensity(self, column: np.ndarray) -> np.ndarray:
        """Return the intensities; mark unchanged rows whose intensity changes as attenuated."""
        rows = np.flatnonzero((self.gain != 1) | self.is_new | (self.codes == LOST))
        if not len(rows):
            return column
        old_intensity = column[rows]
        new_intensity = white_level(column) * self.reflectance[rows]
        values = np.where(self.is_new[rows], new_intensity, old_intensity) * self.gain[rows]
        values[self.codes[rows] == LOST] = 0
        values = np.minimum(values, highest_intensity(column))
        if column.dtype.kind in "iu":
            limits = np.iinfo(column.dtype)
            values = np.clip(np.rint(values), limits.min, limits.max)
        values = values.astype(column.dtype)
        changed = (values != old_intensity) & (old_intensity == old_intensity)  # a NaN stays NaN
        self.codes[rows[changed & (self.codes[rows] == UNCHANGED)]] = ATTENUATED
        out = column.copy()
        out[rows] = values
        return out
