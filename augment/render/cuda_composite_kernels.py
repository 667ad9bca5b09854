"""Triton kernels: the sky behind the splats, smog on finished images, colour maps, finished pixels.

Images are flat: pixel p is column p % width of row p // width.
"""

from __future__ import annotations

import triton
import triton.language as tl

from augment.render.cuda_sky_kernels import (
    cubemap_color,
    mean_density,
    sky_transmittance,
    transmittance,
)


@triton.jit
def pixels_of(count, width, cx, cy, ifx, ify, BLOCK: tl.constexpr):
    """(pixel, whether there is one, u, v): this program's pixels and x / z, y / z of their rays."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    row = pixel // width
    u = ((pixel - row * width).to(tl.float32) + 0.5 - cx) * ifx
    v = (row.to(tl.float32) + 0.5 - cy) * ify
    return pixel, pixel < count, u, v


@triton.jit
def _load_color(rgb, pixel, mask):
    at = rgb + 3 * pixel
    return tl.load(at, mask, 0.0), tl.load(at + 1, mask, 0.0), tl.load(at + 2, mask, 0.0)


@triton.jit
def _store_color(rgb, pixel, red, green, blue, mask):
    at = rgb + 3 * pixel
    tl.store(at, red, mask)
    tl.store(at + 1, green, mask)
    tl.store(at + 2, blue, mask)


@triton.jit(do_not_specialize=["count"])
def composite_color(rgb, alpha, out, count, red, green, blue, BLOCK: tl.constexpr):
    """out = rgb + (1 - alpha) of one colour."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = pixel < count
    r, g, b = _load_color(rgb, pixel, here)
    through = 1.0 - tl.load(alpha + pixel, here, 1.0)
    r, g, b = tl.fma(through, red, r), tl.fma(through, green, g), tl.fma(through, blue, b)
    _store_color(out, pixel, r, g, b, here)


@triton.jit(do_not_specialize=["count", "width", "side"])
def composite_cubemap(
    rgb, alpha, faces, out,
    count, width, side, cx, cy, ifx, ify,
    xu, xv, xw, yu, yv, yw, zu, zv, zw,
    strength, red, green, blue,
    SMOG: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """out = rgb + (1 - alpha) sky of a cube map, with SMOG through the layered smog before it.

    side: of a face with its border. xu ... zw: rows of world_from_camera. strength: optical depth
    of the smog straight up; red, green, blue: its airlight.
    """
    pixel, here, u, v = pixels_of(count, width, cx, cy, ifx, ify, BLOCK)
    x = tl.fma(xu, u, tl.fma(xv, v, xw))
    y = tl.fma(yu, u, tl.fma(yv, v, yw))
    z = tl.fma(zu, u, tl.fma(zv, v, zw))
    sky_r, sky_g, sky_b = cubemap_color(faces, side, x, y, z, here)
    if SMOG:
        visible = sky_transmittance(x, y, z, strength)
        hidden = 1.0 - visible
        sky_r = tl.fma(visible, sky_r, hidden * red)
        sky_g = tl.fma(visible, sky_g, hidden * green)
        sky_b = tl.fma(visible, sky_b, hidden * blue)
    r, g, b = _load_color(rgb, pixel, here)
    through = 1.0 - tl.load(alpha + pixel, here, 1.0)
    r, g, b = tl.fma(through, sky_r, r), tl.fma(through, sky_g, g), tl.fma(through, sky_b, b)
    _store_color(out, pixel, r, g, b, here)


@triton.jit(do_not_specialize=["count", "width"])
def fog(
    rgb, alpha, depth, out,
    count, width, cx, cy, ifx, ify,
    sigma, red, green, blue, eye_height, up_u, up_v, up_w,
    LAYERED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Deferred smog on premultiplied colour (augment.weather.smog.fog_buffers).

    eye_height: above the smog's base. up_u, up_v, up_w: what x / z, y / z and 1 of a ray climb per
    metre of depth. Both in scale heights; read with LAYERED only.
    """
    pixel, here, u, v = pixels_of(count, width, cx, cy, ifx, ify, BLOCK)
    z = tl.load(depth + pixel, here, 0.0)
    tau = sigma * (z * tl.sqrt(tl.fma(u, u, tl.fma(v, v, 1.0))))
    if LAYERED:
        tau *= mean_density(eye_height, z * tl.fma(up_u, u, tl.fma(up_v, v, up_w)))
    t = transmittance(tau)
    airlight = (1.0 - t) * tl.load(alpha + pixel, here, 0.0)
    r, g, b = _load_color(rgb, pixel, here)
    r, g, b = (
        tl.fma(t, r, airlight * red),
        tl.fma(t, g, airlight * green),
        tl.fma(t, b, airlight * blue),
    )
    _store_color(out, pixel, r, g, b, here)


@triton.jit(do_not_specialize=["count"])
def map_colors(
    rgb, count,
    rr, rg, rb, r1, gr, gg, gb, g1, br, bg, bb, b1,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Every colour becomes M[:, :3] @ colour + M[:, 3], in place. rr ... b1: M, row by row."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = pixel < count
    r, g, b = _load_color(rgb, pixel, here)
    red = tl.fma(rr, r, tl.fma(rg, g, tl.fma(rb, b, r1)))
    green = tl.fma(gr, r, tl.fma(gg, g, tl.fma(gb, b, g1)))
    blue = tl.fma(br, r, tl.fma(bg, g, tl.fma(bb, b, b1)))
    _store_color(rgb, pixel, red, green, blue, here)


@triton.jit(do_not_specialize=["count"])
def share_remainder(alpha, rgb, snow, count, least, BLOCK: tl.constexpr):
    """Pixels of alpha >= least become opaque, and what they hold grows with it, in place.

    rgb, snow: None where there is no such image.
    """
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    a = tl.load(alpha + pixel, pixel < count, 0.0)
    done = (a >= least) & (pixel < count)
    scale = 1.0 / tl.where(done, a, 1.0)
    tl.store(alpha + pixel, 1.0, done)
    if rgb is not None:
        r, g, b = _load_color(rgb, pixel, done)
        _store_color(rgb, pixel, r * scale, g * scale, b * scale, done)
    if snow is not None:
        value = tl.load(snow + pixel, done, 0.0)
        tl.store(snow + pixel, value * scale, done)
