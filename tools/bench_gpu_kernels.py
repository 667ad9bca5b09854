"""A Triton kernel that does nothing but blend: how fast a GPU can, all it needs in registers."""

import triton
import triton.language as tl


@triton.jit(do_not_specialize=["steps"])
def blend_only(out, steps, alpha_max, alpha_min, LANES: tl.constexpr):
    """LANES pixels of a row, each blended `steps` times with a splat that moves along the row.

    What a rasteriser's inner loop does for a pixel and a splat once all that is the same for a row
    is known: a Gaussian, an exponential, the two limits of alpha, transmittance, three colours. The
    sums are written so that none of it can be left out. out: float32 [programs, LANES].
    """
    pixel = tl.arange(0, LANES)
    x = pixel.to(tl.float32)
    through = tl.full([LANES], 1.0, tl.float32)
    red = tl.zeros([LANES], tl.float32)
    green = tl.zeros([LANES], tl.float32)
    blue = tl.zeros([LANES], tl.float32)
    mean = 0.0
    for _ in range(steps):
        bend = 0.1 * (x - mean)
        alpha = tl.minimum(tl.exp2(-0.5 - bend * bend), alpha_max)
        weight = tl.where(alpha >= alpha_min, alpha * through, 0.0)
        through -= weight
        red += weight * 0.3
        green += weight * 0.5
        blue += weight * 0.7
        mean += 0.37
    tl.store(out + tl.program_id(0) * LANES + pixel, through + red + green + blue)
