"""A driving scene: Gaussians, moving actors, sky, cameras over time, labels."""

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

from augment import kernels
from augment.cameras import Camera, Frame
from augment.errors import SceneError
from augment.geometry import quat_from_rotmat
from augment.labels import Boxes, LabelSource, LidarSweep
from augment.memo import Latest, memo_of
from augment.render.sh import rotate_sh, sh_turn
from augment.render.threads import kernel_threads
from augment.sky import Sky

# ---- Where an actor is over time -----------------------------------------------------------------

_STRAIGHT_RAD = 1e-6  # sin of a smaller angle loses its digits; the straight line is exact there


@dataclass(frozen=True, eq=False)
class Track:
    """Where an actor is over time. Linear in position, slerp in rotation, between samples.

    timestamps_ns: int64 [T], strictly increasing. world_from_actor: float64 [T, 4, 4].
    hold_ns: how long the actor stays at a pose before the first and after the last sample, and at
    both ends of a gap longer than max_gap_ns (None: always interpolated); beyond it the actor is
    absent. (Cameras of a frame fire at slightly different moments.)
    """

    timestamps_ns: Tensor
    world_from_actor: Float[Tensor, "T 4 4"]
    hold_ns: int = 100_000_000
    max_gap_ns: int | None = None

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
        """world_from_actor at a time, float64, or None where the actor does not exist."""
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
            is_near = times[after] - timestamp_ns <= self.hold_ns
            return self.world_from_actor[after] if is_near else None
        fraction = (timestamp_ns - times[before]) / (times[after] - times[before])
        rows = _rotation(_slerp(knots.quats[before], knots.quats[after], fraction))
        for row, a, b in zip(rows, knots.centres[before], knots.centres[after], strict=True):
            row.append(a + fraction * (b - a) if fraction < 0.5 else b - (b - a) * (1 - fraction))
        return torch.tensor([*rows, [0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)

    @cached_property
    def _knots(self) -> _Knots:
        poses = self.world_from_actor.detach()
        return _Knots(
            self.timestamps_ns.tolist(),
            quat_from_rotmat(poses[:, :3, :3]).tolist(),
            poses[:, :3, 3].tolist(),
        )

    def __getstate__(self) -> dict[str, Any]:
        """Without what is cached, which is made anew in less time than it travels."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}


class _Knots(NamedTuple):
    """A track in Python's own numbers: for a single pose, torch's and NumPy's calls take a hundred
    times as long as the arithmetic. quats: wxyz, T of 4. centres: T of 3.
    """

    times_ns: list[int]
    quats: list[list[float]]
    centres: list[list[float]]


class PackedTracks(NamedTuple):
    """All tracks of a scene for kernels.poses_at. starts int64 [A + 1]: the samples of each.
    times_ns, quats [K, 4], centres [K, 3], poses [K, 4, 4]: of all samples. holds_ns, gaps_ns
    int64 [A]: -1 where a track has no max_gap_ns.
    """

    starts: np.ndarray
    times_ns: np.ndarray
    quats: np.ndarray
    centres: np.ndarray
    poses: np.ndarray
    holds_ns: np.ndarray
    gaps_ns: np.ndarray

    @staticmethod
    def of(tracks: Sequence[Track]) -> PackedTracks:
        knots = [track._knots for track in tracks]
        starts = np.cumsum([0, *(len(own.times_ns) for own in knots)])
        poses = [track.world_from_actor.detach().double().numpy() for track in tracks]
        gaps = [-1 if track.max_gap_ns is None else track.max_gap_ns for track in tracks]
        return PackedTracks(
            starts.astype(np.int64),
            np.concatenate([np.array(own.times_ns, np.int64) for own in knots]),
            np.concatenate([np.array(own.quats, np.float64) for own in knots]),
            np.concatenate([np.array(own.centres, np.float64) for own in knots]),
            np.ascontiguousarray(np.concatenate(poses)),
            np.array([track.hold_ns for track in tracks], np.int64),
            np.array(gaps, np.int64),
        )


def _slerp(a: Sequence[float], b: Sequence[float], fraction: float) -> list[float]:
    """As augment.geometry.slerp."""
    dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    angle = math.acos(min(abs(dot), 1.0))
    weight_a, weight_b = 1 - fraction, fraction
    if angle >= _STRAIGHT_RAD:
        sin = math.sin(angle)
        weight_a, weight_b = math.sin(weight_a * angle) / sin, math.sin(weight_b * angle) / sin
    if dot < 0:  # the shorter way round
        weight_b = -weight_b
    return [weight_a * p + weight_b * q for p, q in zip(a, b, strict=True)]


def _rotation(quat: Sequence[float]) -> list[list[float]]:
    """Rows of the rotation of a wxyz quaternion of any length, as geometry.rotmat_from_quat."""
    length = math.sqrt(sum(v * v for v in quat))
    w, x, y, z = (v / length for v in quat)
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


# ---- Colours that change over time: a Fourier series of every splat's view-independent colour ----
# Yan et al. 2024 (Street Gaussians), section 3.1, "4D spherical harmonics": sh_00(t) = sum_k c_k
# b_k(t) with b_k = cos(pi k t) for even k, sin(pi (k + 1) t) for odd k.


@dataclass(frozen=True, eq=False)
class ColorWaves:
    """What is added to sh[:, 0] of N Gaussians over time; c_0 is sh[:, 0] itself, as b_0 is 1.

    coefficients [N, F - 1, 3]: c_1 to c_{F-1}, of the Gaussians' dtype. timestamps_ns [T]: strictly
    increasing. phases: float64 [T], t at these times; linear between them, held beyond them.
    """

    coefficients: Float[Tensor, "N terms 3"]
    timestamps_ns: Int64[Tensor, "T"]
    phases: Float[Tensor, "T"]

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
        return self.coefficients.numel() * self.coefficients.element_size()

    def phase_at(self, timestamp_ns: int) -> float:
        times, phases = self.timestamps_ns.tolist(), self.phases.tolist()
        after = bisect_right(times, timestamp_ns)
        if after == 0:
            return phases[0]
        if after == len(times):
            return phases[-1]
        share = (timestamp_ns - times[after - 1]) / (times[after] - times[after - 1])
        return phases[after - 1] + share * (phases[after] - phases[after - 1])

    def weights_at(self, timestamp_ns: int) -> list[float]:
        """b_1 to b_{F-1} at a time."""
        return basis(self.phase_at(timestamp_ns), self.coefficients.shape[1] + 1)[1:]

    def change_at(self, timestamp_ns: int) -> Float[Tensor, "N 3"]:
        """What is added to sh[:, 0] at a time."""
        weights = self.weights_at(timestamp_ns)
        change = torch.zeros_like(self.coefficients[:, 0])
        for term, weight in enumerate(weights):
            change.add_(self.coefficients[:, term], alpha=weight)
        return change


def basis(phase: float, terms: int) -> list[float]:
    """b_0 to b_{terms-1} at a phase."""
    return [
        math.cos(math.pi * k * phase) if k % 2 == 0 else math.sin(math.pi * (k + 1) * phase)
        for k in range(terms)
    ]


def colors_at(
    sh: Float[Tensor, "N K 3"],
    waves: ColorWaves | None,
    timestamp_ns: int,
    turn: Float[Tensor, "3 3"] | None,
    *,
    fast: bool = True,
) -> Float[Tensor, "N K 3"]:
    """SH in the colours of a time, and turned by a rotation, where there are such.

    fast: float32 goes through the CPU kernel, equal to the definition here within float rounding.
    """
    if fast and sh.dtype == torch.float32 and not sh.requires_grad:
        return _colors_by_kernel(sh, waves, timestamp_ns, turn)
    if waves is not None:
        first = sh[:, :1] + waves.change_at(timestamp_ns)[:, None]
        sh = torch.cat([first, sh[:, 1:]], 1)
    return sh if turn is None or sh.shape[1] == 1 else rotate_sh(sh, turn)


def _colors_by_kernel(
    sh: Tensor, waves: ColorWaves | None, timestamp_ns: int, turn: Tensor | None
) -> Tensor:
    coefficients, weights = np.zeros((len(sh), 0, 3), np.float32), []
    if waves is not None:
        coefficients = waves.coefficients.detach().contiguous().numpy()
        weights = waves.weights_at(timestamp_ns)
    matrix = np.zeros((0, 0), np.float32)
    if turn is not None and sh.shape[1] > 1:
        matrix = sh_turn(turn, math.isqrt(sh.shape[1]) - 1).numpy().astype(np.float32)
    out = np.empty(tuple(sh.shape), np.float32)
    rows, terms = sh.detach().contiguous().numpy(), np.asarray(weights, np.float32)
    with kernel_threads(1):
        kernels.colors_at(rows, coefficients, terms, matrix, out)
    return torch.from_numpy(out)


MAX_EXTENT_M = 1e7  # float32 tells metres apart there, and squares and cells are still numbers
SH_COUNTS = (1, 4, 9, 16)  # K = (degree + 1)^2 for degrees 0 to 3


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N Gaussians with activated values.

    means [N, 3]: metres. quats [N, 4]: unit wxyz. scales [N, 3]: metres, > 0 along the rotated
    axes. opacities [N]: in [0, 1]. sh [N, K, 3]: spherical harmonics, colour = 0.5 + sum sh Y.
    semantic [N]: SemanticClass values, or None where unknown.
    All float tensors share one dtype (float32; float64 for the reference rasteriser).
    """

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]
    opacities: Float[Tensor, "N"]
    sh: Float[Tensor, "N K 3"]
    semantic: Int16[Tensor, "N"] | None = None

    def __post_init__(self) -> None:
        count = self.means.shape[0]
        columns = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": ()}
        for name, own in columns.items():
            value, shape = getattr(self, name), (count, *own)
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
        if len(shape) != 3 or shape[0] != count or shape[1] not in SH_COUNTS or shape[2] != 3:
            raise ValueError(
                f"sh must be [N, K, 3] with N={count} and K in {SH_COUNTS} (degrees 0-3); "
                f"got {list(shape)}"
            )
        if self.semantic is not None and tuple(self.semantic.shape) != (count,):
            raise ValueError(f"semantic must be [{count}]; got {list(self.semantic.shape)}")

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        return SH_COUNTS.index(self.sh.shape[1])

    @property
    def nbytes(self) -> int:
        return sum(t.numel() * t.element_size() for t in self._tensors().values())

    def _tensors(self) -> dict[str, Tensor]:
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {name: value for name, value in values.items() if value is not None}

    def select(self, index: Tensor) -> Gaussians:
        """The Gaussians at the given indices or mask, in that order."""
        return Gaussians(**{name: tensor[index] for name, tensor in self._tensors().items()})

    @staticmethod
    def empty(sh_degree: int = 0) -> Gaussians:
        shapes = ((0, 3), (0, 4), (0, 3), (0,), (0, SH_COUNTS[sh_degree], 3))
        return Gaussians(*(torch.zeros(shape) for shape in shapes))


@dataclass(frozen=True, eq=False)
class Actor:
    """A rigid moving object: its Gaussians in its own frame (x forward, y left, z up, origin at the
    box centre), its track, and its box size (length, width, height in metres).

    color_waves: how its colours change over time; None where they do not. It has a row for each of
    the Gaussians. colors_in_world: its SH are for directions of the world, whichever way it is
    turned, as Street Gaussians and drivestudio train them, and not for those of its own frame.
    """

    track_id: str
    label: str
    gaussians: Gaussians
    track: Track
    size_m: tuple[float, float, float]
    color_waves: ColorWaves | None = None
    colors_in_world: bool = False

    def __post_init__(self) -> None:
        waves = self.color_waves
        if waves is not None and len(waves.coefficients) != len(self.gaussians):
            raise ValueError(
                f"actor {self.track_id!r}: colour waves must have a row for each of its "
                f"{len(self.gaussians)} Gaussians; got {len(waves.coefficients)}"
            )

    def gaussians_at(self, timestamp_ns: int) -> Gaussians:
        """Its Gaussians in the colours they have at a time, SH for directions in its own frame. The
        last moment's are kept, for other cameras that look at it.
        """
        pose = self.track.pose_at(timestamp_ns) if self.colors_in_world else None
        turn = None if pose is None or self.gaussians.sh_degree == 0 else pose[:3, :3].T
        if self.color_waves is None and turn is None:
            return self.gaussians
        own, waves = self.gaussians, self.color_waves

        def color() -> Gaussians:
            return replace(own, sh=colors_at(own.sh, waves, timestamp_ns, turn))

        read = [own.sh, *([] if waves is None else [waves.coefficients])]
        if any(tensor.requires_grad or tensor.is_inference() for tensor in read):
            return color()
        moment = timestamp_ns, *(tensor._version for tensor in read)
        return memo_of(self).get(("colours of a moment",), Latest).get(moment, color)


@dataclass(frozen=True, eq=False)
class SplatShading:
    """Light that falls on every pixel of a splat by its own normal (see augment.render.shading).

    A splat's colour at a pixel is that of its SH plus slopes [N, 3] times the wrapped share of the
    light, clamp((n . sun + wrap) / (1 + wrap), 0, 1). sun: unit, towards the light, in the part's
    frame.
    """

    slopes: Float[Tensor, "N 3"]
    sun: tuple[float, float, float]
    wrap: float


@dataclass(frozen=True, eq=False)
class PosedGaussians:
    """Gaussians placed in the world: what a rasteriser takes, so that nothing is concatenated.

    world_from_part: float64 [4, 4], or None for the identity. instance_id: 0 for the background,
    1 + the actor's index otherwise. is_overlay: whether they lie on
    the scene, as snow does: the buffer "overlay" counts them, and styles leave their colours.
    rows int64 [R, 2]: the runs (first, last + 1) that are drawn, None for all: of the backend cpu.
    shading: None for splats of one colour each. color_maps [C, 3, 4]: of what every splat shows,
    c' = max(M[:, :3] @ c + M[:, 3], 0): the map in the row of color_rows int16 [N], without them of
    its class, the first where there is none such; None leaves the colours. A part has either
    shading or maps.
    """

    gaussians: Gaussians
    world_from_part: Float[Tensor, "4 4"] | None = None
    instance_id: int = 0
    is_overlay: bool = False
    shading: SplatShading | None = None
    color_maps: Float[Tensor, "C 3 4"] | None = None
    color_rows: Int16[Tensor, "N"] | None = None
    rows: Int64[np.ndarray, "R 2"] | None = None

    @property
    def map_rows(self) -> Int16[Tensor, "N"] | None:
        """Of every splat among the colour maps; None where all take the first."""
        if self.color_maps is None or len(self.color_maps) == 1:
            return None
        return self.gaussians.semantic if self.color_rows is None else self.color_rows


GroundSource = Literal["map", "lidar labels", "road splats", "ransac", "ego path", "stated"]


@dataclass(frozen=True)
class Ground:
    """Where the road under the ego path is, scene world, and how that is known.

    lowest_z_m, median_z_m: over the stretches of the path. residual_m: median distance of the
    `points` used from the planes of their stretches, None without any. tilt_deg: angle between the
    road's normal and +z (a road that slopes, or a gravity that is off); None where unknown.
    """

    lowest_z_m: float
    median_z_m: float
    source: GroundSource
    residual_m: float | None = None
    points: int = 0
    tilt_deg: float | None = None

    def __post_init__(self) -> None:
        if not self.lowest_z_m <= self.median_z_m:  # also catches NaN
            raise ValueError(
                f"a ground's lowest height must not be above its median one; got lowest_z_m "
                f"{self.lowest_z_m}, median_z_m {self.median_z_m}"
            )


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that is known of a drive, in one world: metres, right-handed, +z up.

    world_origin_m: what was subtracted from the dataset's coordinates, float64 [3].
    ground_z_m: height of the road under the ego path (lowest), scene world; None where unknown.
    has_metric_scale: False where one unit is not known to be one metre.
    ground: the road's heights under the path and how they are known, where the adapter has measured
    them or was told; None where `augment.ground.ground_of` has to measure. Where it is set,
    ground_z_m is its lowest.
    has_known_gravity: False where +z is not known to point up.
    frames: in order of time, each with the scene's cameras. labels: boxes and LiDAR on demand.
    problems: what the adapter found wrong and went on without, one sentence each.
    source: the URI the scene was opened from; open_scene(source) opens it again.
    color_maps: how a camera's recorded colours differ from the scene's, by camera name: float32
    [3, 4], recorded = M[:, :3] @ rgb + M[:, 3], display-encoded. A camera without one records the
    scene's own colours. image_color_maps: the same for single images, by camera name and
    timestamp_ns; they go before color_maps.
    recorded_source: the URI of the recording that a fitted scene was made from, for its labels;
    None where `source` itself is the recording. made_by: how the Gaussians came about, facts for
    people and reports in JSON's own types.
    seen_frames: those that the scene was made from where `frames` are others (a camera path's,
    invented ones); empty where they are not known.
    """

    name: str
    source: str
    background: Gaussians
    actors: tuple[Actor, ...]
    sky: Sky
    frames: tuple[Frame, ...]
    labels: LabelSource | None = None
    world_origin_m: np.ndarray = field(default_factory=lambda: np.zeros(3))
    ground_z_m: float | None = None
    has_metric_scale: bool = True
    problems: tuple[str, ...] = ()
    color_maps: Mapping[str, Float[Tensor, "3 4"]] = field(default_factory=dict)
    recorded_source: str | None = None
    made_by: Mapping[str, Any] = field(default_factory=dict)
    ground: Ground | None = None
    has_known_gravity: bool = True
    image_color_maps: Mapping[tuple[str, int], Float[Tensor, "3 4"]] = field(default_factory=dict)
    seen_frames: tuple[Frame, ...] | None = None

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
        """Names of all cameras, in the order they first appear."""
        return tuple(dict.fromkeys(name for frame in self.frames for name in frame.cameras))

    @property
    def all_gaussians(self) -> tuple[Gaussians, ...]:
        """The background's, then each actor's in its own frame."""
        return (self.background, *(actor.gaussians for actor in self.actors))

    @property
    def gaussian_bytes(self) -> int:
        """Of all Gaussians, their colours over time among them."""
        waves = (actor.color_waves for actor in self.actors)
        own = sum(gaussians.nbytes for gaussians in self.all_gaussians)
        return own + sum(wave.nbytes for wave in waves if wave is not None)

    def with_gaussians(self, change: Callable[[Gaussians], Gaussians]) -> Scene:
        """The scene with every part's Gaussians changed."""
        return replace(
            self,
            background=change(self.background),
            actors=tuple(replace(a, gaussians=change(a.gaussians)) for a in self.actors),
        )

    def frame(self, index: int) -> Frame:
        """The frame with the dataset's number `index`."""
        for frame in self.frames:
            if frame.index == index:
                return frame
        known = [f.index for f in self.frames]
        raise SceneError(
            f"scene {self.name!r} has no frame {index}; it has "
            + (f"{known[0]} to {known[-1]} ({len(known)} frames)" if known else "none")
        )

    def parts_at(
        self, timestamp_ns: int, only: Collection[int] | None = None
    ) -> Iterator[PosedGaussians]:
        """Background and every actor that exists at this time, posed. only: instance_ids of the
        actors to take; None for all.
        """
        yield PosedGaussians(self.background)
        for number, actor in enumerate(self.actors, start=1):
            if only is not None and number not in only:
                continue
            pose = actor.track.pose_at(timestamp_ns)
            if pose is not None:
                posed = actor.gaussians_at(timestamp_ns)
                yield PosedGaussians(posed, pose, instance_id=number)

    def poses_at(self, timestamp_ns: int) -> dict[int, np.ndarray]:
        """world_from_actor, float64 [4, 4], of the actors that exist at a time, by instance id."""
        if not self.actors:
            return {}
        tracks = memo_of(self).get(
            ("tracks",), lambda: PackedTracks.of([actor.track for actor in self.actors])
        )
        found = np.empty(len(self.actors), np.uint8)
        poses = np.empty((len(found), 4, 4))
        kernels.poses_at(timestamp_ns, _STRAIGHT_RAD, tracks, found, poses)
        return {int(n) + 1: poses[n] for n in np.flatnonzero(found)}

    def parts_for(
        self, camera: Camera, only: Collection[int] | None = None
    ) -> tuple[PosedGaussians, ...]:
        """The parts at the moment the camera took its image. only: as for parts_at."""
        return tuple(self.parts_at(camera.timestamp_ns, only))

    def color_map(self, camera: Camera) -> Float[Tensor, "3 4"] | None:
        """The image's colour map, or else the camera's; None where there is none, or one that
        changes nothing.
        """
        color_map = self.image_color_maps.get((camera.name, camera.timestamp_ns))
        if color_map is None:
            color_map = self.color_maps.get(camera.name)
        if color_map is None or torch.equal(color_map, torch.eye(3, 4)):
            return None
        return color_map

    @property
    def mapped_cameras(self) -> tuple[str, ...]:
        """Names of the cameras that have a colour map, or whose images have, in their order."""
        maps = [*self.color_maps.items(), *((n, m) for (n, _), m in self.image_color_maps.items())]
        identity = torch.eye(3, 4)
        changing = {name for name, color_map in maps if not torch.equal(color_map, identity)}
        return tuple(name for name in self.camera_names if name in changing)

    @cached_property
    def common_color_map(self) -> Float[Tensor, "3 4"] | None:
        """Mean of all colour maps, float64; None where none changes anything."""
        maps = [*self.color_maps.values(), *self.image_color_maps.values()]
        return torch.stack(maps).double().mean(0) if self.mapped_cameras else None

    def boxes(self, frame_index: int) -> Boxes:
        return Boxes.empty() if self.labels is None else self.labels.boxes(frame_index)

    def lidar(self, frame_index: int) -> LidarSweep | None:
        return None if self.labels is None else self.labels.lidar(frame_index)


def _check_color_map(scene: str, camera: str, color_map: Tensor) -> None:
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
    """Gaussians without those no rasteriser can draw, and a sentence for each kind left out.

    Left out: NaN or infinite values, zero quaternions, scales <= 0, coordinates and scales beyond
    MAX_EXTENT_M. Quaternions are normalised.

    Raises:
        SceneError: nothing usable remains.
    """
    finite = _finite_rows(gaussians)
    norms = quat_lengths(gaussians.quats)
    largest = torch.maximum(gaussians.means.abs().amax(1), gaussians.scales.amax(1))
    is_far = finite & (norms > 0) & (gaussians.scales.amin(1) > 0) & (largest > MAX_EXTENT_M)
    first = f"; the first is number {int(is_far.int().argmax())}" if bool(is_far.any()) else ""
    # In order: each count names what the earlier checks did not already leave out.
    bad = {
        "with NaN or infinite values": ~finite,
        "with a zero quaternion": finite & (norms == 0),
        "with a scale <= 0": finite & (norms > 0) & (gaussians.scales.amin(1) <= 0),
        f"with coordinates or scales beyond {MAX_EXTENT_M:.0e} m{first}": is_far,
    }
    problems = tuple(
        f"{where}: left out {int(mask.sum())} of {len(gaussians)} Gaussians {what}"
        for what, mask in bad.items()
        if bool(mask.any())
    )
    if problems:
        keep = ~torch.stack(list(bad.values())).any(0)
        gaussians, norms = gaussians.select(keep), norms[keep]
    if len(gaussians) == 0:
        raise SceneError(f"{where} holds no usable Gaussians. " + " ".join(problems))
    quats = (gaussians.quats / norms[:, None]).to(gaussians.quats.dtype)
    return replace(gaussians, quats=quats, opacities=gaussians.opacities.clamp(0, 1)), problems


def _finite_rows(gaussians: Gaussians) -> Bool[Tensor, "N"]:
    finite = torch.isfinite(gaussians.opacities)
    for tensor in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.sh):
        finite &= torch.isfinite(tensor.reshape(len(gaussians), -1).sum(1))
    return finite


def quat_lengths(quats: Float[Tensor, "N 4"]) -> Float[Tensor, "N"]:
    """Lengths of quaternions, in float64 where the squares of some leave float32's range: 1e-30 is
    no zero, and 1e20 has an end.
    """
    lengths = quats.norm(dim=1)
    if bool(((lengths > 1e-15) & (lengths < 1e15)).all()):
        return lengths
    return quats.double().norm(dim=1)


# ---- Whether `check_gaussians` has anything to do, and of which rows: without its copies ---------

_QUAT_TOLERANCE = 1e-4  # of unit length; what is further off is to be normalised
_ROWS = 1 << 16  # looked at together: temporaries stay in the cache


def is_drawable(gaussians: Gaussians) -> bool:
    """Whether `check_gaussians` would leave them as they are, told in one look at each number."""
    return all(
        _piece_is_drawable(gaussians, slice(start, start + _ROWS))
        for start in range(0, len(gaussians), _ROWS)
    )


def drawable_rows(gaussians: Gaussians) -> Bool[Tensor, "N"]:
    """The Gaussians that `check_gaussians` keeps."""
    keep = _finite_rows(gaussians)
    for tensor in (gaussians.means, gaussians.scales):
        keep &= tensor.abs().amax(1) <= MAX_EXTENT_M
    return keep & (quat_lengths(gaussians.quats) > 0) & (gaussians.scales.amin(1) > 0)


def _piece_is_drawable(gaussians: Gaussians, rows: slice) -> bool:
    means, quats, sh = gaussians.means[rows], gaussians.quats[rows], gaussians.sh[rows]
    scales, opacities = gaussians.scales[rows], gaussians.opacities[rows]
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
    """Lowest and highest value; NaN where there is one. By NumPy, which wakes no threads."""
    array = values.numpy() if isinstance(values, Tensor) else values
    with np.errstate(invalid="ignore"):
        return float(array.min()), float(array.max())
