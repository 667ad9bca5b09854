"""The CPU rasteriser as a torch operation: forward and backward through the kernels.

Gradients reach means, quats, scales, opacities and sh of every part from rgb, alpha and expected
depth. Camera and part poses get none: they are constants of the operation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.cameras import Camera
from augment.render import cpu_backward
from augment.render import cpu_project_backward as rows
from augment.render.buffers import ALPHA, EXPECTED_DEPTH, RGB, RenderOutput
from augment.render.constants import RasterSettings
from augment.render.cpu_inputs import gather_inputs
from augment.render.cpu_scratch import Scratch
from augment.render.layout import BLOCK, V_EYE
from augment.render.sh import sh_basis
from augment.scene import Gaussians, PosedGaussians

_FIELDS = ("means", "quats", "scales", "opacities", "sh")


def rasterize_with_gradients(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    buffers: frozenset[str],
    settings: RasterSettings,
) -> RenderOutput:
    """As `cpu.rasterize_cpu` without smog, recorded by autograd. buffers: some of DIFFERENTIABLE.

    All splats are listed at once instead of slice by slice, so this takes more memory than a plain
    render: 48 bytes for every pair of a splat and a tile, kept until backward.
    """
    tensors = [getattr(part.gaussians, name) for part in parts for name in _FIELDS]
    setting = _Setting(tuple(parts), camera, settings, EXPECTED_DEPTH in buffers)
    rgb, alpha, depth = _Rasterize.apply(setting, *tensors)
    images = {RGB: rgb, ALPHA: alpha, EXPECTED_DEPTH: depth}
    return RenderOutput(**{name: images[name] for name in buffers})


class _Setting:
    """What an operation is told besides its tensors."""

    def __init__(
        self,
        parts: tuple[PosedGaussians, ...],
        camera: Camera,
        settings: RasterSettings,
        with_depth: bool,
    ) -> None:
        self.parts = parts
        self.camera = camera
        self.settings = settings
        self.with_depth = with_depth


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, setting: _Setting, *tensors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        parts = [
            PosedGaussians(
                Gaussians(**{n: t.detach() for n, t in zip(_FIELDS, own, strict=True)}),
                part.world_from_part,
                part.instance_id,
            )
            for part, own in zip(setting.parts, _groups(tensors), strict=True)
        ]
        inputs = gather_inputs(parts, setting.camera, setting.settings, None, with_color=True)
        tape = cpu_backward.record(
            inputs, setting.camera, setting.settings, Scratch(), with_depth=setting.with_depth
        )
        ctx.tape, ctx.setting = tape, setting
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
        tape: cpu_backward.Tape = ctx.tape
        grads = tape.backward(
            d_rgb.contiguous().numpy(),
            d_alpha.contiguous().numpy(),
            d_depth.contiguous().numpy() if ctx.setting.with_depth else None,
        )
        out: list[Tensor | None] = [None]
        for number, own in enumerate(_groups(ctx.saved_tensors)):
            out += _part_gradients(grads, number, own, tape.inputs.views[number], ctx.setting)
        return tuple(out)


def _groups(tensors: Sequence[Tensor]) -> list[Sequence[Tensor]]:
    return [tensors[i : i + len(_FIELDS)] for i in range(0, len(tensors), len(_FIELDS))]


def _part_gradients(
    grads: cpu_backward.SplatGradients,
    number: int,
    tensors: Sequence[Tensor],
    view: np.ndarray,
    setting: _Setting,
) -> list[Tensor]:
    """Dense gradients of one part's five tensors; zero where the image shows nothing of a splat."""
    blocks = np.flatnonzero(grads.blocks[:, 0] == number)
    used = [np.arange(b * BLOCK, b * BLOCK + grads.counts[b]) for b in blocks]
    at = np.concatenate(used) if used else np.zeros(0, np.int64)
    index = torch.from_numpy(grads.ids[at].astype(np.int64))
    own = torch.from_numpy(grads.rows[at].copy())
    means, quats, scales, opacities, sh = (t.detach() for t in tensors)
    d_sh = torch.zeros_like(sh)
    degree = int(sh.shape[1] ** 0.5) - 1
    if setting.settings.sh_degree is not None:
        degree = min(degree, setting.settings.sh_degree)
    eye = torch.from_numpy(view[V_EYE : V_EYE + 3].copy())
    rest = torch.from_numpy(view[V_EYE + 3 : V_EYE + 6].copy())
    directions = torch.nn.functional.normalize(means[index] - eye - rest, dim=-1)
    basis = sh_basis(directions, degree)  # [M, K']
    color = own[:, rows.G_COLOR : rows.G_COLOR + 3]
    d_sh[index, : basis.shape[1]] = basis[:, :, None] * color[:, None, :]
    d_quats = own[:, rows.G_QUAT : rows.G_QUAT + 4]
    d_scales = own[:, rows.G_SCALE : rows.G_SCALE + 3] / scales[index]
    d_opacities = own[:, rows.G_OPACITY] / opacities[index]
    return [
        torch.zeros_like(means).index_copy(0, index, own[:, rows.G_MEAN : rows.G_MEAN + 3]),
        torch.zeros_like(quats).index_copy(0, index, d_quats),
        torch.zeros_like(scales).index_copy(0, index, d_scales),
        torch.zeros_like(opacities).index_copy(0, index, d_opacities),
        d_sh,
    ]
