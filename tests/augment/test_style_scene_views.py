"""Views under colour maps: the folded way against the renderer, and what each view holds."""

import dataclasses

import pytest
import torch
from scenes import camera_ahead, one_gaussian, random_gaussians, sh_of, smooth_gaussians, stack

from augment.cameras import Frame
from augment.effects.style.scene_views import (
    colors_of,
    folded_pictures,
    map_sh,
    open_view,
    rendered_pictures,
    views_of,
)
from augment.errors import SceneError
from augment.render.sh import SH_C0, sh_basis
from augment.scene import Actor, Gaussians, Scene, Track
from augment.sky import ConstantSky

MILD = torch.tensor([[0.8, 0.1, 0.0, 0.05], [0.05, 0.7, 0.1, 0.1], [0.0, 0.15, 0.75, 0.02]])


def scene_of(background: Gaussians, actors=(), cameras=None) -> Scene:
    cameras = {"ahead": camera_ahead(24, 16, 20.0)} if cameras is None else cameras
    frame = Frame(0, 0, torch.eye(4, dtype=torch.float64), cameras)
    sky = ConstantSky(torch.tensor([0.5, 0.7, 0.9]))
    return Scene("test", "test:", background, tuple(actors), sky, (frame,) if cameras else ())


def light_gaussians(count=50, *, seed=0, sh_degree=1) -> Gaussians:
    """None of whose colours comes near 0, from wherever it is seen."""
    made = random_gaussians(count, seed=seed, sh_degree=sh_degree)
    return dataclasses.replace(made, sh=0.4 * made.sh)


def actor() -> Actor:
    pose = torch.eye(4, dtype=torch.float64)[None]
    pose[0, 0, 3] = 3.0
    track = Track(torch.zeros(1, dtype=torch.int64), pose)
    return Actor(
        "a", "car", one_gaussian((0.0, 0.2, 0.0), 0.4, rgb=(0.8, 0.3, 0.3)), track, (1.0, 1.0, 1.0)
    )


@pytest.fixture
def view():
    scene = scene_of(light_gaussians(), [actor()])
    return open_view(scene, scene.frames[0].cameras["ahead"])


def test_folding_agrees_with_the_renderer(view):
    """1e-5 of the values is float32's rounding over some dozen splats."""
    with torch.no_grad():
        rendered = rendered_pictures([view], MILD[None])
    folded = folded_pictures(view.picture[None], MILD[None])
    assert (rendered - folded).abs().max() < 1e-5
    assert (folded[0] - view.picture).abs().max() > 0.1  # the map does something
    assert 0.05 < float(view.alpha.mean()) < 0.95  # both splats and sky are there


def test_the_transposed_blend_gives_the_folded_gradients(view):
    weights = torch.randn(view.picture.shape, generator=torch.Generator().manual_seed(0))
    gradients = []
    for way in (
        lambda m: rendered_pictures([view], m[None]),
        lambda m: folded_pictures(view.picture[None], m[None]),
    ):
        color_map = MILD.clone().requires_grad_(True)
        (way(color_map)[0] * weights).sum().backward()
        gradients.append(color_map.grad)
    assert (gradients[0] - gradients[1]).abs().max() < 1e-4 * gradients[1].abs().max()


def test_gradients_through_the_renderer_are_finite_differences():
    """In float64, by the renderer's definition."""
    scene = scene_of(smooth_gaussians(3))
    camera = camera_ahead(7, 5, 9.0)
    view = open_view(scene_of(light_gaussians(3)), camera)
    view = dataclasses.replace(
        view, alpha=view.alpha.double(), sky=view.sky.double(), parts=scene.parts_for(camera)
    )
    color_map = MILD.double().requires_grad_(True)
    weights = torch.rand(view.picture.shape, dtype=torch.float64)

    def loss(m):
        return (rendered_pictures([view], m[None])[0] * weights).sum()

    (gradient,) = torch.autograd.grad(loss(color_map), color_map)
    step = 1e-5 * torch.randn(3, 4, dtype=torch.float64)
    with torch.no_grad():
        difference = loss(color_map + step) - loss(color_map - step)
    assert float(difference) == pytest.approx(2 * float((gradient * step).sum()), rel=1e-6)
    picture = torch.rand(2, 3, 2, 2, dtype=torch.float64, requires_grad=True)
    maps = torch.stack([color_map.detach(), 2 * color_map.detach()]).requires_grad_(True)
    assert torch.autograd.gradcheck(folded_pictures, (picture, maps))


def test_the_clamp_is_where_the_two_ways_part(view):
    def parted(color_map: torch.Tensor) -> float:
        with torch.no_grad():
            rendered = rendered_pictures([view], color_map[None])
            folded = folded_pictures(view.picture[None], color_map[None])
        return float(((rendered - folded).abs().amax(1) > 1e-4).float().mean())

    assert parted(MILD) == 0
    darker = torch.cat([torch.eye(3), torch.full((3, 1), -0.6)], 1)
    assert parted(darker) > 0.2


def test_mapped_harmonics_evaluate_to_mapped_colours():
    sh = random_gaussians(20, sh_degree=3, dtype=torch.float64).sh
    directions = torch.nn.functional.normalize(torch.randn(20, 3, dtype=torch.float64), dim=1)
    basis = sh_basis(directions, 3)[:, :, None]
    colors, mapped = ((basis * s).sum(1) + 0.5 for s in (sh, map_sh(sh, MILD.double())))
    wanted = colors @ MILD[:, :3].double().T + MILD[:, 3].double()
    assert torch.allclose(mapped, wanted, atol=1e-12)
    assert torch.allclose(map_sh(sh, torch.eye(3, 4).double()), sh, atol=1e-12)


def test_a_view_keeps_what_it_shows_and_no_more():
    behind, black = one_gaussian((-4.0, 0.0, 0.0)), one_gaussian((5.0, 0.5, 0.0), rgb=(-1, -1, -1))
    scene = scene_of(stack(behind, one_gaussian(), black), [actor()])
    view = open_view(scene, scene.frames[0].cameras["ahead"])
    assert [len(part.gaussians) for part in view.parts] == [2, 1]  # a black one may turn light
    with torch.no_grad():
        same = rendered_pictures([view], torch.eye(3, 4)[None])[0]
    assert (same - view.picture).abs().max() < 1e-6
    bare = open_view(scene, view.camera, with_parts=False)
    assert bare.parts == () and torch.equal(bare.picture, view.picture)
    with pytest.raises(ValueError, match="open it with_parts"):
        rendered_pictures([bare], MILD[None])


def test_views_are_squares_of_cameras_spread_over_the_drive():
    frames = tuple(
        Frame(
            number,
            number,
            torch.eye(4, dtype=torch.float64),
            {n: dataclasses.replace(camera_ahead(timestamp_ns=number), name=n) for n in "ab"},
        )
        for number in range(10)
    )
    scene = dataclasses.replace(scene_of(one_gaussian()), frames=frames)
    chosen = [view.camera for view in views_of(scene, 6, 4)]
    assert [camera.name for camera in chosen] == list("ababab")
    times = [camera.timestamp_ns for camera in chosen]
    assert times == sorted(times) and times[0] <= 1 and times[-1] >= 8
    assert len(views_of(scene, 99, 4)) == 20
    views = views_of(scene, 3, 12)
    assert [tuple(view.picture.shape) for view in views] == [(3, 12, 12)] * 3
    wide = camera_ahead()
    corners = [c.ray_directions(torch.float64) for c in (wide, wide.resized(12, 12))]
    half_px = (1 / wide.fx + 1 / wide.resized(12, 12).fx) / 2
    assert (corners[0][0, 0] - corners[1][0, 0]).abs().max() < half_px + 0.02


def test_a_scene_that_no_camera_sees_is_refused():
    with pytest.raises(SceneError, match=r"has no cameras .* camera_path=FILE"):
        views_of(scene_of(one_gaussian(), cameras={}), 4, 4)


def test_colours_are_of_background_and_actors_alike():
    background = light_gaussians(30, sh_degree=1)
    scene = scene_of(background, [actor()])
    every = colors_of(scene)
    assert every.base.shape == (1, 31, 3) and every.bands.shape == (1, 31, 3, 3)
    assert torch.allclose(every.base[0, :30], 0.5 + SH_C0 * background.sh[:, 0])
    assert every.base[0, 30].tolist() == pytest.approx([0.8, 0.3, 0.3], abs=1e-6)
    assert (every.bands[0, 30] == 0).all()
    some = colors_of(scene, count=8, seed=1)
    assert some.base.shape == (1, 8, 3)
    assert torch.equal(some.base, colors_of(scene, count=8, seed=1).base)
    assert not torch.equal(some.base, colors_of(scene, count=8, seed=2).base)


def test_mapped_colours_are_those_of_mapped_gaussians():
    scene = scene_of(Gaussians(**{**vars(one_gaussian()), "sh": sh_of([[0.2, 0.4, 0.6]])}))
    mapped = colors_of(scene).mapped(MILD[None])
    sh = map_sh(scene.background.sh, MILD)
    assert torch.allclose(mapped.base[0], 0.5 + SH_C0 * sh[:, 0], atol=1e-6)
