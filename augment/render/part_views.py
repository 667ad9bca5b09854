"""The numbers of a view that kernels read, part by part: formed in float64, rounded once."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from augment.cameras import Camera
from augment.render import layout
from augment.render.constants import ALPHA_MIN, MAX_EXTENT_SIGMAS, TAN_FOV_MARGIN, RasterSettings
from augment.render.fog import Fog
from augment.render.layout import LONGEST, HeightClip
from augment.render.sh import MAX_DEGREE
from augment.scene import PosedGaussians

_NO_CLIP = 1e30  # a height at which everything is on the kept side
_NO_FAR = 1e18  # metres; its square is still finite
_NO_RADIUS_CLIP = -1.0  # no splat is as small, not even one of alpha 1/255 in its centre only


def views_of(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    settings: RasterSettings,
    fog: Fog | None,
    clip: HeightClip | None,
) -> np.ndarray:
    """float32 [P, VIEW] of parts as they are: posed, lit, with their colour maps."""
    poses = part_poses([part.world_from_part for part in parts])
    views = part_views(poses, camera, settings, fog, clip)
    views[:, layout.V_OVERLAY] = [part.is_overlay for part in parts]
    views[:, layout.V_MAPS] = [_map_count(part) for part in parts]
    for view, part, pose in zip(views, parts, poses, strict=True):
        if part.shading is not None:
            sun = camera.camera_from_world.numpy()[:3, :3] @ pose[:3, :3] @ part.shading.sun
            view[layout.V_SUN :][:3], view[layout.V_WRAP] = sun, part.shading.wrap
            view[layout.V_LIT] = 1
    return views


def _map_count(part: PosedGaussians) -> int:
    """One for all of a part whose splats have nothing to choose by."""
    if part.color_maps is None:
        return 0
    return 1 if part.map_rows is None else len(part.color_maps)


def part_views(
    poses: np.ndarray,
    camera: Camera,
    settings: RasterSettings,
    fog: Fog | None,
    clip: HeightClip | None = None,
) -> np.ndarray:
    """The float32 numbers of every part's view, [P, VIEW], formed in float64; none is an overlay.

    poses: world_from_part, float64 [P, 4, 4].
    """
    camera_from_part = camera.camera_from_world.numpy() @ poses
    rotations = camera_from_part[:, :3, :3]
    # The point the transform takes to the origin, also where a rotation is not quite orthonormal.
    eyes = np.linalg.solve(rotations, -camera_from_part[:, :3, 3:])[..., 0]
    coarse_eyes = eyes.astype(np.float32)
    focal = np.array([camera.fx, camera.fy])
    centre = np.array([camera.cx, camera.cy])
    size = np.array([camera.width, camera.height], np.float64)
    margin = TAN_FOV_MARGIN * 0.5 * size / focal
    low, high = -(centre / focal + margin), (size - centre) / focal + margin
    if camera.is_orthographic:
        low, high = np.zeros(2), np.zeros(2)  # the Jacobian has no terms of x/z and y/z
    widest = np.maximum(np.abs(low), np.abs(high))
    views = np.zeros((len(poses), layout.VIEW))
    views[:, layout.V_ROTATION :][:, :9] = rotations.reshape(-1, 9)
    views[:, layout.V_EYE :][:, :6] = np.concatenate([coarse_eyes, eyes - coarse_eyes], 1)
    views[:, layout.V_FOCAL :][:, :2], views[:, layout.V_CENTRE :][:, :2] = focal, centre
    views[:, layout.V_SIZE :][:, :2] = size
    views[:, layout.V_LOW :][:, :2], views[:, layout.V_HIGH :][:, :2] = low, high
    views[:, layout.V_GAIN :][:, :2] = MAX_EXTENT_SIGMAS * focal * np.sqrt(1 + widest**2)
    views[:, layout.V_NEAR], views[:, layout.V_BLUR] = settings.near_m, settings.blur_px2
    views[:, layout.V_ALPHA_MIN], views[:, layout.V_LOG_CUT] = ALPHA_MIN, math.log2(ALPHA_MIN)
    if fog is not None:
        views[:, layout.V_SIGMA] = fog.sigma_per_m
        views[:, layout.V_AIRLIGHT :][:, :3] = fog.rgb
        if fog.scale_height_m is not None:
            above = float(camera.centre[2]) - fog.base_z_m
            views[:, layout.V_EYE_HEIGHT] = above / fog.scale_height_m
            views[:, layout.V_UP :][:, :3] = poses[:, 2, :3] / fog.scale_height_m
    views[:, layout.V_FOG_FAR] = _NO_FAR
    if fog is not None and fog.scale_height_m is None and settings.fog_cut > 0:
        far = -math.log(settings.fog_cut) / max(fog.sigma_per_m, 1 / _NO_FAR)
        views[:, layout.V_FOG_FAR] = min(far, _NO_FAR)
    views[:, layout.V_PARALLEL] = camera.is_orthographic
    views[:, layout.V_RADIUS_CLIP] = settings.radius_clip_px or _NO_RADIUS_CLIP
    views[:, layout.V_EXTENT] = MAX_EXTENT_SIGMAS
    views[:, layout.V_CLIP_EYE] = views[:, layout.V_CLIP_REACH] = _NO_CLIP
    if clip is not None:
        up, eye_height = np.array(clip.up), clip.height_of(camera.centre.tolist())
        views[:, layout.V_CLIP_EYE] = clip.sign * eye_height
        views[:, layout.V_CLIP_PART :][:, :3] = clip.sign * (up @ poses[:, :3, :3])
        upwards = camera.camera_from_world.numpy()[:3, :3] @ up
        views[:, layout.V_CLIP_CAMERA :][:, :3] = clip.sign * upwards
        views[:, layout.V_CLIP_FALL] = clip.sign * eye_height
        views[:, layout.V_CLIP_LONGEST] = LONGEST
        if camera.is_orthographic:
            views[:, layout.V_CLIP_FALL] = -clip.sign * upwards[2]
            views[:, layout.V_CLIP_LONGEST] = _NO_CLIP
        views[:, layout.V_CLIP_EDGE] = clip.edge_px
        views[:, layout.V_CLIP_REACH] = min(clip.reach_m, _NO_CLIP)
    return views.astype(np.float32)


def part_poses(poses: Sequence[torch.Tensor | None]) -> np.ndarray:
    """float64 [P, 4, 4] of parts' poses, None standing for the identity."""
    return np.stack([np.eye(4) if pose is None else pose.numpy() for pose in poses])


def raster_modes(
    settings: RasterSettings, fog: Fog | None, clip: HeightClip | None = None, *, with_color: bool
) -> np.ndarray:
    """The kernels' modes, int64."""
    degree = MAX_DEGREE if settings.sh_degree is None else settings.sh_degree
    modes = np.zeros(layout.MODES, np.int64)
    modes[layout.M_COLOR] = with_color
    modes[layout.M_FUNCTIONS] = (degree + 1) ** 2
    modes[layout.M_ANTIALIASED] = settings.antialiased
    modes[layout.M_CLIP] = clip is not None
    if fog is not None:
        is_uniform = fog.scale_height_m is None
        modes[layout.M_FOG] = layout.UNIFORM_FOG if is_uniform else layout.LAYERED_FOG
    return modes
