import dataclasses
import math

import pytest
import torch

from augment.cameras import Camera
from augment.geometry import rigid, rotmat_from_quat
from tests.scenes import camera_ahead


def camera(**changes) -> Camera:
    rotation = rotmat_from_quat(torch.tensor([0.9, 0.1, -0.3, 0.2], dtype=torch.float64))
    base = Camera(
        name="front",
        width=97,
        height=61,
        fx=80.0,
        fy=83.0,
        cx=47.3,
        cy=31.9,
        camera_from_world=rigid(rotation, torch.tensor([0.4, -1.0, 2.0]).double()),
    )
    return dataclasses.replace(base, **changes)


def test_ray_through_a_pixel_projects_back_to_its_centre():
    cam = camera()
    points = cam.centre + 7.5 * cam.ray_directions(torch.float64)  # depth 7.5 at every pixel
    in_camera = points @ cam.camera_from_world[:3, :3].T + cam.camera_from_world[:3, 3]
    assert torch.allclose(in_camera[..., 2], torch.full((61, 97), 7.5, dtype=torch.float64))
    pixels = in_camera @ cam.K.T / 7.5
    assert pixels[0, 0, :2].tolist() == pytest.approx([0.5, 0.5])
    assert pixels[60, 96, :2].tolist() == pytest.approx([96.5, 60.5])


def test_ray_lengths_are_the_norms_of_the_directions():
    cam = camera()
    norms = cam.ray_directions(torch.float64).norm(dim=-1)
    assert torch.allclose(cam.ray_lengths(torch.float64), norms)


def test_scaling_keeps_the_field_of_view():
    cam = camera(width=1920, height=1080, fx=1970.0, fy=1970.0, cx=970.0, cy=483.3)
    half = cam.scaled(0.5)
    assert (half.width, half.height) == (960, 540)
    assert half.fx == 985.0 and half.cx == 485.0
    assert cam.scaled(1.0) is cam
    odd = cam.scaled(0.3333)  # sides round, and the intrinsics follow each side's true ratio
    assert odd.fx / odd.width == pytest.approx(cam.fx / cam.width)
    assert odd.cy / odd.height == pytest.approx(cam.cy / cam.height)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 0}, "width and height must be >= 1 px; got 0x61"),
        ({"fx": -80.0}, "fx must be finite and > 0"),
        ({"fy": math.nan}, "fy must be finite"),
        ({"cx": math.inf}, "cx must be finite"),
        ({"camera_from_world": 2 * torch.eye(4, dtype=torch.float64)}, "rigid"),
        ({"camera_from_world": torch.diag(torch.tensor([1.0, 1, -1, 1]).double())}, "rigid"),
        ({"camera_from_world": torch.full((4, 4), math.nan).double()}, "rigid"),
    ],
)
def test_impossible_cameras_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        camera(**changes)


def test_a_resized_view_spans_the_same_angles():
    camera = camera_ahead(33, 21)
    square = camera.resized(12, 12)
    assert (square.width, square.height) == (12, 12)
    for before, after in (
        (camera.cx / camera.fx, square.cx / square.fx),
        ((camera.width - camera.cx) / camera.fx, (12 - square.cx) / square.fx),
        (camera.cy / camera.fy, square.cy / square.fy),
        ((camera.height - camera.cy) / camera.fy, (12 - square.cy) / square.fy),
    ):
        assert after == pytest.approx(before, rel=1e-12)
