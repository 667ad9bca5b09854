"""The public entry to rasterisation: it checks the arguments, chooses a backend and calls it."""

from __future__ import annotations

import dataclasses
import functools
import logging
import math
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
import torch

from augment.detail.lod import choose_parts
from augment.errors import BackendUnavailable
from augment.render.backends import import_cpu, import_cuda
from augment.render.buffers import (
    ALPHA,
    AUTO,
    BACKENDS,
    BUFFERS,
    CPU,
    CUDA,
    DIFFERENTIABLE,
    EXPECTED_DEPTH,
    REFERENCE,
    RGB,
    RenderOutput,
    choose_kernels,
)
from augment.render.constants import (
    MAX_COV2D_BLUR,
    MAX_TRANSMITTANCE_STOP,
    TRANSMITTANCE_STOP,
    RasterSettings,
)
from augment.render.cpu.order import cut_in_fog
from augment.render.fog import Fog
from augment.render.fog_image import apply_fog_to_render
from augment.render.gsplat_backend import GEOMETRY, tracked_geometry
from augment.render.layout import HeightClip
from augment.render.reference import rasterize_reference
from augment.render.sh import MAX_DEGREE
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, PosedGaussians


def renormalise_alpha(output: RenderOutput, stop: float, *, backend: str = CPU) -> RenderOutput:
    """Make pixels of alpha >= 1 - stop opaque.

    Behind a raised transmittance stop nothing has been blended. Left transparent, that share of a
    pixel would show the sky through every wall. Instead, the blended part stands for it: rgb and
    overlay are divided by alpha, and alpha becomes 1. (The default stop of 1e-4 is less than 8 bits
    show, and gsplat leaves it transparent, too.)

    Args:
        output: a render with alpha; the kernels overwrite it.
        stop: transmittance stop of the render.
        backend: on the CPU, float32 without gradients goes through a kernel, equal within float
            rounding.
    """
    alpha = output.alpha
    assert alpha is not None
    images = {name: getattr(output, name) for name in ("rgb", "overlay")}
    images = {name: image for name, image in images.items() if image is not None}
    if choose_kernels(backend, alpha, *images.values()) == CPU:
        from augment.render import composite_kernels
        from augment.render.threads import kernel_threads

        flat_images = {name: image.numpy().reshape(-1) for name, image in images.items()}
        rgb, overlay = (
            flat_images.get(name, np.empty(0, np.float32)) for name in ("rgb", "overlay")
        )
        with kernel_threads():
            composite_kernels.renormalise_alpha(
                alpha.numpy().reshape(-1), rgb, overlay, np.float32(1 - stop)
            )
        return output
    is_finished = alpha >= 1 - stop
    scale = torch.where(is_finished, 1 / alpha.clamp_min(1 - stop), torch.ones_like(alpha))
    scaled_images = {
        name: image * (scale[..., None] if image.ndim == 3 else scale)
        for name, image in images.items()
    }
    opaque_alpha = torch.where(is_finished, torch.ones_like(alpha), alpha)
    return dataclasses.replace(output, alpha=opaque_alpha, **scaled_images)


logger = logging.getLogger(__name__)


def rasterize(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    *,
    buffers: Collection[str] = (RGB, ALPHA),
    settings: RasterSettings = RasterSettings(),  # noqa: B008 - frozen, so sharing it is safe
    fog: Fog | None = None,
    clip: HeightClip | None = None,
    pixel_mask: torch.Tensor | None = None,
    backend: str = AUTO,
) -> RenderOutput:
    """Return image buffers of the parts seen by the camera; the sky is not part of them.

    Args:
        parts: Gaussians with their poses; splat_ids counts through them in this order.
        camera: the camera.
        buffers: names from augment.render.buffers; the other buffers are None in the result.
        settings: thresholds of the image.
        fog: fog that fades every splat's colour towards the airlight by the splat's own distance.
        clip: height above, or below, which splats are drawn (augment.render.layout).
        pixel_mask: bool [H, W], the pixels that will be looked at; a backend may leave the others
            0.
        backend: one of "cpu" (numba, float32; gradients of rgb, alpha and expected_depth, for
            pinhole cameras, without fog, clip, light per pixel or colour maps, and only if no other
            buffer is asked for), "cuda" (Triton, float32; parts may lie on either side and are kept
            on the GPU as long as their tensors live; the buffers lie there; gradients as
            augment.render.cuda.backward says), "reference" (torch, float32 or float64, gradients of
            all buffers, on the CPU), "auto" (cuda if the Gaussians lie on a GPU, else cpu if it can
            do the job, else reference).

    Raises:
        ValueError, TypeError: no backend, or not the named one, can take an argument.
        BackendUnavailable: the named backend cannot run on this machine.
    """
    camera.check_no_lens("drawing splats")
    _check_arguments(parts, camera, buffers, settings)
    _check_devices(parts, backend)
    if fog is not None and camera.is_orthographic:
        raise ValueError(
            f"camera {camera.name!r} is orthographic: there is no eye from which to measure how "
            f"far the fog is looked through; render it without fog, or with a pinhole camera"
        )
    size = (camera.height, camera.width)
    if pixel_mask is not None and (
        pixel_mask.dtype != torch.bool or tuple(pixel_mask.shape) != size
    ):
        raise ValueError(
            f"pixel_mask must be bool {list(size)} (the camera's size); got "
            f"{pixel_mask.dtype} {list(pixel_mask.shape)}"
        )
    image = _Image(parts, camera, frozenset(buffers), settings, fog, clip, pixel_mask)
    chosen_backend = _choose_backend(image, backend)
    if settings.lod_px > 0 and not _needs_gradients(parts):
        level_settings = cut_in_fog(settings, fog, clip, image.buffers)
        levels = choose_parts(
            parts, camera, level_settings, fog, clip, takes_whole_levels=chosen_backend == CPU
        )
        return levels.restore_ids(_render(image._replace(parts=levels.parts), chosen_backend))
    return _render(image, chosen_backend)


def _render(image: _Image, backend: str) -> RenderOutput:
    """Return the image; pixels behind a raised transmittance stop are opaque."""
    stop = image.settings.transmittance_stop
    if stop <= TRANSMITTANCE_STOP:
        return _call_backend(image, backend)
    output = _call_backend(image._replace(buffers=image.buffers | {ALPHA}), backend)
    opaque_output = renormalise_alpha(output, stop, backend=backend)
    return (
        opaque_output if ALPHA in image.buffers else dataclasses.replace(opaque_output, alpha=None)
    )


class _Image(NamedTuple):
    """The checked arguments of `rasterize`."""

    parts: Sequence[PosedGaussians]
    camera: Camera
    buffers: frozenset[str]
    settings: RasterSettings
    fog: Fog | None
    clip: HeightClip | None
    pixel_mask: torch.Tensor | None


def _call_backend(image: _Image, backend: str) -> RenderOutput:
    """Return the image by one backend, with its own function for gradients."""
    if backend == REFERENCE:
        return rasterize_reference(*image[:-1])
    module = import_cuda() if backend == CUDA else import_cpu()
    if _needs_gradients(image.parts):
        if backend == CUDA:
            from augment.render.cuda.backward import rasterize_with_gradients
        else:
            from augment.render.cpu.backward import rasterize_with_gradients
        return rasterize_with_gradients(*image[:4])
    parts = [_detach_part(p) for p in image.parts]
    mask = image.pixel_mask
    if backend == CUDA and image.fog is not None and image.fog.banks is not None:
        return _fog_buffers(image._replace(parts=parts), image.fog)
    if backend == CUDA:
        return module.rasterize_cuda(parts, *image[1:])
    return module.rasterize_cpu(parts, *image[1:-1], None if mask is None else mask.numpy())


def _fog_buffers(image: _Image, fog: Fog) -> RenderOutput:
    """Return the image on the GPU with fog on the finished buffers; kernels there know no banks."""
    if RGB not in image.buffers:
        return _call_backend(image._replace(fog=None), CUDA)
    buffers = image.buffers | {ALPHA, EXPECTED_DEPTH}
    clear = _call_backend(image._replace(fog=None, buffers=buffers), CUDA)
    fogged = dataclasses.replace(clear, rgb=apply_fog_to_render(clear, image.camera, fog))
    extra: dict[str, None] = dict.fromkeys(buffers - image.buffers)
    return dataclasses.replace(fogged, **extra)


def _choose_backend(image: _Image, backend: str) -> str:
    """Return the backend to use. The first choice for each reason is logged."""
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}; got {backend!r}")
    first_means = image.parts[0].gaussians.means
    if backend == AUTO and first_means.device.type != "cpu":
        backend = CUDA
    if backend == REFERENCE:
        return REFERENCE
    obstacle = None
    if first_means.dtype != torch.float32:
        obstacle = f"the Gaussians are {first_means.dtype}, it takes torch.float32"
    elif _needs_gradients(image.parts):
        missing_gradients = _missing_gradients(image, backend)
        obstacle = missing_gradients and f"gradients {missing_gradients} are asked for, it has none"
    if backend in (CPU, CUDA):
        if obstacle:
            other_backends = (
                "'auto' or 'reference'" if backend == CPU else "'reference', on the CPU"
            )
            raise ValueError(
                f"backend {backend!r} cannot render these Gaussians: {obstacle}; convert or detach "
                f"them, or use backend {other_backends}"
            )
        return backend
    if obstacle is None:
        try:
            import_cpu()
        except BackendUnavailable as error:
            obstacle = str(error)
    if obstacle:
        _log_choice(REFERENCE, f"not cpu: {obstacle}", logging.WARNING)
        return REFERENCE
    _log_choice(CPU, "float32", logging.INFO)
    return CPU


def _missing_gradients(image: _Image, backend: str) -> str | None:
    """Return the gradients that are asked for and that the backend lacks; None if it has all."""
    if any(part.shading is not None for part in image.parts):
        return "of light per pixel"
    if any(part.color_maps is not None for part in image.parts):
        return "through colour maps"
    if image.fog is not None:
        return "through fog"
    if image.clip is not None:
        return "of a clip"
    if backend == CUDA and not tracked_geometry(image.parts):
        return None  # colours move no other buffer, and any camera has its own kernels' gradients
    if image.camera.is_orthographic:
        return "of an orthographic camera"
    other_buffers = image.buffers - DIFFERENTIABLE
    return f"of {', '.join(sorted(other_buffers))}" if other_buffers else None


@functools.cache
def _log_choice(backend: str, reason: str, level: int) -> None:
    logger.log(level, "backend 'auto' renders with %r (%s)", backend, reason)


def _check_arguments(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    buffers: Collection[str],
    settings: RasterSettings,
) -> None:
    """Check parts, buffers and settings; the first fault is raised."""
    if isinstance(buffers, str):
        raise TypeError(f"buffers must be a collection of names; got the string {buffers!r}")
    unknown_buffers = sorted(set(buffers) - set(BUFFERS))
    if unknown_buffers or not buffers:
        problem = (
            f"unknown buffers {', '.join(map(repr, unknown_buffers))}"
            if unknown_buffers
            else "no buffers"
        )
        raise ValueError(f"{problem} asked for; known: {', '.join(BUFFERS)}")
    _check_settings(settings)
    if not isinstance(parts, Sequence) or not parts:
        raise ValueError(
            f"parts must be a non-empty sequence of PosedGaussians; got "
            f"{'an empty one' if isinstance(parts, Sequence) else type(parts).__name__}"
        )
    first_means = parts[0].gaussians.means
    if first_means.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"Gaussians must be float32 or float64; got {first_means.dtype}")
    for number, part in enumerate(parts):
        means = part.gaussians.means
        if means.dtype != first_means.dtype:
            raise ValueError(
                f"all parts must share one dtype; part 0 is {first_means.dtype}, "
                f"part {number} is {means.dtype}"
            )
        _check_pose(part, number, camera)
        _check_shading(part, number)
        _check_color_maps(part, number)


def _check_devices(parts: Sequence[PosedGaussians], backend: str) -> None:
    """Check that all tensors lie on the CPU or, for a backend that can take it, on one GPU."""
    if backend in (AUTO, CUDA):
        devices = {part.gaussians.means.device for part in parts}
        gpu_devices = {device for device in devices if device.type != "cpu"}
        if backend == AUTO and gpu_devices and devices != gpu_devices:
            raise ValueError(
                f"parts lie on {', '.join(sorted(map(str, devices)))}; move all to one device, or "
                f"name the backend"
            )
        return
    for number, part in enumerate(parts):
        if part.gaussians.means.device.type != "cpu":
            raise ValueError(
                f"part {number} is on {part.gaussians.means.device}, where backend {backend!r} "
                f"cannot read it; move it with .cpu(), or use backend 'cuda'"
            )


def _check_shading(part: PosedGaussians, number: int) -> None:
    """Check the light of a part that is lit pixel by pixel."""
    if part.shading is None:
        return
    shape = (len(part.gaussians), 3)
    slopes = part.shading.slopes
    if tuple(slopes.shape) != shape or not slopes.dtype.is_floating_point:
        raise ValueError(
            f"part {number}: shading.slopes must be floats {list(shape)} (from its Gaussians); "
            f"got {slopes.dtype} {list(slopes.shape)}"
        )
    length = math.hypot(*part.shading.sun)
    if not abs(length - 1) < 1e-3:  # `not <` also catches NaN
        raise ValueError(f"part {number}: shading.sun must be of length 1; got {part.shading.sun}")
    if not (math.isfinite(part.shading.wrap) and part.shading.wrap >= 0):
        raise ValueError(
            f"part {number}: shading.wrap must be finite and >= 0; got {part.shading.wrap}"
        )


def _check_color_maps(part: PosedGaussians, number: int) -> None:
    """Check the colour maps of a part and their rows."""
    maps = part.color_maps
    if maps is None:
        return
    if part.shading is not None:
        raise ValueError(
            f"part {number} has colour maps and light per pixel, which maps do not reach; map the "
            f"colours and slopes of its shading instead"
        )
    if maps.ndim != 3 or len(maps) == 0 or tuple(maps.shape[1:]) != (3, 4):
        raise ValueError(
            f"part {number}: color_maps must be [C, 3, 4] with C >= 1; got {list(maps.shape)}"
        )
    rows = part.color_rows
    if rows is not None and (rows.dtype != torch.int16 or len(rows) != len(part.gaussians)):
        raise ValueError(
            f"part {number}: color_rows must be int16 [{len(part.gaussians)}] (from its "
            f"Gaussians); got {rows.dtype} {list(rows.shape)}"
        )
    if not maps.dtype.is_floating_point or not bool(torch.isfinite(maps).all()):
        raise ValueError(f"part {number}: color_maps must be finite floats; got {maps}")


def _check_pose(part: PosedGaussians, number: int, camera: Camera) -> None:
    """Check the pose of a part."""
    pose = part.world_from_part
    if pose is None:
        return
    if pose.dtype != torch.float64 or tuple(pose.shape) != (4, 4):
        raise ValueError(
            f"part {number}: world_from_part must be float64 [4, 4]; "
            f"got {pose.dtype} {list(pose.shape)}"
        )
    if not bool(torch.isfinite(pose).all()):
        raise ValueError(
            f"part {number} (instance {part.instance_id}): world_from_part holds NaN or infinite "
            f"values at {camera.timestamp_ns} ns; check the actor's track"
        )


def _check_settings(settings: RasterSettings) -> None:
    """Check the range of every setting."""
    s = settings
    degree = settings.sh_degree
    max_stop = MAX_TRANSMITTANCE_STOP
    positive_metres = "finite and > 0 (metres)"
    rules = {
        "near_m": (0 < s.near_m < math.inf, positive_metres),
        "alpha_max": (
            0 < s.alpha_max < 1,
            "between 0 and 1 (usual: 0.999 or 0.99), since a splat of alpha 1 would never be "
            "blended",
        ),
        "mode_depth_floor_m": (0 < s.mode_depth_floor_m < math.inf, positive_metres),
        "transmittance_stop": (
            0 < s.transmittance_stop <= max_stop,
            f"> 0 and at most {max_stop}, since median depth is where less than half the light is "
            f"left",
        ),
        "radius_clip_px": (0 <= s.radius_clip_px < math.inf, "finite and >= 0 (pixels)"),
        "blur_px2": (0 < s.blur_px2 <= MAX_COV2D_BLUR, f"> 0 and at most {MAX_COV2D_BLUR} (px^2)"),
        "fog_cut": (0 <= s.fog_cut <= max_stop, f">= 0 and at most {max_stop}"),
        "lod_px": (0 <= s.lod_px < math.inf, "finite and >= 0 (pixels)"),
        "sh_degree": (degree is None or 0 <= degree <= MAX_DEGREE, f"None or 0 to {MAX_DEGREE}"),
    }
    for name, (is_good, requirement) in rules.items():
        if not is_good:
            raise ValueError(f"settings.{name} must be {requirement}; got {getattr(s, name)}")


def _needs_gradients(parts: Sequence[PosedGaussians]) -> bool:
    return torch.is_grad_enabled() and any(_requires_grad(p.gaussians) for p in parts)


def _requires_grad(gaussians: Gaussians) -> bool:
    return any(getattr(gaussians, name).requires_grad for name in (*GEOMETRY, "sh"))


def _detach_part(part: PosedGaussians) -> PosedGaussians:
    """Return the part without autograd, which numpy would refuse.

    It is the same object if no tensor requires a gradient.
    """
    if not _requires_grad(part.gaussians):
        return part
    tensors = {name: getattr(part.gaussians, name).detach() for name in (*GEOMETRY, "sh")}
    return dataclasses.replace(part, gaussians=dataclasses.replace(part.gaussians, **tensors))
