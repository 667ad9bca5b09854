"""Smog, flood, snow and style: what a frame under each costs beside the clean one, and how far
pictures, masks and placed snow are from what is known of the procedural street's true surfaces.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from adapters.base import open_scene, parse_uri
from adapters.procedural import RayHits, StreetTruth, TrueView, open_truth
from augment.cameras import Camera
from augment.effects.flood.water_plane import plane_depth
from augment.effects.snow.cells import SnowCells, SnowSupport
from augment.effects.snow.height_map import Estimator
from augment.effects.snow.layer import build_snow_layer
from augment.effects.snow.light import illumination_of
from augment.effects.snow.placement import PlacementSettings, place_snow_support
from augment.effects.snow.snow import placement_settings
from augment.effects.style.color_maps import CLASSES, StyleMaps, style_gaussians
from augment.effects.style.content import content_pictures, content_statistics
from augment.effects.style.images import image_statistics, read_style_image
from augment.effects.style.network import gscm_map, load_network, network_facts
from augment.effects.style.scores import (
    closed_method,
    network_method,
    oversaturated_share,
    score_pairs,
)
from augment.effects.style.statistics import closed_maps
from augment.effects.style.train import read_photos
from augment.geometry import rigid
from augment.metrics.consistency import DepthView, find_warp
from augment.metrics.image import psnr
from augment.plan import Plan, make_plan
from augment.render.buffers import ALPHA, BUFFERS, RGB
from augment.render.composite import quantise
from augment.render.constants import RasterSettings
from augment.render.fog import blend_airlight, optical_depth
from augment.render.layout import ABOVE, BELOW, UNCUT, HeightClip
from augment.render.rasterize import rasterize
from augment.scene import Gaussians, PosedGaussians, Scene
from augment.semantics import SemanticClass
from augment.timing import stopwatch
from augment.views import render_buffers
from recipes.schema import Output, Recipe, Smog, Weather
from recipes.weather import Flood, Snow, style_preset_names
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
    PICTURE_ONLY,
    RasterCase,
    flood_recipe,
    front_camera,
    random_scene,
    snow_recipe,
    style_recipe,
    water_camera,
)

CLEAN = Recipe(output=PICTURE_ONLY)
SMALL = 0.125  # resolution of the frame that loads kernels before memory is measured
NEXT_CAMERA, AHEAD = "next camera", "1 ahead"
Cases = Mapping[str, tuple[Recipe, Recipe]]  # with the effect, and the clean frame beside it


@dataclass(frozen=True)
class EffectCase:
    """What an effect is measured on. scenes: of its cost, in an image of width x height pixels.
    street: of its errors, procedural, because the truth must be known; frames, cameras, scale: of
    the street's views. cell_m: of snow near the path. splats: of the SH that a style maps. presets:
    styles whose pictures are compared. photos: a folder that style methods are scored on. memory:
    whether it is measured.
    """

    scenes: tuple[str, ...] = ("procedural:street?seed=3&frames=1&gaussians=1000000",)
    width: int = 1600
    height: int = 1066
    street: str = "procedural:street?seed=3&frames=6"
    frames: tuple[int, ...] = (0, 5)
    cameras: tuple[str, ...] = ("front", "left", "back")
    scale: float = 1.0
    cell_m: float = 0.05
    splats: int = 1_000_000
    presets: tuple[str, ...] = style_preset_names()
    photos: Path | None = None
    memory: bool = True

    def open_street(self) -> tuple[Scene, StreetTruth]:
        return open_scene(self.street), open_truth(parse_uri(self.street)[2])

    def views(self, street: Scene, scale: float = 1.0) -> list[Camera]:
        return [
            street.frame(frame).cameras[name].scaled(self.scale * scale)
            for frame in self.frames
            for name in self.cameras
        ]


WHOLE = EffectCase()
QUICK = EffectCase(
    scenes=("procedural:street?seed=3&frames=1",),
    width=800,
    height=533,
    street="procedural:street?seed=3&frames=2&gaussians=120000",
    frames=(0,),
    cameras=("front",),
    scale=0.5,
    cell_m=0.1,
    splats=200_000,
    presets=("overcast", "golden-hour"),
)


def measure(
    effect: str,
    quick: bool = False,
    scene: str | None = None,
    photos: Path | None = None,
    repeats: int = 7,
    case: EffectCase | None = None,
) -> Figures:
    """effect: of EFFECTS. scene: another whose cost is measured beside the street's."""
    machine, case = machine_facts(), case or (QUICK if quick else WHOLE)
    scenes = (*case.scenes, *([scene] if scene else []))
    case = dataclasses.replace(case, scenes=scenes, photos=photos)
    return figures(effect, EFFECTS[effect](case, repeats), machine=machine)


# ---- cost ---------------------------------------------------------------------------------------


def cost_tables(
    case: EffectCase, uri: str, cases: Cases, staged: Sequence[str], repeats: int
) -> list[Table]:
    """Frames of every case in turns with clean ones. staged: cases whose stages and memory are
    shown.
    """
    scene = open_scene(uri)
    camera = water_camera(scene, case.width, case.height)
    rows, stages = [], {}
    for name, (recipe, clean) in tqdm(cases.items(), "frames", leave=False):
        seconds, stage_times = time_frames(
            scene, camera, {"effect": recipe, "clean": clean}, repeats
        )
        ratio = spread_ratio(seconds["effect"], seconds["clean"]).values()
        clean_ms, effect_ms = median_ms(seconds["clean"]), median_ms(seconds["effect"])
        rows.append([name, clean_ms, effect_ms, *ratio])
        if name in staged:
            stages.setdefault("clean", {**stage_times["clean"], "whole": clean_ms})
            stages[name] = {**stage_times["effect"], "whole": effect_ms}
    names = dict.fromkeys(stage for each in stages.values() for stage in each if stage != "whole")
    shown = [stage for stage in names if any(each.get(stage, 0) >= 0.1 for each in stages.values())]
    by_stage = [[s, *(each.get(s) for each in stages.values())] for s in (*shown, "whole")]
    count = sum(len(part.gaussians) for part in scene.parts_for(camera))
    title = f"Frames: {uri}, {count:,} Gaussians, {camera.name} {case.width}x{case.height}"
    tables = [
        Table(title, ("case", "clean ms", "with it ms", "ratio", "least", "p90"), rows),
        Table("Stages, ms; those below 0.1 left out", ("stage", *stages), by_stage),
    ]
    if case.memory:
        recipes = {"clean": cases[staged[0]][1], **{name: cases[name][0] for name in staged}}
        size = (uri, case.width, case.height)
        mib = [[n, peak_mib_in_subprocess(_frame_of, (*size, r))] for n, r in recipes.items()]
        tables.append(Table("Memory of a frame above its scene", ("case", "MiB"), mib))
    return tables


def time_frames(
    scene: Scene, camera: Camera, recipes: Mapping[str, Recipe], repeats: int
) -> tuple[dict[str, list[float]], dict[str, dict[str, float]]]:
    """Seconds of each recipe's frames as floats, and medians of their stages, milliseconds."""
    stage_times: dict[str, list[dict[str, float]]] = {name: [] for name in recipes}

    def frame(name: str, plan: Plan) -> None:
        with stopwatch() as seconds:
            render_buffers(scene, camera, plan)
        stage_times[name].append(seconds)

    plans = {name: make_plan(recipe, scene) for name, recipe in recipes.items()}
    seconds = rounds({n: functools.partial(frame, n, plan) for n, plan in plans.items()}, repeats)
    return seconds, {
        name: {stage: median_ms([lap.get(stage, 0.0) for lap in each[1:]]) for stage in each[-1]}
        for name, each in stage_times.items()
    }


def _frame_of(uri: str, width: int, height: int, recipe: Recipe) -> Action:
    """A frame of a process that has drawn it small: kernels, snow, maps and sky are there."""
    scene = open_scene(uri)
    camera, plan = water_camera(scene, width, height), make_plan(recipe, scene)
    render_buffers(scene, camera.scaled(SMALL), plan)
    return lambda: render_buffers(scene, camera, plan)


# ---- views of one moment ------------------------------------------------------------------------


def view_pairs(
    scene: Scene, frames: Sequence[int], scale: float
) -> Iterator[tuple[str, Camera, Camera]]:
    """Kind and cameras of pairs at one time: each camera and the next one clockwise; each and
    itself where it stands a frame ahead.
    """
    for index in frames:
        frame = scene.frame(index)
        ahead = next((f.cameras for f in scene.frames if f.index == index + 1), {})
        now, later = (
            {n: dataclasses.replace(c.scaled(scale), timestamp_ns=frame.timestamp_ns)
             for n, c in cameras.items()}
            for cameras in (frame.cameras, ahead)
        )  # fmt: skip
        ring = clockwise(frame.cameras)
        yield from ((NEXT_CAMERA, now[a], now[b]) for a, b in ring if a != b)
        yield from ((AHEAD, now[name], later[name]) for name in now if name in later)


def clockwise(cameras: Mapping[str, Camera]) -> list[tuple[str, str]]:
    """Each camera and the next one clockwise, by their optical axes; from the first one on."""

    def bearing(name: str) -> float:
        ahead = cameras[name].world_from_camera[:3, 2]
        return math.atan2(float(ahead[1]), float(ahead[0]))

    ring = sorted(cameras, key=bearing, reverse=True)
    first = ring.index(next(iter(cameras)))
    ring = ring[first:] + ring[:first]
    return list(zip(ring, [*ring[1:], ring[0]], strict=True))


@dataclass(frozen=True, eq=False)
class MaskedView:
    """seen: whose depth says which points two views share. mask bool [H, W]: of the effect."""

    seen: DepthView
    mask: np.ndarray


def mask_agreement(
    pairs: Iterator[tuple[str, Camera, Camera]], view_of: Callable[[Camera], MaskedView]
) -> list[list[str | float | int | None]]:
    """By kind of pairs: points that both show; share of them with equal masks, of all pairs and of
    the worst; root mean square difference of colours, 1/255, where both masks are true.
    """
    view_of = functools.cache(view_of)
    found: dict[str, list[tuple[int, int, float, int]]] = {}
    for kind, one, other in pairs:
        here, there = view_of(one), view_of(other)
        warp = find_warp(here.seen, there.seen)
        ours = here.mask[warp.counts]
        images = np.concatenate([there.seen.picture, there.mask[..., None]], -1)
        theirs = warp.sample(images)[warp.counts]
        same = ours == (theirs[:, 3] > 0.5)
        both = ours & same
        off = here.seen.picture[warp.counts][both] - theirs[both, :3]
        found.setdefault(kind, []).append(
            (len(ours), int(same.sum()), float((off**2).sum()), int(both.sum()))
        )
    rows = []
    for kind, each in found.items():
        points, same, squares, both = (sum(column) for column in zip(*each, strict=True))
        worst = min((s / p for p, s, _, _ in each if p), default=None)
        rms = 255 * math.sqrt(squares / (3 * both)) if both else None
        rows.append([kind, points, same / points if points else None, worst, rms])
    return rows


# ---- smog: errors against exact smog per pixel --------------------------------------------------
# The street's surfaces are known, and so is the distance d of every pixel. The exact picture is
# t(d) c + (1 - t(d)) airlight, with c the clean splat render: the smog is compared and not the
# splats' colour. Silhouettes, where a pixel shows two distances, count separately.

SMOGS = {
    "uniform, visibility 80 m": Smog(visibility_m=80),
    "uniform, visibility 300 m": Smog(visibility_m=300),
    "scale height 15 m, visibility 80 m": Smog(visibility_m=80, scale_height_m=15),
}
SMOOTH = 5  # px: a pixel is away from silhouettes where this square around it is one surface
SMOOTH_DEPTH = 0.1  # largest relative change of depth within that square


def smog_tables(case: EffectCase, repeats: int) -> list[Table]:
    recipes = {
        (name, model): smog_model_recipe(smog, model)
        for name, smog in SMOGS.items()
        for model in ("per_gaussian", "deferred")
    }
    costs = {", ".join(key): (recipe, CLEAN) for key, recipe in recipes.items()}
    staged = [name for name in costs if name.startswith("uniform, visibility 80 m")]
    tables = [t for uri in case.scenes for t in cost_tables(case, uri, costs, staged, repeats)]
    scene, truth = case.open_street()
    views = [truth_view(scene, truth, camera) for camera in case.views(scene, 0.5)]
    rows = []
    for key, recipe in recipes.items():
        errors = [smog_error(recipe, scene, view) for view in views]
        for region in views[0].regions:
            masks = [view.regions[region] for view in views]
            own = np.concatenate([e[mask] for e, mask in zip(errors, masks, strict=True)])
            if len(own):
                median, p99 = map(float, np.quantile(own, [0.5, 0.99]))
                rows.append([*key, region, len(own), median, p99, 100 * float((own > 4).mean())])
    title = f"Largest channel error against exact smog, 1/255: {case.street}"
    columns = ("smog", "model", "region", "pixels", "median", "p99", "above 4/255, %")
    return [*tables, Table(title, columns, rows)]


def smog_model_recipe(smog: Smog, model: str) -> Recipe:
    smog = smog.model_copy(update={"model": model})
    return Recipe(weather=Weather(smog=smog), output=PICTURE_ONLY)


@dataclass(frozen=True, eq=False)
class TruthView:
    """A camera's clean splat render and the exact picture of the same surfaces. regions: bool
    [H, W]: `smooth`, away from silhouettes, and `silhouette`, the other surface pixels.
    """

    camera: Camera
    clean: Tensor
    exact: TrueView
    regions: dict[str, np.ndarray]


def truth_view(scene: Scene, truth: StreetTruth, camera: Camera) -> TruthView:
    clean = render_buffers(scene, camera, make_plan(CLEAN, scene)).rgb
    exact = truth.render(camera)
    surface = np.isfinite(exact.depth)
    smooth = surface & away_from_silhouettes(exact.depth, exact.semantic, exact.instance)
    return TruthView(camera, clean, exact, {"smooth": smooth, "silhouette": surface & ~smooth})


def smog_error(recipe: Recipe, scene: Scene, view: TruthView) -> np.ndarray:
    """Largest channel error [H, W] of the fogged splats against exact smog, in 1/255."""
    plan, camera = make_plan(recipe, scene), view.camera
    assert plan.smog is not None
    fogged = render_buffers(scene, camera, plan).rgb
    z = torch.from_numpy(np.where(np.isfinite(view.exact.depth), view.exact.depth, 1.0))
    rays, eye_z = camera.ray_directions(torch.float64), float(camera.centre[2])
    tau = optical_depth(plan.smog, z * rays.norm(dim=-1), eye_z, eye_z + z * rays[..., 2])
    exact = blend_airlight(view.clean.double(), tau, plan.smog).float()
    return (fogged - exact).abs().amax(-1).numpy() * 255


def away_from_silhouettes(
    depth: np.ndarray, semantic: np.ndarray, instance: np.ndarray
) -> np.ndarray:
    """Pixels whose square of SMOOTH px shows one object, one class, and little change of depth."""
    kernel = np.ones((SMOOTH, SMOOTH), np.uint8)
    far = np.where(np.isfinite(depth), depth, 1e6).astype(np.float32)
    ratio = cv2.dilate(far, kernel) / np.maximum(cv2.erode(far, kernel), 1e-6)
    labels = (semantic.astype(np.float32) * 1000 + instance).astype(np.float32)
    same = cv2.dilate(labels, kernel) == cv2.erode(labels, kernel)
    return same & (ratio < 1 + SMOOTH_DEPTH)


# ---- flood: pictures of the water, and its mask --------------------------------------------------
# Still, opaque water under the mirrored tier is compared with a picture made without the flood's
# own mirror: the Gaussians themselves are mirrored. Other tiers are compared with the mirrored one.
# Which pixels show water first is known on the procedural street by casting rays.

TIERS, WAVES = ("sky", "screen_space", "mirrored"), ("still", "calm")
OPAQUE = {"absorption_per_m": (1e6, 1e6, 1e6)}
EDGE_PX = 3  # pixels this close to the water's border show two surfaces; splats overhang as far
DARK, LIT = 2 / 255, 8 / 255  # a black pixel, and what it is compared with when it should not be
BLOCK = 32
MIRROR = torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0], dtype=torch.float64))


def flood_tables(case: EffectCase, repeats: int) -> list[Table]:
    """Costs of every tier still and with waves, as pictures only; of Schlick's formula; of depth
    and labels as by default; and of water below everything.
    """
    default = Output()
    costs = {f"{t}, {w}": (flood_recipe(t, w), CLEAN) for t in TIERS for w in WAVES}
    costs["mirrored, calm, schlick"] = flood_recipe("mirrored", "calm", fresnel="schlick"), CLEAN
    for tier in TIERS:
        recipe = flood_recipe(tier, "calm", output=default)
        costs[f"{tier}, calm, depth and labels"] = recipe, Recipe(output=default)
    costs["level below everything"] = flood_recipe(level_m=-100.0), CLEAN
    staged = [f"{tier}, calm" for tier in TIERS]
    tables = [t for uri in case.scenes for t in cost_tables(case, uri, costs, staged, repeats)]
    street, truth = case.open_street()
    rows: list[Any] = []
    for camera in case.views(street):
        errors = {"mirrored against mirrored splats": analytic_error(street, camera)} | {
            f"{tier}, {waves}, against mirrored": tier_error(street, camera, tier, waves)
            for tier in TIERS[:2]
            for waves in WAVES
        }
        keys = ("psnr_db", "p99", "black_share", "worst_block", "worst_at")
        name = f"{camera.name} at {camera.timestamp_ns} ns"
        rows += [[name, picture, *map(error.get, keys)] for picture, error in errors.items()]
    columns = ("view", "picture", "PSNR dB", "p99", "black", f"worst {BLOCK}x{BLOCK}", "at")
    title = f"Errors inside the water, channels in 1/255: {case.street}"
    masks = water_masks(street, truth, case.frames, scale=case.scale / 2)
    return [
        *tables,
        Table(title, columns, rows),
        Table(
            "Masks of water against the truth: shares of pixels",
            ("view", "agreeing", "away from silhouettes", "which are"),
            masks,
        ),
    ]


@dataclass(frozen=True, eq=False)
class Picture:
    """rgb [H, W, 3] in [0, 1]. water [H, W]: where the view shows it first."""

    rgb: np.ndarray
    water: np.ndarray


def draw_picture(scene: Scene, camera: Camera, recipe: Recipe) -> Picture:
    buffers = render_buffers(scene, camera, make_plan(recipe, scene))
    water = buffers.water
    if water is None:
        water = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    return Picture(buffers.rgb.clamp(0, 1).numpy(), water.numpy())


def inside(water: np.ndarray) -> np.ndarray:
    """The water's pixels at least EDGE_PX from its border; the image's border is none."""
    kernel = np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1), np.uint8)
    return cv2.erode(water.astype(np.uint8), kernel, borderValue=1).astype(bool)


def analytic_error(scene: Scene, camera: Camera, fresnel: str = "exact") -> dict[str, Any]:
    """The mirrored tier against mirrored Gaussians: still, opaque water."""
    recipe = flood_recipe(fresnel=fresnel, **OPAQUE)
    picture = draw_picture(scene, camera, recipe)
    truth = mirrored_picture(scene, camera, make_plan(recipe, scene)).clamp(0, 1).numpy()
    return {
        **water_error(picture, Picture(truth, picture.water)),
        "water_share": float(picture.water.mean()),
        "psnr_with_edges_db": psnr(picture.rgb, truth, picture.water),
        "outside_psnr_db": psnr(picture.rgb, truth, inside(~picture.water)),
    }


def tier_error(scene: Scene, camera: Camera, reflection: str, waves: str) -> dict[str, Any]:
    """A tier against the mirrored one under the same waves, inside the water."""
    tiers = (flood_recipe(tier, waves) for tier in (reflection, "mirrored"))
    return water_error(*(draw_picture(scene, camera, recipe) for recipe in tiers))


def water_error(picture: Picture, truth: Picture) -> dict[str, Any]:
    """psnr_db in the water; black_share of its pixels that are dark and should not be; worst_block:
    mean channel error in 1/255 of the worst square of BLOCK px that is at least half water, and
    worst_at, its column and row.
    """
    mask = inside(truth.water)
    black = (picture.rgb.max(-1) < DARK) & (truth.rgb.max(-1) >= LIT) & mask
    error = np.abs(picture.rgb - truth.rgb).mean(-1) * 255
    worst = (0.0, 0, 0)
    for row in range(0, error.shape[0], BLOCK):
        for column in range(0, error.shape[1], BLOCK):
            here = np.s_[row : row + BLOCK, column : column + BLOCK]
            if 2 * mask[here].sum() >= BLOCK * BLOCK:
                worst = max(worst, (float(error[here][mask[here]].mean()), column, row))
    return {
        "psnr_db": psnr(picture.rgb, truth.rgb, mask),
        "black_share": float(black.sum() / mask.sum()),
        "p99": float(np.quantile(error[mask], 0.99)),
        "worst_block": worst[0],
        "worst_at": f"{worst[1]}, {worst[2]}",
    }


def mirror_gaussians(gaussians: Gaussians) -> Gaussians:
    """The Gaussians mirrored in their frame's plane z = 0.

    With M = diag(1, 1, -1) the axes R become M R M, a rotation again, since an ellipsoid does not
    change when one of its axes is turned round; its axis vector is -M v. The colour seen along d
    was that along M d: the function of band l and order m has the parity (-1)^(l + m) in z.
    """
    bands = range(gaussians.sh_degree + 1)
    parity = [(-1.0) ** (band + order) for band in bands for order in range(-band, band + 1)]
    return dataclasses.replace(
        gaussians,
        means=gaussians.means * gaussians.means.new_tensor([1.0, 1.0, -1.0]),
        quats=gaussians.quats * gaussians.quats.new_tensor([1.0, -1.0, -1.0, 1.0]),
        sh=gaussians.sh * gaussians.sh.new_tensor(parity)[:, None],
    )


def mirror_parts(parts: Sequence[PosedGaussians], level_z_m: float) -> list[PosedGaussians]:
    """The parts mirrored in the plane z = level_z_m of the world.

    A mirrored pose would be no rigid motion. Mirrored once more in the part's own frame it is one.
    """
    plane, identity = MIRROR.clone(), torch.eye(4, dtype=torch.float64)
    plane[2, 3] = 2 * level_z_m
    poses = [identity if p.world_from_part is None else p.world_from_part for p in parts]
    return [
        PosedGaussians(mirror_gaussians(part.gaussians), plane @ pose @ MIRROR, part.instance_id)
        for part, pose in zip(parts, poses, strict=True)
    ]


def mirrored_picture(scene: Scene, camera: Camera, plan: Plan) -> Float[Tensor, "H W 3"]:
    """The flooded view, not clamped, of an eye above still, opaque water without smog."""
    medium = plan.flood
    assert medium is not None and medium.waves.is_flat and plan.smog is None
    parts, level_z_m = scene.parts_for(camera), medium.level_z_m
    below = mirror_parts(parts, level_z_m)
    front, alpha_above = _layer(parts, camera, plan, HeightClip(level_z_m, ABOVE))
    rgb, alpha = _layer(below, camera, plan, HeightClip(level_z_m, BELOW, overlaps=True))
    rays = camera.ray_directions(torch.float64)
    reflected = (
        rgb + (1 - alpha) * scene.sky.sample((rays * MIRROR.diagonal()[:3]).float()).double()
    )
    cosine = (-rays[..., 2] / rays.norm(dim=-1)).clamp(0, 1).numpy()
    share = torch.from_numpy(fresnel_by_angles(cosine, medium.refraction_index))[..., None]
    water = share * reflected + (1 - share) * torch.tensor(medium.rgb, dtype=torch.float64)
    behind = torch.where(rays[..., 2:] < 0, water, scene.sky.sample(rays.float()).double())
    return (front + (1 - alpha_above) * behind).float()


def _layer(
    parts: Sequence[PosedGaussians], camera: Camera, plan: Plan, clip: HeightClip
) -> tuple[Tensor, Tensor]:
    """Premultiplied rgb [H, W, 3] and alpha [H, W, 1], float64."""
    buffers = frozenset({RGB, ALPHA})
    out = rasterize(parts, camera, buffers=buffers, settings=plan.settings, clip=clip)
    assert out.rgb is not None and out.alpha is not None
    return out.rgb.double(), out.alpha.double()[..., None]


def fresnel_by_angles(cosine: np.ndarray, index: float) -> np.ndarray:
    """Fresnel's laws of sines and tangents, from air into an index > 1; unpolarised.

    Rs = (sin(i - t) / sin(i + t))^2 and Rp = (tan(i - t) / tan(i + t))^2, sin i = index sin t.
    """
    incident = np.arccos(np.clip(cosine, 0, 1))
    refracted = np.arcsin(np.sin(incident) / index)
    steep = incident < 1e-4  # both quotients are 0 / 0 at 0; the limit is right to 1e-8 here
    incident = np.where(steep, math.pi / 4, incident)
    less, more = incident - refracted, incident + refracted
    share = 0.5 * ((np.sin(less) / np.sin(more)) ** 2 + (np.tan(less) / np.tan(more)) ** 2)
    return np.where(steep, ((index - 1) / (index + 1)) ** 2, share)


def water_masks(
    scene: Scene, truth: StreetTruth, frames: Sequence[int], *, scale: float
) -> list[list[str | float]]:
    """By view: the share of its pixels whose mask of water is the true one; the same away from
    silhouettes, beyond which splats reach a little; and how many of the pixels those are.
    """
    rows: list[list[str | float]] = []
    recipe = flood_recipe("sky")
    medium = make_plan(recipe, scene).flood
    assert medium is not None
    for camera in (c.scaled(scale) for n in frames for c in scene.frame(n).cameras.values()):
        depth = plane_depth(camera, medium.level_z_m).numpy()
        true = np.isfinite(depth) & (truth.render(camera).depth > depth)
        same = draw_picture(scene, camera, recipe).water == true
        clear = inside(true) | inside(~true)
        shares = (same.mean(), same[clear].mean(), clear.mean())
        rows.append([f"{camera.name} at {camera.timestamp_ns} ns", *map(float, shares)])
    return rows


# ---- snow: placement, what it covers and should not, its height ----------------------------------
# The procedural street says what snow should lie on: points of its true surface from straight
# above. A point is open where the vertical ray from the sky meets it first, flat where the true
# surface is no steeper than the limit, seen where nothing stands between it and a camera. What
# drives or walks shelters nothing, nor does it hide anything.

SHADINGS = ("per_splat", "per_pixel")
ESTIMATORS: tuple[Estimator, ...] = get_args(Estimator)
DEPTHS_M = (0.02, 0.1, 0.4)
SKY_Z_M = 60.0  # above everything on the street
OVER_M = 0.2  # a cell farther above or below the true surface does not lie on it
RINGS_M = (0.0, 8.0, 16.0, 32.0)
LIFT_M = 1e-3  # of a point above its own surface, before it looks at a camera


def snow_tables(case: EffectCase, repeats: int) -> list[Table]:
    """Costs of either shading alone, with depth and labels, and in smog; and in a flood."""
    beside: dict[str, dict[str, Any]] = {
        "": {},
        ", depth and labels": {"output": Output()},
        ", smog": {"smog": Smog(visibility_m=200)},
    }
    flood = {"flood": Flood(level_m=0.15, reference="median")}
    cases = [(shading, *each) for each in beside.items() for shading in SHADINGS]
    costs = {
        shading + title: (
            snow_recipe(shading, cell_m=case.cell_m, **given),
            snow_recipe(None, **given),
        )
        for shading, title, given in [*cases, ("per_splat", ", flood", flood)]
    }
    tables = []
    for uri in case.scenes:
        tables.append(placement_table(uri, case, repeats))
        tables += cost_tables(case, uri, costs, SHADINGS, repeats)
    street, truth = case.open_street()
    reach_m, pixel_m = (16.0, 0.1) if case.cell_m >= 0.1 else (32.0, 0.05)
    found = snow_accuracy(street, truth, cell_m=case.cell_m, reach_m=reach_m, pixel_m=pixel_m)
    tables += snow_accuracy_tables(case.street, found)
    columns = ("other view", "points", "equal masks", "worst pair", "colour rms, 1/255")
    for shading in SHADINGS:
        rows = snow_masks(street, case.frames, case.scale / 2, shading, case.cell_m)
        tables.append(Table(f"Masks of two views, {shading}", columns, rows))
    return tables


def placement_table(uri: str, case: EffectCase, repeats: int) -> Table:
    """Seconds of finding where snow can lie for all cameras, and of snow laid on it."""
    scene = open_scene(uri)
    cameras = all_cameras(scene)
    settings = placement_settings(Snow(depth_m=0, cell_m=case.cell_m))
    support = place_snow_support(scene, cameras, settings)
    find = functools.partial(place_snow_support, scene, cameras, settings)
    stages = rounds({"all": find}, min(repeats, 3))
    depths_m = itertools.cycle((0.05, 0.1, 0.3))  # what was laid last does not help the next

    def lay(shading: str) -> object:
        snow = Snow.model_validate({"depth_m": next(depths_m), "shading": shading})
        return build_snow_layer(support, scene, snow, illumination_of(scene, snow), seed=0)

    laid = rounds({name: functools.partial(lay, name) for name in SHADINGS}, repeats)
    stages |= {f"another depth, {name}": seconds for name, seconds in laid.items()}
    mib = peak_mib_in_subprocess(_placement_of, (uri, case.cell_m)) if case.memory else None
    on_vehicles = sum(map(len, support.actors.values()))
    return Table(
        f"Placement: {uri}, {len(cameras)} cameras, cells of {case.cell_m:g} m",
        ("stage", "seconds", "least"),
        [[stage, float(np.median(each)), min(each)] for stage, each in stages.items()],
        f"{len(support.ground):,} cells, {on_vehicles:,} on {len(support.actors)} vehicles"
        + ("" if mib is None else f"; {mib:.0f} MiB above the scene"),
    )


def _placement_of(uri: str, cell_m: float) -> Action:
    scene = open_scene(uri)
    coarse, fine = (placement_settings(Snow(depth_m=0, cell_m=m)) for m in (10 * cell_m, cell_m))
    place_snow_support(scene, all_cameras(scene)[:1], coarse)  # loads the kernels
    return lambda: place_snow_support(scene, all_cameras(scene), fine)


def all_cameras(scene: Scene) -> list[Camera]:
    return [camera for frame in scene.frames for camera in frame.cameras.values()]


@dataclass(frozen=True, eq=False)
class TruePoints:
    """P places on a grid of the ground plan and the surface that is highest there.

    xy [P, 2], z [P]: world, metres. slope [P]: of the surface, radians. semantic [P]: its class.
    from_path_m [P]: level distance to the nearest camera. is_seen [P]: by a camera.
    """

    xy: np.ndarray
    z: np.ndarray
    slope: np.ndarray
    semantic: np.ndarray
    from_path_m: np.ndarray
    is_seen: np.ndarray

    def __len__(self) -> int:
        return len(self.z)

    def chosen(self, mask: np.ndarray) -> TruePoints:
        return TruePoints(*(getattr(self, f.name)[mask] for f in dataclasses.fields(self)))


def still(truth: StreetTruth) -> StreetTruth:
    """The street without what moves."""
    return StreetTruth(dataclasses.replace(truth.street, movers=()))


def camera_from_above(cameras: Sequence[Camera], *, reach_m: float, pixel_m: float) -> Camera:
    """An orthographic camera that looks down on all that is within reach_m of the cameras, in level
    distance along x and y; rows towards -y.
    """
    centres = np.stack([camera.centre.numpy()[:2] for camera in cameras])
    low, high = centres.min(0) - reach_m, centres.max(0) + reach_m
    width, height = (int(n) for n in np.ceil((high - low) / pixel_m))
    eye = torch.tensor([*((low + high) / 2), SKY_Z_M], dtype=torch.float64)
    rotation = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    pose, scale = rigid(rotation, -rotation @ eye), 1 / pixel_m
    return Camera(
        "from above", width, height, scale, scale, width / 2, height / 2, pose, is_orthographic=True
    )


def pixel_places(camera: Camera) -> np.ndarray:
    """x and y [H, W, 2] of the pixels of a camera from above."""
    centre = camera.centre.numpy()
    x = centre[0] + (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = centre[1] - (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    return np.stack(np.meshgrid(x, y), -1)


def pixels_of(camera: Camera, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of places [P, 2] in a camera from above."""
    off = (xy - camera.centre.numpy()[:2]) * [camera.fx, -camera.fy] + [camera.cx, camera.cy]
    columns, rows = np.floor(off).astype(np.int64).T
    return rows, columns


def surface_below(truth: StreetTruth, xy: np.ndarray) -> np.ndarray:
    """z [P] of the highest surface at xy [P, 2]; -infinity where there is none."""
    return SKY_Z_M - _drop(truth, xy).distance


def _drop(truth: StreetTruth, xy: np.ndarray) -> RayHits:
    origins = np.concatenate([xy, np.full((len(xy), 1), SKY_Z_M)], 1)
    down = np.broadcast_to([0.0, 0.0, -1.0], origins.shape)
    return truth.cast(origins, down, 0, with_rgb=False)


def true_points(
    truth: StreetTruth, cameras: Sequence[Camera], xy: np.ndarray, *, reach_m: float
) -> TruePoints:
    """The open points at xy [P, 2] within reach_m of the cameras' path. truth: `still`."""
    away = np.full(len(xy), np.inf)
    for centre in {tuple(camera.centre.numpy()[:2].round(1)) for camera in cameras}:
        np.minimum(away, np.hypot(*(xy - centre).T), out=away)
    hits = _drop(truth, xy)
    points = TruePoints(
        xy=xy,
        z=SKY_Z_M - hits.distance,
        slope=np.arccos(np.clip(hits.normal[:, 2], -1, 1)),
        semantic=hits.semantic,
        from_path_m=away,
        is_seen=np.zeros(len(xy), bool),
    )
    met = (away <= reach_m) & np.isfinite(hits.distance)
    points = points.chosen(met)
    return dataclasses.replace(points, is_seen=_seen(truth, cameras, points, hits.normal[met]))


def _seen(
    truth: StreetTruth, cameras: Sequence[Camera], points: TruePoints, normals: np.ndarray
) -> np.ndarray:
    """bool [P]: seen by one of the cameras, whatever its distance."""
    places = np.concatenate([points.xy, points.z[:, None]], 1) + LIFT_M * normals
    seen = np.zeros(len(points), bool)
    for camera in cameras:
        left = np.flatnonzero(~seen)
        pose, to_eye = camera.camera_from_world.numpy(), camera.centre.numpy() - places[left]
        x, y, z = (places[left] @ pose[:3, :3].T + pose[:3, 3]).T
        depth = np.maximum(z, 1e-9)
        u, v = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
        inside = (z > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        inside &= (to_eye * normals[left]).sum(1) > 0
        if inside.any():
            left, to_eye = left[inside], to_eye[inside]
            seen[left] = ~truth.street.static.tree.occluded(places[left], to_eye, 1.0)
    return seen


def snow_accuracy(
    scene: Scene,
    truth: StreetTruth,
    *,
    cell_m: float,
    reach_m: float,
    pixel_m: float,
    depths_m: Sequence[float] = DEPTHS_M,
    estimators: Sequence[Estimator] = ESTIMATORS,
) -> dict[str, Any]:
    """Figures of every estimator that placement can use. reach_m: level distance from the cameras
    within which points are taken. pixel_m: of the view from above; every second of its pixels along
    each axis is a point.
    """
    cameras, street = all_cameras(scene), still(truth)
    above = camera_from_above(cameras, reach_m=reach_m, pixel_m=pixel_m)
    points = true_points(
        street, cameras, pixel_places(above)[1::2, 1::2].reshape(-1, 2), reach_m=reach_m
    )
    max_slope = math.radians(PlacementSettings(cell_m=cell_m).max_slope_deg)
    flat = points.chosen(points.is_seen & (points.slope < max_slope))
    crown = flat.semantic == SemanticClass.VEGETATION
    bias = _scene_bias_m(scene, street, flat, above)
    found = []
    for estimator in estimators:
        settings = PlacementSettings(cell_m=cell_m, estimator=estimator)
        support = place_snow_support(scene, cameras, settings)
        covered = cells_over(support.ground, flat) >= 0
        rings = {}
        for low, high in itertools.pairwise(RINGS_M):
            own = (flat.from_path_m >= low) & (flat.from_path_m < high)
            rings[f"{low:g}-{high:g} m"] = float(covered[own].mean()) if own.any() else None
        found.append({
            "estimator": estimator,
            "covered": float(covered[~crown].mean()),
            "rings": rings,
            "error_m": height_error(support_heights(support.ground, flat) - flat.z),
            "depths": [_drawn(scene, support, street, flat, above, d, bias) for d in depths_m],
        })  # fmt: skip
    return {"points": len(flat), "scene_bias_m": bias, "estimators": found}


def snow_accuracy_tables(street: str, found: dict[str, Any]) -> list[Table]:
    """Lengths in cm, shares in %."""

    def hundredfold(values: Sequence[float | None]) -> list[float | None]:
        return [None if value is None else 100 * value for value in values]

    placed, drawn = [], []
    for each in found["estimators"]:
        shares = [each["covered"], *each["rings"].values(), *each["error_m"].values()]
        placed.append([each["estimator"], *hundredfold(shares)])
        for one in each["depths"]:
            shares = [one["depth_m"], one["covered"], one["sheltered"], *one["error_m"].values()]
            median = one["error_on_scene_m"]["median"]
            drawn.append([each["estimator"], *hundredfold([*shares, median])])
    rings = found["estimators"][0]["rings"]
    lengths = ("error cm", "p95", "bias")
    return [
        Table(
            f"Cells, %: {street}, {found['points']:,} points open to the sky, flat and seen",
            ("heights from", "covered", *rings, *lengths),
            placed,
        ),
        Table(
            "Snow as drawn from above, %",
            ("heights from", "depth cm", "covered", "sheltered", *lengths, "on the scene's own"),
            drawn,
            f"the scene's own surface is off by {100 * found['scene_bias_m']:+.1f} cm",
        ),
    ]


def cells_over(cells: SnowCells, points: TruePoints) -> np.ndarray:
    """int64 [P]: the cell over each point and close to its surface, -1 where there is none."""
    centers, sizes = cells.centers_m.numpy().astype(np.float64), cells.sizes_m.numpy()
    out = np.full(len(points), -1, np.int64)
    for size in np.unique(sizes):
        own = np.flatnonzero(sizes == size)
        low = centers[own, :2] - size / 2
        offset = low[0] % size  # cells of one size share a grid
        key = _keys(np.round((low - offset) / size).astype(np.int64))
        place = _keys(np.floor((points.xy - offset) / size).astype(np.int64))
        order = np.argsort(key)
        at = np.minimum(np.searchsorted(key[order], place), len(own) - 1)
        found = own[order[at]]
        met = key[order[at]] == place
        met &= np.abs(_heights(cells, found, points.xy) - points.z) <= OVER_M
        out[met] = found[met]
    return out


def _keys(columns_rows: np.ndarray) -> np.ndarray:
    return (columns_rows[:, 0] << 32) + columns_rows[:, 1]


def _heights(cells: SnowCells, which: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """z of cells' planes at places [P, 2]."""
    centers = cells.centers_m.numpy()[which].astype(np.float64)
    normals = cells.normals.numpy()[which].astype(np.float64)
    slopes = -normals[:, :2] / normals[:, 2:]
    return centers[:, 2] + (slopes * (xy - centers[:, :2])).sum(1)


def support_heights(cells: SnowCells, points: TruePoints) -> np.ndarray:
    """z [P] of the support under each point, NaN where it has none."""
    over = cells_over(cells, points)
    z, met = np.full(len(points), np.nan), over >= 0
    z[met] = _heights(cells, over[met], points.xy[met])
    return z


def height_error(off: np.ndarray) -> dict[str, float | None]:
    """Of height differences [P], NaN left out."""
    off = off[np.isfinite(off)]
    if len(off) == 0:
        return {"median": None, "p95": None, "bias": None}
    median, p95 = map(float, np.quantile(np.abs(off), [0.5, 0.95]))
    return {"median": median, "p95": p95, "bias": float(np.median(off))}


def _scene_bias_m(scene: Scene, truth: StreetTruth, points: TruePoints, above: Camera) -> float:
    """How far the scene's own Gaussians are above the true surface where the points are: median of
    the centres of those that are heaviest there. A fitted or sampled surface has such an offset,
    which no placement can know.
    """
    out = rasterize([PosedGaussians(scene.background)], above, buffers=BUFFERS, clip=UNCUT)
    assert out.splat_ids is not None
    ids = np.unique(out.splat_ids.numpy()[pixels_of(above, points.xy)])
    means = scene.background.means.numpy()[ids[ids >= 0]].astype(np.float64)
    off = means[:, 2] - surface_below(truth, means[:, :2])
    return float(np.median(off[np.abs(off) < OVER_M]))


def _drawn(
    scene: Scene,
    support: SnowSupport,
    truth: StreetTruth,
    flat: TruePoints,
    above: Camera,
    depth_m: float,
    scene_bias: float,
) -> dict[str, Any]:
    """The points that snow covers, seen from above; the share of it that is drawn beneath what is
    open to the sky; how far its surface is from the true one raised by its depth, and from that
    with the scene's own offset.
    """
    snow = Snow(depth_m=depth_m)
    layer = build_snow_layer(support, scene, snow, illumination_of(scene, snow), seed=0).ground
    without_snow = dataclasses.replace(scene.background, opacities=layer.opacities)
    parts = [PosedGaussians(without_snow), PosedGaussians(layer.gaussians, is_overlay=True)]
    settings = RasterSettings(sh_degree=0)
    out = rasterize(parts, above, buffers=BUFFERS, settings=settings, clip=UNCUT)
    assert out.mode_depth is not None and out.overlay is not None
    height = SKY_Z_M - out.mode_depth.to(torch.float64).numpy()
    shown = out.overlay.numpy() >= 0.5
    z, there = height[pixels_of(above, flat.xy)], shown[pixels_of(above, flat.xy)]
    on_it = there & (np.abs(z - depth_m - flat.z) <= OVER_M + 0.5 * depth_m)
    off = np.where(on_it, z - flat.z - depth_m, np.nan)
    step = max(1, int(shown.sum()) // 400_000)
    places, heights = pixel_places(above)[shown][::step], height[shown][::step]
    sunk = heights < surface_below(truth, places) - OVER_M
    return {
        "depth_m": depth_m,
        "covered": float(on_it[flat.semantic != SemanticClass.VEGETATION].mean()),
        "sheltered": float(sunk.mean()) if len(sunk) else 0.0,
        "error_m": height_error(off),
        "error_on_scene_m": height_error(off - scene_bias),
    }


def snow_masks(
    scene: Scene, frames: Sequence[int], scale: float, shading: str, cell_m: float
) -> list[list[Any]]:
    """Of neighbouring cameras, and of cameras a frame ahead, where their depths agree."""
    output = Output(depth="expected", labels=False)
    plan = make_plan(snow_recipe(shading, cell_m=cell_m, output=output), scene)

    def seen(camera: Camera) -> MaskedView:
        buffers = render_buffers(scene, camera, plan)
        depth, alpha = buffers.raster.expected_depth, buffers.raster.alpha
        assert depth is not None and alpha is not None and buffers.overlay is not None
        picture = buffers.rgb.clamp(0, 1).numpy()
        return MaskedView(
            DepthView(camera, picture, depth.numpy(), alpha.numpy()), buffers.overlay.numpy()
        )

    return mask_agreement(view_pairs(scene, frames, scale), seen)


# ---- style: maps of colours ---------------------------------------------------------------------

PHOTO_PX, HOLDOUT, PAIRS = 256, 8, 60


def style_tables(case: EffectCase, repeats: int) -> list[Table]:
    tables = [_fold_table(RasterCase(case.splats, 640, 480), repeats)]
    costs = {
        "one map": (style_recipe(), CLEAN),
        "a map a region": (style_recipe(per_region=True), CLEAN),  # a preset's are the same
        "on the picture": (style_recipe(applied_to="picture"), CLEAN),
        "one map, folded into SH": (style_recipe(evaluated="sh"), CLEAN),
    }
    for uri in case.scenes:
        tables += cost_tables(case, uri, costs, ("one map",), repeats)
        tables.append(_folded_error_table(uri, case))
    tables.append(_map_table(open_scene(case.street), repeats))
    return tables if case.photos is None else [*tables, _score_table(case.photos)]


def _fold_table(case: RasterCase, repeats: int) -> Table:
    """One map, and one for each class, folded into the SH of random Gaussians."""
    gaussians, _ = random_scene(case)
    classes = torch.arange(len(gaussians), dtype=torch.int16) % (max(SemanticClass) + 1)
    gaussians = dataclasses.replace(gaussians, semantic=classes)
    moved = 2 * gaussians.sh.numel() * gaussians.sh.element_size()
    map_34 = 0.9 * torch.eye(3, 4)  # colours stay finite however often they are mapped
    actions: dict[str, Action] = {}
    for name, count in (("one map", 1), ("a map a class", CLASSES)):
        maps = StyleMaps(map_34.repeat(count, 1, 1), map_34, map_34)
        for where, out in (("in place", gaussians.sh), ("new memory", None)):
            fold = functools.partial(style_gaussians, gaussians, maps, out=out)
            actions[f"{name}, {where}"] = fold
    rows = [
        [name, median_ms(each), min(each) * 1e3, moved / min(each) / 1e9]
        for name, each in rounds(actions, repeats).items()
    ]
    title = f"Maps folded into {len(gaussians):,} Gaussians, {moved / 1e6:.0f} MB read and written"
    return Table(title, ("map", "ms", "least", "GB/s at best"), rows)


def _folded_error_table(uri: str, case: EffectCase) -> Table:
    """Pictures of maps folded into SH against those of mapped colours. They differ where a splat
    with a colour below 0 is blended, which is clamped before the map if the map is not folded.
    """
    scene = open_scene(uri)
    camera, rows = front_camera(scene, case.width), []
    for preset in case.presets:
        folded, mapped = (
            render_buffers(
                scene, camera, make_plan(style_recipe(preset, evaluated=where), scene)
            ).rgb.numpy()
            for where in ("sh", "color")
        )
        off = 255 * np.abs(folded - mapped).max(-1)
        found = psnr(folded.clip(0, 1), mapped.clip(0, 1)) if off.any() else None
        rows.append([preset, found, float(off.max()), 100 * float((off > 1).mean())])
    columns = ("preset", "PSNR dB", "largest", "off by > 1/255, %")
    return Table(f"Maps folded into SH against mapped colours, 1/255: {uri}", columns, rows)


def _map_table(scene: Scene, repeats: int) -> Table:
    """From a style image's file to the map, and what the scene's side takes once."""
    net, rgb = load_network(None), render_buffers(
        scene, front_camera(scene, 1920), make_plan(CLEAN, scene)
    ).rgb  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "style.jpg"
        cv2.imwrite(str(path), quantise(rgb * torch.tensor([1.0, 0.8, 0.6]))[..., ::-1])
        image = read_style_image(path)
        reading = rounds({"reading the image": lambda: read_style_image(path)}, repeats)
    content, pictures = content_statistics(scene, per_region=True), content_pictures(scene)

    def closed(method: Any, per_region: bool = False) -> object:
        style = image_statistics(image)
        return closed_maps(content, style, method=method, strength=1.0, per_region=per_region)

    def once(find: Callable[..., object], **options: bool) -> object:
        return find(dataclasses.replace(scene), **options)  # of a scene that remembers nothing

    actions: dict[str, Action] = {
        "mkl": lambda: closed("mkl"),
        "mkl, per region": lambda: closed("mkl", per_region=True),
        "reinhard": lambda: closed("reinhard"),
        f"gscm, with {len(pictures)} pictures of the scene": lambda: gscm_map(
            net, pictures, pictures[:1].flip(3)
        ),
        "once a scene: statistics": lambda: once(content_statistics, per_region=False),
        "once a scene: of regions": lambda: once(content_statistics, per_region=True),
        "once a scene: pictures": lambda: once(content_pictures),
    }
    seconds = reading | rounds(actions, repeats)
    rows = [[name, median_ms(each), 1e3 * min(each)] for name, each in seconds.items()]
    return Table("From a style image to its map", ("what", "ms", "least"), rows)


def _score_table(photos: Path) -> Table:
    """How well methods do on photographs that the network was not trained on."""
    about = network_facts().get("about") or {}
    names = tuple(f"/{name}" for name in about.get("data", {}).get("held_out", ()))
    held_out = [file for file in sorted(photos.rglob("*")) if file.as_posix().endswith(names)]
    squares = (
        read_photos(held_out, PHOTO_PX, holdout=0).train
        if held_out
        else read_photos([photos], PHOTO_PX, holdout=HOLDOUT).held_out
    )
    pictures = squares.float() / 255
    methods = {
        "none": closed_method("mkl", 0.0),
        "reinhard": closed_method("reinhard"),
        "mkl": closed_method("mkl"),
        "mkl, half": closed_method("mkl", 0.5),
        "gscm": network_method(load_network(None)),
    }
    rows = []
    for name, method in methods.items():
        scores = dataclasses.astuple(score_pairs(method, pictures, repeats=1))
        rows.append([name, *scores, oversaturated_share(method, pictures, pairs=PAIRS)])
    columns = ("method", "same", "half", "below", "look", "oversaturated")
    return Table(f"Methods on {len(pictures)} photos that are held out, PSNR in dB", columns, rows)


EFFECTS: dict[str, Callable[[EffectCase, int], list[Table]]] = {
    "smog": smog_tables,
    "flood": flood_tables,
    "snow": snow_tables,
    "style": style_tables,
}
