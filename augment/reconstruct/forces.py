"""How the loss of a view pulls at rigid things: at every part of the scene, and at the camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from augment.reconstruct.force_kernels import MOMENTS, sum_forces
from augment.render.cpu_backward import SplatGradients
from augment.render.cpu_inputs import Inputs
from augment.render.threads import kernel_threads


@dataclass(frozen=True, eq=False)
class Forces:
    """Of P parts, in each part's own axes, float64. seen: bool [P], whether the view shows it.

    shift [P, 3]: dL by a shift of the part. turn [P, 3]: dL by a turn about its origin (rad), of
    means and ellipsoids; that view-dependent colours turn along is left out.
    """

    seen: np.ndarray
    shift: np.ndarray
    turn: np.ndarray

    def on_camera(self, camera_from_parts: np.ndarray) -> np.ndarray:
        """dL [6] by a turn, then a shift, of everything as the camera sees it, in camera axes.

        camera_from_parts: float64 [P, 4, 4].
        """
        rotations, offsets = camera_from_parts[:, :3, :3], camera_from_parts[:, :3, 3]
        shift = (rotations @ self.shift[..., None])[..., 0]
        turn = (rotations @ self.turn[..., None])[..., 0] + np.cross(offsets, shift)
        return np.concatenate([turn.sum(0), shift.sum(0)])


def part_forces(inputs: Inputs, grads: SplatGradients) -> Forces:
    """The forces of one view's gradients, the same for any number of threads."""
    moments = np.empty((len(inputs.blocks), MOMENTS))
    with kernel_threads():
        sum_forces(
            inputs.addresses,
            inputs.sizes,
            inputs.blocks,
            grads.rows.reshape(-1),
            grads.ids,
            grads.counts,
            moments,
        )
    parts = len(inputs.sizes)
    # Blocks of a part stand together; an empty part has none.
    totals = np.zeros((parts, MOMENTS))
    np.add.at(totals, inputs.blocks[:, 0], moments)
    seen = np.bincount(inputs.blocks[:, 0], grads.counts, minlength=parts) > 0
    return Forces(seen, totals[:, :3], totals[:, 3:])
