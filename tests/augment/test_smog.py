import math

import pytest
import torch

from augment.render.fog import Fog, blend_airlight, fog_buffers, optical_depth, sky_optical_depth

GREY = (0.7, 0.75, 0.8)


def layered(sigma: float = 0.02, height: float = 15.0) -> Fog:
    return Fog(sigma, GREY, scale_height_m=height, base_z_m=-1.0)


def quadrature(medium: Fog, distance: float, eye: float, point: float) -> float:
    """The integral of the density along the ray by the midpoint rule."""
    steps = torch.linspace(0, 1, 20_001, dtype=torch.float64)
    z = eye + (point - eye) * (steps[1:] + steps[:-1]) / 2
    assert medium.scale_height_m is not None
    density = medium.sigma_per_m * torch.exp(-(z - medium.base_z_m) / medium.scale_height_m)
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


def test_a_huge_scale_height_is_uniform_smog():
    distance = torch.rand(100, dtype=torch.float64) * 200
    z = torch.rand(100, dtype=torch.float64) * 20
    uniform = optical_depth(Fog(0.02, GREY), distance, 1.6)
    tall = optical_depth(Fog(0.02, GREY, scale_height_m=1e9), distance, 1.6, z)
    assert torch.allclose(tall, uniform, rtol=1e-7)  # (z - z0) / H is 2e-8 at most


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


def test_the_sky_behind_uniform_smog_or_below_the_horizon_is_airlight():
    slopes = torch.linspace(-1, 1, 21)
    uniform = Fog(1e-5, GREY)
    assert torch.equal(
        blend_airlight(torch.rand(21, 3), sky_optical_depth(uniform, slopes, 0.0), uniform),
        torch.tensor(GREY).expand(21, 3),
    )
    tau = sky_optical_depth(layered(), slopes, 1.6)
    assert torch.isinf(tau[slopes <= 0]).all() and torch.isfinite(tau[slopes > 0]).all()


@pytest.mark.parametrize("sigma", [0.0, 1e-30, 100.0])
@pytest.mark.parametrize("height", [None, 1e-3, 1e5])
def test_extremes_stay_finite(sigma, height):
    medium = Fog(sigma, GREY, scale_height_m=height, base_z_m=0.0)
    distance = torch.tensor([0.0, 1e-30, 1.0, 1e8])
    z = torch.tensor([-1e6, 0.0, 1.0, 1e6])
    rgb = torch.rand(4, 3)
    for eye in (-1e4, 0.0, 1e4):
        out = blend_airlight(rgb, optical_depth(medium, distance, eye, z), medium)
        assert torch.isfinite(out).all()
        low, high = torch.minimum(rgb, torch.tensor(GREY)), torch.maximum(rgb, torch.tensor(GREY))
        assert (out >= low - 1e-6).all() and (out <= high + 1e-6).all()  # float32 rounding
        sky = blend_airlight(
            rgb, sky_optical_depth(medium, torch.tensor([-1.0, 0, 1e-30, 1]), eye), medium
        )
        assert torch.isfinite(sky).all()


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
    out = fog_buffers(rgb, alpha, torch.tensor([[10.0, 0.0]]), medium, 0.0)
    t = math.exp(-1)
    assert torch.allclose(out[0, 0], t * rgb[0, 0] + (1 - t) * 0.5 * torch.tensor(GREY))
    assert torch.equal(out[0, 1], torch.zeros(3))


def test_impossible_densities_are_refused():
    for sigma in (-0.1, math.nan, math.inf):
        with pytest.raises(ValueError, match="sigma_per_m must be finite and >= 0"):
            Fog(sigma, GREY)
    with pytest.raises(ValueError, match="scale_height_m must be finite and > 0; got 0"):
        Fog(0.1, GREY, scale_height_m=0.0)
