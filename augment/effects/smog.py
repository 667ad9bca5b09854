"""Smog, haze and fog: the fog of a recipe in a scene, and what it does to boxes and LiDAR.

The physics of light is augment.render.fog.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int64
from torch import Tensor

from augment.base_photo import RECORDED
from augment.boxes import NOT_COUNTED, PlacedBoxes, shown_pixels
from augment.cameras import Camera
from augment.cast_shadows import (
    FadedShadows,
    faded_shadows,
    shadows_of,
    share_shadows,
    sun_transmittance,
)
from augment.drawing import LayerRenderer
from augment.effects.effect import (
    PICTURE,
    SCENE,
    Active,
    Drawn,
    Effect,
    EffectView,
    Placed,
    Sharing,
    Step,
    skipped,
)
from augment.effects.lidar.beam import Echoes, LidarModel, signal
from augment.effects.lidar.codes import LOST, SCATTERED
from augment.errors import SceneError
from augment.jobs.box_tables import BoxTable
from augment.render.buffers import EXPECTED_DEPTH, MEDIAN_DEPTH
from augment.render.fog import MAX_EXPONENT, Fog, optical_depth_of_arrays
from augment.render.scatter import scatter_forward
from augment.scene import Scene
from augment.timing import timed
from recipes.schema import Recipe, Smog
from recipes.smog import KOSCHMIEDER

# ---- The effect ----------------------------------------------------------------------------------

PER_GAUSSIAN, ON_BUFFERS = "smog per Gaussian", "smog on buffers"
ELEVATION, SKY, SCATTER = "airlight by elevation", "sky", "forward scatter"
SHADOWS = "shadows in smog"
DAMPING = 1e-4  # of the squared gains of a camera's colour map, where that is inverted


@dataclass(frozen=True)
class PlacedSmog:
    """fog: in the scene's heights. on_buffers: applied to finished layers, not to every splat.
    is_common: whether the mean of the cameras' exposures gives its colour in all of them.
    scatter: strength of the forward scatter. sun: of its light, what arrives at the ground; 1 where
    shadows stay as they are.
    """

    fog: Fog
    on_buffers: bool
    is_common: bool = False
    scatter: float = 0.0
    sun: float = 1.0


class SmogEffect(Effect):
    """Smog, haze and fog, in front of the scene and its sky."""

    name, section, model = "smog", "weather.smog", Smog
    folded: ClassVar = {PER_GAUSSIAN: ("weather.smog", None)}
    # transmittance: 0 to 1, of the smog between camera and box; NaN of a box whose numbers are not
    # finite. pixels: those it is the mean of; it is an estimate of none, or where NOT_COUNTED.
    table = BoxTable(
        name="box_smog",
        file="labels/smog.parquet",
        kind="box smog",
        columns={"transmittance": np.float64, "pixels": np.int64},
        sampled=("transmittance",),
        visible="transmittance",
    )

    def reads_splats(self, recipe: Recipe) -> bool:
        smog = self.of(recipe)
        return smog is not None and smog.shadow_fade > 0

    def place(self, recipe: Recipe, scene: Scene, later: Mapping[str, Placed]) -> Placed:
        smog = self.of(recipe)
        fog, reason = _in_heights(smog, scene)
        if fog is None:
            nothing = skipped((PER_GAUSSIAN, ON_BUFFERS, ELEVATION), reason)
            unchanged = skipped((SHADOWS,), reason, SCENE)
            return Placed(None, (*unchanged, *nothing, *skipped((SCATTER,), reason, PICTURE)))
        is_common = recipe.render.exposure == "common" and scene.common_color_map is not None
        if is_common:
            reason += "; one airlight for all cameras, by the mean of their exposures"
        on_photo = recipe.render.base == RECORDED
        on_buffers = on_photo or smog.model == "deferred"
        other = "weather.smog.model chooses the other way"
        if on_photo:
            other = "render.base is 'recorded': the photo's pixels are faded by their depth"
        sky = Step(SKY, True, "sampled, then faded through the smog up to infinity")
        if fog.scale_height_m is None:
            sky = Step(SKY, False, "uniform smog hides it: the airlight colour stands for it")
        sun, fading = _sun_in(fog, smog, scene)
        steps = (
            Step(SHADOWS, sun < 1, fading, SCENE),
            Step(PER_GAUSSIAN, not on_buffers, other if on_buffers else reason),
            Step(ON_BUFFERS, on_buffers, reason if on_buffers else other),
            Step(ELEVATION, fog.overcast > 0, f"weather.smog.overcast is {fog.overcast:g}"),
            sky,
            Step(SCATTER, smog.scatter > 0, f"weather.smog.scatter is {smog.scatter:g}", PICTURE),
        )
        buffers = {EXPECTED_DEPTH} if on_buffers or fog.overcast > 0 else set[str]()
        if smog.scatter > 0:
            buffers.add(MEDIAN_DEPTH)  # which costs nothing where depth images are written
        data = PlacedSmog(fog, on_buffers, is_common, smog.scatter, sun)
        return Placed(data, steps, frozenset(buffers))

    def prepare(self, own: Active) -> FadedShadows | None:
        return faded_shadows(own.scene, own.data.sun)

    def share(self, job: Sharing) -> None:
        if any(smog and smog.shadow_fade > 0 for smog in map(self.of, job.recipes)):
            share_shadows(job.scene)

    def edit_scene(self, own: Active, layers: LayerRenderer, camera: Camera) -> LayerRenderer:
        faded = own.prepared if own.data.sun < 1 else None
        if faded is not None:
            with timed(SHADOWS):
                parts = [p if p.instance_id or p.is_overlay else faded.on(p) for p in layers.parts]
                photo = layers.photo and replace(layers.photo, faded=faded)
                layers = replace(layers, parts=tuple(parts), photo=photo)
        fog, common = own.data.fog, own.scene.common_color_map
        if own.data.is_common and common is not None:
            fog = before_map(fog, own.scene.color_map(camera), common)
        return replace(layers, fog=fog, fog_on_buffers=own.data.on_buffers)

    def edit_image(self, own: Active, drawn: Drawn, camera: Camera) -> Drawn:
        if own.data.scatter == 0:
            return drawn
        alpha, depth = drawn.raster.alpha, drawn.raster.median_depth
        assert alpha is not None and depth is not None
        fog, strength = own.data.fog, own.data.scatter
        with timed(SCATTER):
            rgb = scatter_forward(
                drawn.rgb, alpha, depth, camera, fog, strength, backend=own.backend
            )
        return replace(drawn, rgb=rgb)

    def measure(
        self, placed: PlacedBoxes, camera: Camera, view: EffectView
    ) -> dict[str, np.ndarray]:
        data = view.placed.data
        fog = None if data is None else data.fog
        found = box_transmittance(placed, camera, fog, view.depth_m, view.water_level_z_m)
        return {"transmittance": found.transmittance, "pixels": found.pixels}

    def attenuate(self, own: Active, echoes: Echoes, rng: np.random.Generator) -> None:
        fog_echoes(echoes, own.data.fog, rng)


def _sun_in(fog: Fog, smog: Smog, scene: Scene) -> tuple[float, str]:
    """What of the sun's light counts as arriving at the ground, and why."""
    if smog.shadow_fade == 0:
        return 1.0, "weather.smog.shadow_fade is 0"
    shadows = shadows_of(scene)
    if shadows is None or shadows.certainty == 0:
        return 1.0, "the ground shows no shadows of a sun"
    ground_z_m = float(np.median(shadows.height_m[shadows.known > 0]))
    sun = 1 - smog.shadow_fade * (1 - sun_transmittance(fog, shadows, ground_z_m))
    return sun, (
        f"shadows have {shadows.luminance_ratio:.2f} of the light beside them; {100 * sun:.0f} % "
        f"of the sun's light comes through"
    )


def _in_heights(smog: Smog | None, scene: Scene) -> tuple[Fog | None, str]:
    """The smog in the scene's heights, or None where it would change nothing; and why."""
    if smog is None:
        return None, "the recipe has no smog"
    if smog.sigma_per_m == 0:
        return None, "the smog has no density, so it changes nothing"
    base_z_m = 0.0
    reason = f"extinction {smog.sigma_per_m:.6g}/m, model {smog.model}"
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
    fog = Fog(smog.sigma_per_m, smog.color, smog.scale_height_m, base_z_m, smog.overcast)
    return fog, reason


def before_map(
    fog: Fog, color_map: Float[Tensor, "3 4"] | None, common: Float[Tensor, "3 4"]
) -> Fog:
    """The fog that a camera's colour map M gives the airlight that the common map C gives `fog`.

    Maps are affine, so M(t c + (1 - t) a) = t M(c) + (1 - t) M(a): a = M^-1 C(A) leaves surfaces
    the exposure of their camera. The inverse is damped, a = A + (M'M + d)^-1 M' (C - M)(A), and
    no gain of it exceeds 1 / (2 sqrt d) = 50: airlight keeps its own colour where a camera records
    next to nothing of it, and its bits where M is C. color_map: None for the identity.
    """
    own = torch.eye(3, 4, dtype=torch.float64) if color_map is None else color_map.double()
    left, gains, right = torch.linalg.svd(own[:, :3])
    damped = (gains / (gains**2 + DAMPING))[:, None]
    change = right.T @ (damped * (left.T @ (common - own)))  # [3, 4]
    airlight = torch.tensor(fog.rgb, dtype=torch.float64)
    varying = airlight + change[:, :3] @ airlight
    rgb = varying + change[:, 3]
    return replace(fog, rgb=tuple(rgb.tolist()), varying_rgb=tuple(varying.tolist()))


# ---- On labelled boxes ---------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class BoxTransmittance:
    """transmittance: 0 to 1, NaN of boxes whose numbers are not finite. pixels: those that it is
    the mean of; where there are none, or they are NOT_COUNTED, it is an estimate.
    """

    transmittance: Float64[np.ndarray, " B"]
    pixels: Int64[np.ndarray, " B"]


def box_transmittance(
    placed: PlacedBoxes,
    camera: Camera,
    medium: Fog | None,
    surface_depth_m: Float32[np.ndarray, "H W"] | None,
    water_level_z_m: float | None = None,
) -> BoxTransmittance:
    """exp(-tau) between the eye and each box, by the smog that the image shows.

    surface_depth_m: z of what the pixels show, 0 = none; it decides which of them show a box, and
    how far it is there. A box that none shows, or any where depth is not known, has the mean over
    its corners and its centre. water_level_z_m: scene world; an eye in the water looks at what
    else is in it through no smog, as `flood_view` draws it.
    """
    pixels = np.full(len(placed), NOT_COUNTED)
    transmittance = np.ones(len(placed))
    if medium is None:
        return BoxTransmittance(np.where(placed.is_usable, transmittance, np.nan), pixels)
    eye_m = camera.centre.numpy()
    is_dry = water_level_z_m is None or eye_m[2] > water_level_z_m

    def transmittance_to(distance_m: np.ndarray, point_z_m: np.ndarray) -> np.ndarray:
        t = np.exp(-optical_depth_of_arrays(medium, distance_m, eye_m[2], point_z_m))
        return t if is_dry else np.where(point_z_m <= water_level_z_m, 1.0, t)

    points = np.concatenate([placed.corners_m, placed.centres_m[:, None]], axis=1)  # [B, 9, 3]
    distance = np.linalg.norm(points - eye_m, axis=-1)
    transmittance = transmittance_to(distance, points[..., 2]).mean(axis=1)
    if surface_depth_m is not None:
        pixels[:] = 0
        upwards = camera.world_from_camera[2, :3].numpy()  # the world's z along the camera's axes
        for number, rows, columns in shown_pixels(placed, camera, surface_depth_m):
            z = surface_depth_m[rows, columns].astype(np.float64)
            across = (columns + 0.5 - camera.cx) / camera.fx
            down = (rows + 0.5 - camera.cy) / camera.fy
            point_z = eye_m[2] + z * (across * upwards[0] + down * upwards[1] + upwards[2])
            distance = z * np.sqrt(1 + across**2 + down**2)
            pixels[number] = len(rows)
            transmittance[number] = float(transmittance_to(distance, point_z).mean())
    return BoxTransmittance(np.where(placed.is_usable, transmittance, np.nan), pixels)


# ---- On a LiDAR sweep ----------------------------------------------------------------------------
# Hahner et al. 2021, "Fog Simulation on Real LiDAR Point Clouds in Adverse Weather", ICCV. The echo
# of a pulse P(t) = P0 sin^2(pi t / (2 tau)), 0 <= t <= 2 tau, of half-power width tau:
#
#     hard, from a surface at R0   (rho / pi) exp(-2 T(R0)) / R0^2
#     soft, of droplets, at R      beta int_0^{2w} sin^2(pi x / (2w)) exp(-2 alpha r) xi(r) / r^2 dx
#                                  r = R - x, w = c tau / 2
#
# T is the optical depth, alpha the extinction, beta = 0.046 / MOR the backscatter, MOR = ln(20) /
# alpha the meteorological optical range; xi rises from 0 at overlap_from_m to 1 at overlap_full_m.
# Ranges count from the pulse's middle, so that a surface at R0 is reported at R0 and not at R0 + w.
# The smog is that of the images, thinned to the LiDAR's wavelength (`wavelength_factor`).

VISIBLE_UM = 0.55
BACKSCATTER_MOR = 0.046  # beta x MOR, 1/sr
MOR_OPTICAL_DEPTH = math.log(20)
# Fog is clumpy: the backscatter of what a pulse fills varies about its mean as a gamma variate of
# this shape, by half of it.
CLUMPS = 4.0
_STEP_M, _FAR_M = 0.02, 15.0  # of the soft echo, tabulated
_PULSE_STEPS = 150
_DENSITY_STEP = 0.02  # of log alpha, within which the soft echo is one

# q(V) of Kim, McArthur and Korevaar (2001), V in km: sigma ~ wavelength^-q. Least V, slope, offset.
_KIM = ((50.0, 0.0, 1.6), (6.0, 0.0, 1.3), (1.0, 0.16, 0.34), (0.5, 1.0, -0.5), (0.0, 0.0, 0.0))


def wavelength_factor(extinction_per_m: float, wavelength_um: float = 0.905) -> float:
    """Extinction at the LiDAR's wavelength over that of visible light (0.55 um).

    (wavelength / 0.55 um)^-q with q by the visibility, see _KIM; measurements scatter by some 20 %.
    At 905 nm: 1 in fog, whose droplets are larger than either wavelength, 0.78 at 1 km, 0.52 at 6.
    """
    if extinction_per_m <= 0:
        return 1.0
    visibility_km = KOSCHMIEDER / extinction_per_m / 1000
    _, slope, offset = next(row for row in _KIM if visibility_km > row[0] or row[0] == 0)
    return (wavelength_um / VISIBLE_UM) ** -(slope * visibility_km + offset)


def extinction_at(medium: Fog, z_m: np.ndarray) -> np.ndarray:
    """alpha [N] at heights, 1/metre."""
    if medium.scale_height_m is None:
        return np.full(len(z_m), medium.sigma_per_m)
    height = (z_m - medium.base_z_m) / medium.scale_height_m
    return medium.sigma_per_m * np.exp(np.minimum(-height, MAX_EXPONENT))


class SoftEcho(NamedTuple):
    """What droplets give back, by reported range. ranges_m [K]: rising. signal [K]: as `signal`.
    strongest [K]: the greatest up to each range. share [K]: of the whole echo, up to each range.
    """

    ranges_m: np.ndarray
    signal: np.ndarray
    strongest: np.ndarray
    share: np.ndarray


def soft_response(alpha_per_m: float, echoes_m: np.ndarray, model: LidarModel) -> np.ndarray:
    """The soft integral, without near_gain, at reported ranges [K]; midpoint rule over the pulse.

    An echo at R is reported at R - w. Droplets nearer than overlap_from_m are not seen.
    """
    w = model.pulse_m
    x = (np.arange(_PULSE_STEPS) + 0.5) * (2 * w / _PULSE_STEPS)
    r = echoes_m[:, None] + w - x
    seen = np.clip(
        (r - model.overlap_from_m) / (model.overlap_full_m - model.overlap_from_m), 0.0, 1.0
    )
    r = np.maximum(r, model.overlap_from_m)
    echo = np.sin(math.pi * x / (2 * w)) ** 2 * np.exp(-2 * alpha_per_m * r) * seen / r**2
    beta = BACKSCATTER_MOR * alpha_per_m / MOR_OPTICAL_DEPTH
    return beta * echo.sum(1) * (2 * w / _PULSE_STEPS)


@functools.lru_cache(maxsize=256)
def soft_echo(alpha_per_m: float, model: LidarModel) -> SoftEcho:
    """The soft echo tabulated; what comes from beyond _FAR_M is too weak to count."""
    ranges = np.arange(model.overlap_from_m, _FAR_M, _STEP_M)
    response = model.near_gain * soft_response(alpha_per_m, ranges, model)
    total = np.cumsum(response)
    share = total / max(total[-1], 1e-300)
    return SoftEcho(ranges, response, np.maximum.accumulate(response), share)


class Scatter(NamedTuple):
    """The strongest echo of the droplets before each return. signal [N]: as `signal` gives it, 0
    where none can be. ranges_m [N]: where it is reported.
    """

    signal: np.ndarray
    ranges_m: np.ndarray


def scatter_before(
    medium: Fog,
    eyes_z_m: np.ndarray,
    ends_m: np.ndarray,
    model: LidarModel,
    rng: np.random.Generator,
) -> Scatter:
    """What comes back from the smog before surfaces at ends_m [N].

    Its strength varies with the clumps that a beam meets (CLUMPS); the range of the strongest is
    drawn from the echo's shape. N numbers of each are drawn whatever the density, so that denser
    smog differs by nothing else.
    """
    count = len(ends_m)
    clump = rng.standard_gamma(CLUMPS, count) / CLUMPS
    where = rng.random(count)
    alpha = extinction_at(medium, eyes_z_m)
    out = Scatter(np.zeros(count), np.zeros(count))
    usable = (alpha > 0) & (ends_m > model.overlap_from_m) & np.isfinite(alpha)
    group = np.rint(np.log(np.where(usable, alpha, 1.0)) / _DENSITY_STEP).astype(np.int64)
    low, high = (group[usable].min(), group[usable].max()) if usable.any() else (0, -1)
    for number in range(low, high + 1):
        rows = np.flatnonzero(usable & (group == number)) if high > low else np.flatnonzero(usable)
        if not len(rows):
            continue
        is_uniform = medium.scale_height_m is None
        mean = medium.sigma_per_m if is_uniform else math.exp(number * _DENSITY_STEP)
        echo = soft_echo(float(mean), model)
        last = ((ends_m[rows] - echo.ranges_m[0]) / _STEP_M).astype(np.int64)
        last = np.clip(last, 0, len(echo.ranges_m) - 1)
        out.signal[rows] = echo.strongest[last] * clump[rows]
        at = np.interp(where[rows] * echo.share[last], echo.share, echo.ranges_m)
        out.ranges_m[rows] = np.minimum(at, ends_m[rows])
    return out


def fog_echoes(echoes: Echoes, medium: Fog, rng: np.random.Generator) -> None:
    """Echoes seen through the fog, or lost to its own. medium: of visible light."""
    model = echoes.model
    factor = wavelength_factor(medium.sigma_per_m, model.wavelength_um)
    medium = dataclasses.replace(medium, sigma_per_m=factor * medium.sigma_per_m)
    eyes_z, air = echoes.origins[:, 2], echoes.air_m
    ends_z = eyes_z + air * echoes.directions[:, 2]
    tau = optical_depth_of_arrays(medium, air, eyes_z, ends_z, series_below=1e-4)
    echoes.gain *= np.exp(-2 * tau)
    scatter = scatter_before(medium, eyes_z, air, model, rng)
    echoes.haze_per_m += extinction_at(medium, eyes_z)
    echo = signal(echoes.reflectance * echoes.gain, np.maximum(echoes.ranges_m, 1e-3))
    wins = (scatter.signal > echo) & (echoes.ranges_m > 0) & (echoes.codes != LOST)
    rows = np.flatnonzero(wins)
    ranges = scatter.ranges_m[rows]
    # As reflectance of a surface whose echo from that range is as strong.
    white = signal(np.ones(len(rows)), np.maximum(ranges, 1e-3))
    echoes.replace(rows, ranges, scatter.signal[rows] / white, SCATTERED)
