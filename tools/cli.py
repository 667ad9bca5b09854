"""The `climategs` command: its subcommands, and what it prints for errors.

A subcommand is a model of options, or a function if it has few options. Their docstrings are the
text of `--help`. Heavy imports stay inside the functions, so that `--help` answers at once.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Self, get_args

import tyro
from pydantic import AfterValidator, Field, model_validator
from tyro.conf import Positional, UseAppendAction, arg

from augment.files.formats import ExportKind, SplatKind, join_names
from tools.options import (
    FITTED,
    Command,
    FitOptions,
    Overrides,
    RecipeCommand,
    SceneCommand,
    StyleTrainOptions,
)
from tools.output import LABELS_OF_STORES, JsonFile, NoteHandler, check_local, write_json

if TYPE_CHECKING:
    pass

Backend = Literal["auto", "reference", "cpu", "cuda"]
Links = Literal["hard", "copy"]
Count = Annotated[int, Field(ge=1)]


def _check_frames(text: str) -> str:
    from recipes.schema import parse_frames

    parse_frames(text)
    return text


def _check_shard(text: str) -> str:
    number, slash, count = text.partition("/")
    are_numbers = slash and number.isdecimal() and count.isdecimal() and len(text) < 20
    if not are_numbers or not 1 <= int(number) <= int(count):
        raise ValueError(f"{text!r}: write i/n with i from 1 to n, as in 2/8")
    return text


def _check_levels(text: str) -> str:
    if text != "all" and not all(level.isdecimal() for level in text.split(",")):
        raise ValueError(f"{text!r}: write levels separated by commas, as in 1,3,5, or all")
    return text


def _local(instead: str) -> AfterValidator:
    return AfterValidator(partial(check_local, instead=instead))


class RenderOptions(RecipeCommand):
    """Render a scene under recipes into images, depth, labels and a manifest.

    Run it again to go on after an interruption: what is finished is not rendered twice.

    Args:
        recipes: Recipe files (.yaml), or names of presets; `climategs recipes` lists them.
        scene: procedural:street?seed=3, pandaset:PATH/002, gaussians:PATH/point_cloud.ply, and
            others (docs/scenes.md), or a bare path, which is recognised by what it holds.
        out: The output folder. Further recipes and scenes may go into the same one.
        frames: Frame numbers: all, 4, 0,5,9, or 0:20:2 (start:stop:step, stop excluded).
        cameras: Camera names separated by commas, or all. fitted: all, but of a fitted scene those
            that it was fitted to.
        scale: Resolution relative to the recipe's.
        variants: How many draws from each recipe's ranges. The recipe's own number by default.
        workers: Processes. The bits do not depend on it. One is best where a GPU draws.
        backend: Which rasteriser draws. auto: on the GPU (cuda) where there is one, else the CPU.
        camera_path: A JSON file of camera poses to render instead of the scene's own.
        ego_masks: A folder of masks of the recording car, as ego_masks=FOLDER in the scene's URI
            (docs/scenes.md): CAMERA.png, white on it, or CAMERA.json with polygons.
        tracks: A JSON file that moves, removes and adds actors, as tracks=FILE in the scene's URI
            (docs/scenes.md).
        overwrite: Replace what this scene and recipe wrote before.
        sheet: Also write a contact sheet of the result.
        layout: source: also lay the images into a copy of the scene's dataset, in the place, format
            and size of the recorded ones, for the dataset's own loader.
        links: Of that copy: hard: unchanged files share the dataset's disk space. copy: nothing is
            shared.
    """

    recipes: Positional[
        Annotated[
            tuple[str, ...], arg(metavar="RECIPE [RECIPE ...]", help_behavior_hint="(required)")
        ]
    ]
    scene: str
    out: Annotated[Path, _local("`climategs generate` writes to object stores")]
    frames: Annotated[str, AfterValidator(_check_frames)] = "all"
    cameras: str = FITTED
    scale: Annotated[float, Field(gt=0)] = 1.0
    variants: Count | None = None
    workers: Count = 1
    backend: Backend = "auto"
    camera_path: Path | None = None
    ego_masks: Path | None = None
    tracks: Path | None = None
    overwrite: bool = False
    sheet: bool = True
    layout: Literal["standard", "source"] = "standard"
    links: Links = "hard"

    @model_validator(mode="after")
    def _names_recipes(self) -> Self:
        if not self.recipes:
            raise ValueError("no recipe is named: climategs render RECIPE --scene URI --out OUT")
        return self

    def run(self) -> int:
        from tools.render import render_recipes

        return render_recipes(self)


class GenerateOptions(SceneCommand):
    """Make a dataset: many scenes under many recipes, as a job file says (docs/generate.md).

    Run it again to go on after an interruption, on this machine or another; what is published is
    not rendered twice. Several at the same output share the work.

    Args:
        job: The job file (.yaml): scenes, recipes, variants.
        out: The output: a folder, or s3://bucket/path, gs://bucket/path.
        executor: Who renders: this process, processes of this machine, or actors of a Ray cluster.
        workers: How many; a process for every core by default, one where a GPU draws, on Ray an
            actor for every GPU then.
        shard: i/n: do only the i-th of n parts, for schedulers such as SLURM.
        dry_run: Open the scenes, say what would be rendered, and about how long it takes and how
            large it gets. Nothing is written.
        status: Say how far the jobs of the output have come; needs no job file. The exit code is 0
            if all is done.
        rescan: Open all scenes again, in place of what the output knows of them.
        tracks: A JSON file that moves, removes and adds actors in each scene of the job, as
            tracks=FILE in its URI does in one (docs/scenes.md).
        scratch: Where images are kept until their block is uploaded, for outputs elsewhere.
        backend: Which rasteriser draws. auto: on the GPU (cuda) where there is one, else the CPU;
            on Ray the CPU.
    """

    job: Positional[Path | None] = None
    out: str = ""
    executor: Literal["serial", "processes", "ray"] = "processes"
    workers: Count | None = None
    shard: Annotated[str, AfterValidator(_check_shard)] = "1/1"
    dry_run: bool = False
    status: bool = False
    rescan: bool = False
    tracks: Path | None = None
    scratch: Path | None = None
    backend: Backend = "auto"

    @model_validator(mode="after")
    def _names_job_and_out(self) -> Self:
        if not self.out:
            raise ValueError("--out is missing: a folder, or s3://bucket/path")
        if self.job is None and not self.status:
            raise ValueError("no job file is named: climategs generate JOB.yaml --out OUT")
        return self

    def run(self) -> int:
        from tools.generate import generate_dataset, show_status

        return show_status(self.out) if self.status else generate_dataset(self)


class SuiteSelection(SceneCommand):
    """Scenes and variants of the robustness suite weather-c.

    Args:
        scenes: Scenes, as for render; a folder of nuScenes or Waymo stands for all its scenes, and
            `*` in a path for all that match.
        effects: Names of effects separated by commas: fog, rain, wet, snowfall, snow, flood, night,
            lens, combined; or all.
        levels: Levels separated by commas, 1 to 5, or all. Level 0, the clean render, is always
            there; 0 alone renders nothing else.
        frames: Frame numbers: all, 4, 0,5,9, 0:20:2, or ::5.
        cameras: Camera names separated by commas, or all. fitted: all, but of a fitted scene those
            that it was fitted to.
        scale: Resolution relative to the recorded.
        quarter: Every fourth frame: the suite weather-c-v1-q.
        overrides: Replace a field of render or output in all recipes, level 0 too, as in
            render.base=recorded or output.image=png. The weather's numbers are fixed.
    """

    scenes: Positional[
        Annotated[
            tuple[str, ...], arg(metavar="SCENE [SCENE ...]", help_behavior_hint="(required)")
        ]
    ]
    effects: str = "all"
    levels: Annotated[str, AfterValidator(_check_levels)] = "all"
    frames: Annotated[str, AfterValidator(_check_frames)] = "all"
    cameras: str = FITTED
    scale: Annotated[float, Field(gt=0)] = 1.0
    quarter: bool = False
    overrides: Overrides = ()

    @model_validator(mode="after")
    def _names_scenes(self) -> Self:
        if not self.scenes:
            raise ValueError("no scene is named: climategs suite weather-c SCENE --out OUT")
        if self.quarter and self.frames != "all":
            raise ValueError("--quarter has its own frames: leave --frames out")
        return self


class SuiteOptions(SuiteSelection):
    """Render scenes under the robustness suite weather-c, or go on with it (docs/suite.md).

    Args:
        out: The output: a folder, or s3://bucket/path, gs://bucket/path.
        executor: Who renders: this process, processes of this machine, or actors of a Ray cluster.
        workers: How many; a process for every core by default, one where a GPU draws.
        shard: i/n: do only the i-th of n parts, for schedulers such as SLURM.
        scratch: Where images are kept until their block is uploaded, for outputs elsewhere.
        backend: Which rasteriser draws. auto: on the GPU (cuda) where there is one, else the CPU.
        layout: source: also lay the images of each variant into a copy of the dataset.
        links: Of that copy: hard: unchanged files share the dataset's disk space. copy: nothing is
            shared.
    """

    out: str = ""
    executor: Literal["serial", "processes", "ray"] = "processes"
    workers: Count | None = None
    shard: Annotated[str, AfterValidator(_check_shard)] = "1/1"
    scratch: Path | None = None
    backend: Backend = "auto"
    layout: Literal["standard", "source"] = "standard"
    links: Links = "hard"

    @model_validator(mode="after")
    def _names_out(self) -> Self:
        if not self.out:
            raise ValueError("--out is missing: a folder, or s3://bucket/path")
        if self.layout == "source" and "://" in self.out:
            raise ValueError("--layout source needs a folder on this machine as --out")
        return self

    def run(self) -> int:
        from tools.suite import render_suite

        return render_suite(self)


class SuitePlanOptions(SuiteSelection):
    """Say how many images a suite has, and about how long they take and how large they get.

    Two pictures of each effect are rendered; nothing is written.

    Args:
        backend: Which rasteriser draws.
    """

    backend: Backend = "auto"

    def run(self) -> int:
        from tools.suite import show_plan

        return show_plan(self)


class SuiteVerifyOptions(Command):
    """Hash all files of a suite and compare them with its suite.json. Exit code 1 if any differs.

    Args:
        out: A folder or URI in which a suite was rendered.
    """

    out: Positional[str]

    def run(self) -> int:
        from tools.suite import verify_output

        return verify_output(self.out)


class SuiteProbeOptions(Command):
    """Print the three files of each variant by which a user's loader is probed, with their hashes.

    Args:
        out: A folder or URI in which a suite was rendered.
        variant: Only of this variant, such as fog-3.
    """

    out: Positional[str]
    variant: str | None = None

    def run(self) -> int:
        from tools.suite import show_probes

        return show_probes(self.out, self.variant)


class SuiteSearchOptions(SceneCommand):
    """Find the mildest weather at which a detector breaks, by halving a physical number.

    Each number is rendered into a folder OUT/EFFECT-NUMBER, on which the command is run
    (docs/suite.md).

    Args:
        scenes: Scenes, as for `climategs suite weather-c`.
        effect: fog, rain, snowfall, snow, flood or lens: an effect whose levels are one number.
        until: The condition: SCORE<NUMBER, with <, <=, > or >=.
        command: A program with its arguments; the folder is added to them. The last line that it
            prints must be a JSON object of scores, such as {"recall": 0.48}.
        out: A folder for the images. Run it again to go on after an interruption.
        mildest: Where to begin. Level 1 by default.
        harshest: Where to end. Level 5 by default.
        tolerance: Width of the interval, relative, at which the search ends.
        max_evaluations: At most so many numbers.
        frames: Frame numbers, as for render.
        cameras: Camera names separated by commas, or all; as for render.
        scale: Resolution relative to the recorded.
        workers: Processes. 1 renders in this one.
        backend: Which rasteriser draws. auto: on the GPU (cuda) where there is one, else the CPU.
        overrides: Replace a field of render or output, as for `climategs suite weather-c`.
        json_file: Also write the result and all evaluations to this file.
    """

    scenes: Positional[
        Annotated[
            tuple[str, ...], arg(metavar="SCENE [SCENE ...]", help_behavior_hint="(required)")
        ]
    ]
    effect: str
    until: str
    command: str
    out: Annotated[Path, _local("the command reads a folder on this machine")]
    mildest: Annotated[float, Field(gt=0)] | None = None
    harshest: Annotated[float, Field(gt=0)] | None = None
    tolerance: Annotated[float, Field(gt=0, lt=10)] = 0.05
    max_evaluations: Annotated[int, Field(ge=5)] = 24
    frames: Annotated[str, AfterValidator(_check_frames)] = "all"
    cameras: str = FITTED
    scale: Annotated[float, Field(gt=0)] = 1.0
    workers: Count = 1
    backend: Backend = "auto"
    overrides: Overrides = ()
    json_file: JsonFile = None

    @model_validator(mode="after")
    def _names_scenes(self) -> Self:
        if not self.scenes:
            raise ValueError("no scene is named: climategs suite search SCENE --out OUT")
        return self

    def run(self) -> int:
        from tools.search import search_suite

        return search_suite(self)


class InspectOptions(SceneCommand):
    """Show what is in a scene: Gaussians, actors, cameras, frames, LiDAR, labels, problems.

    Of a recorded drive without images or without LiDAR, of which no scene can be made, it shows
    what is there and what is missing, and ends with exit code 1.

    Args:
        uri: The scene, as for render.
        camera_path: A JSON file of camera poses to look at instead of the scene's own.
        json_file: Also write the facts to this file.
    """

    uri: Positional[str]
    camera_path: Path | None = None
    json_file: JsonFile = None

    def run(self) -> int:
        from tools.inspect import inspect_scene

        return inspect_scene(self)


class RecordOptions(Command):
    """Make a recording of a COLMAP reconstruction, of a phone's video, say.

    docs/datasets/own-drive.md has every command on the way.

    Args:
        model: The folder of the COLMAP model, or of the project that holds sparse/0.
        images: The folder of the images that COLMAP was run on, named by their frame's number;
            those of several cameras in a folder each.
        out: The recording's folder, new.
        fps: Images a second.
        camera_height: Height of the camera above the road in metres. Without it and positions the
            recording has no metres.
        positions: A CSV table with the columns image, lat, lon, or image, x, y in metres: where
            images were taken. It also turns the recording's x to the east.
        lens: recorded keeps the images as they are, and their lens in calibration.json; undistorted
            takes the distortion out of them.
    """

    model: Positional[Path]
    images: Path
    out: Path
    fps: Annotated[float, Field(gt=0, le=1000)]
    camera_height: Annotated[float, Field(gt=0.05, le=20)] | None = None
    positions: Path | None = None
    lens: Literal["undistorted", "recorded"] = "undistorted"

    def run(self) -> int:
        from tools.record import record_drive

        return record_drive(self)


class ExplainOptions(RecipeCommand):
    """Show the plan: which passes and buffers a recipe takes on a scene, why, and what they cost.

    Args:
        recipe: A recipe file or the name of a preset.
        scene: The scene, as for render.
        variant: Which draw from the recipe's ranges.
        times: Render a few views to measure each pass's share of the time.
        at: Time at which weather that changes is explained, seconds since the drive's first image.
            The middle of the drive if absent.
        plot: Also draw all numbers that change over the drive to this PNG file.
        json_file: Also write the plan to this file.
    """

    recipe: Positional[str]
    scene: str
    variant: Annotated[int, Field(ge=0)] = 0
    times: bool = True
    at: float | None = None
    plot: Path | None = None
    json_file: JsonFile = None

    def run(self) -> int:
        from recipes.load import load_recipe, read_overrides
        from tools.explain import explain_recipe, explanation_text

        template = load_recipe(self.recipe, read_overrides(self.overrides))
        facts = explain_recipe(
            template, self.scene, self.variant, times=self.times, at_s=self.at, plot=self.plot
        )
        print(explanation_text(facts))
        write_json(self.json_file, facts)
        return 0


class RecipesOptions(Command):
    """List the presets, print a recipe or what it draws, or write the JSON Schema for editors.

    Args:
        name: A preset or a recipe file to print.
        draws: Print its ranges instead, and what every variant draws from them.
        overrides: Replace a field, as for render, and print the draws.
        schema_file: Write the JSON Schema of recipes to this file.
    """

    name: Positional[str | None] = None
    draws: bool = False
    overrides: Overrides = ()
    schema_file: Annotated[Path | None, arg(name="schema")] = None

    def run(self) -> int:
        from tools.recipes import show_recipes

        return show_recipes(self)


class SheetOptions(Command):
    """Draw pictures of an output folder: a contact sheet, and a video of one camera.

    Args:
        out: A folder that `climategs render` or `generate` wrote.
        recipe: Recipe names separated by commas, or all; of the video, too.
        camera: Camera names separated by commas, or all. They stand as on the car.
        frame: Which frames the contact sheet shows: 4, 0,5,9, or 0:20:2. The middle one by default.
        video_camera: Also write an MP4 of this camera, all variants side by side.
        fps: Frames per second of the video.
    """

    out: Positional[
        Annotated[Path, _local("`climategs report` reads object stores; or copy the output here")]
    ]
    recipe: str = "all"
    camera: str = "all"
    frame: Annotated[str, AfterValidator(_check_frames)] | None = None
    video_camera: str | None = None
    fps: Annotated[float, Field(gt=0)] = 10.0

    def run(self) -> int:
        from tools.sheet import draw_sheet, draw_video

        print(draw_sheet(self.out, self.recipe, self.camera, self.frame))
        if self.video_camera is not None:
            print(draw_video(self.out, self.video_camera, self.fps, self.recipe))
        return 0


class ReportOptions(Command):
    """Write one HTML page about an output: contents, weather, pictures, sliders, failures.

    It needs no network, may be sent to others as it is, and is written also while jobs are running.

    Args:
        out: A folder that `climategs render` or `generate` wrote, or its URI (s3://bucket/path).
        html: The page to write. By default OUT/report.html; NAME-report.html in the working folder
            where OUT is not on this machine.
        images: How many pictures the page has at most. It stays below 5 MB with any number.
    """

    out: Positional[str]
    html: Path | None = None
    images: int = 48

    def run(self) -> int:
        from tools.report import write_report

        print(write_report(self.out, self.html, self.images).sentence)
        return 0


class EvaluateOptions(Command):
    """Measure how consistent an output's images are: between frames, and between cameras.

    One image is warped into the other by the depth that was written with them, and compared where
    both show the same (docs/evaluation.md). Finished images are taken while jobs are running, too.

    Args:
        out: A folder that `climategs render` or `generate` wrote, or its URI (s3://bucket/path).
        short: How many frames are apart over short range.
        long: How many frames are apart over long range.
        scenes: Scene names separated by commas, or all.
        recipes: Recipe names separated by commas, or all.
        pairs: At most so many pairs of each kind from each variant of a scene, evenly chosen.
        lpips: Weights for LPIPS, .pth or .safetensors: of lpips.LPIPS (alex or vgg), or of
            torchvision's alexnet or vgg16 with lpips-heads. Nothing is downloaded.
        lpips_heads: The file of LPIPS's linear heads, where lpips has none.
        pictures: A folder for a picture of each recipe's worst pair of each kind.
        json_file: Also write all figures to this file, those of every pair included.
    """

    out: Positional[str]
    short: Count = 1
    long: Count = 7
    scenes: str = "all"
    recipes: str = "all"
    pairs: Count | None = None
    lpips: Path | None = None
    lpips_heads: Path | None = None
    pictures: Path | None = None
    json_file: JsonFile = None

    @model_validator(mode="after")
    def _long_is_longer(self) -> Self:
        if self.long <= self.short:
            raise ValueError(f"--long must be above --short {self.short}; got {self.long}")
        return self

    def run(self) -> int:
        from tools.evaluate import evaluate_output, evaluation_text

        facts = evaluate_output(self)
        print(evaluation_text(facts))
        write_json(self.json_file, facts)
        return 0


class ViewOptions(RecipeCommand):
    """Look at a scene in the browser, with a slider for every field of every effect.

    Recipes and pictures that the page saves are repeated by render, to the byte (docs/viewer.md).

    Args:
        scene: The scene, as for render; or a folder that render or generate wrote, to look through.
        recipe: A recipe file or the name of a preset to start with.
        out: The folder that recipes and pictures are saved in.
        scale: Resolution relative to the recipe's, as for render.
        host: The address that pages are served at. 127.0.0.1 is for browsers on this machine.
        port: Or the next that is free.
        backend: Which rasteriser draws. auto: on the GPU (cuda) where there is one, else the CPU.
    """

    scene: Positional[str]
    recipe: str = "clear"
    out: Annotated[Path, _local("pages save to this machine")] = Path("views")
    scale: Annotated[float, Field(gt=0)] = 1.0
    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535)] = 8080
    backend: Backend = "auto"

    def run(self) -> int:
        from tools.view.server import view_scene

        return view_scene(self)


class ServeOptions(RecipeCommand):
    """Serve scenes in their weather to closed-loop simulators over gRPC (docs/simulator.md).

    It has the interface of AlpaSim's and NuRec's renderers. Clients name a scene, or
    SCENE@RECIPE#VARIANT.

    Args:
        scenes: Scenes, as for render; NAME=URI gives one the name that clients ask for.
        recipe: A recipe file or the name of a preset that clients may choose; may be given several
            times. The first is the weather of a scene without @RECIPE. clear by default.
        variants: How many draws from each recipe's ranges. The recipe's own number by default.
        host: The address to listen at. 127.0.0.1 is for programs of this machine.
        port: 0 takes a free one.
        max_scenes: Scenes in memory, at most; the others are opened when they are asked for.
        max_requests: Requests in flight, at most. Further ones are refused.
        max_pixels: Pixels of an image, at most.
        tls_cert: A PEM file with the server's certificate; clients then connect by TLS.
        tls_key: A PEM file with its private key.
        tls_client_ca: A PEM file; only clients with a certificate of this authority are served.
        log: Print a line for each request to stderr.
        metrics: At the end also write counts and latencies to this JSON file.
        backend: Which rasteriser draws. auto: on the GPU (cuda) where there is one, else the CPU.
    """

    scenes: Positional[
        Annotated[
            tuple[str, ...], arg(metavar="SCENE [SCENE ...]", help_behavior_hint="(required)")
        ]
    ]
    recipe: Annotated[tuple[str, ...], UseAppendAction] = ()
    variants: Count | None = None
    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535)] = 50051
    max_scenes: Count = 4
    max_requests: Annotated[int, Field(ge=1, le=1024)] = 32
    max_pixels: Annotated[int, Field(ge=1, le=1 << 24)] = 1 << 23
    tls_cert: Path | None = None
    tls_key: Path | None = None
    tls_client_ca: Path | None = None
    log: bool = False
    metrics: Path | None = None
    backend: Backend = "auto"

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if not self.scenes:
            raise ValueError("no scene is named: climategs serve SCENE --recipe RECIPE")
        if (self.tls_cert is None) != (self.tls_key is None):
            raise ValueError("--tls-cert and --tls-key belong together: give both, or neither")
        if self.tls_client_ca is not None and self.tls_cert is None:
            raise ValueError("--tls-client-ca needs --tls-cert and --tls-key")
        return self

    def run(self) -> int:
        from tools.serve.server import serve_scenes

        return serve_scenes(self)


def demo(out: Path = Path("out/demo"), frames: int = 10) -> int:
    """Render the embedded street under five recipes, with a contact sheet and a video.

    Args:
        out: The output folder.
        frames: How many frames of the drive.
    """
    from tools.demo import run_demo

    return run_demo(out, frames)


class ExportOptions(SceneCommand):
    """Write a scene as one file to share, or for other programs: .ply, .splat, .spz, .glb, .usdc.

    What the kind of file cannot keep is said.

    Args:
        scene: The scene, as for render.
        out: The file or folder; a file's suffix is added where it lacks.
        kind: file: everything in one .climategs file. scene: the same as a folder. ply-parts:
            background and every actor apart. The others: Gaussians as they are at one frame.
        frame: The frame that a file of one moment shows. The first by default.
        half: A file of about half the size, at a small loss.
        overwrite: Replace what is there.
    """

    scene: Positional[str]
    out: Path
    kind: ExportKind = "file"
    frame: int | None = None
    half: bool = False
    overwrite: bool = False

    @model_validator(mode="after")
    def _kind_has_them(self) -> Self:
        if self.frame is not None and self.kind not in get_args(SplatKind):
            kinds = join_names(get_args(SplatKind), "and")
            raise ValueError(f"--frame is for {kinds}, of one moment; not for {self.kind}")
        if self.half and self.kind != "file":
            text = "--half is for a single scene file (--kind file); not for"
            raise ValueError(f"{text} {self.kind}")
        return self

    def run(self) -> int:
        from tools.export import export_scene

        return export_scene(self)


class MirrorOptions(Command):
    """Lay rendered images into copies of their dataset, as `render --layout source` does.

    Args:
        out: A folder that `climategs render` or `generate` wrote.
        scene: Only of this scene. By default of all that the manifest names.
        links: hard: unchanged files share the dataset's disk space. copy: nothing is shared.
    """

    out: Positional[Annotated[Path, _local("copy the output here")]]
    scene: str | None = None
    links: Links = "hard"

    def run(self) -> int:
        from tools.mirror import mirror_again

        return mirror_again(self.out, self.scene, links=self.links)


class LabelsOptions(Command):
    """Write an output's labels for trainers: COCO, KITTI, YOLO, as its recipes' output.labels says.

    `render` and `generate` do so at their end; this divides the scenes, or changes what is written
    without rendering again. Later jobs keep to what was said here.

    Args:
        out: A folder that `climategs render` or `generate` wrote.
        split: Parts and their shares of the scenes, as in train=0.8 val=0.2.
        seed: What the split is drawn from.
        overrides: Change output.labels, categories, min_visibility or on_hidden, as for render.
    """

    out: Positional[Annotated[Path, _local(LABELS_OF_STORES)]]
    split: tuple[str, ...] = ()
    seed: int = 0
    overrides: Overrides = ()

    def run(self) -> int:
        from tools.labels import label_files

        print("\n".join(label_files(self.out, self.split, self.seed, self.overrides)))
        return 0


class ScoreCommand(Command):
    """Score a detector or a segmentation network on a robustness suite (docs/score.md).

    Nothing is scored unless everything fits: images, categories, variants, the probe of the loader,
    the baseline.

    Args:
        out: A folder or URI in which a suite was rendered.
        predictions: A folder with a folder of predictions for each variant: results.json (COCO or
            nuScenes), kitti/000000.txt or semantic/000000.png, and meta.json.
        baseline: Predictions of a baseline, or the JSON of its scores.
        effects: Names of effects separated by commas, or all.
        categories: Categories and the labels that belong to them, as in Car=vehicle.car
            Truck=vehicle.* (the first that takes a label counts). By default every label is one.
        kitti_view: KITTI's AP by overlaps in the image, from above, or in space.
        kitti_difficulty: Objects that count for KITTI's AP.
        nuscenes: The folder of nuScenes, for NDS by nuscenes-devkit.
        nuscenes_version: The version of its tables.
        nuscenes_split: The split whose samples the predictions have.
        nuscenes_python: The Python that has nuscenes-devkit, if it is not this one: the devkit
            needs an older NumPy.
        truth: Write the truth of each variant as a COCO file into this folder, with the numbers of
            images and categories, and score nothing.
        html: The page to write. By default PREDICTIONS/score.html.
        json_file: Also write the scores to this file; it serves as a baseline.
    """

    out: Positional[str]
    predictions: Path | None = None
    baseline: Path | None = None
    effects: str = "all"
    categories: tuple[str, ...] = ()
    kitti_view: Literal["bbox", "bev", "3d"] = "bbox"
    kitti_difficulty: Literal["easy", "moderate", "hard"] = "moderate"
    nuscenes: Path | None = None
    nuscenes_version: str = "v1.0-trainval"
    nuscenes_split: str = "val"
    nuscenes_python: Path | None = None
    truth: Path | None = None
    html: Path | None = None
    json_file: JsonFile = None

    @model_validator(mode="after")
    def _names_predictions(self) -> Self:
        if self.predictions is None and self.truth is None:
            raise ValueError("no predictions are named: climategs score OUT --predictions FOLDER")
        return self

    def run(self) -> int:
        from tools.score import score_predictions, write_truth

        return score_predictions(self) if self.truth is None else write_truth(self)


class TagsOptions(Command):
    """Say an output's weather in the classes and words of standards: OSI, OpenSCENARIO, OpenLABEL.

    Each variant has one entry; each frame, where its weather changes over time (docs/tags.md).

    Args:
        out: A folder that `climategs render` or `generate` wrote.
        format: csv: a table of all numbers and classes. osi: EnvironmentalConditions of ASAM OSI as
            JSON. openscenario: a catalog of Environments, XML 1.2. openlabel: OpenLABEL 1.0.0.
        file: Write to this file instead of printing.
    """

    out: Positional[Annotated[Path, _local("copy manifest.parquet and the recipe.yaml files here")]]
    format: Literal["csv", "osi", "openscenario", "openlabel"] = "csv"
    file: Path | None = None

    def run(self) -> int:
        from tools.tags import write_tags

        text = write_tags(self.out, self.format, self.file)
        print(text if self.file is None else f"wrote {self.file}\n", end="")
        return 0


class ApplyOptions(SceneCommand):
    """Write a scene in the colours of a photograph or a preset, with a picture of both beside it.

    Args:
        scene: The scene, as for render.
        style: An image file, or the name of a style preset; `climategs style presets` lists them.
        out: The styled scene's folder; open it as scene:OUT.
        method: mkl maps mean and covariance of the colours, reinhard mean and spread of each
            channel, gscm is the network.
        strength: 0 leaves the colours, 1 takes on the style's, up to 2 goes beyond.
        per_region: Maps of their own for road, vegetation and the rest.
        mask: An image, white where the style image shows sky.
        checkpoint: A trained network for gscm, in place of the one that comes with the package.
        overwrite: Replace the scene that is there.
        json_file: Also write the maps and figures to this file.
    """

    scene: Positional[str]
    style: Positional[str]
    out: Path
    method: Literal["mkl", "reinhard", "gscm"] = "mkl"
    strength: float = 1.0
    per_region: bool = False
    mask: Path | None = None
    checkpoint: Path | None = None
    overwrite: bool = False
    json_file: JsonFile = None

    def run(self) -> int:
        from tools.style import apply_style

        write_json(self.json_file, apply_style(self))
        return 0


def presets(name: Positional[str | None] = None) -> int:
    """List the style presets, or print one of them.

    Args:
        name: A preset to print.
    """
    from recipes.style import style_preset_names, style_preset_text

    print("\n".join(style_preset_names()) if name is None else style_preset_text(name), end="")
    if name is None:
        print()
    return 0


def bench() -> None:
    """Measure speed and error on this machine, one thing at a time."""
    # A line in the list of commands; the words after it go to a table of their own (tools.cli).


def style() -> None:
    """Colour moods: apply one to a scene, train the network behind them, list the presets."""
    # A line in the list of commands; the words after it go to a table of their own (tools.cli).


def suite() -> None:
    """Robustness suite weather-c: render, plan and verify it (docs/suite.md)."""
    # A line in the list of commands; the words after it go to a table of their own (tools.cli).


COMMANDS = {
    "render": RenderOptions,
    "generate": GenerateOptions,
    "suite": suite,
    "fit": FitOptions,
    "record": RecordOptions,
    "inspect": InspectOptions,
    "explain": ExplainOptions,
    "view": ViewOptions,
    "serve": ServeOptions,
    "recipes": RecipesOptions,
    "sheet": SheetOptions,
    "report": ReportOptions,
    "evaluate": EvaluateOptions,
    "score": ScoreCommand,
    "bench": bench,
    "demo": demo,
    "style": style,
    "export": ExportOptions,
    "mirror": MirrorOptions,
    "labels": LabelsOptions,
    "tags": TagsOptions,
}
# Commands of commands, which take over where the first word names one.
GROUPS = {
    "style": {"apply": ApplyOptions, "train": StyleTrainOptions, "presets": presets},
    "suite": {
        "weather-c": SuiteOptions,
        "plan": SuitePlanOptions,
        "verify": SuiteVerifyOptions,
        "probe": SuiteProbeOptions,
        "search": SuiteSearchOptions,
    },
}


def main(arguments: list[str] | None = None) -> int:
    """Run one command. Return 0; 1 where images failed, 2 for an error, 130 if interrupted."""
    if not sys.stderr.isatty():  # a log needs a progress line now and then, not ten a second
        os.environ.setdefault("TQDM_MININTERVAL", "10")
    arguments = sys.argv[1:] if arguments is None else arguments
    table = COMMANDS
    prog = "climategs"
    description = "Weather for driving scenes made of 3D Gaussians."
    logging.basicConfig(level=logging.INFO, format="%(message)s", handlers=[NoteHandler()])
    try:
        check_arguments(arguments)
        if arguments and arguments[0] in ("bench", *GROUPS):
            group, *arguments = arguments
            table = _bench_commands() if group == "bench" else GROUPS[group]
            prog = f"climategs {group}"
            description = COMMANDS[group].__doc__
        result = tyro.extras.subcommand_cli_from_dict(
            table, args=arguments, prog=prog, description=description, sort_subcommands=False
        )
        if isinstance(result, int | None):
            return result
        if isinstance(result, SceneCommand) and not result.cache:
            from adapters.scene_cache import disable_scene_cache

            disable_scene_cache()
        return result.run()
    except KeyboardInterrupt as interruption:
        print(str(interruption) or "interrupted", file=sys.stderr)
        return 130
    except Exception as error:
        if not _is_ours(error):
            raise
        print(f"error: {error}", file=sys.stderr)
        return 2


def check_arguments(arguments: list[str]) -> None:
    """Check that arguments are UTF-8 texts: paths go into manifests, which hold texts.

    Raises:
        ClimateGSError: an argument is not UTF-8.
    """
    for number, argument in enumerate(arguments, 1):
        try:
            argument.encode()
        except UnicodeEncodeError:
            from augment.errors import ClimateGSError

            raise ClimateGSError(
                f"argument {number} is not UTF-8 text: {argument!a}. Texts and names of files "
                f"must be; rename the file, or move it to a folder whose name is"
            ) from None


def _bench_commands() -> dict[str, Callable[..., int]]:
    """Return the commands of `climategs bench`, which the installed package lacks."""
    if importlib.util.find_spec("tools.bench") is None:
        from augment.errors import ClimateGSError

        raise ClimateGSError(
            "`climategs bench` is part of the source checkout, not of the installed package: clone "
            "the repository and run it there (pip install --editable ., or python -m tools.cli)"
        )
    from tools.bench import COMMANDS

    return COMMANDS


def _is_ours(error: Exception) -> bool:
    """Return True for an error that a user can act on; others are defects and get a traceback."""
    from recipes.errors import RecipeError

    if isinstance(error, RecipeError):
        return True
    errors = sys.modules.get("augment.errors")  # not loaded: then none of it was raised
    return errors is not None and isinstance(error, errors.ClimateGSError)


if __name__ == "__main__":
    sys.exit(main())
