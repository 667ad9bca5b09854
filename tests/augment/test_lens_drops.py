"""Drops on the glass before the lens: their optics, where they are, what of a view they touch."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from augment.effects.lens_drops.drops import Drops, LensDropsPlan, drops_at
from augment.effects.lens_drops.optics import blend_drops, draw_drops, map_surroundings
from augment.render.buffers import CPU, REFERENCE
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import rigid
from augment.scene.scene import Scene
from augment.view.layers import LayerRenderer
from augment.view.plan import make_plan, plan_view
from augment.view.render_view import render_view
from recipes.lens_drops import LensDrops
from recipes.schema import Output, Rain, Recipe, Render, Sensor, Smog, Weather
from tests.streets import LABELLED_STREET, open_street

GLASS_M = 0.05
CAMERA_AXES = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]], dtype=torch.float64)  # from ego


def camera(time_ns: int = 0, width: int = 480, height: int = 270, x_m: float = 0.0) -> Camera:
    """One that looks along the world's x."""
    pose = rigid(CAMERA_AXES, CAMERA_AXES @ torch.tensor([-x_m, 0, 0], dtype=torch.float64))
    return Camera("front", width, height, 490.0, 490.0, width / 2, height / 2, pose, time_ns)


def one_drop(radius_m: float, right_m: float = 0.0, down_m: float = 0.0) -> Drops:
    centre = np.array([[right_m, down_m]])
    return Drops(centre, np.array([radius_m]), np.zeros((1, 4)), np.array([math.radians(65)]))


def seen_through(drops: Drops, rgb: torch.Tensor, aperture_m: float, backend: str = CPU):
    view = camera(width=rgb.shape[1], height=rgb.shape[0])
    around = map_surroundings(rgb, view, None, level=False)
    drawn = draw_drops(drops, around, view, glass_m=GLASS_M, aperture_m=aperture_m)
    return *blend_drops(rgb.clone(), *drawn, backend=backend), drawn


def driving(scene: Scene, speed_mps: float) -> Scene:
    """The scene with ten seconds of a drive along x."""
    poses = [rigid(torch.eye(3).double(), torch.tensor([speed_mps * t, 0, 0]).double())
             for t in range(11)]  # fmt: skip
    frames = tuple(Frame(t, 10**9 * t, pose, {}) for t, pose in enumerate(poses))
    return dataclasses.replace(scene, frames=frames)


def placed(**fields) -> LensDropsPlan:
    drops = LensDrops(**{"count": 200, "radius_mm": 2.0} | fields)
    return LensDropsPlan(drops, seed=5)


# ---- Optics --------------------------------------------------------------------------------------


def test_a_drop_shows_the_scene_upside_down_and_darkens_towards_its_rim():
    rgb = torch.zeros(270, 480, 3)
    rgb[:135, :, 0], rgb[135:, :, 2], rgb[:, 240:, 1] = 0.8, 0.8, 0.8  # red above, green right
    radius_px = round(0.003 / GLASS_M * 490)
    seen, mask, _ = seen_through(one_drop(0.003), rgb, 1e-5)
    off = radius_px // 2
    above_left, below_right = seen[135 - off, 240 - off], seen[135 + off, 240 + off]
    assert above_left[2] > 0.7 and above_left[0] < 0.01 and above_left[1] > 0.7
    assert below_right[0] > 0.7 and below_right[2] < 0.01 and below_right[1] < 0.01
    rim = seen[135 - radius_px + 2, 240]
    assert float(rim.max()) < 0.2 and not bool(mask[135 - radius_px - 2, 240])
    inside = mask.sum().item() / (math.pi * (0.003 / GLASS_M * 490) ** 2)
    assert inside == pytest.approx(1, abs=0.03)
    outside = ~mask & (seen == rgb).all(-1)
    assert outside.sum() > 0.99 * (~mask).sum()


@pytest.mark.parametrize("radius_mm", [0.5, 1.0, 4.0])
def test_a_drop_covers_its_share_of_the_aperture(radius_mm):
    aperture_m = 0.0016
    grey = torch.full((270, 480, 3), 0.5)
    _, _, (layer, step, margin) = seen_through(one_drop(radius_mm / 1000), grey, aperture_m)
    middle = layer[round(135 / step) + margin, round(240 / step) + margin, 3]
    assert middle == pytest.approx(min(1, (radius_mm / 1.6) ** 2), rel=0.06)
    # Through the aperture a drop takes as much light altogether as in a pinhole camera.
    area_px = math.pi * (radius_mm / 1000 / GLASS_M * 490) ** 2
    assert layer[..., 3].sum() * step**2 == pytest.approx(area_px, rel=0.08)


def test_kernel_and_torch_blend_alike_and_leave_what_no_drop_covers():
    rgb = torch.rand(67, 93, 3, generator=torch.Generator().manual_seed(1)) * 1.2 - 0.1
    for aperture_m in (1e-5, 0.0004, 0.002):
        drops = one_drop(0.0012, 0.001, -0.001)
        own, mask, _ = seen_through(drops, rgb, aperture_m)
        other, other_mask, _ = seen_through(drops, rgb, aperture_m, REFERENCE)
        torch.testing.assert_close(own * own.abs(), other * other.abs(), rtol=0, atol=1e-5)
        assert (mask != other_mask).sum() <= 2  # at the threshold itself
        assert torch.equal(own[-1], rgb[-1]) and mask.any()


def test_above_the_picture_drops_see_the_sky_in_its_fog():
    scene = open_street()
    own = scene.frames[0].cameras["front"].scaled(0.25)
    dark = torch.zeros(own.height, own.width, 3)
    recipe = Recipe(camera=Sensor(lens_drops=LensDrops(count=1)))
    layers = make_layers(scene, own, recipe)
    clear = map_surroundings(dark, own, layers, level=True)
    foggy_recipe = Recipe(weather=Weather(smog=Smog(visibility_m=50, color=(0.6, 0.6, 0.6))))
    foggy = map_surroundings(dark, own, make_layers(scene, own, foggy_recipe), level=True)
    middle = len(clear) // 2
    assert clear[0, middle].max() > 0.1 and clear[middle, middle].max() == 0 == clear[-1].max()
    assert foggy[0, middle] == pytest.approx(0.36, abs=1e-5)
    assert map_surroundings(dark, own, layers, level=False).max() == 0


def make_layers(scene: Scene, own: Camera, recipe: Recipe):
    """What a view is drawn from, by the effects of the recipe."""
    plan = make_plan(recipe, scene)
    layers = LayerRenderer((), scene.sky, None, False, plan.settings, CPU)
    for active in plan_view(plan, scene, own).effects:
        layers = active.hooks.edit_scene(active, layers, own)
    return layers


# ---- Where drops are -----------------------------------------------------------------------------


def test_drops_are_a_function_of_time_and_stay_where_they_are_at_any_resolution():
    scene = driving(open_street(), 10)
    first = drops_at(placed(), scene, camera(4 * 10**9))
    drops_at(placed(), scene, camera(5 * 10**9))
    for other in (camera(4 * 10**9), camera(4 * 10**9).scaled(2.0)):
        again = drops_at(placed(), dataclasses.replace(scene), other)
        for a, b in zip(first, again, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-15)
    others = [
        drops_at(dataclasses.replace(placed(), seed=6), scene, camera(4 * 10**9)),
        drops_at(placed(), scene, dataclasses.replace(camera(4 * 10**9), name="left")),
    ]
    assert all(abs(o.centres_m[0] - first.centres_m[0]).max() > 1e-4 for o in others)


def test_fewer_drops_are_the_first_of_more():
    scene = driving(open_street(), 10)
    few, many = (drops_at(placed(count=n), scene, camera(3)) for n in (20, 200))
    np.testing.assert_array_equal(few.centres_m, many.centres_m[:20])
    logs = np.log(drops_at(placed(count=500), scene, camera(3)).radii_m / 0.002)
    assert abs(np.median(logs)) < 0.06 and logs.std() == pytest.approx(0.4, rel=0.1)


def test_rain_brings_drops_by_its_rate_and_none_without_it():
    own = LensDrops(wiper_s=4.0)
    counts = [LensDropsPlan(own, 0, rate).count_on(camera()) for rate in (0.0, 2.5, 10.0, 100.0)]
    area_m2, flux = (GLASS_M / 490) ** 2 * 480 * 270, (0, 1381, 3114, 9743)  # by the integral
    assert counts == pytest.approx([4 * area_m2 * f for f in flux], rel=0.08)
    assert LensDropsPlan(own, 0, 300.0).count_on(camera().scaled(2.0)) <= 500
    scene = open_street(LABELLED_STREET)
    dry, wet = Recipe(), Recipe(weather=Weather(rain=Rain(rate_mm_h=20.0)))
    for recipe, runs in ((dry, False), (wet, True)):
        recipe = recipe.model_copy(update={"camera": Sensor(lens_drops=own)})
        steps = {step.name: step for step in make_plan(recipe, scene).steps}
        assert (steps["lens drops"].runs == runs and "rain" in steps["lens drops"].why) or runs


def test_a_wiper_clears_the_glass_and_drops_come_back_one_by_one():
    scene, wiped = driving(open_street(), 10), placed(wiper_s=2.0)
    counts = np.array(
        [len(drops_at(wiped, scene, camera(k * 10**7)).radii_m) for k in range(0, 400, 2)]
    )
    (wipes,) = np.nonzero(np.diff(counts) < 0)
    assert len(wipes) == 2 and wipes[1] - wipes[0] == 100
    assert counts[wipes].min() > 190 and counts[wipes + 1].max() < 9
    assert counts[wipes[0] + 50] == pytest.approx(100, abs=25)


def test_large_drops_run_down_at_rest_and_up_on_a_motorway_and_small_ones_stay():
    def way_m(speed_mps: float, radius_mm: float) -> float:
        scene = driving(open_street(), speed_mps)
        own = placed(radius_mm=radius_mm, radius_spread=0.0)
        before, after = (drops_at(own, scene, camera(n)) for n in (8 * 10**9, 9 * 10**9))
        moved = after.centres_m - before.centres_m
        stayed = np.abs(moved).max(1) < 0.02  # those that no other has followed
        return float(np.median(moved[stayed, 1]))

    assert way_m(0, 2.2) > 1e-3 and way_m(30, 2.2) < -1e-3
    assert abs(way_m(15, 2.2)) < 1e-9 and way_m(0, 1.0) == way_m(30, 1.0) == 0


def test_numbers_stay_finite_at_the_extremes():
    rgb = torch.rand(40, 60, 3)
    scene = dataclasses.replace(open_street(), frames=(), has_known_gravity=False)
    for fields in (
        {"count": 500, "radius_mm": 20.0, "radius_spread": 1.5},
        {"count": 500, "radius_mm": 1e-6},
        {"count": 30, "glass_m": 2.0, "f_number": 0.5, "focal_mm": 500.0},
        {"count": 30, "glass_m": 0.003, "radius_mm": 20.0, "f_number": 64.0, "focal_mm": 0.5},
    ):
        own = LensDrops(**fields)
        view = camera(2**62, 60, 40)
        drops = drops_at(LensDropsPlan(own, 2**62), scene, view)
        around = map_surroundings(rgb, view, None, level=False)
        drawn = draw_drops(drops, around, view, glass_m=own.glass_m, aperture_m=own.aperture_m)
        seen, _ = blend_drops(rgb.clone(), *drawn, backend=CPU)
        assert torch.isfinite(seen).all() and seen.min() >= 0 and seen.max() <= 1.001


# ---- In a recipe ---------------------------------------------------------------------------------


def street_recipe(count: int | None, **fields) -> Recipe:
    drops = None if count is None else LensDrops(count=count, **{"f_number": 6.0} | fields)
    return Recipe(
        camera=Sensor(lens_drops=drops),
        render=Render(scale=0.5),
        output=Output(semantic=True, instance=True),
        seed=3,
    )


def test_drops_touch_the_picture_alone_and_none_of_its_bits_without_drops():
    scene = open_street(LABELLED_STREET)
    view = scene.frames[0].cameras["front"]
    bare, none, some, many = (
        render_view(scene, view, street_recipe(count)) for count in (None, 0, 20, 200)
    )
    assert np.array_equal(bare.rgb, none.rgb) and not none.masks["lens_drops"].any()
    covered = [(v.masks["lens_drops"] == 255).mean() for v in (some, many)]
    assert 0 < covered[0] < covered[1]
    changed = (many.rgb != bare.rgb).any(-1)
    assert changed[many.masks["lens_drops"] == 255].mean() > 0.8
    for field in ("depth_m", "semantic", "instance"):
        assert np.array_equal(getattr(many, field), getattr(bare, field))
    again = render_view(open_street(LABELLED_STREET), view, street_recipe(200))
    assert np.array_equal(again.rgb, many.rgb)
    steps = {step.name: step for step in make_plan(street_recipe(20), scene).steps}
    assert steps["lens drops"].runs and "20 drops" in steps["lens drops"].why
    why = {n: make_plan(street_recipe(n), scene).steps for n in (None, 0)}
    assert all(not s.runs for steps in why.values() for s in steps if s.name == "lens drops")


def test_drops_by_the_share_of_the_picture_need_no_rain():
    scene = open_street(LABELLED_STREET)
    view = next(iter(scene.frames[0].cameras.values()))
    shares = []
    for share in (0.05, 0.35):
        recipe = Recipe(camera=Sensor(lens_drops=LensDrops(share=share)))
        rendered = render_view(scene, view, recipe)
        shares.append((rendered.masks["lens_drops"] == 255).mean())
    assert 0 < shares[0] < shares[1]


def test_fields_are_limited_and_old_hashes_stay():
    for wrong in (
        {"count": -1}, {"count": 501}, {"count": 2.5}, {"count": 3, "radius_mm": 0},
        {"count": 3, "glass_m": 0.0}, {"count": 3, "wiper_s": 0.0}, {"count": 3, "f_number": 0.1},
        {"count": 3, "focal_mm": math.nan}, {"count": 3, "radius_spread": -0.1}, {"drops": 3},
    ):  # fmt: skip
        with pytest.raises(ValueError):
            LensDrops.model_validate(wrong)
    noisy = Recipe(camera=Sensor(noise=0.01))
    assert noisy.hash == "92c71cfa2471dc19"
