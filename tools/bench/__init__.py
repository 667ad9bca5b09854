"""The commands of `climategs bench`: each measures one subject on this machine, prints its tables,
and writes its figures as JSON where it is told to. Subjects are imported when they are run.
"""

from __future__ import annotations

import dataclasses
import importlib
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from tyro.conf import UseAppendAction

from tools.output import JsonFile, write_json

Device = Literal["cpu", "cuda"]
Effect = Literal["smog", "flood", "snow", "rain", "light", "style"]


def bench_raster(
    repeats: int = 7, quick: bool = False, device: Device = "cpu", json_file: JsonFile = None
) -> int:
    """The rasteriser on random scenes: each stage's time, memory, the torch reference beside it.

    Args:
        repeats: Timed frames a scene.
        quick: The smaller scene only.
        device: On cuda the GPU's rasteriser, on the larger scene: `bench gpu --sections raster`.
        json_file: Also write the figures to this file.
    """
    if device == "cuda":
        return bench_gpu(repeats, quick, sections=("raster",), json_file=json_file)
    return _show(_subject("raster").measure(quick, repeats), json_file)


def bench_lod(
    scene: str | None = None, repeats: int = 7, quick: bool = False, json_file: JsonFile = None
) -> int:
    """Levels of detail: a view down a long street over its nearest 100 m alone, memory, accuracy.

    Args:
        scene: A scene folder with levels; by default a kilometre of 20 million splats is written,
            which takes minutes and, for a while, 4 GB of the temporary folder's disk.
        repeats: Timed frames of each kind.
        quick: 200 metres of 100,000 splats.
        json_file: Also write the figures to this file.
    """
    return _show(_subject("lod").measure(quick, repeats, scene), json_file)


def bench_effects(
    only: tuple[Effect, ...] = get_args(Effect),
    repeats: int = 7,
    quick: bool = False,
    scene: str | None = None,
    photos: Path | None = None,
    json_file: JsonFile = None,
) -> int:
    """Measure the cost of each effect in a frame, and the errors of its pictures.

    Args:
        only: Some of the effects.
        repeats: Timed frames of each kind.
        quick: Small scenes and few kinds.
        scene: A scene for cost, beside the procedural street.
        photos: A folder of photographs to score styles on.
        json_file: Also write the figures to this file, by effect.
    """
    results: dict[str, Any] = {}
    subject = _subject("effects")
    case = dataclasses.replace(subject.QUICK_CASE if quick else subject.FULL_CASE, photos=photos)
    for name in only:
        results[name] = subject.measure_effect(name, repeats, case, scene)
        _show(results[name], None)
        write_json(json_file, results, say=name == only[-1])
    return 0


def bench_fit(scene: str | None = None, quick: bool = False, json_file: JsonFile = None) -> int:
    """Time of each stage of a reconstruction's step, memory, and a fit of the procedural street.

    Args:
        scene: Raw data whose steps are timed; by default a drive down the procedural street is
            recorded, and also fitted to every other frame.
        quick: Fewer steps, and no fit.
        json_file: Also write the figures to this file.
    """
    return _show(_subject("fit").measure(quick, scene), json_file)


def bench_jobs(
    repeats: int = 3, quick: bool = False, scene: str | None = None, json_file: JsonFile = None
) -> int:
    """Measure a job's overhead over bare rendering, a job of 10,000 images, and opening scenes.

    Args:
        repeats: How often each way is timed.
        quick: A few tiny images, a job of 500, and a smaller scene.
        scene: Another scene to open, such as street_gaussians:MODEL.
        json_file: Also write the figures to this file.
    """
    return _show(_subject("jobs").measure(quick, scene, repeats), json_file)


def bench_dataset(
    folder: Path | None = None, repeats: int = 3, quick: bool = False, json_file: JsonFile = None
) -> int:
    """Images a second out of an output folder and rendered on the fly; memory of a long manifest.

    Args:
        folder: An output folder with JPEG images; by default one is made.
        repeats: How often each way is timed.
        quick: Few images.
        json_file: Also write the figures to this file.
    """
    return _show(_subject("dataset").measure(quick, folder, repeats), json_file)


def bench_training(
    folder: Path | None = None,
    quick: bool = False,
    table: Path | None = None,
    json_file: JsonFile = None,
) -> int:
    """Train a small network on clean images, on weather and on night; test it on other streets.

    Args:
        folder: Where the images are rendered, and read again by a later run; by default a
            temporary folder.
        quick: A few small images and steps.
        table: Also write the tables to this file, as Markdown.
        json_file: Also write the figures to this file, with the IoU of every class and seed.
    """
    result = _subject("training").measure(quick, folder)
    written = list[Path]()
    if table is not None:
        table.write_text(_subject("harness").markdown(result), encoding="utf-8")
        written.append(table)
    return _show(result, json_file, written)


def bench_detector(
    folder: Path | None = None,
    quick: bool = False,
    table: Path | None = None,
    curves: Path | None = None,
    json_file: JsonFile = None,
) -> int:
    """Train a small detector on clean images and on weather; score both on the suite `weather-c`.

    Args:
        folder: Where images are rendered and predictions are written, and read again by a later
            run; by default a temporary folder.
        quick: A few small images, variants and steps.
        table: Also write the tables to this file, as Markdown.
        curves: Also draw recall against the level of every effect, as an image.
        json_file: Also write the figures to this file, with the scores of every seed.
    """
    if curves is not None:
        _subject("trade").check_matplotlib()
    subject = _subject("detector")
    result = subject.measure(quick, folder)
    written = list[Path]()
    if table is not None:
        table.write_text(_subject("harness").markdown(result), encoding="utf-8")
        written.append(table)
    if curves is not None:
        titles = {name: arm.title for name, arm in subject.ARMS.items()}
        _subject("detector_tables").draw_curves(curves, result["facts"]["curves"], titles)
        written.append(curves)
    return _show(result, json_file, written)


def bench_gpu(
    repeats: int = 30,
    quick: bool = False,
    placement: Annotated[tuple[str, ...], UseAppendAction] = (),
    sections: tuple[str, ...] = (),
    minutes: float = 9.0,
    table: Path | None = None,
    json_file: JsonFile = None,
) -> int:
    """Every figure of the GPU backend, beside what it is to reach and the least it can take.

    Times, stages, achieved bandwidth, memory, determinism, and the pictures' distance from the CPU
    backend's and, where it is installed, gsplat's.

    Args:
        repeats: Timed runs of each.
        quick: A small scene.
        placement: A scene to find a place for snow in, besides the street; may be given several
            times.
        sections: Some of raster, style, frames, passes (beside the CPU's), placement, agreement
            (with the CPU backend's pictures) and launches (counted, without a GPU too); by default
            all.
        minutes: After these a section that still runs is stopped, and no other begins.
        table: Also write the tables, as Markdown: into a document's marked place, or a file of
            their own.
        json_file: Also write the figures to this file, after every section.
    """
    if set(sections) != {"launches"}:
        _subject("harness").check_gpu()
    subject = _subject("gpu")
    case = dataclasses.replace(
        subject.QUICK_CASE if quick else subject.FULL_CASE, placement=placement
    )
    timing = subject.Timing(repeats=repeats)
    result = subject.measure(case, sections or subject.SECTIONS, timing, minutes, json_file)
    if table is not None:
        subject.write_table(table, result)
    _show(result, json_file, () if table is None else (table,))
    return int(any("failed" in section for section in result["facts"]["sections"].values()))


def bench_trade(
    scene: str = "procedural:street?seed=3&frames=6",
    recipe: Annotated[tuple[str, ...], UseAppendAction] = (),
    quick: bool = False,
    device: Device = "cpu",
    table: Path | None = None,
    pictures: Path | None = None,
    json_file: JsonFile = None,
) -> int:
    """Measure speed and errors of each quality setting on a scene, and of the tiers as a whole.

    Args:
        scene: What is rendered.
        recipe: A preset or a file, or clean, smog, flood, snow, style, rain, snowfall, fog (the
            picture alone) or all; may be given several times. By default those nine.
        quick: Small pictures, one timed frame of each, and no memory.
        device: What renders.
        table: Also write the tables to this file, as Markdown.
        pictures: Also draw error against time, and the tiers side by side, here.
        json_file: Also write the figures to this file.
    """
    harness = _subject("harness")
    if device == "cuda":
        harness.check_gpu()
    subject = _subject("trade")
    if pictures is not None:
        subject.check_matplotlib()
    case = subject.QUICK_CASE if quick else subject.FULL_CASE
    trade = subject.bench_trade(scene, recipe or subject.RECIPES, case, backend=device)
    printed_figures = subject.printable(trade.figures)
    written = list[Path]()
    if table is not None:
        table.write_text(harness.markdown(printed_figures), encoding="utf-8")
        written.append(table)
    if pictures is not None:
        written += subject.draw_trade(pictures, trade)
    _show(printed_figures, None, written)
    write_json(json_file, trade.figures)
    return 0


def bench_serve(
    scene: str | None = None,
    recipe: str = "dense-fog",
    scale: float = 0.5,
    minutes: float = 10.0,
    clients: int = 2,
    repeats: int = 5,
    quick: bool = False,
    json_file: JsonFile = None,
) -> int:
    """Measure the sensor service beside a job, and a soak: latencies and memory over minutes.

    Args:
        scene: The scene that is served; by default the procedural street.
        recipe: Its weather.
        scale: The size of the images over the recorded size.
        minutes: The length of the soak; 0 for none.
        clients: The number of clients of the soak, which replay closed loops of all cameras.
        repeats: The number of rounds beside a job; 0 for none.
        quick: Small images, one round, and a soak of seconds.
        json_file: Also write the figures to this file.
    """
    subject = _subject("serve")
    case = subject.QUICK_CASE
    if not quick:
        case = dataclasses.replace(
            subject.FULL_CASE,
            scene=scene or subject.FULL_CASE.scene,
            recipe=recipe,
            scale=scale,
            minutes=minutes,
            clients=clients,
            repeats=repeats,
        )
    return _show(subject.measure(case), json_file)


COMMANDS = {
    "raster": bench_raster,
    "lod": bench_lod,
    "effects": bench_effects,
    "trade": bench_trade,
    "fit": bench_fit,
    "jobs": bench_jobs,
    "dataset": bench_dataset,
    "training": bench_training,
    "detector": bench_detector,
    "serve": bench_serve,
    "gpu": bench_gpu,
}


def _subject(name: str) -> Any:
    return importlib.import_module(f"tools.bench.{name}")


def _show(result: dict[str, Any], json_file: Path | None, written: Any = ()) -> int:
    _subject("harness").print_figures(result)
    for path in written:
        print(f"wrote {path}")
    write_json(json_file, result)
    return 0
