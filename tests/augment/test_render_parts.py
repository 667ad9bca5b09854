"""What parts bring along: light per pixel, colour maps, and whether they count as snow."""

from __future__ import annotations

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
from tests.assertions import assert_images_close
from tests.scenes import camera_ahead, one_gaussian, random_gaussians, random_pose, slight_pose

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


CLASSES = 5
SMOG = Fog(0.2, (0.7, 0.75, 0.8), None, 0.0)


def some_maps(count: int, seed: int = 0, spread: float = 0.3) -> torch.Tensor:
    rng = torch.Generator().manual_seed(seed)
    return torch.eye(3, 4) + spread * (torch.rand(count, 3, 4, generator=rng) - 0.5)


def labelled(seed: int = 0, count: int = 300) -> Gaussians:
    rng = torch.Generator().manual_seed(seed)
    semantic = torch.randint(0, CLASSES, (count,), generator=rng, dtype=torch.int16)
    return dataclasses.replace(random_gaussians(count, seed=seed), semantic=semantic)


def folded(gaussians: Gaussians, maps: torch.Tensor) -> Gaussians:
    """The maps put into the spherical harmonics, one Gaussian at a time."""
    c0, sh = 0.28209479177387814, gaussians.sh.double().clone()
    for i in range(len(gaussians)):
        kind = 0 if gaussians.semantic is None else int(gaussians.semantic[i])
        matrix, offset = maps[kind, :, :3].double(), maps[kind, :, 3].double()
        mean = matrix @ (c0 * sh[i, 0] + 0.5) + offset
        sh[i] = sh[i] @ matrix.T
        sh[i, 0] = (mean - 0.5) / c0
    return dataclasses.replace(gaussians, sh=sh.float())


@pytest.mark.parametrize(("count", "smog"), [(1, SMOG), (CLASSES, None)])
def test_the_kernel_maps_as_the_definition_does(count, smog):
    parts = [
        PosedGaussians(labelled(1), color_maps=some_maps(count)),
        PosedGaussians(labelled(2), random_pose(), 1, color_maps=some_maps(count, 3)),
        PosedGaussians(random_gaussians(100, seed=4), color_maps=some_maps(count, 5)),
        PosedGaussians(random_gaussians(100, seed=6, sh_degree=1)),
    ]
    fast, slow = (
        rasterize(parts, camera_ahead(), fog=smog, backend=name) for name in ("cpu", "reference")
    )
    assert_images_close(fast.rgb, slow.rgb, max_flips=2)
    assert_images_close(fast.alpha, slow.alpha, max_flips=2)
    bare = rasterize([dataclasses.replace(p, color_maps=None) for p in parts], camera_ahead())
    assert (fast.rgb - bare.rgb).abs().max() > 0.02
    assert torch.equal(fast.alpha, bare.alpha)


@pytest.mark.parametrize("count", [1, CLASSES])
def test_where_nothing_is_clamped_a_map_is_one_on_the_coefficients(count):
    gaussians = labelled(7)
    dim = dataclasses.replace(gaussians, sh=gaussians.sh * 0.1)  # every colour near 0.5
    maps = some_maps(count, 8)
    once = dim if count > 1 else dataclasses.replace(dim, semantic=None)
    seen = rasterize([PosedGaussians(dim, color_maps=maps)], camera_ahead()).rgb
    assert_images_close(seen, rasterize([PosedGaussians(folded(once, maps))], camera_ahead()).rgb)


def test_the_identity_changes_no_bit():
    gaussians = labelled(9)
    bare = rasterize([PosedGaussians(gaussians)], camera_ahead()).rgb
    same = torch.eye(3, 4).repeat(CLASSES, 1, 1)
    for maps in (same[:1], same):
        assert torch.equal(
            rasterize([PosedGaussians(gaussians, color_maps=maps)], camera_ahead()).rgb, bare
        )


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_rows_come_before_classes(backend):
    gaussians = labelled(10)
    rows = torch.arange(len(gaussians), dtype=torch.int16) % CLASSES
    maps = some_maps(CLASSES, 11)
    chosen = PosedGaussians(gaussians, color_maps=maps, color_rows=rows)
    instead = PosedGaussians(dataclasses.replace(gaussians, semantic=rows), color_maps=maps)
    images = [rasterize([p], camera_ahead(), backend=backend).rgb for p in (chosen, instead)]
    assert torch.equal(*images)
    with pytest.raises(ValueError, match=r"color_rows must be int16 \[300\]"):
        rasterize([dataclasses.replace(chosen, color_rows=rows[1:])], camera_ahead())


@pytest.mark.parametrize(
    ("maps", "words"),
    [
        (torch.zeros(0, 3, 4), r"\[C, 3, 4\] with C >= 1; got \[0, 3, 4\]"),
        (torch.full((1, 3, 4), torch.nan), "finite"),
        (torch.zeros(1, 3, 4, dtype=torch.int32), "finite floats"),
    ],
)
def test_maps_that_are_none_are_refused(maps, words):
    part = PosedGaussians(random_gaussians(3))
    object.__setattr__(part, "color_maps", maps)  # past what the tests' type checks refuse
    with pytest.raises(ValueError, match=words):
        rasterize([part], camera_ahead())


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
def render_overlay(parts, backend="cpu", buffers=(RGB, ALPHA, OVERLAY), camera=CAMERA):
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
    actual, expected = render_overlay(parts), render_overlay(doubled, "reference")
    assert_images_close(actual.overlay, expected.overlay, p999=1e-5, max_flips=2)
    assert 0.2 < float(actual.overlay.mean()) < 0.8 * float(actual.alpha.mean())


@pytest.mark.parametrize("backend", BACKENDS)
def test_all_of_it_is_alpha_and_none_of_it_is_nothing(backend):
    image = render_overlay(crowd(True, True), backend)
    # One is a sum of weights, the other 1 - transmittance: forty roundings.
    torch.testing.assert_close(image.overlay, image.alpha, rtol=0, atol=1e-5)
    assert not render_overlay(crowd(False, False), backend).overlay.any()


@pytest.mark.parametrize("backend", BACKENDS)
def test_what_hides_snow_counts_against_it(backend):
    snow = PosedGaussians(one_gaussian((6.0, 0, 0), 30.0, 0.9), is_overlay=True)
    glass = PosedGaussians(one_gaussian((3.0, 0, 0), 30.0, 0.75))
    middle = render_overlay([glass, snow], backend).overlay[20:40, 40:60]
    torch.testing.assert_close(middle, torch.full_like(middle, 0.25 * 0.9), rtol=0, atol=1e-4)
