"""What a report's page says of boxes and of LiDAR sweeps."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from augment.effects.lidar import codes
from tools.report_charts import amount_bar, legend, share_bar
from tools.report_html import Html, joined, tag
from tools.report_labels import VISIBILITY_STEPS, Classes, Sample, Shares
from tools.report_numbers import count
from tools.report_tables import MAX_ROWS, folded_table, number_cell, table

_STEP_CLASSES = ("s0", "s1", "s2", "s3", "s4", "s5")
_CODE_CLASSES = ("c0", "c1", "c2", "c3", "c4", "c5", "c6", "c7")
_CODES = {
    codes.UNCHANGED: "unchanged",
    codes.ATTENUATED: "weaker",
    codes.SCATTERED: "scattered in the air or at the water",
    codes.LOST: "lost",
    codes.MOVED: "on another surface",
}


def class_table(classes: Classes) -> Html:
    """Labelled boxes by class."""
    most = classes.rows[0][1] if classes.rows else 0
    rows = [
        [
            tag("th", label, scope="row"),
            tag("td", count(boxes), amount_bar(boxes, most), class_="n"),
            number_cell(count(tracks)),
        ]
        for label, boxes, tracks in classes.rows[:MAX_ROWS]
    ]
    rest = len(classes.rows) - MAX_ROWS
    note = f"and {count(rest, 'more class')}" if rest > 0 else None
    said = "Boxes of each scene's frames, once for all of its variants" + _sampled(classes.sample)
    return joined(
        [
            folded_table("Boxes by class", ("Class", "Boxes", "Tracks"), rows, note, 1),
            tag("p", said + ".", class_="note"),
        ]
    )


def visibility_bars(shares: Shares) -> Html:
    """How much of the boxes each recipe leaves."""
    bounds = [f"{100 * step:.0f}" for step in VISIBILITY_STEPS] + ["100"]
    names = [f"{a}–{b} %" for a, b in itertools.pairwise(bounds)]
    said = (
        "What the weather leaves of the labelled boxes that an image shows: transmittance of the "
        "smog, times the part that no water hides, times the part that no snow covers"
    )
    return joined(
        [
            tag("h3", "Visibility of boxes"),
            tag("p", said + _sampled(shares.sample) + ".", class_="note"),
            legend(names, _STEP_CLASSES),
            _share_rows(shares, names, _STEP_CLASSES, "box"),
        ]
    )


def code_bars(known: Sequence[int], shares: Shares) -> Html:
    """What became of the LiDAR's points."""
    titles = [_CODES.get(code, f"code {code}") for code in known]
    classes = [_CODE_CLASSES[i % len(_CODE_CLASSES)] for i in range(len(known))]
    said = "LiDAR points by weather code" + _sampled(shares.sample) + "."
    return joined(
        [
            tag("h3", "LiDAR in the weather"),
            tag("p", said, class_="note"),
            legend(titles, classes),
            _share_rows(shares, titles, classes, "point"),
        ]
    )


def _share_rows(shares: Shares, names: Sequence[str], classes: Sequence[str], noun: str) -> Html:
    rows = [
        [
            tag("th", name, scope="row"),
            tag("td", share_bar(counts, names, classes), class_="wide"),
            number_cell(count(sum(counts), noun)),
        ]
        for name, counts in shares.rows[:MAX_ROWS]
    ]
    rest = len(shares.rows) - MAX_ROWS
    note = f"and {count(rest, 'more recipe')}" if rest > 0 else None
    return table(None, rows, note, 1)


def _sampled(sample: Sample) -> str:
    if sample.files >= sample.of:
        return ""
    return f"; from {sample.files:,} of {count(sample.of, 'file')}, evenly chosen"
