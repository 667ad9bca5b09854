"""Floods: what they cost, how far pictures are from what they should be, and masks of water.

Still, opaque water under the mirrored tier is compared with a picture made without the flood's own
mirror: the Gaussians themselves are mirrored. Other tiers are compared with the mirrored one. Which
pixels show water first is known on the procedural street by casting rays.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from adapters.procedural import StreetTruth
from augment.cameras import Camera
from augment.effects.flood.water_plane import plane_depth
from augment.metrics.image import psnr
from augment.plan import Plan, make_plan
from augment.render.buffers import ALPHA, RGB
from augment.render.layout import ABOVE, BELOW, HeightClip
from augment.render.rasterize import rasterize
from augment.scene import Gaussians, PosedGaussians, Scene
from augment.views import render_buffers
from recipes.schema import Output, Recipe
from tools.bench.effects import (
    CLEAN,
    QUICK,
    WHOLE,
    Cases,
    EffectCase,
    MaskedView,
    cost_tables,
    mask_agreement,
    plain_view,
    view_pairs,
)
from tools.bench.harness import Figures, Table, figures, machine_facts
from tools.bench.scenes import flood_recipe

TIERS, WAVES = ("sky", "screen_space", "mirrored"), ("still", "calm")
OPAQUE = {"absorption_per_m": (1e6, 1e6, 1e6)}
EDGE_PX = 3  # pixels this close to the water's border show two surfaces; splats overhang as far
DARK, LIT = 2 / 255, 8 / 255  # a black pixel, and what it is compared with when it should not be
BLOCK = 32
REACH_M = 80.0  # farther out a pixel is metres long and shows many things at once
FAR_BELOW_M = -100.0
MIRROR = torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0], dtype=torch.float64))


def bench_flood(
    quick: bool = False,
    *,
    case: EffectCase | None = None,
    scene_uri: str | None = None,
    repeats: int = 7,
    memory: bool = True,
) -> Figures:
    """scene_uri: another scene for the cost."""
    machine, case = machine_facts(), case or (QUICK if quick else WHOLE)
    costs = dataclasses.replace(case, scene=scene_uri or case.scene)
    staged = [f"{tier}, calm" for tier in TIERS]
    tables = cost_tables(costs, cost_cases(), staged, repeats=repeats, memory=memory)
    street, truth = case.open_street()
    views = case.views(street)
    rows: list[Any] = []
    for camera in views:
        name = f"{camera.name} at {camera.timestamp_ns} ns"
        exact = analytic_error(street, camera)
        rows.append(
            [name, "mirrored against mirrored splats", exact["psnr_db"], exact["p99"], *3 * [None]]
        )
        for tier in TIERS[:2]:
            for waves in WAVES:
                error = tier_error(street, camera, tier, waves)
                values = [error[key] for key in ("psnr_db", "p99", "black_share", "worst_block")]
                rows.append(
                    [name, f"{tier}, {waves}, against mirrored", *values, error["worst_at"]]
                )
    columns = ("view", "picture", "PSNR dB", "p99", "black", f"worst {BLOCK}x{BLOCK}", "at")
    title = f"Errors inside the water, channels in 1/255: {case.street}"
    tables.append(Table(title, columns, rows))
    masks = water_masks(street, truth, case.frames, scale=case.scale / 2)
    return figures("flood", [*tables, *masks], machine=machine)


def cost_cases() -> Cases:
    """Every tier still and with waves, as pictures only; Schlick's formula; depth and labels as by
    default; and water below everything.
    """
    default = Output()
    cases = {f"{t}, {w}": (flood_recipe(t, w), CLEAN) for t in TIERS for w in WAVES}
    cases["mirrored, calm, schlick"] = flood_recipe("mirrored", "calm", fresnel="schlick"), CLEAN
    for tier in TIERS:
        recipe = flood_recipe(tier, "calm", output=default)
        cases[f"{tier}, calm, depth and labels"] = recipe, Recipe(output=default)
    return cases | {"level below everything": (flood_recipe(level_m=FAR_BELOW_M), CLEAN)}


# ---- pictures -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Picture:
    """rgb [H, W, 3] in [0, 1]. water [H, W]: where the view shows it first."""

    rgb: np.ndarray
    water: np.ndarray


def draw(scene: Scene, camera: Camera, recipe: Recipe) -> Picture:
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
    picture = draw(scene, camera, recipe)
    truth = mirrored_picture(scene, camera, make_plan(recipe, scene)).clamp(0, 1).numpy()
    return {
        **compare(picture, Picture(truth, picture.water)),
        "water_share": float(picture.water.mean()),
        "psnr_with_edges_db": psnr(picture.rgb, truth, picture.water),
        "outside_psnr_db": psnr(picture.rgb, truth, inside(~picture.water)),
    }


def tier_error(scene: Scene, camera: Camera, reflection: str, waves: str) -> dict[str, Any]:
    """A tier against the mirrored one under the same waves, inside the water."""
    tiers = (draw(scene, camera, flood_recipe(tier, waves)) for tier in (reflection, "mirrored"))
    return compare(*tiers)


def compare(picture: Picture, truth: Picture) -> dict[str, Any]:
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


# ---- what still water reflects: a second scene below the plane, upside down ----------------------


def mirror_gaussians(gaussians: Gaussians) -> Gaussians:
    """The Gaussians mirrored in their frame's plane z = 0.

    With M = diag(1, 1, -1) the axes R become M R M, a rotation again, since an ellipsoid does not
    change when one of its axes is turned round; its axis vector is -M v. The colour seen along d
    was that along M d: the function of band l and order m has the parity (-1)^(l + m) in z.
    """
    parity = [
        (-1.0) ** (band + order)
        for band in range(gaussians.sh_degree + 1)
        for order in range(-band, band + 1)
    ]
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
    front, cover = _layer(parts, camera, plan, HeightClip(level_z_m, ABOVE))
    rgb, alpha = _layer(below, camera, plan, HeightClip(level_z_m, BELOW, overlaps=True))
    rays = camera.ray_directions(torch.float64)
    reflected = (
        rgb + (1 - alpha) * scene.sky.sample((rays * MIRROR.diagonal()[:3]).float()).double()
    )
    cosine = (-rays[..., 2] / rays.norm(dim=-1)).clamp(0, 1).numpy()
    share = torch.from_numpy(fresnel_by_angles(cosine, medium.refraction_index))[..., None]
    water = share * reflected + (1 - share) * torch.tensor(medium.rgb, dtype=torch.float64)
    behind = torch.where(rays[..., 2:] < 0, water, scene.sky.sample(rays.float()).double())
    return (front + (1 - cover) * behind).float()


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


# ---- masks --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class WaterView:
    """One camera's mask and the truth. drawn, true [H, W]: water is first. depth [H, W]: z of the
    plane, infinite where the ray does not meet it.
    """

    camera: Camera
    drawn: np.ndarray
    true: np.ndarray
    depth: np.ndarray

    @property
    def clear(self) -> np.ndarray:
        """bool [H, W]: away from silhouettes, beyond which splats reach a little."""
        return inside(self.true) | inside(~self.true)


def water_view(scene: Scene, truth: StreetTruth, camera: Camera, recipe: Recipe) -> WaterView:
    medium = make_plan(recipe, scene).flood
    assert medium is not None
    depth = plane_depth(camera, medium.level_z_m).numpy()
    true = np.isfinite(depth) & (truth.render(camera).depth > depth)
    return WaterView(camera, draw(scene, camera, recipe).water, true, depth)


def mask_error(view: WaterView) -> dict[str, float]:
    """Share of a view's pixels whose mask is the true one, and of those away from silhouettes."""
    same, clear = view.drawn == view.true, view.clear
    return {
        "agreeing": float(same.mean()),
        "agreeing_off_silhouettes": float(same[clear].mean()),
        "clear_share": float(clear.mean()),
    }


def water_masks(
    scene: Scene, truth: StreetTruth, frames: Sequence[int], *, scale: float
) -> list[Table]:
    """Masks of every camera against the truth. Of points of the plane that two views of one moment
    truly see, away from silhouettes: the share that both masks show as water.
    """
    views: dict[Camera, WaterView] = {}

    def seen(camera: Camera) -> MaskedView:
        view = views[camera] = water_view(scene, truth, camera, flood_recipe("sky"))
        near = inside(view.true) & (view.depth <= REACH_M)
        depth = np.where(np.isfinite(view.depth), view.depth, 0.0)
        return MaskedView(plain_view(camera, depth, near), view.drawn)

    pairs = list(view_pairs(scene, frames, scale, names=("front",)))
    agreement = [row[:4] for row in mask_agreement(pairs, seen)]
    errors = [
        [f"{camera.name} at {camera.timestamp_ns} ns", *mask_error(view).values()]
        for camera, view in views.items()
    ]
    return [
        Table(
            "Masks of water against the truth: shares of pixels",
            ("view", "agreeing", "away from silhouettes", "which are"),
            errors,
        ),
        Table(
            "Masks of two views, where both truly see the water",
            ("other view", "points", "agreeing", "worst pair"),
            agreement,
        ),
    ]
