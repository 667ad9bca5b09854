"""The strongest echo of every beam of a sweep, as the effects change it one after the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from augment.labels import LidarSweep
from augment.lidar_weather.codes import (
    ATTENUATED,
    CODE_COLUMN,
    INDEX_COLUMN,
    LOST,
    MOVED,
    SCATTERED,
    UNCHANGED,
)
from augment.lidar_weather.sensors import (
    LidarModel,
    intensity_column,
    reflectances,
    white_level,
)

_LEAST_M = 1e-3  # nearer returns have no direction


@dataclass(eq=False)
class Echoes:
    """The echoes of a sweep of N returns; arrays are changed in place.

    origins, directions [N, 3]: scene world; directions are unit. ranges_m [N]: as the sensor
    reports them, 0 where the source has no point: such rows are never touched. air_m [N]: how much
    of the way leads through the air. reflectance [N]: of what gives the echo, incidence included,
    relative to a white surface met head on. gain [N]: what the weather leaves of the echo. codes
    [N]: see `codes`. is_new [N]: the echo is not the source's, so its intensity follows from
    reflectance.
    """

    source: LidarSweep
    dataset_origins: np.ndarray
    origins: np.ndarray
    directions: np.ndarray
    ranges_m: np.ndarray
    air_m: np.ndarray
    reflectance: np.ndarray
    gain: np.ndarray
    codes: np.ndarray
    is_new: np.ndarray

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
        ranges[~(np.isfinite(ranges) & (ranges > _LEAST_M))] = 0
        directions = offsets / np.where(ranges > 0, ranges, 1.0)[:, None]
        directions[ranges == 0] = 0
        starts = np.where((ranges > 0)[:, None], origins - world_origin_m, 0.0)
        return Echoes(
            source=sweep,
            dataset_origins=origins,
            origins=starts,
            directions=directions,
            ranges_m=ranges,
            air_m=ranges.copy(),
            reflectance=np.maximum(reflectances(sweep), model.noise_reflectance(ranges)),
            gain=np.ones(count),
            codes=np.full(count, UNCHANGED, np.uint8),
            is_new=np.zeros(count, bool),
        )

    def replace(
        self, rows: np.ndarray, ranges_m: np.ndarray, reflectance: np.ndarray, code: int
    ) -> None:
        """Echoes [M] of something else, met in the air, for the returns in rows [M]."""
        self.ranges_m[rows] = self.air_m[rows] = ranges_m
        self.reflectance[rows], self.gain[rows] = reflectance, 1.0
        self.codes[rows], self.is_new[rows] = code, True

    def see_through(
        self, rows: np.ndarray, ranges_m: np.ndarray, air_m: np.ndarray, kept: np.ndarray
    ) -> None:
        """Move the returns in rows [M] along their beams, and dim them to kept [M]."""
        moves = np.abs(ranges_m - self.ranges_m[rows]) > _LEAST_M
        self.codes[rows[moves]] = MOVED
        self.ranges_m[rows[moves]] = ranges_m[moves]
        self.air_m[rows] = air_m
        self.gain[rows] *= kept

    def lose(self, rows: np.ndarray) -> None:
        """Nothing comes back of the returns in rows, numbers or bool [N]."""
        self.codes[rows] = LOST

    def lose_what_is_too_faint(self, model: LidarModel) -> None:
        """Lose what is below the sensor's noise."""
        faint = self.reflectance * self.gain < model.noise_reflectance(self.ranges_m)
        self.lose(faint & (self.ranges_m > 0))

    def sweep(self) -> LidarSweep:
        """As `apply.weathered_sweep` returns it."""
        columns = {name: np.asarray(column) for name, column in self.source.columns.items()}
        columns |= self._coordinates(columns)
        name = intensity_column(self.source)
        if name is not None:
            columns[name] = self._intensity(columns[name])
        columns[INDEX_COLUMN] = np.arange(len(self.codes), dtype=np.int32)
        columns[CODE_COLUMN] = self.codes
        return LidarSweep(columns)

    def _coordinates(self, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        rows = np.flatnonzero((self.codes == MOVED) | (self.codes == SCATTERED))
        lost = self.codes == LOST
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
        values = (
            np.where(self.is_new[rows], white_level(column) * self.reflectance[rows], old)
            * self.gain[rows]
        )
        values[self.codes[rows] == LOST] = 0
        if column.dtype.kind in "iu":
            limits = np.iinfo(column.dtype)
            values = np.clip(np.rint(values), limits.min, limits.max)
        values = values.astype(column.dtype)
        changed = (values != old) & (old == old)  # NaN was no intensity and is none
        self.codes[rows[changed & (self.codes[rows] == UNCHANGED)]] = ATTENUATED
        out = column.copy()
        out[rows] = values
        return out
