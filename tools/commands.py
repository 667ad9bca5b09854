"""The subcommands of `climategs`: typed functions, whose docstrings are the help.

Heavy imports stay inside the functions, so that `--help` answers at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

from tools.json_files import JsonFile, write_json

if TYPE_CHECKING:
    from augment.scene import Scene


def render(
    recipe: Positional[str],
    scene: str,
    out: Path,
    frames: str = "all",
    cameras: str = "all",
    scale: float = 1.0,
    variants: int | None = None,
    workers: int = 1,
    backend: Literal["auto", "reference", "cpu", "cuda"] = "auto",
    camera_path: Path | None = None,
    overwrite: bool = False,
    sheet: bool = True,
    layout: Literal["standard", "source"] = "standard",
    links: Literal["hard", "copy"] = "hard",
) -> int:
    """Render a scene under a recipe into images, depth, labels and a manifest.

    Run it again to go on after an interruption: what is finished is not rendered twice.

    Args:
        recipe: A recipe file (.yaml), or the name of a preset; `climategs recipes` lists them.
        scene: procedural:street?seed=3, pandaset:PATH/002, gaussians:PATH/point_cloud.ply, and
            others (docs/scenes.md), or a bare path, which is recognised by what it holds.
        out: The output folder. Further recipes and scenes may go into the same one.
        frames: Frame numbers: all, 4, 0,5,9, or 0:20:2 (start:stop:step, stop excluded).
        cameras: Camera names separated by commas, or all.
        scale: Resolution relative to the recipe's.
        variants: How many draws from the recipe's ranges. The recipe's own number by default.
        workers: Processes. The bits do not depend on it. One is best where a GPU draws.
        backend: Which rasteriser draws. auto: on the GPU (cuda) where there is one, else the CPU.
        camera_path: A JSON file of camera poses to render instead of the scene's own.
        overwrite: Replace what this scene and recipe wrote before.
        sheet: Also write a contact sheet of the result.
        layout: source: also lay the images into a copy of the scene's dataset, in the place, format
            and size of the recorded ones, for the dataset's own loader.
        links: Of that copy: hard: unchanged files share the dataset's disk space. copy: nothing is
            shared.
    """
    from tools.local_output import check_local
    from tools.render import render_recipe

    check_local(out, "`climategs generate` writes to object stores")
    return render_recipe(
        recipe,
        scene,
        out,
        frames=frames,
        cameras=cameras,
        scale=scale,
        variants=variants,
        workers=workers,
        backend=backend,
        camera_path=camera_path,
        overwrite=overwrite,
        sheet=sheet,
        layout=layout,
        links=links,
    )


def fit(
    scene: Positional[str],
    out: Path,
    minutes: float | None = None,
    steps: int | None = None,
    scale: float = 0.25,
    cameras: str = "all",
    holdout: str = "every-2nd",
    seed: int = 0,
    depth_weight: float | None = None,
    sh_degree: int | None = None,
    max_splats: int | None = None,
    densify: Literal["absgrad", "mcmc", "none"] = "absgrad",
    image_cache_mb: int = 1024,
    depth: str = "lidar",
    ego_masks: Path | None = None,
    truth: str | None = None,
    device: Literal["cpu", "cuda"] = "cpu",
    overwrite: bool = False,
    json_file: JsonFile = None,
) -> int:
    """Reconstruct a scene of Gaussians from recorded images, LiDAR and boxes.

    Run it again to go on after an interruption; the result is the same to the bit. Ctrl-C stops
    after the current step, and the scene as far as it is fitted is written.

    Args:
        scene: Raw data: pandaset:PATH/002, recording:PATH, or a path that is recognised.
        out: The scene's folder; OUT.fit beside it holds the checkpoint and the report.
        minutes: How long to optimise, 10 by default. Opening and the report come on top.
        steps: How many steps instead. The same steps and seed give the same bytes.
        scale: Resolution of the images that are learnt from, relative to the recorded.
        cameras: Camera names separated by commas, or all.
        holdout: Which frames are kept for the report: every-2nd, every-8th, ..., or none.
        seed: Of everything random.
        depth_weight: How much depth priors count. 0 switches them off.
        sh_degree: Highest band of spherical harmonics, 0 to 3.
        max_splats: Splats are not added beyond this number.
        densify: How splats are added.
        image_cache_mb: Memory for decoded images. The result does not depend on it.
        depth: Depth priors: none, or kinds separated by commas: lidar, metric:DIR (depth maps as
            render writes them), relative:DIR (monocular networks), sparse:DIR (lidar_depth).
        ego_masks: A folder of CAMERA.png, white where the image shows the recording car.
        truth: The procedural street that a recording was rendered from: the report then holds
            the error against its exact depth.
        device: Where views are rendered: cpu, or cuda by gsplat (an extra), of which no two runs
            give the same bytes.
        overwrite: Begin anew and replace what is there.
        json_file: Also write the report to this file.
    """
    from tools.fit import fit_scene
    from tools.fit_options import FitOptions

    options = FitOptions(
        scene=scene,
        out=out,
        minutes=minutes,
        steps=steps,
        scale=scale,
        cameras=None if cameras == "all" else tuple(cameras.split(",")),
        holdout=holdout,
        seed=seed,
        depth_weight=depth_weight,
        sh_degree=sh_degree,
        max_splats=max_splats,
        densify=densify,
        image_cache_mb=image_cache_mb,
        depth=depth,
        ego_masks=ego_masks,
        truth=truth,
        device=device,
        overwrite=overwrite,
    )
    outcome = fit_scene(options)
    write_json(json_file, outcome.report)
    return outcome.code


def inspect(
    uri: Positional[str], camera_path: Path | None = None, json_file: JsonFile = None
) -> int:
    """Show what is in a scene: Gaussians, actors, cameras, frames, LiDAR, labels, problems.

    Args:
        uri: The scene, as for render.
        camera_path: A JSON file of camera poses to look at instead of the scene's own.
        json_file: Also write the facts to this file.
    """
    from tools.scene_report import describe_scene, scene_text

    facts = describe_scene(open_with_path(uri, camera_path))
    print(scene_text(facts))
    write_json(json_file, facts)
    return 0


def explain(
    recipe: Positional[str],
    scene: str,
    variant: int = 0,
    times: bool = True,
    json_file: JsonFile = None,
) -> int:
    """Show the plan: which passes and buffers a recipe takes on a scene, why, and what they cost.

    Args:
        recipe: A recipe file or the name of a preset.
        scene: The scene, as for render.
        variant: Which draw from the recipe's ranges.
        times: Render a few views to measure each pass's share of the time.
        json_file: Also write the plan to this file.
    """
    from tools.explain import explain_recipe, explanation_text

    facts = explain_recipe(recipe, scene, variant, times=times)
    print(explanation_text(facts))
    write_json(json_file, facts)
    return 0


def recipes(name: Positional[str | None] = None, schema: Path | None = None) -> int:
    """List the presets, print one of them, or write the JSON Schema that editors check against.

    Args:
        name: A preset to print.
        schema: Write the JSON Schema of recipes to this file.
    """
    from recipes.json_schema import write_schema
    from recipes.load import preset_names, preset_text

    if schema is not None:
        write_schema(schema)
        print(f"wrote {schema}")
    elif name is not None:
        print(preset_text(name), end="")
    else:
        print("\n".join(preset_names()))
    return 0


def sheet(
    out: Positional[Path],
    frame: int | None = None,
    video_camera: str | None = None,
    fps: float = 10.0,
) -> int:
    """Draw pictures of an output folder: a contact sheet, and a video of one camera.

    Args:
        out: A folder that `climategs render` or `generate` wrote.
        frame: Which frame the contact sheet shows. The middle one by default.
        video_camera: Also write an MP4 of this camera, all variants side by side.
        fps: Frames per second of the video.
    """
    from tools.local_output import check_local
    from tools.pictures import draw_sheet, draw_video

    check_local(out, "`climategs report` reads object stores; or copy the output here")
    print(draw_sheet(out, frame))
    if video_camera is not None:
        print(draw_video(out, video_camera, fps))
    return 0


def bench() -> None:
    """Measure speed and error on this machine, one thing at a time."""
    # A line in the list of commands; the words after it go to a table of their own (tools.cli).


def demo(out: Path = Path("out/demo"), frames: int = 10) -> int:
    """Render the embedded street under five recipes, with a contact sheet and a video.

    Args:
        out: The output folder.
        frames: How many frames of the drive.
    """
    from tools.demo import run_demo

    return run_demo(out, frames)


def style() -> None:
    """Colour moods: apply one to a scene, train the network behind them, list the presets."""
    # A line in the list of commands; the words after it go to a table of their own (tools.cli).


def open_with_path(uri: str, camera_path: Path | None) -> Scene:
    """The scene of a URI, with the cameras of a path file, if given, in place of its own."""
    from adapters.base import open_scene

    scene = open_scene(uri)
    if camera_path is None:
        return scene
    from adapters.camera_files.paths import with_camera_path

    return with_camera_path(scene, camera_path)
