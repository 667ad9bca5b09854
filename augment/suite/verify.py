"""Verification of a suite: every file's SHA-256 against `suite.json`."""

from __future__ import annotations

from dataclasses import dataclass

from augment.jobs.mirror import MIRROR_FOLDER
from augment.output.names import STATE_FOLDER
from augment.output.store import Store
from augment.suite.suite_file import SUITE_FILE, SuiteFile, hash_files, read_suite_file

# Folders in which other files are no concern of a suite: the jobs' state, and copies of datasets,
# most of whose files are the dataset's own.
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
    stored_paths = [path for path in store.list("") if not path.startswith(_OTHER_FOLDERS)]
    digests = hash_files(store, suite_file.files)
    return Verification(
        suite_file,
        changed=tuple(p for p, digest in digests.items() if digest != suite_file.files[p]),
        missing=tuple(sorted(suite_file.files.keys() - digests.keys())),
        unlisted=tuple(p for p in stored_paths if p not in suite_file.files and p != SUITE_FILE),
    )
