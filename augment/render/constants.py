"""Thresholds of the image's definition, in one place; kernels receive them as arguments.

Values are gsplat 1.5.3's, since users' scenes were trained with it or its parents.
"""

from __future__ import annotations

from dataclasses import dataclass

ALPHA_MIN = 1.0 / 255.0  # a splat's contribution below this is skipped
TRANSMITTANCE_STOP = 1e-4  # blending stops before the splat that would reach this
# Median depth is where transmittance falls below one half, so blending must not stop sooner.
MAX_TRANSMITTANCE_STOP = 0.25
COV2D_BLUR = 0.3  # px^2 added to the diagonal of the projected covariance
MAX_EXTENT_SIGMAS = 3.33
TAN_FOV_MARGIN = 0.3  # the Jacobian's x/z, y/z are clamped to the image plus this part of it
DEPTH_EPS = 1e-10  # floor of the weight that expected depth is divided by


@dataclass(frozen=True)
class RasterSettings:
    """What a rasteriser may be told beyond scene and camera.

    near_m: splats nearer than this along z are culled. alpha_max: 0.999 in gsplat 1.5.3, 0.99 in
    the original 3DGS and gsplat's main branch. antialiased: opacity times sqrt(det/det_blurred).
    sh_degree: highest band evaluated; None for all a splat has. mode_depth_floor_m: spread below
    which depths are one cluster whatever they are, as the Gumbel distribution's beta: those up to
    0.88 times as far behind a surface, and 1.56 times as far before it, belong to it.

    transmittance_stop: a pixel is finished once no more than this share of the light behind it
    shines through. A splat that would leave no more than min(transmittance_stop, 1e-4) is not
    blended, which at 1e-4 and below is gsplat's rule; a greater stop blends the splat that reaches
    it. (gsplat's rule with a greater stop would leave out whole surfaces: a wall of alpha 0.999
    leaves 1e-3.) What is lost are weights behind the stop, together at most the stop; `rasterize`
    lets what has been blended stand for them (augment.render.rasterize).

    radius_clip_px: splats no larger than this are left out, by any camera; 0 leaves out none. A
    splat's size is the larger half-extent of the box in which its alpha can reach 1/255,
    sqrt(2 ln(255 opacity) max(xx, yy)), with the opacity after antialiasing and the blurred 2D
    covariance, not rounded. As gsplat's `radius_clip`, which rounds the extent up first.

    fog_cut: where colour and alpha alone are asked for, a backend may leave out splats of which no
    more light than this share comes through the fog, and finish a pixel once no more than this
    share of the light behind would. Alpha then is that of the splats drawn: whoever sets this puts
    the fog behind them, its airlight or the sky through it. 0 leaves out nothing.

    blur_px2: added to the diagonal of the projected covariance; less in an image that is shown
    enlarged, where splats would grow.

    lod_px: far splats of large backgrounds are drawn merged, in cells of this many pixels at most
    (augment.lod); 0 draws all as they are.
    """

    near_m: float = 0.01
    alpha_max: float = 0.999
    antialiased: bool = False
    sh_degree: int | None = None
    mode_depth_floor_m: float = 0.2
    transmittance_stop: float = TRANSMITTANCE_STOP
    radius_clip_px: float = 0.0
    fog_cut: float = 0.0
    blur_px2: float = COV2D_BLUR
    lod_px: float = 0.0
