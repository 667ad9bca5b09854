"""What the GPU backend is meant to reach on one H200, and whether measured figures do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from tools.bench_gpu_frames import FLOOD, SMOG, SNOW, highest_mib
from tools.bench_gpu_raster import CLEAN

Figures = Mapping[str, Any]
PAPER = (
    "ClimateGS reports 0.002 s clean, 0.020 s smog, 0.020 s flood, 0.025 s snow, 0.023 s style "
    "transfer and 3.24 GB; its GPU and resolution are not stated"
)


@dataclass(frozen=True)
class Target:
    """One line of the result. most: what may not be exceeded, in the unit. value: what was
    measured; None where it was not, and why says so. spread: least and 90 % of it. floor: the least
    that counted bytes and blends can take, in the unit, where that is known. gb_per_s: those bytes
    over the measured time.
    """

    what: str
    unit: str
    most: float
    value: float | None = None
    spread: tuple[float, float] | None = None
    floor: float | None = None
    gb_per_s: float | None = None
    why: str = ""

    @property
    def met(self) -> bool | None:
        return None if self.value is None else self.value <= self.most

    @property
    def share(self) -> float | None:
        """Of the floor in what was measured: 1 is as fast as can be."""
        return None if self.floor is None or not self.value else self.floor / self.value


def targets_of(figures: Figures) -> list[Target]:
    """All of them, whatever was measured."""
    raster, frames = _got(figures, "raster"), _got(figures, "frames")
    clean = Target("clean frame", "ms", 3.0, why=_why(figures, "raster"))
    smog = Target("smog in splats, over clean", "x", 1.1, why=clean.why)
    beside = Target("clean frame, over gsplat's", "x", 1.3, why=clean.why)
    memory = Target("memory of the clean frame and its scene", "GB", 2.0, why=clean.why)
    same = Target("rgb off the CPU backend's, 99.9 %", "", 1e-3, why=_why(figures, "agreement"))
    compared = _got(figures, "agreement")
    if compared is not None:
        same = _one(same, max(each["p999"] for each in compared["raster"].values()))
    if raster is not None:
        clean = _timed(clean, raster["ms"][CLEAN], raster["floor"])
        smog = _spread(smog, raster["smog_over_clean"])
        memory = _one(memory, raster["peak_mib"], 2**20 / 1e9, "no GPU memory was measured")
        other = raster["gsplat"]
        beside = (
            _why_not(beside, other["left_out"])
            if "left_out" in other
            else _spread(beside, other["ratio"])
        )
    return [
        clean,
        smog,
        *_frame_targets(figures, frames),
        _style(figures),
        _placement(figures),
        memory,
        beside,
        same,
    ]


def _frame_targets(figures: Figures, frames: Figures | None) -> list[Target]:
    why, compared = _why(figures, "frames"), _got(figures, "agreement")
    same = Target(
        "street: rgb off the CPU backend's, 99.9 %, worst frame",
        "",
        1e-3,
        why=_why(figures, "agreement"),
    )
    if compared is not None:
        same = _one(same, max(each["p999"] for each in compared["frames"].values()))
    lines = [
        Target("street: smog, over clean", "x", 1.1, why=why),
        Target("street: flood balanced", "ms", 6.0, why=why),
        Target("street: snow fast tier, over clean", "x", 1.3, why=why),
        Target("street: most memory of any frame and its scene", "GB", 2.0, why=why),
        same,
    ]
    if frames is None:
        return lines
    rows = frames["frames"]
    return [
        _spread(lines[0], rows[SMOG]["over_clean"]),
        _timed(lines[1], rows[FLOOD]["ms"], rows[FLOOD]["floor"]),
        _spread(lines[2], rows[SNOW]["over_clean"]),
        _one(lines[3], highest_mib(frames), 2**20 / 1e9, "no GPU memory was measured"),
        same,
    ]


def _style(figures: Figures) -> Target:
    line = Target("style: fold and apply to all SH", "ms", 1.0, why=_why(figures, "style"))
    found = _got(figures, "style")
    return line if found is None else _timed(line, found["ms"], found["floor"])


def _placement(figures: Figures) -> Target:
    """The slowest of the scenes that were named; the procedural street alone decides nothing."""
    line = Target("placement of snow, PandaSet", "s", 1.0, why=_why(figures, "placement"))
    found = _got(figures, "placement")
    if found is None:
        return line
    named = [each for each in found["scenes"] if each["named"]]
    if not named:
        return _why_not(line, "no scene was named with --placement")
    return _spread(line, max((each["place_s"] for each in named), key=lambda s: s["median"]))


def _got(figures: Figures, section: str) -> Figures | None:
    found = figures.get(section)
    return None if found is None or "failed" in found or "left_out" in found else found


def _why(figures: Figures, section: str) -> str:
    found = figures.get(section) or {"left_out": "not measured"}
    return f"failed: {found['failed']}" if "failed" in found else found.get("left_out", "")


def _timed(line: Target, ms: Figures, floor: Figures) -> Target:
    return Target(
        line.what,
        line.unit,
        line.most,
        ms["median"],
        (ms["min"], ms["p90"]),
        floor["ms"]["frame"],
        floor["bytes"] / ms["median"] / 1e6 if ms["median"] else None,
    )


def _spread(line: Target, found: Figures) -> Target:
    return Target(line.what, line.unit, line.most, found["median"], (found["min"], found["p90"]))


def _one(line: Target, value: float | None, unit: float = 1.0, why: str = "") -> Target:
    if value is None:
        return _why_not(line, why)
    return Target(line.what, line.unit, line.most, value * unit)


def _why_not(line: Target, why: str) -> Target:
    return Target(line.what, line.unit, line.most, why=why)
