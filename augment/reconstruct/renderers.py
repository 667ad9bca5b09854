"""What renders the views of a fit: the CPU's kernels, or gsplat on a GPU; all else is the same."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from augment.cameras import Camera
from augment.reconstruct.splats import Splats
from augment.render import cpu_backward
from augment.render.constants import RasterSettings
from augment.render.cpu_backward import SplatGradients
from augment.render.cpu_inputs import Inputs
from augment.render.cpu_scratch import Scratch

DEVICES = ("cpu", "cuda")


@runtime_checkable
class ViewTape(Protocol):
    """A finished render and what its gradients take; see augment.render.cpu_backward.Tape."""

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
        """inputs: of these splats (augment.reconstruct.inputs); poses: world_from_part of their
        parts, float64 [P, 4, 4].
        """
        ...


class CpuRenderer:
    """The kernels of augment.render.cpu_backward; the same bits for any number of threads."""

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
    from augment.reconstruct.gsplat_renderer import GsplatRenderer

    return GsplatRenderer()
