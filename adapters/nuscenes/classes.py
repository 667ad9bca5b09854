"""What lidarseg's 32 classes mean here."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from augment.semantics import SemanticClass

NO_SURFACE = -1  # stands for returns that no surface made, where a SemanticClass is expected
EGO_CLASS = 31

# As published, numbered from 0.
_S = SemanticClass
_CLASSES: tuple[tuple[str, int], ...] = (
    ("noise", NO_SURFACE), ("animal", _S.OTHER), ("human.pedestrian.adult", _S.PEDESTRIAN),
    ("human.pedestrian.child", _S.PEDESTRIAN),
    ("human.pedestrian.construction_worker", _S.PEDESTRIAN),
    ("human.pedestrian.personal_mobility", _S.TWO_WHEELER),
    ("human.pedestrian.police_officer", _S.PEDESTRIAN),
    ("human.pedestrian.stroller", _S.PEDESTRIAN), ("human.pedestrian.wheelchair", _S.PEDESTRIAN),
    ("movable_object.barrier", _S.BARRIER), ("movable_object.debris", _S.OTHER),
    ("movable_object.pushable_pullable", _S.OTHER), ("movable_object.trafficcone", _S.OTHER),
    ("static_object.bicycle_rack", _S.OTHER), ("vehicle.bicycle", _S.TWO_WHEELER),
    ("vehicle.bus.bendy", _S.VEHICLE), ("vehicle.bus.rigid", _S.VEHICLE),
    ("vehicle.car", _S.VEHICLE), ("vehicle.construction", _S.VEHICLE),
    ("vehicle.emergency.ambulance", _S.VEHICLE), ("vehicle.emergency.police", _S.VEHICLE),
    ("vehicle.motorcycle", _S.TWO_WHEELER), ("vehicle.trailer", _S.VEHICLE),
    ("vehicle.truck", _S.VEHICLE), ("flat.driveable_surface", _S.ROAD),
    ("flat.other", _S.TERRAIN), ("flat.sidewalk", _S.SIDEWALK), ("flat.terrain", _S.TERRAIN),
    # Walls, but poles and signs too: lidarseg does not tell them apart.
    ("static.manmade", _S.BUILDING), ("static.other", _S.OTHER),
    ("static.vegetation", _S.VEGETATION), ("vehicle.ego", _S.VEHICLE),
)  # fmt: skip


def class_table(names: Mapping[int, str]) -> np.ndarray:
    """SemanticClass, or NO_SURFACE, by the number of a class, int16 [256].

    names: category.json's, by number; where it numbers none, the published ones. Other names are
    UNKNOWN.
    """
    meaning = dict(_CLASSES)
    numbered = names or {number: name for number, (name, _) in enumerate(_CLASSES)}
    table = np.full(256, SemanticClass.UNKNOWN, np.int16)
    for number, name in numbered.items():
        if number < len(table):
            table[number] = meaning.get(name, SemanticClass.UNKNOWN)
    return table
