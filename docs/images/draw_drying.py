"""Draw the picture of a road that gets wet and dries again, within minutes.

    python docs/images/draw_drying.py --drive pandaset:PANDASET/002

Left the embedded street, right a recorded drive of PandaSet, if it is given.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import tyro

from adapters.base import open_scene
from augment.scene.scene import Scene
from augment.view.render_view import render_view
from recipes.fields import changed
from recipes.load import parse_recipe
from recipes.moment import ANY_DRIVE
from tools.pictures import resized, write_rgb

STREET = "procedural:street?seed=3&frames=3&width=1280&height=720"
# Width of one picture, pixels.
CELL_WIDTH = 620
# Share of a picture's rows that are cut off above.
UPPER_SHARE = 0.42
# Quality of the JPEG file.
QUALITY = 72
# Times of the pictures, seconds since the rain begins, with their labels.
MOMENTS = {
    -10: "dry",
    55: "1 min: first drops",
    900: "15 min: rain of 10 mm/h",
    2400: "after 23 min of sun",
    3300: "38 min",
    4200: "53 min",
    5400: "73 min",
}
# A quarter of an hour of rain on a warm day, then sun.
RECIPE = """
seed: 3
weather:
  rain:
    rate_mm_h: {timeline: [[0, 0], [120, 10], [900, 10], [1000, 0]]}
  air: {temperature_c: 25, humidity: 0.5, wind_m_s: 3, road_warmer_k: 5}
output: {depth: none, semantic: false, labels: false}
"""


def draw_column(scene: Scene, camera: str, base: str) -> list[np.ndarray]:
    """Return the pictures of a scene's camera at all moments."""
    recipe = parse_recipe(RECIPE, source="drying road").resolve(0)
    recipe = changed(recipe, {"render.base": base})
    pictures = []
    for time_s, label in MOMENTS.items():
        moment = recipe.at_weather_time(ANY_DRIVE, float(time_s))
        view = scene.frames[0].cameras[camera]
        rgb = render_view(scene, view, moment).rgb
        picture = resized(rgb[int(UPPER_SHARE * len(rgb)) :], CELL_WIDTH, cv2.INTER_AREA)
        for color, width in (((0, 0, 0), 4), ((255, 255, 255), 1)):
            cv2.putText(picture, label, (8, 22), 0, 0.6, color, width, cv2.LINE_AA)
        pictures.append(picture)
    return pictures


def main(*, drive: str | None = None, output_dir: Path = Path(__file__).parent) -> None:
    """Draw the picture.

    Args:
        drive: address of a recorded drive with a camera `front_camera`.
        output_dir: folder for the picture.
    """
    columns = [draw_column(open_scene(STREET), "front", "splats")]
    if drive is not None:
        columns.append(draw_column(open_scene(drive), "front_camera", "recorded"))
    height = min(len(picture) for column in columns for picture in column)
    image = np.hstack([np.vstack([p[-height:] for p in column]) for column in columns])
    write_rgb(output_dir / "drying-road.jpg", image, jpeg_quality=QUALITY)


if __name__ == "__main__":
    tyro.cli(main)
