"""Procedural streets for tests: each is built once a process, which takes seconds."""

from __future__ import annotations

import dataclasses
import functools

from adapters import base
from augment.scene.scene import Actor, Scene

# The cheapest street there is: as few Gaussians as it can have, and few things in it.
SMALL_STREET = "procedural:street?seed=3&frames=2&gaussians=60000&parked=4&moving=1&pedestrians=0"

# With sweeps, and one of each kind of thing that has a box.
LABELLED_STREET = (
    "procedural:street?seed=3&frames=2&width=160&height=96&gaussians=60000&lidar_columns=96"
    "&parked=1&moving=1&pedestrians=1"
)

_built = functools.lru_cache(maxsize=4)(base.open_scene)


def open_street(uri: str = SMALL_STREET) -> Scene:
    """The street of a URI as `open_scene` gives it: a new scene, of which nothing is remembered yet
    (beds of snow, covers, light), with the arrays of the earlier ones. They must not be changed.
    """
    return dataclasses.replace(_built(uri))


def open_fast_street(uri: str = LABELLED_STREET) -> Scene:
    """A street on which everybody drives three times as fast as its track says."""
    street = open_street(uri)
    return dataclasses.replace(street, actors=tuple(map(_hurried, street.actors)))


def _hurried(actor: Actor) -> Actor:
    poses = actor.track.world_from_actor.clone()
    poses[:, :3, 3] += 2 * (poses[:, :3, 3] - poses[0, :3, 3])
    return dataclasses.replace(
        actor, track=dataclasses.replace(actor.track, world_from_actor=poses)
    )
