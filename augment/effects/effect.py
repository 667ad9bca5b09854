"""The effect protocol: one class holds everything that the package asks of an effect.

`augment.effects.EFFECTS` lists the effects in the order in which they are applied. Planning and
`explain`, rendering, warm-up, jobs, label tables, datasets and LiDAR walk that tuple. They know no
effect by name. The recipe's side of an effect (its model, manifest columns and knobs) is a
`recipes.effect.EffectModel`. docs/effects.md shows how to add an effect.

The hooks of `Effect`, by when they are called:

    once a recipe and scene    plan_in_scene    facts, with a reason for every pass
                               sun_share        sunlight on the ground
                               gloss_share      blue sky in glossy surfaces
    once a scene               prepare, relight, precompute, without_parts
    once a view                cameras, visibility, edit_scene, draw, edit_image,
                               visible_mask, front_surface, expose, count_parts
    labels of a view           measure_view, measure_boxes, grow_boxes, box_table
    once a sweep               intersect_beams, attenuate_beams
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

from augment.lamps.drop_cover import DropCover
from augment.lamps.wet_surface import WetRoad, WetSurface
from augment.output.box_tables import BoxTable
from augment.render.buffers import RenderOutput
from augment.scene.boxes import WorldBoxes
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from augment.view.layers import LayerRenderer
from recipes.effect import EffectModel
from recipes.fields import section_at
from recipes.schema import Recipe

# Stages of a view. A pass runs while the scene is put together, while it is drawn, or on the
# finished picture.
SCENE, DRAWING, PICTURE = STAGES = ("scene", "drawing", "picture")


@dataclass(frozen=True)
class Step:
    """One possible pass of an effect, as `explain` lists it."""

    name: str
    """Name of the pass, which is also its time label."""

    runs: bool
    """True if the pass runs."""

    why: str
    """The reason why the pass runs or does not run."""

    stage: str = DRAWING
    """Stage of the view: SCENE, DRAWING or PICTURE."""


def skipped_steps(names: Sequence[str], why: str, stage: str = DRAWING) -> tuple[Step, ...]:
    """Return a `Step` for each of these passes, none of which runs."""
    return tuple(Step(name, False, why, stage) for name in names)


@dataclass(frozen=True)
class EffectPlan:
    """Plan of one effect in a scene: plain facts that can be printed, compared and tested."""

    data: Any
    """Numbers that the drawing hooks need; None if the effect changes nothing."""

    steps: tuple[Step, ...]
    """All passes that were considered, also for an effect that the recipe does not have."""

    buffers: frozenset[str] = frozenset()
    """Buffers of the rasteriser that the effect itself needs."""

    water_level_z_m: float | None = None
    """Height of the water that the effect puts into the scene: scene world, metres."""


@dataclass(frozen=True, eq=False)
class EffectInScene:
    """An effect that is at work in a scene. Every hook that draws receives this record."""

    hooks: Effect
    """The effect's hooks."""

    settings: Any
    """`EffectPlan.data` of the effect; never None."""

    scene: Scene
    """The scene that the effect changes."""

    backend: str
    """Name of the backend that renders the images."""

    earlier_effects: tuple[EffectInScene, ...] = ()
    """Effects that are applied before this one."""

    view_data: Any = None
    """`Visibility.view_data` of the view at hand, as `Effect.visibility` returned it."""

    weather_time_s: float = 0.0
    """Time of the weather at the image, seconds; the clock of the recipe has given it its speed."""

    @cached_property
    def prepared_data(self) -> Any:
        """Result of `Effect.prepare`."""
        return self.hooks.prepare(self)

    @cached_property
    def lit_scene(self) -> Scene:
        """Scene that the effect takes its light from: the scene as earlier effects relit it."""
        relit = (other.hooks.relight(other) for other in reversed(self.earlier_effects))
        return next((scene for scene in relit if scene is not None), self.scene)


@dataclass(frozen=True, eq=False)
class JobContext:
    """Everything that a job will render. `Effect.precompute` receives it."""

    scene: Scene
    """The scene of all images."""

    recipes: Sequence[Recipe]
    """All recipes of the job."""

    cameras: Sequence[Camera] | None = None
    """All cameras of a camera path; None for the scene's cameras. It is never a selection of them,
    so that no image depends on what else is rendered.
    """

    folder: Path | None = None
    """Folder for results in files, which later jobs reuse; None keeps them in memory."""

    backend: str = "auto"
    """Name of the backend that renders the images."""

    progress: bool = False
    """True to show progress bars on stderr."""


@dataclass(frozen=True)
class ViewQuery:
    """Query for `Effect.visibility`: one view of a scene."""

    camera: Camera
    """Camera of the image."""

    cameras: tuple[Camera, ...]
    """Cameras that look into the scene for this view; together they cover all that it can show."""

    world_from_parts: Mapping[int, np.ndarray]
    """world_from_part [4, 4] of the parts that exist, by instance id; 0 is the background."""

    near_m: float
    """Near plane, metres: nothing closer is drawn."""


@dataclass(frozen=True)
class Visibility:
    """Visibility of an effect in one view."""

    is_visible: bool = True
    """False if the effect cannot change the image."""

    skip_reasons: Mapping[str, str] = field(default_factory=dict)
    """Reason for each pass that this view does not need, by the pass's name."""

    instance_ids: frozenset[int] = frozenset()
    """Instance ids of the parts that must be drawn for the effect."""

    view_data: Any = None
    """Data that the other hooks of the view need; they read it as `EffectInScene.view_data`."""


@dataclass(frozen=True, eq=False)
class RenderedView:
    """A rendered picture, which later effects edit."""

    rgb: Float[Tensor, "H W 3"]
    """Display-encoded colour, not clamped, sky included."""

    raster: RenderOutput
    """Buffers of the scene's surfaces."""

    layers: LayerRenderer
    """The parts, sky and fog that were drawn."""

    masks: Mapping[str, Bool[Tensor, "H W"]] = field(default_factory=dict)
    """Masks of effects, by the mask's name."""

    skip_reasons: Mapping[str, str] = field(default_factory=dict)
    """Reason for each pass that proved needless while drawing, by the pass's name."""

    mirrored_rgb: Float[Tensor, "h W 3"] | None = None
    """Change of some rows of `rgb` by what wet ground mirrors of the day, where lamps ask for it:
    they light the ground and not its mirror image."""

    mirrored_rows: tuple[int, int] = (0, 0)
    """The first of these rows, and one past the last."""

    waters: tuple[WetSurface | WetRoad, ...] = ()
    """Waters that mirror lamps, in pixels of their own; none unless `layers.needs_lamp_inputs`."""

    drop_covers: tuple[DropCover, ...] = ()
    """Drops and flakes that lamps light; none unless `layers.needs_lamp_inputs`."""

    luminance_cd_m2: Float[Tensor, "H W"] | None = None
    """Luminance of the picture, for labels; None unless an effect measures it."""


@dataclass(frozen=True, eq=False)
class FrontSurface:
    """A surface of the effect in front of the scene's surfaces.

    Images of the first surface along a ray show it in the pixels of the effect's mask.
    """

    semantic_class: int
    """Semantic class of the surface."""

    depth_m: Float[Tensor, "H W"] | None
    """z of the surface in the camera, metres; None if it has no depth."""


@dataclass(frozen=True, eq=False)
class LabelInputs:
    """Inputs that an effect's labels are measured from, for one view."""

    plan: EffectPlan
    """The effect's plan for the recipe."""

    depth_m: Float32[np.ndarray, "H W"] | None
    """z of the first solid surface, metres, 0 = none. None if the effect does nothing or if no
    label needs it.
    """

    mask: UInt8[np.ndarray, "H W"] | None
    """255 where the pixel shows the effect; None if the view cannot show it."""

    water_level_z_m: float | None
    """Height of the water that is drawn: scene world, metres."""

    luminance_cd_m2: Float32[np.ndarray, "H W"] | None = None
    """Luminance of the picture, as `RenderedView` has it; None where no effect measures it."""

    effect: EffectInScene | None = None
    """The effect at work in the scene; None if it changes nothing there."""


class Effect:
    """One effect. A hook that is not overridden leaves things as they are."""

    name: ClassVar[str]
    """Name of the effect, one word."""

    section: ClassVar[str]
    """Dotted path of the effect's section in a recipe."""

    model: ClassVar[type[EffectModel]]
    """Recipe model of that section."""

    mask_name: ClassVar[str | None] = None
    """Name of the effect's mask image and file; None if it has no mask."""

    is_see_through: ClassVar[bool] = False
    """If True, the masks of other effects keep the pixels of this effect's mask."""

    share_column: ClassVar[str | None] = None
    """Manifest column with the share of an image's pixels that lie in the mask."""

    measured_columns: ClassVar[tuple[str, ...]] = ()
    """Manifest columns of the numbers that `measure_view` returns; null for other images."""

    box_table: ClassVar[BoxTable | None] = None
    """Label table: how the effect changes the labelled boxes."""

    adds_overlays: ClassVar[bool] = False
    """If True, the effect adds surfaces to the scene as overlays (PosedGaussians.is_overlay).
    `output.surface = "scene"` leaves them out.
    """

    precomputes_files: ClassVar[bool] = False
    """If True, `precompute` takes long and stores large results in files."""

    sees_exposure: ClassVar[bool] = False
    """If True, `edit_image` receives the picture in its camera's exposure: the camera's colour map
    is applied before it instead of to the finished picture.
    """

    raster_passes: ClassVar[tuple[str, ...]] = ()
    """Names of those passes that run the rasteriser."""

    kernel_folders: ClassVar[tuple[str, ...]] = ()
    """Packages whose kernels the effect needs besides those of its own folder."""

    off_switches: ClassVar[Mapping[str, tuple[str, Any]]] = {}
    """Passes that run inside the rasteriser: by name, the dotted path of a recipe field and the
    value of it that turns the pass off.
    """

    def section_of(self, recipe: Recipe) -> Any:
        """Return the effect's section of a recipe, or None."""
        return section_at(recipe, self.section)

    # ---- Once a recipe and scene, once a scene ---------------------------------------------------

    def reads_splats(self, recipe: Recipe) -> bool:
        """Return True if the effect reads the background's Gaussians.

        A large scene is then read completely, instead of only what the views show.
        """
        return self.section_of(recipe) is not None

    def kernel_key(self, section: Any) -> Hashable:
        """Return the settings of a section that choose compiled kernels; None if none does.

        Warm-up compiles once for each distinct value.
        """
        return None

    def plan_in_scene(
        self, recipe: Recipe, scene: Scene, later_plans: Mapping[str, EffectPlan]
    ) -> EffectPlan:
        """Return the plan of the effect, in the scene's heights and scale.

        Args:
            recipe: the recipe, also one without this effect.
            scene: the scene to change.
            later_plans: plans of the effects that are applied after this one, by name.

        Raises:
            SceneError: the scene lacks a fact that the effect needs.
        """
        raise NotImplementedError

    def sun_share(self, recipe: Recipe, scene: Scene) -> tuple[float, str]:
        """Return the share of the sun's light that reaches the ground, and the reason.

        It is asked for where the ground shows cast shadows, which fade by the product of all
        effects' shares. 1 leaves them as they are.

        Args:
            recipe: the recipe, also one without this effect.
            scene: the scene to change.
        """
        return 1.0, ""

    def gloss_share(self, recipe: Recipe, scene: Scene) -> tuple[float, str]:
        """Return the share of the clear sky's blue that glossy surfaces keep, and the reason.

        It is asked for where the scene's sky is blue. The picture has the product of all effects'
        shares. 1 leaves gloss as it is.

        Args:
            recipe: the recipe, also one without this effect.
            scene: the scene to change.
        """
        return 1.0, ""

    def prepare(self, effect: EffectInScene) -> Any:
        """Return data that all views share; it is kept in the scene's memo (`memo_of`)."""
        return None

    def relight(self, effect: EffectInScene) -> Scene | None:
        """Return the scene in the light that later effects should use; None if unchanged."""
        return None

    def precompute(self, context: JobContext) -> None:
        """Precompute data that each process of a job would otherwise compute for itself.

        The results are `put` into the scene's memo as shared.
        """

    def without_parts(self, effect: EffectInScene, recipe: Recipe) -> dict[str, Recipe]:
        """Return recipes that each lack one part of the effect, by the part's name.

        `explain` measures by them how long each part takes, and `count_parts` how many it has.
        """
        return {}

    # ---- Once a view -----------------------------------------------------------------------------

    def count_parts(self, effect: EffectInScene, camera: Camera) -> dict[str, dict[str, int]]:
        """Return how many things of each kind a view has, by the parts of `without_parts`."""
        return {}

    def cameras(self, effect: EffectInScene, camera: Camera) -> tuple[Camera, ...] | None:
        """Return the cameras that look into the scene for this view; None for `camera` alone."""
        return None

    def visibility(self, effect: EffectInScene, query: ViewQuery) -> Visibility:
        """Return what the view can show of the effect. This must cost little.

        The answer saves work only: it must not change a single bit of any picture.
        """
        return Visibility()

    def edit_scene(
        self, effect: EffectInScene, layers: LayerRenderer, camera: Camera
    ) -> LayerRenderer:
        """Return this view's scene (parts, sky, fog) with the effect in it."""
        return layers

    def draw(
        self, effect: EffectInScene, layers: LayerRenderer, camera: Camera, buffers: frozenset[str]
    ) -> RenderedView | None:
        """Return the picture, if the effect draws the scene in its own layers; else None."""
        return None

    def edit_image(self, effect: EffectInScene, view: RenderedView, camera: Camera) -> RenderedView:
        """Return the finished picture with the effect on it."""
        return view

    def expose(self, effect: EffectInScene, view: RenderedView, camera: Camera) -> RenderedView:
        """Return the picture as the camera's sensor records it.

        It is called after `edit_image` of all effects, the camera's colour map and the lens's blur.

        Args:
            effect: the effect in the scene.
            view: the picture, not clamped; its colours may be written into.
            camera: the view.
        """
        return view

    def reads_neighbours(self, effect: EffectInScene) -> bool:
        """Return True if pixels of `edit_image` depend on other pixels of its picture."""
        return False

    def visible_mask(self, effect: EffectInScene, view: RenderedView) -> Bool[Tensor, "H W"] | None:
        """Return the pixels that show the effect.

        The caller removes the pixels that belong to masks of later effects.
        """
        return view.masks.get(self.mask_name or "")

    def front_surface(self, effect: EffectInScene, camera: Camera) -> FrontSurface | None:
        """Return the effect's surface in the pixels of its mask.

        None if the first surface along those rays is one of the scene.
        """
        return None

    # ---- Labels, in the writing threads ----------------------------------------------------------

    def measure_view(self, camera: Camera, inputs: LabelInputs) -> dict[str, float]:
        """Return numbers of `measured_columns` that hold for an image.

        Args:
            camera: camera of the image.
            inputs: the plan of the effect, and what is measured in this view.
        """
        return {}

    def measure_boxes(
        self, boxes: WorldBoxes, camera: Camera, inputs: LabelInputs
    ) -> dict[str, np.ndarray]:
        """Return the stored columns of `box_table`, [B] each.

        Args:
            boxes: the labelled boxes, in the scene's world.
            camera: camera of the image.
            inputs: the plan, depth and mask of the effect in this view.
        """
        raise NotImplementedError

    def grow_boxes(self, boxes: WorldBoxes, inputs: LabelInputs) -> WorldBoxes:
        """Return the boxes grown by what the effect lays on them, which counts as their own."""
        return boxes

    # ---- LiDAR -----------------------------------------------------------------------------------

    def intersect_beams(self, effect: EffectInScene, echoes: Any, frame_ns: int) -> None:
        """Apply surfaces of the effect that stop or bend beams.

        echoes: `augment.effects.lidar.beam.Echoes`, changed in place.
        """

    def attenuate_beams(self, effect: EffectInScene, echoes: Any, rng: np.random.Generator) -> None:
        """Weaken echoes by the effect's particles in the air and add the particles' own echoes.

        It runs after `intersect_beams` of all effects.
        """
