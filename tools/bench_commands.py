"""The commands of `climategs bench`: each measures one thing on this machine."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import UseAppendAction

from tools.output import JsonFile, write_json

Device = Literal["cpu", "cuda"]


def raster(
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
        return gpu(repeats, quick, sections=("raster",), json_file=json_file)
    from tools.bench.harness import print_figures
    from tools.bench.raster import bench_raster

    result = bench_raster(repeats=repeats, quick=quick)
    print_figures(result)
    write_json(json_file, result)
    return 0


def gpu(
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
        sections: Some of raster, style, frames, placement and agreement (with the CPU backend's
            pictures); by default all.
        minutes: After these a section that still runs is stopped, and no other begins.
        table: Also write the tables, as Markdown: into a document's marked place, or a file of
            their own.
        json_file: Also write the figures to this file, after every section.
    """
    import dataclasses

    from tools.bench_gpu import QUICK, SECTIONS, WHOLE, bench_gpu
    from tools.bench_gpu_text import gpu_text, write_table
    from tools.gpu_clock import Timing, check_gpu

    check_gpu()
    case = dataclasses.replace(QUICK if quick else WHOLE, placement=placement, minutes=minutes)
    result = bench_gpu(
        case,
        sections=sections or tuple(SECTIONS),
        timing=Timing(repeats=repeats),
        json_file=json_file,
    )
    if table is not None:
        write_table(table, result)
    _print_result(result, gpu_text, json_file, () if table is None else (table,))
    return int(any("failed" in found for found in result.values() if isinstance(found, dict)))


def smog(quick: bool = False, json_file: JsonFile = None) -> int:
    """The error of both smog models against exact per-pixel smog on the procedural street.

    Args:
        quick: One view only.
        json_file: Also write the figures to this file.
    """
    from tools.bench_smog import bench_smog, smog_text

    result = bench_smog(cameras=("front",), frames=(5,)) if quick else bench_smog()
    return _print_result(result, smog_text, json_file)


def flood(
    repeats: int = 7,
    quick: bool = False,
    scene: str | None = None,
    pictures: Path | None = None,
    json_file: JsonFile = None,
) -> int:
    """What flooded frames cost, how exact reflections are, whether cameras agree on the water.

    Args:
        repeats: Timed frames a kind of flood.
        quick: A small scene and few kinds.
        scene: The scene whose frames are timed; by default the procedural street with a million
            Gaussians.
        pictures: Also draw levels, waves and reflections with their time and error here.
        json_file: Also write the figures to this file.
    """
    from tools.bench_flood import QUICK, WHOLE, bench_flood, flood_text

    result = bench_flood(QUICK if quick else WHOLE, scene_uri=scene, repeats=repeats)
    drawn: list[Path] = []
    if pictures is not None:
        from tools.flood_pictures import draw_flood_pictures

        drawn = draw_flood_pictures(pictures)
    return _print_result(result, flood_text, json_file, drawn)


def snow(
    repeats: int = 7,
    quick: bool = False,
    scene: str | None = None,
    pictures: Path | None = None,
    json_file: JsonFile = None,
) -> int:
    """How much of the open ground snow covers, what it costs, whether cameras agree on it.

    Args:
        repeats: Timed frames a kind of snow.
        quick: A small scene and few kinds.
        scene: A scene that is measured beside the procedural street.
        pictures: Also draw depths, shadings, estimators and masks here.
        json_file: Also write the figures to this file.
    """
    from tools import bench_snow
    from tools.bench_snow_text import snow_text

    case = bench_snow.QUICK if quick else bench_snow.WHOLE
    result = bench_snow.bench_snow(case, scene_uri=scene, repeats=repeats)
    drawn: list[Path] = []
    if pictures is not None:
        from tools.snow_pictures import draw_snow_pictures

        drawn = draw_snow_pictures(pictures)
    return _print_result(result, snow_text, json_file, drawn)


def style(
    repeats: int = 7,
    quick: bool = False,
    scene: str | None = None,
    photos: Path | None = None,
    pictures: Path | None = None,
    json_file: JsonFile = None,
) -> int:
    """What a style costs, how exact its maps are, and how the methods do on photos.

    Args:
        repeats: Timed frames a kind of style.
        quick: A small scene and few kinds.
        scene: A scene that is measured beside the procedural street.
        photos: A folder of photographs to score styles on.
        pictures: Also draw methods, presets, strengths, regions, orders and failures here.
        json_file: Also write the figures to this file.
    """
    from tools import bench_style
    from tools.bench_style_text import style_text

    case = bench_style.QUICK if quick else bench_style.WHOLE
    result = bench_style.bench_style(case, scene_uri=scene, photos=photos, repeats=repeats)
    drawn: list[Path] = []
    if pictures is not None:
        from tools.style_pictures import draw_style_pictures

        drawn = draw_style_pictures(pictures, photos=photos)
    return _print_result(result, style_text, json_file, drawn)


def fit(scene: str | None = None, quick: bool = False, json_file: JsonFile = None) -> int:
    """Time of each stage of a reconstruction's step, and memory.

    Args:
        scene: Raw data to fit; by default a drive down the procedural street is recorded.
        quick: Fewer steps.
        json_file: Also write the figures to this file.
    """
    from tools.bench_fit import bench_fit, fit_text

    return _print_result(bench_fit(scene, quick=quick), fit_text, json_file)


def trade(
    scene: str = "procedural:street?seed=3&frames=6",
    recipe: Annotated[tuple[str, ...], UseAppendAction] = (),
    quick: bool = False,
    device: Device = "cpu",
    table: Path | None = None,
    pictures: Path | None = None,
    json_file: JsonFile = None,
) -> int:
    """What each setting that buys speed costs in accuracy on a scene, and the tiers as a whole.

    Args:
        scene: What is rendered.
        recipe: A preset or a file, or clean, smog, flood, snow, style or all; may be given several
            times. By default those six.
        quick: Small pictures, one timed frame of each, and no memory.
        device: What renders.
        table: Also write the tables to this file, as Markdown.
        pictures: Also draw error against time, and the tiers side by side, here.
        json_file: Also write the figures to this file.
    """
    from tools import trade_cases
    from tools.bench_trade import bench_trade
    from tools.trade_text import trade_markdown, trade_text

    if device == "cuda":
        from tools.gpu_clock import check_gpu

        check_gpu()
    case = trade_cases.QUICK if quick else trade_cases.WHOLE_CASE
    found = bench_trade(scene, recipe or trade_cases.RECIPES, case, backend=device)
    drawn: list[Path] = []
    if table is not None:
        table.write_text(trade_markdown(found.figures), encoding="utf-8")
        drawn.append(table)
    if pictures is not None:
        from tools.trade_plots import draw_trade

        drawn += draw_trade(pictures, found.figures, found.pictures)
    return _print_result(found.figures, trade_text, json_file, drawn)


def generate(repeats: int = 3, quick: bool = False, json_file: JsonFile = None) -> int:
    """What the machinery of `climategs generate` adds to bare rendering, and a job of 10,000.

    Args:
        repeats: How often each way is timed.
        quick: A few tiny images, and a job of 500.
        json_file: Also write the figures to this file.
    """
    return jobs(repeats, quick, None, json_file)


def jobs(
    repeats: int = 3, quick: bool = False, scene: str | None = None, json_file: JsonFile = None
) -> int:
    from tools.bench.harness import print_figures
    from tools.bench.jobs import QUICK, WHOLE, bench_jobs

    result = bench_jobs(QUICK if quick else WHOLE, scene_uri=scene, repeats=repeats)
    print_figures(result)
    write_json(json_file, result)
    return 0


def dataset(
    folder: Path | None = None, repeats: int = 3, quick: bool = False, json_file: JsonFile = None
) -> int:
    """Images a second out of an output folder, beside decoding alone; memory of a long manifest.

    Args:
        folder: An output folder with JPEG images; by default one is made.
        repeats: How often each way is timed.
        quick: Few small images.
        json_file: Also write the figures to this file.
    """
    from tools.bench.dataset import QUICK, WHOLE, bench_dataset
    from tools.bench.harness import print_figures

    result = bench_dataset(QUICK if quick else WHOLE, folder=folder, repeats=repeats)
    print_figures(result)
    write_json(json_file, result)
    return 0


def training(
    out: Path = Path("out/training"),
    quick: bool = False,
    pictures: Path | None = None,
    json_file: JsonFile = None,
) -> int:
    """A small segmentation network trained on clean images, and one on weathered ones, compared.

    Both are scored on streets and weather that are new to them.

    Args:
        out: The folder of the images to train on; what is there is not rendered again.
        quick: Too few images and steps to learn much.
        pictures: Also draw scores and predictions here.
        json_file: Also write the figures to this file.
    """
    from tools import training_case
    from tools.bench_training import bench_training
    from tools.training_text import training_text

    trained = bench_training(out, training_case.QUICK if quick else training_case.WHOLE)
    drawn: list[Path] = []
    if pictures is not None:
        from tools.training_pictures import draw_training_pictures

        drawn = list(draw_training_pictures(pictures, trained))
    return _print_result(trained.figures, training_text, json_file, drawn)


def _print_result(
    result: dict[str, Any],
    text: Callable[[dict[str, Any]], str],
    json_file: Path | None,
    drawn: list[Path] | tuple[Path, ...] = (),
) -> int:
    print(text(result) + "".join(f"\nwrote {path}" for path in drawn))
    write_json(json_file, result)
    return 0
