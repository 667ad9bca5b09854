"""What a reconstruction is worth: figures as JSON and Markdown, curves, pictures."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from augment.jobs.atomic import make_folder, output_error, write_atomic
from augment.reconstruct.view import ViewKey, ViewSource
from augment.scene import Scene
from tools.fit_curves import draw_curves
from tools.fit_pictures import choose_views, draw_views
from tools.fit_scores import ViewScore, evaluate_views, mean_scores, means_by_camera
from tools.sheet import write_rgb

MAX_TRAINING_VIEWS = 60  # where nothing is held out
TRAINING_SAMPLE = 12  # beside the held-out views, to see what was learnt by heart
CURVES, PICTURES = "curves.png", "held_out.jpg"
TRAINING_PICTURES = "training_views.jpg"

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
    progress: bool = True,
) -> dict[str, Any]:
    """Evaluate all held-out views and write report.json, report.md, curves.png and held_out.jpg.

    Without held-out views, training views are scored, at most MAX_TRAINING_VIEWS of them, and the
    report says so; the pictures are then training_views.jpg. history: as `draw_curves` takes it.
    facts: what else is to stand in report.json, in JSON's types. Returns report.json's content.

    Raises:
        OutputError: the folder cannot be written.
    """
    scored = _choose_split(source)
    scores = evaluate_views(scene, source, scored.keys, progress=progress)
    report = {
        **(facts or {}),
        "gaussians": len(scene.background) + sum(len(a.gaussians) for a in scene.actors),
        "actors": len(scene.actors),
        "scored": {"split": scored.split, "views": len(scores), "note": scored.note},
        "mean": mean_scores(scores),
        "cameras": means_by_camera(scores),
        "training_sample": _training_sample(scene, source) if scored.split == "test" else None,
        "views": [{"frame": s.key.frame, "camera": s.key.camera, **s.numbers()} for s in scores],
        "history": list(history),
        "definitions": DEFINITIONS,
    }
    report = _plain(report)
    pictures = _write_pictures(folder, scene, source, scores, history, scored.split)
    write_atomic(folder / "report.md", _markdown(scene, report, pictures).encode())
    data = json.dumps(report, indent=1, ensure_ascii=False, allow_nan=False)
    write_atomic(folder / "report.json", data.encode())  # last: it says that all else is there
    return report


@dataclass(frozen=True)
class _Scored:
    """Which views are scored. split: "test" or "train". note: empty, or what a reader must know."""

    split: str
    keys: tuple[ViewKey, ...]
    note: str


def _choose_split(source: ViewSource) -> _Scored:
    if source.test:
        return _Scored("test", source.test, "")
    keys = _spread(source.train, MAX_TRAINING_VIEWS)
    part = "all of them" if len(keys) == len(source.train) else f"{len(keys)} of them"
    return _Scored(
        "train",
        keys,
        f"No view was held out: these are training views ({part}), which the scene was fitted to, "
        f"so the figures say less than those of views it has never seen.",
    )


def _training_sample(scene: Scene, source: ViewSource) -> dict[str, float]:
    keys = _spread(source.train, TRAINING_SAMPLE)
    scores = evaluate_views(scene, source, keys, with_flip=False)
    return {"views": len(scores), **mean_scores(scores)}


def _spread(keys: Sequence[ViewKey], most: int) -> tuple[ViewKey, ...]:
    """At most so many of the views, of all cameras alike, evenly spread over each one's."""
    if len(keys) <= most:
        return tuple(keys)
    by_camera = [
        [key for key in keys if key.camera == name]
        for name in dict.fromkeys(k.camera for k in keys)
    ]
    each = max(1, most // len(by_camera))
    chosen = {
        own[int((i + 0.5) / count * len(own))]
        for own in by_camera
        for count in [min(each, len(own))]
        for i in range(count)
    }
    return tuple(key for key in keys if key in chosen)


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
        raise output_error(folder, error) from error
    titles: dict[str, str] = {}
    if scores:
        name = PICTURES if split == "test" else TRAINING_PICTURES
        write_rgb(folder / name, draw_views(scene, source, choose_views(scores)))
        titles[name] = "recorded, rendered, error, depth"
    curves = draw_curves(history)
    if curves is not None:
        write_rgb(folder / CURVES, curves)
        titles[CURVES] = "loss, PSNR, depth error and Gaussians over the steps"
    return titles


def _markdown(scene: Scene, report: Mapping[str, Any], pictures: Mapping[str, str]) -> str:
    scored = report["scored"]
    kind = "held-out" if scored["split"] == "test" else "training"
    lines = [f"# Reconstruction of {scene.name}", ""]
    lines += [f"- {line}" for line in _summary(scene, report)]
    lines += ["", f"## {scored['views']} {kind} views", ""]
    lines += [scored["note"], ""] if scored["note"] else []
    lines += _table(report, " m" if scene.has_metric_scale else "")
    lines += ["", *_training_line(report), "## Pictures", ""]
    lines += [f"![{title}]({name})\n" for name, title in pictures.items()] or ["None.", ""]
    lines += ["## What the figures mean", ""]
    lines += [f"- {name}: {text}." for name, text in report["definitions"].items()]
    problems = report.get("problems") or []
    lines += ["", "## Problems found in the data", ""] if problems else []
    lines += [f"- {problem}" for problem in problems]
    if report.get("settings"):
        lines += ["", "## Settings", ""]
        lines += [f"- {name}: {value}" for name, value in report["settings"].items()]
    return "\n".join(lines) + "\n"


def _summary(scene: Scene, report: Mapping[str, Any]) -> list[str]:
    lines = [f"made from {report['scene']}"] if "scene" in report else []
    if "step" in report and "steps" in report:
        done = f"{report['step']} of {report['steps']} steps"
        took = f" in {report['seconds'] / 60:.1f} minutes" if "seconds" in report else ""
        lines.append(done + took)
    unit = "" if scene.has_metric_scale else "; the scene's unit is not known to be a metre"
    return [*lines, f"{report['gaussians']:,} Gaussians, {report['actors']} actors{unit}"]


def _table(report: Mapping[str, Any], unit: str) -> list[str]:
    """A row per camera and one of the means over all views; columns nothing is known of are out."""
    known = [name for name in _COLUMNS if name == "views" or name in report["mean"]]
    total = {"views": report["scored"]["views"], **report["mean"]}
    rows = [*report["cameras"].items(), ("**all**", total)]

    def cell(row: Mapping[str, float], name: str) -> str:
        _, text, factor = _COLUMNS[name]
        return text.format(row[name] * factor, unit=unit) if name in row else "-"

    head = ["camera", *(_COLUMNS[name][0] for name in known)]
    return [
        f"| {' | '.join(head)} |",
        f"|---|{'---:|' * len(known)}",
        *(
            f"| {' | '.join([camera.replace('|', '/'), *(cell(row, n) for n in known)])} |"
            for camera, row in rows
        ),
    ]


def _training_line(report: Mapping[str, Any]) -> list[str]:
    sample = report.get("training_sample")
    if not sample or "psnr" not in sample:
        return []
    return [
        f"For comparison, {sample['views']} training views: PSNR {sample['psnr']:.2f} dB, "
        f"SSIM {sample['ssim']:.3f}.",
        "",
    ]


def _plain(value: Any) -> Any:
    """The same in JSON's own types; numbers that JSON has none for, NaN and infinity, as null."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


__all__ = ["ViewScore", "evaluate_views", "mean_scores", "write_report"]
