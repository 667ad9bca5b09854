"""The GPU's bench where there is none: kernels interpreted on a tiny scene, and a fake clock."""

import dataclasses
import importlib.machinery
import sys
import types

import pytest
import torch

from augment.render.constants import RasterSettings
from augment.render.reference import blend_weights, order_by_depth, project_parts
from augment.scene import Ground, PosedGaussians
from tests.snow_scenes import drive, sheet, wall
from tests.tools.test_bench import TickingClock, check_figures
from tools.bench import gpu
from tools.bench.gpu import (
    LANES,
    Ceilings,
    GpuCase,
    Timing,
    count_blends,
    measure,
    measure_ceilings,
    write_table,
)
from tools.bench.harness import WallClock
from tools.bench.scenes import RasterCase, random_scene
from tools.cli import main

SMALL = RasterCase(40, 20, 17)
SPEEDS = Ceilings(bytes_per_s=1e6, blends_per_s=1e6)


def once(clock=None) -> Timing:
    return Timing(repeats=1, warm_up=0, clock=clock or TickingClock())


def test_ceilings_are_work_over_time():
    found = measure_ceilings(once(), copy_bytes=1 << 12, programs=2, steps=3)
    assert found == Ceilings(bytes_per_s=2 * 4096, blends_per_s=2 * LANES * 3)
    assert found.ms(8192.0) == pytest.approx(1000)
    assert found.ms(0.0, 2 * 2 * LANES * 3) == pytest.approx(2000)


def test_blends_are_those_of_the_definition():
    from augment.render.cuda.driver import list_tiles, project
    from augment.render.cuda.splats import gather_inputs

    gaussians, camera = random_scene(RasterCase(60, 20, 17))
    opaque, large = gaussians.opacities.clamp_min(0.9), 30 * gaussians.scales
    parts = [PosedGaussians(dataclasses.replace(gaussians, opacities=opaque, scales=large))]
    settings = RasterSettings(transmittance_stop=0.05)
    seen = project(gather_inputs(parts, camera, settings, None, None, with_color=False))
    tiles = list_tiles(seen, camera, None)
    counted = count_blends(seen, tiles, camera, settings)
    splats = order_by_depth(project_parts(parts, camera, settings))
    y, x = torch.meshgrid(torch.arange(17) + 0.5, torch.arange(20) + 0.5, indexing="ij")
    pixels = torch.stack([x.reshape(-1), y.reshape(-1)])
    weights, after = blend_weights(splats, pixels, torch.ones(340), settings)
    assert counted["done"] == int((weights > 0).sum()) > 2000
    assert bool((after[-1] <= 0.05).any())  # some pixels are finished before their lists end
    lengths = tiles.tile_offsets.diff()
    assert counted["listed"] == int((lengths * torch.tensor([256, 64, 16, 4])).sum())
    assert counted["done"] <= counted["reached"] <= counted["listed"]
    assert counted["entries"] <= int(lengths.sum()) and counted["used"] <= len(gaussians)


@pytest.mark.long
def test_the_floor_of_a_frame_whose_bytes_are_known_and_gsplat_beside_ours(monkeypatch):
    module = types.ModuleType("gsplat")
    module.__spec__ = importlib.machinery.ModuleSpec("gsplat", None)
    monkeypatch.setitem(sys.modules, "gsplat", module)
    gaussians, camera = random_scene(SMALL)
    ours = gpu.draw([PosedGaussians(gaussians)], camera)

    def rasterization(viewmats, Ks, width, height, sh_degree, near_plane, eps2d, **options):
        assert (width, height, sh_degree) == (20, 17, 3) and options["colors"].shape == (40, 16, 3)
        assert viewmats.shape == (1, 4, 4) and Ks[0].diag().tolist() == [camera.fx, camera.fy, 1]
        return ours.rgb[None], ours.alpha[None, ..., None], {}

    module.rasterization = rasterization
    found = gpu.measure_raster(SMALL, once(), SPEEDS)
    assert found["same_bits"] and found["stages_ms"].keys() == {"project", "list", "blend"}
    assert set(found["ms"]) == {"clean", "smog", "gsplat, packed", "gsplat, unpacked"}
    assert found["ms"]["clean"]["median"] == 1000 and found["smog_over_clean"]["median"] == 1
    assert found["gsplat"]["ratio"]["median"] == 1.0 and found["gsplat"]["rgb"]["max"] == 0
    floor, shown = found["floor"], found["floor"]["visible"]
    assert floor["splats"] == 40 and 0 < floor["used"] <= shown <= 40
    # Means, scales and opacity of all, key and count; of those in view quaternion, 16 functions of
    # SH, record and rectangle.
    moved = floor["bytes_of"]
    assert moved["project"] == 40 * (28 + 8) + shown * (16 + 192 + 64 + 8)
    assert moved["list"] == 40 * 8 + shown * 8 + 4 * floor["pairs"] + 4 * 5
    assert moved["blend"] == 4 * floor["entries"] + 64 * floor["used"] + 20 * 17 * 16
    assert floor["ms"]["blend"] == pytest.approx(max(moved["blend"], floor["done"]) / 1e3)
    module.rasterization = None
    assert "gsplat failed: TypeError" in gpu.gsplat_draws(gaussians, camera)


@pytest.mark.long
def test_sections_targets_and_the_page(monkeypatch, tmp_path, capfd):
    """Weathered frames and placement by the CPU backend; the style's section fails."""
    road, ground = sheet((2, 6), (-2, 2), rgb=(0.3, 0.35, 0.3)), Ground(0.0, 0.0, "stated")
    street = drive(road, wall(7.0, (-3, 3), (0, 2.5)), ground=ground, ground_z_m=0.0)
    camera = street.frames[0].cameras["ahead"].scaled(0.25)
    kinds = ("clean", "smog", "flood balanced", "snow fast tier")
    recipes = {name: gpu.frame_recipes(0.4)[name] for name in kinds}
    agreement = gpu.raster_agreement(SMALL)
    assert all(each["p999"] < 1e-4 and each["pixels"] == 20 * 17 for each in agreement.values())
    clean = gpu.measure_raster(SMALL, once(), SPEEDS)
    monkeypatch.setattr(gpu, "BACKEND", "cpu")
    monkeypatch.setattr(gpu, "PLACEMENTS", 1)
    placed = gpu.measure_placement(street, "test:street", cell_m=0.4)
    assert placed["cells"] > 0 and placed["cameras"] == 2
    same = gpu.frame_agreement(street, camera, {"snow fast tier": recipes["snow fast tier"]})
    assert [each["max"] for each in same.values()] == [0]
    found = {
        "ceilings": {**dataclasses.asdict(SPEEDS), "gpu": None},
        "raster": clean,
        "frames": gpu.measure_frames(street, camera, recipes, once(WallClock())),
        "passes": gpu.measure_passes(street, camera, {"clean": recipes["clean"]}),
        "launches": {"launches": {"clean": {"torch": 5, "triton": 9, "host_ms": 0.5}}},
        "placement": {"scenes": [{**placed, "named": True}]},
        "agreement": {"raster": {"clean": {**agreement["clean"], "p999": 2e-3}}, "frames": same},
    }
    monkeypatch.setattr(gpu, "run_section", lambda name, *_: found[name])
    path = tmp_path / "gpu.json"
    result = measure(GpuCase(), timing=once(), json_file=path, in_processes=False)
    tables, sections = check_figures(result), result["facts"]["sections"]
    assert path.is_file() and sections["style"] == {"failed": "KeyError: 'style'"}
    rows = {row[0]: row for row in tables["Figures to reach"]}
    assert rows["clean frame"][1] == 1000 and rows["clean frame"][5] == "MISSED"
    assert rows["smog in splats, over clean"][5] == "met"
    page = tmp_path / "performance.md"
    for text in (f"# Speed\n\n{gpu.START}\nof another day\n{gpu.END}\n\nEnd.\n", ""):
        page.write_text(text)
        write_table(page, result)
        written = page.read_text()
        assert "of another day" not in written and "| clean frame | 1,000 |" in written


def test_without_ceilings_nothing_else_is_measured_and_unknown_sections_are_refused(monkeypatch):
    monkeypatch.setattr(gpu, "run_section", lambda *_: {"left_out": "no time was left"})
    found = measure(GpuCase(), timing=once(), in_processes=False)["facts"]["sections"]
    assert "could not be measured" in found["raster"]["left_out"]
    with pytest.raises(ValueError, match=r"sections are ceilings, .*; got y"):
        measure(GpuCase(), sections=("y",), timing=once())


@pytest.mark.long
def test_views_are_no_launches_and_interpreted_kernels_hide_their_own_operations():
    with gpu.TorchOps() as ops:
        rows = torch.ones(6).reshape(2, 3)[1]  # one operation and two views of it
        assert float((rows * 2).sum()) == 6
    assert ops.count == 3
    gaussians, camera = random_scene(SMALL)
    parts = [PosedGaussians(gaussians)]
    gpu.draw(parts, camera)
    with gpu.interpreted_kernels() as kernels, gpu.TorchOps() as ops:
        gpu.draw(parts, camera)
    assert len(kernels) >= 3 and min(kernels) > 0  # projection, lists, blending
    assert 0 < ops.count < 100


@pytest.mark.long
def test_launches_of_a_frame_need_no_gpu():
    scene, camera = gpu.interpreted_street()
    recipes = gpu.frame_recipes(0.4)
    found = gpu.count_launches(scene, camera, {n: recipes[n] for n in ("clean", "smog")})
    clean, smog = found["launches"].values()
    assert clean["triton"] == smog["triton"] > 0  # fog costs the projection, and no launch
    assert clean["torch"] > 0 and clean["host_ms"] > 0


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_the_commands_say_so(capsys):
    for words in (["gpu"], ["raster", "--device", "cuda"], ["trade", "--device", "cuda"]):
        assert main(["bench", *words]) == 2
        assert "there is no GPU to measure here" in capsys.readouterr().err


@pytest.mark.gpu
def test_a_small_run_on_a_gpu(tmp_path):
    case = dataclasses.replace(
        gpu.QUICK, load={"copy_bytes": 1 << 24, "programs": 264, "steps": 256}
    )
    result = measure(case, timing=Timing(3, 1), json_file=tmp_path / "gpu.json")
    sections = result["facts"]["sections"]
    assert not [name for name in gpu.SECTIONS if "failed" in sections[name]]
    assert sections["raster"]["same_bits"] and sections["raster"]["peak_mib"] > 0
