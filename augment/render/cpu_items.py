"""Numba functions: what a batch of splats asks for in a tile, row by row.

A tile is worked on in strips one register wide. The rows in which an ellipse meets a strip are an
interval (both are convex); they become a flat list of (row, splat) items, which one loop without
branches can blend.
"""

from __future__ import annotations

import math

import numpy as np

from augment.render import cpu_simd as v8
from augment.render.cpu_jit import inner
from augment.render.cpu_math import fmuladd
from augment.render.layout import (
    BLUE,
    BLUNT_Y,
    DEPTH,
    FALL_X,
    FALL_Y,
    GREEN,
    IS_SNOW,
    LANES,
    LEAN_X,
    LEAN_Y,
    LOG_OPACITY,
    MEAN_X,
    MEAN_Y,
    RADIUS_Y,
    RECORD,
    RED,
    SHARP_X,
    SPLAT_ID,
    STRIP,
    TILE_H,
    U,
)

BATCH = 32  # splats between two looks at what is still open
ITEMS = BATCH * TILE_H + TILE_H  # a batch's items at most, and room for the surplus


@inner()
def stage(records, members, at, count, left, top, rgb, expected, median, ids, mode, snow, staged):
    """Records of a batch, turned to one row a field, relative to the tile's corner."""
    n = U(BATCH)
    for k in range(count):
        record = U(members[at + k]) * U(RECORD)
        staged[U(MEAN_X) * n + k] = records[record + U(MEAN_X)] - left
        staged[U(MEAN_Y) * n + k] = records[record + U(MEAN_Y)] - top
        for field in range(U(LEAN_X), U(BLUNT_Y + 1)):
            staged[field * n + k] = records[record + field]
        if expected is not None or median is not None or mode is not None:
            staged[U(DEPTH) * n + k] = records[record + U(DEPTH)]
        if ids is not None:
            staged[U(SPLAT_ID) * n + k] = records[record + U(SPLAT_ID)]
        if snow is not None:
            staged[U(IS_SNOW) * n + k] = records[record + U(IS_SNOW)]
        if rgb is not None:
            staged[U(RED) * n + k] = records[record + U(RED)]
            staged[U(GREEN) * n + k] = records[record + U(GREEN)]
            staged[U(BLUE) * n + k] = records[record + U(BLUE)]


@inner()
def find_spans(staged, count, strip, rows, log_cut, spans):
    """Rows in which each ellipse meets the strip: first, and one past the last.

    An ellipse is highest where its ridge says (LEAN_X RADIUS_Y from its mean), or, where that
    column lies outside the strip, in the strip's nearest column.
    """
    zero, half = np.float32(0), np.float32(0.5)
    n = U(BATCH)
    west = np.float32(strip * LANES) + half
    east = west + np.float32(LANES - 1)
    low, high = np.float32(rows[2 * strip]), np.float32(rows[2 * strip + 1])
    for k in range(count):
        mean_x, mean_y = staged[k], staged[n + k]
        budget = staged[U(LOG_OPACITY) * n + k] - log_cut
        top = staged[U(LEAN_X) * n + k] * staged[U(RADIUS_Y) * n + k]
        fall, lean = staged[U(FALL_X) * n + k], staged[U(LEAN_Y) * n + k]
        blunt = staged[U(BLUNT_Y) * n + k]
        d = min(max(top, west - mean_x), east - mean_x)
        left_over = fmuladd(-fall * d, d, budget)
        reach = math.sqrt(max(left_over, zero)) * blunt
        end = fmuladd(lean, d, mean_y) + reach + half
        end = end if left_over >= zero else zero
        d = min(max(-top, west - mean_x), east - mean_x)
        left_over = fmuladd(-fall * d, d, budget)
        reach = math.sqrt(max(left_over, zero)) * blunt
        begin = min(max(fmuladd(lean, d, mean_y) - reach + half, low), high)
        spans[k] = np.int32(begin)
        spans[n + k] = np.int32(max(min(end, high), begin))


@inner()
def list_items(staged, count, strip, spans, values, places):
    """One item for every (row, splat), in the order of the splats; returns how many.

    An item says where its row of pixels stands in the state, which splat it is, the log2 of alpha
    on the splat's ridge in that row, and how many (sharp) pixels the row's first one is off it.
    A tile's height is always written and the surplus overwritten, which needs no branch.
    """
    n, items = U(BATCH), U(0)
    half = np.float32(0.5)
    first_x = np.float32(strip * LANES) + half
    for k in range(count):
        row, end = spans[k], spans[n + k]
        sharp = staged[U(SHARP_X) * n + k]
        fall = v8.splat(-staged[U(FALL_Y) * n + k])
        peak = v8.splat(staged[U(LOG_OPACITY) * n + k])
        start = v8.splat(sharp * (first_x - staged[k]))
        step = v8.splat(-sharp * staged[U(LEAN_X) * n + k])
        y = np.float32(row) + half - staged[n + k]
        place = np.int32(strip * STRIP) + row * np.int32(LANES)
        for j in range(0, TILE_H, LANES):
            dy = v8.lane_numbers() + v8.splat(y + np.float32(j))
            at = items + U(j)
            v8.store(values, at, v8.fmuladd(fall * dy, dy, peak))
            v8.store(values, at + U(ITEMS), v8.fmuladd(step, dy, start))
            v8.store_ramp(places, at, np.int32(k), np.int32(0))
            v8.store_ramp(places, at + U(ITEMS), np.int32(place + j * LANES), np.int32(LANES))
        items += U(end - row)
    return items
