"""Lamps beside the road: at the tops of a scene's masts, by a rule, or from a list.

In: a scene and settings. Out: `Lamps` that do not change over time. No dataset that the adapters
read names its street lamps (the maps of AV2 and nuScenes hold none), so masts are known from the
class of their Gaussians. Without such a class a rule sets lamps along the path of the recording
car.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Float64

from augment.errors import LampError
from augment.lamps.ies import IesLuminaire
from augment.lamps.lamp import AMBER, RED, LampKind, Lamps, color_of_temperature
from augment.lamps.lamp_types import LampType, make_lamps
from augment.lamps.patterns import BATWING_PEAK_CD, Pattern, mean_over_directions
from augment.lamps.poles import lamp_heads, unnamed_masts
from augment.lamps.road_heights import RoadHeights
from augment.memo import memo_of
from augment.scene.geometry import rotmat_from_quat
from augment.scene.scene import Scene
from augment.scene.semantics import SemanticClass

# ---- Settings ------------------------------------------------------------------------------------

StreetLampSource = Literal["auto", "masts", "rule"]


@dataclass(frozen=True)
class StreetLampSettings:
    """Light and places of street lamps."""

    source: StreetLampSource = "auto"
    """Origin of the places: the scene's masts, the rule, or the masts where there are at least
    MIN_MASTS and else the rule."""
    flux_lm: float = 8_000.0
    """Luminous flux of a lamp, lumens; files of luminaires state their own."""
    temperature_k: float = 3_000.0
    """Colour temperature, kelvin."""
    spacing_m: float = 30.0
    """Distance between two lamps of the rule along the road, metres; sides alternate."""
    height_m: float = 8.0
    """Height of the rule's lamps above the road, metres."""
    offset_m: float = 6.0
    """Distance of the rule's lamps from the path of the recording car, metres."""
    luminaire: IesLuminaire | None = None
    """Luminaire of a file; None for the batwing."""

    def __post_init__(self) -> None:
        limits = {
            "flux_lm": (0.0, 1e6),
            "spacing_m": (5.0, 500.0),
            "height_m": (2.0, 50.0),
            "offset_m": (0.0, 50.0),
        }
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            if not low <= value <= high:  # also catches NaN
                raise ValueError(f"{name} must be {low:g} to {high:g}; got {value}")


# Fewest masts of a scene that are taken in place of the rule.
MIN_MASTS = 2
# Distance beyond both ends of the path up to which the rule sets lamps, metres.
REACH_M = 120.0
# Largest number of lamps of the rule.
MAX_RULE_LAMPS = 1_000
# Largest number of lamps in a list.
MAX_LISTED_LAMPS = 1_000
# Radius of a lamp's disc, metres: 0.1 m² of an LED luminaire.
_RADIUS_M = 0.178


# ---- Street lamps --------------------------------------------------------------------------------


def street_lamps(scene: Scene, settings: StreetLampSettings) -> Lamps:
    """Return the street lamps of a scene, remembered as long as the scene lives.

    Args:
        scene: the scene.
        settings: light and places.
    """
    scene = scene.as_recorded
    return memo_of(scene).get(("street lamps", settings), lambda: _find_lamps(scene, settings))


def _find_lamps(scene: Scene, settings: StreetLampSettings) -> Lamps:
    """Return the street lamps from the best source that knows any."""
    path = _path_of(scene)
    if settings.source != "rule":
        heads = lamp_heads(scene)
        if len(heads) >= MIN_MASTS or settings.source == "masts":
            axes = _axes_along_road(heads.positions_m, heads.feet_m, path)
            return _lamps_at(heads.positions_m, axes, settings)
    positions, axes = _rule_places(scene, path, settings)
    return _lamps_at(positions, axes, settings)


def _lamps_at(
    positions_m: Float64[np.ndarray, "M 3"],
    axes: Float64[np.ndarray, "M 3"],
    settings: StreetLampSettings,
) -> Lamps:
    """Return lamps of the settings' light."""
    if len(positions_m) == 0:
        return Lamps.none()
    color = color_of_temperature(settings.temperature_k)
    intensity_cd = BATWING_PEAK_CD * settings.flux_lm / 1000
    lamp_type = LampType(LampKind.STREET, Pattern.STREET, intensity_cd, color, _RADIUS_M)
    lamps = make_lamps(positions_m, axes, lamp_type)
    if settings.luminaire is None:
        return lamps
    table, peak_cd = settings.luminaire.pack()
    count = len(lamps)
    return replace(
        lamps,
        tables=table[None],
        patterns=np.zeros(count, np.int64),
        intensities_cd=np.full(count, peak_cd),
        mean_intensities_cd=np.full(count, peak_cd * mean_over_directions(table)),
        radii_m=np.full(count, settings.luminaire.radius_m),
    )


# ---- The path and the rule -----------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Path:
    """Path of the recording car, seen from above, continued straight at both ends."""

    points_m: Float64[np.ndarray, "P 3"]
    """Corners of the path, metres; P is 0 where there is no path."""
    lengths_m: Float64[np.ndarray, "P"]
    """Distance along the path of each corner, metres; 0 at the first recorded place."""


# Distance below which positions are noise of a car that stands, metres.
_MIN_STEP_M = 0.5


def _path_of(scene: Scene) -> _Path:
    """Return the path of the recording car."""
    frames = scene.frames if scene.seen_frames is None else scene.seen_frames
    frames = sorted(frames or scene.frames, key=lambda frame: frame.timestamp_ns)
    if not frames:
        return _Path(np.zeros((0, 3)), np.zeros(0))
    poses = [frame.world_from_ego.double().numpy() for frame in frames]
    corners = [poses[0][:3, 3]]
    for pose in poses[1:]:
        if np.hypot(*(pose[:3, 3] - corners[-1])[:2]) >= _MIN_STEP_M:
            corners.append(pose[:3, 3])
    first = _level(poses[0][:3, 0]) if len(corners) < 2 else _level(corners[1] - corners[0])
    last = first if len(corners) < 2 else _level(corners[-1] - corners[-2])
    points = np.array([corners[0] - REACH_M * first, *corners, corners[-1] + REACH_M * last])
    steps = np.hypot(*np.diff(points[:, :2], axis=0).T)
    return _Path(points, np.concatenate([[0.0], np.cumsum(steps)]) - REACH_M)


def _level(vector: np.ndarray) -> np.ndarray:
    """Return the unit vector of a direction's level part; +x where it has none."""
    length = float(np.hypot(vector[0], vector[1]))
    if length < 1e-6:
        return np.array([1.0, 0.0, 0.0])
    return np.array([vector[0] / length, vector[1] / length, 0.0])


def _rule_places(
    scene: Scene, path: _Path, settings: StreetLampSettings
) -> tuple[Float64[np.ndarray, "M 3"], Float64[np.ndarray, "M 3"]]:
    """Return the places and axes of lamps along a path, without those that surfaces hide.

    A lamp hangs at a mast where one stands nearby (`unnamed_masts`). A lamp behind a front moves
    towards the road, by a metre at a time; it is dropped where no place is free.
    """
    positions: list[np.ndarray] = []
    axes: list[np.ndarray] = []
    if len(path.points_m):
        heights = RoadHeights.of_scene(scene)
        walls = _Walls.of_scene(scene)
        masts = unnamed_masts(scene)
        numbers = np.arange(
            np.ceil(path.lengths_m[0] / settings.spacing_m),
            np.floor(path.lengths_m[-1] / settings.spacing_m) + 1,
        )[:MAX_RULE_LAMPS]
        for number in numbers.astype(int):
            middle, heading = _point_at(path, number * settings.spacing_m)
            side = 1.0 if number % 2 == 0 else -1.0
            left = np.array([-heading[1], heading[0], 0.0])
            middle[2] = heights.height_at(middle, float(middle[2])) + settings.height_m
            offsets_m = np.arange(settings.offset_m, 0.0, -1.0) if settings.offset_m else [0.0]
            at_mast = _at_mast(masts, middle, heading, side, settings)
            free_places = [middle + side * offset_m * left for offset_m in offsets_m]
            for position in [*at_mast, *free_places]:
                if not walls.cross(middle, position):
                    positions.append(position)
                    axes.append(side * heading)  # so that the road lies to the axis's right
                    break
    shape = (len(positions), 3)
    return np.array(positions).reshape(shape), np.array(axes).reshape(shape)


# Distances from the path between which masts count, metres: one nearer stands on the carriageway.
_MAST_OFFSETS_M = (3.5, 11.0)
# Length of the arm by which a lamp reaches from its mast towards the road, metres.
_ARM_M = 1.5


def _at_mast(
    masts_m: Float64[np.ndarray, "N 3"],
    middle_m: Float64[np.ndarray, "3"],
    heading: Float64[np.ndarray, "3"],
    side: float,
    settings: StreetLampSettings,
) -> list[np.ndarray]:
    """Return the place of a lamp at the mast that is nearest to its turn; none without one.

    Args:
        masts_m: feet of the masts.
        middle_m: the lamp's turn: a point over the path, at the height of the lamps.
        heading: level direction of the path there.
        side: 1 for masts on the left, -1 for those on the right.
        settings: spacing of the lamps.
    """
    left = np.array([-heading[1], heading[0], 0.0])
    offsets = masts_m - middle_m
    along_m = offsets @ heading
    across_m = side * (offsets @ left)
    low_m, high_m = _MAST_OFFSETS_M
    is_near = (across_m >= low_m) & (across_m <= high_m)
    is_near &= np.abs(along_m) < settings.spacing_m / 2
    if not is_near.any():
        return []
    nearest = np.where(is_near, np.abs(along_m), np.inf).argmin()
    reach_m = across_m[nearest] - _ARM_M
    return [middle_m + along_m[nearest] * heading + side * reach_m * left]


def _point_at(path: _Path, length_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the point of a path at a distance along it, and the level heading there."""
    point = np.array([np.interp(length_m, path.lengths_m, c) for c in path.points_m.T])
    row = int(np.clip(np.searchsorted(path.lengths_m, length_m, side="right") - 1, 0, None))
    row = min(row, len(path.points_m) - 2)
    return point, _level(path.points_m[row + 1] - path.points_m[row])


def _axes_along_road(
    positions_m: Float64[np.ndarray, "M 3"], feet_m: Float64[np.ndarray, "M 3"], path: _Path
) -> Float64[np.ndarray, "M 3"]:
    """Return the axes of lamps on masts: at right angles to their arms, else along the path.

    The road lies to the right of each axis, where the arm reaches.
    """
    axes = np.tile(np.array([1.0, 0.0, 0.0]), (len(positions_m), 1))
    for i, (position, foot) in enumerate(zip(positions_m, feet_m, strict=True)):
        arm = position - foot
        arm[2] = 0.0
        if np.hypot(*arm[:2]) >= _MIN_ARM_M:
            unit = _level(arm)
            axes[i] = [-unit[1], unit[0], 0.0]
        elif len(path.points_m):
            distances = np.hypot(*(path.points_m[:, :2] - position[:2]).T)
            near = int(np.clip(distances.argmin(), 1, len(distances) - 2))
            heading = _level(path.points_m[near + 1] - path.points_m[near - 1])
            offset = path.points_m[near, :2] - position[:2]
            is_right = offset[0] * heading[1] - offset[1] * heading[0] >= 0
            axes[i] = heading if is_right else -heading
    return axes


# Length of an arm from which on it tells the direction of the road, metres.
_MIN_ARM_M = 0.4


# ---- Surfaces ------------------------------------------------------------------------------------

# Share of a ray's light that surfaces may take before a lamp counts as behind them.
_MAX_HIDDEN = 0.7
# Standard deviations within which a Gaussian is looked at.
_REACH_SIGMAS = 3.0


@dataclass(frozen=True, eq=False)
class _Walls:
    """Solid Gaussians of a scene's background, without vegetation and masts."""

    means: np.ndarray
    """Centres, metres, float32 [N, 3]."""
    rows: np.ndarray
    """Row of each in the background, int64 [N]."""
    scene: Scene
    """The scene."""

    @staticmethod
    def of_scene(scene: Scene) -> _Walls:
        """Return the solid Gaussians of a scene."""
        background = scene.background
        is_solid = background.opacities.detach().numpy() > 0.3
        if background.semantic is not None:
            open_classes = [
                int(c) for c in (SemanticClass.VEGETATION, SemanticClass.POLE, SemanticClass.SKY)
            ]
            is_solid &= ~np.isin(background.semantic.numpy(), open_classes)
        rows = np.flatnonzero(is_solid)
        return _Walls(background.means.detach().numpy()[rows], rows, scene)

    def _near(self, low_m: np.ndarray, high_m: np.ndarray) -> np.ndarray:
        """Return the rows of Gaussians with centres in a box, metres."""
        is_near = ((self.means >= low_m) & (self.means <= high_m)).all(1)
        return self.rows[is_near]

    def hidden_share(self, start_m: Float[np.ndarray, "3"], end_m: Float[np.ndarray, "3"]) -> float:
        """Return the share of light that Gaussians take on the way from one place to another.

        Each takes its opacity at the point of the segment that is nearest to its middle.
        """
        margin_m = 1.5
        low = np.minimum(start_m, end_m) - margin_m
        high = np.maximum(start_m, end_m) + margin_m
        rows = self._near(low, high)
        if len(rows) == 0:
            return 0.0
        background = self.scene.background
        ids = np.asarray(rows)
        scales = background.scales.detach()[ids].double().numpy()
        axes = rotmat_from_quat(background.quats.detach()[ids]).double().numpy()
        opacities = background.opacities.detach()[ids].double().numpy()
        offsets = background.means.detach()[ids].double().numpy() - start_m
        # In units of each Gaussian's standard deviations.
        local = np.einsum("nji,nj->ni", axes, offsets) / scales
        ray = np.einsum("nji,j->ni", axes, np.asarray(end_m, float) - start_m) / scales
        squares = np.maximum((ray**2).sum(1), 1e-12)
        share = np.clip((local * ray).sum(1) / squares, 0, 1)
        distances = ((local - share[:, None] * ray) ** 2).sum(1)
        alphas = opacities * np.exp(-0.5 * distances) * (distances < _REACH_SIGMAS**2)
        return float(1 - np.prod(1 - np.minimum(alphas, 0.999)))

    def cross(self, start_m: Float[np.ndarray, "3"], end_m: Float[np.ndarray, "3"]) -> bool:
        """Return True if surfaces stand between two places, or at the second one."""
        return self.hidden_share(start_m, end_m) > _MAX_HIDDEN


# ---- Lamps of a list -----------------------------------------------------------------------------


@dataclass(frozen=True)
class ListedLamp:
    """A lamp that a recipe states."""

    position_m: tuple[float, float, float]
    """Place in the dataset's world, metres."""
    direction: tuple[float, float, float]
    """Direction in which it shines, of any length but zero. For a street lamp: down, or along the
    road."""
    intensity_cd: float
    """Intensity in its brightest direction, candela."""
    kind: LampKind = LampKind.OTHER
    """Kind of the lamp, which chooses its pattern."""
    temperature_k: float = 3_000.0
    """Colour temperature, kelvin; red and amber lamps have their own colour."""


_PATTERN_OF_KIND = {
    LampKind.DIPPED: Pattern.DIPPED_RIGHT,
    LampKind.HIGH: Pattern.HIGH_BEAM,
    LampKind.TAIL: Pattern.REAR,
    LampKind.STOP: Pattern.REAR,
    LampKind.REAR_FOG: Pattern.REAR,
    LampKind.FRONT_FOG: Pattern.FRONT_FOG,
    LampKind.INDICATOR: Pattern.REAR,
    LampKind.DAYTIME: Pattern.DAYTIME,
    LampKind.STREET: Pattern.STREET,
    LampKind.SIGNAL: Pattern.SIGNAL,
    LampKind.WINDOW: Pattern.LAMBERT,
    LampKind.OTHER: Pattern.ISOTROPIC,
}
# Depth under the road up to which a place counts as a rounding error, metres.
_MAX_DEPTH_M = 0.05
# Half length of the way through a lamp that must be free of surfaces, metres.
_FREE_M = 0.02


def listed_lamps(scene: Scene, entries: Sequence[ListedLamp]) -> Lamps:
    """Return the lamps of a list in the scene's world.

    Args:
        scene: the scene.
        entries: the lamps, in the dataset's world.

    Raises:
        LampError: there are more than MAX_LISTED_LAMPS; a number is not finite or an intensity
            negative; a direction is zero; a lamp lies under the road or within a surface.
    """
    if len(entries) > MAX_LISTED_LAMPS:
        raise LampError(
            f"a recipe may list at most {MAX_LISTED_LAMPS} lamps; got {len(entries)}. Leave out "
            f"those that no camera sees"
        )
    heights = RoadHeights.of_scene(scene)
    walls = _Walls.of_scene(scene) if entries else None
    parts: list[Lamps] = []
    for number, entry in enumerate(entries):
        where = f"lamp {number} of the list, a {LampKind(entry.kind).name} lamp"
        _check_entry(entry, where)
        position = np.array(entry.position_m, np.float64) - scene.world_origin_m
        ground_m = heights.height_at(position, -np.inf)
        if position[2] < ground_m - _MAX_DEPTH_M:
            raise LampError(
                f"{where}, lies {ground_m - position[2]:.2f} m under the road: its place is "
                f"{list(entry.position_m)} m and the road there has height "
                f"{ground_m + scene.world_origin_m[2]:.2f} m. Positions are in the dataset's world"
            )
        assert walls is not None
        half = np.array([0.0, 0.0, _FREE_M])
        if walls.cross(position - half, position + half):
            raise LampError(
                f"{where}, lies within a surface at {list(entry.position_m)} m. Move it into the "
                f"open: a few centimetres before a wall are enough"
            )
        parts.append(_listed_lamp(entry, position))
    return Lamps.concatenate(parts)


def _check_entry(entry: ListedLamp, where: str) -> None:
    """Raise LampError unless an entry's numbers are those of a lamp."""
    numbers = [*entry.position_m, *entry.direction, entry.intensity_cd]
    if not np.isfinite(numbers).all():
        raise LampError(f"{where}: position, direction and candela must be finite; got {numbers}")
    if entry.intensity_cd < 0:
        raise LampError(f"{where}: candela must be >= 0; got {entry.intensity_cd}")
    if np.linalg.norm(entry.direction) < 1e-9:
        raise LampError(f"{where}: its direction must not be zero; got {list(entry.direction)}")


def _listed_lamp(entry: ListedLamp, position_m: Float64[np.ndarray, "3"]) -> Lamps:
    """Return one lamp of a list."""
    pattern = _PATTERN_OF_KIND[LampKind(entry.kind)]
    reds = (LampKind.TAIL, LampKind.STOP, LampKind.REAR_FOG)
    if entry.kind in reds:
        color = RED
    elif entry.kind == LampKind.INDICATOR:
        color = AMBER
    else:
        color = color_of_temperature(entry.temperature_k)
    radius_m = _RADIUS_M if entry.kind == LampKind.STREET else 0.05
    lamp_type = LampType(LampKind(entry.kind), pattern, entry.intensity_cd, color, radius_m)
    axis = np.array([entry.direction], np.float64)
    axis /= np.linalg.norm(axis)
    if entry.kind == LampKind.STREET:  # it hangs level: only the direction along the road counts
        axis = _level(axis[0])[None]
    up = (0.0, 0.0, 1.0) if abs(axis[0, 2]) < 0.999 else (1.0, 0.0, 0.0)
    return make_lamps(position_m[None], axis, lamp_type, up=up)
