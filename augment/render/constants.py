"""Thresholds of the image's definition, in one place. Kernels receive them as arguments.

The values are those of gsplat 1.5.3, since users' scenes were trained with it or with its parents.
"""

from __future__ import annotations

from dataclasses import dataclass

# Alpha below which a splat's contribution to a pixel is skipped.
ALPHA_MIN = 1.0 / 255.0
# Transmittance at which blending stops, before the splat that would reach it.
TRANSMITTANCE_STOP = 1e-4
# Largest transmittance stop: median depth is where transmittance falls below one half, so blending
# must not stop sooner.
MAX_TRANSMITTANCE_STOP = 0.25
# px^2 that are added to the diagonal of the projected covariance.
COV2D_BLUR = 0.3
# Largest blur, px^2, that margins of images allow for: views of a lens may be finer than its image.
MAX_COV2D_BLUR = 1.2
# Sigmas beyond which a splat is not drawn.
MAX_EXTENT_SIGMAS = 3.33
# Share of the image by which the range of the Jacobian's x/z and y/z exceeds the image.
TAN_FOV_MARGIN = 0.3
# Alpha below which a pixel shows more sky than surface, and has no depth.
SURFACE_ALPHA = 0.5
# Smallest weight that expected depth is divided by.
DEPTH_EPS = 1e-10


@dataclass(frozen=True)
class RasterSettings:
    """Settings of a rasteriser, besides scene and camera.

    near_m: splats with a smaller z are culled, metres.

    alpha_max: upper limit of alpha; 0.999 in gsplat 1.5.3, 0.99 in the original 3DGS and in
    gsplat's main branch.

    antialiased: if True, opacities are multiplied by sqrt(det / det_blurred).

    sh_degree: highest band that is evaluated; None for all bands of a splat.

    mode_depth_floor_m: spread below which depths always form one cluster, as the beta of a Gumbel
    distribution. Depths up to 0.88 times as far behind a surface, and up to 1.56 times as far
    before it, belong to it.

    transmittance_stop: a pixel is finished once at most this share of the light behind it shines
    through. A splat that would leave at most min(transmittance_stop, 1e-4) is not blended, which is
    gsplat's rule for stops up to 1e-4. A greater stop blends the splat that reaches it: gsplat's
    rule would leave out whole surfaces, since a wall of alpha 0.999 leaves 1e-3. The weights behind
    the stop are lost; their sum is at most the stop. `rasterize` lets the blended splats stand for
    them (augment.render.rasterize).

    radius_clip_px: splats up to this size are left out, for any camera; 0 leaves out none. The size
    of a splat is the larger half-extent of the box in which its alpha can reach 1/255, sqrt(2
    ln(255 opacity) max(xx, yy)), with the opacity after antialiasing and the blurred 2D covariance.
    It is not rounded, while gsplat's `radius_clip` rounds the extent up first.

    fog_cut: if only colour and alpha are asked for, a backend may leave out splats whose light
    comes through the fog by at most this share. It may also finish a pixel once at most this share
    of the light behind it would come through. Alpha then counts the drawn splats only, so the
    caller puts the fog behind them: its airlight, or the sky through it. 0 leaves out nothing.

    blur_px2: added to the diagonal of the projected covariance, px^2. A smaller blur is for an
    image that is shown enlarged, where splats would grow.

    lod_px: far splats of large backgrounds are drawn merged, in cells of at most this many pixels
    (augment.detail.lod); 0 draws all splats as they are.
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
