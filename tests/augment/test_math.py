"""Spherical harmonics, skies, rotations, cameras and random numbers."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from augment.errors import SceneError
from augment.render.sh import evaluate_sh, rotate_sh, sh_basis
from augment.rng import rng_for
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import multiply_quats, quat_from_rotmat, rigid, rotmat_from_quat, slerp
from augment.scene.sky import CubemapSky, LatLongSky, cubemap_coordinates, directions_of_cubemap


def _directions(count, seed=0):
    rng = np.random.default_rng(seed)
    vectors = torch.from_numpy(rng.normal(size=(count, 3)))
    return torch.nn.functional.normalize(vectors, dim=-1)


def _rotation(seed):
    return rotmat_from_quat(torch.from_numpy(np.random.default_rng(seed).normal(size=4)))


def _coefficients(count, degree, seed=1):
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.normal(size=(count, (degree + 1) ** 2, 3)))


def test_basis_is_orthonormal_over_the_sphere():
    # Gauss-Legendre in z and equal steps in azimuth integrate polynomials of degree 6 exactly.
    nodes, weights = np.polynomial.legendre.leggauss(8)
    azimuth = np.arange(16) * (2 * math.pi / 16)
    z, phi = np.meshgrid(nodes, azimuth, indexing="ij")
    radius = np.sqrt(1 - z * z)
    points = np.stack([radius * np.cos(phi), radius * np.sin(phi), z], -1)
    basis = sh_basis(torch.from_numpy(points), 3).numpy()
    area = weights[:, None] * (2 * math.pi / 16)
    gram = np.einsum("ij,ijk,ijl->kl", np.broadcast_to(area, z.shape), basis, basis)
    np.testing.assert_allclose(gram, np.eye(16), atol=1e-13)


def test_signs_and_order_of_the_trained_convention():
    x, y, z = torch.eye(3, dtype=torch.float64)
    c1 = 0.4886025119029199
    torch.testing.assert_close(sh_basis(x, 1)[1:], torch.tensor([0.0, 0.0, -c1]).double())
    torch.testing.assert_close(sh_basis(y, 1)[1:], torch.tensor([-c1, 0.0, 0.0]).double())
    torch.testing.assert_close(sh_basis(z, 1)[1:], torch.tensor([0.0, c1, 0.0]).double())
    diagonal = torch.full((3,), 1 / math.sqrt(3), dtype=torch.float64)
    signs = torch.sign(sh_basis(diagonal, 3)[[4, 5, 7, 9, 10, 11, 12, 13, 15]])
    assert signs.tolist() == [1, -1, -1, -1, 1, -1, -1, -1, 1]


@pytest.mark.parametrize("cut", [0, 1, 2, 3])
def test_max_degree_leaves_higher_bands_out(cut):
    sh, directions = _coefficients(5, 3), _directions(5)
    low_bands = sh[:, : (cut + 1) ** 2]
    assert torch.equal(evaluate_sh(sh, directions, cut), evaluate_sh(low_bands, directions))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rotating_equals_looking_from_the_inversely_rotated_direction(degree):
    sh, directions, rotation = _coefficients(7, degree), _directions(7), _rotation(2)
    turned = evaluate_sh(rotate_sh(sh, rotation), directions)
    expected = evaluate_sh(sh, directions @ rotation)  # rows R^T d
    torch.testing.assert_close(turned, expected, rtol=0, atol=1e-12)  # float64 rounding


def test_gradients():
    sh = _coefficients(3, 3).requires_grad_()
    directions = _directions(3).requires_grad_()
    assert torch.autograd.gradcheck(evaluate_sh, (sh, directions))


def smooth(directions: torch.Tensor) -> torch.Tensor:
    unit = torch.nn.functional.normalize(directions, dim=-1)
    return 0.5 + 0.4 * unit * unit.roll(1, -1)


def random_directions() -> torch.Tensor:
    return torch.randn(2000, 3, generator=torch.Generator().manual_seed(1)) * 5


def test_texel_directions_land_on_their_own_texel():
    size = 8
    face, s, t = cubemap_coordinates(directions_of_cubemap(size))
    ticks = (torch.arange(size) + 0.5) / size * 2 - 1
    assert torch.equal(face, torch.arange(6)[:, None, None].expand(6, size, size))
    assert torch.allclose(s, ticks.expand(6, size, size), atol=1e-6)  # float32 rounding
    assert torch.allclose(t, ticks[:, None].expand(6, size, size), atol=1e-6)


def test_opengl_faces():
    """The cube map table: on the +x face s runs along -z and t along -y, and so on."""
    cases = {
        (1.0, 0.2, 0.3): (0, -0.3, -0.2),
        (-1.0, 0.2, 0.3): (1, 0.3, -0.2),
        (0.2, 1.0, 0.3): (2, 0.2, 0.3),
        (0.2, -1.0, 0.3): (3, 0.2, -0.3),
        (0.2, 0.3, 1.0): (4, 0.2, -0.3),
        (0.2, 0.3, -1.0): (5, -0.2, -0.3),
    }
    for direction, (face, s, t) in cases.items():
        got = cubemap_coordinates(torch.tensor(direction))
        assert int(got[0]) == face
        assert torch.allclose(torch.stack(got[1:]), torch.tensor([s, t]))


def test_a_cubemap_reproduces_a_smooth_function():
    sky = CubemapSky(smooth(directions_of_cubemap(64)))
    directions = random_directions()
    # Bilinear error is about (texel angle)^2 / 8 times the curvature, also across face edges.
    assert (sky.sample(directions) - smooth(directions)).abs().max() < 0.004


def test_a_cubemap_has_no_seams():
    """Steps across every edge are as small as steps inside faces."""
    size = 32
    sky = CubemapSky(smooth(directions_of_cubemap(size)))
    along = torch.linspace(-1, 1, 401, dtype=torch.float64)
    near = torch.full_like(along, 1e-6)
    for first in range(3):
        for second in range(first + 1, 3):
            for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
                sides = []
                for side in (-1, 1):
                    d = torch.zeros(401, 3, dtype=torch.float64)
                    d[:, first], d[:, second] = (
                        signs[0] * (1 - side * near),
                        signs[1] * (1 + side * near),
                    )
                    d[:, 3 - first - second] = along
                    sides.append(sky.sample(d))
                assert (sides[0] - sides[1]).abs().max() < 2 / 255
                assert (sides[0] - smooth(d)).abs().max() < 0.01


def test_the_border_follows_faces_that_change():
    sky = CubemapSky(torch.zeros(6, 4, 4, 3))
    assert float(sky.sample(torch.ones(3)).max()) == 0
    sky.faces.fill_(0.5)
    assert torch.allclose(sky.sample(torch.ones(3)), torch.full((3,), 0.5))


def test_a_latlong_image_reproduces_a_smooth_function():
    height, width = 128, 256
    elevation = (0.5 - (torch.arange(height) + 0.5) / height) * torch.pi
    azimuth = ((torch.arange(width) + 0.5) / width - 0.5) * 2 * torch.pi
    e, a = torch.meshgrid(elevation, azimuth, indexing="ij")
    directions = torch.stack([e.cos() * a.cos(), e.cos() * a.sin(), e.sin()], -1)
    sky = LatLongSky(smooth(directions))
    sampled_directions = random_directions()
    assert (sky.sample(sampled_directions) - smooth(sampled_directions)).abs().max() < 0.02


# float64 arithmetic of a few dozen operations: 1e-12 leaves four digits of slack.
EXACT = 1e-12


def random_quats(count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    quats = torch.randn(count, 4, generator=generator, dtype=torch.float64)
    return torch.nn.functional.normalize(quats, dim=-1)


def test_rotation_matrices_are_proper_and_round_trip():
    quats = random_quats(100)
    rotations = rotmat_from_quat(3.0 * quats)  # length does not matter
    identity = torch.eye(3, dtype=torch.float64).expand(100, 3, 3)
    assert torch.allclose(rotations @ rotations.transpose(1, 2), identity, atol=EXACT)
    assert torch.allclose(torch.det(rotations), torch.ones(100, dtype=torch.float64), atol=EXACT)
    back = quat_from_rotmat(rotations)
    sign = torch.sign((back * quats).sum(-1, keepdim=True))
    assert torch.allclose(back, sign * quats, atol=EXACT)


def test_quarter_turns_compose():
    quarter = torch.tensor([math.sqrt(0.5), 0, 0, math.sqrt(0.5)], dtype=torch.float64)
    half = multiply_quats(quarter, quarter)
    x = torch.tensor([1.0, 0, 0], dtype=torch.float64)
    assert torch.allclose(rotmat_from_quat(quarter) @ x, x.roll(1), atol=EXACT)  # x -> y
    assert torch.allclose(rotmat_from_quat(half) @ x, -x, atol=EXACT)


def test_product_of_quaternions_is_product_of_matrices():
    a, b = random_quats(50), random_quats(50).flip(0)
    expected = rotmat_from_quat(a) @ rotmat_from_quat(b)
    assert torch.allclose(rotmat_from_quat(multiply_quats(a, b)), expected, atol=EXACT)


def test_slerp_moves_at_constant_speed_the_shorter_way():
    a = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    angle = 1.2
    b = torch.tensor([math.cos(angle / 2), 0, 0, math.sin(angle / 2)], dtype=torch.float64)
    for fraction in (0.0, 0.25, 0.5, 1.0):
        at = slerp(a, -b, torch.tensor(fraction, dtype=torch.float64))  # -b is the same rotation
        expected = [math.cos(angle * fraction / 2), 0, 0, math.sin(angle * fraction / 2)]
        assert torch.allclose(at, torch.tensor(expected, dtype=torch.float64), atol=EXACT)


def camera(**changes) -> Camera:
    rotation = rotmat_from_quat(torch.tensor([0.9, 0.1, -0.3, 0.2], dtype=torch.float64))
    base = Camera(
        name="front",
        width=97,
        height=61,
        fx=80.0,
        fy=83.0,
        cx=47.3,
        cy=31.9,
        camera_from_world=rigid(rotation, torch.tensor([0.4, -1.0, 2.0]).double()),
    )
    return dataclasses.replace(base, **changes)


def test_ray_through_a_pixel_projects_back_to_its_centre():
    cam = camera()
    points = cam.centre + 7.5 * cam.ray_directions(torch.float64)  # depth 7.5 at every pixel
    in_camera = points @ cam.camera_from_world[:3, :3].T + cam.camera_from_world[:3, 3]
    assert torch.allclose(in_camera[..., 2], torch.full((61, 97), 7.5, dtype=torch.float64))
    pixels = in_camera @ cam.K.T / 7.5
    assert pixels[0, 0, :2].tolist() == pytest.approx([0.5, 0.5])
    assert pixels[60, 96, :2].tolist() == pytest.approx([96.5, 60.5])


def test_scaling_keeps_the_field_of_view():
    cam = camera(width=1920, height=1080, fx=1970.0, fy=1970.0, cx=970.0, cy=483.3)
    half = cam.scaled(0.5)
    assert (half.width, half.height) == (960, 540)
    assert half.fx == 985.0 and half.cx == 485.0
    assert cam.scaled(1.0) is cam
    odd = cam.scaled(0.3333)  # sides round, and the intrinsics follow each side's true ratio
    assert odd.fx / odd.width == pytest.approx(cam.fx / cam.width)
    assert odd.cy / odd.height == pytest.approx(cam.cy / cam.height)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 0}, "width and height must be >= 1 px; got 0x61"),
        ({"fx": -80.0}, "fx must be finite and > 0"),
        ({"fy": math.nan}, "fy must be finite"),
        ({"cx": math.inf}, "cx must be finite"),
        ({"camera_from_world": 2 * torch.eye(4, dtype=torch.float64)}, "rigid"),
        ({"camera_from_world": torch.diag(torch.tensor([1.0, 1, -1, 1]).double())}, "rigid"),
        ({"camera_from_world": torch.full((4, 4), math.nan).double()}, "rigid"),
    ],
)
def test_impossible_cameras_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        camera(**changes)


def test_frames_take_lenses_of_1_to_170_degrees_alone():
    def frame(**changes: float) -> Frame:
        cam = camera(**({"width": 100, "height": 60, "cx": 50.0, "cy": 30.0} | changes))
        return Frame(4, 0, torch.eye(4, dtype=torch.float64), {"left": cam})

    shortest, longest = (50 / math.tan(math.radians(deg / 2)) for deg in (170, 1))
    for focal in (shortest, longest):
        frame(fx=focal, fy=focal, cx=-950.0, cy=1030.0)
    for changes, message in (
        ({"fx": 0.99 * shortest}, "fx must be from 4.374 to 5729 px.*100x60.*got 4.33"),
        ({"fy": 1.01 * longest}, "fy must be from 4.374 .*got 5786"),
        ({"fy": 1e-320}, "fy must be from 4.374 .*got 9.99989e-321"),
        ({"cx": -951.0}, "cx must lie within 1000 px .*100x60; got -951"),
        ({"cy": 1e12}, "cy must lie within 1000 px"),
    ):
        with pytest.raises(SceneError, match=f"frame 4, camera 'left': {message}"):
            frame(**changes)


KEY = {"seed": 7, "scene": "street", "effect": "snow.flakes", "frame": 3, "camera": "front"}


def first(**changes: object) -> float:
    return float(rng_for(**{**KEY, **changes}).random())


def test_the_first_numbers_are_pinned() -> None:
    """Written data depends on them: they are the same in every version, on every platform."""
    assert rng_for(seed=0, scene="s", effect="e").random(3).tolist() == [
        0.45683649455347763,
        0.4501256850477985,
        0.4131717658034758,
    ]
    assert rng_for(**KEY).random(3).tolist() == [
        0.7187658359476665,
        0.8643062832301446,
        0.119411030876862,
    ]
    assert rng_for(**KEY).integers(0, 1000, 5).tolist() == [877, 718, 200, 864, 397]


def test_the_same_key_starts_anew() -> None:
    first_rng, second_rng = rng_for(**KEY), rng_for(**KEY)
    first_rng.random(100)
    assert first() == float(second_rng.random())


def test_every_part_of_the_key_counts() -> None:
    other_rngs = [
        {},
        {"seed": 8},
        {"scene": "streets"},
        {"effect": "snow.size"},
        {"frame": 4},
        {"frame": None},
        {"camera": "rear"},
        {"camera": None},
        {"frame": None, "camera": None},
        {"camera": "None"},
        {"scene": 'street", 3, "front'},  # what a key joined with commas would confuse
        {"scene": ""},
    ]
    assert len({first(**other) for other in other_rngs}) == len(other_rngs)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": -1}, "seed and frame must be >= 0; got seed=-1, frame=3"),
        ({"frame": -2}, "seed and frame must be >= 0; got seed=7, frame=-2"),
        ({"effect": ""}, "effect must name what is drawn"),
    ],
)
def test_wrong_keys(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rng_for(**{**KEY, **changes})
