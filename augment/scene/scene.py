"""Records of a driving scene: Gaussians, moving actors, sky, cameras over time, labels.

Adapters build a `Scene`; planning, effects, rendering and jobs read it. All records are frozen; a
changed scene is a `dataclasses.replace` of the old one. Symbols: N Gaussians, T samples of time, K
spherical harmonics, terms of a Fourier series, R runs of rows.
"""

from __future__ import annotations

import dataclasses
import math
from bisect import bisect_right
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int16, Int64
from torch import Tensor

from augment.errors import SceneError
from augment.memo import LatestValue, memo_of
from augment.render.sh import rotate_sh, sh_rotation
from augment.render.threads import kernel_threads
from augment.scene import pose_kernels
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import quat_from_rotmat
from augment.scene.labels import Boxes, LabelSource, LidarSweep
from augment.scene.sky import Sky

# ---- Poses of an actor over time -----------------------------------------------------------------

# Angle below which sin loses its digits; the straight line is exact there.
_STRAIGHT_RAD = 1e-6
# Time at which the tracks of actors begin that no image shows: 73 years before 1970, ns.
_NEVER_NS = -(1 << 61)


@dataclass(frozen=True, eq=False)
class Track:
    """Poses of an actor over time: between samples linear in position, slerp in rotation."""

    timestamps_ns: Tensor
    """Times of the samples, int64 [T], strictly increasing."""
    world_from_actor: Float[Tensor, "T 4 4"]
    """Poses of the samples, float64 [T, 4, 4]."""
    hold_ns: int = 100_000_000
    """How long the actor stays at a pose before the first and after the last sample, and at both
    ends of a gap longer than max_gap_ns; beyond that it is absent. (Cameras of one frame fire at
    slightly different moments.)"""
    max_gap_ns: int | None = None
    """Longest time between two samples that is interpolated; None interpolates all."""

    def as_absent(self) -> Track:
        """Return the same motion before all times, of an actor that no image shows."""
        times_ns = self.timestamps_ns - self.timestamps_ns[0] + _NEVER_NS
        return replace(self, timestamps_ns=times_ns, hold_ns=0)

    @property
    def is_absent(self) -> bool:
        """Return True for a track of `as_absent`."""
        return int(self.timestamps_ns[0]) == _NEVER_NS

    def __post_init__(self) -> None:
        count = self.timestamps_ns.shape[0]
        if count < 1 or tuple(self.world_from_actor.shape) != (count, 4, 4):
            raise ValueError(
                f"a track needs T >= 1 timestamps and world_from_actor [T, 4, 4]; "
                f"got {count} and {list(self.world_from_actor.shape)}"
            )
        if count > 1 and not bool((self.timestamps_ns.diff() > 0).all()):
            raise ValueError("track timestamps must be strictly increasing")

    def pose_at(self, timestamp_ns: int) -> Float[Tensor, "4 4"] | None:
        """Return world_from_actor at a time, float64; None where the actor does not exist."""
        knots = self._knots
        times = knots.times_ns
        if not times[0] - self.hold_ns <= timestamp_ns <= times[-1] + self.hold_ns:
            return None
        if timestamp_ns <= times[0]:
            return self.world_from_actor[0]
        if timestamp_ns >= times[-1]:
            return self.world_from_actor[-1]
        after = bisect_right(times, timestamp_ns)
        before = after - 1
        if self.max_gap_ns is not None and times[after] - times[before] > self.max_gap_ns:
            if timestamp_ns - times[before] <= self.hold_ns:
                return self.world_from_actor[before]
            is_held = times[after] - timestamp_ns <= self.hold_ns
            return self.world_from_actor[after] if is_held else None
        fraction = (timestamp_ns - times[before]) / (times[after] - times[before])
        rows = _rotation(_slerp(knots.quats[before], knots.quats[after], fraction))
        for row, start, end in zip(rows, knots.centres[before], knots.centres[after], strict=True):
            row.append(
                start + fraction * (end - start)
                if fraction < 0.5
                else end - (end - start) * (1 - fraction)
            )
        return torch.tensor([*rows, [0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)

    @cached_property
    def _knots(self) -> _Knots:
        """Return the samples in Python's own numbers."""
        poses = self.world_from_actor.detach()
        return _Knots(
            self.timestamps_ns.tolist(),
            quat_from_rotmat(poses[:, :3, :3]).tolist(),
            poses[:, :3, 3].tolist(),
        )

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields only: what is cached is made anew in less time than it travels."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}


class _Knots(NamedTuple):
    """Samples of a track in Python's own numbers.

    For a single pose, calls of torch and NumPy take a hundred times as long as the arithmetic.
    """

    times_ns: list[int]
    """Times, T of them."""
    quats: list[list[float]]
    """Rotations as wxyz, T of 4."""
    centres: list[list[float]]
    """Positions, metres, T of 3."""


class PackedTracks(NamedTuple):
    """All A tracks of a scene, one after the other, for `pose_kernels.poses_at`."""

    starts: np.ndarray
    """First sample of each track, and the number of all samples K, int64 [A + 1]."""
    times_ns: np.ndarray
    """Times of all samples, int64 [K]."""
    quats: np.ndarray
    """Rotations of all samples as wxyz, float64 [K, 4]."""
    centres: np.ndarray
    """Positions of all samples, metres, float64 [K, 3]."""
    poses: np.ndarray
    """world_from_actor of all samples, float64 [K, 4, 4]."""
    holds_ns: np.ndarray
    """hold_ns of each track, int64 [A]."""
    max_gaps_ns: np.ndarray
    """max_gap_ns of each track, int64 [A]; -1 where it has none."""

    @staticmethod
    def from_tracks(tracks: Sequence[Track]) -> PackedTracks:
        """Return the tracks packed, in their order."""
        knots = [track._knots for track in tracks]
        starts = np.cumsum([0, *(len(track_knots.times_ns) for track_knots in knots)])
        poses = [track.world_from_actor.detach().double().numpy() for track in tracks]
        gaps_ns = [-1 if track.max_gap_ns is None else track.max_gap_ns for track in tracks]
        return PackedTracks(
            starts.astype(np.int64),
            np.concatenate([np.array(track_knots.times_ns, np.int64) for track_knots in knots]),
            np.concatenate([np.array(track_knots.quats, np.float64) for track_knots in knots]),
            np.concatenate([np.array(track_knots.centres, np.float64) for track_knots in knots]),
            np.ascontiguousarray(np.concatenate(poses)),
            np.array([track.hold_ns for track in tracks], np.int64),
            np.array(gaps_ns, np.int64),
        )


def _slerp(a: Sequence[float], b: Sequence[float], fraction: float) -> list[float]:
    """Return what `augment.scene.geometry.slerp` gives, not normalised, of two unit quaternions."""
    dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    angle = math.acos(min(abs(dot), 1.0))
    weight_a = 1 - fraction
    weight_b = fraction
    if angle >= _STRAIGHT_RAD:
        sin = math.sin(angle)
        weight_a = math.sin(weight_a * angle) / sin
        weight_b = math.sin(weight_b * angle) / sin
    if dot < 0:  # the shorter way round
        weight_b = -weight_b
    return [weight_a * p + weight_b * q for p, q in zip(a, b, strict=True)]


def _rotation(quat: Sequence[float]) -> list[list[float]]:
    """Return the rows of a rotation matrix, as `geometry.rotmat_from_quat`.

    Args:
        quat: wxyz, of any length but zero.
    """
    length = math.sqrt(sum(v * v for v in quat))
    w, x, y, z = (v / length for v in quat)
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


# ---- Colours that change over time ---------------------------------------------------------------
# Every splat's view-independent colour is a Fourier series of time (Yan et al. 2024, "Street
# Gaussians", section 3.1, "4D spherical harmonics"): sh_00(t) = sum_k c_k b_k(t), with b_k =
# cos(pi k t) for even k and sin(pi (k + 1) t) for odd k.


@dataclass(frozen=True, eq=False)
class ColorSeries:
    """Change of sh[:, 0] of N Gaussians over time, as a Fourier series.

    c_0 is sh[:, 0] itself, as b_0 is 1.
    """

    coefficients: Float[Tensor, "N terms 3"]
    """c_1 to c_{F-1}, [N, F - 1, 3], of the Gaussians' dtype."""
    timestamps_ns: Int64[Tensor, "T"]
    """Times at which `phases` are known, int64 [T], strictly increasing."""
    phases: Float[Tensor, "T"]
    """Value of t at these times, float64 [T]; linear between them, held beyond them."""

    def __post_init__(self) -> None:
        count = self.timestamps_ns.shape[0]
        if count < 1 or tuple(self.phases.shape) != (count,):
            raise ValueError(
                f"colour waves need T >= 1 timestamps and as many phases; got {count} and "
                f"{list(self.phases.shape)}"
            )
        if count > 1 and not bool((self.timestamps_ns.diff() > 0).all()):
            raise ValueError("timestamps of colour waves must be strictly increasing")
        if not bool(torch.isfinite(self.phases).all()):
            raise ValueError("phases of colour waves must be finite")

    @property
    def nbytes(self) -> int:
        """Return the bytes of the coefficients."""
        return self.coefficients.numel() * self.coefficients.element_size()

    def phase_at(self, timestamp_ns: int) -> float:
        """Return t of the series at a time."""
        times = self.timestamps_ns.tolist()
        phases = self.phases.tolist()
        after = bisect_right(times, timestamp_ns)
        if after == 0:
            return phases[0]
        if after == len(times):
            return phases[-1]
        fraction = (timestamp_ns - times[after - 1]) / (times[after] - times[after - 1])
        return phases[after - 1] + fraction * (phases[after] - phases[after - 1])

    def weights_at(self, timestamp_ns: int) -> list[float]:
        """Return b_1 to b_{F-1} at a time."""
        return fourier_basis(self.phase_at(timestamp_ns), self.coefficients.shape[1] + 1)[1:]

    def color_offset_at(self, timestamp_ns: int) -> Float[Tensor, "N 3"]:
        """Return the colours to add to sh[:, 0] at a time."""
        weights = self.weights_at(timestamp_ns)
        change = torch.zeros_like(self.coefficients[:, 0])
        for term, weight in enumerate(weights):
            change.add_(self.coefficients[:, term], alpha=weight)
        return change


def fourier_basis(phase: float, terms: int) -> list[float]:
    """Return b_0 to b_{terms-1} at a phase."""
    return [
        math.cos(math.pi * k * phase) if k % 2 == 0 else math.sin(math.pi * (k + 1) * phase)
        for k in range(terms)
    ]


def colors_at(
    sh: Float[Tensor, "N K 3"],
    waves: ColorSeries | None,
    timestamp_ns: int,
    rotation: Float[Tensor, "3 3"] | None,
    *,
    fast: bool = True,
) -> Float[Tensor, "N K 3"]:
    """Return SH in the colours of a time, turned by a rotation.

    Args:
        sh: spherical harmonics of N Gaussians.
        waves: their change over time; None leaves the colours.
        timestamp_ns: the time.
        rotation: the rotation; None turns nothing.
        fast: send float32 through the CPU kernel, which equals the definition here within float
            rounding.
    """
    if fast and sh.dtype == torch.float32 and not sh.requires_grad:
        return _colors_by_kernel(sh, waves, timestamp_ns, rotation)
    if waves is not None:
        base_colors = sh[:, :1] + waves.color_offset_at(timestamp_ns)[:, None]
        sh = torch.cat([base_colors, sh[:, 1:]], 1)
    return sh if rotation is None or sh.shape[1] == 1 else rotate_sh(sh, rotation)


def _colors_by_kernel(
    sh: Tensor, waves: ColorSeries | None, timestamp_ns: int, rotation: Tensor | None
) -> Tensor:
    """Return `colors_at` of float32 values, by the CPU kernel."""
    coefficients = np.zeros((len(sh), 0, 3), np.float32)
    weights = []
    if waves is not None:
        coefficients = waves.coefficients.detach().contiguous().numpy()
        weights = waves.weights_at(timestamp_ns)
    turn_matrix = np.zeros((0, 0), np.float32)
    if rotation is not None and sh.shape[1] > 1:
        turn_matrix = sh_rotation(rotation, math.isqrt(sh.shape[1]) - 1).numpy().astype(np.float32)
    out = np.empty(tuple(sh.shape), np.float32)
    sh_rows = sh.detach().contiguous().numpy()
    term_weights = np.asarray(weights, np.float32)
    with kernel_threads(1):
        pose_kernels.colors_at(sh_rows, coefficients, term_weights, turn_matrix, out)
    return torch.from_numpy(out)


# Largest coordinate or scale of a usable Gaussian, metres. Float32 still tells metres apart there,
# and squares and cells are still numbers.
MAX_EXTENT_M = 1e7
# Numbers K of spherical harmonics that Gaussians may have: (degree + 1)^2 for degrees 0 to 3.
NUM_SH_BY_DEGREE = (1, 4, 9, 16)


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N Gaussians with activated values.

    All float tensors share one dtype (float32; float64 for the reference rasteriser).
    """

    means: Float[Tensor, "N 3"]
    """Centres, metres, [N, 3]."""
    quats: Float[Tensor, "N 4"]
    """Rotations, unit wxyz, [N, 4]."""
    scales: Float[Tensor, "N 3"]
    """Standard deviations along the rotated axes, metres, > 0, [N, 3]."""
    opacities: Float[Tensor, "N"]
    """Opacities, 0 to 1, [N]."""
    sh: Float[Tensor, "N K 3"]
    """Spherical harmonics, [N, K, 3]; colour = 0.5 + sum sh Y."""
    semantic: Int16[Tensor, "N"] | None = None
    """SemanticClass values, [N]; None where unknown."""

    def __post_init__(self) -> None:
        count = self.means.shape[0]
        columns = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": ()}
        for name, suffix in columns.items():
            value = getattr(self, name)
            shape = (count, *suffix)
            if tuple(value.shape) != shape:
                raise ValueError(
                    f"{name} must be {list(shape)} with N={count} (from means); "
                    f"got {list(value.shape)}"
                )
            if value.dtype != self.means.dtype or not value.dtype.is_floating_point:
                raise ValueError(
                    f"{name} must have the floating dtype of means, {self.means.dtype}; "
                    f"got {value.dtype}"
                )
        shape = tuple(self.sh.shape)
        if (
            len(shape) != 3
            or shape[0] != count
            or shape[1] not in NUM_SH_BY_DEGREE
            or shape[2] != 3
        ):
            raise ValueError(
                f"sh must be [N, K, 3] with N={count} and K in {NUM_SH_BY_DEGREE} (degrees 0-3); "
                f"got {list(shape)}"
            )
        if self.semantic is not None and tuple(self.semantic.shape) != (count,):
            raise ValueError(f"semantic must be [{count}]; got {list(self.semantic.shape)}")

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Return the degree of the spherical harmonics, 0 to 3."""
        return NUM_SH_BY_DEGREE.index(self.sh.shape[1])

    @property
    def nbytes(self) -> int:
        """Return the bytes of all tensors."""
        return sum(t.numel() * t.element_size() for t in self._tensors().values())

    def _tensors(self) -> dict[str, Tensor]:
        """Return the tensors by field name, without those that are None."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {name: value for name, value in values.items() if value is not None}

    def select(self, index: Tensor) -> Gaussians:
        """Return the Gaussians at the given indices or mask, in that order."""
        return Gaussians(**{name: tensor[index] for name, tensor in self._tensors().items()})

    @staticmethod
    def empty(sh_degree: int = 0) -> Gaussians:
        """Return no Gaussians, of float32."""
        shapes = ((0, 3), (0, 4), (0, 3), (0,), (0, NUM_SH_BY_DEGREE[sh_degree], 3))
        return Gaussians(*(torch.zeros(shape) for shape in shapes))


@dataclass(frozen=True, eq=False)
class Actor:
    """A rigid moving object."""

    track_id: str
    """Name of the actor, unique in its scene."""
    label: str
    """Name of the object's kind in the dataset."""
    gaussians: Gaussians
    """Gaussians in the actor's own frame: x forward, y left, z up, origin at the box centre."""
    track: Track
    """Poses over time."""
    size_m: tuple[float, float, float]
    """Length, width and height of the box, metres."""
    color_waves: ColorSeries | None = None
    """Change of the colours over time, a row for each Gaussian; None where there is none."""
    colors_in_world: bool = False
    """If True, SH are for directions of the world, however the actor is turned, as Street Gaussians
    and drivestudio train them; else for directions of its own frame."""
    copy_of: str | None = None
    """Track id of the actor of the same scene that this one is a copy of; None for an actor that
    was recorded, or that comes from another scene."""

    def __post_init__(self) -> None:
        waves = self.color_waves
        if waves is not None and len(waves.coefficients) != len(self.gaussians):
            raise ValueError(
                f"actor {self.track_id!r}: colour waves must have a row for each of its "
                f"{len(self.gaussians)} Gaussians; got {len(waves.coefficients)}"
            )

    def gaussians_at(self, timestamp_ns: int) -> Gaussians:
        """Return the Gaussians in the colours of a time, SH for directions in the actor's own
        frame.

        The colours of the last moment are kept, for other cameras that look at it.
        """
        pose = self.track.pose_at(timestamp_ns) if self.colors_in_world else None
        rotation = None if pose is None or self.gaussians.sh_degree == 0 else pose[:3, :3].T
        if self.color_waves is None and rotation is None:
            return self.gaussians
        gaussians = self.gaussians
        waves = self.color_waves

        def color() -> Gaussians:
            return replace(gaussians, sh=colors_at(gaussians.sh, waves, timestamp_ns, rotation))

        inputs = [gaussians.sh, *([] if waves is None else [waves.coefficients])]
        if any(tensor.requires_grad or tensor.is_inference() for tensor in inputs):
            return color()
        moment = timestamp_ns, *(tensor._version for tensor in inputs)
        return memo_of(self).get(("colours of a moment",), LatestValue).get(moment, color)


@dataclass(frozen=True, eq=False)
class SplatShading:
    """Light that falls on every pixel of a splat by its own normal n (`augment.render.shading`).

    A splat's colour at a pixel is that of its SH, plus slopes times the wrapped share of the light,
    clamp((n . sun + wrap) / (1 + wrap), 0, 1).
    """

    slopes: Float[Tensor, "N 3"]
    """Colour that full light adds, [N, 3]."""
    sun: tuple[float, float, float]
    """Unit vector towards the light, in the part's frame."""
    wrap: float
    """How far light reaches round a splat; 0 for a plain cosine."""


@dataclass(frozen=True, eq=False)
class PosedGaussians:
    """Gaussians in the world: the input of a rasteriser, which concatenates nothing.

    A part has either `shading` or `color_maps`.
    """

    gaussians: Gaussians
    """The Gaussians, in the part's frame."""
    world_from_part: Float[Tensor, "4 4"] | None = None
    """Pose, float64 [4, 4]; None for the identity."""
    instance_id: int = 0
    """0 for the background, else 1 + the actor's index."""
    is_overlay: bool = False
    """If True, the part lies on the scene, as snow does: the buffer "overlay" counts it, and styles
    leave its colours."""
    shading: SplatShading | None = None
    """Light by the splats' normals; None for splats of one colour each."""
    color_maps: Float[Tensor, "C 3 4"] | None = None
    """Maps of the colour c that a splat shows, [C, 3, 4]: c' = max(M[:, :3] @ c + M[:, 3], 0); None
    leaves the colours."""
    color_rows: Int16[Tensor, "N"] | None = None
    """Row of each splat's map, int16 [N]; None takes the row of its class, or the first where there
    is no such row."""
    rows: Int64[np.ndarray, "R 2"] | None = None
    """Runs (first, last + 1) of splats to render, int64 [R, 2], backend "cpu" only; None renders
    all."""

    @property
    def color_map_rows(self) -> Int16[Tensor, "N"] | None:
        """Return the row of each splat's colour map; None where all take the first."""
        if self.color_maps is None or len(self.color_maps) == 1:
            return None
        return self.gaussians.semantic if self.color_rows is None else self.color_rows


GroundSource = Literal["map", "lidar labels", "road splats", "ransac", "ego path", "stated"]


@dataclass(frozen=True)
class Ground:
    """Heights of the road under the ego path, scene world, and how they are known."""

    lowest_z_m: float
    """Lowest height of the path's stretches."""
    median_z_m: float
    """Median height of the path's stretches."""
    source: GroundSource
    """Origin of the heights."""
    residual_m: float | None = None
    """Median distance of the `points` from the planes of their stretches; None without points."""
    points: int = 0
    """Number of points that the planes were fitted to."""
    tilt_deg: float | None = None
    """Angle between the road's normal and +z (a road that slopes, or a gravity that is off); None
    where unknown."""

    def __post_init__(self) -> None:
        if not self.lowest_z_m <= self.median_z_m:  # also catches NaN
            raise ValueError(
                f"a ground's lowest height must not be above its median one; got lowest_z_m "
                f"{self.lowest_z_m}, median_z_m {self.median_z_m}"
            )


# Fields that a moved scene shares with its recorded one, and that decide what is computed for it.
_SHARED_FACTS = (
    "frames",
    "seen_frames",
    "world_origin_m",
    "ground",
    "color_maps",
    "image_color_maps",
    "ego_masks",
)


@dataclass(frozen=True, eq=False)
class Scene:
    """All facts about a drive, in one world: metres, right-handed, +z up."""

    name: str
    """Name of the scene."""
    source: str
    """URI that the scene was opened from; open_scene(source) opens it again."""
    background: Gaussians
    """Gaussians of everything that does not move, in the world."""
    actors: tuple[Actor, ...]
    """Moving objects."""
    sky: Sky
    """Colour by direction, infinitely far away."""
    frames: tuple[Frame, ...]
    """Frames in order of time, each with the scene's cameras."""
    labels: LabelSource | None = None
    """Reader of boxes and LiDAR on demand; None without labels."""
    world_origin_m: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """Offset that was subtracted from the dataset's coordinates, float64 [3]."""
    ground_z_m: float | None = None
    """Lowest height of the road under the ego path, scene world; None where unknown."""
    has_metric_scale: bool = True
    """False where one unit is not known to be one metre."""
    problems: tuple[str, ...] = ()
    """Faults that the adapter found and went on without, one sentence each."""
    color_maps: Mapping[str, Float[Tensor, "3 4"]] = field(default_factory=dict)
    """Difference of a camera's recorded colours from the scene's, by camera name: float32 [3, 4],
    recorded = M[:, :3] @ rgb + M[:, 3], display-encoded. A camera without one records the scene's
    own colours."""
    recorded_source: str | None = None
    """URI of the recording that a fitted scene was made from, for its labels; None where `source`
    itself is the recording."""
    made_by: Mapping[str, Any] = field(default_factory=dict)
    """Origin of the Gaussians: facts for people and reports, in JSON's own types."""
    ground: Ground | None = None
    """Heights of the road under the path, where the adapter has measured them or was told; its
    lowest is then `ground_z_m`. None where `augment.scene.ground.ground_of` has to measure."""
    has_known_gravity: bool = True
    """False where +z is not known to point up."""
    image_color_maps: Mapping[tuple[str, int], Float[Tensor, "3 4"]] = field(default_factory=dict)
    """The same maps for single images, by camera name and timestamp_ns; they go before
    `color_maps`."""
    seen_frames: tuple[Frame, ...] | None = None
    """Frames that the scene was made from, where `frames` are others (those of a camera path, or
    invented ones); empty where they are not known, None where they are `frames`."""
    lens_frames: tuple[Frame, ...] | None = None
    """The frames with their lenses, where `frames` have pinholes in their place
    (`augment.scene.pinhole_scene`); else None."""
    ego_masks: Mapping[str, Bool[np.ndarray, "_ _"]] | None = None
    """Pixels of recorded images that show the recording car, by camera name, bool [H, W] at the
    size of the camera's images. A camera without a mask shows none of it; None where no masks are
    stated, and the images have to tell."""
    recorded: Scene | None = None
    """The scene as it was recorded, where `augment.scene.moved_actors` has moved, removed or added
    actors: the same actors in the same order, on their recorded tracks. None where nothing was
    moved."""

    def __post_init__(self) -> None:
        for name, color_map in self.color_maps.items():
            _check_color_map(self.name, name, color_map)
        for (name, timestamp_ns), color_map in self.image_color_maps.items():
            _check_color_map(self.name, f"{name} at {timestamp_ns} ns", color_map)
        if len(self.background) + sum(len(a.gaussians) for a in self.actors) == 0:
            raise SceneError(
                f"scene {self.name!r} ({self.source}) holds no Gaussians; nothing can be rendered"
            )
        ids = [a.track_id for a in self.actors]
        if len(set(ids)) != len(ids):
            repeated = sorted({i for i in ids if ids.count(i) > 1})
            raise ValueError(f"scene {self.name!r}: actor track_ids repeat: {repeated}")

    @property
    def camera_names(self) -> tuple[str, ...]:
        """Return the names of all cameras, in the order in which they first appear."""
        return tuple(dict.fromkeys(name for frame in self.frames for name in frame.cameras))

    @property
    def as_recorded(self) -> Scene:
        """Return the scene as it was recorded; the scene itself where no actor was moved.

        All that does not depend on the places of actors is computed for this scene, so that it is
        computed once for any number of moves. A scene whose background or sky was replaced after
        the move is taken as it is; one whose name, frames or other facts were replaced has them
        here, too.
        """
        base = self.recorded
        if base is None or base.background is not self.background or base.sky is not self.sky:
            return self
        has_same_facts = all(getattr(base, name) is getattr(self, name) for name in _SHARED_FACTS)
        is_same = has_same_facts and (base.name, base.ground_z_m) == (self.name, self.ground_z_m)
        return base if is_same else self._recorded_with_facts

    @cached_property
    def _recorded_with_facts(self) -> Scene:
        """Return the scene as it was recorded, with the name, frames and facts of this one."""
        assert self.recorded is not None
        base = self.recorded
        return replace(self, actors=base.actors, labels=base.labels, recorded=None)

    def without_memo(self) -> Scene:
        """Return the same scene as an object of its own, of which nothing has been computed yet."""
        base = None if self.recorded is None else replace(self.recorded)
        return replace(self, recorded=base)

    @property
    def moved_instances(self) -> frozenset[int]:
        """Return the instance ids of actors that were moved, removed or added."""
        recorded_actors = () if self.recorded is None else self.recorded.actors
        pairs = zip(self.actors, recorded_actors, strict=False)
        return frozenset(
            number
            for number, (actor, recorded) in enumerate(pairs, start=1)
            if actor.track is not recorded.track
        )

    @property
    def all_gaussians(self) -> tuple[Gaussians, ...]:
        """Return the background's Gaussians, then each actor's in its own frame."""
        return (self.background, *(actor.gaussians for actor in self.actors))

    @property
    def gaussian_bytes(self) -> int:
        """Return the bytes of all Gaussians and of their colours over time."""
        waves = (actor.color_waves for actor in self.actors)
        num_bytes = sum(gaussians.nbytes for gaussians in self.all_gaussians)
        return num_bytes + sum(wave.nbytes for wave in waves if wave is not None)

    def with_gaussians(self, change: Callable[[Gaussians], Gaussians]) -> Scene:
        """Return the scene with every part's Gaussians changed by a function."""
        return replace(
            self,
            background=change(self.background),
            actors=tuple(replace(a, gaussians=change(a.gaussians)) for a in self.actors),
        )

    def frame(self, index: int) -> Frame:
        """Return the frame with the dataset's number `index`."""
        for frame in self.frames:
            if frame.index == index:
                return frame
        indices = [f.index for f in self.frames]
        raise SceneError(
            f"scene {self.name!r} has no frame {index}; it has "
            + (f"{indices[0]} to {indices[-1]} ({len(indices)} frames)" if indices else "none")
        )

    def parts_at(
        self, timestamp_ns: int, actor_ids: Collection[int] | None = None
    ) -> Iterator[PosedGaussians]:
        """Yield the background and every actor that exists at a time, posed.

        Args:
            timestamp_ns: the time.
            actor_ids: instance_ids of the actors to take; None for all.
        """
        yield PosedGaussians(self.background)
        for number, actor in enumerate(self.actors, start=1):
            if actor_ids is not None and number not in actor_ids:
                continue
            pose = actor.track.pose_at(timestamp_ns)
            if pose is not None:
                posed = actor.gaussians_at(timestamp_ns)
                yield PosedGaussians(posed, pose, instance_id=number)

    def poses_at(self, timestamp_ns: int) -> dict[int, np.ndarray]:
        """Return world_from_actor, float64 [4, 4], by instance id, of actors that exist at a
        time.
        """
        if not self.actors:
            return {}
        tracks = memo_of(self).get(
            ("tracks",), lambda: PackedTracks.from_tracks([actor.track for actor in self.actors])
        )
        is_present = np.empty(len(self.actors), np.uint8)
        poses = np.empty((len(is_present), 4, 4))
        pose_kernels.poses_at(timestamp_ns, _STRAIGHT_RAD, tracks, is_present, poses)
        return {int(n) + 1: poses[n] for n in np.flatnonzero(is_present)}

    def parts_for(
        self, camera: Camera, actor_ids: Collection[int] | None = None
    ) -> tuple[PosedGaussians, ...]:
        """Return the parts at the moment of the camera's image, as `parts_at` yields them."""
        return tuple(self.parts_at(camera.timestamp_ns, actor_ids))

    def color_map(self, camera: Camera) -> Float[Tensor, "3 4"] | None:
        """Return the image's colour map, or else the camera's.

        None where there is none, or where it changes nothing.
        """
        color_map = self.image_color_maps.get((camera.name, camera.timestamp_ns))
        if color_map is None:
            color_map = self.color_maps.get(camera.name)
        if color_map is None or torch.equal(color_map, torch.eye(3, 4)):
            return None
        return color_map

    @property
    def color_mapped_cameras(self) -> tuple[str, ...]:
        """Return the names of cameras with a colour map, for all or for single images, in order."""
        maps = [*self.color_maps.items(), *((n, m) for (n, _), m in self.image_color_maps.items())]
        identity = torch.eye(3, 4)
        mapped_names = {name for name, color_map in maps if not torch.equal(color_map, identity)}
        return tuple(name for name in self.camera_names if name in mapped_names)

    @cached_property
    def common_color_map(self) -> Float[Tensor, "3 4"] | None:
        """Return the mean of all colour maps, float64; None where none changes anything."""
        maps = [*self.color_maps.values(), *self.image_color_maps.values()]
        return torch.stack(maps).double().mean(0) if self.color_mapped_cameras else None

    def boxes(self, frame_index: int) -> Boxes:
        """Return the labelled boxes of a frame."""
        return Boxes.empty() if self.labels is None else self.labels.boxes(frame_index)

    def lidar(self, frame_index: int) -> LidarSweep | None:
        """Return the LiDAR sweep of a frame; None where there is none."""
        return None if self.labels is None else self.labels.lidar(frame_index)


def _check_color_map(scene: str, camera: str, color_map: Tensor) -> None:
    """Raise ValueError unless a colour map is finite float32 [3, 4]."""
    if color_map.dtype != torch.float32 or tuple(color_map.shape) != (3, 4):
        raise ValueError(
            f"scene {scene!r}: the colour map of camera {camera!r} must be float32 [3, 4]; "
            f"got {color_map.dtype} {list(color_map.shape)}"
        )
    if not bool(torch.isfinite(color_map).all()):
        raise ValueError(
            f"scene {scene!r}: the colour map of camera {camera!r} must be finite; "
            f"got {color_map.tolist()}"
        )


def check_gaussians(gaussians: Gaussians, *, where: str) -> tuple[Gaussians, tuple[str, ...]]:
    """Return the Gaussians that a rasteriser can render, and a sentence for each kind left out.

    Left out are NaN or infinite values, zero quaternions, scales <= 0, and coordinates and scales
    beyond MAX_EXTENT_M. Quaternions are normalised, opacities clamped to 0 to 1.

    Args:
        gaussians: the Gaussians.
        where: names the Gaussians in the sentences.

    Raises:
        SceneError: nothing usable remains.
    """
    finite = _finite_rows(gaussians)
    norms = quat_lengths(gaussians.quats)
    largest = torch.maximum(gaussians.means.abs().amax(1), gaussians.scales.amax(1))
    is_far = finite & (norms > 0) & (gaussians.scales.amin(1) > 0) & (largest > MAX_EXTENT_M)
    first_far = f"; the first is number {int(is_far.int().argmax())}" if bool(is_far.any()) else ""
    # The order matters: each count leaves out what earlier checks have counted.
    faults = {
        "with NaN or infinite values": ~finite,
        "with a zero quaternion": finite & (norms == 0),
        "with a scale <= 0": finite & (norms > 0) & (gaussians.scales.amin(1) <= 0),
        f"with coordinates or scales beyond {MAX_EXTENT_M:.0e} m{first_far}": is_far,
    }
    problems = tuple(
        f"{where}: left out {int(mask.sum())} of {len(gaussians)} Gaussians {fault}"
        for fault, mask in faults.items()
        if bool(mask.any())
    )
    if problems:
        is_usable = ~torch.stack(list(faults.values())).any(0)
        gaussians = gaussians.select(is_usable)
        norms = norms[is_usable]
    if len(gaussians) == 0:
        raise SceneError(f"{where} holds no usable Gaussians. " + " ".join(problems))
    quats = (gaussians.quats / norms[:, None]).to(gaussians.quats.dtype)
    return replace(gaussians, quats=quats, opacities=gaussians.opacities.clamp(0, 1)), problems


def _finite_rows(gaussians: Gaussians) -> Bool[Tensor, "N"]:
    """Return the mask of Gaussians whose numbers are all finite."""
    finite = torch.isfinite(gaussians.opacities)
    for tensor in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.sh):
        finite &= torch.isfinite(tensor.reshape(len(gaussians), -1).sum(1))
    return finite


def quat_lengths(quats: Float[Tensor, "N 4"]) -> Float[Tensor, "N"]:
    """Return the lengths of quaternions.

    They are in float64 where the squares of some leave float32's range: 1e-30 is no zero, and 1e20
    has an end.
    """
    lengths = quats.norm(dim=1)
    if bool(((lengths > 1e-15) & (lengths < 1e15)).all()):
        return lengths
    return quats.double().norm(dim=1)


# ---- The checks of `check_gaussians` without its copies ------------------------------------------

# Error of a unit quaternion's length beyond which it has to be normalised.
_QUAT_TOLERANCE = 1e-4
# Gaussians that are checked together: temporaries stay in the cache.
_ROWS = 1 << 16


def is_drawable(gaussians: Gaussians) -> bool:
    """Return True if `check_gaussians` would change nothing.

    Each number is read once.
    """
    return all(
        _piece_is_drawable(gaussians, slice(start, start + _ROWS))
        for start in range(0, len(gaussians), _ROWS)
    )


def drawable_rows(gaussians: Gaussians) -> Bool[Tensor, "N"]:
    """Return the mask of Gaussians that `check_gaussians` keeps."""
    is_usable = _finite_rows(gaussians)
    for tensor in (gaussians.means, gaussians.scales):
        is_usable &= tensor.abs().amax(1) <= MAX_EXTENT_M
    return is_usable & (quat_lengths(gaussians.quats) > 0) & (gaussians.scales.amin(1) > 0)


def _piece_is_drawable(gaussians: Gaussians, rows: slice) -> bool:
    """Return `is_drawable` of some rows."""
    means = gaussians.means[rows]
    quats = gaussians.quats[rows]
    sh = gaussians.sh[rows]
    scales = gaussians.scales[rows]
    opacities = gaussians.opacities[rows]
    ranges = [_range(tensor) for tensor in (means, quats, scales, opacities, sh)]
    with np.errstate(over="ignore", invalid="ignore"):
        shortest, longest = _range((quats.numpy() ** 2).sum(1) ** 0.5)
    return (
        bool(np.isfinite(ranges).all())
        and shortest > 1 - _QUAT_TOLERANCE
        and longest < 1 + _QUAT_TOLERANCE
        and -MAX_EXTENT_M <= ranges[0][0] <= ranges[0][1] <= MAX_EXTENT_M
        and 0 < ranges[2][0] <= ranges[2][1] <= MAX_EXTENT_M
        and ranges[3][0] >= 0
        and ranges[3][1] <= 1
    )


def _range(values: Tensor | np.ndarray) -> tuple[float, float]:
    """Return the lowest and highest value, NaN if there is one. NumPy wakes no threads for it."""
    array = values.numpy() if isinstance(values, Tensor) else values
    with np.errstate(invalid="ignore"):
        return float(array.min()), float(array.max())
