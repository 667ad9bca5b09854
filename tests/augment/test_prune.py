"""Splats that no recorded view would miss: what their absence changes, and from where they go."""

from __future__ import annotations

import dataclasses
import pickle

import numpy as np
import pytest
import torch

from augment.detail import prune
from augment.detail.lod import MIN_SPLATS
from augment.effects import JobContext, precompute_effects
from augment.memo import memo_of
from augment.render.rasterize import rasterize
from augment.render.threads import limit_threads
from augment.scene.cameras import Camera, Frame
from augment.scene.scene import Gaussians, PosedGaussians, Scene
from augment.scene.sky import ConstantSky
from augment.view.plan import make_plan
from augment.view.render_view import render_buffers, render_view
from recipes.schema import Output, Recipe, Render
from recipes.speed import Speed
from tests.scenes import camera_ahead, one_gaussian, random_gaussians, stack
from tests.streets import open_street

HIDDEN = (
    1e-4  # what the wall's hidden splats change together is less, and any splat of the wall more
)


def scene_of(gaussians: Gaussians, *cameras: Camera) -> Scene:
    frames = tuple(
        Frame(n, camera.timestamp_ns, torch.eye(4, dtype=torch.float64), {camera.name: camera})
        for n, camera in enumerate(cameras)
    )
    sky = ConstantSky(torch.full((3,), prune.SKY_LUMA))
    return Scene("pruned", "test:pruned", gaussians, actors=(), frames=frames, sky=sky)


def buffers(scene: Scene, camera: Camera, error: float):
    recipe = Recipe(render=Render(speed=Speed(prune=error)), output=Output(depth="median"))
    return render_buffers(scene, camera, make_plan(recipe, scene), backend="cpu")


def luma(gaussians: Gaussians, camera: Camera) -> torch.Tensor:
    out = rasterize([PosedGaussians(gaussians)], camera, backend="cpu")
    assert out.rgb is not None and out.alpha is not None
    rgb = out.rgb + (1 - out.alpha)[..., None] * prune.SKY_LUMA
    return rgb.double() @ torch.tensor(prune.LUMA, dtype=torch.float64)


def test_changes_are_those_of_pictures_without_the_splat(monkeypatch):
    monkeypatch.setattr(prune, "ROUND_ERRORS", (np.inf,))
    splats = random_gaussians(40, seed=3, sh_degree=1)
    splats = dataclasses.replace(splats, opacities=splats.opacities.clamp(0.02, 0.9))
    camera = camera_ahead(64, 48, 50.0)
    errors = prune.errors_of(scene_of(splats, camera))
    full_luma, is_framed = luma(splats, camera), np.isfinite(errors)
    assert 10 < is_framed.sum() < 40  # some stand behind the camera
    order, errors_by_order = np.argsort(errors), np.zeros(40)
    errors_by_order[order] = np.diff(
        errors[order].clip(max=1), prepend=0
    )  # of one view: their running sum
    for i in np.flatnonzero(is_framed):
        left = splats.select(torch.arange(40) != i)
        change = abs(float((luma(left, camera) - full_luma).mean()))
        assert (
            errors_by_order[i] >= 0.97 * change - 1e-7
        )  # the cut-off at 1/255 comes sooner or later
        splat_view = rasterize(
            [PosedGaussians(splats.select(torch.tensor([i])))], camera, backend="cpu"
        )
        assert splat_view.alpha is not None  # weights are no more than alphas
        most = max(change * 1.03, prune.MIN_CONTRAST * float(splat_view.alpha.mean()))
        assert errors_by_order[i] <= most + 1e-7


def street_of_walls() -> tuple[Scene, Camera]:
    """A red wall, 100 splats that it hides, one beside it, and one behind the camera."""
    y, z = np.meshgrid(np.linspace(-3, 3, 13), np.linspace(-2, 2, 9))
    wall = stack(*(one_gaussian((5.0, *at), 0.5, 0.999) for at in zip(y.flat, z.flat, strict=True)))
    hidden_splats = random_gaussians(100, seed=1, sh_degree=0, size=0.1)
    hidden_splats.means[:] = torch.tensor([12.0, 0, 0]) + hidden_splats.means * 0.05
    front_splats = stack(one_gaussian((5.0, 2.9, 0.0), 0.01, 0.05), one_gaussian((-5.0, 0.0, 0.0)))
    camera = camera_ahead(64, 48, 50.0)
    return scene_of(stack(wall, hidden_splats, front_splats), camera), camera


def test_hidden_splats_go_without_a_trace_and_those_that_no_view_framed_stay():
    scene, camera = street_of_walls()
    errors = prune.errors_of(scene)
    assert np.isinf(errors[-1]) and (errors[117:217] < HIDDEN).all()
    bare, less = buffers(scene, camera, 0), buffers(scene, camera, HIDDEN)
    opacities = less.parts[0].gaussians.opacities
    assert (opacities[117:217] == 0).all() and opacities[-1] > 0
    assert (opacities[:117] > 0).sum() > 110  # of a corner no pixel may be in the frame
    assert float((bare.rgb - less.rgb).abs().mean()) < 2.5 * HIDDEN  # of colours, see below
    assert less.depth_m is not None and bare.depth_m is not None
    assert float((less.depth_m != bare.depth_m).double().mean()) < 0.01
    assert (scene.background.opacities[117:217] > 0).all()  # nobody's scene is written to


def test_the_mean_change_follows_what_was_asked_for():
    scene = scene_of(random_gaussians(3000, seed=5, sh_degree=0), camera_ahead(64, 48, 50.0))
    (camera,) = scene.frames[0].cameras.values()
    full_rgb = buffers(scene, camera, 0).rgb
    errors = list[float]()
    for error in (1e-4, 1e-3, 1e-2):
        change = buffers(scene, camera, error).rgb - full_rgb
        # Neighbours that go together uncover each other, the more the more of them go.
        assert abs(float((change @ torch.tensor(prune.LUMA)).mean())) <= 2.5 * error
        errors.append(float(change.abs().mean()))
    assert 0 < errors[0] < errors[1] < errors[2]


def test_a_front_of_small_splats_does_not_go_as_a_whole(monkeypatch):
    """None of them is missed while the others cover what is behind it."""
    x, y, z = np.meshgrid(np.linspace(20, 20.4, 8), *[np.linspace(-2, 2, 21)] * 2)
    places = zip(x.flat, y.flat, z.flat, strict=True)
    front = stack(*(one_gaussian(at, 0.08, 0.6) for at in places))
    camera, error, changes, stay = camera_ahead(64, 48, 50.0), 3e-3, list[float](), list[bool]()
    for rounds in ((np.inf,), prune.ROUND_ERRORS):
        monkeypatch.setattr(prune, "ROUND_ERRORS", rounds)
        stays = torch.from_numpy(prune.errors_of(scene_of(front, camera)) > error)
        left = dataclasses.replace(front, opacities=torch.where(stays, 0.6, 0.0))
        changes.append(abs(float((luma(left, camera) - luma(front, camera)).mean())))
        stay.append(bool(stays.any()))
    assert stay == [False, True]
    # 1.5 and 2.3 times: sums of single changes know nothing of neighbours that go in one round.
    assert changes[1] < 1.6 * error < 2.2 * error < changes[0]


def test_more_is_found_where_more_is_asked_for():
    scene = scene_of(random_gaussians(3000, seed=5, sh_degree=0), camera_ahead(64, 48, 50.0))
    for threads in (1, 2):
        limit_threads(threads)
        try:
            full_errors, slowly = (
                prune.errors_of(dataclasses.replace(scene)),
                dataclasses.replace(scene),
            )
            part = prune.errors_of(slowly, 3e-4).copy()
            assert prune.errors_of(slowly, 1e-4) is prune.errors_of(slowly, 3e-4)
            np.testing.assert_array_equal(part, np.where(part <= 4e-4, full_errors, np.inf))
            assert (part[full_errors <= 3e-4] <= 3e-4).all()
            assert np.isinf(part).sum() > np.isinf(full_errors).sum()
            np.testing.assert_array_equal(prune.errors_of(slowly), full_errors)
        finally:
            limit_threads(None)


def test_views_in_levels_change_nothing_for_those_after_them():
    g = random_gaussians(MIN_SPLATS, seed=2, sh_degree=0, size=0.05)
    scene = scene_of(g, camera := camera_ahead(64, 48, 50.0))
    before = buffers(scene, camera, 1e-3).rgb
    recipe = Recipe(render=Render(speed=Speed(lod_px=1.0)))
    render_buffers(scene, camera, make_plan(recipe, scene), backend="cpu")
    assert torch.equal(buffers(scene, camera, 1e-3).rgb, before)
    assert not torch.equal(buffers(scene, camera, 0.0).rgb, before)


def test_views_from_elsewhere_draw_all():
    scene, camera = street_of_walls()
    near, far = (camera_ahead(64, 48, 50.0, position=(0.0, 0.0, up)) for up in (1.9, 2.1))
    for view, is_pruned in ((camera, True), (near, True), (far, False)):
        opacities = buffers(scene, view, HIDDEN).parts[0].gaussians.opacities
        assert bool((opacities[117:217] == 0).all()) is is_pruned


@pytest.mark.parametrize("render", [Render(), Render(speed=Speed(prune=0.1, lod_px=1.0))])
def test_nothing_is_looked_for_where_nothing_is_left_out(render: Render):
    scene, camera = street_of_walls()
    recipe = Recipe(render=render)
    precompute_effects(JobContext(scene, [recipe]))
    assert not memo_of(scene).shared()
    plan = make_plan(recipe, scene)
    assert plan.prune == 0
    left = render_buffers(scene, camera, plan, backend="cpu").parts[0].gaussians.opacities
    assert left is scene.background.opacities
    assert prune.prune_error_of(Render(speed=Speed(prune=0.1), base="recorded")) == 0


def test_other_processes_take_the_changes_over():
    scene, camera = street_of_walls()
    recipe = Recipe(render=Render(speed=Speed(prune=HIDDEN)))
    precompute_effects(JobContext(scene, [recipe]))
    other = dataclasses.replace(scene)
    memo_of(other).take_shared(pickle.loads(pickle.dumps(memo_of(scene).shared())))
    np.testing.assert_array_equal(prune.errors_of(other), prune.errors_of(scene))
    alone = dataclasses.replace(scene)
    assert torch.equal(
        buffers(other, camera, HIDDEN).rgb, buffers(alone, camera, HIDDEN).rgb
    )  # the same bits, whoever found them


def test_wet_ground_mirrors_what_recorded_views_would_not_miss():
    """From under the ground more is seen than from above: the sky would shine through."""
    scene = open_street(has_wet_ground=True)
    camera = scene.frames[0].cameras["front"].scaled(0.2)
    dry, wet = (
        [
            render_view(
                scene,
                camera,
                Recipe(weather={"rain": rain}, render=Render(speed=Speed(prune=error))),
            )
            for error in (0.0, 2e-3)
        ]
        for rain in ({"rate_mm_h": 10, "wetness": 0.0, "puddles": 0.0}, {"rate_mm_h": 10})
    )
    low = slice(camera.height // 2, None)  # where the ground is
    off = [float(np.abs(b.rgb[low].astype(int) - a.rgb[low]).mean()) for a, b in (dry, wet)]
    assert 0 < off[1] < 1.5 * off[0]  # 1.1 times; 2.05 where the mirror lacks what is left out


def test_scenes_of_vehicles_alone_are_drawn_whole():
    street = open_street()
    nothing = street.background.select(torch.zeros(0, dtype=torch.int64))
    scene = dataclasses.replace(street, background=nothing)
    camera = scene.frames[0].cameras["front"].scaled(0.1)
    recipes = [Recipe(render=Render(speed=Speed(prune=error))) for error in (0.0, 1e-3)]
    precompute_effects(JobContext(scene, recipes))
    full_rgb, left = (render_view(scene, camera, recipe).rgb for recipe in recipes)
    np.testing.assert_array_equal(full_rgb, left)


def test_weather_is_drawn_on_what_is_left():
    scene = open_street()
    camera = scene.frames[0].cameras["front"].scaled(0.1)
    weather = {"snow": {"depth_m": 0.1, "cell_m": 0.4}, "flood": {"level_m": 0.1}}
    views = [
        render_view(scene, camera, Recipe(weather=weather, render=Render(speed=Speed(prune=error))))
        for error in (0.0, 2e-3)
    ]
    off = np.abs(views[0].rgb.astype(int) - views[1].rgb).mean()
    assert 0 < off < 2  # levels of 255
    for name, mask in views[0].masks.items():
        assert (mask != views[1].masks[name]).mean() < 0.01
