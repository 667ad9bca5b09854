"""Things in boxes, carried from picture to picture: a board that moves before a wall."""

import dataclasses

import numpy as np
import pytest
from walls import BOARD_SIZE_M, FRAME_NS, board_boxes, board_centre, driving_camera, wall_view

from augment.jobs.tables import FrameBoxes
from augment.labels import Boxes
from augment.metrics.consistency import (
    MAX_GAP_NS,
    STILL_M,
    ActorPaths,
    carry,
    consistency_of,
    find_warp,
)

FRAMES = 9


def compared(paths, a, b, **kwargs):
    """(consistency over the pixels that moved, over all, what moved and counts)."""
    carried = carry(paths, a, b, **kwargs)
    clear = dataclasses.replace(b, alpha=np.where(carried.unclear_b, 0.0, b.alpha))
    warp = find_warp(a, clear, carried.points_m)
    warped = warp.sample(b.picture)
    moved = warp.counts & carried.moved
    return consistency_of(a, warped, moved), consistency_of(a, warped, warp.counts), moved


@pytest.mark.parametrize("apart", [1, 7])
def test_a_board_goes_along_with_its_box(apart):
    a, b = wall_view(driving_camera(0)), wall_view(driving_camera(apart))
    moving, whole, moved = compared(ActorPaths(board_boxes(FRAMES)), a, b)
    on_board = a.depth_m < 7
    assert moved.sum() > 0.5 * on_board.sum() and not (moved & ~on_board).any()
    assert moving.rmse < 1e-6 and whole.rmse < 1e-6
    # As if it stood the board agrees in depth, and its paint does not.
    standing = find_warp(a, b)
    apart_m = apart * FRAME_NS * 1e-9 * 2.0
    wrong = consistency_of(a, standing.sample(b.picture), standing.counts & on_board)
    assert wrong.rmse == pytest.approx(0.2 * apart_m * np.sqrt(2 / 3), rel=0.05)


def test_the_surroundings_of_a_moving_board_do_not_count():
    """Half a metre around it, in both pictures: shadows and what reaches beyond the label."""
    a, b = wall_view(driving_camera(0)), wall_view(driving_camera(1))
    for view in (a, b):  # a floor under the board, painted as its shadow
        gap = np.abs(view.depth_m - 6.2) < 1
        below = np.zeros_like(gap)
        below[1:] = gap[:-1] & ~gap[1:]
        view.depth_m[below] = 6.2
        view.picture[below] = 0.0
    carried = carry(ActorPaths(board_boxes(FRAMES)), a, b)
    shadow = (a.picture == 0).all(-1)
    assert shadow.any() and np.isnan(carried.points_m[shadow]).all()
    assert carried.unclear_b[(b.picture == 0).all(-1)].all()


def test_poses_are_interpolated_between_labels():
    paths = ActorPaths(board_boxes(FRAMES))
    pose = paths.at(FRAME_NS * 5 // 2)["board"]
    assert pose.known
    assert np.allclose(pose.world_from_box[:3, 3], board_centre(FRAME_NS * 5 // 2), atol=1e-9)
    assert np.allclose(pose.size_m, BOARD_SIZE_M)


def test_what_moves_and_whose_pose_is_not_known_does_not_count():
    """The second picture is taken half a frame after the last label."""
    late = dataclasses.replace(driving_camera(2), timestamp_ns=2 * FRAME_NS + FRAME_NS // 2)
    a, b = wall_view(driving_camera(1)), wall_view(late)
    carried = carry(ActorPaths(board_boxes(3)), a, b)
    on_board = a.depth_m < 7
    assert not carried.moved.any() and np.isnan(carried.points_m[on_board]).all()
    assert np.isfinite(carried.points_m[:, :5]).all()


def test_a_box_that_stands_is_the_worlds():
    frames = {n: dataclasses.replace(f, timestamp_ns=n) for n, f in board_boxes(2).items()}
    for frame in frames.values():
        frame.boxes.centers_m[0] = board_centre(0)
    frames[1].boxes.centers_m[0, 1] += 0.9 * STILL_M  # a label that trembles
    frames = {n: FrameBoxes(n * FRAME_NS, f.boxes) for n, f in frames.items()}
    a = wall_view(driving_camera(0))
    b = wall_view(dataclasses.replace(driving_camera(1), timestamp_ns=0))
    b = dataclasses.replace(b, camera=driving_camera(1))
    carried = carry(ActorPaths(frames), a, b)
    assert not carried.moved.any() and not carried.unclear_b.any()
    assert np.isfinite(carried.points_m).all()
    after = dataclasses.replace(b, camera=dataclasses.replace(b.camera, timestamp_ns=2 * FRAME_NS))
    assert np.isfinite(carry(ActorPaths(frames), a, after).points_m).all()


def test_actors_outside_of_every_box_do_not_count():
    a, b = wall_view(driving_camera(0)), wall_view(driving_camera(1))
    bonnet = np.zeros(a.depth_m.shape, bool)
    bonnet[-4:] = True
    is_actor = bonnet | (a.depth_m < 7)
    carried = carry(ActorPaths(board_boxes(FRAMES)), a, b, is_actor)
    assert np.isnan(carried.points_m[bonnet]).all() and carried.moved.any()


def test_labels_without_numbers_or_far_in_time_are_no_boxes():
    frames = board_boxes(1)
    broken = Boxes(("x",), ("Car",), np.full((1, 3), np.nan), np.ones((1, 3)), np.ones((1, 4)))
    frames[1] = FrameBoxes(FRAME_NS, broken)
    paths = ActorPaths(frames)
    assert set(paths.at(0)) == {"board"}
    assert paths.at(MAX_GAP_NS)["board"].known is False
    assert paths.at(MAX_GAP_NS + 1) == {}
    assert ActorPaths({}).at(0) == {}
