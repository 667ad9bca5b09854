"""What is known of a LiDAR: its optics as assumed, its intensities, where its beams start."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from augment.labels import KnowsLidarOrigins, LidarSweep
from augment.scene import Scene

LIGHT_MPS = 299_792_458.0
INTENSITY_COLUMNS = ("intensity", "i", "reflectance", "reflectivity")
UNKNOWN_REFLECTANCE = 0.10  # of a surface, where the sweep has no intensities
FAINTEST = 0.005  # reflectance that an intensity of 0 stands for: half a step of 8 bits
EGO_SENSOR_M = (0.0, 0.0, 1.8)  # forward, left, up of the ego origin, where nothing else is known


@dataclass(frozen=True)
class LidarModel:
    """A spinning 905 nm LiDAR as its makers describe such; datasets do not publish their own.

    reach_m: where a surface of 10 % reflectance is just seen in clear air; it stands for the
    noise. pulse_fwhm_s: half-power width of the emitted pulse, which is as sin^2 and twice as long
    at its foot. overlap_from_m, overlap_full_m: from where the receiver sees the beam, and from
    where all of it (Hahner et al. 2021, section 3). near_gain: share of a signal from the first
    metres, relative to one from far, that the receiver makes use of. Makers suppress it, and do not
    say by how much: the default makes fog of 40 m visibility cost a surface of 50 % reflectance at
    25 m, which is as far as Bijelic, Gruber and Ritter (2018, "A Benchmark for Lidar Sensors in
    Fog") found LiDARs to see in it.
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
    """The intensity of a white, diffuse surface that is met head on.

    Fractions up to 1 are taken for reflectances. Of other scales, 8 bits, 100 is taken for 100 %,
    as Velodyne and Hesai document theirs; what is above comes from retroreflectors.
    """
    values = np.asarray(intensity)
    if values.dtype.kind == "f":
        finite = values[np.isfinite(values)]
        if finite.size == 0 or finite.max() <= 1:
            return 1.0
    return 100.0


def reflectances(sweep: LidarSweep) -> np.ndarray:
    """What share of the light each return's surface gave back, float64 [N], FAINTEST at least;
    incidence included, as sensors do not take it out.
    """
    name = intensity_column(sweep)
    if name is None:
        return np.full(len(sweep), UNKNOWN_REFLECTANCE)
    values = np.asarray(sweep.columns[name], np.float64)
    return np.maximum(np.nan_to_num(values / white_level(sweep.columns[name])), FAINTEST)


def origins_of(scene: Scene, frame_index: int, sweep: LidarSweep) -> np.ndarray:
    """Where each return's beam started, float64 [N, 3], dataset world.

    From the labels where they know. Else 1.8 m above the ego's origin at the frame's time, which is
    wrong by the sensor's place on its car and by what the car drove within the sweep.

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


def lambertian(reflectance: float, cosine: np.ndarray) -> np.ndarray:
    """What a diffuse surface gives back at an angle, relative to a white one met head on."""
    return reflectance * np.clip(cosine, 0.0, 1.0)


def signal(reflectance: np.ndarray, ranges_m: np.ndarray) -> np.ndarray:
    """Power of an echo, in the units of `smog.soft_response`: reflectance / (pi R^2), 1/m^2/sr."""
    return reflectance / (math.pi * ranges_m**2)
