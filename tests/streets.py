"""Procedural streets for tests: each is built once a process, which takes seconds."""

from __future__ import annotations

import dataclasses
import functools

from adapters import base
from augment.effects.wet.ground_map import EXPOSURE_SETTINGS
from augment.exposure.exposed_surface import ExposedSurface, exposed_surface_of
from augment.memo import memo_of
from augment.scene.scene import Actor, Scene

# The cheapest street there is: as few Gaussians as it can have, and few things in it.
SMALL_STREET = "procedural:street?seed=3&frames=2&gaussians=60000&parked=4&moving=1&pedestrians=0"

# With sweeps, and one of each kind of thing that has a box.
LABELLED_STREET = (
    "procedural:street?seed=3&frames=2&width=160&height=96&gaussians=60000&lidar_columns=96"
    "&parked=1&moving=1&pedestrians=1"
)

_built = functools.lru_cache(maxsize=6)(base.open_scene)


def open_street(uri: str = SMALL_STREET, *, has_wet_ground: bool = False) -> Scene:
    """The street of a URI as `open_scene` gives it: a new scene, of which nothing is remembered yet
    (beds of snow, covers, light), with the arrays of the earlier ones. They must not be changed.

    has_wet_ground: if True, the scene remembers the exposed surface that rain wets, which takes
    seconds to find and is found once a process: for tests of what is done with it.
    """
    street = dataclasses.replace(_built(uri))
    return _with_wet_ground(street, uri, False) if has_wet_ground else street


def open_fast_street(uri: str = LABELLED_STREET, *, has_wet_ground: bool = False) -> Scene:
    """A street on which everybody drives three times as fast as its track says. has_wet_ground: as
    for `open_street`.
    """
    street = open_street(uri)
    fast = dataclasses.replace(street, actors=tuple(map(_hurried, street.actors)))
    return _with_wet_ground(fast, uri, True) if has_wet_ground else fast


def _with_wet_ground(street: Scene, uri: str, is_fast: bool) -> Scene:
    memo_of(street).put(("exposed surface", EXPOSURE_SETTINGS), _wet_ground(uri, is_fast))
    return street


@functools.lru_cache(maxsize=6)
def _wet_ground(uri: str, is_fast: bool) -> ExposedSurface:
    street = open_fast_street(uri) if is_fast else open_street(uri)
    return exposed_surface_of(street, EXPOSURE_SETTINGS)


def _hurried(actor: Actor) -> Actor:
    poses = actor.track.world_from_actor.clone()
    poses[:, :3, 3] += 2 * (poses[:, :3, 3] - poses[0, :3, 3])
    return dataclasses.replace(
        actor, track=dataclasses.replace(actor.track, world_from_actor=poses)
    )
