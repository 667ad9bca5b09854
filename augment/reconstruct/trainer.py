"""The optimisation: each step fits all splats of the scene to one recorded view.

    load → forward (record) → loss → backward → Adam on the splats of the view → at times densify

All data of a step stay in arrays that the kernels read directly. A run is a function of (scene,
views, config): its bits do not depend on threads, and a run that continues from a state between two
steps gives the same bits. The command `fit` drives it.
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
from augment.render.cpu.backward import SplatGradients, Tape, record_render
from augment.render.cpu.driver import Inputs, Scratch
from augment.render.cuda import runtime
from augment.render.gsplat_backend import GsplatImages, import_gsplat, render_with_gsplat
from augment.render.layout import BLOCK_SIZE, M_NUM_SH_FUNCTIONS
from augment.render.part_views import raster_modes, stack_poses, view_numbers
from augment.render.threads import kernel_threads
from augment.rng import rng_for
from augment.scene.cameras import Camera, Frame
from augment.scene.labels import EGO_VEHICLE
from augment.scene.scene import Actor, Gaussians, PosedGaussians, Scene, Track
from augment.scene.sky import CubemapSky

# ---- Small corrections of the poses of actors and cameras, learnt with the scene -----------------
# Labelled boxes are centimetres off, and recorded poses some tenths of a pixel. Corrections are
# stored at knots and linear in time between them, so that frames that are not learnt from (held-out
# frames above all) share their neighbours' corrections.

# Added to the root of Adam's second moment. Forces are some 1e-4 a metre: much smaller ones are
# rounding errors and must not give a direction.
_EPS = 1e-10


class Knots:
    """Values of D numbers at the knots of several objects, float64, zero at first.

    Before the first and after the last knot, the nearest knot's values hold. An object without
    knots
    is never corrected.
    """

    def __init__(self, times_ns: Sequence[np.ndarray], width: int) -> None:
        """times_ns: for each object its knots, int64 [K], increasing. width: D."""
        self._times = list(times_ns)
        self._firsts = np.cumsum([0, *(len(times) for times in times_ns)])
        shape = (int(self._firsts[-1]), width)
        self.values = np.zeros(shape)
        self._adam = DenseAdam(self.values, _EPS)

    def at(self, number: int, timestamp_ns: int) -> np.ndarray | None:
        """Return an object's correction at a time, float64 [D]; None if it has no knots."""
        weighted_rows = self._weighted_rows(number, timestamp_ns)
        return None if weighted_rows is None else weighted_rows[1] @ self.values[weighted_rows[0]]

    def update(
        self, number: int, timestamp_ns: int, gradient: np.ndarray, rates: np.ndarray, pull: float
    ) -> None:
        """Apply a step of Adam to the knots around a time.

        Args:
            number: the object's index.
            timestamp_ns: the time.
            gradient: [D].
            rates: step sizes, [D].
            pull: strength of the pull towards 0.
        """
        weighted_rows = self._weighted_rows(number, timestamp_ns)
        if weighted_rows is None:
            return
        for row, weight in zip(*weighted_rows, strict=True):
            if weight > 0:
                self._adam.update(weight * gradient + pull * self.values[row], rates, row)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the values and Adam's arrays by name."""
        return {"values": self.values, **self._adam.arrays()}

    def _weighted_rows(self, number: int, timestamp_ns: int) -> tuple[list[int], np.ndarray] | None:
        """Return the rows of `values` around a time, and their weights."""
        times = self._times[number]
        if len(times) == 0:
            return None
        first_row = int(self._firsts[number])
        next_knot = int(np.searchsorted(times, timestamp_ns, side="right"))
        if next_knot == 0 or next_knot == len(times):
            return [first_row + min(next_knot, len(times) - 1)], np.ones(1)
        span_ns = int(times[next_knot]) - int(times[next_knot - 1])
        fraction = (timestamp_ns - int(times[next_knot - 1])) / span_ns
        return [first_row + next_knot - 1, first_row + next_knot], np.array(
            [1 - fraction, fraction]
        )


@dataclass(frozen=True, eq=False)
class Forces:
    """Derivatives of the loss by the poses of P parts, in each part's own axes, float64."""

    is_visible: np.ndarray  # bool [P], True for parts that the view shows
    shift: np.ndarray  # [P, 3], dL by a translation of the part, 1/m
    # [P, 3], dL by a rotation about the part's origin (rad), of means and ellipsoids; the rotation
    # of view-dependent colours is neglected.
    turn: np.ndarray

    def on_camera(self, camera_from_parts: np.ndarray) -> np.ndarray:
        """Return dL [6] by a rotation, then a translation, of everything that the camera sees.

        Both are in camera axes.

        Args:
            camera_from_parts: float64 [P, 4, 4].
        """
        rotations = camera_from_parts[:, :3, :3]
        offsets = camera_from_parts[:, :3, 3]
        shift = (rotations @ self.shift[..., None])[..., 0]
        turn = (rotations @ self.turn[..., None])[..., 0] + np.cross(offsets, shift)
        return np.concatenate([turn.sum(0), shift.sum(0)])


def part_forces(inputs: Inputs, grads: SplatGradients) -> Forces:
    """Return the forces of one view's gradients; they do not depend on the number of threads."""
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
    num_parts = len(inputs.sizes)
    # Blocks of a part follow each other; an empty part has none.
    totals = np.zeros((num_parts, MOMENTS))
    np.add.at(totals, inputs.blocks[:, 0], moments)
    is_visible = np.bincount(inputs.blocks[:, 0], grads.counts, minlength=num_parts) > 0
    return Forces(is_visible, totals[:, :3], totals[:, 3:])


SAMPLES_PER_KNOT = 4  # track samples between an actor's knots
# Metres from an actor's origin to the arc that measures its rotation, so that a rotation moves its
# points about as far as a translation of the same length.
_ACTOR_ARC_M = 2.0
_CAMERA_ARC_M = 10.0  # metres from a camera to the arc that measures its rotation


class ActorPoses:
    """Corrections of actors: a translation in the world (3, metres), a rotation about the vertical.

    The rotation is measured by its arc at 2 m.
    """

    def __init__(self, actors: Sequence[Actor]) -> None:
        self.knots = Knots([_actor_knots(actor) for actor in actors], 4)

    def corrected(self, number: int, pose: np.ndarray, timestamp_ns: int) -> np.ndarray:
        """Return the corrected pose of an actor, float64 [4, 4].

        Args:
            number: the actor's index.
            pose: world_from_actor, float64 [4, 4].
            timestamp_ns: the time.
        """
        correction = self.knots.at(number, timestamp_ns)
        if correction is None:
            return pose
        corrected_pose = pose.copy()
        corrected_pose[:3, :3] = (
            _rotation_matrix([0.0, 0.0, correction[3] / _ACTOR_ARC_M]) @ pose[:3, :3]
        )
        corrected_pose[:3, 3] += correction[:3]
        return corrected_pose

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
        """Apply one step to every actor that a view shows.

        Args:
            parts: the numbers of the parts of the view's inputs.
            poses: their world_from_part.
            forces: the view's forces.
            timestamp_ns: the view's time.
            rate_m: the step size, metres.
            pull: strength of the pull to the recorded pose.
        """
        rates = np.full(4, rate_m)
        for index in np.flatnonzero(forces.is_visible).tolist():
            if parts[index] == 0:
                continue
            rotation = poses[index, :3, :3]
            arc_gradient = (rotation @ forces.turn[index])[2] / _ACTOR_ARC_M
            gradient = np.append(rotation @ forces.shift[index], arc_gradient)
            self.knots.update(parts[index] - 1, timestamp_ns, gradient, rates, pull)

    def track(self, number: int, track: Track) -> Track:
        """Return the actor's track with its corrections."""
        times = track.timestamps_ns.tolist()
        poses = [
            self.corrected(number, pose.numpy(), time)
            for pose, time in zip(track.world_from_actor, times, strict=True)
        ]
        return dataclasses.replace(track, world_from_actor=torch.from_numpy(np.stack(poses)))


class CameraPoses:
    """Corrections of cameras: a rotation (3, arcs at 10 m) and a translation (3, metres).

    They move everything that the camera sees, in camera axes.
    """

    def __init__(self, source: ViewSource) -> None:
        times: dict[str, list[int]] = {}
        for key in source.train:
            times.setdefault(key.camera, []).append(source.camera(key).timestamp_ns)
        self._names: Mapping[str, int] = {name: i for i, name in enumerate(times)}
        self.knots = Knots([np.unique(np.array(t, np.int64)) for t in times.values()], 6)

    def corrected(self, camera: Camera) -> Camera:
        """Return the corrected camera; the camera itself where nothing was learnt."""
        number = self._names.get(camera.name)
        correction = None if number is None else self.knots.at(number, camera.timestamp_ns)
        if correction is None or not correction.any():
            return camera
        corrected_from_recorded = np.eye(4)
        corrected_from_recorded[:3, :3] = _rotation_matrix(correction[:3] / _CAMERA_ARC_M)
        corrected_from_recorded[:3, 3] = correction[3:]
        pose = torch.from_numpy(corrected_from_recorded @ camera.camera_from_world.numpy())
        return dataclasses.replace(camera, camera_from_world=pose)

    def update(
        self, camera: Camera, poses: np.ndarray, forces: Forces, *, rate_px: float, pull: float
    ) -> None:
        """Apply one step to a view's camera.

        Args:
            camera: the corrected camera.
            poses: world_from_part of the view's inputs.
            forces: the view's forces.
            rate_px: the step size, pixels.
            pull: strength of the pull to the recorded pose.
        """
        number = self._names.get(camera.name)
        if number is None:
            return
        gradient = forces.on_camera(camera.camera_from_world.numpy() @ poses)
        gradient[:3] /= _CAMERA_ARC_M
        rates = np.full(6, rate_px * _CAMERA_ARC_M / camera.fx)
        self.knots.update(number, camera.timestamp_ns, gradient, rates, pull)


def _actor_knots(actor: Actor) -> np.ndarray:
    """Return an actor's knots, int64 [K]; the recording car's body, tracked exactly, has none."""
    times = actor.track.timestamps_ns.numpy()
    if actor.label == EGO_VEHICLE:
        return times[:0]
    knots = times[::SAMPLES_PER_KNOT]
    return knots if knots[-1] == times[-1] else np.append(knots, times[-1])


def _rotation_matrix(vector_rad: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return the rotation matrix of a rotation vector (Rodrigues)."""
    x, y, z = (float(v) for v in vector_rad)
    angle = (x * x + y * y + z * z) ** 0.5
    cross_matrix = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-12:
        return np.eye(3) + cross_matrix
    return (
        np.eye(3)
        + np.sin(angle) / angle * cross_matrix
        + (1 - np.cos(angle)) / angle**2 * (cross_matrix @ cross_matrix)
    )


# ---- Inputs of the CPU kernels: addresses into the arrays that are fitted ------------------------

_FIELDS = ("means", "quats", "scales", "opacities", "sh")


def splat_inputs(
    splats: Splats,
    parts: Sequence[int],
    poses: np.ndarray,
    camera: Camera,
    settings: RasterSettings,
) -> Inputs:
    """Return the kernels' inputs for the parts that a view shows.

    Nothing is copied: kernels read, and Adam writes, the arrays of `splats`, which must outlive the
    inputs. first_ids are positions in the arrays of `splats`.

    Args:
        splats: the splats.
        parts: the numbers of the parts that exist at the view's time.
        poses: world_from_part, float64 [P, 4, 4].
        camera: the view's camera.
        settings: the rasteriser's settings.
    """
    starts = splats.starts[list(parts)]
    counts = splats.starts[np.asarray(parts) + 1] - starts
    num_sh = splats.sh.shape[1]
    strides = [getattr(splats, name)[:1].nbytes for name in _FIELDS]
    base_addresses = [getattr(splats, name).ctypes.data for name in _FIELDS]
    addresses = np.array(base_addresses, np.uint64) + starts[:, None].astype(np.uint64) * np.array(
        strides, np.uint64
    )
    # no part has gradients of light, or colour maps
    no_addresses = np.zeros((len(starts), layout.NUM_ADDRESSES - len(_FIELDS)), np.uint64)
    return Inputs(
        addresses=np.concatenate([addresses, no_addresses], 1),
        sizes=np.stack([counts, np.full_like(counts, num_sh)], 1),
        first_ids=starts.copy(),
        views=view_numbers(poses, camera, settings, None),
        blocks=_blocks(counts),
        modes=raster_modes(settings, None, with_color=True),
        array_owners=[getattr(splats, name) for name in _FIELDS],
    )


def _blocks(counts: np.ndarray) -> np.ndarray:
    """Return part, first and last + 1 of every block, int64 [B, 3]."""
    per_part = -(-counts // layout.BLOCK_SIZE)
    part = np.repeat(np.arange(len(counts)), per_part)
    first_block = np.repeat(np.cumsum(per_part) - per_part, per_part)
    first = (np.arange(len(part)) - first_block) * layout.BLOCK_SIZE
    last = np.minimum(first + layout.BLOCK_SIZE, counts[part])
    return np.stack([part, first, last], 1).astype(np.int64)


# ---- Renderers of the views: the CPU's kernels, or gsplat on a GPU; everything else is shared ----

DEVICES = ("cpu", "cuda")  # devices that render the views
SETTINGS = RasterSettings()  # settings of all renders


class CpuRenderer:
    """Renders the fitted splats by the kernels of augment.render.cpu.backward.

    The bits do not depend on the number of threads. A tape is valid until the next render. Between
    two renders, splats may be changed in place only where the last tape has gradients.
    """

    def __init__(self) -> None:
        self._scratch = Scratch()

    def record(
        self, splats: Splats, inputs: Inputs, poses: np.ndarray, camera: Camera, *, with_depth: bool
    ) -> Tape:
        """Render a view and keep what its gradients need.

        Args:
            splats: the splats.
            inputs: the inputs of these splats.
            poses: world_from_part of their parts, float64 [P, 4, 4].
            camera: the view's camera.
            with_depth: whether to render the expected depth.
        """
        return record_render(inputs, camera, SETTINGS, self._scratch, with_depth=with_depth)


# The GPU holds a copy of all splats. Before each render it receives the rows that the last step has
# changed on the CPU: the splats of the last view. It returns the image and the gradients of the
# view's splats. gsplat adds contributions in no fixed order, so a fit's bits do not repeat.

_MIN_DETERMINANT = 1e-30  # of a conic, px^-4


class GsplatRenderer:
    """Renders as `CpuRenderer`, by gsplat.

    Raises:
        BackendUnavailable: there is no GPU, or no gsplat.
    """

    def __init__(self) -> None:
        runtime.require_gpu()
        import_gsplat()
        self._splats: Splats | None = None
        self._copies: dict[str, Tensor] = {}
        self._changed = np.zeros(0, np.int64)  # rows of the last tape's gradients
        self._scratch = Scratch()

    def record(
        self, splats: Splats, inputs: Inputs, poses: np.ndarray, camera: Camera, *, with_depth: bool
    ) -> GsplatTape:
        """Render a view as `CpuRenderer.record`."""
        self._refresh(splats)
        # SH need no gradients of their own: they follow from the colours'.
        leaves = {name: copy.detach() for name, copy in self._copies.items()}
        for name in _FIELDS[:4]:
            leaves[name].requires_grad_()
        parts = []
        for first_row, (count, _), pose in zip(inputs.first_ids, inputs.sizes, poses, strict=True):
            part_leaves = {
                name: leaf[int(first_row) : int(first_row + count)] for name, leaf in leaves.items()
            }
            is_world = np.array_equal(pose, np.eye(4))
            world_from_part = None if is_world else torch.from_numpy(np.ascontiguousarray(pose))
            parts.append(PosedGaussians(Gaussians(**part_leaves), world_from_part))
        images = render_with_gsplat(
            parts,
            camera,
            SETTINGS,
            with_depth=with_depth,
            num_sh_functions=int(inputs.modes[M_NUM_SH_FUNCTIONS]),
            keeps_color_gradients=True,
        )
        depth = None if images.expected_depth is None else _array(images.expected_depth)
        return GsplatTape(
            inputs, _array(images.rgb), _array(images.alpha), depth, images, leaves, self
        )

    def _refresh(self, splats: Splats) -> None:
        """Bring the copy on the GPU up to date with the splats."""
        if splats is not self._splats:
            self._copies = {
                name: runtime.upload(torch.from_numpy(getattr(splats, name))) for name in _FIELDS
            }
            if runtime.gpu_device().type == "cpu":  # interpreted: still needs separate memory
                self._copies = {name: copy.clone() for name, copy in self._copies.items()}
        elif len(rows := self._changed):
            changed_arrays = [
                getattr(splats, name)[rows].reshape(len(rows), -1) for name in _FIELDS
            ]
            changed_values = runtime.upload(np.concatenate(changed_arrays, 1))
            row_index = runtime.upload(rows)
            widths = [part.shape[1] for part in changed_arrays]
            for name, part in zip(_FIELDS, changed_values.split(widths, 1), strict=True):
                copy = self._copies[name]
                copy.index_copy_(0, row_index, part.reshape(-1, *copy.shape[1:]))
        self._splats = splats
        self._changed = np.zeros(0, np.int64)

    def rows_of(self, inputs: Inputs, positions: np.ndarray, rows: np.ndarray) -> SplatGradients:
        """Return gradients block by block.

        Args:
            inputs: the view's inputs.
            positions: int64 [T], increasing positions in all parts one after another.
            rows: float32 [T, NUM_GRADIENTS], gradients of these splats.
        """
        counts = inputs.sizes[:, 0]
        part_ends = np.cumsum(counts)
        part_of_row = np.searchsorted(part_ends, positions, side="right")
        ids = positions - (part_ends - counts)[part_of_row]
        self._changed = inputs.first_ids[part_of_row] + ids
        blocks = -(-counts // BLOCK_SIZE)
        block_of_row = (np.cumsum(blocks) - blocks)[part_of_row] + ids // BLOCK_SIZE
        num_blocks = len(inputs.blocks)
        rows_per_block = np.bincount(block_of_row, minlength=num_blocks)
        row_slots = (
            block_of_row * BLOCK_SIZE
            + np.arange(len(positions))
            - (np.cumsum(rows_per_block) - rows_per_block)[block_of_row]
        )
        all_rows = self._scratch.array(
            "rows", (num_blocks * BLOCK_SIZE, backward_kernels.NUM_GRADIENTS), np.float32
        )
        all_ids = self._scratch.array("ids", (num_blocks * BLOCK_SIZE,), np.int32)
        all_rows[row_slots] = rows
        all_ids[row_slots] = ids
        return SplatGradients(all_rows, all_ids, rows_per_block.astype(np.int64), inputs.blocks)


@dataclass(frozen=True, eq=False)
class GsplatTape:
    """Holds a render by gsplat for its gradients, as cpu.backward.Tape."""

    inputs: Inputs
    rgb: np.ndarray
    alpha: np.ndarray
    expected_depth: np.ndarray | None
    images: GsplatImages
    leaves: dict[str, Tensor]  # the tensors that gsplat rendered, by name
    renderer: GsplatRenderer

    def backward(
        self, d_rgb: np.ndarray, d_alpha: np.ndarray, d_expected_depth: np.ndarray | None = None
    ) -> SplatGradients:
        """Return the gradients of the splats that a pixel shows, each once, in order."""
        images = [self.images.rgb, self.images.alpha]
        image_gradients = [runtime.upload(d_rgb), runtime.upload(d_alpha)]
        if self.images.expected_depth is not None and d_expected_depth is not None:
            images.append(self.images.expected_depth)
            image_gradients.append(runtime.upload(d_expected_depth))
        ids = self.images.ids
        if len(ids) == 0:
            no_positions = np.zeros(0, np.int64)
            return self.renderer.rows_of(self.inputs, no_positions, np.zeros((0, 16), np.float32))
        torch.autograd.backward(images, image_gradients)
        with torch.no_grad():
            ids, order = torch.sort(ids.long())
            rows = self._rows(ids, order)
            shown_rows = torch.nonzero((rows[:, : backward_kernels.G_MAX_SIGMA] != 0).any(1))[
                :, 0
            ]  # waits for the GPU
            return self.renderer.rows_of(
                self.inputs, _array(ids[shown_rows]), _array(rows[shown_rows])
            )

    def _rows(self, ids: Tensor, order: Tensor) -> Tensor:
        """Return gradient rows [M, NUM_GRADIENTS] of the rendered splats.

        Their columns are those of augment.render.cpu.backward_kernels.
        """
        counts = self.inputs.sizes[:, 0]
        ends = np.cumsum(counts)
        id_shifts = runtime.upload(self.inputs.first_ids - (ends - counts))
        part = torch.searchsorted(runtime.upload(ends), ids, right=True)
        splat_ids = ids + id_shifts[part]  # in the arrays of all splats
        gradients = {
            name: _gradient_of(leaf)[splat_ids]
            for name, leaf in self.leaves.items()
            if name != "sh"
        }
        values = {name: self.leaves[name].detach()[splat_ids] for name in gradients}
        quats = values["quats"]
        radial_gradient = (gradients["quats"] * quats).sum(1, keepdim=True)
        absolute_gradients = self.images.means2d.absgrad[order]
        a, b, c = self.images.conics.detach()[order].unbind(1)
        variance = torch.maximum(a, c) / (a * c - b * b).clamp_min(_MIN_DETERMINANT)
        rows = {
            backward_kernels.G_MEAN: gradients["means"],
            backward_kernels.G_QUAT: gradients["quats"] - radial_gradient * quats,
            backward_kernels.G_ABS_MEAN: absolute_gradients.norm(dim=1, keepdim=True),
            backward_kernels.G_SCALE: gradients["scales"] * values["scales"],
            backward_kernels.G_OPACITY: (gradients["opacities"] * values["opacities"])[:, None],
            backward_kernels.G_COLOR: _gradient_of(self.images.colors)[ids],
            backward_kernels.G_MAX_SIGMA: torch.sqrt(variance)[:, None],
        }
        return torch.cat([rows[column] for column in sorted(rows)], 1)


def _gradient_of(tensor: Tensor) -> Tensor:
    """Return the gradient of a tensor; zeros without one."""
    return torch.zeros_like(tensor) if tensor.grad is None else tensor.grad


def _array(tensor: Tensor) -> np.ndarray:
    """Copy a tensor into a contiguous array."""
    return np.ascontiguousarray(tensor.detach().cpu().numpy())


def fit_renderer(device: str) -> CpuRenderer | GsplatRenderer:
    """Return the renderer of a device.

    Args:
        device: one of DEVICES.

    Raises:
        BackendUnavailable: there is no such device, or gsplat is not installed.
        ValueError: the name is not one of DEVICES.
    """
    if device not in DEVICES:
        raise ValueError(f"device must be one of {', '.join(DEVICES)}; got {device!r}")
    return CpuRenderer() if device == "cpu" else GsplatRenderer()


# ---- The optimisation ----------------------------------------------------------------------------


@dataclass(frozen=True)
class StepRecord:
    """The result of one step. The losses are those of `ViewLoss`."""

    step: int  # steps so far, this one included
    key: ViewKey  # the view
    loss: float
    l1: float
    ssim: float
    depth: float
    sky: float
    splats: int  # splats after the step
    stage_s: dict[str, float]  # seconds of load, forward, loss, backward, optimise, densify


class Trainer:
    """Fits a scene to its recorded views."""

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
        """Prepare a run.

        Args:
            scene: the scene to start from; it is not changed.
            source: the recorded views, at least one of them for training.
            config: the settings that users choose.
            steps: the steps of the whole run, one view each.
            tuning: the other settings.
            device: the device that renders views; only "cpu" gives reproducible bits.
        """
        if not source.train:
            raise ValueError("the view source has no training views; nothing can be learnt")
        self.step = 0
        self._config = config
        self._steps = steps
        self._tuning = tuning
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
        is_kept = ~self._update_sightings(with_actors=True)
        self.splats = rebuild(self.splats, np.flatnonzero(is_kept | ~is_kept.any()))
        bound_sizes(self.splats)
        self._order: tuple[int, np.ndarray] = (-1, np.zeros(0, np.int64))

    def run_step(self) -> StepRecord:
        """Update everything that one view shows."""
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
            step=self.step,
            key=key,
            loss=loss.total,
            l1=loss.l1,
            ssim=loss.ssim,
            depth=loss.depth,
            sky=loss.sky,
            splats=len(self.splats),
            stage_s=stages,
        )

    def scene(self) -> Scene:
        """Return the scene as fitted so far; it shares nothing with the trainer."""
        actors = tuple(
            dataclasses.replace(
                actor,
                gaussians=self.splats.gaussians(number),
                track=self.actor_poses.track(number - 1, actor.track),
                color_waves=None,  # learnt colours hold at all times, in the actor's frame
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
        """Return a frame with corrected cameras."""
        cameras = {n: self.camera_poses.corrected(c) for n, c in frame.cameras.items()}
        return dataclasses.replace(frame, cameras=cameras)

    def _learnt_arrays(self) -> dict[str, np.ndarray]:
        """Return all arrays that are learnt in place besides the splats, by name in a state."""
        parts = {"sky_adam": self._sky_adam}
        parts |= {f"color_map_adam.{name}": adam for name, adam in self._map_adams.items()}
        parts |= {"actors": self.actor_poses.knots, "cameras": self.camera_poses.knots}
        adam_arrays = {
            f"{part}.{k}": a for part, adam in parts.items() for k, a in adam.arrays().items()
        }
        maps = {f"color_map.{name}": color_map for name, color_map in self.color_maps.items()}
        return {"sky": self.sky_faces, **maps, **adam_arrays}

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return everything needed to continue to the same bits: arrays, and facts for JSON."""
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
        """Return the next view: every view once an epoch, in the epoch's own order."""
        train = self._source.train
        epoch, position = divmod(self.step, len(train))
        if self._order[0] != epoch:
            rng = rng_for(
                seed=self._config.seed, scene=self._scene.name, effect="fit.order", frame=epoch
            )
            self._order = (epoch, rng.permutation(len(train)))
        return train[int(self._order[1][position])]

    def _posed(self, camera: Camera) -> _PosedParts:
        """Return the parts that a view may show, at their corrected poses.

        These are the world, and the actors that have splats and exist at the view's time.
        """
        starts = self.splats.starts
        posed_parts = [
            part
            for part in self._scene.parts_for(camera)
            if part.instance_id == 0 or starts[part.instance_id] < starts[part.instance_id + 1]
        ]
        numbers = [part.instance_id for part in posed_parts]
        poses = stack_poses([part.world_from_part for part in posed_parts])
        for index, number in enumerate(numbers):
            if number > 0:
                poses[index] = self.actor_poses.corrected(
                    number - 1, poses[index], camera.timestamp_ns
                )
        return _PosedParts(numbers, poses)

    def _render(self, parts: _PosedParts, camera: Camera) -> Tape | GsplatTape:
        """Render a view for its gradients."""
        inputs = splat_inputs(self.splats, parts.numbers, parts.poses, camera, SETTINGS)
        inputs.modes[M_NUM_SH_FUNCTIONS] = self._num_sh
        with_depth = self._weights.depth > 0
        return self._renderer.record(
            self.splats, inputs, parts.poses, camera, with_depth=with_depth
        )

    @property
    def _done_fraction(self) -> float:
        """Return the fraction of the run that is over."""
        return min(1.0, self.step / self._steps)

    @property
    def _num_sh(self) -> int:
        """Return the number of SH functions that are learnt now."""
        degree = min(self._config.sh_degree, self.step // self._tuning.steps_per_sh_band)
        return (degree + 1) ** 2

    def _update(
        self,
        parts: _PosedParts,
        inputs: Inputs,
        grads: SplatGradients,
        camera: Camera,
        loss: ViewLoss,
    ) -> None:
        """Apply one step of Adam to splats, sky, colour map and poses."""
        splats = self.splats
        rates = self._tuning.rates
        tuning = self._tuning
        done_fraction = self._done_fraction
        late_factor = rates.late**done_fraction
        forces = part_forces(inputs, grads)
        with kernel_threads():
            update_splats(
                inputs.addresses,
                inputs.sizes,
                inputs.views,
                inputs.blocks,
                inputs.first_ids,
                GradientRows(grads.rows.reshape(-1), grads.ids, grads.counts),
                self._num_sh,
                splat_rates(rates, done_fraction, camera, self._extent_m),
                CORRECTIONS.reshape(-1),
                splats.adam_state(),
            )
        if loss.d_sky is not None:
            rate = decayed(rates.sky, rates.sky_end, done_fraction)
            is_sky = self._is_sky[loss.d_sky.texels]
            self._sky_adam.update(loss.d_sky.texels[is_sky], loss.d_sky.grads[is_sky], rate)
        pull = tuning.exposure_pull * (self.color_maps[camera.name] - IDENTITY_MAP)
        self._map_adams[camera.name].update(loss.d_color_map + pull, rates.color_map * late_factor)
        self.actor_poses.update(
            parts.numbers,
            parts.poses,
            forces,
            camera.timestamp_ns,
            rate_m=rates.actors * late_factor,
            pull=tuning.pose_pull,
        )
        self.camera_poses.update(
            camera, parts.poses, forces, rate_px=rates.cameras * late_factor, pull=tuning.pose_pull
        )

    def _densify(self) -> None:
        """Run a round of densification if one is due."""
        config = self._config
        growth = self._tuning.growth
        if config.densify != "none" and densify_due(growth, self.step, self._steps):
            self.splats = densify(
                self.splats,
                growth,
                max_splats=config.max_splats,
                extent_m=self._extent_m,
                refuted=self._update_sightings(with_actors=False),
            )

    def _update_sightings(self, *, with_actors: bool) -> np.ndarray:
        """Update least sizes from all training views; return the refuted splats, bool [N].

        Only splats of the background are refuted, since boxes say where actors are.

        Args:
            with_actors: whether to update actors, too. Their least sizes hardly change: children
                inherit them.
        """
        sightings = Sightings(len(self.splats))
        for key, packed_sky in self._skies.items():
            camera = self.camera_poses.corrected(self._source.camera(key))
            count = camera.height * camera.width
            sky = np.unpackbits(packed_sky, count=count).view(np.bool_)
            sky = sky.reshape(camera.height, camera.width)
            parts = self._posed(camera) if with_actors else _PosedParts([0], np.eye(4)[None])
            for part, pose in zip(parts.numbers, parts.poses, strict=True):
                sightings.add(self.splats, part, pose, camera, sky)
        is_shown = sightings.px_per_m > 0
        self.splats.min_scale_m[is_shown] = FILTER_PX / sightings.px_per_m[is_shown]
        return sightings.is_refuted & (self.splats.part_of == 0)


@dataclass(frozen=True, eq=False)
class _PosedParts:
    """The parts that a view may show."""

    numbers: list[int]  # 0 is the background
    poses: np.ndarray  # world_from_part, float64 [P, 4, 4]


@contextmanager
def _timed(stages: dict[str, float], name: str) -> Iterator[None]:
    """Record the seconds of a stage."""
    start = time.perf_counter()
    yield
    stages[name] = time.perf_counter() - start


def _extent(source: ViewSource) -> float:
    """Return the distance that the cameras cover, at least 10 m: the limit of splats' sizes."""
    centres = np.stack([source.camera(key).centre.numpy() for key in source.train])
    return max(10.0, float(np.linalg.norm(centres.max(0) - centres.min(0))))
