"""What a reconstruction is worth: recorded views against their renders, as figures in JSON and
Markdown, curves, and pictures; and against the exact depth of a procedural street.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np
import torch
from tqdm import tqdm

from adapters.uri import parse_uri
from augment.errors import AdapterError
from augment.metrics.image import DepthErrors, depth_errors, flip, flip_map, psnr, ssim
from augment.output.atomic import make_folder, make_output_error, write_atomic
from augment.reconstruct.view import RecordedView, ViewKey, ViewSource
from augment.render.buffers import EXPECTED_DEPTH, MEDIAN_DEPTH
from augment.render.composite import to_byte_array
from augment.render.constants import SURFACE_ALPHA
from augment.scene.cameras import Camera
from augment.scene.geometry import rigid
from augment.scene.scene import Scene
from augment.scene.semantics import SemanticClass
from augment.view.plan import make_plan
from augment.view.render_view import render_buffers
from recipes.load import load_recipe
from recipes.schema import Recipe
from tools.axis_ticks import log_ticks, short_number
from tools.chosen_images import evenly
from tools.output import fill
from tools.pictures import color_bar, color_mapped, resized, write, write_rgb
from tools.training import FIT_PANELS, write_curves

if TYPE_CHECKING:
    from adapters.procedural import StreetTruth

MAX_TRAINING_VIEWS = 60  # where nothing is held out
TRAINING_SAMPLE = 12  # beside the held-out views, to see what was learnt by heart
MAX_TRUE_VIEWS = 24
CURVES = "curves.png"  # the file with the curves of the training
PICTURES = "held_out.jpg"  # the file with pictures of held-out views
TRAINING_PICTURES = "training_views.jpg"  # the same of training views
MAX_ROWS = 12  # of the pictures
MAX_OF_A_CAMERA = 3
CELL_WIDTH = 480  # px of one image of the pictures
_GAP = 6  # the space between two images of the sheet, in pixels
_EDGE = 16  # the margin of the sheet, in pixels
_HEAD = 70  # the space above the first row, in pixels
_TITLE = 34  # the space above each row's images, in pixels
_BACKGROUND = (250, 250, 250)  # the colour of the sheet in RGB, 0 to 255
_INK = (30, 30, 30)  # the colour of text
_SOFT = (110, 110, 110)  # the colour of tick marks
_NOTHING = (90, 90, 90)  # the colour of pixels without a value
_BAR = (200, 10)  # width and height of a colour bar, in pixels
_FLIP_COLORS = cv2.COLORMAP_MAGMA  # the colour map of FLIP
_DEPTH_COLORS = cv2.COLORMAP_TURBO  # the colour map of depth

DEFINITIONS = {
    "picture": "rendered without weather, with the camera's recorded exposure, clamped to [0, 1] "
    "and rounded to 8 bits; at the resolution of the fit; pixels of weight 0 left out",
    "psnr": "dB, mean over the views",
    "ssim": "Wang et al. 2004, 11x11 Gaussian window of sigma 1.5, zeros beyond the border, mean "
    "over the colour channels (as 3D Gaussian Splatting)",
    "flip": "mean LDR-FLIP at 67 pixels per degree; 0 is equal",
    "depth": "|rendered - prior| at the view's depth priors where the render has a surface (alpha "
    ">= 0.5); quantiles within a view, then their mean over the views; depth_* is the median "
    "depth, as in depth images, expected_depth_* the expected depth",
    "no_surface": "part of the pixels with a depth prior that the render shows no surface at",
}

# By name in JSON: title, text, factor before it is written.
_COLUMNS = {
    "views": ("views", "{:.0f}", 1),
    "psnr": ("PSNR, dB", "{:.2f}", 1),
    "ssim": ("SSIM", "{:.3f}", 1),
    "flip": ("FLIP", "{:.3f}", 1),
    "depth_median_m": ("depth error, median", "{:.3f}{unit}", 1),
    "depth_p90_m": ("90 %", "{:.2f}{unit}", 1),
    "depth_within_5cm": ("within 5 cm", "{:.0f} %", 100),
    "no_surface": ("no surface", "{:.1f} %", 100),
}


def write_report(
    folder: Path,
    scene: Scene,
    source: ViewSource,
    history: Sequence[Mapping[str, Any]],
    facts: Mapping[str, Any] | None = None,
    *,
    test: Sequence[ViewKey] | None = None,
) -> dict[str, Any]:
    """Evaluate the held-out views, or those of them in `test`, and write report.json, report.md,
    curves.png and held_out.jpg.

    Without held-out views, training views are scored, at most MAX_TRAINING_VIEWS of them, and the
    report says so; the pictures are then training_views.jpg. history: rows of averages {"step",
    "seconds", "loss", "splats", ...} and of evaluations with "split" (test or train), "psnr",
    "depth_median_m". facts: what else is to stand in report.json, in JSON's types. Returns
    report.json's content.

    Raises:
        OutputError: the folder cannot be written.
    """
    split, keys, note = _choose_split(source)
    keys = test or keys
    scores = evaluate_views(scene, source, keys, progress=True)
    sample = None
    if split == "test":
        learnt = _spread(source.train, TRAINING_SAMPLE)
        means = mean_scores(evaluate_views(scene, source, learnt, with_flip=False))
        sample = {"views": len(learnt), **means}
    report = {
        **(facts or {}),
        "gaussians": sum(map(len, scene.all_gaussians)),
        "actors": len(scene.actors),
        "scored": {"split": split, "views": len(scores), "note": note},
        "mean": mean_scores(scores),
        "cameras": means_by_camera(scores),
        "training_sample": sample,
        "views": [{"frame": s.key.frame, "camera": s.key.camera, **s.numbers} for s in scores],
        "history": list(history),
        "definitions": DEFINITIONS,
    }
    report = _plain(report)
    pictures = _write_pictures(folder, scene, source, scores, history, split)
    write_atomic(folder / "report.md", _markdown(scene, report, pictures).encode())
    data = json.dumps(report, indent=1, ensure_ascii=False, allow_nan=False)
    write_atomic(folder / "report.json", data.encode())  # last: it says that all else is there
    return report


def _choose_split(source: ViewSource) -> tuple[str, tuple[ViewKey, ...], str]:
    """Choose the views to score: test or train, the views, and a note for the reader."""
    if source.test:
        return "test", source.test, ""
    keys = _spread(source.train, MAX_TRAINING_VIEWS)
    part = "all of them" if len(keys) == len(source.train) else f"{len(keys)} of them"
    note = (
        f"No view was held out: these are training views ({part}), which the scene was fitted to, "
        f"so the figures say less than those of views it has never seen."
    )
    return "train", keys, note


def _spread(keys: Sequence[ViewKey], max_keys: int) -> tuple[ViewKey, ...]:
    """Choose at most max_keys views, as many of each camera, evenly spread over its views."""
    if len(keys) <= max_keys:
        return tuple(keys)
    cameras = {key.camera for key in keys}
    chosen_keys = set(_of_each_camera(keys, cameras, max(1, max_keys // len(cameras))))
    return tuple(key for key in keys if key in chosen_keys)


def _of_each_camera(
    keys: Sequence[ViewKey], cameras: Iterable[str], max_keys: int
) -> list[ViewKey]:
    return [
        key
        for name in cameras
        for key in evenly([key for key in keys if key.camera == name], max_keys)
    ]


def _write_pictures(
    folder: Path,
    scene: Scene,
    source: ViewSource,
    scores: Sequence[ViewScore],
    history: Sequence[Mapping[str, Any]],
    split: str,
) -> dict[str, str]:
    """Titles by file name. Pictures of an earlier report that are no longer true are removed."""
    try:
        make_folder(folder)
        for name in (CURVES, PICTURES, TRAINING_PICTURES):
            (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise make_output_error(folder, error) from error
    titles: dict[str, str] = {}
    if scores:
        name = PICTURES if split == "test" else TRAINING_PICTURES
        write_rgb(folder / name, draw_views(scene, source, choose_views(scores)))
        titles[name] = "recorded, rendered, error, depth"
    if write_curves(folder / CURVES, history, FIT_PANELS):
        titles[CURVES] = "loss, PSNR, depth error and Gaussians over the steps"
    return titles


def _markdown(scene: Scene, report: Mapping[str, Any], pictures: Mapping[str, str]) -> str:
    """Table of a row per camera and one of the means over all views, without empty columns."""
    unit = " m" if scene.has_metric_scale else ""
    total = {"views": report["scored"]["views"], **report["mean"]}

    def cell(row: Mapping[str, float], name: str) -> str:
        _, text, factor = _COLUMNS[name]
        return text.format(row[name] * factor, unit=unit) if name in row else "-"

    text = fill(
        "fit_report.md",
        scene=scene,
        report=report,
        pictures=pictures,
        columns=_COLUMNS,
        known=[name for name in _COLUMNS if name in total],
        rows=[*report["cameras"].items(), ("**all**", total)],
        cell=cell,
    )
    return text + "\n"


def _plain(value: Any) -> Any:
    """The same in JSON's own types; numbers that JSON has none for, NaN and infinity, as null."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


class HeldOutRender(NamedTuple):
    """A camera's view as users get it without weather. rgb: uint8 [H, W, 3], clamped to [0, 1] and
    rounded to 8 bits. alpha, median_depth_m, expected_depth_m: float32 [H, W]. has_surface: bool
    [H, W], where a depth is written to files.
    """

    rgb: np.ndarray
    alpha: np.ndarray
    median_depth_m: np.ndarray
    expected_depth_m: np.ndarray
    has_surface: np.ndarray


class ViewScore(NamedTuple):
    """One view's render against its recording: figures by the names that reports use, NaN where
    nothing is known.

    psnr (dB), ssim, flip: over the pixels of weight > 0, which are the part `scored` of all.
    depth_*, expected_depth_*: errors of the median depth, as in files, and of the expected one,
    over the pixels with a depth prior and a surface, weighted as the priors. no_surface: the part
    of the pixels with a prior that have none.
    """

    key: ViewKey
    numbers: dict[str, float]


def evaluate_views(
    scene: Scene,
    source: ViewSource,
    keys: Sequence[ViewKey],
    *,
    with_flip: bool = True,
    progress: bool = False,
) -> list[ViewScore]:
    """The score of every view, at the source's resolution and with recorded exposure.

    Only weights of 0 leave a pixel out: a scene is judged on the whole picture, not where learning
    was easy. with_flip: FLIP takes most of the time, 0.2 s for 480x270 pixels on one core.
    """
    bar = tqdm(keys, desc="evaluate", unit="view", disable=None if progress else True)
    return [_score(key, scene, source.load(key), with_flip) for key in bar]


def mean_scores(scores: Iterable[ViewScore]) -> dict[str, float]:
    """Means over the views by the names of `ViewScore`, each over the views that have a
    number; names that no view has one for are left out, as are infinite means (equal pictures).
    """
    rows = [score.numbers for score in scores]
    means: dict[str, float] = {}
    for name in rows[0] if rows else ():
        values = [row[name] for row in rows if not math.isnan(row[name])]
        if values and math.isfinite(mean := float(np.mean(values))):
            means[name] = mean
    return means


def means_by_camera(scores: Sequence[ViewScore]) -> dict[str, dict[str, float]]:
    """`mean_scores` of every camera, with the number of its views."""
    cameras = dict.fromkeys(score.key.camera for score in scores)
    return {
        name: {"views": len(camera_scores), **mean_scores(camera_scores)}
        for name in cameras
        for camera_scores in [[score for score in scores if score.key.camera == name]]
    }


def render_recorded(scene: Scene, camera: Camera) -> HeldOutRender:
    """The view at the camera's own resolution under no weather, as its camera records it."""
    plan = make_plan(_clear(), scene)
    depths = {EXPECTED_DEPTH, MEDIAN_DEPTH}
    plan = dataclasses.replace(plan, image_buffers=plan.image_buffers | depths)
    buffers = render_buffers(scene, camera, plan)
    raster = buffers.raster
    assert raster.alpha is not None
    assert raster.median_depth is not None and raster.expected_depth is not None
    alpha = raster.alpha.numpy()
    return HeldOutRender(
        rgb=to_byte_array(buffers.rgb),
        alpha=alpha,
        median_depth_m=raster.median_depth.numpy(),
        expected_depth_m=raster.expected_depth.numpy(),
        has_surface=alpha >= SURFACE_ALPHA,
    )


@cache
def _clear() -> Recipe:
    return load_recipe("clear").resolve(0)


def _found_camera(scene: Scene, key: ViewKey, camera: Camera) -> Camera:
    """`camera` where the fitted scene says that it stood: a fit refines recorded poses."""
    pose = scene.frame(key.frame).cameras[key.camera].camera_from_world
    return dataclasses.replace(camera, camera_from_world=pose)


def _score(key: ViewKey, scene: Scene, view: RecordedView, with_flip: bool) -> ViewScore:
    rendered = render_recorded(scene, _found_camera(scene, key, view.camera))
    counts = view.weight > 0
    scored = float(counts.mean())
    numbers = {"psnr": math.nan, "ssim": math.nan, "flip": math.nan, "scored": scored}
    if scored > 0:
        metrics = {"psnr": psnr, "ssim": ssim, **({"flip": flip} if with_flip else {})}
        weight = None if scored == 1 else counts
        numbers |= {name: m(rendered.rgb, view.rgb, weight) for name, m in metrics.items()}
    at = view.depth_pixels
    surface = rendered.has_surface.reshape(-1)[at]

    def errors(depth_m: np.ndarray) -> DepthErrors:
        true_m = view.depth_m[surface]
        weight = view.depth_weight[surface]
        return depth_errors(depth_m.reshape(-1)[at[surface]], true_m, weight)

    median = errors(rendered.median_depth_m)
    expected = errors(rendered.expected_depth_m)
    numbers |= {
        "depth_median_m": median.median_m,
        "depth_p90_m": median.p90_m,
        "depth_abs_rel": median.abs_rel,
        "depth_within_5cm": median.within_5cm,
        "expected_depth_median_m": expected.median_m,
        "expected_depth_p90_m": expected.p90_m,
        "depth_pixels": float(median.pixels),
        "no_surface": float(1 - surface.mean()) if len(at) else math.nan,
    }
    return ViewScore(key, numbers)


class _Row(NamedTuple):
    """Images at the size they are drawn; depth_m [H, W], 0 where there is no surface; counts [H, W]
    bool, False where a pixel is left out of the scores."""

    score: ViewScore
    recorded: np.ndarray
    rendered: np.ndarray
    error: np.ndarray
    depth_m: np.ndarray
    counts: np.ndarray


def choose_views(scores: Sequence[ViewScore]) -> list[ViewScore]:
    """A few views of every camera, evenly spread over the drive, at most MAX_ROWS in all.

    Of more cameras than that, the first ones.
    """
    by_key = {score.key: score for score in scores}
    cameras = list(dict.fromkeys(key.camera for key in by_key))[:MAX_ROWS]
    views_per_camera = max(1, min(MAX_OF_A_CAMERA, MAX_ROWS // max(1, len(cameras))))
    return [by_key[key] for key in _of_each_camera(list(by_key), cameras, views_per_camera)]


def draw_views(scene: Scene, source: ViewSource, scores: Sequence[ViewScore]) -> np.ndarray:
    """uint8 RGB: a row for every view, recorded | rendered | FLIP | depth, with its figures."""
    rows = [_row(scene, source, score) for score in scores]
    nearest, farthest = _depth_range(rows)
    heights = [_TITLE + row.recorded.shape[0] + _GAP for row in rows]
    width = 2 * _EDGE + 4 * CELL_WIDTH + 3 * _GAP
    sheet = np.full((_HEAD + sum(heights) + _EDGE, width, 3), _BACKGROUND, np.uint8)
    unit = " m" if scene.has_metric_scale else ""
    _draw_head(sheet, nearest, farthest, unit)
    top = _HEAD
    for row, height in zip(rows, heights, strict=True):
        key = row.score.key
        has_depth = row.depth_m > 0
        write(sheet, f"{key.camera}, frame {key.frame}", _EDGE, top + 24, size=0.6, color=_INK)
        write(sheet, _figures(row.score.numbers, unit), _column(1), top + 24, size=0.5, color=_INK)
        # Near is red, far is blue.
        part = np.log(np.where(has_depth, row.depth_m, nearest) / nearest) / np.log(
            farthest / nearest
        )
        images = (
            row.recorded,
            row.rendered,
            _masked(color_mapped(row.error, _FLIP_COLORS), row.counts),
            _masked(color_mapped(1 - part, _DEPTH_COLORS), has_depth),
        )
        for i, image in enumerate(images):
            y = top + _TITLE
            x = _column(i)
            sheet[y : y + image.shape[0], x : x + CELL_WIDTH] = image
        top += height
    return sheet


def _row(scene: Scene, source: ViewSource, score: ViewScore) -> _Row:
    view = source.load(score.key)
    rendered = render_recorded(scene, _found_camera(scene, score.key, view.camera))
    counts = view.weight > 0
    if counts.any():
        error = flip_map(rendered.rgb, view.rgb, counts)
    else:
        error = np.zeros(counts.shape, np.float32)
    depth = np.where(rendered.has_surface, rendered.median_depth_m, np.float32(0))
    smooth = cv2.INTER_AREA if view.rgb.shape[1] > CELL_WIDTH else cv2.INTER_LINEAR
    images = [resized(image, CELL_WIDTH, smooth) for image in (view.rgb, rendered.rgb, error)]
    # Depths and masks do not average: between two surfaces there is none.
    masks = [
        resized(mask, CELL_WIDTH, cv2.INTER_NEAREST) for mask in (depth, counts.astype(np.uint8))
    ]
    return _Row(score, *images, depth_m=masks[0], counts=masks[1] > 0)


def _depth_range(rows: Sequence[_Row]) -> tuple[float, float]:
    """Nearest and farthest depth of the colour scale: all but 1 % at both ends, 2 digits."""
    depths = np.concatenate([row.depth_m[row.depth_m > 0] for row in rows] or [np.zeros(0)])
    if not len(depths):
        return 1.0, 100.0
    low, high = (float(f"{v:.1g}") for v in np.quantile(depths, (0.01, 0.99)))
    return low, max(high, 2 * low)


def _masked(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    return np.where(mask[..., None], image, np.array(_NOTHING, np.uint8))


def _draw_head(sheet: np.ndarray, nearest: float, farthest: float, unit: str) -> None:
    for i, name in enumerate(("recorded", "rendered", "FLIP error", "depth")):
        write(sheet, name, _column(i), 34, size=0.8, color=_INK, thickness=2)
    flip_ticks = {f"{v:g}": v for v in (0.0, 0.5, 1.0)}
    _draw_scale(sheet, 2, color_bar(*_BAR, _FLIP_COLORS), flip_ticks, "left out")
    span = np.log(farthest / nearest)
    ticks = log_ticks(nearest, farthest)
    ticks = ticks[:: -(-len(ticks) // 4)]  # at most four, so that their texts do not meet
    depths = {f"{short_number(v)}{unit}": float(np.log(v / nearest) / span) for v in ticks}
    bar = color_bar(*_BAR, _DEPTH_COLORS)[:, ::-1]
    _draw_scale(sheet, 3, bar, depths, "no surface")


def _draw_scale(
    sheet: np.ndarray, column: int, bar: np.ndarray, ticks: dict[str, float], grey_meaning: str
) -> None:
    """A colour bar at the right end of a column's head, and what grey means to its left."""
    height, width = bar.shape[:2]
    x = _column(column) + CELL_WIDTH - width - 20
    y = 22
    sheet[y : y + height, x : x + width] = bar
    for text, part in ticks.items():
        at = x + part * width
        cv2.line(sheet, (round(at), y + height), (round(at), y + height + 4), _SOFT, 1)
        write(sheet, text, at, y + height + 20, size=0.45, color=_INK, centred=True)
    left = x - 106
    sheet[y : y + height, left : left + height] = _NOTHING
    write(sheet, grey_meaning, left + height + 5, y + height, size=0.45, color=_INK)


def _column(number: int) -> int:
    return _EDGE + number * (CELL_WIDTH + _GAP)


def _figures(numbers: Mapping[str, float], unit: str) -> str:
    """The row's figures that are known, in one line."""
    texts = {
        "psnr": "PSNR {:.2f} dB",
        "ssim": "SSIM {:.3f}",
        "flip": "FLIP {:.3f}",
        "depth_median_m": f"depth error {{:.3f}}{unit} (median)",
        "depth_p90_m": f"{{:.2f}}{unit} (90 %)",
    }
    formats = {name: text for name, text in texts.items() if not math.isnan(numbers[name])}
    return "     ".join(text.format(numbers[name]) for name, text in formats.items())


def true_depth_errors(
    scene: Scene, truth: StreetTruth, cameras: Sequence[Camera]
) -> dict[str, Any]:
    """Compare a scene's depth with the street's, over all pixels of cameras of the scene's own
    world; the scene may have moved the origin (`world_origin_m`), as an adapter of recordings does.

    Of the result, median, expected: errors of both depths (see `DepthErrors`) over the pixels that
    truly show a surface and are rendered with one. by_class: the median depth's, by the true
    class's name. no_surface: the part of the true surface pixels that are rendered without one.
    sky_covered: the part of the true sky pixels that are rendered with a surface; sky_alpha: their
    mean opacity. NaN where no pixel is meant.
    """
    origin = torch.from_numpy(np.asarray(scene.world_origin_m, np.float64))
    scene_from_dataset = rigid(torch.eye(3, dtype=torch.float64), -origin)
    views = []
    for camera in cameras:
        pose = camera.camera_from_world @ scene_from_dataset
        true_view = truth.render(dataclasses.replace(camera, camera_from_world=pose))
        views.append((render_recorded(scene, camera), true_view))

    def joined(images: Iterable[np.ndarray]) -> np.ndarray:
        return np.concatenate([image.reshape(-1) for image in images] or [np.zeros(0)])

    def errors(depth_m: np.ndarray, pixels: np.ndarray) -> dict[str, Any]:
        return dataclasses.asdict(depth_errors(depth_m[pixels], true_m[pixels]))

    surface = joined(rendered_view.has_surface for rendered_view, _ in views).astype(bool)
    median_m = joined(rendered_view.median_depth_m for rendered_view, _ in views)
    expected_m = joined(rendered_view.expected_depth_m for rendered_view, _ in views)
    alpha = joined(rendered_view.alpha for rendered_view, _ in views)
    true_m = joined(true_view.depth for _, true_view in views)
    semantic = joined(true_view.semantic for _, true_view in views)
    is_sky = np.isinf(true_m)
    compared_pixels = surface & ~is_sky
    return {
        "views": len(views),
        "median": errors(median_m, compared_pixels),
        "expected": errors(expected_m, compared_pixels),
        "by_class": {
            SemanticClass(int(c)).name.lower(): errors(median_m, compared_pixels & (semantic == c))
            for c in np.unique(semantic[~is_sky])
        },
        "no_surface": _mean(~surface[~is_sky]),
        "sky_covered": _mean(surface[is_sky]),
        "sky_alpha": _mean(alpha[is_sky]),
    }


def truth_facts(uri: str, scene: Scene, source: ViewSource) -> dict[str, Any]:
    """For reports: a fitted scene's depth against the street it was recorded from, JSON-able.

    uri: that street, procedural:street?...; at most MAX_TRUE_VIEWS held-out views (training views
    where none is held out) at their recorded cameras.

    Raises:
        AdapterError: the URI is no procedural street.
    """
    truth = open_street(uri)
    keys = source.test or source.train
    chosen_keys = keys[:: max(1, -(-len(keys) // MAX_TRUE_VIEWS))]
    cameras = [source.camera(key) for key in chosen_keys]
    return {"street": uri, **true_depth_errors(scene, truth, cameras)}


def truth_line(truth: Mapping[str, Any]) -> str:
    """The facts in one sentence."""
    depth = truth["median"]
    return (
        f"depth against the street's own: median {100 * depth['median_m']:.1f} cm, 90 % within "
        f"{100 * depth['p90_m']:.1f} cm; {100 * truth['no_surface']:.2f} % of surfaces missing, "
        f"{100 * truth['sky_covered']:.2f} % of the sky covered"
    )


def open_street(uri: str) -> StreetTruth:
    """The exact street of a URI.

    Raises:
        AdapterError: the URI names something else, or an option that streets do not have.
    """
    from adapters.procedural import open_truth

    scheme, path, query = parse_uri(uri)
    if scheme != "procedural" or path != "street":
        raise AdapterError(
            f"--truth {uri!r}: exact depth is known of procedural streets alone, such as "
            f"procedural:street?seed=3, with the options that the recording was rendered with"
        )
    return open_truth(query)


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if len(values) else float("nan")
