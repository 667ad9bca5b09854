"""The colour of fog: one for all cameras whatever their exposures; its change with elevation."""

import dataclasses

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from augment.effects.smog import fog_before_color_map
from augment.render.buffers import RenderOutput
from augment.render.composite import add_airlight_elevation, composite_sky, simplify_sky
from augment.render.fog import Fog, airlight_gain
from augment.scene.cameras import Camera
from augment.scene.scene import Ground, Scene
from augment.scene.sky import CubemapSky
from augment.view.plan import make_plan
from augment.view.render_view import render_buffers, render_view
from recipes.flood import Flood
from recipes.schema import Recipe, Render, Smog, Weather
from tests.scenes import camera_ahead
from tests.snow_scenes import drive, sheet, side_wall

AIR = (0.7, 0.72, 0.75)
# Of a camera that exposes less, one that exposes more and has another white balance, and of single
# images; the last camera has none.
MAPS = {
    "left": torch.tensor([[0.8, 0.02, 0, -0.03], [0, 0.78, 0, 0.01], [0.03, 0, 0.75, 0.0]]),
    "right": torch.tensor([[1.1, 0, 0, 0.0], [0, 1.05, 0.05, 0.02], [0, 0, 1.2, 0.01]]),
}
CAMERAS = ("left", "right", "rear")


@pytest.fixture(scope="module")
def road() -> Scene:
    """A road of 200 m with a wall on its left, in every camera's sight."""
    parts = sheet((1.0, 200.0), (-4.0, 4.0)), side_wall(4.0, (2.0, 200.0), (0.0, 2.0))
    known = Ground(0.0, 0.0, "stated", None, 0, None)
    plain = drive(*parts, places=((0.0, 0.0, 1.5),), ground=known, ground_z_m=0.0)
    names = {name: dataclasses.replace(camera(), name=name) for name in CAMERAS}
    frame = dataclasses.replace(plain.frames[0], cameras=names)
    blue = CubemapSky(torch.tensor([0.2, 0.4, 0.9]).expand(6, 4, 4, 3).contiguous())
    return dataclasses.replace(plain, frames=(frame,), sky=blue)


def camera(name: str = "left") -> Camera:
    return dataclasses.replace(camera_ahead(80, 46, 40.0, position=(0.0, 0.0, 1.5)), name=name)


def picture(scene: Scene, name: str, smog: Smog | None, **options):
    flood = options.pop("flood", None)
    recipe = Recipe(weather=Weather(smog=smog, flood=flood), render=Render(**options))
    plan = make_plan(recipe, scene)
    return render_buffers(scene, camera(name), plan, backend="cpu").rgb


# ---- One fog for all cameras ---------------------------------------------------------------------


@pytest.mark.parametrize("smog", [{}, {"model": "deferred"}, {"scale_height_m": 30.0}])
def test_surfaces_keep_their_exposure_and_fog_has_the_common_one(road, smog):
    """M(t C + (1 - t) a) = t M(C) + (1 - t) common(A) in every pixel, the sky's among them."""
    mapped = dataclasses.replace(road, color_maps=MAPS)
    common = torch.stack(list(MAPS.values())).mean(0)
    goal = common[:, :3] @ torch.tensor(AIR) + common[:, 3]

    def of(color):
        return Smog(extinction_per_m=0.03, color=color, **smog)

    faded = picture(road, "left", of((0.0, 0.0, 0.0)))
    share = picture(road, "left", of((1.0, 1.0, 1.0))) - faded  # of the fog in a pixel
    assert float(share.min()) < 0.2 and float(share.max()) > 0.99
    for name in CAMERAS:
        own = MAPS.get(name, torch.eye(3, 4))
        seen = faded @ own[:, :3].T + (1 - share) * own[:, 3]
        expected = seen + share * goal
        got = picture(mapped, name, of(AIR))
        # Damping moves the airlight by 1e-4 / 0.75^2 of the way between exposures (0.2).
        assert float((got - expected).abs().max()) < 2e-4
        recorded = picture(mapped, name, of(AIR), exposure="recorded")
        thick = share.amin(-1) > 0.99
        assert float((recorded - goal)[thick].abs().mean()) > 0.02  # 5 grey levels


def test_dense_fog_has_one_colour_also_over_water(road):
    """Within a grey level across cameras, where the exposures put 50 between them."""
    mapped = dataclasses.replace(road, color_maps=MAPS)
    smog = Smog(visibility_m=15, color=AIR)
    for flood in (None, Flood(level_m=0.3)):
        rows = slice(10, 24)  # from well above to just above the horizon
        means = {
            exposure: np.stack([
                picture(mapped, name, smog, flood=flood, exposure=exposure)[rows].mean((0, 1))
                for name in CAMERAS
            ])
            for exposure in ("common", "recorded", "neutral")
        }  # fmt: skip
        spread = {name: 255 * np.ptp(mean, 0).max() for name, mean in means.items()}
        assert spread["common"] < 1 and spread["recorded"] > 50 and spread["neutral"] < 1e-3


def test_without_maps_every_exposure_has_the_same_bits(road):
    smog = Smog(visibility_m=50, color=AIR)
    same = [picture(road, "left", smog, exposure=e) for e in ("common", "recorded", "neutral")]
    assert torch.equal(same[0], same[1]) and torch.equal(same[0], same[2])
    alone = dataclasses.replace(road, color_maps={"left": MAPS["left"]})
    pair = [picture(alone, "left", smog, exposure=e) for e in ("common", "recorded")]
    assert torch.equal(*pair)  # the mean of one map is that map
    assert torch.equal(*(picture(alone, "left", None, exposure=e) for e in ("common", "recorded")))


def test_single_images_have_maps_of_their_own_in_the_mean(road):
    by_image = dataclasses.replace(
        road, color_maps=MAPS, image_color_maps={("rear", 5): 2 * MAPS["left"]}
    )
    expected = torch.stack([MAPS["left"], MAPS["right"], 2 * MAPS["left"]]).double().mean(0)
    assert torch.allclose(by_image.common_color_map, expected)
    assert dataclasses.replace(road, color_maps={"left": torch.eye(3, 4)}).common_color_map is None


def test_a_camera_that_is_blind_to_a_channel_does_not_blow_up():
    fog, common = Fog(0.1, AIR), MAPS["right"].double()
    blind = torch.eye(3, 4)
    blind[0, 0] = 0.0  # records no red
    nothing, faint = torch.zeros(3, 4), 1e-20 * torch.eye(3, 4)
    mixed = torch.tensor([[1.0, 1, 1, 0], [1, 1, 1, 0], [1, 1, 1.001, 0]])  # all but singular
    for color_map in (blind, nothing, faint, mixed, 0.01 * mixed, 1e6 * mixed):
        found = np.array(fog_before_color_map(fog, color_map, common).airlight_rgb)
        # No residual counts for more than 1 / (2 sqrt(1e-4)) = 50 times itself.
        residual = (common - color_map)[:, :3] @ torch.tensor(AIR).double() + common[:, 3]
        assert np.linalg.norm(found - AIR) <= 50.01 * float(residual.norm())
    assert fog_before_color_map(fog, nothing, common).airlight_rgb == pytest.approx(AIR)
    red, green, _ = fog_before_color_map(fog, blind, common).airlight_rgb
    assert red == pytest.approx(AIR[0]) and green == pytest.approx(1.05 * AIR[1] + 0.0575, abs=1e-3)


# ---- Airlight by elevation -----------------------------------------------------------------------


def test_an_overcast_zenith_has_three_times_the_horizons_luminance():
    """Moon and Spencer 1942; below, its reciprocal. In luminance: display values to the 2.2."""
    fog = Fog(0.1, AIR, elevation_gain=1.0)
    slopes = torch.tensor([-1.0, -0.5, 0.0, 0.5, 1.0])
    airlight = torch.tensor(AIR) + airlight_gain(fog, slopes)
    luminance = (airlight / torch.tensor(AIR)) ** 2.2
    for channel in range(3):
        assert luminance[:, channel].tolist() == pytest.approx([1 / 3, 1 / 2, 1, 2, 3], rel=1e-5)
    none = airlight_gain(dataclasses.replace(fog, elevation_gain=0.0), slopes)
    assert torch.equal(none, torch.zeros(5, 3))


@pytest.mark.parametrize("smog", [{}, {"model": "deferred"}, {"scale_height_m": 30.0}])
def test_pixels_show_the_airlight_of_their_rays(road, smog):
    """In every pixel the fog's share times what elevation adds; the share as of plain fog."""

    def of(color, overcast=0.0):
        return Smog(extinction_per_m=0.03, color=color, overcast=overcast, **smog)

    plain, bent = picture(road, "left", of(AIR)), picture(road, "left", of(AIR, 0.5))
    share = picture(road, "left", of((1.0, 1.0, 1.0))) - picture(road, "left", of((0.0, 0.0, 0.0)))
    rays = camera().ray_directions()
    slope = rays[..., 2] / rays.norm(dim=-1)
    expected = plain + share * airlight_gain(Fog(0.03, AIR, elevation_gain=0.5), slope)
    # The fog's share of a pixel of many splats is judged by their mean depth: half a grey level,
    # but two along silhouettes.
    error = (bent - expected).abs()
    assert float(error.quantile(0.95)) < 0.002 and float(error.max()) < 0.01
    column = bent[:, 8].mean(-1) if not smog.get("scale_height_m") else bent[24:, 8].mean(-1)
    assert float(column[-1]) < float(column[0])
    mapped = dataclasses.replace(road, color_maps=MAPS)
    common = torch.stack(list(MAPS.values())).mean(0)
    own = {name: picture(mapped, name, of(AIR, 0.5)) for name in CAMERAS}
    flat = {name: picture(mapped, name, of(AIR)) for name in CAMERAS}
    added = share * (airlight_gain(Fog(0.03, AIR, elevation_gain=0.5), slope) @ common[:, :3].T)
    for name in CAMERAS:  # the same to all cameras
        assert float((own[name] - flat[name] - added).abs().max()) < 0.01


def test_without_overcast_no_bit_changes_and_no_depth_is_drawn(road):
    plan = make_plan(Recipe(weather=Weather(smog=Smog(visibility_m=50))), road)
    assert "expected_depth" not in plan.buffers
    steps = {step.name: step for step in plan.steps}
    assert not steps["airlight by elevation"].runs
    bent = Recipe(weather=Weather(smog=Smog(visibility_m=50, overcast=0.5)))
    assert {s.name: s.runs for s in make_plan(bent, road).steps}["airlight by elevation"]
    # Hashes of recipes from before the field are those of recipes without it.
    assert Recipe(weather=Weather(smog=Smog(visibility_m=50, overcast=0.0))).hash == Recipe(
        weather=Weather(smog=Smog(visibility_m=50))
    ).hash != bent.hash  # fmt: skip
    with pytest.raises(ValidationError):
        Smog(visibility_m=50, overcast=1.5)


@pytest.mark.parametrize("height", [None, 12.0])
@pytest.mark.parametrize("eye_z", [1.5, -40.0])  # the latter far below the fog's base
def test_the_kernels_are_the_definition(height, eye_z):
    fog = Fog(0.04, AIR, height, 0.0, elevation_gain=0.7, varying_airlight_rgb=(0.6, 0.7, 0.9))
    view = camera_ahead(53, 37, 20.0, position=(0.0, 0.0, eye_z), yaw=0.4)
    generator = torch.Generator().manual_seed(1)
    rgb, alpha = torch.rand(37, 53, 3, generator=generator), torch.rand(37, 53, generator=generator)
    alpha[:5], alpha[5:9] = 0.0, 1.0
    depth = torch.rand(37, 53, generator=generator) ** 4 * 1e4
    depth[10:12] = 0.0

    def both(run):
        return run("cpu"), run("reference")

    def bent(backend, **options):
        raster = RenderOutput(rgb=rgb.clone(), alpha=alpha, expected_depth=depth)
        return add_airlight_elevation(raster, view, fog, backend=backend, **options)

    fast, slow = both(lambda on: bent(on, has_fog_behind=True))
    assert torch.allclose(fast, slow, atol=2e-5)
    fast, slow = both(bent)
    assert torch.allclose(fast, slow, atol=2e-5)
    assert torch.equal(fast[:5], rgb[:5]) and torch.equal(fast[10:12], rgb[10:12])
    sky = CubemapSky(torch.full((6, 4, 4, 3), 0.4))
    fast, slow = both(lambda on: composite_sky(rgb, alpha, view, sky, fog=fog, backend=on))
    assert torch.allclose(fast, slow, atol=2e-5)


def test_endless_fog_is_a_sky_of_its_airlight(road):
    """Which water mirrors, too."""
    fog = Fog(0.05, AIR, elevation_gain=1.0)
    sky, before = simplify_sky(road.sky, fog)
    assert before is None
    rays = torch.randn(500, 3, generator=torch.Generator().manual_seed(2))
    expected = torch.tensor(AIR) + airlight_gain(fog, rays[:, 2] / rays.norm(dim=-1))
    assert torch.allclose(sky.sample(rays), expected, atol=1e-3)
    smog, flood = Smog(extinction_per_m=0.05, color=AIR, overcast=1.0), Flood(level_m=0.3)
    flooded, dry = (picture(road, "left", smog, flood=water) for water in (flood, None))
    assert bool(torch.isfinite(flooded).all())
    # The sky beside the wall: of a cube map, which errs along its edges, and by the rays.
    assert torch.allclose(flooded[:20, 40:], dry[:20, 40:], atol=2e-3)


def test_views_in_bytes_are_the_same_twice(road):
    recipe = Recipe(weather=Weather(smog=Smog(visibility_m=60, overcast=0.5)))
    mapped = dataclasses.replace(road, color_maps=MAPS)
    first, second = (render_view(mapped, camera("rear"), recipe).rgb for _ in range(2))
    assert np.array_equal(first, second)
