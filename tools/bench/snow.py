"""Snow: its cost, where it is placed, what it covers and should not, and its height.

The procedural street says what snow should lie on: points of its true surface from straight
above. A point is open where the vertical ray from the sky meets it first, flat where the true
surface is no steeper than the limit, seen where nothing stands between it and a camera. What
drives or walks shelters nothing, nor does it hide anything.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from augment.geometry import rigid
from augment.metrics.consistency import DepthView, find_warp
from augment.render.buffers import BUFFERS
from augment.render.constants import RasterSettings
from augment.render.layout import UNCUT
from augment.render.rasterize import rasterize
from augment.scene import PosedGaussians, Scene
from augment.semantics import SemanticClass
from recipes.schema import Output, Recipe
from tools.bench.harness import Action, Cell, Table, peak_mib_in_subprocess, rounds
from tools.bench.scenes import (
    PICTURE_ONLY,
    EffectCase,
    all_cameras,
    cost_tables,
    frame_of,
    recipe_of,
)

NEXT_CAMERA = "next camera"
AHEAD = "1 ahead"
SHADINGS = ("per_splat", "per_pixel")
ESTIMATORS: tuple[Estimator, ...] = get_args(Estimator)
DEPTHS_M = (0.02, 0.1, 0.4)
SKY_Z_M = 60.0  # above everything on the street
OVER_M = 0.2  # a cell farther above or below the true surface does not lie on it
RINGS_M = (0.0, 8.0, 16.0, 32.0)
LIFT_M = 1e-3  # of a point above its own surface, before it looks at a camera


def snow_recipe(
    shading: str = "per_splat",
    cell_m: float = 0.05,
    output: Output = PICTURE_ONLY,
    **other_effects: Any,
) -> Recipe:
    """10 cm of snow. other_effects: fields of other effects, by name."""
    snow = {"depth_m": 0.1, "shading": shading, "cell_m": cell_m}
    return recipe_of({"snow": snow, **other_effects}, output)


def tables(case: EffectCase, repeats: int) -> list[Table]:
    """Costs of either shading alone, with depth and labels, and in smog; and in a flood."""
    kinds = [
        ("", {}, PICTURE_ONLY),
        (", depth and labels", {}, Output()),
        (", smog", {"smog": {"visibility_m": 200}}, PICTURE_ONLY),
    ]
    wet = (", flood", {"flood": {"level_m": 0.15, "reference": "median"}}, PICTURE_ONLY)
    cases = [(shading, *kind) for kind in kinds for shading in SHADINGS] + [("per_splat", *wet)]
    costs = {
        shading + title: (snow_recipe(shading, case.cell_m, output, **beside),
                          recipe_of(beside, output))
        for shading, title, beside, output in cases
    }  # fmt: skip
    all_tables = [placement_table(uri, case, repeats) for uri in case.scenes]
    all_tables += cost_tables(case, costs, SHADINGS, repeats)
    street, truth = case.open_street()
    reach_m, pixel_m = (16.0, 0.1) if case.cell_m >= 0.1 else (32.0, 0.05)
    accuracy = snow_accuracy(street, truth, cell_m=case.cell_m, reach_m=reach_m, pixel_m=pixel_m)
    all_tables += accuracy_tables(case.street, accuracy)
    columns = ("other view", "points", "equal masks", "worst pair", "colour rms, 1/255")
    for shading in SHADINGS:
        rows = snow_masks(street, case.frames, case.scale / 2, shading, case.cell_m)
        all_tables.append(Table(f"Masks of two views, {shading}", columns, rows))
    return all_tables


# ---- placement: what it takes, and what it covers -----------------------------------------------


def placement(scene: Scene, cell_m: float, backend: str = "auto") -> Callable[[], SnowSupport]:
    """Return an action that places snow for all cameras."""
    settings = placement_settings(snow_recipe(cell_m=cell_m).weather.snow, scene)
    cameras = all_cameras(scene)
    return functools.partial(place_snow_support, scene, cameras, settings, backend=backend)


def placement_table(uri: str, case: EffectCase, repeats: int) -> Table:
    """Time the placement of snow for all cameras, and the layer of snow on it."""
    scene = open_scene(uri)
    find = placement(scene, case.cell_m)
    support = find()
    stages = rounds({"all": find}, min(repeats, 3))
    depths_m = itertools.cycle((0.05, 0.1, 0.3))  # what was laid last does not help the next

    def lay(shading: str) -> object:
        snow = recipe_of({"snow": {"depth_m": next(depths_m), "shading": shading}}).weather.snow
        return build_snow_layer(support, scene, snow, illumination_of(scene, snow), seed=0)

    laid = rounds({name: functools.partial(lay, name) for name in SHADINGS}, repeats)
    stages |= {f"another depth, {name}": seconds for name, seconds in laid.items()}
    mib = peak_mib_in_subprocess(_warm_placement, (uri, case.cell_m)) if case.memory else None
    on_vehicles = sum(map(len, support.actors.values()))
    return Table(
        f"Placement: {uri}, {len(all_cameras(scene))} cameras, cells of {case.cell_m:g} m",
        ("stage", "seconds", "least"),
        [[stage, float(np.median(times)), min(times)] for stage, times in stages.items()],
        f"{len(support.ground):,} cells, {on_vehicles:,} on {len(support.actors)} vehicles"
        + ("" if mib is None else f"; {mib:.0f} MiB above the scene"),
    )


def _warm_placement(uri: str, cell_m: float) -> Action:
    scene = open_scene(uri)
    settings = placement_settings(snow_recipe(cell_m=10 * cell_m).weather.snow, scene)
    place_snow_support(scene, all_cameras(scene)[:1], settings)  # loads the kernels
    return placement(scene, cell_m)


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
    """Return the street without moving objects."""
    return StreetTruth(dataclasses.replace(truth.street, movers=()))


def camera_from_above(cameras: Sequence[Camera], *, reach_m: float, pixel_m: float) -> Camera:
    """An orthographic camera that looks down on all that is within reach_m of the cameras, in level
    distance along x and y; rows towards -y.
    """
    centres = np.stack([camera.centre.numpy()[:2] for camera in cameras])
    low = centres.min(0) - reach_m
    high = centres.max(0) + reach_m
    width, height = (int(n) for n in np.ceil((high - low) / pixel_m))
    eye = torch.tensor([*((low + high) / 2), SKY_Z_M], dtype=torch.float64)
    rotation = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    pose = rigid(rotation, -rotation @ eye)
    scale = 1 / pixel_m
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
    """Return rows and columns of positions [P, 2] in a camera from above."""
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
    is_hit = (away <= reach_m) & np.isfinite(hits.distance)
    points = points.chosen(is_hit)
    return dataclasses.replace(points, is_seen=_seen(truth, cameras, points, hits.normal[is_hit]))


def _seen(
    truth: StreetTruth, cameras: Sequence[Camera], points: TruePoints, normals: np.ndarray
) -> np.ndarray:
    """bool [P]: seen by one of the cameras, whatever its distance."""
    places = np.concatenate([points.xy, points.z[:, None]], 1) + LIFT_M * normals
    is_seen = np.zeros(len(points), bool)
    for camera in cameras:
        left = np.flatnonzero(~is_seen)
        pose = camera.camera_from_world.numpy()
        to_eye = camera.centre.numpy() - places[left]
        x, y, z = (places[left] @ pose[:3, :3].T + pose[:3, 3]).T
        depth = np.maximum(z, 1e-9)
        u = camera.fx * x / depth + camera.cx
        v = camera.fy * y / depth + camera.cy
        inside = (z > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        inside &= (to_eye * normals[left]).sum(1) > 0
        if inside.any():
            left = left[inside]
            to_eye = to_eye[inside]
            is_seen[left] = ~truth.street.static.tree.occluded(places[left], to_eye, 1.0)
    return is_seen


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
    cameras = all_cameras(scene)
    street = still(truth)
    above = camera_from_above(cameras, reach_m=reach_m, pixel_m=pixel_m)
    points = true_points(
        street, cameras, pixel_places(above)[1::2, 1::2].reshape(-1, 2), reach_m=reach_m
    )
    max_slope = math.radians(PlacementSettings(cell_m=cell_m).max_slope_deg)
    flat = points.chosen(points.is_seen & (points.slope < max_slope))
    crown = flat.semantic == SemanticClass.VEGETATION
    bias = _scene_bias_m(scene, street, flat, above)
    estimator_rows = []
    for estimator in estimators:
        settings = PlacementSettings(cell_m=cell_m, estimator=estimator)
        support = place_snow_support(scene, cameras, settings)
        covered = cells_over(support.ground, flat) >= 0
        rings = {}
        for low, high in itertools.pairwise(RINGS_M):
            in_ring = (flat.from_path_m >= low) & (flat.from_path_m < high)
            rings[f"{low:g}-{high:g} m"] = float(covered[in_ring].mean()) if in_ring.any() else None
        estimator_rows.append({
            "estimator": estimator,
            "covered": float(covered[~crown].mean()),
            "rings": rings,
            "error_m": height_error(support_heights(support.ground, flat) - flat.z),
            "depths": [_drawn(scene, support, street, flat, above, d, bias) for d in depths_m],
        })  # fmt: skip
    return {"points": len(flat), "scene_bias_m": bias, "estimators": estimator_rows}


def accuracy_tables(street: str, accuracy: dict[str, Any]) -> list[Table]:
    """Lengths in cm, shares in %."""

    def hundredfold(values: Sequence[float | None]) -> list[float | None]:
        return [None if value is None else 100 * value for value in values]

    placement_rows = []
    height_rows = []
    for estimator_figures in accuracy["estimators"]:
        shares = [
            estimator_figures["covered"],
            *estimator_figures["rings"].values(),
            *estimator_figures["error_m"].values(),
        ]
        placement_rows.append([estimator_figures["estimator"], *hundredfold(shares)])
        for depth_figures in estimator_figures["depths"]:
            shares = [
                depth_figures["depth_m"],
                depth_figures["covered"],
                depth_figures["sheltered"],
                *depth_figures["error_m"].values(),
            ]
            median = depth_figures["error_on_scene_m"]["median"]
            height_rows.append([estimator_figures["estimator"], *hundredfold([*shares, median])])
    rings = accuracy["estimators"][0]["rings"]
    lengths = ("error cm", "p95", "bias")
    return [
        Table(
            f"Cells, %: {street}, {accuracy['points']:,} points open to the sky, flat and seen",
            ("heights from", "covered", *rings, *lengths),
            placement_rows,
        ),
        Table(
            "Snow as drawn from above, %",
            ("heights from", "depth cm", "covered", "sheltered", *lengths, "on the scene's own"),
            height_rows,
            f"the scene's own surface is off by {100 * accuracy['scene_bias_m']:+.1f} cm",
        ),
    ]


def cells_over(cells: SnowCells, points: TruePoints) -> np.ndarray:
    """int64 [P]: the cell over each point and close to its surface, -1 where there is none."""
    centers = cells.centers_m.numpy().astype(np.float64)
    sizes = cells.sizes_m.numpy()
    out = np.full(len(points), -1, np.int64)
    for size in np.unique(sizes):
        cell_ids = np.flatnonzero(sizes == size)
        low = centers[cell_ids, :2] - size / 2
        offset = low[0] % size  # cells of one size share a grid
        key = _keys(np.round((low - offset) / size).astype(np.int64))
        place = _keys(np.floor((points.xy - offset) / size).astype(np.int64))
        order = np.argsort(key)
        at = np.minimum(np.searchsorted(key[order], place), len(cell_ids) - 1)
        candidate_ids = cell_ids[order[at]]
        is_match = key[order[at]] == place
        is_match &= np.abs(_heights(cells, candidate_ids, points.xy) - points.z) <= OVER_M
        out[is_match] = candidate_ids[is_match]
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
    z = np.full(len(points), np.nan)
    is_covered = over >= 0
    z[is_covered] = _heights(cells, over[is_covered], points.xy[is_covered])
    return z


def height_error(off: np.ndarray) -> dict[str, float | None]:
    """Return figures of height differences [P] without NaN."""
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
    snow = recipe_of({"snow": {"depth_m": depth_m}}).weather.snow
    layer = build_snow_layer(support, scene, snow, illumination_of(scene, snow), seed=0).ground
    without_snow = dataclasses.replace(scene.background, opacities=layer.opacities)
    parts = [PosedGaussians(without_snow), PosedGaussians(layer.gaussians, is_overlay=True)]
    settings = RasterSettings(sh_degree=0)
    out = rasterize(parts, above, buffers=BUFFERS, settings=settings, clip=UNCUT)
    height = SKY_Z_M - out.mode_depth.to(torch.float64).numpy()
    shows_snow = out.overlay.numpy() >= 0.5
    z = height[pixels_of(above, flat.xy)]
    shows_snow_there = shows_snow[pixels_of(above, flat.xy)]
    on_it = shows_snow_there & (np.abs(z - depth_m - flat.z) <= OVER_M + 0.5 * depth_m)
    off = np.where(on_it, z - flat.z - depth_m, np.nan)
    step = max(1, int(shows_snow.sum()) // 400_000)
    places = pixel_places(above)[shows_snow][::step]
    heights = height[shows_snow][::step]
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
    """Compare masks of neighbouring cameras and of cameras a frame ahead where depths agree."""
    recipe = snow_recipe(shading, cell_m, Output(depth="expected", labels=False))

    def seen(camera: Camera) -> tuple[DepthView, np.ndarray]:
        buffers = frame_of(scene, camera, recipe)()
        images = buffers.rgb.clamp(0, 1), buffers.raster.expected_depth, buffers.raster.alpha
        return DepthView(camera, *(i.numpy() for i in images)), buffers.masks["snow"].numpy()

    return mask_agreement(view_pairs(scene, frames, scale), seen)


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


def mask_agreement(
    pairs: Iterator[tuple[str, Camera, Camera]],
    view_of: Callable[[Camera], tuple[DepthView, np.ndarray]],
) -> list[list[Cell]]:
    """By kind of pairs: points that both show; share of them with equal masks, of all pairs and of
    the worst; root mean square difference of colours, 1/255, where both masks are true. view_of:
    the view whose depth says which points are shared, and the mask bool [H, W].
    """
    view_of = functools.cache(view_of)
    counts_by_kind: dict[str, list[tuple[int, int, float, int]]] = {}
    for kind, first, second in pairs:
        (first_view, first_mask) = view_of(first)
        (second_view, second_mask) = view_of(second)
        warp = find_warp(first_view, second_view)
        ours = first_mask[warp.counts]
        images = np.concatenate([second_view.picture, second_mask[..., None]], -1)
        theirs = warp.sample(images)[warp.counts]
        same = ours == (theirs[:, 3] > 0.5)
        both = ours & same
        squares = float(((first_view.picture[warp.counts][both] - theirs[both, :3]) ** 2).sum())
        counts = (len(ours), int(same.sum()), squares, int(both.sum()))
        counts_by_kind.setdefault(kind, []).append(counts)
    rows: list[list[Cell]] = []
    for kind, pair_counts in counts_by_kind.items():
        points, same, squares, both = (sum(column) for column in zip(*pair_counts, strict=True))
        worst = min((s / p for p, s, _, _ in pair_counts if p), default=None)
        rms = 255 * math.sqrt(squares / (3 * both)) if both else None
        rows.append([kind, points, same / points if points else None, worst, rms])
    return rows
