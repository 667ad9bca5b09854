"""Pictures through lenses and rolling shutters, on a small street whose every point is known."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from augment.output.box_tables import BOXES_2D
from augment.scene.boxes import EDGES, WorldBoxes, find_occlusion, instances_of, outline_world_boxes
from augment.scene.cameras import Camera
from augment.scene.lens_boxes import BoxFrames, count_pixels_through_lens
from augment.scene.lenses import FisheyeLens, Intrinsics, Lens, OpenCVLens
from augment.scene.pinhole_scene import pinhole_scene
from augment.scene.pinhole_views import covering_camera, layout_of
from augment.scene.pixel_rays import pixel_rays_of, project_points
from augment.scene.scene import Gaussians, Scene
from augment.scene.shutter import RollingShutter
from augment.view.box_labels import label_view
from augment.view.lens_view import strips_of
from augment.view.render_view import render_view
from recipes.lens_drops import LensDrops
from recipes.schema import Output, Recipe, Render, Sensor, Smog, Weather
from tests.streets import open_street

CLEAR = Recipe()
LABELLED = Recipe(
    output=Output(depth="expected", semantic=True, instance=True, labels=True, trust=True)
)
BARREL = OpenCVLens(radial=(-0.35, 0.18, -0.06, 0.0, 0.0, 0.0), tangential=(0.001, -0.002))
FISHEYE = FisheyeLens(radial=(-0.01, 0.002, 0.0, 0.0), limit_rad=math.radians(95.0))


@pytest.fixture(scope="module")
def street() -> Scene:
    return open_street()


def camera_with(scene: Scene, lens: Lens | None, width: int = 160, height: int = 96) -> Camera:
    """Return the street's front camera with a lens, in a small image."""
    camera = scene.frames[0].cameras["front"]
    is_wide = isinstance(lens, FisheyeLens)
    focal_px = height / 2 / math.radians(95.0) if is_wide else width * 0.7
    intrinsics = Intrinsics(focal_px, focal_px, width / 2 + 0.3, height / 2 - 0.2)
    return dataclasses.replace(
        camera, width=width, height=height, **intrinsics._asdict(), lens=lens
    )


def test_a_lens_without_distortion_shows_what_the_pinhole_shows(street):
    plain = render_view(street, camera_with(street, None), LABELLED)
    through_lens = render_view(street, camera_with(street, OpenCVLens()), LABELLED)
    # The view is a little larger than the image, whose size clamps splats beside it.
    difference = np.abs(plain.rgb.astype(int) - through_lens.rgb)
    assert difference.max() <= 4
    assert difference.mean() < 0.1
    assert plain.depth_m is not None and through_lens.depth_m is not None
    for got, expected in (
        (through_lens.depth_m, plain.depth_m),
        (through_lens.semantic, plain.semantic),
        (through_lens.instance, plain.instance),
    ):
        assert got is not None and expected is not None
        assert np.isclose(got, expected, rtol=1e-2).mean() > 0.97


@pytest.mark.parametrize("lens", [BARREL, FISHEYE], ids=["barrel", "fisheye"])
def test_pinhole_views_are_at_least_as_fine_as_the_lens_and_cover_it(street, lens):
    camera = camera_with(street, lens)
    layout = layout_of(camera)
    total = np.sum([view.weights for view in layout.views], axis=0)
    np.testing.assert_allclose(total[layout.is_inside], 1.0, atol=1e-5)
    assert not total[~layout.is_inside].any()
    for view in layout.views:
        is_used = view.weights > 0
        pixels = view.pixels[is_used]
        assert (pixels >= 0).all() and (pixels <= (view.width, view.height)).all()
        # The ray of the view's pixel is the lens's.
        fx, fy, cx, cy = view.intrinsics
        local = np.stack([(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, np.ones(len(pixels))])
        ray = view.view_from_camera.T @ (local / np.linalg.norm(local, axis=0))
        np.testing.assert_allclose(ray.T, layout.rays[is_used], atol=2e-6)
        step = np.diff(view.pixels, axis=1)[is_used[:, 1:] & is_used[:, :-1]]
        assert np.quantile(np.linalg.norm(step, axis=1), 0.01) > 0.97


@pytest.mark.parametrize("lens", [BARREL, FISHEYE], ids=["barrel", "fisheye"])
def test_depth_of_a_wall_is_z_or_the_distance_as_the_lens_says(street, lens):
    wall_m = 6.0
    across, down = np.meshgrid(np.arange(-9, 9, 0.05), np.arange(-5, 5, 0.05))
    # Splats are blurred by pixels, and the nearest ones count first: small pixels, small error.
    camera = camera_with(street, lens, 960, 576)
    local = np.stack([across.ravel(), down.ravel(), np.full(across.size, wall_m)], 1)
    pose = camera.world_from_camera.numpy()
    count = len(local)
    wall = Gaussians(
        means=torch.from_numpy(local @ pose[:3, :3].T + pose[:3, 3]).float(),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        scales=torch.full((count, 3), 0.03),
        opacities=torch.full((count,), 0.99),
        sh=torch.zeros(count, 1, 3),
        semantic=torch.zeros(count, dtype=torch.int16),
    )
    view = render_view(dataclasses.replace(street, background=wall, actors=()), camera, LABELLED)
    assert view.depth_m is not None
    layout = layout_of(camera)
    rays = layout.rays
    z = np.maximum(rays[..., 2], 0.05)
    point = rays / z[..., None] * wall_m
    is_wall = (
        layout.is_inside
        & (rays[..., 2] > 0.2)
        & (np.abs(point[..., 0]) < 8.5)
        & (np.abs(point[..., 1]) < 4.5)
    )
    assert is_wall.mean() > 0.05
    expected = (
        wall_m / rays[..., 2] if lens.is_depth_along_ray else np.full_like(rays[..., 2], wall_m)
    )
    is_close = np.isclose(view.depth_m[is_wall], expected[is_wall], rtol=0.01)
    assert is_close.mean() > 0.99


def test_cameras_with_one_lens_share_a_layout_and_errors_name_the_camera(street):
    camera = camera_with(street, BARREL)
    assert layout_of(dataclasses.replace(camera, name="left")) is layout_of(camera)
    blind = dataclasses.replace(camera_with(street, FISHEYE), cx=1e4)
    for name in ("left", "right"):
        with pytest.raises(ValueError, match=f"camera '{name}': no pixel of its image of 160x96"):
            layout_of(dataclasses.replace(blind, name=name))


def test_nothing_is_seen_outside_of_the_lens(street):
    recipe = LABELLED.model_copy(update={"camera": Sensor(noise=0.02, psf_px=1.0)})
    camera = camera_with(street, FISHEYE)
    view = render_view(street, camera, recipe)
    outside = ~layout_of(camera).is_inside
    assert 0.3 < outside.mean() < 0.7
    assert view.camera.lens == FISHEYE
    for image in (view.rgb, view.depth_m, view.instance, view.masks["trust"]):
        assert image is not None
        assert not image[outside].any()
    assert (view.rgb[~outside].max(-1) > 0).mean() > 0.99


def test_glass_and_sensor_belong_to_the_whole_image(street):
    camera = camera_with(street, FISHEYE)
    recipe = Recipe(camera=Sensor(lens_drops=LensDrops(count=12), noise=0.01))
    first = render_view(street, camera, recipe)
    second = render_view(street, camera, recipe)
    np.testing.assert_array_equal(first.rgb, second.rgb)
    assert first.masks["lens_drops"].any()
    # The same drops as on a pinhole image of this size: not one set for each view.
    pinhole = render_view(street, camera.without_lens(), recipe)
    np.testing.assert_array_equal(first.masks["lens_drops"] > 0, pinhole.masks["lens_drops"] > 0)


def test_fog_through_several_views_has_no_seams(street):
    fog = Recipe(weather=Weather(smog=Smog(visibility_m=10.0)))
    camera = camera_with(street, FISHEYE, 192, 192)
    assert len(layout_of(camera).views) > 1
    picture = render_view(street, camera, fog).rgb.astype(np.float64)
    # Rows of sky in dense fog are grey, whatever view they come from.
    inside = layout_of(camera).is_inside[30]
    assert np.ptp(picture[30][inside], axis=0).max() <= 1


@pytest.mark.parametrize("lens", [BARREL, FISHEYE], ids=["barrel", "fisheye"])
def test_outlines_of_boxes_enclose_their_projected_corners(street, lens):
    camera = camera_with(street, lens, 480, 288)
    boxes = WorldBoxes.from_labels(street.labels.boxes(0), street.world_origin_m)
    outlines = outline_world_boxes(boxes, camera)
    checked = 0
    for number in np.flatnonzero(outlines.in_view & (outlines.truncated_fraction == 0)):
        share = np.linspace(0, 1, 101)[:, None]
        ends = boxes.corners_m[number][EDGES]
        points = (ends[:, :1] + share * (ends[:, 1:] - ends[:, :1])).reshape(-1, 3)
        pixels, is_shown = project_points(camera, points)
        assert is_shown.all()
        expected = [*pixels.min(0), *pixels.max(0)]
        np.testing.assert_allclose(outlines.xyxy[number], expected, atol=0.1)
        checked += 1
    assert checked >= 3


def test_masks_through_a_lens_lie_within_their_outlines(street):
    camera = camera_with(street, BARREL, 320, 192)
    boxes = street.labels.boxes(0)
    view = render_view(street, camera, LABELLED)
    labelled, tables = label_view(
        boxes, instances_of(street), street.world_origin_m, camera, view, LABELLED
    )
    numbers = instances_of(street).numbers_of(boxes.track_ids)
    outlines = outline_world_boxes(WorldBoxes.from_labels(boxes, street.world_origin_m), camera)
    checked = 0
    for number, outline, in_view in zip(numbers, outlines.xyxy, outlines.in_view, strict=True):
        rows, columns = np.nonzero(labelled.instance == number)
        if not in_view or len(rows) < 50:
            continue
        # Splats of a car reach a little beyond its box: most pixels must not.
        left, top, right, bottom = outline
        is_within = (columns >= left - 1) & (columns < right + 1)
        is_within &= (rows >= top - 1) & (rows < bottom + 1)
        assert is_within.mean() > 0.85
        checked += 1
    assert checked >= 2
    assert tables[BOXES_2D.name].track_ids == boxes.track_ids


def test_counting_through_rays_is_what_the_pinhole_kernel_counts(street):
    camera = camera_with(street, None)
    view = render_view(street, camera, LABELLED)
    assert view.surface is not None
    boxes = WorldBoxes.from_labels(street.labels.boxes(0), street.world_origin_m)
    numbers = instances_of(street).numbers_of(boxes.track_ids)
    actors = np.where(numbers <= len(street.actors), numbers, 0).astype(np.uint16)
    depth_m = view.surface.depth_m
    expected = find_occlusion(boxes, camera, depth_m, view.instance, actors, with_owners=True)
    half = boxes.sizes_m / 2
    counts, owners = count_pixels_through_lens(
        pixel_rays_of(camera),
        BoxFrames(
            boxes.centres_m,
            boxes.rotations,
            np.stack([boxes.low_m, boxes.high_m], 1),
            np.stack([np.maximum(boxes.low_m, -half), np.minimum(boxes.high_m, half)], 1),
        ),
        np.tile(np.array([0, 0, camera.width, camera.height]), (len(boxes), 1)),
        depth_m,
        view.instance,
        np.zeros((0, 0), bool),
        actors.astype(np.int64),
        0.01,
    )
    np.testing.assert_array_equal(counts[:, 0], expected.num_shown)
    np.testing.assert_array_equal(counts[:, 1], expected.num_hidden)
    np.testing.assert_array_equal(owners, expected.owner_boxes)


def test_scenes_with_lenses_look_with_pinholes_and_share_what_is_computed(street):
    assert pinhole_scene(street) is street
    frames = tuple(
        dataclasses.replace(
            frame,
            cameras={n: dataclasses.replace(c, lens=BARREL) for n, c in frame.cameras.items()},
        )
        for frame in street.frames
    )
    scene = dataclasses.replace(street, frames=frames)
    changed = pinhole_scene(scene)
    assert changed is pinhole_scene(scene)
    moved = dataclasses.replace(scene, seen_frames=frames, actors=(), recorded=None)
    moved = dataclasses.replace(moved, actors=street.actors, recorded=moved)
    assert pinhole_scene(moved).as_recorded is pinhole_scene(moved.as_recorded)
    camera = changed.frames[0].cameras["front"]
    assert camera.is_pinhole
    lens_camera = scene.frames[0].cameras["front"]
    covering = covering_camera(lens_camera)
    assert covering.width > lens_camera.width  # a barrel squeezes what a pinhole shows
    torch.testing.assert_close(camera.camera_from_world, lens_camera.camera_from_world)
    view = render_view(scene, lens_camera.scaled(0.2), LABELLED)
    assert view.masks["trust"].any()


# ---- Rolling shutters ----------------------------------------------------------------------------


def moving(camera: Camera, distance_m: float, read_out: str = "top_to_bottom") -> Camera:
    """Return the camera with a shutter that is read while it moves to its right."""
    start = torch.eye(4, dtype=torch.float64)
    start[0, 3] = distance_m / 2
    end = torch.eye(4, dtype=torch.float64)
    end[0, 3] = -distance_m / 2
    shutter = RollingShutter(start, end, read_out, 30_000_000)
    return dataclasses.replace(camera, shutter=shutter)


def test_a_standing_camera_shows_the_same_with_and_without_a_shutter(street):
    camera = camera_with(street, None)
    plain = render_view(street, camera, LABELLED)
    still = moving(camera, 0.0)
    shutter = dataclasses.replace(still.shutter, duration_ns=0)
    rolling = render_view(street, dataclasses.replace(still, shutter=shutter), LABELLED)
    # Splats beside a view are clamped by the view's size, and strips are smaller than the image.
    assert np.abs(plain.rgb.astype(int) - rolling.rgb).mean() < 0.5
    assert (plain.instance == rolling.instance).mean() > 0.97


@pytest.mark.parametrize("lens", [None, BARREL], ids=["pinhole", "barrel"])
def test_rows_of_strips_show_their_own_moment(street, lens):
    camera = moving(camera_with(street, lens), 0.6)
    rolling = render_view(street, camera, Recipe(render=Render(shutter_strips=4))).rgb
    for row in (10, 50, 80):
        moment = camera.at_read_out(camera.shutter.share_at(row + 0.5, camera.height))
        expected = render_view(street, moment, CLEAR).rgb[row].astype(int)
        of_middle = render_view(street, camera.at_read_out(0.5), CLEAR).rgb[row].astype(int)
        error = np.abs(rolling[row] - expected).mean()
        assert error < 3
        assert row == 50 or error < 0.5 * np.abs(of_middle - expected).mean()
    first = strips_of(camera, 4)[0].camera
    last = strips_of(camera, 4)[3].camera
    assert float((last.centre - first.centre).norm()) == pytest.approx(0.45)
    assert last.timestamp_ns - first.timestamp_ns == 22_500_000


def test_windows_of_a_rolling_shutter_show_the_same_rows(street):
    camera = moving(camera_with(street, None), 0.4)
    whole = render_view(street, camera, CLEAR).rgb.astype(int)
    window = render_view(street, camera.cropped(0, 40, camera.width, 30), CLEAR).rgb
    assert np.abs(whole[40:70] - window).mean() < 1.5


def test_points_are_projected_at_the_time_of_their_row(street):
    camera = moving(camera_with(street, None), 2.0)
    points = camera.centre.numpy() + np.array([[12.0, 1.0, -1.0], [15.0, -2.0, 2.0]])
    local = points @ camera.camera_from_world[:3, :3].numpy().T
    local += camera.camera_from_world[:3, 3].numpy()
    points = points[local[:, 2] > 1]
    assert len(points)
    pixels, is_shown = project_points(camera, points)
    assert is_shown.all()
    for point, pixel in zip(points, pixels, strict=True):
        moment = camera.at_read_out(camera.shutter.share_at(float(pixel[1]), camera.height))
        expected, _ = project_points(moment, point[None])
        # Between two of 33 poses the way of a point over the image is taken for straight.
        np.testing.assert_allclose(pixel, expected[0], atol=1e-3)
    # And the rays of pixels go through these points.
    rays = pixel_rays_of(camera)
    row, column = int(pixels[0, 1]), int(pixels[0, 0])
    along = points[0] - rays.origins_m[row, 0]
    direction = rays.directions[row, column]
    cosine = along @ direction / np.linalg.norm(along) / np.linalg.norm(direction)
    assert cosine > 1 - (1.5 / camera.fx) ** 2
