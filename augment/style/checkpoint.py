"""Style networks in files: safetensors, with what the network is and where it comes from as JSON.

The file's metadata hold one entry, `climategs.gscm`, a JSON object: format (1), encoder, k, offset,
moments, size (px of the pictures) and about (training facts, free). Tensors may be stored in half
precision; they are float32 in memory.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from augment.batch.atomic import write_atomic
from augment.errors import StyleError
from augment.style.encoder import ENCODERS
from augment.style.network import SIZE_PX, Gscm
from recipes.files import open_file

FORMAT = 1
METADATA_KEY = "climategs.gscm"
SHIPPED = Path(__file__).parent / "checkpoints" / "gscm-small.safetensors"
MAX_K = 256  # of a file that is read: what a hostile header can make us reserve
_FIELDS = {"format": int, "encoder": str, "k": int, "offset": bool, "moments": bool, "size": int}
_WHAT_TO_DO = "give a file that `climategs style train` wrote, or none for the shipped network"


def save_network(
    path: Path, net: Gscm, about: Mapping[str, Any], *, half_precision: bool = False
) -> None:
    """Write the network whole or not at all. about: training facts, anything JSON can hold.

    Raises:
        StyleError: a weight is not finite. OutputError: the system refused.
    """
    header = {
        "format": FORMAT,
        "encoder": net.encoder_name,
        "k": net.k,
        "offset": net.offset,
        "moments": net.moments,
        "size": net.size,
        "about": dict(about),
    }
    tensors: dict[str, Tensor] = {}
    for name, value in net.state_dict().items():
        half = half_precision and value.dtype == torch.float32
        stored = value.detach().cpu().to(torch.float16 if half else value.dtype).contiguous()
        if not bool(torch.isfinite(stored).all()):
            raise StyleError(f"{path}: {name!r} is not finite, so the network was not written")
        tensors[name] = stored
    text = json.dumps(header, sort_keys=True, allow_nan=False)
    write_atomic(path, save(tensors, {METADATA_KEY: text}))


def load_network(path: Path | None = None) -> Gscm:
    """Read a network, ready to use (`eval`); the shipped one by default.

    Raises:
        StyleError: there is no such file, or it is no network of this format.
    """
    path = SHIPPED if path is None else path
    header, tensors = _read(path)
    net = Gscm(header["encoder"], header["k"], header["offset"], header["moments"])
    own = net.state_dict()
    missing, extra = sorted(own.keys() - tensors.keys()), sorted(tensors.keys() - own.keys())
    if missing or extra:
        raise StyleError(
            f"{path}: the tensors are not those of its network: missing {missing[:3]}, "
            f"unknown {extra[:3]}; {_WHAT_TO_DO}"
        )
    for name, value in own.items():
        given = tensors[name]
        if given.shape != value.shape or given.is_floating_point() != value.is_floating_point():
            raise StyleError(
                f"{path}: {name!r} must be {value.dtype} {list(value.shape)}; got {given.dtype} "
                f"{list(given.shape)}; {_WHAT_TO_DO}"
            )
        if not bool(torch.isfinite(given).all()):
            raise StyleError(f"{path}: {name!r} holds values that are not finite; {_WHAT_TO_DO}")
    net.load_state_dict({name: tensors[name].to(own[name].dtype) for name in own})
    return net.eval().requires_grad_(False)


def network_facts(path: Path | None = None) -> dict[str, Any]:
    """The header of a network's file: format, encoder, k, offset, moments, size, about.

    Raises:
        StyleError: as load_network, but for the tensors, which are not looked at.
    """
    path = SHIPPED if path is None else path
    try:
        open_file(path).close()  # to open a pipe would wait for ever
        with safe_open(path, framework="pt") as file:
            return _header(path, file.metadata())
    except (OSError, SafetensorError) as error:
        raise _unreadable(path, error) from error


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    try:
        open_file(path).close()  # to open a pipe would wait for ever
        with safe_open(path, framework="pt") as file:
            header = _header(path, file.metadata())
            return header, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> StyleError:
    return StyleError(f"{path}: the style network cannot be read: {error}; {_WHAT_TO_DO}")


def _header(path: Path, metadata: Mapping[str, str] | None) -> dict[str, Any]:
    text = (metadata or {}).get(METADATA_KEY)
    if text is None:
        raise StyleError(f"{path}: no {METADATA_KEY!r} in the file's metadata; {_WHAT_TO_DO}")
    try:
        header = json.loads(text)
    except ValueError as error:
        raise StyleError(f"{path}: {METADATA_KEY!r} is not JSON: {error}; {_WHAT_TO_DO}") from error
    if not isinstance(header, dict):
        raise StyleError(f"{path}: {METADATA_KEY!r} must be an object; got {text[:60]}")
    if header.get("format") != FORMAT:
        raise StyleError(
            f"{path}: format must be {FORMAT}; got {header.get('format')!r}: the file is of "
            f"another version of climategs; {_WHAT_TO_DO}"
        )
    for name, kind in _FIELDS.items():
        if type(header.get(name)) is not kind:
            raise StyleError(
                f"{path}: {name!r} must be of type {kind.__name__}; got {header.get(name)!r}"
            )
    if header["encoder"] not in ENCODERS:
        raise StyleError(f"{path}: encoder must be one of {ENCODERS}; got {header['encoder']!r}")
    if not 4 <= header["k"] <= MAX_K or header["size"] != SIZE_PX:
        raise StyleError(
            f"{path}: k must be 4 to {MAX_K} and size {SIZE_PX}; got {header['k']} and "
            f"{header['size']}"
        )
    return header
