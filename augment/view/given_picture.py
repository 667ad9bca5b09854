"""Weather on pictures that something else has rendered, from their depth alone.

In: a picture, its depth, its camera and a recipe. Out: the picture in the recipe's weather.
`augment.dataset.weather_env` calls it for environments that render themselves.

Without splats there is no scene to change. What lies in the air or on the lens needs only the
picture and its depth:

    smog                fades the picture by its depth (Koschmieder), uniform, by height or in banks
    rain, snowfall      streaks and flakes between the camera and each pixel's surface, their veil
    drops on the lens   show the picture itself
    lens blur, noise    of the sensor

All else is refused: wet or snowy ground, flood, spray, lamps and styles change surfaces that a
picture does not have. The fading of shadows in fog and rain needs the ground's colours and is
left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from augment import effects
from augment.effects.effect import Effect, EffectInScene, RenderedView
from augment.errors import SceneError
from augment.render.buffers import CPU, RenderOutput
from augment.render.composite import to_bytes
from augment.render.constants import RasterSettings
from augment.render.fog import blend_airlight
from augment.render.fog_image import image_optical_depth, sky_image_depth
from augment.render.sensor import add_noise, blur_lens
from augment.scene.cameras import Camera, Frame
from augment.scene.scene import Gaussians, Scene
from augment.scene.scene_times import times_of_drive
from augment.scene.sky import ConstantSky
from augment.view.layers import LayerRenderer
from recipes.moment import SceneTimes
from recipes.schema import Recipe

# Effects that a picture and its depth suffice for, in the order of `EFFECTS`.
POSSIBLE_EFFECTS = ("smog", "rain", "snowfall", "lens_drops")
# Distance of the one invisible splat of a stand-in scene, metres.
_FAR_M = 1e5


@dataclass(frozen=True, eq=False)
class GivenPicture:
    """A picture that something else has rendered."""

    rgb: np.ndarray
    """The picture, uint8 [H, W, 3]."""
    depth_m: np.ndarray
    """z of each pixel's surface along the optical axis, metres, float32 [H, W]; 0 for the sky."""
    camera: Camera
    """The camera, with its pose and the picture's time."""

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        where = f"picture of camera {self.camera.name!r}"
        if self.rgb.dtype != np.uint8 or self.rgb.shape != (*size, 3):
            raise SceneError(
                f"{where}: rgb must be uint8 {[*size, 3]}, as its camera states; got "
                f"{self.rgb.dtype} {list(self.rgb.shape)}"
            )
        if self.depth_m.dtype != np.float32 or self.depth_m.shape != size:
            raise SceneError(
                f"{where}: depth_m must be float32 {list(size)}, as its camera states; got "
                f"{self.depth_m.dtype} {list(self.depth_m.shape)}"
            )
        if not bool((np.isfinite(self.depth_m) & (self.depth_m >= 0)).all()):
            raise SceneError(f"{where}: depth_m must be finite and >= 0, and 0 for the sky")


@dataclass(frozen=True, eq=False)
class WeatheredPicture:
    """A picture in the weather."""

    rgb: UInt8[np.ndarray, "H W 3"]
    """The picture."""
    masks: Mapping[str, Bool[np.ndarray, "H W"]]
    """Pixels that show streaks, flakes or drops on the lens, by the effect's name."""


def stand_in_scene(
    name: str,
    frames: Sequence[Frame],
    *,
    sky_rgb: tuple[float, float, float] = (0.62, 0.66, 0.72),
    ground_z_m: float | None = None,
) -> Scene:
    """Return a scene of nothing visible, for effects that ask a scene for its cameras and sky.

    Args:
        name: name of the scene; streaks and fog banks depend on it.
        frames: the latest frames, by which the camera moves while its shutter is open.
        sky_rgb: colour of the sky, by which drops and flakes are lit.
        ground_z_m: height of the road in the world; None where unknown.
    """
    splat = Gaussians(
        means=torch.tensor([[0.0, 0.0, -_FAR_M]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        scales=torch.ones(1, 3),
        opacities=torch.zeros(1),
        sh=torch.zeros(1, 1, 3),
    )
    sky = ConstantSky(torch.tensor(sky_rgb, dtype=torch.float32))
    return Scene(name, "stand-in", splat, (), sky, tuple(frames), ground_z_m=ground_z_m)


def check_recipe(recipe: Recipe, scene: Scene) -> None:
    """Refuse a recipe that needs more than pictures and their depth.

    Args:
        recipe: the recipe at a moment.
        scene: a stand-in scene.

    Raises:
        SceneError: names the effects, and what to do.
    """
    missing = [effect for effect in effects.EFFECTS if _needs_scene(effect, recipe, scene)]
    if missing:
        sections = ", ".join(f"{effect.name} ({effect.section})" for effect in missing)
        raise SceneError(
            f"recipe {recipe.name}: {sections} changes surfaces of a scene, and an environment "
            f"gives only pictures with their depth; set it to null or 0 (wet ground of rain: "
            f"weather.rain.wetness: 0), or take "
            f"omits_scene_effects=True to leave it out"
        )


def omitted_effects(recipe: Recipe, scene: Scene) -> tuple[str, ...]:
    """Return the names of the recipe's effects that need a scene."""
    return tuple(effect.name for effect in effects.EFFECTS if _needs_scene(effect, recipe, scene))


def weather_picture(picture: GivenPicture, scene: Scene, recipe: Recipe) -> WeatheredPicture:
    """Return a picture in a recipe's weather; effects that need a scene are passed over.

    Args:
        picture: the picture.
        scene: a stand-in scene, whose frames have the picture's camera.
        recipe: the recipe; if it changes over time, by the scene's times.

    Raises:
        SceneError: fog by height, without the height of the road.
    """
    camera = picture.camera
    times = _times_of(scene)
    time_s = recipe.weather_time_s(times, camera.timestamp_ns)
    recipe = recipe.at_weather_time(times, time_s)
    view = _view_of(picture, scene)
    earlier: tuple[EffectInScene, ...] = ()
    for effect in effects.EFFECTS:
        if effect.name not in POSSIBLE_EFFECTS:
            continue
        data = effect.plan_in_scene(recipe, scene, {}).data
        if data is None:
            continue
        at_work = EffectInScene(effect, data, scene, CPU, earlier, weather_time_s=time_s)
        earlier = (*earlier, at_work)
        layers = effect.edit_scene(at_work, view.layers, camera)
        if layers.fog is not view.layers.fog:
            view = _through_fog(replace(view, layers=layers), camera)
        view = effect.edit_image(at_work, view, camera)
    rgb = view.rgb
    if recipe.camera.psf_px > 0:
        rgb = blur_lens(rgb, recipe.camera.psf_px)
    if recipe.camera.noise > 0:
        rgb = add_noise(
            rgb, recipe.camera.noise, camera, seed=recipe.seed, scene=scene.name, backend=CPU
        )
    masks = {name: mask.numpy() for name, mask in view.masks.items()}
    return WeatheredPicture(to_bytes(rgb).numpy(), masks)


def _times_of(scene: Scene) -> SceneTimes:
    """Return the times of a stand-in scene's frames."""
    return times_of_drive((), [frame.timestamp_ns for frame in scene.frames])


def _needs_scene(effect: Effect, recipe: Recipe, scene: Scene) -> bool:
    """Return True if an effect is in the recipe and cannot be made from a picture."""
    if effect.name in POSSIBLE_EFFECTS:
        return False
    try:
        return effect.plan_in_scene(recipe, scene, {}).data is not None
    except SceneError:  # it asks for what a stand-in scene does not have
        return True


def _view_of(picture: GivenPicture, scene: Scene) -> RenderedView:
    """Return the picture as if it had been rendered from splats."""
    rgb = torch.from_numpy(picture.rgb).float() / 255
    depth = torch.from_numpy(picture.depth_m)
    alpha = (depth > 0).float()
    raster = RenderOutput(
        rgb=rgb * alpha[..., None], alpha=alpha, expected_depth=depth, median_depth=depth
    )
    layers = LayerRenderer((), scene.sky, None, True, RasterSettings(), CPU)
    return RenderedView(rgb, raster, layers)


def _through_fog(view: RenderedView, camera: Camera) -> RenderedView:
    """Return the view through the fog of its layers, up to each pixel's surface or the sky."""
    fog = view.layers.fog
    depth = view.raster.expected_depth
    alpha = view.raster.alpha
    assert fog is not None and depth is not None and alpha is not None
    slope = _ray_slope(camera)
    tau = image_optical_depth(fog, camera, depth, backend=CPU)
    tau = torch.where(alpha > 0, tau, sky_image_depth(fog, camera, slope, backend=CPU))
    rgb = blend_airlight(view.rgb, tau, fog, slope)
    raster = replace(view.raster, rgb=rgb * alpha[..., None], fog_share=1 - torch.exp(-tau))
    return replace(view, rgb=rgb, raster=raster)


def _ray_slope(camera: Camera) -> Float[Tensor, "H W"]:
    """Return the vertical part of the unit direction of each pixel."""
    return camera.ray_directions()[..., 2] / camera.ray_lengths()
