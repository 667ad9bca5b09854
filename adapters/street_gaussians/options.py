"""What the URI of a trained model may ask for, as in `street_gaussians:<path>?data=…&width=800`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from adapters.lidar.options import DriveOptions
from augment.errors import AdapterError

SCHEME = "street_gaussians"
DEFAULT_WIDTH = 1600
_KEYS = {
    "data": "the dataset's folder, where it is not where the configuration says",
    "iteration": "which of the saved iterations, a number; the newest without it",
    "weights": "pth or ply; the .pth where there is one",
    "width": f"images are at most so many pixels wide, {DEFAULT_WIDTH} without it; 0 as recorded",
    "frames": "first:stop, frame numbers with stop excluded, either side may be empty",
    "rotation_bug": "0 or 1; actors turned as an older release of the project turned them",
}


@dataclass(frozen=True)
class ModelOptions:
    """Options of one opening; see _KEYS. width: 0 for as recorded."""

    data: Path | None = None
    iteration: int | None = None
    weights: str | None = None
    width: int = DEFAULT_WIDTH
    frames: DriveOptions = field(default_factory=DriveOptions)
    rotation_bug: bool = False

    @staticmethod
    def from_query(query: dict[str, str]) -> ModelOptions:
        """Raises:
        AdapterError: an unknown key (lists the known ones), or a value of the wrong kind.
        """
        unknown = sorted(set(query) - set(_KEYS))
        if unknown:
            known = "; ".join(f"{key}: {meaning}" for key, meaning in _KEYS.items())
            raise AdapterError(
                f"{SCHEME}: unknown option {unknown[0]!r}; for a trained model allowed are {known}"
            )
        frames = {"frames": query["frames"]} if "frames" in query else {}
        return ModelOptions(
            data=Path(query["data"]).expanduser() if "data" in query else None,
            iteration=_number(query, "iteration", None),
            weights=_choice(query, "weights", ("pth", "ply")),
            width=_number(query, "width", DEFAULT_WIDTH) or 0,
            frames=DriveOptions.from_query(SCHEME, frames),
            rotation_bug=_choice(query, "rotation_bug", ("0", "1")) == "1",
        )


def _number(query: dict[str, str], key: str, default: int | None) -> int | None:
    text = query.get(key)
    if text is None:
        return default
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise AdapterError(f"{SCHEME}: {key} must be a whole number, {_KEYS[key]}; got {text!r}")
    return int(text)


def _choice(query: dict[str, str], key: str, allowed: tuple[str, ...]) -> str | None:
    text = query.get(key)
    if text is not None and text not in allowed:
        raise AdapterError(f"{SCHEME}: {key} must be {' or '.join(allowed)}; got {text!r}")
    return text
