"""Records of one rendered view, and the interface of the functions that render one.

`WeatheredBuffers` holds float tensors, `WeatheredView` arrays as files hold them. A `Renderer`
returns the latter or a stand-in for it, a `ViewResult`, which `check_view` checks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from augment import effects
from augment.effects.effect import LabelInputs
from augment.output.layout import TRUST
from augment.render.buffers import RenderOutput
from augment.scene.cameras import Camera
from augment.scene.scene import PosedGaussians, Scene
from augment.view.plan import ViewPlan
from recipes.schema import Recipe

# ---- Records -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class BareBuffers:
    """Buffers of the scene without what effects laid on it (snow, for example)."""

    raster: RenderOutput
    """Buffers of the bare surfaces, without colours."""
    depth_m: Float[Tensor, "H W"] | None
    """z of the bare surfaces, metres, 0 where there is none; None unless planned."""
    parts: tuple[PosedGaussians, ...]
    """The rendered parts, in the order in which splat_ids count their splats."""


@dataclass(frozen=True, eq=False)
class WeatheredBuffers:
    """One finished view as float tensors."""

    camera: Camera
    """The camera of the view, at the rendered resolution."""
    rgb: Float[Tensor, "H W 3"]
    """The picture: display-encoded, not clamped, sky included."""
    raster: RenderOutput
    """Buffers of the scene's surfaces, snow included. With water in view they are those under the
    water, too, and without colours."""
    depth_m: Float[Tensor, "H W"] | None
    """z of the scene's surface, metres, 0 where there is none; None unless planned."""
    parts: tuple[PosedGaussians, ...]
    """The rendered parts, in the order in which splat_ids count their splats."""
    plan: ViewPlan
    """The passes that were carried out."""
    masks: Mapping[str, Bool[Tensor, "H W"]] = field(default_factory=dict)
    """Pixels that show an effect, by the effect's mask name; only effects that can be in view."""
    bare_buffers: BareBuffers | None = None
    """Buffers of the scene without what lies on it; None unless planned."""
    luminance_cd_m2: Float[Tensor, "H W"] | None = None
    """Luminance of the picture, for labels; None unless an effect measures it."""


@dataclass(frozen=True, eq=False)
class LabelSurfaces:
    """Surfaces of one view that labels are measured from.

    Depths are float32 [H, W], z in metres, 0 = none.
    """

    depth_m: np.ndarray
    """Depth of the first solid surface: snow counts, water does not."""
    actor_instance: np.ndarray | None
    """Instance image of those surfaces, uint16 [H, W], actors only; None where there is none."""
    instance_depth_m: np.ndarray | None
    """Depth of the surfaces that the view's instance image shows; None without one."""
    instance_classes: np.ndarray | None
    """Classes of the surfaces that the view's instance image shows; None without one."""
    is_bare: bool
    """If True, `instance_depth_m` and `instance_classes` are without what lies on the scene."""
    classes: np.ndarray | None = None
    """Classes of the surfaces of `depth_m`, uint8 [H, W]; None where no image shows them."""
    own_car: np.ndarray | None = None
    """Pixels of a recorded picture that show the recording car, of which the scene has no surfaces,
    bool [H, W]; None where it shows none."""


@dataclass(frozen=True, eq=False)
class WeatheredView:
    """One finished view as it is written to files."""

    camera: Camera
    """The camera of the view, at the rendered resolution."""
    rgb: np.ndarray
    """The picture, uint8 [H, W, 3]."""
    depth_m: np.ndarray | None
    """Depth, float32 [H, W], metres, 0 = none; None unless planned."""
    semantic: np.ndarray | None
    """SemanticClass of each pixel, uint8 [H, W]; None unless planned."""
    instance: np.ndarray | None
    """Instance of each pixel, uint16 [H, W]: 0 = background or sky, else 1 + the actor's index in
    the scene (`augment.view.box_labels.label_view` adds boxes without an actor)."""
    masks: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Masks by name, uint8 [H, W]: 255 where the pixel shows the effect, else 0; TRUST holds 0 to
    255."""
    effects: Mapping[str, LabelInputs] = field(default_factory=dict)
    """Inputs of the effects' own labels, for every effect that the recipe has, by name."""
    surface: LabelSurfaces | None = None
    """Surfaces that boxes are measured from; None where nobody asks for boxes."""


class PendingView:
    """A view that was begun.

    On a GPU it may still be computed; other backends have finished it.
    """

    def __init__(self, finish: Callable[[], WeatheredView]) -> None:
        self._finish: Callable[[], WeatheredView] | None = finish
        self._view: WeatheredView | None = None

    def result(self) -> WeatheredView:
        """Return the finished view, the same one at every call, and wait for it where needed.

        Only one thread at a time may call this.
        """
        if self._finish is not None:
            self._view = self._finish()
            self._finish = None
        assert self._view is not None
        return self._view


# ---- The interface of a renderer -----------------------------------------------------------------


@runtime_checkable
class Renderer(Protocol):
    """Function that renders an image: `render_view`, `begin_view`, or a stand-in.

    It returns a ViewResult, or a pending one; in the second case a job begins the next view before
    it waits.
    """

    def __call__(self, scene: Scene, camera: Camera, recipe: Recipe, *, backend: str) -> Any: ...


@runtime_checkable
class Pending(Protocol):
    """View whose rendering has begun; `PendingView` is one."""

    def result(self) -> Any: ...


@runtime_checkable
class ViewResult(Protocol):
    """Result of a renderer, a dataclass: `WeatheredView` or a stand-in."""

    rgb: np.ndarray  # uint8 [H, W, 3]
    depth_m: np.ndarray | None  # float32 [H, W], 0 = none
    semantic: np.ndarray | None  # uint8 [H, W]
    instance: np.ndarray | None  # uint16 [H, W]
    masks: Mapping[str, np.ndarray]  # uint8 [H, W], by name: 0 or 255, of TRUST also between
    # The data that labels are measured from, as in WeatheredView.
    effects: Mapping[str, Any]  # LabelInputs by name, of the recipe's effects
    surface: Any  # LabelSurfaces, None without boxes


def check_view(view: ViewResult, camera: Camera, recipe: Recipe) -> None:
    """Raise ValueError unless the view has the size and the buffers that the recipe asks for.

    Args:
        camera: Camera at the written resolution.
    """
    present_effects = [
        effect for effect in effects.EFFECTS if effect.section_of(recipe) is not None
    ]
    effect_names = {effect.name for effect in present_effects}
    measured_names = {effect.name for effect in present_effects if effect.box_table is not None}
    if not measured_names <= set(view.effects) <= effect_names:
        raise ValueError(
            f"the renderer returned what labels of "
            f"{', '.join(sorted(view.effects)) or 'no effect'} are measured from, for a recipe "
            f"with {', '.join(sorted(effect_names)) or 'no effect'}"
        )
    output = recipe.output
    masks = {e.mask_name for e in effects.EFFECTS if e.name in effect_names}
    masks |= {TRUST} if output.trust else set()
    is_requested = {
        "rgb": True,
        "depth_m": output.depth != "none",
        "semantic": output.semantic,
        "instance": output.instance,
        **dict.fromkeys(masks - {None} | set(view.masks), True),
    }
    is_requested |= dict.fromkeys(set(view.masks) - masks, False)
    for name, is_needed in is_requested.items():
        buffer: Any = view.masks.get(name, getattr(view, name, None))
        if (buffer is not None) != is_needed:
            raise ValueError(
                f"the renderer returned {'no' if is_needed else 'a'} {name} buffer, which the "
                f"recipe {'asks' if is_needed else 'does not ask'} for"
            )
        if is_needed and buffer.shape[:2] != (camera.height, camera.width):
            raise ValueError(
                f"the renderer returned {name} of {list(buffer.shape)}; camera {camera.name!r} "
                f"writes {camera.height} rows of {camera.width} pixels"
            )
