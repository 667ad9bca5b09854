"""What of the procedural street snow should lie on: points of its true surface from straight above.

A point is open where the vertical ray that comes down from the sky meets it first, flat where the
true surface is no steeper than the limit, and seen where nothing stands between it and a camera.
What drives or walks shelters nothing, nor does it hide anything.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from adapters.procedural import RayHits, StreetTruth
from adapters.street.world import Body
from augment.cameras import Camera
from augment.geometry import rigid

SKY_Z_M = 60.0  # above everything on the street
_LIFT_M = 1e-3  # of a point above its own surface, before it looks at a camera


@dataclass(frozen=True, eq=False)
class TruePoints:
    """P places on a grid of the ground plan and the surface that is highest there.

    xy [P, 2], z [P]: world, metres. slope [P]: of the surface, radians. semantic [P]: its class.
    from_path_m [P]: level distance to the nearest camera. is_seen [P]: by a camera.
    """

    xy: np.ndarray
    z: np.ndarray
    slope: np.ndarray
    semantic: np.ndarray
    from_path_m: np.ndarray
    is_seen: np.ndarray

    def __len__(self) -> int:
        return len(self.z)

    def chosen(self, mask: np.ndarray) -> TruePoints:
        columns = {f.name: getattr(self, f.name)[mask] for f in dataclasses.fields(self)}
        return TruePoints(**columns)


def still(truth: StreetTruth) -> StreetTruth:
    """The street without what moves."""
    return StreetTruth(dataclasses.replace(truth.street, movers=()))


def camera_from_above(cameras: Sequence[Camera], *, reach_m: float, pixel_m: float) -> Camera:
    """An orthographic camera that looks down on all that is within reach_m of the cameras, in level
    distance along x and y; rows towards -y.
    """
    centres = np.stack([camera.centre.numpy()[:2] for camera in cameras])
    low, high = centres.min(0) - reach_m, centres.max(0) + reach_m
    width, height = (int(n) for n in np.ceil((high - low) / pixel_m))
    eye = torch.tensor([*((low + high) / 2), SKY_Z_M], dtype=torch.float64)
    rotation = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    return Camera(
        name="from above",
        width=width,
        height=height,
        fx=1 / pixel_m,
        fy=1 / pixel_m,
        cx=width / 2,
        cy=height / 2,
        camera_from_world=rigid(rotation, -rotation @ eye),
        is_orthographic=True,
    )


def pixel_places(camera: Camera) -> np.ndarray:
    """x and y [H, W, 2] of the pixels of a camera from above."""
    centre = camera.centre.numpy()
    x = centre[0] + (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = centre[1] - (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    return np.stack(np.meshgrid(x, y), -1)


def surface_below(truth: StreetTruth, xy: np.ndarray) -> np.ndarray:
    """z [P] of the highest surface at xy [P, 2]; -infinity where there is none."""
    return SKY_Z_M - _drop(truth, xy).distance


def body_tops(body: Body, xy: np.ndarray) -> TruePoints:
    """What is highest of a body at xy [P, 2], its frame; is_seen and from_path_m say nothing."""
    origins = np.concatenate([xy, np.full((len(xy), 1), SKY_Z_M)], 1)
    hits = body.tree.cast(origins, np.broadcast_to([0.0, 0.0, -1.0], origins.shape))
    met = hits.shape >= 0
    normals = body.shapes.normals(hits.shape[met], hits.local[met])
    return TruePoints(
        xy=xy[met],
        z=SKY_Z_M - hits.distance[met],
        slope=np.arccos(np.clip(np.abs(normals[:, 2]), 0, 1)),
        semantic=body.shapes.semantic[hits.shape[met]],
        from_path_m=np.zeros(int(met.sum())),
        is_seen=np.ones(int(met.sum()), bool),
    )


def true_points(
    truth: StreetTruth, cameras: Sequence[Camera], xy: np.ndarray, *, reach_m: float
) -> TruePoints:
    """The open points at xy [P, 2] within reach_m of the cameras' path. truth: `still`."""
    centres = np.unique(np.stack([c.centre.numpy()[:2] for c in cameras]).round(1), axis=0)
    away = np.full(len(xy), np.inf)
    for centre in centres:
        np.minimum(away, np.hypot(*(xy - centre).T), out=away)
    near = away <= reach_m
    xy, away = xy[near], away[near]
    hits = _drop(truth, xy)
    met = np.isfinite(hits.distance)
    points = TruePoints(
        xy=xy[met],
        z=SKY_Z_M - hits.distance[met],
        slope=np.arccos(np.clip(hits.normal[met, 2], -1, 1)),
        semantic=hits.semantic[met],
        from_path_m=away[met],
        is_seen=np.zeros(int(met.sum()), bool),
    )
    seen = _seen(truth, cameras, points, hits.normal[met])
    return dataclasses.replace(points, is_seen=seen)


def _drop(truth: StreetTruth, xy: np.ndarray) -> RayHits:
    origins = np.concatenate([xy, np.full((len(xy), 1), SKY_Z_M)], 1)
    down = np.broadcast_to([0.0, 0.0, -1.0], origins.shape)
    return truth.cast(origins, down, 0, with_rgb=False)


def _seen(
    truth: StreetTruth, cameras: Sequence[Camera], points: TruePoints, normals: np.ndarray
) -> np.ndarray:
    """bool [P]: seen by one of the cameras, whatever its distance."""
    places = np.concatenate([points.xy, points.z[:, None]], 1) + _LIFT_M * normals
    seen = np.zeros(len(points), bool)
    for camera in cameras:
        left = np.flatnonzero(~seen)
        pose, eye = camera.camera_from_world.numpy(), camera.centre.numpy()
        local = places[left] @ pose[:3, :3].T + pose[:3, 3]
        depth = np.maximum(local[:, 2], 1e-9)
        u = camera.fx * local[:, 0] / depth + camera.cx
        v = camera.fy * local[:, 1] / depth + camera.cy
        inside = (local[:, 2] > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        inside &= ((eye - places[left]) * normals[left]).sum(1) > 0
        left = left[inside]
        if len(left):
            hidden = truth.street.static.tree.occluded(places[left], eye - places[left], 1.0)
            seen[left[~hidden]] = True
    return seen
