"""Rain in the air against its laws, its reference, and itself from elsewhere."""

from __future__ import annotations

import dataclasses
import math

import numba
import numpy as np
import pytest
import torch

from augment.effects.falling import air, reference
from augment.effects.falling.air import (
    Glow,
    Precipitation,
    cell_walk,
    compute_clear_share,
    draw_falling,
    find_drops,
    max_depths_m,
    veil_of,
)
from augment.effects.falling.drops import sizes_of
from augment.effects.falling.shutter import STANDING, Motion, motion_of
from augment.errors import SceneError
from augment.render.buffers import REFERENCE
from augment.render.fog import Fog
from augment.render.threads import limit_threads
from augment.scene.cameras import Camera, Frame
from augment.scene.scene import Scene
from augment.scene.sky import ConstantSky
from augment.view.plan import make_plan
from augment.view.render_view import render_view
from recipes.schema import Rain, Recipe, Sensor, Weather
from recipes.snowfall import Snowfall
from tests.scenes import camera_ahead, random_gaussians

RAIN = Precipitation("rain", 20.0, (3.0, -1.0), 0.0, 7, 0.005, 0.25)
FORWARD = Motion(np.array([10.0, 1, 0]), np.array([0, 0, 0.3]))
GLOW = Glow(np.array([0.5, 0.6, 0.7]), np.full(3, 0.3), 0.1 * np.eye(3))


def view(*, width: int = 160, **others) -> Camera:
    return camera_ahead(width, width * 3 // 4, width * 1.0, **others)


def drive(*, seconds: float = 0.1, sky: float = 0.7) -> Scene:
    """Three frames, 0.5 m apart along +x."""
    frames = []
    for index in range(3):
        camera = view(position=(0.5 * index, 0, 1.5), timestamp_ns=round(index * seconds * 1e9))
        camera = dataclasses.replace(camera, name="front")
        pose = torch.eye(4, dtype=torch.float64)
        frames.append(Frame(index, camera.timestamp_ns, pose, {"front": camera}))
    sky_rgb = ConstantSky(torch.tensor([sky, sky, 0.8]))
    return Scene("drive", "test", random_gaussians(200), (), sky_rgb, tuple(frames))


def rain(rate: float, *, exposure_ms: float = 5.0, seed: int = 0, **others) -> Recipe:
    weather = Weather(rain=Rain(rate_mm_h=rate, **others))
    return Recipe(weather=weather, camera=Sensor(exposure_ms=exposure_ms), seed=seed)


# ---- Sizes ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [2.5, 10.0, 50.0, 100.0])
def test_rain_falls_at_its_rate_and_veils_as_measured(rate):
    """0.312 R^0.67 / km: Weber et al. 2015 (rain) as quoted by Tremblay et al. 2020."""
    sizes = sizes_of("rain", rate)
    assert sizes.rate_mm_h == pytest.approx(rate, rel=1e-9)
    assert 1000 * sizes.extinction_per_m == pytest.approx(0.312 * rate**0.67, rel=0.15)


def test_a_millimetre_an_hour_of_snow_lets_see_a_kilometre():
    """Moderate snow by the meteorological optical range, where contrast falls to 5 %."""
    sizes = sizes_of("snow", 1.0)
    assert sizes.rate_mm_h == pytest.approx(1.0)
    assert math.log(20) / sizes.extinction_per_m == pytest.approx(1000, rel=0.2)
    assert 0.6 < sizes.speeds_mps.min() < sizes.speeds_mps.max() < 2


def test_sizes_are_numbers_at_any_rate():
    for rate in (1e-300, 1e-6, 300.0):
        for kind in ("rain", "snow"):
            sizes = sizes_of(kind, rate)
            for field in dataclasses.fields(sizes):
                values = getattr(sizes, field.name)
                assert np.isfinite(values).all() and (values > 0).all(), (kind, rate, field.name)


def test_drops_in_the_lattice_are_as_many_as_the_law_says():
    """As many in the view's pyramid, over 100 heights of it: 5 % is three sigma and more."""
    camera, sizes = view(), RAIN.sizes
    ends = max_depths_m(RAIN, camera)
    found = 0.0
    walk = cell_walk(dataclasses.replace(RAIN, exposure_s=1e-6), camera, STANDING, "x")
    for second in range(100):
        moved = walk._replace(moves=walk.moves + np.array([0.0, 0.0, 1000.0 * second]))
        u, v, *_ = find_drops(moved).T.astype(np.float64)
        inside = (u >= 0) & (u <= camera.width) & (v >= 0) & (v <= camera.height)
        found += inside.sum()
    volume = camera.width * camera.height / (3 * camera.fx * camera.fy)
    drops = 100 * volume * (sizes.counts_per_m3 * ends**3).sum()
    assert found == pytest.approx(drops, rel=0.05)


# ---- Where drops are, and what they cover --------------------------------------------------------


def test_the_same_drop_is_in_two_cameras():
    """What one sees of a point, projected by hand, the other finds at the same place."""
    still = dataclasses.replace(RAIN, exposure_s=1e-9)
    cameras = [view(), view(position=(0.05, 0.1, 0.02), yaw=0.1)]
    seen = [find_drops(cell_walk(still, c, STANDING, "x")).astype(np.float64) for c in cameras]
    u, v, _, _, per_z = seen[0].T[:5]
    local = np.stack([(u - cameras[0].cx) / cameras[0].fx, (v - cameras[0].cy) / cameras[0].fy])
    local = np.concatenate([local, np.ones((1, len(u)))]) / per_z
    pose = cameras[0].world_from_camera.numpy()
    other = cameras[1].camera_from_world.numpy()
    there = other[:3, :3] @ (pose[:3, :3] @ local + pose[:3, 3:]) + other[:3, 3:]
    x = cameras[1].fx * there[0] / there[2] + cameras[1].cx
    y = cameras[1].fy * there[1] / there[2] + cameras[1].cy
    away = np.hypot(x[:, None] - seen[1][:, 0], y[:, None] - seen[1][:, 1]).min(1)
    shared = (there[2] > 0.3) & (x > 5) & (x < 155) & (y > 5) & (y < 115) & (there[2] < 1 / per_z)
    assert shared.sum() > 30
    # Float32 rounds columns to 1e-5 px; drops at the end of a class's depth are in one view alone.
    assert np.mean(away[shared] < 1e-2) > 0.9


def test_a_streak_is_as_long_as_its_drop_moves():
    """|v| T f / z of a standing camera that looks level: the fall is across the view."""
    calm = dataclasses.replace(RAIN, wind_mps=(0.0, 0.0))
    camera = view()
    drops = find_drops(cell_walk(calm, camera, STANDING, "x")).astype(np.float64)
    assert np.abs(drops[:, 0] - drops[:, 2]).max() < 1e-3
    fall_m = (drops[:, 3] - drops[:, 1]) / drops[:, 4] / camera.fy
    speeds = calm.sizes.speeds_mps * calm.exposure_s
    assert np.abs(fall_m[:, None] - speeds).min(1).max() < 1e-4
    assert len(np.unique(np.abs(fall_m[:, None] - speeds).argmin(1))) >= 4


def test_streaks_radiate_from_where_the_camera_drives_to():
    camera = view()
    motion = Motion(np.array([200.0, 0, 0]), np.zeros(3))
    drops = find_drops(cell_walk(RAIN, camera, motion, "x")).astype(np.float64)
    outward = (drops[:, 2:4] - drops[:, :2]) * (drops[:, :2] - (camera.cx, camera.cy))
    assert (outward.sum(1) > 0).mean() > 0.97


@pytest.mark.parametrize("kind", ["rain", "snow"])
def test_kernels_equal_their_reference(kind):
    falling = Precipitation(kind, 5.0 if kind == "rain" else 1.0, (3.0, -1.0), 0.3, 7, 0.01, 0.25)
    camera = view(yaw=0.3, timestamp_ns=10**18)
    walk = cell_walk(falling, camera, FORWARD, "x")
    drops, slow = find_drops(walk), reference.find_drops_by_numpy(walk)
    assert len(drops) == len(slow) > 30
    order, slow_order = np.lexsort(drops.T), np.lexsort(slow.T)
    np.testing.assert_allclose(drops[order], slow[slow_order], rtol=1e-5, atol=1e-4)
    rng = np.random.default_rng(0)
    alpha, depth = rng.random((2, 120, 160), np.float32)
    depth *= 8 * (depth > 0.2)
    clear = compute_clear_share(drops, alpha, depth)
    np.testing.assert_allclose(clear, reference.cover_by_numpy(drops, alpha, depth), atol=1e-5)


@pytest.mark.parametrize("width", [160, 149, 5])
def test_the_veil_kernel_equals_its_definition(width):
    """Also where rows do not fill registers."""
    falling = dataclasses.replace(RAIN, rate_mm_h=100.0)
    camera, scene, rng = view(yaw=0.3), drive(), np.random.default_rng(1)
    camera = camera.cropped(0, 0, width, 120)
    alpha, depth = (torch.from_numpy(rng.random((120, width), np.float32)) for _ in range(2))
    rgb = torch.from_numpy(rng.random((120, width, 3), np.float32))
    depth = torch.where(depth > 0.2, 40 * depth**4, 0.0)
    depth[40:80] += 30.0
    rest = alpha, depth, camera, falling
    for splats in (0.5 * rgb, None):
        own = rgb.clone()
        slow, slow_mask = draw_falling(
            own.clone(), *rest, scene=scene, splats=splats, backend=REFERENCE
        )
        fast, mask = draw_falling(own, *rest, scene=scene, splats=splats)
        np.testing.assert_allclose(fast, slow, atol=1e-4)
        assert (mask == slow_mask).all() and (width < 8 or 0.01 < mask.float().mean() < 0.5)
        assert fast.data_ptr() == own.data_ptr() or width < 8


def test_a_bright_sky_does_not_shine_through_the_edges_of_what_is_near():
    """Half a splat, half a sky that the veil hides: the mean of both behind their veils."""
    scene, shape, camera = drive(), (120, 160), view()
    falling = dataclasses.replace(RAIN, rate_mm_h=300.0, min_width_px=50.0)  # all is veil
    dark, bright, near = 0.1, 1.0, torch.full(shape, 3.0)

    def veiled(value: float, alpha: float, splats: float):
        whole = torch.full((*shape, 3), value)
        parts = torch.full((*shape, 3), splats)
        opacity = torch.full(shape, alpha)
        return draw_falling(whole, opacity, near, camera, falling, scene=scene, splats=parts)[0]

    half = veiled(0.5 * (dark + bright), 0.5, 0.5 * dark)
    mean = 0.5 * (veiled(dark, 1.0, dark) + veiled(bright, 0.0, 0.0))
    np.testing.assert_allclose(half, mean, atol=1e-4)


def test_a_streak_takes_twice_its_drops_cross_section():
    """Whatever its length, its blur and where pixels lie: summed over the image."""
    drops = find_drops(cell_walk(RAIN, view(), FORWARD, "x"))
    inside = (drops[:, :4] > 10).all(1) & (drops[:, [0, 2]] < 150).all(1)
    inside &= (drops[:, [1, 3]] < 110).all(1)
    shape = (120, 160)
    for drop in drops[inside][:60]:
        nothing = np.zeros(shape, np.float32)
        clear = compute_clear_share(drop[None], nothing, nothing)
        area = math.pi / 2 * (drop[7] ** 2 + drop[6] ** 2)  # of the disc, by its profile
        # The smallest disc is sampled at five points or so.
        assert (1 - clear).sum() == pytest.approx(drop[8] * area, rel=0.1)


def moving_disc(length: float, inside: float, outside: float, share: float = 1.0) -> np.ndarray:
    """A drop at the middle of 120 rows of 160 pixels, moving upright, as `find_drops` writes it."""
    v0 = 60 - length / 2
    return np.array([[80.0, v0, 80.0, v0 + length, 0.5, 0.5, inside, outside, share]], np.float32)


@pytest.mark.parametrize(("length", "inside", "outside"), [(30, 3, 6), (0, 8, 12), (4, 0, 1.25)])
def test_a_drop_covers_a_pixel_for_the_time_that_its_disc_is_there(length, inside, outside):
    """By Monte Carlo over the exposure, of the profile that the module states."""
    nothing = np.zeros((120, 160), np.float32)
    clear = compute_clear_share(moving_disc(length, inside, outside), nothing, nothing)
    y, x = np.mgrid[:120, :160] + 0.5
    times = (np.arange(400) + 0.5) / 400
    distances2 = [(x - 80) ** 2 + (y - (60 + length * (t - 0.5))) ** 2 for t in times]
    profiles = [((outside**2 - d) / (outside**2 - inside**2)).clip(0, 1) for d in distances2]
    np.testing.assert_allclose(1 - clear, np.mean(profiles, 0), atol=2e-3)


def test_a_flake_that_rests_is_a_soft_disc_and_one_that_moves_has_tapered_ends():
    nothing = np.zeros((120, 160), np.float32)
    disc = 1 - compute_clear_share(moving_disc(0, 6, 12), nothing, nothing)
    np.testing.assert_allclose(disc[60, 76:84], 1, atol=1e-3)  # flat in the middle
    rim = disc[60, 86:92]
    assert (np.diff(rim) < 0).all() and 0 < rim[-1] < rim[0] < 1
    streak = 1 - compute_clear_share(moving_disc(60, 3, 6), nothing, nothing)
    along, across = streak[:, 80], (streak > 1e-4).sum(1)
    # The middle is even; towards its end the streak fades and narrows over a disc's diameter.
    np.testing.assert_allclose(along[45:75], along[60], rtol=1e-4)
    assert (np.diff(along[84:96]) < 0).all()
    assert across[60] > across[92] > across[94] > 0 == across[97]


def test_no_drop_covers_more_than_all_of_a_pixel():
    """A disc that rests would take two cross-sections from its own area."""
    nothing = np.zeros((120, 160), np.float32)
    drops = np.concatenate([moving_disc(0, 10, 12, share=2.0)] * 2)
    clear = compute_clear_share(drops, nothing, nothing)
    assert clear.min() == 0 and clear.max() == 1


def test_what_is_not_drawn_is_veil():
    """The light that gets through to 400 m is the same whatever is drawn one by one."""
    falling = dataclasses.replace(RAIN, exposure_s=0.02)
    camera, scene = view(width=640), drive()
    shape = (camera.height, camera.width)
    means = []
    for width in (0.25, 1.0, 16.0):
        own = dataclasses.replace(falling, min_width_px=width)
        white, solid, far = (
            torch.full((*shape, 3), 0.5),
            torch.ones(shape),
            torch.full(shape, 400.0),
        )
        drops = find_drops(cell_walk(own, camera, FORWARD, scene.name))
        clear = compute_clear_share(drops, solid.numpy(), far.numpy())
        rgb, _ = draw_falling(white, solid, far, camera, own, scene=scene, motion=FORWARD)
        extinction, _, grows, _, whole = veil_of(own, camera, GLOW).bands.astype(np.float64).T
        tau = float((extinction * (400 - whole + grows / 2)).sum())
        means.append(tau - math.log(float(clear.mean())))
        assert torch.isfinite(rgb).all()
    assert means[0] > means[2] * 0.99
    np.testing.assert_allclose(means, 400 * falling.sizes.extinction_per_m, rtol=0.02)


def test_drops_behind_a_surface_are_hidden():
    drops, shape = find_drops(cell_walk(RAIN, view(), STANDING, "x")), (120, 160)
    near = np.full(shape, 0.1, np.float32)
    assert (compute_clear_share(drops, np.ones(shape, np.float32), near) == 1).all()


def test_eddies_carry_flakes_at_their_speed_and_bring_them_back():
    at, phase = np.random.default_rng(0).normal(0, 10, (500, 3)), np.linspace(0, 1, 500)
    times = np.arange(0, 20, 0.01)
    path = np.stack([reference.sway(at, t, phase, 0.3) for t in times])
    speed = np.linalg.norm(np.diff(path, axis=0), axis=-1) / 0.01
    assert 0.2 < speed.mean() < 0.5
    assert np.linalg.norm(path, axis=-1).max() < 0.3 * air.SWAY_REACH_S


# ---- In a picture --------------------------------------------------------------------------------


def test_nothing_falls_at_rate_0():
    scene = drive()
    camera = scene.frames[1].cameras["front"]
    weather = Weather(rain=Rain(rate_mm_h=0.0), snowfall=Snowfall(rate_mm_h=0.0))
    clean, dry = (render_view(scene, camera, r) for r in (Recipe(), Recipe(weather=weather)))
    assert (clean.rgb == dry.rgb).all()
    placed = make_plan(Recipe(weather=weather), scene).effect_plans
    assert not any(s.runs for name in ("rain", "snowfall") for s in placed[name].steps)


def test_the_same_bytes_from_any_number_of_threads_alone_or_among_others():
    pictures = []
    for threads, frames in ((1, [1]), (2, [0, 1]), (numba.config.NUMBA_NUM_THREADS, [2, 1])):
        limit_threads(threads)
        scene = drive()
        views = {f: render_view(scene, scene.frames[f].cameras["front"], rain(50)) for f in frames}
        pictures.append(views[1])
    limit_threads(None)
    assert all((p.rgb == pictures[0].rgb).all() for p in pictures)
    assert all((p.masks["rain"] == pictures[0].masks["rain"]).all() for p in pictures)
    assert 0 < (pictures[0].masks["rain"] > 0).mean() < 0.5


def test_streaks_hardly_show_before_the_sky_and_brighten_the_dark():
    scene, camera, shape = drive(), view(width=320), (240, 320)
    falling = dataclasses.replace(RAIN, rate_mm_h=50.0)
    contrast = []
    for level in (0.05, 0.8):
        rgb, near = torch.full((*shape, 3), level), torch.full(shape, 8.0)
        drops = find_drops(cell_walk(falling, camera, STANDING, scene.name))
        clear = compute_clear_share(drops, np.ones(shape, np.float32), near.numpy())
        out, streak = draw_falling(rgb, torch.ones(shape), near, camera, falling, scene=scene)
        contrast.append(float(out[streak].mean() - out[clear > 0.999].mean()))
    assert contrast[0] > 0.03
    assert abs(contrast[1]) < contrast[0] / 2


@pytest.mark.parametrize(
    ("rate", "exposure_ms", "fog", "depth"),
    [
        (1e-6, 100.0, None, 0.0),
        (300.0, 100.0, Fog(0.05, (0.5, 0.5, 0.5)), 1e6),
        (300.0, 1e-3, Fog(1e-9, (0.5, 0.5, 0.5), 15.0, -1e6), 1e-6),
        (300.0, 5.0, Fog(100.0, (0.5, 0.5, 0.5), 15.0, 1e6), 1e-6),
    ],
)
def test_numbers_stay_finite(rate, exposure_ms, fog, depth):
    falling = Precipitation("rain", rate, (60.0, 0.0), 0.0, 0, exposure_ms / 1000, 0.1)
    shape, scene = (120, 160), drive(sky=0.0)
    rgb = torch.tensor([-1.0, 0.0, 3.0]).expand(*shape, 3).contiguous()
    z = torch.full(shape, depth)
    for backend in ("cpu", REFERENCE):
        out, _ = draw_falling(
            rgb.clone(), torch.ones(shape), z, view(), falling,
            scene=scene, fog=fog, motion=FORWARD, backend=backend,
        )  # fmt: skip
        assert torch.isfinite(out).all()


# ---- The camera's motion -------------------------------------------------------------------------


def test_a_cameras_motion_is_that_between_its_neighbours():
    scene = drive()
    for frame in scene.frames:
        motion = motion_of(scene, frame.cameras["front"])
        np.testing.assert_allclose(motion.velocity_mps, [5, 0, 0], atol=1e-9)
        np.testing.assert_allclose(motion.turn_radps, 0, atol=1e-9)


def test_a_turning_camera_turns_while_the_shutter_is_open():
    motion = Motion(np.zeros(3), np.array([0, 0, 0.5]))
    camera, later = view(), view(yaw=0.5 * 0.1)
    np.testing.assert_allclose(
        motion.pose_after(camera, 0.1), later.camera_from_world.numpy(), atol=1e-12
    )


def test_without_times_cameras_stand():
    scene = drive(seconds=0.0)
    assert motion_of(scene, scene.frames[0].cameras["front"]) is STANDING
    (step,) = make_plan(rain(5.0), scene).effect_plans["rain"].steps
    assert "so they stand" in step.why


def test_a_shutter_open_for_longer_than_a_frame_is_refused():
    with pytest.raises(SceneError, match="exposure_ms = 100 is not below the 100 ms between"):
        make_plan(rain(5.0, exposure_ms=100.0), drive())
    make_plan(rain(0.0, exposure_ms=100.0), drive())
