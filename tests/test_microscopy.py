"""Units, axes, microscopy's formats and stacks of pictures: where and how large the world is, and never a guess without a word."""

import numpy as np
import pint
import pytest

from jvr.io.volumes.units import length_of, millimetres

# --- Units -----------------------------------------------------------------------------------------------------------

# The enumeration UnitsLength of the OME schema 2016-06, and the lengths that OME-Zarr takes from UDUNITS, as pint knows them.
OME = [
    *(
        f"{prefix}m"
        for prefix in ("Y", "Z", "E", "P", "T", "G", "M", "k", "h", "da", "", "d", "c", "m", "µ", "n", "p", "f", "a", "z", "y")
    )
]
OME += ["Å", "thou", "in", "ft", "yd", "mi", "pc"]
PREFIXES = (
    "atto",
    "centi",
    "deci",
    "exa",
    "femto",
    "giga",
    "hecto",
    "kilo",
    "mega",
    "micro",
    "milli",
    "nano",
    "peta",
    "pico",
    "tera",
    "yocto",
)
UDUNITS = [f"{prefix}{metre}" for prefix in (*PREFIXES, "yotta", "zepto", "zetta", "") for metre in ("meter", "metre", "meters")]
UDUNITS += ["angstrom", "foot", "inch", "mile", "parsec", "yard", "inches", "feet", "microns", "fermi"]


def test_units_of_length_are_those_of_pint():
    registry = pint.UnitRegistry()
    for unit in (*OME, *UDUNITS):
        np.testing.assert_allclose(length_of(unit), registry.Quantity(1.0, unit).to("mm").magnitude, rtol=1e-9, err_msg=unit)
    for unit, wanted in {"li": "inch / 12", "ua": "astronomical_unit", "ly": "light_year", "pt": "inch / 72"}.items():
        np.testing.assert_allclose(length_of(unit), registry.Quantity(wanted).to("mm").magnitude, rtol=1e-6, err_msg=unit)


@pytest.mark.parametrize(
    "unit",
    [
        "µm",
        "\u03bcm",
        "um",
        "&#181;m",
        "&micro;m",
        "&#x3BC;m",
        "\\u00B5m",
        "\\u00b5m",
        " Micron ",
        "MICROMETRES",
        "µm/pixel",
        "Âµm",
    ],
)
def test_spellings_of_a_micrometre(unit):
    assert length_of(unit) == 1e-3


def test_case_of_symbols_counts_and_unknown_units_are_said():
    assert (length_of("Mm"), length_of("mm"), length_of("pm"), length_of("Pm")) == (1e9, 1.0, 1e-9, 1e18)
    for unit, said in (
        ("pixel", "no length"),
        ("reference frame", "no length"),
        ("s", "'s' is unknown"),
        (None, "no unit"),
        ("", "no unit"),
    ):
        with pytest.warns(UserWarning, match=f"a.tif: field: .*{said}.*spacing="):
            assert millimetres("a.tif", "field", unit) == 1.0
