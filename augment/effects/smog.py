"""Smog, haze and fog: the effect, the transmittance of labelled boxes, and LiDAR in fog.

`SmogEffect` turns a recipe's `weather.smog` into a `Fog` in the scene's heights. The physics of
light in fog is augment.render.fog.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int64
from torch import Tensor

from augment.effects.effect import (
    PICTURE,
    Effect,
    EffectInScene,
    EffectPlan,
    JobContext,
    LabelInputs,
    RenderedView,
    Step,
    skipped_steps,
)
from augment.effects.lidar.beam import Echoes, LidarModel, signal
from augment.effects.lidar.codes import LOST, SCATTERED
from augment.errors import SceneError
from augment.light.cast_shadows import precompute_shadows, shadows_of, sun_transmittance
from augment.light.common_exposure import exposure_change
from augment.output.box_tables import BoxTable
from augment.render.buffers import EXPECTED_DEPTH, MEDIAN_DEPTH
from augment.render.fog import MAX_EXPONENT, Fog, optical_depth_numpy
from augment.render.fog_banks import FogBanks, bank_seed
from augment.render.fog_image import point_optical_depth_numpy
from augment.render.fog_table import densities_at, ray_means, visible_distances
from augment.render.linear_airlight import mix_linear_light
from augment.render.scatter import scatter_forward, scattered_share
from augment.scene.boxes import NOT_COUNTED, WorldBoxes, pixels_of_boxes
from augment.scene.cameras import Camera
from augment.scene.pixel_rays import pixel_rays_of
from augment.scene.scene import Scene
from augment.timing import timed
from augment.view.layers import LayerRenderer
from recipes.schema import Recipe, Smog
from recipes.smog import KOSCHMIEDER

# ---- The effect ----------------------------------------------------------------------------------

# Names of the passes.
PER_GAUSSIAN = "smog per Gaussian"
ON_BUFFERS = "smog on buffers"
ELEVATION = "airlight by elevation"
SKY = "sky"
LINEAR_LIGHT = "airlight in linear light"
SCATTER = "forward scatter"

# Manifest column of the visibility that an image has.
LOCAL_VISIBILITY = "smog_local_visibility_m"
# Number of level rays that it is measured along.
_NUM_RAYS = 33


@dataclass(frozen=True)
class SmogPlan:
    """Numbers of the smog in a scene, `EffectPlan.data` of `SmogEffect`."""

    fog: Fog
    """The fog in the scene's heights."""

    on_buffers: bool
    """If True, the fog is applied to finished layers instead of to every Gaussian."""

    is_common: bool = False
    """If True, the mean of the cameras' exposures gives the fog's colour in all of them."""

    scatter: float = 0.0
    """Strength of the forward scatter."""

    is_linear: bool = False
    """If True, the airlight of the finished picture is mixed in linear light."""

    wind_mps: float = 0.0
    """Speed of the wind, with which the fog's banks drift."""

    def fog_at(self, time_s: float) -> Fog:
        """Return the fog at a time of the weather, its banks moved by the wind."""
        banks = self.fog.banks
        if banks is None:
            return self.fog
        drift_m = banks.drift_m + self.wind_mps * time_s
        return replace(self.fog, banks=replace(banks, drift_m=drift_m))


class SmogEffect(Effect):
    """Smog, haze and fog, in front of the scene and its sky."""

    name = "smog"
    section = "weather.smog"
    model = Smog
    measured_columns = (LOCAL_VISIBILITY,)
    off_switches: ClassVar = {PER_GAUSSIAN: ("weather.smog", None)}
    # transmittance: 0 to 1, of the smog between camera and box; NaN for a box whose numbers are
    # not finite. pixels: number of pixels that the transmittance is the mean of. With 0 pixels or
    # NOT_COUNTED, the transmittance is an estimate.
    box_table = BoxTable(
        name="box_smog",
        file="labels/smog.parquet",
        kind="box smog",
        columns={"transmittance": np.float64, "pixels": np.int64},
        sample_columns=("transmittance",),
        visible_column="transmittance",
    )

    def reads_splats(self, recipe: Recipe) -> bool:
        smog = self.section_of(recipe)
        return smog is not None and max(smog.shadow_fade, smog.gloss_fade) > 0

    def kernel_key(self, section: Smog) -> bool | None:
        return section.patchiness > 0 or None

    def plan_in_scene(
        self, recipe: Recipe, scene: Scene, later_plans: Mapping[str, EffectPlan]
    ) -> EffectPlan:
        smog = self.section_of(recipe)
        fog, reason = _in_heights(smog, scene, recipe.seed)
        if fog is None:
            drawing_steps = skipped_steps((PER_GAUSSIAN, ON_BUFFERS, ELEVATION), reason)
            picture_steps = skipped_steps((LINEAR_LIGHT, SCATTER), reason, PICTURE)
            return EffectPlan(None, (*drawing_steps, *picture_steps))
        is_common = recipe.render.exposure == "common" and scene.common_color_map is not None
        if is_common:
            reason += "; one airlight for all cameras, by the mean of their exposures"
        on_photo = recipe.render.is_on_recorded
        on_buffers = on_photo or smog.model == "deferred"
        other_reason = "weather.smog.model chooses the other way"
        if on_photo:
            other_reason = "render.base is 'recorded': the photo's pixels are faded by their depth"
        sky = Step(SKY, True, "sampled, then faded through the smog up to infinity")
        if fog.scale_height_m is None:
            sky = Step(SKY, False, "uniform smog hides it: the airlight colour stands for it")
        is_linear = smog.blend == "linear"
        steps = (
            Step(PER_GAUSSIAN, not on_buffers, other_reason if on_buffers else reason),
            Step(ON_BUFFERS, on_buffers, reason if on_buffers else other_reason),
            Step(
                ELEVATION,
                fog.elevation_gain > 0,
                f"weather.smog.overcast is {fog.elevation_gain:g}",
            ),
            sky,
            Step(LINEAR_LIGHT, is_linear, f"weather.smog.blend is {smog.blend}", PICTURE),
            Step(SCATTER, smog.scatter > 0, f"weather.smog.scatter is {smog.scatter:g}", PICTURE),
        )
        buffers = {EXPECTED_DEPTH} if on_buffers or fog.elevation_gain > 0 else set[str]()
        if smog.scatter > 0 or is_linear:
            buffers.add(MEDIAN_DEPTH)  # which costs nothing where depth images are written
        wind_mps = smog.wind_mps if smog.drift_m is None else 0.0
        data = SmogPlan(fog, on_buffers, is_common, smog.scatter, is_linear, wind_mps)
        return EffectPlan(data, steps, frozenset(buffers))

    def sun_share(self, recipe: Recipe, scene: Scene) -> tuple[float, str]:
        smog = self.section_of(recipe)
        fog, _ = _in_heights(smog, scene, recipe.seed)
        shadows = shadows_of(scene) if fog is not None and smog.shadow_fade > 0 else None
        if fog is None or shadows is None:
            return 1.0, ""
        ground_z_m = float(np.median(shadows.height_m[shadows.known_share > 0]))
        share = 1 - smog.shadow_fade * (1 - sun_transmittance(fog, shadows, ground_z_m))
        return share, f"{self.section} leaves {100 * share:.0f} % of the sun's light"

    def gloss_share(self, recipe: Recipe, scene: Scene) -> tuple[float, str]:
        smog = self.section_of(recipe)
        if smog is None or smog.resolved_extinction_per_m == 0 or smog.gloss_fade == 0:
            return 1.0, ""
        share = 1 - smog.gloss_fade
        return share, f"{self.section} leaves {100 * share:.0f} % of the sky's blue"

    def precompute(self, context: JobContext) -> None:
        if any(smog and smog.shadow_fade > 0 for smog in map(self.section_of, context.recipes)):
            precompute_shadows(context.scene)

    def edit_scene(
        self, effect: EffectInScene, layers: LayerRenderer, camera: Camera
    ) -> LayerRenderer:
        fog = effect.settings.fog_at(effect.weather_time_s)
        common = effect.scene.common_color_map
        if effect.settings.is_common and common is not None:
            fog = fog_before_color_map(fog, effect.scene.color_map(camera), common)
        return replace(layers, fog=fog, applies_fog_to_buffers=effect.settings.on_buffers)

    def reads_neighbours(self, effect: EffectInScene) -> bool:
        return effect.settings.scatter > 0

    def edit_image(self, effect: EffectInScene, view: RenderedView, camera: Camera) -> RenderedView:
        settings = effect.settings
        if settings.scatter == 0 and not settings.is_linear:
            return view
        alpha = view.raster.alpha
        depth = view.raster.median_depth
        assert alpha is not None and depth is not None
        rgb = view.rgb
        fog_share = view.raster.fog_share
        if settings.is_linear:
            # That of the layers has the airlight in the camera's exposure.
            fog = view.layers.fog or settings.fog_at(effect.weather_time_s)
            with timed(LINEAR_LIGHT):
                share = fog_share
                if share is None:
                    share = scattered_share(alpha, depth, camera, fog, backend=effect.backend)
                if fog.banks is not None:
                    fog_share = share  # which scatter would look up again
                rgb = mix_linear_light(rgb, share, camera, fog, backend=effect.backend)
        if settings.scatter > 0:
            with timed(SCATTER):
                rgb = scatter_forward(
                    rgb,
                    alpha,
                    depth,
                    camera,
                    settings.fog_at(effect.weather_time_s),
                    settings.scatter,
                    fog_share=fog_share,
                    backend=effect.backend,
                )
        return replace(view, rgb=rgb)

    def measure_view(self, camera: Camera, inputs: LabelInputs) -> dict[str, float]:
        fog = _measured_fog(inputs)
        if fog is None:
            return {}
        return {LOCAL_VISIBILITY: local_visibility(fog, camera)}

    def measure_boxes(
        self, boxes: WorldBoxes, camera: Camera, inputs: LabelInputs
    ) -> dict[str, np.ndarray]:
        fog = _measured_fog(inputs)
        estimate = box_transmittance(boxes, camera, fog, inputs.depth_m, inputs.water_level_z_m)
        return {"transmittance": estimate.transmittance, "pixels": estimate.num_pixels}

    def attenuate_beams(
        self, effect: EffectInScene, echoes: Echoes, rng: np.random.Generator
    ) -> None:
        # A beam is narrower than the angle into which droplets diffract: that light is lost to it.
        fog = effect.settings.fog_at(effect.weather_time_s)
        beam_extinction_per_m = (1 + effect.settings.scatter) * fog.extinction_per_m
        fog_echoes(echoes, replace(fog, extinction_per_m=beam_extinction_per_m), rng)


def _measured_fog(inputs: LabelInputs) -> Fog | None:
    """Return the fog at the time of an image whose labels are measured; None without fog."""
    data = inputs.plan.data
    if data is None:
        return None
    return data.fog_at(0.0 if inputs.effect is None else inputs.effect.weather_time_s)


def local_visibility(fog: Fog, camera: Camera) -> float:
    """Return the visibility from a camera, metres: how far an optical depth of 3.912 reaches.

    It is the median of level rays through the columns of the image, at the height of the eye.
    """
    eye = camera.centre.numpy()
    fog_per_m = float(extinction_at(fog, eye[2:])[0])
    if fog.banks is None:
        return KOSCHMIEDER / max(fog_per_m, 1e-12)
    u = (np.linspace(0, camera.width, _NUM_RAYS) - camera.cx) / camera.fx
    rotation = camera.world_from_camera[:3, :3].numpy()
    directions = rotation @ np.stack([u, np.zeros(_NUM_RAYS), np.ones(_NUM_RAYS)])
    directions[2] = 0
    directions = (directions / np.maximum(np.linalg.norm(directions, axis=0), 1e-9)).T
    level = replace(fog, extinction_per_m=fog_per_m, scale_height_m=None)
    return float(np.median(visible_distances(level, eye, directions, KOSCHMIEDER)))


def _in_heights(smog: Smog | None, scene: Scene, seed: int) -> tuple[Fog | None, str]:
    """Return the smog in the scene's heights and the reason; None if it would change nothing."""
    if smog is None:
        return None, "the recipe has no smog"
    if smog.resolved_extinction_per_m == 0:
        return None, "the smog has no density, so it changes nothing"
    base_z_m = 0.0
    reason = f"extinction {smog.resolved_extinction_per_m:.6g}/m, model {smog.model}"
    if smog.scale_height_m is not None:
        if scene.ground_z_m is None:
            raise SceneError(
                f"weather.smog.scale_height_m = {smog.scale_height_m} needs the road's height, "
                f"which scene {scene.name!r} ({scene.source}) does not know; remove "
                f"scale_height_m, or add ground_z=HEIGHT to the scene's URI"
            )
        base_z_m = scene.ground_z_m + smog.base_height_m
        reason += f", scale height {smog.scale_height_m:g} m above z = {base_z_m:.2f} m"
    if not scene.has_metric_scale:
        reason += "; the scene's unit is not known to be a metre, so densities are per scene unit"
    banks = None
    if smog.patchiness > 0:
        banks = FogBanks(
            smog.patchiness,
            smog.bank_m,
            math.radians(smog.wind_from_deg),
            smog.drift_m or 0.0,
            bank_seed(seed, scene.name),
            (float(scene.world_origin_m[0]), float(scene.world_origin_m[1])),
        )
        reason += f", in banks of {smog.bank_m:g} m, patchiness {smog.patchiness:g}"
    fog = Fog(
        smog.resolved_extinction_per_m,
        smog.color,
        smog.scale_height_m,
        base_z_m,
        smog.overcast,
        banks=banks,
    )
    return fog, reason


def fog_before_color_map(
    fog: Fog, color_map: Float[Tensor, "3 4"] | None, common: Float[Tensor, "3 4"]
) -> Fog:
    """Return the fog whose airlight, after a camera's colour map, looks as in the common exposure.

    The formula is that of `augment.light.common_exposure`. The airlight is not clipped, since its
    dependence on the elevation is added to it.

    Args:
        fog: the fog with airlight A.
        color_map: M; None for the identity.
        common: C.
    """
    change = exposure_change(color_map, common)
    airlight = torch.tensor(fog.airlight_rgb, dtype=torch.float64)
    varying = airlight + change[:, :3] @ airlight
    rgb = varying + change[:, 3]
    return replace(
        fog, airlight_rgb=tuple(rgb.tolist()), varying_airlight_rgb=tuple(varying.tolist())
    )


# ---- On labelled boxes ---------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class BoxTransmittance:
    """Transmittance of the smog between the camera and each of B boxes."""

    transmittance: Float64[np.ndarray, " B"]
    """0 to 1; NaN for boxes whose numbers are not finite."""

    num_pixels: Int64[np.ndarray, " B"]
    """Number of pixels that the transmittance is the mean of. With 0 or NOT_COUNTED, the
    transmittance is an estimate.
    """


def box_transmittance(
    boxes: WorldBoxes,
    camera: Camera,
    fog: Fog | None,
    surface_depth_m: Float32[np.ndarray, "H W"] | None,
    water_level_z_m: float | None = None,
) -> BoxTransmittance:
    """Return exp(-tau) of the smog between the camera's eye and each box.

    Args:
        boxes: the boxes, in the scene's world.
        camera: camera of the image.
        fog: the smog; None for none.
        surface_depth_m: z of the surfaces that the pixels show, metres, 0 = none. It decides which
            pixels show a box and how far away the box is there. If it is None, or if no pixel
            shows the box, the result is the mean over the box's corners and its centre.
        water_level_z_m: height of the water, scene world. An eye under water sees other things
            under water through no smog, as `flood_view` draws them.
    """
    if fog is None:
        transmittance = np.where(boxes.is_usable, 1.0, np.nan)
        return BoxTransmittance(transmittance, np.full(len(boxes), NOT_COUNTED))

    def optical_depth_to(points_m: np.ndarray) -> np.ndarray:
        """Return the optical depth between the eye and points."""
        return point_optical_depth_numpy(fog, camera, points_m)

    return mean_transmittance(boxes, camera, optical_depth_to, surface_depth_m, water_level_z_m)


def mean_transmittance(
    boxes: WorldBoxes,
    camera: Camera,
    optical_depth_to: Callable[[np.ndarray], np.ndarray],
    surface_depth_m: Float32[np.ndarray, "H W"] | None,
    water_level_z_m: float | None = None,
) -> BoxTransmittance:
    """Return the mean of exp(-tau) between the camera's eye and what shows each box.

    Args:
        boxes: as in `box_transmittance`, like all arguments that are not named here.
        camera: the same.
        optical_depth_to: function that gives tau between the eye and points [..., 3], scene world.
        surface_depth_m: the same.
        water_level_z_m: the same.
    """
    pixels = np.full(len(boxes), NOT_COUNTED)
    world_from_camera = camera.world_from_camera.numpy()
    eye_m = world_from_camera[:3, 3]
    is_dry = water_level_z_m is None or eye_m[2] > water_level_z_m

    def transmittance_to(points_m: np.ndarray) -> np.ndarray:
        """Return the transmittance between the eye and points."""
        t = np.exp(-optical_depth_to(points_m))
        return t if is_dry else np.where(points_m[..., 2] <= water_level_z_m, 1.0, t)

    points = np.concatenate([boxes.corners_m, boxes.centres_m[:, None]], axis=1)  # [B, 9, 3]
    transmittance = transmittance_to(points).mean(axis=1)
    if surface_depth_m is not None:
        pixels[:] = 0
        rays = None if camera.is_pinhole else pixel_rays_of(camera)
        for number, rows, columns in pixels_of_boxes(boxes, camera, surface_depth_m):
            if rays is not None:
                points_m = rays.points_at(rows, columns, surface_depth_m[rows, columns])
                pixels[number] = len(rows)
                transmittance[number] = float(transmittance_to(points_m).mean())
                continue
            z = surface_depth_m[rows, columns].astype(np.float64)
            across = (columns + 0.5 - camera.cx) / camera.fx
            down = (rows + 0.5 - camera.cy) / camera.fy
            offsets = np.stack([z * across, z * down, z], -1) @ world_from_camera[:3, :3].T
            pixels[number] = len(rows)
            transmittance[number] = float(transmittance_to(eye_m + offsets).mean())
    return BoxTransmittance(np.where(boxes.is_usable, transmittance, np.nan), pixels)


# ---- On a LiDAR sweep ----------------------------------------------------------------------------
# Hahner et al. 2021, "Fog Simulation on Real LiDAR Point Clouds in Adverse Weather", ICCV. A pulse
# P(t) = P0 sin^2(pi t / (2 tau)), 0 <= t <= 2 tau, of half-power width tau has two echoes:
#
#     hard, from a surface at R0   (rho / pi) exp(-2 T(R0)) / R0^2
#     soft, from droplets at R     beta int_0^{2w} sin^2(pi x / (2w)) exp(-2 alpha r) xi(r) / r^2 dx
#                                  r = R - x, w = c tau / 2
#
# T is the optical depth, alpha the extinction, beta = 0.046 / MOR the backscatter, MOR = ln(20) /
# alpha the meteorological optical range; xi rises from 0 at overlap_from_m to 1 at overlap_full_m.
# Ranges count from the pulse's middle, so that a surface at R0 is reported at R0 and not at R0 + w.
# The smog is the smog of the images, thinned to the LiDAR's wavelength (`wavelength_factor`).

VISIBLE_UM = 0.55  # wavelength of visible light, micrometres
BACKSCATTER_MOR = 0.046  # beta x MOR, 1/sr
MOR_OPTICAL_DEPTH = math.log(20)  # optical depth of one meteorological optical range
# Fog is clumpy: the backscatter of the volume that a pulse fills is a gamma variate of this shape
# about its mean; its standard deviation is half of the mean.
CLUMPS = 4.0
_STEP_M = 0.02  # step of the ranges at which the soft echo is tabulated, metres
_FAR_M = 15.0  # largest tabulated range, metres
_PULSE_STEPS = 150  # steps of the integral over the pulse
_DENSITY_STEP = 0.02  # step of log alpha; densities within one step share a tabulated soft echo

# Kim, McArthur and Korevaar (2001): sigma ~ wavelength^-q, q = slope V + offset, V the visibility
# in km. Rows: smallest V, slope, offset.
_KIM = ((50.0, 0.0, 1.6), (6.0, 0.0, 1.3), (1.0, 0.16, 0.34), (0.5, 1.0, -0.5), (0.0, 0.0, 0.0))


def wavelength_factor(extinction_per_m: float, wavelength_um: float = 0.905) -> float:
    """Return the extinction at the LiDAR's wavelength over the extinction of visible light.

    It is (wavelength / 0.55 um)^-q, where q follows from the visibility by _KIM. Measurements
    scatter about it by some 20 %. At 905 nm it is 1 in fog, whose droplets are larger than either
    wavelength, 0.78 at a visibility of 1 km, and 0.52 at 6 km.
    """
    if extinction_per_m <= 0:
        return 1.0
    visibility_km = KOSCHMIEDER / extinction_per_m / 1000
    _, slope, offset = next(row for row in _KIM if visibility_km > row[0] or row[0] == 0)
    return (wavelength_um / VISIBLE_UM) ** -(slope * visibility_km + offset)


def extinction_at(fog: Fog, z_m: np.ndarray) -> np.ndarray:
    """Return alpha [N] at heights z_m [N] (scene world), 1/metre."""
    if fog.scale_height_m is None:
        return np.full(len(z_m), fog.extinction_per_m)
    height = (z_m - fog.base_z_m) / fog.scale_height_m
    return fog.extinction_per_m * np.exp(np.minimum(-height, MAX_EXPONENT))


class SoftEcho(NamedTuple):
    """Echo of the droplets, tabulated by reported range."""

    ranges_m: np.ndarray  # [K] reported ranges, rising, metres
    signal: np.ndarray  # [K] strength, in the unit of `augment.effects.lidar.beam.signal`
    strongest: np.ndarray  # [K] the greatest strength up to each range
    share: np.ndarray  # [K] share of the whole echo that comes from up to each range


def soft_response(alpha_per_m: float, echoes_m: np.ndarray, model: LidarModel) -> np.ndarray:
    """Return the soft integral, without near_gain, at reported ranges [K].

    The midpoint rule integrates over the pulse. An echo at R is reported at R - w. Droplets nearer
    than overlap_from_m give no echo.
    """
    w = model.pulse_m
    x = (np.arange(_PULSE_STEPS) + 0.5) * (2 * w / _PULSE_STEPS)
    r = echoes_m[:, None] + w - x
    overlap = np.clip(
        (r - model.overlap_from_m) / (model.overlap_full_m - model.overlap_from_m), 0.0, 1.0
    )
    r = np.maximum(r, model.overlap_from_m)
    echo = np.sin(math.pi * x / (2 * w)) ** 2 * np.exp(-2 * alpha_per_m * r) * overlap / r**2
    beta = BACKSCATTER_MOR * alpha_per_m / MOR_OPTICAL_DEPTH
    return beta * echo.sum(1) * (2 * w / _PULSE_STEPS)


@functools.lru_cache(maxsize=256)
def soft_echo(alpha_per_m: float, model: LidarModel) -> SoftEcho:
    """Return the tabulated soft echo; echoes from beyond _FAR_M are too weak to count."""
    ranges = np.arange(model.overlap_from_m, _FAR_M, _STEP_M)
    response = model.near_gain * soft_response(alpha_per_m, ranges, model)
    total = np.cumsum(response)
    share = total / max(total[-1], 1e-300)
    return SoftEcho(ranges, response, np.maximum.accumulate(response), share)


class Scatter(NamedTuple):
    """The strongest echo of the droplets in front of each of N surfaces."""

    signal: np.ndarray  # [N] strength, in the unit of `beam.signal`; 0 where there is no echo
    ranges_m: np.ndarray  # [N] reported range, metres


def scatter_before(
    fog: Fog,
    eyes_z_m: np.ndarray,
    ends_m: np.ndarray,
    model: LidarModel,
    rng: np.random.Generator,
    bank_densities: np.ndarray | float = 1.0,
) -> Scatter:
    """Draw the echoes of the smog in front of surfaces at ranges ends_m [N].

    The strength varies with the clumps that a beam meets (CLUMPS). The range of the strongest echo
    is drawn from the echo's shape. N numbers of each kind are drawn at any density, so that
    only the density differs between two smogs. bank_densities: density of the smog's banks at the
    sensor [N], relative to its mean; echoes come from the next metres.
    """
    count = len(ends_m)
    clump = rng.standard_gamma(CLUMPS, count) / CLUMPS
    quantile = rng.random(count)
    alpha = extinction_at(fog, eyes_z_m) * bank_densities
    out = Scatter(np.zeros(count), np.zeros(count))
    usable = (alpha > 0) & (ends_m > model.overlap_from_m) & np.isfinite(alpha)
    group = np.rint(np.log(np.where(usable, alpha, 1.0)) / _DENSITY_STEP).astype(np.int64)
    low, high = (group[usable].min(), group[usable].max()) if usable.any() else (0, -1)
    for number in range(low, high + 1):
        rows = np.flatnonzero(usable & (group == number)) if high > low else np.flatnonzero(usable)
        if not len(rows):
            continue
        is_uniform = fog.scale_height_m is None and fog.banks is None
        mean = fog.extinction_per_m if is_uniform else math.exp(number * _DENSITY_STEP)
        echo = soft_echo(float(mean), model)
        last = ((ends_m[rows] - echo.ranges_m[0]) / _STEP_M).astype(np.int64)
        last = np.clip(last, 0, len(echo.ranges_m) - 1)
        out.signal[rows] = echo.strongest[last] * clump[rows]
        echo_range = np.interp(quantile[rows] * echo.share[last], echo.share, echo.ranges_m)
        out.ranges_m[rows] = np.minimum(echo_range, ends_m[rows])
    return out


def fog_echoes(echoes: Echoes, fog: Fog, rng: np.random.Generator) -> None:
    """Weaken echoes by the fog, and replace those that the fog's own echo exceeds.

    fog: the fog with its extinction of visible light.
    """
    model = echoes.model
    factor = wavelength_factor(fog.extinction_per_m, model.wavelength_um)
    fog = dataclasses.replace(fog, extinction_per_m=factor * fog.extinction_per_m)
    eyes_z = echoes.origins[:, 2]
    air = echoes.air_path_m
    ends_z = eyes_z + air * echoes.directions[:, 2]
    tau = optical_depth_numpy(fog, air, eyes_z, ends_z, series_below=1e-4)
    densities: np.ndarray | float = 1.0
    if fog.banks is not None:
        tau = tau * ray_means(fog, echoes.origins, echoes.directions, air)
        densities = densities_at(fog, echoes.origins)
    echoes.gain *= np.exp(-2 * tau)
    scatter = scatter_before(fog, eyes_z, air, model, rng, densities)
    echoes.extinction_per_m += extinction_at(fog, eyes_z) * densities
    echo = signal(echoes.reflectance * echoes.gain, np.maximum(echoes.ranges_m, 1e-3))
    wins = (scatter.signal > echo) & (echoes.ranges_m > 0) & (echoes.codes != LOST)
    rows = np.flatnonzero(wins)
    ranges = scatter.ranges_m[rows]
    # Reflectance of a surface whose echo from that range is as strong.
    white = signal(np.ones(len(rows)), np.maximum(ranges, 1e-3))
    echoes.replace_echoes(rows, ranges, scatter.signal[rows] / white, SCATTERED)
