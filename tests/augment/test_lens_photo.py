"""Photos through lenses: they come back where nothing changes, and stay sharp where it does."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from augment.errors import SceneError
from augment.photo.lens_photo import transfer_change
from augment.photo.own_car import own_car_mask
from augment.scene.cameras import Camera
from augment.scene.lenses import FisheyeLens, OpenCVLens
from augment.scene.pinhole_views import layout_of
from augment.scene.pixel_rays import turn_between
from augment.scene.scene import Scene
from augment.scene.shutter import RollingShutter
from augment.view.render_view import render_view
from recipes.schema import Recipe, Render, Weather
from recipes.smog import Smog
from tests.streets import open_street

LENS = OpenCVLens.from_coefficients([-0.3, 0.1, 0.001, -0.0005, -0.01])
WIDTH = 240
HEIGHT = 135


def recipe(*, visibility_m: float | None = None, scale: float = 1.0) -> Recipe:
    weather = Weather() if visibility_m is None else Weather(smog=Smog(visibility_m=visibility_m))
    return Recipe(name="photo", weather=weather, render=Render(base="recorded", scale=scale))


@pytest.fixture(scope="module")
def street() -> Scene:
    return open_street()


def photographed(street: Scene, folder: Path, *, has_shutter: bool = False, lens=LENS) -> Scene:
    """Return the street with one camera that recorded noise through a lens."""
    frame = street.frames[1]
    name = next(iter(frame.cameras))
    camera = frame.cameras[name].resized(WIDTH, HEIGHT)
    shutter = None
    if has_shutter:
        later = camera.camera_from_world.clone()
        later[2, 3] -= 0.4
        shutter = RollingShutter.between(
            camera.camera_from_world,
            later,
            read_out="left_to_right",
            duration_ns=40_000_000,
            camera_from_world=camera.camera_from_world,
        )
    camera = dataclasses.replace(camera, lens=lens, shutter=shutter)
    rng = np.random.default_rng(5)
    small = rng.integers(0, 256, (HEIGHT // 3, WIDTH // 3, 3)).astype(np.uint8)
    path = folder / "photo.png"
    image = cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST)
    assert cv2.imwrite(str(path), image)
    lens_frame = dataclasses.replace(frame, cameras={name: camera}, image_paths={name: str(path)})
    return dataclasses.replace(street, frames=(lens_frame,), seen_frames=())


def only_camera(scene: Scene) -> Camera:
    return next(iter(scene.frames[0].cameras.values()))


def recorded_pixels(scene: Scene) -> np.ndarray:
    image = cv2.imread(next(iter(scene.frames[0].image_paths.values())))
    assert image is not None
    return image[..., ::-1]


@pytest.mark.parametrize("has_shutter", [False, True])
@pytest.mark.parametrize("lens", [LENS, None])
def test_without_weather_the_recorded_pixels_come_back(street, tmp_path, has_shutter, lens):
    if lens is None and not has_shutter:
        pytest.skip("a pinhole, whose photos have tests of their own")
    scene = photographed(street, tmp_path, has_shutter=has_shutter, lens=lens)
    view = render_view(scene, only_camera(scene), recipe())
    np.testing.assert_array_equal(view.rgb, recorded_pixels(scene))


def test_fog_fades_the_photo_by_the_depth_of_the_lens_image(street, tmp_path):
    """Koschmieder's law with the depth that the splats have through the same lens."""
    scene = photographed(street, tmp_path)
    camera = only_camera(scene)
    view = render_view(scene, camera, recipe(visibility_m=60.0))
    clear = recorded_pixels(scene).astype(float)
    depth = render_view(scene, camera, Recipe(name="depth"))
    assert depth.depth_m is not None
    distance = depth.depth_m.astype(float)
    rays, _ = LENS.rays(
        np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), -1),
        camera.intrinsics,
    )
    distance = distance / rays[..., 2]
    # The spread of colours in blocks of the photo shrinks as the transmittance of their distance.
    contrasts = []
    for row in range(0, HEIGHT - 8, 8):
        for column in range(0, WIDTH - 8, 8):
            block = slice(row, row + 8), slice(column, column + 8)
            away = distance[block]
            if away.min() <= 0 or away.max() > 1.3 * away.min():
                continue
            ratio = view.rgb[block].astype(float).std() / clear[block].std()
            contrasts.append((np.exp(-np.log(50) / 60 * away.mean()), ratio))
    assert len(contrasts) > 10
    expected, measured = np.array(contrasts).T
    # Fog mixes linear light, contrast is that of display values: the relation is monotonous.
    assert np.corrcoef(expected, measured)[0, 1] > 0.9
    assert measured[expected > 0.6].mean() > measured[expected < 0.3].mean() + 0.2


def test_a_scaled_photo_is_the_mean_of_its_pixels(street, tmp_path):
    scene = photographed(street, tmp_path)
    view = render_view(scene, only_camera(scene), recipe(scale=1 / 3))
    size = (WIDTH // 3, HEIGHT // 3)
    expected = cv2.resize(recorded_pixels(scene), size, interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(view.rgb, expected)


def test_a_camera_that_recorded_nothing_is_refused(street, tmp_path):
    scene = photographed(street, tmp_path)
    other = dataclasses.replace(only_camera(scene), lens=OpenCVLens())
    with pytest.raises(SceneError, match="has no recorded image"):
        render_view(scene, other, recipe())


def test_the_change_is_transferred_with_the_slope_of_the_picture():
    rng = np.random.default_rng(3)
    recorded = rng.uniform(0.2, 0.8, (60, 80, 3)).astype(np.float32)
    copy = cv2.GaussianBlur(recorded, (3, 3), 0)
    np.testing.assert_allclose(transfer_change(copy, copy, recorded), recorded, atol=1e-6)
    faded = transfer_change(0.4 * copy + 0.5, copy, recorded)
    np.testing.assert_allclose(faded, 0.4 * recorded + 0.5, atol=0.02)
    covered = np.full_like(copy, 0.9)
    np.testing.assert_allclose(transfer_change(covered, copy, recorded), covered, atol=1e-5)


def test_pictures_do_not_depend_on_the_order_of_views(street, tmp_path):
    scene = photographed(street, tmp_path)
    camera = only_camera(scene)
    first = render_view(scene, camera, recipe(visibility_m=60.0)).rgb
    other = photographed(street, tmp_path)
    render_view(other, camera, recipe(visibility_m=30.0, scale=1 / 3))
    again = render_view(other, camera, recipe(visibility_m=60.0)).rgb
    np.testing.assert_array_equal(first, again)


def test_the_recording_car_is_where_a_turned_view_looks_at_it(street, tmp_path):
    """A mask of the lowest rows, in a view that looks 25 degrees down."""
    frame = street.frames[1]
    name = next(iter(frame.cameras))
    pinhole = frame.cameras[name].resized(WIDTH, HEIGHT)
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[HEIGHT - 30 :] = True
    frames = (dataclasses.replace(frame, cameras={name: pinhole}),)
    scene = dataclasses.replace(street, frames=frames, ego_masks={name: mask})
    angle = np.radians(-25.0)
    turn = torch.eye(4, dtype=torch.float64)
    turn[1:3, 1:3] = torch.tensor([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    view = dataclasses.replace(pinhole, camera_from_world=turn @ pinhole.camera_from_world)
    lens_camera = dataclasses.replace(pinhole, lens=LENS)
    in_view = own_car_mask(scene, view, lens_camera)
    directions = view.ray_directions().numpy().astype(float)
    local = directions @ pinhole.camera_from_world[:3, :3].numpy().T
    row = pinhole.fy * local[..., 1] / local[..., 2] + pinhole.cy
    expected = (local[..., 2] > 0) & (row > HEIGHT - 30)
    is_clear = np.abs(row - (HEIGHT - 30)) > 1
    assert in_view is not None and expected[is_clear].any() and not expected[is_clear].all()
    np.testing.assert_array_equal(in_view[is_clear], expected[is_clear])
    same = own_car_mask(scene, pinhole, lens_camera)
    np.testing.assert_array_equal(same, mask)


def test_views_of_a_lens_are_turned_by_the_same_numbers_in_all_frames(street):
    """What is computed once for a view of all images is looked up by this rotation."""
    cameras = [next(iter(frame.cameras.values())).resized(WIDTH, HEIGHT) for frame in street.frames]
    wide = [dataclasses.replace(camera, fx=70.0, fy=70.0, lens=FisheyeLens()) for camera in cameras]
    views = layout_of(wide[0]).views
    assert len(wide) > 1 and len(views) > 1
    for view in views:
        turns = [turn_between(camera, view.camera_for(camera)) for camera in wide]
        np.testing.assert_allclose(turns[0], view.view_from_camera.T, atol=1e-9)
        assert len({turn.tobytes() for turn in turns}) == 1
    np.testing.assert_array_equal(turn_between(wide[0], cameras[0]), np.eye(3))
