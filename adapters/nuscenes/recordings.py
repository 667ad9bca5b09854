"""Scenes of a nuScenes folder, and the conditions that their descriptions state."""

from __future__ import annotations

import re
from pathlib import Path

from adapters.nuscenes.tables import choose_scene, choose_version, read_table

# Words of a scene's description that state a condition, by the condition.
_WORDS = {
    "rain": re.compile(r"\brain(s|y|ing)?\b", re.IGNORECASE),
    "night": re.compile(r"\bnight\b", re.IGNORECASE),
    "fog": re.compile(r"\bfog(gy)?\b", re.IGNORECASE),
    "snow": re.compile(r"\bsnow(s|y|ing)?\b", re.IGNORECASE),
}


def list_scenes(path: str, query: dict[str, str]) -> list[dict[str, str]]:
    """Return the query of each scene in a folder: of the one that the query names, or of all."""
    if "scene" in query:
        return [query]
    root = Path(path)
    rows = read_table(root / choose_version(root, query.get("version")) / "scene.json").values()
    names = [row.text("name") for row in rows]
    has_same_names = len(set(names)) < len(names)
    return [{**query, "scene": row.token if has_same_names else row.text("name")} for row in rows]


def recorded_conditions(path: str, query: dict[str, str]) -> tuple[str, ...]:
    """Return the conditions that the scene's description states; none without a description."""
    root = Path(path)
    row = choose_scene(root / choose_version(root, query.get("version")), query.get("scene"))
    description = row.text("description") if "description" in row.fields else ""
    return tuple(name for name, words in _WORDS.items() if words.search(description))
