"""Facts that a command also writes for machines."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

JsonFile = Annotated[Path | None, arg(name="json", metavar="FILE")]


def write_json(path: Path | None, facts: dict[str, Any], *, say: bool = True) -> None:
    """Write facts to a file, if one is named, and by default say so.

    Raises:
        OutputError: the file cannot be written.
    """
    if path is None:
        return
    from augment.errors import OutputError

    try:
        path.write_text(json.dumps(facts, indent=2) + "\n")
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error
    if say:
        print(f"wrote {path}", file=sys.stderr)
