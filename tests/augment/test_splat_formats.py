"""Contract of all splat formats: what holds for every record of the list."""

from __future__ import annotations

from typing import get_args

from augment.files.formats import SplatKind, splat_formats


def test_kinds_of_the_command_line_are_those_of_the_list():
    """The command line names the kinds without loading the formats."""
    writers = [splat_format.writer for splat_format in splat_formats()]
    assert [writer.kind for writer in writers if writer is not None] == list(get_args(SplatKind))
