"""Thresholds of the image's definition, in one place; kernels receive them as arguments.

Values are gsplat 1.5.3's, since users' scenes were trained with it or its parents.
"""

from __future__ import annotations

from dataclasses import dataclass

ALPHA_MIN = 1.0 / 255.0  # a splat's contribution below this is skipped
TRANSMITTANCE_STOP = 1e-4  # blending stops before the splat that would reach this
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
    """

    near_m: float = 0.01
    alpha_max: float = 0.999
    antialiased: bool = False
    sh_degree: int | None = None
    mode_depth_floor_m: float = 0.2
