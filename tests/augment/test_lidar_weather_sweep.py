"""Weathered sweeps as a whole: what stays to the bit, codes, jobs."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from batch_scenes import FakeLabels, fake_render, make_recipe, open_fake

from augment.cameras import Camera
from augment.effects.lidar import LOST, MOVED, SCATTERED, UNCHANGED, drop_lost
from augment.effects.lidar.beam import origins_of
from augment.effects.lidar.sweep import weathered_sweep
from augment.errors import OutputError
from augment.jobs.manifest import read_manifest
from augment.jobs.render_job import RenderJob, run_job
from augment.jobs.tables import lidar_bytes, read_lidar
from augment.labels import LidarSweep
from augment.scene import Scene
from augment.views import WeatheredView, render_view
from recipes.flood import Flood
from recipes.schema import Recipe, Smog, Weather
from recipes.snow import Snow
from tests.lidar_sweeps import WORLD_ORIGIN_M, SensorLabels, recipe, some_points, street, sweep_of
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
    kept = drop_lost(out)
    assert len(kept) == (code != LOST).sum() < 500
    assert np.isfinite(kept.points_m).all()
    np.testing.assert_array_equal(kept.columns["ring"], kept.columns["source_index"])
    assert drop_lost(sweep) is sweep


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
    shown = weathered_sweep(street(), recipe(smog=40, flood=0.1), 0, sweep_of(points, with_gap))
    np.testing.assert_array_equal(np.isnan(shown.columns["intensity"]), bad)
    empty = weathered_sweep(street(), recipe(smog=40, flood=0.1), 0, sweep_of(np.zeros((0, 3))))
    assert len(empty) == 0 and set(empty.columns) >= ADDED


def test_coordinates_of_whole_numbers() -> None:
    columns = {name: np.arange(30, dtype=np.int32) * 3 for name in "xyz"}
    scene = street(labels=SensorLabels((0.0, 0.0, 0.0)))
    out = weathered_sweep(scene, recipe(smog=10), 0, LidarSweep(columns))
    assert out.columns["weather_code"].any()
    assert {out.columns[name].dtype for name in "xyz"} == {np.dtype(np.float64)}


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


def test_weather_twice_is_refused() -> None:
    out = weathered_sweep(street(), recipe(smog=100), 0, sweep_of(some_points(5)))
    with pytest.raises(ValueError, match="'weather_code' already"):
        weathered_sweep(street(), recipe(smog=100), 0, out)


def test_origins_by_default_and_wrong_ones() -> None:
    sweep = sweep_of(some_points(4))
    unknown = street(labels=SensorLabels(None))
    expected = WORLD_ORIGIN_M + np.array([0.0, 0.0, 1.8])
    np.testing.assert_allclose(origins_of(unknown, 0, sweep), np.tile(expected, (4, 1)))

    class Wrong(SensorLabels):
        def lidar_origins(self, frame_index, sweep):
            return np.zeros((1, 3))

    with pytest.raises(ValueError, match=r"must be \[4, 3\].*got \[1, 3\]"):
        origins_of(street(labels=Wrong(None)), 0, sweep)


def _depth_gaps(scene: Scene, camera: Camera, view: WeatheredView, sweep: LidarSweep) -> np.ndarray:
    """How far in front of or behind the depth image the returns on its snow pixels are, metres."""
    pose = camera.camera_from_world.numpy()
    offsets = sweep.points_m - np.asarray(scene.world_origin_m)
    x, y, z = (offsets @ pose[:3, :3].T + pose[:3, 3]).T
    ahead = z > 0.5
    column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    seen = ahead & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    at = row[seen].astype(int), column[seen].astype(int)
    shown, is_snow = view.depth_m[at], view.masks["snow"][at] == 255
    return np.abs(z[seen] - shown)[is_snow & (shown > 0)]


@pytest.mark.long
def test_lidar_agrees_with_depth_under_snow_by_default() -> None:
    scene = open_street(LABELLED_STREET)
    deep = Recipe(weather=Weather(snow=Snow(depth_m=0.2)))
    gaps: dict[bool, list[np.ndarray]] = {True: [], False: []}
    source = scene.lidar(1)
    sweep = drop_lost(weathered_sweep(scene, deep, 1, source))
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

    failed, shown = outcome(wet, tmp_path / "out")
    assert failed == 0 and shown[0] == shown[2] == ("weather", shown[0][1])
    assert shown[3] == (None, None)  # there is no sweep
    kind, note = shown[1]
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
    assert outcome(wet, tmp_path / "out") == (0, shown)
    assert [path.read_bytes() for path in paths] == before
    failed, shown = outcome(strict, tmp_path / "strict")
    assert failed == 1 and shown[1] == (None, None) and shown[0][0] == "weather"
    with pytest.raises(OutputError, match="recipe hash there"):
        outcome(strict, tmp_path / "out")
