"""Segments of a folder of the Waymo Open Dataset, and the conditions that its statistics state."""

from __future__ import annotations

from pathlib import Path

from adapters.waymo.tables import SEGMENT, find_segment, find_segments
from augment.files.packed_images import parquet_errors
from augment.output.tables import read_table

# Component with the statistics of each frame.
_STATS = "stats"
# Columns of that component.
_WEATHER = "[StatsComponent].weather"
_TIME_OF_DAY = "[StatsComponent].time_of_day"
# Conditions by the dataset's values.
_CONDITIONS = {"rain": "rain", "fog": "fog", "snow": "snow", "Night": "night"}


def list_segments(path: str, query: dict[str, str]) -> list[dict[str, str]]:
    """Return the query of each segment in a folder: of the one that the query names, or of all."""
    if "segment" in query:
        return [query]
    return [{**query, "segment": name} for name in sorted(find_segments(Path(path)))]


def recorded_conditions(path: str, query: dict[str, str]) -> tuple[str, ...]:
    """Return the conditions that a segment's statistics state; none without the component."""
    files = find_segment(Path(path), query.get("segment"))
    if not files.has(_STATS):
        return ()
    file = files.path(_STATS)
    with parquet_errors(file):
        rows = read_table(file, str(file), [SEGMENT, _WEATHER, _TIME_OF_DAY]).to_pylist()
    values = {
        row.get(column)
        for row in rows
        if row.get(SEGMENT) == files.name
        for column in (_WEATHER, _TIME_OF_DAY)
    }
    return tuple(dict.fromkeys(name for value, name in _CONDITIONS.items() if value in values))
