import dataclasses
import math
from decimal import Decimal, localcontext

import numpy as np
import pytest
import torch

from augment.cameras import Camera
from augment.effects.flood.waves import (
    GRAVITY_MPS2,
    WaveSet,
    make_waves,
    normals_from_tangents,
    phases_of,
    tangents_of,
    turns_at,
    wave_field,
)
from augment.geometry import rigid
from recipes.flood import Wave, Waves

NOW = 1_700_000_000_123_456_789  # a timestamp of today's recordings
RMS_SLOPES = {"calm": 0.012, "breeze": 0.04, "wind": 0.09}


def waves_of(count: int = 5, *, steepness: float = 0.5, low=0.4, high=6.0, slope=0.3) -> WaveSet:
    """Waves of all directions, a total steepness and a total slope (sum of k A)."""
    rng = np.random.default_rng(count)
    angles = rng.uniform(0, 2 * math.pi, count)
    share = rng.uniform(0.5, 1.5, count)
    share /= share.sum()
    wavelengths = np.geomspace(low, high, count)
    return WaveSet(
        directions=np.stack([np.cos(angles), np.sin(angles)], axis=1),
        amplitudes_m=slope * share * wavelengths / (2 * math.pi),
        wavelengths_m=wavelengths,
        steepness=steepness * share,
        phases_rad=rng.uniform(0, 2 * math.pi, count),
        depth_m=0.4,
    )


def displaced_surface(waves: WaveSet, points: torch.Tensor, timestamp_ns: int) -> torch.Tensor:
    """Where points [N, 2] of the still plane are at that time; z counts from its level."""
    surface = torch.nn.functional.pad(points, (0, 1))
    phases = phases_of(waves, turns_at(waves, timestamp_ns), points)
    for i, (dx, dy) in enumerate(waves.directions.tolist()):
        theta = phases[..., i]
        across = float(waves.steepness[i] / waves.wavenumbers[i]) * theta.cos()
        lift = float(waves.amplitudes_m[i]) * theta.sin()
        surface = surface + torch.stack([dx * across, dy * across, lift], dim=-1)
    return surface


def wave_normals(waves: WaveSet, points: torch.Tensor, timestamp_ns: int) -> torch.Tensor:
    """Unit normals over parameter points, with every wave at full height."""
    theta = phases_of(waves, turns_at(waves, timestamp_ns), points)
    return normals_from_tangents(tangents_of(waves, theta))


def camera_at(
    eye, *, down_deg=6.0, yaw_deg=40.0, roll_deg=0.0, size=(97, 61), focal=90.0, time=NOW
) -> Camera:
    """A camera that looks down_deg below the horizon; yaw 0 is world +x."""
    yaw, down, roll = (math.radians(a) for a in (yaw_deg, down_deg, roll_deg))
    forward = [math.cos(yaw) * math.cos(down), math.sin(yaw) * math.cos(down), -math.sin(down)]
    forward = torch.tensor(forward, dtype=torch.float64)
    right = torch.tensor([math.sin(yaw), -math.cos(yaw), 0.0], dtype=torch.float64)
    below = torch.linalg.cross(forward, right)
    right, below = (
        math.cos(roll) * right + math.sin(roll) * below,
        math.cos(roll) * below - math.sin(roll) * right,
    )
    rotation = torch.stack([right, below, forward])
    pose = rigid(rotation, -rotation @ torch.tensor(eye, dtype=torch.float64))
    width, height = size
    return Camera("c", width, height, focal, 1.1 * focal, width / 2, height / 2, pose, time)


def random_points(count: int, extent_m: float = 50.0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(0).uniform(-extent_m, extent_m, (count, 2)))


# What a recipe draws


def test_the_same_seed_draws_the_same_bits():
    first, again = (make_waves(Waves(preset="wind"), seed=5, depth_m=0.5) for _ in range(2))
    for field in dataclasses.fields(WaveSet):
        assert np.array_equal(getattr(first, field.name), getattr(again, field.name))
    other = make_waves(Waves(preset="wind"), seed=6, depth_m=0.5)
    assert not np.array_equal(first.wavelengths_m, other.wavelengths_m)
    own = make_waves(Waves(preset="wind", seed=6), seed=5, depth_m=0.5)
    assert np.array_equal(own.phases_rad, other.phases_rad)


def test_the_first_numbers_of_a_seed_are_pinned():
    waves = make_waves(Waves(preset="breeze", count=3), seed=1, depth_m=0.5)
    # Twelve digits: cosines and powers may differ in the last bits between machines.
    wavelengths = [0.0804594348773729, 0.3843134351955985, 2.0991211404386902]
    phases = [2.751173005872406, 1.4414570607582793, 5.628359912392606]
    assert waves.wavelengths_m.tolist() == pytest.approx(wavelengths, rel=1e-12)
    assert waves.phases_rad.tolist() == pytest.approx(phases, rel=1e-12)


@pytest.mark.parametrize(("preset", "count"), [("calm", 1), ("breeze", 24), ("wind", 64)])
def test_a_preset_has_its_rms_slope_whatever_the_count(preset, count):
    waves = make_waves(Waves(preset=preset, count=count), seed=3, depth_m=0.5)
    assert len(waves.wavelengths_m) == count
    waves = dataclasses.replace(waves, steepness=np.zeros(count))  # sines, whose slopes add
    # Over kilometres: two waves of nearly one length still beat within fifty metres.
    normals = wave_normals(waves, random_points(8000, 5000.0), NOW)
    slopes = (normals[:, :2] / normals[:, 2:]).square().sum(-1)
    # 8000 samples of a square that varies as much as its mean: 1.1 %, halved by the root.
    assert float(slopes.mean().sqrt()) == pytest.approx(RMS_SLOPES[preset], rel=0.02)


# Time


def test_waves_travel_as_fast_as_their_depth_allows():
    waves = waves_of(2, low=0.01, high=1000.0)
    deep = dataclasses.replace(waves, depth_m=math.inf)
    speed = deep.frequencies_hz * deep.wavelengths_m
    assert np.allclose(speed, np.sqrt(GRAVITY_MPS2 / deep.wavenumbers), rtol=1e-14)
    shallow = dataclasses.replace(waves, depth_m=1e-4)
    # k h is at most 0.06 here: tanh(x) / x is 1 - x^2 / 3.
    speed = shallow.frequencies_hz * shallow.wavelengths_m
    assert np.allclose(speed, math.sqrt(GRAVITY_MPS2 * 1e-4), rtol=1e-3)


@pytest.mark.parametrize("time", [0, 1, -5, 10**18, NOW, -NOW])
def test_phases_keep_their_precision_at_any_time(time):
    waves = waves_of(64, low=1e-3, high=1e3)
    turns = turns_at(waves, time)
    with localcontext() as context:
        context.prec = 80
        for frequency, phase, turn in zip(
            waves.frequencies_hz, waves.phases_rad, turns, strict=True
        ):
            passed = Decimal(float(frequency)) * time / 10**9
            exact = Decimal(float(phase) / (2 * math.pi)) - passed - Decimal(float(turn))
            # Whole turns, and two roundings of numbers below 1.
            assert abs(exact - exact.to_integral_value()) < 4e-16


# The surface


def test_a_wave_lifts_and_gathers_the_surface_at_its_crest():
    wave = Wave(direction_deg=0, amplitude_m=0.2, wavelength_m=4, steepness=0.5)
    waves = make_waves(Waves(components=(wave,)), seed=0, depth_m=1.0)
    points = torch.tensor([[0.0, 0], [1, 0], [2, 0], [3, 7]], dtype=torch.float64)
    reach = 0.5 * 4 / (2 * math.pi)
    expected = [[reach, 0, 0], [1, 0, 0.2], [2 - reach, 0, 0], [3, 7, -0.2]]
    found = displaced_surface(waves, points, 0)
    assert torch.allclose(found, torch.tensor(expected, dtype=torch.float64), atol=1e-15)


@pytest.mark.parametrize("steepness", [0.0, 0.5, 0.98])
def test_normals_are_those_of_the_displaced_surface(steepness):
    waves = waves_of(64, steepness=steepness, slope=0.9)
    points = random_points(500)
    step = 1e-5
    tangents = []
    for axis in range(2):
        shift = torch.zeros(2, dtype=torch.float64)
        shift[axis] = step
        ahead = displaced_surface(waves, points + shift, NOW)
        tangents.append((ahead - displaced_surface(waves, points - shift, NOW)) / (2 * step))
    expected = torch.linalg.cross(*tangents)
    expected = expected / expected.norm(dim=-1, keepdim=True)
    normals = wave_normals(waves, points, NOW)
    assert float(normals[:, 2].min()) > 0
    # Central differences: (k step)^2 / 6 = 4e-9 of the slope for the shortest wave, and 1e-14 m /
    # 1e-5 m from rounding 50 m; ten times that where the crests are steep.
    assert torch.allclose(normals, expected, atol=5e-8)
    assert torch.allclose(normals.norm(dim=-1), torch.ones(500, dtype=torch.float64), atol=1e-14)


# What a camera sees

CAMERAS = {
    "driving": camera_at([0.0, 0, 1.5]),
    "rolled": camera_at([3.0, 1, 1.5], roll_deg=25),
    "on its side": camera_at([3.0, 1, 1.5], roll_deg=90),
    "along the surface": camera_at([0.0, 0, 0.02], down_deg=0),
    "down": camera_at([1.0, 2, 3.0], down_deg=90),
    "up": camera_at([1.0, 2, 3.0], down_deg=-90),
    "under water": camera_at([1.0, 2, -0.3], down_deg=-20, roll_deg=5),
    "far from the origin": camera_at([5000.0, -5000, 1.5]),
    "at 1e9 s": camera_at([0.0, 0, 1.5], time=10**18),
    "one pixel": camera_at([0.0, 0, 1.5], size=(1, 1)),
    "a row": camera_at([0.0, 0, 1.5], size=(301, 1), roll_deg=10),
    "a column": camera_at([0.0, 0, 1.5], size=(1, 77)),
    "tele": camera_at([0.0, 0, 1.5], down_deg=3, focal=4000.0),
}

SETS = {
    "one": waves_of(1),
    "24": waves_of(24, steepness=0.8, slope=0.8),
    "64": waves_of(64, steepness=0.5, slope=2.0, low=0.05),
    "1 mm and 1 km": waves_of(2, low=1e-3, high=1e3),
}


def fields_of(waves: WaveSet, camera: Camera, *, backend: str, level_z_m: float = 0.0):
    field = wave_field(waves, camera, level_z_m, backend=backend)
    return torch.stack([field.normal_x, field.normal_y, field.slope_variance])


@pytest.mark.parametrize(
    ("waves", "cameras"),
    [
        ("24", CAMERAS),
        ("one", ["tele"]),
        ("64", ["rolled"]),
        ("1 mm and 1 km", ["driving", "down"]),
    ],
)
def test_the_kernel_matches_the_definition(waves, cameras):
    for name in cameras:
        assert_matches_the_definition(SETS[waves], CAMERAS[name])
        seen = fields_of(SETS[waves], CAMERAS[name], backend="reference")
        assert bool((seen != 0).any()) == (name != "up")


def assert_matches_the_definition(waves: WaveSet, camera: Camera) -> None:
    fast = fields_of(waves, camera, backend="cpu")
    slow = fields_of(waves, camera, backend="reference")
    assert fast.shape == slow.shape and fast.dtype == slow.dtype == torch.float32
    # Turns from an anchor at most 64 pixels away, at 4 pixels a turn: 16 * 6e-8 * 2 pi = 6e-6
    # radians at worst, times a slope of at most 1, over the 0.2 that the steepest crest leaves
    # of a unit area.
    assert float((fast - slow).abs().max()) < 1e-5


def footprint_by_differences(camera: Camera, row: int, column: int) -> tuple[np.ndarray, ...]:
    """The plane point of a pixel, its change per pixel [2, 2], and the ray, by moving the image."""

    def point(dx: float, dy: float) -> np.ndarray:
        moved = dataclasses.replace(camera, cx=camera.cx - dx, cy=camera.cy - dy)
        ray = moved.ray_directions(torch.float64)[row, column].numpy()
        eye = camera.centre.numpy()
        return eye[:2] - eye[2] / ray[2] * ray[:2]

    step = 1e-5
    columns = (point(step, 0) - point(-step, 0)) / (2 * step)
    rows = (point(0, step) - point(0, -step)) / (2 * step)
    ray = camera.ray_directions(torch.float64)[row, column].numpy()
    return point(0, 0), np.stack([columns, rows], axis=1), ray


@pytest.mark.parametrize("camera", ["rolled", "tele"])
def test_the_field_is_what_its_definition_says_pixel_by_pixel(camera):
    camera, waves = CAMERAS[camera], waves_of(12, steepness=0.6, slope=1.0, low=0.05, high=3.0)
    field = fields_of(waves, camera, backend="reference")
    rays = camera.ray_directions(torch.float64)
    seen = torch.nonzero(rays[..., 2] < -0.02)[::37].tolist()
    assert len(seen) > 20
    partly = 0
    for row, column in seen:
        place, footprint, ray = footprint_by_differences(camera, row, column)
        view = ray[:2] / np.hypot(*ray[:2])
        heights, variance, xx, xy, yy = np.zeros(2), 0.0, 0.0, 0.0, 0.0
        for i, turn in enumerate(turns_at(waves, camera.timestamp_ns)):
            d, k = waves.directions[i], waves.wavenumbers[i]
            pixels = 2 * math.pi / (k * np.hypot(*(footprint.T @ d)))
            x = min(max((pixels - 2) / 2, 0), 1)
            weight = 3 * x**2 - 2 * x**3
            partly += 0 < weight < 1
            theta = k * (d @ place) + 2 * math.pi * turn
            heights += weight * k * waves.amplitudes_m[i] * math.cos(theta) * d
            squeeze = weight * waves.steepness[i] * math.sin(theta)
            xx, xy, yy = (
                xx + squeeze * d[0] ** 2,
                xy + squeeze * d[0] * d[1],
                yy + squeeze * d[1] ** 2,
            )
            slope = k * waves.amplitudes_m[i] * (d @ view)
            variance += 0.5 * slope**2 * (1 - weight**2)
        normal = np.cross([1 - xx, -xy, heights[0]], [-xy, 1 - yy, heights[1]])
        normal /= np.linalg.norm(normal)
        expected = [normal[0], normal[1], variance]
        # Differences of 1e-5 px leave 1e-9 of the footprint; the field is stored in float32.
        assert field[:, row, column].tolist() == pytest.approx(expected, abs=3e-7)
    assert partly > 10
