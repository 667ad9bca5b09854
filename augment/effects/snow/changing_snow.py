"""Snow that grows and melts from image to image: laid once a scene, then scaled for each view.

In: an exposed surface and a recipe's snow, whose `placed_depth_m` is the drive's largest depth.
Out: `ChangingLayers`; its `at` returns the `SnowLayers` of a moment. Caller: `effect`.

The layer is laid with that depth on all cells that can ever carry snow. A view then takes the part
of it that its cameras may see, and in one pass

- a cell is covered where its noise exceeds a threshold, which falls as the share of the ground that
  is white grows. That share is coverage (1 - exp(-depth / d0)), with d0 for grass, for roads and
  for all else, and with the roads' own depth. The noise stays, so snow comes and goes in its order.
- heights over the surface scale with the depth. Thin snow is translucent and darker.
- traffic takes snow from the roads as `slush` has it, with the passes of the cars that have driven.
- the scene's Gaussians beneath fade as the snow over them closes.

All of it is a function of place and depth, without steps.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from augment.effects.gradient_noise import draw_octaves, find_threshold, sum_octaves
from augment.effects.snow import layer_kernels, slush
from augment.effects.snow.changing_kernels import (
    BARE_BAND,
    MAX_TABLE_DEPTH_M,
    OVERLAP,
    RIM,
    TABLE_SIZE,
    TRANSLUCENT_DEPTH_M,
    ChangingCells,
    LaidSplats,
    SnowState,
    SnowTables,
    fade_buried,
    fade_few_buried,
    find_cell_depths,
    scale_few_splats,
    scale_splats,
)
from augment.effects.snow.depth import (
    CELLS_PER_TASK,
    COVERING_DEPTH_M,
    DepthProfile,
    as_arrays,
    find_depths,
    profile_on_part,
)
from augment.effects.snow.glints import Crystals
from augment.effects.snow.layer import OPACITY, build_part_layer, grain_of_snow
from augment.effects.snow.layer_kernels import CellDepths
from augment.effects.snow.light import SnowIllumination
from augment.effects.snow.part_snow import PartSnow, SnowLayers
from augment.effects.snow.plan import SnowPlan
from augment.effects.snow.traffic import SATURATION
from augment.effects.snow.wet_tracks import WetRoad, make_wet_road
from augment.exposure.cells import ExposedCells, ExposedSurface
from augment.render.sh import SH_C0
from augment.render.threads import kernel_threads
from augment.rng import rng_for
from augment.scene.bounds import Bounds, may_show
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, Scene
from augment.scene.semantics import SemanticClass
from recipes.snow import HARD_COVERING_DEPTH_M, Snow

# Depth at which all but 1/e of grass is white, metres; judgement.
GRASS_COVERING_DEPTH_M = 0.02
# Octaves of the noise that orders the cells: (lattice step in metres, standard deviation).
_ORDER_OCTAVES = ((2.6, 0.35), (1.1, 0.25), (0.45, 0.3), (0.19, 0.6), (0.08, 0.6))
# Largest threshold of that noise; it exceeds all of its values.
_MAX_THRESHOLD = 6.0
# Rise of the noise from a cell's first snow to its full share: of deep snow, whose patches have
# edges, and what thin snow, which lies everywhere between, has more; the depth between the two.
_DEEP_BAND = 0.35
_THIN_BAND = 1.1
_BAND_DEPTH_M = 0.01
# Depth up to which the first flakes are fainter, so that none appears at once, metres.
_ONSET_DEPTH_M = 0.0002
_NUM_SMOOTHING_STEPS = 4  # steps that even out the borders of roads and grass
_CHUNK_M = 3.0  # side of the squares in which the layer is tested for views
_MAX_FEW = 4096  # largest number of Gaussians for which waking other threads costs more
_RUNS_PER_TASK = 4  # runs that a thread takes at a time
# Largest depth over the laid depth; more is scaled, and its boxes are not tested.
_MAX_TESTED_SCALE = 1.5
# Height by which a layer may rise over its boxes: drifts and ridges, metres.
_BOX_MARGIN_M = 0.3
_ROAD_CLASSES = (int(SemanticClass.ROAD), int(SemanticClass.LANE_MARKING))
_GRASS = int(SemanticClass.TERRAIN)


@dataclass(frozen=True, eq=False)
class _Runs:
    """Rows of a table in squares of the ground, and boxes about them."""

    rows: np.ndarray
    """int64 [K, 2], first row and last row + 1 of each square."""
    bounds: Bounds
    """A box for each square, about all places that its Gaussians can take."""

    def visible(self, cameras: Sequence[Camera] | None) -> np.ndarray:
        """Return the rows of the squares that cameras may show; all without cameras."""
        if cameras is None:
            return self.rows
        masks = [may_show(self.bounds, None, camera, 0.0) for camera in cameras]
        return self.rows[np.any(masks, axis=0)]


@dataclass(frozen=True, eq=False)
class ChangingPart:
    """Snow on one part of a scene, as it was laid."""

    laid: PartSnow
    """The layer as it was laid."""
    cells: ChangingCells
    """Its cells."""
    floors: np.ndarray
    """float32 [S], z of the surface beneath each Gaussian."""
    cell_ids: np.ndarray
    """int32 [S], cell of each Gaussian."""
    splat_runs: _Runs
    """Its Gaussians by squares."""
    hideable_ids: np.ndarray
    """int32 [B], numbers of the part's Gaussians that the snow can bury."""
    covering_cells: np.ndarray
    """int32 [B, 5], see ExposedCells."""
    buried_runs: _Runs
    """Those Gaussians by squares."""
    opacities: Tensor
    """Opacities of the part's Gaussians without snow."""

    def at(self, state: SnowState, cameras: Sequence[Camera] | None) -> PartSnow:
        """Return the snow at a moment.

        Args:
            state: the moment.
            cameras: cameras that see the part, which then has no pose; None for all of it.
        """
        runs = self.splat_runs.visible(cameras)
        counts = runs[:, 1] - runs[:, 0]
        firsts = np.cumsum(counts) - counts
        total = int(counts.sum())
        laid = _arrays_of(self.laid)
        tensors = [torch.empty(total if len(array) else 0, *array.shape[1:]) for array in laid]
        scaled = LaidSplats(*(tensor.numpy() for tensor in tensors))
        shares = np.full(len(self.cells.noise), -1, np.float32)
        numbers = (laid, self.floors, self.cell_ids, self.cells, state, _tables(), shares, scaled)
        if total > _MAX_FEW:
            with kernel_threads(_RUNS_PER_TASK):
                scale_splats(np.concatenate([runs, firsts[:, None]], 1), *numbers)
        else:
            for (first, end), place in zip(runs.tolist(), firsts.tolist(), strict=True):
                scale_few_splats(np.array([first, end, place]), *numbers)
        means, quats, scales, opacities, sh, normals, slopes = map(torch.from_numpy, scaled)
        classes = torch.from_numpy(np.full(total, int(SemanticClass.SNOW), np.int16))
        return PartSnow(
            gaussians=Gaussians(means, quats, scales, opacities, sh, semantic=classes),
            visible_opacities=self._fade_buried(state, shares, cameras),
            sunlight_rgb=None if self.laid.sunlight_rgb is None else slopes,
            normals=None if self.laid.normals is None else normals,
            crystals=self._crystals_at(state),
        )

    def _fade_buried(
        self, state: SnowState, shares: np.ndarray, cameras: Sequence[Camera] | None
    ) -> Tensor:
        """Return the opacities of the part's Gaussians at a moment, [N]."""
        runs = self.buried_runs.visible(cameras)
        if not len(runs):
            return self.opacities
        laid = self.opacities.detach().numpy()
        faded = laid.copy()
        numbers = (
            self.hideable_ids,
            self.covering_cells,
            self.cells,
            state,
            _tables(),
            shares,
            laid,
            faded,
        )
        if len(self.hideable_ids) > _MAX_FEW:
            with kernel_threads(_RUNS_PER_TASK):
                fade_buried(runs, *numbers)
        else:
            for run in runs:
                fade_few_buried(run, *numbers)
        return torch.from_numpy(faded)

    def _crystals_at(self, state: SnowState) -> Crystals | None:
        """Return the crystals on snow that hides half of what it lies on."""
        crystals = self.laid.crystals
        if crystals is None or crystals.disc_ids is None:
            return None
        discs = crystals.disc_ids.numpy()
        cell_ids = self.cell_ids[discs]
        shares, depths_m = define_snow(self.cells, state, cell_ids)
        rows = np.flatnonzero(shares >= 0.5)
        places = crystals.places_m.numpy()[rows].copy()
        ratios = depths_m[rows] / np.maximum(self.cells.depths_m[cell_ids[rows]], 1e-6)
        floors = self.floors[discs[rows]]
        places[:, 2] = floors + ratios * (places[:, 2] - floors)
        row_tensor = torch.from_numpy(rows)
        return Crystals(
            torch.from_numpy(places),
            crystals.mirrors[row_tensor],
            crystals.strength,
            crystals.disc_ids[row_tensor],
        )


@dataclass(frozen=True, eq=False)
class RoadWater:
    """Maps of wet road: where the snow melts, and in the tracks of traffic."""

    everywhere: WetRoad
    """Road: wetness 1."""
    tracks: WetRoad
    """Bare tracks once all cars have driven, on the same places."""

    def at(self, wetness: float, driven: float) -> WetRoad | None:
        """Return the wetness at a moment; None if all is dry.

        Args:
            wetness: wetness of bare road, 0 to 1.
            driven: share of the traffic that has driven.
        """
        if wetness <= 0 and driven <= 0:
            return None
        total = torch.maximum(wetness * self.everywhere.wetness, driven * self.tracks.wetness)
        return dataclasses.replace(self.everywhere, wetness=total)


@dataclass(frozen=True, eq=False)
class ChangingLayers:
    """Snow in a scene that changes with time."""

    laid: SnowLayers
    """The snow as it was laid: the most that there can be."""
    ground: ChangingPart
    """Snow on the background."""
    actors: Mapping[str, ChangingPart]
    """Snow on actors, by track_id."""
    road_water: RoadWater | None
    """Water on roads; None without any."""

    def at(
        self,
        snow: Snow,
        cameras: Sequence[Camera] | None = None,
        track_ids: Container[str] | None = None,
    ) -> SnowLayers:
        """Return the snow of a recipe at a moment, without the water on roads.

        Args:
            snow: the recipe's snow at the moment.
            cameras: cameras that see the ground; None for the whole scene.
            track_ids: actors whose snow is in view; None for all.
        """
        state = state_of(snow)
        is_tested = max(state.scale, state.road_scale) <= _MAX_TESTED_SCALE
        return dataclasses.replace(
            self.laid,
            ground=self.ground.at(state, cameras if is_tested else None),
            actors={
                name: part.at(state, None)
                for name, part in self.actors.items()
                if track_ids is None or name in track_ids
            },
            thickness_m=snow.depth_m,
        )

    def wet_road_at(self, snow: Snow) -> WetRoad | None:
        """Return the wet road at a moment; None if all is dry. snow: the recipe's then."""
        if self.road_water is None:
            return None
        wetness = 0.0 if snow.road is None else snow.road.wetness
        return self.road_water.at(wetness, state_of(snow).driven)


# ---- The state of a moment -----------------------------------------------------------------------


def laid_plan(plan: SnowPlan) -> SnowPlan:
    """Return the plan with the snow as it is laid: the same for all moments of a recipe."""
    snow = plan.snow
    road = None if snow.road is None else type(snow.road)()
    fields = {
        "depth_m": snow.laid_depth_m,
        "placed_depth_m": snow.laid_depth_m,
        "coverage": 1.0,
        "road": road,
    }
    laid_snow = snow.model_copy(update=fields)
    return dataclasses.replace(plan, snow=laid_snow, has_wet_ground=False)


def state_of(snow: Snow) -> SnowState:
    """Return the numbers of a recipe's snow that the layer's Gaussians follow from."""
    road = snow.road
    road_depth_m = snow.depth_m if road is None else road.depth_m
    driven = 1.0 if road is None else road.driven
    driven = driven if snow.traffic > 0 else 0.0
    laid_m = _settled_m(snow.laid_depth_m)
    shares = (
        snow.coverage * -math.expm1(-depth_m / covering_m)
        for depth_m, covering_m in (
            (snow.depth_m, HARD_COVERING_DEPTH_M),
            (snow.depth_m, GRASS_COVERING_DEPTH_M),
            (road_depth_m, HARD_COVERING_DEPTH_M),
        )
    )
    order = draw_octaves(_ORDER_OCTAVES, np.random.default_rng(0))
    thresholds = (
        min(max(find_threshold(order, share), -_MAX_THRESHOLD), _MAX_THRESHOLD) for share in shares
    )
    hard, soft, on_road = thresholds
    return SnowState(
        hard_threshold=hard,
        soft_threshold=soft,
        road_threshold=on_road,
        band=_band(snow.depth_m),
        road_band=_band(road_depth_m),
        onset=min(snow.depth_m / _ONSET_DEPTH_M, 1.0),
        road_onset=min(road_depth_m / _ONSET_DEPTH_M, 1.0),
        scale=_settled_m(snow.depth_m) / laid_m,
        road_scale=_settled_m(road_depth_m) / laid_m,
        driven=driven,
        scraped=slush.SCRAPED_SHARE * snow.traffic * driven,
        pressed_share=slush.PRESSED_SHARE,
        baring_passes=slush.BARING_PASSES,
        baring_passes_per_m=slush.BARING_PASSES_PER_M,
        ridge_share=slush.RIDGE_SHARE,
        max_ridge_m=slush.MAX_RIDGE_M,
    )


def find_depths_at(cells: ChangingCells, state: SnowState) -> np.ndarray:
    """Return the depth of the snow on every cell at a moment, float32 [C].

    It is 0 where the snow hides less than half of what it lies on.
    """
    depths_m = np.empty(len(cells.noise), np.float32)
    with kernel_threads(CELLS_PER_TASK):
        find_cell_depths(cells, state, _tables(), depths_m)
    return depths_m


@functools.cache
def _tables() -> SnowTables:
    """Return the tables that kernels read."""
    shares = np.linspace(0, 1, TABLE_SIZE)
    depths_m = MAX_TABLE_DEPTH_M * shares
    tables = (
        OPACITY * (1 - (1 - shares) ** OVERLAP),
        1 - np.exp(-depths_m / TRANSLUCENT_DEPTH_M),
        1 - layer_kernels.THIN_LOSS * np.exp(-depths_m / layer_kernels.THIN_DEPTH_M),
    )
    return SnowTables(*(table.astype(np.float32) for table in tables))


def _band(depth_m: float) -> float:
    """Return the rise of the noise from a cell's first snow to its full share."""
    return _DEEP_BAND + _THIN_BAND * math.exp(-depth_m / _BAND_DEPTH_M)


def _settled_m(depth_m: float) -> float:
    """Return the depth of snow where it lies, if all of it lies on the covered share, metres."""
    share = -math.expm1(-depth_m / COVERING_DEPTH_M)
    return depth_m / share if share > 0 else COVERING_DEPTH_M


def define_snow(
    cells: ChangingCells, state: SnowState, rows: Int[np.ndarray, "R"] | slice = slice(None)
) -> tuple[np.ndarray, np.ndarray]:
    """Return the share of cells that snow covers, and its depth in metres, float64 [R] each.

    This is the definition of `changing_kernels`.

    Args:
        cells: the cells.
        state: the moment.
        rows: rows of the cells; all by default.
    """
    noise, laid_m, road, soft, passes, factor, ridge = (
        array[rows].astype(np.float64) for array in cells
    )
    threshold = state.hard_threshold + soft * (state.soft_threshold - state.hard_threshold)
    threshold += road * (state.road_threshold - state.hard_threshold)
    over = noise - threshold
    place = 0.5 + over / (state.band + road * (state.road_band - state.band))
    share = _smooth(place) * (state.onset + road * (state.road_onset - state.onset))
    fresh_m = laid_m * (state.scale + road * (state.road_scale - state.scale))
    least_m = layer_kernels.MIN_DEPTH_M
    fresh_m = least_m + np.maximum(fresh_m - least_m, 0) * np.clip(0.5 + over / RIM, 0, 1)
    passes = passes * state.driven
    pressed = 1 - np.exp(-passes / SATURATION)
    ridge_m = np.minimum(state.ridge_share * fresh_m, state.max_ridge_m) * state.driven * ridge
    driven_m = fresh_m * (1 - road * state.scraped) * (1 - state.pressed_share * pressed) + ridge_m
    baring = (state.baring_passes + state.baring_passes_per_m * fresh_m) * factor
    is_driven = passes > 0
    depth_m = np.where(is_driven, driven_m, fresh_m)
    gone = np.where(is_driven, _smooth(0.5 + (passes / baring - 1) / BARE_BAND), 0)
    has_snow = (laid_m > 0) & (share > 0)
    share = share * (1 - gone) * (1 - np.exp(-depth_m / TRANSLUCENT_DEPTH_M))
    return np.where(has_snow, share, 0.0), np.where(has_snow, depth_m, 0.0)


def _smooth(t: np.ndarray) -> np.ndarray:
    """Return a cubic from (0, 0) to (1, 1) that is level at both, constant beyond."""
    t = np.clip(t, 0, 1)
    return t * t * (3 - 2 * t)


# ---- The layer, laid once a scene ----------------------------------------------------------------


def lay_changing_snow(
    exposed_surface: ExposedSurface, scene: Scene, plan: SnowPlan, light: SnowIllumination
) -> ChangingLayers:
    """Lay snow of the recipe's `placed_depth_m` on the exposed surface of the scene.

    Args:
        exposed_surface: cells of the scene.
        scene: the scene.
        plan: the recipe's snow, as `laid_plan` returns it.
        light: light on the snow.
    """
    gaussians = {actor.track_id: actor.gaussians for actor in scene.actors}
    ground, road_water = _lay_part(
        exposed_surface.ground, scene.background, None, scene, plan, light
    )
    actors = {
        name: _lay_part(cells, gaussians[name], name, scene, plan, light)[0]
        for name, cells in exposed_surface.actors.items()
    }
    laid = SnowLayers(
        ground.laid,
        {name: part.laid for name, part in actors.items()},
        light.sun,
        light.wrap,
        thickness_m=plan.snow.depth_m,
        grain=grain_of_snow(plan.snow, scene, light, plan.seed),
    )
    return ChangingLayers(laid, ground, actors, road_water)


def changing_cells(
    cells: ExposedCells, track_id: str | None, scene: Scene, plan: SnowPlan
) -> ChangingCells:
    """Return the numbers of a part's cells.

    Args:
        cells: cells of the part.
        track_id: the actor's; None for the background.
        scene: the scene.
        plan: the recipe's snow, as `laid_plan` returns it.
    """
    laid = _find_laid_depths(cells, track_id, scene, plan)
    return _numbers_of(cells, laid.depths.depths_m, laid.traces, track_id, scene, plan)


class _LaidDepths(NamedTuple):
    """Depths of the layer as it is laid."""

    profile: DepthProfile
    rng: np.random.Generator
    depths: CellDepths
    traces: slush.Traces | None  # traces of traffic; None without any


def _find_laid_depths(
    cells: ExposedCells, track_id: str | None, scene: Scene, plan: SnowPlan
) -> _LaidDepths:
    """Return the depths on all cells that can ever carry snow; the arguments are as above."""
    profile, rng = profile_on_part(track_id, scene, plan.snow, plan.seed, plan.water_level_z_m)
    profile = dataclasses.replace(profile, settings=profile.settings._replace(threshold=-1e9))
    depths = find_depths(cells, profile, rng.integers(0, 2**64, dtype=np.uint64))
    traces = slush.find_traces(cells, scene, plan) if track_id is None else None
    return _LaidDepths(profile, rng, depths, traces)


def _lay_part(
    cells: ExposedCells,
    gaussians: Gaussians,
    track_id: str | None,
    scene: Scene,
    plan: SnowPlan,
    light: SnowIllumination,
) -> tuple[ChangingPart, RoadWater | None]:
    """Lay the snow on one part. track_id: None for the background."""
    snow = plan.snow
    profile, rng, depths, traces = _find_laid_depths(cells, track_id, scene, plan)
    tints = None if traces is None else slush.road_tints(depths, cells, traces, snow)
    moves = track_id is not None
    laid, counts = build_part_layer(
        cells, gaussians, snow, light, profile, rng, depths, tints, moves=moves
    )
    numbers = _numbers_of(cells, depths.depths_m, traces, track_id, scene, plan)
    cell_ids = np.repeat(np.arange(len(cells), dtype=np.int32), counts)
    floors = cells.centers_m.numpy()[cell_ids, 2].copy()
    means = laid.gaussians.means.numpy()
    order, splat_rows = _by_squares(means, math.inf if moves else _CHUNK_M)
    laid = _in_deep_tones(_in_order(laid, order), depths.depths_m[cell_ids[order]])
    cell_ids = cell_ids[order]
    floors = floors[order]
    hideable_ids, covering_cells = as_arrays(cells.hideable_ids, cells.covering_cells)
    buried_means = gaussians.means.detach().numpy()[hideable_ids]
    buried_order, buried_rows = _by_squares(buried_means, math.inf if moves else _CHUNK_M)
    hideable_ids = hideable_ids[buried_order]
    scales = gaussians.scales.detach().numpy()[hideable_ids]
    part = ChangingPart(
        laid=laid,
        cells=numbers,
        floors=floors,
        cell_ids=cell_ids,
        splat_runs=_Runs(
            splat_rows, _boxes(means[order], laid.gaussians.scales.numpy(), splat_rows)
        ),
        hideable_ids=hideable_ids,
        covering_cells=np.ascontiguousarray(covering_cells[buried_order]),
        buried_runs=_Runs(buried_rows, _boxes(buried_means[buried_order], scales, buried_rows)),
        opacities=gaussians.opacities,
    )
    return part, _road_water(cells, numbers, traces, plan)


def _numbers_of(
    cells: ExposedCells,
    depths_m: np.ndarray,
    traces: slush.Traces | None,
    track_id: str | None,
    scene: Scene,
    plan: SnowPlan,
) -> ChangingCells:
    """Return the numbers of cells with snow of depths [C]."""
    count = len(cells)
    name = "ground" if track_id is None else f"actor {track_id}"
    rng = rng_for(seed=plan.seed, scene=scene.name, effect=f"snow.order of {name}")
    order = draw_octaves(_ORDER_OCTAVES, rng)
    x_m, y_m = (cells.centers_m[:, k].numpy().astype(np.float64) for k in range(2))
    noise = sum_octaves(order, x_m, y_m)
    if track_id is None:
        noise += layer_kernels.OBSTACLE_SHELTER * cells.obstacle_vectors.norm(dim=1).numpy()
    classes = cells.semantic.numpy()
    is_ground = track_id is None
    road = np.isin(classes, _ROAD_CLASSES) & is_ground
    soft = (classes == _GRASS) & is_ground
    passes = np.zeros(count)
    factor = np.ones(count)
    ridge = np.zeros(count)
    if traces is not None and plan.snow.traffic > 0:
        wear = traces.wear
        rows = np.flatnonzero(wear.is_road)
        sizes_m = cells.sizes_m.numpy()[rows].astype(np.float64)
        edges, lumps = (
            sum_octaves(octaves, x_m[rows], y_m[rows], sizes_m)
            for octaves in (traces.noises.edges, traces.noises.lumps)
        )
        passes[rows] = wear.passes[rows]
        factor[rows] = np.exp(slush.BARE_SCATTER * edges)
        ridge[rows] = wear.ridge[rows] * np.maximum(1 + slush.LUMPINESS * lumps, 0)
    arrays = (
        noise,
        depths_m,
        _evened_out(road.astype(np.float32), cells),
        _evened_out(soft.astype(np.float32), cells),
        passes,
        factor,
        ridge,
    )
    return ChangingCells(*(np.ascontiguousarray(array, np.float32) for array in arrays))


def _evened_out(shares: np.ndarray, cells: ExposedCells) -> np.ndarray:
    """Return shares of cells [C] with soft borders."""
    if not shares.any():
        return shares
    neighbours = cells.neighbours.numpy()
    is_linked = neighbours >= 0
    linked = np.maximum(neighbours, 0)
    num_linked = 1 + is_linked.sum(1)
    for _ in range(_NUM_SMOOTHING_STEPS):
        shares = (shares + np.where(is_linked, shares[linked], 0).sum(1)) / num_linked
    return shares


def _road_water(
    cells: ExposedCells, numbers: ChangingCells, traces: slush.Traces | None, plan: SnowPlan
) -> RoadWater | None:
    """Return the maps of water on the roads; None for a recipe or a scene without any."""
    if plan.snow.road is None and plan.snow.traffic == 0:
        return None
    is_road = numbers.road > 0.5
    tracks = np.zeros(len(cells), np.float32)
    if traces is not None and plan.snow.traffic > 0:
        is_road |= traces.wear.is_road
        first, full = slush.WET_PASSES
        tracks = np.clip((numbers.passes - first) / (full - first), 0, 1).astype(np.float32)
    maps = (
        make_wet_road(cells, np.where(is_road, np.maximum(wetness, 1e-9), 0).astype(np.float32))
        for wetness in (np.ones(len(cells), np.float32), tracks)
    )
    everywhere, in_tracks = maps
    return None if everywhere is None or in_tracks is None else RoadWater(everywhere, in_tracks)


def _by_squares(means: np.ndarray, side_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the order of points by squares of the ground, and each square's rows [K, 2].

    Args:
        means: the points, [N, 3].
        side_m: side of the squares; infinite for one.
    """
    if not len(means):
        return np.zeros(0, np.int64), np.zeros((0, 2), np.int64)
    if math.isinf(side_m):
        return np.arange(len(means)), np.array([[0, len(means)]])
    squares = np.floor(means[:, :2] / side_m).astype(np.int64)
    numbers = np.unique(squares, axis=0, return_inverse=True)[1].reshape(-1)
    order = np.argsort(numbers, kind="stable")
    ends = np.cumsum(np.bincount(numbers))
    return order, np.stack([np.concatenate([[0], ends[:-1]]), ends], 1)


def _boxes(means: np.ndarray, scales: np.ndarray, rows: np.ndarray) -> Bounds:
    """Return a box about each run of Gaussians, with room for what the snow does to them."""
    if not len(rows):
        return Bounds.join([])
    starts = rows[:, 0]
    points = means.astype(np.float64)
    lows = np.minimum.reduceat(points, starts, axis=0)
    highs = np.maximum.reduceat(points, starts, axis=0)
    longest = np.maximum.reduceat(scales.max(1).astype(np.float64), starts)
    lows[:, 2] -= _BOX_MARGIN_M
    highs[:, 2] += _BOX_MARGIN_M
    owners = np.zeros(len(starts), np.int64)
    return Bounds((lows + highs) / 2, (highs - lows) / 2, longest, owners)


def _in_order(part: PartSnow, order: np.ndarray) -> PartSnow:
    """Return a layer with its Gaussians in another order."""
    rows = torch.from_numpy(order)
    crystals = part.crystals
    if crystals is not None and crystals.disc_ids is not None:
        places = np.empty(len(order), np.int64)
        places[order] = np.arange(len(order))
        crystals = dataclasses.replace(
            crystals, disc_ids=torch.from_numpy(places[crystals.disc_ids.numpy()])
        )
    return dataclasses.replace(
        part,
        gaussians=part.gaussians.select(rows),
        sunlight_rgb=None if part.sunlight_rgb is None else part.sunlight_rgb[rows],
        normals=None if part.normals is None else part.normals[rows],
        crystals=crystals,
    )


def _in_deep_tones(part: PartSnow, depths_m: np.ndarray) -> PartSnow:
    """Return a layer without the darkness of thin snow. depths_m: depth of each Gaussian's cell."""
    loss = layer_kernels.THIN_LOSS * np.exp(-depths_m / layer_kernels.THIN_DEPTH_M)
    tones = torch.from_numpy((1 - loss).astype(np.float32))[:, None]
    gaussians = part.gaussians
    sh = gaussians.sh.clone()
    sh[:, 0] = ((0.5 + SH_C0 * sh[:, 0]) / tones - 0.5) / SH_C0
    slopes = part.sunlight_rgb
    return dataclasses.replace(
        part,
        gaussians=dataclasses.replace(gaussians, sh=sh),
        sunlight_rgb=None if slopes is None else slopes / tones,
    )


def _arrays_of(part: PartSnow) -> LaidSplats:
    """Return the arrays of a layer, as kernels take them."""
    g = part.gaussians
    empty = torch.empty(0, 3)
    tensors = (
        g.means,
        g.quats,
        g.scales,
        g.opacities,
        g.sh,
        empty if part.normals is None else part.normals,
        empty if part.sunlight_rgb is None else part.sunlight_rgb,
    )
    return LaidSplats(*as_arrays(*tensors))
