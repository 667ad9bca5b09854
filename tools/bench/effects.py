"""`climategs bench effects`: the cost of every effect in a frame, and the errors of its pictures.

`EFFECTS` lists for each effect the frames whose cost is measured, and the tables of its errors. A
frame with the effect takes turns with the frame without it, so that ratios are of one run. Errors
are against known surfaces (`smog_truth.py`, `flood_truth.py`, `snow_truth.py`), known colours
(`style_scores.py`), or the most accurate setting.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from tqdm import tqdm

from adapters.base import open_scene, parse_uri
from adapters.procedural import StreetTruth, open_truth
from augment.effects.snow.layer import lay_snow
from augment.effects.snow.light import find_snow_light
from augment.effects.snow.plan import exposure_settings
from augment.effects.style.color_maps import NUM_CLASSES, StyleMaps, style_gaussians
from augment.effects.style.content import content_pictures, content_statistics
from augment.effects.style.images import image_statistics, read_style_image
from augment.effects.style.network import gscm_map, load_network
from augment.effects.style.statistics import closed_maps
from augment.exposure.cells import ExposedSurface
from augment.exposure.search import find_exposed_surface
from augment.metrics.image import psnr
from augment.render.composite import to_byte_array
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, Scene
from augment.scene.semantics import SemanticClass
from augment.timing import stopwatch
from recipes.schema import Recipe
from recipes.style import style_preset_names
from tools.bench.flood_truth import analytic_error, flood_fields, tier_error, water_masks
from tools.bench.harness import (
    Action,
    Figures,
    Table,
    figures,
    machine_facts,
    median_ms,
    peak_mib_in_subprocess,
    rounds,
    spread_ratio,
)
from tools.bench.scenes import (
    SMALL,
    RasterCase,
    all_cameras,
    frame_of,
    front_camera,
    random_scene,
    recipe_of,
    street_uri,
    water_camera,
)
from tools.bench.smog_truth import smog_error, truth_view
from tools.bench.snow_truth import snow_accuracy
from tools.bench.style_scores import score_table


@dataclass(frozen=True)
class EffectCase:
    """Scenes and sizes of an effect's measurements."""

    scenes: tuple[str, ...] = (street_uri(gaussians=1_000_000),)
    """Addresses of the scenes that measure cost."""
    width: int = 1600
    """Width of the frames that measure cost, pixels."""
    height: int = 1066
    """Height of these frames, pixels."""
    street: str = street_uri(6)
    """Address of the procedural street that measures errors: its truth is known."""
    frames: tuple[int, ...] = (0, 5)
    """Frames of the street's views."""
    cameras: tuple[str, ...] = ("front", "left", "back")
    """Cameras of the street's views."""
    scale: float = 1.0
    """Scale of the street's views."""
    cell_m: float = 0.05
    """Edge of a snow cell near the path, metres."""
    splats: int = 1_000_000
    """Number of splats into whose SH a style is folded."""
    presets: tuple[str, ...] = ()
    """Styles whose pictures are compared; empty for all."""
    photos: Path | None = None
    """Folder of photographs on which style methods are scored."""
    memory: bool = True
    """True if memory is measured."""

    def open_street(self) -> tuple[Scene, StreetTruth]:
        """Return the street and its exact surfaces."""
        return open_scene(self.street), open_truth(parse_uri(self.street)[2])

    def views(self, street: Scene, scale: float = 1.0) -> list[Camera]:
        """Return the cameras of the street's views. scale: on top of the case's."""
        return [
            street.frame(frame).cameras[name].scaled(self.scale * scale)
            for frame in self.frames
            for name in self.cameras
        ]


FULL_CASE = EffectCase()  # The case of published figures.
# The case of `--quick`.
QUICK_CASE = EffectCase(
    scenes=(street_uri(),),
    width=800,
    height=533,
    street=street_uri(2, 120_000),
    frames=(0,),
    cameras=("front",),
    scale=0.5,
    cell_m=0.1,
    splats=200_000,
    presets=("overcast", "golden-hour"),
)


class Frames(NamedTuple):
    """A frame with an effect, and the frame that it is compared with."""

    effects: Mapping[str, Any]
    """Fields of every effect of the frame, by the effect's name."""
    without: Mapping[str, Any] = {}
    """The same of the other frame."""

    def recipes(self, cell_m: float) -> tuple[Recipe, Recipe]:
        """Return the recipes of both frames. cell_m: edge of snow cells, metres."""
        effects = dict(self.effects)
        if "snow" in effects:
            effects["snow"] = {"cell_m": cell_m, **effects["snow"]}
        return recipe_of(effects), recipe_of(self.without)


class EffectBench(NamedTuple):
    """The measurements of one effect."""

    costs: Mapping[str, Frames]
    """Frames whose cost is measured, by the name of their row."""
    staged: Sequence[str]
    """Rows whose stages and memory are measured."""
    errors: Callable[[EffectCase, int], Iterator[Table]]
    """Function from the case and the number of rounds to the other tables."""


def measure_effect(
    effect: str, repeats: int, case: EffectCase, scene: str | None = None
) -> Figures:
    """Measure one effect.

    Args:
        effect: The effect's name in EFFECTS.
        repeats: The number of rounds that count.
        case: The scenes and sizes.
        scene: The address of a further scene in which the effect's cost is measured.
    """
    machine = machine_facts()
    case = dataclasses.replace(case, scenes=(*case.scenes, *([scene] if scene else [])))
    bench = EFFECTS[effect]
    costs = [table for uri in case.scenes for table in cost_tables(uri, case, bench, repeats)]
    return figures(effect, [*costs, *bench.errors(case, repeats)], machine=machine)


# ---- cost ---------------------------------------------------------------------------------------


def cost_tables(uri: str, case: EffectCase, bench: EffectBench, repeats: int) -> Iterator[Table]:
    """Measure frames with and without an effect in turns: times, stages, memory."""
    scene = open_scene(uri)
    camera = water_camera(scene, case.width, case.height)
    rows = []
    stages = {}
    recipes = {}
    for name, frames in tqdm(bench.costs.items(), "frames", leave=False):
        recipe, clean = frames.recipes(case.cell_m)
        seconds, stage_ms = time_frames(scene, camera, {"with": recipe, "clean": clean}, repeats)
        ratio = spread_ratio(seconds["with"], seconds["clean"]).values()
        rows.append([name, median_ms(seconds["clean"]), median_ms(seconds["with"]), *ratio])
        if name in bench.staged:
            recipes |= {"clean": clean, name: recipe}
            stages.setdefault("clean", stage_ms["clean"])
            stages[name] = stage_ms["with"]
    count = sum(len(part.gaussians) for part in scene.parts_for(camera))
    title = f"Frames: {uri}, {count:,} Gaussians, {camera.name} {case.width}x{case.height}"
    yield Table(title, ("case", "clean ms", "with it ms", "ratio", "least", "p90"), rows)
    stage_rows = [
        [stage, *(stage_ms.get(stage) for stage_ms in stages.values())]
        for stage in dict.fromkeys(stage for stage_ms in stages.values() for stage in stage_ms)
        if any(stage_ms.get(stage, 0) >= 0.1 for stage_ms in stages.values())
    ]
    yield Table("Stages, ms; those below 0.1 left out", ("stage", *stages), stage_rows)
    if case.memory:
        size = (uri, case.width, case.height)
        mib = [[n, peak_mib_in_subprocess(_warm_frame, (*size, r))] for n, r in recipes.items()]
        yield Table("Memory of a frame above its scene", ("case", "MiB"), mib)


def time_frames(
    scene: Scene, camera: Camera, recipes: Mapping[str, Recipe], repeats: int, backend: str = "auto"
) -> tuple[dict[str, list[float]], dict[str, dict[str, float]]]:
    """Time frames of several recipes in turns, to finished floats.

    Returns:
        Seconds of every recipe's frames; medians of their stages in milliseconds, by recipe and
        stage.
    """
    stage_times: dict[str, list[dict[str, float]]] = {name: [] for name in recipes}

    def timed_frame(name: str, frame: Action) -> None:
        with stopwatch() as seconds:
            frame()
        stage_times[name].append(seconds)

    frames = {name: frame_of(scene, camera, recipe, backend) for name, recipe in recipes.items()}
    actions = {name: functools.partial(timed_frame, name, frame) for name, frame in frames.items()}
    return rounds(actions, repeats), {
        name: {
            stage: median_ms([lap.get(stage, 0.0) for lap in frame_stages[1:]])
            for stage in frame_stages[-1]
        }
        for name, frame_stages in stage_times.items()
    }


def _warm_frame(uri: str, width: int, height: int, recipe: Recipe) -> Action:
    """Return an action that draws a frame which was drawn small before.

    So the process already holds kernels, snow, maps and sky.
    """
    scene = open_scene(uri)
    camera = water_camera(scene, width, height)
    frame_of(scene, camera.scaled(SMALL), recipe)()
    return frame_of(scene, camera, recipe)


# ---- smog ---------------------------------------------------------------------------------------

SMOG_MODELS = ("per_gaussian", "deferred")  # The models of a smog, the first is the default.
# The fields of every measured smog, by its name.
SMOGS = {
    "uniform": {"visibility_m": 80},
    "overcast": {"visibility_m": 80, "overcast": 0.5},
    "linear": {"visibility_m": 80, "blend": "linear"},
}
# The rows of smog: every smog by every model.
SMOG_FRAMES = {
    f"{name}, {model}": Frames({"smog": {**smog, "model": model}})
    for name, smog in SMOGS.items()
    for model in SMOG_MODELS
}


def smog_errors(case: EffectCase, repeats: int) -> Iterator[Table]:
    """Compare pictures in smog with exact smog, away from silhouettes and at them."""
    scene, truth = case.open_street()
    views = [truth_view(scene, truth, camera) for camera in case.views(scene, 0.5)]
    rows = []
    for name, frames in SMOG_FRAMES.items():
        errors = [smog_error(recipe_of(frames.effects), scene, view) for view in views]
        for region in views[0].regions:
            masked_errors = [e[view.regions[region]] for e, view in zip(errors, views, strict=True)]
            median, p99 = map(float, np.quantile(np.concatenate(masked_errors), [0.5, 0.99]))
            rows.append([name, region, median, p99])
    title = f"Largest channel error against exact smog, 1/255: {case.street}"
    yield Table(title, ("smog", "region", "median", "p99"), rows)


# ---- flood --------------------------------------------------------------------------------------

TIERS = ("sky", "screen_space", "mirrored")  # The reflections of a flood, the last one is exact.
WAVES = ("still", "calm")  # The presets of waves that are measured.


# The fields of every measured flood, by the name of its row.
FLOODS = {
    **{f"{tier}, {waves}": flood_fields(tier, waves) for tier in TIERS for waves in WAVES},
    "mirrored, calm, schlick": flood_fields("mirrored", "calm", fresnel="schlick"),
    "level below everything": flood_fields("mirrored", level_m=-100.0),
}
FLOOD_FRAMES = {name: Frames({"flood": fields}) for name, fields in FLOODS.items()}


def flood_errors(case: EffectCase, repeats: int) -> Iterator[Table]:
    """Compare reflections with a more exact picture, and the mask of water with cast rays."""
    street, truth = case.open_street()
    rows: list[list[Any]] = []
    for camera in case.views(street):
        errors = {"mirrored against mirrored splats": analytic_error(street, camera)} | {
            f"{tier}, {waves}, against mirrored": tier_error(street, camera, tier, waves)
            for tier in TIERS[:2]
            for waves in WAVES
        }
        name = f"{camera.name} at {camera.timestamp_ns} ns"
        keys = ("psnr_db", "black_share", "worst_block")
        rows += [[name, picture, *map(error.get, keys)] for picture, error in errors.items()]
    title = f"Errors inside the water: {case.street}"
    yield Table(title, ("view", "picture", "PSNR dB", "black", "worst 32x32, 1/255"), rows)
    yield Table(
        "Masks of water against the truth: shares of pixels",
        ("view", "agreeing", "away from silhouettes", "which are"),
        water_masks(street, truth, case.frames, scale=case.scale / 2),
    )


# ---- snow ---------------------------------------------------------------------------------------

SHADINGS = ("per_splat", "per_pixel")  # The shadings of snow that are measured.
SNOW_DEPTH_M = 0.1  # The depth of the snow that is measured, metres.
NUM_PLACEMENTS = 3  # The largest number of timed placements of snow.
SMOG_BESIDE = {"smog": {"visibility_m": 200}}  # The smog of frames of snow in smog.
FLOOD_BESIDE = {"flood": {"level_m": 0.15, "reference": "median"}}  # The flood beside snow.


def _snow(shading: str, **other_effects: Any) -> Frames:
    snow = {"depth_m": SNOW_DEPTH_M, "shading": shading}
    return Frames({"snow": snow, **other_effects}, other_effects)


SNOW_FRAMES = {
    **{shading: _snow(shading) for shading in SHADINGS},
    "per_splat, smog": _snow("per_splat", **SMOG_BESIDE),
    "per_splat, flood": _snow("per_splat", **FLOOD_BESIDE),
}


def snow_errors(case: EffectCase, repeats: int) -> Iterator[Table]:
    """Time the placement of snow, and compare its places and heights with the true surface."""
    for uri in case.scenes:
        yield placement_table(uri, case, repeats)
    street, truth = case.open_street()
    reach_m, pixel_m = (16.0, 0.1) if case.cell_m >= 0.1 else (32.0, 0.05)
    size = {"cell_m": case.cell_m, "reach_m": reach_m, "pixel_m": pixel_m}
    accuracy = snow_accuracy(street, truth, **size, depths_m=(SNOW_DEPTH_M,))
    rows = []
    for estimator in accuracy["estimators"]:
        (layer,) = estimator["depths"]
        shares = (estimator["covered"], layer["sheltered"])
        lengths = (*estimator["error_m"].values(), layer["error_on_scene_m"]["median"])
        hundredfold = [None if n is None else 100 * n for n in (*shares, *lengths)]
        rows.append([estimator["estimator"], *hundredfold])
    yield Table(
        f"Snow: {case.street}, {accuracy['points']:,} points open to the sky, flat and seen",
        ("heights from", "covered %", "sheltered %", "error cm", "p95", "bias", "layer cm"),
        rows,
        f"layer: error of the drawn layer beside the scene's own surface, which is off by "
        f"{100 * accuracy['scene_bias_m']:+.1f} cm",
    )


def placement(scene: Scene, cell_m: float, backend: str = "auto") -> Callable[[], ExposedSurface]:
    """Return an action that places snow for all cameras."""
    snow = recipe_of({"snow": {"depth_m": SNOW_DEPTH_M, "cell_m": cell_m}}).weather.snow
    settings = exposure_settings(snow, scene)
    cameras = all_cameras(scene)
    return functools.partial(find_exposed_surface, scene, cameras, settings, backend=backend)


def placement_table(uri: str, case: EffectCase, repeats: int) -> Table:
    """Time the placement of snow for all cameras, and the layer of snow on it."""
    scene = open_scene(uri)
    find = placement(scene, case.cell_m)
    surface = find()
    # Each layer has another depth than the last one, so that nothing of that can be used again.
    depths_m = itertools.cycle((0.05, 0.1, 0.3))

    def lay() -> object:
        snow = recipe_of({"snow": {"depth_m": next(depths_m)}}).weather.snow
        return lay_snow(surface, scene, snow, find_snow_light(scene, snow), seed=0)

    stages = rounds({"all": find}, min(repeats, NUM_PLACEMENTS))
    stages |= rounds({"another depth": lay}, repeats)
    mib = peak_mib_in_subprocess(_warm_placement, (uri, case.cell_m)) if case.memory else None
    on_vehicles = sum(map(len, surface.actors.values()))
    return Table(
        f"Placement: {uri}, {len(all_cameras(scene))} cameras, cells of {case.cell_m:g} m",
        ("stage", "seconds", "least"),
        [[stage, float(np.median(times)), min(times)] for stage, times in stages.items()],
        f"{len(surface.ground):,} cells, {on_vehicles:,} on {len(surface.actors)} vehicles"
        + ("" if mib is None else f"; {mib:.0f} MiB above the scene"),
    )


def _warm_placement(uri: str, cell_m: float) -> Action:
    """Return an action that places snow, with kernels loaded."""
    scene = open_scene(uri)
    placement(dataclasses.replace(scene, frames=scene.frames[:1]), 10 * cell_m)()
    return placement(scene, cell_m)


# ---- rain and snowfall --------------------------------------------------------------------------

# The weathers, by the name of their row.
FALLING_FRAMES = {
    "rain 10 mm/h, dry": Frames({"rain": {"rate_mm_h": 10, "wetness": 0}}),
    "rain 10 mm/h": Frames({"rain": {"rate_mm_h": 10}}),
    "snowfall 1 mm/h": Frames({"snowfall": {"rate_mm_h": 1}}),
}
# The widths from which a drop or flake is drawn by itself, pixels.
WIDTHS_PX = (0.25, 0.35, 0.5, 1.0, 2.0)


def falling_errors(case: EffectCase, repeats: int) -> Iterator[Table]:
    """Compare pictures with fewer single drops with one of the most. The others become a veil."""
    scene, _ = case.open_street()
    camera = case.views(scene)[0]
    rows = []
    for name in ("rain 10 mm/h, dry", "snowfall 1 mm/h"):
        ((kind, fields),) = FALLING_FRAMES[name].effects.items()
        pictures = []
        for width in WIDTHS_PX:
            speed = {f"{kind}_min_width_px": width}
            recipe = recipe_of({kind: fields, "render": {"speed": speed}})
            pictures.append(frame_of(scene, camera, recipe)().rgb)
        for width, picture in zip(WIDTHS_PX, pictures, strict=True):
            change = 255 * (picture - pictures[0]).abs()
            rows.append([name, width, float(change.mean()), float(change.max())])
    title = f"Drops drawn one by one, against those of {WIDTHS_PX[0]} px; 1/255: {case.street}"
    yield Table(title, ("falls", "min_width_px", "mean error", "largest"), rows)


# ---- hour and lamps -----------------------------------------------------------------------------

NIGHT = {"time": "night", "sky_luminance_cd_m2": 0.05}  # The night that is measured.
LAMPS_BY_DAY = {"time": "day", "vehicles": "on", "vehicle_share": 1}  # All vehicles' lamps by day.
LIT_FOG = {"smog": {"visibility_m": 120, "blend": "linear"}}  # The fog about lamps.
# The frames with lamps, by the name of their row.
LIGHT_FRAMES = {
    "night": Frames({"light": NIGHT}),
    "night, fog 120 m": Frames({"light": NIGHT, **LIT_FOG}),
    "night, rain 10 mm/h": Frames({"light": NIGHT, "rain": {"rate_mm_h": 10}}),
    "fog 120 m by day, over the fog alone": Frames({"light": LAMPS_BY_DAY, **LIT_FOG}, LIT_FOG),
    "clear day, no lamp on": Frames({"light": {"time": "day"}}),
}
# The values of each setting of `render.speed` for lamps, the most accurate one last.
LAMP_SETTINGS = {"lamp_points": (4, 8, 16), "lamp_halo_px": (8, 4, 2), "lamps_per_pixel": (2, 4, 8)}


def lamp_errors(case: EffectCase, repeats: int) -> Iterator[Table]:
    """Compare pictures of fog at night with one of the most accurate settings."""
    scene, _ = case.open_street()
    camera = case.views(scene)[0]
    exact = {name: values[-1] for name, values in LAMP_SETTINGS.items()}

    def picture(speed: Mapping[str, int]) -> torch.Tensor:
        light = {**NIGHT, "noise": 0}
        recipe = recipe_of({"light": light, **LIT_FOG, "render": {"speed": speed}})
        return frame_of(scene, camera, recipe)().rgb.clamp(0, 1)

    reference = picture(exact)
    rows = []
    for name, values in LAMP_SETTINGS.items():
        for value in values[:-1]:
            change = 255 * (picture({**exact, name: value}) - reference).abs()
            rows.append([name, value, float(change.mean()), float(change.max())])
    title = f"Lamps in fog at night, against the most accurate settings; 1/255: {case.street}"
    yield Table(title, ("setting", "value", "mean error", "largest"), rows)


# ---- style --------------------------------------------------------------------------------------


def _style(preset: str = "overcast", **other_fields: Any) -> Frames:
    return Frames({"style": {"preset": preset, **other_fields}})


STYLE_FRAMES = {
    "one map": _style(),
    "a map a region": _style(per_region=True),  # a preset's are the same
    "on the picture": _style(applied_to="picture"),
    "one map, folded into SH": _style(evaluated="sh"),
}


def style_errors(case: EffectCase, repeats: int) -> Iterator[Table]:
    """Time maps of styles, compare maps folded into SH with mapped colours, and score methods."""
    yield fold_table(RasterCase(case.splats, 640, 480), repeats)
    for uri in case.scenes:
        yield folded_error_table(uri, case)
    yield map_table(open_scene(case.street), repeats)
    if case.photos is not None:
        yield score_table(case.photos)


def fold(
    gaussians: Gaussians, count: int, out: torch.Tensor | None, backend: str = "auto"
) -> Action:
    """Return an action that folds colour maps into SH. Colours stay finite however often it runs.

    Args:
        gaussians: The Gaussians.
        count: The number of maps: 1, or one for each class.
        out: The tensor that receives the mapped SH; None for a new one.
        backend: The backend.
    """
    map_34 = 0.9 * torch.eye(3, 4)
    maps = StyleMaps(map_34.repeat(count, 1, 1), map_34, map_34)
    return functools.partial(style_gaussians, gaussians, maps, out=out, backend=backend)


def fold_table(case: RasterCase, repeats: int) -> Table:
    """Time folds of one map, and of one map for each class, into the SH of random Gaussians."""
    gaussians, _ = random_scene(case)
    classes = torch.arange(len(gaussians), dtype=torch.int16) % (max(SemanticClass) + 1)
    gaussians = dataclasses.replace(gaussians, semantic=classes)
    maps = {"one map": 1, "a map a class": NUM_CLASSES}
    actions = {name: fold(gaussians, count, gaussians.sh) for name, count in maps.items()}
    seconds = rounds(actions, repeats)
    title = f"Maps folded into {len(gaussians):,} Gaussians of SH degree 3"
    rows = [[name, median_ms(times), 1e3 * min(times)] for name, times in seconds.items()]
    return Table(title, ("map", "ms", "least"), rows)


def folded_error_table(uri: str, case: EffectCase) -> Table:
    """Compare pictures of maps folded into SH with pictures of mapped colours.

    They differ where a splat with a colour below 0 is blended. Without folding, its colour is
    clamped before the map.
    """
    scene = open_scene(uri)
    camera = front_camera(scene, case.width)
    rows = []
    for preset in case.presets or style_preset_names():
        recipes = (recipe_of(_style(preset, evaluated=to).effects) for to in ("sh", "color"))
        folded, mapped = (frame_of(scene, camera, r)().rgb.numpy() for r in recipes)
        error = 255 * np.abs(folded - mapped).max()
        psnr_db = psnr(folded.clip(0, 1), mapped.clip(0, 1)) if error else None
        rows.append([preset, psnr_db, float(error)])
    title = f"Maps folded into SH against mapped colours: {uri}"
    return Table(title, ("preset", "PSNR dB", "largest, 1/255"), rows)


def map_table(scene: Scene, repeats: int) -> Table:
    """Time the steps from a style image's file to its map. Statistics of the scene are cached."""
    net = load_network(None)
    rgb = frame_of(scene, front_camera(scene, 1920), recipe_of({}))().rgb
    content = content_statistics(scene, per_region=False)
    pictures = content_pictures(scene)

    def closed(method: Any) -> object:
        style = image_statistics(image)
        return closed_maps(content, style, method=method, strength=1.0, per_region=False)

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "style.jpg"
        cv2.imwrite(str(path), to_byte_array(rgb * torch.tensor([1.0, 0.8, 0.6]))[..., ::-1])
        image = read_style_image(path)
        actions: dict[str, Action] = {
            "reading the image": lambda: read_style_image(path),
            "mkl": lambda: closed("mkl"),
            "reinhard": lambda: closed("reinhard"),
            "gscm": lambda: gscm_map(net, pictures, pictures[:1].flip(3)),
        }
        seconds = rounds(actions, repeats)
    rows = [[name, median_ms(times), 1e3 * min(times)] for name, times in seconds.items()]
    return Table("From a style image to its map", ("step", "ms", "least"), rows)


# The measurements of every effect, by its name.
EFFECTS = {
    "smog": EffectBench(SMOG_FRAMES, [f"uniform, {model}" for model in SMOG_MODELS], smog_errors),
    "flood": EffectBench(FLOOD_FRAMES, [f"{tier}, calm" for tier in TIERS], flood_errors),
    "snow": EffectBench(SNOW_FRAMES, SHADINGS, snow_errors),
    "rain": EffectBench(FALLING_FRAMES, [*FALLING_FRAMES], falling_errors),
    "light": EffectBench(LIGHT_FRAMES, ["night", "night, fog 120 m"], lamp_errors),
    "style": EffectBench(STYLE_FRAMES, ["one map"], style_errors),
}
