"""Pictures for a page: the camera of its window, images of a view, and overlays.

`server.py` calls these functions with a scene and a page's request; they know nothing of pages.
"""

from __future__ import annotations

import colorsys
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import torch

from augment import effects
from augment.effects.lidar.codes import CODE_COLUMN, drop_lost_returns
from augment.output.layout import TRUST
from augment.photo.trust import MAX_ANGLE_RAD, MAX_DISTANCE_M, nearest_view, source_views
from augment.render.buffers import AUTO, SPLAT_IDS
from augment.scene.boxes import EDGES, WorldBoxes
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import invert_rigid, rigid, rotmat_from_quat
from augment.scene.pinhole_views import covering_camera
from augment.scene.scene import Scene
from augment.scene.semantics import SemanticClass
from augment.view.plan import plan_at
from augment.view.render_view import render_buffers, render_view
from augment.view.weathered_sweep import weathered_sweep
from recipes.fields import with_unchecked_field
from recipes.schema import Recipe

FAR_M = 167.0  # The largest depth that the page can be sent, metres.
BAR = 24  # The grey of the bars where a recorded camera shows nothing, 0 to 255.
BAR_M = 0.05  # The depth of those bars, metres: they hide all that is drawn beyond.
MAX_DEPTH_M = 100.0  # The depth at the end of the colours of depth, metres.
PICTURE = "picture"  # The word for the rendered image.
DEPTH = "depth"  # The word for its depth in colours.
CLASSES = "classes"  # The word for its semantic classes in colours.
INSTANCES = "instances"  # The word for its instances in colours.
SPLATS = "splat ids"  # The word for the splats that its pixels show, in colours.
# The least values of fields of `render.speed` while something moves.
MOVING = {"transmittance_stop": 0.01, "radius_clip_px": 1.0}


# ---- The camera of a window ----------------------------------------------------------------------


class Place(NamedTuple):
    """Place of a camera's image in a window."""

    fov_rad: float
    """The window's vertical field of view, radians."""
    size: tuple[int, int]
    """The window's width and height, in pixels of the image."""
    left: int
    """The column of the window at which the image begins."""
    top: int
    """The row of the window at which the image begins."""


def place_in_window(camera: Camera, aspect: float) -> Place:
    """Return the place of a camera's image in the smallest window that holds all of it.

    The window looks along the camera's axis. The principal point of a window is its middle, while
    that of a camera may lie elsewhere. So the window has bars, and what the page draws over the
    image lies at the right pixels.

    Args:
        camera: The camera.
        aspect: The window's width divided by its height.
    """
    tan_x = max(camera.cx, camera.width - camera.cx) / camera.fx
    tan_y = max(camera.cy, camera.height - camera.cy) / camera.fy
    tan = max(tan_y, tan_x / aspect)
    width = max(camera.width, round(2 * tan * aspect * camera.fx))
    height = max(camera.height, round(2 * tan * camera.fy))
    left = min(max(round(width / 2 - camera.cx), 0), width - camera.width)
    top = min(max(round(height / 2 - camera.cy), 0), height - camera.height)
    return Place(2 * math.atan(tan), (width, height), left, top)


def free_camera(
    recorded: Camera,
    wxyz: Iterable[float],
    position: Iterable[float],
    fov_rad: float,
    aspect: float,
) -> Camera:
    """Return a camera at any pose, with the pixel density, colours and time of a recorded one.

    Args:
        recorded: The recorded camera.
        wxyz: Rotation of world_from_camera as a quaternion, OpenCV axes.
        position: Translation of world_from_camera in the scene's world.
        fov_rad: Vertical field of view, radians.
        aspect: Width divided by height.
    """
    quat = torch.tensor([*wxyz], dtype=torch.float64)
    pose = rigid(rotmat_from_quat(quat), torch.tensor([*position], dtype=torch.float64))
    tan = math.tan(fov_rad / 2)
    height = max(1, round(2 * tan * recorded.fy))
    width = max(1, round(height * aspect))
    focal = height / 2 / tan
    return replace(
        recorded,
        width=width,
        height=height,
        fx=focal,
        fy=focal,
        cx=width / 2,
        cy=height / 2,
        camera_from_world=invert_rigid(pose),
    )


def distance_warning(scene: Scene, camera: Camera) -> str | None:
    """Return a warning about a picture that is far from where any image was recorded.

    Returns:
        A sentence for the page; None if an image that the scene was made from is near enough, or
        if distances or those images are not known.
    """
    nearest = nearest_view(source_views(scene), camera)
    if nearest is None or not scene.has_metric_scale:
        return None
    if nearest.distance_m <= MAX_DISTANCE_M and nearest.angle_rad <= MAX_ANGLE_RAD:
        return None
    return (
        f"Outside of what was recorded: {nearest.distance_m:.1f} m and "
        f"{math.degrees(nearest.angle_rad):.0f} degrees from the nearest image that the scene was "
        f"made from. Beyond {MAX_DISTANCE_M:g} m or {math.degrees(MAX_ANGLE_RAD):.0f} degrees "
        f"surfaces may be missing, blurred or invented."
    )


# ---- Pictures ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class PageImage:
    """An image for a page."""

    rgb: np.ndarray
    """[H, W, 3], uint8. The rendered image, or colours that stand for depth, classes or numbers."""
    depth_m: np.ndarray | None
    """[H, W]. Depth z, metres, 0 where there is no surface; None if it was not requested."""


def picture_kinds() -> tuple[str, ...]:
    """Return the words for all kinds of pictures that a page can show."""
    masks = (f"mask of {e.mask_name}" for e in effects.EFFECTS if e.mask_name is not None)
    return (PICTURE, DEPTH, CLASSES, INSTANCES, SPLATS, *masks, f"mask of {TRUST}")


def recipe_to_show(recipe: Recipe, shows: str, *, with_depth: bool, factor: float) -> Recipe:
    """Return the recipe with the outputs that a page needs, at `factor` times its resolution.

    The recipe's own outputs stay. A picture that is drawn together with other buffers can differ
    in the last bit from one that is drawn alone. At factor 1 the page shows the bits that
    `climategs render` writes. Only the trust mask is left out if it is not shown: no picture
    depends on it.

    Args:
        recipe: The recipe.
        shows: The kind of the picture, one of `picture_kinds()`.
        with_depth: True if the page needs depth.
        factor: The resolution relative to the recipe's.
    """
    output = recipe.output
    depth = output.depth if output.depth != "none" else "median"
    output = output.model_copy(
        update={
            "depth": depth if with_depth or shows == DEPTH else output.depth,
            "semantic": output.semantic or shows == CLASSES,
            "instance": output.instance or shows == INSTANCES,
            "labels": output.labels or shows == INSTANCES,
            "trust": shows == f"mask of {TRUST}",
        }
    )
    recipe = recipe.model_copy(update={"output": output})
    return with_unchecked_field(recipe, "render.scale", recipe.render.scale * factor)


def coarse_recipe(recipe: Recipe, shows: str, *, with_depth: bool) -> Recipe:
    """Return the recipe of a picture while something moves.

    It has shortcuts of the rasteriser, and lacks outputs that the page does not show. No change
    makes a preparation run again. The arguments are those of `recipe_to_show`.
    """
    if shows == PICTURE and not with_depth:
        changes = {"depth": "none", "semantic": False, "instance": False, "labels": False}
        recipe = recipe.model_copy(update={"output": recipe.output.model_copy(update=changes)})
    for name, value in MOVING.items():
        value = max(value, getattr(recipe.render.speed, name))
        recipe = with_unchecked_field(recipe, f"render.speed.{name}", value)
    return recipe


def draw(
    scene: Scene, camera: Camera, recipe: Recipe, shows: str, *, backend: str = AUTO
) -> PageImage:
    """Draw the image that a page shows.

    Args:
        scene: The scene.
        camera: The camera, before `recipe.render.scale`.
        recipe: The recipe, from `recipe_to_show`.
        shows: The kind of the picture, one of `picture_kinds()`.
        backend: The rasteriser's backend.
    """
    if shows == SPLATS:
        return _draw_splat_ids(scene, camera, recipe, backend)
    view = render_view(scene, camera, recipe, backend=backend)
    rgb = view.rgb
    if shows == DEPTH and view.depth_m is not None:
        rgb = color_depth(view.depth_m)
    elif shows == CLASSES and view.semantic is not None:
        rgb = color_classes(view.semantic)
    elif shows == INSTANCES and view.instance is not None:
        rgb = np.where(view.instance[..., None] > 0, color_numbers(view.instance), rgb // 3)
    elif shows.startswith("mask of "):
        mask = view.masks.get(shows.removeprefix("mask of "))
        rgb = rgb // 3 if mask is None else np.where(mask[..., None] > 0, rgb, rgb // 3)
    return PageImage(rgb, view.depth_m)


def _draw_splat_ids(scene: Scene, camera: Camera, recipe: Recipe, backend: str) -> PageImage:
    recipe = with_unchecked_field(recipe, "output.semantic", True)
    _, plan = plan_at(recipe, scene, camera.timestamp_ns)
    pinhole = covering_camera(camera.scaled(recipe.render.scale))
    view = render_buffers(scene, pinhole, plan, backend=backend)
    ids = getattr(view.raster, SPLAT_IDS).cpu().numpy()
    rgb = np.where(ids[..., None] >= 0, color_numbers(ids), 0).astype(np.uint8)
    depth = None if view.depth_m is None else view.depth_m.float().cpu().numpy()
    return PageImage(rgb, depth)


def color_depth(depth_m: np.ndarray) -> np.ndarray:
    """Return colours of depths, uint8 [H, W, 3].

    The scale is logarithmic from red (near) to blue (MAX_DEPTH_M and more). Pixels without depth
    are black.
    """
    share = np.log(np.maximum(depth_m, 1.0)) / math.log(MAX_DEPTH_M)
    grey = (255 * (1 - np.clip(share, 0, 1))).astype(np.uint8)
    rgb = cv2.cvtColor(cv2.applyColorMap(grey, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    return np.where(depth_m[..., None] > 0, rgb, 0)


def color_numbers(numbers: np.ndarray) -> np.ndarray:
    """Return colours of whole numbers, uint8 [..., 3]. Successive numbers differ much in colour."""
    hashed = numbers.astype(np.uint32) * np.uint32(2654435761)
    hashed ^= hashed >> np.uint32(15)
    return np.stack([64 + (hashed >> np.uint32(s)) % 192 for s in (0, 8, 16)], -1).astype(np.uint8)


def color_classes(classes: np.ndarray) -> np.ndarray:
    """Return the colours of classes, uint8 [..., 3]. classes: uint8 numbers of SemanticClass."""
    return _CLASS_COLORS[classes]


def _class_colors() -> np.ndarray:
    """Return the colour of every class, uint8 [256, 3]: a hue each; grey for unknown numbers."""
    colors = np.full((256, 3), 90)
    for number, kind in enumerate(kinds := list(SemanticClass)[1:]):
        hue = number / len(kinds)
        rgb = colorsys.hsv_to_rgb(hue, 0.75 - 0.35 * (number % 2), 0.95)
        colors[int(kind)] = [round(255 * channel) for channel in rgb]
    return colors.astype(np.uint8)


_CLASS_COLORS = _class_colors()


def add_window_bars(view: PageImage, place: Place) -> PageImage:
    """Return the image with bars around it, which fill the window."""
    height, width = view.rgb.shape[:2]
    right = place.size[0] - place.left - width
    bottom = place.size[1] - place.top - height
    sides = (place.top, bottom, place.left, right)
    if not any(sides):
        return view
    rgb = cv2.copyMakeBorder(view.rgb, *sides, cv2.BORDER_CONSTANT, value=(BAR, BAR, BAR))
    depth = view.depth_m
    if depth is not None:
        depth = cv2.copyMakeBorder(depth, *sides, cv2.BORDER_CONSTANT, value=BAR_M)
    return PageImage(rgb, depth)


def split_pictures(before: np.ndarray, after: np.ndarray, share: float) -> np.ndarray:
    """Return a picture with `before` to the left of a white line and `after` to its right.

    Args:
        before: [H, W, 3], uint8.
        after: [H, W, 3], uint8.
        share: The column of the line, as a share of the width.
    """
    column = round(share * after.shape[1])
    picture = after.copy()
    picture[:, :column] = before[:, :column]
    picture[:, max(column - 1, 0) : column + 1] = 255
    return picture


def page_depth(depth_m: np.ndarray) -> np.ndarray:
    """Return the depth that the page gets: no more than FAR_M, and FAR_M where no surface is."""
    return np.where(depth_m > 0, np.minimum(depth_m, FAR_M), FAR_M)


# ---- Overlays ------------------------------------------------------------------------------------

# The colour of a LiDAR return by its weather_code: unchanged, attenuated, scattered, lost, moved,
# precipitation.
_CODE_COLORS = np.array(
    [[0, 220, 255], [255, 220, 60], [255, 70, 70], [0, 0, 0], [255, 120, 255], [255, 255, 255]]
)


def box_lines(scene: Scene, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges of a frame's labelled boxes and their colours.

    Returns:
        Ends of the edges, [N, 2, 3], in the scene's world; colours of the ends, [N, 2, 3].
    """
    boxes = scene.boxes(frame.index)
    world_boxes = WorldBoxes.from_labels(boxes, np.asarray(scene.world_origin_m))
    lines = world_boxes.corners_m[world_boxes.is_usable][:, EDGES].reshape(-1, 2, 3)
    labels = np.array([sum(map(ord, label)) for label in boxes.labels], np.uint32)
    colors = color_numbers(labels[world_boxes.is_usable])
    return lines, np.broadcast_to(np.repeat(colors, len(EDGES), 0)[:, None], lines.shape)


def lidar_points(
    scene: Scene, frame: Frame, recipe: Recipe
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return a frame's LiDAR returns after the recipe's weather, and their colours.

    Returns:
        Points, [N, 3], in the scene's world; colours by weather_code, uint8 [N, 3]. None if the
        frame has no sweep.
    """
    sweep = scene.lidar(frame.index)
    if sweep is None:
        return None
    sweep = drop_lost_returns(weathered_sweep(scene, recipe, frame.index, sweep))
    points = sweep.points_m - np.asarray(scene.world_origin_m)
    return points, _CODE_COLORS[sweep.columns[CODE_COLUMN]].astype(np.uint8)
