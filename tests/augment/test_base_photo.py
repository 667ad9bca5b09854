"""The recorded image as the picture: the weather's law on its pixels, and bits that stay."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
import torch

from adapters.base import open_scene
from adapters.procedural import open_truth
from adapters.uri import parse_uri
from augment.effects.style.color_maps import MAX_SKY_LEVEL, NUM_CLASSES, StyleMaps
from augment.effects.style.style import SceneStyle
from augment.errors import SceneError
from augment.jobs.render_job import RenderJob, run_job
from augment.memo import memo_of
from augment.output.manifest import read_manifest
from augment.photo.recorded_base import MAX_CONDITION, Photo, open_photo
from augment.render.buffers import RenderOutput
from augment.render.fog import Fog
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from augment.scene.semantics import SemanticClass
from augment.view.plan import make_plan
from augment.view.render_view import render_buffers, render_view
from recipes.flood import Flood, Waves
from recipes.schema import Output, Recipe, Render, Smog, Weather
from recipes.snow import Snow
from recipes.style import Style
from tests.snow_scenes import drive, sheet, stack_all, wall

AIRLIGHT = (0.7, 0.72, 0.75)
COLOR_MAP = torch.tensor([[1.2, 0.1, 0.0, -0.05], [0.0, 0.8, 0.1, 0.02], [0.05, 0.0, 1.1, 0.0]])
WALL_M = 20.0
# Rows above the wall's top.
SKY_ROWS = slice(0, 36)


@pytest.fixture
def scene(tmp_path) -> Scene:
    """A road up to a wall, below an open sky; the photos are noise that no render could show, up to
    the wall's top, and a bright sky above it.
    """
    road, end = sheet((0.6, WALL_M), (-12, 12)), wall(WALL_M, (-12, 12), (0, 3))
    recorded_scene = drive(road, end, ground_z_m=0.0)
    frames = []
    for frame in recorded_scene.frames:
        path = tmp_path / f"{frame.index}.png"
        image = np.random.default_rng(frame.index).integers(0, 256, (90, 160, 3), np.uint8)
        image[SKY_ROWS] = (235, 228, 220)
        assert cv2.imwrite(str(path), image)
        frames.append(dataclasses.replace(frame, image_paths={"ahead": str(path)}))
    return dataclasses.replace(recorded_scene, frames=tuple(frames))


def photo_of(scene: Scene, frame: int = 0) -> np.ndarray:
    return cv2.imread(scene.frames[frame].image_paths["ahead"], cv2.IMREAD_COLOR_RGB)


def recipe_of(*, scale: float = 1.0, style: Style | None = None, **weather) -> Recipe:
    return Recipe(
        weather=Weather(**weather),
        style=style,
        render=Render(base="recorded", scale=scale),
        output=Output(semantic=True),
    )


def ahead(scene: Scene, frame: int = 0) -> Camera:
    return scene.frames[frame].cameras["ahead"]


# ---- Pixels that nothing touches -----------------------------------------------------------------


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("color_maps", [{}, {"ahead": COLOR_MAP}])
def test_without_weather_the_pixels_are_the_photos(scene, color_maps, backend):
    scene = dataclasses.replace(scene, color_maps=color_maps)
    view = render_view(scene, ahead(scene), recipe_of(), backend=backend)
    np.testing.assert_array_equal(view.rgb, photo_of(scene))
    half = render_view(scene, ahead(scene), recipe_of(scale=0.5), backend=backend)
    smaller = cv2.resize(photo_of(scene), (80, 45), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(half.rgb, smaller)


@pytest.mark.long
def test_snow_and_water_leave_every_pixel_that_they_do_not_cover(scene):
    photo = photo_of(scene)
    snow = recipe_of(snow=Snow(depth_m=0.1, cell_m=0.2, tracks="never"))
    buffers = render_buffers(scene, ahead(scene), make_plan(snow, scene))
    covered = buffers.raster.overlay.numpy() > 0
    view = render_view(scene, ahead(scene), snow)
    assert 0.2 < covered.mean() < 0.8
    np.testing.assert_array_equal(view.rgb[~covered], photo[~covered])
    deep = buffers.raster.overlay.numpy() > 0.999
    # Snow hides the noise: neighbours under it are alike.
    assert np.abs(np.diff(view.rgb[50:].astype(int), axis=1)[deep[50:, 1:]]).mean() < 8
    flood = recipe_of(flood=Flood(level_m=0.3, turbidity_ntu=500.0, waves=Waves(height=0.0)))
    view = render_view(scene, ahead(scene), flood)
    water = view.masks["water"] == 255
    is_dry = cv2.dilate(water.astype(np.uint8), np.ones((5, 5), np.uint8)) == 0
    assert 0.2 < water.mean() < 0.8 and is_dry.mean() > 0.2
    np.testing.assert_array_equal(view.rgb[is_dry], photo[is_dry])
    assert (view.rgb[water] != photo[water]).any(-1).mean() > 0.95


# ---- The law of the smog -------------------------------------------------------------------------


@pytest.mark.parametrize("color_maps", [{}, {"ahead": COLOR_MAP}])
@pytest.mark.parametrize("scale_height_m", [None, 10.0])
def test_smog_fades_the_photo_by_the_depth_of_the_scene(scene, scale_height_m, color_maps):
    scene = dataclasses.replace(scene, color_maps=color_maps)
    smog = Smog(extinction_per_m=0.05, color=AIRLIGHT, scale_height_m=scale_height_m)
    camera, photo = ahead(scene), photo_of(scene).astype(float) / 255
    view = render_view(scene, camera, recipe_of(smog=smog))
    rays = camera.ray_directions(torch.float64).numpy()
    length = np.linalg.norm(rays, axis=-1)
    with np.errstate(divide="ignore"):
        depth = np.where(rays[..., 2] < 0, 1.5 / -rays[..., 2], np.inf)
    depth = np.minimum(depth, WALL_M)
    height = 1.5 + depth * rays[..., 2]
    distance = depth * length
    if scale_height_m is not None:
        a, b = 1.5 / scale_height_m, height / scale_height_m
        safe = np.where(np.abs(b - a) < 1e-6, 1e-6, b - a)
        distance = distance * (np.exp(-a) - np.exp(-b)) / safe
        distance = np.where(np.abs(b - a) < 1e-6, depth * length * np.exp(-a), distance)
    t = np.exp(-0.05 * distance)[..., None]
    airlight = np.array(AIRLIGHT)
    if color_maps:
        airlight = COLOR_MAP[:, :3].numpy() @ airlight + COLOR_MAP[:, 3].numpy()
    expected = 255 * (t * photo + (1 - t) * airlight).clip(0, 1)
    inner = height < 0.8  # the filter reaches 4 pixels: away from the edges of road and wall
    inner[:, :44] = inner[:, 116:] = False
    error = np.abs(view.rgb - expected)[inner]
    # Of a splat's centre as its depth, and of the filter where rows of the road are metres apart.
    assert np.median(error) <= 1.0 and np.quantile(error, 0.95) <= 6.0
    sky = rays[..., 2] > 0.25
    if scale_height_m is None:
        everywhere = np.broadcast_to(255 * airlight, view.rgb[sky].shape)
        assert np.abs(view.rgb[sky] - everywhere).max() <= 0.51
    else:
        assert (np.abs(view.rgb[sky] - 255 * photo[sky]).mean(-1) > 1).mean() > 0.9


def test_a_hole_in_the_road_is_as_far_as_the_road(scene):
    """And the sky is far, however the hole is read."""
    smog = Smog(extinction_per_m=0.05, color=AIRLIGHT)
    bare = dataclasses.replace(scene, background=wall(WALL_M, (-12, 12), (0, 3)))
    full_rgb, holed = (render_view(s, ahead(s), recipe_of(smog=smog)).rgb for s in (scene, bare))
    road = slice(60, 90)
    assert np.abs(full_rgb[road].astype(int) - holed[road]).mean() < 1.0
    # Where the road is unknown, a hole is as far as the wall that it borders on, and no sky.
    unknown = dataclasses.replace(bare, ground_z_m=None)
    rgb = render_view(unknown, ahead(unknown), recipe_of(smog=smog)).rgb
    assert not (rgb[road] == 179).all(-1).any()
    assert (rgb[SKY_ROWS.start : SKY_ROWS.stop - 6] == (179, 184, 191)).all()


@pytest.mark.parametrize("scale_height_m", [None, 8.0])
@pytest.mark.parametrize("height_m", [None, 1.5])
def test_the_kernels_are_their_definitions(scale_height_m, height_m):
    """float64 goes through torch."""
    camera = ahead(drive(sheet((0, 1), (0, 1)))).resized(53, 31)
    numbers = np.random.default_rng(0)
    pixels = numbers.integers(0, 256, (31, 53, 3), np.uint8)
    photo = Photo(camera, pixels, "cpu", height_m=height_m)
    alpha = torch.from_numpy(numbers.choice([0.0, 0.02, 0.5, 1.0], (31, 53)))
    depth = torch.from_numpy(numbers.uniform(0, 500, (31, 53))) * (alpha > 0)
    for sigma, base_z_m in ((1e-6, 1000.0), (0.03, 0.3), (50.0, -40.0), (100.0, 0.3)):
        fog = Fog(sigma, AIRLIGHT, scale_height_m, base_z_m)
        fast, slow = (
            photo.transmittance(RenderOutput(alpha=a, expected_depth=z), fog)
            for a, z in ((alpha.float(), depth.float()), (alpha, depth))
        )
        assert bool(fast.isfinite().all()) and 0 <= float(fast.min()) <= float(fast.max()) <= 1
        torch.testing.assert_close(fast, slow.float(), rtol=0, atol=2e-5)


def test_a_close_thing_ends_where_the_photo_shows_its_end():
    """Its splats reach 8 pixels further; where the photo shows their end no bit changes."""
    camera = ahead(drive(sheet((0, 1), (0, 1)))).resized(320, 180)
    fog = Fog(0.05, AIRLIGHT, None, 0.0)
    columns = np.arange(320)
    for end, moved in ((166, True), (174, False)):
        gray = np.where(columns < end, 30, 120) + np.random.default_rng(0).integers(0, 6, (180, 1))
        pixels = np.repeat(gray[..., None], 3, 2).astype(np.uint8)
        photo = Photo(camera, pixels, "cpu")
        depth = torch.from_numpy(np.where(columns < 174, 2.0, 40.0)).float().repeat(180, 1)
        raster = RenderOutput(alpha=torch.ones(180, 320), expected_depth=depth)
        row_transmittance = photo.transmittance(raster, fog)[90]
        near, far = float(row_transmittance[120]), float(row_transmittance[250])
        assert near > 0.85 and far < 0.15
        assert bool((row_transmittance[:162] > 0.8).all()) and bool(
            (row_transmittance[182:] < 0.2).all()
        )
        if moved:
            assert bool((row_transmittance[170:] < 0.3).all())
        else:
            values = torch.where(depth < 10, 0.9, 0.1)
            assert torch.equal(photo.align_edges(values, torch.ones(180, 320), depth), values)


STREET = "procedural:street?seed=3&frames=1"


@pytest.mark.long
def test_fog_on_the_photo_is_fog_on_exact_depth(tmp_path):
    scene = open_scene(STREET)
    frame = scene.frames[0]
    truth, clear = open_truth(parse_uri(STREET)[2]), Recipe(render=Render(scale=0.5))
    name, path = "front", tmp_path / "front.png"
    camera = frame.cameras[name].scaled(0.5)
    photo = render_view(scene, frame.cameras[name], clear).rgb
    assert cv2.imwrite(str(path), photo[..., ::-1])
    photo_frame = dataclasses.replace(frame, cameras={name: camera}, image_paths={name: str(path)})
    scene = dataclasses.replace(scene, frames=(photo_frame,))
    true = truth.render(camera)
    distance = true.depth * camera.ray_lengths(torch.float64).numpy()
    for visibility_m in (50.0, 150.0):
        t = np.exp(-3.912 / visibility_m * distance)[..., None]
        expected = np.round(t * photo + (1 - t) * 255 * np.array(AIRLIGHT))
        smog = Smog(visibility_m=visibility_m, color=AIRLIGHT)
        view = render_view(scene, camera, recipe_of(smog=smog))
        psnr = 10 * np.log10(255**2 / np.mean((view.rgb - expected) ** 2))
        assert psnr >= 40.0


# ---- Style ---------------------------------------------------------------------------------------


def test_a_style_maps_land_and_sky_of_the_photo_each_by_its_own(scene):
    style = Style(preset="dusk")
    land = torch.tensor([[0.5, 0.2, 0.0, 0.1], [0.0, 0.7, 0.0, 0.0], [0.1, 0.0, 0.6, 0.05]])
    sky = torch.tensor([[0.0, 0.0, 0.4, 0.3], [0.0, 0.5, 0.0, 0.2], [0.3, 0.0, 0.0, 0.1]])
    maps = StyleMaps(land.repeat(NUM_CLASSES, 1, 1), sky, land)
    memo_of(scene).put(("style maps", style), maps, shared=True)
    rgb = render_view(scene, ahead(scene), recipe_of(style=style)).rgb
    photo = photo_of(scene).astype(float) / 255
    for rows, expected_map in ((slice(60, 85), land), (slice(0, 10), sky)):
        expected = photo[rows] @ expected_map[:, :3].numpy().T + expected_map[:, 3].numpy()
        assert np.abs(rgb[rows, 20:140] - 255 * expected[:, 20:140]).max() <= 0.51


def test_splats_say_by_marks_what_a_style_does_to_them(scene):
    """As their heaviest splats do, pixel by pixel, where these are solid."""
    maps = torch.eye(3, 4).repeat(NUM_CLASSES, 1, 1)
    maps[:, :, 3] = 0.1
    maps[int(SemanticClass.ROAD), :, 3] = torch.tensor([0.3, 0.0, 0.2])
    end = wall(WALL_M, (-12, 12), (0, 3))
    end = dataclasses.replace(end, semantic=torch.zeros(len(end), dtype=torch.int16))
    road = sheet((0.6, WALL_M), (-12, 12), semantic=int(SemanticClass.ROAD))
    scene = dataclasses.replace(scene, background=stack_all((end, road)))
    levels = torch.zeros(len(scene.background), dtype=torch.int16)
    levels[: len(end)] = (end.means[:, 1] > 0).short() * (MAX_SKY_LEVEL // 2)
    sky = torch.tensor([[0.5, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 0.5, 0]])
    full_style = SceneStyle(StyleMaps(maps, sky, sky), scene.sky, scene, levels).photo_style
    camera = ahead(scene)

    def shown(style, dtype=torch.float32):
        photo = dataclasses.replace(open_photo(scene, camera, None, backend="cpu"), style=style)
        parts, buffers = photo.prepare_parts(scene.parts_for(camera))
        raster = rasterize(parts, camera, buffers=buffers | {"alpha"})
        moved = {name: getattr(raster, name) for name in ("rgb", "alpha")}
        moved = {name: None if own is None else own.to(dtype) for name, own in moved.items()}
        return photo.clear_picture(dataclasses.replace(raster, **moved), parts)

    by_marks, by_ids = shown(full_style), shown(dataclasses.replace(full_style, mark_maps=None))
    assert float((by_marks - by_ids).abs().quantile(0.9)) < 0.01
    torch.testing.assert_close(
        by_marks, shown(full_style, torch.float64).float(), rtol=0, atol=1e-5
    )
    single_style = dataclasses.replace(
        full_style,
        surface_maps=maps[:1],
        other_splat_maps=None,
        mark_maps=full_style.mark_maps[:: len(maps)],
    )
    single_style = dataclasses.replace(
        single_style, mark_rows=levels
    )  # one map for all takes a kernel
    fast, slow = (
        shown(single_style),
        shown(dataclasses.replace(single_style, other_splat_maps=maps[:0])),
    )
    torch.testing.assert_close(fast, slow, rtol=0, atol=1e-6)
    by_ids = shown(dataclasses.replace(single_style, mark_maps=None))
    assert float((fast - by_ids).abs().quantile(0.9)) < 0.01


# ---- Jobs, and what is refused -------------------------------------------------------------------


def test_a_job_writes_the_photos_says_so_and_goes_on(scene, tmp_path):
    job = RenderJob("test:sheets", [recipe_of()], tmp_path / "out")
    result = run_job(job, scene_loader=lambda _: scene, progress=False)
    assert (result.written, result.failed) == (2, 0)
    rows = read_manifest(tmp_path / "out").to_pylist()
    assert {row["base"] for row in rows} == {"recorded"}
    for row in rows:
        image = cv2.imread(str(tmp_path / "out" / row["image_path"]), cv2.IMREAD_COLOR_RGB)
        np.testing.assert_array_equal(image, photo_of(scene, row["frame"]))
    lost = tmp_path / "out" / rows[1]["image_path"]
    lost.unlink()
    again = run_job(job, scene_loader=lambda _: scene, progress=False)
    assert (again.written, again.failed) == (1, 0)
    image = cv2.imread(str(lost), cv2.IMREAD_COLOR_RGB)
    np.testing.assert_array_equal(image, photo_of(scene, rows[1]["frame"]))


def test_what_was_not_recorded_is_refused_before_anything_is_written(scene, tmp_path):
    recipe = recipe_of()
    frames = tuple(dataclasses.replace(f, image_paths={}) for f in scene.frames)
    none = dataclasses.replace(scene, frames=frames)
    partial_scene = dataclasses.replace(scene, frames=(scene.frames[0], frames[1]))
    jobs = (
        (scene, recipe, {"camera_path": frames}, "a camera path shows what no camera"),
        (
            partial_scene,
            recipe,
            {},
            r"1 of 2 selected images .* camera 'ahead' of frame 1: none is known",
        ),
    )
    for job_scene, job_recipe, options, message in jobs:
        job = RenderJob("test:sheets", [job_recipe], tmp_path / "out", **options)
        with pytest.raises(SceneError, match=message):
            run_job(job, scene_loader=lambda _, job_scene=job_scene: job_scene, progress=False)
    assert not (tmp_path / "out").exists()
    run_job(
        RenderJob("test:sheets", [recipe], tmp_path / "out", frames=[0]),
        scene_loader=lambda _: partial_scene,
        progress=False,
    )
    with pytest.raises(SceneError, match=r"has no recorded images; open the recording"):
        make_plan(recipe, none)
    with pytest.raises(SceneError, match=r"render.scale must be <= 1, got 2"):
        make_plan(recipe_of(scale=2.0), scene)
    moved = ahead(scene).camera_from_world.clone()
    moved[0, 3] += 0.1
    novel = dataclasses.replace(ahead(scene), camera_from_world=moved)
    with pytest.raises(SceneError, match=r"no recorded image of camera 'ahead' at 0 ns"):
        render_view(scene, novel, recipe)
    flat = torch.tensor([[1.0, 0, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0]])
    assert torch.linalg.cond(flat[:, :3]) > MAX_CONDITION
    with pytest.raises(SceneError, match=r"has no inverse .* exposure: neutral"):
        open_photo(scene, ahead(scene), flat, backend="cpu")
    cv2.imwrite(scene.frames[0].image_paths["ahead"], np.zeros((9, 16, 3), np.uint8))
    with pytest.raises(SceneError, match=r"0.png is of 16x9 pixels; its camera is of 160x90"):
        render_view(scene, ahead(scene), recipe)


def test_recipes_without_the_field_keep_their_hash():
    assert '"base"' not in Recipe().canonical_json()
    assert Recipe().hash != recipe_of().hash
