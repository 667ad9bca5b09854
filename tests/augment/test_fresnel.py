import math

import pytest
import torch

from augment.effects.flood.flood import exact, schlick


def cosines(*degrees: float) -> torch.Tensor:
    return torch.cos(torch.deg2rad(torch.tensor(degrees, dtype=torch.float64)))


def test_head_on_both_give_the_textbook_value():
    expected = (0.333 / 2.333) ** 2
    for model in (exact, schlick):
        assert float(model(cosines(0.0), 1.333)[0]) == pytest.approx(expected, rel=1e-12)


def test_grazing_light_is_reflected_whole():
    edge = torch.zeros(1, dtype=torch.float64)
    for index in (1.1, 1.333, 3.0):
        assert float(exact(edge, index)) == 1 and float(schlick(edge, index)) == 1


def test_an_index_of_one_reflects_nothing():
    cosine = torch.tensor([0.0, 1e-6, 0.3, 1.0])
    assert not exact(cosine, 1.0).any() and not schlick(cosine, 1.0).any()


def test_brewsters_angle_leaves_only_the_perpendicular_part():
    index = 1.333
    brewster = math.degrees(math.atan(index))
    c, t = math.cos(math.radians(brewster)), math.sin(math.radians(brewster))
    rs = (c - index * t) / (c + index * t)  # refracted and reflected ray stand at right angles
    assert float(exact(cosines(brewster), index)[0]) == pytest.approx(rs * rs / 2, rel=1e-12)


def test_both_sides_of_the_surface_reflect_alike():
    # Stokes: a ray and the one it refracts into see the same reflectance from either side.
    index, angles = 1.333, torch.linspace(0, 89, 90, dtype=torch.float64)
    c = torch.cos(torch.deg2rad(angles))
    t = torch.sqrt(1 - (1 - c * c) / index**2)
    assert torch.allclose(exact(c, index), exact(t, 1 / index), atol=1e-12)


def test_light_under_water_is_totally_reflected_beyond_the_critical_angle():
    critical = math.degrees(math.asin(1 / 1.333))
    beyond = cosines(critical + 1e-6, 60.0, 89.0, 90.0)
    assert torch.equal(exact(beyond, 1 / 1.333), torch.ones(4, dtype=torch.float64))
    assert float(exact(cosines(critical - 1), 1 / 1.333)[0]) < 0.7


def test_what_schlick_misses():
    angles = torch.linspace(0, 90, 9001, dtype=torch.float64)
    c = torch.cos(torch.deg2rad(angles))
    miss = (schlick(c, 1.333) - exact(c, 1.333)).abs()
    # Half a unit of the last digit of the figures in schlick's docstring.
    assert float(miss[angles <= 70].max()) == pytest.approx(0.009, abs=5e-4)
    assert float(miss[7500]) == pytest.approx(0.027, abs=5e-4)
    assert float(miss.max()) == pytest.approx(0.059, abs=5e-4)
    assert float(angles[miss.argmax()]) == pytest.approx(84, abs=0.5)


def test_gradients_stay_finite_from_end_to_end():
    c = torch.linspace(0, 1, 11, dtype=torch.float64, requires_grad=True)
    exact(c, 1.333).sum().backward()
    assert torch.isfinite(c.grad).all()
