"""Smog along rays and in labels, against integrals worked by hand."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch

from adapters.procedural import open_truth
from adapters.uri import parse_uri
from augment.effects.smog import box_transmittance
from augment.render.fog import (
    Fog,
    apply_deferred_fog,
    blend_airlight,
    optical_depth,
    optical_depth_numpy,
    sky_optical_depth,
)
from augment.scene.boxes import BOTTOM_MARGIN_M, NOT_COUNTED, SIDE_MARGIN_M
from augment.scene.geometry import rotmat_from_quat
from augment.scene.labels import Boxes
from recipes.schema import Smog
from recipes.smog import KOSCHMIEDER
from tests.augment.batch_scenes import ORIGIN_M
from tests.augment.box_views import CAR_M, UPRIGHT, boxes_at_random, make_boxes, make_camera, placed
from tests.streets import open_street
from tools.bench.scenes import recipe_of
from tools.bench.smog_truth import smog_error, truth_view

GREY = (0.7, 0.75, 0.8)


def layered(sigma: float = 0.02, height: float = 15.0) -> Fog:
    return Fog(sigma, GREY, scale_height_m=height, base_z_m=-1.0)


def quadrature(medium: Fog, distance: float, eye: float, point: float) -> float:
    """The integral of the density along the ray by the midpoint rule."""
    steps = torch.linspace(0, 1, 20_001, dtype=torch.float64)
    z = eye + (point - eye) * (steps[1:] + steps[:-1]) / 2
    assert medium.scale_height_m is not None
    density = medium.extinction_per_m * torch.exp(-(z - medium.base_z_m) / medium.scale_height_m)
    return float(density.mean()) * distance


def test_one_attenuation_length_leaves_one_part_in_e():
    medium = Fog(0.05, GREY)
    tau = optical_depth(medium, torch.tensor(20.0), 0.0)
    black = blend_airlight(torch.zeros(3), tau, medium)
    expected = (1 - math.exp(-1)) * torch.tensor(GREY)
    assert torch.allclose(black, expected)


def test_no_density_is_the_identity_to_the_bit():
    rgb = torch.rand(50, 3)
    for medium in (Fog(0.0, GREY), layered(sigma=0.0)):
        tau = optical_depth(medium, torch.rand(50) * 1e4, 1.0, torch.rand(50) * 100)
        assert torch.equal(blend_airlight(rgb, tau, medium), rgb)
        assert torch.equal(sky_optical_depth(medium, torch.linspace(-1, 1, 9), 1.0), torch.zeros(9))


def test_scale_height_against_quadrature():
    medium = layered()
    for eye, point, distance in (
        (1.6, 1.6, 50.0),
        (1.6, 1.6001, 50.0),
        (1.6, 40.0, 80.0),
        (60.0, 0.0, 90.0),
        (0.0, 300.0, 300.0),
    ):
        way, z = torch.tensor([distance, point], dtype=torch.float64)
        tau = float(optical_depth(medium, way, eye, z))
        # The midpoint rule is off by (x / 20 000)^2 / 24 with x = 20 scale heights at most: 4e-8.
        assert tau == pytest.approx(quadrature(medium, distance, eye, point), rel=1e-7)


def test_optical_depths_add_up_along_a_ray():
    medium = layered()
    eye, middle, far = 2.0, 12.0, 42.0  # equal slope: the middle lies at a quarter of the way

    def tau(way_m: float, eye_z_m: float, z_m: float) -> float:
        way, z = torch.tensor([way_m, z_m], dtype=torch.float64)
        return float(optical_depth(medium, way, eye_z_m, z))

    parts = tau(25.0, eye, middle) + tau(75.0, middle, far)
    assert parts == pytest.approx(tau(100.0, eye, far), rel=1e-12)


def test_the_sky_is_the_limit_of_far_points():
    medium = layered()
    slope, distance = 0.3, 5_000.0  # 1500 m up: exp(-100) of the density is left
    point = optical_depth(
        medium,
        torch.tensor(distance, dtype=torch.float64),
        1.6,
        torch.tensor(1.6 + slope * distance, dtype=torch.float64),
    )
    sky = sky_optical_depth(medium, torch.tensor(slope, dtype=torch.float64), 1.6)
    assert float(sky) == pytest.approx(float(point), rel=1e-12)


def test_gradients():
    medium = layered()
    rgb = torch.rand(4, 3, dtype=torch.float64, requires_grad=True)
    distance = (torch.rand(4, dtype=torch.float64) * 50 + 1).requires_grad_()
    z = (torch.rand(4, dtype=torch.float64) * 30 + 5).requires_grad_()

    def fogged(rgb, distance, z):
        return blend_airlight(rgb, optical_depth(medium, distance, 1.6, z), medium)

    assert torch.autograd.gradcheck(fogged, (rgb, distance, z))


def test_deferred_smog_fogs_what_covers_the_pixel_and_leaves_the_rest_to_the_sky():
    medium = Fog(0.1, GREY)
    rgb = torch.tensor([[[0.2, 0.2, 0.2], [0.0, 0.0, 0.0]]])  # half covered; not covered
    alpha = torch.tensor([[0.5, 0.0]])
    out = apply_deferred_fog(rgb, alpha, torch.tensor([[1.0, 0.0]]), medium)
    t = math.exp(-1)
    assert torch.allclose(out[0, 0], t * rgb[0, 0] + (1 - t) * 0.5 * torch.tensor(GREY))
    assert torch.equal(out[0, 1], torch.zeros(3))


def test_impossible_densities_are_refused():
    for sigma in (-0.1, math.nan, math.inf):
        with pytest.raises(ValueError, match="extinction_per_m must be finite and >= 0"):
            Fog(sigma, GREY)
    with pytest.raises(ValueError, match="scale_height_m must be finite and > 0; got 0"):
        Fog(0.1, GREY, scale_height_m=0.0)


GREY_SMOG = (0.7, 0.7, 0.7)
THICK = Fog(0.05, GREY_SMOG)
LAYERED = Fog(0.08, GREY_SMOG, scale_height_m=3.0, base_z_m=-0.5)
SHAPE = (106, 160)
POINT_M = (1e-6, 1e-6, 1e-6)
EYE_Z_M = 1.6


def wall(depth_m: float) -> np.ndarray:
    return np.full(SHAPE, depth_m, np.float32)


def measure(boxes: Boxes, medium=THICK, depth_m=None, camera=None, **options):
    return box_transmittance(placed(boxes), camera or make_camera(), medium, depth_m, **options)


def test_a_box_at_a_known_distance() -> None:
    """Exactly, without pixels; with them, by the depth that they show."""
    boxes = make_boxes(((40, 0, EYE_Z_M), POINT_M, UPRIGHT), ((0, 30, EYE_Z_M), POINT_M, UPRIGHT))
    got = measure(boxes)
    # The origin, 4e6 m away, costs 5e-10 m of the box's coordinates.
    np.testing.assert_allclose(got.transmittance, [math.exp(-2), math.exp(-1.5)], rtol=1e-8)
    assert got.num_pixels.tolist() == [NOT_COUNTED] * 2
    far_off = measure(boxes, depth_m=wall(20))
    np.testing.assert_array_equal(far_off.transmittance, got.transmittance)
    assert far_off.num_pixels.tolist() == [0, 0]
    seen = measure(make_boxes(((40, 0, EYE_Z_M), CAR_M, UPRIGHT)), depth_m=wall(38))
    assert seen.num_pixels[0] > 20
    # 4 m of width at 38 m: rays are longer than their depth by 2 cm at most, a thousandth of tau.
    assert seen.transmittance[0] == pytest.approx(math.exp(-0.05 * 38), rel=2e-3)
    assert seen.transmittance[0] < math.exp(-0.05 * 38)


@pytest.mark.parametrize("medium", [THICK, LAYERED])
def test_the_mean_is_that_over_the_pixels_that_show_the_box(medium: Fog) -> None:
    """Every pixel by hand, by the definition that images are fogged with."""
    rng = np.random.default_rng(4)
    boxes, camera = boxes_at_random(rng), make_camera(pitch=0.15)
    depth = rng.uniform(-1, 25, SHAPE).clip(0).astype(np.float32)
    got = measure(boxes, medium, depth, camera)
    rays = camera.ray_directions(torch.float64)
    z = torch.from_numpy(depth).double()
    distance, height = z * rays.norm(dim=-1), EYE_Z_M + z * rays[..., 2]
    through = torch.exp(-optical_depth(medium, distance, EYE_Z_M, height)).numpy()
    for k, size in enumerate(boxes.sizes_m):
        low, high = -size / 2 - SIDE_MARGIN_M, size / 2 + SIDE_MARGIN_M
        low[2] = -size[2] / 2 + min(BOTTOM_MARGIN_M, size[2] / 4)
        rotation = rotmat_from_quat(torch.from_numpy(boxes.quats[k])).numpy()
        points = camera.centre.numpy() + depth[..., None].astype(np.float64) * rays.numpy()
        along = (points - (boxes.centers_m[k] - ORIGIN_M)) @ rotation
        shows = ((along >= low) & (along <= high)).all(axis=-1) & (depth > 0)
        assert got.num_pixels[k] == shows.sum()
        if shows.any():
            assert got.transmittance[k] == pytest.approx(through[shows].mean(), rel=1e-12)
            continue
        signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
        corners = (signs * size) @ rotation.T + boxes.centers_m[k] - ORIGIN_M
        points = np.concatenate([corners, boxes.centers_m[k : k + 1] - ORIGIN_M])
        distance = np.linalg.norm(points - camera.centre.numpy(), axis=1)
        tau = optical_depth(
            medium, torch.from_numpy(distance), EYE_Z_M, torch.from_numpy(points[:, 2].copy())
        )
        # The origin costs 5e-10 m, as above.
        assert got.transmittance[k] == pytest.approx(torch.exp(-tau).mean().item(), rel=1e-8)
    assert (got.num_pixels > 0).sum() > 30 and (got.num_pixels == 0).sum() > 5


@pytest.mark.parametrize("medium", [THICK, LAYERED, Fog(100.0, GREY_SMOG, 0.1, -50.0)])
def test_the_optical_depth_is_that_of_the_image(medium: Fog) -> None:
    rng = np.random.default_rng(1)
    distance, z = rng.uniform(0, 300, 500), rng.uniform(-20, 80, 500)
    z[:3] = EYE_Z_M, EYE_Z_M + 1e-9, EYE_Z_M - 3e-5
    got = optical_depth_numpy(medium, distance, EYE_Z_M, z)
    tensors = torch.from_numpy(distance), torch.from_numpy(z)
    expected = optical_depth(medium, tensors[0], EYE_Z_M, tensors[1]).numpy()
    # The image's takes a straight line below 1e-4, which float32 does not tell from the curve.
    np.testing.assert_allclose(got, expected, rtol=2e-9)


def test_denser_smog_lets_less_through_and_none_all() -> None:
    boxes, camera = boxes_at_random(np.random.default_rng(7)), make_camera(pitch=0.1)
    depth = np.random.default_rng(8).uniform(0, 20, SHAPE).astype(np.float32)
    for medium in (THICK, LAYERED):
        densities = [0.0, 1e-9, 1e-3, 0.02, 0.5, 10.0, 1e4]
        media = [dataclasses.replace(medium, extinction_per_m=sigma) for sigma in densities]
        rows = np.stack([measure(boxes, m, depth, camera).transmittance for m in media])
        assert (rows[0] == 1).all() and (np.diff(rows, axis=0) <= 0).all()
        assert (rows >= 0).all() and (rows[-1] < 0.2).all()  # a pixel of a box around the eye
        assert (np.diff(rows[2:5], axis=0) < 0).all()
    clear = measure(boxes, None, depth, camera)
    assert (clear.transmittance == 1).all() and (clear.num_pixels == NOT_COUNTED).all()


def test_smog_is_in_the_air_alone_for_an_eye_in_the_water() -> None:
    """As images show it: from above, water does not change the smog before what lies in it."""
    boxes = make_boxes(((10, 0, 0.5), (2, 2, 0.4), UPRIGHT), ((10, 0, 4.5), (2, 2, 0.4), UPRIGHT))
    for depth in (None, wall(10)):
        dry, below, above = (
            measure(boxes, depth_m=depth, water_level_z_m=level) for level in (None, 2.0, 1.5)
        )
        np.testing.assert_array_equal(above.transmittance, dry.transmittance)
        assert below.transmittance[0] == 1 and below.transmittance[1] == dry.transmittance[1]


STREET = "procedural:street?seed=3&frames=1&gaussians=150000&parked=4&moving=1&pedestrians=1"


@pytest.fixture(scope="module")
def street():
    scene = open_street(STREET)
    camera = scene.frames[0].cameras["front"].scaled(0.25)
    return scene, truth_view(scene, open_truth(parse_uri(STREET)[2]), camera)


@pytest.mark.long
@pytest.mark.parametrize("model", ["per_gaussian", "deferred"])
@pytest.mark.parametrize("scale_height_m", [None, 15.0])
@pytest.mark.parametrize("blend", ["display", "linear"])
def test_smog_is_within_a_grey_level_away_from_silhouettes(street, model, scale_height_m, blend):
    scene, view = street
    overcast = 0.5 if scale_height_m else 0.0
    smog = {"visibility_m": 80, "scale_height_m": scale_height_m, "overcast": overcast}
    smog |= {"model": model, "blend": blend}
    error = smog_error(recipe_of({"smog": smog}), scene, view)
    smooth = error[view.regions["smooth"]]
    assert len(smooth) > 10_000  # most of the picture that is not sky is measured
    # The bounds a viewer cannot see: one grey level at the median, four at the worst hundredth.
    assert np.median(smooth) <= 1.0
    assert np.quantile(smooth, 0.99) <= 4.0
    # And it is smog that is measured: silhouettes, where two distances mix, do differ.
    assert np.quantile(error[view.regions["silhouette"]], 0.99) > 4.0


# ---- A sensor's reading --------------------------------------------------------------------------


@pytest.mark.parametrize("scatter", [0.0, 0.3, 1.0])
def test_a_sensor_reads_the_range_that_the_fog_was_made_from(scatter):
    """A transmissometer's beam is narrow: it loses what is absorbed, spread and diffracted."""
    mor_m = 90.0
    smog = Smog(mor_m=mor_m, scatter=scatter)
    beam_extinction_per_m = smog.resolved_extinction_per_m * (1 + scatter)
    assert math.exp(-beam_extinction_per_m * mor_m) == pytest.approx(0.05)
    # The finest details lose as much as the beam (`augment.render.scatter`), large things less.
    visibility_m = KOSCHMIEDER / smog.resolved_extinction_per_m
    assert visibility_m == pytest.approx(mor_m * (1 + scatter) * KOSCHMIEDER / math.log(20))
    assert Smog(visibility_m=visibility_m, scatter=scatter).resolved_extinction_per_m == (
        pytest.approx(smog.resolved_extinction_per_m)
    )
