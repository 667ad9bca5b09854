"""Labels of the boxes of one view: their pixels, visibility, masks, and numbers of the effects.

In: a rendered view, its camera, its recipe and the boxes of its frame. Out: the view with the boxes
in its instance image, and the numbers measured for the boxes. Jobs and `augment.dataset.live` call
`label_view`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import UInt8, UInt16

from augment import effects
from augment.output.box_tables import BOXES_2D, MASKS, MODAL_SIDES, SIDES, BoxNumbers, BoxWeather
from augment.scene.box_estimates import Estimate, Evidence, estimate_boxes
from augment.scene.boxes import (
    MIN_DEPTH_M,
    Instances,
    Occlusion,
    Outlines,
    WorldBoxes,
    encode_masks,
    find_occlusion,
    outline_world_boxes,
    paint_boxes,
)
from augment.scene.cameras import Camera
from augment.scene.labels import Boxes
from augment.scene.semantics import SemanticClass
from augment.view.results import ViewResult
from recipes.schema import Recipe

# Depth of the recording car in a picture that shows it, metres: nearer than every box.
OWN_CAR_DEPTH_M = MIN_DEPTH_M / 2


def uses_boxes(recipe: Recipe) -> bool:
    """Return True if images of the recipe need the boxes of their frame."""
    return bool(recipe.output.labels) or recipe.output.instance


def label_view(
    boxes: Boxes,
    instances: Instances,
    world_origin_m: np.ndarray,
    camera: Camera,
    view: ViewResult,
    recipe: Recipe,
    evidence: Callable[[], Evidence | None] | None = None,
) -> tuple[ViewResult, BoxWeather]:
    """Return the view with its frame's boxes, and the measured numbers of the boxes.

    Boxes without an actor are added to the view's instance image. Numbers are measured where labels
    are written.

    Args:
        boxes: Boxes of the frame.
        instances: Numbers of the scene's objects.
        world_origin_m: Origin that was subtracted from the dataset's world, metres.
        camera: Camera at the written resolution.
        view: result that `check_view` has passed.
        evidence: Reads further evidence of the frame's objects.
    """
    numbers_of_table: dict[str, BoxNumbers] = {}
    wants_masks = bool(recipe.output.label_formats)
    output = recipe.output
    surface = view.surface
    world_boxes = WorldBoxes.from_labels(boxes, world_origin_m)
    box_visibility = None
    if surface is not None:
        uses_depth = wants_masks and not output.instance
        on_photo = recipe.render.is_on_recorded
        box_visibility = find_box_visibility(
            boxes,
            instances,
            world_boxes,
            camera,
            view,
            masks=uses_depth,
            evidence=evidence,
            on_photo=on_photo,
        )
    if output.labels:
        numbers_of_table = measure_boxes(
            boxes, instances, world_origin_m, camera, view, box_visibility=box_visibility
        )
    if view.instance is None or surface is None or box_visibility is None:
        return view, numbers_of_table
    assert surface.instance_depth_m is not None and surface.instance_classes is not None
    box_numbers = instances.numbers_of(boxes.track_ids)
    if not surface.is_bare:
        world_boxes = _grow_boxes(world_boxes, view)
    instance_image = paint_boxes(
        view.instance,
        world_boxes,
        box_numbers,
        camera,
        surface.instance_depth_m,
        surface.instance_classes,
        len(instances.actors),
    )
    instance_image = box_visibility.paint_estimates(
        instance_image, box_numbers, surface.instance_classes
    )
    if surface.own_car is not None:
        instance_image = np.where(surface.own_car, np.uint16(0), instance_image)
    if wants_masks:
        numbers_of_table[MASKS.name] = MASKS.make_numbers(
            boxes.track_ids, **encode_masks(instance_image, box_numbers)
        )
    untyped_view: Any = view
    return dataclasses.replace(untyped_view, instance=instance_image), numbers_of_table


def measure_boxes(
    boxes: Boxes,
    instances: Instances,
    world_origin_m: np.ndarray,
    camera: Camera,
    view: ViewResult,
    *,
    box_visibility: BoxVisibility | None = None,
) -> dict[str, BoxNumbers]:
    """Return the measured numbers of a frame's boxes in one of its images, by table.

    Args:
        boxes: Boxes of the frame.
        instances: Numbers of the scene's objects.
        world_origin_m: Origin that was subtracted from the dataset's world, metres.
        camera: Camera at the written resolution.
        view: The image, with the data that labels are measured from.
        box_visibility: Result of `find_box_visibility` for the image, with masks by depth if it has
            owners; computed here if None.
    """
    world_boxes = WorldBoxes.from_labels(boxes, world_origin_m)
    numbers_of_table: dict[str, BoxNumbers] = {}
    if view.surface is not None:
        numbers = instances.numbers_of(boxes.track_ids)
        box_visibility = box_visibility or find_box_visibility(
            boxes, instances, world_boxes, camera, view
        )
        columns = {"instance": numbers.astype(np.int64), **box_visibility.columns()}
        numbers_of_table[BOXES_2D.name] = BOXES_2D.make_numbers(boxes.track_ids, **columns)
        if box_visibility.occlusion.owner_boxes is not None:
            box_numbers = np.arange(1, len(boxes) + 1).astype(np.uint16)
            owners = box_visibility.paint_estimates(
                box_visibility.occlusion.owner_boxes, box_numbers
            )
            numbers_of_table[MASKS.name] = MASKS.make_numbers(
                boxes.track_ids, **encode_masks(owners, box_numbers)
            )
    for effect in effects.EFFECTS:
        table = effect.box_table
        effect_view = view.effects.get(effect.name)
        if table is not None and effect_view is not None:
            columns = effect.measure_boxes(world_boxes, camera, effect_view)
            numbers_of_table[table.name] = table.make_numbers(boxes.track_ids, **columns)
    return numbers_of_table


def find_box_visibility(
    boxes: Boxes,
    instances: Instances,
    world_boxes: WorldBoxes,
    camera: Camera,
    view: ViewResult,
    *,
    masks: bool = False,
    evidence: Callable[[], Evidence | None] | None = None,
    on_photo: bool = False,
) -> BoxVisibility:
    """Return the pixels of an image that show each of its frame's boxes.

    Args:
        boxes: Boxes of the frame.
        instances: Numbers of the scene's objects.
        world_boxes: The boxes in the scene's world.
        camera: Camera of the image, at the written resolution.
        view: The image, with its surface.
        masks: If True, also find the owner of each pixel by depth.
        evidence: Reads further evidence of the frame's objects; if None, depth alone decides.
        on_photo: True if the picture is a recorded one.
    """
    surface = _with_own_car(view.surface)
    outlines = outline_world_boxes(world_boxes, camera)
    numbers = instances.numbers_of(boxes.track_ids)
    actor_numbers = np.where(numbers <= len(instances.actors), numbers, 0)
    grown_boxes = _grow_boxes(world_boxes, view)
    occlusion = find_occlusion(
        grown_boxes,
        camera,
        surface.depth_m,
        surface.actor_instance,
        actor_numbers,
        classes=surface.classes,
        with_owners=masks,
    )
    estimates: Mapping[int, Estimate] = {}
    if evidence is not None:
        estimates = estimate_boxes(
            world_boxes,
            boxes.track_ids,
            camera,
            outlines,
            occlusion,
            evidence,
            on_photo=on_photo,
            own_car=surface.own_car,
            buried_m=np.maximum(grown_boxes.low_m[:, 2] - world_boxes.low_m[:, 2], 0),
        )
    return BoxVisibility(outlines, occlusion, estimates)


@dataclass(frozen=True, eq=False)
class BoxVisibility:
    """Visibility of a frame's boxes in one image."""

    outlines: Outlines
    """Outlines of the projected boxes."""
    occlusion: Occlusion
    """Visibility of the boxes by rendered depth."""
    estimates: Mapping[int, Estimate]
    """Estimates of the boxes that depth does not resolve, by their positions."""

    def columns(self) -> dict[str, np.ndarray]:
        """Return the stored columns of BOXES_2D, without the instances."""
        occlusion = self.occlusion
        xyxy = occlusion.xyxy.copy()
        pixels = occlusion.num_shown.copy()
        hidden_pixels = occlusion.num_hidden.copy()
        is_estimated = np.zeros(len(pixels), bool)
        for box, estimate in self.estimates.items():
            xyxy[box] = estimate.xyxy
            pixels[box] = estimate.num_pixels
            hidden_pixels[box] = estimate.num_hidden
            is_estimated[box] = True
        return {
            **dict(zip(SIDES, self.outlines.xyxy.T.copy(), strict=True)),
            **dict(zip(MODAL_SIDES, xyxy.T.copy(), strict=True)),
            "pixels": pixels,
            "hidden_pixels": hidden_pixels,
            "truncated_fraction": self.outlines.truncated_fraction,
            "is_estimated": is_estimated,
        }

    def paint_estimates(
        self,
        image: UInt16[np.ndarray, "H W"],
        numbers: UInt16[np.ndarray, " B"],
        classes: UInt8[np.ndarray, "H W"] | None = None,
    ) -> UInt16[np.ndarray, "H W"]:
        """Return the image with the numbers of the estimated boxes painted in.

        Pixels that have a number already, or that show water, keep their value.

        Args:
            image: Instance numbers; 0 where there is none.
            numbers: Number of each box.
            classes: Classes of the surfaces that the image shows.
        """
        if not self.estimates:
            return image
        painted_image = image.copy()
        can_show = image == 0
        if classes is not None:
            can_show &= classes != SemanticClass.WATER
        for box, estimate in self.estimates.items():
            is_free = can_show[estimate.rows, estimate.columns]
            is_free &= painted_image[estimate.rows, estimate.columns] == 0
            painted_image[estimate.rows[is_free], estimate.columns[is_free]] = numbers[box]
        return painted_image


def _grow_boxes(world_boxes: WorldBoxes, view: ViewResult) -> WorldBoxes:
    """Return the boxes grown by the layers that lie on them, such as snow."""
    for effect in effects.EFFECTS:
        if effect.name in view.effects:
            world_boxes = effect.grow_boxes(world_boxes, view.effects[effect.name])
    return world_boxes


def _with_own_car(surface: Any) -> Any:
    """Return the LabelSurfaces with the recording car as the nearest surface of its pixels."""
    if surface.own_car is None:
        return surface
    instance_image = surface.actor_instance
    return dataclasses.replace(
        surface,
        depth_m=np.where(surface.own_car, np.float32(OWN_CAR_DEPTH_M), surface.depth_m),
        actor_instance=(
            None
            if instance_image is None
            else np.where(surface.own_car, np.uint16(0), instance_image)
        ),
    )
