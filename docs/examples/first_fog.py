"""Render one camera of the embedded street, clear and in fog.

Run it with: python docs/examples/first_fog.py [OUTPUT_FOLDER]
The first run of an example also compiles kernels, which takes about half a minute.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from adapters.base import open_scene
from augment import render_view
from recipes.load import load_recipe

STREET = "procedural:street?seed=3&gaussians=60000&frames=2&width=480&height=270"


def main(output_dir: Path) -> None:
    """Write first_fog.png: the clear view on the left, the foggy one on the right."""
    scene = open_scene(STREET)
    camera = scene.frames[0].cameras["front"]

    # A preset, and the same preset with one field replaced. resolve(0) draws variant 0: it turns
    # every range of the recipe into a number.
    clear = load_recipe("clear").resolve(0)
    fog = load_recipe("dense-fog", {"weather.smog.visibility_m": 60}).resolve(0)

    views = [render_view(scene, camera, recipe) for recipe in (clear, fog)]
    picture = np.hstack([view.rgb for view in views])  # uint8 [H, 2 W, 3], red first

    output_dir.mkdir(parents=True, exist_ok=True)
    path = output_dir / "first_fog.png"
    cv2.imwrite(str(path), picture[..., ::-1])  # OpenCV takes blue first
    print(f"picture: {path}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples"))
