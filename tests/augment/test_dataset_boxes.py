"""2D boxes, masks and samples for detectors."""

from __future__ import annotations

import sys
import types

import numpy as np
import pytest
import torch

from augment.dataset import box_masks, boxes_2d, torchvision_sample
from augment.dataset.samples import box_tensors
from augment.geometry import multiply_quats, quat_from_rotmat, rigid, rotmat_from_quat
from augment.jobs.box_tables import BoxWeather
from augment.jobs.files import box_tables
from augment.labels import Boxes
from augment.semantics import SemanticClass

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
    there = Boxes(
        boxes.track_ids,
        boxes.labels,
        boxes.centers_m @ pose[:3, :3].T + pose[:3, 3],
        boxes.sizes_m,
        turned.numpy(),
    )
    origins = {"ego": world_from_ego, "camera": world_from_camera, "world": torch.eye(4)}
    camera = {"name": "front", "width": WIDTH, "height": HEIGHT, "timestamp_ns": 0, "K": K}
    camera |= {"world_from_camera": world_from_camera, "world_from_ego": world_from_ego}
    images = dict.fromkeys(("depth", "semantic", "instance", "water", "snow"))
    return {
        "boxes": box_tensors(there, weather or {}, frame, origins[frame].numpy()),
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


def seen_by_rays(boxes: Boxes) -> np.ndarray:
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
    for hit, xyxy, in_view in zip(seen_by_rays(boxes), flat.xyxy, flat.in_view, strict=True):
        rows, columns = np.nonzero(hit)
        if not len(rows):  # no ray; of a view smaller than they are apart perhaps
            low, high = xyxy[:2], xyxy[2:]
            assert not in_view or float((high - low).min()) < 0.5
            continue
        found = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]) / STEPS
        assert in_view
        # Within the borders of the rays' cells, and a pointed end falls between the rays.
        outside = np.array([xyxy[0] - found[0], xyxy[1] - found[1], found[2] - xyxy[2],
                            found[3] - xyxy[3]])  # fmt: skip
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


class Image(torch.Tensor):
    pass


class Mask(torch.Tensor):
    pass


class BoundingBoxes(torch.Tensor):
    format: str
    canvas_size: tuple[int, int]

    def __new__(cls, data, *, format, canvas_size):
        boxes = data.as_subclass(cls)
        boxes.format, boxes.canvas_size = format, canvas_size
        return boxes


def test_a_target_of_tv_tensors(monkeypatch) -> None:
    """With stand-ins for torchvision's types, made as its own are."""
    module = types.ModuleType("torchvision")
    kinds = types.SimpleNamespace(Image=Image, Mask=Mask, BoundingBoxes=BoundingBoxes)
    monkeypatch.setattr(module, "tv_tensors", kinds, raising=False)
    monkeypatch.setitem(sys.modules, "torchvision", module)
    semantic = torch.zeros(HEIGHT, WIDTH, dtype=torch.uint8)
    sample = a_sample(TWO, depth=depth_of_two(), semantic=semantic)
    image, target = torchvision_sample(sample, masks=True)
    assert type(image) is Image and type(target["boxes"]) is BoundingBoxes
    assert (target["boxes"].format, target["boxes"].canvas_size) == ("XYXY", (HEIGHT, WIDTH))
    assert {type(target[key]) for key in ("masks", "depth", "semantic")} == {Mask}
    assert type(target["labels"]) is torch.Tensor and len(target["boxes"]) == 2
