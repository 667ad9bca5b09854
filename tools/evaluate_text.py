"""The consistency of an output as Markdown tables."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

_PARTS = {"all": "", "dry": "without water", "water": "water only"}


def evaluation_text(facts: dict[str, Any]) -> str:
    """All tables."""
    apart = facts["frames_apart"]
    names = {
        "short": _frames(apart["short"]),
        "long": _frames(apart["long"]),
        "cameras": "neighbouring cameras",
    }
    with_lpips = facts["lpips"] is not None
    lines = []
    for kind, name in names.items():
        lines += [f"{name[0].upper()}{name[1:]}", "", *_table(facts, kind, with_lpips), ""]
    if with_lpips:
        lines += [
            f"LPIPS is of {facts['lpips']}, over the whole picture, in which pixels that do not "
            f"count are taken to agree; `counted` is it divided by the share that counts.",
            "",
        ]
    return "\n".join(lines).rstrip()


def _table(facts: dict[str, Any], kind: str, with_lpips: bool) -> list[str]:
    titles = ["recipe", "effects", "pairs", "left out", "apart", "pixels that count"]
    titles += ["RMSE", "p90", "relative"] + ["LPIPS", "counted"] * with_lpips
    lines = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    for row in facts["recipes"]:
        lines += [f"| {' | '.join(cells)} |" for cells in _rows(row, kind, with_lpips)]
    return lines


def _rows(row: dict[str, Any], kind: str, with_lpips: bool) -> Iterator[list[str]]:
    """The cells of one recipe: all pixels, then those without and with water."""
    found = row[kind]
    if found is None or found["all"] is None:
        left_out = "0" if found is None else str(found["left_out"])
        yield [row["recipe"], row["effects"], "0", left_out, *["–"] * (5 + 2 * with_lpips)]
        return
    apart = f"{found['meters_apart']:.2f} m, {found['seconds_apart']:.2f} s"
    for part, title in _PARTS.items():
        each = found[part]
        if each is None:
            continue
        share, rmse = each["share"]["mean"], each["rmse"]
        relative = f"{each['relative']['mean']:.3f}" if "relative" in each else "–"
        numbers = [f"{100 * share:.0f} %", f"{rmse['mean']:.4f} ± {rmse['std']:.4f}"]
        numbers += [f"{rmse['p90']:.4f}", relative]
        if with_lpips:
            keys = ("lpips", "lpips_counted")
            numbers += [f"{each[k]['mean']:.4f}" if k in each else "–" for k in keys]
        if part == "all":
            yield [
                row["recipe"],
                row["effects"],
                str(each["pairs"]),
                str(found["left_out"]),
                apart,
                *numbers,
            ]
        else:
            yield [title, "", str(each["pairs"]), "", "", *numbers]


def _frames(count: int) -> str:
    return f"{count} frame{'s' * (count != 1)} apart"
