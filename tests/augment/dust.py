"""An effect in one file, the example of docs/effects.md: dust in the air tints what is far away."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from pydantic import Field

from augment.effects.effect import (
    PICTURE,
    Effect,
    EffectInScene,
    EffectPlan,
    LabelInputs,
    RenderedView,
    Step,
    skipped_steps,
)
from augment.effects.lidar.beam import Echoes
from augment.output.box_tables import BoxTable
from augment.render.buffers import EXPECTED_DEPTH
from augment.scene.boxes import WorldBoxes
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from augment.timing import timed
from recipes.effect import Column, EffectModel, Knob
from recipes.fields import Colour, Number
from recipes.schema import Recipe

TINT = "dust on the picture"


class Dust(EffectModel):
    """Dust in the air."""

    knobs = (Knob("distance", ("depth", "ray"), "how far dust is looked through", 11),)
    columns = (
        Column(
            "dust_half_m",
            lambda dust: dust.half_m,
            "Half tinted",
            "m",
            presence_values="all",
            label="dust",
        ),
    )

    half_m: Number = Field(gt=0, le=1e6)
    """Distance at which half of what is seen is dust."""
    color: Colour = (0.8, 0.6, 0.4)
    """Colour of the dust: red, green, blue, display-encoded sRGB."""
    distance: Literal["depth", "ray"] = "ray"
    """ray counts along every ray, depth along the optical axis."""


class DustEffect(Effect):
    """A colour cast that grows with distance: out = t rgb + (1 - t) dust, t = 2^(-d / half_m)."""

    name, section, model, mask_name = "dust", "weather.dust", Dust, "dust"
    # clear_fraction: t at the box's centre.
    box_table = BoxTable(
        name="box_dust",
        file="labels/dust.parquet",
        kind="box dust",
        columns={"clear_fraction": np.float64},
        sample_columns=("clear_fraction",),
        visible_column="clear_fraction",
    )

    def plan_in_scene(
        self, recipe: Recipe, scene: Scene, later_plans: Mapping[str, EffectPlan]
    ) -> EffectPlan:
        dust = self.section_of(recipe)
        if dust is None:
            return EffectPlan(None, skipped_steps((TINT,), "the recipe has no dust", PICTURE))
        step = Step(TINT, True, f"half of what stands {dust.half_m:g} m away is dust", PICTURE)
        return EffectPlan(dust, (step,), buffers=frozenset({EXPECTED_DEPTH}))

    def edit_image(self, effect: EffectInScene, view: RenderedView, camera: Camera) -> RenderedView:
        raster, dust = view.raster, effect.settings
        assert raster.expected_depth is not None and raster.alpha is not None
        with timed(TINT):
            metres = raster.expected_depth
            if dust.distance == "ray":
                metres = metres * camera.ray_lengths(metres.dtype, metres.device)
            far = torch.full_like(metres, math.inf)  # the sky is all dust
            clear = torch.exp2(-torch.where(raster.alpha >= 0.5, metres, far) / dust.half_m)
            color = torch.tensor(dust.color, dtype=view.rgb.dtype, device=view.rgb.device)
            rgb = clear[..., None] * view.rgb + (1 - clear[..., None]) * color
        return replace(view, rgb=rgb, masks={**view.masks, "dust": clear < 0.5})

    def measure_boxes(
        self, boxes: WorldBoxes, camera: Camera, inputs: LabelInputs
    ) -> dict[str, np.ndarray]:
        away_m = np.linalg.norm(boxes.centres_m - camera.centre.numpy(), axis=1)
        return {"clear_fraction": np.exp2(-away_m / inputs.plan.data.half_m)}

    def attenuate_beams(
        self, effect: EffectInScene, echoes: Echoes, rng: np.random.Generator
    ) -> None:
        echoes.gain *= np.exp2(-2 * echoes.air_path_m / effect.settings.half_m)  # there and back
