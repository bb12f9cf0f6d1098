"""Units as loggers write them, held against factors worked out by hand."""

from math import pi

import pytest

from jaxatt.units import factor, known, of_name

DEG = pi / 180


@pytest.mark.parametrize(
    ("said", "wanted", "by"),
    [
        ("deg/s", "rad/s", DEG), ("°/s", "rad/s", DEG), ("Deg/sec", "rad s^-1", DEG), ("degrees per second", "deg/s", 1), ("dps", "deg/s", 1),
        ("mdps", "deg/s", 1e-3), ("deg/h", "deg/s", 1 / 3600), ("rpm", "rad/s", pi / 30), ("mrad/s", "rad/s", 1e-3), ("arcsec", "rad", DEG / 3600),
        ("m s^-2", "m/s²", 1), ("m s⁻²", "m/s^2", 1), ("m/s/s", "m s-2", 1), ("µT", "nT", 1e3), ("uT", "T", 1e-6), ("gauss", "T", 1e-4),
        ("in-lbf-s", "in-lbf s", 1), ("in-lbf s", "N m s", 0.0254 * 4.4482216152605), ("in-lbf/(rad s)", "N m/rad/s", 0.0254 * 4.4482216152605),
        ("N-m", "Nm", 1), ("mNm", "N m", 1e-3), ("kg*m^2", "kg m^2", 1), ("", "1", 1), ("-", "1", 1), ("%", "1", 0.01), ("counts", "counts", 1),
    ],
)  # fmt: skip
def test_units_of_one_quantity_differ_by_a_factor(said, wanted, by):
    assert factor(said, wanted) == pytest.approx(by, rel=1e-15) and factor(wanted, said) == pytest.approx(
        1 / by, rel=1e-15
    )


@pytest.mark.parametrize(
    ("said", "wanted"),
    [("1/s", "rad/s"), ("Hz", "rad/s"), ("deg", "deg/s"), ("degC", "deg"), ("g", "m/s^2"), ("counts", "1"), ("LSB", "rad/s"), (None, "1"),
     ("rad/s/sqrt(s)", "rad/s"), ("1, rad/s", "rad/s"), ("(rad/s)^2", "rad^2/s^2"), ("deg/", "deg"), ("m/2", "1/m"), ("^2", "1"), ("mT)", "T"), ("rad^0.5", "rad")],
)  # fmt: skip
def test_others_are_not_taken_for_each_other(said, wanted):
    assert factor(said, wanted) is None


def test_texts_that_are_units_and_names_that_end_in_one():
    assert [text for text in ("s", "deg/s", "1", "", "x", "gyro", "2.5", "nan", "m/s²") if known(text)] == [
        "s",
        "deg/s",
        "m/s²",
    ]
    names = (
        "gyro_x_deg_s",
        "GyroX_dps",
        "gyroXDegPerSec",
        "timeMs",
        "t.us",
        "w_rad_s (x)",
        "g:deg/s",
        "g, rad/s",
        "g / (deg/s)",
        "g <mT>",
    )
    assert [of_name(name) for name in names] == [
        "deg/s",
        "deg/s",
        "deg/s",
        "ms",
        "us",
        "rad/s",
        "deg/s",
        "rad/s",
        "deg/s",
        "mT",
    ]
    assert of_name("g [deg/s] (x)") == "deg/s" and not any(
        map(of_name, ("q_s", "gx", "ms", "omega_x", "q[0]", "w (x)", "share [1]", "a:b"))
    )
