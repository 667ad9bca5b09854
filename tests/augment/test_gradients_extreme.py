"""Gradients of what is trained, where scenes, cameras and pictures are extreme: finite everywhere,
and every step of every optimiser leaves numbers that can be rendered.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from augment.geometry import rigid
from augment.reconstruct import kernels as adam
from augment.reconstruct.config import LearningRates
from augment.reconstruct.splats import CORRECTIONS, Splats, splat_rates
from augment.reconstruct.trainer import Knots, part_forces, splat_inputs
from augment.render.buffers import ALPHA, EXPECTED_DEPTH, RGB
from augment.render.constants import RasterSettings
from augment.render.cpu import backward as cpu_backward
from augment.render.cpu.driver import Scratch
from augment.render.part_views import part_poses
from augment.render.rasterize import rasterize
from augment.render.threads import kernel_threads
from augment.scene import Gaussians, PosedGaussians
from tests.augment.hard_scenes import KINDS, SMOGS, drawing, hard_gaussians, wide_camera
from tests.scenes import in_float64

pytestmark = pytest.mark.long
FIELDS = ("means", "quats", "scales", "opacities", "sh")
kinds, seeds = st.sampled_from(KINDS), st.integers(0, 2**31)
fovs = st.sampled_from((1, 10, 60, 120, 170))
sizes = st.sampled_from(((33, 21), (1, 1), (17, 1), (16, 16)))


def learnt(gaussians: Gaussians) -> Gaussians:
    tensors = {n: getattr(gaussians, n).clone().requires_grad_() for n in FIELDS}
    return dataclasses.replace(gaussians, **tensors)


def gradients(gaussians: Gaussians, camera, *, backend: str, seed: int, **options) -> dict:
    """Of a loss in which every pixel of colour, alpha and depth has a weight of its own."""
    own = learnt(gaussians)
    output = rasterize(
        [PosedGaussians(own)],
        camera,
        buffers=(RGB, ALPHA, EXPECTED_DEPTH),
        backend=backend,
        **options,
    )
    generator = torch.Generator().manual_seed(seed % 2**31)
    loss = output.alpha.new_zeros(())
    for image in (output.rgb, output.alpha, output.expected_depth):
        assert torch.isfinite(image).all()
        loss = loss + (image * torch.rand(image.shape, generator=generator).to(image)).sum()
    loss.backward()
    return {name: getattr(own, name).grad for name in FIELDS}


def assert_finite(found: dict) -> None:
    for name, value in found.items():
        assert value is not None and bool(torch.isfinite(torch.as_tensor(value)).all()), name


@drawing(8)
@given(kinds, seeds, fovs, sizes, st.booleans())
def test_of_the_cpu_rasteriser(kind, seed, fov_deg, size, antialiased):
    camera = wide_camera(fov_deg, size)
    gaussians = hard_gaussians(kind, camera, 60, seed=seed)
    settings = RasterSettings(antialiased=antialiased)
    assert_finite(gradients(gaussians, camera, backend="cpu", seed=seed, settings=settings))


@pytest.mark.parametrize("smog", SMOGS)
@drawing(2)
@given(kinds, seeds, fovs, st.booleans(), st.booleans())
def test_of_the_definition(smog, kind, seed, fov_deg, antialiased, is_double):
    camera = wide_camera(fov_deg, (16, 9))
    gaussians = hard_gaussians(kind, camera, 30, seed=seed)
    if is_double:
        gaussians = in_float64(gaussians)
    settings = RasterSettings(antialiased=antialiased)
    found = gradients(
        gaussians, camera, backend="reference", seed=seed, settings=settings, fog=SMOGS[smog]
    )
    assert_finite(found)


# ---- reconstruction ------------------------------------------------------------------------------


@drawing(5)
@given(kinds, seeds, fovs, st.sampled_from((0.0, 1e-30, 1.0, 1e10)))
def test_splats_and_poses_after_a_step(kind, seed, fov_deg, steepness):
    """Adam keeps logarithms of scales and logits of opacities within what can be drawn."""
    camera = wide_camera(fov_deg)
    start = hard_gaussians(kind, camera, 60, seed=seed, sh_degree=3)
    pose = rigid(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    splats = Splats.of([start, start.select(torch.arange(20))], 3)
    poses = part_poses([None, pose])
    rates = LearningRates()
    inputs = splat_inputs(splats, [0, 1], poses, camera, RasterSettings())
    knots = Knots([np.array([0, 10])], 6)
    rng, scratch = np.random.default_rng(seed), Scratch()
    for step in range(2):
        tape = cpu_backward.record(inputs, camera, RasterSettings(), scratch, with_depth=True)
        images = [
            (steepness * rng.normal(size=image.shape)).astype(np.float32)
            for image in (tape.rgb, tape.alpha, tape.expected_depth)
        ]
        found = tape.backward(*images)
        forces = part_forces(inputs, found)
        on_camera = forces.on_camera(camera.camera_from_world.numpy() @ poses)
        knots.update(0, 5, on_camera, np.full(6, 0.1), 1e-3)
        with kernel_threads():
            adam.update_splats(
                inputs.addresses, inputs.sizes, inputs.views, inputs.blocks, inputs.first_ids,
                adam.GradientRows(found.rows.reshape(-1), found.ids, found.counts), 16,
                splat_rates(rates, step / 10, camera, 50.0), CORRECTIONS.reshape(-1),
                splats.adam_state(),
            )  # fmt: skip
    for name, array in splats.arrays().items():
        assert np.isfinite(array).all(), name
    assert np.isfinite(knots.values).all() and np.isfinite(on_camera).all()
    assert splats.scales.min() > 0
    assert splats.opacities.min() >= 0 and splats.opacities.max() <= 1
    np.testing.assert_allclose(np.linalg.norm(splats.quats, axis=1), 1, atol=1e-5)
