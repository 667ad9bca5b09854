"""Snow: what it costs, what finding its place costs, what it covers and should not, its height, and
whether views agree on it.

The procedural street says what snow should lie on: points of its true surface from straight above.
A point is open where the vertical ray from the sky meets it first, flat where the true surface is
no steeper than the limit, seen where nothing stands between it and a camera. What drives or walks
shelters nothing, nor does it hide anything.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
import torch

from adapters.base import open_scene
from adapters.procedural import RayHits, StreetTruth
from augment.cameras import Camera
from augment.effects.snow.cells import SnowCells, SnowSupport
from augment.effects.snow.height_map import Estimator
from augment.effects.snow.layer import build_snow_layer
from augment.effects.snow.light import illumination_of
from augment.effects.snow.placement import PlacementSettings, place_snow_support
from augment.effects.snow.snow import placement_settings
from augment.effects.snow.surface import DRIVEN_MAX_SLOPE_DEG, moves
from augment.geometry import rigid
from augment.render.buffers import BUFFERS
from augment.render.constants import RasterSettings
from augment.render.layout import UNCUT
from augment.render.rasterize import rasterize
from augment.scene import PosedGaussians, Scene
from augment.semantics import SemanticClass
from recipes.schema import Output, Recipe, Smog, Weather
from recipes.weather import Flood, Snow
from tools.bench.effects import (
    QUICK,
    WHOLE,
    Cases,
    EffectCase,
    MaskedView,
    cost_tables,
    mask_agreement,
    rendered_view,
    view_pairs,
)
from tools.bench.harness import (
    Action,
    Figures,
    Table,
    figures,
    machine_facts,
    peak_mib_in_subprocess,
    rounds,
)
from tools.bench.scenes import PICTURE_ONLY, snow_recipe

SHADINGS = ("per_splat", "per_pixel")
ESTIMATORS: tuple[Estimator, ...] = get_args(Estimator)
DEPTHS_M = (0.02, 0.1, 0.4)
SKY_Z_M = 60.0  # above everything on the street
OVER_M = 0.2  # a cell farther above or below the true surface does not lie on it
RINGS_M = (0.0, 8.0, 16.0, 32.0)
EDGE_M, STEP_M = 0.2, 0.1  # a point is at an edge if this near to it the surface is that far off
PATCH_M = 0.03  # between points on a car
LIFT_M = 1e-3  # of a point above its own surface, before it looks at a camera


def bench_snow(
    quick: bool = False,
    *,
    case: EffectCase | None = None,
    scene_uri: str | None = None,
    repeats: int = 7,
    memory: bool = True,
) -> Figures:
    """scene_uri: a scene whose placement and cost are measured beside the procedural street's."""
    machine, case = machine_facts(), case or (QUICK if quick else WHOLE)
    tables = []
    for uri in (case.scene, *([scene_uri] if scene_uri else [])):
        costs = dataclasses.replace(case, scene=uri)
        tables.append(placement_table(costs, repeats=repeats, memory=memory))
        tables += cost_tables(
            costs, cost_cases(case.cell_m), SHADINGS, repeats=repeats, memory=memory
        )
    street, truth = case.open_street()
    reach_m, pixel_m = (16.0, 0.1) if case.cell_m >= 0.1 else (32.0, 0.05)
    found = accuracy(street, truth, cell_m=case.cell_m, reach_m=reach_m, pixel_m=pixel_m)
    tables += accuracy_tables(case.street, found)
    for shading in SHADINGS:
        rows = snow_masks(street, case.frames, case.scale / 2, shading, case.cell_m)
        columns = ("other view", "points", "equal masks", "worst pair", "colour rms, 1/255")
        tables.append(Table(f"Masks of two views, {shading}", columns, rows))
    return figures("snow", tables, machine=machine)


def cost_cases(cell_m: float) -> Cases:
    """Either shading alone, with depth and labels, and in smog; and in a flood."""
    beside: dict[str, dict[str, Any]] = {
        "": {},
        ", depth and labels": {"output": Output()},
        ", smog": {"smog": Smog(visibility_m=200)},
    }
    flood = {"flood": Flood(level_m=0.15, reference="median")}
    cases = [(shading, *each) for each in beside.items() for shading in SHADINGS]
    return {
        shading + title: (snow_recipe(shading, cell_m=cell_m, **given), _without_snow(**given))
        for shading, title, given in [*cases, ("per_splat", ", flood", flood)]
    }


def _without_snow(output: Output = PICTURE_ONLY, **weather: Any) -> Recipe:
    return Recipe(weather=Weather(**weather), output=output)


# ---- placement ----------------------------------------------------------------------------------


def placement_table(case: EffectCase, *, repeats: int, memory: bool) -> Table:
    """Seconds of finding where snow can lie for all cameras, by stage, and of snow laid on it."""
    scene = open_scene(case.scene)
    cameras = all_cameras(scene)
    settings = placement_settings(Snow(depth_m=0, cell_m=case.cell_m))
    beds = [place_snow_support(scene, cameras, settings) for _ in range(1 + min(repeats, 3))]
    stages = {stage: [bed.seconds[stage] for bed in beds[1:]] for stage in beds[0].seconds}
    depths_m = itertools.cycle((0.05, 0.1, 0.3))  # what was laid last does not help the next

    def lay(shading: str) -> object:
        snow = Snow.model_validate({"depth_m": next(depths_m), "shading": shading})
        return build_snow_layer(beds[0], scene, snow, illumination_of(scene, snow), seed=0)

    laid = rounds({name: functools.partial(lay, name) for name in SHADINGS}, repeats)
    stages |= {f"another depth, {name}": seconds for name, seconds in laid.items()}
    mib = peak_mib_in_subprocess(_placement, (case.scene, case.cell_m)) if memory else None
    bed, on_vehicles = beds[0], sum(map(len, beds[0].actors.values()))
    return Table(
        f"Placement: {case.scene}, {len(cameras)} cameras, cells of {case.cell_m:g} m",
        ("stage", "seconds", "least"),
        [[stage, float(np.median(each)), min(each)] for stage, each in stages.items()],
        f"{len(bed.ground):,} cells, {on_vehicles:,} on {len(bed.actors)} vehicles"
        + ("" if mib is None else f"; {mib:.0f} MiB above the scene"),
    )


def _placement(uri: str, cell_m: float) -> Action:
    scene = open_scene(uri)
    coarse, fine = (placement_settings(Snow(depth_m=0, cell_m=m)) for m in (10 * cell_m, cell_m))
    place_snow_support(scene, all_cameras(scene)[:1], coarse)  # loads the kernels
    return lambda: place_snow_support(scene, all_cameras(scene), fine)


def all_cameras(scene: Scene) -> list[Camera]:
    return [camera for frame in scene.frames for camera in frame.cameras.values()]


# ---- the true surface from above ----------------------------------------------------------------


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


def _drop(truth: StreetTruth, xy: np.ndarray) -> RayHits:
    origins = np.concatenate([xy, np.full((len(xy), 1), SKY_Z_M)], 1)
    down = np.broadcast_to([0.0, 0.0, -1.0], origins.shape)
    return truth.cast(origins, down, 0, with_rgb=False)


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


# ---- what snow lies on, against it --------------------------------------------------------------


def accuracy(
    scene: Scene,
    truth: StreetTruth,
    *,
    cell_m: float,
    reach_m: float,
    pixel_m: float,
    every: int = 2,
    depths_m: Sequence[float] = DEPTHS_M,
    estimators: Sequence[Estimator] = ESTIMATORS,
) -> dict[str, Any]:
    """Figures of every estimator that placement can use. reach_m: level distance from the cameras
    within which points are taken. pixel_m: of the view from above; points are every so many of its
    pixels along each axis.
    """
    cameras, street = all_cameras(scene), still(truth)
    above = camera_from_above(cameras, reach_m=reach_m, pixel_m=pixel_m)
    xy = pixel_places(above)[every // 2 :: every, every // 2 :: every].reshape(-1, 2)
    points = true_points(street, cameras, xy, reach_m=reach_m)
    max_slope = math.radians(PlacementSettings(cell_m=cell_m).max_slope_deg)
    flat = points.chosen(points.is_seen & (points.slope < max_slope))
    crown = flat.semantic == SemanticClass.VEGETATION
    inner = ~at_edges(street, flat) & ~crown
    scene_bias = _scene_bias_m(scene, street, flat, above)
    found = []
    for estimator in estimators:
        settings = PlacementSettings(cell_m=cell_m, estimator=estimator)
        bed = place_snow_support(scene, cameras, settings)
        covered = cells_over(bed.ground, flat) >= 0
        rings = {}
        for low, high in itertools.pairwise(RINGS_M):
            own = (flat.from_path_m >= low) & (flat.from_path_m < high)
            rings[f"{low:g}-{high:g} m"] = float(covered[own].mean()) if own.any() else None
        found.append({
            "estimator": estimator,
            "covered": float(covered[~crown].mean()),
            "covered_off_edges": float(covered[inner].mean()),
            "rings": rings,
            **sheltered_share(bed.ground, street, points),
            "vehicles": _vehicle_shares(bed, scene, truth),
            "bed_error_m": height_error(bed_heights(bed.ground, flat) - flat.z),
            "depths": [
                _drawn(scene, bed, street, flat, above, depth_m, scene_bias)
                for depth_m in depths_m
            ],
        })  # fmt: skip
    return {"points": len(flat), "scene_bias_m": scene_bias, "estimators": found}


def accuracy_tables(street: str, found: dict[str, Any]) -> list[Table]:
    """Lengths in cm, shares in %."""
    beds, drawn = [], []
    for each in found["estimators"]:
        vehicles = each["vehicles"]
        shares = [each[k] for k in ("covered", "covered_off_edges", "sheltered", "in_the_air")]
        shares += [*each["rings"].values(), vehicles["covered"]]
        error = (*_cm(each["bed_error_m"]), _cm(vehicles["bed_error_m"])[0])
        beds.append([each["estimator"], *(None if s is None else 100 * s for s in shares), *error])
        for one in each["depths"]:
            errors = (*_cm(one["error_m"]), _cm(one["error_on_scene_m"])[0])
            shares = 100 * one["covered"], 100 * one["sheltered"]
            drawn.append([each["estimator"], 100 * one["depth_m"], *shares, *errors])
    rings = found["estimators"][0]["rings"]
    columns = ("heights from", "covered", "off edges", "sheltered", "in the air", *rings)
    lengths = ("error cm", "p95", "bias")
    return [
        Table(
            f"Cells, %: {street}, {found['points']:,} points open to the sky, flat and seen",
            (*columns, "driving cars", *lengths, "on cars"),
            beds,
        ),
        Table(
            "Snow as drawn from above, %",
            ("heights from", "depth cm", "covered", "sheltered", *lengths, "on the scene's own"),
            drawn,
            f"the scene's own surface is off by {100 * found['scene_bias_m']:+.1f} cm",
        ),
    ]


def _cm(error: dict[str, float | None]) -> list[float | None]:
    return [None if value is None else 100 * value for value in error.values()]


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


def bed_heights(cells: SnowCells, points: TruePoints) -> np.ndarray:
    """z [P] of the bed under each point, NaN where it has none."""
    over = cells_over(cells, points)
    z, met = np.full(len(points), np.nan), over >= 0
    z[met] = _heights(cells, over[met], points.xy[met])
    return z


def at_edges(truth: StreetTruth, points: TruePoints) -> np.ndarray:
    """bool [P]: within EDGE_M the true surface leaves the point's own plane by STEP_M or more."""
    off = np.zeros(len(points), bool)
    for angle in np.arange(8) * (math.pi / 4):
        beside = points.xy + EDGE_M * np.array([math.cos(angle), math.sin(angle)])
        step = np.abs(surface_below(truth, beside) - points.z)
        off |= step > STEP_M + EDGE_M * np.tan(points.slope)
    return off


def sheltered_share(cells: SnowCells, truth: StreetTruth, points: TruePoints) -> dict[str, float]:
    """Shares by area of the cells that lie OVER_M or more beneath the true surface which is open to
    the sky there, and of those that lie as much above it, on nothing.
    """
    centers, sizes = cells.centers_m.numpy().astype(np.float64), cells.sizes_m.numpy()
    low, high = points.xy.min(0), points.xy.max(0)
    inside = ((centers[:, :2] >= low) & (centers[:, :2] <= high)).all(1)
    centers, area = centers[inside], sizes[inside].astype(np.float64) ** 2
    off = centers[:, 2] - surface_below(truth, centers[:, :2])
    whole = max(float(area.sum()), 1e-9)
    return {
        "sheltered": float(area[off < -OVER_M].sum()) / whole,
        "in_the_air": float(area[off > OVER_M].sum()) / whole,
    }


def _vehicle_shares(bed: SnowSupport, scene: Scene, truth: StreetTruth) -> dict[str, Any]:
    """Of the cars that drive: share of their tops, less steep than what drivers keep clear, that
    has a cell; and how far those are from the true body.
    """
    covered, errors = [np.zeros(0, bool)], [np.zeros(0)]
    for actor, mover in zip(scene.actors, truth.street.movers, strict=True):
        if actor.track_id not in bed.actors or not moves(actor):
            continue
        half = np.array(mover.size_m[:2]) / 2
        axes = [np.arange(-h + PATCH_M / 2, h, PATCH_M) for h in half]
        xy = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
        own = StreetTruth(dataclasses.replace(truth.street, static=mover.body, movers=()))
        tops = true_points(own, [], xy, reach_m=math.inf)
        flat = tops.slope < math.radians(DRIVEN_MAX_SLOPE_DEG)
        tops = tops.chosen(flat & (tops.z > 0))  # above the box's middle: no bumpers and sills
        cells = bed.actors[actor.track_id]
        covered.append(cells_over(cells, tops) >= 0)
        errors.append(bed_heights(cells, tops) - tops.z)
    every = np.concatenate(covered)
    return {
        "points": len(every),
        "covered": float(every.mean()) if len(every) else None,
        "bed_error_m": height_error(np.concatenate(errors)),
    }


def height_error(off: np.ndarray) -> dict[str, float | None]:
    """Of height differences [P], NaN left out."""
    off = off[np.isfinite(off)]
    if len(off) == 0:
        return {"median": None, "p95": None, "bias": None}
    median, p95 = map(float, np.quantile(np.abs(off), [0.5, 0.95]))
    return {"median": median, "p95": p95, "bias": float(np.median(off))}


# ---- snow as it is drawn ------------------------------------------------------------------------


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
    bed: SnowSupport,
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
    layer = build_snow_layer(bed, scene, snow, illumination_of(scene, snow), seed=0).ground
    bare = dataclasses.replace(scene.background, opacities=layer.opacities)
    parts = [PosedGaussians(bare), PosedGaussians(layer.gaussians, is_snow=True)]
    settings = RasterSettings(sh_degree=0)
    out = rasterize(parts, above, buffers=BUFFERS, settings=settings, clip=UNCUT)
    assert out.mode_depth is not None and out.snow is not None
    height = SKY_Z_M - out.mode_depth.to(torch.float64).numpy()
    shown = out.snow.numpy() >= 0.5
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
    recipe = snow_recipe(shading, cell_m=cell_m, output=Output(depth="expected", labels=False))

    def seen(camera: Camera) -> MaskedView:
        view, snow = rendered_view(scene, camera, recipe)
        return MaskedView(view, snow.numpy())

    return mask_agreement(list(view_pairs(scene, frames, scale)), seen)
