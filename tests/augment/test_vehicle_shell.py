"""Shells of vehicles: forms, their fit to points, and the layer that they hold."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from adapters.base import open_scene
from adapters.street.raycast import build_tree
from adapters.street.world import (
    ARCH,
    CAR_GLASS,
    CAR_MODELS,
    HEADLIGHT,
    PLATE,
    RIM,
    TAILLIGHT,
    TRIM,
    TYRE,
    CarModel,
    draw_car,
)
from augment.exposure.search import ExposureSettings, find_exposed_surface
from augment.exposure.shell_grid import VEHICLE_MAX_SLOPE_DEG, find_depth_shares
from augment.exposure.vehicle_cells import parked_vehicles, shells_of_parked, top_speed_mps
from augment.exposure.vehicle_forms import forms_of_label
from augment.exposure.vehicle_shell import ShellSample, VehiclePart, VehicleShell, fit_shell
from augment.scene.labels import Boxes, LidarSweep
from augment.scene.scene import Actor, Gaussians, Scene
from augment.scene.semantics import SemanticClass
from augment.scene.transform import transform_gaussians_rigidly
from augment.view.plan import make_plan
from augment.view.render_view import render_buffers
from recipes.schema import Output, Recipe, Weather
from recipes.snow import Snow
from tests.scenes import stack
from tests.snow_scenes import box_car, cameras_of, drive, sheet

GLASS_RGB = np.array(CAR_GLASS.rgb)
NO_LABELS = Output(labels=False)
OTHER_RGB = np.array([look.rgb for look in (ARCH, HEADLIGHT, PLATE, RIM, TAILLIGHT, TRIM, TYRE)])


# ---- Cars of the procedural street, whose surface is known ---------------------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class CarTruth:
    """Surface of a car at places of its plan, in the frame of its box."""

    model: CarModel
    xy_m: np.ndarray
    z_m: np.ndarray
    slope_deg: np.ndarray
    is_glass: np.ndarray
    is_body: np.ndarray


def car_truth(seed: int, step_m: float = 0.04) -> CarTruth:
    """Look straight down at a car of the street."""
    model, shapes = draw_car(seed)
    length, width, height = model.size_m
    shapes = shapes.moved((0, 0, -height / 2))
    x = np.arange(-length / 2, length / 2, step_m) + step_m / 2
    y = np.arange(-width / 2, width / 2, step_m) + step_m / 2
    xy = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    origins = np.concatenate([xy, np.full((len(xy), 1), height)], 1)
    hits = build_tree(shapes).cast(origins, np.tile([0.0, 0.0, -1.0], (len(xy), 1)))
    distance, shape = hits[0], hits[1]
    normals = shapes.axes[np.maximum(shape, 0), 2]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rgb = shapes.rgb[np.maximum(shape, 0)]
    is_other = (np.abs(rgb[:, None] - OTHER_RGB).max(-1) < 1e-9).any(1)
    z = height - distance
    return CarTruth(
        model,
        xy,
        z,
        np.degrees(np.arccos(np.clip(np.abs(normals[:, 2]), 0, 1))),
        np.abs(rgb - GLASS_RGB).max(1) < 1e-9,
        (shape >= 0) & ~is_other & (z > 0.35 - height / 2),
    )


def returns_of(truth: CarTruth, rng: np.random.Generator, count: int) -> tuple[np.ndarray, ...]:
    """Noisy points on a car as a LiDAR beside it sees them, and which of them face upwards.

    Glass gives few returns, the far side none, and some come from the seats.
    """
    weights = np.where(truth.is_glass, 0.05, 1.0) * (truth.xy_m[:, 1] > -0.3) * truth.is_body
    rows = rng.choice(len(weights), count, p=weights / weights.sum())
    points = np.concatenate([truth.xy_m[rows], truth.z_m[rows, None]], 1)
    points += rng.normal(0, 0.015, points.shape)
    seats = np.stack(
        [rng.uniform(-1, 0.5, 60), rng.uniform(-0.6, 0.6, 60), rng.uniform(-0.1, 0.2, 60)], 1
    )
    faces_up = truth.slope_deg[rows] < 60
    return np.concatenate([points, seats]), np.concatenate([faces_up, np.ones(60, bool)])


@pytest.fixture(scope="module", params=[0, 1, 2])
def fitted_car(request) -> tuple[CarTruth, VehicleShell]:
    """Each model of car with the shell fitted to 2,000 of its points."""
    model = CAR_MODELS[request.param]
    seed = next(s for s in range(100) if draw_car(s)[0] == model)
    truth = car_truth(seed)
    rng = np.random.Generator(np.random.PCG64(1))
    shell = fit_shell(*returns_of(truth, rng, 2000), "Car", model.size_m)
    assert shell is not None
    return truth, shell


def test_shells_follow_roof_and_bonnet_of_known_cars(fitted_car) -> None:
    truth, shell = fitted_car
    sample = shell.sample(truth.xy_m)
    is_paint = np.isin(sample.parts, (VehiclePart.ROOF, VehiclePart.BONNET)) & truth.is_body
    is_paint &= truth.slope_deg < 30
    error = np.abs(sample.z_m - truth.z_m)[is_paint]
    assert np.median(error) < 0.02  # noise of the points 1.5 cm, heights of bonnets curved
    assert np.quantile(error, 0.95) < 0.06


def test_level_faces_are_covered_and_steep_ones_are_not(fitted_car) -> None:
    truth, shell = fitted_car
    sample = shell.sample(truth.xy_m)
    shares = find_depth_shares(sample, 50.0, None)
    is_covered = (shares > 0) & (np.abs(sample.z_m - truth.z_m) < 0.08)
    is_level = truth.is_body & (truth.slope_deg < 30)
    assert is_covered[is_level].mean() >= 0.88  # rims of some centimetres stay bare
    is_steep = truth.is_body & (truth.slope_deg > 60)
    area = 1 / np.cos(np.radians(np.minimum(truth.slope_deg, 88)))
    # One row of places over the rim of a rear window; upright faces weigh 18 times their plan.
    assert (area * (shares > 0))[is_steep].sum() <= 0.02 * area[is_steep].sum()
    is_steep_glass = truth.is_glass & (truth.slope_deg > VEHICLE_MAX_SLOPE_DEG + 4)
    assert (shares > 0)[is_steep_glass].mean() <= 0.02 if is_steep_glass.any() else True


def test_nothing_of_a_layer_hangs_in_the_air(fitted_car) -> None:
    truth, shell = fitted_car
    sample = shell.sample(truth.xy_m)
    is_top = find_depth_shares(sample, 50.0, None) > 0
    height = (sample.z_m - truth.z_m)[is_top & truth.is_body]
    assert (height > 0.06).mean() < 0.02


def test_shells_are_symmetric_and_without_holes(fitted_car) -> None:
    truth, shell = fitted_car
    mirrored = shell.sample(truth.xy_m * [1, -1])
    sample = shell.sample(truth.xy_m)
    np.testing.assert_array_equal(sample.z_m, mirrored.z_m)
    np.testing.assert_array_equal(sample.parts, mirrored.parts)
    x = np.arange(-2.0, 2.0, 0.05)
    middle = shell.sample(np.stack([x, 0 * x], 1))
    is_top = np.flatnonzero(middle.parts != VehiclePart.SIDE)
    assert (np.diff(is_top) == 1).all()  # from boot to bonnet


def test_the_same_points_give_the_same_shell() -> None:
    truth = car_truth(3)
    points, faces_up = returns_of(truth, np.random.Generator(np.random.PCG64(2)), 500)
    shells = [fit_shell(points, faces_up, "Car", truth.model.size_m) for _ in range(2)]
    assert shells[0] is not None and shells[1] is not None
    np.testing.assert_array_equal(shells[0].heights_m, shells[1].heights_m)


# ---- Where the points are few, or of something else ----------------------------------------------


def test_a_few_points_on_one_side_give_the_usual_form() -> None:
    truth = car_truth(3)
    rng = np.random.Generator(np.random.PCG64(4))
    points, faces_up = returns_of(truth, rng, 150)
    is_near = points[:, 1] > 0.5
    shell = fit_shell(points[is_near], faces_up[is_near], "Car", truth.model.size_m)
    assert shell is not None
    sample = shell.sample(truth.xy_m)
    is_roof = truth.is_body & (np.abs(truth.z_m - truth.z_m[truth.is_body].max()) < 0.08)
    assert np.median(np.abs(sample.z_m - truth.z_m)[is_roof]) < 0.08


@pytest.mark.parametrize(
    ("label", "height_m", "expected"),
    [
        ("Car", 1.5, {"hatchback", "saloon", "suv"}),
        ("Car", 1.9, {"hatchback", "saloon", "suv", "van"}),
        ("Pickup Truck", 1.9, {"pickup"}),
        ("Medium-sized Truck", 2.5, {"van", "box truck"}),
        ("vehicle.bus.rigid", 3.2, {"bus"}),
        ("Other Vehicle - Construction Vehicle", 2.8, set()),
        ("Towed Object", 2.0, set()),
        ("vehicle.trailer", 3.0, set()),
    ],
)
def test_forms_go_by_label_and_size(label: str, height_m: float, expected: set[str]) -> None:
    assert {form.name for form in forms_of_label(label, height_m)} == expected


def test_what_no_form_describes_has_no_shell() -> None:
    rng = np.random.Generator(np.random.PCG64(5))
    few = rng.uniform(-0.5, 0.5, (10, 3))
    assert fit_shell(few, np.ones(10, bool), "Car", (4.0, 1.8, 1.5)) is None
    block = rng.uniform(-1, 1, (4000, 3)) * [2.0, 0.9, 0.0] + [0, 0, 0.75]  # as high as its box
    assert fit_shell(block, np.ones(4000, bool), "Car", (4.0, 1.8, 1.5)) is None
    assert fit_shell(block, np.ones(4000, bool), "Crane", (4.0, 1.8, math.nan)) is None
    assert fit_shell(block, np.ones(4000, bool), "Construction vehicle", (4.0, 1.8, 1.5)) is None


def test_strays_above_a_bonnet_do_not_lift_it() -> None:
    truth = car_truth(3)
    rng = np.random.Generator(np.random.PCG64(6))
    points, faces_up = returns_of(truth, rng, 2000)
    branch = rng.uniform(-1, 1, (80, 3)) * [0.2, 0.3, 0.02] + [1.7, 0.4, 0.75]
    with_branch = fit_shell(
        np.concatenate([points, branch]),
        np.concatenate([faces_up, np.ones(80, bool)]),
        "Car",
        truth.model.size_m,
    )
    without = fit_shell(points, faces_up, "Car", truth.model.size_m)
    assert with_branch is not None and without is not None
    assert np.abs(with_branch.heights_m - without.heights_m)[:-2].max() < 0.12


# ---- The layer that a shell holds ----------------------------------------------------------------


def sample_of(part: VehiclePart, slope_deg: float, bonnet_share: float = 0.5) -> ShellSample:
    return ShellSample(
        z_m=np.zeros(1),
        slopes=np.zeros((1, 2)),
        parts=np.array([part], np.int8),
        steepness=np.array([math.tan(math.radians(slope_deg))]),
        bonnet_share=np.array([bonnet_share]),
        pane_edge_m=np.array([1.0]),
    )


def share(part: VehiclePart, slope_deg: float, speed_mps: float | None = None, **place) -> float:
    return float(find_depth_shares(sample_of(part, slope_deg, **place), 50.0, speed_mps)[0])


def test_glass_holds_less_the_steeper_it_is_and_nothing_beyond_38_degrees() -> None:
    shares = [share(VehiclePart.WINDSCREEN, slope) for slope in (5, 15, 25, 37)]
    assert shares[0] == 1 and shares == sorted(shares, reverse=True) and shares[-1] > 0.1
    assert share(VehiclePart.WINDSCREEN, 39) == share(VehiclePart.REAR_WINDOW, 60) == 0
    assert share(VehiclePart.ROOF, 5) == share(VehiclePart.BED, 0) == 1
    assert share(VehiclePart.SIDE, 0) == 0


def test_moving_vehicles_lose_the_bonnets_layer_from_its_front_end() -> None:
    assert share(VehiclePart.WINDSCREEN, 25, speed_mps=1.0) == 0  # the driver looks out
    assert share(VehiclePart.BONNET, 5, speed_mps=1.0) == 1
    at_front = share(VehiclePart.BONNET, 5, speed_mps=7.0, bonnet_share=0.1)
    at_screen = share(VehiclePart.BONNET, 5, speed_mps=7.0, bonnet_share=0.9)
    assert at_front == 0 and at_screen == 1
    assert share(VehiclePart.BONNET, 5, speed_mps=14.0, bonnet_share=0.9) == 0
    assert share(VehiclePart.ROOF, 2, speed_mps=14.0) > 0.9
    assert share(VehiclePart.ROOF, 2, speed_mps=40.0) == pytest.approx(0.5)


def test_speed_is_that_of_the_track_and_of_no_jitter() -> None:
    assert top_speed_mps(box_car(moved_m=0.3)) is None
    assert top_speed_mps(box_car(moved_m=1.5)) == pytest.approx(15)  # 1.5 m in 0.1 s


# ---- Parked vehicles of the background -----------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class OneBox:
    """Labels of one car, the same or moving on from frame to frame."""

    step_m: float = 0.0

    def boxes(self, frame_index: int) -> Boxes:
        centre = np.array([[7.0 + self.step_m * frame_index, 1.0, SIZE_M[2] / 2]])
        quats = np.array([[1.0, 0.0, 0.0, 0.0]])
        return Boxes(("car",), ("Car",), centre, np.array([SIZE_M]), quats)

    def lidar(self, frame_index: int) -> LidarSweep | None:
        return None


SIZE_M = CAR_MODELS[1].size_m
CAR_CENTRE_M = np.array([7.0, 1.0, SIZE_M[2] / 2])


def car_splats() -> Gaussians:
    """Flat splats over the upper surface of a saloon, in world coordinates."""
    seed = next(s for s in range(100) if draw_car(s)[0] == CAR_MODELS[1])
    truth = car_truth(seed, step_m=0.1)
    rows = truth.is_body
    spots = np.concatenate([truth.xy_m[rows], truth.z_m[rows, None]], 1)
    base = sheet((0, 1), (0, 1), semantic=SemanticClass.VEHICLE)
    count = len(spots)
    return Gaussians(
        means=torch.from_numpy(spots + CAR_CENTRE_M).float(),
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        scales=torch.tensor([0.07, 0.07, 0.004]).repeat(count, 1),
        opacities=torch.full((count,), 0.99),
        sh=base.sh[:1].repeat(count, 1, 1),
        semantic=torch.full((count,), int(SemanticClass.VEHICLE), dtype=torch.int16),
    )


def parked_scene(labels: OneBox | None) -> Scene:
    ground = sheet((-6, 20), (-8, 8), semantic=SemanticClass.ROAD)
    parts = dataclasses.replace(
        stack(ground, car_splats()), semantic=torch.cat([ground.semantic, car_splats().semantic])
    )
    return drive(parts, labels=labels)


def test_labelled_vehicles_that_stand_still_are_parked() -> None:
    assert parked_vehicles(parked_scene(None)) == ()
    assert [v.label for v in parked_vehicles(parked_scene(OneBox()))] == ["Car"]
    assert parked_vehicles(parked_scene(OneBox(step_m=2.0))) == ()


def test_a_parked_car_is_covered_on_roof_bonnet_and_boot() -> None:
    scene = parked_scene(OneBox())
    cells = find_exposed_surface(scene, cameras_of(scene), ExposureSettings(cell_m=0.05)).ground
    z = cells.centers_m[:, 2]
    x = cells.centers_m[:, 0] - 7.0
    is_car = (z > 0.5) & (x.abs() < SIZE_M[0] / 2)
    assert bool((cells.semantic[is_car] == SemanticClass.VEHICLE).all())
    model = CAR_MODELS[1]
    places = ((0.0, model.roof_z), (1.8, None), (-2.0, None))
    for place, height in places:
        is_here = is_car & ((x - place).abs() < 0.1) & ((cells.centers_m[:, 1] - 1).abs() < 0.4)
        assert float((cells.sizes_m[is_here] ** 2).sum()) > 0.12  # of 0.16 m2
        assert height is None or float(z[is_here].median()) == pytest.approx(height, abs=0.03)
    assert float(cells.depth_share[is_car].min()) < 1  # glass of 36 degrees
    assert bool((cells.depth_share[~is_car] == 1).all())


def test_parked_vehicles_far_from_the_path_have_no_shell() -> None:
    vehicles = parked_vehicles(parked_scene(OneBox()))
    splats = car_splats()
    near = np.array([[7.0, -40.0], [0.0, 200.0]])
    far = np.array([[7.0, 70.0], [7.0, -70.0]])
    assert len(shells_of_parked(vehicles, splats, near)) == 1
    assert shells_of_parked(vehicles, splats, far) == ()


def test_a_turned_box_gives_the_same_shell() -> None:
    """The frame of the world has no effect on a vehicle's form."""
    vehicle = parked_vehicles(parked_scene(OneBox()))[0]
    splats = car_splats()
    turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    shift = np.array([30.0, -12.0, 2.0])
    turned_splats = transform_gaussians_rigidly(
        splats, torch.from_numpy(turn), torch.from_numpy(shift)
    )
    turned = dataclasses.replace(
        vehicle, centre_m=turn @ vehicle.centre_m + shift, rotation=turn @ vehicle.rotation
    )
    path = np.zeros((1, 2))
    (first,) = shells_of_parked([vehicle], splats, path)
    (second,) = shells_of_parked([turned], turned_splats, path)
    np.testing.assert_allclose(second.shell.knots_x_m, first.shell.knots_x_m, atol=0.01)
    np.testing.assert_allclose(second.shell.knots_z_m, first.shell.knots_z_m, atol=0.01)


def test_actors_lie_on_shells_too() -> None:
    splats = car_splats()
    local = dataclasses.replace(splats, means=splats.means - torch.tensor([7, 1, SIZE_M[2] / 2]))
    plain = box_car(size=SIZE_M, moved_m=0.4)
    actor: Actor = dataclasses.replace(plain, gaussians=local)
    scene = drive(sheet((-6, 20), (-8, 8), semantic=SemanticClass.ROAD), actors=[actor])
    cells = find_exposed_surface(scene, cameras_of(scene), ExposureSettings(cell_m=0.1)).actors
    area = float((cells["car"].sizes_m ** 2).sum())
    assert 4.0 < area < 7.0  # of 8.6 m2 in the box
    counts = (cells["car"].neighbours >= 0).sum(1)
    assert float((counts == 4).float().mean()) > 0.85  # one patch, no torn edges


# ---- Vehicles of PandaSet, marked by eye ---------------------------------------------------------

PARTS_FILE = Path(__file__).parents[1] / "data" / "vehicle_parts.json"


def part_shares(snow_mask: Callable[[str], np.ndarray]) -> dict[str, float]:
    """Percent of the marked pixels of each kind of part that the cameras' snow masks cover."""
    pixels = {kind: [0, 0] for kind in ("level", "cleared", "steep")}
    for vehicle in json.loads(PARTS_FILE.read_text())["vehicles"]:
        snow = snow_mask(vehicle["camera"])
        for kind, counts in pixels.items():
            for polygons in vehicle[kind].values():
                area = np.zeros(snow.shape, np.uint8)
                cv2.fillPoly(area, [np.array(polygon, np.int32) for polygon in polygons], 1)
                counts[0] += int(area.sum())
                counts[1] += int(snow[area > 0].sum())
    return {kind: 100 * snowy / total for kind, (total, snowy) in pixels.items()}


def test_marked_parts_are_polygons_within_the_images() -> None:
    marked = json.loads(PARTS_FILE.read_text())
    assert len(marked["vehicles"]) >= 12
    for vehicle in marked["vehicles"]:
        for kind in ("level", "cleared", "steep"):
            for polygons in vehicle[kind].values():
                corners = np.concatenate([np.array(polygon) for polygon in polygons])
                assert corners.min() >= 0 and (corners <= [1920, 1080]).all()


@pytest.mark.long
def test_marked_vehicles_of_a_recorded_drive_carry_their_snow(shared_dir) -> None:
    """Masks of the raw drive at full size."""
    folder = shared_dir / "data" / "pandaset_mini" / "002"
    if not folder.is_dir():
        pytest.skip(f"no PandaSet at {folder}")
    scene = open_scene(f"pandaset:{folder}")
    plan = make_plan(Recipe(weather=Weather(snow=Snow(depth_m=0.1)), output=NO_LABELS), scene)
    frame = scene.frame(json.loads(PARTS_FILE.read_text())["frame"])

    @functools.cache
    def snow_mask(camera: str) -> np.ndarray:
        return render_buffers(scene, frame.cameras[camera], plan).masks["snow"].numpy()

    shares = part_shares(snow_mask)
    assert shares["level"] >= 90
    assert shares["cleared"] <= 15  # the raw drive has holes in glass, which show snow behind it
    assert shares["steep"] <= 1
