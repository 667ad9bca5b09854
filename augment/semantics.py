"""The semantic classes of Gaussians and pixels, few enough to hold across datasets."""

from enum import IntEnum


class SemanticClass(IntEnum):
    """Values are written to semantic images; they never change meaning between versions."""

    UNKNOWN = 0
    ROAD = 1
    LANE_MARKING = 2
    SIDEWALK = 3
    TERRAIN = 4
    VEGETATION = 5
    BUILDING = 6
    BARRIER = 7
    POLE = 8
    SIGN = 9
    VEHICLE = 10
    TWO_WHEELER = 11
    PEDESTRIAN = 12
    OTHER = 13
    SKY = 14
    WATER = 15
    SNOW = 16
