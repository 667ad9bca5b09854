"""Guesses what a misspelt key was meant to be."""

from __future__ import annotations

import re

from recipes.fields import ROOT, SectionSpec, join
from recipes.nearest import nearest_word
from recipes.values import RANGE_KINDS

_UNIT = re.compile(
    r"_(per_)?(k|c|m)?(m|metres?|meters?|ft|feet|mi|miles?|yards?|mps|kmh|kph|mph|deg|rad|ntu|fnu)$"
)
# What a key may have been meant to be, where the section has it.
_SYNONYMS: dict[str, tuple[str, ...]] = {
    "fog": ("smog",),
    "haze": ("smog",),
    "mist": ("smog",),
    "beta": ("extinction_per_m",),
    "density": ("extinction_per_m",),
    "sigma": ("extinction_per_m",),
    "airlight": ("color",),
    "water": ("flood",),
    "puddle": ("flood",),
    "puddles": ("flood",),
    "depth": ("level_m",),
    "depth_m": ("level_m",),
    "clarity": ("turbidity_ntu",),
    "ior": ("refraction_index",),
    "refraction": ("refraction_index",),
    "wind": ("waves",),
    "ripples": ("waves",),
    "level": ("depth_m",),
    "level_m": ("depth_m",),
    "height": ("depth_m",),
    "height_m": ("depth_m",),
    "thickness": ("depth_m",),
    "thickness_m": ("depth_m",),
    "cover": ("coverage",),
    "slope_deg": ("max_slope_deg",),
    "glitter": ("sparkle",),
    "reflectance": ("albedo",),
    "azimuth": ("sun_azimuth_deg",),
    "azimuth_deg": ("sun_azimuth_deg",),
    "elevation": ("sun_elevation_deg",),
    "elevation_deg": ("sun_elevation_deg",),
    "drifts": ("drift",),
    "mood": ("style",),
    "look": ("style",),
    "photo": ("image",),
    "picture": ("image",),
    "file": ("image",),
    "path": ("image",),
    "sky_mask": ("mask",),
    "algorithm": ("method",),
    "weight": ("strength",),
    "amount": ("strength",),
    "intensity": ("strength",),
    "regions": ("per_region",),
    "network": ("checkpoint",),
    "weights": ("checkpoint",),
    "sha256": ("digest",),
}


def unknown_key(key: str, section: SectionSpec) -> str:
    """Why `key` is refused and which known one is nearest."""
    if key in RANGE_KINDS:
        return "a range stands for one field, not for a whole section"
    nearest = _nearest(key, section)
    if nearest is not None:
        spec = {**section.fields, **section.extra}.get(nearest)
        unit = f" ({spec.unit})" if spec and spec.unit else ""
        return f"unknown field; did you mean {nearest}{unit}?"
    elsewhere = [
        (other, name)
        for name in (key, *_SYNONYMS.get(key, ()))
        for other in ROOT.walk()
        if name in other.known and other is not section
    ]
    below = [place for place in elsewhere if place[0].path.startswith(f"{section.path}.")]
    elsewhere = below or elsewhere
    if elsewhere:
        places = [join(o.path, name) if o.path else f"{name} at the top" for o, name in elsewhere]
        return f"unknown field here; did you mean {' or '.join(places)}?"
    return f"unknown field; known here: {', '.join(section.known)}"


def _nearest(key: str, section: SectionSpec) -> str | None:
    known, low = section.known, key.lower().replace("-", "_")
    if low in known:
        return low
    bases = {_base(name): name for name in known}
    if _base(low) in bases:  # visibility_km, visibility: the unit is what was wrong
        return bases[_base(low)]
    for meant in (*_SYNONYMS.get(low, ()), *_SYNONYMS.get(_base(low), ())):
        if meant in known:
            return meant
    if any(low in other.known for other in ROOT.walk()):
        return None  # spelt well, but in another place
    close = nearest_word(low, known)
    if close is None:
        base = nearest_word(_base(low), tuple(bases))
        close = bases[base] if base else None
    return close


def _base(name: str) -> str:
    """The name without its unit."""
    stripped = _UNIT.sub("", name)
    return stripped or name
