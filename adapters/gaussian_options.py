"""What may be asked of a splat file in its URI: `gaussians:PATH?up=-y&scale=1&cameras=FILE`."""

from __future__ import annotations

import math
from dataclasses import dataclass

from adapters.cameras.default_paths import PATH_KINDS, PathKind
from adapters.world import parse_up
from augment.errors import AdapterError

QUERY_KEYS = {
    "up": "the file's axis that points up (+x … -z), a vector 0,-1,0.1, or 'cameras': their mean; "
    "estimated without it",
    "scale": "metres per unit of the file; 1 says that it is in metres; estimated without it",
    "cameras": "a camera file or COLMAP folder in the file's world, or 'none'",
    "path": "without cameras: auto, drive or orbit",
    "iteration": "which iteration_N of a trained model; the newest by default",
    "sky": "colour behind the Gaussians: overcast (a light grey), black, white, or three numbers "
    "0 to 1",
}
COLOURS = {"overcast": (0.85, 0.85, 0.85), "black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


@dataclass(frozen=True)
class GaussianOptions:
    """The query, parsed. up: None, 'cameras', or what parse_up takes."""

    up: str | None = None
    scale: float | None = None
    cameras: str | None = None
    path: PathKind = "auto"
    iteration: int | None = None
    sky: tuple[float, float, float] | None = None

    @staticmethod
    def from_query(query: dict[str, str]) -> GaussianOptions:
        """The options of a URI's query.

        Raises:
            AdapterError: an unknown key, or a value of the wrong kind or out of range.
        """
        unknown = sorted(set(query) - set(QUERY_KEYS))
        if unknown:
            known = "; ".join(f"{key}: {meaning}" for key, meaning in QUERY_KEYS.items())
            raise AdapterError(
                f"gaussians: unknown key {', '.join(map(repr, unknown))}. Known: {known}"
            )
        if query.get("up", "cameras") != "cameras":
            parse_up(query["up"])  # a mistake here must not wait for a large file to load
        path = PATH_KINDS.get(query.get("path", "auto"))
        if path is None:
            raise AdapterError(
                f"gaussians: path must be one of {', '.join(PATH_KINDS)}; got {query['path']!r}"
            )
        return GaussianOptions(
            up=query.get("up"),
            scale=_parse_scale(query["scale"]) if "scale" in query else None,
            cameras=query.get("cameras"),
            path=path,
            iteration=_whole_number(query["iteration"]) if "iteration" in query else None,
            sky=_parse_colour(query["sky"]) if "sky" in query else None,
        )


def _parse_scale(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 1e-6 <= value <= 1e6:  # NaN compares false; beyond, float32 runs out for real scenes
        raise AdapterError(
            f"gaussians: scale must be metres per unit, a number from 1e-6 to 1e6; got {text!r}"
        )
    return value


def _whole_number(text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise AdapterError(f"gaussians: iteration must be a whole number; got {text!r}")
    return int(text)


def _parse_colour(text: str) -> tuple[float, float, float]:
    try:
        red, green, blue = COLOURS.get(text) or [float(part) for part in text.split(",")]
    except ValueError:
        red = green = blue = math.nan
    if not all(0 <= value <= 1 for value in (red, green, blue)):
        raise AdapterError(
            f"gaussians: sky must be {', '.join(COLOURS)}, or three numbers 0 to 1 such as "
            f"0.7,0.8,0.9; got {text!r}"
        )
    return red, green, blue
