"""A driving scene: Gaussians, moving actors, sky, cameras over time, labels."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int16
from torch import Tensor

from augment.cameras import Camera, Frame
from augment.color_waves import ColorWaves, colors_at
from augment.errors import SceneError
from augment.ground_heights import Ground
from augment.labels import Boxes, LabelSource, LidarSweep
from augment.semantics import SemanticClass
from augment.sky import Sky
from augment.track import Track

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
        expected = {
            "means": (count, 3),
            "quats": (count, 4),
            "scales": (count, 3),
            "opacities": (count,),
        }
        for name, shape in expected.items():
            value = getattr(self, name)
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
        tensors = [self.means, self.quats, self.scales, self.opacities, self.sh]
        if self.semantic is not None:
            tensors.append(self.semantic)
        return sum(t.numel() * t.element_size() for t in tensors)

    def select(self, index: Tensor) -> Gaussians:
        """The Gaussians at the given indices or mask, in that order."""
        return Gaussians(
            means=self.means[index],
            quats=self.quats[index],
            scales=self.scales[index],
            opacities=self.opacities[index],
            sh=self.sh[index],
            semantic=None if self.semantic is None else self.semantic[index],
        )

    @staticmethod
    def empty(sh_degree: int = 0) -> Gaussians:
        k = SH_COUNTS[sh_degree]
        return Gaussians(
            means=torch.zeros(0, 3),
            quats=torch.zeros(0, 4),
            scales=torch.zeros(0, 3),
            opacities=torch.zeros(0),
            sh=torch.zeros(0, k, 3),
        )


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
        """Its Gaussians in the colours they have at a time, SH for directions in its own frame."""
        pose = self.track.pose_at(timestamp_ns) if self.colors_in_world else None
        turn = None if pose is None or self.gaussians.sh_degree == 0 else pose[:3, :3].T
        if self.color_waves is None and turn is None:
            return self.gaussians
        sh = colors_at(self.gaussians.sh, self.color_waves, timestamp_ns, turn)
        return replace(self.gaussians, sh=sh)


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
    1 + the actor's index otherwise. is_snow: whether they are snow, which the buffer "snow" counts.
    shading: None for splats of one colour each. color_maps [C, 3, 4]: of what every splat shows,
    c' = max(M[:, :3] @ c + M[:, 3], 0): the map in the row of color_rows int16 [N], without them of
    its class, the first where there is none such; None leaves the colours. A part has either
    shading or maps.
    """

    gaussians: Gaussians
    world_from_part: Float[Tensor, "4 4"] | None = None
    instance_id: int = 0
    is_snow: bool = False
    shading: SplatShading | None = None
    color_maps: Float[Tensor, "C 3 4"] | None = None
    color_rows: Int16[Tensor, "N"] | None = None

    @property
    def map_rows(self) -> Int16[Tensor, "N"] | None:
        """Of every splat among the colour maps; None where all take the first."""
        if self.color_maps is None or len(self.color_maps) == 1:
            return None
        return self.gaussians.semantic if self.color_rows is None else self.color_rows


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
    finite = torch.ones(len(gaussians), dtype=torch.bool)
    for tensor in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.sh):
        finite &= torch.isfinite(tensor.reshape(len(gaussians), -1).sum(1))
    finite &= torch.isfinite(gaussians.opacities)
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
    unit = Gaussians(
        means=gaussians.means,
        quats=(gaussians.quats / norms[:, None]).to(gaussians.quats.dtype),
        scales=gaussians.scales,
        opacities=gaussians.opacities.clamp(0, 1),
        sh=gaussians.sh,
        semantic=gaussians.semantic,
    )
    return unit, problems


def quat_lengths(quats: Float[Tensor, "N 4"]) -> Float[Tensor, "N"]:
    """Lengths of quaternions, in float64 where the squares of some leave float32's range: 1e-30 is
    no zero, and 1e20 has an end.
    """
    lengths = quats.norm(dim=1)
    if bool(((lengths > 1e-15) & (lengths < 1e15)).all()):
        return lengths
    return quats.double().norm(dim=1)


__all__ = [
    "Actor",
    "Gaussians",
    "PosedGaussians",
    "Scene",
    "SemanticClass",
    "Track",
    "check_gaussians",
    "quat_lengths",
]
