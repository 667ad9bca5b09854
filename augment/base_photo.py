"""The recorded image as the picture, to which the scene supplies the weather.

P is the photo in the scene's colours, mapped where a style asks for it; alpha, depth and the share
o and colours S of what lies on the scene (snow) are rendered. Then

    clear = (1 - o) P + S
    picture = T clear + (1 - T) airlight         T = alpha T(depth) + (1 - alpha) T(sky)

A layer of a flooded scene shows (alpha - o) P + S in place of its splats' colours, so what stands
in the water, what is seen through it and what the screen reflects are the photo's. Only views that
the photo is not, as the mirrored one, show splats.

T and the sky's share are those of splats, whose edges lie pixels beside the photo's: a guided
filter (He, Sun and Tang 2013, "Guided Image Filtering") moves them there. Things close to the
camera lie further off: beside edges that the photo does not show, T is told by what is around, as
far as the photo shows no edge between (Min et al. 2014, "Fast Global Image Smoothing Based on
Weighted Least Squares").
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int16, UInt8
from torch import Tensor

from augment.cameras import Camera, Frame
from augment.cast_shadows import FadedShadows
from augment.errors import SceneError
from augment.files.recorded_images import ImageFault, has_image, read_scaled
from augment.memo import memo_of
from augment.render import photo_kernels as kernels
from augment.render.buffers import (
    AUTO,
    CPU,
    CUDA,
    OVERLAY,
    RGB,
    SPLAT_IDS,
    RenderOutput,
    kernels_for,
)
from augment.render.composite import add_elevation, map_colors, pixels_at_unit_depth
from augment.render.cuda import runtime as gpu
from augment.render.fog import Fog, optical_depth, sky_optical_depth
from augment.render.threads import kernel_threads
from augment.scene import PosedGaussians, Scene
from recipes.schema import Recipe

RECORDED = "recorded"
# What a photo shows is opaque, while reconstructed surfaces let some light through: the alphas that
# are taken for nothing and for all.
CLEAR_ALPHA, OPAQUE_ALPHA = 0.04, 0.96
# Of the guided filter: its radius over the image's width, and the variance of display-encoded
# colour that counts as an edge.
RADIUS, EDGE = 1 / 320, 0.05**2
WIDER = 4  # times as wide for the sky's share: splats of sky and of pale walls are told apart badly
# Splats lie OFF_M beside what the photo shows, which is many pixels where that is close: edges of T
# between surfaces, by at least EDGE_OF_T, that may be off by FEWEST_PX or more, at most a WIDEST of
# the image's width, in a copy ALIGNED_PX wide. An edge of the photo has a contrast of PLAIN of 255
# or more; where most of T's edges nearby (a NEARBY of the width) are on such, they are where they
# belong. The further from the others, the more T counts, and everywhere a little, for what is
# nothing but edge. REACH, ALIKE: of the smoothing, squared pixels and colours of 255.
OFF_M, EDGE_OF_T, FEWEST_PX, WIDEST, ALIGNED_PX = 0.12, 0.1, 2, 1 / 30, 480
PLAIN, NEARBY = 26, 1 / 20
LITTLE, REACH, ALIKE = 0.02, 1000.0, 5.0
# Where nothing is rendered, rays that fall by more than this (metres a metre) see the road, no sky.
LEVEL = 0.02
MAX_CONDITION = 1e3  # of a colour map that is undone: 8 bits come back exactly
HIGHEST_M = 4.0  # a camera above the road; more is a hill's
ROWS = 32  # image rows a thread takes at a time
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
    missing = [v for v in views if not has_image(Path(v[0].image_paths.get(v[1], "")))]
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
    """A style's colour maps. splats [C, 3, 4]: one, or one a class. sky [3, 4]. levels [M]: the sky
    in each of the background's M - 2 splats, 0 to 1, between zeros that stand for no splat and for
    actors'; None where there is none in any.

    others [K, 3, 4]: of the splats' maps, those that differ from the first. marks [R, 3, 4]: what a
    map makes of any colour: the sky in a splat, and in how far it takes each of the others; by rows
    of the background's splats, or by classes where `rows` is None. None where there is nothing to
    mark, or others are more than two.
    """

    splats: Float[Tensor, "C 3 4"]
    sky: Float[Tensor, "3 4"]
    levels: Float[Tensor, " M"] | None = None
    others: Float[Tensor, "K 3 4"] | None = None
    marks: Float[Tensor, "R 3 4"] | None = None
    rows: Int16[Tensor, " N"] | None = None

    def marked(self, parts: Sequence[PosedGaussians]) -> tuple[PosedGaussians, ...]:
        """The parts in the colours of their marks."""
        assert self.marks is not None
        own = self.marks[: len(self.splats)].contiguous()
        return tuple(
            replace(part, color_maps=own, color_rows=None)
            if part.instance_id > 0 or self.rows is None
            else replace(part, color_maps=self.marks, color_rows=self.rows)
            for part in parts
        )


@dataclass(frozen=True, eq=False)
class Photo:
    """A recorded image. camera: that took it, at its size. pixels: as recorded. backend: that
    draws. undone: the map from recorded colours to the scene's, which the camera's colour map turns
    back in the finished picture; None where these are the same. height_m: of the camera above the
    road; None where unknown. faded: the ground's shadows, in smog.
    """

    camera: Camera
    pixels: UInt8[np.ndarray, "H W 3"]
    backend: str
    undone: Float[Tensor, "3 4"] | None = None
    height_m: float | None = None
    style: PhotoStyle | None = None
    faded: FadedShadows | None = None

    def is_seen_by(self, camera: Camera) -> bool:
        """Whether the camera is a window of the photo's."""
        return _is_window(self.camera, camera)

    def buffers_for(self, parts: Sequence[PosedGaussians]) -> frozenset[str]:
        """That painting layers of these parts takes."""
        own = {RGB, OVERLAY} if any(part.is_overlay for part in parts) else set[str]()
        if self.style is not None and (len(self.style.splats) > 1 or self.style.levels is not None):
            own.add(SPLAT_IDS)
        return frozenset(own)

    def prepare(
        self, parts: Sequence[PosedGaussians]
    ) -> tuple[tuple[PosedGaussians, ...], frozenset[str]]:
        """The parts and the buffers that `clear_picture` takes."""
        if self._takes_marks(parts):
            assert self.style is not None
            return self.style.marked(parts), frozenset({RGB})
        return blackened(parts), self.buffers_for(parts)

    def _takes_marks(self, parts: Sequence[PosedGaussians]) -> bool:
        """Whether splats say in place of their colours what a style does to them, which takes half
        as long as knowing the heaviest one of each pixel.
        """
        marks = None if self.style is None else self.style.marks
        return marks is not None and not any(part.is_overlay for part in parts)

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
        surface = land if level is None else mix(land, sky, level)
        surface = self._without_sun(surface, raster, camera)
        if shown is not None:
            weight = shown if camera is self.camera else shown * self._inside(camera)
            own = (1 - weight)[..., None] * raster.rgb
            return replace(raster, rgb=add_faded(own, surface, weight * raster.alpha))
        alpha = share = opaque_alpha(raster.alpha)
        if raster.overlay is not None:
            alpha = torch.maximum(alpha, raster.overlay)
            share = alpha - raster.overlay
        return replace(raster, rgb=add_faded(raster.rgb, surface, share), alpha=alpha)

    def clear_picture(
        self, raster: RenderOutput, parts: Sequence[PosedGaussians]
    ) -> Float[Tensor, "H W 3"]:
        """The photo with what lies on the scene, before any smog. raster: of the parts that
        `prepare` gives.
        """
        rgb = self._land if self.style is None else self._styled(self.style, raster, parts)
        rgb = self._without_sun(rgb, raster, self.camera)
        if raster.overlay is None:
            return rgb
        assert raster.rgb is not None
        return add_faded(raster.rgb, rgb, 1 - raster.overlay)

    def _styled(
        self, style: PhotoStyle, raster: RenderOutput, parts: Sequence[PosedGaussians]
    ) -> Float[Tensor, "H W 3"]:
        assert raster.alpha is not None
        if not self._takes_marks(parts):
            land, sky, level = self.colors(raster, parts, self.camera)
            return mix(land, sky, self.sharpen(self._sky_share(raster.alpha, level), WIDER))
        alpha, marks = raster.alpha, raster.rgb
        assert marks is not None
        if kernels_for(self.backend, alpha, marks) == CPU:
            share = self.sharpen(self._marked_share_on_cpu(alpha, marks), WIDER)
        else:
            level = (marks[..., 0] / alpha.clamp_min(1e-6)).clamp_max(1)
            share = self.sharpen(self._sky_share(alpha, level), WIDER)
        if style.others is None and self.backend == CPU:
            return self._in_both_on_cpu(style, share)
        land = self._land
        for number, other in enumerate(() if style.others is None else style.others):
            weight = (marks[..., 1 + number] / alpha.clamp_min(1e-6)).clamp_max(1)
            land = mix(land, self._in_colors(other), weight)
        return mix(land, self._sky, share)

    def _sky_share(
        self, alpha: Float[Tensor, "H W"], level: Float[Tensor, "H W"] | None
    ) -> Float[Tensor, "H W"]:
        """How much of each pixel is sky: beside the surfaces, and painted on them."""
        alpha = opaque_alpha(alpha)
        share = 1 - alpha if level is None else 1 - alpha * (1 - level)
        if self.height_m is not None:
            share = share.masked_fill(self.fall > LEVEL, 0.0)
        return share

    def _marked_share_on_cpu(self, alpha: Tensor, marks: Tensor) -> Tensor:
        out = np.empty(tuple(alpha.shape), np.float32)
        fall = (-self.camera.world_from_camera[2, :3]).tolist()
        numbers = (CLEAR_ALPHA, OPAQUE_ALPHA), *pixels_at_unit_depth(self.camera)
        numbers = *numbers, (*fall, math.inf if self.height_m is None else LEVEL)
        with kernel_threads(ROWS):
            kernels.sky_share(
                alpha.detach().numpy(), marks.detach().numpy(),
                *(np.asarray(n, np.float32) for n in numbers), out,
            )  # fmt: skip
        return torch.from_numpy(out)

    def _in_both_on_cpu(self, style: PhotoStyle, share: Tensor) -> Tensor:
        maps = (_composed(own, self.undone).numpy() for own in (style.splats[0], style.sky))
        out = np.empty(self.pixels.shape, np.float32)
        with kernel_threads(ROWS):
            kernels.styled_colors(self.pixels, *maps, share.numpy(), out)
        return torch.from_numpy(out)

    def colors(
        self, raster: RenderOutput, parts: Sequence[PosedGaussians], camera: Camera
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """What surfaces show [H, W, 3], what the sky shows, and how much of a surface is sky
        [H, W], None for nothing of any; at the pixels of a window. In the scene's colours, not
        clamped.
        """
        land, style, level = self._cut(self._land, camera), self.style, None
        if style is None:
            return land, self.sky_colors(camera), None
        if len(style.splats) > 1:
            assert raster.splat_ids is not None
            there = raster.splat_ids >= 0
            table = _classes(parts, land.device)
            classes = torch.where(there, table[raster.splat_ids.clamp_min(0)], 0)
            for value in torch.unique(classes).tolist():
                if value and not torch.equal(style.splats[value], style.splats[0]):
                    own = self._cut(self._in_colors(style.splats[value]), camera)
                    land = torch.where((classes == value)[..., None], own, land)
        if style.levels is not None:
            assert raster.splat_ids is not None
            levels = style.levels.to(land.device)
            level = levels[(raster.splat_ids + 1).clamp_max(len(levels) - 1)]
        return land, self.sky_colors(camera), level

    def _without_sun(
        self, rgb: Float[Tensor, "H W 3"], raster: RenderOutput, camera: Camera
    ) -> Float[Tensor, "H W 3"]:
        """What surfaces show, with the shadows on the ground faded."""
        depth, alpha = raster.expected_depth, raster.alpha
        if self.faded is None or depth is None or alpha is None:
            return rgb
        small = camera.resized(*_at_most(camera, ALIGNED_PX))
        z, shown = (
            cv2.resize(
                v.detach().cpu().float().contiguous().numpy(),
                (small.width, small.height),
                interpolation=cv2.INTER_NEAREST,
            )
            for v in (depth, alpha)
        )
        points = z[..., None] * small.ray_directions().numpy() + camera.centre.numpy()
        points[shown < 0.5] = math.inf
        lit, factors = self.faded.gains(points.astype(np.float32))
        lit = cv2.resize(lit, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR)
        if camera is self.camera:
            lit = self.sharpen(torch.from_numpy(lit), WIDER).numpy()
        steps = cv2.merge([np.rint(lit * 255).astype(np.uint8)] * 3)
        return rgb * torch.from_numpy(cv2.LUT(steps, factors[None])).to(rgb.device)

    def sky_colors(self, camera: Camera) -> Float[Tensor, "H W 3"]:
        """What the sky shows at the pixels of a window."""
        return self._cut(self._land if self.style is None else self._sky, camera)

    @cached_property
    def _land(self) -> Float[Tensor, "H W 3"]:
        return self._in_colors(None if self.style is None else self.style.splats[0])

    @cached_property
    def _sky(self) -> Float[Tensor, "H W 3"]:
        assert self.style is not None
        return self._in_colors(self.style.sky)

    def _in_colors(self, style_map: Float[Tensor, "3 4"] | None) -> Float[Tensor, "H W 3"]:
        """The photo in the scene's colours, or under a style's map of them, which ends at 0."""
        color_map, least = self.undone, -math.inf
        if style_map is not None:
            color_map, least = _composed(style_map, self.undone), 0.0
        if self.backend == CPU:
            out = np.empty(self.pixels.shape, np.float32)
            given = np.eye(3, 4, dtype=np.float32) if color_map is None else color_map.numpy()
            with kernel_threads(ROWS):
                kernels.scene_colors(self.pixels, given, np.float32(least), out)
            return torch.from_numpy(out)
        pixels = torch.from_numpy(self.pixels)
        rgb = (gpu.upload(pixels) if self.backend == CUDA else pixels).float() / 255
        if color_map is None:
            return rgb
        return map_colors(rgb, color_map, backend=self.backend).clamp_min(least)

    def sharpen(self, values: Float[Tensor, "H W"], times: int = 1) -> Float[Tensor, "H W"]:
        """Values of 0 to 1 whose edges move to the photo's. times: RADIUS."""
        radius = max(2, round(RADIUS * times * self.camera.width))
        source = np.ascontiguousarray(values.detach().cpu().float().numpy())
        there = np.flatnonzero(source.max(1) > 0)
        if not len(there):
            return values
        # No window of the other rows holds a value.
        rows = slice(max(0, there[0] - 2 * radius), there[-1] + 1 + 2 * radius)
        guide = cv2.cvtColor(
            self.pixels[rows], cv2.COLOR_RGB2GRAY
        )  # in colour it takes twice as long
        found = np.zeros_like(source)
        found[rows] = cv2.ximgproc.guidedFilter(guide, source[rows], radius, EDGE * 255**2)
        return torch.from_numpy(np.clip(found, 0, 1, out=found)).to(values.device)

    def transmittance(self, raster: RenderOutput, fog: Fog) -> Float[Tensor, "H W"]:
        """T of what the photo shows, up to the rendered depth; where nothing is rendered up to the
        road or the sky. Its edges are the photo's.
        """
        assert raster.alpha is not None and raster.expected_depth is not None
        alpha, depth = opaque_alpha(raster.alpha), raster.expected_depth
        if kernels_for(self.backend, alpha, depth) == CPU:
            found = self._transmittance_on_cpu(alpha, depth, fog)
            return self.sharpen(self.aligned(found, alpha, depth))
        camera, device, fall = self.camera, alpha.device, self.fall
        lengths, eye_z_m = camera.ray_lengths(device=device), float(camera.centre[2])
        seen = torch.exp(-optical_depth(fog, depth * lengths, eye_z_m, eye_z_m - depth * fall))
        tau = sky_optical_depth(fog, -fall / lengths, eye_z_m)
        if self.height_m is not None:
            distance = self.height_m / fall.clamp_min(LEVEL) * lengths
            road_z_m = torch.full_like(fall, eye_z_m - self.height_m)
            to_road = optical_depth(fog, distance, eye_z_m, road_z_m)
            tau = torch.where(fall > LEVEL, to_road, tau)
        found = alpha * seen + (1 - alpha) * torch.exp(-tau)
        return self.sharpen(self.aligned(found, alpha, depth))

    def aligned(
        self, values: Float[Tensor, "H W"], alpha: Float[Tensor, "H W"], depth: Float[Tensor, "H W"]
    ) -> Float[Tensor, "H W"]:
        """Values of about 0 to 1, beside edges of close things those of what is around there."""
        size = _at_most(self.camera, ALIGNED_PX)
        factor = self.camera.width / size[0]
        full, shown, z = (v.detach().cpu().float().numpy() for v in (values, alpha, depth))
        own = cv2.resize(full, size, interpolation=cv2.INTER_AREA)
        shown, z = (cv2.resize(v, size, interpolation=cv2.INTER_NEAREST) for v in (shown, z))
        z = np.where(shown > 0.5, z, np.float32(math.inf))
        around = np.ones((5, 5), np.uint8)
        whole = cv2.medianBlur(own, 5)  # without what a reconstruction has of dots
        edges = (_contrast(whole) > EDGE_OF_T) & np.isfinite(cv2.dilate(z, around))
        nearest_m = np.maximum(cv2.erode(z, around), 1e-3)
        off_px = np.where(edges, self.camera.fx / factor * OFF_M / nearest_m, 0)
        if off_px.max() < FEWEST_PX:
            return values
        guide = cv2.resize(self.pixels, size, interpolation=cv2.INTER_AREA)
        nearby = (max(3, round(NEARBY * size[0])),) * 2
        asked = (off_px >= FEWEST_PX).astype(np.float32)
        unseen = asked * (_contrast(guide).max(-1) < PLAIN)
        off_px[cv2.blur(unseen, nearby) < 0.5 * cv2.blur(asked, nearby)] = 0
        trust, radius = np.ones(own.shape, np.float32), FEWEST_PX
        while radius <= WIDEST * size[0]:
            beside = off_px >= radius
            if beside.any():
                away = cv2.distanceTransform((~beside).astype(np.uint8), cv2.DIST_L2, 3)
                np.minimum(trust, (2 * away / radius - 1).clip(0, 1), out=trust)
            radius *= 2
        if trust.min() == 1:
            return values
        smooth = cv2.ximgproc.createFastGlobalSmootherFilter(guide, REACH, ALIKE)
        weight = np.maximum(trust, np.float32(LITTLE))
        told = smooth.filter(weight * own) / np.maximum(smooth.filter(weight), 1e-6)
        shape = (self.camera.width, self.camera.height)
        change = cv2.resize((1 - trust) * (told - own), shape, interpolation=cv2.INTER_LINEAR)
        return torch.from_numpy(cv2.add(full, change)).to(values)

    def airlight(self, fog: Fog) -> Float[Tensor, "#H #W 3"]:
        """The fog's colour at each pixel; of one pixel where it is one."""
        if fog.overcast == 0:
            return torch.tensor(fog.rgb, device=self._device)[None, None]
        size = (self.camera.height, self.camera.width)
        nothing = torch.zeros(size, device=self._device)
        raster = RenderOutput(
            rgb=torch.zeros(*size, 3, device=self._device), alpha=nothing, expected_depth=nothing
        )
        return add_elevation(raster, self.camera, fog, behind=True, backend=self.backend)

    def _transmittance_on_cpu(self, alpha: Tensor, depth: Tensor, fog: Fog) -> Tensor:
        camera, out = self.camera, np.empty(tuple(alpha.shape), np.float32)
        inverse_m = 0.0 if fog.scale_height_m is None else 1 / fog.scale_height_m
        lens = (1 / camera.fx, 1 / camera.fy, camera.cx, camera.cy)
        over_base_m = float(camera.centre[2]) - fog.base_z_m
        numbers = (
            *(lens, (-camera.world_from_camera[2, :3]).tolist()),
            (fog.sigma_per_m, inverse_m, over_base_m),
            (self.height_m or 0.0, LEVEL),
        )
        arrays = [np.array(own, np.float32) for own in numbers]
        with kernel_threads(ROWS):
            kernels.transmittance(alpha.numpy(), depth.detach().numpy(), *arrays, out)
        return torch.from_numpy(out)

    @cached_property
    def fall(self) -> Float[Tensor, "H W"]:
        """By how much each pixel's ray falls per metre of depth."""
        camera, device = self.camera, self._device
        x, y, z = (-camera.world_from_camera[2, :3]).tolist()
        u = (torch.arange(camera.width, device=device) + 0.5 - camera.cx) / camera.fx
        v = (torch.arange(camera.height, device=device) + 0.5 - camera.cy) / camera.fy
        return (x * u + z) + (y * v)[:, None]

    def _cut(self, rgb: Float[Tensor, "H W 3"], camera: Camera) -> Float[Tensor, "h w 3"]:
        """The photo's image at a window's pixels; its border's colours beyond it."""
        if camera is self.camera:
            return rgb
        rows, columns = self._places(camera)
        rows = rows.clamp(0, self.camera.height - 1)
        return rgb[rows][:, columns.clamp(0, self.camera.width - 1)]

    def _inside(self, camera: Camera) -> Tensor:
        rows, columns = self._places(camera)
        down = (rows >= 0) & (rows < self.camera.height)
        across = (columns >= 0) & (columns < self.camera.width)
        return down[:, None] & across

    @property
    def _device(self) -> torch.device:
        return gpu.gpu_device() if self.backend == CUDA else torch.device("cpu")

    def _places(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """The photo's rows and columns of a window's."""
        device = self._device
        top, left = round(self.camera.cy - camera.cy), round(self.camera.cx - camera.cx)
        rows = torch.arange(top, top + camera.height, device=device)
        return rows, torch.arange(left, left + camera.width, device=device)


def open_photo(
    scene: Scene, camera: Camera, color_map: Float[Tensor, "3 4"] | None, *, backend: str
) -> Photo:
    """The photo of a camera of the scene, at its size, before any style.

    color_map: that the finished picture takes.

    Raises:
        SceneError: there is none, it cannot be read, or the colour map has no inverse.
    """
    path, full = find_recorded(scene, camera)
    try:
        pixels = read_scaled(path, full, camera)
    except ImageFault as fault:
        raise SceneError(f"camera {camera.name}: recorded image {path} {fault}") from None
    undone = None
    if color_map is not None:
        matrix, offset = color_map[:, :3].double(), color_map[:, 3].double()
        if float(torch.linalg.cond(matrix)) > MAX_CONDITION:
            raise SceneError(
                f"scene {scene.name!r}: the colour map of camera {camera.name!r} has no inverse "
                f"({color_map.tolist()}), so its photo has no colours in the scene; render with "
                f"exposure: neutral"
            )
        inverse = torch.linalg.inv(matrix)
        undone = torch.cat([inverse, -(inverse @ offset)[:, None]], 1).float()
    height_m = None
    if scene.has_known_gravity and scene.ground_z_m is not None:
        above = float(camera.centre[2]) - scene.ground_z_m
        height_m = min(above, HIGHEST_M) if above > 0 else None
    return Photo(camera, pixels, backend, undone, height_m)


def _at_most(camera: Camera, width_px: int) -> tuple[int, int]:
    """Width and height of a copy of the camera's image."""
    factor = max(1.0, camera.width / width_px)
    return max(1, round(camera.width / factor)), max(1, round(camera.height / factor))


def _contrast(image: np.ndarray) -> np.ndarray:
    """Between the highest and the lowest of each pixel and its neighbours."""
    around = np.ones((3, 3), np.uint8)
    return cv2.dilate(image, around) - cv2.erode(image, around)


def blackened(parts: Sequence[PosedGaussians]) -> tuple[PosedGaussians, ...]:
    """The parts in black, but for what lies on the scene: their colours come from the photo."""
    return tuple(
        part if part.is_overlay else replace(part, color_maps=_NO_COLOR, color_rows=None)
        for part in parts
    )


def opaque_alpha(alpha: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """The alpha of what the photo shows there, 0 to 1."""
    return ((alpha - CLEAR_ALPHA) / (OPAQUE_ALPHA - CLEAR_ALPHA)).clamp(0, 1)


def mix(
    rgb: Float[Tensor, "H W 3"], other: Float[Tensor, "#H #W 3"], weight: Float[Tensor, "H W"]
) -> Float[Tensor, "H W 3"]:
    """(1 - weight) rgb + weight other: each to the bit where the other's weight is 0."""
    if kernels_for(AUTO, rgb, other, weight) != CPU:
        return (1 - weight)[..., None] * rgb + weight[..., None] * other
    return _run(kernels.mix, rgb, other, weight)


def add_faded(
    base: Float[Tensor, "H W 3"], rgb: Float[Tensor, "H W 3"], weight: Float[Tensor, "H W"]
) -> Float[Tensor, "H W 3"]:
    """base + weight rgb."""
    if kernels_for(AUTO, base, rgb, weight) != CPU:
        return base + weight[..., None] * rgb
    return _run(kernels.add_faded, base, rgb, weight)


def _run(kernel: Any, *images: Tensor) -> Tensor:
    out = np.empty(tuple(images[0].shape), np.float32)
    with kernel_threads(ROWS):
        kernel(*(image.detach().contiguous().numpy() for image in images), out)
    return torch.from_numpy(out)


def _composed(
    outer: Float[Tensor, "3 4"], inner: Float[Tensor, "3 4"] | None
) -> Float[Tensor, "3 4"]:
    """The map of what `inner` gives, float32."""
    if inner is None:
        return outer.contiguous()
    matrix, first = outer[:, :3].double(), inner.double()
    found = matrix @ first
    found[:, 3] += outer[:, 3]
    return found.float()


def _classes(parts: Sequence[PosedGaussians], device: torch.device) -> Int16[Tensor, "N"]:
    """Of every splat, in the order in which buffers count them; 0 where unknown."""
    own = [
        torch.zeros(len(p.gaussians), dtype=torch.int16)
        if p.gaussians.semantic is None
        else p.gaussians.semantic
        for p in parts
    ]
    return torch.cat([o if o.device == device else gpu.resident(o) for o in own])
