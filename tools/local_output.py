"""Output folders that must lie on this machine."""

from __future__ import annotations

import re
from pathlib import Path

from augment.errors import OutputError


def check_local(out: Path, instead: str) -> None:
    """Refuse `s3://bucket/path` where a folder is meant: as a path it would be a folder `s3:` here.

    instead: what to do, for the message.

    Raises:
        OutputError: the path begins with a scheme.
    """
    # Path makes one slash of two.
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]+:/", str(out)):
        raise OutputError(
            f"{out} is not on this machine, and this command needs a folder that is; {instead}"
        )
