"""Units are the user's word, in any usual spelling, and their sizes are right."""

import math

import pytest

from analysis.exchange import ExchangeError, parse_choice

UNITS = {
    "angle": ("rad", "mrad", "urad", "deg", "arcmin", "arcsec", "rev"),
    "torque": ("N.m", "mN.m", "uN.m", "N.cm", "N.mm", "kN.m", "lbf.in", "ozf.in"),
    "force": ("N", "mN", "kN", "lbf"),
    "time": ("s", "ms", "us", "ns"),
}


@pytest.mark.parametrize(
    ("quantity", "unit", "size"),
    [
        ("angle", "deg", math.radians(1)),
        ("angle", "°", math.radians(1)),
        ("angle", "mrad", 1e-3),
        ("angle", "µrad", 1e-6),
        ("angle", "arcsec", math.radians(1 / 3600)),
        ("angle", "rev", 2 * math.pi),
        ("torque", "Nm", 1.0),
        ("torque", "N·m", 1.0),
        ("torque", "N*m", 1.0),
        ("torque", "mN.m", 1e-3),
        ("torque", "Nmm", 1e-3),
        ("torque", "N.cm", 1e-2),
        ("torque", "lbf.in", 0.1129848290276167),  # NIST SP 811
        ("torque", "ozf.in", 7.061551814226043e-3),
        ("force", "lbf", 4.4482216152605),
        ("time", "ms", 1e-3),
        ("time", " s ", 1.0),
        ("angle", "0.02 rad", 0.02),  # equivalent of one volt
        ("angle", "2.5e-1deg", math.radians(0.25)),
        ("torque", "-1.5 mN.m", -1.5e-3),
    ],
)
def test_unit_has_its_factor(quantity, unit, size):
    assert parse_choice(f"x:{unit}", quantity).factor == pytest.approx(size, rel=1e-14)


@pytest.mark.parametrize(
    ("quantity", "unit"),
    [
        ("torque", "nm"),
        ("torque", "N"),
        ("angle", "Deg"),
        ("angle", ""),
        ("time", "min"),
        ("angle", "V"),
        ("angle", "grad"),
        ("angle", "0.02"),
        ("angle", "0 rad"),
        ("angle", "0.02 N.m"),
    ],
)
def test_wrong_unit_is_refused_with_the_valid_ones(quantity, unit):
    with pytest.raises(ExchangeError, match="choose from") as refusal:
        parse_choice(f"x:{unit}", quantity)
    assert f"choose from {', '.join(UNITS[quantity])}. " in str(refusal.value)
    # The way on for a signal in volts.
    assert "CHANNEL:0.02" in str(refusal.value)


def test_capitals_distinguish_milli_from_mega():
    assert parse_choice("x:mNm", "torque").unit == "mN.m"
    with pytest.raises(ExchangeError, match="'MNm' is not a unit of torque"):
        parse_choice("x:MNm", "torque")


def test_spellings_of_units_are_unique():
    for quantity, names in UNITS.items():
        assert [parse_choice(f"x:{name}", quantity).unit for name in names] == list(names)


def test_unit_of_a_signal_is_reported_as_stated():
    choice = parse_choice("lame:0.5 Nm", "torque")
    assert (str(choice), choice.factor) == ("lame:0.5 N.m", 0.5)


def test_choice_is_split_at_its_last_colon():
    choice = parse_choice("Rig: motor/Angle:deg", "angle")
    assert (choice.channel, choice.unit) == ("Rig: motor/Angle", "deg")
    assert str(choice) == "Rig: motor/Angle:deg"


@pytest.mark.parametrize("text", ["angle", ":deg", "  :deg", "angle:", "angle:furlong"])
def test_a_choice_without_channel_or_unit_is_refused(text):
    with pytest.raises(ExchangeError, match="deg"):
        parse_choice(text, "angle")
