"""Numba kernel of labelled boxes: pixels of a depth image that show each box, or hide it."""

from __future__ import annotations

import numpy as np

from augment.render.cpu.jit import kernel_function, serial_kernel


# This kernel takes one thread: it runs beside the renderer, on threads that write files.
@serial_kernel
def count_box_pixels(
    depth,
    instance,
    scenery,
    actors,
    windows,
    across,
    down,
    axes,
    eyes,
    owned,
    labelled,
    near_m,
    counts,
    owners,
):
    """Count the pixels that show each of B boxes, and those that show what hides it.

    A pixel shows a box if the surface there lies in the part of the box that owns surfaces. It
    shows what hides the box if its ray meets the labelled box and the surface lies before that
    part.

    Args:
        depth: float32 [H, W], z of the surfaces, metres, 0 = none.
        instance: uint16 [H, W], the actors' numbers; [0, 0] where they are not known.
        scenery: bool [H, W], surfaces of a class that no object has; [0, 0] where classes are not
            known.
        actors: int64 [B], the boxes' actors, 0 = none.
        windows: int64 [B, 4], left, top, right, bottom of the pixels that can show a box.
        across: float64 [W], x / z of the pixels' rays.
        down: float64 [H], y / z of the pixels' rays.
        axes: float64 [B, 3, 3], columns are the camera's axes in the box's frame.
        eyes: float64 [B, 3], the camera's centre in the box's frame, metres.
        owned: float64 [B, 2, 3], lowest and highest corner of the part that owns surfaces, metres.
        labelled: float64 [B, 2, 3], lowest and highest corner of the labelled box, metres.
        near_m: z below which a box is not seen.
        counts: int64 [B, 6], set to the pixels that show the box, the pixels that show what hides
            it, and left, top, right, bottom of the former, right and bottom excluded.
        owners: uint16 [H, W], set to 1 + the smallest of the boxes that a pixel shows by its depth,
            0 = none; [0, 0] where nobody asks.
    """
    knows_actors = instance.size > 0
    knows_classes = scenery.size > 0
    volumes = np.empty(len(counts), np.float64)
    for box in range(len(counts)):
        low = labelled[box, 0]
        high = labelled[box, 1]
        volumes[box] = (high[0] - low[0]) * (high[1] - low[1]) * (high[2] - low[2])
    # Pixels of known actors: they show the actor's boxes wherever they are.
    boxes_of = np.empty(65536, np.int64)  # the first box of each actor
    for actor in range(len(boxes_of)):
        boxes_of[actor] = -1
    for box in range(len(counts)):
        counts[box, 2] = depth.shape[1]
        counts[box, 3] = depth.shape[0]
        if actors[box] > 0 and boxes_of[actors[box]] < 0:
            boxes_of[actors[box]] = box
    if knows_actors:
        for row in range(instance.shape[0]):
            for column in range(instance.shape[1]):
                if instance[row, column] > 0:
                    box = boxes_of[instance[row, column]]
                    if box >= 0:
                        _add(counts[box], row, column)
        for box in range(len(counts)):  # a second box of an actor shows what the first one does
            if actors[box] > 0:
                for k in range(counts.shape[1]):
                    counts[box, k] = counts[boxes_of[actors[box]], k]
    for box in range(len(counts)):
        left, top, right, bottom = windows[box]
        actor_number = actors[box]
        for row in range(top, bottom):
            for column in range(left, right):
                z = depth[row, column]
                if not z > 0:
                    continue
                pixel_actor = np.int64(0)
                if knows_actors:
                    pixel_actor = np.int64(instance[row, column])
                    if actor_number > 0 and pixel_actor == actor_number:
                        continue  # counted above
                # Depths at which the ray enters and leaves the labelled box, then the owning part.
                enter = near_m
                leave = np.inf
                nearest = near_m
                farthest = np.inf
                for axis in range(3):
                    slope = (
                        axes[box, axis, 0] * across[column]
                        + axes[box, axis, 1] * down[row]
                        + axes[box, axis, 2]
                    )
                    eye = eyes[box, axis]
                    a = (labelled[box, 0, axis] - eye) / slope
                    b = (labelled[box, 1, axis] - eye) / slope
                    enter = max(enter, min(a, b))
                    leave = min(leave, max(a, b))
                    a = (owned[box, 0, axis] - eye) / slope
                    b = (owned[box, 1, axis] - eye) / slope
                    nearest = max(nearest, min(a, b))
                    farthest = min(farthest, max(a, b))
                if nearest <= z and z <= farthest:
                    if actor_number == 0 and pixel_actor == 0:
                        if knows_classes and scenery[row, column]:
                            continue
                        _add(counts[box], row, column)
                        if owners.size > 0:
                            owner = np.int64(owners[row, column]) - 1
                            if owner < 0 or volumes[box] < volumes[owner]:
                                owners[row, column] = box + 1
                    elif pixel_actor > 0 and enter <= leave:
                        counts[box, 1] += 1  # another actor, in this box
                elif z < nearest and enter <= leave:
                    counts[box, 1] += 1
    for box in range(len(counts)):
        if counts[box, 0] == 0:
            for k in range(2, counts.shape[1]):
                counts[box, k] = 0


@kernel_function()
def _add(counts, row, column):
    """Add one pixel to a box's counts (a row of `count_box_pixels`'s)."""
    counts[0] += 1
    counts[2] = min(counts[2], column)
    counts[3] = min(counts[3], row)
    counts[4] = max(counts[4], column + 1)
    counts[5] = max(counts[5], row + 1)
