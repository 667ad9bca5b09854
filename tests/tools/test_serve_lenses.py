"""Lenses of the sensor service: from a message to a camera and back, and refused numbers."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from augment.scene.cameras import Camera
from augment.scene.lenses import FisheyeLens, FThetaLens, OpenCVLens
from tests.lenses import F_THETA, F_THETA_CENTRE_PX
from tools.serve.errors import RequestRefused
from tools.serve.lens_specs import MAX_COEFFICIENTS, camera_spec, read_lens, read_out
from tools.serve.messages import enum_numbers, message_class

PINHOLE = Camera("front", 960, 740, 500.0, 510.0, 477.5, 371.25, torch.eye(4, dtype=torch.float64))
LENSES = [
    None,
    OpenCVLens(
        (-0.37, 0.2, -0.068, 0.01, 0.02, 0.003), (1.4e-3, 5.7e-4), (1e-3, 2e-4, 3e-3, -1e-4)
    ),
    FisheyeLens((0.01, -0.02, 0.003, -0.0004), 1.2),
    F_THETA,
    dataclasses.replace(F_THETA, reference="distance_to_angle"),
]


def with_lens(lens) -> Camera:
    focal = {} if not isinstance(lens, FThetaLens) else {"fx": lens.slope_px, "fy": lens.slope_px}
    return dataclasses.replace(PINHOLE, lens=lens, **focal)


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: type(lens).__name__)
def test_a_camera_survives_its_message(lens):
    camera = with_lens(lens)
    numbers = read_lens(camera_spec(camera))
    assert numbers.lens == lens
    assert numbers[:4] == camera.intrinsics


def test_an_f_theta_pixel_is_where_the_polynomial_puts_it():
    """By hand: the principal point, plus the linear part of (r(theta), 0)."""
    spec = camera_spec(with_lens(F_THETA))
    spec.ftheta_param.principal_point_x, spec.ftheta_param.principal_point_y = F_THETA_CENTRE_PX
    numbers = read_lens(spec)
    angle = 0.9
    distance = sum(k * angle**power for power, k in enumerate(F_THETA.angle_to_distance))
    direction = np.array([[np.sin(angle), 0.0, np.cos(angle)]])
    pixel, is_inside = numbers.lens.project(direction, with_lens(F_THETA).intrinsics)
    assert is_inside.all()
    c, _, e = F_THETA.linear
    offset = pixel[0] - (PINHOLE.cx, PINHOLE.cy)
    np.testing.assert_allclose(offset, [c * distance, e * distance], rtol=0, atol=1e-9)
    # Our first pixel's centre is (0.5, 0.5), theirs (0, 0).
    assert (numbers.cx - 0.5, numbers.cy - 0.5) == F_THETA_CENTRE_PX


def test_opencv_coefficients_keep_their_order():
    lens = LENSES[1]
    numbers = read_lens(camera_spec(with_lens(lens)))
    direction = np.array([[0.3, -0.2, 1.0]])
    k1, k2, k3, k4, k5, k6 = lens.radial
    coefficients = np.array([k1, k2, *lens.tangential, k3, k4, k5, k6, *lens.thin_prism])
    intrinsics = np.array([[numbers.fx, 0, numbers.cx], [0, numbers.fy, numbers.cy], [0, 0, 1.0]])
    expected, _ = cv2.projectPoints(direction, np.zeros(3), np.zeros(3), intrinsics, coefficients)
    pixel, _ = numbers.lens.project(direction, with_lens(lens).intrinsics)
    np.testing.assert_allclose(pixel[0], expected[0, 0], rtol=0, atol=1e-9)


def test_numbers_that_are_no_lens_are_refused_in_words():
    def ftheta(**changes):
        spec = camera_spec(with_lens(F_THETA))
        for name, value in changes.items():
            if isinstance(value, list):
                del getattr(spec.ftheta_param, name)[:]
                getattr(spec.ftheta_param, name).extend(value)
            else:
                setattr(spec.ftheta_param, name, value)
        return spec

    def pinhole(**changes):
        spec = camera_spec(PINHOLE)
        for name, values in changes.items():
            getattr(spec.opencv_pinhole_param, name).extend(values)
        return spec

    many = [0.0, 500.0] + [0.0] * MAX_COEFFICIENTS
    refused = {
        "reference_poly must be": ftheta(reference_poly=0),
        "at most 16 coefficients": ftheta(angle_to_pixeldist_poly=many),
        "2 or more coefficients": ftheta(angle_to_pixeldist_poly=[0.0]),
        "must begin with 0": ftheta(angle_to_pixeldist_poly=[5.0, 400.0]),
        "radial_coeffs must have at most 6": pinhole(radial_coeffs=[0.1]),
        "thin_prism_coeffs must have at most 4": pinhole(thin_prism_coeffs=[0.1]),
        "has no lens": message_class("CameraSpec")(resolution_w=9),
    }
    for words, spec in refused.items():
        with pytest.raises(RequestRefused, match=words):
            read_lens(spec)
    nan_spec = camera_spec(PINHOLE)
    nan_spec.opencv_pinhole_param.radial_coeffs[0] = float("nan")
    with pytest.raises(RequestRefused, match="finite"):
        read_lens(nan_spec)


def test_read_outs_are_those_of_the_shutter():
    spec = camera_spec(PINHOLE)
    assert read_out(spec) is None  # GLOBAL
    spec.shutter_type = enum_numbers("ShutterType")["ROLLING_RIGHT_TO_LEFT"]
    assert read_out(spec) == "right_to_left"
    spec.shutter_type = 77
    assert read_out(spec) is None


def test_threads_that_ask_first_get_the_same_classes():
    code = """
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
from tools.serve.messages import message_class
barrier = Barrier(8)
def ask(_):
    barrier.wait()
    return message_class("CameraSpec")
with ThreadPoolExecutor(8) as pool:
    assert len(set(pool.map(ask, range(8)))) == 1
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])
