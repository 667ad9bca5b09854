"""Files that a recipe names: their allowed places, and the digest of their contents.

A recipe file names files in its own folder or below, and none outside: a recipe from a stranger
reads no other files.
"""

from __future__ import annotations

import errno
import hashlib
import os
import stat
from collections.abc import Mapping
from io import BufferedReader
from pathlib import Path, PurePosixPath, PureWindowsPath

from recipes.effect import EffectModel
from recipes.errors import RecipeError, nearest_word, short
from recipes.fields import found, replaced
from recipes.schema import SECTIONS, Recipe

# Largest file that is read, MiB.
MAX_MIB = 512
# Largest number of names in a folder that are compared with a misspelt one.
MAX_NAMES = 1000


def with_digest(recipe: Recipe) -> Recipe:
    """Return the recipe with the digests of the files that its sections name.

    Without files it is the same object.

    Raises:
        RecipeError: a file is missing, unreadable or too large, or has another digest than given.
    """
    for path, section in recipe.sections().items():
        if not section.files:
            continue
        try:
            hashes = {name: _hash(section, name) for name in section.files}
            recipe = replaced(recipe, f"{path}.digest", _check_digest(section, hashes))
        except ValueError as error:
            raise RecipeError(f"recipe {recipe.name}, variant {recipe.variant}: {error}") from None
    return recipe


def read_files(section: EffectModel) -> dict[str, bytes]:
    """Return the contents of the section's files by field, checked against its digest if any.

    Raises:
        RecipeError: a file is missing, unreadable or too large, or the files have changed.
    """
    contents = {}
    try:
        for name in section.files:
            with _open(section, name) as file:
                contents[name] = file.read()
        hashes = {name: hashlib.sha256(data).hexdigest() for name, data in contents.items()}
        _check_digest(section, hashes)
    except (ValueError, OSError) as error:
        raise RecipeError(str(error)) from None
    return contents


def digest_of(hashes: Mapping[str, str]) -> str:
    """Return the SHA-256 of a line `FIELD HASH` for each file, in the order of the section's
    fields.
    """
    lines = [f"{name} {digest}\n" for name, digest in hashes.items()]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def file_below(folder: Path, written: str) -> Path:
    """Return the absolute path of the file that a recipe in `folder` names.

    Raises:
        ValueError: the path leads out of the folder, or is no file that can be read.
    """
    folder_text = short(str(folder.absolute()), 200)
    advice = f"put the file beside the recipe, in {folder_text} or below it"
    if PureWindowsPath(written).anchor:
        raise ValueError(f"must be a path from the recipe's folder; {advice}")
    if "\\" in written:
        raise ValueError("must have / between folders, on every system")
    depth = 0
    for part in PurePosixPath(written).parts:
        depth += -1 if part == ".." else 1
        if depth < 0:
            raise ValueError(f"leads out of the recipe's folder; {advice}")
    path = folder.absolute() / written
    try:
        target_path = path.resolve()
        is_inside = target_path.is_relative_to(folder.resolve())
    except (OSError, RuntimeError, ValueError) as error:  # a circle of links; no possible name
        raise ValueError(f"cannot be found: {short(str(error), 200)}") from None
    if not is_inside:
        target = short(str(target_path), 200)
        raise ValueError(f"leads through a link to {target}, out of the recipe's folder; {advice}")
    try:
        _open_checked(path).close()
    except FileNotFoundError:
        name = _nearest_name(path)
        hint = f"did you mean {name}?" if name else "put the file beside the recipe or below it"
        raise ValueError(f"there is no such file in {folder_text}; {hint}") from None
    return path


def open_file(path: str | Path) -> BufferedReader:
    """Open a file that a user has named, for reading.

    Raises:
        OSError: it cannot be opened, or is a folder, a pipe (which might block for ever) or a
            device.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        kind = os.fstat(descriptor).st_mode
        if not (stat.S_ISREG(kind) or stat.S_ISDIR(kind)):
            raise OSError(errno.EINVAL, "a pipe or device, not a regular file", str(path))
        return os.fdopen(descriptor, "rb")  # which refuses folders
    except BaseException:
        os.close(descriptor)
        raise


def _open_checked(path: str | Path) -> BufferedReader:
    """Open a file of no more than MAX_MIB.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file cannot be read. The message says why.
    """
    try:
        file = open_file(path)
    except (FileNotFoundError, NotADirectoryError):
        raise FileNotFoundError(str(path)) from None
    except IsADirectoryError:
        raise ValueError("is a folder, not a file") from None
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror}") from None
    mib = os.fstat(file.fileno()).st_size / 2**20
    if mib > MAX_MIB:
        file.close()
        raise ValueError(f"holds {mib:.0f} MiB, more than the {MAX_MIB} MiB that are read")
    return file


def _field_in_words(section: EffectModel, name: str) -> str:
    """Return a field as `path = value`, for messages."""
    path = next(path for path, model in SECTIONS.items() if model is type(section))
    return f"{path}.{name} = {getattr(section, name)!r}"


def _open(section: EffectModel, name: str) -> BufferedReader:
    try:
        return _open_checked(section.files[name])
    except FileNotFoundError:
        raise ValueError(f"{_field_in_words(section, name)}: there is no such file") from None
    except ValueError as error:
        raise ValueError(f"{_field_in_words(section, name)}: {error}") from None


def _hash(section: EffectModel, name: str) -> str:
    with _open(section, name) as file:
        try:
            return hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            raise ValueError(f"{_field_in_words(section, name)}: cannot be read: {error}") from None


def _check_digest(section: EffectModel, hashes: Mapping[str, str]) -> str:
    digest = digest_of(hashes)
    recipe_digest: str | None = found(section, "digest")
    if recipe_digest not in (None, digest):
        paths = ", ".join(section.files.values())
        subject = "the file has" if len(hashes) == 1 else "one of the files has"
        raise ValueError(
            f"{_field_in_words(section, 'digest')}: {subject} changed since: {paths} now "
            f"gives {digest}; bring back what was there, or remove the digest to take what is"
        )
    return digest


def _nearest_name(path: Path) -> str | None:
    """Return the name in the folder that is most like the file's; None without one."""
    try:
        with os.scandir(path.parent) as entries:
            names = [entry.name for entry, _ in zip(entries, range(MAX_NAMES), strict=False)]
    except OSError:
        return None
    name = nearest_word(path.name, tuple(sorted(names)))
    return short(name) if name else None
