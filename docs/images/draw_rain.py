"""Draw the pictures of rain, snowfall and weathered LiDAR in this folder again, within minutes.

    python docs/images/draw_rain.py --drive scene:scenes/002

The pictures `drive` and `lidar` show a fitted PandaSet drive (docs/reconstruction.md). Without
--drive they are not made.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import tyro

from adapters.base import open_scene
from augment.effects.lidar import codes
from augment.scene.geometry import invert_rigid
from augment.scene.scene import Scene
from augment.view.render_view import render_view
from augment.view.weathered_sweep import weathered_sweep
from recipes.load import load_recipe, read_overrides
from recipes.schema import Recipe
from tools.pictures import resized, write, write_rgb, write_video

Which = Literal["street", "drive", "lidar", "video"]  # A picture that is made.
STREET = "procedural:street?seed=3&frames=40"  # The address of the street.
FRAME = 12  # The index of the frame that pictures show.
CELL_WIDTH = 600  # The width of one picture among several, pixels.
COLUMNS = 3  # The number of pictures side by side.
QUALITY = 76  # The quality of JPEG files.
# The presets of falling weather that are shown.
PRESETS = ("drizzle", "rain", "downpour", "flurries", "snowfall", "blizzard")
# The style of dusk. It is applied to the finished picture, so that snow and flakes get the same
# light as everything else.
DUSK = ("style.preset=grey-dusk", "style.strength=1", "style.applied_to=picture")
# The frames of the video by preset.
VIDEO = {"downpour": range(20), "blizzard": range(20, 40)}
VIDEO_SIZE = (640, 360)  # The width and height of the video, pixels.
VIDEO_HZ = 10  # The video's frames a second.

# The weathers of LiDAR sweeps by title, as texts of `--set`.
SWEEPS: dict[str, tuple[str, ...]] = {
    "clear": (),
    "fog, visibility 60 m": ("weather.smog.visibility_m=60",),
    "flood, 12 cm, 60 NTU": ("weather.flood={level_m: 0.12, turbidity_ntu: 60}",),
    "rain, 50 mm/h, wet road": ("weather.rain.rate_mm_h=50",),
    "snowfall, 1 mm/h": ("weather.snowfall.rate_mm_h=1",),
    "snow on the ground, 20 cm": ("weather.snow.depth_m=0.2",),
}
# The name and the colour of every weather_code of a LiDAR return.
CODES = {
    codes.UNCHANGED: ("unchanged", (150, 150, 150)),
    codes.ATTENUATED: ("attenuated", (120, 185, 235)),
    codes.LOST: ("lost (where it was)", (85, 85, 85)),
    codes.MOVED: ("moved", (255, 255, 255)),
    codes.SCATTERED: ("scattered", (255, 115, 60)),
    codes.PRECIPITATION: ("drops, flakes", (255, 225, 70)),
}
PX_PER_M = 8  # The scale of a sweep's panel, pixels a metre.
PANEL = (500, 350)  # The width and height of the view from above, pixels.
SIDE = 96  # The height of the view from the side, pixels.
GROUND = 24  # The grey of a panel, 0 to 255.


def main(
    which: tuple[Which, ...] = ("street", "drive", "lidar", "video"),
    drive: str | None = None,
    out: Path = Path("docs/images"),
) -> None:
    """Draw the documentation's pictures of rain and snowfall.

    Args:
        which: The pictures to make.
        drive: A fitted drive with a camera front_camera and LiDAR sweeps.
        out: The folder of the pictures.
    """
    if "street" in which or "video" in which:
        street = open_scene(STREET)
        if "street" in which:
            draw_weathers(street, "front", 1.0, out / "rain-street.jpg")
        if "video" in which:
            frames = drive_through(street, "front")
            write_video(out / "rain.mp4", frames, VIDEO_HZ)
    if drive is not None and ("drive" in which or "lidar" in which):
        fitted = open_scene(drive)
        if "drive" in which:
            draw_weathers(fitted, "front_camera", 0.5, out / "rain-drive.jpg")
        if "lidar" in which:
            write_rgb(out / "lidar-weather.png", sweeps_from_above(fitted))


def recipe_of(preset: str, sets: Sequence[str], scale: float = 1.0) -> Recipe:
    """Return a preset's recipe with changed fields. sets: texts of `--set`."""
    overrides = read_overrides([*sets, f"render.scale={scale}"])
    return load_recipe(preset, overrides).resolve(0)


def draw_weathers(scene: Scene, camera: str, scale: float, path: Path) -> None:
    """Draw all kinds of falling weather, COLUMNS beside each other, by day above dusk."""
    lines = []
    recorded_camera = scene.frame(FRAME).cameras[camera]
    for first in range(0, len(PRESETS), COLUMNS):
        for time, sets in (("day", ()), ("dusk", DUSK)):
            cells = []
            for preset in PRESETS[first : first + COLUMNS]:
                rgb = render_view(scene, recorded_camera, recipe_of(preset, sets, scale)).rgb
                cell = resized(rgb, CELL_WIDTH, cv2.INTER_AREA)
                write_title(cell, f"{preset}, {time}")
                cells.append(cell)
            lines.append(np.hstack(cells))
    write_rgb(path, np.vstack(lines), jpeg_quality=QUALITY)


def drive_through(scene: Scene, camera: str) -> Iterator[np.ndarray]:
    """Yield the frames of a drive whose weather changes."""
    for preset, numbers in VIDEO.items():
        for number in numbers:
            recorded_camera = scene.frame(number).cameras[camera].resized(*VIDEO_SIZE)
            rgb = render_view(
                scene, recorded_camera, recipe_of(preset, ("camera.noise=0",))
            ).rgb.copy()
            write_title(rgb, preset)
            yield rgb


def write_title(image: np.ndarray, text: str) -> None:
    """Write a text into an image's upper left corner, white with a black shadow."""
    write(image, text, 11, 25, size=0.6, color=(0, 0, 0))
    write(image, text, 10, 24, size=0.6, color=(255, 255, 255))


def sweeps_from_above(scene: Scene) -> np.ndarray:
    """Draw a panel for each of SWEEPS: view from above, shares of its codes, view from the side."""
    panels = [_panel(scene, title, recipe_of("clear", sets)) for title, sets in SWEEPS.items()]
    lines = [np.hstack(panels[k : k + COLUMNS]) for k in range(0, len(panels), COLUMNS)]
    return np.vstack(lines)


def _panel(scene: Scene, title: str, recipe: Recipe) -> np.ndarray:
    """Draw the panel of one sweep, uint8 [H, W, 3]."""
    frame = scene.frame(FRAME)
    source = scene.lidar(FRAME)
    assert source is not None, f"{scene.name} has no sweep of frame {FRAME}"
    sweep = weathered_sweep(scene, recipe, FRAME, source)
    point_codes = sweep.columns.get(codes.CODE_COLUMN, np.zeros(len(sweep.points_m), np.uint8))
    points = np.where((point_codes == codes.LOST)[:, None], source.points_m, sweep.points_m)
    ego_from_world = invert_rigid(frame.world_from_ego).numpy()
    points = points - np.asarray(scene.world_origin_m)
    points = points @ ego_from_world[:3, :3].T + ego_from_world[:3, 3]

    width, height = PANEL
    panel = np.full((height + SIDE, width, 3), GROUND, np.uint8)
    across = width / 3 + PX_PER_M * points[:, 0]
    above = height / 2 - PX_PER_M * points[:, 1]
    beside = height + SIDE - 12 - PX_PER_M * points[:, 2]
    is_near = np.abs(points[:, 1]) < 6  # The view from the side shows only these points.
    shares = []
    for code, (name, color) in CODES.items():
        has_code = point_codes == code
        _dot(panel[:height], across[has_code], above[has_code], color)
        if code != codes.LOST:
            _dot(
                panel[height:],
                across[has_code & is_near],
                beside[has_code & is_near] - height,
                color,
            )
        if has_code.any():
            percent = 100 * has_code.mean()
            shares.append(
                (f"{name} {percent:.0f} %" if percent >= 1 else f"{name} {percent:.1g} %", color)
            )
    panel[: 36 + 17 * len(shares), :210] = GROUND
    write(panel, title, 12, 24, size=0.6, color=(255, 255, 255))
    for line, (text, color) in enumerate(shares):
        write(panel, text, 12, 44 + 17 * line, size=0.42, color=color)
    panel[height] = panel[0] = panel[:, 0] = 90
    return panel


def _dot(image: np.ndarray, x: np.ndarray, y: np.ndarray, color: tuple[int, int, int]) -> None:
    """Draw points at columns x and rows y that lie inside the image."""
    column = np.floor(x).astype(int)
    row = np.floor(y).astype(int)
    inside = (column >= 0) & (column < image.shape[1]) & (row >= 0) & (row < image.shape[0])
    image[row[inside], column[inside]] = color


if __name__ == "__main__":
    tyro.cli(main)
