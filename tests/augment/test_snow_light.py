"""Where the sun stands over a scene, and how bright and what colour its snow would be."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch

from augment.cameras import Camera, Frame
from augment.effects.snow.light import (
    Illumination,
    display_from_linear,
    illumination_of,
    light_of,
    linear_from_display,
)
from augment.scene import Gaussians, Scene
from augment.semantics import SemanticClass
from augment.sky import ConstantSky, LatLongSky, Sky
from recipes.snow import Snow, SnowLight

SH_C0 = 0.28209479177387814
HEIGHT = 180  # a row a degree
GREY = (0.35, 0.35, 0.35)
BLUE_SKY = (0.30, 0.45, 0.75)


def sky_with_sun(
    azimuth_deg: float, elevation_deg: float, *, radius_deg: float = 1.5, rgb: object = BLUE_SKY
) -> LatLongSky:
    """An even sky, a dark land, and a disc of sun."""
    elevations = np.radians(90 - (np.arange(HEIGHT) + 0.5))
    azimuths = np.radians((np.arange(2 * HEIGHT) + 0.5) - 180)
    e, a = np.meshgrid(elevations, azimuths, indexing="ij")
    directions = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1)
    image = np.where(e[..., None] > 0, np.asarray(rgb), 0.2)
    image[directions @ unit(azimuth_deg, elevation_deg) > np.cos(np.radians(radius_deg))] = 1.0
    return LatLongSky(torch.from_numpy(image.astype(np.float32)))


def unit(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    a, e = math.radians(azimuth_deg), math.radians(elevation_deg)
    return np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])


def discs(rgb: object, semantic: SemanticClass | None, *, count: int = 30, z: float = 0.0):
    """Level discs of one colour."""
    sh = torch.as_tensor(np.asarray(rgb, np.float32) - 0.5).expand(count, 1, 3) / SH_C0
    return Gaussians(
        means=torch.tensor([0.0, 0.0, z])
        + torch.arange(count)[:, None] * torch.tensor([1.0, 0, 0]),
        quats=torch.tensor([1.0, 0, 0, 0]).expand(count, 4).contiguous(),
        scales=torch.tensor([0.3, 0.3, 0.01]).expand(count, 3).contiguous(),
        opacities=torch.full((count,), 0.9),
        sh=sh.contiguous(),
        semantic=None if semantic is None else torch.full((count,), int(semantic)).short(),
    )


def joined(*parts: Gaussians) -> Gaussians:
    names = ("means", "quats", "scales", "opacities", "sh", "semantic")
    return Gaussians(*(torch.cat([getattr(part, name) for part in parts]) for name in names))


def scene(sky: Sky, ground: Gaussians, frames: tuple[Frame, ...] = ()) -> Scene:
    return Scene("s", "test:s", ground, (), sky, frames)


def street(sky: Sky, rgb: object = GREY) -> Scene:
    return scene(sky, discs(rgb, SemanticClass.ROAD))


def snow(*, albedo: float = 0.85, **light: float) -> Snow:
    return Snow(depth_m=0.1, albedo=albedo, light=SnowLight(**light))


def level(light: Illumination) -> np.ndarray:
    """Linear colour of level snow that sees the sun."""
    lit, shadow = (linear_from_display(np.array(c)) for c in (light.lit_rgb, light.shadow_rgb))
    return shadow + (lit - shadow) * (light.sun[2] + light.wrap) / (1 + light.wrap)


def luminance(rgb: object) -> float:
    return float(linear_from_display(np.asarray(rgb)) @ [0.2126, 0.7152, 0.0722])


def degrees_between(a: object, b: object) -> float:
    return math.degrees(math.acos(min(1.0, float(np.dot(np.asarray(a), np.asarray(b))))))


def check(light: Illumination) -> None:
    values = (*light.sun, *light.lit_rgb, *light.shadow_rgb, light.wrap)
    assert all(type(value) is float and math.isfinite(value) for value in values)
    assert math.hypot(*light.sun) == pytest.approx(1, abs=1e-12)
    pairs = zip(light.shadow_rgb, light.lit_rgb, strict=True)
    assert all(0 <= shadow <= lit <= 1 for shadow, lit in pairs)
    assert 0 <= light.wrap <= 1


def test_encoding_is_srgb_and_inverts() -> None:
    values = np.linspace(0, 1, 1001)
    # both halves of the standard are given to four digits
    assert display_from_linear(linear_from_display(values)) == pytest.approx(values, abs=1e-6)
    assert float(linear_from_display(np.array(0.5))) == pytest.approx(0.214041, abs=1e-6)


@pytest.mark.parametrize(("azimuth_deg", "elevation_deg"), [(-170, 12), (64, 45), (179, 85)])
def test_the_sun_is_found(azimuth_deg: float, elevation_deg: float) -> None:
    light = illumination_of(street(sky_with_sun(azimuth_deg, elevation_deg)), snow())
    # samples are 1.1 degrees apart and are averaged over 8
    assert degrees_between(light.sun, unit(azimuth_deg, elevation_deg)) < 1.5
    check(light)


def test_an_even_sky_is_overcast() -> None:
    for rgb in ((0.5, 0.5, 0.5), (1.0, 1.0, 1.0), (0.2, 0.3, 0.6)):
        light = illumination_of(street(ConstantSky(torch.tensor(rgb))), snow())
        assert light.sun == pytest.approx(unit(135, 45), abs=1e-9)
        # soft shadows: 8 to 10 % darker than what faces the light
        assert 0.90 < luminance(light.shadow_rgb) / luminance(light.lit_rgb) < 0.92
        assert light.wrap > 0.8
        check(light)


def test_a_clear_sky_makes_blue_shadows_half_as_bright_and_warm_light() -> None:
    found = light_of(street(sky_with_sun(0, 45, radius_deg=4)))
    assert found.sun_share == pytest.approx(0.9)
    light = illumination_of(street(sky_with_sun(0, 45, radius_deg=4)), snow())
    assert 0.45 < luminance(light.shadow_rgb) / luminance(light.lit_rgb) < 0.6
    red, green, blue = light.shadow_rgb
    assert red < green < blue and blue - red < 0.2
    assert light.lit_rgb[0] > light.lit_rgb[2] and light.lit_rgb[0] - light.lit_rgb[2] < 0.05
    assert light.wrap == pytest.approx(0.54)


def test_level_snow_gets_the_light_of_the_road() -> None:
    """Where nothing nears white: linear radiance is the road's times the ratio of the albedos."""
    for sky in (sky_with_sun(0, 30, radius_deg=4), ConstantSky(torch.tensor([0.2, 0.2, 0.2]))):
        for rgb in ((0.05, 0.05, 0.05), (0.2, 0.2, 0.2)):
            light = illumination_of(street(sky, rgb), snow(albedo=0.8))
            shown = float(level(light) @ [0.2126, 0.7152, 0.0722])
            # sRGB's two halves are given to four digits
            assert shown == pytest.approx(luminance(rgb) * 0.8 / 0.10, rel=1e-4)


def test_darker_roads_and_lower_albedos_make_darker_snow() -> None:
    sky = sky_with_sun(50, 40)
    roads = [0.0, 0.02, 0.1, 0.3, 0.6, 1.0]
    by_road = [luminance(illumination_of(street(sky, (v, v, v)), snow()).lit_rgb) for v in roads]
    assert by_road[0] < 1e-6 and all(a < b for a, b in itertools.pairwise(by_road))
    assert by_road[-1] <= 0.87, "below white"
    place = street(sky)
    for fixed in ({}, {"brightness": 0.8}):
        values = [
            luminance(illumination_of(place, snow(albedo=a, **fixed)).lit_rgb)
            for a in (0.0, 0.3, 0.6, 0.85, 1.0)
        ]
        assert values[0] == 0 and all(a < b for a, b in itertools.pairwise(values))


def test_what_the_recipe_says_holds() -> None:
    place = street(sky_with_sun(50, 40))
    found = light_of(place)
    azimuth = illumination_of(place, snow(sun_azimuth_deg=-100))
    assert azimuth.sun == pytest.approx(unit(-100, found.elevation_deg), abs=1e-9)
    elevation = illumination_of(place, snow(sun_elevation_deg=0))
    assert elevation.sun == pytest.approx(unit(found.azimuth_deg, 0), abs=1e-9)
    both = illumination_of(place, snow(sun_azimuth_deg=90, sun_elevation_deg=90))
    assert both.sun == pytest.approx((0, 0, 1), abs=1e-9)
    ratios = []
    for share in (0.0, 0.5, 1.0):
        light = illumination_of(place, snow(sun=share))
        ratios.append(luminance(light.shadow_rgb) / luminance(light.lit_rgb))
        check(light)
    assert ratios[0] > ratios[1] > ratios[2] and ratios[2] == pytest.approx(0.5, abs=0.01)
    bright = illumination_of(place, snow(brightness=0.8))
    assert luminance(bright.lit_rgb) == pytest.approx(luminance((0.8, 0.8, 0.8)), rel=1e-6)
    check(illumination_of(place, snow(brightness=1.0, albedo=1.0)))


def test_the_road_is_asked_first_and_by_area() -> None:
    sky = ConstantSky(torch.tensor([0.5, 0.5, 0.5]))
    road = discs((0.3, 0.3, 0.3), SemanticClass.ROAD)
    walls = discs((0.9, 0.1, 0.1), SemanticClass.BUILDING, count=300)
    pavement = discs((0.6, 0.6, 0.6), SemanticClass.SIDEWALK, count=300)
    alone = light_of(scene(sky, road))
    assert alone.ground_albedo == 0.10
    assert alone.ground_rgb_linear == pytest.approx((luminance((0.3, 0.3, 0.3)),) * 3, rel=1e-5)
    assert light_of(scene(sky, joined(walls, pavement, road))) == alone
    few = discs((0.3, 0.3, 0.3), SemanticClass.ROAD, count=5)
    assert light_of(scene(sky, joined(few, pavement))).ground_albedo == 0.22
    # a layer of many small dark splats beneath, which nothing sees
    beneath = discs((0.0, 0.0, 0.0), SemanticClass.ROAD, count=100)
    small = dataclasses.replace(beneath, scales=0.3 * beneath.scales)
    faint = dataclasses.replace(beneath, opacities=0.1 * beneath.opacities)
    for layer in (small, faint):
        assert light_of(scene(sky, joined(road, layer))) == alone


def test_without_classes_level_splats_below_the_cameras_are_ground() -> None:
    sky = ConstantSky(torch.tensor([0.5, 0.5, 0.5]))
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]], dtype=torch.float64)
    pose[1, 3] = 1.5  # the eye stands at z = 1.5 m
    camera = Camera("front", 8, 6, 5.0, 5.0, 4.0, 3.0, pose)
    frames = (Frame(0, 0, torch.eye(4, dtype=torch.float64), {"front": camera}),)
    below, above = discs((0.3, 0.3, 0.3), None), discs((0.9, 0.9, 0.9), None, count=90, z=4.0)
    turned = math.sqrt(0.5) * torch.tensor([1.0, 1.0, 0, 0]).repeat(90, 1)
    upright = dataclasses.replace(discs((0.9, 0.1, 0.1), None, count=90), quats=turned)
    parts = [below, above, upright]
    names = ("means", "quats", "scales", "opacities", "sh")
    everything = Gaussians(*(torch.cat([getattr(p, name) for p in parts]) for name in names))
    found = light_of(scene(sky, everything, frames))
    assert found.ground_rgb_linear == pytest.approx((luminance((0.3, 0.3, 0.3)),) * 3, rel=1e-5)
    assert not found.ground_is_grey


def test_any_scene_gives_colours() -> None:
    numbers = ((0.0, 0.0), (0.0, math.nan), (1e-4, 40.0), (7.0, 1.0), (math.nan, 0.5))
    for (sky, road), semantic in itertools.product(numbers, (SemanticClass.ROAD, None)):
        count = 1 if road == 0.5 else 30
        place = scene(ConstantSky(torch.full((3,), sky)), discs((road,) * 3, semantic, count=count))
        for recipe in (snow(), snow(albedo=1.0, sun=1.0), snow(brightness=0.0)):
            check(illumination_of(place, recipe))
