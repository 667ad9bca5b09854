import dataclasses
import pickle

import numpy as np
import pytest
import torch

from augment.errors import SceneError
from augment.photo.recorded_base import check_base
from augment.photo.trust import trust_mask
from augment.scene.box_estimates import evidence_of
from augment.scene.boxes import WorldBoxes, outline_world_boxes
from augment.scene.cameras import Camera
from augment.scene.moved_actors import add_actors, carry_track, make_track, move_actors, shift_track
from augment.scene.scene import Actor, Scene, Track
from augment.scene.scene_index import SceneIndex
from augment.view.box_labels import label_view
from augment.view.render_view import render_view
from augment.view.weathered_sweep import weathered_sweep
from recipes.load import load_recipe
from recipes.schema import Recipe
from tests.streets import open_street

STREET = (
    "procedural:street?seed=3&frames=3&width=320&height=180&gaussians=60000&lidar_columns=96"
    "&parked=1&moving=2&pedestrians=0"
)
MOVED = "car-1"
OTHER = "car-0"
WEATHERS = ("dense-fog", "fresh-snow", "street-flood", "night-rain")
# The same, for a test that draws new scenes: the last two take 9 s of processor time each.
WEATHERS_OF_NEW_SCENES = (
    "dense-fog",
    "street-flood",
    pytest.param("fresh-snow", marks=pytest.mark.long),
    pytest.param("night-rain", marks=pytest.mark.long),
)


def recipe_of(name: str) -> Recipe:
    return load_recipe(name).resolve(0)


def street() -> tuple[Scene, Camera]:
    scene = open_street(STREET)
    return scene, scene.frames[1].cameras["front"]


def pose(x: float, y: float, z: float = 0.8, yaw: float = 0.0) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    matrix[:3, 3] = [x, y, z]
    return matrix


def actor_of(scene: Scene, track_id: str) -> Actor:
    return next(actor for actor in scene.actors if actor.track_id == track_id)


def moved_street(x: float = 12.0, y: float = -1.0, yaw: float = 0.4) -> tuple[Scene, Camera]:
    scene, camera = street()
    track = carry_track(actor_of(scene, MOVED).track, [(camera.timestamp_ns, pose(x, y, yaw=yaw))])
    return move_actors(scene, {MOVED: track}), camera


@pytest.mark.parametrize("name", ("clear", *WEATHERS))
def test_a_move_to_the_recorded_track_changes_no_bit(name: str) -> None:
    scene, camera = street()
    track = actor_of(scene, MOVED).track
    same = move_actors(scene, {MOVED: dataclasses.replace(track)})
    recipe = recipe_of(name)
    assert (render_view(scene, camera, recipe).rgb == render_view(same, camera, recipe).rgb).all()


@pytest.mark.parametrize("name", WEATHERS_OF_NEW_SCENES)
def test_a_moved_picture_does_not_depend_on_earlier_pictures(name: str) -> None:
    recipe = recipe_of(name)
    alone, camera = moved_street()
    first = render_view(alone, camera, recipe).rgb
    scene, _ = street()
    render_view(scene, camera, recipe)
    elsewhere = move_actors(
        scene, {MOVED: shift_track(actor_of(scene, MOVED).track, (0.0, 2.0, 0.0))}
    )
    render_view(elsewhere, camera, recipe)
    track = carry_track(
        actor_of(scene, MOVED).track, [(camera.timestamp_ns, pose(12.0, -1.0, yaw=0.4))]
    )
    last = render_view(move_actors(elsewhere, {MOVED: track}), camera, recipe).rgb
    assert (first == last).all()


def test_boxes_of_a_moved_actor_agree_with_its_pixels() -> None:
    scene, camera = moved_street()
    outputs = {"depth": "expected", "instance": True, "labels": True, "semantic": True}
    recipe = recipe_of("clear")
    recipe = recipe.model_copy(update={"output": recipe.output.model_copy(update=outputs)})
    index = SceneIndex.of(scene)
    boxes = scene.boxes(1)
    view, _ = label_view(
        boxes,
        index.instances,
        scene.world_origin_m,
        camera,
        render_view(scene, camera, recipe),
        recipe,
        lambda: evidence_of(scene, 1),
    )
    number = index.instances.by_track[MOVED]
    rows, columns = np.nonzero(view.instance == number)
    box = boxes.track_ids.index(MOVED)
    outlines = outline_world_boxes(WorldBoxes.from_labels(boxes, scene.world_origin_m), camera)
    left, top, right, bottom = outlines.xyxy[box]
    # Coarse splats blur the car's outline by up to a fifth of its width to each side, moved or not.
    low_column, high_column = np.quantile(columns, [0.05, 0.95])
    low_row, high_row = np.quantile(rows, [0.02, 0.98])
    low = np.maximum([left, top], [low_column, low_row])
    high = np.minimum([right, bottom], [high_column + 1, high_row + 1])
    overlap = np.prod(high - low)
    of_mask = (high_column + 1 - low_column) * (high_row + 1 - low_row)
    assert len(rows) > 300
    assert overlap / (of_mask + (right - left) * (bottom - top) - overlap) > 0.6


def test_a_removed_actor_has_neither_pixels_nor_box_and_others_keep_their_numbers() -> None:
    scene, camera = street()
    without = move_actors(scene, {OTHER: None})
    recipe = recipe_of("clear")
    recipe = recipe.model_copy(
        update={"output": recipe.output.model_copy(update={"instance": True})}
    )
    before = render_view(scene, camera, recipe).instance
    after = render_view(without, camera, recipe).instance
    assert before is not None and after is not None
    numbers = SceneIndex.of(scene).instances.by_track
    assert dict(SceneIndex.of(without).instances.by_track) == dict(numbers)
    assert (before == numbers[OTHER]).any()
    assert not (after == numbers[OTHER]).any()
    assert OTHER not in without.boxes(1).track_ids
    assert set(without.boxes(1).track_ids) == set(scene.boxes(1).track_ids) - {OTHER}


def test_an_added_actor_has_a_number_of_its_own_a_box_and_pixels() -> None:
    scene, camera = street()
    source = actor_of(scene, MOVED)
    track = make_track([(camera.timestamp_ns, pose(11.0, -1.5))], "copy")
    copy = dataclasses.replace(source, track_id="copy", copy_of=MOVED, track=track)
    more = add_actors(scene, [copy])
    recipe = recipe_of("clear")
    recipe = recipe.model_copy(
        update={"output": recipe.output.model_copy(update={"instance": True})}
    )
    number = SceneIndex.of(more).instances.by_track["copy"]
    assert number == len(scene.actors) + 1
    instance = render_view(more, camera, recipe).instance
    assert instance is not None and (instance == number).sum() > 300
    boxes = more.boxes(1)
    row = boxes.track_ids.index("copy")
    assert np.allclose(boxes.centers_m[row] - more.world_origin_m, [11.0, -1.5, 0.8])
    assert boxes.labels[row] == source.label
    assert len(boxes) == len(scene.boxes(1)) + 1


def test_trust_is_zero_on_a_side_that_no_image_shows_and_full_far_from_the_move() -> None:
    scene, camera = moved_street(yaw=0.4)
    plain, _ = street()
    recipe = recipe_of("clear")
    recipe = recipe.model_copy(
        update={"output": recipe.output.model_copy(update={"instance": True})}
    )
    instance = render_view(scene, camera, recipe).instance
    is_moved = instance == 1 + [actor.track_id for actor in scene.actors].index(MOVED)
    trust = trust_mask(scene, camera)
    # The car came towards the camera; its back, which now faces the camera, was never recorded.
    assert np.median(trust[is_moved]) < 128 <= np.median(trust_mask(plain, camera)[is_moved])
    assert (trust[is_moved] == 0).mean() > 0.3
    assert np.median(trust[~is_moved]) == 255


def test_trust_is_zero_on_ground_that_an_actor_always_hid() -> None:
    scene, camera = street()
    # A car that stands before the camera during the whole drive.
    times_ns = actor_of(scene, OTHER).track.timestamps_ns
    matrix = torch.from_numpy(pose(8.0, -1.7))[None].expand(len(times_ns), 4, 4).contiguous()
    parked = dataclasses.replace(actor_of(scene, OTHER), track=Track(times_ns, matrix))
    actors = tuple(parked if actor.track_id == OTHER else actor for actor in scene.actors)
    scene = dataclasses.replace(scene, actors=actors)
    without = move_actors(scene, {OTHER: None})
    recipe = recipe_of("clear")
    output = recipe.output.model_copy(update={"instance": True, "semantic": True})
    recipe = recipe.model_copy(update={"output": output})
    hidden = render_view(scene, camera, recipe).instance == 1
    assert hidden.sum() > 300
    trust = trust_mask(without, camera)
    assert (trust[hidden] == 0).mean() > 0.1
    assert (trust[~hidden] == 255).mean() > 0.8


def test_a_sweep_of_a_moved_scene_is_the_recorded_one() -> None:
    scene, _ = street()
    moved, _ = moved_street()
    recipe = recipe_of("fresh-snow")
    sweep = scene.lidar(1)
    assert sweep is not None
    recorded = weathered_sweep(scene, recipe, 1, sweep)
    of_moved = weathered_sweep(moved, recipe, 1, sweep)
    for name, column in recorded.columns.items():
        assert np.array_equal(column, of_moved.columns[name], equal_nan=column.dtype.kind == "f")


def test_a_carried_track_meets_the_poses_and_keeps_the_recorded_speed() -> None:
    scene, camera = street()
    track = actor_of(scene, MOVED).track
    start_ns = camera.timestamp_ns
    poses = [(start_ns, pose(12.0, -1.0)), (start_ns + 20_000_000, pose(12.3, -1.0))]
    carried = carry_track(track, poses)
    for time_ns, expected in poses:
        at = carried.pose_at(time_ns)
        assert at is not None and np.allclose(at, expected, atol=1e-9)
    before = carried.pose_at(start_ns - 50_000_000)
    recorded = track.pose_at(start_ns)
    earlier = track.pose_at(start_ns - 50_000_000)
    assert before is not None and recorded is not None and earlier is not None
    step = (recorded[:3, 3] - earlier[:3, 3]).norm()
    assert float((torch.from_numpy(poses[0][1])[:3, 3] - before[:3, 3]).norm()) == pytest.approx(
        float(step)
    )


def test_moves_that_cannot_be_are_refused_in_words() -> None:
    scene, camera = street()
    time_ns = camera.timestamp_ns
    mirrored = pose(0, 0)
    mirrored[0, 0] = -1
    scaled = pose(0, 0)
    scaled[:3, :3] *= 1.1
    track = actor_of(scene, MOVED).track
    refusals = {
        "no actor 'car-9'": lambda: move_actors(scene, {"car-9": None}),
        "part of the background": lambda: move_actors(scene, {"parked-0": None}),
        "must be finite": lambda: make_track([(0, np.full((4, 4), np.nan))], "actor 'a'"),
        "mirrors": lambda: make_track([(0, mirrored)], "actor 'a'"),
        "must be rigid": lambda: make_track([(0, scaled)], "actor 'a'"),
        "4x4": lambda: make_track([(0, np.eye(3))], "actor 'a'"),
        "within": lambda: make_track([(0, pose(1e9, 0))], "actor 'a'"),
        "must increase": lambda: make_track([(5, pose(0, 0)), (5, pose(1, 0))], "actor 'a'"),
        "at least one pose": lambda: make_track([], "actor 'a'"),
        "two actors": lambda: add_actors(scene, [actor_of(scene, MOVED)]),
        "base: splats": lambda: check_base(
            recipe_of("clear").model_copy(
                update={"render": recipe_of("clear").render.model_copy(update={"base": "recorded"})}
            ),
            move_actors(scene, {MOVED: carry_track(track, [(time_ns, pose(9, 0))])}),
        ),
    }
    for words, call in refusals.items():
        with pytest.raises(SceneError, match=words):
            call()


def test_a_moved_scene_with_other_frames_is_recorded_in_these_frames() -> None:
    scene, _ = moved_street()
    fewer = dataclasses.replace(scene, frames=scene.frames[:2])
    recorded = fewer.as_recorded
    assert recorded.frames is fewer.frames
    assert recorded.actors is scene.as_recorded.actors
    assert recorded is fewer.as_recorded
    assert scene.as_recorded is scene.recorded
    renamed = dataclasses.replace(scene, name="renamed")  # snow and streaks depend on the name
    assert renamed.as_recorded.name == "renamed"
    assert renamed.as_recorded is renamed.as_recorded
    plain, _ = street()
    assert plain.as_recorded is plain


def test_a_moved_scene_that_travels_to_another_process_still_shares_its_recorded_one() -> None:
    moved, _ = moved_street()
    there = pickle.loads(pickle.dumps(moved))
    assert there.as_recorded is there.recorded
    assert there.moved_instances == moved.moved_instances
    assert there.boxes(1).track_ids == moved.boxes(1).track_ids
