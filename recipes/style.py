"""What a recipe may say of style: the colour mood of a photograph, or of a preset."""

from __future__ import annotations

from pathlib import PurePath
from typing import Annotated, Literal

from pydantic import AfterValidator, ConfigDict, Field, Strict, model_validator
from pydantic.config import JsonDict

from recipes.style_presets import no_such_style, style_preset_names
from recipes.types import Closed, Digest, FilePath, Flag, Number

# In words of JSON Schema: one of the two is present and not null.
_ONE_SOURCE: JsonDict = {
    "oneOf": [
        {"required": [name], "properties": {name: {"not": {"type": "null"}}}}
        for name in ("image", "preset")
    ]
}
FILES = ("image", "mask", "checkpoint")  # the fields that name one


def _known(name: str) -> str:
    if name not in style_preset_names():
        raise ValueError(no_such_style(name))
    return name


StyleName = Annotated[str, Strict(), AfterValidator(_known)]


class Style(Closed):
    """The colours of the scene, turned into those of an image or of a preset."""

    model_config = ConfigDict(json_schema_extra=_ONE_SOURCE)

    image: FilePath | None = Field(
        default=None, description="The picture whose colours the scene takes on."
    )
    preset: StyleName | None = Field(
        default=None, description="A style that comes with the package, in place of an image."
    )
    mask: FilePath | None = Field(
        default=None,
        description="An image of the style image's shape, white where that shows sky; null to "
        "look for the sky at its top.",
    )
    method: Literal["mkl", "reinhard", "gscm"] = Field(
        default="mkl",
        description="mkl maps mean and covariance of the colours (Monge-Kantorovich), reinhard "
        "mean and spread of each channel; gscm is the network.",
    )
    strength: Number = Field(
        default=1.0, ge=0, le=2, description="0 leaves the scene's colours, 1 takes on the style's."
    )
    per_region: Flag = Field(
        default=False,
        description="Maps of their own for road, vegetation and the rest, where the scene knows "
        "its classes.",
    )
    applied_to: Literal["scene", "picture"] = Field(
        default="scene",
        description="scene styles what stands in the weather, picture also the weather itself.",
    )
    evaluated: Literal["color", "sh"] = Field(
        default="color",
        description="color maps every colour as it is seen; sh maps the background's spherical "
        "harmonics once, which frames pay nothing for and which differs where colours that change "
        "with the direction reach below 0. Of applied_to scene.",
    )
    checkpoint: FilePath | None = Field(
        default=None,
        description="A trained network for gscm; null for the one that comes with the package.",
    )
    digest: Digest | None = Field(
        default=None,
        description="SHA-256 over what the files above hold; checked where given, worked out "
        "where null.",
    )

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
    def changes(self) -> bool:
        """Whether there is any: a style of no strength changes nothing."""
        return self.strength > 0

    @property
    def name(self) -> str:
        """Of the preset, or of the image's file without its folders."""
        return self.preset or PurePath(self.image or "").name

    @property
    def files(self) -> dict[str, str]:
        """The files that it names, by field."""
        named = {name: getattr(self, name) for name in FILES}
        return {name: path for name, path in named.items() if path is not None}
