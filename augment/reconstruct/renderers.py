"""What renders the views of a fit: the CPU's kernels, or gsplat on a GPU; all else is the same."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from augment.cameras import Camera
from augment.reconstruct.splats import Splats
from augment.render.constants import RasterSettings
from augment.render.cpu import backward as cpu_backward
from augment.render.cpu import backward_kernels
from augment.render.cpu.backward import SplatGradients
from augment.render.cpu.driver import Inputs, Scratch
from augment.render.cuda import runtime
from augment.render.gsplat_backend import GsplatImages, draw_with_gsplat, import_gsplat
from augment.render.layout import BLOCK, M_FUNCTIONS
from augment.scene import Gaussians, PosedGaussians

# ---- Views of a fit rendered, and their gradients found, by gsplat on a GPU ----------------------
# The GPU holds a copy of all splats; what a step changed on the CPU, it is sent: the rows of the
# splats that the view showed. Back come the image and those splats' gradients. gsplat adds shares
# up in no fixed order, so a fit's bits do not repeat.

_FIELDS = ("means", "quats", "scales", "opacities", "sh")
_MIN_DET = 1e-30  # of a conic, px^-4


class GsplatRenderer:
    """See augment.reconstruct.renderers.FitRenderer.

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
        self,
        splats: Splats,
        inputs: Inputs,
        poses: np.ndarray,
        camera: Camera,
        settings: RasterSettings,
        *,
        with_depth: bool,
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
            settings,
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
    """See augment.reconstruct.renderers.ViewTape. leaves: what gsplat was given, by name."""

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


DEVICES = ("cpu", "cuda")


@runtime_checkable
class ViewTape(Protocol):
    """A finished render and what its gradients take; see augment.render.cpu.backward.Tape."""

    @property
    def inputs(self) -> Inputs: ...
    @property
    def rgb(self) -> np.ndarray: ...
    @property
    def alpha(self) -> np.ndarray: ...
    @property
    def expected_depth(self) -> np.ndarray | None: ...

    def backward(
        self, d_rgb: np.ndarray, d_alpha: np.ndarray, d_expected_depth: np.ndarray | None = None
    ) -> SplatGradients: ...


@runtime_checkable
class FitRenderer(Protocol):
    """Renders the splats that are fitted, so that the loss can be followed back to them.

    A tape holds until the next render. Splats may be changed in place between two renders, but
    those only whose gradients the last tape told.
    """

    def record(
        self,
        splats: Splats,
        inputs: Inputs,
        poses: np.ndarray,
        camera: Camera,
        settings: RasterSettings,
        *,
        with_depth: bool,
    ) -> ViewTape:
        """inputs: of these splats (augment.reconstruct.trainer); poses: world_from_part of their
        parts, float64 [P, 4, 4].
        """
        ...


class CpuRenderer:
    """The kernels of augment.render.cpu.backward; the same bits for any number of threads."""

    def __init__(self) -> None:
        self._scratch = Scratch()

    def record(
        self,
        splats: Splats,
        inputs: Inputs,
        poses: np.ndarray,
        camera: Camera,
        settings: RasterSettings,
        *,
        with_depth: bool,
    ) -> ViewTape:
        return cpu_backward.record(inputs, camera, settings, self._scratch, with_depth=with_depth)


def fit_renderer(device: str) -> FitRenderer:
    """device: one of DEVICES.

    Raises:
        BackendUnavailable: there is no such device, or gsplat is not installed.
        ValueError: another name.
    """
    if device == "cpu":
        return CpuRenderer()
    if device != "cuda":
        raise ValueError(f"device must be one of {', '.join(DEVICES)}; got {device!r}")

    return GsplatRenderer()
