"""2D boxes where rendered depth alone does not tell what shows an object."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from augment.output.box_tables import BOXES_2D, BoxNumbers, BoxWeather
from augment.scene.box_estimates import Evidence, SortedPoints, estimate_boxes
from augment.scene.boxes import Instances, WorldBoxes, find_occlusion, outline_world_boxes
from augment.scene.cameras import Camera
from augment.scene.labels import Boxes
from augment.scene.semantics import SemanticClass
from augment.view.box_labels import label_view
from augment.view.results import LabelSurfaces, WeatheredView
from recipes.schema import Output, Recipe, Render
from tests.augment.batch_scenes import ORIGIN_M
from tests.augment.box_views import UPRIGHT, make_boxes, make_camera

CAR = ((30.0, 0.0, 0.75), (4.0, 1.8, 1.5), UPRIGHT)
CAMERA = Camera("front", 640, 424, 600.0, 600.0, 320.2, 212.1, make_camera().camera_from_world)
ON_CAR = [(28.0, y, z) for y in (-0.8, 0.0, 0.8) for z in (0.5, 0.9, 1.3)]
NO_POINTS = SortedPoints(np.zeros((0, 3)))


def at_x(x_m: float, points: list) -> list:
    """The points moved along their rays from the camera to another x."""
    eye = CAMERA.centre.numpy()
    return [tuple(eye + (np.array(p) - eye) * (x_m - eye[0]) / (p[0] - eye[0])) for p in points]


def label(
    depth_m: np.ndarray | float,
    returns: list,
    *boxes: tuple,
    base: str = "recorded",
    splats: list | None = None,
    instance: bool = True,
    classes: np.ndarray | None = None,
    own_car: np.ndarray | None = None,
) -> tuple[np.ndarray | None, BoxNumbers, BoxNumbers]:
    """The instance image and both tables of boxes before a surface of that depth."""
    size = CAMERA.height, CAMERA.width
    depth = np.broadcast_to(np.float32(depth_m), size).copy()
    unknown = np.full(size, SemanticClass.UNKNOWN, np.uint8)
    none = np.zeros(size, np.uint16) if instance else None
    surface = LabelSurfaces(
        depth, none, depth, unknown if classes is None else classes,
        is_bare=False, classes=classes, own_car=own_car,
    )  # fmt: skip
    view = WeatheredView(CAMERA, np.zeros((*size, 3), np.uint8), None, None, none, surface=surface)
    labelled = make_boxes(*(boxes or (CAR,)))
    evidence = Evidence(
        SortedPoints.from_points(np.array(returns, np.float64).reshape(-1, 3)),
        SortedPoints.from_points(np.array(splats)) if splats else NO_POINTS,
        frozenset(),
    )
    recipe = Recipe(
        output=Output(instance=instance, labels=("coco",)),
        render=Render(base=base),  # pyright: ignore[reportArgumentType]
    )
    instances = Instances((), (0,), _Labels(labelled))
    labelled_view, measured = label_view(
        labelled, instances, ORIGIN_M, CAMERA, view, recipe, lambda: evidence
    )
    return labelled_view.instance, *_tables(measured)


def _tables(measured: BoxWeather) -> tuple[BoxNumbers, BoxNumbers]:
    return measured["box_2d"], measured["box_mask"]


class _Labels:
    def __init__(self, boxes: Boxes) -> None:
        self._boxes = boxes

    def boxes(self, frame_index: int) -> Boxes:
        return self._boxes

    def lidar(self, frame_index: int) -> None:
        return None


def amodal_of(*boxes: tuple) -> np.ndarray:
    world_boxes = WorldBoxes.from_labels(make_boxes(*boxes), ORIGIN_M)
    return outline_world_boxes(world_boxes, CAMERA).xyxy


@pytest.mark.parametrize(
    ("depth_m", "returns", "is_estimated"),
    [
        (100.0, ON_CAR, True),
        (0.0, ON_CAR, True),  # the sky
        (12.0, ON_CAR, True),  # a splat of a stray return, before the whole car
        (28.0, ON_CAR, False),  # the car's own back
        (100.0, [], False),  # it may stand behind what neither depth nor the LiDAR resolves
        (100.0, ON_CAR[:2], False),  # strays
        (12.0, at_x(12.0, ON_CAR), False),  # a wall
        (12.0, ON_CAR[:3] + at_x(12.0, ON_CAR[3:]), False),  # a fence that lets a few through
        (100.0, [(28.0, y, 0.1) for y in (-0.6, 0.0, 0.6)], False),  # the ground under it
        (100.0, ON_CAR + at_x(80.0, ON_CAR + ON_CAR), False),  # a frame that is looked through
        (12.0, [p for x in range(40) for p in np.add(ON_CAR, (x * 0.01, 0, 0))], False),  # many
    ],
)
@pytest.mark.parametrize("instance", [True, False])
def test_an_object_is_estimated_where_returns_prove_it_and_depth_misses_it(
    depth_m: float, returns: list, is_estimated: bool, instance: bool
) -> None:
    image, flat, masks = label(depth_m, returns, instance=instance)
    assert flat["is_estimated"].tolist() == [is_estimated]
    if not is_estimated:
        is_shown = depth_m == 28.0
        assert bool(flat["pixels"][0]) == bool(masks["pixels"][0]) == is_shown
        return
    np.testing.assert_allclose(flat["modal_xyxy"], amodal_of(CAR), atol=1)
    assert flat["visible_fraction"][0] == 1
    sides = [masks[side][0] for side in ("left", "top", "right", "bottom")]
    np.testing.assert_array_equal(sides, flat["modal_xyxy"][0])
    assert masks["pixels"][0] == flat["pixels"][0] > 300
    assert image is None or (image == 1).sum() == flat["pixels"][0]


def test_nearer_boxes_and_returns_before_it_hide_an_estimated_object() -> None:
    beside = ((20.0, 1.5, 0.75), (2.0, 3.0, 2.0), UPRIGHT)  # covers its left side
    _, by_box, _ = label(100.0, ON_CAR, CAR, beside)
    left = [p for p in ON_CAR if p[1] > 0.5]
    right = [p for p in ON_CAR if p[1] < 0.5]
    _, by_wall, _ = label(100.0, right + at_x(15.0, left))
    x0, _, x1, _ = amodal_of(CAR)[0]
    for flat in (by_box, by_wall):
        assert flat["is_estimated"][0]
        assert flat["modal_x0"][0] > x0 + 0.1 * (x1 - x0)
        assert flat["modal_x1"][0] == pytest.approx(x1, abs=1)
        assert 0.4 < flat["visible_fraction"][0] < 0.9


@pytest.mark.parametrize(("splats", "is_drawn"), [([], False), (ON_CAR[:3], True)])
def test_a_rendered_picture_shows_only_what_has_splats(splats: list, is_drawn: bool) -> None:
    _, flat, _ = label(100.0, ON_CAR, base="splats", splats=splats)
    assert flat["is_estimated"].tolist() == [is_drawn]


def test_what_snow_buries_of_an_object_is_not_estimated() -> None:
    world_boxes = WorldBoxes.from_labels(make_boxes(CAR), ORIGIN_M)
    depth_m = np.full((CAMERA.height, CAMERA.width), 100, np.float32)
    evidence = Evidence(SortedPoints.from_points(np.array(ON_CAR)), NO_POINTS, frozenset())
    bottoms = []
    for buried_m in (0.0, 0.4):
        estimates = estimate_boxes(
            world_boxes, ("car",), CAMERA, outline_world_boxes(world_boxes, CAMERA),
            find_occlusion(world_boxes, CAMERA, depth_m), lambda: evidence,
            on_photo=True, buried_m=np.array([buried_m]),
        )  # fmt: skip
        bottoms.append(estimates[0].xyxy[3])
    # 0.4 m at 28 m, seen through 600 pixels of focal length
    assert bottoms[0] - bottoms[1] == pytest.approx(0.4 * 600 / 28, abs=1)


def test_tables_without_the_column_are_read_as_of_depth_alone(tmp_path: Path) -> None:
    _, flat, _ = label(100.0, ON_CAR)
    path = tmp_path / "boxes_2d.parquet"
    path.write_bytes(BOXES_2D.to_bytes({(4, "front"): flat}))
    assert BOXES_2D.read(path)[4, "front"]["is_estimated"].tolist() == [True]
    pq.write_table(pq.read_table(path).drop_columns(["is_estimated"]), path)
    assert BOXES_2D.read(path)[4, "front"]["is_estimated"].tolist() == [False]
    line = BOXES_2D.to_json(flat)
    assert BOXES_2D.from_json(line)["is_estimated"].tolist() == [True]
    assert BOXES_2D.from_json(line[:-1])["is_estimated"].tolist() == [False]


# ---- Surfaces in a box that are not its object's -------------------------------------------------


@pytest.mark.parametrize("scenery", [SemanticClass.VEGETATION, SemanticClass.ROAD])
@pytest.mark.parametrize("instance", [True, False])
def test_a_surface_of_scenery_in_a_box_is_not_its_object(
    scenery: SemanticClass, instance: bool
) -> None:
    """A bush that reaches into the box of the car before it, 10 cm over the roof."""
    _, y0, _, y1 = amodal_of(CAR)[0]
    below = round(y0 + 0.3 * (y1 - y0))
    classes = np.full((CAMERA.height, CAMERA.width), SemanticClass.VEHICLE, np.uint8)
    classes[:below] = scenery
    _, plain, _ = label(28.0, [], instance=instance)
    _, flat, masks = label(28.0, [], instance=instance, classes=classes)
    assert plain["modal_y0"][0] < y0 and flat["modal_y0"][0] == below
    assert masks["top"][0] == below and masks["pixels"][0] == flat["pixels"][0]
    assert flat["visible_fraction"][0] == 1  # the bush is beside it, not before it


@pytest.mark.parametrize("depth_m", [28.0, 100.0])
@pytest.mark.parametrize("instance", [True, False])
def test_the_recording_car_in_a_photo_hides_what_is_behind_it(
    depth_m: float, instance: bool
) -> None:
    _, y0, _, y1 = amodal_of(CAR)[0]
    top = round((y0 + y1) / 2)
    own_car = np.zeros((CAMERA.height, CAMERA.width), bool)
    own_car[top:] = True
    image, flat, masks = label(depth_m, ON_CAR, instance=instance, own_car=own_car)
    assert flat["is_estimated"].tolist() == [depth_m == 100.0]
    assert flat["modal_y1"][0] == masks["bottom"][0] == top
    assert flat["visible_fraction"][0] == pytest.approx(0.5, abs=0.1)
    assert image is None or not image[own_car].any()
