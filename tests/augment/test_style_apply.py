"""From a style to a scene's maps, and these folded into SH and sky: definitions, algebra, bits."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch

from augment.effects.snow.effect import build_snow_layers
from augment.effects.style.color_maps import (
    MAX_SKY_LEVEL,
    NUM_CLASSES,
    StyleMaps,
    map_sh,
    sky_levels,
    style_actor,
    style_gaussians,
    style_scene,
    style_sky,
)
from augment.effects.style.content import content_pictures, content_statistics, gaussian_statistics
from augment.effects.style.images import image_statistics, read_style_image
from augment.effects.style.network import Gscm, save_network
from augment.effects.style.statistics import LAND, SKY, VEGETATION, WHOLE
from augment.effects.style.statistics import ROAD as ROADS
from augment.effects.style.style import scene_style_of, style_maps
from augment.errors import StyleError
from augment.memo import memo_of
from augment.render.composite import apply_color_map, composite_sky
from augment.render.cuda import runtime as gpu
from augment.render.rasterize import rasterize
from augment.render.sh import SH_C0, evaluate_sh
from augment.render.threads import limit_threads
from augment.scene.cameras import Frame
from augment.scene.scene import Actor, ColorSeries, Gaussians, PosedGaussians, Scene, Track
from augment.scene.semantics import SemanticClass
from augment.scene.sky import ConstantSky, CubemapSky, LatLongSky
from augment.view.plan import make_plan
from augment.view.render_view import render_buffers, render_view
from recipes.schema import Output, Recipe, Smog, Weather
from recipes.snow import Snow
from recipes.style import Style
from tests.augment.pretend_gpu import pretended_gpu
from tests.fitted_scenes import fitted_scene
from tests.scenes import camera_ahead, one_gaussian, random_gaussians, sh_of
from tests.snow_scenes import box_car, drive, sheet, side_wall, wall

IDENTITY_MAPS = StyleMaps(torch.eye(3, 4)[None], torch.eye(3, 4), torch.eye(3, 4))


def some_map(seed: int = 0, size: float = 0.2) -> torch.Tensor:
    return torch.eye(3, 4) + size * torch.randn(3, 4, generator=torch.Generator().manual_seed(seed))


def maps_of(splats: torch.Tensor) -> StyleMaps:
    return StyleMaps(splats, some_map(1), some_map(2))


def maps_by_class() -> StyleMaps:
    splats = torch.stack([some_map(seed) for seed in range(NUM_CLASSES)])
    splats[3] = torch.eye(3, 4)
    return maps_of(splats)


def with_classes(count: int, sh_degree: int, *, runs: bool = False):
    gaussians = random_gaussians(count, sh_degree=sh_degree)
    classes = torch.randint(0, NUM_CLASSES, (count,), generator=torch.Generator().manual_seed(5))
    classes = (classes.sort().values if runs else classes).short()
    return dataclasses.replace(gaussians, semantic=classes)


@pytest.mark.parametrize("sh_degree", [0, 1, 3])
@pytest.mark.parametrize("backend, count", [("cpu", 7), ("cpu", 4500), ("cuda", 7)])
def test_the_kernel_equals_the_definition(backend, sh_degree, count):
    """Sizes that no run, no register and no program divides; sums of three products round alike."""
    gaussians = with_classes(count, sh_degree)
    for maps in (maps_of(some_map()[None]), maps_by_class()):
        classes = None if len(maps.splats) == 1 else gaussians.semantic
        expected = map_sh(gaussians.sh, maps.splats, classes)
        got = style_gaussians(gaussians, maps, backend=backend).sh.cpu()
        torch.testing.assert_close(got, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("backend", ["cpu", "cuda"])
def test_identities_leave_every_bit(backend):
    gaussians = with_classes(100, 2)
    odd = torch.tensor([-0.0, float("nan"), float("inf"), 1e-42])
    gaussians.sh.view(-1)[: len(odd)] = odd
    bits = gaussians.sh.clone().view(torch.int32)
    every = maps_of(torch.eye(3, 4).repeat(NUM_CLASSES, 1, 1))
    for maps in (IDENTITY_MAPS, every):
        assert style_gaussians(gaussians, maps, backend=backend) is gaussians
        out = torch.zeros_like(gaussians.sh)
        out = out.to(gpu.gpu_device()) if backend == "cuda" else out
        assert style_gaussians(gaussians, maps, out=out, backend=backend).sh is out
        assert torch.equal(out.cpu().view(torch.int32), bits)
    slow = map_sh(gaussians.sh, torch.eye(3, 4)[None])
    assert torch.equal(slow.view(torch.int32), bits)


def test_on_the_gpu_sh_of_either_side_give_new_ones_there_or_change_in_place(monkeypatch):
    """And some maps of classes leave their splats' bits."""
    gaussians, maps = with_classes(80, 3), maps_by_class()
    bits = gaussians.sh.clone()
    expected = style_gaussians(gaussians, maps).sh
    with pretended_gpu(monkeypatch):
        styled = style_gaussians(gaussians, maps, backend="cuda")
        assert styled.sh.device == gpu.gpu_device() and styled.means is gaussians.means
        got = styled.sh.cpu()
        torch.testing.assert_close(got, expected, rtol=1e-6, atol=1e-6)
        assert torch.equal(gaussians.sh, bits)
        still = gaussians.semantic == 3
        assert still.any() and torch.equal(got[still], bits[still])
        there = dataclasses.replace(gaussians, sh=gpu.upload(gaussians.sh))
        assert torch.equal(style_gaussians(there, maps).sh.cpu(), got)
        in_place = style_gaussians(there, maps, out=there.sh).sh
        assert in_place is there.sh and torch.equal(in_place.cpu(), got)
        with pytest.raises(ValueError, match="out must lie on meta"):
            style_gaussians(gaussians, maps, out=torch.zeros_like(bits), backend="cuda")


@pytest.mark.parametrize("wrong", [-1, NUM_CLASSES])
def test_classes_without_a_map_are_refused(wrong):
    gaussians = with_classes(5, 0)
    gaussians.semantic[2] = wrong
    with pytest.raises(ValueError, match=rf"maps for classes 0 to {NUM_CLASSES - 1}.*{wrong}"):
        style_gaussians(gaussians, maps_by_class())
    style_gaussians(gaussians, maps_of(some_map()[None]))  # one map asks for no class


def test_a_styled_scene_shows_the_mapped_picture():
    """Where no clamp acts: pale colours and a gentle map."""
    gaussians = random_gaussians(200, sh_degree=1)
    gaussians.sh.mul_(0.3)
    color_map = some_map(size=0.05)
    camera, sky = camera_ahead(), ConstantSky(torch.tensor([0.4, 0.5, 0.6]))

    def picture(splats, behind):
        seen = rasterize([PosedGaussians(splats)], camera)
        return composite_sky(seen.rgb, seen.alpha, camera, behind)

    clean = picture(gaussians, sky)
    mapped_gaussians = style_gaussians(gaussians, maps_of(color_map[None]))
    styled = picture(mapped_gaussians, style_sky(sky, color_map))
    expected = apply_color_map(clean, color_map, backend="reference")
    torch.testing.assert_close(styled, expected, rtol=0, atol=2e-5)  # blends of 200 splats
    assert (styled - clean).abs().max() > 0.01


SKIES = (
    ConstantSky(torch.tensor([0.3, 0.5, 0.7])),
    LatLongSky(0.3 + 0.3 * torch.rand(5, 9, 3, generator=torch.Generator().manual_seed(0))),
    CubemapSky(0.3 + 0.3 * torch.rand(6, 4, 4, 3, generator=torch.Generator().manual_seed(0))),
)


class OwnSky:
    """None of the known ones."""

    def sample(self, directions):
        return (0.5 + 0.2 * torch.nn.functional.normalize(directions, dim=-1)).clamp(0, 1)


@pytest.mark.parametrize("sky", [*SKIES, OwnSky()], ids=lambda sky: type(sky).__name__)
def test_skies(sky):
    towards = torch.randn(200, 3, generator=torch.Generator().manual_seed(9))
    towards = torch.nn.functional.normalize(towards, dim=1)
    color_map = some_map(size=0.05)
    expected = sky.sample(towards) @ color_map[:, :3].T + color_map[:, 3]
    assert expected.min() > 0 and expected.max() < 1
    torch.testing.assert_close(
        style_sky(sky, color_map).sample(towards), expected, rtol=0, atol=1e-6
    )
    assert style_sky(sky, torch.eye(3, 4)) is sky
    extreme = style_sky(sky, 9 * some_map()).sample(towards)
    assert extreme.min() >= 0 and extreme.max() <= 1


@pytest.mark.parametrize("backend", ["reference", "cpu", "cuda"])
def test_without_directions_a_colour_below_0_is_mapped_as_the_black_that_it_shows(backend):
    dark = dataclasses.replace(random_gaussians(3, sh_degree=0), sh=torch.full((3, 1, 3), -9.0))
    lift = torch.cat([0.5 * torch.eye(3), torch.tensor([[0.2], [0.1], [0.3]])], 1)
    maps = StyleMaps(lift[None], lift, lift)
    colors = 0.5 + SH_C0 * style_gaussians(dark, maps, backend=backend).sh[:, 0].cpu()
    torch.testing.assert_close(colors, lift[:, 3].expand(3, 3), rtol=0, atol=1e-6)


def test_colours_that_change_over_time_are_mapped_at_all_times():
    gaussians = with_classes(50, 1)
    waves = ColorSeries(
        0.1 * torch.randn(50, 4, 3, generator=torch.Generator().manual_seed(3)),
        torch.tensor([0, 1_000]),
        torch.tensor([0.0, 1.0], dtype=torch.float64),
    )
    track = Track(torch.tensor([0]), torch.eye(4, dtype=torch.float64)[None])
    actor = Actor("a", "car", gaussians, track, (4.0, 2.0, 1.5), waves)
    for maps in (maps_of(some_map()[None]), maps_by_class()):
        styled = style_actor(actor, maps)
        for timestamp_ns in (0, 300, 1_000):
            expected = style_gaussians(actor.gaussians_at(timestamp_ns), maps).sh
            got = styled.gaussians_at(timestamp_ns).sh
            torch.testing.assert_close(got, expected, rtol=1e-5, atol=1e-5)


ROAD, BUILDING, CAR = (int(SemanticClass[name]) for name in ("ROAD", "BUILDING", "VEHICLE"))
STYLE = Style(preset="dusk")


def of_class(gaussians: Gaussians, value: int) -> Gaussians:
    classes = torch.full((len(gaussians),), value, dtype=torch.int16)
    return dataclasses.replace(gaussians, semantic=classes)


@pytest.fixture
def scene() -> Scene:
    """A road, a wall beside it, and a car."""
    ground = sheet((-2.0, 24.0), (-4.0, 4.0), semantic=ROAD)
    wall = of_class(side_wall(4.0, (2.0, 24.0), (0.0, 1.0)), BUILDING)
    car = box_car(start=(8.0, -2.0), moved_m=3.0, size=(3.0, 1.8, 1.0), semantic=CAR)
    return drive(ground, wall, actors=[car])


def gentle(seed: int) -> torch.Tensor:
    """A map that takes no colour of the scene out of [0, 1]."""
    rng = torch.Generator().manual_seed(seed)
    return 0.7 * torch.eye(3, 4) + 0.075 * torch.rand(3, 4, generator=rng)


def known_maps(scene: Scene, style: Style = STYLE, maps: StyleMaps | None = None) -> StyleMaps:
    """Maps that the scene takes for its style's from now on."""
    maps = maps or StyleMaps(gentle(1)[None], gentle(2), gentle(3))
    memo_of(scene).put(("style maps", style), maps, shared=True)
    return maps


def camera_of(scene: Scene):
    return scene.frames[0].cameras["ahead"]


def recipe_of(style: Style | None = STYLE, *, classes: bool = True, **weather) -> Recipe:
    output = Output(semantic=classes, instance=classes)
    return Recipe(style=style, weather=Weather(**weather), output=output)


def buffers_of(scene: Scene, recipe: Recipe, backend: str = "auto"):
    return render_buffers(scene, camera_of(scene), make_plan(recipe, scene), backend=backend)


def mapped(rgb: torch.Tensor, color_map: torch.Tensor) -> torch.Tensor:
    return rgb @ color_map[:, :3].T + color_map[:, 3]


def ran(scene: Scene, recipe: Recipe) -> dict[str, bool]:
    return {step.name: step.runs for step in make_plan(recipe, scene).steps}


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_splats_and_sky_are_mapped_each_by_its_own(scene, backend):
    maps = known_maps(scene)
    clean = buffers_of(scene, recipe_of(None), backend)
    styled = buffers_of(scene, recipe_of(), backend)
    alpha = clean.raster.alpha[..., None]
    splats, sky = clean.raster.rgb, scene.sky.rgb
    expected = splats @ maps.splats[0, :, :3].T + alpha * maps.splats[0, :, 3]
    expected = expected + (1 - alpha) * mapped(sky, maps.sky)
    torch.testing.assert_close(styled.rgb, expected, rtol=0, atol=2e-5)
    assert (styled.rgb - clean.rgb).abs().max() > 0.1


def test_every_class_takes_its_map(scene):
    splats = torch.eye(3, 4).repeat(NUM_CLASSES, 1, 1)
    splats[CAR] = gentle(5)
    known_maps(scene, maps=StyleMaps(splats, torch.eye(3, 4), gentle(3)))
    clean = render_view(scene, camera_of(scene), recipe_of(None))
    styled = render_view(scene, camera_of(scene), recipe_of())
    changed = (styled.rgb.astype(int) != clean.rgb).any(-1)
    sure = clean.semantic == CAR
    assert changed[sure].mean() > 0.95
    reach = cv2.dilate(sure.astype(np.uint8), np.ones((25, 25), np.uint8)) > 0
    assert not changed[~reach].any()


@pytest.mark.parametrize("weather", [{}, {"snow": Snow(depth_m=0.1, cell_m=0.1)}])
def test_no_strength_is_no_style_to_the_bit(scene, weather):
    none = Style(preset="dusk", strength=0)
    plan = make_plan(recipe_of(none, **weather), scene)
    assert plan.effect_plans["style"].data is None
    assert not any(runs for name, runs in ran(scene, recipe_of(none)).items() if "style" in name)
    recipes = [recipe_of(style, **weather) for style in (None, none)]
    clean, unstyled = (render_view(scene, camera_of(scene), recipe) for recipe in recipes)
    assert np.array_equal(clean.rgb, unstyled.rgb)


def test_a_picture_is_mapped_with_its_weather(scene):
    style = Style(preset="dusk", applied_to="picture")
    maps = known_maps(scene, style)
    weather = {"smog": Smog(visibility_m=50)}
    clean = buffers_of(scene, recipe_of(None, **weather))
    styled = buffers_of(scene, recipe_of(style, **weather))
    torch.testing.assert_close(styled.rgb, mapped(clean.rgb, maps.picture), rtol=0, atol=1e-5)
    steps = ran(scene, recipe_of(style))
    assert steps["style on the picture"] and not steps["style on the scene"]


def test_smog_keeps_its_colour(scene):
    known_maps(scene)
    dense = {"smog": Smog(extinction_per_m=50, color=(0.3, 0.5, 0.7))}
    view = render_view(scene, camera_of(scene), recipe_of(**dense))
    assert (np.abs(view.rgb.astype(int) - np.array([77, 128, 179])) <= 1).all()


def test_snow_keeps_its_colour_and_takes_the_styles_light(scene):
    maps = known_maps(scene)
    recipe = recipe_of(snow=Snow(depth_m=0.1, cell_m=0.1, tracks="never"))
    plan = make_plan(recipe, scene)
    look = scene_style_of(scene, STYLE)
    snow = plan.effect_plans["snow"].data
    styled, plain = (build_snow_layers(scene, snow, light) for light in (look.lighting_scene, None))
    parts = look.map_parts(styled.parts_for(scene, camera_of(scene)))
    assert any(part.is_overlay for part in parts)
    assert all((part.color_maps is None) == part.is_overlay for part in parts)
    # Its light is read from the mapped ground and sky, and differs from the bare scene's.
    means = [cover.ground.gaussians.sh.mean((0, 1)) for cover in (styled, plain)]
    assert (means[0] - means[1]).abs().max() > 0.02
    ground = scene.background.sh[0, 0] * SH_C0 + 0.5
    seen = look.lighting_scene.background.sh[0, 0] * SH_C0 + 0.5
    torch.testing.assert_close(seen, mapped(ground, maps.splats[0]), rtol=0, atol=1e-5)
    assert torch.equal(styled.ground.gaussians.means, plain.ground.gaussians.means)
    drawn = rasterize([p for p in parts if p.is_overlay], camera_of(scene))
    view = render_buffers(scene, camera_of(scene), plan)
    covered = view.raster.overlay > 0.995
    assert covered.sum() > 500
    torch.testing.assert_close(view.rgb[covered], drawn.rgb[covered], rtol=0, atol=0.02)


def with_sh(scene: Scene, sh: torch.Tensor) -> Scene:
    return dataclasses.replace(scene, background=dataclasses.replace(scene.background, sh=sh))


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("weather", [{}, {"snow": Snow(depth_m=0.1, cell_m=0.1, coverage=0.3)}])
def test_folded_maps_draw_the_same_where_no_colour_is_clamped(scene, weather, backend):
    sh = scene.background.sh
    bands = 0.1 * (torch.rand(len(sh), 3, 3, generator=torch.Generator().manual_seed(7)) - 0.5)
    scene = with_sh(scene, torch.cat([sh, bands], 1))  # colours change with the direction
    folding = Style(preset="dusk", evaluated="sh")
    for style in (STYLE, folding):
        known_maps(scene, style)
    by_color, by_sh = (
        buffers_of(scene, recipe_of(style, **weather), backend) for style in (STYLE, folding)
    )
    # 1e-5: sums of 4 terms in float32, folded or not, blended.
    torch.testing.assert_close(by_sh.rgb, by_color.rgb, rtol=0, atol=1e-5)
    ground = by_sh.parts[0]
    assert ground.color_maps is None and by_color.parts[0].color_maps is not None
    again = buffers_of(scene, recipe_of(folding, **weather), backend)
    assert again.parts[0].gaussians.sh is ground.gaussians.sh  # once for all frames
    assert torch.equal(ground.gaussians.means, scene.background.means)
    assert not torch.equal(ground.gaussians.sh, scene.background.sh)
    assert by_sh.parts[1].color_maps is not None  # of an actor


# ---- where maps in SH are exact ------------------------------------------------------------------


def folding_error(scene, camera):
    """Largest channel difference [H, W] of colours mapped in SH and of mapped colours."""
    recipes = (recipe_of(Style(preset="overcast", evaluated=to)) for to in ("sh", "color"))
    folded, mapped = (render_buffers(scene, camera, make_plan(r, scene)).rgb for r in recipes)
    return (folded - mapped).abs().amax(2).numpy()


def touched_pixels(scene, camera):
    """bool [H, W]; such splats are drawn white, all others far below black."""
    own = scene.background
    away = torch.nn.functional.normalize(own.means - camera.centre.float(), dim=1)
    below = (evaluate_sh(own.sh, away) + 0.5 < 0).any(1)
    sh = torch.where(below, 0.5 / SH_C0, -1 / SH_C0)[:, None, None].expand(-1, 1, 3).contiguous()
    return rasterize([PosedGaussians(dataclasses.replace(own, sh=sh))], camera).rgb[..., 0] > 0


def test_maps_in_sh_are_exact_but_where_a_colour_is_below_zero():
    road = sheet((2, 9), (-2, 2), rgb=(0.3, 0.35, 0.3), semantic=int(SemanticClass.ROAD))
    scene = drive(road, wall(9.0, (-3, 3), (0, 2.5)), places=[(0.0, 0.0, 1.5)])
    camera = camera_of(scene)
    assert not touched_pixels(scene, camera).any()
    sh = scene.background.sh.clone()
    sh[: len(road)] = sh_of(np.full((len(road), 3), -0.1))
    dark = with_sh(scene, sh)
    touched = touched_pixels(dark, camera).numpy()
    assert touched[-5:, 60:100].all() and not touched[:20].any()
    assert folding_error(dark, camera).max() < 1e-5  # no directions: known exactly
    error = folding_error(with_sh(dark, torch.cat([sh, torch.zeros(len(sh), 3, 3)], 1)), camera)
    assert error[touched].max() > 1 / 255 > 1e-5 > error[~touched].max()


# ---- from a style to maps ------------------------------------------------------------------------


def colourful() -> Scene:
    """A scene whose colours vary in all three channels, under a sky."""
    rng = np.random.default_rng(3)
    scene = drive(sheet((0.5, 8), (-4, 4)), wall(8.0, (-4, 4), (0, 2)))
    colors = torch.from_numpy(rng.uniform(0.3, 0.6, (len(scene.background), 1, 3))).float()
    return with_sh(scene, (colors - 0.5) / SH_C0)


@pytest.fixture
def photo(tmp_path):
    """Speckled ground under a bright, blue, graded sky."""
    rng = np.random.default_rng(0)
    rgb = rng.uniform((90, 70, 40), (170, 130, 90), (96, 128, 3))
    rgb[:40] = np.linspace((110, 160, 235), (150, 190, 245), 40)[:, None]
    path = tmp_path / "photo.png"
    assert cv2.imwrite(str(path), rgb[..., ::-1].astype(np.uint8))
    mask = np.zeros((96, 128), np.uint8)
    mask[:40] = 255
    assert cv2.imwrite(str(tmp_path / "mask.png"), mask)
    return path


def equal(a: StyleMaps, b: StyleMaps) -> bool:
    return all(torch.equal(getattr(a, n), getattr(b, n)) for n in ("splats", "sky", "picture"))


def test_the_scene_takes_on_the_colours(photo):
    scene = colourful()
    style = Style(image=str(photo), mask=str(photo.with_name("mask.png")))
    target = image_statistics(read_style_image(photo, photo.with_name("mask.png")))
    styled = style_scene(scene, style_maps(scene, style))
    before, found = (content_statistics(s, per_region=False) for s in (scene, styled))
    for region in (LAND, SKY):
        error = np.abs(found[region].mean - target[region].mean).max()
        assert error < 0.02, region  # pixels mix splats and clamp some of them
        assert np.abs(before[region].mean - target[region].mean).max() > 5 * error


def test_an_image_is_read_if_it_has_an_effect(photo):
    no_image = Style(image="/no/such/file.png", strength=0)
    assert equal(style_maps(fitted_scene(), no_image), IDENTITY_MAPS)
    with pytest.raises(StyleError, match=r"file\.png"):
        style_maps(fitted_scene(), no_image.model_copy(update={"strength": 1}))
    maps = style_maps(fitted_scene(), Style(image=str(photo), per_region=True))
    assert len(maps.splats) == NUM_CLASSES


def test_the_network_gives_one_map_for_all(photo, tmp_path):
    torch.manual_seed(0)
    network = tmp_path / "net.safetensors"
    save_network(network, Gscm("small"), {})
    scene = colourful()
    style = Style(image=str(photo), method="gscm", checkpoint=str(network))
    maps = style_maps(scene, style)
    assert maps.splats.shape == (1, 3, 4)
    assert torch.equal(maps.splats[0], maps.sky) and torch.equal(maps.sky, maps.picture)
    assert equal(maps, style_maps(colourful(), style))
    half = style_maps(scene, style.model_copy(update={"strength": 0.5}))
    torch.testing.assert_close(
        half.sky, torch.lerp(torch.eye(3, 4), maps.sky, 0.5), rtol=0, atol=1e-5
    )


BLUE = (0.6, 0.7, 0.9)  # of a drive
RED = torch.tensor([[0, 0, 0, 0.9], [0, 0, 0, 0.1], [0, 0, 0, 0.1]])
GREEN = torch.tensor([[0, 0, 0, 0.1], [0, 0, 0, 0.9], [0, 0, 0, 0.1]])
SEEN = torch.cat([0.03**2 * torch.eye(3), torch.tensor(BLUE)[:, None]], 1)


def maps(splats: torch.Tensor = GREEN[None], seen: torch.Tensor | None = SEEN) -> StyleMaps:
    return StyleMaps(splats, RED, torch.eye(3, 4), seen)


def ball(mean, rgb=BLUE) -> Gaussians:
    return one_gaussian(mean, 1.0, 0.9, rgb)


def scene_of(*balls: Gaussians, sky=BLUE) -> Scene:
    """A road of which nothing is sky, and balls ahead of a camera 1.5 m above it."""
    made = drive(sheet((0.0, 4.0), (-2.0, 2.0)), *balls)
    return dataclasses.replace(made, sky=ConstantSky(torch.tensor(sky)))


HIGH = (30.0, 0.0, 12.0)


def test_what_has_the_skys_colour_above_the_horizon_is_sky():
    pale, brick, low = (0.62, 0.69, 0.88), (0.6, 0.3, 0.2), (30.0, 0.0, 0.5)
    scene = scene_of(ball(HIGH), ball(HIGH, pale), ball(HIGH, brick), ball(low))
    levels = sky_levels(scene, maps())
    assert levels is not None
    assert levels[-4:].tolist() == [MAX_SKY_LEVEL, MAX_SKY_LEVEL, 0, 0]


def test_without_a_map_of_its_own_no_sky_is_looked_for():
    scene = scene_of(ball(HIGH))
    light_grey = (0.8, 0.8, 0.8)
    wall_rgb = (0.5, 0.4, 0.3)
    grey_map = torch.cat([torch.eye(3) / 100, torch.full((3, 1), 0.8)], 1)
    for other, seen in (
        (scene, None),
        (dataclasses.replace(scene, frames=()), SEEN),
        (dataclasses.replace(scene, has_known_gravity=False), SEEN),
        (scene_of(ball(HIGH, (0.1, 0.1, 0.1))), SEEN),
        # Nobody saw that sky, so no splat paints it.
        (scene_of(ball(HIGH, light_grey), sky=light_grey), grey_map),
        # Where nothing is seen of a cube map, a fit leaves the wall's own colour in it.
        (scene_of(ball(HIGH, wall_rgb), sky=wall_rgb), SEEN),
    ):
        assert sky_levels(other, maps(seen=seen)) is None


def test_the_halo_changes_with_the_sky_in_pictures_and_in_styled_scenes():
    scene = scene_of(ball(HIGH), ball((30.0, 4.0, 12.0), (0.5, 0.3, 0.2)))
    known_maps(scene, maps=maps())
    camera = camera_of(scene)
    look = scene_style_of(scene, STYLE)
    rows = look.map_parts(scene.parts_for(camera))[0].color_rows
    assert rows is not None and rows[-2:].tolist() == [MAX_SKY_LEVEL, 0] and not rows[:-2].any()
    styled = style_scene(scene, maps())
    fused = render_view(scene, camera, Recipe(style=STYLE))
    folded = render_view(styled, camera, Recipe())
    assert np.abs(fused.rgb.astype(int) - folded.rgb).max() <= 1
    colors = (styled.background.sh[-2:, 0] * SH_C0 + 0.5).tolist()
    np.testing.assert_allclose(colors, [[0.9, 0.1, 0.1], [0.1, 0.9, 0.1]], atol=1e-5)
    assert torch.equal(look.lighting_scene.background.sh[-1], look.lighting_scene.background.sh[0])


ROAD_RGB, HEDGE_RGB, SKY_RGB = (0.3, 0.32, 0.35), (0.1, 0.4, 0.05), (0.5, 0.7, 0.9)


def street() -> Scene:
    """A road before a hedge, under a sky of one colour."""
    road = sheet((0.5, 8), (-4, 4), rgb=ROAD_RGB, semantic=ROAD)
    hedge = of_class(wall(8.0, (-4, 4), (0, 2), rgb=HEDGE_RGB), SemanticClass.VEGETATION)
    return dataclasses.replace(drive(road, hedge), sky=ConstantSky(torch.tensor(SKY_RGB)))


def numbers(statistics) -> dict:
    """Regions in order, with all their numbers."""
    return {
        region: (found.mean.tolist(), found.covariance.tolist(), found.share)
        for region, found in statistics.items()
    }


def test_every_region_has_its_colour():
    found = content_statistics(street(), per_region=True)
    assert list(found) == [WHOLE, LAND, SKY, ROADS, VEGETATION]
    # Edges mix the colours of what is on both sides of them.
    for region, rgb in ((SKY, SKY_RGB), (ROADS, ROAD_RGB), (VEGETATION, HEDGE_RGB)):
        assert np.abs(found[region].mean - rgb).max() < 0.02, region
        assert np.sqrt(np.diag(found[region].covariance)).max() < 0.06, region
    assert found[WHOLE].share == 1
    assert found[LAND].share + found[SKY].share == pytest.approx(1, abs=1e-5)
    assert found[ROADS].share + found[VEGETATION].share == pytest.approx(
        found[LAND].share, abs=1e-4
    )
    mixed = sum(found[r].share * found[r].mean for r in (SKY, LAND))
    assert np.abs(found[WHOLE].mean - mixed).max() < 1e-5
    assert min(found[r].share for r in (SKY, ROADS, VEGETATION)) > 0.05


def test_the_sky_has_to_be_seen():
    """Splats always let a little through, and the light of two walls' gaps is no sky."""
    walls = [wall(x, (-9, 9), (-6, 9)) for x in (4.0, 4.1)]
    assert SKY in content_statistics(drive(walls[0]), per_region=True)
    assert list(content_statistics(drive(*walls), per_region=True)) == [WHOLE, LAND]


@pytest.mark.parametrize("why", ["no frames", "no cameras", "nothing seen", "orthographic"])
def test_what_no_camera_sees_speaks_for_itself(why):
    scene = street()
    behind = camera_ahead(position=(-50.0, 0, 1.5), yaw=np.pi)
    cameras = {
        "no cameras": {},
        "nothing seen": {"behind": behind},
        "orthographic": {"above": dataclasses.replace(behind, is_orthographic=True)},
    }.get(why)
    frames = () if cameras is None else (Frame(0, 0, torch.eye(4).double(), cameras),)
    blind = dataclasses.replace(scene, frames=frames)
    found = content_statistics(blind, per_region=True)
    assert numbers(found) == numbers(gaussian_statistics(scene, per_region=True))
    assert SKY not in found and found[ROADS].share + found[VEGETATION].share == pytest.approx(1)
    assert found[ROADS].mean == pytest.approx(ROAD_RGB, abs=1e-6)
    assert found[VEGETATION].mean == pytest.approx(HEDGE_RGB, abs=1e-6)
    picture = content_pictures(blind)
    assert picture.shape == (1, 3, 256, 256)
    assert picture[0].mean((1, 2)).numpy() == pytest.approx(found[WHOLE].mean, abs=1e-3)


def test_bits_do_not_depend_on_threads():
    scene = dataclasses.replace(fitted_scene(), actors=())
    found = content_statistics(scene, per_region=True)
    pictures = content_pictures(scene)
    scene = dataclasses.replace(scene)  # another object: nothing is remembered
    limit_threads(2)
    assert numbers(content_statistics(scene, per_region=True)) == numbers(found)
    assert torch.equal(content_pictures(scene), pictures)
