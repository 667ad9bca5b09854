"""Draw the film strips of weather that changes over time again, within a quarter of an hour.

    python docs/images/draw_over_time.py --drive scene:scenes/002

Each preset has a strip: above the embedded street, below a recorded drive of PandaSet, if it is
given.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import tyro

from adapters.base import open_scene
from augment.scene.scene import Scene
from augment.scene.scene_times import scene_times
from augment.view.render_view import render_view
from recipes.fields import changed, section_at
from recipes.load import load_recipe
from recipes.schema import Recipe
from tools.pictures import resized, write, write_rgb

Preset = Literal["fog-bank", "passing-shower", "drying-road", "first-snow"]  # Strip to draw.
STREET = "procedural:street?seed=3&frames=40&width=1280&height=720"
# Width of one picture, pixels.
CELL_WIDTH = 400
# Number of pictures of a drive.
NUM_PICTURES = 5
# Share of a picture's rows that are cut off below.
LOWER_SHARE = 0.08
# Quality of the JPEG files.
QUALITY = 74
# Scale of the rendering.
SCALE = 0.75
# Where the shower of the street and that of the recorded drive come from: ahead of the cameras.
FROM_DEG = {"splats": 20.0, "recorded": 60.0}


def label_of(recipe: Recipe, minutes: float) -> str:
    """Return the time of the weather and its numbers, for a picture."""
    text = f"{minutes:.0f} min" if minutes >= 1 else f"{60 * minutes:.0f} s"
    parts = {
        "weather.smog.visibility_m": "mean visibility {:.0f} m",
        "weather.rain.rate_mm_h": "rain {:.0f} mm/h",
        "weather.rain.road.film_mm": "film {:.2f} mm",
        "weather.snowfall.rate_mm_h": "snowfall {:.0f} mm/h",
    }
    numbers = ((form, section_at(recipe, path)) for path, form in parts.items())
    texts = [form.format(number) for form, number in numbers if number is not None]
    depth_m = section_at(recipe, "weather.snow.depth_m")
    if depth_m is not None:
        texts.append(f"snow {100 * depth_m:.1f} cm")
    return ", ".join([text, *texts])


def draw_row(preset: str, scene: Scene, camera: str, base: str) -> np.ndarray:
    """Return the pictures of a scene's camera over its drive, side by side."""
    fields: dict[str, object] = {"render.base": base, "render.scale": SCALE}
    recipe = load_recipe(preset).resolve(0)
    if preset == "passing-shower":
        fields["weather.rain.wind_from_deg"] = FROM_DEG[base]
    recipe = changed(recipe, fields)
    numbers = np.linspace(0, len(scene.frames) - 1, NUM_PICTURES)
    pictures = []
    for number in numbers.round().astype(int):
        view = scene.frames[number].cameras[camera]
        rgb = render_view(scene, view, recipe).rgb
        picture = resized(rgb, CELL_WIDTH, cv2.INTER_AREA)
        picture = picture[: round((1 - LOWER_SHARE) * len(picture))].copy()
        times = scene_times(scene)
        minutes = recipe.weather_time_s(times, view.timestamp_ns) / 60
        label = label_of(recipe.at(times, view.timestamp_ns), minutes)
        for color, offset_px in (((0, 0, 0), 1), ((255, 255, 255), 0)):
            write(picture, label, 6 + offset_px, 17 + offset_px, size=0.42, color=color)
        pictures.append(picture)
    return np.hstack(pictures)


def main(
    *,
    drive: str | None = None,
    output_dir: Path = Path(__file__).parent,
    presets: tuple[Preset, ...] = ("fog-bank", "passing-shower", "drying-road", "first-snow"),
) -> None:
    """Draw the strips.

    Args:
        drive: address of a recorded drive with a camera `front_camera`.
        output_dir: folder for the pictures.
        presets: presets whose strips are drawn.
    """
    street = open_scene(STREET)
    recorded = None if drive is None else open_scene(drive)
    for preset in presets:
        rows = [draw_row(preset, street, "front", "splats")]
        if recorded is not None:
            rows.append(draw_row(preset, recorded, "front_camera", "recorded"))
        write_rgb(output_dir / f"over-time-{preset}.jpg", np.vstack(rows), jpeg_quality=QUALITY)


if __name__ == "__main__":
    tyro.cli(main)
