"""One way of writing a quantity: units, digits, ±, and nothing that nobody can stand behind."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eha_monitor.quantity import (
    FLOOR,
    quantity,
    readable,
    rounded,
    share,
    signed,
    with_uncertainty,
)

UNITS = ["Pa", "N·s/m", "m^3/(s*Pa)", "m³/s", "m", "1/Pa", "1", ""]


@pytest.mark.parametrize("value, unit, text", [
    (6e8, "Pa", "600 MPa"), (1.4e9, "Pa", "1400 MPa"), (2e4, "Pa", "20 kPa"), (0.04, "m", "40 mm"),
    (600.0, "N·s/m", "600 N·s/m"), (159e3, "N·s/m", "159 kN·s/m"), (25e-6, "m", "25 µm"),
    (9.98e-7, "m", "0.998 µm"),
    (7.03e-5, "N·m·s/rad", "70.3 µN·m·s/rad"), (5e-13, "m³/(s·Pa)", "30 ml/(min·MPa)"),
    (5e-13, "m^3/(s*Pa)", "30 ml/(min·MPa)"), (2.83e-9, "m³/(s·√Pa)", "0.1698 l/(min·√MPa)"),
    (1.1e-10, "m^3/(s*Pa^0.5)", "6.6 ml/(min·√MPa)"), (1e-5, "m^3/s", "0.6 l/min"),
    (5.05e-4, "m²", "5.05 cm²"), (6.85e-5, "m³", "68.5 cm³"), (3e-3, "s", "3 ms"),
    (2e-8, "1/Pa", "2 %/MPa"), (1e3, "Pa/s", "60 kPa/min"), (0.5, "N", "0.5 N"),
    (-0.04, "m/s", "−40 mm/s"), (0.0, "m", "0 m"), (float("nan"), "m", "—"),
    (3600.0, "s", "3600 s"), (9999.7, "N·s/m", "10000 N·s/m"), (99999.7, "1", "100000"),
    (1e30, "Pa", "1·10³⁰ Pa"), (0.2, "1", "0.2"),
])
def test_quantity_in_engineering_units(value, unit, text):
    assert quantity(value, unit) == text


@pytest.mark.parametrize("value, stddev, unit, text", [
    (5.99998e8, 3.0e4, "Pa", "600.0 ± 0.2 MPa"),  # not 599.998 ± 0.030
    (600.087, 0.0649, "N·s/m", "600.1 ± 0.2 N·s/m"),
    (600.123, 2.34, "N·s/m", "600.1 ± 2.3 N·s/m"),
    (6.002e8, 1.1e6, "Pa", "600.2 ± 1.1 MPa"),
    (419.2, 6.1, "N·s/m", "419 ± 6 N·s/m"),
    (182.4e3, 4.0e3, "N·s/m", "182 ± 4 kN·s/m"),
    (600.0, 0.97, "N·s/m", "600.0 ± 1.0 N·s/m"),
    (500.0, 1000.0, "N·s/m", "500 ± 1000 N·s/m"),
    (40.03, 0.08, "N", "40.03 ± 0.08 N"),
    (0.02, 0.11, "N", "0.02 ± 0.11 N"),
    (-0.001, 0.2, "N", "0.00 ± 0.20 N"),
    (1e-12, 3e-14, "m^3/(s*Pa)", "60.0 ± 1.8 ml/(min·MPa)"),
    (2.09e30, 2e28, "Pa", "(2.090 ± 0.020)·10³⁰ Pa"),
    (float("nan"), 1.0, "Pa", "—"),
    (600.0, float("inf"), "N·s/m", "600 N·s/m, ± not known"),
    (0.0, 0.0, "m", "0 ± 0 m"),
])
def test_uncertainty_sets_the_digits(value, stddev, unit, text):
    assert with_uncertainty(value, stddev, unit) == text


def test_signs_and_shares():
    assert (signed(2e4, "Pa"), signed(-2e4, "Pa")) == ("+20 kPa", "−20 kPa")
    assert share(0.0251) == "2.51 %"


@given(st.floats(allow_nan=True, allow_infinity=True),
       st.floats(allow_nan=True, allow_infinity=True), st.sampled_from(UNITS))
def test_any_number_can_be_written_and_stays_short(value, stddev, unit):
    for text in (quantity(value, unit), quantity(value, unit, 3),
                 with_uncertainty(value, stddev, unit)):
        assert text and len(text) < 50 and not re.search(r"\de[+-]?\d", text)
    assert readable(value, unit).factor > 0


@given(st.floats(1.0, 1e4), st.floats(1e-9, 1e3))
def test_no_digit_is_finer_than_the_floor_and_the_text_is_the_number(value, stddev):
    shown, spread = rounded(value, stddev)
    assert float(spread) >= 0.66 * FLOOR * value  # one digit of it, rounded
    step = 10.0 ** -len(shown.partition(".")[2])
    assert step > 0.09 * FLOOR * value
    assert abs(float(shown) - value) <= max(0.5 * float(spread), 0.6 * step)
    assert float(spread) == pytest.approx(max(stddev, FLOOR * value), rel=0.5)
    assert re.fullmatch(r"\d+(\.\d+)?", shown)
