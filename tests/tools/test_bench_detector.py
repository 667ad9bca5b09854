"""The worked example of a robust detector: targets, loss, detections, tables, and a tiny run."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from tools.bench.detection import (
    CELL_PX,
    DISTANCE_UNIT_PX,
    NUM_SIDES,
    DetectionViews,
    Objects,
    Targets,
    decode,
    detect,
    detection_loss,
    flip_targets,
    make_targets,
    stack_targets,
    suppress,
    train_detector,
)
from tools.bench.detector import (
    ARMS,
    CLEAR,
    FULL_CASE,
    LEARNT_WEATHER,
    UNKNOWN_EFFECTS,
    draw_recipe,
    objects_of,
)
from tools.bench.detector_tables import Hits, largest_rise, pool_hits
from tools.bench.segmentation import TrainingSettings, one_deterministic_thread

SIZE = (48, 64)
# Two objects of different categories, and one of the first that is ignored.
OBJECTS = Objects(
    torch.tensor([[4.0, 10, 24, 30], [40.0, 8, 48, 36], [30.0, 30, 38, 40]]),
    torch.tensor([0, 1, 0]),
    torch.tensor([False, False, True]),
)


def output_of(targets: Targets) -> torch.Tensor:
    """Return the output of a network that knows the targets."""
    heat = targets.heat.nan_to_num(0.0).clamp(1e-4, 1 - 1e-4)
    return torch.cat([heat.logit(), (targets.distances / DISTANCE_UNIT_PX).log()])


# ---- targets and loss ---------------------------------------------------------------------------


def test_a_mark_is_one_in_the_middle_cell_and_its_distances_lead_to_the_box():
    targets = make_targets(OBJECTS, 2, SIZE)
    assert (targets.heat == 1).sum((1, 2)).tolist() == [1, 1]
    row, column = (targets.heat[0] == 1).nonzero()[0].tolist()
    x_px, y_px = CELL_PX * (column + 0.5), CELL_PX * (row + 0.5)
    left, top, right, bottom = targets.distances[:, row, column].tolist()
    assert [x_px - left, y_px - top, x_px + right, y_px + bottom] == pytest.approx([4, 10, 24, 30])
    # Two objects teach boxes, each with a weight of 1.
    assert targets.weights.sum().item() == pytest.approx(2, abs=1e-5)


def test_cells_of_an_ignored_object_teach_nothing_in_its_category_alone():
    targets = make_targets(OBJECTS, 2, SIZE)
    inside = (slice(30 // CELL_PX, 40 // CELL_PX), slice(30 // CELL_PX, 38 // CELL_PX))
    assert targets.heat[0][inside].isnan().all()
    assert not targets.heat[1].isnan().any()
    output = output_of(targets)[None]
    loss = detection_loss(output, stack_targets([targets]))
    output[0, 0][inside] = 5.0  # a confident detection there
    assert detection_loss(output, stack_targets([targets])) == loss


def test_targets_of_a_flipped_image_are_flipped_targets():
    boxes = OBJECTS.boxes
    flipped = torch.stack(
        [SIZE[1] - boxes[:, 2], boxes[:, 1], SIZE[1] - boxes[:, 0], boxes[:, 3]], dim=1
    )
    # Middles on the border of two cells would fall to the right one in both images.
    shift = torch.tensor([1.0, 0, 1, 0])
    expected = make_targets(dataclasses.replace(OBJECTS, boxes=flipped - shift), 2, SIZE)
    targets = make_targets(dataclasses.replace(OBJECTS, boxes=boxes + shift), 2, SIZE)
    both = flip_targets(stack_targets([targets, targets]), torch.tensor([True, False]))
    for part, expected_part, same_part in zip(both, expected, targets, strict=True):
        torch.testing.assert_close(part[0], expected_part, equal_nan=True)
        torch.testing.assert_close(part[1], same_part, equal_nan=True)


def test_a_wrong_side_a_missed_middle_and_a_false_middle_raise_the_loss():
    targets = stack_targets([make_targets(OBJECTS, 2, SIZE)])
    output = output_of(Targets(*(part[0] for part in targets)))[None]
    true_loss = detection_loss(output, targets)
    wider = output.clone()
    wider[:, -NUM_SIDES] += 0.3  # left sides lie farther out
    missed = output.clone()
    missed[:, :-NUM_SIDES][targets.heat == 1] = -3.0
    false = output.clone()
    false[0, 1, 20, 2] = 3.0
    for other in (wider, missed, false):
        assert true_loss < detection_loss(other, targets)


# ---- detections ---------------------------------------------------------------------------------


def test_true_output_is_decoded_to_the_true_objects():
    targets = make_targets(OBJECTS, 2, SIZE)
    found = decode(targets.heat.nan_to_num(0.0), targets.distances)
    best = found.scores == 1
    order = found.categories[best].argsort()
    torch.testing.assert_close(found.boxes[best][order], OBJECTS.boxes[:2])
    assert found.categories[best][order].tolist() == [0, 1]


def test_the_lower_of_two_boxes_is_dropped_only_within_a_category():
    boxes = torch.tensor([[0.0, 0, 10, 10], [1.0, 0, 11, 10], [30.0, 0, 40, 10]])
    assert suppress(boxes, torch.tensor([0, 0, 0])) == [0, 2]
    assert suppress(boxes, torch.tensor([0, 1, 0])) == [0, 1, 2]


def test_a_network_learns_a_few_bright_objects():
    rng = np.random.default_rng(3)
    images = []
    targets = []
    for _ in range(8):
        left, top = rng.integers(2, 40), rng.integers(2, 26)
        image = torch.full((1, 3, *SIZE), 60, dtype=torch.uint8)
        image[..., top : top + 16, left : left + 20] = 220
        images.append(image)
        box = torch.tensor([[left, top, left + 20, top + 16]], dtype=torch.float32)
        objects = Objects(box, torch.tensor([0]), torch.tensor([False]))
        targets.append(make_targets(objects, 1, SIZE))
    views = DetectionViews(torch.stack(images), (CLEAR,), stack_targets(targets))
    settings = TrainingSettings(
        steps=80, batch=4, learning_rate=8e-3, widths=(8, 16, 24), num_classes=1 + NUM_SIDES
    )
    with one_deterministic_thread():
        network = train_detector(views, settings, kinds=(), seed=0)
    found = detect(network, images[0][0])
    row, column = (targets[0].heat[0] == 1).nonzero()[0].tolist()
    middle = torch.tensor([CELL_PX * (column + 0.5), CELL_PX * (row + 0.5)])
    # The best detection has its middle within two cells of the object's.
    assert ((found.boxes[0, :2] + found.boxes[0, 2:]) / 2 - middle).abs().max() < 2 * CELL_PX


def test_objects_are_those_that_the_image_shows_with_a_category():
    nan = float("nan")
    boxes = {
        "modal_xyxy": torch.tensor(
            [[0, 0, 20, 20], [nan] * 4, [0, 0, 4, 4], [5, 5, 30, 30], [9, 9, 40, 40]]
        ),
        "visible_fraction": torch.tensor([1.0, nan, 1.0, 0.05, 1.0]),
        "labels": ["Car", "Car", "Pedestrian", "Car", "Kite"],
    }
    objects = objects_of(boxes)
    assert objects.categories.tolist() == [0, 1, 0]
    assert objects.is_ignored.tolist() == [False, True, True]  # seen, too small, too hidden


# ---- tables -------------------------------------------------------------------------------------


def make_hits(*counts_by_level):
    """Hits of three scenes with ten objects each, from the clean variant on."""
    num_found = {str(k): np.array(counts, np.float64) for k, counts in enumerate(counts_by_level)}
    return Hits(np.full(3, 10.0), num_found)


def test_falling_recall_has_no_rise():
    rise = largest_rise(make_hits([9, 9, 9], [8, 8, 8], [2, 2, 2]), ("0", "1", "2"))
    assert rise.points == pytest.approx(-10) and not rise.num_significant


def test_a_rise_in_all_scenes_is_significant_and_one_in_a_single_scene_is_not():
    everywhere = largest_rise(make_hits([9, 9, 9], [3, 3, 3], [5, 5, 5]), ("0", "1", "2"))
    assert (everywhere.variant, everywhere.num_significant) == ("2", 1)
    assert everywhere.interval == pytest.approx((20, 20))
    once = largest_rise(make_hits([9, 9, 9], [3, 3, 3], [5, 3, 3]), ("0", "1", "2"))
    assert once.points > 0 and not once.num_significant


def test_pooled_hits_are_sums_over_seeds():
    pooled = pool_hits([make_hits([1, 2, 3]), make_hits([4, 5, 6])])
    assert pooled.objects.tolist() == [20, 20, 20]
    assert pooled.num_found["0"].tolist() == [5, 7, 9]


# ---- the case -----------------------------------------------------------------------------------


def test_no_street_is_both_learnt_and_tested_and_draws_differ():
    assert not {*FULL_CASE.train_scenes} & {*FULL_CASE.test_scenes}
    recipes = [r for uri in FULL_CASE.train_scenes for r in FULL_CASE.recipes_of(uri)[1:]]
    assert len({(recipe.name, recipe.variant) for recipe in recipes}) == len(recipes)


def test_one_arm_learns_weather_and_none_learns_floods_or_drops():
    assert ARMS["clean"].kinds == () and ARMS["weather"].kinds == tuple(LEARNT_WEATHER)
    assert UNKNOWN_EFFECTS == ("flood", "lens")
    for kind in LEARNT_WEATHER:
        recipe = draw_recipe(kind, 0)
        assert recipe.weather.flood is None and recipe.camera.lens_drops is None
