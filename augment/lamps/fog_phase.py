"""Air between lamps and a camera: its extinction, and the table of what it scatters.

Symbols, as in `augment.lamps.air_light`: theta is the angle by which light is scattered, h the
distance of a lamp from a ray, u = sigma h its optical distance. A lamp of 1 cd whose light meets
the ray under the angles theta_0 to theta_1 gives

    G(u, theta_1) - G(u, theta_0)       G(u, theta) = integral_0^theta p(t) exp(-u tan(t / 2)) dt

times sigma exp(-sigma D cos gamma) / h. G depends on the phase function p alone. So it is tabulated
once, and the light of a lamp without a pattern takes two look-ups.

The phase function is a sum of Henyey-Greenstein lobes (Henyey and Greenstein 1941),

    p(theta) = (1 - g^2) / (4 pi (1 + g^2 - 2 g cos theta)^1.5).
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32, Float64

from augment.lamps.halo_table_kernels import DISTANCE_KNEE, MAX_DISTANCE, NUM_ANGLES, NUM_DISTANCES
from augment.render.fog import Fog, optical_depth_numpy

# Asymmetry g of fog droplets, as in `augment.render.fog`.
FOG_ASYMMETRY = 0.85
# Share of a lobe that scatters backwards, in fog that the recording car's lamps light. One lobe of
# FOG_ASYMMETRY has 0.003 / sr at 180 degrees, where droplets have a peak of some 0.02 (assumed).
BACKWARD_SHARE = 0.1
# Asymmetry of that share.
BACKWARD_ASYMMETRY = -0.3
# Asymmetry of what raindrops refract and reflect: large spheres of water have 0.88 together with
# the half that they diffract (g = 1), so 0.77 without it.
RAIN_ASYMMETRY = 0.77
# Asymmetry of what flakes refract and reflect (assumed).
SNOW_ASYMMETRY = 0.6
# Share of the extinction of drops and flakes that is diffraction: half, for large particles (van de
# Hulst 1957, ch. 8). Millimetres diffract by 0.03 degrees, so this light is not lost to a pixel.
DIFFRACTED_SHARE = 0.5
# Number of steps to which the share of rain or snow in the scattering is rounded, so that few
# tables are made.
NUM_SHARE_STEPS = 16

Lobes = tuple[tuple[float, float], ...]
"""Weight and asymmetry g of each lobe of a phase function. The weights sum to 1."""


@dataclass(frozen=True)
class AirExtinction:
    """Fog, rain and snowfall between lamps and a camera."""

    fog: Fog | None = None
    """Fog, uniform or thinning with height; None for clear air."""
    precipitation_per_m: float = 0.0
    """Extinction by falling drops or flakes, 1/m, diffraction included."""
    precipitation: Literal["rain", "snow"] = "rain"
    """Kind of those drops."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.precipitation_per_m) and self.precipitation_per_m >= 0):
            raise ValueError(
                f"precipitation_per_m must be finite and >= 0; got {self.precipitation_per_m}"
            )

    @property
    def scattering_precipitation_per_m(self) -> float:
        """Extinction by falling drops or flakes without what they diffract, 1/m."""
        return self.precipitation_per_m * (1 - DIFFRACTED_SHARE)

    @property
    def is_clear(self) -> bool:
        """True if the air has no extinction."""
        has_fog = self.fog is not None and self.fog.extinction_per_m > 0
        return not has_fog and self.precipitation_per_m == 0

    def mean_extinction_per_m(
        self, starts_m: Float[np.ndarray, "*N 3"], ends_m: Float[np.ndarray, "*N 3"]
    ) -> Float64[np.ndarray, "*N"]:
        """Return the mean extinction along straight paths, 1/m.

        Args:
            starts_m: points of the scene's world, metres.
            ends_m: points of the scene's world, metres.
        """
        distances_m = np.linalg.norm(ends_m - starts_m, axis=-1)
        sigma = np.full(distances_m.shape, self.scattering_precipitation_per_m)
        if self.fog is not None:
            lengths_m = np.maximum(distances_m, 1e-6)
            tau = optical_depth_numpy(self.fog, lengths_m, starts_m[..., 2], ends_m[..., 2])
            sigma = sigma + tau / lengths_m
        return sigma

    def transmittance(
        self, starts_m: Float[np.ndarray, "*N 3"], ends_m: Float[np.ndarray, "*N 3"]
    ) -> Float64[np.ndarray, "*N"]:
        """Return the share of light that passes along straight paths; arguments as above."""
        distances_m = np.linalg.norm(ends_m - starts_m, axis=-1)
        return np.exp(-self.mean_extinction_per_m(starts_m, ends_m) * distances_m)

    def lobes(self, fog_extinction_per_m: float, *, is_own: bool) -> Lobes:
        """Return the phase function of the air.

        Args:
            fog_extinction_per_m: mean extinction by fog, 1/m, which weighs its lobes.
            is_own: if True, fog has a lobe that scatters backwards, for lamps of the recording car.
        """
        fog: Lobes = ((1.0, FOG_ASYMMETRY),)
        if is_own:
            fog = ((1 - BACKWARD_SHARE, FOG_ASYMMETRY), (BACKWARD_SHARE, BACKWARD_ASYMMETRY))
        sigma = self.scattering_precipitation_per_m
        total = sigma + fog_extinction_per_m
        share = round(NUM_SHARE_STEPS * sigma / total) / NUM_SHARE_STEPS if total > 0 else 0.0
        falling = (share, RAIN_ASYMMETRY if self.precipitation == "rain" else SNOW_ASYMMETRY)
        scaled = tuple((weight * (1 - share), g) for weight, g in fog)
        return tuple(lobe for lobe in (*scaled, falling) if lobe[0] > 0)


def phase_function(lobes: Lobes, theta_rad: Float[np.ndarray, "*N"]) -> Float64[np.ndarray, "*N"]:
    """Return the phase function, 1/sr, at the angles by which light is scattered."""
    cosines = np.cos(theta_rad)
    values = np.zeros(np.shape(theta_rad))
    for weight, g in lobes:
        values += weight * (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cosines) ** 1.5)
    return values


def table_distances() -> Float64[np.ndarray, "U"]:
    """Return the optical distances u of the rows of `scatter_table`."""
    steps = np.linspace(0, np.arcsinh(MAX_DISTANCE / DISTANCE_KNEE), NUM_DISTANCES)
    return DISTANCE_KNEE * np.sinh(steps)


@functools.lru_cache(maxsize=2 * NUM_SHARE_STEPS)
def scatter_table(lobes: Lobes) -> Float32[np.ndarray, "U T"]:
    """Return the table of G(u, theta) of a phase function.

    Rows are `table_distances`, columns are NUM_ANGLES + 1 angles from 0 to pi.
    """
    edges = np.linspace(0, np.pi, NUM_ANGLES + 1)
    points, weights = np.polynomial.legendre.leggauss(4)
    half_step = np.pi / NUM_ANGLES / 2
    theta = (edges[:-1] + half_step)[:, None] + half_step * points  # [T, 4]
    scattered = phase_function(lobes, theta) * weights * half_step
    u = table_distances()[:, None, None]
    cells = (scattered * np.exp(-np.minimum(u * np.tan(theta / 2), 700.0))).sum(2)  # [U, T]
    table = np.zeros((NUM_DISTANCES, NUM_ANGLES + 1), np.float32)
    table[:, 1:] = np.cumsum(cells, 1)
    table.setflags(write=False)
    return table


def scattered_beyond(lobes: Lobes, theta_rad: Float[np.ndarray, "*N"]) -> Float64[np.ndarray, "*N"]:
    """Return the integral of the phase function from theta to pi: a bound of what G can add."""
    row = scatter_table(lobes)[0].astype(np.float64)
    return row[-1] - np.interp(theta_rad, np.linspace(0, np.pi, NUM_ANGLES + 1), row)
