"""Files of luminaires: what they mean, and hostile ones."""

from __future__ import annotations

import numpy as np
import pytest

from augment.errors import LampError
from augment.lamps import patterns
from augment.lamps.ies import MAX_BYTES, IesLuminaire, parse_ies, read_ies

VERTICAL = (0.0, 30.0, 60.0, 90.0)
HEADER = "IESNA:LM-63-2002\n[TEST] made up\n[MANUFAC] none\nTILT=NONE\n"


def ies_text(
    horizontal=(0.0,),
    candela=((100.0, 200.0, 400.0, 0.0),),
    *,
    header: str = HEADER,
    numbers: str = "1 1000 2.0 {v} {h} 1 2 0.2 0.5 0.1",
    ballast: str = "0.5 1 60",
) -> str:
    """A file of type C; its multipliers 2 and 0.5 leave the candela."""
    lines = [
        numbers.format(v=len(VERTICAL), h=len(horizontal)),
        ballast,
        " ".join(map(str, VERTICAL)),
        " ".join(map(str, horizontal)),
        *(" ".join(map(str, row)) for row in candela),
    ]
    return header + "\n".join(lines) + "\n"


def test_round_luminaire_has_its_candela_in_all_planes_and_none_above():
    luminaire = parse_ies(ies_text(), "lamp.ies")
    angles = np.array([0.0, 30.0, 45.0, 60.0, 75.0, 90.0, 120.0])
    for turn in (0.0, 77.0, 210.0):
        values = luminaire.candela_at(angles, np.full_like(angles, turn))
        np.testing.assert_allclose(values, [100, 200, 300, 400, 200, 0, 0])
    # A disc of the area 0.2 m x 0.5 m.
    assert luminaire.radius_m == pytest.approx(np.sqrt(0.1 / np.pi))


def planes(*names_and_values: float):
    """Rows of candela that are equal at all vertical angles."""
    return tuple((value,) * len(VERTICAL) for value in names_and_values)


@pytest.mark.parametrize(
    ("horizontal", "values", "expected"),
    [
        ((0.0, 90.0), (10.0, 20.0), {0: 10, 45: 15, 90: 20, 135: 15, 180: 10, 270: 20, 315: 15}),
        ((0.0, 90.0, 180.0), (10.0, 20.0, 40.0), {90: 20, 135: 30, 180: 40, 225: 30, 270: 20}),
        ((90.0, 180.0, 270.0), (10.0, 20.0, 40.0), {90: 10, 0: 20, 45: 15, 180: 20, 315: 30}),
        ((0.0, 90.0, 180.0, 270.0, 360.0), (1.0, 2.0, 3.0, 4.0, 1.0), {90: 2, 270: 4, 315: 2.5}),
    ],
)
def test_planes_that_a_file_leaves_out_follow_from_its_symmetry(horizontal, values, expected):
    luminaire = parse_ies(ies_text(horizontal, planes(*values)), "lamp.ies")
    for turn, value in expected.items():
        assert luminaire.candela_at(np.array([30.0]), np.array([float(turn)]))[0] == value, turn
        assert luminaire.candela_at(np.array([30.0]), np.array([turn - 360.0]))[0] == value


def test_street_side_is_0_in_american_files_and_90_in_others():
    american = parse_ies(ies_text((0.0, 90.0, 180.0), planes(50.0, 90.0, 10.0)), "a.ies")
    european = parse_ies(ies_text((90.0, 180.0, 270.0), planes(50.0, 90.0, 10.0)), "b.ies")
    assert american.street_side_deg == 0 and european.street_side_deg == 90
    for luminaire in (american, european):
        table, peak_cd = luminaire.pack()
        directions = patterns.directions_at(np.full(3, -60.0), np.array([0.0, 90.0, -90.0]))
        values = peak_cd * patterns.pattern_value(table, directions)
        # Along the road, across it, and behind the mast; 1 cd of 90 for the bend of the planes
        # at the mast, which lies within a node's width.
        np.testing.assert_allclose(values, [90, 50, 10], atol=1.0)


def test_packed_luminaire_keeps_its_flux():
    luminaire = parse_ies(ies_text(), "lamp.ies")
    table, peak_cd = luminaire.pack()
    angles = np.radians(np.linspace(0, 90, 2001))
    values = luminaire.candela_at(np.degrees(angles), np.zeros_like(angles))
    flux_lm = 2 * np.pi * np.trapezoid(values * np.sin(angles), angles)
    packed_lm = 4 * np.pi * peak_cd * patterns.mean_over_directions(table)
    assert packed_lm == pytest.approx(flux_lm, rel=0.02)  # the corners of four angles


def test_tilt_include_is_read_over_and_leaves_the_candela():
    tilted = ies_text(header="IESNA91\nTILT=INCLUDE\n1\n3\n0 45 90\n1.0 0.9 0.8\n")
    plain = parse_ies(ies_text(), "a.ies")
    np.testing.assert_array_equal(parse_ies(tilted, "b.ies").candela, plain.candela)


BAD_FILES = (
    ("", "no line TILT="),
    ("\x00\x01\x02" * 50, "no line TILT="),
    (ies_text(header="IESNA91\nTILT=../../etc/passwd\n"), "names another file, which is not read"),
    (ies_text(header="IESNA91\nTILT=INCLUDE\n1\n900\n0 90\n"), "ends within the 900 angles"),
    (HEADER, "must be 13 numbers; the file ends after 0"),
    (ies_text(numbers="1 1000 2 {v} {h} 3 2 0 0 0"), r"only photometry of type C .* type A \(3\)"),
    (ies_text(numbers="1 1000 2 {v} {h} 2 2 0 0 0"), r"type B \(2\)"),
    (ies_text(numbers="1 1000 2 {v} {h} 1 5 0 0 0"), "unit must be 1"),
    (ies_text(numbers="1 1000 2 900000000 {h} 1 2 0 0 0"), "vertical angles must be a whole"),
    (ies_text(numbers="1 1000 2 999 999 1 2 0 0 0"), "at most 250,000 candela values"),
    (ies_text(numbers="1 1000 2 -4 {h} 1 2 0 0 0"), "whole number from 1 to 1000; got -4"),
    (ies_text(numbers="1 1000 2 3.5 {h} 1 2 0 0 0"), "whole number"),
    (ies_text(numbers="1 1000 nan {v} {h} 1 2 0 0 0"), "must be finite; got 'nan'"),
    (ies_text(numbers="1 1000 -2 {v} {h} 1 2 0 0 0"), "multipliers of candela must be > 0"),
    (ies_text(candela=((100.0, -1.0, 5.0, 5.0),)), r"0 to 1e\+08 cd; got -1 cd"),
    (ies_text(candela=((100.0, 1e12, 5.0, 5.0),)), "got 1e"),
    (ies_text(candela=((100.0, "inf", 5.0, 5.0),)), "must be finite; got 'inf'"),
    (ies_text(candela=((100.0, "x" * 500, 5.0, 5.0),)), "candela values must be numbers; got 'xxx"),
    (ies_text(candela=((100.0, 5.0),)), "must be 4 numbers; the file ends after 2"),
    (ies_text((0.0, 0.0), planes(1.0, 2.0)), "horizontal angles must increase"),
    (ies_text((0.0, 45.0), planes(1.0, 2.0)), "horizontal angles must go from 0"),
    (ies_text().replace("0.0 30.0 60.0", "10.0 30.0 60.0"), "vertical angles must go from 0"),
)


@pytest.mark.parametrize(("text", "message"), BAD_FILES)
def test_damaged_and_hostile_files_are_refused_with_the_reason(text, message):
    with pytest.raises(LampError, match=message) as error:
        parse_ies(text, "lamp.ies")
    assert str(error.value).startswith("lamp.ies") and len(str(error.value)) < 300


def test_files_that_are_missing_or_too_large_are_refused(tmp_path):
    with pytest.raises(LampError, match="cannot be read as an IES file: No such file"):
        read_ies(tmp_path / "absent.ies")
    large = tmp_path / "large.ies"
    large.write_bytes(b" " * (MAX_BYTES + 1))
    with pytest.raises(LampError, match="at most 4,000,000 bytes"):
        read_ies(large)
    file = tmp_path / "lamp.ies"
    file.write_text(ies_text())
    assert isinstance(read_ies(file), IesLuminaire)


def test_a_dark_luminaire_is_no_lamp():
    dark = parse_ies(ies_text(candela=((0.0,) * 4,)), "lamp.ies")
    with pytest.raises(LampError, match="without any light"):
        dark.pack()
