"""The recorded image as the picture, to which the scene supplies the weather.

P is the photo in the scene's colours, mapped where a style asks for it; alpha, depth and the share
o and colours S of what lies on the scene (snow) are rendered. Then

    clear = (1 - o) P + S
    picture = T clear + (1 - T) airlight         T = alpha T(depth) + (1 - alpha) T(sky)

A layer of a flooded scene shows (alpha - o) P + S in place of its splats' colours, so what stands
in the water, what is seen through it and what the screen reflects are the photo's. Only views that
the photo is not, as the mirrored one, show splats.

T and the sky's share are those of splats, whose edges lie pixels beside the photo's: a guided
filter (He, Sun and Tang 2013, "Guided Image Filtering") moves them there.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int16, UInt8
from torch import Tensor

from augment.cameras import Camera, Frame
from augment.errors import SceneError
from augment.files.recorded_images import ImageFault, read_scaled
from augment.memo import memo_of
from augment.render.buffers import CUDA, OVERLAY, SPLAT_IDS, RenderOutput
from augment.render.cuda import runtime as gpu
from augment.scene import PosedGaussians, Scene
from recipes.schema import Recipe

RECORDED = "recorded"
# What a photo shows is opaque, while reconstructed surfaces let some light through: the alphas that
# are taken for nothing and for all.
CLEAR_ALPHA, OPAQUE_ALPHA = 0.04, 0.96
RADIUS = 1 / 160  # of the guided filter, over the image's width
EPSILON = 0.03**2  # variance of display-encoded colour that counts as an edge
_NO_COLOR = torch.zeros(1, 3, 4)  # a colour map that leaves black

# ---- Which image a camera recorded ---------------------------------------------------------------


def check_photos(
    recipes: Iterable[Recipe],
    scene_name: str,
    selection: Iterable[tuple[Frame, Sequence[str]]],
    *,
    is_path: bool = False,
) -> None:
    """Refuse recipes on recorded images where one of the selected images was not recorded.

    selection: frames and the names of their cameras. is_path: they are of a camera path.

    Raises:
        SceneError: says which image is missing, and what to do.
    """
    names = sorted({recipe.name for recipe in recipes if recipe.render.base == RECORDED})
    if not names:
        return
    wanted = f"recipe {', '.join(names)}: render.base is 'recorded'"
    if is_path:
        raise SceneError(
            f"{wanted}, and a camera path shows what no camera of scene {scene_name!r} recorded; "
            f"render it with base: splats"
        )
    views = [(frame, name) for frame, cameras in selection for name in cameras]
    missing = [v for v in views if not Path(v[0].image_paths.get(v[1], "")).is_file()]
    if missing:
        frame, name = missing[0]
        path = frame.image_paths.get(name)
        where = "none is known" if path is None else f"{path} is not there"
        raise SceneError(
            f"{wanted}, but {len(missing)} of {len(views)} selected images of scene "
            f"{scene_name!r} have no recorded one; the first is camera {name!r} of frame "
            f"{frame.index}: {where}. Select other cameras or frames, say where the recording has "
            f"moved (data=URI of a fitted scene), or render with base: splats"
        )


def check_base(recipe: Recipe, scene: Scene) -> None:
    """Refuse a recipe on recorded images that no camera of the scene can serve.

    Raises:
        SceneError: the scale is above 1, or the scene has no recorded images.
    """
    if recipe.render.base != RECORDED:
        return
    wanted = f"recipe {recipe.name}: render.base is 'recorded'"
    if recipe.render.scale > 1:
        raise SceneError(
            f"{wanted}, which holds no more pixels than were recorded; render.scale must be <= 1, "
            f"got {recipe.render.scale:g}"
        )
    if not any(frame.image_paths for frame in scene.frames):
        raise SceneError(
            f"{wanted}, but scene {scene.name!r} ({scene.source}) has no recorded images; open the "
            f"recording or a scene fitted to it, or render with base: splats"
        )


def find_recorded(scene: Scene, camera: Camera) -> tuple[Path, Camera]:
    """The image that a camera recorded, and that camera at the image's own size.

    camera: of the scene, at any scale; found by name, time and pose.

    Raises:
        SceneError: there is none.
    """

    def index() -> dict[tuple[str, int], list[tuple[Path, Camera]]]:
        found = defaultdict(list)
        for frame in scene.frames:
            for name, path in frame.image_paths.items():
                if (own := frame.cameras.get(name)) is not None:
                    found[name, own.timestamp_ns].append((Path(path), own))
        return dict(found)

    images = memo_of(scene).get(("recorded images",), index)
    for path, own in images.get((camera.name, camera.timestamp_ns), ()):
        if _is_window(own.resized(camera.width, camera.height), camera):
            return path, own
    raise SceneError(
        f"scene {scene.name!r} has no recorded image of camera {camera.name!r} at "
        f"{camera.timestamp_ns} ns, this pose and this focal length; with render.base 'recorded' "
        f"only what was recorded can be rendered, all else takes base: splats"
    )


def _is_window(outer: Camera, inner: Camera) -> bool:
    """Whether both look through one lens at one moment, at one size of a pixel."""
    focal = max(abs(outer.fx / inner.fx - 1), abs(outer.fy / inner.fy - 1))
    return focal < 1e-9 and torch.equal(outer.camera_from_world, inner.camera_from_world)


# ---- The photo in place of the scene's colours ---------------------------------------------------


@dataclass(frozen=True, eq=False)
class PhotoStyle:
    """A style's colour maps. splats [C, 3, 4]: one, or one a class. sky [3, 4]. levels [N]: the sky
    in each of the background's splats, 0 to 1; None where there is none in any.
    """

    splats: Float[Tensor, "C 3 4"]
    sky: Float[Tensor, "3 4"]
    levels: Float[Tensor, "N"] | None = None


@dataclass(frozen=True, eq=False)
class Photo:
    """A recorded image. camera: that took it, at its size. rgb: display-encoded float32, in the
    scene's colours, which the camera's colour map makes the recorded ones; not clamped; on the side
    that draws. pixels: as recorded.
    """

    camera: Camera
    rgb: Float[Tensor, "H W 3"]
    pixels: UInt8[np.ndarray, "H W 3"]
    style: PhotoStyle | None = None

    def is_seen_by(self, camera: Camera) -> bool:
        """Whether the camera is a window of the photo's."""
        return _is_window(self.camera, camera)

    def buffers_for(self, parts: Sequence[PosedGaussians]) -> frozenset[str]:
        """That painting layers of these parts takes."""
        own = {OVERLAY} if any(part.is_overlay for part in parts) else set[str]()
        if self.style is not None and (len(self.style.splats) > 1 or self.style.levels is not None):
            own.add(SPLAT_IDS)
        return frozenset(own)

    def paint(
        self,
        raster: RenderOutput,
        parts: Sequence[PosedGaussians],
        camera: Camera,
        shown: Float[Tensor, "H W"] | None = None,
    ) -> RenderOutput:
        """A layer that shows the photo in place of its splats.

        raster: of `blackened` parts, or, with `shown`, of the parts in their own colours, which
        stay where the photo shows the layer in no share of a pixel.
        """
        assert raster.rgb is not None and raster.alpha is not None
        land, sky, level = self.colors(raster, parts, camera)
        surface = land if level is None else torch.lerp(land, sky, level[..., None])
        if shown is not None:
            weight = shown if camera is self.camera else shown * self._inside(camera)
            own = raster.alpha[..., None] * surface
            return replace(raster, rgb=torch.lerp(raster.rgb, own, weight[..., None]))
        alpha = opaque_alpha(raster.alpha)
        if raster.overlay is None:
            return replace(raster, rgb=alpha[..., None] * surface, alpha=alpha)
        alpha = torch.maximum(alpha, raster.overlay)
        rgb = raster.rgb + (alpha - raster.overlay)[..., None] * surface
        return replace(raster, rgb=rgb, alpha=alpha)

    def clear_picture(
        self, raster: RenderOutput, parts: Sequence[PosedGaussians]
    ) -> Float[Tensor, "H W 3"]:
        """The photo with what lies on the scene, before any smog. raster: of `blackened` parts."""
        land, sky, level = self.colors(raster, parts, self.camera)
        rgb = land
        if self.style is not None:
            assert raster.alpha is not None
            alpha = opaque_alpha(raster.alpha)
            share = 1 - alpha if level is None else 1 - alpha * (1 - level)
            rgb = torch.lerp(land, sky, self.sharpen(share)[..., None])
        if raster.overlay is None:
            return rgb
        return (1 - raster.overlay)[..., None] * rgb + raster.rgb

    def colors(
        self, raster: RenderOutput, parts: Sequence[PosedGaussians], camera: Camera
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """What surfaces show [H, W, 3], what the sky shows, and how much of a surface is sky
        [H, W], None for nothing of any; at the pixels of a window.
        """
        rgb, style = self._cut(camera), self.style
        if style is None:
            return rgb, rgb, None
        land, level, index = _mapped(rgb, style.splats[0]), None, None
        if self.buffers_for(()):
            assert raster.splat_ids is not None
            index = raster.splat_ids
        if len(style.splats) > 1:
            assert index is not None
            classes = torch.where(index >= 0, _classes(parts, rgb.device)[index.clamp_min(0)], 0)
            for value in torch.unique(classes).tolist():
                if value and not torch.equal(style.splats[value], style.splats[0]):
                    own = (classes == value)[..., None]
                    land = torch.where(own, _mapped(rgb, style.splats[value]), land)
        if style.levels is not None:
            assert index is not None
            known = (index >= 0) & (index < len(style.levels))  # the background comes first
            levels = style.levels.to(rgb.device)
            level = torch.where(known, levels[index.clamp(0, len(levels) - 1)], 0.0)
        return land, self.sky_colors(camera), level

    def sky_colors(self, camera: Camera) -> Float[Tensor, "H W 3"]:
        """What the sky shows at the pixels of a window."""
        rgb = self._cut(camera)
        return rgb if self.style is None else _mapped(rgb, self.style.sky)

    def sharpen(self, values: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
        """Values of 0 to 1 whose edges move to the photo's."""
        guide = self.pixels.astype(np.float32) / 255
        source = np.ascontiguousarray(values.cpu().numpy())
        radius = max(2, round(RADIUS * self.camera.width))
        step = 0.5 if radius >= 4 else 1.0  # of the fast filter, which needs two pixels
        found = cv2.ximgproc.guidedFilter(guide, source, radius, EPSILON, scale=step)
        return torch.from_numpy(found).clamp_(0, 1).to(values.device)

    def _cut(self, camera: Camera) -> Float[Tensor, "H W 3"]:
        """The photo at a window's pixels; its border's colours beyond it."""
        if camera is self.camera:
            return self.rgb
        rows, columns = self._places(camera)
        rows = rows.clamp(0, self.camera.height - 1)
        return self.rgb[rows][:, columns.clamp(0, self.camera.width - 1)]

    def _inside(self, camera: Camera) -> Tensor:
        rows, columns = self._places(camera)
        down = (rows >= 0) & (rows < self.camera.height)
        across = (columns >= 0) & (columns < self.camera.width)
        return down[:, None] & across

    def _places(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """The photo's rows and columns of a window's."""
        device = self.rgb.device
        top, left = round(self.camera.cy - camera.cy), round(self.camera.cx - camera.cx)
        rows = torch.arange(top, top + camera.height, device=device)
        return rows, torch.arange(left, left + camera.width, device=device)


def open_photo(
    scene: Scene, camera: Camera, color_map: Float[Tensor, "3 4"] | None, *, backend: str
) -> Photo:
    """The photo of a camera of the scene, at its size. color_map: that the finished picture takes.

    Raises:
        SceneError: there is none, it cannot be read, or the colour map has no inverse.
    """
    path, full = find_recorded(scene, camera)
    try:
        pixels = read_scaled(path, full, camera)
    except ImageFault as fault:
        raise SceneError(f"camera {camera.name}: recorded image {path} {fault}") from None
    on_gpu = backend == CUDA
    rgb = (gpu.upload(pixels) if on_gpu else torch.from_numpy(pixels)).float() / 255
    if color_map is not None:
        matrix, offset = color_map[:, :3].double(), color_map[:, 3].double()
        if float(torch.linalg.cond(matrix)) > 1e3:
            raise SceneError(
                f"scene {scene.name!r}: the colour map of camera {camera.name!r} has no inverse "
                f"({color_map.tolist()}), so its photo has no colours in the scene; render with "
                f"exposure: neutral"
            )
        inverse = torch.linalg.inv(matrix)
        undone = torch.cat([inverse, -(inverse @ offset)[:, None]], 1).float().to(rgb.device)
        rgb = rgb @ undone[:, :3].T + undone[:, 3]
    return Photo(camera, rgb, pixels)


def blackened(parts: Sequence[PosedGaussians]) -> tuple[PosedGaussians, ...]:
    """The parts in black, but for what lies on the scene: their colours come from the photo."""
    return tuple(
        part if part.is_overlay else replace(part, color_maps=_NO_COLOR, color_rows=None)
        for part in parts
    )


def opaque_alpha(alpha: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """The alpha of what the photo shows there, 0 to 1."""
    return ((alpha - CLEAR_ALPHA) / (OPAQUE_ALPHA - CLEAR_ALPHA)).clamp(0, 1)


def _mapped(rgb: Tensor, color_map: Tensor) -> Tensor:
    color_map = color_map.to(rgb.device, rgb.dtype)
    return (rgb @ color_map[:, :3].T + color_map[:, 3]).clamp_min(0)


def _classes(parts: Sequence[PosedGaussians], device: torch.device) -> Int16[Tensor, "N"]:
    """Of every splat, in the order in which buffers count them; 0 where unknown."""
    own = [
        torch.zeros(len(p.gaussians), dtype=torch.int16)
        if p.gaussians.semantic is None
        else p.gaussians.semantic
        for p in parts
    ]
    return torch.cat([o if o.device == device else gpu.resident(o) for o in own])
