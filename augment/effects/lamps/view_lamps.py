"""Lamps that are on in a view: of vehicles, the recording car, streets and the recipe's list."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from augment.effects.lamps.plan import LightPlan
from augment.errors import LampError
from augment.lamps.ies import MAX_BYTES, IesLuminaire, parse_ies
from augment.lamps.lamp import AMBER, GREEN, MAX_LAMPS, RED, LampKind, Lamps
from augment.lamps.street_lamps import ListedLamp as LampEntry
from augment.lamps.street_lamps import StreetLampSettings, listed_lamps, street_lamps
from augment.lamps.vehicle_lamps import (
    OwnLampSettings,
    VehicleLampSettings,
    own_lamps,
    vehicle_lamps,
)
from augment.memo import memo_of
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from recipes.files import read_files
from recipes.light import Light, ListedLamp

# Distance from the camera beyond which lamps are left out, metres.
MAX_DISTANCE_M = 500.0
# Part of the image's width by which a lamp by day may lie outside the image: its halo reaches in.
_MARGIN = 0.1
# Luminous intensity below which a lamp is dark, candela.
_MIN_CD = 1e-3
_KINDS = {
    "street": LampKind.STREET,
    "dipped": LampKind.DIPPED,
    "high": LampKind.HIGH,
    "tail": LampKind.TAIL,
    "stop": LampKind.STOP,
    "signal": LampKind.SIGNAL,
    "flood": LampKind.WINDOW,
    "bulb": LampKind.OTHER,
}
_COLORS = {"red": RED, "amber": AMBER, "green": GREEN}


def lamps_of_view(plan: LightPlan, scene: Scene, camera: Camera) -> Lamps:
    """Return the lamps that can matter in a view.

    At dusk and night these are all lamps within MAX_DISTANCE_M; by day those in the image, whose
    light is more than the day's.

    Args:
        plan: the plan.
        scene: the scene.
        camera: the view.
    """
    lamps = lamps_at(plan, scene, camera)
    if len(lamps) == 0:
        return lamps
    offsets = lamps.positions_m - camera.centre.numpy()
    distances_m = np.linalg.norm(offsets, axis=1)
    is_near = (distances_m < MAX_DISTANCE_M) & (lamps.intensities_cd > _MIN_CD)
    if not plan.hour.is_dark:
        points = offsets @ camera.camera_from_world[:3, :3].numpy().T
        z = np.maximum(points[:, 2], 1e-6)
        column = camera.fx * points[:, 0] / z + camera.cx
        row = camera.fy * points[:, 1] / z + camera.cy
        margin_px = _MARGIN * camera.width
        is_near &= (points[:, 2] > 0.2) & (
            np.abs(column - camera.width / 2) < margin_px + camera.width / 2
        )
        is_near &= np.abs(row - camera.height / 2) < margin_px + camera.height / 2
    if is_near.sum() > MAX_LAMPS:
        is_near[np.argsort(np.where(is_near, distances_m, math.inf), kind="stable")[MAX_LAMPS:]] = (
            False
        )
    return lamps.select(is_near)


def lamps_at(plan: LightPlan, scene: Scene, camera: Camera) -> Lamps:
    """Return all lamps that are on at the moment of a camera's image."""
    light = plan.light
    is_left = light.traffic == "left"
    parts = [fixed_lamps(plan, scene)]
    if plan.has_vehicle_lamps and light.vehicle_share > 0:
        settings = VehicleLampSettings(
            seed=plan.seed,
            lit_share=light.vehicle_share,
            parked_share=0.05 * light.vehicle_share,
            unknown_share=0.5 * light.vehicle_share,
            left_hand_traffic=is_left,
        )
        parts.append(vehicle_lamps(scene, camera.timestamp_ns, settings))
    if plan.own_beam != "off" and plan.hour.is_dark:
        beam = LampKind.HIGH if plan.own_beam == "high" else LampKind.DIPPED
        parts.append(own_lamps(scene, camera, OwnLampSettings(beam, left_hand_traffic=is_left)))
    return Lamps.concatenate(parts)


def fixed_lamps(plan: LightPlan, scene: Scene) -> Lamps:
    """Return street lamps and the recipe's list, which are the same at every moment."""
    light = plan.light
    scene = scene.as_recorded
    key = ("lamps, fixed", light, plan.has_street_lamps)
    return memo_of(scene).get(key, lambda: _make_fixed(plan, scene))


def describe_lamps(plan: LightPlan, scene: Scene, reason: str) -> str:
    """Return the lamps in words, for `explain`.

    Args:
        plan: the plan.
        scene: the scene.
        reason: why `auto` turns lamps on or not.
    """
    light = plan.light
    parts = []
    if plan.has_vehicle_lamps:
        parts.append(f"lamps of {100 * light.vehicle_share:.0f} % of the moving vehicles")
    if plan.own_beam != "off" and plan.hour.is_dark:
        parts.append(f"own {plan.own_beam} beams")
    if plan.has_street_lamps:
        num_listed = len(light.lamps or ())
        parts.append(f"{len(fixed_lamps(plan, scene)) - num_listed} street lamps")
    if light.lamps:
        parts.append(f"{len(light.lamps)} lamps of the recipe's")
    notes = [reason]
    if not scene.has_metric_scale:
        notes.append("the scene's unit is not known to be a metre, so distances are in scene units")
    if plan.has_vehicle_lamps and scene.labels is None and not scene.actors:
        notes.append("no vehicle has a box, so none has lamps")
    return f"{', '.join(parts) or 'none'}; {'; '.join(notes)}"


def _make_fixed(plan: LightPlan, scene: Scene) -> Lamps:
    """Make the lamps that do not move."""
    light = plan.light
    parts = []
    if plan.has_street_lamps:
        settings = StreetLampSettings(
            flux_lm=light.street_lumen,
            temperature_k=light.street_kelvin,
            spacing_m=light.street_spacing_m,
            height_m=light.street_height_m,
            luminaire=_luminaire(light),
        )
        parts.append(street_lamps(scene, settings))
    if light.lamps:
        entries = [_entry(lamp) for lamp in light.lamps]
        lamps = listed_lamps(scene, entries)
        colors = lamps.colors.copy()
        for row, lamp in enumerate(light.lamps):
            colors[row] = _COLORS.get(lamp.color, colors[row])
        radii_m = np.array([lamp.radius_m for lamp in light.lamps])
        parts.append(replace(lamps, colors=colors, radii_m=radii_m))
    return Lamps.concatenate(parts)


def _luminaire(light: Light) -> IesLuminaire | None:
    """Return the luminaire of the recipe's file; None without one.

    Raises:
        RecipeError: the file cannot be read, or has changed.
        LampError: it is no IES file.
    """
    if light.street_ies is None:
        return None
    where = f"light.street_ies = {light.street_ies!r}"
    content = read_files(light)["street_ies"]
    if len(content) > MAX_BYTES:
        raise LampError(
            f"{where}: an IES file may have at most {MAX_BYTES:,} bytes; got {len(content):,}"
        )
    return parse_ies(content.decode("latin-1"), where)


def _entry(lamp: ListedLamp) -> LampEntry:
    """Return a lamp of the recipe's list as `listed_lamps` takes it."""
    azimuth = math.radians(lamp.azimuth_deg)
    elevation = math.radians(0.0 if lamp.kind == "street" else lamp.elevation_deg)
    level = math.cos(elevation)
    return LampEntry(
        (lamp.x_m, lamp.y_m, lamp.z_m),
        (level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)),
        lamp.candela,
        _KINDS[lamp.kind],
        lamp.kelvin,
    )
