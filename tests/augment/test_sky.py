import torch

from augment.sky import (
    ConstantSky,
    CubemapSky,
    LatLongSky,
    cubemap_coordinates,
    directions_of_cubemap,
)


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
    # Bilinear error is about (texel angle)^2 / 8 times the curvature, and half a texel is clamped
    # at face edges: 0.02 at 64 texels a face.
    assert (sky.sample(directions) - smooth(directions)).abs().max() < 0.02


def test_a_latlong_image_reproduces_a_smooth_function():
    height, width = 128, 256
    elevation = (0.5 - (torch.arange(height) + 0.5) / height) * torch.pi
    azimuth = ((torch.arange(width) + 0.5) / width - 0.5) * 2 * torch.pi
    e, a = torch.meshgrid(elevation, azimuth, indexing="ij")
    directions = torch.stack([e.cos() * a.cos(), e.cos() * a.sin(), e.sin()], -1)
    sky = LatLongSky(smooth(directions))
    asked = random_directions()
    assert (sky.sample(asked) - smooth(asked)).abs().max() < 0.02


def test_a_latlong_image_has_no_seam_behind():
    sky = LatLongSky(torch.rand(4, 8, 3))
    either_side = torch.tensor([[-1.0, 1e-6, 0.0], [-1.0, -1e-6, 0.0]])
    left, right = sky.sample(either_side)
    assert torch.allclose(left, right, atol=1e-4)


def test_a_constant_sky_is_constant():
    sky = ConstantSky(torch.tensor([0.1, 0.2, 0.3]))
    assert torch.equal(sky.sample(torch.zeros(2, 5, 3)), sky.rgb.expand(2, 5, 3))
