"""Light per pixel: the dome of every splat, in the definition and in the kernel."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from augment.cameras import Camera
from augment.geometry import quat_from_rotmat, rotmat_from_quat
from augment.render.buffers import ALPHA, OVERLAY, RGB
from augment.render.fog import Fog
from augment.render.rasterize import rasterize
from augment.scene import Gaussians, PosedGaussians, SplatShading

C0 = 0.28209479177387814
SIZE = 48


def camera(**changes) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    numbers = {"fx": 60.0, "fy": 55.0, "cx": SIZE / 2, "cy": SIZE / 2}
    return Camera("test", SIZE, SIZE, camera_from_world=pose, **(numbers | changes))


def facing(normals: torch.Tensor) -> torch.Tensor:
    """Quaternions whose z axes are the normals."""
    helper = torch.where(normals[:, :1].abs() > 0.9, torch.tensor([[0.0, 1, 0]]),
                         torch.tensor([[1.0, 0, 0]]))  # fmt: skip
    x = torch.nn.functional.normalize(torch.linalg.cross(helper, normals), dim=1)
    return quat_from_rotmat(torch.stack([x, torch.linalg.cross(normals, x), normals], 2))


def disc(normal=(0.0, 0.0, -1.0), at=(0.0, 0.0, 5.0), opacity=0.99, radius=0.5) -> Gaussians:
    n = torch.nn.functional.normalize(torch.tensor([normal]), dim=1)
    return Gaussians(
        means=torch.tensor([at]),
        quats=facing(n),
        scales=torch.tensor([[radius, radius, 0.01]]),
        opacities=torch.tensor([opacity]),
        sh=torch.full((1, 1, 3), (0.2 - 0.5) / C0),
    )


def some_parts(seed=0, count=300, shaded=True) -> list[PosedGaussians]:
    """A lit part among others, one of them posed."""
    rng = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.rand(*shape, generator=rng)  # noqa: E731

    def cloud(n: int) -> Gaussians:
        normals = torch.nn.functional.normalize(draw(n, 3) - 0.5, dim=1)
        return Gaussians(
            means=(draw(n, 3) - 0.5) * torch.tensor([4.0, 4.0, 3.0]) + torch.tensor([0, 0, 5.0]),
            quats=facing(normals),
            scales=0.03 + 0.2 * draw(n, 3),
            opacities=0.1 + 0.89 * draw(n),
            sh=0.3 * (draw(n, 4, 3) - 0.5),
        )

    turn = torch.eye(4, dtype=torch.float64)
    angle = 0.4
    turn[:2, :2] = torch.tensor(
        [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    )
    sun = torch.nn.functional.normalize(torch.tensor([0.3, -0.8, -0.4]), dim=0)
    sun = tuple((sun / sun.norm()).double().tolist())
    parts = [PosedGaussians(cloud(count))]
    for pose, share in ((None, 0.4), (turn, 0.8)):
        light = SplatShading(draw(count, 3), sun, share)
        shading = light if shaded else None
        parts.append(PosedGaussians(cloud(count), pose, is_overlay=True, shading=shading))
    return parts


def shaded(gaussians: Gaussians, sun, wrap=0.0, slopes=(0.5, 0.5, 0.5)) -> PosedGaussians:
    sun = np.array(sun) / np.linalg.norm(sun)
    light = SplatShading(torch.tensor([slopes]), tuple(sun.tolist()), wrap)
    return PosedGaussians(gaussians, shading=light)


def render(parts, view, **options):
    """With the buffers that pictures of snow ask for, whose kernel there is."""
    return rasterize(parts, view, buffers=(RGB, ALPHA, OVERLAY), **options)


@pytest.mark.parametrize(
    ("smog", "orthographic"), [(None, False), (Fog(0.2, (0.7, 0.6, 0.5)), False), (None, True)]
)
def test_the_kernel_shows_what_the_definition_says(smog, orthographic):
    view = camera(is_orthographic=True, fx=12.0, fy=11.0) if orthographic else camera()
    fast, slow = (
        render(some_parts(), view, fog=smog, backend=name) for name in ("cpu", "reference")
    )
    difference = (fast.rgb - slow.rgb).abs()
    assert float(difference.quantile(0.999)) < 1e-4
    assert float(difference.max()) < 5e-3  # an alpha at its cut-off may fall on either side
    plain = render(some_parts(shaded=False), view, fog=smog)
    assert float((fast.rgb - plain.rgb).abs().max()) > 0.1
    assert torch.equal(fast.alpha, plain.alpha)


def test_a_pixel_is_lit_by_the_papers_normal():
    """D, d', n and the wrapped light written out for every pixel of one splat, in float64."""
    view, sun, wrap = camera(), np.array([0.5, -0.6, -0.62]), 0.3
    sun /= np.linalg.norm(sun)
    gaussians = disc(normal=(0.3, -0.7, -0.5), at=(0.4, -0.2, 4.0))
    image = rasterize([shaded(gaussians, sun, wrap)], view, backend="reference")
    plain = rasterize([PosedGaussians(gaussians)], view, backend="reference")
    added = (image.rgb - plain.rgb)[..., 0].numpy().astype(np.float64)
    weight = image.alpha.numpy().astype(np.float64)

    n2 = np.array([0.3, -0.7, -0.5]) / np.linalg.norm([0.3, -0.7, -0.5])
    n1 = np.array([0.0, 0.0, -1.0])
    x0, y0, z0 = 0.4, -0.2, 4.0
    mean = np.array([60 * x0 / z0 + 24, 55 * y0 / z0 + 24])
    axes = rotmat_from_quat(gaussians.quats)[0].numpy() * gaussians.scales.numpy()
    jacobian = np.array([[60 / z0, 0, -60 * x0 / z0**2], [0, 55 / z0, -55 * y0 / z0**2]])
    cov = jacobian @ axes @ axes.T @ jacobian.T + 0.3 * np.eye(2)
    cut = math.sqrt(2 * math.log(255 * 0.99))
    checked = 0
    for row in range(SIZE):
        for column in range(SIZE):
            if weight[row, column] < 0.01:
                continue
            p = np.array([column + 0.5, row + 0.5]) - mean
            big_d = math.sqrt(p @ np.linalg.solve(cov, p)) / cut
            d = np.array([p[0] * z0 / 60, p[1] * z0 / 55, 0.0])
            d = d - (d @ n2) / (n1 @ n2) * n1
            assert abs(d @ n2) < 1e-12
            n = big_d * d / np.linalg.norm(d) + math.sqrt(1 - min(big_d, 1) ** 2) * n2
            assert np.linalg.norm(n) == pytest.approx(1, abs=1e-6)
            share = min(max((n @ sun + wrap) / (1 + wrap), 0), 1)
            assert added[row, column] == pytest.approx(0.5 * share * weight[row, column], abs=2e-5)
            checked += 1
    assert checked > 100


def test_light_from_behind_adds_nothing_and_wrapping_lets_some_through():
    base = render([PosedGaussians(disc())], camera())
    dark = render([shaded(disc(), (0.0, 0.0, 1.0))], camera())
    assert torch.allclose(dark.rgb, base.rgb, atol=1e-6)
    wrapped = render([shaded(disc(), (1.0, 0.0, 0.3), wrap=0.6)], camera())
    assert float((wrapped.rgb - base.rgb).max()) > 0.05


def test_a_splat_seen_from_behind_is_lit_on_the_side_that_is_seen():
    front = render([shaded(disc((0.1, 0.2, -1.0)), (0.0, 0.0, -1.0))], camera())
    back = render([shaded(disc((-0.1, -0.2, 1.0)), (0.0, 0.0, -1.0))], camera())
    assert torch.allclose(front.rgb, back.rgb, atol=1e-5)


@pytest.mark.parametrize("normal", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, -1e-6)])
@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_splats_seen_edge_on_stay_finite(normal, backend):
    part = shaded(disc(normal), (0.6, -0.8, 0.0), wrap=0.2)
    image = render([part], camera(), backend=backend)
    assert torch.isfinite(image.rgb).all()
    assert float(image.rgb.max()) <= 0.2 + 0.5 + 1e-5


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"slopes": torch.zeros(2, 3)}, r"slopes must be floats \[1, 3\]"),
        ({"sun": (0.0, 0.0, 0.5)}, "of length 1"),
        ({"sun": (math.nan, 0.0, 1.0)}, "of length 1"),
        ({"wrap": -0.1}, "wrap must be finite"),
    ],
)
def test_light_that_cannot_be_is_refused(change, says):
    part = shaded(disc(), (0.0, 0.0, -1.0))
    part = dataclasses.replace(part, shading=dataclasses.replace(part.shading, **change))
    with pytest.raises(ValueError, match=says):
        rasterize([part], camera())
