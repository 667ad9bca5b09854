"""The images of a view, made on the GPU by one kernel and brought back in one copy."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.cameras import Camera
from augment.render.cuda import image_kernels as kernels
from augment.render.cuda.runtime import Download, address_of, gpu_device, launch, resident, upload
from augment.render.fog import Fog, vertical_optical_depth
from augment.scene import PosedGaussians
from augment.semantics import SemanticClass
from augment.views import SURFACE_ALPHA, RequestedImages, ViewImages

# ---- Passes over finished images, float32 without gradients --------------------------------------
# Definitions: augment.render.composite, augment.render.fog, augment.render.rasterize.

BLOCK = 128  # pixels of a program: one a thread, which needs few registers and no exchange
MAX_STRENGTH = 1e30  # of fog before the sky: finite in float32, and nothing is seen through it


def composite_color(
    rgb: Float[Tensor, "H W 3"], alpha: Float[Tensor, "H W"], color: Float[Tensor, "3"]
) -> Float[Tensor, "H W 3"]:
    """rgb + (1 - alpha) color. color: read on the host, so it had better lie there."""
    rgb, alpha = rgb.detach().contiguous(), alpha.detach().contiguous()
    out = torch.empty_like(rgb)
    given = (rgb, alpha, out, alpha.numel(), *color.tolist())
    launch(kernels.composite_color, _grid(alpha.numel()), *given, BLOCK=BLOCK)
    return out


def composite_cubemap(
    rgb: Float[Tensor, "H W 3"],
    alpha: Float[Tensor, "H W"],
    camera: Camera,
    faces: Float[Tensor, "6 S S 3"],
    fog: Fog | None,
) -> Float[Tensor, "H W 3"]:
    """The sky of a cube map behind the image. faces: with a border, on either side; kept on the GPU
    for as long as they live. fog: layered.
    """
    rgb, alpha, faces = rgb.detach().contiguous(), alpha.detach().contiguous(), resident(faces)
    out = torch.empty_like(rgb)
    strength, airlight = 0.0, (0.0, 0.0, 0.0)
    if fog is not None:
        vertical = vertical_optical_depth(fog, float(camera.centre[2]))
        strength, airlight = min(vertical, MAX_STRENGTH), fog.rgb
    launch(
        kernels.composite_cubemap,
        _grid(alpha.numel()),
        *(rgb, alpha, faces, out, alpha.numel(), camera.width, faces.shape[1]),
        *_rays(camera),
        *camera.world_from_camera[:3, :3].flatten().tolist(),
        *(strength, *airlight),
        FOG=fog is not None,
        BLOCK=BLOCK,
    )
    return out


def fog(
    rgb: Float[Tensor, "H W 3"],
    alpha: Float[Tensor, "H W"],
    depth: Float[Tensor, "H W"],
    camera: Camera,
    medium: Fog,
) -> Float[Tensor, "H W 3"]:
    """Deferred fog: the image through what lies before its surfaces. depth: z over alpha."""
    rgb, alpha, depth = (image.detach().contiguous() for image in (rgb, alpha, depth))
    out = torch.empty_like(rgb)
    eye, up = 0.0, (0.0, 0.0, 0.0)
    if medium.scale_height_m is not None:
        pose = camera.world_from_camera
        eye = (float(pose[2, 3]) - medium.base_z_m) / medium.scale_height_m
        up = (pose[2, :3] / medium.scale_height_m).tolist()
    launch(
        kernels.fog,
        _grid(alpha.numel()),
        *(rgb, alpha, depth, out, alpha.numel(), camera.width),
        *_rays(camera),
        *(medium.sigma_per_m, *medium.rgb, eye, *up),
        LAYERED=medium.scale_height_m is not None,
        BLOCK=BLOCK,
    )
    return out


def map_colors(rgb: Float[Tensor, "H W 3"], color_map: Float[Tensor, "3 4"]) -> None:
    """Every colour under the map, in place. rgb: contiguous. color_map: read on the host."""
    count = rgb.numel() // 3
    numbers = color_map.detach().flatten().tolist()
    launch(kernels.map_colors, _grid(count), rgb.detach(), count, *numbers, BLOCK=BLOCK)


def renormalise_alpha(
    alpha: Tensor, rgb: Tensor | None, overlay: Tensor | None, stop: float
) -> None:
    """Finished pixels become opaque, in place; all contiguous."""
    count = alpha.numel()
    launch(
        kernels.renormalise_alpha,
        _grid(count),
        *(alpha, rgb, overlay, count, 1 - stop),
        BLOCK=BLOCK,
    )


def _grid(count: int) -> tuple[int]:
    return (-(-count // BLOCK),)


def _rays(camera: Camera) -> tuple[float, float, float, float]:
    """cx, cy, 1 / fx, 1 / fy."""
    return camera.cx, camera.cy, 1 / camera.fx, 1 / camera.fy


QUANTIZE_BLOCK = 512  # pixels of a program: four a thread, whose bytes are written as words
ALIGNMENT = 16  # bytes, of every image in the memory that is copied
# What the kernel writes. torch computes with no uint16, so instances are written as int16.
KINDS = {
    "rgb": (torch.uint8, np.uint8),
    "depth_m": (torch.float32, np.float32),
    "scene_depth_m": (torch.float32, np.float32),
    "water": (torch.uint8, np.uint8),
    "overlay": (torch.uint8, np.uint8),
    "semantic": (torch.uint8, np.uint8),
    "instance": (torch.int16, np.uint16),
}


@dataclass(frozen=True)
class _Place:
    """Where an image lies in the memory that is copied. start: in bytes."""

    start: int
    shape: tuple[int, ...]
    on_gpu: torch.dtype
    on_cpu: type

    @property
    def end(self) -> int:
        return self.start + math.prod(self.shape) * self.on_gpu.itemsize

    def of(self, packed: Tensor) -> Tensor:
        return packed[self.start : self.end].view(self.on_gpu)

    def read(self, memory: np.ndarray) -> np.ndarray:
        return memory[self.start : self.end].view(self.on_cpu).reshape(self.shape)


def begin_cuda_images(requested: RequestedImages, camera: Camera) -> Callable[[], ViewImages]:
    """Launches the kernel and the copy. What is returned waits for them."""
    shares_depth = requested.scene_depth_m is requested.depth_m and requested.first is None
    asked = {
        "rgb": True,
        "depth_m": requested.depth_m is not None,
        "scene_depth_m": requested.scene_depth_m is not None and not shares_depth,
        "water": requested.water is not None,
        "overlay": requested.overlay is not None,
        "semantic": requested.semantic,
        "instance": requested.instance,
    }
    places = _places([name for name in KINDS if asked[name]], camera)
    packed = torch.empty(
        max(place.end for place in places.values()), dtype=torch.uint8, device=gpu_device()
    )
    _make({name: place.of(packed) for name, place in places.items()}, requested, camera)
    copy = Download(packed)

    def finish() -> ViewImages:
        memory = copy.result().numpy()
        images = {name: place.read(memory) for name, place in places.items()}
        if shares_depth and "depth_m" in images:
            images["scene_depth_m"] = images["depth_m"]
        return ViewImages(rgb=images.pop("rgb"), **images)

    return finish


def _places(names: Sequence[str], camera: Camera) -> dict[str, _Place]:
    """One image after the other."""
    places, end = dict[str, _Place](), 0
    for name in names:
        shape = (camera.height, camera.width, 3) if name == "rgb" else (camera.height, camera.width)
        start = -(-end // ALIGNMENT) * ALIGNMENT
        places[name] = _Place(start, shape, *KINDS[name])
        end = places[name].end
    return places


def _make(images: dict[str, Tensor], requested: RequestedImages, camera: Camera) -> None:
    looked_up = requested.semantic or requested.instance
    parts = requested.parts if looked_up else ()
    semantics = [part.gaussians.semantic for part in parts]
    classes = [None if own is None else resident(own) for own in semantics]  # kept until the launch
    table = upload(_table_of(parts, classes)) if looked_up else None
    shown = requested.shown
    pose = camera.world_from_camera
    eye_m = 0.0 if requested.plane_z_m is None else float(pose[2, 3]) - requested.plane_z_m
    count = camera.height * camera.width
    launch(
        kernels.make_images,
        (-(-count // QUANTIZE_BLOCK),),
        requested.rgb.detach().contiguous(),
        _plain(requested.depth_m),
        _plain(requested.scene_depth_m if "scene_depth_m" in images else None),
        _plain(requested.water),
        _plain(requested.overlay),
        _plain(shown.alpha if looked_up else None),
        _plain(shown.splat_ids if looked_up else None),
        table,
        *(images.get(name) for name in KINDS),
        *(count, camera.width, len(requested.parts), (len(requested.parts) - 1).bit_length()),
        *(camera.cx, camera.cy, 1 / camera.fx, 1 / camera.fy),
        *(-pose[2, :3]).tolist(),
        eye_m,
        *(SURFACE_ALPHA, int(SemanticClass.SKY), int(SemanticClass.WATER)),
        SHOWS_WATER=requested.first is not None,
        IN_AIR=requested.plane_z_m is not None,
        BLOCK=QUANTIZE_BLOCK,
    )


def _table_of(parts: Sequence[PosedGaussians], classes: Sequence[Tensor | None]) -> np.ndarray:
    """int64 [P, 3]: first splat, address of the classes on the GPU or 0, instance."""
    table = np.zeros((len(parts), 3), np.int64)
    table[1:, 0] = np.cumsum([len(part.gaussians) for part in parts[:-1]])
    table[:, 1] = [0 if own is None else address_of(own) for own in classes]
    table[:, 2] = [part.instance_id for part in parts]
    return table


def _plain(image: Tensor | None) -> Tensor | None:
    """As the kernel reads it: contiguous, and bools as bytes."""
    if image is None:
        return None
    image = image.detach().contiguous()
    return image.view(torch.uint8) if image.dtype == torch.bool else image
