"""What a flood costs and how right it is: the entry, and the figures as text for people."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from adapters.base import open_scene, parse_uri
from adapters.procedural import open_truth
from tools.bench_flood_cost import bench_camera, bench_cost
from tools.bench_flood_error import bench_error, fresnel_table
from tools.bench_flood_masks import bench_masks, dry_views
from tools.bench_flood_memory import flood_peak_mib
from tools.machine import load_average, machine_facts, machine_line


@dataclass(frozen=True)
class FloodCase:
    """What is measured on. scene: of the cost. width, height: of its image, pixels. street: of the
    errors and masks, procedural, because the truth must be known. scale: of its cameras.
    """

    scene: str = "procedural:street?seed=3&frames=1&gaussians=1000000"
    width: int = 1600
    height: int = 1066
    street: str = "procedural:street?seed=3&frames=6"
    frames: tuple[int, ...] = (0, 5)
    cameras: tuple[str, ...] = ("front", "left", "back")
    scale: float = 1.0


WHOLE = FloodCase()
QUICK = FloodCase(
    scene="procedural:street?seed=3&frames=1",
    width=800,
    height=533,
    street="procedural:street?seed=3&frames=1&gaussians=120000",
    frames=(0,),
    cameras=("front",),
    scale=0.5,
)


def bench_flood(
    case: FloodCase = WHOLE,
    *,
    scene_uri: str | None = None,
    repeats: int = 7,
    memory: bool = True,
    progress: bool = True,
) -> dict[str, Any]:
    """All figures as plain numbers for JSON. scene_uri: another scene for the cost.

    repeats: timed pairs of frames a case, after one that is not counted. memory: also start a
    process for each tier that measures peak memory.
    """
    if repeats < 1:
        raise ValueError(f"need repeats >= 1; got {repeats}")
    if scene_uri is not None:
        case = dataclasses.replace(case, scene=scene_uri)
    machine = machine_facts()
    scene = open_scene(case.scene)
    camera = bench_camera(scene, case.width, case.height)
    cost = {
        "scene": case.scene,
        **bench_cost(scene, camera, repeats=repeats, progress=progress),
        "peak_mib": _memory(case) if memory else None,
    }
    del scene
    street, truth = open_scene(case.street), open_truth(parse_uri(case.street)[2])
    views = [
        street.frame(f).cameras[c].scaled(case.scale) for f in case.frames for c in case.cameras
    ]
    return {
        "machine": dataclasses.asdict(machine),
        "cost": cost,
        "street": case.street,
        "errors": bench_error(street, views),
        "fresnel": fresnel_table(),
        "masks": bench_masks(street, truth, case.frames, scale=case.scale / 2),
        "dry_views": dry_views(street, views[0]),
        "load_after": load_average(),
    }


def _memory(case: FloodCase) -> dict[str, float | None]:
    tiers = {"clean": None, "sky": "sky", "screen_space": "screen_space", "mirrored": "mirrored"}
    return {
        name: flood_peak_mib(case.scene, case.width, case.height, tier)
        for name, tier in tiers.items()
    }


def flood_text(figures: dict[str, Any]) -> str:
    """The figures as tables for people."""
    lines = [
        machine_line(figures),
        "",
        *_cost_lines(figures["cost"]),
        "",
        *_error_lines(figures),
        "",
        *_fresnel_lines(figures["fresnel"], figures["cost"]["fresnel"]),
        "",
        *_mask_lines(figures),
    ]
    return "\n".join(lines)


def _cost_lines(cost: dict[str, Any]) -> list[str]:
    lines = [
        f"COST  {cost['scene']}: {cost['gaussians']} Gaussians",
        f"  {cost['camera']}, {100 * cost['water_share']:.0f} % under water, "
        f"{cost['repeats']} pairs of frames",
        f"  {'':<32}{'clean ms':>10}{'flooded ms':>11}{'ratio':>8}{'min':>7}{'p90':>7}",
    ]
    for case in cost["cases"]:
        ratio = case["ratio"]
        lines.append(
            f"  {case['case']:<32}{case['clean_ms']['median']:>10.1f}"
            f"{case['flooded_ms']['median']:>11.1f}{ratio['median']:>8.2f}"
            f"{ratio['min']:>7.2f}{ratio['p90']:>7.2f}"
        )
    for tier in cost["stages"]:
        lines.append(f"  stages, {tier['tier']}, calm: ms (over the clean frame)")
        lines += [
            f"    {stage['stage']:<30}{stage['ms']['median']:>10.1f}"
            f"   ({stage['over_clean']['median']:.3f})"
            for stage in tier["stages"]
        ]
    peak = cost["peak_mib"]
    if peak is None or None in peak.values():
        lines.append("  memory of a frame: not measured")
    else:
        each = ", ".join(f"{name} {mib:.0f}" for name, mib in peak.items())
        lines.append(f"  memory of a frame above its scene, MiB: {each}")
    return lines


def _error_lines(figures: dict[str, Any]) -> list[str]:
    lines = [
        f"ERROR  {figures['street']}; inside the water, channel errors in 1/255",
        f"  {'':<36}{'PSNR dB':>8}{'p99':>8}{'black':>8}{'worst 32x32':>12}  at",
    ]
    for view in figures["errors"]:
        exact = view["analytic"]
        lines += [
            f"  {view['view']}, {100 * exact['water_share']:.0f} % water",
            f"    {'mirrored against mirrored splats':<34}{exact['psnr_db']:>8.1f}"
            f"   (99.9 % below {exact['p999']:.3f}, all below {exact['largest']:.1f}; "
            f"with its edges {exact['psnr_with_edges_db']:.1f} dB)",
        ]
        for name, tier in view["tiers"].items():
            column, row = tier["worst_block_at"]
            lines.append(
                f"    {name + ', against mirrored':<34}{tier['psnr_db']:>8.1f}{tier['p99']:>8.1f}"
                f"{100 * tier['black_share']:>6.2f} %{tier['worst_block']:>12.1f}  {column}, {row}"
            )
    return lines


def _fresnel_lines(table: dict[str, Any], cost: dict[str, Any]) -> list[str]:
    lines = [f"FRESNEL  index {table['index']}", "  degrees   exact  Schlick  difference"]
    lines += [
        f"  {row['degrees']:>7}{row['exact']:>8.4f}{row['schlick']:>9.4f}"
        f"{row['schlick'] - row['exact']:>+12.4f}"
        for row in table["rows"]
    ]
    named = {"up to 70": "below_70", "at 75": "at_75", "80 to 90": "80_to_90"}
    lines += [
        f"  largest difference {name}: {table[key]['difference']:.4f} "
        f"at {table[key]['degrees']:.1f} degrees"
        for name, key in named.items()
    ]
    ratio = cost["exact_over_schlick"]
    lines.append(
        f"  shading with exact over with Schlick: {ratio['median']:.3f} "
        f"(least {ratio['min']:.3f}, p90 {ratio['p90']:.3f})"
    )
    return lines


def _mask_lines(figures: dict[str, Any]) -> list[str]:
    lines = ["MASKS  share of pixels that agree; in brackets: away from silhouettes, seen by both"]
    for view in figures["masks"]["views"]:
        lines.append(
            f"  {view['view'] + ', with the truth':<36}{100 * view['agreeing']:>8.2f} % "
            f"[{100 * view['agreeing_off_silhouettes']:.3f} % of {view['pixels']} pixels]"
        )
    for pair in figures["masks"]["pairs"]:
        if pair["visible"]:
            lines.append(
                f"  {pair['pair']:<36}{100 * pair['agreeing']:>8.2f} % "
                f"[{100 * pair['agreeing_visible']:.3f} % of {pair['visible']} points]"
            )
    for name, same in figures["dry_views"].items():
        lines.append(f"  {name}: {'the clean frame to the bit' if same else 'NOT the clean frame'}")
    return lines
