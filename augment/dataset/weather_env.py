"""Weather for gymnasium environments that render themselves.

    env = weather_env(gymnasium.make("hugsim_env/HUGSim-v0"), "dense-fog", axes="y-down")

The observations keep their keys and shapes; their pictures are in the weather, from the depth that
comes with them. `augment.view.given_picture` says which effects that suffices for. gymnasium comes
with the extra `gym`, and is imported when `weather_env` is called.

An observation has a dict for each kind of image, by camera name:

    observation   rgb       uint8 [H, W, 3]
                  depth     float [H, W] or [H, W, 1], metres
                  semantic  uint8 [H, W], optional: `sky_classes` are its numbers of the sky
    info          cam_params, by camera name: {"intrinsic": {"W", "H", "cx", "cy", and "fx", "fy" or
                      "fovx", "fovy" in radians}, "v2c": camera_from_vehicle, [4, 4]}
                  ego_pos   position of the vehicle in the world, [3], metres
                  ego_rot   rotation of the vehicle: [3] Euler angles XYZ in radians, or [3, 3]
                  timestamp seconds

An environment with other keys passes a function `cameras_of(observation, info)`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from augment.errors import ClimateGSError, SceneError
from augment.scene.cameras import Camera, Frame
from augment.view.given_picture import (
    GivenPicture,
    check_recipe,
    omitted_effects,
    stand_in_scene,
    weather_picture,
)
from recipes.load import load_recipe
from recipes.moment import SceneTimes
from recipes.schema import Recipe

if TYPE_CHECKING:
    import gymnasium

# Axes of an environment's world and vehicle: x ahead, y left, z up; or x right, y down, z ahead.
Axes = Literal["z-up", "y-down"]
# Cameras of an observation, by name.
CamerasOf = Callable[[Mapping[str, Any], Mapping[str, Any]], Mapping[str, Camera]]
# Our world's axes, of those of a world in which y points down.
_ZUP_FROM_YDOWN = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
# Error of a rotation's matrix that an environment's float32 may have.
_MAX_ROTATION_ERROR = 1e-3


class EnvWeather:
    """Puts observations into the weather of a recipe, step by step.

    Equal recipes, seeds and observations give equal bits. A step depends on the step before it
    only by the camera's motion, which streaks follow.
    """

    def __init__(
        self,
        recipe: Recipe | str,
        *,
        axes: Axes = "z-up",
        cameras_of: CamerasOf | None = None,
        depth: Literal["z", "ray"] = "z",
        max_depth_m: float = 1000.0,
        sky_classes: tuple[int, ...] = (),
        sky_rgb: tuple[float, float, float] = (0.62, 0.66, 0.72),
        ground_z_m: float | None = None,
        duration_s: float | None = None,
        omits_scene_effects: bool = False,
        name: str = "environment",
    ) -> None:
        """Prepare the weather.

        Args:
            recipe: a resolved recipe, or the name of a preset or of a recipe file.
            axes: axes of the environment's world and vehicle.
            cameras_of: returns the cameras of an observation, with poses in metres in a world whose
                z points up; None reads the keys above.
            depth: "z" along the optical axis, or "ray" along each pixel's ray.
            max_depth_m: pixels from here on show the sky, and so do those of no depth.
            sky_classes: numbers of the sky in the observation's classes.
            sky_rgb: colour of the sky, by which drops and flakes are lit, 0 to 1.
            ground_z_m: height of the road, for fog by height; None where unknown.
            duration_s: length of an episode, for weather that changes over time.
            omits_scene_effects: if True, effects that need a scene are left out, and `omitted`
                names them; else they are refused.
            name: name of the world; streaks and fog banks depend on it.

        Raises:
            SceneError: the recipe needs a scene, or changes over time without a duration.
            RecipeError: a timeline goes beyond the duration.
        """
        if isinstance(recipe, str):
            recipe = load_recipe(recipe).resolve(0)
        if recipe.changes_over_time and duration_s is None:
            raise SceneError(
                f"recipe {recipe.name} changes over time: state duration_s, the seconds that an "
                f"episode lasts"
            )
        if not (math.isfinite(max_depth_m) and max_depth_m > 0):
            raise SceneError(f"max_depth_m must be finite and > 0; got {max_depth_m}")
        self._recipe = recipe
        self._cameras_of = cameras_of
        self._axes: Axes = axes
        self._depth = depth
        self._max_depth_m = max_depth_m
        self._sky_classes = sky_classes
        self._scene_facts: dict[str, Any] = {"sky_rgb": sky_rgb, "ground_z_m": ground_z_m}
        self._duration_s = duration_s
        self._name = name
        self._first: Frame | None = None
        self._latest: Frame | None = None
        end_ns = round(1e9 * (duration_s or 0.0))
        probe_frames = (_empty_frame(0, 0), _empty_frame(1, end_ns))
        probe = stand_in_scene(name, probe_frames, **self._scene_facts)
        states = recipe.over_time(SceneTimes(0, end_ns))
        if not omits_scene_effects:
            for state in states:
                check_recipe(state, probe)
        omitted = dict.fromkeys(n for state in states for n in omitted_effects(state, probe))
        self.omitted: tuple[str, ...] = tuple(omitted)
        """Names of the recipe's effects that are left out."""

    @property
    def recipe(self) -> Recipe:
        """Return the recipe of the episode at hand."""
        return self._recipe

    def reset(self, seed: int | None = None) -> None:
        """Begin an episode.

        Args:
            seed: seed of its weather; None leaves the seed as it is.
        """
        self._first = None
        self._latest = None
        if seed is not None:
            self._recipe = self._recipe.model_copy(update={"seed": seed})

    def apply(
        self, observation: Mapping[str, Any], info: Mapping[str, Any]
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return an observation in the weather, and its info.

        The info gets `weather_masks`: by camera and effect, bool [H, W], pixels that show streaks,
        flakes or drops.

        Args:
            observation: the environment's observation.
            info: the environment's info.

        Raises:
            SceneError: a key is missing, or an image does not fit its camera.
        """
        cameras = self._cameras(observation, info)
        frame = Frame(0, next(iter(cameras.values())).timestamp_ns, torch.eye(4).double(), cameras)
        scene = stand_in_scene(self._name, self._frames_with(frame), **self._scene_facts)
        images = dict(_required(observation, "rgb", "observation"))
        depths = _required(observation, "depth", "observation")
        masks: dict[str, dict[str, np.ndarray]] = {}
        for name, camera in cameras.items():
            classes = observation.get("semantic", {}).get(name)
            depth_m = self._z_of(_required(depths, name, "depth"), classes, camera)
            rgb = np.asarray(_required(images, name, "rgb"))
            weathered = weather_picture(GivenPicture(rgb, depth_m, camera), scene, self._recipe)
            images[name] = weathered.rgb
            masks[name] = dict(weathered.masks)
        return {**observation, "rgb": images}, {**info, "weather_masks": masks}

    def _frames_with(self, frame: Frame) -> tuple[Frame, ...]:
        """Return the frames of the episode's start, of the last step and of this one."""
        first = frame if self._first is None else self._first
        latest = frame if self._latest is None else self._latest
        if frame.timestamp_ns < latest.timestamp_ns:
            raise SceneError(
                f"the environment's time went back from {latest.timestamp_ns} ns to "
                f"{frame.timestamp_ns} ns; call reset first"
            )
        self._first = first
        self._latest = frame
        frames = {f.timestamp_ns: f for f in (first, latest, frame)}
        if self._duration_s is not None:
            end_ns = first.timestamp_ns + round(1e9 * self._duration_s)
            frames.setdefault(end_ns, _empty_frame(0, end_ns))
        return tuple(frames[time_ns] for time_ns in sorted(frames))

    def _cameras(
        self, observation: Mapping[str, Any], info: Mapping[str, Any]
    ) -> Mapping[str, Camera]:
        """Return the cameras of an observation, by name."""
        if self._cameras_of is not None:
            cameras = self._cameras_of(observation, info)
        else:
            cameras = read_cameras(info, self._axes)
        if not cameras:
            raise SceneError("the environment names no camera, so there is no picture to weather")
        return cameras

    def _z_of(self, depth: Any, classes: Any, camera: Camera) -> np.ndarray:
        """Return z of each pixel, metres, float32 [H, W]; 0 for the sky."""
        depth_m = np.asarray(depth, np.float32)
        size = (camera.height, camera.width)
        if depth_m.shape == (*size, 1):
            depth_m = depth_m[..., 0]
        if depth_m.shape != size:
            raise SceneError(
                f"camera {camera.name!r}: depth must be {list(size)}, as cam_params state; got "
                f"{list(depth_m.shape)}"
            )
        is_surface = np.isfinite(depth_m) & (depth_m > 0) & (depth_m < self._max_depth_m)
        if self._sky_classes and classes is not None:
            class_image = np.asarray(classes)
            if class_image.shape not in (size, (*size, 1)):
                raise SceneError(
                    f"camera {camera.name!r}: semantic must be {list(size)}, as cam_params state; "
                    f"got {list(class_image.shape)}"
                )
            is_surface &= ~np.isin(class_image.reshape(size), self._sky_classes)
        if self._depth == "ray":
            depth_m = depth_m / camera.ray_lengths().numpy()
        return np.where(is_surface, depth_m, np.float32(0))


def weather_env(env: gymnasium.Env, recipe: Recipe | str, **options: Any) -> gymnasium.Env:
    """Return an environment whose observations are in a recipe's weather.

    Rewards, actions and physics stay those of the environment. `reset(seed=…)` also sets the seed
    of the weather.

    Args:
        env: the environment.
        recipe: as for `EnvWeather`.
        options: further arguments of `EnvWeather`.

    Raises:
        ClimateGSError: gymnasium is not installed.
        SceneError: as `EnvWeather`.
    """
    try:
        import gymnasium
    except ImportError:
        raise ClimateGSError("weather_env needs gymnasium: pip install 'climategs[gym]'") from None

    weather = EnvWeather(recipe, **options)

    class WeatherEnv(gymnasium.Wrapper):
        """The environment in the weather."""

        def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
            """Begin an episode; returns its first observation and info."""
            observation, info = self.env.reset(seed=seed, options=options)
            weather.reset(seed)
            return weather.apply(observation, info)

        def step(self, action: Any) -> Any:
            """Do a step; returns observation, reward, terminated, truncated and info."""
            observation, reward, terminated, truncated, info = self.env.step(action)
            observation, info = weather.apply(observation, info)
            return observation, reward, terminated, truncated, info

    return WeatherEnv(env)


# ---- Cameras from an environment's own keys ------------------------------------------------------


def read_cameras(info: Mapping[str, Any], axes: Axes) -> dict[str, Camera]:
    """Return the cameras that an environment's info states.

    Args:
        info: the info, with the keys that this module's description lists.
        axes: axes of the environment's world and vehicle.

    Raises:
        SceneError: a key is missing, or a number is not usable.
    """
    position = _array(_required(info, "ego_pos", "info"), (3,), "ego_pos")
    rotation = np.asarray(_required(info, "ego_rot", "info"), np.float64)
    world_from_vehicle = np.eye(4)
    if rotation.shape == (3,):
        rotation = Rotation.from_euler("XYZ", rotation).as_matrix()
    world_from_vehicle[:3, :3] = _array(rotation, (3, 3), "ego_rot")
    world_from_vehicle[:3, 3] = position
    if axes == "y-down":
        world_from_vehicle = _ZUP_FROM_YDOWN @ world_from_vehicle
    time_s = float(_required(info, "timestamp", "info"))
    if not math.isfinite(time_s):
        raise SceneError(f"info: timestamp must be finite; got {time_s}")
    cameras = {}
    for name, parameters in _required(info, "cam_params", "info").items():
        where = f"cam_params of {name!r}"
        intrinsic = _required(parameters, "intrinsic", where)
        camera_from_vehicle = _array(_required(parameters, "v2c", where), (4, 4), f"{where}: v2c")
        pose = camera_from_vehicle @ np.linalg.inv(world_from_vehicle)
        error = float(np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max())
        if error > _MAX_ROTATION_ERROR:
            raise SceneError(
                f"{where}: v2c must be a rotation and a shift; it is off by {error:.3g}"
            )
        width = int(_required(intrinsic, "W", where))
        height = int(_required(intrinsic, "H", where))
        try:
            cameras[name] = Camera(
                name=name,
                width=width,
                height=height,
                fx=_focal_px(intrinsic, "x", width, where),
                fy=_focal_px(intrinsic, "y", height, where),
                cx=float(intrinsic.get("cx", width / 2)),
                cy=float(intrinsic.get("cy", height / 2)),
                camera_from_world=torch.from_numpy(_rigid(pose)),
                timestamp_ns=round(1e9 * time_s),
            )
        except ValueError as error:
            raise SceneError(f"{where}: {error}") from None
    return cameras


def _focal_px(intrinsic: Mapping[str, Any], axis: str, size_px: int, where: str) -> float:
    """Return the focal length of an axis, which is stated or follows from the angle of view."""
    if f"f{axis}" in intrinsic:
        return float(intrinsic[f"f{axis}"])
    angle_rad = float(_required(intrinsic, f"fov{axis}", where))
    if not 0 < angle_rad < math.pi:
        raise SceneError(f"{where}: fov{axis} must be 0 to pi radians; got {angle_rad}")
    return size_px / (2 * math.tan(angle_rad / 2))


def _rigid(pose: np.ndarray) -> np.ndarray:
    """Return a pose whose rotation is exactly one: float32 environments round."""
    left, _, right = np.linalg.svd(pose[:3, :3])
    rigid = pose.copy()
    rigid[:3, :3] = left @ right
    return rigid


def _array(values: Any, shape: tuple[int, ...], where: str) -> np.ndarray:
    """Return finite numbers as float64."""
    array = np.asarray(values, np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise SceneError(f"{where} must be {list(shape)} finite numbers; got {values!r:.80}")
    return array


def _required(mapping: Mapping[str, Any], key: str, where: str) -> Any:
    """Return the value of a key."""
    if key not in mapping:
        raise SceneError(
            f"{where} has no {key!r}; it has {', '.join(map(str, mapping)) or 'nothing'}. Give "
            f"cameras_of for an environment with other keys"
        )
    return mapping[key]


def _empty_frame(index: int, timestamp_ns: int) -> Frame:
    """Return a frame without cameras."""
    return Frame(index, timestamp_ns, torch.eye(4, dtype=torch.float64), {})
