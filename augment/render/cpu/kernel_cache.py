"""Compiled kernels, kept in the user's cache folder for the next process.

    $XDG_CACHE_HOME or ~/.cache, climategs/kernels/DIGEST/

DIGEST is of numba's version and of the sources that a kernel is made from, so checkouts with the
same sources share what was compiled, and checkouts with other sources never meet. A folder that no
process has used for KEEP_DAYS is removed when the next one is made. NUMBA_CACHE_DIR names another
place. Where the cache folder cannot be written, numba's own choice is used: beside the sources.
"""

# pyright: reportPrivateImportUsage=false, reportAttributeAccessIssue=false
# (numba has no types)

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import shutil
import time
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    InTreeCacheLocator,
    UserProvidedCacheLocator,
    _CacheLocator,
)

# Days after which an unused folder is removed.
KEEP_DAYS = 60
SECONDS_A_DAY = 86_400


def user_cache_folder() -> Path | None:
    """Return the folder of this package in the user's cache folder; it may not exist yet.

    It is None if the user has no home. A relative XDG_CACHE_HOME does not count, as the XDG Base
    Directory Specification says.
    """
    cache_home = Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        base = cache_home if cache_home.is_absolute() else Path.home() / ".cache"
    except RuntimeError:
        return None
    return base / "climategs"


@functools.cache
def kernel_cache_folder() -> Path | None:
    """Return the folder of the compiled kernels; it is the same one as long as this process runs.

    It is None if the user has no home.
    """
    folder = user_cache_folder()
    return None if folder is None else folder / "kernels"


def cache_of_kernel(function: Any, sources_digest: str) -> FunctionCache | None:
    """Return numba's cache of one kernel; None if no folder can be written.

    Args:
        function: the Python function of the kernel.
        sources_digest: digest of the files whose code the kernel may contain besides its own file.
    """

    class Folder(UserCacheLocator):
        digest_of_others = sources_digest

    class Files(CompileResultCacheImpl):
        _locator_classes = (UserProvidedCacheLocator, Folder, InTreeCacheLocator)

    class Cache(FunctionCache):
        _impl_class = Files

    try:
        return Cache(function)
    except RuntimeError:  # none of the three places can be written
        return None


class UserCacheLocator(_CacheLocator):
    """Locator of one kernel's files: a folder that is named by all sources of the kernel."""

    digest_of_others = ""

    def __init__(self, function: Any, file: str, kernels: Path) -> None:
        self._py_file = file  # numba's warnings read it
        self._line = function.__code__.co_firstlineno
        versions = f"{numba.__version__} {self.digest_of_others} {_file_digest(file)}"
        self._digest = hashlib.sha256(versions.encode()).hexdigest()[:24]
        self._folder = kernels / self._digest

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return self._digest

    def get_disambiguator(self) -> str:
        return str(self._line)

    def ensure_cache_path(self) -> None:
        if not _is_ready(self.get_cache_path()):
            raise PermissionError(self.get_cache_path())

    @classmethod
    def from_function(cls, function: Any, file: str) -> UserCacheLocator | None:
        """Return the locator of a kernel; None if its folder cannot be written."""
        kernels = kernel_cache_folder()
        if kernels is None:
            return None
        try:
            locator = cls(function, file, kernels)
            locator.ensure_cache_path()
        except OSError:
            return None
        return locator


@functools.cache
def _file_digest(path: str) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


@functools.cache
def _is_ready(path: str) -> bool:
    make_folder(Path(path))
    return os.access(path, os.W_OK)


def make_folder(folder: Path) -> None:
    """Make the folder of a kernel, or note that it is still in use."""
    if not folder.is_dir():
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        _remove_unused(folder.parent)
    elif time.time() - folder.stat().st_mtime > SECONDS_A_DAY:
        with contextlib.suppress(OSError):
            os.utime(folder)


def _remove_unused(folder: Path) -> None:
    """Remove folders that no process has used for KEEP_DAYS; their kernels are compiled again."""
    oldest = time.time() - KEEP_DAYS * SECONDS_A_DAY
    for entry in os.scandir(folder):
        with contextlib.suppress(OSError):
            if entry.stat(follow_symlinks=False).st_mtime < oldest:
                shutil.rmtree(entry.path, ignore_errors=True)
