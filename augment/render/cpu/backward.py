"""Gradients on the CPU: a render that records how it was made, and its backward pass.

    tape = record(inputs, camera, settings, scratch, with_depth=…)   rgb, alpha, expected_depth
    grads = tape.backward(d_rgb, d_alpha, d_expected_depth)          a row a touched Gaussian

The forward pass is that of `cpu.rasterize_cpu` in a single slice of z, so that every list entry
still exists when the backward pass needs it. Bits do not depend on the number of threads.
`rasterize` calls `rasterize_with_gradients`; the trainer and `prune` use the tape.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from augment.render.buffers import ALPHA, EXPECTED_DEPTH, RGB, RenderOutput
from augment.render.constants import DEPTH_EPS, RasterSettings
from augment.render.cpu import backward_kernels
from augment.render.cpu.blend import Frame, TileSplats
from augment.render.cpu.driver import (
    Inputs,
    Scratch,
    StageTimer,
    Tiles,
    gather_inputs,
    image_arrays,
    project,
    rank,
    sort,
)
from augment.render.cpu.project import Splats
from augment.render.layout import BLOCK_SIZE, RECORD, SPLAT_ID, V_EYE
from augment.render.sh import sh_basis
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, PosedGaussians

# Pieces of work in adding up shares.
_SUM_RANGES = 8


@dataclass(frozen=True, eq=False)
class SplatGradients:
    """dL of every Gaussian that the image shows, block by block (Inputs.blocks).

    Block b has counts[b] rows, from row b BLOCK_SIZE on. rows and ids live in the tape's scratch:
    its next use overwrites them.

    rows: float32 [B BLOCK_SIZE, NUM_GRADIENTS], columns as backward_kernels names them.
    ids: int32 [B BLOCK_SIZE], index of the Gaussian in its part.
    counts: int64 [B], rows of each block.
    blocks: int64 [B, 3], as in Inputs.
    """

    rows: np.ndarray
    ids: np.ndarray
    counts: np.ndarray
    blocks: np.ndarray


@dataclass(frozen=True, eq=False)
class Tape:
    """A finished render of one camera and the arrays that its gradients need.

    rgb [H, W, 3], alpha [H, W] and expected_depth [H, W] (or None) are float32, as in RenderOutput.
    All arrays live in the scratch that `record_render` was given.
    """

    inputs: Inputs
    camera: Camera
    rgb: np.ndarray
    alpha: np.ndarray
    expected_depth: np.ndarray | None
    splats: Splats
    tile_splats: TileSplats
    frame: Frame
    scratch: Scratch

    def backward(
        self,
        d_rgb: np.ndarray,
        d_alpha: np.ndarray,
        d_expected_depth: np.ndarray | None = None,
        *,
        timer: StageTimer | None = None,
    ) -> SplatGradients:
        """Return gradients of a loss with these derivatives by the images, all float32 and
        contiguous.
        """
        timer = StageTimer(None) if timer is None else timer
        depth = d_depth = None
        if self.expected_depth is not None and d_expected_depth is not None:
            alpha_floor = np.maximum(self.alpha, np.float32(DEPTH_EPS))
            depth = self.expected_depth * alpha_floor
            d_depth = d_expected_depth / alpha_floor
            is_covered = self.alpha > np.float32(DEPTH_EPS)
            d_alpha = d_alpha - np.where(is_covered, d_depth * self.expected_depth, np.float32(0))
        scratch = self.scratch
        inputs = self.inputs
        slots = inputs.num_slots
        blocks = len(inputs.blocks)
        rows = scratch.array("grads", (slots, backward_kernels.NUM_GRADIENTS), np.float32)
        ids = scratch.array("grad_ids", (slots,), np.int32)
        counts = scratch.array("grad_counts", (blocks,), np.int64)
        images = (self.rgb, self.alpha, depth, d_rgb, d_alpha, d_depth)
        slopes = backward_kernels.Slopes(*(None if i is None else i.reshape(-1) for i in images))
        with kernel_threads():
            sums, is_touched = self._sum_shares(slopes, timer)
            backward_kernels.project_backward(
                inputs.read, self.splats, is_touched, sums, rows.reshape(-1), ids, counts
            )
            timer.end_stage("project backward")
        return SplatGradients(rows, ids, counts, inputs.blocks)

    def sum_splat_effects(
        self, d_rgb: np.ndarray, d_alpha: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return numbers, summed weights and summed effects on alpha of the frame's splats.

        Returns:
            For every splat in the frame: its number, the sum of its weights times the loss's
            derivative by red, and the sum of its alphas times the loss's derivatives by them.
        """
        images = (self.rgb, self.alpha, None, d_rgb, d_alpha, None)
        slopes = backward_kernels.Slopes(*(None if i is None else i.reshape(-1) for i in images))
        with kernel_threads():
            sums, is_touched = self._sum_shares(slopes, StageTimer(None))
        is_filled = np.arange(BLOCK_SIZE) < self.splats.splat_counts[:, None]  # [B, BLOCK_SIZE]
        is_filled = is_filled.reshape(-1)
        records = self.splats.records.reshape(-1, RECORD)
        ids = records[is_filled, SPLAT_ID].view(np.int32)
        shares = sums.reshape(-1, backward_kernels.SHARE)[is_filled]
        shares[is_touched[is_filled] == 0] = 0  # these slots hold what the last use left
        by_log2 = shares[:, backward_kernels.S_0]
        return ids, shares[:, backward_kernels.S_RED], by_log2 / np.float32(math.log(2))

    def _sum_shares(
        self, slopes: backward_kernels.Slopes, timer: StageTimer
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the sums of all tiles' shares for every slot, and the slots that light reached."""
        scratch = self.scratch
        tile_splats = self.tile_splats
        slots = self.inputs.num_slots
        entries = len(tile_splats.tile_splat_ids)
        shares = scratch.array("shares", (entries * backward_kernels.SHARE,), np.float32)
        num_reached = scratch.array("reached", (len(tile_splats.tile_offsets) - 1,), np.int64)
        sums = scratch.array("sums", (slots * backward_kernels.SHARE,), np.float32)
        is_touched = scratch.array("touched", (slots,), np.uint8)
        backward_kernels.blend_backward(tile_splats, self.frame, slopes, shares, num_reached)
        timer.end_stage("raster backward")
        backward_kernels.sum_shares(
            tile_splats.tile_splat_ids,
            tile_splats.tile_offsets,
            num_reached,
            shares,
            _SUM_RANGES,
            sums,
            is_touched,
        )
        timer.end_stage("sum backward")
        return sums, is_touched


def record_render(
    inputs: Inputs,
    camera: Camera,
    settings: RasterSettings,
    scratch: Scratch,
    *,
    with_depth: bool,
    timer: StageTimer | None = None,
) -> Tape:
    """Render colour, alpha and, if asked for, expected depth, and keep the arrays of `backward`.

    Raises:
        ValueError: the camera is orthographic; the gradients are those of pinhole cameras.
    """
    if camera.is_orthographic:
        raise ValueError(
            f"camera {camera.name!r} is orthographic; the kernels' gradients are of pinhole "
            f"cameras only: use `rasterize` with backend 'auto' or 'reference'"
        )
    timer = StageTimer(None) if timer is None else timer
    buffers = frozenset({RGB, ALPHA, EXPECTED_DEPTH} if with_depth else {RGB, ALPHA})
    images = image_arrays(camera, buffers)
    with kernel_threads():
        tiles = Tiles(camera, images, settings, scratch)
        depths, edges = rank(inputs, camera, scratch)
        bins = (edges[0], edges[-1])
        splats = project(inputs, depths, bins, tiles, scratch)
        timer.end_stage("project")
        slots, rects = sort(splats, bins[0], scratch, is_ordered=inputs.is_ordered)
        timer.end_stage("sort")
        tile_splat_ids, tile_offsets = tiles.list_all(slots, rects)
        timer.end_stage("bin")
        timer.count("visible", len(slots))
        timer.count("pairs", len(tile_splat_ids))
        tile_splats = tiles.blend_lists(splats, tile_splat_ids, tile_offsets, is_last=True)
        timer.end_stage("raster")
    return Tape(
        inputs=inputs,
        camera=camera,
        rgb=images[RGB],
        alpha=images[ALPHA],
        expected_depth=images.get(EXPECTED_DEPTH),
        splats=splats,
        tile_splats=tile_splats,
        frame=tiles.frame,
        scratch=scratch,
    )


# ---- The CPU rasteriser as a torch operation: forward and backward through the kernels -----------
# Gradients reach means, quats, scales, opacities and sh of every part from rgb, alpha and expected
# depth. Camera and part poses get none: they are constants of the operation.

_FIELDS = ("means", "quats", "scales", "opacities", "sh")


def rasterize_with_gradients(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    buffers: frozenset[str],
    settings: RasterSettings,
) -> RenderOutput:
    """Return `cpu.rasterize_cpu` without fog, recorded by autograd.

    All splats are listed at once instead of slice by slice. So this takes more memory than a plain
    render: 48 bytes for every pair of a splat and a tile, kept until backward.

    buffers: some of DIFFERENTIABLE.
    """
    tensors = [getattr(part.gaussians, name) for part in parts for name in _FIELDS]
    arguments = _OperationArguments(tuple(parts), camera, settings, EXPECTED_DEPTH in buffers)
    rgb, alpha, depth = _Rasterize.apply(arguments, *tensors)
    images = {RGB: rgb, ALPHA: alpha, EXPECTED_DEPTH: depth}
    return RenderOutput(**{name: images[name] for name in buffers})


class _OperationArguments(NamedTuple):
    """Arguments of an operation besides its tensors."""

    parts: tuple[PosedGaussians, ...]
    camera: Camera
    settings: RasterSettings
    with_depth: bool


class _Rasterize(torch.autograd.Function):
    """The render as an autograd operation; its tensors are those of all parts, part by part."""

    @staticmethod
    def forward(
        ctx: Any, arguments: _OperationArguments, *tensors: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        parts = [
            PosedGaussians(
                Gaussians(**{n: t.detach() for n, t in zip(_FIELDS, part_tensors, strict=True)}),
                part.world_from_part,
                part.instance_id,
            )
            for part, part_tensors in zip(arguments.parts, _group_by_part(tensors), strict=True)
        ]
        inputs = gather_inputs(parts, arguments.camera, arguments.settings, None, with_color=True)
        tape = record_render(
            inputs, arguments.camera, arguments.settings, Scratch(), with_depth=arguments.with_depth
        )
        ctx.tape = tape
        ctx.arguments = arguments
        ctx.save_for_backward(*tensors)  # so that a change in place is noticed
        depth = np.zeros_like(tape.alpha) if tape.expected_depth is None else tape.expected_depth
        # Copies: the tape keeps its own images, whatever is done to these.
        return (
            torch.from_numpy(tape.rgb.copy()),
            torch.from_numpy(tape.alpha.copy()),
            torch.from_numpy(depth.copy()),
        )

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride] - torch's own way
        ctx: Any, d_rgb: Tensor, d_alpha: Tensor, d_depth: Tensor
    ) -> tuple[Any, ...]:
        tape: Tape = ctx.tape
        grads = tape.backward(
            d_rgb.contiguous().numpy(),
            d_alpha.contiguous().numpy(),
            d_depth.contiguous().numpy() if ctx.arguments.with_depth else None,
        )
        gradients: list[Tensor | None] = [None]
        for number, part_tensors in enumerate(_group_by_part(ctx.saved_tensors)):
            gradients += _part_gradients(
                grads, number, part_tensors, tape.inputs.views[number], ctx.arguments
            )
        return tuple(gradients)


def _group_by_part(tensors: Sequence[Tensor]) -> list[Sequence[Tensor]]:
    """Return the tensors of each part."""
    return [tensors[i : i + len(_FIELDS)] for i in range(0, len(tensors), len(_FIELDS))]


def _part_gradients(
    grads: SplatGradients,
    number: int,
    tensors: Sequence[Tensor],
    view: np.ndarray,
    arguments: _OperationArguments,
) -> list[Tensor]:
    """Return dense gradients of one part's five tensors; zero for splats that the image does not
    show.
    """
    blocks = np.flatnonzero(grads.blocks[:, 0] == number)
    block_rows = [np.arange(b * BLOCK_SIZE, b * BLOCK_SIZE + grads.counts[b]) for b in blocks]
    rows = np.concatenate(block_rows) if block_rows else np.zeros(0, np.int64)
    index = torch.from_numpy(grads.ids[rows].astype(np.int64))
    gradient_rows = torch.from_numpy(grads.rows[rows].copy())
    means, quats, scales, opacities, sh = (t.detach() for t in tensors)
    d_sh = torch.zeros_like(sh)
    degree = int(sh.shape[1] ** 0.5) - 1
    if arguments.settings.sh_degree is not None:
        degree = min(degree, arguments.settings.sh_degree)
    eye = torch.from_numpy(view[V_EYE : V_EYE + 3].copy())
    eye_remainder = torch.from_numpy(view[V_EYE + 3 : V_EYE + 6].copy())
    directions = torch.nn.functional.normalize(means[index] - eye - eye_remainder, dim=-1)
    basis = sh_basis(directions, degree)  # [M, K']
    color = gradient_rows[:, backward_kernels.G_COLOR : backward_kernels.G_COLOR + 3]
    d_sh[index, : basis.shape[1]] = basis[:, :, None] * color[:, None, :]
    d_quats = gradient_rows[:, backward_kernels.G_QUAT : backward_kernels.G_QUAT + 4]
    d_scales = (
        gradient_rows[:, backward_kernels.G_SCALE : backward_kernels.G_SCALE + 3] / scales[index]
    )
    d_opacities = gradient_rows[:, backward_kernels.G_OPACITY] / opacities[index]
    at_mean = backward_kernels.G_MEAN
    return [
        torch.zeros_like(means).index_copy(0, index, gradient_rows[:, at_mean : at_mean + 3]),
        torch.zeros_like(quats).index_copy(0, index, d_quats),
        torch.zeros_like(scales).index_copy(0, index, d_scales),
        torch.zeros_like(opacities).index_copy(0, index, d_opacities),
        d_sh,
    ]
