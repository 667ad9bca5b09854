"""Gradients on the CPU: a render that remembers how it was made, and the way back.

    tape = record(inputs, camera, settings, scratch, with_depth=…)   rgb, alpha, expected_depth
    grads = tape.backward(d_rgb, d_alpha, d_expected_depth)          a row a touched Gaussian

The forward pass is `cpu.rasterize_cpu` in a single slice of z, so that every list entry is still
there when the way back needs it. Bits do not depend on the number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from augment.cameras import Camera
from augment.render import cpu_blend_backward, cpu_project_backward
from augment.render.buffers import ALPHA, EXPECTED_DEPTH, RGB
from augment.render.constants import DEPTH_EPS, RasterSettings
from augment.render.cpu import Clock, Tiles, image_arrays, project, rank, sort
from augment.render.cpu_inputs import Inputs
from augment.render.cpu_scratch import Scratch
from augment.render.threads import kernel_threads

_RANGES = 8  # pieces of work in adding up shares


@dataclass(frozen=True, eq=False)
class SplatGradients:
    """dL of every Gaussian that the image shows, block by block (Inputs.blocks).

    Block b has counts[b] rows, from row b BLOCK on. rows: float32 [B BLOCK, GRAD], columns as
    cpu_project_backward names them. ids: int32 [B BLOCK], index of the Gaussian in its part.
    Both live in the tape's scratch: they are overwritten by its next use.
    """

    rows: np.ndarray
    ids: np.ndarray
    counts: np.ndarray
    blocks: np.ndarray


@dataclass(frozen=True, eq=False)
class Tape:
    """A finished render of one camera and what its gradients take.

    rgb [H, W, 3], alpha [H, W], expected_depth [H, W] or None: float32, as RenderOutput's. All
    arrays live in the scratch that `record` was given.
    """

    inputs: Inputs
    camera: Camera
    rgb: np.ndarray
    alpha: np.ndarray
    expected_depth: np.ndarray | None
    records: np.ndarray
    found: np.ndarray
    members: np.ndarray
    starts: np.ndarray
    size: np.ndarray
    limits: np.ndarray
    scratch: Scratch

    def backward(
        self,
        d_rgb: np.ndarray,
        d_alpha: np.ndarray,
        d_expected_depth: np.ndarray | None = None,
        *,
        clock: Clock | None = None,
    ) -> SplatGradients:
        """Gradients of a loss with these derivatives by the images, all float32, contiguous."""
        clock = Clock(None) if clock is None else clock
        depth = d_depth = None
        if self.expected_depth is not None and d_expected_depth is not None:
            weight = np.maximum(self.alpha, np.float32(DEPTH_EPS))
            depth = self.expected_depth * weight
            d_depth = d_expected_depth / weight
            inside = self.alpha > np.float32(DEPTH_EPS)
            d_alpha = d_alpha - np.where(inside, d_depth * self.expected_depth, np.float32(0))
        scratch, inputs = self.scratch, self.inputs
        entries, slots, blocks = len(self.members), inputs.slots, len(inputs.blocks)
        shares = scratch.array("shares", (entries * cpu_blend_backward.SHARE,), np.float32)
        reached = scratch.array("reached", (len(self.starts) - 1,), np.int64)
        sums = scratch.array("sums", (slots * cpu_blend_backward.SHARE,), np.float32)
        touched = scratch.array("touched", (slots,), np.uint8)
        rows = scratch.array("grads", (slots, cpu_project_backward.GRAD), np.float32)
        ids = scratch.array("grad_ids", (slots,), np.int32)
        counts = scratch.array("grad_counts", (blocks,), np.int64)
        with kernel_threads():
            cpu_blend_backward.blend_backward(
                self.records,
                self.members,
                self.starts,
                self.size,
                self.limits,
                self.rgb.reshape(-1),
                self.alpha.reshape(-1),
                None if depth is None else depth.reshape(-1),
                d_rgb.reshape(-1),
                d_alpha.reshape(-1),
                None if d_depth is None else d_depth.reshape(-1),
                shares,
                reached,
            )
            clock.lap("raster backward")
            cpu_blend_backward.sum_shares(
                self.members, self.starts, reached, shares, _RANGES, sums, touched
            )
            clock.lap("sum backward")
            cpu_project_backward.project_backward(
                inputs.addresses,
                inputs.sizes,
                inputs.views,
                inputs.blocks,
                inputs.first_ids,
                self.found,
                touched,
                inputs.modes,
                self.records,
                sums,
                rows.reshape(-1),
                ids,
                counts,
            )
            clock.lap("project backward")
        return SplatGradients(rows, ids, counts, inputs.blocks)


def record(
    inputs: Inputs,
    camera: Camera,
    settings: RasterSettings,
    scratch: Scratch,
    *,
    with_depth: bool,
    clock: Clock | None = None,
) -> Tape:
    """Render colour, alpha and, if asked for, expected depth, and keep what `backward` needs.

    Raises:
        ValueError: the camera is orthographic; the way back knows pinhole cameras only.
    """
    if camera.is_orthographic:
        raise ValueError(
            f"camera {camera.name!r} is orthographic; the kernels' gradients are of pinhole "
            f"cameras only: use `rasterize` with backend 'auto' or 'reference'"
        )
    clock = Clock(None) if clock is None else clock
    buffers = frozenset({RGB, ALPHA, EXPECTED_DEPTH} if with_depth else {RGB, ALPHA})
    images = image_arrays(camera, buffers)
    with kernel_threads():
        tiles = Tiles(camera, images, settings, scratch)
        depths, edges = rank(inputs, camera, scratch)
        bins = (edges[0], edges[-1])
        splats = project(inputs, depths, bins, tiles, scratch)
        clock.lap("project")
        slots, rects = sort(splats, bins[0], scratch)
        clock.lap("sort")
        members, starts = tiles.list_all(slots, rects)
        clock.lap("bin")
        clock.count("visible", len(slots))
        clock.count("pairs", len(members))
        tiles.blend_members(splats, members, starts, is_last=True)
        clock.lap("raster")
    return Tape(
        inputs=inputs,
        camera=camera,
        rgb=images[RGB],
        alpha=images[ALPHA],
        expected_depth=images.get(EXPECTED_DEPTH),
        records=splats.records,
        found=splats.found,
        members=members,
        starts=starts,
        size=tiles.size,
        limits=tiles.limits,
        scratch=scratch,
    )
