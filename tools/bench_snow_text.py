"""The figures of snow as tables for people."""

from __future__ import annotations

from typing import Any

from tools.bench_snow_depths import OFF_M, ZONES
from tools.bench_snow_masks import SAME_M, SAME_SHARE
from tools.machine import machine_line


def snow_text(figures: dict[str, Any]) -> str:
    """All tables."""
    lines = [
        machine_line(figures),
        "",
        *_accuracy_lines(figures["street"], figures["accuracy"]),
        "",
        *_depth_lines(f"{figures['street']}, against the truth", figures["depths"]),
    ]
    for scene in figures["scenes"]:
        if scene["lidar_depths"] is not None:
            title = f"{scene['scene']}, against its LiDAR"
            lines += ["", *_depth_lines(title, scene["lidar_depths"])]
    for scene in figures["scenes"]:
        lines += ["", *_placement_lines(scene["scene"], scene["placement"])]
        lines += ["", *_cost_lines(scene["scene"], scene["cost"])]
    return "\n".join([*lines, "", *_mask_lines(figures["masks"])])


def _accuracy_lines(street: str, accuracy: dict[str, Any]) -> list[str]:
    lines = [
        f"ACCURACY  {street}: {accuracy['exposed_flat_seen']} points that are open to the sky, "
        f"flat and seen, within {accuracy['reach_m']:g} m; crowns of trees apart",
        f"  {'heights from':<14}{'covered':>10}{'+ crowns':>10}{'off edges':>10}"
        f"{'sheltered':>11}{'in the air':>11}{'bed error median, p95, bias, cm':>34}",
    ]
    for each in accuracy["estimators"]:
        lines.append(
            f"  {each['estimator']:<14}{_percent(each['covered']):>10}"
            f"{_percent(each['covered_with_crowns']):>10}"
            f"{_percent(each['covered_off_edges']):>10}"
            f"{_percent(each['sheltered']):>11}{_percent(each['in_the_air']):>11}"
            f"{_error_cm(each['bed_error_m']):>34}"
        )
    lines += [
        f"  as drawn from above; the scene's own surface is off by "
        f"{100 * accuracy['scene_bias_m']:+.1f} cm",
        f"  {'heights from':<14}{'depth cm':>9}{'covered':>10}{'sheltered':>11}"
        f"{'error median, p95, bias, cm':>34}{'allowed':>9}{'without that':>14}",
    ]
    for each in accuracy["estimators"]:
        lines += [
            f"  {each['estimator']:<14}{100 * drawn['depth_m']:>9.0f}"
            f"{_percent(drawn['covered']):>10}{_percent(drawn['sheltered']):>11}"
            f"{_error_cm(drawn['error_m']):>34}{100 * drawn['allowed_m']:>9.1f}"
            f"{_cm(drawn['error_on_scene_m']['median']):>14}"
            for drawn in each["depths"]
        ]
    best = accuracy["estimators"][0]
    classes = ", ".join(
        f"{name} {_percent(found['covered'])} of {found['points']}"
        for name, found in best["classes"].items()
    )
    lines += [
        f"  {each['estimator']}, {each['vehicles']['points']} points on driving cars: "
        f"covered {_percent(each['vehicles']['covered'])}, bed error "
        f"{_error_cm(each['vehicles']['bed_error_m'])} cm"
        for each in accuracy["estimators"]
    ]
    rings = ", ".join(f"{name} {_percent(share)}" for name, share in best["rings"].items())
    return [*lines, f"  {best['estimator']}, covered: {classes}", f"  {rings}"]


def _depth_lines(title: str, depths: dict[str, dict[str, Any]]) -> list[str]:
    heads = "".join(f"{zone + ' mean, median, off':>32}" for zone in ZONES)
    lines = [
        f"DEPTHS OF CAMERAS  {title}; cm, and share off by more than {100 * OFF_M:.0f} cm",
        f"  {'':<22}{heads}",
    ]
    for name, zones in depths.items():
        row = f"  {name:<22}"
        for zone in ZONES:
            each = zones[zone]
            if each["pixels"]:
                row += f"{100 * each['mean_m']:>14.1f}{100 * each['median_m']:>8.1f}"
                row += f"{_percent(each['off']):>10}"
            else:
                row += f"{'-':>32}"
        lines.append(row)
    return lines


def _placement_lines(scene: str, placed: dict[str, Any]) -> list[str]:
    stages = ", ".join(f"{k} {v['median']:.2f}" for k, v in placed["stages_s"].items())
    file, place = placed["file"], placed["place_s"]
    peak = placed["peak_mib"]
    memory = "memory not measured" if peak is None else f"{peak:.0f} MiB above the scene"
    lines = [
        f"PLACEMENT  {scene}: {placed['gaussians']} Gaussians, {placed['cameras']} cameras, cells "
        f"of {placed['cell_m']:g} m",
        f"  {place['median']:.2f} s (least {place['min']:.2f}): {stages}; {memory}",
        f"  {placed['cells']} cells, and {placed['vehicle_cells']} on {placed['vehicles']} "
        f"vehicles; {placed['buried']} Gaussians may be buried",
        f"  file {file['mib']:.1f} MiB: key {file['key_s']:.2f} s, written in "
        f"{file['save_s']:.2f} s, read in {file['load_s']:.2f} s",
    ]
    lines += [
        f"  laid anew, {shading}: {laid['seconds']['median']:.3f} s "
        f"(least {laid['seconds']['min']:.3f}), {laid['gaussians']} Gaussians"
        for shading, laid in placed["lay"].items()
    ]
    return lines


def _cost_lines(scene: str, cost: dict[str, Any]) -> list[str]:
    lines = [
        f"COST  {scene}: {cost['gaussians']} Gaussians",
        f"  {cost['camera']}, {cost['repeats']} pairs of frames",
        f"  {'':<32}{'clean ms':>10}{'snowy ms':>11}{'ratio':>8}{'min':>7}{'p90':>7}",
    ]
    for case in cost["cases"]:
        ratio = case["ratio"]
        lines.append(
            f"  {case['case']:<32}{case['clean_ms']['median']:>10.1f}"
            f"{case['snowy_ms']['median']:>11.1f}{ratio['median']:>8.2f}"
            f"{ratio['min']:>7.2f}{ratio['p90']:>7.2f}"
        )
    for each in cost["stages"]:
        counts = "; ".join(
            f"{name} {found['splats']} splats, {found['visible']} visible, {found['pairs']} pairs"
            for name, found in each["counts"].items()
        )
        lines.append(f"  stages, {each['shading']}: {counts}")
        lines += [
            f"    {stage['stage']:<30}{stage['clean_ms']['median']:>10.1f}"
            f"{stage['snowy_ms']['median']:>11.1f}"
            for stage in each["stages"]
        ]
    return lines


def _mask_lines(masks: dict[str, Any]) -> list[str]:
    lines = [
        f"VIEWS  neighbours where depths agree within {100 * SAME_SHARE:.0f} % and "
        f"{100 * SAME_M:.0f} cm: share of equal masks; difference of snow's colour, 1/255"
    ]
    for shading, kinds in masks.items():
        for kind, found in kinds.items():
            if not found["points"]:
                continue
            worst = min(pair["agreeing"] for pair in found["pairs"])
            rms = "-" if found["color_rms"] is None else f"{found['color_rms']:.1f} rms"
            lines.append(
                f"  {shading + ', ' + kind:<24}{_percent(found['agreeing']):>10} of "
                f"{found['points']} points (worst pair {_percent(worst)}){rms:>12}"
            )
    return lines


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.2f} %"


def _cm(length_m: float | None) -> str:
    return "-" if length_m is None else f"{100 * length_m:.2f}"


def _error_cm(error: dict[str, float | None]) -> str:
    if error["median"] is None or error["p95"] is None or error["bias"] is None:
        return "-"
    return f"{100 * error['median']:.2f}{100 * error['p95']:>8.2f}{100 * error['bias']:>+8.2f}"
