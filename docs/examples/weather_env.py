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
SKY = 14  # number of the sky in StreetEnv's classes


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
        return *self.observe()[:1], 0.0, False, False, self.observe()[1]

    def observe(self):
        camera = self.scene.frames[self.number].cameras["front"]
        view = render_view(self.scene, camera, CLEAR.resolve(0))
        images = {"rgb": view.rgb, "depth": view.depth_m, "semantic": view.semantic}
        size = {"W": camera.width, "H": camera.height, "cx": camera.cx, "cy": camera.cy}
        lens = {**size, "fx": camera.fx, "fy": camera.fy}
        front = {"intrinsic": lens, "v2c": camera.camera_from_world.numpy()}
        pose = {"ego_pos": np.zeros(3), "ego_rot": np.zeros(3), "timestamp": 0.1 * self.number}
        return {k: {"front": v} for k, v in images.items()}, {
            **pose,
            "cam_params": {"front": front},
        }


def main(output_dir: Path) -> None:
    """Write weather_env.png: the street clear, and in the fog of the second step."""
    output_dir.mkdir(parents=True, exist_ok=True)
    env = weather_env(StreetEnv(), "dense-fog", sky_classes=(SKY,))
    env.reset(seed=7)
    foggy, _, _, _, _ = env.step(env.action_space.sample())
    clear, _ = env.unwrapped.observe()
    path = output_dir / "weather_env.png"
    pictures = np.hstack([clear["rgb"]["front"], foggy["rgb"]["front"]])
    cv2.imwrite(str(path), pictures[..., ::-1])
    print(f"picture: {path}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples"))
