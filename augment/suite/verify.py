"""Verification of a suite: every file's SHA-256 against `suite.json`."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from augment.jobs.mirror import MIRROR_FOLDER
from augment.output.names import STATE_FOLDER
from augment.output.store import Store, StoredFileMissing
from augment.suite.suite_file import SUITE_FILE, SuiteFile, hash_file, read_suite_file

# Files that are read at a time.
_NUM_READS = 8
# Folders that hold no file of a suite: the jobs' state, and copies of datasets.
_OTHER_FOLDERS = (f"{STATE_FOLDER}/", f"{MIRROR_FOLDER}/")


@dataclass(frozen=True)
class Verification:
    """Outcome of the verification of a suite."""

    suite_file: SuiteFile
    """The suite's statement of its files."""
    changed: tuple[str, ...]
    """Paths of the files whose bytes have changed."""
    missing: tuple[str, ...]
    """Paths of the files that are not there."""
    unlisted: tuple[str, ...]
    """Paths of files in the folder that the suite does not state."""

    @property
    def is_intact(self) -> bool:
        """Return True if every file of the suite has the bytes that it was rendered with."""
        return not self.changed and not self.missing


def verify_suite(store: Store) -> Verification:
    """Hash all files of a suite and compare them with `suite.json`.

    Raises:
        OutputError: There is no `suite.json`, or it is damaged, or a file cannot be read.
    """
    suite_file = read_suite_file(store)
    paths = sorted(suite_file.files)

    def digest_of(path: str) -> str | None:
        try:
            return hash_file(store, path)
        except StoredFileMissing:
            return None

    with ThreadPoolExecutor(_NUM_READS, thread_name_prefix="hashes") as pool:
        digest_by_path = dict(zip(paths, pool.map(digest_of, paths), strict=True))
    stored_paths = [path for path in store.list("") if not path.startswith(_OTHER_FOLDERS)]
    return Verification(
        suite_file,
        changed=tuple(
            path
            for path, digest in digest_by_path.items()
            if digest is not None and digest != suite_file.files[path]
        ),
        missing=tuple(path for path, digest in digest_by_path.items() if digest is None),
        unlisted=tuple(
            path for path in stored_paths if path not in suite_file.files and path != SUITE_FILE
        ),
    )
