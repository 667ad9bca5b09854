"""Open to the sky: cells over scenes whose surfaces are known, and the files that keep them."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from augment.effects.snow.plan import exposure_settings, naming_cell_field
from augment.effects.wet.ground_map import refusing_cell_size
from augment.errors import OutputError, SceneError
from augment.exposure.cells import (
    FLUSH,
    MAX_EDGE_DISTANCE_M,
    OPEN_EDGE,
    ExposedCells,
    ExposedSurface,
)
from augment.exposure.exposed_surface import (
    FORMAT,
    exposed_surface_key,
    exposed_surface_of,
    load_exposed_surface,
    save_exposed_surface,
)
from augment.exposure.search import ExposureSettings, find_exposed_surface
from augment.exposure.surface import is_vehicle
from augment.exposure.tiles import TooManyCellsError
from augment.exposure.wheel_tracks import EGO_WIDTH_M, WHEEL_OFFSET_SHARE, find_wheel_paths
from augment.render.threads import limit_threads
from augment.scene.labels import EGO_VEHICLE
from augment.scene.scene import Gaussians, Scene, Track
from augment.scene.semantics import SemanticClass
from augment.timing import PassProgress, watched
from recipes.snow import Snow
from tests.scenes import one_gaussian, stack
from tests.snow_scenes import box_car, cameras_of, drive, sheet, side_wall, wall

COARSE = ExposureSettings(cell_m=0.1)
GROUND = sheet((-6, 20), (-8, 8))
LEFT, RIGHT, BACK, FRONT = range(4)


def place(scene: Scene, settings: ExposureSettings = COARSE) -> ExposedSurface:
    bed = find_exposed_surface(scene, cameras_of(scene), settings)
    check_cells(bed.ground, len(scene.background))
    for actor in scene.actors:
        if actor.track_id in bed.actors:
            check_cells(bed.actors[actor.track_id], len(actor.gaussians))
    return bed


def check_cells(cells: ExposedCells, gaussians: int) -> None:
    """Check the rules that the cells of every scene keep."""
    count = len(cells)
    for field in dataclasses.fields(ExposedCells):
        values = getattr(cells, field.name)
        assert bool(torch.isfinite(values.double()).all()), field.name
        if field.name not in ("hideable_ids", "covering_cells"):
            assert len(values) == count, field.name
    np.testing.assert_allclose(cells.normals.norm(dim=1), 1, atol=1e-5)
    assert bool((cells.normals[:, 2] > 0).all())
    assert bool((cells.edge_distance_m >= 0.499 * cells.sizes_m).all())
    assert bool(
        (
            cells.edge_distance_m <= torch.clamp(cells.sizes_m / 2, min=MAX_EDGE_DISTANCE_M) + 1e-5
        ).all()
    )
    assert bool(((cells.relative_light >= 0.25) & (cells.relative_light <= 1.5)).all())
    assert bool(((cells.track_share >= 0) & (cells.track_share <= 1)).all())
    assert bool((cells.obstacle_vectors.norm(dim=1) <= 1 + 1e-5).all())
    check_neighbours(cells)
    assert tuple(cells.covering_cells.shape) == (len(cells.hideable_ids), 5)
    if len(cells.hideable_ids):
        assert 0 <= int(cells.hideable_ids.min()) <= int(cells.hideable_ids.max()) < gaussians
        assert 0 <= int(cells.covering_cells.min()) <= int(cells.covering_cells.max()) < count
        assert len(cells.hideable_ids.unique()) == len(cells.hideable_ids)


def check_neighbours(cells: ExposedCells) -> None:
    """Every link leads one cell aside, to a cell of the same size that links back."""
    steps = torch.tensor([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])
    for side, step in enumerate(steps):
        to = cells.neighbours[:, side].long()
        assert bool((to >= FLUSH).all())
        here = torch.nonzero(to >= 0)[:, 0]
        there = to[here]
        assert bool((cells.neighbours[there, side ^ 1].long() == here).all())
        assert bool((cells.sizes_m[there] == cells.sizes_m[here]).all())
        moved = cells.centers_m[there, :2] - cells.centers_m[here, :2]
        expected = step * cells.sizes_m[here, None]
        rounding = 1e-4 + 1.3e-7 * float(cells.centers_m.abs().amax()) if len(here) else 0.0
        np.testing.assert_allclose(moved, expected, atol=rounding)


def under(cells: ExposedCells, x: float, y: float) -> int:
    """The number of the cell under a point, -1 where there is none."""
    gap = (cells.centers_m[:, :2] - torch.tensor([x, y])).abs().amax(1)
    found = torch.nonzero(gap <= cells.sizes_m / 2 + 1e-6)[:, 0]
    return int(found[0]) if len(found) else -1


def within(cells: ExposedCells, x: tuple[float, float], y: tuple[float, float]) -> torch.Tensor:
    px, py = cells.centers_m[:, 0], cells.centers_m[:, 1]
    return (px > x[0]) & (px < x[1]) & (py > y[0]) & (py < y[1])


@pytest.fixture(scope="module")
def flat_ground() -> tuple[Scene, ExposedSurface]:
    scene = drive(GROUND)
    return scene, place(scene)


def test_level_ground_ahead_is_covered_once(flat_ground) -> None:
    cells = flat_ground[1].ground
    chosen = within(cells, (4, 12), (-2, 2))
    area = float((cells.sizes_m[chosen] ** 2).sum())
    assert area == pytest.approx(32, rel=0.03)  # up to a row of cells at its border
    lowest = float(cells.centers_m[chosen, 2].abs().max())
    assert lowest < 0.005
    assert float(cells.normals[chosen, 2].min()) > 0.999
    np.testing.assert_allclose(cells.relative_light[chosen], 1, atol=0.02)
    assert float(cells.edge_distance_m[chosen].min()) == MAX_EDGE_DISTANCE_M


def test_bits_do_not_depend_on_threads_or_on_who_watches(flat_ground) -> None:
    scene, bed = flat_ground
    limit_threads(2)
    told = list[PassProgress]()
    with watched(told.append):
        together = find_exposed_surface(scene, cameras_of(scene), COARSE)
    assert_equal(together, bed)
    total = told[0].num_steps
    assert [progress.num_done for progress in told] == [*range(total + 1)] and total > 1
    assert {progress.name for progress in told} == {"finding exposed surfaces"}


def test_a_platform_has_open_edges_and_the_ground_beside_it_none() -> None:
    platform = sheet((6, 8), (-1, 1), 0.6)
    sides = [side_wall(y, (6, 8), (0, 0.6)) for y in (-1, 1)]
    scene = drive(GROUND, platform, wall(6, (-1, 1), (0, 0.6)), *sides)
    cells = place(scene).ground
    top, foot = under(cells, 7.0, 0.05), under(cells, 5.65, 0.05)
    assert float(cells.centers_m[top, 2]) == pytest.approx(0.6, abs=0.01)
    # Splats reach half their size beyond the edge that their centres end at.
    assert float(cells.edge_distance_m[top]) == pytest.approx(1.0, abs=0.25)
    assert float(cells.edge_distance_m[foot]) > 1.5
    raised = torch.nonzero(cells.centers_m[:, 2] > 0.5)[:, 0]
    borders = (cells.neighbours[raised] == OPEN_EDGE).any(1)
    assert bool(borders.any())
    assert float(cells.edge_distance_m[raised][borders].max()) <= 0.5 * 0.1 + 1e-5
    assert bool((cells.obstacle_vectors[raised] == 0).all())
    bank = cells.obstacle_vectors[foot]
    assert float(bank[0]) > 0.3 and abs(float(bank[1])) < 0.1  # towards +x, where it stands
    assert float(cells.obstacle_vectors[under(cells, 3.5, 0.05)].norm()) < 0.01
    low = torch.nonzero(within(cells, (5.2, 6.2), (-0.7, 0.7)) & (cells.centers_m[:, 2] < 0.1))
    assert not bool((cells.neighbours[low[:, 0], RIGHT] == OPEN_EDGE).any())


@pytest.mark.parametrize(
    ("slope", "limit", "cell_m", "expected"),
    [(30.0, 50.0, 0.05, 1), (60.0, 50.0, 0.05, 0), (30.0, 20.0, 0.4, 0)],
)
def test_the_slope_decides(slope: float, limit: float, cell_m: float, expected: int) -> None:
    ramp = sheet((5, 10), (-3, 3), slope_deg=slope)
    settings = ExposureSettings(cell_m=cell_m, max_slope_deg=limit)
    cells = place(drive(ramp), settings).ground
    inside = within(cells, (6, 9), (-2, 2))
    assert bool(inside.any()) == bool(expected)
    if expected:
        tilt = torch.rad2deg(torch.atan2(-cells.normals[inside, 0], cells.normals[inside, 2]))
        np.testing.assert_allclose(tilt.median(), slope, atol=2)
        rise = math.tan(math.radians(slope)) * (cells.centers_m[inside, 0] - 5)
        np.testing.assert_allclose(cells.centers_m[inside, 2], rise, atol=0.06)


def test_nothing_lies_under_a_canopy() -> None:
    canopy = sheet((6, 9), (-3, 3), 4.0)
    cells = place(drive(GROUND, canopy)).ground
    below = within(cells, (6.2, 8.8), (-2.8, 2.8)) & (cells.centers_m[:, 2] < 3.9)
    assert not bool(below.any())
    assert bool(within(cells, (3, 5.5), (-1, 1)).any())
    assert bool(within(cells, (10, 13), (-1, 1)).any())


def test_cells_that_would_take_too_much_memory_are_refused_at_once() -> None:
    """The caller adds the recipe's field."""
    scene = drive(GROUND)
    refused = r"0\.001 m would take [\d,]+ million cells.* GB.*or fewer frames"
    with pytest.raises(TooManyCellsError, match=refused):
        find_exposed_surface(scene, cameras_of(scene), ExposureSettings(cell_m=0.001))
    with pytest.raises(SceneError, match=refused + "; weather.snow.cell_m"), naming_cell_field():
        exposed_surface_of(scene, ExposureSettings(cell_m=0.001))
    with pytest.raises(SceneError, match=refused + "; weather.rain has no"), refusing_cell_size():
        exposed_surface_of(scene, ExposureSettings(cell_m=0.001))


def test_unknown_scale_or_gravity_and_wrong_settings_are_refused(unchecked) -> None:
    for unknown in ("has_metric_scale", "has_known_gravity"):
        scene = drive(GROUND, **{unknown: False})
        with pytest.raises(SceneError, match="not known"):
            find_exposed_surface(scene, cameras_of(scene), COARSE)
    wrong = [("cell_m", 0.0), ("cell_m", math.nan), ("max_slope_deg", 90.0), ("estimator", "mean")]
    for name, value in wrong:
        with pytest.raises(ValueError, match=name):
            ExposureSettings(**{name: value})


def hole_at(ground: Gaussians, x: float, y: float, radius: float) -> Gaussians:
    """The ground without its splats about a place."""
    return ground.select((ground.means[:, :2] - torch.tensor([x, y])).norm(dim=1) > radius)


@pytest.mark.parametrize(
    ("x", "y", "radius", "expected"),
    [(2.0, 0.0, 2.5, True), (9.0, 5.0, 1.2, True), (9.0, 0.0, 2.5, False)],
)
def test_holes_under_the_path_and_small_ones_are_closed(
    x: float, y: float, radius: float, expected: bool
) -> None:
    ground = hole_at(sheet((-6, 20), (-9, 9), slope_deg=3.0), x, y, radius)
    cells = place(drive(ground, places=[(0.0, 0.0, 2.0), (3.0, 0.0, 2.0)])).ground
    size = radius / 2
    inside = within(cells, (max(x - size, 2.5), x + size), (y - size, y + size))
    assert bool(inside.any()) == expected
    if expected:
        rise = math.tan(math.radians(3)) * (cells.centers_m[inside, 0] + 6)
        np.testing.assert_allclose(cells.centers_m[inside, 2], rise, atol=0.03)
        area = float((cells.sizes_m[inside] ** 2).sum())
        assert area == pytest.approx((x + size - max(x - size, 2.5)) * 2 * size, rel=0.15)
        np.testing.assert_allclose(cells.relative_light[inside], 1, atol=0.1)


@pytest.mark.long
@pytest.mark.parametrize("cell_m", [0.05, 0.4])
def test_wires_and_boards_on_edge_are_not_exposed(cell_m: float) -> None:
    x = torch.linspace(6, 9, 40)
    wire = one_gaussian(mean=(0.0, 0.0, 5.0), scale=(0.08, 0.01, 0.01), opacity=0.99)
    wire = stack(*(dataclasses.replace(wire, means=torch.tensor([[v, 0.5, 5.0]])) for v in x))
    board = [wall(10 + 0.02 * i, (-3, -1), (1.0, 3.0)) for i in range(3)]
    cells = place(drive(GROUND, wire, *board), ExposureSettings(cell_m=cell_m)).ground
    assert float(cells.centers_m[:, 2].max()) < 0.1
    assert bool(within(cells, (6.5, 8.5), (-0.2, 1.2)).any())


def test_long_narrow_tops_high_up_carry_nothing() -> None:
    """A beam of half a metre is bare however long it is; a roof of two metres is not."""
    beam, roof = sheet((4, 14), (-3.25, -2.75), 4.0), sheet((4, 14), (1, 3), 4.0)
    cells = place(drive(GROUND, beam, roof)).ground
    high = cells.centers_m[:, 2] > 3
    assert not bool((high & (cells.centers_m[:, 1] < 0)).any())
    assert float((cells.sizes_m[high] ** 2).sum()) > 5  # what of it the camera sees


def test_what_is_too_narrow_for_snow_has_none_by_its_class() -> None:
    top = sheet((6, 8), (-1, 1), 0.5, semantic=SemanticClass.POLE)
    ground = sheet((-6, 20), (-8, 8), semantic=SemanticClass.ROAD)
    cells = place(drive(ground, top)).ground
    assert not bool((cells.centers_m[:, 2] > 0.4).any())


def test_foliage_stands_over_the_ground_and_grass_does_not() -> None:
    green = SemanticClass.VEGETATION
    parts = [
        sheet((-6, 20), (-8, 8), semantic=SemanticClass.ROAD),
        sheet((5, 8), (-2, 2), 1.2, semantic=green),
        sheet((5.5, 5.7), (-0.1, 0.1), 1.25, semantic=SemanticClass.OTHER),  # a crown's own noise
        sheet((10, 13), (-2, 2), 0.2, semantic=green),
    ]
    cells = place(drive(*parts)).ground
    crown = within(cells, (5.4, 7.6), (-1.6, 1.6)) & (cells.centers_m[:, 2] > 1)
    grass = within(cells, (10.4, 12.6), (-1.6, 1.6)) & (cells.centers_m[:, 2] > 0.1)
    assert bool(crown.any()) and bool((cells.semantic[crown] == green).all())
    assert bool(grass.any()) and bool((cells.semantic[grass] == SemanticClass.TERRAIN).all())


@pytest.mark.parametrize(("slope", "expected"), [(15.0, True), (45.0, False)])
def test_vehicles_carry_snow_on_what_is_level_alone(slope: float, expected: bool) -> None:
    """45 degrees are below the recipe's limit, which holds for roofs of houses."""
    for semantic, carries in ((SemanticClass.VEHICLE, expected), (SemanticClass.BUILDING, True)):
        ramp = sheet((5, 8), (-2, 2), slope_deg=slope, semantic=semantic)
        cells = place(drive(ramp), ExposureSettings(cell_m=0.05)).ground
        assert bool(within(cells, (5.5, 7.5), (-1.5, 1.5)).any()) == carries, semantic


def test_slivers_and_shells_of_a_vehicle_carry_nothing() -> None:
    """Strips of 15 cm at a door's height, and a gap in the roof that lies 20 cm deeper."""
    car = box_car(size=(4.0, 1.8, 1.5))
    shell = car.gaussians
    gap = (shell.means[:, 0].abs() < 0.1) & (shell.means[:, 2] > 0.7)
    lower = shell.means - 0.2 * torch.tensor([0.0, 0.0, 1.0]) * gap[:, None]
    sill = sheet((-1.5, 1.5), (0.9, 1.05), 0.2)
    parts = stack(dataclasses.replace(shell, means=lower), sill)
    bed = place(drive(GROUND, actors=[dataclasses.replace(car, gaussians=parts)]))
    z = bed.actors["car"].centers_m[:, 2]
    assert float(z.min()) > 0.65 and float(z.max()) < 0.8


def test_the_ground_is_buried_and_walls_are_not() -> None:
    platform, front = sheet((6, 8), (-1, 1), 0.6), wall(6, (-1, 1), (0, 0.6))
    scene = drive(GROUND, platform, front)
    cells = place(scene).ground
    hidden = torch.zeros(len(scene.background), dtype=torch.bool)
    hidden[cells.hideable_ids.long()] = True
    first_wall = len(GROUND) + len(platform)
    assert not bool(hidden[first_wall:].any())
    means = scene.background.means
    ahead = (means[:, 0] > 3) & (means[:, 0] < 5) & (means[:, 1].abs() < 1)
    assert bool(hidden[ahead].all())
    behind = means[:, 0] < 0
    assert not bool(hidden[behind].any())
    inner = (means[:, 0] > 6.4) & (means[:, 0] < 7.6) & (means[:, 1].abs() < 0.5)
    on_top = inner & (means[:, 2] > 0.5)
    assert bool(hidden[on_top].all())
    assert not bool(hidden[inner & (means[:, 2] < 0.05)].any())  # the ground below is deeper


def test_wheel_tracks_are_those_of_a_recorded_drive() -> None:
    recorded = drive(GROUND)
    y_m = [float(path.points_m[:, 1].mean()) for path in find_wheel_paths(recorded)]
    assert len(y_m) == 1
    invented = dataclasses.replace(recorded, seen_frames=())
    assert find_wheel_paths(invented) == ()
    assert len(find_wheel_paths(invented, has_path_without_drive=True)) == 1
    aside = torch.eye(4, dtype=torch.float64)
    aside[1, 3] = 3.0
    frames = tuple(
        dataclasses.replace(frame, world_from_ego=aside @ frame.world_from_ego)
        for frame in recorded.frames
    )
    on_path = dataclasses.replace(recorded, frames=frames, seen_frames=recorded.frames)
    assert [float(path.points_m[:, 1].mean()) for path in find_wheel_paths(on_path)] == y_m
    for tracks, expected in (("auto", False), ("always", True)):
        settings = exposure_settings(Snow(depth_m=0.1, tracks=tracks), invented)
        assert settings.has_tracks_without_drive == expected
        on_drive = exposure_settings(Snow(depth_m=0.1, tracks=tracks), recorded)
        assert not on_drive.has_tracks_without_drive


def test_wheels_leave_tracks_beside_the_path() -> None:
    scene = drive(sheet((-6, 30), (-8, 8)), places=[(x, 0.0, 1.5) for x in (0.0, 2.0, 4.0)])
    cells = place(scene, ExposureSettings(cell_m=0.05)).ground
    wheels = WHEEL_OFFSET_SHARE * EGO_WIDTH_M
    for x in (6.0, 12.0):
        for y in (wheels, -wheels):
            assert float(cells.track_share[under(cells, x, y)]) > 0.6
        for y in (0.0, 0.4, 1.3, -1.3):
            assert float(cells.track_share[under(cells, x, y)]) < 0.05
    assert float(cells.track_share.max()) > 0.95


def test_shade_on_the_ground_is_kept_and_markings_are_no_light() -> None:
    road = SemanticClass.ROAD
    parts = [
        sheet((-6, 9), (-8, 8), rgb=(0.5, 0.5, 0.5), semantic=road),
        sheet((9, 14), (-8, 8), rgb=(0.3, 0.3, 0.3), semantic=road),
        sheet((3, 7), (-0.2, 0.2), 0.004, rgb=(1, 1, 1), semantic=SemanticClass.LANE_MARKING),
    ]
    cells = place(drive(*parts), ExposureSettings(cell_m=0.05)).ground
    marked = cells.semantic == SemanticClass.LANE_MARKING
    assert int(marked.sum()) > 50
    lit = within(cells, (2.5, 8), (-2, 2)) & ~marked
    shade = within(cells, (10, 13), (-2, 2))
    expected = ((0.3 + 0.055) / 1.055) ** 2.4 / ((0.5 + 0.055) / 1.055) ** 2.4
    ratio = float(cells.relative_light[shade].median() / cells.relative_light[lit].median())
    assert ratio == pytest.approx(expected, rel=0.05)
    assert float(cells.relative_light[marked].median()) == pytest.approx(
        float(cells.relative_light[lit].median()), rel=0.25
    )


def test_vehicles_carry_their_own_cells() -> None:
    car = box_car(size=(4.0, 1.8, 1.5))
    bed = place(drive(GROUND, actors=[car]))
    cells = bed.actors["car"]
    area = float((cells.sizes_m**2).sum())
    assert area == pytest.approx(4.0 * 1.8, rel=0.2)
    np.testing.assert_allclose(cells.centers_m[:, 2], 0.75, atol=0.02)
    assert not bool((cells.neighbours == FLUSH).any())
    assert float(cells.edge_distance_m.max()) == pytest.approx(0.9, abs=0.2)
    roof = len(sheet((-2, 2), (-0.9, 0.9), 0.75))
    assert len(cells.hideable_ids) > roof / 2 and int(cells.hideable_ids.max()) < roof
    assert bool(within(bed.ground, (4, 8), (2.5, 3.5)).any())  # it drives on: ground is ground


def test_which_actors_are_vehicles() -> None:
    cases = [
        ("Car", None, True),
        ("Medium-sized Truck", None, True),
        ("Pedestrian", None, False),
        ("Scarecrow", None, False),
        (EGO_VEHICLE, SemanticClass.VEHICLE, False),
        ("thing", SemanticClass.VEHICLE, True),
        ("Car", SemanticClass.PEDESTRIAN, False),
    ]
    for label, semantic, expected in cases:
        assert is_vehicle(box_car(label=label, semantic=semantic)) is expected, label
    walker = drive(GROUND, actors=[box_car(label="Pedestrian")])
    assert place(walker, ExposureSettings(cell_m=0.2)).actors == {}


# ---- exposed surfaces in files -------------------------------------------------------------------

SETTINGS = ExposureSettings(cell_m=0.2)


@pytest.fixture(scope="module")
def scene() -> Scene:
    cars = [box_car(), box_car(start=(9.0, -3.0), track_id="täxi/2")]
    return drive(sheet((-2, 14), (-6, 6), semantic=1), actors=cars)


@pytest.fixture(scope="module")
def support(scene: Scene) -> ExposedSurface:
    found = find_exposed_surface(scene, cameras_of(scene), SETTINGS)
    assert len(found.ground) > 500 and set(found.actors) == {"car", "täxi/2"}
    return found


def assert_equal(a: ExposedSurface, b: ExposedSurface) -> None:
    assert list(a.actors) == list(b.actors)
    for one, other in ((a.ground, b.ground), *((a.actors[k], b.actors[k]) for k in a.actors)):
        for field in dataclasses.fields(ExposedCells):
            x, y = getattr(one, field.name), getattr(other, field.name)
            assert x.dtype == y.dtype and torch.equal(x, y), field.name


def test_a_file_gives_back_the_support_to_the_bit(support: ExposedSurface, tmp_path: Path) -> None:
    path = tmp_path / "new" / "exposed.safetensors"
    save_exposed_surface(path, support, "a key")
    assert_equal(load_exposed_surface(path, "a key"), support)
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    save_exposed_surface(path, dataclasses.replace(support, actors={}), "another")
    assert load_exposed_surface(path, "another").actors == {}


def test_the_same_support_is_the_same_bytes(support: ExposedSurface, tmp_path: Path) -> None:
    for name in "ab":
        save_exposed_surface(tmp_path / name, support, "k")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    ground = dataclasses.replace(support.ground, relative_light=support.ground.track_share)
    shared = ExposedSurface(ground, {"a": support.actors["car"], "b": support.actors["car"]})
    save_exposed_surface(tmp_path / "support", shared, "k")
    assert_equal(load_exposed_surface(tmp_path / "support", "k"), shared)
    empty = find_exposed_surface(drive(sheet((-2, 14), (-6, 6))), [], SETTINGS)
    save_exposed_surface(tmp_path / "b", empty, "k")
    assert_equal(load_exposed_surface(tmp_path / "b", "k"), empty)


def test_keys_tell_contents_apart(scene: Scene) -> None:
    cameras, ground, car = cameras_of(scene), scene.background, scene.actors[0]
    again = drive(sheet((-2, 14), (-6, 6), semantic=1), actors=scene.actors)
    key = exposed_surface_key(scene, cameras, SETTINGS)
    assert exposed_surface_key(again, cameras_of(again), SETTINGS) == key
    moved = ground.means.clone()
    moved[7, 2] += 1e-3
    track = Track(car.track.timestamps_ns, car.track.world_from_actor + 0)
    track.world_from_actor[1, 0, 3] += 0.1
    ego = scene.frames[0].world_from_ego.clone()
    ego[1, 3] += 0.5
    scenes = [
        dataclasses.replace(scene, background=dataclasses.replace(ground, **changes))
        for changes in ({"means": moved}, {"sh": ground.sh * 0.9}, {"semantic": None})
    ]
    scenes += [
        dataclasses.replace(scene, actors=(dataclasses.replace(car, **c), *scene.actors[1:]))
        for c in ({"label": "Pedestrian"}, {"size_m": (4.0, 1.8, 1.6)}, {"track": track})
    ]
    first = dataclasses.replace(scene.frames[0], world_from_ego=ego)
    scenes.append(dataclasses.replace(scene, frames=(first, *scene.frames[1:])))
    keys = [key, *(exposed_surface_key(other, cameras, SETTINGS) for other in scenes)]
    keys.append(exposed_surface_key(scene, cameras[:1], SETTINGS))
    for change in ({"cell_m": 0.3}, {"max_slope_deg": 40.0}, {"estimator": "median"}):
        keys.append(exposed_surface_key(scene, cameras, dataclasses.replace(SETTINGS, **change)))
    assert len(set(keys)) == len(keys)


def test_a_support_is_found_once_and_a_damaged_file_is_written_anew(
    scene: Scene, tmp_path: Path, caplog
) -> None:
    old_file = tmp_path / f"snow-{40 * 'a'}.safetensors"  # as version 7 of the format left it
    old_file.touch()
    own = dataclasses.replace(scene)
    first = exposed_surface_of(own, SETTINGS, folder=tmp_path)
    assert exposed_surface_of(own, SETTINGS) is first
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    path.write_bytes(whole[:-5])
    again = exposed_surface_of(dataclasses.replace(scene), SETTINGS, folder=tmp_path)
    assert_equal(again, first)
    assert "is found again" in caplog.text and path.read_bytes() == whole


def test_cut_files_and_those_of_something_else_are_refused(
    support: ExposedSurface, tmp_path: Path
) -> None:
    path = tmp_path / "exposed.safetensors"
    with pytest.raises(SceneError, match="no such file"):
        load_exposed_surface(path, "k")
    save_exposed_surface(path, support, "k")
    with pytest.raises(SceneError, match="of something else: its key is 'k', expected 'other'"):
        load_exposed_surface(path, "other")
    data = path.read_bytes()
    lengths = (0, 1, 7, 100, len(data) // 2, len(data) - 1)
    for damaged in (b"no tensors", *(data[:length] for length in lengths)):
        path.write_bytes(damaged)
        with pytest.raises(SceneError, match="damaged"):
            load_exposed_surface(path, "k")
    with pytest.raises(SceneError, match="damaged"):
        load_exposed_surface(tmp_path, "k")
    save_file({"x": torch.zeros(3)}, path)
    with pytest.raises(SceneError, match="no exposed surface of this version"):
        load_exposed_surface(path, "k")


def test_contents_that_do_not_fit_are_refused(support: ExposedSurface, tmp_path: Path) -> None:
    path = tmp_path / "exposed.safetensors"
    save_exposed_surface(path, support, "k")
    whole = load_file(path)
    ids: dict = {"format": FORMAT, "key": "k", "track_ids": list(support.actors)}
    short = whole["ground.relative_light"][1:].clone()
    neighbours, buried_by, buried = (
        whole[f"ground.{name}"].clone() for name in ("neighbours", "covering_cells", "hideable_ids")
    )
    neighbours[0, 0], buried_by[0, 0], buried[0] = -3, len(support.ground), -1
    missing = {
        name: tensor for name, tensor in whole.items() if name != "actors.1.obstacle_vectors"
    }
    for tensors, about in (
        (whole | {"ground.relative_light": short}, ids),
        (missing, ids),
        (whole | {"ground.track_share": whole["ground.track_share"].double()}, ids),
        (whole | {"ground.neighbours": neighbours}, ids),
        (whole | {"ground.covering_cells": buried_by}, ids),
        (whole | {"ground.hideable_ids": buried}, ids),
        (whole, ids | {"track_ids": 3}),
    ):
        save_file(tensors, path, metadata={"exposed_surface": json.dumps(about)})
        with pytest.raises(SceneError, match="damaged"):
            load_exposed_surface(path, "k")


def test_a_folder_that_cannot_be_written_is_an_error(scene: Scene, tmp_path: Path) -> None:
    in_the_way = tmp_path / "file"
    in_the_way.write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        exposed_surface_of(dataclasses.replace(scene), SETTINGS, folder=in_the_way)
