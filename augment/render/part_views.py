"""The numbers of a view that kernels read, part by part, formed in float64 and rounded once.

`cpu.driver`, `cuda.splats` and the trainer call these functions; `layout` names the numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from augment.render import layout
from augment.render.constants import ALPHA_MIN, MAX_EXTENT_SIGMAS, TAN_FOV_MARGIN, RasterSettings
from augment.render.fog import Fog
from augment.render.fog_table import thinnest_fog
from augment.render.layout import MAX_DEPTH_GROWTH, HeightClip
from augment.render.sh import MAX_DEGREE
from augment.scene.cameras import Camera
from augment.scene.scene import PosedGaussians

# Height at which everything is on the kept side, metres.
_NO_CLIP = 1e30
# Distance that no splat exceeds, metres; its square is still finite.
_NO_FAR = 1e18
# Radius that every splat exceeds, pixels, even one of alpha 1/255 in its centre only.
_NO_RADIUS_CLIP = -1.0


def views_of(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    settings: RasterSettings,
    fog: Fog | None,
    clip: HeightClip | None,
) -> np.ndarray:
    """Return views float32 [P, VIEW] of posed parts, with their light and colour maps."""
    poses = stack_poses([part.world_from_part for part in parts])
    views = view_numbers(poses, camera, settings, fog, clip)
    views[:, layout.V_OVERLAY] = [part.is_overlay for part in parts]
    views[:, layout.V_MAPS] = [_map_count(part) for part in parts]
    for view, part, pose in zip(views, parts, poses, strict=True):
        if part.shading is not None:
            sun = camera.camera_from_world.numpy()[:3, :3] @ pose[:3, :3] @ part.shading.sun
            view[layout.V_SUN :][:3] = sun
            view[layout.V_WRAP] = part.shading.wrap
            view[layout.V_LIT] = 1
    return views


def _map_count(part: PosedGaussians) -> int:
    """Return the number of a part's colour maps; 1 if its splats have no rows to choose by."""
    if part.color_maps is None:
        return 0
    return 1 if part.color_map_rows is None else len(part.color_maps)


def view_numbers(
    poses: np.ndarray,
    camera: Camera,
    settings: RasterSettings,
    fog: Fog | None,
    clip: HeightClip | None = None,
) -> np.ndarray:
    """Return the views of parts that are no overlays, float32 [P, VIEW], formed in float64.

    Args:
        poses: world_from_part, float64 [P, 4, 4].
        camera: the camera.
        settings: thresholds of the image.
        fog: fog before the splats; None for clear air.
        clip: height at which splats are cut; None for no cut.
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
    low_tangents = -(centre / focal + margin)
    high_tangents = (size - centre) / focal + margin
    if camera.is_orthographic:
        # the Jacobian has no terms of x/z and y/z
        low_tangents = np.zeros(2)
        high_tangents = np.zeros(2)
    widest_tangents = np.maximum(np.abs(low_tangents), np.abs(high_tangents))
    views = np.zeros((len(poses), layout.VIEW))
    views[:, layout.V_ROTATION :][:, :9] = rotations.reshape(-1, 9)
    views[:, layout.V_EYE :][:, :6] = np.concatenate([coarse_eyes, eyes - coarse_eyes], 1)
    views[:, layout.V_FOCAL :][:, :2] = focal
    views[:, layout.V_CENTRE :][:, :2] = centre
    views[:, layout.V_SIZE :][:, :2] = size
    views[:, layout.V_LOW :][:, :2] = low_tangents
    views[:, layout.V_HIGH :][:, :2] = high_tangents
    views[:, layout.V_GAIN :][:, :2] = MAX_EXTENT_SIGMAS * focal * np.sqrt(1 + widest_tangents**2)
    views[:, layout.V_NEAR] = settings.near_m
    views[:, layout.V_BLUR] = settings.blur_px2
    views[:, layout.V_ALPHA_MIN] = ALPHA_MIN
    views[:, layout.V_LOG_CUT] = math.log2(ALPHA_MIN)
    if fog is not None:
        views[:, layout.V_EXTINCTION] = fog.extinction_per_m
        views[:, layout.V_AIRLIGHT :][:, :3] = fog.airlight_rgb
        if fog.scale_height_m is not None:
            eye_above_base_m = float(camera.centre[2]) - fog.base_z_m
            views[:, layout.V_EYE_HEIGHT] = eye_above_base_m / fog.scale_height_m
            views[:, layout.V_UP :][:, :3] = poses[:, 2, :3] / fog.scale_height_m
    views[:, layout.V_FOG_FAR] = _NO_FAR
    if fog is not None and fog.scale_height_m is None and settings.fog_cut > 0:
        least_per_m = thinnest_fog(fog, camera).extinction_per_m
        fog_far_m = -math.log(settings.fog_cut) / max(least_per_m, 1 / _NO_FAR)
        views[:, layout.V_FOG_FAR] = min(fog_far_m, _NO_FAR)
    views[:, layout.V_PARALLEL] = camera.is_orthographic
    views[:, layout.V_RADIUS_CLIP] = settings.radius_clip_px or _NO_RADIUS_CLIP
    views[:, layout.V_EXTENT] = MAX_EXTENT_SIGMAS
    views[:, layout.V_CLIP_EYE] = views[:, layout.V_CLIP_REACH] = _NO_CLIP
    if clip is not None:
        clip_up = np.array(clip.up)
        eye_height_m = clip.height_above(camera.centre.tolist())
        views[:, layout.V_CLIP_EYE] = clip.sign * eye_height_m
        views[:, layout.V_CLIP_PART :][:, :3] = clip.sign * (clip_up @ poses[:, :3, :3])
        clip_up_in_camera = camera.camera_from_world.numpy()[:3, :3] @ clip_up
        views[:, layout.V_CLIP_CAMERA :][:, :3] = clip.sign * clip_up_in_camera
        views[:, layout.V_CLIP_FALL] = clip.sign * eye_height_m
        views[:, layout.V_CLIP_LONGEST] = MAX_DEPTH_GROWTH
        if camera.is_orthographic:
            views[:, layout.V_CLIP_FALL] = -clip.sign * clip_up_in_camera[2]
            views[:, layout.V_CLIP_LONGEST] = _NO_CLIP
        views[:, layout.V_CLIP_EDGE] = clip.edge_px
        views[:, layout.V_CLIP_REACH] = min(clip.max_distance_m, _NO_CLIP)
    return views.astype(np.float32)


def stack_poses(poses: Sequence[torch.Tensor | None]) -> np.ndarray:
    """Return the poses of parts, float64 [P, 4, 4]; None stands for the identity."""
    return np.stack([np.eye(4) if pose is None else pose.numpy() for pose in poses])


def raster_modes(
    settings: RasterSettings, fog: Fog | None, clip: HeightClip | None = None, *, with_color: bool
) -> np.ndarray:
    """Return the modes of the projection, int64 [MODES]."""
    degree = MAX_DEGREE if settings.sh_degree is None else settings.sh_degree
    modes = np.zeros(layout.MODES, np.int64)
    modes[layout.M_COLOR] = with_color
    modes[layout.M_NUM_SH_FUNCTIONS] = (degree + 1) ** 2
    modes[layout.M_ANTIALIASED] = settings.antialiased
    modes[layout.M_CLIP] = clip is not None
    if fog is not None:
        is_uniform = fog.scale_height_m is None
        modes[layout.M_FOG] = layout.UNIFORM_FOG if is_uniform else layout.LAYERED_FOG
    return modes
