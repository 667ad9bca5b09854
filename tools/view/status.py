"""The status line of a page: its picture, the work for the next one, and how far that has got.

"At rest" is said of nothing but the whole picture of what the page asks for now.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from augment.timing import PassProgress

if TYPE_CHECKING:
    from tools.view.page import ViewRequest

MOVING_S = 0.4  # The time for which the status line speaks of a moving picture, seconds.
BUSY_S = 0.5  # The shortest wait that gets a bar, seconds.
# The passes that draw nothing yet: effects find out there what they put into the scene.
_PREPARATIONS = ("plan", "view plan", "parts", "prune")


@dataclass(frozen=True)
class ShownPicture:
    """The picture that a page has got last."""

    request: ViewRequest
    """The wish of the page that it was drawn for."""
    width: int
    """Its columns, without bars."""
    height: int
    """Its rows, without bars."""
    seconds: float
    """The time that it took, seconds."""
    sent_at: float
    """When it was sent, on the monotonic clock."""
    is_at_rest: bool
    """Whether it is the whole picture, and not a rough one while something moves."""
    is_complete: bool = True
    """Whether what lies over the picture is there, too."""
    is_valid: bool = True
    """Whether the wish's recipe is valid; else the picture is of the last one that was."""


@dataclass
class Activity:
    """The work at hand of the thread that draws. It writes, other threads read."""

    progress: PassProgress | None = None
    """The pass that runs; None before the first."""
    compiling: int = 0
    """Kernels that are being compiled."""
    compiled: int = 0
    """Kernels that have been compiled for this picture."""


@dataclass(frozen=True)
class Status:
    """The status line of a page."""

    text: str
    """One sentence."""
    is_current: bool
    """Whether the picture is of what the page asks for."""
    share: float | None = None
    """How much of a preparation is done, 0 to 1; None where that is not known."""
    is_long: bool = False
    """Whether it takes long enough for a bar."""


def describe_activity(activity: Activity | None) -> str:
    """Return the thread's work in words. activity: None while it draws for another page."""
    if activity is None:
        return "waiting for the picture of another page"
    progress = activity.progress
    if progress is not None and progress.num_steps and not activity.compiling:
        return f"{progress.name}, step {progress.num_done} of {progress.num_steps}"
    if activity.compiling or activity.compiled:  # or another process compiles what is wanted next
        so_far = f", {activity.compiled} done" if activity.compiled else ""
        return f"compiling kernels (only the first time{so_far})"
    if progress is None:
        return "drawing"
    return "preparing the scene" if progress.name in _PREPARATIONS else f"drawing ({progress.name})"


def page_status(
    picture: ShownPicture | None,
    request: ViewRequest,
    activity: Activity | None,
    *,
    waited_s: float,
    now: float,
    has_failed: bool = False,
) -> Status:
    """Return the status line of a page: its picture, and the work for the next one.

    Args:
        picture: The last picture; None before the first.
        wish: What the page asks for.
        activity: What the thread does for this page; None while it draws for another.
        waited_s: Seconds since the wish.
        now: On the monotonic clock.
        has_failed: Whether the wish could not be drawn.
    """
    if has_failed:
        return Status("Not drawn", False)
    is_current = picture is not None and picture.request is request
    if picture is not None:
        size = f"{picture.width} x {picture.height}"
        if is_current and picture.is_at_rest and picture.is_complete:
            recipe = "" if picture.is_valid else "; of the last recipe that was valid"
            return Status(f"{size} at rest, {1000 * picture.seconds:.0f} ms{recipe}", True)
        if not picture.is_at_rest and now - picture.sent_at < MOVING_S:
            return Status(f"{size} while moving, {1000 * picture.seconds:.0f} ms", is_current)
    work = describe_activity(activity)
    if waited_s >= 1:
        work += f", {waited_s:.0f} s"
    share = None
    if activity is not None and activity.progress is not None and not activity.compiling:
        total = activity.progress.num_steps
        share = activity.progress.num_done / total if total else None
    text = f"{_what_is_shown(picture, wish)}: {work}"
    return Status(text, is_current, share, waited_s >= BUSY_S)


def _describe_picture(picture: ShownPicture | None, request: ViewRequest) -> str:
    """Return in words how the picture differs from the wish."""
    if picture is None:
        return "First picture"
    if picture.request is request:
        follows = "what lies over it" if picture.is_at_rest else "the whole one"
        return f"{'Picture' if picture.is_rest else 'Rough picture'}, {follows} follows"
    if picture.request.edits != request.edits:
        return "Picture not of this recipe yet"
    views = ((w.frame, w.camera, w.pose) for w in (picture.request, request))
    if len(set(views)) > 1:
        return "Picture not of this view yet"
    return "Picture not up to date yet"
