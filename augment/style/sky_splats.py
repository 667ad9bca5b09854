"""Splats that paint sky: what of a fitted scene has to change with the sky and not with the land.

A fit fills gaps at the skyline, between wires, branches and roofs, with splats of the sky's colour.
Under the land's map they would stay behind as halos when the sky's map is another. What paints sky
stands above the horizon and has the colour of the sky behind it, where that is what the cameras see
as sky: a cube map behind a wall holds whatever the fit left there, and a wall that is as pale as
the clouds beside it may still differ from the sky behind it.
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Float, Int16
from scipy.spatial import KDTree
from torch import Tensor

from augment.render.sh import SH_C0
from augment.scene import Scene
from augment.sky import is_stand_in
from augment.style.maps import StyleMaps

LEVELS = 8  # steps from a splat of the land to one of the sky
_NEAR, _FAR = 0.06, 0.16  # greatest difference of a channel: sky up to here, none from there
_LIKELY, _UNLIKELY = 7.0, 14.0  # squared Mahalanobis distance from the colours of the seen sky
_LOW_DEG, _HIGH_DEG = 0.5, 3.0  # elevation: none up to here, all from there
_FLOOR = 0.01  # standard deviation added to the seen sky's, so that a plain one is not a point
_MOST_PLACES = 64  # that the sky is looked at from


def sky_levels(scene: Scene, maps: StyleMaps) -> Int16[Tensor, "N"] | None:
    """How much of every background splat is sky, 0 to LEVELS; None where none is any, or where it
    cannot be told: without cameras, without knowing where up is, or in front of a grey stand-in.

    Each is looked at from the nearest of the scene's cameras. Remembered for as long as the scene
    lives, since it is the same for every style.
    """
    seen = maps.seen_sky
    if seen is None or is_stand_in(scene.sky):
        return None
    known, key = _remembered.setdefault(scene, {}), seen.numpy().tobytes()
    if key not in known:
        known[key] = _find(scene, seen)
    return known[key]


_remembered: WeakKeyDictionary[Scene, dict[bytes, Tensor | None]] = WeakKeyDictionary()


def _find(scene: Scene, seen: Float[Tensor, "3 4"]) -> Int16[Tensor, "N"] | None:
    g, places = scene.background, _places(scene)
    if len(places) == 0 or len(g) == 0 or not scene.has_known_gravity:
        return None
    rgb = np.clip(0.5 + SH_C0 * g.sh[:, 0].double().numpy(), 0, 1)
    likely = _ramp(_distance(rgb, seen), _UNLIKELY, _LIKELY)
    found = np.flatnonzero((likely > 0) & (g.means[:, 2].numpy() > places[:, 2].min()))
    if len(found) == 0:
        return None
    means = g.means[found].double().numpy()
    away = means - places[KDTree(places).query(means)[1]]
    length = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
    elevation_deg = np.degrees(np.arcsin(np.clip(away[:, 2] / length, -1, 1)))
    behind = scene.sky.sample(torch.from_numpy(away.astype(np.float32))).double().numpy()
    share = (
        likely[found]
        * _ramp(elevation_deg, _LOW_DEG, _HIGH_DEG)
        * _ramp(np.abs(rgb[found] - behind).max(1), _FAR, _NEAR)
        * _ramp(_distance(behind, seen), _UNLIKELY, _LIKELY)
    )
    levels = np.zeros(len(g), np.int16)
    levels[found] = np.round(LEVELS * share)
    return torch.from_numpy(levels) if levels.any() else None


def level_maps(maps: StyleMaps) -> Float[Tensor, "R 3 4"]:
    """The splats' maps at every level, those of level 0 first: row C level + class."""
    steps = torch.arange(LEVELS + 1) / LEVELS
    return torch.cat([torch.lerp(maps.splats, maps.sky, step) for step in steps])


def map_rows(
    levels: Int16[Tensor, "N"], classes: Int16[Tensor, "N"] | None, count: int
) -> Int16[Tensor, "N"]:
    """The row of level_maps for every splat. count: of the splats' maps, C."""
    if count == 1 or classes is None:
        return count * levels
    known = torch.where((classes >= 0) & (classes < count), classes, 0)
    return (count * levels + known).to(torch.int16)


def _places(scene: Scene) -> np.ndarray:
    """Centres of the scene's cameras, float64 [P, 3], a few spread over its frames."""
    centres = [c.centre.numpy() for f in scene.frames for c in f.cameras.values()]
    step = max(1, -(-len(centres) // _MOST_PLACES))
    return np.asarray(centres[::step], np.float64).reshape(-1, 3)


def _distance(rgb: np.ndarray, seen: Float[Tensor, "3 4"]) -> np.ndarray:
    """Squared, in standard deviations of the seen sky's colours."""
    mean, covariance = seen[:, 3].double().numpy(), seen[:, :3].double().numpy()
    inverse = np.linalg.inv(covariance + _FLOOR**2 * np.eye(3))
    apart = rgb - mean
    return np.einsum("ni,ij,nj->n", apart, inverse, apart)


def _ramp(value: np.ndarray, none: float, full: float) -> np.ndarray:
    """0 at `none` and beyond, 1 at `full` and beyond, straight between."""
    return np.clip((value - none) / (full - none), 0, 1)
