"""What one view of a scene in its weather consists of: buffers in floats, and what is written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from augment.cameras import Camera
from augment.render.buffers import RenderOutput
from augment.scene import PosedGaussians
from augment.view_plan import ViewPlan
from augment.weather.smog import SmogMedium

SURFACE_ALPHA = 0.5  # a pixel less covered than this shows more sky than surface: it has no depth


@dataclass(frozen=True, eq=False)
class BareBuffers:
    """What images show of a scene without its snow: see the same fields of WeatheredBuffers."""

    raster: RenderOutput
    depth_m: Float[Tensor, "H W"] | None
    parts: tuple[PosedGaussians, ...]


@dataclass(frozen=True, eq=False)
class WeatheredBuffers:
    """One finished view in floats. rgb [H, W, 3]: display-encoded, not clamped, sky included.

    raster: the buffers of the scene's surfaces; with water in view, of those under it too, without
    colours. depth_m [H, W]: z along the optical axis of the scene's surface, 0 where there is none;
    None unless planned. water [H, W]: where a ray meets water first; None where no water is in
    view. snow [H, W]: where snow is what the pixel shows; None where none can be in view; it is a
    surface of the scene for raster, depth_m and parts. bare: the scene without it, if planned.
    parts: those drawn, by which splat_ids count. view: what of the plan was carried out.
    """

    camera: Camera
    rgb: Float[Tensor, "H W 3"]
    raster: RenderOutput
    depth_m: Float[Tensor, "H W"] | None
    parts: tuple[PosedGaussians, ...]
    view: ViewPlan
    water: Bool[Tensor, "H W"] | None = None
    snow: Bool[Tensor, "H W"] | None = None
    bare: BareBuffers | None = None


@dataclass(frozen=True, eq=False)
class FloodedView:
    """What a view's labels under water are measured from.

    level_z_m: the water's surface, scene world. scene_depth_m: float32 [H, W], z of the scene's own
    surface, seen through the water where there is some; 0 = none. None where no water is in
    view, or no label needs it.
    """

    level_z_m: float
    scene_depth_m: np.ndarray | None


@dataclass(frozen=True, eq=False)
class SnowyView:
    """What a view's labels in the snow are measured from.

    surface_depth_m: float32 [H, W], z of the first solid surface, snow included; 0 = none. None
    where no snow is in view, or no label needs it. thickness_m: the layer's depth.
    """

    surface_depth_m: np.ndarray | None
    thickness_m: float


@dataclass(frozen=True, eq=False)
class SmoggyView:
    """What the labels in a view's smog are measured from.

    medium: None where the recipe's smog has no density. surface_depth_m: float32 [H, W], z of the
    surface that is seen through the smog, snow included and water not; 0 = none. None where no
    label needs it. water_level_z_m: of the flood, scene world; None where none is drawn.
    """

    medium: SmogMedium | None
    surface_depth_m: np.ndarray | None
    water_level_z_m: float | None


@dataclass(frozen=True, eq=False)
class SurfaceView:
    """What the labelled boxes in a view are found by.

    depth_m: float32 [H, W], z of the first solid surface, snow included and water not; 0 = none.
    snow_m: the snow's depth, 0 where none is in view. actors: uint16 [H, W], the instance image of
    those surfaces, which knows of actors only; None where there is none. shown_depth_m,
    shown_classes, shown_snow_m: likewise of the surfaces that the view's instance image shows; None
    without one.
    """

    depth_m: np.ndarray
    snow_m: float
    actors: np.ndarray | None
    shown_depth_m: np.ndarray | None
    shown_classes: np.ndarray | None
    shown_snow_m: float


@dataclass(frozen=True, eq=False)
class WeatheredView:
    """One finished view as it is written to files.

    rgb: uint8 [H, W, 3]. depth_m: float32 [H, W], 0 = none. semantic: uint8 [H, W], SemanticClass.
    instance: uint16 [H, W], 0 = background or sky, else 1 + the actor's index in the scene; what is
    written has boxes without an actor, too (`augment.batch.box_weather.label_view`).
    water: uint8 [H, W], 255 where a ray meets water first, else 0; None where the recipe has no
    flood. flood: None where the recipe has no flood. snow: uint8 [H, W], 255 where snow is what the
    pixel shows, else 0. snow, snowy: None where the recipe has no snow. smoggy: None where it has
    no smog. surface: None where nobody asks for boxes.
    """

    camera: Camera
    rgb: np.ndarray
    depth_m: np.ndarray | None
    semantic: np.ndarray | None
    instance: np.ndarray | None
    water: np.ndarray | None = None
    flood: FloodedView | None = None
    snow: np.ndarray | None = None
    snowy: SnowyView | None = None
    smoggy: SmoggyView | None = None
    surface: SurfaceView | None = None


class PendingView:
    """A view that is under way. On a GPU it has been begun and nobody has waited for it yet; other
    backends have finished it.
    """

    def __init__(self, finish: Callable[[], WeatheredView]) -> None:
        self._finish: Callable[[], WeatheredView] | None = finish
        self._view: WeatheredView | None = None

    def result(self) -> WeatheredView:
        """The view, once it is there; the same one every time. Of one thread at a time."""
        if self._finish is not None:
            self._view, self._finish = self._finish(), None
        assert self._view is not None
        return self._view
