"""Pictures of styles for the docs: methods, presets, strengths, regions, order, failures.

All show the procedural street. Panels are drawn twice as large as they are shown.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from adapters.base import open_scene
from augment.cameras import Camera
from augment.effects.style.images import read_style_image
from augment.effects.style.network import SHIPPED
from augment.effects.style.train import SUFFIXES
from augment.plan import make_plan
from augment.render.composite import quantise
from augment.scene import Scene
from augment.views import render_buffers
from recipes.schema import Output, Recipe, Smog, Weather
from recipes.weather import Snow, Style, style_preset_names
from tools.drawing import GAP_PX, captioned, strip, write_jpeg

STREET = "procedural:street?seed=3"
CAMERA, FRAME = "front", 5
PANEL_PX = 288
LARGER = 2  # panels are rendered, and then averaged down
ROWS = 3  # of photos on the sheet of methods
METHODS = {"reinhard": "Reinhard", "mkl": "MKL", "gscm": "GSCM"}
PHOTOS = ("21.jpg", "06.jpg", "22.jpg")  # Kodak's, shown where the folder has them
REGION_PHOTOS = ("16.jpg", "11.jpg")
# What goes wrong: Kodak's photos, and presets.
FAILING_PHOTOS = {
    "02.jpg": "a red door: the whole street is red",
    "13.jpg": "a forest: walls and road turn green",
    "03.jpg": "caps in the sun: leaves turn acid",
}
FAILING_PRESETS = {
    "night": "night: no lamp is lit, shadows of day stay",
    "golden-hour": "golden-hour: shadows stay as they fell",
}
STRENGTHS = (0.0, 0.5, 1.0, 2.0)
CELL_M = 0.1  # of snow


def draw_style_pictures(
    folder: Path, *, photos: Path | None = None, checkpoint: Path | None = None
) -> list[Path]:
    """JPEGs: style-methods, style-presets, style-strengths, style-regions, style-order and
    style-failures.

    photos: a folder of style images; without one presets stand in. checkpoint: the network; None
    for the shipped one. Where there is neither photo nor network, the panels of GSCM are left out.
    """
    stage = Stage.open(photos, checkpoint)
    drawings: dict[str, Callable[[Stage], np.ndarray]] = {
        "style-methods": draw_methods,
        "style-presets": draw_presets,
        "style-strengths": draw_strengths,
        "style-regions": draw_regions,
        "style-order": draw_order,
        "style-failures": draw_failures,
    }
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, draw in tqdm(drawings.items(), unit="picture"):
        paths.append(folder / f"{name}.jpg")
        write_jpeg(paths[-1], draw(stage))
    return paths


@dataclass(frozen=True, eq=False)
class Stage:
    """The scene and the camera that all panels show. photos: by name, in order."""

    scene: Scene
    camera: Camera
    photos: Mapping[str, Path]
    checkpoint: Path | None
    has_network: bool

    @classmethod
    def open(cls, photos: Path | None, checkpoint: Path | None) -> Stage:
        scene = open_scene(STREET)
        camera = scene.frame(FRAME).cameras[CAMERA]
        files = sorted(photos.iterdir()) if photos is not None else []
        return cls(
            scene,
            camera.scaled(LARGER * PANEL_PX / camera.width),
            {p.name: p for p in files if p.suffix.lower() in SUFFIXES},
            checkpoint,
            checkpoint is not None or SHIPPED.is_file(),
        )

    def panel(self, title: str, text: str = "", **recipe: Any) -> np.ndarray:
        """The scene under a recipe, with two lines below."""
        plan = make_plan(Recipe(output=Output(depth="none", labels=False), **recipe), self.scene)
        picture = quantise(render_buffers(self.scene, self.camera, plan).rgb)
        return captioned(self._small(picture), title, text)

    def photo(self, name: str, title: str = "style", text: str = "") -> np.ndarray:
        """A style image, fitted into a panel."""
        rgb = (255 * read_style_image(self.photos[name]).rgb).round().astype(np.uint8)
        width, height = PANEL_PX, self._height
        scale = min(width / rgb.shape[1], height / rgb.shape[0])
        size = round(rgb.shape[1] * scale), round(rgb.shape[0] * scale)
        small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
        panel = np.full((height, width, 3), 255, np.uint8)
        left = (width - size[0]) // 2
        panel[: size[1], left : left + size[0]] = small
        return captioned(panel, title, text)

    def chosen(self, names: Sequence[str], count: int) -> list[str]:
        """Those of the names that there are photos of, else the first photos."""
        found = [name for name in names if name in self.photos]
        return (found or list(self.photos))[:count]

    def style(self, source: str, **fields: Any) -> Style:
        """Of a photo's name or of a preset."""
        if source in self.photos:
            if fields.get("method") == "gscm" and self.checkpoint is not None:
                fields["checkpoint"] = str(self.checkpoint)
            return Style(image=str(self.photos[source]), **fields)
        return Style(preset=source, **fields)

    @property
    def _height(self) -> int:
        return round(self.camera.height / LARGER)

    def _small(self, picture: np.ndarray) -> np.ndarray:
        return cv2.resize(picture, (PANEL_PX, self._height), interpolation=cv2.INTER_AREA)


def draw_methods(stage: Stage) -> np.ndarray:
    """A row a photo: the scene, the photo, and the scene in its colours by each method."""
    rows = []
    for name in stage.chosen(PHOTOS, ROWS):
        methods = [m for m in METHODS if m != "gscm" or stage.has_network]
        panels = [stage.panel(METHODS[m], style=stage.style(name, method=m)) for m in methods]
        rows.append([stage.panel("scene"), stage.photo(name), *panels])
    if not rows:
        for name in ("overcast", "golden-hour", "night"):
            panels = [
                stage.panel(METHODS[m], name, style=stage.style(name, method=m))
                for m in ("reinhard", "mkl")
            ]
            rows.append([stage.panel("scene"), *panels])
    return _grid(rows)


def draw_presets(stage: Stage) -> np.ndarray:
    """The scene and every preset."""
    panels = [stage.panel("as captured")]
    panels += [stage.panel(name, style=Style(preset=name)) for name in style_preset_names()]
    return _grid(_rows_of(panels, 5))


def draw_strengths(stage: Stage) -> np.ndarray:
    """A row a style: weaker and stronger than it is."""
    sources = ["golden-hour", "overcast", *stage.chosen(PHOTOS[2:3], 1)]
    return _grid([
        [
            stage.panel(
                f"strength {value:g}",
                "a photograph" if name in stage.photos else name,
                style=stage.style(name, strength=value),
            )
            for value in STRENGTHS
        ]
        for name in sources
    ])  # fmt: skip


def draw_regions(stage: Stage) -> np.ndarray:
    """A row a style: one map for the land and one for the sky, one a region, one for everything."""
    rows = []
    for source in stage.chosen(REGION_PHOTOS, 2) or ["golden-hour"]:
        maps = {
            "land and sky": stage.style(source),
            "per_region: true": stage.style(source, per_region=True),
            "applied_to: picture": stage.style(source, applied_to="picture"),
        }
        panels = [stage.panel(title, style=style) for title, style in maps.items()]
        shown = [stage.photo(source)] if source in stage.photos else []
        rows.append([stage.panel("scene"), *shown, *panels])
    return _grid(rows)


def draw_order(stage: Stage) -> np.ndarray:
    """Weather without a style, with the style under it, and with the style over it."""
    weather = Weather(
        smog=Smog(visibility_m=120), snow=Snow(depth_m=0.1, coverage=0.6, cell_m=CELL_M)
    )
    rows = []
    for name in ("golden-hour", "night"):
        panels = [stage.panel("snow and smog", "no style", weather=weather)]
        for where in ("scene", "picture"):
            style = Style(preset=name, applied_to=where)
            panels.append(stage.panel(f"applied_to: {where}", name, style=style, weather=weather))
        rows.append([stage.panel(name, "no weather", style=Style(preset=name)), *panels])
    return _grid(rows)


def draw_failures(stage: Stage) -> np.ndarray:
    """What no linear map of colours can do, and what statistics mistake for a mood."""
    panels = []
    for name in [name for name in FAILING_PHOTOS if name in stage.photos]:
        panels.append(stage.photo(name))
        panels.append(stage.panel("MKL", FAILING_PHOTOS[name], style=stage.style(name)))
    for name, text in FAILING_PRESETS.items():
        panels.append(stage.panel("preset", text, style=Style(preset=name)))
    return _grid(_rows_of(panels, 4))


def _rows_of(panels: Sequence[np.ndarray], count: int) -> list[list[np.ndarray]]:
    return [list(panels[at : at + count]) for at in range(0, len(panels), count)]


def _grid(rows: Sequence[Sequence[np.ndarray]]) -> np.ndarray:
    """Rows of panels of one size on white; short rows end early."""
    columns = max(map(len, rows))
    white = np.full_like(rows[0][0], 255)
    lines = [strip([*row, *[white] * (columns - len(row))]) for row in rows]
    gap = np.full((GAP_PX, lines[0].shape[1], 3), 255, np.uint8)
    return np.concatenate([part for line in lines for part in (gap, line)][1:])
