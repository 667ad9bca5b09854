"""The status line of a page: its picture, the work for the next one, and its progress.

The line says "at rest" only if the picture is complete and shows what the page requests now.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from augment.timing import PassProgress

if TYPE_CHECKING:
    from tools.view.page import ViewRequest

MOVING_S = 0.4  # The time for which the status line speaks of a moving picture, seconds.
BUSY_S = 0.5  # The shortest wait that gets a bar, seconds.
# The passes that draw nothing yet. Effects compute there what they put into the scene.
_PREPARATIONS = ("plan", "view plan", "collect parts", "prune")


@dataclass(frozen=True)
class ShownPicture:
    """The last picture that was sent to a page."""

    request: ViewRequest
    """The request of the page that it was drawn for."""
    width: int
    """The number of columns, without bars."""
    height: int
    """The number of rows, without bars."""
    seconds: float
    """The time of drawing, seconds."""
    sent_at: float
    """The time when it was sent, on the monotonic clock, seconds."""
    is_at_rest: bool
    """True if it has full quality; False for a rough one while something moves."""
    is_complete: bool = True
    """True if the overlays of the picture were sent, too."""
    is_valid: bool = True
    """True if the request's recipe is valid; else the picture shows the last valid recipe."""


@dataclass
class Activity:
    """The current work of the thread that draws. Only that thread writes it; others read."""

    progress: PassProgress | None = None
    """The pass that runs; None before the first."""
    compiling: int = 0
    """The number of kernels that are being compiled."""
    compiled: int = 0
    """The number of kernels that were compiled for this picture."""


@dataclass(frozen=True)
class Status:
    """The status line of a page."""

    text: str
    """One sentence."""
    is_current: bool
    """True if the picture shows what the page requests."""
    share: float | None = None
    """The finished share of a preparation, 0 to 1; None if it is not known."""
    is_long: bool = False
    """True if the work takes long enough for a progress bar."""


def describe_activity(activity: Activity | None) -> str:
    """Return the thread's work in words.

    Args:
        activity: The work for this page; None while the thread draws for another page.
    """
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
        request: The view that the page asks for.
        activity: The work of the thread for this page; None while it draws for another page.
        waited_s: Seconds since the request.
        now: The time on the monotonic clock, seconds.
        has_failed: True if the request could not be drawn.
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
    text = f"{_describe_picture(picture, request)}: {work}"
    return Status(text, is_current, share, waited_s >= BUSY_S)


def _describe_picture(picture: ShownPicture | None, request: ViewRequest) -> str:
    """Return in words how the picture differs from the request."""
    if picture is None:
        return "First picture"
    if picture.request is request:
        follows = "what lies over it" if picture.is_at_rest else "the whole one"
        return f"{'Picture' if picture.is_at_rest else 'Rough picture'}, {follows} follows"
    if picture.request.edits != request.edits:
        return "Picture not of this recipe yet"
    views = ((w.frame, w.camera, w.pose) for w in (picture.request, request))
    if len(set(views)) > 1:
        return "Picture not of this view yet"
    return "Picture not up to date yet"
