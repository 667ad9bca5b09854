"""The optimisation itself: one recorded view a step, all splats of the scene.

    load → forward (record) → loss → backward → Adam on what the view touched → now and then densify

Everything a step needs stays in arrays that the kernels read directly. A run is a function of
(scene, views, config): bits do not depend on threads, and a state saved between two steps continues
to the same bits.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.cameras import Camera, Frame
from augment.labels import EGO_VEHICLE
from augment.reconstruct.config import FitConfig, LossWeights, Tuning
from augment.reconstruct.kernels import MOMENTS, GradientRows, sum_forces, update_splats
from augment.reconstruct.loss import (
    IDENTITY_MAP,
    LossScratch,
    ViewLoss,
    paint_below_horizon,
    starting_sky,
    view_loss,
)
from augment.reconstruct.splats import (
    CORRECTIONS,
    FILTER_PX,
    ColorAdam,
    DenseAdam,
    Sightings,
    Splats,
    bound_sizes,
    decayed,
    densify,
    densify_due,
    rebuild,
    splat_rates,
)
from augment.reconstruct.view import ViewKey, ViewSource
from augment.render import layout
from augment.render.constants import RasterSettings
from augment.render.cpu import backward_kernels
from augment.render.cpu.backward import SplatGradients, Tape, record
from augment.render.cpu.driver import Inputs, Scratch
from augment.render.cuda import runtime
from augment.render.gsplat_backend import GsplatImages, draw_with_gsplat, import_gsplat
from augment.render.layout import BLOCK, M_FUNCTIONS
from augment.render.part_views import part_poses, part_views, raster_modes
from augment.render.threads import kernel_threads
from augment.rng import rng_for
from augment.scene import Actor, Gaussians, PosedGaussians, Scene, Track
from augment.sky import CubemapSky

# ---- Small corrections of where actors and cameras are, learnt with the scene -------------------
# Labelled boxes are centimetres off, and recorded poses some tenths of a pixel. Corrections are
# given at knots and linear in time between them, so that what is not learnt from, held-out frames
# above all, shares what its neighbours found.

# Forces are some 1e-4 a metre: what is smaller than this is rounding, and must not be a direction.
_EPS = 1e-10


class Knots:
    """D numbers at the knots of several things, float64, all zero to begin with.

    Before the first and after the last knot the nearest one holds. A thing without knots is never
    corrected.
    """

    def __init__(self, times_ns: Sequence[np.ndarray], width: int) -> None:
        """times_ns: int64 [K] a thing, increasing."""
        self._times = list(times_ns)
        self._firsts = np.cumsum([0, *(len(times) for times in times_ns)])
        shape = (int(self._firsts[-1]), width)
        self.values = np.zeros(shape)
        self._adam = DenseAdam(self.values, _EPS)

    def at(self, number: int, timestamp_ns: int) -> np.ndarray | None:
        """The thing's correction, float64 [D], at a time; None where it has no knots."""
        place = self._place(number, timestamp_ns)
        return None if place is None else place[1] @ self.values[place[0]]

    def update(
        self, number: int, timestamp_ns: int, gradient: np.ndarray, rates: np.ndarray, pull: float
    ) -> None:
        """A step of Adam for the knots around a time. gradient, rates: [D]. pull: towards 0."""
        place = self._place(number, timestamp_ns)
        if place is None:
            return
        for row, weight in zip(*place, strict=True):
            if weight > 0:
                self._adam.update(weight * gradient + pull * self.values[row], rates, row)

    def arrays(self) -> dict[str, np.ndarray]:
        return {"values": self.values, **self._adam.arrays()}

    def _place(self, number: int, timestamp_ns: int) -> tuple[list[int], np.ndarray] | None:
        """Rows of `values` around a time, and their weights."""
        times = self._times[number]
        if len(times) == 0:
            return None
        first = int(self._firsts[number])
        after = int(np.searchsorted(times, timestamp_ns, side="right"))
        if after == 0 or after == len(times):
            return [first + min(after, len(times) - 1)], np.ones(1)
        span = int(times[after]) - int(times[after - 1])
        part = (timestamp_ns - int(times[after - 1])) / span
        return [first + after - 1, first + after], np.array([1 - part, part])


@dataclass(frozen=True, eq=False)
class Forces:
    """Of P parts, in each part's own axes, float64. seen: bool [P], whether the view shows it.

    shift [P, 3]: dL by a shift of the part. turn [P, 3]: dL by a turn about its origin (rad), of
    means and ellipsoids; that view-dependent colours turn along is left out.
    """

    seen: np.ndarray
    shift: np.ndarray
    turn: np.ndarray

    def on_camera(self, camera_from_parts: np.ndarray) -> np.ndarray:
        """dL [6] by a turn, then a shift, of everything as the camera sees it, in camera axes.

        camera_from_parts: float64 [P, 4, 4].
        """
        rotations, offsets = camera_from_parts[:, :3, :3], camera_from_parts[:, :3, 3]
        shift = (rotations @ self.shift[..., None])[..., 0]
        turn = (rotations @ self.turn[..., None])[..., 0] + np.cross(offsets, shift)
        return np.concatenate([turn.sum(0), shift.sum(0)])


def part_forces(inputs: Inputs, grads: SplatGradients) -> Forces:
    """The forces of one view's gradients, the same for any number of threads."""
    moments = np.empty((len(inputs.blocks), MOMENTS))
    with kernel_threads():
        sum_forces(
            inputs.addresses,
            inputs.sizes,
            inputs.blocks,
            grads.rows.reshape(-1),
            grads.ids,
            grads.counts,
            moments,
        )
    parts = len(inputs.sizes)
    # Blocks of a part stand together; an empty part has none.
    totals = np.zeros((parts, MOMENTS))
    np.add.at(totals, inputs.blocks[:, 0], moments)
    seen = np.bincount(inputs.blocks[:, 0], grads.counts, minlength=parts) > 0
    return Forces(seen, totals[:, :3], totals[:, 3:])


KNOT_EVERY = 4  # track samples between an actor's knots
_REACH_M = 2.0  # a turn moves an actor's points about this far from its origin as a shift does
_DEPTH_M = 10.0  # and a camera's turn what it sees this far away


class ActorPoses:
    """A shift in the world (3, metres) and a turn about the vertical (its arc at 2 m)."""

    def __init__(self, actors: Sequence[Actor]) -> None:
        self.knots = Knots([_actor_knots(actor) for actor in actors], 4)

    def corrected(self, number: int, pose: np.ndarray, timestamp_ns: int) -> np.ndarray:
        """world_from_actor, float64 [4, 4], of the actor with this index, moved and turned."""
        shift = self.knots.at(number, timestamp_ns)
        if shift is None:
            return pose
        out = pose.copy()
        out[:3, :3] = _turn([0.0, 0.0, shift[3] / _REACH_M]) @ pose[:3, :3]
        out[:3, 3] += shift[:3]
        return out

    def update(
        self,
        parts: Sequence[int],
        poses: np.ndarray,
        forces: Forces,
        timestamp_ns: int,
        *,
        rate_m: float,
        pull: float,
    ) -> None:
        """One step for every actor that a view shows. parts, poses: those of its inputs."""
        rates = np.full(4, rate_m)
        for place in np.flatnonzero(forces.seen).tolist():
            if parts[place] == 0:
                continue
            rotation = poses[place, :3, :3]
            turn = (rotation @ forces.turn[place])[2] / _REACH_M
            gradient = np.append(rotation @ forces.shift[place], turn)
            self.knots.update(parts[place] - 1, timestamp_ns, gradient, rates, pull)

    def track(self, number: int, track: Track) -> Track:
        """The actor's track with its corrections."""
        times = track.timestamps_ns.tolist()
        poses = [
            self.corrected(number, pose.numpy(), time)
            for pose, time in zip(track.world_from_actor, times, strict=True)
        ]
        return dataclasses.replace(track, world_from_actor=torch.from_numpy(np.stack(poses)))


class CameraPoses:
    """A turn (3, arcs at 10 m) and a shift (3, metres) in camera axes of what a camera sees."""

    def __init__(self, source: ViewSource) -> None:
        times: dict[str, list[int]] = {}
        for key in source.train:
            times.setdefault(key.camera, []).append(source.camera(key).timestamp_ns)
        self._names: Mapping[str, int] = {name: i for i, name in enumerate(times)}
        self.knots = Knots([np.unique(np.array(t, np.int64)) for t in times.values()], 6)

    def corrected(self, camera: Camera) -> Camera:
        """The camera where it was found to be; itself where nothing is known of it."""
        number = self._names.get(camera.name)
        change = None if number is None else self.knots.at(number, camera.timestamp_ns)
        if change is None or not change.any():
            return camera
        moved = np.eye(4)
        moved[:3, :3], moved[:3, 3] = _turn(change[:3] / _DEPTH_M), change[3:]
        pose = torch.from_numpy(moved @ camera.camera_from_world.numpy())
        return dataclasses.replace(camera, camera_from_world=pose)

    def update(
        self, camera: Camera, poses: np.ndarray, forces: Forces, *, rate_px: float, pull: float
    ) -> None:
        """One step for a view's camera, as corrected. poses: world_from_part of its inputs."""
        number = self._names.get(camera.name)
        if number is None:
            return
        gradient = forces.on_camera(camera.camera_from_world.numpy() @ poses)
        gradient[:3] /= _DEPTH_M
        rates = np.full(6, rate_px * _DEPTH_M / camera.fx)
        self.knots.update(number, camera.timestamp_ns, gradient, rates, pull)


def _actor_knots(actor: Actor) -> np.ndarray:
    """int64 [K] times; none for the recording car's own body, whose track is exact."""
    times = actor.track.timestamps_ns.numpy()
    if actor.label == EGO_VEHICLE:
        return times[:0]
    knots = times[::KNOT_EVERY]
    return knots if knots[-1] == times[-1] else np.append(knots, times[-1])


def _turn(vector_rad: Sequence[float] | np.ndarray) -> np.ndarray:
    """Rotation matrix of a rotation vector (Rodrigues)."""
    x, y, z = (float(v) for v in vector_rad)
    angle = (x * x + y * y + z * z) ** 0.5
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-12:
        return np.eye(3) + cross
    return (
        np.eye(3) + np.sin(angle) / angle * cross + (1 - np.cos(angle)) / angle**2 * (cross @ cross)
    )


# ---- The splats of a view as the CPU kernels take them: addresses into the arrays being fitted ---

_FIELDS = ("means", "quats", "scales", "opacities", "sh")


def splat_inputs(
    splats: Splats,
    parts: Sequence[int],
    poses: np.ndarray,
    camera: Camera,
    settings: RasterSettings,
) -> Inputs:
    """Inputs of the parts that exist now. parts: their numbers. poses: world_from_part, float64
    [P, 4, 4]. Nothing is copied: kernels read, and Adam writes, the arrays of `splats`, which must
    outlive the inputs.

    first_ids are positions in the arrays of `splats`.
    """
    starts = splats.starts[list(parts)]
    counts = splats.starts[np.asarray(parts) + 1] - starts
    functions = splats.sh.shape[1]
    strides = [getattr(splats, name)[:1].nbytes for name in _FIELDS]
    bases = [getattr(splats, name).ctypes.data for name in _FIELDS]
    addresses = np.array(bases, np.uint64) + starts[:, None].astype(np.uint64) * np.array(
        strides, np.uint64
    )
    # no part has slopes of light, or colour maps
    absent = np.zeros((len(starts), layout.ADDRESSES - len(_FIELDS)), np.uint64)
    return Inputs(
        addresses=np.concatenate([addresses, absent], 1),
        sizes=np.stack([counts, np.full_like(counts, functions)], 1),
        first_ids=starts.copy(),
        views=part_views(poses, camera, settings, None),
        blocks=_blocks(counts),
        modes=raster_modes(settings, None, with_color=True),
        kept_alive=[getattr(splats, name) for name in _FIELDS],
    )


def _blocks(counts: np.ndarray) -> np.ndarray:
    """int64 [B, 3]: part, first and last + 1 of every block."""
    per_part = -(-counts // layout.BLOCK)
    part = np.repeat(np.arange(len(counts)), per_part)
    first_block = np.repeat(np.cumsum(per_part) - per_part, per_part)
    first = (np.arange(len(part)) - first_block) * layout.BLOCK
    last = np.minimum(first + layout.BLOCK, counts[part])
    return np.stack([part, first, last], 1).astype(np.int64)


# ---- What renders the views: the CPU's kernels, or gsplat on a GPU; all else is the same

DEVICES = ("cpu", "cuda")
SETTINGS = RasterSettings()


class CpuRenderer:
    """Renders the splats that are fitted by the kernels of augment.render.cpu.backward; the same
    bits for any number of threads.

    A tape holds until the next render. Splats may be changed in place between two renders, but only
    those whose gradients the last tape told.
    """

    def __init__(self) -> None:
        self._scratch = Scratch()

    def record(
        self, splats: Splats, inputs: Inputs, poses: np.ndarray, camera: Camera, *, with_depth: bool
    ) -> Tape:
        """inputs: of these splats; poses: world_from_part of their parts, float64 [P, 4, 4]."""
        return record(inputs, camera, SETTINGS, self._scratch, with_depth=with_depth)


# The GPU holds a copy of all splats; what a step changed on the CPU, it is sent: the rows of the
# splats that the view showed. Back come the image and those splats' gradients. gsplat adds shares
# up in no fixed order, so a fit's bits do not repeat.

_MIN_DET = 1e-30  # of a conic, px^-4


class GsplatRenderer:
    """As `CpuRenderer`, by gsplat.

    Raises:
        BackendUnavailable: there is no GPU, or no gsplat.
    """

    def __init__(self) -> None:
        runtime.check_can_run()
        import_gsplat()
        self._splats: Splats | None = None
        self._copies: dict[str, Tensor] = {}
        self._changed = np.zeros(0, np.int64)  # rows of the last tape's gradients
        self._scratch = Scratch()

    def record(
        self, splats: Splats, inputs: Inputs, poses: np.ndarray, camera: Camera, *, with_depth: bool
    ) -> GsplatTape:
        self._refresh(splats)
        # SH need no gradients of their own: they follow from the colours'.
        leaves = {name: copy.detach() for name, copy in self._copies.items()}
        for name in _FIELDS[:4]:
            leaves[name].requires_grad_()
        parts = []
        for first, (count, _), pose in zip(inputs.first_ids, inputs.sizes, poses, strict=True):
            own = {name: leaf[int(first) : int(first + count)] for name, leaf in leaves.items()}
            is_world = np.array_equal(pose, np.eye(4))
            placed = None if is_world else torch.from_numpy(np.ascontiguousarray(pose))
            parts.append(PosedGaussians(Gaussians(**own), placed))
        images = draw_with_gsplat(
            parts,
            camera,
            SETTINGS,
            with_depth=with_depth,
            functions=int(inputs.modes[M_FUNCTIONS]),
            keep_color_slopes=True,
        )
        depth = None if images.expected_depth is None else _array(images.expected_depth)
        return GsplatTape(
            inputs, _array(images.rgb), _array(images.alpha), depth, images, leaves, self
        )

    def _refresh(self, splats: Splats) -> None:
        """The copy on the GPU as the splats are now."""
        if splats is not self._splats:
            self._copies = {
                name: runtime.upload(torch.from_numpy(getattr(splats, name))) for name in _FIELDS
            }
            if runtime.gpu_device().type == "cpu":  # interpreted: a copy of its own all the same
                self._copies = {name: copy.clone() for name, copy in self._copies.items()}
        elif len(rows := self._changed):
            flat = [getattr(splats, name)[rows].reshape(len(rows), -1) for name in _FIELDS]
            sent = runtime.upload(np.concatenate(flat, 1))
            index = runtime.upload(rows)
            widths = [part.shape[1] for part in flat]
            for name, part in zip(_FIELDS, sent.split(widths, 1), strict=True):
                copy = self._copies[name]
                copy.index_copy_(0, index, part.reshape(-1, *copy.shape[1:]))
        self._splats, self._changed = splats, np.zeros(0, np.int64)

    def rows_of(self, inputs: Inputs, seen: np.ndarray, rows: np.ndarray) -> SplatGradients:
        """Gradients block by block. seen: int64 [T], increasing positions in all parts one after
        another; rows: float32 [T, GRAD].
        """
        counts = inputs.sizes[:, 0]
        ends = np.cumsum(counts)
        part = np.searchsorted(ends, seen, side="right")
        ids = seen - (ends - counts)[part]
        self._changed = inputs.first_ids[part] + ids
        blocks = -(-counts // BLOCK)
        block = (np.cumsum(blocks) - blocks)[part] + ids // BLOCK
        total = len(inputs.blocks)
        found = np.bincount(block, minlength=total)
        at = block * BLOCK + np.arange(len(seen)) - (np.cumsum(found) - found)[block]
        all_rows = self._scratch.array("rows", (total * BLOCK, backward_kernels.GRAD), np.float32)
        all_ids = self._scratch.array("ids", (total * BLOCK,), np.int32)
        all_rows[at], all_ids[at] = rows, ids
        return SplatGradients(all_rows, all_ids, found.astype(np.int64), inputs.blocks)


@dataclass(frozen=True, eq=False)
class GsplatTape:
    """As cpu.backward.Tape. leaves: what gsplat was given, by name."""

    inputs: Inputs
    rgb: np.ndarray
    alpha: np.ndarray
    expected_depth: np.ndarray | None
    images: GsplatImages
    leaves: dict[str, Tensor]
    renderer: GsplatRenderer

    def backward(
        self, d_rgb: np.ndarray, d_alpha: np.ndarray, d_expected_depth: np.ndarray | None = None
    ) -> SplatGradients:
        """Of the splats that a pixel shows; each once, in order."""
        images = [self.images.rgb, self.images.alpha]
        slopes = [runtime.upload(d_rgb), runtime.upload(d_alpha)]
        if self.images.expected_depth is not None and d_expected_depth is not None:
            images.append(self.images.expected_depth)
            slopes.append(runtime.upload(d_expected_depth))
        ids = self.images.ids
        if len(ids) == 0:
            none = np.zeros(0, np.int64)
            return self.renderer.rows_of(self.inputs, none, np.zeros((0, 16), np.float32))
        torch.autograd.backward(images, slopes)
        with torch.no_grad():
            ids, order = torch.sort(ids.long())
            rows = self._rows(ids, order)
            shown = torch.nonzero((rows[:, : backward_kernels.G_RADIUS] != 0).any(1))[:, 0]  # waits
            return self.renderer.rows_of(self.inputs, _array(ids[shown]), _array(rows[shown]))

    def _rows(self, ids: Tensor, order: Tensor) -> Tensor:
        """Rows as augment.render.cpu.backward_kernels lists them, [M, GRAD], of splats drawn."""
        counts = self.inputs.sizes[:, 0]
        ends = np.cumsum(counts)
        shifts = runtime.upload(self.inputs.first_ids - (ends - counts))
        part = torch.searchsorted(runtime.upload(ends), ids, right=True)
        own = ids + shifts[part]  # in the arrays of all splats
        slopes = {name: _slope(leaf)[own] for name, leaf in self.leaves.items() if name != "sh"}
        values = {name: self.leaves[name].detach()[own] for name in slopes}
        quats = values["quats"]
        radial = (slopes["quats"] * quats).sum(1, keepdim=True)
        absolute = self.images.means2d.absgrad[order]
        a, b, c = self.images.conics.detach()[order].unbind(1)
        widest = torch.maximum(a, c) / (a * c - b * b).clamp_min(_MIN_DET)
        rows = {
            backward_kernels.G_MEAN: slopes["means"],
            backward_kernels.G_QUAT: slopes["quats"] - radial * quats,
            backward_kernels.G_ABS: absolute.norm(dim=1, keepdim=True),
            backward_kernels.G_SCALE: slopes["scales"] * values["scales"],
            backward_kernels.G_OPACITY: (slopes["opacities"] * values["opacities"])[:, None],
            backward_kernels.G_COLOR: _slope(self.images.colors)[ids],
            backward_kernels.G_RADIUS: torch.sqrt(widest)[:, None],
        }
        return torch.cat([rows[column] for column in sorted(rows)], 1)


def _slope(tensor: Tensor) -> Tensor:
    return torch.zeros_like(tensor) if tensor.grad is None else tensor.grad


def _array(tensor: Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().cpu().numpy())


def fit_renderer(device: str) -> CpuRenderer | GsplatRenderer:
    """device: one of DEVICES.

    Raises:
        BackendUnavailable: there is no such device, or gsplat is not installed.
        ValueError: another name.
    """
    if device not in DEVICES:
        raise ValueError(f"device must be one of {', '.join(DEVICES)}; got {device!r}")
    return CpuRenderer() if device == "cpu" else GsplatRenderer()


# ---- The optimisation ----------------------------------------------------------------------------


@dataclass(frozen=True)
class StepRecord:
    """What one step did. stage_s: seconds of load, forward, loss, backward, optimise, densify."""

    step: int
    key: ViewKey
    loss: float
    l1: float
    ssim: float
    depth: float
    sky: float
    splats: int
    stage_s: dict[str, float]


class Trainer:
    """A scene while it is fitted to its recorded views."""

    def __init__(
        self,
        scene: Scene,
        source: ViewSource,
        config: FitConfig,
        steps: int,
        *,
        tuning: Tuning = Tuning(),  # noqa: B008 - frozen, so sharing it is safe
        device: str = "cpu",
    ) -> None:
        """scene: what is started from; it is not changed. source: at least one training view.
        steps: of the whole run, one view each. device: where views are rendered; bits are those of
        "cpu".
        """
        if not source.train:
            raise ValueError("the view source has no training views; nothing can be learnt")
        self.step = 0
        self._config, self._steps, self._tuning = config, steps, tuning
        self._weights = LossWeights(depth=config.depth_weight)
        parts = scene.all_gaussians
        self.splats = Splats.of(parts, config.sh_degree)
        self.sky_faces = starting_sky(scene.sky)
        self._is_sky = paint_below_horizon(self.sky_faces)
        self._sky_adam = ColorAdam(self.sky_faces.reshape(-1, 3))
        names = sorted({key.camera for key in (*source.train, *source.test)})
        self.color_maps = {name: IDENTITY_MAP.copy() for name in names}
        self._map_adams = {name: DenseAdam(m) for name, m in self.color_maps.items()}
        self._scene = scene
        self._source = source
        self._renderer = fit_renderer(device)
        self._loss_scratch = LossScratch()
        self.actor_poses = ActorPoses(scene.actors)
        self.camera_poses = CameraPoses(source)
        self._extent_m = _extent(source)
        self._skies = {key: np.packbits(source.load(key).sky) for key in source.train}
        kept = ~self._look(with_actors=True)
        self.splats = rebuild(self.splats, np.flatnonzero(kept | ~kept.any()))
        bound_sizes(self.splats)
        self._order: tuple[int, np.ndarray] = (-1, np.zeros(0, np.int64))

    def run_step(self) -> StepRecord:
        """One update of everything that one view shows."""
        stages: dict[str, float] = {}
        key = self._next_key()
        with _timed(stages, "load"):
            view = self._source.load(key)
            view = dataclasses.replace(view, camera=self.camera_poses.corrected(view.camera))
        with _timed(stages, "forward"):
            parts = self._posed(view.camera)
            tape = self._render(parts, view.camera)
        with _timed(stages, "loss"):
            loss = view_loss(
                tape.rgb,
                tape.alpha,
                tape.expected_depth,
                view,
                self.sky_faces,
                self.color_maps[key.camera],
                self._weights,
                scratch=self._loss_scratch,
            )
        with _timed(stages, "backward"):
            with_depth = tape.expected_depth is not None
            grads = tape.backward(
                loss.d_rgb, loss.d_alpha, loss.d_expected_depth if with_depth else None
            )
        with _timed(stages, "optimise"):
            self._update(parts, tape.inputs, grads, view.camera, loss)
        self.step += 1
        with _timed(stages, "densify"):
            self._densify()
        return StepRecord(
            step=self.step, key=key, loss=loss.total, l1=loss.l1, ssim=loss.ssim, depth=loss.depth,
            sky=loss.sky, splats=len(self.splats), stage_s=stages,
        )  # fmt: skip

    def scene(self) -> Scene:
        """The scene as fitted so far; it shares nothing with the trainer."""
        actors = tuple(
            dataclasses.replace(
                actor,
                gaussians=self.splats.gaussians(number),
                track=self.actor_poses.track(number - 1, actor.track),
                color_waves=None,  # learnt colours are those of all times, in the actor's frame
                colors_in_world=False,
            )
            for number, actor in enumerate(self._scene.actors, start=1)
        )
        maps = {name: torch.from_numpy(m.copy()) for name, m in self.color_maps.items()}
        return dataclasses.replace(
            self._scene,
            background=self.splats.gaussians(0),
            actors=actors,
            frames=tuple(self._frame(frame) for frame in self._scene.frames),
            sky=CubemapSky(torch.from_numpy(self.sky_faces.copy())),
            color_maps=maps,
            image_color_maps={},
        )

    def _frame(self, frame: Frame) -> Frame:
        cameras = {n: self.camera_poses.corrected(c) for n, c in frame.cameras.items()}
        return dataclasses.replace(frame, cameras=cameras)

    def _learnt_arrays(self) -> dict[str, np.ndarray]:
        """All that is learnt in place besides the splats, by the names of a state."""
        parts = {"sky_adam": self._sky_adam}
        parts |= {f"color_map_adam.{name}": adam for name, adam in self._map_adams.items()}
        parts |= {"actors": self.actor_poses.knots, "cameras": self.camera_poses.knots}
        own = {f"{part}.{k}": a for part, adam in parts.items() for k, a in adam.arrays().items()}
        maps = {f"color_map.{name}": color_map for name, color_map in self.color_maps.items()}
        return {"sky": self.sky_faces, **maps, **own}

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """All that continuing to the same bits needs: arrays, and facts for JSON."""
        arrays = {f"splats.{name}": array for name, array in self.splats.arrays().items()}
        arrays |= self._learnt_arrays()
        return {name: array.copy() for name, array in arrays.items()}, {"step": self.step}

    def load_state(self, arrays: dict[str, np.ndarray], facts: dict[str, Any]) -> None:
        """Continue from a state of a trainer with the same scene, views and config."""
        names = Splats.__dataclass_fields__
        self.splats = Splats(**{name: arrays[f"splats.{name}"].copy() for name in names})
        for name, array in self._learnt_arrays().items():
            array[:] = arrays[name]
        self.step = int(facts["step"])

    def _next_key(self) -> ViewKey:
        """Every view once an epoch, in an order of its own."""
        train = self._source.train
        epoch, place = divmod(self.step, len(train))
        if self._order[0] != epoch:
            rng = rng_for(
                seed=self._config.seed, scene=self._scene.name, effect="fit.order", frame=epoch
            )
            self._order = (epoch, rng.permutation(len(train)))
        return train[int(self._order[1][place])]

    def _posed(self, camera: Camera) -> _PosedParts:
        """The world, and the actors that hold splats and exist when the view was taken, where they
        are now taken to be."""
        starts = self.splats.starts
        posed = [
            part
            for part in self._scene.parts_for(camera)
            if part.instance_id == 0 or starts[part.instance_id] < starts[part.instance_id + 1]
        ]
        numbers = [part.instance_id for part in posed]
        poses = part_poses([part.world_from_part for part in posed])
        for place, number in enumerate(numbers):
            if number > 0:
                poses[place] = self.actor_poses.corrected(
                    number - 1, poses[place], camera.timestamp_ns
                )
        return _PosedParts(numbers, poses)

    def _render(self, parts: _PosedParts, camera: Camera) -> Tape | GsplatTape:
        inputs = splat_inputs(self.splats, parts.numbers, parts.poses, camera, SETTINGS)
        inputs.modes[M_FUNCTIONS] = self._functions
        with_depth = self._weights.depth > 0
        return self._renderer.record(
            self.splats, inputs, parts.poses, camera, with_depth=with_depth
        )

    @property
    def _done(self) -> float:
        """The part of the run that lies behind."""
        return min(1.0, self.step / self._steps)

    @property
    def _functions(self) -> int:
        """SH functions that are learnt by now."""
        degree = min(self._config.sh_degree, self.step // self._tuning.sh_every)
        return (degree + 1) ** 2

    def _update(
        self,
        parts: _PosedParts,
        inputs: Inputs,
        grads: SplatGradients,
        camera: Camera,
        loss: ViewLoss,
    ) -> None:
        splats, rates, tuning = self.splats, self._tuning.rates, self._tuning
        done = self._done
        late = rates.late**done
        forces = part_forces(inputs, grads)
        with kernel_threads():
            update_splats(
                inputs.addresses, inputs.sizes, inputs.views, inputs.blocks, inputs.first_ids,
                GradientRows(grads.rows.reshape(-1), grads.ids, grads.counts), self._functions,
                splat_rates(rates, done, camera, self._extent_m), CORRECTIONS.reshape(-1),
                splats.adam_state(),
            )  # fmt: skip
        if loss.d_sky is not None:
            rate = decayed(rates.sky, rates.sky_end, done)
            above = self._is_sky[loss.d_sky.texels]
            self._sky_adam.update(loss.d_sky.texels[above], loss.d_sky.grads[above], rate)
        pull = tuning.exposure_pull * (self.color_maps[camera.name] - IDENTITY_MAP)
        self._map_adams[camera.name].update(loss.d_color_map + pull, rates.color_map * late)
        self.actor_poses.update(
            parts.numbers,
            parts.poses,
            forces,
            camera.timestamp_ns,
            rate_m=rates.actors * late,
            pull=tuning.pose_pull,
        )
        self.camera_poses.update(
            camera, parts.poses, forces, rate_px=rates.cameras * late, pull=tuning.pose_pull
        )

    def _densify(self) -> None:
        config, growth = self._config, self._tuning.growth
        if config.densify != "none" and densify_due(growth, self.step, self._steps):
            self.splats = densify(
                self.splats, growth, max_splats=config.max_splats, extent_m=self._extent_m,
                refuted=self._look(with_actors=False),
            )  # fmt: skip

    def _look(self, *, with_actors: bool) -> np.ndarray:
        """Brings the least sizes up to date by all training views, of actors where asked for (they
        hardly change: children inherit them). Returns which splats the sky refutes, bool [N]: of
        the background alone, since boxes say that actors are there.
        """
        found = Sightings(len(self.splats))
        for key, bits in self._skies.items():
            camera = self.camera_poses.corrected(self._source.camera(key))
            count = camera.height * camera.width
            sky = np.unpackbits(bits, count=count).view(np.bool_)
            sky = sky.reshape(camera.height, camera.width)
            parts = self._posed(camera) if with_actors else _PosedParts([0], np.eye(4)[None])
            for part, pose in zip(parts.numbers, parts.poses, strict=True):
                found.add(self.splats, part, pose, camera, sky)
        shown = found.px_per_m > 0
        self.splats.smallest[shown] = FILTER_PX / found.px_per_m[shown]
        return found.refuted & (self.splats.part_of == 0)


@dataclass(frozen=True, eq=False)
class _PosedParts:
    """What a view may show. numbers: of the parts. poses: world_from_part, float64 [P, 4, 4]."""

    numbers: list[int]
    poses: np.ndarray


@contextmanager
def _timed(stages: dict[str, float], name: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    stages[name] = time.perf_counter() - start


def _extent(source: ViewSource) -> float:
    """How far the cameras move, and at least 10 m: what splats' sizes are bounded against."""
    centres = np.stack([source.camera(key).centre.numpy() for key in source.train])
    return max(10.0, float(np.linalg.norm(centres.max(0) - centres.min(0))))
