"""Whether views agree on where the water is, and whether views without water stay as they were.

What a pixel shows first is known on the procedural street: water, exactly if the true surface on
its ray lies behind the plane. A point of the plane that two cameras both see by that measure, away
from silhouettes in both images, must be water in both masks. Without the truth, a difference that
is due to something standing before one camera could not be told from an error.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from adapters.procedural import StreetTruth
from augment.cameras import Camera
from augment.effects.flood.water_plane import plane_depth
from augment.geometry import rigid
from augment.plan import make_plan
from augment.scene import Scene
from augment.views import render_buffers
from recipes.schema import Recipe
from tools.bench_flood_error import PICTURE_ONLY, draw, flood_recipe, inside

SILHOUETTE_PX = 3  # splats stand up to this far out beyond the true surface
REACH_M = 80.0  # farther out a pixel is metres long and shows many things at once
FAR_BELOW_M = -100.0


@dataclass(frozen=True, eq=False)
class WaterView:
    """One camera's mask and the truth. drawn, true [H, W]: water is first. depth [H, W]: z of the
    plane, infinite where the ray does not meet it.
    """

    camera: Camera
    drawn: np.ndarray
    true: np.ndarray
    depth: np.ndarray


def water_view(scene: Scene, truth: StreetTruth, camera: Camera, recipe: Recipe) -> WaterView:
    medium = make_plan(recipe, scene).flood
    assert medium is not None
    depth = plane_depth(camera, medium.level_z_m).numpy()
    surface = truth.render(camera).depth
    true = np.isfinite(depth) & (surface > depth)
    return WaterView(camera, draw(scene, camera, recipe).water, true, depth)


def mask_error(view: WaterView) -> dict[str, float]:
    """Share of a view's pixels whose mask is the true one, and of those away from silhouettes."""
    same = view.drawn == view.true
    clear = inside(view.true, SILHOUETTE_PX) | inside(~view.true, SILHOUETTE_PX)
    return {
        "pixels": int(same.size),
        "agreeing": float(same.mean()),
        "agreeing_off_silhouettes": float(same[clear].mean()),
        "clear_share": float(clear.mean()),
    }


def pair_agreement(here: WaterView, there: WaterView) -> dict[str, float | None]:
    """Points of the plane at one view's pixels, looked up in another's.

    points: as near as REACH_M and inside both images. agreeing: share of equal masks, with what
    stands before one camera only. visible: points that both truly see, away from silhouettes.
    agreeing_visible: share of them that both masks show as water. Shares of nothing are None.
    """
    near = here.depth <= REACH_M
    rays = here.camera.ray_directions(torch.float64).numpy()[near]
    points = here.camera.centre.numpy() + here.depth[near][:, None] * rays
    pose = there.camera.camera_from_world.numpy()
    local = points @ pose[:3, :3].T + pose[:3, 3]
    z = np.maximum(local[:, 2], 1e-9)
    column = np.floor(there.camera.fx * local[:, 0] / z + there.camera.cx)
    row = np.floor(there.camera.fy * local[:, 1] / z + there.camera.cy)
    height, width = there.drawn.shape
    met = (local[:, 2] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    at = row[met].astype(np.int64), column[met].astype(np.int64)
    ours, theirs = here.drawn[near][met], there.drawn[at]
    both = inside(here.true, SILHOUETTE_PX)[near][met] & inside(there.true, SILHOUETTE_PX)[at]
    return {
        "points": int(met.sum()),
        "agreeing": float((ours == theirs).mean()) if met.any() else None,
        "visible": int(both.sum()),
        "agreeing_visible": float((ours & theirs)[both].mean()) if both.any() else None,
    }


def bench_masks(
    scene: Scene,
    truth: StreetTruth,
    frames: Sequence[int],
    pairs: Sequence[tuple[str, str]] | None = None,
    scale: float = 1.0,
) -> dict[str, Any]:
    """Masks of neighbouring cameras at each frame's time, and of the first camera as it stands in
    the next of the frames, taken at the time of this one.
    """
    recipe = flood_recipe("sky")
    views, agreement = [], []
    for number, index in enumerate(frames):
        frame = scene.frame(index)

        def view_of(camera: Camera, time: int = frame.timestamp_ns) -> WaterView:
            camera = dataclasses.replace(camera.scaled(scale), timestamp_ns=time)
            return water_view(scene, truth, camera, recipe)

        chosen = tuple(neighbours(frame.cameras)) if pairs is None else pairs
        names = dict.fromkeys(name for pair in chosen for name in pair)
        seen = {name: view_of(frame.cameras[name]) for name in names}
        views += [
            {"view": f"{name}, frame {index}", **mask_error(view)} for name, view in seen.items()
        ]
        compared = [(f"{a} in {b}", seen[a], seen[b]) for a, b in chosen]
        if number + 1 < len(frames):
            ahead = view_of(scene.frame(frames[number + 1]).cameras[chosen[0][0]])
            first = chosen[0][0]
            compared.append(
                (f"{first} in {first} of frame {frames[number + 1]}", seen[first], ahead)
            )
        agreement += [
            {"pair": f"{name}, frame {index}", **pair_agreement(a, b)} for name, a, b in compared
        ]
    return {"views": views, "pairs": agreement}


def neighbours(cameras: Mapping[str, Camera]) -> list[tuple[str, str]]:
    """Each camera and the next one clockwise, by their optical axes; from the first one on."""

    def bearing(name: str) -> float:
        ahead = cameras[name].world_from_camera[:3, 2]
        return math.atan2(float(ahead[1]), float(ahead[0]))

    ring = sorted(cameras, key=bearing, reverse=True)
    first = ring.index(next(iter(cameras)))
    ring = ring[first:] + ring[:first]
    return [(name, ring[(i + 1) % len(ring)]) for i, name in enumerate(ring)]


def looking_up(camera: Camera) -> Camera:
    """The camera turned until no ray of it falls: straight up."""
    right = camera.world_from_camera[:3, 0].clone()
    right[2] = 0
    right /= right.norm()
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    rotation = torch.stack([right, torch.linalg.cross(up, right), up])
    return dataclasses.replace(camera, camera_from_world=rigid(rotation, -rotation @ camera.centre))


def dry_views(scene: Scene, camera: Camera) -> dict[str, bool]:
    """Whether a view that no water is in is the clean one to the bit: of a camera that looks up,
    and of water below everything.
    """
    cases = {
        "looking up": (looking_up(camera), flood_recipe(waves="calm")),
        "level below everything": (camera, flood_recipe(level_m=FAR_BELOW_M)),
    }
    clean = make_plan(Recipe(output=PICTURE_ONLY), scene)
    return {
        name: torch.equal(
            render_buffers(scene, view, make_plan(recipe, scene)).rgb,
            render_buffers(scene, view, clean).rgb,
        )
        for name, (view, recipe) in cases.items()
    }
