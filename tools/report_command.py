"""`climategs report`."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional


def report(out: Positional[str], html: Path | None = None, images: int = 48) -> int:
    """Write one HTML page about an output: contents, weather, pictures, sliders, failures.

    It needs no network, may be sent to others as it is, and is written also while jobs are running.

    Args:
        out: A folder that `climategs render` or `generate` wrote, or its URI (s3://bucket/path).
        html: The page to write. By default OUT/report.html; NAME-report.html in the working folder
            where OUT is not on this machine.
        images: How many pictures the page has at most. It stays below 5 MB with any number.
    """
    from tools.report import text_of, write_report

    print(text_of(write_report(out, html, images)))
    return 0
