"""The figures of `climategs bench gpu` as text for a terminal, and as Markdown for a document."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from tools.bench_gpu_floor import PIXEL, STAGES
from tools.bench_gpu_targets import Target, targets_of
from tools.tables import aligned, markdown

Figures = Mapping[str, Any]
START = "<!-- gpu: made by climategs bench gpu --table docs/performance.md -->"
END = "<!-- end of gpu -->"
TARGETS = ("what", "measured", "least-p90", "to reach", "", "floor", "of it", "GB/s")
STAGE = ("stage", "ms", "least-p90", "floor ms", "of it", "MB", "GB/s")
FRAMES = (
    "frame", "ms", "least-p90", "x clean", "floor ms", "of it", "8 bits, alone", "in a row",
    "MiB", "of it frame", "same bits",
)  # fmt: skip
AGREEMENT = ("picture", "99.9 %", "most", "off by > 0.001", "pixels")
PLACES = ("scene", "Gaussians", "cameras", "cells", "s", "least-p90", "slowest stages")
Table = tuple[str, Sequence[str], list[tuple[str, ...]]]


def gpu_text(figures: Figures) -> str:
    """Everything that was measured, in columns, and what was not."""
    lines = list(_facts(figures))
    for title, header, rows in _tables(figures):
        lines += ["", f"{title}:", *aligned([header, *rows], left=1)]
    return "\n".join([*lines, *_missing(figures)])


def gpu_markdown(figures: Figures) -> list[str]:
    """The same as lines of a document."""
    lines = [f"- {fact}." for fact in _facts(figures)]
    for title, header, rows in _tables(figures):
        lines += ["", f"**{title}**", "", *markdown(header, rows, left=1)]
    return [*lines, *_missing(figures)]


def write_table(path: Path, figures: Figures) -> None:
    """Into a document between its markers; a file without them is written anew."""
    block = "\n".join([START, "", *gpu_markdown(figures), "", END])
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    before, found, rest = text.partition(START)
    _, closed, after = rest.partition(END)
    whole = before + block + after if found and closed else block + "\n"
    path.write_text(whole, encoding="utf-8")


def _facts(figures: Figures) -> Iterator[str]:
    machine, gpu = figures["machine"], figures["gpu"] or {}
    versions = ", ".join(f"{name} {number}" for name, number in machine["versions"].items())
    named = gpu.get("name", "no GPU: kernels are interpreted, times mean nothing")
    yield f"{figures['date']}, {named}" + (
        f", {gpu['memory_gib']:g} GiB, {gpu['processors']} processors, CUDA {gpu['cuda']}, "
        f"driver {gpu['driver'] or 'unknown'}, triton {gpu['triton']}"
        if gpu
        else ""
    )
    host = f"{machine['processor']}, {machine['cores']} cores"
    yield f"{host}; Python {machine['python']}, {versions}"
    ceilings = figures["ceilings"]
    if "bytes_per_s" in ceilings:
        yield (
            f"at best, measured: {ceilings['bytes_per_s'] / 1e9:.0f} GB/s copied (read and "
            f"written), {ceilings['blends_per_s'] / 1e9:.0f} G blends/s"
        )
    yield f"{figures['repeats']} timed runs of each after {figures['warm_up']}, in turns; medians"


def _tables(figures: Figures) -> Iterator[Table]:
    yield "Figures to reach", TARGETS, [_target_cells(line) for line in targets_of(figures)]
    raster, frames = figures["raster"], figures["frames"]
    if "ms" in raster:
        floor = raster["floor"]
        title = (
            f"{raster['case']}: {floor['visible']:,} of {floor['splats']:,} splats in view, "
            f"{floor['used']:,} before pixels are finished; {floor['pairs']:,} pairs of splats "
            f"and tiles, {floor['pairs_reached']:,} reached; {floor['blends']:,} blends, "
            f"{floor['reached_blends']:,} tried"
        )
        yield title, STAGE, list(_stage_rows(raster))
    if "frames" in frames:
        title = f"{frames['scene']}, {frames['gaussians']:,} Gaussians, {frames['camera']}"
        yield title, FRAMES, [_frame_cells(name, row) for name, row in frames["frames"].items()]
    if "scenes" in figures["placement"]:
        rows = [_place_cells(each) for each in figures["placement"]["scenes"]]
        yield "Where snow lies, once a scene", PLACES, rows
    agreement = figures["agreement"]
    if "frames" in agreement:
        rows = [_agreement_cells(f"random scene, {n}", e) for n, e in agreement["raster"].items()]
        rows += [_agreement_cells(f"street, {n}", e) for n, e in agreement["frames"].items()]
        yield "rgb off the CPU backend's, of every pixel the channel farthest off", AGREEMENT, rows


def _missing(figures: Figures) -> list[str]:
    whys = [
        f"{name}: {found.get('failed') or found.get('left_out')}"
        for name, found in figures.items()
        if isinstance(found, Mapping) and ("failed" in found or "left_out" in found)
    ]
    lines = [f"- {line.what}: {line.why}." for line in targets_of(figures) if line.why]
    lines += [f"- section {why}." for why in whys]
    return ["", "Not measured:", "", *lines] if lines else []


def _target_cells(line: Target) -> tuple[str, ...]:
    form = ".1e" if not line.unit else ".3g"
    unit = f" {line.unit}" if line.unit else ""
    if line.value is None:
        return (line.what, "not measured", "", f"<= {line.most:{form}}{unit}", "", "", "", "")
    return (
        line.what,
        f"{line.value:{form}}{unit}",
        "" if line.spread is None else f"{line.spread[0]:{form}}-{line.spread[1]:{form}}",
        f"<= {line.most:{form}}{unit}",
        "met" if line.met else "MISSED",
        "" if line.floor is None else f"{line.floor:.3g}{unit}",
        "" if line.share is None else f"{100 * line.share:.0f} %",
        "" if line.gb_per_s is None else f"{line.gb_per_s:.0f}",
    )


def _stage_rows(raster: Figures) -> Iterator[tuple[str, ...]]:
    floor, stages = raster["floor"], raster["stages_ms"]
    for name in STAGES:
        yield _stage_cells(name, stages[name], floor["ms"][name], floor["bytes_of"][name])
    whole = floor["ms"]["frame"], floor["bytes"] - floor["bytes_of"][PIXEL]
    for name, spread in raster["ms"].items():
        is_ours = not name.startswith("gsplat")
        yield _stage_cells(name, spread, *(whole if is_ours else (None, None)))
    yield _stage_cells("clean, host waits", raster["host_ms"], None, None)


def _stage_cells(
    name: str, spread: Figures, floor: float | None, moved: float | None
) -> tuple[str, ...]:
    median = spread["median"]
    return (
        name,
        f"{median:.3f}",
        f"{spread['min']:.3f}-{spread['p90']:.3f}",
        "" if floor is None else f"{floor:.3f}",
        "" if floor is None or not median else f"{100 * floor / median:.0f} %",
        "" if moved is None else f"{moved / 1e6:.0f}",
        "" if moved is None or not median else f"{moved / median / 1e6:.0f}",
    )


def _frame_cells(name: str, row: Figures) -> tuple[str, ...]:
    ms, floor = row["ms"], row["floor"]["ms"]["frame"]
    return (
        name,
        f"{ms['median']:.2f}",
        f"{ms['min']:.2f}-{ms['p90']:.2f}",
        f"{row['over_clean']['median']:.2f}",
        f"{floor:.2f}",
        f"{100 * floor / ms['median']:.0f} %" if ms["median"] else "",
        f"{row['delivered']['ms']['median']:.2f}",
        f"{row['delivered']['in_a_row_ms']:.2f}",
        *("-" if mib is None else f"{mib:.0f}" for mib in (row["peak_mib"], row["frame_mib"])),
        "yes" if row["same_bits"] else "NO",
    )


def _agreement_cells(name: str, found: Figures) -> tuple[str, ...]:
    errors = f"{found['p999']:.1e}", f"{found['max']:.1e}"
    return (name, *errors, str(found["flipped"]), f"{found['pixels']:,}")


def _place_cells(found: Figures) -> tuple[str, ...]:
    seconds = found["place_s"]
    slowest = sorted(found["stages_s"].items(), key=lambda item: -item[1]["median"])[:3]
    return (
        found["scene"],
        f"{found['gaussians']:,}",
        str(found["cameras"]),
        f"{found['cells']:,}",
        f"{seconds['median']:.2f}",
        f"{seconds['min']:.2f}-{seconds['p90']:.2f}",
        ", ".join(f"{name} {spread['median']:.2f}" for name, spread in slowest),
    )
