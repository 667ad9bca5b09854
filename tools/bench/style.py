"""Styles: what they cost, how exact maps in SH are, how well methods do on photographs, and whether
views of a styled scene agree as those of the clean one do.

Colours are clamped to >= 0 before they are blended. Mapped as evaluated colours, a splat's colour
is clamped before the map and after it; mapped in its SH, after it alone. So pictures differ only in
"touched" pixels: where a splat with a colour below 0, as this camera sees it, is blended.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from adapters.base import open_scene
from augment.cameras import Camera
from augment.effects.style.color_maps import CLASSES, StyleMaps, style_gaussians, styled_scene
from augment.effects.style.content import content_pictures, content_statistics
from augment.effects.style.images import image_statistics, read_style_image
from augment.effects.style.network import (
    Gscm,
    apply_map,
    compose,
    gscm_map,
    load_network,
    network_facts,
)
from augment.effects.style.scores import (
    Method,
    closed_method,
    network_method,
    oversaturated_share,
    score_pairs,
)
from augment.effects.style.statistics import closed_maps
from augment.effects.style.style import style_maps
from augment.effects.style.train import read_photos
from augment.metrics.consistency import Consistency, warped_consistency
from augment.plan import make_plan
from augment.render.composite import quantise
from augment.render.rasterize import rasterize
from augment.render.sh import SH_C0, evaluate_sh
from augment.scene import Gaussians, PosedGaussians, Scene
from augment.semantics import SemanticClass
from augment.views import render_buffers
from recipes.schema import Output, Recipe, Render
from recipes.weather import Style, style_preset_names
from tools.bench.effects import (
    CLEAN,
    NEXT_CAMERA,
    QUICK,
    WHOLE,
    EffectCase,
    cost_tables,
    rendered_view,
    view_pairs,
)
from tools.bench.harness import Action, Figures, Table, figures, machine_facts, median_ms, rounds
from tools.bench.scenes import RasterCase, front_camera, random_scene, style_recipe

WHOLE_STYLE = dataclasses.replace(
    WHOLE, street="procedural:street?seed=0&frames=10", frames=(0, 1, 2)
)
QUICK_STYLE = dataclasses.replace(
    QUICK, street="procedural:street?seed=0&frames=8&gaussians=120000"
)
PRESETS, QUICK_PRESETS = style_preset_names(), ("overcast", "golden-hour")
KINDS = ("1 ahead", "7 ahead", NEXT_CAMERA)  # frames apart, as Lai et al. 2018 and successors
VIEWS_PX, PHOTO_PX, HOLDOUT = 480, 256, 8
VISIBLE = 1 / 255
BAND_SPREAD = 0.06  # standard deviation of the coefficients that give a scene directions
MIN_SHARE = 0.01  # of a view that another shows; of less there is nothing to say


def bench_style(
    quick: bool = False,
    *,
    case: EffectCase | None = None,
    scene_uri: str | None = None,
    photos: Path | None = None,
    repeats: int = 7,
    memory: bool = True,
) -> Figures:
    """scene_uri: a scene whose cost, exactness and views are measured beside the street's. photos:
    a folder of photographs; those that the network was not trained on are scored on.
    """
    machine, case = machine_facts(), case or (QUICK_STYLE if quick else WHOLE_STYLE)
    presets = QUICK_PRESETS if quick else PRESETS
    network = load_network(None)
    tables = [apply_table(RasterCase(200_000 if quick else 1_000_000, 640, 480), repeats)]
    costs = {
        "one map": (style_recipe(), CLEAN),
        "a map a region": (style_recipe(per_region=True), CLEAN),  # a preset's are the same
        "on the picture": (style_recipe(applied_to="picture"), CLEAN),
        "one map, folded into SH": (style_recipe(evaluated="sh"), CLEAN),
    }
    uris = (case.scene, *([scene_uri] if scene_uri else []))
    for uri in uris:
        own = dataclasses.replace(case, scene=uri)
        tables += cost_tables(own, costs, ("one map",), repeats=repeats, memory=memory)
        scene = open_scene(uri)
        tables.append(exact_table(uri, scene, front_camera(scene, case.width), presets))
    street = open_scene(case.street)
    tables.append(map_table(street, network, repeats))
    if photos is not None:
        tables.append(score_table(network, photos, pairs=60))
    for uri in (case.street, *uris[1:]):
        tables.append(view_table(uri, open_scene(uri), case.frames, presets))
    return figures("style", tables, machine=machine, folding_error=folding_error(network))


# ---- maps ---------------------------------------------------------------------------------------


def apply_table(case: RasterCase, repeats: int) -> Table:
    """One map, and one for each class, on the SH of random Gaussians."""
    gaussians, _ = random_scene(case)
    classes = torch.arange(len(gaussians), dtype=torch.int16) % (max(SemanticClass) + 1)
    gaussians = dataclasses.replace(gaussians, semantic=classes)
    moved = 2 * gaussians.sh.numel() * gaussians.sh.element_size()
    actions: dict[str, Action] = {
        f"{name}, {where}": functools.partial(style_gaussians, gaussians, some_maps(count), out=out)
        for name, count in (("one map", 1), ("a map a class", CLASSES))
        for where, out in (("in place", gaussians.sh), ("new memory", None))
    }
    rows = [
        [name, median_ms(each), min(each) * 1e3, moved / min(each) / 1e9]
        for name, each in rounds(actions, repeats).items()
    ]
    title = f"Maps folded into {len(gaussians):,} Gaussians, {moved / 1e6:.0f} MB read and written"
    return Table(title, ("map", "ms", "least", "GB/s at best"), rows)


def some_maps(count: int) -> StyleMaps:
    """Gains about 0.9, so that colours stay finite however often they are mapped."""
    maps = 0.9 * torch.eye(3, 4).repeat(count, 1, 1)
    maps[:, :, 3] = 0.05
    maps[:, 0, 1] = torch.linspace(-0.05, 0.05, count)
    return StyleMaps(maps, maps[0], maps[0])


def folding_error(net: Gscm) -> float:
    """Largest difference of random colours in [0, 1] mapped factor by factor and by the folded map,
    between pairs of noise pictures of different colours.
    """
    generator = torch.Generator().manual_seed(0)
    pictures = torch.rand((4, 3, net.size, net.size), generator=generator)
    pictures = pictures * torch.rand((4, 3, 1, 1), generator=generator)
    colors = torch.rand((2, 4096, 3), generator=generator)
    with torch.no_grad():
        f_c, f_s = net.encode(pictures)
        f_c, f_s = f_c[:2], f_s[2:]
        factors = net.apply_factors(f_c, f_s, colors)
        folded = apply_map(compose(net.style_map(f_s), net.content_map(f_c)), colors)
    return float((factors - folded).abs().max())


def exact_table(uri: str, scene: Scene, camera: Camera, presets: Sequence[str]) -> Table:
    """Colours mapped in SH against mapped colours: of the scene as it is, and with SH 3 where its
    colours depend on no direction.
    """
    degree = max(part.sh_degree for part in scene.all_gaussians)
    kinds = {f"SH {degree}": scene} | ({} if degree else {"SH 3": with_directions(scene)})
    rows: list[list[Any]] = []
    for kind, each in kinds.items():
        touched = clamped_pixels(each, camera)
        for preset in presets:
            off = map_error(each, camera, preset)
            worst = [255 * float(each.max(initial=0)) for each in (off, off[~touched])]
            shares = 100 * float(touched.mean()), 100 * float((off > VISIBLE).mean())
            rows.append([kind, preset, shares[0], *worst, shares[1]])
    columns = ("colours", "preset", "touched %", "largest", "elsewhere", "off by > 1/255, %")
    return Table(f"Maps in SH against mapped colours, 1/255: {uri}", columns, rows)


def map_error(scene: Scene, camera: Camera, preset: str) -> np.ndarray:
    """Largest channel difference [H, W] of colours mapped in SH and of mapped colours."""
    clean, fused = make_plan(CLEAN, scene), make_plan(style_recipe(preset), scene)
    in_sh = styled_scene(scene, style_maps(scene, Style(preset=preset)))
    off = render_buffers(scene, camera, fused).rgb - render_buffers(in_sh, camera, clean).rgb
    return off.abs().amax(2).numpy()


def clamped_pixels(scene: Scene, camera: Camera) -> np.ndarray:
    """bool [H, W]: where a splat with a colour below 0, before any map, is blended."""

    def marked(part: PosedGaussians) -> PosedGaussians:
        eye = camera.centre.double()
        if part.world_from_part is not None:
            to_part = torch.linalg.inv(part.world_from_part)
            eye = to_part[:3, :3] @ eye + to_part[:3, 3]
        away = torch.nn.functional.normalize(part.gaussians.means - eye.float(), dim=1)
        below = (evaluate_sh(part.gaussians.sh, away) + 0.5 < 0).any(1)
        # White, or far below black, so that rounding shows nothing of it.
        sh = torch.where(below, 0.5 / SH_C0, -1 / SH_C0)[:, None, None].expand(-1, 1, 3)
        gaussians = dataclasses.replace(part.gaussians, sh=sh.contiguous())
        return dataclasses.replace(part, gaussians=gaussians)

    seen = rasterize([marked(part) for part in scene.parts_for(camera)], camera)
    assert seen.rgb is not None
    return seen.rgb[..., 0].numpy() > 0


def with_directions(scene: Scene) -> Scene:
    """The scene with SH of degree 3, the bands above its own random and the same every time."""
    rng = np.random.default_rng(0)

    def widened(gaussians: Gaussians) -> Gaussians:
        own = gaussians.sh
        sh = rng.normal(0, BAND_SPREAD, (len(own), 16, 3)).astype(np.float32)
        sh[:, : own.shape[1]] = own.numpy()
        return dataclasses.replace(gaussians, sh=torch.from_numpy(sh))

    return scene.with_gaussians(widened)


def map_table(scene: Scene, net: Gscm, repeats: int) -> Table:
    """From a style image's file to the map, and what the scene's side takes once."""
    camera = front_camera(scene, 1920)
    rgb = render_buffers(scene, camera, make_plan(CLEAN, scene)).rgb
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


def score_table(net: Gscm, photos: Path, *, pairs: int) -> Table:
    """How well methods do on photographs (augment.effects.style.scores)."""
    about = network_facts().get("about") or {}
    names = tuple(f"/{name}" for name in about.get("data", {}).get("held_out", ()))
    held_out = [file for file in sorted(photos.rglob("*")) if file.as_posix().endswith(names)]
    squares = (
        read_photos(held_out, PHOTO_PX, holdout=0).train
        if held_out
        else read_photos([photos], PHOTO_PX, holdout=HOLDOUT).held_out
    )
    pictures = squares.float() / 255
    methods: dict[str, Method] = {
        "none": closed_method("mkl", 0.0),
        "reinhard": closed_method("reinhard"),
        "mkl": closed_method("mkl"),
        "mkl, half": closed_method("mkl", 0.5),
        "gscm": network_method(net),
    }
    rows = []
    for name, method in methods.items():
        good = score_pairs(method, pictures, repeats=1)
        harm = oversaturated_share(method, pictures, pairs=pairs)
        rows.append([name, *dataclasses.astuple(good), harm])
    return Table(
        f"Methods on {len(pictures)} photos that are held out, PSNR in dB",
        ("method", "same", "half", "below", "look", "oversaturated"),
        rows,
    )


# ---- views --------------------------------------------------------------------------------------


def view_table(uri: str, scene: Scene, frames: Sequence[int], presets: Sequence[str]) -> Table:
    """Errors of views warped into others (augment.metrics.consistency), by kind of pairs: in 1/255,
    and relative to the picture's own spread. Cameras show the scene's own colours, or what is
    measured would be how their exposures differ.
    """
    known = [frame.index for frame in scene.frames if frame.index in frames] or [0]
    front = front_camera(scene)
    pairs = list(
        view_pairs(scene, known, VIEWS_PX / front.width, ahead=(1, 7), names=(front.name,))
    )
    output, render = Output(depth="expected", labels=False), Render(exposure="neutral")
    rows: list[list[Any]] = []
    for name in ("clean", *presets):
        style = None if name == "clean" else Style(preset=name)
        recipe = Recipe(style=style, output=output, render=render)
        view = functools.cache(lambda camera, r=recipe: rendered_view(scene, camera, r)[0])
        cells: list[Any] = [name]
        for kind in KINDS:
            each = [warped_consistency(view(a), view(b)) for k, a, b in pairs if k == kind]
            rmse, relative = pooled([one for one in each if one.share >= MIN_SHARE])
            cells += [None if rmse is None else 255 * rmse, relative]
        rows.append(cells)
    columns = [column for kind in KINDS for column in (kind, "relative")]
    return Table(f"Error of a view warped into another: {uri}", ("style", *columns), rows)


def pooled(seen: Sequence[Consistency]) -> tuple[float | None, float | None]:
    """RMSE and its ratio to the spread, over pairs by how many pixels count."""
    squares = sum(each.share * each.rmse**2 for each in seen)
    spread = sum(each.share * each.spread**2 for each in seen)
    if not spread > 0:
        return None, None
    return math.sqrt(squares / sum(each.share for each in seen)), math.sqrt(squares / spread)
