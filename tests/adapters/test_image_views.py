"""Colours and sky from images: what is seen, what is hidden, what is infinitely far."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import cv2
import numpy as np
import torch

from adapters.lidar_scene.image_views import Body, SurfelColours, View, observe_views
from adapters.lidar_scene.kernels import SkyGatherer
from adapters.lidar_scene.split import join_tracks
from adapters.lidar_scene.surfels import Surfels
from adapters.raw_drive import BoxSample
from augment.scene.cameras import Camera

WIDTH, HEIGHT, FOCAL = 64, 48, 32.0
# Camera axes in the world: looks along +x.
FORWARD = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
RED, GREEN, BLUE = (200, 30, 30), (30, 180, 40), (40, 60, 220)


def camera(name="front", at=(0.0, 0.0, 0.0), time_ns=0, rotation=FORWARD) -> Camera:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ np.asarray(at)
    matrix = torch.from_numpy(pose)
    return Camera(name, WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, matrix, time_ns)


def view(path: Path, image, cam: Camera, **kwargs) -> View:
    cv2.imwrite(str(path), np.asarray(image, np.uint8)[..., ::-1])
    return View(cam, path, 0, **kwargs)


def solid(colour) -> np.ndarray:
    return np.tile(np.uint8(colour), (HEIGHT, WIDTH, 1))


def wall(distance: float, half: float, spacing=0.2) -> Surfels:
    """Facing the camera, across the optical axis."""
    ticks = np.arange(-half, half + 1e-6, spacing)
    y, z = np.meshgrid(ticks, ticks)
    count = y.size
    centres = np.stack([np.full(count, distance), y.ravel(), z.ravel()], 1).astype(np.float32)
    axis = np.eye(3, dtype=np.float32)
    return Surfels(
        centres,
        np.tile(axis[0], (count, 1)),
        np.tile(axis[1], (count, 1)),
        np.full((count, 2), spacing, np.float32),
        np.zeros(count, bool),
        np.zeros((count, 0), np.int64),
    )


def gatherer() -> SkyGatherer:
    return SkyGatherer(32, math.radians(15))


def observed(
    *bodies: Body, views: list[View], sky: SkyGatherer | None = None
) -> list[SurfelColours]:
    seen, problems = observe_views(bodies, views, sky or gatherer(), image_scale=1.0)
    assert problems == ()
    return list(seen)


def assert_coloured(colours: np.ndarray, colour, atol: float = 0.02) -> None:
    expected = np.broadcast_to(np.divide(colour, 255), np.shape(colours))
    np.testing.assert_allclose(colours, expected, atol=atol)


def test_surfels_take_the_colour_of_their_pixels(tmp_path):
    image = solid(RED)
    image[:, WIDTH // 2 :] = GREEN  # the right half: negative y
    surfels = wall(5.0, 2.0)
    (seen,) = observed(Body(surfels), views=[view(tmp_path / "a.png", image, camera())])
    assert seen.is_observed.all()
    assert_coloured(seen.colours[surfels.centres[:, 1] > 0.5], RED)
    assert_coloured(seen.colours[surfels.centres[:, 1] < -0.5], GREEN)


def test_what_is_behind_a_surface_or_the_camera_or_aside_is_unseen(tmp_path):
    near, far, behind, aside = wall(4.0, 0.8), wall(8.0, 3.0), wall(-5.0, 1.0), wall(5.0, 1.0)
    aside = dataclasses.replace(aside, centres=aside.centres + np.float32([0, 30, 0]))
    views = [view(tmp_path / "a.png", solid(RED), camera())]
    front, back, *unseen = observed(*map(Body, (near, far, behind, aside)), views=views)
    assert front.is_observed.all() and not any(seen.is_observed.any() for seen in unseen)
    hidden = np.abs(far.centres[:, 1:]).max(axis=1) < 1.3  # 0.8 m at 4 m hides 1.6 m at 8 m
    free = np.abs(far.centres[:, 1:]).max(axis=1) > 2.0
    assert not back.is_observed[hidden].any() and back.is_observed[free].all()


def test_the_median_leaves_one_odd_image_out(tmp_path):
    views = [view(tmp_path / f"{i}.png", solid(RED), camera()) for i in range(4)]
    views.append(view(tmp_path / "odd.png", solid(GREEN), camera()))
    (seen,) = observed(Body(wall(5.0, 1.0)), views=views)
    assert_coloured(seen.colours, RED, atol=0.01)


def test_the_nearer_camera_counts_most(tmp_path):
    views = [
        view(tmp_path / "far.png", solid(GREEN), camera("far", at=(-15, 0, 0))),
        view(tmp_path / "near.png", solid(RED), camera("near")),
    ]
    (seen,) = observed(Body(wall(5.0, 0.4)), views=views)
    # Scores go with 1/z, weights with their square: 16 to 1.
    assert_coloured(seen.colours.mean(0), (16 * np.array(RED) + GREEN) / 17)


def moving_box() -> tuple:
    pose = np.eye(4)
    pose[:3, 3] = (4.0, 0, 0)
    later = pose.copy()
    later[1, 3] = 6.0
    size = np.array([0.4, 1.6, 1.6])
    samples = [
        BoxSample("c", None, "Car", i, i * 10**8, p, size) for i, p in enumerate((pose, later))
    ]
    return join_tracks(samples)


def test_a_moving_box_hides_the_world_even_where_lidar_saw_through_it(tmp_path):
    bodies = Body(wall(8.0, 0.8)), Body(wall(0.0, -1.0), *moving_box())
    views = [view(tmp_path / "a.png", solid(RED), camera(time_ns=0))]
    seen, _ = observed(*bodies, views=views)
    assert not seen.is_observed.any()
    views.append(view(tmp_path / "b.png", solid(GREEN), camera(time_ns=10**8)))
    seen, _ = observed(*bodies, views=views)
    assert seen.is_observed.all()
    assert_coloured(seen.colours.mean(0), GREEN, atol=0.01)


def test_actors_are_coloured_where_they_are_at_the_cameras_time(tmp_path):
    own = wall(-0.2, 0.6)  # its rear, in its own frame
    body = Body(own, *moving_box())
    image = solid(BLUE)
    image[:, WIDTH // 2 - 8 : WIDTH // 2 + 8] = RED
    (seen,) = observed(body, views=[view(tmp_path / "a.png", image, camera(time_ns=0))])
    assert_coloured(seen.colours[np.abs(own.centres[:, 1]) < 0.5].mean(0), RED)
    (seen,) = observed(body, views=[view(tmp_path / "b.png", image, camera(time_ns=10**9))])
    assert not seen.is_observed.any()


def test_an_actor_at_the_images_border_takes_the_colours_of_a_wall_that_stands_there(tmp_path):
    """Actors out of an image are not drawn into it; the world always is."""
    actor = wall(0.0, 1.0)
    world = dataclasses.replace(actor, centres=actor.centres + np.float32([4, 0, 0]))
    shares = []
    for degrees in (-70, -60, -50, -40, -30, 0, 30, 40, 50, 60, 70):
        angle = math.radians(degrees)
        sine = math.sin(angle)
        cosine = math.cos(angle)
        for turn in (
            [[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]],
            [[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]],
        ):
            views = [view(tmp_path / "a.png", solid(RED), camera(rotation=FORWARD @ turn))]
            (expected,) = observed(Body(world), views=views)
            (result,) = observed(Body(actor, *moving_box()), views=views)
            np.testing.assert_array_equal(result.is_observed, expected.is_observed)
            np.testing.assert_array_equal(result.colours, expected.colours)
            shares.append(expected.is_observed.mean())
    assert sum(0 < share < 1 for share in shares) >= 4 and min(shares) == 0 and max(shares) == 1


def test_the_sky_of_a_long_drive_is_taken_from_some_of_its_frames(tmp_path):
    for count, colour in ((23, (np.array(BLUE) + RED) / 2), (24, np.array(BLUE))):
        views = [
            dataclasses.replace(
                view(tmp_path / f"{n}.png", solid((BLUE, RED)[n % 2]), camera()), frame=n
            )
            for n in range(count)
        ]
        sky = gatherer()
        observed(Body(wall(-5.0, 1.0)), views=views, sky=sky)
        ahead = sky.finish().sample(torch.tensor([1.0, 0.0, 0.1])).numpy()
        # Of 23 images 12 are blue.
        assert_coloured(ahead, colour, atol=0.03)


def test_rows_that_show_the_recording_car_are_not_used(tmp_path):
    surfels = wall(5.0, 2.0)
    views = [view(tmp_path / "a.png", solid(RED), camera(), used_rows=0.5)]
    (seen,) = observed(Body(surfels), views=views)
    heights = surfels.centres[:, 2]
    assert not seen.is_observed[heights < -0.2].any() and seen.is_observed[heights > 0.2].all()


def test_images_that_cannot_be_used_are_problems(tmp_path):
    small = view(tmp_path / "small.png", solid(RED)[::2, ::2], camera())
    (tmp_path / "bad.png").write_bytes(b"no image")
    bad = View(camera(), tmp_path / "bad.png", 3)
    (seen,), problems = observe_views([Body(wall(5, 1))], [small, bad], gatherer(), image_scale=1.0)
    assert not seen.is_observed.any()
    assert "small.png is 32 px wide, not 64; left out" in problems[0]
    assert "frame 3: image" in problems[1] and "bad.png cannot be decoded" in problems[1]


def test_what_nothing_covers_is_sky(tmp_path):
    image = solid(BLUE)
    image[HEIGHT // 2 :] = GREEN
    floor = wall(6.0, 6.0, spacing=0.5)
    low = dataclasses.replace(floor, centres=floor.centres - np.float32([0, 0, 6.5]))
    sky = gatherer()
    observed(Body(low), views=[view(tmp_path / "a.png", image, camera())], sky=sky)
    faces = sky.finish()
    assert_coloured(faces.sample(torch.tensor([[1.0, 0.0, 0.3], [1.0, 0.5, 0.4]])), BLUE)
    # No image shows these: filled from the sky, not from the ground.
    unseen = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.2]])
    assert_coloured(faces.sample(unseen), BLUE, atol=0.05)


def test_above_a_wall_that_leaves_the_lidars_view_another_image_is_believed(tmp_path):
    tall = wall(4.0, 1.5)  # its top is 20 degrees up: above it may be more wall
    walled = view(tmp_path / "a.png", solid(RED), camera())
    clear = view(tmp_path / "b.png", solid(BLUE), camera(at=(6.0, 0, 0)))  # past the wall
    direction = torch.tensor([[1.0, 0.0, 0.55]])
    for views, colour in (([walled], RED), ([walled, clear], BLUE), ([walled] * 5 + [clear], BLUE)):
        sky = gatherer()
        observed(Body(tall), views=views, sky=sky)
        assert_coloured(sky.finish().sample(direction), colour, atol=0.08)
