"""A scene fitted to renders of the procedural street, against the street's exact depth."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch

from adapters.procedural import StreetTruth, TrueView, open_truth
from adapters.uri import parse_uri
from augment.cameras import Camera
from augment.errors import AdapterError
from augment.geometry import rigid
from augment.metrics.image import DepthErrors, depth_errors
from augment.reconstruct.view import ViewSource
from augment.scene import Scene
from augment.semantics import SemanticClass
from tools.fit_scores import RenderedView, render_recorded

MAX_VIEWS = 24


class Truth(Protocol):
    """What is asked of a `StreetTruth`."""

    def render(self, camera: Camera) -> TrueView: ...


@dataclass(frozen=True)
class TruthErrors:
    """Depth errors over all pixels of a number of views whose true depth is known.

    median, expected: of both depths, over the pixels that truly show a surface and are rendered
    with one. by_class: the median depth's, by the true class's name. no_surface: the part of the
    true surface pixels that are rendered without one. sky_covered: the part of the true sky pixels
    that are rendered with a surface; sky_alpha: their mean opacity. NaN where no pixel is meant.
    """

    views: int
    median: DepthErrors
    expected: DepthErrors
    by_class: dict[str, DepthErrors]
    no_surface: float
    sky_covered: float
    sky_alpha: float


def true_depth_errors(scene: Scene, truth: Truth, cameras: Sequence[Camera]) -> TruthErrors:
    """Compare a scene's depth with the street's, through cameras of the scene's own world.

    The scene may have moved the origin (`world_origin_m`), as an adapter of recordings does.
    """
    pixels = [_pixels(scene, truth, camera) for camera in cameras]

    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(p, name) for p in pixels] or [np.zeros(0)])

    alpha, true_m, surface = joined("alpha"), joined("true_m"), joined("surface").astype(bool)
    median_m, semantic = joined("median_m"), joined("semantic")
    is_sky = np.isinf(true_m)
    used = surface & ~is_sky
    classes = np.unique(semantic[~is_sky])
    return TruthErrors(
        views=len(pixels),
        median=depth_errors(median_m[used], true_m[used]),
        expected=depth_errors(joined("expected_m")[used], true_m[used]),
        by_class={
            SemanticClass(int(c)).name.lower(): depth_errors(median_m[own], true_m[own])
            for c in classes
            for own in [used & (semantic == c)]
        },
        no_surface=_part(~surface[~is_sky]),
        sky_covered=_part(surface[is_sky]),
        sky_alpha=_part(alpha[is_sky]),
    )


def truth_facts(uri: str, scene: Scene, source: ViewSource) -> dict[str, Any]:
    """For reports: a fitted scene's depth against the street it was recorded from, JSON-able.

    uri: that street, procedural:street?...; at most MAX_VIEWS held-out views (training views
    where none is held out) at their recorded cameras.

    Raises:
        AdapterError: the URI is no procedural street.
    """
    truth = open_street(uri)
    keys = source.test or source.train
    chosen = keys[:: max(1, -(-len(keys) // MAX_VIEWS))]
    errors = true_depth_errors(scene, truth, [source.camera(key) for key in chosen])
    facts = dataclasses.asdict(errors)
    return {"street": uri, **facts}


def open_street(uri: str) -> StreetTruth:
    """The exact street of a URI.

    Raises:
        AdapterError: the URI names something else, or an option that streets do not have.
    """
    scheme, path, query = parse_uri(uri)
    if scheme != "procedural" or path != "street":
        raise AdapterError(
            f"--truth {uri!r}: exact depth is known of procedural streets alone, such as "
            f"procedural:street?seed=3, with the options that the recording was rendered with"
        )
    return open_truth(query)


@dataclass(frozen=True, eq=False)
class _Pixels:
    """Of one view, flat."""

    true_m: np.ndarray
    semantic: np.ndarray
    alpha: np.ndarray
    surface: np.ndarray
    median_m: np.ndarray
    expected_m: np.ndarray


def _pixels(scene: Scene, truth: Truth, camera: Camera) -> _Pixels:
    seen: RenderedView = render_recorded(scene, camera)
    true = truth.render(_in_dataset_world(camera, scene.world_origin_m))
    return _Pixels(
        true_m=true.depth.reshape(-1),
        semantic=true.semantic.reshape(-1),
        alpha=seen.alpha.reshape(-1),
        surface=seen.has_surface.reshape(-1),
        median_m=seen.median_depth_m.reshape(-1),
        expected_m=seen.expected_depth_m.reshape(-1),
    )


def _in_dataset_world(camera: Camera, world_origin_m: np.ndarray) -> Camera:
    origin = torch.from_numpy(np.asarray(world_origin_m, np.float64))
    scene_from_dataset = rigid(torch.eye(3, dtype=torch.float64), -origin)
    return dataclasses.replace(
        camera, camera_from_world=camera.camera_from_world @ scene_from_dataset
    )


def _part(values: np.ndarray) -> float:
    return float(np.mean(values)) if len(values) else float("nan")
