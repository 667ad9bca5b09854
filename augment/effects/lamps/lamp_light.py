"""Luminance that lamps add to a picture: on surfaces, in the air, and by the lamps themselves."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from augment.effects.effect import EffectInScene, RenderedView
from augment.effects.lamps.picture_light import find_reflectance, find_surfaces
from augment.effects.lamps.plan import AIR, DROPS, EMITTERS, SURFACES, WET, LightPlan
from augment.effects.lamps.recording_car import PAINT_M, light_recording_car, recording_car_pixels
from augment.effects.lamps.signs import sign_pixels
from augment.lamps.air_light import air_light
from augment.lamps.beam_shadows import BeamShadows, draw_beam_shadows, looks_into, throws_shadows
from augment.lamps.drop_light import add_drop_light
from augment.lamps.emitters import HALO_RADIUS_M, add_emitters, lamp_visibility
from augment.lamps.fog_phase import AirExtinction
from augment.lamps.lamp import Lamps
from augment.lamps.recorded_lamps import find_recorded_lamps, vehicle_pixels
from augment.lamps.surface_light import surface_light
from augment.lamps.wet_glints import add_wet_glints
from augment.memo import memo_of
from augment.render.buffers import REFERENCE
from augment.render.fog_table import local_fog
from augment.render.scatter import scattered_share
from augment.scene.cameras import Camera
from augment.scene.labels import EGO_VEHICLE
from augment.timing import timed

# Width of the pixels of halos by day, over that at night: they are faint.
DAY_HALO_STEPS = 2


def add_lamp_light(
    effect: EffectInScene,
    view: RenderedView,
    camera: Camera,
    rgb: Float32[np.ndarray, "H W 3"],
    white: float,
    threshold_cd_m2: float,
    color_map: Tensor | None,
) -> Float32[np.ndarray, "H W 3"] | None:
    """Return the luminance that lamps add to each pixel, cd/m2 in linear sRGB; None without lamps.

    Args:
        effect: the effect in the scene, with the view's lamps.
        view: the picture before it, with its layers and buffers.
        camera: the view.
        rgb: the picture, display-encoded, in the camera's exposure.
        white: linear light of a white surface in it.
        threshold_cd_m2: luminance that need not be added, cd/m2.
        color_map: the camera's colour map [3, 4], which the picture has; None without one.
    """
    plan: LightPlan = effect.settings
    lamps: Lamps = effect.view_data
    recorded = _recorded_light(effect, view, camera)
    if lamps is None or len(lamps) == 0:
        return recorded
    raster = view.raster
    assert raster.alpha is not None and raster.expected_depth is not None
    alpha = np.ascontiguousarray(raster.alpha.detach().cpu().numpy(), np.float32)
    z = np.ascontiguousarray(raster.expected_depth.detach().cpu().numpy(), np.float32)
    depth_m = find_surfaces(alpha, z, uses_kernels=effect.backend != REFERENCE)
    air = air_of(effect, view, camera)
    # Not zeros_like, which would write to memory where no light is added.
    added = np.zeros(rgb.shape, np.float32) if recorded is None else recorded
    if plan.hour.is_dark:
        car_pixels = recording_car_pixels(effect.scene, camera)
        if car_pixels is not None:
            depth_m[car_pixels] = 0
            view = _without_water(view, car_pixels)
        airlight_rgb = _airlight(view, color_map)
        _add_surface_light(
            effect,
            view,
            camera,
            _without_mirror(rgb, view, color_map),
            white,
            depth_m,
            air,
            threshold_cd_m2,
            added,
            airlight_rgb=airlight_rgb,
        )
        if car_pixels is not None:
            depth_m[car_pixels] = PAINT_M
            with timed(SURFACES):
                light_recording_car(
                    added,
                    car_pixels,
                    rgb,
                    white,
                    lamps,
                    camera,
                    uses_kernels=effect.backend != REFERENCE,
                )
    if not air.is_clear:
        with timed(AIR):
            air_light(
                lamps,
                camera,
                depth_m,
                air,
                num_points=plan.lamp_points,
                step_px=plan.lamp_halo_px * (1 if plan.hour.is_dark else DAY_HALO_STEPS),
                threshold_cd_m2=threshold_cd_m2,
                visible_shares=lamp_visibility(lamps, camera, z, alpha, radius_m=HALO_RADIUS_M),
                picture=added,
                is_depth=True,
            )
    if plan.hour.is_dark and plan.has_drops:
        with timed(DROPS):
            eye = camera.centre.numpy()[None]
            extinction_per_m = float(air.mean_extinction_per_m(eye, eye + 1.0)[0])
            for cover in view.drop_covers:
                add_drop_light(
                    added,
                    lamps,
                    camera,
                    cover,
                    extinction_per_m=extinction_per_m,
                    min_luminance_cd_m2=threshold_cd_m2,
                )
    with timed(EMITTERS):
        visible_shares = lamp_visibility(lamps, camera, z, alpha)
        add_emitters(added, lamps, camera, visible_shares, air)
    return added


def _without_water(view: RenderedView, pixels: Bool[np.ndarray, "H W"]) -> RenderedView:
    """Return the view without water at some pixels."""
    return replace(view, waters=tuple(water.without(pixels) for water in view.waters))


def _without_mirror(
    rgb: Float32[np.ndarray, "H W 3"], view: RenderedView, color_map: Tensor | None
) -> Float32[np.ndarray, "H W 3"]:
    """Return the picture without what wet ground mirrors of the day."""
    mirrored = view.mirrored_rgb
    if mirrored is None:
        return rgb
    if color_map is not None:
        mirrored = mirrored @ color_map[:, :3].to(mirrored).T
    out = rgb.copy()
    rows = out[slice(*view.mirrored_rows)]
    rows -= mirrored.detach().cpu().numpy()
    np.maximum(rows, np.float32(0), out=rows)
    return out


def _airlight(view: RenderedView, color_map: Tensor | None) -> tuple[float, float, float]:
    """Return the colour of the fog in a camera's finished picture; black without fog."""
    fog = view.layers.fog
    if fog is None:
        return (0.0, 0.0, 0.0)
    color = torch.tensor(fog.airlight_rgb, dtype=torch.float64)
    if color_map is not None:
        color = color_map[:, :3].double().cpu() @ color + color_map[:, 3].double().cpu()
    red, green, blue = color.tolist()
    return (red, green, blue)


def air_of(effect: EffectInScene, view: RenderedView, camera: Camera) -> AirExtinction:
    """Return the extinction of fog, rain and snowfall in a view.

    Fog with banks counts as plain fog that is as dense as the banks around the camera, and a shower
    as rain or snowfall of the rate at the camera.
    """
    per_m = 0.0
    kind: Literal["rain", "snow"] = "rain"
    for other in effect.earlier_effects:
        if other.hooks.name in ("rain", "snowfall") and other.settings is not None:
            per_m += other.settings.at(camera).sizes.extinction_per_m
            if other.hooks.name == "snowfall":
                kind = "snow"
    smog = next((o for o in effect.earlier_effects if o.hooks.name == "smog"), None)
    fog = None
    if smog is not None:
        fog = local_fog(smog.settings.fog_at(smog.weather_time_s), camera)
    return AirExtinction(fog, per_m, kind)


def _recorded_light(
    effect: EffectInScene, view: RenderedView, camera: Camera
) -> Float32[np.ndarray, "H W 3"] | None:
    """Return the luminance of lamps that a recorded picture shows lit; None without any.

    By day they are in the picture already.
    """
    photo = view.layers.photo
    plan: LightPlan = effect.settings
    if photo is None or not plan.hour.is_dark or not plan.has_vehicle_lamps:
        return None
    with timed(EMITTERS):
        recorded_lamps = find_recorded_lamps(photo.pixels, vehicle_pixels(effect.scene, camera))
        if not recorded_lamps.lamps:
            return None
        luminance = recorded_lamps.luminance_cd_m2
        if view.raster.fog_share is not None:
            share = view.raster.fog_share.detach().cpu().numpy()
            luminance = luminance * (1 - np.clip(share, 0, 1))[..., None]
    return np.ascontiguousarray(luminance, np.float32)


def _add_surface_light(
    effect: EffectInScene,
    view: RenderedView,
    camera: Camera,
    rgb: np.ndarray,
    white: float,
    depth_m: np.ndarray,
    air: AirExtinction,
    threshold_cd_m2: float,
    added: np.ndarray,
    *,
    airlight_rgb: tuple[float, float, float],
) -> None:
    """Add the light of surfaces and water under lamps, as the fog before them lets it through."""
    plan: LightPlan = effect.settings
    lamps: Lamps = effect.view_data
    with timed(SURFACES):
        fog_share = _fog_share(effect, view, camera)
        reflectance = find_reflectance(
            rgb, white, fog_share, airlight_rgb, uses_kernels=effect.backend != REFERENCE
        )
        shadows = _own_shadows(effect, view, camera)
        is_sign = None
        if plan.has_signs:
            is_sign = sign_pixels(
                view.layers.parts,
                camera,
                depth_m,
                settings=view.layers.settings,
                backend=effect.backend,
            )
        eyes = np.tile(camera.centre.numpy(), (len(lamps), 1))
        extinctions_per_m = air.mean_extinction_per_m(eyes, lamps.positions_m)
        surface_light(
            lamps,
            camera,
            depth_m,
            reflectance,
            extinctions_per_m=extinctions_per_m,
            min_luminance_cd_m2=threshold_cd_m2,
            lamps_per_pixel=plan.lamps_per_pixel,
            shadows=shadows,
            is_sign=is_sign,
            picture=added,
        )
    if not plan.is_wet:
        return
    with timed(WET):
        if not view.waters:
            return
        glints = added if fog_share is None else np.zeros_like(added)
        for water in view.waters:
            add_wet_glints(
                glints,
                lamps,
                camera,
                water,
                extinctions_per_m=extinctions_per_m,
                min_luminance_cd_m2=threshold_cd_m2,
                lamps_per_pixel=plan.lamps_per_pixel,
                shadows=shadows,
            )
        if fog_share is not None:
            added += glints * (1 - np.clip(fog_share, 0, 1))[..., None]


def _own_shadows(effect: EffectInScene, view: RenderedView, camera: Camera) -> BeamShadows | None:
    """Return the depth maps of the own beams; None if the view does not look where they shine.

    All cameras of a moment share the maps, so these have the scene's parts and not the view's.
    """
    lamps: Lamps = effect.view_data
    beams = lamps.select(throws_shadows(lamps))
    if len(beams) == 0 or not looks_into(camera, beams):
        return None
    scene = effect.scene
    settings = view.layers.settings
    moment = camera.timestamp_ns
    places = (beams.positions_m.tobytes(), beams.axes.tobytes(), beams.ups.tobytes())

    def draw() -> BeamShadows | None:
        ids = [i for i, actor in enumerate(scene.actors, 1) if actor.label != EGO_VEHICLE]
        parts = tuple(scene.parts_at(moment, ids))
        return draw_beam_shadows(
            beams, parts, settings=settings, backend=effect.backend, timestamp_ns=moment
        )

    key = ("lamps, beam shadows", moment, places, settings, effect.backend)
    return memo_of(scene).get(key, draw)


def _fog_share(
    effect: EffectInScene, view: RenderedView, camera: Camera
) -> Float32[np.ndarray, "H W"] | None:
    """Return the share of the fog's airlight in each pixel; None without fog."""
    fog = view.layers.fog
    if fog is None:
        return None
    share = view.raster.fog_share
    if share is None:
        alpha = view.raster.alpha
        depth = view.raster.expected_depth
        assert alpha is not None and depth is not None
        share = scattered_share(alpha, depth, camera, fog, backend=effect.backend)
    return np.ascontiguousarray(share.detach().cpu().numpy(), np.float32)
