"""Pictures of what `climategs render` wrote: read the manifest, draw."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from augment.jobs.layout import folder_name, resolve_inside
from tools import sheet

VIDEO_WIDTH = 1440
MAX_SHOWN = 12  # scenes and variants in one picture


def read_rows(out: Path) -> list[dict[str, Any]]:
    """The finished images of an output folder, as manifest rows.

    Raises:
        OutputError: there is no manifest, or it holds no finished image.
    """
    from augment.errors import OutputError
    from augment.jobs.manifest import read_manifest

    rows = [row for row in read_manifest(out).to_pylist() if row["status"] == "ok"]
    if not rows:
        raise OutputError(f"{out} holds no finished image; run `climategs render` first")
    return rows


def draw_sheet(out: Path, frame: int | None = None) -> Path:
    """Writes OUT/contact_sheet.png: a row per scene and variant, a column per camera.

    Of more than MAX_SHOWN variants, as many are shown, evenly spread.
    """
    rows = read_rows(out)
    frames = sorted({row["frame"] for row in rows})
    frame = frames[len(frames) // 2] if frame is None else frame
    cameras = list(dict.fromkeys(row["camera"] for row in rows))
    lines = []
    for scene, variant in _shown(_groups(rows)):
        group = {
            row["camera"]: row
            for row in rows
            if (row["scene"], row["variant"], row["frame"]) == (scene, variant, frame)
        }
        if group:
            title = f"{scene}, frame {frame}: {_weather(next(iter(group.values())))}"
            images = [(name, _read(out, group[name])) for name in cameras if name in group]
            lines.append((title, images))
    if not lines:
        from augment.errors import OutputError

        raise OutputError(f"{out} holds no image of frame {frame}; it has frames {frames}")
    path = out / "contact_sheet.png"
    sheet.write_rgb(path, sheet.contact_sheet(lines))
    return path


def draw_video(out: Path, camera: str, frames_per_second: float = 10.0) -> Path:
    """Writes OUT/video_<camera>.mp4: scenes and variants side by side, frame by frame."""
    rows = [row for row in read_rows(out) if row["camera"] == camera]
    by_key = {(row["scene"], row["variant"], row["frame"]): row for row in rows}
    groups = _shown(_groups(rows))
    frames = [
        frame
        for frame in sorted({row["frame"] for row in rows})
        if all((*group, frame) in by_key for group in groups)
    ]

    def pictures():
        for frame in frames:
            shown = [by_key[(*group, frame)] for group in groups]
            images = [(_weather(row), _read(out, row)) for row in shown]
            yield sheet.side_by_side(images, VIDEO_WIDTH)

    path = out / f"video_{folder_name(camera)}.mp4"
    sheet.write_video(path, pictures(), frames_per_second)
    return path


def _read(out: Path, row: dict[str, Any]) -> np.ndarray:
    return sheet.read_rgb(resolve_inside(out, row["image_path"]))


def _shown(groups: list[tuple[str, str]]) -> list[tuple[str, str]]:
    step = -(-len(groups) // MAX_SHOWN)
    return groups[::step]


def _groups(rows: list[dict[str, Any]]) -> list[tuple[str, str]]:
    """Scene and variant of every row, each once: a scene's clearest, driest and barest first."""
    weather = {
        (row["scene"], row["variant"]): (_extinction(row), _water_level(row), _snow_depth(row))
        for row in rows
    }
    return sorted(weather, key=lambda group: (group[0], *weather[group], group[1]))


def _extinction(row: dict[str, Any]) -> float:
    """Of the recipe's smog, per metre; 0 where it has none."""
    extinction = row.get("smog_extinction_per_m", math.nan)
    return 0.0 if math.isnan(extinction) else extinction


def _water_level(row: dict[str, Any]) -> float:
    """Of the recipe's flood, metres; -infinity where it has none."""
    level = row.get("flood_level_m", math.nan)  # no column in folders older than floods
    return -math.inf if math.isnan(level) else level


def _snow_depth(row: dict[str, Any]) -> float:
    """Of the recipe's snow, metres; 0 where it has none."""
    depth = row.get("snow_depth_m", math.nan)  # no column in folders older than snow
    return 0.0 if math.isnan(depth) else depth


def _weather(row: dict[str, Any]) -> str:
    """The variant's name and what its weather means to a person."""
    from recipes.schema import KOSCHMIEDER

    said = []
    if style := row.get("style"):
        said.append(f"{style} x {row.get('style_strength', math.nan):.2g}")
    if (extinction := _extinction(row)) > 0:
        said.append(f"visibility {KOSCHMIEDER / extinction:.0f} m")
    if math.isfinite(level := _water_level(row)):
        said.append(f"water at {level:.2f} m")
    if (depth := _snow_depth(row)) > 0:
        said.append(f"snow {100 * depth:.3g} cm")
    return f"{row['variant']} ({', '.join(said) or 'no weather'})"
