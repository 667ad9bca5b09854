"""The figures of the worked example as Markdown tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tools.machine import machine_line

REGIME_NAMES = {
    "clean": "clean",
    "jitter": "clean, colours jittered",
    "weather": "clean and weather",
}


def training_text(figures: dict[str, Any]) -> str:
    """Markdown: scores by condition and by class, and what was trained on what."""
    case, views = figures["case"], figures["views"]
    summary = figures["summary"]
    seeds = len(case["seeds"])
    seconds, cpu = figures["seconds"], figures["cpu_seconds"]
    spent = "; ".join(f"{part} {seconds[part]:.0f} ({cpu[part]:.0f})" for part in seconds)
    draws = {part: _draws(figures["draws"][part]) for part in ("train", "test")}
    return "\n".join(
        [
            f"{machine_line(figures)}",
            "",
            f"Seconds (processor seconds): {spent}; all {sum(seconds.values()):.0f} "
            f"({sum(cpu.values()):.0f}). Images written: {figures['generated']['written']}, "
            f"found: {figures['generated']['found']}.",
            "",
            f"{len(case['train_scenes'])} training scenes, {views['train']} views, each clean and "
            f"as {draws['train']}; {len(case['test_scenes'])} test scenes, {views['test']} views. "
            f"{case['steps']} steps of {case['batch']} images, {figures['parameters']} weights, "
            f"{seeds} seeds.",
            "",
            f"mIoU in %, mean over {seeds} seeds (least to greatest)",
            "",
            *_condition_table(summary, case),
            "",
            "IoU in % by class, mean over the seeds",
            "",
            *_class_table(summary, case),
        ]
    )


def _condition_table(summary: dict[str, Any], case: dict[str, Any]) -> list[str]:
    rows = []
    for group, names in case["test_weather"].items():
        for name in names:
            each = [summary[regime]["conditions"][name] for regime in summary]
            rows.append([f"{group}: {name}" if group != name else name, *map(_cell, each)])
        if len(names) > 1:
            each = [summary[regime]["groups"][group] for regime in summary]
            rows.append([f"**{group}, mean**", *map(_cell, each)])
    return _table(["tested on", *(f"trained on {REGIME_NAMES[r]}" for r in summary)], rows)


def _class_table(summary: dict[str, Any], case: dict[str, Any]) -> list[str]:
    conditions = [name for names in case["test_weather"].values() for name in names]
    labels = list(summary[next(iter(summary))]["classes"][conditions[0]])
    rows = []
    for condition in conditions:
        for regime, found in summary.items():
            of_class = found["classes"][condition]
            values = [
                f"{100 * of_class[label]['mean']:.1f}" if label in of_class else "-"
                for label in labels
            ]
            rows.append([condition, REGIME_NAMES[regime], *values])
    return _table(["tested on", "trained on", *labels], rows)


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [
        f"| {' | '.join(heads)} |",
        f"|{' --- |' * len(heads)}",
        *(f"| {' | '.join(row)} |" for row in rows),
    ]


def _cell(spread: dict[str, Any]) -> str:
    mean, low, high = (100 * spread[name] for name in ("mean", "min", "max"))
    return f"{mean:.1f} ({low:.1f} to {high:.1f})"


def _draws(scenes: dict[str, Sequence[str]]) -> str:
    """How many draws of each recipe a scene has: `2 x smog, 1 x snow`."""
    names = [variant.rpartition("-")[0] for variant in next(iter(scenes.values()))[1:]]
    return ", ".join(f"{names.count(name)} x {name}" for name in dict.fromkeys(names))
