"""Luminance that lamps add to a picture: on surfaces, in the air, and by the lamps themselves."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from augment.effects.effect import EffectInScene, RenderedView
from augment.effects.lamps.picture_light import find_reflectance
from augment.effects.lamps.plan import AIR, DROPS, EMITTERS, SURFACES, WET, LightPlan
from augment.effects.lamps.signs import sign_pixels
from augment.lamps.air_light import air_light
from augment.lamps.beam_shadows import draw_beam_shadows
from augment.lamps.drop_light import add_drop_light
from augment.lamps.emitters import HALO_RADIUS_M, add_emitters, lamp_visibility
from augment.lamps.fog_phase import AirExtinction
from augment.lamps.lamp import Lamps
from augment.lamps.recorded_lamps import find_recorded_lamps, vehicle_pixels
from augment.lamps.surface_light import surface_light
from augment.lamps.wet_glints import add_wet_glints
from augment.render.buffers import REFERENCE
from augment.render.constants import SURFACE_ALPHA
from augment.render.scatter import scattered_share
from augment.scene.cameras import Camera
from augment.timing import timed

# Opacity of a pixel up to which it shows no surface that hides a lamp.
MIN_ALPHA = 1e-3


def add_lamp_light(
    effect: EffectInScene,
    view: RenderedView,
    camera: Camera,
    rgb: Float32[np.ndarray, "H W 3"],
    white: float,
    threshold_cd_m2: float,
) -> Float32[np.ndarray, "H W 3"] | None:
    """Return the luminance that lamps add to each pixel, cd/m2 in linear sRGB; None without lamps.

    Args:
        effect: the effect in the scene, with the view's lamps.
        view: the picture before it, with its layers and buffers.
        camera: the view.
        rgb: the picture, display-encoded, in the camera's exposure.
        white: linear light of a white surface in it.
        threshold_cd_m2: luminance that need not be added, cd/m2.
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
    depth_m = np.where((alpha >= SURFACE_ALPHA) & np.isfinite(z), z, np.float32(0))
    air = air_of(effect, view)
    added = np.zeros_like(rgb) if recorded is None else recorded
    if plan.hour.is_dark:
        _add_surface_light(effect, view, camera, rgb, white, depth_m, air, threshold_cd_m2, added)
    surface_m = np.where(alpha > MIN_ALPHA, z, np.float32(np.inf))
    if not air.is_clear:
        with timed(AIR):
            lengths = camera.ray_lengths().numpy()
            distance_m = np.where(depth_m > 0, depth_m * lengths, np.float32(np.inf))
            air_light(
                lamps,
                camera,
                distance_m.astype(np.float32),
                air,
                num_points=plan.lamp_points,
                step_px=plan.lamp_halo_px,
                threshold_cd_m2=threshold_cd_m2,
                visible_shares=lamp_visibility(
                    lamps, camera, surface_m, alpha, radius_m=HALO_RADIUS_M
                ),
                picture=added,
            )
    if plan.hour.is_dark and plan.has_drops:
        with timed(DROPS):
            eye = camera.centre.numpy()
            for cover in view.drop_covers:
                add_drop_light(
                    added,
                    lamps,
                    camera,
                    cover,
                    extinction_per_m=float(air.mean_extinction_per_m(eye, eye + 1.0)),
                    min_luminance_cd_m2=threshold_cd_m2,
                )
    with timed(EMITTERS):
        visible_shares = lamp_visibility(lamps, camera, surface_m, alpha)
        add_emitters(added, lamps, camera, visible_shares, air)
    return added


def air_of(effect: EffectInScene, view: RenderedView) -> AirExtinction:
    """Return the extinction of fog, rain and snowfall in a view."""
    per_m = 0.0
    kind = "rain"
    for other in effect.earlier_effects:
        sizes = getattr(other.settings, "sizes", None)
        if other.hooks.name in ("rain", "snowfall") and sizes is not None:
            per_m += sizes.extinction_per_m
            kind = "snow" if other.hooks.name == "snowfall" else kind
    fog = next((o.settings.fog for o in effect.earlier_effects if o.hooks.name == "smog"), None)
    return AirExtinction(fog, per_m, "snow" if kind == "snow" else "rain")


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
) -> None:
    """Add the light of surfaces and water under lamps, as the fog before them lets it through."""
    plan: LightPlan = effect.settings
    lamps: Lamps = effect.view_data
    with timed(SURFACES):
        fog_share = _fog_share(effect, view, camera)
        fog = view.layers.fog
        reflectance = find_reflectance(
            rgb,
            white,
            fog_share,
            (0.0, 0.0, 0.0) if fog is None else fog.airlight_rgb,
            uses_kernels=effect.backend != REFERENCE,
        )
        shadows = draw_beam_shadows(
            lamps,
            tuple(view.layers.parts),
            settings=view.layers.settings,
            backend=effect.backend,
            timestamp_ns=camera.timestamp_ns,
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
            is_sign=sign_pixels(view) if plan.has_signs else None,
            picture=added,
        )
    if not plan.is_wet:
        return
    with timed(WET):
        if view.wet_surface is None:
            return
        glints = added if fog_share is None else np.zeros_like(added)
        add_wet_glints(
            glints,
            lamps,
            camera,
            view.wet_surface,
            extinctions_per_m=extinctions_per_m,
            min_luminance_cd_m2=threshold_cd_m2,
            lamps_per_pixel=plan.lamps_per_pixel,
            shadows=shadows,
        )
        if fog_share is not None:
            added += glints * (1 - np.clip(fog_share, 0, 1))[..., None]


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
