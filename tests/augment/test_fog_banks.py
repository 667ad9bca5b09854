"""Fog banks: their field, the optical depth of rays in all passes, drift, labels, bad input."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from augment import render_view
from augment.effects.lidar.beam import DEFAULT_MODEL, Echoes
from augment.effects.lidar.codes import SCATTERED
from augment.effects.smog import box_transmittance, fog_echoes, local_visibility, wavelength_factor
from augment.render.buffers import ALPHA, EXPECTED_DEPTH, RGB
from augment.render.constants import RasterSettings
from augment.render.fog import Fog
from augment.render.fog_banks import FogBanks, bank_density, bank_seed
from augment.render.fog_image import (
    apply_fog_to_render,
    image_optical_depth,
    point_optical_depth_numpy,
)
from augment.render.fog_table import (
    bank_table,
    densities_at,
    far_distance,
    image_means,
    look_up,
    point_means_numpy,
    ray_means,
    thinnest_fog,
)
from augment.render.rasterize import rasterize
from augment.scene.scene import PosedGaussians
from recipes.errors import RecipeError
from recipes.load import parse_recipe
from recipes.moment import SceneTimes
from tests.augment.box_views import UPRIGHT, make_boxes, make_camera, placed
from tests.lidar_sweeps import SENSOR_M, WORLD_ORIGIN_M, some_points, sweep_of
from tests.scenes import camera_ahead, random_gaussians, random_pose
from tests.streets import open_street

GREY = (0.7, 0.7, 0.7)
PATCHY = FogBanks(0.7, 300.0, 0.4, 20.0, 5)
UNIFORM = Fog(0.02, GREY, banks=PATCHY)
LAYERED = Fog(0.04, GREY, 4.0, -1.0, banks=PATCHY)
STREET = "procedural:street?seed=3&gaussians=60000&frames=2&width=240&height=135"


def exact_means(fog: Fog, eye: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Mean density along rays to points [N, 3], by sums over 10,000 points of each."""
    assert fog.banks is not None
    shares = (np.arange(10_000) + 0.5) / 10_000
    means = []
    for point in points:
        places = eye + shares[:, None] * (point - eye)
        weights = np.ones(len(shares))
        if fog.scale_height_m is not None:
            weights = np.exp(-(places[:, 2] - places[:, 2].min()) / fog.scale_height_m)
        densities = bank_density(fog.banks, places[:, :2])
        means.append((densities * weights).sum() / weights.sum())
    return np.array(means)


def points_before(camera, rng, count: int, far_m: float, *, top: float) -> np.ndarray:
    """Points in the image's cone, evenly spread over the logarithm of the distance from 2 m."""
    u = rng.uniform(0, camera.width, count)
    v = rng.uniform(0, top * camera.height, count)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(count)], 1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    distances = np.exp(rng.uniform(math.log(2), math.log(far_m), count))
    pose = camera.world_from_camera.numpy()
    return (rays * distances[:, None]) @ pose[:3, :3].T + pose[:3, 3]


def test_the_recipes_density_is_the_fields_mean_and_patchiness_its_deviation():
    places = np.random.default_rng(0).uniform(-3e5, 3e5, (400_000, 2))
    for patchiness in (0.3, 0.7, 1.5, 2.0):
        density = bank_density(replace(PATCHY, patchiness=patchiness), places)
        # The standard error of the mean of a log-normal value is at most 1.2 % here.
        assert density.mean() == pytest.approx(1, abs=0.04 if patchiness > 1 else 0.01)
        assert np.log(density).std() == pytest.approx(patchiness, rel=0.01)
        # Vaisala calls fog patchy whose visibility is more than twice or less than half its mean.
    uniform = bank_density(replace(PATCHY, patchiness=0.3), places)
    assert np.mean((uniform > 2) | (uniform < 0.5)) < 0.05
    patchy = bank_density(PATCHY, places)
    assert np.mean((patchy > 2) | (patchy < 0.5)) > 0.3


def test_kernels_have_the_density_of_the_definition():
    points = np.random.default_rng(1).uniform(-1e5, 1e5, (2000, 3))
    np.testing.assert_allclose(
        densities_at(UNIFORM, points), bank_density(PATCHY, points[:, :2]), rtol=1e-9
    )


def test_banks_drift_with_the_wind_and_do_not_change():
    """Air that comes from +x carries what was at x to x - U t."""
    places = np.random.default_rng(2).uniform(-500, 500, (500, 2))
    for angle in (0.0, 0.5 * math.pi, 2.0):
        banks = replace(PATCHY, wind_from_rad=angle, drift_m=0.0)
        moved = replace(banks, drift_m=35.0)
        way = -35.0 * np.array([math.cos(angle), math.sin(angle)])
        np.testing.assert_allclose(
            bank_density(moved, places + way), bank_density(banks, places), rtol=1e-9
        )


def test_the_field_is_fixed_to_the_datasets_world():
    """Scenes of the same drive may have other origins, by the frames that are opened."""
    places = np.random.default_rng(2).uniform(-500, 500, (500, 2))
    far = replace(PATCHY, origin_m=(448_262.0, 4_421_337.0))
    moved = replace(PATCHY, origin_m=(448_200.0, 4_421_300.0))
    np.testing.assert_allclose(
        bank_density(far, places), bank_density(moved, places + np.array([62.0, 37.0])), rtol=1e-6
    )


def test_banks_are_longer_along_the_wind():
    banks = replace(PATCHY, wind_from_rad=0.0, bank_m=100.0)
    places = np.random.default_rng(3).uniform(-1e5, 1e5, (50_000, 2))

    def correlation(step: tuple[float, float]) -> float:
        first, second = (np.log(bank_density(banks, p)) for p in (places, places + step))
        return float(np.corrcoef(first, second)[0, 1])

    assert correlation((60.0, 0.0)) > correlation((0.0, 60.0)) + 0.2
    assert abs(correlation((0.0, 400.0))) < 0.05  # nothing is larger than the outer scale


@pytest.mark.parametrize("visibility_m", [50, 200, 1000])
@pytest.mark.parametrize("scale_height_m", [None, 4.0])
def test_the_depth_of_a_ray_is_within_a_percent_of_a_sum_over_it(visibility_m, scale_height_m):
    """Up to an optical depth of 5, behind which less than 1 % of the light is left."""
    sigma = 3.912 / visibility_m
    top = 1.0 if scale_height_m is None else 0.45  # rays above the ground
    for seed in range(3):
        rng = np.random.default_rng(seed)
        fog = Fog(sigma, GREY, scale_height_m, banks=replace(PATCHY, seed=seed))
        camera = camera_ahead(320, 200, 280.0, position=(seed * 90.0, 7.0, 1.6), yaw=1.7 * seed)
        points = points_before(camera, rng, 60, 5 / sigma, top=top)
        expected = exact_means(fog, camera.centre.numpy(), points)
        table = point_means_numpy(fog, camera, points) / expected - 1
        assert np.abs(table).max() < 0.012 and np.percentile(np.abs(table), 95) < 0.007
        offsets = points - camera.centre.numpy()
        distances = np.linalg.norm(offsets, axis=1)
        directions = offsets / distances[:, None]
        beams = ray_means(fog, camera.centre.numpy(), directions, distances)
        np.testing.assert_allclose(beams, expected, rtol=6e-3)


@pytest.mark.parametrize("fog", [UNIFORM, LAYERED])
def test_the_kernel_reads_the_table_as_its_definition(fog):
    camera = camera_ahead(37, 22, 20.0, position=(3.0, -2.0, 1.6), yaw=2.5)
    rng = np.random.default_rng(5)
    depth = torch.from_numpy(rng.uniform(0, 900, (22, 37)).astype(np.float32))
    depth[3, 4] = 0
    got = image_means(fog, camera, depth)
    rays = camera.ray_directions(torch.float64)
    expected = look_up(bank_table(fog, camera), rays * depth.double()[..., None])
    np.testing.assert_allclose(got.numpy(), expected.numpy(), rtol=2e-5)  # float32


@pytest.mark.parametrize("fog", [UNIFORM, LAYERED])
def test_splats_in_banks_are_those_of_the_definition(fog):
    parts = [
        PosedGaussians(random_gaussians(200, seed=1, sh_degree=1)),
        PosedGaussians(random_gaussians(80, seed=2), random_pose(3)),
    ]
    thick = replace(fog, extinction_per_m=0.3)
    camera = camera_ahead(45, 30, 40.0, yaw=0.1)
    expected = rasterize(parts, camera, buffers={RGB}, fog=thick, backend="reference").rgb
    got = rasterize(parts, camera, buffers={RGB}, fog=thick, backend="cpu").rgb
    plain = rasterize(parts, camera, buffers={RGB}, fog=replace(thick, banks=None)).rgb
    assert expected is not None and got is not None and plain is not None
    np.testing.assert_allclose(got.numpy(), expected.numpy(), atol=2e-4)
    assert (got - plain).abs().max() > 0.01


def test_culling_behind_banks_leaves_out_nothing_that_shows():
    parts = [PosedGaussians(random_gaussians(2000, seed=4))]
    camera = camera_ahead(64, 40, 50.0)
    thick = replace(UNIFORM, extinction_per_m=0.8)
    images = [
        rasterize(parts, camera, buffers={RGB}, settings=RasterSettings(fog_cut=cut), fog=thick).rgb
        for cut in (0.0, 1e-3)
    ]
    assert (images[0] - images[1]).abs().max() < 4e-3
    thin = thinnest_fog(thick, camera)
    assert thin.banks is None and thin.extinction_per_m < thick.extinction_per_m


def test_fog_on_buffers_has_the_depth_of_its_points():
    parts = [PosedGaussians(random_gaussians(300, seed=6))]
    camera = camera_ahead(40, 30, 40.0)
    raster = rasterize(parts, camera, buffers={RGB, ALPHA, EXPECTED_DEPTH})
    assert raster.expected_depth is not None and raster.rgb is not None
    fog = replace(LAYERED, extinction_per_m=0.2)
    fogged = apply_fog_to_render(raster, camera, fog)
    tau = image_optical_depth(fog, camera, raster.expected_depth)
    points = camera.centre + camera.ray_directions(torch.float64) * raster.expected_depth[..., None]
    expected = point_optical_depth_numpy(fog, camera, points.numpy())
    np.testing.assert_allclose(tau.numpy(), expected, rtol=1e-4, atol=1e-6)
    assert fogged.shape == raster.rgb.shape


def test_windows_and_mirrored_cameras_read_the_same_numbers():
    camera = camera_ahead(64, 48, 50.0, position=(1.0, 2.0, 1.6))
    depth = torch.full((48, 64), 150.0)
    whole = image_means(UNIFORM, camera, depth)
    window = image_means(UNIFORM, camera.cropped(10, 5, 20, 16), depth[5:21, 10:30])
    np.testing.assert_allclose(window.numpy(), whole[5:21, 10:30].numpy(), rtol=1e-5)


def test_patchiness_zero_is_the_plain_recipe_to_the_bit_and_in_its_hash():
    plain = parse_recipe("{version: 1, weather: {smog: {visibility_m: 60}}}", source="a")
    zero = parse_recipe(
        "{version: 1, weather: {smog: {visibility_m: 60, patchiness: 0, wind_mps: 2}}}", source="b"
    )
    assert plain.resolve(0).hash == zero.resolve(0).hash
    windy = zero.resolve(0)
    scene = open_street(STREET)
    camera = scene.frames[1].cameras["front"]
    assert torch.equal(
        torch.as_tensor(np.asarray(render_view(scene, camera, plain.resolve(0)).rgb)),
        torch.as_tensor(np.asarray(render_view(scene, camera, windy).rgb)),
    )


def patchy_recipe(clock_s: float = 0, **fields):
    smog = ", ".join(
        f"{name}: {value}"
        for name, value in {"visibility_m": 90, "patchiness": 1, **fields}.items()
    )
    text = f"{{version: 1, weather: {{clock: {{start_s: {clock_s}}}, smog: {{{smog}}}}}}}"
    return parse_recipe(text, source="banks").resolve(0)


def test_images_of_a_scene_agree_on_the_field_and_change_with_time():
    scene = open_street(STREET)
    camera = scene.frames[0].cameras["front"]
    first = np.asarray(render_view(scene, camera, patchy_recipe(0)).rgb)
    again = np.asarray(render_view(scene, camera, patchy_recipe(0)).rgb)
    later = np.asarray(render_view(scene, camera, patchy_recipe(60, wind_mps=6)).rgb)
    np.testing.assert_array_equal(first, again)
    assert np.abs(first.astype(int) - later).max() > 5
    assert bank_seed(1, scene.name) != bank_seed(2, scene.name)


@pytest.mark.parametrize("scale_height", [None, 6])
@pytest.mark.parametrize("model", ["per_gaussian", "deferred"])
def test_every_pass_takes_banks(scale_height, model):
    extra = {} if scale_height is None else {"scale_height_m": scale_height}
    recipe = patchy_recipe(
        model=model, overcast=0.5, scatter=1, blend="linear", shadow_fade=1, **extra
    )
    scene = open_street(STREET)
    view = render_view(scene, scene.frames[0].cameras["front"], recipe)
    assert np.isfinite(np.asarray(view.rgb)).all()


@pytest.mark.parametrize("fog", [UNIFORM, LAYERED])
def test_beams_and_images_have_the_same_depth(fog):
    """Beams are integrated one by one, pixels read the table: within the table's 1.2 %."""
    points = some_points()
    origins = np.tile(SENSOR_M, (len(points), 1)) + WORLD_ORIGIN_M
    echoes = Echoes.from_sweep(sweep_of(points), origins, WORLD_ORIGIN_M, DEFAULT_MODEL)
    fog_echoes(echoes, fog, np.random.default_rng(0))
    hit = echoes.codes != SCATTERED
    assert hit.sum() > 50
    # At this density the LiDAR's wavelength has the extinction of visible light.
    assert wavelength_factor(fog.extinction_per_m) == 1
    camera = camera_ahead(position=tuple(SENSOR_M))
    tau = point_optical_depth_numpy(fog, camera, points[hit])
    np.testing.assert_allclose(-0.5 * np.log(echoes.gain[hit]), tau, rtol=0.012)


@pytest.mark.parametrize("fog", [UNIFORM, LAYERED])
def test_a_boxs_transmittance_is_that_of_its_rays(fog):
    tiny = (1e-6, 1e-6, 1e-6)
    places = np.array([[40.0, 3.0, 1.6], [90.0, -20.0, 4.0]])
    boxes = make_boxes(*((tuple(place), tiny, UPRIGHT) for place in places))
    camera = make_camera()
    got = box_transmittance(placed(boxes), camera, fog, None)
    offsets = places - camera.centre.numpy()
    distances = np.linalg.norm(offsets, axis=1)
    means = ray_means(fog, camera.centre.numpy(), offsets / distances[:, None], distances)
    plain = point_optical_depth_numpy(replace(fog, banks=None), camera, places)
    np.testing.assert_allclose(-np.log(got.transmittance), plain * means, rtol=0.012)


def test_visibility_of_an_image_is_that_of_its_rays():
    """Half of the level rays have more than 3.912 before them up to there, and half have less."""
    camera = camera_ahead(64, 48, 50.0, position=(0.0, 0.0, 1.6))
    visibility = local_visibility(UNIFORM, camera)
    across = (np.linspace(0, 64, 33) - camera.cx) / camera.fx
    rays = np.stack([np.ones(33), -across, np.zeros(33)], 1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    means = ray_means(UNIFORM, camera.centre.numpy(), rays, np.full(33, visibility))
    # Distances are interpolated between steps of 9 %.
    assert np.median(0.02 * visibility * means) == pytest.approx(3.912, rel=0.005)
    assert visibility != pytest.approx(3.912 / 0.02, rel=0.02)
    assert local_visibility(replace(UNIFORM, banks=None), camera) == pytest.approx(3.912 / 0.02)
    assert far_distance(UNIFORM) > 3 * visibility


REFUSALS = {
    "patchiness: 2.5": "patchiness = 2.5: must be >= 0 and <= 2",
    "patchiness: -0.1": "patchiness = -0.1: must be >= 0 and <= 2",
    "patchiness: 1, wind_mps: 100": "wind_mps = 100: must be >= 0 and <= 60",
    "patchiness: 1, bank_m: 3": "bank_m = 3: must be >= 50 and <= 10000",
    "patchiness: 1, wind_from_deg: 400": "wind_from_deg = 400: must be >= -360 and <= 360",
}


def test_impossible_banks_are_refused():
    for fields, message in REFUSALS.items():
        text = f"{{version: 1, weather: {{smog: {{visibility_m: 90, {fields}}}}}}}"
        with pytest.raises(RecipeError, match=message):
            parse_recipe(text, source="r")


def test_a_changing_wind_carries_banks_as_far_as_it_blew():
    text = """
version: 1
weather:
  smog: {visibility_m: 90, patchiness: 1, wind_mps: {timeline: [[0, 0], [10, 4]]}}
"""
    recipe = parse_recipe(text, source="wind").resolve(0)
    times = SceneTimes(0, 20 * 10**9)
    smog = recipe.at(times, 10 * 10**9).weather.smog
    assert smog is not None and smog.drift_m == pytest.approx(20.0)
