"""What `describe` says of a volume, against numbers known beforehand."""

import json

import numpy as np
import pytest

from jvr.io.describe import describe, format_description
from jvr.model.volume import Volume


def ramp(dtype="i2"):
    return np.arange(4 * 5 * 8).reshape(4, 5, 8).astype(dtype)


def turned(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def test_numbers_in_data_units_and_ready_for_json():
    volume = Volume(ramp(), np.diag([0.8125, 2.4, 3, 1]), slope=0.5, intercept=-10.0)
    d = json.loads(json.dumps(describe(volume, "head.nii"), allow_nan=False))
    assert (d["file"], d["shape"], d["dtype"], d["bytes"]) == ("head.nii", [4, 5, 8], "int16", 320)
    assert (d["spacing"], d["origin"], d["extent"]) == ([0.8125, 2.4, 3.0], [0, 0, 0], [2.4375, 9.6, 21.0])
    assert (d["minimum"], d["maximum"], d["mean"]) == (-10.0, 69.5, 0.5 * 79.5 - 10)
    np.testing.assert_allclose(list(d["percentiles"].values()), 0.5 * np.percentile(ramp(), [1, 5, 25, 50, 75, 95, 99]) - 10)
    assert d["histogram"]["counts"] == [5] * 32
    np.testing.assert_allclose(d["histogram"]["edges"], np.linspace(-10, 69.5, 33))


def test_histogram_counts_are_those_of_numpy():
    values = np.random.default_rng(0).normal(size=(20, 30, 40)).astype("f4")
    d = describe(Volume(values))
    counts, edges = np.histogram(values.astype("f8"), 32)
    assert d["histogram"]["counts"] == counts.tolist()
    np.testing.assert_allclose(d["histogram"]["edges"], edges)


def test_negative_slope_turns_the_distribution_round():
    values = ramp() ** 2
    d, mirrored = describe(Volume(-values, slope=-1.0)), describe(Volume(values))
    for key in ("minimum", "maximum", "mean", "histogram"):
        assert d[key] == mirrored[key]
    np.testing.assert_allclose(list(d["percentiles"].values()), list(mirrored["percentiles"].values()))


@pytest.mark.parametrize(
    ("diagonal", "code"), [((1, 1, 1), "LPS"), ((-1, -1, 1), "RAS"), ((1, -1, -1), "LAI"), ((-2, 3, -4), "RPI")]
)
def test_orientation_of_straight_grids(diagonal, code):
    d = describe(Volume(ramp(), np.diag([*diagonal, 1.0])))
    assert (d["orientation"], d["oblique"], d["oblique_degrees"]) == (code, False, 0.0)


def test_orientation_of_permuted_and_oblique_grids():
    sagittal = np.array([[0, 0, -1, 5], [1, 0, 0, 6], [0, -1, 0, 7], [0, 0, 0, 1.0]])
    assert describe(Volume(ramp(), sagittal))["orientation"] == "PIR"
    d = describe(Volume(ramp(), turned(20)))
    assert (d["orientation"], d["oblique"]) == ("LPS", True)
    assert d["oblique_degrees"] == pytest.approx(20, abs=0.02)
    # At 45 degrees two letters are equally right, but no letter may come twice.
    assert len({letter for letter in describe(Volume(ramp(), turned(45)))["orientation"]}) == 3


@pytest.mark.parametrize("value", [0.0, 1e9, -1e29])
def test_constant_volumes(value):
    d = describe(Volume(np.full((3, 4, 5), value, "f4")))
    assert d["minimum"] == d["maximum"] == float(np.float32(value))
    assert sum(d["histogram"]["counts"]) == 60
    assert all(np.diff(d["histogram"]["edges"]) > 0)
    assert format_description(d)


def test_voxels_that_are_missing_are_counted_and_left_out():
    values = ramp("f4")
    values[0, 0, 1], values[0, 0, 2] = np.nan, -2000
    d = describe(Volume(values, missing=-2000))
    assert (d["missing"], d["minimum"], d["maximum"], sum(d["histogram"]["counts"])) == (2, 0.0, 159.0, 158)
    assert "missing      2 voxels (1.25 %)" in format_description(d)


def test_terminal_text_is_aligned_and_shows_single_voxels():
    values = np.zeros((20, 20, 20), "u1")
    values[3, 4, 5] = 200
    text = format_description(describe(Volume(values, turned(20)), "a.nii"))
    lines = text.splitlines()
    assert lines[0] == "file         a.nii"
    assert "20 x 20 x 20, uint8, 8 kB" in text
    assert "oblique by 20 degrees" in text
    rows = [line[13:] for line in lines[-5:-1]]
    assert [row[0] for row in rows] == ["█"] * 4
    assert len(rows[-1]) == 32
    assert rows[-1][-1] != " "
    assert rows[-1][1:-1].strip() == ""
    assert lines[-1].split() == ["0", "200"]
