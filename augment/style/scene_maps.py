"""From a recipe's style to the maps of a scene: the one place that knows all the methods."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.cameras import Camera
from augment.errors import StyleError
from augment.scene import Scene
from augment.style.closed_form import LAND_LIMITS, closed_maps
from augment.style.content import (
    PICTURE_SIZE,
    content_key,
    content_pictures,
    content_statistics,
)
from augment.style.images import StyleImage, image_statistics, read_style_image
from augment.style.maps import StyleMaps, identity_map, with_strength
from augment.style.statistics import Statistics
from recipes.style import Style

if TYPE_CHECKING:
    from augment.style.network import Gscm

MOST_REMEMBERED = 8  # styles of a scene

_remembered: WeakKeyDictionary[Scene, dict[tuple, StyleMaps]] = WeakKeyDictionary()
_given: WeakKeyDictionary[Scene, dict[Style, StyleMaps]] = WeakKeyDictionary()


def style_maps(scene: Scene, style: Style, *, cameras: Sequence[Camera] | None = None) -> StyleMaps:
    """The maps that give the scene the style's colours, float32; identities at strength 0.

    style: image, mask and checkpoint are paths that can be opened as they are. Its applied_to says
    which of the maps are wanted, and changes none. cameras: those that the scene will be seen by;
    None for all of its own. The last few are remembered for as long as the scene lives, with what
    their files held when they were first read. `remember_maps` overrides all of this.

    Raises:
        StyleError: an image, a preset or a checkpoint cannot be used.
    """
    if not style.changes:
        return identity_maps()
    given = _given.get(scene, {}).get(style)
    if given is not None:
        return given
    key = (style, content_key(scene, cameras))
    known = _remembered.setdefault(scene, {})
    if key not in known:
        maps = _find_maps(scene, style, cameras)
        while len(known) >= MOST_REMEMBERED:
            del known[next(iter(known))]
        known[key] = maps
    return known[key]


def remember_maps(scene: Scene, style: Style, maps: StyleMaps) -> None:
    """Make `style_maps` give these maps for the scene and the style from now on, whatever the
    cameras.
    """
    given = _given.setdefault(scene, {})
    while len(given) >= MOST_REMEMBERED:
        del given[next(iter(given))]
    given[style] = maps


def identity_maps() -> StyleMaps:
    """One map for all, which changes nothing."""
    return StyleMaps(identity_map()[None], identity_map(), identity_map())


def _find_maps(scene: Scene, style: Style, cameras: Sequence[Camera] | None) -> StyleMaps:
    if style.method == "gscm":
        found = _network_map(scene, style, cameras)
        return StyleMaps(found[None], found, found)
    return closed_maps(
        content_statistics(scene, cameras, per_region=style.per_region),
        _style_statistics(style),
        method=style.method,
        strength=style.strength,
        per_region=style.per_region,
    )


def _style_statistics(style: Style) -> Statistics:
    if style.preset is not None:
        from augment.style.presets import preset_statistics

        return preset_statistics(style.preset)
    return image_statistics(_style_image(style))


def _style_image(style: Style) -> StyleImage:
    assert style.image is not None
    mask = None if style.mask is None else Path(style.mask)
    return read_style_image(Path(style.image), mask)


def _network_map(
    scene: Scene, style: Style, cameras: Sequence[Camera] | None
) -> Float[Tensor, "3 4"]:
    from augment.style.network import compose, style_side

    picture = _style_picture(_style_image(style))
    net = _network(style.checkpoint, _stamp(style.checkpoint))
    content = content_pictures(scene, cameras)
    found = compose(style_side(net, picture), _content_side(scene, net, content)).double()
    if not bool(torch.isfinite(found).all()):
        raise StyleError(
            f"the network gives no finite map for style image {style.image}: {found.tolist()}; "
            f"use another checkpoint, or method mkl"
        )
    mean = content.double().mean((0, 2, 3))
    full = _limited(found, mean)
    return _limited(with_strength(full, style.strength), mean).float()


def _content_side(
    scene: Scene, net: Gscm, content: Float[Tensor, "B 3 256 256"]
) -> Float[Tensor, "3 4"]:
    """The scene's half of its maps, remembered with the pictures and the network it is of."""
    from augment.style.network import content_side

    known = _content_sides.get(scene)
    if known is None or known[0] is not net or known[1] is not content:
        known = _content_sides[scene] = (net, content, content_side(net, content))
    return known[2]


_content_sides: WeakKeyDictionary[Scene, tuple[Gscm, Tensor, Tensor]] = WeakKeyDictionary()


@functools.lru_cache(maxsize=2)
def _network(path: str | None, _stamp: tuple[int, int]) -> Gscm:
    """The network of a file, read once for all styles for as long as the file stays as it is."""
    from augment.style.checkpoint import load_network

    return load_network(None if path is None else Path(path))


def _stamp(path: str | None) -> tuple[int, int]:
    """What changes with a file; of one that is not there, nothing: reading it says so."""
    if path is None or not Path(path).is_file():
        return (0, 0)
    found = Path(path).stat()
    return (found.st_mtime_ns, found.st_size)


def _style_picture(image: StyleImage) -> Float[Tensor, "1 3 256 256"]:
    """The style image squeezed to a square; what does not count has the others' mean colour."""
    # By NumPy and OpenCV: on pictures this small torch's threads cost more than they give.
    weights = image.weights[..., None]
    mean = np.average(image.rgb.reshape(-1, 3), axis=0, weights=image.weights.reshape(-1))
    filled = image.rgb * weights + mean.astype(np.float32) * (1 - weights)
    square = cv2.resize(filled, (PICTURE_SIZE, PICTURE_SIZE), interpolation=cv2.INTER_AREA)
    square = np.clip(square, 0, 1).transpose(2, 0, 1)[None]
    return torch.from_numpy(np.ascontiguousarray(square))


def _limited(color_map: Float[Tensor, "3 4"], mean: Float[Tensor, "3"]) -> Float[Tensor, "3 4"]:
    """The map with no gain above that of the closed forms; the mean colour goes where it went."""
    matrix, offset = color_map[:, :3], color_map[:, 3]
    u, gains, v = torch.linalg.svd(matrix)
    if float(gains.max()) <= LAND_LIMITS.most_gain:
        return color_map
    tamed = u @ torch.diag(gains.clamp(max=LAND_LIMITS.most_gain)) @ v
    return torch.cat([tamed, (offset + (matrix - tamed) @ mean)[:, None]], 1)
