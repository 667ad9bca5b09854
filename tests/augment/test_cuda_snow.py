"""Snow on a GPU that is pretended: what is seen, and where it can lie, as the CPU finds it."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from augment.effects.snow import placement
from augment.effects.snow.placement import PlacementSettings, place_snow_support
from tests.augment.pretend_gpu import AwayTensor, pretended_gpu
from tests.snow_scenes import box_car, cameras_of, drive, sheet


@pytest.mark.long
def test_a_bed_placed_on_the_gpu_is_the_cpus(monkeypatch):
    small = sheet((0.0, 1.4), (-0.7, 0.7))  # few splats, for an interpreted blend
    ground = dataclasses.replace(small, means=16 * small.means, scales=16 * small.scales)
    scene = drive(ground, places=[(-3.0, 0.0, 1.5)])
    cameras = [camera.scaled(0.12) for camera in cameras_of(scene)]
    settings = PlacementSettings(cell_m=8.0)
    monkeypatch.setattr(placement, "_SQUARE_CELLS", 16)  # several, which threads work on
    expected = place_snow_support(scene, cameras, settings)
    assert len(expected.ground) > 5
    with pretended_gpu(monkeypatch):
        found = place_snow_support(scene, cameras, settings, backend="cuda")
    assert_alike(found.ground, expected.ground)


@pytest.mark.gpu
def test_a_larger_bed_with_a_vehicle_is_the_cpus():
    car = box_car(start=(6.0, 0.0))
    scene = drive(sheet((-6.0, 20.0), (-8.0, 8.0)), actors=[car])
    expected = place_snow_support(scene, cameras_of(scene), PlacementSettings(cell_m=0.1))
    found = place_snow_support(
        scene, cameras_of(scene), PlacementSettings(cell_m=0.1), backend="cuda"
    )
    assert found.actors.keys() == expected.actors.keys() == {"car"}
    for a, b in ((found.ground, expected.ground), (found.actors["car"], expected.actors["car"])):
        assert len(a) == pytest.approx(len(b), rel=1e-3)  # cells at a threshold
        assert float((a.sizes_m**2).sum()) == pytest.approx(float((b.sizes_m**2).sum()), rel=1e-3)


def assert_alike(found, expected) -> None:
    """The same cells; heights and colours within what float32 sums differ by."""
    for field in dataclasses.fields(expected):
        a, b = getattr(found, field.name), getattr(expected, field.name)
        assert not isinstance(a, AwayTensor)
        if a.dtype.is_floating_point:
            torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)
        else:
            assert torch.equal(a, b), field.name
