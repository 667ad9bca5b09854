"""The state of an unfinished reconstruction on disk, from which it goes on to the same bits.

`fit.json` says all there is to say and names the arrays' file with its checksum; it is written last
and replaced in one step, so a kill at any moment leaves a whole checkpoint: this one or the one
before.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from augment.errors import OutputError
from augment.jobs.atomic import (
    flush_folder,
    make_folder,
    output_error,
    remove_temporaries,
    temporary_beside,
    write_atomic,
)
from tools.fit_options import differences

VERSION = 1
PLAN_FILE = "fit.json"
_STATES = "state-*.safetensors"


@dataclass(frozen=True)
class Checkpoint:
    """A reconstruction after `step` of `steps` steps.

    settings, length: what was asked for. data: what was found in the recorded data. history: rows
    so far; sums: of the steps since the last row; seconds: spent so far. facts, arrays: the
    Trainer's state; no arrays before the first step. finished: the scene and its report stand.
    """

    settings: dict[str, Any]
    length: dict[str, float]
    steps: int
    data: dict[str, Any]
    step: int = 0
    finished: bool = False
    seconds: float = 0.0
    history: list[dict[str, Any]] = field(default_factory=list)
    sums: dict[str, float] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)
    arrays: dict[str, np.ndarray] = field(default_factory=dict)


def save_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Replace the folder's checkpoint.

    Raises:
        OutputError: the system refused; the checkpoint before is then as it was.
    """
    plan = {**facts_of(checkpoint), "version": VERSION, "state": None}
    name = None
    if checkpoint.arrays:
        name = f"state-{checkpoint.step:07d}.safetensors"
        plan["state"] = {"file": name, "sha256": _write_state(folder / name, checkpoint.arrays)}
    write_atomic(folder / PLAN_FILE, (json.dumps(plan, indent=1) + "\n").encode())
    for path in folder.glob(_STATES):
        if path.name != name:
            _remove(path)
    _remove_leftovers(folder)


def mark_finished(folder: Path) -> None:
    """Note that the scene and the report of the folder's checkpoint are written."""
    plan = _read_plan(folder)
    plan["finished"] = True
    write_atomic(folder / PLAN_FILE, (json.dumps(plan, indent=1) + "\n").encode())


def check_same(
    out: Path, settings: Mapping[str, Any], length: Mapping[str, float], before: Checkpoint
) -> None:
    """Refuse to go on with what was begun with other settings or another length.

    Raises:
        OutputError: it was; every difference is named.
    """
    changed = differences(before.settings, settings)
    if length != before.length and length.get("steps") != before.steps:
        was, now = (" ".join(f"--{n} {v:g}" for n, v in a.items()) for a in (before.length, length))
        changed.append(f"its length was {was} ({before.steps} steps), now {now}")
    if changed:
        raise OutputError(
            f"{out} was begun with other settings: {'; '.join(changed)}. Choose another --out, or "
            f"begin anew with --overwrite"
        )


def load_checkpoint(folder: Path, *, arrays: bool = True) -> Checkpoint | None:
    """The folder's checkpoint; None where there is none. arrays: False leaves them on disk.

    Raises:
        OutputError: a file of it is missing, damaged, or of another version.
    """
    if not (folder / PLAN_FILE).is_file():
        return None
    plan = _read_plan(folder)
    state = plan.pop("state")
    del plan["version"]
    return Checkpoint(**plan, arrays=_read_state(folder, state) if state and arrays else {})


def facts_of(checkpoint: Checkpoint) -> dict[str, Any]:
    """The checkpoint's facts for JSON."""
    names = (name for name in Checkpoint.__dataclass_fields__ if name != "arrays")
    return {name: getattr(checkpoint, name) for name in names}


def _read_plan(folder: Path) -> dict[str, Any]:
    path = folder / PLAN_FILE
    try:
        plan = json.loads(path.read_bytes())
    except OSError as error:
        raise OutputError(f"{path} cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise _damaged(path, str(error)) from error
    version = plan.get("version") if isinstance(plan, dict) else None
    if version != VERSION:
        raise OutputError(
            f"{path} is of version {version}, this program writes {VERSION}: fit to another --out, "
            f"or begin anew with --overwrite"
        )
    names = {*Checkpoint.__dataclass_fields__, "version", "state"} - {"arrays"}
    if wrong := names ^ plan.keys():
        raise _damaged(path, f"it lacks, or should not have, {', '.join(sorted(wrong))}")
    step, steps = plan["step"], plan["steps"]
    if not (isinstance(step, int) and isinstance(steps, int) and 0 <= step <= steps):
        raise _damaged(path, f"it is at step {step!r} of {steps!r}")
    return plan


def _read_state(folder: Path, state: dict[str, str]) -> dict[str, np.ndarray]:
    try:
        path = folder / Path(state["file"]).name  # a name: nothing outside the folder is read
        checksum = state["sha256"]
    except (KeyError, TypeError) as error:
        raise _damaged(folder / PLAN_FILE, "it does not name its state's file") from error
    try:
        with path.open("rb") as file:
            if hashlib.file_digest(file, "sha256").hexdigest() != checksum:
                raise _damaged(path, f"its SHA-256 is not the one in {PLAN_FILE}")
        return {name: np.array(array) for name, array in load_file(path).items()}  # ours to change
    except OSError as error:
        raise _damaged(path, f"it cannot be read ({error.strerror})") from error
    except SafetensorError as error:
        raise _damaged(path, str(error)) from error


def _write_state(path: Path, arrays: dict[str, np.ndarray]) -> str:
    """Write arrays under their final name in one step, without a copy in memory. Returns SHA-256.

    Raises:
        OutputError: the system refused.
    """
    temporary = temporary_beside(path)
    try:
        make_folder(path.parent)
        save_file({name: np.asarray(a, order="C") for name, a in arrays.items()}, temporary)
        with temporary.open("rb") as file:
            checksum = hashlib.file_digest(file, "sha256").hexdigest()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        flush_folder(path.parent)
    except OSError as error:
        raise output_error(path, error) from error
    except SafetensorError as error:  # how it reports a full disk
        raise OutputError(f"cannot write {path}: {error}; see whether the disk is full") from error
    finally:
        temporary.unlink(missing_ok=True)
    return checksum


def _remove_leftovers(folder: Path) -> None:
    """What killed runs left half-written; safetensors has temporary names of its own."""
    remove_temporaries(folder, recursive=False)
    for path in folder.glob(".tmp*"):
        _remove(path)


def _damaged(path: Path, what: str) -> OutputError:
    return OutputError(f"{path} is damaged: {what}. Begin anew with --overwrite")


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise output_error(path, error) from error
