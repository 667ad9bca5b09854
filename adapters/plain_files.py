"""Small files of a dataset: JSON and tables of numbers, and paths that stay inside its folder."""

from __future__ import annotations

import json
import re
import reprlib
from collections import Counter
from collections.abc import Sequence
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, TypeVar

import cv2
import numpy as np
from pydantic import Field, TypeAdapter, ValidationError

from augment.errors import AdapterError
from augment.files.image_size import ImageHeader, decode_pixels, image_header
from augment.files.recorded_images import TWELVE_BITS, has_12_bits
from augment.files.recorded_images import ImageFault as ImageFault
from augment.files.recorded_images import decode_image as decode_image
from augment.files.recorded_images import is_whole_jpeg as is_whole_jpeg
from recipes.errors import RecipeError
from recipes.files import open_file
from recipes.yaml_tree import read_plain

MAX_NESTING = 64  # lists and objects inside each other in a JSON file
LARGEST = 1e9  # metres or pixels: float64 tells a micrometre there, and no drive goes as far
_MAX_BYTES = 1 << 30  # of a text; the longest table of nuScenes' training set has 0.6 GB
_MAX_YAML = 1 << 18  # characters; the configurations of trained scenes have some 10 000
_FROM_DATASET = "copy it from the dataset"
# Whole files with a wrong value in them come from converters; another copy has it too.
_MEND = "Correct the value in the file, or in the program that wrote it"
Value = TypeVar("Value")


def read_text(path: Path, *, if_missing: str = _FROM_DATASET) -> str:
    """Read a UTF-8 file, without the byte order mark that some editors write.

    if_missing: advice for the message about a missing file.
    """
    try:
        with open_file(path) as file:
            data = file.read(_MAX_BYTES + 1)
        if len(data) > _MAX_BYTES:
            raise AdapterError(f"{path} must have at most {_MAX_BYTES} bytes; it has more")
        return data.decode("utf-8-sig")
    except FileNotFoundError:
        raise AdapterError(f"{path} does not exist; {if_missing}") from None
    except (OSError, ValueError) as error:
        raise AdapterError(f"{path} cannot be read as text: {error}") from None


def read_yaml(path: Path, *, if_missing: str = _FROM_DATASET) -> dict[str, Any]:
    """Read the mapping in a YAML file as recipes are read (see recipes.yaml_tree).

    Tags and merge keys are refused, and the expansion of aliases is limited.
    """
    text = read_text(path, if_missing=if_missing)
    if len(text) > _MAX_YAML:
        raise AdapterError(f"{path} must have at most {_MAX_YAML} characters; it has {len(text)}")
    try:
        content = read_plain(text, source=str(path))
    except RecipeError as error:
        raise AdapterError(f"{error}; copy it again") from None
    if not isinstance(content, dict):
        raise AdapterError(f"{path} must hold keys and values; got {type(content).__name__}")
    return content


def read_json(path: Path, kind: type = dict, *, if_missing: str = _FROM_DATASET) -> Any:
    """Read the contents of a JSON file with a `kind` (dict, list, or object for either) at its
    top.

    Python reads NaN, Infinity and whole numbers of any length from JSON; `Number` and `array_of`
    tell them apart.
    """
    text = read_text(path, if_missing=if_missing)
    try:
        content = json.loads(text, object_pairs_hook=_unique)
        _check_nesting(content)
        if r"\ud" in text.lower():  # half a pair of surrogates is no character, and not written
            json.dumps(content, ensure_ascii=False).encode()
    except (ValueError, RecursionError) as error:
        raise AdapterError(f"{path} is not readable JSON ({error}); copy it again") from None
    if not isinstance(content, kind):
        names = {dict: "an object", list: "a list"}
        raise AdapterError(
            f"{path} must hold {names.get(kind, kind.__name__)}; got {type(content).__name__}"
        )
    return content


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    entries = dict(pairs)
    if len(entries) < len(pairs):
        key, count = Counter(key for key, _ in pairs).most_common(1)[0]
        raise ValueError(f"an object has {count} entries {key!r:.80}")
    return entries


def _check_nesting(content: object) -> None:
    """Raise ValueError where later steps, which may call themselves, could run out of stack."""
    inner: list[Any] = [content]
    for _ in range(MAX_NESTING):
        values = (v.values() if isinstance(v, dict) else v for v in inner if _is_nested(v))
        inner = [v for value in values for v in value if _is_nested(v)]
        if not inner:
            return
    raise ValueError(f"more than {MAX_NESTING} lists and objects inside each other")


def _is_nested(value: object) -> bool:
    return isinstance(value, dict | list)


# No texts, true or false, which pydantic otherwise takes for numbers; and none beyond LARGEST.
Number = Annotated[float, Field(strict=True, ge=-LARGEST, le=LARGEST, allow_inf_nan=False)]
Text = Annotated[str, Field(strict=True, max_length=_MAX_BYTES)]  # no half pairs of surrogates


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def validate_content(kind: type[Value], content: object, where: str, *, hint: str = _MEND) -> Value:
    """Validate the content of a file as a pydantic model, or as another type that pydantic
    validates.

    Args:
        kind: the model or type.
        content: the content.
        where: file and place in it, for messages.
        hint: advice for the message about invalid content.
    """
    try:
        return _adapter(kind).validate_python(content)
    except ValidationError as error:
        fault = error.errors(include_url=False, include_context=False)[0]
    names = ".".join(map(str, fault["loc"]))
    said = re.sub(r"^(Value error, |\w+ should )", "", str(fault["msg"]))
    said = said if said.startswith("must ") else f"must {said}"
    got = reprlib.repr(fault["input"])  # of a file's every entry it would be as large as the file
    said = "is missing" if fault["type"] == "missing" else f"{said}; got {got}"
    raise AdapterError(f"{where}: {names}{' ' if names else ''}{said}. {hint}")


def array_of(value: object) -> np.ndarray | None:
    """Return JSON's lists of numbers as float64, NaN and infinity included.

    The result is None if anything else is in them (a text, true, a number beyond float64), or if
    lists have unequal length.
    """
    flat = [value]
    while any(isinstance(v, list) for v in flat):
        flat = [w for v in flat for w in (v if isinstance(v, list) else [v])]
    if not all(type(v) in (int, float) for v in flat):
        return None
    try:
        return np.array(value, np.float64)
    except (ValueError, OverflowError):
        return None


_IMAGE_ENDS = ((b"\x89PNG\r\n\x1a\n", b"IEND"), (b"\xff\xd8", b"\xff\xd9"))
_MOST_HEADER = 1 << 18  # bytes, with previews and profiles
MISSING = "does not exist"


def check_image(path: Path, *, decode: bool = True) -> ImageHeader | str:
    """Return the header of a PNG or JPEG, or the fault of the image as the end of a sentence.

    Args:
        path: the image's file.
        decode: if True, the image is decoded to be sure of it, a JPEG at an eighth of its size. If
            False, its header counts; images of 16 bits are decoded all the same, since their values
            decide.
    """
    try:
        with open_file(path) as file:
            data = file.read(-1 if decode else _MOST_HEADER)
            size = file.seek(0, 2)
            file.seek(max(0, size - 64))
            tail = file.read()
    except FileNotFoundError:
        return MISSING
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    # Decoders fill what is cut off with grey.
    if not any(data.startswith(start) and end in tail for start, end in _IMAGE_ENDS):
        return "is cut short, or neither PNG nor JPEG"
    header = image_header(data)
    if header is None:
        return "cannot be decoded"
    if header.bits == 16:
        if not decode:
            return check_image(path)
        if has_12_bits(data):
            return TWELVE_BITS
    if not decode:
        return header
    flags = cv2.IMREAD_REDUCED_GRAYSCALE_8 if header.format == "JPEG" else cv2.IMREAD_COLOR
    return "cannot be decoded" if decode_pixels(data, flags) is None else header


def read_numbers(path: Path, shape: Sequence[int] | None = None) -> np.ndarray:
    """Read the finite numbers of a text file, float64 in that shape, or flat.

    See `parse_numbers`.
    """
    return parse_numbers(read_text(path).replace(",", " "), str(path), shape)


def parse_numbers(text: str, where: str, shape: Sequence[int] | None = None) -> np.ndarray:
    """Return the finite numbers of a text, float64 in that shape, or flat."""
    try:
        values = np.array([float(word) for word in text.split()], np.float64)
    except ValueError as error:
        raise AdapterError(f"{where} must hold numbers only ({error})") from None
    if not np.isfinite(values).all():
        raise AdapterError(f"{where} holds NaN or infinite numbers")
    if shape is None:
        return values
    if values.size != int(np.prod(shape)):
        expected = " x ".join(map(str, shape))
        raise AdapterError(f"{where} must hold {expected} numbers; it holds {values.size}")
    return values.reshape(shape)


def read_pose(path: Path) -> np.ndarray:
    """Read a rigid transform from a file of 4 x 4 or 3 x 4 numbers, float64 [4, 4]."""
    values = read_numbers(path)
    if values.size not in (12, 16):
        raise AdapterError(f"{path} must hold 4 x 4 numbers, a pose; it holds {values.size}")
    return checked_pose(values.reshape(-1, 4), str(path))


def checked_pose(matrix: np.ndarray, where: str) -> np.ndarray:
    """Return a matrix [3, 4] or [4, 4] as float64 [4, 4] with an exactly orthonormal rotation."""
    pose = np.eye(4)
    pose[: len(matrix)] = matrix
    rotation = pose[:3, :3]
    with np.errstate(all="ignore"):
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    is_pose = (np.abs(pose) <= LARGEST).all() and error < 1e-3 and np.linalg.det(rotation) > 0
    if not is_pose or not np.allclose(pose[3], [0, 0, 0, 1]):
        raise AdapterError(
            f"{where} must be a rotation and a translation (metres) with 0 0 0 1 in its last row; "
            f"got {pose.tolist()}"
        )
    u, _, vt = np.linalg.svd(rotation)
    pose[:3, :3] = u @ vt
    pose[3] = [0, 0, 0, 1]
    return pose


def resolve_inside(root: Path, name: str, where: str) -> Path:
    """Return the path of a dataset's file that a table names relative to the dataset's folder.

    Absolute names and '..' are refused. Links are followed as long as they stay in the folder; the
    folder's own entries are followed too, since people link them to their disks. where: the table
    and row, for messages.
    """
    parts = PurePosixPath(name).parts if isinstance(name, str) else ()
    if not parts or parts[0] == "/" or ".." in parts or "\\" in name or "\0" in name:
        raise AdapterError(
            f"{where} names the file {name!r}; names must be relative to {root}, without '..'"
        )
    path = root.joinpath(*parts)
    real = path.resolve()
    entries = (root.resolve(), (root / parts[0]).resolve()) if len(parts) > 1 else (root.resolve(),)
    if not any(real.is_relative_to(entry) for entry in entries):
        raise AdapterError(
            f"{where} names {name!r}, which leads through a link to {real}, outside {root}; put "
            f"the file itself there"
        )
    return path
