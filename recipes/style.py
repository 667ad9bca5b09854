"""Recipe section of style: the colour mood of a photograph, or of a preset.

The presets come with the package: statistics of colours, in YAML, without pictures.
"""

from __future__ import annotations

from pathlib import PurePath
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, Strict, model_validator

from recipes.effect import Column, EffectModel, Knob
from recipes.errors import RecipeError
from recipes.fields import (
    Digest,
    FilePath,
    Flag,
    Number,
    OneOf,
    one_of,
    packaged_names,
    packaged_text,
)


def style_preset_names() -> tuple[str, ...]:
    """Return the names of the style presets, in alphabetical order."""
    return packaged_names("styles")


STYLES = OneOf("style", style_preset_names)
StyleName = Annotated[str, Strict(), STYLES]


def style_preset_text(name: str) -> str:
    """Return the YAML of a style: mean and covariance of the colours of land and of sky.

    Raises:
        RecipeError: there is no style of that name.
    """
    if name not in style_preset_names():
        raise RecipeError(f"style {name!r}: {STYLES.refusal(name)}")
    return packaged_text("styles", name)


class Style(EffectModel):
    """The colours of the scene, turned into those of an image or of a preset."""

    model_config = ConfigDict(json_schema_extra=one_of("image", "preset"))
    later_fields = ("evaluated",)
    file_fields = ("image", "mask", "checkpoint")
    synonyms = (
        ("style", "mood look"),
        ("image", "photo picture file path"),
        ("mask", "sky_mask"),
        ("method", "algorithm"),
        ("strength", "weight amount intensity"),
        ("per_region", "regions"),
        ("checkpoint", "network weights"),
        ("digest", "sha256"),
    )
    knobs = (
        Knob(
            "evaluated",
            ("sh", "color"),
            "map folded into the scene or put on each colour",
            9,
            applies_to=lambda style: style.applied_to == "scene",
        ),
    )
    columns = (
        Column(
            "style",
            lambda style: style.name,
            "Style",
            value_if_absent=None,
            label="style",
            caption="{style} x {style_strength:.2g}",
        ),
        Column("style_method", lambda style: style.method, value_if_absent=None),
        Column(
            "style_strength",
            lambda style: style.strength,
            "Strength of style",
            value_if_absent=0.0,
            presence_values="nonzero",
            linear=True,
        ),
    )

    image: FilePath | None = None
    """The picture whose colours the scene takes on."""
    preset: StyleName | None = None
    """A style that comes with the package, in place of an image."""
    mask: FilePath | None = None
    """An image of the style image's shape, white where that shows sky; null to look for the sky at
    its top."""
    method: Literal["mkl", "reinhard", "gscm"] = "mkl"
    """mkl maps mean and covariance of the colours (Monge-Kantorovich), reinhard mean and spread of
    each channel; gscm is the network."""
    strength: Number = Field(default=1.0, ge=0, le=2)
    """0 leaves the scene's colours, 1 takes on the style's."""
    per_region: Flag = False
    """Maps of their own for road, vegetation and the rest, where the scene knows its classes."""
    applied_to: Literal["scene", "picture"] = "scene"
    """scene styles what stands in the weather, picture also the weather itself."""
    evaluated: Literal["color", "sh"] = "color"
    """color maps every colour as it is seen; sh maps the background's spherical harmonics once,
    which frames pay nothing for and which differs where colours that change with the direction
    reach below 0. Of applied_to scene."""
    checkpoint: FilePath | None = None
    """A trained network for gscm; null for the one that comes with the package."""
    digest: Digest | None = None
    """SHA-256 over what the files above hold; checked where given, worked out where null."""

    @model_validator(mode="after")
    def _one_source(self) -> Style:
        if (self.image is None) == (self.preset is None):
            both = "both give" if self.image is not None else "neither gives"
            raise ValueError(f"image and preset {both} the style: give one of them")
        if self.image is None and self.mask is not None:
            raise ValueError("mask belongs to an image, and there is none")
        if self.image is None and self.method == "gscm":
            raise ValueError("method gscm looks at an image: give image instead of preset")
        if self.image is None and self.digest is not None:
            raise ValueError("digest belongs to an image, and there is none")
        if self.checkpoint is not None and self.method != "gscm":
            raise ValueError(f"checkpoint belongs to method gscm; method is {self.method}")
        if self.method == "gscm" and self.per_region:
            raise ValueError("per_region is for mkl and reinhard: gscm gives one map for all")
        if self.applied_to == "picture" and self.per_region:
            raise ValueError("per_region is for applied_to scene: a picture has one map for all")
        return self

    @property
    def has_effect(self) -> bool:
        """Return False for a style without strength, which changes nothing."""
        return self.strength > 0

    @property
    def name(self) -> str:
        """Return the name of the preset, or of the image's file without its folders."""
        return self.preset or PurePath(self.image or "").name
