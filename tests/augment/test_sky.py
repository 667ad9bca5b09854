import torch

from augment.sky import (
    CubemapSky,
    LatLongSky,
    cubemap_coordinates,
    directions_of_cubemap,
    with_border,
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
                for way in (-1, 1):
                    d = torch.zeros(401, 3, dtype=torch.float64)
                    d[:, first], d[:, second] = (
                        signs[0] * (1 - way * near),
                        signs[1] * (1 + way * near),
                    )
                    d[:, 3 - first - second] = along
                    sides.append(sky.sample(d))
                assert (sides[0] - sides[1]).abs().max() < 2 / 255
                assert (sides[0] - smooth(d)).abs().max() < 0.01


def test_a_corner_is_the_mean_of_its_three_texels():
    faces = torch.rand(6, 4, 4, 3, generator=torch.Generator().manual_seed(1))
    bordered = with_border(faces)
    # Face +x holds s along -z and t along -y: its upper left corner looks to (1, 1, 1), as the
    # upper right of +z and the lower right of +y do.
    meet = (faces[0, 0, 0] + faces[4, 0, 3] + faces[2, 3, 3]) / 3
    assert torch.allclose(bordered[0, 0, 0], meet)
    assert torch.allclose(CubemapSky(faces).sample(torch.ones(3)), meet, atol=0.2)


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
    asked = random_directions()
    assert (sky.sample(asked) - smooth(asked)).abs().max() < 0.02


def test_a_latlong_image_has_no_seam_behind():
    sky = LatLongSky(torch.rand(4, 8, 3))
    either_side = torch.tensor([[-1.0, 1e-6, 0.0], [-1.0, -1e-6, 0.0]])
    left, right = sky.sample(either_side)
    assert torch.allclose(left, right, atol=1e-4)
