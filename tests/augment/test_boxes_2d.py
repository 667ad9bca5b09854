"""Which pixels show a labelled box, what hides it, and what detectors are given of it."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from augment.dataset import SceneDataset, WeatherDataset, box_masks, boxes_2d, torchvision_sample
from augment.dataset.samples import box_tensors, buffers
from augment.errors import AdapterError
from augment.jobs.render_job import JobResult, RenderJob, run_job
from augment.output.box_tables import BoxNumbers, BoxWeather
from augment.output.box_weather import box_tables
from augment.output.manifest import read_manifest
from augment.output.tables import read_boxes
from augment.scene.boxes import MAX_INSTANCE, Instances, instances_of
from augment.scene.cameras import Camera
from augment.scene.geometry import multiply_quats, quat_from_rotmat, rigid, rotmat_from_quat
from augment.scene.labels import Boxes
from augment.scene.scene import Gaussians, Scene
from augment.scene.semantics import SemanticClass
from augment.view.box_labels import label_view, measure_boxes
from augment.view.render_view import render_view
from recipes.schema import Output, Recipe, Render, Weather
from recipes.snow import Snow
from tests.snow_scenes import box_car, drive, stack_all

PARKED = np.array([14.0, 0.0, 0.75])
SIZE = np.array([4.0, 1.8, 1.5])
STEP_M = 0.06  # between splats
ORIGIN = np.array([1000.0, -2000.0, 50.0])
RECIPE = Recipe(name="clear", output=Output(semantic=True, instance=True))
FOLDER = Path("sheets") / "clear-000"


@dataclasses.dataclass(frozen=True)
class StreetLabels:
    """Of a car that drives and cars that stand; frame 1 shows one more. unreadable: a frame."""

    unreadable: int | None = None

    def boxes(self, frame_index: int) -> Boxes:
        if frame_index == self.unreadable:
            raise AdapterError("cuboids are cut short")
        places = {
            "later": [14.0, 5.0, 0.75],
            "parked": PARKED,
            "car": [6.0 + 5.0 * frame_index, 3.0, 0.75],
            "behind": [-9.0, 0.0, 0.75],
        }
        if frame_index == 0:
            del places["later"]
        count = len(places)
        return Boxes(
            tuple(places), ("Car",) * count, np.array(list(places.values())) + ORIGIN,
            np.tile(SIZE, (count, 1)), np.array([[1.0, 0, 0, 0]] * count),
        )  # fmt: skip

    def lidar(self, frame_index: int) -> None:
        return None


def plate(low, high, semantic: SemanticClass) -> Gaussians:
    """An opaque rectangle between two corners, flat along one axis."""
    spans = [
        np.arange(a + STEP_M / 2, max(b, a + STEP_M), STEP_M)
        for a, b in zip(low, high, strict=True)
    ]
    flat = [a == b for a, b in zip(low, high, strict=True)]
    spans = [
        np.array([a]) if is_flat else span
        for a, is_flat, span in zip(low, flat, spans, strict=True)
    ]
    means = np.stack([grid.ravel() for grid in np.meshgrid(*spans)], axis=1)
    count = len(means)
    scales = torch.tensor([0.004 if is_flat else 0.6 * STEP_M for is_flat in flat])
    return Gaussians(
        means=torch.from_numpy(means).float(),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        scales=scales.repeat(count, 1),
        opacities=torch.full((count,), 0.99),
        sh=torch.zeros(count, 1, 3),
        semantic=torch.full((count,), int(semantic), dtype=torch.int16),
    )


def car_at(centre: np.ndarray) -> Gaussians:
    """The sides of a parked car that cameras see."""
    low, high = centre - SIZE / 2, centre + SIZE / 2
    return stack_all([
        plate(low, [low[0], high[1], high[2]], SemanticClass.VEHICLE),
        plate([low[0], low[1], high[2]], high, SemanticClass.VEHICLE),
        plate(low, [high[0], low[1], high[2]], SemanticClass.VEHICLE),
        plate([low[0], high[1], low[2]], high, SemanticClass.VEHICLE),
    ])  # fmt: skip


def street(
    labels: StreetLabels | None = StreetLabels(), *, hidden_to_y: float = 0.0, eye_z_m: float = 1.5
) -> Scene:
    """A road, two parked cars, a wall before them up to y = hidden_to_y, and a car that drives."""
    parts = [
        plate([2.0, -6.0, 0.0], [24.0, 8.0, 0.0], SemanticClass.ROAD),
        car_at(PARKED),
        car_at(np.array([14.0, 5.0, 0.75])),
    ]
    if hidden_to_y > -4.0:
        parts += [plate([7.0, -4.0, 0.0], [7.0, hidden_to_y, 3.0], SemanticClass.BUILDING)]
    scene = drive(
        *parts, actors=[box_car(with_shadow=False)], labels=labels, world_origin_m=ORIGIN,
        ground_z_m=0.0, places=((0.0, 0.0, eye_z_m), (1.0, 0.0, eye_z_m)),
    )  # fmt: skip
    frames = [
        dataclasses.replace(f, cameras={"ahead": f.cameras["ahead"].scaled(3.0)})
        for f in scene.frames
    ]
    return dataclasses.replace(scene, frames=tuple(frames))


def open_street(uri: str) -> Scene:
    return street()


def run(out: Path, opened=open_street, **options) -> JobResult:
    job = RenderJob("test:sheets", [RECIPE], out, backend="cpu", **options)
    return run_job(job, scene_loader=opened, progress=False)


def measure(scene: Scene, camera: Camera, recipe: Recipe = RECIPE) -> tuple[BoxNumbers, np.ndarray]:
    """What is measured of frame 0's boxes, and the instance image as it is written."""
    boxes, view = scene.boxes(0), render_view(scene, camera, recipe, backend="cpu")
    instances = instances_of(scene)
    numbers = measure_boxes(boxes, instances, ORIGIN, camera, view)["box_2d"]
    return numbers, label_view(boxes, instances, ORIGIN, camera, view, recipe)[0].instance


def seen_by_rays(camera: Camera, hidden_to_y: float) -> tuple[np.ndarray, np.ndarray]:
    """bool [H, W]: pixels whose rays meet the parked car, and those that the wall leaves of them,
    by the planes of both.
    """
    eye = camera.centre.numpy()
    rays = camera.ray_directions(torch.float64).numpy()
    a, b = ((PARKED + side * SIZE / 2 - eye) / rays for side in (-1, 1))
    enter, leave = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
    on_wall = eye + (7.0 - eye[0]) / rays[..., :1] * rays
    covered = (on_wall[..., 1] < hidden_to_y) & (on_wall[..., 2] < 3.0)
    return enter < leave, (enter < leave) & ~covered


@pytest.mark.parametrize(
    ("hidden_to_y", "instance"), [(-4.0, True), (-0.2, False), (0.2, True), (4.0, False)]
)
def test_fractions_and_bounds_are_those_of_rays(hidden_to_y: float, instance: bool) -> None:
    scene = street(hidden_to_y=hidden_to_y)
    camera = scene.frames[0].cameras["ahead"]
    recipe = Recipe(output=Output(instance=instance, depth="median"))
    boxes, view = scene.boxes(0), render_view(scene, camera, recipe, backend="cpu")
    numbers = measure_boxes(boxes, instances_of(scene), ORIGIN, camera, view)["box_2d"]
    num_whole, num_left = seen_by_rays(camera, hidden_to_y)
    # Splats blur edges by a pixel, and the box's lowest 8 cm own no surface.
    assert numbers["visible_fraction"][0] == pytest.approx(
        num_left.sum() / num_whole.sum(), abs=0.04
    )
    assert numbers["pixels"][0] == pytest.approx(num_left.sum(), abs=0.1 * num_whole.sum())
    assert numbers["truncated_fraction"].tolist()[0::2] == [0, 1]
    if not num_left.any():
        assert np.isnan(numbers["modal_xyxy"][0]).all()
        return
    rows, columns = np.nonzero(num_left)
    bounds = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    np.testing.assert_allclose(numbers["modal_xyxy"][0], bounds, atol=2)
    rows, columns = np.nonzero(num_whole)
    bounds = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    amodal = [numbers[side][0] for side in ("x0", "y0", "x1", "y1")]
    np.testing.assert_allclose(amodal, bounds, atol=1)


def test_a_box_across_the_border_is_truncated_by_its_share_of_the_outline() -> None:
    scene = street()
    full_camera = scene.frames[0].cameras["ahead"]
    x0, x1 = (measure(scene, full_camera)[0][side][0] for side in ("x0", "x1"))
    middle = round((x0 + x1) / 2)
    cut = full_camera.cropped(
        middle, 0, 480 - middle, 270
    )  # symmetric: the car stands straight ahead
    numbers, _ = measure(scene, cut)
    assert numbers["truncated_fraction"][0] == pytest.approx(0.5, abs=0.03)
    assert numbers["x0"][0] == 0 and numbers["x1"][0] == pytest.approx(x1 - middle)
    assert np.isnan(numbers["visible_fraction"][2])  # behind the camera: not known


def test_parked_cars_have_an_instance_and_the_road_in_their_box_has_none() -> None:
    scene = street()
    camera = scene.frames[0].cameras["ahead"]
    plain = render_view(scene, camera, RECIPE, backend="cpu")
    numbers, image = measure(scene, camera)
    assert numbers["instance"].tolist() == [2, 1, 3]  # the driving car is the only actor
    _, left = seen_by_rays(camera, 0.0)
    # 5 % are the lowest 8 cm, and edges are blurred by a pixel: those of the wall are the wall's.
    assert (image == 2)[left].mean() > 0.83 and (image == 2)[~left].mean() < 0.01
    np.testing.assert_array_equal(image == 1, plain.instance == 1)  # as it was rendered
    assert not image[np.isin(plain.semantic, [SemanticClass.ROAD, SemanticClass.SKY])].any()
    # Nothing that one image shows depends on what else is written.
    other = Recipe(output=Output(semantic=False, instance=True, depth="none", labels=False))
    instance_only = render_view(scene, camera, other, backend="cpu")
    assert instance_only.semantic is None and instance_only.depth_m is None


def test_where_boxes_overlap_the_one_that_encloses_the_surface_has_it_then_the_smaller() -> None:
    class Overlapping(StreetLabels):
        def boxes(self, frame_index: int) -> Boxes:
            beside, up = np.array([[0.0, SIZE[1] - 0.02, 0.0], [0.0, 0.0, SIZE[2]]])
            centers = np.array([PARKED, PARKED + beside, PARKED + up])
            sizes = np.array([SIZE, SIZE, SIZE * [1, 1, 3]])
            quats = np.array([[1.0, 0, 0, 0]] * 3)
            return Boxes(("own", "beside", "around"), ("Car",) * 3, centers + ORIGIN, sizes, quats)

    scene = street(Overlapping(), hidden_to_y=-4.0)
    camera = scene.frames[0].cameras["ahead"]
    _, image = measure(scene, camera)
    _, left = seen_by_rays(camera, -4.0)
    assert (image == 2)[left].mean() > 0.85
    assert not (image == 4)[left].any() and not (image == 3)[left].mean() > 0.02


@pytest.mark.long
@pytest.mark.parametrize("surface", ["solid", pytest.param("scene", marks=pytest.mark.long)])
def test_snow_on_a_parked_car_is_the_car(surface: str) -> None:
    """Of 0.3 m, which raises the surface out of the box; seen from above. `scene` looks through."""
    scene = street(hidden_to_y=-4.0, eye_z_m=4.0)
    camera = scene.frames[0].cameras["ahead"]
    clear, bare = measure(scene, camera)
    output = Output(semantic=True, instance=True, surface=surface)
    snowy = Recipe(weather=Weather(snow=Snow(depth_m=0.3)), output=output)
    numbers, image = measure(scene, camera, snowy)
    assert numbers["visible_fraction"][0] == pytest.approx(clear["visible_fraction"][0], abs=0.05)
    covered = render_view(scene, camera, snowy, backend="cpu").masks["snow"] == 255
    eye, rays = camera.centre.numpy(), camera.ray_directions(torch.float64).numpy()
    on_top = np.abs(eye + (1.5 - eye[2]) / rays[..., 2:] * rays - PARKED) < SIZE / 2 - 0.3
    on_roof = on_top[..., 0] & on_top[..., 1] & (rays[..., 2] < 0)
    assert on_roof.sum() > 100 and covered[on_roof].mean() > 0.9
    assert (image == 2)[on_roof].mean() > 0.95
    if surface == "scene":
        np.testing.assert_array_equal(image, bare)


@pytest.fixture(scope="module")
def job_output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("street") / "out"
    assert run(out).failed == 0
    return out


def test_files_agree_over_frames_and_with_a_live_scene(job_output: Path) -> None:
    boxes = read_boxes(job_output / FOLDER / "labels" / "boxes.parquet")
    measured = box_tables()["box_2d"].read(job_output / FOLDER / "labels" / "boxes_2d.parquet")
    ids = {
        t: int(n)
        for f in boxes.values()
        for t, n in zip(f.boxes.track_ids, f.instances, strict=True)
    }
    # The actor, then tracks as frame 0 lists them, then what frame 1 adds.
    assert ids == {"car": 1, "parked": 2, "behind": 3, "later": 4}
    live = SceneDataset(street(), RECIPE, backend="cpu")
    for row in read_manifest(job_output).to_pylist():
        frame = row["frame"]
        assert row["box_2d_path"] == str(FOLDER / "labels/boxes_2d.parquet")
        image = cv2.imread(str(job_output / row["instance_path"]), cv2.IMREAD_UNCHANGED)
        shown_ids = {ids[t] for t in ("parked", "car", *(["later"] if frame else []))}
        assert set(np.unique(image).tolist()) == {0, *shown_ids}
        assert boxes[frame].instances.tolist() == [ids[t] for t in boxes[frame].boxes.track_ids]
        np.testing.assert_array_equal(measured[frame, "ahead"]["instance"], boxes[frame].instances)
    stored = WeatherDataset(job_output)
    for sample, other in zip(stored, live, strict=True):
        assert torch.equal(sample["instance"], other["instance"])
        for key in ("instance", "modal_xyxy", "visible_fraction", "truncated_fraction"):
            np.testing.assert_array_equal(sample["boxes"][key], other["boxes"][key])
        numbers = measured[sample["frame"], "ahead"]
        amodal = np.stack([numbers["x0"], numbers["y0"], numbers["x1"], numbers["y1"]], axis=1)
        np.testing.assert_allclose(boxes_2d(sample).xyxy, amodal, atol=1e-4)


def files_of(out: Path) -> dict[str, bytes]:
    return {str(p.relative_to(out)): p.read_bytes() for p in out.rglob("*") if p.is_file()}


def test_parts_in_any_order_and_workers_give_the_files_of_one_run(
    job_output: Path, tmp_path
) -> None:
    run(tmp_path / "parts", frames=[1])
    assert run(tmp_path / "parts").skipped == 1
    assert files_of(tmp_path / "parts") == files_of(job_output)
    (tmp_path / "parts" / FOLDER / "labels" / "boxes_2d.parquet").unlink()
    assert run(tmp_path / "parts").written == 2  # only rendering tells
    assert files_of(tmp_path / "parts") == files_of(job_output)


def test_a_frame_that_could_not_be_read_renumbers_what_was_rendered_without_it(
    job_output: Path, tmp_path: Path
) -> None:
    """Frame 0 first shows a track: frame 1 has been numbered without it."""
    result = run(tmp_path, opened=lambda uri: street(StreetLabels(unreadable=0)))
    assert (result.written, result.failed) == (1, 1)
    assert run(tmp_path).written == 2
    assert files_of(tmp_path) == files_of(job_output)
    assert run(tmp_path).skipped == 2


def test_objects_beyond_sixteen_bits_have_no_instance(caplog) -> None:
    class Many(StreetLabels):
        def boxes(self, frame_index: int) -> Boxes:
            names = tuple(f"{frame_index}-{k}" for k in range(MAX_INSTANCE))
            zeros = np.zeros((MAX_INSTANCE, 3))
            return Boxes(names, names, zeros, zeros, np.zeros((MAX_INSTANCE, 4)))

    many = Instances(("car",), (0, 1), Many())
    track_ids = ("car", "0-0", f"0-{MAX_INSTANCE - 2}", f"0-{MAX_INSTANCE - 1}", "1-0", "no")
    assert many.numbers_of(track_ids).tolist() == [1, 2, MAX_INSTANCE, 0, 0, 0]
    assert "instance images number 65535 of them" in caplog.text


def test_targets_of_what_is_seen(job_output: Path) -> None:
    sample = WeatherDataset(job_output, frames=[0])[0]
    _, amodal = torchvision_sample(sample)
    assert amodal["track_ids"] == ["parked", "car"]
    assert 0.3 < amodal["visible_fraction"][0] < 0.7 < 0.95 < amodal["visible_fraction"][1]
    _, modal = torchvision_sample(sample, bounds="modal")
    assert torch.equal(modal["boxes"], sample["boxes"]["modal_xyxy"][:2])
    widths = [float(t["boxes"][0, 2] - t["boxes"][0, 0]) for t in (amodal, modal)]
    assert 0.3 < widths[1] / widths[0] < 0.7  # the wall hides half of the parked car
    _, visible_target = torchvision_sample(sample, min_visible_fraction=0.8)
    assert visible_target["track_ids"] == ["car"]
    flooded_street = street(hidden_to_y=2.0)
    _, none = torchvision_sample(
        SceneDataset(flooded_street, RECIPE, backend="cpu")[0], bounds="modal"
    )
    assert none["track_ids"] == ["car"]

    old = {key: None for key in ("modal_xyxy", "visible_fraction", "truncated_fraction")}
    older = {**sample, "boxes": {**sample["boxes"], **old}}
    assert "visible_fraction" not in torchvision_sample(older)[1]
    for options in ({"bounds": "modal"}, {"min_visible_fraction": 0.1}):
        with pytest.raises(
            ValueError, match=r"need what labels/boxes_2d.parquet says; scene 'shee"
        ):
            torchvision_sample(older, **options)
    with pytest.raises(ValueError, match="bounds must be one of amodal, modal; got 'tight'"):
        torchvision_sample(sample, bounds="tight")


@pytest.mark.long
def test_parked_cars_of_a_recorded_drive_have_an_instance(shared_dir) -> None:
    from adapters.base import open_scene

    root = shared_dir / "data" / "pandaset_mini" / "002"
    if not root.is_dir():
        pytest.skip(f"no PandaSet sequence at {root}")
    query = "frames=10:12&voxel_m=0.15&image_scale=0.25&sky_size=128"
    scene = open_scene(f"pandaset:{root}?{query}")
    recipe = Recipe(output=Output(instance=True), render=Render(scale=0.5))
    numbers = instances_of(scene)
    cars = 0
    for sample in SceneDataset(scene, recipe, cameras=["front_camera", "left_camera"]):
        boxes = sample["boxes"]
        counts = np.bincount(sample["instance"].flatten(), minlength=MAX_INSTANCE)
        assert boxes["instance"].tolist() == numbers.numbers_of(tuple(boxes["track_ids"])).tolist()
        fractions, xyxy = boxes["visible_fraction"].numpy(), boxes["modal_xyxy"].numpy()
        area = (xyxy[:, 2] - xyxy[:, 0]) * (xyxy[:, 3] - xyxy[:, 1])
        for k in np.flatnonzero((fractions > 0.5) & (area > 500)):
            cars += boxes["instance"][k] > len(scene.actors)
            assert counts[boxes["instance"][k]] > 200, (boxes["labels"][k], boxes["track_ids"][k])
    assert cars > 10


# ---- 2D boxes, masks and samples for detectors ---------------------------------------------------

WIDTH, HEIGHT = 24, 16
K = torch.tensor([[20.3, 0, 12.25], [0, 20.1, 8.5], [0, 0, 1]], dtype=torch.float64)
STEPS = 8  # rays a pixel and side


def a_pose(seed: int, far_m: float = 0.0) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    rotation = rotmat_from_quat(torch.from_numpy(rng.normal(size=4)))
    return rigid(rotation, torch.from_numpy(rng.normal(size=3) + far_m))


def a_sample(boxes: Boxes, frame: str = "world", weather: BoxWeather | None = None, **more) -> dict:
    """Of boxes in the camera's frame; the sample has them in another."""
    world_from_camera, world_from_ego = a_pose(1, 4e6), a_pose(2, 4e6)
    pose = world_from_camera.numpy()
    quats = torch.from_numpy(boxes.quats)
    turned = multiply_quats(quat_from_rotmat(world_from_camera[:3, :3]).expand_as(quats), quats)
    labelled_boxes = Boxes(
        boxes.track_ids,
        boxes.labels,
        boxes.centers_m @ pose[:3, :3].T + pose[:3, 3],
        boxes.sizes_m,
        turned.numpy(),
    )
    origins = {"ego": world_from_ego, "camera": world_from_camera, "world": torch.eye(4)}
    camera = {"name": "front", "width": WIDTH, "height": HEIGHT, "timestamp_ns": 0, "K": K}
    camera |= {"world_from_camera": world_from_camera, "world_from_ego": world_from_ego}
    images = dict.fromkeys(buffers())
    return {
        "boxes": box_tensors(labelled_boxes, weather or {}, frame, origins[frame].numpy()),
        "camera": camera,
        "image": torch.zeros(3, HEIGHT, WIDTH),
        "scene": "street",
        "variant": "fog-000",
        "frame": 4,
        **images,
        **more,
    }


def boxes_at(centers: list, sizes: list, quats: list | None = None, label: str = "Car") -> Boxes:
    """Camera frame: x right, y down, z forward."""
    count = len(centers)
    quats = quats or [[1.0, 0, 0, 0]] * count
    numbers = (np.array(v, np.float64).reshape(count, -1) for v in (centers, sizes, quats))
    return Boxes(tuple(map(str, range(count))), (label,) * count, *numbers)


def random_boxes(count: int, seed: int) -> Boxes:
    """Around the camera: before it, beside it, behind it, and some that it is in."""
    rng = np.random.default_rng(seed)
    centers = rng.normal([0, 0, 3], 4, (count, 3))
    return boxes_at(
        centers.tolist(), rng.uniform(0.5, 4, (count, 3)).tolist(),
        rng.normal(size=(count, 4)).tolist(),
    )  # fmt: skip


def met_by_rays(boxes: Boxes) -> np.ndarray:
    """bool [B, H * STEPS, W * STEPS]: rays between the pixels' borders that meet each box, by the
    box's six planes.
    """
    x = (np.arange(WIDTH * STEPS) + 0.5) / STEPS
    y = (np.arange(HEIGHT * STEPS) + 0.5) / STEPS
    rays = np.stack(np.meshgrid((x - K[0, 2].item()) / 20.3, (y - 8.5) / 20.1), axis=-1)
    rays = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1)
    rotations = rotmat_from_quat(torch.from_numpy(boxes.quats)).numpy()
    hits = []
    for center, size, rotation in zip(boxes.centers_m, boxes.sizes_m, rotations, strict=True):
        enter, leave = np.full(rays.shape[:2], 0.01), np.full(rays.shape[:2], np.inf)
        for axis in range(3):
            speed, start = rays @ rotation[:, axis], -center @ rotation[:, axis]
            depths = np.sort(np.stack([(-size[axis] / 2 - start) / speed,
                                       (size[axis] / 2 - start) / speed]), axis=0)  # fmt: skip
            enter, leave = np.maximum(enter, depths[0]), np.minimum(leave, depths[1])
        hits.append(enter <= leave)
    return np.array(hits)


def test_boxes_enclose_the_rays_that_meet_them_tightly() -> None:
    boxes = random_boxes(120, seed=3)
    flat = boxes_2d(a_sample(boxes, "camera"))
    for frame in ("world", "ego"):
        other = boxes_2d(a_sample(boxes, frame))
        assert torch.equal(other.in_view, flat.in_view)
        np.testing.assert_allclose(other.xyxy, flat.xyxy, atol=1e-4)
    assert flat.xyxy.dtype == torch.float32 and flat.in_view.dtype == torch.bool
    slack, checked = 0.01, 0
    for hit, xyxy, in_view in zip(met_by_rays(boxes), flat.xyxy, flat.in_view, strict=True):
        rows, columns = np.nonzero(hit)
        if not len(rows):  # no ray; of a view smaller than they are apart perhaps
            low, high = xyxy[:2], xyxy[2:]
            assert not in_view or float((high - low).min()) < 0.5
            continue
        ray_bounds = (
            np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]) / STEPS
        )
        assert in_view
        # Within the borders of the rays' cells, and a pointed end falls between the rays.
        outside = np.array(
            [
                xyxy[0] - ray_bounds[0],
                xyxy[1] - ray_bounds[1],
                ray_bounds[2] - xyxy[2],
                ray_bounds[3] - xyxy[3],
            ]
        )
        assert outside.max() <= 1 / STEPS + slack
        assert outside.min() >= -0.6
        checked += 1
    assert checked > 30 and int((~flat.in_view).sum()) > 30


def test_a_box_cut_by_a_border_is_tight() -> None:
    """A diamond whose lower corner leaves the image: the bounds of its corners would be wider."""
    turned = [np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)]
    boxes = boxes_at([[0, 2, 10]], [[4, 4, 0.001]], [turned])
    left, top, right, bottom = boxes_2d(a_sample(boxes, "camera")).xyxy[0].tolist()
    reach = np.sqrt(8)
    assert top == pytest.approx(8.5 + 20.1 * (2 - reach) / 10, abs=0.01)
    assert bottom == 16
    below = 2 - (16 - 8.5) * 10 / 20.1  # of the border, seen from the middle, upwards
    assert below < 0  # the middle is in view
    assert right - left == pytest.approx(2 * 20.3 * reach / 10, abs=0.01)
    far = boxes_at([[0, 6, 10]], [[4, 4, 0.001]], [turned])  # the tip is all that is in view
    left, top, right, bottom = boxes_2d(a_sample(far, "camera")).xyxy[0].tolist()
    depth_of_tip = 16 - (8.5 + 20.1 * (6 - reach) / 10)
    assert right - left == pytest.approx(2 * depth_of_tip * 20.3 / 20.1, abs=0.02)


def test_boxes_out_of_view_and_broken_ones() -> None:
    nan, inf = float("nan"), float("inf")
    boxes = boxes_at(
        [[0, 0, -5], [0, 0, 0], [nan, 0, 5], [0, 0, inf], [0, 0, 5], [40, 0, 5]],
        [[1, 1, 1], [2, 2, 2], [1, 1, 1], [1, 1, 1], [1, 1, 1], [1, 1, 1]],
        [[1, 0, 0, 0]] * 4 + [[0, 0, 0, 0]] + [[1, 0, 0, 0]],
    )
    for frame in ("world", "ego", "camera"):
        flat = boxes_2d(a_sample(boxes, frame))
        assert flat.in_view.tolist() == [False, True, False, False, False, False]
        assert flat.xyxy[1].tolist() == [0, 0, WIDTH, HEIGHT]  # the camera is in it
        assert flat.xyxy[[0, 2, 3, 4, 5]].abs().max() == 0
    assert boxes_2d(a_sample(Boxes.empty())).xyxy.shape == (0, 4)
    with pytest.raises(ValueError, match=r"frame 4: the sample has no boxes; open the dataset"):
        boxes_2d(a_sample(boxes) | {"boxes": None})


UPRIGHT = [0.5**0.5, 0.5**0.5, 0, 0]  # the boxes' z is up, the camera's is forward
TWO = boxes_at([[0, 0, 5], [0, 0, 9], [0, 0, -5]], [[1, 1, 1], [6, 1, 3], [1, 1, 1]], [UPRIGHT] * 3)


def smog_of(*transmittance: float) -> BoxWeather:
    names = tuple(map(str, range(len(transmittance))))
    stored = [names, transmittance, [1] * len(names)]
    return {"box_smog": box_tables()["box_smog"].from_json(stored)}


def depth_of_two() -> torch.Tensor:
    """The small near box before the large far one, the front faces of both."""
    depth = torch.full((HEIGHT, WIDTH), 8.5)
    depth[7:10, 10:14] = 4.5
    return depth


def test_masks_hold_what_others_do_not_hide() -> None:
    for frame in ("world", "ego", "camera"):
        masks = box_masks(a_sample(TWO, frame, depth=depth_of_two()))
        assert masks.shape == (3, HEIGHT, WIDTH) and masks.dtype == torch.bool
        assert masks.flatten(1).sum(dim=1)[[0, 2]].tolist() == [12, 0]
        assert masks[1].sum() > 60 and not (masks[0] & masks[1]).any()
    with pytest.raises(ValueError, match=r"masks need boxes and depth; .* lacks depth"):
        box_masks(a_sample(TWO))


@pytest.fixture
def without_torchvision(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "torchvision", None)  # its import then fails


def test_a_target_of_plain_tensors(without_torchvision) -> None:
    sample = a_sample(TWO, weather=smog_of(0.9, 0.3, 0.9), depth=depth_of_two())
    image, target = torchvision_sample(sample, masks=True)
    assert image is sample["image"]
    assert target["labels"].tolist() == [SemanticClass.VEHICLE] * 2
    assert target["labels"].dtype == torch.int64
    assert torch.equal(target["boxes"], boxes_2d(sample).xyxy[:2])
    assert target["masks"].shape == (2, HEIGHT, WIDTH) and target["depth"] is sample["depth"]
    assert target["visibility"].tolist() == [0.9, 0.3] and target["track_ids"] == ["0", "1"]
    assert (target["scene"], target["frame"]) == ("street", 4) and "water" not in target

    _, target = torchvision_sample(sample, min_visibility=0.5)
    assert target["track_ids"] == ["0"] and "masks" not in target
    _, target = torchvision_sample(sample, min_side_px=5.0, label_ids={"Car": 3})
    assert target["track_ids"] == ["1"] and target["labels"].tolist() == [3]
    _, target = torchvision_sample(sample, label_ids={"Bus": 3})
    assert target["boxes"].shape == (0, 4) and target["labels"].dtype == torch.int64
    _, target = torchvision_sample(sample, masks=True, min_pixels=13)
    assert target["track_ids"] == ["1"]
    with pytest.raises(ValueError, match="the sample has no image"):
        torchvision_sample(sample | {"image": None})
