"""The figures of styles as tables for people."""

from __future__ import annotations

from typing import Any

from tools.bench_style_views import KINDS
from tools.machine import machine_line


def style_text(figures: dict[str, Any]) -> str:
    """All tables."""
    lines = [
        machine_line(figures),
        "",
        *_folding_lines(figures["folding"]),
        "",
        *_apply_lines(figures["apply"]),
    ]
    for scene in figures["scenes"]:
        lines += ["", *_exact_lines(scene["scene"], scene["exact"])]
        lines += ["", *_frame_lines(scene["scene"], scene["frames"], scene["memory"])]
    lines += ["", *_map_lines(figures["maps"]), "", *_score_lines(figures["scores"])]
    for name, rows in figures["views"].items():
        lines += ["", *_view_lines(name, rows)]
    return "\n".join(lines)


def _folding_lines(folding: dict[str, float]) -> list[str]:
    lines = ["FOLDING  largest difference of a colour mapped factor by factor and folded"]
    return [*lines, *(f"  {name:<24}{error:>12.1e}" for name, error in folding.items())]


def _apply_lines(apply: dict[str, Any]) -> list[str]:
    lines = [
        f"APPLY  to {apply['gaussians']} Gaussians, {apply['bytes'] / 1e6:.0f} MB read and written",
        f"  {'':<28}{'ms min':>10}{'median':>10}{'GB/s best':>12}",
    ]
    for name, each in apply.items():
        if isinstance(each, dict):
            ms = each["ms"]
            best = apply["bytes"] / ms["min"] / 1e6
            lines.append(f"  {name:<28}{ms['min']:>10.1f}{ms['median']:>10.1f}{best:>12.1f}")
    return lines


def _exact_lines(scene: str, exact: list[dict[str, Any]]) -> list[str]:
    lines = [
        f"SH AGAINST COLOURS  {scene}; differences of a channel in 1/255",
        f"  {'colours':<9}{'preset':<16}{'pixels a clamp touches':>24}{'max there':>11}"
        f"{'max elsewhere':>15}{'off by > 1/255':>16}",
    ]
    return lines + [
        f"  {each['colors']:<9}{each['preset']:<16}{_percent(each['touched_share']):>24}"
        f"{255 * each['touched_max']:>11.2f}{255 * each['untouched_max']:>15.5f}"
        f"{_percent(each['visible_share']):>16}"
        for each in exact
    ]


def _frame_lines(scene: str, frames: dict[str, Any], memory: dict[str, float] | None) -> list[str]:
    lines = [
        f"FRAMES  {scene}: {frames['gaussians']} Gaussians, {frames['camera']}; "
        f"{frames['repeats']} turns",
        f"  {'':<28}{'clean ms':>10}{'styled ms':>11}{'ratio':>8}{'least':>8}{'90 %':>8}",
    ]
    for each in frames["cases"]:
        ratio = each["ratio"]
        lines.append(
            f"  {each['case']:<28}{each['clean_ms']['median']:>10.1f}"
            f"{each['styled_ms']['median']:>11.1f}{ratio['median']:>8.3f}{ratio['min']:>8.3f}"
            f"{ratio['p90']:>8.3f}"
        )
    if memory is not None:
        lines.append(
            f"  memory above the scene: clean {memory['clean_mib']:.0f} MiB, styled "
            f"{memory['styled_mib']:.0f} MiB, ratio {memory['ratio']:.3f}; with the scene's "
            f"{memory['scene_mib']:.0f} MiB {memory['whole_ratio']:.3f}"
        )
    return lines


def _map_lines(maps: dict[str, Any]) -> list[str]:
    read = maps["read_ms"]["min"]
    lines = [
        f"STYLE IMAGE TO MAP  {maps['image']}; ms, least and median",
        f"  {'':<36}{'min':>10}{'median':>10}{'with reading':>14}",
        f"  {'reading the image':<36}{read:>10.1f}{maps['read_ms']['median']:>10.1f}",
    ]
    lines += [
        f"  {name:<36}{ms['min']:>10.1f}{ms['median']:>10.1f}{read + ms['min']:>14.1f}"
        for name, ms in maps["map_ms"].items()
    ]
    return lines + [
        f"  {'once a scene: ' + name:<36}{ms['min']:>10.1f}{ms['median']:>10.1f}"
        for name, ms in maps["scene_ms"].items()
    ]


def _score_lines(scores: dict[str, Any]) -> list[str]:
    if "methods" not in scores:
        return [f"SCORES  left out: {scores['skipped']}"]
    lines = [
        f"SCORES  {scores['photos']} held-out photos, {scores['size_px']} px; PSNR in dB where the "
        f"right result is known, then pairs of different photos",
        f"  {'':<32}{'same':>8}{'half':>8}{'below':>8}{'look':>8}{'gradients':>11}"
        f"{'oversaturated':>15}{'condition':>11}",
    ]
    for each in scores["methods"]:
        lines.append(
            f"  {each['method']:<32}"
            + "".join(f"{each[name]:>8.2f}" for name in ("same", "half", "below", "look"))
            + f"{each['gradient_ssim']:>11.3f}{_percent(each['oversaturated']):>15}"
            f"{each['conditioning']:>11.1f}"
        )
    limits = ", ".join(f"{name} {value:.2f}" for name, value in scores["limits_db"].items())
    lines.append(f"  best linear map of each case, same: {limits}")
    if scores["skipped"]:
        lines.append(f"  left out: {scores['skipped']}")
    return lines


def _view_lines(scene: str, rows: list[dict[str, Any]]) -> list[str]:
    heads = "".join(f"{kind:>30}" for kind in KINDS)
    lines = [
        f"VIEWS  {scene}: error of a view warped into another, 1/255 rms; to the picture's spread; "
        f"(ratio of each to clean)",
        f"  {'':<26}{heads}",
    ]
    for row in rows:
        cells = []
        for kind in KINDS:
            each = row[kind]
            if each is None:
                cells.append("-")
                continue
            cells.append(
                f"{255 * each['rmse']:.2f} ({_number(each['rmse_ratio'], 2)})  "
                f"{_number(each['relative'], 3)} ({_number(each['relative_ratio'], 2)})"
            )
        lines.append(f"  {row['style']:<26}" + "".join(f"{cell:>30}" for cell in cells))
    return lines


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _percent(share: float) -> str:
    return f"{100 * share:.2f} %"
