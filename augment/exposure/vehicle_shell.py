"""Smooth shell over a vehicle: roof, bonnet, boot or bed, and the glass between them.

Input: the vehicle's points in the frame of its box, and which of them face upwards. Output: a
`VehicleShell`, which gives the height of the surface everywhere over the vehicle's plan. It has no
holes, since it is a fitted form and not a map of points. Callers: `vehicle_cells`.

1. `_side_heights` takes the height of the upper surface at stations along the vehicle, from the
   points of both sides, laid over each other.
2. `_fit_forms` fits the line of knots of each form in question (`vehicle_forms`) by Gauss-Newton
   steps, with weights of Cauchy's that are drawn in from step to step (iteratively reweighted
   least squares). The form with the least cost counts.
3. `_follow_points` moves the line towards the points, smoothly, and no further than
   `MAX_CORRECTION_M`.
4. Widths and curvature across are taken from the points as well, as far as there are any.

Coordinates: x forward, y left, z up from the *bottom* of the box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from augment.exposure.vehicle_forms import (
    KNOT_X_SIGMAS,
    KNOT_Z_SIGMAS,
    NUM_KNOTS,
    VehicleForm,
    forms_of_label,
)

STATION_M = 0.05  # distance between stations along the vehicle
MIN_POINTS = 40  # fewest points that a shell is fitted to
_MAX_STRAY_SHARE = 0.6  # largest share of stations that lie off the fitted line
_MAX_AT_LIMIT = 1  # largest number of coordinates of knots at the limit of their form
_LIMIT_SHARE = 0.98  # share of the largest shift from which on a coordinate is at that limit
_MAX_ABOVE_SHARE = 0.25  # largest share of those that lie above it
_STRAY_M = 0.12  # distance off the line from which a station is astray
# Height over the box up to which a point can be the vehicle's, metres.
_MAX_HEIGHT_OVER_BOX_M = 0.06
_MIN_HEIGHT_SHARE = 0.25  # lower points, in heights of the box, are wheels and bumpers
# Half width in which points count, in half widths of the box: at the belt line, and at the roof,
# beyond which only poles, walls and mirrors stand.
_BELT_WIDTH = 0.97
_ROOF_WIDTH = 0.75
_BELT_HEIGHT_SHARE = 0.62  # height of the belt line, in heights of the box
_SUPPORT_RANGE_M = 0.05  # range of heights within which a surface has its points
_NUM_SUPPORTERS = 3  # number of further points in that range
_TOP_DEPTH_M = 0.08  # depth below the highest such point down to which points are the surface
_TOP_SLACK_M = 0.02  # height above it up to which they are
_TOP_QUANTILE = 0.6  # quantile of their heights that counts
_ALL_POINTS_WEIGHT = 0.3  # weight of heights from points that do not face upwards
_KEY_STEP_M = 1000.0  # step of sorting keys between stations, far above any height
_FULL_COUNT = 6  # number of points at a station from which on it has full weight

_NUM_STEPS = 14  # largest number of Gauss-Newton steps
_NUM_SCALE_STEPS = 9  # number of steps in which the scale of Cauchy's weights is drawn in
_MIN_STEP_M = 0.003  # largest step of any knot at which the fit ends
_MAX_STEP_M = 0.15  # largest step of a knot
_MAX_KNOT_SHIFT = 3.5  # largest shift of a knot from its form, in standard deviations
_MAX_END_RISE_M = 0.02  # largest rise of a bonnet or boot towards its end
_MIN_KNOT_GAP_M = 0.03  # least distance between knots along the vehicle
_HEIGHT_SIGMA_M = 0.03  # standard deviation of a station's height
_STATION_WEIGHT = 0.5  # weight of a station, since neighbours share points
_FIRST_SCALE_M = 0.25  # scale of Cauchy's weights in the first step
_LAST_SCALE_M = 0.04  # scale in the last steps; what lies lower may be the interior
_UPPER_SCALE_M = 0.08  # least scale for points above the line: nothing floats within a box
_COST_SCALE_M = 0.05  # scale for stations below the line, when forms are compared
_ANCHOR_GAP_M = 0.06  # distance beyond the box of the feet of the two end faces
_ANCHOR_HEIGHT_SHARE = 0.2  # height of those feet, in heights of the box

MAX_CORRECTION_M = 0.08  # largest distance of the shell from its form
_CORRECTION_SIGMA_M = 0.12  # standard deviation of the blur of that distance along the vehicle
_FORM_WEIGHT = 0.8  # weight of no correction, in stations
_EDGE_BLUR_M = 0.05  # standard deviation of the blur that rounds the knots

_CROWN_M = 0.05  # usual fall of a surface from the middle to _CROWN_WIDTH
_CROWN_WIDTH = 0.8  # in half widths of the box
_CROWN_SIGMA_M = 0.02  # standard deviation of that fall
_MAX_CROWN_M = 0.12  # largest fall
_CROWN_POINT_SIGMA_M = 0.2  # standard deviation of a point; many points share their error
_SURFACE_SLACK_M = 0.05  # distance from the line within which a point is on the surface
_EDGE_SLACK_M = 0.035  # the same for points that tell a width
_WIDTH_QUANTILE = 0.95  # quantile of the points' distances from the middle that is the edge
_MIN_EDGE_POINTS = 12  # fewest points that tell a width
_FULL_EDGE_POINTS = 100  # number of points from which on they alone tell it
# Usual half widths and their limits, in half widths of the box: roof, bonnet, boot.
_ROOF_HALF = (0.67, 0.58, 0.86)
_BONNET_HALF = (0.80, 0.70, 0.90)
_BOOT_HALF = (0.78, 0.66, 0.88)
_CORNER_M = 0.3  # length over which the plan narrows towards its ends
_RIM_M = 0.01  # width of the rim of roof, bonnet and boot that holds nothing
# The same at the ends of boot, roof and bonnet, as a shift of the knots.
_KNOT_INSETS_M = np.array([0.04, 0.0, 0.02, -0.02, 0.0, -0.05])
# Largest width of the pillars beside windscreen and rear window. They hold nothing, and end at the
# roof and at the bonnet or boot.
_PILLAR_M = 0.08
_CORNER_NARROWING = 0.25  # share of the width that it loses there
_MIN_BOOT_LENGTH_M = 0.25  # a shorter boot is the rim of a hatch
# Steepest rear window over a boot shorter than the following length; below a steeper one lies the
# face of a hatch.
_MAX_REAR_SLOPE = 1.0
_MIN_STEEP_BOOT_LENGTH_M = 0.6
_BED_DEPTH_M = 0.48  # usual depth of a bed below its rails
_BED_WALL_M = 0.08  # thickness of a bed's walls
_MIN_BED_STEP_M = 0.2  # least depth of a bed's floor below the rails
_MIN_BED_POINTS = 10  # fewest points that tell a bed's floor, or a cover over it


class VehiclePart(IntEnum):
    """Parts of a vehicle seen from above."""

    SIDE = 0  # sides, ends, sills and mirrors, which hold nothing
    ROOF = 1
    BONNET = 2
    BOOT = 3  # lid of a boot, or the cover of a bed
    BED = 4  # floor of an open bed
    WINDSCREEN = 5
    REAR_WINDOW = 6


GLASS_PARTS = (VehiclePart.WINDSCREEN, VehiclePart.REAR_WINDOW)


class ShellSample(NamedTuple):
    """Shell at N places of the vehicle's plan."""

    z_m: np.ndarray  # float64 [N], height in the box's frame, from its centre
    slopes: np.ndarray  # float64 [N, 2], dz/dx and dz/dy, box's frame
    parts: np.ndarray  # int8 [N], VehiclePart
    # float64 [N], rise over run of the part: of glass, that between its two edges, so that a
    # pane is covered as a whole or not at all.
    steepness: np.ndarray
    # float64 [N], distance behind the front end of the bonnet in lengths of the bonnet; 0 at the
    # front end.
    bonnet_share: np.ndarray
    pane_edge_m: np.ndarray  # float64 [N], level distance from the nearer end of a glass pane


@dataclass(frozen=True, eq=False)
class VehicleShell:
    """Surface of a vehicle over its plan, in the frame of its box."""

    size_m: tuple[float, float, float]
    """Length, width and height of the box."""
    form: VehicleForm
    """Form that the shell was fitted from."""
    knots_x_m: np.ndarray
    """Places of the knots along the vehicle, float64 [6], see vehicle_forms."""
    knots_z_m: np.ndarray
    """Heights of the knots over the bottom of the box, float64 [6]."""
    stations_m: np.ndarray
    """Places of the stations along the vehicle, float64 [K]."""
    heights_m: np.ndarray
    """Heights of the middle line at the stations over the bottom of the box, float64 [K]."""
    roof_half_m: float
    """Half width of the roof."""
    bonnet_half_m: float
    """Half width of the bonnet."""
    boot_half_m: float
    """Half width of the boot or bed."""
    crown_m: float
    """Fall of the surface from the middle to 0.8 half widths of the box."""
    bed_z_m: float | None
    """Height of the floor of an open bed over the bottom of the box; None without one."""

    def sample(self, xy_m: np.ndarray) -> ShellSample:
        """Return the shell at places [N, 2] of the box's frame."""
        x = xy_m[:, 0]
        y = xy_m[:, 1]
        half_height = self.size_m[2] / 2
        knots = self.knots_x_m
        heights = np.interp(x, self.stations_m, self.heights_m)
        slope_x = np.interp(x, self.stations_m, np.gradient(self.heights_m, self.stations_m))
        crown_per_m2 = self.crown_m / (_CROWN_WIDTH * self.size_m[1] / 2) ** 2
        z = heights - crown_per_m2 * y**2
        slope_y = -2 * crown_per_m2 * y
        segment = np.searchsorted(knots + _KNOT_INSETS_M, x, side="right")  # 1 to 5 between them
        parts = _PARTS_OF_SEGMENTS[segment]
        steepness = np.hypot(slope_x, slope_y)
        chords = np.abs(np.diff(self.knots_z_m) / np.diff(knots))
        is_glass = (parts == VehiclePart.WINDSCREEN) | (parts == VehiclePart.REAR_WINDOW)
        if self.form.has_upright_rear:
            chords[1] = np.inf
        if self.form.has_upright_front:
            chords[3] = np.inf
        steepness[is_glass] = chords[segment[is_glass] - 1]
        boot_length = knots[1] - knots[0]
        is_hatch = chords[1] > _MAX_REAR_SLOPE and boot_length < _MIN_STEEP_BOOT_LENGTH_M
        if boot_length < _MIN_BOOT_LENGTH_M or is_hatch:
            parts[parts == VehiclePart.BOOT] = VehiclePart.SIDE
        is_side = np.abs(y) > self.half_width_m(x)
        parts[is_side] = VehiclePart.SIDE
        is_low = parts == VehiclePart.SIDE
        z[is_low] = np.minimum(z[is_low], _MIN_HEIGHT_SHARE * self.size_m[2])
        if self.bed_z_m is not None:
            self._lower_bed(x, y, z, parts)
            is_bed = parts == VehiclePart.BED
            slope_x = np.where(is_bed, 0.0, slope_x)
            slope_y = np.where(is_bed, 0.0, slope_y)
            steepness[is_bed] = 0.0
        bonnet_share = (knots[5] - x) / (knots[5] - knots[4])
        slopes = np.stack([slope_x, slope_y], 1)
        ends = np.concatenate([knots[:1], knots, knots[-1:]])
        pane_edge = np.minimum(x - ends[segment], ends[segment + 1] - x)
        return ShellSample(z - half_height, slopes, parts, steepness, bonnet_share, pane_edge)

    def half_width_m(self, x: np.ndarray) -> np.ndarray:
        """Return the half width of what is seen from above at places along the vehicle, [N]."""
        knots = self.knots_x_m
        widths = (
            self.boot_half_m,
            self.boot_half_m,
            self.roof_half_m,
            self.roof_half_m,
            self.bonnet_half_m,
            self.bonnet_half_m,
        )
        half = np.interp(x, knots, widths)
        for start, end in ((1, 2), (3, 4)):
            share = np.clip((x - knots[start]) / (knots[end] - knots[start]), 0, 1)
            half = half - 4 * share * (1 - share) * _PILLAR_M
        to_end = np.minimum(knots[5] - x, x - knots[0])
        corner = np.clip(1 - to_end / _CORNER_M, 0, 1)
        return half * (1 - _CORNER_NARROWING * corner**2) - _RIM_M

    def _lower_bed(self, x: np.ndarray, y: np.ndarray, z: np.ndarray, parts: np.ndarray) -> None:
        """Lower the boot to the floor of the bed, in place; its walls hold nothing."""
        assert self.bed_z_m is not None
        is_boot = parts == VehiclePart.BOOT
        is_floor = (
            is_boot
            & (x > self.knots_x_m[0] + _BED_WALL_M)
            & (x < self.knots_x_m[1] - _BED_WALL_M)
            & (np.abs(y) < self.boot_half_m - _BED_WALL_M)
        )
        parts[is_boot] = VehiclePart.SIDE
        parts[is_floor] = VehiclePart.BED
        z[is_floor] = self.bed_z_m


# Parts between the knots, and SIDE before the first and after the last.
_PARTS_OF_SEGMENTS = np.array(
    [
        VehiclePart.SIDE,
        VehiclePart.BOOT,
        VehiclePart.REAR_WINDOW,
        VehiclePart.ROOF,
        VehiclePart.WINDSCREEN,
        VehiclePart.BONNET,
        VehiclePart.SIDE,
    ],
    np.int8,
)


def fit_shell(
    points_m: np.ndarray, is_facing_up: np.ndarray, label: str, size_m: tuple[float, float, float]
) -> VehicleShell | None:
    """Fit a shell to a vehicle; None where its form is not known, or points are too few.

    Args:
        points_m: float64 [N, 3], points of the vehicle, in the frame of its box.
        is_facing_up: bool [N], True for points of a surface that faces upwards rather than aside.
        label: the dataset's name for the kind of vehicle.
        size_m: length, width and height of its box.
    """
    forms = forms_of_label(label, size_m[2])
    if not forms or not np.isfinite(size_m).all() or min(size_m) <= 0:
        return None
    points = _body_points(points_m, is_facing_up, size_m)
    if len(points.x) < MIN_POINTS:
        return None
    stations = _stations(size_m[0])
    sides = [
        _side_heights(points.x[chosen], points.lifted_z[chosen], stations)
        for chosen in (points.is_facing_up, np.ones(len(points.x), bool))
    ]
    heights = np.concatenate([sides[0].heights_m, sides[1].heights_m])
    weights = np.concatenate([sides[0].weights, _ALL_POINTS_WEIGHT * sides[1].weights])
    fit = _fit_forms(forms, stations, heights, weights, size_m)
    line, segments = _lines(fit.knots[None], stations, size_m, np.array([fit.rise_m]))[:2]
    if fit.num_at_limit > _MAX_AT_LIMIT or not _is_likely(sides, line[0]):
        return None
    heights_m = _follow_points(line[0], segments[0], stations, heights, weights)
    return _measure_across(fit, points, stations, heights_m, size_m)


class _BodyPoints(NamedTuple):
    """Points of a vehicle's upper body."""

    x: np.ndarray  # float64 [N], place along the vehicle
    half: np.ndarray  # float64 [N], distance from the middle plane, in half widths of the box
    z: np.ndarray  # float64 [N], height over the bottom of the box
    lifted_z: np.ndarray  # float64 [N], z that the surface has in the middle, if it has its crown
    is_facing_up: np.ndarray  # bool [N]


def _body_points(
    points_m: np.ndarray, is_facing_up: np.ndarray, size_m: tuple[float, float, float]
) -> _BodyPoints:
    """Return the points that can be roof, glass, bonnet or boot, both sides laid together."""
    z = points_m[:, 2] + size_m[2] / 2
    half = np.abs(points_m[:, 1]) / (size_m[1] / 2)
    above_belt = np.clip((z / size_m[2] - _BELT_HEIGHT_SHARE) / (1 - _BELT_HEIGHT_SHARE), 0, 1)
    is_body = (
        (z < size_m[2] + _MAX_HEIGHT_OVER_BOX_M)
        & (z > _MIN_HEIGHT_SHARE * size_m[2])
        & (half < _BELT_WIDTH + (_ROOF_WIDTH - _BELT_WIDTH) * above_belt)
        & (np.abs(points_m[:, 0]) < size_m[0] / 2)
    )
    z = z[is_body]
    half = half[is_body]
    lifted_z = z + _CROWN_M * np.minimum(half / _CROWN_WIDTH, 1) ** 2
    return _BodyPoints(points_m[is_body, 0], half, z, lifted_z, is_facing_up[is_body])


def _stations(length_m: float) -> np.ndarray:
    """Return the places of the stations along a vehicle of this length."""
    count = max(2, int(np.ceil(length_m / STATION_M)))
    return (np.arange(count) + 0.5 - count / 2) * STATION_M


class _SideHeights(NamedTuple):
    """Heights of a vehicle's upper surface at K stations."""

    heights_m: np.ndarray  # float64 [K]
    weights: np.ndarray  # float64 [K], 0 where there is no height


def _side_heights(x: np.ndarray, z: np.ndarray, stations: np.ndarray) -> _SideHeights:
    """Return the height of the highest surface at each station.

    Points of the neighbouring stations count where a station has too few, since they would carry a
    roof beyond its ends.
    """
    nearest = np.floor((x - stations[0]) / STATION_M + 0.5).astype(np.int64)
    alone = _surface_heights(nearest, z, len(stations))
    is_known = alone.weights > 0
    around = np.concatenate([nearest - 1, nearest, nearest + 1])
    is_needed = (around >= 0) & (around < len(stations))
    is_needed[is_needed] = ~is_known[around[is_needed]]
    together = _surface_heights(around[is_needed], np.tile(z, 3)[is_needed], len(stations))
    return _SideHeights(
        np.where(is_known, alone.heights_m, together.heights_m),
        np.where(is_known, alone.weights, together.weights),
    )


def _surface_heights(station: np.ndarray, z: np.ndarray, count: int) -> _SideHeights:
    """Return the height of the highest surface of each of `count` stations.

    A surface has several points within _SUPPORT_RANGE_M; a stray point above it is none.

    Args:
        station: station of each point, int64 [N].
        z: height of each point, float64 [N].
        count: number of stations.
    """
    heights = np.zeros(count)
    weights = np.zeros(count)
    is_inside = (station >= 0) & (station < count)
    station = station[is_inside]
    z = z[is_inside]
    # Keys rise with the station, and within a station as z falls.
    keys = _KEY_STEP_M * station - z
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    station = station[order]
    z = z[order]
    if len(z) <= _NUM_SUPPORTERS:
        return _SideHeights(heights, weights)
    is_supported = (station[_NUM_SUPPORTERS:] == station[:-_NUM_SUPPORTERS]) & (
        z[:-_NUM_SUPPORTERS] - z[_NUM_SUPPORTERS:] < _SUPPORT_RANGE_M
    )
    supported_rows = np.flatnonzero(is_supported)
    found_stations, first = np.unique(station[supported_rows], return_index=True)
    tops = z[supported_rows[first]]
    starts = np.searchsorted(station, found_stations, side="left")
    ends = np.searchsorted(station, found_stations, side="right")
    lows = np.searchsorted(keys, _KEY_STEP_M * found_stations - (tops + _TOP_SLACK_M))
    highs = np.searchsorted(keys, _KEY_STEP_M * found_stations - (tops - _TOP_DEPTH_M))
    index = np.clip(lows, starts, None) + (1 - _TOP_QUANTILE) * (
        np.minimum(highs, ends) - 1 - np.clip(lows, starts, None)
    )
    heights[found_stations] = z[np.round(index).astype(np.int64)]
    weights[found_stations] = np.minimum((ends - starts) / _FULL_COUNT, 1.0)
    return _SideHeights(heights, weights)


def _is_likely(sides: Sequence[_SideHeights], line: np.ndarray) -> bool:
    """Return True if a fitted line agrees with the points.

    Points below the line may be the interior. Surfaces above it cannot be.

    Args:
        sides: heights of points that face upwards, and of all points.
        line: the fitted heights, float64 [K].
    """
    is_known = sides[1].weights > 0
    is_astray = is_known & (np.abs(sides[1].heights_m - line) > _STRAY_M)
    faces_up = sides[0].weights > 0
    is_above = faces_up & (sides[0].heights_m > line + _STRAY_M)
    return bool(
        is_astray.sum() <= _MAX_STRAY_SHARE * is_known.sum()
        and is_above.sum() <= _MAX_ABOVE_SHARE * faces_up.sum()
    )


# ---- Fit of the forms ----------------------------------------------------------------------------


class _FormFit(NamedTuple):
    """Fitted line of knots."""

    form: VehicleForm
    knots: np.ndarray  # float64 [12], x of the knots, then their heights
    rise_m: float  # rise of the roof's middle
    num_at_limit: int  # number of coordinates of knots that are as far off the form as may be


def _lines(
    knots: np.ndarray, x: np.ndarray, size_m: tuple[float, float, float], rises_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return F lines of knots at places [N].

    Args:
        knots: float64 [F, 12], x of the knots, then their heights.
        x: places along the vehicle.
        size_m: size of the box.
        rises_m: float64 [F], rise of the roof's middle.

    Returns:
        Heights [F, N]; segments int64 [F, N], 0 to 6, 0 and 6 being the end faces; the derivatives
        of the heights by the knots [F, N, 12].
    """
    num_lines = len(knots)
    end_x = np.full((num_lines, 1), size_m[0] / 2 + _ANCHOR_GAP_M)
    end_z = np.full((num_lines, 1), _ANCHOR_HEIGHT_SHARE * size_m[2])
    all_x = np.concatenate([-end_x, knots[:, :NUM_KNOTS], end_x], 1)
    all_z = np.concatenate([end_z, knots[:, NUM_KNOTS:], end_z], 1)
    segments = (x[None, :, None] >= all_x[:, None, 1:-1]).sum(-1)
    starts = (NUM_KNOTS + 2) * np.arange(num_lines)[:, None] + segments
    left_x = all_x.ravel()[starts]
    right_x = all_x.ravel()[starts + 1]
    left_z = all_z.ravel()[starts]
    right_z = all_z.ravel()[starts + 1]
    length = np.maximum(right_x - left_x, 1e-3)
    t = np.clip((x - left_x) / length, 0, 1)
    slope = (right_z - left_z) / length
    is_roof = segments == 3
    heights = left_z + t * (right_z - left_z)
    heights = heights + np.where(is_roof, 4 * t * (1 - t) * rises_m[:, None], 0.0)
    # The share of each knot in each place; the feet of the end faces stay.
    knots_before = np.arange(1, NUM_KNOTS + 1) - segments[..., None]
    shares = np.where(knots_before == 0, (1 - t)[..., None], 0.0)
    shares += np.where(knots_before == 1, t[..., None], 0.0)
    derivatives = np.concatenate([-slope[..., None] * shares, shares], -1)
    return heights, segments, derivatives


def _fit_forms(
    forms: tuple[VehicleForm, ...],
    stations: np.ndarray,
    heights: np.ndarray,
    weights: np.ndarray,
    size_m: tuple[float, float, float],
) -> _FormFit:
    """Fit all forms and return the one with the least cost.

    Args:
        forms: the forms.
        stations: places of the stations, float64 [K].
        heights: heights of points that face upwards, then of all points, float64 [2 K].
        weights: their weights, float64 [2 K].
        size_m: size of the box.
    """
    length = size_m[0]
    height = size_m[2]
    x = np.tile(stations, 2)
    faces_up = np.arange(len(x)) < len(stations)
    is_known = weights > 0
    x = x[is_known]
    faces_up = faces_up[is_known]
    heights = heights[is_known]
    weights = weights[is_known]
    knot_scales = np.repeat([length, height], NUM_KNOTS)
    form_knots = knot_scales * np.array([[*form.knots_x, *form.knots_z] for form in forms])
    rises_m = np.array([form.roof_rise * height for form in forms])
    sigmas = knot_scales * np.array([*KNOT_X_SIGMAS, *KNOT_Z_SIGMAS])
    prior = np.diag(1 / sigmas**2)
    station_weights = _STATION_WEIGHT * weights / _HEIGHT_SIGMA_M**2
    knots = form_knots.copy()
    for step in range(_NUM_STEPS):
        last_knots = knots
        lines, _, derivatives = _lines(knots, x, size_m, rises_m)
        residuals = heights - lines
        progress = min(step / (_NUM_SCALE_STEPS - 1), 1.0)
        scale = _FIRST_SCALE_M * (_LAST_SCALE_M / _FIRST_SCALE_M) ** progress
        scales = np.where((residuals > 0) & faces_up, max(scale, _UPPER_SCALE_M), scale)
        w = station_weights / (1 + (residuals / scales) ** 2)
        weighted = (derivatives * w[..., None]).transpose(0, 2, 1)
        matrix = weighted @ derivatives + prior
        vector = (weighted @ residuals[..., None])[..., 0] + (form_knots - knots) / sigmas**2
        change = np.linalg.solve(matrix, vector[..., None])[..., 0]
        knots = knots + np.clip(change, -_MAX_STEP_M, _MAX_STEP_M)
        knots = np.clip(
            knots, form_knots - _MAX_KNOT_SHIFT * sigmas, form_knots + _MAX_KNOT_SHIFT * sigmas
        )
        for k in range(1, NUM_KNOTS):
            knots[:, k] = np.maximum(knots[:, k], knots[:, k - 1] + _MIN_KNOT_GAP_M)
        for end, inner in ((0, 1), (5, 4)):  # bonnet and boot fall towards their ends
            highest = knots[:, NUM_KNOTS + inner] + _MAX_END_RISE_M
            knots[:, NUM_KNOTS + end] = np.minimum(knots[:, NUM_KNOTS + end], highest)
        if progress == 1.0 and np.abs(knots - last_knots).max() < _MIN_STEP_M:
            break
    residuals = heights - _lines(knots, x, size_m, rises_m)[0]
    scales = np.where((residuals > 0) & faces_up, _UPPER_SCALE_M, _COST_SCALE_M)
    misfit = (station_weights * scales**2 * np.log1p((residuals / scales) ** 2)).sum(1)
    costs = misfit + (((knots - form_knots) / sigmas) ** 2).sum(1)
    best = int(costs.argmin())
    shifts = np.abs(knots[best] - form_knots[best]) / sigmas
    num_at_limit = int((shifts >= _LIMIT_SHARE * _MAX_KNOT_SHIFT).sum())
    return _FormFit(forms[best], knots[best], float(rises_m[best]), num_at_limit)


def _follow_points(
    line: np.ndarray,
    segments: np.ndarray,
    stations: np.ndarray,
    heights: np.ndarray,
    weights: np.ndarray,
) -> np.ndarray:
    """Return the line moved towards the points, float64 [K], with its knots rounded.

    Args:
        line: fitted heights, float64 [K].
        segments: segments of the stations, int64 [K].
        stations: places of the stations, float64 [K].
        heights: heights of the points, float64 [2 K].
        weights: their weights, float64 [2 K].
    """
    gaps = stations[:, None] - stations[None]
    blur = np.exp(-0.5 * (gaps / _CORRECTION_SIGMA_M) ** 2)
    blur *= segments[:, None] == segments[None]
    total = np.full(len(line), _FORM_WEIGHT)
    correction = np.zeros(len(line))
    for chosen in (slice(0, len(line)), slice(len(line), None)):
        residuals = heights[chosen] - line
        w = weights[chosen] / (1 + (residuals / _COST_SCALE_M) ** 4)
        total += blur @ w
        correction += blur @ (w * np.clip(residuals, -MAX_CORRECTION_M, MAX_CORRECTION_M))
    moved = line + correction / total
    rounding = np.exp(-0.5 * (gaps / _EDGE_BLUR_M) ** 2)
    # The end faces fall steeply, and would pull the ends down.
    is_end = (segments == 0) | (segments == NUM_KNOTS)
    rounding *= is_end[:, None] == is_end[None]
    return rounding @ moved / rounding.sum(1)


def _measure_across(
    fit: _FormFit,
    points: _BodyPoints,
    stations: np.ndarray,
    heights_m: np.ndarray,
    size_m: tuple[float, float, float],
) -> VehicleShell:
    """Return the shell, with the widths and the curvature that the points show."""
    knots_x = fit.knots[:NUM_KNOTS].copy()
    middle = np.interp(points.x, stations, heights_m)
    fall = middle - points.z
    lever = (points.half / _CROWN_WIDTH) ** 2
    is_top = points.is_facing_up & (np.abs(middle - points.lifted_z) < _SURFACE_SLACK_M)
    is_top &= (points.x > knots_x[2]) & (points.x < knots_x[3]) | (points.x > knots_x[4])
    precision = 1 / _CROWN_SIGMA_M**2 + (lever[is_top] ** 2).sum() / _CROWN_POINT_SIGMA_M**2
    crown = (
        _CROWN_M / _CROWN_SIGMA_M**2
        + (lever[is_top] * fall[is_top]).sum() / _CROWN_POINT_SIGMA_M**2
    ) / precision
    crown = float(np.clip(crown, 0, _MAX_CROWN_M))
    is_surface = np.abs(middle - crown * lever - points.z) < _EDGE_SLACK_M
    is_surface &= points.is_facing_up

    def half_width(first: int, second: int, limits: tuple[float, float, float]) -> float:
        """Return the half width between two knots, metres."""
        usual, low, high = limits
        is_between = (points.x > knots_x[first]) & (points.x < knots_x[second])
        edge_points = points.half[is_surface & is_between]
        width = usual
        if len(edge_points) >= _MIN_EDGE_POINTS:
            certainty = min(len(edge_points) / _FULL_EDGE_POINTS, 1.0)
            edge = float(np.quantile(edge_points, _WIDTH_QUANTILE))
            width = certainty * edge + (1 - certainty) * usual
        return float(np.clip(width, low, high)) * size_m[1] / 2

    return VehicleShell(
        size_m=(float(size_m[0]), float(size_m[1]), float(size_m[2])),
        form=fit.form,
        knots_x_m=knots_x,
        knots_z_m=fit.knots[NUM_KNOTS:].copy(),
        stations_m=stations,
        heights_m=heights_m,
        roof_half_m=half_width(2, 3, _ROOF_HALF),
        bonnet_half_m=half_width(4, 5, _BONNET_HALF),
        boot_half_m=half_width(0, 1, _BOOT_HALF),
        crown_m=crown,
        bed_z_m=_bed_height(fit, points, middle) if fit.form.has_bed else None,
    )


def _bed_height(fit: _FormFit, points: _BodyPoints, middle: np.ndarray) -> float | None:
    """Return the height of the floor of an open bed; None if a cover lies over it."""
    is_inner = (
        points.is_facing_up
        & (points.x > fit.knots[0] + _BED_WALL_M)
        & (points.x < fit.knots[1] - _BED_WALL_M)
        & (points.half < 0.6)
    )
    depth = middle - points.z
    num_cover = int((is_inner & (np.abs(depth) < _SURFACE_SLACK_M)).sum())
    floor_points = points.z[is_inner & (depth > _MIN_BED_STEP_M)]
    if num_cover >= max(_MIN_BED_POINTS, len(floor_points)):
        return None
    if len(floor_points) >= _MIN_BED_POINTS:
        return float(np.median(floor_points))
    rail_z = float(fit.knots[NUM_KNOTS : NUM_KNOTS + 2].mean())
    return rail_z - _BED_DEPTH_M
