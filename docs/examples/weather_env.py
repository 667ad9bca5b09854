"""Put an environment that renders itself into fog: a gymnasium environment with depth and cameras.

Run it with: python docs/examples/weather_env.py [OUTPUT_FOLDER]; it needs climategs[gym].
StreetEnv stands for any simulator with HUGSIM's keys; docs/dataset.md lists them.
"""

import sys
from pathlib import Path

import cv2
import gymnasium
import numpy as np

from adapters.base import open_scene
from augment import render_view
from augment.dataset.weather_env import weather_env
from recipes.load import parse_recipe

STREET = "procedural:street?seed=3&gaussians=60000&frames=5&width=480&height=270"
CLEAR = parse_recipe("version: 1\noutput: {depth: expected, semantic: true}\n", source="clear")


class StreetEnv(gymnasium.Env):
    """A car that drives down the embedded street, whatever the action is."""

    observation_space = gymnasium.spaces.Dict({})  # a real one lists its images
    action_space = gymnasium.spaces.Box(-1, 1, (2,))  # acceleration and rate of steering

    def reset(self, *, seed=None, options=None):
        self.scene = open_scene(STREET)
        self.number = 0
        return self.observe()

    def step(self, action):
        self.number += 1
        observation, info = self.observe()
        return observation, 0.0, False, False, info

    def observe(self):
        camera = self.scene.frames[self.number].cameras["front"]
        view = render_view(self.scene, camera, CLEAR.resolve(0))
        images = {"rgb": view.rgb, "depth": view.depth_m, "semantic": view.semantic}
        lens = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")}
        lens |= {"W": camera.width, "H": camera.height}
        info = {"ego_pos": [0, 0, 0], "ego_rot": [0, 0, 0], "timestamp": 0.1 * self.number}
        pose = camera.camera_from_world.numpy()
        info["cam_params"] = {"front": {"intrinsic": lens, "v2c": pose}}
        return {kind: {"front": image} for kind, image in images.items()}, info


def main(output_dir: Path) -> None:
    """Write weather_env.png: the street clear, and in the fog of the second step."""
    output_dir.mkdir(parents=True, exist_ok=True)
    env = weather_env(StreetEnv(), "dense-fog", sky_classes=(14,))  # the sky in StreetEnv
    env.reset(seed=7)
    foggy = env.step(env.action_space.sample())[0]
    clear = env.unwrapped.observe()[0]
    path = output_dir / "weather_env.png"
    cv2.imwrite(str(path), np.hstack([o["rgb"]["front"] for o in (clear, foggy)])[..., ::-1])
    print(f"picture: {path}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples"))
