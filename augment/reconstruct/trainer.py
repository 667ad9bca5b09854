"""The optimisation itself: one recorded view a step, all splats of the scene.

    load → forward (record) → loss → backward → Adam on what the view touched → now and then densify

Everything a step needs stays in arrays that the kernels read directly. A run is a function of
(scene, views, config): bits do not depend on threads, and a state saved between two steps continues
to the same bits.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from augment.cameras import Camera, Frame
from augment.reconstruct import kernels
from augment.reconstruct.config import FitConfig
from augment.reconstruct.densify import add_noise, densify, densify_due
from augment.reconstruct.kernels import update_rows, update_splats
from augment.reconstruct.loss import LossScratch, ViewLoss, view_loss
from augment.reconstruct.loss_reference import paint_below_horizon, starting_sky
from augment.reconstruct.poses import ActorPoses, CameraPoses, part_forces
from augment.reconstruct.renderers import ViewTape, fit_renderer
from augment.reconstruct.splats import Splats
from augment.reconstruct.view import RecordedView, ViewKey, ViewSource
from augment.render import layout
from augment.render.constants import RasterSettings
from augment.render.cpu.backward import SplatGradients
from augment.render.cpu.backward_kernels import G_MEAN, G_OPACITY, G_QUAT, G_SCALE
from augment.render.cpu.driver import Inputs
from augment.render.layout import BLOCK, M_FUNCTIONS
from augment.render.part_views import part_poses, part_views, raster_modes
from augment.render.threads import kernel_threads
from augment.rng import rng_for
from augment.scene import Scene
from augment.sky import CubemapSky

# --------------------------------------------------------------------------------------------------
# Adam for what is not a splat: colour maps (every number, every step) and the sky (few texels)

# ---- Step sizes of one update, as the kernel takes them ------------------------------------------

BETA1, BETA2 = 0.9, 0.999
CORRECTIONS = kernels.bias_corrections(BETA1, BETA2)
_MIN_M = 1e-3  # no splat gets thinner along any axis


def splat_rates(config: FitConfig, step: int, camera: Camera, extent_m: float) -> np.ndarray:
    """float32 [RATES] for the update after `step` updates.

    Means decay exponentially over the run; the others fall to rates.late of their value likewise.
    """
    rates = config.rates
    done = min(1.0, step / max(config.steps, 1))
    late = rates.late**done
    values = np.zeros(kernels.RATES, np.float32)
    values[G_MEAN : G_MEAN + 3] = decayed(rates.means, rates.means_end, done)
    values[G_QUAT : G_QUAT + 4] = rates.quats * late
    values[G_SCALE : G_SCALE + 3] = rates.scales * late
    values[G_OPACITY] = -rates.opacities * late
    values[kernels.R_SH_DC] = rates.sh_dc * late
    values[kernels.R_SH_REST] = rates.sh_rest * late
    values[kernels.R_BETA1], values[kernels.R_BETA2] = BETA1, BETA2
    values[kernels.R_OPACITY_DECAY] = config.loss.opacity_decay
    values[kernels.R_SCALE_DECAY] = config.loss.scale_decay
    values[kernels.R_SMALLEST], values[kernels.R_LARGEST] = _MIN_M, extent_m
    side = max(camera.width, camera.height)
    values[kernels.R_ABS_UNIT], values[kernels.R_RADIUS_UNIT] = 0.5 * side, 1 / side
    return values


def decayed(start: float, end: float, done: float) -> float:
    """From start to end exponentially, done being the part of the run; 0 where either is 0."""
    return start ** (1 - done) * end**done if start and end else 0.0


_EPS = 1e-15


class DenseAdam:
    """Adam on one small float32 array, which is updated in place; moments in float64."""

    def __init__(self, values: np.ndarray) -> None:
        self._values = values
        self._m = np.zeros(values.shape)
        self._v = np.zeros(values.shape)
        self._count = np.zeros(1, np.int64)

    def update(self, gradient: np.ndarray, rate: float) -> None:
        self._count += 1
        self._m += (1 - BETA1) * (gradient - self._m)
        self._v += (1 - BETA2) * (gradient * gradient - self._v)
        n = int(self._count[0])
        first = self._m / (1 - BETA1**n)
        second = self._v / (1 - BETA2**n)
        self._values -= (rate * first / (np.sqrt(second) + _EPS)).astype(np.float32)

    def arrays(self) -> dict[str, np.ndarray]:
        return {"m": self._m, "v": self._v, "count": self._count}

    def load(self, arrays: dict[str, np.ndarray]) -> None:
        for name, array in self.arrays().items():
            array[:] = arrays[name]


class ColorAdam:
    """Adam on rows of a float32 array [N, 3] of colours in place, counting each row's updates."""

    def __init__(self, values: np.ndarray) -> None:
        self._values = values
        self._m = np.zeros_like(values)
        self._v = np.zeros_like(values)
        self._count = np.zeros(len(values), np.int32)

    def update(self, rows: np.ndarray, gradient: np.ndarray, rate: float) -> None:
        """rows: int32 [T], each once. gradient: float32 [T, 3]. Colours stay within [0, 1]."""
        with kernel_threads():
            update_rows(
                self._values.reshape(-1),
                self._m.reshape(-1),
                self._v.reshape(-1),
                self._count,
                rows,
                gradient,
                np.float32(rate),
                np.array([BETA1, BETA2], np.float32),
                CORRECTIONS.reshape(-1),
            )

    def arrays(self) -> dict[str, np.ndarray]:
        return {"m": self._m, "v": self._v, "count": self._count}

    def load(self, arrays: dict[str, np.ndarray]) -> None:
        for name, array in self.arrays().items():
            array[:] = arrays[name]


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
        arrays=[getattr(splats, name) for name in _FIELDS],
    )


def _blocks(counts: np.ndarray) -> np.ndarray:
    """int64 [B, 3]: part, first and last + 1 of every block."""
    per_part = -(-counts // layout.BLOCK)
    part = np.repeat(np.arange(len(counts)), per_part)
    first_block = np.repeat(np.cumsum(per_part) - per_part, per_part)
    first = (np.arange(len(part)) - first_block) * layout.BLOCK
    last = np.minimum(first + layout.BLOCK, counts[part])
    return np.stack([part, first, last], 1).astype(np.int64)


_IDENTITY = np.eye(3, 4, dtype=np.float32)


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
        self, scene: Scene, source: ViewSource, config: FitConfig, *, device: str = "cpu"
    ) -> None:
        """scene: what is started from; it is not changed. source: at least one training view.
        device: where views are rendered (augment.reconstruct.renderers); bits are those of "cpu".
        """
        if not source.train:
            raise ValueError("the view source has no training views; nothing can be learnt")
        self.config = config
        self.step = 0
        parts = scene.all_gaussians
        self.splats = Splats.of(parts, config.sh_degree)
        self.sky_faces = starting_sky(scene.sky)
        self._is_sky = paint_below_horizon(self.sky_faces)
        self._sky_adam = ColorAdam(self.sky_faces.reshape(-1, 3))
        names = sorted({key.camera for key in (*source.train, *source.test)})
        self.color_maps = {name: _IDENTITY.copy() for name in names}
        self._map_adams = {name: DenseAdam(m) for name, m in self.color_maps.items()}
        self._scene = scene
        self._source = source
        self._settings = RasterSettings()
        self._renderer = fit_renderer(device)
        self._loss_scratch = LossScratch()
        self.actor_poses = ActorPoses(scene.actors)
        self.camera_poses = CameraPoses(source)
        self._extent_m = _extent(source)
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
            loss = self._loss(tape, view, key)
        with _timed(stages, "backward"):
            with_depth = tape.expected_depth is not None
            grads = tape.backward(
                loss.d_rgb, loss.d_alpha, loss.d_expected_depth if with_depth else None
            )
        with _timed(stages, "optimise"):
            self._update(parts, tape.inputs, grads, view.camera, loss)
        self.step += 1
        with _timed(stages, "densify"):
            if self.config.densify.method == "mcmc" and self.config.densify.noise > 0:
                self._add_noise(tape.inputs, grads)
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
            color_maps=maps if self.config.exposure else {},
            image_color_maps={},
        )

    def _frame(self, frame: Frame) -> Frame:
        cameras = {n: self.camera_poses.corrected(c) for n, c in frame.cameras.items()}
        return dataclasses.replace(frame, cameras=cameras)

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """All that continuing to the same bits needs: arrays, and facts for JSON."""
        arrays = {f"splats.{name}": array for name, array in self.splats.arrays().items()}
        arrays["sky"] = self.sky_faces
        arrays |= {f"sky_adam.{name}": a for name, a in self._sky_adam.arrays().items()}
        for name, adam in self._map_adams.items():
            arrays[f"color_map.{name}"] = self.color_maps[name]
            arrays |= {f"color_map_adam.{name}.{k}": a for k, a in adam.arrays().items()}
        arrays |= {f"actors.{name}": a for name, a in self.actor_poses.knots.arrays().items()}
        arrays |= {f"cameras.{name}": a for name, a in self.camera_poses.knots.arrays().items()}
        return {name: array.copy() for name, array in arrays.items()}, {"step": self.step}

    def load_state(self, arrays: dict[str, np.ndarray], facts: dict[str, Any]) -> None:
        """Continue from a state of a trainer with the same scene, views and config."""
        names = Splats.__dataclass_fields__
        self.splats = Splats(**{name: arrays[f"splats.{name}"].copy() for name in names})
        self.sky_faces[:] = arrays["sky"]
        self._sky_adam.load({k: arrays[f"sky_adam.{k}"] for k in self._sky_adam.arrays()})
        for name, adam in self._map_adams.items():
            self.color_maps[name][:] = arrays[f"color_map.{name}"]
            adam.load({k: arrays[f"color_map_adam.{name}.{k}"] for k in adam.arrays()})
        for prefix, knots in (
            ("actors", self.actor_poses.knots),
            ("cameras", self.camera_poses.knots),
        ):
            knots.load({k: arrays[f"{prefix}.{k}"] for k in knots.arrays()})
        self.step = int(facts["step"])

    def _next_key(self) -> ViewKey:
        """Every view once an epoch, in an order of its own."""
        train = self._source.train
        epoch, place = divmod(self.step, len(train))
        if self._order[0] != epoch:
            rng = rng_for(
                seed=self.config.seed, scene=self._scene.name, effect="fit.order", frame=epoch
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
        if self.config.pose_refinement:
            for place, number in enumerate(numbers):
                if number > 0:
                    poses[place] = self.actor_poses.corrected(
                        number - 1, poses[place], camera.timestamp_ns
                    )
        return _PosedParts(numbers, poses)

    def _render(self, parts: _PosedParts, camera: Camera) -> ViewTape:
        inputs = splat_inputs(self.splats, parts.numbers, parts.poses, camera, self._settings)
        inputs.modes[M_FUNCTIONS] = self._functions
        return self._renderer.record(
            self.splats,
            inputs,
            parts.poses,
            camera,
            self._settings,
            with_depth=self.config.loss.depth > 0,
        )

    @property
    def _done(self) -> float:
        """The part of the run that lies behind."""
        return min(1.0, self.step / max(self.config.steps, 1))

    @property
    def _functions(self) -> int:
        """SH functions that are learnt by now."""
        degree = min(self.config.sh_degree, self.step // max(self.config.sh_every, 1))
        return (degree + 1) ** 2

    def _loss(self, tape: ViewTape, view: RecordedView, key: ViewKey) -> ViewLoss:
        return view_loss(
            tape.rgb,
            tape.alpha,
            tape.expected_depth,
            view,
            self.sky_faces,
            self.color_maps[key.camera],
            self.config.loss,
            scratch=self._loss_scratch,
        )

    def _update(
        self,
        parts: _PosedParts,
        inputs: Inputs,
        grads: SplatGradients,
        camera: Camera,
        loss: ViewLoss,
    ) -> None:
        splats, rates = self.splats, self.config.rates
        done = self._done
        forces = part_forces(inputs, grads) if self.config.pose_refinement else None
        with kernel_threads():
            update_splats(
                inputs.addresses,
                inputs.sizes,
                inputs.views,
                inputs.blocks,
                inputs.first_ids,
                grads.rows.reshape(-1),
                grads.ids,
                grads.counts,
                self._functions,
                splat_rates(self.config, self.step, camera, self._extent_m),
                CORRECTIONS.reshape(-1),
                splats.geometry_m.reshape(-1),
                splats.geometry_v.reshape(-1),
                splats.sh_m.reshape(-1),
                splats.sh_v.reshape(-1),
                splats.age,
                splats.grads.reshape(-1),
            )
        if loss.d_sky is not None:
            rate = decayed(rates.sky, rates.sky_end, done)
            above = self._is_sky[loss.d_sky.texels]
            self._sky_adam.update(loss.d_sky.texels[above], loss.d_sky.grads[above], rate)
        if self.config.exposure:
            color_map = self.color_maps[camera.name]
            pull = self.config.exposure_pull * (color_map - _IDENTITY)
            self._map_adams[camera.name].update(
                loss.d_color_map + pull, rates.color_map * rates.late**done
            )
        if forces is not None:
            late = rates.late**done
            self.actor_poses.update(
                parts.numbers,
                parts.poses,
                forces,
                camera.timestamp_ns,
                rate_m=rates.actors * late,
                pull=self.config.pose_pull,
            )
            self.camera_poses.update(
                camera,
                parts.poses,
                forces,
                rate_px=rates.cameras * late,
                pull=self.config.pose_pull,
            )

    def _add_noise(self, inputs: Inputs, grads: SplatGradients) -> None:
        """Noise on the means of faint splats that the view shows."""
        config = self.config
        firsts = inputs.first_ids[inputs.blocks[:, 0]]
        rows = [
            first + grads.ids[block * BLOCK : block * BLOCK + count].astype(np.int64)
            for block, (first, count) in enumerate(zip(firsts, grads.counts, strict=True))
            if count > 0
        ]
        if not rows:
            return
        rng = rng_for(seed=config.seed, scene=self._scene.name, effect="fit.noise", frame=self.step)
        rates = config.rates
        decay = decayed(rates.means, rates.means_end, self._done) / (rates.means or 1.0)
        noise = config.densify.noise * decay
        add_noise(self.splats, np.concatenate(rows), noise, rng)

    def _densify(self) -> None:
        config = self.config
        if not densify_due(config.densify, self.step, config.steps):
            return
        rng = rng_for(
            seed=config.seed, scene=self._scene.name, effect="fit.densify", frame=self.step
        )
        self.splats, _ = densify(
            self.splats,
            config.densify,
            rng=rng,
            step=self.step,
            total_steps=config.steps,
            extent_m=self._extent_m,
        )


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
