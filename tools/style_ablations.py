"""`climategs style train --ablations`: what each part of the training is good for (ClimateGS,
supplement, "Ablation Studies"), by networks that were trained alike but for that part.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from augment.effects.style.scores import DEFINITIONS
from augment.jobs.atomic import write_atomic
from tools.fit_options import length_of
from tools.style_train import train_style
from tools.style_train_options import StyleTrainOptions
from tools.training import Outcome

TABLE_FILE, TEXT_FILE = "ablations.json", "ablations.txt"
FULL = "all losses, 3x4"
# By folder: the table's name, and what is changed. Pairs have an L_con and L_cyc of their own.
VARIANTS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "full": (FULL, {}),
    "no_consistency": ("without L_con", {"consistency": 0.0, "pair_weights": "consistency=0"}),
    "no_cycle": ("without L_cyc", {"cycle": 0.0, "pair_weights": "cycle=0"}),
    "matrix_3x3": ("3x3", {"matrix": "3x3"}),
}
_COLUMNS = {
    "content_rmse": ("content RMSE", "{:.3f}"),
    "restoration_psnr": ("restored, dB", "{:.2f}"),
    "style_loss": ("L_s", "{:.3f}"),
    "same": ("same, dB", "{:.2f}"),
    "half": ("half, dB", "{:.2f}"),
    "look": ("look, dB", "{:.2f}"),
}


def train_ablations(options: StyleTrainOptions, *, progress: bool = True) -> Outcome:
    """Trains every variant into a folder of its own below `options.out`, and compares them there.

    All take the same seed and steps; minutes are shared among them. A variant that is finished is
    not trained again.

    Raises:
        ClimateGSError: as `train_style`.
    """
    steps = options.steps
    minutes = length_of(options).get("minutes")
    minutes = None if minutes is None else minutes / len(VARIANTS)
    rows: dict[str, dict[str, Any]] = {}
    for folder, (name, changes) in VARIANTS.items():
        changed = dict(changes)
        if "pair_weights" in changed and options.pair_weights:
            changed["pair_weights"] = f"{options.pair_weights},{changed['pair_weights']}"
        variant = dataclasses.replace(
            options,
            out=options.out / folder,
            ablations=False,
            steps=steps,
            minutes=minutes if steps is None else None,
            **changed,
        )
        outcome = train_style(variant, progress=progress)
        if outcome.code:
            return outcome
        steps = int(outcome.report["steps"])  # the first one's, however fast the others are
        rows[name] = outcome.report["scores"]
    report = {"steps": steps, "seed": options.seed, "definitions": DEFINITIONS, "rows": rows}
    _write(options.out, report)
    return Outcome(0, report)


def ablation_table(rows: Mapping[str, Mapping[str, float]]) -> str:
    """Markdown, one row a variant; a dash where a score is not known."""
    known = [name for name in _COLUMNS if any(name in row for row in rows.values())]
    lines = [["training", *(_COLUMNS[name][0] for name in known)]]
    lines.append(["---"] + ["---:"] * len(known))
    for title, row in rows.items():
        cells = [_COLUMNS[n][1].format(row[n]) if n in row else "-" for n in known]
        lines.append([title, *cells])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def _write(out: Path, report: Mapping[str, Any]) -> None:
    table = ablation_table(report["rows"])
    write_atomic(out / TABLE_FILE, (json.dumps(report, indent=1) + "\n").encode())
    write_atomic(out / TEXT_FILE, table.encode())
    print(table, end="")
    print(f"table: {out / TEXT_FILE}")
