"""What an effect is: one class says all that the rest of the package asks of it.

`augment.effects.EFFECTS` lists the effects in the order in which they are applied. Planning and
`explain`, rendering, warm-up, jobs, label tables, datasets and LiDAR walk that tuple and know none
of them by name. The recipe's side (its model, manifest columns and knobs) is a
`recipes.effect.EffectModel`. docs/effects.md shows how to add one.

    once a recipe and scene    place            facts, with a reason for every pass
    once a scene               prepare, relight, share
    once a view                cameras, in_view, edit_scene, draw, edit_image, mask_of,
                               front_surface
    labels of a view           measure, grow_boxes, table
    once a sweep               meet, attenuate
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from torch import Tensor

from augment.boxes import PlacedBoxes
from augment.cameras import Camera
from augment.drawing import LayerRenderer
from augment.jobs.box_tables import BoxTable
from augment.render.buffers import RenderOutput
from augment.scene import Scene
from recipes.effect import EffectModel
from recipes.fields import found
from recipes.schema import Recipe

# When a pass runs: as the scene is put together, as it is drawn, on the finished picture.
SCENE, DRAWING, PICTURE = STAGES = ("scene", "drawing", "picture")


@dataclass(frozen=True)
class Step:
    """One possible pass. why: the reason it runs, or the reason it does not."""

    name: str
    runs: bool
    why: str
    stage: str = DRAWING


def skipped(names: Sequence[str], why: str, stage: str = DRAWING) -> tuple[Step, ...]:
    """Passes none of which runs."""
    return tuple(Step(name, False, why, stage) for name in names)


@dataclass(frozen=True)
class Placed:
    """An effect of a recipe in a scene, in plain facts that can be printed, compared and tested.

    data: what drawing takes; None where the effect changes nothing. steps: every pass considered,
    also those of an effect that the recipe lacks. buffers: asked of the rasteriser for the
    effect's own sake. water_level_z_m: of water that it puts into the scene, scene world.
    """

    data: Any
    steps: tuple[Step, ...]
    buffers: frozenset[str] = frozenset()
    water_level_z_m: float | None = None


@dataclass(frozen=True, eq=False)
class Active:
    """An effect at work in a scene. earlier: those that are applied before it. seen: what
    `Effect.in_view` found of it in one view.
    """

    effect: Effect
    data: Any
    scene: Scene
    backend: str
    earlier: tuple[Active, ...] = ()
    seen: Any = None

    @cached_property
    def prepared(self) -> Any:
        """What `Effect.prepare` gives."""
        return self.effect.prepare(self)

    @cached_property
    def light(self) -> Scene:
        """The scene that the effect takes its light from: as earlier effects have left it."""
        relit = (other.effect.relight(other) for other in reversed(self.earlier))
        return next((scene for scene in relit if scene is not None), self.scene)


@dataclass(frozen=True, eq=False)
class Sharing:
    """What a job will render. cameras: all that a camera path has, or None for the scene's: never a
    selection, so that no image depends on what else is rendered. folder: for what lies in files,
    which later jobs find; None to keep it in memory. backend: that renders the images. progress:
    bars on stderr.
    """

    scene: Scene
    recipes: Sequence[Recipe]
    cameras: Sequence[Camera] | None = None
    folder: Path | None = None
    backend: str = "auto"
    progress: bool = False


@dataclass(frozen=True)
class Sight:
    """What can be seen of a scene in one view. cameras: that look into it, between them. poses:
    world_from_part of the parts that exist, by instance id, the background's (0) included.
    """

    camera: Camera
    cameras: tuple[Camera, ...]
    poses: Mapping[int, np.ndarray]
    near_m: float


@dataclass(frozen=True)
class InView:
    """What a camera can see of an effect. skipped: reasons by the passes that it saves. owners:
    instance ids of the parts that must be drawn for it. seen: whatever the other hooks of the view
    want to know.
    """

    is_seen: bool = True
    skipped: Mapping[str, str] = field(default_factory=dict)
    owners: frozenset[int] = frozenset()
    seen: Any = None


@dataclass(frozen=True, eq=False)
class Drawn:
    """A picture. rgb: display-encoded, not clamped, sky included. raster: buffers of the scene's
    surfaces. layers: what was drawn, with its fog. masks: bool, by name. skipped: reasons by the
    passes that drawing found needless.
    """

    rgb: Float[Tensor, "H W 3"]
    raster: RenderOutput
    layers: LayerRenderer
    masks: Mapping[str, Bool[Tensor, "H W"]] = field(default_factory=dict)
    skipped: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class FrontSurface:
    """A surface before the scene's, which images of what a ray meets first show in its mask's
    pixels. semantic: its class. depth_m: z, metres; None where it has none.
    """

    semantic: int
    depth_m: Float[Tensor, "H W"] | None


@dataclass(frozen=True, eq=False)
class EffectView:
    """What an effect's labels are measured from. placed: by the recipe. depth_m: z of the first
    solid surface, metres, 0 = none; None where the effect does nothing or no label needs it. mask:
    255 where the effect is what the pixel shows; None where none of it can be in view.
    water_level_z_m: of water that is drawn, scene world.
    """

    placed: Placed
    depth_m: Float32[np.ndarray, "H W"] | None
    mask: UInt8[np.ndarray, "H W"] | None
    water_level_z_m: float | None


class Effect:
    """One effect; hooks that are not overridden leave things as they are.

    name: one word. section: dotted path of its part of a recipe, whose model is `model`. mask: name
    of its mask image and file. is_see_through: other effects' masks keep the pixels of its own.
    share_column: of the manifest, for the share of an image's pixels in its mask. table: of what it
    does to labelled boxes. lies_on_scene: it adds surfaces to the scene, as overlays
    (PosedGaussians.is_overlay), which output.surface = "scene" leaves out. shares_files: what it
    shares is large, takes long and lies in files. draws: those of its passes that run the
    rasteriser. folded: what turns off a pass that runs inside the
    rasteriser, by its name: dotted path of a field, and its value.
    """

    name: ClassVar[str]
    section: ClassVar[str]
    model: ClassVar[type[EffectModel]]
    mask: ClassVar[str | None] = None
    is_see_through: ClassVar[bool] = False
    share_column: ClassVar[str | None] = None
    table: ClassVar[BoxTable | None] = None
    lies_on_scene: ClassVar[bool] = False
    shares_files: ClassVar[bool] = False
    draws: ClassVar[tuple[str, ...]] = ()
    folded: ClassVar[Mapping[str, tuple[str, Any]]] = {}

    def of(self, recipe: Recipe) -> Any:
        """Its section of the recipe, or None."""
        return found(recipe, self.section)

    # ---- Once a recipe and scene, once a scene ---------------------------------------------------

    def reads_splats(self, recipe: Recipe) -> bool:
        """Whether it works with the background's numbers: a large scene is read whole for it."""
        return self.of(recipe) is not None

    def kernels(self, section: Any) -> Hashable:
        """What of its section chooses the kernels that are compiled; None where nothing does."""
        return None

    def place(self, recipe: Recipe, scene: Scene, later: Mapping[str, Placed]) -> Placed:
        """The effect in the scene's heights and scale. later: effects that are applied after it.

        Raises:
            SceneError: the scene does not know a fact that the effect needs.
        """
        raise NotImplementedError

    def prepare(self, own: Active) -> Any:
        """What all views share; kept in `augment.memo.memo_of(own.scene)`."""
        return None

    def relight(self, own: Active) -> Scene | None:
        """A scene with the light that later effects find, or None where it is as before."""
        return None

    def share(self, job: Sharing) -> None:
        """Prepare what a job's processes would otherwise each work out, and `put` it into the
        scene's memo as shared.
        """

    # ---- Once a view -----------------------------------------------------------------------------

    def cameras(self, own: Active, camera: Camera) -> tuple[Camera, ...] | None:
        """Those that look into the scene for this view; None where it is the camera alone."""
        return None

    def in_view(self, own: Active, sight: Sight) -> InView:
        """What of the effect the view can show, at little cost; no bit of a picture may change."""
        return InView()

    def edit_scene(self, own: Active, layers: LayerRenderer, camera: Camera) -> LayerRenderer:
        """The scene of this view (parts, sky, fog) with the effect in it."""
        return layers

    def draw(
        self, own: Active, layers: LayerRenderer, camera: Camera, buffers: frozenset[str]
    ) -> Drawn | None:
        """The picture, of an effect that draws the scene in layers of its own."""
        return None

    def edit_image(self, own: Active, drawn: Drawn, camera: Camera) -> Drawn:
        """The finished picture with the effect on it."""
        return drawn

    def mask_of(self, own: Active, drawn: Drawn) -> Bool[Tensor, "H W"] | None:
        """Where the effect is what a pixel shows; pixels of later effects' masks are taken out."""
        return drawn.masks.get(self.mask or "")

    def front_surface(self, own: Active, camera: Camera) -> FrontSurface | None:
        """What a ray meets first in the pixels of its mask, if that is no surface of the scene."""
        return None

    # ---- Labels, in the writing threads ----------------------------------------------------------

    def measure(
        self, placed: PlacedBoxes, camera: Camera, view: EffectView
    ) -> dict[str, np.ndarray]:
        """The stored columns of `table`, [B] each. placed: labelled boxes in the scene's world."""
        raise NotImplementedError

    def grow_boxes(self, placed: PlacedBoxes, view: EffectView) -> PlacedBoxes:
        """The boxes with what the effect lays on them, which counts as theirs."""
        return placed

    # ---- LiDAR -----------------------------------------------------------------------------------

    def meet(self, own: Active, echoes: Any, frame_ns: int) -> None:
        """Surfaces of the effect that beams end on, or are bent by. echoes: changes in place
        (augment.effects.lidar.beam.Echoes).
        """

    def attenuate(self, own: Active, echoes: Any, rng: np.random.Generator) -> None:
        """What the effect in the air takes from echoes, and adds; after all surfaces."""
