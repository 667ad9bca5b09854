"""What a PandaSet URI may ask for, as in `pandaset:<path>?voxel_m=0.05&frames=0:10`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from augment.errors import AdapterError

IMAGE_SCALES = (1.0, 0.5, 0.25, 0.125)  # the fractions a JPEG decodes to without a second resize


@dataclass(frozen=True)
class PandaSetOptions:
    """Options of one opening; a scene is a function of the files and of these.

    first_frame, stop_frame: frame numbers used, stop excluded; None for the sequence's end.
    voxel_m: edge of a voxel near the ego path, metres; it grows with the distance from it.
    max_gaussians: voxels are enlarged until the scene holds no more than about this many.
    image_scale: resolution that images are decoded at for colours and sky. sky_size: texels along
    an edge of the sky's cube map.
    """

    first_frame: int = 0
    stop_frame: int | None = None
    voxel_m: float = 0.04
    max_gaussians: int = 500_000
    image_scale: float = 0.5
    sky_size: int = 768

    @staticmethod
    def from_query(query: dict[str, str]) -> PandaSetOptions:
        """The options of a URI's query.

        Raises:
            AdapterError: an unknown key, or a value of the wrong kind or out of range.
        """
        unknown = sorted(set(query) - set(_KEYS))
        if unknown:
            allowed = "; ".join(f"{key}: {kind}" for key, (_, kind) in _KEYS.items())
            raise AdapterError(f"pandaset: unknown option {unknown[0]!r}; allowed are {allowed}")
        fields: dict[str, Any] = {}
        for key, text in query.items():
            parse, kind = _KEYS[key]
            try:
                fields |= parse(key, text)
            except ValueError:
                raise AdapterError(f"pandaset: {key} must be {kind}; got {text!r}") from None
        return PandaSetOptions(**fields)

    def keeps(self, frame: int) -> bool:
        return frame >= self.first_frame and (self.stop_frame is None or frame < self.stop_frame)


def _frames(_: str, text: str) -> dict[str, Any]:
    first, colon, stop = text.partition(":")
    if not colon:
        raise ValueError(text)
    fields = {"first_frame": int(first or 0), "stop_frame": int(stop) if stop else None}
    if fields["first_frame"] < 0 or (stop and fields["stop_frame"] <= fields["first_frame"]):
        raise ValueError(text)
    return fields


def _integer(low: int, high: int) -> Callable[[str, str], dict[str, Any]]:
    def parse(key: str, text: str) -> dict[str, Any]:
        if not low <= int(text) <= high:
            raise ValueError(text)
        return {key: int(text)}

    return parse


def _voxel(key: str, text: str) -> dict[str, Any]:
    value = float(text)
    if not (math.isfinite(value) and 0.01 <= value <= 2):
        raise ValueError(text)
    return {key: value}


def _scale(key: str, text: str) -> dict[str, Any]:
    if float(text) not in IMAGE_SCALES:
        raise ValueError(text)
    return {key: float(text)}


_KEYS: dict[str, tuple[Callable[[str, str], dict[str, Any]], str]] = {
    "frames": (_frames, "first:stop, frame numbers with stop excluded, either side may be empty"),
    "voxel_m": (_voxel, "a number of metres from 0.01 to 2"),
    "max_gaussians": (_integer(1_000, 20_000_000), "an integer from 1000 to 20000000"),
    "image_scale": (_scale, "one of 1, 0.5, 0.25, 0.125"),
    "sky_size": (_integer(8, 4096), "an integer from 8 to 4096"),
}
