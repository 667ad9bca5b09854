"""What a view leaves out before it is projected: blocks of Gaussians, and what fog hides."""

from __future__ import annotations

import dataclasses
import gc
import math
import weakref

import numpy as np
import pytest
import torch

from augment.render.buffers import ALPHA, BUFFERS, RGB, RenderOutput
from augment.render.composite import composite_sky
from augment.render.constants import ALPHA_MIN, RasterSettings
from augment.render.cpu import order
from augment.render.cpu.driver import gather_inputs, rasterize_cpu
from augment.render.cpu.order import CELL_SIZE, spatial_order
from augment.render.fog import Fog
from augment.render.layout import HeightClip
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, PosedGaussians
from augment.scene.sky import ConstantSky, CubemapSky
from tests.augment.hard_scenes import KINDS, hard_gaussians, wide_camera
from tests.scenes import camera_ahead, random_gaussians, random_pose, sh_of

PLAIN = RasterSettings()
PICTURE = frozenset({RGB, ALPHA})
COUNT = 6000  # a dozen cells


@pytest.fixture(autouse=True)
def _small_scenes_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have few Gaussians taken by their boxes, which costs more than it saves."""
    monkeypatch.setattr(order, "_MIN_COUNT", 8 * CELL_SIZE)


def copy_of(gaussians: Gaussians) -> Gaussians:
    """Equal Gaussians that no view has drawn."""
    return dataclasses.replace(gaussians, means=gaussians.means.clone())


def drawn(gaussians: Gaussians) -> Gaussians:
    """As they are after a view, so that the next one takes them block by block."""
    spatial_order(gaussians)
    assert spatial_order(gaussians) is not None
    return gaussians


def draw(
    parts, camera: Camera, buffers=PICTURE, settings=PLAIN, fog=None, clip=None
) -> RenderOutput:
    if isinstance(parts, Gaussians):
        parts = [PosedGaussians(parts)]
    return rasterize_cpu(parts, camera, frozenset(buffers), settings, fog, clip)


def assert_same_bits(a: RenderOutput, b: RenderOutput, buffers=PICTURE):
    for name in buffers:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def places_read(gaussians: Gaussians, camera: Camera, settings=PLAIN, fog=None, clip=None) -> int:
    inputs = gather_inputs(
        [PosedGaussians(gaussians)], camera, settings, fog, clip, with_color=True, is_culled=True
    )
    return int((inputs.blocks[:, 2] - inputs.blocks[:, 1]).sum())


# ---- Blocks --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [*KINDS, "many at one depth"])
def test_blocks_change_no_bit(kind: str):
    camera = wide_camera(70, (61, 43), at=(0.3, -0.2, 0.1), turn=0.4)
    if kind == "many at one depth":  # ties are broken by number, whatever the order
        camera, scene = camera_ahead(61, 43), random_gaussians(COUNT, sh_degree=0)
        scene.means[:, 0] = (8 * scene.means[:, 0]).round() / 8 + 2
    else:
        scene = hard_gaussians(kind, camera, COUNT, sh_degree=1)
    away = wide_camera(70, (61, 43), at=(9.0, 7.0, 3.0), turn=-1.0)
    pose = random_pose(1)
    for view in (camera, away, dataclasses.replace(camera, is_orthographic=True)):
        for clip in (None, HeightClip(0.1, "above"), HeightClip(0.4, "below", max_distance_m=0.5)):
            fresh = [PosedGaussians(copy_of(scene)), PosedGaussians(copy_of(scene), pose)]
            known = [PosedGaussians(drawn(scene)), PosedGaussians(scene, pose)]
            expected = draw(fresh, view, BUFFERS, clip=clip)
            assert_same_bits(draw(known, view, BUFFERS, clip=clip), expected, BUFFERS)


def test_a_camera_reads_what_it_may_see_alone():
    scene = random_gaussians(40_000, sh_degree=0, size=0.02)
    ahead, back = camera_ahead(), camera_ahead(yaw=math.pi)
    assert places_read(scene, ahead) == len(scene)  # the first time
    read = places_read(scene, ahead), places_read(scene, back)
    assert read[1] < 0.2 * len(scene) < read[0] < len(scene)
    above = HeightClip(100.0, "above")
    assert places_read(scene, ahead, RasterSettings(), None, above) == 0
    buried = dataclasses.replace(scene, opacities=torch.zeros(len(scene)))
    assert places_read(buried, ahead) == 0


def test_those_too_faint_for_any_view_are_not_read_and_change_no_bit():
    scene = random_gaussians(COUNT, sh_degree=1)
    camera, shown = camera_ahead(61, 43), scene.opacities.clone()
    faint = torch.rand(COUNT, generator=torch.Generator().manual_seed(1)) < 0.6
    scene.opacities[faint] = 0.9 * ALPHA_MIN
    scene.opacities[5] = math.nan  # of which nothing is known
    expected = draw(copy_of(scene), camera, BUFFERS)
    places_read(drawn(scene), camera)
    known = spatial_order(scene)
    assert known is not None
    assert COUNT - len(known.ids) == int((scene.opacities < ALPHA_MIN).sum()) > COUNT / 2
    assert_same_bits(draw(scene, camera, BUFFERS), expected, BUFFERS)
    again = dataclasses.replace(scene, opacities=shown)  # the same means and scales beside others
    assert_same_bits(draw(again, camera), draw(copy_of(again), camera))
    whole = spatial_order(again)
    assert whole is not None and len(whole.ids) == COUNT
    scene.opacities[:] = shown
    assert_same_bits(draw(scene, camera, BUFFERS), draw(copy_of(scene), camera, BUFFERS), BUFFERS)


def test_rows_go_with_their_order():
    scene = random_gaussians(COUNT)
    own = spatial_order(drawn(scene))
    assert own is not None
    another = own.without_faint(scene.opacities.numpy() < 0.5, scene.means.numpy())
    rows = weakref.ref(another.sorted(scene.scales).rows)
    gc.disable()
    try:
        assert rows() is not None
        del another
        assert rows() is None
    finally:
        gc.enable()


def test_a_change_in_place_is_seen():
    scene, camera = random_gaussians(COUNT), camera_ahead()
    draw(drawn(scene), camera)
    for name in ("means", "scales", "opacities"):
        tensor = getattr(scene, name)
        tensor.mul_(0.7)
        assert_same_bits(draw(scene, camera), draw(copy_of(scene), camera))


def test_gaussians_with_numbers_that_are_none_hide_no_others():
    scene, camera = random_gaussians(COUNT), camera_ahead()
    scene.means[::7] = math.nan
    scene.means[3::7] = math.inf
    scene.scales[1::11], scene.opacities[2::13] = math.nan, math.nan
    assert_same_bits(draw(drawn(scene), camera), draw(copy_of(scene), camera))


# ---- Fog -----------------------------------------------------------------------------------------

CUT = RasterSettings(fog_cut=0.002)
LEVEL = 1 / 255


def street(count: int = COUNT) -> Gaussians:
    """Ground, facades and a tower as far as 4 km ahead and behind, colours in [0, 1]."""
    rng = np.random.default_rng(0)
    x = rng.choice([-1, 1], count) * np.exp(rng.uniform(0, math.log(4000), count))
    across, up = rng.uniform(-12, 12, count), np.zeros(count)
    wall = rng.random(count) < 0.6
    across[wall], up[wall] = np.sign(across[wall]) * 12, rng.uniform(0, 60, wall.sum())
    size = (0.02 * np.abs(x) + 0.2)[:, None] * np.exp(rng.uniform(-2, 0, (count, 3)))
    quats = rng.normal(size=(count, 4))
    fields = (
        np.stack([x, across, up], 1),
        quats / np.linalg.norm(quats, axis=1, keepdims=True),
        size,
        rng.uniform(0.2, 1, count),
    )
    tensors = [torch.from_numpy(f.astype(np.float32)) for f in fields]
    return Gaussians(*tensors, sh=sh_of(rng.choice([0.0, 1.0], (count, 3))))


@pytest.mark.parametrize("height_m", [None, 3.0, 15.0, 200.0])
@pytest.mark.parametrize("extinction_per_m", [1e-4, 0.02, 0.3, 100.0])
@pytest.mark.parametrize("at", [(0.0, 0.0, 1.5), (0.0, 0.0, 90.0), (10_000.0, 0.0, 1.5), "inside"])
def test_fog_hides_what_is_left_out(at, extinction_per_m: float, height_m: float | None):
    scene = drawn(street())
    if at == "inside":
        at = tuple(scene.means[int(scene.scales.amax(1).argmax())].tolist())
    fog = Fog(extinction_per_m, (0.9, 0.5, 0.1), height_m)
    faces = torch.from_numpy(np.random.default_rng(0).integers(0, 2, (6, 4, 4, 3))).float()
    sky = CubemapSky(faces)
    for yaw in (0.0, math.pi):
        camera = camera_ahead(61, 43, 40.0, position=at, yaw=yaw)
        for view in (camera, dataclasses.replace(camera, cy=60.0)):  # the second looks up
            seen = draw(scene, view, settings=CUT, fog=fog)
            whole = draw(scene, view, fog=fog)
            pictures = [composite_sky(r.rgb, r.alpha, view, sky, fog=fog) for r in (seen, whole)]
            assert float((pictures[0] - pictures[1]).abs().max()) <= LEVEL


def test_dense_fog_leaves_out_most_of_a_street_and_no_fog_nothing():
    scene = drawn(street(10 * COUNT))
    camera = camera_ahead(61, 43, position=(0.0, 0.0, 1.5))
    everything = places_read(scene, camera)
    assert places_read(scene, camera, CUT, Fog(0.08, (1.0, 1.0, 1.0))) < 0.7 * everything
    clear = Fog(0.0, (1.0, 1.0, 1.0))
    assert places_read(scene, camera, CUT, clear) == everything
    assert_same_bits(draw(scene, camera, settings=CUT, fog=clear), draw(scene, camera, fog=clear))
    assert_same_bits(draw(scene, camera, settings=CUT), draw(scene, camera))


def test_depth_and_classes_are_those_behind_any_fog():
    scene, camera = drawn(street()), camera_ahead(61, 43, position=(0.0, 0.0, 1.5))
    fog = Fog(0.3, (1.0, 1.0, 1.0))
    whole = draw(scene, camera, BUFFERS, fog=fog)
    assert_same_bits(draw(scene, camera, BUFFERS, CUT, fog), whole, BUFFERS)
    clip = HeightClip(2.0, "above")
    whole = draw(scene, camera, fog=fog, clip=clip)
    assert_same_bits(draw(scene, camera, PICTURE, CUT, fog, clip), whole)


def test_pixels_end_where_the_fog_hides_the_rest():
    """Hundreds of thin sheets behind each other, the nearest of which hide the others."""
    sheets = Gaussians(
        means=torch.stack([torch.linspace(2, 60, 400), torch.zeros(400), torch.zeros(400)], 1),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(400, 1),
        scales=torch.tensor([[0.01, 60.0, 60.0]]).repeat(400, 1),
        opacities=torch.full((400,), 0.02),
        sh=sh_of(np.random.default_rng(0).uniform(0, 1, (400, 3))),
    )
    camera, fog = camera_ahead(61, 43), Fog(0.1, (0.5, 0.5, 0.5))
    seen, whole = (draw(sheets, camera, settings=s, fog=fog) for s in (CUT, RasterSettings()))
    left = [float((1 - r.alpha).min()) for r in (seen, whole)]
    assert left[0] > 5 * left[1] > 0
    sky = ConstantSky(torch.ones(3))
    shown = [composite_sky(r.rgb, r.alpha, camera, sky, fog=fog) for r in (seen, whole)]
    assert float((shown[0] - shown[1]).abs().max()) <= LEVEL / 2


def test_a_cut_that_is_none_is_refused():
    for cut in (-0.1, 0.3, math.nan):
        with pytest.raises(ValueError, match=r"settings\.fog_cut must be >= 0 and at most 0.25"):
            settings = RasterSettings(fog_cut=cut)
            rasterize([PosedGaussians(random_gaussians(5))], camera_ahead(), settings=settings)
