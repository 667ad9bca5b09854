"""Weathered sweeps: what stays to the bit, codes, jobs; echoes of smog, snow and water."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from augment.effects.flood.flood_medium import FloodMedium
from augment.effects.flood.lidar import ABSORPTION_905_PER_M, meet_water
from augment.effects.flood.waves import make_waves
from augment.effects.lidar import ATTENUATED, LOST, MOVED, SCATTERED, UNCHANGED, drop_lost_returns
from augment.effects.lidar.beam import LidarModel, find_beam_origins
from augment.effects.smog import soft_echo, soft_response, wavelength_factor
from augment.effects.snow.effect import build_snow_layers
from augment.effects.snow.lidar import (
    GROUND_SLACK_M,
    LidarSnow,
    find_lidar_snow,
    intersect_layers,
    make_snow_grid,
)
from augment.effects.snow.plan import SnowPlan, exposure_settings
from augment.errors import OutputError
from augment.exposure.cells import ExposedCells, ExposedSurface
from augment.jobs.render_job import RenderJob, run_job
from augment.memo import memo_of
from augment.output.manifest import read_manifest
from augment.output.tables import lidar_bytes, read_lidar
from augment.scene.cameras import Camera
from augment.scene.labels import LidarSweep
from augment.scene.scene import Scene
from augment.view.render_view import render_view
from augment.view.results import WeatheredView
from augment.view.weathered_sweep import weathered_sweep
from recipes.flood import Flood, Waves
from recipes.schema import Recipe, Smog, Weather
from recipes.smog import KOSCHMIEDER
from recipes.snow import Snow
from tests.augment.batch_scenes import FakeLabels, fake_render, make_recipe, open_fake
from tests.lidar_sweeps import (
    SENSOR_M,
    WORLD_ORIGIN_M,
    SensorLabels,
    beams,
    ground_points,
    ranges_of,
    recipe,
    some_points,
    street,
    sweep_of,
)
from tests.snow_beds import cells_on_grid
from tests.snow_scenes import box_car
from tests.streets import LABELLED_STREET, open_street

ADDED = {"source_index", "weather_code"}


@pytest.mark.parametrize(
    "weather",
    [
        {},
        {"smog": Smog(extinction_per_m=0.0)},
        {"snow": Snow(depth_m=0.0)},
        {"snow": Snow(depth_m=0.3, coverage=0.0)},
        {"flood": Flood(level_m=-50.0, reference="absolute")},
    ],
)
def test_no_weather_is_the_source_to_the_bit(weather: dict) -> None:
    sweep = sweep_of(
        some_points(100),
        intensity=np.linspace(0, 1, 100),
        ring=np.arange(100, dtype=np.uint8),
        note=np.array(["a", "b"] * 50, object),
    )
    out = weathered_sweep(street(), recipe(**weather), 0, sweep)
    assert list(out.columns) == [*sweep.columns, "source_index", "weather_code"]
    assert not out.columns["weather_code"].any()
    plain = LidarSweep({k: v for k, v in out.columns.items() if k not in ADDED})
    assert lidar_bytes(plain) == lidar_bytes(sweep)


def test_every_row_keeps_its_place() -> None:
    points = some_points(500)
    sweep = sweep_of(points, ring=np.arange(500, dtype=np.uint16))
    out = weathered_sweep(street(), recipe(smog=60, flood=0.1), 0, sweep)
    assert out.columns["source_index"].dtype == np.int32
    assert out.columns["weather_code"].dtype == np.uint8
    np.testing.assert_array_equal(out.columns["source_index"], np.arange(500))
    np.testing.assert_array_equal(out.columns["ring"], sweep.columns["ring"])
    assert {k: v.dtype for k, v in sweep.columns.items()} == {
        k: v.dtype for k, v in out.columns.items() if k not in ADDED
    }
    code = out.columns["weather_code"]
    same = (out.points_m == sweep.points_m).all(1)
    assert not same[np.isin(code, [SCATTERED, LOST, MOVED])].any()
    assert same[~np.isin(code, [SCATTERED, LOST, MOVED])].all()
    received = drop_lost_returns(out)
    assert len(received) == (code != LOST).sum() < 500
    assert np.isfinite(received.points_m).all()
    np.testing.assert_array_equal(received.columns["ring"], received.columns["source_index"])
    assert drop_lost_returns(sweep) is sweep


def test_returns_that_are_none_and_sweeps_without_intensity() -> None:
    points = some_points(60)
    points[::7] = np.nan
    points[3] = np.inf
    points[5] = [0.0, 0.0, 1.8]  # at the sensor itself
    bad = ~np.isfinite(points).all(1)
    bad[5] = True
    sweep = sweep_of(points, intensity=None)
    out = weathered_sweep(street(), recipe(smog=Smog(visibility_m=40, scale_height_m=50)), 0, sweep)
    assert "intensity" not in out.columns
    assert (out.columns["weather_code"][bad] == UNCHANGED).all()
    np.testing.assert_array_equal(out.points_m[bad], sweep.points_m[bad])
    assert (out.columns["weather_code"] == SCATTERED).any()
    with_gap = np.where(bad, np.nan, 0.4)
    weathered = weathered_sweep(street(), recipe(smog=40, flood=0.1), 0, sweep_of(points, with_gap))
    np.testing.assert_array_equal(np.isnan(weathered.columns["intensity"]), bad)
    empty = weathered_sweep(street(), recipe(smog=40, flood=0.1), 0, sweep_of(np.zeros((0, 3))))
    assert len(empty) == 0 and set(empty.columns) >= ADDED


def test_the_same_in_every_process_and_order() -> None:
    sweep, seeded = sweep_of(some_points(300), 0.2), recipe(smog=40, seed=7)
    first = weathered_sweep(street(), seeded, 0, sweep)
    weathered_sweep(street(), recipe(smog=500), 1, sweep)
    again = weathered_sweep(street(), seeded, 0, sweep)
    assert lidar_bytes(first) == lidar_bytes(again)
    for other in (recipe(smog=40, seed=8), seeded):
        changed = weathered_sweep(street(), other, 1 if other is seeded else 0, sweep)
        assert lidar_bytes(changed) != lidar_bytes(first)
    assert first.columns["x"][:2] == pytest.approx(again.columns["x"][:2], nan_ok=True)


def test_origins_by_default_and_wrong_ones() -> None:
    sweep = sweep_of(some_points(4))
    unknown = street(labels=SensorLabels(None))
    expected = WORLD_ORIGIN_M + np.array([0.0, 0.0, 1.8])
    np.testing.assert_allclose(find_beam_origins(unknown, 0, sweep), np.tile(expected, (4, 1)))

    class Wrong(SensorLabels):
        def lidar_origins(self, frame_index, sweep):
            return np.zeros((1, 3))

    with pytest.raises(ValueError, match=r"must be \[4, 3\].*got \[1, 3\]"):
        find_beam_origins(street(labels=Wrong(None)), 0, sweep)


def _depth_gaps(scene: Scene, camera: Camera, view: WeatheredView, sweep: LidarSweep) -> np.ndarray:
    """How far in front of or behind the depth image the returns on its snow pixels are, metres."""
    pose = camera.camera_from_world.numpy()
    offsets = sweep.points_m - np.asarray(scene.world_origin_m)
    x, y, z = (offsets @ pose[:3, :3].T + pose[:3, 3]).T
    ahead = z > 0.5
    column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    is_in_image = (
        ahead & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    )
    at = row[is_in_image].astype(int), column[is_in_image].astype(int)
    image_depth_m, is_snow = view.depth_m[at], view.masks["snow"][at] == 255
    return np.abs(z[is_in_image] - image_depth_m)[is_snow & (image_depth_m > 0)]


@pytest.mark.long
def test_lidar_agrees_with_depth_under_snow_by_default() -> None:
    scene = open_street(LABELLED_STREET)
    deep = Recipe(weather=Weather(snow=Snow(depth_m=0.2)))
    gaps: dict[bool, list[np.ndarray]] = {True: [], False: []}
    source = scene.lidar(1)
    sweep = drop_lost_returns(weathered_sweep(scene, deep, 1, source))
    for name in ("front", "left"):
        camera = scene.frame(1).cameras[name].scaled(4.0)  # pixels that are small on the road
        view = render_view(scene, camera, deep)
        for is_weathered, returns in ((True, sweep), (False, source)):
            gaps[is_weathered].append(_depth_gaps(scene, camera, view, returns))
    after, before = (np.concatenate(gaps[kind]) for kind in (True, False))
    assert deep.lidar == "weather" and len(after) > 300
    # Beams are flat: a centimetre of height is several of depth. Now 0.06 m, and 0.64 m.
    assert np.median(after) < 0.1 < 0.5 < np.median(before)


@dataclass(frozen=True)
class _Misfit(FakeLabels):
    """Labels whose origins do not fit frame 1."""

    def lidar_origins(self, frame_index, sweep):
        return np.zeros((len(sweep) - (frame_index == 1), 3))


def test_auto_weathers_what_it_can_and_tells_of_the_rest(tmp_path: Path) -> None:
    scene = dataclasses.replace(open_fake("fake:street"), labels=_Misfit())
    wet = make_recipe("wet", flood=Flood(level_m=40, reference="absolute"), depth="none")
    strict = wet.model_copy(update={"output": wet.output.model_copy(update={"lidar": "weather"})})

    def outcome(recipe: Recipe, out: Path, **options) -> tuple[int, dict[int, tuple]]:
        job = RenderJob("fake:street", [recipe], out, cameras=["front"], **options)
        done = run_job(job, scene_loader=lambda _: scene, renderer=fake_render, progress=False)
        rows = read_manifest(out).to_pylist()
        return done.failed, {row["frame"]: (row["lidar"], row["lidar_note"]) for row in rows}

    failed, entries = outcome(wet, tmp_path / "out")
    assert failed == 0 and entries[0] == entries[2] == ("weather", entries[0][1])
    assert entries[3] == (None, None)  # there is no sweep
    kind, note = entries[1]
    assert kind == "clean" and "not in depth or sweeps" in note
    assert re.search(r"no weather on this sweep: ValueError: lidar_origins of _Misfit", note)
    paths = [tmp_path / f"out/street/wet-000/lidar/{n:06d}.parquet" for n in range(3)]
    sweeps = [read_lidar(path) for path in paths]
    assert [set(sweep.columns) >= ADDED for sweep in sweeps] == [True, False, True]
    assert lidar_bytes(sweeps[1]) == lidar_bytes(scene.lidar(1))
    # Sweeps that another run has left say what they are; a damaged one is written anew.
    before = [path.read_bytes() for path in paths]
    for image in (tmp_path / "out/street/wet-000/images/front").iterdir():
        image.unlink()
    paths[2].write_bytes(before[2][:100])
    assert outcome(wet, tmp_path / "out") == (0, entries)
    assert [path.read_bytes() for path in paths] == before
    failed, entries = outcome(strict, tmp_path / "strict")
    assert failed == 1 and entries[1] == (None, None) and entries[0][0] == "weather"
    with pytest.raises(OutputError, match="recipe hash there"):
        outcome(strict, tmp_path / "out")


MODEL = LidarModel()


@pytest.mark.parametrize(
    ("visibility_km", "expected"),
    [(0.05, 1.0), (0.5, 1.0), (1.0, 0.779), (6.0, 0.523), (20.0, 0.523), (60.0, 0.451)],
)
def test_kims_factor(visibility_km: float, expected: float) -> None:
    """The table's values by hand: (0.905 / 0.55)^-q, q = 0, 0, 0.5, 1.3, 1.3, 1.6."""
    factor = wavelength_factor(KOSCHMIEDER / (1000 * visibility_km))
    assert factor == pytest.approx(expected, abs=1e-3)
    assert wavelength_factor(0.0) == 1.0


def test_intensities_fall_by_two_ways() -> None:
    points = some_points()
    sweep = sweep_of(points, intensity=0.5)
    out = weathered_sweep(street(), recipe(smog=Smog(extinction_per_m=0.01)), 0, sweep)
    code = out.columns["weather_code"]
    is_attenuated = code == ATTENUATED
    assert is_attenuated.all(), "nothing is near the noise yet"
    expected = 0.5 * np.exp(-2 * 0.01 * ranges_of(sweep))
    np.testing.assert_allclose(
        out.columns["intensity"][is_attenuated], expected[is_attenuated], rtol=1e-5
    )
    assert (out.points_m[is_attenuated] == sweep.points_m[is_attenuated]).all()


def test_a_beam_loses_what_droplets_diffract() -> None:
    """A LiDAR's beam is as narrow as a transmissometer's: `mor_m` gives its extinction."""
    sweep = sweep_of(some_points(), intensity=0.5)
    by_range, by_extinction = (
        weathered_sweep(street(), recipe(smog=smog), 0, sweep).columns["intensity"]
        for smog in (
            Smog(mor_m=300.0, scatter=0.5),
            Smog(extinction_per_m=math.log(20) / 300, scatter=0.0),
        )
    )
    np.testing.assert_allclose(by_range, by_extinction, rtol=1e-6)


@pytest.mark.parametrize("alpha", [0.002, 0.06, 0.5])
def test_the_soft_echo_is_the_integral(alpha: float) -> None:
    w = MODEL.pulse_m
    beta = 0.046 * alpha / math.log(20)

    def echo(reported: float) -> float:
        def integrand(r: float) -> float:
            x = reported + w - r
            overlap = min(max((r - 0.9) / 0.1, 0.0), 1.0)
            return (
                beta
                * math.sin(math.pi * x / (2 * w)) ** 2
                * math.exp(-2 * alpha * r)
                * overlap
                / r**2
            )

        low, high = max(reported - w, 0.9), reported + w
        return quad(integrand, low, high, points=[min(max(1.0, low), high)], epsabs=0, limit=200)[0]

    at = np.array([0.95, 1.3, 1.8, 2.5, 4.0, 8.0])
    exact = np.array([echo(float(r)) for r in at])
    # The midpoint rule steps 2 cm through an overlap that rises within 10.
    np.testing.assert_allclose(soft_response(alpha, at, MODEL), exact, rtol=5e-3)
    fine = np.arange(0.9, 6, 0.01)
    peak = fine[np.argmax([echo(float(r)) for r in fine])]
    table = soft_echo(alpha, MODEL)
    assert table.ranges_m[table.signal.argmax()] == pytest.approx(peak, abs=0.04)


def test_denser_smog_leaves_less() -> None:
    sweep = sweep_of(some_points(1500), intensity=np.linspace(0, 1, 1500))
    scene = street()
    attenuated_masks, bright, unchanged = [], [], []
    for visibility_m in (5000, 1000, 300, 100, 50, 20, 5):
        out = weathered_sweep(scene, recipe(smog=visibility_m), 0, sweep)
        code = out.columns["weather_code"]
        attenuated_masks.append(code == ATTENUATED)
        unchanged.append(code == UNCHANGED)
        bright.append(np.where(attenuated_masks[-1], out.columns["intensity"], 0))
    for thin, dense in itertools.pairwise(unchanged):
        assert not (dense & ~thin).any()
    for (thin, dense), (lit, dim) in zip(
        itertools.pairwise(attenuated_masks), itertools.pairwise(bright), strict=True
    ):
        assert not (dense & ~thin & ~unchanged[0]).any()
        assert (dim[dense & thin] <= lit[dense & thin]).all()


SNOW = Snow(depth_m=0.1)
FLAT = cells_on_grid(np.zeros((200, 60)), 0.1, corner_m=(0.0, -3.0))


@pytest.fixture(scope="module")
def scene():
    """A street whose support is known: no test here draws it from above."""
    car = box_car(start=(4.0, 3.0), moved_m=3.0)
    opened = street(actors=(car,))
    roof = cells_on_grid(np.full((40, 18), 0.75), 0.1, corner_m=(-2.0, -0.9))
    support = ExposedSurface(ground=FLAT, actors={"car": roof})
    memo_of(opened).put(("exposed surface", exposure_settings(SNOW, opened)), support)
    return opened


def meets(cells: ExposedCells, depths: np.ndarray | float, points: np.ndarray) -> np.ndarray:
    """Return the points where beams end on a layer of snow, [N, 3]."""
    layer = make_snow_grid(cells, np.broadcast_to(np.float32(depths), len(cells)).copy())
    snow = LidarSnow(layer, {}, 0.8)
    origins, directions, ends = beams(points)
    hits = intersect_layers(snow, street(), sweep_of(points), 0, origins, directions, ends)
    assert (hits <= ends).all()
    return origins + hits[:, None] * directions


def test_level_snow_is_met_at_its_top() -> None:
    points = ground_points(np.linspace(1, 19, 300))
    points_on_snow = meets(FLAT, 0.1, points)
    np.testing.assert_allclose(points_on_snow[:, 2], 0.1, atol=1e-6)  # cells are float32
    expected = SENSOR_M[0] + (points[:, 0] - SENSOR_M[0]) * (1.7 / 1.8)
    np.testing.assert_allclose(points_on_snow[:, 0], expected, atol=1e-5)


@settings(max_examples=12, deadline=None, derandomize=True)
@given(st.integers(0, 10**6), st.floats(0.0, 3.0), st.floats(1.0, 4.0))
def test_the_march_is_what_a_search_in_small_steps_finds(seed: int, depth: float, deeper: float):
    """Against the definition, along each beam; and deeper snow never lets a beam go farther."""
    rng = np.random.default_rng(seed)
    ground = rng.uniform(0, 0.2, (30, 20))
    ground[rng.random((30, 20)) < 0.1] = np.nan
    cells = cells_on_grid(ground, 0.5, corner_m=(0.5, -5.0))
    depths = (depth * rng.random(len(cells)) * (rng.random(len(cells)) < 0.8)).astype(np.float32)
    points = np.column_stack(
        [rng.uniform(1, 16, 12), rng.uniform(-5, 5, 12), rng.uniform(0, 3, 12)]
    )
    layer = make_snow_grid(cells, depths, grid_m=0.5)
    if layer is None:
        return
    origins, directions, ends = beams(points)
    shallow = intersect_layers(
        LidarSnow(layer, {}, 1.0), street(), sweep_of(points), 0, origins, directions, ends
    )
    steps = np.arange(0.3, 20, 5e-3)
    at = origins[:, None] + steps[:, None] * directions[:, None]
    index = np.floor((at[..., :2] - layer.corner) / layer.cell_m).astype(int)
    rows, columns = layer.base.shape
    inside = ((index >= 0) & (index < [columns, rows])).all(-1)
    row, column = np.clip(index[..., 1], 0, rows - 1), np.clip(index[..., 0], 0, columns - 1)
    low, high = layer.base[row, column] - GROUND_SLACK_M, layer.top[row, column]
    within = inside & (at[..., 2] >= low) & (at[..., 2] <= high) & (steps < ends[:, None])
    first = np.where(within.any(1), steps[within.argmax(1)], ends)
    entered = directions[:, 2] < 0  # a step from below may be taken for one from a side
    # A beam may clip a corner by less than a step, which the search does not see.
    assert (shallow[entered] <= first[entered] + 1e-6).all()
    assert (np.abs(shallow - first)[entered] < 1e-2).mean() > 0.8
    deep = make_snow_grid(cells, deeper * depths, grid_m=0.5)
    hits = intersect_layers(
        LidarSnow(deep, {}, 1.0), street(), sweep_of(points), 0, origins, directions, ends
    )
    assert (hits <= shallow + 1e-6).all()


def test_the_layer_is_that_of_the_images(scene) -> None:
    recipe_snow = SnowPlan(SNOW, seed=0)
    top = find_lidar_snow(scene, recipe_snow).ground.top
    means = build_snow_layers(scene, recipe_snow).ground.gaussians.means.numpy()
    covered = np.isfinite(top)
    # A splat's middle lies a centimetre inside the layer whose surface it shows.
    assert np.median(top[covered]) == pytest.approx(np.median(means[:, 2]), abs=0.02)
    layer = find_lidar_snow(scene, recipe_snow).ground
    index = np.floor((means[:, :2] - layer.corner) / layer.cell_m).astype(int)
    near = top[np.clip(index[:, 1], 0, top.shape[0] - 1), np.clip(index[:, 0], 0, top.shape[1] - 1)]
    # Drifts are centimetres high and metres long: with another seed they would not agree.
    rises = np.corrcoef(near[np.isfinite(near)], means[np.isfinite(near), 2])[0, 1]
    assert rises > 0.9


def test_a_sweep_in_the_snow(scene) -> None:
    points = ground_points(np.linspace(1, 19, 200))
    points[:, 1] = np.linspace(-2.5, 2.5, 200)
    sweep = sweep_of(points, intensity=0.1)
    out = weathered_sweep(scene, recipe(snow=SNOW), 0, sweep)
    code = out.columns["weather_code"]
    assert (code == MOVED).mean() > 0.9
    moved = code == MOVED
    assert (ranges_of(out)[moved] < ranges_of(sweep)[moved]).all()
    before = sweep.points_m[moved] - WORLD_ORIGIN_M - SENSOR_M
    after = out.points_m[moved] - WORLD_ORIGIN_M - SENSOR_M
    assert np.linalg.norm(np.cross(before, after), axis=1).max() < 1e-6
    # Level snow at a slant of theta gives back 0.79 cos(theta).
    slant = -before[:, 2] / np.linalg.norm(before, axis=1)
    np.testing.assert_allclose(
        out.columns["intensity"][moved], 0.93 * 0.85 * np.maximum(slant, 0.02), rtol=1e-5
    )


def test_snow_rides_on_a_car_as_its_returns_say_when(scene) -> None:
    """At 0 s the car stands at x = 4, 0.1 s later at 7: its returns are of 0.1 s."""
    points = np.array([[8.5, 3.0, 1.575], [8.4, 3.2, 1.575], [8.3, 2.8, 1.575]])
    late = sweep_of(points, timestamp_ns=np.full(3, 100_000_000))
    out = weathered_sweep(scene, recipe(snow=SNOW), 0, late)
    assert (out.columns["weather_code"] == MOVED).all()
    assert (out.points_m[:, 2] - WORLD_ORIGIN_M[2] > 1.53).all()
    gone = sweep_of(points, timestamp_ns=np.zeros(3, np.int64))
    still = weathered_sweep(scene, recipe(snow=SNOW), 0, gone)
    assert (still.columns["weather_code"] == UNCHANGED).all()


CLEAR = Flood(level_m=0.02, reference="absolute", turbidity_ntu=0)


def medium(level_m: float = 0.02, extinction: float = 0.34, index: float = 1.333) -> FloodMedium:
    return FloodMedium(
        level_z_m=level_m,
        extinction_per_m=(extinction, 0.06, 0.01),
        rgb=(0.4, 0.4, 0.3),
        waves=make_waves(Waves(preset="still"), seed=0, depth_m=1.0),
        refraction_index=index,
    )


def test_a_shallow_bed_by_hand() -> None:
    """Straight down through 2 cm: 1 - F = 0.98, exp(-2 7.5 0.02), and 2 cm of water as 2.7."""
    water_echo = meet_water(medium(), *beams(np.array([[0.0, 0.0, 0.0]])), np.array([0.3]))
    transmitted = 1 - ((1.333 - 1) / (1.333 + 1)) ** 2
    assert water_echo.bed_gain[0] == pytest.approx(
        transmitted**2 * math.exp(-0.04 * ABSORPTION_905_PER_M)
    )
    assert water_echo.range_m[0] == pytest.approx(1.78 + 1.333 * 0.02)
    assert water_echo.surface_m[0] == pytest.approx(1.78) and water_echo.is_bed[0]


def test_a_slanted_beam_bends() -> None:
    """45 degrees: asin(sin 45 / n) below, so 2 cm take 2 cm / cos of that."""
    water_echo = meet_water(medium(), *beams(np.array([[1.8, 0.0, 0.0]])), np.array([0.3]))
    below = math.asin(math.sin(math.pi / 4) / 1.333)
    expected = 1.78 * math.sqrt(2) + 1.333 * 0.02 / math.cos(below)
    assert water_echo.range_m[0] == pytest.approx(expected, abs=1e-9)


def test_a_clear_flood_shows_its_bed_near_the_car_and_nothing_farther() -> None:
    distances = np.linspace(1, 60, 200)
    sweep = sweep_of(ground_points(distances), intensity=0.2)
    out = weathered_sweep(street(), recipe(flood=CLEAR), 0, sweep)
    code = out.columns["weather_code"]
    assert code[0] == MOVED and code[-1] == LOST
    assert SCATTERED not in code and UNCHANGED not in code
    moved = code != LOST
    assert (np.diff(moved.astype(int)) <= 0).all(), "once lost, farther is lost, too"
    assert (out.columns["intensity"][moved] < 0.2).all()
    # Slower light makes it seem deeper straight below, bent beams less deep at a slant.
    rises = out.points_m[moved][:, 2] - sweep.points_m[moved][:, 2]
    slanted = distances[moved] > 3
    assert rises[0] < 0 and slanted.any() and (rises[slanted] > 0).all()


def test_a_drowned_sensor_sees_nothing() -> None:
    sweep = sweep_of(some_points(50), intensity=0.2)
    out = weathered_sweep(street(), recipe(flood=2.0), 0, sweep)
    assert (out.columns["weather_code"] == LOST).all()


def test_more_water_never_leaves_more() -> None:
    sweep = sweep_of(some_points(800), intensity=0.3)
    scene = street()
    before = np.ones(800, bool)
    for level_m in (0.001, 0.01, 0.1, 0.5, 1.5, 1.79, 1.81, 5.0):
        out = weathered_sweep(scene, recipe(flood=level_m), 0, sweep)
        unchanged = out.columns["weather_code"] == UNCHANGED
        assert not (unchanged & ~before).any()
        before = unchanged
