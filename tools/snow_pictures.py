"""Pictures of snow for the docs: depths, shadings, height estimators and masks."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from adapters.base import open_scene, parse_uri
from adapters.procedural import StreetTruth, open_truth
from augment.cameras import Camera
from augment.effects.snow.height_map import Estimator
from augment.effects.snow.layer import build_snow_layer
from augment.effects.snow.light import illumination_of
from augment.effects.snow.placement import PlacementSettings, place_snow_support
from augment.effects.snow.snow import placement_settings
from augment.effects.snow.support import remember_support
from augment.plan import make_plan
from augment.render.composite import quantise
from augment.scene import Scene
from augment.views import WeatheredBuffers, render_buffers
from recipes.schema import Output, Recipe, Weather
from recipes.weather import Snow
from tools.bench_snow_accuracy import draw_snow
from tools.bench_snow_truth import camera_from_above, pixel_places, still, surface_below
from tools.drawing import captioned, color_mapped, strip, write_jpeg

STREET = "procedural:street?seed=3"
CAMERA, FRAME, SCALE = "front", 5, 0.6
REPEATS = 11
CELL_M = 0.05
DEPTHS_M = (0.02, 0.1, 0.4)
ESTIMATORS: tuple[Estimator, ...] = ("mode", "median", "expected")
CLOSE = 3.0  # of the close view's resolution over the picture's
CLOSE_AT = (0.30, 0.62, 0.34, 0.34)  # left, top, width, height of the close view, of the picture
EDGES_CAMERA, EDGES_AT = "front", (0.0, 0.38, 0.34, 0.34)  # where things end against each other
EDGES_ZOOM = 3.0
ABOVE_REACH_M, ABOVE_PIXEL_M = 9.0, 0.05
ERROR_RANGE_M = 0.3
MASK_RGB, MASK_SHARE = (30, 90, 255), 0.55


def draw_snow_pictures(folder: Path) -> list[Path]:
    """Four JPEGs: snow-depths, snow-shading, snow-estimators, snow-masks."""
    scene, truth = open_scene(STREET), open_truth(parse_uri(STREET)[2])
    drawings: dict[str, Callable[[], np.ndarray]] = {
        "snow-depths": lambda: draw_depths(scene),
        "snow-shading": lambda: draw_shadings(scene),
        "snow-masks": lambda: draw_masks(scene),
        "snow-estimators": lambda: draw_estimators(scene, truth),
    }
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, draw in tqdm(drawings.items(), unit="picture"):
        paths.append(folder / f"{name}.jpg")
        write_jpeg(paths[-1], draw())
    return paths


def draw_depths(scene: Scene) -> np.ndarray:
    """One view under three depths, with the time of each."""
    camera = scene.frame(FRAME).cameras[CAMERA].scaled(SCALE)
    clean_s, _ = _timed(scene, camera, None)
    panels = []
    for depth_m in DEPTHS_M:
        seconds, frame = _timed(scene, camera, Snow(depth_m=depth_m, cell_m=CELL_M))
        text = f"{1e3 * seconds:.0f} ms (clean {1e3 * clean_s:.0f} ms)"
        panels.append(captioned(quantise(frame.rgb), f"{100 * depth_m:g} cm of snow", text))
    return strip(panels)


def draw_shadings(scene: Scene) -> np.ndarray:
    """Both shadings, and a part of each rendered larger below it."""
    camera = scene.frame(FRAME).cameras[CAMERA].scaled(SCALE)
    close = _window(camera, CLOSE_AT, CLOSE)
    clean_s, _ = _timed(scene, camera, None)
    columns = []
    for shading in ("per_splat", "per_pixel"):
        snow = Snow(depth_m=0.1, shading=shading, cell_m=CELL_M)
        seconds, frame = _timed(scene, camera, snow)
        larger = _frame(scene, close, snow)
        text = f"{1e3 * seconds:.0f} ms (clean {1e3 * clean_s:.0f} ms); {CLOSE:g} x below"
        picture = captioned(quantise(frame.rgb), f"shading: {shading}", text)
        height = round(close.height * camera.width / close.width)
        part = cv2.resize(
            quantise(larger.rgb), (camera.width, height), interpolation=cv2.INTER_AREA
        )
        columns.append(np.concatenate([picture, part]))
    return strip(columns)


def draw_masks(scene: Scene) -> np.ndarray:
    """Three neighbouring cameras with their snow masks laid over them."""
    panels = []
    for name in ("front_left", "front", "front_right"):
        camera = scene.frame(FRAME).cameras[name].scaled(SCALE)
        frame = _frame(scene, camera, Snow(depth_m=0.1, cell_m=CELL_M))
        assert frame.snow is not None
        mask = frame.snow.numpy()
        rgb = quantise(frame.rgb).astype(np.float32)
        rgb[mask] += MASK_SHARE * (np.array(MASK_RGB, np.float32) - rgb[mask])
        text = f"{100 * mask.mean():.0f} % of the pixels are snow"
        panels.append(captioned(rgb.round().astype(np.uint8), f"mask of {name}", text))
    return strip(panels)


def draw_estimators(scene: Scene, truth: StreetTruth) -> np.ndarray:
    """Heights of the drawn snow against the true surface raised by its depth, from straight above;
    and a part of a picture with silhouettes; for each depth buffer that placement can use.
    """
    cameras = [camera for frame in scene.frames for camera in frame.cameras.values()]
    snow, truth = Snow(depth_m=0.1, cell_m=CELL_M, tracks="never"), still(truth)
    near = scene.frame(FRAME).cameras.values()
    above = camera_from_above(list(near), reach_m=ABOVE_REACH_M, pixel_m=ABOVE_PIXEL_M)
    top = surface_below(truth, pixel_places(above).reshape(-1, 2)).reshape(above.height, -1)
    view = scene.frame(FRAME).cameras[EDGES_CAMERA].scaled(SCALE)
    view = _window(view, EDGES_AT, EDGES_ZOOM)
    columns = []
    for estimator in ESTIMATORS:
        bed = place_snow_support(
            scene, cameras, PlacementSettings(cell_m=CELL_M, estimator=estimator)
        )
        cover = build_snow_layer(bed, scene, snow, illumination_of(scene, snow), seed=0)
        height, shown = draw_snow(scene, cover, above)
        error = height - top - snow.depth_m
        map_rgb = color_mapped(0.5 + error / (2 * ERROR_RANGE_M), cv2.COLORMAP_TWILIGHT_SHIFTED)
        map_rgb[~shown] = 255
        size = np.abs(error[shown])
        text = (
            f"median error {100 * np.median(size):.1f} cm, {100 * (size > 0.1).mean():.1f} % off "
            f"by more than 10 cm"
        )
        with_bed = dataclasses.replace(scene)  # beds and covers are remembered by scene
        remember_support(with_bed, placement_settings(snow), bed)
        picture = quantise(_frame(with_bed, view, snow).rgb)
        width = map_rgb.shape[1]
        part = cv2.resize(picture, (width, round(width * view.height / view.width)))
        title = f"heights from {estimator} depth: blue too low, red too high"
        columns.append(np.concatenate([captioned(map_rgb, title, text), part]))
    return strip(columns)


def _window(camera: Camera, at: tuple[float, float, float, float], zoom: float) -> Camera:
    """A part of an image, given in shares of it, at `zoom` times its resolution."""
    left, top, width, height = at
    return camera.cropped(
        round(left * camera.width),
        round(top * camera.height),
        round(width * camera.width),
        round(height * camera.height),
    ).scaled(zoom)


def _frame(scene: Scene, camera: Camera, snow: Snow | None) -> WeatheredBuffers:
    recipe = Recipe(weather=Weather(snow=snow), output=Output(depth="none", labels=False))
    return render_buffers(scene, camera, make_plan(recipe, scene))


def _timed(scene: Scene, camera: Camera, snow: Snow | None) -> tuple[float, WeatheredBuffers]:
    """Least seconds of a few frames after one that is not counted, and the frame."""
    frame = _frame(scene, camera, snow)
    seconds = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        frame = _frame(scene, camera, snow)
        seconds.append(time.perf_counter() - started)
    return min(seconds), frame
