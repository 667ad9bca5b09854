"""The buffer "overlay": how much of a pixel is covered by parts that are snow."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from augment.render.buffers import ALPHA, BUFFERS, OVERLAY, RGB
from augment.render.rasterize import rasterize
from augment.scene import Gaussians, PosedGaussians
from tests.assertions import assert_images_close
from tests.scenes import camera_ahead, one_gaussian, random_gaussians, slight_pose

BACKENDS = ("cpu", pytest.param("reference", marks=pytest.mark.long))
CAMERA = camera_ahead(97, 61, 80.0)


def crowd(*snowy: bool) -> list[PosedGaussians]:
    """Parts that stand among each other, not too near the eye."""
    scenes = [random_gaussians(900, seed=i, sh_degree=0) for i in range(len(snowy))]
    scenes = [s.select(s.means[:, 0] > 2) for s in scenes]
    pose = slight_pose()
    return [
        PosedGaussians(scene, pose if i else None, i, is_overlay=is_overlay)
        for i, (scene, is_overlay) in enumerate(zip(scenes, snowy, strict=True))
    ]


# Of what a picture of snow asks for: other sets of buffers would take kernels of their own, which
# are compiled for seconds.
def render(parts, backend="cpu", buffers=(RGB, ALPHA, OVERLAY), camera=CAMERA):
    return rasterize(parts, camera, buffers=buffers, backend=backend)


def test_kernels_match_the_definition():
    parts = crowd(False, True, False)
    names = ("means", "quats", "scales", "opacities", "sh")
    doubled = [
        dataclasses.replace(
            part, gaussians=Gaussians(**{n: getattr(part.gaussians, n).double() for n in names})
        )
        for part in parts
    ]
    actual, expected = render(parts), render(doubled, "reference")
    assert_images_close(actual.overlay, expected.overlay, p999=1e-5, max_flips=2)
    assert 0.2 < float(actual.overlay.mean()) < 0.8 * float(actual.alpha.mean())


@pytest.mark.parametrize("backend", BACKENDS)
def test_all_of_it_is_alpha_and_none_of_it_is_nothing(backend):
    image = render(crowd(True, True), backend)
    # One is a sum of weights, the other 1 - transmittance: forty roundings.
    torch.testing.assert_close(image.overlay, image.alpha, rtol=0, atol=1e-5)
    assert not render(crowd(False, False), backend).overlay.any()


@pytest.mark.parametrize("backend", BACKENDS)
def test_what_hides_snow_counts_against_it(backend):
    snow = PosedGaussians(one_gaussian((6.0, 0, 0), 30.0, 0.9), is_overlay=True)
    glass = PosedGaussians(one_gaussian((3.0, 0, 0), 30.0, 0.75))
    middle = render([glass, snow], backend).overlay[20:40, 40:60]
    torch.testing.assert_close(middle, torch.full_like(middle, 0.25 * 0.9), rtol=0, atol=1e-4)


def test_what_is_called_snow_changes_nothing_else():
    colder, warmer = (
        render(crowd(False, is_overlay), buffers=BUFFERS) for is_overlay in (True, False)
    )
    for name in set(BUFFERS) - {OVERLAY}:
        assert torch.equal(getattr(colder, name), getattr(warmer, name)), name
