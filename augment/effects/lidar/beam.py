"""A recipe's weather on a LiDAR sweep, in the order in which a beam meets it.

1. Snow ends it where it comes to the layer first: the echo is the snow's.
2. Water bends it, swallows it, or sends it away; snow under water has melted.
3. Smog dims the echo along the way through the air, there and back, and adds its own.
4. The sensor reports the strongest echo, if that is above its noise.

Every return is a row of the source and stays one; `codes` says what became of it.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from augment.effects.flood.flood import FloodMedium, reflectance
from augment.effects.lidar.codes import (
    ATTENUATED,
    CODE_COLUMN,
    INDEX_COLUMN,
    LOST,
    MOVED,
    SCATTERED,
    UNCHANGED,
)
from augment.labels import KnowsLidarOrigins, LidarSweep
from augment.plan import make_plan
from augment.render.fog import MAX_EXPONENT, Fog, optical_depth_of_arrays
from augment.rng import rng_for
from augment.scene import Scene
from recipes.schema import KOSCHMIEDER, Recipe
from recipes.weather import PURE_WATER_PER_M

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
    (Bijelic, Gruber and Ritter 2018, "A Benchmark for Lidar Sensors in Fog").
    """

    wavelength_um: float = 0.905
    reach_m: float = 150.0
    pulse_fwhm_s: float = 10e-9
    overlap_from_m: float = 0.9
    overlap_full_m: float = 1.0
    near_gain: float = 0.01

    @property
    def pulse_m(self) -> float:
        """Half the emitted pulse's length as ranges count, c tau / 2."""
        return LIGHT_MPS * self.pulse_fwhm_s / 2

    def noise_reflectance(self, ranges_m: np.ndarray) -> np.ndarray:
        """The reflectance that is just seen at a range in clear air: 0.1 (R / reach)^2."""
        return 0.1 * (ranges_m / self.reach_m) ** 2


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
    head on. gain [N]: what the weather leaves of the echo. is_new [N]: the echo is not the
    source's, so its intensity follows from reflectance.
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
        ranges[~(np.isfinite(ranges) & (ranges > _MIN_M))] = 0
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
        moves = np.abs(ranges_m - self.ranges_m[rows]) > _MIN_M
        self.codes[rows[moves]] = MOVED
        self.ranges_m[rows[moves]] = ranges_m[moves]
        self.air_m[rows] = air_m
        self.gain[rows] *= kept

    def lose_faint(self, model: LidarModel) -> None:
        """Lose what is below the sensor's noise."""
        faint = self.reflectance * self.gain < model.noise_reflectance(self.ranges_m)
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
        own = white_level(column) * self.reflectance[rows]
        values = np.where(self.is_new[rows], own, old) * self.gain[rows]
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


# ---- Fog, haze and smog --------------------------------------------------------------------------
# Hahner et al. 2021, "Fog Simulation on Real LiDAR Point Clouds in Adverse Weather", ICCV. The echo
# of a pulse P(t) = P0 sin^2(pi t / (2 tau)), 0 <= t <= 2 tau, of half-power width tau:
#
#     hard, from a surface at R0   (rho / pi) exp(-2 T(R0)) / R0^2
#     soft, of droplets, at R      beta int_0^{2w} sin^2(pi x / (2w)) exp(-2 alpha r) xi(r) / r^2 dx
#                                  r = R - x, w = c tau / 2
#
# T is the optical depth, alpha the extinction, beta = 0.046 / MOR the backscatter, MOR = ln(20) /
# alpha the meteorological optical range; xi rises from 0 at overlap_from_m to 1 at overlap_full_m.
# Ranges count from the pulse's middle, so that a surface at R0 is reported at R0 and not at R0 + w.
# The smog is that of the images, thinned to the LiDAR's wavelength (`wavelength_factor`).

VISIBLE_UM = 0.55
BACKSCATTER_MOR = 0.046  # beta x MOR, 1/sr
MOR_OPTICAL_DEPTH = math.log(20)
# Fog is clumpy: the backscatter of what a pulse fills varies about its mean as a gamma variate of
# this shape, by half of it.
CLUMPS = 4.0
_STEP_M, _FAR_M = 0.02, 15.0  # of the soft echo, tabulated
_PULSE_STEPS = 150
_DENSITY_STEP = 0.02  # of log alpha, within which the soft echo is one

# q(V) of Kim, McArthur and Korevaar (2001), V in km: sigma ~ wavelength^-q. Least V, slope, offset.
_KIM = ((50.0, 0.0, 1.6), (6.0, 0.0, 1.3), (1.0, 0.16, 0.34), (0.5, 1.0, -0.5), (0.0, 0.0, 0.0))


def wavelength_factor(extinction_per_m: float, wavelength_um: float = 0.905) -> float:
    """Extinction at the LiDAR's wavelength over that of visible light (0.55 um).

    (wavelength / 0.55 um)^-q with q by the visibility, see _KIM; measurements scatter by some 20 %.
    At 905 nm: 1 in fog, whose droplets are larger than either wavelength, 0.78 at 1 km, 0.52 at 6.
    """
    if extinction_per_m <= 0:
        return 1.0
    visibility_km = KOSCHMIEDER / extinction_per_m / 1000
    _, slope, offset = next(row for row in _KIM if visibility_km > row[0] or row[0] == 0)
    return (wavelength_um / VISIBLE_UM) ** -(slope * visibility_km + offset)


def extinction_at(medium: Fog, z_m: np.ndarray) -> np.ndarray:
    """alpha [N] at heights, 1/metre."""
    if medium.scale_height_m is None:
        return np.full(len(z_m), medium.sigma_per_m)
    height = (z_m - medium.base_z_m) / medium.scale_height_m
    return medium.sigma_per_m * np.exp(np.minimum(-height, MAX_EXPONENT))


class SoftEcho(NamedTuple):
    """What droplets give back, by reported range. ranges_m [K]: rising. signal [K]: as `signal`.
    strongest [K]: the greatest up to each range. share [K]: of the whole echo, up to each range.
    """

    ranges_m: np.ndarray
    signal: np.ndarray
    strongest: np.ndarray
    share: np.ndarray


def soft_response(alpha_per_m: float, echoes_m: np.ndarray, model: LidarModel) -> np.ndarray:
    """The soft integral, without near_gain, at reported ranges [K]; midpoint rule over the pulse.

    An echo at R is reported at R - w. Droplets nearer than overlap_from_m are not seen.
    """
    w = model.pulse_m
    x = (np.arange(_PULSE_STEPS) + 0.5) * (2 * w / _PULSE_STEPS)
    r = echoes_m[:, None] + w - x
    seen = np.clip(
        (r - model.overlap_from_m) / (model.overlap_full_m - model.overlap_from_m), 0.0, 1.0
    )
    r = np.maximum(r, model.overlap_from_m)
    echo = np.sin(math.pi * x / (2 * w)) ** 2 * np.exp(-2 * alpha_per_m * r) * seen / r**2
    beta = BACKSCATTER_MOR * alpha_per_m / MOR_OPTICAL_DEPTH
    return beta * echo.sum(1) * (2 * w / _PULSE_STEPS)


@functools.lru_cache(maxsize=256)
def soft_echo(alpha_per_m: float, model: LidarModel) -> SoftEcho:
    """The soft echo tabulated; what comes from beyond _FAR_M is too weak to count."""
    ranges = np.arange(model.overlap_from_m, _FAR_M, _STEP_M)
    response = model.near_gain * soft_response(alpha_per_m, ranges, model)
    total = np.cumsum(response)
    share = total / max(total[-1], 1e-300)
    return SoftEcho(ranges, response, np.maximum.accumulate(response), share)


class Scatter(NamedTuple):
    """The strongest echo of the droplets before each return. signal [N]: as `signal` gives it, 0
    where none can be. ranges_m [N]: where it is reported.
    """

    signal: np.ndarray
    ranges_m: np.ndarray


def scatter_before(
    medium: Fog,
    eyes_z_m: np.ndarray,
    ends_m: np.ndarray,
    model: LidarModel,
    rng: np.random.Generator,
) -> Scatter:
    """What comes back from the smog before surfaces at ends_m [N].

    Its strength varies with the clumps that a beam meets (CLUMPS); the range of the strongest is
    drawn from the echo's shape. N numbers of each are drawn whatever the density, so that denser
    smog differs by nothing else.
    """
    count = len(ends_m)
    clump = rng.standard_gamma(CLUMPS, count) / CLUMPS
    where = rng.random(count)
    alpha = extinction_at(medium, eyes_z_m)
    out = Scatter(np.zeros(count), np.zeros(count))
    usable = (alpha > 0) & (ends_m > model.overlap_from_m) & np.isfinite(alpha)
    group = np.rint(np.log(np.where(usable, alpha, 1.0)) / _DENSITY_STEP).astype(np.int64)
    low, high = (group[usable].min(), group[usable].max()) if usable.any() else (0, -1)
    for number in range(low, high + 1):
        rows = np.flatnonzero(usable & (group == number)) if high > low else np.flatnonzero(usable)
        if not len(rows):
            continue
        is_uniform = medium.scale_height_m is None
        mean = medium.sigma_per_m if is_uniform else math.exp(number * _DENSITY_STEP)
        echo = soft_echo(float(mean), model)
        last = ((ends_m[rows] - echo.ranges_m[0]) / _STEP_M).astype(np.int64)
        last = np.clip(last, 0, len(echo.ranges_m) - 1)
        out.signal[rows] = echo.strongest[last] * clump[rows]
        at = np.interp(where[rows] * echo.share[last], echo.share, echo.ranges_m)
        out.ranges_m[rows] = np.minimum(at, ends_m[rows])
    return out


# ---- Standing water: a flat mirror that swallows 905 nm within centimetres -----------------------
# A beam that meets the surface at a slant leaves it by reflection, away from the sensor, or enters.
# The stronger echo counts:
#
#     bed     rho (1 - F)^2 exp(-2 c l)     from the bed, l metres along the refracted way
#     water   (1 - F)^2 R_w cos(theta)      from grains in muddy water, within a hand of its surface
#
# with Fresnel's F and theta the angle of incidence. Left out: the waves' slopes, none of whose
# facets faces a sensor on a car but right beside it, and the few, weak mirror images of objects.

# Absorption of pure water at 905 nm. Kou, Labrie and Chylek (1993, "Refractive indices of water and
# ice in the 0.65- to 2.5-um spectral region") have 6.8/m at 900 nm and 14/m at 925 nm; warm water
# has a tenth more. Visible light's 0.06 to 0.3/m does not count against it.
ABSORPTION_905_PER_M = 7.5
BACKWARD = 0.019  # of the light that grains deflect (Petzold 1972, harbour)
MOREL = 0.33  # diffuse reflectance of water over b_b / (a + b_b) (Morel and Prieur 1977)


class WaterEcho(NamedTuple):
    """The M beams that meet the water: their rows; range of the surface, where the air ends; range
    as reported, light being slower in water; what is kept of the bed's echo; whether that is the
    stronger; reflectance of the water.
    """

    rows: np.ndarray
    surface_m: np.ndarray
    range_m: np.ndarray
    kept: np.ndarray
    is_bed: np.ndarray
    reflectance: np.ndarray


def grains_per_m(medium: FloodMedium) -> float:
    """Extinction by grains, which is grey: that of red, less what pure water takes of it."""
    return max(medium.extinction_per_m[0] - PURE_WATER_PER_M[0], 0.0)


def water_reflectance(medium: FloodMedium) -> float:
    """R_w of the muddy water itself at 905 nm; 0 of clear water, 0.33 at most."""
    backward = BACKWARD * min(grains_per_m(medium), 1e9)
    return MOREL * backward / (ABSORPTION_905_PER_M + backward)


def meet_water(
    medium: FloodMedium,
    origins: np.ndarray,
    directions: np.ndarray,
    ends_m: np.ndarray,
    reflectances: np.ndarray,
) -> WaterEcho:
    """The echoes of beams [N] that would reach a surface at ends_m, of a reflectance, under water.

    origins, directions: [N, 3], scene world. Beams that start under water are left out. The bed
    counts as level about the return: a wheel's side is reported too near by about the bend.
    """
    drop = origins[:, 2] - medium.level_z_m
    fall = -directions[:, 2]
    rows = np.flatnonzero((drop > 0) & (fall * ends_m > drop))
    fall, ends = fall[rows], ends_m[rows]
    surface = drop[rows] / fall
    index = medium.refraction_index
    passed = 1 - reflectance(torch.from_numpy(np.minimum(fall, 1.0)), index, medium.fresnel).numpy()
    below = np.sqrt(1 - (1 - np.minimum(fall, 1.0) ** 2) / index**2)  # cosine of the bent beam
    way = np.maximum(ends - surface, 0) * fall / np.maximum(below, 1e-9)
    extinction = ABSORPTION_905_PER_M + grains_per_m(medium)
    thin = np.where(way > 0, np.exp(-2 * np.minimum(extinction * way, 400.0)), 1.0)
    kept = passed**2 * thin
    mud = passed**2 * water_reflectance(medium) * fall
    ranges = surface + index * way
    # Echoes of equal reflectance fall with the range squared.
    is_bed = reflectances[rows] * kept / np.maximum(ranges, 1e-9) ** 2 >= mud / surface**2
    return WaterEcho(rows, surface, np.where(is_bed, ranges, surface), kept, is_bed, mud)


# ---- The sweep -----------------------------------------------------------------------------------

DEFAULT_MODEL = LidarModel()


def weathered_sweep(
    scene: Scene,
    recipe: Recipe,
    frame_index: int,
    sweep: LidarSweep,
    *,
    model: LidarModel = DEFAULT_MODEL,
) -> LidarSweep:
    """The sweep of a frame as the recipe's weather would have let the sensor take it.

    All columns of the source, of which x, y, z and the intensity change where the weather changed
    them, and `source_index` int32, `weather_code` uint8 (see codes). The class of a return that
    moved onto the snow is still that of what lies beneath. Whole coordinates become float64, since
    lost returns have none. Thread-safe.

    Raises:
        SceneError: the weather cannot be placed in this scene. ValueError: the sweep has a column
            of one of the new names, or its labels' origins do not fit it.
    """
    for name in (CODE_COLUMN, INDEX_COLUMN):
        if name in sweep.columns:
            raise ValueError(
                f"the sweep of frame {frame_index} has a column {name!r} already: it is weathered, "
                f"or the dataset's own column must be renamed"
            )
    plan = make_plan(recipe, scene)
    echoes = Echoes.of(
        sweep, origins_of(scene, frame_index, sweep), np.asarray(scene.world_origin_m), model
    )
    if plan.snow is not None:
        from augment.effects.snow.lidar import meet_snow  # which is about this module's echoes

        meet_snow(echoes, scene, plan.snow, sweep, scene.frame(frame_index).timestamp_ns)
    if plan.flood is not None:
        _meet_water(echoes, plan.flood)
    if plan.smog is not None:
        rng = rng_for(seed=recipe.seed, scene=scene.name, frame=frame_index, effect="lidar.smog")
        _meet_smog(echoes, plan.smog, model, rng)
    echoes.lose_faint(model)
    return echoes.sweep()


def _meet_water(echoes: Echoes, medium: FloodMedium) -> None:
    """A sensor under water sees nothing: its light ends within centimetres."""
    drowned = echoes.origins[:, 2] <= medium.level_z_m
    echoes.codes[drowned & (echoes.ranges_m > 0)] = LOST
    ends = np.where(drowned, 0.0, echoes.ranges_m)
    water = meet_water(medium, echoes.origins, echoes.directions, ends, echoes.reflectance)
    bed, mud = water.is_bed, ~water.is_bed
    echoes.see_through(water.rows[bed], water.range_m[bed], water.surface_m[bed], water.kept[bed])
    echoes.replace(water.rows[mud], water.surface_m[mud], water.reflectance[mud], SCATTERED)


def _meet_smog(echoes: Echoes, medium: Fog, model: LidarModel, rng: np.random.Generator) -> None:
    factor = wavelength_factor(medium.sigma_per_m, model.wavelength_um)
    medium = dataclasses.replace(medium, sigma_per_m=factor * medium.sigma_per_m)
    eyes_z, air = echoes.origins[:, 2], echoes.air_m
    ends_z = eyes_z + air * echoes.directions[:, 2]
    tau = optical_depth_of_arrays(medium, air, eyes_z, ends_z, series_below=1e-4)
    echoes.gain *= np.exp(-2 * tau)
    scatter = scatter_before(medium, eyes_z, air, model, rng)
    echo = signal(echoes.reflectance * echoes.gain, np.maximum(echoes.ranges_m, 1e-3))
    wins = (scatter.signal > echo) & (echoes.ranges_m > 0) & (echoes.codes != LOST)
    rows = np.flatnonzero(wins)
    ranges = scatter.ranges_m[rows]
    # As reflectance of a surface whose echo from that range is as strong.
    white = signal(np.ones(len(rows)), np.maximum(ranges, 1e-3))
    echoes.replace(rows, ranges, scatter.signal[rows] / white, SCATTERED)
